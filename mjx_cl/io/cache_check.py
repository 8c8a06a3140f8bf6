"""Whether compiled programs are found again: a process compiles a small program, a second one has
to take it from the compile cache.
"""

import os
import pathlib
import subprocess
import sys
import tempfile
import time
from typing import NamedTuple

from mjx_cl.io import runtime

HIT = "/jax/compilation_cache/cache_hits"  # JAX's event
NAME = "mjx_cl_cache_check"  # of the program, and so of its file in the cache
PROBE = f"""
import sys
from mjx_cl.io import runtime
runtime.setup()
import jax
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
def {NAME}(x):
  return x * float(sys.argv[1])
jax.jit({NAME})(1.0).block_until_ready()
print({HIT!r} in events)
"""


class Found(NamedTuple):
  """What was found.

  Attributes:
    hit: the second process took the program from the cache.
    remedy: what to do where it did not, one line; "" where it did.
  """

  hit: bool
  remedy: str


def check(timeout_s: float = 120.0) -> Found:
  """Compiles a program that no cache holds yet in one process, then in a second one; removes it
  from the cache again.
  """
  folder = runtime.cache_dir()
  try:
    number = str(time.time_ns() % 10**9 + 0.5)
    said = [_probe(number, timeout_s) for _ in range(2)]
  except (OSError, subprocess.SubprocessError) as e:
    return Found(False, f"it could not be tried: {' '.join(str(e).split())[:200]}")
  finally:
    if folder.is_dir():
      for file in folder.glob(f"jit_{NAME}-*"):
        file.unlink(missing_ok=True)
  return Found(True, "") if said[1] else Found(False, _remedy(folder))


def _probe(number: str, timeout_s: float) -> bool:
  """Whether a new process has the program of `number` from the cache."""
  done = subprocess.run(
    [sys.executable, "-c", PROBE, number],
    capture_output=True,
    text=True,
    timeout=timeout_s,
    check=True,
    env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
  )
  return done.stdout.split()[-1:] == ["True"]


def _remedy(folder: pathlib.Path) -> str:
  """Why a program was not found again in the cache, as far as can be told, and what helps."""
  anew = "every command compiles its programs anew"
  other = "set MJX_CL_CACHE to a folder on a disk with room that this user may write to"
  if os.environ.get("JAX_ENABLE_COMPILATION_CACHE", "1").lower() in ("0", "false", "off", "no"):
    return f"{anew}: JAX_ENABLE_COMPILATION_CACHE turns the cache off; unset it"
  try:
    with tempfile.NamedTemporaryFile(dir=folder) as file:
      file.write(bytes(2**20))
      file.flush()
  except OSError as e:
    return f"{anew}: {folder} cannot be written ({e.strerror or e}); {other}"
  return f"{anew}: JAX found nothing in {folder}, though it can be written; remove it, or {other}"
