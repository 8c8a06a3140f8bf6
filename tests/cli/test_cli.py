"""The command line: what it prints where, exit codes, one line for every kind of bad input, and no
earlier result lost.
"""

import dataclasses
import errno
import io
import json
import os
import pathlib
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import zipfile

import numpy as np
import pytest
from rich.console import Console
from test_run import saved  # noqa: F401  a fixture

import mjx_cl
from mjx_cl import detectors, envs, faults
from mjx_cl.adapt.arms import ARMS
from mjx_cl.cli import app, names, registries, results
from mjx_cl.cli import tables as shown
from mjx_cl.config import PRESETS, RunConfig
from mjx_cl.config.sizes import SIZES
from mjx_cl.errors import FileError, UserError
from mjx_cl.faults import presets
from mjx_cl.io import folders, interrupt
from mjx_cl.io import tables as store
from mjx_cl.render import figures
from mjx_cl.runs import run
from mjx_cl.training import agents


@pytest.fixture
def mjx(capsys):
  """mjx(*argv): (exit code, standard output, standard error) of `mjx-cl` in this process."""

  def call(*argv):
    capsys.readouterr()
    try:
      code = app.main([str(a) for a in argv])
    except SystemExit as e:  # --help
      code = e.code or 0
    return code, *capsys.readouterr()

  return call


@pytest.fixture
def refused(mjx):
  """refused(code, *argv): the one line that a refused command prints."""

  def call(code, *argv):
    got, out, err = mjx(*argv)
    assert (
      (got, out) == (code, "")
      and err.startswith("mjx-cl: ")
      and err.count("\n") == 1
      and err.endswith("\n")
    ), (got, out, err)
    return err

  return call


def content(folder):
  """Every file below a folder."""
  return {
    str(p.relative_to(folder)): p.read_bytes()
    for p in sorted(pathlib.Path(folder).rglob("*"))
    if p.is_file()
  }


# ---- what it prints ------------------------------------------------------------------------------


@pytest.mark.parametrize("argv", [["--help"], ["run", "--help"], ["list"]])
def test_help_imports_nothing_heavy(argv):
  """Seconds depend on the machine; what makes them many is an import of JAX (2 s) or of what needs
  it.
  """
  process = subprocess.run(
    [sys.executable, "-X", "importtime", "-m", "mjx_cl", *argv],
    capture_output=True,
    text=True,
    timeout=1200,
  )
  imported = {
    line.split("|")[-1].strip()
    for line in process.stderr.splitlines()
    if line.startswith("import time:")
  }
  assert process.returncode == 0 and "walker" in process.stdout and "mjx_cl.cli.app" in imported
  assert not imported & {
    "jax",
    "jaxlib",
    "flax",
    "optax",
    "mujoco",
    "matplotlib",
    "pyarrow",
    "duckdb",
    "scipy",
  }


@pytest.mark.parametrize("command", app.COMMANDS)
def test_help_of_each_command_shows_an_example_that_it_takes(mjx, command):
  name = command.__name__.lower()
  code, out, err = mjx(name, "--help")
  (example,) = re.findall(r"^Example: mjx-cl (.*)$", out, re.M)
  assert (code, err) == (0, "") and type(app.parse(shlex.split(example))) is command


def test_run_takes_every_setting_of_a_run():
  """A flag for each field, under its own name but for --arm and --set."""
  given = app.parse(
    [
      "run",
      "car",
      "--set",
      "a=1",
      "b=x",
      "--arm",
      "none",
      "--target",
      "random",
      "--adapt.ratio",
      "2",
    ]
  )
  assert given.env == "car" and given.settings == {"a": 1, "b": "x"} and given.arms == ("none",)
  assert given.target is None and given.adapt.ratio == 2.0
  flags = {f.name for f in dataclasses.fields(app.Run)} - {
    "out",
    "track",
    "quick",
    "json",
    "resume",
    "overwrite",
  }
  assert flags == {f.name for f in dataclasses.fields(RunConfig)}


def test_help_names_every_command(mjx):
  code, out, err = mjx("--help")
  assert (
    code == 0
    and err == ""
    and all(name in out for name in ("run", "train", "eval", "plot", "query", "list", "doctor"))
  )


def test_no_command_is_answered_by_the_help(mjx):
  assert mjx() == (2, mjx("--help")[1], "")


def test_version(capsys):
  with pytest.raises(SystemExit) as end:
    app.main(["--version"])
  assert end.value.code == 0 and capsys.readouterr().out == f"mjx-cl {mjx_cl.__version__}\n"


def test_the_names_that_ship_are_those_of_the_registries():
  """`python -m mjx_cl.cli.names` writes them."""
  groups = (envs.ENVS.group, faults.FAULTS.group, detectors.DETECTORS.group, ARMS.group)
  assert groups == names.GROUPS
  assert json.loads(names.FILE.read_text()) == registries.tables(registries.TABLES)


def test_list(mjx):
  code, out, err = mjx("list", "--json")
  assert code == 0 and err == "" and out.count("\n") == 1
  tables = json.loads(out)
  assert {k: set(v) for k, v in tables.items()} == {
    "envs": set(envs.ENVS),
    "faults": set(faults.FAULTS),
    "targets": set(envs.ENVS),
    "detectors": set(detectors.DETECTORS),
    "presets": set(PRESETS),
    "agents": set(agents.shipped()),
    "arms": set(ARMS),
    "sizes": set(SIZES),
    "suites": {"leaderboard", "leaderboard-100k"},
    "benches": {"again", "arms", "full", "loop", "methods", "paper", "quick", "stop", "study"},
    "fault-presets": set(presets.PRESETS),
    "schedules": set(presets.SCHEDULES),
  }
  assert all(
    text for table in tables.values() for text in table.values()
  )  # each with a word about it
  knees = next(x for x in tables["targets"]["walker"].split("; ") if "gear" in x)
  assert "right_knee" in knees.partition(": ")[2] and "steering" not in knees
  assert "lidar_00 to lidar_63," in tables["targets"]["car"]
  assert json.loads(mjx("list", "faults", "--json")[1]) == {"faults": tables["faults"]}
  text = mjx("list")[1]
  assert all(name in text for table in tables.values() for name in table)


def test_a_run_is_shown_as_a_table_with_intervals(capsys, monkeypatch):
  monkeypatch.setenv("COLUMNS", "200")
  arm = {"seeds": 4, "affected": 4, "alarms": 4, "false_alarm_streams": 0, "converged": 3}
  arm |= {
    "aborted_by_rule": 1,
    "latency_median_steps": 354.0,
    "latency_median_steps_ci": [269, 537],
  }
  arm |= {"recovered_within_10000": 3, "recovered_within_10000_ci": [1.2, 3.82]}
  arm |= {"reward_pre": 0.95, "reward_pre_ci": None, "reward_drop": None}
  arm |= {"reward_final": 0.88, "reward_final_ci": [0.85, 0.92]}
  summary = {"env": "walker", "fault": "gear", "severity": 0.5, "onset": 4000, "steps": 13_000}
  summary |= {"detector": "cusum", "wall_s": 65.0, "wall_share": {"physics": 1.0}}
  shown.show_summary(summary | {"arms": {"detector": arm}}, "runs/x")
  out = capsys.readouterr().out
  assert "walker, gear 0.5 at step 4,000 of 13,000, detector cusum; 1:05 wall" in out
  row, below = (
    [cell.strip() for cell in line.split("│")[1:-1]] for line in out.splitlines() if "│" in line
  )
  assert row == ["detector", "4", "4", "4", "0", "354", "3 of 4"] + [
    "3 converged, 1 aborted by rule",
    "0.95",
    "-",
    "0.88",
  ]
  assert [cell for cell in below if cell] == ["[269, 537]", "[30%, 96%]", "[0.85, 0.92]"]
  assert "[steps]" in out and out.endswith("files in runs/x\n")


def test_what_was_not_measured_is_not_called_unaffected(capsys, monkeypatch):
  """A fault within the warm-up: no reward before it."""
  monkeypatch.setenv("COLUMNS", "200")
  summary = store.read_json(pathlib.Path(__file__).parents[2] / "results/walker_gear/summary.json")
  for arm, known in ((summary["arms"]["detector"], False), (summary["arms"]["none"], True)):
    arm |= {"affected": 0, "affected_ci": [0.0, 2.8] if known else None}
  shown.show_summary(summary, "runs/x")
  lines = [line.split("│") for line in capsys.readouterr().out.splitlines()]
  cells = {line[1].strip(): line[3].strip() for line in lines if len(line) > 3}
  assert (cells["detector"], cells["none"]) == ("-", "0")
  trace = {"stream": np.arange(2), "seed": np.arange(2)}
  rows = lambda affected: [{"seed": 0, "affected": affected, "change": 0}]
  assert figures._affected(trace, rows(None))[1] == "all robots"
  assert figures._affected(trace, rows(False))[1] == "all robots, none of which it costs a tenth"


@pytest.mark.parametrize("columns", [60, 80, 100, 200])
def test_a_runs_table_keeps_to_the_terminal(capsys, monkeypatch, columns):
  """What does not fit is named and lies in summary.json; an interval may have no upper end."""
  monkeypatch.setenv("COLUMNS", str(columns))
  summary = store.read_json(pathlib.Path(__file__).parents[2] / "results/walker_gear/summary.json")
  arm = summary["arms"]["detector"]
  arm |= {"latency_median_steps": 50.0, "latency_median_steps_ci": [20.0, None]}
  shown.show_summary(summary, "runs/x")
  first, *lines = capsys.readouterr().out.splitlines()
  assert max(len(line) for line in lines if set(line) & set("│┃━─")) <= columns
  text = "\n".join(lines)
  assert all(name in text for name in ("detector", "none", "50", "[20, -]", "at last"))
  assert ("not shown" in text) == (columns < 200)
  assert "files in runs/x" in text


def test_the_parts_of_a_suite_are_one_table(capsys, monkeypatch):
  """A row for each part and arm, the part's own numbers in it."""
  monkeypatch.setenv("COLUMNS", "200")
  entries = store.read_json(pathlib.Path(__file__).parents[2] / "results/full/bench.json")[
    "entries"
  ]
  two = dict(list(entries.items())[:2])
  shown.show_suite(two)
  text = capsys.readouterr().out
  lines = [line for line in text.splitlines() if "│" in line]
  rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in lines]
  rows = [row for row in rows if row[1] in ("detector", "none")]
  assert [(row[0], row[1]) for row in rows] == [
    (part, arm) for part, own in two.items() for arm in own["arms"]
  ]
  assert [row[-1] for row in rows] == [
    f"{arm['reward_final']:.2f}" for own in two.values() for arm in own["arms"].values()
  ]
  assert "more in bench.json" in text


def test_doctor(mjx):
  code, out, err = mjx("doctor", "--json")
  rows = json.loads(out)
  assert code == 0 and err == "" and out.count("\n") == 1
  assert (
    rows["versions"]["jax"]
    and rows["devices"]
    and rows["physics"] in ("native", "mjx")
    and rows["free_memory_gib"] > 0
  )
  assert rows["compile_cache"] == os.environ["MJX_CL_CACHE"] and rows["matmul_gflop_s"] > 0
  assert rows["physics"] == "mjx" or rows["walker_control_steps_s"] > 0


def test_standard_output_is_clean_where_mjx_is_loaded():
  """`from mujoco import mjx` says on standard output that warp is absent."""
  code = (
    "import mjx_cl.envs, json; env = mjx_cl.envs.make('walker', 'mjx'); "
    "print(json.dumps(env.physics.name))"
  )
  process = subprocess.run(
    [sys.executable, "-c", code], capture_output=True, text=True, timeout=1200
  )
  assert process.returncode == 0 and process.stdout == '"mjx"\n', process.stderr


def test_query(mjx, refused, tmp_path):
  store.write_table(tmp_path / "runs.parquet", {"seed": [0, 1], "x": np.array([0.5, np.nan])})
  code, out, err = mjx("query", tmp_path, "select * from runs order by seed", "--json")
  assert (code, err) == (0, "") and json.loads(out) == [
    {"seed": 0, "x": 0.5},
    {"seed": 1, "x": None},
  ]
  code, out, err = mjx("query", tmp_path, "select count(*) as n from runs")
  assert (code, err) == (0, "") and "n" in out and "2" in out
  sql = (
    "select 0.5 * count(*) as half, list(x order by seed) as xs, {'a': 'nan'::double} as s, map "
    "{date '2026-01-02': [1.0 / 0]} as m, histogram(seed * 1.5) as h from runs"
  )
  code, out, err = mjx("query", tmp_path, sql, "--json")
  assert (code, err) == (0, "") and json.loads(out) == [
    {
      "half": 1.0,
      "xs": [0.5, None],
      "s": {"a": None},
      "m": {"2026-01-02": [None]},
      "h": {"0.0": 1, "1.5": 1},
    }
  ]
  assert "runs" in refused(2, "query", tmp_path, "select y from runs")
  assert "no .parquet" in refused(2, "query", tmp_path / "none", "select 1")


def test_rows_are_set_as_rich_sets_them(capsys, monkeypatch):
  names, rows = ["step", "[red]x", ""], [(1, "漢字", None), (-20, "e\u0301[/b]", 0.5), ("", "", "")]
  on = Console(file=io.StringIO(), width=80)
  on.print(shown.table(names, rows, left=names))
  for width, alike in ((80, True), (on.measure(shown.table(names, rows)).maximum - 1, False)):
    monkeypatch.setenv("COLUMNS", str(width))
    shown.print_rows(names, rows)
    assert (capsys.readouterr().out == on.file.getvalue()) == alike  # folds, where it must
  shown.print_rows(["x"], [["\x1b[31m\r\n\x9b"]])
  assert [line.strip("│ ") for line in capsys.readouterr().out.splitlines()[3:5]] == [
    r"\x1b[31m\r",
    r"\x9b",
  ]


def test_query_prints_the_first_rows_and_says_so(mjx, refused, tmp_path):
  count = 100 * results.FIRST
  store.write_table(tmp_path / "trace.parquet", {"step": np.arange(count)})
  for words, rows in (((), results.FIRST), (("--limit", "250"), 250)):
    code, out, err = mjx("query", tmp_path, "from trace", *words)
    shown = [line.strip("│ ") for line in out.splitlines() if line.startswith("│")]
    assert code == 0 and shown == [str(k) for k in range(rows)]
    assert out.count("step") == -(-rows // results.FIRST) and f"first {rows}" in err
  code, out, err = mjx("query", tmp_path, "from trace", "--json")
  assert (code, err) == (0, "") and len(json.loads(out)) == count
  code, out, err = mjx("query", tmp_path, "from trace", "--json", "--limit", "3")
  assert "first 3" in err and len(json.loads(out)) == 3
  code, out, err = mjx("query", tmp_path, "select 7", "--limit", "1", "--timeout", "600")
  assert (code, err) == (0, "") and "7" in out
  for words in (("--limit", "0"), ("--timeout", "0"), ("--timeout", "nan")):
    assert words[0] in refused(2, "query", tmp_path, "from trace", *words)
  assert "UTF-8" in refused(2, "query", tmp_path, "select '\udcff'")


@pytest.mark.parametrize(
  "argv",
  [
    ("leaderboard", "--export", ""),
    ("leaderboard", "--out", ""),
    ("bench", "paper", "--out", ""),
    ("bench", "paper", "--only", ""),
    ("run", "walker", "--out", ""),
    ("run", "walker", "--fault", ""),
    ("train", "walker", "--out", ""),
    ("certify", "walker", "--out", ""),
    ("record", ""),
    ("plot", ""),
  ],
)
def test_an_empty_text_is_not_nothing(refused, tmp_path, monkeypatch, argv):
  monkeypatch.chdir(tmp_path)
  assert "empty" in refused(2, *argv) and not list(tmp_path.iterdir())


def test_a_line_stays_one_that_can_be_read(refused):
  line = refused(2, "run", "walker", "--fault", "x" * 100_000)
  assert "unknown fault" in line and " ... " in line and "choose from" in line and len(line) <= 500


def test_names_are_no_markup(mjx, tmp_path):
  store.write_table(tmp_path / "trace.parquet", {"[/red]x": ["[/b]"]})
  code, out, err = mjx("query", tmp_path, "from trace")
  assert (code, err) == (0, "") and "[/red]x" in out and "[/b]" in out
  on = Console(file=io.StringIO(), width=80)
  on.print(shown.table(["[/red]"], [["[bold]"]], title="[/x]"))
  assert all(text in on.file.getvalue() for text in ("[/red]", "[bold]", "[/x]"))


def test_a_line_holds_no_control_character_and_no_more_than_500(refused):
  for given in (
    "\x1b[31m",
    "\x07",
    "\x9b",
    "\udcff",
    "\u202e",
    "a" * 5000,
    "a b " * 900,
    "\x1b" * 900,
  ):
    for argv in (["list", given], ["eval", given], ["list", "all", given]):
      text = refused(2, *argv)
      assert text.rstrip("\n").isprintable() and len(text) <= 500, text


@pytest.mark.parametrize(
  "argv", [("detect", "x", "--nominal", "y", "--out"), ("run", "walker", "--out"), ("plot",)]
)
def test_a_name_that_is_no_utf_8_is_refused(refused, tmp_path, monkeypatch, argv):
  monkeypatch.chdir(tmp_path)
  text = refused(2, *argv, "caf\udce9")
  assert "UTF-8" in text and "caf\\udce9" in text and not list(tmp_path.iterdir())


def test_report_elsewhere_than_in_a_checkout_is_one_line(refused, tmp_path, monkeypatch):
  monkeypatch.setattr(results, "__file__", str(tmp_path / "mjx_cl" / "cli" / "results.py"))
  assert "checkout" in refused(2, "report", "--check")


# ---- bad arguments -------------------------------------------------------------------------------

RUN = {
  "environment": (["run", "wlker"], ["wlker", "walker"]),
  "fault": (["run", "walker", "--fault", "geer"], ["geer", "gear, joint_damping"]),
  "target": (["run", "walker", "--target", "left_elbow"], ["left_elbow", "left_knee", "random"]),
  "target of no fault": (
    ["run", "walker", "--fault", "none", "--target", "left_knee"],
    ["left_knee"],
  ),
  "detector": (
    ["run", "walker", "--detector", "cusums"],
    ["cusums", "cusum", "rolling_sigma, rolling_sigma_plain"],
  ),
  "detector setting": (["run", "walker", "--set", "windows=5"], ["windows"]),
  "detector setting out of range": (["run", "walker", "--set", "window=1"], ["window"]),
  "setting without a value": (["run", "walker", "--set", "window"], ["name=value"]),
  "setting without a name": (["run", "walker", "--set", "=5"], ["name=value", "'=5'"]),
  "arm": (
    ["run", "walker", "--arm", "detektor"],
    ["detektor", "always, calm, detector, guarded, no-fault, none, oracle"],
  ),
  "arm twice": (["run", "walker", "--arm", "none", "none"], ["once"]),
  "physics": (["run", "walker", "--physics", "warp"], ["warp", "native"]),
  "form": (["run", "walker", "--form", "papers"], ["papers", "streaming"]),
  "actions": (["run", "walker", "--actions", "own"], ["own", "recorded"]),
  "flag": (["run", "walker", "--sede", "3"], ["--sede"]),
  "flag of another command": (["run", "walker", "--episodes", "3"], ["--episodes"]),
  "word for a number": (["run", "walker", "--seeds", "many"], ["many"]),
  "severity above 1": (["run", "walker", "--severity", "1.5"], ["severity", "1.5"]),
  "severity below 0": (["run", "walker", "--severity", "-0.1"], ["severity", "-0.1"]),
  "severity nan": (["run", "walker", "--severity", "nan"], ["severity", "nan"]),
  "onset beyond the end": (
    ["run", "walker", "--onset", "2000", "--steps", "1000"],
    ["onset", "2000", "1000"],
  ),
  "onset below 0": (["run", "walker", "--onset", "-1"], ["onset"]),
  "zero seeds": (["run", "walker", "--seeds", "0"], ["seeds", "0"]),
  "seed below 0": (["run", "walker", "--first-seed", "-1"], ["first_seed"]),
  "zero steps": (["run", "walker", "--steps", "0"], ["steps"]),
  "zero duration": (["run", "walker", "--duration", "0"], ["duration"]),
  "adaptation out of range": (["run", "walker", "--adapt.patience", "0"], ["patience"]),
  "agent that is not there": (
    ["run", "walker", "--agent", "wlaker"],
    ["wlaker", f"shipped: {', '.join(agents.shipped())};"],
  ),
}
OTHER = {
  "command": (["rnu"], ["rnu"]),
  "train: environment": (["train", "wlker"], ["wlker", "walker"]),
  "train: preset": (["train", "walker", "--preset", "huge"], ["huge", "cpu, paper, tiny"]),
  "train: setting": (["train", "walker", "--set", "lerning=3"], ["lerning", "lr"]),
  "train: setting out of range": (["train", "walker", "--set", "lr=-1"], ["lr", "-1"]),
  "train: zero seeds": (["train", "walker", "--seeds", "0"], ["seeds"]),
  "train: a word for a number": (
    ["train", "walker", "--set", "updates=abc"],
    ["updates takes int", "'abc'"],
  ),
  "train: a fraction for a count": (
    ["train", "walker", "--set", "envs=2.5"],
    ["envs takes int", "2.5"],
  ),
  "train: rises for ever": (["train", "walker", "--set", "lr_end=-1"], ["lr_end", "-1"]),
  "train: never an update": (
    ["train", "walker", "--preset", "tiny", "--set", "capacity=16"],
    ["capacity=16", "capacity=128 would"],
  ),
  "detector: half a sample": (
    ["run", "walker", "--set", "window=100.5"],
    ["window takes int", "100.5"],
  ),
  "detector: half a patience": (["run", "walker", "--set", "patience=1.5"], ["patience takes int"]),
  "detector: a flag for a number": (
    ["run", "walker", "--detector", "cusum", "--set", "slack=true"],
    ["slack takes float"],
  ),
  "detector: a number for a channel": (
    ["run", "walker", "--detector", "cusum", "--set", "channel=5"],
    ["5 is no channel", "opr"],
  ),
  "detector: no channel": (["run", "walker", "--detector", "cusum@"], ["no channel", "opr"]),
  "detector: a threshold without end": (
    ["run", "walker", "--detector", "cusum", "--set", "threshold=Infinity"],
    ["threshold must be finite"],
  ),
  "adapt: acceptance": (
    ["run", "walker", "--adapt.acceptance", "nan"],
    ["acceptance must be finite"],
  ),
  "adapt: too long a reference": (
    ["run", "walker", "--adapt.refit", "99999999"],
    ["refit", "1,000,000"],
  ),
  "adapt: too much patience": (
    ["run", "walker", "--adapt.patience", "999999999"],
    ["patience", "100,000"],
  ),
  "seeds without end": (
    ["run", "walker", "--seeds", "9223372036854775808"],
    ["seeds at most", "9223372036854775808"],
  ),
  "adapt: too large a batch": (["run", "walker", "--adapt.batch", "1000000"], ["batch", "4,096"]),
  "adapt: more than 31 bits": (
    ["run", "walker", "--adapt.budget", "99999999999"],
    ["budget", "2,147,483,646"],
  ),
  "run: a seed of more than 31 bits": (
    ["run", "walker", "--first-seed", "2147483648"],
    ["first_seed", "2,147,483,638"],
  ),
  "run: no agent": (["run", "walker", "--agent", ""], ["agent", "empty name"]),
  "run: no out": (["run", "walker", "--out", ""], ["--out", "empty name"]),
  "eval: a seed below 0": (["eval", "walker", "--seed", "-1"], ["seed", "-1"]),
  "eval: a seed without end": (
    ["eval", "walker", "--seed", "99999999999999999999"],
    ["seed must lie in"],
  ),
  "eval: all episodes there are": (
    ["eval", "walker", "--episodes", "100000000"],
    ["episodes must lie in 1..10,000"],
  ),
  "train: a seed below 0": (["train", "walker", "--seed", "-1"], ["seed", "-1"]),
  "train: never saved": (["train", "walker", "--save-every-s", "nan"], ["--save-every-s"]),
  "train: updates without end": (
    ["train", "walker", "--set", "updates=99999999999999999999"],
    ["updates must be a whole number in"],
  ),
  "render: steps without end": (
    ["render", "walker", "--steps", "99999999999"],
    ["steps must lie in 1..100,000"],
  ),
  "bench: a shard in other digits": (["bench", "quick", "--shard", "²/3"], ["--shard takes K/N"]),
  "list: all": (["list", "zz"], ["all", "envs"]),
  "detector setting of another kind": (
    ["run", "walker", "--detector", "multichart", "--set", "charts=5"],
    ["charts", "commas", "5"],
  ),
  "adapting without a state behind": (
    ["run", "walker", "--adapt.last-starts", "1"],
    ["last_starts", "2 or more"],
  ),
  "train: no state behind": (
    ["train", "walker", "--set", "last_starts=1"],
    ["last_starts", "2..length"],
  ),
  "train: an agent that sees otherwise": (
    ["train", "quadruped", "--agent", "quadruped"],
    ["obs_scale spec", "--set obs_scale=spec"],
  ),
  "train: an agent of another size": (
    ["train", "walker", "--preset", "tiny", "--agent", "walker"],
    ["size size1m", "tiny"],
  ),
  "eval: environment": (["eval", "wlker"], ["wlker", "walker"]),
  "eval: zero episodes": (["eval", "walker", "--episodes", "0"], ["episodes"]),
  "eval: agent": (["eval", "walker", "--agent", "wlaker"], ["wlaker"]),
  "eval: fault": (["eval", "walker", "--fault", "gaer"], ["gaer", "gear"]),
  "eval: target": (["eval", "walker", "--fault", "gear", "--target", "hip"], ["right_hip"]),
  "list": (["list", "robots"], ["robots", "envs"]),
  "plot": (["plot", "nowhere"], ["nowhere"]),
}


@pytest.mark.parametrize("case", RUN)
def test_bad_argument_of_run_is_one_line(refused, tmp_path, case):
  argv, words = RUN[case]
  text = refused(2, *argv, "--out", tmp_path / "out")
  assert all(word in text for word in words), text
  assert content(tmp_path) == {}


@pytest.mark.parametrize("case", OTHER)
def test_bad_argument_is_one_line(refused, tmp_path, monkeypatch, case):
  argv, words = OTHER[case]
  monkeypatch.chdir(tmp_path)  # the default --out is relative
  text = refused(2, *argv)
  assert all(word in text for word in words), text
  assert content(tmp_path) == {}


# ---- bad agents ----------------------------------------------------------------------------------


def tamper(folder, **changes):
  card = json.loads((folder / "card.json").read_text())
  (folder / "card.json").write_text(json.dumps(card | changes))


def foreign(folder):
  np.savez(folder / "agent.npz", w=np.zeros(3))


def truncated(folder):
  data = (folder / "agent.npz").read_bytes()
  (folder / "agent.npz").write_bytes(data[: len(data) // 2])


def other_size(folder):
  tamper(folder, dreamer=dataclasses.asdict(PRESETS["cpu"].dreamer))


def member(folder, name="a.npy", content=b"garbage"):
  """Adds a file to the archive of weights."""
  with zipfile.ZipFile(folder / "agent.npz", "a") as archive:
    archive.writestr(name, content)


def retyped(kind):
  """The same weights as arrays of another type."""

  def spoil(folder):
    with np.load(folder / "agent.npz") as z:
      held = {k: np.zeros(z[k].shape, kind) for k in z.files}
    np.savez(folder / "agent.npz", **held)

  return spoil


def nested(folder):
  (folder / "card.json").write_text('{"env": ' + "[" * 100_000 + "]" * 100_000 + "}")


AGENTS = {
  "another robot": (lambda f: tamper(f, env="car"), 2, "car"),
  "another size": (other_size, 1, "does not fit size size1m"),
  "unknown size": (lambda f: tamper(f, dreamer={"size": "size3k"}), 1, "size1m"),
  **{
    f"repeat {value!r}": (lambda f, value=value: tamper(f, repeat=value), 1, word)
    for value, word in (
      *((value, "repeat takes int") for value in ("2", None, [1], 1.5, 1e30, True)),
      *((value, "repeat must lie in 1..100") for value in (0, -1, 101, 10**30)),
      *((value, "not finite") for value in (float("nan"), float("inf"))),
    )
  },
  "no robot": (lambda f: tamper(f, env=None), 1, "env takes str; got None"),
  "a number for a robot": (lambda f: tamper(f, env=3), 1, "env takes str; got 3"),
  "a word for updates": (lambda f: tamper(f, updates="x"), 1, "updates takes int"),
  "settings that are a list": (lambda f: tamper(f, dreamer=[]), 1, "dreamer must be a table"),
  "a word in the settings": (
    lambda f: tamper(f, dreamer={"size": "size1m", "lr": "x"}),
    1,
    "dreamer.lr takes float",
  ),
  "a number without end in the settings": (
    lambda f: tamper(f, dreamer={"size": "size1m", "batch": 10**400}),
    1,
    "batch must be above 0 and finite",
  ),
  "a score that is no number": (lambda f: tamper(f, eval=float("nan")), 1, "not finite"),
  "card without a ground": (nested, 1, "nested deeper than 64 levels"),
  "garbage among the weights": (member, 1, "is no array"),
  "weights that are text": (retyped("U3"), 1, "does not fit"),
  "weights that are void": (retyped("V4"), 1, "does not fit"),
  "weights that are complex": (retyped("c8"), 1, "does not fit"),
  "truncated": (truncated, 1, "agent.npz"),
  "empty": (lambda f: (f / "agent.npz").write_bytes(b""), 1, "agent.npz"),
  "foreign": (foreign, 1, "does not fit"),
  "no archive": (lambda f: (f / "agent.npz").write_text("weights"), 1, "agent.npz"),
  "pickled": (lambda f: np.savez(f / "agent.npz", w=np.array([{}])), 1, "agent.npz"),
  "without weights": (lambda f: (f / "agent.npz").unlink(), 1, "agent.npz"),
  "card of something else": (
    lambda f: (f / "card.json").write_text('{"name": "x"}'),
    1,
    "card.json",
  ),
  "card that is no object": (lambda f: (f / "card.json").write_text("[1]"), 1, "card.json"),
  "card that is no JSON": (lambda f: (f / "card.json").write_text("{"), 1, "card.json"),
}


@pytest.mark.parametrize("command", ["run", "eval"])
@pytest.mark.parametrize("case", AGENTS)
def test_bad_agent_is_one_line(refused, saved, tmp_path, case, command):  # noqa: F811
  spoil, code, word = AGENTS[case]
  shutil.copytree(saved, tmp_path / "agent")
  spoil(tmp_path / "agent")
  before = content(tmp_path)
  where = ["--out", tmp_path / "out"] if command == "run" else []
  assert word in refused(code, command, "walker", "--agent", tmp_path / "agent", *where)
  assert content(tmp_path) == before


# ---- the output folder ---------------------------------------------------------------------------


@pytest.fixture
def begun(mjx, saved, tmp_path, monkeypatch):  # noqa: F811
  """(arguments, folder) of a run that was cut off before its first chunk. The physics is never
  stepped here: a chunk is a Ctrl-C.
  """

  def cut(self):
    interrupt.note(signal.SIGINT)
    raise KeyboardInterrupt

  monkeypatch.setattr(run.Runner, "step", cut)
  argv = ["run", "walker", "--agent", saved, "--seeds", "1", "--out", tmp_path / "out"]
  code, out, err = mjx(*argv)
  assert (
    (code, out) == (130, "") and err.count("mjx-cl: ") == 1 and "--resume" in err.splitlines()[-1]
  )
  return argv, tmp_path / "out"


def test_another_run_is_refused_and_unchanged(refused, begun):
  argv, out = begun
  before = content(out)
  assert json.loads(before["config.json"])["env"] == "walker"
  text = refused(2, *argv)
  assert all(word in text for word in (str(out), "--resume", "--overwrite"))
  assert "exclude" in refused(2, *argv, "--resume", "--overwrite")
  assert content(out) == before


def test_resume_with_other_settings_is_refused(mjx, refused, begun):
  argv, out = begun
  before = content(out)
  assert "severity" in refused(2, *argv, "--resume", "--severity", "0.25")
  text = refused(2, *argv, "--resume", "--seeds", "2", "--set", "patience=9", "--adapt.ratio", "8")
  assert all(word in text for word in ("seeds", "settings", "adapt")) and "severity" not in text
  assert content(out) == before
  code, _, err = mjx(*argv, "--resume")  # the same settings go on
  assert code == 130 and "holds no run" not in err
  code, _, err = mjx(*argv[:-1], f"{out}-mistyped", "--resume")
  assert code == 130 and f"note: {out}-mistyped holds no run to go on with: one begins" in err


def test_resume_of_what_is_no_run(refused, begun):
  argv, out = begun
  (out / "config.json").write_text("{")
  assert "config.json" in refused(1, *argv, "--resume")
  (out / "config.json").write_text('{"command": "train", "env": "walker"}')
  assert "command" in refused(2, *argv, "--resume")


def test_overwrite_replaces_a_run_and_nothing_else(mjx, begun):
  argv, out = begun
  for name in ("trace.parquet", "summary.json", "figure.png", "notes.txt"):
    (out / name).write_text("old")
  assert mjx(*argv, "--overwrite", "--severity", "0.25")[0] == 130
  assert json.loads((out / "config.json").read_text())["severity"] == 0.25
  assert sorted(os.listdir(out)) == ["config.json", "notes.txt", "work"]


@pytest.mark.parametrize(
  "wrong",
  [
    ["--fault", "geer"],
    ["--detector", "cusums"],
    ["--target", "elbow"],
    ["--agent", "wlaker"],
    ["--severity", "2"],
    ["--set", "a=1"],
  ],
)
def test_a_mistake_beside_overwrite_loses_nothing(refused, begun, wrong):
  argv, out = begun
  (out / "trace.parquet").write_text("a night's work")
  before = content(out)
  refused(2, *argv, "--overwrite", *wrong)
  assert content(out) == before


def test_a_folder_of_something_else_is_refused(refused, saved, tmp_path):  # noqa: F811
  (tmp_path / "thesis.tex").write_text("years")
  assert "no run of mjx-cl" in refused(2, "run", "walker", "--agent", saved, "--out", tmp_path)
  assert "is a file" in refused(
    2, "run", "walker", "--agent", saved, "--out", tmp_path / "thesis.tex"
  )
  assert content(tmp_path) == {"thesis.tex": b"years"}


# ---- a full disk ---------------------------------------------------------------------------------


def full(*_, **__):
  raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_at_the_start_is_one_line(refused, saved, tmp_path, monkeypatch):  # noqa: F811
  monkeypatch.setattr(folders, "open", full, raising=False)
  assert "No space left" in refused(
    1, "run", "walker", "--agent", saved, "--seeds", "1", "--out", tmp_path / "out"
  )
  assert content(tmp_path / "out") == {}


def test_a_full_disk_at_a_checkpoint_is_one_line(mjx, begun, monkeypatch):
  """The chunk ends, its checkpoint does not fit: the run stops, what was there stays."""
  argv, out = begun
  before = content(out)

  def step(self):
    os.kill(os.getpid(), signal.SIGINT)
    each = np.zeros(2, int)
    return run.Progress(64, 25_000, 1.0, ["detector", "none"], [0, 0], each, each, each, each)

  monkeypatch.setattr(run.Runner, "step", step)
  monkeypatch.setattr(run.np, "savez", full)
  code, _, err = mjx(*argv, "--resume")
  *_, last = err.splitlines()
  assert (
    code == 1 and last.startswith("mjx-cl: ") and "No space left" in last and "unchanged" in last
  )
  assert content(out) == before


MAPS = "libparquet.so.2600: failed to map segment from shared object"


def test_a_message_of_several_lines_becomes_one(refused, monkeypatch):
  def fail(_):
    raise FileError("first\n  second\tthird")

  monkeypatch.setitem(app.DO, app.List, fail)
  assert refused(1, "list") == "mjx-cl: first second third\n"


@pytest.mark.parametrize("raised, said", [(MemoryError(), ""), (ImportError(MAPS), f": {MAPS}")])
def test_too_little_memory_is_said_as_such(refused, monkeypatch, raised, said):
  def fail(_):
    raise raised

  monkeypatch.setitem(app.DO, app.List, fail)
  assert refused(1, "list") == (
    f"mjx-cl: out of memory{said}; fewer --seeds, arms or detectors or a smaller batch need less\n"
  )


def test_what_a_part_lacked_memory_for_is_said_with_it(refused, monkeypatch):
  """A line of this package's that comes of too little memory keeps its words, and says so."""

  def fail(_):
    try:
      raise MemoryError("Unable to allocate 8 GiB")
    except MemoryError:
      raise UserError("detector 'x' failed") from None

  monkeypatch.setitem(app.DO, app.List, fail)
  assert "out of memory: detector 'x' failed; fewer --seeds" in refused(1, "list")


def test_a_pipe_that_closes_is_no_error(mjx, monkeypatch):
  def closed(_):
    raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))

  monkeypatch.setitem(app.DO, app.List, closed)
  assert mjx("list") == (0, "", "")


def test_a_second_interrupt_ends_the_process_without_its_threads(tmp_path):
  """A thread that goes on after the interrupt must neither hold the process up nor write to the
  terminal.
  """
  code = """
import sys, threading, time, os, signal
from mjx_cl.cli import app as cli
from mjx_cl.io.interrupt import Interruptible
def slow():
  time.sleep(300)
  print("late")
def do(args):
  with Interruptible():
    threading.Thread(target=slow).start()
    for _ in range(2):
      os.kill(os.getpid(), signal.SIGINT)
    time.sleep(200)
cli.DO[cli.Doctor] = do
sys.argv = ["mjx-cl", "doctor"]
sys.exit(cli.main())
"""
  begin = time.monotonic()
  out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=1200)
  assert out.returncode == 130 and time.monotonic() - begin < 250  # the thread sleeps for 300 s
  assert (
    out.stderr.splitlines() == ["mjx-cl: stopping after this chunk, saving", "mjx-cl: interrupted"]
    and "late" not in out.stdout
  )


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash on this machine")
def test_bash_completes_a_flag(mjx, tmp_path):
  code, script, _ = mjx("--tyro-print-completion", "bash")
  (tmp_path / "mjx-cl").write_text(script)
  ask = """
    source ./mjx-cl; own=$(complete -p mjx-cl | sed -E 's/.*-F ([^ ]+).*/\\1/')
    COMP_WORDS=(mjx-cl run walker --detec); COMP_CWORD=3
    COMP_LINE="mjx-cl run walker --detec"; COMP_POINT=${#COMP_LINE}
    $own mjx-cl --detec walker; echo "${COMPREPLY[@]}"
  """
  done = subprocess.run(["bash", "-c", ask], cwd=tmp_path, capture_output=True, text=True)
  assert (code, done.stdout.strip()) == (0, "--detector"), done.stderr


def test_nobody_waits_for_what_is_compiled_ahead():
  """A run whose streams never learn ends while a thread still compiles what they would need."""
  code = (
    "import sys, threading, time\n"
    "threading.Thread(target=time.sleep, args=(3600,), name='ahead_0').start()\n"
    "sys.argv = ['mjx-cl', 'list', 'arms']\n"
    "from mjx_cl.cli import app\n"
    "sys.exit(app.main())\n"
  )
  done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
  assert done.returncode == 0 and "  detector" in done.stdout and "FILE.py:NAME" in done.stdout
