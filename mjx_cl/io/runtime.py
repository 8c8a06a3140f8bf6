"""What must be decided before JAX starts its first backend: devices, compile cache, dispatch.

Importing this module is free of JAX; `setup()` is idempotent. The command line calls it before a
command that computes; a program of one's own calls `mjx_cl.setup()` before its first use of JAX.
"""

import ctypes
import functools
import gc
import importlib.metadata
import os
import pathlib
import platform
import re
import subprocess
import sys
from typing import Any

from mjx_cl import BENCHMARK
from mjx_cl.io import limits

# gc's thresholds where nobody has set others: up to Python 3.11, and from 3.12 on
PYTHONS_OWN = ((700, 10, 10), (2000, 10, 10), (2000, 10, 0))
_DEVICES_FLAG = "--xla_force_host_platform_device_count"
_done = False


def cache_dir() -> pathlib.Path:
  """Folder of JAX's persistent compile cache: `MJX_CL_CACHE`, else the platform's user cache
  folder.
  """
  mac = "~/Library/Caches" if sys.platform == "darwin" else None
  users = mac or os.environ.get("XDG_CACHE_HOME", "~/.cache")
  return pathlib.Path(os.environ.get("MJX_CL_CACHE") or f"{users}/mjx_cl").expanduser()


def _glibc(function: str, *arguments: int) -> bool:
  """What a function of glibc's allocator answers; False where there is no glibc."""
  try:
    return sys.platform == "linux" and bool(getattr(ctypes.CDLL(None), function)(*arguments))
  except (AttributeError, OSError):
    return False


def keep_memory() -> bool:
  """Tells glibc to keep freed memory instead of handing every large block back to the system; True
  where that was done.

  XLA takes the scratch memory of a program anew at each call. Through mmap every call then touches
  fresh pages, and updates take longer for the page faults. The process stays as large as its peak.
  A user who has set MALLOC_MMAP_MAX_, MALLOC_MMAP_THRESHOLD_ or MALLOC_TRIM_THRESHOLD_ is left
  alone; so is every other C library.
  """
  trim_threshold, mmap_max = -1, -4  # M_TRIM_THRESHOLD and M_MMAP_MAX of malloc.h
  own = ("MALLOC_MMAP_MAX_", "MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_")
  return (
    os.environ.keys().isdisjoint(own)
    and _glibc("mallopt", mmap_max, 0)
    and _glibc("mallopt", trim_threshold, -1)
  )


def give_back() -> bool:
  """Hands free memory back to the system where glibc keeps it (`keep_memory`); True where that was
  done. For after what needed much and comes seldom: a save.
  """
  return _glibc("malloc_trim", 0)


def collect_seldom() -> bool:
  """Lets Python's garbage collector run seldom; True where that was done.

  Tracing a program makes hundreds of thousands of objects, hardly any of them garbage: at Python's
  own thresholds collecting takes half of a trace's time. A user's own thresholds are left alone.
  """
  if gc.get_threshold() not in PYTHONS_OWN:
    return False
  gc.set_threshold(50_000, 20, 50)
  return True


def cores() -> list[int]:
  """Numbers of the cores that this process may use; where the system has no affinity, of all."""
  return (
    sorted(os.sched_getaffinity(0))
    if hasattr(os, "sched_getaffinity")
    else list(range(os.cpu_count() or 1))
  )


def sharing(seeds: int) -> int:
  """How many of the cores share `seeds` seeds evenly: the greatest divisor of `seeds` that is no
  more than the cores.
  """
  return max(n for n in range(1, min(seeds, len(cores())) + 1) if seeds % n == 0)


def seeds_by() -> str:
  """How the seeds of a device share a program of updates (learn.make_learn): `map`, one after
  another, on a CPU; `vmap`, all in each product, elsewhere.

  On CPUs both take the same time, and `map` needs the scratch memory of one seed. A GPU is not
  filled by one seed.
  """
  import jax

  return "map" if jax.default_backend() == "cpu" else "vmap"


def quiet() -> None:
  """Keeps XLA's notes from standard error, if JAX is not imported yet and the user has not chosen:
  its loader prints an error of a page for each cached program over two pseudo features of the
  compiler that no CPU reports.
  """
  os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def setup(devices: int = 1) -> None:
  """Sets the count of devices, the compile cache, the allocator, the garbage collector and
  synchronous CPU dispatch. Call before the first JAX computation.

  Args:
    devices: as how many devices a CPU counts. A program that is sharded over them keeps the cores
      busy with a share each, which a single program does only within its larger products. What is
      not sharded stays on the first device and has all cores as before. A count in the user's own
      XLA_FLAGS or JAX_NUM_CPU_DEVICES is left as it is.

  Synchronous dispatch: a jax.pure_callback converts its arguments on a thread of the CPU client,
  and with asynchronous dispatch that conversion can wait for itself (jax issues 24255 and 25861).
  Physics calls the host by name, without a conversion, but falls back to pure_callback where a
  jaxlib does not take that.

  Raises:
    FileError: where the address space is limited to less than JAX takes.
  """
  global _done
  if _done:
    return
  limits.check()
  _done = True
  keep_memory()
  collect_seldom()
  quiet()
  import jax

  theirs = _DEVICES_FLAG in os.environ.get("XLA_FLAGS", "") or "JAX_NUM_CPU_DEVICES" in os.environ
  if devices > 1 and not theirs:
    jax.config.update("jax_num_cpu_devices", devices)
  jax.config.update("jax_cpu_enable_async_dispatch", False)
  folder = cache_dir()
  try:
    folder.mkdir(parents=True, exist_ok=True)
  except OSError:
    return  # a read-only home: everything works, programs are compiled anew
  jax.config.update("jax_compilation_cache_dir", str(folder))
  # a run starts with hundreds of small programs
  jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
  jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def default_physics() -> str:
  """`native` on a CPU where mjbatch is installed, else `mjx`."""
  import jax

  if jax.default_backend() != "cpu":
    return "mjx"
  try:
    import mjbatch  # noqa: F401
  except ImportError:
    print("mjx-cl: mjbatch is not available on this platform, physics runs on mjx", file=sys.stderr)
    return "mjx"
  return "native"


PACKAGES = (
  "jax",
  "jaxlib",
  "mujoco",
  "mujoco-mjx",
  "mjbatch",
  "flax",
  "optax",
  "orbax-checkpoint",
  "numpy",
)


def provenance() -> dict[str, Any]:
  """Versions, machine and commit of this process, for config.json; cores: those that it may use;
  benchmark: version of suites, recordings and scores.
  """
  return {
    "benchmark": BENCHMARK,
    "versions": {name: _version(name) for name in PACKAGES},
    "python": platform.python_version(),
    "git_commit": _commit(),
    "machine": {
      "cpu": _cpu(),
      "cores": len(cores()),
      "system": platform.system(),
      "arch": platform.machine(),
    },
  }


def _version(package: str) -> str | None:
  try:
    return importlib.metadata.version(package)
  except importlib.metadata.PackageNotFoundError:
    return None


@functools.cache
def _commit() -> str | None:
  """Commit of the source tree this package runs from, None outside a checkout; asked once, since a
  later one is not what this process has loaded.
  """
  try:
    out = subprocess.run(
      ["git", "rev-parse", "HEAD"],
      cwd=pathlib.Path(__file__).parent,
      capture_output=True,
      text=True,
      timeout=5,
    )
  except (OSError, subprocess.SubprocessError):
    return None
  return out.stdout.strip() or None


def _cpu() -> str:
  info = pathlib.Path("/proc/cpuinfo")
  named = re.search(r"^model name.*?:(.*)", info.read_text() if info.exists() else "", re.M)
  return named[1].strip() if named else platform.processor() or platform.machine()
