"""E-detector on one residual: evidence of a raised mean whose false alarms are bounded without a
model of the stream.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.detectors.base import Alarm, Detector, Warm, above, cold, demand, scalar, standardise

FORMS = ("sum", "max")


class EDetectorState(NamedTuple):
  """Attributes:
  warm: scale of the stream. evidence: float32 (bets,), ln(M + 1) of form `sum`, ln max(M, 1) of
  form `max`; 0 is none.
  """

  warm: Warm
  evidence: jax.Array


def accumulate(evidence: jax.Array, growth: jax.Array, form: str) -> tuple[jax.Array, jax.Array]:
  """One sample of an e-detector for each bet, and their mean.

    sum (Shiryaev-Roberts):  M' = (M + 1) exp(growth)         max (CUSUM):  M' = max(M, 1)
      exp(growth)

  Args:
    evidence: float32 (bets,), see EDetectorState. growth: float32 (bets,), logarithms of factors
      whose healthy mean is at most 1.

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
  threshold: float = 9.2104,
  bound: float = 0.1,
  deviation: float = 1.0,
  shifts: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0),
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

  Where E[z_t | past] <= bound and z_t given the past is sub-Gaussian with `deviation` (E exp(lambda
  (z - E z)) <= exp(lambda^2 deviation^2 / 2)), the mean of exp(growth_k) given the past is at most
  1. So E[mean_k M_k at T] <= E[T] for every stopping time T, and
    E[T] >= exp(threshold) from every restart, in finite samples, whatever else the stream does:
    changing variance, skew, dependence.
  The condition is on the CONDITIONAL mean. An autocorrelated stream breaks it, as its mean given
  the past wanders over the bound: there the alarms come far too often unless the stream is whitened
  first. Warm-up errors count too: `bound` leaves room for that of the mean (1 / sqrt(warmup) for
  independent samples), `deviation` for that of std and for tails heavier than a Gaussian's.

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
    Detector whose update takes x, float32 (), and gives Alarm(fired: bool (), score: float32 ());
    score nan during warm-up.
  Blind to: a fall of the mean, unless two_sided (so for the reward); a shift below `bound`; a
  change of variance alone.
  Source: Shin, Ramdas and Rinaldo 2022, arXiv 2203.03532.   Example: _, out =
    jax.lax.scan(det.update, det.init(), xs)
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
  sign = np.repeat(
    np.float32([1, -1]) if two_sided else np.float32([1]),  # type: ignore[arg-type]
    len(size),
  )
  size = np.tile(size, len(sign) // len(size))
  price = size * np.float32(bound) + np.square(size * np.float32(deviation)) / 2

  def start(warm: Warm) -> EDetectorState:
    return EDetectorState(warm, jnp.zeros(len(size)))

  def update(state: EDetectorState, x: jax.Array) -> tuple[EDetectorState, Alarm]:
    warm, z, ready = standardise(state.warm, jnp.asarray(x, jnp.float32), warmup)
    evidence, score = accumulate(state.evidence, sign * size * z - price, form)
    fired = ready & (score > threshold)
    new = EDetectorState(warm, jnp.where(ready & ~fired, evidence, 0.0))
    return new, Alarm(fired, jnp.where(ready, score, jnp.nan))

  return Detector(lambda: start(cold()), update)
