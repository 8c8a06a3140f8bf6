"""ADWIN on one residual: a window that is cut wherever its two parts differ in mean.

The bound is meant for samples in [0, 1]. In the form with variance, the variance carries the scale,
and only the term 2/3 m L, the price of a bounded but skewed sample, has the unit of x: on samples
much smaller than 1 it rules and the rule is deaf, on samples much larger it vanishes and what is
left is a test of a normal mean. Warm-up deviations as unit set that scale; they are not bounded, so
delta is then a level, not a guarantee.

Only every `clock`-th sample is a check, and only beyond `grace_period` samples: an alarm comes up
to clock - 1 samples later than the evidence for it, and between checks the score is that of the
last one, of the window before anything was dropped.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from mjx_cl.detectors.base import (
  Alarm,
  Detector,
  Flag,
  Number,
  Setting,
  Warm,
  above,
  at_least,
  cold,
  demand,
  scalar,
  standardise,
)
from mjx_cl.detectors.base import keep as kept


class Buckets(NamedTuple):
  """The window as an exponential histogram: a bucket of row i stands for 2^i samples; the oldest is
  place 0 of the highest row in use.

  Attributes:
    mean: float32 (max_buckets, rows), 0 where unused.
    squares: float32 (max_buckets, rows), sums of squared deviations, 0 where unused.
    number: int32 (rows,), buckets in use.
  """

  mean: jax.Array
  squares: jax.Array
  number: jax.Array


class AdwinState(NamedTuple):
  """What the detector remembers.

  Attributes:
    warm: scale of the stream.
    window: see Buckets.
    tick: int32 (), samples since the window began.
    score: float32 (), of the last check.
  """

  warm: Warm
  window: Buckets
  tick: jax.Array
  score: jax.Array


def empty(max_buckets: int, rows: int) -> Buckets:
  """A window of no samples."""
  return Buckets(
    jnp.zeros((max_buckets, rows)), jnp.zeros((max_buckets, rows)), jnp.zeros(rows, jnp.int32)
  )


def insert(window: Buckets, x: Number) -> Buckets:
  """Adds a sample as a bucket of row 0. A full row first merges its two oldest buckets into one of
  the next row, so a carry runs up the full rows; beyond the last row it is lost, and the window
  slides.
  """
  mean, squares, number = window
  places, rows = mean.shape
  row = jnp.arange(rows)
  stop = jnp.min(jnp.where(number == places, rows, row))  # first row with a free place
  gets, gives = row <= stop, row < stop
  size = jnp.float32(2.0) ** row
  up_mean = (mean[0] + mean[1]) / 2
  up_squares = squares[0] + squares[1] + size / 2 * jnp.square(mean[0] - mean[1])
  number = jnp.where(gives, number - 2, number)
  place = gets & (jnp.arange(places)[:, None] == number)

  def settle(old: jax.Array, first: jax.Array, up: jax.Array) -> jax.Array:
    left = jnp.where(gives, jnp.concatenate([old[2:], jnp.zeros((2, rows))]), old)
    return jnp.where(place, jnp.concatenate([first[None], up[:-1]]), left)

  return Buckets(
    settle(mean, x, up_mean), settle(squares, jnp.float32(0), up_squares), number + gets
  )


def drop_oldest(window: Buckets) -> Buckets:
  """Without the oldest bucket."""
  row = jnp.arange(window.number.shape[0])
  oldest = row == jnp.max(jnp.where(window.number > 0, row, -1))
  left = lambda old: jnp.where(
    oldest, jnp.concatenate([old[1:], jnp.zeros((1, row.shape[0]))]), old
  )
  return Buckets(left(window.mean), left(window.squares), window.number - oldest)


def strongest_cut(window: Buckets, shortest: int) -> Number:
  """The largest -ln(delta) at which some cut of the window is just significant, float32 (); -inf
  where none is allowed yet.
  """
  places, rows = window.mean.shape
  in_order = lambda a: a.T[::-1].reshape(-1)  # oldest first
  held = in_order(jnp.arange(places)[:, None] < window.number)
  n = jnp.where(
    held, in_order(jnp.broadcast_to(jnp.float32(2.0) ** jnp.arange(rows), (places, rows))), 0.0
  )
  mean = in_order(window.mean)
  width = jnp.sum(n)
  centre = jnp.sum(n * mean) / width
  variance = (
    jnp.sum(jnp.where(held, in_order(window.squares) + n * jnp.square(mean - centre), 0.0)) / width
  )
  n0, u0 = jnp.cumsum(n), jnp.cumsum(n * (mean - centre))
  n1 = width - n0
  allowed = (n0 >= shortest) & (n1 >= shortest)
  # the parts' sums about the centre are u0 and -u0
  difference = jnp.abs(u0 / jnp.maximum(n0, 1) + u0 / jnp.maximum(n1, 1))
  m = 1 / jnp.maximum(n0 - shortest + 1, 1) + 1 / jnp.maximum(n1 - shortest + 1, 1)
  linear, root = 2 / 3 * m, jnp.sqrt(2 * m * variance)
  # linear y^2 + root y = difference, without cancellation
  y = 2 * difference / (root + jnp.sqrt(root * root + 4 * linear * difference))
  return jnp.max(jnp.where(allowed, y * y, -jnp.inf)) - jnp.log(2 * jnp.log(width))


def checked(
  window: Buckets, due: Flag, last: Number, threshold: Setting, shortest: int
) -> tuple[Buckets, Number]:
  """(window after the cuts, score before them): a loop of no turn where nothing is due, so that
  under vmap the test costs only where some stream is due; the score is `last` there.
  """

  def turn(carry: tuple[Buckets, Flag, Number, Flag]) -> tuple[Buckets, Flag, Number, Flag]:
    window, _, score, first = carry
    now = strongest_cut(window, shortest)
    cut = now > threshold
    return (
      kept(cut, drop_oldest(window), window),
      cut,
      jnp.where(first, now, score),
      jnp.bool_(False),
    )

  window, _, score, _ = jax.lax.while_loop(
    lambda carry: carry[1], turn, (window, due, last, jnp.bool_(True))
  )
  return window, jnp.where(jnp.isneginf(score), jnp.nan, score)


@scalar
def adwin(
  threshold: Setting = 6.2146,
  clock: int = 32,
  grace_period: int = 10,
  max_buckets: int = 5,
  min_window_length: int = 5,
  rows: int = 16,
  keep: bool = False,
  warmup: int = 1000,
) -> Detector:
  """Two-sided ADWIN: a window as long as its samples agree, kept as O(log n) buckets, tested at
  every border between two of them.

    parts of n0 older and n1 newer samples, W = n0 + n1, means u0, u1, variance s2 of the window
    significant at delta where |u0 - u1| > sqrt(2 m s2 L) + 2/3 m L,  L = ln(2 ln(W) / delta),
      m = 1 / (n0 - min_window_length + 1) + 1 / (n1 - min_window_length + 1)
    score = largest -ln(delta) at which a border would just be significant
    fired = score > threshold, at a check; then the oldest buckets go, one by one, until no border
      is significant; then, unless `keep`, the rest goes too

  Args:
    threshold: -ln(delta), compared with the score; 6.2146 is delta = 0.002. May be traced.
    clock: samples from check to check [control steps].
    grace_period: samples that a window must exceed to be checked [control steps].
    max_buckets: buckets of one size; more make finer borders.
    min_window_length: samples that either part must have [control steps].
    rows: bucket sizes 1, 2, 4 .. 2^(rows-1); beyond max_buckets (2^rows - 1) samples, 327,675 by
      default, the oldest are forgotten.
    keep: after an alarm keep what lies after the cut, as in the paper; one change then often alarms
      at several checks. False starts from an empty window.
    warmup: samples that scale the stream and enter no window [control steps]; 0: x as it is.
  Blind to: a change of variance alone; a change that is undone within `clock` samples; a shift that
  2/3 m L hides (warmup = 0, small unit).
  Source: Bifet and Gavalda 2007, SIAM International Conference on Data Mining, 443-448, in the form
  with variance; warmup = 0 alarms where river.drift.ADWIN does.
  """
  demand(
    "adwin",
    threshold=(threshold, above(threshold, 0), "above 0"),
    **at_least(1, clock=clock, grace_period=grace_period, min_window_length=min_window_length),
    **at_least(2, max_buckets=max_buckets),
    rows=(rows, 1 <= rows <= 24, "from 1 to 24"),
    warmup=(warmup, warmup == 0 or warmup >= 2, "0, or at least 2"),
  )

  def init() -> AdwinState:
    return AdwinState(cold(), empty(max_buckets, rows), jnp.int32(0), jnp.float32(jnp.nan))

  def update(state: AdwinState, x: ArrayLike) -> tuple[AdwinState, Alarm]:
    warm, z, ready = standardise(state.warm, jnp.asarray(x, jnp.float32), warmup)
    tick, window = state.tick + 1, insert(state.window, z)
    width = jnp.sum(window.number * 2 ** jnp.arange(rows))
    due = ready & (tick % clock == 0) & (width > grace_period)
    window, score = checked(window, due, state.score, threshold, min_window_length)
    fired = due & (score > threshold)
    new = AdwinState(warm, window, tick, score)
    start = init()._replace(warm=warm)
    return kept(ready & ~(fired & (not keep)), new, start), Alarm(fired, score)

  return Detector(init, update)
