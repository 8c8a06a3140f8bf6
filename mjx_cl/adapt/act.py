"""Which weights act: a moving average of what is learnt, by turns with those of before where an arm
is guarded, and what an abort goes back to.
"""

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


TURN, SKIP, KEPT = 4, 1, 12  # chunks of a turn, of its first that do not count, of those that do


class Guard(NamedTuple):
  """Two sets of weights that act by turns while an adaptation runs; leading (groups,).

  From the first update on, turns of TURN chunks: in three of four acts the side that earns more, in
  the fourth the other. A side's worth is its mean reward over its last KEPT chunks, the first SKIP
  of each turn left out, since the robot comes to them from the other's hands; until both have KEPT
  of them the learner's leads. What acts is what predicts. When the adaptation ends, however it
  does, the side that earned more stays, the learner's where they are equal or nothing is known.
  The idea is that of high confidence policy improvement (Thomas, Theocharous and Ghavamzadeh 2015,
  https://proceedings.mlr.press/v37/thomas15.html), here with means in place of bounds.

  Attributes:
    old: the parameters that acted when the adaptation began.
    new: the moving average of the learner's.
    learnt: bool, an update has been taken since.
    age: int32, chunks since the first update.
    acts: bool, `old` acts in the chunk to come.
    rewards: float32 (groups, 2, KEPT), rewards a step of the last chunks that count, of `old` and
      of `new`; nan where there are none yet.
    counts: int32 (groups, 2), chunks that have counted.
  """

  old: Any
  new: Any
  learnt: jax.Array
  age: jax.Array
  acts: jax.Array
  rewards: jax.Array
  counts: jax.Array


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


def unguarded(params: Any, groups: int) -> Guard:
  """The Guard of streams that have not begun to learn; `params`: leading (groups,)."""
  flags = lambda: jnp.zeros(groups, bool)
  copy = lambda: jax.tree.map(jnp.copy, params)
  unknown = jnp.full((groups, 2, KEPT), jnp.nan)
  none = lambda *shape: jnp.zeros((groups, *shape), jnp.int32)
  return Guard(copy(), copy(), flags(), none(), flags(), unknown, none(2))


def worth(guard: Guard) -> jax.Array:
  """Mean reward a step of both sides, (groups, 2); nan: unknown."""
  return jnp.nanmean(guard.rewards, 2)


def take_turns(
  acting: Any,
  guard: Guard,
  was: jax.Array,
  phase: PhaseState,
  begins: jax.Array,
  reward: jax.Array,
  taken: jax.Array,
  guarded: jax.Array,
) -> tuple[Any, Guard, Weighed]:
  """What acts next of a guarded stream.

  Args:
    acting: what acts otherwise: while adapting the moving average of what is learnt.
    guard: before the chunk.
    was: int32 (groups,), phases before it.
    phase: after it.
    begins: bool (groups,), an adaptation begins.
    reward: float32 (groups,), a step of the chunk.
    taken: int32 (groups,), updates of the chunk.
    guarded: bool (groups,), the arm is.

  Returns:
    (acting', guard', Weighed).
  """
  adapting = was == ADAPTING
  # before the first update `old` acts, whatever `acts` says
  side = jnp.where(guard.learnt & ~guard.acts, 1, 0)
  counts = adapting & (~guard.learnt | (guard.age % TURN >= SKIP))
  rewards, number = jax.vmap(_note)(guard.rewards, guard.counts, side, reward, counts)
  noted = guard._replace(rewards=rewards, counts=number)
  earned, earns = worth(noted)[:, 0], worth(noted)[:, 1]
  worse = earns < earned  # False where either is unknown
  over = ended(was, phase)
  back = guarded & over & guard.learnt & worse
  age = jnp.where(guard.learnt, guard.age + 1, 0)
  learnt = (guard.learnt | (taken > 0)) & ~begins & ~over
  full = jnp.all(number >= KEPT, 1)
  leads = full & worse  # `old` does
  other = (age // TURN) % 4 == 3
  acts = guarded & learnt & jnp.where(other, ~leads, leads)
  old = choose(begins, acting, guard.old)
  new, acting = acting, choose(guarded & (back | acts), old, acting)
  after = Guard(
    old,
    new,
    learnt,
    jnp.where(learnt, age, 0),
    acts,
    jnp.where(begins[:, None, None], jnp.nan, rewards),
    jnp.where(begins[:, None], 0, number),
  )
  return acting, after, Weighed(back, earned, earns)


def _note(
  rewards: jax.Array, counts: jax.Array, side: jax.Array, reward: jax.Array, counts_now: jax.Array
) -> tuple[jax.Array, jax.Array]:
  """One stream's rewards and counts with that of a chunk, where it counts."""
  at = counts[side] % KEPT
  new = rewards.at[side, at].set(jnp.where(counts_now, reward, rewards[side, at]))
  return new, counts.at[side].add(counts_now.astype(jnp.int32))


def choose(where: jax.Array, a: Any, b: Any) -> Any:
  """Of each stream the leaves of `a` where `where` (groups,), else those of `b`."""
  return jax.tree.map(lambda x, y: jnp.where(_wide(where, x), x, y), a, b)


def _wide(x: jax.Array, like: jax.Array) -> jax.Array:
  return x.reshape((-1,) + (1,) * (like.ndim - 1))
