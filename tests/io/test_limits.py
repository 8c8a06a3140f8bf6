"""A limit of the address space, and what is raised where memory has run out."""

import os
import resource
import subprocess
import sys

import psutil
import pytest

from mjx_cl.errors import FileError
from mjx_cl.io import limits, memory

NULL = "<built-in function isinstance> returned NULL without setting an exception"


def of(error, cause=None):
  """An error with what it comes of."""
  error.__cause__ = cause
  return error


@pytest.mark.parametrize(
  "error",
  [
    MemoryError(),
    MemoryError("std::bad_alloc"),
    RuntimeError("std::bad_alloc"),
    RuntimeError("RESOURCE_EXHAUSTED: Failed to allocate request for 8.00GiB on device ordinal 0"),
    RuntimeError("INTERNAL: Traceback ... MemoryError: Unable to allocate 1.00 GiB"),
    ImportError("libparquet.so.2600: failed to map segment from shared object"),
    ImportError("libx.so: cannot allocate memory in static TLS block"),
    OSError(12, "Cannot allocate memory"),
    of(SystemError("error return without exception set"), MemoryError()),
    of(ValueError("x"), of(KeyError("y"), MemoryError())),
  ],
)
def test_foreign_words_for_too_little_memory(error):
  assert limits.ran_out(error)


@pytest.mark.parametrize(
  "error",
  [
    None,
    ValueError("x"),
    ImportError("No module named 'x'"),
    SystemError(NULL),
    RuntimeError("RESOURCE_EXHAUSTED: Error opening [OS error 24: EMFILE Too many open files]"),
    of(ValueError("x"), KeyError("y")),
  ],
)
def test_other_errors_are_not_of_memory(error, monkeypatch):
  monkeypatch.setattr(limits, "address_space", lambda: None)
  assert not limits.ran_out(error)


def test_c_code_without_a_reason_lacks_memory_where_that_is_limited(monkeypatch):
  monkeypatch.setattr(limits, "address_space", lambda: 2**30)
  assert limits.ran_out(SystemError(NULL)) and not limits.ran_out(ValueError("x"))


def test_too_little_address_space_is_refused_before_jax_starts(monkeypatch):
  for limit, fits in ((None, True), (limits.LEAST, True), (2**30, False)):
    monkeypatch.setattr(limits, "address_space", lambda limit=limit: limit)
    if fits:
      limits.check()
    else:
      with pytest.raises(FileError, match="limited to 1.0 GiB .ulimit -v., 2 GiB or more"):
        limits.check()


@pytest.mark.skipif(sys.platform != "linux", reason="RLIMIT_AS binds on Linux")
def test_a_limit_of_1_gib_is_one_line(tmp_path):
  """XLA's threads would end the process with `std::bad_alloc`."""
  done = subprocess.run(
    [sys.executable, "-m", "mjx_cl", "detect", "none.csv", "--nominal", "none.csv"],
    capture_output=True,
    text=True,
    timeout=1200,
    cwd=tmp_path,
    env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (2**30, 2**30)),
  )
  assert (done.returncode, done.stdout) == (1, "") and done.stderr == (
    "mjx-cl: address space is limited to 1.0 GiB (ulimit -v), 2 GiB or more are needed; raise the "
    "limit\n"
  )


def test_free_memory_is_within_the_address_space(monkeypatch):
  own = psutil.Process().memory_info().vms
  for more, left in ((2**20, 2**20), (0, 0), (-(2**30), 0)):
    monkeypatch.setattr(limits, "address_space", lambda more=more: own + more)
    monkeypatch.setattr(
      memory.psutil.Process, "memory_info", lambda self: type("", (), {"vms": own})
    )
    assert memory.free() == left
