"""Memory of the machine: what is free of it, within a container's limit, and what a process grows
to.
"""

import pathlib

import jax
import psutil

from mjx_cl.io import limits

MARGIN = 0.85  # share of the free memory that may be planned for
PROCESS = 7 * 2**28  # bytes of Python, its libraries, compiled programs and their scratch memory
# of what weights and replays take: weights once more while they are saved, traces, what the
# allocator cannot use
GROWTH = 1.5

# bytes; control groups of version 1 say a number of this size where there is no limit
NO_LIMIT = 2**60


def resident(need: int) -> int:
  """Bytes that a process grows to whose weights and replays take `need` bytes; of an accelerator's
  memory those alone.
  """
  return PROCESS + int(GROWTH * need) if jax.default_backend() == "cpu" else need


def container(
  root: str | pathlib.Path = "/sys/fs/cgroup", groups: str | pathlib.Path = "/proc/self/cgroup"
) -> int | None:
  """Bytes that the memory limit of this process's control group (a container, a batch job) leaves,
  never below 0; None where there is no limit.

    min over the group and those it lies in of
      limit - (used - page cache that can be reclaimed at once)

  Args:
    root: where control groups are mounted: version 2 itself, version 1 with its memory controller
      in `memory`.
    groups: file that names the groups of this process, a line `number:controllers:path` each.
  """
  names = _text(groups).splitlines()
  versions = (
    (
      pathlib.Path(root),
      next((x.partition("0::")[2] for x in names if "0::" in x), ""),
      ("memory.max", "memory.current"),
      ("inactive_file",),
    ),
    (
      pathlib.Path(root, "memory"),
      next((x.partition(":memory:")[2] for x in names if ":memory:" in x), ""),
      ("memory.limit_in_bytes", "memory.usage_in_bytes"),
      ("total_inactive_file", "inactive_file"),
    ),
  )
  left = []
  for mount, own, files, caches in versions:
    path = mount / own.strip("/")
    for folder in {mount, *(p for p in (path, *path.parents) if p.is_relative_to(mount))}:
      most, now = (_text(folder / name).strip() for name in files)
      # `max`, and files that are not there, are no numbers
      if most.isdigit() and now.isdigit() and int(most) < NO_LIMIT:
        lines = (line.split() for line in _text(folder / "memory.stat").splitlines())
        stat = {words[0]: words[1] for words in lines if len(words) > 1}
        cache = next((int(stat[name]) for name in caches if name in stat), 0)
        left.append(max(0, int(most) - max(0, int(now) - cache)))
  return min(left, default=None)


def _text(path: pathlib.Path | str) -> str:
  """What a file says; nothing where it cannot be read."""
  try:
    return pathlib.Path(path).read_text()
  except (OSError, UnicodeDecodeError):
    return ""


def free() -> int:
  """Bytes free on the device that computes; of a CPU's memory what the machine has, and what the
  container and the process may take, whichever is least.
  """
  stats = None if jax.default_backend() == "cpu" else jax.local_devices()[0].memory_stats()
  if stats:
    return stats["bytes_limit"] - stats["bytes_in_use"]
  left = [psutil.virtual_memory().available]
  if (limited := container()) is not None:
    left.append(limited)
  if (space := limits.address_space()) is not None:
    left.append(max(0, space - psutil.Process().memory_info().vms))
  return min(left)


def held() -> int:
  """Bytes that this process holds already of what `resident` says it will; 0 where that is an
  accelerator's.
  """
  return psutil.Process().memory_info().rss if jax.default_backend() == "cpu" else 0
