"""Bytes that a training or a run will hold, known before anything is allocated."""

from __future__ import annotations

import bisect
import functools
import pathlib
from collections.abc import Callable
from typing import NamedTuple

from mjx_cl.errors import UserError
from mjx_cl.io import runtime
from mjx_cl.sizes import SIZES

MARGIN = 0.85  # share of the free memory that may be planned for
PROCESS = 7 * 2**28  # bytes of Python, its libraries, compiled programs and their scratch memory
# of what weights and replays take: weights once more while they are saved, traces, what the
# allocator cannot use
GROWTH = 1.5

NO_LIMIT = (
  2**60
)  # bytes; control groups of version 1 say a number of this size where there is no limit


def resident(need: int) -> int:
  """Bytes that a process grows to whose weights and replays take `need` bytes; of an accelerator's
  memory those alone.

  By runs of ten walkers an arm, native physics: 2.7 GiB of 0.8 to the end (two arms, 25,000 steps);
  up to a third save, traces still short, 2.5 of 0.8 (one arm, 64,000) and 3.6 of 1.6 (two). Nothing
  larger was measured.
  """
  import jax

  return PROCESS + int(GROWTH * need) if jax.default_backend() == "cpu" else need


class Need(NamedTuple):
  """Bytes. `record`: one replay record. `weights`: one seed's parameters, slow critic and two
  moments. `replay`: all records of one seed.
  """

  record: int
  weights: int
  replay: int

  def total(self, seeds: int, at_once: int = 1) -> int:
    """Of `seeds` seeds; an update holds one more copy of the weights of the seeds at work,
    `at_once` of them.
    """
    return seeds * (self.weights + self.replay) + at_once * self.weights


@functools.lru_cache
def parameters(size: str, obs_size: int, act_size: int, bins: int = 255) -> tuple[int, int]:
  """Trainable parameters and those of the slow critic."""
  import jax

  from mjx_cl.config import DreamerConfig
  from mjx_cl.dreamer.agent import Agent, parameter_count

  state = jax.eval_shape(
    Agent(DreamerConfig(size=size, bins=bins), obs_size, act_size).init, jax.random.key(0)
  )
  return parameter_count(state.params), parameter_count(state.slow)


def need(size: str, obs_size: int, act_size: int, records: int, bins: int = 255) -> Need:
  """What one seed with a replay of `records` records holds."""
  from mjx_cl.dreamer import replay

  trained, slow = parameters(size, obs_size, act_size, bins)
  record = replay.record_bytes(obs_size, act_size, SIZES[size].deter, SIZES[size].stoch)
  return Need(record, 4 * (3 * trained + slow), records * record)


def container(root="/sys/fs/cgroup", groups="/proc/self/cgroup") -> int | None:
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


def _text(path) -> str:
  """What a file says; nothing where it cannot be read."""
  try:
    return pathlib.Path(path).read_text()
  except (OSError, UnicodeDecodeError):
    return ""


def free() -> int:
  """Bytes free on the device that computes; of a CPU's memory what the machine has and what the
  container may take, whichever is less.
  """
  import jax
  import psutil

  stats = None if jax.default_backend() == "cpu" else jax.local_devices()[0].memory_stats()
  if stats:
    return stats["bytes_limit"] - stats["bytes_in_use"]
  machine, limited = psutil.virtual_memory().available, container()
  return machine if limited is None else min(machine, limited)


def held() -> int:
  """Bytes that this process holds already of what `resident` says it will; 0 where that is an
  accelerator's.
  """
  import jax
  import psutil

  return psutil.Process().memory_info().rss if jax.default_backend() == "cpu" else 0


def check(
  size: str,
  obs_size: int,
  act_size: int,
  records: int,
  seeds: int,
  what: tuple[str, Callable[[int], int]],
  bins: int = 255,
  shards: int = 1,
) -> Need:
  """Refuses what would not fit.

  Args:
    records: of one seed. seeds: of all. what: the setting that bounds the records, and the records
      that a value of it needs (never fewer for more).
    shards: devices over which the seeds are spread.

  Raises:
    UserError that names the number which would fit.
  """
  setting, records_of = what
  wanted = need(size, obs_size, act_size, records, bins)
  here = -(-seeds // shards)
  space, grown = (
    int(MARGIN * free()) + held(),
    resident(wanted.total(here, here if runtime.seeds_by() == "vmap" else 1)),
  )
  if grown > space:
    each = (resident(2**40) - resident(0)) / 2**40  # bytes of the process for a byte of replay
    room = int((space - grown) / each + here * wanted.replay) // here // wanted.record
    left = bisect.bisect_right(range(1, 2 + max(0, room)), room, key=records_of)
    fits = (
      f"{setting}={left:,} would fit"
      if left > 0
      else f"not even {setting}=1 fits: fewer seeds or a smaller size would"
    )
    raise UserError(
      f"{seeds} seeds of {size} with {records:,} records each need {grown / 2**30:.1f} GiB a "
      f"device, {space / 2**30:.1f} GiB may be "
      f"used; {fits}"
    )
  return wanted


def table(obs_size: int = 24, act_size: int = 6) -> dict[str, str]:
  """Size -> its memory, in words; observations and actions of the walker by default."""
  out = {}
  for size in SIZES:
    n = need(size, obs_size, act_size, 10**6)
    trained, _ = parameters(size, obs_size, act_size)
    out[size] = (
      f"{trained:,} parameters; {n.weights / 1e6:,.1f} MB a seed with slow critic and moments; "
      f"{n.record:,} bytes a record, "
      f"{n.replay / 1e9:,.1f} GB a million of them"
    )
  return out
