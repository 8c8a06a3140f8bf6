"""Page's cumulative sums."""

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


@scalar
def cusum(
  slack: Real = 0.5, threshold: Setting = 8.0, two_sided: bool = True, warmup: int = 1000
) -> Detector:
  """CUSUM on one stream, in units of the stream's own warm-up deviation.

    z = (x - mean) / max(std, 1e-6)                    mean, std frozen after `warmup` samples
    up = max(0, up + z - slack),  down = max(0, down - z - slack)
    score = max(up, down), one-sided: up
    fired = score > threshold; then up = down = 0, while mean and std are kept

  Args:
    slack: shift per sample that is tolerated; half the shift to be found quickest [warm-up std].
    threshold: decision level [warm-up std]. Two-sided, slack 0.5, on independent Gaussian samples:
      ARL0 168 at 4, 465 at 5.
    two_sided: also a fall fires; False: a rise alone.
    warmup: samples that fit mean and std; nothing fires before they end; 0: x is standardised
      already [control steps].

  Returns:
    Detector of one number; the score is nan during warm-up.
  Blind to: a change of variance alone, unless single samples exceed the slack by the threshold; any
  shift below `slack`.
  Reference: Page 1954, Biometrika 41, 100-115.
  """
  demand(
    "cusum",
    slack=(slack, slack >= 0, "at least 0"),
    threshold=(threshold, above(threshold, 0), "above 0"),
    warmup=(warmup, warmup == 0 or warmup >= 2, "0 or at least 2"),
  )

  def step(sums: Sides, z: Number) -> tuple[Sides, Number]:
    up = jnp.maximum(0.0, sums.up + z - slack)
    down = jnp.maximum(0.0, sums.down - z - slack) if two_sided else sums.down
    return Sides(up, down), jnp.maximum(up, down)

  return chart(lambda: Sides(jnp.float32(0), jnp.float32(0)), step, threshold, warmup)
