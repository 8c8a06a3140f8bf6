"""Surprise of the latent: how far the observation moves the model's belief."""

import jax.numpy as jnp

from mjx_cl.detectors.base import Detector, Setting, whole
from mjx_cl.detectors.multivariate import standing


@whole
def surprise(
  smooth: int = 100, threshold: Setting = 4.0, warmup: int = 1000, two_sided: bool = False
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
    Detector over monitor.Residual.
  Blind to: a change that the world model foresees, or that the decoder alone sees; a change of
  variance alone. Reference: Zollicoffer, Eaton, Balloch, Kim, Zhou, Wright, Riedl 2025, ICML, arXiv
  2310.08731.
  """
  score = lambda z: jnp.abs(z[0]) if two_sided else z[0]
  return standing("surprise", ("surprise",), warmup > 0, smooth, warmup, threshold, score)
