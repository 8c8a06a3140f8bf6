"""Method of arm `guarded`: old and new weights act by turns, the new stay where they win."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.adapt.methods.base import Acts, Method, View, follow
from mjx_cl.adapt.phases import ADAPTING
from mjx_cl.adapt.trees import choose

TURN, SKIP = 4, 1  # chunks of a turn, and of its first that do not count
KEPT = 16  # chunks of a side that count: an episode of 1,000 steps, whose start earns less
CHANGING = 6  # of the learner's while it acts seldom or has only begun
FEW = 4  # chunks of each side from which on a difference may be clear
NEVER = 2**30  # turns
GRACE = 48  # chunks from the first update on in which the new weights alone act
MARGIN = 0.05  # of what the old earn, by which the learner's must earn more to stay


class Guard(NamedTuple):
  """Two sets of weights that act by turns while an adaptation runs.

  The learner's act alone for GRACE chunks after the first update: who learns gets worse before it
  gets better, and learns from what it does itself. Then, or as soon as they earn less than the old
  earned before that update, by three standard errors, come turns of TURN chunks. One side leads,
  and of every `period` turns one is the other's. A side's worth is its mean reward over its last
  KEPT chunks (of the learner's CHANGING while it does not lead), the first SKIP of each turn left
  out, since the robot comes to them from the other's hands. The learner's leads, unless the old
  clearly earn more: by two standard errors of the difference of the means, the variance pooled, of
  FEW chunks each at least.

    period  =  2    while a side has fewer chunks
               4    where the old earn more, but not clearly
               4, 8, then 16   where they clearly do, the longer the more often in a row they did
               16   where the learner's earn more, but not clearly
               -    where they clearly do: the old, which stay as they are, act no more

  What acts is what predicts. When the adaptation ends, however it does, the learner's stay if they
  earn MARGIN more, or clearly more, or if the old have not acted long enough to tell, else the old.
  The idea is that of high confidence policy improvement (Thomas, Theocharous and Ghavamzadeh 2015,
  https://proceedings.mlr.press/v37/thomas15.html), here by turns and without its bounds.

  Attributes:
    old: the parameters that acted when the adaptation began.
    new: the moving average of the learner's.
    learnt: bool (), an update has been taken since.
    age: int32 (), chunks since the first update; GRACE at least once turns have begun.
    acts: bool (), `old` acts in the chunk to come.
    other: bool (), it is the turn of the side that does not lead.
    waits: int32 (), turns since such a turn.
    losses: int32 (), turns of the learner's in a row after which the old clearly earned more.
    rewards: float32 (2, KEPT), rewards a step of the last chunks that count, the latest first, of
      `old` and of `new`; 0 where there are none yet.
    counts: int32 (2,), chunks that have counted.
  """

  old: Any
  new: Any
  learnt: jax.Array
  age: jax.Array
  acts: jax.Array
  other: jax.Array
  waits: jax.Array
  losses: jax.Array
  rewards: jax.Array
  counts: jax.Array


def init(params: Any) -> Guard:
  """Of a stream that has not begun to learn."""
  no, none = jnp.bool_(False), jnp.int32(0)
  nothing, nobody = jnp.zeros((2, KEPT)), jnp.zeros(2, jnp.int32)
  return Guard(params, params, no, none, no, no, none, none, nothing, nobody)


def hides(guard: Guard) -> jax.Array:
  """The old weights have acted."""
  return guard.acts


def compared(rewards: jax.Array, held: jax.Array) -> tuple[jax.Array, jax.Array]:
  """Means (2,) of the first `held` (2,) of rewards (2, KEPT), nan of none, and the squared standard
  error of their difference, the variance pooled; inf where fewer than two are left to tell it by.
  """
  mask = jnp.arange(KEPT) < held[:, None]
  means = jnp.where(mask, rewards, 0).sum(1) / held
  squares = jnp.where(mask, rewards - means[:, None], 0) ** 2
  freedom = held.sum() - 2
  variance = jnp.where(freedom > 0, squares.sum() / jnp.maximum(freedom, 1), jnp.inf)
  return means, variance * (1 / held).sum()


def act(guard: Guard, view: View) -> Acts:
  """What acts next, see Guard."""
  new = follow(choose(guard.learnt, guard.new, view.acted), view.learner, view.rate)
  adapting = view.was == ADAPTING
  # before the first update `old` acts, whatever `acts` says
  side = jnp.where(guard.learnt & ~guard.acts, 1, 0)
  counts = adapting & (~guard.learnt | (guard.age % TURN >= SKIP))
  latest = jnp.roll(guard.rewards[side], 1).at[0].set(view.reward)
  rewards = guard.rewards.at[side].set(jnp.where(counts, latest, guard.rewards[side]))
  number = guard.counts.at[side].add(counts.astype(jnp.int32))
  seldom = (guard.acts ^ guard.other) | (guard.age < GRACE)
  held = jnp.minimum(number, jnp.stack([KEPT, jnp.where(seldom, CHANGING, KEPT)]))
  (earned, earns), error = compared(rewards, held)
  worse = earns < earned  # False where either is unknown
  apart = (earns - earned) ** 2 / error
  known = jnp.all(number >= FEW)
  clear = known & (apart > 4)
  better = (earns - earned >= MARGIN * jnp.abs(earned)) | (clear & ~worse)
  back = view.over & guard.learnt & known & ~better
  age = jnp.where(guard.learnt, guard.age + 1, 0)
  fails = guard.learnt & worse & (number[1] >= CHANGING) & (apart > 9)
  age = jnp.where(fails, jnp.maximum(age, GRACE), age)
  learnt = (guard.learnt | (view.taken > 0)) & ~view.begins & ~view.over
  turns = age % TURN == 0  # a turn begins
  free = age < GRACE
  lost = ~free & guard.learnt & turns & ~guard.acts & clear & worse
  losses = jnp.where(lost, guard.losses + 1, jnp.where(clear & worse, guard.losses, 0))
  waits = jnp.where(turns, jnp.where(guard.other, 0, guard.waits + guard.learnt), guard.waits)
  rare = 4 * 2 ** jnp.clip(losses - 1, 0, 2)
  period = jnp.where(clear, jnp.where(worse, rare, NEVER), jnp.where(worse, 4, 16))
  period = jnp.where(known, period, 2)
  other = jnp.where(turns, ~free & (waits >= period - 1), guard.other)
  acts = jnp.where(turns, ~free & (other ^ (clear & worse)), guard.acts)
  old = choose(view.begins, new, guard.old)
  after = Guard(
    old,
    new,
    learnt,
    jnp.where(learnt, age, 0),
    learnt & acts,
    learnt & other,
    jnp.where(learnt, waits, 0),
    jnp.where(learnt, losses, 0),
    jnp.where(view.begins, 0, rewards),
    jnp.where(view.begins, 0, number),
  )
  return Acts(choose(back | (acts & learnt), old, new), after, back, earned, earns)


METHOD = Method(init, act, hides=hides, copies=2, weighs=True)
