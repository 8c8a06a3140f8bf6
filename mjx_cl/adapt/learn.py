"""What a stream learns from: the replay of an adaptation, the updates that it pays for, and new
parameters and moments.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from mjx_cl.adapt.methods import Method
from mjx_cl.adapt.state import LoopState
from mjx_cl.adapt.trees import choose, put, take
from mjx_cl.dreamer import replay as replay_lib
from mjx_cl.dreamer.agent import Agent, TrainState, culprit
from mjx_cl.dreamer.replay import Replay
from mjx_cl.dreamer.state import Record
from mjx_cl.keys import OfAdaptation
from mjx_cl.rollout.scan import Row, records


def fill(
  replay: Replay, rows: Row, begins: jax.Array, row: jax.Array, adapting: jax.Array
) -> Replay:
  """`replay` of each stream with what came after the alarm and nothing else.

  Args:
    replay: before the chunk.
    rows: of the chunk.
    begins: bool (groups,), an adaptation begins in the chunk.
    row: int32 (groups,), after which row.
    adapting: bool (groups,), the chunk began within an adaptation.
  """
  none = replay_lib.clear(replay)
  count, queue = choose(begins, (none.count, none.queue), (replay.count, replay.queue))
  length = rows.reward.shape[0]
  keep = jnp.where(begins[None], jnp.arange(length)[:, None] > row[None], adapting[None])
  new, exist = records(rows)
  exist = exist & jnp.repeat(keep.T, 2, axis=1)[:, None]
  return jax.vmap(replay_lib.add)(replay._replace(count=count, queue=queue), new, exist)


def owing(
  agent: Agent,
  replay: Replay,
  adapting: jax.Array,
  owed: jax.Array,
  rows: int,
  ratio: jax.Array | float,
  start_windows: jax.Array | float,
) -> jax.Array:
  """Updates that are due after a chunk of `rows`, float32 (groups,): `ratio` replayed records a
  row, while an adaptation runs whose replay holds `start_windows`, () or (groups,); what is left of
  `owed` counts on.
  """
  c = agent.config
  windows = jax.vmap(lambda r: replay_lib.windows(r, c.length + 1))(replay)
  due = adapting & (windows >= start_windows)
  return jnp.where(due, owed + rows * ratio / (c.batch * c.length), 0.0)


def begin(
  agent: Agent,
  state: LoopState,
  keys: jax.Array,
  begins: jax.Array,
  fresh: jax.Array | None,
  moments: bool,
) -> tuple[TrainState, Any]:
  """What the learner starts from, and what acts, where an adaptation `begins` (groups,).

  Args:
    agent: the learner.
    state: before the chunk.
    keys: of the streams.
    begins: bool (groups,).
    fresh: bool (groups,), parameters are drawn anew; None: of no stream.
    moments: the optimiser's moments and counters are set back.
  """
  train, acting = state.train, state.acting
  if fresh is not None:
    train, acting = renew(agent, train, acting, keys, begins & fresh)
  if moments:
    new = jax.vmap(agent.optimizer.init)(train.params)
    opt = jax.lax.cond(jnp.any(begins), lambda o: choose(begins, new, o), lambda o: o, train.opt)
    train = train._replace(opt=opt)
  return train, acting


def renew(
  agent: Agent, train: TrainState, acting: Any, keys: jax.Array, fresh: jax.Array
) -> tuple[TrainState, Any]:
  """New parameters, moments and counters where `fresh` (groups,). Loops for the reason given in
  `learn`.
  """

  def stream(g: jax.Array, state: tuple[TrainState, Any]) -> tuple[TrainState, Any]:
    def anew(_: jax.Array, state: tuple[TrainState, Any]) -> tuple[TrainState, Any]:
      train, acting = state
      new = agent.init(jax.random.fold_in(keys[g], OfAdaptation.FRESH))
      return put(train, g, new), put(acting, g, new.params)

    return jax.lax.fori_loop(0, fresh[g].astype(jnp.int32), anew, state)

  return jax.lax.fori_loop(0, fresh.shape[0], stream, (train, acting))


def learn(
  agent: Agent,
  train: TrainState,
  replay: Replay,
  keys: jax.Array,
  number: jax.Array,
  methods: tuple[Method, ...],
  which: jax.Array,
  memory: tuple[Any, ...],
) -> tuple[TrainState, Replay, jax.Array]:
  """`number` (groups,) updates for each stream. Nested loops with their own trip counts: the
  carry is changed in place, so a stream without an update costs neither arithmetic nor a copy
  (`vmap` would compute all, `lax.map` would copy all). All streams lie in one replay, of which an
  update reads and writes its own windows: taken out of it, a stream's would be copied twice for
  each update.

  Args:
    agent: the learner.
    train: TrainState of the streams.
    replay: of the streams.
    keys: of the streams.
    number: int32 (groups,), updates that are due.
    methods: of the run.
    which: int32 (groups,), which of them is the stream's.
    memory: of each method, leading (groups,).

  Returns:
    (train', replay', int32 (groups,): what was at fault, see agent.culprit).
  """
  c = agent.config
  # (groups, 1, ..) -> (groups, ..)
  together = jax.tree.map(lambda x: x.reshape((-1,) + x.shape[2:]), replay)

  def stream(
    g: jax.Array, state: tuple[TrainState, Replay, jax.Array]
  ) -> tuple[TrainState, Replay, jax.Array]:
    def update(
      state: tuple[jax.Array, TrainState, Replay, jax.Array],
    ) -> tuple[jax.Array, TrainState, Replay, jax.Array]:
      i, train, replay, _ = state
      key_sample, key_update = jax.random.split(jax.random.fold_in(keys[g], i))
      replay, data, address = replay_lib.sample(replay, key_sample, c.batch, c.length + 1, only=g)
      own = tuple(take(kept, g) for kept in memory)
      learnt, latents, bad = _update(
        agent, methods, which[g], own, take(train, g), data, key_update
      )
      replay = replay_lib.refresh(replay, address, latents)
      return i + 1, put(train, g, learnt), replay, bad

    train, replay, failed = state
    more = lambda state: (state[0] < number[g]) & (state[-1] < 0)
    _, train, replay, bad = jax.lax.while_loop(
      more, update, (jnp.int32(0), train, replay, jnp.int32(-1))
    )
    return train, replay, failed.at[g].set(bad)

  train, together, failed = jax.lax.fori_loop(
    0, number.shape[0], stream, (train, together, jnp.full(number.shape, -1, jnp.int32))
  )
  apart = jax.tree.map(lambda x, like: x.reshape(like.shape), together, replay)
  return train, apart, failed


def _update(
  agent: Agent,
  methods: tuple[Method, ...],
  which: jax.Array,
  memory: tuple[Any, ...],
  before: TrainState,
  data: Record,
  key: jax.Array,
) -> tuple[TrainState, tuple[jax.Array, jax.Array], jax.Array]:
  """One update of one stream by method `which` (): (state', latents, what is at fault)."""

  def by(method: Method | None, own: Any) -> tuple[TrainState, Any, jax.Array]:
    if method is None or method.update is None:
      learnt, metrics, latents = agent.update(before, data, key)
    else:
      learnt, metrics, latents = method.update(agent, own, before, data, key)
    return learnt, latents, culprit(metrics)

  ways: list[Any] = [lambda: by(None, ())]  # methods without an update of their own share one
  way = jnp.zeros(len(methods), jnp.int32)
  for i, (method, own) in enumerate(zip(methods, memory)):
    if method.update is not None:
      way = way.at[i].set(len(ways))
      ways.append(lambda method=method, own=own: by(method, own))
  learnt, latents, bad = jax.lax.switch(way[which], ways) if len(ways) > 1 else ways[0]()
  for i, (method, own) in enumerate(zip(methods, memory)):
    if method.keep is not None:
      learnt = choose(which == i, method.keep(own, before, learnt), learnt)
  # whatever of the state a method takes up, an update has been made
  return learnt._replace(updates=before.updates + (bad < 0)), latents, bad
