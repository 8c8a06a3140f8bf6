"""The planner of benchmarks/planning.py against a loop over its sequences."""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick

from benchmarks import planning
from mjx_cl.config import DreamerConfig
from mjx_cl.dreamer import heads, nets
from mjx_cl.dreamer.agent import Agent
from mjx_cl.errors import UserError

OBS, ACT, KEY = 5, 2, jax.random.key(3)


@pytest.fixture(scope="module")
def whole():
  """An agent whose heads speak, its parameters, a carry and an observation."""
  agent = Agent(DreamerConfig(size="tiny"), OBS, ACT)
  leaves, tree = jax.tree.flatten(agent.init_params(jax.random.key(0)))
  rng = np.random.default_rng(0)
  noise = lambda x: jnp.asarray(rng.standard_normal(x.shape) * 0.1, jnp.float32)
  params = jax.tree.unflatten(tree, [x + noise(x) for x in leaves])
  # peaked two-hot heads: worths of some tens, where bins go up to 5e8
  symlog_bins = np.sign(agent.bins) * np.log1p(np.abs(np.asarray(agent.bins)))
  for name in ("rew", "val"):
    params[name]["out"]["bias"] -= 4 * jnp.abs(jnp.asarray(symlog_bins) - 1.0)
  obs = jnp.asarray(rng.standard_normal(OBS), jnp.float32)
  return agent, params, agent.carry(), obs


def test_without_deviation_the_plan_is_the_policy(whole):
  agent, params, carry, obs = whole
  planner = planning.Planner(agent, 10, 3, 2, 0.0)
  after, action = quick.jit(planner.act)(params, carry, obs, KEY)
  mean, _ = agent._policy(params, after.deter[None], after.stoch[None])
  np.testing.assert_allclose(action, mean[0], atol=1e-5)  # float32 products of other sizes
  assert planner.size is agent.size


def test_the_best_of_the_sequences_by_a_loop(whole):
  agent, params, carry, obs = whole
  n, horizon, m, sigma = 10, 3, 2, 0.5
  after, action = quick.jit(planning.Planner(agent, n, horizon, m, sigma).act)(
    params, carry, obs, KEY
  )
  _, key_a, key_u = jax.random.split(KEY, 3)
  noise = np.asarray(sigma * jax.random.normal(key_a, (horizon, n, 1, ACT)))
  uniform = jax.random.uniform(key_u, (horizon, 1, m, agent.size.stoch))
  read = lambda name, x: heads.read(getattr(agent, name), params[name], x.deter, x.stoch)
  mean_of = lambda logits: float(nets.two_hot_mean(logits, agent.bins)[0])

  @quick.jit
  def follow(latent, deviation, draw):
    action = jnp.clip(agent._policy(params, latent.deter, latent.stoch)[0] + deviation, -1, 1)
    return agent.follow(params, latent, action, draw), action

  worths, firsts = [], []
  for i in range(n):
    dreams = []
    for j in range(m):
      latent = agent.latent(params, after.deter[None], after.stoch[None])
      total, weight = 0.0, 1.0
      for k in range(horizon):
        latent, taken = follow(latent, noise[k, i] * (i > 0), uniform[k, 0, j][None])
        firsts += [np.asarray(taken[0])] if j == k == 0 else []
        total += weight * mean_of(read("rew", latent))
        weight /= 1 + np.exp(-float(read("con", latent)[0, 0]))
      dreams.append(total + weight * mean_of(read("val", latent)))
    worths.append(np.mean(dreams))
  best = int(np.argmax(worths))
  second = sorted(worths)[-2]
  assert best > 0 and worths[best] - second > 1e-3 * abs(second)  # no tie within float32
  np.testing.assert_allclose(action, firsts[best], atol=1e-5)


def test_too_little_is_refused():
  args = dict(env="car_real", agent=None, seed=0)
  with pytest.raises(UserError, match="--steps must be at least 50; got 9"):
    planning.measure(argparse.Namespace(**args, steps=9, robots=2))
  with pytest.raises(UserError, match="--robots must be at least 2; got 1"):
    planning.measure(argparse.Namespace(**args, steps=50, robots=1))
