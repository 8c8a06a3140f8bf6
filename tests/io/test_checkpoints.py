"""Checkpoints: what is read has the placement of what it takes the place of; a good one is never
lost to a fault of the machine, a broken one is set aside.
"""

import errno
import os
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl.errors import FileError
from mjx_cl.io.checkpoints import Checkpoints

TREE = {"w": jnp.arange(6.0).reshape(2, 3), "n": jnp.int32(4)}


@pytest.fixture
def folder(tmp_path):
  """Holds checkpoints 1 and 2."""
  store = Checkpoints(tmp_path / "checkpoints")
  for number in (1, 2):
    store.save(number, TREE | {"n": jnp.int32(number)}, {"number": number})
  store.close()
  return tmp_path / "checkpoints"


def contents(folder):
  return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def break_(folder):
  for file in folder.rglob("*"):
    if file.is_file():
      file.write_bytes(b"\x93\x00garbage")


def wrapped(text):
  """As orbax wraps what TensorStore says."""
  error = Exception("Encountered error while reading array index")
  error.__cause__ = ValueError(text)
  return error


@pytest.mark.parametrize("newest_is_broken", [False, True])
@pytest.mark.parametrize(
  "error",
  [
    OSError(errno.EMFILE, "Too many open files"),
    MemoryError("8 GiB"),
    PermissionError(errno.EACCES, "Permission denied"),
    wrapped(
      'RESOURCE_EXHAUSTED: Error opening "manifest.ocdbt" [OS error 24: EMFILE Too many open files]'
    ),
    wrapped("Error reading [OS error 5: EIO]"),
  ],
  ids=str,
)
def test_what_is_not_the_files_fault_changes_nothing(folder, error, newest_is_broken, monkeypatch):
  if newest_is_broken:  # and the one before it cannot be read for another reason
    break_(folder / "2")
  before = contents(folder)
  store = Checkpoints(folder)
  read = store._manager.restore

  def fails(number, **kwargs):
    if newest_is_broken and number == 2:
      return read(number, **kwargs)
    raise error

  monkeypatch.setattr(store._manager, "restore", fails)
  with pytest.raises(
    FileError,
    match=f"cannot read checkpoint {1 if newest_is_broken else 2} in .*nothing was changed",
  ) as e:
    store.load(TREE)
  assert "\n" not in str(e.value) and contents(folder) == before and store.latest() == 2
  monkeypatch.undo()
  assert store.load(TREE)[1] == {"number": 1 if newest_is_broken else 2}


CHILD = """
import os, resource, sys
from mjx_cl.io.checkpoints import Checkpoints
from mjx_cl.errors import FileError
import jax.numpy as jnp
store, like = Checkpoints(sys.argv[1]), {"w": jnp.zeros((2, 3)), "n": jnp.int32(0)}
store.load(like)  # whatever is imported on the way
resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) - 1, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
try:
  store.load(like)
except FileError as e:
  print(e)
os._exit(0)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="counts open files in /proc")
def test_too_many_open_files_lose_no_checkpoint(folder):
  """The real thing: no descriptor is left to read with."""
  before = contents(folder)
  done = subprocess.run(
    [sys.executable, "-u", "-c", CHILD, str(folder)],
    env=os.environ | {"JAX_PLATFORMS": "cpu"},
    capture_output=True,
    text=True,
    timeout=1200,
  )
  assert (
    done.stdout.startswith("cannot read checkpoint 2 in ")
    and "nothing was changed" in done.stdout
    and done.stdout.count("\n") == 1
  ), done.stderr
  assert contents(folder) == before and Checkpoints(folder).load(TREE)[1] == {"number": 2}


def test_a_broken_checkpoint_is_set_aside_and_its_number_is_free(folder, same, capfd):
  for name in ("2.broken", "2.broken-2"):  # twice the same number
    if name != "2.broken":
      shutil.rmtree(folder / "2")
      shutil.copytree(folder / "1", folder / "2")
    break_(folder / "2")
    broken = contents(folder / "2")
    store = Checkpoints(folder)
    tree, meta = store.load(TREE)
    assert meta == {"number": 1} and same(tree, TREE | {"n": jnp.int32(1)}) and store.latest() == 1
    assert (
      contents(folder / name) == broken
      and capfd.readouterr().err.count("it is broken, going on from checkpoint 1") == 1
    )
    store.save(2, TREE, {"number": 2})
    store.close()
  assert Checkpoints(folder).load(TREE)[1] == {"number": 2} and capfd.readouterr().err == ""
  store = Checkpoints(folder)
  for number in (3, 4, 5):
    store.save(number, TREE, {})
  assert sorted(p.name for p in folder.iterdir()) == [
    "2.broken",
    "2.broken-2",
    "4",
    "5",
  ]  # what is set aside does not count among the two


FULL = """
import resource, signal, sys
from mjx_cl.io import runtime
runtime.setup()
import numpy as np
from mjx_cl.cli import app
from mjx_cl.io.checkpoints import Checkpoints
store = Checkpoints(sys.argv[1])
rng = np.random.default_rng(0)
tree = {name: rng.random((200, 1000)) for name in "abcd"}  # what no compression makes small
store.save(1, {"a": np.zeros(3)}, {})
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))
sys.exit(app.attempt(lambda: store.save(2, tree, {})))
"""


def test_a_checkpoint_that_does_not_fit_is_one_line(tmp_path):
  """Orbax, TensorStore and asyncio say nothing of their own; half a checkpoint takes no room."""
  done = subprocess.run(
    [sys.executable, "-c", FULL, str(tmp_path / "store")],
    capture_output=True,
    text=True,
    timeout=1200,
    env=os.environ | {"JAX_PLATFORMS": "cpu"},
  )
  assert done.returncode == 1
  (line,) = [x for x in done.stderr.splitlines() if "cpu_aot" not in x]
  assert line == (
    f"mjx-cl: cannot write checkpoint 2 in {tmp_path / 'store'}: File too large; the earlier ones "
    "are intact"
  )
  assert [p.name for p in (tmp_path / "store").iterdir()] == ["1"]


@pytest.mark.parametrize("other", [{"n": jnp.float32(4)}, {"w": jnp.zeros((2, 3), jnp.float16)}])
def test_another_dtype_is_refused_and_not_cast(folder, other):
  before, (name,) = contents(folder), other
  with pytest.raises(
    FileError,
    match=(
      f"checkpoint 2 in .* another version: {name} is {TREE[name].dtype} there, "
      f"{other[name].dtype} here"
    ),
  ) as e:
    Checkpoints(folder).load(TREE | other)
  assert "\n" not in str(e.value) and contents(folder) == before


def test_arrays_come_back_as_free_or_bound_as_they_were(tmp_path):
  """An array that is bound to a device where it was free before would be another program to
  `jax.jit`.
  """
  device = jax.devices()[0]
  tree = {
    "free": jnp.arange(6.0).reshape(2, 3),
    "bound": jax.device_put(jnp.arange(4), device),
    "host": np.arange(3),
    "key": jax.random.key(3),
    "keys": jax.random.split(jax.random.key(4), 2),
    "empty": jnp.zeros((0, 2)),
    "half": jnp.ones(2, jnp.float16),
    "flag": jnp.array([True, False]),
  }
  checkpoints = Checkpoints(tmp_path / "c")
  checkpoints.save(1, tree, {"n": 7})
  like = jax.tree.map(
    lambda x: (
      x
      if x.dtype == tree["key"].dtype
      else (np if isinstance(x, np.ndarray) else jnp).zeros_like(x)
    ),
    tree,
  ) | {"bound": jax.device_put(jnp.zeros(4, int), device)}
  got, meta = checkpoints.load(like)
  checkpoints.close()
  assert meta == {"n": 7} and got.keys() == tree.keys()
  for name, x in tree.items():
    y = got[name]
    assert (type(y), y.shape, y.dtype) == (type(x), x.shape, x.dtype), name
    assert (
      getattr(y, "committed", None)
      == getattr(x, "committed", None)
      == {"bound": True, "host": None}.get(name, False)
    ), name
    data = lambda v: np.asarray(jax.random.key_data(v) if "key" in name else v)
    np.testing.assert_array_equal(data(x), data(y), err_msg=name)
  program = jax.jit(lambda t: t["free"].sum() + t["half"].sum())
  program({k: tree[k] for k in ("free", "half")})
  program({k: got[k] for k in ("free", "half")})
  assert program._cache_size() == 1
