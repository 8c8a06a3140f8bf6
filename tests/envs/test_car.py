"""The simulated car against a NumPy model written from the equations, and against limits that
follow from them.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl.envs import car as lib
from mjx_cl.envs import racing
from mjx_cl.envs.car import Car, Motion
from mjx_cl.errors import UserError
from mjx_cl.types import Model

CARS = 24  # batch of the programs that hold the lidar
MU, G, M, L, LF, LR = 1.0489, 9.81, 3.74, 0.3302, 0.15875, 0.17145


@pytest.fixture(scope="module")
def env():
  return Car()


@pytest.fixture(scope="module")
def init(env):
  """init(seed): CARS cars, state and observation; one program."""
  jitted = jax.jit(jax.vmap(env.init, (None, 0)))
  return lambda seed: jitted(env.model, jax.random.split(jax.random.key(seed), CARS))


@pytest.fixture(scope="module")
def step(env):
  """One control step of CARS cars, jitted."""
  return jax.jit(jax.vmap(env.step, (None, 0, 0)))


@pytest.fixture(scope="module")
def advance():
  """lib.advance of many cars, each with its own task and command, no outer force."""
  return jax.jit(
    jax.vmap(lambda task, motion, angle, speed: lib.advance(Model({}, task), motion, angle, speed))
  )


def tasks(num, **changed):
  """Nominal task of `num` cars, with leaves replaced by (num, ...) arrays."""
  base = {k: jnp.broadcast_to(v, (num,) + v.shape) for k, v in lib.nominal().items()}
  return base | {k: jnp.asarray(v, jnp.float32) for k, v in changed.items()}


def motions(num, **changed):
  """Cars at rest at the origin, with fields replaced by (num,) arrays or numbers."""
  return Motion(
    *(
      jnp.broadcast_to(jnp.asarray(changed.get(f, 0.0), jnp.float32), (num,))
      for f in Motion._fields
    )
  )


def random_tasks(num, rng):
  return tasks(
    num,
    friction=rng.uniform(0.05, 1.2, (num, 2)),
    mass=rng.uniform(2, 6, num),
    inertia=rng.uniform(0.03, 0.08, num),
    com=np.stack([rng.uniform(-0.03, 0.03, num), rng.uniform(0.03, 0.12, num)], 1),
    strength=rng.uniform(0.3, 1, (num, 2)),
    velocity_limit=rng.uniform([1, 1], [3.2, 5], (num, 2)),
    steer_lag_s=rng.uniform(0.01, 0.2, num),
    gravity=np.stack(
      [rng.uniform(-2, 2, num), rng.uniform(-2, 2, num), rng.uniform(-10, -8, num)], 1
    ),
  )


def random_motions(num, rng):
  """Driving, spinning, reversing and sliding cars."""
  return motions(
    num,
    x=rng.uniform(-9, 9, num),
    y=rng.uniform(-9, 9, num),
    yaw=rng.uniform(-3, 3, num),
    vx=rng.uniform(-2, 5, num),
    vy=rng.normal(0, 1, num),
    yaw_rate=rng.normal(0, 3, num),
    steer=rng.uniform(-0.41, 0.41, num),
  )


def oracle_slope(task, q, angle, speed, force):
  """d/dt of (x, y, yaw, vx, vy, r, delta) of one car in float64."""
  _, _, yaw, vx, vy, r, delta = q
  m, iz, (shift, h), mu = task["mass"], task["inertia"], task["com"], task["friction"]
  lf, lr = LF - shift, LR + shift
  target = np.clip(task["strength"][0] * angle, -0.4189, 0.4189)
  limit = task["velocity_limit"]
  rate = np.clip((target - delta) / max(task["steer_lag_s"], 0.01), -limit[0], limit[0])
  error = min(speed, limit[1]) - vx
  accel = np.clip((4.755 if error > 0 else 19.02) * error, -9.51, 9.51)
  want = task["strength"][1] * 3.74 * accel
  g = -task["gravity"][2]
  at_rest = np.array([m * g * lr / L, m * g * lf / L])
  q0 = np.clip(want / (mu @ at_rest), -0.95, 0.95)
  moved = q0 * (mu @ at_rest) * h / L
  load = np.maximum(at_rest + [-moved, moved], 0)
  used = np.clip(want / (mu @ load), -0.95, 0.95)
  fx = used * mu * load
  speeds = []
  for steer, lateral in (
    (delta, vy + lf * r),
    (0.0, vy - lr * r),
  ):  # velocity of the axle's centre, turned into the wheels' frame
    speeds.append(
      np.array([[np.cos(steer), np.sin(steer)], [-np.sin(steer), np.cos(steer)]]) @ [vx, lateral]
    )
  alpha = np.array([-np.arctan2(w, max(abs(u), 1.0)) for u, w in speeds])
  fy = mu * load * np.sqrt(1 - used**2) * np.tanh(np.array([4.718, 5.4562]) * alpha)
  front = np.array([[np.cos(delta), -np.sin(delta)], [np.sin(delta), np.cos(delta)]]) @ [
    fx[0],
    fy[0],
  ]
  world = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
  push = world.T @ (np.asarray(force[:2]) + m * np.asarray(task["gravity"][:2]))
  ax, ay = (front + [fx[1], fy[1]] + push) / m
  return np.array(
    [
      *(world @ [vx, vy]),
      r,
      ax + vy * r,
      ay - vx * r,
      (lf * front[1] - lr * fy[1] + force[2]) / iz,
      rate,
    ]
  )


def oracle_advance(task, q, angle, speed, force=(0, 0, 0)):
  for _ in range(5):
    k1 = oracle_slope(task, q, angle, speed, force)
    k2 = oracle_slope(task, q + 0.005 * k1, angle, speed, force)
    k3 = oracle_slope(task, q + 0.005 * k2, angle, speed, force)
    k4 = oracle_slope(task, q + 0.01 * k3, angle, speed, force)
    q = q + 0.01 / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
  return np.array([*q[:2], (q[2] + np.pi) % (2 * np.pi) - np.pi, *q[3:]])


# ---- spec, command, observation, reward ----------------------------------------------------------


def test_spec_and_model(env):
  spec = env.spec
  assert [v.name for v in spec.obs] == [f"lidar_{k:02d}" for k in range(64)] + [
    "speed",
    "yaw_rate",
    "steering",
  ] and len(spec.obs) == 67
  assert [v.unit for v in spec.obs] == ["1"] * 64 + ["m/s", "rad/s", "rad"]
  assert {(v.low, v.high) for v in spec.obs[:64]} == {(0, 1)} and (
    spec.obs[66].low,
    spec.obs[66].high,
  ) == pytest.approx((-1.05 * 0.4189, 1.05 * 0.4189))
  assert [v.name for v in spec.act] == list(spec.targets) == ["steering", "motor"] and {
    (v.low, v.high) for v in spec.act
  } == {(-1, 1)}
  assert (spec.control_s, spec.episode_steps, spec.posture) == (
    0.05,
    1200,
    None,
  ) and 0 < spec.acceptance < 0.93
  groups = dict(spec.obs_groups)
  assert (
    sorted(groups["lidar_right"] + groups["lidar_front"] + groups["lidar_left"])
    == list(groups["lidar"])
    == list(range(64))
  )
  assert len(groups["lidar_right"]) == len(groups["lidar_left"]) and max(
    groups["lidar_right"]
  ) < min(groups["lidar_front"])
  assert groups["motion"] == (64, 65, 66) and spec.feet == (("front", (0,)), ("rear", (1,)))
  task = {k: np.asarray(v).tolist() for k, v in env.model.task.items()}
  want = {
    "friction": [MU, MU],
    "mass": M,
    "inertia": 0.04712,
    "com": [0, 0.074],
    "strength": [1, 1],
    "velocity_limit": [3.2, 5],
    "steer_lag_s": 0.02,
    "noise": 0.01,
    "gravity": [0, 0, -9.81],
    "reward_weights": [0.2, -5],
  }
  assert set(task) == set(want) and env.model.mj == {}
  assert all(task[k] == pytest.approx(want[k], rel=1e-6) for k in want)  # float32
  assert all(
    v.dtype == jnp.float32 for v in jax.tree.leaves(env.model)
  ) and env.model.force.tolist() == [0, 0, 0]


def test_any_backend_is_the_same_car_and_a_wrong_name_is_refused(env, same):
  assert env.physics.name == "jax" and env.physics.seconds == 0.0
  other = Car("mjx")
  assert other.spec == env.spec and same(other.model, env.model) and other.physics.name == "jax"
  with pytest.raises(UserError, match="unknown physics 'gpu'; choose from: auto, mjx, native"):
    Car("gpu")


@pytest.mark.parametrize(
  "action, want",
  [
    ((0, 0), (0, 2.75)),
    ((1, 1), (0.4189, 5)),
    ((-1, -1), (-0.4189, 0.5)),
    ((-9, 9), (-0.4189, 5)),
    ((0.5, -0.5), (0.20945, 1.625)),
  ],
)
def test_command_by_hand(action, want):
  assert [float(v) for v in racing.command(jnp.asarray(action, jnp.float32))] == pytest.approx(
    want, abs=1e-6
  )


def test_observation_scales_clips_and_adds_noise(env):
  ranges = jnp.tile(jnp.asarray([0.004, 2.0, 9.996, 10.0]), 16)
  obs = racing.observe(env.course, ranges, 3.0, -1.5, 0.2, 0.0, jax.random.key(0))
  np.testing.assert_allclose(
    obs, [*np.tile([0.0004, 0.2, 0.9996, 1.0], 16), 3.0, -1.5, 0.2], rtol=1e-6
  )
  noisy = np.asarray(
    jax.jit(jax.vmap(lambda key: racing.observe(env.course, ranges, 3.0, -1.5, 0.2, 0.01, key)))(
      jax.random.split(jax.random.key(1), 400)
    )
  )
  assert noisy[:, :64].min() == 0 and noisy[:, :64].max() == 1
  middle = noisy[:, 1:64:4] * 10 - 2.0
  assert abs(middle.std() - 0.01) < 5 * 0.01 / np.sqrt(2 * middle.size) and abs(
    middle.mean()
  ) < 5 * 0.01 / np.sqrt(middle.size)
  np.testing.assert_array_equal(
    noisy[:, 64:], np.tile(np.float32([3.0, -1.5, 0.2]), (400, 1))
  )  # what the car knows of itself has none


@pytest.mark.parametrize(
  "along, crashed, want",
  [(5.0, False, 1.0), (0.0, False, 0.0), (-2.5, False, -0.5), (5.0, True, -4.0), (0.0, True, -5.0)],
)
def test_reward_by_hand(along, crashed, want):
  assert float(racing.reward(jnp.float32(along), jnp.bool_(crashed))) == pytest.approx(
    want, abs=1e-6
  )


def test_progress_is_the_speed_along_the_track(env):
  t = env.course.tracks[2]
  x, y = t.centre[10]
  heading = t.heading[10]
  angle = np.float32([0.0, 0.5, np.pi / 2, np.pi])
  got = jax.jit(
    jax.vmap(lambda vx, vy: racing.progress(env.course, 2, jnp.float32(x), jnp.float32(y), vx, vy))
  )(2 * np.cos(heading + angle), 2 * np.sin(heading + angle))
  np.testing.assert_allclose(got, 2 * np.cos(angle), atol=1e-3)


# ---- tyres ---------------------------------------------------------------------------------------


def test_no_axle_exceeds_its_friction(advance):
  num, rng = 2000, np.random.default_rng(0)
  task, motion = random_tasks(num, rng), random_motions(num, rng)
  task["friction"] = task["friction"].at[:50, 1].set(0.0)
  along, across, load = jax.jit(jax.vmap(lib.axle_forces))(
    task, motion, jnp.asarray(rng.normal(0, 30, num), jnp.float32)
  )
  assert np.isfinite(along).all() and np.isfinite(across).all() and (load >= 0).all()
  total, most = np.hypot(along, across), np.asarray(task["friction"] * load)
  assert (total <= most * (1 + 1e-5) + 1e-6).all() and (
    total / np.maximum(most, 1e-6)
  ).max() > 0.99  # float32; the bound is reached
  assert (np.abs(along) <= 0.95 * most * (1 + 1e-5) + 1e-6).all()
  np.testing.assert_allclose(load.sum(1), task["mass"] * -task["gravity"][:, 2], rtol=1e-5)


def test_tyre_by_hand():
  """A standing car holds 19.05 N in front and 17.64 N behind; the slope of the force at no slip is
  C mu N, its end mu N.
  """
  jitted = jax.jit(
    lambda vy, drive: lib.axle_forces(
      lib.nominal(), Motion(*map(jnp.float32, (0, 0, 0, 3.0, vy, 0, 0))), drive
    )
  )

  def forces(vy, drive=0.0):
    return [np.asarray(v) for v in jitted(vy, drive)]

  np.testing.assert_allclose(forces(0)[2], [19.05, 17.64], atol=0.005)
  np.testing.assert_allclose(
    forces(-0.003)[1] / 0.001, MU * np.array([4.718 * 19.05, 5.4562 * 17.64]), rtol=1e-3
  )  # slip 0.001 rad
  np.testing.assert_allclose(forces(-30.0)[1], MU * np.array([19.05, 17.64]), rtol=1e-3)
  along, across, load = forces(-30.0, drive=3.74 * 5)
  np.testing.assert_allclose(
    load, [19.05 - 3.74 * 5 * 0.074 / L, 17.64 + 3.74 * 5 * 0.074 / L], atol=0.01
  )
  assert along.sum() == pytest.approx(3.74 * 5, rel=1e-5)
  np.testing.assert_allclose(np.hypot(along, across), MU * load, rtol=1e-3)


def test_lost_grip_changes_its_own_axle_only():
  rng = np.random.default_rng(1)
  motion, no_drive = random_motions(200, rng), jnp.zeros(200)
  forces = jax.jit(jax.vmap(lib.axle_forces))
  _, plain, _ = forces(tasks(200), motion, no_drive)
  _, sock, _ = forces(tasks(200, friction=np.tile([MU, 0.5 * MU], (200, 1))), motion, no_drive)
  np.testing.assert_array_equal(sock[:, 0], plain[:, 0])
  np.testing.assert_allclose(sock[:, 1], 0.5 * plain[:, 1], rtol=1e-5)


# ---- dynamics ------------------------------------------------------------------------------------


def test_dynamics_equal_a_numpy_loop(advance):
  num, rng = 32, np.random.default_rng(2)
  task, motion = random_tasks(num, rng), random_motions(num, rng)
  want = np.array(motion, float).T
  rows = [{k: np.asarray(v[i], float) for k, v in task.items()} for i in range(num)]
  for _ in range(10):
    angle, speed = (
      rng.uniform(-0.42, 0.42, num).astype(np.float32),
      rng.uniform(0.5, 5, num).astype(np.float32),
    )
    motion = advance(task, motion, angle, speed)
    want = np.array(
      [oracle_advance(rows[i], want[i], float(angle[i]), float(speed[i])) for i in range(num)]
    )
  error = np.array(motion).T - want
  error[:, 2] = (error[:, 2] + np.pi) % (2 * np.pi) - np.pi
  np.testing.assert_allclose(
    error, 0, atol=2e-3
  )  # float32 over 50 substeps, sliding cars included, which may amplify it; measured 5e-6
  assert np.median(np.abs(error)) < 1e-5


def test_outer_force_and_slope_push_the_car(env):
  advance = jax.jit(
    lambda model: lib.advance(
      model, Motion(*map(jnp.float32, (0, 0, 1.2, 2.0, 0, 0, 0.1))), 0.1, 3.0
    )
  )

  def one(force, gravity):
    model = env.model._replace(
      task=env.model.task | {"gravity": jnp.asarray(gravity, jnp.float32)}, force=force
    )
    return np.array(advance(model), float)

  task = {k: np.asarray(v, float) for k, v in env.model.task.items()}
  start = np.array([0, 0, np.float32(1.2), 2.0, 0, 0, np.float32(0.1)], float)
  for force, gravity in (((5.0, -3.0, 0.1), (0, 0, -9.81)), ((0.0, 0.0, 0.0), (1.5, -1.0, -9.6))):
    want = oracle_advance(task | {"gravity": np.array(gravity)}, start, 0.1, 3.0, force)
    np.testing.assert_allclose(one(jnp.asarray(force), gravity), want, atol=1e-5)
    assert np.abs(one(None, (0, 0, -9.81)) - want).max() > 0.01  # it matters
  np.testing.assert_array_equal(one(None, (0, 0, -9.81)), one(jnp.zeros(3), (0, 0, -9.81)))


def test_limits_of_acceleration_and_steering(advance):
  """From rest to full speed, from full speed to the least, and steering from end to end: 9.51 m/s2
  or what friction allows, 3.2 rad/s.
  """
  friction = np.array([MU, MU, 0.4, 0.4])
  motion = motions(4, vx=[0.0, 5.0, 0.0, 5.0])
  speed = jnp.asarray([5.0, 0.5, 5.0, 0.5])
  after = advance(tasks(4, friction=np.stack([friction] * 2, 1)), motion, jnp.zeros(4), speed)
  accel = (np.asarray(after.vx) - np.asarray(motion.vx)) / 0.05
  limit = np.minimum(9.51, 0.95 * friction * G)
  np.testing.assert_allclose(accel, limit * [1, -1, 1, -1], rtol=1e-4)
  motion, angles = motions(1, steer=-0.4189), []
  for _ in range(8):
    motion = advance(tasks(1), motion, jnp.asarray([0.4189]), jnp.asarray([0.5]))
    angles.append(float(motion.steer[0]))
  np.testing.assert_allclose(np.diff([-0.4189, *angles[:4]]), 3.2 * 0.05, rtol=1e-4)
  assert angles[-1] == pytest.approx(0.4189, abs=1e-3) and max(angles) <= 0.4189


def circle(advance, task, num, angle, speed, steps=80, **start):
  motion = motions(num, vx=speed, **start)
  for _ in range(steps):
    motion = advance(
      task,
      motion,
      jnp.broadcast_to(jnp.float32(angle), (num,)),
      jnp.broadcast_to(jnp.asarray(speed, jnp.float32), (num,)),
    )
  return motion


def test_steady_cornering_follows_the_understeer_formula(advance):
  """delta = L / R + K a_y / g, K = 1 / (mu_f C_f) - 1 / (mu_r C_r), R = V / r, a_y = V r; nominal
  and with less grip behind.
  """
  behind = np.array([1.0, 0.7, 1.0, 0.7])
  motion = circle(
    advance,
    tasks(4, friction=np.stack([np.full(4, MU), MU * behind], 1)),
    4,
    0.03,
    [1.5, 1.5, 3.0, 3.0],
  )
  understeer = 1 / (MU * 4.718) - 1 / (MU * behind * 5.4562)
  assert understeer[0] == pytest.approx(0.027, abs=5e-4) and understeer[1] < 0
  speed, rate = np.hypot(motion.vx, motion.vy), np.asarray(motion.yaw_rate)
  np.testing.assert_allclose(
    L * rate / speed + understeer * speed * rate / G, 0.03, rtol=0.01
  )  # tanh at 10 % of the grip, tan at 0.03 rad


def test_slow_cars_roll_on_the_kinematic_circle(advance):
  motion = circle(advance, tasks(2), 2, 0.4189, [0.5, 1.0])
  radius = np.hypot(motion.vx, motion.vy) / motion.yaw_rate
  want = np.hypot(L / np.tan(0.4189), LR)  # of the centre of gravity
  # slip adds K a_y / g <= 0.027 * 1.3 / 9.81 rad to 0.4189, and the tyre below 1 m/s is as soft as
  # at 1 m/s
  np.testing.assert_allclose(radius, want, rtol=0.02)


def test_critical_speed_with_less_grip_behind(advance):
  """v_crit = sqrt(g L / -K): 4.69, 2.81 and 2.13 m/s for friction 0.524, 0.30 and 0.20 behind.
  Below it a disturbance dies, above it grows.
  """
  behind = np.array([0.5 * MU, 0.30, 0.20])
  critical = np.sqrt(G * L / (1 / (behind * 5.4562) - 1 / (MU * 4.718)))
  np.testing.assert_allclose(critical, [4.69, 2.81, 2.13], atol=0.005)
  friction = np.tile(np.stack([np.full(3, MU), behind], 1), (2, 1))
  speed = np.concatenate([0.9 * critical, 1.1 * critical])
  task = tasks(6, friction=friction, velocity_limit=np.tile([3.2, 9.0], (6, 1)))
  early = circle(advance, task, 6, 0.0, speed, steps=10, yaw_rate=0.01)
  late = circle(advance, task, 6, 0.0, speed, steps=70, yaw_rate=0.01)
  ratio = np.abs(np.asarray(late.yaw_rate) / np.asarray(early.yaw_rate))
  assert (ratio[:3] < 0.5).all() and (ratio[3:] > 3.0).all(), ratio


# ---- environment ---------------------------------------------------------------------------------


def test_reset(env, init):
  state, obs = init(0)
  assert obs.shape == (CARS, 67) and obs.dtype == jnp.float32
  motion = state.physics.motion
  for field in ("vx", "vy", "yaw_rate", "steer"):
    np.testing.assert_array_equal(getattr(motion, field), 0)
  np.testing.assert_array_equal(state.step, 0)
  clean = jax.jit(jax.vmap(env.course.scan))(state.physics.track, motion.x, motion.y, motion.yaw)
  error = np.asarray(obs[:, :64] * 10 - clean)
  assert 0.008 < error.std() < 0.012 and np.abs(error).max() < 0.06
  np.testing.assert_array_equal(obs[:, 64:], 0)


def test_step_is_command_dynamics_lidar_and_reward(env, init, step):
  state, _ = init(1)
  rng = np.random.default_rng(3)
  rows = np.array(state.physics.motion, float).T
  task = {k: np.asarray(v, float) for k, v in env.model.task.items()}
  scan, noise = jax.jit(jax.vmap(env.course.scan)), []
  for _ in range(5):
    action = rng.uniform(-1, 1, (CARS, 2)).astype(np.float32)
    state, out = step(env.model, state, action)
    motion = state.physics.motion
    noise.append(
      np.asarray(out.obs[:, :64] * 10 - scan(state.physics.track, motion.x, motion.y, motion.yaw))
    )
    rows = np.array(
      [
        oracle_advance(task, q, 0.4189 * float(a[0]), 0.5 + 2.25 * (float(a[1]) + 1))
        for q, a in zip(rows, action)
      ]
    )
  np.testing.assert_allclose(np.array(motion).T, rows, atol=1e-4)  # float32, 5 control steps
  np.testing.assert_allclose(out.obs[:, 64:], rows[:, [3, 5, 6]], atol=1e-4)
  assert (
    np.abs(noise).max() < 0.06 and 0.008 < np.std(noise) < 0.012
  )  # 6 deviations; readings at the range's end have half of the noise
  assert (
    np.abs(np.corrcoef(np.reshape(noise, (5, -1))) - np.eye(5)).max() < 0.15
  )  # fresh at every step: 5 / sqrt(24 * 64)
  heading = np.asarray(
    jax.jit(jax.vmap(env.course.locate))(state.physics.track, motion.x, motion.y).heading
  )
  angle = rows[:, 2] - heading
  along = rows[:, 3] * np.cos(angle) - rows[:, 4] * np.sin(angle)
  np.testing.assert_allclose(out.reward, along / 5 - 5 * np.asarray(out.terminated), atol=1e-4)
  np.testing.assert_array_equal(out.obs, out.final_obs)


def test_contact_terminates_and_time_truncates(env, init, step):
  state, _ = init(2)
  t = env.course.tracks[0]
  side = np.tile(
    [0.0, 1.0], CARS // 2
  )  # a car along the track touches the wall from 1.1 - 0.155 m on
  x, y = t.centre[4][:, None] + np.array([[-np.sin(t.heading[4])], [np.cos(t.heading[4])]]) * side
  motion = motions(CARS, x=x, y=y, yaw=t.heading[4], vx=2.0)
  step_at = jnp.tile(jnp.asarray([5, 5, 1199, 1199], jnp.int32), CARS // 4)
  state = state._replace(
    physics=state.physics._replace(motion=motion, track=jnp.zeros(CARS, jnp.int32)), step=step_at
  )
  state, out = step(env.model, state, jnp.tile(jnp.asarray([1.0, 0.0]), (CARS, 1)))
  assert out.terminated[:4].tolist() == [False, True, False, True]
  assert out.truncated[:4].tolist() == [False, False, True, False]  # an end is one or the other
  assert (
    out.reward[1] < -4.4 and out.reward[0] > 0.3 and state.step[:4].tolist() == [6, 6, 1200, 1200]
  )


def test_a_car_that_faces_back_along_the_track_has_crashed(env, init, step):
  state, _ = init(3)
  t, degrees = env.course.tracks[1], np.array([0, 85, -85, 95, -95, 180])
  turn = np.resize(np.radians(degrees), CARS)
  motion = motions(CARS, x=t.centre[9][0], y=t.centre[9][1], yaw=t.heading[9] + turn)
  physics = state.physics._replace(motion=motion, track=jnp.ones(CARS, jnp.int32))
  _, out = step(
    env.model, state._replace(physics=physics), jnp.tile(jnp.asarray([0.0, -1]), (CARS, 1))
  )
  assert out.terminated[:6].tolist() == [False, False, False, True, True, True]
  assert not out.truncated.any()
  np.testing.assert_allclose(out.reward[:6], [0, 0, 0, -5, -5, -5], atol=0.1)  # from rest


def test_same_key_gives_equal_bits_and_a_loop_the_same_numbers(env, init, step, same):
  action = jnp.tile(jnp.asarray([[0.3, 1.0], [-0.2, 0.5], [0.1, -1.0]]), (CARS // 3, 1))

  def run(seed):
    state, _ = init(seed)
    outs = []
    for _ in range(6):
      state, out = step(env.model, state, action)
      outs.append(out)
    return state, outs

  together = run(0)
  assert same(together, run(0)) and not same(together, run(1))
  single, start = jax.jit(env.step), init(0)[0]
  for i in range(3):
    state = jax.tree.map(lambda v: v[i], start)
    for k in range(6):
      state, out = single(env.model, state, action[i])
      np.testing.assert_allclose(
        out.obs, together[1][k].obs[i], rtol=1e-4, atol=1e-5
      )  # another order of float32 sums
      np.testing.assert_allclose(out.reward, together[1][k].reward[i], atol=1e-5)


def test_reference_driver_laps_every_track_and_a_sock_throws_it_off(env, init):
  """Pure pursuit under vmap and scan on all tracks for 20 s: no contact, most of the full reward;
  with half the grip behind it crashes.
  """
  track = np.arange(CARS, dtype=np.int32) % 6
  x, y, heading, _ = jax.jit(jax.vmap(env.course.at))(
    track, np.arange(CARS, dtype=np.float32) * 1.3
  )
  state, _ = init(0)
  state = state._replace(
    physics=state.physics._replace(
      motion=motions(CARS, x=x, y=y, yaw=heading), track=jnp.asarray(track)
    )
  )

  @jax.jit
  def drive(model):
    def one(state, _):
      action = jax.vmap(lambda s: racing.pure_pursuit(env, s))(state)
      state, out = jax.vmap(env.step, (None, 0, 0))(model, state, action)
      return state, (out.reward, out.terminated, action, jnp.isfinite(out.obs).all())

    return jax.lax.scan(one, state, None, length=400)[1]

  reward, crashed, action, finite = drive(env.model)
  assert not crashed.any() and finite.all() and np.abs(action).max() <= 1
  assert np.asarray(reward).mean(0).min() > 0.8
  _, crashed, _, finite = drive(
    env.model._replace(task=env.model.task | {"friction": jnp.asarray([MU, 0.5 * MU], jnp.float32)})
  )
  assert np.asarray(crashed).any(0).mean() > 0.5 and finite.all()
