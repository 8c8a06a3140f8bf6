"""Pretraining: a host loop of collect (acting, physics) and learn (updates), resumable."""

import dataclasses
import os
import pathlib
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import faults
from mjx_cl.config import CHUNK, DreamerConfig, TrainConfig
from mjx_cl.dreamer import replay as replay_lib
from mjx_cl.dreamer.agent import CAUSES, EXPLODED, Agent, TrainState, Weights
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import checkpoints, tables
from mjx_cl.io.interrupt import Interruptible
from mjx_cl.keys import OfStream
from mjx_cl.rollout.scan import Rollout, Row, Stream, nest, records, start
from mjx_cl.training import episodes, needs
from mjx_cl.training.learn import make_learn, seeds_mesh
from mjx_cl.training.premises import check, eased, expert, faults_of, shaped


class Learner(NamedTuple):
  """Arrays of a pretraining run, all with a leading seeds axis but `key`."""

  train: TrainState
  streams: Stream
  replay: replay_lib.Replay
  key: jax.Array


# what a checkpoint keeps of a Trainer beside its arrays, and how each is read again
COUNTERS: dict[str, Callable[[Any], Any]] = {
  "phase": str,
  "phase_start": int,
  "owed": float,
  "own": lambda returns: [float(x) for x in returns],
  "expert_return": float,
  "seconds": float,
}


def mean(values: Sequence[float]) -> float | None:
  """Mean of numbers; None where there are none."""
  return float(np.mean(values)) if values else None


def fits(env: Any, dreamer: DreamerConfig, config: TrainConfig, seeds: int = 1) -> None:
  """Refuses, before anything is allocated or removed, what a Trainer of these would refuse.

  Raises:
    UserError: one line.
  """
  check(env, dreamer, config)
  shaped(eased(env, config.penalties), config.shaping)
  if dreamer.anchor and config.shake:
    raise UserError(
      "anchor holds the policy to the actions taken; shake puts random ones among them: set it to 0"
    )
  sizes = len(env.spec.obs), len(env.spec.act)
  Agent(dreamer, *sizes)
  mesh = seeds_mesh(seeds)
  needs.check(
    dreamer.size,
    *sizes,
    config.envs * config.capacity,
    seeds,
    ("capacity", lambda n: n * config.envs),
    dreamer.bins,
    # devices of a CPU share its memory
    1 if mesh is None or jax.default_backend() == "cpu" else mesh.size,
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
    fits(env, dreamer, config, seeds)
    self.env, self.dreamer, self.config, self.out = env, dreamer, config, pathlib.Path(out)
    self.seed, self.seeds, self.mesh = seed, seeds, seeds_mesh(seeds)
    env = shaped(eased(env, config.penalties), config.shaping)
    self.expert = expert(env, config.demonstrator) if config.demonstrator else None
    self.expert_return = 0.0
    self.phase = "clone" if self.expert else "pure"
    self.phase_start = self.chunks = 0
    self.owed = self.seconds = 0.0
    self.rows: list[dict] = []
    self.own: list[float] = []
    self.failed: dict[int, str] = {}  # seed, from 0 -> the term that was not finite, and when
    self.plain = Agent(dreamer, len(env.spec.obs), len(env.spec.act))
    fault, self.plan, self.target = faults_of(env, config)
    self.fault: Any = fault if config.fault else None
    self._programs(env, fault)
    self.state = self._place(self._begun(env, fault, seed))
    self.returns = episodes.Returns((seeds, config.envs))
    self.driven = self._drive()  # robots whose running episode the demonstrator drove, if in part
    self._add = jax.jit(jax.vmap(replay_lib.add), donate_argnums=0)
    self._redraw = jax.jit(nest(self._new_fault, 0, 0))
    self.checkpoints = checkpoints.Checkpoints(self.out / "checkpoints")

  def _programs(self, env: Any, fault: Any) -> None:
    """`collect` and `learn`, the programs of each phase."""
    dreamer, config = self.dreamer, self.config
    self.collect = {"pure": Rollout(env, self.plain, fault, config.repeat)}
    self.learn = {"pure": make_learn(self.plain, dreamer.batch, dreamer.length, self.mesh)}
    if self.expert:
      sizes = len(env.spec.obs), len(env.spec.act)
      cloning = Agent(dataclasses.replace(dreamer, anchor=0.0), *sizes, clone_std=config.clone_std)
      rollout = Rollout(
        env, cloning, fault, config.repeat, expert=self.expert, expert_noise=config.demo_noise
      )
      learn = make_learn(cloning, dreamer.batch, dreamer.length, self.mesh)
      self.collect |= {"clone": rollout, "fade": rollout}
      self.learn |= {"clone": learn, "fade": learn}

  def _begun(self, env: Any, fault: Any, seed: int) -> Learner:
    """Untrained weights, robots in their first step and an empty replay."""
    key_init, key_stream, key = jax.random.split(jax.random.key(seed), 3)
    config, size = self.config, self.plain.size
    train = jax.vmap(self.plain.init)(jax.random.split(key_init, self.seeds))
    begin = lambda k: start(env, self.plain, fault, k, plan=self._drawn(k), target=self.target)
    streams = nest(begin, 0, 0)(jax.random.split(key_stream, (self.seeds, config.envs)))
    empty = replay_lib.init(
      config.envs, config.capacity, len(env.spec.obs), len(env.spec.act), size.deter, size.stoch
    )
    replay = jax.tree.map(lambda x: jnp.broadcast_to(x, (self.seeds,) + x.shape).copy(), empty)
    return Learner(train, streams, replay, key)

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
    """Which robots the demonstrator drives: the first ones."""
    driven = 0 if self.phase == "pure" else round(self.config.demo_share * self.config.envs)
    return np.tile(np.arange(self.config.envs) < driven, (self.seeds, 1))

  def _shake(self) -> np.ndarray | None:
    """Probability of a random stretch for each robot, or None; the last robots are shaken, the
    first are driven by a demonstrator.
    """
    c = self.config
    if not c.shake or self.phase != "pure":
      return None
    shaken = np.arange(c.envs) >= c.envs - round(c.shake_share * c.envs)
    return np.tile(np.float32(c.shake) * shaken, (self.seeds, 1))

  def _weights(self) -> Weights:
    done, c = self.updates, self.config
    left = c.updates - done
    end = 1.0 if c.lr_end is None else c.lr_end / self.dreamer.lr
    lr = float(np.interp(left, [0, max(1, c.pure)], [end, 1.0]))
    if self.phase == "clone":
      return Weights(c.clone_weight, 0.0, lr)
    if self.phase == "fade":
      return Weights(
        c.clone_weight * max(0.0, 1.0 - (done - self.phase_start) / max(1, c.fade)), 1.0, lr
      )
    return Weights(0.0, float(done - self.phase_start >= c.hold), lr)

  def _advance_phase(self) -> None:
    c, done = self.config, self.updates
    if self.phase == "clone":
      good = (
        len(self.own) >= 16 and np.mean(self.own[-16:]) >= c.clone_until * self.expert_return > 0
      )
      if good or done - self.phase_start >= c.clone or c.updates - done <= c.fade + c.pure:
        self.phase, self.phase_start = "fade", done
    elif self.phase == "fade" and (done - self.phase_start >= c.fade or c.updates - done <= c.pure):
      self.phase, self.phase_start = "pure", done
      self.state = self.state._replace(
        replay=jax.jit(replay_lib.clear, donate_argnums=0)(self.state.replay)
      )

  def _drawn(self, key: jax.Array) -> faults.Plan:
    """A severity from the stream's key, from the first step on; a preset's own, and none without
    `config.fault`.
    """
    if self.plan is not None:
      return self.plan
    if not self.config.fault:
      return faults.plan()
    key = jax.random.fold_in(key, OfStream.TRAINING_FAULT)
    return faults.plan(self.config.severity * jax.random.uniform(key))

  def _new_fault(self, stream: Stream, ended: jax.Array) -> Stream:
    """`stream` with another target and severity where its episode `ended`, so far as these are
    drawn: that follows from its key and its clock. What the faults remember is of the episode that
    has begun since, and stays.
    """
    key = jax.random.fold_in(jax.random.fold_in(stream.key, OfStream.TRAINING_FAULT), stream.t)
    fresh = faults.begin(self.fault, key, self._drawn(key), self.target)
    states = zip(fresh.states, stream.injection.states)
    fresh = fresh._replace(states=tuple(new._replace(memory=old.memory) for new, old in states))
    return stream._replace(
      injection=jax.tree.map(
        lambda a, b: jnp.where(ended, jnp.asarray(a, b.dtype), b), fresh, stream.injection
      )
    )

  # ---- one chunk ---------------------------------------------------------------------------------

  def step(self) -> dict[str, Any]:
    """Collects one chunk, takes the updates that it pays for, returns a row of metrics."""
    begin = time.monotonic()
    row = self._lived()
    collected = time.monotonic()
    row |= self._learnt()
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

  def _lived(self) -> dict[str, Any]:
    """Collects one chunk; what its episodes returned, those that end, short ones first."""
    drive, shake = self._drive(), self._shake()
    rows = self._collect(drive, shake)
    counts = ~drive if shake is None else ~drive & (shake == 0)  # those that act as the agent would
    self.driven |= drive
    expert_returns, own = [], []
    for at, value in self.returns.add(rows):
      if drive[at]:
        expert_returns.append(value)
      elif counts[at] and not self.driven[at]:
        own.append((at[0], value))
      self.driven[at] = drive[at]  # of the episode that begins
    returns = [value for _, value in own]
    self.own = (self.own + returns)[-200:]
    if expert_returns:
      latest = float(np.mean(expert_returns))
      self.expert_return = 0.8 * self.expert_return + 0.2 * latest if self.expert_return else latest
    row = {
      "records": int(np.sum(np.asarray(self.state.streams.t))) // self.config.repeat // self.seeds,
      "phase": self.phase,
      "return": mean(returns),
      "episodes": len(returns),
      "expert_return": self.expert_return or None,
      "reward": float(np.asarray(rows.reward)[:, counts].mean()) if counts.any() else None,
    }
    if self.seeds > 1:
      row |= {
        f"return/{g}": mean([value for seed, value in own if seed == g]) for g in range(self.seeds)
      }
    return row

  def _collect(self, drive: np.ndarray, shake: np.ndarray | None) -> Row:
    """Lives one chunk and keeps its records."""
    params = self.state.train.params
    if self.mesh is not None:
      params = jax.device_put(params, jax.devices()[0])
    streams, rows = self.collect[self.phase].chunk(params, self.state.streams, CHUNK, drive, shake)
    if self.fault is not None:
      streams = self._redraw(streams, jnp.any(rows.terminated | rows.truncated, 0))
    cost = self.config.fall_cost if self.config.updates - self.updates > self.config.pure else 0.0
    kept = records(rows._replace(reward=rows.reward - cost * rows.terminated) if cost else rows)
    if self.mesh is not None:
      kept = jax.device_put(kept, jax.tree.leaves(self.state.replay)[0].sharding)
    self.state = self.state._replace(streams=streams, replay=self._add(self.state.replay, *kept))
    return rows

  def _learnt(self) -> dict[str, Any]:
    """Takes the updates that a chunk pays for; their metrics, none where there are none."""
    size = self.dreamer.batch * self.dreamer.length
    windows = jax.vmap(lambda r: replay_lib.windows(r, self.dreamer.length + 1))(self.state.replay)
    if int(np.min(windows)) < size:
      return {}
    self.owed += CHUNK * self.config.envs * self.config.ratio / size
    # the last phase gets its updates in full
    kept = 0 if self.phase == "pure" else self.config.pure
    count = max(0, min(int(self.owed), self.config.updates - self.updates - kept))
    if not count:
      return {}
    count = 1 << (count.bit_length() - 1)  # few static lengths: the rest is owed
    self.owed -= count
    key, key_learn = jax.random.split(self.state.key)
    active = np.array([g not in self.failed for g in range(self.seeds)])
    train, replay, metrics, bad = self.learn[self.phase](
      self.state.train, self.state.replay, key_learn, self._weights(), active, count
    )
    self.state = self.state._replace(train=train, replay=replay, key=key)
    self._notice_failures(np.asarray(bad))
    alive = [g for g in range(self.seeds) if g not in self.failed]
    return {k: float(np.mean(np.asarray(v)[alive])) for k, v in metrics.items()} | {
      "failed_seeds": len(self.failed)
    }

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
        f"mjx-cl: numeric failure of seed {self.seed + g}: {self.failed[int(g)]}; it stops here",
        file=sys.stderr,
        flush=True,
      )
    if len(self.failed) == self.seeds:
      raise FileError(
        f"numeric failure of every seed: {self.failed[self.seeds - 1]}; the last checkpoint is "
        f"intact: --resume --set updates={max(1, self.updates)} ends sound, or give another --out "
        "and a lower lr"
      )

  @property
  def done(self) -> bool:
    """All updates have been made."""
    return self.updates >= self.config.updates

  # ---- files -------------------------------------------------------------------------------------

  def save(self) -> None:
    """Checkpoint (arrays with replay) and metrics.parquet, a row a chunk."""
    if self.rows:  # first: a kill in between leaves rows too many, which resume cuts off
      names = sorted(set().union(*self.rows))
      columns = {n: [r.get(n) for r in self.rows] for n in names}
      tables.write_table(self.out / "metrics.parquet", columns)
    if self.checkpoints.latest() != self.chunks:
      meta = {name: getattr(self, name) for name in COUNTERS} | {
        "sums": self.returns.sums.tolist(),
        "driven": self.driven.tolist(),
        "failed": {str(g): why for g, why in self.failed.items()},
      }
      self.checkpoints.save(self.chunks, self.state, meta)

  def resume(self) -> None:
    """Goes on from the newest checkpoint.

    Raises:
      FileError: no checkpoint can be read, or it or metrics.parquet is not a training's; the
        trainer is as before then.
    """
    path = self.out / "metrics.parquet"
    rows = tables.read_arrow(path).to_pylist() if path.exists() else []
    state, meta = self.checkpoints.load(self.state)
    chunks: Any = self.checkpoints.latest()
    try:
      failed = {int(g): str(why) for g, why in meta.get("failed", {}).items()}
      counters = {name: read(meta[name]) for name, read in COUNTERS.items()}
      sums = np.asarray(meta["sums"], float)
      driven = np.asarray(meta.get("driven", self.driven), bool)
      robots = self.returns.sums.shape
      if counters["phase"] not in self.collect or not robots == sums.shape == driven.shape:
        raise ValueError(f"phase {counters['phase']!r}, returns of {sums.shape}")
    except (AttributeError, KeyError, TypeError, ValueError) as e:
      why = f"no {e}" if isinstance(e, KeyError) else e
      raise FileError(
        f"checkpoint {chunks} in {self.checkpoints.folder} is not a training's ({why}): "
        "--overwrite begins anew"
      ) from None
    vars(self).update(counters, chunks=chunks, rows=rows[:chunks], failed=failed)
    self.state, self.returns.sums, self.driven = self._place(state), sums, driven.copy()


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
