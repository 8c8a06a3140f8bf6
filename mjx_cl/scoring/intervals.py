"""Aggregates with intervals, after rliable's definitions (Agarwal et al. 2021): interquartile mean
and percentile bootstrap.
"""

from __future__ import annotations

import functools
import math

import numpy as np

REPS = 20_000


def iqm(x: np.ndarray, axis: int = -1) -> np.ndarray:
  """Mean of the middle half: floor(n / 4) values are cut at each end (scipy.stats.trim_mean with
  0.25, rliable's IQM).
  """
  x = np.sort(np.asarray(x, float), axis)
  n = x.shape[axis]
  cut = n // 4
  return np.take(x, np.arange(cut, n - cut), axis).mean(axis)


def interval(x, statistic=iqm, seed: int = 0, level: float = 0.95) -> list[float] | None:
  """Percentile bootstrap interval of `statistic` over runs.

  Args:
    x: values of the runs (n,); with strata, (n, strata): each column is resampled by itself
      (rliable's stratified bootstrap).
    statistic: called as statistic(values, axis=-1) on (REPS, values).

  Returns:
    [low, high], or None for fewer than two values.
  """
  x = np.asarray(x, float)
  if len(x) < 2:
    return None
  rng = np.random.default_rng(seed)
  if x.ndim == 1:
    draws = x[rng.integers(0, len(x), (REPS, len(x)))]
  else:
    rows = rng.integers(0, len(x), (REPS,) + x.shape)
    draws = np.take_along_axis(np.broadcast_to(x, (REPS,) + x.shape), rows, 1).reshape(REPS, -1)
  stats = statistic(draws, axis=-1)
  low, high = np.quantile(stats, [(1 - level) / 2, (1 + level) / 2], method="nearest")
  return [finite(low), finite(high)]


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


def ends(statistics, level: float = 0.95) -> list[list[float | None] | None]:
  """Percentile intervals of several bootstrapped statistics at once.

  Args:
    statistics: float (k, reps). nan: undefined in that draw, left out; inf: a censored time, an end
      that falls on one is None.

  Returns:
    k times [low, high], None where fewer than half of the draws define the statistic or both ends
    are undefined.
  """
  out = []
  for row in np.sort(np.asarray(statistics, float), -1):  # nan comes last
    known = len(row) - int(np.sum(np.isnan(row)))
    pair = (
      [finite(row[int(round((known - 1) * q))]) for q in ((1 - level) / 2, (1 + level) / 2)]
      if 2 * known >= len(row) and known
      else None
    )
    out.append(None if pair in (None, [None, None]) else pair)
  return out


def censored_median(x, axis: int = -1) -> np.ndarray:
  """Median of times in which a censored run counts as infinite (Kaplan-Meier's median where all are
  censored at the end).
  """
  x = np.sort(np.asarray(x, float), axis)
  return np.take(x, (x.shape[axis] - 1) // 2, axis)


def share(x, axis: int = -1) -> np.ndarray:
  """Mean of zeros and ones."""
  return np.mean(np.asarray(x, float), axis)


def wilson(hits: int, n: int) -> list[float] | None:
  """Wilson 95 % interval of a proportion; unlike the bootstrap it is not of width zero at 0 or n
  hits.
  """
  if not n:
    return None
  z, p = 1.959964, hits / n
  middle = (p + z * z / (2 * n)) / (1 + z * z / n)
  half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
  return [max(0.0, middle - half), min(1.0, middle + half)]


def finite(x) -> float | None:
  """float, None where undefined or infinite."""
  return float(x) if x is not None and np.isfinite(x) else None
