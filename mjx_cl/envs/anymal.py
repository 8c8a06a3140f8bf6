"""The quadruped's body: an ANYmal-C (52 kg, 12 motors), its motors and its kinematics.

Joint order is leg by leg (LF, RF, LH, RH x HAA, HFE, KFE), the order of the MuJoCo tree. Motors are
PD controllers under a DC motor's torque-speed line. Each joint carries 0.1 kg m2 of motor inertia
(MuJoCo Playground's figure for Spot; none is published for this robot), without which a shank of
0.016 kg m2 gains 25 rad/s in one physics step of 80 N m, and the torque-speed line, an explicit
damper of 16 N m s/rad, swings it for ever. Joints have no dry friction (as in the robot's
description), so MJX, which decides at compile time, refuses a fault of `dof_frictionloss`.
"""

import importlib.resources
import types
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

LEGS = ("LF", "RF", "LH", "RH")
JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("HAA", "HFE", "KFE"))
DEFAULT = np.array([0, 0.4, -0.8] * 2 + [0, -0.4, 0.8] * 2, np.float32)  # stance [rad]
STIFFNESS, DAMPING = 80.0, 5.0  # [N m/rad], [N m s/rad]
SATURATION = 120.0  # torque at standstill that the voltage would allow [N m]
EFFORT = 80.0  # limit of torque [N m]
VELOCITY = 7.5  # no torque beyond [rad/s]
ARMATURE = 0.1  # inertia of a motor, seen at the joint; as in quadruped.xml [kg m2]
PHYSICS_S = 0.005

# lengths in base-parallel frames [m]; sides (4, 2): +1 front / -1 hind, +1 left / -1 right
SIDES = np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)], np.float32)
# HAA in base, HFE in hip, KFE in thigh
HIP, THIGH, SHANK = (0.2999, 0.104, 0.0), (0.0599, 0.08381, 0.0), (0.0, 0.1003, -0.285)
FOOT, FOOT_RADIUS = (0.08795, 0.01305, -0.31547), 0.03  # centre in shank
KNEE, KNEE_RADIUS = (0.0, 0.08, -0.285), 0.06  # centre in thigh
TOUCH = 0.001  # a gap up to this counts as contact [m]
# cylinders of the base: centre, axis (0 x, 2 z), half length, radius
TRUNK = (
  ((0.0, 0.07, 0.0), 0, 0.5245, 0.09),
  ((0.0, -0.07, 0.0), 0, 0.5245, 0.09),
  ((-0.364, 0.0, 0.1335), 2, 0.06, 0.07),
)


def load_model() -> mujoco.MjModel:
  """The robot as mujoco.MjModel: 52.135 kg, free base, 12 torque motors of gear 1 [N m], physics
  step 0.005 s.
  """
  return mujoco.MjModel.from_xml_string(
    importlib.resources.files("mjx_cl.envs").joinpath("assets/quadruped.xml").read_text()
  )


def motor_law(xp: types.ModuleType, task: dict[str, Any], ctrl: Any, qpos: Any, qvel: Any) -> Any:
  """Torques [N m] (..., 12); see physics for who calls it.

    tau  = strength clip(80 (ctrl - q) - 5 qd, -most(v + qd), most(v - qd))
    most(x) = clip(max(120 x / v, min(20 x, 0)), -80, 80)

  most(x) is the torque that the motor can give where x rad/s are left until its limit: 80 N m up to
  v / 3, then falling to 0 at v and on to -80 N m: beyond the limit it brakes, no harder than stops
  the motor's inertia at the limit in one physics step (20 = armature / physics step [N m s/rad]),
  which matters for v < 6 rad/s: the line is then too steep for a step of 5 ms. `strength` comes
  after the clip: a weak motor gives less also where the controller asks for more than there is.

  Args:
    xp: numpy or jax.numpy.
    task: `strength` (12,), 1 nominal, and `velocity_limit` v (12,) [rad/s].
    ctrl: target angles (..., 12) [rad].
    qpos: (..., 19).
    qvel: (..., 18).
  """
  q, speed, limit = qpos[..., 7:], qvel[..., 6:], task["velocity_limit"]
  wanted = STIFFNESS * (ctrl - q) - DAMPING * speed
  stop = ARMATURE / PHYSICS_S
  most = lambda left: xp.clip(
    xp.maximum(SATURATION * left / limit, xp.minimum(stop * left, 0.0)), -EFFORT, EFFORT
  )
  return task["strength"] * xp.clip(wanted, -most(limit + speed), most(limit - speed))


# ---- kinematics ----------------------------------------------------------------------------------


def rotation(quat: jax.Array) -> jax.Array:
  """Rotation matrix (3, 3), body to world, of a quaternion (w, x, y, z) of any length."""
  w, x, y, z = quat / jnp.linalg.norm(quat)
  return jnp.stack(
    [
      1 - 2 * (y * y + z * z),
      2 * (x * y - w * z),
      2 * (x * z + w * y),
      2 * (x * y + w * z),
      1 - 2 * (x * x + z * z),
      2 * (y * z - w * x),
      2 * (x * z - w * y),
      2 * (y * z + w * x),
      1 - 2 * (x * x + y * y),
    ]
  ).reshape(3, 3)


def leg_points(qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
  """Centres of the four foot and the four knee spheres in the world, (4, 3) each [m].

  In the base, with roll a, pitch b, knee c and lengths mirrored per leg:
    knee = HIP + Rx(a) (THIGH + Ry(b) KNEE),   foot = HIP + Rx(a) (THIGH + Ry(b) (SHANK + Ry(c)
      FOOT))
  """
  a, b, c = qpos[7:].reshape(4, 3).T
  mirror = lambda offset: jnp.stack(
    [SIDES[:, 0] * offset[0], SIDES[:, 1] * offset[1], jnp.full(4, offset[2])], -1
  )
  about_x = lambda t, p: jnp.stack(
    [
      p[:, 0],
      jnp.cos(t) * p[:, 1] - jnp.sin(t) * p[:, 2],
      jnp.sin(t) * p[:, 1] + jnp.cos(t) * p[:, 2],
    ],
    -1,
  )
  about_y = lambda t, p: jnp.stack(
    [
      jnp.cos(t) * p[:, 0] + jnp.sin(t) * p[:, 2],
      p[:, 1],
      jnp.cos(t) * p[:, 2] - jnp.sin(t) * p[:, 0],
    ],
    -1,
  )
  knee = mirror(HIP) + about_x(a, mirror(THIGH) + about_y(b, mirror(KNEE)))
  foot = mirror(HIP) + about_x(
    a, mirror(THIGH) + about_y(b, mirror(SHANK) + about_y(c, mirror(FOOT)))
  )
  turn = rotation(qpos[3:7])
  world = lambda p: (
    qpos[:3] + jnp.sum(turn * p[:, None, :], -1)
  )  # no dot: XLA may round it otherwise in a batch
  return world(foot), world(knee)


def trunk_height(qpos: jax.Array) -> jax.Array:
  """Height of the base's lowest point above the ground [m], (): over its cylinders, z - half |u_z|
  - radius sqrt(1 - u_z^2), u the axis.
  """
  turn = rotation(qpos[3:7])
  heights = []
  for center, axis, half, radius in TRUNK:
    z = qpos[2] + jnp.sum(turn[2] * jnp.asarray(center))
    heights.append(
      z
      - half * jnp.abs(turn[2, axis])
      - radius * jnp.sqrt(jnp.maximum(1.0 - turn[2, axis] ** 2, 0.0))
    )
  return jnp.min(jnp.stack(heights))


def base_motion(
  qpos: jax.Array, qvel: jax.Array, gravity: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
  """Linear velocity of the base's origin [m/s], angular velocity [rad/s] and direction of gravity,
  (3,) each, in the base's frame.

  MuJoCo's free joint has the linear velocity in the world's frame and the angular velocity in the
  body's.
  """
  turn = rotation(qpos[3:7])
  return (
    jnp.sum(turn * qvel[:3, None], 0),
    qvel[3:6],
    jnp.sum(turn * (gravity / jnp.maximum(jnp.linalg.norm(gravity), 1e-6))[:, None], 0),
  )
