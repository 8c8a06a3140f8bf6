"""Runs against each other: differences by hand, intervals against another bootstrap, bad input."""

import json
import pathlib

import numpy as np
import pyarrow.parquet
import pytest
from scipy import stats

from mjx_cl.cli import app
from mjx_cl.io import tables
from mjx_cl.scoring import versus

PRE = 2.0
RESULTS = pathlib.Path(__file__).parents[2] / "results"
LOOP, AGAIN = RESULTS / "loop", RESULTS / "again/walker"


def run_of(folder, arms, env="walker", steps=25_000):
  """A finished run: arm -> reward_final of seeds 0, 1, ...; None: not known."""
  rows = [
    dict(arm=arm, seed=seed, change=0, reward_pre=PRE, reward_final=x, return_lost=10.0 - seed,
         terminations=seed, updates=5)
    for arm, values in arms.items() for seed, x in enumerate(values)
  ]  # fmt: skip
  folder.mkdir(parents=True)
  names = list(rows[0])
  tables.write_table(folder / "runs.parquet", {k: [r[k] for r in rows] for k in names})
  tables.write_json(folder / "config.json", {"env": env, "steps": steps, "arms": list(arms)})
  return folder


@pytest.fixture
def mjx(capsys):
  """mjx(*argv): (exit code, standard output, standard error) of `mjx-cl compare`."""

  def call(*argv):
    capsys.readouterr()
    return app.main(["compare", *map(str, argv)]), *capsys.readouterr()

  return call


def test_arms_of_one_run_by_hand(tmp_path):
  run = run_of(tmp_path / "a", {"detector": [1.0, 1.2, None, 1.8], "none": [0.5, 1.4, 0.9, 1.0]})
  found = versus.variants([str(run)])
  rows = {(r["variant"], r["measure"]): r for r in versus.compare(found)}
  row = rows["none", "reward_final"]
  gain = np.array([-0.5, 0.2, -0.8])  # seed 2 has no partner
  assert row["pairs"] == 3 and row["streams"] == 4
  assert row["difference"] == pytest.approx(gain.mean()) and row["better"] == pytest.approx(1 / 3)
  assert row["iqm"] == pytest.approx((0.9 + 1.0) / 2)
  assert rows["none", "reward_kept"]["difference"] == pytest.approx(gain.mean() / PRE)
  assert rows["none", "return_lost"]["better"] == 0.5  # ties
  same = rows["detector", "reward_final"]
  assert same["difference"] == 0 and same["difference_ci"] == [0, 0]


def test_a_false_alarm_before_the_change_lowers_no_loss():
  """`cusum@surprise` has alarmed on two walkers before the fault; what is earned after it is what
  differs, 104 as results/loop says.
  """
  (part,) = (p for p in versus.by(str(LOOP), "detector") if p.name == "walker")
  first = next(x for x in part.found if x.name == "detector=rolling_sigma")
  one = next(x for x in part.found if x.name == "detector=cusum@surprise")
  row = versus.against(one, first, "return_lost")
  earned = lambda r: r["reward_pre"] * r["lived"] - r["return_lost"]
  want = [earned(first.rows[k]) - earned(one.rows[k]) for k in sorted(first.rows)]
  assert row["difference"] == pytest.approx(np.mean(want)) and round(row["difference"]) == -104
  cut = [k for k in one.rows if one.rows[k]["reward_pre"] != first.rows[k]["reward_pre"]]
  assert len(cut) == 2 and {one.rows[k]["false_alarms"] for k in cut} == {1}
  assert {r["lived"] for r in one.rows.values()} == {20_000}


def test_after_a_later_change_losses_are_compared_as_they_stand():
  """Each arm has another reward before the repair: the difference is that of what is printed."""
  first, one = versus.variants([f"{AGAIN}:none", f"{AGAIN}:detector"], 1)
  row = versus.against(one, first, "return_lost")
  lost = lambda r: r["return_lost"]
  want = np.mean([lost(one.rows[k]) - lost(first.rows[k]) for k in sorted(first.rows)])
  assert row["difference"] == pytest.approx(want)
  assert any(one.rows[k]["reward_pre"] != first.rows[k]["reward_pre"] for k in first.rows)


@pytest.mark.parametrize("broken", ["config", "column", "empty"])
def test_files_that_are_no_runs_are_a_line(tmp_path, mjx, broken):
  run = run_of(tmp_path / "a", {"detector": [1.0, 1.2], "none": [1.0, 1.0]})
  table = pyarrow.parquet.read_table(run / "runs.parquet")
  if broken == "config":
    tables.write_json(run / "config.json", {"a": 1})
  else:
    table = table.drop_columns("reward_pre") if broken == "column" else table.slice(0, 0)
    pyarrow.parquet.write_table(table, run / "runs.parquet")
  code, _, err = mjx(run)
  assert code == 1 and "not a run's files" in err and err.count("\n") == 1


def test_versions_of_the_benchmark_are_not_mixed(tmp_path, mjx):
  """A run that says none is of the first."""
  runs = [run_of(tmp_path / name, {"detector": [1.0, 1.2]}) for name in "abc"]
  for folder, version in zip(runs[1:], (1, 2)):
    config = tables.read_json(folder / "config.json")
    tables.write_json(folder / "config.json", config | {"benchmark": version})
  assert len(versus.variants([str(runs[0]), str(runs[1])])) == 2
  code, _, err = mjx(runs[0], runs[2])
  assert code and "versions 1, 2 of the benchmark cannot be compared" in err


def test_runs_that_share_nothing_are_told_apart(tmp_path, mjx):
  """Rows of the first runs, which knew no change; no seed in common; another repair."""
  one, two = (run_of(tmp_path / name, {"detector": [1.0, 1.2]}) for name in "ab")
  rows = tables.read_rows(two / "runs.parquet")
  for k, row in enumerate(rows):
    del row["change"]
    row["seed"] = 7 + k
  tables.write_table(two / "runs.parquet", {k: [r[k] for r in rows] for k in rows[0]})
  config = tables.read_json(two / "config.json")
  tables.write_json(two / "config.json", config | {"duration": 3000, "first_seed": 7})
  code, out, err = mjx(one, two, "--measure", "reward_final")
  assert code == 0 and f"no pair of one seed with {two}:detector" in " ".join(out.split())
  assert all(name in out + err for name in ("duration", "first_seed"))


def test_a_variant_with_pairs_in_one_measure_is_not_said_to_have_none(tmp_path, mjx):
  """Seed 0 alone has a final reward, the other arm's too late."""
  run = run_of(tmp_path / "a", {"detector": [1.0, None], "none": [None, 0.5]})
  measures = ("--measure", "reward_final", "terminations")
  code, out, _ = mjx(run, *measures)
  assert code == 0 and "no pair of one seed" not in out
  code, out, _ = mjx(run, *measures[:2])
  assert code == 0 and "no pair of one seed with none" in " ".join(out.split())


def test_one_run_is_not_compared_with_itself(tmp_path, mjx):
  run = run_of(tmp_path / "a", {"detector": [1.0, 1.2]})
  code, _, err = mjx(run, f"{tmp_path}/../{tmp_path.name}/a")
  assert code == 2 and "is there twice" in err


def test_a_robot_that_changes_twice_is_one_stream(tmp_path, mjx):
  """A fault and its repair are two rows of a seed, and no two robots."""
  run = run_of(tmp_path / "a", {"detector": [1.0, 1.2], "none": [0.5, 1.4]})
  rows = tables.read_rows(run / "runs.parquet")
  rows += [row | {"change": 1, "reward_final": 3.0} for row in rows]
  tables.write_table(run / "runs.parquet", {k: [r[k] for r in rows] for k in rows[0]})
  for change, want in ((0, [1.0, 1.2]), (1, [3.0, 3.0])):
    code, out, _ = mjx(run, "--measure", "reward_final", "--change", change, "--json")
    [first, other] = json.loads(out)
    assert code == 0 and first["streams"] == other["pairs"] == 2
    assert first["iqm"] == pytest.approx(np.mean(want))
  for wrong in (2, -1):
    code, _, err = mjx(run, "--change", wrong)
    assert code == 2 and "--change must lie in 0..1" in err and err.count("\n") == 1


def test_the_default_agent_named_is_the_default_agent(tmp_path, mjx):
  a, b = (run_of(tmp_path / name, {"detector": [1.0, 1.2]}) for name in "ab")
  for agent, differ in (("walker", False), ("walker-2", True)):
    config = tables.read_json(b / "config.json") | {"agent": agent}
    tables.write_json(b / "config.json", config)
    assert ("these runs differ in agent" in mjx(a, b)[2]) == differ


def test_less_of_a_loss_is_better(tmp_path):
  run = run_of(tmp_path / "a", {"detector": [1.0, 1.0], "none": [1.0, 1.0]})
  one, two = versus.variants([str(run)])
  for key in two.rows:
    two.rows[key]["terminations"] -= 1
  assert versus.against(two, one, "terminations")["better"] == 1.0


def test_the_interval_is_that_of_another_bootstrap(tmp_path):
  rng = np.random.default_rng(0)
  mine, theirs = rng.normal(1.0, 0.2, 40), rng.normal(0.9, 0.2, 40)
  a = run_of(tmp_path / "a", {"detector": mine.tolist()})
  b = run_of(tmp_path / "b", {"detector": theirs.tolist()})
  row = versus.against(*reversed(versus.variants([str(a), str(b)])), "reward_final")
  want = stats.bootstrap((theirs - mine,), np.mean, method="percentile", rng=1)
  low, high = want.confidence_interval
  assert row["difference_ci"] == pytest.approx([low, high], abs=0.01)


def test_a_profile_by_hand(tmp_path):
  run = run_of(tmp_path / "a", {"detector": [1.0, 2.0, 2.2, 0.2], "none": [1.0] * 4})
  one, _ = versus.variants([str(run)])
  share, (low, high) = versus.profile(one, np.array([0.0, 0.5, 0.6, 1.05]))
  assert share.tolist() == [1.0, 0.75, 0.5, 0.25]
  assert (low <= share).all() and (share <= high).all() and low[0] == high[0] == 1.0


def test_the_command(mjx, tmp_path):
  far = tmp_path / "a folder of a name that is wider than its column"
  a = run_of(far / "a", {"detector": [1.0, 1.2], "none": [0.5, 0.4]})
  b = run_of(far / "b:c", {"rollback": [1.4, 1.6]}, steps=20_000)
  out = tmp_path / "profile.png"
  code, text, err = mjx(a, b, "--out", out)
  assert code == 0 and "runs differ in steps" in err
  assert " a:detector " in text and " b:c:rollback " in text and "wider" not in text.split("png")[0]
  assert out.read_bytes()[:4] == b"\x89PNG" and out.stat().st_size > 10_000
  code, text, err = mjx(f"{a}:none", b, "--json", "--measure", "reward_final")
  (first, second) = json.loads(text)
  assert (code, first["variant"]) == (0, f"{a}:none")
  assert second["difference"] == pytest.approx(1.05) and second["pairs"] == 2
  assert mjx(a, "--out", out)[0] == 2  # it is there
  assert mjx(a, "--out", out, "--overwrite")[0] == 0


def test_the_parts_of_a_suite_are_compared_one_by_one(tmp_path, mjx):
  """A line for each part that all have, and how often a difference is told from 0."""
  for name, parts in {"one": "ab", "two": "abc"}.items():
    for k, part in enumerate(parts):
      low = [0.5, 0.6, 0.7] if name == "one" else [0.9, 1.0, 1.3 - k]
      arms = {"detector": low, "none": [x - 0.1 for x in low]}
      run_of(tmp_path / name / "walker" / f"fault={part}", arms)
  one, two = tmp_path / "one", tmp_path / "two"
  code, text, _ = mjx(one, two, "--json", "--measure", "reward_final")
  assert code == 0
  rows = {row["part"]: row for row in json.loads(text)}
  assert set(rows) == {"walker/fault=a", "walker/fault=b"}
  assert rows["walker/fault=a"]["difference"] == pytest.approx((0.4 + 0.4 + 0.6) / 3)
  assert rows["walker/fault=b"]["difference"] == pytest.approx((0.4 + 0.4 - 0.4) / 3)
  assert {(r["against"], r["variant"]) for r in rows.values()} == {
    (f"{one}:detector", f"{two}:detector")
  }
  text = mjx(one, two, "--measure", "reward_final")[1]
  assert "2 parts" in text and "1 better, 0 worse" in text
  text = mjx(two, "--measure", "reward_final", "return_lost")[1]  # its arms
  assert "3 parts" in text and "0 better, 3 worse" in text and "0 better, 0 worse" in text
  for argv, words in (
    ((one, two / "walker" / "fault=a"), "holds no runs of a suite"),
    ((one / "walker", two), "no finished run of one name"),
    ((one, one), "is there twice"),
    ((one, two, "--out", tmp_path / "x.png"), "one run's variants"),
  ):
    code, _, err = mjx(*argv)
    assert code == 2 and words in err and err.count("\n") == 1


def test_a_setting_that_a_suite_varies_is_compared_over_its_parts(tmp_path, mjx):
  """Parts that differ in the detector alone; how often and how soon it alarms, by hand."""
  late = {"cusum": [10, 20, None], "ewma": [30, None, None]}
  for fault in ("gear", "bias"):
    for detector, steps in late.items():
      folder = run_of(
        tmp_path / "walker" / f"fault={fault},detector={detector}", {"detector": [1.0] * 3}
      )
      rows = tables.read_rows(folder / "runs.parquet")
      table = {k: [r[k] for r in rows] for k in rows[0]}
      table |= {"latency_steps": steps, "adapting_at_onset": [False] * 3}
      table |= {"recovery_step": [5, None, None], "affected": [True, True, False]}
      tables.write_table(folder / "runs.parquet", table)
  run_of(tmp_path / "walker" / "fault=noise,detector=cusum", {"detector": [1.0] * 3})
  argv = ("--by", "detector", "--measure", "alarmed", "latency_steps", "recovered", "--json")
  rows = json.loads(mjx(tmp_path, *argv)[1])
  assert {r["part"] for r in rows} == {"walker/fault=gear", "walker/fault=bias"}
  assert {(r["against"], r["variant"]) for r in rows} == {("detector=cusum", "detector=ewma")}
  first = {r["measure"]: r for r in rows if r["part"] == "walker/fault=gear"}
  assert first["alarmed"]["difference"] == pytest.approx(-1 / 3)
  assert first["alarmed"]["mean"] == pytest.approx(1 / 3) and "iqm" not in first["alarmed"]
  assert first["latency_steps"]["iqm"] == 30
  assert first["latency_steps"]["pairs"] == 1 and first["latency_steps"]["difference"] == 20
  assert first["recovered"]["pairs"] == 2 and first["recovered"]["difference"] == 0
  code, _, err = mjx(tmp_path, "--by", "severity")
  assert code == 2 and "differ in severity; its parts vary detector, fault" in err
  assert mjx(tmp_path, tmp_path, "--by", "detector")[0] == 2


@pytest.mark.parametrize(
  "argv, code, words",
  [
    ((), 2, ()),
    (("{a}", "{nothing}"), 2, ("nothing", "no finished run")),
    (("{a}:rollbcak", "{a}"), 2, ("rollbcak", "detector, none")),
    (("{one}",), 2, ("one arm",)),
    (("{a}", "{car}"), 2, ("different robots", "car, walker")),
    (("{a}", "--measure", "reward"), 2, ("measure", "reward_final")),
    (("{a}", "--out", "x.gif"), 2, (".png",)),
  ],
)
def test_wrong_words_are_one_line(mjx, tmp_path, argv, code, words):
  folders = {
    "a": run_of(tmp_path / "a", {"detector": [1.0], "none": [0.5]}),
    "one": run_of(tmp_path / "one", {"none": [0.5]}),
    "car": run_of(tmp_path / "car", {"detector": [0.5]}, "car"),
    "nothing": tmp_path / "nothing",
  }
  got, text, err = mjx(*(word.format(**folders) for word in argv))
  assert (got, text) == (code, "") and all(word in err for word in words), err
  assert not words or err.startswith("mjx-cl: ") and err.count("\n") == 1
