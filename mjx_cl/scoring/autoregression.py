"""Gaussian autoregressions of a channel: fitted, whitened, tested for whiteness."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from mjx_cl.errors import UserError

ORDER = 8  # of the autoregressions, unless another is asked for
# least innovation variance, of the channel's nominal variance: a frozen sensor has none
FLOOR = 1e-6


class Conditional(NamedTuple):
  """Gaussian autoregression: x_t ~ N(intercept + sum_k lags[k] x_{t-1-k}, covariance), whitener
  covariance whitener' = 1.

  Attributes:
    intercept: float (C,).
    lags: float (order, C, C), lags[0] acts on the newest value.
    whitener: float (C, C), inverse of the Cholesky factor.
    log_det: float (), ln det covariance.
  """

  intercept: np.ndarray
  lags: np.ndarray
  whitener: np.ndarray
  log_det: np.ndarray


class Parameters(NamedTuple):
  """Conditional densities of a channel: what detectors.likelihood_ratio takes.

  Attributes:
    before: healthy.
    after: faulty.
  """

  before: Conditional
  after: Conditional


def streams_of(x: ArrayLike, name: str) -> np.ndarray:
  """(T, S, C) from (T,), (T, S) or (T, S, C)."""
  x = np.asarray(x, float)
  if not 1 <= x.ndim <= 3:
    raise UserError(f"{name} must be (T,), (T, S) or (T, S, C); got shape {x.shape}")
  return x.reshape(x.shape + (1,) * (3 - x.ndim))


class Lagged(NamedTuple):
  """Streams beside their own past, for many models of one order.

  Attributes:
    past: (T - order, S, order C), newest first.
    now: (T - order, S, C).
    known: bool (T - order, S), where all of both is finite.
  """

  past: np.ndarray
  now: np.ndarray
  known: np.ndarray


def lagged(x: ArrayLike | Lagged, order: int) -> Lagged:
  """Streams (T,), (T, S) or (T, S, C), or what this gave, beside their past."""
  if isinstance(x, Lagged):
    return x
  x = streams_of(x, "x")
  if len(x) <= order:
    raise UserError(
      f"an autoregression of order {order} needs more than {order} steps; got {len(x)}"
    )
  steps = len(x) - order
  past = (
    np.concatenate([x[order - 1 - k : order - 1 - k + steps] for k in range(order)], -1)
    if order
    else np.zeros(x.shape[:2] + (0,))
  )
  now = x[order:]
  return Lagged(past, now, np.isfinite(past).all(-1) & np.isfinite(now).all(-1))


def _conditional(x: np.ndarray, order: int, floor: np.ndarray) -> Conditional:
  """Least squares over all streams of x (T, S, C)."""
  past, now, known = lagged(x, order)
  past, now = past[known], now[known]
  channels = now.shape[1]
  if len(now) < 2 * (past.shape[1] + 1) + channels:
    raise UserError(
      f"too few known samples for an autoregression of order {order} on {channels} channel(s): "
      f"{len(now)}"
    )
  coefficients, *_ = np.linalg.lstsq(past - past.mean(0), now - now.mean(0), rcond=1e-10)
  left = now - now.mean(0) - (past - past.mean(0)) @ coefficients
  factor = np.linalg.cholesky(left.T @ left / len(left) + np.diag(floor))
  return Conditional(
    now.mean(0) - past.mean(0) @ coefficients,
    np.swapaxes(coefficients.reshape(order, channels, channels), 1, 2),
    np.linalg.inv(factor),
    2 * np.log(np.diag(factor)).sum(),
  )


class Healthy:
  """Healthy streams and what is fitted to them alone, each once: many faults are held against one
  healthy robot.

  Args:
    streams: float (T,), (T, S) or (T, S, C).
    order: of the autoregression.
  """

  def __init__(self, streams: ArrayLike, order: int = ORDER) -> None:
    self.streams, self.order = streams_of(streams, "nominal"), order

  @functools.cached_property
  def floor(self) -> np.ndarray:
    """Least innovation variance of each channel, (C,)."""
    return FLOOR * np.maximum(np.nanvar(self.streams, axis=(0, 1)), 1e-12)

  @functools.cached_property
  def model(self) -> Conditional:
    """Fit of all streams."""
    return _conditional(self.streams, self.order, self.floor)

  @functools.cached_property
  def halves(self) -> tuple[Healthy, Healthy]:
    """Even and odd streams."""
    return Healthy(self.streams[:, ::2], self.order), Healthy(self.streams[:, 1::2], self.order)

  @functools.cached_property
  def white(self) -> np.ndarray:
    """Innovations of the first channel, (T - order, S)."""
    return innovations(self.streams, self.model)[..., 0]


def healthy_of(nominal: ArrayLike | Healthy, order: int) -> Healthy:
  """Healthy streams, or what has been made of them already."""
  return nominal if isinstance(nominal, Healthy) else Healthy(nominal, order)


def fit(nominal: ArrayLike | Healthy, faulty: ArrayLike, order: int = ORDER) -> Parameters:
  """Conditional densities before and after the change, by least squares over all streams.

  Args:
    nominal: float (T, S) or (T, S, C), healthy steps; or a Healthy, whose order then holds.
    faulty: float (T, S) or (T, S, C), steps after the onset alone; T and S of the two may differ. A
      step counts where it and the `order` steps before it are finite.
    order: of the autoregression; 0 takes steps as independent.

  Returns:
    Parameters, arrays float64.
  """
  healthy, faulty = healthy_of(nominal, order), streams_of(faulty, "faulty")
  if healthy.streams.shape[2] != faulty.shape[2]:
    raise UserError(
      f"healthy and faulty streams must have the same channels; got {healthy.streams.shape[2]} "
      f"and {faulty.shape[2]}"
    )
  return Parameters(healthy.model, _conditional(faulty, healthy.order, healthy.floor))


def innovations(x: ArrayLike | Lagged, model: Conditional) -> np.ndarray:
  """Whitened one-step errors (T - order, S, C) of streams x, or of `lagged` ones: independent
  standard normal where the model holds; nan where a lag is unknown.
  """
  past, now, known = lagged(x, len(model.lags))
  flat = np.swapaxes(model.lags, 1, 2).reshape(-1, now.shape[2])
  return np.where(
    known[..., None], (now - model.intercept - past @ flat) @ model.whitener.T, np.nan
  )


def log_density(x: ArrayLike | Lagged, model: Conditional) -> np.ndarray:
  """Ln p(x_t | past) of each step, but for a constant, (T - order, S); nan where a lag
  is unknown.
  """
  return -0.5 * (np.sum(innovations(x, model) ** 2, -1) + model.log_det)


def log_ratio(x: ArrayLike | Lagged, parameters: Parameters) -> np.ndarray:
  """Ln p_after(x_t | past) - ln p_before(x_t | past) of each step, (T - order, S); nan where a lag
  is unknown.
  """
  x = lagged(x, len(parameters.after.lags))
  return log_density(x, parameters.after) - log_density(x, parameters.before)


def ljung_box(e: ArrayLike, lags: int = 20, fitted: int = 0) -> tuple[float, float]:
  """Test that streams are white.

    Q = sum over streams and k = 1 .. lags of n (n + 2) r_k^2 / (n - k),   chi-square with (streams
      x lags - fitted) degrees if they are white

  Args:
    e: float (T,) or (T, S), nan left out.
    lags: autocorrelations tested.
    fitted: autoregressive coefficients that were fitted to all of them.

  Returns:
    (Q, p): p small: not white. Long streams fail for correlations too small to matter.
  Reference: Ljung and Box 1978, Biometrika 65, 297-303.
  """
  e = streams_of(e, "e")[..., 0]
  if len(e) <= lags or e.shape[1] * lags <= fitted:
    raise UserError(
      "ljung_box needs more steps than lags and more autocorrelations than fitted "
      f"coefficients; got {e.shape}, {lags}, {fitted}"
    )
  known = np.isfinite(e)
  n = known.sum(0)
  e = np.where(known, e - np.nanmean(e, 0), 0.0)
  r = np.stack([np.sum(e[k:] * e[:-k], 0) for k in range(1, lags + 1)]) / np.maximum(
    np.sum(e * e, 0), 1e-300
  )
  q = float(np.sum(n * (n + 2) * r**2 / (n - np.arange(1, lags + 1)[:, None])))
  return q, float(special.chdtrc(e.shape[1] * lags - fitted, q))
