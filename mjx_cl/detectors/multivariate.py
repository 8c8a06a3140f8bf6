"""What the detectors over several fields of a residual share: reading the fields, trailing means, a
whitened reference, work that is done once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.detectors.base import Warm, standardise
from mjx_cl.detectors.combine import NAMES, is_channel, read
from mjx_cl.errors import UserError
from mjx_cl.rollout.monitor import CHANNELS, Residual

ALONE = ("reward", "surprise")  # known where the residuals are not


def split(name: str, channels: str | tuple[str, ...]) -> tuple[str, ...]:
  """Names of channels out of `a+b+c` or a sequence; `groups` is all eight. Unknown, repeated or no
  names are refused for detector `name`.
  """
  channels = tuple(channels.split("+") if isinstance(channels, str) else channels)
  channels = tuple(
    c
    for group in channels
    for c in ([c for c in CHANNELS if c.startswith("group_")] if group == "groups" else [group])
  )
  if not channels or len(set(channels)) < len(channels) or not all(map(is_channel, channels)):
    raise UserError(
      f"detector {name!r}: channels must be one or several of groups, {NAMES}, each once; got "
      f"{'+'.join(channels)}"
    )
  return channels


def pick(residual: Residual, channels: tuple[str, ...], log: bool) -> tuple[jax.Array, jax.Array]:
  """(x, known): the channels of a monitor.Residual, float32 (len(channels),), and whether all of
  them are known; x is 0 where they are not.

  Args:
    log: ln max(x, 1e-9) of every channel but the reward, which may be negative.
  """
  x = jnp.stack(
    [
      jnp.log(jnp.maximum(read(c, residual), 1e-9)) if log and c != "reward" else read(c, residual)
      for c in channels
    ]
  )
  known = jnp.all(jnp.isfinite(x)) & (residual.valid | all(c in ALONE for c in channels))
  return jnp.where(known, x, 0.0), known


def keep(known: jax.Array, new: Any, old: Any) -> Any:
  """`new` where known, else `old`; for leaves small enough to be copied at each step."""
  return jax.tree.map(lambda a, b: jnp.where(known, a, b), new, old)


class Trail(NamedTuple):
  """The last samples and their sum.

  Attributes:
    buffer: float32 (smooth, p), a ring. total: float32 (p,), sum of the samples held. count: int32
      (), samples since the last restart.
  """

  buffer: jax.Array
  total: jax.Array
  count: jax.Array  # type: ignore[assignment]


def trail(smooth: int, p: int) -> Trail:
  """Nothing held."""
  return Trail(jnp.zeros((smooth, p)), jnp.zeros(p), jnp.int32(0))


def push(state: Trail, x: jax.Array, known: jax.Array) -> Trail:
  """Adds x where known. One row of the ring is written, never the whole ring: a masked copy of it
  would be the cost of a step.
  """
  smooth = state.buffer.shape[0]
  at = state.count % smooth
  row = state.buffer[at]
  leaving = jnp.where(state.count >= smooth, row, 0.0)
  total = state.total + jnp.where(known, x - leaving, 0.0)
  return Trail(state.buffer.at[at].set(jnp.where(known, x, row)), total, state.count + known)


def restart(state: Trail, fired: jax.Array) -> Trail:
  """Forgets the samples where fired; the ring need not be cleared, since rows from before are not
  read again.
  """
  return Trail(state.buffer, jnp.where(fired, 0.0, state.total), jnp.where(fired, 0, state.count))


class Standing(NamedTuple):
  """Attributes: trail: Trail. warm: base.Warm of the trailing mean, mean and squares
  float32 (p,).
  """

  trail: Trail
  warm: Warm


def standing(smooth: int, p: int) -> Standing:
  """Nothing seen."""
  return Standing(trail(smooth, p), Warm(jnp.int32(0), jnp.zeros(p), jnp.zeros(p)))


def trailing_z(
  state: Standing, x: jax.Array, known: jax.Array, smooth: int, warmup: int
) -> tuple[Standing, jax.Array, jax.Array]:
  """Trailing mean of `smooth` samples in units of its own deviation over the first `warmup`
  samples.

    y_t = mean of x_{t-smooth+1..t};  z = (y_t - mean) / max(std, 1e-6), mean and std over the
    warmup - smooth + 1 trailing means of the warm-up

  The deviation of the mean, not that of a sample over sqrt(smooth): samples of a robot are no
  independent draws. warmup = 0: x is standardised and independent already, z = sqrt(smooth) y.

  Returns:
    (state', z (p,), ready): ready is false during warm-up and for smooth - 1 samples after a
    restart.
  """
  held = push(state.trail, x, known)
  full = held.count >= smooth
  if warmup == 0:
    return Standing(held, state.warm), held.total / jnp.sqrt(jnp.float32(smooth)), full & known
  warm, z, ready = standardise(state.warm, held.total / smooth, warmup - smooth + 1)
  return Standing(held, keep(known & full, warm, state.warm)), z, ready & full & known


def once(due: jax.Array, compute: Callable[[Any], Any], operands: Any, old: Any) -> Any:
  """`compute(operands)` where due, else `old`; computed only in the steps and streams in which it
  is due, also under vmap.

  `jax.lax.cond` under vmap computes both branches for every stream at every step.

  Args:
    due: bool (). compute: pure, operands -> a pytree like `old`; must not close over traced values.
  """
  return _once(compute, 0)(due, operands, old)


def _once(compute: Callable[[Any], Any], rank: int) -> Callable[[Any, Any, Any], Any]:
  """`once` for `rank` leading axes of streams."""
  alone = lambda lane: jax.lax.cond(lane[0], lambda: compute(lane[1]), lambda: lane[2])

  @jax.custom_batching.custom_vmap
  def run(due: jax.Array, operands: Any, old: Any) -> Any:
    if rank == 0:
      return alone((due, operands, old))
    flat = lambda x: x.reshape((-1,) + x.shape[rank:])
    lanes = lambda: jax.tree.map(
      lambda x, like: x.reshape(like.shape),
      jax.lax.map(alone, jax.tree.map(flat, (due, operands, old))),
      old,
    )
    return jax.lax.cond(jnp.any(due), lanes, lambda: old)

  @run.def_vmap
  def batched(size: int, is_batched: Any, *args: Any) -> tuple[Any, Any]:
    args = jax.tree.map(
      lambda x, b: x if b else jnp.broadcast_to(x, (size,) + x.shape), args, tuple(is_batched)
    )
    out = _once(compute, rank + 1)(*args)
    return out, jax.tree.map(lambda _: True, out)

  return run


class Whitener(NamedTuple):
  """Attributes:
  count: int32 (), samples of the warm-up seen. mean: float32 (p,). moment: float32 (p, p), sum of
  outer products of deviations. matrix: float32 (p, p), maps deviations from the mean to
  uncorrelated units; set once, at the end of the warm-up.
  """

  count: jax.Array  # type: ignore[assignment]
  mean: jax.Array
  moment: jax.Array
  matrix: jax.Array


def whitener(p: int) -> Whitener:
  """Nothing seen: mean 0, identity."""
  return Whitener(jnp.int32(0), jnp.zeros(p), jnp.zeros((p, p)), jnp.eye(p))


def whiten(
  state: Whitener, x: jax.Array, known: jax.Array, warmup: int, shrinkage: float
) -> tuple[Whitener, jax.Array, jax.Array]:
  """Y = M (x - mean) with M' M = S^-1: uncorrelated, of unit deviation, in the healthy stream.

    S = D ((1 - shrinkage) R + shrinkage I) D;  D = max(std, 1e-6), R = correlations, both of the
    first `warmup` samples (n - 1)
    S = L L',  M = L^-1, one Cholesky factorisation when the warm-up ends

  Returns:
    (state', y (p,), ready): ready is false during warm-up. warmup = 0 takes x as uncorrelated and
    standardised already.
  """
  if warmup == 0:
    return state, x, known
  learning = state.count < warmup
  count = state.count + 1
  step = x - state.mean
  mean = state.mean + step / count
  moment = state.moment + jnp.outer(step, x - mean)
  count, mean, moment = keep(learning & known, (count, mean, moment), state[:3])

  def factor(moment: jax.Array) -> jax.Array:
    p = moment.shape[0]
    std = jnp.maximum(jnp.sqrt(jnp.diag(moment) / (warmup - 1)), 1e-6)
    r = moment / (warmup - 1) / std[:, None] / std
    r = jnp.where(
      jnp.eye(p, dtype=bool), 1.0, (1 - shrinkage) * r
    )  # shrinkage leaves the diagonal as it is
    return jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(r), jnp.diag(1 / std), lower=True)

  matrix = once(learning & known & (count == warmup), factor, moment, state.matrix)
  return Whitener(count, mean, moment, matrix), matrix @ (x - mean), known & ~learning
