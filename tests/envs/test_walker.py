"""Walker-walk against an oracle in NumPy and C MuJoCo, written from the published formulas."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_cl import envs
from mjx_cl.envs import walker as task

JOINTS = ["right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle"]


@pytest.fixture(scope="module")
def env():
  return envs.make("walker", "native")


@pytest.fixture(scope="module")
def step(env):
  """One control step of many robots, jitted."""
  return jax.jit(jax.vmap(env.step, (None, 0, 0)))


def tolerance(x, lower, upper=np.inf, margin=0.0, sigmoid="gaussian", value_at_margin=0.1):
  """dm_control.utils.rewards.tolerance: 1 inside the bounds, falling to `value_at_margin` at
  distance `margin`.
  """
  distance = np.where(x < lower, lower - x, np.maximum(x - upper, 0.0)) / margin
  if sigmoid == "gaussian":
    return np.exp(-0.5 * (distance * np.sqrt(-2 * np.log(value_at_margin))) ** 2)
  scaled = distance * (1 - value_at_margin)
  return np.where(np.abs(scaled) < 1, 1 - scaled, 0.0)


def oracle(model, qpos, qvel):
  """(observation (24,), reward) of DMC's walker-walk at one state, by MuJoCo's own kinematics."""
  data = mujoco.MjData(model)
  data.qpos[:], data.qvel[:] = qpos, qvel
  mujoco.mj_forward(model, data)
  mujoco.mj_subtreeVel(model, data)
  torso = model.body("torso").id
  names = ["torso", "right_thigh", "right_leg", "right_foot", "left_thigh", "left_leg", "left_foot"]
  xmat = [data.body(name).xmat for name in names]  # row-major: 0 is xx, 2 is xz, 8 is zz
  height, speed = data.xpos[torso, 2], data.subtree_linvel[torso, 0]
  obs = np.concatenate([[x for m in xmat for x in (m[0], m[2])], [height], data.qvel])
  stand = (3 * tolerance(height, 1.2, margin=0.6) + (1 + xmat[0][8]) / 2) / 4
  return obs, stand * (
    5 * tolerance(speed, 1.0, margin=0.5, sigmoid="linear", value_at_margin=0.5) + 1
  ) / 6


def states(num):
  """Upright, falling and lying walkers of any posture that stand still, walk and run, either way:
  qpos (num, 9), qvel (num, 9).
  """
  rng = np.random.default_rng(0)
  upright = rng.random((num, 1)) < 0.5
  angle = np.where(upright, rng.normal(0, 0.2, (num, 1)), rng.uniform(-np.pi, np.pi, (num, 1)))
  height = np.where(upright, rng.uniform(-0.2, 0.1, (num, 1)), rng.uniform(-1.2, 0.1, (num, 1)))
  qpos = np.concatenate(
    [height, rng.uniform(-5, 5, (num, 1)), angle, rng.uniform(-1, 1, (num, 6))], 1
  )
  qvel = rng.normal(size=(num, 9)) * [1, 1.5, 2, 5, 5, 5, 5, 5, 5]
  return qpos.astype(np.float32), qvel.astype(np.float32)


# ---- model and spec ------------------------------------------------------------------------------


def test_masses_inertias_and_motors(walker):
  mass = {"torso": 10.673, "thigh": 4.058, "leg": 2.781, "foot": 2.094}  # [kg]
  inertia = {
    "torso": (0.02544, 0.44316),
    "thigh": (0.00494, 0.09330),
    "leg": (0.00218, 0.07230),
    "foot": (0.00249, 0.01394),
  }  # [kg m2]
  for body in range(1, walker.nbody):
    kind = walker.body(body).name.split("_")[-1]
    assert walker.body_mass[body] == pytest.approx(
      mass[kind], abs=5e-4
    )  # the table has three decimals
    axial, transverse = min(walker.body_inertia[body]), max(walker.body_inertia[body])
    assert (axial, transverse) == pytest.approx(inertia[kind], abs=6e-6)  # the table has five
  assert walker.body_mass.sum() == pytest.approx(28.540, abs=5e-4)
  assert [walker.actuator(i).name for i in range(walker.nu)] == JOINTS
  np.testing.assert_array_equal(walker.actuator_gear[:, 0], [100, 50, 20, 100, 50, 20])
  np.testing.assert_allclose(
    np.degrees(walker.jnt_range[3:]), [[-20, 100], [-150, 0], [-45, 45]] * 2, atol=1e-9
  )  # rounding of radians
  assert [walker.joint(j).name for j in range(walker.njnt)] == ["rootz", "rootx", "rooty"] + JOINTS


def test_spec(env, walker):
  spec = env.spec
  bodies = [
    "torso",
    "right_thigh",
    "right_leg",
    "right_foot",
    "left_thigh",
    "left_leg",
    "left_foot",
  ]
  names = (
    [f"{b}_{k}" for b in bodies for k in ("xx", "xz")]
    + ["height"]
    + ["vel_" + j for j in ["rootz", "rootx", "rooty"] + JOINTS]
  )
  assert [v.name for v in spec.obs] == names and len(spec.obs) == 24
  assert [v.unit for v in spec.obs] == ["1"] * 14 + ["m"] + ["m/s"] * 2 + ["rad/s"] * 7
  assert [v.name for v in spec.act] == JOINTS == list(spec.targets)
  assert {(v.unit, v.low, v.high) for v in spec.act} == {("1", -1, 1)}
  assert spec.control_s == pytest.approx(walker.opt.timestep * 10) and spec.episode_steps == 1000
  index, least = spec.posture
  assert spec.obs[index].name == "height" and 0.3 < least < 1.2  # between lying and standing [m]
  assert 0 < spec.acceptance < 1
  for name, value in env.model.mj.items():
    np.testing.assert_array_equal(
      value,
      np.asarray(walker.opt.gravity if name == "gravity" else getattr(walker, name), np.float32),
    )
  assert set(env.model.task) == {"reward_weights", "command_range"} and env.model.force.shape == (
    9,
  )
  np.testing.assert_array_equal(env.model.mj["actuator_gear"], walker.actuator_gear)


# ---- observation and reward ----------------------------------------------------------------------


def test_observation_and_reward_equal_the_oracle(env, walker):
  qpos, qvel = states(600)
  obs = jax.jit(jax.vmap(task.observe))(qpos, qvel)
  reward = jax.jit(jax.vmap(lambda q, v: task.reward(q, v, env._mass)))(qpos, qvel)
  want_obs, want_reward = (
    np.array(x) for x in zip(*(oracle(walker, q, v) for q, v in zip(qpos, qvel)))
  )
  np.testing.assert_allclose(
    obs, want_obs, atol=2e-6
  )  # cos and sin of a float32 sum of angles; measured: 3.0e-7
  np.testing.assert_allclose(reward, want_reward, atol=2e-6)  # measured: 2.4e-7
  assert reward.min() >= 0 and reward.max() <= 1
  assert (
    want_reward.min() < 0.02 and want_reward.max() > 0.98 and np.std(want_reward) > 0.2
  )  # the states cover the range


def test_step_observes_the_state_it_arrives_at(env, step, walker):
  num = 32
  state, _ = jax.vmap(env.init, (None, 0))(env.model, jax.random.split(jax.random.key(1), num))
  at, rng = env.physics._qpos_at, np.random.default_rng(2)
  for k in range(40):
    state, out = step(env.model, state, rng.uniform(-1, 1, (num, 6)).astype(np.float32))
    if k % 13 == 0:
      row = np.asarray(state.physics).view(np.float64)
      want = [oracle(walker, r[at : at + 9], r[at + 9 : at + 18]) for r in row]
      np.testing.assert_allclose(
        out.obs, np.array([w[0] for w in want]), rtol=1e-6, atol=2e-6
      )  # float32 of the float64 state
      np.testing.assert_allclose(out.reward, [w[1] for w in want], atol=1e-5)
      np.testing.assert_array_equal(out.obs, out.final_obs)
      assert ((out.reward >= 0) & (out.reward <= 1)).all()


@pytest.mark.parametrize(
  "height, angle, speed, want",
  [
    (1.3, 0.0, 1.0, 1.0),
    (1.3, 0.0, 5.0, 1.0),
    (1.3, 0.0, 0.5, 3.5 / 6),
    (1.3, 0.0, 0.0, 1 / 6),
    (1.3, 0.0, -1.0, 1 / 6),
    (0.6, 0.0, 1.0, (3 * 0.1 + 1) / 4),
    (1.2, np.pi, 1.0, 0.75),
    (0.6, np.pi, 0.0, 0.3 / 4 / 6),
  ],
)
def test_reward_by_hand(env, height, angle, speed, want):
  qpos, qvel = np.zeros(9), np.zeros(9)
  qpos[0], qpos[2], qvel[1] = height - 1.3, angle, speed
  got = task.reward(jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32), env._mass)
  assert float(got) == pytest.approx(want, abs=1e-6)  # float32


# ---- reset ---------------------------------------------------------------------------------------


def test_reset_distribution(env, walker):
  num = 2000
  state, obs = jax.jit(jax.vmap(env.init, (None, 0)))(
    env.model, jax.random.split(jax.random.key(0), num)
  )
  at = env.physics._qpos_at
  row = np.asarray(state.physics).view(np.float64)
  qpos, qvel = row[:, at : at + 9], row[:, at + 9 : at + 18]
  np.testing.assert_array_equal(qpos[:, :2], 0)
  np.testing.assert_array_equal(qvel, 0)
  np.testing.assert_array_equal(state.step, 0)
  low, high = np.array([[-np.pi, np.pi]] + list(walker.jnt_range[3:])).T
  share = (qpos[:, 2:] - low) / (high - low)
  assert share.min() >= -1e-6 and share.max() <= 1 + 1e-6  # float32 rounding of the ends
  assert (
    share.min(0).max() < 0.01 and share.max(0).min() > 0.99
  )  # the ranges are reached; 1 % is missed by all in e-20 of cases
  for (
    column
  ) in share.T:  # 10 bins of 200 +- 13.4; 5 deviations: one false alarm in 25,000 runs of this test
    assert np.abs(np.histogram(column, 10, (0, 1))[0] - 200).max() < 67
  correlation = np.corrcoef(share.T) - np.eye(7)
  assert (
    np.abs(correlation).max() < 0.11
  )  # independent draws: deviation 1 / sqrt(2000) = 0.022, 5 of them
  np.testing.assert_allclose(
    obs, np.array([oracle(walker, q, v)[0] for q, v in zip(qpos, qvel)]), atol=2e-6
  )


def test_same_key_gives_equal_bits_and_another_key_does_not(env, step, same):
  def run(seed):
    state, obs = jax.vmap(env.init, (None, 0))(env.model, jax.random.split(jax.random.key(seed), 3))
    outs = []
    for k in range(10):
      state, out = step(env.model, state, jnp.full((3, 6), 0.1 * k))
      outs.append(out)
    return state, obs, outs

  assert same(run(0), run(0)) and not same(run(0), run(1))


# ---- step ----------------------------------------------------------------------------------------


def test_episode_is_truncated_after_1000_steps_and_never_terminates(env):
  def one(state, key):
    return env.step(env.model, state, jax.random.uniform(key, (6,), minval=-1, maxval=1))

  state, _ = env.init(env.model, jax.random.key(0))
  state, out = jax.jit(lambda s, k: jax.lax.scan(one, s, k))(
    state, jax.random.split(jax.random.key(1), 1000)
  )
  np.testing.assert_array_equal(out.truncated, np.arange(1000) == 999)
  assert not out.terminated.any() and int(state.step) == 1000
  assert float(out.obs[:, 14].min()) < 0.7  # it had fallen, which ends nothing


def test_actions_are_clipped(env, step, same):
  state, _ = jax.vmap(env.init, (None, 0))(env.model, jax.random.split(jax.random.key(3), 3))
  sign = jnp.array([[1, -1, 1, -1, 1, -1.0]] * 3)
  assert same(step(env.model, state, 3 * sign), step(env.model, state, sign))
  assert not same(step(env.model, state, 0.9 * sign), step(env.model, state, sign))


def test_mjx_gives_the_same_environment():
  """Reset, observation and reward of both backends; the physics itself is test_physics.py's
  business.
  """
  native, mjx = envs.make("walker", "native"), envs.make("walker", "mjx")
  key = jax.random.key(5)
  (a, obs_a), (b, obs_b) = native.init(native.model, key), mjx.init(mjx.model, key)
  at = native.physics._qpos_at
  np.testing.assert_array_equal(obs_a, obs_b)
  np.testing.assert_array_equal(
    np.asarray(a.physics).view(np.float64)[at : at + 9].astype(np.float32), b.physics.qpos
  )
  assert native.spec == mjx.spec
  _, out = jax.eval_shape(mjx.step, mjx.model, b, jnp.zeros(6))  # it takes its own model
  assert out.obs.shape == (24,)
  assert set(native.model.mj) - set(mjx.model.mj) == {"dof_frictionloss"}
