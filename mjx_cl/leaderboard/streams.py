"""Recorded residual streams: a suite (TOML) -> Parquet that pandas alone reads -> arrays that
detectors are scored on. Schema: `SCHEMA`, `META`.

A set is a folder: `streams.parquet` (one row per stream, `META`), ROBOT.parquet (one row per stream
and control step, `SCHEMA`), ROBOT_latents.parquet (stream, step, z0..z15, where they were kept),
from version 2 on ROBOT_innovations.parquet (stream, step, innovation_NAME of every variable and of
the reward, where the suite keeps them) and config.json. A fault stream shares its past with the
healthy robot of the same seed: rows before its onset are those of the stream `prefix`, and stand
there alone. `StreamSet` joins them; so does, in pandas,
  own = rows[rows.stream == s]; past = rows[(rows.stream == prefix) & (rows.step < onset)];
  pandas.concat([past, own])
Values are rounded to powers of two near a quarter of the deviation on healthy robots (half for
groups and latents, a whole one for innovations), of the logarithm where they cannot be negative: a
column's variance grows by 0.5 % (2 %, 8 %), the files shrink to a third. config.json holds the
steps.
"""

import pathlib
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_cl.errors import FileError, UserError
from mjx_cl.io import tables
from mjx_cl.leaderboard import suite as suites
from mjx_cl.leaderboard.suite import about as about
from mjx_cl.leaderboard.suite import suite as suite
from mjx_cl.rollout.monitor import CHANNELS, LATENT, Residual
from mjx_cl.scoring import metrics

VERSION, READ = 2, (1, 2)  # as written, and what can be read
RECORDINGS = pathlib.Path(__file__).parent / "recordings"
COLUMNS = tuple(CHANNELS)
SIGNED = "innovation_"  # and the name of the variable
PROJECTION = tuple(f"z{k}" for k in range(LATENT))  # of the latent
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
LATENTS = {name: SCHEMA[name] for name in ("stream", "step")} | {
  name: "float32" for name in PROJECTION
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


def _holds(values: np.ndarray, said: str) -> bool:
  """Whether a column holds what its line in SCHEMA or META says."""
  kind, known = said.partition(",")[0], values
  if "null" in said:
    known = values[np.array([x is not None and x == x for x in values.tolist()], bool)]
    if not len(known):
      return True
  if kind == "bool":
    return known.dtype.kind == "b"
  if kind.startswith("float"):
    return known.dtype.kind in "fiu"
  if kind.startswith("int"):
    low, high = np.iinfo(kind).min, np.iinfo(kind).max
    numbers = known.dtype.kind in "fiu" and np.isfinite(known).all()
    return bool(numbers and (known >= low).all() and (known <= high).all())
  return all(isinstance(x, str) for x in known.tolist())


class Streams(NamedTuple):
  """Streams side by side, time-major NumPy arrays; unknown values are nan.

  Attributes:
    residual: monitor.Residual with leading (T, S); `variables` is empty, `innovation` None where it
      was not asked for.
    episode: int16 (T, S).
    stream: number, int (S,).
    seed: int (S,).
    onset: int (S,), T for a healthy stream.
    fault: names or None, of S.
    target: names or None, of S.
    severity: float (S,).
    control_s: control period [s].
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


class Rows:
  """A table whose rows lie stream by stream."""

  def __init__(self, columns: dict[str, np.ndarray]) -> None:
    self.columns = columns
    numbers = np.unique(self.columns["stream"], return_index=True, return_counts=True)
    self.at = {n: slice(first, first + count) for n, first, count in zip(*numbers)}

  def put(self, number: int, limit: int, column: int, out: dict[str, np.ndarray]) -> None:
    """Writes the rows of stream `number` before step `limit` into column `column` of arrays by
    name.
    """
    own = self.at.get(number, slice(0, 0))
    step = self.columns["step"][own]
    keep = step < limit
    for name, array in out.items():
      array[step[keep], column] = self.columns[name][own][keep]


class StreamSet:
  """A recorded set, see the module's text.

  Args:
    folder: of the set; None: the one that ships.

  Raises:
    FileError for a folder that holds none, or one of another version.
  """

  def __init__(self, folder: pathlib.Path | str | None = None) -> None:
    self.folder = pathlib.Path(folder) if folder else RECORDINGS / "leaderboard"
    none = f"{self.folder} holds no recorded streams"
    make = "make some with `mjx-cl record`"
    try:
      self.config = tables.read_json(self.folder / "config.json")
    except FileError:
      raise FileError(f"{none} (no readable config.json); {make}") from None
    version = self.config.get("version")
    if version is None:
      raise FileError(f"{none}: its config.json is of something else; {make}")
    if version not in READ:
      raise FileError(
        f"{self.folder}: streams of version {version}, this release reads versions "
        f"{' and '.join(map(str, READ))}; record them anew"
      )
    try:
      self.suite = suites.of(self.config["suite"])
    except (KeyError, TypeError, AttributeError, ValueError) as e:
      raise FileError(
        f"{self.folder / 'config.json'} names no suite ({type(e).__name__}: {e})"
      ) from None
    self.meta = tables.read_table(self.folder / "streams.parquet")
    self._demand("streams.parquet", self.meta, META)
    self._held: dict[str, tuple[Rows, Rows]] = {}
    self._errors: dict[str, Rows] = {}

  def _rows(self, file: str, schema: dict[str, str]) -> Rows:
    columns = tables.read_table(self.folder / file)
    self._demand(file, columns, schema)
    if min(columns["step"], default=0) < 0:
      raise FileError(f"{self.folder / file}: a step below 0")
    return Rows(columns)

  def _demand(self, file: str, table: dict[str, np.ndarray], schema: dict[str, str]) -> None:
    path = self.folder / file
    if set(table) != set(schema):
      raise FileError(f"{path} is not of this schema: it has {', '.join(table)}")
    for name, said in schema.items():
      if not _holds(table[name], said):
        raise FileError(f"{path} is not of this schema: column {name} holds something else")
    if schema is META and not len(table["stream"]):
      raise FileError(f"{path} has no rows")

  @property
  def robots(self) -> list[str]:
    """Robots of the set, in its order."""
    return list(dict.fromkeys(self.meta["robot"].tolist()))

  def signed(self, robot: str) -> tuple[str, ...]:
    """Columns of the robot's innovations, none where the set does not hold them."""
    return tuple(self.config.get("details", {}).get(robot, {}).get("innovations", ()))

  def need_innovations(self, robot: str) -> tuple[str, ...]:
    """`signed`; FileError where the set has none."""
    names = self.signed(robot)
    if not names:
      raise FileError(
        f"{self.folder} holds no innovations of {robot}; record a suite with `innovations = true`"
      )
    return names

  def agent(self, robot: str) -> str:
    """Shipped name or folder of the agent that was recorded, that of the robot's name where the
    set does not tell.
    """
    told = self.config.get("agents", {}).get(robot, {})
    return told.get("agent") or told.get("name", robot)

  def choose(self, robots: Collection[str] = ()) -> list[str]:
    """These robots, each once; all where none is named. UserError for one that the set lacks."""
    for robot in robots:
      if robot not in self.robots:
        raise UserError(f"this set has no robot {robot!r}; choose from: {', '.join(self.robots)}")
    return list(dict.fromkeys(robots)) or self.robots

  def _hit(self, **values: Any) -> np.ndarray:
    """Which streams have these values in `meta`, None: any."""
    hits = [self.meta[k] == value for k, value in values.items() if value is not None]
    return np.logical_and.reduce(hits)

  def find(
    self,
    robot: str,
    kind: str,
    split: str | None = None,
    fault: str | None = None,
    severity: float | None = None,
  ) -> np.ndarray:
    """Stream numbers, in order."""
    return self.meta["stream"][
      self._hit(robot=robot, kind=kind, split=split, fault=fault, severity=severity)
    ]

  def faults(self, robot: str, split: str = "score") -> list[tuple[str, float]]:
    """(fault, severity) of fully kept streams, in the order of the suite."""
    hit = self._hit(robot=robot, kind="fault", split=split, full=True)
    fault, severity = (self.meta[k][hit].tolist() for k in ("fault", "severity"))
    return list(dict.fromkeys(zip(fault, severity)))

  def extent(self, robot: str) -> tuple[int, int]:
    """(most control steps, number) of the fault streams that score."""
    steps = self.meta["steps"][self._hit(robot=robot, kind="fault", split="score")]
    return int(steps.max()), len(steps)

  def scored(self, robots: Collection[str] = ()) -> dict[int, int]:
    """{stream: control steps} of all that a file of scores must hold: nominal, fault and probe
    streams; all robots where none is named.
    """
    m = self.meta
    hit = (m["kind"] != "past") & self._hit(full=True)
    if robots:
      hit &= np.isin(m["robot"].astype(str), list(robots))
    return dict(zip(m["stream"][hit].tolist(), m["steps"][hit].tolist()))

  def _load(self, robot: str) -> tuple[Rows, Rows]:
    """Rows and latents of a robot."""
    if robot not in self._held:
      self._held.clear()  # one robot at a time: a set may be larger than the memory
      self._errors.clear()
      self._held[robot] = (
        self._rows(f"{robot}.parquet", SCHEMA),
        self._rows(f"{robot}_latents.parquet", LATENTS),
      )
    return self._held[robot]

  def _innovations(self, robot: str) -> Rows:
    """Rows of a robot's innovations; FileError where the set has none."""
    if robot not in self._errors:
      names = self.need_innovations(robot)
      schema = {name: SCHEMA[name] for name in ("stream", "step")} | dict.fromkeys(names, "float16")
      self._errors = {robot: self._rows(f"{robot}_innovations.parquet", schema)}
    return self._errors[robot]

  def _fill(
    self,
    robot: str,
    number: int,
    limit: int,
    column: int,
    out: dict[str, np.ndarray],
    z: dict[str, np.ndarray],
    errors: dict[str, np.ndarray],
  ) -> None:
    """Writes what is known of stream `number` before step `limit` into column `column` of the
    arrays, its past first.
    """
    m = self.meta
    at = self._at(number)
    if m["prefix"][at] is not None and np.isfinite(m["prefix"][at]):
      cut = m["onset"][at] if m["kind"][at] == "fault" else m["steps"][at]
      self._fill(robot, int(m["prefix"][at]), min(limit, int(cut)), column, out, z, errors)
    rows, latents = self._load(robot)
    rows.put(number, limit, column, out)
    latents.put(number, limit, column, z)
    if errors:
      self._innovations(robot).put(number, limit, column, errors)

  def _at(self, number: int) -> int:
    return int(np.flatnonzero(self.meta["stream"] == number)[0])

  def get(self, robot: str, numbers: Sequence[int] | np.ndarray, signed: bool = False) -> Streams:
    """Streams of one robot, the shorter ones filled up with unknown values to the longest.

    Args:
      robot: of the set.
      numbers: of its streams.
      signed: with their innovations; FileError where the set has none.
    """
    at = [self._at(n) for n in numbers]
    if not at:
      raise UserError(
        f"no such stream of robot {robot!r}; robots of this set: {', '.join(self.robots)}"
      )
    m = {k: v[at] for k, v in self.meta.items()}
    if min(m["steps"]) < 1:
      raise FileError(f"{self.folder / 'streams.parquet'}: steps must be above 0")
    shape = int(max(m["steps"])), len(at)
    known: dict[str, Any] = {c: np.full(shape, np.nan, np.float32) for c in COLUMNS}
    known |= {"episode": np.zeros(shape, np.int16), "terminated": np.zeros(shape, bool)}
    z = np.full(shape + (LATENT,), np.nan, np.float32)
    latents = {name: z[..., k] for k, name in enumerate(PROJECTION)}
    names = self.signed(robot)
    e = np.full((*shape, len(names)), np.nan, np.float32) if signed else None
    errors = {} if e is None else {name: e[..., k] for k, name in enumerate(names)}
    if signed:
      self._load(robot)  # lets go of another robot's
      self._innovations(robot)
    for column, (number, steps) in enumerate(zip(numbers, m["steps"])):
      self._fill(robot, int(number), int(steps), column, known, latents, errors)
    episode = known.pop("episode")
    groups = [known.pop(c) for c in COLUMNS if c.startswith("group_")]
    residual = Residual(
      **known,
      variables=np.zeros(shape + (0,), np.float32),  # type: ignore[arg-type]
      valid=np.isfinite(known["opr"]),
      groups=np.stack(groups, -1),  # type: ignore[arg-type]
      latent=z,  # type: ignore[arg-type]
      innovation=e,  # type: ignore[arg-type]
    )
    onset = np.nan_to_num(m["onset"].astype(float), nan=shape[0])
    return Streams(
      residual,
      episode,
      m["stream"].astype(int),
      m["seed"].astype(int),
      np.where(m["kind"] == "fault", onset, shape[0]).astype(int),
      m["fault"].tolist(),
      m["target"].tolist(),
      m["severity"].astype(float),
      float(m["control_s"][0]),
    )


class Data(NamedTuple):
  """The streams of one robot.

  Attributes:
    robot: its name.
    tune: healthy streams of the seeds that tune.
    score: healthy streams of the seeds that score.
    fault: of the seeds that score; its labels are per stream.
    count_from: of the suite, and so are the next two [control steps].
    arl0: [control steps].
    horizon_s: [s].
    twins: (T, S) reward of the healthy robots that the fault streams were one with until the onset,
      seed by seed as in `score`; None: unknown.
  """

  robot: str
  tune: Streams
  score: Streams
  fault: Streams
  count_from: int
  arl0: float
  horizon_s: float
  twins: np.ndarray | None = None

  @property
  def horizon(self) -> int:
    """Control steps after an onset in which an alarm counts."""
    return metrics.steps_in(self.horizon_s, self.fault.control_s)

  def own(self, key: tuple[str, float]) -> np.ndarray:
    """Columns of `fault` with this fault and severity, seed by seed as in `score`."""
    return np.flatnonzero([one == key for one in zip(self.fault.fault, self.fault.severity)])


def load(streams: StreamSet, robot: str) -> Data:
  """One robot's streams, with innovations where the set has them.

  Raises:
    FileError where its fault streams are not one for each seed that scores.
  """
  signed = bool(streams.signed(robot))
  tune, score = (
    streams.get(robot, streams.find(robot, "nominal", s), signed) for s in ("tune", "score")
  )
  keys, suite = streams.faults(robot), streams.suite
  numbers = np.concatenate([streams.find(robot, "fault", "score", *key) for key in keys])
  fault = streams.get(robot, numbers, signed)
  seeds = list(dict.fromkeys(score.seed.tolist()))
  past = streams.get(robot, streams.find(robot, "past", "score"))
  twins = np.asarray(past.residual.reward) if past.seed.tolist() == seeds else None
  data = Data(robot, tune, score, fault, suite.count_from, suite.arl0, suite.horizon_s, twins)
  for name, severity in keys:
    if fault.seed[data.own((name, severity))].tolist() != seeds:
      raise FileError(
        f"{streams.folder}: {robot}, {name} {severity:g}: its streams must be those of the "
        f"seeds {seeds}, in order, one of each"
      )
  return data


def joined(a: Residual, b: Residual) -> Residual:
  """Two residuals side by side, cut to the shorter."""
  steps = min(len(a.opr), len(b.opr))
  return jax.tree.map(lambda x, y: np.concatenate([x[:steps], y[:steps]], 1), a, b)
