"""Walker-walk: a planar walker of seven capsules keeps upright and walks at 1 m/s.

Model, observation, reward and reset follow DeepMind Control Suite's walker-walk (Tassa et al. 2018;
figures from dm_control 1.0.50).
"""

import importlib.resources

import jax
import jax.numpy as jnp
import mujoco

from mjx_cl import physics as physics_lib
from mjx_cl.physics.fields import FAULTY
from mjx_cl.types import EnvState, Model, Spec, Step, Var

STAND_HEIGHT = 1.2  # [m]
WALK_SPEED = 1.0  # [m/s]
BODIES = ("torso", "right_thigh", "right_leg", "right_foot", "left_thigh", "left_leg", "left_foot")
# deviation of each channel while the shipped agent walks
SCALES = (
  0.027, 0.14, 0.46, 0.34, 0.22, 0.46, 0.52, 0.67, 0.045, 0.14, 0.2, 0.21, 0.1, 0.28, 0.067, 0.67,
  0.55, 2.2, 10.0, 16.0, 15.0, 3.0, 5.7, 7.4,
)  # fmt: skip
JOINTS = ("right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle")


def load_model() -> mujoco.MjModel:
  """The walker as mujoco.MjModel (28.540 kg, 6 motors, physics step 0.0025 s)."""
  return mujoco.MjModel.from_xml_string(
    importlib.resources.files("mjx_cl.envs").joinpath("assets/walker.xml").read_text()
  )


def angles(qpos: jax.Array) -> jax.Array:
  """Angle of each body about +y [rad], (7,) in tree order, from qpos (9,) = rootz, rootx, rooty,
  right leg, left leg.
  """
  root = qpos[2]
  right = root - jnp.cumsum(qpos[3:6])  # leg hinges turn about -y
  left = root - jnp.cumsum(qpos[6:9])
  return jnp.concatenate([root[None], right, left])


def center_x(qpos: jax.Array, mass: jax.Array) -> jax.Array:
  """Position of the centre of mass along x [m], (), for body masses (7,) [kg].

  Chain of each leg: hip 0.3 m below the torso's centre, thigh centre 0.225 below the hip, knee 0.45
  below the hip, leg centre 0.25 below the knee, ankle 0.5 below the knee, foot centre 0.06 ahead of
  the ankle. A point (dx, dz) of a body at angle a lies at x + cos(a) dx + sin(a) dz. Each body's
  own centre of mass is taken at its nominal place, under fault `com` too, which at severity 1
  changes the reward by up to 0.02 a step.
  """
  sin, cos = jnp.sin(angles(qpos)), jnp.cos(angles(qpos))
  torso = qpos[1]
  hip = torso - 0.3 * sin[0]
  xs = [torso]
  for thigh, leg, foot in ((1, 2, 3), (4, 5, 6)):
    knee = hip - 0.45 * sin[thigh]
    xs += [
      hip - 0.225 * sin[thigh],
      knee - 0.25 * sin[leg],
      knee - 0.5 * sin[leg] + 0.06 * cos[foot],
    ]
  return jnp.dot(jnp.stack(xs), mass) / jnp.sum(mass)


def observe(qpos: jax.Array, qvel: jax.Array) -> jax.Array:
  """Observation, float32 (24,): (cos, sin) of each body's angle (14), torso height [m] (1), qvel
  [m/s, rad/s] (9).
  """
  a = angles(qpos)
  orientation = jnp.stack([jnp.cos(a), jnp.sin(a)], -1).reshape(-1)  # xmat xx and xz
  return jnp.concatenate([orientation, 1.3 + qpos[:1], qvel])


REWARD_TERMS = {"standing": 3.0, "upright": 1.0, "move": 5.0}  # weights
WEIGHTS = tuple(REWARD_TERMS.values())


def reward(
  qpos: jax.Array,
  qvel: jax.Array,
  mass: jax.Array,
  weights: jax.Array | tuple[float, ...] = WEIGHTS,
  speed_asked: jax.Array | float = WALK_SPEED,
) -> jax.Array:
  """Walk reward in [0, 1], float32 (), for weights (3, 1, 5) of REWARD_TERMS and the speed asked
  for [m/s].

  standing = 1 if height >= 1.2 m else 0.1 ** (((1.2 - height) / 0.6) ** 2)
  upright  = (1 + cos(torso angle)) / 2
  reward   = (3 standing + upright) / 4 * (5 clip(v_x / speed asked, 0, 1) + 1) / 6
  v_x      = velocity of the centre of mass [m/s]
  """
  height = 1.3 + qpos[0]
  short = jnp.maximum(STAND_HEIGHT - height, 0.0) / 0.6
  standing = jnp.exp(jnp.log(0.1) * short * short)
  upright = (1.0 + jnp.cos(qpos[2])) / 2.0
  _, speed = jax.jvp(lambda q: center_x(q, mass), (qpos,), (qvel,))
  move = jnp.clip(speed / speed_asked, 0.0, 1.0)
  return (weights[0] * standing + weights[1] * upright) / 4.0 * (weights[2] * move + 1.0) / 6.0


def make_spec(mj_model: mujoco.MjModel) -> Spec:
  """Names, units and groups, with the model's numbers of geoms and bodies."""
  obs = (
    *(Var(f"{b}_{k}", "1", -1, 1) for b in BODIES for k in ("xx", "xz")),
    Var("height", "m"),
    Var("vel_rootz", "m/s"),
    Var("vel_rootx", "m/s"),
    Var("vel_rooty", "rad/s"),
    *(Var(f"vel_{j}", "rad/s") for j in JOINTS),
  )
  return Spec(
    name="walker",
    obs=tuple(v._replace(scale=s) for v, s in zip(obs, SCALES)),
    act=tuple(Var(j, "1", -1, 1) for j in JOINTS),
    control_s=0.025,
    episode_steps=1000,
    # mean reward per step; one that stands still earns 0.17, one that walks and never falls 0.95
    acceptance=0.8,
    posture=(14, 0.9),  # mean torso height [m]; 1.2 is standing, 0.3 is lying
    targets=JOINTS,
    act_groups=(("right_leg", (0, 1, 2)), ("left_leg", (3, 4, 5)), ("all", tuple(range(6)))),
    obs_groups=(
      ("orientations", tuple(range(14))),
      ("height", (14,)),
      ("velocities", tuple(range(15, 24))),
    ),
    feet=tuple((foot, (mj_model.geom(foot).id,)) for foot in ("right_foot", "left_foot")),
    bodies=tuple((b, (mj_model.body(b).id,)) for b in BODIES),
    watched=(
      ("torso_orientation", (0, 1)),
      ("right_orientation", tuple(range(2, 8))),
      ("left_orientation", tuple(range(8, 14))),
      ("height", (14,)),
      ("torso_velocity", (15, 16)),
      ("torso_pitch_rate", (17,)),
      ("right_velocity", (18, 19, 20)),
      ("left_velocity", (21, 22, 23)),
    ),
  )


class Walker:
  """Walker-walk. No early termination; truncated after 1,000 control steps of 0.025 s (10 physics
  steps).

  Reset (DMC's): the six leg joints uniform in their ranges, torso angle uniform in (-pi, pi),
  everything else 0, torso centre at 1.3 m, not settled. Observation and reward use their own
  kinematics of qpos and qvel, so they are current and equal on both backends.
  """

  def __init__(self, physics: str = "auto") -> None:
    self.mj_model = load_model()
    self.physics = physics_lib.make(physics, self.mj_model, substeps=10)
    low, high = self.mj_model.jnt_range[3:].T
    self._low, self._high = jnp.asarray(low, jnp.float32), jnp.asarray(high, jnp.float32)
    self._mass = jnp.asarray(self.mj_model.body_mass[1:], jnp.float32)
    self.spec = make_spec(self.mj_model)
    self.reward_terms = tuple(REWARD_TERMS)
    self.model = Model(
      mj=physics_lib.leaves(self.mj_model, *FAULTY, backend=self.physics),
      task={
        "reward_weights": jnp.asarray(WEIGHTS, jnp.float32),
        "command_range": jnp.asarray([WALK_SPEED], jnp.float32),
      },
      force=jnp.zeros(self.mj_model.nv),
    )

  def init(self, model: Model, key: jax.Array) -> tuple[EnvState, jax.Array]:
    """A fresh episode drawn from `key`: state and observation (24,)."""
    key_leg, key_root = jax.random.split(key)
    legs = jax.random.uniform(key_leg, (6,), minval=self._low, maxval=self._high)
    if "jnt_range" in model.mj:  # a joint that has lost range starts within what is left
      legs = jnp.clip(legs, *model.mj["jnt_range"][3:].T)
    root = jax.random.uniform(key_root, (), minval=-jnp.pi, maxval=jnp.pi)
    qpos, qvel = jnp.concatenate([jnp.zeros(2), root[None], legs]), jnp.zeros(9)
    return EnvState(self.physics.init(qpos, qvel), jnp.int32(0)), observe(qpos, qvel)

  def step(self, model: Model, state: EnvState, action: jax.Array) -> tuple[EnvState, Step]:
    """One control step with action (6,), clipped to [-1, 1]."""
    inner, out = self.physics.step(
      model.mj, state.physics, jnp.clip(action, -1.0, 1.0), force=model.force
    )
    obs, step = observe(out["qpos"], out["qvel"]), state.step + 1
    mass = model.mj["body_mass"][1:] if "body_mass" in model.mj else self._mass
    earned = reward(
      out["qpos"], out["qvel"], mass, model.task["reward_weights"], model.task["command_range"][0]
    )
    truncated = step >= self.spec.episode_steps
    return EnvState(inner, step), Step(obs, earned, jnp.bool_(False), truncated, obs)
