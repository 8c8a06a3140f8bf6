"""Robots and their tasks. `ENVS` is the one table, which entry points `mjx_cl.envs` join;
`make(name)` builds one.
"""

import inspect
from typing import Any

from mjx_cl.envs.car import Car
from mjx_cl.envs.car_real import CarReal
from mjx_cl.envs.quadruped import Quadruped
from mjx_cl.envs.walker import Walker
from mjx_cl.errors import PluginError, UserError, choose
from mjx_cl.io.plugins import Registry, line, of_user
from mjx_cl.physics import PURE_JAX
from mjx_cl.types import Spec

ENVS = Registry(
  "mjx_cl.envs",
  "environment",
  {"walker": Walker, "quadruped": Quadruped, "car": Car, "car_real": CarReal},
)


def physics_of(env: Any) -> Any:
  """The physics backend of a robot: its `name`, and the `seconds` spent in it outside the compiled
  program; of a robot that names none, pure JAX.
  """
  return getattr(env, "physics", PURE_JAX)


def make(name: str, physics: str = "auto") -> Any:
  """Builds environment `name` on a physics backend (`auto`, `native` or `mjx`). A class that takes
  no `physics` has none to choose from.

  Raises:
    UserError for an unknown name, a backend that the robot has not, and whatever goes wrong in a
    robot of another package.
  """
  build: Any = choose("environment", name, ENVS)
  if name in ENVS.own:
    return build(physics=physics)
  try:
    parameters = inspect.signature(build).parameters.values()
    takes = any(p.name == "physics" or p.kind is p.VAR_KEYWORD for p in parameters)
    if not takes and physics != "auto":
      raise UserError(
        f"environment {name!r} has no physics backend to choose; leave out --physics {physics}"
      )
    robot = build(physics=physics) if takes else build()
    lacking = [part for part in ("spec", "model", "init", "step") if not hasattr(robot, part)]
    if lacking or not isinstance(robot.spec, Spec):
      raise PluginError(
        f"environment {name!r} gives {type(robot).__name__}, which has no "
        f"{' and no '.join(lacking or ['mjx_cl.types.Spec'])}"
      )
    return robot
  except UserError:
    raise
  except BaseException as e:  # whatever a foreign class raises
    if of_user(e):
      raise
    raise PluginError(f"environment {name!r} cannot be built: {line(e)}") from e
