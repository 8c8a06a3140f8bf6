"""The demonstrator: our plain policy equals brax's network, files round trip, the adapter keeps
brax's contract.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks

from mjx_cl import envs
from mjx_cl.errors import FileError
from mjx_cl.training import demonstrator, premises


def brax_policy(obs_size, act_size):
  """A random brax PPO network with a normaliser that is not the identity, and its deterministic
  inference.
  """
  net = networks.make_ppo_networks(
    obs_size, act_size, running_statistics.normalize, policy_hidden_layer_sizes=(16, 16)
  )
  normalizer = running_statistics.init_state(specs.Array((obs_size,), jnp.float32))
  normalizer = running_statistics.update(
    normalizer, 3.0 + 2.0 * jax.random.normal(jax.random.key(1), (50, obs_size))
  )
  params = (normalizer, net.policy_network.init(jax.random.key(2)))
  return params, networks.make_inference_fn(net)(params, deterministic=True)


def test_a_training_that_cannot_go_on_is_one_line(tmp_path, monkeypatch, capsys):
  monkeypatch.setattr("sys.argv", ["demonstrator", "car", "--out", str(tmp_path), "--resume"])
  monkeypatch.setattr(demonstrator.runtime, "setup", lambda: None)
  with pytest.raises(SystemExit) as e:
    demonstrator.main()
  said = capsys.readouterr().err
  assert e.value.code == FileError.exit_code and said.count("\n") == 1
  assert said.startswith(f"mjx-cl: {tmp_path} holds no demonstrator training")


def test_policy_equals_brax():
  params, infer = brax_policy(5, 2)
  obs = jax.random.normal(jax.random.key(3), (7, 5))
  ours = demonstrator._to_policy(params)(obs)
  theirs, _ = infer(obs, jax.random.key(4))
  assert np.ptp(np.asarray(theirs)) > 0.01  # a network that says something
  np.testing.assert_allclose(
    ours, theirs, atol=1e-6
  )  # the same float32 products, grouped otherwise


def test_round_trip(tmp_path):
  policy = demonstrator._to_policy(brax_policy(5, 2)[0])
  demonstrator.save(tmp_path / "p.npz", policy)
  again = demonstrator.load(tmp_path / "p.npz")
  assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), policy, again))
  (tmp_path / "p.npz").write_bytes((tmp_path / "p.npz").read_bytes()[:100])
  with pytest.raises(FileError, match="cannot read demonstrator"):
    demonstrator.load(tmp_path / "p.npz")


def test_a_policy_of_another_robot_is_one_line(tmp_path, short_walker):
  path = tmp_path / "p.npz"
  demonstrator.save(path, demonstrator._to_policy(brax_policy(5, 2)[0]))
  with pytest.raises(FileError, match="takes 5 observations and gives 2 actions.* has 24 and 6"):
    premises.expert(short_walker, str(path))
  for layers in ((), ((jnp.ones((4, 4)), jnp.ones(4)),)):
    demonstrator.save(path, demonstrator.Policy(jnp.zeros(5), jnp.ones(5), layers))
    with pytest.raises(FileError, match="cannot read demonstrator"):
      demonstrator.load(path)


def test_adapter_steps_like_the_environment():
  env = envs.make("walker")
  adapter = demonstrator.brax_env(env)
  assert (adapter.observation_size, adapter.action_size) == (24, 6)
  action = jnp.linspace(-1, 1, 6)
  state = adapter.reset(jax.random.key(0))
  _, step = env.step(env.model, state.pipeline_state, action)
  after = adapter.step(state, action)
  assert not np.array_equal(after.obs, state.obs)
  np.testing.assert_array_equal(after.obs, step.final_obs)
  np.testing.assert_array_equal(after.reward, step.reward)
  assert float(after.done) == 0.0


def test_shaped_reward_is_the_demonstrators_alone():
  env = envs.make("quadruped", "native")
  own = env.demonstration
  shaped = demonstrator.Shaped(env, own["weights"], own["bonus"])
  state, _ = env.init(env.model, jax.random.key(0))
  action = jnp.linspace(-1, 1, 12)
  terms = dict(
    zip(
      env.reward_terms,
      np.asarray(
        shaped.model.task["reward_weights"]
        / jnp.where(env.model.task["reward_weights"] == 0, 1, env.model.task["reward_weights"])
      ),
    )
  )
  assert {k: round(float(v), 3) for k, v in terms.items() if v not in (0, 1)} == own["weights"]
  (_, plain), (_, other) = (
    env.step(shaped.model, state, action),
    shaped.step(shaped.model, state, action),
  )
  np.testing.assert_allclose(other.reward, plain.reward + own["bonus"], rtol=1e-6)
  np.testing.assert_array_equal(other.final_obs, plain.final_obs)
  assert shaped.spec is env.spec and demonstrator.brax_env(shaped).observation_size == 48


@pytest.mark.slow
def test_ppo_trains_the_walker_through_the_adapter(short_walker, tmp_path):
  """A short run of brax's PPO: every layer of the policy moves, its statistics are those of what
  the robots saw.
  """
  small = dict(
    num_envs=8,
    unroll_length=6,
    num_minibatches=2,
    batch_size=8,
    num_updates_per_batch=2,
    num_eval_envs=4,
  )
  rows = demonstrator.train(short_walker, tmp_path, steps=384, evals=2, **small)
  assert [r["step"] for r in rows] == [0, 384] and all(
    0 <= r["return"] <= 12 for r in rows
  )  # episodes of 12 steps, at most 1 a step
  first, last = (demonstrator.load(p) for p in sorted(tmp_path.glob("policy_*.npz")))
  assert all(np.abs(a - b).max() > 1e-4 for (a, _), (b, _) in zip(first.layers, last.layers))
  assert not np.asarray(first.mean).any() and np.asarray(last.mean).any()
  height = short_walker.spec.obs.index(next(v for v in short_walker.spec.obs if "height" in v.name))
  assert 0.5 < last.mean[height] < 1.6  # a walker's torso, at 1.3 m at most
