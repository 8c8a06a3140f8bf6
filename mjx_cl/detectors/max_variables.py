"""The largest of several channels' charts."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from mjx_cl.detectors.base import Detector, Number, Setting, whole
from mjx_cl.detectors.multivariate import Rows, split, standing
from mjx_cl.types import Array


def corrected(z: Float[Array, "*rows"], charts: int, two_sided: bool) -> Float[Array, "*rows"]:
  """-ln of the Sidak-corrected Gaussian p-value of the largest of `charts` deviations z: -ln(1 - (1
  - p)^charts), p = 2 Phi(-z) or Phi(-z).
  """
  ln_p = jax.scipy.special.log_ndtr(-z) + (jnp.log(2.0) if two_sided else 0.0)
  # there 1 - (1 - p)^charts = charts p to float32; further out p itself would underflow
  tiny = ln_p < -30
  # p = 1, at z = 0, has no logarithm of 1 - p
  p = jnp.exp(jnp.where(tiny, -30.0, jnp.minimum(ln_p, -1e-7)))
  return jnp.where(tiny, -ln_p - jnp.log(charts), -jnp.log(-jnp.expm1(charts * jnp.log1p(-p))))


@whole
def max_variables(
  smooth: int = 100,
  threshold: Setting = 15.0,
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
    channels: as in hotelling.
    log: as in hotelling.

  Returns:
    Detector over monitor.Residual.
  Blind to: a change of variance alone; a shift spread thinly over all channels, which hotelling
  adds up.
  Reference: Sidak 1967, J. Amer. Statist. Assoc. 62, 626-633; charts side by side:
  Woodall, Ncube 1985, Technometrics 27, 285-292.
  """
  names = split("max_variables", channels)
  sign = jnp.array([-1.0 if c == "reward" else 1.0 for c in names])

  def score(z: Rows) -> Number:
    return corrected(jnp.max(jnp.abs(z) if two_sided else sign * z), len(names), two_sided)

  return standing("max_variables", names, log, smooth, warmup, threshold, score)
