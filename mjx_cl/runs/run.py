"""`run`: the whole loop for arms x seeds streams, a host loop over chunks; checkpoints, result
files.

Where the robot becomes another one (a preset with `becomes`, see transfer.py) each stream has an
onset of its own: the step with which its first episode of the other robot begins. That step is its
`onset` in events.parquet, from it on its `severity` is 1, and latency, windows and recovery in
runs.parquet are counted from it. `onset` is null there, and every alarm a false one, for a stream
that never changed. Faults that follow have events of their own at the run's onset plus their
`after`.

A stream that changes more than once (a preset in sequence, such as car/transfer-then-socks, or a
fault that is repaired) has a row in runs.parquet for each change, numbered in column `change`,
`kind` onset or repair; summary.json holds the first in `arms`, the others in `later_changes`. A row
ends where the next change begins. Of a later change reward_pre is the mean of the 2,000 steps
before it, and reward_drop that of the same stream, whatever its arm did in those steps: no stream
without adaptation shares its past.
"""

from __future__ import annotations

import json
import pathlib
import shutil
import sys
import time
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import detectors, envs, faults
from mjx_cl.adapt import decide as phase_lib
from mjx_cl.adapt.arms import ARMS, FOREVER, never_stops
from mjx_cl.adapt.blocks import Crew
from mjx_cl.adapt.decide import SIGNALS
from mjx_cl.adapt.loop import Choices, Loop, LoopState, Programs, choices
from mjx_cl.config import CHUNK, RunConfig
from mjx_cl.dreamer import replay
from mjx_cl.dreamer.agent import CAUSES, EXPLODED
from mjx_cl.errors import FileError, UserError
from mjx_cl.faults.presets import becomes, changes
from mjx_cl.io import arrays, checkpoints, folders, runtime, tables
from mjx_cl.io.interrupt import Interruptible
from mjx_cl.keys import OfSeed
from mjx_cl.render import figures
from mjx_cl.rollout.monitor import Monitor
from mjx_cl.rollout.order import Lanes
from mjx_cl.rollout.scan import Rollout, Stream, nest, start
from mjx_cl.rollout.transfer import Moving, Transfer
from mjx_cl.runs.doubts import notes
from mjx_cl.runs.identity import arm_agents, check_same, identity, known_as, threshold_of
from mjx_cl.runs.records import Ledger, acts
from mjx_cl.runs.settings import check
from mjx_cl.runs.snapshots import Snapshots
from mjx_cl.scoring import events as event_table
from mjx_cl.scoring import stop_rule
from mjx_cl.training import agents
from mjx_cl.training import needs as bytes_of

if TYPE_CHECKING:
  from collections.abc import Callable
  from typing import Any

  from mjx_cl.adapt.loop import Digest
  from mjx_cl.rollout.scan import Row


class State(NamedTuple):
  """All arrays of a run: the robots and everything else, in blocks of streams, see crew.py."""

  streams: Stream | Moving
  loop: list[LoopState]


class Progress(NamedTuple):
  """What a display needs after each chunk: arrays over streams; `note`: what else is under way."""

  step: int
  steps: int
  seconds: float
  arms: list[str]
  seeds: list[int]
  phase: np.ndarray | jax.Array
  reward: np.ndarray | jax.Array
  alarms: np.ndarray
  updates: np.ndarray | jax.Array
  note: str = ""


def capacity(steps: int, episode: int, repeat: int = 1) -> int:
  """Replay records kept for a stream of `steps` control steps whose episodes last `episode`: all
  that it can write, one more than steps an episode. A robot that falls often begins more episodes
  than that, and in the end forgets its oldest records.
  """
  chunks = -(-steps // (CHUNK * repeat))
  return replay.room((chunks + 2) * CHUNK + steps // episode)


def held(state: LoopState) -> dict:
  """Its fields by name, without those that this run has no use for: a checkpoint of a version that
  did not know them yet goes on.
  """
  return {name: value for name, value in state._asdict().items() if value is not None}


class Runner:
  """Runs one RunConfig into the folder `out`.

  Streams are ordered arm by arm, seed by seed. A stream's keys come from its seed alone, so the
  same seed lives the same life in every arm until an alarm is acted on, bit for bit: see lanes.py.
  Another number of arms or seeds is another program, which rounds otherwise.
  """

  def __init__(
    self, config: RunConfig, out: pathlib.Path | str, programs: Programs | None = None
  ) -> None:
    self.config = config = check(config)
    self.out = pathlib.Path(out)
    self.env = envs.make(config.env, config.physics)
    self.other = (
      envs.make(becomes(config), config.physics) if becomes(config) else None  # type: ignore[arg-type]
    )  # what the robot becomes
    self.robots = [self.env] + [self.other] * (self.other is not None)
    spec = self.env.spec
    adapt = config.adapt
    self.trained = agents.of(
      self.env,
      config.agent,
      lr=adapt.lr,
      policy_lr=adapt.policy_lr,
      anchor=adapt.anchor,
      last_starts=adapt.last_starts,
      batch=adapt.batch,
    )
    agent, self.repeat = self.trained.agent, int(self.trained.card.get("repeat", 1))
    self.others = arm_agents(config, self.env)
    self.changes = changes(config)
    self.stops = stop_rule.told(config)
    self.faults, plan, target = faults.build(self.changes, self.robots[-1], config.onset)
    robot = known_as(self.env)
    found = threshold_of(config)
    settings = config.settings | ({"threshold": found.value} if found else {})
    detector = detectors.make(config.detector, **({"robot": robot} | settings))
    monitor = Monitor(agent, n=15, form=config.form, actions=config.actions, spec=spec)
    begin: Callable[[jax.Array, jax.Array], Any]
    if self.other is None:
      self.rollout: Rollout | Transfer = Rollout(
        self.env, agent, self.faults, self.repeat, config.deterministic
      )
      begin = lambda k, breaks: start(
        self.env, agent, self.faults, k, target=target, plan=spared(plan, breaks)
      )
    else:
      self.rollout = Transfer(
        self.env, self.other, agent, self.faults, self.repeat, config.deterministic
      )
      begin = lambda k, breaks: self.rollout.start(  # type: ignore[union-attr]
        k, target, spared(plan, breaks), jnp.where(breaks, config.onset, FOREVER)
      )
    self.chunk_steps = CHUNK * self.repeat
    self.chunks = -(-config.steps // self.chunk_steps)
    episode = min(r.spec.episode_steps for r in self.robots)
    needs = lambda steps: capacity(steps, episode, self.repeat)
    bytes_of.check(
      agent.config.size,
      len(spec.obs),
      len(spec.act),
      needs(config.steps),
      len(config.arms) * config.seeds,
      ("steps", needs),
      agent.config.bins,
    )
    self.seeds = [config.first_seed + i for i in range(config.seeds)]
    self.labels = [(arm, seed) for arm in config.arms for seed in self.seeds]
    self.groups = len(self.labels)
    self.lanes = Lanes(len(config.arms), config.seeds)
    same = (
      agent.config,
      agent.obs_size,
      agent.act_size,
      agent.stepwise,
      config.form,
      config.actions,
      spec,
      detectors.factory(config.detector),
      config.detector,
      robot,
      json.dumps(settings, sort_keys=True, default=repr),
    )
    self.crew = Crew(
      Loop(
        agent,
        monitor,
        detector,
        spec,
        config.adapt,
        self.repeat,
        capacity=needs(config.steps),
        same=same,
        programs=Programs() if programs is None else programs,
      ),
      self.groups,
    )
    self.breaks = np.asarray([ARMS[arm].breaks for arm, _ in self.labels])
    keys = jnp.stack([jax.random.key(seed) for _, seed in self.labels])[:, None]
    self.keys = jax.vmap(lambda k: jax.random.fold_in(k, OfSeed.ADAPTATION))(keys[:, 0])
    trains = [
      self.others[arm].train if arm in self.others else self.trained.train for arm, _ in self.labels
    ]
    self.state = State(
      nest(begin, (0, 0), (0, None))(keys, jnp.asarray(self.breaks)),
      self.crew.init(trains, any(ARMS[arm].rollback for arm in config.arms)),
    )
    self.acting = self.crew.acting(self.state.loop, self.lanes)
    self.choices = self._choices(self.state.streams)
    self.done_chunks = 0
    self.compiled = False  # the first chunk of this process compiles
    self.seconds = {"physics": 0.0, "acting": 0.0, "digest": 0.0, "other": 0.0}
    self.quiet: list[float] = []  # digest time of chunks without an update
    self.parts: list[dict] = []
    self.stream_seconds: np.ndarray = np.zeros(self.groups)
    self._updates: np.ndarray | jax.Array = np.zeros(self.groups, int)
    self._alarms: np.ndarray = np.zeros(self.groups, int)
    self._phase: np.ndarray | jax.Array = np.zeros(self.groups, int)
    self.work = self.out / "work"
    self.endless = any(never_stops(ARMS[arm]) for arm in config.arms)
    self.snapshots = (
      Snapshots(
        config,
        self.robots[-1],
        agent,
        self.faults,
        self.changes,
        self.repeat,
        self.labels,
        self.trained.train.params,
        self.work / "snapshots",
      )
      if config.snapshots
      else None
    )

  def open(self) -> None:
    """Makes the working folder; before that nothing in `out` is touched."""
    self.checkpoints = checkpoints.Checkpoints(self.work / "checkpoints")

  # ---- one chunk ---------------------------------------------------------------------------------

  def step(self) -> Progress:
    """Lives one chunk and logs it."""
    begin = time.perf_counter()
    physics = self._physics_seconds()
    streams, rows = self.rollout.chunk(self.acting, self.lanes.spread(self.state.streams), CHUNK)
    streams, rows = self.lanes.gather(streams), self.lanes.gather_rows(jax.block_until_ready(rows))
    acted = time.perf_counter()
    physics = self._physics_seconds() - physics
    now = (self.done_chunks + 1) * self.chunk_steps
    if self.other is not None:
      self.choices = self._choices(streams)  # robots have changed in this chunk
    loop, digest = self.crew.digest(
      self.state.loop, rows, jnp.int32(now), self.choices, self.keys, self._acceptance(streams, now)
    )
    digested = time.perf_counter()
    self.state = State(streams, loop)
    changed = (digest.updates != self._updates) | (
      digest.decision > 0
    )  # weights are what they were in every other stream
    if (
      changed.any() or len(loop) == 1
    ):  # the only block's own arrays, which its next digest uses up
      self.acting = self.crew.acting(loop, self.lanes)
    before = self._phase
    self._log(rows, digest)
    updates = digest.updates - self._updates
    self._updates = digest.updates
    self.done_chunks += 1
    self._notice_failures(digest, now)
    if self.snapshots:
      self.snapshots.take(self.acting, self.lanes.place, before, digest, now, self.chunk_steps)
    if self.compiled:
      self.seconds["physics"] += physics
      self.seconds["acting"] += acted - begin - physics
      self.seconds["digest"] += digested - acted
      if not updates.sum():
        self.quiet.append(digested - acted)
    else:
      self.seconds["other"] += digested - begin
      self.compiled = True
    learning = (
      max(0.0, digested - acted - float(np.median(self.quiet)))
      if self.quiet and updates.sum()
      else 0.0
    )
    self.stream_seconds += (digested - begin - learning) / self.groups + learning * updates / max(  # type: ignore[operator]
      1, updates.sum()
    )
    self.seconds["other"] += time.perf_counter() - digested
    self._alarms = self._alarms + digest.fired.sum(0)
    return Progress(
      min(now, self.config.steps),
      self.config.steps,
      sum(self.seconds.values()),
      [a for a, _ in self.labels],
      [s for _, s in self.labels],
      digest.phase,
      digest.signals[:, 2],
      self._alarms,
      digest.updates,
    )

  def _notice_failures(self, digest: Digest, now: int) -> None:
    """Says which streams are given up for a loss at fault; they live on without learning. A reward
    that is no number would spoil every figure: that ends the run.
    """
    lost = np.flatnonzero(~np.isfinite(digest.signals[:, SIGNALS.index("reward")]))
    if len(lost):
      raise FileError(
        f"numeric failure at step {now} in stream {self.labels[lost[0]]}: its reward is not "
        "finite; the last checkpoint is intact"
      )
    for g in np.flatnonzero(digest.decision == phase_lib.ABORT_NUMERIC):
      bad = int(digest.failed[g])
      term = (
        CAUSES[bad]
        if bad >= 0
        else next(name for name, x in zip(SIGNALS[3:], digest.signals[g, 3:]) if not np.isfinite(x))
      )
      arm, seed = self.labels[g]
      print(
        f"mjx-cl: numeric failure at step {now} of arm {arm}, seed {seed}: {term} is not "
        f"finite, or above {EXPLODED:g}; it learns no more, the others go on",
        file=sys.stderr,
        flush=True,
      )

  def _physics_seconds(self) -> float:
    clocks = {
      id(getattr(p, "host", p)): p for p in map(envs.physics_of, self.robots)
    }  # robots of one model share a host
    return sum(getattr(p, "seconds", 0.0) for p in clocks.values())

  def _acceptance(self, streams: Stream | Moving, now: int) -> jax.Array | None:
    """Level (groups,) of the robot that each stream has after `now` control steps; None where
    robots stay what they are.
    """
    if self.other is None:
      return None
    return jnp.where(
      streams.after.enter[:, 0] < now,  # type: ignore[union-attr]
      jnp.float32(self.other.spec.acceptance),
      jnp.float32(self.env.spec.acceptance),
    )

  def _choices(self, streams: Stream | Moving) -> Choices:
    """The arms, with every true onset of their robots that is known by now; arms that are told one
    begin there even where the fault's severity is 0.
    """
    c = self.config
    onsets = tuple(c.onset + change.after for change in self.changes if change.fault != "none")
    moves = (
      [()] * self.groups
      if self.other is None
      else [(int(step),) for step in np.asarray(streams.after.enter)[:, 0]]  # type: ignore[union-attr]
    )
    return choices(self.labels, c.adapt, c.steps, [own + onsets for own in moves], self.stops)

  def onsets(self) -> list[int | None]:
    """Each stream's onset; where the robot becomes another one: as far as it is known. None: not in
    this run, an arm whose robot is spared, or a run without a fault or with one of severity 0,
    which changes nothing.
    """
    if self.other is None:
      met = self.config.onset < self.config.steps and any(acts(change) for change in self.changes)
      return [self.config.onset if breaks and met else None for breaks in self.breaks]
    return [
      int(step) if step < self.config.steps else None
      for step in np.asarray(self.state.streams.after.enter)[:, 0]  # type: ignore[union-attr]
    ]

  def _log(self, rows: Row, digest: Digest) -> None:
    """Keeps a chunk's rows, (control steps, groups), and its chunk values (groups,)."""
    control = lambda x: np.repeat(np.asarray(x)[:, :, 0], self.repeat, 0)

    def at_end(
      x: np.ndarray | jax.Array,
    ) -> np.ndarray:  # a value per decision, known with its last control step
      out = np.full((CHUNK, self.repeat) + x.shape[1:], np.nan, np.float32)
      out[:, -1] = x
      return out.reshape((-1,) + x.shape[1:])

    ends = lambda x: at_end(np.asarray(x).astype(np.float32)) > 0
    each = lambda x: (
      np.asarray(x)[:, :, 0].swapaxes(1, 2).reshape(-1, self.groups)
    )  # a value per control step
    rewards = each(rows.rewards)
    part = {
      "reward": rewards,
      "severity": control(rows.severity) if rows.severities is None else each(rows.severities),
      "episode": control(rows.episode),
      "terminated": ends(np.asarray(rows.terminated)[:, :, 0]),
      "truncated": ends(np.asarray(rows.truncated)[:, :, 0]),
      "opr": at_end(digest.residual.opr),
      "rpr": at_end(digest.residual.rpr),
      "valid": ends(digest.residual.valid),
      "score": at_end(digest.score),
      "alarm": ends(digest.fired),
      "phase": np.broadcast_to(self._phase.astype(np.int8), rewards.shape).copy(),
      "updates": np.broadcast_to(self._updates.astype(np.int32), rewards.shape).copy(),
      **({"parts": at_end(digest.residual.groups)} if self.config.parts else {}),
      **({"variables": at_end(digest.residual.variables)} if self.config.residuals else {}),
      "signals": digest.signals[None],
      "decision": digest.decision[None],
      "since": digest.since[None],
      "settled": digest.settled[None],
      **(
        {"back": digest.back[None], "earned": digest.earned[None], "earns": digest.earns[None]}  # type: ignore[index]
        if digest.back is not None
        else {}
      ),
    }
    if self.endless:  # what the stop rule reads besides the signals
      now = (self.done_chunks + 1) * self.chunk_steps
      level = (
        self._acceptance(self.state.streams, now)
        if self.config.adapt.acceptance is None
        else self.config.adapt.acceptance
      )
      index = (self.env.spec.posture or (0, 0.0))[0]
      part |= {
        "posture": np.asarray(rows.final_obs)[:, :, 0, index].mean(0)[None],
        "acceptance": np.broadcast_to(
          np.float32(self.env.spec.acceptance if level is None else level), (1, self.groups)
        ).copy(),
      }
    self._phase = digest.phase
    self.parts.append(part)

  # ---- kill and resume ---------------------------------------------------------------------------

  def save(self) -> None:
    """Trace so far and state, so that a killed run goes on from here."""
    number = self.done_chunks
    if self.checkpoints.latest() == number:
      return
    begin = time.perf_counter()
    arrays.write(self.work / f"trace-{number:06d}.npz", self._trace())
    self.seconds["other"] += time.perf_counter() - begin
    meta = {
      "seconds": self.seconds,
      "quiet": self.quiet,
      "stream_seconds": self.stream_seconds.tolist(),
      "updates": self._updates.tolist(),
      "alarms": self._alarms.tolist(),
      "phase": self._phase.tolist(),
    }
    self.checkpoints.save(
      number,
      State(self.state.streams, held(self.crew.join(self.state.loop))),  # type: ignore[arg-type]
      meta,
    )
    runtime.give_back()
    for old in sorted(self.work.glob("trace-*.npz"))[:-2]:
      old.unlink()

  def _trace(self) -> dict[str, np.ndarray]:
    return (
      {k: np.concatenate([p[k] for p in self.parts]) for k in self.parts[0]} if self.parts else {}
    )

  def resume(self) -> None:
    """Goes on from the newest checkpoint; without one, from the start."""
    if self.checkpoints.latest() is None:
      return
    like = State(self.state.streams, held(self.crew.shapes(self.state.loop)))  # type: ignore[arg-type]
    self.state = self.acting = (  # type: ignore[assignment]
      None  # what the run began with need not lie beside what it goes on with
    )
    (streams, loop), meta = self.checkpoints.load(like)
    number = self.checkpoints.latest()
    self.state = State(streams, self.crew.split(LoopState(**loop)))
    self.acting = self.crew.acting(self.state.loop, self.lanes)
    self.parts = [arrays.read(self.work / f"trace-{number:06d}.npz")]
    self.done_chunks = number  # type: ignore[assignment]
    self.seconds, self.quiet, self.stream_seconds = (
      meta["seconds"],
      meta["quiet"],
      np.asarray(meta["stream_seconds"]),
    )
    self._updates, self._alarms, self._phase = (
      np.asarray(meta[k]) for k in ("updates", "alarms", "phase")
    )

  @property
  def done(self) -> bool:
    """All chunks have been lived."""
    return self.done_chunks >= self.chunks

  # ---- result files ------------------------------------------------------------------------------

  def config_dict(self) -> dict:
    """What config.json holds."""
    return {
      "command": "run",
      **identity(self.config),
      "physics": "+".join(dict.fromkeys(envs.physics_of(robot).name for robot in self.robots)),
      "agent_card": self.trained.card,
      **(
        {"arm_cards": {arm: other.card for arm, other in self.others.items()}}
        if self.others
        else {}
      ),
      "agent_path": pathlib.Path(self.trained.path).name,
      "repeat": self.repeat,
      "control_s": self.env.spec.control_s,
      **runtime.provenance(),
    }

  def finish(self, tell: Callable[[str], Any] = lambda text: None) -> dict:
    """Writes trace, events, runs, summary and figure, of an arm that never stops also signals,
    snapshots and stop; removes the working files.

    Returns summary.json's value.
    """
    steps = self.config.steps
    if self.snapshots:
      self.save()  # their evaluation takes a while; one that is cut off goes on from here
    trace = {k: v[:steps] if v.shape[0] >= steps else v for k, v in self._trace().items()}
    outside = (trace["decision"] == phase_lib.START) & (
      trace["since"] >= steps
    )  # the last chunk lives on to its end
    trace["decision"] = np.where(outside, phase_lib.NOTHING, trace["decision"])
    if self.other is None:
      targets = np.asarray(self.state.streams.injection.target)[:, 0]  # type: ignore[union-attr]  # (groups, F)
      names = [
        "+".join(f"{f.name}:{f.targets[t]}" for f, t in zip(self.faults, row)) for row in targets
      ]
    else:
      names = [self.config.fault] * self.groups
    ledger = self._ledger([name if breaks else "none" for name, breaks in zip(names, self.breaks)])
    table, events = ledger.trace(trace), ledger.events(trace)
    runs = ledger.rows(trace, events)
    tables.write_table(self.out / "trace.parquet", table)
    event_table.write(self.out / "events.parquet", events)
    tables.write_table(self.out / "runs.parquet", {k: [r[k] for r in runs] for k in runs[0]})
    if self.config.residuals:
      tables.write_table(
        self.out / "residuals.parquet",
        {k: table[k] for k in ("stream", "arm", "seed", "step")}
        | {
          v.name: np.ascontiguousarray(trace["variables"][:, :, k].T).reshape(-1)
          for k, v in enumerate(self.env.spec.obs)
        },
      )
    figures.figure(self.out)
    if self.endless and "posture" in trace:
      tables.write_table(self.out / "signals.parquet", ledger.signals(trace))
    summary = ledger.summary(runs, trace, self.seconds, self.quiet, self.done_chunks)
    taken = self.snapshots.taken(trace, self.chunk_steps) if self.snapshots else []
    if taken:
      last = self.state.streams if self.other is None else self.state.streams.after  # type: ignore[union-attr]
      columns, summary["wall_s_snapshots"] = self.snapshots.evaluate(  # type: ignore[union-attr]
        taken,
        np.asarray(last.injection.target)[:, 0],  # type: ignore[union-attr]
        tell,
      )
      tables.write_table(self.out / "snapshots.parquet", columns)
      judged = stop_rule.of_folder(self.out)
      tables.write_table(
        self.out / "stop.parquet", {k: [r[k] for r in judged] for k in stop_rule.COLUMNS}
      )
      summary["stop_rule"] = stop_rule.summarise(judged)
    if self.config.keep:
      self.keep()
    tables.write_json(self.out / "summary.json", summary)
    self.checkpoints.close()
    shutil.rmtree(self.work, ignore_errors=True)
    return summary

  def _ledger(self, names: list[str]) -> Ledger:
    return Ledger(
      self.config,
      self.env.spec,
      self.repeat,
      self.chunk_steps,
      self.changes,
      None if self.other is None else self.other.spec.name,
      self.labels,
      self.breaks,
      names,
      self.onsets(),
      self._updates,  # type: ignore[arg-type]
      self.stream_seconds,
    )

  def keep(self) -> None:
    """Writes OUT/agents/ARM-SEED for every stream that has learnt: the weights that it acts by at
    the end, and the moments and counters of its learner.

    Of a stream that went back (arm `rollback`) the weights are those of before, moments, slow
    critic and counters those of the learner that was given up. The card is that of the agent it
    began with but for what that scored, and `adapted`: robot and fault it has lived with, arm,
    seed, control steps of the run, updates taken.
    """
    block_of = [
      (i, g - block.start)
      for i, block in enumerate(self.crew.blocks)
      for g in range(block.start, block.stop)
    ]
    for g, (arm, seed) in enumerate(self.labels):
      if not self._updates[g]:
        continue
      i, at = block_of[g]
      own = jax.tree.map(
        lambda x: np.asarray(x[at]),
        self.state.loop[i].train._replace(params=self.state.loop[i].acting),
      )
      card = {
        k: v
        for k, v in self.others.get(arm, self.trained).card.items()
        if k not in ("eval", "demonstrator_return")
      }
      adapted = {
        "env": self.config.env,
        "becomes": becomes(self.config),
        "fault": self.config.fault,
        "arm": arm,
        "seed": seed,
        "steps": self.config.steps,
        "updates": int(self._updates[g]),
      }
      try:
        agents.save(self.out / "agents" / f"{arm}-{seed}", own, {**card, "adapted": adapted})
      except OSError as e:
        raise FileError(
          f"cannot write in {self.out / 'agents'}: {e.strerror or e}; --resume writes them again"
        ) from None


def spared(plan: faults.Plan, breaks: jax.Array) -> faults.Plan:
  """`plan` for a robot that breaks, bool (); without any severity for one that does not."""
  return plan._replace(severity=jnp.where(breaks, plan.severity, 0.0))


def execute(
  config: RunConfig,
  out: pathlib.Path | str,
  resume: bool = False,
  overwrite: bool = False,
  progress: Callable[[Progress], Any] = lambda p: None,
  save_every_s: float = 60.0,
  tell: Callable[[str], Any] = lambda text: None,
  programs: Programs | None = None,
) -> dict:
  """Runs `config` into `out` and returns summary.json's value. A kill at any moment loses at most
  `save_every_s` seconds of work. `programs`: compiled ones of this process that it may share.
  """
  config, fresh = check(config), not pathlib.Path(out).exists()
  state, out = folders.claim_folder(out, resume, overwrite), pathlib.Path(out)
  if state == "done":
    check_same(
      out, {k: v for k, v in identity(config).items() if k != "physics"}
    )  # `auto` is resolved there
    return tables.read_json(out / "summary.json")
  try:
    runner = Runner(
      config, out, programs
    )  # refuses wrong names and broken agents before anything of an earlier run is removed
  except UserError:
    if fresh and not any(out.iterdir()):
      out.rmdir()
    raise
  values = runner.config_dict()
  if state == "resume":
    check_same(out, values)
    runner.open()
    runner.resume()
  else:
    if overwrite:
      clear(out)
    runner.open()
    tables.write_json(out / "config.json", values)
  for text in notes(config):
    tell(f"note: {text}")
  tell(
    f"{len(config.arms) * config.seeds} streams of {config.steps:,} control steps; what is not "
    "compiled yet is compiled first, a minute or two"
  )
  saved = time.monotonic()
  with Interruptible() as interrupt:
    last = None
    while not runner.done:
      last = runner.step()
      progress(last)
      try:
        interrupt.check()
      except KeyboardInterrupt:
        # between two chunks; a second signal, in the middle of one, leaves nothing whole to save
        runner.save()
        raise
      if time.monotonic() - saved > save_every_s:
        runner.save()
        saved = time.monotonic()
  return runner.finish(lambda text: last and progress(last._replace(note=text)))


def clear(out: pathlib.Path) -> None:
  """Removes an earlier run's own files, nothing else."""
  for name in ("config.json", *folders.RESULTS):
    (out / name).unlink(missing_ok=True)
  for name in ("work", "checkpoints"):
    shutil.rmtree(out / name, ignore_errors=True)
  for card in (out / "agents").glob("*/card.json"):
    if '"adapted"' not in card.read_text(errors="replace"):  # not of `keep`
      continue
    for name in ("agent.npz", "card.json"):
      (card.parent / name).unlink(missing_ok=True)
    for folder in (card.parent, card.parent.parent):
      if not any(folder.iterdir()):
        folder.rmdir()
