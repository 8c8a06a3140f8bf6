"""Healthy streams: the threshold for a wanted number of alarms on them, and several of one seed put
together.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

TOGETHER = 8  # thresholds counted in one call
ROUNDS = 8  # calls at the most


def narrow(
  count: Callable[[np.ndarray], np.ndarray], scores: np.ndarray, target: float
) -> tuple[float, list[tuple[float, int]]]:
  """The least threshold found from which on there are never more than `target` alarms.

  The number of alarms falls with the threshold only on the whole: where a score stays above a low
  threshold it crosses it seldom. So the search comes from above, and a threshold below one with too
  many alarms is none.

  Args:
    count: thresholds (TOGETHER,) -> alarms (TOGETHER,). scores: of the healthy streams without
      restarts, nan unknown. target: alarms.

  Returns:
    (threshold, [(threshold, alarms)] of all that were tried); infinity where no score is known, or
    where none was found.
  """
  known = scores[np.isfinite(scores)]
  if not len(known):
    return math.inf, []
  top = float(known.max())
  top += max(abs(top) * 1e-3, 1e-6)
  grid = np.unique(np.append(np.quantile(known, 1 - np.geomspace(0.3, 1e-5, TOGETHER - 1)), top))
  tried: dict[float, int]
  low, high, tried = float(known.min()), math.inf, {}
  for _ in range(ROUNDS):
    grid = np.append(grid, [grid[-1]] * (TOGETHER - len(grid)))
    tried |= {float(t): int(c) for t, c in zip(grid, count(grid))}
    bad = [t for t, c in tried.items() if c > target]
    good = [t for t in tried if not bad or t > max(bad)]
    if not good:
      return math.inf, list(tried.items())
    high = min(good)
    under = max(bad) if bad else low if low < high else high - max(1.0, abs(high))
    if high - under <= 1e-6 * max(abs(high), abs(under)) or bad and tried[under] - tried[high] <= 1:
      break
    if (
      under >= 0 and high > 8 * under
    ):  # evidence that grows without restarts leaves the threshold far below the scores
      grid = np.geomspace(max(under, 1e-4 * high), high, TOGETHER + 2)[1:-1]
    else:
      grid = np.linspace(under, high, TOGETHER + 2)[1:-1]
  if not bad:
    most = max(tried.values())
    high = (min if most else max)(t for t, c in tried.items() if c == most)
  return high, list(tried.items())


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
    x: (T, S). seeds: (S,). seen: bool (S,), see `seeing`; where it is not true of all, the others
      are cut into equal stretches, one for each seed.
  """
  owners = dict.fromkeys(seeds.tolist())
  if seen is not None and not seen.all():
    rest = x[count_from:, seen].T.reshape(-1)
    each = len(rest) // len(owners)
    return np.concatenate(
      [
        np.broadcast_to(x[:count_from, :1], (count_from, len(owners))),
        rest[: each * len(owners)].reshape(len(owners), each).T,
      ]
    )
  columns = []
  for seed in owners:
    own = np.flatnonzero(seeds == seed)
    columns.append(np.concatenate([x[:count_from, own[0]]] + [x[count_from:, k] for k in own]))
  return np.stack(columns, -1)
