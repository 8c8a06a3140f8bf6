"""The reality gap of the car, item by item, as ordinary faults of `car_real`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp

from mjx_cl.errors import UserError
from mjx_cl.faults.base import Fault, fault
from mjx_cl.types import Model

if TYPE_CHECKING:
  import jax

  from mjx_cl.faults.base import Ports


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
    target: jax.Array, memory: Any, severity: jax.Array, key: jax.Array, ports: Ports
  ) -> tuple[Any, dict[str, jax.Array]]:
    model = Model(dict(ports.model.mj), dict(ports.model.task), ports.model.force)
    for i, name in enumerate(items):
      model = env.widen(
        model, name, jnp.where((target == i) | (target == len(items)), severity, 0.0)
      )
    value = lambda leaf: getattr(model, leaf.split(".")[0])[leaf.split(".")[1]]
    return memory, {leaf: value(leaf) for leaf in leaves}

  return fault("gap", env, leaves, tuple(items) + ("all",), act, drawn=len(items))


TRANSFER = {"gap": gap}
