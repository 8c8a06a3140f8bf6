"""When a stream adapts and when it is done: the phase machine of one stream and its stop rule.

  nominal --alarm or schedule--> adapting --> converged | aborted | ended

One call per chunk; every decision has a reason. AdaptConfig is a pytree here: numbers that only
enter arithmetic are leaves, so that a jitted function which takes it as an argument serves every
budget, ratio and rule; fields of STATIC shape arrays or choose what is computed, and are part of
the structure.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.adapt.choices import Choices
from mjx_cl.adapt.phases import ABORTED, ADAPTING, CONVERGED, ENDED, NOMINAL
from mjx_cl.adapt.settling import SIGNALS, settled
from mjx_cl.config import AdaptConfig

# decisions of a chunk; the last is taken of numbers that fail, see `give_up`
NOTHING, START, STOP, ABORT_BELOW, ABORT_HOPELESS, ABORT_BUDGET, END, ABORT_NUMERIC = range(8)
DECISIONS = (
  "nothing",
  "start",
  "stop",
  "abort_below",
  "abort_hopeless",
  "abort_budget",
  "end",
  "abort_numeric",
)
REASONS = (
  "",
  "alarm",
  "all six signals settled, task acceptable",
  "settled below acceptance",
  "no settling in sight",
  "budget spent",
  "fixed number of steps over",
  "numeric failure",
)

STATIC = ("patience", "refit", "fresh_moments")


LEAVES = tuple(f.name for f in dataclasses.fields(AdaptConfig) if f.name not in STATIC)


def _flatten(config: AdaptConfig) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
  values = vars(config)
  return tuple(values[name] for name in LEAVES), tuple(values[name] for name in STATIC)


def _unflatten(static: tuple[Any, ...], leaves: Iterable[Any]) -> AdaptConfig:
  # traced values can't be checked; those of the config that was flattened have been
  config = object.__new__(AdaptConfig)
  vars(config).update(zip((*STATIC, *LEAVES), (*static, *leaves)))
  return config


jax.tree_util.register_pytree_node(AdaptConfig, _flatten, _unflatten)


class PhaseState(NamedTuple):
  """What the phase machine remembers of one stream.

  Attributes:
    phase: int32 ().
    since: int32 (), control step of the alarm or of the schedule.
    ring: float32 (patience, 6), chunk signals since the alarm.
    count: int32 (), rows of `ring` ever written.
    best: float32 (), highest reward over a patience since the alarm.
    best_at: int32 (), control step at which that was reached.
    mean: float32 (6,), running mean of the nominal signals.
    square: float32 (6,), sum of their squared deviations.
    number: float32 (6,), how many they are.
    posture: float32 (patience,), mean posture per chunk.
  """

  phase: jax.Array
  since: jax.Array
  ring: jax.Array
  count: jax.Array  # type: ignore[assignment]
  best: jax.Array
  best_at: jax.Array
  mean: jax.Array
  square: jax.Array
  number: jax.Array
  posture: jax.Array


class Starts(NamedTuple):
  """What may begin an adaptation in a chunk, leading (groups,).

  Attributes:
    alarm: bool, an alarm after the warm-up.
    due: bool, a start of the arm's schedule.
    step: int32, control step of what is due, else of the first alarm.
    row: int32, row of the chunk after which replay begins; -1: before the first.
  """

  alarm: jax.Array
  due: jax.Array
  step: jax.Array
  row: jax.Array


def starts(
  fired: jax.Array, at: jax.Array, now: jax.Array, repeat: int, config: AdaptConfig
) -> Starts:
  """What begins in the chunk that ends with control step `now`.

  Args:
    fired: bool (T, groups), alarms of its rows.
    at: int32 (groups, K), control steps at which adaptation is due.
    now: int32 ().
    repeat: control steps of a row.
    config: AdaptConfig.
  """
  length = fired.shape[0]
  # control step at which each row is known
  known = now - length * repeat + (jnp.arange(length) + 1) * repeat - 1
  acted = fired & (known >= config.warmup)[:, None]
  first = jnp.argmax(acted, 0)
  alarm_step = known[first]
  # a start that is due at step s is known before the step is taken, so that replay begins with
  # its row
  opened = now - length * repeat
  falls = (at >= jnp.maximum(opened, config.warmup)) & (at < now)
  due, earliest = jnp.any(falls, 1), jnp.min(jnp.where(falls, at, now), 1)
  row = jnp.where(due, -((opened - earliest) // repeat) - 1, first)
  return Starts(jnp.any(acted, 0), due, jnp.where(due, earliest, alarm_step), row)


def decide(
  state: PhaseState,
  signals: jax.Array,
  posture: jax.Array,
  begin: Starts,
  now: jax.Array,
  choices: Choices,
  acceptance: jax.Array | float,
  least_posture: float,
  config: AdaptConfig,
) -> tuple[PhaseState, jax.Array, jax.Array]:
  """`update` of every stream, leading (groups,); acceptance: () or (groups,)."""
  level = 0 if jnp.ndim(acceptance) else None
  axes = (0, 0, 0, 0, 0, None, 0, level, None, None, 0, 0, 0)
  return jax.vmap(update, axes)(
    state,
    signals,
    posture,
    begin.alarm,
    begin.step,
    now,
    choices.listens,
    acceptance,
    least_posture,
    config,
    begin.due,
    choices.rule,
    choices.limit,
  )


def regained(
  state: PhaseState, acceptance: jax.Array | float, regain: jax.Array | float
) -> jax.Array:
  """What the mean reward must reach before an adaptation may converge, float32 (groups,).

    max(acceptance, m - (1 - regain) |m|),  m = mean reward before the first adaptation
    acceptance                              where regain = 0, or m is not known

  Args:
    state: of the streams, leading (groups,).
    acceptance: float32 () or (groups,), level of the task.
    regain: float32 () or (groups,), in [0, 1].
  """
  k = SIGNALS.index("reward")
  before, known = state.mean[:, k], state.number[:, k] > 0
  level = before - (1.0 - regain) * jnp.abs(before)
  return jnp.maximum(acceptance, jnp.where((regain > 0) & known, level, -jnp.inf))


def give_up(
  phase: PhaseState, decision: jax.Array, was: jax.Array, failed: jax.Array, signals: jax.Array
) -> tuple[PhaseState, jax.Array]:
  """A stream whose numbers fail is given up, whatever its phase, and acts on by what it had learnt.

  Args:
    phase: after the chunk.
    decision: int32 (groups,), of the chunk.
    was: int32 (groups,), phases before it.
    failed: int32 (groups,), see Digest.
    signals: float32 (groups, 6).

  Returns:
    (phase', decision').
  """
  broken = (failed >= 0) | ~jnp.all(jnp.isfinite(signals[:, SIGNALS.index("dyn_loss") :]), 1)
  decision = jnp.where(broken & (was != ABORTED), ABORT_NUMERIC, decision)
  return phase._replace(phase=jnp.where(broken, ABORTED, phase.phase)), decision


def init(config: AdaptConfig) -> PhaseState:
  """A nominal stream that knows nothing."""
  six = jnp.zeros(len(SIGNALS))
  return PhaseState(
    phase=jnp.int32(NOMINAL),
    since=jnp.int32(0),
    ring=jnp.full((config.patience, len(SIGNALS)), jnp.nan),
    count=jnp.int32(0),
    best=jnp.float32(-jnp.inf),
    best_at=jnp.int32(0),
    mean=six,
    square=six,
    number=six,
    posture=jnp.zeros(config.patience),
  )


def nominal_std(state: PhaseState) -> jax.Array:
  """Deviation of the nominal chunk signals, (6,)."""
  return jnp.sqrt(jnp.maximum(0.0, state.square / jnp.maximum(1.0, state.number - 1.0)))


def update(
  state: PhaseState,
  signals: jax.Array,
  posture: jax.Array,
  alarm: jax.Array,
  alarm_step: jax.Array | int,
  now: jax.Array | int,
  acts: jax.Array | bool,
  acceptance: jax.Array | float,
  least_posture: jax.Array | float,
  config: AdaptConfig,
  due: jax.Array | bool = False,
  rule: jax.Array | bool = True,
  limit: jax.Array | int | None = None,
  counts: jax.Array | None = None,
) -> tuple[PhaseState, jax.Array, jax.Array]:
  """One chunk of one stream.

  Args:
    state: before the chunk.
    signals: float32 (6,), means over the chunk in the order of SIGNALS, nan where unknown.
    posture: float32 (), mean posture over the chunk.
    alarm: bool (), an alarm fell in this chunk.
    alarm_step: int32 (), control step of the alarm, or of what was due.
    now: int32 (), control steps done after this chunk.
    acts: bool (), the stream's arm acts on alarms.
    acceptance: float32 (), level of the task.
    least_posture: float32 (), level of the task.
    config: AdaptConfig.
    due: bool (), a start of the arm's schedule fell in this chunk.
    rule: bool (), the stop and abort rules are in force; without them adaptation ends after `limit`
      alone, as `ended`.
    limit: int32 (), most control steps of adaptation, None: config.budget.
    counts: bool (6,), signals that must have settled, None: all.

  Returns:
    (state', decision int32 (), settled bool (6,)).
  """
  limit = config.budget if limit is None else limit
  watching = (state.phase == NOMINAL) | (state.phase == CONVERGED) | (state.phase == ENDED)
  begins = watching & ((alarm & acts) | due) & (now > config.warmup)
  state = _remember(state, signals, posture, begins, now, config)
  ok = settled(state.ring, state.count, state.mean, nominal_std(state), config)
  calm = jnp.all(ok if counts is None else ok | ~counts)
  state, decision = _judge(state, begins, calm, now, acceptance, least_posture, rule, limit, config)
  since = jnp.where(begins, alarm_step, state.since).astype(jnp.int32)
  return state._replace(since=since), decision, ok


def rest(
  state: PhaseState, signals: jax.Array, now: jax.Array | int, config: AdaptConfig
) -> PhaseState:
  """One chunk of one stream that has begun no adaptation and begins none; arguments as of
  `update`.
  """
  return _remember(state, signals, state.posture[0], jnp.bool_(False), now, config)


def _remember(
  state: PhaseState,
  signals: jax.Array,
  posture: jax.Array,
  begins: jax.Array,
  now: jax.Array | int,
  config: AdaptConfig,
) -> PhaseState:
  """The nominal levels (Welford) until the first adaptation, the ring while adapting."""
  adapting = state.phase == ADAPTING
  learns = (state.phase == NOMINAL) & ~begins & (now > config.warmup) & ~jnp.isnan(signals)
  number = state.number + learns
  delta = jnp.where(learns, signals - state.mean, 0.0)
  mean = state.mean + delta / jnp.maximum(1.0, number)
  square = state.square + delta * jnp.where(learns, signals - mean, 0.0)

  slot = state.count % config.patience
  ring = jnp.where(adapting, state.ring.at[slot].set(signals), state.ring)
  postures = jnp.where(adapting, state.posture.at[slot].set(posture), state.posture)
  count = state.count + adapting
  return state._replace(
    ring=ring, count=count, posture=postures, mean=mean, square=square, number=number
  )


def _judge(
  state: PhaseState,
  begins: jax.Array,
  calm: jax.Array,
  now: jax.Array | int,
  acceptance: jax.Array | float,
  least_posture: jax.Array | float,
  rule: jax.Array | bool,
  limit: jax.Array | int,
  config: AdaptConfig,
) -> tuple[PhaseState, jax.Array]:
  """The decision of a chunk that is remembered already, and the phase that follows it.

  begins: bool (), an adaptation begins; calm: bool (), all signals that count have settled.
  """
  adapting = state.phase == ADAPTING
  age = now - state.since
  reward = jnp.nanmean(state.ring[:, SIGNALS.index("reward")])
  accepted = (reward >= acceptance) & (jnp.nanmean(state.posture) >= least_posture)
  full = adapting & (state.count >= config.patience) & (age >= config.least)
  # progress: the reward over the patience has not risen by 5 % of |acceptance| above its best for a
  # third of `give_up`
  better = full & (reward > state.best + 0.05 * jnp.abs(acceptance))
  best = jnp.where(better, reward, state.best)
  best_at = jnp.where(better, now, state.best_at)
  stuck = (
    full
    & (age >= config.give_up)
    & (now - best_at >= config.give_up // 3)
    & (~accepted | (age >= 5 * config.give_up // 4))
    & rule
  )

  stop = full & calm & accepted & rule
  below = calm & ~accepted & stuck
  hopeless = stuck & ~below & ~stop
  spent = adapting & (age >= limit) & ~stop & ~stuck
  end = spent & ~rule
  decision = jnp.select(
    [begins, stop, below, hopeless, end, spent],
    [START, STOP, ABORT_BELOW, ABORT_HOPELESS, END, ABORT_BUDGET],
    NOTHING,
  )
  phase = jnp.select(
    [begins, stop, end, below | hopeless | spent],
    [ADAPTING, CONVERGED, ENDED, ABORTED],
    state.phase,
  )
  state = state._replace(
    phase=phase.astype(jnp.int32),
    best=jnp.where(begins, -jnp.inf, best),
    best_at=jnp.where(begins, now, best_at).astype(jnp.int32),
    count=jnp.where(begins, 0, state.count).astype(jnp.int32),
    ring=jnp.where(begins, jnp.nan, state.ring),
  )
  return state, decision.astype(jnp.int32)
