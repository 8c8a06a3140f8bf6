"""KSWIN on one residual: the newest samples against a random draw of the older ones, by the
Kolmogorov-Smirnov test.

Any change of the distribution counts, though spread and shape move F less than a shift; no unit is
needed. The p-value is that of one test on independent samples; tests overlap and residuals swing
with the gait, so the threshold is calibrated. Differences from river.drift.KSWIN: p < alpha where
it has p <= alpha; it also wants D > 0.1, which p decides alone below some 300 samples; its draws
start again from its seed after an alarm; it tests at each sample (every = 1, window = 100,
stat_size = 30, threshold = 5.2983). The defaults here span a gait cycle or two and test every tenth
sample, as neighbouring tests share nearly all samples.

Between tests the score is that of the last one, nan until the window is full. The draws come from a
key in the state (from `seed`), so equal streams give equal alarms; streams started alike share
their draws.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Int, UInt32

from mjx_cl.detectors.base import (
  Alarm,
  Count,
  Detector,
  Flag,
  Number,
  Setting,
  above,
  demand,
  scalar,
)
from mjx_cl.types import Array


class KswinState(NamedTuple):
  """What the detector remembers.

  Attributes:
    buffer: float32 (window,), the last samples, a ring.
    seen: int32 (), samples.
    held: int32 (), samples since the last restart, at most `window`.
    key: uint32 (2,), of the draws.
    tests: int32 (), draws made.
    score: float32 (), of the last test.
  """

  buffer: jax.Array
  seen: jax.Array
  held: jax.Array
  key: jax.Array
  tests: jax.Array
  score: jax.Array


def surprisals(size: int) -> Float[np.ndarray, " values"]:
  """-ln p of the exact two-sided test of two samples of `size` without ties, for D = 0, 1/size ..
  1, float32 (size + 1,).

  P(D >= h / size) = 2 sum_{k >= 1} (-1)^(k-1) C(2 size, size - k h) / C(2 size, size), by reflected
  paths, in whole numbers.
  """
  ways = lambda h: (
    2 * sum((-1) ** (k - 1) * math.comb(2 * size, size - k * h) for k in range(1, size // h + 1))
  )
  return np.array(
    [0.0] + [math.log(math.comb(2 * size, size)) - math.log(ways(h)) for h in range(1, size + 1)],
    np.float32,
  )


def draw(key: UInt32[Array, "2"], tests: Count, older: int, number: int) -> Int[Array, " number"]:
  """`number` different indices below `older`, every set as likely, int32 (number,): Floyd's method,
  whose cost does not grow with `older`.
  """
  u = jax.random.uniform(
    jax.random.fold_in(jax.random.wrap_key_data(key, impl="threefry2x32"), tests), (number,)
  )

  def turn(chosen: jax.Array, i: jax.Array) -> tuple[jax.Array, None]:
    last = older - number + i
    pick = jnp.floor(u[i] * (last + 1)).astype(jnp.int32)
    return jnp.where(
      jnp.arange(number) == i, jnp.where(jnp.any(chosen == pick), last, pick), chosen
    ), None

  return jax.lax.scan(turn, jnp.full(number, -1, jnp.int32), jnp.arange(number), unroll=4)[0]


def distance(a: Float[Array, " size"], b: Float[Array, " size"]) -> Count:
  """Size times the Kolmogorov-Smirnov distance of two samples of equal size, int32 ().

  One sample of each at a time: faster than a table of all pairs, which the compiler sums along its
  rows.
  """
  both = jnp.concatenate([a, b])

  def turn(ahead: jax.Array, pair: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
    return ahead + jnp.where(pair[0] <= both, 1, 0) - jnp.where(pair[1] <= both, 1, 0), None

  return jnp.max(jnp.abs(jax.lax.scan(turn, jnp.zeros(both.shape, jnp.int32), (a, b), unroll=4)[0]))


def tested(
  state: KswinState, buffer: Float[Array, " window"], due: Flag, table: Float[np.ndarray, " values"]
) -> tuple[Count, Number]:
  """(draws made, -ln P): where due, of the newest samples of the ring against a draw of the older
  ones. A loop of one turn or none: under vmap a cond would test at every sample, as would a turn
  that the compiler may hoist for it changes no carry.
  """
  size, window = len(table) - 1, len(buffer)
  at = lambda place: buffer[(state.seen + 1 + place) % window]  # place 0 is the oldest sample

  def turn(carry: tuple[Flag, Count, Number]) -> tuple[Flag, Count, Number]:
    _, tests, _ = carry
    new, old = at(window - size + jnp.arange(size)), at(draw(state.key, tests, window - size, size))
    return jnp.bool_(False), tests + 1, jnp.asarray(table)[distance(new, old)]

  start = due, state.tests, state.score
  return jax.lax.while_loop(lambda carry: carry[0], turn, start)[1:]


@scalar
def kswin(
  threshold: Setting = 7.0,
  window: int = 300,
  stat_size: int = 40,
  every: int = 10,
  keep: bool = False,
  seed: int = 0,
) -> Detector:
  """Two-sided Kolmogorov-Smirnov windowing: is the newest part of a sliding window distributed as
  the rest of it?

    a = newest `stat_size` samples,  b = as many drawn without replacement from the `window` -
    `stat_size` older ones
    D = max_x |F_a(x) - F_b(x)|,  score = -ln P(D or more), exact for two samples without ties
    fired = score > threshold, at a test; then the window is filled anew, or from a on if `keep`

  Args:
    threshold: -ln(alpha); 7 had one alarm in 20,000 independent samples, 6 to 6.5 one in 8,400 (p
      is discrete). May be traced.
    window: samples of the window [control steps].
    stat_size: samples on each side of the test [control steps]; with ties (a constant stream) the
      test errs on the quiet side.
    every: samples from test to test [control steps]; an alarm comes up to every - 1 samples late.
    keep: after an alarm the newest `stat_size` samples stay in the window, as in the paper; False:
      none, as in river.
    seed: of the draws.
  Blind to: a change slower than the window, which the older part takes in; a shift of few samples.
  It fires at any change within the window's reach, of the healthy gait as well.
  Source: Raab, Heusinger and Schleif 2020, Neurocomputing 416, 340-351; the distribution of D:
  Gnedenko and Korolyuk 1951.
  """
  demand(
    "kswin",
    threshold=(threshold, above(threshold, 0), "above 0"),
    stat_size=(stat_size, 2 <= stat_size <= 1000, "from 2 to 1,000"),
    window=(window, window >= 2 * stat_size, "at least twice stat_size"),
    every=(every, every >= 1, "at least 1"),
    seed=(seed, 0 <= seed < 2**32, "from 0 to 2^32 - 1"),
  )
  table = surprisals(stat_size)

  def init() -> KswinState:
    zero = lambda: jnp.int32(0)
    key = jax.random.key_data(jax.random.key(seed, impl="threefry2x32"))
    return KswinState(jnp.zeros(window), zero(), zero(), key, zero(), jnp.float32(jnp.nan))

  def update(state: KswinState, x: ArrayLike) -> tuple[KswinState, Alarm]:
    buffer = state.buffer.at[state.seen % window].set(jnp.asarray(x, jnp.float32))
    seen, held = state.seen + 1, jnp.minimum(state.held + 1, window)
    due = (held == window) & (seen % every == 0)

    tests, score = tested(state, buffer, due, table)
    fired = due & (score > threshold)
    held = jnp.where(fired, stat_size if keep else 0, held)
    return KswinState(buffer, seen, held, state.key, tests, score), Alarm(fired, score)

  return Detector(init, update)
