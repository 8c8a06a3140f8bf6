"""Method of arm `world-model`: actor and critic stay as they are."""

from __future__ import annotations

from typing import Any

import jax

from mjx_cl.adapt.methods.base import Method
from mjx_cl.dreamer.agent import TrainState

BEHAVIOUR = {"pol", "val", "slow", "range"}  # of a TrainState: what is no world model


def keep(memory: Any, before: TrainState, after: TrainState) -> TrainState:
  """`after` with actor, critic, slow critic, range of the returns, and the moments of actor and
  critic as `before`.

  Zero gradients alone would not do: momentum moves what has none. The value loss on replay still
  shapes the features, as in every arm.
  """
  del memory

  def one(path: tuple[Any, ...], old: jax.Array, new: jax.Array) -> jax.Array:
    names = {getattr(part, "key", getattr(part, "name", None)) for part in path}
    return old if names & BEHAVIOUR else new

  return jax.tree_util.tree_map_with_path(one, before, after)


METHOD = Method(keep=keep)
