"""The reality gap of the car, item by item, as ordinary faults of `car_real`."""
from __future__ import annotations

import jax.numpy as jnp

from mjx_cl.errors import UserError
from mjx_cl.faults.base import Fault, fault


def gap(env) -> Fault:
  """One item of the gap between simulator and car, or all of them, appears or grows.

    x' = x + severity (x_real - x_simulator)

  Severity: 1 adds the whole difference of the item [its unit, see envs.car_real.GAP]: where the item is switched off it is then there in full, where it
  is on it is doubled. Target: an item, or all. Owns the task leaves of the items.
  """
  items = getattr(env, "gap_items", None)
  if not items:
    raise UserError(f"fault 'gap' needs a robot with a reality gap (car_real), which {env.spec.name!r} is not")
  leaves = tuple(sorted({f"task.{item.leaf}" for item in items}))
  names = tuple(item.name for item in items) + ("all",)

  def act(target, memory, severity, key, ports):
    values = {}
    for leaf in leaves:
      value = ports.model.task[leaf[5:]]
      for i, item in enumerate(items):
        if f"task.{item.leaf}" == leaf:
          change = severity * jnp.asarray(item.real - item.simulator, jnp.float32)
          value = jnp.where((target == i) | (target == len(items)), value + change, value)
      values[leaf] = value
    return memory, values
  return fault("gap", env, leaves, names, act, drawn=len(items))


TRANSFER = {"gap": gap}
