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

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import special, stats

from mjx_cl.errors import UserError
from mjx_cl.scoring import alarms
from mjx_cl.scoring import intervals as bootstrap

if TYPE_CHECKING:
  from numpy.typing import ArrayLike

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
  """Attributes:
  miss: cost of a missed fault. false_alarm: cost of one false alarm. Both in units of an utterly
  late detection.
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
    alarm: bool (T, S). onset: int (S,). horizon: [control steps]. count_from: steps before it count
      nowhere.

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
    latency: (S,), inf = missed. healthy_alarms: (S,), alarms of the same seeds' healthy streams.
      healthy_steps: steps of each of these.
  """
  rate = (
    np.asarray(healthy_alarms, float) * (3600.0 / (healthy_steps * control_s))
    if healthy_steps
    else np.full(len(latency), np.nan)
  )
  missed = ~np.isfinite(latency)
  out = {"miss_probability": missed.astype(float), "false_alarms_per_hour": rate}
  for x in WITHIN_S:
    out[f"detected_within_{x:g}s"] = (latency < steps_in(x, control_s)).astype(float)
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
    faulty, healthy: scores of each seed, float (steps,), nan left out.
  """
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
    wins[:, j] = (
      np.bincount(
        owner, np.searchsorted(x, every, "left") + np.searchsorted(x, every, "right"), len(faulty)
      )
      / 2
    )
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
    alarm: bool (T, S), fired in that step. score: float (T, S), nan unknown. onset: int (S,) or one
      for all, first faulty step.
    nominal_alarm, nominal_score: (N, S), the same seeds without a fault. control_s: [s per control
      step].
    count_from: steps before it count nowhere, the detector's warm-up.
    reps: bootstrap draws; the same seeds are drawn for every metric. horizon_s: a later alarm is no
      detection [s after onset].

  Returns:
    Flat dict, undefined = None. x_ci = [low, high] at 95 %, an end that falls on a censored time is
    None, the whole None for fewer than two seeds: Wilson for shares, exact Poisson where no false
      alarm came (a bootstrap would have width zero), bootstrap over seeds otherwise. streams;
      latency_median_steps, latency_median_s (None when half or more are missed); miss_probability;
      false_alarms_per_hour; detected_within_{0.5, 1, 5, 20}s, None beyond horizon_s; auroc (scores
      in [onset, onset + horizon_s) against the healthy ones); cost_{standard, few_false,
      few_misses}; stream_latency_steps (S,), stream_healthy_alarms (S,), healthy_steps, control_s:
      what `overall` computes the means and their intervals from.
  """
  alarm, nominal_alarm, score, nominal_score = (
    np.asarray(alarm, bool),
    np.asarray(nominal_alarm, bool),
    np.asarray(score),
    np.asarray(nominal_score),
  )
  streams, horizon = alarm.shape[1], steps_in(horizon_s, control_s)
  onset = np.broadcast_to(np.asarray(onset, int), (streams,))
  _demand(alarm, score, onset, nominal_alarm, nominal_score, horizon, count_from)
  latency, healthy_alarms = (
    latencies(alarm, onset, horizon, count_from),
    nominal_alarm[count_from:].sum(0),
  )
  healthy_steps = len(nominal_alarm) - count_from
  values = per_stream(latency, healthy_alarms, healthy_steps, control_s)
  values |= {f"detected_within_{x:g}s": np.full(streams, np.nan) for x in WITHIN_S if x > horizon_s}
  missed = int(values["miss_probability"].sum())
  median = float(bootstrap.censored_median(latency)) if 2 * missed < streams else None
  known = lambda x: x[~np.isnan(x)]
  area, area_ci = auroc(
    [known(score[k : k + horizon, s]) for s, k in enumerate(onset)],
    [known(x) for x in nominal_score[count_from:].T],
    reps,
  )

  intervals: dict[str, list | None] = dict.fromkeys(values)
  median_ci = None
  if streams > 1:
    drawn = latency[bootstrap.draws(streams, reps)]
    medians = np.where(
      2 * np.isinf(drawn).sum(-1) < streams, bootstrap.censored_median(drawn), np.inf
    )
    means = np.stack(list(values.values())) @ bootstrap.weights(streams, reps).T
    median_ci, *ends = bootstrap.ends(np.concatenate([medians[None], means]))
    intervals = dict(zip(values, ends))
    for name in SHARES:
      intervals[name] = (
        bootstrap.wilson(int(round(values[name].sum())), streams)
        if np.isfinite(values[name]).all()
        else None
      )
    if healthy_steps > 0 and not healthy_alarms.sum():
      hours = streams * healthy_steps * control_s / 3600.0
      intervals["false_alarms_per_hour"] = [x / hours for x in bootstrap.poisson(0)]

  out = {
    "streams": streams,
    "latency_median_steps": median,
    "latency_median_steps_ci": median_ci,
    "latency_median_s": _scaled(median, control_s),
    "latency_median_s_ci": median_ci and [_scaled(x, control_s) for x in median_ci],
  }
  for name, x in values.items():
    out |= {name: bootstrap.finite(x.mean()), f"{name}_ci": intervals[name]}
  return out | {
    "auroc": area,
    "auroc_ci": area_ci,
    "stream_latency_steps": [int(x) if np.isfinite(x) else None for x in latency],
    "stream_healthy_alarms": [int(x) for x in healthy_alarms],
    "healthy_steps": healthy_steps,
    "control_s": control_s,
  }


def _scaled(x: float | None, by: float) -> float | None:
  return None if x is None else x * by


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
    alarm: bool (T, S). count_from: steps before it count nowhere.

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
    alarm: bool (T, S). episode: int (T, S), number of the episode, constant within it. count_from:
      steps before it count nowhere.

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


class Overall(NamedTuple):
  """Attributes:
  rows: a dict for each detector, best `cost_standard` first.
  critical_difference: mean ranks further apart differ at 5 % (Nemenyi); None for fewer than two
  detectors or blocks. friedman_p: chance of ranks this uneven if all detectors were alike
  (Friedman's chi-square, ties corrected). blocks: robot x fault x severity in which every detector
  has a score; ranks are over these.
  """

  rows: list[dict]
  critical_difference: float | None
  friedman_p: float | None
  blocks: int


def overall(rows: list[dict], reps: int = REPS) -> Overall:
  """Means of each detector over all of its robots x faults x severities, equal weight for each, and
  ranks.

    mean rank: rank by cost_standard within a block, 1 = best, ties share; critical difference = q
    sqrt(k (k + 1) / (6 n)), q = studentised range / sqrt(2), k detectors, n blocks; what a row
    calls a reference takes no rank and makes none

  Intervals: bootstrap over seeds, stratified by robot. The faults of one robot share their seeds'
  healthy streams, so a seed is drawn with all of its faults; a share of 0 or 1 and a rate of 0 have
  Wilson's and Poisson's over the seeds of all robots. They say how far another set of seeds would
  move the mean on these faults, not what other faults would do. Blocks that share seeds are not
  independent either: the critical difference is somewhat too small.

  Args:
    rows: of `row`, with detector, robot, fault, severity, and perhaps reference.

  Returns:
    Overall; each row has detector, blocks, and for every mean over streams its value and its _ci,
    None where any of its rows has none; mean_rank.
  Reference: Demsar 2006, Journal of Machine Learning Research 7, 1-30.
  """
  table: dict[str, dict[tuple, dict]] = {}
  for r in rows:
    block = (r["robot"], r["fault"], r["severity"])
    if block in table.setdefault(r["detector"], {}):
      raise UserError(f"two rows of detector {r['detector']!r} on {block}")
    table[r["detector"]][block] = r
  out = [
    {"detector": name, "blocks": len(mine)} | _means(list(mine.values()), reps)
    for name, mine in table.items()
  ]
  rivals = {name: t for name, t in table.items() if not any(r.get("reference") for r in t.values())}
  shared = [
    b
    for b in (next(iter(rivals.values())) if rivals else ())
    if all(b in t and t[b]["cost_standard"] is not None for t in rivals.values())
  ]
  ranks = stats.rankdata(
    [[-t[b]["cost_standard"] for t in rivals.values()] for b in shared], axis=-1
  )
  mean = dict(zip(rivals, ranks.mean(0))) if len(shared) else {}
  for r in out:
    r["mean_rank"] = bootstrap.finite(mean.get(r["detector"]))
  out.sort(
    key=lambda r: -np.inf if r["cost_standard"] is None else r["cost_standard"], reverse=True
  )
  n, k = len(shared), len(rivals)
  if n < 2 or k < 2:
    return Overall(out, None, None, n)
  spread = (ranks - (k + 1) / 2).sum(0)
  within = ((ranks - (k + 1) / 2) ** 2).sum() / (k - 1)
  p = float(special.chdtrc(k - 1, (spread**2).sum() / within)) if within else 1.0
  q = float(stats.studentized_range.ppf(0.95, k, np.inf)) / 2**0.5
  return Overall(out, q * (k * (k + 1) / (6 * n)) ** 0.5, p, n)


def difference(
  rows: list[dict], first: str, second: str, measure: str = "cost_standard", reps: int = REPS
) -> tuple[float, list[float | None] | None]:
  """How far detector `first` lies above `second` in the mean over all robots x faults x severities,
  and its 95 % interval.

  Paired: both detectors saw the same streams, and a drawn seed counts for both with all of its
  faults (`overall`).

  Args:
    rows: as `overall` takes them. measure: one of its means over streams.

  Returns:
    (mean difference, [low, high]).

  Raises:
    UserError where the two were not scored on the same faults, or rows lack their streams.
  """
  mine = [
    {(r["robot"], r["fault"], r["severity"]): r for r in rows if r["detector"] == name}
    for name in (first, second)
  ]
  if mine[0].keys() != mine[1].keys() or not mine[0]:
    raise UserError(
      f"detectors {first!r} and {second!r} must be scored on the same faults; got "
      f"{len(mine[0])} and {len(mine[1])} rows"
    )
  names, (one, other) = (
    list(per_stream(np.zeros(1), np.zeros(1), 1, 1.0)),
    [_drawn(list(own.values()), reps) for own in mine],
  )
  if one is None or other is None:
    raise UserError(f"detectors {first!r} and {second!r}: the rows hold no streams to draw from")
  k = names.index(measure)
  value = float(
    np.mean([r[measure] for r in mine[0].values()])
    - np.mean([r[measure] for r in mine[1].values()])
  )
  return value, bootstrap.ends((one - other)[k : k + 1])[0]


def _drawn(rows: list[dict], reps: int) -> np.ndarray | None:
  """Means over one detector's rows on seeds drawn anew, float (measures of per_stream, reps), the
  same draw for every detector; None without streams.
  """
  drawn: Any  # a number until the first robot is added
  strata: dict[str, list[dict]]
  drawn, strata = 0.0, {}
  for r in rows:
    strata.setdefault(r["robot"], []).append(r)
  if not all("stream_latency_steps" in r and r["streams"] > 1 for r in rows):
    return None
  for seed, (robot, mine) in enumerate(sorted(strata.items())):
    if len({r["streams"] for r in mine}) > 1:
      raise UserError(
        f"the faults of robot {robot!r} must have the same seeds; got "
        f"{sorted({r['streams'] for r in mine})} streams"
      )
    sums: Any = 0.0
    for r in mine:
      latency = np.array([np.inf if x is None else x for x in r["stream_latency_steps"]], float)
      sums = sums + np.stack(
        list(
          per_stream(
            latency, np.array(r["stream_healthy_alarms"]), r["healthy_steps"], r["control_s"]
          ).values()
        )
      )
    drawn = drawn + sums @ bootstrap.weights(sums.shape[1], reps, seed).T / len(rows)
  return drawn


def _means(rows: list[dict], reps: int) -> dict:
  """Means over rows of one detector, and their intervals from the rows' streams."""
  names, drawn = list(per_stream(np.zeros(1), np.zeros(1), 1, 1.0)), _drawn(rows, reps)
  enough = drawn is not None
  strata = {r["robot"]: r for r in rows}
  ends = bootstrap.ends(drawn) if enough else [None] * len(names)  # type: ignore[arg-type]
  seeds = sum(r["streams"] for r in strata.values())
  out: dict[str, Any] = {}
  interval: list[float | None] | list[float] | None
  for name, interval in zip(names, ends):
    value = (
      float(np.mean([r[name] for r in rows])) if all(r[name] is not None for r in rows) else None
    )
    if enough and name in SHARES and value in (0.0, 1.0):
      interval = bootstrap.wilson(int(value) * seeds, seeds)
    elif enough and name == "false_alarms_per_hour" and value == 0:
      hours = (
        sum(r["streams"] * r["healthy_steps"] * r["control_s"] for r in strata.values()) / 3600.0
      )
      interval = [x / hours for x in bootstrap.poisson(0)]
    out |= {name: value, f"{name}_ci": None if value is None else interval}
  return out
