"""What happens to a chunk of rows of every stream, in one jitted program without callbacks: it is
watched, decided upon and learnt from, and the weights that act next are chosen.

Streams are groups of one member: each has its own parameters. A stream that is not adapting costs
no update.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.adapt import act, decide, learn, watch
from mjx_cl.adapt import arms as arms_lib
from mjx_cl.config import AdaptConfig
from mjx_cl.detectors.base import Detector
from mjx_cl.dreamer import replay as replay_lib
from mjx_cl.dreamer.agent import Agent, TrainState
from mjx_cl.errors import choose
from mjx_cl.rollout.monitor import History, Monitor, Residual, unknown
from mjx_cl.rollout.scan import Row
from mjx_cl.types import Spec


class LoopState(NamedTuple):
  """Everything of a run but the streams; leading (groups,) unless said.

  Attributes:
    train: TrainState of each stream.
    acting: the parameters that act and predict, a moving average of train.params while adapting,
      equal to them otherwise.
    replay: Replay with one environment each, post-alarm records only.
    history: monitor history, leading (n - 1, groups, 1).
    detector: state of the detector.
    phase: PhaseState.
    past: Residual of the last `refit` rows, leading (refit, groups).
    owed: float32, fraction of an update that is due.
    executed: int32, updates taken since the run began.
    before: Before of each stream; None where no arm of the run goes back.
  """

  train: TrainState
  acting: Any
  replay: replay_lib.Replay | Any
  history: History
  detector: Any
  phase: decide.PhaseState
  past: Residual
  owed: jax.Array
  executed: jax.Array
  before: act.Before | None = None


class Digest(NamedTuple):
  """What the host logs of a chunk: rows (T, groups) and values (groups,).

  Attributes:
    residual: Residual of each row.
    score: float32, the detector's, of each row.
    fired: bool, alarms, of each row.
    signals: float32 (groups, 6), in the order of decide.SIGNALS.
    settled: bool (groups, 6), which of them have settled.
    phase: int32, index into decide.PHASES after the chunk.
    decision: int32, index into decide.REASONS.
    since: int32, control step that the last adaptation counts from.
    updates: int32, taken since the run began.
    failed: int32, index into agent.CAUSES of what was at fault in an update, which changed nothing
      and was the stream's last; -1: nothing.
    back: bool, an abort put the weights of before the adaptation back; None where no arm does.
    earned: float32, mean reward a step of those, see act.Before; None likewise.
    earns: float32, of the weights that have learnt; None likewise.
  """

  residual: Residual
  score: jax.Array
  fired: jax.Array
  signals: jax.Array
  settled: jax.Array
  phase: jax.Array
  decision: jax.Array
  since: jax.Array
  updates: jax.Array
  failed: jax.Array
  back: jax.Array | None = None
  earned: jax.Array | None = None
  earns: jax.Array | None = None


# Choices.at is padded to a multiple of it: arms with up to eight starts share a program
WIDTH = 8


class Choices(NamedTuple):
  """The arms of a run as arrays, leading (groups,); see arms.Arm.

  Attributes:
    listens: bool, alarms are acted on.
    at: int32 (groups, K), control steps at which adaptation is due, FOREVER: none; K is a multiple
      of WIDTH.
    rule: bool, stop and abort rules are in force.
    limit: int32, most control steps of one adaptation.
    world_only: bool, actor and critic keep what they are. fresh: bool, every start draws new
      parameters; None: no arm of the run does, and the program goes without the drawing, a quarter
      of what there is to compile.
    rollback: bool, an abort may put the weights of before the adaptation back; None: no arm of the
      run does, and LoopState.before is None too.
  """

  listens: jax.Array
  at: jax.Array
  rule: jax.Array
  limit: jax.Array
  world_only: jax.Array
  fresh: jax.Array | None
  rollback: jax.Array | None = None


def choices(
  labels: Sequence[tuple[str, int]],
  config: AdaptConfig,
  steps: int,
  onsets: Sequence[tuple[int, ...]] | None = None,
  stops: dict[int, int] | None = None,
) -> Choices:
  """Choices of streams.

  Args:
    labels: (arm, seed) of each.
    config: AdaptConfig.
    steps: of the run.
    onsets: true onsets of each robot, unless its arm spares it, as control steps, FOREVER: not
      known yet; None: no faults.
    stops: seed -> control steps after which an arm that is told its oracle stop ends.

  Raises:
    UserError where an arm's schedule does not fit into the run.
  """
  arms: list[Any] = [choose("arm", arm, arms_lib.ARMS) for arm, _ in labels]
  onsets = [()] * len(arms) if onsets is None else onsets
  at = [
    arm.trigger.steps(config, own if arm.breaks else (), steps, seed)
    for arm, own, (_, seed) in zip(arms, onsets, labels)
  ]
  width = WIDTH * max(1, -(-max(map(len, at)) // WIDTH))
  at = [
    [step if step < steps else arms_lib.FOREVER for step in row]
    + [arms_lib.FOREVER] * (width - len(row))
    for row in at
  ]
  flags = lambda get: jnp.asarray([get(arm) for arm in arms], bool)
  limits = [
    min(arm.end.limit(config), stops[seed]) if arm.end.told else arm.end.limit(config)  # type: ignore[index]
    for arm, (_, seed) in zip(arms, labels)
  ]
  return Choices(
    flags(lambda a: a.trigger.listens),
    jnp.asarray(at, jnp.int32),
    flags(lambda a: a.end.rule),
    jnp.asarray(limits, jnp.int32),
    flags(lambda a: a.world_only),
    flags(lambda a: a.fresh) if any(arm.fresh for arm in arms) else None,
    flags(lambda a: a.rollback) if any(arm.rollback for arm in arms) else None,
  )


class Programs:
  """Compiled programs of Loops, for runs of one process that follow each other.

  Args:
    most: as many are kept, the newest: a compiled program takes memory.
  """

  def __init__(self, most: int = 8) -> None:
    self.most = most
    self.kept: dict[Hashable, Any] = {}  # the newest last

  def share(self, key: Hashable, program: Any) -> Any:
    """The program that is kept under `key`, else `program`, which is kept from now on."""
    try:
      program = self.kept.pop(key, program)
    except TypeError:  # it holds a list, such as the spec of another package may
      return program
    self.kept[key] = program
    while len(self.kept) > self.most:
      del self.kept[next(iter(self.kept))]
    return program


class Loop:
  """Monitor, detector, phase machine and learner of a run.

  Args:
    agent: Agent whose config holds the learning rate of adaptation.
    monitor: gives residuals.
    detector: gives alarms.
    spec: of the environment (acceptance, posture).
    config: AdaptConfig.
    repeat: control steps per decision.
    capacity: post-alarm records kept per stream.
    same: stands for agent, monitor, detector and spec together; Loops that give an equal one share
      their program in `programs`. None, or what has no hash: its own.
    programs: of the process; None: the Loop's own alone.

  The numbers of `config` are arguments of the program, not constants in it: runs that differ in
  budget, ratio, average or rule share one compilation.
  """

  def __init__(
    self,
    agent: Agent,
    monitor: Monitor,
    detector: Detector,
    spec: Spec,
    config: AdaptConfig,
    repeat: int = 1,
    capacity: int = 20_480,
    same: Hashable | None = None,
    programs: Programs | None = None,
  ) -> None:
    self.agent, self.monitor, self.detector, self.spec = agent, monitor, detector, spec
    self.config, self.repeat, self.capacity = config, repeat, capacity
    self._program = jax.jit(self._digest, donate_argnums=0)
    if same is not None and programs is not None:
      self._program = programs.share((same, repeat), self._program)

  def init(self, train: TrainState, groups: int, rollback: bool = False) -> LoopState:
    """State before the first step; `train` is the shipped agent, the same for every stream.
    rollback: an arm of the run goes back, see Before.
    """
    a = self.agent
    spread = lambda tree: jax.tree.map(
      lambda x: jnp.broadcast_to(x, (groups,) + x.shape).copy(), tree
    )
    shapes = jax.eval_shape(
      lambda: replay_lib.init(1, self.capacity, a.obs_size, a.act_size, a.size.deter, a.size.stoch)
    )
    replay = jax.tree.map(
      lambda x: jnp.zeros((groups,) + x.shape, x.dtype), shapes
    )  # empty: all zeros; a copy of one would be held twice for a while
    rows = max(1, self.config.refit // self.repeat)
    state = LoopState(
      spread(train),
      spread(train.params),
      replay,
      self.monitor.init(groups, 1),
      spread(self.detector.init()),
      spread(decide.init(self.config)),
      unknown((rows, groups), a.obs_size),
      jnp.zeros(groups),
      jnp.zeros(groups, jnp.int32),
      act.Before(
        spread(train.params), jnp.zeros(groups), jnp.zeros(groups), jnp.zeros(groups, bool)
      )
      if rollback
      else None,
    )
    return jax.tree.map(
      lambda x: jnp.asarray(x, x.dtype) if x.weak_type else x, state
    )  # a weak type would be a second trace, also of a run that goes on

  def digest(
    self,
    state: LoopState,
    rows: Row,
    now: jax.Array,
    choices: Choices,
    keys: jax.Array,
    acceptance: jax.Array | None = None,
  ) -> tuple[LoopState, Digest]:
    """One chunk, jitted; `state` is used up.

    Args:
      state: before the chunk.
      rows: leading (T, groups, 1).
      now: int32 (), control steps done after the chunk.
      choices: of the streams.
      keys: (groups,), each stream's own, so that what a stream draws does not depend on its
        neighbours.
      acceptance: float32 (groups,), of the robot that each stream has by now, where robots change;
        None: that of `spec`.

    Returns:
      (state', Digest).
    """
    return self._program(state, rows, now, choices, keys, acceptance, self.config)

  def _digest(
    self,
    state: LoopState,
    rows: Row,
    now: jax.Array,
    choices: Choices,
    keys: jax.Array,
    acceptance: jax.Array | float | None,
    config: AdaptConfig,
  ) -> tuple[LoopState, Digest]:
    agent, was, length = self.agent, state.phase.phase, rows.reward.shape[0]
    split = jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, now), 3))(keys)
    seen, history, detector, past = watch.watch(
      agent, self.monitor, self.detector, self.spec, state, rows, split[:, :2]
    )

    begin = decide.starts(seen.fired, choices.at, now, self.repeat, config)
    if acceptance is None or config.acceptance is not None:
      acceptance = self.spec.acceptance if config.acceptance is None else config.acceptance
    _, least = self.spec.posture or (0, -jnp.inf)
    phase, decision, settled = decide.decide(
      state.phase, seen.signals, seen.posture, begin, now, choices, acceptance, least, config
    )
    begins = decision == decide.START

    replay = learn.fill(state.replay, rows, begins, begin.row, was == decide.ADAPTING)
    owed = learn.owing(agent, replay, phase.phase == decide.ADAPTING, state.owed, length, config)
    number = jnp.floor(owed + 1e-6).astype(jnp.int32)
    train, acting = state.train, state.acting
    if choices.fresh is not None:
      train, acting = learn.renew(agent, train, acting, keys, begins & choices.fresh)
    if config.fresh_moments:
      train = learn.fresh_moments(agent, train, begins)
    counted = train.updates
    train, replay, failed = learn.learn(
      agent, train, replay, split[:, 2], number, choices.world_only
    )
    taken = train.updates - counted
    phase, decision = decide.give_up(phase, decision, was, failed, seen.signals)

    # the robot acts by a moving average of what it learns, and keeps it when it is done
    acting = act.follow(acting, train.params, number, config.average)
    before, weighed = state.before, ()
    if before is not None:
      reward = seen.signals[:, decide.SIGNALS.index("reward")]
      acting, before, weighed = act.put_back(  # type: ignore[assignment]
        acting,
        before,
        phase,
        was,
        begins,
        reward,
        taken,
        choices.rollback,  # type: ignore[arg-type]
      )
    train = train._replace(params=act.choose(act.ended(was, phase), acting, train.params))

    # a stream that is done watches again, its reference refitted on the latest rows
    over = (decision == decide.STOP) | (decision == decide.END)
    refit = lambda d, p, s: watch.refit(self.detector, d, p, s)
    detector = jax.lax.cond(jnp.any(over), refit, lambda d, p, s: d, detector, past, over)
    executed = state.executed + taken
    state = LoopState(
      train, acting, replay, history, detector, phase, past, owed - number, executed, before
    )
    said = (phase.phase, decision, phase.since, executed, failed, *weighed)
    return state, Digest(*seen[:4], settled, *said)
