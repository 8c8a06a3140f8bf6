"""The four-wheel car against hand sums, C MuJoCo and what a car must do; its reality gap item by
item; parity of the two backends.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_cl import physics
from mjx_cl.envs import car, course
from mjx_cl.envs import car_real as lib
from mjx_cl.errors import UserError

OVAL = course.generate("oval")
CARS = 64  # batch of the one MJX program
MU, G, L, LF, LR = 1.0489, 9.81, 0.3302, 0.15875, 0.17145
SPINS = [8, 11, 13, 15]
NOISES = {"lidar_noise", "speed_noise", "yaw_rate_noise"}


@pytest.fixture(scope="module")
def env():
  """The car with every gap item at the simulator's value."""
  return lib.CarReal("native", gap=(), tracks=[OVAL])


@pytest.fixture(scope="module")
def real():
  """The car with the whole gap."""
  return lib.CarReal("native", tracks=[OVAL])


@pytest.fixture(scope="module")
def ride(env):
  """ride(models, commands (N, T, 2), speed): motion (N, T) on an open floor and how upright,
  commands in rad and m/s, starting straight ahead.
  """

  def one(model, qvel, commands):
    def step(state, command):
      state, out = env.physics.step(model.mj, state, command, model.task, model.force)
      return state, lib.read_motion(out["qpos"], out["qvel"])

    return jax.lax.scan(step, env.physics.init(env._rest, qvel), commands)[1]

  jitted = jax.jit(jax.vmap(one))

  def go(models, commands, speed=0.0):
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *models)
    qvel = np.zeros((len(models), 16), np.float32)
    qvel[:, 0], qvel[:, SPINS] = speed, np.reshape(speed, (-1, 1)) / lib.RADIUS
    motion, upright = jitted(stacked, qvel, jnp.asarray(commands, jnp.float32))
    return jax.tree.map(np.asarray, motion), np.asarray(upright)

  return go


@pytest.fixture(scope="module")
def drive(env):
  """drive(models, keys, actions (T, 2)): initial observation (N, O), then states and steps as lists
  over time; one program of 12 cars.
  """
  first, step = jax.jit(jax.vmap(env.init)), jax.jit(jax.vmap(env.step))

  def go(models, keys, actions, change=lambda state: state):
    num = len(models)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *(models + [env.model] * (12 - num)))
    state, obs = first(stacked, keys[jnp.arange(12) % len(keys)])
    state, states, outs = change(state), [], []
    for action in np.asarray(actions, np.float32):
      state, out = step(stacked, state, np.tile(action, (12, 1)))
      (
        states.append(jax.tree.map(lambda x: x[:num], state)),
        outs.append(jax.tree.map(lambda x: np.asarray(x)[:num], out)),
      )
    return obs[:num], states, outs

  return go


def steady(angle, speed, steps=60):
  """A constant command, (T, 2)."""
  return np.tile([angle, speed], (steps, 1))


def grip(env, **wheels):
  """The nominal model with other friction coefficients: front, rear or single wheels."""
  table, feet = env.model.mj["geom_friction"], dict(env.spec.feet)
  for name, value in wheels.items():
    table = table.at[np.array(feet[name]), 0].set(value)
  return env.model._replace(mj=env.model.mj | {"geom_friction": table})


def slip(motion):
  """Angle between heading and velocity [deg]."""
  return np.degrees(np.arctan2(motion.vy, motion.vx))


# ---- figures -------------------------------------------------------------------------------------


def test_mass_inertia_and_axle_loads():
  model = lib.load_model()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  assert model.body_mass.sum() == pytest.approx(3.74, abs=1e-6)
  np.testing.assert_allclose(
    data.subtree_com[1], [0, 0, 0.074], atol=1e-6
  )  # origin of the chassis frame, at its height
  dense = np.zeros((model.nv, model.nv))
  mujoco.mj_fullM(model, data, dense)
  assert dense[5, 5] == pytest.approx(0.04712, rel=1e-4)
  np.testing.assert_allclose([data.body(w).xpos[0] for w in lib.WHEELS], [LF, LF, -LR, -LR])
  mujoco.mj_step(model, data, 400)
  load, force = {}, np.zeros(6)
  for k in range(data.ncon):
    mujoco.mj_contactForce(model, data, k, force)
    load[model.geom(max(data.contact[k].geom)).name[6:]] = force[0]
  assert load["front_left"] + load["front_right"] == pytest.approx(
    19.05, abs=0.02
  )  # m g l_r / (l_f + l_r)
  assert load["rear_left"] + load["rear_right"] == pytest.approx(17.64, abs=0.02)
  assert np.abs(data.qvel).max() < 1e-4


def test_a_policy_moves_over_unchanged(env, real):
  simulator = car.Car(tracks=[OVAL])
  for e in (env, real):
    assert (
      e.spec.obs == simulator.spec.obs
      and e.spec.act == simulator.spec.act
      and e.spec.obs_groups == simulator.spec.obs_groups
    )
    assert (e.spec.name, e.spec.control_s, e.spec.episode_steps) == ("car_real", 0.05, 1200)
    assert e.mj_model.opt.timestep * lib.SUBSTEPS == pytest.approx(0.05)
    assert e.reward_terms == simulator.reward_terms
  for name in set(env.model.task) & set(simulator.model.task):
    np.testing.assert_array_equal(env.model.task[name], simulator.model.task[name])
  for x, y in zip(
    *(
      jax.jit(lambda key: e.pose(e.init(e.model, key)[0]))(jax.random.key(4))
      for e in (env, simulator)
    )
  ):
    np.testing.assert_array_equal(x, y)  # the same place to start


def test_spec_names_what_faults_act_on(env):
  assert (
    [env.mj_model.body(i[0]).name for _, i in env.spec.bodies]
    == ["chassis", *lib.WHEELS]
    == [n for n, _ in env.spec.bodies]
  )
  feet = dict(env.spec.feet)
  assert (
    feet["front"] == feet["front_left"] + feet["front_right"]
    and feet["rear"] == feet["rear_left"] + feet["rear_right"]
  )
  for wheel in lib.WHEELS:
    assert env.mj_model.geom(feet[wheel][0]).name == f"wheel_{wheel}"
    assert env.mj_model.geom_priority[feet[wheel][0]] > env.mj_model.geom("floor").priority[0]
  assert set(env.model.mj) == {
    "body_mass",
    "body_inertia",
    "body_ipos",
    "geom_friction",
    "dof_damping",
    "gravity",
  }
  for name, value in env.model.mj.items():
    own = env.mj_model.opt.gravity if name == "gravity" else getattr(env.mj_model, name)
    np.testing.assert_array_equal(value, own.astype(np.float32))
  np.testing.assert_array_equal(env.model.force, np.zeros(16))


# ---- how it drives -------------------------------------------------------------------------------


def test_acceleration_and_braking_reach_their_limits(env, ride):
  commands = np.concatenate([steady(0, 5, 20), steady(0, 0.5, 20)])
  models = [env.model, grip(env, front=0.65, rear=0.65), env.widen(env.model, "acceleration", 1.0)]
  motion, upright = ride(models, [commands] * 3)
  change = np.diff(motion.vx, axis=1) / 0.05
  for k, most in enumerate((9.51, 0.65 * G, 3.0)):  # the motor's limit, or what the tyres hold
    assert np.median(change[k, :5]) == pytest.approx(most, rel=0.04)  # measured: 9.50, 6.23, 2.99
    assert np.median(-change[k, 20:25]) == pytest.approx(
      most, rel=0.05
    )  # measured: 9.34, 6.35, 3.10
  assert change.max() < 9.51 * 1.03 and change.min() > -MU * G
  assert np.abs(motion.y).max() < 1e-6 and np.abs(motion.yaw).max() < 1e-6  # straight ahead
  assert motion.vx[0, 19] == pytest.approx(4.9, abs=0.1) and upright.min() > 0.998


def test_slow_curves_have_the_radius_of_the_wheelbase(env, ride):
  angles = np.array([0.1, 0.2, 0.3, 0.4189, -0.1, -0.2, -0.3, -0.4189])
  motion, _ = ride([env.model] * 8, [steady(a, 1.0) for a in angles], np.full(8, 1.0))
  speed, rate = np.hypot(motion.vx, motion.vy)[:, -1], motion.yaw_rate[:, -1]
  radius = np.hypot(L / np.tan(angles), LR)  # of the centre of gravity
  np.testing.assert_allclose(
    speed / np.abs(rate), radius, rtol=0.04
  )  # measured: 1.025 to 1.028 times as large; tyres slip
  np.testing.assert_allclose(rate[:4], -rate[4:], rtol=1e-3)  # left as right
  np.testing.assert_allclose(motion.steer[:, -1], angles, atol=1e-3)
  assert motion.yaw_rate[:, 40:].std(1).max() < 1e-3  # no jitter


def test_sideways_acceleration_ends_at_mu_g(env, ride):
  mus = [MU, 0.65, 0.3]
  motion, upright = ride(
    [grip(env, front=m, rear=m) for m in mus], [steady(0.35, 5)] * 3, np.full(3, 5.0)
  )
  for k, mu in enumerate(mus):
    sideways = (motion.yaw_rate * np.hypot(motion.vx, motion.vy))[k, 40:]
    assert (
      0.85 * mu * G < sideways.min() and sideways.max() < 1.01 * mu * G
    )  # measured: 0.93 to 0.99
  assert upright.min() > 0.998  # it slides, it does not tip
  assert (
    np.abs(slip(motion)).max() < 12 and motion.yaw_rate[:, 40:].std(1).max() < 0.05
  )  # and neither spins nor hops


def test_socks_behind_spin_the_car_socks_in_front_push_it_straight(env, ride):
  ramp = steady(0.2, 3.5)
  ramp[:, 0] = np.minimum(0.02 * np.arange(60), 0.2)
  models = [env.model, grip(env, rear=0.3), grip(env, front=0.3)]
  motion, _ = ride(models, [ramp] * 3, np.full(3, 3.5))
  nominal, rear, front = (np.abs(slip(jax.tree.map(lambda x: x[k], motion))) for k in range(3))
  assert nominal.max() < 8 and rear.max() > 60 and front.max() < 8  # [deg]
  assert np.abs(motion.yaw_rate[2, -1]) < 0.75 * np.abs(motion.yaw_rate[0, -1])
  gentle, _ = ride(
    models, [steady(0.2, 1.2)] * 3, np.full(3, 1.2)
  )  # 0.9 m/s2: the socks still hold
  np.testing.assert_allclose(gentle.yaw_rate[1:, -1], gentle.yaw_rate[0, -1], rtol=0.05)


def test_one_slippery_wheel_turns_a_braking_car_to_the_other_side(env, ride):
  models = [env.model] + [grip(env, **{w: 0.1}) for w in lib.WHEELS]
  motion, _ = ride(models, [steady(0, 0.5, 12)] * 5, np.full(5, 4.0))
  turn = motion.yaw[:, -1]
  assert abs(turn[0]) < 1e-5
  assert (turn[[1, 3]] < -0.01).all() and (
    turn[[2, 4]] > 0.01
  ).all()  # left wheels slip: to the right
  assert (motion.vx[1:, 4] > motion.vx[0, 4] + 0.02).all()  # and it brakes less


def test_strength_and_limits(env, ride):
  def task(**changed):
    return env.model._replace(
      task=env.model.task | {k: jnp.asarray(v, jnp.float32) for k, v in changed.items()}
    )

  models = [
    env.model,
    task(strength=[0.5, 1.0]),
    env.model,
    task(strength=[1.0, 0.5]),
    task(velocity_limit=[3.2, 1.5]),
    task(velocity_limit=[0.5, 5.0]),
  ]
  motion, _ = ride(
    models,
    [steady(0.2, 3), steady(0.2, 3), steady(0, 5), steady(0, 5), steady(0, 3), steady(0.2, 3)],
  )
  np.testing.assert_allclose(motion.steer[:2, -1], [0.2, 0.1], atol=2e-3)
  gain = motion.vx[2:4, 3] - motion.vx[2:4, 1]  # [m/s] in 0.1 s, once the tyres have taken hold
  assert gain[1] == pytest.approx(gain[0] / 2, rel=0.03)
  assert 1.4 < motion.vx[4].max() < 1.52
  assert motion.steer[5, 3] == pytest.approx(0.5 * 0.2, rel=0.05) and motion.steer[
    0, 3
  ] == pytest.approx(0.2, rel=0.01)


# ---- the gap -------------------------------------------------------------------------------------


def test_gap_items_have_the_values_of_the_table(env, real, same):
  assert env.gap_items is lib.GAP
  figures = {
    "steering_lag": (0.02, 0.158),
    "command_delay": (0, 1),
    "acceleration": (9.51, 3.0),
    "lidar_noise": (0.01, 0.03),
    "mass": (3.74, 3.54),
    "yaw_inertia": (0.04712, 0.05797),
    "grip": (1.0489, 0.65),
  }
  for name, (simulator, value) in figures.items():
    assert (lib.GAP[name].simulator, lib.GAP[name].real) == (simulator, value)

  def read(e, model):
    found = {
      n: float(model.task[i.leaf[5:]]) for n, i in lib.GAP.items() if i.leaf.startswith("task.")
    }
    found["mass"], found["grip"] = (
      float(model.mj["body_mass"].sum()),
      float(model.mj["geom_friction"][e.wheels[2], 0]),
    )
    return found

  for name, value in read(env, env.model).items():
    assert value == pytest.approx(lib.GAP[name].simulator, abs=1e-6)
  for name, value in read(real, real.model).items():
    assert value == pytest.approx(lib.GAP[name].real, rel=1e-6)
  dense, data = (
    np.zeros((16, 16)),
    mujoco.MjData(lib.CarReal("native", gap=("yaw_inertia",), tracks=[OVAL]).mj_model),
  )
  model = lib.CarReal("native", gap=("yaw_inertia",), tracks=[OVAL]).mj_model
  mujoco.mj_forward(model, data)
  mujoco.mj_fullM(model, data, dense)
  assert dense[5, 5] == pytest.approx(0.05797, rel=1e-4)
  assert real.mj_model.body_subtreemass[1] == pytest.approx(
    3.54, rel=1e-6
  )  # constants derived of the mass are renewed
  with pytest.raises(UserError, match="'wind'.*steering_lag"):
    lib.CarReal("native", gap=("wind",), tracks=[OVAL])


def test_widen_owns_one_leaf_and_share_zero_leaves_every_bit(env, same):
  def whole(model):
    return (
      {f"mj.{k}": v for k, v in model.mj.items()}
      | {f"task.{k}": v for k, v in model.task.items()}
      | {"force": model.force}
    )

  for name, item in lib.GAP.items():
    zero, one, two = (
      whole(jax.jit(lambda s: env.widen(env.model, name, s))(x)) for x in (0.0, 1.0, 2.0)
    )
    assert same(zero, whole(env.model))
    for other in (one, two):
      assert {k for k in zero if not same(zero[k], other[k])} == {item.leaf}
    signed = ("mj.gravity", "mj.body_ipos", "task.reward_weights")
    assert all(
      (np.asarray(v) >= 0).all() for k, v in two.items() if k not in signed
    )  # twice the gap is still a car


@pytest.fixture(scope="module")
def tour(env, drive):
  """Cars of one key and one drive, by name: `none`, and each with one item of the gap: (motion by
  field, obs), time-major; and first obs.
  """
  names = ("none", *lib.GAP)
  models = [env.model] + [env.widen(env.model, n, 1.0) for n in lib.GAP]
  first, states, outs = drive(
    models,
    jax.random.split(jax.random.key(3), 1),
    [[0.6 * np.sin(0.4 * k), 0.8 if k < 20 else -0.9] for k in range(30)],
  )
  motion = jax.tree.map(lambda *x: np.stack(x), *(s.physics.motion for s in states))
  obs = np.stack([o.obs for o in outs])
  return {
    n: (jax.tree.map(lambda x: x[:, i], motion), obs[:, i]) for i, n in enumerate(names)
  }, dict(zip(names, first))


def test_each_gap_item_changes_the_drive_or_what_is_seen_of_it(tour):
  drives, first = tour
  motion, obs = drives["none"]
  for name in lib.GAP:
    moved = max(np.abs(a - b).max() for a, b in zip(drives[name][0], motion))
    if name in NOISES:
      assert moved == 0.0  # sensors alone
      assert not np.array_equal(drives[name][1], obs) and not np.array_equal(
        first[name], first["none"]
      )
    else:
      assert moved > 0.01, name  # [m, rad, m/s, rad/s]; measured: 0.03 and more
      np.testing.assert_array_equal(first[name], first["none"])


def test_baked_in_gap_equals_the_same_gap_by_widen(env, real):
  """A fault that brings the items gives the same car as their names at construction: constants
  derived of masses agree too.
  """
  wide = env.model
  for name in lib.GAP:
    wide = env.widen(wide, name, 1.0)
  for a, b in zip(jax.tree.leaves(wide), jax.tree.leaves(real.model)):
    np.testing.assert_allclose(a, b, rtol=1e-6)
  ends = []
  for e in (env, real):
    advance, state = jax.jit(e.physics.step), e.physics.init(env._rest, jnp.zeros(16))
    for _ in range(20):
      state, out = advance(
        wide.mj if e is env else real.model.mj,
        state,
        jnp.array([0.15, 3.0]),
        real.model.task,
        real.model.force,
      )
    ends.append(np.concatenate([out["qpos"][:9], out["qvel"][:9]]))
  np.testing.assert_allclose(*ends, atol=1e-4)
  assert np.abs(ends[0][9:]).max() > 1


def test_steering_lag_and_rate(env, ride):
  lagged = env.widen(env.model, "steering_lag", 1.0)
  motion, _ = ride(
    [env.model, lagged, env.model],
    [steady(0.05, 1, 20), steady(0.05, 1, 20), steady(0.4, 1, 20)],
    np.full(3, 1.0),
  )
  left = 1 - motion.steer / np.array([[0.05], [0.05], [0.4]])
  tau = -np.polyfit(np.log(left[1, :8]), 0.05 * np.arange(1, 9), 1)[0]
  assert tau == pytest.approx(0.158, rel=0.02)  # [s]; measured: 0.1569
  assert left[0, 1] < 0.02  # the simulator's 0.02 s
  assert motion.steer[2, 0] == pytest.approx(
    3.2 * 0.05, rel=0.05
  )  # [rad] at the rate limit; measured: 0.155


def test_command_delay_is_one_control_step(env, drive):
  models = [env.model] + [env.widen(env.model, "command_delay", x) for x in (1.0, 2.0, 0.5)]
  actions = np.random.default_rng(0).uniform(-1, 1, (12, 2))
  actions[0, 0] = 0.1
  _, states, _ = drive(models, jax.random.split(jax.random.key(1), 1), actions)
  rows = np.array(
    [
      np.stack([s.physics.motion.vx, s.physics.motion.yaw_rate, s.physics.motion.steer], -1)
      for s in states
    ]
  )
  np.testing.assert_allclose(
    rows[1:, 1], rows[:-1, 0], atol=3e-3
  )  # springs and tyres move a little while the car waits
  np.testing.assert_allclose(rows[2:, 2], rows[:-2, 0], atol=3e-3)
  assert np.abs(rows[1:, 0] - rows[:-1, 0]).max() > 0.3
  assert (
    np.abs(rows[0, 1]).max() < 1e-3 and np.abs(rows[0, 0]).max() > 0.3
  )  # the first command has not arrived
  assert rows[0, 3, 2] == pytest.approx(
    rows[0, 0, 2] / 2, rel=0.02
  )  # half a step: the mean command


def test_speed_lag(env, drive):
  _, states, _ = drive(
    [env.widen(env.model, "speed_lag", 1.0), env.model],
    jax.random.split(jax.random.key(1), 1),
    [[0.0, 1.0]] * 6,
  )
  pursued = np.array([s.physics.speed for s in states])
  np.testing.assert_allclose(
    pursued[:, 0], 5 * (1 - np.exp(-0.05 * np.arange(1, 7) / 0.1)), rtol=1e-5
  )
  np.testing.assert_array_equal(pursued[:, 1], 5)


def test_noise_has_the_deviation_it_states(env, real):
  """At one place, 400 keys: deviation of a reading [m, m/s, rad/s]; five deviations of the estimate
  are 18 %.
  """
  for e in (env, real):
    state, _ = e.init(e.model, jax.random.key(0))
    p = state.physics
    obs = jax.jit(jax.vmap(lambda key: e._observe(e.model, p.motion, p.track, key)))(
      jax.random.split(jax.random.key(1), 400)
    )
    ranges = np.asarray(e.course.scan(p.track, p.motion.x, p.motion.y, p.motion.yaw))
    beam = int(np.argmin(ranges))
    assert obs[:, beam].std() * 10 == pytest.approx(float(e.model.task["noise"]), rel=0.18)
    for column, name in ((64, "speed_noise"), (65, "yaw_rate_noise")):
      assert obs[:, column].std() == pytest.approx(float(e.model.task[name]), rel=0.18, abs=1e-9)
    assert np.corrcoef(obs[:, beam], obs[:, beam + 1])[0, 1] < 0.25 and obs[:, 66].std() == 0


# ---- task ----------------------------------------------------------------------------------------


def test_observation_reward_and_end_follow_the_course(env, drive):
  clean = env.model._replace(task=env.model.task | {"noise": jnp.float32(0)})
  _, states, outs = drive([clean] * 4, jax.random.split(jax.random.key(2), 4), [[0.1, 0.0]] * 60)
  scan, collides, locate = (
    jax.jit(jax.vmap(f)) for f in (env.course.scan, env.course.collides, env.course.locate)
  )
  at, ended, matrix = env.physics._qpos_at, np.zeros(4, bool), np.zeros((4, 9))
  for state, out in zip(states, outs):
    row = np.asarray(state.physics.backend).view(np.float64)
    q, v = row[:, at : at + 17], row[:, at + 17 : at + 33]
    for i in range(4):
      mujoco.mju_quat2Mat(matrix[i], q[i, 3:7])
    yaw = np.arctan2(matrix[:, 3], matrix[:, 0])
    track, place = state.physics.track, [np.float32(x) for x in (q[:, 0], q[:, 1], yaw)]
    heading = np.asarray(locate(track, *place[:2]).heading)
    near = np.asarray(collides(track, *place)) | (np.cos(yaw - heading) < 0)
    np.testing.assert_allclose(out.obs[:, :64], np.clip(scan(track, *place), 0, 10) / 10, atol=1e-4)
    own = np.stack(
      [v[:, 0] * np.cos(yaw) + v[:, 1] * np.sin(yaw), v[:, 5], (q[:, 8] + q[:, 11]) / 2], -1
    )
    np.testing.assert_allclose(out.obs[:, 64:], own, atol=1e-4)
    np.testing.assert_allclose(
      out.reward, (v[:, 0] * np.cos(heading) + v[:, 1] * np.sin(heading)) / 5 - 5 * near, atol=1e-4
    )
    np.testing.assert_array_equal(out.terminated, near)
    np.testing.assert_array_equal(out.obs, out.final_obs)
    assert not out.truncated.any()
    ended |= near
  assert ended.all()  # a constant command meets a wall


def test_facing_back_along_the_track_terminates(env, drive):
  def change(state):
    backend = state.physics.backend
    for i, turn in enumerate((0.0, np.pi, 1.7)):
      m = state.physics.motion
      yaw = m.yaw[i] + turn
      qpos = np.array(env._rest)
      qpos[:2], qpos[3:7] = (m.x[i], m.y[i]), (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))
      backend = backend.at[i].set(env.physics.init(jnp.asarray(qpos, jnp.float32), jnp.zeros(16)))
    return state._replace(physics=state.physics._replace(backend=backend))

  keys = jax.random.split(jax.random.key(6), 3)
  _, _, (out,) = drive([env.model] * 3, keys, [[0.0, -1.0]], change)
  np.testing.assert_array_equal(out.terminated, [False, True, True])
  np.testing.assert_allclose(out.reward, [0, -5, -5], atol=0.2)  # from rest


def test_tipping_over_terminates_and_the_time_limit_truncates(env, drive):
  def change(state):
    lying = np.array(env._rest)
    lying[:2] = state.physics.motion.x[0], state.physics.motion.y[0]
    lying[2:7] = 0.3, np.cos(0.6), np.sin(0.6), 0, 0  # rolled by 1.2 rad
    backend = state.physics.backend.at[0].set(
      env.physics.init(jnp.asarray(lying, jnp.float32), jnp.zeros(16))
    )
    return state._replace(
      physics=state.physics._replace(backend=backend),
      step=state.step.at[1].set(1199).at[2].set(1198),
    )

  _, _, (out,) = drive(
    [env.model] * 3, jax.random.split(jax.random.key(5), 3), np.zeros((1, 2)), change
  )
  np.testing.assert_array_equal(out.terminated, [True, False, False])
  np.testing.assert_array_equal(out.truncated, [False, True, False])
  assert out.reward[0] < -4


def test_same_key_gives_equal_bits_and_vmap_equals_a_loop(env, real, drive, same):
  keys, actions = (
    jax.random.split(jax.random.key(8), 3),
    np.random.default_rng(1).uniform(-1, 1, (8, 2)),
  )
  first = drive([real.model] * 3, keys, actions)
  assert same(first, drive([real.model] * 3, keys, actions))
  assert not same(first[0][0], first[0][1]) and not same(first[2][0].obs[0], first[2][1].obs[0])
  assert same(
    drive([real.model] * 3, keys, 3 * np.sign(actions[:2]))[2],
    drive([real.model] * 3, keys, np.sign(actions[:2]))[2],
  )  # clipped
  step = jax.jit(env.step)
  for i in range(3):
    state, obs = env.init(real.model, keys[i])
    for k, action in enumerate(np.asarray(actions, np.float32)):
      state, out = step(real.model, state, action)
      for x, y in zip(out, first[2][k]):
        np.testing.assert_allclose(x, y[i], atol=2e-5)  # the lidar's sums in another order


# ---- parity native / MJX -------------------------------------------------------------------------
# Tolerances are about ten times what was measured on a CPU (jax 0.9.2, mujoco 3.14.0). Wheels slip
# and lift smoothly, so that even the largest
# error is bounded, given a solver that has converged: with 8 instead of 20 line-search steps C
# MuJoCo is up to 0.2 m/s off its own limit.


@pytest.fixture(scope="module")
def pair(env):
  """{name: (init, step)} of both backends for CARS cars with a friction table of their own, and
  such tables; one MJX program.
  """
  backends = {
    n: physics.make(n, env.mj_model, lib.SUBSTEPS, law=lib.motor_law(env.mj_model))
    for n in ("native", "mjx")
  }
  table = np.tile(env.mj_model.geom_friction, (CARS, 1, 1)).astype(np.float32)
  table[:, list(env.wheels), 0] *= np.random.default_rng(0).uniform(0.3, 1, (CARS, 4))

  def programs(backend):
    step = jax.vmap(
      lambda friction, state, command: backend.step(
        {"geom_friction": friction}, state, command, env.model.task
      )
    )
    return jax.jit(jax.vmap(backend.init)), jax.jit(step)

  return {n: programs(b) for n, b in backends.items()}, table


@pytest.fixture(scope="module")
def crowd(env, pair):
  """States of cars that drive, brake, slide and spin: qpos, qvel (16, CARS, ...), and commands (16,
  CARS, 2).
  """
  (init, step), table = pair[0]["native"], pair[1]
  rng, kept = np.random.default_rng(1), []
  state = init(np.tile(env._rest, (CARS, 1)), np.zeros((CARS, 16), np.float32))
  for k in range(80):
    if k % 8 == 0:
      command = np.stack([rng.uniform(-0.42, 0.42, CARS), rng.uniform(0.5, 5, CARS)], -1).astype(
        np.float32
      )
    state, out = step(table, state, command)
    if k % 5 == 4:
      kept.append((np.asarray(out["qpos"]), np.asarray(out["qvel"]), command))
  return tuple(np.stack(x) for x in zip(*kept))


def errors(a, b):
  """Largest error of each car's chassis, sorted: place, attitude [m, 1], velocity [m/s, rad/s]."""
  return tuple(
    np.sort(np.abs(np.asarray(a[k])[:, :n] - np.asarray(b[k])[:, :n]).max(-1))
    for k, n in (("qpos", 7), ("qvel", 6))
  )


def test_parity_of_one_step_from_1000_states(pair, crowd):
  backends, table = pair
  position, speed = [], []
  for qpos, qvel, command in zip(*crowd):
    a, b = (step(table, init(qpos, qvel), command[::-1])[1] for init, step in backends.values())
    p, s = errors(a, b)
    position.append(p), speed.append(s)
  position, speed = np.sort(np.concatenate(position)), np.sort(np.concatenate(speed))
  assert len(position) >= 1000
  assert np.median(position) < 5e-6 and position[-1] < 1e-4  # measured: 4.8e-7, largest 1.1e-5
  assert np.median(speed) < 2e-4 and speed[-1] < 5e-3  # measured: 2.2e-5, largest 5.5e-4


def test_parity_of_ten_steps_from_50_states(pair, crowd):
  backends, table = pair
  qpos, qvel, _ = (x[4] for x in crowd)
  commands = crowd[2][:10]
  states = {n: init(qpos, qvel) for n, (init, _) in backends.items()}
  for command in commands:
    outs = {}
    for n, (_, step) in backends.items():
      states[n], outs[n] = step(table, states[n], command)
  position, speed = errors(outs["native"], outs["mjx"])
  assert len(position) >= 50
  assert np.median(position) < 7e-5 and position[-1] < 4e-4  # measured: 6.5e-6, largest 4.2e-5
  assert np.median(speed) < 7e-4 and speed[-1] < 5e-3  # measured: 6.8e-5, largest 4.5e-4


def test_parity_of_100_steps_without_contact(env, pair):
  """Cars that fall for 5 s (123 m), turn and are told to steer and to drive; wheels and springs
  move, the floor is not met.
  """
  backends, table = pair
  rng = np.random.default_rng(3)
  qpos, qvel = np.tile(env._rest, (CARS, 1)), np.zeros((CARS, 16))
  qpos[:, 2], qvel[:, :6] = 140.0, rng.uniform(-1, 1, (CARS, 6))
  states = {
    n: init(qpos.astype(np.float32), qvel.astype(np.float32)) for n, (init, _) in backends.items()
  }
  for k in range(100):
    if k % 10 == 0:
      command = np.stack([rng.uniform(-0.42, 0.42, CARS), rng.uniform(0.5, 5, CARS)], -1).astype(
        np.float32
      )
    outs = {}
    for n, (_, step) in backends.items():
      states[n], outs[n] = step(table, states[n], command)
  assert (
    np.asarray(outs["native"]["qpos"])[:, 2].min() > 5
    and np.abs(np.asarray(outs["native"]["qvel"])[:, 6:]).max() > 50
  )  # in the air; wheels have spun up
  position, speed = errors(outs["native"], outs["mjx"])
  assert np.median(position) < 7e-4 and position[-1] < 4e-3  # measured: 7.2e-5, largest 3.5e-4
  assert np.median(speed) < 6e-4 and speed[-1] < 3e-3  # measured: 6.1e-5, largest 2.9e-4


def test_mjx_environment_starts_as_the_native_one(env):
  other = lib.CarReal("mjx", gap=(), tracks=[OVAL])
  (a, obs_a), (b, obs_b) = (
    env.init(env.model, jax.random.key(5)),
    other.init(other.model, jax.random.key(5)),
  )
  at = env.physics._qpos_at
  np.testing.assert_array_equal(obs_a, obs_b)
  np.testing.assert_array_equal(
    np.asarray(a.physics.backend).view(np.float64)[at : at + 17].astype(np.float32),
    b.physics.backend.qpos,
  )
  assert env.spec == other.spec
