"""Robots and their tasks. `ENVS` is the one table, which entry points `mjx_cl.envs` join;
`make(name)` builds one.
"""

import inspect
from collections.abc import Iterator
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
from mjx_cl.types import GROUPS, Spec, Step

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
  """Traces two steps of a robot of another package; PluginError where that gives something else
  than the contract and the robot's spec say.
  """
  complain = lambda text: PluginError(f"environment {name!r}: {text}")
  size = len(robot.spec.obs)
  if wrong := next(_misfits(robot), None):
    raise complain(wrong)
  first = jax.eval_shape(lambda: robot.init(robot.model, jax.random.key(0)))
  if not (isinstance(first, tuple) and len(first) == 2 and hasattr(first[0], "step")):
    raise complain("init gives no (EnvState, observation)")
  state, obs = first
  if getattr(obs, "shape", None) != (size,):
    raise complain(f"init gives an observation that is not of its spec's {size} variables")
  act = jax.ShapeDtypeStruct((len(robot.spec.act),), jnp.float32)

  def one(state: Any, action: jax.Array) -> tuple[Any, Step]:
    given = robot.step(robot.model, state, action)
    out = given[1] if isinstance(given, tuple) and len(given) == 2 else given
    if not isinstance(out, Step):
      raise complain(f"step gives {type(out).__name__} in place of a Step")
    return given

  after, out = jax.eval_shape(one, state, act)
  for field, value in out._asdict().items():
    want = (size,) if "obs" in field else ()
    if value.shape != want:
      held = f"its spec's {size} variables" if want else "one number"
      raise complain(f"step gives {field} of shape {value.shape}, which is not {held}")
    if (value.dtype == jnp.bool_) != (field in ("terminated", "truncated")):
      raise complain(f"step gives {field} of type {value.dtype}")
  was, now = (_forms(x) for x in (state, after))
  if was != now:
    at = next((k for k in was.keys() | now.keys() if was.get(k) != now.get(k)), "its structure")
    raise complain(
      f"step gives a state whose {at} is {now.get(at, 'missing')}; init gave {was.get(at, 'none')}"
    )


def _forms(tree: Any) -> dict[str, str]:
  """Type and shape of every leaf, by its place."""
  leaves = jax.tree_util.tree_leaves_with_path(tree)
  return {jax.tree_util.keystr(path).strip("."): f"{x.dtype}{list(x.shape)}" for path, x in leaves}


def _misfits(robot: Any) -> Iterator[str]:
  """What of a spec does not fit itself or the robot's MuJoCo model."""
  spec, host = robot.spec, getattr(robot, "mj_model", None)
  sizes = {"act_groups": len(spec.act), "obs_groups": len(spec.obs), "watched": len(spec.obs)}
  if host is not None:
    sizes |= {"bodies": host.nbody, "feet": host.ngeom}
  for field, size in sizes.items():
    for group, indices in getattr(spec, field):
      if not indices or not all(0 <= i < size for i in indices):
        yield f"spec.{field}: {group!r} must hold indices in 0..{size - 1}; got {tuple(indices)}"
  if len(spec.watched) > GROUPS:
    yield f"spec.watched has {len(spec.watched)} parts; at most {GROUPS}"
  if spec.posture is not None and not 0 <= spec.posture[0] < len(spec.obs):
    yield f"spec.posture: index {spec.posture[0]} is not in 0..{len(spec.obs) - 1}"
  if len(spec.targets) > len(spec.act):
    yield f"spec.targets names {len(spec.targets)} of {len(spec.act)} actions"
