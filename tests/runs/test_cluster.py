"""Parts on a Ray cluster of two machines of a core each: what a part by itself gives, whatever is
lost on the way.
"""

import os
import pathlib
import signal
import subprocess
import sys
import threading

import psutil
import pytest
from test_suite import mini  # noqa: F401  a fixture
from test_transfer import agent, saved  # noqa: F401  fixtures

from mjx_cl.errors import FileError, UserError
from mjx_cl.io import tables
from mjx_cl.runs import cluster, workers
from mjx_cl.runs import suite as suites

WORKER = "mjx_cl.cli.worker"
PARTS = ["grip/severity=0.5", "grip/severity=1.0"]


def given(folder, **other):
  suites_text = (folder / "suite.json").read_text()
  known = dict(module=WORKER, out=str(folder), token="", suite=suites_text)
  return cluster.Given(**known, versions=cluster.versions())._replace(**other)


@pytest.fixture
def plan(mini, tmp_path):  # noqa: F811
  """Folder of a suite that is to be run."""

  def write(name, steps=192):
    mini.write_text(mini.read_text().replace("steps = 192", f"steps = {steps}"))
    suites.write_plan(suites.suite(str(mini)), tmp_path / name)
    return tmp_path / name

  return write


def same(one, two):
  """Whether two suites' folders hold the same results."""
  for part in PARTS:
    for name in ("trace", "events", "runs"):
      a, b = (tables.read_arrow(out / part / f"{name}.parquet") for out in (one, two))
      if name == "runs":
        a, b = (table.drop_columns("wall_s") for table in (a, b))
      if not a.equals(b):
        return False
  return True


# ---- one machine's side --------------------------------------------------------------------------


def test_a_machine_with_other_versions_runs_nothing(plan):
  out = plan("out")
  told = cluster.run_part("healthy", given(out, versions={"jax": "0.0.1"}), print)
  assert told.code is None and not (out / "healthy").exists()
  wrong = cluster._failure(told)
  assert "in place of 0.0.1" in str(wrong) and "\n" not in str(wrong)


def test_a_part_comes_back_as_bytes_where_no_disk_is_shared(plan, tmp_path, monkeypatch):
  monkeypatch.setattr(cluster.tempfile, "gettempdir", lambda: str(tmp_path / "node"))
  (tmp_path / "node").mkdir()
  there, here = plan("there"), plan("here")
  own = given(there, out=str(tmp_path / "driver"), token="1")
  told = cluster.run_part("healthy", own, lambda line: None)
  assert told.code == 0 and not (there / "healthy").exists()
  cluster.place(here, "healthy", told.files)
  (plan_,) = [p for p in suites.suite(str(tmp_path / "mini.toml")).parts if p.name == "healthy"]
  assert suites.finished(here, plan_) and not list(here.glob("*.tmp"))
  again = cluster.run_part("healthy", own, lambda line: None)
  assert {k for k in again.files} == {k for k in told.files}  # finished there: not run again
  broken = told.files | {"runs.parquet": told.files["runs.parquet"][:-9]}
  for files, words in ((broken, "run it again"), ({"../x": b""}, "leads out")):
    with pytest.raises(FileError, match=words):
      cluster.place(here, "healthy", files)
  assert suites.finished(here, plan_) and not (here / "x").exists()


def test_what_a_part_says_last_is_why_it_failed(plan):
  out = plan("out")
  value = tables.read_json(out / "suite.json")
  value["parts"]["healthy"]["agent"] = str(out / "nowhere")
  tables.write_json(out / "suite.json", value)
  (out / cluster.HERE).write_text("7")
  told = cluster.run_part("healthy", given(out, token="7"), lambda line: None)
  wrong = cluster._failure(told)
  assert type(wrong) is UserError and "part healthy: no agent" in str(wrong)


TAKES = """import sys
from mjx_cl.io import runtime
from mjx_cl.runs import cluster
runtime.cores = lambda: [0, 1]
with cluster.own_core() as mine:
  print(*mine, flush=True)
  sys.stdin.read()"""


def test_parts_of_a_machine_have_cores_of_their_own(tmp_path):
  """A part beyond the cores has all of them, and a core is free again when its part has gone."""
  take = lambda: subprocess.Popen(
    [sys.executable, "-c", TAKES],
    stdin=subprocess.PIPE,
    stdout=subprocess.PIPE,
    text=True,
    env=os.environ | {"TMPDIR": str(tmp_path)},
  )
  held = []
  for want in ("0", "1", "0 1"):
    held.append(take())
    assert held[-1].stdout.readline().strip() == want
  held[0].kill()
  held[0].wait()
  held.append(take())
  assert held[-1].stdout.readline().strip() == "0"
  for process in held[1:]:
    process.communicate()


# ---- a cluster -----------------------------------------------------------------------------------


@pytest.fixture
def machines(monkeypatch):
  """(address, nodes) of a cluster of two machines."""
  pytest.importorskip("ray", reason="the extra [ray] is not installed")
  from ray.cluster_utils import Cluster

  monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
  monkeypatch.setenv("PYTHONPATH", str(pathlib.Path(cluster.__file__).parents[2]))
  made = Cluster()
  made.add_node(num_cpus=0, include_dashboard=False)  # the driver's, which runs no part
  nodes = [made.add_node(num_cpus=1) for _ in range(2)]
  made.wait_for_nodes()
  yield made, nodes
  made.shutdown()


def together(machines, out, tell=lambda text: None):
  """Runs PARTS on the cluster: names of those that ended."""
  ended = []
  needs = dict.fromkeys(PARTS, 2**20)
  cluster.together(
    WORKER, out, PARTS, needs, ended.append, tell, cluster.Cluster(machines[0].address)
  )
  return ended


def alone(out):
  """Runs PARTS here, one after the other."""
  workers.together(WORKER, out, PARTS, 1, lambda name: None)
  return out


def processes():
  """Those that run parts."""
  found = []
  for process in psutil.process_iter(["cmdline"]):
    if WORKER in (process.info["cmdline"] or []):
      found.append(process)
  return found


def test_a_cluster_gives_what_one_machine_gives(plan, machines):
  one, two = alone(plan("one")), plan("two")
  assert sorted(together(machines, two)) == PARTS
  assert same(one, two) and not (two / cluster.HERE).exists() and not processes()


@pytest.mark.parametrize("lost", ["process", "machine"])
def test_what_is_lost_begins_again(plan, machines, lost):
  one, two = alone(plan("one", steps=3200)), plan("two", steps=3200)
  gone = []

  def tell(text):
    if gone or "step " not in text:
      return
    gone.append(text)
    if lost == "process":
      processes()[0].kill()
    else:
      threading.Thread(target=machines[0].remove_node, args=(machines[1][0],)).start()

  assert sorted(together(machines, two, tell)) == PARTS and gone
  assert same(one, two) and not processes()


def test_an_interrupt_leaves_nothing_running_and_the_same_command_goes_on(plan, machines):
  one, two = alone(plan("one", steps=3200)), plan("two", steps=3200)

  def tell(text):
    if "step " in text:
      os.kill(os.getpid(), signal.SIGINT)

  with pytest.raises(KeyboardInterrupt):
    together(machines, two, tell)
  psutil.wait_procs(processes(), timeout=600)
  assert not processes()
  assert sorted(together(machines, two)) == PARTS and same(one, two)


def test_no_cluster_and_too_large_a_part_are_one_line(plan, machines):
  out = plan("out")
  run = lambda needs, address: cluster.together(
    WORKER, out, PARTS, dict.fromkeys(PARTS, needs), print, on=cluster.Cluster(address)
  )
  with pytest.raises(UserError, match="no machine of the cluster has a core and 1048576.0 GiB"):
    run(2**50, machines[0].address)
  for address, words in (("127.0.0.1:1", "no Ray cluster answers"), ("here", "HOST:PORT")):
    with pytest.raises(UserError, match=words):
      run(1, address)
