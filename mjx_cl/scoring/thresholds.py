"""Healthy streams: the threshold for a wanted number of alarms on them, and several of one seed put
together.
"""

import math
from collections.abc import Callable

import numpy as np

TOGETHER = 8  # thresholds counted in one call
ROUNDS = 8  # calls at the most
HIGHEST = 1e9  # threshold above which alarms must have ceased


def refine(
  count: Callable[[np.ndarray], np.ndarray],
  grid: np.ndarray,
  finer: Callable[[dict[float, int]], np.ndarray | None],
  rounds: int = ROUNDS,
) -> dict[float, int]:
  """Alarms at a grid of thresholds and, round by round, at finer ones inside it.

  Args:
    count: thresholds (TOGETHER,) -> alarms (TOGETHER,).
    grid: the first thresholds, at most TOGETHER.
    finer: {threshold: alarms} so far -> the next thresholds; None: enough is known.
    rounds: calls of `count` at the most.

  Returns:
    {threshold: alarms}.
  """
  tried: dict[float, int] = {}
  following: np.ndarray | None = grid
  while following is not None and rounds:
    levels = np.append(following, [following[-1]] * (TOGETHER - len(following)))
    tried |= {float(t): int(c) for t, c in zip(levels, count(levels))}
    following, rounds = finer(tried), rounds - 1
  return tried


def passed(tried: dict[float, int], target: float) -> tuple[float, float]:
  """The highest threshold with more than `target` alarms and the next one above it, infinite where
  there is none.
  """
  under = max((t for t, alarms in tried.items() if alarms > target), default=-math.inf)
  return under, min((t for t in tried if t > under), default=math.inf)


def narrow(
  count: Callable[[np.ndarray], np.ndarray], scores: np.ndarray, target: float
) -> tuple[float, list[tuple[float, int]]]:
  """The least threshold found from which on there are never more than `target` alarms.

  The number of alarms falls with the threshold only on the whole: where a score stays above a low
  threshold it crosses it seldom. So the search comes from above, and a threshold below one with too
  many alarms is none.

  Args:
    count: thresholds (TOGETHER,) -> alarms (TOGETHER,).
    scores: of the healthy streams without restarts, nan unknown.
    target: alarms.

  Returns:
    (threshold, [(threshold, alarms)] of all that were tried); infinity where no score is known, or
    where none was found.
  """
  known = scores[np.isfinite(scores)]
  if not len(known):
    return math.inf, []
  low, top = float(known.min()), float(known.max())
  top += max(abs(top) * 1e-3, 1e-6)

  def finer(tried: dict[float, int]) -> np.ndarray | None:
    under, high = passed(tried, target)
    if high == math.inf or under in tried and tried[under] - tried[high] <= 1:
      return None
    if under == -math.inf:
      under = low if low < high else high - max(1.0, abs(high))
    if high - under <= 1e-6 * max(abs(high), abs(under)):
      return None
    if under >= 0 and high > 8 * under:
      # evidence that grows without restarts leaves the threshold far below the scores
      return np.geomspace(max(under, 1e-4 * high), high, TOGETHER + 2)[1:-1]
    return np.linspace(under, high, TOGETHER + 2)[1:-1]

  shares = 1 - np.geomspace(0.3, 1e-5, TOGETHER - 1)
  tried = refine(count, np.unique(np.append(np.quantile(known, shares), top)), finer)
  under, high = passed(tried, target)
  if under == -math.inf:
    most = max(tried.values())
    high = (min if most else max)(t for t, c in tried.items() if c == most)
  return high, list(tried.items())


def reach(
  few: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Raises thresholds eightfold until each gives few enough alarms, or HIGHEST is passed.

  Args:
    few: thresholds (N,) -> whether their alarms are few enough, bool (N,).
    low: (N,), below the first thresholds.
    high: (N,), the first thresholds.

  Returns:
    (low, high, few at high); a threshold that was raised lies in (low, high].
  """
  while not (known := few(high)).all() and high.max() < HIGHEST:
    low, high = np.where(known, low, high), np.where(known, high, high * 8)
  return low, high, known


def halve(
  few: Callable[[np.ndarray], np.ndarray],
  low: np.ndarray,
  high: np.ndarray,
  middle: Callable[[np.ndarray, np.ndarray], np.ndarray],
  times: int,
) -> np.ndarray:
  """The least thresholds with few enough alarms, (N,), by halving what `reach` gives.

  Args:
    few: see `reach`.
    low: (N,), thresholds with too many alarms.
    high: (N,), thresholds with few enough.
    middle: (low, high) -> what lies half-way, (N,).
    times: halvings.
  """
  for _ in range(times):
    between = middle(low, high)
    known = few(between)
    low, high = np.where(known, low, between), np.where(known, between, high)
  return high


def nearest(tried: list[tuple[float, int]], steps: float, arl0: float) -> float:
  """Of the thresholds that were tried on so many healthy steps the one whose ARL0 is nearest."""
  return min(tried, key=lambda x: abs(math.log(steps / max(0.5, x[1])) - math.log(arl0)))[0]


def seeing(score: np.ndarray, count_from: int) -> np.ndarray:
  """Which streams (S,) of scores (T, S) a detector sees: those with a known score from `count_from`
  on; all where it tells no score at all.

  The latent is kept for a part of the healthy streams. What a detector cannot see is no healthy
  operation without an alarm.
  """
  seen = np.isfinite(score[count_from:]).any(0)
  return seen if seen.any() else np.ones_like(seen)


def by_seed(
  x: np.ndarray, seeds: np.ndarray, count_from: int, seen: np.ndarray | None = None
) -> np.ndarray:
  """Several streams of a seed one after the other, their first `count_from` steps once at the
  front: (steps, seeds).

  Args:
    x: (T, S).
    seeds: (S,).
    count_from: steps of each stream that come once.
    seen: bool (S,), see `seeing`; where it is not true of all, the others are cut into equal
      stretches, one for each seed.
  """
  owners = dict.fromkeys(seeds.tolist())
  if seen is not None and not seen.all():
    rest = x[count_from:, seen].T.reshape(-1)
    each = len(rest) // len(owners)
    front = np.broadcast_to(x[:count_from, :1], (count_from, len(owners)))
    return np.concatenate([front, rest[: each * len(owners)].reshape(len(owners), each).T])
  own = [np.flatnonzero(seeds == seed) for seed in owners]
  return np.stack([np.append(x[:count_from, k[0]], x[count_from:, k].T) for k in own], -1)
