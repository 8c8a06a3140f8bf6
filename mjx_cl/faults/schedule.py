"""When a fault acts: a factor in [0, 1] on its severity, as a pure function of the control step.
`SCHEDULES` (presets.py) is the one table.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Float, Int, PRNGKeyArray

from mjx_cl.faults.presets import FOREVER, Change, place
from mjx_cl.types import Array

Numbers = ArrayLike | Sequence[float | int]
Step = Int[Array, ""] | int  # control step


class Plan(NamedTuple):
  """When and how strongly faults act; arrays () or (F,), all of them traced: they change between
  calls without a new compilation.

  Attributes:
    severity: float32, at most reached.
    onset: int32, first control step.
    duration: int32, control steps; FOREVER is never repaired.
    kind: int32, index into SCHEDULES.
    period: int32, control steps, at least 1.
    share: float32 in [0, 1].
  """

  severity: Array
  onset: Array
  duration: Array
  kind: Array
  period: Array
  share: Array


def plan(
  severity: Numbers = 0.0,
  onset: Numbers = 0,
  duration: Numbers = FOREVER,
  schedule: str | Numbers = "abrupt",
  period: Numbers = 1000,
  share: Numbers = 0.5,
) -> Plan:
  """A Plan from numbers or arrays; `schedule` is a name or an array of indices."""
  kind = place(schedule) if isinstance(schedule, str) else schedule
  i, f = lambda x: jnp.asarray(x, jnp.int32), lambda x: jnp.asarray(x, jnp.float32)
  return Plan(f(severity), i(onset), i(duration), i(kind), i(period), f(share))


def numbers(change: Change, onset: int) -> tuple[float, int, int, int, int, float]:
  """What `plan` takes of a Change of a run whose onset is `onset`."""
  return (
    change.severity,
    onset + change.after,
    change.duration or FOREVER,
    place(change.schedule),
    change.period,
    change.share,
  )


def spread(plan: Plan, faults: int) -> Plan:
  """Plan with every leaf (F,)."""
  return Plan(*(jnp.broadcast_to(x, (faults,)) for x in plan))


def abrupt(t: Step, onset: Int[Array, "*f"], duration: Int[Array, "*f"]) -> Float[Array, "*f"]:
  """1 for onset <= t < onset + duration, else 0. `onset`, `duration` in control steps; FOREVER is
  never repaired.
  """
  return ((t >= onset) & (t - onset < duration)).astype(jnp.float32)


def factor(plan: Plan, walk: Float[Array, "*f"], t: Step) -> Float[Array, "*f"]:
  """Share of the severity that is in force at control step t.

    abrupt 1;  ramp min(1, (since + 1) / period);  intermittent 1 if (since mod period) < share
    period else 0;
    cyclic (1 - cos(2 pi (since + 1) / period)) / 2;  random walk: `walk`
      since = t - onset
  Exactly 0 before the onset and from onset + duration on.
  """
  since = t - plan.onset
  phase = jnp.mod(since, plan.period).astype(jnp.float32)
  period = plan.period.astype(jnp.float32)
  ramp = jnp.minimum(1.0, (since + 1).astype(jnp.float32) / period)
  on = (phase < plan.share * period * (1 - 1e-6)).astype(jnp.float32)  # 0.3f 100 is above 30
  wave = 0.5 - 0.5 * jnp.cos(2 * jnp.pi * (phase + 1) / period)
  kinds = jnp.stack([jnp.ones_like(ramp), ramp, on, wave, jnp.broadcast_to(walk, ramp.shape)])
  chosen = jnp.take_along_axis(kinds, plan.kind[None], 0)[0]
  return jnp.where(abrupt(t, plan.onset, plan.duration) > 0, chosen, 0.0)


def severity(plan: Plan, walk: Float[Array, "*f"], t: Step) -> Float[Array, "*f"]:
  """Severity in force, in [0, 1]."""
  return plan.severity * factor(plan, walk, t)


def walk(plan: Plan, value: Float[Array, "*f"], t: Step, key: PRNGKeyArray) -> Float[Array, "*f"]:
  """Where the random walk stands at control step t: a new step at the onset and every `period`
  after it, reflected at 0 and 1.
  """
  since = t - plan.onset
  due = (since >= 0) & (jnp.mod(since, plan.period) == 0)
  moved = jnp.abs(value + plan.share * jax.random.normal(key, value.shape))  # reflected at 0
  moved = jnp.clip(1.0 - jnp.abs(1.0 - moved), 0.0, 1.0)  # and at 1
  return jnp.where(due, moved, value)
