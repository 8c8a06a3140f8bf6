"""Contract suite over every fault of the table, on the walker, and the figures of single faults."""
import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl import faults
from mjx_cl.errors import UserError
from mjx_cl.faults import FAULTS, schedule
from mjx_cl.rollout import Rollout, start

LENGTH = 32  # decisions; with episodes of 12 steps the robots are reset at 12 and at 24
SEVERITY = np.array([0.0, 0.5, 1.0, 0.8, 0.3], np.float32)
ONSET = np.array([0, 6, 3, 10, 1])
DURATION = np.array([schedule.FOREVER, schedule.FOREVER, 4, 8, schedule.FOREVER])  # the fourth spans a reset


class Runs:
  """Five streams of equal key under a fault, each with its own severity, onset, duration and target, and five nominal ones: one program."""

  def __init__(self, name, env, agent, params):
    self.fault, none = faults.make(name, env.spec), faults.make("none", env.spec)
    self.roll, nominal = Rollout(env, agent, self.fault), Rollout(env, agent, none)

    def both(params, streams, plain):
      return self.roll._chunk(params, streams, LENGTH), nominal._chunk(params, plain, LENGTH)
    self.program = jax.jit(chex.assert_max_traces(both, n=1))
    self.env, self.agent, self.none, self.params = env, agent, none, params
    self.targets = np.array([0, 0, len(self.fault.targets) - 1, len(self.fault.targets) // 2, -1])
    (self.end, self.rows), (self.end_nominal, self.rows_nominal) = self.run(3, SEVERITY, ONSET, DURATION, self.targets)

  def run(self, seed, severity, onset, duration, targets):
    def streams(fault):
      one = lambda *x: start(self.env, self.agent, fault, jax.random.key(seed), x[0], x[1], x[2], x[3])
      return jax.vmap(jax.vmap(one))(*(jnp.asarray(x)[None] for x in (severity, onset, duration, targets)))
    return self.program(self.params, streams(self.fault), streams(self.none))

  def lane(self, i, rows=None):
    """Rows of stream i, (LENGTH, ...)."""
    return jax.tree.map(lambda x: np.asarray(x[:, 0, i]), self.rows if rows is None else rows)


@pytest.fixture(scope="module", params=sorted(FAULTS))
def runs(request, short_walker, tiny, tiny_params):
  chex.clear_trace_counter()
  return Runs(request.param, short_walker, tiny, jax.tree.map(lambda x: x[:1], tiny_params))


@pytest.fixture(params=sorted(FAULTS))
def fault(request, short_walker):
  return faults.make(request.param, short_walker.spec)


def ports_of(env):
  """All ports filled, with values that any change would show on."""
  return faults.Ports(env.model, ctrl=jnp.linspace(-0.9, 0.8, 6), force=jnp.linspace(-2, 3, 9), obs=jnp.linspace(-1, 4, 24))


def leaves(ports):
  """Name such as `mj.actuator_gear`, `task.x`, `ctrl` -> array."""
  flat = {f"mj.{k}": v for k, v in ports.model.mj.items()} | {f"task.{k}": v for k, v in ports.model.task.items()}
  flat |= {"ctrl": ports.ctrl, "force": ports.force, "obs": ports.obs}
  return {k: np.asarray(v) for k, v in flat.items()}


def changed(before, after):
  """Names of the leaves whose bits differ."""
  before, after = leaves(before), leaves(after)
  assert before.keys() == after.keys()
  for k in before:
    assert before[k].shape == after[k].shape and before[k].dtype == after[k].dtype, k
  return {k for k in before if before[k].tobytes() != after[k].tobytes()}


def fingerprint(fault, fstate, env):
  """What the fault does at severity 1, as bytes."""
  return b"".join(v.tobytes() for v in leaves(fault.apply(fstate, jnp.float32(1), jax.random.key(0), ports_of(env))[1]).values())


# ---- contract: whole rollouts --------------------------------------------------------------------------------------------------------

def test_severity_zero_equals_nominal_bit_for_bit(runs, same):
  assert same(runs.lane(0), runs.lane(0, runs.rows_nominal))
  physics, nominal = runs.end.env.physics[0, 0], runs.end_nominal.env.physics[0, 0]
  np.testing.assert_array_equal(physics, nominal)


def test_before_onset_nothing_changes(runs, same):
  for i in range(1, 5):
    cut = lambda rows: jax.tree.map(lambda x: x[:ONSET[i]], rows)
    assert same(cut(runs.lane(i)), cut(runs.lane(i, runs.rows_nominal)))


def test_after_onset_the_robot_is_another(runs):
  for i in range(1, 5):
    here, nominal = runs.lane(i), runs.lane(i, runs.rows_nominal)
    differs = (here.final_obs != nominal.final_obs).any(-1) | (here.obs != nominal.obs).any(-1)
    assert differs[ONSET[i]:].any() == (runs.fault.name != "none")


def test_severity_follows_the_clock_across_resets(runs):
  t = np.arange(LENGTH)
  for i in range(5):
    active = (t >= ONSET[i]) & (t < ONSET[i] + DURATION[i])
    np.testing.assert_array_equal(runs.lane(i).severity, np.where(active, SEVERITY[i], np.float32(0)))
  np.testing.assert_array_equal(runs.lane(3).episode, t // 12)  # there were resets while the fault was active
  np.testing.assert_array_equal(runs.end.t, LENGTH)
  np.testing.assert_array_equal(runs.end.injection.onset[0], ONSET)
  np.testing.assert_array_equal(runs.end.injection.duration[0], DURATION)


def test_one_trace_for_all_seeds_severities_onsets_and_targets(runs):
  severity, onset = np.array([0.1, 0.9, 0.0, 1.0, 0.6], np.float32), np.array([9, 0, 2, 30, 1])
  targets = (np.arange(5) + 1) % len(runs.fault.targets)
  (_, rows), _ = runs.run(11, severity, onset, DURATION[::-1], targets)  # a second trace raises
  np.testing.assert_array_equal(rows.severity[-1, 0], severity * [1, 0, 0, 1, 1])  # the second and third are repaired by then


def test_each_stream_of_a_batch_has_its_own_target(runs, same):
  targets = np.array([0, 1, 2, 3, 0]) % len(runs.fault.targets)
  (end, _), _ = runs.run(5, np.ones(5, np.float32), np.full(5, 26), DURATION[[0] * 5], targets)  # equal in all else, since the last reset
  for i in range(5):
    for j in range(i):
      equal = same(*(jax.tree.map(lambda x: x[0, k], (end.env, end.obs)) for k in (i, j)))
      assert equal == (targets[i] == targets[j])


# ---- contract: ports -----------------------------------------------------------------------------------------------------------------

def test_registered_name_is_the_faults_own(short_walker):
  assert all(faults.make(name, short_walker.spec).name == name for name in FAULTS)


@pytest.mark.parametrize("severity", [0.0, 1e-3, 0.5, 1.0])
def test_only_owned_leaves_change(fault, short_walker, severity):
  before = ports_of(short_walker)
  for target in range(len(fault.targets)):
    fstate, after = fault.apply(fault.init(jax.random.key(0), target), jnp.float32(severity), jax.random.key(1), before)
    assert changed(before, after) == (set(fault.owns) if severity else set())
    assert jax.tree.structure(fstate) == jax.tree.structure(fault.init(jax.random.key(0), target))


def test_owned_names_are_leaves(fault, short_walker):
  assert set(fault.owns) <= leaves(ports_of(short_walker)).keys()
  assert (fault.name == "none") == (not fault.owns)


def test_repaired_after_duration(fault, short_walker):
  before = ports_of(short_walker)
  injection = faults.Injection(fault.init(jax.random.key(0)), jnp.float32(0.7), jnp.int32(5), jnp.int32(3))
  for t in range(12):
    injection, after, severity = faults.inject(fault, injection, jnp.int32(t), jax.random.key(t), before)
    assert changed(before, after) == (set(fault.owns) if 5 <= t < 8 else set())
    assert float(severity) == (np.float32(0.7) if 5 <= t < 8 else 0)


def test_a_fault_does_not_compound(fault, short_walker):
  """It starts from the nominal model in every step: the tenth step's model is the first's."""
  injection = faults.Injection(fault.init(jax.random.key(0)), jnp.float32(0.5), jnp.int32(0), jnp.int32(schedule.FOREVER))
  seen = []
  for t in range(10):
    injection, after, _ = faults.inject(fault, injection, jnp.int32(t), jax.random.key(0), ports_of(short_walker))
    seen.append(b"".join(v.tobytes() for k, v in leaves(after).items() if k.startswith("mj.")))
  assert len(set(seen)) == 1


def test_drawn_targets_cover_all_and_given_ones_are_honoured(fault, short_walker):
  given = [fingerprint(fault, fault.init(jax.random.key(k), i), short_walker) for i in range(len(fault.targets)) for k in (0, 1)]
  assert given[::2] == given[1::2]  # whatever the key
  assert len(set(given)) == len(fault.targets)
  draw = jax.vmap(fault.init)(jax.random.split(jax.random.key(0), 64))  # all of 6 joints are missed by one in 20,000 such draws
  drawn = [fingerprint(fault, jax.tree.map(lambda x: x[i], draw), short_walker) for i in range(64)]
  assert set(drawn) == set(given)


def test_target_names(fault):
  for i, name in enumerate(fault.targets):
    assert faults.target_index(fault, name) == i
  assert faults.target_index(fault, None) == faults.target_index(fault, "random") == -1
  with pytest.raises(UserError, match=f"'tail'.*{fault.name}.*random, {', '.join(fault.targets)}"):
    faults.target_index(fault, "tail")


def test_unknown_fault_names_the_choices(short_walker):
  with pytest.raises(UserError, match="'rust'.*" + ", ".join(sorted(FAULTS))):
    faults.make("rust", short_walker.spec)


# ---- schedule ------------------------------------------------------------------------------------------------------------------------

@pytest.mark.parametrize("onset, duration", [(0, 1), (0, schedule.FOREVER), (7, 5), (7, 0), (schedule.FOREVER, schedule.FOREVER)])
def test_abrupt_schedule(onset, duration):
  t = np.array([0, 1, 6, 7, 8, 11, 12, 2**31 - 2])
  got = jax.vmap(schedule.abrupt, (0, None, None))(jnp.asarray(t, jnp.int32), jnp.int32(onset), jnp.int32(duration))
  np.testing.assert_array_equal(got, [float(onset <= x < onset + duration) for x in t.tolist()])  # Python's integers do not overflow


# ---- single faults -------------------------------------------------------------------------------------------------------------------

def gears(short_walker, target, severity):
  fault = faults.make("gear", short_walker.spec)
  fstate = fault.init(jax.random.key(0), faults.target_index(fault, target))
  return np.asarray(fault.apply(fstate, jnp.float32(severity), jax.random.key(0), ports_of(short_walker))[1].model.mj["actuator_gear"])


@pytest.mark.parametrize("target, index, want", [("right_hip", 0, 50), ("right_knee", 1, 25), ("right_ankle", 2, 10), ("left_hip", 3, 50)])
def test_gear_is_halved_exactly_as_in_the_paper(short_walker, target, index, want):
  nominal = np.array([100, 50, 20, 100, 50, 20], np.float32)
  nominal[index] = want
  got = gears(short_walker, target, 0.5)
  np.testing.assert_array_equal(got[:, 0], nominal)
  np.testing.assert_array_equal(got[:, 1:], 0)


def test_gear_at_severity_one_gives_no_torque(short_walker):
  np.testing.assert_array_equal(gears(short_walker, "left_knee", 1.0)[:, 0], [100, 50, 20, 100, 0, 20])
