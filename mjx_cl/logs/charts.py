"""Control charts on the residuals of `healthy`, and thresholds that reach beyond the nominal log.

Three charts, each of exponentially weighted averages over spans of 5, 25 and 125 samples, as far as
the nominal log has LEAST_BLOCKS of them:

- `level`: |average| of a column's residual against its neighbours, in its healthy deviations: the
  column reads too high or too low. Blind to what changes all columns in their usual relation.
- `spread`: |average| of ln(residual^2 + 0.01), for both predictions: noise, a frozen sensor,
  another way of moving. Blind to a constant offset that is small beside the residual.
- `joint`: Mahalanobis distance of all columns' averages, with the covariance of Ledoit and Wolf
  (2004): many columns a little. Blind to one column among many that moves a little.

A chart's threshold for an average run length follows from the generalised extreme value
distribution of its healthy maxima over blocks, by L-moments (Hosking, Wallis and Wood 1985), with a
tail that is exponential or heavier: so that it may lie above all that the nominal log has shown. A
score is in healthy deviations that n independent averages gave, so its tail is at least that of
Student's t with n degrees of freedom, of shape 1 / n.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy import signal, special

SPANS = (5, 25, 125)  # samples
PAUSE = 32  # samples for which nothing may be known before an average falls back to what is healthy
CHARTS = ("level", "spread", "joint")
LEAST_BLOCKS = 20  # of which maxima are taken, and independent averages that a span needs
HEAVIEST = 0.3  # of the tails that are believed, as shape of the distribution


class Scales(NamedTuple):
  """Healthy means and deviations of the averages.

  Attributes:
    level: (spans, C) deviation of the averages of residuals.
    spread: (2, 2, spans, C) mean and deviation of those of ln(residual^2 + 0.01), of both
      predictions.
    joint: (spans, C, C) inverse covariance of the averages, of one span each.

  Of a span that is not `used` deviations are inf, and inverse covariances 0.
  """

  level: np.ndarray
  spread: np.ndarray
  joint: np.ndarray


def used(rows: int) -> int:
  """How many of SPANS a nominal log of so many rows gives scales of."""
  return max(1, sum(LEAST_BLOCKS * span <= rows for span in SPANS))


def averages(
  x: np.ndarray, start: np.ndarray | float = 0.0, paused: np.ndarray | None = None
) -> Iterator[np.ndarray]:
  """Exponentially weighted averages of x (..., T, C) over each of SPANS, which begin at `start` and
  stand still where x (T, C) is `paused`.
  """
  still = () if paused is None else np.flatnonzero(paused.any(0))
  for span in SPANS:
    rate = 2 / (span + 1)
    begin = np.broadcast_to(start, (*x.shape[:-2], 1, x.shape[-1])) * (1 - rate)
    found = signal.lfilter([rate], [1, rate - 1], x, -2, begin)[0]
    for c in still:
      moving = ~paused[:, c]  # type: ignore[index]
      own = signal.lfilter([rate], [1, rate - 1], x[moving, c], 0, begin[:, c])[0]
      found[:, c] = np.r_[begin[:, c] / (1 - rate), own][np.cumsum(moving)]
    yield found


def _paused(x: np.ndarray) -> np.ndarray | None:
  """Bool (T, C): stretches of nan in x (T, C) of no more than PAUSE rows, but for those that x
  begins with; None where there is none.
  """
  unknown = np.isnan(x)
  some = unknown.any(-1)
  if x.ndim > 2 or not some[int(np.argmin(some)) :].any():
    return None
  rows = np.arange(len(x))[:, None]
  before = np.maximum.accumulate(np.where(unknown, -1, rows), 0)
  after = np.minimum.accumulate(np.where(unknown, len(x), rows)[::-1], 0)[::-1]
  return unknown & (before >= 0) & (after - before <= PAUSE + 1)


def logs(residuals: np.ndarray) -> np.ndarray:
  """What the chart `spread` averages."""
  return np.log(residuals**2 + 0.01)


def _known(x: np.ndarray, otherwise: np.ndarray | float = 0.0) -> np.ndarray:
  return np.where(np.isnan(x), otherwise, x)


def _shrunk(x: np.ndarray) -> np.ndarray:
  """Covariance of x (N, C) shrunk towards a multiple of the identity, Ledoit and Wolf (2004),
  equation 14, with every SPANS[-1]-th row counted as independent.
  """
  rows, columns = x.shape
  covariance = x.T @ x / rows
  level = np.trace(covariance) / columns
  distance = ((covariance - level * np.eye(columns)) ** 2).sum()
  error = max(0.0, ((x**2).sum(1) ** 2).mean() - (covariance**2).sum())
  share = min(1.0, error / max(1.0, rows / SPANS[-1]) / max(distance, 1e-300))
  return share * level * np.eye(columns) + (1 - share) * covariance


def scales(residuals: np.ndarray) -> Scales:
  """Of the nominal log's residuals (2, N, C); at nan averages stand still, then count it as neither
  high nor low.
  """
  level, joint = [], []
  for average in averages(_known(residuals[0]), 0.0, _paused(residuals[0])):
    level.append(average.std(0))
    joint.append(np.linalg.inv(_shrunk(average)))
  spread = []
  for energy in logs(residuals):
    middle = np.nanmean(energy, 0, keepdims=True)
    energies = averages(_known(energy, middle), middle, _paused(energy))
    spread.append([(x.mean(0), x.std(0)) for x in energies])
  mean, deviation = np.moveaxis(np.array(spread), 2, 0)
  found = Scales(
    np.maximum(level, 1e-9), np.stack([mean, np.maximum(deviation, 1e-9)]), np.stack(joint)
  )
  few = slice(used(residuals.shape[1]), None)
  found.level[few], found.spread[1, :, few], found.joint[few] = np.inf, np.inf, 0.0
  return found


def scores(residuals: np.ndarray, own: Scales) -> dict[str, np.ndarray]:
  """Chart -> (..., T, C), of `joint` (..., T, 1), for residuals (2, ..., T, C)."""
  shape = residuals.shape[1:]
  level, spread, joint = np.zeros(shape), np.zeros(shape), np.zeros(shape[:-1])
  level_of = averages(_known(residuals[0]), 0.0, _paused(residuals[0]))
  for x, deviation, inverse in zip(level_of, own.level, own.joint):
    joint = np.maximum(joint, ((x @ inverse) * x).sum(-1))
    level = np.maximum(level, np.abs(x / deviation))
  for energy, means, deviations in zip(logs(residuals), *own.spread):
    energies = averages(_known(energy, means[-1]), means[-1], _paused(energy))
    for x, mean, deviation in zip(energies, means, deviations):
      spread = np.maximum(spread, np.abs((x - mean) / deviation))
  return {"level": level, "spread": spread, "joint": np.sqrt(joint)[..., None]}


class Tail(NamedTuple):
  """Distribution of a healthy score's maximum over a block, one for each column: generalised
  extreme value, P(M <= x) = exp(-(1 + shape (x - middle) / width)^(-1 / shape)).

  Attributes:
    middle: (C,).
    width: (C,).
    shape: (C,) up to HEAVIEST.
    block: samples.
  """

  middle: np.ndarray
  width: np.ndarray
  shape: np.ndarray
  block: int

  def threshold(self, arl0: float) -> np.ndarray:
    """(C,) that all columns together exceed in one of `arl0` samples on average."""
    rate = min(0.5, self.block / (arl0 * len(self.middle)))
    y = -np.log(-np.log1p(-rate))  # the standard Gumbel's quantile
    small = self.shape < 1e-6
    shape = np.where(small, 1.0, self.shape)
    return self.middle + self.width * np.where(small, y, np.expm1(shape * y) / shape)

  def expected(self, score: np.ndarray, samples: int) -> np.ndarray:
    """How many blocks of `samples` healthy ones would exceed a score in some column; score
    (..., C).
    """
    z = (np.asarray(score) - self.middle) / self.width
    small = self.shape < 1e-6
    shape = np.where(small, 1.0, self.shape)
    inner = np.maximum(1 + shape * z, 1e-300)
    with np.errstate(over="ignore"):
      rate = -np.expm1(-np.where(small, np.exp(-z), inner ** (-1 / shape)))
    rate = np.where(~small & (1 + self.shape * z <= 0), 1.0, rate)
    return rate * len(self.middle) * samples / self.block


def tail(score: np.ndarray) -> Tail:
  """Of a healthy score (N, C)."""
  longest = SPANS[used(len(score)) - 1]
  block = max(1, min(longest, len(score) // LEAST_BLOCKS))
  usable = len(score) // block * block
  maxima = np.sort(score[:usable].reshape(-1, block, score.shape[1]).max(1), 0)
  n = len(maxima)
  at = np.arange(n)[:, None]
  first, second = maxima.mean(0), (at / (n - 1) * maxima).mean(0)
  third = (at * (at - 1) / ((n - 1) * (n - 2)) * maxima).mean(0)
  l2 = np.maximum(2 * second - first, 1e-9)
  c = l2 / np.where(np.abs(3 * third - first) < 1e-12, 1e-12, 3 * third - first)
  c = c - np.log(2) / np.log(3)
  k = -(
    7.8590 * c + 2.9554 * c**2
  )  # Hosking, Wallis and Wood (1985), equation 14; theirs is -shape
  shape = np.clip(k, min(HEAVIEST, longest / len(score)), HEAVIEST)
  small = shape < 1e-6
  safe = np.where(small, 0.1, shape)
  gamma = special.gamma(1 - safe)
  width = np.where(small, l2 / np.log(2), l2 * safe / (gamma * np.expm1(safe * np.log(2))))
  middle = first - np.where(small, np.euler_gamma * width, width * (gamma - 1) / safe)
  return Tail(middle, width, shape, block)


def alarms(score: np.ndarray, threshold: np.ndarray) -> np.ndarray:
  """Bool (T, C): samples at which a score rises above its threshold."""
  above = score > threshold
  return above & ~np.concatenate([np.zeros((1, above.shape[1]), bool), above[:-1]])
