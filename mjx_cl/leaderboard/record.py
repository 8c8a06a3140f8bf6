"""Recording of a suite: healthy and faulty robots of all seeds in one batched program per robot and
split, written as streams.py describes.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import json
import os
import pathlib
import shutil
import time
import zlib
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import envs
from mjx_cl import faults as faults_lib
from mjx_cl.config import CHUNK
from mjx_cl.detectors.combine import read
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import arrays, folders, runtime
from mjx_cl.io import tables as store
from mjx_cl.keys import OfSeed
from mjx_cl.leaderboard.streams import COLUMNS, LATENT, META, SCHEMA, VERSION, Suite
from mjx_cl.rollout.monitor import Monitor, watched
from mjx_cl.rollout.scan import Rollout, nest, start, stream_keys
from mjx_cl.training import agents

if TYPE_CHECKING:
  from collections.abc import Callable, Collection, Iterable
  from typing import Any

  from mjx_cl.rollout.monitor import History
  from mjx_cl.rollout.scan import Row

TILE = 16  # lanes are filled up to a multiple of it
MADE = (
  "command",
  "versions",
  "python",
  "git_commit",
  "machine",
)  # of config.json: how a set was made
HELD = "held.json"  # config.json of the set whose files are being replaced


class Lane(NamedTuple):
  """One robot of a recording. fault None: healthy."""

  seed: int
  fault: str | None = None
  target: str | None = None
  severity: float = 0.0
  full: bool = True


def lanes(suite_: Suite, robot: str, split: str) -> list[Lane]:
  """The robots of one fault recording: every seed healthy first, then every fault, severity and
  seed. The split `tune` repeats the faults that score on seeds that do not, for oracles that must
  be fitted; of those OPR and RPR alone are kept. A fault's own noise is drawn by its place in the
  suite: new faults belong behind the others, which then live as before.
  """
  seeds, tables = suite_.numbers(split), suite_.robots[robot]
  out = [Lane(seed) for seed in seeds]
  for source in ("score", "tune"):
    if split == "score" and source == "tune":
      continue
    for key, severities in tables.get(source, {}).items():
      fault, _, target = key.partition(":")
      out += [
        Lane(seed, fault, target or None, float(s), source == split)
        for s in severities
        for seed in seeds
      ]
  return out


class Behind:
  """Calls of one function on a thread of its own, in order and at most one behind: a frozen agent
  acts without waiting for what is made of its last chunk.

  with Behind(function) as call: call(...)         an error of the function comes up at the next
    call, or at the end
  """

  _last: concurrent.futures.Future | None

  def __init__(self, function: Callable[..., Any]) -> None:
    self._function, self._pool, self._last = (
      function,
      concurrent.futures.ThreadPoolExecutor(1, "behind"),
      None,
    )

  def __enter__(self) -> Behind:
    return self

  def __call__(self, *args: Any) -> None:
    """Begins the next one once the last has ended."""
    if self._last is not None:
      self._last.result()
    self._last = self._pool.submit(self._function, *args)

  def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
    self._pool.shutdown()
    if kind is None and self._last is not None:
      self._last.result()


def _record(
  env: Any,
  trained: agents.Trained,
  lanes_: list[Lane],
  keys: jax.Array,
  onsets: np.ndarray,
  steps: int,
  watch_from: int,
  progress: Callable[[int, int, int], Any],
) -> dict[str, np.ndarray]:
  """Lives `steps` control steps of every lane; the monitor looks at healthy lanes all the time, at
  the others from `watch_from` on.

  Returns:
    COLUMNS float32 (steps, S), nan where unknown; episode int16, terminated bool (steps, S); latent
    float16 (steps, S, 16); target (S,) names.
  """
  names = list(dict.fromkeys(lane.fault for lane in lanes_ if lane.fault))
  faults = tuple(faults_lib.make(n, env) for n in names) or (faults_lib.none(env),)
  severity, target = (
    np.zeros((len(lanes_), len(faults)), np.float32),
    np.zeros((len(lanes_), len(faults)), np.int32),
  )
  drawn: list[str | None] = []
  for i, lane in enumerate(lanes_):
    drawn.append(None)
    if lane.fault:
      k = names.index(lane.fault)
      at = faults_lib.target_index(faults[k], lane.target)
      if at < 0:  # from seed and name alone: a fault more in the suite changes no other's target
        at = int(
          np.random.default_rng([lane.seed, zlib.crc32(lane.fault.encode())]).integers(
            faults[k].drawn
          )
        )
      severity[i, k], target[i, k], drawn[-1] = lane.severity, at, faults[k].targets[at]
  agent = trained.agent
  rollout, monitor = Rollout(env, agent, faults), Monitor(agent, spec=env.spec)
  plans = jax.vmap(
    lambda s, o: faults_lib.plan(
      s, jnp.broadcast_to(o, s.shape), jnp.full(s.shape, faults_lib.FOREVER)
    )
  )(jnp.asarray(severity), jnp.asarray(onsets, jnp.int32))
  begin = lambda k, p, t: start(env, agent, faults, k, target=t, plan=p)
  n = len(lanes_)
  fill = (
    np.arange(n + -n % TILE) % n
    # matrix products take the last rows of an odd batch in another order, and a lane's past must be
    # its twin's
  )
  state = nest(begin, 0, 0)(
    keys[None, fill], jax.tree.map(lambda x: x[None, fill], plans), jnp.asarray(target)[None, fill]
  )
  params = jax.tree.map(lambda x: x[None], trained.train.params)
  healthy = sum(lane.fault is None for lane in lanes_)
  watch, remember = jax.jit(monitor.update_each), jax.jit(monitor.remember)
  draws = jax.vmap(
    lambda key, chunk: jax.random.fold_in(jax.random.fold_in(key, OfSeed.WATCH), chunk), (0, None)
  )
  history = monitor.init(1, len(lanes_))
  out: dict[str, list] = {c: [] for c in COLUMNS + ("episode", "terminated", "latent")}

  def look(chunk: int, history: History, rows: Row) -> None:
    """One chunk, seen and stored."""
    everyone = (chunk + 1) * CHUNK > watch_from
    take = (lambda x: x) if everyone else (lambda x: x[:, :, :healthy])
    own = draws(keys if everyone else keys[:healthy], chunk)[None]
    _, seen = watch(params, jax.tree.map(take, history), jax.tree.map(take, rows), own)
    seen = jax.tree.map(lambda x: np.asarray(x)[:, 0], seen)
    wide = lambda x: (
      x
      if everyone
      else np.concatenate(
        [x, np.full((CHUNK, len(lanes_) - healthy) + x.shape[2:], np.nan, np.float32)], 1
      )
    )
    for name in COLUMNS:
      out[name].append(wide(read(name, seen)))
    out["latent"].append(wide(seen.latent).astype(np.float16))
    out["episode"].append(np.asarray(rows.episode)[:, 0].astype(np.int16))
    out["terminated"].append(np.asarray(rows.terminated)[:, 0])
    progress(min(steps, (chunk + 1) * CHUNK), steps, len(lanes_))

  with Behind(look) as looked:
    for chunk in range(-(-steps // CHUNK)):
      state, rows = rollout.chunk(params, state, CHUNK)
      rows = jax.tree.map(lambda x: x[:, :, :n], rows)
      looked(chunk, history, rows)
      history = remember(history, rows)
  return {k: np.concatenate(v)[:steps] for k, v in out.items()} | {
    "target": np.asarray([t or "" for t in drawn])
  }


def claim(
  suite_: Suite, out: pathlib.Path | str, overwrite: bool, robots: Collection[str] = ()
) -> None:
  """Makes sure that `out` may take a recording of the suite; with `overwrite` the set that it holds
  is removed, and no other file; where it has more than the `robots` named, and is of this very
  suite, it stays until theirs are recorded, see `record`.

  Raises:
    UserError for a folder that holds a set, or anything else than parts of one.
  """
  out = pathlib.Path(out)
  foreign = UserError(f"{out} is no folder of a recording; give another --out")
  if not out.exists():
    return
  if not out.is_dir():
    raise foreign
  known, held = set(suite_.robots), (out / "config.json").exists()
  if held:
    try:
      config = json.loads((out / "config.json").read_text())
      known |= set(config["suite"]["robots"])
      is_set = {"meta", "schema", "stream_steps"} <= set(config)
    except (OSError, ValueError, KeyError, TypeError):
      is_set = False
    if not is_set:
      raise foreign
    if not overwrite:
      raise UserError(
        f"{out} holds a recorded set; give --overwrite to replace it, or another --out"
      )
    if robots and set(config["suite"]["robots"]) - set(robots):
      beside(suite_, out, robots)
      return
  ours = {
    "config.json",
    "streams.parquet",
    *(f"{r}{end}.parquet" for r in known for end in ("", "_latents")),
  }
  if held:
    for name in sorted(ours):
      (out / name).unlink(missing_ok=True)
    clear(out)
  elif {p.name.removesuffix(".tmp") for p in out.iterdir()} - ours - {"work"} or _others(
    out / "work"
  ):
    raise foreign


def beside(suite_: Suite, out: pathlib.Path | str, robots: Collection[str]) -> dict | None:
  """config.json of the set in `out` that holds more than `robots`, whose other streams stay there;
  None where it holds no more, or is none.

  Raises:
    UserError where streams of `suite_` have no place in it.
  """
  out = pathlib.Path(out)
  for path in (
    out / "config.json",
    out / "work" / "set" / HELD,
  ):  # the latter: files were being moved into place when it was cut off
    try:
      config = store.read_json(path)
      break
    except FileError:
      continue
  else:
    return None
  held = config["suite"]["robots"]
  if not set(held) - set(robots):
    return None
  whole = json.loads(json.dumps(_plain(suite_, suite_.robots)))
  same = whole | {"robots": {r: whole["robots"].get(r) for r in held}}
  differ = (
    folders.differing(same, config["suite"])
    + [k for k in MADE if k not in config]
    + ["version"] * (config["version"] != VERSION)
    + [k for k in ("details", "stream_steps") if set(config.get(k, ())) != set(held)]
  )
  if differ:
    raise UserError(
      f"{out} holds a set of another suite (its {', '.join(differ)}), whose other robots' "
      "streams would be lost; give another --out, or "
      "record all robots"
    )
  return config


def _plain(suite_: Suite, robots: Iterable[str]) -> dict:
  """The suite as config.json has it, with these robots alone."""
  return {f.name: getattr(suite_, f.name) for f in dataclasses.fields(Suite)} | {
    "robots": {r: suite_.robots[r] for r in robots}
  }


def _others(work: pathlib.Path) -> list[pathlib.Path]:
  """What is no part of a recording."""
  staged = lambda p: (
    p.name == "set"
    and p.is_dir()
    and all(f.suffix in (".parquet", ".json", ".tmp") for f in p.iterdir())
  )
  return (
    [
      p
      for p in work.iterdir()
      if not p.name.removesuffix(".tmp").endswith(".npz") and not staged(p)
    ]
    if work.is_dir()
    else []
  )


def clear(out: pathlib.Path | str) -> None:
  """Removes the parts of a recording."""
  work = pathlib.Path(out) / "work"
  if work.is_dir() and not _others(work):
    shutil.rmtree(work)


def _publish(staged: pathlib.Path, out: pathlib.Path) -> None:
  """Moves a set's files into place. config.json, without which a folder holds no set, leaves first
  and comes last: no one reads old beside new.
  """
  if (out / "config.json").exists():
    os.replace(out / "config.json", staged / HELD)
  for p in sorted(staged.glob("*.parquet")):
    os.replace(p, out / p.name)
  os.replace(staged / "config.json", out / "config.json")


def prepare(
  suite_: Suite, robots: Collection[str], physics: str, agent: str | None
) -> dict[str, tuple]:
  """Robot -> (env, agents.Trained) of a recording; all robots of the suite where none is named.

  Raises:
    UserError, before hours are spent: an unknown robot, fault, target or agent, or an agent that
      does not act in every control step.
  """
  out = {}
  for robot in robots or suite_.robots:
    if robot not in suite_.robots:
      raise UserError(
        f"suite {suite_.name!r} has no robot {robot!r}; choose from: {', '.join(suite_.robots)}"
      )
    if ":" in robot:
      raise UserError(
        f"suite {suite_.name!r}: robot {robot!r} gives the recording's files their names; "
        "register it, in the entry-point group mjx_cl.envs"
      )
    env = envs.make(robot, physics)
    for key in (k for table in suite_.robots[robot].values() for k in table):
      fault, _, target = key.partition(":")
      faults_lib.target_index(faults_lib.make(fault, env), target or None)
    out[robot] = env, agents.of(env, agent)
    if int(out[robot][1].card.get("repeat", 1)) != 1:
      raise UserError(
        f"the agent of {robot!r} holds its actions; streams are recorded with agents that act "
        "in every control step"
      )
  return out


def record(
  suite_: Suite,
  out: pathlib.Path | str,
  robots: Collection[str] = (),
  physics: str = "auto",
  agent: str | None = None,
  command: str = "",
  progress: Callable[[str, int, int, int], Any] = lambda part, done, steps, lanes: None,
) -> dict:
  """Records a suite into the folder `out`; parts that are finished already are kept, so a recording
  that was cut off goes on.

  Where `robots` are named and `out` holds a set of this very suite, the streams of its other robots
  stay in it, with the numbers that they have; how they were recorded stands under `kept` of
  config.json then.

  Returns:
    {robot: stream-steps per second of its parts}, plus the size of the files.
  """
  out = pathlib.Path(out)
  work, staged = out / "work", out / "work" / "set"
  staged.mkdir(parents=True, exist_ok=True)
  for p in staged.iterdir():
    if p.name != HELD:
      p.unlink()
  ready = prepare(suite_, robots, physics, agent)
  old = beside(suite_, out, robots) if robots else None
  table = store.read_rows(out / "streams.parquet") if old else []
  kind_of = {row["stream"]: row["kind"] for row in table}
  table = [
    row for row in table if kind_of.get(row["prefix"]) != "nominal"
  ]  # probes of healthy streams are numbered anew, behind all others
  kept = {r: None for r in old["suite"]["robots"] if r not in robots} if old else {}
  rows, free = (
    [row for row in table if row["robot"] in kept],
    1 + max((row["stream"] for row in table), default=-1),
  )
  steps_of, speed, details, who_acts = {}, {}, {}, {}
  for robot, (env, trained) in ready.items():
    weights = _digest(trained.train.params)
    who_acts[robot] = {"name": pathlib.Path(trained.path).name, "crc32": weights}
    parts, seconds, lived = {}, 0.0, 0
    for split in ("score", "tune"):
      seeds = suite_.numbers(split)
      for kind in ("nominal", "fault"):
        if kind == "nominal":
          each = suite_.nominal[split]
          who = [Lane(s) for s in seeds for _ in range(each)]
          keys = stream_keys(seeds, each + 1)[
            np.flatnonzero(np.arange(len(seeds) * (each + 1)) % (each + 1))
          ]  # the first belongs to the faults
          onsets, steps, watch = np.zeros(len(who), int), suite_.nominal["steps"], 0
        else:
          who = lanes(suite_, robot, split)
          keys = jax.numpy.stack([jax.random.key(lane.seed) for lane in who])
          onsets = np.asarray([suite_.onset_of(lane.seed) for lane in who])
          steps, watch = int(onsets.max()) + suite_.after(env.spec.control_s), int(onsets.min())
        path, tag = (
          work / f"{robot}-{split}-{kind}.npz",
          json.dumps([[list(lane) for lane in who], steps, trained.card.get("updates"), VERSION]),
        )
        of = json.dumps(
          [onsets.tolist(), weights, runtime.default_physics() if physics == "auto" else physics]
        )
        data = _part(path, tag, of)
        if data is None:
          begin = time.monotonic()
          data = _record(
            env,
            trained,
            who,
            keys,
            onsets,
            steps,
            watch,
            lambda *a, part=f"{robot} {split} {kind}": progress(part, *a),
          )
          seconds, lived = seconds + time.monotonic() - begin, lived + steps * len(who)
          arrays.write(path, {"tag": tag, "of": of, **data})
        parts[split, kind] = (who, onsets, data)
    groups = ",".join(name for name, _ in watched(env.spec))
    number = min((row["stream"] for row in table if row["robot"] == robot), default=free)
    details[robot], fresh = _write(suite_, staged, robot, parts, number, env.spec.control_s, groups)
    rows, free = rows + fresh, max(free, number + len(fresh))
    steps_of[robot] = int(sum(x[2]["opr"].size for x in parts.values()))
    speed[robot] = lived / seconds if seconds else None
  write_meta(staged, rows + healthy_probes(rows))
  if old:
    made = {k: old[k] for k in MADE}
    kept = {r: old.get("kept", {}).get(r, made) for r in kept}
    tables = (("details", details), ("stream_steps", steps_of), ("agents", who_acts))
    details, steps_of, who_acts = (
      {r: old[name][r] for r in kept if r in old.get(name, ())} | new for name, new in tables
    )
  config = {
    "version": VERSION,
    "suite": _plain(suite_, [r for r in suite_.robots if r in {*ready, *kept}]),
    "command": command,
    "schema": SCHEMA,
    "meta": META,
    "agents": who_acts,
    "details": details,
    "stream_steps": steps_of,
    **runtime.provenance(),
  }
  store.write_json(staged / "config.json", config | ({"kept": kept} if kept else {}))
  _publish(staged, out)
  size = sum(p.stat().st_size for p in out.glob("*.parquet"))
  return {"stream_steps_per_s": speed, "stream_steps": steps_of, "bytes": size}


HEALTHY_PROBES = 2  # of each split of each robot


def healthy_probes(rows: list[dict]) -> list[dict]:
  """Rows of META for streams that are healthy ones cut off: a threshold rests on these streams
  alone, so a score may not look ahead in them either.

  They hold no rows of their own, and are numbered behind all others; which streams, and how long,
  follows from the robot's name.
  """
  out, number = [], 1 + max((row["stream"] for row in rows), default=-1)
  for robot in dict.fromkeys(row["robot"] for row in sorted(rows, key=lambda row: row["stream"])):
    for split in ("score", "tune"):
      whole = sorted(
        (
          row
          for row in rows
          if (row["robot"], row["split"], row["kind"]) == (robot, split, "nominal")
        ),
        key=lambda row: row["stream"],
      )
      rng = np.random.default_rng(zlib.crc32(f"{robot} {split}".encode()))
      for at in rng.choice(len(whole), min(HEALTHY_PROBES, len(whole)), replace=False):
        source = whole[int(at)]
        cut = int(rng.integers(source["steps"] // 4, source["steps"]))
        out.append(
          source | {"stream": number, "kind": "probe", "steps": cut, "prefix": source["stream"]}
        )
        number += 1
  return out


def write_meta(out: pathlib.Path | str, rows: list[dict]) -> None:
  """Writes streams.parquet, a row of META a stream, in the order of their numbers."""
  types = {
    "stream": np.int32,
    "seed": np.int32,
    "severity": float,
    "steps": np.int32,
    "full": bool,
    "control_s": float,
  }
  rows = sorted(rows, key=lambda row: row["stream"])
  columns = {k: [row[k] for row in rows] for k in META}
  store.write_table(
    pathlib.Path(out) / "streams.parquet",
    {k: np.asarray(v, types[k]) if k in types else v for k, v in columns.items()},
  )


def _digest(params: Any) -> int:
  """CRC-32 of an agent's weights, which tells agents apart; config.json of a set holds it for each
  robot's.
  """
  return zlib.crc32(b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(params)))


def _part(path: pathlib.Path, tag: str, of: str) -> dict | None:
  """What an earlier recording left, None where it is of something else or broken: tag, lanes and
  length; of, onsets, agent and physics.
  """
  try:
    part = arrays.read(path)
  except FileError:
    return None
  if str(part.pop("tag", None)) != tag or str(part.pop("of", of)) != of:
    return None
  return part


def _write(
  suite_: Suite,
  out: pathlib.Path,
  robot: str,
  parts: dict[tuple[str, str], tuple[list[Lane], np.ndarray, dict[str, np.ndarray]]],
  number: int,
  control_s: float,
  groups: str,
) -> tuple[dict, list[dict]]:
  """Writes ROBOT.parquet and ROBOT_latents.parquet, streams numbered from `number` on. Returns the
  rounding steps, and the streams' rows of META.
  """
  grain, differ = _grain(parts["tune", "nominal"][2]), 0
  rows: dict[str, list] = {k: [] for k in SCHEMA}
  latents: dict[str, list] = {
    k: [] for k in ("stream", "step") + tuple(f"z{k}" for k in range(LATENT))
  }
  meta, begin = [], number

  def add_meta(**values: Any) -> None:
    meta.append({k: values.get(k) for k in META})

  def add_rows(
    stream: int,
    data: dict[str, np.ndarray],
    lane: int,
    first: int,
    last: int,
    columns: tuple[str, ...],
  ) -> None:
    at = slice(first, last)
    rows["stream"].append(np.full(last - first, stream, np.int32))
    rows["step"].append(np.arange(first, last, dtype=np.int32))
    for k in ("episode", "terminated"):
      rows[k].append(data[k][at, lane])
    for k in COLUMNS:
      rows[k].append(
        rounded(data[k][at, lane], k, grain)
        if k in columns
        else np.full(last - first, np.nan, np.float32)
      )

  def add_latents(
    stream: int, data: dict[str, np.ndarray], lane: int, first: int, last: int
  ) -> None:
    latents["stream"].append(np.full(last - first, stream, np.int32))
    latents["step"].append(np.arange(first, last, dtype=np.int32))
    for k in range(LATENT):
      latents[f"z{k}"].append(
        rounded(data["latent"][first:last, lane, k].astype(np.float32), f"z{k}", grain)
      )

  for split in ("score", "tune"):
    common = dict(robot=robot, split=split, control_s=control_s, groups=groups)
    who, _, data = parts[split, "nominal"]
    for i, lane in enumerate(who):
      add_meta(
        stream=number,
        kind="nominal",
        seed=lane.seed,
        severity=0.0,
        steps=len(data["opr"]),
        full=True,
        **common,
      )
      add_rows(number, data, i, 0, len(data["opr"]), COLUMNS)
      if i < suite_.latents["nominal"]:
        add_latents(number, data, i, 0, len(data["opr"]))
      number += 1
    who, onsets, data = parts[split, "fault"]
    after, past, first = suite_.after(control_s), {}, number
    for i, lane in enumerate(who):
      end = int(onsets[i]) + after
      if lane.fault is None:
        past[lane.seed] = (number, i)
        add_meta(
          stream=number, kind="past", seed=lane.seed, severity=0.0, steps=end, full=True, **common
        )
        add_rows(number, data, i, 0, end, COLUMNS)
        add_latents(number, data, i, 0, int(onsets[i]))
      else:
        twin, j = past[lane.seed]
        for k in (
          "episode",
          "terminated",
        ):  # the fault's own past, step for step, is that of its healthy twin
          if not np.array_equal(data[k][: onsets[i], i], data[k][: onsets[i], j]):
            raise FileError(
              f"{robot}, {lane.fault}, seed {lane.seed}: its past differs from that of the "
              "healthy robot of the same seed"
            )
        seen = data["reward"][: onsets[i], i]
        differ += not np.array_equal(
          np.where(np.isnan(seen), 0, data["reward"][: onsets[i], j]), np.nan_to_num(seen)
        )
        add_meta(
          stream=number,
          kind="fault",
          seed=lane.seed,
          fault=lane.fault,
          target=str(data["target"][i]),
          severity=lane.severity,
          onset=int(onsets[i]),
          steps=end,
          prefix=twin,
          full=lane.full,
          **common,
        )
        add_rows(number, data, i, int(onsets[i]), end, COLUMNS if lane.full else ("opr", "rpr"))
        if lane.full:
          add_latents(
            number,
            data,
            i,
            int(onsets[i]),
            min(end, int(onsets[i]) + round(suite_.latents["after_s"] / control_s)),
          )
      number += 1
    if (
      split == "score"
    ):  # some streams again, cut off somewhere: a score that looks ahead betrays itself there
      rng = np.random.default_rng(zlib.crc32(robot.encode()))
      whole = [
        i for i in range(first - begin, number - begin) if meta[i]["kind"] == "fault"
      ]  # streams are numbered in the order of `meta`
      for at in rng.choice(whole, min(5, len(whole)), replace=False):
        source = meta[int(at)]
        cut = int(rng.integers(source["onset"], source["steps"]))  # type: ignore[arg-type]
        add_meta(
          stream=number,
          kind="probe",
          seed=source["seed"],
          severity=0.0,
          steps=cut,
          prefix=source["stream"],
          full=True,
          **common,
        )
        number += 1
  table = {k: np.concatenate(v) for k, v in rows.items()}
  how: dict[str, Any] = {
    "codec": "brotli",
    "level": 11 if len(table["step"]) < 2_000_000 else 5,
  }  # 11: 9 % smaller than zstd at its best; but half a MB a second
  store.write_table(out / f"{robot}.parquet", table, split=COLUMNS, **how)
  store.write_table(
    out / f"{robot}_latents.parquet",
    {k: np.concatenate(v) for k, v in latents.items()},
    **how,
    split=tuple(f"z{k}" for k in range(LATENT)),
  )
  return {
    "rounding": {k: float(v) for k, v in grain.items()},
    "pasts_that_differ": int(differ),
  }, meta  # in the last digits, hence later in all: should be 0


def _grain(healthy: dict) -> dict[str, float]:
  """How each column is rounded, from healthy streams: relative steps (of residuals, groups and
  surprise) or absolute ones (reward, latents), powers of two near the deviation (of the logarithm;
  absolute) divided by FINENESS.
  """
  grain = {}
  for name in COLUMNS + tuple(f"z{k}" for k in range(LATENT)):
    x = healthy["latent"][..., int(name[1:])] if name[0] == "z" else healthy[name]
    x = x[np.isfinite(x)].astype(np.float64)
    wide = float(np.std(x if absolute(name) else np.log(np.maximum(x, FLOOR)))) if len(x) else 0.0
    fineness = FINENESS["latent" if name[0] == "z" else name.split("_")[0]]
    grain[name] = 2.0 ** min(  # type: ignore[operator]
      -1.0 if not absolute(name) else np.inf, np.round(np.log2(max(wide, 1e-9) / fineness))
    )
  return grain


FLOOR = 1e-6  # residuals below are taken as this before the logarithm
FINENESS = {"opr": 4, "rpr": 4, "reward": 4, "surprise": 4, "group": 2, "latent": 2}


def absolute(name: str) -> bool:
  """Whether a column is rounded to absolute steps; the others may not be negative and are rounded
  to relative ones.
  """
  return name == "reward" or name[0] == "z"


def rounded(x: np.ndarray, name: str, grain: dict[str, float]) -> np.ndarray:
  """`x` on the grid of its column, float32 whose low mantissa bits are zero, which is what makes
  the files small; nan stays nan.
  """
  x = x.astype(np.float32)
  if absolute(name):
    return (np.round(x.astype(np.float64) / grain[name]) * grain[name]).astype(np.float32)
  drop = 23 + int(np.log2(grain[name]))
  x = np.maximum(x, np.float32(FLOOR))
  if drop < 1:  # a column that hardly varies
    return x
  bits = x.view(np.uint32).astype(np.uint64)
  return np.where(
    np.isfinite(x),
    (((bits + (1 << (drop - 1))) >> drop) << drop).astype(np.uint32).view(np.float32),
    np.nan,
  ).astype(np.float32)
