"""Parts side by side: how many, what they write, and what is left when one fails, when they are stopped and when their parent dies."""
import json
import pathlib
import subprocess
import sys
import time

import numpy as np
import psutil
import pyarrow.parquet
import pytest
from test_bench import mini  # noqa: F401  a fixture
from test_cli import mjx, refused  # noqa: F401  fixtures
from test_transfer import agent, saved  # noqa: F401  fixtures

from mjx_cl import bench, store, workers
from mjx_cl.errors import FileError, UserError

GB = 2**30


@pytest.mark.parametrize("asked, needs, space, want", [
    (None, [GB] * 5, 100 * GB, 4), (None, [GB] * 5, 3 * GB, 3), (None, [3 * GB, GB, GB], 4 * GB, 2), (None, [GB], 100 * GB, 1), (None, [], GB, 1),
    (1, [GB] * 5, GB, 1), (4, [GB] * 5, 100 * GB, 4), (4, [GB], GB, 4)])
def test_as_many_as_cores_and_memory_allow(monkeypatch, asked, needs, space, want):
  monkeypatch.setattr(workers, "cores", lambda: [0, 1, 2, 3])
  assert workers.number(asked, needs, space) == want


@pytest.mark.parametrize("asked, words", [(0, "1..4"), (5, "1..4"), (3, "2 would")])
def test_more_than_fit_are_refused(monkeypatch, asked, words):
  monkeypatch.setattr(workers, "cores", lambda: [0, 1, 2, 3])
  with pytest.raises(UserError, match=words):
    workers.number(asked, [GB] * 5, 2 * GB)


def test_side_by_side_is_as_one_after_the_other(mjx, refused, mini, tmp_path, monkeypatch):  # noqa: F811
  """The same streams live the same lives; a float may differ in the last digits, as a product is added up otherwise on fewer cores."""
  own = workers.cores()
  monkeypatch.setattr(workers, "cores", lambda: own[-1:] * 2)  # two workers, also where there is one core
  assert "1..2" in refused(2, "bench", mini, "--out", tmp_path / "x", "--jobs", "3")
  code, text, err = mjx("bench", mini, "--out", tmp_path / "two", "--jobs", "2", "--json")
  assert code == 0, err
  assert json.loads(text)["finished"] == 3 and "healthy finished, " in err and ", 3 of 3" not in err.split("finished, ")[1]
  assert any(line.startswith("grip/severity=0.5: step 192/192") for line in err.splitlines())  # what a worker says is passed on
  assert mjx("bench", mini, "--out", tmp_path / "one", "--jobs", "1")[0] == 0
  one, two = (pyarrow.parquet.read_table(tmp_path / name / "bench.parquet").to_pydict() for name in ("one", "two"))
  assert one.keys() == two.keys()
  for name, values in one.items():
    if name == "wall_s":
      continue
    if any(isinstance(v, float) for v in values):
      np.testing.assert_allclose(np.array(values, float), np.array(two[name], float), rtol=1e-3, err_msg=name)
    else:
      assert values == two[name], name


def test_one_that_fails_is_named_and_the_others_are_kept(mini, tmp_path):  # noqa: F811
  plan = bench.suite(str(mini))
  bench.write_plan(plan, tmp_path / "out")
  value = json.loads((tmp_path / "out/suite.json").read_text())
  value["parts"]["healthy"]["agent"] = str(tmp_path / "nowhere")
  store.write_json(tmp_path / "out/suite.json", value)
  said, ended = [], []
  with pytest.raises(UserError, match="^part healthy: .*nowhere"):
    workers.together(tmp_path / "out", ["healthy", "grip/severity=0.5"], 1, ended.append, said.append)
  assert ended == []
  workers.together(tmp_path / "out", ["grip/severity=0.5"], 1, ended.append, said.append)
  assert ended == ["grip/severity=0.5"] and bench.finished(tmp_path / "out", plan.parts[0])


def test_a_worker_that_is_killed_is_said(mini, tmp_path):  # noqa: F811
  bench.write_plan(bench.suite(str(mini)), tmp_path)
  worker = workers.Worker(tmp_path, "healthy", 0, [], lambda text: None)
  worker.process.kill()
  worker.process.wait()
  with pytest.raises(FileError, match="healthy was ended by signal 9.*the same command goes on"):
    worker.check()


def test_no_worker_outlives_its_parent(mini, tmp_path):  # noqa: F811
  """The parent is killed outright; its workers save and end, and the same command finishes what they began."""
  two = "import sys; from mjx_cl import cli, workers; own = workers.cores(); workers.cores = lambda: own[-1:] * 2; sys.exit(cli.main(sys.argv[1:]))"
  command = [sys.executable, "-c", two, "bench", str(mini), "--out", str(tmp_path / "out"), "--only", "grip", "--jobs", "2"]
  parent = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
  children, end = [], time.monotonic() + 120
  while not list(pathlib.Path(tmp_path).glob("out/grip/*/config.json")) and parent.poll() is None and time.monotonic() < end:
    time.sleep(0.05)
  children = psutil.Process(parent.pid).children() if parent.poll() is None else []
  parent.kill()
  parent.wait()
  assert children, "the parent ended before its workers began"
  assert not psutil.wait_procs(children, timeout=120)[1]
  assert subprocess.run(command, capture_output=True).returncode == 0
  assert all((tmp_path / "out/grip" / name / "summary.json").exists() for name in ("severity=0.5", "severity=1.0"))
