"""Methods of the arms `ratchet` and `swift-ratchet`: what is learnt goes back to its best where it
falls behind it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.adapt.methods.base import Acts, Method, View, follow
from mjx_cl.adapt.phases import ADAPTING
from mjx_cl.adapt.trees import choose
from mjx_cl.dreamer.agent import TrainState

SPAN = 16  # chunks that are judged together: an episode of 1,000 steps, whose start earns less
FEW = 6  # chunks from which on a mean is compared
BEHIND = 0.1  # of what the best earned, by which a mean must lie below it
LESS = 0.05  # the same where the adaptation ends
LEAST = 2.0**-4  # share of a step


class Ratchet(NamedTuple):
  """The best weights of an adaptation so far.

  The first are those that it began with, judged by the chunks between the alarm and the first
  update. The chunks from there on are cut into spans of SPAN; the weights of the middle of the span
  that earned most are kept. Where the mean reward of the last SPAN chunks (of those since the first
  update or the last return, FEW at least) lies below what the best earned by BEHIND and by three
  standard errors, the variance that of the last chunks, what acts goes back to the best at once,
  the learner, with the slow critic, in place of its next chunk of updates; from then on updates
  move the weights half as far, at the least LEAST of it. Moments and replay stay. Where the first
  FEW chunks after a return lie as far behind, it is the robot that has changed: what they earn is
  what the best are worth now. When the adaptation ends, however it does, the best act on if the
  last chunks earned less by LESS.

  An actor that learns in dreams of a few thousand records can come to exploit what its world model
  has wrong, and unlearn what it could do; the records of that teach the model. It is early stopping
  (Prechelt 1998, https://doi.org/10.1007/3-540-49430-8_3) that goes on learning.

  Attributes:
    best: the weights kept.
    worth: float32 (), what they earned, mean reward a step.
    number: int32 (), chunks of that mean; 0: none yet.
    middle: weights of the middle of the running span.
    rewards: float32 (SPAN,), rewards a step of the last chunks, the latest first.
    chunks: int32 (), chunks since the alarm, since the first update, or since the last return.
    learnt: bool (), an update has been taken since the adaptation began.
    back: bool (), the learner is to go back.
    stride: float32 (), share of an update's step that is taken.
  """

  best: Any
  worth: jax.Array
  number: jax.Array
  middle: Any
  rewards: jax.Array
  chunks: jax.Array
  learnt: jax.Array
  back: jax.Array
  stride: jax.Array


def init(params: Any) -> Ratchet:
  """Of a stream that has not begun to learn."""
  no, none = jnp.bool_(False), jnp.int32(0)
  rewards, whole = jnp.zeros(SPAN), jnp.float32(1)
  return Ratchet(params, jnp.float32(0), none, params, rewards, none, no, no, whole)


def act(held: Ratchet, view: View) -> Acts:
  """What acts next, see Ratchet."""
  new = follow(view.acted, view.learner, view.rate)
  lived = view.was == ADAPTING
  chunks = held.chunks + lived
  latest = jnp.roll(held.rewards, 1).at[0].set(view.reward)
  rewards = jnp.where(lived, latest, held.rewards)
  known = jnp.minimum(chunks, SPAN)
  mask = jnp.arange(SPAN) < known
  mean = jnp.where(mask, rewards, 0).sum() / known
  spread = jnp.where(mask, rewards - mean, 0) ** 2
  spread = spread.sum() / jnp.maximum(known - 1, 1)

  starts = ~held.learnt & (view.taken > 0) & (known > 0)  # the chunks so far were of the old
  middle = choose(chunks % SPAN == SPAN // 2, new, held.middle)
  better = held.learnt & lived & (chunks % SPAN == 0) & (mean > held.worth)
  best = choose(view.begins, new, choose(better, middle, held.best))
  worth, number = choose(starts | better, (mean, known), (held.worth, held.number))

  lack, scale = worth - mean, jnp.abs(worth)
  error = spread * (1 / known + 1 / number)
  enough = held.learnt & lived & (chunks >= FEW) & (number > 0)
  behind = enough & (lack > BEHIND * scale) & (lack**2 > 9 * error) & ~view.over
  changed = behind & (held.stride < 1) & (chunks == FEW)  # the best themselves
  worth, number = choose(changed, (mean, known), (worth, number))
  back = behind & ~changed
  end = enough & (lack > LESS * scale) & view.over
  learnt = (held.learnt | (view.taken > 0)) & ~view.begins & ~view.over
  after = Ratchet(
    best,
    worth,
    jnp.where(view.begins, 0, number),
    middle,
    rewards,
    jnp.where(view.begins | starts | back, 0, chunks),
    learnt,
    back | (held.back & (view.taken == 0) & learnt),
    jnp.where(view.begins, 1, jnp.where(back, jnp.maximum(held.stride / 2, LEAST), held.stride)),
  )
  return Acts(choose(back | end, best, new), after)


def keep(held: Ratchet, before: TrainState, after: TrainState) -> TrainState:
  """The best where the learner is to go back to it, else the update as far as it is taken."""
  step = lambda old, new: jnp.where(held.stride == 1, new, old + held.stride * (new - old))
  taken = after._replace(params=jax.tree.map(step, before.params, after.params))
  best = after._replace(params=held.best, slow=held.best["val"])
  return choose(held.back, best, taken)


METHOD = Method(init, act, keep, copies=2)
