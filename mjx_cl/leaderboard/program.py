"""The one compiled program of a detector on recorded streams: stretches of many lanes, one after
the other.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.detectors.base import Detector
from mjx_cl.rollout.monitor import Residual


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
  members = getattr(detector.update, "members", None)

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
