"""The board of methods: what it reads and refuses, and lives of one's own beside the published."""

import collections
import dataclasses
import json
import pathlib
import shutil

import numpy as np
import pyarrow.parquet as parquet
import pytest
from test_page import browser, driver  # noqa: F401  fixtures
from test_suite import MINI
from test_transfer import agent, saved  # noqa: F401  fixtures: a tiny agent of the car

from mjx_cl.cli import app
from mjx_cl.cli import methods as methods_cli
from mjx_cl.config import RunConfig, own_agent
from mjx_cl.errors import FileError, UserError
from mjx_cl.leaderboard import methods, methods_page
from mjx_cl.runs import bench, suite
from mjx_cl.scoring import adaptation

RESULTS = pathlib.Path(__file__).parents[2] / "results"
STEADY = RESULTS / "methods"  # six seeds, a part of five arms and one of two
FILES = set(methods.FILES)


@pytest.fixture
def called(capsys):
  """called(*argv): (exit code, output, errors) of `mjx-cl leaderboard --methods`."""

  def call(*argv):
    capsys.readouterr()
    code = app.main(["leaderboard", "--methods", *map(str, argv)])
    return code, *capsys.readouterr()

  return call


@pytest.fixture
def nothing_ships(monkeypatch, tmp_path):
  monkeypatch.setattr(methods, "LIVES", tmp_path / "no such file")


def test_lives_are_the_rows_of_runs():
  lives = methods.of_folder(STEADY)
  assert len(lives) == 5 * 6 + 2 * 6 and {x["setting"] for x in lives} == {"steady", "mean"}
  rows = parquet.read_table(STEADY / "steady" / "runs.parquet").to_pylist()
  calm = [x for x in lives if x["method"] == "calm" or x["method"].endswith(":calm")]
  own = [r for r in rows if r["arm"] == calm[0]["method"]]
  assert [x["return_lost"] for x in calm] == [r["return_lost"] for r in own]
  assert {x["steps"] for x in calm} == {14_000} and {x["onset"] for x in calm} == {2_000}


def test_a_life_ends_with_its_next_change():
  """The car of the paper: moved elsewhere some time after step 10,000, socks from 52,000 on."""
  lives = [x for x in methods.of_folder(RESULTS / "paper") if x["robot"] == "car"]
  rows = parquet.read_table(RESULTS / "paper" / "car" / "runs.parquet").to_pylist()
  first, second = ({r["stream"]: r["onset"] for r in rows if r["change"] == k} for k in (0, 1))
  own = [(second[s] - first[s], first[s]) for s in sorted(first)]
  assert sorted((x["steps"], x["onset"]) for x in lives) == sorted(own)


def test_agents_are_apart_and_a_setting_is_theirs_together():
  lives = methods.of_folder(RESULTS / "agents")
  assert {x["setting"] for x in lives} == {"walker"}
  assert {x["agent"] for x in lives} == {"walker", "walker-2", "walker-3"}
  row = next(r for r in adaptation.board(lives).overall if r["method"] == "detector")
  assert row["agents"] == 3 and row["streams"] == 60
  assert row["score_ci"][0] < row["score"] < row["score_ci"][1]


def test_the_command_writes_what_it_shows(called, nothing_ships, tmp_path):
  code, out, _ = called(STEADY, "--out", tmp_path / "board")
  assert code == 0 and "42 lives" in out
  assert {p.name for p in (tmp_path / "board").iterdir()} == FILES
  lives = methods.of_folder(STEADY)
  board = adaptation.board(lives)
  table = parquet.read_table(tmp_path / "board" / "methods_overall.parquet").to_pylist()
  assert [r["score"] for r in table] == pytest.approx([r["score"] for r in board.overall])
  assert table[0]["score_low"] == pytest.approx(board.overall[0]["score_ci"][0])
  again = parquet.read_table(tmp_path / "board" / "methods_lives.parquet").to_pylist()
  anew = adaptation.board(again)  # a comparison needs no rerun
  assert [r["score"] for r in anew.overall] == pytest.approx([r["score"] for r in board.overall])


def test_lives_of_ones_own_stand_beside_the_published(called, monkeypatch, tmp_path):
  lives = methods.of_folder(STEADY)
  is_own = lambda x: x["method"].endswith(":calm")
  monkeypatch.setattr(methods, "LIVES", tmp_path / "lives.parquet")
  methods.write_lives([x for x in lives if not is_own(x)], methods.LIVES)
  own = shutil.copytree(STEADY, tmp_path / "mine")
  for part in ("steady", "mean"):  # the arm of one's own alone
    table = parquet.read_table(own / part / "runs.parquet")
    mask = [a.endswith(":calm") for a in table["arm"].to_pylist()]
    parquet.write_table(table.filter(mask), own / part / "runs.parquet")
  code, out, err = called(own, "--out", tmp_path / "board", "--json")
  assert code == 0, err
  both = json.loads(out)
  assert [r["score"] for r in both["overall"]] == pytest.approx(
    [r["score"] for r in adaptation.board(lives).overall]
  )
  assert "calm" in {r["method"] for r in both["overall"]}  # by its function's name
  code, out, err = called(own, "--out", tmp_path / "named", "--name", "still water", "--json")
  assert "still water" in {r["method"] for r in json.loads(out)["overall"]}
  code, _, err = called(own, "--out", tmp_path / "taken", "--name", "none")
  assert code == 2 and "has a method 'none' already" in err


def test_lives_of_two_folders_stand_beside_each_other(called, tmp_path):
  """The arms of one folder without `none`, and `none` from another, as if one run had both."""
  two = [shutil.copytree(STEADY, tmp_path / name) for name in ("one", "other")]
  for k, folder in enumerate(two):
    for part in ("steady", "mean"):
      table = parquet.read_table(folder / part / "runs.parquet")
      mask = [(a == "none") == bool(k) for a in table["arm"].to_pylist()]
      parquet.write_table(table.filter(mask), folder / part / "runs.parquet")
  code, out, err = called(two[0], "--beside", two[1], "--out", tmp_path / "board", "--json")
  assert code == 0, err
  whole = adaptation.board(methods.of_folder(STEADY)).overall
  assert [r["score"] for r in json.loads(out)["overall"]] == pytest.approx(
    [r["score"] for r in whole]
  )


def test_what_is_published_stays_and_new_seeds_bring_their_own_none():
  lives = methods.of_folder(STEADY)
  own = [x | {"return_lost": 0.0} for x in lives if x["method"] == "none" and x["seed"] == 100]
  own += [x | {"seed": 300} for x in own]
  both = methods.joined(lives, own)
  # one's own `none` of a seed that is published stays for one's own lives alone
  assert len(both) == len(lives) + 4 and sum(x["return_lost"] == 0.0 for x in both) == 4
  rows = {r["setting"]: r for r in adaptation.board(both).rows if r["method"] == "none"}
  assert {r["streams"] for r in rows.values()} == {7}
  kept, single = methods.counted([x | {"seed": 400} for x in lives if x["method"] != "none"] + both)
  assert len(kept) == len(both) and single == len(lives) - 12


def test_folders_beside_each_other_in_any_order_hold_all_lives(called, tmp_path):
  """Two suites: neither stands by itself."""
  two = (RESULTS / "agents", STEADY)
  apart = [methods.of_folder(folder) for folder in two]
  for order in (two, two[::-1]):
    lives = methods.together(order)
    assert len(lives) == sum(map(len, apart)) and not any(x["own"] for x in lives)
    assert {x["setting"] for x in lives} == {x["setting"] for own in apart for x in own}
  code, out, err = called("--beside", *two, "--out", tmp_path / "board")
  assert code == 0 and f"{len(lives)} lives" in out, err


def test_another_machines_lives_are_measured_against_their_own_none():
  """There every life loses 0.2 a step more."""
  lives = methods.of_folder(STEADY)
  own = [x | {"return_lost": x["return_lost"] + 0.2 * x["steps"]} for x in lives]
  own = [x | {"method": x["method"].replace("oracle", "mine")} for x in own]
  rows = adaptation.board(methods.joined(lives, own)).rows
  beyond = {(r["setting"], r["method"]): r["beyond"] for r in rows}
  for setting in ("steady", "mean"):
    assert beyond[setting, "mine"] == pytest.approx(beyond[setting, "oracle"])


def test_another_suite_stands_by_itself_and_other_settings_are_refused():
  lives = methods.of_folder(STEADY)
  other = [x | {"setting": "mine"} for x in lives]
  alone = methods.joined(lives, other)
  assert len(alone) == len(lives) and {x["setting"] for x in alone} == {"mine"}
  config = json.loads(lives[0]["settings"])
  config["severity"], config["adapt"]["ratio"] = 0.5, 64.0
  with pytest.raises(UserError, match="run with another adapt, severity than the published one"):
    methods.joined(lives, [x | {"settings": json.dumps(config)} for x in lives])


def test_another_agent_may_have_another_severity_and_nothing_else():
  lives = methods.of_folder(STEADY)
  lives = [x for x in lives if x["setting"] == lives[0]["setting"]]
  config = json.loads(lives[0]["settings"]) | {"severity": 0.9}
  other = {"agent": "walker-9", "severity": 0.9}
  own = [x | other | {"settings": json.dumps(config)} for x in lives]
  both = methods.joined(lives, own)
  assert len(both) == 2 * len(lives)
  board = adaptation.board(both)
  assert {r["agents"] for r in board.rows} == {2}
  config["adapt"]["ratio"] = 64.0
  with pytest.raises(UserError, match="run with another adapt than the published one"):
    methods.joined(lives, [x | {"settings": json.dumps(config)} for x in own])
  more = [x | {"seed": 900} for x in own]
  with pytest.raises(UserError, match="run with another severity than"):  # of its own lives
    methods.joined(both, [x | {"settings": lives[0]["settings"]} for x in more])


@pytest.mark.parametrize(
  "argv, said",
  (
    (("--detector", "cusum"), "--detector is of detectors; leave out --methods"),
    (("--submit", "x.parquet"), "--submit is of detectors; leave out --methods"),
    ((STEADY, "--arm", "none"), "give a folder of lives, or --arm to live them in --out"),
    (("--beside", STEADY, "--arm", "x"), "--beside is of lives that are there; leave out --arm"),
    ((STEADY, "--seeds", "2"), "--seeds is of lives to come; give --arm"),
    ((RESULTS / "stop.json",), "holds no results of a suite; give the --out of `mjx-cl bench"),
    ((STEADY, "--robot", "car"), "holds no finished part of these robots"),
  ),
)
def test_bad_input_is_one_line(called, nothing_ships, tmp_path, argv, said):
  code, out, err = called(*argv, "--out", tmp_path / "board")
  assert code == 2 and said in err and err.count("\n") == 1 and not out
  assert not list(tmp_path.glob("board/*"))


def test_a_board_is_not_replaced_unasked(called, nothing_ships, tmp_path):
  assert called(STEADY, "--out", tmp_path)[0] == 0
  for more in ((STEADY,), ("--arm", "still")):
    code, _, err = called(*more, "--out", tmp_path)
    assert code == 2 and "holds a board; give --overwrite" in err
  assert called(STEADY, "--out", tmp_path, "--overwrite")[0] == 0


def test_nothing_is_lived_before_all_is_known_to_be_right(called, monkeypatch, tmp_path):
  monkeypatch.setattr(methods_cli.runs, "live", lambda *_, **__: pytest.fail("lived"))
  lives = methods.of_folder(STEADY)
  monkeypatch.setattr(methods, "LIVES", tmp_path / "lives.parquet")
  methods.write_lives(lives, methods.LIVES)
  (tmp_path / "other").mkdir()
  (tmp_path / "other" / "suite.json").write_text('{"suite": "quick", "parts": {}}')
  for more, said in (
    (("--out", tmp_path / "a", "--robot", "car", "walkr"), "unknown robot 'walkr'"),
    (("--out", tmp_path / "a", "--name", "oracle"), "has a method 'oracle' already"),
    (("--out", tmp_path / "other"), "holds suite 'quick'; give another --out"),
    (("--out", tmp_path / "a", "--seeds", "0"), "seeds"),
  ):
    code, out, err = called("--arm", "quiet", *more)
    assert (code, out) == (2, "") and said in err and err.count("\n") == 1, err


def test_an_arm_is_lived_beside_none(called, monkeypatch, saved, tmp_path):  # noqa: F811
  """The whole command, on a suite of tiny robots."""
  mini = MINI.replace("AGENT", str(saved)).replace("healthy", "loose").replace("0.0", "0.25")
  (tmp_path / "mini.toml").write_text(mini)
  monkeypatch.setattr(methods, "SUITE", str(tmp_path / "mini.toml"))
  monkeypatch.setattr(methods, "LIVES", tmp_path / "no such file")
  (tmp_path / "own.py").write_text(
    "from mjx_cl.adapt.arms import NEVER, NO_END, Arm\n"
    "def idle():\n  return Arm('does nothing', NEVER, NO_END)\n"
  )
  command = ("--arm", f"{tmp_path}/own.py:idle", "--out", tmp_path / "out", "--json")
  code, out, err = called(*command)
  assert code == 0, err
  overall = {r["method"]: r for r in json.loads(out)["overall"]}
  assert set(overall) == {"idle", "none"} and overall["idle"]["streams"] == 3 * 2
  assert all(row["falls"] == 0 for row in overall.values())  # they live alike
  monkeypatch.setattr(bench.run, "execute", lambda *_, **__: pytest.fail("lived again"))
  assert called(*command)[0] == 0


def test_a_setting_without_none_and_broken_files_are_said(tmp_path):
  lives = [x for x in methods.of_folder(STEADY) if x["method"] != "none"]
  with pytest.raises(UserError, match="was not run with arm 'none', which scores 0: give --arm"):
    methods.whole(lives)
  folder = shutil.copytree(STEADY, tmp_path / "broken")
  (folder / "steady" / "config.json").write_text("{}")
  with pytest.raises(FileError, match="not a run's files"):
    methods.of_folder(folder)
  (folder / "suite.json").write_text('{"parts": 3}')
  with pytest.raises(FileError, match="not a suite's"):
    methods.of_folder(folder)


def _seeds(lives: list[dict], parts: dict) -> list[tuple[RunConfig, list[int]]]:
  rows = collections.defaultdict(list)
  for x in lives:
    rows[x["setting"], x["agent"], x["method"]].append(x["seed"])
  return [(parts[setting], sorted(seeds)) for (setting, *_), seeds in rows.items()]


def test_lives_that_ship_are_of_the_suite_that_ships():
  lives = methods.shipped()
  parts = {part.name: part.config for part in suite.suite(methods.SUITE).parts}
  assert lives and {x["setting"] for x in lives} <= set(parts)
  for x in lives:
    config = parts[x["setting"]]
    assert x["robot"] == config.env
    lived = json.loads(x["settings"])
    if x["agent"] != (config.agent or own_agent(config.env)):  # of another agent as hard
      lived["severity"] = config.severity
    lived = methods.settings(lived)  # settings that came since: their defaults
    assert lived == methods.settings(dataclasses.asdict(config)), x["setting"]
    assert np.isfinite([x["return_lost"], x["reward_pre"]]).all()
  for config, seeds in _seeds(lives, parts):  # no gap, none twice, as many as the suite's or more
    assert len(seeds) >= config.seeds, (config.env, seeds)
    assert seeds == list(range(seeds[0], seeds[0] + len(seeds))), (config.env, seeds)
  methods.whole(lives)


def test_the_published_board_needs_no_lives(called, tmp_path):
  code, out, err = called("--out", tmp_path, "--json")
  assert code == 0, err
  published = parquet.read_table(RESULTS / "methods_board" / "methods_overall.parquet").to_pylist()
  shown = json.loads(out)["overall"]
  assert [r["method"] for r in shown] == [r["method"] for r in published]
  for a, b in zip(shown, published):  # sums in another order
    assert a["score"] == pytest.approx(b["score"], abs=1e-6)


# ---- the page ------------------------------------------------------------------------------------


def test_names_cannot_break_the_page(tmp_path):
  lives = methods.of_folder(STEADY)
  bad = '</svg><script>alert("x")</script>'
  lives = [x | {"method": bad if x["method"].endswith(":calm") else x["method"]} for x in lives]
  methods_page.write(tmp_path / "x.html", adaptation.board(lives), lives, {"command": bad})
  page = (tmp_path / "x.html").read_text()
  assert "<script" not in page and page.count("alert(") >= 2


def test_a_setting_without_a_severity_has_its_section(tmp_path):
  lives = methods.of_folder(RESULTS / "paper")
  methods_page.write(tmp_path / "x.html", adaptation.board(lives), lives, {})
  assert "car/transfer-then-socks; from" in (tmp_path / "x.html").read_text()


def test_the_page_shows_every_method_and_every_life(browser, tmp_path):  # noqa: F811
  lives = methods.of_folder(STEADY)
  methods_page.write(tmp_path / "x.html", adaptation.board(lives), lives, {})
  browser.open(tmp_path / "x.html")
  count = lambda css: browser.driver.find_elements("css selector", css)
  assert [x.text.splitlines()[0] for x in count("tbody th")][-1] == "none"
  assert len(count("tbody tr")) == 5
  assert len(count("section.setting")) == 2 and len(count("circle")) == len(lives)
  assert len(count(".mean")) == 5 + 2  # a setting of five methods, one of two
  width = "return [document.documentElement.scrollWidth, window.innerWidth]"
  needs, has = browser.driver.execute_script(width)
  assert needs <= has


def test_settings_of_a_run_are_alike_whenever_it_was_lived():
  """What the run is older than has its default."""
  now = dataclasses.asdict(RunConfig("walker"))
  adapt = {k: v for k, v in now["adapt"].items() if k != "regain"}
  assert methods.settings(now) == methods.settings(now | {"adapt": adapt})
  assert methods.settings(now) != methods.settings(now | {"adapt": adapt | {"regain": 0.9}})
