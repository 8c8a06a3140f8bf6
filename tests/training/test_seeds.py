"""Several seeds in one program: as a loop over them, spread over devices, and one that fails alone."""

import dataclasses
import os
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl.config import PRESETS, TrainConfig, replace
from mjx_cl.dreamer.agent import CAUSES, Weights, culprit
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import checkpoints, runtime
from mjx_cl.training import agents, files
from mjx_cl.training import trainer as train

DREAMER = replace(PRESETS["tiny"].dreamer, batch=4, length=8, imagine=4)
CONFIG = TrainConfig(envs=4, updates=10_000, ratio=0.25, capacity=256)  # 2 updates a chunk
SEEDS = 4  # on two devices two each
_shared = {}


def make_trainer(env, out):
  """A Trainer of SEEDS seeds; those of one robot share their programs."""
  trainer = train.Trainer(env, DREAMER, CONFIG, out, seeds=SEEDS)
  trainer.collect, trainer.learn, trainer._add = _shared.setdefault(
    id(env), (trainer.collect, trainer.learn, trainer._add)
  )
  return trainer


def test_a_seed_that_fails_is_named_as_its_folder_is(short_walker, tmp_path, capfd):
  trainer = train.Trainer(short_walker, DREAMER, CONFIG, tmp_path, seed=5, seeds=3)
  trainer._notice_failures(np.array([-1, 0, -1]))
  assert "numeric failure of seed 6: " in capfd.readouterr().err and list(trainer.failed) == [1]


def seed(tree, g):
  return jax.tree.map(lambda x: x[g], tree)


@pytest.mark.slow
def test_seeds_in_one_program_are_a_loop_over_them(short_walker, tmp_path):
  trainer = make_trainer(short_walker, tmp_path)
  for _ in range(2):
    trainer.step()
  state, key = trainer.state, jax.random.key(5)
  alone = train.make_learn(trainer.plain, DREAMER.batch, DREAMER.length)
  copy = lambda tree: jax.tree.map(jnp.copy, tree)
  one = [
    alone(
      *copy(jax.tree.map(lambda x: x[None], seed((state.train, state.replay), g))),
      k,
      Weights(),
      np.ones(1, bool),
      2,
    )
    for g, k in enumerate(jax.random.split(key, SEEDS))
  ]
  all_ = trainer.learn["pure"](
    *copy((state.train, state.replay)), key, Weights(), np.ones(SEEDS, bool), 2
  )
  for g in range(SEEDS):
    for (path, a), b in zip(jax.tree.leaves_with_path(one[g]), jax.tree.leaves(seed(all_, g))):
      a, b = np.asarray(a[0], np.float64), np.asarray(b, np.float64)
      # two programs of the same arithmetic; after 2 updates they differ by float32 rounding,
      # latents by that of float16
      np.testing.assert_allclose(
        a, b, rtol=2e-3, atol=2e-4 * max(1.0, np.abs(a).max()), err_msg=jax.tree_util.keystr(path)
      )
  first = np.asarray(jax.tree.leaves(all_[0].params)[0])
  assert np.abs(first[0] - first[1]).max() > 1e-3  # they are different seeds


def poisoned(state, g, value):
  """The state with one weight of seed g's reward head put to `value`: NaN gives a loss that is NaN,
  1e8 one that is about 1e8.
  """
  params = state.train.params
  bias = params["rew"]["out"]["bias"].at[g, 0].set(value)
  params = {**params, "rew": {**params["rew"], "out": {**params["rew"]["out"], "bias": bias}}}
  return state._replace(train=state.train._replace(params=params))


@pytest.mark.slow
def test_by_vmap_is_by_map(short_walker, tmp_path):
  """Both ways over the seeds give the same weights, replay, metrics and culprits: one seed sound,
  one that fails in its first update, one that is not active.
  """
  trainer = make_trainer(short_walker, tmp_path)
  for _ in range(2):
    trainer.step()
  state, active = poisoned(trainer.state, 1, 1e8), np.array([True, True, False, False])
  copy = lambda: jax.tree.map(jnp.copy, (state.train, state.replay))
  assert runtime.seeds_by() == "map"  # on a CPU
  by_map = trainer.learn["pure"](*copy(), jax.random.key(5), Weights(), active, 2)
  by_vmap = train.make_learn(trainer.plain, DREAMER.batch, DREAMER.length, how="vmap")(
    *copy(), jax.random.key(5), Weights(), active, 2
  )
  assert list(by_map[3]) == list(by_vmap[3]) == [-1, CAUSES.index("loss/rew"), -1, -1]
  assert [int(x) - int(y) for x, y in zip(by_vmap[0].updates, state.train.updates)] == [2, 0, 0, 0]
  moved = lambda out: np.abs(
    np.asarray(jax.tree.leaves(out[0].params)[0])
    - np.asarray(jax.tree.leaves(state.train.params)[0])
  ).max(1)
  assert moved(by_vmap)[0] > 0 and not moved(by_vmap)[1:].any()
  assert jax.tree.structure(by_map) == jax.tree.structure(by_vmap)
  for (path, a), b in zip(jax.tree.leaves_with_path(by_map), jax.tree.leaves(by_vmap)):
    assert (a.shape, a.dtype) == (b.shape, b.dtype), jax.tree_util.keystr(path)
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    # two programs of the same arithmetic; after 2 updates they differ by float32 rounding, latents
    # by that of float16
    np.testing.assert_allclose(
      a, b, rtol=2e-3, atol=2e-4 * max(1.0, np.abs(a[0]).max()), err_msg=jax.tree_util.keystr(path)
    )
  with pytest.raises(UserError, match="unknown how 'pmap'; choose from: map, vmap"):
    train.make_learn(trainer.plain, DREAMER.batch, DREAMER.length, how="pmap")


@pytest.mark.parametrize(
  "value, at_fault",
  [(1e6, False), (1.01e6, True), (-1.01e6, True), (3e38, True), (np.inf, True), (np.nan, True)],
)
def test_a_loss_beyond_the_bound_is_at_fault(value, at_fault):
  metrics = {k: jnp.float32(1.0) for k in CAUSES if k != "loss/anchor"}
  assert int(culprit(metrics | {"loss/value": jnp.float32(value)})) == (
    CAUSES.index("loss/value") if at_fault else -1
  )
  assert int(culprit(metrics | {"opt/grad_norm": jnp.float32(value)})) == (
    -1 if np.isfinite(value) else CAUSES.index("opt/grad_norm")
  )


@pytest.mark.parametrize("value", [np.nan, 1e8], ids=["nan", "exploded"])
def test_a_seed_that_fails_stops_alone_and_is_named(
  short_walker, tmp_path, same, capfd, monkeypatch, value
):
  monkeypatch.chdir(tmp_path)  # MuJoCo logs actions that are not finite into the working folder
  sound, hurt = (
    make_trainer(short_walker, tmp_path / "sound"),
    make_trainer(short_walker, tmp_path / "hurt"),
  )
  for trainer in (sound, hurt):
    trainer.step()
  hurt.state = poisoned(hurt.state, 1, value)
  at = int(hurt.state.train.updates[1])
  frozen = jax.tree.map(jnp.copy, seed(hurt.state.train, 1))
  rows, learn, metrics = [], hurt.learn, []

  def watched(*args):
    out = learn["pure"](*args)
    metrics.append(np.asarray(out[2]["loss/rew"]))
    return out

  hurt.learn = {"pure": watched}
  rows = [hurt.step() for _ in range(2)]
  hurt.learn = learn
  assert np.isnan(metrics[0][1]) if np.isnan(value) else 1e6 < metrics[0][1] < np.inf
  for _ in range(2):
    sound.step()
  assert (
    list(hurt.failed) == [1]
    and hurt.failed[1] == f"loss/rew is not finite, or above 1e+06, in update {at + 1}"
  )
  said = capfd.readouterr().err
  assert said.count("numeric failure of seed 1") == 1
  for g in (0, 2, 3):
    assert same(seed(hurt.state.train, g), seed(sound.state.train, g)) and same(
      seed(hurt.state.replay, g), seed(sound.state.replay, g)
    )
  assert same(seed(hurt.state.train, 1), frozen)  # nothing of the update at fault remains
  assert [r["failed_seeds"] for r in rows] == [1, 1] and all(
    np.isfinite(r["opt/loss"]) for r in rows
  )
  assert hurt.updates == sound.updates
  each = [
    rows[-1][f"return/{g}"] for g in range(SEEDS)
  ]  # returns are kept apart, and all robots have equally many episodes
  np.testing.assert_allclose(np.mean(each), rows[-1]["return"], rtol=1e-6)
  assert len(set(each)) == SEEDS
  hurt.save()
  again = make_trainer(short_walker, tmp_path / "hurt")
  again.resume()
  assert again.failed == hurt.failed
  again.step()
  assert same(seed(again.state.train, 1), frozen)


def test_every_sound_seed_leaves_its_agent(short_walker, tmp_path):
  trainer = make_trainer(short_walker, tmp_path)
  for _ in range(2):
    trainer.step()
  trainer.failed[0] = "for the test"
  trainer.about = {"env": "walker", "preset": "tiny", "command": "", "seed": 5, "repeat": 1}
  trainer.about |= {"dreamer": dataclasses.asdict(DREAMER), "train": dataclasses.asdict(CONFIG)}
  card = files.export(trainer, 1)
  folders = sorted(p.parent.name for p in tmp_path.glob("seed-*/agent"))
  assert folders == ["seed-6", "seed-7", "seed-8"]
  for g, folder in enumerate(folders, 1):
    kept = agents.of(short_walker, str(tmp_path / folder / "agent"))
    ours = jax.tree.leaves(seed(trainer.state.train.params, g))
    assert all(map(np.array_equal, jax.tree.leaves(kept.train.params), ours))
    assert kept.card["group"] == g and kept.card["updates"] == trainer.updates
  first = agents.of(short_walker, str(tmp_path / "agent"))
  same = agents.of(short_walker, str(tmp_path / "seed-6/agent"))
  assert all(
    map(np.array_equal, jax.tree.leaves(first.train.params), jax.tree.leaves(same.train.params))
  )
  assert first.card == card and same.card == card | {"group": 1}
  files.clear(tmp_path)
  assert not list(tmp_path.glob("**/agent.npz")) and not list(tmp_path.glob("**/card.json"))


def test_when_every_seed_fails_the_training_ends(short_walker, tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  trainer = make_trainer(short_walker, tmp_path)
  trainer.step()
  trainer.state = trainer.state._replace(
    train=trainer.state.train._replace(
      params=jax.tree.map(lambda x: x * jnp.nan, trainer.state.train.params)
    )
  )
  with pytest.raises(FileError, match="numeric failure of every seed") as e:
    for _ in range(2):
      trainer.step()
  assert "\n" not in str(e.value)


def live(env, out):
  """A training through a checkpoint to a seed that fails: its trainer, and {leaf: weights and
  moments} where the checkpoint was written. Going on from there gives the bits of never having
  stopped, and a seed whose loss explodes leaves the others' bits alone.
  """
  whole = make_trainer(env, out)
  while whole.updates < 4:
    whole.step()
  whole.save()
  again = make_trainer(env, out)
  again.resume()
  named = lambda tree: {
    jax.tree_util.keystr(path): np.asarray(x) for path, x in jax.tree.leaves_with_path(tree)
  }
  saved = named(again.state.train)
  at = again.updates
  for _ in range(2):
    whole.step()
    again.step()
  assert again.updates > at  # what was read meets what is spread over devices
  one, other = (named(checkpoints.pack(trainer.state)) for trainer in (whole, again))
  assert list(one) == list(other)
  assert all(one[name].tobytes() == other[name].tobytes() for name in one)
  again.state = again._place(poisoned(again.state, 1, 1e8))
  of = lambda trainer, g: [np.asarray(x[g]) for x in jax.tree.leaves(trainer.state.train)]
  frozen = of(again, 1)
  whole.step()
  row = again.step()
  assert list(again.failed) == [1] and row["failed_seeds"] == 1
  assert again.failed[1].startswith("loss/rew is not finite, or above 1e+06")
  assert all(map(np.array_equal, frozen, of(again, 1)))
  for g in (0, 2, 3):
    assert all(map(np.array_equal, of(whole, g), of(again, g)))
  return whole, saved


TWO = """
import sys
from mjx_cl.io import runtime; runtime.setup()
import jax, numpy as np
assert len(jax.devices()) == 2
sys.path.insert(0, {tests!r})
import test_seeds
from mjx_cl import envs
env = envs.make("walker", "native")
env.spec = env.spec._replace(episode_steps=12)
trainer, saved = test_seeds.live(env, {out!r})
leaf = jax.tree.leaves(trainer.state.train.params)[0]
assert trainer.mesh is not None and len(leaf.sharding.device_set) == 2
assert leaf.addressable_shards[0].data.shape[0] == test_seeds.SEEDS // 2
np.savez({out!r} + "/saved.npz", *saved.values())
"""


@pytest.mark.slow
def test_two_devices_equal_one(short_walker, tmp_path, monkeypatch):
  """The same training on one device, here, and on two of a process of its own; the programs differ,
  so bits may.
  """
  monkeypatch.chdir(tmp_path)  # MuJoCo logs actions that are not finite into the working folder
  trainer, one = live(short_walker, tmp_path / "one")
  assert trainer.mesh is None
  out = tmp_path / "two"
  done = subprocess.run(
    [
      sys.executable,
      "-c",
      TWO.format(tests=str(pathlib.Path(__file__).parent), out=str(out)),
    ],
    env=os.environ
    | {"XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2"},
    capture_output=True,
    text=True,
  )
  assert done.returncode == 0, done.stderr[-2000:]
  with np.load(out / "saved.npz") as two:
    assert len(two.files) == len(one)
    for (name, a), key in zip(one.items(), two.files):
      # 4 updates in float32, two programs
      np.testing.assert_allclose(
        a, two[key], rtol=1e-3, atol=1e-5 * max(1.0, float(np.abs(a).max())), err_msg=name
      )
