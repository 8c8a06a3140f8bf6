"""The oracle stop on tables made by hand; snapshots, their evaluation, the stop's score and the
ablation in one run with a tiny agent.
"""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet
import pytest

from mjx_cl import envs, faults
from mjx_cl.adapt import decide as phase_lib
from mjx_cl.adapt.arms import ARMS, never_stops, stops
from mjx_cl.adapt.loop import Loop
from mjx_cl.config import AdaptConfig, RunConfig
from mjx_cl.envs.walker import Walker
from mjx_cl.errors import FileError, UserError
from mjx_cl.faults import presets
from mjx_cl.io import tables
from mjx_cl.keys import OfSeed
from mjx_cl.rollout.scan import Rollout, nest, start
from mjx_cl.runs import identity, loops, run, scores, settings, snapshots
from mjx_cl.runs import runner as runner_lib
from mjx_cl.runs.snapshots import Snapshots
from mjx_cl.scoring import ablation, stop_rule
from mjx_cl.training import agents

# ---- by hand -------------------------------------------------------------------------------------


def test_which_arms_are_scored_and_on_which():
  assert [name for name, arm in ARMS.items() if never_stops(arm)] == ["oracle-budget"]
  assert [name for name, arm in ARMS.items() if stops(arm)] == ["detector", "oracle"]


def test_an_abort_without_a_start_is_no_adaptation():
  """A numeric failure aborts a nominal stream too: the span of another stream is not its."""
  of = lambda stream, kind, step: {
    **{"stream": stream, "arm": "detector", "seed": stream, "since": step},
    **{"kind": kind, "step": step, "reason": kind},
  }
  assert stop_rule.spans([of(1, "abort", 6000)]) == []
  begun, ended = of(0, "start", 100), of(0, "stop", 900)
  (span,) = stop_rule.spans([begun, of(1, "abort", 6000)])
  assert (span["stop"], span["outcome"]) == (None, "adapting")
  (span,) = stop_rule.spans([begun, ended, of(0, "abort", 6000)])
  assert (span["stop"], span["outcome"]) == (900, "converged")


def test_the_oracle_stop_is_the_earliest_that_is_good_enough():
  age = [64, 1088, 2112, 3136, 4096]
  assert stop_rule.oracle(age, [0.2, 0.5, 0.76, 0.7, 0.8]) == 2  # 0.76 is 95 % of 0.8
  assert stop_rule.oracle(age, [0.2, 0.5, 0.759, 0.7, 0.8]) == 4
  assert stop_rule.oracle(age, [0.8, 0.1, 0.1, 0.1, 0.1]) == 0
  assert (
    stop_rule.oracle(age, [-9.0, -2.0, -2.1, -2.0, -3.0]) == 1
  )  # 5 % of the best's size below the best
  assert (
    stop_rule.oracle(age, [-9.0, -2.05, -2.2, -2.0, -3.0]) == 1
    and stop_rule.oracle(age, [-9.0, -2.15, -2.2, -2.0, -3.0]) == 3
  )
  with pytest.raises(ValueError, match="rise"):
    stop_rule.oracle([1, 3, 2], [1.0, 1.0, 1.0])
  assert [stop_rule.at(age, [1.0, 2.0, 3.0, 4.0, 5.0], s) for s in (0, 64, 1087, 1088, 9999)] == [
    1.0,
    1.0,
    1.0,
    2.0,
    5.0,
  ]


ALARM, TRUE = "alarm at step", "true onset at step"
FINE, BELOW = "all six signals settled, task acceptable", "settled below acceptance"


def hand():
  """Three seeds, arms none, oracle, oracle-budget, detector (streams 3 arm + seed); onset 1,000,
  the robot's life 9,000 steps.
  """
  snaps = [
    {
      "stream": 6 + seed,
      "arm": "oracle-budget",
      "seed": seed,
      "step": 999 + age,
      "since_start": age,
      "reward_mean": reward,
    }
    for seed, curve in enumerate(
      ([0.2, 0.6, 0.78, 0.8, 0.7], [0.1, 0.1, 0.12, 0.12, 0.12], [0.4, 0.3, 0.2, 0.3, 0.2])
    )
    for age, reward in zip((24, 1048, 2072, 3096, 4056), curve)
  ]
  events = []

  def lived(stream, arm, seed, since, end, kind, reason, why):
    events.append(
      {
        "stream": stream,
        "arm": arm,
        "seed": seed,
        "step": since // 64 * 64 + 63,
        "kind": "start",
        "reason": f"{why} {since}",
        "since": since,
      }
    )
    if kind:
      events.append(
        {"stream": stream, "arm": arm, "seed": seed, "step": end, "kind": kind, "reason": reason}
      )

  lived(
    3, "oracle", 0, 1000, 3583, "stop", FINE, TRUE
  )  # age 2584: 512 after the oracle stop, on the snapshot of 2072
  lived(4, "oracle", 1, 1000, 2047, "abort", BELOW, TRUE)  # age 1048: too early
  lived(5, "oracle", 2, 1000, None, None, None, TRUE)  # never ends
  for seed in range(3):
    lived(6 + seed, "oracle-budget", seed, 1000, 5055, "stop", "fixed number of steps over", TRUE)
  lived(
    9, "detector", 0, 500, 900, "stop", FINE, ALARM
  )  # a false alarm, over before the onset: not this one
  lived(9, "detector", 0, 1100, 2175, "stop", FINE, ALARM)  # age 1076: between two snapshots
  lived(10, "detector", 1, 1200, 5247, "stop", FINE, ALARM)
  lived(
    11, "detector", 2, 700, 5247, "stop", FINE, ALARM
  )  # adapting since before the onset: no start of its own after it
  none = {0: 0.2, 1: 0.1, 2: 0.95}
  final = {
    "none": none,
    "oracle": {0: 0.7, 1: 0.54, 2: 1.0},
    "oracle-budget": {0: 0.3, 1: 0.2, 2: 1.0},
    "detector": {0: 0.3, 1: 0.5, 2: 0.9},
  }
  runs = [
    {
      "stream": 3 * i + seed,
      "arm": arm,
      "seed": seed,
      "change": 0,
      "onset": 1000,
      "reward_pre": 1.0,
      "reward_final": own[seed],
      "updates": 777,
    }
    for i, (arm, own) in enumerate(final.items())
    for seed in range(3)
  ]
  updates = np.maximum(0, np.arange(9000) // 64 - 18)[None] * np.ones(
    (12, 1), int
  )  # one with every chunk, told in the row after it
  return snaps, events, runs, updates


def test_stops_by_hand():
  judged = {(r["arm"], r["seed"]): r for r in stop_rule.rows(*hand())}
  assert len(judged) == 6 and all(set(r) == set(stop_rule.COLUMNS) for r in judged.values())
  want = {
    "stream": 3,
    "since": 1000,
    "stop": 3583,
    "outcome": "converged",
    "oracle_stop_steps": 2072,
    "own_stop_steps": 2584,
    "steps_after_oracle": 512,
    "early": False,
    "reward_best": 0.8,
    "reward_oracle": 0.78,
    "reward_stop": 0.78,
    "return_lost": pytest.approx(200.0),
    "return_lost_early": 0.0,
    "lost_share": pytest.approx(0.025),
    "updates_wasted": 56 - 48,
    "aborted": False,
    "unrecoverable": False,
  }
  assert {k: judged["oracle", 0][k] for k in want} == want
  want = {
    "outcome": "aborted",
    "reason": BELOW,
    "oracle_stop_steps": 2072,
    "own_stop_steps": 1048,
    "steps_after_oracle": -1024,
    "early": True,
    "reward_stop": 0.1,
    "return_lost": pytest.approx(200.0),
    "return_lost_early": pytest.approx(200.0),
    "lost_share": pytest.approx(1 / 6),
    "updates_wasted": 0,
    "aborted": True,
    "unrecoverable": True,
  }  # 0.54 is (0.54 - 0.1) / 0.9 < 1/2 of what was lost
  assert {k: judged["oracle", 1][k] for k in want} == want
  row = judged["oracle", 2]
  assert (
    row["outcome"],
    row["oracle_stop_steps"],
    row["reward_best"],
    row["aborted"],
    row["unrecoverable"],
  ) == ("adapting", 24, 0.4, False, None)
  assert all(
    row[k] is None
    for k in (
      "stop",
      "own_stop_steps",
      "steps_after_oracle",
      "early",
      "return_lost",
      "updates_wasted",
    )
  )
  row = judged["detector", 0]  # measured from its own start
  assert (row["since"], row["own_stop_steps"], row["steps_after_oracle"], row["reward_stop"]) == (
    1100,
    1076,
    -996,
    0.6,
  )
  row = judged["detector", 1]
  assert (
    row["own_stop_steps"],
    row["steps_after_oracle"],
    row["updates_wasted"],
    row["early"],
  ) == (4048, 1976, 82 - 51, False)
  row = judged["detector", 2]
  assert (
    all(row[k] is None for k in ("since", "stop", "outcome", "aborted", "early"))
    and row["oracle_stop_steps"] == 24
  )


def test_the_last_chunk_counts_all_updates():
  snaps, events, runs, updates = hand()
  for e in events:
    if e["stream"] == 3 and e["kind"] == "stop":
      e["step"] = 8999
  assert {(r["arm"], r["seed"]): r for r in stop_rule.rows(snaps, events, runs, updates)}[
    "oracle", 0
  ]["updates_wasted"] == 777 - (48 - 18)


def test_aggregates_of_stops():
  arms = stop_rule.summarise(stop_rule.rows(*hand()))["arms"]
  own = arms["oracle"]
  assert (own["adaptations"], own["never_begun"], own["ended"], own["early"]) == (3, 0, 2, 1)
  assert own["steps_after_oracle_median"] == 512 and own["steps_after_oracle_median_ci"] == [
    -1024,
    None,
  ]  # one is later than all
  assert own["return_lost"] == pytest.approx(200.0) and own["return_lost_early"] == pytest.approx(
    100.0
  )
  assert own["lost_share"] == pytest.approx((0.025 + 1 / 6) / 2)
  assert own["updates_wasted_mean"] == (56 - 48) / 2
  assert (own["aborted_unrecoverable"], own["aborted_recoverable"], own["ended_unrecoverable"]) == (
    1,
    0,
    0,
  )
  own = arms["detector"]
  assert (own["adaptations"], own["never_begun"], own["ended"], own["early"]) == (
    2,
    1,
    2,
    1,
  ) and own["ended_unrecoverable"] == 1
  json.dumps(arms, allow_nan=False)
  for arm in arms.values():
    assert {k for k in arm if not k.endswith("_ci") and k + "_ci" not in arm} == {
      "adaptations",
      "never_begun",
      "ended",
    }


def test_a_second_adaptation_is_compared_with_its_own_snapshots():
  snaps, events, runs, updates = hand()
  snaps += [
    s | {"step": s["step"] + 6000, "reward_mean": 1 - s["reward_mean"]}
    for s in snaps
    if s["seed"] == 0
  ]
  events += [
    {
      "stream": 3,
      "arm": "oracle",
      "seed": 0,
      "step": 7039,
      "kind": "start",
      "reason": f"{TRUE} 7000",
      "since": 7000,
    },
    {"stream": 3, "arm": "oracle", "seed": 0, "step": 8047, "kind": "abort", "reason": BELOW},
  ]
  events.sort(key=lambda e: (e["stream"], e["step"]))
  judged = stop_rule.rows(snaps, events, runs, updates)
  both, of_alarms = ([r for r in judged if r["stream"] == g] for g in (3, 9))
  assert [(r["since"], r["oracle_stop_steps"]) for r in of_alarms] == [(None, 24), (1100, 2072)]
  late = [
    e | ({"since": 7100} if e["stream"] == 9 and e.get("since") == 1100 else {}) for e in events
  ]
  assert [
    r["oracle_stop_steps"]
    for r in stop_rule.rows(snaps, late, runs, updates)
    if r["stream"] == 9 and r["since"]
  ] == [24]  # of the second alone
  assert [
    (r["since"], r["oracle_stop_steps"], r["own_stop_steps"], r["outcome"]) for r in both
  ] == [(1000, 2072, 2584, "converged"), (7000, 24, 1048, "aborted")]
  assert (
    [r["unrecoverable"] for r in both] == [False, None]
    and both[1]["reward_best"] == 0.8
    and both[1]["reward_stop"] == pytest.approx(0.4)
  )


# ---- when snapshots are taken --------------------------------------------------------------------


@pytest.mark.parametrize("every", [1, 10, 64, 100, 150, 1000])
def test_due_against_a_loop(every):
  """A start at 300, the end after chunk 12: the chunks that hold 300, 300 + every, ..."""
  for c in range(20):
    now, adapting, begins = (c + 1) * 64, 4 < c <= 12, c == 4
    before = phase_lib.ADAPTING if adapting else phase_lib.NOMINAL
    got = snapshots.due(
      [before], [phase_lib.START if begins else 0], [300 if c >= 4 else 0], now, 64, every
    )
    assert got[0] == (
      (adapting or begins) and any(now - 64 <= 300 + m * every < now for m in range(2000))
    ), c


# ---- a run ---------------------------------------------------------------------------------------

LIFE, FAULT, SEED, EPISODE, EVERY = 700, 300, 3, 75, 100
FOUR = (
  "detector",
  "none",
  "oracle",
  "oracle-budget",
)  # as many streams as are computed alike to the last bit
ADAPT = AdaptConfig(
  warmup=100,
  start_windows=40,
  patience=4,
  least=64,
  trend=1e9,
  fluctuation=1e9,
  refit=100,
  budget=320,
)


class Easy(Walker):
  """A walker with short episodes whose task counts as done whatever the robot does: random weights
  can converge.
  """

  def __init__(self, physics="auto"):
    super().__init__(physics)
    self.spec = self.spec._replace(episode_steps=EPISODE, posture=None, acceptance=0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
  return tmp_path_factory.mktemp("stop")


@pytest.fixture(scope="module")
def config(tiny, folder):
  agents.save(
    folder / "agent",
    jax.jit(tiny.init)(jax.random.key(0)),
    {"env": "walker", "preset": "tiny", "repeat": 1, "dreamer": dataclasses.asdict(tiny.config)},
  )
  patch = pytest.MonkeyPatch()
  patch.setitem(envs.ENVS, "walker", Easy)
  patch.setattr(snapshots, "BATCH", 3)  # four snapshots are two batches
  kept, program = (
    {},
    Snapshots._program,
  )  # every run of this module is of one configuration, and shares what is compiled
  patch.setattr(runner_lib, "Rollout", lambda *args: kept.setdefault("rollout", Rollout(*args)))
  patch.setattr(
    loops, "Loop", lambda *args, **settings: kept.setdefault("loop", Loop(*args, **settings))
  )
  patch.setattr(Snapshots, "_program", lambda self: kept.setdefault("program", program(self)))
  yield RunConfig(
    "walker",
    onset=FAULT,
    steps=LIFE,
    seeds=1,
    first_seed=SEED,
    detector="rolling_sigma_plain",
    settings=dict(window=100, warmup=30),
    physics="native",
    arms=FOUR,
    agent=str(folder / "agent"),
    snapshots=EVERY,
    adapt=ADAPT,
  )
  patch.undo()


@pytest.fixture(scope="module")
def lived(config, folder):
  """(folder of a run, {step: what the never-stopped robot acted by after each chunk}), and the
  snapshots kept aside.
  """
  out, acted = folder / "whole", {}
  patch = pytest.MonkeyPatch()
  step, evaluate = run.Runner.step, Snapshots.evaluate

  def watched(self):
    progress = step(self)
    for band in self.lives.bands:
      if band.acting is not None:  # what acts is never out of date
        jax.tree.map(np.testing.assert_array_equal, band.acting, self.lives._acting(band))
    weights = self.lives.acting(3)
    acted[progress.step - 1] = jax.tree.map(np.array, {k: weights[k] for k in snapshots.ACTS})
    return progress

  def kept(self, wanted, targets, tell):
    acted["files"] = {s.step: self._read(s) for s in wanted}
    acted["names"] = sorted(p.name for p in self.folder.iterdir())
    acted["targets"] = targets
    return evaluate(self, wanted, targets, tell)

  patch.setattr(run.Runner, "step", watched)
  patch.setattr(Snapshots, "evaluate", kept)
  run.execute(config, out)
  patch.undo()
  return out, acted


def table(out, name):
  return pyarrow.parquet.read_table(out / f"{name}.parquet").to_pylist()


def test_snapshots_are_what_acted(lived, same):
  out, acted = lived
  rows = table(out, "snapshots")
  steps = [
    383 - 64,
    447,
    511,
    639,
  ]  # chunks that hold 300, 400, 500 and 600; it ends with that of 300 + 320
  assert [r["step"] for r in rows] == steps and [r["since_start"] for r in rows] == [
    s + 1 - FAULT for s in steps
  ]
  assert (
    all((r["stream"], r["arm"], r["seed"]) == (3, "oracle-budget", SEED) for r in rows)
    and list(acted["files"]) == steps
  )
  assert acted["names"] == [f"0003-{s:09d}.npz" for s in steps]
  for s in steps:
    assert same(acted["files"][s], acted[s]), s
  assert not same(acted[319], acted[511]) and not same(acted[511], acted[639])
  assert not (out / "work").exists()


def test_each_is_evaluated_on_the_broken_robot_with_the_same_keys(lived, config):
  """Against a loop over episodes, each alone, from the definition."""
  out, acted = lived
  env = envs.make("walker", "native")
  agent = agents.load(config.agent, "walker", 24, 6).agent
  broken = faults.make("gear", env)
  rollout = Rollout(env, agent, broken)
  target = broken.targets.index(table(out, "runs")[3]["fault"].split(":")[1])
  keys = jax.random.split(jax.random.fold_in(jax.random.key(SEED), OfSeed.SNAPSHOTS), 5)

  def returns(params, severity, key):
    stream = nest(lambda k: start(env, agent, broken, k, severity, 0, target=target), 0, 0)(
      key[None, None]
    )
    _, rows = rollout.chunk(jax.tree.map(lambda x: jnp.asarray(x)[None], params), stream, EPISODE)
    assert (
      bool(rows.truncated[-1, 0, 0]) and (np.asarray(rows.severity) == np.float32(severity)).all()
    )
    return float(np.asarray(rows.reward, np.float64).sum())

  for row in table(out, "snapshots")[1::2]:
    got = [row[f"return_{i}"] for i in range(5)]
    want = [returns(acted["files"][row["step"]], 0.5, k) for k in keys]
    # another order of float32 sums: a robot that falls makes much of it, so most of the keys count
    assert np.median(np.abs(np.subtract(got, want))) < 0.01, (got, want)
    assert row["steps"] == 5 * EPISODE and row["reward_mean"] == pytest.approx(
      sum(got) / (5 * EPISODE)
    )
  healthy = [returns(acted["files"][639], 0.0, k) for k in keys]
  # twice what is allowed above: neither the healthy robot nor one key for all would pass
  assert np.median(np.abs(np.subtract(healthy, want))) > 0.02, (healthy, want)
  assert np.median(np.abs(np.subtract(want, want[0]))) > 0.02, want


def test_the_stop_is_scored_from_the_files(lived):
  out, _ = lived
  judged, summary = table(out, "stop"), json.loads((out / "summary.json").read_text())
  assert [(r["arm"], r["seed"]) for r in judged] == [("detector", SEED), ("oracle", SEED)]
  snaps, updates = (
    table(out, "snapshots"),
    tables.read_table(out / "trace.parquet")["updates"].reshape(4, LIFE),
  )
  ends = [e["step"] for e in table(out, "events") if e["arm"] == "oracle" and e["kind"] == "stop"]
  row, best = judged[1], max(s["reward_mean"] for s in snaps)
  first = next(s for s in snaps if s["reward_mean"] >= 0.95 * best)
  last = [s for s in snaps if s["step"] <= ends[0]][-1]
  assert (
    row["stop"] == ends[0] == 575
    and row["own_stop_steps"] == 276
    and row["oracle_stop_steps"] == first["since_start"]
  )
  assert row["reward_stop"] == last["reward_mean"] and row["return_lost"] == pytest.approx(
    (best - last["reward_mean"]) * stop_rule.HORIZON
  )
  assert (
    row["updates_wasted"] == max(0, int(updates[2, 576]) - int(updates[2, first["step"] + 1]))
    and updates[2, 576] > 0
  )
  assert (
    summary["stop_rule"] == json.loads(json.dumps(stop_rule.summarise(judged)))
    and summary["wall_s_snapshots"] > 0
  )
  assert stop_rule.of_folder(out) == judged


def test_the_rule_without_a_signal(lived):
  """Nothing left out: the stop of arm oracle, which lived the same life until then."""
  out, _ = lived
  trace = tables.read_table(out / "trace.parquet")["reward"].reshape(4, LIFE)
  assert trace[2, :576].tobytes() == trace[3, :576].tobytes()
  rows = ablation.ablation(out)
  assert [r["left_out"] for r in rows] == [
    "",
    "opr",
    "rpr",
    "reward",
    "dyn_loss",
    "adv_mag",
    "value_loss",
  ]
  span = next(s for s in stop_rule.spans(table(out, "events")) if s["arm"] == "oracle")
  judged = table(out, "stop")[1]
  assert {k: rows[0][k] for k in ("seed", "stop", "outcome", "reason")} == {
    k: span[k] for k in ("seed", "stop", "outcome", "reason")
  }
  shared = (
    "own_stop_steps",
    "oracle_stop_steps",
    "steps_after_oracle",
    "early",
    "reward_stop",
    "return_lost",
    "lost_share",
  )
  assert {k: rows[0][k] for k in shared} == {k: judged[k] for k in shared}
  assert scores.scores(out)["ablation"] == ablation.ablated(rows) and list(
    ablation.ablated(rows)
  ) == [r["left_out"] for r in rows]


def test_aggregates_of_the_ablation_by_hand():
  """Four adaptations without the reward: stops at 100 and 300, an abort at 500, one that never
  ends; three of them have snapshots.
  """
  row = lambda outcome, at, early, lost: {
    "left_out": "reward",
    "outcome": outcome,
    "stop": at,
    "own_stop_steps": at,
    "early": early,
    "lost_share": lost,
  }
  rows = [
    row("converged", 100, True, 0.2),
    row("converged", 300, False, 0.0),
    row("aborted", 500, True, 0.1),
    row("adapting", None, None, None),
  ]
  got = ablation.ablated(rows + [dict(rows[0], left_out="")])
  assert (
    list(got) == ["reward", ""]
    and got["reward"]["adaptations"] == 4
    and (got["reward"]["converged"], got["reward"]["aborted"]) == (2, 1)
  )
  assert (
    got["reward"]["own_stop_steps_median"] == 300
    and got["reward"]["own_stop_steps_median_ci"][1] is None
  )  # of 100, 300, 500 and never
  assert (got["reward"]["judged"], got["reward"]["early"]) == (3, 2) and got["reward"][
    "lost_share"
  ] == pytest.approx(0.1)
  assert (
    got[""]["lost_share"] == 0.2
    and ablation.ablated([dict(rows[3], left_out="")])[""]["lost_share"] is None
  )


@pytest.mark.slow
def test_evaluation_that_is_cut_off_goes_on(config, folder, lived, monkeypatch):
  """Killed in the run, interrupted in the second batch: neither lost nor twice, and the first batch
  is not lived again.
  """
  out, runner = folder / "cut", None
  runner = run.Runner(config, out)
  out.mkdir()
  runner.open()
  tables.write_json(out / "config.json", runner.config_dict())
  for c in range(8):
    runner.step()
    if c == 6:
      runner.save()
  # chunk 7, with its snapshot, is lost to the checkpoint and lived again
  runner.checkpoints.close()
  assert len(list((out / "work" / "snapshots").iterdir())) == 3
  live, batches = Snapshots._live, []

  def counted(self, program, batch, targets, interrupt):
    batches.append([s.step for s in batch])
    if len(batches) == 2:
      raise KeyboardInterrupt
    return live(self, program, batch, targets, interrupt)

  monkeypatch.setattr(Snapshots, "_live", counted)
  with pytest.raises(KeyboardInterrupt):
    run.execute(config, out, resume=True)
  assert (
    not (out / "summary.json").exists()
    and (out / "work" / "snapshots" / "scores-000000.npz").exists()
  )
  monkeypatch.setattr(run.Runner, "step", None)  # no chunk is lived again
  run.execute(config, out, resume=True)
  assert (
    [len(b) for b in batches] == [3, 3, 3] and batches[1] == batches[2] and batches[0] != batches[1]
  )
  for name in ("snapshots", "signals", "events"):
    assert table(out, name) == table(lived[0], name), name
  assert not (out / "work").exists()


# ---- ablation by hand ----------------------------------------------------------------------------


def test_leaving_out_the_signal_that_holds_up_the_stop(tmp_path):
  """Seed 0: the value loss rises until chunk 40, all else is flat. Seed 1: it rises to the end, and
  the reward never reaches acceptance.
  """
  config = AdaptConfig(patience=4, least=1, give_up=60 * 64, budget=100 * 64, warmup=64)
  tables.write_json(tmp_path / "config.json", {"adapt": dataclasses.asdict(config)})
  tables.write_table(
    tmp_path / "events.parquet",
    {
      "stream": [0, 1],
      "arm": ["oracle-budget"] * 2,
      "seed": [0, 1],
      "step": [383, 383],
      "kind": ["start"] * 2,
      "reason": [f"{TRUE} 330"] * 2,
    },
  )
  chunks = np.arange(90)
  loss = np.where(chunks < 40, 1.4 ** np.minimum(chunks, 40.0), 1.4**40)
  columns = {
    "stream": np.repeat([0, 1], 90),
    "step": np.tile(chunks * 64 + 63, 2),
    "opr": np.ones(180),
    "rpr": np.ones(180),
    "reward": np.repeat([0.8, 0.3], 90),
    "dyn_loss": np.ones(180),
    "adv_mag": np.ones(180),
    "value_loss": np.concatenate([loss, 1.4**chunks]),
    "posture": np.ones(180),
    "acceptance": np.full(180, 0.6),
    "least_posture": np.full(180, np.nan),
  }
  tables.write_table(tmp_path / "signals.parquet", columns)
  rows = {(r["seed"], r["left_out"]): r for r in ablation.ablation(tmp_path)}
  assert len(rows) == 14
  # the start falls into chunk 5; the ring of four is full with chunk 9
  late = rows[0, ""]["stop"]
  assert (
    40 * 64 < late < 45 * 64
    and rows[0, "value_loss"]["stop"] == 10 * 64 - 1
    and rows[0, "value_loss"]["own_stop_steps"] == 10 * 64 - 330
  )
  assert {r["stop"] for (seed, left), r in rows.items() if seed == 0 and left != "value_loss"} == {
    late
  }
  other = {
    (r["seed"], r["left_out"]): r["stop"]
    for r in ablation.ablation(tmp_path, patience=8, least=20 * 64)
  }
  assert (
    other[0, "value_loss"] == 26 * 64 - 1
  )  # the first chunk whose end lies `least` after the start in step 330
  assert other[0, ""] > late
  with pytest.raises(UserError, match="no budget; choose from: patience, trend"):
    ablation.ablation(tmp_path, budget=5)
  again = ablation.ablation(tmp_path, regain=0.9)  # of 0.8, and of 0.3 before: not below the task's
  assert [r["stop"] for r in again] == [r["stop"] for r in rows.values()]
  half = np.where(np.tile(chunks, 2) < 5, 1.0, 0.7)  # 0.7 of 1.0: not what is asked for
  tables.write_table(tmp_path / "signals.parquet", columns | {"reward": half})
  ends = lambda **rule: {
    r["outcome"] for r in ablation.ablation(tmp_path, **rule) if r["seed"] == 0
  }
  assert ends(regain=0.6) == ends() == {"converged"} and ends(regain=0.9) == {"aborted"}
  tables.write_table(tmp_path / "signals.parquet", columns)
  assert all(r["outcome"] == "converged" for (seed, _), r in rows.items() if seed == 0)
  assert all(
    r["outcome"] == "aborted" for (seed, _), r in rows.items() if seed == 1
  )  # acceptance is still asked for
  reasons = {left: r["reason"] for (seed, left), r in rows.items() if seed == 1}
  assert reasons == dict.fromkeys(reasons, "no settling in sight") | {"value_loss": BELOW}
  with pytest.raises(FileError, match="signals"):
    (tmp_path / "signals.parquet").unlink()
    ablation.ablation(tmp_path)


# ---- what is refused -----------------------------------------------------------------------------


def test_bad_settings_are_refused(config, folder, monkeypatch):
  with pytest.raises(UserError, match="needs an arm that never stops by itself: oracle-budget"):
    settings.check(RunConfig("walker", snapshots=1000))
  with pytest.raises(UserError, match="snapshots must lie in 0"):
    RunConfig("walker", arms=("oracle-budget",), snapshots=-1)
  monkeypatch.setattr(snapshots, "LIMIT_MIB", 1)
  with pytest.raises(
    UserError, match="snapshots=100 would take up to .* MiB on the disk, 1 may be used; snapshots="
  ) as e:
    run.Runner(config, folder / "never")
  fits = int(str(e.value).split("snapshots=")[2].split()[0])
  make = lambda every: (
    run.Runner(dataclasses.replace(config, snapshots=every), folder / "never").snapshots
  )
  assert make(fits).bytes > 0 and fits > 100
  with pytest.raises(UserError):
    make(fits - 1)
  assert not (folder / "never").exists()


def test_a_run_begun_before_there_were_snapshots_goes_on(tmp_path):
  (tmp_path / "config.json").write_text(json.dumps({"env": "walker"}))
  run.check_same(tmp_path, {"env": "walker", "snapshots": 0})
  with pytest.raises(UserError, match="another snapshots"):
    run.check_same(tmp_path, {"env": "walker", "snapshots": 5})


def test_a_setting_of_adapt_that_did_not_exist_when_the_run_began(tmp_path):
  now = dataclasses.asdict(AdaptConfig())
  tables.write_json(
    tmp_path / "config.json", {"adapt": {k: v for k, v in now.items() if k != "policy_lr"}}
  )
  run.check_same(tmp_path, {"adapt": now})
  with pytest.raises(UserError, match="another adapt"):
    run.check_same(tmp_path, {"adapt": {**now, "policy_lr": 0.5}})


def test_a_fault_that_is_not_there_yet_is_not_evaluated(config, tmp_path):
  make = lambda **kw: Snapshots.severities.__get__(type("S", (), kw)())
  of = make(
    config=dataclasses.replace(config, onset=500),
    changes=presets.changes(dataclasses.replace(config, duration=200)),
  )
  assert [of(since) for since in (499, 500, 699, 700)] == [[0.0], [0.5], [0.5], [0.0]]


# ---- an arm that is told its stop ----------------------------------------------------------------


def test_told_is_the_oracle_stop_of_each_seed(tmp_path):
  told = lambda **changes: stop_rule.told(
    RunConfig(
      **dict(env="walker", arms=("oracle-stop", "none"), seeds=2, first_seed=4, stops=str(tmp_path))
      | changes
    )
  )
  with pytest.raises(FileError, match="holds no run"):
    told()
  tables.write_json(
    tmp_path / "config.json",
    {
      "env": "walker",
      "fault": "gear",
      "onset": 5000,
      "agent": None,
      "adapt": {"ratio": 16.0, "lr": 1e-4, "patience": 3},
    },
  )
  with pytest.raises(FileError, match="no snapshots.parquet; run arm oracle-budget"):
    told()
  tables.write_table(
    tmp_path / "snapshots.parquet",
    {
      "arm": ["oracle-budget"] * 7 + ["mine.py:endless"] * 3,
      "seed": [4] * 3 + [5] * 3 + [9] + [4, 4, 11],
      "since_start": [3000, 24, 1000] * 2 + [24] + [3000, 24, 24],
      "reward_mean": [1.0, 0.5, 0.96, 0.1, 0.99, 0.2, 1.0, 9.0, 9.0, 9.0],
    },
  )
  assert told() == {4: 1000, 5: 24}  # the first of 95 % of the best; nothing gained from adapting
  assert told(arms=("none",), stops=None) == {}
  with pytest.raises(UserError, match="no snapshots of seed 6, 7; it has 4, 5, 9"):
    told(seeds=4)
  for wrong, text in (
    (dict(onset=4000), "another onset"),
    (dict(fault="slope"), "another fault"),
    (dict(agent="walker-plain"), "another agent"),
    (dict(adapt=AdaptConfig(ratio=64)), "another adapt.ratio"),
  ):
    with pytest.raises(UserError, match=text):
      told(**wrong)
  assert told(adapt=AdaptConfig(budget=77, patience=5)) == told()  # what ends adaptation may differ
  other = tables.read_json(tmp_path / "config.json") | {"agent_card": {"updates": 7}}
  tables.write_json(tmp_path / "config.json", other)
  values = {"oracle_stops": {"4": 1000}, "agent_card": {"updates": 8}}
  own = RunConfig("walker", arms=("oracle-stop",), stops=str(tmp_path))
  with pytest.raises(UserError, match="another agent .updates."):
    identity.check_told(own, values)
  identity.check_told(own, values | {"agent_card": {"updates": 7, "new": 1}})
  tables.write_json(tmp_path / "config.json", other | {"benchmark": 9})
  with pytest.raises(UserError, match="another benchmark"):
    told()


def test_an_arm_that_is_told_needs_to_be(config):
  for wrong, text in (
    (dict(stops=None), "needs stops"),
    (dict(arms=("oracle",)), "needs an arm that ends there: oracle-stop"),
    (dict(fault="car/transfer-then-socks", env="car", severity=None), "changes once"),
  ):
    with pytest.raises(UserError, match=text):
      settings.check(
        dataclasses.replace(config, **dict(arms=("oracle-stop",), snapshots=0, stops="x") | wrong)
      )
  together = dataclasses.replace(
    config, arms=("oracle-stop",), snapshots=0, stops="x", fault="any/all-easy", severity=None
  )
  assert len(presets.changes(together)) > 1  # several faults at once are one change


def test_it_lives_as_the_one_that_never_stops_until_then(lived, config, folder):
  out, acted = lived
  told = folder / "told"
  run.execute(
    dataclasses.replace(config, arms=FOUR[:3] + ("oracle-stop",), snapshots=0, stops=str(out)), told
  )
  end = json.loads((told / "config.json").read_text())["oracle_stops"][str(SEED)]
  curve = table(out, "snapshots")
  ages, rewards = ([s[k] for s in curve] for k in ("since_start", "reward_mean"))
  assert end == max(1, ages[stop_rule.oracle(ages, rewards)])
  ends = [
    (e["step"], e["reason"])
    for e in table(told, "events")
    if e["arm"] == "oracle-stop" and e["kind"] == "stop"
  ]
  assert [step for step, _ in ends] == [
    next(c for c in range(383, LIFE, 64) if c + 1 - FAULT > end)
  ]  # it begins in the chunk before 383, and can end with the next
  rows = lambda folder, arm: [
    (r["reward"], r["opr"], r["updates"]) for r in table(folder, "trace") if r["arm"] == arm
  ]
  mine, endless = rows(told, "oracle-stop"), rows(out, "oracle-budget")
  assert mine[: ends[0][0] + 1] == endless[: ends[0][0] + 1] and rows(told, "none") == rows(
    out, "none"
  )
  assert mine[-1][2] == max(m[2] for m in mine[: ends[0][0] + 2]) and (mine != endless) == (
    ends[0][0] + 1 - FAULT < 320
  )
