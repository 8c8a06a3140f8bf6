"""Environments of Brax and MuJoCo Playground as robots of this package: `brax:NAME` and
`playground:NAME` wherever a robot is named, `from_brax` and `from_playground` for one that is at
hand. Both step MuJoCo XLA, so that faults reach their models' fields.
"""

import contextlib
import copy
import importlib
import io
import types
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from mjx_cl.envs.mjcf import FIELDS, describe
from mjx_cl.errors import UserError, choose
from mjx_cl.types import EnvState, Model, Step


class Held(NamedTuple):
  """What one robot keeps.

  Attributes:
    data: mjx.Data, or what brax makes of it.
    state: the rest of the environment's own state.
  """

  data: Any
  state: Any


class Access(NamedTuple):
  """How a kind of environment holds its model and its state.

  Attributes:
    model: name of the attribute that holds the mjx.Model.
    data: name of the state's field that holds the mjx.Data.
  """

  model: str
  data: str


BRAX = Access("sys", "pipeline_state")
PLAYGROUND = Access("_mjx_model", "data")


class External:
  """An environment with `reset(key) -> state` and `step(state, action) -> state`, where a state has
  `obs`, `reward` and `done`, as a robot: `spec`, `model`, `init`, `step`.

  An episode terminates where `done` is set and is truncated after `episode_steps`. What a fault
  owns replaces the fields of the environment's mjx.Model for that step, with the constants that
  follow from masses (physics.mjx); forces go to qfrc_applied. The reward and its weights are the
  environment's own.

  Raises:
    UserError: an observation that is not one vector.
  """

  def __init__(
    self,
    env: Any,
    access: Access,
    mj_model: mujoco.MjModel,
    name: str,
    episode_steps: int,
    acceptance: float,
    scale: float | Sequence[float],
  ) -> None:
    from mjx_cl.physics.mjx import Mjx  # a costly import

    self.env, self.access, self.mj_model = env, access, mj_model
    own = getattr(env, access.model)
    self.physics = Mjx(mj_model, 1, model=own)
    fields = [field for field in FIELDS if field not in ("gravity", *self.physics.inert)]
    self.model = Model(
      {field: jnp.asarray(getattr(own, field), jnp.float32) for field in fields}
      | {"gravity": jnp.asarray(own.opt.gravity, jnp.float32)},
      {},
      jnp.zeros(mj_model.nv),
    )
    obs = vector(jax.eval_shape(env.reset, jax.random.key(0)).obs)
    if len(obs.shape) != 1:
      raise UserError(f"robot {name!r} observes arrays of shape {obs.shape}; one vector is needed")
    names = tuple(f"obs_{i}" for i in range(obs.shape[0]))
    self.spec = describe(
      mj_model, name, names, float(env.dt), episode_steps, acceptance, scale=scale
    )

  def init(self, model: Model, key: jax.Array) -> tuple[EnvState, jax.Array]:
    """A fresh episode drawn from `key`: state and observation."""
    state = self._told(model).reset(key)
    return EnvState(self._held(state), jnp.int32(0)), vector(state.obs)

  def step(self, model: Model, state: EnvState, action: jax.Array) -> tuple[EnvState, Step]:
    """One control step with an action in [-1, 1]."""
    data, rest = state.physics
    if model.force is not None:
      data = data.replace(qfrc_applied=jnp.asarray(model.force, data.qfrc_applied.dtype))
    before = rest.replace(**{self.access.data: data})
    after = self._told(model).step(before, jnp.clip(action, -1.0, 1.0))
    obs, now, ended = vector(after.obs), state.step + 1, after.done > 0
    late = (now >= self.spec.episode_steps) & ~ended
    reward = jnp.asarray(after.reward, jnp.float32)
    return EnvState(self._held(after), now), Step(obs, reward, ended, late, obs)

  def _told(self, model: Model) -> Any:
    """The environment, with the fields of a Model in place of its own."""
    if not model.mj:
      return self.env
    env = copy.copy(self.env)
    setattr(env, self.access.model, self.physics.model(model.mj))
    return env

  def _held(self, state: Any) -> Held:
    return Held(getattr(state, self.access.data), state.replace(**{self.access.data: None}))


def vector(obs: Any) -> Any:
  """The observation; of a dict what the policy sees, `state`."""
  if isinstance(obs, dict):
    return choose("observation", "state", obs)
  return obs


def from_brax(
  env: Any,
  name: str | None = None,
  episode_steps: int = 1000,
  acceptance: float = 0.0,
  scale: float | Sequence[float] = 1.0,
) -> External:
  """A `brax.envs.PipelineEnv` of backend mjx as a robot, without brax's wrappers.

  Args:
    env: environment.
    name: what tables and agents' cards call it; None: that of its class.
    episode_steps: control steps until truncation.
    acceptance: mean reward a control step from which the task counts as done well enough.
    scale: typical deviation of the observation, a number or one for each entry: the unit of faults
      of its sensors.

  Raises:
    UserError: another backend, or an observation that is not one vector.

  Example:
    Ant = lambda: from_brax(brax.envs.get_environment("ant", backend="mjx"), acceptance=3.0)
  """
  if getattr(env, "backend", None) != "mjx":
    got = getattr(env, "backend", type(env).__name__)
    raise UserError(f"faults change MuJoCo's model: brax's backend must be mjx; got {got}")
  name = name or type(env).__name__.lower()
  return External(env, BRAX, env.sys.mj_model, name, episode_steps, acceptance, scale)


def from_playground(
  env: Any,
  name: str | None = None,
  episode_steps: int = 1000,
  acceptance: float = 0.0,
  scale: float | Sequence[float] = 1.0,
) -> External:
  """A `mujoco_playground.MjxEnv` of implementation jax as a robot; arguments as of `from_brax`.

  Example:
    run = registry.load("CheetahRun", config_overrides={"impl": "jax"})
    Cheetah = lambda: from_playground(run, acceptance=0.8)
  """
  name = name or type(env).__name__.lower()
  return External(env, PLAYGROUND, env.mj_model, name, episode_steps, acceptance, scale)


def _imported(package: str, extra: str) -> types.ModuleType:
  """A package; what its import prints stays off standard output."""
  try:
    with contextlib.redirect_stdout(io.StringIO()):
      return importlib.import_module(package)
  except ImportError as e:
    raise UserError(f"this robot needs {package} ({e}): pip install {extra}") from None


def brax_robot(name: str) -> External:
  """`brax:NAME`."""
  envs = _imported("brax.envs", "brax")
  choose("brax environment", name, envs._envs)
  return from_brax(envs.get_environment(name, backend="mjx"), f"brax:{name}")


def playground_robot(name: str) -> External:
  """`playground:NAME`, with its own length of an episode."""
  registry = _imported("mujoco_playground", "playground").registry
  choose("playground environment", name, dict.fromkeys(registry.ALL_ENVS))
  steps = int(registry.get_default_config(name).episode_length)
  env = registry.load(name, config_overrides={"impl": "jax"})
  return from_playground(env, f"playground:{name}", steps)


LIBRARIES: dict[str, Callable[[str], External]] = {
  "brax": brax_robot,
  "playground": playground_robot,
}
