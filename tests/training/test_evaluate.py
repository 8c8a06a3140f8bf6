"""`eval`: returns and the task's own figures, against one episode stepped by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick

from mjx_cl import envs, faults
from mjx_cl.config import PRESETS
from mjx_cl.dreamer.agent import Agent
from mjx_cl.rollout.scan import Rollout, start
from mjx_cl.training import evaluate


@pytest.fixture(scope="module", params=[pytest.param("car", marks=pytest.mark.slow), "walker"])
def case(request):
  env = envs.make(request.param, "native")
  env.spec = env.spec._replace(episode_steps=30)
  agent = Agent(PRESETS["tiny"].dreamer, len(env.spec.obs), len(env.spec.act))
  return env, agent, jax.jit(agent.init)(jax.random.key(3)).params


def by_hand(env, agent, params, seed, rollout, drive=False):
  """Return, the measured figure in all steps but the one that ends, terminated, readings."""
  stream = quick.jit(lambda key: start(env, agent, rollout.fault, key))(jax.random.key(seed))
  lead = lambda tree: jax.tree.map(lambda x: x[None, None], tree)
  streams, total, seen, read = lead(stream), 0.0, [], []
  for _ in range(env.spec.episode_steps):
    streams, rows = rollout.chunk(
      jax.tree.map(lambda x: x[None], params), streams, 1, jnp.full((1, 1), drive)
    )
    total += float(rows.reward[0, 0, 0])
    read.append(np.asarray(rows.final_obs[0, 0, 0], np.float64))
    if bool(rows.terminated[0, 0, 0] | rows.truncated[0, 0, 0]):
      return total, seen, bool(rows.terminated[0, 0, 0]), np.array(read)
    if hasattr(env, "measure"):
      seen.append(
        float(env.measure(jax.tree.map(lambda x: x[0, 0], streams.env))["mean_speed_m_s"])
      )


def test_figures_are_those_of_single_episodes(case):
  env, agent, params = case
  got = evaluate.evaluate(env, agent, params, episodes=2, seed=5)
  plain = Rollout(env, agent, faults.none(env))
  hand = [by_hand(env, agent, params, seed, plain) for seed in (5, 6)]
  np.testing.assert_allclose(got["returns"], [h[0] for h in hand], atol=0.02)  # rounded to 0.01
  assert got["terminations"] == sum(h[2] for h in hand) and got["episodes"] == 2
  assert {k for k in got if not k.endswith("_ci") and k + "_ci" not in got} == {
    "episodes",
    "returns",
    "return_mean",
    "return_iqm",
    "deviations",
  }  # these two: return_ci
  late = [x[env.spec.episode_steps // 4 :] for *_, x in hand]
  want = np.concatenate(late).std(0) if sum(map(len, late)) else None
  for k, value in enumerate(got["deviations"].values()):
    assert value == (None if want is None else pytest.approx(want[k], rel=0.01, abs=1e-5))
  if env.spec.name == "walker":
    assert "mean_speed_m_s" not in got
    return
  assert got["mean_speed_m_s"] == pytest.approx(np.mean(hand[0][1] + hand[1][1]), rel=1e-3)
  assert got["mean_speed_m_s_ci"][0] <= got["mean_speed_m_s"] <= got["mean_speed_m_s_ci"][1]
  assert (
    got["collision_rate"] == got["terminations"] / 2
    and got["collision_rate_ci"][0] <= got["collision_rate"] <= got["collision_rate_ci"][1]
  )
  driver = Rollout(env, agent, faults.none(env), expert=lambda s: env.reference(s.env))
  driven = [by_hand(env, agent, params, seed, driver, True) for seed in (5, 6)]
  assert got["reference_speed_m_s"] == pytest.approx(np.mean(driven[0][1] + driven[1][1]), rel=1e-3)
  assert (
    got["reference_speed_m_s"] > got["mean_speed_m_s"]
  )  # one that knows the way against random weights
