"""E-detector on one residual: evidence of a raised mean whose false alarms are bounded without a
model of the stream.

Where E[z_t | past] <= bound and z_t given the past is sub-Gaussian with `deviation` (E exp(lambda
(z - E z)) <= exp(lambda^2 deviation^2 / 2)), the mean of exp(growth_k) given the past is at most 1.
So E[mean_k M_k at T] <= E[T] for every stopping time T, and E[T] >= exp(threshold) from every
restart, in finite samples, whatever else the stream does: changing variance, skew, dependence.

The condition is on the CONDITIONAL mean. An autocorrelated stream breaks it, as its mean given the
past wanders over the bound: there the alarms come far too often unless the stream is whitened
first. Warm-up errors count too: `bound` leaves room for that of the mean (1 / sqrt(warmup) for
independent samples), `deviation` for that of std and for tails heavier than a Gaussian's.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mjx_cl.detectors.base import Detector, Number, Real, Setting, above, chart, demand, scalar
from mjx_cl.types import Array

FORMS = ("sum", "max")
Bets = Float[Array, "bets"]


def accumulate(evidence: Bets, growth: Bets, form: str) -> tuple[Bets, Number]:
  """One sample of an e-detector for each bet, and their mean.

    sum (Shiryaev-Roberts):  M' = (M + 1) exp(growth)         max (CUSUM):  M' = max(M, 1)
      exp(growth)

  Args:
    evidence: float32 (bets,), ln(M + 1) of form `sum`, ln max(M, 1) of form `max`; 0 is none.
    growth: float32 (bets,), logarithms of factors whose healthy mean is at most 1.
    form: one of FORMS.

  Returns:
    (evidence', ln of the mean of M' over the bets, float32 ()).
  """
  total = evidence + growth
  top = jnp.max(total)
  score = top + jnp.log(jnp.mean(jnp.exp(total - top)))
  floor = jnp.maximum(total, 0.0)
  return (floor + jnp.log(1 + jnp.exp(-jnp.abs(total))) if form == "sum" else floor), score


@scalar
def e_detector(
  threshold: Setting = 9.2104,
  bound: Real = 0.1,
  deviation: Real = 1.0,
  shifts: tuple[Real, ...] = (0.25, 0.5, 1.0, 2.0, 4.0),
  form: str = "sum",
  two_sided: bool = False,
  warmup: int = 1000,
) -> Detector:
  """Bets against "the mean is at most `bound`", one started at every sample, for several sizes of
  shift; the alarm is their total wealth.

    z = (x - mean) / max(std, 1e-6)                     mean, std frozen after `warmup` samples
    growth_k = lambda_k (z - bound) - (lambda_k deviation)^2 / 2,   lambda_k = shifts[k] /
      deviation^2
    sum:  M_k = (M_k + 1) exp(growth_k)     max:  M_k = max(M_k, 1) exp(growth_k)     score = ln
      mean_k M_k
    fired = score > threshold; then all M_k = 0, while mean and std are kept

  E[T] >= exp(threshold) from every restart, where the head of this file's condition holds.

  Args:
    threshold: ln(1 / rate) [nats]; 9.2104 is one false alarm in 10,000 samples at most. May be
      traced.
    bound: largest healthy mean of z [warm-up std].
    deviation: sub-Gaussian deviation of healthy z [warm-up std].
    shifts: means above the bound that the bets are best for [warm-up std].
    form: `sum` (e-SR) or `max` (e-CUSUM); max is never above sum, so the same bound holds for it,
      with slack.
    two_sided: also bets against a mean below -bound, with half of the wealth.
    warmup: samples that fit mean and std; nothing fires before they end [control steps]. 0: the
      stream is standardised already.

  Returns:
    Detector of one number; the score is nan during warm-up.
  Blind to: a fall of the mean, unless two_sided (so for the reward); a shift below `bound`; a
  change of variance alone.
  Source: Shin, Ramdas and Rinaldo 2022, arXiv 2203.03532.
  """
  demand(
    "e_detector",
    threshold=(threshold, above(threshold, -math.inf), "a number"),
    bound=(bound, bound >= 0, "at least 0"),
    deviation=(deviation, deviation > 0, "above 0"),
    shifts=(shifts, len(shifts) > 0 and all(s > 0 for s in shifts), "one or more above 0"),
    form=(form, form in FORMS, "one of sum, max"),
    warmup=(warmup, warmup == 0 or warmup >= 2, "0, or at least 2"),
  )
  size = np.array(shifts, np.float32) / np.float32(deviation) ** 2
  sign = np.repeat(np.array([1, -1] if two_sided else [1], np.float32), len(size))
  size = np.tile(size, len(sign) // len(size))
  price = size * np.float32(bound) + np.square(size * np.float32(deviation)) / 2

  def step(evidence: Bets, z: Number) -> tuple[Bets, Number]:
    return accumulate(evidence, sign * size * z - price, form)

  return chart(lambda: jnp.zeros(len(size)), step, threshold, warmup)
