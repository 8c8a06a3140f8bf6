"""How early a detector could know: limits of the delay at a given rate of false alarms, always of a
declared channel.

Physics is deterministic: whoever sees every input of a simulated robot needs one step. A limit
therefore belongs to the channel that detectors are given (such as the logarithm of OPR), and to a
model of it. Two are offered, from the most to the least demanding of assumptions:

  brownian      closed form for a known shift of the mean of independent Gaussian values;
    `closed_form` prints it only where a stream passes for such
  likelihood-ratio CUSUM (detectors/likelihood_ratio.py) on `fit`, run on the same streams at the
  same ARL0: `efficiency` compares with it

Delay counts the samples used, so delay = latency_steps + 1: an alarm in the first faulty step has
used one.
"""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import special

from mjx_cl.errors import UserError
from mjx_cl.scoring import intervals as bootstrap

if TYPE_CHECKING:
  from collections.abc import Iterable

  from numpy.typing import ArrayLike

# 2 x 0.583: mean overshoot at both ends of a Gaussian random walk, Siegmund 1985, Sequential
# Analysis
EXCESS = 1.166
WHITE = 0.01  # Ljung-Box p-value from which innovations pass for white
FLOOR = (
  1e-6  # least innovation variance, of the channel's nominal variance: a frozen sensor has none
)
REPS = 2_000  # bootstrap draws


class Limit(NamedTuple):
  """Attributes:
  delay: expected samples until the alarm, worst case: evidence at zero when the change comes.
  threshold: of the log-likelihood-ratio CUSUM.
  """

  delay: float
  threshold: float


def brownian(arl0: float, shift: float, discrete: bool = True) -> Limit:
  """The least worst-case delay of any detector with this ARL0, for a known mean shift of
  independent Gaussian values.

    solve  arl0 = 2 (e^u - u - 1) / shift^2  for u > 0;   delay = 2 (e^-u + u - 1) / shift^2

  Exact for a Brownian motion with drift. In discrete time the same delay belongs to the same ARL0
  to about 1 %, and Siegmund's correction moves the threshold alone: evidence overshoots, so the
  boundary that reaches this ARL0 is u - 1.166 shift in place of u.

  Args:
    arl0: mean samples between false alarms. shift: of the mean [deviations]. discrete: correct the
      threshold.
  Blind to: an onset at a random time finds evidence above zero, so that a mean delay measured so
  can be slightly below this one. References: Shiryaev 1996, Russian Math. Surveys 51, 750-751;
  Moustakides 2004, Ann. Statist. 32, 302-315 (closed form, optimality);
    Moustakides 1986, Ann. Statist. 14, 1379-1387 (optimality in discrete time); Siegmund 1985,
    Sequential Analysis.
  """
  if not (arl0 > 0 and shift != 0 and math.isfinite(arl0) and math.isfinite(shift)):
    raise UserError(f"brownian needs arl0 above 0 and a shift other than 0; got {arl0}, {shift}")
  shift = abs(shift)
  want, low, high = arl0 * shift**2 / 2, 0.0, 700.0  # e^700 is near the largest float64
  for _ in range(200):
    u = (low + high) / 2
    low, high = (u, high) if math.expm1(u) - u < want else (low, u)
  return Limit(2 * (math.expm1(-u) + u) / shift**2, u - EXCESS * shift if discrete else u)


class Conditional(NamedTuple):
  """Gaussian autoregression: x_t ~ N(intercept + sum_k lags[k] x_{t-1-k}, covariance), whitener
  covariance whitener' = 1.

  Attributes:
    intercept: float (C,). lags: float (order, C, C), lags[0] acts on the newest value. whitener:
      float (C, C), inverse of the Cholesky factor.
    log_det: float (), ln det covariance.
  """

  intercept: np.ndarray
  lags: np.ndarray
  whitener: np.ndarray
  log_det: np.ndarray


class Parameters(NamedTuple):
  """Conditional densities of a channel, healthy and faulty: what
  detectors.likelihood_ratio takes.
  """

  before: Conditional
  after: Conditional


def _streams(x: ArrayLike, name: str) -> np.ndarray:
  """(T, S, C) from (T,), (T, S) or (T, S, C)."""
  x = np.asarray(x, float)
  if not 1 <= x.ndim <= 3:
    raise UserError(f"{name} must be (T,), (T, S) or (T, S, C); got shape {x.shape}")
  return x.reshape(x.shape + (1,) * (3 - x.ndim))


class Lagged(NamedTuple):
  """Streams beside their own past, for many models of one order. Attributes: past (T - order, S,
  order C), newest first, now (T - order, S, C), known (T - order, S), where all of both is
  finite.
  """

  past: np.ndarray
  now: np.ndarray
  known: np.ndarray


def lagged(x: ArrayLike | Lagged, order: int) -> Lagged:
  """Streams (T,), (T, S) or (T, S, C), or what this gave, beside their past."""
  if isinstance(x, Lagged):
    return x
  x = _streams(x, "x")
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
    streams: float (T,), (T, S) or (T, S, C). order: of the autoregression.
  """

  def __init__(self, streams: ArrayLike, order: int = 8) -> None:
    self.streams, self.order = _streams(streams, "nominal"), order

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


def _healthy(nominal: ArrayLike | Healthy, order: int) -> Healthy:
  return nominal if isinstance(nominal, Healthy) else Healthy(nominal, order)


def fit(nominal: ArrayLike | Healthy, faulty: ArrayLike, order: int = 8) -> Parameters:
  """Conditional densities before and after the change, by least squares over all streams.

  Args:
    nominal, faulty: float (T, S), (T, S, C): healthy steps, and steps after the onset alone; T and
      S of the two may differ. A step counts where it and the `order` steps before it are finite.
      nominal may be a Healthy, whose order then holds.
    order: of the autoregression; 0 takes steps as independent.

  Returns:
    Parameters, arrays float64.
  """
  healthy, faulty = _healthy(nominal, order), _streams(faulty, "faulty")
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


def information(
  nominal: ArrayLike | Healthy, faulty: ArrayLike, order: int = 8, reps: int = REPS
) -> dict:
  """Estimated KL rate of the faulty from the healthy channel, with Gaussian autoregressions fitted
  on other seeds than it is measured on.

    I = mean over faulty steps of ln p_after(x_t | past) / p_before(x_t | past);  even seeds are
    measured with the fit of odd seeds, and the reverse for a mean shift of d deviations: d^2 / 2 if
    steps are independent, (d^2 / 2) (1 - phi) / (1 + phi) in an AR(1)

  It can err both ways. It is KL(true after || fitted before) - KL(true after || fitted after): a
  healthy channel with heavier tails than a Gaussian makes the first too large, a faulty one that
  the model does not describe the second. A fit on n steps loses about parameters / 2n nats, which
  cancels only in part, so that it may come out below 0 where there is nothing to know. It knows
  neither the other channels nor dependence beyond `order` steps, and takes all faulty steps as
  alike: a fault that acts at once and fades has more at first.

  Args:
    nominal, faulty: (T, S) or (T, S, C), stream s of both is seed s; faulty: steps after the onset
      alone. S >= 2. nominal may be a Healthy.

  Returns:
    {information_nats_per_step, its _ci: bootstrap over seeds, None for fewer than two}.
  """
  healthy, faulty = _healthy(nominal, order), _streams(faulty, "faulty")
  seeds = faulty.shape[1]
  if seeds < 2 or healthy.streams.shape[1] != seeds:
    raise UserError(
      "information needs two or more seeds, the same ones healthy and faulty; got "
      f"{healthy.streams.shape[1]} and {seeds}"
    )
  rate = np.empty(seeds)
  for half in (0, 1):
    ratio = log_ratio(
      faulty[:, half::2], fit(healthy.halves[1 - half], faulty[:, 1 - half :: 2], order)
    )
    known = np.isfinite(ratio)
    rate[half::2] = np.where(known, ratio, 0).sum(0) / np.where(known.any(0), known.sum(0), np.nan)
  rate = rate[np.isfinite(rate)]
  interval = (
    bootstrap.ends((bootstrap.weights(len(rate), reps) @ rate)[None])[0] if len(rate) > 1 else None
  )
  return {
    "information_nats_per_step": bootstrap.finite(rate.mean()) if len(rate) else None,
    "information_nats_per_step_ci": interval,
  }


def whiten(x: ArrayLike, order: int = 8) -> tuple[np.ndarray, Conditional]:
  """Innovations (T - order, S) of one channel x (T,) or (T, S) under its own autoregression, in
  deviations, and the autoregression.
  """
  x = _streams(x, "x")
  if x.shape[2] != 1:
    raise UserError(f"whiten takes one channel; got {x.shape[2]}")
  model = _conditional(x, order, FLOOR * np.maximum(np.nanvar(x, axis=(0, 1)), 1e-12))
  return innovations(x, model)[..., 0], model


def ljung_box(e: ArrayLike, lags: int = 20, fitted: int = 0) -> tuple[float, float]:
  """Test that streams are white.

    Q = sum over streams and k = 1 .. lags of n (n + 2) r_k^2 / (n - k),   chi-square with (streams
      x lags - fitted) degrees if they are white

  Args:
    e: float (T,) or (T, S), nan left out. lags: autocorrelations tested. fitted: autoregressive
      coefficients that were fitted to all of them.

  Returns:
    (Q, p): p small: not white. Long streams fail for correlations too small to matter.
  Reference: Ljung and Box 1978, Biometrika 65, 297-303.
  """
  e = _streams(e, "e")[..., 0]
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


def closed_form(
  nominal: ArrayLike | Healthy, faulty: ArrayLike, arl0: float, order: int = 8, lags: int = 20
) -> dict:
  """The closed form of `brownian` for one channel, where it applies: after whitening a mean shift
  in independent values.

  It is printed only if the whitened healthy streams pass Ljung and Box's test (p >= 0.01, `lags`
  autocorrelations) and the fault is a shift of the mean of the innovations, s deviations: s^2 / 2
  must be 80 to 125 % of the information of the channel. The first innovation after the onset is
  larger than the later ones where values are positively correlated, so that a delay can be far
  below it; smaller where negatively.

  Args:
    nominal, faulty: (T, S), as for `information`.

  Returns:
    {optimal_delay_steps: samples or None, optimal_delay_steps_ci: bootstrap over the faulty
    streams, note: the reason for None, else None, ljung_box_p}.
  """
  healthy = _healthy(nominal, order)
  if healthy.streams.shape[2] != 1:
    raise UserError(f"closed_form takes one channel; got {healthy.streams.shape[2]}")
  order = healthy.order
  _, p = ljung_box(healthy.white, lags, order)
  after = innovations(faulty, healthy.model)
  shift = float(np.nanmean(after))
  rate = information(healthy, faulty, order)["information_nats_per_step"]
  note = None
  if p < WHITE:
    note = (
      f"no closed form: healthy innovations of order {order} are not white (Ljung-Box p = {p:.2g})"
    )
  elif rate is None or rate <= 0:
    note = "no closed form: the fault does not show in this channel"
  elif not 0.8 <= shift**2 / 2 / rate <= 1.25:
    note = (
      "no closed form: the fault is no mere shift of the mean (which would carry "
      f"{shift**2 / 2:.3g} of {rate:.3g} nats per step)"
    )
  known = {
    "optimal_delay_steps": None,
    "optimal_delay_steps_ci": None,
    "note": note,
    "ljung_box_p": p,
  }
  return (
    known
    if note
    else known
    | {
      "optimal_delay_steps": brownian(arl0, shift).delay,
      "optimal_delay_steps_ci": _delays(arl0, after),
    }
  )


def _delays(arl0: float, e: np.ndarray) -> list[float | None]:
  """Interval of the closed form's delay: the delays at the ends of the shift's own, a bootstrap
  over streams of innovations e (T, S) or (T, S, 1). An end is None where no shift is among the
  likely ones, which no detector finds.
  """
  e = e.reshape(len(e), -1)
  count, total = np.isfinite(e).sum(0), np.nansum(e, 0)
  w = bootstrap.weights(len(total), REPS)
  low: Any
  high: Any
  ((low, high),) = bootstrap.ends(((w @ total) / (w @ count))[None])  # type: ignore[misc]
  if low > 0 or high < 0:
    return [brownian(arl0, x).delay for x in sorted((low, high), key=abs, reverse=True)]
  return [brownian(arl0, max(-low, high)).delay, None]


def efficiency(
  oracle_latencies: Iterable[float | None],
  detector_latencies: Iterable[float | None],
  horizon: int,
  reps: int = REPS,
) -> dict:
  """Delay of the oracle over that of a detector, both at one ARL0 and on the same streams.

    restricted mean delay = mean of min(latency_steps + 1, horizon), a miss counts the horizon;
      efficiency = oracle's / detector's

  Args:
    oracle_latencies, detector_latencies: (S,) of the same seeds [control steps], None or inf or nan
      = missed. horizon: [control steps].

  Returns:
    {efficiency; oracle_delay_steps, delay_steps: restricted means; each with its _ci, a bootstrap
    over seeds, drawn in pairs, None for fewer than two;
    note: a sentence where the efficiency is above 1, else None}.
  """
  sides = [
    np.array([np.inf if x is None else x for x in side], float)
    for side in (oracle_latencies, detector_latencies)
  ]
  if len(sides[0]) != len(sides[1]) or not len(sides[0]):
    raise UserError(
      f"efficiency needs the same seeds of oracle and detector; got {len(sides[0])} and "
      f"{len(sides[1])}"
    )
  oracle, mine = (np.minimum(np.where(np.isnan(x), np.inf, x) + 1, horizon) for x in sides)
  intervals: list[list[float | None] | None]
  value, intervals = float(oracle.mean() / mine.mean()), [None, None, None]
  if len(mine) > 1:
    w = bootstrap.weights(len(mine), reps)
    theirs, own = w @ oracle, w @ mine
    intervals = bootstrap.ends(np.stack([theirs / own, theirs, own]))
  note = (
    (
      "above 1: the oracle is optimal only for the worst onset and for data of the Gaussian "
      "autoregression that was fitted to it; this detector "
      "was luckier, or uses what that model leaves out"
    )
    if value > 1
    else None
  )
  values = {
    "efficiency": value,
    "oracle_delay_steps": float(oracle.mean()),
    "delay_steps": float(mine.mean()),
  }
  return values | {f"{k}_ci": ends for k, ends in zip(values, intervals)} | {"note": note}
