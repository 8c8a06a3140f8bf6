"""What a chunk of rows says of a stream: residuals of the predictions, alarms, and the six signals
that the stop rule reads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.adapt.act import choose
from mjx_cl.adapt.state import LoopState
from mjx_cl.detectors.base import Detector
from mjx_cl.dreamer.agent import Agent, Record, TrainState
from mjx_cl.rollout.monitor import History, Monitor, Residual
from mjx_cl.rollout.scan import Row
from mjx_cl.types import Spec


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


def watch(
  agent: Agent,
  monitor: Monitor,
  detector: Detector,
  spec: Spec,
  state: LoopState,
  rows: Row,
  keys: jax.Array,
) -> tuple[Watched, History, Any, Residual]:
  """Looks at a chunk.

  Args:
    agent: that predicts.
    monitor: gives residuals.
    detector: gives alarms.
    spec: of the environment.
    state: before the chunk.
    rows: leading (T, groups, 1).
    keys: (groups, 2), of the monitor and of the signals.

  Returns:
    (Watched, the monitor's history, the detector's state, the latest residuals) after the chunk.
  """
  history, residual = monitor.update(state.acting, state.history, rows, keys[:, 0])
  residual = jax.tree.map(lambda x: x[:, :, 0], residual)
  after, alarms = jax.lax.scan(jax.vmap(detector.update), state.detector, residual)
  past = jax.tree.map(lambda a, b: jnp.concatenate([a, b])[-a.shape[0] :], state.past, residual)

  dyn, adv, value = evaluate(agent, state.train, state.history, rows, keys[:, 1])
  reward = jnp.mean(rows.rewards, (0, 2, 3))
  signals = jnp.stack(
    [jnp.nanmean(residual.opr, 0), jnp.nanmean(residual.rpr, 0), reward, dyn, adv, value], -1
  )
  index, _ = spec.posture or (0, -jnp.inf)
  posture = jnp.mean(rows.final_obs[:, :, 0, index], 0)
  return Watched(residual, alarms.score, alarms.fired, signals, posture), history, after, past


def evaluate(
  agent: Agent, train: TrainState, before: History, rows: Row, keys: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
  """Dynamics loss, advantage magnitude and value loss (groups,) on the chunk just lived, without
  gradient.

  The ring of recent data is the chunk itself with the last record before it as context, so an
  alarm leaves nothing old in it.
  """
  # (groups, 1, 1 + T, ...)
  join = lambda old, new: jnp.concatenate([old[-1:].astype(new.dtype), new])[:, :, 0].swapaxes(
    0, 1
  )[:, None]
  deter, stoch = join(before.deter, rows.deter), join(before.stoch, rows.stoch)
  action, obs = join(before.action, rows.action), join(before.obs, rows.obs)
  reward = join(before.reward, rows.reward_in)
  first = join(before.done, rows.first).at[:, :, 0].set(True)
  none = jnp.zeros_like(first)
  batch = Record(
    obs=obs,
    action=action,
    reward=reward,
    first=first,
    last=jnp.concatenate([first[:, :, 1:], none[:, :, :1]], 2),
    terminal=none,
    deter=deter,
    stoch=stoch,
    demo=jnp.zeros_like(action),
    has_demo=none,
  )

  def one(
    train: TrainState, batch: Record, key: jax.Array
  ) -> tuple[jax.Array, jax.Array, jax.Array]:
    metrics = agent.loss(train.params, train.slow, train.range, batch, key)[1][0]
    return metrics["loss/dyn"], metrics["adv_mag"], metrics["loss/value"]

  return jax.vmap(one)(train, batch, keys)


def refit(detector: Detector, state: Any, past: Residual, over: jax.Array) -> Any:
  """`state` of the detector, where `over` (groups,): one that has seen the rows `past` alone."""
  fresh = jax.tree.map(lambda x: jnp.broadcast_to(x, (over.shape[0],) + x.shape), detector.init())
  fresh, _ = jax.lax.scan(jax.vmap(detector.update), fresh, past)
  return choose(over, fresh, state)
