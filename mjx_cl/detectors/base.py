"""The contract of a detector, and what the detectors share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.errors import UserError


class Alarm(NamedTuple):
  """Attributes:
  fired: bool (). score: float32 (), larger is more suspect; nan where the sample was masked or
  nothing is known yet.
  """

  fired: jax.Array
  score: jax.Array


class Detector(NamedTuple):
  """Attributes:
    init: () -> state, a pytree of arrays.
    update: (state, x) -> (state, Alarm), same structure, shapes and dtypes in and out: scannable
      and vmappable. Where `update.skips` is set, a scalar x that is nan leaves the state as it is
      and has no score; `combine.on` then need not compare a long state element by element at every
      sample.

  A factory's `threshold` is compared as score > threshold and may be traced, so that one compiled
  program serves a whole calibration. After an alarm the evidence starts from nothing, what was
  learnt of the healthy robot stays, unless the factory says otherwise.
  """

  init: Callable[[], Any]
  update: Callable[[Any, Any], tuple[Any, Alarm]]


def scalar(factory: Callable[..., Detector]) -> Callable[..., Detector]:
  """Marks a factory whose detectors take one number per step; `make` puts them on channels of
  monitor.Residual. Works for plug-ins too.
  """
  factory.takes = "scalar"  # type: ignore[attr-defined]
  return factory


def demand(name: str, **rules: tuple[Any, bool, str]) -> None:
  """Refuses settings out of range.

  Example: demand("cusum", threshold=(threshold, above(threshold, 0), "above 0"))
  """
  for setting, (value, holds, rule) in rules.items():
    if not holds:
      raise UserError(f"detector {name!r}: {setting} must be {rule}; got {value}")


def above(value: float | jax.Array, low: float) -> bool:
  """Value > low; a traced value, which has no number yet, passes."""
  return isinstance(value, jax.core.Tracer) or bool(value > low)


class Warm(NamedTuple):
  """Mean and deviation of a stream's first samples, frozen then.

  Attributes:
    count: int32 (). mean: float32 (). squares: float32 (), sum of squared deviations.
  """

  count: jax.Array  # type: ignore[assignment]
  mean: jax.Array
  squares: jax.Array


def cold() -> Warm:
  """Nothing seen."""
  return Warm(jnp.int32(0), jnp.float32(0), jnp.float32(0))


def standardise(state: Warm, x: jax.Array, warmup: int) -> tuple[Warm, jax.Array, jax.Array]:
  """Z = (x - mean) / max(std, 1e-6) with mean and std (n, not n - 1) of the first `warmup` samples,
  by Welford's recursion.

  Returns:
    (state', z, ready): ready is false, and z means nothing, during warm-up. warmup = 0 takes x as
    standardised already: z = x.
  """
  if warmup == 0:
    return state, x, jnp.bool_(True)
  ready = state.count >= warmup
  count = state.count + 1
  step = x - state.mean
  mean = state.mean + step / count
  new = Warm(count, mean, state.squares + step * (x - mean))
  state = jax.tree.map(lambda a, b: jnp.where(ready, a, b), state, new)
  z = (x - state.mean) / jnp.maximum(jnp.sqrt(state.squares / jnp.maximum(1, state.count)), 1e-6)
  return state, z, ready
