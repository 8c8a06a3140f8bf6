"""Bytes that a training or a run will hold, known before anything is allocated."""

import bisect
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax

from mjx_cl.config import DreamerConfig
from mjx_cl.config.sizes import SIZES
from mjx_cl.dreamer import replay
from mjx_cl.dreamer.agent import Agent, parameter_count
from mjx_cl.errors import UserError
from mjx_cl.io import memory, runtime


class Need(NamedTuple):
  """Bytes of one seed.

  Attributes:
    record: one replay record.
    weights: parameters, slow critic and the two moments.
    replay: all its records.
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
  state = jax.eval_shape(
    Agent(DreamerConfig(size=size, bins=bins), obs_size, act_size).init, jax.random.key(0)
  )
  return parameter_count(state.params), parameter_count(state.slow)


def need(size: str, obs_size: int, act_size: int, records: int, bins: int = 255) -> Need:
  """What one seed with a replay of `records` records holds."""
  trained, slow = parameters(size, obs_size, act_size, bins)
  record = replay.record_bytes(obs_size, act_size, SIZES[size].deter, SIZES[size].stoch)
  return Need(record, 4 * (3 * trained + slow), records * record)


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
    size: of the learner.
    obs_size: variables of an observation.
    act_size: variables of an action.
    records: of one seed.
    seeds: of all.
    what: the setting that bounds the records, and the records that a value of it needs (never fewer
      for more).
    bins: classes of the two-hot heads.
    shards: devices over which the seeds are spread.

  Raises:
    UserError: names the number which would fit.
  """
  setting, records_of = what
  wanted = need(size, obs_size, act_size, records, bins)
  here = -(-seeds // shards)
  space = int(memory.MARGIN * memory.free()) + memory.held()
  grown = memory.resident(wanted.total(here, here if runtime.seeds_by() == "vmap" else 1))
  if grown > space:
    # bytes of the process for a byte of replay
    each = (memory.resident(2**40) - memory.resident(0)) / 2**40
    room = int((space - grown) / each + here * wanted.replay) // here // wanted.record
    left = bisect.bisect_right(range(1, 2 + max(0, room)), room, key=records_of)
    fits = (
      f"{setting}={left:,} would fit"
      if left > 0
      else f"not even {setting}=1 fits: fewer seeds or a smaller size would"
    )
    raise UserError(
      f"{seeds} seeds of {size} with {records:,} records each need {grown / 2**30:.1f} GiB a "
      f"device, {space / 2**30:.1f} GiB may be used; {fits}"
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
      f"{n.record:,} bytes a record, {n.replay / 1e9:,.1f} GB a million of them"
    )
  return out
