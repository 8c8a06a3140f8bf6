"""The phase of one stream: nominal --alarm or schedule--> adapting --> converged | aborted | ended.
One call per chunk, every decision has a reason.

AdaptConfig is a pytree here: numbers that only enter arithmetic are leaves, so that a jitted
function which takes it as an argument serves every budget, ratio and rule; fields of STATIC shape
arrays or choose what is computed, and are part of the structure.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.adapt.convergence import SIGNALS, settled
from mjx_cl.config import AdaptConfig

NOMINAL, ADAPTING, CONVERGED, ABORTED, ENDED = range(5)
PHASES = ("nominal", "adapting", "converged", "aborted", "ended")
# decisions of a chunk
NOTHING, START, STOP, ABORT_BELOW, ABORT_HOPELESS, ABORT_BUDGET, END, ABORT_NUMERIC = range(
  8
)  # the last is Loop's own: a loss at fault
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


def _flatten(config: AdaptConfig):
  names = [f.name for f in dataclasses.fields(config)]
  return tuple(getattr(config, n) for n in names if n not in STATIC), tuple(
    getattr(config, n) for n in STATIC
  )


def _unflatten(static, leaves) -> AdaptConfig:
  config = object.__new__(
    AdaptConfig
  )  # traced values can't be checked; those of the config that was flattened have been
  names = [f.name for f in dataclasses.fields(AdaptConfig)]
  for name, value in (*zip(STATIC, static), *zip((n for n in names if n not in STATIC), leaves)):
    object.__setattr__(config, name, value)
  return config


jax.tree_util.register_pytree_node(AdaptConfig, _flatten, _unflatten)


class PhaseState(NamedTuple):
  """Attributes:
  phase: int32 (). since: int32 (), control step of the alarm or of the schedule. ring (patience,
  6), count (): chunk signals since the alarm. best, best_at: float32 (), int32 (): highest reward
  over a patience since the alarm, and when it was reached. mean, square, number: running moments of
  the nominal signals, (6,), (6,), (6,). posture (patience,): mean posture per chunk.
  """

  phase: jax.Array
  since: jax.Array
  ring: jax.Array
  count: jax.Array
  best: jax.Array
  best_at: jax.Array
  mean: jax.Array
  square: jax.Array
  number: jax.Array
  posture: jax.Array


def init(config: AdaptConfig) -> PhaseState:
  """A nominal stream that knows nothing."""
  six = jnp.zeros(len(SIGNALS))
  zero = jnp.int32(0)
  return PhaseState(
    zero,
    zero,
    jnp.full((config.patience, len(SIGNALS)), jnp.nan),
    zero,
    jnp.float32(-jnp.inf),
    zero,
    six,
    six,
    six,
    jnp.zeros(config.patience),
  )


def nominal_std(state: PhaseState) -> jax.Array:
  """Deviation of the nominal chunk signals, (6,)."""
  return jnp.sqrt(jnp.maximum(0.0, state.square / jnp.maximum(1.0, state.number - 1.0)))


def update(
  state: PhaseState,
  signals,
  posture,
  alarm,
  alarm_step,
  now,
  acts,
  acceptance,
  least_posture,
  config: AdaptConfig,
  due=False,
  rule=True,
  limit=None,
  counts=None,
):
  """One chunk.

  Args:
    signals: float32 (6,), means over the chunk in the order of SIGNALS, nan where unknown.
    posture: float32 (), mean posture over the chunk.
    alarm: bool (), an alarm fell in this chunk. alarm_step: int32 (), control step of the alarm, or
      of what was due.
    now: int32 (), control steps done after this chunk.
    acts: bool (), the stream's arm acts on alarms.
    acceptance, least_posture: float32 (), levels of the task.
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
  adapting = state.phase == ADAPTING

  # nominal levels: Welford, until the first adaptation
  learns = (state.phase == NOMINAL) & ~begins & (now > config.warmup) & ~jnp.isnan(signals)
  number = state.number + learns
  delta = jnp.where(learns, signals - state.mean, 0.0)
  mean = state.mean + delta / jnp.maximum(1.0, number)
  square = state.square + delta * jnp.where(learns, signals - mean, 0.0)

  slot = state.count % config.patience
  ring = jnp.where(adapting, state.ring.at[slot].set(signals), state.ring)
  postures = jnp.where(adapting, state.posture.at[slot].set(posture), state.posture)
  count = state.count + adapting
  state = state._replace(
    ring=ring, count=count, posture=postures, mean=mean, square=square, number=number
  )

  age = now - state.since
  ok = settled(ring, count, mean, nominal_std(state), config)
  calm = jnp.all(ok if counts is None else ok | ~counts)
  reward = jnp.nanmean(ring[:, SIGNALS.index("reward")])
  accepted = (reward >= acceptance) & (jnp.mean(postures) >= least_posture)
  full = adapting & (count >= config.patience) & (age >= config.least)
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
    since=jnp.where(begins, alarm_step, state.since).astype(jnp.int32),
    best=jnp.where(begins, -jnp.inf, best),
    best_at=jnp.where(begins, now, best_at).astype(jnp.int32),
    count=jnp.where(begins, 0, state.count).astype(jnp.int32),
    ring=jnp.where(begins, jnp.nan, state.ring),
  )
  return state, decision.astype(jnp.int32), ok
