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

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.scoring import thresholds as healthy

if TYPE_CHECKING:
  from collections.abc import Iterable, Iterator

  from mjx_cl.detectors.base import Detector
  from mjx_cl.leaderboard.streams import StreamSet
  from mjx_cl.rollout.monitor import Residual

LANES, LANES_SHARED = 80, 20  # side by side: of one threshold each, or of healthy.TOGETHER
LEVELS = 5  # thresholds that fault streams are run at: the calibrated one and those of the curve


class Samples(NamedTuple):
  """The streams of one robot, one after the other.

  Attributes:
    residual: monitor.Residual with leading (N,), unknown rows at the end. steps: of each healthy
      stream. horizon: of each fault stream, from its onset.
    healthy: int (S,), first row of each healthy stream, those that tune first. past: int (P,),
      first row of each past. onset: int (P,), its steps.
    fault: int (F,), row of each fault stream's onset. owner: int (F,), its past.
  """

  residual: Any
  steps: int
  horizon: int
  healthy: np.ndarray
  past: np.ndarray
  onset: np.ndarray
  fault: np.ndarray
  owner: np.ndarray


class Room(NamedTuple):
  """Sizes that serve all robots of a set, so that none is compiled anew: samples, output rows by
  number of lanes, pasts.
  """

  samples: int
  rows: dict[int, int]
  pasts: int


def room(streams: StreamSet, robots: Iterable[str]) -> Room:
  """Room for these robots of a StreamSet; a robot whose streams share fewer pasts than their seeds
  takes more, and compiles anew.
  """
  m, samples, pasts, rows = streams.meta, 0, 0, {LANES: 0, LANES_SHARED: 0}
  for robot in robots:
    nominal = np.isin(m["stream"], streams.find(robot, "nominal"))
    fault = np.isin(m["stream"], streams.find(robot, "fault", "score"))
    most, number = streams.extent(robot)
    seeds, longest = len(np.unique(m["seed"][fault])), int(m["steps"][nominal].max())
    horizon = int(streams.suite.horizon_s / m["control_s"][fault].min() + 1e-6)
    samples = max(samples, int(nominal.sum()) * longest + seeds * most + number * horizon + 1)
    pasts = max(pasts, seeds)
    for lanes, copies in ((LANES, LEVELS), (LANES_SHARED, 1)):
      rows[lanes] = max(
        rows[lanes],
        longest,
        -(-copies * seeds // lanes) * most + -(-copies * number // lanes) * horizon,
      )
  return Room(samples, rows, pasts)


def samples(
  nominal: Residual,
  fault: Residual,
  onset: np.ndarray,
  seed: np.ndarray,
  horizon: int,
  most: int = 0,
) -> Samples:
  """Samples of healthy streams (T, S) and fault streams (T, F).

  Args:
    nominal, fault: monitor.Residual, NumPy. onset, seed: int (F,). horizon: steps kept from the
      onset on. most: rows to fill up to.
  """
  leaves = jax.tree.leaves(fault)
  same = lambda a, b, steps: all(
    np.array_equal(x[:steps, a], x[:steps, b], equal_nan=x.dtype.kind == "f") for x in leaves
  )
  lanes: list[int]
  owner: list[int]
  lanes, owner = [], []
  for column, (first, number) in enumerate(zip(onset, seed)):
    known = next(
      (
        k
        for k, lane in enumerate(lanes)
        if onset[lane] == first and seed[lane] == number and same(lane, column, first)
      ),
      None,
    )
    owner.append(len(lanes) if known is None else known)
    if known is None:
      lanes.append(column)
  steps, streams = nominal.opr.shape
  past, after = onset[lanes].astype(int), np.full(len(onset), horizon)
  starts = np.concatenate([[0], np.cumsum(np.concatenate([np.full(streams, steps), past, after]))])
  total = max(int(starts[-1]) + 1, most)

  def flat(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    out = (
      np.zeros((total,) + a.shape[2:], bool)
      if a.dtype == bool
      else np.full((total,) + a.shape[2:], np.nan, a.dtype)
    )
    out[: streams * steps] = np.swapaxes(a, 0, 1).reshape((streams * steps,) + a.shape[2:])
    for at, column, n in zip(starts[streams:], lanes, past):
      out[at : at + n] = b[:n, column]
    for column, at in enumerate(starts[streams + len(lanes) : -1]):
      part = b[onset[column] : onset[column] + horizon, column]
      out[at : at + len(part)] = part
    return out

  residual = jax.tree.map(lambda a, b: jax.device_put(flat(a, b)), nominal, fault)
  cut = streams + len(lanes)
  return Samples(
    residual,
    steps,
    horizon,
    starts[:streams],
    starts[streams:cut],
    past,
    starts[cut:-1],
    np.asarray(owner, int),
  )


def updates(
  detector: Detector,
) -> Callable[[Any, Residual], tuple[Any, tuple[jax.Array, jax.Array]]]:
  """Update that gives (state, (fired (), scores (M,))): the score of each member of `any_of`, since
  each restarts by itself; else the one score.
  """
  members = detector.members

  def update(state: Any, x: Residual) -> tuple[Any, tuple[jax.Array, jax.Array]]:
    out = (
      [d.update(s, x) for d, s in zip(members, state)] if members else [detector.update(state, x)]
    )
    fired = jnp.any(jnp.stack([alarm.fired for _, alarm in out]))
    new = tuple(s for s, _ in out) if members else out[0][0]
    return new, (fired, jnp.stack([jnp.asarray(alarm.score, jnp.float32) for _, alarm in out]))

  return update


def shared(build: Callable, sample: Residual) -> bool:
  """Whether the scores are free of the threshold, by the structure of the program; sample:
  monitor.Residual of one row.
  """

  def scores(threshold: jax.Array, xs: Residual) -> jax.Array:
    detector = build(threshold)
    return jax.lax.scan(updates(detector), detector.init(), xs)[1][1]

  try:
    jax.eval_shape(
      jax.vmap(scores, (0, None), None), jnp.zeros(2), jax.tree.map(lambda x: x[None], sample)
    )
  except ValueError:  # what vmap says of an output that differs along the mapped axis
    return False
  return True


def program(build: Callable, rows: int, pool: int) -> jax.stages.Wrapped:
  """The one program of a detector, jitted: stretches of lanes one after the other, each from a
  state that is held and into one.

    (thresholds (G, K, L), first (G, L), steps (G,), row (G,), source (G, L), into (G, L),
    stretches, residual (N, ..)) -> fired, scores

  first: row of `residual` that a lane begins at. row: of the output that a stretch begins at.
  source: 0 the detector's init, else a place of the pool. into: place of the pool that the last
  state is put, `pool` - 1: nowhere.

  Args:
    rows: of the output. pool: places.

  Returns:
    fired bool (K, rows, L), scores float32 (K, rows, L, M), see `updates`; rows that were not
    reached are False, nan.
  """

  def run(
    thresholds: jax.Array,
    first: jax.Array,
    steps: jax.Array,
    row: jax.Array,
    source: jax.Array,
    into: jax.Array,
    stretches: jax.Array,
    residual: Residual,
  ) -> tuple[jax.Array, jax.Array]:
    lanes = first.shape[1]

    def one(thresholds: jax.Array) -> tuple[jax.Array, jax.Array]:  # (G, L)
      init = jax.vmap(lambda t: build(t).init())
      move = jax.vmap(lambda t, state, x: updates(build(t))(state, x))
      like = jax.eval_shape(
        move, thresholds[0], init(thresholds[0]), jax.tree.map(lambda r: r[first[0]], residual)
      )[1][1]

      def stretch(
        g: jax.Array, carry: tuple[Any, jax.Array, jax.Array]
      ) -> tuple[Any, jax.Array, jax.Array]:
        held, fired, scores = carry
        start, before = init(thresholds[g]), jax.tree.map(lambda p: p[source[g]], held)
        fresh = lambda a, b: jnp.where((source[g] == 0).reshape((-1,) + (1,) * (a.ndim - 1)), a, b)

        def step(
          i: jax.Array, carry: tuple[Any, jax.Array, jax.Array]
        ) -> tuple[Any, jax.Array, jax.Array]:
          state, fired, scores = carry
          state, (f, s) = move(
            thresholds[g], state, jax.tree.map(lambda r: r[first[g] + i], residual)
          )
          return (
            state,
            jax.lax.dynamic_update_index_in_dim(fired, f, row[g] + i, 0),
            jax.lax.dynamic_update_index_in_dim(scores, s, row[g] + i, 0),
          )

        state, fired, scores = jax.lax.fori_loop(
          0, steps[g], step, (jax.tree.map(fresh, start, before), fired, scores)
        )
        return jax.tree.map(lambda p, x: p.at[into[g]].set(x), held, state), fired, scores

      held = jax.tree.map(lambda x: jnp.zeros((pool,) + x.shape[1:], x.dtype), init(thresholds[0]))
      out = jax.lax.fori_loop(
        0,
        stretches,
        stretch,
        (
          held,
          jnp.zeros((rows, lanes), bool),
          jnp.full((rows,) + like.shape, jnp.nan, jnp.float32),
        ),
      )
      return out[1:]

    return jax.vmap(one, 1)(thresholds)

  return jax.jit(run)


class Stretch(NamedTuple):
  """One of `program`, see there. thresholds: (K, n), first, source, into: (n,) for n of
  the lanes.
  """

  thresholds: np.ndarray
  first: np.ndarray
  steps: int
  row: int
  source: np.ndarray
  into: np.ndarray


class Runner:
  """A detector, compiled when it is first run.

  Args:
    build: threshold -> Detector.
    room: of the set; None: that of the first robot.
  """

  shape: tuple[int, int, int, int]
  compiled: Any

  def __init__(self, build: Callable, room: Room | None = None) -> None:
    self.build, self.room, self.together = build, room, 0

  def prepare(self, data: Samples) -> None:
    """Compiles for these streams; a second robot that fits needs nothing."""
    if not self.together:
      self.together = (
        healthy.TOGETHER if shared(self.build, jax.tree.map(lambda x: x[0], data.residual)) else 1
      )
      self.lanes = LANES_SHARED if self.together > 1 else LANES
    copies = 1 if self.together > 1 else LEVELS
    batches = lambda n: -(-n // self.lanes)
    pasts = max(len(data.past), self.room.pasts if self.room else 0)
    past = batches(copies * len(data.past)) * int(data.onset.max(initial=0))
    rows = max(
      data.steps,
      past + batches(copies * len(data.fault)) * data.horizon,
      self.room.rows[self.lanes] if self.room else 0,
    )
    shape = (
      rows,
      2 + copies * pasts,
      1 + batches(copies * len(data.fault)) + copies * pasts,
      data.residual.opr.shape[0],
    )
    if (
      getattr(self, "shape", None) is None
      or any(have < want for have, want in zip(self.shape[:3], shape[:3]))
      or self.shape[3] != shape[3]
    ):
      self.shape, self.compiled = shape, None
      self.run_program = program(self.build, rows, shape[1])
    if self.compiled is None:
      self.compiled = self.run_program.lower(*self._filled([]), 0, data.residual).compile()

  def _filled(self, stretches: list[Stretch]) -> tuple[np.ndarray, ...]:
    """Arrays of `program`, lanes without use at the first row and into nowhere."""
    g, k, n, nowhere = self.shape[2], self.together, self.lanes, self.shape[1] - 1
    thresholds, first = np.zeros((g, k, n), np.float32), np.zeros((g, n), np.int32)
    steps, row, source, into = (
      np.zeros(g, np.int32),
      np.zeros(g, np.int32),
      np.zeros((g, n), np.int32),
      np.full((g, n), nowhere, np.int32),
    )
    for i, s in enumerate(stretches):
      used = len(s.first)
      (
        thresholds[i, :, :used],
        first[i, :used],
        steps[i],
        row[i],
        source[i, :used],
        into[i, :used],
      ) = s
    return thresholds, first, steps, row, source, into

  def _call(self, stretches: list[Stretch], data: Samples) -> tuple[np.ndarray, np.ndarray]:
    fired, scores = self.compiled(*self._filled(stretches), len(stretches), data.residual)
    return np.asarray(fired), np.asarray(scores)

  def healthy(
    self, lanes: list[tuple[int, np.ndarray]], data: Samples
  ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Lanes (stream, thresholds (K,)), K = `together`: yields fired (K, T), scores (K, T, M) of
    each.
    """
    self.prepare(data)
    for at in range(0, len(lanes), self.lanes):
      now = lanes[at : at + self.lanes]
      first = data.healthy[[stream for stream, _ in now]]
      zero = np.zeros(len(now), int)
      fired, scores = self._call(
        [
          Stretch(
            np.stack([t for _, t in now], 1), first, data.steps, 0, zero, zero + self.shape[1] - 1
          )
        ],
        data,
      )
      for i in range(len(now)):
        yield fired[:, : data.steps, i].copy(), scores[:, : data.steps, i].copy()

  def faults(
    self, levels: np.ndarray, data: Samples
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """(fired bool (K, H, F), score float32 (K, H, F), before bool (O, F), us): from each onset on,
    at K = len(levels) <= LEVELS thresholds.

    before: alarms at levels[0] ahead of each onset, False from it on; O: the last onset. us:
    microseconds per sample of a stream, whose thresholds share its computation where they can.
    """
    self.prepare(data)
    apart = [levels[k : k + self.together] for k in range(0, len(levels), self.together)]
    vectors = np.stack([np.append(t, [t[-1]] * (self.together - len(t))) for t in apart]).astype(
      np.float32
    )  # (groups, K)
    groups, pasts = len(vectors), len(data.past)
    begin: float
    stretches: list[Stretch]
    ahead: list[tuple[int, int]]
    stretches, done, row, last, ahead = [], 0, 0, int(data.onset.max(initial=0)), []
    lanes = [(g, p) for g in range(groups) for p in range(pasts)]
    for at in range(0, len(lanes), self.lanes):
      g, p = np.asarray(lanes[at : at + self.lanes]).T
      begin, places = 0, 1 + at + np.arange(len(g))
      for end in np.unique(data.onset[p]):
        live = data.onset[p] >= end
        stretches.append(
          Stretch(
            vectors[g].T,
            np.where(live, data.past[p] + begin, 0),
            int(end - begin),
            int(row + begin),
            np.where(live & (begin > 0), places, 0),
            np.where(live, places, self.shape[1] - 1),
          )
        )
        done += int(end - begin)
        begin = end
      ahead += [(row, i) for i in range(len(g))]
      row += last
    where: list[tuple[int, int]]
    tails, where = [(g, f) for g in range(groups) for f in range(len(data.fault))], []
    for at in range(0, len(tails), self.lanes):
      g, f = np.asarray(tails[at : at + self.lanes]).T
      stretches.append(
        Stretch(
          vectors[g].T,
          data.fault[f],
          data.horizon,
          row,
          1 + g * pasts + data.owner[f],
          np.full(len(g), self.shape[1] - 1),
        )
      )
      where += [(row, i) for i in range(len(g))]
      row, done = row + data.horizon, done + data.horizon
    begin = time.perf_counter()
    fired, scores = self._call(stretches, data)
    us = (time.perf_counter() - begin) / (done * self.lanes) * 1e6
    shape = groups, len(data.fault), self.together, data.horizon
    out_fired, out_score = np.zeros(shape, bool), np.full(shape, np.nan, np.float32)
    for (g, f), (row, i) in zip(tails, where):
      out_fired[g, f] = fired[:, row : row + data.horizon, i]
      out_score[g, f] = strongest(scores[:, row : row + data.horizon, i])
    before = np.zeros((last, len(data.fault)), bool)
    for f, p in enumerate(data.owner):
      row, i = ahead[p]
      before[: data.onset[p], f] = fired[0, row : row + data.onset[p], i]
    together = lambda x: np.moveaxis(x, 1, 3).reshape(
      groups * self.together, data.horizon, len(data.fault)
    )[: len(levels)]
    return together(out_fired), together(out_score), before, us


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


class Counter:
  """Alarms of healthy streams at thresholds, each stream run only where no other run of it tells
  (`same`).

  Args:
    streams: number of the healthy streams that are counted, the first. count_from: steps before it
      count nowhere. reuse: False runs everything.
  """

  def __init__(
    self, runner: Runner, data: Samples, streams: int, count_from: int, reuse: bool = True
  ) -> None:
    self.runner, self.data, self.streams, self.count_from, self.reuse = (
      runner,
      data,
      streams,
      count_from,
      reuse,
    )
    self.runs: list[list[tuple[float, np.ndarray, int]]] = [
      [] for _ in range(streams)
    ]  # (threshold, scores (T, M), alarms)
    self.tried: dict[float, int] = {}
    # every alarm so far had a score above the threshold, without which no run tells of another
    self.sound = True

  def score(self) -> np.ndarray:
    """Scores without restarts, (T, streams)."""
    self._run([(s, [math.inf]) for s in range(self.streams)])
    return np.stack([strongest(own[-1][1]) for own in self.runs], 1)

  def _run(self, wanted: list[tuple[int, list[float]]]) -> None:
    self.runner.prepare(self.data)
    size = self.runner.together
    lanes = [(s, t[k : k + size]) for s, t in wanted for k in range(0, len(t), size)]
    full = [(s, np.asarray(t + t[-1:] * (size - len(t)), np.float32)) for s, t in lanes]
    for (s, thresholds), (fired, scores) in zip(lanes, self.runner.healthy(full, self.data)):
      for k, t in enumerate(thresholds):
        self.sound &= not (fired[k] & ~(scores[k] > t).any(-1)).any()
        self.runs[s].append((t, scores[k], int(fired[k, self.count_from :].sum())))

  def _known(self, stream: int, threshold: float) -> int | None:
    """Alarms by another run, None where none tells."""
    under = max(
      (r for r in self.runs[stream] if r[0] <= threshold), key=lambda r: r[0], default=None
    )
    over = min(
      (r for r in self.runs[stream] if r[0] >= threshold), key=lambda r: r[0], default=None
    )
    for run in (under, over):
      if run and (run[0] == threshold or self.reuse and same(run[1], run[0], threshold)):
        return run[2]
    return None

  def count(self, levels: np.ndarray, target: float) -> np.ndarray:
    """Alarms of all streams at each threshold, int (len(levels),). target: only runs around the
    least threshold above all with more are kept.
    """
    levels = [float(t) for t in levels.astype(np.float32)]  # type: ignore[assignment]
    each = {t: [self._known(s, t) for s in range(self.streams)] for t in dict.fromkeys(levels)}
    self._run(
      [
        (s, missing)
        for s in range(self.streams)
        if (missing := [t for t, known in each.items() if known[s] is None])
      ]
    )
    self.tried |= {
      t: sum(self._known(s, t) if k is None else k for s, k in enumerate(known))  # type: ignore[misc]
      for t, known in each.items()
    }
    low = max((t for t, alarms in self.tried.items() if alarms > target), default=-math.inf)
    high = min((t for t in self.tried if t > low), default=math.inf)
    self.runs = [[r for r in own if low <= r[0] <= high or r[0] == math.inf] for own in self.runs]
    return np.asarray([self.tried[t] for t in levels])
