"""The paper's rule on one residual: beyond so many rolling deviations of the rolling mean.

The window is never summed anew: it is the end of a block, whole blocks and the beginning of one,
each with its mean and sum of squared deviations (Chan, Golub and LeVeque 1983, eq. 1.5); nothing is
ever subtracted, so a large sample leaves no rounding behind when it leaves. Sample i, i = 0 ..
seen - 1, lies at i mod (window + lag); blocks are its stretches [j size, (j + 1) size), size the
power of two at or below window / 12. A sample costs window / size + O(1).
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Float

from mjx_cl.detectors.base import (
  Alarm,
  Count,
  Detector,
  Flag,
  Number,
  Real,
  Setting,
  above,
  judged,
  keep,
)
from mjx_cl.errors import UserError
from mjx_cl.types import Array

Ring = Float[Array, "samples"]


class Moments(NamedTuple):
  """Of a stretch of samples.

  Attributes:
    mean: float32 ().
    squares: float32 (), sum of squared deviations from the mean.
  """

  mean: jax.Array
  squares: jax.Array


class Parts(NamedTuple):
  """What the window is put together from.

  Attributes:
    blocks: Moments of (blocks,), of the blocks that the window has wholly taken in.
    number: int32 (blocks,), which they are, -1 none.
    tail: Moments of the samples behind the last of them.
    heads: float32 (2 size, 2), moments of the ends of an even and an odd block, from each of their
      samples on.
    growing: Moments, the last of the ends that was found.
  """

  blocks: Moments
  number: jax.Array
  tail: Moments
  heads: jax.Array
  growing: Moments


class RollingSigmaState(NamedTuple):
  """What the detector remembers.

  Attributes:
    recent: float32 (smooth,), the last samples.
    buffer: float32 (window + lag,), the last smoothed samples.
    seen: int32 (), samples.
    run: int32 (), smoothed samples in a row beyond the threshold.
    parts: of the window.
  """

  recent: jax.Array
  buffer: jax.Array
  seen: jax.Array
  run: jax.Array
  parts: Parts


def grown(moments: Moments, before: Count, x: Number) -> Moments:
  """Moments of one sample more, by Welford's recursion; `before`: how many there were, 0 begins
  anew.
  """
  step = x - moments.mean
  mean = moments.mean + step / (before + 1)
  more = Moments(mean, moments.squares + step * (x - mean))
  return keep(before == 0, Moments(x, jnp.zeros_like(x)), more)


def put(array: jax.Array, at: Count, value: ArrayLike, where: Flag) -> jax.Array:
  """`array` with `value` at an index, where told."""
  return array.at[jnp.where(where, at, array.shape[0])].set(value, mode="drop")


@dataclasses.dataclass(frozen=True)
class Window:
  """The sums of a sliding window.

  Attributes:
    length: samples of the window.
    lag: the newest samples, which it leaves out.
  """

  length: int
  lag: int

  @property
  def shift(self) -> int:
    """Binary logarithm of the samples of a block."""
    return max(0, (self.length // 12).bit_length() - 1)

  def empty(self) -> Parts:
    """No samples."""
    zero = Moments(jnp.float32(0), jnp.float32(0))
    number = (self.length >> self.shift) + 1
    return Parts(
      Moments(jnp.zeros(number), jnp.zeros(number)),
      jnp.full(number, -1, jnp.int32),
      zero,
      jnp.zeros((2 << self.shift, 2)),
      zero,
    )

  def moved(self, old: Parts, buffer: Ring, end: Count, known: Flag) -> Parts:
    """The parts where the window is the samples [end - length, end), of which those below 0 are
    none; one sample later than `old`, or as `old` where the sample is not known.
    """
    shift, size, held = self.shift, 1 << self.shift, len(buffer)
    begin = end - self.length
    within = lambda i: i & (size - 1)
    # where it ends: the sample that enters, and a block that it completes
    tail = grown(old.tail, within(end - 1), buffer[(end - 1) % held])
    tail = jax.tree.map(lambda a: jnp.where(end > 0, a, 0.0), tail)
    complete = known & (end > 0) & (within(end) == 0)
    at = ((end >> shift) - 1) % len(old.number)
    blocks = jax.tree.map(lambda a, b: put(a, at, b, complete), old.blocks, tail)
    number = put(old.number, at, (end >> shift) - 1, complete)
    # where it begins: while it leaves one block, the ends of the next are found, from the last
    # sample backwards
    back, following = within(begin), (begin >> shift) + 1
    last = size - 1 - back
    growing = grown(old.growing, back, buffer[(following * size + last) % held])
    at = (following & 1) * size + last
    heads = put(old.heads, at, jnp.stack(growing), known & (begin >= -size))
    return Parts(
      blocks, number, keep(known, tail, old.tail), heads, keep(known, growing, old.growing)
    )

  def moments(self, parts: Parts, end: Count) -> tuple[Number, Number]:
    """(mean, variance) of the samples [end - length, end)."""
    blocks, tail, size = parts.blocks, parts.tail, 1 << self.shift
    first = jnp.maximum(end - self.length, 0)
    head = Moments(*parts.heads[((first >> self.shift) & 1) * size + (first & (size - 1))])
    in_head, in_tail = -first & (size - 1), jnp.where(end > 0, end & (size - 1), 0)
    inside = (parts.number >= 0) & (parts.number << self.shift >= first)
    total = jnp.maximum(1, end - first)
    mean = (
      jnp.sum(jnp.where(inside, blocks.mean, 0.0)) * size
      + in_head * head.mean
      + in_tail * tail.mean
    ) / total
    about = lambda n, m: m.squares + n * jnp.square(m.mean - mean)
    squares = jnp.sum(jnp.where(inside, about(size, blocks), 0.0))
    squares += jnp.where(in_head > 0, about(in_head, head), 0.0) + jnp.where(
      in_tail > 0, about(in_tail, tail), 0.0
    )
    return mean, squares / total


def rolling_sigma(
  window: int = 1000,
  threshold: Setting = 3.0,
  patience: int = 1,
  two_sided: bool = True,
  warmup: int = 500,
  smooth: int = 1,
  lag: int = 0,
  log: bool = False,
  unit: Real = 1.0,
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
    Detector of one number.
  Blind to: a change slower than window + lag, which the reference absorbs; with `patience`, a
  change that comes and goes faster.
  Reference: the paper, section on change detection.
  """
  good = window >= 2 and patience >= 1 and above(threshold, 0) and min(warmup, window) >= 2
  if not (good and smooth >= 1 and lag >= 0 and 0 < unit < float("inf")):
    raise UserError(
      "rolling_sigma needs window >= 2, patience >= 1, threshold > 0, warmup >= 2, smooth >= "
      "1, lag >= 0, unit > 0; got "
      f"{window}, {patience}, {threshold}, {warmup}, {smooth}, {lag}, {unit}"
    )
  sums, least = Window(window, lag), min(warmup, window)
  return _ruled(sums, threshold, patience, two_sided, least, smooth, log, unit)


def _ruled(
  sums: Window,
  threshold: Setting,
  patience: int,
  two_sided: bool,
  warmup: int,
  smooth: int,
  log: bool,
  unit: Real,
) -> Detector:
  """`rolling_sigma` once its settings are known to be good."""
  held = sums.length + sums.lag

  def init() -> RollingSigmaState:
    recent, buffer = jnp.zeros(smooth), jnp.zeros(held)
    return RollingSigmaState(recent, buffer, jnp.int32(0), jnp.int32(0), sums.empty())

  def update(state: RollingSigmaState, x: ArrayLike) -> tuple[RollingSigmaState, Alarm]:
    x, seen = jnp.asarray(x, jnp.float32), state.seen
    known = ~jnp.isnan(x)
    x = jnp.log(jnp.maximum(x, 1e-9)) if log else x
    recent = put(state.recent, seen % smooth, x, known)
    y = jnp.sum(recent) / jnp.minimum(seen + 1, smooth)
    # before it is read, else XLA copies it; what leaves it here nothing needs
    buffer = put(state.buffer, seen % held, y, known)
    end = seen - sums.lag
    parts = sums.moved(state.parts, buffer, end, known)
    mean, variance = sums.moments(parts, end)
    z = (y - mean) / jnp.maximum(unit * jnp.sqrt(variance), 1e-6)
    beyond, score = judged(jnp.abs(z) if two_sided else z, known & (end >= warmup), threshold)
    run = jnp.where(beyond, state.run + 1, 0)
    seen, kept = keep(known, (seen + 1, run), (seen, state.run))
    new = RollingSigmaState(recent, buffer, seen, kept, parts)
    return new, Alarm(known & (run == patience), score)

  return Detector(init, update, skips=True)
