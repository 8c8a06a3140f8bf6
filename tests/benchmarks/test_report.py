"""README and results agree; every number of a marked block comes from a file; bad input gives one
line.
"""

import json
import pathlib
import re
import shutil
import signal
import subprocess
import sys

import numpy as np
import pyarrow
import pyarrow.parquet as parquet
import pytest

from benchmarks.report import paper, report
from mjx_cl.cli import app
from mjx_cl.errors import FileError

ROOT = pathlib.Path(__file__).parents[2]
RESULTS = ROOT / "results"
PAGES = report.pages(ROOT)
USED = [
  (page, b.name) for page in PAGES for b in report.find(page.read_text().splitlines(), page.name)
]
SOURCES = {
  "run-walker": ("walker_gear/config.json", "walker_gear/summary.json", "walker_gear/runs.parquet"),
  "arl0": ("arl0.json",),
  "leaderboard": ("leaderboard.json", "leaderboard.parquet", "leaderboard_overall.parquet"),
  "leaderboard-100k": (
    "leaderboard_overall.parquet",
    *(
      f"leaderboard_100k/{file}"
      for file in ("leaderboard.json", "leaderboard.parquet", "leaderboard_overall.parquet")
    ),
  ),
  "physics": ("physics.json",),
  "dreamer": ("dreamer_update.json",),
  "agents": (
    "walker_agent/eval.json",
    "walker_agent/curve.parquet",
    "walker_learning/eval.json",
    "walker_learning/then.parquet",
    "car_agent/eval.json",
    "car_agent/eval_car_real.json",
    "car_agent/curve.parquet",
    *(
      f"{agent}_agent/{file}"
      for agent in ("walker_2", "walker_3", "car_2", "car_3")
      for file in ("eval.json", "curve.parquet")
    ),
    "quadruped_agent/eval.json",
    *(f"quadruped_trot_agent/eval{end}.json" for end in ("", "-2", "-3")),
    *(f"quadruped_trot_agent/curve{end}.parquet" for end in ("", "-2", "-3")),
    "quadruped_cloned/eval.json",
    "quadruped_agent/then.parquet",
    "quadruped_cloned/curve.parquet",
  ),
  "detectors": ("detectors.json",),
  "paper": tuple(
    f"paper/{robot}/{file}"
    for robot in ("walker", "quadruped", "car")
    for file in ("config.json", "summary.json", "runs.parquet")
  )
  + ("paper/car/events.parquet",),
  "arms": ("paper/bench.json",),
  "other-arms": ("arms/bench.json",),
  "stop-rule": ("stop/bench.json",),
  "oracle-stop": (
    "oracle_stop/suite.json",
    "oracle_stop/bench.json",
    "oracle_stop/damping/runs.parquet",
    "oracle_stop/payload/runs.parquet",
  ),
  "expert": (
    "paper/walker/runs.parquet",
    *(f"expert/walker/{file}" for file in ("config.json", "runs.parquet", "snapshots.parquet")),
  ),
  "rollback": (
    "rollback/suite.json",
    "rollback/bench.json",
    *(
      f"rollback/quadruped-{part}/{file}.parquet"
      for part in ("easy", "payload")
      for file in ("runs", "events")
    ),
  ),
  "again": ("again/bench.json",),
  "study": ("study/bench.json", "study/suite.json", "study/bench.parquet"),
  "size": ("size/bench.json", "size/suite.json", "size/less/config.json"),
  "full": ("full/bench.json", "full/suite.json", "full/bench.parquet"),
  "in-loop": (
    "loop/bench.json",
    "loop/suite.json",
    *(
      f"loop/{part}/{file}.parquet"
      for part in ("walker/detector=ewma", "walker/detector=cusum@surprise")
      for file in ("runs", "events")
    ),
  ),
  "two-agents": ("walker_gear/summary.json", "walker_plain/summary.json"),
  "several-agents": ("agents/bench.json",),
  "methods": tuple(
    f"methods_board/{file}"
    for file in ("methods.json", "methods.parquet", "methods_overall.parquet")
  ),
  "gradient": ("policy_gradient.json",),
  "raw-logs": ("raw_logs.json", "innovations.json"),
  "long-logs": ("long_log.json",),
  "gait": (
    "quadruped_agent/gait.json",
    *(f"quadruped_trot_agent/gait{end}.json" for end in ("", "-2", "-3")),
  ),
  "quadruped": (
    "quadruped_agent/finetuning/none/config.json",
    *(f"quadruped_agent/finetuning/{run}/curve.json" for run in ("none", "expert")),
    *(
      f"quadruped_agent/finetuning/{run}/{file}.json"
      for run in ("told", "ratio64", "ratio64_lr3e-5", "average0.02", "average0.01_lr2e-4")
      for file in ("config", "summary", "curve")
    ),
  ),
  "ppo": ("ppo_finetune.json", "paper/bench.json"),
}
BESIDE = {
  "physics": ("physics_xeon.json",),
  "dreamer": ("dreamer_update_xeon.json",),
  "detectors": ("detectors_epyc2.json",),
}  # of other machines: may be missing
ALL = [(name, file) for name, files in SOURCES.items() for file in files]


@pytest.fixture
def mjx(capsys):
  """mjx(*argv): (exit code, standard output, standard error) of `mjx-cl` in this process."""
  before = signal.getsignal(signal.SIGTERM)

  def call(*argv):
    capsys.readouterr()
    return app.main([str(a) for a in argv]), *capsys.readouterr()

  yield call
  signal.signal(signal.SIGTERM, before)


def write(path, rows):
  path.parent.mkdir(parents=True, exist_ok=True)
  parquet.write_table(pyarrow.Table.from_pylist(rows), path)


@pytest.fixture
def results(tmp_path):
  """A copy of results/ in which no file of any block is missing: the experiments of the paper are
  the walker's run, the car's with two changes.
  """
  out = tmp_path / "results"
  shutil.copytree(
    RESULTS,
    out,
    ignore=shutil.ignore_patterns(
      "*.png",
      "*.html",
      "paper",
      "arms",
      "stop",
      "again",
      "study",
      "size",
      "full",
      "loop",
      "detectors*.json",
      "policy_gradient.json",
    ),
  )
  rows = [
    {"name": "cusum: 1000 streams", "value": 0.4567, "unit": "s", "goal": "<= 1", "holds": True},
    {"name": "adwin: 1000 streams", "value": 23.4, "unit": "s", "goal": "<= 20", "holds": False},
    {"name": "ewma: a sample", "value": 1234.5, "unit": "ns", "goal": None, "holds": None},
  ]
  (out / "detectors.json").write_text(json.dumps(rows))
  (out / "detectors_epyc2.json").write_text(
    json.dumps(
      {
        "command": "measure --it",
        "machine": "an Abacus",
        "rows": [r | {"value": r["value"] / 2, "holds": r["goal"] and True} for r in rows[1:]],
      }
    )
  )
  steps = [
    {
      "step": s,
      "promise": 5 * s,
      "gain": s / 9,
      "gain_ci": [s / 9 - 0.011, s / 9 + 0.013],
      "terminations": 3 + round(100 * abs(s)),
    }
    for s in (0.0, 0.07, -0.07)
  ]
  (out / "policy_gradient.json").write_text(
    json.dumps(
      {"agents": [{"name": "walker", "robots": 48, "steps": 1024, "batches": 32, "rows": steps}]}
    )
  )
  runs = parquet.read_table(out / "walker_gear/runs.parquet").to_pylist()
  for robot in ("walker", "quadruped", "car"):
    (out / "paper" / robot).mkdir(parents=True)
    for file in ("config.json", "summary.json", "events.parquet"):
      shutil.copy(out / "walker_gear" / file, out / "paper" / robot)
    later = [
      r
      | {
        "change": 1,
        "onset": 15_000,
        "reward_drop": r["reward_drop"] + 0.1,
        "recovery_step": r["recovery_step"] and r["recovery_step"] + 10_000,
      }
      for r in runs
    ]
    write(
      out / "paper" / robot / "runs.parquet",
      [r | {"change": 0} for r in runs] + (later if robot == "car" else []),
    )
  summary = json.loads((out / "walker_gear/summary.json").read_text())
  back = {
    "n": 6,
    "recovered": 5,
    "median_steps": 4321.0,
    "median_steps_ci": [1234.0, None],
    "restricted_mean_steps": 5432.1,
    "restricted_mean_steps_ci": [3456.7, 6543.2],
    "horizon": 10_000,
  }
  worth = {"seeds": 7, "undefined": 3, "normalised": 0.876, "normalised_ci": [0.764, 1.043]}
  entry = {
    "arms": {
      arm: summary["arms"][arm] | {"updates_mean": 232.4, "terminations_mean": 3.21}
      for arm in ("detector", "none")
    },
    "scores": {
      "normalised": {"detector": worth, "none": worth | {"normalised": 0.012}},
      "recovery": {"detector": back, "none": None},
      "against_oracle": {
        "seeds": 8,
        "difference": -0.067,
        "difference_ci": [-0.189, 0.045],
        "holds_zero": True,
      },
    },
  }
  both = lambda name, value: {name: value, name + "_ci": [0.9 * value, 1.1 * value]}
  judged = {
    "adaptations": 9,
    "never_begun": 1,
    "ended": 8,
    **both("early", 3),
    **both("steps_after_oracle_median", 2345.0),
    **both("return_lost", 123.4),
    **both("lost_share", 0.034),
    **both("updates_wasted_mean", 56.7),
    **both("aborted_unrecoverable", 2),
    **both("aborted_recoverable", 1),
    **both("ended_unrecoverable", 1),
  }
  left_out = {
    name: {
      "adaptations": 9,
      "converged": n,
      "aborted": 9 - n,
      **both("own_stop_steps_median", 6789.0 + n),
      "judged": 7,
      "early": 4,
      **both("lost_share", 0.056),
    }
    for n, name in enumerate(("", "reward"), 6)
  }
  arms = {arm: entry["arms"][arm] | both("recovery_median_steps", 3333.0) for arm in entry["arms"]}
  entries = {
    "paper": entry,
    "arms": entry,
    "again": entry | {"arms": arms, "later_changes": [arms, arms]},
    "stop": {
      "steps": 18_000,
      "onset": 2000,
      "stop_rule": {"share": 0.95, "horizon_steps": 10_000, "arms": {"oracle": judged}},
      "scores": {"ablation": left_out, "without_floor": {"12": left_out}},
    },
  }
  (out / "study").mkdir()
  part = {"env": "walker", "fault": "gear", "severity": 0.25}
  (out / "study/suite.json").write_text(
    json.dumps(
      {
        "suite": "study",
        "parts": {
          "walker": part | {"adapt": {"ratio": 16.0}},
          "less": part | {"adapt": {"ratio": 4.0}},
        },
      }
    )
  )
  lived = [
    r
    | {"part": name, "reward_final": r["reward_final"] * (factor if r["arm"] == "detector" else 1)}
    for name, factor in (("walker", 1.0), ("less", 0.8))
    for r in runs
  ]
  write(out / "study/bench.parquet", lived)
  (out / "study/bench.json").write_text(
    json.dumps(
      {"suite": "study", "parts": 2, "finished": 2, "entries": {"walker": entry, "less": entry}}
    )
  )
  (out / "size/less").mkdir(parents=True)
  shutil.copy(out / "walker_gear/config.json", out / "size/less")
  one = part | {"adapt": {"ratio": 9.0}, "onset": 321, "steps": 7654, "target": "left_toe"}
  (out / "size/suite.json").write_text(
    json.dumps({"suite": "size", "parts": {"less": one, "more": one}})
  )
  (out / "size/bench.json").write_text(
    json.dumps({"suite": "size", "parts": 2, "finished": 1, "entries": {"less": entry}})
  )
  (out / "full").mkdir()
  plan = {
    "walker": part | {"fault": "gear"},
    "other": part | {"fault": "walker/damping-easy"},
    "car": part | {"env": "car"},
  }
  (out / "full/suite.json").write_text(
    json.dumps(
      {"suite": "full", "parts": {k: v | {"first_seed": 31, "seeds": 10} for k, v in plan.items()}}
    )
  )
  write(out / "full/bench.parquet", [r for r in lived if r["part"] == "walker"])
  (out / "full/bench.json").write_text(
    json.dumps({"suite": "full", "parts": 3, "finished": 1, "entries": {"walker": entry}})
  )
  plan = {
    f"walker/detector={d}": part
    | {"detector": d, "onset": 5000, "steps": 25_000, "first_seed": 31, "seeds": 10}
    for d in ("ewma", "cusum@surprise", "never")
  }
  for name, factor in zip(list(plan)[:2], (1.0, 0.7)):
    write(
      out / "loop" / name / "runs.parquet",
      [
        r
        | {
          "change": 0,
          "return_lost": r["return_lost"] and factor * r["return_lost"] + 17.0 * r["seed"] * factor,
        }
        for r in runs
      ],
    )
    write(
      out / "loop" / name / "events.parquet",
      parquet.read_table(out / "walker_gear/events.parquet").to_pylist()[: round(40 * factor)],
    )
  (out / "loop/suite.json").write_text(json.dumps({"suite": "loop", "parts": plan}))
  (out / "loop/bench.json").write_text(
    json.dumps(
      {
        "suite": "loop",
        "parts": 3,
        "finished": 2,
        "entries": {name: entry for name in list(plan)[:2]},
      }
    )
  )
  for suite, value in entries.items():
    (out / suite).mkdir(exist_ok=True)
    (out / suite / "bench.json").write_text(
      json.dumps({"suite": suite, "parts": 1, "finished": 1, "entries": {"walker": value}})
    )
  return out


def page(tmp_path, text, end="\n"):
  path = tmp_path / "PAGE.md"
  path.write_bytes(text.replace("\n", end).encode())
  return path


def block(name):
  return f"<!-- report:{name} -->\n<!-- /report -->\n"


# ---- README and results --------------------------------------------------------------------------


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_pages_agree_with_results(page):
  rows = report.report(RESULTS, page, check=True)
  assert rows and [r["name"] for r in rows if not r["agrees"]] == [], "run `mjx-cl report`"


def test_every_block_is_shown_once():
  assert sorted(name for _, name in USED) == sorted(report.BLOCKS | report.CODE)


@pytest.mark.parametrize(
  "page",
  [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "results").rglob("*.md")],
  ids=lambda p: str(p.relative_to(ROOT)),
)
def test_links_of_a_page_lead_somewhere(page):
  lost = []
  for at, _, anchor in re.findall(r"\]\(([^)#\s]*)(#([^)\s]+))?\)", page.read_text()):
    target = page.parent / at if at else page
    if re.match(r"https?:", at):
      continue
    if not target.exists() or (anchor and anchor not in anchors(target)):
      lost.append(f"{at}#{anchor}" if anchor else at)
  assert lost == []


def anchors(page):
  """Of the headings of a Markdown page, as GitHub writes them."""
  heads = re.findall(r"^#+ (.+)$", page.read_text(), re.M)
  return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def test_a_figure_of_the_answers_stands_on_the_page_that_is_linked():
  blocks = r"<!-- report:.*?<!-- /report -->"
  page = (ROOT / "docs/results.md").read_text()
  shown, seen, lost = " ".join(re.findall(blocks, page, re.S)), 0, []
  for section in re.split(r"\n## ", re.sub(blocks, "", page, flags=re.S)):
    linked = set(re.findall(r"\]\((\.\./results/[^)#]+/README.md)", section))
    text = shown + "".join((ROOT / "docs" / at).read_text() for at in linked)
    text = " ".join(text.split())
    figures = re.findall(r"-?\d[\d.,]* \[-?\d[^\]]+\]", section)
    seen += len(figures)
    lost += [figure for figure in figures if figure not in text]
  assert seen > 15 and lost == []


def test_every_block_has_its_sources_here():
  assert set(SOURCES) == set(report.BLOCKS)


@pytest.mark.parametrize(
  "shown", sorted({page for page, _ in USED}), ids=lambda x: str(x.relative_to(ROOT))
)
def test_one_changed_digit_of_each_block_is_found(shown, mjx, tmp_path):
  # the copy does not lie beside the results
  text = re.sub(r"(\.\./)+results/", "results/", shown.read_text())
  lines = text.splitlines(keepends=True)
  right = "".join(lines)
  blocks = report.find(lines, shown.name)
  for block in blocks:
    k = max(k for k in range(block.first + 1, block.last) if re.search(r"\d", lines[k]))
    lines[k] = re.sub(r"\d(?=\D*$)", lambda m: str((int(m[0]) + 1) % 10), lines[k].rstrip("\n"))
    lines[k] += "\n"
  names = ", ".join(dict.fromkeys(block.name for block in blocks))
  wrong = page(tmp_path, "".join(lines))
  before = wrong.read_bytes()
  code, out, err = mjx("report", "--results", RESULTS, "--page", wrong, "--check")
  assert (code, out) == (1, "") and err.count("\n") == 1
  assert f"disagrees with {RESULTS} in: {names};" in err
  assert wrong.read_bytes() == before != right.encode()
  done = mjx("report", "--results", RESULTS, "--page", wrong)
  assert done[:2] == (0, f"{wrong}: written anew: {names}\n")
  assert wrong.read_text() == right


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_nothing_outside_the_blocks_changes(end, mjx, results, tmp_path):
  before, after = (
    "\ufeffa  \n\n\x0b ü 1.25\u2028x\n",
    "b\n  <b>-->\n" + block("physics") + "last line without an end",
  )
  path = page(tmp_path, before + block("arl0") + after, end)
  assert mjx("report", "--results", results, "--page", path)[0] == 0
  once = path.read_bytes()
  text = once.decode().replace(end, "\n")
  assert (
    text.startswith(before + "<!-- report:arl0 -->\nDetector and stop rule")
    and once.count(b"\n") == once.count(end.encode()) > 10
  )
  assert (
    text.endswith("last line without an end")
    and report.render("arl0", results) in text
    and report.render("physics", results) in text
  )
  stamp = path.stat().st_mtime_ns, path.stat().st_ino
  assert (
    mjx("report", "--results", results, "--page", path)[1]
    == f"{path}: all 2 blocks agree with {results}\n"
  )
  assert (
    path.read_bytes() == once and (path.stat().st_mtime_ns, path.stat().st_ino) == stamp
  )  # not even written


def test_json_says_which_agree(mjx, results, tmp_path):
  path = page(tmp_path, "x\n" + block("arl0") + block("physics") + block("arl0"))
  code, out, err = mjx("report", "--results", results, "--page", path, "--json")
  assert (
    code == 0
    and err == ""
    and json.loads(out)
    == [
      {"page": str(path), "name": name, "line": line, "agrees": False}
      for name, line in (("arl0", 2), ("physics", 4), ("arl0", 6))
    ]
  )
  path.write_text(path.read_text().replace("medians", "means"))
  code, out, err = mjx("report", "--results", results, "--page", path, "--json", "--check")
  assert (
    code == 1
    and [r["agrees"] for r in json.loads(out)] == [True, False, True]
    and "in: physics;" in err
  )


def test_no_jax_is_imported():
  code = (
    "import sys; from mjx_cl.cli import app as cli; code = cli.main(['report', '--check', "
    "'--page', "
    "'docs/results.md']); "
    "print(code, [m for m in ('jax', 'mujoco', 'flax', 'matplotlib') if m in sys.modules])"
  )
  done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
  assert done.stdout.splitlines()[-1] == "0 []", done


# ---- bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
  "text, says",
  [
    (
      "<!-- report:arl -->\n<!-- /report -->\n",
      "PAGE.md:1: unknown block 'arl'; choose from: again, agents, arl0,",
    ),
    ("\n<!-- report:arl0 -->\nx\n", "PAGE.md:2: block 'arl0' is not closed by <!-- /report -->"),
    (
      "<!-- report:arl0 -->\n<!-- report:physics -->\n<!-- /report -->\n",
      "PAGE.md:1: block 'arl0' is not closed",
    ),
    ("a\n<!-- /report -->\n", "PAGE.md:2: <!-- /report --> closes nothing"),
    (
      "<!--report:arl0-->\n<!-- /report -->\n",
      "PAGE.md:1: '<!--report:arl0-->' is no marker; write <!-- report:NAME -->",
    ),
    (
      "<!-- report: arl0 -->\n<!-- /report -->\n",
      "PAGE.md:1: '<!-- report: arl0 -->' is no marker",
    ),
    ("text <!-- report:arl0 --> 5\n", "PAGE.md:1: 'text <!-- report:arl0 --> 5' is no marker"),
    ("<!-- report:arl0 -->\n<!-- /report --> x\n", "PAGE.md:2: '<!-- /report --> x' is no marker"),
    (
      "<!-- report:arl0 -->\n5 <!-- /report:arl0 -->\n",
      "PAGE.md:2: '5 <!-- /report:arl0 -->' is no marker",
    ),
  ],
)
def test_bad_markers(text, says, mjx, results, tmp_path):
  path = page(tmp_path, text)
  code, out, err = mjx("report", "--results", results, "--page", path)
  assert (
    (code, out) == (1, "") and err.count("\n") == 1 and says in err and path.read_text() == text
  )


def test_files_that_are_not_there(mjx, results, tmp_path):
  path = page(tmp_path, "\n")
  assert mjx("report", "--results", tmp_path / "none", "--page", path) == (
    2,
    "",
    f"mjx-cl: no folder {tmp_path / 'none'}\n",
  )
  assert mjx("report", "--results", results, "--page", tmp_path / "none.md") == (
    2,
    "",
    f"mjx-cl: no file {tmp_path / 'none.md'}\n",
  )
  code, out, err = mjx("report", "--results", results, "--page", tmp_path)
  assert code == 1 and err.count("\n") == 1 and "irectory" in err
  assert mjx("report", "--results", results, "--page", path) == (
    0,
    f"{path}: no marked block\n",
    "",
  )
  path.write_bytes(b"\xff\xfe\x00")
  assert mjx("report", "--results", results, "--page", path) == (
    1,
    "",
    f"mjx-cl: {path} is no UTF-8 text\n",
  )


@pytest.mark.parametrize("name, file", ALL)
@pytest.mark.parametrize("how", ["missing", "empty", "other"])
def test_a_file_of_a_block_is_missing_or_broken(name, file, how, results, tmp_path):
  path, target = page(tmp_path, block("arl0") + block(name)), results / file
  before = path.read_bytes()
  if how == "missing":
    target.unlink()
  elif how == "empty":
    target.write_bytes(b"")
  elif file.endswith("parquet"):
    write(target, [{"some": 1}])
  else:
    target.write_text('{"some": 1}')
  if (
    how == "other"
    and name == "paper"
    and file.endswith("summary.json")
    or how == "other"
    and name == "detectors"
  ):
    target.write_text("[1]")
  with pytest.raises(FileError) as e:
    report.report(results, path)
  said = str(e.value)
  assert (
    f"block '{name}'" in said
    and (str(target) in said or how == "other")
    and "\n" not in said
    and path.read_bytes() == before
  )


def test_a_missing_row_of_a_script_is_named(results):
  path = results / "physics.json"
  (results / "physics_xeon.json").unlink()  # another machine's file may have it
  value = json.loads(path.read_text())
  gone = value["rows"].pop(0)["name"]
  path.write_text(json.dumps(value))
  with pytest.raises(FileError, match=re.escape(f"block 'physics': {path} has no row {gone!r}")):
    report.render("physics", results)


# ---- every number comes from a file --------------------------------------------------------------


def changed(value, key="", place=0):
  """Every number of a JSON value, or column, becomes another one: by its key, so that no ratio or
  difference of two stays; 0 may stay 0.
  """
  if isinstance(value, dict):
    return {k: changed(v, k) for k, v in value.items()}
  if isinstance(value, list):
    return [changed(v, key, i) for i, v in enumerate(value)]
  if isinstance(value, str) and key in ("goal", "machine"):
    return re.sub(r"\d+(\.\d+)?", lambda m: f"{2 * float(m[0]) + 0.03:g}", value)
  if value is None or isinstance(value, (str, bool)) or key in ("change", "seed", "stream"):
    return value
  if isinstance(value, int):
    return value + value // 3 + len(key) + place
  return value * (3.1 + 0.1 * (len(key) % 7)) + (0.173 if value > 0 else 0.0)


def change(path):
  if path.suffix == ".json":
    path.write_text(json.dumps(changed(json.loads(path.read_text()))))
    return
  rows = [changed(r) for r in parquet.read_table(path).to_pylist()]
  if path.name == "runs.parquet" or {"loop", "rollback"} & set(
    path.parts
  ):  # counts of rows are numbers too
    rows += rows
  elif path == path.parent.parent / "full" / "bench.parquet":
    rows += [r | {"seed": r["seed"] + 1000} for r in rows]
  elif path.name == "leaderboard.parquet":
    rows += [r | {"fault": "another"} for r in rows]
  elif path.name == "leaderboard_overall.parquet":
    rows.append(rows[-1] | {"detector": "another", "cost_standard": -1e9})
  write(path, rows)


# what a block says of itself: windows of the definitions, sizes in names of rows, goals
CONSTANTS = {
  "run-walker": {"95", "500", "2,000", "10,000"},
  "arl0": {"500"},
  "leaderboard": {"100", "95", "1", "5", "4"},
  "leaderboard-100k": {"100", "100k", "95", "5", "10,000"},
  "physics": {"160", "256", "16", "64", "1,024"},
  "dreamer": {"2,048", "16", "64", "15", "1,024", "256", "1", "12", "32", "40"},
  "agents": {"95", "0.25", "5", "2", "3"},
  "detectors": {"1000"},
  "paper": {"95"}
  | {
    x
    for e in paper.EXPERIMENTS.values()
    for s in e.statements
    for x in re.findall(r"[\d,.]*\d", s.text)
  }
  | {x for e in paper.EXPERIMENTS.values() for x in re.findall(r"[\d,.]*\d", e.runs)}
  | {f"{e.onset:,}" for e in paper.EXPERIMENTS.values()}
  | {"16", "12", "4", "05"},  # the authors' batch, size and learning rate
  "arms": {"95", "1", "2,000", "10,000"},
  "other-arms": {"95", "1", "2,000", "10,000"},
  "oracle-stop": {"95", "2,000", "0"},
  "expert": {"4", "2,000", "1", "5", "0", "0.94"},  # the last a ratio of differences of one column
  "rollback": {"95", "2,000", "10", "5", "1"},
  "stop-rule": {"95", "1", "50", "768", "1,536", "3,072"},
  "again": {"95", "2,000"},
  "study": {"1", "2,000"},
  "size": {"1", "2,000", "20"},
  "full": {"95", "500", "2,000", "1", "2", "3"},
  "in-loop": {"95", "500", "2,000", "10,000", "1", "2", "3"},
  "two-agents": {"95", "500", "10,000", "2,000"},
  "several-agents": {"95", "500", "10,000", "2,000", "0", "2", "3"},  # the last of names
  "methods": {"0", "100", "95"},
  "gradient": {"95"},
  "raw-logs": {"1"},
  "gait": {"20", "2", "3"},  # of names too
  "quadruped": {"95", "8"},
  "ppo": {"95", "3"},
}


@pytest.mark.parametrize("name", report.BLOCKS)
def test_every_number_follows_the_files(name, results):
  old = report.render(name, results)
  for file in (*SOURCES[name], *BESIDE.get(name, ())):
    change(results / file)
  new = report.render(name, results)
  tokens = lambda text: re.findall(r"[\d,.]*\d", text)
  old, new = tokens(old), tokens(new)
  assert len(old) > 2
  stays = [
    (a, old[max(0, k - 3) : k + 3])
    for k, (a, b) in enumerate(zip(old, new))
    if a == b and a not in CONSTANTS[name] and float(a.replace(",", ""))
  ]
  assert stays == []


@pytest.mark.parametrize(
  "name, file",
  [p for p in ALL if "paper/" not in p[1] or "summary" not in p[1]]
  + [(name, file) for name, files in BESIDE.items() for file in files],
)
def test_every_file_counts(name, file, results):
  old = report.render(name, results)
  change(results / file)
  assert report.render(name, results) != old


# ---- values --------------------------------------------------------------------------------------


def cells(text, start):
  """Cells of the one table row that begins with `start`."""
  (line,) = [x for x in text.split("\n") if x.startswith(f"| {start}")]
  return [x.strip() for x in line.strip("|").split("|")]


def test_the_walkers_table_against_its_runs(results):
  text = report.render("run-walker", results)
  runs = parquet.read_table(results / "walker_gear/runs.parquet").to_pylist()
  main = [r for r in runs if r["arm"] == "detector"]
  hit = [r for r in main if r["affected"]]
  back = sorted(r["recovery_step"] - 5000 for r in hit)
  assert cells(text, "recovery, median")[1].startswith(f"{back[2]:,} [")
  recovered = (
    f"{sum(x <= 10_000 for x in back)} of {len(hit)} [2.6, 5.8] ({len(back)} within 20,000)"
  )
  assert cells(text, "affected streams recovered")[1:] == [recovered, "0 of 6"]
  final = np.sort([r["reward_final"] for r in hit])[1:-1].mean()
  assert cells(text, "reward over the last")[1].startswith(f"{final:.2f} [")
  hips = [r["reward_final"] / r["reward_pre"] for r in hit if r["fault"] == "gear:right_hip"]
  assert f"right_hip {100 * np.mean(hips):.0f} % ({len(hips)})" in text
  assert (
    f"lose at most {100 * max(r['reward_drop'] for r in main if not r['affected']):.1f} %" in text
  )


def test_the_board_is_sorted_and_whole(results):
  text = report.render("leaderboard", results)
  overall = parquet.read_table(results / "leaderboard_overall.parquet").to_pylist()
  shown = [
    re.match(r"\| (.+?) \| (-?\d+) \[", line).groups()
    for line in text.split("\n")
    if re.match(r"\| .+ \| -?\d+ \[", line)
  ]
  assert [int(x) for _, x in shown] == sorted((int(x) for _, x in shown), reverse=True) and len(
    shown
  ) > 10
  rest = text[text.rindex("\n\n") :].replace("\n", " ")
  assert {r["detector"] for r in overall} == {d.rstrip(" §¶") for d, _ in shown} | {
    r["detector"] for r in overall if f" {r['detector']} " in rest
  }
  assert "-0 " not in text and "-0]" not in text and "-0.0" not in text
  rows = parquet.read_table(results / "leaderboard.parquet").to_pylist()
  bounded = {r["detector"] for r in rows if (r["note"] or "").startswith("no threshold gives")}
  assert {d.removesuffix(" §") for d, _ in shown if d.endswith("§")} == bounded & {
    d.removesuffix(" §") for d, _ in shown
  } and bounded
  best = max(
    {r["detector"] for r in rows if not r["reference"]},
    key=lambda d: np.mean(
      [r["cost_standard"] for r in rows if (r["detector"], r["robot"]) == (d, "car")]
    ),
  )
  assert f"`{best}`" in " ".join(text.split()).split("Best on each robot:")[1].split("(car)")[0]


@pytest.mark.parametrize(
  "n, ci, want",
  [
    (5, [0.77, 0.81], "0.79 [0.77, 0.81], 5 seeds"),
    (3, [0.77, 0.81], "0.79 (0.77 to 0.81), 3 seeds"),
    (1, [0.79, 0.79], "0.79, 1 seed"),
    (1, None, "0.79, 1 seed"),
  ],
)
def test_three_seeds_give_no_interval(n, ci, want):
  assert report.few({"x": 0.79, "x_ci": ci}, "x", n, 2) == want


def test_an_experiment_that_was_not_run_is_named(results):
  shutil.rmtree(results / "paper/car")
  text = " ".join(report.render("paper", results).split())
  assert (
    "Not run to its end yet: `paper/car-transfer` and `paper/car-socks`." in text
    and "| `paper/walker`" in text
  )
  shutil.rmtree(results / "paper")
  with pytest.raises(FileError, match="bench paper"):
    report.render("paper", results)


def test_the_catalogue_holds_every_fault_and_item(results):
  from mjx_cl import faults
  from mjx_cl.envs.car_real import GAP

  text = report.render("faults", results)
  names = re.findall(
    r"^\| `(\w+)` \| (\w+) \| [^|]{20,} \| [^|]{8,} \| [^|]{5,} \| [^|]{3,} \|$", text, re.M
  )  # each says all that a reader asks
  assert (
    names == [(name, family) for family, members in faults.FAMILIES.items() for name in members]
    and len(names) == text.count("\n") - 1
  )
  assert cells(text, "`velocity_limit`")[3].startswith("1 leaves 5 % of the limit")
  gap = report.render("gap", results)
  assert re.findall(r"^\| `(\w+)`", gap, re.M) == list(GAP) and cells(gap, "`grip`")[2:4] == [
    "1.049",
    "0.65",
  ]


def test_arms_side_by_side(results):
  text = report.render("arms", results)
  assert cells(text, "`walker`") == [
    "`walker`",
    "detector",
    "5 of 6",
    "4,321 [1,234, -]",
    "5,432 [3,457, 6,543]",
    "0.88 [0.76, 1.04], 7 seeds",
    "232",
    "3.2",
  ]
  assert cells(text, "| none")[:5] == ["", "none", "none affected", "-", "-"]
  assert "walker -0.07 [-0.19, 0.04], 8 seeds, the interval holds 0" in " ".join(text.split())


def test_missed_goals_are_said(results):
  path = results / "physics.json"
  value = json.loads(path.read_text())
  for row in value["rows"]:
    row["holds"] = None if row["goal"] is None else True
  path.write_text(json.dumps(value))
  assert "missed" not in report.render("physics", results)
  value["rows"][0] |= {"value": 0.8125, "holds": False}
  path.write_text(json.dumps(value))
  (results / "physics_xeon.json").unlink()
  assert (
    "| jitted rollout of 160 walkers, against bare mjbatch stepping of the same work | ratio | "
    "0.81 (missed) | >= 0.85 |"
  ) in report.render("physics", results)
  detectors = report.render("detectors", results)
  assert "| | unit | measured | an Abacus | goal |" in detectors
  assert (
    "| cusum: 1000 streams | s | 0.457 | - | <= 1 |" in detectors
  )  # the second machine did not measure it
  assert "| adwin: 1000 streams | s | 23.4 (missed) | 11.7 | <= 20 |" in detectors
  assert "| ewma: a sample | ns | 1,234 | 617 | |" in detectors


# ---- the paper -----------------------------------------------------------------------------------


def run_row(seed, **other):
  return {
    "stream": seed,
    "arm": "detector",
    "seed": seed,
    "change": 0,
    "onset": 5000,
    "latency_steps": 100,
    "adapt_start": 5110,
    "adapt_stop": 12_000,
    "outcome": "converged",
    "affected": True,
    "recovery_step": 9000,
    "stable_step": 9500,
    "reward_pre": 1.0,
    "reward_drop": 0.3,
    "reward_final": 0.9,
    "first_stop": 12_000,
    "restarts": 0,
  } | other


CONFIG = json.loads((RESULTS / "walker_gear/config.json").read_text())


def test_medians_and_intervals_are_those_of_the_summary(results):
  summary = json.loads((results / "paper/walker/summary.json").read_text())
  runs = parquet.read_table(results / "paper/walker/runs.parquet").to_pylist()
  lines = {
    what: (own, gap) for what, _, own, gap in paper.compare("paper/walker", CONFIG, runs, [])
  }
  low, high = summary["recovery_median_steps_ci"]
  assert lines["reward back after onset"] == (
    f"5,092 [{low:,.0f}, {high:,.0f}] steps, 6 of 6 affected streams",
    "-4,908 steps",
  )
  low, high = summary["latency_median_steps_ci"]
  assert high is None and lines["alarm after onset"] == (
    f"271 [{low:,.0f}, -] steps, 6 of 10 streams",
    "the paper gives no figure",
  )


def test_each_measure_by_hand():
  calm = run_row(
    1,
    latency_steps=None,
    adapt_start=None,
    adapt_stop=None,
    first_stop=None,
    outcome="nominal",
    recovery_step=None,
    reward_drop=0.0,
    affected=False,
  )
  lost = run_row(
    2,
    latency_steps=300,
    adapt_stop=20_000,
    outcome="aborted_by_rule",
    recovery_step=None,
    reward_final=0.5,
    first_stop=None,
  )
  rows = [run_row(0), calm, lost, run_row(3, reward_final=1.0, restarts=2)]
  measured = {name: f(rows) for name, f in paper.MEASURES.items()}
  assert {name: m.value for name, m in measured.items()} == {
    "latency": 100,
    "recovery": 4000,
    "stop": 7000,
    "last_stop": 20_000,
    "outcomes": 0.5,
    "kept": pytest.approx(0.8),
    "drop": pytest.approx(0.3),
    "stable": 4500,
  }
  assert paper.stable([{k: v for k, v in run_row(0).items() if k != "stable_step"}]).value is None
  assert measured["stop"].text.endswith("2 of 4 streams, 1 of them alarmed again later")
  assert measured["recovery"].text.endswith("2 of 3 affected streams") and measured[
    "latency"
  ].text.endswith("3 of 4 streams")
  assert (
    measured["outcomes"].text
    == "converged 2 of 4 [0.6, 3.4], aborted 1, still adapting 0, never alarmed 1"
  )
  assert measured["last_stop"].text == "20,000 (3 streams ended one)"
  rows.append(run_row(4, outcome="adapting", adapt_stop=None))
  assert paper.last_stop(rows) == paper.Measured(
    None, "- (3 streams ended one, the last at 20,000; 1 still adapting at the end of the run)"
  )
  assert paper.recovery([run_row(0, affected=False)]) == paper.Measured(
    None, "none of affected streams"
  )
  never = [run_row(k, recovery_step=None) for k in range(4)]
  assert paper.recovery(never) == paper.Measured(None, "- [-, -] steps, 0 of 4 affected streams")


def test_numbers_and_intervals():
  assert [
    paper.number(-0.3),
    paper.number(-0.04, 1),
    paper.number(-1234.56, 1),
    paper.number(None),
  ] == ["0", "0.0", "-1,234.6", "-"]
  assert [paper.span([-0.2, 1e4]), paper.span([1.0, None], 1), paper.span(None)] == [
    "[0, 10,000]",
    "[1.0, -]",
    "",
  ]


def test_differences():
  assert paper.difference(10_000, paper.Measured(12_500.0, "")) == "+2,500 steps"
  assert paper.difference(10_000, paper.Measured(10_000, "")) == "0 steps"
  assert paper.difference(0.2, paper.Measured(0.15, "", "%")) == "-5 points"
  assert paper.difference(None, paper.Measured(3, "")) == "the paper gives no figure"
  assert paper.difference(5, paper.Measured(None, "")) == "not reached"


def test_each_change_of_the_car_has_rows_of_its_own():
  later = {"change": 1, "onset": 47_000, "reward_drop": 0.25, "latency_steps": None}
  runs = [run_row(k) for k in range(4)] + [
    run_row(k, recovery_step=50_000 + k, **later) for k in range(4)
  ]
  event = lambda stream, step, kind: {"stream": stream, "step": step, "kind": kind}
  events = (
    [event(k, 5100, "start") for k in range(4)]
    + [event(k, 12_000 + k, "stop") for k in range(3)]
    + [event(2, 13_000, "start"), event(2, 14_000, "stop")]
  )
  events += [
    event(3, 46_000, "abort"),
    event(3, 48_000, "stop"),
  ]  # the latter is of the second change
  first, second = (
    dict((line[0], line[2:]) for line in paper.compare(name, CONFIG, runs, events))
    for name in ("paper/car-transfer", "paper/car-socks")
  )
  assert first["reward back after transfer"][0].startswith("4,000 [") and second[
    "reward back after the socks"
  ][0].startswith("3,001 [")
  assert second["reward lost at first"] == ("25 [25, 25] %, 4 streams", "+5 points")
  assert second["alarm after the socks"][0] == "- [-, -] steps, 0 of 4 streams"
  assert first["first finetuning ends after"] == (
    "7,001 [7,000, -] steps, 3 of 4 streams, 1 of them alarmed again later",
    "-32,999 steps",
  )
  assert [r["first_stop"] for r in paper.with_stops(runs, events)] == [
    12_000,
    12_001,
    12_002,
    None,
    None,
    None,
    None,
    48_000,
  ]
  with pytest.raises(
    FileError, match="paper/car-socks: runs.parquet holds no row of arm `detector` with change 1"
  ):
    paper.compare("paper/car-socks", CONFIG, runs[:4], events)


def test_what_differs_from_the_papers_setup():
  walker, dog = paper.EXPERIMENTS["paper/walker"], paper.EXPERIMENTS["paper/quadruped"]
  assert paper.setup(walker, CONFIG) == [
    "size1m in place of size12m",
    "4 sequences an update in place of 16",
    "learning rate 0.0001 in place of 4e-05",
    "while finetuning the robot acts by a moving average of the weights (rate 0.1 every 64 steps)",
    "a finetuning lasts 6,000 steps at least before it may converge",
    "detector `rolling_sigma` in place of three standard deviations of single residuals",
    "agent pretrained with a demonstrator",
  ]
  same = json.loads(json.dumps(CONFIG)) | {"detector": "rolling_sigma_plain", "onset": 9000}
  same["adapt"] |= {"batch": None, "lr": None, "average": 1.0, "least": 1}
  same["agent_card"] = {"dreamer": {"size": "size12m", "batch": 16, "lr": 4e-5}}
  assert paper.setup(dog, same) == [dog.robot]
  assert paper.setup(walker, same) == ["onset 9,000 in place of 5,000"]
  slower = CONFIG | {"agent_card": CONFIG["agent_card"] | {"finetuning_lr": 3e-5}}
  assert paper.setup(walker, slower)[2] == "learning rate 3e-05 in place of 4e-05"
  held = CONFIG | {"agent_card": CONFIG["agent_card"] | {"finetuning_anchor": 0.1}}
  line = "policy held to the actions taken with a weight of 0.1"
  assert line in paper.setup(walker, held | {"adapt": CONFIG["adapt"] | {"anchor": None}})
  for factor in (0.1, 0.0):
    given = slower | {"adapt": CONFIG["adapt"] | {"model_lr": factor}}
    assert paper.setup(walker, given)[3] == f"the world model's own steps {factor:g} times as long"
  same["agent_card"]["dreamer"] |= {"horizon": 33, "policy_lr": 1e-6}  # of its last stage alone
  same["adapt"] |= {"policy_lr": 0.5}
  assert paper.setup(dog, same) == [
    "the policy's own steps 0.5 times as long",
    "discount horizon 33 in place of 333",
    dog.robot,
  ]
  same["agent_card"]["dreamer"] = {
    "size": "size12m",
    "anchor": 0.2,
    "min_std": 0.03,
    "max_std": 0.5,
    "entropy": 0.0,
  }
  same["adapt"] |= {"anchor": 0.05, "policy_lr": None}
  assert paper.setup(dog, same)[:4] == [
    "policy held to the actions taken with a weight of 0.05",
    "standard deviation of the actions at least 0.03 in place of 0.1",
    "at most 0.5 in place of 1",
    "entropy weight 0 in place of 0.0003",
  ]


def test_the_papers_block_names_every_experiment(results):
  text = report.render("paper", results)
  for name, e in paper.EXPERIMENTS.items():
    assert text.count(f"| `{name}`: {e.protocol}; ") == 1
  assert sum(line.startswith("| ") for line in text.split("\n")) == 1 + sum(
    len(e.statements) for e in paper.EXPERIMENTS.values()
  )
  assert text.count("size1m") == 1  # what all share is said once
  own = f"onset 5,000 in place of 9,000; {paper.EXPERIMENTS['paper/quadruped'].robot}"
  assert cells(text, "`paper/quadruped`")[-1] == own
  assert len({line.count("|") for line in text.split("\n") if line.startswith("|")}) == 1
