"""Hotelling's T^2 chart on a trailing mean of several channels."""

from typing import NamedTuple

import jax.numpy as jnp

from mjx_cl.detectors.base import Alarm, Detector, Real, Setting, above, demand, judged, whole
from mjx_cl.detectors.multivariate import (
  Trail,
  Whitener,
  check_whitener,
  pick,
  push,
  restart,
  split,
  trail,
  whiten,
  whitener,
)
from mjx_cl.rollout.monitor import Residual


class HotellingState(NamedTuple):
  """What the detector remembers.

  Attributes:
    whitener: the reference.
    trail: of whitened samples (smooth, p).
  """

  whitener: Whitener
  trail: Trail


@whole
def hotelling(
  smooth: int = 100,
  threshold: Setting = 36.0,
  warmup: int = 1000,
  shrinkage: Real = 0.1,
  channels: str | tuple[str, ...] = "groups+opr+rpr+reward",
  log: bool = True,
) -> Detector:
  """Hotelling's T^2 of a trailing mean against the warm-up's mean and covariance.

    x_t = the channels, logarithms of all but the reward
    y_t = mean of the last n = min(smooth, samples since the warm-up or the last alarm) values of x
    T^2 = n (y_t - mean)' S^-1 (y_t - mean) = score;  S = covariance of single samples, correlations
    times 1 - shrinkage
    fired = T^2 > threshold; then the trailing mean starts from nothing, while mean and S are kept

  Two-sided: a quadratic form, so a rise and a fall of any channel count alike.
  For independent Gaussian samples of p channels, no shrinkage and m = warmup: T^2 / (1 + n / m) is
  p (m - 1) / (m - p) F(p, m - p), near chi-square with p degrees for m >> p, n. Samples of a robot
  are correlated in time, which makes T^2 larger: calibrate. The default threshold has an ARL0 of
  about 10,000 samples on independent Gaussian samples.

  Args:
    smooth: samples of the trailing mean [control steps].
    threshold: decision level of T^2 [squared deviations].
    warmup: samples that fit mean and covariance, at least channels + 2; nothing fires before they
      end. 0: the channels are standardised and uncorrelated already.
    shrinkage: in [0, 1], share by which correlations are drawn to zero: S = (1 - shrinkage)
      S_warmup + shrinkage diag(S_warmup). At 0 a covariance from few effective samples has
      directions of almost no variance, in which everything is an alarm.
    channels: `a+b+..` or a sequence of channels (combine.CHANNELS); `groups` is all eight.
    log: take logarithms of all but the reward.

  Returns:
    Detector over monitor.Residual.
  Blind to: a change of variance alone within the trailing mean; a change slower than the warm-up is
  none if it lies inside it. A shift in one channel of p counts as much as p - 1 channels of noise
  allow: max_variables is sharper there.
  Reference: Hotelling 1947, in Techniques of Statistical Analysis, 111-184; Montgomery,
  Introduction to Statistical Quality Control, ch. 11.
  """
  names = split("hotelling", channels)
  demand(
    "hotelling",
    smooth=(smooth, smooth >= 1, "at least 1"),
    threshold=(threshold, above(threshold, 0), "above 0"),
  )
  check_whitener("hotelling", names, warmup, shrinkage)

  def init() -> HotellingState:
    return HotellingState(whitener(len(names)), trail(smooth, len(names)))

  def update(state: HotellingState, residual: Residual) -> tuple[HotellingState, Alarm]:
    x, known = pick(residual, names, log)
    reference, y, ready = whiten(state.whitener, x, known, warmup, shrinkage)
    held = push(state.trail, y, ready)
    alarm = judged(jnp.sum(jnp.square(held.total)) / held.size(), ready, threshold)
    return HotellingState(reference, restart(held, alarm.fired)), alarm

  return Detector(init, update)
