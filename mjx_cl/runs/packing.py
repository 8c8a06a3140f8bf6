"""What a checkpoint holds of a run's lives: those that are frozen side by side, learners side by
side, and each learner's replay, which holds most of the memory, as it is.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.adapt.state import LATER, Frozen, LoopState, cut, glue
from mjx_cl.runs.groups import Band
from mjx_cl.runs.lives import Lives


def pack(lives: Lives) -> tuple[dict, list[list[int]]]:
  """What a checkpoint holds, NumPy but for the robots, and the streams of each band."""
  frozen = [life for herd in lives.herds for life in herd.frozen]
  loops = [loop for band in lives.bands for loop in band.loops]
  robots = [herd.streams for herd in lives.herds] + [band.streams for band in lives.bands]
  tree: dict[str, Any] = {"robots": robots}
  if frozen:
    tree["sight"] = glue([life.sight for life in frozen], LATER)
    tree["phase"] = glue([life.phase for life in frozen], ())
  if loops:
    tree["replays"] = [loop.replay for loop in loops]
    tree["learners"] = _held(glue([loop._replace(replay=None) for loop in loops], LATER))
  return tree, [band.who for band in lives.bands]


def like(lives: Lives, who: list[list[int]]) -> dict:
  """Shapes of what `pack` gives with bands of the streams `who`."""
  tree, _ = pack(lives)
  spread = lambda x: jnp.concatenate([x] * lives.band_size)
  tree["robots"] = [herd.streams for herd in lives.herds]
  tree["robots"] += [jax.tree.map(spread, lives.robot) for _ in who]
  if who:
    begin = lambda train: lives.loop.init(train, lives.width, lives.methods)
    state = jax.eval_shape(begin, lives.trains[0])
    number = sum(len(own) for own in who) // lives.width
    tree["replays"] = [state.replay] * number
    fields = state._replace(replay=None)._asdict().items()
    tree["learners"] = _held(LoopState(*(_wider(v, number, name) for name, v in fields)))
  return tree


def unpack(lives: Lives, tree: dict, who: list[list[int]]) -> None:
  """Goes on from what `pack` gave."""
  robots = iter(tree["robots"])
  at = 0
  for herd in lives.herds:
    herd.streams, first, at = next(robots), at, at + len(herd.lives)
    herd.frozen = [
      Frozen(_part(tree["sight"], i, 1), cut(tree["phase"], slice(i, i + 1), 0))
      for i in range(first, at)
    ]
    herd.frozen = jax.tree.map(jnp.asarray, herd.frozen)
  loops = [
    jax.tree.map(
      jnp.asarray,
      _part(LoopState(**tree["learners"], replay=None), k, lives.width)._replace(replay=replay),
    )
    for k, replay in enumerate(tree.get("replays", []))
  ]
  bands = []
  for members in who:
    number = len(members) // lives.width
    bands.append(Band(list(members), next(robots), loops[:number]))
    del loops[:number]
  lives.settle_down(bands)


def _held(state: LoopState) -> dict:
  """Its fields by name, without those that this run has no use for."""
  return {name: value for name, value in state._asdict().items() if value is not None}


def _wider(tree: Any, number: int, name: str) -> Any:
  """Shapes of `number` states' field `name` side by side."""
  axis = int(name in LATER)
  wide = lambda x: jax.ShapeDtypeStruct(
    x.shape[:axis] + (number * x.shape[axis],) + x.shape[axis + 1 :], x.dtype
  )
  return jax.tree.map(wide, tree)


def _part(state: Any, k: int, width: int) -> Any:
  """State k of several side by side, of `width` streams each."""
  at = slice(k * width, (k + 1) * width)
  host = lambda tree: jax.tree.map(np.asarray, tree)
  return type(state)(
    *(cut(host(value), at, int(name in LATER)) for name, value in state._asdict().items())
  )
