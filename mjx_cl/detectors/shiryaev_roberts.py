"""Shiryaev-Roberts: the likelihood ratio of a change, summed over all times at which it may have
happened.
"""

import math

import jax.numpy as jnp

from mjx_cl.detectors.base import (
  Detector,
  Number,
  Real,
  Setting,
  Sides,
  above,
  chart,
  demand,
  scalar,
)


def softplus(x: Number) -> Number:
  """ln(1 + e^x), -inf included."""
  return jnp.maximum(x, 0.0) + jnp.log1p(jnp.exp(-jnp.abs(x)))


@scalar
def shiryaev_roberts(
  shift: Real = 1.0, threshold: Setting = math.log(1e4), two_sided: bool = True, warmup: int = 1000
) -> Detector:
  """Shiryaev-Roberts procedure for a Gaussian mean shift of known size, in logarithms.

    z = (x - mean) / max(std, 1e-6)                    mean, std frozen after `warmup` samples
    R+ = (1 + R+) exp(shift z - shift^2 / 2),  R- = (1 + R-) exp(-shift z - shift^2 / 2),  both
    start at 0
    score = ln((R+ + R-) / 2) (two-sided) or ln R+
    fired = score > threshold; then R+ = R- = 0, while mean and std are kept

  R_n - n is a martingale while z is independent standard Gaussian, and so is that of the
  half-and-half mixture: the mean number of samples to a false alarm is at least exp(threshold),
  whatever the shift. Among procedures that are restarted after each false alarm, none of equal ARL0
  has a shorter mean delay to a change in the far future of the size `shift`.

  Args:
    shift: size of the mean shift to be found quickest [warm-up std].
    threshold: decision level on ln R [nats]; ln A guarantees ARL0 >= A on independent Gaussian
      samples.
    two_sided: rise or fall, half and half; False: a rise alone.
    warmup: samples that fit mean and std; nothing fires before they end; 0: x is standardised
      already [control steps].

  Returns:
    Detector of one number; the score is nan during warm-up.
  Blind to: a shift below shift / 2, against which the evidence falls; a change of variance alone.
  Reference: Shiryaev 1963, Theory Probab. Appl. 8, 22-46; Roberts 1966, Technometrics 8, 411-430;
  Pollak and Tartakovsky 2009, Stat. Sinica 19.
  """
  demand(
    "shiryaev_roberts",
    shift=(shift, shift > 0, "above 0"),
    threshold=(threshold, above(threshold, -math.inf), "a number"),
    warmup=(warmup, warmup == 0 or warmup >= 2, "0 or at least 2"),
  )

  def step(ln_r: Sides, z: Number) -> tuple[Sides, Number]:
    up = softplus(ln_r.up) + (shift * z - 0.5 * shift**2)
    if not two_sided:
      return Sides(up, ln_r.down), up
    down = softplus(ln_r.down) + (-shift * z - 0.5 * shift**2)
    score = jnp.maximum(up, down) + jnp.log1p(jnp.exp(-jnp.abs(up - down))) - math.log(2)
    return Sides(up, down), score

  return chart(lambda: Sides(jnp.float32(-jnp.inf), jnp.float32(-jnp.inf)), step, threshold, warmup)
