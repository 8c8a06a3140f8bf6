"""The paper's rule on one residual: beyond so many rolling deviations of the rolling mean."""
from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.detectors.base import Alarm, Detector
from mjx_cl.errors import UserError


class RollingSigmaState(NamedTuple):
  """Attributes:
    buffer: float32 (window,), the last samples. count: int32 (), samples seen. run: int32 (), samples in a row beyond the threshold.
  """
  buffer: jax.Array
  count: jax.Array
  run: jax.Array


def rolling_sigma(window: int = 1000, threshold: float = 3.0, patience: int = 1, two_sided: bool = True, warmup: int = 500) -> Detector:
  """Rolling mean and standard deviation of the last `window` samples, the present one not among them.

    z = (x - mean) / max(std, 1e-6),  score = |z| (two-sided) or z
    fired = score > threshold `patience` times in a row; then the run starts anew, the window is kept

  Every sample enters the window, alarms or not, as the paper's rolling statistics do.

  Args:
    window: samples of the rolling statistics [control steps]. The paper gives none.
    threshold: decision level [rolling std]; 3 in the paper.
    patience: how many in a row.
    two_sided: also a fall below the mean fires, the literal "deviation"; False: a rise alone.
    warmup: nothing fires before so many samples; at most `window`.
  Returns:
    Detector whose update takes x, float32 (), and gives Alarm(fired: bool (), score: float32 ()).
  Blind to: a change slower than the window, which the reference absorbs; with `patience`, a change that comes and goes faster.
  Reference: the paper, section on change detection.   Example: _, out = jax.lax.scan(det.update, det.init(), xs)
  """
  if not (window >= 2 and patience >= 1 and threshold > 0 and 2 <= min(warmup, window)):
    raise UserError(f"rolling_sigma needs window >= 2, patience >= 1, threshold > 0, warmup >= 2; got {window}, {patience}, {threshold}, {warmup}")
  warmup = min(warmup, window)

  def init():
    return RollingSigmaState(jnp.zeros(window), jnp.int32(0), jnp.int32(0))

  def update(state, x):
    x = jnp.asarray(x, jnp.float32)
    held = jnp.arange(window) < state.count
    number = jnp.maximum(1, jnp.minimum(state.count, window))
    mean = jnp.sum(jnp.where(held, state.buffer, 0.0)) / number
    std = jnp.sqrt(jnp.sum(jnp.where(held, jnp.square(state.buffer - mean), 0.0)) / number)
    z = (x - mean) / jnp.maximum(std, 1e-6)
    score = jnp.abs(z) if two_sided else z
    ready = state.count >= warmup
    run = jnp.where(ready & (score > threshold), state.run + 1, 0)
    fired = run >= patience
    new = RollingSigmaState(state.buffer.at[state.count % window].set(x), state.count + 1, jnp.where(fired, 0, run))
    return new, Alarm(fired, jnp.where(ready, score, jnp.nan))

  return Detector(init, update)
