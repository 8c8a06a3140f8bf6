"""Car: a 1:10 scale racing car keeps fast and off the walls of a track that it sees by lidar. The
simulator, pure JAX on every backend.

Parameters, command layer and integrator follow the F1TENTH gym's car (O'Kelly et al. 2020); the
tyre saturates and each axle has its own friction. Observation, action and reward are module
functions: `car_real` (MuJoCo) shares them, so that an agent moves from one to the other.
"""

from __future__ import annotations

import types
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.envs.course import Course
from mjx_cl.errors import choose
from mjx_cl.types import EnvState, Model, Spec, Step, Var

if TYPE_CHECKING:
  from collections.abc import Iterable

  from mjx_cl.envs.course import Track

FRICTION = 1.0489  # tyre on floor
STIFFNESS = (4.718, 5.4562)  # front, rear cornering stiffness per unit of load [1/rad]
AXLES = (0.15875, 0.17145)  # from the centre of gravity to the front and rear axle [m]
WHEELBASE = 0.3302  # [m]
HEIGHT = 0.074  # of the centre of gravity [m]
MASS, INERTIA = 3.74, 0.04712  # [kg], [kg m2] about the vertical
STEER_MAX, STEER_RATE = 0.4189, 3.2  # [rad], [rad/s]
STEER_LAG = 0.02  # [s]; stands for the gym's buffer of two 10 ms steps
ACCEL_MAX = 9.51  # [m/s2], either way; the gym lowers it above 7.319 m/s only
GAIN_UP, GAIN_DOWN = (
  10 * ACCEL_MAX / 20,
  10 * ACCEL_MAX / 5,
)  # speed control [1/s], for the gym's range of -5 to 20 m/s
GRAVITY = 9.81  # [m/s2]
SPEED_MIN, SPEED_MAX = 0.5, 5.0  # commanded [m/s]
TRACTION = 0.95  # share of the grip that drive or brake force may take
SLOW = 1.0  # [m/s]; wheel speed below which slip is taken at this speed
LIDAR_SIGMA = 0.01  # [m]
REWARD_TERMS = {"speed": 0.2, "crash": -5.0}  # weights, see `reward`
WEIGHTS = tuple(REWARD_TERMS.values())
CONTROL_S, SUBSTEPS = 0.05, 5  # [s], RK4 steps in it
EPISODE = 1200  # control steps: 60 s


# ---- what the simulator and the MuJoCo car share -------------------------------------------------


def spec(name: str, course: Course, acceptance: float) -> Spec:
  """Spec of a car on `course`: the lidar's beams from right to left, then speed, yaw rate and
  steering angle; steering and motor as action.

  Scales are deviations over 160 cars and 30 s of the reference driver; one number for all beams.
  """
  lidar = tuple(Var(f"lidar_{k:02d}", "1", 0, 1, scale=0.15) for k in range(course.beams))
  own = (
    Var("speed", "m/s", scale=0.3),
    Var("yaw_rate", "rad/s", scale=1.2),
    Var("steering", "rad", -STEER_MAX, STEER_MAX, scale=0.11),
  )
  beams, side = np.arange(course.beams), np.pi / 4
  parts = {
    "lidar": beams,
    "lidar_right": beams[course.angles < -side],
    "lidar_front": beams[np.abs(course.angles) <= side],
    "lidar_left": beams[course.angles > side],
    "motion": course.beams + np.arange(3),
  }
  fans = tuple(
    (f"lidar_{side}", tuple(int(i) for i in at))
    for side, at in zip(
      ("right", "front_right", "front", "front_left", "left"), np.array_split(beams, 5)
    )
  )
  motion = tuple((v.name, (course.beams + k,)) for k, v in enumerate(own))
  return Spec(
    name=name,
    obs=lidar + own,
    act=(Var("steering", "1", -1, 1), Var("motor", "1", -1, 1)),
    control_s=CONTROL_S,
    episode_steps=EPISODE,
    acceptance=acceptance,
    posture=None,
    targets=("steering", "motor"),
    obs_groups=tuple((part, tuple(int(i) for i in at)) for part, at in parts.items()),
    feet=(("front", (0,)), ("rear", (1,))),
    watched=fans + motion,
  )


def command(action: jax.Array) -> tuple[jax.Array, jax.Array]:
  """Steering angle [rad] and speed [m/s] that an action (2,), clipped to [-1, 1], asks for.

    angle = 0.4189 a_0,   speed = 0.5 + (a_1 + 1) / 2 * 4.5

  At 5 m/s the lidar sees 2 s ahead, and curves below a radius of 2.4 m exceed the tyres' grip (v^2
  / r > mu g), so that a good driver must brake. The car never parks: standing would be a safe
  policy with nothing to learn from, and a car that faces a wall, with no reverse gear, would wait
  there until the time limit.
  """
  action = jnp.clip(action, -1.0, 1.0)
  return STEER_MAX * action[0], SPEED_MIN + 0.5 * (action[1] + 1.0) * (SPEED_MAX - SPEED_MIN)


def observe(
  course: Course,
  ranges: jax.Array,
  speed: jax.Array,
  yaw_rate: jax.Array,
  steer: jax.Array,
  sigma: jax.Array,
  key: jax.Array,
) -> jax.Array:
  """Observation, float32 (beams + 3,): clip(range + sigma N(0, 1), 0, max) / max, then forward
  speed [m/s], yaw rate [rad/s], steering angle [rad].

  Args:
    ranges: (beams,) [m], `course.scan`'s.
    sigma: deviation of the lidar's noise [m], ().
    key: of the noise.
  """
  noisy = ranges + sigma * jax.random.normal(key, ranges.shape)
  return jnp.concatenate(
    [jnp.clip(noisy, 0.0, course.max_range) / course.max_range, jnp.stack([speed, yaw_rate, steer])]
  )


def progress(
  course: Course,
  track: jax.Array,
  x: jax.Array,
  y: jax.Array,
  velocity_x: jax.Array,
  velocity_y: jax.Array,
) -> jax.Array:
  """Speed along the track [m/s], (): the world velocity [m/s] of the car's origin along the track's
  direction at its nearest point.

  Speed ahead of the car itself would also pay for driving in circles, which the car can do between
  the walls.
  """
  heading = course.locate(track, x, y).heading
  return velocity_x * jnp.cos(heading) + velocity_y * jnp.sin(heading)


def reward(
  along: jax.Array, crashed: jax.Array, weights: jax.Array | tuple[float, ...] = WEIGHTS
) -> jax.Array:
  """Reward, float32 (): 0.2 along - 5 [crashed], for the speed along the track [m/s]; 1 at the
  highest speed, negative the wrong way round.

  5 is what a new start costs, 10 control steps from standstill at half of the full reward: even a
  policy that is blind to what follows an end gains nothing by crashing.

  Args:
    weights: (2,) of `REWARD_TERMS` [s/m, 1].
  """
  return weights[0] * along + weights[1] * crashed


# ---- dynamics ------------------------------------------------------------------------------------


class Motion(NamedTuple):
  """What the dynamics integrate, each float32 (): place and yaw in the world, velocity of the
  centre of gravity in the car's frame.
  """

  x: jax.Array  # [m]
  y: jax.Array  # [m]
  yaw: jax.Array  # [rad]
  vx: jax.Array  # [m/s], ahead
  vy: jax.Array  # [m/s], to the left
  yaw_rate: jax.Array  # [rad/s]
  steer: jax.Array  # [rad]


class CarState(NamedTuple):
  """State of one car: motion, int32 () index of its track, and the key of its lidar's noise."""

  motion: Motion
  track: jax.Array
  key: jax.Array


def nominal() -> dict[str, jax.Array]:
  """What a fault may change beside `Model.force`: `Model.task`, all float32.

  friction (2,): of the front and rear tyres. mass () [kg]. inertia () [kg m2]. com (2,) [m]: shift
  of the centre of gravity ahead, height. strength (2,): share of the steering angle, of the motor's
  force that arrives. velocity_limit (2,): of the steering [rad/s], of the motor [m/s]. steer_lag_s
  () [s]. noise () [m]: deviation of the lidar. gravity (3,) [m/s2]: in the world frame; a
  horizontal part is a tilted floor. reward_weights (2,): see `reward`.
  """
  values = dict(
    friction=[FRICTION] * 2,
    mass=MASS,
    inertia=INERTIA,
    com=[0.0, HEIGHT],
    strength=[1.0, 1.0],
    velocity_limit=[STEER_RATE, SPEED_MAX],
    steer_lag_s=STEER_LAG,
    noise=LIDAR_SIGMA,
    gravity=[0.0, 0.0, -GRAVITY],
    reward_weights=list(REWARD_TERMS.values()),
  )
  return {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}


def axle_forces(
  task: dict[str, jax.Array], motion: Motion, drive: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
  """Force ahead and to the left [N] of the front and rear tyres in the wheels' own frames, and the
  axles' loads [N]: (2,) each.

    N_f = (m g l_r - F h) / (l_f + l_r), N_r = (m g l_f + F h) / (l_f + l_r)         F = drive force
      under the loads at rest
    q   = clip(drive / sum mu N, -0.95, 0.95)                                         share of the
      grip that drives or brakes
    F_x = q mu N,   F_y = sqrt(1 - q^2) mu N tanh(C alpha)                            per axle:
      slope C mu N at q = 0, friction ellipse
    alpha = -atan2(w, max(|u|, 1))                       u, w = velocity of the axle's centre along
      and across its wheels [m/s]

  All four wheels drive and brake through one shaft, as in the chassis that F1TENTH builds on: their
  speeds are equal, so both axles use the same share of their grip. (The gym's 9.51 m/s2 needs four
  wheels: the rear axle alone carries mu g l_f / (l_f + l_r) = 4.9 m/s2.) Wheel speed is no state:
  demand beyond the traction limit is lost, and spinning wheels keep a third of their side force.
  Below 1 m/s slip is taken at 1 m/s. Side forces, which fall with v^2, then still hold the car on
  its kinematic path, and the equations stay finite and slow enough for RK4 down to a standstill; a
  blend into a kinematic model would give a car that slides sideways endless grip.
  """
  front, rear = AXLES[0] - task["com"][0], AXLES[1] + task["com"][0]
  rest = task["mass"] * -task["gravity"][2] * jnp.stack([rear, front]) / WHEELBASE

  def share(grip: jax.Array) -> jax.Array:
    return jnp.clip(drive / jnp.maximum(jnp.sum(grip), 1e-6), -TRACTION, TRACTION)

  grip = task["friction"] * rest
  transfer = share(grip) * jnp.sum(grip) * task["com"][1] / WHEELBASE
  load = jnp.maximum(rest + jnp.stack([-transfer, transfer]), 0.0)
  grip = task["friction"] * load
  used = share(grip)
  sin, cos = jnp.sin(motion.steer), jnp.cos(motion.steer)
  side = motion.vy + front * motion.yaw_rate
  u = jnp.stack([cos * motion.vx + sin * side, motion.vx])
  w = jnp.stack([cos * side - sin * motion.vx, motion.vy - rear * motion.yaw_rate])
  slip = -jnp.arctan2(w, jnp.maximum(jnp.abs(u), SLOW))
  return (
    used * grip,
    jnp.sqrt(1.0 - used * used) * grip * jnp.tanh(jnp.asarray(STIFFNESS, jnp.float32) * slip),
    load,
  )


def derivative(
  task: dict[str, jax.Array], motion: Motion, angle: jax.Array, speed: jax.Array, force: jax.Array
) -> Motion:
  """d/dt of the motion under a commanded steering angle [rad] and speed [m/s]: single-track model
  in force form.

    steer' = clip((strength_0 angle - steer) / lag, -limit_0, limit_0)
    a      = clip(k (min(speed, limit_1) - vx), -9.51, 9.51),   drive = strength_1 m_nominal a
      k = 4.755 1/s to speed up, 19.02 to brake
    vx'    = sum F_ahead / m + vy r,   vy' = sum F_left / m - vx r,   r' = (l_f F_left,front - l_r
      F_left,rear + M) / I            r = yaw rate

  Args:
    force: (3,), outer force on the centre of gravity along world x, y [N], moment M about the
      vertical [N m]. Gravity's horizontal part adds to it.
  """
  goal = jnp.clip(task["strength"][0] * angle, -STEER_MAX, STEER_MAX)
  most = task["velocity_limit"][0]
  turn = jnp.clip(
    (goal - motion.steer) / jnp.maximum(task["steer_lag_s"], CONTROL_S / SUBSTEPS), -most, most
  )
  error = jnp.minimum(speed, task["velocity_limit"][1]) - motion.vx
  drive = (
    task["strength"][1]
    * MASS
    * jnp.clip(jnp.where(error > 0, GAIN_UP, GAIN_DOWN) * error, -ACCEL_MAX, ACCEL_MAX)
  )
  along, across, _ = axle_forces(task, motion, drive)
  sin, cos = jnp.sin(motion.steer), jnp.cos(motion.steer)
  left = jnp.stack([sin * along[0] + cos * across[0], across[1]])  # front, rear
  moment = (AXLES[0] - task["com"][0]) * left[0] - (AXLES[1] + task["com"][0]) * left[1] + force[2]
  ahead = cos * along[0] - sin * across[0] + along[1]
  push = force[:2] + task["mass"] * task["gravity"][:2]
  sin, cos = jnp.sin(motion.yaw), jnp.cos(motion.yaw)
  return Motion(
    x=cos * motion.vx - sin * motion.vy,
    y=sin * motion.vx + cos * motion.vy,
    yaw=motion.yaw_rate,
    vx=(ahead + cos * push[0] + sin * push[1]) / task["mass"] + motion.vy * motion.yaw_rate,
    vy=(left[0] + left[1] + cos * push[1] - sin * push[0]) / task["mass"]
    - motion.vx * motion.yaw_rate,
    yaw_rate=moment / task["inertia"],
    steer=turn,
  )


def advance(model: Model, motion: Motion, angle: jax.Array, speed: jax.Array) -> Motion:
  """The motion one control step of 0.05 s later: five RK4 steps of 0.01 s under a constant command.
  Yaw stays in [-pi, pi).
  """
  dt = CONTROL_S / SUBSTEPS
  force = jnp.zeros(3) if model.force is None else model.force

  def substep(_: jax.Array, m: Motion) -> Motion:
    def slope(k: Motion, share: float) -> Motion:
      return derivative(
        model.task, jax.tree.map(lambda a, b: a + share * dt * b, m, k), angle, speed, force
      )

    k1 = derivative(model.task, m, angle, speed, force)
    k2 = slope(k1, 0.5)
    k3 = slope(k2, 0.5)
    k4 = slope(k3, 1.0)
    return jax.tree.map(
      lambda a, b, c, d, e: a + dt / 6 * (b + 2 * c + 2 * d + e), m, k1, k2, k3, k4
    )

  motion = jax.lax.fori_loop(0, SUBSTEPS, substep, motion)
  return motion._replace(yaw=(motion.yaw + jnp.pi) % (2 * jnp.pi) - jnp.pi)


# ---- environment ---------------------------------------------------------------------------------


class Car:
  """The simulated car on tracks of its own. Touching a wall terminates, 1,200 control steps of 0.05
  s truncate.

  Reset: a random track and place on it, at most 0.3 m and 0.2 rad off the centre line, at rest with
  straight wheels.

  Args:
    physics: `auto`, `native`, `mjx`: all mean the same, pure JAX.
    tracks: see Course; by default its own six.
  """

  def __init__(self, physics: str = "auto", tracks: Iterable[Track] | None = None) -> None:
    choose("physics", physics, dict.fromkeys(("auto", "native", "mjx")))
    self.physics = types.SimpleNamespace(
      name="jax", seconds=0.0
    )  # no time is spent outside the compiled program
    self.course = Course(tracks)
    self.spec = spec(
      "car", self.course, acceptance=0.6
    )  # 3 m/s along the track and no crash; the reference driver earns 0.93
    self.reward_terms = tuple(REWARD_TERMS)
    self.model = Model(mj={}, task=nominal(), force=jnp.zeros(3))

  def pose(self, state: EnvState) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]:
    """Privileged: track, x, y [m], yaw [rad] and speed ahead [m/s]."""
    m = state.physics.motion
    return state.physics.track, m.x, m.y, m.yaw, m.vx

  termination_rate = "collision_rate"  # what the share of terminated episodes is called

  def measure(self, state: EnvState) -> dict[str, jax.Array]:
    """mean_speed_m_s: speed along the track, float32 ()."""
    m = state.physics.motion
    sin, cos = jnp.sin(m.yaw), jnp.cos(m.yaw)
    return {
      "mean_speed_m_s": progress(
        self.course, state.physics.track, m.x, m.y, cos * m.vx - sin * m.vy, sin * m.vx + cos * m.vy
      )
    }

  def reference(self, state: EnvState) -> jax.Array:
    """Action (2,) of the reference driver, which knows where the car is."""
    return pure_pursuit(self, state)

  def _observe(self, model: Model, motion: Motion, track: jax.Array, key: jax.Array) -> jax.Array:
    ranges = self.course.scan(track, motion.x, motion.y, motion.yaw)
    return observe(
      self.course, ranges, motion.vx, motion.yaw_rate, motion.steer, model.task["noise"], key
    )

  def init(self, model: Model, key: jax.Array) -> tuple[EnvState, jax.Array]:
    """A fresh episode drawn from `key`: state and observation (67,)."""
    key_spawn, key_noise, key = jax.random.split(key, 3)
    track, x, y, yaw = self.course.spawn(key_spawn)
    zero = jnp.zeros(())
    motion = Motion(x, y, yaw, zero, zero, zero, zero)
    return EnvState(CarState(motion, track, key), jnp.int32(0)), self._observe(
      model, motion, track, key_noise
    )

  def step(self, model: Model, state: EnvState, action: jax.Array) -> tuple[EnvState, Step]:
    """One control step with action (2,), clipped to [-1, 1]."""
    track = state.physics.track
    key_noise, key = jax.random.split(state.physics.key)
    motion = advance(model, state.physics.motion, *command(action))
    sin, cos = jnp.sin(motion.yaw), jnp.cos(motion.yaw)
    along = progress(
      self.course,
      track,
      motion.x,
      motion.y,
      cos * motion.vx - sin * motion.vy,
      sin * motion.vx + cos * motion.vy,
    )
    crashed = self.course.collides(track, motion.x, motion.y, motion.yaw)
    obs, step = self._observe(model, motion, track, key_noise), state.step + 1
    earned = reward(along, crashed, model.task["reward_weights"])
    truncated = ~crashed & (step >= self.spec.episode_steps)
    return EnvState(CarState(motion, track, key), step), Step(obs, earned, crashed, truncated, obs)


# ---- reference driver ----------------------------------------------------------------------------


def pure_pursuit(env: Any, state: EnvState, friction: float = FRICTION) -> jax.Array:
  """Action (2,) of the reference driver, from the true place of the car: `env` has `course` and
  `pose(state)`. Yardstick and demonstrator.

    steering = atan(2 L sin(eta) / d)            towards the centre line's point 0.6 m + 0.15 s *
      speed ahead; eta, d seen from the rear axle
    speed    = min over points z = 0 .. 3 m ahead of sqrt(0.8 mu g / |curvature| + 2 * 0.4 mu g z),
      at most 5 m/s, and no farther from the
               car's own speed than what the speed control answers with 0.5 mu g

  Source: Coulter 1992, Implementation of the pure pursuit path tracking algorithm, CMU-RI-TR-92-01.
  """
  track, x, y, yaw, speed = env.pose(state)
  s = env.course.locate(track, x, y).s
  goal_x, goal_y, _, _ = env.course.at(track, s + 0.6 + 0.15 * jnp.maximum(speed, 0.0))
  dx, dy = goal_x - x + AXLES[1] * jnp.cos(yaw), goal_y - y + AXLES[1] * jnp.sin(yaw)
  square = dx * dx + dy * dy
  across = jnp.cos(yaw) * dy - jnp.sin(yaw) * dx  # d sin(eta)
  angle = jnp.arctan(2 * WHEELBASE * across / square)
  ahead = jnp.arange(0.0, 3.01, 0.2)
  curvature = jax.vmap(lambda z: env.course.at(track, s + z)[3])(ahead)
  grip = friction * GRAVITY
  fastest = jnp.min(
    jnp.sqrt(0.8 * grip / jnp.maximum(jnp.abs(curvature), 1e-3) + 0.8 * grip * ahead)
  )
  fastest = jnp.clip(fastest, speed - 0.5 * grip / GAIN_DOWN, speed + 0.5 * grip / GAIN_UP)
  action = jnp.stack([angle / STEER_MAX, 2 * (fastest - SPEED_MIN) / (SPEED_MAX - SPEED_MIN) - 1])
  return jnp.clip(action, -1.0, 1.0)
