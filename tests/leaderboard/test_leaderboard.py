"""Recorded streams and the leaderboard on a synthetic set: exact joins, thresholds at the asked
rate, submissions, the same numbers whatever is added.
"""

import dataclasses
import json
import pathlib
import re
import shlex
import types

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet
import pytest
from test_cli import mjx, refused  # noqa: F401  fixtures

from mjx_cl import detectors
from mjx_cl.detectors.python_class import HostDetector
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import tables as store
from mjx_cl.leaderboard import (
  calibration,
  lives,
  oracle,
  set_tables,
  streams,
  submissions,
  sweep,
)
from mjx_cl.leaderboard import entries as entries_of
from mjx_cl.leaderboard import program as program_of
from mjx_cl.leaderboard import score as leaderboard
from mjx_cl.leaderboard.suite import Suite
from mjx_cl.scoring import autoregression, metrics
from mjx_cl.scoring import thresholds as healthy

CONTROL_S, SEEDS = 0.5, 4
SUITE = Suite(
  "small",
  400.0,
  200,
  (260, 300),
  20.0,
  {"score": (0, SEEDS - 1), "tune": (100, 99 + SEEDS)},
  {"steps": 1024, "score": 2, "tune": 4},
  {"nominal": 6, "after_s": 10.0},
  {"walker": {"score": {"gear": (0.5, 1.0), "bias": (1.0,)}, "tune": {"wind": (1.0,)}}},
)
SHIFT = {
  ("gear", 0.5): 0.5,
  ("gear", 1.0): 2.0,
  ("bias", 1.0): 4.0,
  ("wind", 1.0): 1.0,
}  # of ln OPR and all else, in deviations


def part(lanes, onsets, steps, seed):
  """Arrays of a recording: independent log-normal residuals, shifted from the onset on; a lane's
  past is its seed's.
  """
  shape = (steps, len(lanes))
  noise = {}
  for lane in lanes:
    noise.setdefault(
      lane.seed,
      np.random.default_rng([seed, lane.seed]).standard_normal((steps, 12 + 16)).astype(np.float32),
    )
  data = {c: np.zeros(shape, np.float32) for c in streams.COLUMNS} | {
    "latent": np.zeros(shape + (16,), np.float16)
  }
  for i, lane in enumerate(lanes):
    own = (
      noise[lane.seed]
      if lane.fault
      else np.random.default_rng([seed, lane.seed, i])
      .standard_normal((steps, 28))
      .astype(np.float32)
    )
    if lane.fault is None and i < SEEDS and onsets.any():
      own = noise[lane.seed]
    late = (np.arange(steps) >= onsets[i])[:, None] * SHIFT.get((lane.fault, lane.severity), 0.0)
    x = own + late
    for k, c in enumerate(streams.COLUMNS):
      data[c][:, i] = 0.5 - 0.1 * x[:, k] if c == "reward" else np.exp(0.3 * x[:, k])
    data["latent"][:, i] = x[:, 12:]
  data["opr"][50:55] = data["rpr"][50:55] = np.nan  # a window that was cut
  data["innovation"] = 3.0 * data["latent"][..., :3].astype(np.float32)
  episode = np.broadcast_to((np.arange(steps) // 100).astype(np.int16)[:, None], shape)
  return data | {
    "episode": episode,
    "terminated": np.zeros(shape, bool),
    "target": np.asarray([lane.fault and "part" or "" for lane in lanes]),
  }


def make_set(folder, suite=SUITE, robots=("walker",), variables=()):
  """A set as `record` writes it, from synthetic recordings; with innovations of `variables`."""
  folder.mkdir(parents=True, exist_ok=True)
  rows, details = [], {}
  for robot in robots:
    parts = {}
    for split in ("score", "tune"):
      seeds = suite.numbers(split)
      who = [lives.Lane(s) for s in seeds for _ in range(suite.nominal[split])]
      parts[split, "nominal"] = (
        who,
        np.zeros(len(who), int),
        part(who, np.zeros(len(who), int), suite.nominal["steps"], 1),
      )
      who = lives.lanes(suite, robot, split)
      onsets = np.asarray([suite.onset_of(lane.seed) for lane in who])
      parts[split, "fault"] = (
        who,
        onsets,
        part(who, onsets, int(onsets.max()) + suite.after(CONTROL_S), 2),
      )
    names = variables.get(robot, ()) if isinstance(variables, dict) else variables
    details[robot], fresh = set_tables.write(
      suite,
      folder,
      robot,
      parts,
      len(rows),
      CONTROL_S,
      ",".join(f"g{k}" for k in range(8)),
      names,
    )
    rows += fresh
  set_tables.write_meta(folder, rows + set_tables.healthy_probes(rows))
  store.write_json(
    folder / "config.json",
    {"version": streams.VERSION, "suite": dataclasses.asdict(suite), "details": details},
  )
  return parts


@pytest.fixture(scope="module")
def small(tmp_path_factory):
  folder = tmp_path_factory.mktemp("set")
  parts = make_set(folder)
  return streams.StreamSet(folder), parts, folder


# ---- streams -------------------------------------------------------------------------------------


def test_what_was_recorded_comes_back_but_for_the_rounding(small):
  held, parts, _ = small
  who, onsets, data = parts["score", "fault"]
  numbers = held.find("walker", "fault", "score")
  got = held.get("walker", numbers)
  faulty = [i for i, lane in enumerate(who) if lane.fault]
  assert len(numbers) == len(faulty) == 3 * SEEDS and got.fault == [who[i].fault for i in faulty]
  np.testing.assert_array_equal(got.onset, onsets[faulty])
  for name in ("opr", "rpr", "surprise"):
    x, y = getattr(got.residual, name), data[name][:, faulty]
    for column, i in enumerate(faulty):
      end = onsets[i] + SUITE.after(CONTROL_S)
      assert np.isnan(x[end:, column]).all()
      # relative steps of 2^-4, the power of two nearest to a quarter of the deviation 0.3 of the
      # logarithm: at most half of one off
      np.testing.assert_allclose(x[:end, column], y[:end, column], rtol=0.5 * 2**-4)
  np.testing.assert_array_equal(np.isnan(got.residual.opr[50:55]), True)
  np.testing.assert_allclose(
    got.residual.reward[:300, 0], data["reward"][:300, faulty[0]], atol=0.5 * 2**-5
  )  # 0.1 / 4 is nearest to 2^-5
  assert np.isfinite(got.residual.latent[onsets[faulty[0]] + 5, 0]).all()
  assert np.isnan(got.residual.latent[onsets[faulty[0]] + 20 + 1, 0]).all()  # kept for 10 s


def test_innovations_come_back_to_half_a_deviation(tmp_path):
  parts = make_set(tmp_path, variables=("height", "speed", "reward"))
  held = streams.StreamSet(tmp_path)
  names = ("innovation_height", "innovation_speed", "innovation_reward")
  assert held.signed("walker") == held.need_innovations("walker") == names
  who, onsets, data = parts["score", "fault"]
  faulty = [i for i, lane in enumerate(who) if lane.fault]
  numbers = held.find("walker", "fault", "score")
  got = held.get("walker", numbers, signed=True).residual.innovation
  table = pyarrow.parquet.read_table(tmp_path / "walker_innovations.parquet")
  assert table.column_names == ["stream", "step", *names]
  grain = held.config["details"]["walker"]["rounding"]
  for k, name in enumerate(names):
    assert grain[name] == 4.0  # of 2^j the nearest, by its logarithm, to the deviation 3
    for column, i in enumerate(faulty):
      end = onsets[i] + SUITE.after(CONTROL_S)
      np.testing.assert_allclose(got[:end, column, k], data["innovation"][:end, i, k], atol=2.0)
      assert np.isnan(got[end:, column, k]).all()
  assert held.get("walker", numbers).residual.innovation is None
  assert streams.load(held, "walker").tune.residual.innovation.shape == (1024, 4 * SEEDS, 3)


def test_a_detector_that_takes_innovations_runs_on_robots_of_different_size(tmp_path, monkeypatch):
  """The largest error of the step over its threshold, in NumPy."""
  both = dataclasses.replace(SUITE, robots=dict.fromkeys(("walker", "car"), SUITE.robots["walker"]))
  make_set(tmp_path, both, ("walker", "car"), {"walker": "abc", "car": "ab"})
  held = streams.StreamSet(tmp_path)

  def largest(threshold=1.0):
    def update(state, row):
      score = jnp.max(jnp.abs(row.innovation))
      return state, detectors.Alarm(score > threshold, score)

    return detectors.Detector(lambda: jnp.zeros(()), update)

  largest.signed = True
  monkeypatch.setitem(detectors.DETECTORS, "largest", largest)
  entry = entries_of.entry("largest", {"use": "largest"})
  kept, left = leaderboard.able([entry], held, held.robots, ("largest",))
  board = leaderboard.score(held, kept)
  assert not left and {row["robot"] for row in board.rows if row["detector"] == "largest"} == {
    "walker",
    "car",
  }
  for robot in held.robots:
    data = streams.load(held, robot)
    e = np.abs(data.tune.residual.innovation).max(-1)[SUITE.count_from :]
    (row, *_) = [r for r in board.rows if (r["detector"], r["robot"]) == ("largest", robot)]
    assert row["arl0_alarms"] > 0 and 0 < np.nanmean(e > row["threshold"]) < 0.01


def test_float16_holds_every_innovation_that_is_written():
  error = np.array([[-1e9, 0.0, 3.0, np.nan]], np.float32).T[:, :, None]
  grain = set_tables.grains(
    {c: np.ones((4, 1), np.float32) for c in streams.COLUMNS}
    | {"latent": np.ones((4, 1, 16), np.float16), "innovation": np.zeros((4, 1, 1), np.float32)},
    ("innovation_reward",),
  )
  assert np.float16(grain["innovation_reward"]) > 0  # of a variable that never varies
  kept = set_tables.half(error[:, 0, 0], "innovation_reward", {"innovation_reward": 2.0})
  np.testing.assert_array_equal(kept, np.float16([-60_000, 0, 4, np.nan]))  # 1.5 steps: to even


def test_a_set_without_innovations_says_what_to_record(small):
  held, _, folder = small
  assert held.signed("walker") == ()
  with pytest.raises(FileError, match="holds no innovations of walker; record a suite with") as e:
    held.get("walker", held.find("walker", "fault", "score"), signed=True)
  assert "\n" not in str(e.value)
  entry = leaderboard.chosen(("ewma",), "walker")[0]._replace(name="mine", signed=True)
  kept, left = leaderboard.able([entry], held, ["walker"])
  assert not kept and len(left) == 1 and left[0].startswith("mine is left out: ")
  with pytest.raises(FileError, match="holds no innovations"):
    leaderboard.able([entry], held, ["walker"], ("mine",))


def test_a_set_of_the_version_before_reads_alike(small, tmp_path):
  held, _, folder = small
  for path in folder.iterdir():
    (tmp_path / path.name).write_bytes(path.read_bytes())
  config = json.loads((folder / "config.json").read_text()) | {"version": 1}
  del config["suite"]["innovations"]
  (tmp_path / "config.json").write_text(json.dumps(config))
  old, numbers = streams.StreamSet(tmp_path), held.find("walker", "nominal", "score")
  jax.tree.map(
    np.testing.assert_array_equal,
    old.get("walker", numbers).residual,
    held.get("walker", numbers).residual,
  )


def test_plain_parquet_readers_can_read_it(small):
  """The join of the module's text, on plain Parquet columns."""
  held, _, folder = small
  rows = pyarrow.parquet.read_table(folder / "walker.parquet").to_pydict()
  assert set(rows) == set(streams.SCHEMA)
  meta = pyarrow.parquet.read_table(folder / "streams.parquet").to_pylist()
  one = next(m for m in meta if m["kind"] == "fault" and m["full"])
  pick = lambda s, keep: [
    (t, x) for n, t, x in zip(rows["stream"], rows["step"], rows["opr"]) if n == s and keep(t)
  ]
  joined = pick(one["prefix"], lambda t: t < one["onset"]) + pick(one["stream"], lambda t: True)
  assert [t for t, _ in joined] == list(range(one["steps"]))
  got = held.get("walker", [one["stream"]]).residual.opr[:, 0]
  np.testing.assert_array_equal(
    np.asarray([np.nan if x is None else x for _, x in joined], np.float32), got
  )


def test_a_probe_is_another_stream_cut_off(small):
  held, _, _ = small
  probes = held.find("walker", "probe")
  of = lambda n: held.meta["kind"][
    held.meta["stream"] == held.meta["prefix"][held.meta["stream"] == n][0]
  ][0]
  assert (
    sorted(map(of, probes)) == ["fault"] * 5 + ["nominal"] * 4
  )  # two healthy ones of each split
  for n in probes:
    at = int(np.flatnonzero(held.meta["stream"] == n)[0])
    whole, cut = held.get("walker", [int(held.meta["prefix"][at])]), held.get("walker", [n])
    steps = int(held.meta["steps"][at])
    np.testing.assert_array_equal(cut.residual.rpr[:steps], whole.residual.rpr[:steps])


def test_other_pasts_are_refused(tmp_path, monkeypatch):
  monkeypatch.setattr(np, "array_equal", lambda a, b, **_: False)
  with pytest.raises(FileError, match="its past differs from that of the healthy robot"):
    make_set(tmp_path / "x")


def test_suites_that_ship_are_sound():
  for name, alarms in (("leaderboard", 20), ("leaderboard-100k", 30)):
    s = streams.suite(name)
    assert (
      s.name == name
      and s.nominal["tune"] * 10 * (s.nominal["steps"] - s.count_from) / s.arl0 >= alarms
    )
    from mjx_cl import envs, faults

    for robot, tables in s.robots.items():
      env = envs.make(robot)
      for key in [k for t in tables.values() for k in t]:
        fault, _, target = key.partition(":")
        faults.target_index(faults.make(fault, env), target or None)


BEYOND = ("x", None, True, -1.0, float("nan"), float("inf"), 1e300, 10**400)


@pytest.mark.parametrize(
  "edit, text",
  [
    ({"onset": [300, 300]}, "onset must be"),
    ({"seeds": {"score": [0, 9], "tune": [9, 12]}}, "without a common seed"),
    (
      {"robots": {"walker": {"score": {"gear": [0.5]}, "tune": {"gear": [1.0]}}}},
      "gear is to tune and to score",
    ),
    ({"robots": {"walker": {"score": {"gear": [1.5]}}}}, "severities in"),
    ({"robots": {}}, "no \\[robots"),
    ({"nominal": {"steps": 5}}, "needs"),
    *[({"latents": {"nominal": 1, "after_s": x}}, "after_s must be a number") for x in BEYOND],
    *[({name: x}, f"{name} must be a number") for name in ("horizon_s", "arl0") for x in BEYOND],
    ({"latents": {"nominal": -1, "after_s": 1.0}}, "nominal must be 0 or above"),
    ({"nominal": {"steps": 10**13, "score": 1, "tune": 1}}, "steps must be .* below 2,147,483,648"),
    ({"onset": (10**14, 10**14 + 1)}, "onset must be .* below 2,147,483,648"),
    ({"seeds": {"score": (0, 9), "tune": (2**31, 2**31)}}, "tune must be .* below 2,147,483,648"),
    ({"name": 3}, "name must be text"),
    ({"robots": {"walker": {"score": {"gear": (True,)}}}}, "severities in"),
  ],
)
def test_unsound_suites_are_refused_in_one_line(edit, text):
  with pytest.raises(UserError, match=text) as e:
    dataclasses.replace(SUITE, **edit)
  assert "\n" not in str(e.value)


def test_suite_files(tmp_path):
  with pytest.raises(UserError, match="unknown suite 'nope'; choose from: .*leaderboard"):
    streams.suite("nope")
  (tmp_path / "a.toml").write_text("name = ")
  with pytest.raises(FileError, match="is no TOML"):
    streams.suite(str(tmp_path / "a.toml"))
  (tmp_path / "a.toml").write_text("name = 'a'\nfoo = 1")
  with pytest.raises(UserError, match="unknown 'foo'.*missing 'arl0'"):
    streams.suite(str(tmp_path / "a.toml"))
  (tmp_path / "a.toml").write_text(
    "base = 'leaderboard'\nname = 'a'\narl0 = 5\nlatents = {nominal = 1, after_s = 2.0}"
  )
  own, base = streams.suite(str(tmp_path / "a.toml")), streams.suite("leaderboard")
  assert (
    own == dataclasses.replace(base, name="a", arl0=5, latents={"nominal": 1, "after_s": 2.0})
    and own.latents != base.latents
  )
  for wrong in ("'nope'", "3", "'../leaderboard'"):
    (tmp_path / "a.toml").write_text(f"base = {wrong}")
    with pytest.raises(UserError, match="unknown base .*choose from: .*leaderboard"):
      streams.suite(str(tmp_path / "a.toml"))


def test_foreign_folders(tmp_path, small):
  with pytest.raises(FileError, match="holds no recorded streams"):
    streams.StreamSet(tmp_path)
  (tmp_path / "config.json").write_text(json.dumps({"version": 99}))
  with pytest.raises(FileError, match="version 99"):
    streams.StreamSet(tmp_path)
  with pytest.raises(UserError, match="robots of this set: walker"):
    small[0].get("car", [])


# ---- thresholds ----------------------------------------------------------------------------------


def test_narrow_finds_the_threshold_of_an_exponential_score():
  """Alarms above t of n exponential scores: n exp(-t); the least threshold with at most 20 of
  100,000 is ln 5000 = 8.5.
  """
  score = np.random.default_rng(0).exponential(size=100_000)
  calls = []

  def count(t):
    calls.append(t)
    return (score[:, None] > t).sum(0)

  threshold, tried = healthy.narrow(count, score, 20)
  assert (
    (score > threshold).sum() == 20
    and len(calls) <= healthy.ROUNDS
    and all(len(t) == healthy.TOGETHER for t in calls)
  )
  assert dict(tried)[threshold] == 20
  assert healthy.narrow(count, np.full(3, np.nan), 20) == (np.inf, [])


def test_narrow_goes_below_the_scores_where_evidence_restarts():
  """A CUSUM's scores without restarts lie far above its threshold."""
  assert healthy.narrow(lambda t: np.where(t < 5.0, 1000, 3), np.linspace(1.0, 1e5, 1000), 10)[
    0
  ] == pytest.approx(5.0, rel=0.02)


@pytest.fixture(scope="module")
def board(small):
  entries = [entries_of.entry("cusum", {"warmup": 150})] + [
    entries_of.entry(n, {"use": n}) for n in ("never", "always")
  ]
  return leaderboard.score(small[0], entries)


def pick(board, **want):
  return [r for r in board.rows if all(r[k] == v for k, v in want.items())]


def test_false_alarms_match_the_asked_rate(board):
  (row,) = pick(board, detector="cusum", fault="bias")
  steps = 16 * (1024 - 200)
  assert steps / 400 - 3 <= row["arl0_alarms"] <= steps / 400 and row["arl0"] == pytest.approx(
    steps / row["arl0_alarms"]
  )
  # the scoring seeds' own healthy streams: 8 x 824 steps hold 16 alarms at that rate, four
  # deviations of a Poisson count either way
  per_hour = 3600 / CONTROL_S / 400
  assert abs(row["false_alarms_per_hour"] - per_hour) < 4 * np.sqrt(16.5) / 16.5 * per_hour


def test_what_a_fault_takes_of_the_reward(small):
  """By a loop over its streams' rewards from their onsets on, and those that were recorded of the
  healthy robots of these seeds in the same steps.
  """
  held, parts, _ = small
  data = streams.load(held, "walker")
  key = ("gear", 1.0)
  who, _, recorded = parts["score", "fault"]
  after, healthy = [], []
  for k in data.own(key):
    within = slice(data.fault.onset[k], data.fault.onset[k] + data.horizon)
    after += np.asarray(data.fault.residual.reward)[within, k].tolist()
    [twin] = [
      i for i, lane in enumerate(who) if (lane.fault, lane.seed) == (None, data.fault.seed[k])
    ]
    healthy += recorded["reward"][within, twin].tolist()
  assert leaderboard.reward_lost(data, key) == pytest.approx(
    1 - np.mean(after) / np.mean(healthy),
    abs=0.5 * 2**-5 / np.mean(healthy),  # half a step of the rounded reward
  )
  gone = data.fault.residual._replace(reward=np.zeros_like(data.fault.residual.reward))
  assert leaderboard.reward_lost(data._replace(fault=data.fault._replace(residual=gone)), key) == 1


def test_stronger_faults_are_found_sooner_and_the_oracles_bound_all(board):
  late = lambda d, f, s: pick(board, detector=d, fault=f, severity=s)[0]["delay_steps"]
  assert late("cusum", "bias", 1.0) < late("cusum", "gear", 1.0) < late("cusum", "gear", 0.5)
  for f, s in (
    ("gear", 1.0),
    ("bias", 1.0),
  ):  # half a deviation is too little to fit an oracle on four seeds
    assert (
      late("true onset (oracle)", f, s)
      == 1
      <= late("likelihood_ratio (oracle)", f, s)
      <= late("cusum", f, s) + 2
    )
  assert [r["detector"] for r in board.overall.rows][0] == "true onset (oracle)"
  assert pick(board, detector="true onset (oracle)", fault="bias")[0]["cost_standard"] == 100
  assert pick(board, detector="never", fault="bias")[0]["cost_standard"] == 0
  assert pick(board, detector="never", fault="bias")[0]["miss_probability"] == 1


def test_pages_hold_the_stream_of_every_seed_and_its_alarms(small, board):
  """Alarms of a detector that always alarms stand at each stream's own onset; missed and found ones
  are as many as the row counts.
  """
  data = streams.load(small[0], "walker")
  assert {(p["fault"], p["severity"]) for p in board.faults} == set(small[0].faults("walker"))
  for found in board.faults:
    lives, own = [found] + found["others"], data.own((found["fault"], found["severity"]))
    assert [one["seed"] for one in lives] == data.fault.seed[own].tolist() and len(lives) > 1
    (row,) = pick(board, detector="cusum", fault=found["fault"], severity=found["severity"])
    assert sum(one["alarms"]["cusum"] is None for one in lives) == round(
      row["miss_probability"] * len(lives)
    )
    for k, one in zip(own, lives):
      assert (one["onset"], one["alarms"]["always"], one["alarms"]["never"]) == (
        data.fault.onset[k],
        data.fault.onset[k],
        None,
      )
      assert (
        one["early"]["always"] == one["first"] == one["onset"] - data.horizon // 2
        and "never" not in one["early"]
      )
      reward = np.asarray(one["channels"]["reward"], float)
      np.testing.assert_allclose(
        reward,
        data.fault.residual.reward[one["first"] :: one["every"], k][: len(reward)],
        rtol=5e-3,
      )  # three digits


def test_pages_hold_the_alarms_before_the_onset(small, board):
  """Those of a threshold so low that some streams have one, against the plain scan over whole
  streams.
  """
  data = streams.load(small[0], "walker")
  one = entries_of.entry("cusum", {"warmup": 150})
  low = one._replace(build=lambda threshold: one.build(3.5), calibrated=False)
  fired = np.asarray(program(low.build)(np.float32([0]), data.fault.residual)[0])[0]
  early = {}
  for found in leaderboard.score(small[0], [low]).faults:
    for k, life in zip(data.own((found["fault"], found["severity"])), [found] + found["others"]):
      ahead, after = (
        np.flatnonzero(fired[a:b, k]) + a
        for a, b in ((life["first"], life["onset"]), (life["onset"], life["onset"] + data.horizon))
      )
      assert life["early"].get("cusum") == (ahead[0] if len(ahead) else None)
      assert life["alarms"]["cusum"] == (after[0] if len(after) else None)
      early[int(k)] = life["early"].get("cusum")
  assert None in early.values() and len(set(early.values())) > 1


def test_a_longer_stream_changes_no_number(small, tmp_path, monkeypatch):
  """Rows, curves and pages are the same where each fault stream goes on for another 150 steps, in
  which whatever alarms is to count nowhere.
  """
  kept, after = SUITE.after(CONTROL_S), Suite.after
  with monkeypatch.context() as patch:
    patch.setattr(Suite, "after", lambda self, control_s: after(self, control_s) + 150)
    make_set(tmp_path / "longer")
  longer = streams.StreamSet(tmp_path / "longer")
  assert (
    longer.extent("walker") == (small[0].extent("walker")[0] + 150, small[0].extent("walker")[1])
    and SUITE.after(CONTROL_S) == kept
  )
  a, b = (streams.load(held, "walker").fault for held in (small[0], longer))
  np.testing.assert_array_equal(
    b.residual.opr[: a.onset.min() + kept], a.residual.opr[: a.onset.min() + kept]
  )
  assert np.isfinite(b.residual.opr[a.onset.max() + kept :]).any()
  entries = [
    entries_of.entry("cusum", {"warmup": 150}),
    entries_of.entry("rolling_sigma_plain", {"window": 150, "warmup": 100}),
  ]
  extra = [
    ("above", submissions.from_host(HostDetector(lambda: Above(2.5), "above", "opr", False)))
  ]
  a, b = (leaderboard.score(held, entries, extra=extra) for held in (small[0], longer))
  untimed = lambda rows: [{k: v for k, v in r.items() if k != "us_per_sample"} for r in rows]
  assert len(a.rows) > 12 and untimed(a.rows) == untimed(b.rows)
  assert a.overall == b.overall and a.curves == b.curves and a.faults == b.faults


def test_the_oracles_episodes_are_those_of_its_healthy_runs(board):
  """Streams that `by_seed` puts together are told apart again, whatever the order of their seeds
  and the ends of their episodes.
  """
  rng = np.random.default_rng(0)
  seeds, fired = np.array([3, 0, 3, 1, 0, 1]), rng.random((90, 6)) < 0.05
  episode = np.cumsum(rng.random((90, 6)) < 0.1, 0)
  data = types.SimpleNamespace(
    score=types.SimpleNamespace(seed=seeds, episode=episode), count_from=20
  )
  want = metrics.episode_alarm_probability(fired, episode, 20)
  assert (
    oracle.episodes(healthy.by_seed(fired, seeds, 20), data) == want
    and 0.2 < want["episode_alarm_probability"] < 0.8
  )
  for row in pick(board, detector="likelihood_ratio (oracle)"):
    hits, alarms = (
      row["episode_alarm_probability"] * 64,
      sum(row["stream_healthy_alarms"]),
    )  # eight whole episodes of 100 steps in each of 8 streams
    assert (
      hits == round(hits) <= alarms
      and (hits > 0) == (alarms > 0) == (row["fault"] == "gear")
      and row["us_per_sample"] is None
    )
  assert len(pick(board, detector="likelihood_ratio (oracle)")) == 3


def test_information_of_the_channel_is_that_of_the_shift(board):
  """Two independent channels, each shifted by 2 deviations: 2 x 2^2 / 2 = 4 nats; 2 seeds x 40
  faulty steps fit 34 coefficients of the after model, which costs a few tenths of a nat."""
  row = pick(board, detector="cusum", fault="gear", severity=1.0)[0]
  assert (
    abs(row["information_nats_per_step"] - 4.0) < 0.8
    and row["information_nats_per_step_ci"][0] < row["information_nats_per_step"]
  )


def test_a_fault_more_changes_no_other_number(small, board, tmp_path):
  more = dataclasses.replace(
    SUITE,
    robots={
      "walker": {
        "score": SUITE.robots["walker"]["score"] | {"push": (1.0,)},
        "tune": {"wind": (1.0,)},
      }
    },
  )
  make_set(tmp_path / "more", more)
  other = leaderboard.score(
    streams.StreamSet(tmp_path / "more"), [entries_of.entry("cusum", {"warmup": 150})]
  )
  for f, s in (("gear", 0.5), ("bias", 1.0)):
    a, b = (
      pick(board, detector="cusum", fault=f, severity=s)[0],
      pick(other, detector="cusum", fault=f, severity=s)[0],
    )
    assert {k: v for k, v in a.items() if k != "us_per_sample"} == {
      k: v for k, v in b.items() if k != "us_per_sample"
    }


def test_restarted_cusum_equals_the_detector(small):
  """The oracle's NumPy loop against detectors.likelihood_ratio with the same fit."""
  from mjx_cl.detectors.likelihood_ratio import likelihood_ratio

  held = small[0]
  data = streams.load(held, "walker")
  healthy = oracle.channels(data.tune.residual, slice(0, 4))[200:]
  own = np.flatnonzero(np.asarray(data.fault.fault) == "gear")[-SEEDS:]
  after = np.stack(
    [
      oracle.channels(data.fault.residual, slice(k, k + 1))[o : o + 40, 0]
      for k, o in zip(own, data.fault.onset[own])
    ],
    1,
  )
  p = autoregression.fit(healthy, after, 2)
  x = jax.tree.map(lambda a: jnp.asarray(a[:200, own]), data.fault.residual)
  x = x._replace(
    opr=jnp.nan_to_num(x.opr, nan=1.0),
    rpr=jnp.nan_to_num(x.rpr, nan=1.0),
    valid=jnp.ones_like(x.valid),
  )  # gaps are bridged otherwise there
  det = likelihood_ratio(p, 3.0, oracle.CHANNELS)
  start = jax.tree.map(lambda a: jnp.broadcast_to(a, (SEEDS,) + a.shape), det.init())
  alarm = jax.lax.scan(jax.vmap(det.update), start, x)[1]
  ratio = np.concatenate(
    [
      np.full((2, SEEDS), np.nan),
      autoregression.log_ratio(oracle.channels(jax.tree.map(np.asarray, x)), p),
    ]
  )
  fired, score = oracle.restarted(ratio, np.full(SEEDS, 3.0))
  np.testing.assert_allclose(
    alarm.score, score, rtol=1e-3, atol=1e-3
  )  # float32 sums of a few hundred terms
  assert (np.asarray(alarm.fired) == fired).mean() > 0.995


def program(build):
  """(thresholds (K,), residual (T, S)) -> (fired bool (K, T, S), score float32 (K, T, S)), jitted:
  the plain form that passes.py is held against.
  """
  import jax
  import jax.numpy as jnp

  def run(thresholds, residual):
    streams = residual.opr.shape[1]

    def one(threshold):
      detector = build(threshold)
      start = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (streams,) + jnp.shape(x)), detector.init()
      )
      alarm = jax.lax.scan(jax.vmap(detector.update), start, residual)[1]
      return alarm.fired, alarm.score

    return jax.vmap(one)(thresholds)

  return jax.jit(run)


# ---- passes --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
  "name, settings, together",
  [
    ("cusum", {"warmup": 150}, 1),
    ("rolling_sigma_plain", {"window": 150, "warmup": 100}, healthy.TOGETHER),
    ("rolling_sigma", {"window": 150, "warmup": 100, "smooth": 5, "lag": 3}, healthy.TOGETHER),
    ("knn", {"warmup": 150, "references": 30}, 1),
    ("multichart", {"charts": "e_detector,ewma"}, 1),
  ],
)
def test_passes_equal_whole_streams_at_every_threshold(small, name, settings, together):
  """Shared pasts, reused runs and unused lanes against the plain scan over whole streams."""
  data = streams.load(small[0], "walker")
  nominal, onset, horizon = (
    streams.joined(data.tune.residual, data.score.residual),
    data.fault.onset,
    data.horizon,
  )
  one, tune = entries_of.entry(name, settings), len(data.tune.stream)
  build = one.own("quadruped") if one.own else one.build  # whose residuals have a threshold each
  known = program_of.samples(nominal, data.fault.residual, onset, data.fault.seed, horizon)
  runner, plain = sweep.Runner(build), program(build)
  assert len(known.past) == SEEDS  # three faults of a seed share one
  counter = sweep.Counter(runner, known, tune, data.count_from)
  free = counter.score()
  assert runner.together == together
  np.testing.assert_allclose(
    free, np.asarray(plain(np.float32([np.inf]), nominal)[1])[0, :, :tune], rtol=1e-4, atol=1e-5
  )
  ran, run = [], runner.healthy
  runner.healthy = lambda lanes, data: ran.append(len(lanes)) or run(lanes, data)
  spread = free[data.count_from :][np.isfinite(free[data.count_from :])]
  for levels in (
    np.quantile(spread, [0.5, 0.9, 0.99, 0.999]),
    np.quantile(spread, [0.99, 0.9903, 0.9906, 0.991]),
    spread.max() + np.arange(1, 5),
  ):
    alarms = np.asarray(plain(levels.astype(np.float32), nominal)[0])[
      :, data.count_from :, :tune
    ].sum((1, 2))
    np.testing.assert_array_equal(counter.count(levels, 0.0), alarms)
  assert (
    sum(ran) < 3 * 4 * tune // together or together > 1 and ran[2] == 0
  )  # above all scores nothing need be run
  levels = np.quantile(spread, [0.9, 0.99, 0.999]).astype(np.float32)
  fired, score, before, _ = runner.faults(levels, known)
  whole = [np.asarray(x) for x in plain(levels, data.fault.residual)]
  after = [np.stack([x[:, k : k + horizon, s] for s, k in enumerate(onset)], 2) for x in whole]
  np.testing.assert_array_equal(fired, after[0])
  np.testing.assert_array_equal(
    before, np.where(np.arange(len(before))[:, None] < onset, whole[0][0, : onset.max()], False)
  )
  assert fired.any() or name in ("knn", "multichart")
  np.testing.assert_allclose(score, after[1], rtol=1e-4, atol=1e-5)


def test_the_rate_between_two_thresholds_is_met_on_every_stream():
  """The lower threshold alarms at other steps, as a detector does that starts afresh there: of
  these as many count as are wanted, on streams that were counted and on others alike.
  """
  steps, tune, others = 1000, 10, 400
  at = lambda first, n: np.tile((np.arange(steps) % 50 == first)[:, None], (1, n))
  high = lambda n: (at(0, n), np.zeros((steps, n)))  # 20 alarms a stream
  low = lambda n: at(7, n) | at(9, n) & (np.arange(n) % 2 > 0)  # 30, in the mean
  tuning = types.SimpleNamespace(residual=types.SimpleNamespace(opr=np.zeros((steps, tune))))
  data = types.SimpleNamespace(robot="walker", arl0=40, count_from=0, tune=tuning)
  fired, late, note = calibration.at_rate(
    data,
    {2.0: 20 * tune, 1.0: 30 * tune},
    2.0,
    steps * tune,
    high(tune + others),
    high(others),
    lambda level: (low(tune + others), low(others)),
  )
  assert fired[:, :tune].sum() == 25 * tune and "probability 0.167" in note
  for alarms in (fired[:, tune:], late):  # 2,000 added at random, sd 41
    np.testing.assert_allclose(alarms.sum() / others, 25, rtol=0.02)


def test_a_score_of_mostly_one_value_may_be_summed_in_another_order():
  random = np.random.default_rng(0)
  whole = np.where(random.random(4000) < 0.2, random.exponential(1.0, 4000), 0.0)
  cut = whole + 1e-6 * random.standard_normal(4000)
  assert submissions._differ(whole, cut) is None
  cut[3000] += 0.1
  assert submissions._differ(whole, cut) == 3000


def test_more_pasts_than_lanes(small, monkeypatch):
  """Each batch of pasts keeps rows of its own."""
  data = streams.load(small[0], "walker")
  known = program_of.samples(
    streams.joined(data.tune.residual, data.score.residual),
    data.fault.residual,
    data.fault.onset,
    data.fault.seed,
    data.horizon,
  )
  one = entries_of.entry("rolling_sigma_plain", {"window": 150, "warmup": 100})
  found = []
  for lanes in (20, 3):
    for module in (program_of, sweep):
      monkeypatch.setattr(module, "LANES_SHARED", lanes)
    found.append(
      sweep.Runner(one.build, program_of.room(small[0], ["walker"])).faults(
        np.float32([2.0, 3.0]), known
      )[:3]
    )
  for a, b in zip(*found):
    np.testing.assert_array_equal(a, b)
  assert found[0][2].any()


@pytest.mark.parametrize(
  "name, settings, lanes",
  [
    ("cusum", {"warmup": 150}, program_of.LANES),
    ("rolling_sigma_plain", {"window": 150, "warmup": 100}, program_of.LANES_SHARED),
  ],
)
def test_time_per_sample_counts_an_update_once(small, monkeypatch, name, settings, lanes):
  """One second for all lanes of the longest past and of one horizon; eight thresholds that share a
  score are one update.
  """
  data = streams.load(small[0], "walker")
  known = program_of.samples(
    streams.joined(data.tune.residual, data.score.residual),
    data.fault.residual,
    data.fault.onset,
    data.fault.seed,
    data.horizon,
  )
  monkeypatch.setattr(sweep, "time", types.SimpleNamespace(perf_counter=iter([5.0, 6.0]).__next__))
  us = sweep.Runner(entries_of.entry(name, settings).build).faults(np.float32([3.0]), known)[-1]
  assert us == pytest.approx(1e6 / (lanes * (data.fault.onset.max() + data.horizon)))


def test_other_pasts_are_not_shared(small):
  data = streams.load(small[0], "walker")
  nominal = streams.joined(data.tune.residual, data.score.residual)
  other = data.fault.residual._replace(opr=data.fault.residual.opr.copy())
  other.opr[100, 0] += 1.0
  known = program_of.samples(nominal, other, data.fault.onset, data.fault.seed, data.horizon)
  assert len(known.past) == SEEDS + 1 and (known.owner == known.owner[0]).sum() == 1


def test_a_run_tells_of_thresholds_that_part_no_score():
  scores = np.array([[1.0, np.nan], [3.0, 5.0]])
  assert (
    sweep.same(scores, 3.0, 4.9)
    and sweep.same(scores, 4.9, 3.0)
    and sweep.same(scores, 5.0, np.inf)
  )
  assert (
    not sweep.same(scores, 4.9, 5.0)
    and not sweep.same(scores, 2.9, 3.0)
    and not sweep.same(scores, np.inf, 4.9)
  )


def as_it_is(data, tried, threshold, counted, healthy, fault, at):
  """In place of calibration.at_rate: the alarms at the threshold, however few."""
  return healthy[0], fault[0], None


def test_a_threshold_used_otherwise_is_found_out_and_all_is_run(small, monkeypatch):
  """Fires a quarter below its threshold: no score lies between two thresholds, yet their alarms
  differ. Recorded OPR is rounded, so that no threshold gives the asked rate: left at that here.
  """
  monkeypatch.setattr(calibration, "at_rate", as_it_is)
  from mjx_cl.detectors.base import Alarm, Detector

  early = lambda t: Detector(lambda: jnp.int32(0), lambda s, x: (s, Alarm(x.opr > t - 0.25, x.opr)))
  data = streams.load(small[0], "walker")
  known = program_of.samples(
    streams.joined(data.tune.residual, data.score.residual),
    data.fault.residual,
    data.fault.onset,
    data.fault.seed,
    data.horizon,
  )
  got = calibration.examine(
    entries_of.Entry("early", early, True, False), data, sweep.Runner(early), known
  )
  opr = data.tune.residual.opr[data.count_from :]
  want, _ = healthy.narrow(
    lambda t: (opr[None] > t.astype(np.float32)[:, None, None] - np.float32(0.25)).sum((1, 2)),
    opr,
    opr.size / data.arl0,
  )
  assert (
    got.threshold == np.float32(want)
    and got.arl0["alarms"] == (opr > np.float32(got.threshold) - np.float32(0.25)).sum() > 0
  )


# ---- other ways in -------------------------------------------------------------------------------


def submission(held, score):
  """{stream: scores} of every stream but pasts, by `score` on OPR (steps,)."""
  m = held.meta
  out = {"stream": [], "step": [], "score": []}
  for n, steps, kind, full in zip(m["stream"], m["steps"], m["kind"], m["full"]):
    if kind != "past" and full:
      x = held.get("walker", [n]).residual.opr[: int(steps), 0]
      out["stream"].append(np.full(len(x), n))
      out["step"].append(np.arange(len(x)))
      out["score"].append(score(x))
  return {k: np.concatenate(v) for k, v in out.items()}


def trailing(x):
  """Mean of ln OPR over the last four known samples."""
  known = np.nan_to_num(np.log(x))
  return np.convolve(known, np.ones(4) / 4)[: len(x)]


def test_a_file_of_scores_is_scored(small, tmp_path):
  held = small[0]
  store.write_table(tmp_path / "s.parquet", submission(held, trailing))
  scores = submissions.read_submission(tmp_path / "s.parquet", held)
  board = leaderboard.score(held, [], extra=[("mine", submissions.from_scores(scores))])
  row = pick(board, detector="mine", fault="bias")[0]
  assert (
    row["latency_median_steps"] <= 4
    and 20 <= row["arl0_alarms"] <= 16 * 824 / 400
    and row["miss_probability"] == 0
  )


def test_a_rarer_rate_gains_nothing(small, tmp_path, monkeypatch):
  """Scores in two steps, whose only threshold alarms too seldom, and in three, of which one alarms
  too seldom and the next too often: where all faults are found at once, fewer false alarms are all
  that can be gained. Without the rule each gains.
  """
  held, rows = small[0], {}
  quiet = np.concatenate([trailing(held.get("walker", [n]).residual.opr[:, 0]) for n in
                          held.find("walker", "nominal", "tune").tolist()])  # fmt: skip
  rare, often = np.nanquantile(quiet, [1 - 2e-4, 1 - 2e-2])
  forms = {
    "plain": lambda x: x,
    "two": lambda x: (x > rare) * 1.0,
    "three": lambda x: (x > rare) * 1.0 + (x > often),
  }
  for name, form in forms.items():
    store.write_table(tmp_path / "s.parquet", submission(held, lambda x, f=form: f(trailing(x))))
    scores = submissions.read_submission(tmp_path / "s.parquet", held)
    for rule in (True, False):
      with monkeypatch.context() as patch:
        if not rule:
          patch.setattr(submissions, "at_rate", as_it_is)
        board = leaderboard.score(held, [], extra=[("mine", submissions.from_scores(scores))])
      rows[name, rule] = pick(board, detector="mine", fault="bias")
  cost = lambda name, rule: np.mean([r["cost_standard"] for r in rows[name, rule]])
  assert rows["plain", True] == rows["plain", False] and rows["plain", True][0]["note"] is None
  for name, words in (("two", "drawn at random"), ("three", "no threshold gives")):
    row = rows[name, True][0]
    assert words in row["note"] and cost(name, False) > cost("plain", True) >= cost(name, True)
    assert rows[name, False][0]["arl0_alarms"] < row["arl0_alarms"]
    assert row["arl0_alarms"] == rows["plain", True][0]["arl0_alarms"]  # as many as asked for


@pytest.mark.parametrize(
  "spoil, text",
  [
    (lambda t: {k: v[t["stream"] != t["stream"][-1]] for k, v in t.items()}, "streams are missing"),
    (lambda t: {k: v[1:] for k, v in t.items()}, "must have one row for each of its steps"),
    (lambda t: t | {"score": np.full_like(t["score"], np.nan)}, "no score is known"),
    (
      lambda t: t | {"score": np.where(np.arange(len(t["score"])) == 7, np.inf, t["score"])},
      "infinite",
    ),
    (lambda t: {"stream": t["stream"], "score": t["score"]}, "needs the columns"),
  ],
)
def test_broken_submissions_get_one_line(small, tmp_path, spoil, text):
  store.write_table(tmp_path / "s.parquet", spoil(submission(small[0], trailing)))
  with pytest.raises(FileError, match=text) as e:
    submissions.read_submission(tmp_path / "s.parquet", small[0])
  assert "\n" not in str(e.value)


def test_a_score_that_looks_ahead_is_found_out(small, tmp_path):
  ahead = lambda x: np.convolve(
    np.nan_to_num(np.log(x)), np.ones(5) / 5, "same"
  )  # a centred mean sees two samples of the future
  store.write_table(tmp_path / "s.parquet", submission(small[0], ahead))
  with pytest.raises(FileError, match="looks ahead"):
    submissions.read_submission(tmp_path / "s.parquet", small[0])


@pytest.mark.parametrize("split", ["score", "tune"])
def test_a_score_that_looks_ahead_in_healthy_streams_alone_is_found_out(small, tmp_path, split):
  """Clipped at a level of the whole healthy stream, scores give a lower threshold or fewer false
  alarms, and are those of a causal score under every fault.
  """
  held = small[0]
  table = submission(held, trailing)
  m = held.meta
  source = {
    int(n): int(p) if k == "probe" else int(n)
    for n, k, p in zip(m["stream"], m["kind"], np.nan_to_num(m["prefix"].astype(float)))
  }
  healthy = set(held.find("walker", "nominal", split).tolist())
  score = np.array(table["score"], float)
  for n in np.unique(table["stream"]):
    if source[int(n)] in healthy:
      own = table["stream"] == n
      score[own] = np.minimum(score[own], np.nanquantile(score[own], 0.9))
  store.write_table(tmp_path / "s.parquet", table | {"score": score})
  with pytest.raises(FileError, match="looks ahead"):
    submissions.read_submission(tmp_path / "s.parquet", held)


def test_the_scores_of_the_example(small, tmp_path, monkeypatch):
  """The script of docs/detection.md makes of the exported streams a file that is taken, with the
  mean of the last hundred in it.
  """
  from test_detect import example

  monkeypatch.chdir(tmp_path)
  submissions.export(small[0], "streams")
  exec(compile(example("scores.py"), "scores.py", "exec"), {})
  scores = submissions.read_submission("scores.parquet", small[0])
  n = int(small[0].find("walker", "fault", "score")[0])
  x = np.nan_to_num(np.log(small[0].get("walker", [n]).residual.opr[:, 0].astype(float)))
  np.testing.assert_allclose(scores[n][150], x[51:151].mean(), rtol=1e-6)
  assert np.isnan(scores[n][:99]).all() and np.isfinite(scores[n][99:]).all()


@pytest.fixture(scope="module")
def late(tmp_path_factory):
  """A set of two robots whose faults begin behind a warm-up of 500 steps."""
  folder, robots = tmp_path_factory.mktemp("late"), ("walker", "car")
  make_set(
    folder,
    dataclasses.replace(
      SUITE, onset=(620, 660), robots={r: SUITE.robots["walker"] for r in robots}
    ),
    robots,
  )
  return folder


def shown(page, part):
  """The one command `mjx-cl leaderboard ...` with `part` in it that a page of the documentation
  shows, as arguments.
  """
  text = (pathlib.Path(__file__).parents[2] / page).read_text()
  (line,) = [one for one in re.findall(r"mjx-cl (leaderboard [^`\n]*)", text) if part in one]
  return shlex.split(line, comments=True)


def test_the_pair_of_the_documentation_by_its_command(late, tmp_path, monkeypatch, mjx):  # noqa: F811
  from test_detect import example

  monkeypatch.chdir(tmp_path)
  pathlib.Path("level.py").write_text(example("level.py"))
  command, *more = shown("docs/detection.md", "level.py:level")
  code, out, err = mjx(command, late, *more, "--json")
  assert code == 0, err
  rows = json.loads(out)
  assert {r["detector"] for r in rows} == {"level.py:level", *leaderboard.ORACLES} and {
    r["robot"] for r in rows
  } == {"walker", "car"}
  for row in (r for r in rows if r["detector"] == "level.py:level"):
    assert 16 * 824 / 400 - 4 < row["arl0_alarms"] <= 16 * 824 / 400 and row["threshold"] > 0
    assert (
      row["fault"] != "bias" or row["miss_probability"] == 0 and row["latency_median_steps"] <= 2
    )  # four deviations


def test_detectors_by_channel_and_from_files_stand_beside_the_others(late, tmp_path, monkeypatch):
  """In the board's order, one's own behind; each name once."""
  from test_detect import example

  monkeypatch.chdir(tmp_path)
  pathlib.Path("level.py").write_text(example("level.py"))
  names = [
    e.name
    for e in entries_of.chosen(
      ("level.py:level@opr", "never", "cusum@opr+reward", "cusum@opr", "never", "cusum@opr+reward"),
      "walker",
    )
  ]
  assert names == ["never", "cusum@opr", "level.py:level@opr", "cusum@opr+reward"]
  assert entries_of.chosen(("none",), "walker") == [] and [
    e.name for e in entries_of.chosen((), "walker")
  ] == list(entries_of.variants())
  one = entries_of.chosen(("level.py:level@opr",), "walker")[0]
  assert one.calibrated and not one.reference


def test_what_is_no_detector_gets_one_line(mjx, refused, late, tmp_path, monkeypatch):  # noqa: F811
  monkeypatch.chdir(tmp_path)
  pathlib.Path("odd.py").write_text(
    "class Plain:\n  def update(self, x):\n    return False\ndef broken(threshold=1.0):\n  "
    "return {}['x']\n"
    "import jax.numpy as jnp\n"
    "from mjx_cl.detectors import Alarm, Detector, scalar\n"
    "@scalar\n"
    "def blind(threshold=1.0):\n"
    "  update = lambda state, x: (state, Alarm(x > threshold, x * jnp.nan))\n"
    "  return Detector(lambda: jnp.float32(0), update)\n"
  )
  say = lambda code, *names: refused(
    code, "leaderboard", late, "--out", "board", "--detector", *names
  )
  assert "no file none.py" in say(1, "none.py:level")
  assert "nothing of the name 'level'" in say(2, "odd.py:level")
  assert "mjx-cl leaderboard --add" in say(2, "never", "odd.py:Plain")
  assert "detector 'odd.py:broken' failed: KeyError" in say(1, "odd.py:broken")
  assert "unknown detector 'cusm'" in say(2, "cusm@opr") and "unknown detector 'x'" in say(2, "x")
  assert "'nothing'" in say(2, "cusum@nothing") and "channels of its own" in say(2, "hotelling@opr")
  assert not pathlib.Path("board").exists()
  code, _, err = mjx("leaderboard", late, "--out", "board", "--detector", "odd.py:blind@opr")
  assert code == 1 and "odd.py:blind@opr' knows no score on the healthy streams of walker" in err


@pytest.mark.parametrize(
  "part, name, others",
  [("mine.py:Mine", "Mine", set()), ("river.drift:PageHinkley", "PageHinkley", {"cusum@opr"})],
)
def test_the_commands_for_ones_own_detector(late, tmp_path, monkeypatch, mjx, part, name, others):  # noqa: F811
  """A class out of a file and a river detector, calibrated to the asked rate; both see the fault of
  four deviations.
  """
  if part.startswith("river"):
    pytest.importorskip("river")
  monkeypatch.chdir(tmp_path)
  (block,) = [
    b
    for b in re.findall(
      r"^```python\n(.*?)^```",
      (pathlib.Path(__file__).parents[2] / "docs/extending.md").read_text(),
      re.S | re.M,
    )
    if "# mine.py" in b
  ]
  pathlib.Path("mine.py").write_text(block)
  command, *more = shown("docs/extending.md", part)
  code, out, err = mjx(command, late, *more, "--json")
  assert code == 0, err
  rows = json.loads(out)
  assert {r["detector"] for r in rows} == {name, *others, *leaderboard.ORACLES} and {
    r["robot"] for r in rows
  } == {"car"}
  assert (pathlib.Path(more[more.index("--out") + 1]) / "leaderboard.html").exists()
  (row,) = [r for r in rows if r["detector"] == name and r["fault"] == "bias"]
  assert row["threshold"] > 0 and 0 < row["arl0_alarms"] <= 16 * 824 / 400
  assert row["miss_probability"] == 0 and row["us_per_sample"] > 0


class Above:
  """A detector as a newcomer writes it."""

  def __init__(self, threshold=2.0):
    self.threshold, self.score = threshold, 0.0

  def update(self, x):
    self.score = x
    return x > self.threshold


def test_a_plain_python_class_is_calibrated_and_scored(small, monkeypatch):
  monkeypatch.setattr(submissions, "at_rate", as_it_is)  # recorded OPR is rounded
  host = lambda value: HostDetector(lambda: Above(value), "above", "opr", False)
  board = leaderboard.score(
    small[0], [], extra=[("above", submissions.from_host(host, "threshold"))]
  )
  row = pick(board, detector="above", fault="bias")[0]
  x = small[0].get("walker", small[0].find("walker", "nominal", "tune")).residual.opr[200:]
  most = x.size / 400
  lower = x[x <= row["threshold"]].max()  # the next value that occurs is too low
  assert (x > row["threshold"]).sum() == row["arl0_alarms"] <= most < (x >= lower).sum()
  assert row["latency_median_steps"] <= 6 and row["us_per_sample"] > 0
  fixed = leaderboard.score(
    small[0],
    [],
    extra=[
      ("above", submissions.from_host(HostDetector(lambda: Above(1.0), "above", "opr", False)))
    ],
  )
  assert (
    pick(fixed, detector="above", fault="bias")[0]["threshold"] is None
    and pick(fixed, detector="above", fault="bias")[0]["arl0"] < 10
  )


def test_crossings_count_excursions():
  score = np.array([0, 2, 3, np.nan, 3, 0, np.nan, 5, 1.0])[:, None]
  np.testing.assert_array_equal(np.flatnonzero(submissions.crossings(score, 1.5)[:, 0]), [1, 7])


def test_export_is_whole_streams(small, tmp_path):
  held = small[0]
  (file,) = submissions.export(held, tmp_path)
  table = store.read_table(file)
  n = int(held.find("walker", "probe")[0])
  own = table["stream"] == n
  np.testing.assert_array_equal(table["opr"][own], held.get("walker", [n]).residual.opr[:, 0])
  assert set(table) == {"stream", "step", "episode", "terminated"} | set(streams.COLUMNS)
  before = pathlib.Path(file).stat().st_mtime_ns
  with pytest.raises(UserError, match="holds walker.parquet already; give --overwrite"):
    submissions.export(held, tmp_path)
  assert pathlib.Path(file).stat().st_mtime_ns == before and submissions.export(
    held, tmp_path, overwrite=True
  ) == [file]
  (tmp_path / "config.json").write_text(
    "{}"
  )  # as a recorded set has it, whose files have these names
  with pytest.raises(UserError, match="folder of a recording"):
    submissions.export(held, tmp_path, overwrite=True)


def test_files(small, board, tmp_path):
  leaderboard.write(board, tmp_path, {"command": "mjx-cl leaderboard"})
  table = store.read_table(tmp_path / "leaderboard.parquet")
  assert len(table["detector"]) == len(board.rows) and {
    "cost_standard_low",
    "cost_standard_high",
    "auroc",
  } <= set(table)
  assert "cusum" in (tmp_path / "leaderboard.html").read_text()
  above = [r for r in board.rows if r["efficiency"] is not None and r["efficiency"] > 1]
  assert above and all(
    r["note"].startswith("above 1: ") for r in above
  )  # what the page tells at such a figure


def test_every_entry_of_the_default_board_is_built():
  for name, settings in entries_of.variants().items():
    one = entries_of.entry(name, settings)
    assert isinstance(one.build(3.0), detectors.Detector)
