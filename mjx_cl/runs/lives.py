"""Robots side by side: every life is lived once, on whichever core is free.

A stream (arm x seed) that has not begun to learn acts by the weights that its agent ships with, so
the arms of a seed are one life until one of them begins an adaptation: its stream then leaves with
a copy of the robot as it stands, and is a learner from that chunk on.

  herd  up to HERD lives that act as one batch under one set of weights
  band  up to BAND learners that act as one batch, each under its own weights

Watching and learning are programs of one stream. Batches have fixed sizes and are filled up with
repetitions, so a life's numbers do not depend on which others there are, nor on how many cores
share the work. On an accelerator all streams are one band from the start.
"""

from __future__ import annotations

import concurrent.futures
import functools
import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.adapt import methods
from mjx_cl.adapt.loop import Loop, Once
from mjx_cl.adapt.state import ROWS, Digest, Frozen, LoopState, cut, glue
from mjx_cl.adapt.watch import Minds
from mjx_cl.config import CHUNK
from mjx_cl.dreamer.agent import TrainState
from mjx_cl.io.interrupt import threads
from mjx_cl.io.runtime import cores
from mjx_cl.rollout.scan import Row
from mjx_cl.runs.groups import (
  BAND,
  HERD,
  WORK,
  Band,
  Chunk,
  Herd,
  Settle,
  Told,
  departs,
  row_of,
  slim,
)

MANY = 4  # groups for each core, above which a group is seen to as a whole


class Lives:
  """The streams of a run.

  Args:
    rollout: Rollout or Transfer; its `chunk` lives on.
    loop: of every stream.
    streams: robots before the first step, leading (streams, 1).
    trains: the agent of each stream.
    life: name of each stream's life: equal ones have the same robot, agent and keys.
    keys: of the streams, for all but their robots.
    arm_methods: of the arms, as in Choices.
    together: all streams are one band from the start; None: on an accelerator.
    ahead: what a first departure needs is compiled beside the first chunks.
  """

  def __init__(
    self,
    rollout: Any,
    loop: Loop,
    streams: Any,
    trains: Sequence[TrainState],
    life: Sequence[Hashable],
    keys: jax.Array,
    arm_methods: tuple[methods.Method, ...] = (methods.PAPER,),
    together: bool | None = None,
    ahead: bool = False,
  ) -> None:
    self.loop, self.keys = loop, keys
    self.trains, self.streams = list(trains), len(trains)
    self.methods = arm_methods
    together = jax.default_backend() != "cpu" if together is None else together
    # streams of a band, and those that share a LoopState
    self.band_size, self.width = (self.streams, self.streams) if together else (BAND, 1)
    self.herds: list[Herd] = []
    self.bands: list[Band] = []
    self.place: dict[int, tuple[Band, int]] = {}  # learner -> its band and lane
    self.sharing: dict[Hashable, list[int]] = {}  # life -> streams that live it still
    # what compiles beside the first chunks what the first departure will need
    self._ahead: concurrent.futures.Future | None = None
    self._due_ahead = ahead and not together
    live = lambda *given: rollout.chunk(*given, CHUNK)
    self._live = {Herd: Once(live), Band: Once(live)}
    self._programs = (*self._live.values(), *loop.programs)
    if together:
      state = loop.init(trains[0], self.streams, self.methods)
      stack = jax.tree.map(lambda *x: jnp.stack(x), *trains)
      # memories are written at every start, before they are read
      state = state._replace(train=stack, acting=jax.tree.map(jnp.copy, stack.params))
      self.settle_down([Band(list(range(self.streams)), streams, [state])])
    else:
      for g, own in enumerate(life):
        self.sharing.setdefault(own, []).append(g)
      self._gather(streams)
    self.robot = jax.tree.map(lambda x: x[:1], streams)

  def _gather(self, streams: Any) -> None:
    """Herds of all lives."""
    agents = {id(train): train for train in self.trains}
    for train in agents.values():
      own = [life for life, who in self.sharing.items() if self.trains[who[0]] is train]
      one = jax.tree.map(lambda x: jnp.asarray(x)[None], train)
      minds = Minds(one.params, one.slow, one.range)
      for k in range(0, len(own), HERD):
        lives = own[k : k + HERD]
        lanes = np.array([self.sharing[lives[i % len(lives)]][0] for i in range(HERD)])
        robots = jax.tree.map(lambda x: x[lanes].swapaxes(0, 1), streams)
        frozen = [self.loop.frozen() for _ in lives]
        self.herds.append(Herd(lives, train, minds, robots, frozen))

  def settle_down(self, bands: list[Band]) -> None:
    """Takes `bands` as those of all learners."""
    self.bands = bands
    self.place = {g: (band, lane) for band in bands for lane, g in enumerate(band.who)}
    for life, who in self.sharing.items():
      self.sharing[life] = [g for g in who if g not in self.place]

  @property
  def compiled(self) -> float:
    """Seconds that first calls of programs have taken so far, which compile."""
    return sum(program.seconds for program in self._programs)

  # ---- who is where ------------------------------------------------------------------------------

  def _loop_of(self, g: int) -> tuple[LoopState, int]:
    """State of learner g, and its place there."""
    band, lane = self.place[g]
    return band.loops[lane // self.width], lane % self.width

  def acting(self, g: int) -> Any:
    """What stream g acts by."""
    if g not in self.place:
      return self.trains[g].params
    loop, at = self._loop_of(g)
    return jax.tree.map(lambda x: x[at], loop.acting)

  def learnt(self, g: int) -> TrainState:
    """What learner g has learnt, with the weights that it acts by, NumPy."""
    loop, at = self._loop_of(g)
    return jax.tree.map(lambda x: np.asarray(x[at]), loop.train._replace(params=loop.acting))

  def each(self, read: Callable[[Any], jax.Array]) -> np.ndarray:
    """`read` of the robots, which it gets with two leading axes, as (streams, ...)."""
    out: dict[int, np.ndarray] = {}
    for herd in self.herds:
      values = np.asarray(read(herd.streams))[0]
      out |= {g: values[k] for k, life in enumerate(herd.lives) for g in self.sharing[life]}
    for band in self.bands:
      values = np.asarray(read(band.streams))[:, 0]
      out |= {g: values[lane] for lane, g in enumerate(band.who)}
    return np.stack([out[g] for g in range(self.streams)])

  # ---- one chunk ---------------------------------------------------------------------------------

  def step(self, now: int, settle: Settle) -> Chunk:
    """Lives a chunk; `now`: control steps done after it."""
    told: dict[int, tuple[Row, Digest]] = {}
    left: dict[int, tuple[LoopState, Any]] = {}
    seconds = np.zeros((self.streams, len(WORK)))
    # learners first: theirs is most of the work
    groups: list[Herd | Band] = [*self.bands]
    groups += [h for h in self.herds if any(map(self.sharing.get, h.lives))]
    for who, acting, look in self._all(groups, now, settle):
      told |= look.streams
      left |= look.left
      seconds[who] = np.array((acting, *look.seconds)) / len(who)
    for g in sorted(left):
      self._join(g, *left[g])
    if self._ahead is None and self._due_ahead and self.herds:
      self._compile_ahead(now, settle)
    rows, digests = zip(*(told[g] for g in range(self.streams)))
    join = lambda name: np.concatenate([getattr(r, name) for r in rows], 1)
    logged = [None if x is None else join(name) for name, x in rows[0]._asdict().items()]
    return Chunk(row_of(logged), glue(list(digests), ROWS), seconds)

  def _all(
    self, groups: list[Herd | Band], now: int, settle: Settle
  ) -> Iterator[tuple[list[int], float, Told]]:
    """Of all groups: (streams that share a state, seconds of acting, Told)."""

    def whole(group: Herd | Band) -> list[tuple[list[int], float, Told]]:
      rows, took = self._act(group)
      tasks = list(self._tasks(group, rows, now, settle))
      return [(who, took / len(tasks), task()) for who, task in tasks]

    with threads(len(cores())) as pool:
      if len(groups) > MANY * len(cores()):  # rows of a few groups at a time lie in memory
        for told in pool.map(whole, groups):
          yield from told
        return
      acted = {pool.submit(self._act, group): group for group in groups}
      looks = []
      for future in concurrent.futures.as_completed(acted):
        rows, took = future.result()
        tasks = list(self._tasks(acted[future], rows, now, settle))
        looks += [(who, took / len(tasks), pool.submit(task)) for who, task in tasks]
      for who, took, look in looks:
        yield who, took, look.result()

  def _act(self, group: Herd | Band) -> tuple[Row, float]:
    """Rows of a chunk, and the seconds that it took."""
    begin = time.perf_counter()
    if isinstance(group, Herd):
      params = group.minds.params
    else:
      params = group.acting = self._acting(group) if group.acting is None else group.acting
    group.streams, rows = self._live[type(group)](params, group.streams)
    return jax.tree.map(np.asarray, rows), time.perf_counter() - begin

  def _acting(self, band: Band) -> Any:
    """Weights of all lanes of a band; a lane without a learner repeats its first."""
    parts = [loop.acting for loop in band.loops]
    parts += parts[:1] * (self.band_size // self.width - len(parts))
    # copies: the next digest uses the loops' own arrays up
    return jax.tree.map(lambda *x: jnp.array(np.concatenate(x)), *parts)

  def _tasks(
    self, group: Herd | Band, rows: Row, now: int, settle: Settle
  ) -> Iterator[tuple[list[int], Callable[[], Told]]]:
    """What is to be done with a group's rows, each for streams that share it."""
    if isinstance(group, Herd):
      for lane, life in enumerate(group.lives):
        if who := self.sharing[life]:
          own = jax.tree.map(lambda x, lane=lane: x[:, :, lane : lane + 1], rows)
          yield who, functools.partial(self._watch_life, group, lane, who, own, now, settle)
      return
    for k in range(len(group.loops)):
      lanes = slice(k * self.width, (k + 1) * self.width)
      own = cut(rows, lanes, 1)
      yield group.who[lanes], functools.partial(self._watch_band, group, k, own, now, settle)

  def _watch_life(
    self, herd: Herd, lane: int, who: list[int], rows: Row, now: int, settle: Settle
  ) -> Told:
    begin = time.perf_counter()
    step, was, keys = jnp.int32(now), herd.frozen[lane], self.keys[who[0] : who[0] + 1]
    seen, sight = self.loop.watch(herd.minds, was.sight, rows, step, keys)
    phase, digest = jax.block_until_ready(self.loop.rest(was.phase, seen, step))
    herd.frozen[lane] = Frozen(sight, phase)
    # nothing to weigh yet; streams that learn say it too
    if any(method.weighs for method in self.methods):
      unknown = np.full(1, np.nan, np.float32)
      digest = digest._replace(back=np.zeros(1, bool), earned=unknown, earns=unknown)
    digest = jax.tree.map(np.asarray, digest)
    few = slim(rows)
    told, left = {g: (few, digest) for g in who}, {}
    watched = time.perf_counter()
    robot = functools.cache(lambda: jax.tree.map(lambda x: x[:, lane : lane + 1], herd.streams))
    for g in who:
      settled = settle(g, robot)
      at = int(was.phase.phase[0])
      fired = digest.fired[:, 0]
      if departs(fired, at, settled.choices, now, self.loop.repeat, self.loop.config):
        own, phase = jax.tree.map(jnp.copy, (sight, was.phase))  # learning uses its state up
        state = self.loop.init(herd.train, 1, self.methods)._replace(phase=phase)
        state, new = self.loop.learn(
          state, seen, own, rows, step, settled.choices, keys, settled.acceptance
        )
        left[g] = jax.block_until_ready(state), robot()
        told[g] = few, jax.tree.map(np.asarray, new)
    return Told(told, left, (watched - begin, time.perf_counter() - watched))

  def _watch_band(self, band: Band, k: int, rows: Row, now: int, settle: Settle) -> Told:
    begin = time.perf_counter()
    step, state, first = jnp.int32(now), band.loops[k], k * self.width
    taken = np.array(state.executed)  # learning uses the state up
    who = band.who[first : first + self.width]
    keys = self.keys[np.array(who)]
    seen, sight = jax.block_until_ready(self.loop.watch(state.minds, state.sight, rows, step, keys))
    watched = time.perf_counter()
    robot = lambda lane: jax.tree.map(lambda x: x[lane : lane + 1], band.streams)
    settled = [settle(g, functools.partial(robot, first + i)) for i, g in enumerate(who)]
    all_settled = jax.tree.map(lambda *x: jnp.concatenate(x), *settled)
    state, digest = self.loop.learn(
      state, seen, sight, rows, step, all_settled.choices, keys, all_settled.acceptance
    )
    band.loops[k] = jax.block_until_ready(state)
    digest = jax.tree.map(np.asarray, digest)
    learning = (digest.decision > 0).any() or (digest.updates != taken).any()
    if learning or any(method.act is not methods.average for method in self.methods):
      band.acting = None  # in every other chunk weights are what they were
    one = lambda i: Digest(
      *(cut(v, slice(i, i + 1), int(name in ROWS)) for name, v in digest._asdict().items())
    )
    told = {g: (cut(slim(rows), slice(i, i + 1), 1), one(i)) for i, g in enumerate(who)}
    return Told(told, {}, (watched - begin, time.perf_counter() - watched))

  def _join(self, g: int, loop: LoopState, robot: Any) -> None:
    """Stream g is a learner from now on."""
    band = next((b for b in self.bands if len(b.who) < self.band_size), None)
    if band is None:
      spread = lambda x: jnp.concatenate([x] * self.band_size)
      band = Band([], jax.tree.map(spread, robot), [])
      self.bands.append(band)
    at = len(band.who)
    band.streams = jax.tree.map(lambda x, new: x.at[at].set(new[0]), band.streams, robot)
    band.who.append(g)
    band.loops.append(loop)
    band.acting = None
    self.settle_down(self.bands)

  def _compile_ahead(self, now: int, settle: Settle) -> None:
    """On a thread: the programs of a learner, on a departure that leads nowhere."""
    herd, programs = self.herds[0], self.loop.programs
    who = self.sharing[herd.lives[0]][:1]
    if not who:
      return
    frozen, robots = herd.frozen[0], jax.tree.map(lambda x: x[:, :1], herd.streams)

    def ahead() -> None:
      settled, keys = settle(who[0], lambda: robots), self.keys[who[0] : who[0] + 1]
      _, rows = self._live[Herd](herd.minds.params, herd.streams)
      rows = jax.tree.map(lambda x: np.asarray(x)[:, :, :1], rows)
      seen, sight = self.loop.watch(herd.minds, frozen.sight, rows, jnp.int32(now), keys)
      state = self.loop.init(herd.train, 1, self.methods)._replace(**sight._asdict())
      programs.learn.warm(
        state,
        seen,
        rows,
        jnp.int32(now),
        settled.choices,
        keys,
        settled.acceptance,
        self.loop.config,
      )
      spread = lambda x: jnp.concatenate([x] * self.band_size)
      params = jax.tree.map(lambda x: jnp.stack([x] * self.band_size), herd.train.params)
      self._live[Band].warm(params, jax.tree.map(spread, robots))

    pool = concurrent.futures.ThreadPoolExecutor(1, "ahead")
    self._ahead = pool.submit(ahead)
    pool.shutdown(wait=False)
