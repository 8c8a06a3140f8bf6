"""Faults between the robot and the world: grip, slope, pushes, wind."""

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from mjx_cl.errors import UserError
from mjx_cl.faults.base import Fault, Ports, Severity, Values, fault, masks, read
from mjx_cl.faults.body import force_map, heading_targets
from mjx_cl.faults.kinds import leafwise, scaled
from mjx_cl.types import Array

HEADINGS = ("forward", "backward", "left", "right")

PUSH_EVERY = 100  # control steps between two pushes
PUSH_FOR = 4  # control steps that one lasts


def friction(env: Any) -> Fault:
  """Grip is lost: under all feet (a slippery ground) or under one foot, wheel or axle (a sock).

    mu_i' = mu_i (1 - 0.95 severity)

  Severity: 1 leaves 5 % of the friction coefficient [1]. Target: all, or a foot, wheel or axle (any
  of them drawn). Owns `mj.geom_friction` (n, 3) of the touching geoms, or `task.friction`, one per
  axle. The geoms must have priority over the floor: MuJoCo takes the greater of two equal ones
  otherwise, and the fault would do nothing. Source: friction of realworldrl_suite, MuJoCo
  Playground and f1tenth_gym.
  """
  feet = env.spec.feet
  if not feet:
    raise UserError(
      f"fault 'friction' needs feet or wheels with a name, which robot {env.spec.name!r} does "
      "not have"
    )
  everything = tuple(sorted({i for _, hit in feet for i in hit}))
  if "friction" in env.model.task:
    leaf, size = "task.friction", env.model.task["friction"].shape[0]
  else:
    leaf, size = "mj.geom_friction", env.mj_model.ngeom
    check_priority(env, everything)
  names, mask = masks([("all", everything), *feet], size)
  return scaled("friction", env, leaf, lambda severity: 1.0 - 0.95 * severity, (names, mask, None))


def check_priority(env: Any, geoms: Iterable[int]) -> None:
  """Raises UserError where a foot's friction is masked by what it stands on."""
  model = env.mj_model
  ground = model.body_weldid[model.geom_bodyid] == 0
  ground &= (model.geom_contype | model.geom_conaffinity) != 0
  floor = np.flatnonzero(ground)
  masked = [
    mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, g) or str(g)
    for g in geoms
    if any(model.geom_priority[g] <= model.geom_priority[f] for f in floor)
  ]
  if masked:
    raise UserError(
      f"fault 'friction': the floor masks the friction of {', '.join(masked)} in robot "
      f"{env.spec.name!r}; give these geoms a higher priority"
    )


def slope(env: Any) -> Fault:
  """The ground is no longer level: gravity tilts, the ground stays where it is.

    g' = |g| (sin(a) e - cos(a) z),   a = 20 degrees severity, e the direction downhill

  Severity: 1 is a slope of 20 [degrees]. Target: where downhill is (drawn), forward, backward,
  left, right as far as the robot can move there. Owns `mj.gravity` (3,) [m/s^2], or `task.gravity`.
  Source: slopes of Nagabandi et al. (learning_to_adapt); the range is this project's own choice.
  """
  names, directions = heading_targets(env, HEADINGS)
  leaf = "task.gravity" if "gravity" in env.model.task else "mj.gravity"

  def tilted(
    value: Float[Array, "3"], downhill: Float[Array, "3"], severity: Severity
  ) -> Float[Array, "3"]:
    angle = jnp.deg2rad(20.0) * severity
    down = jnp.sin(angle) * downhill - jnp.cos(angle) * jnp.asarray([0.0, 0.0, 1.0])
    return jnp.linalg.norm(value) * down

  return leafwise("slope", env, {leaf: tilted}, (names, directions, None))


def whole_mass(env: Any) -> float:
  """Mass of the nominal robot [kg]."""
  return (
    float(np.asarray(env.model.task["mass"]))
    if "mass" in env.model.task
    else float(env.mj_model.body_mass.sum())
  )


def wind(env: Any) -> Fault:
  """A steady force on the trunk.   F = 0.3 severity M g e [N]

  Severity: 1 is 30 % of the weight [N]. Target: the direction of the wind in the world (drawn),
  forward (+x), backward, left, right as far as the robot can move there. Owns `force` (nv,).
  Source: force faults of PEDM, Haider et al. 2023; direction and range are this project's own
  choice.
  """
  names, directions = heading_targets(env, HEADINGS)
  blows = 0.3 * 9.81 * whole_mass(env) * directions @ force_map(env)
  return leafwise(
    "wind",
    env,
    {"force": lambda value, blow, severity: value + severity * blow},
    (names, blows, None),
  )


def push(env: Any) -> Fault:
  """Blows to the trunk: every 100 control steps, for 4, each in a direction drawn anew.

    F = severity M dv / (4 dt) e [N],   dv = 1.5 m/s, e = forward or backward (and sideways where
      the robot can move there)

  Severity: 1 changes the speed by 1.5 per blow [m/s] (Isaac Lab trains with 0.5, severity 1/3).
  Target: trunk, the only one. Owns `force` (nv,). Memory: the direction of the latest blow.
  Source: pushes of Isaac Lab.
  """
  _, directions = heading_targets(env, HEADINGS)
  blows = 1.5 * whole_mass(env) / (PUSH_FOR * env.spec.control_s) * directions @ force_map(env)

  def act(
    target: Any, memory: Int[Array, ""], severity: Severity, key: PRNGKeyArray, ports: Ports
  ) -> Values:
    phase = jnp.mod(ports.since, PUSH_EVERY)
    which = jnp.where(phase == 0, jax.random.randint(key, (), 0, directions.shape[0]), memory)
    strength = jnp.where(phase < PUSH_FOR, severity, 0.0)
    chosen = (jnp.arange(blows.shape[0]) == which)[:, None]
    blow = jnp.sum(jnp.where(chosen, blows, 0.0), 0)
    return which, {"force": read(ports, "force") + strength * blow}

  return fault("push", env, ("force",), ("trunk",), act, jnp.int32(0))


CONTACT = {"friction": friction, "slope": slope, "wind": wind, "push": push}
