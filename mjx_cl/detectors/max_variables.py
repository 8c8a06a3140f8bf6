"""The largest of several channels' charts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from mjx_cl.detectors import multivariate
from mjx_cl.detectors.base import Alarm, Detector, above, demand

if TYPE_CHECKING:
  from mjx_cl.rollout.monitor import Residual


def corrected(z: jax.Array, charts: int, two_sided: bool) -> jax.Array:
  """-ln of the Sidak-corrected Gaussian p-value of the largest of `charts` deviations z: -ln(1 - (1
  - p)^charts), p = 2 Phi(-z) or Phi(-z).
  """
  ln_p = jax.scipy.special.log_ndtr(-z) + (jnp.log(2.0) if two_sided else 0.0)
  tiny = (
    ln_p < -30
    # then 1 - (1 - p)^charts = charts p to float32, and p itself would underflow a little further
    # out
  )
  p = jnp.exp(
    jnp.where(tiny, -30.0, jnp.minimum(ln_p, -1e-7))
  )  # p = 1, at z = 0, has no logarithm of 1 - p
  return jnp.where(tiny, -ln_p - jnp.log(charts), -jnp.log(-jnp.expm1(charts * jnp.log1p(-p))))


def max_variables(
  smooth: int = 100,
  threshold: float = 15.0,
  two_sided: bool = True,
  warmup: int = 1000,
  channels: str | tuple[str, ...] = "groups+reward",
  log: bool = True,
) -> Detector:
  """Maximum over channels of a standardised trailing mean, corrected for their number.

    z_c = (mean of the last `smooth` samples of channel c - mean_c) / std_c;  mean_c, std_c of that
    trailing mean over the warm-up
    z = max_c |z_c|, or max_c z_c with the sign of the reward turned (one-sided);  p = 2 Phi(-z), or
    Phi(-z)
    score = -ln(1 - (1 - p)^C), C channels: -ln of Sidak's corrected p-value
    fired = score > threshold; then the trailing means start from nothing, unknown until refilled,
    while mean_c and std_c are kept

  The p-value holds at one step, for Gaussian trailing means, independent channels (too large
  otherwise) and known mean_c, std_c. A warm-up of a few times `smooth` knows std_c to a fifth or
  so, and residuals are skewed: the score ranks, the threshold is calibrated anyway. The default
  threshold has an ARL0 of about 10,000 samples on independent Gaussian samples.

  Args:
    smooth: samples of the trailing mean [control steps].
    threshold: decision level of the score [nats].
    two_sided: also a fall counts; False: a rise of residuals and surprise, a fall of the reward
      alone.
    warmup: samples that fit mean and deviation, at least 2 smooth; 0: channels are standardised and
      independent samples already.
    channels, log: as in hotelling.

  Returns:
    Detector whose update takes a monitor.Residual and gives Alarm(fired: bool (), score: float32
    ()).
  Blind to: a change of variance alone; a shift spread thinly over all channels, which hotelling
  adds up. Reference: Sidak 1967, J. Amer. Statist. Assoc. 62, 626-633; charts side by side:
  Woodall, Ncube 1985, Technometrics 27, 285-292. Example: _, out = jax.lax.scan(det.update,
  det.init(), residuals)
  """
  names = multivariate.split("max_variables", channels)
  demand(
    "max_variables",
    smooth=(smooth, smooth >= 1, "at least 1"),
    threshold=(threshold, above(threshold, 0), "above 0"),
    warmup=(
      warmup,
      warmup == 0 or warmup >= max(2, 2 * smooth),
      "0, or at least twice `smooth` and 2",
    ),
  )
  sign = jnp.array([-1.0 if c == "reward" else 1.0 for c in names])

  def init() -> multivariate.Standing:
    return multivariate.standing(smooth, len(names))

  def update(
    state: multivariate.Standing, residual: Residual
  ) -> tuple[multivariate.Standing, Alarm]:
    x, known = multivariate.pick(residual, names, log)
    state, z, ready = multivariate.trailing_z(state, x, known, smooth, warmup)
    largest = jnp.max(jnp.abs(z) if two_sided else sign * z)
    score = corrected(largest, len(names), two_sided)
    fired = ready & (score > threshold)
    return state._replace(trail=multivariate.restart(state.trail, fired)), Alarm(
      fired, jnp.where(ready, score, jnp.nan)
    )

  return Detector(init, update)


max_variables.takes = "residual"  # type: ignore[attr-defined]
