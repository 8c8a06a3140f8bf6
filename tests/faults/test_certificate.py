"""Contract suite: every fault of every robot acts, from its onset on, on nothing else, in one
compiled program; and the suite finds those that do not.
"""

import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl import envs, faults
from mjx_cl.errors import FileError, UserError
from mjx_cl.faults import certificate, presets
from mjx_cl.faults.lanes import WIDTH, Lane
from mjx_cl.io import tables
from mjx_cl.runs import certificate_tables, certify

LACKING = {  # what each robot cannot have, with the reason in the fault's own message
  "walker": {"velocity_limit": "task.velocity_limit", "lidar_loss": "lidar", "gap": "reality gap"},
  "quadruped": {"gear": "mj.actuator_gear", "lidar_loss": "lidar", "gap": "reality gap"},
  "car": {
    "gear": "mj.actuator_gear",
    "joint_lock": "one motor per joint",
    "com": "bodies with a name",
    "limb_mass": "bodies with a name",
    "joint_damping": "one motor per joint",
    "joint_friction": "one motor per joint",
    "range_loss": "one motor per joint",
    "gap": "reality gap",
    "command_range": "command_range",
  },
  "car_real": {
    "gear": "mj.actuator_gear",
    "joint_lock": "one motor per joint",
    "joint_damping": "one motor per joint",
    "joint_friction": "one motor per joint",
    "range_loss": "one motor per joint",
    "command_range": "command_range",
  },
}


@pytest.fixture(scope="module", params=sorted(envs.ENVS))
def robot(request):
  return envs.make(request.param, "native")


@pytest.fixture(scope="module")
def program():
  """certificate.program, made once for all faults of a robot."""
  made, make = {}, certificate.program

  def once(env, have):
    key = env.spec.name, tuple(f.name for f in have)
    return made.setdefault(key, None) or made.update({key: make(env, have)}) or made[key]

  return once


QUICK = ("walker", "car")


@pytest.mark.parametrize(
  "robot",
  [
    pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
    for name in sorted(envs.ENVS)
  ],
  indirect=True,
)
def test_every_fault_of_every_robot_acts_as_it_claims(robot, program, monkeypatch):
  """At severity 0 nominal bit for bit; above it other, never before the onset; more with more
  severity; whatever the robot, target and preset.
  """
  monkeypatch.setattr(certificate, "program", program)
  have = {k: f for k, f in faults.available(robot).items() if k != "none"}
  rows = certificate.certify(robot, have)
  assert certificate.faulty(rows) == []
  assert {r.fault for r in rows if "/" not in r.fault} == set(have) | {"none"}
  by_severity = {k: {r.severity for r in rows if r.fault == k} for k in have}
  assert all(s == set(certificate.SEVERITIES) for s in by_severity.values())
  own = {n for n, p in presets.PRESETS.items() if p.robot == robot.spec.name and p.changes}
  assert own <= {r.fault for r in rows}


def test_what_a_robot_cannot_have_says_why(robot):
  lacking = LACKING.get(robot.spec.name)
  if lacking is None:
    pytest.skip("a robot of another package")
  assert set(faults.FAULTS.own) - set(faults.available(robot)) == set(lacking)
  for name, word in lacking.items():
    with pytest.raises(UserError, match=word):
      faults.make(name, robot)


def test_every_channel_has_a_typical_deviation_of_its_own_kind(robot):
  """Sensor faults are measured in these: a default of 1 for all would make one of them a
  catastrophe and the other nothing.
  """
  scales = [v.scale for v in robot.spec.obs]
  assert min(scales) > 0 and len(set(scales)) > 2
  for v in robot.spec.obs:
    assert v.high > 1e9 or v.scale < 0.5 * (v.high - v.low), v.name


def test_targets_name_their_parts(robot):
  """Names are unique, groups lie within the robot, and no two targets of a fault stand for the
  same.
  """
  for name, f in faults.available(robot).items():
    assert len(set(f.targets)) == len(f.targets), name
    rows = {
      b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(f.init(jax.random.key(0), i).row))
      for i in range(len(f.targets))
    }
    assert len(rows) == len(f.targets) or name == "none", name
  size = len(robot.spec.act)
  for _, index in robot.spec.act_groups:
    assert set(index) <= set(range(size))
  for _, index in robot.spec.obs_groups:
    assert set(index) <= set(range(len(robot.spec.obs)))


# ---- the suite finds what is wrong ---------------------------------------------------------------


@pytest.fixture(scope="module")
def short():
  return envs.make("car", "native")


def broken(env):
  """Faults as a careless author writes them."""
  ctrl = lambda name, act, memory=(): faults.fault(name, env, ("ctrl",), ("all",), act, memory)
  return {
    "idle": ctrl("idle", lambda t, m, s, key, ports: (m, {"ctrl": ports.ctrl * 1.0})),
    "backwards": ctrl("backwards", lambda t, m, s, key, ports: (m, {"ctrl": ports.ctrl * s})),
    # the author bypasses `fault`: the change is there before the onset and at severity 0
    "early": faults.Fault(
      "early",
      ("ctrl",),
      ("all",),
      1,
      lambda key, target=-1: faults.State(jnp.int32(0), (), ()),
      lambda state, s, key, ports: (state, ports._replace(ctrl=ports.ctrl * 0.5)),
      False,
    ),
    "nan": faults.fault(
      "nan", env, ("obs",), ("all",), lambda t, m, s, key, ports: (m, {"obs": ports.obs * jnp.nan})
    ),
    "sound": ctrl("sound", lambda t, m, s, key, ports: (m, {"ctrl": ports.ctrl * (1 - s)})),
  }


@pytest.mark.parametrize(
  "name, words",
  [
    ("idle", ["changes nothing"]),
    ("backwards", ["falls with severity"]),
    ("early", ["not the nominal robot bit for bit"]),
    ("nan", ["no numbers"]),
    ("sound", []),
  ],
)
def test_a_defective_fault_is_found(short, name, words):
  """`early` makes the nominal robot of its own program another one too, which the comparison with
  the program without faults shows.
  """
  found = certificate.faulty(
    certificate.certify(
      short,
      {name: broken(short)[name]},
      onset=20,
      steps=140,
      sizes=(1.0,),
      severities=(0.0, 0.5, 1.0),
    )
  )
  if name == "early":
    assert any("it is not the robot without faults" in line for line in found)
  else:
    assert all(any(word in line for line in found) for word in words) and bool(found) == bool(words)


def test_many_robots_many_faults_one_trace(short, program):
  """Faults, targets, severities, onsets and schedules differ over a batch and change between calls:
  traced once, as for the certificates of this robot, whose program it is.
  """
  have = {k: f for k, f in faults.available(short).items() if k != "none"}
  names, rng = list(have), np.random.default_rng(0)
  run = program(short, tuple(have.values()))
  model = faults.owned_model(tuple(have.values()), short.model)
  signal = jnp.asarray(certificate.actions(short, 240, 0))
  seen = []
  for _ in range(3):
    lanes = [
      Lane(
        names[i % len(names)],
        (f := have[names[i % len(names)]]).targets[rng.integers(len(f.targets))],
        float(rng.uniform(0.2, 1)),
      )
      for i in rng.permutation(WIDTH)
    ]
    plan, target = certificate.plans(have, lanes, 0)
    plan = plan._replace(
      onset=jnp.asarray(rng.integers(0, 6, plan.onset.shape), jnp.int32),
      kind=jnp.asarray(rng.integers(0, 5, plan.kind.shape), jnp.int32),
      period=jnp.full(plan.period.shape, 4, jnp.int32),
    )
    seen.append(np.asarray(run(model, jax.random.key(0), plan, target, signal)[0][0]))
  assert run._cache_size() == 1
  for one, other in zip(seen, seen[1:]):
    assert one.shape == (WIDTH, 240, 67) and np.isfinite(one).all() and (one != other).any()
  # a few do not act on what this robot does
  assert min(len({x.tobytes() for x in one}) for one in seen) > 0.75 * WIDTH


# ---- cost and files ------------------------------------------------------------------------------


def test_divergence_of_two_normals_against_the_closed_form():
  """Unit deviations, means 1.5 and 0 apart in one channel: KL = 1.5^2 / 2; a deviation of e^0.5
  alone: (e - 1 - 1) / 2.
  """
  rng = np.random.default_rng(0)
  x = rng.normal(size=(200_000, 2))
  assert certify.divergence(x + np.array([1.5, 0]), x) == pytest.approx(
    1.125, rel=0.02
  )  # 1 / sqrt(n) on the moments
  assert certify.divergence(x * np.array([np.exp(0.5), 1]), x) == pytest.approx(
    (np.e - 2) / 2, rel=0.02
  )
  assert certify.divergence(x[:10], x) is None


@pytest.mark.slow
def test_certify_command_measures_the_cost(tmp_path):
  rows = certify.certify("walker", "native", episodes=3, only=("gear",))
  certificate_tables.write(tmp_path, rows)
  top = next(r for r in rows if r["fault"] == "gear" and r["severity"] == 1 and r["episodes"])
  assert (
    top["return_lost"] > 100
    and top["return_lost_low"] <= top["return_lost"] <= top["return_lost_high"]
    and top["kl_nats"] > 0.1
  )


def test_files_keep_the_rows_of_other_robots(tmp_path, short):
  have = {"noise": faults.make("noise", short)}
  extra = {
    "physics": "jax",
    "agent": None,
    "episodes": 0,
    "return_nominal": None,
    "return_mean": None,
    "return_lost": None,
    "return_lost_low": None,
    "return_lost_high": None,
    "kl_nats": None,
  }
  assert set(extra) | set(certificate.Certificate._fields) == set(certificate_tables.COLUMNS)
  rows = [
    c._asdict() | extra
    for c in certificate.certify(
      short, have, onset=20, steps=140, sizes=(1.0,), severities=(0.0, 1.0)
    )
  ]
  certificate_tables.write(tmp_path, [r | {"robot": "other"} for r in rows])
  certificate_tables.write(tmp_path, rows)
  certificate_tables.write(tmp_path, rows)
  import pyarrow.parquet

  kept = pyarrow.parquet.read_table(tmp_path / "certificates.parquet").to_pylist()
  assert (
    [r["robot"] for r in kept].count("car")
    == len(rows)
    == [r["robot"] for r in kept].count("other")
  )
  with pytest.raises(UserError, match="measured costs of other"):
    certificate_tables.write(
      tmp_path, [r | {"robot": "other", "episodes": 3, "return_nominal": 9.0} for r in rows]
    )
    certificate_tables.guard(tmp_path, ("other",), 0)
  certificate_tables.guard(tmp_path, ("other",), 2)
  text = (tmp_path / "certificates.md").read_text()
  assert "## car" in text and "## other" in text and "| sensor | noise | lidar | 1 |" in text
  lost = lambda agent, n, **more: {"agent": agent, "episodes": n, "return_nominal": 9.0 * n} | more
  noisy = [r for r in rows if r["fault"] == "noise"]
  own = [r | lost("a", 20) for r in noisy] + [r | lost("b", 5, fault="bias") for r in noisy]
  said = certificate_tables.table(own)
  assert "Nominal return 180 over 20 episodes of agent `a` (noise)." in said
  assert "Nominal return 45 over 5 episodes of agent `b` (bias)." in said
  assert "episodes of agent `a`.\n" in certificate_tables.table(own[: len(noisy)])
  assert all(row["holds"] for row in certificate_tables.summary(rows) if row["goal"])
  json.dumps(certificate_tables.summary(rows))
  both = certificate_tables.table(
    [r | {"kl_nats": 1.0} for r in rows] + [r | {"physics": "mjx", "kl_nats": 7.0} for r in rows]
  )
  one, other = both.split("## car, physics ")[1:]
  assert (
    one.startswith("jax") and "| 1 |\n" in one and other.startswith("mjx") and "| 7 |\n" in other
  )


def test_what_is_in_the_way_is_said_before_anything_is_measured(tmp_path):
  (tmp_path / "file").write_text("x")
  with pytest.raises(FileError, match="cannot write in"):
    certificate_tables.guard(tmp_path / "file", ("walker",), 20)
  (tmp_path / "certificates.parquet").write_text("no table")
  with pytest.raises(FileError, match="is no table of certificates"):
    certificate_tables.guard(tmp_path, ("walker",), 20)
  with pytest.raises(UserError, match="no agent 'nobody'"):
    certify.certify("car", episodes=1, agent="nobody")
  with pytest.raises(UserError, match="'none' changes nothing"):
    certify.certify("car", only=("none",))


def test_unknown_robot_names_the_choices():
  with pytest.raises(UserError, match="'crawler'.*car, car_real, quadruped, walker"):
    certify.check(("crawler",))


def test_the_certificates_that_are_published_are_of_every_fault_target_severity_and_preset(robot):
  """No lane of today's catalogue is missing in results/certificates.parquet, and none is of
  yesterday's.
  """
  if robot.spec.name not in LACKING:
    pytest.skip("a robot of another package")
  path = pathlib.Path(__file__).parents[2] / "results/certificates.parquet"
  rows = [r for r in tables.read_rows(path) if r["robot"] == robot.spec.name]
  have = {
    k: f for k, f in faults.available(robot).items() if k in faults.FAULTS.own and k != "none"
  }
  key = lambda fault, target, severity: (fault, target, round(severity, 6))
  want = {
    key(lane.fault, lane.target, lane.severity)
    for lane in certificate.lanes(have, certificate.SEVERITIES)
    + certificate.preset_lanes(robot, have)
  }
  want |= {key(name, "preset", 1.0) for name in certify.changes(robot.spec.name)}
  assert {key(r["fault"], r["target"], r["severity"]) for r in rows if r["fault"] != "none"} == want
  assert (
    certificate.faulty(
      [certificate.Certificate(**{k: r[k] for k in certificate.Certificate._fields}) for r in rows]
    )
    == []
  )
