"""Recorded residual streams: a suite (TOML) -> Parquet that pandas alone reads -> arrays that detectors are scored on. Schema: `SCHEMA`, `META`.

A set is a folder: `streams.parquet` (one row per stream, `META`), ROBOT.parquet (one row per stream and control step, `SCHEMA`),
ROBOT_latents.parquet (stream, step, z0..z15, where they were kept) and config.json. A fault stream shares its past with the healthy robot of the
same seed: rows before its onset are those of the stream `prefix`, and stand there alone. `StreamSet` joins them; so does, in pandas,
  own = rows[rows.stream == s]; past = rows[(rows.stream == prefix) & (rows.step < onset)]; pandas.concat([past, own])
Values are rounded to powers of two near a quarter of the deviation on healthy robots (half for groups and latents), of the logarithm where they cannot
be negative: a column's variance grows by 0.5 % (2 %), the files shrink to a third. config.json holds the steps.
"""
from __future__ import annotations

import dataclasses
import json
import pathlib
import tomllib
import zlib
from typing import NamedTuple

import numpy as np

from mjx_cl import store
from mjx_cl.errors import FileError, UserError

VERSION = 1
HERE = pathlib.Path(__file__).parent
SUITES, RECORDINGS = HERE / "suites", HERE / "recordings"
GROUPS, LATENT = 8, 16
CHUNK = 64
COLUMNS = ("opr", "rpr", "reward", "surprise") + tuple(f"group_{k}" for k in range(GROUPS))
SCHEMA = {
    "stream": "int32, number of the stream", "step": "int32, control step since the stream began", "episode": "int16, episode of the stream",
    "terminated": "bool, the episode ended in this step", "opr": "float32, observation residual, null where its window was cut",
    "rpr": "float32, reward residual, as opr", "reward": "float32, of arriving", "surprise": "float32, KL(posterior || prior) [nats]",
    **{f"group_{k}": "float32, mean residual of a part of the observation, in typical deviations; its name is in streams.parquet, `groups`"
       for k in range(GROUPS)}}
META = {
    "stream": "int32", "robot": "string", "kind": "nominal, fault, past (the healthy robot that fault streams of its seed share their past with) or probe (a stream cut off at `steps`, "
            "for the test of causality)",
    "split": "score or tune", "seed": "int32", "fault": "string, null for nominal", "target": "string, null for nominal", "severity": "float64",
    "onset": "int32, first control step that the fault acts in, null for nominal", "steps": "int32, length with its past",
    "prefix": "int32, stream that holds the rows before `onset`, null: none", "full": "bool, false: opr and rpr alone were kept",
    "control_s": "float64, control period", "groups": "string, names of the eight parts, comma-separated"}


# ---- suites --------------------------------------------------------------------------------------------------------------------------

@dataclasses.dataclass(frozen=True)
class Suite:
  """What is recorded and how it is scored; read from TOML.

  Attributes:
    name, arl0 [control steps], count_from [control steps], onset (low, high) [control steps], horizon_s: as in suites/leaderboard.toml.
    seeds: split -> (first, last). nominal: steps, and split -> streams per seed. latents: nominal (streams), after_s.
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

  def __post_init__(self):
    def need(holds, text):
      if not holds:
        raise UserError(f"suite {self.name!r}: {text}")
    need(self.arl0 > 0 and self.horizon_s > 0, "arl0 and horizon_s must be above 0")
    need(len(self.onset) == 2 and 0 <= self.count_from <= self.onset[0] < self.onset[1], "onset must be [low, high] with count_from <= low < high")
    for table, keys in (("seeds", {"score", "tune"}), ("nominal", {"steps", "score", "tune"}), ("latents", {"nominal", "after_s"})):
      need(set(getattr(self, table)) == keys, f"[{table}] needs {', '.join(sorted(keys))}")
    need(self.nominal["steps"] > self.count_from, "nominal steps must exceed count_from")
    (a, b), (c, d) = (self.seeds[s] for s in ("score", "tune"))
    need(a <= b and c <= d and (b < c or d < a), "the seeds that score and the seeds that tune must be two ranges without a common seed")
    need(bool(self.robots), "no [robots.NAME]")
    for robot, splits in self.robots.items():
      need(set(splits) <= {"score", "tune"} and splits.get("score"), f"robot {robot!r} needs a table `score`, and may have `tune`")
      both = {k.split(":")[0] for k in splits["score"]} & {k.split(":")[0] for k in splits.get("tune", {})}
      need(not both, f"robot {robot!r}: {', '.join(sorted(both))} is to tune and to score; take different faults")
      for key, severities in ((k, v) for s in splits.values() for k, v in s.items()):
        need(bool(severities) and all(isinstance(x, (int, float)) and 0 < x <= 1 for x in severities), f"robot {robot!r}, {key}: severities in (0, 1]")

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


def suite(name: str) -> Suite:
  """A suite by name (`mjx-cl list suites`) or from a TOML file.

  Raises:
    UserError for an unknown name or a value out of range; FileError for a file that is no TOML.
  """
  path = SUITES / f"{name}.toml"
  if not path.exists():
    path = pathlib.Path(name)
    if path.suffix != ".toml":
      raise UserError(f"unknown suite {name!r}; choose from: {', '.join(sorted(p.stem for p in SUITES.glob('*.toml')))}; or give a .toml file")
  try:
    data = tomllib.loads(path.read_text())
  except OSError as e:
    raise FileError(f"cannot read {path}: {e.strerror}") from None
  except ValueError as e:
    raise FileError(f"{path} is no TOML: {e}") from None
  fields = {f.name for f in dataclasses.fields(Suite)}
  if set(data) != fields:
    wrong = [f"unknown {k!r}" for k in sorted(set(data) - fields)] + [f"missing {k!r}" for k in sorted(fields - set(data))]
    raise UserError(f"suite {path.name}: {', '.join(wrong)}; it takes: {', '.join(sorted(fields))}")
  try:
    return Suite(**data | {"onset": tuple(data["onset"]), "seeds": {k: tuple(v) for k, v in data["seeds"].items()}})
  except (TypeError, AttributeError, ValueError) as e:
    raise UserError(f"suite {path.name}: a value of the wrong kind ({e})") from None


def about() -> dict[str, str]:
  """Name -> what a shipped suite holds, in one line."""
  out = {}
  for path in sorted(SUITES.glob("*.toml")):
    s = suite(path.stem)
    out[s.name] = ", ".join(f"{r}: {sum(map(len, t['score'].values()))} faults that score, {sum(map(len, t.get('tune', {}).values()))} that tune"
                            for r, t in s.robots.items())
  return out


# ---- reading -------------------------------------------------------------------------------------------------------------------------

class Streams(NamedTuple):
  """Streams side by side, time-major NumPy arrays; unknown values are nan.

  Attributes:
    residual: monitor.Residual with leading (T, S); `variables` is empty. episode: int16 (T, S).
    stream, seed, onset: int (S,); onset is T for a healthy stream. fault, target: lists of S. severity: float (S,). control_s: [s].
  """
  residual: object
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

  def __init__(self, folder=None):
    self.folder = pathlib.Path(folder) if folder else RECORDINGS / "leaderboard"
    try:
      self.config = json.loads((self.folder / "config.json").read_text())
    except (OSError, ValueError):
      raise FileError(f"{self.folder} holds no recorded streams (no readable config.json); make some with `mjx-cl record`") from None
    if self.config.get("version") != VERSION:
      raise FileError(f"{self.folder}: streams of version {self.config.get('version')}, this release reads version {VERSION}; record them anew")
    self.suite = Suite(**self.config["suite"] | {k: tuple(self.config["suite"][k]) for k in ("onset",)}
                       | {"seeds": {k: tuple(v) for k, v in self.config["suite"]["seeds"].items()}})
    self.meta = store.read_table(self.folder / "streams.parquet")
    if set(self.meta) != set(META):
      raise FileError(f"{self.folder / 'streams.parquet'} is not of this schema: it has {', '.join(self.meta)}")
    self._rows: dict[str, dict] = {}

  @property
  def robots(self) -> list[str]:
    return list(dict.fromkeys(self.meta["robot"].tolist()))

  def choose(self, robots=()) -> list[str]:
    """These robots, each once; all where none is named. UserError for one that the set lacks."""
    for robot in robots:
      if robot not in self.robots:
        raise UserError(f"this set has no robot {robot!r}; choose from: {', '.join(self.robots)}")
    return list(dict.fromkeys(robots)) or self.robots

  def find(self, robot: str, kind: str, split: str | None = None, fault: str | None = None, severity: float | None = None) -> np.ndarray:
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

  def scored(self, robots=()) -> dict[int, int]:
    """{stream: control steps} of all that a file of scores must hold: nominal, fault and probe streams; all robots where none is named."""
    m = self.meta
    return {int(n): int(steps) for n, steps, kind, full, robot in zip(m["stream"], m["steps"], m["kind"], m["full"], m["robot"])
            if kind != "past" and full and (not robots or robot in robots)}

  def _load(self, robot: str) -> dict:
    if robot not in self._rows:
      self._rows.clear()  # one robot at a time: a set may be larger than the memory
      rows = store.read_table(self.folder / f"{robot}.parquet")
      latents = store.read_table(self.folder / f"{robot}_latents.parquet")
      starts = lambda t: dict(zip(*np.unique(t["stream"], return_index=True)))
      ends = lambda t: dict(zip(*np.unique(t["stream"], return_counts=True)))
      self._rows[robot] = {"rows": rows, "at": starts(rows), "n": ends(rows), "latents": latents, "lat": starts(latents), "latn": ends(latents)}
    return self._rows[robot]

  def _fill(self, robot, number, limit, out, z, column):
    """Writes the rows of stream `number` before step `limit` into column `column` of the arrays, its past first."""
    m = self.meta
    at = int(np.flatnonzero(m["stream"] == number)[0])
    held = self._load(robot)
    if m["prefix"][at] is not None and np.isfinite(m["prefix"][at]):
      cut = m["onset"][at] if m["kind"][at] == "fault" else m["steps"][at]
      self._fill(robot, int(m["prefix"][at]), min(limit, int(cut)), out, z, column)
    for rows, first, count, into in ((held["rows"], held["at"], held["n"], out), (held["latents"], held["lat"], held["latn"], None)):
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

  def get(self, robot: str, numbers) -> Streams:
    """Streams of one robot, the shorter ones filled up with unknown values to the longest."""
    from mjx_cl.monitor import Residual
    m = self.meta
    at = [int(np.flatnonzero(m["stream"] == n)[0]) for n in numbers]
    if not at:
      raise UserError(f"no such stream of robot {robot!r}; robots of this set: {', '.join(self.robots)}")
    steps = int(max(m["steps"][at]))
    shape = (steps, len(at))
    out = {c: np.full(shape, np.nan, np.float32) for c in COLUMNS} | {"episode": np.zeros(shape, np.int16), "terminated": np.zeros(shape, bool)}
    z = np.full(shape + (LATENT,), np.nan, np.float32)
    for column, number in enumerate(numbers):
      self._fill(robot, int(number), int(m["steps"][at[column]]), out, z, column)
    groups = np.stack([out[f"group_{k}"] for k in range(GROUPS)], -1)
    valid = np.isfinite(out["opr"])
    residual = Residual(out["opr"], out["rpr"], np.zeros(shape + (0,), np.float32), valid, groups, out["reward"], out["terminated"], out["surprise"], z)
    onset = np.where(m["kind"][at] == "fault", np.nan_to_num(m["onset"][at].astype(float), nan=steps), steps).astype(int)
    return Streams(residual, out["episode"], m["stream"][at].astype(int), m["seed"][at].astype(int), onset, m["fault"][at].tolist(),
                   m["target"][at].tolist(), m["severity"][at].astype(float), float(m["control_s"][at[0]]))


# ---- recording -----------------------------------------------------------------------------------------------------------------------

class Lane(NamedTuple):
  """One robot of a recording. fault None: healthy."""
  seed: int
  fault: str | None = None
  target: str | None = None
  severity: float = 0.0
  full: bool = True


def lanes(suite_: Suite, robot: str, split: str) -> list[Lane]:
  """The robots of one fault recording: every seed healthy first, then every fault, severity and seed. The split `tune` repeats the faults that
  score on seeds that do not, for oracles that must be fitted; of those OPR and RPR alone are kept."""
  seeds, tables = suite_.numbers(split), suite_.robots[robot]
  out = [Lane(seed) for seed in seeds]
  for source in ("score", "tune"):
    if split == "score" and source == "tune":
      continue
    for key, severities in tables.get(source, {}).items():
      fault, _, target = key.partition(":")
      out += [Lane(seed, fault, target or None, float(s), source == split) for s in severities for seed in seeds]
  return out


def _record(env, trained, lanes_: list[Lane], keys, onsets, steps: int, watch_from: int, progress) -> dict[str, np.ndarray]:
  """Lives `steps` control steps of every lane; the monitor looks at healthy lanes all the time, at the others from `watch_from` on.

  Returns:
    COLUMNS float32 (steps, S), nan where unknown; episode int16, terminated bool (steps, S); latent float16 (steps, S, 16); target (S,) names.
  """
  import jax
  import jax.numpy as jnp
  from mjx_cl import faults as faults_lib
  from mjx_cl.monitor import Monitor
  from mjx_cl.rollout import Rollout, nest, start
  names = list(dict.fromkeys(lane.fault for lane in lanes_ if lane.fault))
  faults = tuple(faults_lib.make(n, env) for n in names) or (faults_lib.none(env),)
  severity, target = np.zeros((len(lanes_), len(faults)), np.float32), np.zeros((len(lanes_), len(faults)), np.int32)
  drawn: list[str | None] = []
  for i, lane in enumerate(lanes_):
    drawn.append(None)
    if lane.fault:
      k = names.index(lane.fault)
      at = faults_lib.target_index(faults[k], lane.target)
      if at < 0:  # from seed and name alone: a fault more in the suite changes no other's target
        at = int(np.random.default_rng([lane.seed, zlib.crc32(lane.fault.encode())]).integers(faults[k].drawn))
      severity[i, k], target[i, k], drawn[-1] = lane.severity, at, faults[k].targets[at]
  agent = trained.agent
  rollout, monitor = Rollout(env, agent, faults), Monitor(agent, spec=env.spec)
  plans = jax.vmap(lambda s, o: faults_lib.plan(s, jnp.broadcast_to(o, s.shape), jnp.full(s.shape, faults_lib.FOREVER)))(
      jnp.asarray(severity), jnp.asarray(onsets, jnp.int32))
  begin = lambda k, p, t: start(env, agent, faults, k, target=t, plan=p)
  state = nest(begin, 0, 0)(keys[None], jax.tree.map(lambda x: x[None], plans), jnp.asarray(target)[None])
  params = jax.tree.map(lambda x: x[None], trained.train.params)
  healthy = sum(lane.fault is None for lane in lanes_)
  watch, remember = jax.jit(monitor.update), jax.jit(monitor.remember)
  history = monitor.init(1, len(lanes_))
  out: dict[str, list] = {c: [] for c in COLUMNS + ("episode", "terminated", "latent")}
  for chunk in range(-(-steps // CHUNK)):
    state, rows = rollout.chunk(params, state, CHUNK)
    everyone = (chunk + 1) * CHUNK > watch_from
    take = (lambda x: x) if everyone else (lambda x: x[:, :, :healthy])
    _, seen = watch(params, jax.tree.map(take, history), jax.tree.map(take, rows), jax.random.split(jax.random.fold_in(keys[0], chunk), 1))
    history = remember(history, rows)
    seen = jax.tree.map(lambda x: np.asarray(x)[:, 0], seen)
    wide = lambda x: x if everyone else np.concatenate([x, np.full((CHUNK, len(lanes_) - healthy) + x.shape[2:], np.nan, np.float32)], 1)
    for k, name in enumerate(COLUMNS):
      out[name].append(wide(seen.groups[..., k - 4] if name.startswith("group_") else getattr(seen, name)))
    out["latent"].append(wide(seen.latent).astype(np.float16))
    out["episode"].append(np.asarray(rows.episode)[:, 0].astype(np.int16))
    out["terminated"].append(np.asarray(rows.terminated)[:, 0])
    progress(min(steps, (chunk + 1) * CHUNK), steps, len(lanes_))
  return {k: np.concatenate(v)[:steps] for k, v in out.items()} | {"target": np.asarray([t or "" for t in drawn])}


def record(suite_: Suite, out, robots=(), physics: str = "auto", agent: str | None = None, command: str = "", progress=lambda part, done, steps, lanes: None) -> dict:
  """Records a suite into the folder `out`; parts that are finished already are kept, so a recording that was cut off goes on.

  Returns:
    {robot: stream-steps per second of its parts}, plus the size of the files.
  """
  import time
  from mjx_cl import agents, envs
  from mjx_cl.monitor import watched
  from mjx_cl.record import stream_keys
  import jax
  out = pathlib.Path(out)
  work = out / "work"
  work.mkdir(parents=True, exist_ok=True)
  chosen = list(robots) or list(suite_.robots)
  for robot in chosen:
    if robot not in suite_.robots:
      raise UserError(f"suite {suite_.name!r} has no robot {robot!r}; choose from: {', '.join(suite_.robots)}")
  meta: dict[str, list] = {k: [] for k in META}
  steps_of, speed, details = {}, {}, {}
  for robot in chosen:
    env = envs.make(robot, physics)
    trained = agents.load(agent, robot, len(env.spec.obs), len(env.spec.act))
    if int(trained.card.get("repeat", 1)) != 1:
      raise UserError(f"the agent of {robot!r} holds its actions; streams are recorded with agents that act in every control step")
    parts, seconds, lived = {}, 0.0, 0
    for split in ("score", "tune"):
      seeds = suite_.numbers(split)
      for kind in ("nominal", "fault"):
        if kind == "nominal":
          each = suite_.nominal[split]
          who = [Lane(s) for s in seeds for _ in range(each)]
          keys = stream_keys(seeds, each + 1)[np.flatnonzero(np.arange(len(seeds) * (each + 1)) % (each + 1))]  # the first belongs to the faults
          onsets, steps, watch = np.zeros(len(who), int), suite_.nominal["steps"], 0
        else:
          who = lanes(suite_, robot, split)
          keys = jax.numpy.stack([jax.random.key(lane.seed) for lane in who])
          onsets = np.asarray([suite_.onset_of(lane.seed) for lane in who])
          steps, watch = int(onsets.max()) + suite_.after(env.spec.control_s), int(onsets.min())
        path, tag = work / f"{robot}-{split}-{kind}.npz", json.dumps([[list(lane) for lane in who], steps, trained.card.get("updates"), VERSION])
        data = _part(path, tag)
        if data is None:
          begin = time.monotonic()
          data = _record(env, trained, who, keys, onsets, steps, watch, lambda *a, part=f"{robot} {split} {kind}": progress(part, *a))
          seconds, lived = seconds + time.monotonic() - begin, lived + steps * len(who)
          store.atomic(path, lambda f, data=data, tag=tag: np.savez(f, tag=np.asarray(tag), **data))
        parts[split, kind] = (who, onsets, data)
    groups = ",".join(name for name, _ in watched(env.spec))
    details[robot] = _write(suite_, out, robot, parts, meta, env.spec.control_s, groups)
    steps_of[robot] = int(sum(x[2]["opr"].size for x in parts.values()))
    speed[robot] = lived / seconds if seconds else None
  types = {"stream": np.int32, "seed": np.int32, "severity": float, "steps": np.int32, "full": bool, "control_s": float}
  store.write_table(out / "streams.parquet", {k: np.asarray(v, types[k]) if k in types else v for k, v in meta.items()})
  plain = {f.name: getattr(suite_, f.name) for f in dataclasses.fields(Suite)} | {"robots": {r: suite_.robots[r] for r in chosen}}
  store.write_json(out / "config.json", {"version": VERSION, "suite": plain, "command": command, "schema": SCHEMA, "meta": META, "details": details,
                                        "stream_steps": steps_of, **store.provenance()})
  size = sum(p.stat().st_size for p in out.glob("*.parquet"))
  return {"stream_steps_per_s": speed, "stream_steps": steps_of, "bytes": size}


def _part(path: pathlib.Path, tag: str) -> dict | None:
  """What an earlier recording left, None where it is of something else or broken."""
  try:
    with np.load(path, allow_pickle=False) as z:
      if str(z["tag"]) != tag:
        return None
      return {k: z[k] for k in z.files if k != "tag"}
  except (OSError, ValueError, KeyError, EOFError):
    return None
  except Exception as e:  # zipfile's own errors for a truncated file
    if type(e).__module__ in ("zipfile", "zlib"):
      return None
    raise


def _write(suite_, out, robot, parts, meta, control_s, groups) -> dict:
  """Writes ROBOT.parquet and ROBOT_latents.parquet and adds to `meta`. Returns the rounding steps."""
  grain = _grain(parts["tune", "nominal"][2])
  rows: dict[str, list] = {k: [] for k in SCHEMA}
  latents: dict[str, list] = {k: [] for k in ("stream", "step") + tuple(f"z{k}" for k in range(LATENT))}
  number = int(meta["stream"][-1]) + 1 if meta["stream"] else 0

  def add_meta(**values):
    for k in META:
      meta[k].append(values.get(k))

  def add_rows(stream, data, lane, first, last, columns):
    at = slice(first, last)
    rows["stream"].append(np.full(last - first, stream, np.int32))
    rows["step"].append(np.arange(first, last, dtype=np.int32))
    for k in ("episode", "terminated"):
      rows[k].append(data[k][at, lane])
    for k in COLUMNS:
      rows[k].append(rounded(data[k][at, lane], k, grain) if k in columns else np.full(last - first, np.nan, np.float32))

  def add_latents(stream, data, lane, first, last):
    latents["stream"].append(np.full(last - first, stream, np.int32))
    latents["step"].append(np.arange(first, last, dtype=np.int32))
    for k in range(LATENT):
      latents[f"z{k}"].append(rounded(data["latent"][first:last, lane, k].astype(np.float32), f"z{k}", grain))

  for split in ("score", "tune"):
    common = dict(robot=robot, split=split, control_s=control_s, groups=groups)
    who, _, data = parts[split, "nominal"]
    for i, lane in enumerate(who):
      add_meta(stream=number, kind="nominal", seed=lane.seed, severity=0.0, steps=len(data["opr"]), full=True, **common)
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
        add_meta(stream=number, kind="past", seed=lane.seed, severity=0.0, steps=end, full=True, **common)
        add_rows(number, data, i, 0, end, COLUMNS)
        add_latents(number, data, i, 0, int(onsets[i]))
      else:
        twin, j = past[lane.seed]
        for k in ("episode", "terminated"):  # the fault's own past, step for step, is that of its healthy twin
          if not np.array_equal(data[k][:onsets[i], i], data[k][:onsets[i], j]):
            raise FileError(f"{robot}, {lane.fault}, seed {lane.seed}: its past differs from that of the healthy robot of the same seed")
        add_meta(stream=number, kind="fault", seed=lane.seed, fault=lane.fault, target=str(data["target"][i]), severity=lane.severity,
                 onset=int(onsets[i]), steps=end, prefix=twin, full=lane.full, **common)
        add_rows(number, data, i, int(onsets[i]), end, COLUMNS if lane.full else ("opr", "rpr"))
        if lane.full:
          add_latents(number, data, i, int(onsets[i]), min(end, int(onsets[i]) + round(suite_.latents["after_s"] / control_s)))
      number += 1
    if split == "score":  # some streams again, cut off somewhere: a score that looks ahead betrays itself there
      rng = np.random.default_rng(zlib.crc32(robot.encode()))
      whole = [i for i in range(first, number) if meta["kind"][i] == "fault"]  # streams are numbered in the order of `meta`
      for source in rng.choice(whole, min(5, len(whole)), replace=False):
        at = int(source)
        cut = int(rng.integers(meta["onset"][at], meta["steps"][at]))
        add_meta(stream=number, kind="probe", seed=meta["seed"][at], severity=0.0, steps=cut, prefix=int(source), full=True, **common)
        number += 1
  table = {k: np.concatenate(v) for k, v in rows.items()}
  store.write_table(out / f"{robot}.parquet", table, level=19, split=COLUMNS)
  store.write_table(out / f"{robot}_latents.parquet", {k: np.concatenate(v) for k, v in latents.items()}, level=19,
                    split=tuple(f"z{k}" for k in range(LATENT)))
  return {"rounding": {k: float(v) for k, v in grain.items()}}


def _grain(healthy: dict) -> dict[str, float]:
  """How each column is rounded, from healthy streams: relative steps (of residuals, groups and surprise) or absolute ones (reward, latents), powers of
  two near the deviation (of the logarithm; absolute) divided by FINENESS."""
  grain = {}
  for name in COLUMNS + tuple(f"z{k}" for k in range(LATENT)):
    x = healthy["latent"][..., int(name[1:])] if name[0] == "z" else healthy[name]
    x = x[np.isfinite(x)].astype(np.float64)
    wide = float(np.std(x if absolute(name) else np.log(np.maximum(x, FLOOR))))
    grain[name] = 2.0 ** min(-1.0 if not absolute(name) else np.inf, np.round(np.log2(max(wide, 1e-9) / FINENESS["latent" if name[0] == "z" else name.split("_")[0]])))
  return grain


FLOOR = 1e-6  # residuals below are taken as this before the logarithm
FINENESS = {"opr": 4, "rpr": 4, "reward": 4, "surprise": 4, "group": 2, "latent": 2}


def absolute(name: str) -> bool:
  """Whether a column is rounded to absolute steps; the others may not be negative and are rounded to relative ones."""
  return name == "reward" or name[0] == "z"


def rounded(x: np.ndarray, name: str, grain: dict[str, float]) -> np.ndarray:
  """`x` on the grid of its column, float32 whose low mantissa bits are zero, which is what makes the files small; nan stays nan."""
  x = x.astype(np.float32)
  if absolute(name):
    return (np.round(x.astype(np.float64) / grain[name]) * grain[name]).astype(np.float32)
  drop = 23 + int(np.log2(grain[name]))
  bits = np.maximum(x, np.float32(FLOOR)).view(np.uint32).astype(np.uint64)
  return np.where(np.isfinite(x), (((bits + (1 << (drop - 1))) >> drop) << drop).astype(np.uint32).view(np.float32), np.nan).astype(np.float32)
