"""Memory of the machine: what is free of it, within a container's limit, and what a process grows
to.
"""

from __future__ import annotations

import pathlib

import jax
import psutil

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

  By runs of ten walkers an arm, native physics: 2.7 GiB of 0.8 to the end (two arms, 25,000 steps);
  up to a third save, traces still short, 2.5 of 0.8 (one arm, 64,000) and 3.6 of 1.6 (two). Nothing
  larger was measured.
  """
  return PROCESS + int(GROWTH * need) if jax.default_backend() == "cpu" else need


def container(
  root: str | pathlib.Path = "/sys/fs/cgroup", groups: str | pathlib.Path = "/proc/self/cgroup"
) -> int | None:
  """Bytes that the memory limit of this process's control group (a container, a batch job) leaves,
  never below 0; None where there is no limit.

    min over the group and those it lies in of  limit - (used - page cache that can be reclaimed at
    once)

  Args:
    root: where control groups are mounted: version 2 itself, version 1 with its memory controller
      in `memory`.
    groups: file that names the groups of this process, a line `number:controllers:path` each.
  """
  versions = (
    (pathlib.Path(root), "0::", "memory.max", "memory.current", ("inactive_file",)),
    (
      pathlib.Path(root, "memory"),
      ":memory:",
      "memory.limit_in_bytes",
      "memory.usage_in_bytes",
      ("total_inactive_file", "inactive_file"),
    ),
  )
  left = []
  for mount, sign, limit, used, caches in versions:
    own = [
      line.partition(sign)[2].strip("/") for line in _text(groups).splitlines() if sign in line
    ]
    path = mount.joinpath(*own[:1])
    for folder in {mount, *(p for p in (path, *path.parents) if p.is_relative_to(mount))}:
      most, now = _text(folder / limit).strip(), _text(folder / used).strip()
      if (
        not (most.isdigit() and now.isdigit()) or int(most) >= NO_LIMIT
      ):  # `max`, and files that are not there
        continue
      stat = dict(
        line.split()[:2] for line in _text(folder / "memory.stat").splitlines() if " " in line
      )
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
  """Bytes free on the device that computes; of a CPU's memory what the machine has and what the
  container may take, whichever is less.
  """
  stats = None if jax.default_backend() == "cpu" else jax.local_devices()[0].memory_stats()
  if stats:
    return stats["bytes_limit"] - stats["bytes_in_use"]
  machine, limited = psutil.virtual_memory().available, container()
  return machine if limited is None else min(machine, limited)


def held() -> int:
  """Bytes that this process holds already of what `resident` says it will; 0 where that is an
  accelerator's.
  """
  return psutil.Process().memory_info().rss if jax.default_backend() == "cpu" else 0
