"""Detectors that look at nothing: what every score is printed beside."""
from __future__ import annotations

import math
from typing import Callable, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.detectors.base import Alarm, Detector, above, demand


def reference(factory: Callable[..., Detector]) -> Callable[..., Detector]:
  """Marks a factory as a reference: no contract that asks for a detection holds for it."""
  factory.takes, factory.reference = "residual", True
  return factory


def _constant(fires: bool) -> Detector:
  """Fires at every known row or at none; score 1 or 0."""
  def update(state, residual):
    return state, Alarm(residual.valid & fires, jnp.where(residual.valid, float(fires), jnp.nan).astype(jnp.float32))
  return Detector(lambda: jnp.int32(0), update)


@reference
def never() -> Detector:
  """Never fires; score 0. The floor of every delay and miss figure, the ceiling of every false-alarm figure.

  Printed beside every score because a score that `never` also reaches was not earned by detection: with few faults in a long stream, precision,
  false alarms per hour and return of an agent that needs no help all look fine. No threshold: it is not calibrated, its ARL0 is infinite.
  Blind to: everything.
  Example: _, out = jax.lax.scan(det.update, det.init(), residuals)
  """
  return _constant(False)


@reference
def always() -> Detector:
  """Fires at every known row; score 1. Latency 0 and no miss, at an ARL0 of one step.

  Printed beside every score because a delay without its false alarms is won by this detector. No threshold: it is not calibrated.
  Blind to: everything.
  Example: _, out = jax.lax.scan(det.update, det.init(), residuals)
  """
  return _constant(True)


class PeriodicState(NamedTuple):
  """Attributes: count: int32 (), known rows since the last alarm. begun: float32 (), share of the interval that was over when the stream began; negative: not drawn yet."""
  count: jax.Array
  begun: jax.Array


@reference
def periodic(threshold: float = math.log(10_000)) -> Detector:
  """Fires every round(exp(threshold)) known rows, whatever they hold.

    n = known rows since the last alarm, this one included;  score = ln(n + 1/2 + b exp(threshold));  fired = score > threshold; then n = b = 0

  A stream comes upon the clock anywhere: b is a uniform draw of the bits of OPR and reward of the first known row. Streams in step would all alarm at once, and streams
  shorter than the interval never.

  Printed beside every score because where changes are frequent, or the tolerance after them long, a clock finds many of them: half a period is its
  mean delay. The threshold is ln of the interval, so calibration to an ARL0 works on it. float32 holds the interval to a row up to about 10^6 rows.

  Args:
    threshold: ln of the interval [ln control steps], at least 0.
  Blind to: everything.
  Example: _, out = jax.lax.scan(det.update, det.init(), residuals)
  """
  demand("periodic", threshold=(threshold, above(threshold, -1e-9), "at least 0, the logarithm of an interval in steps"))

  def update(state, residual):
    known = residual.valid
    begun = jnp.where(known & (state.begun < 0), drawn(_told_apart(jnp.zeros(2, jnp.uint32), residual)), state.begun)
    count = state.count + known
    score = jnp.logaddexp(jnp.log(count.astype(jnp.float32) + 0.5), jnp.log(jnp.maximum(begun, 0.0)) + threshold)
    fired = known & (score > threshold)
    return PeriodicState(jnp.where(fired, 0, count), jnp.where(fired, 0.0, begun)), Alarm(fired, jnp.where(known, score, jnp.nan))

  drawn = lambda key: jax.random.uniform(key, minval=jnp.finfo(jnp.float32).tiny)
  return Detector(lambda: PeriodicState(jnp.int32(0), jnp.float32(-1)), update)


def _told_apart(seed: jax.Array, residual) -> jax.Array:
  """A key of seed, uint32 (2,), and the bits of a row: streams start from one state, and would otherwise all draw the same."""
  bits = jax.lax.bitcast_convert_type(jnp.stack([residual.opr, residual.reward]), jnp.uint32)
  return jax.random.wrap_key_data(seed + bits, impl="threefry2x32")  # modulo 2^32; the cipher spreads what is near


class RandomState(NamedTuple):
  """Attributes: count: int32 (), known rows. seed: uint32 (2,), data of a key."""
  count: jax.Array
  seed: jax.Array


@reference
def random(threshold: float = math.log(10_000), seed: int = 0) -> Detector:
  """Fires at a known row with probability exp(-threshold), whatever it holds.

    u = uniform draw of (seed, number of the known row, bits of the row's OPR and reward);  score = -ln u;  fired = score > threshold

  The score is exponential with mean 1, so the threshold is ln of the mean interval and calibration to an ARL0 works on it. The row's bits
  only tell streams apart, which start from one state and would otherwise all fire at once.

  Printed beside every score because it is the chance level: a detector at the same ARL0 that finds no more within a tolerance of T steps than the
  1 - (1 - exp(-threshold))^T of this one has found nothing.

  Args:
    threshold: ln of the mean interval [ln control steps], at least 0.
    seed: of the draws.
  Blind to: everything.
  Example: _, out = jax.lax.scan(det.update, det.init(), residuals)
  """
  demand("random", threshold=(threshold, above(threshold, -1e-9), "at least 0, the logarithm of a mean interval in steps"))

  def init():
    return RandomState(jnp.int32(0), jax.random.key_data(jax.random.key(seed, impl="threefry2x32")))

  def update(state, residual):
    u = jax.random.uniform(jax.random.fold_in(_told_apart(state.seed, residual), state.count), minval=jnp.finfo(jnp.float32).tiny)
    score = -jnp.log(u)
    known = residual.valid
    return RandomState(state.count + known, state.seed), Alarm(known & (score > threshold), jnp.where(known, score, jnp.nan))

  return Detector(init, update)


@reference
def oracle(onset=0) -> Detector:
  """Fires once, at the true onset: latency 0, no miss, no false alarm.

    t = rows before this one, known or not;  score = 1 if t >= onset, else 0;  fired = (t == onset)

  Printed beside every score because it bounds what detection is worth: the best return that an agent could reach by being told, from which the loss
  of a real detector is measured. No threshold. A detector does not see the onset, so it is not in the table: whoever scores it gives it the truth. It
  counts every row, since an onset is a time, and fires at a row of which nothing is known; the contract on unknown rows does not hold for it.

  Args:
    onset: step of the change [control steps], may be traced.
  Example: _, out = jax.lax.scan(det.update, det.init(), residuals)
  """
  demand("oracle", onset=(onset, above(onset, -1), "at least 0"))

  def update(state, residual):
    return state + 1, Alarm(state == onset, jnp.where(state >= onset, 1.0, 0.0).astype(jnp.float32))

  return Detector(lambda: jnp.int32(0), update)


REFERENCES = {"never": never, "always": always, "periodic": periodic, "random": random, "oracle": oracle}
