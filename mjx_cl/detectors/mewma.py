"""Multivariate EWMA chart."""

from typing import NamedTuple

import jax.numpy as jnp

from mjx_cl.detectors.base import (
  Alarm,
  Detector,
  Number,
  Real,
  Setting,
  above,
  demand,
  judged,
  whole,
)
from mjx_cl.detectors.multivariate import (
  Rows,
  Whitener,
  check_whitener,
  pick,
  split,
  whiten,
  whitener,
)
from mjx_cl.rollout.monitor import Residual


class MewmaState(NamedTuple):
  """What the chart remembers.

  Attributes:
    whitener: the reference.
    mean: float32 (p,), the moving average of whitened samples.
    left: float32 (), (1 - rate)^(2 t).
  """

  whitener: Whitener
  mean: Rows
  left: Number


@whole
def mewma(
  rate: Real = 0.02,
  threshold: Setting = 37.0,
  warmup: int = 1000,
  shrinkage: Real = 0.1,
  exact: bool = False,
  channels: str | tuple[str, ...] = "groups+opr+rpr+reward",
  log: bool = True,
) -> Detector:
  """Multivariate exponentially weighted moving average of several channels against the warm-up's
  mean and covariance.

    z_t = rate (x_t - mean) + (1 - rate) z_{t-1},  z_0 = 0;  score = z_t' V^-1 z_t
    V = rate / (2 - rate) S, the asymptotic variance; exact: times 1 - (1 - rate)^(2 t)
    fired = score > threshold; then z = 0 and t = 0, while mean and S (see hotelling) are kept

  Two-sided: the score is a squared distance, so a rise and a fall of any channel, the reward too,
  count alike. With the asymptotic variance and independent Gaussian samples of known covariance, p
  = 4, rate = 0.1, threshold 12.73 the published ARL0 is 200 and a shift of one deviation is found
  after 12.2 samples. The exact variance finds a change at the start sooner, for a shorter ARL0.
  Samples of a robot are correlated in time: calibrate. The default threshold has an ARL0 of about
  10,000 on independent Gaussian samples.

  Args:
    rate: in (0, 1], weight of the newest sample; 1 is Hotelling's chart of single samples. The
      memory is about 2 / rate samples.
    threshold: decision level [squared deviations].
    warmup: as in hotelling.
    shrinkage: as in hotelling.
    exact: the exact variance.
    channels: as in hotelling.
    log: as in hotelling.
  Blind to: a change of variance alone at small rates; a change much shorter than 1 / rate samples.
  Reference: Lowry, Woodall, Champ, Rigdon 1992, Technometrics 34, 46-53; run lengths: Runger,
  Prabhu 1996, J. Amer. Statist. Assoc. 91, 1701-1706.
  """
  names = split("mewma", channels)
  demand(
    "mewma",
    rate=(rate, 0 < rate <= 1, "in (0, 1]"),
    threshold=(threshold, above(threshold, 0), "above 0"),
  )
  check_whitener("mewma", names, warmup, shrinkage)

  def init() -> MewmaState:
    return MewmaState(whitener(len(names)), jnp.zeros(len(names)), jnp.float32(1))

  def update(state: MewmaState, residual: Residual) -> tuple[MewmaState, Alarm]:
    x, known = pick(residual, names, log)
    reference, y, ready = whiten(state.whitener, x, known, warmup, shrinkage)
    mean = jnp.where(ready, rate * y + (1 - rate) * state.mean, state.mean)
    left = jnp.where(ready, state.left * (1 - rate) ** 2, state.left)
    score = jnp.sum(jnp.square(mean)) * (2 - rate) / rate
    if exact:
      score = score / (1 - left)  # left < 1 after the first sample; before it the score is unknown
    alarm = judged(score, ready, threshold)
    mean, left = jnp.where(alarm.fired, 0.0, mean), jnp.where(alarm.fired, 1.0, left)
    return MewmaState(reference, mean, left), alarm

  return Detector(init, update)
