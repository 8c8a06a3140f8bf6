"""Car_real: the car as a four-wheel MuJoCo vehicle, a stand-in for the laboratory's car to which
the simulator's policy is moved.

Observation, action, reward and tracks are those of `car`. What differs is of two kinds. The vehicle
itself: suspension, wheels with a spin of their own, load that moves between four wheels, Coulomb
friction at each of them (assets/car.xml); this is never switched off. And the reality gap: the
items of `GAP`, each named, with its source, and switchable; together they are one identified 1:10
car ("NUC2", ForzaETH's race stack) as far as figures of it were at hand.
"""

import importlib.resources
import types
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_cl import physics as physics_lib
from mjx_cl.envs import racing
from mjx_cl.envs.car import nominal
from mjx_cl.envs.course import Course
from mjx_cl.envs.racing import Motion
from mjx_cl.envs.tracks import Track
from mjx_cl.errors import choose
from mjx_cl.types import EnvState, Model, Step

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
RADIUS = 0.0492  # of a wheel under load [m]: 0.05 less half of what tyre and floor give way
TRACK = 0.25  # between left and right wheels [m]
WHEEL_INERTIA = 0.00015  # of a wheel about its axle [kg m2]
# torque on a wheel per difference of its axle's speed from the mean of both [N m s/rad]
SHAFT = 0.01
# of the steering hinges [N m s/rad]; with a servo torque of as much per rad/s they turn at the rate
# asked for
STEER_DAMPING = 0.5
# what the motor accelerates, spinning wheels included: 3.98 [kg]
INERTIAL_MASS = racing.MASS + 4 * WHEEL_INERTIA / RADIUS**2
SUBSTEPS = 10  # physics steps of 0.005 s in a control step of 0.05 s
LONGEST_DELAY = 3  # of a command [control steps]


class Item(NamedTuple):
  """One part of the reality gap.

  Attributes:
    unit: of the two values.
    simulator: value in `car`.
    real: value of the real car.
    leaf: of the Model, that carries it.
    source: of the real value; "estimate" where none was found.
  """

  unit: str
  simulator: float
  real: float
  leaf: str
  source: str


GAP = {
  "steering_lag": Item(
    "s",
    racing.STEER_LAG,
    0.158,
    "task.steer_lag_s",
    "ForzaETH race stack, NUC2: steering as first-order lag",
  ),
  "command_delay": Item(
    "control steps",
    0.0,
    1.0,
    "task.delay",
    "ForzaETH race stack, simulator: buffer of 5 commands of 10 ms",
  ),
  "speed_lag": Item(
    "s",
    0.0,
    0.1,
    "task.speed_lag_s",
    "estimate: filter and ramp of the motor controller's speed loop",
  ),
  "acceleration": Item(
    "m/s2", racing.ACCEL_MAX, 3.0, "task.accel_max", "ForzaETH race stack, NUC2: acceleration +-3"
  ),
  "lidar_noise": Item(
    "m",
    racing.LIDAR_SIGMA,
    0.03,
    "task.noise",
    "data sheet of the usual scanner, Hokuyo UST-10LX: repeatability sigma < 30 mm",
  ),
  "speed_noise": Item(
    "m/s", 0.0, 0.05, "task.speed_noise", "estimate: wheel odometry at 1 % of 5 m/s"
  ),
  "yaw_rate_noise": Item(
    "rad/s", 0.0, 0.05, "task.yaw_rate_noise", "estimate: gyroscope on a vibrating chassis"
  ),
  "steering_offset": Item(
    "rad", 0.0, 0.02, "task.steer_offset", "estimate: trim of the servo horn, 1 degree"
  ),
  "mass": Item("kg", racing.MASS, 3.54, "mj.body_mass", "ForzaETH race stack, NUC2"),
  "yaw_inertia": Item(
    "kg m2", racing.INERTIA, 0.05797, "mj.body_inertia", "ForzaETH race stack, NUC2"
  ),
  "grip": Item(
    "1",
    racing.FRICTION,
    0.65,
    "mj.geom_friction",
    "ForzaETH race stack, NUC2: peak D of the Pacejka fits, front 0.650, rear 0.618",
  ),
}


def load_model() -> mujoco.MjModel:
  """The vehicle with the simulator's figures as mujoco.MjModel: 3.74 kg, 16 degrees of freedom,
  physics step 0.005 s.
  """
  return mujoco.MjModel.from_xml_string(
    importlib.resources.files("mjx_cl.envs").joinpath("assets/car.xml").read_text()
  )


def widen(model: Model, name: str, share: jax.Array | float, wheels: tuple[int, ...]) -> Model:
  """The model with gap item `name` moved by `share` of its gap: from a simulator's value to the
  real one for 1, and on beyond it.

    acceleration, grip (of the wheels), mass (of every body): x (real / simulator)^share
    the others:                                               x + share (real - simulator)

  Yaw inertia changes in the chassis alone. Masses scale the wheels' part of it too: with the whole
  gap it is 0.0569 kg m2, 1.9 % below the real one.

  Share 0 leaves every bit. A fault of the same item is this function of its severity; constants
  that follow from masses are the backend's business.

  Args:
    wheels: geoms of the four wheels.
  """
  item: Any = choose("gap item", name, GAP)
  where, leaf = item.leaf.split(".")
  table = getattr(model, where)
  value, more = table[leaf], share * (item.real - item.simulator)
  if name in ("acceleration", "grip", "mass"):
    less = jnp.exp(share * np.float32(np.log(item.real / item.simulator)))  # 1 exactly for share 0
    value = value.at[jnp.asarray(wheels), 0].multiply(less) if name == "grip" else value * less
  elif name == "yaw_inertia":
    value = value.at[1, 2].add(more)  # body 1 is the chassis
  else:
    value = value + more
  return model._replace(**{where: table | {leaf: value}})


def ackermann(xp: types.ModuleType, angle: Any) -> Any:
  """Angles of the left and right front wheel [rad] at which both roll about one centre, for the
  angle of a wheel in the middle: (..., 2).

  tan d_left = tan d / (1 - w tan d),   tan d_right = tan d / (1 + w tan d),   w = half the track /
    wheelbase
  """
  t, w = xp.tan(angle), TRACK / 2 / racing.WHEELBASE
  return xp.stack([xp.arctan(t / (1 - w * t)), xp.arctan(t / (1 + w * t))], -1)


def middle(left: jax.Array, right: jax.Array) -> jax.Array:
  """Steering angle [rad] of a wheel in the middle, from the two front wheels: mean of what each of
  them says (see `ackermann`).
  """
  w = TRACK / 2 / racing.WHEELBASE
  left, right = jnp.tan(left), jnp.tan(right)
  return (jnp.arctan(left / (1 + w * left)) + jnp.arctan(right / (1 - w * right))) / 2


def motor_law(mj_model: mujoco.MjModel) -> Callable[..., Any]:
  """Motor law of the vehicle: ctrl (..., 2) = steering angle [rad], speed [m/s] -> torques of 2
  steering and 4 wheel motors [N m].

    goal   = ackermann(clip(strength_0 angle_commanded + offset, +-0.4189))
    rate   = clip((goal - angle) (1 - exp(-dt / lag)) / dt, -limit_0, limit_0)
    torque = rate x damping of the hinge                        of a steering motor
    a      = clip(k (min(speed, limit_1) - r w), +-a_max)       w = mean speed of the wheels [rad/s]
    torque = strength_1 m a r / 4 + c (w - w_axle)              of a wheel, c = 0.01 N m s/rad

  k = 4.755 1/s to speed up, 19.02 to brake, and four driven wheels, as in `car`. One shaft turns
  both axles (the second term, as stiff as the physics step allows); behind it left and right share
  the torque evenly, so that one wheel on ice takes its share with it. The motor measures its own
  speed, not the car's. `steer_lag_s` is the time constant of the steering angle, at least 0.01 s;
  dt = 0.005 s.
  """
  angles = [mj_model.joint(n).qposadr[0] for n in ("steering_left", "steering_right")]
  dt = float(mj_model.opt.timestep)
  spins = [mj_model.joint(f"spin_{n}").dofadr[0] for n in WHEELS]

  def law(xp: types.ModuleType, task: dict[str, Any], ctrl: Any, qpos: Any, qvel: Any) -> Any:
    goal = task["strength"][..., 0] * ctrl[..., 0] + task["steer_offset"]
    goal = ackermann(xp, xp.clip(goal, -racing.STEER_MAX, racing.STEER_MAX))
    gain = (1 - xp.exp(-dt / xp.maximum(task["steer_lag_s"], 0.01)[..., None])) / dt
    most = task["velocity_limit"][..., :1]
    rate = xp.clip((goal - xp.stack([qpos[..., i] for i in angles], -1)) * gain, -most, most)
    front = (qvel[..., spins[0]] + qvel[..., spins[1]]) / 2
    rear = (qvel[..., spins[2]] + qvel[..., spins[3]]) / 2
    error = xp.minimum(ctrl[..., 1], task["velocity_limit"][..., 1]) - RADIUS * (front + rear) / 2
    accel = xp.where(error > 0, racing.GAIN_UP, racing.GAIN_DOWN) * error
    accel = xp.clip(accel, -task["accel_max"], task["accel_max"])
    torque = INERTIAL_MASS * RADIUS / 4 * task["strength"][..., 1] * accel
    shaft = SHAFT * (rear - front) / 2
    wheels = [torque + shaft, torque + shaft, torque - shaft, torque - shaft]
    return xp.concatenate([STEER_DAMPING * rate, xp.stack(wheels, -1)], -1)

  return law


class CarRealState(NamedTuple):
  """State of one car.

  Attributes:
    backend: of the physics; opaque.
    motion: Motion, of the chassis' origin (the centre of gravity), projected on the floor.
    track: int32 (), index of its track.
    sent: float32 (3, 2), the last commands, newest first: steering angle [rad], speed [m/s]; zero
      before the first.
    speed: float32 (), speed that the motor controller pursues, the lagged command [m/s].
    key: of the sensors' noise.
  """

  backend: object
  motion: Motion
  track: jax.Array
  sent: jax.Array
  speed: jax.Array
  key: jax.Array


def read_motion(qpos: jax.Array, qvel: jax.Array) -> tuple[Motion, jax.Array]:
  """Motion, and how upright the car is: the z part of its own vertical, 1 on its wheels. From
  qpos (17,), qvel (16,).
  """
  w, x, y, z = qpos[3], qpos[4], qpos[5], qpos[6]
  yaw = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
  sin, cos = jnp.sin(yaw), jnp.cos(yaw)
  motion = Motion(
    qpos[0],
    qpos[1],
    yaw,
    cos * qvel[0] + sin * qvel[1],
    cos * qvel[1] - sin * qvel[0],
    qvel[5],
    middle(qpos[8], qpos[11]),
  )
  return motion, 1 - 2 * (x * x + y * y)


class CarReal(racing.Racer):
  """The four-wheel car on the tracks of `car`, with the reality gap switched on by name.

  Touching a wall, facing back along the track, or tipping over by 60 degrees, terminates; 1,200
  control steps of 0.05 s truncate. Reset as in `car`, on settled springs. `Model.task` as in `car`
  where the name is the same; besides

    accel_max: () [m/s2].
    speed_lag_s: () [s].
    delay: (), 0 to 3; a fraction gives the command's mean over the step [control steps].
    steer_offset: () [rad].
    speed_noise: () [m/s].
    yaw_rate_noise: () [rad/s].

  Args:
    physics: `auto`, `native` or `mjx`.
    gap: names of the items of GAP that have their real value; the others have the simulator's.
    tracks: see Course; by default its own six.
  """

  def __init__(
    self,
    physics: str = "auto",
    gap: tuple[str, ...] = tuple(GAP),
    tracks: Iterable[Track] | None = None,
  ) -> None:
    self.course = Course(tracks)
    self.mj_model = load_model()
    self.wheels = tuple(self.mj_model.geom(f"wheel_{n}").id for n in WHEELS)
    leaves = ("body_mass", "body_inertia", "body_ipos", "geom_friction", "dof_damping", "gravity")
    task: dict[str, Any] = {
      name: nominal()[name] for name in ("strength", "velocity_limit", "reward_weights")
    }
    task |= {i.leaf[5:]: i.simulator for i in GAP.values() if i.leaf.startswith("task.")}
    model = Model(
      physics_lib.leaves(self.mj_model, *leaves),
      {name: jnp.asarray(value, jnp.float32) for name, value in task.items()},
      jnp.zeros(self.mj_model.nv),
    )
    for name in gap:
      model = self.widen(model, name, 1.0)
    for leaf in {GAP[name].leaf[3:] for name in gap if GAP[name].leaf.startswith("mj.")}:
      getattr(self.mj_model, leaf)[:] = model.mj[leaf]
    data = mujoco.MjData(self.mj_model)
    mujoco.mj_setConst(self.mj_model, data)
    mujoco.mj_step(self.mj_model, data, 400)  # 2 s: the springs settle
    self._rest = jnp.asarray(data.qpos, jnp.float32)
    self.model, self.gap_items = model, GAP
    self.physics = physics_lib.make(physics, self.mj_model, SUBSTEPS, law=motor_law(self.mj_model))
    # no crash; the reference driver earns 0.95 without the gap, 0.64 with
    spec = racing.spec("car_real", self.course, acceptance=0.5)
    front, rear = self.wheels[:2], self.wheels[2:]
    own = tuple((n, (g,)) for n, g in zip(WHEELS, self.wheels))
    self.spec = spec._replace(
      feet=(("front", front), ("rear", rear), *own),
      bodies=tuple((n, (self.mj_model.body(n).id,)) for n in ("chassis", *WHEELS)),
    )

  def widen(self, model: Model, name: str, share: jax.Array | float) -> Model:
    """The model with gap item `name` moved by `share` of its gap, see the function `widen`."""
    return widen(model, name, share, self.wheels)

  agents_of = "car"  # same observation, action and reward: what was learnt there may drive here

  def _observe(self, model: Model, motion: Motion, track: jax.Array, key: jax.Array) -> jax.Array:
    key_lidar, key_own = jax.random.split(key)
    ranges = self.course.scan(track, motion.x, motion.y, motion.yaw)
    noise = jax.random.normal(key_own, (2,))
    speed = motion.vx + model.task["speed_noise"] * noise[0]
    yaw_rate = motion.yaw_rate + model.task["yaw_rate_noise"] * noise[1]
    return racing.observe(
      self.course, ranges, speed, yaw_rate, motion.steer, model.task["noise"], key_lidar
    )

  def init(self, model: Model, key: jax.Array) -> tuple[EnvState, jax.Array]:
    """A fresh episode drawn from `key`: state and observation (67,)."""
    key_spawn, key_noise, key = jax.random.split(key, 3)
    track, x, y, yaw = self.course.spawn(key_spawn)
    zero = jnp.zeros(())
    turn = jnp.stack([jnp.cos(yaw / 2), zero, zero, jnp.sin(yaw / 2)])
    qpos = jnp.concatenate([jnp.stack([x, y]), self._rest[2:3], turn, self._rest[7:]])
    motion = Motion(x, y, yaw, zero, zero, zero, zero)
    state = CarRealState(
      self.physics.init(qpos, jnp.zeros(self.mj_model.nv)),
      motion,
      track,
      jnp.zeros((LONGEST_DELAY, 2)),
      zero,
      key,
    )
    return EnvState(state, jnp.int32(0)), self._observe(model, motion, track, key_noise)

  def step(self, model: Model, state: EnvState, action: jax.Array) -> tuple[EnvState, Step]:
    """One control step with action (2,), clipped to [-1, 1].

    command = sent[d] (1 - f) + sent[d + 1] f        delay = d + f control steps; sent[0] is the one
      of now
    speed'  = command + exp(-0.05 s / lag) (speed - command)
    """
    last = state.physics
    sent = jnp.concatenate([jnp.stack(racing.command(action))[None], last.sent])
    delay = jnp.clip(model.task["delay"], 0.0, LONGEST_DELAY)
    whole = jnp.minimum(delay.astype(jnp.int32), LONGEST_DELAY - 1)
    angle, speed = sent[whole] + (delay - whole) * (sent[whole + 1] - sent[whole])
    speed = speed + jnp.exp(-self.spec.control_s / jnp.maximum(model.task["speed_lag_s"], 1e-4)) * (
      last.speed - speed
    )
    backend, out = self.physics.step(
      model.mj, last.backend, jnp.stack([angle, speed]), model.task, model.force
    )
    motion, upright = read_motion(out["qpos"], out["qvel"])
    key_noise, key = jax.random.split(last.key)
    along = racing.progress(
      self.course, last.track, motion.x, motion.y, out["qvel"][0], out["qvel"][1]
    )
    crashed = self.crashed(last.track, motion) | ~(upright > 0.5)
    obs, step = self._observe(model, motion, last.track, key_noise), state.step + 1
    earned = racing.reward(along, crashed, model.task["reward_weights"])
    truncated = ~crashed & (step >= self.spec.episode_steps)
    arrived = CarRealState(backend, motion, last.track, sent[:-1], speed, key)
    return EnvState(arrived, step), Step(obs, earned, crashed, truncated, obs)
