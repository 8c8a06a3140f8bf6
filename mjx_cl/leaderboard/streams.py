"""Recorded residual streams: a suite (TOML) -> Parquet that pandas alone reads -> arrays that
detectors are scored on. Schema: `SCHEMA`, `META`.

A set is a folder: `streams.parquet` (one row per stream, `META`), ROBOT.parquet (one row per stream
and control step, `SCHEMA`), ROBOT_latents.parquet (stream, step, z0..z15, where they were kept) and
config.json. A fault stream shares its past with the healthy robot of the same seed: rows before its
onset are those of the stream `prefix`, and stand there alone. `StreamSet` joins them; so does, in
pandas,
  own = rows[rows.stream == s]; past = rows[(rows.stream == prefix) & (rows.step < onset)];
  pandas.concat([past, own])
Values are rounded to powers of two near a quarter of the deviation on healthy robots (half for
groups and latents), of the logarithm where they cannot be negative: a column's variance grows by
0.5 % (2 %), the files shrink to a third. config.json holds the steps.
"""

from __future__ import annotations

import dataclasses
import json
import pathlib
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mjx_cl.errors import FileError, UserError
from mjx_cl.io import tables
from mjx_cl.rollout.monitor import CHANNELS, LATENT, Residual
from mjx_cl.scoring import metrics

if TYPE_CHECKING:
  from collections.abc import Collection, Sequence
  from typing import Any

VERSION = 1
HERE = pathlib.Path(__file__).parent
SUITES, RECORDINGS = HERE / "suites", HERE / "recordings"
COLUMNS = tuple(CHANNELS)
SCHEMA = {
  "stream": "int32, number of the stream",
  "step": "int32, control step since the stream began",
  "episode": "int16, episode of the stream",
  "terminated": "bool, the episode ended in this step",
  **{
    name: f"float32, {what}"
    + ("; its name is in streams.parquet, `groups`" if name.startswith("group_") else "")
    for name, what in CHANNELS.items()
  },
}
META = {
  "stream": "int32",
  "robot": "string",
  "kind": "nominal, fault, past (the healthy robot that fault streams of its seed share their past "
  "with) or probe (a stream cut off at `steps`, "
  "for the test of causality)",
  "split": "score or tune",
  "seed": "int32",
  "fault": "string, null for nominal",
  "target": "string, null for nominal",
  "severity": "float64",
  "onset": "int32, first control step that the fault acts in, null for nominal",
  "steps": "int32, length with its past",
  "prefix": "int32, stream that holds the rows before `onset`, null: none",
  "full": "bool, false: opr and rpr alone were kept",
  "control_s": "float64, control period",
  "groups": "string, names of the eight parts, comma-separated",
}


# ---- suites --------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Suite:
  """What is recorded and how it is scored; read from TOML.

  Attributes:
    name, arl0 [control steps], count_from [control steps], onset (low, high) [control steps],
    horizon_s: as in suites/leaderboard.toml.
    seeds: split -> (first, last). nominal: steps, and split -> streams per seed. latents: nominal
      (streams), after_s.
    robots: robot -> split -> {fault or fault:target: severities}.
  """

  name: str
  arl0: float
  count_from: int
  onset: tuple[int, int]
  horizon_s: float
  seeds: dict[str, tuple[int, int]]
  nominal: dict[str, int]
  latents: dict[str, float]
  robots: dict[str, dict[str, dict[str, tuple[float, ...]]]]

  def __post_init__(self) -> None:
    def need(holds: object, text: str) -> None:
      if not holds:
        raise UserError(f"suite {self.name!r}: {text}")

    table: Any
    whole: dict[str, list[Any]] = {
      "count_from": [self.count_from],
      "onset": list(self.onset),
      **{f"[seeds] {k}": list(v) for k, v in self.seeds.items()},
      **{f"[nominal] {k}": [v] for k, v in self.nominal.items()},
      "[latents] nominal": [self.latents.get("nominal", 0)],
    }
    for name, values in whole.items():
      need(
        all(type(v) is int for v in values),
        f"{name} must be made of whole numbers; got {', '.join(map(str, values))}",
      )
    need(all(len(v) == 2 for v in self.seeds.values()), "[seeds] are [first, last]")
    need(self.arl0 > 0 and self.horizon_s > 0, "arl0 and horizon_s must be above 0")
    need(
      len(self.onset) == 2 and 0 <= self.count_from <= self.onset[0] < self.onset[1],
      "onset must be [low, high] with count_from <= low < high",
    )
    for table, keys in (
      ("seeds", {"score", "tune"}),
      ("nominal", {"steps", "score", "tune"}),
      ("latents", {"nominal", "after_s"}),
    ):
      need(set(getattr(self, table)) == keys, f"[{table}] needs {', '.join(sorted(keys))}")
    need(self.nominal["steps"] > self.count_from, "nominal steps must exceed count_from")
    need(
      min(self.nominal["score"], self.nominal["tune"]) >= 1,
      "[nominal] needs one or more streams per seed of either split",
    )
    (a, b), (c, d) = (self.seeds[s] for s in ("score", "tune"))
    apart = min(a, c) >= 0 and a <= b and c <= d and (b < c or d < a)
    need(
      apart, "the seeds that score and the seeds that tune must be two ranges without a common seed"
    )
    need(bool(self.robots), "no [robots.NAME]")
    for robot, splits in self.robots.items():
      need(
        set(splits) <= {"score", "tune"} and splits.get("score"),
        f"robot {robot!r} needs a table `score`, and may have `tune`",
      )
      both = {k.split(":")[0] for k in splits["score"]} & {
        k.split(":")[0] for k in splits.get("tune", {})
      }
      need(
        not both,
        (
          f"robot {robot!r}: {', '.join(sorted(both))} is to tune and to score; take different "
          "faults"
        ),
      )
      for key, severities in ((k, v) for s in splits.values() for k, v in s.items()):
        sound = bool(severities) and all(
          isinstance(x, (int, float)) and 0 < x <= 1 for x in severities
        )
        need(sound, f"robot {robot!r}, {key}: severities in (0, 1]")
      for table in splits.values():
        named = [
          (key.split(":")[0], float(x)) for key, severities in table.items() for x in severities
        ]
        twice = sorted({f"{fault} {x:g}" for fault, x in named if named.count((fault, x)) > 1})
        need(
          not twice,
          (
            f"robot {robot!r}: {', '.join(twice)} is there twice; a line of the board is one "
            "fault at one severity, with one target"
          ),
        )

  def numbers(self, split: str) -> list[int]:
    """Seeds of a split."""
    first, last = self.seeds[split]
    return list(range(first, last + 1))

  def onset_of(self, seed: int) -> int:
    """First faulty control step of a seed's streams."""
    return int(np.random.default_rng([seed, 7]).integers(*self.onset))

  def after(self, control_s: float) -> int:
    """Control steps that are kept from the onset on."""
    return int(np.ceil(self.horizon_s / control_s)) + 1


def _suite(data: dict) -> Suite:
  """A suite from TOML or JSON, which know no tuples."""
  return Suite(
    **data
    | {"onset": tuple(data["onset"]), "seeds": {k: tuple(v) for k, v in data["seeds"].items()}}
  )


def suite(name: str) -> Suite:
  """A suite by name (`mjx-cl list suites`) or from a TOML file. `base` in a file names a suite that
  ships: what the file leaves out is as there.

  Raises:
    UserError for an unknown name or a value out of range; FileError for a file that is no TOML.
  """
  path, data = tables.read_suite(name, SUITES)
  if "base" in data:
    base = data.pop("base")
    names = sorted(p.stem for p in SUITES.glob("*.toml"))
    if base not in names:
      raise UserError(f"suite {path.name}: unknown base {base!r}; choose from: {', '.join(names)}")
    data = tables.read_suite(base, SUITES)[1] | data
  fields = {f.name for f in dataclasses.fields(Suite)}
  if set(data) != fields:
    wrong = [f"unknown {k!r}" for k in sorted(set(data) - fields)] + [
      f"missing {k!r}" for k in sorted(fields - set(data))
    ]
    raise UserError(f"suite {path.name}: {', '.join(wrong)}; it takes: {', '.join(sorted(fields))}")
  try:
    return _suite(data)
  except (TypeError, AttributeError, ValueError) as e:
    raise UserError(f"suite {path.name}: a value of the wrong kind ({e})") from None


def about() -> dict[str, str]:
  """Name -> what a shipped suite holds, in one line."""
  out = {}
  for path in sorted(SUITES.glob("*.toml")):
    s = suite(path.stem)
    out[s.name] = ", ".join(
      (
        f"{r}: {sum(map(len, t['score'].values()))} faults that score, "
        f"{sum(map(len, t.get('tune', {}).values()))} that tune"
      )
      for r, t in s.robots.items()
    )
  return out


# ---- reading -------------------------------------------------------------------------------------


class Streams(NamedTuple):
  """Streams side by side, time-major NumPy arrays; unknown values are nan.

  Attributes:
    residual: monitor.Residual with leading (T, S); `variables` is empty. episode: int16 (T, S).
    stream, seed, onset: int (S,); onset is T for a healthy stream. fault, target: lists of S.
      severity: float (S,). control_s: [s].
  """

  residual: Residual
  episode: np.ndarray
  stream: np.ndarray
  seed: np.ndarray
  onset: np.ndarray
  fault: list
  target: list
  severity: np.ndarray
  control_s: float


class StreamSet:
  """A recorded set, see the module's text.

  Args:
    folder: of the set; None: the one that ships.

  Raises:
    FileError for a folder that holds none, or one of another version.
  """

  def __init__(self, folder: pathlib.Path | str | None = None) -> None:
    self.folder = pathlib.Path(folder) if folder else RECORDINGS / "leaderboard"
    try:
      self.config = json.loads((self.folder / "config.json").read_text())
    except (OSError, ValueError):
      raise FileError(
        f"{self.folder} holds no recorded streams (no readable config.json); make some with "
        "`mjx-cl record`"
      ) from None
    version = self.config.get("version") if isinstance(self.config, dict) else None
    if version is None:
      raise FileError(
        f"{self.folder} holds no recorded streams: its config.json is of something else; make "
        "some with `mjx-cl record`"
      )
    if version != VERSION:
      raise FileError(
        f"{self.folder}: streams of version {version}, this release reads version {VERSION}; "
        "record them anew"
      )
    try:
      self.suite = _suite(self.config["suite"])
    except (KeyError, TypeError, AttributeError, ValueError) as e:
      raise FileError(
        f"{self.folder / 'config.json'} names no suite ({type(e).__name__}: {e})"
      ) from None
    self.meta = tables.read_table(self.folder / "streams.parquet")
    if set(self.meta) != set(META):
      raise FileError(
        f"{self.folder / 'streams.parquet'} is not of this schema: it has {', '.join(self.meta)}"
      )
    self._rows: dict[str, dict] = {}

  @property
  def robots(self) -> list[str]:
    """Robots of the set, in its order."""
    return list(dict.fromkeys(self.meta["robot"].tolist()))

  def choose(self, robots: Collection[str] = ()) -> list[str]:
    """These robots, each once; all where none is named. UserError for one that the set lacks."""
    for robot in robots:
      if robot not in self.robots:
        raise UserError(f"this set has no robot {robot!r}; choose from: {', '.join(self.robots)}")
    return list(dict.fromkeys(robots)) or self.robots

  def find(
    self,
    robot: str,
    kind: str,
    split: str | None = None,
    fault: str | None = None,
    severity: float | None = None,
  ) -> np.ndarray:
    """Stream numbers, in order."""
    m = self.meta
    hit = (m["robot"] == robot) & (m["kind"] == kind)
    for column, value in (("split", split), ("fault", fault), ("severity", severity)):
      if value is not None:
        hit &= m[column] == value
    return m["stream"][hit]

  def faults(self, robot: str, split: str = "score") -> list[tuple[str, float]]:
    """(fault, severity) of fully kept streams, in the order of the suite."""
    m = self.meta
    hit = (m["robot"] == robot) & (m["kind"] == "fault") & (m["split"] == split) & m["full"]
    return list(dict.fromkeys(zip(m["fault"][hit].tolist(), m["severity"][hit].tolist())))

  def extent(self, robot: str) -> tuple[int, int]:
    """(most control steps, number) of the fault streams that score."""
    numbers = np.isin(self.meta["stream"], self.find(robot, "fault", "score"))
    return int(self.meta["steps"][numbers].max()), int(numbers.sum())

  def scored(self, robots: Collection[str] = ()) -> dict[int, int]:
    """{stream: control steps} of all that a file of scores must hold: nominal, fault and probe
    streams; all robots where none is named.
    """
    m = self.meta
    return {
      int(n): int(steps)
      for n, steps, kind, full, robot in zip(
        m["stream"], m["steps"], m["kind"], m["full"], m["robot"]
      )
      if kind != "past" and full and (not robots or robot in robots)
    }

  def _load(self, robot: str) -> dict:
    if robot not in self._rows:
      self._rows.clear()  # one robot at a time: a set may be larger than the memory
      rows = tables.read_table(self.folder / f"{robot}.parquet")
      if set(rows) != set(SCHEMA):
        raise FileError(
          f"{self.folder / f'{robot}.parquet'} is not of this schema: it has {', '.join(rows)}"
        )
      latents = tables.read_table(self.folder / f"{robot}_latents.parquet")
      starts = lambda t: dict(zip(*np.unique(t["stream"], return_index=True)))
      ends = lambda t: dict(zip(*np.unique(t["stream"], return_counts=True)))
      self._rows[robot] = {
        "rows": rows,
        "at": starts(rows),
        "n": ends(rows),
        "latents": latents,
        "lat": starts(latents),
        "latn": ends(latents),
      }
    return self._rows[robot]

  def _fill(
    self,
    robot: str,
    number: int,
    limit: int,
    out: dict[str, np.ndarray],
    z: np.ndarray | None,
    column: int,
  ) -> None:
    """Writes the rows of stream `number` before step `limit` into column `column` of the arrays,
    its past first.
    """
    m = self.meta
    at = int(np.flatnonzero(m["stream"] == number)[0])
    held = self._load(robot)
    if m["prefix"][at] is not None and np.isfinite(m["prefix"][at]):
      cut = m["onset"][at] if m["kind"][at] == "fault" else m["steps"][at]
      self._fill(robot, int(m["prefix"][at]), min(limit, int(cut)), out, z, column)
    for rows, first, count, into in (
      (held["rows"], held["at"], held["n"], out),
      (held["latents"], held["lat"], held["latn"], None),
    ):
      if number not in first:
        continue
      own = slice(first[number], first[number] + count[number])
      step = rows["step"][own]
      keep = step < limit
      if into is not None:
        for name, array in into.items():
          array[step[keep], column] = rows[name][own][keep]
      elif z is not None:
        z[step[keep], column] = np.stack([rows[f"z{k}"][own][keep] for k in range(LATENT)], -1)

  def get(self, robot: str, numbers: Sequence[int] | np.ndarray) -> Streams:
    """Streams of one robot, the shorter ones filled up with unknown values to the longest."""
    m = self.meta
    at = [int(np.flatnonzero(m["stream"] == n)[0]) for n in numbers]
    if not at:
      raise UserError(
        f"no such stream of robot {robot!r}; robots of this set: {', '.join(self.robots)}"
      )
    steps = int(max(m["steps"][at]))
    shape = (steps, len(at))
    out = {c: np.full(shape, np.nan, np.float32) for c in COLUMNS} | {
      "episode": np.zeros(shape, np.int16),
      "terminated": np.zeros(shape, bool),
    }
    z = np.full(shape + (LATENT,), np.nan, np.float32)
    for column, number in enumerate(numbers):
      self._fill(robot, int(number), int(m["steps"][at[column]]), out, z, column)
    groups = np.stack([x for name, x in out.items() if name.startswith("group_")], -1)
    valid = np.isfinite(out["opr"])
    none = np.zeros(shape + (0,), np.float32)
    residual = Residual(
      out["opr"],
      out["rpr"],
      none,  # type: ignore[arg-type]
      valid,
      groups,  # type: ignore[arg-type]
      out["reward"],
      out["terminated"],
      out["surprise"],
      z,  # type: ignore[arg-type]
    )
    onset = np.where(
      m["kind"][at] == "fault", np.nan_to_num(m["onset"][at].astype(float), nan=steps), steps
    ).astype(int)
    return Streams(
      residual,
      out["episode"],
      m["stream"][at].astype(int),
      m["seed"][at].astype(int),
      onset,
      m["fault"][at].tolist(),
      m["target"][at].tolist(),
      m["severity"][at].astype(float),
      float(m["control_s"][at[0]]),
    )


class Data(NamedTuple):
  """The streams of one robot. tune, score: healthy ones of either split. fault: of the seeds that
  score; its labels are per stream.
  """

  robot: str
  tune: Streams
  score: Streams
  fault: Streams
  count_from: int
  arl0: float
  horizon_s: float

  @property
  def horizon(self) -> int:
    """Control steps after an onset in which an alarm counts."""
    return metrics.steps_in(self.horizon_s, self.fault.control_s)

  def own(self, key: tuple[str, float]) -> np.ndarray:
    """Columns of `fault` with this fault and severity, seed by seed as in `score`."""
    return np.flatnonzero(
      [f == key[0] and s == key[1] for f, s in zip(self.fault.fault, self.fault.severity)]
    )
