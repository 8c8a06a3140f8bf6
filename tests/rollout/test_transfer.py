"""A robot that becomes another one: who changes when, that no row is lost, what each half of a life
equals, a run with it, kill and resume.
"""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet
import pytest

from mjx_cl import envs, faults
from mjx_cl.config import CHUNK, FOREVER, PRESETS, AdaptConfig, RunConfig
from mjx_cl.dreamer.agent import Agent
from mjx_cl.envs.car import Car
from mjx_cl.envs.car_real import CarReal
from mjx_cl.errors import PluginError, UserError
from mjx_cl.faults import certificate, presets
from mjx_cl.faults.presets import SOCKS, SOCKS_GRIP, Change, Preset
from mjx_cl.io import tables
from mjx_cl.rollout import transfer as transfer_lib
from mjx_cl.rollout.scan import Rollout, nest, start
from mjx_cl.rollout.transfer import Transfer
from mjx_cl.runs import certify, run, settings
from mjx_cl.training import agents

EPISODE, SEEDS, ONSET, CHUNK, CHUNKS = 50, 5, 70, 64, 5
SECOND = 100  # steps from the onset to the second change


def shorten(base, **spec):
  """A robot with episodes of EPISODE steps, and more that its spec says otherwise."""

  class Short(base):
    def __init__(self, physics="auto"):
      super().__init__("auto" if base is Car else "native")
      self.spec = self.spec._replace(episode_steps=EPISODE, **spec)

  return Short


@pytest.fixture(scope="module")
def robots():
  return shorten(Car)(), shorten(CarReal)()


@pytest.fixture(scope="module")
def agent():
  return Agent(PRESETS["tiny"].dreamer, 67, 2)


@pytest.fixture(scope="module")
def params(agent):
  one = jax.jit(agent.init)(jax.random.key(0)).params
  return jax.tree.map(lambda x: jnp.broadcast_to(x, (SEEDS,) + x.shape), one)


@pytest.fixture(scope="module")
def keys():
  return jnp.stack([jax.random.key(s) for s in range(SEEDS)])[:, None]


@pytest.fixture(scope="module")
def transfer(robots, agent):
  """Transfer, and begin(keys, socks severity, due) -> Moving."""
  made, plan, target = faults.build((Change("friction", "rear", 0.5, SECOND),), robots[1], ONSET)
  both = Transfer(*robots, agent, made)

  def begin(keys, severity=0.0, due=ONSET):
    chosen = plan._replace(severity=jnp.full(1, severity))
    one = lambda key, due: both.start(
      key, target, chosen, due
    )  # not jitted, like that of a run: one program more could round otherwise
    return nest(one, (0, 0), (0, 0))(
      keys, jnp.broadcast_to(jnp.asarray(due, jnp.int32).reshape(-1, 1), (SEEDS, 1))
    )

  return both, begin


def live(rollout, params, streams, lengths=(CHUNK,) * CHUNKS):
  """(streams at the end, Row with leading (steps, SEEDS))."""
  parts = []
  for length in lengths:
    streams, rows = rollout.chunk(params, streams, length)
    parts.append(rows)
  return streams, jax.tree.map(lambda *x: np.concatenate(x)[:, :, 0], *parts)


@pytest.fixture(scope="module")
def lived(transfer, params, keys):
  """A life with the change and nothing after it: (Moving at the end, rows)."""
  both, begin = transfer
  return live(both, params, begin(keys))


def ends(rows):
  return rows.terminated | rows.truncated


def first_step(rows, g, due=ONSET):
  """Step after the first episode's end at or after `due`."""
  return int(np.flatnonzero(ends(rows)[:, g] & (np.arange(len(rows.reward)) >= due))[0]) + 1


def equal(a, b, where=slice(None)):
  """Every array of two Rows is bit for bit the same in the rows `where`."""
  return all(x is y or x[where].tobytes() == y[where].tobytes() for x, y in zip(a, b, strict=True))


# ---- who changes when ----------------------------------------------------------------------------


def test_each_stream_changes_at_its_own_first_end(lived):
  streams, rows = lived
  enter = np.asarray(streams.after.enter)[:, 0]
  assert enter.tolist() == [first_step(rows, g) for g in range(SEEDS)]
  assert (
    len(set(enter.tolist())) >= 3 and (enter > ONSET).all() and (enter <= ONSET + EPISODE).all()
  )
  early = ends(rows)[CHUNK:ONSET].any(
    0
  )  # an end in the chunk of the onset, before it, changes nothing
  assert early.any()
  clock = np.arange(len(rows.reward))[:, None]
  np.testing.assert_array_equal(
    rows.severity, np.where(clock >= enter, 1.0, 0.0).astype(np.float32)
  )


def test_no_row_is_lost_or_doubled(lived):
  """Across the change as everywhere: an episode's number rises by 1 after its end, a first row
  follows, its reward is 0, and the records chain.
  """
  streams, rows = lived
  over = ends(rows)
  assert (
    rows.reward.shape == (CHUNK * CHUNKS, SEEDS)
    and (rows.episode[0] == 0).all()
    and rows.first[0].all()
  )
  np.testing.assert_array_equal(np.diff(rows.episode, axis=0), over[:-1])
  np.testing.assert_array_equal(rows.first[1:], over[:-1])
  np.testing.assert_array_equal(rows.reward_in[1:], np.where(over[:-1], 0.0, rows.reward[:-1]))
  going = ~over[:-1]
  np.testing.assert_array_equal(rows.obs[1:][going], rows.final_obs[:-1][going])
  for g in range(SEEDS):
    at = np.flatnonzero(over[:, g])
    lengths = np.diff(np.concatenate([[-1], at]))
    assert (lengths <= EPISODE).all()
    np.testing.assert_array_equal(
      rows.truncated[at, g], (lengths == EPISODE) & ~rows.terminated[at, g]
    )
  assert (np.asarray(streams.after.t) == CHUNK * CHUNKS).all()


def test_the_life_before_is_that_of_a_plain_run(lived, robots, agent, params, keys):
  none = (faults.none(robots[0]),)
  plain = Rollout(robots[0], agent, none)
  streams, own = live(plain, params, nest(lambda k: start(robots[0], agent, none, k), 0, 0)(keys))
  enter = np.asarray(lived[0].after.enter)[:, 0]
  for g in range(SEEDS):
    one = lambda rows: jax.tree.map(lambda x: x[:, g], rows)
    assert equal(one(own), one(lived[1]), slice(0, enter[g]))
    assert not np.array_equal(own.obs[enter[g] :, g], lived[1].obs[enter[g] :, g])


def test_where_the_chunk_ends_does_not_matter(lived, transfer, params, keys):
  """A chunk that ends with the very step in which a stream's episode does, and others cut anywhere."""
  both, begin = transfer
  length = int(np.asarray(lived[0].after.enter)[0, 0])
  streams, rows = live(both, params, begin(keys), (length, length))
  assert equal(rows, jax.tree.map(lambda x: x[: 2 * length], lived[1]))


def test_streams_have_onsets_of_their_own(lived, transfer, params, keys, same):
  """Onsets are data: a late one, one that never comes, whose second robot rests; the others' lives
  stay what they are.
  """
  both, begin = transfer
  due = [ONSET, faults.FOREVER, ONSET, 130, ONSET]
  begun = begin(keys, due=due)
  streams, rows = live(both, params, begun)
  rests = lambda moving: jax.tree.map(lambda x: x[1], moving.after.env)
  assert same(rests(begun), rests(streams))
  enter = np.asarray(streams.after.enter)[:, 0]
  assert enter[1] == faults.FOREVER and not rows.severity[:, 1].any()
  assert [enter[g] for g in (0, 2, 3, 4)] == [first_step(rows, g, due[g]) for g in (0, 2, 3, 4)]
  for g in (0, 2, 4):
    assert enter[g] == np.asarray(lived[0].after.enter)[g, 0]


def test_only_the_rollouts_that_are_needed_run(lived, transfer, params, keys, monkeypatch):
  both, begin = transfer
  calls = []
  for name in ("before", "after"):
    rollout = getattr(both, name)
    chunk = rollout.chunk
    monkeypatch.setattr(
      rollout, "chunk", lambda *a, name=name, chunk=chunk: calls.append(name) or chunk(*a)
    )
  last = -(-int(np.asarray(lived[0].after.enter).max()) // CHUNK)
  live(both, params, begin(keys))
  want = (
    [["before"]] * (ONSET // CHUNK)
    + [["before", "after"]] * (last - ONSET // CHUNK)
    + [["after"]] * (CHUNKS - last)
  )
  assert calls == sum(want, []) and last < CHUNKS


# ---- the robot after the change ------------------------------------------------------------------


def test_after_the_change_the_robot_is_the_other_one(lived, robots, agent, params, keys):
  """Oracle: from `enter` on one car_real, stepped one by one with the actions that the rows tell;
  the agent begins afresh with it.
  """
  streams, rows = lived
  both = [
    jax.jit(functools.partial(env.step, faults.owned_model((faults.none(env),), env.model)))
    for env in robots
  ]
  gaps = []
  act = jax.jit(agent.act, static_argnums=4)
  for g in range(2):
    enter = int(streams.after.enter[g, 0])
    stream_key = jax.random.split(keys[g, 0], 3)[2]
    one = jax.tree.map(lambda x: x[g], params)
    states = [None, None]
    for k in range(enter, enter + 60):
      if k == enter or ends(rows)[k - 1, g]:
        drawn = jax.random.fold_in(jax.random.fold_in(stream_key, k), 2)
        carry = agent.carry()
        states = [env.init(env.model, drawn)[0] for env in robots]
        np.testing.assert_allclose(
          rows.obs[k, g], robots[1].init(robots[1].model, drawn)[1], atol=1e-5
        )
      now = jax.random.fold_in(jax.random.fold_in(stream_key, k), 0)
      carry, action = act(
        agent.prepare(one), carry, rows.obs[k, g], jax.random.split(now)[0], False
      )
      np.testing.assert_allclose(rows.action[k, g], action, atol=1e-4)
      outs = []
      for i in range(2):
        states[i], out = both[i](states[i], rows.action[k, g])
        outs.append(out)
      np.testing.assert_allclose(
        rows.final_obs[k, g], outs[1].obs, atol=2e-4
      )  # programs differ in the order of float32 sums
      np.testing.assert_allclose(rows.reward[k, g], outs[1].reward, atol=1e-4)
      assert rows.terminated[k, g] == outs[1].terminated
      gaps.append(np.abs(rows.final_obs[k, g] - outs[0].obs).max())
  assert np.median(gaps) > 0.02  # the same actions in car are another life


@pytest.mark.slow
def test_the_certificate_of_a_change(robots):
  """It acts from the first step of the episode after the end, not before."""
  moved = certify.become(*robots, "car/sim-to-real", onset=10)
  assert (moved.first_step, moved.early, moved.identical, moved.finite) == (0, False, False, True)
  assert 0 < moved.diff_1 < moved.diff_10 and certificate.faulty([moved]) == []


@pytest.mark.slow
def test_a_change_that_comes_early_is_seen(robots, monkeypatch):
  merge = transfer_lib.merge
  monkeypatch.setattr(
    transfer_lib, "merge", lambda t, enter, before, after: merge(t, enter - 1, before, after)
  )
  early = certify.become(*robots, "car/sim-to-real", onset=10)
  assert (
    early.early and early.first_step == -1 and "before the onset" in certificate.faulty([early])[0]
  )


def test_a_fault_of_the_second_robot_follows(lived, transfer, params, keys):
  both, begin = transfer
  streams, rows = live(both, params, begin(keys, severity=SOCKS))
  at = ONSET + SECOND
  assert equal(rows, lived[1], slice(0, at - 1)) and np.array_equal(rows.obs[at], lived[1].obs[at])
  assert (
    all((rows.obs[at:, g] != lived[1].obs[at:, g]).any() for g in range(SEEDS))
    and (rows.severity[at:] == 1).all()
  )
  grip = both.after._drive(
    jax.tree.map(lambda x: x[0, 0], streams.after), jax.random.key(0), jnp.zeros(2)
  )[1].model.mj["geom_friction"][:, 0]
  feet = dict(both.after.env.spec.feet)
  np.testing.assert_allclose(grip[jnp.asarray(feet["rear"])], SOCKS_GRIP, rtol=1e-5)
  np.testing.assert_allclose(grip[jnp.asarray(feet["front"])], 0.65, rtol=1e-5)


def test_refused_robots(robots, agent):
  with pytest.raises(UserError, match="holds its action for 2"):
    Transfer(*robots, agent, (faults.none(robots[1]),), repeat=2)
  walker = envs.make("walker", "native")
  with pytest.raises(UserError, match="'car' cannot become 'walker'"):
    Transfer(robots[0], walker, agent, (faults.none(walker),))


# ---- names ---------------------------------------------------------------------------------------


def test_presets_with_a_change_of_robots():
  found = {name: p for name, p in presets.PRESETS.items() if p.becomes}
  assert {"car/sim-to-real", "car/transfer-then-socks"} <= set(found)
  for preset in presets.PRESETS.values():
    assert bool(preset.becomes) or not preset.then
  for preset in found.values():
    first, other = envs.make(preset.robot), envs.make(preset.becomes, "native")
    assert (first.spec.obs, first.spec.act, first.spec.control_s) == (
      other.spec.obs,
      other.spec.act,
      other.spec.control_s,
    )
    faults.build(preset.then, other)
    assert all(
      c.after >= first.spec.episode_steps for c in preset.then
    )  # every stream has changed by then
  (socks,) = found["car/transfer-then-socks"].then
  assert (socks.fault, socks.target, socks.severity, socks.after) == (
    "friction",
    "rear",
    SOCKS,
    42_000,
  )


def test_config():
  late = RunConfig("car", fault="car/sim-to-real", onset=900, steps=300)
  assert (
    presets.becomes(late) == "car_real"
    and presets.becomes(RunConfig("car")) is None
    and presets.becomes(RunConfig("car_real", fault="car/socks")) is None
  )
  assert [c.fault for c in presets.changes(late)] == ["none"]
  assert presets.changes(RunConfig("car", fault="car/transfer-then-socks")) == (
    Change("friction", "rear", SOCKS, 42_000),
  )
  for kw, words in (
    ({"severity": 0.3}, "its own severity and target"),
    ({"target": "rear"}, "its own severity and target"),
    ({"schedule": "ramp"}, "its own schedule"),
    ({"duration": 50}, "'car_real' for good; leave duration out"),
    ({"onset": -1}, "onset must lie in 0..2147483646"),
    ({"onset": 2**31}, "onset must lie in"),
    ({"env": "walker"}, "of robot 'car'"),
  ):
    with pytest.raises(UserError, match=words) as e:
      settings.check(RunConfig(**{"env": "car", "fault": "car/sim-to-real"} | kw))
    assert "\n" not in str(e.value)


@pytest.fixture(scope="module")
def saved(agent, tmp_path_factory):
  """Folder of the tiny agent."""
  folder = tmp_path_factory.mktemp("agents") / "tiny_car"
  agents.save(
    folder,
    jax.jit(agent.init)(jax.random.key(0)),
    {"env": "car", "preset": "tiny", "repeat": 1, "dreamer": dataclasses.asdict(agent.config)},
  )
  return folder


def test_an_agent_that_holds_its_action_is_refused(agent, saved, tmp_path):
  folder = tmp_path / "held"
  agents.save(
    folder,
    jax.jit(agent.init)(jax.random.key(0)),
    {"env": "car", "preset": "tiny", "repeat": 2, "dreamer": dataclasses.asdict(agent.config)},
  )
  with pytest.raises(UserError, match="holds its action for 2"):
    run.Runner(RunConfig("car", fault="car/sim-to-real", agent=str(folder)), tmp_path / "out")


# ---- a run ---------------------------------------------------------------------------------------

STEPS = 400
ADAPT = AdaptConfig(
  warmup=30, start_windows=20, patience=4, least=64, trend=1e9, fluctuation=1e9, refit=60
)


@pytest.fixture(scope="module")
def short():
  """Table entries in place: short robots, of which only the second one's task can be done, and a
  preset that goes on after SECOND steps.
  """
  with pytest.MonkeyPatch.context() as patch:
    patch.setitem(envs.ENVS, "car", shorten(Car, acceptance=1e9))
    patch.setitem(envs.ENVS, "car_real", shorten(CarReal, acceptance=-1e9))
    patch.setitem(
      presets.PRESETS,
      "car/both",
      Preset("car", (), "", "", "car_real", (Change("friction", "rear", SOCKS, SECOND),)),
    )
    yield


def asked(saved, **kw):
  given = dict(
    fault="car/both",
    onset=ONSET,
    steps=STEPS,
    seeds=2,
    detector="rolling_sigma_plain",
    settings={"window": 40, "warmup": 20},
    agent=str(saved),
    adapt=ADAPT,
  )
  return RunConfig("car", **given | kw)


@pytest.fixture(scope="module")
def whole(short, saved, tmp_path_factory):
  """An uninterrupted run of both arms: (folder, [rows of each chunk], {(control steps done,
  stream): acceptance that was handed on}).
  """
  out, chunks, levels = tmp_path_factory.mktemp("runs") / "whole", [], {}
  log, settle = run.Runner._log, run.Runner._settle

  def settled(self, now, g, robot):
    told = settle(self, now, g, robot)
    levels[now, g] = told.acceptance
    return told

  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(
      run.Runner,
      "_log",
      lambda self, rows, digest: (
        chunks.append(jax.tree.map(np.asarray, rows)) or log(self, rows, digest)
      ),
    )
    patch.setattr(run.Runner, "_settle", settled)
    run.execute(asked(saved), out)
  return out, chunks, levels


def table(folder, name):
  return pyarrow.parquet.read_table(folder / f"{name}.parquet").to_pydict()


def by_stream(folder, streams=4):
  return {k: v.reshape(streams, -1) for k, v in tables.read_table(folder / "trace.parquet").items()}


def events_of(folder, g, *kinds):
  e = table(folder, "events")
  return [
    (s, r)
    for stream, s, k, r in zip(e["stream"], e["step"], e["kind"], e["reason"])
    if stream == g and k in kinds
  ]


def entered(trace, g):
  over = trace["terminated"][g] | trace["truncated"][g]
  return int(np.flatnonzero(over & (trace["step"][g] >= ONSET))[0]) + 1


@pytest.mark.slow
def test_trace_of_a_run(whole):
  trace = by_stream(whole[0])
  assert (
    set(trace["fault"].reshape(-1)) == {"car/both"} and (trace["step"] == np.arange(STEPS)).all()
  )
  for g in range(4):
    at = entered(trace, g)
    np.testing.assert_array_equal(trace["severity"][g], np.arange(STEPS) >= at)
    np.testing.assert_array_equal(trace["fault_active"][g], np.arange(STEPS) >= at)
    over = trace["terminated"][g] | trace["truncated"][g]
    np.testing.assert_array_equal(np.diff(trace["episode"][g]), over[:-1])
    assert not over[at - 16 : at - 1].any() and not over[at : at + 14].any()
    valid = (
      np.arange(at - 1, at + 15) - at
      # a window of 15 steps is cut at the reset and needs 5; row k holds the one that began with
      # row
      # k - 14
    )
    np.testing.assert_array_equal(trace["valid"][g, at - 1 : at + 15], (valid < 10) | (valid >= 14))
  assert entered(trace, 0) != entered(trace, 1)


def test_each_stream_has_its_own_onset_event(whole):
  out, trace = whole[0], by_stream(whole[0])
  for g in range(4):
    assert events_of(out, g, "onset") == [
      (entered(trace, g), "becomes car_real, severity 1"),
      (ONSET + SECOND, f"friction, severity {SOCKS:g}"),
    ]
    alarms = events_of(out, g, "alarm")
    assert alarms and all(
      ("before onset: a false alarm" in r) == (s < entered(trace, g)) for s, r in alarms
    )


def test_latency_and_windows_are_counted_from_there(whole):
  out, trace, rows = whole[0], by_stream(whole[0]), table(whole[0], "runs")
  assert rows["change"] == [0, 1] * 4 and rows["stream"] == [0, 0, 1, 1, 2, 2, 3, 3]
  for g in range(4):
    row, at = {k: v[2 * g] for k, v in rows.items()}, entered(trace, g)
    then = {k: v[2 * g + 1] for k, v in rows.items()}["onset"]
    assert then == ONSET + SECOND > at
    reward, alarms = (
      trace["reward"][g, :then].astype(float),
      np.flatnonzero(trace["alarm"][g, :then]),
    )
    busy = trace["phase"][g][at] == "adapting"  # kept apart from latency
    after = alarms[(alarms >= at) & (not busy)]
    assert row["adapting_at_onset"] == busy
    assert (
      row["onset"] == at
      and row["false_alarms"] == (alarms < at).sum()
      and row["alarm_step"] == (after[0] if len(after) else None)
    )
    assert row["latency_steps"] == (after[0] - at if len(after) else None)
    acted = [int(r.split()[-1]) for _, r in events_of(out, g, "start")]
    assert row["reward_pre"] == pytest.approx(reward[ADAPT.warmup : min([at] + acted[:1])].mean())
    assert row["return_lost"] == pytest.approx((row["reward_pre"] - reward[at:]).sum())
    none, own = trace["reward"][2 + g % 2, :then].astype(float), entered(trace, 2 + g % 2)
    assert row["reward_drop"] == pytest.approx(
      1 - none[own:].mean() / none[ADAPT.warmup : own].mean()
    )
  summary = json.loads((out / "summary.json").read_text())
  assert (summary["fault"], summary["severity"], summary["onset"]) == ("car/both", 1.0, ONSET)


def test_the_second_change_has_rows_of_its_own(whole):
  out, trace, rows = whole[0], by_stream(whole[0]), table(whole[0], "runs")
  for g in range(4):
    row, at = {k: v[2 * g + 1] for k, v in rows.items()}, ONSET + SECOND
    reward, alarms = trace["reward"][g].astype(float), np.flatnonzero(trace["alarm"][g])
    busy = trace["phase"][g][at] == "adapting"  # kept apart from latency
    after = alarms[(alarms >= at) & (not busy)]
    assert row["adapting_at_onset"] == busy
    assert row["alarm_step"] == (after[0] if len(after) else None) and row["latency_steps"] == (
      after[0] - at if len(after) else None
    )
    assert (
      row["false_alarms"] is None and row["wall_s"] is None and row["return_lost_healthy"] is None
    )  # what comes before is the first row's
    assert row["reward_pre"] == pytest.approx(reward[:at].mean()) and row[
      "reward_drop"
    ] == pytest.approx(1 - reward[at:].mean() / reward[:at].mean())
    assert (
      row["terminations"] == trace["terminated"][g, at:].sum()
      and row["adapted_steps"] == (trace["phase"][g, at:] == "adapting").sum()
    )
    assert (
      rows["updates"][2 * g] == trace["updates"][g, at]
      and row["updates"] >= trace["updates"][g, -1] - trace["updates"][g, at]
    )
  summary = json.loads((out / "summary.json").read_text())
  (later,) = summary["later_changes"]
  assert (
    set(later) == set(summary["arms"])
    and later["none"]["seeds"] == 2
    and later["none"]["false_alarms_per_hour"] is None
  )


def test_the_task_is_accepted_by_the_level_of_the_robot_that_there_is(whole):
  """The first robot's level cannot be reached, the second's cannot be missed: streams that adapt
  converge, and only as the second robot.
  """
  out, _, levels = whole
  trace = by_stream(out)
  at = np.asarray([entered(trace, g) for g in range(4)])
  for i in range(-(-STEPS // CHUNK)):
    level = np.concatenate([levels[(i + 1) * CHUNK, g] for g in range(4)])
    np.testing.assert_array_equal(
      level, np.where(at < (i + 1) * CHUNK, -1e9, 1e9).astype(np.float32)
    )
  stops = [(g, s) for g in (0, 1) for s, _ in events_of(out, g, "stop")]
  assert stops and all(s >= at[g] for g, s in stops)


def test_starts_are_as_wide_for_every_arm_of_a_run(short, saved, tmp_path):
  """Beside an arm of nine starts, one that is told the change has it, once it has come, in a row
  of the same shape: streams are put together, and share a program.
  """
  adapt = dataclasses.replace(ADAPT, period=40, period_steps=30)
  runner = run.Runner(asked(saved, arms=("periodic", "oracle"), seeds=1, adapt=adapt), tmp_path)
  robot = jax.tree.map(lambda x: x[:, :1], runner.lives.herds[0].streams)
  moved = robot._replace(after=robot.after._replace(enter=jnp.full_like(robot.after.enter, 97)))
  told = [
    [runner._settle(128, g, lambda own=own: own).choices.at for own in (robot, moved)]
    for g in (0, 1)
  ]
  assert {at.shape for own in told for at in own} == {runner.choices[0].at.shape} == {(1, 16)}
  assert list(told[0][1][0][:10]) == [*range(40, 400, 40), FOREVER]
  assert sorted(told[1][1][0].tolist())[:3] == [97, ONSET + SECOND, FOREVER]
  assert sorted(told[1][0][0].tolist())[:2] == [ONSET + SECOND, FOREVER]


def test_starts_that_follow_from_the_onset_have_room(short, saved, tmp_path):
  """A trigger that starts the more often the sooner the robot changes, and one that starts more
  often later than at once, which is refused in a line.
  """
  own = tmp_path / "own.py"
  own.write_text(
    "from mjx_cl.adapt.arms import BUDGET, Arm, Trigger\n"
    "every = lambda onsets, steps, by: tuple(s for o in onsets for s in range(o, steps, by))\n"
    "def often():\n"
    "  return Arm('', Trigger('', lambda adapt, on, steps, seed: every(on, steps, 20)), BUDGET)\n"
    "def late():\n"
    "  count = lambda on: 20 if 75 < on[0] < 2**30 else 1\n"
    "  return Arm('', Trigger('', lambda adapt, on, steps, seed: (200,) * count(on)), BUDGET)\n"
  )
  whole = run.Runner(asked(saved, arms=(f"{own}:often", "none")), tmp_path / "a")
  at = whole._at(0, ONSET + 10)
  assert at.shape == whole.choices[0].at.shape and at.shape[1] >= (STEPS - ONSET) // 20
  steps = list(range(ONSET + 10, STEPS, 20)) + list(range(ONSET + SECOND, STEPS, 20))
  assert at[0, : len(steps)].tolist() == steps and (at[0, len(steps) :] == FOREVER).all()
  late = run.Runner(asked(saved, arms=(f"{own}:late", "none")), tmp_path / "b")
  with pytest.raises(PluginError, match="told an onset at step 80 it starts more adaptations"):
    late._at(0, 80)


def test_the_replay_holds_what_the_stream_lived(whole):
  """Updates follow the change, and both arms of a seed live the same life until the first alarm
  that is acted on.
  """
  out, chunks, _ = whole
  trace = by_stream(out)
  obs = np.concatenate([c.final_obs for c in chunks])[:, :, 0]
  for g in (0, 1):
    first = (events_of(out, g, "start") + [(STEPS, "")])[0][0]
    assert obs[:first, g].tobytes() == obs[:first, g + 2].tobytes()
    assert trace["updates"][g, -1] > 0 and not trace["updates"][g + 2].any()


@pytest.mark.slow
def test_a_run_killed_before_during_and_after_the_change_ends_in_the_same_files(
  whole, short, saved, tmp_path
):
  out = tmp_path / "cut"
  trace = by_stream(whole[0])
  at = sorted(entered(trace, g) for g in range(4))
  during = at[0] // CHUNK + 1  # chunks after which the first stream has moved
  cuts, what = [1, during, STEPS // CHUNK - 1], []
  values = None
  for cut in cuts + [None]:
    runner = run.Runner(asked(saved), out)
    out.mkdir(exist_ok=True)
    runner.open()
    if values is None:
      values = runner.config_dict()
      tables.write_json(out / "config.json", values)
    run.check_same(out, runner.config_dict())
    runner.resume()
    while not runner.done and runner.done_chunks != cut:
      runner.step()
    if cut:
      runner.save()
      runner.checkpoints.close()
      what.append(
        [int(x) < runner.done_chunks * CHUNK for x in runner.lives.each(lambda r: r.after.enter)]
      )
  run.finish(runner)
  assert not any(what[0]) and any(what[1]) and all(what[2])
  for name in ("trace", "events", "runs"):
    a, b = table(out, name), table(whole[0], name)
    assert list(a) == list(b)
    for column in set(a) - {"wall_s"}:
      assert a[column] == b[column], (name, column)


def test_an_onset_after_the_last_step_never_comes(whole, short, saved, tmp_path):
  """The life of the others until they change, and on; every alarm is false, and the onset
  undefined.
  """
  run.execute(asked(saved, onset=STEPS + 100), tmp_path)
  late, other = by_stream(tmp_path), by_stream(whole[0])
  at = min(entered(other, g) for g in range(4))
  for column in set(late) - {"fault"}:
    np.testing.assert_array_equal(late[column][:, :at], other[column][:, :at])
  assert not late["severity"].any() and (late["reward"][:, at:] != other["reward"][:, at:]).any()
  rows = table(tmp_path, "runs")
  assert (
    rows["onset"]
    == rows["latency_steps"]
    == rows["affected"]
    == rows["recovery_step"]
    == [None] * 4
  )
  assert (
    rows["false_alarms"] == late["alarm"].sum(1).tolist()
    and sum(rows["false_alarms"])
    and not events_of(tmp_path, 0, "onset")
  )
  arms = json.loads((tmp_path / "summary.json").read_text())["arms"]
  assert arms["none"]["false_alarms_per_hour"] == pytest.approx(
    sum(rows["false_alarms"][2:]) / (2 * STEPS * 0.05 / 3600)
  )


@pytest.mark.slow
def test_a_robot_that_is_spared_stays_what_it_is(whole, short, saved, tmp_path):
  """Arm `no-fault` beside others: no change, no onset, no second fault; until its first start the
  life of a car alone.
  """
  run.execute(asked(saved, arms=("no-fault", "none")), tmp_path)
  trace, rows, before = by_stream(tmp_path), table(tmp_path, "runs"), by_stream(whole[0])
  for g in (0, 1):
    assert (
      not trace["severity"][g].any()
      and not trace["fault_active"][g].any()
      and set(trace["fault"][g]) == {"none"}
    )
    assert rows["onset"][rows["stream"].index(g)] is None and not events_of(tmp_path, g, "onset")
    at = min([entered(trace, g + 2)] + [s + 1 for s, _ in events_of(tmp_path, g, "start")])
    assert (
      trace["reward"][g, :at].tobytes()
      == trace["reward"][g + 2, :at].tobytes()
      == before["reward"][g, :at].tobytes()
    )
    np.testing.assert_array_equal(
      trace["severity"][g + 2], np.arange(STEPS) >= entered(trace, g + 2)
    )
    assert rows["onset"][rows["stream"].index(g + 2)] == entered(trace, g + 2)
