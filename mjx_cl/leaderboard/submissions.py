"""Other ways onto the leaderboard than a registered detector: a plain Python class, a file of
scores, and for the latter the streams as plain files.
"""

import math
import pathlib
from collections.abc import Callable, Collection

import numpy as np
import pyarrow.compute
import pyarrow.parquet

from mjx_cl.detectors import python_class as host_lib
from mjx_cl.detectors.combine import read
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import tables
from mjx_cl.leaderboard.calibration import CURVE, Found, at_rate, curve, found
from mjx_cl.leaderboard.streams import COLUMNS, Data, Streams, StreamSet
from mjx_cl.scoring import thresholds

HALVINGS = 20  # of a factor of 8, until 2e-6 is left; fewer where the alarms asked for are met
# streams of each kind on which a plain class must give the same answers when they are cut off
TRIED = 2


def crossings(score: np.ndarray, threshold: float) -> np.ndarray:
  """Alarms of scores (T, S): where a known score rises above `threshold`; the next alarm needs a
  score at or below it first.
  """
  over = score > threshold
  known = np.isfinite(score)
  at = np.arange(len(score))[:, None]
  last = np.maximum.accumulate(np.where(known, at, -1), 0)
  before = np.concatenate([np.full((1,) + score.shape[1:], -1), last[:-1]])
  was = np.take_along_axis(over, np.maximum(before, 0), 0) & (before >= 0)
  return over & known & ~was


def from_scores(scores: dict[int, np.ndarray]) -> Callable[[Data], Found]:
  """Data -> Found for scores that someone else computed, stream -> float (steps,); calibrated like
  the others.
  """

  def get(data: Data) -> Found:
    def column(own: Streams, steps: int) -> np.ndarray:
      out = np.full((steps, len(own.stream)), np.nan)
      for k, n in enumerate(own.stream):
        x = np.asarray(scores[int(n)], float)[:steps]
        out[: len(x), k] = x
      return out

    steps = min(len(data.tune.residual.opr), len(data.score.residual.opr))
    tune, fault = column(data.tune, steps), column(data.fault, len(data.fault.residual.opr))
    nominal = np.concatenate([tune, column(data.score, steps)], 1)
    counted = int(thresholds.seeing(tune, data.count_from).sum()) * (steps - data.count_from)
    count = lambda levels: np.asarray([crossings(tune, t)[data.count_from :].sum() for t in levels])
    threshold, tried = thresholds.narrow(count, tune[data.count_from :], counted / data.arl0)
    levels = [threshold] + [thresholds.nearest(tried, counted, a) for a in CURVE if tried]
    alarms = dict(tried)
    points = curve([(alarms[t], crossings(fault, t)) for t in levels if t in alarms], data, counted)
    both = lambda level: (crossings(nominal, level), crossings(fault, level))
    fired, fault_fired = both(threshold)
    fired, fault_fired, note = at_rate(
      data, alarms, threshold, counted, (fired, nominal), (fault_fired, fault), both
    )
    rated = found(data, threshold, fired, nominal, fault_fired, fault, None, points)
    return rated._replace(note=note)

  return get


def _numbers(path: pathlib.Path | str, table: dict, name: str) -> np.ndarray:
  try:
    return np.asarray(table[name], float)
  except (TypeError, ValueError):
    raise FileError(f"{path}: column {name!r} must hold numbers") from None


def read_submission(
  path: pathlib.Path | str, streams: StreamSet, robots: Collection[str] = ()
) -> dict[int, np.ndarray]:
  """Checks and reads a file of scores: Parquet with the columns stream, step, score, a row for
  every control step of every stream of the set but those of kind `past`; null where no score is
  known.

  Args:
    path: of the file.
    streams: the set.
    robots: whose streams it must hold; all where empty.

  Raises:
    FileError, one line: unreadable, a missing column or stream, a wrong length, a score that is
      infinite or nan (not null), a robot without any score on its healthy streams, or a score that
      looks ahead: streams of kind `probe` are others cut off, and their scores must be those of the
      whole stream up to there.
  """
  number, step, score = _columns(path, streams)
  order = np.lexsort((step, number))
  own, begin = np.unique(number[order], return_index=True)
  parts = [np.split(x[order], begin[1:]) for x in (step, score)]
  held = dict(zip(own.tolist(), zip(*parts)))
  want = streams.scored(robots)
  missing = sorted(set(want) - set(held))
  if missing:
    raise FileError(
      f"{path}: {len(missing)} of {len(want)} streams are missing, the first is stream {missing[0]}"
    )
  for n, steps in want.items():
    if not np.array_equal(held[n][0], np.arange(steps)):
      raise FileError(
        f"{path}: stream {n} must have one row for each of its steps 0 to {steps - 1}; it has "
        f"{len(held[n][0])} rows"
      )
  out = {n: held[n][1] for n in want}
  for robot in streams.choose(robots):
    tune = streams.find(robot, "nominal", "tune").tolist()
    if not any(np.isfinite(out[n][streams.suite.count_from :]).any() for n in tune):
      raise FileError(
        f"{path}: no score is known on the healthy streams of {robot} that set the threshold"
      )
  for n, kind, whole in zip(*(streams.meta[k] for k in ("stream", "kind", "prefix"))):
    if kind == "probe" and n in want:
      first = _differ(out[int(whole)][: want[n]], out[n])
      if first is not None:
        raise FileError(
          f"{path}: the score looks ahead: stream {n} is stream {int(whole)} cut off after "
          f"{want[n]} steps, yet their scores differ from step {first} on"
        )
  return out


def _columns(path: pathlib.Path | str, streams: StreamSet) -> list[np.ndarray]:
  """Stream, step and score of every row, all sound but perhaps not all that is needed."""
  table = tables.read_table(path)
  if not {"stream", "step", "score"} <= set(table):
    raise FileError(f"{path}: needs the columns stream, step, score; it has {', '.join(table)}")
  number, step, score = (_numbers(path, table, k) for k in ("stream", "step", "score"))
  nameless = ~np.isfinite(number + step)
  if nameless.any():
    raise FileError(f"{path}: row {int(nameless.argmax())} names no stream or no step")
  known = np.asarray(streams.meta["stream"], float)
  span = f"{known.min():.0f} to {known.max():.0f}, some left out"
  for strange, word in (
    (~np.isin(number, known), f"of the set {streams.folder}; its streams are {span}"),
    (step != np.floor(step), "with a whole step"),
  ):
    if strange.any():
      at = int(strange.argmax())
      raise FileError(f"{path}: row {at}, stream {number[at]:g}, step {step[at]:g}, is none {word}")
  raw = pyarrow.parquet.read_table(path, columns=["score"])["score"]
  nan = np.zeros(len(raw), bool)
  if pyarrow.types.is_floating(raw.type):
    nan = np.asarray(pyarrow.compute.fill_null(pyarrow.compute.is_nan(raw), False))
  for wrong, word in ((nan, "nan"), (np.isinf(score), "infinite")):
    if wrong.any():
      at = int(wrong.argmax())
      raise FileError(
        f"{path}: a score is {word} in stream {int(number[at])}, step {int(step[at])}; leave out "
        "(null) what is not known"
      )
  return [number, step, score]


def _differ(whole: np.ndarray, cut: np.ndarray) -> int | None:
  """First step at which two scores differ by more than sums in another order do, None without such
  a step.

  That is a thousandth of the width of the scores' middle half (where it is one value, of the median
  distance of the others from it), and 1e-5 of how far a score lies
  from their middle; what the middle itself, a mere offset, costs in float32 is granted up to a
  twentieth of the width.
  """
  known = whole[np.isfinite(whole)]
  low, middle, high = np.quantile(known, [0.25, 0.5, 0.75]) if len(known) else (0.0, 0.0, 0.0)
  others = np.abs(known - middle)
  width = high - low or (np.median(others[others > 0]) if others.any() else 0.0)
  allowed = 1e-3 * width + min(1e-5 * abs(middle), 0.05 * width) + 1e-5 * np.abs(whole - middle)
  differ = ~(np.abs(whole - cut) <= allowed) & ~(np.isnan(whole) & np.isnan(cut))
  return int(np.flatnonzero(differ)[0]) if differ.any() else None


def from_host(
  host: host_lib.HostDetector | Callable[[float], host_lib.HostDetector],
  threshold_name: str | None = None,
) -> Callable[[Data], Found]:
  """Data -> Found for a plain Python class, see detectors.python_class; one that looks ahead is
  refused.

  Args:
    host: a HostDetector, or with `threshold_name` a function of one setting's value to one.
    threshold_name: setting that is calibrated to the ARL0, above 0, larger = fewer alarms; None:
      run as it is, its own ARL0 printed.
  """
  make: Callable[[float], host_lib.HostDetector] = (
    (lambda value: host) if isinstance(host, host_lib.HostDetector) else host
  )

  def get(data: Data) -> Found:
    detector, value, tried = make(1.0), math.inf, dict[float, int]()
    tune, score, fault = (
      host_lib.samples(detector, x.residual) for x in (data.tune, data.score, data.fault)
    )
    for x in (tune, score, fault):
      host_lib.causal(detector, x[:, :TRIED])
    counted = tune.shape[1] * (len(tune) - data.count_from)
    if threshold_name:

      def alarms(v: float) -> int:
        tried[v] = int(host_lib.run(make(v), tune)[0][data.count_from :].sum())
        return tried[v]

      value = _least(alarms, counted / data.arl0, f"--threshold {threshold_name}")
      detector = make(value)
    steps = min(len(tune), len(score))
    healthy = np.concatenate([tune[:steps], score[:steps]], 1)
    fired, healthy_score, _ = host_lib.run(detector, healthy)
    fault_fired, fault_score, seconds = host_lib.run(detector, fault)
    us = seconds / max(1, np.isfinite(fault).sum()) * 1e6
    at = lambda level: (
      host_lib.run(make(level), healthy)[0],
      host_lib.run(make(level), fault)[0],
    )
    fired, fault_fired, note = at_rate(
      data, tried, value, counted, (fired, healthy_score), (fault_fired, fault_score), at
    )
    threshold = value if threshold_name else None
    rated = found(data, threshold, fired, healthy_score, fault_fired, fault_score, us)
    return rated._replace(note=note)

  return get


def _least(alarms: Callable[[float], int], target: float, what: str) -> float:
  """A value above 0 with `target` alarms, rounded down; where there is none the least with
  fewer, to 2e-6 of itself.
  """
  few = lambda value: np.asarray(alarms(float(value)) <= target)
  low, high, enough = thresholds.reach(few, np.asarray(1 / 8), np.asarray(1.0))
  if not enough:
    raise UserError(
      f"{what}: at {float(high):g} there are still more than the {target:.0f} alarms asked for; "
      "larger values must mean fewer alarms"
    )
  while high <= 1 and high > 1 / thresholds.HIGHEST and few(low):
    low, high = low / 8, low
  if high <= 1 / thresholds.HIGHEST:
    raise UserError(
      f"{what}: even at {float(high):g} there are no more than the {target:.0f} alarms asked for, "
      "so that nothing is calibrated; its values lie above 0, larger ones mean "
      "fewer alarms: give the class a setting of that kind (a score that is negative wants "
      "an offset)"
    )
  for _ in range(HALVINGS):
    between = np.sqrt(low * high)
    given = alarms(float(between))
    if given == int(target):
      return float(between)
    low, high = (low, between) if given <= target else (between, high)
  return float(high)


def export(
  streams: StreamSet,
  folder: pathlib.Path | str,
  robots: Collection[str] = (),
  overwrite: bool = False,
) -> list[str]:
  """Every stream that a submission needs, in full, as ROBOT.parquet with its past joined: for tools
  that know nothing of this package.

  Args:
    streams: the set.
    folder: to write into.
    robots: all where empty.
    overwrite: replace files that are there.

  Raises:
    UserError where `folder` is a recorded set, whose files have these names, or holds one of the
    files already.
  """
  folder, robots = pathlib.Path(folder), streams.choose(robots)
  if (folder / "config.json").exists():
    raise UserError(f"{folder} is the folder of a recording or a run; give --export another one")
  paths = {robot: folder / f"{robot}.parquet" for robot in robots}
  there = [path.name for path in paths.values() if path.exists()]
  if there and not overwrite:
    raise UserError(
      f"{folder} holds {there[0]} already; give --overwrite to replace it, or --export another "
      "folder"
    )
  folder.mkdir(parents=True, exist_ok=True)
  for robot, path in paths.items():
    parts = []
    for n, steps in streams.scored((robot,)).items():
      one = streams.get(robot, [n])
      ends = {"episode": one.episode[:, 0], "terminated": one.residual.terminated[:, 0]}
      known = ends | {c: read(c, one.residual)[:, 0] for c in COLUMNS}
      index = {"stream": np.full(steps, n, np.int32), "step": np.arange(steps, dtype=np.int32)}
      parts.append(index | known)
    whole = {k: np.concatenate([part[k] for part in parts]) for k in parts[0]}
    tables.write_table(path, whole, level=9)
  return [str(path) for path in paths.values()]
