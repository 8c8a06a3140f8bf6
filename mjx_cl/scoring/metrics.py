"""The leaderboard's numbers: one matching of alarms to onsets, and a few lines for each metric over
it.

  fault stream    latency_s = steps from the onset to the first alarm in [onset, onset + horizon_s);
    no alarm there: the fault is missed
  healthy stream  false alarms = its alarms from `count_from` on, over its hours from `count_from`
  on

An alarm of step onset + k is known k + 1 control periods after the fault began to act: "detected
within x s" means k + 1 <= x / control_s, and the latency is k (0 for an alarm in the first faulty
step). What a fault stream does before its onset or behind the horizon counts nowhere, and false
alarms come from healthy streams alone: adding faults to a suite, or lengthening its streams, leaves
every other number as it was.

cost of one stream = miss                              where the fault is missed
                   = 1 - 2^(-latency_s / HALF_S)       where it is detected
  + false_alarm * HOURS_PER_FAULT * false alarms per hour of the same seed's healthy stream
score = 100 (1 - mean cost / miss): 0 for a detector that never fires, 100 for one that fires in the
step of the onset and never else, below 0 for one whose alarms cost more than never looking. It is a
mean over streams, hence linear and additive.

In the spirit of the profiles of the Numenta Anomaly Benchmark (Lavin and Ahmad 2015), whose windows
and sigmoid it does not share.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mjx_cl.errors import UserError
from mjx_cl.scoring import alarms
from mjx_cl.scoring import intervals as bootstrap

HORIZON_S = 20.0  # a later alarm is no detection, unless a suite says otherwise [s after onset]
HALF_S = 5.0  # delay after which half of what an immediate alarm saves is lost [s]
# healthy operation for each fault, six minutes; sets how many false alarms stand against one miss
# [h]
HOURS_PER_FAULT = 0.1
WITHIN_S = (0.5, 1.0, 5.0, 20.0)
SHARES = ("miss_probability", *(f"detected_within_{x:g}s" for x in WITHIN_S))
REPS = 2_000  # bootstrap draws
FEW = 50  # alarms below which an ARL0 is marked


class Profile(NamedTuple):
  """What errors cost, in units of an utterly late detection.

  Attributes:
    miss: cost of a missed fault.
    false_alarm: cost of one false alarm.
  """

  miss: float
  false_alarm: float


PROFILES = {
  "standard": Profile(1.0, 0.1),
  "few_false": Profile(1.0, 0.2),
  "few_misses": Profile(2.0, 0.1),
}


def steps_in(seconds: float, control_s: float) -> int:
  """Whole control periods in so many seconds."""
  return int(seconds / control_s + 1e-6)  # 0.3 / 0.1 falls short of 3 in binary


def latencies(
  alarm: np.ndarray, onset: np.ndarray, horizon: int, count_from: int = 0
) -> np.ndarray:
  """Steps from onset to the first alarm in [onset, onset + horizon), inf where there is none.

  Args:
    alarm: bool (T, S).
    onset: int (S,).
    horizon: [control steps].
    count_from: steps before it count nowhere.

  Returns:
    float (S,).
  """
  found = [
    alarms.score(alarm[count_from : first + horizon, s], first - count_from).latency_steps
    for s, first in enumerate(onset)
  ]
  return np.array([np.inf if k is None else k for k in found], float)


def per_stream(
  latency: np.ndarray, healthy_alarms: np.ndarray, healthy_steps: int, control_s: float
) -> dict[str, np.ndarray]:
  """Every metric that is a mean over streams, as float (S,) by name; nan where undefined.

  Args:
    latency: (S,), inf = missed.
    healthy_alarms: (S,), alarms of the same seeds' healthy streams.
    healthy_steps: steps of each of these.
    control_s: control period [s].
  """
  rate = np.full(len(latency), np.nan)
  if healthy_steps:
    rate = np.asarray(healthy_alarms, float) * (3600.0 / (healthy_steps * control_s))
  missed = ~np.isfinite(latency)
  out = {"miss_probability": missed.astype(float), "false_alarms_per_hour": rate}
  out |= {
    f"detected_within_{x:g}s": (latency < steps_in(x, control_s)).astype(float) for x in WITHIN_S
  }
  late = 1.0 - 0.5 ** (latency * control_s / HALF_S)
  for name, profile in PROFILES.items():
    cost = np.where(missed, profile.miss, late) + profile.false_alarm * HOURS_PER_FAULT * rate
    out[f"cost_{name}"] = 100.0 * (1.0 - cost / profile.miss)
  return out


def auroc(
  faulty: list[np.ndarray], healthy: list[np.ndarray], reps: int = REPS
) -> tuple[float | None, list[float | None] | None]:
  """P(score of a faulty step > score of a healthy step) + P(equal) / 2, pooled over streams, and
  its bootstrap interval over seeds.

    wins[i, j] = faulty steps of seed i that beat healthy steps of seed j;   AUROC = c' wins c / (c'
      n  c' m), c = how often a seed was drawn

  It deceives in four ways. It has no threshold: scores may be ordered well and yet no usable alarm
  exist, or the alarm come late. It has no time: an alarm after 10 s and 10 s of noise equal 10 s of
  moderate scores. It punishes evidence that restarts after an alarm, since the score falls back
  while the fault lasts. Its steps are not independent, so that their number says nothing of its
  error; the interval is over seeds for that.

  Args:
    faulty: scores of each seed, float (steps,), nan left out.
    healthy: likewise.
    reps: bootstrap draws.
  """
  faulty, healthy = ([x[~np.isnan(x)] for x in side] for side in (faulty, healthy))
  sizes = [np.array([len(x) for x in side], float) for side in (faulty, healthy)]
  if not (sizes[0].sum() and sizes[1].sum()):
    return None, None
  # ranks among the sorted healthy scores of each seed; queries in order keep the search in cache
  every = np.concatenate(faulty)
  order = np.argsort(every)
  every, owner = every[order], np.repeat(np.arange(len(faulty)), sizes[0].astype(int))[order]
  wins = np.empty((len(faulty), len(healthy)))
  for j, x in enumerate(healthy):
    x = np.sort(x)
    beaten = np.searchsorted(x, every, "left") + np.searchsorted(x, every, "right")
    wins[:, j] = np.bincount(owner, beaten, len(faulty)) / 2
  value = float(wins.sum() / (sizes[0].sum() * sizes[1].sum()))
  if len(faulty) < 2:
    return value, None
  w = bootstrap.weights(len(faulty), reps)
  pairs = (w @ sizes[0]) * (w @ sizes[1])
  drawn = np.divide(np.sum((w @ wins) * w, 1), pairs, out=np.full(reps, np.nan), where=pairs > 0)
  return value, bootstrap.ends(drawn[None])[0]


def row(
  alarm: ArrayLike,
  score: ArrayLike,
  onset: ArrayLike,
  nominal_alarm: ArrayLike,
  nominal_score: ArrayLike,
  control_s: float,
  count_from: int = 0,
  reps: int = REPS,
  horizon_s: float = HORIZON_S,
) -> dict:
  """All metrics of one detector on one fault: stream s of both recordings is seed s.

  Args:
    alarm: bool (T, S), fired in that step.
    score: float (T, S), nan unknown.
    onset: int (S,) or one for all, first faulty step.
    nominal_alarm: bool (N, S), the same seeds without a fault.
    nominal_score: float (N, S), likewise.
    control_s: [s per control step].
    count_from: steps before it count nowhere, the detector's warm-up.
    reps: bootstrap draws; the same seeds are drawn for every metric.
    horizon_s: a later alarm is no detection [s after onset].

  Returns:
    Flat dict, undefined = None. x_ci = [low, high] at 95 %, an end that falls on a censored time is
    None, the whole None for fewer than two seeds: Wilson for shares, exact Poisson where no false
      alarm came (a bootstrap would have width zero), bootstrap over seeds otherwise. streams;
      latency_median_steps, latency_median_s (None when half or more are missed); miss_probability;
      false_alarms_per_hour; detected_within_{0.5, 1, 5, 20}s, None beyond horizon_s; auroc (scores
      in [onset, onset + horizon_s) against the healthy ones); cost_{standard, few_false,
      few_misses}; stream_latency_steps (S,), stream_healthy_alarms (S,), healthy_steps, control_s:
      what `comparison.overall` computes the means and their intervals from.
  """
  alarm, nominal_alarm = np.asarray(alarm, bool), np.asarray(nominal_alarm, bool)
  score, nominal_score = np.asarray(score), np.asarray(nominal_score)
  streams, horizon = alarm.shape[1], steps_in(horizon_s, control_s)
  onset = np.broadcast_to(np.asarray(onset, int), (streams,))
  _demand(alarm, score, onset, nominal_alarm, nominal_score, horizon, count_from)
  latency = latencies(alarm, onset, horizon, count_from)
  healthy_alarms = nominal_alarm[count_from:].sum(0)
  healthy_steps = len(nominal_alarm) - count_from
  values = per_stream(latency, healthy_alarms, healthy_steps, control_s)
  values |= {f"detected_within_{x:g}s": np.full(streams, np.nan) for x in WITHIN_S if x > horizon_s}
  faulty = [score[k : k + horizon, s] for s, k in enumerate(onset)]
  area, area_ci = auroc(faulty, list(nominal_score[count_from:].T), reps)
  hours = streams * healthy_steps * control_s / 3600.0
  return {
    "streams": streams,
    **_intervals(latency, values, hours, control_s, reps),
    "auroc": area,
    "auroc_ci": area_ci,
    "stream_latency_steps": [int(x) if np.isfinite(x) else None for x in latency],
    "stream_healthy_alarms": [int(x) for x in healthy_alarms],
    "healthy_steps": healthy_steps,
    "control_s": control_s,
  }


def _median(latency: np.ndarray) -> np.ndarray:
  """Median latency of (.., S), inf where half or more are missed."""
  few = 2 * np.isinf(latency).sum(-1) < latency.shape[-1]
  return np.where(few, bootstrap.censored_median(latency), np.inf)


def _intervals(
  latency: np.ndarray, values: dict[str, np.ndarray], hours: float, control_s: float, reps: int
) -> dict[str, Any]:
  """Median latency and means of `values`, by name, with their intervals.

  Args:
    latency: (S,).
    values: of `per_stream`.
    hours: of healthy operation.
    control_s: control period [s].
    reps: bootstrap draws.
  """
  streams, median, median_ci = len(latency), bootstrap.finite(_median(latency)), None
  intervals: dict[str, Any] = dict.fromkeys(values)
  if streams > 1:
    medians = _median(latency[bootstrap.draws(streams, reps)])
    means = np.stack(list(values.values())) @ bootstrap.weights(streams, reps).T
    median_ci, *ends = bootstrap.ends(np.concatenate([medians[None], means]))
    intervals = dict(zip(values, ends))
    for name in SHARES:
      hits = values[name].sum()
      intervals[name] = bootstrap.wilson(round(hits), streams) if np.isfinite(hits) else None
    if hours > 0 and not values["false_alarms_per_hour"].any():
      intervals["false_alarms_per_hour"] = [x / hours for x in bootstrap.poisson(0)]
  seconds = lambda x: None if x is None else x * control_s
  out = {
    "latency_median_steps": median,
    "latency_median_steps_ci": median_ci,
    "latency_median_s": seconds(median),
    "latency_median_s_ci": median_ci and [seconds(x) for x in median_ci],
  }
  for name, x in values.items():
    out |= {name: bootstrap.finite(x.mean()), f"{name}_ci": intervals[name]}
  return out


def _demand(
  alarm: np.ndarray,
  score: np.ndarray,
  onset: np.ndarray,
  nominal_alarm: np.ndarray,
  nominal_score: np.ndarray,
  horizon: int,
  count_from: int,
) -> None:
  """Refuses recordings that would be scored on less than was promised."""
  if (
    alarm.shape != score.shape
    or nominal_alarm.shape != nominal_score.shape
    or alarm.shape[1] != nominal_alarm.shape[1]
  ):
    raise UserError(
      "alarms and scores must be (steps, streams), with one healthy stream for each seed; got "
      f"{alarm.shape}, {score.shape}, healthy {nominal_alarm.shape}, {nominal_score.shape}"
    )
  if onset.min() < count_from or onset.max() + horizon > len(alarm):
    raise UserError(
      f"onsets must lie in [{count_from}, {len(alarm) - horizon}], between warm-up and "
      f"{horizon} steps before the end of the stream; "
      f"got {onset.min()} .. {onset.max()}"
    )
  if len(nominal_alarm) < count_from:
    raise UserError(
      f"the healthy streams end within the warm-up of {count_from} steps; got "
      f"{len(nominal_alarm)} steps"
    )


def arl0(alarm: ArrayLike, count_from: int = 0) -> dict:
  """Average run length to a false alarm on healthy streams, with restarts: steps / alarms.

  Args:
    alarm: bool (T, S).
    count_from: steps before it count nowhere.

  Returns:
    {arl0 [control steps], None without an alarm; arl0_ci: from the exact Poisson interval of the
    number of alarms, which takes alarms as independent, its upper end None without an alarm;
    alarms; few: fewer than 50 of them}.
  """
  alarm = np.asarray(alarm, bool)[count_from:]
  count, steps = int(alarm.sum()), alarm.size
  low, high = bootstrap.poisson(count)
  return {
    "arl0": steps / count if count else None,
    "arl0_ci": [steps / high, steps / low if count else None] if steps else None,
    "alarms": count,
    "few": count < FEW,
  }


def episode_alarm_probability(alarm: ArrayLike, episode: ArrayLike, count_from: int = 0) -> dict:
  """Share of healthy episodes with an alarm.

  Only whole episodes count: those that begin at `count_from` or later and are followed by another
  one.

  Args:
    alarm: bool (T, S).
    episode: int (T, S), number of the episode, constant within it.
    count_from: steps before it count nowhere.

  Returns:
    {episode_alarm_probability, episode_alarm_probability_ci: Wilson over episodes, taken as
    independent; episodes}.
  """
  alarm, episode = np.asarray(alarm, bool), np.asarray(episode)
  hits = n = 0
  for fired, number in zip(alarm.T, episode.T):
    begins = (
      np.flatnonzero(np.diff(number, prepend=number[0] - 1)) if len(number) else np.array([], int)
    )
    begins = begins[begins >= count_from]
    if len(begins) > 1:
      any_alarm = np.logical_or.reduceat(fired, begins)[:-1]
      hits, n = hits + int(any_alarm.sum()), n + len(any_alarm)
  return {
    "episode_alarm_probability": hits / n if n else None,
    "episode_alarm_probability_ci": bootstrap.wilson(hits, n),
    "episodes": n,
  }
