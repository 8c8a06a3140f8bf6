"""Losses of actor and critic on imagined states, all states at once: one large product per layer
through each head. `stepwise` computes the same for a CPU; they agree up to the order of float32
sums.

With imagined states s_0..s_H (no gradient), R the lambda-return, S the return scale and omega the
product of continues:
  policy = -mean omega_i [log pi(a_i | s_i) sg((R_i - v_i) / S) + eta H(pi(s_i))]
  value  =  mean omega_i [CE(v(s_i), sg R_i) + CE(v(s_i), sg v_slow(s_i))],   i = 0..H-1, means over
    i and starts
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, PRNGKeyArray

from mjx_cl.dreamer import heads, nets
from mjx_cl.dreamer.losses import lambda_return, update_range
from mjx_cl.dreamer.networks import Networks, sg
from mjx_cl.types import Array

Sums = tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]  # of policy, value, entropy


class States(NamedTuple):
  """Imagined states and the actions chosen there.

  Attributes:
    deter: (..., D).
    stoch: (..., S).
    first: outputs (..., U) of the first layers of policy and value, or None: not known.
    action: (..., A).
  """

  deter: jax.Array
  stoch: jax.Array
  first: tuple | None
  action: jax.Array


class Imagined(NamedTuple):
  """States 0..H-1 and what the heads without gradient say, each (H, N).

  Attributes:
    states: leading (H, N).
    rew: reward at states 1..H.
    con: continue at states 1..H.
    val: value at states 1..H.
    con0: (N,), continue at state 0.
    val0: value at states 0..H-1.
    slow: value of the slow critic at states 0..H-1.
  """

  states: States
  rew: jax.Array
  con: jax.Array
  val: jax.Array
  con0: jax.Array
  val0: jax.Array
  slow: jax.Array


def readings(
  agent: Networks,
  params: Any,
  slow: Any,
  deter: Float[Array, "*lead deter"],
  stoch: Float[Array, "*lead stoch"],
  first: tuple[jax.Array | None, ...] = (None,) * 4,
) -> tuple[
  Float[Array, "*lead"], Float[Array, "*lead"], Float[Array, "*lead"], Float[Array, "*lead"]
]:
  """Reward, continue, value and slow value at states; `first`: what their first layers give, where
  that is known already.
  """
  mean = lambda *given: nets.two_hot_mean(heads.read(*given), agent.bins)
  con = lambda *given: jax.nn.sigmoid(heads.read(*given)[..., 0])
  return (
    mean(agent.rew, params["rew"], deter, stoch, first[0]),
    con(agent.con, params["con"], deter, stoch, first[1]),
    mean(agent.val, params["val"], deter, stoch, first[2]),
    mean(agent.val, slow, deter, stoch, first[3]),
  )


def imagine(
  agent: Networks,
  params: Any,
  slow: Any,
  deter: Float[Array, "rows deter"],
  stoch: Float[Array, "rows stoch"],
  key: PRNGKeyArray,
) -> Imagined:
  """`Imagined` from the stacked states of `agent.imagine`."""
  deter, stoch, action = agent.imagine(params, deter, stoch, key, agent.config.imagine)
  rew, con, val, slow_val = readings(agent, params, slow, deter, stoch)
  states = States(deter[:-1], stoch[:-1], None, action[:-1])
  return Imagined(states, rew[1:], con[1:], val[1:], con[0], val[:-1], slow_val[:-1])


def sums(
  agent: Networks,
  pol: Any,
  val: Any,
  states: States,
  advantage: Float[Array, "*lead"],
  omega: Float[Array, "*lead"],
  ret: Float[Array, "*lead"],
  slow: Float[Array, "*lead"],
) -> Sums:
  """Sums over states of the policy loss, the value loss and the entropy."""
  deter, stoch, first, action = states
  first = first or (None, None)
  mean, std = nets.normal(*heads.read(agent.pol, pol, deter, stoch, first[0]), *agent.deviations)
  entropy = nets.normal_entropy(std)
  policy = -omega * (
    nets.normal_logp(mean, std, action) * advantage + agent.config.entropy * entropy
  )
  logits = heads.read(agent.val, val, deter, stoch, first[1])
  value = omega * (
    nets.two_hot_loss(logits, ret, agent.bins) + nets.two_hot_loss(logits, slow, agent.bins)
  )
  return jnp.sum(policy), jnp.sum(value), jnp.sum(entropy)


class Behaviour(NamedTuple):
  """Losses of actor and critic.

  Attributes:
    policy: float32 (), mean.
    value: float32 (), mean.
    boot: float32 (N,), imagined return from each start.
    range: float32 (2,), the new percentile range.
    metrics: name -> float32 ().
  """

  policy: jax.Array
  value: jax.Array
  boot: jax.Array
  range: jax.Array
  metrics: dict[str, jax.Array]


def losses(
  agent: Networks,
  params: Any,
  slow: Any,
  range_: Float[Array, "2"],
  deter: Float[Array, "rows deter"],
  stoch: Float[Array, "rows stoch"],
  key: PRNGKeyArray,
  imagine: Callable[..., Imagined],
  sums: Callable[..., Sums],
) -> Behaviour:
  """Imagines from rows and gives the losses; `imagine` and `sums` of here or of `stepwise`."""
  c, frozen = agent.config, sg(params)
  img = sg(imagine(agent, frozen, sg(slow), sg(deter), sg(stoch), key))
  ret = lambda_return(img.rew, img.con, img.val, c.lam)
  omega = jnp.cumprod(jnp.concatenate([img.con0[None], img.con[:-1]]), 0)
  range_, scale = update_range(range_, ret, c.range_rate)
  adv = (ret - img.val0) / scale
  against = sg((adv, omega, ret, img.slow))
  out = sums(agent, params["pol"], params["val"], img.states, *against)
  policy, value, entropy = (x / adv.size for x in out)
  # over states 0..H
  every = lambda inner, first: (jnp.sum(inner) + jnp.sum(first)) / (inner.size + first.size)
  metrics = {
    "adv": adv.mean(),
    "adv_std": adv.std(),
    "adv_mag": jnp.abs(adv).mean(),
    "ret": ((ret - range_[0]) / scale).mean(),
    "val": every(img.val, img.val0[0]),
    "tar": ret.mean(),
    "rew": img.rew.mean(),
    "con": every(img.con, img.con0),
    "weight": omega.mean(),
    "ent/action": entropy,
    "ret_scale": scale,
  }
  return Behaviour(policy, value, ret[0], range_, metrics)
