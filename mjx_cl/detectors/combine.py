"""Combinators: a detector of a channel, several together, several samples together, and what a
stream passes through first.
"""

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Float

from mjx_cl.detectors.base import Alarm, Count, Detector, Flag, anew, demand, keep
from mjx_cl.errors import UserError
from mjx_cl.rollout.monitor import CHANNELS, Residual
from mjx_cl.types import Array

NAMES = f"{', '.join(CHANNELS)}, variable_0 and so on"


def is_channel(name: Any) -> bool:
  """Whether `read` knows the name; how many variables there are only the residual tells."""
  if not isinstance(name, str):
    return False
  return name in CHANNELS or name.startswith("variable_") and name[9:].isdigit()


def read(channel: str, residual: Residual) -> Float[Array, "*rows"]:
  """One number of a monitor.Residual, or of rows of them with leading axes: `opr`, `rpr`, `reward`,
  `surprise`, `group_0` .. `group_7`, or `variable_0` and so on, the residual of a single
  observation variable. Unknown values are nan. UserError for a variable that the residual does not
  hold.
  """
  if channel.startswith("group_"):
    return residual.groups[..., int(channel[6:])]
  if channel.startswith("variable_"):
    index, size = int(channel[9:]), residual.variables.shape[-1]
    if index >= size:
      raise UserError(
        f"no channel {channel}: the residual holds {size} variables"
        + ("" if size else ", since recorded streams keep groups of them alone")
      )
    return residual.variables[..., index]
  return getattr(residual, channel)


def on(channel: str, detector: Detector, log: bool = False) -> Detector:
  """A single-residual detector on one channel of monitor.Residual. A sample that is invalid or no
  finite number leaves its state unchanged.

  Args:
    log: ln max(x, 1e-9) in place of x; residuals are positive and skewed.
  """
  if not is_channel(channel):
    raise UserError(f"unknown channel {channel!r}; choose from: {NAMES}")

  def update(state: Any, residual: Residual) -> tuple[Any, Alarm]:
    x = read(channel, residual)
    valid = jnp.isfinite(x) & (residual.valid | (channel in ("reward", "surprise")))
    x = jnp.where(valid, x, jnp.nan if detector.skips else 0.0)
    new, alarm = detector.update(state, jnp.log(jnp.maximum(x, 1e-9)) if log else x)
    if not detector.skips:
      new = keep(valid, new, state)
    return new, Alarm(alarm.fired & valid, jnp.where(valid, alarm.score, jnp.nan))

  return Detector(detector.init, update, anew=detector.anew)


def any_of(*detectors: Detector) -> Detector:
  """Fires when any member fires; score = the largest of the members' scores that are known."""

  def update(states: tuple[Any, ...], x: Any) -> tuple[tuple[Any, ...], Alarm]:
    out = [d.update(s, x) for d, s in zip(detectors, states)]
    fired = jnp.any(jnp.stack([alarm.fired for _, alarm in out]))
    scores = jnp.stack([alarm.score for _, alarm in out])
    known = jnp.where(jnp.isnan(scores), -jnp.inf, scores).max()
    return tuple(state for state, _ in out), Alarm(
      fired, jnp.where(jnp.all(jnp.isnan(scores)), jnp.nan, known)
    )

  return Detector(
    lambda: tuple(d.init() for d in detectors),
    update,
    members=detectors,
    anew=lambda: tuple(anew(d)() for d in detectors),
  )


class RunState(NamedTuple):
  """What patience remembers.

  Attributes:
    inner: state of the detector.
    run: int32 (), scores in a row above the threshold, at most k.
  """

  inner: Any
  run: jax.Array


def patience(factory: Callable[..., Detector], k: int, **settings: Any) -> Detector:
  """`factory(**settings)`, but firing only at the k-th score above its threshold in a row; k = 1
  changes nothing.

  Until then the detector does not know its threshold, so that its evidence goes on where it would
  have been spent by an alarm. It fires at the k-th and starts afresh as always; what a run is to it
  (cusum: spent by the alarm; z_score: one alarm per excursion) stays as it is. A sample without a
  score neither lengthens nor ends a run. Takes a factory, since a finished detector's threshold
  cannot be held back.
  """
  demand("patience", k=(k, k >= 1, "at least 1"))
  known = inspect.signature(factory).parameters
  if "threshold" not in known:
    raise UserError("patience needs a detector with a setting `threshold`")
  first = factory(**settings)
  threshold = settings.pop("threshold", known["threshold"].default)

  def update(state: RunState, x: Any) -> tuple[RunState, Alarm]:
    detector = factory(threshold=jnp.where(state.run >= k - 1, threshold, jnp.inf), **settings)
    inner, alarm = detector.update(state.inner, x)
    run = jnp.where(alarm.score > threshold, jnp.minimum(state.run + 1, k), 0)
    return RunState(inner, jnp.where(jnp.isnan(alarm.score), state.run, run)), alarm

  begin = lambda inner: RunState(inner, jnp.int32(0))
  return Detector(lambda: begin(first.init()), update, anew=lambda: begin(anew(first)()))


class CoolState(NamedTuple):
  """What a cool-down remembers.

  Attributes:
    inner: state of the detector.
    left: int32 (), samples for which alarms are still dropped.
  """

  inner: Any
  left: jax.Array


def cool_down(detector: Detector, steps: int) -> Detector:
  """Drops the alarms of the `steps` samples after one that counted. The detector runs on meanwhile,
  and a dropped alarm restarts its evidence too. A sample without a score does not count; 0 changes
  nothing.
  """
  demand("cool_down", steps=(steps, steps >= 0, "at least 0"))

  def update(state: CoolState, x: Any) -> tuple[CoolState, Alarm]:
    inner, alarm = detector.update(state.inner, x)
    fired = alarm.fired & (state.left == 0)
    left = jnp.where(jnp.isnan(alarm.score), state.left, jnp.maximum(state.left - 1, 0))
    return CoolState(inner, jnp.where(fired, steps, left)), Alarm(fired, alarm.score)

  begin = lambda inner: CoolState(inner, jnp.int32(0))
  return Detector(lambda: begin(detector.init()), update, anew=lambda: begin(anew(detector)()))


class Sums(NamedTuple):
  """Sums over the first `warmup` samples d = x - origin of a stream, (order + 1,) by lag.

  Attributes:
    products: float32 (order + 1,), sum of d_t d_{t-k}.
    first: float32 (order + 1,), sum of the first k samples' d.
    last: float32 (order + 1,), sum of the last k samples' d.
    total: float32 (), sum of d.
  """

  products: jax.Array
  first: jax.Array
  last: jax.Array
  total: jax.Array


class Filters(NamedTuple):
  """Prediction error filters of one order.

  Attributes:
    forward: float32 (order + 1,).
    backward: float32 (order + 1,).
    error: float32 (), variance of their output.
  """

  forward: jax.Array
  backward: jax.Array
  error: jax.Array


class WhitenedState(NamedTuple):
  """What whitening remembers.

  Attributes:
    seen: int32 (), samples, at most warmup + order.
    origin: float32 (), the first sample.
    recent: float32 (order,), the last d, newest first; 0 where there is none.
    sums: of the warm-up.
    filters: fitted to it.
    inner: state of the detector.
  """

  seen: jax.Array
  origin: jax.Array
  recent: jax.Array
  sums: Sums
  filters: Filters
  inner: Any


def levinson(sums: Sums, filters: Filters, begins: Flag, warmup: int) -> Filters:
  """Filters of one order more, by Levinson's recursion from the autocovariances that the sums give;
  it begins with the variance of the stream.
  """
  lag = jnp.arange(len(sums.products))
  mean = sums.total / warmup
  c = (
    sums.products
    - mean * (2 * sums.total - sums.first - sums.last)
    + (warmup - lag) * jnp.square(mean)
  ) / warmup
  error = jnp.where(begins, c[0], filters.error)
  behind = jnp.concatenate([jnp.zeros(1), filters.backward[:-1]])
  # the floor: a deviation of 1e-6, as in base.standardise
  reflection = jnp.sum(behind * c) / jnp.maximum(error, 1e-12)
  return Filters(
    filters.forward - reflection * behind,
    behind - reflection * filters.forward,
    error * (1 - jnp.square(reflection)),
  )


def added(sums: Sums, window: Float[Array, " lags"], n: Count) -> Sums:
  """The sums with one sample more, the first of `window`, behind `n` others."""
  d = window[0]
  return Sums(
    sums.products + d * window,
    sums.first + jnp.where(n < jnp.arange(len(window)), d, 0.0),
    jnp.concatenate([jnp.zeros(1), sums.last[:-1] + d]),
    sums.total + d,
  )


def whitened(detector: Detector, order: int = 8, warmup: int = 1000) -> Detector:
  """Hands a detector of one number the innovations of an autoregression that is fitted to the
  stream's own first samples.

    c_k = 1/N sum_{t=k+1..N} (x_t - m)(x_{t-k} - m),  m = mean of x_1..x_N,  N = warmup
    sum_j a_j c_|i-j| = c_i, i = 1..order (Yule-Walker; its solution is stable)
    e_t = x_t - m - sum_j a_j (x_{t-j} - m)

  The equations are solved by Levinson's recursion, one order at each of the `order` samples after
  the warm-up, so that under vmap no step pays for the whole solution. The detector sees e_t from
  sample warmup + order + 1 on and has its own warm-up from there. A shift D of the mean arrives as
  D at its first sample and as D (1 - sum a_j) later: swings of the gait no longer pile up in a
  cumulative sum, and a lasting shift of a strongly dependent stream is as small as it is.

  Args:
    detector: of one number.
    order: samples that predict the next.
    warmup: samples that fit the autoregression [control steps].

  Returns:
    Detector of x, float32 (); Alarm.score is nan until the inner detector knows one.
  Blind to: whatever repeats with the dependence of the healthy stream. Innovations are
  uncorrelated, not independent or Gaussian. Samples masked out are skipped: their neighbours count
  as adjacent.
  Reference: Alwan and Roberts 1988, J. Bus. Econ. Stat. 6, 87-95; Durbin 1960, Rev. Int. Stat.
  Inst. 28, 233-244.
  """
  demand(
    "whitened",
    order=(order, order >= 1, "at least 1"),
    warmup=(warmup, warmup > 2 * order, "more than twice the order"),
  )

  def init() -> WhitenedState:
    zeros = lambda: jnp.zeros(order + 1)
    return WhitenedState(
      jnp.int32(0),
      jnp.float32(0),
      jnp.zeros(order),
      Sums(zeros(), zeros(), zeros(), jnp.float32(0)),
      Filters(zeros().at[0].set(1.0), zeros().at[0].set(1.0), jnp.float32(0)),
      detector.init(),
    )

  def update(state: WhitenedState, x: ArrayLike) -> tuple[WhitenedState, Alarm]:
    x, n = jnp.asarray(x, jnp.float32), state.seen
    origin = jnp.where(n == 0, x, state.origin)
    window = jnp.concatenate([(x - origin)[None], state.recent])
    ready = n >= warmup + order
    solved = levinson(state.sums, state.filters, n == warmup, warmup)
    filters = keep((n >= warmup) & ~ready, solved, state.filters)
    sums = keep(n < warmup, added(state.sums, window, n), state.sums)
    innovation = jnp.sum(filters.forward * (window - state.sums.total / warmup))
    inner, alarm = detector.update(state.inner, jnp.where(ready, innovation, 0.0))
    inner = keep(ready, inner, state.inner)
    seen = jnp.where(ready, n, n + 1)
    new = WhitenedState(seen, origin, window[:-1], sums, filters, inner)
    return new, Alarm(alarm.fired & ready, jnp.where(ready, alarm.score, jnp.nan))

  return Detector(init, update)
