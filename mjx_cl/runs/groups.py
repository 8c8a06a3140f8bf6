"""What a run's streams are grouped into, and what a chunk brings of them; see lives.py."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import numpy as np

from mjx_cl.adapt import decide
from mjx_cl.adapt.choices import Choices
from mjx_cl.adapt.state import Digest, Frozen, LoopState
from mjx_cl.adapt.watch import Minds
from mjx_cl.config import AdaptConfig
from mjx_cl.dreamer.agent import TrainState
from mjx_cl.rollout.scan import Row

HERD, BAND = 8, 4
LOGGED = ("rewards", "severity", "severities", "episode", "terminated", "truncated", "final_obs")
WORK = ("acting", "monitor", "updates")  # kinds of work, in the order in which a stream has them


class Settled(NamedTuple):
  """What holds for one stream in a chunk.

  Attributes:
    choices: of its arm, leading (1,).
    acceptance: float32 (1,), of its robot, or None: that of the environment.
  """

  choices: Choices
  acceptance: Any


@dataclasses.dataclass
class Herd:
  """Lives under one set of weights.

  Attributes:
    lives: their names.
    train: the agent.
    minds: what it acts and judges by, leading (1,).
    streams: robots, leading (1, HERD).
    frozen: of each life.
  """

  lives: list[Hashable]
  train: TrainState
  minds: Minds
  streams: Any
  frozen: list[Frozen]


@dataclasses.dataclass
class Band:
  """Learners.

  Attributes:
    who: number of the stream in each lane, fewer than lanes where there is room.
    streams: robots, leading (lanes, 1).
    loops: LoopStates, of one stream each; on an accelerator one of all.
    acting: weights, leading (lanes,); None: to be put together.
  """

  who: list[int]
  streams: Any
  loops: list[LoopState]
  acting: Any = None


class Chunk(NamedTuple):
  """What a chunk brought.

  Attributes:
    rows: Row leading (T, streams, 1), NumPy, of the fields LOGGED; the others are None.
    digest: Digest, NumPy.
    seconds: float (streams, 3), of each kind of WORK, on one core; lives that several streams
      share are shared out.
  """

  rows: Row
  digest: Digest
  seconds: np.ndarray


def departs(
  fired: np.ndarray,
  phase: int,
  choices: Choices,
  now: int,
  repeat: int,
  config: AdaptConfig,
) -> bool:
  """Whether a stream begins an adaptation, as decide.starts and decide.update say it.

  Args:
    fired: bool (T,), alarms of the chunk's rows.
    phase: of the stream.
    choices: of its arm, leading (1,).
    now: control steps done after the chunk.
    repeat: control steps of a row.
    config: AdaptConfig.
  """
  if phase != decide.NOMINAL or now <= config.warmup:
    return False
  opened = now - len(fired) * repeat
  at = np.asarray(choices.at)
  due = ((at >= max(opened, config.warmup)) & (at < now)).any()
  known = opened + (np.arange(len(fired)) + 1) * repeat - 1
  heard = bool(np.asarray(choices.listens)[0]) and (fired & (known >= config.warmup)).any()
  return bool(due or heard)


class Told(NamedTuple):
  """What became of a chunk of streams that share a state.

  Attributes:
    streams: number -> (rows, digest), NumPy, each with one stream.
    left: number -> (state, robot) of those that have begun to learn.
    seconds: of watching and of learning.
  """

  streams: dict[int, tuple[Row, Digest]]
  left: dict[int, tuple[LoopState, Any]]
  seconds: tuple[float, float]


# (stream, its robot after the chunk with leading (1, 1), on demand) -> Settled
Settle = Callable[[int, Callable[[], Any]], Settled]


def slim(rows: Row) -> Row:
  """Of the fields LOGGED; the others are None."""
  return row_of([x if name in LOGGED else None for name, x in rows._asdict().items()])


def row_of(fields: list[Any]) -> Row:
  """A Row, of which some fields may be None."""
  return Row(*fields)
