"""Memory that is stated: bytes against what is really allocated, and what would not fit is refused with the number that would."""
import re

import jax
import pytest

from mjx_cl import memory, replay
from mjx_cl.config import PRESETS, RunConfig, TrainConfig
from mjx_cl.dreamer.agent import Agent
from mjx_cl.errors import UserError

OBS, ACT = 24, 6


@pytest.fixture(autouse=True)
def small(monkeypatch):
  monkeypatch.setattr(memory, "held", lambda: 0)


def bytes_of(tree):
  return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def test_need_is_what_is_allocated():
  dreamer = PRESETS["tiny"].dreamer
  agent, size = Agent(dreamer, OBS, ACT), Agent(dreamer, OBS, ACT).size
  need = memory.need("tiny", OBS, ACT, 4 * 100, dreamer.bins)
  empty = jax.eval_shape(lambda: replay.init(4, 100, OBS, ACT, size.deter, size.stoch))
  assert need.record == bytes_of(empty.data) // 400 and need.replay == bytes_of(empty.data)
  state = jax.eval_shape(agent.init, jax.random.key(0))
  counters = bytes_of(state) - need.weights
  assert 0 < counters < 64  # update counters and the return range
  assert need.total(3) == 3 * (need.replay + need.weights) + need.weights


def test_the_number_that_is_named_fits_and_the_next_does_not(monkeypatch):
  monkeypatch.setattr(memory, "free", lambda: int((memory.PROCESS + 200 * 2**20) / memory.MARGIN))
  ask = lambda capacity: memory.check("size1m", OBS, ACT, 8 * capacity, 3, ("capacity", lambda n: 8 * n))
  with pytest.raises(UserError, match="3 seeds of size1m with 8,000,000 records each need 42.3 GiB a device, 1.9 GiB may be used") as e:
    ask(1_000_000)
  fits = int(re.search(r"capacity=([\d,]+) would fit", str(e.value))[1].replace(",", ""))
  ask(fits)
  with pytest.raises(UserError):
    ask(fits + 1)
  assert ask(fits).replay == 8 * fits * memory.need("size1m", OBS, ACT, 1).record


def test_weights_that_do_not_fit_are_said_so(monkeypatch):
  monkeypatch.setattr(memory, "free", lambda: 2**20)
  with pytest.raises(UserError, match="not even capacity=1 fits"):
    memory.check("size12m", OBS, ACT, 10, 1, ("capacity", lambda n: n))


def test_an_accelerator_holds_weights_and_replays_alone(monkeypatch):
  assert memory.resident(2**30) == memory.PROCESS + int(memory.GROWTH * 2**30)
  monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
  assert memory.resident(2**30) == 2**30
  monkeypatch.setattr(memory, "free", lambda: 200 * 2**20)
  with pytest.raises(UserError) as e:
    memory.check("size1m", OBS, ACT, 10**7, 3, ("capacity", lambda n: n))
  fits = int(re.search(r"capacity=([\d,]+) would fit", str(e.value))[1].replace(",", ""))
  memory.check("size1m", OBS, ACT, fits, 3, ("capacity", lambda n: n))
  with pytest.raises(UserError):
    memory.check("size1m", OBS, ACT, fits + 1, 3, ("capacity", lambda n: n))


def test_devices_share_the_seeds(monkeypatch):
  need = memory.need("size1m", OBS, ACT, 1000)
  monkeypatch.setattr(memory, "free", lambda: int(memory.resident(need.total(2)) / memory.MARGIN) + 2)
  memory.check("size1m", OBS, ACT, 1000, 4, ("capacity", lambda n: n), shards=2)
  with pytest.raises(UserError):
    memory.check("size1m", OBS, ACT, 1000, 4, ("capacity", lambda n: n))


def test_trainer_and_runner_refuse_before_they_allocate(monkeypatch, short_walker, tmp_path):
  from mjx_cl import run, train
  monkeypatch.setattr(memory, "free", lambda: int((memory.PROCESS + 10 * 2**20) / memory.MARGIN))
  with pytest.raises(UserError, match="capacity=[0-9,]+ would fit"):
    train.Trainer(short_walker, PRESETS["tiny"].dreamer, TrainConfig(capacity=10**7), tmp_path)
  with pytest.raises(UserError, match="a smaller size would|would fit"):
    run.Runner(RunConfig(env="walker"), tmp_path)
  assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("need, measured", [(0.80, 2.66), (0.82, 2.47), (1.63, 3.58)])
def test_a_process_takes_more_than_its_replays(need, measured):
  """Never less than what was seen [GiB]."""
  assert measured * 2**30 <= memory.resident(int(need * 2**30)) <= 1.6 * measured * 2**30


def test_what_is_held_already_need_not_be_free(monkeypatch):
  need = memory.resident(memory.need("size1m", OBS, ACT, 1000).total(1))
  ask = lambda: memory.check("size1m", OBS, ACT, 1000, 1, ("capacity", lambda n: n))
  monkeypatch.setattr(memory, "free", lambda: int(0.5 * need / memory.MARGIN))
  with pytest.raises(UserError):
    ask()
  monkeypatch.setattr(memory, "held", lambda: need // 2 + 2)
  ask()
  monkeypatch.undo()
  assert 50 * 2**20 < memory.held() < 2**40


def test_table_has_every_size():
  table = memory.table()
  assert list(table) == list(memory.SIZES) and "640,867 parameters" in table["size1m"] and "1,208 bytes a record" in table["size1m"]
