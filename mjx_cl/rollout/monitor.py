"""Prediction residuals: what the world model foresaw, step by step, against what came.

At decision t the model imagines n steps from its posterior, one prior sample each, with the
recorded actions; predictions are in raw units. With x_{t+i} the observation arrived at i steps
later and o ranging over observation variables:

  paper       e_t[o] = (1/n) sum_{i=1..n} |xhat_{t+i|t}[o] - x_{t+i}[o]|, in the row whose arrival
    is t+n, when it is known
  streaming   s_t[o] = (1/n) sum_{i=1..n} |xhat_{t|t-i}[o] - x_t[o]|, in the row whose arrival is t

  innovation  x_{t+1}[o] - xhat_{t+1|t}[o], with its sign, in the row whose arrival is t+1

OPR = mean over o; RPR is the same sum over the reward. A window is cut at a reset and averaged over
the steps left; fewer than `least` of them, or fewer than n steps since the run began, make the row
invalid. Source: the paper, section on change detection.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Key, PRNGKeyArray

from mjx_cl.dreamer import rssm
from mjx_cl.errors import UserError
from mjx_cl.keys import OfMonitor
from mjx_cl.rollout.scan import Row
from mjx_cl.types import GROUPS, Array, Spec, Var

LATENT = 16  # dimensions of the latent's projection
# channels of one number, in the order of every table of them: name -> what it is
CHANNELS = {
  "opr": "observation residual, null where fewer than 5 steps of its window are left",
  "rpr": "reward residual, as opr",
  "reward": "of arriving",
  "surprise": "KL(posterior || prior) [nats]",
  **{
    f"group_{k}": "mean residual of a part of the observation, in typical deviations"
    for k in range(GROUPS)
  },
}


class Residual(NamedTuple):
  """What detectors see of one row. Whatever is not known is nan.

  Attributes:
    opr: float32 (), mean of `variables`.
    rpr: float32 (), that of the reward.
    variables: float32 (O,), in raw units.
    valid: bool (), opr, rpr, variables and groups are known.
    groups: float32 (8,), mean residual of the parts `spec.watched`, in typical deviations of each
      variable.
    reward: float32 (), of arriving.
    terminated: bool (), the episode ended in arriving.
    surprise: float32 (), KL(posterior || prior) of the latent at the decision [nats].
    latent: float32 (16,), a fixed projection of the posterior latent at the decision, see
      `Monitor.project`.
    innovation: float32 (O + 1,), signed one-step errors of the observation and, last, the reward,
      in raw units; None unless the Monitor is `signed`.
  """

  opr: jax.Array
  rpr: jax.Array
  variables: jax.Array
  valid: jax.Array
  groups: jax.Array
  reward: jax.Array
  terminated: jax.Array
  surprise: jax.Array
  latent: jax.Array
  innovation: jax.Array | None = None


def unknown(leading: tuple[int, ...], variables: int, signed: bool = False) -> Residual:
  """Rows of which nothing is known; `signed`: as of a Monitor that is."""
  # no two fields share a buffer: all are donated
  nan = lambda *shape: jnp.full(leading + shape, jnp.nan)
  false = lambda: jnp.zeros(leading, bool)
  return Residual(
    nan(),
    nan(),
    nan(variables),
    false(),
    nan(GROUPS),
    nan(),
    false(),
    nan(),
    nan(LATENT),
    nan(variables + 1) if signed else None,
  )


def watched(spec: Spec) -> tuple[tuple[str, tuple[int, ...]], ...]:
  """(name, indices) of the eight parts: `spec.watched`, or the observation in eight stretches of
  about equal length.
  """
  if spec.watched:
    return spec.watched
  stretches = np.array_split(np.arange(len(spec.obs)), GROUPS)
  return tuple(
    (f"obs_{at[0]}_{at[-1]}" if len(at) else f"empty_{k}", tuple(int(i) for i in at))
    for k, at in enumerate(stretches)
  )


class History(NamedTuple):
  """The last n - 1 rows before a chunk, time-major (n - 1, groups, members, ...).

  Attributes:
    deter: float32 (D,), latent at the decision.
    stoch: int32 (stoch,), its class indices.
    action: float32 (A,).
    obs: float32 (O,), of arriving.
    reward: float32 (), of arriving.
    done: bool (), the episode ended in arriving.
    exists: bool (), false before the run began.
  """

  deter: jax.Array
  stoch: jax.Array
  action: jax.Array
  obs: jax.Array
  reward: jax.Array
  done: jax.Array
  exists: jax.Array


class Monitor:
  """Residuals of chunks.

  Args:
    agent: dreamer.agent.Agent.
    n: decisions predicted.
    form: `paper` or `streaming`.
    actions: `recorded`, or `policy` (the literal reading of the paper: the policy imagines its own
      actions).
    least: fewest steps a cut window may keep.
    spec: of the robot, for `groups`; None: eight stretches of the observation in raw units.
    signed: rows have an innovation.
  """

  def __init__(
    self,
    agent: Any,
    n: int = 15,
    form: str = "paper",
    actions: str = "recorded",
    least: int = 5,
    spec: Spec | None = None,
    signed: bool = False,
  ) -> None:
    self.signed = signed
    if form not in ("paper", "streaming"):
      raise UserError(f"unknown residual form {form!r}; choose from: paper, streaming")
    if actions not in ("recorded", "policy"):
      raise UserError(f"unknown residual actions {actions!r}; choose from: recorded, policy")
    if not 1 <= least <= n:
      raise UserError(f"least must lie in 1..n={n}; got {least}")
    self.agent, self.n, self.form, self.actions, self.least = agent, n, form, actions, least
    spec = spec or Spec("", (Var("", ""),) * agent.obs_size, (), 1.0, 1, 0.0, None, ())
    self._groups = np.zeros((agent.obs_size, GROUPS), np.float32)  # variables -> groups
    for k, (_, at) in enumerate(watched(spec)):
      for i in at:
        self._groups[i, k] = 1.0 / (len(at) * spec.obs[i].scale)
    size, shape = agent.size, (agent.size.deter + agent.stoch_size, LATENT)
    parts = [np.full(size.deter, size.deter), np.full(agent.stoch_size, size.stoch)]
    normal = np.random.default_rng(LATENT).standard_normal(shape)
    self._projection = (normal / np.sqrt(np.concatenate(parts))[:, None]).astype(np.float32)

  def init(self, groups: int, members: int) -> History:
    """The history before a run."""
    a = self.agent
    zeros = lambda *shape, dtype=jnp.float32: jnp.zeros(
      (self.n - 1, groups, members) + shape, dtype
    )
    return History(
      zeros(a.size.deter),
      zeros(a.size.stoch, dtype=jnp.int32),
      zeros(a.act_size),
      zeros(a.obs_size),
      zeros(),
      zeros(dtype=bool),
      zeros(dtype=bool),
    )

  def update(
    self, params: Any, history: History, rows: Row, keys: Key[Array, "groups"]
  ) -> tuple[History, Residual]:
    """Residuals of one chunk.

    Args:
      params: leading (groups,).
      history: before the chunk.
      rows: leading (T, groups, members), T >= n - 1.
      keys: of the predictions.

    Returns:
      (history', Residual with leading (T, groups, members)).
    """
    seq = self._join(history, rows)
    per_group = jax.vmap(self._group, (0, 1, 0), 1)
    opr, rpr, variables, valid = per_group(params, seq, keys)
    look = jax.vmap(self._look, (0, 1, 1, 1), 1)
    surprise, latent = look(params, rows.obs, rows.deter, rows.stoch)
    residual = Residual(
      opr=opr,
      rpr=rpr,
      variables=variables,
      valid=valid,
      groups=variables @ self._groups,
      reward=rows.reward,
      terminated=rows.terminated,
      surprise=surprise,
      latent=latent,
      innovation=jax.vmap(self.ahead, (0, 1, 0), 1)(params, rows, keys) if self.signed else None,
    )
    return self._last(history, seq), residual

  def update_each(
    self, params: Any, history: History, rows: Row, keys: Key[Array, "groups members"]
  ) -> tuple[History, Residual]:
    """`update` with a key for each member, (groups, members): no member's residuals depend on which
    others there are, but for the last digit.
    """
    alone = lambda tree: jax.tree.map(lambda x: x[:, :, None], tree)
    each = lambda h, r, k: self.update(params, alone(h), alone(r), k)
    return jax.tree.map(lambda x: x[:, :, :, 0], jax.vmap(each, (2, 2, 1), 2)(history, rows, keys))

  def remember(self, history: History, rows: Row) -> History:
    """The history after a chunk, as `update` gives it, without looking."""
    return self._last(history, self._join(history, rows))

  def _join(self, history: History, rows: Row) -> History:
    done = rows.terminated | rows.truncated
    chunk = History(
      rows.deter, rows.stoch, rows.action, rows.final_obs, rows.reward, done, jnp.ones_like(done)
    )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b.astype(a.dtype)]), history, chunk)

  def _last(self, history: History, seq: History) -> History:
    return jax.tree.map(lambda x: x[-(self.n - 1) :], seq) if self.n > 1 else history

  def _group(
    self, params: Any, seq: History, key: PRNGKeyArray
  ) -> tuple[
    Float[Array, "steps members"],
    Float[Array, "steps members"],
    Float[Array, "steps members obs"],
    Bool[Array, "steps members"],
  ]:
    """One parameter set; seq has leading (n - 1 + T, members)."""
    n, (total, members) = self.n, seq.done.shape
    rows = total - n + 1
    starts = rows if self.form == "paper" else total
    # window[i, s] = row s + i, clamped; `inside` says that it exists
    index = jnp.arange(starts)[None] + jnp.arange(n)[:, None]
    inside = index < total
    index = jnp.minimum(index, total - 1)
    actions = seq.action[index].reshape(n, starts * members, -1)
    deter = seq.deter[:starts].reshape(starts * members, -1)
    stoch = self.agent.hot(seq.stoch[:starts]).reshape(starts * members, -1)
    if self.actions == "recorded":
      obs, reward = self.agent.open_loop(params, deter, stoch, actions, key)
    else:
      obs, reward = self.agent.dream(params, deter, stoch, n, key)
    shape = (n, starts, members)
    obs_error = jnp.abs(obs.reshape(shape + (-1,)) - seq.obs[index])
    reward_error = jnp.abs(reward.reshape(shape) - seq.reward[index])
    error = jnp.concatenate([obs_error, reward_error[..., None]], -1)
    # resets before the i-th arrival
    ended = jnp.cumsum(seq.done[index].astype(jnp.int32), 0) - seq.done[index]
    valid = inside[..., None] & (ended == 0) & seq.exists[:starts][None]
    if self.form == "streaming":  # row k gathers the i-th prediction of start k - i + 1
      row = jnp.arange(n - 1, total)[None] - jnp.arange(n)[:, None]
      step = jnp.arange(n)[:, None]
      error, valid = error[step, row], valid[step, row]
    count = jnp.sum(valid, 0)
    mean = jnp.sum(jnp.where(valid[..., None], error, 0.0), 0) / jnp.maximum(1, count)[..., None]
    good = (count >= self.least) & seq.exists[:rows]  # n steps since the run began
    mean = jnp.where(good[..., None], mean, jnp.nan)
    return jnp.mean(mean[..., :-1], -1), mean[..., -1], mean[..., :-1], good

  def ahead(
    self, params: Any, rows: Row, key: PRNGKeyArray
  ) -> Float[Array, "steps members innovation"]:
    """Innovations of one parameter set; rows have leading (T, members)."""
    flat = lambda x: x.reshape((-1,) + x.shape[2:])
    deter, stoch = flat(rows.deter).astype(jnp.float32), self.agent.hot(flat(rows.stoch))
    key = jax.random.fold_in(key, OfMonitor.AHEAD)
    obs, reward = self.agent.open_loop(params, deter, stoch, flat(rows.action)[None], key)
    foreseen = jnp.concatenate([obs[0], reward[0][:, None]], -1)
    came = jnp.concatenate([rows.final_obs, rows.reward[..., None]], -1)
    return came - foreseen.reshape(came.shape)

  def _look(
    self,
    params: Any,
    obs: Float[Array, "*lead obs"],
    deter: Float[Array, "*lead deter"],
    stoch: Int[Array, "*lead variables"],
  ) -> tuple[Float[Array, "*lead"], Float[Array, "*lead 16"]]:
    """Surprise [nats] and projected latent of decisions."""
    logits = [x.astype(jnp.float32) for x in self.agent.beliefs(params, deter, obs)]
    return rssm.kl(*logits), self.project(deter, stoch)

  def project(
    self, deter: Float[Array, "*lead deter"], stoch: Int[Array, "*lead variables"]
  ) -> Float[Array, "*lead 16"]:
    """One fixed Gaussian projection (NumPy's default_rng(16)) of [deter / sqrt(D), one-hot stoch /
    sqrt(variables)].
    """
    latent = jnp.concatenate([deter.astype(jnp.float32), self.agent.hot(stoch)], -1)
    return latent @ self._projection
