"""What a run writes down: from the trace of all streams to the tables of the contract, the events,
a row per stream and change, and the summary.

NumPy on the host; nothing here moves a robot. Definitions: scoring/recovery.py, scoring/alarms.py.
Streams are numbered arm by arm, seed by seed.
"""

from __future__ import annotations

import dataclasses
import pathlib
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mjx_cl.adapt import decide as phase_lib
from mjx_cl.adapt.arms import ARMS, FOREVER, NEVER
from mjx_cl.adapt.decide import SIGNALS
from mjx_cl.config import AdaptConfig, RunConfig
from mjx_cl.errors import FileError
from mjx_cl.io import tables
from mjx_cl.rollout.monitor import watched
from mjx_cl.scoring import alarms as alarm_score
from mjx_cl.scoring import intervals, recovery
from mjx_cl.types import Spec

if TYPE_CHECKING:
  from typing import Any

  from mjx_cl.faults.presets import Change

# by decision: what a stream has come to
OUTCOMES = {
  "stop": "converged",
  "abort_below": "aborted_by_rule",
  "abort_hopeless": "aborted_by_rule",
  "abort_budget": "aborted_by_budget",
  "end": "ended",
  "abort_numeric": "failed",
}


def acts(change: Change) -> bool:
  """Whether a change of the robot is one: a fault of a severity above 0."""
  return change.fault != "none" and change.severity > 0


class Ledger(NamedTuple):
  """What must be known of a run besides its trace.

  Attributes:
    config: of the run. spec: of the robot. repeat: control steps of a decision. chunk_steps:
      control steps of a chunk.
    changes: of presets.Change, the faults. becomes: name of the robot that it turns into, or
      None.
    labels: (arm, seed) of each stream. breaks: bool (groups,), whether its robot breaks. names: its
      fault and target, "none" where it is spared.
    onsets: control step of its first change, None where there is none in this run, see
      run.Runner.onsets.
    updates: int (groups,), taken by the end. stream_seconds: float (groups,), share of the wall
      time.
  A trace is a dict of arrays, (steps, groups) or (chunks, groups), as run.Runner keeps it.
  """

  config: RunConfig
  spec: Spec
  repeat: int
  chunk_steps: int
  changes: tuple
  becomes: str | None
  labels: list[tuple[str, int]]
  breaks: np.ndarray
  names: list[str]
  onsets: list[int | None]
  updates: np.ndarray
  stream_seconds: np.ndarray

  def later(self, onset: int) -> dict[int, str]:
    """Control steps at which a stream with this onset changes, in order, and what happens: its
    onset, those of faults that come later, and repairs.
    """
    c, out = self.config, {onset: "onset"}
    for change in self.changes:
      begin = c.onset + change.after
      for step, kind in ((begin, "onset"), (begin + (change.duration or FOREVER), "repair")):
        if acts(change) and onset < step < c.steps and out.get(step) != "onset":
          out[step] = kind
    return dict(sorted(out.items()))

  def trace(self, trace: dict[str, np.ndarray]) -> dict:
    """Columns of trace.parquet, stream by stream."""
    steps, groups = trace["reward"].shape
    flat = lambda x: np.ascontiguousarray(x.T).reshape(-1)
    column = lambda values: np.repeat(np.asarray(values), steps)
    table = {
      "stream": column(np.arange(groups, dtype=np.int32)),
      "arm": column([a for a, _ in self.labels]),
      "seed": column(np.asarray([s for _, s in self.labels], np.int32)),
      "fault": column(self.names),
      "step": np.tile(np.arange(steps, dtype=np.int32), groups),
      "episode": flat(trace["episode"]),
      "phase": np.asarray(phase_lib.PHASES)[flat(trace["phase"])],
      "fault_active": flat(trace["severity"] > 0),
      "severity": flat(trace["severity"]),
      "reward": flat(trace["reward"]),
      "opr": flat(trace["opr"]),
      "rpr": flat(trace["rpr"]),
      "score": flat(trace["score"]),
      "alarm": flat(trace["alarm"]),
      "terminated": flat(trace["terminated"]),
      "truncated": flat(trace["truncated"]),
      "valid": flat(trace["valid"]),
    }
    if self.config.parts:
      table |= {
        f"residual_{name}": flat(trace["parts"][:, :, k])
        for k, (name, at) in enumerate(watched(self.spec))
        if at
      }
    for column_name, index in (
      ("dyn_loss", 3),
      ("adv_mag", 4),
      ("value_loss", 5),
    ):  # once per chunk, in the row at which it is known
      values = np.full((steps, groups), np.nan, np.float32)
      at = np.minimum((np.arange(len(trace["signals"])) + 1) * self.chunk_steps, steps) - 1
      values[at] = trace["signals"][:, :, index]
      table[column_name] = flat(values)
    return table | {"updates": flat(trace["updates"])}

  def signals(self, trace: dict[str, np.ndarray]) -> dict:
    """Per chunk what the stop rule read: the six signals, posture and the levels asked for."""
    chunks, groups = trace["decision"].shape
    flat = lambda x: np.ascontiguousarray(x.T).reshape(-1)
    column = lambda values: np.repeat(np.asarray(values), chunks)
    step = (
      np.minimum((np.arange(chunks, dtype=np.int32) + 1) * self.chunk_steps, self.config.steps) - 1
    )
    least = (self.spec.posture or (0, np.nan))[1]
    return {
      "stream": column(np.arange(groups, dtype=np.int32)),
      "arm": column([a for a, _ in self.labels]),
      "seed": column(np.asarray([s for _, s in self.labels], np.int32)),
      "step": np.tile(step, groups).astype(np.int32),
      **{name: flat(trace["signals"][:, :, i]) for i, name in enumerate(SIGNALS)},
      "posture": flat(trace["posture"]),
      "acceptance": flat(trace["acceptance"]),
      "least_posture": np.full(chunks * groups, least, np.float32),
    }

  def events(self, trace: dict[str, np.ndarray]) -> list[dict]:
    """Every onset, alarm, start, stop, abort, rollback and repair, with its reason."""
    c, events = self.config, []
    for g, ((arm, seed), onset) in enumerate(zip(self.labels, self.onsets)):
      healthy = "on a healthy robot" if onset is None else "before onset"
      onset, trigger = c.steps if onset is None else onset, ARMS[arm].trigger

      def add(
        step: int | np.integer,
        kind: str,
        reason: str,
        cause: str | None = None,
        decision: str | None = None,
        since: int | None = None,
      ) -> None:
        events.append(
          {
            "stream": g,
            "arm": arm,
            "seed": seed,
            "step": int(step),
            "kind": kind,
            "cause": cause,
            "decision": decision,
            "since": since,
            "chunk": int(step) // self.chunk_steps,
            "reason": reason,
            "fault": self.names[g],
          }
        )

      if self.becomes is not None and onset < c.steps:
        add(onset, "onset", f"becomes {self.becomes}, severity 1", f"becomes {self.becomes}")
      for change in self.changes:
        begin = c.onset + change.after
        if self.breaks[g] and acts(change) and begin < c.steps:
          several = f"{change.fault}, " if len(self.changes) > 1 or self.becomes is not None else ""
          add(
            begin,
            "onset",
            f"{several}severity {change.severity:g}"
            + ("" if change.schedule == "abrupt" else f", {change.schedule}"),
            change.fault,
          )
          if change.duration and begin + change.duration < c.steps:
            said = f"{several}after {change.duration} steps"
            add(begin + change.duration, "repair", said, change.fault)
      decisions = trace["decision"][:, g]
      started = {int(trace["since"][i, g]) for i in np.flatnonzero(decisions == phase_lib.START)}
      for step in np.flatnonzero(trace["alarm"][:, g]):
        false = f", {healthy}: a false alarm" if step < onset else ""
        if trigger.listens and int(step) in started:
          add(step, "alarm", "acted on" + false, "acted on")
        else:
          phase = phase_lib.PHASES[trace["phase"][step, g]]
          late = (
            decisions[step // self.chunk_steps] == phase_lib.START
          )  # the phase changes at the end of the chunk
          why = (
            "warm-up"
            if step < c.adapt.warmup
            else "an alarm before it was"
            if late
            else f"phase {phase}"
          )
          if not trigger.listens:
            why = "arm does not adapt" if trigger is NEVER else "arm does not listen"
          add(step, "alarm", f"logged, not acted on: {why}" + false, why)
      for i in np.flatnonzero(decisions):
        end = min((i + 1) * self.chunk_steps, c.steps) - 1  # type: ignore[operator]
        decision = int(decisions[i])
        kind = {phase_lib.START: "start", phase_lib.STOP: "stop", phase_lib.END: "stop"}.get(
          decision, "abort"
        )
        starts, since = decision == phase_lib.START, int(trace["since"][i, g])
        add(
          end,
          kind,
          f"{trigger.why} at step {since}" if starts else phase_lib.REASONS[decision],
          trigger.why if starts else None,
          phase_lib.DECISIONS[decision],
          since,
        )
        if "back" in trace and trace["back"][i, g]:
          add(
            end,
            "rollback",
            (
              f"the weights of before earned {trace['earned'][i, g]:.3f} a step, those of now "
              f"{trace['earns'][i, g]:.3f}"
            ),
            since=since,
          )
    return sorted(events, key=lambda e: (e["stream"], e["step"]))

  def rows(self, trace: dict[str, np.ndarray], events: list[dict]) -> list[dict]:
    """One row per stream and change, in order: the first change's row holds the stream from its
    start up to the next change, see `later`.
    """
    c, rows = self.config, []
    control_s = self.spec.control_s
    happens = [{c.steps: "onset"} if onset is None else self.later(onset) for onset in self.onsets]
    changes = [list(own) for own in happens]
    onsets = [own[0] for own in changes]
    pre, drop, begun = {}, {}, {}
    for g, ((arm, seed), onset) in enumerate(zip(self.labels, onsets)):
      reward = trace["reward"][: (changes[g] + [c.steps])[1], g].astype(float)
      acted = [
        int(s)
        for s, d in zip(trace["since"][:, g], trace["decision"][:, g])
        if d == phase_lib.START
      ]
      begun[g] = acted[0] if acted else None
      pre[g] = recovery.reward_pre(reward, onset, c.adapt.warmup, begun[g])
      if arm == "none":
        drop[seed] = recovery.reward_drop(reward, onset, pre[g]) if onset < c.steps else None
    for g, (arm, seed) in enumerate(
      self.labels
      # no alarm ends the window of an arm that does not listen: the same life goes on in arm `none`
    ):
      if not ARMS[arm].trigger.listens and not ARMS[arm].agent and ("none", seed) in self.labels:
        pre[g] = pre[self.labels.index(("none", seed))]
    for g, (arm, seed) in enumerate(self.labels):
      for change, onset in enumerate(changes[g]):
        begin, end = (onset if change else 0), (changes[g] + [c.steps])[change + 1]
        reward = trace["reward"][:end, g].astype(float)
        own = [e for e in events if e["stream"] == g and begin <= e["step"] < max(end, 1)]
        score = alarm_score.score(trace["alarm"][begin:end, g], onset - begin)
        starts = [e["step"] for e in own if e["kind"] == "start"]
        ends = [e for e in own if e["kind"] in ("stop", "abort")]
        outcome = (
          "adapting"
          if starts or change and trace["phase"][begin, g] == phase_lib.ADAPTING
          else "nominal"
        )
        if ends and (not starts or ends[-1]["step"] > starts[-1]):
          outcome = OUTCOMES[ends[-1]["decision"]]
        never = self.onsets[g] is None
        before, lost = pre[g], None if never else drop.get(seed)
        # no arm without adaptation lives on as this one does: its own first steps after the change
        # say what that cost
        if change:
          before = float(np.mean(reward[max(0, onset - recovery.FINAL) : onset]))
          lost = recovery.reward_drop(reward, onset, before)
        affected = None if lost is None else bool(lost >= 0.1)
        back = recovery.recovery_step(reward, onset, before)
        stable = (
          None
          if never
          else recovery.stable_step(reward, trace["terminated"][:end, g], onset, before)
        )
        last = (self.updates[g] if end == c.steps else trace["updates"][end, g]) - (
          trace["updates"][begin, g] if change else 0
        )
        rows.append(
          {
            "stream": g,
            "arm": arm,
            "seed": seed,
            "fault": self.names[g],
            "change": change,
            "kind": happens[g][onset],
            "onset": None if never else onset,
            "alarm_step": None if score.alarm_step is None else score.alarm_step + begin,
            "latency_steps": score.latency_steps,
            "latency_s": None if score.latency_steps is None else score.latency_steps * control_s,
            "false_alarms": None if change else score.false_alarms,
            "adapt_start": starts[0] if starts else None,
            "adapt_stop": ends[-1]["step"] if ends else None,
            "outcome": outcome,
            "reason": ends[-1]["reason"] if ends else None,
            "affected": affected,
            "recovery_step": back if affected else None,
            "stable_step": stable,
            "reward_pre": before,
            "reward_drop": lost,
            "reward_final": float(np.mean(reward[-recovery.FINAL :])),
            "return_lost": None if never else recovery.return_lost(reward, onset, before),
            "return_lost_healthy": None
            if change
            else recovery.return_lost_healthy(reward, onset, before, begun[g]),
            "terminations": int(trace["terminated"][begin:end, g].sum()),
            "adapted_steps": int(np.sum(trace["phase"][begin:end, g] == phase_lib.ADAPTING)),
            "updates": int(last),
            "wall_s": None if change else float(self.stream_seconds[g]),
          }
        )
    return set_apart(rows, events)

  def summary(
    self,
    rows: list[dict],
    trace: dict[str, np.ndarray],
    seconds: dict[str, float],
    quiet: list[float],
    chunks: int,
  ) -> dict:
    """summary.json: per arm the aggregates, each with its interval; arm `detector` also at the top
    level.

    Args:
      rows: of runs.parquet. seconds: wall time by kind of work (physics, acting, digest, other).
        quiet: digest's of each chunk without an update. chunks: of the run.
    """
    severity = (
      1.0 if self.becomes is not None else max(c.severity if acts(c) else 0.0 for c in self.changes)
    )
    out: dict[str, Any] = {
      "env": self.config.env,
      "fault": self.config.fault,
      "severity": severity,
      "onset": self.config.onset,
      "steps": self.config.steps,
      "detector": self.config.detector,
    }
    out |= by_arm(rows, self.config, self.spec.control_s)
    out["invalid_share"], out["invalid_share_ci"] = invalid(trace["valid"], self.repeat)
    wall = sum(seconds.values())
    quiet = float(np.median(quiet)) if quiet else 0.0  # type: ignore[assignment]
    monitor: Any = min(seconds["digest"], quiet * max(1, chunks - 1))
    shares = {
      "physics": seconds["physics"],
      "acting": seconds["acting"],
      "monitor": monitor,
      "updates": seconds["digest"] - monitor,
      "other": seconds["other"],
    }
    out["wall_s"] = wall
    out["wall_s_arms"] = {
      arm: float(sum(r["wall_s"] or 0.0 for r in rows if r["arm"] == arm)) for arm in out["arms"]
    }
    out["wall_share"] = {k: v / wall for k, v in shares.items()}
    return out


def invalid(valid: np.ndarray, repeat: int) -> tuple[float | None, list | None]:
  """Share of the decisions whose residuals are not known, the first 15 apart, and its interval over
  streams; None for shorter runs. valid: bool (control steps, groups).
  """
  known = valid[15 * repeat :][repeat - 1 :: repeat]
  each = 1.0 - known.mean(0) if len(known) else []
  return (float(np.mean(each)), intervals.interval(each, np.mean)) if len(each) else (None, None)  # type: ignore[arg-type]


def set_apart(rows: list[dict], events: list[dict]) -> list[dict]:
  """Rows with `adapting_at_onset`: whether the stream's finetuning was under way when the change
  came. Such a stream is a false alarm (or one that was told to adapt) and is kept apart from
  latency: what its detector says then starts nothing, so it has no `alarm_step`, `latency_steps`
  and `latency_s`, and counts neither as a detection nor as a miss.
  """
  out = []
  for r in rows:
    last = None
    if r["onset"] is not None:
      own = [
        e["kind"]
        for e in events
        if e["stream"] == r["stream"]
        and e["step"] < r["onset"]
        and e["kind"] in ("start", "stop", "abort")
      ]
      last = own[-1] if own else None
    under_way = last == "start"
    out.append(
      r
      | {"adapting_at_onset": under_way}
      | (dict.fromkeys(("alarm_step", "latency_steps", "latency_s")) if under_way else {})
    )
  return out


def rescore(folder: pathlib.Path | str) -> dict:
  """Writes runs.parquet and summary.json of a finished run anew by today's definitions, as far as
  they follow from its rows and events: `adapting_at_onset` and what is kept apart by it, and every
  aggregate of the rows. Returns summary.json's value. For results of an earlier version; what a run
  writes needs it not.

  Raises:
    FileError where the folder is not a finished run's.
  """
  folder = pathlib.Path(folder)
  config, summary = (
    tables.read_json(folder / "config.json"),
    tables.read_json(folder / "summary.json"),
  )
  rows = set_apart(
    tables.read_rows(folder / "runs.parquet"), tables.read_rows(folder / "events.parquet")
  )
  try:
    own = {f.name for f in dataclasses.fields(RunConfig)}
    adapt = AdaptConfig(
      **{
        k: v
        for k, v in config["adapt"].items()
        if k in {f.name for f in dataclasses.fields(AdaptConfig)}
      }
    )
    run = RunConfig(
      **{  # type: ignore[arg-type]
        k: tuple(v) if k == "arms" else v
        for k, v in config.items()
        if k in own and k not in ("adapt", "physics")
      },
      adapt=adapt,
    )  # physics: as resolved there
    summary |= by_arm(rows, run, config["control_s"])
  except (KeyError, TypeError) as e:
    raise FileError(f"{folder} is not a finished run's: {type(e).__name__}: {e}") from None
  tables.write_table(folder / "runs.parquet", {k: [r[k] for r in rows] for k in rows[0]})
  tables.write_json(folder / "summary.json", summary)
  return summary


def by_arm(rows: list[dict], config: RunConfig, control_s: float) -> dict:
  """What summary.json says from the rows of runs.parquet alone: `arms`, `later_changes` where there
  are any, and arm `detector` once more at the top.
  """
  of = lambda change: {
    arm: summarise(own, config, control_s)
    for arm in config.arms
    if (own := [r for r in rows if r["arm"] == arm and r["change"] == change])
  }
  out: dict = {"arms": of(0)}
  later = range(1, 1 + max(r["change"] for r in rows))
  if later:
    out["later_changes"] = [of(change) for change in later]
  return out | out["arms"].get("detector", {})


def summarise(rows: list[dict], config: RunConfig, control_s: float) -> dict:
  """Aggregates of one arm. Recovery counts affected streams alone; times are censored medians;
  means are IQM with bootstrap intervals.
  """
  affected, met = (
    [r for r in rows if r["affected"]],
    [r for r in rows if r["onset"] is not None and not r.get("adapting_at_onset")],
  )
  latency = [np.inf if r["latency_steps"] is None else r["latency_steps"] for r in met]
  back = [
    np.inf if r["recovery_step"] is None else r["recovery_step"] - r["onset"] for r in affected
  ]
  out: dict = {"seeds": len(rows)}

  def put(name: str, value: float | None, ci: list[float] | None) -> None:
    out[name], out[name + "_ci"] = value, ci

  def count(name: str, hits: int, n: int) -> None:
    p = intervals.wilson(hits, n)
    put(name, hits, None if p is None else [p[0] * n, p[1] * n])

  count("affected", len(affected), sum(r["affected"] is not None for r in rows))
  count("adapting_at_onset", sum(bool(r.get("adapting_at_onset")) for r in rows), len(rows))
  count("alarms", sum(np.isfinite(x) for x in latency), len(met))
  count("false_alarm_streams", sum(bool(r["false_alarms"]) for r in rows), len(rows))
  hours = (
    sum(
      config.steps if r["onset"] is None else min(r["onset"], config.steps)
      for r in rows
      if not r["change"]
    )
    * control_s
    / 3600
  )
  false = sum(r["false_alarms"] or 0 for r in rows)
  put(
    "false_alarms_per_hour",
    false / hours if hours else None,
    [x / hours for x in intervals.poisson(false)] if hours else None,
  )
  median = lambda x: intervals.finite(intervals.censored_median(x)) if len(x) else None  # type: ignore[arg-type]
  put(
    "latency_median_steps",
    median(latency),
    intervals.interval(latency, intervals.censored_median) if latency else None,  # type: ignore[arg-type]
  )
  put(
    "miss_probability",
    float(np.mean(~np.isfinite(latency))) if met else None,
    intervals.wilson(int(np.sum(~np.isfinite(latency))), len(latency)),
  )
  hit = [
    r["latency_steps"] is not None and r["latency_steps"] <= 500
    for r in affected
    if not r.get("adapting_at_onset")
  ]
  count("affected_watched", len(hit), len(affected))
  count("affected_alarmed_within_500", sum(hit), len(hit))
  for outcome in dict.fromkeys((*OUTCOMES.values(), "adapting")):
    hits = sum(r["outcome"] == outcome for r in rows)
    if hits or outcome != "failed":  # numeric failures are named where there are any
      count(outcome, hits, len(rows))
  count("recovered", sum(np.isfinite(x) for x in back), len(affected))
  count("recovered_within_10000", sum(x <= 10_000 for x in back), len(affected))
  put(
    "recovery_median_steps",
    median(back),
    intervals.interval(back, intervals.censored_median) if len(back) > 1 else None,  # type: ignore[arg-type]
  )
  for name in ("reward_pre", "reward_drop", "reward_final", "return_lost"):
    values = [r[name] for r in rows if r[name] is not None]
    put(
      name,
      float(intervals.iqm(values)) if values else None,  # type: ignore[arg-type]
      intervals.interval(values) if values else None,  # type: ignore[arg-type]
    )
  for name in (
    "return_lost_healthy",
    "adapted_steps",
    "updates",
    "terminations",
  ):  # a ledger: what is rare must count
    values = [r[name] for r in rows if r[name] is not None]
    put(
      f"{name}_mean",
      float(np.mean(values)) if values else None,
      intervals.interval(values, np.mean) if values else None,  # type: ignore[arg-type]
    )
  values = [r["reward_final"] for r in affected]
  put(
    "reward_final_affected",
    float(intervals.iqm(values)) if values else None,  # type: ignore[arg-type]
    intervals.interval(values) if values else None,  # type: ignore[arg-type]
  )
  return out
