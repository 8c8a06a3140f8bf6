"""What is run of a detector on a robot: its streams one after the other, and the one compiled
program that lives stretches of many lanes of them.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.detectors.base import Detector
from mjx_cl.leaderboard.streams import StreamSet
from mjx_cl.rollout.monitor import Residual

LANES, LANES_SHARED = 80, 20  # side by side: of one threshold each, or of thresholds.TOGETHER
LEVELS = 5  # thresholds that fault streams are run at: the calibrated one and those of the curve


class Samples(NamedTuple):
  """The streams of one robot, one after the other.

  Attributes:
    residual: monitor.Residual with leading (N,), unknown rows at the end.
    steps: of each healthy stream.
    horizon: of each fault stream, from its onset.
    healthy: int (S,), first row of each healthy stream, those that tune first.
    past: int (P,), first row of each past.
    onset: int (P,), steps of each past.
    fault: int (F,), row of each fault stream's onset.
    owner: int (F,), past of each fault stream.
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
  """Sizes that serve all robots of a set, so that none is compiled anew.

  Attributes:
    samples: rows of Samples.
    rows: output rows by number of lanes.
    pasts: of fault streams.
  """

  samples: int
  rows: dict[int, int]
  pasts: int


def room(streams: StreamSet, robots: Iterable[str]) -> Room:
  """Room for these robots of a set; a robot whose streams share fewer pasts than their seeds takes
  more, and compiles anew.
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
      own = -(-copies * seeds // lanes) * most + -(-copies * number // lanes) * horizon
      rows[lanes] = max(rows[lanes], longest, own)
  return Room(samples, rows, pasts)


def _owners(fault: Residual, onset: np.ndarray, seed: np.ndarray) -> tuple[list[int], np.ndarray]:
  """(a fault stream of each past, past of each fault stream): streams of one seed and onset share
  a past where it is the same in all residuals.
  """
  leaves = jax.tree.leaves(fault)
  same = lambda a, b, steps: all(
    np.array_equal(x[:steps, a], x[:steps, b], equal_nan=x.dtype.kind == "f") for x in leaves
  )
  lanes: list[int] = []
  owner: list[int] = []
  for column, (first, number) in enumerate(zip(onset, seed)):
    shares = lambda k, first=first, number=number, column=column: (
      onset[lanes[k]] == first and seed[lanes[k]] == number and same(lanes[k], column, first)
    )
    owner.append(next(filter(shares, range(len(lanes))), len(lanes)))
    if owner[-1] == len(lanes):
      lanes.append(column)
  return lanes, np.asarray(owner, int)


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
    nominal: monitor.Residual, NumPy.
    fault: monitor.Residual, NumPy.
    onset: int (F,).
    seed: int (F,).
    horizon: steps kept from the onset on.
    most: rows to fill up to.
  """
  lanes, owner = _owners(fault, onset, seed)
  steps, streams = nominal.opr.shape
  past, after = onset[lanes].astype(int), np.full(len(onset), horizon)
  starts = np.concatenate([[0], np.cumsum(np.concatenate([np.full(streams, steps), past, after]))])
  total, cut = max(int(starts[-1]) + 1, most), streams + len(lanes)

  def flat(a: np.ndarray, b: np.ndarray) -> jax.Array:
    out = np.full((total,) + a.shape[2:], False if a.dtype == bool else np.nan, a.dtype)
    out[: streams * steps] = np.swapaxes(a, 0, 1).reshape((streams * steps,) + a.shape[2:])
    for at, column, n in zip(starts[streams:], lanes, past):
      out[at : at + n] = b[:n, column]
    for column, at in enumerate(starts[cut:-1]):
      part = b[onset[column] : onset[column] + horizon, column]
      out[at : at + len(part)] = part
    return jax.device_put(out)

  return Samples(
    jax.tree.map(flat, nominal, fault),
    steps,
    horizon,
    starts[:streams],
    starts[streams:cut],
    past,
    starts[cut:-1],
    owner,
  )


class Stretch(NamedTuple):
  """What n of the lanes live in one go, see `program`.

  Attributes:
    thresholds: float (K, n).
    first: int (n,), row of the samples that a lane begins at.
    steps: rows that it lives.
    row: of the output that it begins at.
    source: int (n,), 0 the detector's init, else a place of the pool.
    into: int (n,), place of the pool for the last state, the last place: nowhere.
  """

  thresholds: Any
  first: Any
  steps: Any
  row: Any
  source: Any
  into: Any


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
  """Whether the scores are free of the threshold, by the structure of the program.

  Args:
    build: threshold -> Detector.
    sample: monitor.Residual of one row.
  """

  def scores(threshold: jax.Array, xs: Residual) -> jax.Array:
    detector = build(threshold)
    return jax.lax.scan(updates(detector), detector.init(), xs)[1][1]

  xs = jax.tree.map(lambda x: x[None], sample)
  try:
    jax.eval_shape(jax.vmap(scores, (0, None), None), jnp.zeros(2), xs)
  except ValueError:  # what vmap says of an output that differs along the mapped axis
    return False
  return True


def program(build: Callable, rows: int, pool: int) -> jax.stages.Wrapped:
  """The one program of a detector, jitted: stretches of lanes one after the other, each from a
  state that is held and into one.

    (stretches, number of stretches, residual (N, ..)) -> fired, scores

  The fields of Stretch have a leading (G,) there, the thresholds (G, K, L) for L lanes.

  Args:
    build: threshold -> Detector.
    rows: of the output.
    pool: places for states.

  Returns:
    fired bool (K, rows, L), scores float32 (K, rows, L, M), see `updates`; rows that were not
    reached are False, nan.
  """
  init = jax.vmap(lambda t: build(t).init())
  move = jax.vmap(lambda t, state, x: updates(build(t))(state, x))

  def run(all_of: Stretch, stretches: jax.Array, residual: Residual) -> tuple[jax.Array, jax.Array]:
    _, first, steps, row, source, into = all_of

    def one(thresholds: jax.Array) -> tuple[jax.Array, jax.Array]:  # (G, L)
      sample = lambda at: jax.tree.map(lambda r: r[at], residual)
      begun = init(thresholds[0])
      like = jax.eval_shape(move, thresholds[0], begun, sample(first[0]))[1][1]

      def stretch(g: jax.Array, carry: tuple) -> tuple[Any, jax.Array, jax.Array]:
        held, fired, scores = carry
        start, before = init(thresholds[g]), jax.tree.map(lambda p: p[source[g]], held)
        fresh = lambda a, b: jnp.where((source[g] == 0).reshape((-1,) + (1,) * (a.ndim - 1)), a, b)

        def step(i: jax.Array, carry: tuple) -> tuple[Any, jax.Array, jax.Array]:
          state, fired, scores = carry
          state, (f, s) = move(thresholds[g], state, sample(first[g] + i))
          put = lambda rows, x: jax.lax.dynamic_update_index_in_dim(rows, x, row[g] + i, 0)
          return state, put(fired, f), put(scores, s)

        state, fired, scores = jax.lax.fori_loop(
          0, steps[g], step, (jax.tree.map(fresh, start, before), fired, scores)
        )
        return jax.tree.map(lambda p, x: p.at[into[g]].set(x), held, state), fired, scores

      held = jax.tree.map(lambda x: jnp.zeros((pool,) + x.shape[1:], x.dtype), begun)
      fired = jnp.zeros((rows, first.shape[1]), bool)
      scores = jnp.full((rows,) + like.shape, jnp.nan, jnp.float32)
      return jax.lax.fori_loop(0, stretches, stretch, (held, fired, scores))[1:]

    return jax.vmap(one, 1)(all_of.thresholds)

  return jax.jit(run)
