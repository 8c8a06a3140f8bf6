"""Five probe environments: each asks for one more ability than the one before, so the first that
fails names the broken part.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl.config import PRESETS, replace
from mjx_cl.dreamer import nets
from mjx_cl.dreamer.agent import Agent
from mjx_cl.training import trainer as train
from mjx_cl.types import EnvState, Model, Spec, Step, Var

HORIZON = 4  # discount 0.75: values settle within a few hundred updates
GAMMA = 1 - 1 / HORIZON
# 3e-4 lets 1 seed in 6 settle on one action of the last probe before the reward is known (all 6
# learn it with 0.01)
ENTROPY = 0.01


class Probe:
  """Episodes of `steps` control steps. obs float32 (2,): a coin of +-1 (0 where the probe has none)
  and the step; action (1,).

  Args:
    steps: length of an episode.
    reward: (coin, step, action in [-1, 1]) -> reward of that step.
    coin: the coin is drawn.
    limit: the end is a time limit (the value goes on), not a true terminal.
  """

  def __init__(self, name, steps, reward, coin=False, limit=False):
    self.steps, self.reward, self.coin, self.limit = steps, reward, coin, limit
    self.spec = Spec(
      name,
      (Var("coin", "1"), Var("step", "1")),
      (Var("lever", "1", -1, 1),),
      1.0,
      steps,
      0.0,
      None,
      ("lever",),
    )
    self.model = Model({}, {})

  def init(self, model, key):
    coin = jnp.where(jax.random.bernoulli(key), 1.0, -1.0) if self.coin else jnp.float32(0)
    return EnvState(coin, jnp.int32(0)), jnp.stack([coin, 0.0])

  def step(self, model, state, action):
    reward = jnp.float32(self.reward(state.physics, state.step, jnp.clip(action[0], -1.0, 1.0)))
    step = state.step + 1
    end, obs = step >= self.steps, jnp.stack([state.physics, step.astype(jnp.float32)])
    return EnvState(state.physics, step), Step(
      obs, reward, end & (not self.limit), end & self.limit, obs
    )


@functools.cache
def shared_learn(agent_config):
  """One compiled program of updates for all five probes, which have the same shapes."""
  return train.make_learn(Agent(agent_config, 2, 1), agent_config.batch, agent_config.length)


def learnt(env, out, updates, seed=0):
  """Trains `tiny` on a probe and gives the trainer."""
  preset = PRESETS["tiny"]
  dreamer = replace(preset.dreamer, horizon=HORIZON, batch=8, length=8, imagine=4, entropy=ENTROPY)
  trainer = train.Trainer(
    env, dreamer, replace(preset.train, updates=updates, ratio=4.0), out, seed=seed
  )
  trainer.learn = {"pure": shared_learn(dreamer)}
  while not trainer.done:
    trainer.step()
  return trainer


def judge(trainer, path):
  """Mean over 64 sampled latents of the value at the end of a list of observations, and of the
  policy's mean there.
  """
  agent, params = trainer.plain, jax.tree.map(lambda x: x[0], trainer.state.train.params)

  @jax.jit
  @jax.vmap
  def run(key):
    carry = agent.carry()
    for i, obs in enumerate(path):
      carry, action = agent.act(
        params, carry, jnp.array(obs, jnp.float32), jax.random.fold_in(key, i), True
      )
    return nets.two_hot_mean(
      agent.value(params["val"], carry.deter, carry.stoch), agent.bins
    ), action[0]

  value, action = run(jax.random.split(jax.random.key(1), 64))
  return float(np.mean(value)), float(np.mean(action))


# Tolerances: the worst of 5 seeds was off by 0.05, 0.15 and 0.03; a wrong discount, end or time
# shift is off by 0.25 or more.


@pytest.mark.slow
def test_constant_reward_gives_the_geometric_sum_past_the_time_limit(tmp_path):
  env = Probe("constant", 8, lambda coin, step, action: 1.0, limit=True)
  trainer = learnt(env, tmp_path, 768)
  for steps in (1, 5):
    value, _ = judge(trainer, [(0, i) for i in range(steps)])
    assert abs(value - 1 / (1 - GAMMA)) < 0.15


@pytest.mark.slow
def test_observed_reward_is_read_from_the_observation(tmp_path):
  trainer = learnt(Probe("observed", 1, lambda coin, step, action: coin, coin=True), tmp_path, 512)
  for coin in (-1, 1):
    value, _ = judge(trainer, [(coin, 0)])
    assert abs(value - coin) < 0.22


@pytest.mark.slow
def test_delayed_reward_is_discounted(tmp_path):
  trainer = learnt(Probe("delayed", 2, lambda coin, step, action: step), tmp_path, 768)
  assert abs(judge(trainer, [(0, 0)])[0] - GAMMA) < 0.1
  assert abs(judge(trainer, [(0, 0), (0, 1)])[0] - 1.0) < 0.1


def test_chosen_reward_is_chosen(tmp_path):
  trainer = learnt(Probe("chosen", 1, lambda coin, step, action: action), tmp_path, 512)
  value, action = judge(trainer, [(0, 0)])
  assert action > 0.8 and value > 0.6  # an untrained policy: 0 and 0


@pytest.mark.slow
def test_action_follows_the_observation(tmp_path):
  trainer = learnt(
    Probe("both", 1, lambda coin, step, action: coin * action, coin=True), tmp_path, 1024
  )
  for coin in (-1, 1):
    value, action = judge(trainer, [(coin, 0)])
    assert (
      coin * action > 0.5 and value > 0.3
    )  # one action for both coins would fail for one of them
