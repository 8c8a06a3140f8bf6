"""Faults of the body: masses, where they sit, joints. Masses bring their derived constants
(mj_setConst, physics.fields).
"""

from collections.abc import Callable, Iterable
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Bool, Float

from mjx_cl.errors import UserError
from mjx_cl.faults.actuator import dofs
from mjx_cl.faults.base import Fault, Severity, actuator_targets, masks
from mjx_cl.faults.kinds import along, leafwise
from mjx_cl.types import Array

MASSES = ("mj.body_mass", "mj.body_inertia")


def _bodies(env: Any, name: str) -> tuple[tuple[str, ...], Bool[Array, "targets nbody"]]:
  """Names and masks of spec.bodies."""
  if not env.spec.bodies or getattr(env, "mj_model", None) is None:
    raise UserError(
      f"fault {name!r} needs bodies with a name and a mass, which robot {env.spec.name!r} does "
      "not have"
    )
  return masks(env.spec.bodies, env.mj_model.nbody)


def _heavier(growth: Callable[[Any, Severity], Array]) -> Callable[[Array, Any, Severity], Array]:
  """A leaf times growth(row, severity)."""
  return lambda value, row, severity: value * along(growth(row, severity), value)


def payload(env: Any) -> Fault:
  """The trunk carries a load, spread as its own mass is.

    m' = m (1 + 0.4 severity M / m),  I' = I m' / m                       M whole mass, m the
      trunk's

  Severity: 1 is a load of 40 % of the whole robot [kg]: quadruped 20.9 kg (Isaac Lab randomises by
  +-5 kg, severity 0.24), walker 11.4, car 1.5. Target: trunk, the only one. Owns `mj.body_mass`,
  `mj.body_inertia`, or `task.mass`, `task.inertia` where there is no MuJoCo model. Source: payloads
  of Isaac Lab (ANYmal-C, +-5 kg) and Walk These Ways.
  """
  if "mass" in env.model.task:
    grown = lambda value, row, severity: value * (1.0 + 0.4 * severity)
    return leafwise(
      "payload", env, {"task.mass": grown, "task.inertia": grown}, (("trunk",), None, None)
    )
  _bodies(env, "payload")
  mass = np.asarray(env.mj_model.body_mass)
  trunk = np.arange(mass.size) == env.spec.bodies[0][1][0]
  share = float(mass.sum() / mass[trunk][0])
  grown = _heavier(lambda row, severity: jnp.where(trunk, 1.0 + 0.4 * severity * share, 1.0))
  return leafwise("payload", env, dict.fromkeys(MASSES, grown), (("trunk",), None, None))


def com(env: Any) -> Fault:
  """The trunk's centre of mass moves.

    r' = r + 0.5 severity g e,   g = sqrt(trace(I) / (2 m)) radius of gyration, e the direction

  The walker's reward still takes the nominal place (walker.center_x).

  Severity: 1 moves it by half the radius of gyration [m]: quadruped 0.13 (Loquercio et al. 2022
  train with 0.1), walker 0.10. Target: a direction (drawn), forward, backward, left, right, up,
  down as far as the robot can move there. Owns `mj.body_ipos`. Source: shifts of the trunk's centre
  of mass in Isaac Lab and Loquercio et al. 2022.
  """
  _bodies(env, "com")
  model, trunk = env.mj_model, int(env.spec.bodies[0][1][0])
  gyration = float(np.sqrt(model.body_inertia[trunk].sum() / 2 / model.body_mass[trunk]))
  names, directions = heading_targets(env, ("forward", "backward", "left", "right", "up", "down"))
  of_trunk = (jnp.arange(model.nbody) == trunk)[:, None]
  moved = lambda value, direction, severity: (
    value + jnp.where(of_trunk, 0.5 * severity * gyration * direction, 0.0)
  )
  return leafwise("com", env, {"mj.body_ipos": moved}, (names, directions, None))


def limb_mass(env: Any) -> Fault:
  """A limb grows heavier (mud, ice), its inertia with it.   m_b' = m_b (1 + 2 severity)

  Severity: 1 triples the mass [kg], the upper end of Nagabandi et al.'s arm. Target: a body other
  than the trunk (drawn). Owns `mj.body_mass`, `mj.body_inertia`. Source: Nagabandi et al. 2019.
  """
  names, mask = _bodies(env, "limb_mass")
  grown = _heavier(lambda hit, severity: jnp.where(hit, 1.0 + 2.0 * severity, 1.0))
  return leafwise("limb_mass", env, dict.fromkeys(MASSES, grown), (names[1:], mask[1:], None))


def joint_damping(env: Any) -> Fault:
  """A joint grows stiff in motion.   damping_j' = damping_j + 10 severity [N m s/rad]

  Severity: 1 adds 10 [N m s/rad], the upper end of realworldrl_suite's walker (nominal 0.1).
  Target: a joint (drawn), a leg or all. Owns `mj.dof_damping`. Source: realworldrl_suite.
  """
  names, mask, single = actuator_targets(env)
  return leafwise(
    "joint_damping",
    env,
    {"mj.dof_damping": lambda value, hit, severity: value + 10.0 * severity * hit},
    (names, mask.astype(jnp.float32) @ dofs(env, "joint_damping"), single),
  )


def joint_friction(env: Any) -> Fault:
  """Dry friction in a joint.   frictionloss_j' = frictionloss_j + 0.25 severity tau_j [N m]

  Severity: 1 adds a quarter of the motor's greatest torque tau_j [N m]. Target: a joint (drawn), a
  leg or all. Owns `mj.dof_frictionloss`. MJX builds no friction constraint for a model that has
  none and refuses it there; C MuJoCo (physics native) does. Source: MuJoCo Playground varies the
  Go1's by a tenth; the range is this project's own choice.
  """
  names, mask, single = actuator_targets(env)
  which = dofs(env, "joint_friction")
  model = env.mj_model
  gain, gear = model.actuator_gainprm[:, 0], model.actuator_gear[:, 0]
  motor = model.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE
  told = np.where(motor, np.abs(gain) * np.abs(model.actuator_ctrlrange).max(1), 0.0)
  limit = np.abs(model.actuator_forcerange).max(1)
  most = np.where(model.actuator_forcelimited.astype(bool), limit, told)
  torque = np.abs(gear * most).astype(np.float32)
  if not (torque > 0).all():
    raise UserError(
      "fault 'joint_friction' needs motors with a greatest torque (ctrlrange of a motor, or "
      f"forcerange), which robot {env.spec.name!r} does not state"
    )
  physics = getattr(getattr(env, "physics", None), "name", None)  # a robot in pure JAX has none
  if physics == "mjx" and not (model.dof_frictionloss[which.any(0)] > 0).all():
    raise UserError(
      "fault 'joint_friction': MJX builds no friction constraint for a joint that has none, so it "
      "would do nothing there; choose physics native"
    )
  return leafwise(
    "joint_friction",
    env,
    {"mj.dof_frictionloss": lambda value, most, severity: value + 0.25 * severity * most},
    (names, (mask * torque) @ which, single),
  )


def range_loss(env: Any) -> Fault:
  """A joint's range shrinks towards the angle at which the robot stands.   low' = low + 0.95
    severity (q0 - low), high alike

  Severity: 1 leaves 5 % of the range [rad]. Target: a joint (drawn), a leg or all; every joint
  needs limits. Owns `mj.jnt_range`. Not visible to: a gait that does not come near the limits.
  Source: none; fault and range are this project's own choice.
  """
  names, mask, single = actuator_targets(env)
  dofs(env, "range_loss")  # which refuses a robot without one motor per joint
  model = env.mj_model
  joints = model.actuator_trnid[:, 0]
  free = [name for name, has in zip(env.spec.targets, model.jnt_limited[joints]) if not has]
  if free:
    raise UserError(
      f"fault 'range_loss' needs joints with limits; these have none in robot {env.spec.name!r}: "
      + ", ".join(free)
    )
  stance = getattr(env, "stance", None)  # joint angles of standing, in actuator order
  stance = model.qpos0[model.jnt_qposadr[joints]] if stance is None else np.asarray(stance)
  middle = np.zeros((model.njnt, 1), np.float32)
  middle[joints, 0] = np.clip(stance, *model.jnt_range[joints].T)
  hits = jnp.zeros((len(names), model.njnt), bool).at[:, joints].set(mask)
  narrower = lambda value, hit, severity: jnp.where(
    hit[:, None], value + 0.95 * severity * (middle - value), value
  )
  return leafwise("range_loss", env, {"mj.jnt_range": narrower}, (names, hits, single))


DIRECTIONS = {
  "forward": (1, 0, 0),
  "backward": (-1, 0, 0),
  "left": (0, 1, 0),
  "right": (0, -1, 0),
  "up": (0, 0, 1),
  "down": (0, 0, -1),
}


def heading_targets(env: Any, names: Iterable[str]) -> tuple[tuple[str, ...], Float[Array, "..."]]:
  """Names and unit vectors of the directions in which the robot's trunk is free to move; UserError
  where it is in none.
  """
  free = np.abs(force_map(env)).sum(1) > 0
  kept = [n for n in names if free[np.flatnonzero(DIRECTIONS[n])[0]]]
  if not kept:
    raise UserError(f"robot {env.spec.name!r} has no trunk that is free to move")
  return tuple(kept), jnp.asarray([DIRECTIONS[n] for n in kept], jnp.float32)


def force_map(env: Any) -> Float[np.ndarray, "3 nv"]:
  """A force F (world axes) [N] on the trunk is the generalised force F @ map.

  The trunk's slide joints, or the translations of its free joint (the force then acts at the body's
  origin). Without a MuJoCo model the force's first two entries are along x and y of the world.
  """
  model = getattr(env, "mj_model", None)
  if model is None:
    size = 0 if env.model.force is None else env.model.force.shape[0]
    return np.eye(3, size, dtype=np.float32) * np.array([[1], [1], [0]], np.float32)
  out, data = np.zeros((3, model.nv), np.float32), mujoco.MjData(model)
  mujoco.mj_kinematics(model, data)  # at qpos0; an axis of a model is the body's own
  trunk = int(env.spec.bodies[0][1][0]) if env.spec.bodies else 1
  for j in range(model.body_jntadr[trunk], model.body_jntadr[trunk] + model.body_jntnum[trunk]):
    at = model.jnt_dofadr[j]
    if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:
      out[:, at : at + 3] = np.eye(3)
    elif model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE:
      out[:, at] = data.xaxis[j].round(9)  # a turn by 90 degrees is one
  return out


BODY = {
  "payload": payload,
  "com": com,
  "limb_mass": limb_mass,
  "joint_damping": joint_damping,
  "joint_friction": joint_friction,
  "range_loss": range_loss,
}
