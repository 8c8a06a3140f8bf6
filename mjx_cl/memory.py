"""Bytes that a training or a run will hold, known before anything is allocated."""
from __future__ import annotations

import bisect
import functools
from collections.abc import Callable
from typing import NamedTuple

from mjx_cl.dreamer.sizes import SIZES
from mjx_cl.errors import UserError

MARGIN = 0.85               # share of the free memory that may be planned for
PROCESS = 7 * 2**28         # bytes of Python, its libraries, compiled programs and their scratch memory
GROWTH = 1.5                # of what weights and replays take: weights once more while they are saved, traces, what the allocator cannot use


def resident(need: int) -> int:
  """Bytes that a process grows to whose weights and replays take `need` bytes; of an accelerator's memory those alone.

  By runs of ten walkers an arm, native physics: 2.7 GiB of 0.8 to the end (two arms, 25,000 steps); up to a third save, traces still short, 2.5 of 0.8
  (one arm, 64,000) and 3.6 of 1.6 (two). Nothing larger was measured.
  """
  import jax
  return PROCESS + int(GROWTH * need) if jax.default_backend() == "cpu" else need


class Need(NamedTuple):
  """Bytes. `record`: one replay record. `weights`: one seed's parameters, slow critic and two moments. `replay`: all records of one seed."""
  record: int
  weights: int
  replay: int

  def total(self, seeds: int) -> int:
    """Of `seeds` seeds; an update holds one more copy of the weights of the seed at work."""
    return seeds * (self.weights + self.replay) + self.weights


@functools.lru_cache
def parameters(size: str, obs_size: int, act_size: int, bins: int = 255) -> tuple[int, int]:
  """Trainable parameters and those of the slow critic."""
  import jax
  from mjx_cl.config import DreamerConfig
  from mjx_cl.dreamer.agent import Agent, parameter_count
  state = jax.eval_shape(Agent(DreamerConfig(size=size, bins=bins), obs_size, act_size).init, jax.random.key(0))
  return parameter_count(state.params), parameter_count(state.slow)


def need(size: str, obs_size: int, act_size: int, records: int, bins: int = 255) -> Need:
  """What one seed with a replay of `records` records holds."""
  from mjx_cl import replay
  trained, slow = parameters(size, obs_size, act_size, bins)
  record = replay.record_bytes(obs_size, act_size, SIZES[size].deter, SIZES[size].stoch)
  return Need(record, 4 * (3 * trained + slow), records * record)


def free() -> int:
  """Bytes free on the device that computes."""
  import jax
  import psutil
  stats = None if jax.default_backend() == "cpu" else jax.local_devices()[0].memory_stats()
  return stats["bytes_limit"] - stats["bytes_in_use"] if stats else psutil.virtual_memory().available


def held() -> int:
  """Bytes that this process holds already of what `resident` says it will; 0 where that is an accelerator's."""
  import jax
  import psutil
  return psutil.Process().memory_info().rss if jax.default_backend() == "cpu" else 0


def check(size: str, obs_size: int, act_size: int, records: int, seeds: int, what: tuple[str, Callable[[int], int]], bins: int = 255, shards: int = 1) -> Need:
  """Refuses what would not fit.

  Args:
    records: of one seed. seeds: of all. what: the setting that bounds the records, and the records that a value of it needs (never fewer for more).
    shards: devices over which the seeds are spread.
  Raises:
    UserError that names the number which would fit.
  """
  setting, records_of = what
  wanted = need(size, obs_size, act_size, records, bins)
  here = -(-seeds // shards)
  space, grown = int(MARGIN * free()) + held(), resident(wanted.total(here))
  if grown > space:
    each = (resident(2**40) - resident(0)) / 2**40  # bytes of the process for a byte of replay
    room = int((space - grown) / each + here * wanted.replay) // here // wanted.record
    left = bisect.bisect_right(range(1, 2 + max(0, room)), room, key=records_of)
    fits = f"{setting}={left:,} would fit" if left > 0 else f"not even {setting}=1 fits: fewer seeds or a smaller size would"
    raise UserError(f"{seeds} seeds of {size} with {records:,} records each need {grown / 2**30:.1f} GiB a device, {space / 2**30:.1f} GiB may be "
                    f"used; {fits}")
  return wanted


def table(obs_size: int = 24, act_size: int = 6) -> dict[str, str]:
  """Size -> its memory, in words; observations and actions of the walker by default."""
  out = {}
  for size in SIZES:
    n = need(size, obs_size, act_size, 10**6)
    trained, _ = parameters(size, obs_size, act_size)
    out[size] = (f"{trained:,} parameters; {n.weights / 1e6:,.1f} MB a seed with slow critic and moments; {n.record:,} bytes a record, "
                 f"{n.replay / 1e9:,.1f} GB a million of them")
  return out
