"""Quadruped: an ANYmal-C (52 kg, 12 motors) follows velocity commands on flat ground.

The task is Isaac Lab's flat velocity task for ANYmal-C, `Isaac-Velocity-Flat-Anymal-C-v0`:
observation, noise, rewards, commands, resets and the DC-motor clip have its figures. What differs,
and why:

  Joint order is leg by leg (LF, RF, LH, RH x HAA, HFE, KFE), the order of the MuJoCo tree; Isaac's
  goes by joint type. Motors: PD with 80 N m/rad (legged_gym's for a robot without its actuator net)
  and 5 N m s/rad (Isaac's). Isaac's 40 N m/rad lets the knees
    sag twice as far.
  Each joint carries 0.1 kg m2 of motor inertia (MuJoCo Playground's figure for Spot; none is
  published for this robot). Without it a shank of
    0.016 kg m2 gains 25 rad/s in one physics step of 80 N m, and the torque-speed line, an explicit
    damper of 16 N m s/rad, makes it swing for ever between +-15 rad/s.
  Beyond a lowered velocity limit (under 6 rad/s) a motor brakes no harder than stops that inertia
  at the limit in one physics step: the line is
    then too steep for a step of 5 ms.
  Actions are clipped to [-1, 1] and mean 1 rad; Isaac's are unbounded and mean 0.5 rad. Within
  +-0.5 rad the motors could give only 1.5 times the
    25 N m with which a knee carries a quarter of the robot, too little for two legs on the ground
    or a weak motor. The action-rate penalty counts in Isaac's units.
  Reward is divided by 1.5, the greatest that tracking can earn, and not multiplied by the control
  period: 1 per step is perfect tracking. Contact means that a shape is within 1 mm of the ground,
  from kinematics at the end of the control step; Isaac thresholds a force at 1 N. The
    base is two cylinders and the lidar's cage. An undesired contact is a knee (thigh's lower end
    with its drive); Isaac's is any part of the thigh.
  Self-collision is off. One friction of 0.8 stands for Isaac's 0.8 static and 0.6 dynamic.
  Nothing is randomised but the start, the command and the noise: the nominal robot is one fixed
  robot, and mass, centre of mass, friction and
    pushes change by a fault only.
  Velocity of the base is that of its frame's origin, 2 cm from its centre of mass.
  Joints have no dry friction (as in the robot's description), so MJX, which decides at compile
  time, refuses a fault of `dof_frictionloss`.
"""

from __future__ import annotations

import importlib.resources
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_cl import physics as physics_lib
from mjx_cl.types import EnvState, Model, Spec, Step, Var

if TYPE_CHECKING:
  import types

LEGS = ("LF", "RF", "LH", "RH")
JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("HAA", "HFE", "KFE"))
DEFAULT = np.array([0, 0.4, -0.8] * 2 + [0, -0.4, 0.8] * 2, np.float32)  # stance [rad]
ACTION_SCALE, ISAAC_SCALE = 1.0, 0.5  # [rad] of an action of 1, here and in Isaac Lab
STIFFNESS, DAMPING = 80.0, 5.0  # [N m/rad], [N m s/rad]
SATURATION = 120.0  # torque at standstill that the voltage would allow [N m]
EFFORT = 80.0  # limit of torque [N m]
VELOCITY = 7.5  # no torque beyond [rad/s]
ARMATURE = 0.1  # inertia of a motor, seen at the joint; as in quadruped.xml [kg m2]
CONTROL_S, PHYSICS_S, SUBSTEPS = 0.02, 0.005, 4
EPISODE_STEPS, RESAMPLE_STEPS = 1000, 500  # 20 s; a new command every 10 s
STANDING = 0.02  # share of commands to stand
HEADING_GAIN = 0.5  # [1/s]
AIR_TIME = 0.5  # a swing that lasts longer is rewarded [s]
REWARD_SCALE = 1.5  # greatest weighted sum of the two tracking terms
SOFT_LIMIT = 0.95  # share of a joint's range that is free of penalty

# reward terms: name, weight before the division by REWARD_SCALE
REWARDS = (
  ("track_velocity", 1.0),
  ("track_yaw_rate", 0.5),
  ("vertical_velocity", -2.0),
  ("roll_pitch_rate", -0.05),
  ("torque", -2.5e-5),
  ("joint_acceleration", -2.5e-7),
  ("action_rate", -0.01),
  ("air_time", 0.5),
  ("knee_contacts", -1.0),
  ("tilt", -5.0),
  ("joint_limits", 0.0),
)

# observation: group, channels, unit, half width of the uniform noise, typical deviation of a
# channel (64 robots of a PPO policy that tracks to 0.45 m/s)
OBSERVATION = (
  ("base_lin_vel", ("x", "y", "z"), "m/s", 0.1, 0.3),
  ("base_ang_vel", ("x", "y", "z"), "rad/s", 0.2, 0.35),
  ("projected_gravity", ("x", "y", "z"), "1", 0.05, 0.05),
  ("command", ("vx", "vy", "wz"), "m/s", 0.0, 0.5),
  ("joint_pos", JOINTS, "rad", 0.01, 0.2),
  ("joint_vel", JOINTS, "rad/s", 1.5, 2.0),
  ("last_action", JOINTS, "1", 0.0, 0.35),
)
NOISE = np.concatenate(
  [np.full(len(names), noise) for _, names, _, noise, _ in OBSERVATION]
).astype(np.float32)

# lengths in base-parallel frames [m]; sides (4, 2): +1 front / -1 hind, +1 left / -1 right
SIDES = np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)], np.float32)
HIP, THIGH, SHANK = (
  (0.2999, 0.104, 0.0),
  (0.0599, 0.08381, 0.0),
  (0.0, 0.1003, -0.285),
)  # HAA in base, HFE in hip, KFE in thigh
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


class Command(NamedTuple):
  """What a command is made of; the draw is kept, not the command, so that a change of the command's
  range acts at once and cannot compound.

  Attributes:
    share: float32 (2,), in [0, 1), place of v_x and v_y in their ranges.
    heading: float32 (), direction to face, world frame [rad].
    standing: bool (), stand still.
  """

  share: jax.Array
  heading: jax.Array
  standing: jax.Array


class QuadrupedState(NamedTuple):
  """State of one robot.

  Attributes:
    backend: state of the physics backend, opaque.
    qpos: float32 (19,), at the end of the control step.
    qvel: float32 (18,), at the end of the control step.
    torque: float32 (12,), of the last physics step [N m].
    action: float32 (12,), the last one.
    draw: Command in force.
    command: float32 (3,), v_x, v_y [m/s], yaw rate [rad/s], as observed.
    air: float32 (4,), time that each foot has been off the ground [s].
    velocity_error: float32 (), |v_xy - commanded v_xy| when arriving here, body frame [m/s].
    fallen: bool (), the base has touched the ground.
    key: uint32 (2,), raw key data (a typed key would not survive `jnp.where`).
  """

  backend: Any
  qpos: jax.Array
  qvel: jax.Array
  torque: jax.Array
  action: jax.Array
  draw: Command
  command: jax.Array
  air: jax.Array
  velocity_error: jax.Array
  fallen: jax.Array
  key: jax.Array


# ---- motors --------------------------------------------------------------------------------------


def motor_law(xp: types.ModuleType, task: dict[str, Any], ctrl: Any, qpos: Any, qvel: Any) -> Any:
  """Torques [N m] (..., 12) for target angles `ctrl` [rad] (..., 12); see physics for who calls it.

    tau  = strength clip(80 (ctrl - q) - 5 qd, -most(v + qd), most(v - qd))
      strength (12,), 1 nominal
    most(x) = clip(max(120 x / v, min(20 x, 0)), -80, 80)                                     v =
      velocity_limit (12,) [rad/s]

  most(x) is the torque that the motor can give where x rad/s are left until its limit: 80 N m up to
  v / 3, then falling to 0 at v and on to
  -80 N m: beyond the limit it brakes. 20 = armature / physics step [N m s/rad] bounds the braking;
  it matters for v < 6 rad/s only.

  `strength` comes after the clip: a weak motor gives less also where the controller asks for more
  than there is.
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


# ---- command -------------------------------------------------------------------------------------


def draw_command(key: jax.Array) -> Command:
  """v_x and v_y uniform in their ranges, heading uniform in (-pi, pi), 2 % to stand."""
  key_share, key_heading, key_standing = jax.random.split(key, 3)
  return Command(
    jax.random.uniform(key_share, (2,)),
    jax.random.uniform(key_heading, (), minval=-jnp.pi, maxval=jnp.pi),
    jax.random.uniform(key_standing) < STANDING,
  )


def command_of(task: dict[str, jax.Array], draw: Command, qpos: jax.Array) -> jax.Array:
  """Command (3,): v_x, v_y [m/s] in the base's frame, yaw rate [rad/s].

  v = low + share (high - low),   w_z = clip(0.5 wrap(heading - yaw), low_z, high_z),   all 0 where
    standing
  """
  low, high = task["command_range"]
  velocity = low[:2] + draw.share * (high[:2] - low[:2])
  turn = rotation(qpos[3:7])
  error = draw.heading - jnp.arctan2(turn[1, 0], turn[0, 0])
  error = jnp.arctan2(jnp.sin(error), jnp.cos(error))
  rate = jnp.clip(HEADING_GAIN * error, low[2], high[2])
  return jnp.where(draw.standing, 0.0, jnp.concatenate([velocity, rate[None]]))


# ---- observation and reward ----------------------------------------------------------------------


def observe(
  qpos: jax.Array, qvel: jax.Array, gravity: jax.Array, command: jax.Array, action: jax.Array
) -> jax.Array:
  """Observation without noise, float32 (48,), in the order of OBSERVATION; joint angles from the
  stance.
  """
  linear, angular, down = base_motion(qpos, qvel, gravity)
  return jnp.concatenate([linear, angular, down, command, qpos[7:] - DEFAULT, qvel[6:], action])


def reward_terms(
  before: QuadrupedState,
  action: jax.Array,
  qpos: jax.Array,
  qvel: jax.Array,
  gravity: jax.Array,
  acceleration: jax.Array,
  torque: jax.Array,
  soft_range: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
  """Unweighted terms of the reward for arriving at (qpos, qvel).

    track_velocity    exp(-|v_xy - command|^2 / 0.25)          vertical_velocity   v_z^2
      all velocities in the base's frame
    track_yaw_rate    exp(-(w_z - command)^2 / 0.25)           roll_pitch_rate     w_x^2 + w_y^2
    torque            sum tau^2                                joint_acceleration  sum qdd^2
      of the last physics step
    action_rate       sum (a - last a)^2, a of 0.5 rad          air_time            sum over feet
      that touch down of (time in the air - 0.5 s),
    knee_contacts     number of knees at or below the ground                       only where the
      commanded |v_xy| > 0.1 m/s
    tilt              g_x^2 + g_y^2, g = gravity's direction   joint_limits        sum of rad beyond
      95 % of the range

  Args:
    before: state that was left; its `command` is what the agent saw.
    action: (12,), of this step.
    qpos: (19,), on arriving.
    qvel: (18,), on arriving.
    gravity: (3,) [m/s2].
    acceleration: (12,) [rad/s2].
    torque: (12,) [N m].
    soft_range: (2, 12) [rad].

  Returns:
    (terms (11,) in the order of REWARDS, air' (4,) [s], |v_xy - command| () [m/s]).
  """
  linear, angular, down = base_motion(qpos, qvel, gravity)
  foot, knee = leg_points(qpos)
  contact = foot[:, 2] <= FOOT_RADIUS + TOUCH
  air = before.air + CONTROL_S
  touchdown = contact & (before.air > 0)
  command = before.command
  moving = jnp.sum(command[:2] ** 2) > 0.1**2
  off = jnp.sum((linear[:2] - command[:2]) ** 2)
  change = ACTION_SCALE / ISAAC_SCALE * (action - before.action)
  q = qpos[7:]
  terms = jnp.stack(
    [
      jnp.exp(-off / 0.25),
      jnp.exp(-((angular[2] - command[2]) ** 2) / 0.25),
      linear[2] ** 2,
      jnp.sum(angular[:2] ** 2),
      jnp.sum(torque**2),
      jnp.sum(acceleration**2),
      jnp.sum(change**2),
      jnp.where(moving, jnp.sum(jnp.where(touchdown, air - AIR_TIME, 0.0)), 0.0),
      jnp.sum((knee[:, 2] <= KNEE_RADIUS + TOUCH).astype(jnp.float32)),
      jnp.sum(down[:2] ** 2),
      jnp.sum(jnp.maximum(soft_range[0] - q, 0.0) + jnp.maximum(q - soft_range[1], 0.0)),
    ]
  )
  return terms, jnp.where(contact, 0.0, air), jnp.sqrt(off)


# ---- task ----------------------------------------------------------------------------------------


def make_spec(mj_model: mujoco.MjModel) -> Spec:
  """Names, units and groups, read from the tables above and the MuJoCo model."""
  obs, groups = [], []  # type: ignore[var-annotated]
  for group, names, unit, noise, scale in OBSERVATION:
    groups.append((group, tuple(range(len(obs), len(obs) + len(names)))))
    bound = {"projected_gravity": 1 + noise, "last_action": 1.0}.get(group, float("inf"))
    obs += [
      Var(f"{group}_{name}", "rad/s" if name == "wz" else unit, -bound, bound, scale)
      for name in names
    ]
  legs = tuple((leg, tuple(range(3 * k, 3 * k + 3))) for k, leg in enumerate(LEGS))
  return Spec(
    name="quadruped",
    obs=tuple(obs),
    act=tuple(Var(j, "1", -1, 1) for j in JOINTS),
    control_s=CONTROL_S,
    episode_steps=EPISODE_STEPS,
    # mean reward per step: one that stands still earns 0.21; the shipped agent earns 0.63, and
    # above 0.50 in 99 % of all stretches of 3,072 steps
    # (healthy, seeds 100 to 109, 0.95 M control steps); perfect tracking without effort would be 1
    acceptance=0.48,
    # upright is a least value of no channel (gravity's z is then -1); a fall ends the episode,
    # standing still earns too little
    posture=None,
    targets=JOINTS,
    act_groups=legs + (("all", tuple(range(12))),),
    obs_groups=tuple(groups),
    feet=tuple((leg, (mj_model.geom(f"{leg}_foot").id,)) for leg in LEGS),
    bodies=tuple((mj_model.body(b).name, (b,)) for b in range(1, mj_model.nbody)),
    watched=tuple(
      (group, at)
      for group, at in groups
      if group in ("base_lin_vel", "base_ang_vel", "projected_gravity", "joint_pos")
    )
    + tuple(
      (f"joint_vel_{leg}", tuple(dict(groups)["joint_vel"][3 * k : 3 * k + 3]))
      for k, leg in enumerate(LEGS)
    ),
  )


class Quadruped:
  """Velocity commands on flat ground. Terminated when the base touches the ground; truncated after
  1,000 control steps of 0.02 s.

  Action (12,) in [-1, 1]: target angle = stance + 1 rad x action, held for 4 physics steps;
  `motor_law` gives the torques. Reset: base at 0.6 m, x and y uniform in +-0.5 m, yaw in +-pi, each
  of its six velocities in +-0.5 (m/s, rad/s); joints at stance x U(0.5, 1.5), at rest. A command
  holds for 10 s. Observation and reward use their own kinematics of qpos and qvel, so they are
  current and equal on both backends.

  `EnvState.physics` is a QuadrupedState; the backend's own state is `state.physics.backend`. Leaves
  of `model`: see __init__. Where gravity is tilted (a slope), the observed direction of gravity and
  the penalty of tilt follow it.
  """

  def __init__(self, physics: str = "auto") -> None:
    self.mj_model = load_model()
    self.physics = physics_lib.make(physics, self.mj_model, substeps=SUBSTEPS, law=motor_law)
    self.spec = make_spec(self.mj_model)
    low, high = self.mj_model.jnt_range[1:].T
    middle, half = (low + high) / 2, SOFT_LIMIT * (high - low) / 2
    self._gravity = jnp.asarray(self.mj_model.opt.gravity, jnp.float32)
    self.stance, self.reward_terms = DEFAULT, tuple(name for name, _ in REWARDS)
    self._soft_range = jnp.asarray([middle - half, middle + half], jnp.float32)
    self.model = Model(
      mj=physics_lib.leaves(
        self.mj_model,
        "body_mass",
        "body_inertia",
        "body_ipos",
        "geom_friction",
        "dof_armature",
        "dof_damping",
        "dof_frictionloss",
        "jnt_range",
        "gravity",
        backend=self.physics,
      ),
      task={
        "strength": jnp.ones(12),
        "velocity_limit": jnp.full(12, VELOCITY, jnp.float32),
        "command_range": jnp.asarray(
          [[-1.0] * 3, [1.0] * 3], jnp.float32
        ),  # least and greatest v_x, v_y [m/s], yaw rate [rad/s]
        "reward_weights": jnp.asarray([weight for _, weight in REWARDS], jnp.float32),
      },
      force=jnp.zeros(self.mj_model.nv),
    )

  def init(self, model: Model, key: jax.Array) -> tuple[EnvState, jax.Array]:
    """A fresh episode drawn from `key`: state and observation (48,)."""
    key_place, key_yaw, key_speed, key_joints, key_command, key_noise, key = jax.random.split(
      key, 7
    )
    place = jax.random.uniform(key_place, (2,), minval=-0.5, maxval=0.5)
    yaw = jax.random.uniform(key_yaw, (), minval=-jnp.pi, maxval=jnp.pi)
    speed = jax.random.uniform(key_speed, (6,), minval=-0.5, maxval=0.5)  # world frame
    joints = DEFAULT * jax.random.uniform(key_joints, (12,), minval=0.5, maxval=1.5)
    zero = jnp.zeros(())
    quat = jnp.stack([jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)])
    qpos = jnp.concatenate([place, jnp.array([0.6]), quat, joints])
    turning = jnp.stack(
      [
        jnp.cos(yaw) * speed[3] + jnp.sin(yaw) * speed[4],
        jnp.cos(yaw) * speed[4] - jnp.sin(yaw) * speed[3],
        speed[5],
      ]
    )
    qvel = jnp.concatenate([speed[:3], turning, jnp.zeros(12)])
    draw, action, gravity = (
      draw_command(key_command),
      jnp.zeros(12),
      model.mj.get("gravity", self._gravity),
    )
    command = command_of(model.task, draw, qpos)
    state = QuadrupedState(
      self.physics.init(qpos, qvel),
      qpos,
      qvel,
      jnp.zeros(12),
      action,
      draw,
      command,
      jnp.zeros(4),
      jnp.float32(0),
      jnp.bool_(False),
      jax.random.key_data(key),
    )
    return EnvState(state, jnp.int32(0)), self._sense(
      key_noise, observe(qpos, qvel, gravity, command, action)
    )

  def step(self, model: Model, state: EnvState, action: jax.Array) -> tuple[EnvState, Step]:
    """One control step with action (12,), clipped to [-1, 1]."""
    before, task = state.physics, model.task
    action = jnp.clip(action, -1.0, 1.0)
    motor = {name: task[name] for name in ("strength", "velocity_limit")}
    inner, out = self.physics.step(
      model.mj,
      before.backend,
      DEFAULT + ACTION_SCALE * action,  # type: ignore[arg-type]
      motor,
      model.force,
    )
    qpos, qvel, gravity = (
      out["qpos"],
      out["qvel"],
      model.mj.get("gravity", self._gravity),
    )  # `rollout` leaves out what no fault owns
    acceleration = (qvel - out["qvel_before"])[6:] / PHYSICS_S
    terms, air, error = reward_terms(
      before, action, qpos, qvel, gravity, acceleration, out["ctrl"], self._soft_range
    )
    reward = jnp.sum(task["reward_weights"] * terms) / REWARD_SCALE
    fallen = ~(trunk_height(qpos) > TOUCH)  # true as well for a state that is no number

    step = state.step + 1
    key_command, key_noise = jax.random.split(
      jax.random.fold_in(jax.random.wrap_key_data(before.key), step)
    )
    renew = step % RESAMPLE_STEPS == 0
    draw = jax.tree.map(
      lambda new, old: jnp.where(renew, new, old), draw_command(key_command), before.draw
    )
    command = command_of(task, draw, qpos)
    after = QuadrupedState(
      inner, qpos, qvel, out["ctrl"], action, draw, command, air, error, fallen, before.key
    )
    obs = self._sense(key_noise, observe(qpos, qvel, gravity, command, action))
    truncated = ~fallen & (step >= self.spec.episode_steps)
    return EnvState(after, step), Step(obs, reward, fallen, truncated, obs)

  # how PPO learns to show the way (demonstrator.py): at first every step costs, and it would learn
  # to fall
  demonstration = {
    "steps": 30_000_000,
    "weights": {"joint_acceleration": 0.2, "torque": 0.5},
    "bonus": 1.2,
    "ppo": {"discounting": 0.99, "entropy_cost": 5e-3, "reward_scaling": 1.0},
  }
  termination_rate = "fall_rate"  # what the share of terminated episodes is called

  def measure(self, state: EnvState) -> dict[str, jax.Array]:
    """The task's own figures on arriving at `state`, from the true state, float32 () each.

    velocity_error_m_s: |v_xy - commanded v_xy|; its mean over steps is `eval`'s figure.
    """
    return {"velocity_error_m_s": state.physics.velocity_error}

  def noiseless(self, model: Model, state: EnvState) -> jax.Array:
    """The observation (48,) at `state` without its noise: what a demonstrator is shown."""
    p = state.physics
    return observe(p.qpos, p.qvel, model.mj.get("gravity", self._gravity), p.command, p.action)

  def _sense(self, key: jax.Array, obs: jax.Array) -> jax.Array:
    return obs + NOISE * jax.random.uniform(key, obs.shape, minval=-1.0, maxval=1.0)
