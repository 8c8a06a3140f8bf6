"""What the simulated and the MuJoCo car share: figures, observation, action, reward and reference
driver, so that an agent moves from one to the other.

Parameters and command layer follow the F1TENTH gym's car (O'Kelly et al. 2020).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.envs.course import Course
from mjx_cl.types import EnvState, Spec, Var

FRICTION = 1.0489  # tyre on floor
AXLES = (0.15875, 0.17145)  # from the centre of gravity to the front and rear axle [m]
WHEELBASE = 0.3302  # [m]
MASS, INERTIA = 3.74, 0.04712  # [kg], [kg m2] about the vertical
STEER_MAX, STEER_RATE = 0.4189, 3.2  # [rad], [rad/s]
STEER_LAG = 0.02  # [s]; stands for the gym's buffer of two 10 ms steps
ACCEL_MAX = 9.51  # [m/s2], either way; the gym lowers it above 7.319 m/s only
# speed control [1/s], for the gym's range of -5 to 20 m/s
GAIN_UP, GAIN_DOWN = 10 * ACCEL_MAX / 20, 10 * ACCEL_MAX / 5
GRAVITY = 9.81  # [m/s2]
SPEED_MIN, SPEED_MAX = 0.5, 5.0  # commanded [m/s]
LIDAR_SIGMA = 0.01  # [m]
REWARD_TERMS = {"speed": 0.2, "crash": -5.0}  # weights, see `reward`
WEIGHTS = tuple(REWARD_TERMS.values())
CONTROL_S = 0.05
EPISODE = 1200  # control steps: 60 s


class Motion(NamedTuple):
  """How a car moves; each float32 ().

  Attributes:
    x: of the centre of gravity, in the world [m].
    y: of the centre of gravity, in the world [m].
    yaw: in the world [rad].
    vx: velocity ahead [m/s].
    vy: velocity to the left [m/s].
    yaw_rate: [rad/s].
    steer: steering angle [rad].
  """

  x: jax.Array
  y: jax.Array
  yaw: jax.Array
  vx: jax.Array
  vy: jax.Array
  yaw_rate: jax.Array
  steer: jax.Array


def spec(name: str, course: Course, acceptance: float) -> Spec:
  """Spec of a car on `course`: the lidar's beams from right to left, then speed, yaw rate and
  steering angle; steering and motor as action.

  Scales are deviations over 160 cars and 30 s of the reference driver; one number for all beams.
  """
  lidar = tuple(Var(f"lidar_{k:02d}", "1", 0, 1, scale=0.15) for k in range(course.beams))
  own = (
    Var("speed", "m/s", scale=0.3),
    Var("yaw_rate", "rad/s", scale=1.2),
    # measured, an angle overshoots what is asked for
    Var("steering", "rad", -1.05 * STEER_MAX, 1.05 * STEER_MAX, scale=0.11),
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


def astray(
  course: Course, track: jax.Array, x: jax.Array, y: jax.Array, yaw: jax.Array
) -> jax.Array:
  """Whether the car faces back along the track, bool (): cos(yaw - heading at its nearest point) <
  0.

  The observation does not tell the two ways round apart, so that a car that has spun would drive on
  as well as ever and learn that driving well does not pay. The reference driver is at most 20
  degrees off the heading, in `car_real`, where it crashes, 45. To end an episode there is the usage
  of TORCS (Loiacono, Cardamone and Lanzi 2013, https://arxiv.org/abs/1304.1672, by gym_torcs).
  """
  return jnp.cos(yaw - course.locate(track, x, y).heading) < 0


def reward(
  along: jax.Array, crashed: jax.Array, weights: jax.Array | tuple[float, ...] = WEIGHTS
) -> jax.Array:
  """Reward, float32 (): 0.2 along - 5 [crashed], for the speed along the track [m/s]; 1 at the
  highest speed. Crashed: has touched a wall, or is `astray`.

  5 is what a new start costs, 10 control steps from standstill at half of the full reward: even a
  policy that is blind to what follows an end gains nothing by crashing.

  Args:
    weights: (2,) of `REWARD_TERMS` [s/m, 1].
  """
  return weights[0] * along + weights[1] * crashed


def pure_pursuit(env: Any, state: EnvState, friction: float = FRICTION) -> jax.Array:
  """Action (2,) of the reference driver, from the true place of the car: `env` has `course` and
  `pose(state)`. Yardstick and demonstrator.

    steering = atan(2 L sin(eta) / d)
    speed    = min over z = 0 .. 3 m of sqrt(0.8 mu g / |curvature(z)| + 2 * 0.4 mu g z)

  with eta and d, seen from the rear axle, the direction and distance of the centre line's point
  0.6 m + 0.15 s * speed ahead, and z a distance ahead along the centre line. The speed is at most
  5 m/s, and no farther from the car's own than what the speed control answers with 0.5 mu g.

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


class Racer:
  """A car on a course, whose `EnvState.physics` has a `motion` and the index of its `track`."""

  course: Course
  reward_terms = tuple(REWARD_TERMS)
  termination_rate = "collision_rate"  # what the share of terminated episodes is called

  def pose(self, state: EnvState) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]:
    """Privileged: track, x, y [m], yaw [rad] and speed ahead [m/s]."""
    m = state.physics.motion
    return state.physics.track, m.x, m.y, m.yaw, m.vx

  def crashed(self, track: jax.Array, motion: Motion) -> jax.Array:
    """Whether the car touches a wall or is `astray`, bool ()."""
    at = track, motion.x, motion.y, motion.yaw
    return self.course.collides(*at) | astray(self.course, *at)

  def measure(self, state: EnvState) -> dict[str, jax.Array]:
    """mean_speed_m_s: speed along the track, float32 ()."""
    return {"mean_speed_m_s": self.along(state.physics.track, state.physics.motion)}

  def along(self, track: jax.Array, motion: Motion) -> jax.Array:
    """`progress` of a motion."""
    sin, cos = jnp.sin(motion.yaw), jnp.cos(motion.yaw)
    return progress(
      self.course,
      track,
      motion.x,
      motion.y,
      cos * motion.vx - sin * motion.vy,
      sin * motion.vx + cos * motion.vy,
    )

  def reference(self, state: EnvState) -> jax.Array:
    """Action (2,) of the reference driver, which knows where the car is."""
    return pure_pursuit(self, state)
