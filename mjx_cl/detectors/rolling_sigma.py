"""The paper's rule on one residual: beyond so many rolling deviations of the rolling mean."""
from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.detectors.base import Alarm, Detector, above
from mjx_cl.errors import UserError


class RollingSigmaState(NamedTuple):
  """Attributes:
    recent: float32 (smooth,), the last samples. buffer: float32 (window + lag,), the last smoothed samples.
    count: int32 (), samples seen. run: int32 (), smoothed samples in a row beyond the threshold.
  """
  recent: jax.Array
  buffer: jax.Array
  count: jax.Array
  run: jax.Array


def rolling_sigma(window: int = 1000, threshold: float = 3.0, patience: int = 1, two_sided: bool = True, warmup: int = 500, smooth: int = 1,
                  lag: int = 0, log: bool = False) -> Detector:
  """Rolling mean and standard deviation of the `window` samples before the present one.

    y_t = mean of x_{t-smooth+1..t}, or of ln max(x, 1e-9);   mean, std over y_{t-lag-window..t-lag-1}
    z = (y_t - mean) / max(std, 1e-6),  score = |z| (two-sided) or z
    fired when score > threshold for the `patience`-th time in a row: one alarm per excursion, the next needs a score below first

  Every sample enters the window, alarms or not, as the paper's rolling statistics do. smooth = 1, lag = 0 and no logarithm are the paper's rule.

  Args:
    window: samples of the rolling statistics [control steps]. The paper gives none.
    threshold: decision level [rolling std]; 3 in the paper.
    patience: how many in a row.
    two_sided: also a fall below the mean fires, the literal "deviation"; False: a rise alone.
    warmup: reference samples needed before anything fires; at most `window`.
    smooth: samples of the trailing mean that is tested; a gait makes single residuals swing, so a shift shows in their mean.
    lag: the newest samples that the reference leaves out, so that a change cannot raise its own threshold.
    log: take the logarithm first; a residual is positive and skewed, and single large ones otherwise widen the deviation for a whole window.
  Returns:
    Detector whose update takes x, float32 (), and gives Alarm(fired: bool (), score: float32 ()).
  Blind to: a change slower than window + lag, which the reference absorbs; with `patience`, a change that comes and goes faster.
  Reference: the paper, section on change detection.   Example: _, out = jax.lax.scan(det.update, det.init(), xs)
  """
  if not (window >= 2 and patience >= 1 and above(threshold, 0) and min(warmup, window) >= 2 and smooth >= 1 and lag >= 0):
    raise UserError("rolling_sigma needs window >= 2, patience >= 1, threshold > 0, warmup >= 2, smooth >= 1, lag >= 0; got "
                    f"{window}, {patience}, {threshold}, {warmup}, {smooth}, {lag}")
  warmup, size = min(warmup, window), window + lag

  def init():
    return RollingSigmaState(jnp.zeros(smooth), jnp.zeros(size), jnp.int32(0), jnp.int32(0))

  def update(state, x):
    x = jnp.asarray(x, jnp.float32)
    recent = state.recent.at[state.count % smooth].set(jnp.log(jnp.maximum(x, 1e-9)) if log else x)
    y = jnp.sum(recent) / jnp.minimum(state.count + 1, smooth)
    behind = (state.count + size - 1) % size - jnp.arange(size)
    age = jnp.where(behind < 0, behind + size, behind)  # 0 is the newest smoothed sample before this one
    held = (age >= lag) & (age < state.count)
    number = jnp.maximum(1, jnp.sum(held))
    mean = jnp.sum(jnp.where(held, state.buffer, 0.0)) / number
    std = jnp.sqrt(jnp.sum(jnp.where(held, jnp.square(state.buffer - mean), 0.0)) / number)
    z = (y - mean) / jnp.maximum(std, 1e-6)
    score = jnp.abs(z) if two_sided else z
    ready = state.count - lag >= warmup
    run = jnp.where(ready & (score > threshold), state.run + 1, 0)
    new = RollingSigmaState(recent, state.buffer.at[state.count % size].set(y), state.count + 1, run)
    return new, Alarm(run == patience, jnp.where(ready, score, jnp.nan))

  return Detector(init, update)
