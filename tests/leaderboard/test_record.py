"""Recording a suite with real robots and a tiny agent, and the commands on what it writes: record,
leaderboard.
"""

import dataclasses
import json
import os
import pathlib

import numpy as np
import pytest
from test_cli import mjx, refused  # noqa: F401  fixtures
from test_leaderboard import submission, trailing
from test_run import saved  # noqa: F401  a fixture

from mjx_cl import envs
from mjx_cl.cli import app
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import tables
from mjx_cl.leaderboard import lives, parts, room, streams
from mjx_cl.leaderboard import record as recording
from mjx_cl.training import agents

SPLITS = ("score", "tune")

SUITE = """
name = "mini"
arl0 = 100
count_from = 64
onset = [100, 120]
horizon_s = 20.0
seeds = {score = [0, 1], tune = [100, 101]}
nominal = {steps = 256, score = 1, tune = 1}
latents = {nominal = 1, after_s = 1.0}
[robots.walker]
score.gear = [0.5]
score."noise:all" = [1.0]
tune.push = [1.0]
"""


@pytest.fixture(scope="module")
def recorded(saved, tmp_path_factory):
  """(folder of a set, its suite file): two walkers a split, recorded by the command."""
  from mjx_cl.cli import app

  folder = tmp_path_factory.mktemp("record")
  (folder / "mini.toml").write_text(SUITE)
  assert (
    app.main(
      [
        "record",
        str(folder / "mini.toml"),
        "--out",
        str(folder / "set"),
        "--agent",
        str(saved),
        "--physics",
        "native",
      ]
    )
    == 0
  )
  return folder / "set", folder / "mini.toml"


@pytest.mark.slow
def test_a_set_of_real_robots(recorded):
  held = streams.StreamSet(recorded[0])
  assert (
    held.robots == ["walker"]
    and held.faults("walker") == [("gear", 0.5), ("noise", 1.0)]
    and held.faults("walker", "tune") == [("push", 1.0)]
  )
  got = held.get("walker", held.find("walker", "fault", "score"))
  healthy = held.get("walker", held.find("walker", "past", "score"))
  assert (
    got.fault == ["gear"] * 2 + ["noise"] * 2
    and got.target[2] == "all"
    and set(got.seed) == {0, 1}
    and ((got.onset >= 100) & (got.onset < 120)).all()
  )
  for k, onset in enumerate(got.onset):
    np.testing.assert_array_equal(
      got.residual.opr[:onset, k], healthy.residual.opr[:onset, k % 2]
    )  # one past
    x, y = (
      got.residual.opr[onset + 20 : onset + 400, k],
      healthy.residual.opr[onset + 20 : onset + 400, k % 2],
    )
    assert (
      x != y
    ).mean() > 0.5  # and another life afterwards; half precision lets some equal values meet
  assert held.config["details"]["walker"]["pasts_that_differ"] == 0
  noisy = np.nanmean(got.residual.groups[130:, 2:], (0, 1)) / np.nanmean(
    healthy.residual.groups[130:], (0, 1)
  )
  assert (
    (noisy > 1.05).sum() >= 4
  )  # noise of one deviation on every channel shows in the groups, even of an untrained agent
  tuned = held.get("walker", held.find("walker", "fault", "tune", "gear"))
  assert (
    np.isfinite(tuned.residual.opr[150:]).any()
    and np.isnan(tuned.residual.reward[tuned.onset[0] :]).all()
  )  # for oracles: OPR and RPR alone
  assert (
    np.isfinite(got.residual.latent[got.onset[0] + 39, 0]).all()
    and np.isnan(got.residual.latent[got.onset[0] + 41, 0]).all()
  )


def test_a_recording_goes_on_where_it_was_cut_off(recorded, saved, tmp_path):
  """Kept parts are taken as they are, a broken one is recorded again; the set has the same bytes."""
  suite = streams.suite(str(recorded[1]))
  lived = []
  with pytest.raises(KeyboardInterrupt):

    def stop(part, done, steps, lanes):
      lived.append(part)
      if part == "walker tune nominal":
        raise KeyboardInterrupt

    recording.record(suite, tmp_path, physics="native", agent=str(saved), progress=stop)
  assert not list(tmp_path.glob("*.parquet")) and len(list((tmp_path / "work").glob("*.npz"))) == 2
  part = tmp_path / "work" / "walker-score-nominal.npz"
  part.write_bytes(part.read_bytes()[:1000])
  lived.clear()
  recording.record(
    suite,
    tmp_path,
    physics="native",
    agent=str(saved),
    progress=lambda part, *_: lived.append(part),
  )
  assert list(dict.fromkeys(lived)) == [
    "walker score nominal",
    "walker tune nominal",
    "walker tune fault",
  ]
  for name in ("walker.parquet", "walker_latents.parquet", "streams.parquet"):
    assert (tmp_path / name).read_bytes() == (recorded[0] / name).read_bytes()


TWO = """name = "two"
arl0 = 100
count_from = 50
onset = [100, 120]
horizon_s = 2.0
seeds = {score = [0, 1], tune = [100, 101]}
nominal = {steps = 128, score = 1, tune = 1}
latents = {nominal = 1, after_s = 1.0}
robots.walker = {score = {gear = [0.5]}, tune = {push = [1.0]}}
robots.car = {score = {friction = [0.5]}, tune = {wind = [1.0]}}
"""


@pytest.mark.parametrize(
  "good, bad",
  [
    ("count_from = 50", "count_from = 5e1"),
    ("[100, 120]", "[100.0, 120]"),
    ("tune = [100, 101]", "tune = [100, 101.0]"),
    ("steps = 128", "steps = 1.28e2"),
    ("{nominal = 1,", "{nominal = true,"),
  ],
)
def test_counts_of_a_suite_are_whole_numbers(tmp_path, good, bad):
  """TOML's 5e1 is a float, which indexes nothing: said before hours of recording."""
  (tmp_path / "two.toml").write_text(TWO.replace(good, bad))
  with pytest.raises(UserError, match="whole numbers below .*; got .*[.T]"):
    streams.suite(str(tmp_path / "two.toml"))


@pytest.mark.parametrize(
  "good, bad",
  [
    ("steps = 128", "steps = 2_000_000_000"),
    ("onset = [100, 120]", "onset = [2_000_000_000, 2_000_000_001]"),
    ("horizon_s = 2.0", "horizon_s = 2e9"),
    ("tune = [100, 101]", "tune = [100, 2_000_000_000]"),
    ("steps = 128, score = 1", "steps = 128, score = 2_000_000_000"),
  ],
)
def test_what_memory_does_not_hold_is_refused_at_first(refused, tmp_path, good, bad):  # noqa: F811
  (tmp_path / "two.toml").write_text(TWO.replace(good, bad))
  text = refused(2, "record", tmp_path / "two.toml", "--out", tmp_path / "set")
  assert "suite 'two': streams of walker need" in text and "GiB may be used; fewer seeds" in text
  assert not list((tmp_path / "set").iterdir())


def test_the_memory_of_a_recording_follows_its_lanes_and_steps(tmp_path):
  (tmp_path / "two.toml").write_text(TWO)
  suite, env = streams.suite(str(tmp_path / "two.toml")), envs.make("walker", "native")
  learner, after = agents.of(env).agent.config, lambda s: s.after(env.spec.control_s)
  need = lambda s: room.of(s, "walker", env.spec, learner)
  lanes = lambda kind: sum(
    len(parts.who_lives(suite, "walker", split, kind, env.spec.control_s)[0]) for split in SPLITS
  )
  row = room.COPIES * room.ROW
  more = dataclasses.replace(suite, nominal=suite.nominal | {"steps": 1128})
  assert need(more) - need(suite) == row * lanes("nominal") * 1000
  later = dataclasses.replace(suite, horizon_s=4.0)
  assert need(later) - need(suite) == row * lanes("fault") * (after(later) - after(suite))


@pytest.fixture
def two(tmp_path, monkeypatch):
  """record(name, robots, seed): bytes of the tables and config.json of the set in tmp_path / name,
  of a suite of two robots, lives made up from the seed.
  """
  (tmp_path / "two.toml").write_text(TWO)
  suite, draw = streams.suite(str(tmp_path / "two.toml")), [0]

  def live(env, trained, who, keys, onsets, steps, watch, signed, progress):
    rng = np.random.default_rng([draw[0], len(env.spec.obs), steps])
    life = {
      c: np.repeat(rng.gamma(4.0, size=(steps, 1)).astype(np.float32), len(who), 1)
      for c in streams.COLUMNS
    }
    errors = rng.normal(size=(steps, 1, len(env.spec.obs) + 1)).astype(np.float32)
    return life | {
      "innovation": np.repeat(errors, len(who), 1),
      "latent": np.zeros((steps, len(who), streams.LATENT), np.float16),
      "episode": np.zeros((steps, len(who)), np.int16),
      "terminated": np.zeros((steps, len(who)), bool),
      "target": np.array([lane.target or "all" for lane in who]),
    }

  monkeypatch.setattr(lives, "live", live)

  def record(name, robots=(), seed=0, **edit):
    draw[0], out, own = seed, tmp_path / name, dataclasses.replace(suite, **edit)
    recording.claim(own, out, True, robots)
    recording.record(own, out, robots, physics="native", command=f"record {seed}")
    recording.clear(out)
    config = json.loads((out / "config.json").read_text())
    return {p.name: p.read_bytes() for p in out.glob("*.parquet")}, config

  return record


def test_one_robot_of_a_set_is_recorded_anew(two, tmp_path, capsys):
  """The others' streams keep bytes, numbers and provenance; recorded one by one, a set has the
  bytes of one recorded at once.
  """
  record = two
  whole, config = record("set")
  assert (
    set(whole)
    == {f"{r}{end}.parquet" for r in ("walker", "car") for end in ("", "_latents")}
    | {"streams.parquet"}
    and "kept" not in config
  )
  again, config = record("set", ("walker",), 1)
  assert {name for name in whole if whole[name] != again[name]} == {
    "walker.parquet"
  }  # its latents are 0 in both
  assert (
    config["command"] == "record 1"
    and config["kept"]["car"]["command"] == "record 0"
    and set(config["kept"]) == {"car"}
  )
  assert set(config["agents"]) == {"walker", "car"} and all(
    set(a) == {"name", "agent", "crc32"} for a in config["agents"].values()
  )
  assert (
    set(config["details"])
    == set(config["stream_steps"])
    == set(config["suite"]["robots"])
    == {"walker", "car"}
  )
  assert (
    record("set", ("walker",), 0)[0] == whole
    and record("set", ("car",), 2)[1]["kept"]["walker"]["command"] == "record 0"
  )
  assert (
    app.main(
      [
        "record",
        str(tmp_path / "two.toml"),
        "--out",
        str(tmp_path / "set"),
        "--robot",
        "car",
        "--overwrite",
        "--physics",
        "native",
      ]
    )
    == 0
  )
  assert "walker: 2,448 stream-steps, recorded before" in capsys.readouterr().out
  one, _ = record("by one", ("walker",))
  assert set(one) == {"walker.parquet", "walker_latents.parquet", "streams.parquet"}
  grown, config = record("by one", ("car",))
  assert grown == whole and len(streams.StreamSet(tmp_path / "by one").robots) == 2
  with pytest.raises(UserError, match="another suite .its arl0., whose other robots"):
    record("set", ("walker",), 0, arl0=200)
  assert {
    p.name: p.read_bytes() for p in (tmp_path / "by one").glob("*.parquet")
  } == whole and streams.StreamSet(tmp_path / "set").robots


@pytest.mark.parametrize("cut", range(1, 6))
def test_a_set_that_was_cut_off_between_its_files_is_none(two, tmp_path, monkeypatch, cut):
  """Killed while a robot's new files move into place: nobody reads old beside new, the others'
  streams are there, and the same command ends it.
  """
  record, moved, replace = two, [], os.replace
  whole, _ = record("set")
  wanted, _ = record("wanted", seed=1)

  def kill(source, target):
    if (
      pathlib.Path(target).parent == tmp_path / "set" or pathlib.Path(target).name == recording.HELD
    ):
      moved.append(target)
      if len(moved) == cut:
        raise KeyboardInterrupt
    replace(source, target)

  monkeypatch.setattr(os, "replace", kill)
  with pytest.raises(KeyboardInterrupt):
    record("set", ("walker",), 1)
  monkeypatch.setattr(os, "replace", replace)
  if cut > 1:
    with pytest.raises(FileError, match="holds no recorded streams"):
      streams.StreamSet(tmp_path / "set")
  else:
    assert streams.StreamSet(tmp_path / "set").robots == ["walker", "car"]
  again, config = record("set", ("walker",), 1)
  assert config["kept"]["car"]["command"] == "record 0" and not (tmp_path / "set" / "work").exists()
  assert again == {name: (wanted if "walker" in name else whole)[name] for name in whole}


def test_record_refuses(refused, recorded, tmp_path):
  assert "holds a recorded set" in refused(2, "record", recorded[1], "--out", recorded[0])
  assert "unknown suite 'x'; choose from: leaderboard" in refused(
    2, "record", "x", "--out", tmp_path / "a"
  )
  assert "has no robot 'car'; choose from: walker" in refused(
    2, "record", recorded[1], "--robot", "car", "--out", tmp_path / "b"
  )
  (tmp_path / "c").mkdir()
  (tmp_path / "c" / "mine.txt").write_text("x")
  assert "is no folder of a recording" in refused(2, "record", recorded[1], "--out", tmp_path / "c")
  assert (tmp_path / "c" / "mine.txt").read_text() == "x"


def test_the_leaderboard_command(mjx, recorded, tmp_path):
  (tmp_path / "mine.py").write_text(
    "class Mine:\n  def __init__(self, level=1.0):\n    self.level = level\n"
    "  def update(self, x):\n    return x > self.level\n"
  )
  code, out, err = mjx(
    "leaderboard",
    recorded[0],
    "--out",
    tmp_path / "board",
    "--detector",
    "never",
    "--add",
    f"{tmp_path / 'mine.py'}:Mine",
    "--threshold",
    "level",
    "--json",
  )
  assert code == 0, err
  rows = json.loads(out)
  assert {r["detector"] for r in rows} == {
    "never",
    "Mine",
    "true onset (oracle)",
    "likelihood_ratio (oracle)",
  } and len(rows) == 4 * 2
  assert all(r["arl0_alarms"] <= 2 * 192 / 100 for r in rows if r["detector"] == "Mine")
  assert {p.name for p in (tmp_path / "board").iterdir()} == {
    "leaderboard.parquet",
    "leaderboard_overall.parquet",
    "leaderboard.html",
    "leaderboard.json",
  }
  code, out, _ = mjx(
    "query",
    tmp_path / "board",
    "select count(*) as n from leaderboard where robot = 'walker'",
    "--json",
  )
  assert code == 0 and json.loads(out) == [{"n": 8}]


def test_a_file_of_scores_through_the_command(mjx, refused, recorded, tmp_path):
  held = streams.StreamSet(recorded[0])
  tables.write_table(tmp_path / "s.parquet", submission(held, trailing))
  code, out, err = mjx(
    "leaderboard",
    recorded[0],
    "--out",
    tmp_path / "board",
    "--detector",
    "none",
    "--submit",
    tmp_path / "s.parquet",
    "--name",
    "mine",
    "--json",
  )
  assert code == 0 and {r["detector"] for r in json.loads(out)} >= {"mine"}, err
  (tmp_path / "bad.parquet").write_bytes(b"PAR1 not")
  assert "cannot read" in refused(
    1, "leaderboard", recorded[0], "--submit", tmp_path / "bad.parquet"
  )
  code, out, _ = mjx("leaderboard", recorded[0], "--export", tmp_path / "out", "--json")
  assert code == 0 and json.loads(out) == [str(tmp_path / "out" / "walker.parquet")]


def test_the_leaderboard_refuses(refused, recorded, tmp_path):
  assert "unknown detector 'x'; choose from:" in refused(
    2, "leaderboard", recorded[0], "--detector", "x"
  )
  assert "has no robot 'car'; choose from: walker" in refused(
    2, "leaderboard", recorded[0], "--detector", "never", "--robot", "car"
  )
  assert "holds no recorded streams" in refused(1, "leaderboard", tmp_path)
  assert "the board has a detector 'never' already" in refused(
    2,
    "leaderboard",
    recorded[0],
    "--detector",
    "never",
    "--add",
    "river.drift:PageHinkley",
    "--name",
    "never",
  )
