"""The quadruped's reference driver: a trot of a robot that knows its state.

A clock moves diagonal feet together. A foot on the ground passes under the body at the commanded
velocity; one in the air goes to where it will stand halfway (M. Raibert, Legged Robots That
Balance, MIT Press 1986, chapter 2). Feet on the ground carry the weight and right the body with
forces that the joints give through the Jacobian's transpose (virtual model control: J. Pratt et
al., Int. J. Robotics Research 20(2), 2001). The motors' PD controllers are told angles that come
to these torques.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from mjx_cl.envs import anymal
from mjx_cl.types import Array

CONTROL_S, MASS, GRAVITY = 0.02, 52.135, 9.81  # [s], [kg], [m/s2]
STILL = 0.05  # a slower command is one to stand
CLOCK = (0.0, 0.5, 0.5, 0.0)  # of LF, RF, LH, RH [periods]


class Gait(NamedTuple):
  """A trot's constants; found by the cross-entropy method (Rubinstein 1999) on the task's reward,
  height and trot of healthy robots, seeds from 100 on.

  Attributes:
    period: of a stride [s].
    duty: share of it that a foot stands.
    lift: of a foot in the air [m].
    height: of the base [m].
    fore: feet ahead (front) and behind (hind) of the hip's link [m].
    boost: steps for each of v_x, v_y, w_z commanded.
    land: a foot lands so much further for each m/s that the robot is too fast [s].
    hold: a standing foot is asked so much further alike [s].
    ramp: share of its stance after which a foot carries its part.
    rise: of the height [1/s2].
    fall: of the vertical velocity [1/s].
    level: of roll and pitch [m/s2].
    still: of their rates [m/s].
    push: of the velocity [1/s].
    bear: share of the forces that the motors are told.
    smooth: share of the last action that stays.
  """

  period: float = 0.477
  duty: float = 0.589
  lift: float = 0.09
  height: float = 0.507
  fore: float = 0.034
  boost: tuple[float, float, float] = (1.033, 1.039, 1.202)
  land: float = 0.041
  hold: float = 0.088
  ramp: float = 0.078
  rise: float = 24.5
  fall: float = 8.61
  level: float = 8.06
  still: float = 1.58
  push: float = 2.86
  bear: float = 1.068
  smooth: float = 0.361


GAIT = Gait()


def angles(foot: Float[Array, "4 3"]) -> Float[Array, "4 3"]:
  """Joint angles HAA, HFE, KFE [rad] that bring the feet's centres to `foot` [m], in the base's
  frame; knees bend as in the stance. The inverse of `reach`; what is out of reach is approached.
  """
  side_x, side_y = jnp.asarray(anymal.SIDES.T)
  upper, lower = -anymal.SHANK[2], (anymal.FOOT[0] ** 2 + anymal.FOOT[2] ** 2) ** 0.5
  bent = jnp.arctan2(-anymal.FOOT[0] * side_x, -anymal.FOOT[2])
  across = side_y * (anymal.THIGH[1] + anymal.SHANK[1] + anymal.FOOT[1])
  x = foot[:, 0] - side_x * (anymal.HIP[0] + anymal.THIGH[0])
  y, z = foot[:, 1] - side_y * anymal.HIP[1], foot[:, 2]
  deep = jnp.sqrt(jnp.maximum(y**2 + z**2 - across**2, 0.1**2))
  roll = jnp.arctan2(z, y) - jnp.arctan2(-deep, across)
  bend = (x**2 + deep**2 - upper**2 - lower**2) / (2 * upper * lower)
  bend = -side_x * jnp.arccos(jnp.clip(bend, -1.0, 0.999))
  pitch = jnp.arctan2(-x, deep) - jnp.arctan2(lower * jnp.sin(bend), upper + lower * jnp.cos(bend))
  return jnp.stack([jnp.arctan2(jnp.sin(roll), jnp.cos(roll)), pitch, bend - bent], -1)


def reach(joints: Float[Array, "4 3"]) -> Float[Array, "4 3"]:
  """Centres of the feet [m] in the base's frame, of joint angles [rad]."""
  at_origin = jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
  return anymal.leg_points(jnp.concatenate([at_origin, joints.reshape(-1)]))[0]


def action(
  step: Array,
  qpos: Float[Array, "19"],
  qvel: Float[Array, "18"],
  command: Float[Array, "3"],
  last: Float[Array, "12"],
  gait: Gait = GAIT,
) -> Float[Array, "12"]:
  """Action in [-1, 1] (target angle less stance [rad]) at control step `step` of an episode.

  Args:
    step: int32 ().
    qpos: of the robot.
    qvel: of the robot.
    command: v_x, v_y [m/s], yaw rate [rad/s].
    last: the last action.
    gait: constants.
  """
  turn = anymal.rotation(qpos[3:7])
  yaw = jnp.arctan2(turn[1, 0], turn[0, 0])
  c, s = jnp.cos(yaw), jnp.sin(yaw)
  flat = jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])  # level frame to world
  level = turn.T @ flat  # level frame to base
  velocity, rate = flat.T @ qvel[:3], level.T @ qvel[3:6]
  too_fast = (velocity - command) * jnp.array([1.0, 1.0, 0.0])

  # where the clock has each foot
  moving = jnp.sum(command**2) > STILL**2
  phase = jnp.mod(step * CONTROL_S / gait.period + jnp.array(CLOCK), 1.0)
  stands = (phase < gait.duty) | ~moving
  stood, swung = phase / gait.duty, (phase - gait.duty) / (1 - gait.duty)
  side_x, side_y = jnp.asarray(anymal.SIDES.T)
  home = jnp.stack(
    [
      side_x * (anymal.HIP[0] + anymal.THIGH[0] + gait.fore),
      side_y * (anymal.HIP[1] + anymal.THIGH[1] + anymal.SHANK[1] + anymal.FOOT[1]),
      jnp.zeros(4),
    ],
    -1,
  )
  asked = command * jnp.asarray(gait.boost)
  under = jnp.stack(
    [asked[0] - asked[2] * home[:, 1], asked[1] + asked[2] * home[:, 0], jnp.zeros(4)], -1
  )
  stride = under * gait.period * gait.duty
  standing = home + stride * (0.5 - stood)[:, None] * moving + gait.hold * too_fast
  along = (1 - jnp.cos(jnp.pi * swung)) / 2
  swinging = home + stride * (along - 0.5)[:, None] + gait.land * too_fast * along[:, None]
  lifted = jnp.where(stands, 0.0, gait.lift * jnp.sin(jnp.pi * jnp.clip(swung, 0.0, 1.0)))
  foot = jnp.where(stands[:, None], standing, swinging)
  foot = foot.at[:, 2].set(anymal.FOOT_RADIUS - gait.height + lifted)
  target = angles(foot @ level.T)

  # what the standing feet carry
  joints = qpos[7:].reshape(4, 3)
  weight = jnp.clip(jnp.minimum(stood, 1 - stood) / gait.ramp, 0.0, 1.0)
  weight = jnp.where(moving, jnp.where(stands, weight, 0.0), 1.0) + 1e-3
  share = weight / jnp.sum(weight)
  at, up = reach(joints) @ level, flat.T @ turn[:, 2]
  total = GRAVITY + gait.rise * (gait.height - qpos[2]) - gait.fall * velocity[2]
  rolling = gait.level * up[1] - gait.still * rate[0]
  pitching = -gait.level * up[0] - gait.still * rate[1]
  lean = rolling * at[:, 1] / jnp.sum(share * at[:, 1] ** 2)
  lean -= pitching * at[:, 0] / jnp.sum(share * at[:, 0] ** 2)
  push = jnp.tile(-gait.push * too_fast, (4, 1))
  force = push.at[:, 2].set(jnp.maximum(total + lean, 0.0))
  force = MASS * share[:, None] * force @ level.T
  slopes = jax.jacfwd(reach)(joints)[jnp.arange(4), :, jnp.arange(4)]  # (leg, xyz, joint)
  torque = -jnp.einsum("lxj,lx->lj", slopes, force)
  target += gait.bear * torque / anymal.STIFFNESS
  new = jnp.clip(target.reshape(-1) - anymal.DEFAULT, -1.0, 1.0)
  return new + gait.smooth * (last - new)
