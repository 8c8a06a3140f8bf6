"""Other ways onto the leaderboard than a registered detector: a plain Python class, a file of
scores, and for the latter the streams as plain files.
"""

from __future__ import annotations

import pathlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import pyarrow.compute
import pyarrow.parquet

from mjx_cl.detectors import python_class as host_lib
from mjx_cl.detectors.combine import read
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import tables
from mjx_cl.leaderboard.calibration import CURVE, Found, curve, found
from mjx_cl.leaderboard.streams import COLUMNS, Data, Streams, StreamSet
from mjx_cl.scoring import thresholds

if TYPE_CHECKING:
  from collections.abc import Collection
  from typing import Any

HALVINGS = 8  # of a factor of 8, until less than a hundredth is left
TRIED = (
  2  # streams of each kind on which a plain class must give the same answers when they are cut off
)


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
    tune = column(data.tune, steps)
    nominal = np.concatenate([tune, column(data.score, steps)], 1)
    fault = column(data.fault, len(data.fault.residual.opr))
    counted = int(thresholds.seeing(tune, data.count_from).sum()) * (steps - data.count_from)
    count = lambda levels: np.asarray([crossings(tune, t)[data.count_from :].sum() for t in levels])
    threshold, tried = thresholds.narrow(count, tune[data.count_from :], counted / data.arl0)
    levels = [threshold] + [thresholds.nearest(tried, counted, a) for a in CURVE if tried]
    alarms = dict(tried)
    points = curve([(alarms[t], crossings(fault, t)) for t in levels if t in alarms], data, counted)
    return found(
      data,
      threshold,
      crossings(nominal, threshold),
      nominal,
      crossings(fault, threshold),
      fault,
      None,
      points,
    )

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
    robots: whose streams it must hold; all where empty.

  Raises:
    FileError, one line: unreadable, a missing column or stream, a wrong length, a score that is
      infinite or nan (not null), a robot without any score
    on its healthy streams, or a score that looks ahead: streams of kind `probe` are others cut off,
      and their scores must be those of the whole
    stream up to there.
  """
  table = tables.read_table(path)
  if not {"stream", "step", "score"} <= set(table):
    raise FileError(f"{path}: needs the columns stream, step, score; it has {', '.join(table)}")
  number, step, score = (_numbers(path, table, k) for k in ("stream", "step", "score"))
  if not (np.isfinite(number).all() and np.isfinite(step).all()):
    raise FileError(
      f"{path}: row {int(np.flatnonzero(~np.isfinite(number + step))[0])} names no stream or "
      "no step"
    )
  known = np.asarray(streams.meta["stream"], float)
  for strange, word in (
    (
      ~np.isin(number, known),
      (
        f"of the set {streams.folder}; its streams are {known.min():.0f} to {known.max():.0f}, "
        "some left out"
      ),
    ),
    (step != np.floor(step), "with a whole step"),
  ):
    if strange.any():
      raise FileError(
        f"{path}: row {int(strange.argmax())}, stream {number[strange][0]:g}, step "
        f"{step[strange][0]:g}, is none {word}"
      )
  raw = pyarrow.parquet.read_table(path, columns=["score"])["score"]
  nan = (
    np.asarray(pyarrow.compute.fill_null(pyarrow.compute.is_nan(raw), False))
    if pyarrow.types.is_floating(raw.type)
    else np.zeros(len(raw), bool)
  )
  for wrong, word in ((nan, "nan"), (np.isinf(score), "infinite")):
    if wrong.any():
      raise FileError(
        f"{path}: a score is {word} in stream {int(number[wrong][0])}, step "
        f"{int(step[wrong][0])}; leave out (null) what is not known"
      )
  want, out = streams.scored(robots), {}
  order = np.lexsort((step, number))
  number, step, score = number[order], step[order], score[order]
  at = {
    int(n): (i, c) for n, i, c in zip(*np.unique(number, return_index=True, return_counts=True))
  }
  missing = sorted(set(want) - set(at))
  if missing:
    raise FileError(
      f"{path}: {len(missing)} of {len(want)} streams are missing, the first is stream {missing[0]}"
    )
  for n, steps in want.items():
    i, c = at[n]
    if c != steps or not np.array_equal(step[i : i + c], np.arange(steps)):
      raise FileError(
        f"{path}: stream {n} must have one row for each of its steps 0 to {steps - 1}; it has "
        f"{c} rows"
      )
    out[n] = score[i : i + c]
  for robot in streams.choose(robots):
    if not any(
      np.isfinite(out[int(n)][streams.suite.count_from :]).any()
      for n in streams.find(robot, "nominal", "tune")
    ):
      raise FileError(
        f"{path}: no score is known on the healthy streams of {robot} that set the threshold"
      )
  m = streams.meta
  for n, whole in (
    (int(n), int(p))
    for n, k, p in zip(m["stream"], m["kind"], m["prefix"])
    if k == "probe" and int(n) in want
  ):
    first = _differ(out[whole][: want[n]], out[n])
    if first is not None:
      raise FileError(
        f"{path}: the score looks ahead: stream {n} is stream {whole} cut off after {want[n]} "
        "steps, "
        f"yet their scores differ from step {first} on"
      )
  return out


def _differ(whole: np.ndarray, cut: np.ndarray) -> int | None:
  """First step at which two scores differ by more than sums in another order do, None without such
  a step.

  That is a thousandth of the width of the scores' middle half, and 1e-5 of how far a score lies
  from their middle; what the middle itself, a mere offset, costs in float32 is granted up to a
  twentieth of the width.
  """
  known = whole[np.isfinite(whole)]
  low, middle, high = np.quantile(known, [0.25, 0.5, 0.75]) if len(known) else (0.0, 0.0, 0.0)
  width = high - low
  allowed = 1e-3 * width + min(1e-5 * abs(middle), 0.05 * width) + 1e-5 * np.abs(whole - middle)
  differ = ~(np.abs(whole - cut) <= allowed) & ~(np.isnan(whole) & np.isnan(cut))
  return int(np.flatnonzero(differ)[0]) if differ.any() else None


def from_host(
  host: host_lib.HostDetector | Callable[[float], host_lib.HostDetector],
  threshold_name: str | None = None,
) -> Callable[[Data], Found]:
  """Data -> Found for a plain Python class, see detectors.host; one that looks ahead is refused.

  Args:
    host: detectors.host.HostDetector, or with `threshold_name` a function of one setting's value to
      one.
    threshold_name: setting that is calibrated to the ARL0, above 0, larger = fewer alarms; None:
      run as it is, its own ARL0 printed.
  """

  def get(data: Data) -> Found:
    detector: Any = host(1.0) if threshold_name else host  # type: ignore[operator]
    tune, score, fault = (
      host_lib.samples(detector, x.residual) for x in (data.tune, data.score, data.fault)
    )
    for x in (tune, score, fault):
      host_lib.check_causal(detector.factory, x[:, :TRIED], host_name=detector.host_name)
    value = None
    if threshold_name:
      target = tune.shape[1] * (len(tune) - data.count_from) / data.arl0
      alarms = lambda v: int(
        host_lib.run_host(host(v).factory, tune, detector.host_name)[0][data.count_from :].sum()  # type: ignore[operator]
      )
      value = _least(alarms, target, f"--threshold {threshold_name}")
      detector = host(value)  # type: ignore[operator]
    steps = min(len(tune), len(score))
    fired, found_score = host_lib.run_host(
      detector.factory, np.concatenate([tune[:steps], score[:steps]], 1), detector.host_name
    )
    begin = time.perf_counter()
    fault_fired, fault_score = host_lib.run_host(detector.factory, fault, detector.host_name)
    us = (time.perf_counter() - begin) / max(1, np.isfinite(fault).sum()) * 1e6
    return found(data, value, fired, found_score, fault_fired, fault_score, us)

  return get


def _least(alarms: Callable[[float], int], target: float, what: str) -> float:
  """The least value above 0 with at most `target` alarms, to a hundredth of itself."""
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
  return float(thresholds.halve(few, low, high, lambda a, b: np.sqrt(a * b), HALVINGS))


def export(
  streams: StreamSet,
  folder: pathlib.Path | str,
  robots: Collection[str] = (),
  overwrite: bool = False,
) -> list[str]:
  """Every stream that a submission needs, in full, as ROBOT.parquet with its past joined: for tools
  that know nothing of this package.

  Raises:
    UserError where `folder` is a recorded set, whose files have these names, or holds one of the
    files already.
  """
  folder = pathlib.Path(folder)
  if (folder / "config.json").exists():
    raise UserError(f"{folder} is the folder of a recording or a run; give --export another one")
  there = [robot for robot in streams.choose(robots) if (folder / f"{robot}.parquet").exists()]
  if there and not overwrite:
    raise UserError(
      f"{folder} holds {there[0]}.parquet already; give --overwrite to replace it, or --export "
      "another folder"
    )
  folder.mkdir(parents=True, exist_ok=True)
  written = []
  for robot in streams.choose(robots):
    table: dict[str, list] = {k: [] for k in ("stream", "step", "episode", "terminated") + COLUMNS}
    for n, steps in streams.scored((robot,)).items():
      one = streams.get(robot, [n])
      r = one.residual
      values = {
        "stream": np.full(steps, n, np.int32),
        "step": np.arange(steps, dtype=np.int32),
        "episode": one.episode[:, 0],
        "terminated": r.terminated[:, 0],
        **{c: read(c, r)[:, 0] for c in COLUMNS},
      }
      for k, v in values.items():
        table[k].append(v)
    tables.write_table(
      folder / f"{robot}.parquet", {k: np.concatenate(v) for k, v in table.items()}, level=9
    )
    written.append(str(folder / f"{robot}.parquet"))
  return written
