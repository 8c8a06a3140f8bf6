"""Detectors that look at nothing: what every score is printed beside."""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray, UInt32

from mjx_cl.detectors.base import Alarm, Detector, Setting, above, demand, judged
from mjx_cl.rollout.monitor import Residual
from mjx_cl.types import Array


def reference(factory: Callable[..., Detector]) -> Callable[..., Detector]:
  """Marks a factory as a reference: no contract that asks for a detection holds for it."""
  factory.takes, factory.reference = "residual", True  # type: ignore[attr-defined]
  return factory


def _constant(fires: bool) -> Detector:
  """Fires at every known row or at none; score 1 or 0."""

  def update(state: jax.Array, residual: Residual) -> tuple[jax.Array, Alarm]:
    return state, judged(jnp.float32(fires), residual.valid, 0.5)

  return Detector(lambda: jnp.int32(0), update)


@reference
def never() -> Detector:
  """Never fires; score 0. The floor of every delay and miss figure, the ceiling of every
  false-alarm figure.

  Printed beside every score because a score that `never` also reaches was not earned by detection:
  with few faults in a long stream, precision, false alarms per hour and return of an agent that
  needs no help all look fine. No threshold: it is not calibrated, its ARL0 is infinite. Blind to:
  everything.
  """
  return _constant(False)


@reference
def always() -> Detector:
  """Fires at every known row; score 1. Latency 0 and no miss, at an ARL0 of one step.

  Printed beside every score because a delay without its false alarms is won by this detector. No
  threshold: it is not calibrated. Blind to: everything.
  """
  return _constant(True)


class PeriodicState(NamedTuple):
  """What the clock remembers.

  Attributes:
    seen: uint32 (), known rows.
    phase: uint32 (), where on the clock the stream began.
    begun: bool (), it has been drawn.
  """

  seen: jax.Array
  phase: jax.Array
  begun: jax.Array


GOLDEN = 2_654_435_769  # 2^32 over the golden ratio


@reference
def periodic(threshold: Setting = math.log(10_000)) -> Detector:
  """Fires every exp(threshold) known rows, whatever they hold, as regularly as a clock can that
  does not know its period.

    x = (phase + GOLDEN n) mod 2^32, n = number of the known row;  u = (x + 1/2) / 2^32;  score =
    -ln u;  fired = score > threshold

  Multiples of the golden ratio are spread over the unit interval as evenly as can be: of N rows N
  exp(-threshold) fire, up to a few, and the intervals between them have three lengths at most, all
  near exp(threshold). So a score that is free of the threshold has the rate that is asked for, and
  calibration to an ARL0 works on it. A stream comes upon the clock anywhere: its phase is a uniform
  draw of the bits of OPR and reward of its first known row; in step, streams would all alarm at
  once.

  Printed beside every score because where changes are frequent, or the tolerance after them long, a
  clock finds many of them: half a period is its mean delay.

  Args:
    threshold: ln of the mean interval [ln control steps], at least 0.
  Blind to: everything.
  Reference: Sos 1958, Ann. Univ. Sci. Budapest 1, 127-134 (three lengths).
  """
  rule = "at least 0, the logarithm of an interval in steps"
  demand("periodic", threshold=(threshold, above(threshold, -1e-9), rule))

  def update(state: PeriodicState, residual: Residual) -> tuple[PeriodicState, Alarm]:
    known = residual.valid
    drawn = jax.random.bits(_told_apart(jnp.zeros(2, jnp.uint32), residual))
    phase = jnp.where(known & ~state.begun, drawn, state.phase)
    u = ((phase + jnp.uint32(GOLDEN) * state.seen).astype(jnp.float32) + 0.5) * 2.0**-32
    new = PeriodicState(state.seen + known.astype(jnp.uint32), phase, state.begun | known)
    return new, judged(-jnp.log(u), known, threshold)

  return Detector(lambda: PeriodicState(jnp.uint32(0), jnp.uint32(0), jnp.bool_(False)), update)


def _told_apart(seed: UInt32[Array, "2"], residual: Residual) -> PRNGKeyArray:
  """A key of seed and the bits of a row: streams start from one state, and would otherwise all draw
  the same.
  """
  bits = jax.lax.bitcast_convert_type(jnp.stack([residual.opr, residual.reward]), jnp.uint32)
  # modulo 2^32; the cipher spreads what is near
  return jax.random.wrap_key_data(seed + bits, impl="threefry2x32")


class RandomState(NamedTuple):
  """What the draws go by.

  Attributes:
    seen: int32 (), known rows.
    seed: uint32 (2,), data of a key.
  """

  seen: jax.Array
  seed: jax.Array


@reference
def random(threshold: Setting = math.log(10_000), seed: int = 0) -> Detector:
  """Fires at a known row with probability exp(-threshold), whatever it holds.

    u = uniform draw of (seed, number of the known row, bits of the row's OPR and reward);  score =
    -ln u;  fired = score > threshold

  The score is exponential with mean 1, so the threshold is ln of the mean interval and calibration
  to an ARL0 works on it. The row's bits only tell streams apart, which start from one state and
  would otherwise all fire at once.

  Printed beside every score because it is the chance level: a detector at the same ARL0 that finds
  no more within a tolerance of T steps than the 1 - (1 - exp(-threshold))^T of this one has found
  nothing.

  Args:
    threshold: ln of the mean interval [ln control steps], at least 0.
    seed: of the draws.
  Blind to: everything.
  """
  rule = "at least 0, the logarithm of a mean interval in steps"
  demand("random", threshold=(threshold, above(threshold, -1e-9), rule))

  def init() -> RandomState:
    return RandomState(jnp.int32(0), jax.random.key_data(jax.random.key(seed, impl="threefry2x32")))

  def update(state: RandomState, residual: Residual) -> tuple[RandomState, Alarm]:
    key = jax.random.fold_in(_told_apart(state.seed, residual), state.seen)
    score = -jnp.log(jax.random.uniform(key, minval=jnp.finfo(jnp.float32).tiny))
    alarm = judged(score, residual.valid, threshold)
    return RandomState(state.seen + residual.valid, state.seed), alarm

  return Detector(init, update)


@reference
def oracle(onset: Setting = 0) -> Detector:
  """Fires once, at the true onset: latency 0, no miss, no false alarm.

    t = rows before this one, known or not;  score = 1 if t >= onset, else 0;  fired = (t == onset)

  Printed beside every score because it bounds what detection is worth: the best return that an
  agent could reach by being told, from which the loss of a real detector is measured. No threshold.
  A detector does not see the onset, so it is not in the table: whoever scores it gives it the
  truth. It counts every row, since an onset is a time, and fires at a row of which nothing is
  known; the contract on unknown rows does not hold for it.

  Args:
    onset: step of the change [control steps], may be traced.
  """
  demand("oracle", onset=(onset, above(onset, -1), "at least 0"))

  def update(state: jax.Array, residual: Residual) -> tuple[jax.Array, Alarm]:
    return state + 1, Alarm(state == onset, jnp.where(state >= onset, 1.0, 0.0).astype(jnp.float32))

  return Detector(lambda: jnp.int32(0), update)


# the oracle must be told the onset, so it is not in the table of detectors
REFERENCES = {f.__name__: f for f in (never, always, periodic, random, oracle)}
