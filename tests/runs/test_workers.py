"""Parts side by side: how many, what they write, and what is left when one fails, when they are
stopped and when their parent dies.
"""

import json
import re
import signal
import subprocess
import sys

import numpy as np
import psutil
import pyarrow.parquet
import pytest
from test_cli import mjx, refused  # noqa: F401  fixtures
from test_suite import mini  # noqa: F401  a fixture
from test_transfer import agent, saved  # noqa: F401  fixtures

from mjx_cl.errors import FileError, UserError
from mjx_cl.io import checkpoints as checkpoint
from mjx_cl.io import memory, tables
from mjx_cl.runs import run, scores, workers
from mjx_cl.runs import suite as suites

GB = 2**30


@pytest.mark.parametrize(
  "asked, needs, space, want",
  [
    (None, [GB] * 5, 100 * GB, 4),
    (None, [GB] * 5, 3 * GB, 3),
    (None, [3 * GB, GB, GB], 4 * GB, 2),
    (None, [GB], 100 * GB, 1),
    (None, [], GB, 1),
    (1, [GB] * 5, GB, 1),
    (4, [GB] * 5, 100 * GB, 4),
    (4, [GB], GB, 4),
  ],
)
def test_as_many_as_cores_and_memory_allow(monkeypatch, asked, needs, space, want):
  monkeypatch.setattr(workers, "cores", lambda: [0, 1, 2, 3])
  assert workers.number(asked, needs, space) == want


@pytest.mark.parametrize("asked, words", [(0, "1..4"), (5, "1..4"), (3, "2 would")])
def test_more_than_fit_are_refused(monkeypatch, asked, words):
  monkeypatch.setattr(workers, "cores", lambda: [0, 1, 2, 3])
  with pytest.raises(UserError, match=words):
    workers.number(asked, [GB] * 5, 2 * GB)


def compiled(suite, folder):
  """Lives one chunk of a suite's first part, whose programs then lie in the cache: two workers that
  begin together would both compile them.
  """
  runner = run.Runner(suites.suite(str(suite)).parts[0].config, folder)
  folder.mkdir()
  runner.open()
  runner.step()
  runner.checkpoints.close()


@pytest.mark.slow
def test_side_by_side_is_as_one_after_the_other(mjx, refused, mini, tmp_path, monkeypatch):  # noqa: F811
  """The same streams live the same lives on the same share of the cores."""
  own = workers.cores()
  monkeypatch.setattr(
    workers, "cores", lambda: own[-1:] * 2
  )  # two workers, also where there is one core
  monkeypatch.setattr(
    memory, "resident", lambda need: 0
  )  # ... or little memory free: these robots are small
  assert "1..2" in refused(2, "bench", mini, "--out", tmp_path / "x", "--jobs", "3")
  compiled(mini, tmp_path / "compiled")
  code, text, err = mjx(
    "bench", mini, "--out", tmp_path / "two", "--only", "grip", "--jobs", "2", "--json"
  )
  assert code == 0, err
  assert json.loads(text)["finished"] == 2 and re.findall(r"finished, (\d) of 2", err) == ["1", "2"]
  assert any(
    line.startswith("grip/severity=0.5: step 192/192") for line in err.splitlines()
  )  # what a worker says is passed on
  plan = suites.suite(str(mini))
  suites.write_plan(plan, tmp_path / "one")
  monkeypatch.setattr(workers, "cores", lambda: own[-1:])
  workers.together(
    WORKER,
    tmp_path / "one",
    [p.name for p in suites.pick(plan.parts, ("grip",))],
    1,
    lambda name: None,
  )
  scores.collect(tmp_path / "one", plan)
  one, two = (
    pyarrow.parquet.read_table(tmp_path / name / "bench.parquet").to_pydict()
    for name in ("one", "two")
  )
  assert one.keys() == two.keys()
  for name, values in one.items():
    if name == "wall_s":
      continue
    if any(isinstance(v, float) for v in values):
      np.testing.assert_array_equal(
        np.array(values, float), np.array(two[name], float), err_msg=name
      )
    else:
      assert values == two[name], name


WORKER = "mjx_cl.cli.worker"

TWO = """import sys
from mjx_cl.cli import app as cli
from mjx_cl.io import memory
from mjx_cl.runs import workers
own = workers.cores()
workers.cores, memory.resident = lambda: own[-1:] * 2, lambda need: 0
sys.exit(cli.main(sys.argv[1:]))"""


@pytest.fixture
def long(mini):  # noqa: F811
  """The suite with parts of 313 chunks, which outlast what is done to them."""
  mini.write_text(mini.read_text().replace("steps = 192", "steps = 20_000"))
  return mini


def saved_chunks(out, part):
  """Chunks in the newest checkpoint of a part."""
  checkpoints = checkpoint.Checkpoints(out / part / "work/checkpoints")
  try:
    return checkpoints.latest()
  finally:
    checkpoints.close()


def lives(lines, *parts):
  """Waits until each of the parts has said how far it is."""
  waiting = set(parts)
  for line in lines:
    waiting -= {part for part in waiting if line.startswith(f"{part}: step ")}
    if not waiting:
      return
  raise AssertionError(f"ended before {waiting} began")


def test_one_that_fails_is_named_and_none_goes_on(long, tmp_path, monkeypatch):
  own, ended = workers.cores(), []
  monkeypatch.setattr(workers, "cores", lambda: own[-1:] * 2)
  suites.write_plan(suites.suite(str(long)), tmp_path)
  value = json.loads((tmp_path / "suite.json").read_text())
  value["parts"]["healthy"]["agent"] = str(tmp_path / "nowhere")
  tables.write_json(tmp_path / "suite.json", value)
  with pytest.raises(UserError, match="^part healthy: no agent .*nowhere"):
    workers.together(WORKER, tmp_path, ["grip/severity=0.5", "healthy"], 2, ended.append)
  assert ended == [] and not psutil.Process().children()


def test_a_worker_that_is_killed_is_said(mini, tmp_path):  # noqa: F811
  suites.write_plan(suites.suite(str(mini)), tmp_path)
  worker = workers.Worker(WORKER, tmp_path, 0, [], lambda text: None)
  worker.give("healthy")
  worker.process.kill()
  worker.process.wait()
  with pytest.raises(FileError, match="healthy was ended by signal 9.*the same command goes on"):
    worker.check()


@pytest.mark.parametrize(
  "number", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)]
)
def test_no_worker_outlives_its_parent_and_all_have_saved(long, tmp_path, number):
  """The parent is killed outright, or asked to end: each worker saves between two chunks and ends."""
  out, parts = tmp_path / "out", ("grip/severity=0.5", "grip/severity=1.0")
  compiled(long, tmp_path / "compiled")
  parent = subprocess.Popen(
    [
      sys.executable,
      "-c",
      TWO,
      "bench",
      str(long),
      "--out",
      str(out),
      "--only",
      "grip",
      "--jobs",
      "2",
    ],
    stderr=subprocess.PIPE,
    stdout=subprocess.DEVNULL,
    text=True,
  )
  lives(parent.stderr, *parts)
  children = psutil.Process(parent.pid).children()
  assert len(children) == 2
  parent.send_signal(number)
  said = parent.stderr.read()
  assert parent.wait() == (130 if number == signal.SIGINT else -9)
  assert number == signal.SIGKILL or said.endswith(
    "mjx-cl: interrupted; the same command goes on where it stopped\n"
  )
  assert not psutil.wait_procs(children, timeout=1200)[1]
  assert all(
    saved_chunks(out, part) >= 1 and not (out / part / "summary.json").exists() for part in parts
  )
