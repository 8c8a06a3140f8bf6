"""Method of arm `calm`: while it learns the robot acts without exploring."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.adapt.methods.base import Acts, Method, View, follow
from mjx_cl.adapt.methods.quiet import still
from mjx_cl.adapt.trees import choose


class Calm(NamedTuple):
  """Attributes:
  average: the moving average of the learner's parameters, with its own deviations.
  learnt: bool (), an update has been taken since the adaptation began.
  """

  average: Any
  learnt: jax.Array


def init(params: Any) -> Calm:
  """Of a stream that has not begun to learn."""
  return Calm(params, jnp.bool_(False))


def act(calm: Calm, view: View) -> Acts:
  """From the first update on the average acts with the least deviation; dreams explore as ever.
  When the adaptation is over its own deviations come back.

  Real mistakes cost return and dreamt ones do not: exploration belongs into the dreams (LIFT, 2026,
  https://arxiv.org/abs/2601.21363).
  """
  new = follow(choose(calm.learnt, calm.average, view.acted), view.learner, view.rate)
  learnt = (calm.learnt | (view.taken > 0)) & ~view.begins & ~view.over
  return Acts(choose(learnt, still(new), new), Calm(new, learnt))


METHOD = Method(init, act, copies=1)
