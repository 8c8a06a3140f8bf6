"""The oracle of the leaderboard: CUSUM of a log-likelihood ratio that was fitted on other seeds of
the very fault.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from mjx_cl.detectors.base import Alarm, Detector, Number, Setting, above, demand, judged, whole
from mjx_cl.detectors.multivariate import Rows, pick
from mjx_cl.errors import UserError
from mjx_cl.rollout.monitor import CHANNELS, Residual
from mjx_cl.types import Array


class LikelihoodRatioState(NamedTuple):
  """What the detector remembers.

  Attributes:
    recent: float32 (order, C), the last samples, newest first.
    seen: int32 (), samples, at most `order`.
    evidence: float32 () [nats].
  """

  recent: jax.Array
  seen: jax.Array
  evidence: jax.Array


def misfit(model: Any, recent: Float[Array, "order channels"], x: Rows) -> Number:
  """-2 ln p, without the constant that both models have."""
  mean = model.intercept + jnp.einsum("kij,kj->i", model.lags, recent[: model.lags.shape[0]])
  return jnp.sum(jnp.square(model.whitener @ (x - mean))) + model.log_det


def fitted(parameters: Any, channels: tuple[str, ...]) -> tuple[Any, Any]:
  """The two models, in float32; refused where they are not of these channels."""
  for channel in channels:
    if channel not in CHANNELS:
      raise UserError(f"unknown channel {channel!r}; choose from: {', '.join(CHANNELS)}")
  before, after = jax.tree.map(
    lambda a: jnp.asarray(a, jnp.float32), (parameters.before, parameters.after)
  )
  if before.intercept.shape[-1] != len(channels):
    raise UserError(
      f"likelihood_ratio: parameters of {before.intercept.shape[-1]} channel(s) for "
      f"{len(channels)}: {', '.join(channels)}"
    )
  return before, after


@whole
def likelihood_ratio(
  parameters: Any,
  threshold: Setting = 6.0,
  channels: tuple[str, ...] = ("opr",),
  log: bool = True,
) -> Detector:
  """CUSUM of the log-likelihood ratio of two Gaussian autoregressions, fitted before and after the
  change.

    l_t = ln p_after(x_t | x_{t-order..t-1}) - ln p_before(x_t | ...),   -2 ln p = |whitener (x_t -
      intercept - sum_k lags[k] x_{t-1-k})|^2 + log_det
    score = evidence = max(0, evidence + l_t);   fired = score > threshold; then evidence = 0, while
      the last samples are kept

  No detector without this fit knows the fault in advance: it is a reference for how early the
  channel could have told, not a competitor. For independent Gaussian samples and true parameters no
  detector of the same ARL0 has a smaller worst-case delay (Moustakides 1986).

  Args:
    parameters: scoring.autoregression.Parameters of the same channels, in the same order and with
      the same logarithm; may be traced.
    threshold: decision level [nats]; may be traced.
    channels: of monitor.CHANNELS.
    log: ln max(x, 1e-9) in place of x, for all channels but the reward.

  Returns:
    Detector over monitor.Residual. The first `order` samples only fill the past: nothing fires,
    score nan. A sample with an unknown channel leaves the state unchanged; the past of the next one
    then ends before the gap.
  Blind to: a fault other than the fitted one; dependence beyond `order`; a reference that drifts.
  Reference: Moustakides 1986, Ann. Statist. 14, 1379-1387; Lai 1998, IEEE Trans. Inf. Theory 44,
  2917-2929 (dependent data).
  Example: det = likelihood_ratio(autoregression.fit(nominal, faulty, order=8), threshold=8.0)
  """
  demand(
    "likelihood_ratio",
    threshold=(threshold, above(threshold, 0), "above 0"),
    channels=(channels, len(channels) > 0, "one or more"),
  )
  before, after = fitted(parameters, channels)
  order = max(before.lags.shape[0], after.lags.shape[0])

  def init() -> LikelihoodRatioState:
    return LikelihoodRatioState(jnp.zeros((order, len(channels))), jnp.int32(0), jnp.float32(0))

  def update(state: LikelihoodRatioState, residual: Residual) -> tuple[LikelihoodRatioState, Alarm]:
    x, valid = pick(residual, channels, log)
    ready = valid & (state.seen >= order)
    ratio = 0.5 * (misfit(before, state.recent, x) - misfit(after, state.recent, x))
    score = jnp.where(ready, jnp.maximum(0.0, state.evidence + ratio), state.evidence)
    alarm = judged(score, ready, threshold)
    recent = jnp.where(valid, jnp.concatenate([x[None], state.recent])[:order], state.recent)
    evidence = jnp.where(alarm.fired, 0.0, score)
    return LikelihoodRatioState(recent, jnp.minimum(order, state.seen + valid), evidence), alarm

  return Detector(init, update)
