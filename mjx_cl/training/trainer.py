"""Pretraining: a host loop of collect (acting and physics) and learn (updates), resumable at any
chunk.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import json
import os
import pathlib
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import faults
from mjx_cl.config import CHUNK, DreamerConfig, TrainConfig, recorded
from mjx_cl.dreamer import replay as replay_lib
from mjx_cl.dreamer.agent import CAUSES, EXPLODED, Agent, TrainState, Weights, culprit
from mjx_cl.errors import FileError, UserError, choose
from mjx_cl.faults import presets
from mjx_cl.io import checkpoints, folders, runtime, tables
from mjx_cl.io.interrupt import Interruptible
from mjx_cl.keys import OfStream
from mjx_cl.rollout.scan import Rollout, Stream, nest, records, start
from mjx_cl.training import agents, demonstrator, episodes, evaluate, needs

if TYPE_CHECKING:
  Metrics = dict[str, jax.Array]
  Learnt = tuple[TrainState, replay_lib.Replay, Metrics, jax.Array]

DEMONSTRATOR_STEPS = 8_000_000


class Learner(NamedTuple):
  """Arrays of a pretraining run, all with a leading seeds axis but `key`."""

  train: TrainState
  streams: Stream
  replay: replay_lib.Replay
  key: jax.Array


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
  fault, which changes no weights, the seed's updates end.

  A seed that is not active is passed over. With a `mesh` each of its devices does its own share of
  the seeds: `mjx-cl train` on a CPU makes as many devices of the cores as share the seeds evenly
  (runtime.sharing).

  Args:
    how: `map` or `vmap` over the seeds of a device; None: as runtime.seeds_by says. The arithmetic
      is the same, so results agree but for float32 rounding.
  """

  def step(
    train: TrainState, replay: replay_lib.Replay, key: jax.Array, weights: Weights
  ) -> tuple[TrainState, replay_lib.Replay, Metrics, tuple[jax.Array, jax.Array], Any]:
    key_sample, key_update = jax.random.split(key)
    replay, data, address = replay_lib.sample(replay, key_sample, batch, length + 1)
    train, metrics, latents = agent.update(train, data, key_update, weights)
    return train, replay, metrics, address, latents

  def one_seed(
    train: TrainState, replay: replay_lib.Replay, key: jax.Array, weights: Weights, updates: int
  ) -> Learnt:
    keys = jax.random.split(key, updates)

    def one_update(
      train: TrainState, replay: replay_lib.Replay, key: jax.Array
    ) -> tuple[TrainState, replay_lib.Replay, Metrics]:
      train, replay, metrics, address, latents = step(train, replay, key, weights)
      return train, replay_lib.refresh(replay, address, latents), metrics

    def body(state: tuple[Any, ...]) -> tuple[Any, ...]:
      i, train, replay, sums, _ = state
      train, replay, metrics = one_update(train, replay, keys[i])
      return i + 1, train, replay, jax.tree.map(jnp.add, sums, metrics), culprit(metrics)

    zero = jax.tree.map(
      lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(one_update, train, replay, key)[2]
    )
    more = lambda state: (state[0] < updates) & (state[-1] < 0)
    i, train, replay, sums, bad = jax.lax.while_loop(
      more, body, (jnp.int32(0), train, replay, zero, jnp.int32(-1))
    )
    return train, replay, jax.tree.map(lambda x: x / i, sums), bad

  def by_map(
    train: TrainState,
    replay: replay_lib.Replay,
    keys: jax.Array,
    weights: Weights,
    active: jax.Array,
    updates: int,
  ) -> Learnt:
    run = lambda train, replay, key: one_seed(train, replay, key, weights, updates)
    shapes = jax.eval_shape(run, *jax.tree.map(lambda x: x[0], (train, replay, keys)))[2]
    rest = lambda train, replay, key: (
      train,
      replay,
      jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes),
      jnp.int32(-1),
    )
    return jax.lax.map(
      lambda x: jax.lax.cond(x[3], run, rest, *x[:3]), (train, replay, keys, active)
    )

  def by_vmap(
    train: TrainState,
    replay: replay_lib.Replay,
    keys: jax.Array,
    weights: Weights,
    active: jax.Array,
    updates: int,
  ) -> Learnt:
    keys = jax.vmap(lambda key: jax.random.split(key, updates), out_axes=1)(keys)

    def one_update(
      train: TrainState,
      replay: replay_lib.Replay,
      key: jax.Array,
      live: jax.Array,
      # vmap of `one_seed` would hold a second replay: what a loop carries is kept or replaced as a
      # whole
    ) -> tuple[TrainState, replay_lib.Replay, Metrics, jax.Array]:
      new, sampled, metrics, (stream, begin), latents = step(train, replay, key, weights)
      kept = lambda a, b: jax.tree.map(lambda a, b: jnp.where(live, a, b), a, b)
      sampled = sampled._replace(queue=kept(sampled.queue, replay.queue))
      replay = replay_lib.refresh(
        sampled, (stream, jnp.where(live, begin, -(2**30))), latents
      )  # long evicted: nothing is written
      return (
        kept(new, train),
        replay,
        kept(metrics, jax.tree.map(jnp.zeros_like, metrics)),
        jnp.where(live, culprit(metrics), -1),
      )

    def body(state: tuple[Any, ...]) -> tuple[Any, ...]:
      i, count, train, replay, sums, bad = state
      live = active & (bad < 0)
      train, replay, metrics, found = jax.vmap(one_update)(train, replay, keys[i], live)
      return (
        i + 1,
        count + live,
        train,
        replay,
        jax.tree.map(jnp.add, sums, metrics),
        jnp.where(live, found, bad),
      )

    none = jnp.zeros(active.shape, jnp.int32)
    shapes = jax.eval_shape(jax.vmap(one_update), train, replay, keys[0], active)[2]
    zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    more = lambda state: (state[0] < updates) & jnp.any(active & (state[-1] < 0))
    _, count, train, replay, sums, bad = jax.lax.while_loop(
      more, body, (jnp.int32(0), none, train, replay, zero, none - 1)
    )
    return train, replay, jax.tree.map(lambda x: x / jnp.maximum(1, count), sums), bad

  over_seeds = choose("how", how or runtime.seeds_by(), {"map": by_map, "vmap": by_vmap})

  @functools.partial(jax.jit, static_argnames=("updates",), donate_argnums=(0, 1))
  def learn(
    train: TrainState,
    replay: replay_lib.Replay,
    key: jax.Array,
    weights: Weights,
    active: jax.Array,
    updates: int,
  ) -> Learnt:
    seeds = train.updates.shape[0]
    if seeds == 1:  # no copy of the replay
      out = one_seed(  # type: ignore[call-arg]
        *jax.tree.map(lambda x: x[0], (train, replay)), key, weights, updates
      )
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


def expert(env: Any, name: str) -> Callable[[Stream], jax.Array]:
  """A demonstrator, Stream -> action: `reference`, the environment's own driver that knows its
  state, or a policy's .npz.

  A policy sees the observation without its noise where the robot can give it (`noiseless`): labels
  then follow from what a latent can know.
  """
  if name == "reference":
    if not hasattr(env, "reference"):
      raise UserError(
        f"robot {env.spec.name!r} has no reference driver; give a policy's .npz or `ppo`"
      )
    return lambda stream: env.reference(stream.env)
  policy = demonstrator.load(name)
  if hasattr(env, "noiseless"):
    return lambda stream: policy(env.noiseless(env.model, stream.env))
  return lambda stream: policy(stream.obs)


def cut(env: Any, steps: int | None) -> Any:
  """The environment with episodes of `steps` control steps; itself for None."""
  if steps is None:
    return env
  env = copy.copy(env)
  env.spec = env.spec._replace(episode_steps=steps)
  return env


def eased(env: Any, factor: float) -> Any:
  """The environment with its reward's negative weights times `factor`; itself for 1."""
  if factor == 1.0:
    return env
  weights = env.model.task.get("reward_weights")
  if weights is None or not (np.asarray(weights) < 0).any():
    raise UserError(f"penalties: the reward of robot {env.spec.name!r} has no negative weights")
  env = copy.copy(env)
  env.model = env.model._replace(
    task=env.model.task | {"reward_weights": jnp.where(weights < 0, weights * factor, weights)}
  )
  return env


def faults_of(
  env: Any, config: TrainConfig
) -> tuple[faults.Fault | tuple[faults.Fault, ...], faults.Plan | None, jax.Array | int]:
  """(Fault or tuple of them, their Plan, targets) of a training: of a preset its own; of a fault no
  Plan and -1, since both are drawn.

  Raises:
    UserError for what is unknown, belongs to another robot, or turns the robot into another one.
  """
  if config.fault is None or not presets.named(config.fault):
    return faults.make(config.fault or "none", env), None, -1
  if config.severity != 1.0:
    raise UserError(f"preset {config.fault!r} brings its own severity; leave severity out")
  changes = presets.resolve(env.spec.name, config.fault)
  if presets.find(config.fault, env.spec.name).becomes:
    raise UserError(
      f"preset {config.fault!r} turns the robot into another one, which only `mjx-cl run` "
      "does; train that one itself"
    )
  return faults.build(changes, env)


def check(
  env: Any, dreamer: DreamerConfig, config: TrainConfig, agent_name: str | None = None
) -> None:
  """Refuses actions whose bounds are not -1 and 1, a replay that can never hold one update's
  windows, and an agent that sees or acts otherwise than this training would have it.

  Raises:
    UserError. Size, bins and obs_scale decide what weights mean, repeat what an action does; what
    else differs a training may change.
  """
  for var in env.spec.act:
    if (var.low, var.high) != (-1, 1):
      raise UserError(
        f"action {var.name!r} of robot {env.spec.name!r} has bounds {var.low:g} and "
        f"{var.high:g}; the policy acts in -1 to 1: declare these bounds "
        f"(Var(..., -1, 1)) and scale in the environment's `step`"
      )
  least = max(2 * CHUNK, dreamer.length + -(-dreamer.batch * dreamer.length // config.envs))
  if config.capacity < least:
    raise UserError(
      f"capacity={config.capacity} records of each of {config.envs} robots never hold the "
      f"{dreamer.batch} x {dreamer.length} steps of an update; "
      f"capacity={least} would"
    )
  if agent_name:
    trained = agents.of(env, agent_name)
    of, spec = (
      lambda c, repeat: {
        "size": c.size,
        "bins": c.bins,
        "obs_scale": scaled(env, c).obs_scale,
        "repeat": repeat,
      },
      dataclasses.replace(dreamer, obs_scale="spec"),
    )
    has, wanted = (
      of(trained.agent.config, int(trained.card.get("repeat", 1))),
      of(dreamer, config.repeat),
    )
    say = lambda x: (
      "spec" if x == scaled(env, spec).obs_scale else x if isinstance(x, str) else json.dumps(x)
    )
    for name in (n for n in has if has[n] != wanted[n]):
      raise UserError(
        f"agent {agent_name!r} has {name} {say(has[name])}, this training {say(wanted[name])}; "
        f"--set {name}={say(has[name])} goes on with its own"
      )


def scaled(env: Any, dreamer: DreamerConfig) -> DreamerConfig:
  """`dreamer` with the robot's own deviations in the place of obs_scale `spec`."""
  return (
    dataclasses.replace(dreamer, obs_scale=tuple(float(v.scale) for v in env.spec.obs))
    if dreamer.obs_scale == "spec"
    else dreamer
  )


class Trainer:
  """Pretrains `seeds` agents on one environment.

  Phases with a demonstrator: `clone` (its data on half the robots, the cloning term, no policy
  gradient) until the agent's own return reaches `clone_until` of the demonstrator's; `fade` (policy
  gradient on, cloning weight falls to 0); `pure` (replay emptied, plain DreamerV3). Without one
  there is only `pure`.
  """

  about: dict[str, Any]

  def __init__(
    self,
    env: Any,
    dreamer: DreamerConfig,
    config: TrainConfig,
    out: os.PathLike | str,
    seed: int = 0,
    seeds: int = 1,
  ) -> None:
    check(env, dreamer, config)
    self.env, self.dreamer, self.config, self.out = env, dreamer, config, pathlib.Path(out)
    env = eased(cut(env, config.episode), config.penalties)
    self.seeds = seeds
    self.expert = expert(env, config.demonstrator) if config.demonstrator else None
    self.expert_return = 0.0
    self.phase = "clone" if self.expert else "pure"
    self.phase_start = 0
    self.owed = 0.0
    self.rows: list[dict] = []
    self.own: list[float] = []
    self.seconds, self.chunks = 0.0, 0
    spec = env.spec
    self.plain = Agent(dreamer, len(spec.obs), len(spec.act))
    self.mesh = seeds_mesh(seeds)
    needs.check(
      dreamer.size,
      len(spec.obs),
      len(spec.act),
      config.envs * config.capacity,
      seeds,
      ("capacity", lambda n: n * config.envs),
      dreamer.bins,
      1 if self.mesh is None or jax.default_backend() == "cpu" else self.mesh.size,
    )  # devices of a CPU share its memory
    self.failed: dict[int, str] = {}  # seed -> the term that was not finite, and when
    fault, self.plan, self.target = faults_of(env, config)
    self.collect = {"pure": Rollout(env, self.plain, fault, config.repeat)}
    if dreamer.anchor and config.shake:
      raise UserError(
        "anchor holds the policy to the actions taken; shake puts random ones among them: set it "
        "to 0"
      )
    self.learn = {"pure": make_learn(self.plain, dreamer.batch, dreamer.length, self.mesh)}
    if self.expert:
      cloning = Agent(
        dataclasses.replace(dreamer, anchor=0.0),
        len(spec.obs),
        len(spec.act),
        clone_std=config.clone_std,
      )
      rollout = Rollout(
        env, cloning, fault, config.repeat, expert=self.expert, expert_noise=config.demo_noise
      )
      learn = make_learn(cloning, dreamer.batch, dreamer.length, self.mesh)
      self.collect |= {"clone": rollout, "fade": rollout}
      self.learn |= {"clone": learn, "fade": learn}
    key_init, key_stream, key = jax.random.split(jax.random.key(seed), 3)
    agent, size = self.plain, self.plain.size
    train = jax.vmap(agent.init)(jax.random.split(key_init, seeds))
    keys = jax.random.split(key_stream, (seeds, config.envs))
    self.fault = fault if config.fault else None
    streams = nest(
      lambda k: start(env, agent, fault, k, plan=self._drawn(k), target=self.target), 0, 0
    )(keys)
    empty = replay_lib.init(
      config.envs, config.capacity, len(spec.obs), len(spec.act), size.deter, size.stoch
    )
    replay = jax.tree.map(lambda x: jnp.broadcast_to(x, (seeds,) + x.shape).copy(), empty)
    self.state = self._place(Learner(train, streams, replay, key))
    self.returns = episodes.Returns((seeds, config.envs))
    self._add = jax.jit(jax.vmap(replay_lib.add), donate_argnums=0)
    self._redraw = jax.jit(nest(self._new_fault, 0, 0))
    self.checkpoints = checkpoints.Checkpoints(self.out / "checkpoints")

  # ---- phases ------------------------------------------------------------------------------------

  def _place(self, state: Learner) -> Learner:
    """Weights and replay on the devices that learn on them. The robots stay on the first: physics
    on a CPU is one batch of the host.
    """
    if self.mesh is None:
      return state
    spread = jax.sharding.NamedSharding(self.mesh, jax.sharding.PartitionSpec("seeds"))
    return state._replace(
      train=jax.device_put(state.train, spread), replay=jax.device_put(state.replay, spread)
    )

  @property
  def updates(self) -> int:
    """Updates taken, by the seeds that have not failed."""
    return int(np.max(np.asarray(self.state.train.updates)))

  def _drive(self) -> np.ndarray:
    drive = np.zeros((self.seeds, self.config.envs), bool)
    if self.phase != "pure":
      drive[:, : round(self.config.demo_share * self.config.envs)] = True
    return drive

  def _shake(self) -> np.ndarray | None:
    """Probability of a random stretch for each robot, or None; the last robots are shaken, the
    first are driven by a demonstrator.
    """
    if not self.config.shake or self.phase != "pure":
      return None
    shake = np.zeros((self.seeds, self.config.envs), np.float32)
    shake[:, self.config.envs - round(self.config.shake_share * self.config.envs) :] = (
      self.config.shake
    )
    return shake

  def _weights(self) -> Weights:
    done, c = self.updates, self.config
    left = c.updates - done
    lr = (
      1.0
      if c.lr_end is None
      else float(np.interp(left, [0, max(1, c.pure)], [c.lr_end / self.dreamer.lr, 1.0]))
    )
    if self.phase == "clone":
      return Weights(c.clone_weight, 0.0, lr)
    if self.phase == "fade":
      return Weights(c.clone_weight * max(0.0, 1.0 - (done - self.phase_start) / c.fade), 1.0, lr)
    return Weights(0.0, float(done - self.phase_start >= c.hold), lr)

  def _advance_phase(self) -> None:
    c, done = self.config, self.updates
    if self.phase == "clone":
      good = (
        len(self.own) >= 16 and np.mean(self.own[-16:]) >= c.clone_until * self.expert_return > 0
      )
      if good or done - self.phase_start >= c.clone or c.updates - done <= c.fade + c.pure:
        self._enter("fade")
    elif self.phase == "fade" and (done - self.phase_start >= c.fade or c.updates - done <= c.pure):
      self._enter("pure")
      self.state = self.state._replace(
        replay=jax.jit(replay_lib.clear, donate_argnums=0)(self.state.replay)
      )

  def _enter(self, phase: str) -> None:
    self.phase, self.phase_start = phase, self.updates

  def _drawn(self, key: jax.Array) -> faults.Plan:
    """A severity from the stream's key, from the first step on; a preset's own, and none without
    `config.fault`.
    """
    if self.plan is not None:
      return self.plan
    return faults.plan(
      self.config.severity * jax.random.uniform(jax.random.fold_in(key, OfStream.TRAINING_FAULT))
      if self.config.fault
      else 0.0
    )

  def _new_fault(self, stream: Stream, ended: jax.Array) -> Stream:
    """`stream` with another target and severity where its episode `ended`, so far as these are
    drawn: that follows from its key and its clock.
    """
    key = jax.random.fold_in(jax.random.fold_in(stream.key, OfStream.TRAINING_FAULT), stream.t)
    fresh = faults.begin(self.fault, key, self._drawn(key), self.target)  # type: ignore[arg-type]
    return stream._replace(
      injection=jax.tree.map(
        lambda a, b: jnp.where(ended, jnp.asarray(a, b.dtype), b), fresh, stream.injection
      )
    )

  # ---- one chunk ---------------------------------------------------------------------------------

  def step(self) -> dict[str, Any]:
    """Collects one chunk, takes the updates that it pays for, returns a row of metrics."""
    begin = time.monotonic()
    drive, shake = self._drive(), self._shake()
    kept: Any
    params, kept = self.state.train.params, records
    if self.mesh is not None:
      params = jax.device_put(params, jax.devices()[0])
      kept = lambda rows: jax.device_put(
        records(rows), jax.tree.leaves(self.state.replay)[0].sharding
      )
    streams, rows = self.collect[self.phase].chunk(params, self.state.streams, CHUNK, drive, shake)
    if self.fault is not None:
      streams = self._redraw(streams, jnp.any(rows.terminated | rows.truncated, 0))
    cost = self.config.fall_cost if self.config.updates - self.updates > self.config.pure else 0.0
    learnt = rows._replace(reward=rows.reward - cost * rows.terminated) if cost else rows
    replay = self._add(self.state.replay, *kept(learnt))
    self.state = self.state._replace(streams=streams, replay=replay)
    each: dict[int, list[float]]
    expert_returns, own, each = [], [], {g: [] for g in range(self.seeds)}
    counts = ~drive  # robots that act as the agent would
    counts &= shake is None or shake == 0
    for at, value in self.returns.add(rows):
      if drive[at]:
        expert_returns.append(value)
      elif counts[at]:
        own.append(value)
        each[at[0]].append(value)
    self.own = (self.own + own)[-200:]
    if expert_returns:
      self.expert_return = (
        float(np.mean(expert_returns))
        if not self.expert_return
        else 0.8 * self.expert_return + 0.2 * float(np.mean(expert_returns))
      )
    collected = time.monotonic()
    row = {
      "updates": self.updates,
      "records": int(np.sum(np.asarray(self.state.streams.t))) // self.config.repeat // self.seeds,
      "phase": self.phase,
      "return": float(np.mean(own)) if own else None,
      "episodes": len(own),
      "expert_return": self.expert_return or None,
      "reward": float(np.asarray(rows.reward)[:, counts].mean()) if counts.any() else None,
    }  # `return` is of episodes that end, short ones first
    if self.seeds > 1:
      row |= {
        f"return/{g}": float(np.mean(values)) if values else None for g, values in each.items()
      }
    size = self.dreamer.batch * self.dreamer.length
    enough = (
      int(
        np.min(
          jax.vmap(lambda r: replay_lib.windows(r, self.dreamer.length + 1))(self.state.replay)
        )
      )
      >= size
    )
    if enough:
      self.owed += CHUNK * self.config.envs * self.config.ratio / size
      kept = (
        0 if self.phase == "pure" else self.config.pure
      )  # the last phase gets its updates in full
      count = max(0, min(int(self.owed), self.config.updates - self.updates - kept))
      count = 1 << (count.bit_length() - 1) if count else 0  # few static lengths: the rest is owed
      self.owed -= count
      if count:
        key, key_learn = jax.random.split(self.state.key)
        active = np.array([g not in self.failed for g in range(self.seeds)])
        train, replay, metrics, bad = self.learn[self.phase](
          self.state.train, self.state.replay, key_learn, self._weights(), active, count
        )
        self.state = self.state._replace(train=train, replay=replay, key=key)
        metrics = {k: np.asarray(v) for k, v in metrics.items()}  # type: ignore[misc]
        self._notice_failures(np.asarray(bad))
        alive = [g for g in range(self.seeds) if g not in self.failed]
        row |= {k: float(np.mean(v[alive])) for k, v in metrics.items()} | {
          "failed_seeds": len(self.failed)
        }
    end = time.monotonic()
    self.seconds += end - begin
    row |= {
      "updates": self.updates,
      "seconds": self.seconds,
      "collect_s": collected - begin,
      "learn_s": end - collected,
    }
    self.rows.append(row)
    self.chunks += 1
    self._advance_phase()
    return row

  def _notice_failures(self, culprits: np.ndarray) -> None:
    """Stops every seed with a term at fault (agent.culprit): its weights are those before that
    update, and stay.
    """
    for g in np.flatnonzero(culprits >= 0):
      self.failed[int(g)] = (
        f"{CAUSES[culprits[g]]} is not finite, or above {EXPLODED:g}, in update "
        f"{int(np.asarray(self.state.train.updates)[g]) + 1}"
      )
      print(
        f"mjx-cl: numeric failure of seed {g}: {self.failed[int(g)]}; it stops here, its last "
        "sound weights are kept",
        file=sys.stderr,
        flush=True,
      )
    if len(self.failed) == self.seeds:
      raise FileError(
        f"numeric failure of every seed: {self.failed[self.seeds - 1]}; the last checkpoint is "
        "intact, --resume goes on from it"
      )

  @property
  def done(self) -> bool:
    """All updates have been made."""
    return self.updates >= self.config.updates

  # ---- files -------------------------------------------------------------------------------------

  def save(self) -> None:
    """Checkpoint (arrays with replay) and metrics.parquet."""
    meta = {
      "phase": self.phase,
      "phase_start": self.phase_start,
      "owed": self.owed,
      "own": self.own,
      "expert_return": self.expert_return,
      "sums": self.returns.sums.tolist(),
      "seconds": self.seconds,
      "failed": {str(g): why for g, why in self.failed.items()},
    }
    self.write_metrics()  # first: a kill in between leaves rows too many, which resume cuts off
    if self.checkpoints.latest() != self.chunks:
      self.checkpoints.save(self.chunks, self.state, meta)

  def write_metrics(self) -> None:
    """Writes OUT/metrics.parquet, a row a chunk."""
    if self.rows:
      names = sorted(set().union(*self.rows))
      columns = {n: [r.get(n) for r in self.rows] for n in names}
      tables.write_table(self.out / "metrics.parquet", columns)

  def resume(self) -> None:
    """Goes on from the newest checkpoint.

    Raises:
      FileError where no checkpoint can be read, or it or metrics.parquet is not a training's; the
      trainer is as before then.
    """
    path = self.out / "metrics.parquet"
    rows = tables.read_arrow(path).to_pylist() if path.exists() else []
    state, meta = self.checkpoints.load(self.state)
    chunks: Any = self.checkpoints.latest()
    try:
      failed = {int(g): str(why) for g, why in meta.get("failed", {}).items()}
      phase, phase_start, owed, own = (
        str(meta["phase"]),
        int(meta["phase_start"]),
        float(meta["owed"]),
        [float(x) for x in meta["own"]],
      )
      expert_return, sums, seconds = (
        float(meta["expert_return"]),
        np.asarray(meta["sums"], float),
        float(meta["seconds"]),
      )
      if phase not in self.collect or sums.shape != self.returns.sums.shape:
        raise ValueError(f"phase {phase!r}, returns of {sums.shape}")
    except (AttributeError, KeyError, TypeError, ValueError) as e:
      why = f"no {e}" if isinstance(e, KeyError) else e
      raise FileError(
        f"checkpoint {chunks} in {self.checkpoints.folder} is not a training's ({why}): "
        "--overwrite begins anew"
      ) from None
    self.state, self.rows, self.chunks, self.failed = (
      self._place(state),
      rows[:chunks],
      chunks,
      failed,
    )
    self.phase, self.phase_start, self.owed, self.own = phase, phase_start, owed, own
    self.expert_return, self.returns.sums, self.seconds = expert_return, sums, seconds


def build(
  env: Any,
  dreamer: DreamerConfig,
  config: TrainConfig,
  out: os.PathLike | str,
  seed: int,
  seeds: int,
  demonstrator_name: str | None,
  agent_name: str | None,
  preset: str,
  command: str,
  resume: bool,
) -> Trainer:
  """A Trainer with its folder and config.json; trains the demonstrator first where
  `demonstrator_name` is `ppo`.
  """
  out = pathlib.Path(out)
  config = shown(config, out, demonstrator_name)
  if demonstrator_name == "ppo":
    path = pathlib.Path(config.demonstrator)  # type: ignore[arg-type]
    if not path.exists():
      demonstrator.train(
        env,
        out / "demonstrator",
        getattr(env, "demonstration", {}).get("steps", DEMONSTRATOR_STEPS),
        seed,
        progress=lambda row: print(
          f"demonstrator: {row['step']:,} steps, return {row['return']:.0f}",
          file=sys.stderr,
          flush=True,
        ),
      )
      os.replace(sorted((out / "demonstrator").glob("policy_*.npz"))[-1], path)
  dreamer = scaled(env, dreamer)
  trainer = Trainer(env, dreamer, config, out, seed, seeds)
  trainer.about = {
    "env": env.spec.name,
    "preset": preset,
    "command": command,
    "seed": seed,
    "repeat": config.repeat,
    "dreamer": dataclasses.asdict(dreamer),
    "train": dataclasses.asdict(config),
    "started_from": agent_name,
  }
  values = {"command": "train", "seeds": seeds, **trainer.about, **runtime.provenance()}
  if resume and trainer.checkpoints.latest() is not None:
    trainer.resume()
    tables.write_json(out / "config.json", values)  # `updates` may have grown
  else:  # one that was cut off before its first checkpoint begins anew
    if agent_name:
      check(env, dreamer, config, agent_name)
      trained = agents.of(env, agent_name)
      spread = jax.tree.map(lambda x: jnp.broadcast_to(x, (seeds,) + x.shape).copy(), trained.train)
      trainer.state = trainer.state._replace(
        train=spread._replace(updates=jnp.zeros_like(spread.updates))
      )
    tables.write_json(out / "config.json", values)
  return trainer


def shown(
  config: TrainConfig, out: os.PathLike | str, demonstrator_name: str | None
) -> TrainConfig:
  """The settings with their demonstrator: the policy that `ppo` leaves in the folder, or what the
  user named.
  """
  if not demonstrator_name:
    return config
  own = pathlib.Path(out, "demonstrator", "policy.npz")
  return dataclasses.replace(
    config, demonstrator=str(own) if demonstrator_name == "ppo" else demonstrator_name
  )


def check_same(
  out: os.PathLike | str,
  env: Any,
  dreamer: DreamerConfig,
  config: TrainConfig,
  seed: int,
  seeds: int,
  demonstrator_name: str | None,
  agent_name: str | None,
) -> int:
  """Refuses to resume a training with other settings than it began with; the number of updates may
  be another. Returns the one it has.

  Raises:
    UserError that names the flags; FileError where config.json is not a training's.
  """
  path = pathlib.Path(out, "config.json")
  flat = lambda about, settings, agent: {**about, **settings, "agent": agent}
  now = flat(
    {"env": env.spec.name, "seed": seed, "seeds": seeds},
    json.loads(
      json.dumps(
        dataclasses.asdict(scaled(env, dreamer))
        | dataclasses.asdict(shown(config, out, demonstrator_name))
      )
    ),
    agent_name,
  )
  try:
    old = json.loads(path.read_text())
    settings = (
      dataclasses.asdict(DreamerConfig())
      | dataclasses.asdict(TrainConfig())
      | recorded(DreamerConfig, old["dreamer"])
      | recorded(TrainConfig, old["train"])
    )  # of a setting younger than the training
    before = flat(
      {"env": old["env"], "seed": old["seed"], "seeds": old.get("seeds", seeds)},
      settings,
      old.get("started_from"),
    )
  except (OSError, ValueError, KeyError, TypeError) as e:
    why = f": {e}" if type(e) is ValueError else ""
    raise FileError(f"{path} is not a training's{why}; give --overwrite or another --out") from None
  for key in (
    "demonstrator",
    "agent",
  ):  # one file may be named in two ways, and a folder may have moved
    names = [pathlib.Path(v[key]) for v in (before, now) if v[key]]
    if len(names) == 2 and (
      names[0].resolve() == names[1].resolve()
      if all(n.exists() for n in names)
      else names[0].name == names[1].name
    ):
      before[key] = now[key]
  changed = folders.differing(before, now, ("updates",))
  if changed:
    raise UserError(
      f"--resume: {out} was begun with another {', '.join(changed)}; give the same settings, "
      "--overwrite, or another --out with "
      f"--agent {pathlib.Path(out, 'agent')} once it has ended"
    )
  return int(before["updates"])


def clear(out: pathlib.Path) -> None:
  """Removes the agent and the demonstrator that an earlier training wrote, nothing else; the rest:
  run.clear.
  """
  for name in ("agent/agent.npz", "agent/card.json"):
    (out / name).unlink(missing_ok=True)
  for path in (out / "demonstrator").glob("policy*.npz"):
    path.unlink()


def export(trainer: Trainer, count: int = 20) -> dict[str, Any]:
  """Writes OUT/agent of the first seed that has not failed: weights, moments, counters, and the
  card with its returns. Returns the card.
  """
  sound = min(set(range(trainer.seeds)) - set(trainer.failed))
  train = jax.tree.map(lambda x: jax.device_put(x[sound], jax.devices()[0]), trainer.state.train)
  scores = {
    "first_seed": 0,
    **evaluate.evaluate(trainer.env, trainer.plain, train.params, count, 0, trainer.config.repeat),
  }
  phases: dict[str, dict] = {}
  for row in trainer.rows:
    phase = phases.setdefault(row["phase"], {"first_update": row["updates"], "returns": []})
    phase["last_update"] = row["updates"]
    if row["return"] is not None:
      phase["returns"].append(row["return"])
  for phase in phases.values():  # own episodes of the training, about the last three rounds
    phase["return_at_end"] = float(np.mean(phase["returns"][-3:])) if phase["returns"] else None
    phase["return_at_start"] = float(np.mean(phase["returns"][:1])) if phase["returns"] else None
    del phase["returns"]
  kept = json.loads(json.dumps(trainer.about))
  if kept["train"]["demonstrator"]:
    kept["train"]["demonstrator"] = pathlib.Path(kept["train"]["demonstrator"]).name
  card = {
    **kept,
    "updates": trainer.updates,
    "records": trainer.rows[-1]["records"],
    "seconds": round(trainer.seconds),
    "phases": phases,
    "demonstrator_return": trainer.expert_return or None,
    "eval": scores,
    **runtime.provenance(),
  }
  agents.save(trainer.out / "agent", train, card)
  return card


def run(
  trainer: Trainer,
  progress: Callable[[dict[str, Any]], object] = lambda row: None,
  save_every_s: float = 240.0,
) -> None:
  """Trains to the end, saving every `save_every_s` seconds, at the end, and when interrupted."""
  saved = time.monotonic()
  with Interruptible() as interrupt:
    while not trainer.done:
      progress(trainer.step())
      try:
        interrupt.check()
      except KeyboardInterrupt:
        # between two chunks; a second signal, in the middle of one, leaves nothing whole to save
        trainer.save()
        raise
      if time.monotonic() - saved > save_every_s:
        trainer.save()
        saved = time.monotonic()
  trainer.save()
