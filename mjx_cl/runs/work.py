"""The work of a run, chunk by chunk: who acts, who is watched, who learns, and what that takes.

  herd   acts for up to HERD lives, whether it is full or not
  band   acts for up to BAND learners
  watch  monitor, detector and signals of a life or learner
  update of one learner

Seconds are those of one core; so many cores share a chunk, but a stream's own work is one after
the other:

  wall = max((herds + bands + watches + updates) / cores, act + watch + updates of one stream)
"""

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_cl.adapt import methods
from mjx_cl.adapt.arms import Arm
from mjx_cl.config import CHUNK, AdaptConfig
from mjx_cl.runs.groups import BAND, HERD

# core seconds of size1m, where RATE FLOP/s are two quiet cores' dense float32 products: per stream
# and control step, physics apart
RATE = 440e9
ACT_S, LEARNER_ACT_S, WATCH_S = 0.08e-3, 0.22e-3, 0.25e-3
# per stream and control step; a car's physics is part of its acting
PHYSICS_S = {"walker": 0.05e-3, "quadruped": 0.06e-3, "car": 0.0, "car_real": 0.06e-3}
# per replayed step that an update trains on, every state an imagination start
UPDATE_S = 0.105 / (4 * 64)


class Speed(NamedTuple):
  """Core seconds.

  Attributes:
    herd: of a herd's chunk.
    band: of a band's chunk.
    watch: of a chunk of one stream.
    update: of one update.
  """

  herd: float
  band: float
  watch: float
  update: float


class Learner(NamedTuple):
  """How streams learn.

  Attributes:
    fill: control steps of adaptation before the first update.
    rate: updates per control step after that.
  """

  fill: int
  rate: float


class Spell(NamedTuple):
  """An adaptation that is expected.

  Attributes:
    start: control step.
    steps: its length [control steps].
    chance: that it comes.
  """

  start: int
  steps: float
  chance: float = 1.0


class Load(NamedTuple):
  """What is expected of chunks, float (chunks,).

  Attributes:
    herds: that act.
    bands: that act.
    watched: streams.
    updates: of all.
    longest: updates of the stream that has most.
  """

  herds: np.ndarray
  bands: np.ndarray
  watched: np.ndarray
  updates: np.ndarray
  longest: np.ndarray

  def kinds(self) -> np.ndarray:
    """Float (chunks, 4), in the order of Speed."""
    return np.stack([self.herds, self.bands, self.watched, self.updates], 1)


def learner(arm: Arm, adapt: AdaptConfig, trained: Any, repeat: int = 1) -> Learner:
  """How a stream of this arm learns by AdaptConfig and the agent's DreamerConfig."""
  replayed = (adapt.batch or trained.batch) * trained.length
  windows = methods.of(arm).settings.of("start_windows", adapt)
  return Learner((windows + trained.length) * repeat, adapt.ratio / replayed / repeat)


def speed(adapt: AdaptConfig, trained: Any, size: float, physics: float, repeat: int = 1) -> Speed:
  """Speed of a core of the machine of RATE.

  Args:
    adapt: of the run.
    trained: DreamerConfig of its agent.
    size: parameters, of those of size1m on a walker.
    physics: seconds of a control step.
    repeat: control steps of a decision.
  """
  # imagination is about half of an update
  starts = adapt.last_starts
  share = 1.0 if not starts else 0.5 + 0.5 * starts / trained.length
  acting = lambda each: CHUNK * (each * size + physics * repeat)
  replayed = (adapt.batch or trained.batch) * trained.length
  return Speed(
    HERD * acting(ACT_S),
    BAND * acting(LEARNER_ACT_S),
    CHUNK * WATCH_S * size,
    replayed * UPDATE_S * share * size,
  )


def herds(lives: Sequence[tuple[Hashable, Hashable]]) -> list[list[list[int]]]:
  """Herds of lives of streams; lives: (agent, what tells its lives apart) of each stream."""
  of: dict[Hashable, dict[Hashable, list[int]]] = {}
  for g, (agent, life) in enumerate(lives):
    of.setdefault(agent, {}).setdefault(life, []).append(g)
  return [
    own[k : k + HERD]
    for own in map(list, map(dict.values, of.values()))
    for k in range(0, len(own), HERD)
  ]


def load(
  spells: Sequence[Sequence[Spell]],
  begun: Sequence[bool],
  together: list[list[list[int]]],
  learners: Sequence[Learner],
  at: np.ndarray,
  chunk: int,
) -> Load:
  """What is expected of the chunks that begin with control steps `at`.

  Args:
    spells: of each stream, none within another.
    begun: whether it is a learner already.
    together: see `herds`.
    learners: how each stream learns.
    at: int (chunks,).
    chunk: its control steps.
  """
  learns, updates = np.zeros((len(spells), len(at))), np.zeros((len(spells), len(at)))
  for g, (stream, own) in enumerate(zip(spells, learners)):
    frozen = np.full(len(at), 0.0 if begun[g] else 1.0)
    for start, steps, chance in stream:
      frozen *= 1.0 - chance * (at >= start)
      within = np.minimum(at + chunk, start + steps) - np.maximum(at, start + own.fill)
      updates[g] += chance * own.rate * np.clip(within, 0.0, chunk)
    learns[g] = 1.0 - frozen
  some = lambda shares: 1.0 - np.prod([1.0 - x for x in shares], 0)
  alive = [[1.0 - np.prod(learns[life], 0) for life in herd] for herd in together]
  number = learns.sum(0)
  return Load(
    sum((some(herd) for herd in alive), np.zeros(len(at))),
    np.where(number < 1, number, np.ceil(number / BAND - 1e-9)),
    sum((sum(herd) for herd in alive), number),
    updates.sum(0),
    updates.max(0),
  )


def wall(done: Load, core: Speed, cores: int) -> np.ndarray:
  """Seconds of each chunk, (chunks,)."""
  total = done.kinds() @ np.array(core)
  learning = np.minimum(1.0, done.bands) * core.band + done.longest * core.update
  chain = np.maximum(np.minimum(1.0, done.herds) * core.herd, learning) + core.watch
  return np.maximum(total / cores, chain)
