"""Many streams through one detector, shared among the cores."""

import concurrent.futures
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from mjx_cl.detectors.base import Alarm, Detector
from mjx_cl.errors import UserError
from mjx_cl.io import runtime


def scan(detector: Detector, cores: int | None = None) -> Callable[[Any], Alarm]:
  """A call that runs a detector over streams side by side, from its first state on: one jitted
  program, a scan over time of the vmapped update.

  XLA runs a small step of many streams on one core. So each core has a share of the streams, a
  thread and the same program, which is compiled for the share; a stream's alarms do not depend on
  the others. On another backend than a CPU all streams are one share.

  Args:
    detector: its update takes a number, a vector or any pytree per step.
    cores: shares; default: of a CPU, the cores that this process may use. No more than streams.

  Returns:
    xs, leaves (T, S, ...) -> Alarm(fired bool (T, S), score float32 (T, S)). Compiled at the first
    call and for every new shape.

  Raises:
    UserError for fewer than one core, or leaves without the two axes.
  Example: alarms = detectors.scan(detectors.cusum())(xs)      # alarms.fired: bool (T, S)
  """
  if cores is not None and cores < 1:
    raise UserError(f"scan needs one core or more; got {cores}")

  def run(xs: Any, at: int | jax.Array, share: int) -> Alarm:
    own = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, at, share, 1), xs)
    start = jax.tree.map(lambda x: jnp.broadcast_to(x, (share,) + jnp.shape(x)), detector.init())
    return jax.lax.scan(jax.vmap(detector.update), start, own)[1]

  programs: dict[tuple, Callable[[Any, int], Alarm]] = {}

  def program(xs: Any, share: int) -> Callable[[Any, int], Alarm]:
    """Compiled for these shapes, before the threads start: each would compile it for itself."""
    key = (jax.tree.structure(xs), *((x.shape, x.dtype) for x in jax.tree.leaves(xs)), share)
    if key not in programs:
      programs[key] = jax.jit(functools.partial(run, share=share)).lower(xs, 0).compile()
    return programs[key]

  def call(xs: Any) -> Alarm:
    xs = jax.tree.map(jnp.asarray, xs)
    shapes = {x.shape[:2] for x in jax.tree.leaves(xs)}
    if len(shapes) != 1 or len(*shapes) != 2 or 0 in min(shapes):
      raise UserError(
        "scan takes leaves of one or more samples and streams, time first; got "
        f"{', '.join(map(str, sorted(shapes)))}"
      )
    streams = min(shapes)[1]
    number = min(streams, cores or (len(runtime.cores()) if jax.default_backend() == "cpu" else 1))
    share = -(-streams // number)
    starts = [
      min(k * share, streams - share) for k in range(-(-streams // share))
    ]  # the last begins earlier where the shares do not divide the streams
    one = program(xs, share)
    if len(starts) == 1:
      return one(xs, 0)
    with concurrent.futures.ThreadPoolExecutor(len(starts), "scan") as pool:
      parts = list(pool.map(lambda at: jax.block_until_ready(one(xs, at)), starts))
    parts[-1] = jax.tree.map(lambda x: x[:, share * len(starts) - streams :], parts[-1])
    return jax.tree.map(lambda *x: jnp.concatenate(x, 1), *parts)

  return call
