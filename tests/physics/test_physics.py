"""The two physics backends: bits, independence of what was stepped before, and parity."""

import copy

import jax
import mujoco
import numpy as np
import pytest

from mjx_cl import physics
from mjx_cl.errors import UserError
from mjx_cl.physics.native import Native, float64_bits

SPEC = mujoco.mjtState.mjSTATE_INTEGRATION


def starts(num, seed=0):
  """Walkers of random posture just above the floor, and moving: qpos (num, 9), qvel (num, 9),
  float32.
  """
  rng = np.random.default_rng(seed)
  qpos = np.concatenate(
    [rng.uniform(-0.2, 0, (num, 1)), rng.normal(size=(num, 2)), rng.uniform(-0.3, 0, (num, 6))], 1
  )
  return qpos.astype(np.float32), rng.normal(size=(num, 9)).astype(np.float32)


def gears(model, num, seed=0):
  """A gear table of its own for every stream, (num, 6, 6)."""
  return (model.actuator_gear * np.random.default_rng(seed).uniform(0.3, 1.7, (num, 6, 1))).astype(
    np.float32
  )


# ---- bits ----------------------------------------------------------------------------------------


def test_float64_bits_are_exact():
  rng = np.random.default_rng(0)
  limits = np.finfo(np.float32)
  x = rng.normal(size=20_000) * 10.0 ** rng.uniform(-37, 37, 20_000)  # either sign and any size
  x = x[np.abs(x) >= limits.tiny]  # denormals have a test of their own
  x = np.concatenate(
    [x, [0.0, -0.0, 1.0, -1.0, limits.max, limits.min, limits.tiny, -limits.tiny, 1 + limits.eps]]
  ).astype(np.float32)
  got = np.asarray(jax.jit(float64_bits)(x))
  assert got.dtype == np.uint32
  np.testing.assert_array_equal(got, x.astype(np.float64).view(np.uint32))


def test_float64_bits_flush_denormals_to_zero():
  x = np.array([1e-40, -1e-40], np.float32)
  np.testing.assert_array_equal(np.asarray(float64_bits(x)).view(np.float64), [0.0, 0.0])


def test_native_equals_mujoco_bit_for_bit(walker):
  num, steps = 5, 100
  native = Native(walker, substeps=10)
  (qpos, qvel), gear = starts(num), gears(walker, num)
  ctrl = (
    np.random.default_rng(1).uniform(-1.5, 1.5, (steps, num, 6)).astype(np.float32)
  )  # beyond the range too: MuJoCo clips
  state, step = jax.vmap(native.init)(qpos, qvel), jax.jit(jax.vmap(native.step))
  models, datas, contacts = [], [], 0
  for i in range(num):
    models.append(walker.__copy__())
    models[i].actuator_gear[:] = gear[i]
    datas.append(mujoco.MjData(models[i]))
    datas[i].qpos[:], datas[i].qvel[:] = qpos[i], qvel[i]
  for c in ctrl:
    state, out = step({"actuator_gear": gear}, state, c)
    for i, (model, data) in enumerate(zip(models, datas)):
      data.ctrl[:] = c[i]
      mujoco.mj_step(model, data, 10)
      contacts += data.ncon
      row = np.empty(mujoco.mj_stateSize(model, SPEC))
      mujoco.mj_getState(model, data, row, SPEC)
      np.testing.assert_array_equal(np.asarray(state[i]).view(np.float64), row)
      np.testing.assert_array_equal(out["qpos"][i], data.qpos.astype(np.float32))
      np.testing.assert_array_equal(out["qvel"][i], data.qvel.astype(np.float32))
  assert contacts > 100  # the comparison has seen the contact solver at work


def test_derived_outputs_are_current(walker):
  native = Native(walker, substeps=10, outputs=("qpos", "xpos", "xmat"))
  qpos, qvel = starts(3)
  state = jax.vmap(native.init)(qpos, qvel)
  for _ in range(5):
    state, out = jax.vmap(native.step)({}, state, np.full((3, 6), 0.5, np.float32))
  for i in range(3):
    data = mujoco.MjData(walker)
    mujoco.mj_setState(walker, data, np.asarray(state[i]).view(np.float64), SPEC)
    mujoco.mj_forward(walker, data)
    np.testing.assert_array_equal(out["xpos"][i], data.xpos.astype(np.float32))
    np.testing.assert_array_equal(out["xmat"][i].ravel(), data.xmat.astype(np.float32).ravel())


# ---- nothing is remembered -----------------------------------------------------------------------


def test_native_does_not_depend_on_what_was_stepped_before(walker, same, monkeypatch, tmp_path):
  monkeypatch.chdir(tmp_path)  # MuJoCo logs what diverges to a file in the present folder
  num = 6
  native = Native(walker, substeps=10)
  step = jax.jit(jax.vmap(native.step))
  (qpos, qvel), ctrl = starts(num), np.full((num, 6), 0.7, np.float32)
  state = jax.vmap(native.init)(qpos, qvel)
  for _ in range(20):  # into contact, with a warm start in the row
    state, _ = step({"actuator_gear": gears(walker, num)}, state, ctrl)
  nominal = {"actuator_gear": np.tile(walker.actuator_gear.astype(np.float32), (num, 1, 1))}
  first = {
    "none": step({}, state, ctrl),
    "gear": step({"actuator_gear": gears(walker, num)}, state, ctrl),
  }
  other, lost = (
    jax.vmap(native.init)(*starts(num, 9)),
    jax.vmap(native.init)(qpos, qvel * np.float32(1e18)),
  )  # MuJoCo resets what diverges
  light = {"dof_damping": np.full((num, 9), 5, np.float32), "actuator_gear": gears(walker, num, 5)}
  for fields, row in (({}, other), (light, other), (nominal, lost), ({}, lost), (nominal, state)):
    step(fields, row, -ctrl)
    assert same(step({}, state, ctrl), first["none"])
    assert same(step({"actuator_gear": gears(walker, num)}, state, ctrl), first["gear"])
  assert not same(first["none"], first["gear"]) and not same(first["none"], step({}, other, ctrl))
  assert same(
    step(nominal, state, ctrl), first["none"]
  )  # writing the nominal field equals not writing it


def test_vmap_of_one_and_of_many_give_equal_bits(walker, same):
  num = 7
  native = Native(walker, substeps=10)
  state, gear = jax.vmap(native.init)(*starts(num)), gears(walker, num)
  ctrl = np.random.default_rng(3).uniform(-1, 1, (num, 6)).astype(np.float32)
  many = jax.vmap(native.step)({"actuator_gear": gear}, state, ctrl)
  nested = jax.vmap(jax.vmap(native.step))(
    *jax.tree.map(lambda x: x[None], ({"actuator_gear": gear}, state, ctrl))
  )
  assert same(jax.tree.map(lambda x: x[0], nested), many)
  for i in range(num):
    alone = native.step({"actuator_gear": gear[i]}, state[i], ctrl[i])
    assert same(alone, jax.tree.map(lambda x: x[i], many))


def test_robots_that_are_the_same_in_every_bit_are_stepped_once(walker, same, monkeypatch):
  native, sizes = Native(walker, substeps=10), []
  inner = native.host._step
  monkeypatch.setattr(
    native.host, "_step", lambda layout, rows: sizes.append(len(rows)) or inner(layout, rows)
  )
  place = np.array([0, 1, 0, 2, 1, 0])
  (qpos, qvel), gear = starts(3), gears(walker, 3)
  state, ctrl = jax.vmap(native.init)(qpos, qvel), np.full((3, 6), 0.7, np.float32)
  step = jax.jit(jax.vmap(native.step))
  fields = {"actuator_gear": gear}
  want = step(fields, state, ctrl)
  got = step({"actuator_gear": gear[place]}, state[place], ctrl[place])
  assert same(got, jax.tree.map(lambda x: x[place], want)) and sizes == [3, 3]
  gear[2] *= 2  # no state, but what acts on it
  gear = gear[place]
  gear[2] *= np.float32(1.5)
  step({"actuator_gear": gear}, state[place], ctrl[place])
  assert sizes[2:] == [4]


def test_a_field_without_batch_axis_is_shared_by_all(walker, same):
  native = Native(walker, substeps=10)
  state, gear, ctrl = (
    jax.vmap(native.init)(*starts(3)),
    gears(walker, 1)[0],
    np.full((3, 6), 0.5, np.float32),
  )
  shared = jax.vmap(native.step, (None, 0, 0))({"actuator_gear": gear}, state, ctrl)
  assert same(shared, jax.vmap(native.step)({"actuator_gear": np.stack([gear] * 3)}, state, ctrl))


# ---- parity native / MJX -------------------------------------------------------------------------
# Both start from the same float32 state; C MuJoCo then computes in float64, MJX in float32. They
# are compared by quantiles over many robots, since single ones part for two reasons that are no
# error of the model. A foot touches or leaves the floor one physics step earlier: there C MuJoCo is
# as far from itself when qpos moves by 3e-7. And MJX's solver, whose float32 rounds an improvement
# to less than the tolerance of 1e-8, ends an iteration early: the velocity is up to 1 rad/s off in
# that physics step and comes back in those that follow. A program that LLVM does not optimise does
# so in one of 4,096 control steps, to which the optimised one, or a tolerance of 1e-10, agrees to
# 1e-5. Wrong physics shows in all that meet it, see `test_wrong_physics_is_noticed`. Tolerances are
# about ten times what was measured on a CPU (jax 0.9.2, mujoco 3.14.0, AVX2 and AVX-512, either
# level of LLVM), the figures stand beside them.


def errors(a, b):
  """Largest error of each robot, sorted: (qpos [m, rad], qvel [m/s, rad/s])."""
  return tuple(
    np.sort(np.abs(np.asarray(a[k]) - np.asarray(b[k])).max(-1)) for k in ("qpos", "qvel")
  )


def run_both(pair, fields, qpos, qvel, ctrl):
  """Errors after every control step of both backends from the same states, with ctrl (T, ROBOTS,
  6).
  """
  states = {name: init(qpos, qvel) for name, (init, _) in pair.items()}
  found = []
  for c in ctrl:
    outs = {}
    for name, (_, step) in pair.items():
      states[name], outs[name] = step(fields, states[name], c)
    found.append(errors(outs["native"], outs["mjx"]))
  return found, outs["native"]


FAR = 0.05  # [rad/s], 250 times what 99 % of the steps stay below


@pytest.fixture(scope="module")
def singles(pair, fields, crowd):
  """4,096 single steps of MJX, ROBOTS at a time: states, commands and what they lead to."""
  init, step = pair["mjx"]
  rng, found = np.random.default_rng(6), []
  for qpos, qvel in zip(*crowd):
    for ctrl in rng.uniform(-1, 1, (4, len(qpos), 6)).astype(np.float32):
      found.append((qpos, qvel, ctrl, step(fields, init(qpos, qvel), ctrl)[1]))
  return found


def against(singles, native, fields):
  """Errors of C MuJoCo over `singles`: of qpos, of qvel, and whether qvel's is above FAR and above
  three times its own move where qpos moves by 3e-7; (4096,) each.
  """
  (init, step), signs, found = native, np.random.default_rng(0), []
  for qpos, qvel, ctrl, want in singles:
    out = step(fields, init(qpos, qvel), ctrl)[1]
    position, speed = (np.abs(out[k] - want[k]).max(-1) for k in ("qpos", "qvel"))
    own = np.zeros(len(qpos))
    for _ in range(16 if (speed > FAR).any() else 0):
      near = qpos + 3e-7 * signs.choice([-1, 1], qpos.shape).astype(np.float32)
      moved = step(fields, init(near, qvel), ctrl)[1]["qvel"]
      own = np.maximum(own, np.abs(out["qvel"] - moved).max(-1))
    found.append((position, speed, ~(speed < np.maximum(FAR, 3 * own))))  # nan counts
  return [np.concatenate(x) for x in zip(*found)]


def close(position, speed):
  """The usual step."""
  return (
    (np.median(position) < 2e-6 and np.quantile(position, 0.99) < 3e-5)  # 2.4e-7, 3.2e-6
    and (np.median(speed) < 1e-4 and np.quantile(speed, 0.99) < 2e-3)  # 9e-6, 2.4e-4
  )


def explained(far):
  """The unusual step: but for one in a thousand, where MJX's solver ends early (met: one in
  4,096 without LLVM's optimisation, none with it), C MuJoCo differs from itself as far.
  """
  return far.mean() < 1e-3


def test_parity_of_one_step_from_1000_states(walker, pair, fields, crowd, singles):
  contacts = 0
  for q in np.concatenate(crowd[0]):
    data = mujoco.MjData(walker)
    data.qpos[:] = q
    mujoco.mj_fwdPosition(walker, data)
    contacts += data.ncon > 0
  assert crowd[0].shape[0] * crowd[0].shape[1] >= 1000 and contacts > 500
  position, speed, _ = against(singles, pair["native"], fields)
  assert close(position, speed)


def test_parity_outliers_are_states_at_which_mujoco_differs_from_itself(pair, fields, singles):
  _, speed, far = against(singles, pair["native"], fields)
  assert explained(far)
  assert (speed > FAR).mean() < 5e-3  # met: 7e-4 at most


def heavier(model):
  model.body_mass[3] *= 1.01


def rougher(model):
  model.geom_friction[:, 0] *= 1.01


def without_a_stop(model):
  model.jnt_limited[5] = 0


def without_a_contact(model):
  model.geom_contype[-1] = model.geom_conaffinity[-1] = 0


def stronger(model):
  """Nothing: the gear is a field of the step."""


@pytest.mark.parametrize(
  "wrong", [stronger, heavier, rougher, without_a_stop, without_a_contact], ids=lambda f: f.__name__
)
def test_wrong_physics_is_noticed(walker, fields, singles, wrong):
  """By both of the criteria above: one motor's gear, one body's mass or the friction 1 % off, one
  joint without its stop, one foot without contact, on one side alone.
  """
  model = copy.copy(walker)
  wrong(model)
  mujoco.mj_setConst(model, mujoco.MjData(model))
  native = physics.make("native", model, substeps=10)
  gear = fields["actuator_gear"].at[:, 2].multiply(1.01 if wrong is stronger else 1.0)
  position, speed, far = against(
    singles[::4],
    (jax.jit(jax.vmap(native.init)), jax.jit(jax.vmap(native.step))),
    {"actuator_gear": gear},
  )
  assert not close(position, speed) and not explained(far)


def test_parity_of_ten_steps_from_50_states(pair, fields, crowd):
  qpos, qvel = crowd[0][2], crowd[1][2]
  qpos, qvel = (
    np.concatenate([x[:50]] * 6)[: len(x)] for x in (qpos, qvel)
  )  # 50 states, repeated to fill the program's batch
  ctrl = np.random.default_rng(5).uniform(-1, 1, (10, 50, 6)).astype(np.float32)
  found, _ = run_both(pair, fields, qpos, qvel, np.concatenate([ctrl] * 6, 1)[:, : len(qpos)])
  position, speed = found[-1]
  assert (
    np.median(position) < 4e-5 and np.quantile(position, 0.9) < 3e-4
  )  # measured: 3.2e-6, 2.6e-5 (largest 1.1e-4)
  assert (
    np.median(speed) < 6e-4 and np.quantile(speed, 0.9) < 5e-3
  )  # measured: 5.5e-5, 4.4e-4 (largest 1.1e-3)


def test_parity_of_100_steps_without_contact(walker, pair, fields):
  """A fall of 2.5 s (31 m) from 36 m with torques of a tenth of their range; joint stops are met,
  the floor is not.
  """
  num = len(fields["actuator_gear"])
  rng = np.random.default_rng(6)
  low, high = walker.jnt_range[3:].T
  legs = low + rng.uniform(0.3, 0.7, (num, 6)) * (high - low)
  qpos = np.concatenate(
    [np.full((num, 1), 36.0), np.zeros((num, 1)), rng.uniform(-1, 1, (num, 1)), legs], 1
  ).astype(np.float32)
  ctrl = rng.uniform(-0.1, 0.1, (100, num, 6)).astype(np.float32)
  found, out = run_both(pair, fields, qpos, np.zeros((num, 9), np.float32), ctrl)
  assert (
    out["qpos"][:, 0].min() > 0.5
  )  # torso centre still 1.8 m above the floor, more than a walker's reach of 1.5 m
  assert (
    np.abs(out["qpos"][:, 3:] - qpos[:, 3:]).max() > 1.0
  )  # and the legs have moved by more than a radian
  position, speed = found[-1]
  # measured with LLVM's optimisation 3.5e-5, 1.3e-4; 7.6e-5, 6.2e-4. Without it, where MJX's
  # solver may end early at joint stops, 4.6e-5, 9.8e-4; 1.2e-4, 2.6e-3
  assert np.median(position) < 3e-4 and np.quantile(position, 0.9) < 5e-3
  assert np.median(speed) < 7e-4 and np.quantile(speed, 0.9) < 2e-2
  init, step = pair["native"]
  state = init(qpos, np.zeros((num, 9), np.float32))
  strong = {"actuator_gear": fields["actuator_gear"].at[:, 2].multiply(1.01)}
  for c in ctrl:
    state, off = step(strong, state, c)
  assert np.median(np.abs(off["qpos"] - out["qpos"]).max(-1)) > 3e-3  # one gear 1 % off: 1e-2


# ---- choice --------------------------------------------------------------------------------------


def test_make_builds_every_name_and_refuses_others(walker):
  for name in ("native", "mjx"):
    assert physics.make(name, walker, substeps=2).name == name
  assert physics.make("auto", walker, substeps=2).name == (
    "native" if jax.default_backend() == "cpu" else "mjx"
  )
  with pytest.raises(UserError, match="'bullet'.*auto, native, mjx"):
    physics.make("bullet", walker, substeps=2)


def test_both_backends_read_the_fields_they_are_given(walker, pair, fields, crowd):
  """Half the gear: the same effect on both sides, far above the parity tolerance."""
  qpos, qvel = crowd[0][0], crowd[1][0]
  ctrl = np.full((len(qpos), 6), 0.8, np.float32)
  outs = {}
  for name, (init, step) in pair.items():
    gear, start = fields["actuator_gear"], init(qpos, qvel)
    whole, half = (step({"actuator_gear": g}, start, ctrl)[1]["qvel"] for g in (gear, gear / 2))
    outs[name] = np.asarray(whole - half)
  effect = np.abs(outs["native"]).max(-1)
  assert np.median(effect) > 0.5  # [rad/s]; measured: 5.4
  assert np.median(np.abs(outs["native"] - outs["mjx"]).max(-1)) < 1e-4  # measured: 1.0e-5


# ---- what faults need: fields, derived constants, forces, motor laws -----------------------------


def by_hand(model, fields, qpos, qvel, ctrl, steps, force=None, law=None, task=None):
  """Plain mujoco with `fields` written into a copy of the model and mj_setConst: (qpos, qvel),
  float32.
  """
  model = copy.deepcopy(model)
  for name, value in fields.items():
    (model.opt.gravity if name == "gravity" else getattr(model, name))[...] = value
  data = mujoco.MjData(model)
  mujoco.mj_setConst(model, data)
  mujoco.mj_resetData(model, data)
  data.qpos[:], data.qvel[:] = qpos, qvel
  if force is not None:
    data.qfrc_applied[:] = force
  for _ in range(steps):
    data.ctrl[:] = ctrl if law is None else law(np, task, ctrl, data.qpos, data.qvel)
    mujoco.mj_step(model, data)
  return data.qpos.astype(np.float32), data.qvel.astype(np.float32)


def changed_fields(model, num, seed=0):
  """Masses, damping, friction, ranges and gravity of each robot; the first robot's are nominal.
  name -> (num, ...) float32.
  """
  rng = np.random.default_rng(seed)
  out = {}
  for name in (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "dof_damping",
    "dof_frictionloss",
    "geom_friction",
    "jnt_range",
    "gravity",
  ):
    nominal = np.asarray(model.opt.gravity if name == "gravity" else getattr(model, name))
    grown = nominal * rng.uniform(0.8, 1.6, (num,) + nominal.shape) + (
      rng.uniform(0, 3, (num,) + nominal.shape) if name == "dof_frictionloss" else 0
    )
    out[name] = np.where(
      np.arange(num).reshape((-1,) + (1,) * nominal.ndim) == 0, nominal, grown
    ).astype(np.float32)
  return out


def test_native_with_changed_fields_equals_mujoco_bit_for_bit(walker):
  """Derived constants of masses included, and whatever masses the batch held before; robot 0's
  nominal values are float64 ones that float32 rounds.
  """
  num = 6
  native = physics.make("native", walker, substeps=4)
  step = jax.jit(jax.vmap(native.step))
  qpos, qvel = starts(num)
  ctrl = np.random.default_rng(3).uniform(-1, 1, (num, 6)).astype(np.float32)
  force = np.random.default_rng(4).normal(0, 20, (num, 9)).astype(np.float32)
  state = jax.vmap(native.init)(qpos, qvel)
  for seed in (0, 1, 0):  # back to the first masses
    fields = changed_fields(walker, num, seed)
    _, out = step(fields, state, ctrl, None, force)
    for i in range(num):
      mine = {
        k: (
          np.asarray(walker.opt.gravity if k == "gravity" else getattr(walker, k))
          if i == 0
          else v[i]
        )
        for k, v in fields.items()
      }
      want = by_hand(walker, mine, qpos[i], qvel[i], ctrl[i], 4, force[i])
      np.testing.assert_array_equal(out["qpos"][i], want[0])
      np.testing.assert_array_equal(out["qvel"][i], want[1])


def test_nominal_fields_change_nothing(walker):
  native = physics.make("native", walker, substeps=4)
  qpos, qvel = starts(5)
  state, ctrl = jax.vmap(native.init)(qpos, qvel), np.full((5, 6), 0.3, np.float32)
  names = [n for n in changed_fields(walker, 1)]
  nominal = {
    k: jax.numpy.tile(v, (5,) + (1,) * v.ndim) for k, v in physics.leaves(walker, *names).items()
  }
  rows, _ = jax.jit(jax.vmap(native.step))(nominal, state, ctrl)
  plain, _ = jax.jit(jax.vmap(native.step))({}, state, ctrl)
  np.testing.assert_array_equal(rows, plain)


def spring(xp, task, ctrl, qpos, qvel):
  """A motor law with state and a parameter: PD towards ctrl, clipped."""
  return xp.clip(task["gain"] * (ctrl - qpos[..., 3:]) - 0.1 * qvel[..., 3:], -1.0, 1.0)


def test_motor_law_is_evaluated_at_every_physics_step(walker):
  num = 4
  native = physics.make("native", walker, substeps=5, law=spring)
  qpos, qvel = starts(num)
  ctrl = np.random.default_rng(0).uniform(-0.5, 0.5, (num, 6)).astype(np.float32)
  task = {"gain": np.linspace(0.5, 4, num * 6).reshape(num, 6).astype(np.float32)}
  _, out = jax.jit(jax.vmap(native.step))({}, jax.vmap(native.init)(qpos, qvel), ctrl, task)
  for i in range(num):
    want = by_hand(
      walker, {}, qpos[i], qvel[i], ctrl[i], 5, law=spring, task={"gain": task["gain"][i]}
    )
    np.testing.assert_array_equal(out["qpos"][i], want[0])
    before = by_hand(
      walker, {}, qpos[i], qvel[i], ctrl[i], 4, law=spring, task={"gain": task["gain"][i]}
    )
    np.testing.assert_array_equal(out["qvel_before"][i], before[1])
    np.testing.assert_allclose(
      out["ctrl"][i], spring(np, {"gain": task["gain"][i]}, ctrl[i], *before), atol=1e-6
    )  # from float32 states


def test_mjx_derives_the_constants_that_mujoco_does(walker):
  """Tolerance: float32 sums and a 9 x 9 inverse; the largest seen is 4e-6."""
  mjx = physics.make("mjx", walker, substeps=1)
  derive = jax.jit(lambda fields: mjx.derived(mjx._model.replace(**fields)))
  fields = {
    k: v
    for k, v in changed_fields(walker, 4).items()
    if k in ("body_mass", "body_inertia", "body_ipos")
  }
  for i in range(4):
    mine = {k: v[i] for k, v in fields.items()}
    model = copy.deepcopy(walker)
    for name, value in mine.items():
      getattr(model, name)[...] = value
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for name, got in derive(mine).items():
      want = getattr(model, name)
      np.testing.assert_allclose(got, want, rtol=5e-5, atol=1e-6 * np.abs(want).max(), err_msg=name)


def test_mjx_derives_the_weight_of_a_tendon():
  """Of a fixed and a spatial one, as mj_setConst does; float32."""
  model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><site name="a" pos="0 0 1"/><body>
    <joint name="j" type="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".03"
    mass="1"/><body pos=".4 0 0"><joint name="k" type="hinge" axis="0 1 0"/><geom type="capsule"
    fromto="0 0 0 .4 0 0" size=".03" mass="1"/><site name="b" pos=".3 0 0"/></body></body>
    </worldbody><tendon><fixed limited="true" range="-1 1"><joint joint="j" coef="1"/><joint
    joint="k"
    coef="-.5"/></fixed><spatial limited="true" range="0 2"><site site="a"/><site site="b"/>
    </spatial></tendon></mujoco>""")
  mjx = physics.make("mjx", model, substeps=1)
  before = model.tendon_invweight0.copy()
  own = {"body_mass": 3 * model.body_mass, "body_inertia": 3 * model.body_inertia}
  got = mjx.model({k: v.astype(np.float32) for k, v in own.items()}).tendon_invweight0
  for name, value in own.items():
    getattr(model, name)[...] = value
  mujoco.mj_setConst(model, mujoco.MjData(model))
  np.testing.assert_allclose(got, model.tendon_invweight0, rtol=5e-5)
  assert (model.tendon_invweight0 < 0.4 * before).all()


def test_mjx_refuses_a_field_without_effect(walker):
  with pytest.raises(UserError, match="dof_frictionloss.*choose physics native"):
    physics.make("mjx", walker, substeps=1).model({"dof_frictionloss": np.ones(9, np.float32)})
