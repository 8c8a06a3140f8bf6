"""What the detectors over several fields of a residual share: reading the fields, trailing means, a
whitened reference, work that is done once.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from mjx_cl.detectors.base import (
  Alarm,
  Count,
  Detector,
  Flag,
  Number,
  Real,
  Setting,
  Warm,
  above,
  cold,
  demand,
  judged,
  keep,
  standardise,
)
from mjx_cl.detectors.combine import NAMES, is_channel, read
from mjx_cl.errors import UserError
from mjx_cl.rollout.monitor import CHANNELS, Residual
from mjx_cl.types import Array

ALONE = ("reward", "surprise")  # known where the residuals are not


Rows = Float[Array, "channels"]


def split(name: str, channels: str | tuple[str, ...]) -> tuple[str, ...]:
  """Names of channels out of `a+b+c` or a sequence; `groups` is all eight. Unknown, repeated or no
  names are refused for detector `name`.
  """
  groups = [c for c in CHANNELS if c.startswith("group_")]
  named = channels.split("+") if isinstance(channels, str) else channels
  channels = tuple(c for name in named for c in (groups if name == "groups" else [name]))
  if not channels or len(set(channels)) < len(channels) or not all(map(is_channel, channels)):
    raise UserError(
      f"detector {name!r}: channels must be one or several of groups, {NAMES}, each once; got "
      f"{'+'.join(map(str, channels))}"
    )
  return channels


def pick(residual: Residual, channels: tuple[str, ...], log: bool) -> tuple[Rows, Flag]:
  """(x, known): the channels of a monitor.Residual, float32 (len(channels),), and whether all of
  them are known; x is 0 where they are not.

  Args:
    log: ln max(x, 1e-9) of every channel but the reward, which may be negative.
  """
  look = lambda c: read(c, residual)
  ln = lambda x: jnp.log(jnp.maximum(x, 1e-9))
  x = jnp.stack([ln(look(c)) if log and c != "reward" else look(c) for c in channels])
  known = jnp.all(jnp.isfinite(x)) & (residual.valid | all(c in ALONE for c in channels))
  return jnp.where(known, x, 0.0), known


class Trail(NamedTuple):
  """The last samples and their sum.

  Attributes:
    buffer: float32 (smooth, p), a ring.
    total: float32 (p,), sum of the samples held.
    since: int32 (), samples since the last restart.
  """

  buffer: jax.Array
  total: jax.Array
  since: jax.Array

  def size(self) -> Count:
    """How many samples, int32 (); 1 where there is none."""
    return jnp.maximum(1, jnp.minimum(self.since, self.buffer.shape[0]))


def trail(smooth: int, p: int) -> Trail:
  """Nothing held."""
  return Trail(jnp.zeros((smooth, p)), jnp.zeros(p), jnp.int32(0))


def push(state: Trail, x: Rows, known: Flag) -> Trail:
  """Adds x where known. One row of the ring is written, never the whole ring: a masked copy of it
  would be the cost of a step.
  """
  smooth = state.buffer.shape[0]
  at = state.since % smooth
  row = state.buffer[at]
  leaving = jnp.where(state.since >= smooth, row, 0.0)
  total = state.total + jnp.where(known, x - leaving, 0.0)
  return Trail(state.buffer.at[at].set(jnp.where(known, x, row)), total, state.since + known)


def restart(state: Trail, fired: Flag) -> Trail:
  """Forgets the samples where fired; the ring need not be cleared, since rows from before are not
  read again.
  """
  return Trail(state.buffer, jnp.where(fired, 0.0, state.total), jnp.where(fired, 0, state.since))


class Standing(NamedTuple):
  """Trailing means and their reference.

  Attributes:
    trail: of the samples.
    warm: of the trailing means, mean and squares float32 (p,).
  """

  trail: Trail
  warm: Warm


def standing(
  name: str,
  channels: tuple[str, ...],
  log: bool,
  smooth: int,
  warmup: int,
  threshold: Setting,
  scored: Callable[[Rows], Number],
) -> Detector:
  """A detector of trailing means in units of their own deviation over the first `warmup` samples.

    y_t = mean of x_{t-smooth+1..t};  z = (y_t - mean) / max(std, 1e-6), mean and std over the
      warmup - smooth + 1 trailing means of the warm-up;  score = scored(z)
    fired = score > threshold; then the trailing means start from nothing

  The deviation of the mean, not that of a sample over sqrt(smooth): samples of a robot are no
  independent draws. warmup = 0: x is standardised and independent already, z = sqrt(smooth) y.
  Nothing is known during warm-up and for smooth - 1 samples after a restart.

  Args:
    name: of the detector, for what is refused.
    channels: what it watches.
    log: see `pick`.
    smooth: samples of the trailing mean [control steps].
    warmup: samples that fit mean and deviation [control steps].
    threshold: decision level of the score.
    scored: z, float32 (p,) -> score, float32 ().
  """
  at_least = max(2, 2 * smooth)
  demand(
    name,
    smooth=(smooth, smooth >= 1, "at least 1"),
    threshold=(threshold, above(threshold, 0), "above 0"),
    warmup=(warmup, warmup == 0 or warmup >= at_least, "0, or at least twice `smooth` and 2"),
  )
  p = len(channels)

  def update(state: Standing, residual: Residual) -> tuple[Standing, Alarm]:
    x, known = pick(residual, channels, log)
    held = push(state.trail, x, known)
    full = known & (held.since >= smooth)
    if warmup == 0:
      warm, z, ready = state.warm, held.total / jnp.sqrt(jnp.float32(smooth)), full
    else:
      warm, z, ready = standardise(state.warm, held.total / smooth, warmup - smooth + 1)
      warm, ready = keep(full, warm, state.warm), ready & full
    alarm = judged(scored(z), ready, threshold)
    return Standing(restart(held, alarm.fired), warm), alarm

  return Detector(lambda: Standing(trail(smooth, p), cold(p)), update)


def once(due: Flag, compute: Callable[[Any], Any], operands: Any, old: Any) -> Any:
  """`compute(operands)` where due, else `old`; computed only in the steps and streams in which it
  is due, also under vmap.

  `jax.lax.cond` under vmap computes both branches for every stream at every step.

  Args:
    due: bool ().
    compute: pure, operands -> a pytree like `old`; must not close over traced values.
    operands: a pytree.
    old: what is known already.
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
  """The reference of correlated channels.

  Attributes:
    seen: int32 (), samples of the warm-up.
    mean: float32 (p,).
    moment: float32 (p, p), sum of outer products of deviations.
    matrix: float32 (p, p), maps deviations from the mean to uncorrelated units; set once, at the
      end of the warm-up.
  """

  seen: jax.Array
  mean: jax.Array
  moment: jax.Array
  matrix: jax.Array


def whitener(p: int) -> Whitener:
  """Nothing seen: mean 0, identity."""
  return Whitener(jnp.int32(0), jnp.zeros(p), jnp.zeros((p, p)), jnp.eye(p))


def check_whitener(name: str, channels: tuple[str, ...], warmup: int, shrinkage: Real) -> None:
  """Refuses a warm-up or a shrinkage of detector `name` that gives no reference."""
  least = len(channels) + 2
  rule = f"0, or at least {least}, the channels and two"
  demand(
    name,
    warmup=(warmup, warmup == 0 or warmup >= least, rule),
    shrinkage=(shrinkage, 0 <= shrinkage <= 1, "in [0, 1]"),
  )


def whiten(
  state: Whitener, x: Rows, known: Flag, warmup: int, shrinkage: Real
) -> tuple[Whitener, Rows, Flag]:
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
  learning, seen = state.seen < warmup, state.seen + 1
  step = x - state.mean
  mean = state.mean + step / seen
  moment = state.moment + jnp.outer(step, x - mean)
  seen, mean, moment = keep(learning & known, (seen, mean, moment), state[:3])

  def factor(moment: Float[Array, "channels channels"]) -> Float[Array, "channels channels"]:
    std = jnp.maximum(jnp.sqrt(jnp.diag(moment) / (warmup - 1)), 1e-6)
    r = moment / (warmup - 1) / std[:, None] / std
    # shrinkage leaves the diagonal as it is
    r = jnp.where(jnp.eye(len(std), dtype=bool), 1.0, (1 - shrinkage) * r)
    return jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(r), jnp.diag(1 / std), lower=True)

  matrix = once(learning & known & (seen == warmup), factor, moment, state.matrix)
  return Whitener(seen, mean, moment, matrix), matrix @ (x - mean), known & ~learning
