"""Faults of motors and transmissions."""
from __future__ import annotations

import jax
import jax.numpy as jnp

from mjx_cl.faults.base import Fault, Ports


def gear(spec) -> Fault:
  """One joint's gear ratio falls: a motor of the same command gives (1 - severity) of its torque.

    gear_j' = gear_j (1 - severity)

  Severity: lost share of the gear ratio, 0 nominal, 1 no torque at all; the paper halves the gear, severity 0.5. Target: a joint, or drawn
  uniformly from the stream's key. Owns `mj.actuator_gear` [ratio], (nu, 6). Not visible to: a robot that does not load the joint.
  Source: the paper's walker experiment.
  """
  def init(key, target=-1):
    return jnp.where(jnp.asarray(target) < 0, jax.random.randint(key, (), 0, len(spec.targets)), target).astype(jnp.int32)

  def apply(joint, severity, key, ports: Ports):
    del key
    value = ports.model.mj["actuator_gear"]
    hit = (jnp.arange(value.shape[0]) == joint)[:, None]
    changed = jnp.where(hit, value * (1.0 - severity), value)
    return joint, ports._replace(model=ports.model._replace(mj=ports.model.mj | {"actuator_gear": changed}))

  return Fault("gear", ("mj.actuator_gear",), spec.targets, init, apply)
