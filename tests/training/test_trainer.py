"""Pretraining: exact resume, the train ratio, phases with a demonstrator, checkpoints that survive
kills and refuse damage.
"""

import copy
import dataclasses
import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet
import pytest

from mjx_cl import envs
from mjx_cl.cli import app
from mjx_cl.config import PRESETS, TrainConfig, replace
from mjx_cl.dreamer import replay as replay_lib
from mjx_cl.dreamer.agent import CAUSES
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import checkpoints, interrupt
from mjx_cl.training import agents, demonstrator, files, premises
from mjx_cl.training import trainer as train

ENVS, BATCH, LENGTH = 4, 4, 8
DREAMER = replace(PRESETS["tiny"].dreamer, batch=BATCH, length=LENGTH, imagine=4)
PER_CHUNK = train.CHUNK * ENVS / (BATCH * LENGTH)  # updates of a chunk at train ratio 1: 8
_collect, _learn = {}, {}


def make_trainer(env, out, dreamer=DREAMER, **config):
  """A small Trainer; those of one kind share their compiled rollout and updates."""
  trainer = train.Trainer(
    env,
    dreamer,
    TrainConfig(**dict(dict(envs=ENVS, updates=10_000, ratio=1.0, capacity=256), **config)),
    out,
  )
  key = (id(env), bool(trainer.expert), trainer.config.demo_noise)
  trainer.collect = _collect.setdefault(key, trainer.collect)
  trainer.learn = _learn.setdefault(
    (dreamer, bool(trainer.expert), trainer.config.clone_std), trainer.learn
  )
  return trainer


class Counted:
  """Stands for the learner: only counts, and keeps what it was called with."""

  def __init__(self, metric=0.0):
    self.calls, self.metric = [], metric

  def __call__(self, state, replay, key, weights, active, updates):
    self.calls.append((updates, weights))
    bad = CAUSES.index("loss/rew") if np.isnan(self.metric) else -1
    return (
      state._replace(updates=state.updates + updates),
      replay,
      {"loss/rew": np.full(1, self.metric)},
      np.full(1, bad),
    )


def counted(trainer, **kwargs):
  learn = Counted(**kwargs)
  trainer.learn = {k: learn for k in trainer.learn}
  return learn


@pytest.fixture(scope="module")
def expert_path(tmp_path_factory):
  """A demonstrator of random weights."""
  rng = np.random.default_rng(0)
  layer = lambda a, b: (
    rng.standard_normal((a, b)).astype(np.float32) / np.sqrt(a),
    np.zeros(b, np.float32),
  )
  path = tmp_path_factory.mktemp("demo") / "policy.npz"
  demonstrator.save(
    path,
    demonstrator.Policy(
      np.zeros(24, np.float32), np.ones(24, np.float32), (layer(24, 8), layer(8, 12))
    ),
  )
  return str(path)


@pytest.mark.slow
def test_an_update_refreshes_the_latents_that_it_was_taken_on(short_walker, tmp_path):
  """Stored latents are put to nought: after updates the sampled windows hold new ones, other
  records none.
  """
  trainer = make_trainer(short_walker, tmp_path, ratio=0.25)
  while not trainer.updates:
    trainer.step()
  data = trainer.state.replay.data
  blank = data._replace(deter=jnp.zeros_like(data.deter), stoch=jnp.zeros_like(data.stoch))
  state = trainer.state
  updates = trainer.updates
  _, replay, _, _ = trainer.learn["pure"](
    *jax.tree.map(jnp.copy, (state.train, state.replay._replace(data=blank))),
    jax.random.key(5),
    trainer._weights(),
    np.ones(1, bool),
    updates,
  )
  fresh = np.asarray(replay.data.deter)[0].any(-1)
  assert LENGTH < fresh.sum() <= updates * BATCH * LENGTH and not fresh.all()


# ---- resume --------------------------------------------------------------------------------------


def test_resume_gives_the_same_bits(short_walker, tmp_path, same):
  whole = make_trainer(short_walker, tmp_path / "whole", ratio=0.25)
  for _ in range(4):
    whole.step()
  programs = lambda: {name: learn._cache_size() for name, learn in whole.learn.items()}
  known = programs()
  first = make_trainer(short_walker, tmp_path / "parts", ratio=0.25)
  first.learn = whole.learn
  for _ in range(2):
    first.step()
  first.save()
  second = make_trainer(short_walker, tmp_path / "parts", ratio=0.25)
  second.learn = whole.learn
  assert not same(second.state, first.state)
  second.resume()
  assert same(second.state, first.state) and second.updates == 4 == 2 * PER_CHUNK * 0.25
  for _ in range(2):
    second.step()
  assert same(second.state, whole.state)  # parameters, moments, robots, replay and key
  assert programs() == known  # a training that goes on compiles nothing anew
  assert second.updates == whole.updates == 8
  np.testing.assert_array_equal(second.returns.sums, whole.returns.sums)
  assert (second.phase, second.owed, second.own) == (
    whole.phase,
    whole.owed,
    whole.own,
  ) and whole.own
  timeless = lambda rows: [
    {k: v for k, v in row.items() if not k.endswith(("_s", "seconds")) and v is not None}
    for row in rows
  ]
  assert timeless(second.rows) == timeless(whole.rows)


@pytest.mark.slow
def test_randomised_faults_are_drawn_anew_with_each_episode(short_walker, tmp_path, same):
  """Targets and severities of 40 robots whose episodes last 12 of 64 steps: new ones each chunk,
  uniform below the given severity; the same after resume.
  """
  make = lambda: train.Trainer(
    short_walker,
    DREAMER,
    TrainConfig(envs=40, updates=10_000, ratio=0.001, capacity=256, fault="gear", severity=0.5),
    tmp_path,
  )
  trainer, drawn = make(), []
  severity = lambda t: np.asarray(t.state.streams.injection.plan.severity)[0, :, 0]
  for k in range(3):
    drawn.append(severity(trainer))
    trainer.step()
    if k == 1:
      trainer.save()
  drawn = np.array(drawn)
  assert drawn.min() >= 0 and drawn.max() <= 0.5 and (np.diff(drawn, axis=0) != 0).all()
  # 120 draws of a uniform: mean 0.25, its error 0.013; the largest of them below 0.45 with
  # probability 0.9^120 = 3e-6
  assert abs(drawn.mean() - 0.25) < 0.05 and drawn.max() > 0.45
  assert set(np.asarray(trainer.state.streams.injection.target)[0, :, 0]) == set(
    range(6)
  )  # (5 / 6)^40 = 7e-4 to miss a given joint
  ended = np.zeros((1, 40), bool)
  ended[0, 3] = True
  later = trainer.state.streams._replace(
    t=trainer.state.streams.t + 1
  )  # what is drawn follows from the clock
  some = trainer._redraw(later, ended)
  kept = np.arange(40) != 3
  assert (
    severity(trainer)[kept] == np.asarray(some.injection.plan.severity)[0, kept, 0]
  ).all() and severity(trainer)[3] != some.injection.plan.severity[0, 3, 0]
  again = make()
  again.collect, again.learn = trainer.collect, trainer.learn
  again.resume()
  again.step()
  assert same(again.state, trainer.state)
  with pytest.raises(UserError, match="unknown fault 'geer'"):
    train.Trainer(short_walker, DREAMER, TrainConfig(fault="geer"), tmp_path)


def test_a_new_draw_keeps_what_a_fault_remembers(short_walker, tmp_path, same):
  """The chunk may have lived part of the next episode, whose start alone fills a memory."""
  config = TrainConfig(envs=40, fault="stuck+command_delay", severity=0.5)
  trainer = train.Trainer(short_walker, DREAMER, config, tmp_path)
  streams = trainer.state.streams
  full = lambda state: state._replace(memory=jax.tree.map(lambda x: x + 1, state.memory))
  injection = streams.injection._replace(states=tuple(map(full, streams.injection.states)))
  streams = streams._replace(injection=injection, t=streams.t + 1)
  new = trainer._redraw(streams, np.ones((1, 40), bool)).injection
  memory = lambda injection: [state.memory for state in injection.states]
  assert jax.tree.leaves(memory(injection)) and same(memory(new), memory(injection))
  assert (new.plan.severity != injection.plan.severity).all()
  assert (new.target != injection.target).any()


@pytest.mark.slow
def test_a_preset_is_trained_under_as_it_is(short_walker, tmp_path):
  """Severities, clocks and the targets that it names, for every robot, and still after a new draw;
  a target that it leaves open is drawn.
  """
  trainer = train.Trainer(
    short_walker, DREAMER, TrainConfig(envs=ENVS, fault="walker/gear-half-twice"), tmp_path
  )
  knee = trainer.fault[0].targets.index("right_knee")
  for streams in (
    trainer.state.streams,
    trainer._redraw(trainer.state.streams, np.ones((1, ENVS), bool)),
  ):
    injection = streams.injection
    assert (np.asarray(injection.target) == knee).all() and (
      np.asarray(injection.plan.severity) == 0.5
    ).all()
    assert (np.asarray(injection.plan.onset) == [0, 20_000]).all() and (
      np.asarray(injection.plan.duration)[..., 0] == 10_000
    ).all()
  drawn = train.Trainer(
    short_walker, DREAMER, TrainConfig(envs=40, fault="walker/gear-half"), tmp_path
  )
  assert set(np.asarray(drawn.state.streams.injection.target)[0, :, 0]) == set(
    range(6)
  )  # 6 (5 / 6)^40 = 4e-3 to miss one; the seed is fixed
  for bad, text in (
    (dict(fault="walker/gear-half", severity=0.3), "brings its own severity"),
    (dict(fault="walker/gear-haf"), "walker/gear-half"),
    (dict(fault="quadruped/rh-velocity-third"), "of robot 'quadruped'"),
  ):
    with pytest.raises(UserError, match=text):
      train.Trainer(short_walker, DREAMER, TrainConfig(**bad), tmp_path)


@pytest.fixture
def begun(tmp_path, monkeypatch):
  """(arguments, folder) of a training that was cut off before its first chunk."""

  def cut(self):
    interrupt.note(signal.SIGINT)
    raise KeyboardInterrupt

  monkeypatch.setattr(train.Trainer, "step", cut)
  argv = ["train", "walker", "--preset", "tiny", "--out", str(tmp_path / "out")]
  assert app.main(argv) == 130
  return argv, tmp_path / "out"


def test_an_agent_of_before_is_gone_once_overwrite_begins(begun, capsys):
  """Else --resume would find its card, call the new training finished, and leave the old agent."""
  argv, out = begun
  for name in ("agent/card.json", "agent/agent.npz", "demonstrator/policy.npz", "agent/notes.txt"):
    (out / name).parent.mkdir(exist_ok=True)
    (out / name).write_text("old")
  assert app.main([*argv, "--overwrite"]) == 130
  assert (
    not [
      p.name
      for p in (*(out / "agent").iterdir(), *(out / "demonstrator").iterdir())
      if p.name != "notes.txt"
    ]
    and (out / "agent/notes.txt").exists()
  )
  capsys.readouterr()
  assert app.main([*argv, "--resume"]) == 130 and "finished" not in capsys.readouterr().err


def test_overwrite_of_the_folder_that_the_agent_lies_in_is_refused(begun, capsys):
  argv, out = begun
  config = (out / "config.json").read_text()
  shutil.copytree(agents.HERE / "walker", out / "agent")
  assert (
    app.main(
      [*argv, "--overwrite", "--agent", str(out / "agent"), "--set", "size=size1m", "bins=255"]
    )
    == 2
  )
  assert (
    "another --out" in capsys.readouterr().err
    and (out / "agent/agent.npz").exists()
    and (out / "config.json").read_text() == config
  )


def test_a_demonstrator_that_was_cut_off_goes_on(tmp_path, monkeypatch, capsys):
  asked = []

  def cut(env, folder, steps, seed, progress, resume):
    asked.append((seed, resume))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "latest.msgpack").write_bytes(b"networks")
    interrupt.note(signal.SIGINT)
    raise KeyboardInterrupt

  monkeypatch.setattr(demonstrator, "train", cut)
  argv = ["train", "walker", "--preset", "tiny", "--demonstrator", "ppo", "--out", str(tmp_path)]
  argv += ["--set", "clone=10", "fade=10", "pure=10"]
  for more in ([], ["--resume"], ["--overwrite"]):
    assert app.main([*argv, *more]) == 130, capsys.readouterr().err
  assert asked == [(0, False), (0, True), (0, False)]
  capsys.readouterr()
  assert app.main([*argv, "--seed", "1", "--resume"]) == 2 and "seed" in capsys.readouterr().err


def test_what_a_demonstrator_asks_for_is_said_before_an_earlier_training_is_gone(begun, capsys):
  argv, out = begun
  before = (out / "config.json").read_text()
  assert app.main([*argv, "--overwrite", "--demonstrator", "ppo", "--set", "clone=1000"]) == 2
  assert (
    "exceeds updates" in capsys.readouterr().err and (out / "config.json").read_text() == before
  )


@pytest.mark.parametrize(
  "given, said",
  [
    (["capacity=50000000"], "would fit"),
    (["anchor=0.1", "shake=0.1"], "shake puts random ones"),
    (["shaping=1"], "has no shaping terms"),
    (["severity=0.5"], "severity is of a fault"),
    (["warmup=10", "--agent", "walker"], "warmup does nothing with --agent"),
    (["demonstrator=ppo", "clone=10", "fade=10", "pure=10"], "cannot read demonstrator"),
  ],
)
def test_what_a_trainer_refuses_costs_no_earlier_training(begun, capsys, given, said):
  argv, out = begun
  (out / "agent").mkdir()
  (out / "agent/agent.npz").write_text("old")
  before = (out / "config.json").read_text()
  assert app.main([*argv, "--overwrite", "--set", *given]) in (1, 2)
  error = capsys.readouterr().err
  assert said in error and error.count("\n") == 1
  assert (out / "agent/agent.npz").exists() and (out / "config.json").read_text() == before


def test_a_shipped_agent_does_not_lie_in_the_folder_of_the_command(begun, monkeypatch, capsys):
  argv, out = begun
  monkeypatch.chdir(out)
  assert (
    app.main(
      [*argv[:-1], ".", "--overwrite", "--agent", "walker", "--set", "size=size1m", "bins=255"]
    )
    == 130
  ), capsys.readouterr().err


def test_the_demonstrator_of_a_resumed_training_may_be_named_in_another_way(tmp_path, monkeypatch):
  """As a relative path, from another folder, and where its folder has moved; another file of the
  same name is another.
  """
  env, dreamer = envs.make("walker"), PRESETS["tiny"].dreamer
  config = replace(PRESETS["tiny"].train, clone=10, fade=10, pure=10)
  for name in ("a", "b"):
    (tmp_path / name).mkdir()
    (tmp_path / name / "policy.npz").write_text("")
  begun = dataclasses.replace(config, demonstrator=str(tmp_path / "a/policy.npz"))
  (tmp_path / "config.json").write_text(
    json.dumps(
      {
        "env": "walker",
        "seed": 0,
        "seeds": 1,
        "started_from": None,
        "dreamer": dataclasses.asdict(dreamer),
        "train": dataclasses.asdict(begun),
      }
    )
  )
  same = lambda name: files.check_same(tmp_path, env, dreamer, config, 0, 1, name, None)
  monkeypatch.chdir(tmp_path / "b")
  assert same("../a/policy.npz") == same("elsewhere/policy.npz") == config.updates
  for name in ("policy.npz", None, "elsewhere/other.npz", "reference", "ppo"):
    if name == "ppo":  # its policy would lie in the training's own folder
      (tmp_path / "demonstrator").mkdir()
      (tmp_path / "demonstrator/policy.npz").write_text("")
    with pytest.raises(UserError, match="another demonstrator;"):
      same(name)


def test_a_training_is_resumed_with_its_own_settings(begun, capsys):
  argv, out = begun
  before = (out / "config.json").read_text()
  assert app.main([*argv, "--resume", "--seed", "7", "--set", "repeat=2", "lr=0.5"]) == 2
  said = capsys.readouterr().err.splitlines()[-1]
  assert "another seed, lr, repeat;" in said and (out / "config.json").read_text() == before
  assert app.main([*argv, "--resume", "--set", "updates=300"]) == 130  # more of the same
  assert json.loads((out / "config.json").read_text())["train"]["updates"] == 300
  assert (
    app.main([*argv, "--resume", "--seeds", "2"]) == 2
    and "another seeds;" in capsys.readouterr().err
  )
  ratio = json.loads((out / "config.json").read_text())["train"]["ratio"]
  assert (
    app.main([*argv, "--resume", "--set", f"ratio={ratio:g}", "updates=300"]) == 130
  )  # 16 is 16.0
  (out / "agent").mkdir()
  (out / "agent/card.json").write_text("{}")
  assert (
    app.main([*argv, "--resume", "--set", "updates=300"]) == 0
    and "is finished" in capsys.readouterr().err
  )
  assert (
    app.main([*argv, "--resume", "--set", "updates=400"]) == 2
    and "finished its 300 updates; go on with --agent" in capsys.readouterr().err
  )
  (out / "config.json").write_text('{"command": "run"}')
  assert app.main([*argv, "--resume"]) == 1 and "not a training's" in capsys.readouterr().err


def test_resume_without_a_checkpoint(short_walker, tmp_path):
  """One that was killed before its first checkpoint begins anew: as a fresh one, with the agent
  that it was to start from.
  """
  with pytest.raises(FileError, match="no checkpoint"):
    make_trainer(short_walker, tmp_path).resume()
  build = lambda resume: files.build(
    short_walker,
    DREAMER,
    TrainConfig(envs=4, updates=8, ratio=1.0, capacity=128),
    tmp_path / "cut",
    3,
    1,
    None,
    None,
    "tiny",
    "",
    resume,
  )
  first = build(False)
  again = build(True)
  assert again.updates == 0 and json.loads((tmp_path / "cut/config.json").read_text())["seed"] == 3
  assert all(
    np.array_equal(a, b)
    for a, b in zip(jax.tree.leaves(first.state.train), jax.tree.leaves(again.state.train))
  )


@pytest.fixture
def trained(short_walker, tmp_path):
  """(folder, a new Trainer of it) of a training with one chunk and its checkpoint."""
  trainer = make_trainer(short_walker, tmp_path)
  counted(trainer)
  trainer.step()
  trainer.save()
  return tmp_path, trainer


META = {
  "without phase": lambda m: m.pop("phase"),
  "without owed": lambda m: m.pop("owed"),
  "without sums": lambda m: m.pop("sums"),
  "of words": lambda m: m.update(owed="x"),
  "of None": lambda m: m.update(own=None),
  "another phase": lambda m: m.update(phase="clone"),
  "other robots": lambda m: m.update(sums=[[0.0]]),
  "failed": lambda m: m.update(failed=[1]),
}


@pytest.mark.parametrize("kind", META)
def test_a_checkpoint_without_what_a_training_needs_is_one_line(trained, kind, same):
  folder, trainer = trained
  meta = trainer.checkpoints.load(trainer.state)[1]
  META[kind](meta)
  trainer.checkpoints.save(2, trainer.state, meta)
  before = {
    k: v
    for k, v in vars(trainer).items()
    if k in ("rows", "failed", "phase", "phase_start", "owed", "own", "chunks", "seconds")
  }
  state = trainer.state
  with pytest.raises(FileError, match="checkpoint 2 in .* is not a training's") as e:
    trainer.resume()
  assert (
    "\n" not in str(e.value)
    and trainer.state is state
    and before == {k: vars(trainer)[k] for k in before}
  )
  if kind.startswith("without"):
    assert f"(no '{kind.split()[1]}')" in str(e.value)


@pytest.mark.parametrize("damage", ["truncated", "emptied", "garbage"])
def test_damaged_metrics_are_one_line(trained, damage):
  folder, trainer = trained
  DAMAGE[damage](folder / "metrics.parquet")
  with pytest.raises(FileError, match=f"cannot read {folder / 'metrics.parquet'}: ") as e:
    trainer.resume()
  assert "\n" not in str(e.value)
  (folder / "metrics.parquet").unlink()  # rows are lost, the training is not
  trainer.resume()
  assert trainer.chunks == 1 and not trainer.rows


def test_actions_in_other_bounds_are_refused(short_walker, tmp_path):
  """The policy lives in about -1 to 1, so an action that goes further or less far is named, with
  the remedy.
  """
  for low, high in ((-2, 2), (0, 1), (float("-inf"), float("inf"))):
    robot = copy.copy(short_walker)
    act = list(robot.spec.act)
    act[2] = act[2]._replace(low=low, high=high)
    robot.spec = robot.spec._replace(act=tuple(act))
    with pytest.raises(
      UserError,
      match=(
        f"action '{act[2].name}' of robot 'walker' has bounds {low:g} and {high:g}.* scale in "
        "the environment's `step`"
      ),
    ) as e:
      train.Trainer(robot, DREAMER, TrainConfig(), tmp_path / "none")
    assert "\n" not in str(e.value) and not (tmp_path / "none").exists()
  for name in envs.ENVS:
    assert {(var.low, var.high) for var in envs.make(name).spec.act} == {(-1, 1)}, name


def test_a_second_signal_saves_no_half_of_a_chunk(tmp_path):
  """The first interrupt lets the chunk end and saves; one more, in the middle of it, leaves nothing
  whole to save.
  """
  notes = []

  class Half:
    done = False

    def step(self):
      notes.append("step")
      if len(notes) == 2:
        raise KeyboardInterrupt  # as the second signal does

    def save(self):
      notes.append("save")

  with pytest.raises(KeyboardInterrupt):
    train.run(Half())
  assert notes == ["step", "step"]


# ---- train ratio ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
  "ratio", [0.1, 1.0, 3.0]
)  # less than one update a chunk; a power of two; not a power of two
def test_updates_follow_the_ratio(short_walker, tmp_path, ratio):
  trainer, chunks = make_trainer(short_walker, tmp_path, ratio=ratio), 20
  learn = counted(trainer)
  for _ in range(chunks):
    trainer.step()
  per_chunk = PER_CHUNK * ratio
  assert (
    chunks * per_chunk - per_chunk - 1 <= trainer.updates <= chunks * per_chunk
  )  # at most a chunk's worth is owed
  assert trainer.updates == sum(n for n, _ in learn.calls)
  assert all(n & (n - 1) == 0 for n, _ in learn.calls)  # powers of two: few programs


def test_first_update_waits_for_windows_and_pays_no_backlog(short_walker, tmp_path):
  trainer = make_trainer(
    short_walker, tmp_path, replace(DREAMER, batch=64), ratio=16.0
  )  # 512 windows; 8 updates a chunk
  counted(trainer)
  counts, before = [], 0
  for _ in range(5):
    trainer.step()
    windows = int(
      replay_lib.windows(jax.tree.map(lambda x: x[0], trainer.state.replay), LENGTH + 1)
    )
    counts.append((windows >= 64 * LENGTH, trainer.updates - before))
    before = trainer.updates
  assert not counts[0][0] and counts[-1][0]
  assert all(n == (8 if ready else 0) for ready, n in counts)


@pytest.mark.slow
def test_published_protocol_starts_after_2048_records(tmp_path):
  """16 robots, windows of 65: 1,024 of them exist after 128 vector steps. From there one update per
  record at ratio 1,024: about 498k by 500k records.
  """
  from mjx_cl import envs

  dreamer = replace(PRESETS["tiny"].dreamer, batch=16, length=64)
  trainer = train.Trainer(
    envs.make("walker", "native"),
    dreamer,
    TrainConfig(envs=16, updates=10**6, ratio=1024.0, capacity=1024),
    tmp_path,
  )
  learn = counted(trainer)
  rows = [trainer.step() for _ in range(3)]
  assert [r["records"] for r in rows] == [1024, 2048, 3072] and [u for u, _ in learn.calls] == [
    1024,
    1024,
  ]
  again = jax.tree.map(
    jnp.zeros_like,
    trainer.collect["pure"].chunk(trainer.state.train.params, trainer.state.streams, train.CHUNK)[
      1
    ],
  )
  trainer.collect = {
    "pure": types.SimpleNamespace(
      chunk=lambda params, streams, steps, *_: (streams._replace(t=streams.t + steps), again)
    )
  }  # time alone goes on
  while (row := trainer.step())["records"] < 499_000:
    pass
  assert (
    row["records"] == 488 * 1024
    and row["updates"] == trainer.updates == sum(u for u, _ in learn.calls) == 487 * 1024
  )  # 498,688 of 499,712


def test_last_chunk_stops_at_the_last_update(short_walker, tmp_path):
  trainer = make_trainer(short_walker, tmp_path, updates=19)
  counted(trainer)
  while not trainer.done:
    trainer.step()
  assert trainer.updates == 19


def test_learning_rate_falls_over_the_last_updates(short_walker, tmp_path):
  trainer = make_trainer(short_walker, tmp_path, updates=64, pure=32, lr_end=DREAMER.lr / 4)
  learn = counted(trainer)
  while not trainer.done:
    trainer.step()
  np.testing.assert_allclose(
    [w.lr for _, w in learn.calls], [1, 1, 1, 1, 1, 0.8125, 0.625, 0.4375]
  )  # a line from 1 at 32 to 0.25 at 64


# ---- phases --------------------------------------------------------------------------------------


def phases(env, out, expert_path, **config):
  trainer = make_trainer(
    env, out, demonstrator=expert_path, clone_until=1.0, clone_weight=0.4, **config
  )
  learn = counted(trainer)
  trainer.expert_return = 1e9  # out of reach: the phases end by their update counts
  return trainer, learn


def test_phases_follow_one_another(short_walker, tmp_path, expert_path):
  trainer, learn = phases(
    short_walker, tmp_path, expert_path, updates=64, clone=16, fade=16, pure=32
  )
  held = []
  while not trainer.done:
    labelled = trainer.step()["phase"] != "pure"
    replay = trainer.state.replay
    held.append(int(np.max(replay.count)))
    written = np.asarray(replay.data.has_demo) & (
      np.arange(256) < np.asarray(replay.count)[..., None]
    )
    if labelled and held[-1]:
      assert written.any()
    if not labelled:
      assert not written.any() and not trainer._drive().any()
  names = [row["phase"] for row in trainer.rows]
  assert names == ["clone"] * 2 + ["fade"] * 2 + ["pure"] * 4
  assert (
    held[3] == 0 and 0 < held[4] < held[2]
  )  # emptied on entering the last phase, then filled anew
  clone, policy = ([float(getattr(w, n)) for _, w in learn.calls] for n in ("clone", "policy"))
  np.testing.assert_allclose(clone, [0.4, 0.4, 0.4, 0.2, 0, 0, 0, 0])
  assert policy == [0, 0, 1, 1, 1, 1, 1, 1]
  assert sum(n for (n, _), name in zip(learn.calls, names) if name == "pure") >= 32


def test_a_fade_of_no_updates_lasts_a_chunk(short_walker, tmp_path, expert_path):
  trainer, learn = phases(
    short_walker, tmp_path, expert_path, updates=48, clone=16, fade=0, pure=16
  )
  while not trainer.done:
    trainer.step()
  assert "fade" in (names := [row["phase"] for row in trainer.rows]) and names[-1] == "pure"
  assert learn.calls[-1][1].clone == 0.0


def test_a_return_that_the_demonstrator_began_is_not_the_agents(
  short_walker, tmp_path, expert_path
):
  """Robots that it drove until the last phase begin it in mid-episode; resumed alike."""
  trainer, _ = phases(short_walker, tmp_path, expert_path, updates=64, clone=16, fade=16, pure=32)
  while trainer.phase != "pure":
    trainer.step()
  trainer.save()
  trainer.checkpoints.close()
  again = phases(short_walker, tmp_path, expert_path, updates=64, clone=16, fade=16, pure=32)[0]
  again.resume()
  driven = np.arange(ENVS) < 2
  for one in (trainer, again):
    assert (one.driven == driven).all()
    row = one.step()
    # of episodes of 12 steps: the driven robots' first is left out
    ended = (np.asarray(one.state.streams.t)[0] // 12) - ((one.chunks - 1) * train.CHUNK // 12)
    assert row["episodes"] == int((ended - driven).sum()) and not one.driven.any()


def test_at_least_pure_updates_are_pure(short_walker, tmp_path, expert_path):
  trainer, learn = phases(
    short_walker, tmp_path, expert_path, updates=100, clone=20, fade=30, pure=50
  )
  while not trainer.done:
    trainer.step()
  assert sum(n for n, w in learn.calls if w.clone == 0.0) >= 50


def test_expert_drives_its_share_and_is_labelled_everywhere(short_walker, tmp_path, expert_path):
  trainer, _ = phases(
    short_walker,
    tmp_path,
    expert_path,
    updates=64,
    clone=16,
    fade=16,
    pure=32,
    demo_noise=0.0,
    demo_share=0.5,
  )
  trainer.step()
  data = jax.tree.map(lambda x: np.asarray(x)[0], trainer.state.replay.data)
  at = np.asarray(data.has_demo)
  assert at[:, :60].sum() > 0.8 * at[:, :60].size  # all but the last records of episodes
  for e in range(ENVS):
    followed = np.allclose(
      data.action[e][at[e]], data.demo[e][at[e]], atol=1e-5
    )  # the expert's own action, without noise
    assert followed == (e < 2), e
  np.testing.assert_allclose(
    data.demo[at], demonstrator.load(expert_path)(data.obs[at]), atol=1e-5
  )  # float32 in another order


def test_the_reference_driver_is_a_demonstrator(short_walker):
  env = envs.make("car")
  state, obs = env.init(env.model, jax.random.key(0))
  stream = types.SimpleNamespace(env=state, obs=obs)
  np.testing.assert_array_equal(premises.expert(env, "reference")(stream), env.reference(state))
  with pytest.raises(UserError, match="'walker' has no reference driver"):
    premises.expert(short_walker, "reference")


def test_cloning_ends_when_the_agent_is_good_enough(short_walker, tmp_path, expert_path):
  trainer = make_trainer(
    short_walker, tmp_path, demonstrator=expert_path, clone_until=0.8, updates=20_000
  )
  trainer.expert_return = 100.0
  for own, phase in (
    ([90.0] * 15, "clone"),
    ([70.0] * 16, "clone"),
    ([90.0] * 4 + [79.0] * 16, "clone"),
    ([10.0] * 4 + [81.0] * 16, "fade"),
  ):
    trainer.own = own
    trainer._advance_phase()
    assert trainer.phase == phase, own


def test_phases_must_fit():
  with pytest.raises(UserError, match="exceeds updates"):
    TrainConfig(demonstrator="x", updates=100)


# ---- files ---------------------------------------------------------------------------------------


def test_metrics_are_written_and_readable(short_walker, tmp_path):
  trainer = make_trainer(short_walker, tmp_path, updates=16)
  counted(trainer, metric=2.5)
  seen = []
  train.run(trainer, progress=seen.append)
  rows = pyarrow.parquet.read_table(tmp_path / "metrics.parquet").to_pylist()
  assert trainer.done and [r["updates"] for r in rows] == [r["updates"] for r in seen] == [8, 16]
  assert all(r["loss/rew"] == 2.5 and r["phase"] == "pure" for r in rows)
  assert [r["records"] for r in rows] == [train.CHUNK * ENVS, 2 * train.CHUNK * ENVS]
  assert trainer.checkpoints.latest() == 2


def test_returns_are_sums_over_episodes(short_walker, tmp_path):
  trainer = make_trainer(short_walker, tmp_path)
  counted(trainer)
  row = trainer.step()
  data = jax.tree.map(lambda x: np.asarray(x)[0], trainer.state.replay.data)
  episodes = [np.split(data.reward[e], np.flatnonzero(data.last[e]) + 1)[:-1] for e in range(ENVS)]
  assert row["episodes"] == sum(map(len, episodes)) == ENVS * (train.CHUNK // 12)
  np.testing.assert_allclose(
    row["reward"], data.reward.sum() / (ENVS * train.CHUNK), rtol=0.05
  )  # the last step's reward arrives with the next chunk
  np.testing.assert_allclose(
    row["return"], np.mean([np.sum(r) for e in episodes for r in e]), rtol=1e-5
  )  # float32 rewards


def test_an_end_for_good_costs_until_the_last_updates(short_walker, tmp_path):
  """Every second robot falls where its episodes end: its last records lose the cost, nobody else's
  do, no return does, and no record of the last updates.
  """
  falls = np.arange(ENVS) % 2 == 0
  replays, returns = [], []
  for cost, pure in (
    (0.0, 1),
    (7.0, 1),
    (7.0, 10_000),
  ):  # of 10,001 updates; the last trainer has one behind it
    trainer = make_trainer(short_walker, tmp_path, fall_cost=cost, pure=pure, updates=10_001)
    trainer.state = trainer.state._replace(
      train=trainer.state.train._replace(updates=trainer.state.train.updates + 1)
    )
    counted(trainer)
    chunk = trainer.collect["pure"].chunk

    def fallen(*args, chunk=chunk):
      streams, rows = chunk(*args)
      return streams, rows._replace(
        terminated=rows.truncated & falls, truncated=rows.truncated & ~falls
      )

    trainer.collect = {"pure": types.SimpleNamespace(chunk=fallen)}
    returns.append(trainer.step()["return"])
    replays.append(jax.tree.map(lambda x: np.asarray(x)[0], trainer.state.replay.data))
  plain, cost, late = replays
  assert plain.terminal.any() and (plain.terminal == plain.last & falls[:, None]).all()
  np.testing.assert_array_equal(cost.reward, plain.reward - np.float32(7) * plain.terminal)
  np.testing.assert_array_equal(late.reward, plain.reward)
  assert returns[0] == returns[1] == returns[2]
  with pytest.raises(UserError, match="fall_cost must be 0 or above"):
    TrainConfig(fall_cost=-1)
  with pytest.raises(UserError, match="set pure below that"):
    TrainConfig(fall_cost=1, updates=100, pure=100)


def test_penalties_are_eased_and_nothing_else(short_walker, tmp_path):
  robot = copy.copy(short_walker)
  before = np.asarray(short_walker.model.task["reward_weights"]).copy()
  before[0] = -2.0
  robot.model = robot.model._replace(
    task=robot.model.task | {"reward_weights": jnp.asarray(before)}
  )
  trainer = make_trainer(robot, tmp_path, penalties=0.25)
  at = trainer.collect["pure"].env
  assert at is not robot and trainer.env is robot  # what is evaluated in the end
  np.testing.assert_array_equal(
    at.model.task["reward_weights"], np.where(before < 0, before * np.float32(0.25), before)
  )
  np.testing.assert_array_equal(robot.model.task["reward_weights"], before)
  for name, leaf in robot.model.task.items():
    assert name == "reward_weights" or at.model.task[name] is leaf
  assert premises.eased(robot, 1.0) is robot
  with pytest.raises(UserError, match="has no negative weights"):
    make_trainer(short_walker, tmp_path, penalties=0.5)


def test_shaping_is_added_to_the_reward_and_to_nothing_else(short_walker, tmp_path):
  """Of a robot that has terms of its own; others refuse."""
  robot = envs.make("quadruped")
  shaped = premises.shaped(robot, 0.5)
  state, _ = robot.init(robot.model, jax.random.key(0))
  action = jnp.full(12, 0.1)
  (after, plain), (other, more) = (e.step(e.model, state, action) for e in (robot, shaped))
  want = plain.reward + 0.5 * robot.shaping(state, after)
  assert float(more.reward) == pytest.approx(float(want), abs=1e-6) != float(plain.reward)
  same = lambda a, b: np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
  same(other.physics.qpos, after.physics.qpos)
  same(more.obs, plain.obs)
  assert premises.shaped(robot, 0.0) is robot
  with pytest.raises(UserError, match="no shaping terms"):
    make_trainer(short_walker, tmp_path, shaping=0.5)


def test_the_policy_is_held_at_the_start_of_the_pure_phase(short_walker, tmp_path):
  """Without its own gradient for the first `hold` updates; the anchor takes the robots' own actions
  for right, so no random ones may be among them.
  """
  trainer = make_trainer(short_walker, tmp_path, replace(DREAMER, anchor=0.5), hold=20)
  learn = counted(trainer)
  while trainer.updates < 40:
    trainer.step()
  before = np.cumsum([0] + [n for n, _ in learn.calls])[:-1]
  assert [w.policy for _, w in learn.calls] == [float(u >= 20) for u in before] and before[-1] > 20
  with pytest.raises(UserError, match="hold must be a whole number in 0"):
    TrainConfig(hold=-1)
  with pytest.raises(UserError, match="anchor must be 0 or above"):
    replace(DREAMER, anchor=-0.5)
  with pytest.raises(UserError, match="to 0"):
    make_trainer(short_walker, tmp_path, replace(DREAMER, anchor=0.5), shake=0.1)
  with pytest.raises(UserError, match="min_std and max_std must lie above 0"):
    replace(DREAMER, min_std=0.0)


def test_a_metric_that_is_not_finite_stops_the_run(short_walker, tmp_path):
  trainer = make_trainer(short_walker, tmp_path)
  counted(trainer, metric=float("nan"))
  with pytest.raises(FileError, match="numeric failure") as e:
    trainer.step()
  assert "\n" not in str(e.value)


TREE = {"w": jnp.arange(6.0).reshape(2, 3), "n": jnp.int32(4), "key": jax.random.key(3)}


def like(tree):
  return jax.tree.map(
    lambda x: jnp.zeros_like(x) if not checkpoints._is_key(x) else jax.random.key(0), tree
  )


@pytest.fixture
def saved(tmp_path):
  """A folder with checkpoints 1 and 2."""
  store = checkpoints.Checkpoints(tmp_path / "checkpoints")
  for number in (1, 2):
    store.save(number, TREE | {"n": jnp.int32(number)}, {"number": number})
  store.close()
  return tmp_path / "checkpoints"


def test_round_trip_keeps_two(saved, same):
  store = checkpoints.Checkpoints(saved)
  store.save(7, TREE, {"text": "x", "list": [1.5, None]})
  tree, meta = store.load(like(TREE))
  assert same(tree, TREE) and meta == {"text": "x", "list": [1.5, None]}
  assert sorted(p.name for p in saved.iterdir() if p.is_dir()) == ["2", "7"]


DAMAGE = {
  "truncated": lambda f: f.write_bytes(f.read_bytes()[: f.stat().st_size // 2]),
  "emptied": lambda f: f.write_bytes(b""),
  "garbage": lambda f: f.write_bytes(b"\x93\x00garbage" * 20),
  "removed": lambda f: f.unlink(),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_checkpoint_is_one_clear_line(saved, same, kind, capfd):
  """The newest broken: said, and the one before it is taken; both broken: an error, and nothing is
  removed.
  """

  def damage(number):
    for file in sorted((saved / number).rglob("*")):
      if file.is_file():
        DAMAGE[kind](file)

  both = saved.parent / "both"
  damage("2")
  shutil.copytree(saved, both)
  store = checkpoints.Checkpoints(saved)
  tree, meta = store.load(like(TREE))
  assert same(tree, TREE | {"n": jnp.int32(1)}) and meta == {"number": 1} and store.latest() == 1
  (line,) = [x for x in capfd.readouterr().err.splitlines() if x.startswith("mjx-cl:")]
  assert line.startswith(f"mjx-cl: cannot read checkpoint 2 in {saved}: ") and line.endswith(
    "; it is broken, going on from checkpoint 1"
  )
  store.save(2, TREE, {"number": 2})  # the number is free again
  assert same(store.load(like(TREE))[0], TREE)
  saved = both
  damage("1")
  before = sorted(p for p in both.rglob("*"))
  with pytest.raises(FileError) as e:
    checkpoints.Checkpoints(both).load(like(TREE))
  assert (
    "\n" not in str(e.value)
    and "checkpoint 2" in str(e.value)
    and str(both) in str(e.value)
    and sorted(p for p in both.rglob("*")) == before
  )


def test_any_one_damaged_file_is_noticed_or_harmless(saved, same):
  files = [f.relative_to(saved) for f in sorted((saved / "2").rglob("*")) if f.is_file()]
  noticed = 0
  for i, file in enumerate(files):
    for kind in ("truncated", "removed"):
      copy = saved.parent / f"{i}-{kind}"
      shutil.copytree(saved, copy)
      DAMAGE[kind](copy / file)
      tree, meta = checkpoints.Checkpoints(copy).load(like(TREE))
      assert meta["number"] in (1, 2) and same(tree, TREE | {"n": jnp.int32(meta["number"])}), file
      noticed += meta["number"] == 1
  assert noticed >= 2 and len(files) > 2


@pytest.mark.parametrize(
  "other",
  [{"w": jnp.zeros((2, 4))}, {"w": jnp.zeros((3, 2))}, {"w": jnp.zeros(6)}, {"more": jnp.zeros(2)}],
)
def test_checkpoint_of_another_size_is_one_clear_line(saved, other):
  with pytest.raises(FileError) as e:
    checkpoints.Checkpoints(saved).load(like(TREE) | other)
  assert "\n" not in str(e.value) and "checkpoint 2" in str(e.value)


CHILD = """
import os, sys
from mjx_cl.io import checkpoints as checkpoint
import jax.numpy as jnp
store = checkpoint.Checkpoints(sys.argv[1])
def die(event, args):
  if event == "os.rename" and os.path.basename(os.fspath(args[1])) == "3":
    os._exit(9)  # as SIGKILL: nothing is cleaned up
sys.addaudithook(die)
store.save(3, {"w": jnp.ones((2, 3))}, {"number": 3})
"""


def test_kill_during_a_save_keeps_the_last_good_checkpoint(saved, same):
  root = str(pathlib.Path(checkpoints.__file__).parents[2])
  env = os.environ | {
    "PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")]),
    "JAX_PLATFORMS": "cpu",
  }
  done = subprocess.run(
    [sys.executable, "-c", CHILD, str(saved)], env=env, capture_output=True, text=True, timeout=1200
  )
  assert done.returncode == 9, done.stderr
  left = [p.name for p in saved.iterdir() if p.name not in ("1", "2")]
  assert any(n.startswith("3.") for n in left)  # the half-written folder, under its temporary name
  store = checkpoints.Checkpoints(saved)
  assert store.latest() == 2
  tree, meta = store.load(like(TREE))
  assert same(tree, TREE | {"n": jnp.int32(2)}) and meta == {"number": 2}
  store.save(3, TREE, {"number": 3})
  assert store.latest() == 3 and same(store.load(like(TREE))[0], TREE)


def test_empty_temporary_folder_is_no_checkpoint(saved):
  shutil.copytree(saved / "2", saved / "9.orbax-checkpoint-tmp")
  for file in list((saved / "9.orbax-checkpoint-tmp").rglob("*"))[::2]:
    if file.is_file():
      file.unlink()
  assert checkpoints.Checkpoints(saved).latest() == 2
