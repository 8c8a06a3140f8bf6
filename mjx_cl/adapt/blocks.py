"""The streams of a run side by side on the cores: each block of them is a Loop of its own, taken by
whichever thread is free.

A Loop treats each of its streams alone, so how they are cut into blocks changes nothing but the
time, and the last digits of a float. One large program does not keep two cores busy: only the
products within it are shared out, a few at a time. On a CPU a block is one stream: a program that
is compiled once for every number of seeds, a stream that learns does not hold up those that only
watch, and what it computes does not depend on its neighbours. On an accelerator all streams are one
block.
"""

from __future__ import annotations

import concurrent.futures
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.adapt.choices import Choices
from mjx_cl.adapt.loop import Loop
from mjx_cl.adapt.state import Digest, LoopState
from mjx_cl.dreamer.agent import TrainState
from mjx_cl.io.runtime import cores
from mjx_cl.rollout.order import Lanes
from mjx_cl.rollout.scan import Row

# fields of a LoopState whose streams lie along axis 1; of the others along axis 0
LATER = ("history", "past")
ROWS = ("residual", "score", "fired")  # fields of a Digest, likewise


class Blocks:
  """A Loop for `groups` streams, cut into blocks.

  Args:
    loop: of every block.
    groups: streams.
    size: streams in a block; None: one on a CPU, all on an accelerator.
    threads: None: as many as cores may be used, and no more than there are blocks.
  """

  def __init__(
    self, loop: Loop, groups: int, size: int | None = None, threads: int | None = None
  ) -> None:
    size = size or (1 if jax.default_backend() == "cpu" else groups)
    self.loop, self.groups = loop, groups
    self.blocks = [slice(g, min(g + size, groups)) for g in range(0, groups, size)]
    self.threads = threads or min(len(cores()), len(self.blocks))
    self._warm: set[int] = set()  # sizes of block whose program is there

  def init(self, trains: Sequence[TrainState], rollback: bool = False) -> list[LoopState]:
    """State before the first step, a list of blocks.

    Args:
      trains: what each stream begins with; those of a block are put in place one by one.
      rollback: as of Loop.init.
    """
    return [self._begin(trains[block], rollback) for block in self.blocks]

  def _begin(self, trains: Sequence[TrainState], rollback: bool) -> LoopState:
    state = self.loop.init(trains[0], len(trains), rollback)
    if all(train is trains[0] for train in trains):
      return state
    stack = jax.tree.map(lambda *x: jnp.stack(x), *trains)
    # `before` is written at every start, before it is read
    return state._replace(train=stack, acting=jax.tree.map(jnp.copy, stack.params))

  def digest(
    self,
    states: list[LoopState],
    rows: Row,
    now: jax.Array,
    choices: Choices,
    keys: jax.Array,
    acceptance: jax.Array | None = None,
  ) -> tuple[list[LoopState], Digest]:
    """One chunk of all streams; arguments as of Loop.digest, `states` is used up. The Digest is
    NumPy.
    """
    host = lambda tree: jax.tree.map(np.asarray, tree)
    if len(self.blocks) == 1:
      state, digest = self.loop.digest(states[0], rows, now, choices, keys, acceptance)
      return [jax.block_until_ready(state)], host(digest)
    rows, choices, acceptance = host(rows), host(choices), host(acceptance)

    def one(i: int) -> tuple[LoopState, Digest]:
      block = self.blocks[i]
      state, digest = self.loop.digest(
        states[i],
        cut(rows, block, 1),
        now,
        cut(choices, block, 0),
        keys[block],
        cut(acceptance, block, 0),
      )
      return jax.block_until_ready(state), host(digest)

    sizes = [block.stop - block.start for block in self.blocks]
    first = [i for i, size in enumerate(sizes) if size not in self._warm and sizes.index(size) == i]
    out = {i: one(i) for i in first}  # compiles; threads at the same time would all compile
    self._warm.update(sizes)
    rest = [i for i in range(len(self.blocks)) if i not in out]
    with concurrent.futures.ThreadPoolExecutor(self.threads) as pool:
      out |= dict(zip(rest, pool.map(one, rest)))
    done = [out[i] for i in range(len(self.blocks))]
    return [state for state, _ in done], glue([digest for _, digest in done], ROWS)

  def acting(self, states: list[LoopState], lanes: Lanes | None = None) -> Any:
    """What each stream acts by, leading (lanes,); None: (groups,). Of a single block in that order
    these are its own arrays: the next digest uses them up.
    """
    if len(states) == 1:
      return states[0].acting if lanes is None else lanes.spread(states[0].acting)
    at = [
      (states[i].acting, g - block.start)
      for i, block in enumerate(self.blocks)
      for g in range(block.start, block.stop)
    ]
    order = range(self.groups) if lanes is None else lanes.order
    streams = [
      jax.tree.map(lambda x: np.asarray(x)[k], acting) for acting, k in (at[g] for g in order)
    ]
    return jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *streams)

  def shapes(self, states: list[LoopState]) -> LoopState:
    """What `join` gives, without its numbers and without their memory."""
    empty = lambda x, shape: np.broadcast_to(np.zeros((), x.dtype), shape)
    wide = lambda x, axis: empty(x, x.shape[:axis] + (self.groups,) + x.shape[axis + 1 :])
    field = lambda name: jax.tree.map(
      lambda x: wide(x, int(name in LATER)), getattr(states[0], name)
    )
    replays = [jax.tree.map(lambda x: empty(x, x.shape), state.replay) for state in states]
    return LoopState(
      **{name: field(name) for name in LoopState._fields if name != "replay"}, replay=replays
    )

  def join(self, states: list[LoopState]) -> LoopState:
    """What a checkpoint holds: the fields of all streams put together, NumPy, and a list of the
    blocks' replays, which hold most of the memory, as they are.
    """
    if len(states) == 1:
      return states[0]._replace(replay=[states[0].replay])
    return glue([state._replace(replay=None) for state in states], LATER)._replace(
      replay=[state.replay for state in states]
    )

  def split(self, state: LoopState) -> list[LoopState]:
    """Inverse of `join`."""
    if len(self.blocks) == 1:
      return [state._replace(replay=state.replay[0])]

    def part(block: slice, replay: Any) -> LoopState:
      fields = {
        name: cut(jax.tree.map(np.asarray, value), block, int(name in LATER))
        for name, value in zip(LoopState._fields, state)
        if name != "replay"
      }
      return jax.tree.map(jnp.asarray, LoopState(**fields, replay=replay))

    return [part(block, replay) for block, replay in zip(self.blocks, state.replay, strict=True)]


def cut(tree: Any, block: slice, axis: int) -> Any:
  """Entries `block` along an axis of every leaf."""
  return jax.tree.map(lambda x: x[(slice(None),) * axis + (block,)], tree)


def glue(parts: list, later: tuple[str, ...]) -> Any:
  """Named tuples put together along axis 1 of the fields `later`, axis 0 of the others, NumPy."""

  def field(name: str) -> Any:
    values = [getattr(part, name) for part in parts]
    return jax.tree.map(
      lambda *x: np.concatenate([np.asarray(y) for y in x], int(name in later)), *values
    )

  return type(parts[0])(*(field(name) for name in parts[0]._fields))
