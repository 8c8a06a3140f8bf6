"""A detector calibrated on one robot: its threshold, what it did there, and its latency at other
rates of false alarms.
"""

import math
import zlib
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import numpy as np

from mjx_cl.leaderboard import sweep
from mjx_cl.leaderboard.entries import Entry
from mjx_cl.leaderboard.program import Samples
from mjx_cl.leaderboard.streams import Data
from mjx_cl.scoring import metrics, thresholds

# further ARL0 of the latency-against-false-alarm curves [control steps]
CURVE = (300, 1_000, 3_000, 30_000)


class Found(NamedTuple):
  """What a detector did on one robot.

  Attributes:
    threshold: None where there is none to set.
    arl0: metrics.arl0 on the tuning streams.
    episode: metrics.episode_alarm_probability, scoring streams.
    nominal_fired: bool (N, S) on the healthy scoring streams, seed by seed.
    nominal_score: (N, S), likewise.
    fired: bool (T, F) on the fault streams.
    score: (T, F), likewise.
    us_per_sample: compute [microseconds], None where not measured.
    curve: [{false_alarms_per_hour, latency_mean_s, detected}].
    note: how it was brought to the asked rate where no threshold does; None: one does.
  """

  threshold: float | None
  arl0: dict
  episode: dict
  nominal_fired: np.ndarray
  nominal_score: np.ndarray
  fired: np.ndarray
  score: np.ndarray
  us_per_sample: float | None
  curve: list[dict]
  note: str | None = None


def examine(one: Entry, data: Data, runner: sweep.Runner, samples: Samples) -> Found:
  """Calibrates a detector on one robot and runs it.

  Args:
    one: the detector.
    data: streams of the robot.
    runner: of the detector, compiled once for all robots.
    samples: of `data`.
  """
  runner.prepare(samples)
  for reuse in (True, False):
    tried: dict[float, int] = {}
    threshold, counted, sound = 0.0, 0, True
    if one.calibrated:
      threshold, tried, counted, sound = _calibrate(data, runner, samples, reuse)
    every = np.full((len(samples.healthy), runner.together), threshold, np.float32)
    runs = list(runner.healthy(list(enumerate(every)), samples))
    fired = np.stack([f[0] for f, _ in runs], 1)
    alarms = fired[data.count_from :, : data.tune.residual.opr.shape[1]].sum()
    # a threshold that is used otherwise than as score > threshold lets no run tell of another; then
    # all are run
    if not one.calibrated or sound and alarms == tried.get(threshold, 0):
      break
  score = np.stack([sweep.strongest(s[0]) for _, s in runs], 1)
  known = list(tried.items())
  levels = [threshold] + [thresholds.nearest(known, counted, a) for a in CURVE if tried]
  late_fired, late_score, before, us = runner.faults(np.asarray(levels, np.float32), samples)
  placed = lambda x, unknown: _placed(x, data.fault.onset, len(data.fault.residual.opr), unknown)
  pairs = [(tried[t], placed(f, False)) for t, f in zip(levels, late_fired) if t in tried]

  def faulty(late: np.ndarray, before: np.ndarray) -> np.ndarray:
    alarms = placed(late, False)
    alarms[: len(before)] |= before
    return alarms

  def at(level: float) -> tuple[np.ndarray, np.ndarray]:
    lanes = [(s, np.full(runner.together, level, np.float32)) for s in range(len(samples.healthy))]
    own = np.stack([f[0] for f, _ in runner.healthy(lanes, samples)], 1)
    late, _, before, _ = runner.faults(np.asarray([level], np.float32), samples)
    return own, faulty(late[0], before)

  fault_fired, fault_score = faulty(late_fired[0], before), placed(late_score[0], np.nan)
  fired, fault_fired, note = at_rate(
    data, tried, threshold, counted, (fired, score), (fault_fired, fault_score), at
  )
  return found(
    data,
    float(np.float32(threshold)) if one.calibrated else None,
    fired,
    score,
    fault_fired,
    fault_score,
    us,
    curve(pairs, data, counted),
  )._replace(note=note)


def at_rate(
  data: Data,
  tried: Mapping[float, int],
  threshold: float,
  counted: int,
  healthy: tuple[np.ndarray, np.ndarray],
  fault: tuple[np.ndarray, np.ndarray],
  at: Callable[[float], tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray, str | None]:
  """Alarms at the asked rate where the threshold gives fewer: all detectors are compared at one
  rate, and none gains by a rarer one.

  With a alarms at the threshold, b more at other steps at the next lower one that was tried and has
  too many, and n asked for, each of these b counts with probability (n - a) / b, a randomised test
  between two operating points. Where there is no such lower one, alarms are added at random,
  n - a on the healthy steps that were counted. On those steps n - a are drawn, no more and no
  fewer. Draws follow from the robot's name.

  Args:
    data: streams of the robot.
    tried: threshold -> alarms.
    threshold: that was found.
    counted: healthy steps.
    healthy: alarms and scores there, (N, S).
    fault: likewise on fault streams, (T, F).
    at: threshold -> alarms on both.

  Returns:
    (alarms, alarms on fault streams, note; None where nothing was changed).
  """
  have, wanted = tried.get(threshold, math.inf), math.floor(counted / data.arl0)
  if have >= wanted:
    return healthy[0], fault[0], None
  random = np.random.default_rng(zlib.crc32(data.robot.encode()))
  lower = [t for t, alarms in tried.items() if t < threshold and alarms > wanted]
  tune = data.tune.residual.opr.shape[1]
  seen = thresholds.seeing(healthy[1][:, :tune], data.count_from)
  block = np.zeros(healthy[0].shape, bool)  # the steps that were counted
  block[data.count_from :, :tune] = seen
  more = at(max(lower)) if lower else (np.isfinite(healthy[1]), np.isfinite(fault[1]))
  could = np.flatnonzero(block & more[0] & ~healthy[0])
  if lower:
    share = min(1.0, (wanted - have) / max(1, len(could)))
    note = (
      f"no threshold gives the asked rate: {have} alarms, or {tried[max(lower)]}, of {wanted}; "
      f"those of the lower one count with probability {share:.3g}"
    )
  else:
    share = (wanted - have) / counted
    note = f"{have} alarms of {wanted} asked for: the others were drawn at random"
  added, late = (
    m & ~x & (random.random(m.shape) < share) for m, (x, _) in zip(more, (healthy, fault))
  )
  added[block] = False
  added.flat[random.choice(could, int(min(wanted - have, len(could))), replace=False)] = True
  return healthy[0] | added, fault[0] | late, note


def _calibrate(
  data: Data, runner: sweep.Runner, samples: Samples, reuse: bool
) -> tuple[float, dict[float, int], int, bool]:
  """(threshold, {threshold: alarms} that were tried, healthy steps that were counted, whether one
  run may tell of another).
  """
  streams = data.tune.residual.opr.shape[1]
  counter = sweep.Counter(runner, samples, streams, data.count_from, reuse)
  free = counter.score()[data.count_from :]
  counted = int(thresholds.seeing(free, 0).sum()) * len(free)
  target = counted / data.arl0
  threshold, tried = thresholds.narrow(lambda levels: counter.count(levels, target), free, target)
  return threshold, dict(tried), counted, counter.sound


def _placed(x: np.ndarray, onset: np.ndarray, steps: int, unknown: float) -> np.ndarray:
  """(T, F) from rows (H, F) that begin at the onsets; `unknown` before and behind, where nothing
  counts.
  """
  out = np.full((steps, len(onset)), unknown, x.dtype)
  for k, first in enumerate(onset):
    out[first : first + len(x), k] = x[: steps - first, k]
  return out


def curve(pairs: Iterable[tuple[int, np.ndarray]], data: Data, counted: float) -> list[dict]:
  """Latency against false alarms: mean over fault streams of min(delay, horizon), a miss counts the
  horizon.

  Args:
    pairs: (alarms on `counted` healthy steps, fired (T, F) on the fault streams) of each threshold.
    data: streams of the robot.
    counted: healthy control steps.
  """
  control_s, horizon, points = data.fault.control_s, data.horizon, {}
  for alarms, fired in pairs:
    latency = metrics.latencies(fired, data.fault.onset, horizon)
    rate = alarms / (counted * control_s / 3600)
    points[rate] = {
      "false_alarms_per_hour": rate,
      "latency_mean_s": float(np.mean(np.minimum(latency + 1, horizon)) * control_s),
      "detected": float(np.isfinite(latency).mean()),
    }
  return [points[k] for k in sorted(points)]


def found(
  data: Data,
  threshold: float | None,
  fired: np.ndarray,
  score: np.ndarray,
  fault_fired: np.ndarray,
  fault_score: np.ndarray,
  us: float | None = None,
  points: Iterable[dict] = (),
) -> Found:
  """Found from raw alarms and scores.

  Args:
    data: streams of the robot.
    threshold: None where there is none to set.
    fired: bool (N, tuning + scoring streams), on healthy streams.
    score: (N, tuning + scoring streams), likewise.
    fault_fired: bool (T, F), on fault streams.
    fault_score: (T, F), likewise.
    us: microseconds per sample.
    points: of `curve`.
  """
  tune, count_from = data.tune.residual.opr.shape[1], data.count_from
  steps = min(len(fired), len(data.score.episode))
  tuned, scored = (thresholds.seeing(x, count_from) for x in (score[:, :tune], score[:, tune:]))
  by_seed = lambda x: thresholds.by_seed(x[:, tune:], data.score.seed, count_from, scored)
  return Found(
    threshold,
    metrics.arl0(fired[:, :tune][:, tuned], count_from),
    metrics.episode_alarm_probability(
      fired[:steps, tune:][:, scored], data.score.episode[:steps, scored], count_from
    ),
    by_seed(fired),
    by_seed(score),
    fault_fired,
    fault_score,
    us,
    list(points),
  )
