"""What every fault is: pure maps over ports, driven by a severity in [0, 1]."""
from __future__ import annotations

from typing import Any, Callable, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.faults import schedule
from mjx_cl.types import Model


class Ports(NamedTuple):
  """The places at which a fault can act on one robot in one control step.

  Attributes:
    model: types.Model, nominal on the way in: a fault starts from the nominal model, so it cannot compound.
    ctrl: float32 (A,), the action as the agent gave it, or None while no action is at hand.
    force: float32 (nv,), generalised force applied from outside, or None.
    obs: float32 (O,), what the sensors report, or None.
  """
  model: Model
  ctrl: jax.Array | None = None
  force: jax.Array | None = None
  obs: jax.Array | None = None


class Fault(NamedTuple):
  """Attributes:
    name: registry name.
    owns: leaves it may write, such as "mj.actuator_gear"; severity 0 leaves them bit-identical.
    targets: names that a target index stands for.
    init: (key, target int32 () or -1 to draw it) -> fstate, a pytree.
    apply: (fstate, severity float32 (), key, Ports) -> (fstate, Ports).
  """
  name: str
  owns: tuple[str, ...]
  targets: tuple[str, ...]
  init: Callable[..., Any]
  apply: Callable[..., Any]


class Injection(NamedTuple):
  """The true fault of one stream; logged, never observable to agent or detector.

  Attributes:
    state: fstate of the fault.
    severity: float32 (), the severity while active.
    onset, duration: int32 (), control steps.
  """
  state: Any
  severity: jax.Array
  onset: jax.Array
  duration: jax.Array


def inject(fault: Fault, injection: Injection, t: jax.Array, key: jax.Array, ports: Ports):
  """Applies `fault` in control step t.

  Returns:
    (injection', ports', severity now float32 ()).
  """
  severity = injection.severity * schedule.abrupt(t, injection.onset, injection.duration)
  state, ports = fault.apply(injection.state, severity, key, ports)
  return injection._replace(state=state), ports, severity


def none(spec) -> Fault:
  """No fault at all: the nominal robot."""
  del spec
  return Fault("none", (), ("all",), lambda key, target=-1: jnp.int32(0), lambda state, severity, key, ports: (state, ports))
