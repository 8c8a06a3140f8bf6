"""The reality gap of the car, item by item, as ordinary faults of `car_real`."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Int, PRNGKeyArray

from mjx_cl.errors import UserError
from mjx_cl.faults.base import Fault, Ports, Severity, Values, fault, read
from mjx_cl.types import Array


def gap(env: Any) -> Fault:
  """One item of the gap between simulator and car, or all of them, appears or grows (env.widen).

    x' = x + severity (x_real - x_simulator),  acceleration, grip and mass:  x' = x (x_real /
    x_simulator)^severity

  Severity: 1 adds the whole difference of the item [its unit, see envs.car_real.GAP]: where the
  item is switched off it is then there in full, where it is on it is doubled. Target: an item
  (drawn), or all. Owns the leaves of the items. Source: named with each item.
  """
  items = getattr(env, "gap_items", None)
  if not items:
    raise UserError(
      f"fault 'gap' needs a robot with a reality gap (car_real), which {env.spec.name!r} is not"
    )
  leaves = tuple(sorted({item.leaf for item in items.values()}))

  def act(
    target: Int[Array, ""], memory: Any, severity: Severity, key: PRNGKeyArray, ports: Ports
  ) -> Values:
    model = ports.model
    for i, name in enumerate(items):
      model = env.widen(
        model, name, jnp.where((target == i) | (target == len(items)), severity, 0.0)
      )
    return memory, {leaf: read(Ports(model), leaf) for leaf in leaves}

  return fault("gap", env, leaves, tuple(items) + ("all",), act, drawn=len(items))


TRANSFER = {"gap": gap}
