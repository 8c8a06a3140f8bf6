"""What a run writes down: from the trace of all streams to the tables of the contract, the events,
and a row per stream and change.

NumPy on the host; nothing here moves a robot. Definitions: scoring/recovery.py, scoring/alarms.py.
Streams are numbered arm by arm, seed by seed.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from mjx_cl.adapt import decide as phase_lib
from mjx_cl.adapt.arms import ARMS, FOREVER, NEVER
from mjx_cl.adapt.phases import PHASES
from mjx_cl.config import RunConfig
from mjx_cl.faults.presets import Change
from mjx_cl.rollout.monitor import watched
from mjx_cl.scoring import alarms, recovery
from mjx_cl.types import Spec

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


def flat(x: np.ndarray) -> np.ndarray:
  """A column of a table, stream by stream, of an array (steps, groups)."""
  return np.ascontiguousarray(x.T).reshape(-1)


class Event(NamedTuple):
  """What happens to a stream, a row of events.parquet.

  Attributes:
    step: control step.
    kind: onset, alarm, start, stop, abort, rollback or repair.
    reason: a sentence for the reader.
    cause: what it was due to, in a word that programs read.
    decision: of the phase, see decide.DECISIONS.
    since: control step that the adaptation counts from.
  """

  step: int
  kind: str
  reason: str
  cause: str | None = None
  decision: str | None = None
  since: int | None = None


class Life(NamedTuple):
  """What the rows of a stream are measured by.

  Attributes:
    changes: control step -> onset or repair, in order; the end of the run where there is none.
    pre: reward before the first change.
    begun: control step at which its first adaptation began, None where there is none.
  """

  changes: dict[int, str]
  pre: float | None
  begun: int | None


class Ledger(NamedTuple):
  """What must be known of a run besides its trace, a dict of arrays, (steps, groups) or (chunks,
  groups), as run.Runner keeps it.

  Attributes:
    config: of the run.
    spec: of the robot.
    repeat: control steps of a decision.
    chunk_steps: control steps of a chunk.
    changes: the faults.
    becomes: name of the robot that it turns into, or None.
    labels: (arm, seed) of each stream.
    breaks: bool (groups,), whether the stream's robot breaks.
    names: its fault and target, "none" where it is spared.
    onsets: control step of its first change, None where there is none in this run, see
      run.Runner.onsets.
    updates: int (groups,), taken by the end.
    stream_seconds: float (groups,), share of the wall time.
  """

  config: RunConfig
  spec: Spec
  repeat: int
  chunk_steps: int
  changes: tuple[Change, ...]
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
    table = self._streams(steps) | {
      "fault": np.repeat(np.asarray(self.names), steps),
      "step": np.tile(np.arange(steps, dtype=np.int32), groups),
      "episode": flat(trace["episode"]),
      "phase": np.asarray(PHASES)[flat(trace["phase"])],
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
    # once per chunk, in the row at which it is known
    at = np.minimum((np.arange(len(trace["signals"])) + 1) * self.chunk_steps, steps) - 1
    for index, name in enumerate(("dyn_loss", "adv_mag", "value_loss"), 3):
      values = np.full((steps, groups), np.nan, np.float32)
      values[at] = trace["signals"][:, :, index]
      table[name] = flat(values)
    return table | {"updates": flat(trace["updates"])}

  def signals(self, trace: dict[str, np.ndarray]) -> dict:
    """Per chunk what the stop rule read: the six signals, posture and the levels asked for."""
    chunks, groups = trace["decision"].shape
    steps = (np.arange(chunks, dtype=np.int32) + 1) * self.chunk_steps
    least = (self.spec.posture or (0, np.nan))[1]
    return self._streams(chunks) | {
      "step": np.tile(np.minimum(steps, self.config.steps) - 1, groups).astype(np.int32),
      **{name: flat(trace["signals"][:, :, i]) for i, name in enumerate(phase_lib.SIGNALS)},
      "posture": flat(trace["posture"]),
      "acceptance": flat(trace["acceptance"]),
      "least_posture": np.full(chunks * groups, least, np.float32),
    }

  def _streams(self, length: int) -> dict:
    """The columns stream, arm and seed of a table with `length` rows a stream."""
    arms, seeds = zip(*self.labels)
    values = (np.arange(len(arms), dtype=np.int32), np.asarray(arms), np.asarray(seeds, np.int32))
    return {k: np.repeat(v, length) for k, v in zip(("stream", "arm", "seed"), values)}

  def events(self, trace: dict[str, np.ndarray]) -> list[dict]:
    """Every onset, alarm, start, stop, abort, rollback and repair, with its reason."""
    events = [
      {
        "stream": g,
        "arm": arm,
        "seed": seed,
        "step": e.step,
        "kind": e.kind,
        "cause": e.cause,
        "decision": e.decision,
        "since": e.since,
        "chunk": e.step // self.chunk_steps,
        "reason": e.reason,
        "fault": self.names[g],
      }
      for g, (arm, seed) in enumerate(self.labels)
      for e in (*self._changes(g), *self._alarms(g, trace), *self._decisions(g, trace))
    ]
    return sorted(events, key=lambda e: (e["stream"], e["step"]))

  def _changes(self, g: int) -> Iterator[Event]:
    """Onsets and repairs of stream `g`."""
    onset, end = self.onsets[g], self.config.steps
    if self.becomes is not None and onset is not None and onset < end:
      cause = f"becomes {self.becomes}"
      yield Event(onset, "onset", f"{cause}, severity 1", cause)
    for change in self.changes:
      begin = self.config.onset + change.after
      if not (self.breaks[g] and acts(change) and begin < end):
        continue
      several = f"{change.fault}, " if len(self.changes) > 1 or self.becomes is not None else ""
      how = "" if change.schedule == "abrupt" else f", {change.schedule}"
      yield Event(begin, "onset", f"{several}severity {change.severity:g}{how}", change.fault)
      if change.duration and begin + change.duration < end:
        said = f"{several}after {change.duration} steps"
        yield Event(begin + change.duration, "repair", said, change.fault)

  def _alarms(self, g: int, trace: dict[str, np.ndarray]) -> Iterator[Event]:
    """Alarms of stream `g`, and why those that start nothing do not."""
    onset, trigger = self.onsets[g], ARMS[self.labels[g][0]].trigger
    healthy = "on a healthy robot" if onset is None else "before onset"
    decisions = trace["decision"][:, g]
    started = set(trace["since"][decisions == phase_lib.START, g].tolist())
    for step in np.flatnonzero(trace["alarm"][:, g]).tolist():
      early = step < (self.config.steps if onset is None else onset)
      false = f", {healthy}: a false alarm" if early else ""
      if trigger.listens and step in started:
        yield Event(step, "alarm", f"acted on{false}", "acted on")
        continue
      if not trigger.listens:
        why = "arm does not adapt" if trigger is NEVER else "arm does not listen"
      elif step < self.config.adapt.warmup:
        why = "warm-up"
      elif decisions[step // self.chunk_steps] == phase_lib.START:
        why = "an alarm before it was"  # the phase changes at the end of the chunk
      else:
        why = f"phase {PHASES[trace['phase'][step, g]]}"
      yield Event(step, "alarm", f"logged, not acted on: {why}{false}", why)

  def _decisions(self, g: int, trace: dict[str, np.ndarray]) -> Iterator[Event]:
    """Starts, stops, aborts and rollbacks of stream `g`."""
    why = ARMS[self.labels[g][0]].trigger.why
    kinds = {phase_lib.START: "start", phase_lib.STOP: "stop", phase_lib.END: "stop"}
    for i in np.flatnonzero(trace["decision"][:, g]).tolist():
      end = min((i + 1) * self.chunk_steps, self.config.steps) - 1
      decision, since = int(trace["decision"][i, g]), int(trace["since"][i, g])
      starts, kind = decision == phase_lib.START, kinds.get(decision, "abort")
      reason = f"{why} at step {since}" if starts else phase_lib.REASONS[decision]
      cause = why if starts else None
      yield Event(end, kind, reason, cause, phase_lib.DECISIONS[decision], since)
      if "back" in trace and trace["back"][i, g]:
        said = (
          f"the weights of before earned {trace['earned'][i, g]:.3f} a step, those of now "
          f"{trace['earns'][i, g]:.3f}"
        )
        yield Event(end, "rollback", said, since=since)

  def rows(self, trace: dict[str, np.ndarray], events: list[dict]) -> list[dict]:
    """One row per stream and change, in order: the first change's row holds the stream from its
    start up to the next change, see `later`.
    """
    steps, lives, drops = self.config.steps, [], {}
    for g, (onset, (arm, seed)) in enumerate(zip(self.onsets, self.labels)):
      changes = {steps: "onset"} if onset is None else self.later(onset)
      first, end = (*changes, steps)[:2]
      reward = trace["reward"][:end, g].astype(float)
      starts = trace["since"][trace["decision"][:, g] == phase_lib.START, g].tolist()
      begun = starts[0] if starts else None
      pre = recovery.reward_pre(reward, first, self.config.adapt.warmup, begun)
      lives.append(Life(changes, pre, begun))
      if arm == "none":
        drops[seed] = recovery.reward_drop(reward, first, pre) if first < steps else None
    rows = []
    for g, (life, (arm, seed)) in enumerate(zip(lives, self.labels)):
      # no alarm ends the window of an arm that does not listen: the same life goes on in arm `none`
      if not ARMS[arm].trigger.listens and not ARMS[arm].agent and ("none", seed) in self.labels:
        life = life._replace(pre=lives[self.labels.index(("none", seed))].pre)
      own = [e for e in events if e["stream"] == g]
      for change in range(len(life.changes)):
        rows.append(self._row(trace, own, g, change, life, drops.get(seed)))
    return set_apart(rows, events)

  def _row(
    self, trace: dict, events: list[dict], g: int, change: int, life: Life, lost: float | None
  ) -> dict:
    """The row of stream `g` and its change number `change`.

    Args:
      trace: of the run.
      events: of the stream.
      g: its number.
      change: number of the change, 0 for the first.
      life: of the stream.
      lost: share of the reward that the first change cost a stream without adaptation.
    """
    onset, end = (*life.changes, self.config.steps)[change : change + 2]
    begin, never = onset if change else 0, self.onsets[g] is None
    (arm, seed), reward = self.labels[g], trace["reward"][:end, g].astype(float)
    before = life.pre
    if change:
      # no arm without adaptation lives on as this one does: its own first steps after the change
      # say what that cost
      before = float(np.mean(reward[max(0, onset - recovery.FINAL) : onset]))
      lost = recovery.reward_drop(reward, onset, before)
    elif never:
      lost = None
    own = [e for e in events if begin <= e["step"] < max(end, 1)]
    adapting = trace["phase"][begin:end, g] == phase_lib.ADAPTING
    healthy = None if change else recovery.return_lost_healthy(reward, onset, before, life.begun)
    score = alarms.score(trace["alarm"][begin:end, g], onset - begin)
    latency, affected = score.latency_steps, None if lost is None else bool(lost >= 0.1)
    # what came before the change says nothing of how it ended
    last = recovery.FINAL if never else min(recovery.FINAL, max(1, end - onset))
    fallen = trace["terminated"][:end, g]
    updates = self.updates[g] if end == self.config.steps else trace["updates"][end, g]
    return {
      "stream": g,
      "arm": arm,
      "seed": seed,
      "fault": self.names[g],
      "change": change,
      "kind": life.changes[onset],
      "onset": None if never else onset,
      "alarm_step": None if score.alarm_step is None else score.alarm_step + begin,
      "latency_steps": latency,
      "latency_s": None if latency is None else latency * self.spec.control_s,
      "false_alarms": None if change else score.false_alarms,
      **came_to(own, bool(change) and adapting[0]),
      "affected": affected,
      "recovery_step": recovery.recovery_step(reward, onset, before) if affected else None,
      "stable_step": None if never else recovery.stable_step(reward, fallen, onset, before),
      "reward_pre": before,
      "reward_drop": lost,
      "reward_final": float(np.mean(reward[-last:])),
      "return_lost": None if never else recovery.return_lost(reward, onset, before),
      "return_lost_healthy": healthy,
      "terminations": int(fallen[begin:].sum()),
      "adapted_steps": int(np.sum(adapting)),
      "updates": int(updates - (trace["updates"][begin, g] if change else 0)),
      "wall_s": None if change else float(self.stream_seconds[g]),
    }


def came_to(events: list[dict], under_way: bool) -> dict:
  """What a stream's adaptations came to.

  Args:
    events: of the stream, in order.
    under_way: whether it adapted when they began.
  """
  starts = [e["step"] for e in events if e["kind"] == "start"]
  ends = [e for e in events if e["kind"] in ("stop", "abort")]
  last: dict = ends[-1] if ends else {"step": None, "reason": None}
  outcome = "adapting" if starts or under_way else "nominal"
  if ends and (not starts or last["step"] > starts[-1]):
    outcome = OUTCOMES[last["decision"]]
  return {
    "adapt_start": starts[0] if starts else None,
    "adapt_stop": last["step"],
    "outcome": outcome,
    "reason": last["reason"],
  }


def begun(event: dict) -> int:
  """The control step from which an event counts: of a start that of what started it, which the
  chunk's end, `step`, follows.
  """
  since = event.get("since") if event["kind"] == "start" else None
  return event["step"] if since is None else since


def set_apart(rows: list[dict], events: list[dict]) -> list[dict]:
  """Rows with `adapting_at_onset`: whether the stream's finetuning was under way when the change
  came. Such a stream is a false alarm (or one that was told to adapt) and is kept apart from
  latency: what its detector says then starts nothing, so it has no `alarm_step`, `latency_steps`
  and `latency_s`, and counts neither as a detection nor as a miss.
  """
  out = []
  for r in rows:
    kinds = [
      e["kind"]
      for e in events
      if r["onset"] is not None
      and e["stream"] == r["stream"]
      and e["kind"] in ("start", "stop", "abort")
      and begun(e) < r["onset"]
    ]
    under_way = kinds[-1:] == ["start"]
    unknown = dict.fromkeys(("alarm_step", "latency_steps", "latency_s") if under_way else ())
    out.append(r | {"adapting_at_onset": under_way} | unknown)
  return out
