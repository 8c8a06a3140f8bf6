"""summary.json of a run: per arm the aggregates of its rows, each with its interval."""

import collections
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mjx_cl.config import RunConfig
from mjx_cl.runs.records import OUTCOMES, Ledger, acts
from mjx_cl.scoring import intervals


def summary(
  ledger: Ledger,
  rows: list[dict],
  trace: dict[str, np.ndarray],
  seconds: dict[str, float],
) -> dict:
  """summary.json: per arm the aggregates; those of arm `detector` also at the top level.

  Args:
    ledger: of the run.
    rows: of runs.parquet.
    trace: of the run.
    seconds: wall time by kind of work (runner.KINDS).
  """
  config, wall = ledger.config, sum(seconds.values())
  severities = [c.severity if acts(c) else 0.0 for c in ledger.changes]
  arms = by_arm(rows, config, ledger.spec.control_s)
  share, interval = invalid(trace["valid"], ledger.repeat)
  return {
    "env": config.env,
    "fault": config.fault,
    "severity": max(severities) if ledger.becomes is None else 1.0,
    "onset": config.onset,
    "steps": config.steps,
    "detector": config.detector,
    **arms,
    "invalid_share": share,
    "invalid_share_ci": interval,
    "wall_s": wall,
    "wall_s_arms": {
      arm: float(sum(r["wall_s"] or 0.0 for r in rows if r["arm"] == arm)) for arm in arms["arms"]
    },
    "wall_share": {k: v / wall for k, v in seconds.items()},
  }


def invalid(valid: np.ndarray, repeat: int) -> tuple[float | None, list | None]:
  """Share of the decisions whose residuals are not known, the first 15 apart, and its interval over
  streams; None for shorter runs. valid: bool (control steps, groups).
  """
  known = valid[15 * repeat :][repeat - 1 :: repeat]
  if not len(known):
    return None, None
  each = 1.0 - known.mean(0)
  return float(np.mean(each)), intervals.interval(each, np.mean)


def by_arm(rows: list[dict], config: RunConfig, control_s: float) -> dict:
  """What summary.json says from the rows of runs.parquet alone: `arms`, `later_changes` where there
  are any, and arm `detector` once more at the top.
  """
  first, *later = (
    {
      arm: summarise(own, config, control_s)
      for arm in config.arms
      if (own := [r for r in rows if r["arm"] == arm and r["change"] == change])
    }
    for change in range(1 + max(r["change"] for r in rows))
  )
  return {"arms": first, **({"later_changes": later} if later else {}), **first.get("detector", {})}


def summarise(rows: list[dict], config: RunConfig, control_s: float) -> dict:
  """Aggregates of one arm. Recovery counts affected streams alone; times are censored medians;
  means are IQM with bootstrap intervals.
  """
  affected = [r for r in rows if r["affected"]]
  met = [r for r in rows if r["onset"] is not None and not r.get("adapting_at_onset")]
  watched = [r for r in affected if not r.get("adapting_at_onset")]
  time = lambda step, since=0: np.inf if step is None else step - since
  latency = [time(r["latency_steps"]) for r in met]
  back = [time(r["recovery_step"], r["onset"]) for r in affected]
  missed, n = int(np.isinf(latency).sum()), len(rows)
  outcomes = collections.Counter(r["outcome"] for r in rows)
  return {
    "seeds": n,
    **_count("affected", len(affected), sum(r["affected"] is not None for r in rows)),
    **_count("adapting_at_onset", sum(bool(r.get("adapting_at_onset")) for r in rows), n),
    **_count("alarms", len(met) - missed, len(met)),
    **_count("false_alarm_streams", sum(bool(r["false_alarms"]) for r in rows), n),
    **_false_alarms(rows, config.steps, control_s),
    **_median("latency_median_steps", latency),
    **_entry(
      "miss_probability", missed / len(met) if met else None, intervals.wilson(missed, len(met))
    ),
    **_count("affected_watched", len(watched), len(affected)),
    **_count(
      "affected_alarmed_within_500",
      sum(time(r["latency_steps"]) <= 500 for r in watched),
      len(watched),
    ),
    **{
      key: value
      for outcome in dict.fromkeys((*OUTCOMES.values(), "adapting"))
      # numeric failures are named where there are any
      if outcomes[outcome] or outcome != "failed"
      for key, value in _count(outcome, outcomes[outcome], n).items()
    },
    **_count("recovered", sum(map(np.isfinite, back)), len(affected)),
    **_count("recovered_within_10000", sum(x <= 10_000 for x in back), len(affected)),
    **_median("recovery_median_steps", back),
    **_mean("reward_pre", rows),
    **_mean("reward_drop", rows),
    **_mean("reward_final", rows),
    **_mean("return_lost", rows),
    # a ledger: what is rare must count
    **_mean("return_lost_healthy", rows, "_mean", np.mean),
    **_mean("adapted_steps", rows, "_mean", np.mean),
    **_mean("updates", rows, "_mean", np.mean),
    **_mean("terminations", rows, "_mean", np.mean),
    **_mean("reward_final", affected, "_affected"),
  }


def _entry(name: str, value: float | None, interval: Sequence | None) -> dict:
  return {name: value, f"{name}_ci": interval}


def _count(name: str, hits: int, n: int) -> dict:
  """So many of `n` streams."""
  interval = intervals.wilson(hits, n)
  return _entry(name, hits, None if interval is None else [x * n for x in interval])


def _false_alarms(rows: list[dict], steps: int, control_s: float) -> dict:
  """False alarms per hour of healthy robots, of runs of `steps` control steps."""
  healthy = (
    steps if r["onset"] is None else min(r["onset"], steps) for r in rows if not r["change"]
  )
  hours, count = sum(healthy) * control_s / 3600, sum(r["false_alarms"] or 0 for r in rows)
  if not hours:
    return _entry("false_alarms_per_hour", None, None)
  interval = [x / hours for x in intervals.poisson(count)]
  return _entry("false_alarms_per_hour", count / hours, interval)


def _median(name: str, times: list[float]) -> dict:
  """Median of times [control steps], infinite ones censored."""
  value = intervals.finite(intervals.censored_median(times)) if times else None
  return _entry(name, value, intervals.interval(times, intervals.censored_median))


def _mean(
  name: str, rows: list[dict], suffix: str = "", statistic: Callable[..., Any] = intervals.iqm
) -> dict:
  """A mean over the rows in which `name` is known, under its name and the suffix."""
  values = [r[name] for r in rows if r[name] is not None]
  value = float(statistic(values)) if values else None
  return _entry(name + suffix, value, intervals.interval(values, statistic))
