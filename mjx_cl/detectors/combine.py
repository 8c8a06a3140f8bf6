"""Combinators: a detector of a channel, the union of several."""
from __future__ import annotations

import jax
import jax.numpy as jnp

from mjx_cl.detectors.base import Alarm, Detector
from mjx_cl.errors import UserError

CHANNELS = ("opr", "rpr", "reward", "surprise") + tuple(f"group_{k}" for k in range(8))


def read(channel: str, residual) -> jax.Array:
  """One number of a monitor.Residual: `opr`, `rpr`, `reward`, `surprise`, or `group_0` .. `group_7`. Unknown values are nan."""
  if channel.startswith("group_"):
    return residual.groups[int(channel[6:])]
  return getattr(residual, channel)


def on(channel: str, detector: Detector, log: bool = False) -> Detector:
  """A single-residual detector on one channel of monitor.Residual. A sample that is invalid or no finite number leaves its
  state unchanged.

  Args:
    log: ln max(x, 1e-9) in place of x; residuals are positive and skewed.
  """
  if channel not in CHANNELS:
    raise UserError(f"unknown channel {channel!r}; choose from: {', '.join(CHANNELS)}")

  def update(state, residual):
    x = read(channel, residual)
    valid = jnp.isfinite(x) & (residual.valid | (channel in ("reward", "surprise")))
    x = jnp.where(valid, x, 0.0)
    new, alarm = detector.update(state, jnp.log(jnp.maximum(x, 1e-9)) if log else x)
    state = jax.tree.map(lambda a, b: jnp.where(valid, a, b), new, state)
    return state, Alarm(alarm.fired & valid, jnp.where(valid, alarm.score, jnp.nan))
  return Detector(detector.init, update)


def any_of(*detectors: Detector) -> Detector:
  """Fires when any member fires; score = the largest of the members' scores that are known."""
  def update(states, x):
    out = [d.update(s, x) for d, s in zip(detectors, states)]
    fired = jnp.any(jnp.stack([alarm.fired for _, alarm in out]))
    scores = jnp.stack([alarm.score for _, alarm in out])
    known = jnp.where(jnp.isnan(scores), -jnp.inf, scores).max()
    return tuple(state for state, _ in out), Alarm(fired, jnp.where(jnp.all(jnp.isnan(scores)), jnp.nan, known))
  return Detector(lambda: tuple(d.init() for d in detectors), update)
