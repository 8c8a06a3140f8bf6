"""Environments of Brax and MuJoCo Playground as robots of this package: `brax:NAME` and
`playground:NAME` wherever a robot is named, `External` for one that is at hand. Both step MuJoCo
XLA, so that faults reach their models' fields.
"""

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.envs.mjcf import describe
from mjx_cl.errors import UserError, choose
from mjx_cl.io import plugins
from mjx_cl.physics.fields import FAULTY
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
  """A `mujoco_playground.MjxEnv` of implementation jax, or a `brax.envs.PipelineEnv` of backend mjx
  without brax's wrappers, as a robot: `spec`, `model`, `init`, `step`.

  An episode terminates where its state's `done` is set and is truncated after `episode_steps`. What
  a fault owns replaces the fields of the environment's mjx.Model for that step, with the constants
  that follow from masses (physics.mjx); forces go to qfrc_applied. The reward and its weights are
  the environment's own.

  Args:
    env: environment.
    name: what tables and agents' cards call it; None: that of its class in lower case.
    episode_steps: control steps until truncation.
    acceptance: mean reward a control step from which the task counts as done well enough.
    scale: typical deviation of the observation, a number or one for each entry: the unit of faults
      of its sensors.

  Raises:
    UserError: another environment, or an observation that is not one vector.

  Example:
    Ant = lambda: External(brax.envs.get_environment("ant", backend="mjx"), acceptance=3.0)
  """

  def __init__(
    self,
    env: Any,
    name: str | None = None,
    episode_steps: int = 1000,
    acceptance: float = 0.0,
    scale: float | Sequence[float] = 1.0,
  ) -> None:
    from mjx_cl.physics.mjx import Mjx  # a costly import

    name = name or type(env).__name__.lower()
    if hasattr(env, PLAYGROUND.model):
      self.access, host = PLAYGROUND, env.mj_model
    elif getattr(env, "backend", None) == "mjx":
      self.access, host = BRAX, env.sys.mj_model
    else:
      raise UserError(f"robot {name!r} is none of MuJoCo Playground, nor of brax's backend mjx")
    own = getattr(env, self.access.model)
    self.env, self.mj_model, self.physics = env, host, Mjx(host, 1, model=own)
    fields = [field for field in FAULTY if field not in ("gravity", *self.physics.inert)]
    self.model = Model(
      {field: jnp.asarray(getattr(own, field), jnp.float32) for field in fields}
      | {"gravity": jnp.asarray(own.opt.gravity, jnp.float32)},
      {},
      jnp.zeros(host.nv),
    )
    obs = vector(jax.eval_shape(env.reset, jax.random.key(0)).obs)
    if len(obs.shape) != 1:
      raise UserError(f"robot {name!r} observes arrays of shape {obs.shape}; one vector is needed")
    names = tuple(f"obs_{i}" for i in range(obs.shape[0]))
    self.spec = describe(host, name, names, float(env.dt), episode_steps, acceptance, scale)

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


def brax_robot(name: str) -> External:
  """`brax:NAME`."""
  envs = plugins.optional("brax", "brax.envs")
  choose("brax environment", name, envs._envs)
  return External(envs.get_environment(name, backend="mjx"), f"brax:{name}")


def playground_robot(name: str) -> External:
  """`playground:NAME`, with its own length of an episode."""
  registry = plugins.optional("playground", "mujoco_playground").registry
  choose("playground environment", name, dict.fromkeys(registry.ALL_ENVS))
  steps = int(registry.get_default_config(name).episode_length)
  env = registry.load(name, config_overrides={"impl": "jax"})
  return External(env, f"playground:{name}", steps)


LIBRARIES: dict[str, Callable[[str], External]] = {
  "brax": brax_robot,
  "playground": playground_robot,
}
