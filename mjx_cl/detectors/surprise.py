"""Surprise of the latent: how far the observation moves the model's belief."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax.numpy as jnp

from mjx_cl.detectors import multivariate
from mjx_cl.detectors.base import Alarm, Detector, above, demand

if TYPE_CHECKING:
  from mjx_cl.rollout.monitor import Residual


def surprise(
  smooth: int = 100, threshold: float = 4.0, warmup: int = 1000, two_sided: bool = False
) -> Detector:
  """Standardised trailing mean of ln KL(posterior || prior) of the latent.

    x_t = ln max(surprise_t, 1e-9);  y_t = mean of x_{t-smooth+1..t};  z = (y_t - mean) / max(std,
    1e-6), mean and std of y over the warm-up
    score = z, or |z|;  fired = score > threshold; then the trailing mean starts from nothing,
    unknown until refilled, while mean and std are kept

  Zollicoffer et al. do without a threshold: a step is novel when KL(p(z|h, x) || p(z|h)), the
  surprise of this field, exceeds a second divergence of the same step, from p(z|h, x) to the belief
  of a model whose history h is emptied. A Residual holds one divergence a step, and the second one
  cannot be had from it: the monitor would have to evaluate the model once more with an empty
  history. This detector is therefore their signal with a threshold, not their bound. The default
  threshold has an ARL0 of about 10,000 samples on independent log-normal samples.

  Args:
    smooth: samples of the trailing mean [control steps].
    threshold: decision level [deviations of the trailing mean].
    warmup: samples that fit mean and deviation, at least 2 smooth; 0: samples are standardised and
      independent already, and no logarithm is taken.
    two_sided: also a fall counts, as of a frozen sensor that is foreseen too well.

  Returns:
    Detector whose update takes a monitor.Residual and gives Alarm(fired: bool (), score: float32
    ()).
  Blind to: a change that the world model foresees, or that the decoder alone sees; a change of
  variance alone. Reference: Zollicoffer, Eaton, Balloch, Kim, Zhou, Wright, Riedl 2025, ICML, arXiv
  2310.08731. Example: _, out = jax.lax.scan(det.update, det.init(), residuals)
  """
  demand(
    "surprise",
    smooth=(smooth, smooth >= 1, "at least 1"),
    threshold=(threshold, above(threshold, 0), "above 0"),
    warmup=(
      warmup,
      warmup == 0 or warmup >= max(2, 2 * smooth),
      "0, or at least twice `smooth` and 2",
    ),
  )

  def init() -> multivariate.Standing:
    return multivariate.standing(smooth, 1)

  def update(
    state: multivariate.Standing, residual: Residual
  ) -> tuple[multivariate.Standing, Alarm]:
    x, known = multivariate.pick(residual, ("surprise",), warmup > 0)
    state, z, ready = multivariate.trailing_z(state, x, known, smooth, warmup)
    score = jnp.abs(z[0]) if two_sided else z[0]
    fired = ready & (score > threshold)
    return state._replace(trail=multivariate.restart(state.trail, fired)), Alarm(
      fired, jnp.where(ready, score, jnp.nan)
    )

  return Detector(init, update)


surprise.takes = "residual"  # type: ignore[attr-defined]
