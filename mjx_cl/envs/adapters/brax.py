"""Our environment as a `brax.envs.Env`; see `brax_env`. Importing this needs brax."""

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs import base

from mjx_cl import faults
from mjx_cl.envs.adapters.driven import join, worst
from mjx_cl.keys import OfStep


class BraxEnv(base.Env):
  """One robot; brax's wrappers make several of it.

  Args:
    env: environment.
    fault: name of a fault or of a preset; None: nominal, and nothing in `info`.
    **settings: FaultSettings.
  """

  def __init__(self, env: Any, fault: str | None = None, **settings: Any) -> None:
    self.env, self.faulty = env, fault is not None
    self.rollout, self._begin = join(env, fault=fault or "none", **settings)

  def reset(self, rng: jax.Array) -> base.State:
    """A new life drawn from `rng`."""
    zero = jnp.float32(0)
    if not self.faulty:
      state, obs = self.env.init(self.env.model, rng)
      return base.State(state, obs, zero, zero, {})
    stream = self._begin(rng)
    return base.State(stream.env, stream.obs, zero, zero, {}, _info(stream, zero))

  def step(self, state: base.State, action: jax.Array) -> base.State:
    """One control step."""
    if self.faulty:
      inner, out, info = self._control(state, action)
    else:
      inner, out = self.env.step(self.rollout.model, state.pipeline_state, action)
      info = state.info
    return state.replace(
      pipeline_state=inner,
      obs=out.final_obs,
      reward=out.reward,
      done=out.terminated.astype(jnp.float32),
      info=info,
    )

  def _control(self, state: base.State, action: jax.Array) -> tuple[Any, Any, dict[str, Any]]:
    first = state.pipeline_state.step == 0
    stream = state.info["stream"]._replace(env=state.pipeline_state, first=first)
    now = jax.random.fold_in(jax.random.fold_in(stream.key, stream.t), OfStep.FIRST_READING)
    rollout = self.rollout
    renewed, _ = faults.sense(
      rollout.fault, stream.injection, stream.t, now, rollout.model, state.obs, True
    )
    anew = first & (stream.t > 0)  # the first episode's is new; brax's autoreset renews none
    injection = jax.tree.map(lambda new, old: jnp.where(anew, new, old), renewed, stream.injection)
    stream, out, severity = rollout._control(stream._replace(injection=injection), action)
    return stream.env, out, state.info | _info(stream, worst(severity))

  @property
  def observation_size(self) -> int:
    """Channels of an observation."""
    return len(self.env.spec.obs)

  @property
  def action_size(self) -> int:
    """Channels of an action."""
    return len(self.env.spec.act)

  @property
  def backend(self) -> str:
    """Name of the backend, which brax's wrappers ask for."""
    return "mjx_cl"


def _info(stream: Any, severity: jax.Array) -> dict[str, Any]:
  """What lives through brax's autoreset: fault and clock, without the robot."""
  return {"stream": stream._replace(env=()), "severity": severity}
