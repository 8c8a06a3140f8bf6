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

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mjx_cl.errors import UserError
from mjx_cl.scoring import intervals as bootstrap
from mjx_cl.scoring.autoregression import (
  ORDER,
  Healthy,
  fit,
  healthy_of,
  innovations,
  ljung_box,
  log_ratio,
  streams_of,
)

# 2 x 0.583: mean overshoot at both ends of a Gaussian random walk, Siegmund 1985, Sequential
# Analysis
EXCESS = 1.166
WHITE = 0.01  # Ljung-Box p-value from which innovations pass for white
REPS = 2_000  # bootstrap draws


class Limit(NamedTuple):
  """How early a detector can be.

  Attributes:
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
    arl0: mean samples between false alarms.
    shift: of the mean [deviations].
    discrete: correct the threshold.
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


def information(
  nominal: ArrayLike | Healthy, faulty: ArrayLike, order: int = ORDER, reps: int = REPS
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
    nominal: (T, S) or (T, S, C), stream s is seed s, S >= 2; or a Healthy.
    faulty: likewise, steps after the onset alone.
    order: of the autoregressions.
    reps: bootstrap draws.

  Returns:
    {information_nats_per_step, its _ci: bootstrap over seeds, None for fewer than two}.
  """
  healthy, faulty = healthy_of(nominal, order), streams_of(faulty, "faulty")
  seeds = faulty.shape[1]
  if seeds < 2 or healthy.streams.shape[1] != seeds:
    raise UserError(
      "information needs two or more seeds, the same ones healthy and faulty; got "
      f"{healthy.streams.shape[1]} and {seeds}"
    )
  rate = np.empty(seeds)
  for half in (0, 1):
    model = fit(healthy.halves[1 - half], faulty[:, 1 - half :: 2], order)
    ratio = log_ratio(faulty[:, half::2], model)
    known = np.isfinite(ratio)
    rate[half::2] = np.where(known, ratio, 0).sum(0) / np.where(known.any(0), known.sum(0), np.nan)
  rate, interval = rate[np.isfinite(rate)], None
  if len(rate) > 1:
    (interval,) = bootstrap.ends((bootstrap.weights(len(rate), reps) @ rate)[None])
  return {
    "information_nats_per_step": bootstrap.finite(rate.mean()) if len(rate) else None,
    "information_nats_per_step_ci": interval,
  }


def closed_form(
  nominal: ArrayLike | Healthy, faulty: ArrayLike, arl0: float, order: int = ORDER, lags: int = 20
) -> dict:
  """The closed form of `brownian` for one channel, where it applies: after whitening a mean shift
  in independent values.

  It is printed only if the whitened healthy streams pass Ljung and Box's test (p >= 0.01, `lags`
  autocorrelations) and the fault is a shift of the mean of the innovations, s deviations: s^2 / 2
  must be 80 to 125 % of the information of the channel. The first innovation after the onset is
  larger than the later ones where values are positively correlated, so that a delay can be far
  below it; smaller where negatively.

  Args:
    nominal: (T, S), as for `information`.
    faulty: (T, S), likewise.
    arl0: mean samples between false alarms.
    order: of the autoregression.
    lags: autocorrelations tested.

  Returns:
    {optimal_delay_steps: samples or None, optimal_delay_steps_ci: bootstrap over the faulty
    streams, note: the reason for None, else None, ljung_box_p}.
  """
  healthy = healthy_of(nominal, order)
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
  return {
    "optimal_delay_steps": None if note else brownian(arl0, shift).delay,
    "optimal_delay_steps_ci": None if note else _delays(arl0, after),
    "note": note,
    "ljung_box_p": p,
  }


def _delays(arl0: float, e: np.ndarray) -> list[float | None]:
  """Interval of the closed form's delay: the delays at the ends of the shift's own, a bootstrap
  over streams of innovations e (T, S) or (T, S, 1). An end is None where no shift is among the
  likely ones, which no detector finds.
  """
  e = e.reshape(len(e), -1)
  count, total = np.isfinite(e).sum(0), np.nansum(e, 0)
  w = bootstrap.weights(len(total), REPS)
  ends = bootstrap.ends(((w @ total) / (w @ count))[None])[0] or (None, None)
  low, high = (math.nan if x is None else x for x in ends)
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
    oracle_latencies: (S,) [control steps], None or inf or nan = missed.
    detector_latencies: (S,) of the same seeds, likewise.
    horizon: [control steps].
    reps: bootstrap draws.

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
  values = {
    "efficiency": float(oracle.mean() / mine.mean()),
    "oracle_delay_steps": float(oracle.mean()),
    "delay_steps": float(mine.mean()),
  }
  intervals: list[list[float | None] | None] = [None] * 3
  if len(mine) > 1:
    w = bootstrap.weights(len(mine), reps)
    theirs, own = w @ oracle, w @ mine
    intervals = bootstrap.ends(np.stack([theirs / own, theirs, own]))
  note = (
    "above 1: the oracle is optimal only for the worst onset and for data of the Gaussian "
    "autoregression that was fitted to it; this detector was luckier, or uses what that model "
    "leaves out"
  )
  return (
    values
    | {f"{k}_ci": ends for k, ends in zip(values, intervals)}
    | {"note": note if values["efficiency"] > 1 else None}
  )
