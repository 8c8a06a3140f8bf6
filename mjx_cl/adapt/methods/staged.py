"""Method of arm `staged`: first the world model learns, then the critic with it, then the actor."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from mjx_cl.adapt.methods.base import Acts, Method, View, average
from mjx_cl.dreamer.agent import TrainState

MODEL, CRITIC = 100, 200  # updates from which on the critic, and the actor learns


def init(params: Any) -> jax.Array:
  """Updates of the adaptation so far, int32 ()."""
  del params
  return jnp.int32(0)


def keep(taken: jax.Array, before: TrainState, after: TrainState) -> TrainState:
  """Of an update the world model's part; from MODEL updates of the adaptation on the critic's, from
  CRITIC on the actor's too, each with its moments.

  The actor is improved in dreams, and judged by the critic: neither is worth following while the
  model still dreams of the robot of before. Levy et al. 2026 (SimDist,
  https://arxiv.org/abs/2603.15759) adapt the dynamics alone.
  """

  def one(path: tuple[Any, ...], old: jax.Array, new: jax.Array) -> jax.Array:
    names = {getattr(part, "key", getattr(part, "name", None)) for part in path}
    if "pol" in names:
      return jnp.where(taken < CRITIC, old, new)
    return jnp.where(taken < MODEL, old, new) if names & {"val", "slow", "range"} else new

  return jax.tree_util.tree_map_with_path(one, before, after)


def act(taken: jax.Array, view: View) -> Acts:
  """As the paper's; counts."""
  return average(jnp.where(view.begins, 0, taken + view.taken), view)


METHOD = Method(init, act, keep)
