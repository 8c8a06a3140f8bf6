"""Runs of one detector over the recorded streams of a robot: one compiled program for all of them,
and no sample run twice without need.

A lane is a stream at one threshold, or at `TOGETHER` of them where the score does not depend on the
threshold, so that all share its computation. What is saved, and why no number changes:
  compiling   samples of all streams lie one after the other and a lane is a row to begin at, so one
    program serves every robot, split and length
  pasts       fault streams that share their past continue from the state that it ends in
  thresholds  a lane whose scores never lie between two thresholds takes the same decisions at both:
  one run tells of either (`same`)
"""

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from mjx_cl.leaderboard.program import (
  LANES,
  LANES_SHARED,
  LEVELS,
  Room,
  Samples,
  Stretch,
  program,
  shared,
)
from mjx_cl.rollout.monitor import Residual
from mjx_cl.scoring import thresholds as healthy


class Runner:
  """A detector, compiled when it is first run.

  Args:
    build: threshold -> Detector.
    room: of the set; None: that of the first robot.
    signed: it takes innovations, whose number is a robot's own.
  """

  def __init__(self, build: Callable, room: Room | None = None, signed: bool = False) -> None:
    self.build, self.room, self.together, self.signed = build, room, 0, signed
    self.shape = (0, 0, 0, 0)  # output rows, places of the pool, stretches, samples
    self.compiled: Any = None

  def prepare(self, data: Samples) -> None:
    """Compiles for these streams; a second robot that fits needs nothing."""
    if not self.together:
      one_row = jax.tree.map(lambda x: x[0], self._rows(data))
      self.together = healthy.TOGETHER if shared(self.build, one_row) else 1
      self.lanes = LANES_SHARED if self.together > 1 else LANES
    copies = 1 if self.together > 1 else LEVELS
    batches = lambda n: -(-copies * n // self.lanes)
    room = self.room or Room(0, {self.lanes: 0}, 0)
    pasts, faults = copies * max(len(data.past), room.pasts), batches(len(data.fault))
    past = batches(len(data.past)) * int(data.onset.max(initial=0))
    rows = max(data.steps, past + faults * data.horizon, room.rows[self.lanes])
    shape = rows, 2 + pasts, 1 + faults + pasts, data.residual.opr.shape[0]
    small = any(have < want for have, want in zip(self.shape, shape[:3]))
    if self.compiled is None or small or self.shape[3] != shape[3]:
      self.shape, self.compiled = shape, None
      run = program(self.build, rows, shape[1])
      self.compiled = run.lower(self._filled([]), 0, self._rows(data)).compile()

  def _rows(self, data: Samples) -> Residual:
    return data.residual if self.signed else data.residual._replace(innovation=None)

  def _filled(self, stretches: list[Stretch]) -> Stretch:
    """What `program` takes, lanes without use at the first row and into nowhere."""
    _, pool, g, _ = self.shape
    whole = lambda *shape: np.zeros((g,) + shape, np.int32)
    out = Stretch(
      np.zeros((g, self.together, self.lanes), np.float32),
      whole(self.lanes),
      whole(),
      whole(),
      whole(self.lanes),
      whole(self.lanes) + np.int32(pool - 1),
    )
    for i, stretch in enumerate(stretches):
      used = len(stretch.first)
      for array, own in zip(out, stretch):
        array[(i, ..., slice(used)) if array.ndim > 1 else i] = own
    return out

  def _call(self, stretches: list[Stretch], data: Samples) -> tuple[np.ndarray, np.ndarray]:
    fired, scores = self.compiled(self._filled(stretches), len(stretches), self._rows(data))
    return np.asarray(fired), np.asarray(scores)

  def healthy(
    self, lanes: list[tuple[int, np.ndarray]], data: Samples
  ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Runs lanes.

    Args:
      lanes: (stream, thresholds (K,)) of each, K = `together`.
      data: of the robot.

    Yields:
      fired (K, T), scores (K, T, M) of each.
    """
    self.prepare(data)
    for now in batched(lanes, self.lanes):
      streams, levels = zip(*now)
      zero = np.zeros(len(now), int)
      nowhere = zero + self.shape[1] - 1
      first = data.healthy[list(streams)]
      one = Stretch(np.stack(levels, 1), first, data.steps, 0, zero, nowhere)
      fired, scores = self._call([one], data)
      for i in range(len(now)):
        yield fired[:, : data.steps, i].copy(), scores[:, : data.steps, i].copy()

  def faults(
    self, levels: np.ndarray, data: Samples
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Runs fault streams from each onset on.

    Args:
      levels: K <= LEVELS thresholds.
      data: of the robot.

    Returns:
      (fired bool (K, H, F), score float32 (K, H, F), before bool (O, F), us); before: alarms at
      levels[0] ahead of each onset, False from it on, O the last onset; us: microseconds per sample
      of a stream, whose thresholds share its computation where they can.
    """
    self.prepare(data)
    last, horizon, faults = int(data.onset.max(initial=0)), data.horizon, len(data.fault)
    apart = [list(part) for part in batched(levels, self.together)]
    vectors = np.asarray([t + t[-1:] * (self.together - len(t)) for t in apart], np.float32)
    pasts = list(itertools.product(range(len(vectors)), range(len(data.past))))
    tails = list(itertools.product(range(len(vectors)), range(faults)))
    stretches: list[Stretch] = []
    ahead, where = [], []  # (output row, lane) of each past and of each fault stream
    for batch, part in enumerate(batched(pasts, self.lanes)):
      stretches += self._pasts(vectors, np.asarray(part), batch, data)
      ahead += [(batch * last, i) for i in range(len(part))]
    row = last * -(-len(pasts) // self.lanes)
    for part in batched(tails, self.lanes):
      g, f = np.asarray(part).T
      source = 1 + g * len(data.past) + data.owner[f]
      nowhere = np.full(len(g), self.shape[1] - 1)
      stretches.append(Stretch(vectors[g].T, data.fault[f], horizon, row, source, nowhere))
      where += [(row, i) for i in range(len(g))]
      row += horizon
    begin = time.perf_counter()
    fired, scores = self._call(stretches, data)
    done = sum(stretch.steps for stretch in stretches)
    us = (time.perf_counter() - begin) / (done * self.lanes) * 1e6
    before = np.zeros((last, faults), bool)
    for f, p in enumerate(data.owner):
      at, i = ahead[p]
      before[: data.onset[p], f] = fired[0, at : at + data.onset[p], i]

    def whole(x: np.ndarray) -> np.ndarray:
      """(K, H, F) from the output (together, rows, lanes)."""
      each = np.stack([x[:, at : at + horizon, i] for at, i in where], -1)
      each = each.reshape(self.together, horizon, len(vectors), faults)
      return np.moveaxis(each, 2, 0).reshape(-1, horizon, faults)[: len(levels)]

    return whole(fired), whole(strongest(scores)), before, us

  def _pasts(
    self, vectors: np.ndarray, part: np.ndarray, batch: int, data: Samples
  ) -> Iterator[Stretch]:
    """Stretches of some pasts side by side, from one onset to the next.

    Args:
      vectors: (groups, K) thresholds.
      part: int (n, 2), group and past of each lane.
      batch: which of the batches it is.
      data: of the robot.
    """
    g, p = part.T
    places = 1 + batch * self.lanes + np.arange(len(g))
    begin, row = 0, batch * int(data.onset.max(initial=0))
    for end in np.unique(data.onset[p]).tolist():
      live = data.onset[p] >= end
      yield Stretch(
        vectors[g].T,
        np.where(live, data.past[p] + begin, 0),
        end - begin,
        row + begin,
        np.where(live & (begin > 0), places, 0),
        np.where(live, places, self.shape[1] - 1),
      )
      begin = end


def batched(items: Any, size: int) -> Iterator[Any]:
  """`items` in parts of `size`, the last perhaps shorter."""
  for at in range(0, len(items), size):
    yield items[at : at + size]


def strongest(scores: np.ndarray) -> np.ndarray:
  """The largest known of the members' scores (.., M), as `any_of` has it; nan where none
  is known.
  """
  return scores[..., 0] if scores.shape[-1] == 1 else np.fmax.reduce(scores, -1)


def same(scores: np.ndarray, one: float, other: float) -> bool:
  """Whether a run at threshold `one` with these scores is the run at `other`: no score lies above
  the one and not above the other.

  By induction: a detector knows its threshold only through score > threshold, so that up to any
  step both runs are in one state.
  """
  low, high = min(one, other), max(one, other)
  return not ((scores > low) & (scores <= high)).any()


@dataclasses.dataclass
class Counter:
  """Alarms of healthy streams at thresholds, each stream run only where no other run of it tells
  (`same`).

  Attributes:
    runner: of the detector.
    data: of the robot.
    streams: number of the healthy streams that are counted, the first.
    count_from: steps before it count nowhere.
    reuse: False runs everything.
    tried: {threshold: alarms}.
    sound: every alarm so far had a score above the threshold, without which no run tells of
      another.
  """

  runner: Runner
  data: Samples
  streams: int
  count_from: int
  reuse: bool = True
  tried: dict[float, int] = dataclasses.field(default_factory=dict)
  sound: bool = True

  def __post_init__(self) -> None:
    # (threshold, scores (T, M), alarms) of each stream's runs
    self.runs: list[list[tuple[float, np.ndarray, int]]] = [[] for _ in range(self.streams)]

  def score(self) -> np.ndarray:
    """Scores without restarts, (T, streams)."""
    self._run({s: [math.inf] for s in range(self.streams)})
    return np.stack([strongest(own[-1][1]) for own in self.runs], 1)

  def _run(self, wanted: dict[int, list[float]]) -> None:
    """Runs streams at thresholds."""
    self.runner.prepare(self.data)
    size = self.runner.together
    lanes = [(s, part) for s, levels in wanted.items() for part in batched(levels, size)]
    full = [(s, np.asarray(t + t[-1:] * (size - len(t)), np.float32)) for s, t in lanes]
    for (s, levels), (fired, scores) in zip(lanes, self.runner.healthy(full, self.data)):
      for k, t in enumerate(levels):
        self.sound &= not (fired[k] & ~(scores[k] > t).any(-1)).any()
        self.runs[s].append((t, scores[k], int(fired[k, self.count_from :].sum())))

  def _known(self, stream: int, threshold: float) -> int | None:
    """Alarms by another run, None where none tells."""
    level = lambda run: run[0]
    under = [run for run in self.runs[stream] if run[0] <= threshold]
    over = [run for run in self.runs[stream] if run[0] >= threshold]
    nearest = [pick(runs, key=level) for pick, runs in ((max, under), (min, over)) if runs]
    for t, scores, alarms in nearest:
      if t == threshold or self.reuse and same(scores, t, threshold):
        return alarms
    return None

  def count(self, levels: np.ndarray, target: float) -> np.ndarray:
    """Alarms of all streams at each threshold, int (len(levels),).

    Args:
      levels: thresholds.
      target: only runs around the least threshold above all with more are kept.
    """
    asked = levels.astype(np.float32).tolist()
    each = {t: [self._known(s, t) for s in range(self.streams)] for t in asked}
    wanted = {s: [t for t, known in each.items() if known[s] is None] for s in range(self.streams)}
    self._run({s: missing for s, missing in wanted.items() if missing})
    for t, known in each.items():
      counts = [self._known(s, t) if k is None else k for s, k in enumerate(known)]
      self.tried[t] = sum(k for k in counts if k is not None)
    low, high = healthy.passed(self.tried, target)
    self.runs = [[r for r in own if low <= r[0] <= high or r[0] == math.inf] for own in self.runs]
    return np.asarray([self.tried[t] for t in asked])
