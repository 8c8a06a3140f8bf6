"""What happens to a chunk of rows: residuals, alarms, signals, phase, replay, updates. One jitted
program without callbacks.

Streams are groups of one member: each has its own parameters. A stream that is not adapting costs
no update.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.adapt import arms as arms_lib
from mjx_cl.adapt import phase as phase_lib
from mjx_cl.adapt.convergence import SIGNALS
from mjx_cl.config import AdaptConfig
from mjx_cl.dreamer import replay as replay_lib
from mjx_cl.dreamer.agent import Agent, Batch, TrainState, culprit
from mjx_cl.errors import choose
from mjx_cl.keys import OfAdaptation
from mjx_cl.rollout.monitor import History, Monitor, unknown
from mjx_cl.rollout.scan import records

BEHAVIOUR = {
  "pol",
  "val",
  "slow",
  "range",
}  # of a TrainState: what is no world model, moments under the same names


class Before(NamedTuple):
  """What an adaptation began with, and what that was worth; leading (groups,).

      back  =  aborted  and  mean reward of the last `patience` chunks < mean reward of the chunks
      between the alarm and the first update

  The weights of before the adaptation are still at work while the replay fills (start_windows). The
  two sides are earned at two times: under the same fault where a true alarm began the adaptation;
  but one begun by a false alarm compares a healthy robot with one that may have broken since, which
  favours going back, and so does a fault under which the reward goes on falling. Where an abort
  comes before `patience` chunks have been lived, the mean is over those that have. A stream that is
  aborted before its first update has nothing to take back. Moments, slow critic and range stay
  those of the learner, which takes no other update.

  Attributes:
    params: the parameters that acted when the adaptation began. reward, chunks: float32, sum over
      the chunks that they have lived since, and their number.
    learnt: bool, an update has been taken since.
  """

  params: Any
  reward: jax.Array
  chunks: jax.Array
  learnt: jax.Array


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
  replay: replay_lib.Replay
  history: History
  detector: Any
  phase: phase_lib.PhaseState
  past: Residual
  owed: jax.Array
  executed: jax.Array
  before: Before | None = None


class Digest(NamedTuple):
  """What the host logs of a chunk: rows (T, groups) and values (groups,). `failed`: index into
  agent.CAUSES of what was at fault in an update, which changed nothing and was the stream's last;
  -1: nothing. `back`: bool, an abort put the weights of before the adaptation back; None where no
  arm does. `earned`, `earns`: mean reward a step that was judged by, see Before; None likewise.
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


# Choices.at is padded to a multiple of it: arms with up to eight starts share a program, `periodic`
# too
WIDTH = 8


class Choices(NamedTuple):
  """The arms of a run as arrays, leading (groups,); see arms.Arm.

  Attributes:
    listens: bool, alarms are acted on. at: int32 (groups, K), control steps at which adaptation is
      due, FOREVER: none; K is a multiple of WIDTH.
    rule: bool, stop and abort rules are in force. limit: int32, most control steps of one
      adaptation.
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
  labels, config: AdaptConfig, steps: int, onsets=None, stops: dict[int, int] | None = None
) -> Choices:
  """Choices of streams.

  Args:
    labels: (arm, seed) of each. steps: of the run.
    onsets: true onsets of each robot, unless its arm spares it, as control steps, FOREVER: not
      known yet; None: no faults.
    stops: seed -> control steps after which an arm that is told its oracle stop ends.

  Raises:
    UserError where an arm's schedule does not fit into the run.
  """
  arms = [choose("arm", arm, arms_lib.ARMS) for arm, _ in labels]
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
    min(arm.end.limit(config), stops[seed]) if arm.end.told else arm.end.limit(config)
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


_programs: dict[Hashable, Any] = {}  # see Loop's `same`; the newest last
PROGRAMS = 8  # as many are kept: a compiled program takes memory


class Loop:
  """Monitor, detector, phase machine and learner of a run.

  Args:
    agent: Agent whose config holds the learning rate of adaptation.
    monitor, detector: what watches.
    spec: of the environment (acceptance, posture).
    repeat: control steps per decision.
    capacity: post-alarm records kept per stream.
    same: stands for agent, monitor, detector and spec together; Loops of a process that give an
      equal one share their compiled program. None, or what has no hash: its own.

  The numbers of `config` are arguments of the program, not constants in it: runs that differ in
  budget, ratio, average or rule share one compilation.
  """

  def __init__(
    self,
    agent: Agent,
    monitor: Monitor,
    detector,
    spec,
    config: AdaptConfig,
    repeat: int = 1,
    capacity: int = 20_480,
    same: Hashable | None = None,
  ):
    self.agent, self.monitor, self.detector, self.spec = agent, monitor, detector, spec
    self.config, self.repeat, self.capacity = config, repeat, capacity
    self._program = jax.jit(self._digest, donate_argnums=0)
    if same is not None:
      self._share((same, repeat))

  def _share(self, key) -> None:
    """Takes over the program of an equal Loop of this process, if it is still kept."""
    try:
      self._program = _programs.pop(key, self._program)
    except TypeError:  # a spec of another package that holds a list
      return
    _programs[key] = self._program
    while len(_programs) > PROGRAMS:
      del _programs[next(iter(_programs))]

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
      spread(phase_lib.init(self.config)),
      unknown((rows, groups), a.obs_size),
      jnp.zeros(groups),
      jnp.zeros(groups, jnp.int32),
      Before(spread(train.params), jnp.zeros(groups), jnp.zeros(groups), jnp.zeros(groups, bool))
      if rollback
      else None,
    )
    return jax.tree.map(
      lambda x: jnp.asarray(x, x.dtype) if x.weak_type else x, state
    )  # a weak type would be a second trace, also of a run that goes on

  def digest(
    self, state: LoopState, rows, now, choices: Choices, keys, acceptance=None
  ) -> tuple[LoopState, Digest]:
    """One chunk, jitted; `state` is used up.

    Args:
      rows: rollout.Row, leading (T, groups, 1). now: int32 (), control steps done after the chunk.
        choices: of the streams.
      keys: (groups,), each stream's own, so that what a stream draws does not depend on its
        neighbours.
      acceptance: float32 (groups,), of the robot that each stream has by now, where robots change;
        None: that of `spec`.

    Returns:
      (state', Digest).
    """
    return self._program(state, rows, now, choices, keys, acceptance, self.config)

  def _digest(self, state, rows, now, choices, keys, acceptance, config):
    split = jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, now), 3))(keys)
    key_monitor, key_eval, key_update = split[:, 0], split[:, 1], split[:, 2]
    length = rows.reward.shape[0]
    before = state.history
    history, residual = self.monitor.update(state.acting, state.history, rows, key_monitor)
    residual = jax.tree.map(lambda x: x[:, :, 0], residual)
    detector, alarms = jax.lax.scan(jax.vmap(self.detector.update), state.detector, residual)
    past = jax.tree.map(lambda a, b: jnp.concatenate([a, b])[-a.shape[0] :], state.past, residual)

    dyn, adv, value = self._evaluate(state.train, before, rows, key_eval)
    reward = jnp.mean(rows.rewards, (0, 2, 3))
    signals = jnp.stack(
      [jnp.nanmean(residual.opr, 0), jnp.nanmean(residual.rpr, 0), reward, dyn, adv, value], -1
    )
    index, least_posture = self.spec.posture or (0, -jnp.inf)
    posture = jnp.mean(rows.final_obs[:, :, 0, index], 0)

    known = (
      now - length * self.repeat + (jnp.arange(length) + 1) * self.repeat - 1
    )  # control step at which each row is known
    acted = alarms.fired & (known >= config.warmup)[:, None]
    first = jnp.argmax(acted, 0)
    alarm_step = known[first]
    # a start that is due at step s is known before the step is taken, so that replay begins with
    # its row
    opened = now - length * self.repeat
    falls = (choices.at >= jnp.maximum(opened, config.warmup)) & (choices.at < now)
    due, at = jnp.any(falls, 1), jnp.min(jnp.where(falls, choices.at, now), 1)
    first = jnp.where(due, -((opened - at) // self.repeat) - 1, first)
    alarm_step = jnp.where(due, at, alarm_step)
    if acceptance is None or config.acceptance is not None:
      acceptance = self.spec.acceptance if config.acceptance is None else config.acceptance
    step = lambda *x: phase_lib.update(*x[:-3], config, *x[-3:])
    was = state.phase.phase
    phase, decision, ok = jax.vmap(
      step, (0, 0, 0, 0, 0, None, 0, 0 if jnp.ndim(acceptance) else None, None, 0, 0, 0)
    )(
      state.phase,
      signals,
      posture,
      jnp.any(acted, 0),
      alarm_step,
      now,
      choices.listens,
      acceptance,
      least_posture,
      due,
      choices.rule,
      choices.limit,
    )

    # replay holds what came after the alarm and nothing else
    begins = decision == phase_lib.START
    replay = jax.tree.map(
      lambda a, b: jnp.where(begins.reshape((-1,) + (1,) * (a.ndim - 1)), a, b),
      *self._counts(state.replay),
    )
    keep = jnp.where(
      begins[None], jnp.arange(length)[:, None] > first[None], (was == phase_lib.ADAPTING)[None]
    )
    new, exist = records(rows)
    exist = exist & jnp.repeat(keep.T, 2, axis=1)[:, None]
    replay = jax.vmap(replay_lib.add)(
      state.replay._replace(count=replay[0], queue=replay[1]), new, exist
    )

    c = self.agent.config
    windows = jax.vmap(lambda r: replay_lib.windows(r, c.length + 1))(replay)
    due = (phase.phase == phase_lib.ADAPTING) & (windows >= config.start_windows)
    owed = jnp.where(due, state.owed + length * config.ratio / (c.batch * c.length), 0.0)
    number = jnp.floor(owed + 1e-6).astype(jnp.int32)
    train, acting = state.train, state.acting
    if choices.fresh is not None:
      train, acting = self._renew(train, acting, keys, begins & choices.fresh)
    if config.fresh_moments:
      fresh = jax.vmap(self.agent.optimizer.init)(train.params)
      reset = lambda new, old: jnp.where(begins.reshape((-1,) + (1,) * (old.ndim - 1)), new, old)
      train = train._replace(
        opt=jax.lax.cond(
          jnp.any(begins), lambda o: jax.tree.map(reset, fresh, o), lambda o: o, train.opt
        )
      )
    counted = train.updates
    train, replay, failed = self._learn(train, replay, key_update, number, choices.world_only)
    taken = train.updates - counted

    # a stream whose numbers fail is given up, whatever its phase, and acts on by what it had learnt
    broken = (failed >= 0) | ~jnp.all(jnp.isfinite(signals[:, SIGNALS.index("dyn_loss") :]), 1)
    decision = jnp.where(broken & (was != phase_lib.ABORTED), phase_lib.ABORT_NUMERIC, decision)
    phase = phase._replace(phase=jnp.where(broken, phase_lib.ABORTED, phase.phase))

    # the robot acts by a moving average of what it learns, and keeps it when it is done
    rate = jnp.where(number > 0, config.average, 0.0)
    ended = (was == phase_lib.ADAPTING) & (phase.phase != phase_lib.ADAPTING)
    wide = lambda x, like: x.reshape((-1,) + (1,) * (like.ndim - 1))
    acting = jax.tree.map(lambda a, p: a + wide(rate, a) * (p - a), acting, train.params)
    back = earned = earns = None
    old = state.before
    if old is not None:
      lived = (
        was == phase_lib.ADAPTING
      ) & ~old.learnt  # the chunk just lived is one of the old weights
      reward_sum, chunks = old.reward + jnp.where(lived, reward, 0.0), old.chunks + lived
      earned, earns = reward_sum / chunks, jnp.nanmean(phase.ring[:, :, SIGNALS.index("reward")], 1)
      back = (
        choices.rollback
        & ended
        & (phase.phase == phase_lib.ABORTED)
        & old.learnt
        & (earns < earned)
      )
      acting = jax.tree.map(lambda a, b: jnp.where(wide(back, a), b, a), acting, old.params)
      kept = jax.tree.map(lambda a, b: jnp.where(wide(begins, a), a, b), acting, old.params)
      old = Before(
        kept,
        jnp.where(begins, 0.0, reward_sum),
        jnp.where(begins, 0.0, chunks),
        ~begins & (old.learnt | (taken > 0)),
      )
    train = train._replace(
      params=jax.tree.map(lambda a, p: jnp.where(wide(ended, a), a, p), acting, train.params)
    )

    # a stream that is done watches again, its reference refitted on the latest rows
    over = (decision == phase_lib.STOP) | (decision == phase_lib.END)
    detector = jax.lax.cond(jnp.any(over), self._refit, lambda d, p, s: d, detector, past, over)
    state = LoopState(
      train,
      acting,
      replay,
      history,
      detector,
      phase,
      past,
      owed - number,
      state.executed + taken,
      old,
    )
    return state, Digest(
      residual,
      alarms.score,
      alarms.fired,
      signals,
      ok,
      phase.phase,
      decision,
      phase.since,
      state.executed,
      failed,
      back,
      earned,
      earns,
    )

  @staticmethod
  def _counts(replay):
    return (jnp.zeros_like(replay.count), jnp.zeros_like(replay.queue)), (
      replay.count,
      replay.queue,
    )

  def _evaluate(self, train: TrainState, before: History, rows, keys):
    """Dynamics loss, advantage magnitude and value loss (groups,) on the chunk just lived, without
    gradient.

    The ring of recent data is the chunk itself with the last record before it as context, so an
    alarm leaves nothing old in it.
    """
    join = lambda old, new: jnp.concatenate([old[-1:].astype(new.dtype), new])[:, :, 0].swapaxes(
      0, 1
    )[:, None]  # (groups, 1, 1 + T, ...)
    done = rows.terminated | rows.truncated
    deter, stoch, action = (
      join(before.deter, rows.deter),
      join(before.stoch, rows.stoch),
      join(before.action, rows.action),
    )
    obs, reward, first = (
      join(before.obs, rows.obs),
      join(before.reward, rows.reward_in),
      join(before.done, rows.first),
    )
    first = first.at[:, :, 0].set(True)
    last = jnp.concatenate([first[:, :, 1:], jnp.zeros_like(first[:, :, :1])], 2)
    terminal = jnp.concatenate(
      [jnp.zeros_like(first[:, :, :1]), jnp.zeros_like(done[:, :, 0].T[:, None])], 2
    )
    batch = Batch(
      obs,
      action,
      reward,
      first,
      last,
      terminal,
      deter,
      stoch,
      jnp.zeros_like(action),
      jnp.zeros_like(first),
    )

    def one(train, batch, key):
      metrics = self.agent.loss(train.params, train.slow, train.range, batch, key)[1][0]
      return metrics["loss/dyn"], metrics["adv_mag"], metrics["loss/value"]

    return jax.vmap(one)(train, batch, keys)

  def _renew(self, train: TrainState, acting, keys, fresh):
    """New parameters, moments and counters where `fresh` (groups,). Loops for the reason given in
    `_learn`.
    """

    def stream(g, state):
      def renew(_, state):
        train, acting = state
        new = self.agent.init(jax.random.fold_in(keys[g], OfAdaptation.FRESH))
        return put(train, g, new), put(acting, g, new.params)

      return jax.lax.fori_loop(0, fresh[g].astype(jnp.int32), renew, state)

    return jax.lax.fori_loop(0, fresh.shape[0], stream, (train, acting))

  def _learn(self, train: TrainState, replay, keys, number, world_only):
    """`number` (groups,) updates for each stream. Nested loops with their own trip counts: the
    carry is changed in place, so a stream without an update costs neither arithmetic nor a copy
    (`vmap` would compute all, `lax.map` would copy all). All streams lie in one replay, of which an
    update reads and writes its own windows: taken out of it, a stream's would be copied twice for
    each update.
    """
    c = self.agent.config
    shapes = jax.tree.map(lambda x: x.shape, replay)
    together = jax.tree.map(
      lambda x: x.reshape((-1,) + x.shape[2:]), replay
    )  # (groups, 1, ..) -> (groups, ..)

    def stream(g, state):
      def update(state):
        i, train, replay, _ = state
        key_sample, key_update = jax.random.split(jax.random.fold_in(keys[g], i))
        replay, data, address = replay_lib.sample(replay, key_sample, c.batch, c.length + 1, only=g)
        before = take(train, g)
        learnt, metrics, latents = self.agent.update(before, data, key_update)
        return (
          i + 1,
          put(train, g, keep_behaviour(world_only[g], before, learnt)),
          replay_lib.refresh(replay, address, latents),
          culprit(metrics),
        )

      train, replay, failed = state
      more = lambda state: (state[0] < number[g]) & (state[-1] < 0)
      _, train, replay, bad = jax.lax.while_loop(
        more, update, (jnp.int32(0), train, replay, jnp.int32(-1))
      )
      return train, replay, failed.at[g].set(bad)

    train, together, failed = jax.lax.fori_loop(
      0, number.shape[0], stream, (train, together, jnp.full(number.shape, -1, jnp.int32))
    )
    return (
      train,
      jax.tree.map(
        lambda x, shape: x.reshape(shape),
        together,
        shapes,
        is_leaf=lambda x: isinstance(x, jax.Array),
      ),
      failed,
    )

  def _refit(self, detector, past, stop):
    fresh = jax.tree.map(
      lambda x: jnp.broadcast_to(x, (stop.shape[0],) + x.shape), self.detector.init()
    )
    fresh, _ = jax.lax.scan(jax.vmap(self.detector.update), fresh, past)
    return jax.tree.map(
      lambda a, b: jnp.where(stop.reshape((-1,) + (1,) * (a.ndim - 1)), a, b), fresh, detector
    )


def take(tree, g):
  """Entry g of every leaf."""
  return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, g, keepdims=False), tree)


def put(tree, g, value):
  """`tree` with `value` as entry g of every leaf."""
  return jax.tree.map(lambda x, v: jax.lax.dynamic_update_index_in_dim(x, v, g, 0), tree, value)


def keep_behaviour(keep, before: TrainState, after: TrainState) -> TrainState:
  """`after`, where `keep` (): with actor, critic, slow critic, range of the returns, and the
  moments of actor and critic as `before`.

  Zero gradients alone would not do: momentum moves what has none. The value loss on replay still
  shapes the features, as in every arm.
  """

  def one(path, old, new):
    names = {getattr(part, "key", getattr(part, "name", None)) for part in path}
    return jnp.where(keep, old, new) if names & BEHAVIOUR else new

  return jax.tree_util.tree_map_with_path(one, before, after)
