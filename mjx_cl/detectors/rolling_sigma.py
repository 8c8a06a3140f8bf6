"""The paper's rule on one residual: beyond so many rolling deviations of the rolling mean."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.detectors.base import Alarm, Detector, above
from mjx_cl.errors import UserError


class Moments(NamedTuple):
  """Of a stretch of samples.

  Attributes:
    mean: float32 (). squares: float32 (), sum of squared deviations from the mean.
  """

  mean: jax.Array
  squares: jax.Array


class RollingSigmaState(NamedTuple):
  """Sample i, i = 0 .. count - 1, lies at i mod (window + lag); blocks are its stretches [j size,
  (j + 1) size), see `rolling_sigma`.

  Attributes:
    recent: float32 (smooth,), the last samples. buffer: float32 (window + lag,), the last smoothed
      samples. count: int32 (), samples seen.
    run: int32 (), smoothed samples in a row beyond the threshold.
    blocks: Moments of (blocks,), of the blocks that the window has wholly taken in. number: int32
      (blocks,), which they are, -1 none.
    tail: Moments of the samples behind the last of them. heads: float32 (2 size, 2), moments of the
      ends of an even and an odd block, from each of their
    samples on. growing: Moments, the last of the ends that was found.
  """

  recent: jax.Array
  buffer: jax.Array
  count: jax.Array  # type: ignore[assignment]
  run: jax.Array
  blocks: Moments
  number: jax.Array
  tail: Moments
  heads: jax.Array
  growing: Moments


def grown(moments: Moments, before: jax.Array, x: jax.Array) -> Moments:
  """Moments of one sample more, by Welford's recursion; `before`: how many there were, 0 begins
  anew.
  """
  step = x - moments.mean
  mean = moments.mean + step / (before + 1)
  more = Moments(mean, moments.squares + step * (x - mean))
  return jax.tree.map(
    lambda a, b: jnp.where(before == 0, a, b), Moments(x, jnp.zeros_like(x)), more
  )


def rolling_sigma(
  window: int = 1000,
  threshold: float = 3.0,
  patience: int = 1,
  two_sided: bool = True,
  warmup: int = 500,
  smooth: int = 1,
  lag: int = 0,
  log: bool = False,
  unit: float = 1.0,
) -> Detector:
  """Rolling mean and standard deviation of the `window` samples before the present one.

    y_t = mean of x_{t-smooth+1..t}, or of ln max(x, 1e-9);   mean, std over
      y_{t-lag-window..t-lag-1}
    z = (y_t - mean) / max(unit * std, 1e-6),  score = |z| (two-sided) or z
    fired when score > threshold for the `patience`-th time in a row: one alarm per excursion, the
    next needs a score below first

  Every sample enters the window, alarms or not, as the paper's rolling statistics do. smooth = 1,
  lag = 0 and no logarithm are the paper's rule. A sample that is nan is none: the state stays as it
  is, the score is nan.

  The window is never summed anew: it is the end of a block, whole blocks and the beginning of one,
  each with its mean and sum of squared deviations (Chan, Golub and LeVeque 1983, eq. 1.5); nothing
  is ever subtracted, so a large sample leaves no rounding behind when it leaves.

  Args:
    window: samples of the rolling statistics [control steps]. The paper gives none.
    threshold: decision level [unit * rolling std]; 3 in the paper.
    patience: how many in a row.
    two_sided: also a fall below the mean fires, the literal "deviation"; False: a rise alone.
    warmup: reference samples needed before anything fires; at most `window`.
    smooth: samples of the trailing mean that is tested; a gait makes single residuals swing, so a
      shift shows in their mean.
    lag: the newest samples that the reference leaves out, so that a change cannot raise its own
      threshold.
    log: take the logarithm first; a residual is positive and skewed, and single large ones
      otherwise widen the deviation for a whole window.
    unit: standard deviations that count as one, so that several of these can share a threshold.

  Returns:
    Detector whose update takes x, float32 (), and gives Alarm(fired: bool (), score: float32 ()).
  Cost: window / size + O(1) a sample, size the power of two at or below window / 12.
  Blind to: a change slower than window + lag, which the reference absorbs; with `patience`, a
  change that comes and goes faster.
  Reference: the paper, section on change detection.   Example: _, out = jax.lax.scan(det.update,
    det.init(), xs)
  """
  if not (
    window >= 2
    and patience >= 1
    and above(threshold, 0)
    and min(warmup, window) >= 2
    and smooth >= 1
    and lag >= 0
    and 0 < unit < float("inf")
  ):
    raise UserError(
      "rolling_sigma needs window >= 2, patience >= 1, threshold > 0, warmup >= 2, smooth >= "
      "1, lag >= 0, unit > 0; got "
      f"{window}, {patience}, {threshold}, {warmup}, {smooth}, {lag}, {unit}"
    )
  warmup, held = min(warmup, window), window + lag
  shift = max(0, (window // 12).bit_length() - 1)
  size, number = 1 << shift, (window >> shift) + 1

  def init() -> RollingSigmaState:
    zero = Moments(jnp.float32(0), jnp.float32(0))
    return RollingSigmaState(
      jnp.zeros(smooth),
      jnp.zeros(held),
      jnp.int32(0),
      jnp.int32(0),
      Moments(jnp.zeros(number), jnp.zeros(number)),
      jnp.full(number, -1, jnp.int32),
      zero,
      jnp.zeros((2 * size, 2)),
      zero,
    )

  def update(state: RollingSigmaState, x: jax.Array) -> tuple[RollingSigmaState, Alarm]:
    x = jnp.asarray(x, jnp.float32)
    known = ~jnp.isnan(x)
    put = lambda array, at, value, where: array.at[
      jnp.where(known & where, at, array.shape[0])
    ].set(value, mode="drop")
    recent = put(
      state.recent, state.count % smooth, jnp.log(jnp.maximum(x, 1e-9)) if log else x, True
    )
    y = jnp.sum(recent) / jnp.minimum(state.count + 1, smooth)
    buffer = put(
      state.buffer, state.count % held, y, True
    )  # before it is read, else XLA copies it; what leaves it here nothing needs
    end = state.count - lag  # the window is samples [begin, end), of which those below 0 are none
    begin = end - window
    within = lambda i: i & (size - 1)
    # where it ends: the sample that enters, and a block that it completes
    tail = grown(state.tail, within(end - 1), buffer[(end - 1) % held])
    tail = jax.tree.map(lambda a: jnp.where(end > 0, a, 0.0), tail)
    complete, at = (end > 0) & (within(end) == 0), ((end >> shift) - 1) % number
    blocks = jax.tree.map(lambda a, b: put(a, at, b, complete), state.blocks, tail)
    numbers = put(state.number, at, (end >> shift) - 1, complete)
    # where it begins: while it leaves one block, the ends of the next are found, from the last
    # sample backwards
    back, following = within(begin), (begin >> shift) + 1
    last = size - 1 - back
    growing = grown(state.growing, back, buffer[(following * size + last) % held])
    heads = put(state.heads, (following & 1) * size + last, jnp.stack(growing), begin >= -size)
    first = jnp.maximum(begin, 0)
    head = Moments(*heads[((first >> shift) & 1) * size + within(first)])
    in_head, in_tail = -first & (size - 1), jnp.where(end > 0, within(end), 0)
    whole = (numbers >= 0) & (numbers << shift >= first)
    total = jnp.maximum(1, end - first)
    mean = (
      jnp.sum(jnp.where(whole, blocks.mean, 0.0)) * size + in_head * head.mean + in_tail * tail.mean
    ) / total
    about = lambda n, m: m.squares + n * jnp.square(m.mean - mean)
    squares = jnp.sum(jnp.where(whole, about(size, blocks), 0.0))
    squares += jnp.where(in_head > 0, about(in_head, head), 0.0) + jnp.where(
      in_tail > 0, about(in_tail, tail), 0.0
    )
    z = (y - mean) / jnp.maximum(unit * jnp.sqrt(squares / total), 1e-6)
    score = jnp.abs(z) if two_sided else z
    ready = known & (end >= warmup)
    run = jnp.where(ready & (score > threshold), state.run + 1, 0)
    keep = lambda new, old: jax.tree.map(lambda a, b: jnp.where(known, a, b), new, old)
    new = RollingSigmaState(
      recent,
      buffer,
      keep(state.count + 1, state.count),
      keep(run, state.run),
      blocks,
      numbers,
      keep(tail, state.tail),
      heads,
      keep(growing, state.growing),
    )
    return new, Alarm(known & (run == patience), jnp.where(ready, score, jnp.nan))

  update.skips = True  # type: ignore[attr-defined]
  return Detector(init, update)
