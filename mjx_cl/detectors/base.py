"""The contract of a detector, and what the detectors share."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int

from mjx_cl.errors import UserError
from mjx_cl.types import Array

Flag = Bool[Array, ""]
Count = Int[Array, ""]
Number = Float[Array, ""]
# whole numbers are legal where a float is
Real = float | int
# settings as a caller may write them: also whole, or traced in a calibration
Setting = float | int | Array


class Alarm(NamedTuple):
  """What a detector says of one sample.

  Attributes:
    fired: bool ().
    score: float32 (), larger is more suspect; nan where the sample was masked or nothing is known
      yet.
  """

  fired: jax.Array
  score: jax.Array


class Detector(NamedTuple):
  """A pair of pure functions over one stream.

  A factory's `threshold` is compared as score > threshold and may be traced, so that one compiled
  program serves a whole calibration. After an alarm the evidence starts from nothing, what was
  learnt of the healthy robot stays, unless the factory says otherwise.

  Attributes:
    init: () -> state, a pytree of arrays.
    update: (state, x) -> (state, Alarm), same structure, shapes and dtypes in and out: scannable
      and vmappable.
    skips: whether a scalar x that is nan leaves the state as it is and has no score; `combine.on`
      then need not compare a long state element by element at every sample.
    members: the detectors of which any fires, whose largest score hides what the others do.
    anew: () -> state of a detector that is to learn from the next samples what it was told of the
      healthy robot, after a finetuning has changed the agent; None: init learns that anyway.

  Example: _, out = jax.lax.scan(det.update, det.init(), xs)      # out.fired: bool (T,)
  """

  init: Callable[[], Any]
  update: Callable[[Any, Any], tuple[Any, Alarm]]
  skips: bool = False
  members: tuple["Detector", ...] = ()
  anew: Callable[[], Any] | None = None


def anew(detector: Detector) -> Callable[[], Any]:
  """What gives the state of a detector after a finetuning, see Detector."""
  return detector.anew or detector.init


def scalar(factory: Callable[..., Detector]) -> Callable[..., Detector]:
  """Marks a factory whose detectors take one number per step; `make` puts them on channels of
  monitor.Residual. Works for plug-ins too.
  """
  factory.takes = "scalar"  # type: ignore[attr-defined]
  return factory


def whole(factory: Callable[..., Detector]) -> Callable[..., Detector]:
  """Marks a factory whose detectors take a whole monitor.Residual per step."""
  factory.takes = "residual"  # type: ignore[attr-defined]
  return factory


def demand(name: str, **rules: tuple[Any, bool, str]) -> None:
  """Refuses settings out of range.

  Example: demand("cusum", threshold=(threshold, above(threshold, 0), "above 0"))
  """
  for setting, (value, holds, rule) in rules.items():
    if not holds:
      raise UserError(f"detector {name!r}: {setting} must be {rule}; got {value}")


def at_least(low: int, **values: int) -> dict[str, tuple[int, bool, str]]:
  """Rules of `demand` for settings that share a lower bound."""
  return {setting: (value, value >= low, f"at least {low}") for setting, value in values.items()}


def above(value: Setting, low: Real) -> bool:
  """Value > low; a traced value, which has no number yet, passes."""
  return isinstance(value, jax.core.Tracer) or bool(value > low)


def keep(known: Flag, new: Any, old: Any) -> Any:
  """`new` where known, else `old`; for leaves small enough to be copied at each step."""
  return jax.tree.map(lambda a, b: jnp.where(known, a, b), new, old)


def judged(score: Number, known: Flag, threshold: Setting) -> Alarm:
  """The alarm of a score, which is known or not."""
  return Alarm(known & (score > threshold), jnp.where(known, score, jnp.nan))


class Warm(NamedTuple):
  """Mean and deviation of a stream's first samples, frozen then.

  Attributes:
    seen: int32 (), samples.
    mean: float32 (), or (p,) of a vector.
    squares: float32, as the mean: sum of squared deviations.
  """

  seen: jax.Array
  mean: jax.Array
  squares: jax.Array


def cold(*shape: int) -> Warm:
  """Nothing seen."""
  return Warm(jnp.int32(0), jnp.zeros(shape), jnp.zeros(shape))


def standardise(
  state: Warm, x: Float[Array, "*p"], warmup: int
) -> tuple[Warm, Float[Array, "*p"], Flag]:
  """Z = (x - mean) / max(std, 1e-6) with mean and std (n, not n - 1) of the first `warmup` samples,
  by Welford's recursion.

  Returns:
    (state', z, ready): ready is false, and z means nothing, during warm-up. warmup = 0 takes x as
    standardised already: z = x.
  """
  if warmup == 0:
    return state, x, jnp.bool_(True)
  ready, seen = state.seen >= warmup, state.seen + 1
  step = x - state.mean
  mean = state.mean + step / seen
  state = keep(ready, state, Warm(seen, mean, state.squares + step * (x - mean)))
  z = (x - state.mean) / jnp.maximum(jnp.sqrt(state.squares / jnp.maximum(1, state.seen)), 1e-6)
  return state, z, ready


class ChartState(NamedTuple):
  """What a chart remembers.

  Attributes:
    warm: the reference.
    evidence: what the chart gathers, at its start again after an alarm.
  """

  warm: Warm
  evidence: Any


class Sides(NamedTuple):
  """Evidence for either direction.

  Attributes:
    up: float32 (), for a rise.
    down: float32 (), for a fall.
  """

  up: jax.Array
  down: jax.Array


def chart(
  start: Callable[[], Any],
  step: Callable[[Any, Number], tuple[Any, Number]],
  threshold: Setting,
  warmup: int,
) -> Detector:
  """A detector of one number that gathers evidence from its standardised samples.

  Args:
    start: () -> evidence of nothing, for the beginning, the warm-up and after an alarm.
    step: (evidence, z) -> (evidence', score); a score of nan is unknown.
    threshold: decision level of the score.
    warmup: see `standardise`.
  """

  def update(state: ChartState, x: ArrayLike) -> tuple[ChartState, Alarm]:
    warm, z, ready = standardise(state.warm, jnp.asarray(x, jnp.float32), warmup)
    evidence, score = step(state.evidence, z)
    alarm = judged(score, ready, threshold)
    return ChartState(warm, keep(ready & ~alarm.fired, evidence, start())), alarm

  return Detector(lambda: ChartState(cold(), start()), update)
