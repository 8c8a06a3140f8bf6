"""Which weights act: a moving average of what is learnt, and what an abort goes back to."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.adapt.decide import ABORTED, ADAPTING, SIGNALS, PhaseState


class Before(NamedTuple):
  """What an adaptation began with, and what that was worth; leading (groups,).

      back  =  aborted  and  mean reward of the last `patience` chunks < mean reward of the chunks
      between the alarm and the first update

  The weights of before the adaptation are still at work while the replay fills (start_windows). The
  two sides are earned at two times: under the same fault where a true alarm began the adaptation;
  but one begun by a false alarm compares a healthy robot with one that may have broken since, which
  favours going back, and so does a fault under which the reward goes on falling. Where an abort
  comes before `patience` chunks have been lived, the mean is over those that have. A stream that is
  aborted before its first update has nothing to take back. Moments, slow critic and range stay
  those of the learner, which takes no other update.

  Attributes:
    params: the parameters that acted when the adaptation began.
    reward: float32, sum of the mean rewards of the chunks that they have lived since.
    chunks: float32, number of these chunks.
    learnt: bool, an update has been taken since.
  """

  params: Any
  reward: jax.Array
  chunks: jax.Array
  learnt: jax.Array


class Weighed(NamedTuple):
  """What an abort was judged by, leading (groups,).

  Attributes:
    back: bool, the weights of before the adaptation are put back.
    earned: float32, mean reward a step of those.
    earns: float32, of those that have learnt.
  """

  back: jax.Array
  earned: jax.Array
  earns: jax.Array


def follow(acting: Any, params: Any, number: jax.Array, average: jax.Array | float) -> Any:
  """`acting` drawn towards the parameters that learn, where `number` (groups,) of updates is above
  0: acting + average (params - acting).
  """
  rate = jnp.where(number > 0, average, 0.0)
  return jax.tree.map(lambda a, p: a + _wide(rate, a) * (p - a), acting, params)


def ended(was: jax.Array, phase: PhaseState) -> jax.Array:
  """Which adaptations ended in a chunk, bool (groups,); `was`: phases before it."""
  return (was == ADAPTING) & (phase.phase != ADAPTING)


def put_back(
  acting: Any,
  before: Before,
  phase: PhaseState,
  was: jax.Array,
  begins: jax.Array,
  reward: jax.Array,
  taken: jax.Array,
  rollback: jax.Array,
) -> tuple[Any, Before, Weighed]:
  """The weights of before an adaptation, where it was aborted and they earned more.

  Args:
    acting: what acts otherwise.
    before: what the adaptation began with.
    phase: after the chunk.
    was: int32 (groups,), phases before it.
    begins: bool (groups,), an adaptation begins.
    reward: float32 (groups,), a step of the chunk.
    taken: int32 (groups,), updates of the chunk.
    rollback: bool (groups,), the arm goes back.

  Returns:
    (acting', before', Weighed).
  """
  lived = (was == ADAPTING) & ~before.learnt  # the chunk just lived is one of the old weights
  reward_sum, chunks = before.reward + jnp.where(lived, reward, 0.0), before.chunks + lived
  earned = reward_sum / chunks
  earns = jnp.nanmean(phase.ring[:, :, SIGNALS.index("reward")], 1)
  back = rollback & ended(was, phase) & (phase.phase == ABORTED) & before.learnt & (earns < earned)
  acting = choose(back, before.params, acting)
  after = Before(
    choose(begins, acting, before.params),
    jnp.where(begins, 0.0, reward_sum),
    jnp.where(begins, 0.0, chunks),
    ~begins & (before.learnt | (taken > 0)),
  )
  return acting, after, Weighed(back, earned, earns)


def choose(where: jax.Array, a: Any, b: Any) -> Any:
  """Of each stream the leaves of `a` where `where` (groups,), else those of `b`."""
  return jax.tree.map(lambda x, y: jnp.where(_wide(where, x), x, y), a, b)


def _wide(x: jax.Array, like: jax.Array) -> jax.Array:
  return x.reshape((-1,) + (1,) * (like.ndim - 1))
