"""The Page-Hinkley test: cumulative deviations from the running mean, against their
extreme so far.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import ArrayLike

from mjx_cl.detectors.base import (
  Alarm,
  ChartState,
  Detector,
  Number,
  Real,
  Setting,
  above,
  cold,
  demand,
  judged,
  scalar,
  standardise,
)

MODES = ("both", "up", "down")


class Fading(NamedTuple):
  """Sums over the samples since the start or the last alarm.

  Attributes:
    seen: float32 (), samples.
    origin: float32 (), the first of them.
    mean: float32 (), their mean less the origin, so that a distant level does not cost it digits.
    rise: float32 (), up - low.
    low: float32 (), smallest `up` so far.
    fall: float32 (), high - down.
    high: float32 (), largest `down`.
  """

  seen: Number
  origin: Number
  mean: Number
  rise: Number
  low: Number
  fall: Number
  high: Number


def faded(state: Fading, z: Number, delta: Real, alpha: Real) -> Fading:
  """The sums with one sample more.

  The extremes do not fade while the sums do, so the differences are what is kept, with the term
  that this leaves: rise = max(0, alpha rise + dev - delta - (1 - alpha) low).
  """
  origin = jnp.where(state.seen == 0, z, state.origin)
  z = z - origin
  seen = state.seen + 1
  mean = state.mean + (z - state.mean) / seen
  dev = z - mean
  rise = alpha * state.rise + (dev - delta) - (1 - alpha) * state.low
  low = state.low + jnp.minimum(0.0, rise)
  fall = alpha * state.fall - (dev + delta) + (1 - alpha) * state.high
  high = state.high - jnp.minimum(0.0, fall)
  return Fading(seen, origin, mean, jnp.maximum(0.0, rise), low, jnp.maximum(0.0, fall), high)


@scalar
def page_hinkley(
  delta: Real = 0.005,
  threshold: Setting = 50.0,
  alpha: Real = 0.9999,
  mode: str = "both",
  min_instances: int = 30,
  warmup: int = 1000,
) -> Detector:
  """Page-Hinkley test with fading sums, as river.drift.PageHinkley defines it.

    z = (x - centre) / max(std, 1e-6)                                centre, std frozen after
      `warmup` samples
    mean = mean of all z since the last alarm, this one among them,  dev = z - mean
    up = alpha up + dev - delta,    low = min(low, up)               both start at 0
    down = alpha down + dev + delta,  high = max(high, down)
    score = max(up - low, high - down), or the first alone (mode "up"), or the second (mode "down")
    fired = score > threshold once `min_instances` samples are in the mean; then mean, sums and
    extremes start anew

  The mean is evidence here, not reference: after an alarm the test takes whatever it then sees as
  normal. With warmup = 0 it fires at the samples at which river's does, up to the digits of
  float32.

  Args:
    delta: deviation per sample that is tolerated [warm-up std].
    threshold: decision level [warm-up std, summed].
    alpha: share of the sums that is kept from sample to sample, in (0, 1].
    mode: `both`, `up` or `down`.
    min_instances: samples after the warm-up, or after an alarm, before anything fires and a score
      is known [control steps].
    warmup: samples that fit centre and std; 0: x as it is [control steps].
  Blind to: a shift below delta; a change slow enough for the running mean to follow; a change of
  variance alone; with alpha < 1 also a shift below about threshold * (1 - alpha), whose faded sum
  never gets there.
  Reference: Page 1954, Biometrika 41, 100-115; Hinkley 1971, Biometrika 58, 509-523;
  river.drift.PageHinkley.
  """
  demand(
    "page_hinkley",
    delta=(delta, delta >= 0, "at least 0"),
    threshold=(threshold, above(threshold, 0), "above 0"),
    alpha=(alpha, 0 < alpha <= 1, "in (0, 1]"),
    mode=(mode, mode in MODES, f"one of {', '.join(MODES)}"),
    min_instances=(min_instances, min_instances >= 1, "at least 1"),
    warmup=(warmup, warmup == 0 or warmup >= 2, "0 or at least 2"),
  )

  def init() -> ChartState:
    return ChartState(cold(), Fading(*(jnp.float32(0) for _ in Fading._fields)))

  def update(state: ChartState, x: ArrayLike) -> tuple[ChartState, Alarm]:
    warm, z, ready = standardise(state.warm, jnp.asarray(x, jnp.float32), warmup)
    new = faded(state.evidence, z, delta, alpha)
    score = {"both": jnp.maximum(new.rise, new.fall), "up": new.rise, "down": new.fall}[mode]
    alarm = judged(score, ready & (new.seen >= min_instances), threshold)
    evidence = [jnp.where(ready & ~alarm.fired, value, 0.0) for value in new]
    return ChartState(warm, Fading(*evidence)), alarm

  return Detector(init, update)
