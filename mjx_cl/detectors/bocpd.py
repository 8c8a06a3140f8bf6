"""Bayesian online change point detection on one residual: how long ago did the present level begin?

The restart after an alarm is no change: until `recent` samples have passed it stands in for
r > recent. Run lengths from max_run - 1 on share one cell. What enters it is merged by weighted
mean of the natural parameters, so the cell holds the longest level, and one that joins it from
below replaces it in proportion to its probability. The score is exact until max_run - 1 samples
after a restart; later the older levels are one mixture instead of many. Probabilities are
logarithms, so that the score has no bound that one swing of a gait reaches; samples are cut at
+-1,000 deviations, the score at +-10,000 nats.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mjx_cl.detectors.base import Detector, Number, Real, Setting, above, chart, demand, scalar
from mjx_cl.types import Array

FAR = 1e3  # samples are cut here [warm-up std]
LEAST = -1e4  # log-probability of what no run length stands for [nats]


class Runs(NamedTuple):
  """The posterior of the run length.

  Attributes:
    weight: float32 (max_run,), log-probability of each run length, -inf: impossible.
    mean: float32 (max_run,), posterior location m of each.
    spread: float32 (max_run,), posterior scale b of each.
    tail_kappa: float32 (), the count k of the last cell.
    tail_alpha: float32 (), the shape a of the last cell.
    since: int32 (), samples since the restart.
  """

  weight: jax.Array
  mean: jax.Array
  spread: jax.Array
  tail_kappa: jax.Array
  tail_alpha: jax.Array
  since: jax.Array


class Cells(NamedTuple):
  """What is known in advance of each run length, all but the last.

  Attributes:
    run: int (max_run,), the length.
    kappa: float32 (max_run,), the count k.
    alpha: float32 (max_run,), the shape a.
    gamma: float32 (max_run,), Gamma(a + 1/2) / Gamma(a).
  """

  run: np.ndarray
  kappa: np.ndarray
  alpha: np.ndarray
  gamma: np.ndarray


def cells(max_run: int, kappa: Real, alpha: Real) -> Cells:
  """The table for the prior `kappa`, `alpha`."""
  run = np.arange(max_run)
  gamma = [math.exp(math.lgamma(alpha + r / 2 + 0.5) - math.lgamma(alpha + r / 2)) for r in run]
  return Cells(
    run,
    np.asarray(kappa + run, np.float32),
    np.asarray(alpha + run / 2, np.float32),
    np.array(gamma, np.float32),
  )


def restarted(table: Cells, beta: Real) -> Runs:
  """All mass at r = 0."""
  size = len(table.run)
  return Runs(
    jnp.where(table.run == 0, 0.0, -jnp.inf).astype(jnp.float32),
    jnp.zeros(size),
    jnp.full(size, beta, jnp.float32),
    jnp.float32(table.kappa[-1]),
    jnp.float32(table.alpha[-1]),
    jnp.int32(0),
  )


def gamma_ratio(alpha: Float[Array, "*rows"]) -> Float[Array, "*rows"]:
  """Gamma(alpha + 1/2) / Gamma(alpha) for alpha >= 8, by Stirling's series to 1e-7; a difference of
  two float32 lgamma would lose the digits.
  """
  return jnp.sqrt(alpha) * jnp.exp(-1 / (8 * alpha) + 1 / (192 * alpha**3))


def longer(state: Runs, z: Number, table: Cells, hazard: Real, beta: Real) -> Runs:
  """The posterior with one sample more; what enters the last cell is merged with what was in it."""
  last = len(table.run) - 1
  tail = table.run == last
  k = jnp.where(tail, state.tail_kappa, table.kappa)
  a = jnp.where(tail, state.tail_alpha, table.alpha)
  g = jnp.where(tail, gamma_ratio(state.tail_alpha), table.gamma)
  square = jnp.square(z - state.mean)
  width = 2 * state.spread * (k + 1) / k
  density = jnp.log(g * jax.lax.rsqrt(math.pi * width)) - (a + 0.5) * jnp.log(1 + square / width)

  joint = state.weight + density
  joint = joint - jax.nn.logsumexp(joint)
  since = state.since + 1
  grown = math.log1p(-hazard) + joint
  low, high = grown[last - 1], grown[last]  # both become the last cell
  together = jnp.logaddexp(low, high)
  weight = jnp.concatenate([jnp.full(1, math.log(hazard)), grown[:-1]]).at[last].set(together)
  weight = jnp.where(table.run <= since, weight, -jnp.inf)

  mean = (k * state.mean + z) / (k + 1)
  spread = state.spread + k * square / (2 * (k + 1))
  share = jnp.where(high > -jnp.inf, jnp.exp(low - together), 1.0)
  k_low, k_high = share * (table.kappa[last - 1] + 1), (1 - share) * (state.tail_kappa + 1)
  k_tail = k_low + k_high
  mean_tail = (k_low * mean[last - 1] + k_high * mean[last]) / k_tail
  between = k_low * k_high / k_tail * jnp.square(mean[last - 1] - mean[last])
  spread_tail = share * spread[last - 1] + (1 - share) * spread[last] + between / 2
  a_tail = share * (table.alpha[last - 1] + 0.5) + (1 - share) * (state.tail_alpha + 0.5)
  shift = lambda prior, old, end: jnp.concatenate(
    [jnp.full(1, prior, jnp.float32), old[:-2], end[None]]
  )
  return Runs(
    weight,
    shift(0.0, mean, mean_tail),
    shift(beta, spread, spread_tail),
    k_tail,
    a_tail,
    jnp.minimum(since, 2**30),
  )


def odds(state: Runs, recent: int) -> Number:
  """Ln P(1 <= r <= recent) - ln P(r > recent); the run that the restart began stands on the other
  side.
  """
  near, inside = state.weight[1 : recent + 1], np.arange(1, recent + 1)
  began = jnp.max(jnp.where(inside == state.since, near, -jnp.inf))
  total = lambda x: jnp.maximum(jax.nn.logsumexp(x), LEAST)
  return total(jnp.where(inside < state.since, near, -jnp.inf)) - jnp.logaddexp(
    total(state.weight[recent + 1 :]), began
  )


@scalar
def bocpd(
  threshold: Setting = 1.0,
  hazard: Real = 1e-3,
  recent: int = 50,
  max_run: int = 200,
  kappa: Real = 0.1,
  alpha: Real = 1.0,
  beta: Real = 1.0,
  warmup: int = 1000,
) -> Detector:
  """Posterior of the run length r, the samples since the mean and variance last changed, for
  Gaussian samples; prior normal-inverse-gamma.

    z = x in warm-up deviations;  a new level: variance ~ InvGamma(alpha, beta), mean ~ N(0,
    variance / kappa)
    pi_r = Student-t density of z, 2 a_r degrees, location m_r, scale^2 b_r (k_r + 1) / (a_r k_r)
    P(r+1) ~ (1 - hazard) pi_r P(r),   P(0) ~ hazard sum_r pi_r P(r),   divided by their sum
    m' = (k m + z) / (k + 1),  b' = b + k (z - m)^2 / (2 (k + 1)),  k' = k + 1,  a' = a + 1/2 for
    the longer run
    score = ln P(1 <= r <= recent) - ln P(r > recent), the log odds that the run in force began
    within the last `recent` samples
    fired = score > threshold; then all mass goes to r = 0 and the levels seen are forgotten, while
    the scale z is kept

  Two-sided: a rise, a fall and another variance are new levels alike.

  Args:
    threshold: decision level [nats]; 0 is as likely as not, 1 had one alarm in 15,000 independent
      Gaussian samples. May be traced.
    hazard: prior probability of a change at each sample; acts as a shift of the threshold.
    recent: how new a level must be to count as a change [control steps].
    max_run: cells, longer runs share the last; the cost is proportional to it [control steps].
    kappa: prior samples of the mean; 0.1 expects shifts of some three deviations.
    alpha: shape of the prior of the variance.
    beta: its scale.
    warmup: samples that fit mean and std and that the run length does not count [control steps]; 0:
      the stream is standardised already.
  Blind to: a drift slow against `recent`, which lengthens the run instead. Samples are taken as
  independent and Gaussian: a single outlier counts as a new level at once, and so does one swing of
  a gait.
  Source: Adams and MacKay 2007, arXiv 0710.3742.
  """
  demand(
    "bocpd",
    threshold=(threshold, above(threshold, -math.inf), "a number"),
    hazard=(hazard, 0 < hazard < 1, "between 0 and 1"),
    recent=(recent, recent >= 1, "at least 1"),
    max_run=(max_run, max_run >= max(20, recent + 2), "at least 20 and recent + 2"),
    kappa=(kappa, kappa > 0, "above 0"),
    alpha=(alpha, alpha > 0, "above 0"),
    beta=(beta, beta > 0, "above 0"),
    warmup=(warmup, warmup == 0 or warmup >= 2, "0, or at least 2"),
  )
  table = cells(max_run, kappa, alpha)

  def step(state: Runs, z: Number) -> tuple[Runs, Number]:
    new = longer(state, jnp.clip(z, -FAR, FAR), table, hazard, beta)
    return new, odds(new, recent)

  return chart(lambda: restarted(table, beta), step, threshold, warmup)
