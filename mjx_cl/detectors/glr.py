"""The generalised likelihood ratio of a mean shift of unknown size at an unknown time, over all of
the past.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.detectors.base import Detector, Number, Setting, above, chart, demand, scalar


class Candidates(NamedTuple):
  """Times at which a shift may have begun, oldest first; row 0 for a rise, row 1 for a fall.

  Attributes:
    length: float32 (2, capacity), samples since each.
    total: float32 (2, capacity), sum of z (row 1: of -z) since then; -inf: no candidate.
  """

  length: jax.Array
  total: jax.Array


@scalar
def glr(threshold: Setting = 12.0, capacity: int = 32, warmup: int = 1000) -> Detector:
  """Two-sided generalised likelihood ratio, exact over every window and every size of the shift
  (FOCuS with a known mean before the change).

    z = (x - mean) / max(std, 1e-6)                    mean, std frozen after `warmup` samples
    score = max over s < t of (z_{s+1} + .. + z_t)^2 / (2 (t - s)),  s from the start or the last
    alarm
    fired = score > threshold; then s starts anew, while mean and std are kept

  For a rise, a time s can be the maximum, now or later, only if it is a corner of the convex
  minorant of the cumulative sum with a positive slope ahead: if the mean of z since s is positive
  and above the mean since the candidate before it. The others are dropped for good. Of n samples
  about ln(n) / 2 candidates are left on each side, ln(n) where the reference is off, and `capacity`
  fit. Where one more would come, it takes the place of the newest. The score is then never too
  large, and still exact over shifts of at most twice the slope between the two newest candidates
  before (the smallest such bound since the start), since all that are best for those are kept; a
  larger shift is seen through a window that begins somewhat early.

  Args:
    threshold: decision level [nats].
    capacity: candidates kept on each side.
    warmup: samples that fit mean and std; nothing fires before they end; 0: x is standardised
      already [control steps].

  Returns:
    Detector of one number; the score is nan during warm-up.
  Blind to: a change of variance alone. An error of the warm-up's mean is a shift like any other:
  given time it fires, sooner than for detectors
    with a slack.
  Reference: Lorden 1971, Ann. Math. Stat. 42, 1897-1908; Romano, Eckley, Fearnhead and Rigaill
  2023, J. Mach. Learn. Res. 24(81).
  """
  demand(
    "glr",
    threshold=(threshold, above(threshold, 0), "above 0"),
    capacity=(capacity, capacity >= 2, "at least 2"),
    warmup=(warmup, warmup == 0 or warmup >= 2, "0 or at least 2"),
  )
  slot = jnp.arange(capacity)

  def start() -> Candidates:
    return Candidates(jnp.ones((2, capacity)), jnp.full((2, capacity), -jnp.inf))

  def step(state: Candidates, z: Number) -> tuple[Candidates, Number]:
    mean = state.total / state.length
    # the means rise up to the tangent from the present and fall behind it: the last that rises is
    # the last that is kept
    rises = mean > jnp.concatenate([jnp.zeros((2, 1)), mean[:, :-1]], 1)
    kept = jnp.max(jnp.where(rises, slot + 1, 0), 1, keepdims=True)
    new = jnp.minimum(kept, capacity - 1)
    length = jnp.where(slot == new, 0.0, state.length) + 1.0
    total = (
      jnp.where(slot < new, state.total, jnp.where(slot == new, 0.0, -jnp.inf))
      + jnp.stack([z, -z])[:, None]
    )
    score = 0.5 * jnp.max(jnp.square(jnp.maximum(total, 0.0)) / length)
    return Candidates(length, total), score

  return chart(start, step, threshold, warmup)
