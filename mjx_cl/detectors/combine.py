"""Combinators: a detector of a channel, the union of several."""
from __future__ import annotations

import jax
import jax.numpy as jnp

from mjx_cl.detectors.base import Alarm, Detector


def on(channel: str, detector: Detector) -> Detector:
  """A single-residual detector on one field (`opr` or `rpr`) of monitor.Residual. An invalid row leaves its state unchanged."""
  def update(state, residual):
    x = jnp.where(residual.valid, getattr(residual, channel), 0.0)
    new, alarm = detector.update(state, x)
    state = jax.tree.map(lambda a, b: jnp.where(residual.valid, a, b), new, state)
    return state, Alarm(alarm.fired & residual.valid, jnp.where(residual.valid, alarm.score, jnp.nan))
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
