"""The life of a run: all its streams, chunk by chunk, and its checkpoints."""

import functools
import itertools
import pathlib
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import envs, faults
from mjx_cl.adapt import decide as phase_lib
from mjx_cl.adapt import methods
from mjx_cl.adapt.arms import ARMS, FOREVER, never_stops
from mjx_cl.adapt.loop import Choices, Digest, Programs, choices
from mjx_cl.adapt.state import cut
from mjx_cl.config import CHUNK, RunConfig
from mjx_cl.dreamer.agent import CAUSES, EXPLODED
from mjx_cl.errors import FileError, PluginError
from mjx_cl.faults.presets import becomes, changes
from mjx_cl.io import arrays, checkpoints, runtime
from mjx_cl.keys import OfSeed
from mjx_cl.rollout.scan import Rollout, Row, nest, start
from mjx_cl.rollout.transfer import Transfer
from mjx_cl.runs import packing, room
from mjx_cl.runs.clock import clock_of, counted, sorted_out
from mjx_cl.runs.groups import Settled
from mjx_cl.runs.healthy import Healthy, fork, key_of, last, take
from mjx_cl.runs.identity import arm_agents, check_learners, identity
from mjx_cl.runs.lives import Lives
from mjx_cl.runs.loops import make_loop
from mjx_cl.runs.outlook import Standing
from mjx_cl.runs.records import acts
from mjx_cl.runs.settings import check
from mjx_cl.runs.snapshots import Snapshots
from mjx_cl.runs.trace import at_end, columns
from mjx_cl.scoring import stop_rule
from mjx_cl.training import agents

SOON = 16  # chunks: of a shorter run nothing is compiled before it is needed
KINDS = ("physics", "acting", "monitor", "updates", "compiling", "other")  # of wall time


class Progress(NamedTuple):
  """What a display needs after each chunk.

  Attributes:
    step: control steps done.
    steps: of the run.
    seconds: of wall time.
    arms: of each stream.
    seeds: of each stream.
    phase: int (groups,), index into phases.PHASES.
    reward: float (groups,), mean of the chunk.
    alarms: int (groups,), so far.
    updates: int (groups,), so far.
    note: what else is under way.
    left: seconds to the end, None: not known yet.
  """

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
  left: float | None = None


class Runner:
  """Runs one RunConfig into the folder `out`.

  Streams are ordered arm by arm, seed by seed. A stream's keys come from its seed alone, so the
  same seed lives the same life in every arm until an adaptation begins, see lives.py.
  """

  def __init__(
    self,
    config: RunConfig,
    out: pathlib.Path | str,
    programs: Programs | None = None,
    healthy: Healthy | None = None,
  ) -> None:
    self.config = config = check(config)
    self.out = pathlib.Path(out)
    self.work = self.out / "work"
    # the robots, their agents and what befalls them
    self.programs = Programs() if programs is None else programs
    self.env = self._robot(config.env)
    into = becomes(config)
    self.other = None if into is None else self._robot(into)
    self.robots = [self.env] if self.other is None else [self.env, self.other]
    adapt = ("lr", "policy_lr", "model_lr", "anchor", "last_starts", "batch")
    departures = {name: getattr(config.adapt, name) for name in adapt}
    self.trained = agents.of(self.env, config.agent, **departures)
    check_learners(config, self.trained)
    self.repeat = self.trained.repeat
    self.others = arm_agents(config, self.env)
    self.changes = changes(config)
    self.stops = stop_rule.told(config)
    self.faults, plan, target = faults.build(self.changes, self.robots[-1], config.onset)
    # the streams
    learner = (self.env.spec, self.trained.agent.config, self.repeat)
    self.room = room.of(config, *learner)
    room.check(self.room, config)
    seeds = range(config.first_seed, config.first_seed + config.seeds)
    self.labels = list(itertools.product(config.arms, seeds))
    self.groups = len(self.labels)
    arms = [ARMS[arm] for arm in config.arms]
    for name, arm in zip(config.arms, arms):
      if not isinstance(arm.method, str):
        methods.check(name, arm.method, self.trained.agent)
    self.endless = any(never_stops(arm) for arm in arms)
    self.breaks = np.asarray([ARMS[arm].breaks for arm, _ in self.labels])
    self.chunk_steps = CHUNK * self.repeat
    self.chunks = -(-config.steps // self.chunk_steps)
    self._begin(plan, target)
    self.choices = self._choices()
    self.clock = clock_of(config, *learner, self.stops)
    self.clock.joined = not self.lives.herds
    self.healthy = healthy
    cards = [self.trained.card, *(other.card for other in self.others.values())]
    owned = {leaf.removeprefix("mj.") for fault in self.faults for leaf in fault.owns}
    self.shares = key_of(config, cards, owned) if healthy and self.lives.herds else ""
    # what has been lived
    self.done_chunks = 0
    self.seconds = dict.fromkeys(KINDS, 0.0)
    self.parts: list[dict] = []
    self.stream_seconds: np.ndarray = np.zeros(self.groups)
    self._updates: Any = np.zeros(self.groups, int)
    self._alarms: Any = np.zeros(self.groups, int)
    self._phase: Any = np.zeros(self.groups, int)
    self.snapshots: Snapshots | None = None
    if config.snapshots:
      what = (self.robots[-1], self.trained, self.faults, self.changes, self.labels)
      self.snapshots = Snapshots(config, *what, self.work / "snapshots")

  def _robot(self, name: str) -> Any:
    """The robot of that name, one for all runs that share programs."""
    physics = self.config.physics
    own = ("robot", envs.ENVS.get(name), name, physics)
    return self.programs.share(own, lambda: envs.make(name, physics))

  def _begin(self, plan: faults.Plan, target: Any) -> None:
    """What moves the streams, and the streams before their first step."""
    keys = jnp.stack([jax.random.key(seed) for _, seed in self.labels])[:, None]
    self.keys = jax.vmap(lambda k: jax.random.fold_in(k, OfSeed.ADAPTATION))(keys[:, 0])
    self.rollout, begin = self._rollout(plan, target)
    learners = sum(ARMS[arm].learns for arm, _ in self.labels)
    self.loop = make_loop(self.config, self.robots, self.trained, learners, self.programs)
    trains = [self.others.get(arm, self.trained).train for arm, _ in self.labels]
    self.lives = Lives(
      self.rollout,
      self.loop,
      nest(begin, (0, 0), (0, None))(keys, jnp.asarray(self.breaks)),
      trains,
      [(id(t), bool(b), seed) for t, b, (_, seed) in zip(trains, self.breaks, self.labels)],
      self.keys,
      methods.used(tuple(self.config.arms)),
      ahead=learners > 0 and self.chunks > SOON,
    )

  def _rollout(self, plan: faults.Plan, target: Any) -> tuple[Any, Callable[..., Any]]:
    """The rollout, and what begins a stream of it, given its key and whether its robot breaks."""
    env, agent, own, onset = self.env, self.trained.agent, self.faults, self.config.onset
    how = (self.repeat, self.config.deterministic)
    # rollouts of the same robots, agent and faults are the same, however severe the faults are
    what = [faults.FAULTS.get(change.fault) for change in self.changes]
    mind = (agent.config, agent.obs_size, agent.act_size, agent.stepwise)
    same = ("rollout", *self.robots, mind, *what, *how)
    # without any severity for a robot that does not break
    spared = lambda breaks: plan._replace(severity=jnp.where(breaks, plan.severity, 0.0))
    if self.other is None:
      begin = lambda key, breaks: start(env, agent, own, key, target=target, plan=spared(breaks))
      return self.programs.share(same, lambda: Rollout(env, agent, own, *how)), begin
    moves = self.programs.share(same, lambda: Transfer(env, self.other, agent, own, *how))
    due = lambda breaks: jnp.where(breaks, onset, FOREVER)
    return moves, lambda key, breaks: moves.start(key, target, spared(breaks), due(breaks))

  def open(self) -> None:
    """Makes the working folder; before that nothing in `out` is touched."""
    self.checkpoints = checkpoints.Checkpoints(self.work / "checkpoints")

  def fork(self) -> None:
    """Goes on from what a run of another fault has lived before the onset, where there is one."""
    past = self.healthy.kept.get(self.shares) if self.healthy else None
    if past is None or not fork(self.lives, past):
      return
    self.done_chunks, self.parts = past.chunks, list(past.parts)
    self._alarms, self._phase = past.alarms, past.phase

  # ---- one chunk ---------------------------------------------------------------------------------

  def step(self) -> Progress:
    """Lives one chunk and logs it."""
    begin, physics, compiled = time.perf_counter(), self._physics_seconds(), self.lives.compiled
    done, learner = counted(self.lives), np.isin(range(self.groups), list(self.lives.place))
    now = (self.done_chunks + 1) * self.chunk_steps
    rows, digest, seconds = self.lives.step(now, functools.partial(self._settle, now))
    lived = time.perf_counter()
    before, updates = self._phase, digest.updates - self._updates
    self._log(rows, digest)
    self._updates = digest.updates
    self._alarms = self._alarms + digest.fired.sum(0)
    self.done_chunks += 1
    self._notice_failures(digest, now)
    if self.healthy and self.shares and self.done_chunks <= last(self.config, self.chunk_steps):
      past = take(self.lives, self.done_chunks, self.parts, self._alarms, self._phase)
      self.healthy.keep(self.shares, past)
    if self.snapshots:
      self.snapshots.take(self.lives.acting, before, digest, now, self.chunk_steps)
    physics, compiled = self._physics_seconds() - physics, self.lives.compiled - compiled
    self._account(lived - begin, seconds, physics, compiled)
    self.seconds["other"] += time.perf_counter() - lived
    if not compiled:
      one = lambda x: np.array([float(x)])
      done = done._replace(updates=one(updates.sum()), longest=one(updates.max()))
      each = sorted_out(seconds, learner, updates)
      self.clock.see(done, each, time.perf_counter() - begin)
    arms, seeds = map(list, zip(*self.labels))
    return Progress(
      min(now, self.config.steps),
      self.config.steps,
      sum(self.seconds.values()),
      arms,
      seeds,
      digest.phase,
      digest.signals[:, phase_lib.SIGNALS.index("reward")],
      self._alarms,
      digest.updates,
      left=self.clock.left(now, self._stands(digest), self.lives.compiled),
    )

  def _stands(self, digest: Digest) -> list[Standing]:
    """How each stream stands after a chunk."""
    begun = [g in self.lives.place and int(digest.since[g]) > 0 for g in range(self.groups)]
    return [
      Standing(int(phase), int(since) if yes else -1)
      for phase, since, yes in zip(digest.phase, digest.since, begun)
    ]

  def _account(self, wall: float, seconds: np.ndarray, physics: float, compiled: float) -> None:
    """Adds a chunk's seconds of wall time, shared among kinds of work and streams as the cores'
    own `seconds` (groups, kinds) are; a chunk in which something was compiled counts as compiling.
    """
    if compiled:  # which nobody in particular has caused
      self.seconds["compiling"] += wall
      self.stream_seconds += wall / len(seconds)
      return
    share = wall / max(1e-9, seconds.sum())
    self.stream_seconds += seconds.sum(1) * share
    acting, monitor, updates = seconds.sum(0) * share
    physics = min(acting, physics * share)
    for kind, spent in zip(KINDS, (physics, acting - physics, monitor, updates)):
      self.seconds[kind] += float(spent)

  def _notice_failures(self, digest: Digest, now: int) -> None:
    """Says which streams are given up for a loss at fault; they live on without learning. A reward
    that is no number would spoil every figure: that ends the run.
    """
    lost = np.flatnonzero(~np.isfinite(digest.signals[:, phase_lib.SIGNALS.index("reward")]))
    if len(lost):
      raise FileError(
        "numeric failure by step {} in arm {}, seed {}: the robot's reward is not finite; the last "
        "checkpoint is intact".format(now, *self.labels[lost[0]])
      )
    for g in np.flatnonzero(digest.decision == phase_lib.ABORT_NUMERIC):
      bad = int(digest.failed[g])
      wrong = [
        name for name, x in zip(phase_lib.SIGNALS[3:], digest.signals[g, 3:]) if not np.isfinite(x)
      ]
      term = CAUSES[bad] if bad >= 0 else wrong[0]
      arm, seed = self.labels[g]
      print(
        f"mjx-cl: numeric failure at step {now} of arm {arm}, seed {seed}: {term} is not "
        f"finite, or above {EXPLODED:g}; it learns no more, the others go on",
        file=sys.stderr,
        flush=True,
      )

  def _physics_seconds(self) -> float:
    # robots of one model share a host
    clocks = {id(getattr(p, "host", p)): p for p in map(envs.physics_of, self.robots)}
    return sum(getattr(p, "seconds", 0.0) for p in clocks.values())

  def _entered(self) -> np.ndarray:
    """Int (groups,), control step at which each robot became the other one; FOREVER: not known."""
    return self.lives.each(lambda robots: robots.after.enter)

  def _level(self, enter: Any, now: int) -> jax.Array:
    """Acceptance of robots that became the other one in control steps `enter`."""
    levels = [jnp.float32(robot.spec.acceptance) for robot in (self.robots[-1], self.env)]
    return jnp.where(jnp.asarray(enter) < now, *levels)

  def _settle(self, now: int, g: int, robot: Callable[[], Any]) -> Settled:
    """What holds for stream g in the chunk that ends with control step `now`."""
    own = self.choices[g]
    if self.other is None:
      return Settled(own, None)
    enter = robot().after.enter[0]
    return Settled(own._replace(at=self._at(g, int(enter[0]))), self._level(enter, now))

  def _onsets(self) -> tuple[int, ...]:
    return tuple(self.config.onset + c.after for c in self.changes if c.fault != "none")

  def _at(self, g: int, enter: int) -> jax.Array:
    """Choices.at of stream g, as wide as before, whose robot became the other one in control step
    `enter`.
    """
    c, own = self.config, self.labels[g : g + 1]
    at = choices(own, c.adapt, c.steps, [(enter, *self._onsets())], self.stops).at
    room = self.choices[g].at.shape[1] - at.shape[1]  # an arm with more starts makes it wider
    if room < 0:
      raise PluginError(
        f"arm {own[0][0]!r}: told an onset at step {enter:,} it starts more adaptations than the "
        f"{self.choices[g].at.shape[1]} that a run has room for whose onset may be {c.onset:,}"
      )
    return jnp.pad(at, ((0, 0), (0, room)), constant_values=FOREVER)

  def _choices(self) -> list[Choices]:
    """Of each stream, with every true onset that is known from the start; arms that are told one
    begin there even where the fault's severity is 0.
    """
    c = self.config
    known = [(() if self.other is None else (FOREVER,)) + self._onsets()] * self.groups
    room = 0
    if self.other is not None:  # as many starts as there are where the onset comes at once
      soon = [(c.onset, *self._onsets())] * self.groups
      room = choices(self.labels, c.adapt, c.steps, soon, self.stops).at.shape[1]
    whole = choices(self.labels, c.adapt, c.steps, known, self.stops)
    more = ((0, 0), (0, max(0, room - whole.at.shape[1])))
    whole = whole._replace(at=jnp.pad(whole.at, more, constant_values=FOREVER))
    return [cut(whole, slice(g, g + 1), 0) for g in range(self.groups)]

  def onsets(self) -> list[int | None]:
    """Each stream's onset; where the robot becomes another one: as far as it is known. None: not in
    this run, an arm whose robot is spared, or a run without a fault or with one of severity 0,
    which changes nothing.
    """
    steps, onset = self.config.steps, self.config.onset
    if self.other is not None:
      return [step if step < steps else None for step in self._entered().tolist()]
    met = onset < steps and any(acts(change) for change in self.changes)
    return [onset if breaks and met else None for breaks in self.breaks]

  def _log(self, rows: Row, digest: Digest) -> None:
    """Keeps a chunk's rows, (control steps, groups), and its chunk values (groups,)."""
    part = columns(rows, digest, self._phase, self._updates, self.repeat)
    if self.config.parts:
      part["parts"] = at_end(digest.residual.groups, self.repeat)
    if self.config.residuals:
      part["variables"] = at_end(digest.residual.variables, self.repeat)
      part["innovation"] = at_end(digest.residual.innovation, self.repeat)
    if self.endless:  # what the stop rule reads besides the signals
      level: Any = self.config.adapt.acceptance
      if level is None:
        now = (self.done_chunks + 1) * self.chunk_steps
        level = self.env.spec.acceptance
        level = level if self.other is None else self._level(self._entered(), now)
      level = np.asarray(level, np.float32)
      index = (self.env.spec.posture or (0, 0.0))[0]
      part["posture"] = np.asarray(rows.final_obs)[:, :, 0, index].mean(0)[None]
      part["acceptance"] = np.broadcast_to(level, (1, self.groups)).copy()
    self._phase = digest.phase
    self.parts.append(part)

  # ---- kill and resume ---------------------------------------------------------------------------

  def save(self) -> None:
    """Trace so far and state, so that a killed run goes on from here."""
    number = self.done_chunks
    if self.checkpoints.latest() == number:
      return
    begin = time.perf_counter()
    tree, bands = packing.pack(self.lives)
    arrays.write(self.work / f"trace-{number:06d}.npz", self.trace())
    self.seconds["other"] += time.perf_counter() - begin
    meta = {
      "seconds": self.seconds,
      "bands": bands,
      "stream_seconds": self.stream_seconds.tolist(),
      "updates": self._updates.tolist(),
      "alarms": self._alarms.tolist(),
      "phase": self._phase.tolist(),
    }
    self.checkpoints.save(number, tree, meta)
    runtime.give_back()
    kept = {f"trace-{n:06d}.npz" for n in self.checkpoints.numbers()}
    for old in self.work.glob("trace-*.npz"):  # a save that failed leaves one without a checkpoint
      if old.name not in kept:
        old.unlink()

  def trace(self) -> dict[str, np.ndarray]:
    """Everything that has been logged, (control steps, groups) or (chunks, groups)."""
    names = self.parts[0] if self.parts else ()
    return {name: np.concatenate([part[name] for part in self.parts]) for name in names}

  def resume(self) -> None:
    """Goes on from the newest checkpoint; without one, from the start."""
    if self.checkpoints.latest() is None:
      return
    tree, meta = self.checkpoints.load(self._like)
    packing.unpack(self.lives, tree, meta["bands"])
    number = self.checkpoints.latest() or 0  # a broken one has been set aside
    self.parts = [arrays.read(self.work / f"trace-{number:06d}.npz")]
    self.done_chunks = number
    self.seconds = meta["seconds"]
    self.stream_seconds, self._updates, self._alarms, self._phase = (
      np.asarray(meta[k]) for k in ("stream_seconds", "updates", "alarms", "phase")
    )

  def _like(self, meta: dict) -> dict:
    """Shapes of a checkpoint's tree."""
    if "bands" not in meta:
      raise FileError("it names no bands of learners, as those of an earlier version")
    return packing.like(self.lives, meta["bands"])

  @property
  def done(self) -> bool:
    """All chunks have been lived."""
    return self.done_chunks >= self.chunks

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
