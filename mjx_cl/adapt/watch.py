"""What a chunk of rows says of a stream: residuals of the predictions, alarms, and the six signals
that the stop rule reads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.adapt.trees import choose
from mjx_cl.detectors.base import Detector, anew
from mjx_cl.dreamer.agent import Agent
from mjx_cl.rollout.monitor import History, Monitor, Residual
from mjx_cl.rollout.scan import Row
from mjx_cl.types import Spec

STARTS = 16  # states of a chunk that the signals of actor and critic are imagined from


class Watched(NamedTuple):
  """What was seen in a chunk.

  Attributes:
    residual: Residual, leading (T, groups).
    score: float32 (T, groups), of the detector.
    fired: bool (T, groups), alarms.
    signals: float32 (groups, 6), in the order of decide.SIGNALS.
    posture: float32 (groups,), mean posture.
  """

  residual: Residual
  score: jax.Array
  fired: jax.Array
  signals: jax.Array
  posture: jax.Array


class Sight(NamedTuple):
  """What watching remembers from chunk to chunk.

  Attributes:
    history: of the monitor, leading (n - 1, groups, 1).
    detector: state of the detector, leading (groups,).
    past: Residual of the last `refit` rows, leading (refit, groups).
  """

  history: History
  detector: Any
  past: Residual


class Minds(NamedTuple):
  """Which weights predict and judge, leading (groups,).

  Attributes:
    params: that act.
    slow: of the slow critic.
    range: float32 (groups, 2), see TrainState.
  """

  params: Any
  slow: Any
  range: jax.Array


def watch(
  agent: Agent,
  monitor: Monitor,
  detector: Detector,
  spec: Spec,
  minds: Minds,
  sight: Sight,
  rows: Row,
  keys: jax.Array,
) -> tuple[Watched, Sight]:
  """Looks at a chunk.

  Args:
    agent: that predicts.
    monitor: gives residuals.
    detector: gives alarms.
    spec: of the environment.
    minds: weights.
    sight: before the chunk.
    rows: leading (T, groups, 1).
    keys: (groups, 2), of the monitor and of the signals.

  Returns:
    (Watched, sight') after the chunk.
  """
  history, residual = monitor.update(minds.params, sight.history, rows, keys[:, 0])
  residual = jax.tree.map(lambda x: x[:, :, 0], residual)
  after, alarms = jax.lax.scan(jax.vmap(detector.update), sight.detector, residual)
  past = jax.tree.map(lambda a, b: jnp.concatenate([a, b])[-a.shape[0] :], sight.past, residual)

  dyn = jnp.mean(jnp.maximum(agent.config.free_nats, residual.surprise), 0)
  adv, value = evaluate(agent, minds, rows, keys[:, 1])
  reward = jnp.mean(rows.rewards, (0, 2, 3))
  signals = jnp.stack(
    [jnp.nanmean(residual.opr, 0), jnp.nanmean(residual.rpr, 0), reward, dyn, adv, value], -1
  )
  index, _ = spec.posture or (0, -jnp.inf)
  posture = jnp.mean(rows.final_obs[:, :, 0, index], 0)
  seen = Watched(residual, alarms.score, alarms.fired, signals, posture)
  return seen, Sight(history, after, past)


def evaluate(agent: Agent, minds: Minds, rows: Row, keys: jax.Array) -> tuple[jax.Array, jax.Array]:
  """Advantage magnitude and value loss (groups,) of what the robot acts by, without gradient.

  Imagined from STARTS states of the chunk, evenly spaced, whose posterior latents acting has found
  already.
  """
  length = rows.reward.shape[0]
  at = jnp.arange(max(1, length // STARTS) - 1, length, max(1, length // STARTS))

  def one(
    minds: Minds, deter: jax.Array, stoch: jax.Array, key: jax.Array
  ) -> tuple[jax.Array, jax.Array]:
    dreamt = agent.judge(*minds, deter, agent.hot(stoch), key)
    return dreamt.metrics["adv_mag"], dreamt.value

  return jax.vmap(one, (0, 1, 1, 0))(minds, rows.deter[at, :, 0], rows.stoch[at, :, 0], keys)


def refit(detector: Detector, state: Any, past: Residual, over: jax.Array) -> Any:
  """`state` of the detector, where `over` (groups,): one that has seen the rows `past` alone."""
  spread = lambda x: jnp.broadcast_to(x, (over.shape[0],) + jnp.shape(x))
  fresh = jax.tree.map(spread, anew(detector)())
  fresh, _ = jax.lax.scan(jax.vmap(detector.update), fresh, past)
  return choose(over, fresh, state)
