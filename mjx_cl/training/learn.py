"""Updates of several seeds of a learner in one jitted program."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.dreamer import replay as replay_lib
from mjx_cl.dreamer.agent import Agent, TrainState, Weights, culprit
from mjx_cl.dreamer.replay import Replay
from mjx_cl.errors import choose
from mjx_cl.io import runtime

Metrics = dict[str, jax.Array]
Learnt = tuple[TrainState, Replay, Metrics, jax.Array]
NEVER = -(2**30)  # the begin of a window long evicted: nothing is written there


def _nought(shapes: Any) -> Any:
  return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)


@dataclass(frozen=True)
class Updater:
  """Updates of a learner on windows of its replay.

  Attributes:
    agent: the learner.
    batch: windows of an update.
    length: trained steps of a window.
  """

  agent: Agent
  batch: int
  length: int

  def sampled(
    self, train: TrainState, replay: Replay, key: jax.Array, weights: Weights
  ) -> tuple[TrainState, Replay, Metrics, tuple[jax.Array, jax.Array], Any]:
    """One update: (train, replay, metrics, where its windows lie, their new latents)."""
    key_sample, key_update = jax.random.split(key)
    replay, data, address = replay_lib.sample(replay, key_sample, self.batch, self.length + 1)
    train, metrics, latents = self.agent.update(train, data, key_update, weights)
    return train, replay, metrics, address, latents

  def refreshed(
    self, train: TrainState, replay: Replay, key: jax.Array, weights: Weights
  ) -> tuple[TrainState, Replay, Metrics]:
    """One update that writes its windows' new latents into the replay."""
    train, replay, metrics, address, latents = self.sampled(train, replay, key, weights)
    return train, replay_lib.refresh(replay, address, latents), metrics

  def shapes(self, train: TrainState, replay: Replay, key: jax.Array, weights: Weights) -> Metrics:
    """Of the metrics of an update, each the shape also of its mean. A trace of the update."""
    return jax.eval_shape(self.refreshed, train, replay, key, weights)[2]

  def one_seed(
    self,
    train: TrainState,
    replay: Replay,
    key: jax.Array,
    weights: Weights,
    updates: int,
    shapes: Metrics | None = None,
  ) -> Learnt:
    """`updates` updates of one seed, see `make_learn`; `shapes`: of its metrics, where known."""
    keys = jax.random.split(key, updates)
    if shapes is None:
      shapes = self.shapes(train, replay, key, weights)

    def body(state: tuple[Any, ...]) -> tuple[Any, ...]:
      i, train, replay, sums, _ = state
      train, replay, metrics = self.refreshed(train, replay, keys[i], weights)
      return i + 1, train, replay, jax.tree.map(jnp.add, sums, metrics), culprit(metrics)

    more = lambda state: (state[0] < updates) & (state[-1] < 0)
    i, train, replay, sums, bad = jax.lax.while_loop(
      more, body, (jnp.int32(0), train, replay, _nought(shapes), jnp.int32(-1))
    )
    return train, replay, jax.tree.map(lambda x: x / i, sums), bad

  def by_map(
    self,
    train: TrainState,
    replay: Replay,
    keys: jax.Array,
    weights: Weights,
    active: jax.Array,
    updates: int,
  ) -> Learnt:
    """Seeds one after another."""
    one: tuple[Any, Any, Any] = jax.tree.map(lambda x: x[0], (train, replay, keys))
    shapes = self.shapes(*one, weights)
    run = lambda train, replay, key: self.one_seed(train, replay, key, weights, updates, shapes)
    rest = lambda train, replay, key: (train, replay, _nought(shapes), jnp.int32(-1))
    return jax.lax.map(
      lambda x: jax.lax.cond(x[3], run, rest, *x[:3]), (train, replay, keys, active)
    )

  def if_live(
    self, weights: Weights, train: TrainState, replay: Replay, key: jax.Array, live: jax.Array
  ) -> tuple[TrainState, Replay, Metrics, jax.Array]:
    """One update of one seed of several, which changes nothing unless the seed is `live`.

    vmap of `one_seed` would hold a second replay: what a loop carries is kept or replaced as a
    whole.
    """
    new, sampled, metrics, (stream, begin), latents = self.sampled(train, replay, key, weights)
    kept = lambda a, b: jax.tree.map(lambda a, b: jnp.where(live, a, b), a, b)
    sampled = sampled._replace(queue=kept(sampled.queue, replay.queue))
    replay = replay_lib.refresh(sampled, (stream, jnp.where(live, begin, NEVER)), latents)
    return (
      kept(new, train),
      replay,
      kept(metrics, jax.tree.map(jnp.zeros_like, metrics)),
      jnp.where(live, culprit(metrics), -1),
    )

  def by_vmap(
    self,
    train: TrainState,
    replay: Replay,
    keys: jax.Array,
    weights: Weights,
    active: jax.Array,
    updates: int,
  ) -> Learnt:
    """All seeds in each product."""
    keys = jax.vmap(lambda key: jax.random.split(key, updates), out_axes=1)(keys)
    update = jax.vmap(functools.partial(self.if_live, weights))

    def body(state: tuple[Any, ...]) -> tuple[Any, ...]:
      i, count, train, replay, sums, bad = state
      live = active & (bad < 0)
      train, replay, metrics, found = update(train, replay, keys[i], live)
      return (
        i + 1,
        count + live,
        train,
        replay,
        jax.tree.map(jnp.add, sums, metrics),
        jnp.where(live, found, bad),
      )

    none = jnp.zeros(active.shape, jnp.int32)
    zero = _nought(jax.eval_shape(update, train, replay, keys[0], active)[2])
    more = lambda state: (state[0] < updates) & jnp.any(active & (state[-1] < 0))
    _, count, train, replay, sums, bad = jax.lax.while_loop(
      more, body, (jnp.int32(0), none, train, replay, zero, none - 1)
    )
    return train, replay, jax.tree.map(lambda x: x / jnp.maximum(1, count), sums), bad


def make_learn(
  agent: Agent,
  batch: int,
  length: int,
  mesh: jax.sharding.Mesh | None = None,
  *,
  how: str | None = None,
) -> Callable[..., Learnt]:
  """(train, replay, key, weights, active (seeds,), updates) -> (train, replay, metrics (seeds,),
  means over the updates, culprit (seeds,)), seeds leading, jitted.

  `culprit` is the index into agent.CAUSES of the term at fault, -1 for none: with the update at
  fault, which changes no weights, the seed's updates end. A seed that is not active is passed over.

  Args:
    agent: the learner.
    batch: windows of an update.
    length: trained steps of a window.
    mesh: each of its devices does its own share of the seeds: `mjx-cl train` on a CPU makes as many
      devices of the cores as share the seeds evenly (runtime.sharing).
    how: `map` or `vmap` over the seeds of a device; None: as runtime.seeds_by says. The arithmetic
      is the same, so results agree but for float32 rounding.
  """
  updater = Updater(agent, batch, length)
  over_seeds: Callable[..., Learnt] = choose(
    "how", how or runtime.seeds_by(), {"map": updater.by_map, "vmap": updater.by_vmap}
  )

  @functools.partial(jax.jit, static_argnames=("updates",), donate_argnums=(0, 1))
  def learn(
    train: TrainState,
    replay: Replay,
    key: jax.Array,
    weights: Weights,
    active: jax.Array,
    updates: int,
  ) -> Learnt:
    seeds = train.updates.shape[0]
    if seeds == 1:  # no copy of the replay
      train, replay = jax.tree.map(lambda x: x[0], (train, replay))
      out = updater.one_seed(train, replay, key, weights, updates)
      return jax.tree.map(lambda x: x[None], out)
    body = functools.partial(over_seeds, updates=updates)
    if mesh is not None:
      mine, all_ = jax.sharding.PartitionSpec("seeds"), jax.sharding.PartitionSpec()
      body = jax.shard_map(
        body, mesh=mesh, in_specs=(mine, mine, mine, all_, mine), out_specs=mine, check_vma=False
      )
    return body(train, replay, jax.random.split(key, seeds), weights, active)

  return learn


def seeds_mesh(seeds: int) -> jax.sharding.Mesh | None:
  """A mesh of the most devices that share `seeds` seeds evenly, or None where that is one."""
  devices = jax.devices()
  count = max(n for n in range(1, len(devices) + 1) if seeds % n == 0)
  return jax.sharding.Mesh(np.asarray(devices[:count]), ("seeds",)) if count > 1 else None
