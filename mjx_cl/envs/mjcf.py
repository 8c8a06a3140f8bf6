"""A robot out of a MuJoCo model and three functions: `Robot`."""

import os
import pathlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_cl import physics as physics_lib
from mjx_cl.errors import PluginError, UserError
from mjx_cl.physics.fields import FAULTY
from mjx_cl.types import EnvState, Model, Spec, Step, Var

Pose = tuple[jax.Array, jax.Array]  # float32 qpos (nq,), qvel (nv,)


class Robot:
  """A task on a MuJoCo model: derive from it, set `mjcf`, write `observe` and `reward`.

  Actions in [-1, 1] are scaled to each actuator's ctrlrange, where it has one. Motors (else the
  joints that they drive), bodies and feet have the model's names. Functions are pure, of one robot,
  in jax.numpy.

  Attributes:
    mjcf: path of an MJCF file, its text, or a mujoco.MjModel.
    name: what tables and agents' cards call it; None: that of the class in lower case.
    substeps: physics steps of a control step.
    episode_steps: control steps until truncation.
    acceptance: mean reward a control step from which the task counts as done well enough.
    names: of the observation's entries; None: obs_0, obs_1, ...
    scale: typical deviation of the observation while the healthy robot is at work, a number or one
      for each entry: the unit of faults of its sensors.
    feet: name -> names of geoms that touch the ground; None: those geoms of bodies without children
      that can touch something.
    noise: half-width of the uniform noise on qpos and qvel of a fresh episode.

  Raises:
    UserError: no such file, not a MuJoCo model.
    PluginError: `observe` gives no vector.

  Example: docs/extending.md
  """

  mjcf: Any = None
  name: str | None = None
  substeps: int = 1
  episode_steps: int = 1000
  acceptance: float = 0.0
  names: Sequence[str] | None = None
  scale: float | Sequence[float] = 1.0
  feet: dict[str, Sequence[str]] | None = None
  noise: float = 0.005

  def __init__(self, physics: str = "auto") -> None:
    self.mj_model = host = load(self.mjcf)
    self.physics = physics_lib.make(physics, host, self.substeps)
    low, high = host.actuator_ctrlrange.T.astype(np.float32)
    limited = host.actuator_ctrllimited.astype(bool)
    self._middle = jnp.asarray(np.where(limited, (low + high) / 2, 0))
    self._half = jnp.asarray(np.where(limited, (high - low) / 2, 1))
    self.model = Model(
      physics_lib.leaves(host, *FAULTY, backend=self.physics), {}, jnp.zeros(host.nv)
    )
    like = (
      jax.ShapeDtypeStruct((host.nq,), np.float32),
      jax.ShapeDtypeStruct((host.nv,), np.float32),
    )
    shape = getattr(jax.eval_shape(self.observe, *like), "shape", None)
    if shape is None or len(shape) != 1:
      raise PluginError(f"observe gives {shape or 'no array'}; one vector is needed")
    self.spec = describe(
      host,
      self.name or type(self).__name__.lower(),
      tuple(self.names or (f"obs_{i}" for i in range(shape[0]))),
      float(host.opt.timestep) * self.substeps,
      self.episode_steps,
      self.acceptance,
      self.scale,
      self.feet,
    )

  def observe(self, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """What the sensors of the robot say, float32 (O,)."""
    return jnp.concatenate([qpos, qvel])

  def reward(self, before: Pose, after: Pose, action: jax.Array) -> Any:
    """Reward () of a control step from `before` to `after` under `action` (nu,) in [-1, 1]."""
    raise NotImplementedError(f"{type(self).__name__} has no reward")

  def terminated(self, qpos: jax.Array, qvel: jax.Array) -> Any:
    """Whether the episode ends in a state that is worth nothing from there on, bool ()."""
    return False

  def reset(self, key: jax.Array) -> Pose:
    """Pose of a fresh episode: the model's own, with `noise`."""
    host, (one, two) = self.mj_model, jax.random.split(key)
    spread = lambda k, n: jax.random.uniform(k, (n,), minval=-self.noise, maxval=self.noise)
    return jnp.asarray(host.qpos0, jnp.float32) + spread(one, host.nq), spread(two, host.nv)

  def init(self, model: Model, key: jax.Array) -> tuple[EnvState, jax.Array]:
    """A fresh episode drawn from `key`: state and observation."""
    qpos, qvel = self.reset(key)
    obs = jnp.asarray(self.observe(qpos, qvel), jnp.float32)
    return EnvState((self.physics.init(qpos, qvel), (qpos, qvel)), jnp.int32(0)), obs

  def step(self, model: Model, state: EnvState, action: jax.Array) -> tuple[EnvState, Step]:
    """One control step with an action (nu,), clipped to [-1, 1]."""
    (inner, before), now = state.physics, state.step + 1
    action = jnp.clip(action, -1.0, 1.0)
    told = self._middle + self._half * action
    inner, out = self.physics.step(model.mj, inner, told, force=model.force)
    after = out["qpos"], out["qvel"]
    obs = jnp.asarray(self.observe(*after), jnp.float32)
    ended = jnp.asarray(self.terminated(*after), bool)
    late = (now >= self.spec.episode_steps) & ~ended
    reward = jnp.asarray(self.reward(before, after, action), jnp.float32)
    return EnvState((inner, after), now), Step(obs, reward, ended, late, obs)


def load(mjcf: Any) -> mujoco.MjModel:
  """A path, a text of MJCF, or a model that is there already, as mujoco.MjModel."""
  if isinstance(mjcf, mujoco.MjModel):
    return mjcf
  if not isinstance(mjcf, (str, os.PathLike)):
    raise UserError(
      f"mjcf must be a path, a text of MJCF or a mujoco.MjModel; got {type(mjcf).__name__}"
    )
  text = isinstance(mjcf, str) and mjcf.lstrip().startswith("<")
  if not text and not pathlib.Path(mjcf).is_file():
    raise UserError(f"no file {mjcf} for mjcf")
  make = mujoco.MjModel.from_xml_string if text else mujoco.MjModel.from_xml_path
  try:
    return make(str(mjcf))
  except ValueError as e:
    raise UserError(f"mjcf is no MuJoCo model: {' '.join(str(e).split())}") from None


def describe(
  host: mujoco.MjModel,
  name: str,
  names: tuple[str, ...],
  control_s: float,
  episode_steps: int,
  acceptance: float,
  scale: float | Sequence[float] = 1.0,
  feet: dict[str, Sequence[str]] | None = None,
) -> Spec:
  """Spec of a robot by what its MuJoCo model says; arguments as the attributes of `Robot`."""
  scales = np.broadcast_to(np.asarray(scale, np.float32), (len(names),))
  motors = tuple(_motor(host, i) for i in range(host.nu))
  # what is welded to the world is ground
  bodies = [b for b in range(1, host.nbody) if host.body_mass[b] > 0 and host.body_weldid[b]]
  ids = (
    _feet(host)
    if feet is None
    else {foot: tuple(_geom(host, g) for g in geoms) for foot, geoms in feet.items()}
  )
  return Spec(
    name=name,
    obs=tuple(Var(n, "1", scale=float(x)) for n, x in zip(names, scales)),
    act=tuple(Var(motor, "1", -1, 1) for motor in motors),
    control_s=control_s,
    episode_steps=episode_steps,
    acceptance=acceptance,
    posture=None,
    targets=motors,
    feet=tuple(ids.items()),
    bodies=tuple((_body(host, b), (b,)) for b in bodies),
  )


def _feet(host: mujoco.MjModel) -> dict[str, tuple[int, ...]]:
  """Geoms that can touch something, of bodies without children, by body."""
  parents = set(host.body_parentid.tolist())
  out: dict[str, tuple[int, ...]] = {}
  for geom in range(host.ngeom):
    body = int(host.geom_bodyid[geom])
    touches = host.geom_contype[geom] or host.geom_conaffinity[geom]
    if host.body_weldid[body] and body not in parents and touches:
      out[_body(host, body)] = (*out.get(_body(host, body), ()), geom)
  return out


def _geom(host: mujoco.MjModel, name: str) -> int:
  index = mujoco.mj_name2id(host, mujoco.mjtObj.mjOBJ_GEOM, name)
  if index < 0:
    have = ", ".join(filter(None, (host.geom(i).name for i in range(host.ngeom))))
    raise UserError(f"feet: the model has no geom {name!r}; it has {have or 'none with a name'}")
  return index


def _motor(host: mujoco.MjModel, i: int) -> str:
  """Name of an actuator, else of the joint that it drives."""
  joint = host.actuator_trnid[i, 0]
  drives = host.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
  return host.actuator(i).name or (host.joint(joint).name if drives else "") or f"actuator_{i}"


def _body(host: mujoco.MjModel, i: int) -> str:
  return host.body(i).name or f"body_{i}"
