"""Quadruped: an ANYmal-C follows velocity commands on flat ground.

The task is Isaac Lab's flat velocity task for ANYmal-C, `Isaac-Velocity-Flat-Anymal-C-v0`:
observation, noise, rewards, commands, resets and the DC-motor clip have its figures. What differs,
and why:

  Joints are in the order of the MuJoCo tree (`anymal`); Isaac's go by joint type.
  Motors: PD with 80 N m/rad (legged_gym's for a robot without its actuator net) and 5 N m s/rad
    (Isaac's); with Isaac's 40 N m/rad the knees sag twice as far. Motor inertia and what bounds
    a motor's braking: `anymal`.
  Actions are clipped to [-1, 1] and mean 1 rad; Isaac's are unbounded and mean 0.5 rad. Within
    +-0.5 rad the motors could give only 1.5 times the 25 N m with which a knee carries a quarter of
    the robot, too little for two legs on the ground or a weak motor. The action-rate penalty counts
    in Isaac's units.
  Reward is divided by 1.5, the greatest that tracking can earn, and not multiplied by the control
    period: 1 per step is perfect tracking.
  Contact means that a shape is within 1 mm of the ground, from kinematics at the end of the control
    step; Isaac thresholds a force at 1 N. The base is two cylinders and the lidar's cage. An
    undesired contact is a knee (thigh's lower end with its drive), in Isaac any part of the thigh.
  Self-collision is off. One friction of 0.8 stands for Isaac's 0.8 static and 0.6 dynamic.
  Nothing is randomised but the start, the command and the noise: the nominal robot is one fixed
    robot, and mass, centre of mass, friction and pushes change by a fault only.
  Velocity of the base is that of its frame's origin, 2 cm from its centre of mass.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_cl import physics as physics_lib
from mjx_cl.envs import anymal, trot
from mjx_cl.types import EnvState, Model, Spec, Step, Var

ACTION_SCALE, ISAAC_SCALE = 1.0, 0.5  # [rad] of an action of 1, here and in Isaac Lab
CONTROL_S, SUBSTEPS = 0.02, 4  # [s], physics steps in it
EPISODE_STEPS, RESAMPLE_STEPS = 1000, 500  # 20 s; a new command every 10 s
STANDING = 0.02  # share of commands to stand
HEADING_GAIN = 0.5  # [1/s]
AIR_TIME = 0.5  # a swing that lasts longer is rewarded [s]
REWARD_SCALE = 1.5  # greatest weighted sum of the two tracking terms
SWING_S, LIFT, HEIGHT = 0.4, 0.05, 0.55  # [s], [m], [m]: the trot that `shaping` asks for
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
# channel (of a policy that tracks to 0.45 m/s)
OBSERVATION = (
  ("base_lin_vel", ("x", "y", "z"), "m/s", 0.1, 0.3),
  ("base_ang_vel", ("x", "y", "z"), "rad/s", 0.2, 0.35),
  ("projected_gravity", ("x", "y", "z"), "1", 0.05, 0.05),
  ("command", ("vx", "vy", "wz"), "m/s", 0.0, 0.5),
  ("joint_pos", anymal.JOINTS, "rad", 0.01, 0.2),
  ("joint_vel", anymal.JOINTS, "rad/s", 1.5, 2.0),
  ("last_action", anymal.JOINTS, "1", 0.0, 0.35),
)
NOISE = np.array([noise for _, names, _, noise, _ in OBSERVATION for _ in names], np.float32)


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

  v   = low + share (high - low)
  w_z = clip(0.5 wrap(heading - yaw), low_z, high_z),   all 0 where standing
  """
  low, high = task["command_range"]
  velocity = low[:2] + draw.share * (high[:2] - low[:2])
  turn = anymal.rotation(qpos[3:7])
  error = draw.heading - jnp.arctan2(turn[1, 0], turn[0, 0])
  error = jnp.arctan2(jnp.sin(error), jnp.cos(error))
  rate = jnp.clip(HEADING_GAIN * error, low[2], high[2])
  return jnp.where(draw.standing, 0.0, jnp.concatenate([velocity, rate[None]]))


def observe(
  qpos: jax.Array, qvel: jax.Array, gravity: jax.Array, command: jax.Array, action: jax.Array
) -> jax.Array:
  """Observation without noise, float32 (48,), in the order of OBSERVATION; joint angles from the
  stance.
  """
  linear, angular, down = anymal.base_motion(qpos, qvel, gravity)
  return jnp.concatenate(
    [linear, angular, down, command, qpos[7:] - anymal.DEFAULT, qvel[6:], action]
  )


def reward_terms(
  before: QuadrupedState,
  action: jax.Array,
  out: dict[str, jax.Array],
  gravity: jax.Array,
  soft_range: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
  """Unweighted terms of the reward for arriving somewhere; velocities are in the base's frame.

    track_velocity      exp(-|v_xy - command|^2 / 0.25)
    track_yaw_rate      exp(-(w_z - command)^2 / 0.25)
    vertical_velocity   v_z^2
    roll_pitch_rate     w_x^2 + w_y^2
    torque              sum tau^2 of the last physics step
    joint_acceleration  sum qdd^2 of the last physics step
    action_rate         sum (a - last a)^2, a of 0.5 rad
    air_time            sum over feet that touch down of (time in the air - 0.5 s), only where the
                        commanded |v_xy| > 0.1 m/s
    knee_contacts       number of knees at or below the ground
    tilt                g_x^2 + g_y^2, g = gravity's direction
    joint_limits        sum of rad beyond 95 % of the range

  Args:
    before: state that was left; its `command` is what the agent saw.
    action: (12,), of this step.
    out: what the physics gives on arriving.
    gravity: (3,) [m/s2].
    soft_range: (2, 12) [rad].

  Returns:
    (terms (11,) in the order of REWARDS, air' (4,) [s], |v_xy - command| () [m/s]).
  """
  q, command = out["qpos"][7:], before.command
  acceleration = (out["qvel"] - out["qvel_before"])[6:] / anymal.PHYSICS_S
  linear, angular, down = anymal.base_motion(out["qpos"], out["qvel"], gravity)
  foot, knee = anymal.leg_points(out["qpos"])
  contact, air = foot[:, 2] <= anymal.FOOT_RADIUS + anymal.TOUCH, before.air + CONTROL_S
  landed = jnp.sum(jnp.where(contact & (before.air > 0), air - AIR_TIME, 0.0))
  off = jnp.sum((linear[:2] - command[:2]) ** 2)
  terms = [
    jnp.exp(-off / 0.25),
    jnp.exp(-((angular[2] - command[2]) ** 2) / 0.25),
    linear[2] ** 2,
    jnp.sum(angular[:2] ** 2),
    jnp.sum(out["ctrl"] ** 2),
    jnp.sum(acceleration**2),
    jnp.sum((ACTION_SCALE / ISAAC_SCALE * (action - before.action)) ** 2),
    jnp.where(jnp.sum(command[:2] ** 2) > 0.1**2, landed, 0.0),
    jnp.sum((knee[:, 2] <= anymal.KNEE_RADIUS + anymal.TOUCH).astype(jnp.float32)),
    jnp.sum(down[:2] ** 2),
    jnp.sum(jnp.maximum(soft_range[0] - q, 0.0) + jnp.maximum(q - soft_range[1], 0.0)),
  ]
  return jnp.stack(terms), jnp.where(contact, 0.0, air), jnp.sqrt(off)


def make_spec(mj_model: mujoco.MjModel) -> Spec:
  """Names, units and groups, read from the tables above and the MuJoCo model."""
  bounds = {"projected_gravity": 1.05, "last_action": 1.0}  # noise included
  obs = tuple(
    Var(f"{group}_{name}", "rad/s" if name == "wz" else unit, -bound, bound, scale)
    for group, names, unit, _, scale in OBSERVATION
    for bound in [bounds.get(group, float("inf"))]
    for name in names
  )
  ends = np.cumsum([len(names) for _, names, *_ in OBSERVATION]).tolist()
  groups = {
    group: tuple(range(end - len(names), end)) for (group, names, *_), end in zip(OBSERVATION, ends)
  }
  legs = tuple((leg, (3 * k, 3 * k + 1, 3 * k + 2)) for k, leg in enumerate(anymal.LEGS))
  foreseen = ("base_lin_vel", "base_ang_vel", "projected_gravity", "joint_pos")
  return Spec(
    name="quadruped",
    obs=obs,
    act=tuple(Var(j, "1", -1, 1) for j in anymal.JOINTS),
    control_s=CONTROL_S,
    episode_steps=EPISODE_STEPS,
    # mean reward per step; one that stands still earns 0.21, perfect tracking without effort 1
    acceptance=0.48,
    # upright is a least value of no channel (gravity's z is then -1); a fall ends the episode,
    # standing still earns too little
    posture=None,
    targets=anymal.JOINTS,
    act_groups=(*legs, ("all", tuple(range(12)))),
    obs_groups=tuple(groups.items()),
    feet=tuple((leg, (mj_model.geom(f"{leg}_foot").id,)) for leg in anymal.LEGS),
    bodies=tuple((mj_model.body(b).name, (b,)) for b in range(1, mj_model.nbody)),
    watched=(
      *((group, groups[group]) for group in foreseen),
      *((f"joint_vel_{leg}", tuple(groups["joint_vel"][i] for i in at)) for leg, at in legs),
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
    self.mj_model = anymal.load_model()
    self.physics = physics_lib.make(physics, self.mj_model, substeps=SUBSTEPS, law=anymal.motor_law)
    self.spec = make_spec(self.mj_model)
    self.stance, self.reward_terms = anymal.DEFAULT, tuple(name for name, _ in REWARDS)
    low, high = self.mj_model.jnt_range[1:].T
    middle, half = (low + high) / 2, SOFT_LIMIT * (high - low) / 2
    self._gravity = jnp.asarray(self.mj_model.opt.gravity, jnp.float32)
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
      ),  # fmt: skip
      task={
        "strength": jnp.ones(12),
        "velocity_limit": jnp.full(12, anymal.VELOCITY, jnp.float32),
        # least and greatest v_x, v_y [m/s], yaw rate [rad/s]
        "command_range": jnp.asarray([[-1.0] * 3, [1.0] * 3], jnp.float32),
        "reward_weights": jnp.asarray([weight for _, weight in REWARDS], jnp.float32),
      },
      force=jnp.zeros(self.mj_model.nv),
    )

  def init(self, model: Model, key: jax.Array) -> tuple[EnvState, jax.Array]:
    """A fresh episode drawn from `key`: state and observation (48,)."""
    keys = jax.random.split(key, 7)
    place = jax.random.uniform(keys[0], (2,), minval=-0.5, maxval=0.5)
    yaw = jax.random.uniform(keys[1], (), minval=-jnp.pi, maxval=jnp.pi)
    speed = jax.random.uniform(keys[2], (6,), minval=-0.5, maxval=0.5)  # world frame
    joints = anymal.DEFAULT * jax.random.uniform(keys[3], (12,), minval=0.5, maxval=1.5)
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
    draw = draw_command(keys[4])
    start = QuadrupedState(
      backend=self.physics.init(qpos, qvel),
      qpos=qpos,
      qvel=qvel,
      torque=jnp.zeros(12),
      action=jnp.zeros(12),
      draw=draw,
      command=command_of(model.task, draw, qpos),
      air=jnp.zeros(4),
      velocity_error=jnp.float32(0),
      fallen=jnp.bool_(False),
      key=jax.random.key_data(keys[6]),
    )
    state = EnvState(start, jnp.int32(0))
    return state, self._sense(keys[5], model, state)

  def step(self, model: Model, state: EnvState, action: jax.Array) -> tuple[EnvState, Step]:
    """One control step with action (12,), clipped to [-1, 1]."""
    before, task = state.physics, model.task
    action = jnp.clip(action, -1.0, 1.0)
    inner, out = self.physics.step(
      model.mj,
      before.backend,
      jnp.asarray(anymal.DEFAULT) + ACTION_SCALE * action,
      {name: task[name] for name in ("strength", "velocity_limit")},
      model.force,
    )
    qpos, gravity = out["qpos"], self._gravity_of(model)
    terms, air, error = reward_terms(before, action, out, gravity, self._soft_range)
    reward = jnp.sum(task["reward_weights"] * terms) / REWARD_SCALE
    # true as well for a state that is no number
    fallen = ~(anymal.trunk_height(qpos) > anymal.TOUCH)
    step = state.step + 1
    key_command, key_noise = jax.random.split(
      jax.random.fold_in(jax.random.wrap_key_data(before.key), step)
    )
    renew = step % RESAMPLE_STEPS == 0
    draw = jax.tree.map(
      lambda new, old: jnp.where(renew, new, old), draw_command(key_command), before.draw
    )
    command, qvel, torque = command_of(task, draw, qpos), out["qvel"], out["ctrl"]
    after = QuadrupedState(
      inner, qpos, qvel, torque, action, draw, command, air, error, fallen, before.key
    )
    arrived = EnvState(after, step)
    obs = self._sense(key_noise, model, arrived)
    truncated = ~fallen & (step >= self.spec.episode_steps)
    return arrived, Step(obs, reward, fallen, truncated, obs)

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

  def shaping(self, before: EnvState, after: EnvState) -> jax.Array:
    """What a trot earns beside the reward while learning (setting `shaping`), float32 () in [0, 1]:

      (pairs + lift + height) / 3
      pairs   share of four that hold: diagonal feet alike (two pairs), front feet not, hind feet
              not; a foot is up while it has been off the ground for less than 0.4 s
      lift    mean over feet that are up of min(clearance / 0.05 m, 1)
      height  exp(-((z of the base - 0.55 m) / 0.08 m)^2)

    pairs and lift are 1 where the command is to stand.
    """
    p = after.physics
    up = (p.air > 0) & (p.air < SWING_S)
    foot, _ = anymal.leg_points(p.qpos)
    clear = jnp.clip((foot[:, 2] - anymal.FOOT_RADIUS) / LIFT, 0.0, 1.0)
    lift = jnp.sum(jnp.where(up, clear, 0.0)) / jnp.maximum(jnp.sum(up), 1)
    lf, rf, lh, rh = up
    pairs = jnp.mean(jnp.array([lf == rh, rf == lh, lf != rf, lh != rh], jnp.float32))
    moving = jnp.sum(before.physics.command**2) > 0.1**2
    height = jnp.exp(-(((p.qpos[2] - HEIGHT) / 0.08) ** 2))
    return (jnp.where(moving, pairs + lift, 2.0) + height) / 3

  def reference(self, state: EnvState) -> jax.Array:
    """Action (12,) of the driver that knows the robot's state, `trot`."""
    p = state.physics
    return trot.action(state.step, p.qpos, p.qvel, p.command, p.action)

  def noiseless(self, model: Model, state: EnvState) -> jax.Array:
    """The observation (48,) at `state` without its noise: what a demonstrator is shown."""
    p = state.physics
    return observe(p.qpos, p.qvel, self._gravity_of(model), p.command, p.action)

  def _gravity_of(self, model: Model) -> jax.Array:
    """Gravity (3,) [m/s2]; `rollout` leaves out what no fault owns."""
    return model.mj.get("gravity", self._gravity)

  def _sense(self, key: jax.Array, model: Model, state: EnvState) -> jax.Array:
    noise = NOISE * jax.random.uniform(key, (len(NOISE),), minval=-1.0, maxval=1.0)
    return self.noiseless(model, state) + noise
