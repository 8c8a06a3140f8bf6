"""A chart of the exponentially weighted moving average."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.detectors.base import Detector, Number, Real, Setting, above, chart, demand, scalar


class Average(NamedTuple):
  """What the samples since the start or the last alarm come to.

  Attributes:
    average: float32 ().
    forgotten: float32 (), (1 - rate)^(2 n) after n samples.
  """

  average: jax.Array
  forgotten: jax.Array


@scalar
def ewma(rate: Real = 0.1, threshold: Setting = 3.0, warmup: int = 1000) -> Detector:
  """Two-sided EWMA chart on one stream, with the exact variance of the average at each sample.

    z = (x - mean) / max(std, 1e-6)                    mean, std frozen after `warmup` samples
    average_n = (1 - rate) average_{n-1} + rate z_n,   average_0 = 0
    var_n = rate / (2 - rate) (1 - (1 - rate)^(2 n)),  score = |average_n| / sqrt(var_n)
    fired = score > threshold; then n = 0, average = 0, while mean and std are kept

  Args:
    rate: weight of the newest sample, in (0, 1]; small ones find small shifts, 1 is the chart of
      single samples.
    threshold: decision level [std of the average]. On independent Gaussian samples rate 0.1 and
      threshold 2.814 give ARL0 500 with the asymptotic variance and 486 with the exact one, which
      is narrower at first and so fires more often just after a restart.
    warmup: samples that fit mean and std; nothing fires before they end; 0: x is standardised
      already [control steps].

  Returns:
    Detector of one number; the score is nan during warm-up.
  Blind to: a shift below about threshold * sqrt(rate / (2 - rate)) deviations; a change of variance
  below the threshold. Reference: Roberts 1959, Technometrics 1, 239-250; Lucas and Saccucci 1990,
  Technometrics 32, 1-12.
  """
  demand(
    "ewma",
    rate=(rate, 0 < rate <= 1, "in (0, 1]"),
    threshold=(threshold, above(threshold, 0), "above 0"),
    warmup=(warmup, warmup == 0 or warmup >= 2, "0 or at least 2"),
  )

  def step(past: Average, z: Number) -> tuple[Average, Number]:
    average = past.average + rate * (z - past.average)
    forgotten = past.forgotten * (1 - rate) ** 2
    score = jnp.abs(average) * jax.lax.rsqrt(rate / (2 - rate) * (1 - forgotten))
    return Average(average, forgotten), score

  return chart(lambda: Average(jnp.float32(0), jnp.float32(1)), step, threshold, warmup)
