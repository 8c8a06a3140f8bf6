"""A detector over the columns of a log: which there are, and the compiled program of one."""

import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.detectors import DETECTORS, Alarm, Detector, rolling_sigma
from mjx_cl.detectors.base import keep
from mjx_cl.errors import choose
from mjx_cl.rollout.monitor import unknown

LEVELS = 8  # thresholds tried side by side
# rows of the trailing mean of a detector over all columns, a quarter of the warm-up at most
SMOOTH = 100


def _rolling(threshold: float, warmup: int) -> Detector:
  """`rolling_sigma` as the paper has it, its window as long as the warm-up."""
  return rolling_sigma(threshold=threshold, window=warmup, warmup=warmup)


def table() -> dict[str, Callable[..., Detector]]:
  """Detectors of one number per sample, those of DETECTORS that are marked so, and the paper's
  rule; and those of several channels, which watch all columns together.
  """
  takes = lambda build, kind: getattr(build, "takes", "") == kind
  told = lambda build: set(inspect.signature(build).parameters)
  found = {
    name: build
    for name, build in DETECTORS.items()
    if takes(build, "scalar")
    and not getattr(build, "reference", False)
    and "threshold" in told(build)
  }
  together = {name: build for name, build in DETECTORS.items() if joint(build)}
  return {"rolling_sigma_plain": _rolling} | found | together


def joint(factory: Callable[..., Detector]) -> bool:
  """Whether a factory is told its channels: then one detector watches all columns."""
  wanted = {"channels", "log", "threshold", "warmup"}
  return (
    getattr(factory, "takes", "") == "residual"
    and wanted <= inspect.signature(factory).parameters.keys()
  )


def together(
  factory: Callable[..., Detector], threshold: float | jax.Array, warmup: int, columns: int
) -> Detector:
  """A detector of several channels on a row of `columns` numbers; a row with a missing one is
  passed over.
  """
  settings: dict[str, Any] = {
    "channels": tuple(f"variable_{k}" for k in range(columns)),
    "smooth": max(1, min(SMOOTH, warmup // 4)),
  }
  own = inspect.signature(factory).parameters
  told = {name: value for name, value in settings.items() if name in own}
  inner = factory(threshold=threshold, warmup=warmup, log=False, **told)
  residual = jax.tree.map(lambda x: x[0], unknown((1,), columns))
  return Detector(
    inner.init,
    lambda state, x: inner.update(state, residual._replace(variables=x, valid=jnp.bool_(True))),
  )


class Program:
  """One detector over many columns and LEVELS thresholds at once, compiled once; thresholds, states
  and samples are its arguments.
  """

  def __init__(self, name: str, warmup: int, columns: int, chunk: int) -> None:
    factory = choose("detector", name, table())
    parameters = inspect.signature(factory).parameters
    several, plain = joint(factory), parameters["threshold"].default
    settings = {"warmup": warmup} if "warmup" in parameters else {}

    def build(threshold: float | jax.Array) -> Detector:
      if several:
        return together(factory, threshold, warmup, columns)
      return factory(threshold=threshold, **settings)

    self.columns = 1 if several else columns  # of its alarms
    self.start = jax.tree.map(
      lambda x: jnp.broadcast_to(x, (LEVELS, self.columns) + jnp.shape(x)),
      build(1.0 if plain is inspect.Parameter.empty else plain).init(),
    )
    self.chunk = chunk

    def single(threshold: jax.Array, state: Any, x: jax.Array) -> tuple[Any, Alarm]:
      known = jnp.all(jnp.isfinite(x))
      new, alarm = build(threshold).update(state, jnp.where(known, x, 0.0))
      score = jnp.where(known, alarm.score, jnp.nan)
      return keep(known, new, state), Alarm(alarm.fired & known, score)

    def run(
      thresholds: jax.Array, states: Any, xs: jax.Array
    ) -> tuple[Any, tuple[jax.Array, jax.Array, jax.Array]]:
      every = jax.vmap(jax.vmap(single, (None, 0, 0)), (0, 0, None))

      def step(states: Any, x: jax.Array) -> tuple[Any, tuple[jax.Array, jax.Array, jax.Array]]:
        states, alarm = every(thresholds, states, x[None] if several else x)
        return states, (alarm.fired.any(-1), alarm.fired[0], alarm.score[0])

      return jax.lax.scan(step, states, xs)

    self.run = jax.jit(run)

  def __call__(
    self, thresholds: np.ndarray | jax.Array, states: Any, xs: np.ndarray
  ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray]:
    """Over xs (T, C), in calls of equal shape; rows that fill up the last are missing samples,
    which change nothing.

    Returns:
      (states', alarms of any column bool (T, LEVELS), alarms bool (T, C) and scores (T, C) at the
      first threshold); C is 1 where one detector watches all.
    """
    thresholds, parts = jnp.asarray(thresholds, jnp.float32), []
    for begin in range(0, len(xs), self.chunk):
      part = xs[begin : begin + self.chunk]
      part = np.pad(part, ((0, self.chunk - len(part)), (0, 0)), constant_values=np.nan)
      states, out = self.run(thresholds, states, jnp.asarray(part, jnp.float32))
      parts.append(jax.tree.map(np.asarray, out))
    return states, *(np.concatenate(x)[: len(xs)] for x in zip(*parts))
