"""Car: a 1:10 scale racing car keeps fast and off the walls of a track that it sees by lidar. The
simulator, pure JAX on every backend.

Integrator and single-track model follow the F1TENTH gym's car (O'Kelly et al. 2020); the tyre
saturates and each axle has its own friction. The rest of the task is in `racing`.
"""

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.envs.course import Course
from mjx_cl.envs.racing import (
  ACCEL_MAX,
  AXLES,
  CONTROL_S,
  FRICTION,
  GAIN_DOWN,
  GAIN_UP,
  GRAVITY,
  INERTIA,
  LIDAR_SIGMA,
  MASS,
  REWARD_TERMS,
  SPEED_MAX,
  STEER_LAG,
  STEER_MAX,
  STEER_RATE,
  WHEELBASE,
  Motion,
  Racer,
  command,
  observe,
  reward,
  spec,
)
from mjx_cl.envs.tracks import Track
from mjx_cl.errors import choose
from mjx_cl.physics import PURE_JAX
from mjx_cl.types import EnvState, Model, Step

STIFFNESS = (4.718, 5.4562)  # front, rear cornering stiffness per unit of load [1/rad]
HEIGHT = 0.074  # of the centre of gravity [m]
TRACTION = 0.95  # share of the grip that drive or brake force may take
SLOW = 1.0  # [m/s]; wheel speed below which slip is taken at this speed
SUBSTEPS = 5  # RK4 steps of a control step


class CarState(NamedTuple):
  """State of one car.

  Attributes:
    motion: of the car.
    track: int32 (), index of its track.
    key: of its lidar's noise.
  """

  motion: Motion
  track: jax.Array
  key: jax.Array


def nominal() -> dict[str, jax.Array]:
  """What a fault may change beside `Model.force`: `Model.task`, all float32.

  Returns:
    friction: (2,), of the front and rear tyres.
    mass: () [kg].
    inertia: () [kg m2].
    com: (2,), shift of the centre of gravity ahead, its height [m].
    strength: (2,), share of the steering angle, of the motor's force that arrives.
    velocity_limit: (2,), of the steering [rad/s], of the motor [m/s].
    steer_lag_s: () [s].
    noise: (), deviation of the lidar [m].
    gravity: (3,) in the world frame; a horizontal part is a tilted floor [m/s2].
    reward_weights: (2,), see `reward`.
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

    N_f = (m g l_r - F h) / (l_f + l_r),  N_r = (m g l_f + F h) / (l_f + l_r)
    q   = clip(drive / sum mu N, -0.95, 0.95)
    F_x = q mu N,  F_y = sqrt(1 - q^2) mu N tanh(C alpha)
    alpha = -atan2(w, max(|u|, 1))

  with F the drive force under the loads at rest, q the share of the grip that drives or brakes, per
  axle a slope C mu N at q = 0 and a friction ellipse, and (u, w) the velocity of the axle's centre
  along and across its wheels [m/s].

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
    a      = clip(k (min(speed, limit_1) - vx), -9.51, 9.51),  drive = strength_1 m_nominal a
    vx'    = sum F_ahead / m + vy r
    vy'    = sum F_left / m - vx r
    r'     = (l_f F_left,front - l_r F_left,rear + M) / I

  with k = 4.755 1/s to speed up, 19.02 to brake, and r the yaw rate.

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


class Car(Racer):
  """The simulated car on tracks of its own. Touching a wall, or facing back along the track,
  terminates; 1,200 control steps of 0.05 s truncate.

  Reset: a random track and place on it, at most 0.3 m and 0.2 rad off the centre line, at rest with
  straight wheels.

  Args:
    physics: `auto`, `native`, `mjx`: all mean the same, pure JAX.
    tracks: see Course; by default its own six.
  """

  def __init__(self, physics: str = "auto", tracks: Iterable[Track] | None = None) -> None:
    choose("physics", physics, dict.fromkeys(("auto", "native", "mjx")))
    self.physics = PURE_JAX
    self.course = Course(tracks)
    # 3 m/s along the track and no crash; the reference driver earns 0.93
    self.spec = spec("car", self.course, acceptance=0.6)
    self.model = Model(mj={}, task=nominal(), force=jnp.zeros(3))

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
    along = self.along(track, motion)
    crashed = self.crashed(track, motion)
    obs, step = self._observe(model, motion, track, key_noise), state.step + 1
    earned = reward(along, crashed, model.task["reward_weights"])
    truncated = ~crashed & (step >= self.spec.episode_steps)
    return EnvState(CarState(motion, track, key), step), Step(obs, earned, crashed, truncated, obs)
