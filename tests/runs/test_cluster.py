"""Parts on a Ray cluster of two machines of a core each: what a part by itself gives, whatever is
lost on the way.
"""

import os
import pathlib
import signal
import subprocess
import sys
import threading
import zlib

import psutil
import pytest
from test_suite import MINI, mini  # noqa: F401  a fixture
from test_transfer import agent, saved  # noqa: F401  fixtures

from mjx_cl.errors import FileError, UserError
from mjx_cl.io import folders, tables
from mjx_cl.runs import cluster, workers
from mjx_cl.runs import suite as suites

WORKER = "mjx_cl.cli.worker"
PARTS = ["grip/severity=0.5", "grip/severity=1.0"]


def given(folder, **other):
  suites_text = (folder / "suite.json").read_text()
  known = dict(module=WORKER, out=str(folder), token="", suite=suites_text)
  return cluster.Given(**known, versions=cluster.versions())._replace(**other)


@pytest.fixture(autouse=True)
def released():
  """No process outlives a test."""
  yield
  cluster.release()


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
  assert cluster.folder_of(own) != cluster.folder_of(own._replace(suite="{}"))
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


def test_the_newest_line_of_each_part_is_taken_once():
  board = cluster.Board()
  for name, line in (("a", "step 1"), ("b", "step 5"), ("a", "step 2")):
    board.put(name, line)
  assert board.take() == ["step 2", "step 5"] and board.take() == []


def test_a_part_that_is_to_end_saves(plan, monkeypatch):
  """Without an exception from Ray, which C code may drop."""
  monkeypatch.setattr(cluster, "ASK_S", 0.0)
  out, said = plan("out", steps=3200), []
  (out / cluster.HERE).write_text("7")
  own = given(out, token="7")
  with pytest.raises(KeyboardInterrupt):
    cluster.run_part(PARTS[0], own, said.append, lambda: any("step " in line for line in said))
  assert not processes(out) and list(out.rglob("checkpoints/*"))


STUB = """import json, os, pathlib, sys, zlib
out = pathlib.Path(sys.argv[1])
size = json.loads((out / "suite.json").read_text())["size"]
for name in map(str.strip, iter(sys.stdin.readline, "")):
  folder, block = out / name, os.urandom(size)
  folder.mkdir(parents=True, exist_ok=True)
  (folder / "block").write_bytes(block)
  seen = {k: os.environ.get(k) for k in ("CUDA_VISIBLE_DEVICES", "JAX_PLATFORMS")}
  print(name, "pid", os.getpid(), file=sys.stderr, flush=True)
  (folder / "seen.json").write_text(json.dumps(seen | {"crc32": zlib.crc32(block)}))
  print("finished", name, flush=True)"""


def test_the_process_of_a_part_runs_the_next_of_its_suite(tmp_path):
  """And one of another suite is another's; where it was killed there is a new one."""
  (tmp_path / "stub.py").write_text(STUB)
  pids = []

  def run(name, out):
    folders.make(out)
    tables.write_json(out / "suite.json", {"size": 1})
    own = given(out, module="stub", token="7", begun=str(tmp_path))
    (out / cluster.HERE).write_text("7")
    said = []
    told = cluster.run_part(name, own, said.append)
    assert told.code == 0 and said[-1].startswith(f"{name}: {name} pid ")
    pids.append(int(said[-1].split()[-1]))

  one, two = tmp_path / "one", tmp_path / "two"
  try:
    run("a", one)
    run("b", one)
    os.kill(pids[-1], signal.SIGKILL)
    psutil.wait_procs([psutil.Process(pids[-1])], timeout=60)
    run("c", one)
    run("a", two)
  finally:
    cluster.release()
  assert pids[0] == pids[1] and len(set(pids)) == 3


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
def build(monkeypatch, tmp_path):
  """build(*own, **all): (cluster, nodes) of machines with a core each and what else is said of them,
  whose processes find modules in tmp_path.
  """
  pytest.importorskip("ray", reason="the extra [ray] is not installed")
  from ray.cluster_utils import Cluster

  monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
  paths = (pathlib.Path(cluster.__file__).parents[2], tmp_path)
  monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(str, paths)))
  made = Cluster()

  def start(*own, **every):
    # the driver's, which runs no part
    made.add_node(num_cpus=0, include_dashboard=False, **every)
    nodes = [made.add_node(num_cpus=1, **more, **every) for more in own]
    made.wait_for_nodes()
    return made, nodes

  yield start
  made.shutdown()


@pytest.fixture
def machines(build):
  """(cluster, nodes) of two machines."""
  return build({}, {})


@pytest.fixture(scope="module")
def whole(saved, tmp_path_factory):  # noqa: F811
  """PARTS of 50 chunks, lived here one after the other."""
  folder = tmp_path_factory.mktemp("whole")
  text = MINI.replace("AGENT", str(saved)).replace("steps = 192", "steps = 3200")
  (folder / "mini.toml").write_text(text)
  suites.write_plan(suites.suite(str(folder / "mini.toml")), folder)
  return alone(folder)


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


def processes(out):
  """Those that run parts of the suite in this folder."""
  found = []
  for process in psutil.process_iter(["cmdline"]):
    if {WORKER, str(out.resolve())} <= set(process.info["cmdline"] or []):
      found.append(process)
  return found


def ended(out):
  """Whether all of them end."""
  psutil.wait_procs(processes(out), timeout=600)
  return not processes(out)


def test_a_cluster_gives_what_one_machine_gives(plan, machines):
  one, two = alone(plan("one")), plan("two")
  assert sorted(together(machines, two)) == PARTS
  assert same(one, two) and not (two / cluster.HERE).exists() and ended(two)


@pytest.mark.parametrize("lost", ["process", "machine"])
def test_what_is_lost_begins_again(plan, whole, machines, lost):
  two, gone = plan("two", steps=3200), []

  def tell(text):
    if gone or "step " not in text:
      return
    gone.append(text)
    if lost == "process":
      processes(two)[0].kill()
    else:
      threading.Thread(target=machines[0].remove_node, args=(machines[1][0],)).start()

  assert sorted(together(machines, two, tell)) == PARTS and gone
  assert same(whole, two) and ended(two)


def test_an_interrupt_leaves_nothing_running_and_the_same_command_goes_on(plan, whole, machines):
  def tell(text):
    if "step " in text:
      os.kill(os.getpid(), signal.SIGINT)

  for name in ("two", "three", "four"):  # where it is heard late both parts may be at their end
    two = plan(name, steps=3200)
    with pytest.raises(KeyboardInterrupt):
      together(machines, two, tell)
    assert not processes(two)
    if list(two.rglob("checkpoints/*")):
      break
  else:
    pytest.fail("no part was saved in three tries")
  assert sorted(together(machines, two)) == PARTS and same(whole, two)


DRIVER = """import sys
from mjx_cl.runs import cluster
out, address, *names = sys.argv[1:]
tell = lambda text: print(text, flush=True)
needs = dict.fromkeys(names, 2**20)
on = cluster.Cluster(address)
cluster.together("mjx_cl.cli.worker", out, names, needs, print, tell, on)"""


def test_a_driver_that_is_killed_leaves_nothing_running_and_the_next_goes_on(plan, whole, machines):
  two = plan("two", steps=3200)
  command = [sys.executable, "-c", DRIVER, str(two), machines[0].address, *PARTS]
  with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as driver:
    assert any("step " in line for line in driver.stdout)
    driver.kill()
  assert ended(two) and list(two.glob("grip/*/config.json"))
  assert sorted(together(machines, two)) == PARTS and same(whole, two)
  assert not (two / cluster.HERE).exists()


def test_a_cluster_of_other_versions_is_refused(plan, machines, monkeypatch):
  own = cluster.versions()
  monkeypatch.setattr(cluster, "versions", lambda: own | {"jax": "0.0.1"})
  with pytest.raises(UserError, match=r"has jax .* in place of 0\.0\.1; install the driver's"):
    together(machines, plan("out"))


@pytest.fixture
def seen(tmp_path):
  """seen(machines, gpu, size): what the processes of two parts have seen, which wrote `size` bytes
  each.
  """
  (tmp_path / "stub.py").write_text(STUB)

  def run(made, gpu=False, size=1):
    out, names = tmp_path / "out", ["a", "b"]
    folders.make(out)
    tables.write_json(out / "suite.json", {"size": size})
    on, none = cluster.Cluster(made.address, gpu), lambda *_: None
    cluster.together("stub", out, names, dict.fromkeys(names, 1), none, none, on, none)
    told = [tables.read_json(out / name / "seen.json") for name in names]
    for name, one in zip(names, told):
      assert zlib.crc32((out / name / "block").read_bytes()) == one.pop("crc32")
    return [tuple(one.values()) for one in told]

  return run


def test_a_part_has_the_gpu_that_was_asked_for_and_no_other(build, seen, monkeypatch):
  monkeypatch.delenv("JAX_PLATFORMS", raising=False)
  made, nodes = build({"num_gpus": 1}, {})
  assert seen(made, gpu=True) == [("0", "cuda,cpu")] * 2
  assert [platforms for _, platforms in seen(made)] == ["cpu"] * 2
  made.remove_node(nodes[0])
  with pytest.raises(UserError, match="no machine of the cluster has a core, a GPU and"):
    seen(made, gpu=True)


def test_results_beyond_the_object_store_arrive(build, seen, monkeypatch):
  """Parts of 160 MB each by way of the smallest store that Ray takes."""
  monkeypatch.setattr(cluster, "HERE", ".elsewhere")
  made, _ = build({}, {}, object_store_memory=75 * 2**20)
  assert len(seen(made, size=160 * 10**6)) == 2


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
