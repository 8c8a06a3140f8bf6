"""The oracle of the leaderboard: what a CUSUM knows that was fitted to the very fault on other
seeds, and how early the channel could tell.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjx_cl.errors import UserError
from mjx_cl.leaderboard.streams import StreamSet
from mjx_cl.scoring import limits, metrics
from mjx_cl.scoring import thresholds as healthy

if TYPE_CHECKING:
  from mjx_cl.leaderboard.streams import Data
  from mjx_cl.rollout.monitor import Residual

ORDER = 8  # of the autoregressions
CHANNELS = ("opr", "rpr")  # the declared channel: what the single-residual detectors see
LIMITS = tuple(
  k + end for k in ("information_nats_per_step", "optimal_delay_steps") for end in ("", "_ci")
)
START, HALVINGS = 40.0, 14  # of the search for a threshold [nats]


class OracleRun(NamedTuple):
  """The likelihood-ratio CUSUM of one fault on its scoring streams: latency (S,), fired and score
  (T, S), on healthy ones by seed (N, S).
  """

  latency: np.ndarray
  fired: np.ndarray
  score: np.ndarray
  nominal_fired: np.ndarray
  nominal_score: np.ndarray
  threshold: float
  arl0: dict


class Oracle(NamedTuple):
  """What is known of one fault.

  Attributes:
    limits: what LIMITS names, and a note on why one is None. run: None where the oracle cannot be
      fitted.
  """

  limits: dict
  run: OracleRun | None


def channels(residual: Residual, columns: slice | np.ndarray = slice(None)) -> np.ndarray:
  """Ln of the oracle's channels, (T, S, C)."""
  return np.stack(
    [np.log(np.maximum(getattr(residual, c)[:, columns].astype(float), 1e-9)) for c in CHANNELS], -1
  )


def restarted(ratio: np.ndarray, thresholds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """CUSUM with restarts of log-likelihood ratios (T, S), nan = skipped, at one threshold for each
  stream: (fired, score), (T, S).
  """
  evidence, fired, score = (
    np.zeros(ratio.shape[1]),
    np.zeros(ratio.shape, bool),
    np.full(ratio.shape, np.nan),
  )
  known = np.isfinite(ratio)
  for t in range(len(ratio)):
    now = np.maximum(0.0, evidence + np.where(known[t], ratio[t], 0.0))
    score[t] = np.where(known[t], now, np.nan)
    fired[t] = known[t] & (now > thresholds)
    evidence = np.where(fired[t], 0.0, now)
  return fired, score


def _attempt(estimate: Callable[[], Any]) -> tuple[Any, str | None]:
  """(estimate, None), or (None, why not): too few known samples or seeds."""
  try:
    return estimate(), None
  except (UserError, np.linalg.LinAlgError) as e:
    return None, str(e)


def _known(
  normal: limits.Healthy, first: limits.Healthy, after: np.ndarray, arl0: float
) -> tuple[limits.Parameters | None, dict]:
  """Fit of a fault, None where too little is known of it, and its limits; healthy channels and the
  first of them, (T, S, C) after the onset.
  """
  fit, no_fit = _attempt(lambda: limits.fit(normal, after))
  information, no_information = _attempt(lambda: limits.information(normal, after))
  form, no_form = _attempt(lambda: limits.closed_form(first, after[..., 0], arl0))
  unknown = dict.fromkeys(LIMITS)
  return fit, unknown | {"note": no_fit or no_information or no_form} | (information or {}) | (
    form or {}
  )


def _thresholds(ratio: np.ndarray, lanes: int, count_from: int, most: float) -> np.ndarray:
  """The least threshold of each fault with at most `most` alarms on its `lanes` columns of ratio
  (T, faults x lanes).
  """
  faults = ratio.shape[1] // lanes
  few = lambda levels: (
    restarted(ratio, np.repeat(levels, lanes))[0][count_from:]
    .reshape(-1, faults, lanes)
    .sum((0, 2))
    <= most
  )
  # heavy tails: a single healthy step can carry hundreds of nats
  low, high, _ = healthy.reach(few, np.zeros(faults), np.full(faults, START))
  return healthy.halve(few, low, high, lambda a, b: (a + b) / 2, HALVINGS)


def _ratios(x: np.ndarray, fits: list[limits.Parameters]) -> np.ndarray:
  """Log-likelihood ratios (T, faults x S) of healthy channels (T, S, C), nan over the first ORDER
  steps; one healthy model stands in all fits.
  """
  out, lanes = np.full((len(x), len(fits) * x.shape[1]), np.nan), x.shape[1]
  x = limits.lagged(x, ORDER)  # type: ignore[assignment]
  before = limits.log_density(x, fits[0].before)
  for k, one in enumerate(fits):
    out[ORDER:, k * lanes : (k + 1) * lanes] = limits.log_density(x, one.after) - before
  return out


def oracles(streams: StreamSet, data: Data) -> dict[tuple[str, float], Oracle]:
  """The likelihood-ratio CUSUM of every fault: fitted on the seeds that tune, calibrated on their
  healthy streams, run on the seeds that score.

  Args:
    data: leaderboard.Data of one robot of the set.
  """
  lanes = data.tune.residual.opr.shape[1]
  each = lanes // len(dict.fromkeys(data.tune.seed.tolist()))
  tune, score = (channels(x.residual) for x in (data.tune, data.score))
  normal: Any = tune[data.count_from :, ::each]
  normal, first, known = limits.Healthy(normal, ORDER), limits.Healthy(normal[..., 0], ORDER), {}
  for key in streams.faults(data.robot):
    tuned: Any = streams.get(data.robot, streams.find(data.robot, "fault", "tune", *key))
    after = np.stack(
      [
        channels(tuned.residual, slice(s, s + 1))[o : o + data.horizon, 0]
        for s, o in enumerate(tuned.onset)
      ],
      1,
    )
    known[key] = _known(normal, first, after, data.arl0)
  out = {key: Oracle(limit, None) for key, (_, limit) in known.items()}
  fits = {key: fit for key, (fit, _) in known.items() if fit is not None}
  if not fits:
    return out
  each_fault = list(fits.values())
  tuned = _ratios(tune, each_fault)
  levels = _thresholds(
    tuned, lanes, data.count_from, lanes * (len(tune) - data.count_from) / data.arl0
  )
  tuned = restarted(tuned, np.repeat(levels, lanes))[0]
  scored = restarted(_ratios(score, each_fault), np.repeat(levels, score.shape[1]))
  part = lambda x, k: x[
    :, k * (x.shape[1] // len(fits)) : (k + 1) * (x.shape[1] // len(fits))
  ]  # of fault k
  for k, (key, fit) in enumerate(fits.items()):
    own = data.own(key)
    ratio = _ratios(channels(data.fault.residual, own), [fit])
    fired, evidence = restarted(ratio, np.full(ratio.shape[1], levels[k]))
    nominal = [healthy.by_seed(part(x, k), data.score.seed, data.count_from) for x in scored]
    arl0 = metrics.arl0(part(tuned, k), data.count_from)
    latency = metrics.latencies(fired, data.fault.onset[own], data.horizon)
    out[key] = Oracle(
      out[key].limits,
      OracleRun(latency, fired, evidence, *nominal, float(levels[k]), arl0),  # type: ignore[arg-type, call-arg]
    )
  return out
