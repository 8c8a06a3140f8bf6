"""`run` end to end with a tiny agent of random weights on a walker that is easily pleased; kill and
resume; agents' files; `eval`.
"""

import contextlib
import dataclasses
import functools
import io
import json
import math
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import time
import warnings

import jax
import numpy as np
import pyarrow.parquet
import pytest

from mjx_cl import envs
from mjx_cl.cli import app, runs
from mjx_cl.config import CHUNK, AdaptConfig, RunConfig
from mjx_cl.dreamer.agent import Agent
from mjx_cl.envs.walker import Walker
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import tables
from mjx_cl.render import figures
from mjx_cl.runs import identity, run, runner, workers
from mjx_cl.runs.run import ledger_of
from mjx_cl.runs.runner import KINDS
from mjx_cl.scoring import events, intervals
from mjx_cl.training import agents, evaluate

STEPS, ONSET, EPISODE, SEEDS = 700, 300, 150, (3, 4)
ENDS = [
  min(STEPS, (i + 1) * CHUNK) - 1 for i in range(-(-STEPS // CHUNK))
]  # last step of each chunk
# nominal levels from step 100, an alarm at any sample beyond three deviations of the last 100,
# settled four chunks after it
ARGS = [
  "run",
  "walker",
  "--steps",
  str(STEPS),
  "--onset",
  str(ONSET),
  "--seeds",
  "2",
  "--first-seed",
  "3",
  "--detector",
  "rolling_sigma_plain",
  "--set",
  "window=100",
  "warmup=30",
  "--adapt.warmup",
  "100",
  "--adapt.start-windows",
  "40",
  "--adapt.patience",
  "4",
  "--adapt.least",
  "64",
  "--adapt.trend",
  "1e9",
  "--adapt.fluctuation",
  "1e9",
  "--adapt.refit",
  "100",
  "--keep",
  "--parts",
  "--residuals",
  "--json",
]


class Easy(Walker):
  """A walker with short episodes whose task counts as done whatever the robot does: random weights
  can converge.
  """

  def __init__(self, physics="auto"):
    super().__init__(physics)
    self.spec = self.spec._replace(episode_steps=EPISODE, posture=None, acceptance=0.0)


def child(argv, save_every_s):
  """`mjx-cl` with the easy walker, for a process of its own."""
  envs.ENVS["walker"] = Easy
  run.execute = functools.partial(run.execute, save_every_s=save_every_s)
  sys.exit(app.main(argv))


def spawn(argv, save_every_s=60.0):
  code = f"import sys, test_run; test_run.child(sys.argv[1:], {save_every_s})"
  here = pathlib.Path(__file__).parent
  return subprocess.Popen(
    [sys.executable, "-c", code, *argv],
    cwd=here,
    stdout=subprocess.PIPE,
    stderr=subprocess.PIPE,
    text=True,
  )


@pytest.fixture(scope="session")
def saved(tiny, tmp_path_factory):
  """Folder of a tiny walker agent with random weights, whose last stage held model and policy."""
  folder = tmp_path_factory.mktemp("agents") / "tiny"
  held = dataclasses.asdict(tiny.config) | {"model_lr": 0.0, "policy_lr": 1e-6}
  agents.save(
    folder,
    jax.jit(tiny.init)(jax.random.key(0)),
    {"env": "walker", "preset": "tiny", "repeat": 1, "dreamer": held},
  )
  return folder


@pytest.fixture(scope="module")
def whole(saved, tmp_path_factory):
  """An uninterrupted run in this process: (folder, standard output, standard error)."""
  out = tmp_path_factory.mktemp("runs") / "whole"
  before = signal.getsignal(signal.SIGTERM)
  with (
    pytest.MonkeyPatch.context() as patch,
    contextlib.redirect_stdout(io.StringIO()) as stdout,
    contextlib.redirect_stderr(io.StringIO()) as stderr,
  ):
    patch.setitem(envs.ENVS, "walker", Easy)
    code = app.main(ARGS + ["--agent", str(saved), "--out", str(out)])
  signal.signal(signal.SIGTERM, before)
  assert code == 0, stderr.getvalue()
  return out, stdout.getvalue(), stderr.getvalue()


def table(folder, name):
  """Columns of a result file as lists, null as None."""
  return pyarrow.parquet.read_table(folder / f"{name}.parquet").to_pydict()


def by_stream(folder):
  """trace.parquet as {column: (streams, steps)}; null in a number is nan."""
  trace = tables.read_table(folder / "trace.parquet")
  return {k: v.reshape(4, STEPS) for k, v in trace.items()}


def of_stream(folder, stream, *kinds):
  """Events (step, reason) of one stream."""
  e = table(folder, "events")
  return [
    (s, r)
    for g, s, k, r in zip(e["stream"], e["step"], e["kind"], e["reason"])
    if g == stream and k in kinds
  ]


# ---- files ---------------------------------------------------------------------------------------


def test_all_files_are_there_with_their_columns(whole):
  out, _, _ = whole
  assert sorted(os.listdir(out)) == [
    "agents",
    "config.json",
    "events.parquet",
    "figure.png",
    "residuals.parquet",
    "runs.parquet",
    "summary.json",
    "trace.parquet",
  ]
  assert list(table(out, "trace")) == [
    "stream",
    "arm",
    "seed",
    "fault",
    "step",
    "episode",
    "phase",
    "fault_active",
    "severity",
    "reward",
    "opr",
    "rpr",
    "score",
    "alarm",
    "terminated",
    "truncated",
    "valid",
    *(f"residual_{name}" for name, _ in envs.make("walker").spec.watched),
    "dyn_loss",
    "adv_mag",
    "value_loss",
    "updates",
  ]
  assert list(table(out, "events")) == list(events.COLUMNS)
  assert {
    "arm",
    "onset",
    "alarm_step",
    "latency_steps",
    "latency_s",
    "false_alarms",
    "adapt_start",
    "adapt_stop",
    "outcome",
    "recovery_step",
    "stable_step",
    "reward_pre",
    "reward_drop",
    "reward_final",
    "return_lost",
    "terminations",
    "updates",
    "wall_s",
  } <= set(table(out, "runs"))


def test_residuals_of_the_parts_are_known_where_opr_is(whole):
  """`--parts`. The mean residual of some variables bounds OPR, the mean over all, from below."""
  rows, spec = by_stream(whole[0]), envs.make("walker").spec
  known = rows["valid"]
  assert 0 < known.mean() < 1
  for name, at in spec.watched:
    part = rows[f"residual_{name}"]
    np.testing.assert_array_equal(np.isfinite(part), known)
    least = min(spec.obs[i].scale for i in at)
    assert (part[known] >= 0).all() and (
      part[known] * least * len(at) / len(spec.obs) <= rows["opr"][known] * (1 + 1e-4)
    ).all()  # float32 sums


def test_residuals_of_the_variables_have_opr_for_their_mean(whole):
  rows, spec = by_stream(whole[0]), envs.make("walker").spec
  table = tables.read_table(whole[0] / "residuals.parquet")
  names = [v.name for v in spec.obs]
  signed = [f"innovation_{name}" for name in (*names, "reward")]
  assert list(table) == ["stream", "arm", "seed", "step", *names, *signed]
  assert np.array_equal(table["step"], np.tile(np.arange(STEPS), 4))
  ahead = np.stack([table[name] for name in signed])
  assert np.isfinite(ahead).all()  # a fresh agent foresees no reward, whose error has one sign
  assert (ahead[:-1] < 0).any(1).all() and (ahead[:-1] > 0).any(1).all()
  values = np.stack([table[name].reshape(4, STEPS) for name in names], -1)
  np.testing.assert_array_equal(np.isfinite(values).all(-1), rows["valid"])
  np.testing.assert_allclose(
    values.mean(-1)[rows["valid"]], rows["opr"][rows["valid"]], rtol=1e-5
  )  # float32 sums


def test_each_part_has_its_own_column(saved, tmp_path):
  """A chunk whose parts hold their own number, in the order of monitor.watched."""
  runner = run.Runner(
    RunConfig("walker", steps=64, onset=32, seeds=2, arms=("none",), agent=str(saved), parts=True),
    tmp_path,
  )
  shape = lambda *more: np.zeros((64, 2, *more), np.float32)
  trace = {
    k: shape()
    for k in (
      "reward",
      "severity",
      "episode",
      "terminated",
      "truncated",
      "opr",
      "rpr",
      "valid",
      "score",
      "alarm",
      "updates",
    )
  }
  trace |= {
    "phase": np.zeros((64, 2), np.int8),
    "signals": np.zeros((1, 2, 6)),
    "parts": shape(8) + np.arange(8) + 100 * np.arange(2)[:, None],
  }
  table = ledger_of(runner).trace(trace)
  for k, (name, at) in enumerate(runner.env.spec.watched):
    assert at
    np.testing.assert_array_equal(table[f"residual_{name}"], np.repeat([k, 100 + k], 64))


def test_config_tells_how_it_was_made(whole, saved):
  config = json.loads((whole[0] / "config.json").read_text())
  assert [config[k] for k in ("command", "env", "severity", "onset", "arms")] == [
    "run",
    "walker",
    0.5,
    ONSET,
    ["detector", "none"],
  ]
  assert (
    config["settings"] == {"window": 100, "warmup": 30}
    and config["adapt"]["patience"] == 4
    and config["physics"] in ("native", "mjx")
  )
  assert (
    config["versions"]["jax"] == jax.__version__
    and config["machine"]["cores"] == len(workers.cores())
    and "git_commit" in config
  )
  assert config["agent_card"] == json.loads((saved / "card.json").read_text())


def test_standard_output_is_one_json_value(whole):
  out, stdout, stderr = whole
  assert (
    json.loads(stdout) == json.loads((out / "summary.json").read_text()) and stdout.count("\n") == 1
  )
  assert f"{STEPS}/{STEPS}" in stderr  # progress goes there


def test_summary_has_every_aggregate_with_its_interval(whole):
  summary = json.loads((whole[0] / "summary.json").read_text())
  assert set(summary["arms"]) == {"detector", "none"}
  for arm in summary["arms"].values():
    for name in (
      "alarms",
      "false_alarm_streams",
      "latency_median_steps",
      "miss_probability",
      "converged",
      "aborted_by_rule",
      "aborted_by_budget",
      "recovered",
      "recovery_median_steps",
      "reward_pre",
      "reward_drop",
      "reward_final",
      "return_lost",
    ):
      ci = arm[name + "_ci"]
      assert name in arm and (ci is None or len(ci) == 2)
      if arm[name] is not None and ci is not None and None not in ci:
        assert ci[0] <= arm[name] <= ci[1], name
    assert arm["seeds"] == 2 and 0 <= arm["affected"] <= 2
  assert all(
    summary[k] == v for k, v in summary["arms"]["detector"].items()
  )  # stands at the top level too
  assert tuple(summary["wall_share"]) == KINDS
  assert sum(summary["wall_share"].values()) == pytest.approx(1.0)
  assert summary["wall_s"] > 0 and 0 <= summary["invalid_share"] < 0.5


def test_figure_is_a_png(whole):
  content = (whole[0] / "figure.png").read_bytes()
  assert content.startswith(b"\x89PNG\r\n\x1a\n") and len(content) > 20_000


# ---- what happened -------------------------------------------------------------------------------


def test_trace_rows(whole):
  trace = by_stream(whole[0])
  assert (trace["step"] == np.arange(STEPS)).all()
  assert [list(trace[k][:, 0]) for k in ("stream", "arm", "seed")] == [
    [0, 1, 2, 3],
    ["detector"] * 2 + ["none"] * 2,
    [3, 4, 3, 4],
  ]
  np.testing.assert_array_equal(
    trace["severity"], np.broadcast_to(np.where(np.arange(STEPS) >= ONSET, 0.5, 0.0), (4, STEPS))
  )
  np.testing.assert_array_equal(trace["fault_active"], trace["severity"] > 0)
  np.testing.assert_array_equal(
    trace["episode"], np.broadcast_to(np.arange(STEPS) // EPISODE, (4, STEPS))
  )
  np.testing.assert_array_equal(
    trace["truncated"], np.broadcast_to(np.arange(STEPS) % EPISODE == EPISODE - 1, (4, STEPS))
  )
  assert not trace["terminated"].any() and ((trace["reward"] >= 0) & (trace["reward"] <= 1)).all()
  for name in ("opr", "rpr"):
    np.testing.assert_array_equal(np.isfinite(trace[name]), trace["valid"])
  assert not trace["valid"][:, :14].any() and trace["valid"][:, 14:].mean() > 0.9
  for name in ("dyn_loss", "adv_mag", "value_loss"):
    assert [list(np.flatnonzero(np.isfinite(x))) for x in trace[name]] == [ENDS] * 4


def test_onset_and_alarms_are_events(whole):
  out, trace = whole[0], by_stream(whole[0])
  faults = trace["fault"][:, 0]
  assert all(
    f.startswith("gear:") and f.split(":")[1] in Easy("native").spec.targets for f in faults
  ) and list(faults[:2]) == list(faults[2:])
  for g in range(4):
    assert of_stream(out, g, "onset") == [(ONSET, "severity 0.5")]
    alarms = of_stream(out, g, "alarm")
    assert [s for s, _ in alarms] == list(np.flatnonzero(trace["alarm"][g])) and alarms
    assert all(("before onset: a false alarm" in r) == (s < ONSET) for s, r in alarms)
    assert all("acted on" in r for _, r in alarms)
  kinds = set(table(out, "events")["kind"])
  assert (
    kinds <= {"onset", "alarm", "start", "stop", "abort", "repair"} and {"start", "stop"} <= kinds
  )


def test_starts_and_stops_have_their_reasons(whole):
  out, trace = whole[0], by_stream(whole[0])
  for g in (0, 1):
    starts, stops = of_stream(out, g, "start"), of_stream(out, g, "stop", "abort")
    assert starts and all(r == "all six signals settled, task acceptable" for _, r in stops)
    acted = [s for s, r in of_stream(out, g, "alarm") if r.startswith("acted on")]
    assert [r for _, r in starts] == [f"alarm at step {s}" for s in acted] and min(
      acted
    ) >= 100  # never in the warm-up
    for (end, _), alarm in zip(starts, acted):
      assert end == min(e for e in ENDS if e >= alarm)  # decided at the end of the chunk
    for (start, _), (stop, _) in zip(starts, stops):
      assert stop == min(start + 4 * CHUNK, STEPS - 1)
      assert set(trace["phase"][g, start + 1 : stop + 1]) == {"adapting"}
    first = starts[0][0]
    assert (
      set(trace["phase"][g, : first + 1]) == {"nominal"}
      and (trace["updates"][g, : first + 1] == 0).all()
    )
    assert trace["updates"][g, -1] > 0 and (np.diff(trace["updates"][g]) >= 0).all()
  for g in (2, 3):
    assert (
      not of_stream(out, g, "start", "stop", "abort")
      and set(trace["phase"][g]) == {"nominal"}
      and not trace["updates"][g].any()
    )
    assert all("arm does not adapt" in r for _, r in of_stream(out, g, "alarm"))


def test_both_arms_live_the_same_life_until_an_alarm_is_acted_on(whole):
  out, trace = whole[0], by_stream(whole[0])
  for g in (0, 1):
    first = of_stream(out, g, "start")[0][0] + 1
    for name in ("reward", "opr", "rpr", "score", "alarm"):
      assert trace[name][g, :first].tobytes() == trace[name][g + 2, :first].tobytes(), name
    assert (
      trace["reward"][g, first + CHUNK :] != trace["reward"][g + 2, first + CHUNK :]
    ).any()  # then finetuning tells


def test_runs_are_sums_of_the_trace(whole):
  out, trace = whole[0], by_stream(whole[0])
  rows = table(out, "runs")
  for g in range(4):
    row = {k: v[g] for k, v in rows.items()}
    reward, alarms = trace["reward"][g].astype(float), np.flatnonzero(trace["alarm"][g])
    busy = trace["phase"][g][ONSET] == "adapting"  # kept apart from latency
    after = alarms[(alarms >= ONSET) & (not busy)]
    assert row["adapting_at_onset"] == busy
    assert (
      row["alarm_step"] == (after[0] if len(after) else None)
      and row["false_alarms"] == (alarms < ONSET).sum()
    )
    if len(after):
      assert row["latency_steps"] == after[0] - ONSET and row["latency_s"] == pytest.approx(
        0.025 * (after[0] - ONSET)
      )
    acted = [int(r.split()[-1]) for _, r in of_stream(out, g, "start")]
    end = min([ONSET] + acted[:1])
    pre = reward[100:end].mean() if end > 100 else None
    assert row["reward_pre"] == pytest.approx(pre)
    assert (
      row["reward_final"] == pytest.approx(reward[ONSET:].mean()) and row["terminations"] == 0
    )  # the run is shorter than 2,000 steps
    if pre is not None:
      assert row["return_lost"] == pytest.approx((pre - reward[ONSET:]).sum())
    none = trace["reward"][2 + g % 2].astype(float)
    assert row["reward_drop"] == pytest.approx(1 - none[ONSET:].mean() / none[100:ONSET].mean())
    assert row["affected"] == (row["reward_drop"] >= 0.1) and (
      row["recovery_step"] is None or row["affected"]
    )
    assert (row["outcome"] == "nominal") == (row["arm"] == "none") and (row["updates"] > 0) == (
      row["arm"] == "detector"
    )


# ---- figure --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_preset_of_several_faults_ends_in_all_files(saved, tmp_path):
  """Six faults at once, repaired after 30 steps; each is an event, and the figure does without a
  single severity.
  """
  config = RunConfig(
    "walker",
    fault="any/all-easy",
    onset=40,
    duration=30,
    steps=128,
    seeds=1,
    arms=("none",),
    agent=str(saved),
    physics="native",
    # as below: one program of the loop
    detector="periodic",
    settings={"threshold": math.log(30)},
  )
  summary = run.execute(config, tmp_path / "out")
  assert summary["fault"] == "any/all-easy" and summary["severity"] == pytest.approx(1 / 3)
  e = table(tmp_path / "out", "events")
  names = ["delay", "command_delay", "noise", "command_noise", "dropout_burst", "freeze_burst"]
  onsets = [
    (s, r.split(",")[0]) for s, k, r in zip(e["step"], e["kind"], e["reason"]) if k == "onset"
  ]
  assert onsets == [(40, n) for n in names]
  assert [(s, r) for s, k, r in zip(e["step"], e["kind"], e["reason"]) if k == "repair"] == [
    (70, f"{n}, after 30 steps") for n in names
  ]
  severity = np.asarray(table(tmp_path / "out", "trace")["severity"])
  np.testing.assert_allclose(
    severity,
    np.where((np.arange(128) >= 40) & (np.arange(128) < 70), np.float32(1 / 3), 0),
    rtol=1e-6,
  )
  assert (
    set(e["fault"]) == {"+".join(f"{n}:all" for n in names)}
    and (tmp_path / "out" / "figure.png").stat().st_size > 5000
  )
  rows = table(tmp_path / "out", "runs")
  assert (rows["change"], rows["kind"], rows["onset"]) == ([0, 1], ["onset", "repair"], [40, 70])
  reward = np.asarray(table(tmp_path / "out", "trace")["reward"], float)
  assert rows["reward_final"] == pytest.approx([reward[:70].mean(), reward.mean()]) and rows[
    "reward_pre"
  ][1] == pytest.approx(reward[:70].mean())


@pytest.mark.parametrize("change", [{"fault": "none"}, {"severity": 0.0}, {"onset": 128}], ids=str)
def test_a_healthy_run_has_no_severity_no_onset_and_no_detection(saved, tmp_path, change):
  """Without a fault, with one of severity 0, or with one after the last step: every alarm is a
  false one, at the step that would be the onset's and later too.
  """
  config = RunConfig(
    "walker",
    **({"fault": "gear", "onset": 40} | change),
    steps=128,
    seeds=1,
    arms=("none",),
    agent=str(saved),
    physics="native",
    detector="periodic",
    settings={"threshold": math.log(30)},
    adapt=AdaptConfig(warmup=20),
  )
  summary = run.execute(config, tmp_path / "out")
  trace, events, rows = (table(tmp_path / "out", name) for name in ("trace", "events", "runs"))
  assert (
    not any(trace["fault_active"])
    and not any(trace["severity"])
    and not events["kind"].count("onset")
  )
  alarms = np.flatnonzero(trace["alarm"])
  assert (
    (alarms > 40).any()
    and rows["false_alarms"] == [len(alarms)]
    and all("false alarm" in r for k, r in zip(events["kind"], events["reason"]) if k == "alarm")
  )
  assert (
    rows["onset"],
    rows["alarm_step"],
    rows["latency_steps"],
    rows["affected"],
    rows["reward_drop"],
    rows["return_lost"],
  ) == ([None],) * 6
  assert (
    summary["arms"]["none"]["alarms"] == 0
    and summary["arms"]["none"]["miss_probability"] is None
    and summary["arms"]["none"]["affected"] == 0
  )
  assert summary["arms"]["none"]["false_alarms_per_hour"] == pytest.approx(
    len(alarms) / (128 * 0.025 / 3600)
  )
  assert summary["severity"] == (0.5 if "onset" in change else 0.0)


@pytest.mark.slow
def test_an_alarm_behind_the_last_step_starts_nothing(saved, tmp_path):
  """The last chunk lives on to its end; what is decided on its surplus is no part of the run."""
  config = lambda steps: RunConfig(
    "walker",
    onset=40,
    steps=steps,
    seeds=1,
    arms=("detector",),
    agent=str(saved),
    physics="native",
    detector="periodic",
    settings={"threshold": math.log(30)},
    adapt=AdaptConfig(warmup=100),
  )
  run.execute(config(128), tmp_path / "whole")
  events = table(tmp_path / "whole", "events")
  (since,) = [s for k, s in zip(events["kind"], events["since"]) if k == "start"]
  assert since > 100
  run.execute(config(since), tmp_path / "cut")
  events, rows = table(tmp_path / "cut", "events"), table(tmp_path / "cut", "runs")
  assert "start" not in events["kind"] and (rows["adapt_start"], rows["outcome"]) == (
    [None],
    ["nominal"],
  )


def test_smooth_is_a_trailing_mean_that_leaves_nan_out():
  rng = np.random.default_rng(0)
  x = np.where(rng.random((2, 40)) < 0.3, np.nan, rng.normal(size=(2, 40)))
  x[:, :2] = np.nan
  want = [
    [
      np.nan if np.isnan(part := row[max(0, k - 6) : k + 1]).all() else np.nanmean(part)
      for k in range(40)
    ]
    for row in x
  ]
  np.testing.assert_allclose(
    figures.smooth(x, 7), want, rtol=1e-9, atol=1e-12
  )  # differences of float64 sums


@pytest.mark.parametrize("starts", [[], [60]])
def test_figure_of_a_run_in_which_little_happened(tmp_path, starts):
  """No alarm, no residual yet: still a figure, and one whose layout has not collapsed (Matplotlib
  warns of that).
  """
  steps = 90
  numbers = np.tile(np.linspace(0, 1, steps), 2)
  trace = {
    "stream": [0] * steps + [1] * steps,
    "arm": ["detector"] * steps + ["none"] * steps,
    "step": np.tile(np.arange(steps), 2),
    "reward": numbers,
  }
  trace |= {"opr": np.full(2 * steps, np.nan)}
  tables.write_table(tmp_path / "trace.parquet", trace)
  events = {
    "step": [40] + starts + [80],
    "kind": ["onset"] + ["start"] * len(starts) + ["abort" if starts else "alarm"],
    "decision": [None] + ["start"] * len(starts) + ["abort_budget" if starts else None],
    "arm": ["detector"] * (2 + len(starts)),
    "stream": [0] * (2 + len(starts)),
  }
  tables.write_table(tmp_path / "events.parquet", events)
  tables.write_json(
    tmp_path / "config.json",
    {"env": "walker", "fault": "gear", "severity": 0.5, "onset": 40, "control_s": 0.025},
  )
  with warnings.catch_warnings():
    warnings.simplefilter("error")
    assert figures.figure(tmp_path) == tmp_path / "figure.png"
  assert (tmp_path / "figure.png").read_bytes().startswith(
    b"\x89PNG"
  ) and "figure.tmp.png" not in os.listdir(tmp_path)


# ---- kill and resume -----------------------------------------------------------------------------


def resume(argv):
  """Runs the command in this process: (exit code, standard error)."""
  stderr = io.StringIO()
  with contextlib.redirect_stderr(stderr), contextlib.redirect_stdout(io.StringIO()):
    return app.main(argv), stderr.getvalue()


def test_a_killed_and_interrupted_run_ends_in_the_same_files(whole, saved, tmp_path, monkeypatch):
  out = tmp_path / "cut"
  argv = ARGS + ["--agent", str(saved), "--out", str(out)]
  process = spawn(argv, save_every_s=0.0)  # a checkpoint after every chunk
  end = time.monotonic() + 1200
  try:
    while not list(
      out.glob("work/trace-000004.npz")
    ):  # its checkpoint may be half written: then the one before counts
      assert process.poll() is None and time.monotonic() < end, process.communicate()[1]
      time.sleep(0.002)
  finally:
    process.kill()
    process.communicate()
  assert process.returncode == -signal.SIGKILL and not (out / "summary.json").exists()

  monkeypatch.setitem(envs.ENVS, "walker", Easy)
  step, lived = run.Runner.step, []

  def interrupted(self):
    lived.append(self.done_chunks)
    if len(lived) == 3:
      os.kill(os.getpid(), signal.SIGINT)  # Ctrl-C during the third chunk
    return step(self)

  monkeypatch.setattr(run.Runner, "step", interrupted)
  code, stderr = resume(argv + ["--resume"])
  assert code == 130 and "--resume" in stderr.splitlines()[-1]
  assert (
    lived[0] in (3, 4) and len(lived) == 3
  )  # went on from a checkpoint, stopped after the chunk
  monkeypatch.setattr(run.Runner, "step", step)
  assert (out / f"work/trace-{lived[-1] + 1:06d}.npz").exists()

  code, stderr = resume(argv + ["--resume"])
  assert code == 0, stderr
  assert sorted(os.listdir(out)) == sorted(os.listdir(whole[0]))
  for name in ("trace", "events", "runs"):
    a, b = table(out, name), table(whole[0], name)
    assert list(a) == list(b)
    for column in set(a) - {"wall_s"}:
      assert a[column] == b[column], (name, column)
  a, b = (json.loads((f / "summary.json").read_text()) for f in (out, whole[0]))
  assert {k: v for k, v in a.items() if "wall" not in k} == {
    k: v for k, v in b.items() if "wall" not in k
  }
  for name in os.listdir(out / "agents"):
    a, b = (agents.load(str(f / "agents" / name), "walker", 24, 6) for f in (out, whole[0]))
    jax.tree.map(np.testing.assert_array_equal, a.train, b.train)


def test_what_a_removed_run_has_left_is_not_gone_on_from(saved, tmp_path):
  """Checkpoints of another run, whose config.json is gone."""

  class Cut(Exception):
    """A kill between two chunks."""

  def lived(severity, chunks):
    config = RunConfig(
      "walker", severity=severity, onset=64, steps=640, seeds=1, arms=("none",),
      agent=str(saved), adapt=AdaptConfig(warmup=32),
    )  # fmt: skip
    steps = []

    def cut(progress):
      steps.append(progress.step)
      if len(steps) == chunks:
        raise Cut

    with contextlib.suppress(Cut):
      run.execute(config, tmp_path / "out", resume=True, progress=cut, save_every_s=0.0)
    return steps

  assert lived(0.5, 6)[-1] == 384
  (tmp_path / "out/config.json").unlink()
  assert lived(1.0, 3) == [64, 128, 192]
  assert lived(1.0, 2) == [192, 256]  # the third chunk was not saved


def test_what_a_stream_has_learnt_is_an_agent(whole, saved):
  """Of those that took updates, with the count; it differs from what the run began with, and arm
  `none` keeps nothing.
  """
  out = whole[0]
  runs = [dict(zip(table(out, "runs"), cells)) for cells in zip(*table(out, "runs").values())]
  learnt = {f"{r['arm']}-{r['seed']}": r["updates"] for r in runs if r["updates"]}
  assert (
    learnt
    and sorted(os.listdir(out / "agents")) == sorted(learnt)
    and all(name.startswith("detector-") for name in learnt)
  )
  first = agents.load(str(saved), "walker", 24, 6)
  for name, updates in learnt.items():
    kept = agents.load(str(out / "agents" / name), "walker", 24, 6)
    assert kept.card["adapted"] == {
      "env": "walker",
      "becomes": None,
      "fault": "gear",
      "arm": "detector",
      "seed": int(name[-1]),
      "steps": STEPS,
      "updates": updates,
    }
    assert (
      int(kept.train.updates) == int(first.train.updates) + updates
      and kept.card["dreamer"] == first.card["dreamer"]
    )
    moved = jax.tree.map(
      lambda a, b: float(np.abs(a - b).max()), kept.train.params, first.train.params
    )
    assert np.isfinite(jax.tree.leaves(moved)).all()
    # what its training held still in the end learns too; a step is of the size of the rate
    for part in ("enc", "dyn", "dec", "pol"):
      assert max(jax.tree.leaves(moved[part])) > 0.01 * AdaptConfig().lr, part


def test_overwriting_a_run_removes_its_agents_and_no_other_file(tmp_path):
  for name in ("detector-3", "mine", "other"):
    (tmp_path / "agents" / name).mkdir(parents=True)
  (tmp_path / "agents/mine/notes.txt").write_text("x")
  for name in ("agent.npz", "card.json"):
    (tmp_path / "agents/detector-3" / name).write_text('{"adapted": {}}')
    (tmp_path / "agents/other" / name).write_text("{}")
  run.clear(tmp_path)
  assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()) == [
    "agents/mine/notes.txt",
    "agents/other/agent.npz",
    "agents/other/card.json",
  ]
  assert not (tmp_path / "agents/detector-3").exists()


def test_resume_of_a_finished_run_changes_nothing(whole, saved, monkeypatch):
  out = whole[0]
  before = {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}
  monkeypatch.setattr(run.Runner, "__init__", None)  # nothing is built
  assert resume(ARGS + ["--agent", str(saved), "--out", str(out), "--resume"])[0] == 0
  code, stderr = resume(
    ARGS + ["--agent", str(saved), "--out", str(out), "--resume", "--severity", "0.7"]
  )
  assert code == 2 and "severity" in stderr and stderr.count("\n") == 1
  assert {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()} == before


class Stub:
  """A Runner of five chunks that does nothing but note what is asked of it."""

  signals, notes = 0, []

  room = "memory"

  def __init__(self, config, out, *shared):
    self.chunk = 0

  def step(self):
    self.chunk += 1
    if self.chunk == 3:
      for _ in range(self.signals):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)  # Python runs the handler between two bytecodes
    self.notes.append(f"step {self.chunk}")

  done = property(lambda self: self.chunk == 5)
  config_dict = lambda self: {}
  open = fork = lambda self: None
  save = lambda self: self.notes.append("save")


@pytest.mark.parametrize(
  "signals, want", [(0, ["step 4", "step 5", "finish"]), (1, ["save"]), (2, None)]
)
def test_an_interrupt_is_acted_on_between_two_chunks(tmp_path, monkeypatch, signals, want):
  """One signal: the chunk ends, its state is saved. A second one ends the chunk half way, and
  nothing half is saved.
  """
  monkeypatch.setattr(
    run, "Runner", type("Stubbed", (Stub,), {"signals": signals, "notes": (notes := [])})
  )
  monkeypatch.setattr(run, "finish", lambda runner, tell: runner.notes.append("finish"))
  call = lambda: run.execute(RunConfig("walker"), tmp_path / "x")
  if signals:
    with pytest.raises(KeyboardInterrupt):
      call()
  else:
    call()
  assert notes == ["step 1", "step 2"] + (["step 3"] + want if want else [])
  assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


class Broken:
  """A text stream whose reader has gone."""

  def write(self, text):
    raise BrokenPipeError

  flush = write


def test_progress_that_nobody_reads_ends_no_work(monkeypatch, tmp_path):
  """`2>&1 | tee log`: Ctrl-C kills tee as well; what is said then goes nowhere, the state is saved,
  and the exit code is 130.
  """
  monkeypatch.setattr(
    run, "Runner", type("Stubbed", (Stub,), {"signals": 1, "notes": (notes := [])})
  )
  monkeypatch.setattr(
    runs,
    "RunDisplay",
    lambda: contextlib.nullcontext(lambda p: runs.say("a line of progress")),
  )
  monkeypatch.setattr(sys, "stderr", broken := Broken())
  assert app.main(["run", "walker", "--out", str(tmp_path / "x")]) == 130
  assert notes[-1] == "save" and sys.stderr is not broken  # what is said from now on goes nowhere


# ---- agents --------------------------------------------------------------------------------------


def used(tiny):
  """A TrainState whose every leaf is in use."""
  state = jax.jit(tiny.init)(jax.random.key(1))
  leaves, tree = jax.tree.flatten(state)
  rng = np.random.default_rng(0)
  draw = lambda x: (rng.normal(size=x.shape) * 10.0 ** rng.uniform(-12, 3)).astype(np.float32)
  leaves = [draw(x) if x.dtype == np.float32 else np.full(x.shape, 77, x.dtype) for x in leaves]
  return jax.tree.unflatten(tree, leaves)


def test_agents_round_trip(tiny, tmp_path, same):
  state = used(tiny)
  card = {"env": "walker", "dreamer": dataclasses.asdict(tiny.config), "note": "ü"}
  agents.save(tmp_path, state, card)
  assert sorted(os.listdir(tmp_path)) == ["agent.npz", "card.json"]
  back = agents.load(str(tmp_path), "walker", 24, 6)
  assert back.card == card and isinstance(back.agent, Agent)
  assert back.agent.config == dataclasses.replace(tiny.config, warmup=0)  # no second warm-up
  assert same(
    back.train._replace(opt=()), state._replace(opt=())
  )  # parameters, slow critic, range and counters in full
  for a, b in zip(jax.tree.leaves(back.train.opt), jax.tree.leaves(state.opt), strict=True):
    assert a.dtype == b.dtype
    np.testing.assert_allclose(
      a, b, rtol=2.0**-8 if b.dtype == np.float32 else 0
    )  # bfloat16 keeps 8 bits of a moment, rounded to nearest
  agents.save(tmp_path, back.train, card)
  assert same(
    agents.load(str(tmp_path), "walker", 24, 6).train, back.train
  )  # and loses nothing twice


def test_a_small_agent_differs_by_its_rounding_alone(tiny, tmp_path, same):
  """Weights to 11 bits, squares to a third of an octave, momentum from 0, all else in full."""
  state = used(tiny)
  square = jax.tree.map(np.abs, state.opt[1].nu)
  zeros = lambda x: np.where(np.arange(x.size).reshape(x.shape) == 0, 0, x).astype(np.float32)
  state = state._replace(
    opt=(state.opt[0], state.opt[1]._replace(nu=jax.tree.map(zeros, square)), *state.opt[2:]),
    params=jax.tree.map(lambda x: x / (1 + np.abs(x)), state.params),
    slow=jax.tree.map(lambda x: x / (1 + np.abs(x)), state.slow),
  )
  card = {"env": "walker", "dreamer": dataclasses.asdict(tiny.config)}
  agents.save(tmp_path, state, card, small=True)
  back = agents.load(str(tmp_path), "walker", 24, 6).train
  for name in ("params", "slow"):
    for a, b in zip(*(jax.tree.leaves(getattr(x, name)) for x in (back, state)), strict=True):
      assert a.dtype == b.dtype == np.float32
      # a float16 keeps 11 bits, below 2^-14 steps of 2^-24
      np.testing.assert_allclose(a, b, rtol=2.0**-11, atol=2.0**-25)
  held, kept = (jax.tree.leaves(x.opt[1].nu) for x in (back, state))
  for a, b in zip(held, kept, strict=True):
    np.testing.assert_array_equal(a == 0, b == 0)
    there = (b > 2.0**-80) & (b < 2.0**5)
    octaves = np.log2(np.asarray(a)[there]) - np.log2(np.asarray(b)[there])
    assert np.all(np.abs(octaves) <= 1 / 6 + 1e-5)
  assert sum(np.sum(x > 0) for x in held) > 1000
  assert not any(np.any(x) for x in jax.tree.leaves(back.opt[2].ema))
  assert (back.opt[1].count, back.opt[2].count) == (state.opt[1].count, state.opt[2].count)
  rest = {"params": (), "slow": (), "opt": ()}
  assert same(back._replace(**rest), state._replace(**rest))
  agents.save(tmp_path, back, card, small=True)
  assert same(agents.load(str(tmp_path), "walker", 24, 6).train, back)  # nothing is lost twice
  for bad in (1e6, np.nan):
    wild = back._replace(params=jax.tree.map(lambda x, bad=bad: x * bad, back.params))
    with pytest.raises(UserError, match="does not fit half precision; leave out small"):
      agents.save(tmp_path, wild, card, small=True)


def test_shipped_agents_are_small():
  size = sum(f.stat().st_size for f in agents.HERE.rglob("*") if f.is_file() and f.suffix != ".py")
  assert len(agents.shipped()) >= 9 and size <= 30e6


def test_load_overrides_how_it_goes_on(saved):
  given = {"lr": 1e-5, "last_starts": 4, "model_lr": 0.1}
  config = agents.load(str(saved), "walker", 24, 6, **given).agent.config
  assert (config.lr, config.last_starts, config.model_lr, config.warmup) == (1e-5, 4, 0.1, 0)


def test_an_agent_is_finetuned_at_the_rate_of_its_card(saved, tmp_path):
  """The default gives way to the card's; None, and what does not finetune, keep the agent's own."""
  shutil.copytree(saved, tmp_path / "agent")
  load = lambda **given: agents.load(str(tmp_path / "agent"), "walker", 24, 6, **given)
  rate = lambda **given: load(**given).agent.config.lr
  own = json.loads((saved / "card.json").read_text())["dreamer"]["lr"]
  assert own != AdaptConfig.lr == 1e-4
  rates = lambda: (rate(), rate(lr=None), rate(lr=AdaptConfig.lr), rate(lr=2e-5))
  assert rates() == (own, own, 1e-4, 2e-5)
  card = json.loads((saved / "card.json").read_text())
  for said, wrong in ((3e-5, False), (0.0, True), ("slow", True), (-1.0, True)):
    (tmp_path / "agent/card.json").write_text(json.dumps(card | {"finetuning_lr": said}))
    if wrong:
      with pytest.raises(FileError, match="is not an agent's card: .*finetuning_lr"):
        load()
    else:
      assert rates() == (own, own, said, 2e-5)


def test_an_agent_is_finetuned_with_the_anchor_of_its_card(saved, tmp_path):
  """Where none is given; training on knows nothing of it."""
  shutil.copytree(saved, tmp_path / "agent")
  load = lambda **given: agents.load(str(tmp_path / "agent"), "walker", 24, 6, **given)
  given = {}, {"anchor": None}, {"anchor": 0.0}, {"anchor": 0.2}
  weights = lambda: [load(**some).agent.config.anchor for some in given]
  card = json.loads((saved / "card.json").read_text())
  assert weights() == [0.0, 0.0, 0.0, 0.2]
  for said, known in ((0.1, [0.0, 0.1, 0.0, 0.2]), (0.0, [0.0, 0.0, 0.0, 0.2]), (-0.1, None)):
    (tmp_path / "agent/card.json").write_text(json.dumps(card | {"finetuning_anchor": said}))
    if known:
      assert weights() == known
    else:
      with pytest.raises(FileError, match="finetuning_anchor must be 0 or above; got -0.1"):
        load()


@pytest.mark.parametrize("name", agents.shipped())
def test_every_shipped_agent_loads(name):
  robot = json.loads((agents.HERE / name / "card.json").read_text())["env"]
  trained = agents.of(envs.make(robot), name)
  assert (
    trained.card["env"] == robot == name.partition("-")[0]
    and {"command", "dreamer", "repeat", "eval"} <= set(trained.card)
    and int(trained.train.updates) > 0
  )
  assert all(np.isfinite(x).all() for x in jax.tree.leaves(trained.train))


def test_every_robot_has_an_agent():
  assert {"walker", "car", "quadruped"} <= set(agents.shipped()) and all(
    agents.is_shipped(envs.make(name)) for name in envs.ENVS.own
  )


def test_a_related_robot_takes_the_agent():
  """car_real has observation, action and reward of car; the walker has not."""
  assert (
    agents.load(None, "car_real", 67, 2).card["env"]
    == agents.load("car", "car_real", 67, 2).card["env"]
    == "car"
  )
  with pytest.raises(UserError, match="trained on 'car', not on 'walker'"):
    agents.load("car", "walker", 24, 6)
  with pytest.raises(UserError, match="trained on 'walker', not on 'car_real'"):
    agents.load("walker", "car_real", 67, 2)


def test_load_refuses_what_does_not_fit(saved, tmp_path):
  with pytest.raises(FileError, match="does not fit"):
    agents.load(str(saved), "walker", 25, 6)
  with pytest.raises(UserError, match=f"shipped: {', '.join(agents.shipped())};"):
    agents.load(str(tmp_path / "none"), "walker", 24, 6)


def test_what_is_cut_down_to_its_acting_cannot_learn(saved, tmp_path):
  """Arms that take no update may use it; scratch, which draws all anew, too."""
  trained = agents.load(str(saved), "walker", 24, 6)
  params = trained.train.params | {"val": jax.tree.map(np.zeros_like, trained.train.params["val"])}
  agents.save(tmp_path / "cut", trained.train._replace(params=params), trained.card)
  config = RunConfig(
    "walker", agent=str(tmp_path / "cut"), arms=("still", "scratch", "none", "quiet")
  )
  cut = agents.load(config.agent, "walker", 24, 6)
  identity.check_learners(dataclasses.replace(config, arms=config.arms[:-1]), cut)
  identity.check_learners(config, trained)
  with pytest.raises(UserError, match="critic is zero.* leave out arm quiet, or give the agent"):
    runner.Runner(config, tmp_path / "out")


# ---- eval ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("fault", ["none", "gear"])
def test_eval_sums_the_rewards_of_one_episode_each(saved, short_walker, monkeypatch, capsys, fault):
  """Episodes of 12 steps; the rollouts, lived again step by step in one chunk, give the sums."""
  import jax.numpy as jnp

  from mjx_cl import faults
  from mjx_cl.rollout.scan import Rollout, nest, start

  monkeypatch.setitem(envs.ENVS, "walker", lambda physics: short_walker)
  before = signal.getsignal(signal.SIGTERM)
  try:
    assert (
      app.main(
        ["eval", "walker", "--agent", str(saved), "--episodes", "3", "--seed", "5", "--json"]
        + (
          ["--fault", "gear", "--target", "left_hip", "--severity", "1"] if fault == "gear" else []
        )
      )
      == 0
    )
  finally:
    signal.signal(signal.SIGTERM, before)
  result = json.loads(capsys.readouterr().out)
  trained = agents.load(str(saved), "walker", 24, 6)
  broken = {"severity": 1.0, "target": 3} if fault == "gear" else {}
  said = {k: result[k] for k in ("fault", "target", "severity") if k in result}
  assert said == ({"fault": "gear", "target": "left_hip", "severity": 1.0} if broken else {})
  made = faults.make(fault, short_walker)
  assert not broken or made.targets[3] == "left_hip"
  keys = jnp.stack([jax.random.key(s) for s in (5, 6, 7)])[None]
  begin = lambda k: start(short_walker, trained.agent, made, k, **broken)
  streams = nest(begin, 0, 0)(keys)
  rows = Rollout(short_walker, trained.agent, made).chunk(
    jax.tree.map(lambda x: x[None], trained.train.params), streams, 12
  )[1]
  returns = np.asarray(rows.reward)[:, 0].sum(0)
  assert np.asarray(rows.truncated)[-1].all()
  assert (
    set(result)
    >= {"env", "agent", "episodes", "return_mean", "return_iqm", "return_ci", "terminations"}
    and result["episodes"] == 3
  )
  np.testing.assert_allclose(result["returns"], returns, atol=0.005)  # printed to two places
  np.testing.assert_allclose(
    [result["return_mean"], result["return_iqm"]],
    [returns.mean(), intervals.iqm(returns)],
    rtol=1e-5,
  )  # float32 sums
  assert (
    result["return_ci"][0] <= result["return_iqm"] <= result["return_ci"][1]
    and result["terminations"] == 0
  )


def test_a_robot_that_ends_no_episode_is_not_waited_for(saved, short_walker, monkeypatch, capsys):
  class Endless(evaluate.Episodes):
    """Episodes of a robot whose step never sets truncated."""

    alive = property(lambda _: np.ones((1, 2), bool), lambda *_: None)

  monkeypatch.setattr(evaluate, "Episodes", Endless)
  monkeypatch.setitem(envs.ENVS, "walker", lambda physics: short_walker)
  assert app.main(["eval", "walker", "--agent", str(saved), "--episodes", "2"]) == 2
  assert "ends no episode in its episode_steps=" in capsys.readouterr().err


# ---- time left -----------------------------------------------------------------------------------


def test_time_left_is_known_from_the_first_chunk_without_compiling(saved, tmp_path, monkeypatch):
  """It counts the chunks that are left at the speed of those that were lived, and ends at 0."""
  monkeypatch.setitem(envs.ENVS, "walker", Easy)
  now = [0.0]
  monkeypatch.setattr(runner.time, "perf_counter", lambda: now[0])
  seen = []
  config = RunConfig("walker", agent=str(saved), seeds=1, arms=("none",), steps=640, onset=600)
  lives = runner.Runner(config, tmp_path / "run")

  def step(end, settle, own=lives.lives.step):
    out = own(end, settle)
    now[0] += 3.0
    return out._replace(seconds=np.array([[2.0, 4.0, 0.0]]))

  monkeypatch.setattr(lives.lives, "step", step)
  while not lives.done:
    seen.append(lives.step().left)
  first = next(k for k, left in enumerate(seen) if left is not None)
  assert first <= 1 and seen[-1] == 0.0
  assert seen[first:] == pytest.approx([3.0 * (9 - k) for k in range(first, 10)], rel=0.05)
