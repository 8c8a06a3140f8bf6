"""A chart of single samples: so many deviations from the mean of the healthy stream."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from mjx_cl.detectors.base import (
  Alarm,
  Detector,
  Setting,
  Warm,
  above,
  cold,
  demand,
  judged,
  scalar,
  standardise,
)


class ZScoreState(NamedTuple):
  """What the chart remembers.

  Attributes:
    warm: the reference.
    recent: float32 (smooth,), the last samples, zero where none.
    seen: int32 (), samples; it only says where in `recent` the next sample goes and how many there
      are, and stays below 2 smooth, so that it never overflows.
    beyond: bool (), the last score was above the threshold.
  """

  warm: Warm
  recent: jax.Array
  seen: jax.Array
  beyond: jax.Array


@scalar
def z_score(
  threshold: Setting = 4.0, two_sided: bool = True, smooth: int = 1, warmup: int = 1000
) -> Detector:
  """Shewhart's chart with a frozen reference, of samples or of their trailing mean.

    y_t = mean of x_{t-smooth+1..t} (of the samples there are);   mean, std of the first `warmup` y,
      frozen then
    z = (y_t - mean) / max(std, 1e-6),  score = |z| (two-sided) or z
    fired when score > threshold and the score before was not: one alarm per excursion, the next
    needs a score at or below the threshold first

  The reference is taken of y, not of x: std is right for a trailing mean of dependent samples too.

  Args:
    threshold: decision level [std of y]; ARL0 on independent Gaussian samples is 1 / P(|z| >
      threshold): 370 at 3, 15,787 at 4.
    two_sided: also a fall fires; False: a rise alone.
    smooth: samples of the trailing mean that is tested; 1: the samples themselves [control steps].
    warmup: samples that fit mean and std; nothing fires before they end; 0: x is standardised
      already [control steps].

  Returns:
    Detector of one number; the score is nan during warm-up.
  Blind to: a shift well below threshold deviations of y, for it does not add evidence up; a change
  of the spread below them. Reference: Shewhart 1931, Economic Control of Quality of Manufactured
  Product.
  """
  demand(
    "z_score",
    threshold=(threshold, above(threshold, 0), "above 0"),
    smooth=(smooth, smooth >= 1, "at least 1"),
    warmup=(warmup, warmup == 0 or warmup >= 2, "0 or at least 2"),
  )

  def init() -> ZScoreState:
    return ZScoreState(cold(), jnp.zeros(smooth), jnp.int32(0), jnp.bool_(False))

  def update(state: ZScoreState, x: ArrayLike) -> tuple[ZScoreState, Alarm]:
    recent, y = state.recent, jnp.asarray(x, jnp.float32)
    if smooth > 1:
      recent = recent.at[state.seen % smooth].set(y)
      y = jnp.sum(recent) / jnp.minimum(state.seen + 1, smooth)
    warm, z, ready = standardise(state.warm, y, warmup)
    beyond, score = judged(jnp.abs(z) if two_sided else z, ready, threshold)
    seen = jnp.where(state.seen + 1 < 2 * smooth, state.seen + 1, smooth)
    return ZScoreState(warm, recent, seen, beyond), Alarm(beyond & ~state.beyond, score)

  return Detector(init, update)
