"""How long until recovery, where some streams had not recovered when the run ended: Kaplan-Meier
and what follows from it.
"""

import math
import warnings
from typing import NamedTuple

import numpy as np
from scipy import stats

from mjx_cl.scoring import recovery

Z = 1.959963984540054  # 97.5 % quantile of the normal distribution


class Curve(NamedTuple):
  """P(not yet recovered by t), a step function: 1 before time[0], survival[i] from time[i] on;
  after `last` unknown unless it is 0.

  Attributes:
    time: float (k,), distinct times at which something happened, rising.
    survival: float (k,), the estimate.
    low: float (k,), lower end of its pointwise 95 % interval; nan where that is undefined.
    high: float (k,), upper end, likewise.
    at_risk: int (k,), streams under observation just before time[i].
    events: int (k,), those of them that recovered at it.
    last: longest time under observation.
  """

  time: np.ndarray
  survival: np.ndarray
  low: np.ndarray
  high: np.ndarray
  at_risk: np.ndarray
  events: np.ndarray
  last: float


def kaplan_meier(time: np.ndarray, seen: np.ndarray, interval: str = "log-log") -> Curve:
  """Kaplan and Meier's estimate from right-censored times.

    S(t) = prod_{t_i <= t} (1 - d_i / n_i)       d_i events at t_i among the n_i still under
      observation; a stream censored at t_i counts in n_i
    V(t) = sum_{t_i <= t} d_i / (n_i (n_i - d_i)),   Greenwood's error = S sqrt(V)
    log-log: S^exp(+-z sqrt(V) / log S)           linear: S +- z S sqrt(V), cut to [0, 1]

  Args:
    time: (n,) times of recovery or of censoring [any unit].
    seen: bool (n,), the recovery was seen; False: censored.
    interval: log-log (stays within [0, 1], fair with ten streams) or linear.

  Returns:
    Curve over the times of events; empty arrays where none was seen.
  Undefined: either interval where S is 0, since V is infinite there.
  Reference: Kaplan and Meier 1958; Greenwood 1926; Kalbfleisch and Prentice 1980 for log-log.
  """
  time, seen = _checked(time, seen)
  at = np.unique(time[seen])
  events = (time[None] == at[:, None])[:, seen].sum(1)
  at_risk = (time[None] >= at[:, None]).sum(1)
  sf = stats.ecdf(stats.CensoredData.right_censored(time, ~seen)).sf
  with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):  # where nobody is left
    pair = sf.confidence_interval(method=interval)
  survival = sf.evaluate(at)
  low, high = (np.where(survival > 0, x.evaluate(at), np.nan) for x in pair)
  return Curve(at, survival, low, high, at_risk, events, float(time.max()))


def quantile(curve: Curve, share: float = 0.5) -> tuple[float | None, list[float | None]]:
  """Time by which `share` of the streams have recovered, the median by default, with Brookmeyer and
  Crowley's interval.

    T = min {t : S(t) <= 1 - share},   interval: those t at which the curve's pointwise interval
      holds 1 - share

  Returns:
    (T, [low, high]); None where the curve, or an end of its interval, never falls that far: the
    quantile is censored.
  Reference: Brookmeyer and Crowley 1982; with the curve's own interval, as R's survfit and SAS'
  lifetest have it.
  """

  def first(x: np.ndarray) -> float | None:
    # products of fractions: S may be 0.5 to the last bit but one
    hit = np.flatnonzero(x <= 1 - share + 1e-12)
    return float(curve.time[hit[0]]) if len(hit) else None

  gone = curve.survival == 0  # the pointwise interval is undefined there; no stream is left
  return first(curve.survival), [
    first(np.where(gone, 0.0, curve.low)),
    first(np.where(gone, np.inf, curve.high)),
  ]


def restricted_mean(
  time: np.ndarray, seen: np.ndarray, horizon: float
) -> tuple[float | None, list[float] | None]:
  """Mean time to recovery up to a horizon: a stream that takes longer counts as `horizon`.

    mean = integral_0^horizon S(t) dt,   variance = sum_{t_i <= horizon} A_i^2 d_i / (n_i (n_i -
      d_i)),   A_i = integral_{t_i}^horizon S

  Returns:
    (mean, [low, high] by the normal law, cut to [0, horizon]); (None, None) where the horizon is
    later than the longest time under observation and S
    is above 0 there: what came after is unknown. The interval is None where every variance term is
      undefined or no event was seen.
  Reference: Klein and Moeschberger 2003, section 4.5; Irwin 1949.
  """
  curve = kaplan_meier(time, seen)
  if horizon <= 0:
    raise ValueError(f"horizon must be above 0; got {horizon}")
  if horizon > curve.last and (not len(curve.time) or curve.survival[-1] > 0):
    return None, None
  inside = curve.time < horizon
  at, survival = curve.time[inside], curve.survival[inside]
  areas = np.append(1.0, survival) * np.diff(np.concatenate([[0.0], at, [horizon]]))
  left = np.cumsum(areas[::-1])[::-1][1:]  # A_i
  left_risk, events = curve.at_risk[inside], curve.events[inside]
  live = left_risk > events  # where nobody is left, A_i is 0
  variance = float(
    np.sum(left[live] ** 2 * events[live] / (left_risk[live] * (left_risk[live] - events[live])))
  )
  mean, half = float(areas.sum()), Z * math.sqrt(variance)
  return mean, [max(0.0, mean - half), min(float(horizon), mean + half)] if live.any() else None


def of_runs(rows: list[dict], steps: int) -> tuple[np.ndarray, np.ndarray]:
  """Times to recovery of the affected streams of runs.parquet (a list of rows), in control steps
  since the onset, as (time, seen).

  A stream that has not recovered is censored 2,000 steps before the end of the run, or before its
  next change: recovery must hold for that long, so none could be seen later.
  """
  hit = [(r, until) for r, until in zip(rows, watched(rows, steps)) if r["affected"]]
  seen = np.array([r["recovery_step"] is not None for r, _ in hit], bool)
  time = [
    until if r["recovery_step"] is None else r["recovery_step"] - r["onset"] for r, until in hit
  ]
  return np.maximum(0.0, np.array(time, float)), seen


def watched(rows: list[dict], steps: int) -> list[int | None]:
  """Control steps after its onset for which a recovery could be seen, of each row of runs.parquet:
  up to 2,000 before the stream's next change, or before the end of the run. Below 0 where even that
  is earlier; None without an onset.
  """
  onsets: dict[int, list[int]] = {}
  for r in rows:
    if r["onset"] is not None:
      onsets.setdefault(r["stream"], []).append(r["onset"])
  end = lambda r: min([at for at in onsets[r["stream"]] if at > r["onset"]], default=steps)
  return [None if r["onset"] is None else end(r) - recovery.HOLD - r["onset"] for r in rows]


def _checked(time: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  time, seen = np.asarray(time, float), np.asarray(seen, bool)
  if time.ndim != 1 or time.shape != seen.shape or not len(time):
    raise ValueError(
      f"one time and one flag for each of at least one stream; got {time.shape} and {seen.shape}"
    )
  if not np.isfinite(time).all() or (time < 0).any():
    raise ValueError(
      "times must be finite and at least 0; a censored one is the time until which it was watched"
    )
  return time, seen
