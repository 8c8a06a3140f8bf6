"""Shiryaev-Roberts: the likelihood ratio of a change, summed over all times at which it may have
happened.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.detectors.base import Alarm, Detector, Warm, above, cold, demand, scalar, standardise


class ShiryaevRobertsState(NamedTuple):
  """Attributes:
  warm: reference. up, down: float32 (), ln R for a rise and for a fall; -inf is R = 0.
  """

  warm: Warm
  up: jax.Array
  down: jax.Array


def softplus(x: jax.Array) -> jax.Array:
  """ln(1 + e^x), -inf included."""
  return jnp.maximum(x, 0.0) + jnp.log1p(jnp.exp(-jnp.abs(x)))


@scalar
def shiryaev_roberts(
  shift: float = 1.0, threshold: float = math.log(1e4), two_sided: bool = True, warmup: int = 1000
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
    Detector whose update takes x, float32 (), and gives Alarm(fired: bool (), score: float32 (),
    nan during warm-up).
  Blind to: a shift below shift / 2, against which the evidence falls; a change of variance alone.
  Reference: Shiryaev 1963, Theory Probab. Appl. 8, 22-46; Roberts 1966, Technometrics 8, 411-430;
  Pollak and Tartakovsky 2009, Stat. Sinica 19.
  Example: _, out = jax.lax.scan(det.update, det.init(), xs)      # out.fired: bool (T,)
  """
  demand(
    "shiryaev_roberts",
    shift=(shift, shift > 0, "above 0"),
    threshold=(threshold, above(threshold, -math.inf), "a number"),
    warmup=(warmup, warmup == 0 or warmup >= 2, "0 or at least 2"),
  )

  def init() -> ShiryaevRobertsState:
    return ShiryaevRobertsState(cold(), jnp.float32(-jnp.inf), jnp.float32(-jnp.inf))

  def update(state: ShiryaevRobertsState, x: jax.Array) -> tuple[ShiryaevRobertsState, Alarm]:
    warm, z, ready = standardise(state.warm, jnp.asarray(x, jnp.float32), warmup)
    up = softplus(state.up) + (shift * z - 0.5 * shift**2)
    down = softplus(state.down) + (-shift * z - 0.5 * shift**2) if two_sided else state.down
    score = (
      jnp.maximum(up, down) + jnp.log1p(jnp.exp(-jnp.abs(up - down))) - math.log(2)
      if two_sided
      else up
    )
    fired = ready & (score > threshold)
    keep = ready & ~fired
    new = ShiryaevRobertsState(warm, jnp.where(keep, up, -jnp.inf), jnp.where(keep, down, -jnp.inf))
    return new, Alarm(fired, jnp.where(ready, score, jnp.nan))

  return Detector(init, update)
