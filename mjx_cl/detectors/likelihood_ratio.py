"""The oracle of the leaderboard: CUSUM of a log-likelihood ratio that was fitted on other seeds of
the very fault.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.detectors.base import Alarm, Detector, above, demand
from mjx_cl.detectors.combine import CHANNELS, read
from mjx_cl.errors import UserError

if TYPE_CHECKING:
  from mjx_cl.rollout.monitor import Residual


class LikelihoodRatioState(NamedTuple):
  """Attributes:
  recent: float32 (order, C), the last samples, newest first. count: int32 (), samples seen, at most
  `order`. evidence: float32 () [nats].
  """

  recent: jax.Array
  count: jax.Array  # type: ignore[assignment]
  evidence: jax.Array


def likelihood_ratio(
  parameters: Any,
  threshold: float = 6.0,
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
    channels: of combine.CHANNELS.
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
  for channel in channels:
    if channel not in CHANNELS:
      raise UserError(f"unknown channel {channel!r}; choose from: {', '.join(CHANNELS)}")
  before, after = (
    jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), model)
    for model in (parameters.before, parameters.after)
  )
  if before.intercept.shape[-1] != len(channels):
    raise UserError(
      f"likelihood_ratio: parameters of {before.intercept.shape[-1]} channel(s) for "
      f"{len(channels)}: {', '.join(channels)}"
    )
  orders = before.lags.shape[0], after.lags.shape[0]
  order = max(orders)

  def misfit(model: Any, recent: jax.Array, x: jax.Array) -> jax.Array:
    """-2 ln p, without the constant that both have."""
    mean = model.intercept + jnp.einsum("kij,kj->i", model.lags, recent[: model.lags.shape[0]])
    return jnp.sum(jnp.square(model.whitener @ (x - mean))) + model.log_det

  def init() -> LikelihoodRatioState:
    return LikelihoodRatioState(jnp.zeros((order, len(channels))), jnp.int32(0), jnp.float32(0))

  def update(state: LikelihoodRatioState, residual: Residual) -> tuple[LikelihoodRatioState, Alarm]:
    x = jnp.stack([read(c, residual) for c in channels])
    timed = all(c in ("reward", "surprise") for c in channels)  # known without a prediction window
    valid = jnp.all(jnp.isfinite(x)) & (residual.valid | timed)
    x = jnp.where(valid, x, 1.0)
    if log:
      x = jnp.where(jnp.array([c != "reward" for c in channels]), jnp.log(jnp.maximum(x, 1e-9)), x)
    ready = valid & (state.count >= order)
    ratio = 0.5 * (misfit(before, state.recent, x) - misfit(after, state.recent, x))
    score = jnp.where(ready, jnp.maximum(0.0, state.evidence + ratio), state.evidence)
    fired = ready & (score > threshold)
    recent = jnp.where(valid, jnp.concatenate([x[None], state.recent])[:order], state.recent)
    new = LikelihoodRatioState(
      recent, jnp.minimum(order, state.count + valid), jnp.where(fired, 0.0, score)
    )
    return new, Alarm(fired, jnp.where(ready, score, jnp.nan))

  return Detector(init, update)


# and a fit first: it has no line in the table
likelihood_ratio.takes = "residual"  # type: ignore[attr-defined]
