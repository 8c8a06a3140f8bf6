"""The Parquet files of a recorded set, from what its robots lived; streams.py describes them."""

import dataclasses
import pathlib
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjx_cl.errors import FileError
from mjx_cl.io import tables
from mjx_cl.leaderboard.lives import Lane
from mjx_cl.leaderboard.streams import COLUMNS, META, PROJECTION, SIGNED
from mjx_cl.leaderboard.suite import Suite

Part = tuple[list[Lane], np.ndarray, dict[str, np.ndarray]]  # lanes, onsets (S,), what `live` gave
FLOOR = 1e-6  # residuals below are taken as this before the logarithm
FINENESS = {"opr": 4, "rpr": 4, "reward": 4, "surprise": 4, "group": 2, "z": 2, "innovation": 1}
HALF = 60_000.0, 2.0**-24  # the largest innovation and the finest step that float16 holds
PROBES = 5  # fault streams of each robot that come once more, cut off
HEALTHY_PROBES = 2  # of each split of each robot


@dataclasses.dataclass
class Robot:
  """Streams of one robot, while its files are put together.

  Attributes:
    suite: that is recorded.
    common: what its rows of META share.
    number: of the next stream.
    grain: rounding step of each column.
    rows: blocks of ROBOT.parquet, a dict of columns each.
    latents: blocks of ROBOT_latents.parquet.
    signed: blocks of ROBOT_innovations.parquet.
    meta: rows of META.
    differ: pasts that differ from those of their twins.
    names: columns of innovations, in their order; none: not recorded.
  """

  suite: Suite
  common: dict[str, Any]
  number: int
  grain: dict[str, float]
  rows: list[dict[str, np.ndarray]] = dataclasses.field(default_factory=list)
  latents: list[dict[str, np.ndarray]] = dataclasses.field(default_factory=list)
  signed: list[dict[str, np.ndarray]] = dataclasses.field(default_factory=list)
  meta: list[dict[str, Any]] = dataclasses.field(default_factory=list)
  differ: int = 0
  names: tuple[str, ...] = ()

  def add(self, **values: Any) -> None:
    """A stream more in `meta`."""
    known = {"stream": self.number, "severity": 0.0, "full": True} | self.common | values
    self.meta.append(dict.fromkeys(META) | known)
    self.number += 1

  def fill(
    self,
    data: dict[str, np.ndarray],
    lane: int,
    steps: tuple[int, int],
    until: int,
    columns: tuple[str, ...] = COLUMNS,
  ) -> None:
    """Rows `steps` of the stream that was added last, its latents up to step `until`, and its
    innovations where all `columns` are kept.
    """
    index = lambda last: {
      "stream": np.full(last - steps[0], self.number - 1, np.int32),
      "step": np.arange(steps[0], last, dtype=np.int32),
    }
    at, unknown = slice(*steps), np.full(steps[1] - steps[0], np.nan, np.float32)
    self.rows.append(
      index(steps[1])
      | {k: data[k][at, lane] for k in ("episode", "terminated")}
      | {k: rounded(data[k][at, lane], k, self.grain) if k in columns else unknown for k in COLUMNS}
    )
    z = data["latent"][steps[0] : until, lane].astype(np.float32)
    self.latents.append(
      index(until) | {name: rounded(z[:, k], name, self.grain) for k, name in enumerate(PROJECTION)}
    )
    if self.names and columns == COLUMNS:
      errors = data["innovation"][at, lane]
      signed = {c: half(errors[:, k], c, self.grain) for k, c in enumerate(self.names)}
      self.signed.append(index(steps[1]) | signed)

  def healthy(self, split: str, part: Part) -> None:
    """Streams of healthy robots."""
    who, _, data = part
    steps = len(data["opr"])
    for i, lane in enumerate(who):
      self.add(split=split, kind="nominal", seed=lane.seed, steps=steps)
      self.fill(data, i, (0, steps), steps if i < self.suite.latents["nominal"] else 0)

  def faulty(self, split: str, part: Part) -> None:
    """Streams of faulty robots, and the pasts that they share.

    Raises:
      FileError where a past is not that of the healthy robot of the same seed, step for step.
    """
    who, onsets, data = part
    control_s, past = self.common["control_s"], {}
    latents = round(self.suite.latents["after_s"] / control_s)
    for i, (lane, onset) in enumerate(zip(who, onsets.tolist())):
      end = onset + self.suite.after(control_s)
      if lane.fault is None:
        past[lane.seed] = self.number, i
        self.add(split=split, kind="past", seed=lane.seed, steps=end)
        self.fill(data, i, (0, end), onset)
        continue
      twin, j = past[lane.seed]
      same = lambda k, i=i, j=j, n=onset: np.array_equal(data[k][:n, i], data[k][:n, j])
      if not (same("episode") and same("terminated")):
        raise FileError(
          f"{self.common['robot']}, {lane.fault}, seed {lane.seed}: its past differs from that of "
          "the healthy robot of the same seed"
        )
      seen = data["reward"][:onset, i]
      theirs = np.where(np.isnan(seen), 0, data["reward"][:onset, j])
      self.differ += not np.array_equal(theirs, np.nan_to_num(seen))
      self.add(
        split=split,
        kind="fault",
        seed=lane.seed,
        fault=lane.fault,
        target=str(data["target"][i]),
        severity=lane.severity,
        onset=onset,
        steps=end,
        prefix=twin,
        full=lane.full,
      )
      until = min(end, onset + latents) if lane.full else onset
      self.fill(data, i, (onset, end), until, COLUMNS if lane.full else ("opr", "rpr"))

  def probes(self) -> None:
    """Some fault streams that score again, cut off somewhere: a score that looks ahead betrays
    itself there.
    """
    rng = np.random.default_rng(zlib.crc32(self.common["robot"].encode()))
    whole = [row for row in self.meta if row["kind"] == "fault"]
    for at in rng.choice(len(whole), min(PROBES, len(whole)), replace=False):
      source = whole[at]
      cut = int(rng.integers(source["onset"], source["steps"]))
      self.add(split="score", kind="probe", seed=source["seed"], steps=cut, prefix=source["stream"])


def write(
  suite: Suite,
  out: pathlib.Path,
  robot: str,
  parts: dict[tuple[str, str], Part],
  number: int,
  control_s: float,
  groups: str,
  variables: Sequence[str] = (),
) -> tuple[dict, list[dict]]:
  """Writes ROBOT.parquet, ROBOT_latents.parquet and, where `variables` names what their innovations
  are of, ROBOT_innovations.parquet, streams numbered from `number` on.

  Returns:
    (details of config.json: rounding steps, and the number of pasts that differ in the last digits,
    hence later in all, which should be 0; the streams' rows of META).
  """
  common = {"robot": robot, "control_s": control_s, "groups": groups}
  names = tuple(f"{SIGNED}{name}" for name in variables)
  own = Robot(suite, common, number, grains(parts["tune", "nominal"][2], names), names=names)
  for split in ("score", "tune"):
    own.healthy(split, parts[split, "nominal"])
    own.faulty(split, parts[split, "fault"])
    if split == "score":
      own.probes()
  # 11: 9 % smaller than zstd at its best; but half a MB a second
  level = 11 if sum(len(block["step"]) for block in own.rows) < 2_000_000 else 5
  for name, blocks, split_up in (
    (robot, own.rows, COLUMNS),
    (f"{robot}_latents", own.latents, PROJECTION),
    (f"{robot}_innovations", own.signed, names),
  ):
    if not blocks:
      continue
    table = {k: np.concatenate([block[k] for block in blocks]) for k in blocks[0]}
    tables.write_table(out / f"{name}.parquet", table, split=split_up, codec="brotli", level=level)
  told = {"rounding": own.grain, "pasts_that_differ": own.differ}
  return told | ({"innovations": list(names)} if names else {}), own.meta


def healthy_probes(rows: list[dict]) -> list[dict]:
  """Rows of META for streams that are healthy ones cut off: a threshold rests on these streams
  alone, so a score may not look ahead in them either.

  They hold no rows of their own, and are numbered behind all others; which streams, and how long,
  follows from the robot's name.
  """
  rows = sorted(rows, key=lambda row: row["stream"])
  out: list[dict] = []
  first = rows[-1]["stream"] + 1
  for robot in dict.fromkeys(row["robot"] for row in rows):
    for split in ("score", "tune"):
      kind = robot, split, "nominal"
      whole = [row for row in rows if (row["robot"], row["split"], row["kind"]) == kind]
      rng = np.random.default_rng(zlib.crc32(f"{robot} {split}".encode()))
      for at in rng.choice(len(whole), min(HEALTHY_PROBES, len(whole)), replace=False):
        source = whole[at]
        cut = int(rng.integers(source["steps"] // 4, source["steps"]))
        own = {"kind": "probe", "steps": cut, "prefix": source["stream"]}
        out.append(source | own | {"stream": first + len(out)})
  return out


def write_meta(out: pathlib.Path, rows: list[dict]) -> None:
  """Writes streams.parquet, a row of META a stream, in the order of their numbers."""
  rows = sorted(rows, key=lambda row: row["stream"])
  columns: dict[str, Any] = {k: [row[k] for row in rows] for k in META}
  for k in ("stream", "seed", "steps"):
    columns[k] = np.asarray(columns[k], np.int32)
  tables.write_table(out / "streams.parquet", columns)


def grains(healthy: dict[str, np.ndarray], names: Sequence[str] = ()) -> dict[str, float]:
  """How each column is rounded, from healthy streams: relative steps (of residuals, groups and
  surprise) or absolute ones (reward, latents, innovations), powers of two near the deviation (of
  the logarithm; absolute) divided by FINENESS.

  Args:
    healthy: what `live` gave.
    names: columns of innovations.
  """
  out, signed = {}, {name: k for k, name in enumerate(names)}
  for name in (*COLUMNS, *PROJECTION, *names):
    if name in signed:
      x = healthy["innovation"][..., signed[name]]
    else:
      x = healthy["latent"][..., int(name[1:])] if name in PROJECTION else healthy[name]
    x = x[np.isfinite(x)].astype(np.float64)
    wide = float(np.std(x if absolute(name) else np.log(np.maximum(x, FLOOR)))) if len(x) else 0.0
    fineness = FINENESS["z" if name in PROJECTION else name.split("_")[0]]
    power = float(np.round(np.log2(max(wide, 1e-9) / fineness)))
    out[name] = 2.0 ** (power if absolute(name) else min(-1.0, power))
    if name in signed:
      out[name] = max(out[name], HALF[1])
  return out


def absolute(name: str) -> bool:
  """Whether a column is rounded to absolute steps; the others may not be negative and are rounded
  to relative ones.
  """
  return name == "reward" or name in PROJECTION or name.startswith(SIGNED)


def rounded(x: np.ndarray, name: str, grain: dict[str, float]) -> np.ndarray:
  """`x` on the grid of its column, float32 whose low mantissa bits are zero; nan stays nan."""
  x = x.astype(np.float32)
  if absolute(name):
    return (np.round(x.astype(np.float64) / grain[name]) * grain[name]).astype(np.float32)
  drop = 23 + int(np.log2(grain[name]))
  x = np.maximum(x, np.float32(FLOOR))
  if drop < 1:  # a column that hardly varies
    return x
  bits = x.view(np.uint32).astype(np.uint64)
  kept = (((bits + (1 << (drop - 1))) >> drop) << drop).astype(np.uint32).view(np.float32)
  return np.where(np.isfinite(x), kept, np.nan).astype(np.float32)


def half(x: np.ndarray, name: str, grain: dict[str, float]) -> np.ndarray:
  """`rounded`, as float16."""
  return rounded(np.clip(x, -HALF[0], HALF[0]), name, grain).astype(np.float16)
