"""Robots and their tasks. `ENVS` is the one table, which entry points `mjx_cl.envs` join;
`make(name)` builds one.
"""

import inspect
from typing import Any

import jax
import jax.numpy as jnp

from mjx_cl.envs.car import Car
from mjx_cl.envs.car_real import CarReal
from mjx_cl.envs.external import LIBRARIES
from mjx_cl.envs.quadruped import Quadruped
from mjx_cl.envs.walker import Walker
from mjx_cl.errors import PluginError, UserError, choose
from mjx_cl.io.plugins import Registry, line, of_user
from mjx_cl.physics import PURE_JAX
from mjx_cl.types import Spec, Step

ENVS = Registry(
  "mjx_cl.envs",
  "environment",
  {"walker": Walker, "quadruped": Quadruped, "car": Car, "car_real": CarReal},
  LIBRARIES,
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
    UserError: for an unknown name, a backend that the robot has not, and whatever goes wrong in a
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
    _try(name, robot)
    return robot
  except UserError:
    raise
  except BaseException as e:  # whatever a foreign class raises
    if of_user(e):
      raise
    raise PluginError(f"environment {name!r} cannot be built: {line(e)}") from e


def _try(name: str, robot: Any) -> None:
  """Traces a step of a robot of another package; PluginError where that gives something else than
  its spec says.
  """

  def one() -> tuple[Any, Any]:
    state, obs = robot.init(robot.model, jax.random.key(0))
    state, out = robot.step(robot.model, state, jnp.zeros(len(robot.spec.act)))
    if not isinstance(out, Step):
      gave = type(out).__name__
      raise PluginError(f"environment {name!r}: step gives {gave} in place of a Step")
    return obs, out.obs

  for what, value in zip(("init", "step"), jax.eval_shape(one)):
    if getattr(value, "shape", None) != (len(robot.spec.obs),):
      raise PluginError(
        f"environment {name!r}: {what} gives an observation that is not of its spec's "
        f"{len(robot.spec.obs)} variables"
      )
