"""Method of arm `guarded`: old and new weights act by turns, and the better ones stay."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.adapt.methods.base import Acts, Method, View, follow
from mjx_cl.adapt.phases import ADAPTING
from mjx_cl.adapt.trees import choose

TURN, SKIP, KEPT = 4, 1, 12  # chunks of a turn, of its first that do not count, of those that do
FEW = 4  # chunks of each side from which on a difference may be clear
OFTEN, RARE = 4, 16  # one of so many turns is the other side's; RARE: the learner clearly leads


class Guard(NamedTuple):
  """Two sets of weights that act by turns while an adaptation runs.

  From the first update on, turns of TURN chunks: one side leads, in every fourth turn acts the
  other. A side's worth is its mean reward over its last KEPT chunks, the first SKIP of each turn
  left out, since the robot comes to them from the other's hands. The learner's leads, unless the
  old clearly earn more: by two standard errors of the difference of both means (Welch's), of FEW
  chunks each at least. Where the learner's clearly earn more the old act in every sixteenth turn
  alone. What acts is what predicts. When the adaptation ends, however it
  does, the side that earned more stays, the learner's where they are equal or nothing is known.
  The idea is that of high confidence policy improvement (Thomas, Theocharous and Ghavamzadeh 2015,
  https://proceedings.mlr.press/v37/thomas15.html), here with means in place of bounds.

  Attributes:
    old: the parameters that acted when the adaptation began.
    new: the moving average of the learner's.
    learnt: bool (), an update has been taken since.
    age: int32 (), chunks since the first update.
    acts: bool (), `old` acts in the chunk to come.
    rewards: float32 (2, KEPT), rewards a step of the last chunks that count, of `old` and of `new`;
      nan where there are none yet.
    counts: int32 (2,), chunks that have counted.
  """

  old: Any
  new: Any
  learnt: jax.Array
  age: jax.Array
  acts: jax.Array
  rewards: jax.Array
  counts: jax.Array


def init(params: Any) -> Guard:
  """Of a stream that has not begun to learn."""
  no, none = jnp.bool_(False), jnp.int32(0)
  return Guard(params, params, no, none, no, jnp.full((2, KEPT), jnp.nan), jnp.zeros(2, jnp.int32))


def hides(guard: Guard) -> jax.Array:
  """The old weights have acted."""
  return guard.acts


def act(guard: Guard, view: View) -> Acts:
  """What acts next, see Guard."""
  new = follow(choose(guard.learnt, guard.new, view.acted), view.learner, view.rate)
  adapting = view.was == ADAPTING
  # before the first update `old` acts, whatever `acts` says
  side = jnp.where(guard.learnt & ~guard.acts, 1, 0)
  counts = adapting & (~guard.learnt | (guard.age % TURN >= SKIP))
  at = guard.counts[side] % KEPT
  rewards = guard.rewards.at[side, at].set(jnp.where(counts, view.reward, guard.rewards[side, at]))
  number = guard.counts.at[side].add(counts.astype(jnp.int32))
  earned, earns = jnp.nanmean(rewards, 1)
  worse = earns < earned  # False where either is unknown
  spread = jnp.nanvar(rewards, 1) / jnp.maximum(jnp.minimum(number, KEPT) - 1, 1)  # of a mean
  clear = jnp.all(number >= FEW) & ((earns - earned) ** 2 > 4 * spread.sum())
  back = view.over & guard.learnt & worse
  age = jnp.where(guard.learnt, guard.age + 1, 0)
  learnt = (guard.learnt | (view.taken > 0)) & ~view.begins & ~view.over
  leads = clear & worse  # `old` does
  period = jnp.where(clear & ~worse, RARE, OFTEN)
  other = (age // TURN) % period == period - 1
  acts = learnt & jnp.where(other, ~leads, leads)
  old = choose(view.begins, new, guard.old)
  after = Guard(
    old,
    new,
    learnt,
    jnp.where(learnt, age, 0),
    acts,
    jnp.where(view.begins, jnp.nan, rewards),
    jnp.where(view.begins, 0, number),
  )
  return Acts(choose(back | acts, old, new), after, back, earned, earns)


METHOD = Method(init, act, hides=hides, copies=2, weighs=True)
