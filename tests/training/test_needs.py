"""Memory that is stated: bytes against what is really allocated, and what would not fit is refused
with the number that would.
"""

import re

import jax
import pytest

from mjx_cl.config import PRESETS, RunConfig, TrainConfig
from mjx_cl.dreamer import replay
from mjx_cl.dreamer.agent import Agent
from mjx_cl.errors import UserError
from mjx_cl.io import memory, runtime
from mjx_cl.training import needs

OBS, ACT = 24, 6


@pytest.fixture(autouse=True)
def small(monkeypatch):
  monkeypatch.setattr(memory, "held", lambda: 0)


def bytes_of(tree):
  return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def test_need_is_what_is_allocated():
  dreamer = PRESETS["tiny"].dreamer
  agent, size = Agent(dreamer, OBS, ACT), Agent(dreamer, OBS, ACT).size
  need = needs.need("tiny", OBS, ACT, 4 * 100, dreamer.bins)
  empty = jax.eval_shape(lambda: replay.init(4, 100, OBS, ACT, size.deter, size.stoch))
  assert need.record == bytes_of(empty.data) // 400 and need.replay == bytes_of(empty.data)
  state = jax.eval_shape(agent.init, jax.random.key(0))
  counters = bytes_of(state) - need.weights
  assert 0 < counters < 64  # update counters and the return range
  assert need.total(3) == 3 * (need.replay + need.weights) + need.weights


def test_the_number_that_is_named_fits_and_the_next_does_not(monkeypatch):
  monkeypatch.setattr(memory, "free", lambda: int((memory.PROCESS + 200 * 2**20) / memory.MARGIN))
  ask = lambda capacity: needs.check(
    "size1m", OBS, ACT, 8 * capacity, 3, ("capacity", lambda n: 8 * n)
  )
  with pytest.raises(
    UserError,
    match="3 seeds of size1m with 8,000,000 records each need 42.3 GiB a device, 1.9 GiB may be used",
  ) as e:
    ask(1_000_000)
  fits = int(re.search(r"capacity=([\d,]+) would fit", str(e.value))[1].replace(",", ""))
  ask(fits)
  with pytest.raises(UserError):
    ask(fits + 1)
  assert ask(fits).replay == 8 * fits * needs.need("size1m", OBS, ACT, 1).record


def test_weights_that_do_not_fit_are_said_so(monkeypatch):
  monkeypatch.setattr(memory, "free", lambda: 2**20)
  with pytest.raises(UserError, match="not even capacity=1 fits"):
    needs.check("size12m", OBS, ACT, 10, 1, ("capacity", lambda n: n))


def test_an_accelerator_holds_weights_and_replays_alone(monkeypatch):
  assert memory.resident(2**30) == memory.PROCESS + int(memory.GROWTH * 2**30)
  monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
  assert memory.resident(2**30) == 2**30
  assert runtime.seeds_by() == "vmap"
  need = needs.need("size1m", OBS, ACT, 1000)
  for short in (0, 2):  # all seeds are at work at once: twice the weights of each
    monkeypatch.setattr(
      memory,
      "free",
      lambda: int((3 * (2 * need.weights + need.replay) - short) / memory.MARGIN) + 1,
    )
    ask = lambda: needs.check("size1m", OBS, ACT, 1000, 3, ("capacity", lambda n: n))
    if short:
      with pytest.raises(UserError):
        ask()
    else:
      ask()
  monkeypatch.setattr(memory, "free", lambda: 200 * 2**20)
  with pytest.raises(UserError) as e:
    needs.check("size1m", OBS, ACT, 10**7, 3, ("capacity", lambda n: n))
  fits = int(re.search(r"capacity=([\d,]+) would fit", str(e.value))[1].replace(",", ""))
  needs.check("size1m", OBS, ACT, fits, 3, ("capacity", lambda n: n))
  with pytest.raises(UserError):
    needs.check("size1m", OBS, ACT, fits + 1, 3, ("capacity", lambda n: n))


def test_devices_share_the_seeds(monkeypatch):
  need = needs.need("size1m", OBS, ACT, 1000)
  monkeypatch.setattr(
    memory, "free", lambda: int(memory.resident(need.total(2)) / memory.MARGIN) + 2
  )
  needs.check("size1m", OBS, ACT, 1000, 4, ("capacity", lambda n: n), shards=2)
  with pytest.raises(UserError):
    needs.check("size1m", OBS, ACT, 1000, 4, ("capacity", lambda n: n))


def test_trainer_and_runner_refuse_before_they_allocate(monkeypatch, short_walker, tmp_path):
  from mjx_cl.runs import run
  from mjx_cl.training import trainer

  monkeypatch.setattr(memory, "free", lambda: int((memory.PROCESS + 10 * 2**20) / memory.MARGIN))
  with pytest.raises(UserError, match="capacity=[0-9,]+ would fit"):
    trainer.Trainer(short_walker, PRESETS["tiny"].dreamer, TrainConfig(capacity=10**7), tmp_path)
  with pytest.raises(UserError, match="a smaller size would|would fit|need less"):
    run.Runner(RunConfig(env="walker"), tmp_path)
  assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("need, measured", [(0.80, 2.66), (0.82, 2.47), (1.63, 3.58)])
def test_a_process_takes_more_than_its_replays(need, measured):
  """Never less than what was seen [GiB]."""
  assert measured * 2**30 <= memory.resident(int(need * 2**30)) <= 1.6 * measured * 2**30


GIB = 2**30
V2 = {
  "memory.max": 8 * GIB,
  "memory.current": 5 * GIB,
  "memory.stat": f"anon {GIB}\nfile {4 * GIB}\nactive_file {GIB}\ninactive_file {3 * GIB}\n",
}
V1 = {
  "memory.limit_in_bytes": 8 * GIB,
  "memory.usage_in_bytes": 5 * GIB,
  "memory.stat": f"inactive_file {GIB}\ntotal_inactive_file {3 * GIB}\n",
}


@pytest.mark.parametrize(
  "mount, path, sign, files, left",
  [
    ("", "", "0::/", V2, 6 * GIB),
    ("memory", "", "9:memory:/", V1, 6 * GIB),
    ("", "job/7", "0::/job/7", V2, 6 * GIB),
    ("memory", "job/7", "4:memory:/job/7", V1, 6 * GIB),
    ("", "", "0::/elsewhere", V2, 6 * GIB),  # as a container without a namespace of its own sees it
    ("", "", "0::/", V2 | {"memory.max": "max"}, None),
    ("memory", "", "9:memory:/", V1 | {"memory.limit_in_bytes": 9223372036854771712}, None),
    ("", "", "0::/", V2 | {"memory.stat": ""}, 3 * GIB),
    ("memory", "", "9:memory:/", V1 | {"memory.stat": f"inactive_file {GIB}\n"}, 4 * GIB),
    ("", "", "0::/", V2 | {"memory.current": 9 * GIB, "memory.stat": ""}, 0),
    ("", "", "0::/", {"memory.max": "garbage", "memory.current": ""}, None),
    ("", "", "", {}, None),
    ("", "", "", V2, 6 * GIB),
  ],
)
def test_a_containers_limit(tmp_path, mount, path, sign, files, left):
  """Limit less what is used, the page cache that can be reclaimed apart."""
  folder = tmp_path / "cgroup" / mount / path
  folder.mkdir(parents=True)
  for name, value in files.items():
    (folder / name).write_text(f"{value}\n")
  (tmp_path / "self").write_text(f"3:cpu,cpuacct:/x\n{sign}\n" if sign else "")
  assert memory.container(tmp_path / "cgroup", tmp_path / "self") == left


def test_a_limit_around_the_group_binds_too(tmp_path):
  for folder, limit in ((tmp_path / "job", 4 * GIB), (tmp_path / "job/7", 8 * GIB)):
    folder.mkdir()
    for name, value in (V2 | {"memory.max": limit}).items():
      (folder / name).write_text(str(value))
  (tmp_path / "self").write_text("0::/job/7\n")
  assert memory.container(tmp_path, tmp_path / "self") == 2 * GIB


def test_what_is_free_is_the_less_of_machine_and_container(monkeypatch):
  import psutil

  monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": 10 * GIB}))
  for limited, least in ((None, 10), (3 * GIB, 3), (20 * GIB, 10)):
    monkeypatch.setattr(memory, "container", lambda: limited)
    assert memory.free() == least * GIB


def test_what_is_held_already_need_not_be_free(monkeypatch):
  need = memory.resident(needs.need("size1m", OBS, ACT, 1000).total(1))
  ask = lambda: needs.check("size1m", OBS, ACT, 1000, 1, ("capacity", lambda n: n))
  monkeypatch.setattr(memory, "free", lambda: int(0.5 * need / memory.MARGIN))
  with pytest.raises(UserError):
    ask()
  monkeypatch.setattr(memory, "held", lambda: need // 2 + 2)
  ask()
  monkeypatch.undo()
  assert 50 * 2**20 < memory.held() < 2**40


def test_table_has_every_size():
  table = needs.table()
  assert (
    list(table) == list(needs.SIZES)
    and "640,867 parameters" in table["size1m"]
    and "1,208 bytes a record" in table["size1m"]
  )
