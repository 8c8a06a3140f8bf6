"""summary.json of a run: per arm the aggregates of its rows, each with its interval; and those of
several agents together.
"""

import collections
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_cl.config import RunConfig
from mjx_cl.runs.records import OUTCOMES, Ledger, acts
from mjx_cl.scoring import intervals

DRAWS = 1000  # of the bootstrap over agents
# of summary.json: what runs have in common that differ in seeds or agent alone
HEAD = ("env", "fault", "severity", "onset", "steps", "detector")


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
  value = _by_change(rows, config, lambda own: summarise(own, config, control_s))
  return value | value["arms"].get("detector", {})


def over_agents(agents: Mapping[str, list[dict]], config: RunConfig, control_s: float) -> dict:
  """What the runs of several agents say together, all else the same: `arms`, `later_changes` where
  there are any. Each interval is a hierarchical bootstrap (agents with replacement, then of each
  its rows), and nowhere narrower than that of `summarise`, which takes all rows as of one agent:
  few agents differ by chance less than agents do.

  Args:
    agents: name -> rows of its runs.parquet.
    config: of the runs, whatever their agent.
    control_s: seconds of a control step.
  """
  rows = [r | {"agent": name} for name, own in agents.items() for r in own]
  return {
    "agents": list(agents),
    **_by_change(rows, config, lambda own: _hierarchical(own, config, control_s)),
  }


def _by_change(rows: list[dict], config: RunConfig, of: Callable[[list[dict]], dict]) -> dict:
  """`of` the rows of each arm, of the first change and of those after it."""
  first, *later = (
    {
      arm: of(own)
      for arm in config.arms
      if (own := [r for r in rows if r["arm"] == arm and r["change"] == change])
    }
    for change in range(1 + max(r["change"] for r in rows))
  )
  return {"arms": first, **({"later_changes": later} if later else {})}


class _Aggregate(NamedTuple):
  """An aggregate of rows.

  Attributes:
    value: None where it is not defined.
    interval: makes its interval; None: it has none.
    of: the value counts so many rows; None: it is no count.
    undefined: what an undefined value counts as among others: inf of a censored time.
  """

  value: float | None
  interval: Callable[[], Sequence | None] | None
  of: int | None = None
  undefined: float = np.nan

  def comparable(self) -> float:
    """A count as a share, since what it is out of may differ."""
    if self.of is not None:
      return self.value / self.of if self.of else np.nan  # type: ignore[operator]
    return self.undefined if self.value is None else self.value


def _flat(found: Mapping[str, _Aggregate], ends: Callable[[str], Sequence | None]) -> dict:
  """NAME and NAME_ci of each aggregate; `ends` gives the interval of a name."""
  out: dict[str, Any] = {}
  for name, own in found.items():
    out[name] = own.value
    if own.interval is not None:
      out[f"{name}_ci"] = ends(name)
  return out


def _hierarchical(rows: list[dict], config: RunConfig, control_s: float) -> dict:
  """`summarise` of rows with an `agent`, with the intervals of `over_agents`."""
  found = _aggregates(rows, config, control_s)
  groups: dict[str, list[dict]] = {}
  for r in rows:
    groups.setdefault(r["agent"], []).append(r)
  own, random = list(groups.values()), np.random.default_rng(0)
  drawn: dict[str, list[float]] = {name: [] for name in found}
  for _ in range(DRAWS):
    picked = (own[k] for k in random.integers(len(own), size=len(own)))
    sample = [of[k] for of in picked for k in random.integers(len(of), size=len(of))]
    values = _aggregates(sample, config, control_s)
    for name, seen in drawn.items():  # numeric failures are named where there are any
      seen.append(values[name].comparable() if name in values else 0.0)

  def ends(name: str) -> Sequence | None:
    narrow = found[name].interval()  # type: ignore[misc]
    wide = intervals.ends(np.array([drawn[name]]))[0]
    if narrow is None or wide is None:
      return None
    if (of := found[name].of) is not None:
      wide = [None if x is None else x * of for x in wide]
    low, high = zip(narrow, wide)
    return [None if None in pair else pick(pair) for pick, pair in ((min, low), (max, high))]

  return _flat(found, ends)


def summarise(rows: list[dict], config: RunConfig, control_s: float) -> dict:
  """Aggregates of one arm. Recovery counts affected streams alone; times are censored medians;
  means are IQM with bootstrap intervals.
  """
  found = _aggregates(rows, config, control_s)
  return _flat(found, lambda name: found[name].interval())  # type: ignore[misc]


def _aggregates(rows: list[dict], config: RunConfig, control_s: float) -> dict[str, _Aggregate]:
  """What `summarise` says, by name."""
  affected = [r for r in rows if r["affected"]]
  met = [r for r in rows if r["onset"] is not None and not r.get("adapting_at_onset")]
  watched = [r for r in affected if not r.get("adapting_at_onset")]
  time = lambda step, since=0: np.inf if step is None else step - since
  latency = [time(r["latency_steps"]) for r in met]
  back = [time(r["recovery_step"], r["onset"]) for r in affected]
  missed, n = int(np.isinf(latency).sum()), len(rows)
  outcomes = collections.Counter(r["outcome"] for r in rows)
  return {
    "seeds": _Aggregate(n, None),
    "affected": _count(len(affected), sum(r["affected"] is not None for r in rows)),
    "adapting_at_onset": _count(sum(bool(r.get("adapting_at_onset")) for r in rows), n),
    "alarms": _count(len(met) - missed, len(met)),
    "false_alarm_streams": _count(sum(bool(r["false_alarms"]) for r in rows), n),
    "false_alarms_per_hour": _false_alarms(rows, config.steps, control_s),
    "latency_median_steps": _median(latency),
    "miss_probability": _Aggregate(
      missed / len(met) if met else None, lambda: intervals.wilson(missed, len(met))
    ),
    "affected_watched": _count(len(watched), len(affected)),
    "affected_alarmed_within_500": _count(
      sum(time(r["latency_steps"]) <= 500 for r in watched), len(watched)
    ),
    **{
      outcome: _count(outcomes[outcome], n)
      for outcome in dict.fromkeys((*OUTCOMES.values(), "adapting"))
      # numeric failures are named where there are any
      if outcomes[outcome] or outcome != "failed"
    },
    "recovered": _count(sum(map(np.isfinite, back)), len(affected)),
    "recovered_within_10000": _count(sum(x <= 10_000 for x in back), len(affected)),
    "recovery_median_steps": _median(back),
    "reward_pre": _mean("reward_pre", rows),
    "reward_drop": _mean("reward_drop", rows),
    "reward_final": _mean("reward_final", rows),
    "return_lost": _mean("return_lost", rows),
    # a ledger: what is rare must count
    "return_lost_healthy_mean": _mean("return_lost_healthy", rows, np.mean),
    "adapted_steps_mean": _mean("adapted_steps", rows, np.mean),
    "updates_mean": _mean("updates", rows, np.mean),
    "terminations_mean": _mean("terminations", rows, np.mean),
    "reward_final_affected": _mean("reward_final", affected),
  }


def _count(hits: int, n: int) -> _Aggregate:
  """So many of `n` streams."""

  def ends() -> list[float] | None:
    interval = intervals.wilson(hits, n)
    return None if interval is None else [x * n for x in interval]

  return _Aggregate(int(hits), ends, n)


def _false_alarms(rows: list[dict], steps: int, control_s: float) -> _Aggregate:
  """False alarms per hour of healthy robots, of runs of `steps` control steps."""
  healthy = (
    steps if r["onset"] is None else min(r["onset"], steps) for r in rows if not r["change"]
  )
  hours, count = sum(healthy) * control_s / 3600, sum(r["false_alarms"] or 0 for r in rows)
  if not hours:
    return _Aggregate(None, lambda: None)
  return _Aggregate(count / hours, lambda: [x / hours for x in intervals.poisson(count)])


def _median(times: list[float]) -> _Aggregate:
  """Median of times [control steps], infinite ones censored."""
  value = intervals.finite(intervals.censored_median(times)) if times else None
  return _Aggregate(
    value,
    lambda: intervals.interval(times, intervals.censored_median),
    undefined=np.inf if times else np.nan,
  )


def _mean(
  name: str, rows: Iterable[dict], statistic: Callable[..., Any] = intervals.iqm
) -> _Aggregate:
  """A mean over the rows in which `name` is known."""
  values = [r[name] for r in rows if r[name] is not None]
  value = float(statistic(values)) if values else None
  return _Aggregate(value, lambda: intervals.interval(values, statistic))
