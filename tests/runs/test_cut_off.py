"""What a full disk or a kill at a bad moment leaves behind can be gone on from."""

import dataclasses
import pathlib
import shutil
import signal
import types
from typing import NamedTuple

import numpy as np
import pytest

from mjx_cl.config import RunConfig
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import checkpoints, folders, tables
from mjx_cl.runs import bench, packing, run, runner, suite
from mjx_cl.training import files

PAPER = pathlib.Path(__file__).parents[2] / "results" / "paper"


def full(*_args, **_more):
  raise OSError(28, "No space left on device")


@pytest.fixture
def life(tmp_path, monkeypatch):
  """life(saves, fails): the checkpoint that a run of nothing goes on from, after it has saved at
  some chunks and failed to at another.
  """
  like = {"x": np.zeros(3, np.float32)}
  monkeypatch.setattr(packing, "pack", lambda lives: (like, []))
  monkeypatch.setattr(packing, "unpack", lambda *_: None)

  class Empty(runner.Runner):
    def __init__(self):
      self.work, self.done_chunks, self.lives = tmp_path, 0, None
      self.seconds, self.stream_seconds = {"other": 0.0}, np.zeros(1)
      self._updates = self._alarms = self._phase = np.zeros(1, int)
      self.checkpoints = checkpoints.Checkpoints(tmp_path / "checkpoints")

    def trace(self):
      return {"reward": np.zeros((self.done_chunks, 1))}

    def _like(self, meta):
      return like

  def live(saves=(), fails=None):
    one = Empty()
    one.resume()
    begun = one.done_chunks
    for one.done_chunks in saves:
      one.save()
    if fails is not None:
      one.done_chunks, one.checkpoints._manager.save = fails, full
      with pytest.raises(FileError, match="the earlier ones are intact"):
        one.save()
    one.checkpoints.close()
    return begun

  return live


def test_a_signal_during_the_last_save_ends_the_run(monkeypatch):
  """Else the next part of a suite would begin."""
  saved = []

  class Short:
    done = False

    def step(self):
      self.done = True

    def save(self):
      saved.append(1)
      if len(saved) == 1:
        signal.raise_signal(signal.SIGINT)

  with pytest.raises(KeyboardInterrupt):
    run.live(Short(), lambda progress: None, save_every_s=0.0)
  assert len(saved) == 2


def test_what_says_that_a_run_is_finished_goes_first(tmp_path, monkeypatch):
  """A kill while an earlier run is removed leaves one that is not finished."""
  tables.write_json(tmp_path / "config.json", {})
  for name in folders.RESULTS:
    (tmp_path / name).write_text("x")
  real, gone = pathlib.Path.unlink, []

  def kill(path, missing_ok=False):
    real(path, missing_ok=missing_ok)
    gone.append(path.name)
    raise KeyboardInterrupt

  monkeypatch.setattr(pathlib.Path, "unlink", kill)
  with pytest.raises(KeyboardInterrupt):
    run.clear(tmp_path)
  assert len(gone) == 1 and folders.claim_folder(tmp_path, True, False) == "resume"


def test_traces_of_saves_that_failed_displace_none(life):
  assert [life([100, 200]), life(fails=300), life(fails=260), life([230])] == [0, 200, 200, 200]
  assert life() == 230


def test_a_training_of_several_seeds_is_done_when_all_agents_are_there(tmp_path, monkeypatch):
  """Cut off while the second seed is evaluated it is not."""

  class Train(NamedTuple):
    params: dict

  tables.write_json(tmp_path / "config.json", {})
  left = [None, KeyboardInterrupt]

  def evaluated(*_):
    if left.pop(0):
      raise KeyboardInterrupt
    return {"return_mean": 1.0}

  monkeypatch.setattr(files.evaluate, "evaluate", evaluated)
  monkeypatch.setattr(files, "_told", lambda trainer: {"seed": 0, "env": "walker"})
  state = types.SimpleNamespace(train=Train({"a": np.zeros((3, 2), np.float32)}))
  config = types.SimpleNamespace(repeat=1)
  trainer = types.SimpleNamespace(
    seeds=3, failed={}, out=tmp_path, env=None, plain=None, config=config, state=state
  )
  with pytest.raises(KeyboardInterrupt):
    files.export(trainer)
  claim = lambda: folders.claim_folder(tmp_path, True, False, done_marker="agent/card.json")
  assert claim() == "resume"
  left[:] = [None] * 3
  files.export(trainer)
  assert claim() == "done" and (tmp_path / "seed-2" / "agent" / "card.json").exists()


def test_a_part_that_was_cut_off_before_its_settings_were_written_is_begun_anew(
  tmp_path, monkeypatch
):
  begun = []

  class Fake:
    def __init__(self, config, out, *_):
      self.out, self.fork = out, lambda: begun.append(out)

    def config_dict(self):
      return {}

    def open(self):
      (self.out / "work" / "checkpoints").mkdir(parents=True, exist_ok=True)

  monkeypatch.setattr(run, "Runner", Fake)
  part = suite.Part("part", run.check(RunConfig("walker")))
  monkeypatch.setattr(bench.run, "execute", lambda config, folder, **how: run._begun(
    config, folder, how["resume"], False, None, None))  # fmt: skip
  monkeypatch.setattr(bench, "collect", lambda *_: {})
  plan = suite.Suite("one", "", (part,))
  again = lambda: bench.execute(plan, tmp_path, [part], {}, lambda _: None, jobs=1)
  with monkeypatch.context() as disk:
    disk.setattr(run.tables, "write_json", full)
    with pytest.raises(OSError, match="No space"):
      again()
  again()
  assert begun == [tmp_path / "part"]


def test_physics_that_is_asked_for_is_no_other(tmp_path):
  """The published walker was lived on C MuJoCo."""
  plan = tables.read_json(PAPER / "suite.json")["parts"]
  native = suite.resolved(plan["walker"])
  asked = lambda physics: suite.Part("walker", dataclasses.replace(native, physics=physics))
  assert suite.finished(PAPER, asked("auto")) and suite.finished(PAPER, asked("native"))
  with pytest.raises(UserError, match="physics"):
    suite.finished(PAPER, asked("mjx"))
  said = []
  assert not bench.offers(tmp_path, [asked("mjx")], [PAPER], said.append)
  assert len(said) == 1 and "physics" in said[0]
  car = suite.resolved(plan["car"])  # of pure JAX, and C MuJoCo after the move
  asked = lambda physics: suite.Part("car", dataclasses.replace(car, physics=physics))
  assert suite.finished(PAPER, asked("native"))
  with pytest.raises(UserError, match="physics"):
    suite.finished(PAPER, asked("mjx"))


def test_a_merge_that_fails_leaves_nothing(tmp_path, monkeypatch):
  plan = tables.read_json(PAPER / "suite.json")["parts"]
  part = suite.Part("walker", suite.resolved(plan["walker"]))
  found = bench.offers(tmp_path, [part], [PAPER], lambda _: None)
  copy, left = shutil.copyfile, [False, False, True]
  monkeypatch.setattr(
    bench.shutil, "copyfile", lambda *of: full() if left.pop(0) else copy(*of)
  )  # fmt: skip
  with pytest.raises(OSError, match="No space"):
    bench.take(tmp_path, [part], found)
  assert not list(tmp_path.glob("*.tmp"))
