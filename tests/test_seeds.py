"""Several seeds in one program: as a loop over them, spread over devices, and one that fails alone."""
import os
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl import train
from mjx_cl.config import PRESETS, TrainConfig, replace
from mjx_cl.dreamer.agent import Weights
from mjx_cl.errors import FileError

DREAMER = replace(PRESETS["tiny"].dreamer, batch=4, length=8, imagine=4)
CONFIG = TrainConfig(envs=4, updates=10_000, ratio=0.25, capacity=256)  # 2 updates a chunk
SEEDS = 3
_shared = {}


def make_trainer(env, out):
  trainer = train.Trainer(env, DREAMER, CONFIG, out, seeds=SEEDS)
  trainer.collect, trainer.learn, trainer._add = _shared.setdefault(id(env), (trainer.collect, trainer.learn, trainer._add))
  return trainer


def seed(tree, g):
  return jax.tree.map(lambda x: x[g], tree)


def test_seeds_in_one_program_are_a_loop_over_them(short_walker, tmp_path):
  trainer = make_trainer(short_walker, tmp_path)
  for _ in range(2):
    trainer.step()
  state, key = trainer.state, jax.random.key(5)
  alone = train.make_learn(trainer.plain, DREAMER.batch, DREAMER.length)
  copy = lambda tree: jax.tree.map(jnp.copy, tree)
  one = [alone(*copy(jax.tree.map(lambda x: x[None], seed((state.train, state.replay), g))), k, Weights(), np.ones(1, bool), 2)
         for g, k in enumerate(jax.random.split(key, SEEDS))]
  all_ = trainer.learn["pure"](*copy((state.train, state.replay)), key, Weights(), np.ones(SEEDS, bool), 2)
  for g in range(SEEDS):
    for (path, a), b in zip(jax.tree.leaves_with_path(one[g]), jax.tree.leaves(seed(all_, g))):
      a, b = np.asarray(a[0], np.float64), np.asarray(b, np.float64)
      # two programs of the same arithmetic; after 2 updates they differ by float32 rounding, latents by that of float16
      np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-4 * max(1.0, np.abs(a).max()), err_msg=jax.tree_util.keystr(path))
  first = np.asarray(jax.tree.leaves(all_[0].params)[0])
  assert np.abs(first[0] - first[1]).max() > 1e-3  # they are different seeds


def test_a_seed_that_fails_stops_alone_and_is_named(short_walker, tmp_path, same, capfd, monkeypatch):
  monkeypatch.chdir(tmp_path)  # MuJoCo logs actions that are not finite into the working folder
  sound, hurt = make_trainer(short_walker, tmp_path / "sound"), make_trainer(short_walker, tmp_path / "hurt")
  for trainer in (sound, hurt):
    trainer.step()
  params = hurt.state.train.params
  bias = params["rew"]["out"]["bias"].at[1, 0].set(jnp.nan)
  params = {**params, "rew": {**params["rew"], "out": {**params["rew"]["out"], "bias": bias}}}
  hurt.state = hurt.state._replace(train=hurt.state.train._replace(params=params))
  at = int(hurt.state.train.updates[1])
  frozen = jax.tree.map(jnp.copy, seed(hurt.state.train, 1))
  rows = [hurt.step() for _ in range(2)]
  for _ in range(2):
    sound.step()
  assert list(hurt.failed) == [1] and hurt.failed[1] == f"loss/rew is not finite, or above 1e+06, in update {at + 1}"
  said = capfd.readouterr().err
  assert said.count("numeric failure of seed 1") == 1
  for g in (0, 2):
    assert same(seed(hurt.state.train, g), seed(sound.state.train, g)) and same(seed(hurt.state.replay, g), seed(sound.state.replay, g))
  assert same(seed(hurt.state.train, 1), frozen)  # nothing of the update at fault remains
  assert [r["failed_seeds"] for r in rows] == [1, 1] and all(np.isfinite(r["opt/loss"]) for r in rows)
  assert hurt.updates == sound.updates
  each = [rows[-1][f"return/{g}"] for g in range(SEEDS)]  # returns are kept apart, and all robots have equally many episodes
  np.testing.assert_allclose(np.mean(each), rows[-1]["return"], rtol=1e-6)
  assert len(set(each)) == SEEDS
  hurt.save()
  again = make_trainer(short_walker, tmp_path / "hurt")
  again.resume()
  assert again.failed == hurt.failed
  again.step()
  assert same(seed(again.state.train, 1), frozen)


def test_when_every_seed_fails_the_training_ends(short_walker, tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  trainer = make_trainer(short_walker, tmp_path)
  trainer.step()
  trainer.state = trainer.state._replace(train=trainer.state.train._replace(params=jax.tree.map(lambda x: x * jnp.nan, trainer.state.train.params)))
  with pytest.raises(FileError, match="numeric failure of every seed") as e:
    for _ in range(2):
      trainer.step()
  assert "\n" not in str(e.value)


DEVICES = """
import sys
from mjx_cl import runtime; runtime.setup()
import jax, numpy as np
assert len(jax.devices()) == {devices}
sys.path.insert(0, {tests!r})
import test_seeds
from mjx_cl import envs, train
env = envs.make("walker", "native")
env.spec = env.spec._replace(episode_steps=12)
trainer = train.Trainer(env, test_seeds.DREAMER, test_seeds.CONFIG, {out!r}, seeds=2)
assert (trainer.mesh is not None) == ({devices} > 1)
while trainer.updates < 4:
  trainer.step()
if trainer.mesh is not None:
  leaf = jax.tree.leaves(trainer.state.train.params)[0]
  assert len(leaf.sharding.device_set) == 2 and leaf.addressable_shards[0].data.shape[0] == 1
trainer.save()
second = train.Trainer(env, test_seeds.DREAMER, test_seeds.CONFIG, {out!r}, seeds=2)
second.resume()
leaves = [np.asarray(x) for x in jax.tree.leaves(second.state.train)]
np.savez({out!r} + "/state.npz", *leaves)
at = second.updates
second.step()
assert second.updates > at  # what was read meets what is spread over devices
"""


def test_two_devices_equal_one(tmp_path):
  """The same training on one and on two host devices, through a checkpoint; the programs differ, so bits may."""
  out = {}
  for devices in (1, 2):
    folder = tmp_path / str(devices)
    flags = f"--xla_force_host_platform_device_count={devices} --xla_backend_optimization_level=0"  # compiles sooner, see quick.py
    code = DEVICES.format(devices=devices, tests=str(pathlib.Path(__file__).parent), out=str(folder))
    done = subprocess.run([sys.executable, "-c", code], env=os.environ | {"XLA_FLAGS": flags}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    with np.load(folder / "state.npz") as z:
      out[devices] = [z[k] for k in z.files]
  for a, b in zip(out[1], out[2]):
    np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5 * max(1.0, float(np.abs(a).max())))  # 4 updates in float32, two programs
