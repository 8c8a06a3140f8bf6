"""The oracle of the leaderboard: what a CUSUM knows that was fitted to the very fault on other
seeds, and how early the channel could tell.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from mjx_cl.errors import UserError
from mjx_cl.leaderboard.calibration import Found
from mjx_cl.leaderboard.streams import Data, StreamSet
from mjx_cl.rollout.monitor import Residual
from mjx_cl.scoring import autoregression, limits, metrics
from mjx_cl.scoring import thresholds as healthy
from mjx_cl.scoring.autoregression import ORDER, Healthy, Parameters

CHANNELS = ("opr", "rpr")  # the declared channel: what the single-residual detectors see
LIMITS = tuple(
  k + end for k in ("information_nats_per_step", "optimal_delay_steps") for end in ("", "_ci")
)
START, HALVINGS = 40.0, 14  # of the search for a threshold [nats]


class Oracle(NamedTuple):
  """What is known of one fault.

  Attributes:
    limits: what LIMITS names, and a note on why one is None.
    run: of the likelihood-ratio CUSUM, on this fault's streams alone; None where it cannot be
      fitted.
  """

  limits: dict
  run: Found | None


def channels(residual: Residual, columns: slice | np.ndarray = slice(None)) -> np.ndarray:
  """Ln of the oracle's channels, (T, S, C)."""
  own = lambda c: np.asarray(getattr(residual, c))[:, columns].astype(float)
  return np.stack([np.log(np.maximum(own(c), 1e-9)) for c in CHANNELS], -1)


def restarted(ratio: np.ndarray, thresholds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """CUSUM with restarts of log-likelihood ratios (T, S), nan = skipped, at one threshold for each
  stream: (fired, score), (T, S).
  """
  evidence, known = np.zeros(ratio.shape[1]), np.isfinite(ratio)
  fired, score = np.zeros(ratio.shape, bool), np.full(ratio.shape, np.nan)
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
  normal: Healthy, first: Healthy, after: np.ndarray, arl0: float
) -> tuple[Parameters | None, dict]:
  """Fit of a fault, None where too little is known of it, and its limits; healthy channels and the
  first of them, (T, S, C) after the onset.
  """
  fit, no_fit = _attempt(lambda: autoregression.fit(normal, after))
  information, no_information = _attempt(lambda: limits.information(normal, after))
  form, no_form = _attempt(lambda: limits.closed_form(first, after[..., 0], arl0))
  unknown = {**dict.fromkeys(LIMITS), "note": no_fit or no_information or no_form}
  return fit, unknown | (information or {}) | (form or {})


def _thresholds(ratio: np.ndarray, lanes: int, count_from: int, most: float) -> np.ndarray:
  """The least threshold of each fault with at most `most` alarms on its `lanes` columns of ratio
  (T, faults x lanes).
  """
  faults = ratio.shape[1] // lanes

  def few(levels: np.ndarray) -> np.ndarray:
    fired = restarted(ratio, np.repeat(levels, lanes))[0][count_from:]
    return fired.reshape(-1, faults, lanes).sum((0, 2)) <= most

  # heavy tails: a single healthy step can carry hundreds of nats
  low, high, _ = healthy.reach(few, np.zeros(faults), np.full(faults, START))
  return healthy.halve(few, low, high, lambda a, b: (a + b) / 2, HALVINGS)


def _ratios(x: np.ndarray, fits: list[Parameters]) -> np.ndarray:
  """Log-likelihood ratios (T, faults x S) of healthy channels (T, S, C), nan over the first ORDER
  steps; one healthy model stands in all fits.
  """
  known = autoregression.lagged(x, ORDER)
  before = autoregression.log_density(known, fits[0].before)
  ratios = [autoregression.log_density(known, one.after) - before for one in fits]
  return np.pad(np.concatenate(ratios, 1), ((ORDER, 0), (0, 0)), constant_values=np.nan)


def episodes(fired: np.ndarray, data: Data) -> dict:
  """metrics.episode_alarm_probability of alarms on the healthy streams that score, which
  `by_seed` has put one after the other.
  """
  seeds, episode = data.score.seed, data.score.episode
  order = np.concatenate([np.flatnonzero(seeds == seed) for seed in dict.fromkeys(seeds.tolist())])
  # stream by stream again; what came before `count_from` counts nowhere
  apart = np.zeros(episode.shape, bool)
  apart[data.count_from :] = fired[data.count_from :].T.reshape(len(order), -1).T
  return metrics.episode_alarm_probability(apart, episode[:, order], data.count_from)


def oracles(streams: StreamSet, data: Data) -> dict[tuple[str, float], Oracle]:
  """The likelihood-ratio CUSUM of every fault: fitted on the seeds that tune, calibrated on their
  healthy streams, run on the seeds that score.

  Args:
    streams: the set.
    data: of one robot of the set.
  """
  each = len(data.tune.seed) // len(set(data.tune.seed.tolist()))
  tune = channels(data.tune.residual)
  normal = tune[data.count_from :, ::each]
  whole, first = Healthy(normal, ORDER), Healthy(normal[..., 0], ORDER)
  known = {}
  for key in streams.faults(data.robot):
    tuned = streams.get(data.robot, streams.find(data.robot, "fault", "tune", *key))
    after = [
      channels(tuned.residual, slice(s, s + 1))[o : o + data.horizon, 0]
      for s, o in enumerate(tuned.onset)
    ]
    known[key] = _known(whole, first, np.stack(after, 1), data.arl0)
  fits = {key: fit for key, (fit, _) in known.items() if fit is not None}
  runs = _runs(data, tune, fits) if fits else {}
  return {key: Oracle(limit, runs.get(key)) for key, (_, limit) in known.items()}


def _runs(
  data: Data, tune: np.ndarray, fits: dict[tuple[str, float], Parameters]
) -> dict[tuple[str, float], Found]:
  """The CUSUM of each fit, calibrated on `tune`, the channels of the healthy streams that tune."""
  each, lanes = list(fits.values()), tune.shape[1]
  ratio = _ratios(tune, each)
  most = lanes * (len(tune) - data.count_from) / data.arl0
  levels = _thresholds(ratio, lanes, data.count_from, most)
  tuned, _ = restarted(ratio, np.repeat(levels, lanes))
  ratio = _ratios(channels(data.score.residual), each)
  scored = restarted(ratio, np.repeat(levels, ratio.shape[1] // len(fits)))
  out = {}
  for k, (key, fit) in enumerate(fits.items()):
    part = lambda x, k=k: np.split(x, len(fits), 1)[k]  # of this fault
    ratio = _ratios(channels(data.fault.residual, data.own(key)), [fit])
    by_seed = lambda x: healthy.by_seed(part(x), data.score.seed, data.count_from)
    nominal_fired, nominal_score = (by_seed(x) for x in scored)
    fired, score = restarted(ratio, np.full(ratio.shape[1], levels[k]))
    out[key] = Found(
      float(levels[k]),
      metrics.arl0(part(tuned), data.count_from),
      episodes(nominal_fired, data),
      nominal_fired,
      nominal_score,
      fired,
      score,
      None,
      [],
    )
  return out
