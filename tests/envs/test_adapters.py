"""Adapters: gymnasium's checker, its own vectorisation of our single environment and a loop by hand
as oracles of the vector one.
"""

import copy
import pickle
import subprocess
import sys
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, check_step_determinism
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from mjx_cl import envs
from mjx_cl.envs import adapters
from mjx_cl.errors import UserError
from mjx_cl.io import registration

ROBOTS, STEPS, SEED = 3, 30, 11
FAULT = dict(
  fault="gear", target="left_hip", severity=0.5, onset=7
)  # inside the first episode of 12 steps


def actions_of(steps=STEPS, seed=0):
  return np.random.default_rng(seed).uniform(-1, 1, (steps, ROBOTS, 6)).astype(np.float32)


def live(env, actions, seed=SEED):
  """First observation and the lists obs, reward, terminated, truncated, infos of the steps, stacked
  where they are arrays.
  """
  first, info = env.reset(seed=seed)
  assert info == {}
  *arrays, infos = zip(*(env.step(a) for a in actions))
  return first, [np.stack(x) for x in arrays], infos


@pytest.fixture(scope="module")
def vector(short_walker):
  return adapters.gymnasium_vector(short_walker, ROBOTS, seed=SEED, **FAULT)


@pytest.fixture(scope="module")
def single(short_walker):
  return adapters.gymnasium_env(short_walker, **FAULT)


@pytest.fixture(scope="module")
def life(vector):
  return live(vector, actions_of())


# ---- gymnasium's word ----------------------------------------------------------------------------


def test_checker_passes_the_single_environment(single):
  with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    check_env(single)
  allowed = (
    "infinity",
    "not having a spec",
  )  # speeds have no bounds; it is made by a function, not registered
  assert [str(w.message) for w in caught if not any(a in str(w.message) for a in allowed)] == []


def test_vector_environment_keeps_the_contract_of_its_base_class(vector, life):
  """gymnasium has no checker for vector environments; this is what its base class writes down."""
  assert (
    isinstance(vector, gymnasium.vector.VectorEnv)
    and vector.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
  )
  assert (
    vector.num_envs,
    vector.single_observation_space.shape,
    vector.single_action_space.shape,
  ) == (ROBOTS, (24,), (6,))
  assert vector.observation_space == gymnasium.vector.utils.batch_space(
    vector.single_observation_space, ROBOTS
  )
  assert vector.action_space == gymnasium.vector.utils.batch_space(
    vector.single_action_space, ROBOTS
  )
  first, (obs, reward, terminated, truncated), infos = life
  assert first in vector.observation_space and all(o in vector.observation_space for o in obs)
  assert reward.shape == terminated.shape == truncated.shape == (STEPS, ROBOTS) and np.issubdtype(
    reward.dtype, np.floating
  )
  assert terminated.dtype == truncated.dtype == np.bool_
  check_step_determinism(_Unbatched(vector))
  gymnasium.wrappers.vector.RecordEpisodeStatistics(vector).reset(
    seed=0
  )  # wrappers of both kinds take it
  gymnasium.wrappers.vector.FlattenObservation(vector).reset(seed=0)


class _Unbatched(gymnasium.Env):
  """A vector environment as one whose rewards are summed: gymnasium's determinism check then
  applies to it.
  """

  def __init__(self, env):
    self.env, self.observation_space, self.action_space = (
      env,
      env.observation_space,
      env.action_space,
    )

  def reset(self, *, seed=None, options=None):
    super().reset(seed=seed)
    return self.env.reset(seed=seed, options=options)

  def step(self, action):
    obs, reward, terminated, truncated, info = self.env.step(action)
    return obs, float(reward.sum()), bool(terminated.any()), bool(truncated.any()), info


# ---- autoreset -----------------------------------------------------------------------------------


def test_equals_gymnasiums_own_vectorisation(single, life):
  """SyncVectorEnv over single robots defines next-step autoreset; observations differ by the batch
  size of one XLA program alone.
  """

  def another():
    env = copy.copy(single)
    env.robots = copy.copy(single.robots)  # shares the compiled programs alone
    return env

  sync = SyncVectorEnv([another] * ROBOTS, autoreset_mode=AutoresetMode.NEXT_STEP)
  first, arrays, infos = live(sync, actions_of())
  ours, our_arrays, our_infos = life
  np.testing.assert_allclose(ours, first, atol=1e-6)
  for a, b in zip(our_arrays, arrays):
    np.testing.assert_allclose(a, b, atol=1e-4)
  for a, b in zip(our_infos, infos):
    for name in ("severity", "t"):
      none = np.zeros(ROBOTS, bool)
      np.testing.assert_array_equal(a["_" + name], b.get("_" + name, none))
      np.testing.assert_array_equal(a[name], b.get(name, none))


def test_equals_a_hand_stepped_environment(short_walker, life):
  """Robot 1: episodes of 12 steps, then one call that resets; the fault clock counts control steps
  alone and halves the hip's gear from 7 on.
  """
  env, robot = short_walker, 1
  step = jax.jit(env.step)
  key_env, _, key = jax.random.split(jax.random.key(SEED + robot), 3)
  state, obs = env.init(env.model, key_env)
  first, (got_obs, got_reward, got_terminated, got_truncated), infos = life
  np.testing.assert_allclose(first[robot], obs, atol=1e-6)
  t, over = 0, False
  for k, action in enumerate(actions_of()[:, robot]):
    if over:
      state, obs = env.init(env.model, jax.random.fold_in(jax.random.fold_in(key, t), 2))
      reward, over, severity = 0.0, False, 0.0
      assert not infos[k]["_severity"][robot]
    else:
      severity = 0.5 * (t >= FAULT["onset"])
      gear = env.model.mj["actuator_gear"].at[3].multiply(1 - severity)
      state, out = step(
        env.model._replace(mj=env.model.mj | {"actuator_gear": gear}), state, action
      )
      obs, reward, over = out.final_obs, float(out.reward), bool(out.truncated)
      assert infos[k]["_t"][robot] and infos[k]["t"][robot] == t
      t += 1
    np.testing.assert_allclose(got_obs[k, robot], obs, atol=1e-4)
    assert got_reward[k, robot] == pytest.approx(reward, abs=1e-5)
    assert infos[k]["severity"][robot] == severity
    assert (got_terminated[k, robot], got_truncated[k, robot]) == (False, over)
  assert t == STEPS - 2 and got_truncated[:, robot].sum() == 2  # steps 12 and 25 were resets


def test_robots_that_end_apart_are_reset_apart(vector):
  """The middle robot's episode is ten steps older: it ends first, and no other robot notices."""
  vector.reset(seed=SEED)
  streams = vector.robots.streams
  vector.robots.streams = streams._replace(env=streams.env._replace(step=jnp.array([[0, 10, 0]])))
  ends, rewards = [], []
  for action in actions_of(5):
    _, reward, _, truncated, infos = vector.step(action)
    ends.append(truncated)
    rewards.append(reward)
  np.testing.assert_array_equal(ends, np.arange(5)[:, None] == [9, 1, 9])
  np.testing.assert_array_equal(np.array(rewards) == 0, np.arange(5)[:, None] == [9, 2, 9])
  np.testing.assert_array_equal(infos["t"], [4, 3, 4])  # the call that resets is no control step
  np.testing.assert_array_equal(vector.robots.streams.episode, [[0, 1, 0]])


# ---- seeds ---------------------------------------------------------------------------------------


def test_seeds_reproduce(vector, life, same):
  again = live(vector, actions_of())
  assert same(again[:2], life[:2])
  other = live(vector, actions_of(2), seed=SEED + ROBOTS)
  assert not np.isclose(other[0], life[0]).all(-1).any()
  shifted, _ = vector.reset(seed=SEED + 1)
  np.testing.assert_array_equal(shifted[:-1], life[0][1:])  # robot i has seed s + i
  listed, _ = vector.reset(seed=[SEED + 1, SEED, SEED])
  np.testing.assert_array_equal(listed, life[0][[1, 0, 0]])


def test_a_reset_without_a_seed_is_a_new_episode_of_the_same_life(vector):
  vector.reset(seed=0)
  for action in actions_of(3):
    vector.step(action)
  first, _ = vector.reset()
  second, _ = vector.reset()
  assert not np.isclose(first, second).all(-1).any()
  assert vector.step(actions_of(1)[0])[4]["t"].tolist() == [3] * ROBOTS  # the fault clock goes on
  vector.reset(seed=0)
  for action in actions_of(3):
    vector.step(action)
  np.testing.assert_array_equal(vector.reset()[0], first)


def test_the_first_reset_takes_the_seed_of_the_maker(vector, life):
  fresh = copy.copy(vector)
  fresh.robots = copy.copy(vector.robots)
  fresh.robots.streams = None
  np.testing.assert_array_equal(fresh.reset()[0], life[0])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copy_goes_on_as_the_robots_would(copied, same):
  env = adapters.gymnasium_env("walker", physics="native", **FAULT | {"onset": 1})
  env.reset(seed=SEED)
  actions = actions_of(4)[:, 0]
  env.step(actions[0])
  again = copied(env)
  assert again.robots is not env.robots
  there, here = ([e.step(a) for a in actions[1:]] for e in (again, env))
  assert same([x[:4] for x in there], [x[:4] for x in here])
  assert [x[4]["t"] for x in there] == [x[4]["t"] for x in here] == [1, 2, 3]


# ---- brax ----------------------------------------------------------------------------------------


def test_brax_environment_keeps_its_fault_over_an_autoreset(short_walker):
  """brax's wrappers restart the robot; severity goes by the control steps since the start."""
  from brax.envs.wrappers import training

  env = training.wrap(adapters.brax_env(short_walker, **FAULT), episode_length=5)
  state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), 2))
  first, step, severity, done, obs = state.obs, jax.jit(env.step), [], [], []
  for action in actions_of(10)[:, :2]:
    state = step(state, action)
    severity.append(np.asarray(state.info["severity"]))
    done.append(np.asarray(state.done))
    obs.append(state.obs)
  np.testing.assert_array_equal(severity, 0.5 * (np.arange(10)[:, None] >= [7, 7]))
  np.testing.assert_array_equal(done, np.arange(10)[:, None] % 5 == [4, 4])
  np.testing.assert_array_equal(obs[4], first)


def test_schedules_and_presets_act(short_walker):
  """A repaired preset, then a cycle by hand: severity (1 - cos(2 pi (t - onset + 1) / period)) / 2
  of 0.8.
  """

  def severities(**fault):
    robots = adapters.gymnasium_env(short_walker, **fault)
    robots.reset(seed=SEED)
    return [robots.step(np.zeros(6, np.float32))[4]["severity"] for _ in range(10)]

  t = np.arange(10)
  assert severities(fault="walker/gear-half", onset=3, duration=4) == [
    0.5 * (3 <= k < 7) for k in t
  ]
  cycle = severities(
    fault="gear", target="left_hip", severity=0.8, onset=2, schedule="cyclic", period=4
  )
  np.testing.assert_allclose(
    cycle, np.where(t < 2, 0, 0.4 * (1 - np.cos(np.pi / 2 * (t - 1)))), atol=1e-6
  )  # float32 cosine


# ---- refusals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
  "bad, word",
  [
    (dict(num_envs=0), "num_envs"),
    (dict(severity=1.5), "severity"),
    (dict(onset=-1), "onset"),
    (dict(duration=0), "duration"),
    (dict(fault="geer"), "geer"),
    (dict(fault="gear", target="elbow"), "elbow"),
    (dict(env="wlker"), "wlker"),
    (dict(fault="walker/gear-half", severity=0.5), "brings its own severity"),
    (dict(fault="gear", schedule="sine"), "sine"),
    (dict(fault="gear", period=0), "period"),
    (dict(fault="walker/gear-haf"), "gear-half"),
    (dict(fault="quadruped/rh-velocity-third"), "quadruped"),
    (dict(fault="walker/gear-half-twice", onset=2**31 - 2), "onset"),
    (dict(env="car", fault="car/sim-to-real"), "car_real"),
  ],
)
def test_bad_arguments_are_named(short_walker, bad, word):
  with pytest.raises(UserError, match=word):
    adapters.gymnasium_vector(**{"env": short_walker, "num_envs": 2} | bad)


def test_wrong_calls_are_refused(short_walker, vector):
  with pytest.raises(gymnasium.error.ResetNeeded):
    adapters.gymnasium_vector(short_walker, 2).step(np.zeros((2, 6)))
  with pytest.raises(gymnasium.error.ResetNeeded):
    adapters.gymnasium_env(short_walker).step(np.zeros(6))
  vector.reset(seed=0)
  with pytest.raises(UserError, match="shape"):
    vector.step(np.zeros((ROBOTS, 5)))
  with pytest.raises(UserError, match="seed"):
    vector.reset(seed=[1, 2])
  with pytest.raises(UserError, match="options"):
    vector.reset(options={"height": 2})
  with pytest.raises(UserError, match="options.*height"):
    adapters.gymnasium_env(short_walker).reset(options={"height": 2})


def test_settings_of_a_fault_may_be_numpys(short_walker):
  settings = {"severity": np.float32(0.5), "onset": np.int64(3), "duration": np.int32(5)}
  assert adapters.gymnasium_env(short_walker, fault="gear", **settings)


def test_a_copy_shares_environment_and_programs(vector):
  robots = vector.robots
  for other in (copy.copy(robots), copy.deepcopy(robots)):
    assert other is not robots and other.env is robots.env and other._step is robots._step


@pytest.mark.parametrize(
  "given, said",
  [
    ({"severity": 0.9}, "severity and target are of a fault"),
    ({"target": "trunk"}, "severity and target are of a fault"),
    ({"fault": "gear", "onset": 10.7}, "onset takes int; got 10.7"),
    ({"fault": "gear", "severity": "0.5"}, "severity takes float; got '0.5'"),
    ({"fault": "gear", "onset": float("nan")}, "onset takes int; got nan"),
  ],
)
def test_settings_of_a_fault_are_refused_in_a_line(short_walker, given, said):
  with pytest.raises(UserError, match=said) as refused:
    adapters.gymnasium_env(short_walker, **given)
  assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
  "package, call",
  [
    ("gymnasium", adapters.gymnasium_vector),
    ("gymnasium", adapters.gymnasium_env),
    ("brax", adapters.brax_env),
  ],
)
def test_a_missing_package_is_one_line(short_walker, monkeypatch, package, call):
  for name in [n for n in sys.modules if n.split(".")[0] == package] + [package, "brax.envs"]:
    monkeypatch.setitem(sys.modules, name, None)
  with pytest.raises(UserError) as refused:
    call(short_walker)
  install = {"gymnasium": "'mjx-cl[gymnasium]'", "brax": "brax"}[package]
  assert str(refused.value).endswith(f"pip install {install}") and "\n" not in str(refused.value)


# ---- gymnasium's names ---------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["gymnasium, mjx_cl", "mjx_cl, gymnasium"])
def test_gymnasium_knows_every_robot_by_name(order):
  """Before JAX is imported; where gymnasium comes second, by a call."""
  program = (
    f"import {order}, sys; {'mjx_cl.register_envs();' * order.startswith('mjx')}"
    "print('jax' in sys.modules);"
    "print(sorted(k for k in gymnasium.registry if k.startswith('mjx_cl/')))"
  )
  out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
  loaded, names = out.stdout.splitlines()
  assert loaded == "False"
  assert names == str(sorted(f"mjx_cl/{name}" for name in registration.ROBOTS))
  assert set(registration.ROBOTS.values()) == {*envs.ENVS}


def test_made_by_name_it_is_our_robot():
  """One step of both ways equals the adapter's own; gymnasium's checks run on it without a warning."""
  fault = dict(fault="gear", target="left_hip", severity=0.5, onset=7)
  want = adapters.gymnasium_env("walker", **fault)
  with warnings.catch_warnings():
    warnings.simplefilter("error")
    registration.register_envs()
    registration.register_envs()
    got = gymnasium.make("mjx_cl/Walker-v0", **fault)
    first = got.reset(seed=3)[0]
    after = got.step(np.zeros(6, np.float32))
    many = gymnasium.make_vec(
      "mjx_cl/Walker-v0", 2, vectorization_mode="vector_entry_point", **fault
    )
  np.testing.assert_array_equal(first, want.reset(seed=3)[0])
  np.testing.assert_array_equal(after[0], want.step(np.zeros(6, np.float32))[0])
  np.testing.assert_array_equal(many.reset(seed=3)[0][0], first)
  with pytest.raises(UserError, match="mjx-cl render"):
    gymnasium.make("mjx_cl/Walker-v0", render_mode="human")


def test_xla_is_quiet_before_jax_comes():
  """Once it is loaded its loader prints a page for each cached program."""
  code = """
import sys, gymnasium, mjx_cl
from mjx_cl.io import runtime
said, quiet = [], runtime.quiet
runtime.quiet = lambda: said.append("jax" in sys.modules) or quiet()
gymnasium.make("mjx_cl/Walker-v0")
gymnasium.make_vec("mjx_cl/Walker-v0", 2, vectorization_mode="vector_entry_point")
print(said[0], len(said) > 1)
"""
  out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
  assert out.stdout.split() == ["False", "True"], out.stderr


@pytest.mark.parametrize("name", ["Walker-v0", "Car-v0"])
def test_stable_baselines_checks_it_and_trains_on_it(name):
  stable = pytest.importorskip("stable_baselines3")
  checker = pytest.importorskip("stable_baselines3.common.env_checker")
  registration.register_envs()
  with warnings.catch_warnings():
    warnings.simplefilter("error")
    env = gymnasium.make(f"mjx_cl/{name}", onset=50)
    checker.check_env(env)
  learner = stable.PPO("MlpPolicy", env, n_steps=64, batch_size=32, device="cpu", seed=0)
  before = learner.policy.state_dict()["action_net.weight"].clone()
  learner.learn(128)
  assert learner.num_timesteps == 128
  assert not before.equal(learner.policy.state_dict()["action_net.weight"])
