"""Detectors against each other: means over all faults of all robots, ranks, paired differences."""

from typing import Any, NamedTuple

import numpy as np
from scipy import special, stats

from mjx_cl.errors import UserError
from mjx_cl.scoring import intervals as bootstrap
from mjx_cl.scoring.metrics import REPS, SHARES, per_stream

COSTLY = 0.1  # of the reward; a fault that takes so much from a robot that does not adapt is costly
# every metric that is a mean over streams
MEASURES = tuple(per_stream(np.zeros(1), np.zeros(1), 1, 1.0))


class Overall(NamedTuple):
  """Detectors against each other.

  Attributes:
    rows: a dict for each detector, best `cost_standard` first.
    critical_difference: mean ranks further apart differ at 5 %; None for fewer than two detectors
      or blocks.
    friedman_p: chance of ranks this uneven if all detectors were alike (Friedman's chi-square, ties
      corrected, blocks taken as independent).
    blocks: robot x fault x severity in which every detector has a score; ranks are over these.
  """

  rows: list[dict]
  critical_difference: float | None
  friedman_p: float | None
  blocks: int


def overall(rows: list[dict], reps: int = REPS) -> Overall:
  """Means of each detector over all of its robots x faults x severities, equal weight for each, and
  ranks.

    mean rank: rank by cost_standard within a block, 1 = best, ties share; critical difference: the
    95 % point, over seeds drawn anew, of how far apart two detectors' mean ranks move, or Nemenyi's
    where that is larger: q sqrt(k (k + 1) / (6 n)), q = studentised range / sqrt(2), k detectors, n
    blocks; what a row calls a reference takes no rank and makes none

  Intervals: bootstrap over seeds, stratified by robot. The faults of one robot share their seeds'
  healthy streams, so a seed is drawn with all of its faults; a share of 0 or 1 and a rate of 0 have
  Wilson's and Poisson's over the seeds of all robots. They say how far another set of seeds would
  move the mean on these faults, not what other faults would do. Nemenyi's difference takes
  blocks as independent, which those of one robot are not: an alarm on a healthy stream moves all.

  Args:
    rows: of metrics.row, with detector, robot, fault, severity, and perhaps reference.
    reps: bootstrap draws.

  Returns:
    Overall; each row has detector, blocks, and for every mean over streams its value and its _ci,
    None where any of its rows has none; mean_rank; cost_costly, cost_costly_ci and blocks_costly:
    cost_standard over the rows whose `reward_lost` is COSTLY or more.
  Reference: Demsar 2006, Journal of Machine Learning Research 7, 1-30.
  """
  table: dict[str, dict[tuple, dict]] = {}
  for r in rows:
    own = table.setdefault(r["detector"], {})
    if _block(r) in own:
      raise UserError(f"two rows of detector {r['detector']!r} on {_block(r)}")
    own[_block(r)] = r
  rivals = {name: t for name, t in table.items() if not any(r.get("reference") for r in t.values())}
  blocks = next(iter(rivals.values()), {})
  scored = lambda t, b: b in t and t[b]["cost_standard"] is not None
  shared = [b for b in blocks if all(scored(t, b) for t in rivals.values())]
  scores = np.array([[t[b]["cost_standard"] for t in rivals.values()] for b in shared], float)
  ranks, critical, p = ranked(scores.reshape(len(shared), len(rivals)))
  if critical is not None:
    by_block = [[t[b] for b in shared] for t in rivals.values()]
    critical = max(critical, _spread(by_block, ranks, reps))
  mean = dict(zip(rivals, ranks))
  out = [
    {"detector": name, "blocks": len(own)}
    | _means(list(own.values()), reps)
    | _costly(list(own.values()), reps)
    | {"mean_rank": bootstrap.finite(mean.get(name))}
    for name, own in table.items()
  ]
  worst_if_none = lambda r: -np.inf if r["cost_standard"] is None else r["cost_standard"]
  out.sort(key=worst_if_none, reverse=True)
  return Overall(out, critical, p, len(shared))


def ranked(scores: np.ndarray) -> tuple[np.ndarray, float | None, float | None]:
  """Mean ranks of rivals, 1 = best, ties share; Nemenyi's critical difference of two of them at 5
  %, and Friedman's chance of ranks this uneven, as in `overall`.

  Args:
    scores: (blocks, rivals), more is better.

  Returns:
    (ranks, difference, chance); no ranks without a block, None for fewer than two blocks or rivals.
  """
  n, k = scores.shape
  if not n:
    return np.array([]), None, None
  ranks = stats.rankdata(-scores, axis=-1)
  if n < 2 or k < 2:
    return ranks.mean(0), None, None
  spread = (ranks - (k + 1) / 2).sum(0)
  within = ((ranks - (k + 1) / 2) ** 2).sum() / (k - 1)
  p = float(special.chdtrc(k - 1, (spread**2).sum() / within)) if within else 1.0
  q = float(stats.studentized_range.ppf(0.95, k, np.inf)) / 2**0.5
  return ranks.mean(0), q * (k * (k + 1) / (6 * n)) ** 0.5, p


def _block(row: dict) -> tuple[str, str, float]:
  return row["robot"], row["fault"], row["severity"]


def difference(
  rows: list[dict], first: str, second: str, measure: str = "cost_standard", reps: int = REPS
) -> tuple[float, list[float | None] | None]:
  """How far detector `first` lies above `second` in the mean over all robots x faults x severities,
  and its 95 % interval.

  Paired: both detectors saw the same streams, and a drawn seed counts for both with all of its
  faults (`overall`).

  Args:
    rows: as `overall` takes them.
    first: name of a detector.
    second: of another.
    measure: one of the means over streams.
    reps: bootstrap draws.

  Returns:
    (mean difference, [low, high]).

  Raises:
    UserError where the two were not scored on the same faults, or rows lack their streams.
  """
  one, other = ({_block(r): r for r in rows if r["detector"] == n} for n in (first, second))
  if one.keys() != other.keys() or not one:
    raise UserError(
      f"detectors {first!r} and {second!r} must be scored on the same faults; got "
      f"{len(one)} and {len(other)} rows"
    )
  drawn = [_drawn(list(own.values()), reps) for own in (one, other)]
  if drawn[0] is None or drawn[1] is None:
    raise UserError(f"detectors {first!r} and {second!r}: the rows hold no streams to draw from")
  k = MEASURES.index(measure)
  values = [[r[measure] for r in own.values()] for own in (one, other)]
  if any(None in own for own in values):
    raise UserError(f"{measure} is not known of every fault of {first!r} and {second!r}")
  means = [np.mean(own) for own in values]
  return float(means[0] - means[1]), bootstrap.ends((drawn[0] - drawn[1])[k : k + 1])[0]


def _drawn(rows: list[dict], reps: int) -> np.ndarray | None:
  """Means over one detector's rows on seeds drawn anew, float (MEASURES, reps), the same draw for
  every detector; None without streams.
  """
  if not all("stream_latency_steps" in r and r["streams"] > 1 for r in rows):
    return None
  strata: dict[str, list[dict]] = {}
  for r in rows:
    strata.setdefault(r["robot"], []).append(r)
  drawn: Any = 0.0  # a number until the first robot is added
  for seed, (robot, mine) in enumerate(sorted(strata.items())):
    streams = sorted({r["streams"] for r in mine})
    if len(streams) > 1:
      raise UserError(
        f"the faults of robot {robot!r} must have the same seeds; got {streams} streams"
      )
    sums: Any = sum(map(_values, mine))
    drawn = drawn + sums @ bootstrap.weights(sums.shape[1], reps, seed).T / len(rows)
  return drawn


def _spread(rows: list[list[dict]], seen: np.ndarray, reps: int) -> float:
  """95 % point, over seeds drawn anew, of the most that two mean ranks move against each other from
  those `seen`; rows of each rival by block. 0 without streams.
  """
  every = [r for own in rows for r in own]
  if not all("stream_latency_steps" in r and r["streams"] > 1 for r in every):
    return 0.0
  robots = {robot: seed for seed, robot in enumerate(sorted({r["robot"] for r in every}))}
  k, ranks = MEASURES.index("cost_standard"), np.zeros((reps, len(rows)))
  for block in zip(*rows):
    drawn = bootstrap.weights(block[0]["streams"], reps, robots[block[0]["robot"]])
    scores = np.stack([drawn @ _values(r)[k] for r in block], -1)
    ranks += stats.rankdata(-scores.round(9), axis=-1) / len(rows[0])  # ties are ties
  return float(np.quantile(np.ptp(ranks - seen, -1), 0.95))


def _values(row: dict) -> np.ndarray:
  """Every measure of each stream of a row, float (MEASURES, S)."""
  latency = [np.inf if x is None else x for x in row["stream_latency_steps"]]
  values = per_stream(
    np.array(latency, float),
    np.array(row["stream_healthy_alarms"]),
    row["healthy_steps"],
    row["control_s"],
  )
  return np.stack(list(values.values()))


def _costly(rows: list[dict], reps: int) -> dict[str, Any]:
  """The cost score over faults that cost the robot something."""
  costly = [r for r in rows if (r.get("reward_lost") or 0.0) >= COSTLY]
  found = _means(costly, reps) if costly else {}
  ends = {"cost_costly" + end: found.get("cost_standard" + end) for end in ("", "_ci")}
  return ends | {"blocks_costly": len(costly)}


def _means(rows: list[dict], reps: int) -> dict:
  """Means over rows of one detector, and their intervals from the rows' streams."""
  drawn = _drawn(rows, reps)
  ends = [None] * len(MEASURES) if drawn is None else bootstrap.ends(drawn)
  strata = {r["robot"]: r for r in rows}.values()
  out: dict[str, Any] = {}
  for name, pair in zip(MEASURES, ends):
    interval: Any = pair
    values = [r[name] for r in rows]
    value = None if None in values else float(np.mean(values))
    if drawn is not None and name in SHARES and value in (0.0, 1.0):
      seeds = sum(r["streams"] for r in strata)
      interval = bootstrap.wilson(int(value) * seeds, seeds)
    elif drawn is not None and name == "false_alarms_per_hour" and value == 0:
      steps = sum(r["streams"] * r["healthy_steps"] * r["control_s"] for r in strata)
      interval = [x / (steps / 3600.0) for x in bootstrap.poisson(0)]
    out |= {name: value, f"{name}_ci": None if value is None else interval}
  return out
