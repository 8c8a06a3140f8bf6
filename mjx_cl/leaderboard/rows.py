"""Rows of the board: what a detector, or an oracle, did on each fault and severity of a robot."""

import math

import numpy as np

from mjx_cl.leaderboard import oracle as oracles
from mjx_cl.leaderboard.calibration import Found
from mjx_cl.leaderboard.streams import Data
from mjx_cl.scoring import limits, metrics, thresholds

# rows that are there whatever detectors are chosen
ORACLES = ("true onset (oracle)", "likelihood_ratio (oracle)")
EPISODES = ("episode_alarm_probability", "episode_alarm_probability_ci")


def rows_of(
  name: str, reference: bool, result: Found, data: Data, known: dict[tuple, oracles.Oracle]
) -> list[dict]:
  """One row per fault and severity, of which `known` tells what its oracle did."""
  out = []
  for key, oracle in known.items():
    own = data.own(key)
    part = result._replace(fired=result.fired[:, own], score=result.score[:, own])
    out.append(_row(name, reference, data, key, part, oracle))
  return out


def _row(
  name: str,
  reference: bool,
  data: Data,
  key: tuple[str, float],
  result: Found,
  oracle: oracles.Oracle,
) -> dict:
  """One row; fired and score of `result` are of this fault's streams alone."""
  onset, threshold, arl0 = data.fault.onset[data.own(key)], result.threshold, result.arl0
  row = metrics.row(
    result.fired,
    result.score,
    onset,
    result.nominal_fired,
    result.nominal_score,
    data.fault.control_s,
    data.count_from,
    horizon_s=data.horizon_s,
  )
  latency = metrics.latencies(result.fired, onset, data.horizon)
  best = metrics.latencies(oracle.run.fired, onset, data.horizon) if oracle.run else latency
  share = limits.efficiency(best, latency, data.horizon)
  if oracle.run is None:
    names = ("oracle_delay_steps", "oracle_delay_steps_ci", "efficiency", "efficiency_ci")
    share |= dict.fromkeys(names)
  tells = name == ORACLES[1 if oracle.run else 0]  # the row that says why a limit is unknown
  notes = [n for n in (share["note"], oracle.limits["note"] if tells else None) if n]
  return {
    "detector": name,
    "reference": reference,
    "robot": data.robot,
    "fault": key[0],
    "severity": key[1],
    "threshold": threshold if threshold is None or math.isfinite(threshold) else None,
    "arl0": arl0.get("arl0"),
    "arl0_ci": arl0.get("arl0_ci"),
    "arl0_alarms": arl0.get("alarms"),
    "arl0_few": arl0.get("few", False),
    **{k: result.episode.get(k) for k in EPISODES},
    **row,
    "us_per_sample": result.us_per_sample,
    **{k: oracle.limits[k] for k in oracles.LIMITS},
    **share,
    "note": "; ".join(notes) or None,
  }


def oracle_rows(data: Data, known: dict[tuple, oracles.Oracle]) -> list[dict]:
  """Rows of the two oracles: the true onset, and the likelihood-ratio CUSUM where it could be
  fitted.

  Their `us_per_sample` is None: the one reads the label, the other is a NumPy loop over all streams
  of all faults at once, whose time is no detector's.
  """
  out = []
  steps = np.arange(len(data.fault.residual.opr))[:, None]
  quiet = np.zeros(data.score.episode.shape, bool)
  nominal = thresholds.by_seed(quiet, data.score.seed, data.count_from)
  for key, oracle in known.items():
    if oracle.run:
      out.append(_row(ORACLES[1], True, data, key, oracle.run, oracle))
    since = steps - data.fault.onset[data.own(key)]
    told = Found(
      None, {}, {}, nominal, nominal.astype(float), since == 0, (since >= 0).astype(float), None, []
    )
    out.append(_row(ORACLES[0], True, data, key, told, oracle))
  return out
