"""Method of arm `rollback`: an aborted adaptation is taken back where it earned less."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.adapt.methods.base import Acts, Method, View, follow
from mjx_cl.adapt.phases import ABORTED, ADAPTING
from mjx_cl.adapt.trees import choose


class Before(NamedTuple):
  """What an adaptation began with, and what that was worth.

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
    reward: float32 (), sum of the mean rewards of the chunks that they have lived since.
    chunks: float32 (), number of these chunks.
    learnt: bool (), an update has been taken since.
  """

  params: Any
  reward: jax.Array
  chunks: jax.Array
  learnt: jax.Array


def init(params: Any) -> Before:
  """Of a stream that has not begun to learn."""
  return Before(params, jnp.float32(0), jnp.float32(0), jnp.bool_(False))


def act(before: Before, view: View) -> Acts:
  """The average of what is learnt; where an abort goes back the weights of before."""
  acting = follow(view.acted, view.learner, view.rate)
  lived = (view.was == ADAPTING) & ~before.learnt  # the chunk just lived is one of the old weights
  reward = before.reward + jnp.where(lived, view.reward, 0.0)
  chunks = before.chunks + lived
  earned = reward / chunks
  back = view.over & (view.phase == ABORTED) & before.learnt & (view.recent < earned)
  acting = choose(back, before.params, acting)
  after = Before(
    choose(view.begins, acting, before.params),
    jnp.where(view.begins, 0.0, reward),
    jnp.where(view.begins, 0.0, chunks),
    ~view.begins & (before.learnt | (view.taken > 0)),
  )
  return Acts(acting, after, back, earned, view.recent)


METHOD = Method(init, act, copies=1, weighs=True)
