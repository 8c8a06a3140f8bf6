"""The life before the onset is the same for every fault and severity of a robot, agent and seed:
runs of one process that follow each other live it once.

A run goes on from there a whole chunk before the chunk of its onset, in which what its faults
remember (delay lines, held values) is filled as if they had been there from the start.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_cl.config import FaultConfig, RunConfig
from mjx_cl.faults import FAULTS
from mjx_cl.faults.presets import becomes, changes
from mjx_cl.physics.fields import DERIVING
from mjx_cl.runs.identity import identity
from mjx_cl.runs.lives import Lives

# of a run's settings, those that no robot notices before the onset
LATER = {f.name for f in dataclasses.fields(FaultConfig)} - {"env", "onset"} | {"changes", "keep"}


class Past(NamedTuple):
  """Robots before their onset.

  Attributes:
    chunks: that they have lived.
    herds: of each its agent, robots and Frozen.
    parts: what was logged.
    alarms: int (streams,), so far.
    phase: int (streams,).
  """

  chunks: int
  herds: list[tuple[Any, Any, list]]
  parts: list[dict]
  alarms: np.ndarray
  phase: np.ndarray


class Healthy:
  """What runs of one process share of their robots' lives before the onset.

  Args:
    most: as many pasts are kept, the newest.
  """

  def __init__(self, most: int = 4) -> None:
    self.most = most
    self.kept: dict[str, Past] = {}  # the newest last

  def keep(self, key: str, past: Past | None) -> None:
    """Keeps what was lived under `key`, in place of what was there; None: nothing."""
    if past is None:
      return
    self.kept.pop(key, None)
    self.kept[key] = past
    while len(self.kept) > self.most:
      del self.kept[next(iter(self.kept))]


def key_of(config: RunConfig, cards: list[dict], owned: Iterable[str]) -> str:
  """What a run with agents of these cards shares with those of other faults; "": nothing.

  Args:
    config: of the run.
    cards: of its agents.
    owned: MuJoCo fields that its faults write. Of one with masses of its own the reward, which is
      computed from them, rounds otherwise.
  """
  # a robot that becomes another one brings both with it, snapshots are taken from the start, and a
  # fault of another package may remember more than a chunk
  own = all(change.fault in FAULTS.own for change in changes(config))
  if not own or config.snapshots or becomes(config) is not None:
    return ""
  said = {k: v for k, v in identity(config).items() if k not in LATER}
  return json.dumps([said, cards, sorted(set(DERIVING).intersection(owned))], sort_keys=True)


def last(config: RunConfig, chunk_steps: int) -> int:
  """Chunks after which runs part at the latest."""
  return config.onset // chunk_steps - 1


def take(lives: Lives, chunks: int, parts: list[dict], alarms: Any, phase: Any) -> Past | None:
  """The past of lives of which none has begun to learn; None where one has."""
  if lives.bands:
    return None
  herds = [(herd.train, herd.streams, list(herd.frozen)) for herd in lives.herds]
  return Past(chunks, herds, list(parts), np.array(alarms), np.array(phase))


def fork(lives: Lives, past: Past) -> bool:
  """Goes on from a past, each robot with the faults that it is to have; false where that was lived
  by other weights.
  """
  same = lambda a, b: jax.tree.all(jax.tree.map(np.array_equal, a, b))
  if not same([herd.train for herd in lives.herds], [train for train, _, _ in past.herds]):
    return False
  for herd, (_, robots, frozen) in zip(lives.herds, past.herds):
    herd.streams = robots._replace(injection=herd.streams.injection)
    herd.frozen = list(frozen)
  return True
