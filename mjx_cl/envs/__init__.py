"""Robots and their tasks. `ENVS` is the one table; `make(name)` builds one."""
from __future__ import annotations

import importlib.metadata

from mjx_cl.envs.car import Car
from mjx_cl.envs.car_real import CarReal
from mjx_cl.envs.quadruped import Quadruped
from mjx_cl.envs.walker import Walker
from mjx_cl.errors import UserError, choose

ENVS = {"walker": Walker, "quadruped": Quadruped, "car": Car, "car_real": CarReal}


def _plugins() -> None:
  """Adds the robots of other packages (entry-point group `mjx_cl.envs`); a name that is taken is an error."""
  for entry in importlib.metadata.entry_points(group="mjx_cl.envs"):
    if entry.name in ENVS:
      raise UserError(f"environment {entry.name!r} of {entry.value} has a name that is taken")
    ENVS[entry.name] = entry.load()


_plugins()


def make(name: str, physics: str = "auto"):
  """Builds environment `name` on a physics backend (`auto`, `native` or `mjx`)."""
  return choose("environment", name, ENVS)(physics=physics)
