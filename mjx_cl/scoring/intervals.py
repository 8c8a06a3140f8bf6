"""Aggregates with intervals, after rliable's definitions (Agarwal et al. 2021): interquartile mean
and percentile bootstrap.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import special, stats

REPS = 20_000


def iqm(x: ArrayLike, axis: int = -1) -> np.ndarray:
  """Mean of the middle half: floor(n / 4) values are cut at each end (scipy.stats.trim_mean with
  0.25, rliable's IQM).
  """
  x = np.sort(np.asarray(x, float), axis)
  n = x.shape[axis]
  cut = n // 4
  return np.take(x, np.arange(cut, n - cut), axis).mean(axis)


def interval(
  x: ArrayLike, statistic: Callable[..., Any] = iqm, seed: int = 0, level: float = 0.95
) -> list[float] | None:
  """Percentile bootstrap interval of `statistic` over runs.

  Args:
    x: values of the runs (n,); with strata, (n, strata): each column is resampled by itself
      (rliable's stratified bootstrap).
    statistic: called as statistic(values, axis=-1) on (REPS, values).
    seed: of the draws.
    level: of the interval.

  Returns:
    [low, high], or None for fewer than two values.
  """
  x = np.asarray(x, float)
  if len(x) < 2:
    return None
  rows = np.random.default_rng(seed).integers(0, len(x), (REPS,) + x.shape)
  drawn = np.take_along_axis(x[None], rows, 1).reshape(REPS, -1)
  found = statistic(drawn, axis=-1)
  ends = np.quantile(found, [(1 - level) / 2, (1 + level) / 2], method="nearest")
  return [finite(x) for x in ends]  # type: ignore[misc]


@functools.lru_cache(maxsize=64)
def draws(n: int, reps: int, seed: int = 0) -> np.ndarray:
  """Resampled runs of a bootstrap, int (reps, n), read-only. Whatever shares them keeps what its
  numbers have in common within a run.
  """
  index = np.random.default_rng(seed).integers(0, n, (reps, n))
  index.flags.writeable = False
  return index


@functools.lru_cache(maxsize=64)
def weights(n: int, reps: int, seed: int = 0) -> np.ndarray:
  """How often each run is in each of `draws`, over n: float (reps, n), read-only; weights @ values
  are the means of the resampled values.
  """
  counts = np.zeros((reps, n))
  np.add.at(counts, (np.arange(reps)[:, None], draws(n, reps, seed)), 1.0 / n)
  counts.flags.writeable = False
  return counts


def nested(
  groups: list[np.ndarray],
  statistic: Callable[[list[np.ndarray]], ArrayLike],
  reps: int = 10_000,
  seed: int = 0,
) -> np.ndarray:
  """`statistic` of groups drawn with replacement, and of each its runs drawn likewise: a bootstrap
  of agents and then of their seeds; float (reps, k).

  Args:
    groups: of each its runs, (n, ...).
    statistic: groups -> (k,) or ().
    reps: draws.
    seed: of the draws.
  """
  random, out = np.random.default_rng(seed), []
  for _ in range(reps):
    drawn = [groups[k] for k in random.integers(len(groups), size=len(groups))]
    runs = [x[random.integers(len(x), size=len(x))] for x in drawn]
    out.append(np.atleast_1d(np.asarray(statistic(runs), float)))
  return np.array(out)


def ends(statistics: np.ndarray, level: float = 0.95) -> list[list[float | None] | None]:
  """Percentile intervals of several bootstrapped statistics at once.

  Args:
    statistics: float (k, reps). nan: undefined in that draw, left out; inf: a censored time, an end
      that falls on one is None.
    level: of the intervals.

  Returns:
    k times [low, high], None where fewer than half of the draws define the statistic or both ends
    are undefined.
  """
  out: list[list[float | None] | None] = []
  for row in np.sort(np.asarray(statistics, float), -1):  # nan comes last
    known = int(np.sum(~np.isnan(row)))
    pair = [finite(row[round((known - 1) * q)]) for q in ((1 - level) / 2, (1 + level) / 2)]
    out.append(None if 2 * known < len(row) or pair == [None, None] else pair)
  return out


def censored_median(x: ArrayLike, axis: int = -1) -> np.ndarray:
  """Median of times in which a censored run counts as infinite (Kaplan-Meier's median where all are
  censored at the end).
  """
  x = np.sort(np.asarray(x, float), axis)
  return np.take(x, (x.shape[axis] - 1) // 2, axis)


def wilson(hits: int, n: int) -> list[float] | None:
  """Wilson 95 % interval of a proportion; unlike the bootstrap it is not of width zero at 0 or n
  hits.
  """
  return list(_wilson(hits, n)) if n else None


@functools.lru_cache(maxsize=4096)
def _wilson(hits: int, n: int) -> tuple[float, float]:
  low, high = stats.binomtest(hits, n).proportion_ci(method="wilson")
  return float(low), float(high)


def poisson(count: int, level: float = 0.95) -> tuple[float, float]:
  """Exact interval of a Poisson mean after `count` events; below 0 events it begins at 0.

    low: P(N >= count; low) = (1 - level) / 2,  high: P(N <= count; high) = (1 - level) / 2

  Reference: Garwood 1936, Biometrika 28, 437-442.
  """
  tail = (1 - level) / 2
  low = float(special.gammaincinv(count, tail)) if count else 0.0
  return low, float(special.gammaincinv(count + 1, 1 - tail))


def finite(x: float | np.ndarray | None) -> float | None:
  """float, None where undefined or infinite."""
  return float(x) if x is not None and np.isfinite(x) else None
