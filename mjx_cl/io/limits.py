"""Memory that a process may take by the limit of its address space, and what is raised where it has
run out. Free of JAX.
"""

import re
import sys

from mjx_cl.errors import FileError

if sys.platform != "win32":
  import resource

LEAST = 2**31  # bytes of address space below which JAX ends the process without a word
# XLA, C++, NumPy, the system and its linker; TensorStore says the first of open files as well
WORDS = re.compile(
  "RESOURCE_EXHAUSTED(?!.*(OS error|os_error))|MemoryError|bad_alloc|[Oo]ut of memory|"
  "annot allocate memory|failed to map segment|nable to allocate"
)


def address_space() -> int | None:
  """Bytes of address space that this process may have (`ulimit -v`); None: without limit."""
  if sys.platform == "win32":
    return None
  limit = resource.getrlimit(resource.RLIMIT_AS)[0]
  return None if limit == resource.RLIM_INFINITY else limit


def check() -> None:
  """Raises FileError where JAX has no room."""
  limit = address_space()
  if limit is not None and limit < LEAST:
    raise FileError(
      f"address space is limited to {limit / 2**30:.1f} GiB (ulimit -v), {LEAST / 2**30:.0f} GiB "
      "or more are needed; raise the limit"
    )


def ran_out(error: BaseException | None) -> bool:
  """Whether an error, or one that it comes of, says that memory has run out. C code that fails
  without a reason is taken for that where the address space is limited.
  """
  while error is not None:
    try:
      said = str(error)
    except BaseException:  # a foreign one's own method
      said = ""
    if isinstance(error, MemoryError) or WORDS.search(said):
      return True
    if isinstance(error, SystemError) and address_space() is not None:
      return True
    error = error.__cause__ or error.__context__
  return False
