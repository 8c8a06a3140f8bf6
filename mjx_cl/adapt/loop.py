"""What happens to a chunk of rows of every stream, in one jitted program without callbacks: it is
watched, decided upon and learnt from, and the weights that act next are chosen.

Streams are groups of one member: each has its own parameters. A stream that is not adapting costs
no update.
"""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.adapt import decide, learn, methods, watch
from mjx_cl.adapt.choices import WIDTH, Choices, choices
from mjx_cl.adapt.state import Digest, Frozen, LoopState
from mjx_cl.adapt.trees import choose
from mjx_cl.adapt.watch import Minds, Sight, Watched
from mjx_cl.config import AdaptConfig
from mjx_cl.detectors.base import Detector
from mjx_cl.dreamer import replay as replay_lib
from mjx_cl.dreamer.agent import Agent, TrainState
from mjx_cl.rollout.monitor import Monitor, unknown
from mjx_cl.rollout.scan import Row
from mjx_cl.types import Spec

__all__ = ["WIDTH", "Choices", "Digest", "Loop", "LoopState", "Once", "Programs", "choices"]


class Programs:
  """Robots, rollouts and compiled programs, for runs of one process that follow each other.

  Args:
    most: as many are kept, the newest: a compiled program takes memory.
  """

  def __init__(self, most: int = 16) -> None:
    self.most = most
    self.kept: dict[Hashable, Any] = {}  # the newest last

  def share(self, key: Hashable, make: Callable[[], Any]) -> Any:
    """What is kept under `key`, else what `make` gives, which is kept from now on."""
    try:
      program = self.kept.pop(key) if key in self.kept else make()
    except TypeError:  # the key holds a list, such as the spec of another package may
      return make()
    self.kept[key] = program
    while len(self.kept) > self.most:
      del self.kept[next(iter(self.kept))]
    return program


class Once:
  """A jitted function that threads may call at the same time: the first call, which compiles, is
  made alone.

  Attributes:
    seconds: that calls have waited for compiling.
  """

  def __init__(self, function: Callable[..., Any]) -> None:
    self.function, self.seconds = function, 0.0
    self._lock, self._warm = threading.Lock(), False

  def __call__(self, *args: Any) -> Any:
    """What the function gives."""
    if self._warm:
      return self.function(*args)
    begin = time.perf_counter()
    out = self.warm(*args)
    self.seconds += time.perf_counter() - begin
    return out

  def warm(self, *args: Any) -> Any:
    """Likewise; time that goes by counts as nobody's."""
    with self._lock:
      out = self.function(*args)
      self._warm = True
    return out


class Jitted(NamedTuple):
  """The programs of a Loop.

  Attributes:
    watch: of every stream, see Loop.watch.
    rest: of streams that have not begun to learn.
    learn: of those that have.
  """

  watch: Once
  rest: Once
  learn: Once


def strong(tree: Any) -> Any:
  """Without weak types: those would be a second trace, also of a run that goes on."""
  return jax.tree.map(lambda x: jnp.asarray(x, x.dtype) if x.weak_type else x, tree)


def _split(keys: jax.Array, now: jax.Array) -> jax.Array:
  """Keys (groups, 3) of a chunk: of the monitor, the signals and the updates."""
  return jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, now), 3))(keys)


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
    own = lambda: Jitted(
      Once(jax.jit(self._watch)),
      Once(jax.jit(self._rest)),
      Once(jax.jit(self._learn, donate_argnums=0)),
    )
    shared = same is not None and programs is not None
    self.programs = programs.share((same, repeat), own) if shared and programs else own()

  def init(
    self,
    train: TrainState,
    groups: int,
    own: tuple[methods.Method, ...] = (methods.PAPER,),
  ) -> LoopState:
    """State before the first step.

    Args:
      train: the shipped agent, the same for every stream.
      groups: streams.
      own: methods of the run, as in Choices.
    """
    a = self.agent
    copies = lambda x: jnp.broadcast_to(x, (groups,) + x.shape).copy()
    spread = lambda tree: jax.tree.map(lambda x: copies(jnp.asarray(x)), tree)
    shapes = jax.eval_shape(
      lambda: replay_lib.init(1, self.capacity, a.obs_size, a.act_size, a.size.deter, a.size.stoch)
    )
    none = lambda: jnp.zeros(groups)
    params = lambda: spread(train.params)
    state = LoopState(
      train=spread(train),
      acting=params(),
      # empty: all zeros; a copy of one would be held twice for a while
      replay=jax.tree.map(lambda x: jnp.zeros((groups,) + x.shape, x.dtype), shapes),
      history=self.monitor.init(groups, 1),
      detector=spread(self.detector.init()),
      phase=spread(decide.init(self.config)),
      past=unknown(
        (max(1, self.config.refit // self.repeat), groups), a.obs_size, self.monitor.signed
      ),
      owed=none(),
      executed=jnp.zeros(groups, jnp.int32),
      memory=tuple(jax.vmap(functools.partial(methods.remember, m))(params()) for m in own),
    )
    return strong(state)

  def frozen(self) -> Frozen:
    """A life before its first step."""
    sight = Sight(
      self.monitor.init(1, 1),
      jax.tree.map(lambda x: jnp.asarray(x)[None], self.detector.init()),
      unknown(
        (max(1, self.config.refit // self.repeat), 1), self.agent.obs_size, self.monitor.signed
      ),
    )
    phase = jax.tree.map(lambda x: jnp.asarray(x)[None], decide.init(self.config))
    return strong(Frozen(sight, phase))

  def watch(
    self, minds: Minds, sight: Sight, rows: Row, now: jax.Array, keys: jax.Array
  ) -> tuple[Watched, Sight]:
    """What a chunk says, jitted; arguments as of `digest`."""
    return self.programs.watch(minds, sight, rows, now, keys)

  def rest(
    self, phase: decide.PhaseState, seen: Watched, now: jax.Array
  ) -> tuple[decide.PhaseState, Digest]:
    """A chunk of streams that begin no adaptation and have begun none, jitted."""
    return self.programs.rest(phase, seen, now, self.config)

  def learn(
    self,
    state: LoopState,
    seen: Watched,
    sight: Sight,
    rows: Row,
    now: jax.Array,
    choices: Choices,
    keys: jax.Array,
    acceptance: jax.Array | None = None,
  ) -> tuple[LoopState, Digest]:
    """What follows from a chunk that has been watched, jitted; arguments as of `digest`."""
    state = state._replace(**sight._asdict())
    return self.programs.learn(state, seen, rows, now, choices, keys, acceptance, self.config)

  def digest(
    self,
    state: LoopState,
    rows: Row,
    now: jax.Array,
    choices: Choices,
    keys: jax.Array,
    acceptance: jax.Array | None = None,
  ) -> tuple[LoopState, Digest]:
    """One chunk, watched and learnt from; `state` is used up.

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
    seen, sight = self.watch(state.minds, state.sight, rows, now, keys)
    return self.learn(state, seen, sight, rows, now, choices, keys, acceptance)

  def _watch(
    self, minds: Minds, sight: Sight, rows: Row, now: jax.Array, keys: jax.Array
  ) -> tuple[Watched, Sight]:
    split = _split(keys, now)[:, :2]
    return watch.watch(
      self.agent, self.monitor, self.detector, self.spec, minds, sight, rows, split
    )

  def _rest(
    self, phase: decide.PhaseState, seen: Watched, now: jax.Array, config: AdaptConfig
  ) -> tuple[decide.PhaseState, Digest]:
    was = phase.phase
    phase = jax.vmap(decide.rest, (0, 0, None, None))(phase, seen.signals, now, config)
    failed = jnp.full_like(was, -1)
    phase, decision = decide.give_up(phase, jnp.zeros_like(was), was, failed, seen.signals)
    unsettled = jnp.zeros(seen.signals.shape, bool)
    none = jnp.zeros_like(was)
    return phase, Digest(*seen[:4], unsettled, phase.phase, decision, phase.since, none, failed)

  def _learn(
    self,
    state: LoopState,
    seen: Watched,
    rows: Row,
    now: jax.Array,
    choices: Choices,
    keys: jax.Array,
    acceptance: jax.Array | float | None,
    config: AdaptConfig,
  ) -> tuple[LoopState, Digest]:
    agent, was = self.agent, state.phase.phase
    draws = _split(keys, now)[:, 2]
    begin = decide.starts(seen.fired, choices.at, now, self.repeat, config)
    if acceptance is None or config.acceptance is not None:
      acceptance = self.spec.acceptance if config.acceptance is None else config.acceptance
    _, least = self.spec.posture or (0, -jnp.inf)
    setting = lambda name: choices.settings.get(name, getattr(config, name))
    acceptance = decide.regained(state.phase, acceptance, setting("regain"))
    signals, posture = seen.signals, seen.posture
    own = choices.methods.all
    for i, (method, memory) in enumerate(zip(own, state.memory)):
      if method.hides is not None:  # the rule judges what learns
        others = (choices.method == i) & jax.vmap(method.hides)(memory) & (was == decide.ADAPTING)
        signals = jnp.where(others[:, None], jnp.nan, signals)
        posture = jnp.where(others, jnp.nan, posture)
    phase, decision, settled = decide.decide(
      state.phase, signals, posture, begin, now, choices, acceptance, least, config
    )
    begins = decision == decide.START

    replay = learn.fill(state.replay, rows, begins, begin.row, was == decide.ADAPTING)
    length, adapting = rows.reward.shape[0], phase.phase == decide.ADAPTING
    enough = setting("start_windows")
    # a method's memory is of this adaptation from the next chunk on
    due = adapting & ~begins
    owed = learn.owing(agent, replay, due, state.owed, length, config.ratio, enough)
    if not all(method.learns for method in own):
      owed = jnp.where(jnp.array([m.learns for m in own])[choices.method], owed, 0.0)
    number = jnp.floor(owed + 1e-6).astype(jnp.int32)
    train, acting = learn.begin(agent, state, keys, begins, choices.fresh, config.fresh_moments)
    counted = train.updates
    train, replay, failed = learn.learn(
      agent, train, replay, draws, number, own, choices.method, state.memory
    )
    taken = train.updates - counted
    phase, decision = decide.give_up(phase, decision, was, failed, seen.signals)

    over = (was == decide.ADAPTING) & (phase.phase != decide.ADAPTING)
    view = methods.View(
      was,
      phase.phase,
      begins,
      over,
      seen.signals[:, decide.SIGNALS.index("reward")],
      jnp.nanmean(phase.ring[:, :, decide.SIGNALS.index("reward")], 1),
      seen.signals,
      taken,
      jnp.where(number > 0, setting("average"), 0.0),
      acting,
      train.params,
    )
    acting, learner, memory, weighed = _act(own, choices.method, state.memory, view, state.acting)
    # the robot keeps what it acts by when it is done
    train = train._replace(params=choose(over, learner, train.params))
    # a stream that is done watches again, its reference refitted on the latest rows
    done = (decision == decide.STOP) | (decision == decide.END)
    refit = lambda d, p, s: watch.refit(self.detector, d, p, s)
    detector = jax.lax.cond(
      jnp.any(done), refit, lambda d, p, s: d, state.detector, state.past, done
    )
    executed = state.executed + taken
    state = state._replace(
      train=train,
      acting=acting,
      replay=replay,
      detector=detector,
      phase=phase,
      owed=owed - number,
      executed=executed,
      memory=memory,
    )
    said = (phase.phase, decision, phase.since, executed, failed, *weighed)
    return state, Digest(*seen[:4], settled, *said)


def _act(
  own: tuple[methods.Method, ...],
  which: jax.Array,
  memory: tuple[Any, ...],
  view: methods.View,
  acted: Any,
) -> tuple[Any, Any, tuple[Any, ...], tuple[jax.Array, ...]]:
  """What acts in the chunk to come by each stream's method, what a learner that is done goes on
  from, the memories of all, and what was weighed where a method of the run weighs; leading
  (groups,). Until its first adaptation begins a stream acts on by what `acted` in the chunk, and a
  memory is what that gives.
  """
  first = view.begins & (view.was == decide.NOMINAL)
  begun = view.begins | (view.was != decide.NOMINAL)
  none = jnp.full(begun.shape, jnp.nan, jnp.float32)
  chosen: Any = methods.Acts(view.acted, (), jnp.zeros(begun.shape, bool), none, none, view.learner)
  memories = []
  for i, (method, kept) in enumerate(zip(own, memory)):
    act = lambda memory, view, method=method: _whole(method.act(memory, view))
    kept = choose(first, jax.vmap(functools.partial(methods.remember, method))(acted), kept)
    said = jax.vmap(act)(kept, view)
    same = lambda new, old: jnp.asarray(new, old.dtype)
    memories.append(choose(begun, jax.tree.map(same, said.memory, kept), kept))
    learner = said.params if said.learner is None else said.learner
    said = said._replace(memory=(), learner=learner)
    chosen = choose(begun & (which == i), said, chosen)
  weighed = (chosen.back, chosen.earned, chosen.earns)
  weighs = any(method.weighs for method in own)
  return chosen.params, chosen.learner, tuple(memories), weighed if weighs else ()


def _whole(acts: methods.Acts) -> methods.Acts:
  """With arrays in place of the defaults."""
  return acts._replace(
    back=jnp.asarray(acts.back, bool),
    earned=jnp.asarray(acts.earned, jnp.float32),
    earns=jnp.asarray(acts.earns, jnp.float32),
  )
