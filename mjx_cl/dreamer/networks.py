"""The networks of DreamerV3 joined, for one seed: acting, observing, imagining, predicting. Nothing
here learns.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from mjx_cl.config import DreamerConfig
from mjx_cl.config.sizes import SIZES
from mjx_cl.dreamer import heads, nets, posterior, rssm
from mjx_cl.dreamer.state import Carry, Latent, Record
from mjx_cl.errors import UserError
from mjx_cl.types import Array

sg = jax.lax.stop_gradient


class Networks:
  """Encoder, RSSM, decoder and heads for `obs_size` observations and `act_size` actions. Parameters
  are a dict: enc, dyn, dec, rew, con, pol, val.

  Args:
    config: DreamerConfig.
    obs_size: observation variables.
    act_size: action variables.

  Raises:
    UserError where config.obs_scale does not fit.
  """

  def __init__(self, config: DreamerConfig, obs_size: int, act_size: int) -> None:
    self.config, self.obs_size, self.act_size = config, obs_size, act_size
    self.size = s = SIZES[config.size]
    self.stoch_size = s.stoch * s.classes
    self.deviations: tuple[float, ...] = config.min_std, config.max_std
    self.bins = jnp.asarray(nets.two_hot_bins(config.bins))
    if isinstance(config.obs_scale, str):
      raise UserError(
        "obs_scale `spec` is for training, where there is a robot; an agent takes the numbers"
      )
    if config.obs_scale and len(config.obs_scale) != obs_size:
      raise UserError(
        f"obs_scale has {len(config.obs_scale)} numbers for {obs_size} observation variables"
      )
    self.obs_scale = jnp.asarray(config.obs_scale or 1.0, jnp.float32)
    self.enc, self.dyn = heads.Encoder(s.units), rssm.RSSM(s)
    self.dec = heads.Decoder(s.units, obs_size)
    self.rew, self.con = heads.Head(1, s.units, config.bins, 0.0), heads.Head(1, s.units, 1, 1.0)
    self.pol = heads.PolicyHead(s.units, act_size)
    self.val = heads.Head(3, s.units, config.bins, 0.0)

  # ---- parameters --------------------------------------------------------------------------------

  def init_params(self, key: PRNGKeyArray) -> dict[str, Any]:
    """Fresh parameters from `key`."""
    keys = jax.random.split(key, 7)
    deter, stoch = jnp.zeros((1, self.size.deter)), jnp.zeros((1, self.stoch_size))
    action, tokens = jnp.zeros((1, self.act_size)), jnp.zeros((1, self.size.units))
    inputs = {"enc": (jnp.zeros((1, self.obs_size)),), "dyn": (deter, stoch, action, tokens)}
    return {
      name: getattr(self, name).init(key, *inputs.get(name, (deter, stoch)))["params"]
      for key, name in zip(keys, ("enc", "dyn", "dec", "rew", "con", "pol", "val"))
    }

  def _apply(self, params: Any, name: str, *args: Any, **kwargs: Any) -> Any:
    own = params[name]
    return getattr(self, name).apply(own if "params" in own else {"params": own}, *args, **kwargs)

  def _encode(self, params: Any, obs: Float[Array, "*lead obs"]) -> Float[Array, "*lead units"]:
    return self._apply(params, "enc", obs / self.obs_scale)

  def prepare(self, params: Any) -> dict[str, Any]:
    """The same parameters with what a scan over the core would otherwise re-arrange at every step;
    every method takes either form.
    """
    return {**params, "dyn": rssm.hoist(params["dyn"])} if "params" not in params["dyn"] else params

  def _core(
    self,
    params: Any,
    deter: Float[Array, "rows deter"],
    stoch: Float[Array, "rows stoch"],
    action: Float[Array, "rows act"],
  ) -> Float[Array, "rows deter"]:
    return self._apply(params, "dyn", deter, stoch, action, method="core")

  def _policy(
    self, params: Any, deter: Float[Array, "*lead deter"], stoch: Float[Array, "*lead stoch"]
  ) -> tuple[Float[Array, "*lead act"], Float[Array, "*lead act"]]:
    """Mean and deviation of the action."""
    return nets.normal(*self._apply(params, "pol", deter, stoch), *self.deviations)

  def hot(self, index: Int[Array, "*lead variables"]) -> Float[Array, "*lead stoch"]:
    """Class indices (..., stoch) -> flat one-hot (..., stoch * classes)."""
    return jax.nn.one_hot(index, self.size.classes).reshape(index.shape[:-1] + (self.stoch_size,))

  # ---- acting ------------------------------------------------------------------------------------

  def carry(self) -> Carry:
    """The carry at an episode's start."""
    return Carry(jnp.zeros(self.size.deter), jnp.zeros(self.stoch_size), jnp.zeros(self.act_size))

  def act(
    self,
    params: Any,
    carry: Carry,
    obs: Float[Array, "obs"],
    key: PRNGKeyArray,
    deterministic: bool = False,
  ) -> tuple[Carry, Float[Array, "act"]]:
    """One posterior step and an action for one robot.

    Args:
      params: of the networks.
      carry: of the last step.
      obs: float32 (O,).
      key: of latent and action.
      deterministic: the mean in place of a sample.

    Returns:
      (carry', action (A,), unclipped; the environment clips). carry'.deter and .stoch are the
      posterior latent at obs.
    """
    key_z, key_a = jax.random.split(key)
    deter = self._core(params, carry.deter[None], carry.stoch[None], carry.action[None])
    logits = self._apply(params, "dyn", deter, self._encode(params, obs[None]), method="posterior")
    stoch = rssm.sample(logits, jax.random.uniform(key_z, (1, self.size.stoch))).reshape(1, -1)
    mean, std = self._policy(params, deter, stoch)
    action = mean if deterministic else mean + std * jax.random.normal(key_a, mean.shape)
    return Carry(deter[0], stoch[0], action[0]), action[0]

  # ---- world model -------------------------------------------------------------------------------

  def observe(
    self, params: Any, batch: Record, key: PRNGKeyArray
  ) -> tuple[
    Float[Array, "steps batch deter"],
    Float[Array, "steps batch stoch"],
    Float[Array, "steps batch variables classes"],
  ]:
    """Posterior states of the T trained steps, time-major: deter (T, B, D), stoch (T, B, S),
    posterior logits (T, B, stoch, classes).
    """
    length, rows = batch.obs.shape[1] - 1, batch.obs.shape[0]
    # on a CPU the product of a single row takes twice the time of that of two
    wide = lambda x, axis: jnp.repeat(x, 2, axis) if rows == 1 else x
    dyn = params["dyn"].get("params", params["dyn"])
    xs = (
      batch.action[:, :-1].swapaxes(0, 1),
      later(batch.first).astype(jnp.float32),
      self._encode(params, later(batch.obs)),
      nets.in_a_row(jax.random.uniform, key, (length, rows, self.size.stoch)),
    )
    start = batch.deter[:, 0].astype(jnp.float32), self.hot(batch.stoch[:, 0])
    met = posterior.inputs(self.dyn, dyn, *(wide(x, 1) for x in xs))
    begin = wide(start[0], 0), wide(start[1], 0)
    deter, stoch, logits = posterior.posteriors(self.dyn, dyn, begin, met)
    return deter[:, :rows], stoch[:, :rows], logits[:, :rows]

  def imagine(
    self,
    params: Any,
    deter: Float[Array, "rows deter"],
    stoch: Float[Array, "rows stoch"],
    key: PRNGKeyArray,
    steps: int,
  ) -> tuple[
    Float[Array, "states rows deter"],
    Float[Array, "states rows stoch"],
    Float[Array, "states rows act"],
  ]:
    """Policy and prior from rows (N, D), (N, S), no gradient.

    Returns:
      deter (steps + 1, N, D), stoch (steps + 1, N, S), action (steps + 1, N, A); index 0 is the
      start.
    """
    params, rows = sg(self.prepare(params)), deter.shape[0]
    uniform, noise = self.draws(key, steps, rows)

    def step(state: Latent, x: tuple[Array, Array]) -> tuple[Latent, tuple[Array, Array, Array]]:
      noise, uniform = x
      action = self.choose(params, state.deter, state.stoch, noise)
      return self.follow(params, state, action, uniform), (state.deter, state.stoch, action)

    end, states = jax.lax.scan(
      step, self.latent(params, sg(deter), sg(stoch)), (noise[:-1], uniform)
    )
    last = (end.deter, end.stoch, self.choose(params, end.deter, end.stoch, noise[-1]))
    return sg(jax.tree.map(lambda x, final: jnp.concatenate([x, final[None]]), states, last))

  def draws(
    self, key: PRNGKeyArray, steps: int, rows: int
  ) -> tuple[Float[Array, "steps rows variables"], Float[Array, "states rows act"]]:
    """Uniform numbers (steps, rows, stoch) for the prior and normal ones (steps + 1, rows, A) for
    the policy.
    """
    key_z, key_a = jax.random.split(key)
    return (
      nets.in_a_row(jax.random.uniform, key_z, (steps, rows, self.size.stoch)),
      nets.in_a_row(jax.random.normal, key_a, (steps + 1, rows, self.act_size)),
    )

  def choose(
    self,
    params: Any,
    deter: Float[Array, "rows deter"],
    stoch: Float[Array, "rows stoch"],
    noise: Float[Array, "rows act"],
  ) -> Float[Array, "rows act"]:
    """The policy's action for standard normal `noise`."""
    mean, std = self._policy(params, deter, stoch)
    return mean + std * noise

  def latent(
    self, params: Any, deter: Float[Array, "rows deter"], stoch: Float[Array, "rows stoch"]
  ) -> Latent:
    """Rows as a scan over the prior carries them."""
    return Latent(self._apply(params, "dyn", deter, method="cut"), deter, stoch)

  def follow(
    self,
    params: Any,
    state: Latent,
    action: Float[Array, "rows act"],
    uniform: Float[Array, "rows variables"],
  ) -> Latent:
    """One step of the prior, sampled with numbers `uniform` in [0, 1)."""
    chunks = self._apply(
      params, "dyn", state.chunks, state.deter, state.stoch, action, method="core_cut"
    )
    deter = rssm.join(chunks)
    logits = self._apply(params, "dyn", deter, method="prior")
    return Latent(chunks, deter, rssm.sample(logits, uniform).reshape(state.stoch.shape))

  def value(
    self,
    value_params: Any,
    deter: Float[Array, "*lead deter"],
    stoch: Float[Array, "*lead stoch"],
  ) -> Float[Array, "*lead bins"]:
    """Value logits of a (fast or slow) critic."""
    return heads.read(self.val, value_params, deter, stoch)

  # ---- prediction --------------------------------------------------------------------------------

  def open_loop(
    self,
    params: Any,
    deter: Float[Array, "rows deter"],
    stoch: Float[Array, "rows stoch"],
    actions: Float[Array, "steps rows act"],
    key: PRNGKeyArray,
  ) -> tuple[Float[Array, "steps rows obs"], Float[Array, "steps rows"]]:
    """Predictions of the next n steps from rows, actions given, one prior sample each; never looks
    at an observation.

    Args:
      params: of the networks.
      deter: of the posterior at t, (N, D).
      stoch: likewise, (N, S).
      actions: a_t .. a_{t+n-1}, (n, N, A).
      key: of the samples.

    Returns:
      xhat_{t+1..t+n} (n, N, O) in raw units (symexp applied) and rhat (n, N).
    """
    params = self.prepare(params)
    uniform = nets.in_a_row(
      jax.random.uniform, key, (actions.shape[0], deter.shape[0], self.size.stoch)
    )

    def step(state: Latent, x: tuple[Array, Array]) -> tuple[Latent, tuple[Array, Array]]:
      # decoded where the state is at hand: the stacked states would be a hundred times the
      # predictions
      state = self.follow(params, state, *x)
      return state, self.predict(params, state.deter, state.stoch)

    return jax.lax.scan(step, self.latent(params, deter, stoch), (actions, uniform))[1]

  def predict(
    self, params: Any, deter: Float[Array, "*lead deter"], stoch: Float[Array, "*lead stoch"]
  ) -> tuple[Float[Array, "*lead obs"], Float[Array, "*lead"]]:
    """Observation in raw units and reward at states."""
    return (
      self.obs_scale * nets.symexp(self._apply(params, "dec", deter, stoch)),
      nets.two_hot_mean(self._apply(params, "rew", deter, stoch), self.bins),
    )

  def beliefs(
    self, params: Any, deter: Float[Array, "*lead deter"], obs: Float[Array, "*lead obs"]
  ) -> tuple[Float[Array, "*lead variables classes"], Float[Array, "*lead variables classes"]]:
    """Logits of the posterior at `obs` and of the prior, both at `deter`."""
    flat = deter.reshape(-1, deter.shape[-1])
    tokens = self._encode(params, obs.reshape(-1, obs.shape[-1]))
    shape = deter.shape[:-1] + (self.size.stoch, self.size.classes)
    return (
      self._apply(params, "dyn", flat, tokens, method="posterior").reshape(shape),
      self._apply(params, "dyn", flat, method="prior").reshape(shape),
    )

  def dream(
    self,
    params: Any,
    deter: Float[Array, "rows deter"],
    stoch: Float[Array, "rows stoch"],
    steps: int,
    key: PRNGKeyArray,
  ) -> tuple[Float[Array, "steps rows obs"], Float[Array, "steps rows"]]:
    """As `open_loop`, with the actions that the policy imagines for itself."""
    deters, stochs, _ = self.imagine(params, deter, stoch, key, steps)
    return self.predict(params, deters[1:], stochs[1:])


def later(x: Array) -> Array:
  """Records 1.. of windows (B, 1 + T, ...), time-major (T, B, ...)."""
  return x[:, 1:].swapaxes(0, 1)


def parameter_count(params: Any) -> int:
  """Trainable parameters, slow critic apart."""
  return int(sum(np.prod(x.shape) for x in jax.tree.leaves(params)))
