"""Contract suite over every fault of the table, on the walker, and the figures of single faults."""

import copy
import re
import types

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl import envs, faults
from mjx_cl.errors import PluginError, UserError
from mjx_cl.faults import FAULTS, schedule
from mjx_cl.rollout.scan import Rollout, start

LENGTH = 32  # decisions; with episodes of 12 steps the robots are reset at 12 and at 24
SEVERITY = np.array([0.0, 0.5, 1.0, 0.8, 0.3], np.float32)
ONSET = np.array([0, 6, 3, 10, 1])
DURATION = np.array(
  [schedule.FOREVER, schedule.FOREVER, 4, 8, schedule.FOREVER]
)  # the fourth spans a reset


class Runs:
  """Five streams of equal key under a fault, each with its own severity, onset, duration and
  target, and five nominal ones: one program.
  """

  def __init__(self, name, env, agent, params):
    self.fault, none = faults.make(name, env), faults.make("none", env)
    self.roll, nominal = Rollout(env, agent, self.fault), Rollout(env, agent, none)

    def both(params, streams, plain):
      return self.roll._chunk(params, streams, LENGTH), nominal._chunk(params, plain, LENGTH)

    self.program = jax.jit(chex.assert_max_traces(both, n=1))
    self.env, self.agent, self.none, self.params = env, agent, none, params
    self.targets = np.array([0, 0, len(self.fault.targets) - 1, len(self.fault.targets) // 2, -1])
    (self.end, self.rows), (self.end_nominal, self.rows_nominal) = self.run(
      3, SEVERITY, ONSET, DURATION, self.targets
    )

  def run(self, seed, severity, onset, duration, targets):
    def streams(fault):
      one = lambda *x: start(
        self.env, self.agent, fault, jax.random.key(seed), x[0], x[1], x[2], x[3]
      )
      return jax.vmap(jax.vmap(one))(
        *(jnp.asarray(x)[None] for x in (severity, onset, duration, targets))
      )

    return self.program(self.params, streams(self.fault), streams(self.none))

  def lane(self, i, rows=None):
    """Rows of stream i, (LENGTH, ...)."""
    return jax.tree.map(lambda x: np.asarray(x[:, 0, i]), self.rows if rows is None else rows)


PLUGGED = set(FAULTS) - set(FAULTS.own)
ON_WALKER = sorted(
  set(FAULTS.own) - {"velocity_limit", "lidar_loss", "gap"}
)  # these three have nothing to act on there
if PLUGGED:  # faults of other packages, as far as a walker can have them
  ON_WALKER += sorted(PLUGGED & set(faults.available(envs.make("walker", "native"))))


@pytest.fixture(
  scope="module", params=["none", "gear", "freeze"]
)  # a model leaf; a sensor with memory
def runs(request, short_walker, tiny, tiny_params):
  chex.clear_trace_counter()
  return Runs(request.param, short_walker, tiny, jax.tree.map(lambda x: x[:1], tiny_params))


@pytest.fixture(params=ON_WALKER)
def fault(request, short_walker):
  return faults.make(request.param, short_walker)


def ports_of(env, obs=True, first=False, seed=0):
  """Ports filled with values that any change would show on: of the driven robot, or of its sensors."""
  rng = np.random.default_rng(seed)
  ctrl, seen = (jnp.asarray(rng.uniform(0.1, 0.8, n), jnp.float32) for n in (6, 24))
  return faults.Ports(
    env.model,
    ctrl=None if obs else ctrl,
    obs=seen if obs else None,
    first=jnp.bool_(first),
    since=jnp.int32(0),
  )


def leaves(ports):
  """Name such as `mj.actuator_gear`, `task.x`, `ctrl` -> array."""
  flat = {f"mj.{k}": v for k, v in ports.model.mj.items()} | {
    f"task.{k}": v for k, v in ports.model.task.items()
  }
  flat |= {"force": ports.model.force} | (
    {"ctrl": ports.ctrl} if ports.obs is None else {"obs": ports.obs}
  )
  return {k: np.asarray(v) for k, v in flat.items()}


def changed(before, after):
  """Names of the leaves whose bits differ."""
  before, after = leaves(before), leaves(after)
  assert before.keys() == after.keys()
  for k in before:
    assert before[k].shape == after[k].shape and before[k].dtype == after[k].dtype, k
  return {k for k in before if before[k].tobytes() != after[k].tobytes()}


def live(fault, fstate, env, severity, steps=12):
  """Names of the leaves that change within `steps` control steps, and the bytes of everything: what
  the fault does to a robot.
  """
  names, seen = set(), []
  for t in range(steps):
    before = ports_of(env, fault.senses, t == 0, seed=t)._replace(since=jnp.int32(t))
    fstate, after = fault.apply(fstate, jnp.float32(severity), jax.random.key(t), before)
    names |= changed(before, after)
    seen += [v.tobytes() for v in leaves(after).values()]
  return names, b"".join(seen), fstate


# ---- contract: whole rollouts --------------------------------------------------------------------


def test_severity_zero_equals_nominal_bit_for_bit(runs, same):
  assert same(runs.lane(0), runs.lane(0, runs.rows_nominal))
  physics, nominal = runs.end.env.physics[0, 0], runs.end_nominal.env.physics[0, 0]
  np.testing.assert_array_equal(physics, nominal)


def test_before_onset_nothing_changes(runs, same):
  for i in range(1, 5):
    # the outcome of a step is read in the next one: a sensor that fails at the onset already shows
    # in the outcome of the step before
    cut = lambda rows: jax.tree.map(lambda x: x[: ONSET[i] - runs.fault.senses], rows)
    assert same(cut(runs.lane(i)), cut(runs.lane(i, runs.rows_nominal)))


def test_after_onset_the_robot_is_another(runs):
  for i in range(1, 5):
    here, nominal = runs.lane(i), runs.lane(i, runs.rows_nominal)
    differs = (here.final_obs != nominal.final_obs).any(-1) | (here.obs != nominal.obs).any(-1)
    assert differs[ONSET[i] :].any() == (runs.fault.name != "none")


def test_severity_follows_the_clock_across_resets(runs):
  t = np.arange(LENGTH)
  for i in range(5):
    active = (t >= ONSET[i]) & (t < ONSET[i] + DURATION[i])
    np.testing.assert_array_equal(
      runs.lane(i).severity, np.where(active & bool(runs.fault.owns), SEVERITY[i], np.float32(0))
    )  # `none` has no severity
  np.testing.assert_array_equal(
    runs.lane(3).episode, t // 12
  )  # there were resets while the fault was active
  np.testing.assert_array_equal(runs.end.t, LENGTH)
  np.testing.assert_array_equal(runs.end.injection.plan.onset[0, :, 0], ONSET)
  np.testing.assert_array_equal(runs.end.injection.plan.duration[0, :, 0], DURATION)


def test_one_trace_for_all_seeds_severities_onsets_and_targets(runs):
  severity, onset = np.array([0.1, 0.9, 0.0, 1.0, 0.6], np.float32), np.array([9, 0, 2, 30, 1])
  targets = (np.arange(5) + 1) % len(runs.fault.targets)
  (_, rows), _ = runs.run(11, severity, onset, DURATION[::-1], targets)  # a second trace raises
  np.testing.assert_array_equal(
    rows.severity[-1, 0], severity * [1, 0, 0, 1, 1] * bool(runs.fault.owns)
  )  # the second and third are repaired by then


def test_each_stream_of_a_batch_has_its_own_target(runs, same):
  targets = np.array([0, 1, 2, 3, 0]) % len(runs.fault.targets)
  (end, _), _ = runs.run(
    5, np.ones(5, np.float32), np.full(5, 26), DURATION[[0] * 5], targets
  )  # equal in all else, since the last reset
  for i in range(5):
    for j in range(i):
      equal = same(*(jax.tree.map(lambda x: x[0, k], (end.env, end.obs)) for k in (i, j)))
      assert equal == (targets[i] == targets[j])


# ---- contract: ports -----------------------------------------------------------------------------


def test_registered_name_is_the_faults_own(short_walker):
  assert all(faults.make(name, short_walker).name == name for name in ON_WALKER)


@pytest.mark.parametrize("severity", [0.0, 0.5, 1.0])
def test_only_owned_leaves_change(fault, short_walker, severity):
  for target in {0, len(fault.targets) - 1}:
    begin = fault.init(jax.random.key(0), target)
    names, _, end = live(fault, begin, short_walker, severity)
    assert names == (set(fault.owns) if severity else set())
    assert jax.tree.map(lambda x: (x.shape, x.dtype), end) == jax.tree.map(
      lambda x: (x.shape, x.dtype), begin
    )


@pytest.mark.parametrize(
  "name",
  sorted(
    set(ON_WALKER)
    - {"none", "command_dropout", "dropout", "freeze", "dropout_burst", "freeze_burst"}
  ),
)  # these lose a thousandth of the steps
def test_the_least_severity_acts(name, short_walker):
  fault = faults.make(name, short_walker)
  assert live(fault, fault.init(jax.random.key(0), 0), short_walker, 1e-3)[0] == set(fault.owns)


@pytest.mark.parametrize("leaf", ["task.mass", "mj.body_mass", "force", "ctrl"])
def test_a_fault_that_writes_what_it_does_not_own_is_refused(short_walker, leaf):
  """A Fault that was put together by hand, not by `faults.fault`: it ends where it is traced, in a
  rollout as in a certificate.
  """

  def apply(state, severity, key, ports):
    value = jnp.where(severity > 0, -ports.ctrl, ports.ctrl)
    ports = faults.base.write(ports, "ctrl", value)
    return state, faults.base.write(ports, leaf, 2.0 * faults.base.read(ports, leaf))

  owns = ("ctrl",) if leaf != "ctrl" else ()
  env = short_walker
  if leaf not in leaves(ports_of(env, False)):
    leaf = next(k for k in leaves(ports_of(env, False)) if k.startswith(leaf[:2]))
  rogue = faults.Fault(
    "rogue",
    owns,
    ("all",),
    1,
    lambda key, target=-1: faults.State(jnp.int32(0), (), ()),
    apply,
    False,
  )
  plan = faults.plan(0.5)
  drive = lambda t: faults.drive(
    rogue, faults.begin(rogue, jax.random.key(0), plan), t, jax.random.key(1), ports_of(env, False)
  )
  with pytest.raises(
    UserError,
    match=(
      f"^fault 'rogue' writes {leaf}, which it does not own; it owns "
      f"{owns[0] if owns else 'nothing'}(\n|$)"  # JAX adds a note to what it traces
    ),
  ):
    jax.eval_shape(drive, jnp.int32(0))


def test_owned_names_are_leaves(fault, short_walker):
  assert set(fault.owns) <= leaves(ports_of(short_walker, fault.senses)).keys()
  assert (fault.name == "none") == (not fault.owns)
  assert fault.senses == (fault.owns == ("obs",))


def test_drawn_targets_cover_all_that_may_be_drawn_and_given_ones_are_honoured(fault, short_walker):
  init = jax.jit(fault.init)
  assert [
    int(init(jax.random.key(k), i).target) for i in range(len(fault.targets)) for k in (0, 1)
  ] == [i for i in range(len(fault.targets)) for _ in (0, 1)]
  drawn = np.asarray(
    jax.vmap(fault.init)(jax.random.split(jax.random.key(0), 64)).target
  )  # all of 6 joints are missed by one in 20,000 such draws
  assert set(drawn.tolist()) == set(range(fault.drawn)) and 1 <= fault.drawn <= len(fault.targets)


def test_target_names(fault):
  for i, name in enumerate(fault.targets):
    assert faults.target_index(fault, name) == i
  assert faults.target_index(fault, None) == faults.target_index(fault, "random") == -1
  with pytest.raises(
    UserError, match=f"'tail'.*{fault.name}.*random, {', '.join(fault.targets[:3])}"
  ):
    faults.target_index(fault, "tail")


def test_unknown_fault_names_the_choices(short_walker):
  with pytest.raises(UserError, match="'rust'.*" + ", ".join(sorted(FAULTS)[:3])):
    faults.make("rust", short_walker)


def test_a_fault_without_anything_to_act_on_is_refused(short_walker):
  with pytest.raises(UserError, match="'velocity_limit' acts on task.velocity_limit.*'walker'"):
    faults.make("velocity_limit", short_walker)
  assert set(faults.available(short_walker)) == set(ON_WALKER)


@pytest.mark.parametrize(
  "gave, said",
  [
    (None, "gives NoneType in place of"),
    ((1, 2, 3), "gives tuple in place of"),
    (((), "ctrl"), "gives tuple in place of"),
    (((), {"ctrl": None}), "gives NoneType for ctrl"),
    (((), {"ctrl": "text"}), "gives str for ctrl"),
    (
      ((), {"ctrl": np.zeros(3)}),
      r"gives ndarray of shape \(3,\) for ctrl, which has shape \(6,\)",
    ),
  ],
)
def test_a_map_that_answers_wrongly_is_one_line(short_walker, gave, said):
  bad = faults.fault("bad", short_walker, ("ctrl",), ("all",), lambda *_: gave)
  ports = faults.Ports(short_walker.model, jnp.zeros(6), None, jnp.bool_(True), jnp.int32(0))
  with pytest.raises(PluginError, match=f"'bad' {said}"):
    bad.apply(bad.init(jax.random.key(0)), jnp.float32(1), jax.random.key(0), ports)


def test_what_a_map_returns_beside_its_own_leaves_is_refused(short_walker):
  """Whatever a third party's fault returns, leaves it does not own cannot be reached."""
  bad = faults.fault(
    "bad",
    short_walker,
    ("ctrl",),
    ("all",),
    lambda target, m, s, key, ports: (m, {"mj.body_mass": ports.model.mj["body_mass"] * 2}),
  )
  with pytest.raises(PluginError, match="owns ctrl but gave mj.body_mass"):
    bad.apply(
      bad.init(jax.random.key(0)),
      jnp.float32(1),
      jax.random.key(0),
      ports_of(short_walker, obs=False),
    )
  with pytest.raises(ValueError, match="sensors are read at another moment"):
    faults.fault("two", short_walker, ("ctrl", "obs"), ("all",), lambda *_: None)


def test_every_documented_fault_states_severity_target_and_leaves(short_walker):
  """Severity with its unit in brackets, target, leaves and source in the docstring; `about` repeats
  the first three, and the leaves are the true ones.
  """
  for name in sorted(set(FAULTS.own) - {"none"}):
    said = dict(
      re.findall(r"; (severity|target|owns): (.*?)(?=; (?:target|owns): |$)", faults.about(name))
    )
    assert set(said) == {"severity", "target", "owns"}, name
    assert re.search(r"\[[^]]+\]", said["severity"]) and re.search(
      r"Source: \w", FAULTS[name].__doc__
    ), name
    if name in ON_WALKER:
      assert all(leaf in said["owns"] for leaf in faults.make(name, short_walker).owns), name


def test_stuck_holds_the_last_command_before_the_onset(short_walker):
  stuck = faults.make("stuck", short_walker)
  injection = faults.begin(
    stuck, jax.random.key(0), faults.plan(1.0, 3), faults.target_index(stuck, "right_knee")
  )
  sent = []
  for t in range(6):
    ports = ports_of(short_walker, obs=False, first=t == 0)._replace(ctrl=jnp.full(6, t / 10))
    injection, ports, _ = faults.drive(stuck, injection, jnp.int32(t), jax.random.key(t), ports)
    sent.append((round(float(ports.ctrl[1]), 2), round(float(ports.ctrl[0]), 2)))
  assert sent == [(0.0, 0.0), (0.1, 0.1), (0.2, 0.2), (0.2, 0.3), (0.2, 0.4), (0.2, 0.5)]


# ---- several faults ------------------------------------------------------------------------------


def test_faults_compose_in_order_and_follow_their_own_clocks(short_walker):
  """Two faults of one leaf: both act where both are active, each alone elsewhere; 0.5 then 0.2 of
  the gear leave 0.4 of it.
  """
  two = (faults.make("gear", short_walker), faults.make("torque_loss", short_walker))
  injection = faults.begin(
    two,
    jax.random.key(0),
    faults.plan(jnp.asarray([0.5, 0.2]), jnp.asarray([2, 4]), jnp.asarray([4, 100])),
    jnp.asarray([0, 0]),
  )
  got = []
  for t in range(8):
    injection, ports, severity = faults.drive(
      two, injection, jnp.int32(t), jax.random.key(t), ports_of(short_walker, obs=False)
    )
    got.append(
      (
        round(float(ports.model.mj["actuator_gear"][0, 0]), 3),
        [round(float(x), 2) for x in severity],
      )
    )
  alone, both, other = (50.0, [0.5, 0.0]), (40.0, [0.5, 0.2]), (80.0, [0.0, 0.2])
  assert got == [(100.0, [0.0, 0.0])] * 2 + [alone] * 2 + [both] * 2 + [other] * 2


def test_the_first_fault_of_several_draws_the_target_that_it_draws_alone(short_walker):
  gear, slope = faults.make("gear", short_walker), faults.make("slope", short_walker)
  for k in range(8):
    alone = faults.begin(gear, jax.random.key(k), faults.plan())
    assert int(alone.target[0]) == int(
      faults.begin((gear, slope), jax.random.key(k), faults.plan()).target[0]
    )


# ---- schedule ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
  "onset, duration",
  [(0, 1), (0, schedule.FOREVER), (7, 5), (7, 0), (schedule.FOREVER, schedule.FOREVER)],
)
def test_abrupt_schedule(onset, duration):
  t = np.array([0, 1, 6, 7, 8, 11, 12, 2**31 - 2])
  got = jax.vmap(schedule.abrupt, (0, None, None))(
    jnp.asarray(t, jnp.int32), jnp.int32(onset), jnp.int32(duration)
  )
  np.testing.assert_array_equal(
    got, [float(onset <= x < onset + duration) for x in t.tolist()]
  )  # Python's integers do not overflow


def follow(kind, onset=10, duration=schedule.FOREVER, period=8, share=0.5, steps=60, seed=0):
  """Severity factor of a schedule over time, (steps,)."""
  plan, walk, out = faults.plan(1.0, onset, duration, kind, period, share), jnp.float32(0), []
  for t in range(steps):
    walk = schedule.walk(plan, walk, jnp.int32(t), jax.random.fold_in(jax.random.key(seed), t))
    out.append(float(schedule.severity(plan, walk, jnp.int32(t))))
  return np.asarray(out)


def test_schedules_against_loops():
  since = np.arange(60) - 10
  after = since >= 0
  np.testing.assert_allclose(
    follow("ramp"), np.where(after, np.minimum(1, (since + 1) / 8), 0), atol=1e-6
  )  # float32
  np.testing.assert_allclose(
    follow("intermittent", share=0.25), np.where(after & (since % 8 < 2), 1.0, 0), atol=1e-6
  )
  for share, on in ((0.3, 30), (0.6, 60), (0.54, 54), (1.0, 100)):  # 0.3f x 100 is above 30
    acts = follow("intermittent", onset=0, period=100, share=share, steps=100)
    assert acts.tolist() == [1.0] * on + [0.0] * (100 - on)
  np.testing.assert_allclose(
    follow("cyclic"),
    np.where(after, 0.5 - 0.5 * np.cos(2 * np.pi * (since % 8 + 1) / 8), 0),
    atol=1e-6,
  )
  for kind in faults.SCHEDULES:
    got = follow(kind, duration=20)
    assert (
      (got[:10] == 0).all()
      and (got[30:] == 0).all()
      and got[10:30].any()
      and got.min() >= 0
      and got.max() <= 1
    ), kind


def test_random_walk_moves_once_a_period_and_stays_in_bounds():
  got = follow("random_walk", share=0.4, steps=400)
  change = np.flatnonzero(np.diff(got)) + 1
  assert set(change) <= set(range(10, 400, 8)) and len(change) > 40
  assert 0 <= got.min() < 0.2 and 0.8 < got.max() <= 1
  steps = np.abs(np.diff(got[10::8]))
  assert 0.15 < np.median(steps) < 0.4  # median of |N(0, 0.4)| is 0.27; reflections shorten some
  np.testing.assert_array_equal(got, follow("random_walk", share=0.4, steps=400))
  assert (got != follow("random_walk", share=0.4, steps=400, seed=1)).any()


def test_unknown_schedule_names_the_choices():
  with pytest.raises(
    UserError, match="'sometimes'.*abrupt, ramp, intermittent, cyclic, random_walk"
  ):
    faults.plan(schedule="sometimes")


# ---- single faults -------------------------------------------------------------------------------


def gears(short_walker, target, severity):
  fault = faults.make("gear", short_walker)
  fstate = fault.init(jax.random.key(0), faults.target_index(fault, target))
  return np.asarray(
    fault.apply(
      fstate, jnp.float32(severity), jax.random.key(0), ports_of(short_walker, obs=False)
    )[1].model.mj["actuator_gear"]
  )


@pytest.mark.parametrize(
  "target, index, want",
  [("right_hip", 0, 50), ("right_knee", 1, 25), ("right_ankle", 2, 10), ("left_hip", 3, 50)],
)
def test_gear_is_halved_exactly_as_in_the_paper(short_walker, target, index, want):
  nominal = np.array([100, 50, 20, 100, 50, 20], np.float32)
  nominal[index] = want
  got = gears(short_walker, target, 0.5)
  np.testing.assert_array_equal(got[:, 0], nominal)
  np.testing.assert_array_equal(got[:, 1:], 0)


def test_gear_at_severity_one_gives_no_torque(short_walker):
  np.testing.assert_array_equal(
    gears(short_walker, "left_knee", 1.0)[:, 0], [100, 50, 20, 100, 0, 20]
  )


def _floor(model):
  model.geom_priority[model.geom("floor").id] = model.geom_priority.max() + 1


def _unlimited(model):
  model.jnt_limited[model.joint("left_knee").id] = 0


def _no_range(model):
  model.actuator_ctrlrange[2] = 0.0


@pytest.mark.parametrize(
  "name, spoil, words",
  [
    ("friction", _floor, "the floor masks the friction of .*; give these geoms a higher priority"),
    ("range_loss", _unlimited, "needs joints with limits; .*left_knee"),
    ("joint_friction", _no_range, "needs motors with a greatest torque"),
  ],
)
def test_what_would_silently_do_nothing_is_refused(short_walker, name, spoil, words):
  """A model on which MuJoCo would not let the fault act."""
  env = copy.copy(short_walker)
  env.mj_model = copy.copy(short_walker.mj_model)
  faults.make(name, env)
  spoil(env.mj_model)
  with pytest.raises(UserError, match=words):
    faults.make(name, env)


def test_joint_friction_needs_a_model_with_some_on_mjx(short_walker):
  env = copy.copy(short_walker)
  env.physics = types.SimpleNamespace(name="mjx")
  with pytest.raises(UserError, match="MJX builds no friction constraint"):
    faults.make("joint_friction", env)
