"""Devices, compile cache, and the two programs that have been known to hang: many MJX robots,
many physics callbacks.
"""

import gc
import os
import pathlib
import subprocess
import sys

import jax
import mujoco
import numpy as np
import pytest

from mjx_cl.cli import app
from mjx_cl.io import runtime
from mjx_cl.physics.native import Native

FAULTS_OF_REUSE = """
import resource
from mjx_cl.io import runtime
assert runtime.keep_memory() is {keeps}
import numpy as np
def touch():
  before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
  x = np.ones(2**24, np.uint8)  # 16 MiB, freed at once
  del x
  return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
touch()
print(touch())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's allocator")
@pytest.mark.parametrize("keeps", [True, False])
def test_freed_memory_is_kept_unless_the_user_has_decided(keeps):
  """A block of 16 MiB that is freed and taken again: no fresh pages where memory is kept, 4,096 (or
  some huge ones) where it is mapped anew.
  """
  env = {k: v for k, v in os.environ.items() if not k.startswith("MALLOC_")} | (
    {} if keeps else {"MALLOC_MMAP_THRESHOLD_": "131072"}
  )
  out = subprocess.run(
    [sys.executable, "-c", FAULTS_OF_REUSE.format(keeps=keeps)],
    env=env,
    capture_output=True,
    text=True,
    check=True,
  )
  assert (int(out.stdout) < 4) is keeps


GIVEN_BACK = """
import os
from mjx_cl.io import runtime
assert runtime.keep_memory()
import numpy as np
held = lambda: int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
before = held()
blocks = [np.ones(2**20, np.uint8) for _ in range(256)]
del blocks
kept = held()
assert runtime.give_back()
print(before, kept, held())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's allocator")
def test_kept_memory_is_given_back_when_asked():
  """256 MiB that were freed stay with the process, and leave it at `give_back`."""
  env = {k: v for k, v in os.environ.items() if not k.startswith("MALLOC_")}
  out = subprocess.run(
    [sys.executable, "-c", GIVEN_BACK], env=env, capture_output=True, text=True, check=True
  )
  before, kept, after = map(float, out.stdout.split())
  assert kept > before + 200 and after < before + 50


def test_cache_dir_follows_the_environment(monkeypatch, tmp_path):
  monkeypatch.setenv("MJX_CL_CACHE", str(tmp_path / "here"))
  assert runtime.cache_dir() == tmp_path / "here"
  monkeypatch.setenv("MJX_CL_CACHE", "~/there")
  assert runtime.cache_dir() == pathlib.Path.home() / "there"
  monkeypatch.delenv("MJX_CL_CACHE")
  monkeypatch.setattr(runtime.sys, "platform", "linux")
  monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
  assert runtime.cache_dir() == tmp_path / "mjx_cl"
  monkeypatch.setattr(runtime.sys, "platform", "darwin")
  assert runtime.cache_dir() == pathlib.Path.home() / "Library/Caches/mjx_cl"


def test_setup_has_set_cache_and_dispatch():
  assert jax.config.jax_compilation_cache_dir == os.environ["MJX_CL_CACHE"]
  assert jax.config.values["jax_cpu_enable_async_dispatch"] is False


def test_setup_is_idempotent(monkeypatch):
  calls = []
  monkeypatch.setattr(runtime, "keep_memory", lambda: calls.append(1))
  monkeypatch.setattr(runtime, "_done", False)
  for _ in range(2):
    runtime.setup()
  assert calls == [1]  # a second call touches nothing


def test_setup_survives_a_home_that_cannot_be_written(monkeypatch, tmp_path):
  (tmp_path / "file").write_text("")
  before = jax.config.jax_compilation_cache_dir
  monkeypatch.setattr(runtime, "_done", False)
  monkeypatch.setenv(
    "MJX_CL_CACHE", str(tmp_path / "file" / "cache")
  )  # a folder below a file: OSError for every user, root too
  runtime.setup()
  assert jax.config.jax_compilation_cache_dir == before


@pytest.mark.parametrize(
  "cores, seeds, devices",
  [(2, 10, 2), (2, 3, 1), (4, 9, 3), (4, 2, 2), (1, 8, 1), (16, 10, 10), (2, 1, 1)],
)
def test_cores_share_seeds_evenly(monkeypatch, cores, seeds, devices):
  monkeypatch.setattr(runtime, "cores", lambda: list(range(cores)))
  assert runtime.sharing(seeds) == devices


@pytest.mark.parametrize(
  "asked, own, want",
  [
    (2, {}, 2),
    (1, {}, 1),
    (2, {"XLA_FLAGS": "--xla_force_host_platform_device_count=3"}, 3),
    (2, {"JAX_NUM_CPU_DEVICES": "4"}, 4),
  ],
)
def test_a_cpu_counts_as_many_devices_as_asked_unless_the_user_has_decided(asked, own, want):
  env = {k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", "JAX_NUM_CPU_DEVICES")} | own
  code = (
    f"from mjx_cl.io import runtime; runtime.setup({asked}); import jax; print(len(jax.devices()))"
  )
  assert (
    int(
      subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True
      ).stdout
    )
    == want
  )


@pytest.mark.parametrize(
  "argv, devices",
  [
    (["train", "walker", "--seeds", "4"], 2),
    (["train", "walker"], 1),
    (["run", "walker", "--seeds", "4"], 1),
  ],
)
def test_the_seeds_of_a_training_are_shared_by_the_cores(monkeypatch, argv, devices):
  asked = []
  monkeypatch.setattr(runtime, "cores", lambda: [0, 1])
  monkeypatch.setattr(runtime, "setup", lambda devices=1: asked.append(devices))
  monkeypatch.setattr(app, "DO", {kind: lambda command: None for kind in app.DO})
  assert app.main(argv) == 0 and asked == [devices]


@pytest.mark.slow
def test_256_mjx_walkers_finish_and_agree_with_mujoco(walker, pair, fields, crowd, within):
  init, step = pair["mjx"]
  qpos, qvel = (
    np.concatenate([x[1][:128]] * 2) for x in crowd
  )  # robot i + 128 is robot i once more
  ctrl = np.random.default_rng(1).uniform(-1, 1, (3, 128, 6)).astype(np.float32)

  def run():
    state = init(qpos, qvel)
    for c in ctrl:
      state, out = step(fields, state, np.concatenate([c, c]))
    return {name: np.asarray(x) for name, x in out.items()}

  out = within(1200, run)
  for x in out.values():
    np.testing.assert_array_equal(x[:128], x[128:])
  error = []
  for i in range(0, 128, 8):
    data = mujoco.MjData(walker)
    data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
    for c in ctrl[:, i]:
      data.ctrl[:] = c
      mujoco.mj_step(walker, data, 10)
    assert np.abs(data.qpos - qpos[i]).max() > 0.05  # it moved far more than the tolerance
    error.append(
      [np.abs(data.qpos - out["qpos"][i]).max(), np.abs(data.qvel - out["qvel"][i]).max()]
    )
  position, speed = np.median(error, 0)
  assert position < 5e-6 and speed < 2e-4, (
    error
  )  # measured: 5.5e-7, 1.5e-5; contact outliers are test_physics.py's business


@pytest.mark.slow
def test_20000_callbacks_with_160_streams(walker, within):
  """The known risk is a deadlock (jax issues 24255, 25861); the oracle is plain mj_step, bit for
  bit. The walkers float, which takes MuJoCo a third of the time; what crosses JAX is as large.
  """
  streams, calls, watched = 160, 20_000, np.array([3, 158])
  walker = walker.__copy__()
  walker.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
  walker.opt.gravity[:] = 0
  native = Native(walker, substeps=1)
  rng = np.random.default_rng(2)
  gear = (np.asarray(walker.actuator_gear) * rng.uniform(0.5, 1.5, (streams, 6, 1))).astype(
    np.float32
  )
  qpos = np.concatenate(
    [np.zeros((streams, 2)), rng.uniform(-1, 1, (streams, 1)), rng.uniform(-0.3, 0, (streams, 6))],
    1,
  ).astype(np.float32)

  @jax.jit
  def run(state, key):
    def one(state, k):
      ctrl = jax.random.uniform(jax.random.fold_in(key, k), (streams, 6), minval=-1, maxval=1)
      state, _ = jax.vmap(native.step)({"actuator_gear": gear}, state, ctrl)
      return state, ctrl[watched]

    return jax.lax.scan(one, state, np.arange(calls))

  state = jax.vmap(native.init)(qpos, np.zeros((streams, 9), np.float32))
  state, ctrl = within(1200, lambda: jax.tree.map(np.asarray, run(state, jax.random.key(0))))
  spec = mujoco.mjtState.mjSTATE_INTEGRATION
  for j, i in enumerate(watched):
    model, data, row = (
      load_geared(walker, gear[i]),
      mujoco.MjData(walker),
      np.empty(mujoco.mj_stateSize(walker, spec)),
    )
    data.qpos[:] = qpos[i]
    for c in ctrl[:, j]:
      data.ctrl[:] = c
      mujoco.mj_step(model, data)
    mujoco.mj_getState(model, data, row, spec)
    assert data.time == pytest.approx(50.0)  # 20,000 steps of 0.0025 s
    np.testing.assert_array_equal(state[i].view(np.float64), row)


def load_geared(model, gear):
  """Copy of a model with other gears."""
  model = model.__copy__()
  model.actuator_gear[:] = gear
  return model


def test_the_collector_runs_seldom_unless_its_user_has_set_it():
  held = gc.get_threshold()
  try:
    gc.set_threshold(700, 10, 10)
    assert runtime.collect_seldom() and gc.get_threshold()[0] > 700
    gc.set_threshold(123, 4, 5)
    assert not runtime.collect_seldom() and gc.get_threshold() == (123, 4, 5)
  finally:
    gc.set_threshold(*held)
