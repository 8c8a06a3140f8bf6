"""Is the stop rule right? Stops and aborts against the best stop that the same seed could have had.

The best stop is known afterwards, from snapshots of an arm that never stops (snapshots.py). With
five episodes a snapshot its own reward is noise, and the best of twenty is the luckiest of them
too: what a stop loses against it is an upper bound, for the perfect stop as well.
"""

import os
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet
from numpy.typing import ArrayLike

from mjx_cl import BENCHMARK
from mjx_cl.adapt.arms import ARMS, stops
from mjx_cl.config import RunConfig
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import folders, tables
from mjx_cl.scoring import events, intervals, normalised_recovery

SHARE = 0.95  # of the best snapshot's reward, from which a stop is good enough
HORIZON = 10_000  # control steps that the robot lives on with the weights of its stop
COLUMNS = (
  "stream",
  "arm",
  "seed",
  "since",
  "stop",
  "outcome",
  "reason",
  "oracle_stop_steps",
  "own_stop_steps",
  "steps_after_oracle",
  "early",
  "reward_best",
  "reward_oracle",
  "reward_stop",
  "return_lost",
  "return_lost_early",
  "lost_share",
  "updates_wasted",
  "aborted",
  "unrecoverable",
)


def oracle(age: Sequence[int] | np.ndarray, reward: ArrayLike, share: float = SHARE) -> int:
  """Index of the earliest snapshot whose reward reaches `share` of the best one's: reward >= best -
  (1 - share) |best|.

  Args:
    age: (n,) control steps since adaptation started, rising.
    reward: (n,) mean reward per control step.
    share: of the best one's.
  """
  reward = np.asarray(reward, float)
  if not (np.diff(age) > 0).all():
    raise ValueError(f"ages must rise; got {list(age)}")
  best = reward.max()
  return int(np.flatnonzero(reward >= best - (1 - share) * abs(best))[0])


def at(age: ArrayLike, reward: np.ndarray, stop: int) -> float:
  """Reward of the weights with which adaptation ended after `stop` control steps: of the last
  snapshot up to then.
  """
  return float(reward[max(0, int(np.searchsorted(age, stop, "right")) - 1)])


def curves(snapshots: list[dict]) -> dict[tuple[int, int], list[dict]]:
  """(stream, control step that its adaptation started after) -> its snapshots by their age."""
  out: dict[tuple[int, int], list[dict]] = {}
  for s in sorted(snapshots, key=lambda s: s["since_start"]):
    out.setdefault((s["stream"], s["step"] + 1 - s["since_start"]), []).append(s)
  return out


def spans(happened: list[dict]) -> list[dict]:
  """Adaptations in events.parquet (rows in order): {stream, arm, seed, since (the control step of
  what started it), stop, outcome, reason}.

  outcome: converged, aborted, ended, or adapting, whose stop and reason are None.
  """
  out = []
  for e in happened:
    if e["kind"] == "start":
      unknown = {"stop": None, "outcome": "adapting", "reason": None}
      out.append({k: e[k] for k in ("stream", "arm", "seed", "since")} | unknown)
    # a numeric failure aborts a stream that adapts or not
    elif e["kind"] in ("stop", "abort") and out and _open(out[-1], e["stream"]):
      stopped = "converged" if ARMS[e["arm"]].end.rule else "ended"
      outcome = stopped if e["kind"] == "stop" else "aborted"
      out[-1] |= {"stop": e["step"], "outcome": outcome, "reason": e["reason"]}
  return out


def _open(span: dict, stream: int) -> bool:
  return span["stream"] == stream and span["stop"] is None


def unrecoverable(runs: list[dict]) -> dict[int, bool | None]:
  """Seed -> no arm of the run reached half of normalised recovery; None where it is undefined, as
  of a robot that lost little.
  """
  best: dict[int, list] = {}
  for r in normalised_recovery.rows(runs):
    best.setdefault(r["seed"], []).append(r["normalised"])
  return {
    seed: None if None in own else max(own) < normalised_recovery.HALF for seed, own in best.items()
  }


def rows(
  snapshots: list[dict], happened: list[dict], runs: list[dict], updates: np.ndarray
) -> list[dict]:
  """Every adaptation that the stop rule may end, against the snapshots of the same seed.

    oracle_stop_steps, own_stop_steps: control steps from the start of its adaptation to the oracle
    stop, and to its own stop or abort
    return_lost = (reward_best - reward_stop) HORIZON, of the snapshot as old as the own stop;
    return_lost_early: where that came before the oracle stop, else 0; lost_share = (reward_best -
    reward_stop) / |reward_best| updates_wasted: updates between the oracle stop and a later own one

  An arm that starts later than the one that never stops, as the detector's, is measured from its
  own start: the first from that of the snapshots on and before the next. Where there is none, or
  where it does not end, what rests on it is None.

  Args:
    snapshots: rows of snapshots.parquet.
    happened: rows of events.parquet.
    runs: rows of runs.parquet.
    updates: int (streams, steps), the column of trace.parquet.

  Returns:
    rows with COLUMNS, sorted by stream.
  """
  label, lived, known = unrecoverable(runs), spans(happened), curves(snapshots)
  total: dict[int, int] = {}
  for r in runs:
    total[r["stream"]] = total.get(r["stream"], 0) + r["updates"]
  streams = sorted({(r["stream"], r["arm"], r["seed"]) for r in runs if stops(ARMS[r["arm"]])})
  out = []
  for (endless, begin), own in sorted(known.items()):
    begins = [b for g, b in known if g == endless]
    later = min([b for b in begins if b > begin], default=np.inf)
    for g, arm, seed in streams:
      if seed != own[0]["seed"]:
        continue
      span = next((s for s in lived if s["stream"] == g and begin <= s["since"] < later), {})
      done = lambda step, g=g: int(updates[g][step + 1] if step + 1 < len(updates[g]) else total[g])
      out.append(
        dict.fromkeys(COLUMNS)
        | span
        | {"stream": g, "arm": arm, "seed": seed}
        | against(own, span.get("since"), span.get("stop"), done)
        | {
          "aborted": span["outcome"] == "aborted" if span else None,
          # what comes later has no arm `none` to be normalised by
          "unrecoverable": label.get(seed) if begin == min(begins) else None,
        }
      )
  return sorted(out, key=lambda r: (r["stream"], -1 if r["since"] is None else r["since"]))


def against(
  curve: list[dict],
  since: int | None,
  stop: int | None,
  done: Callable[[int], int] = lambda step: 0,
) -> dict:
  """The stop of one adaptation against its snapshots.

  Args:
    curve: the snapshots by their age.
    since: control step of what started it.
    stop: control step of its end; None: it never ended.
    done: control step -> updates taken by then.
  """
  age, reward = (np.array([s[k] for s in curve]) for k in ("since_start", "reward_mean"))
  first, best = oracle(age, reward), float(reward.max())
  out = {
    "oracle_stop_steps": int(age[first]),
    "reward_best": best,
    "reward_oracle": float(reward[first]),
  }
  if stop is None or since is None:
    return out
  own = stop + 1 - since
  after, left = own - int(age[first]), at(age, reward, own)
  return out | {
    "own_stop_steps": own,
    "steps_after_oracle": after,
    "early": after < 0,
    "reward_stop": left,
    "return_lost": (best - left) * HORIZON,
    "return_lost_early": (best - left) * HORIZON if after < 0 else 0.0,
    "lost_share": (best - left) / abs(best) if best else None,
    "updates_wasted": done(stop) - done(since + int(age[first]) - 1) if after > 0 else 0,
  }


def summarise(judged: list[dict]) -> dict:
  """Aggregates of `rows`, as summary.json's `stop_rule`: per arm counts with Wilson's interval, IQM
  and means with bootstrap intervals.

  steps_after_oracle_median: an adaptation that has begun and never ended counts as later than all
  others; None: half of them are such. aborted_unrecoverable: aborts that were right;
  aborted_recoverable: some arm got halfway; ended_unrecoverable: counted as converged, and none
  did.
  """
  arms = {}
  for arm in dict.fromkeys(r["arm"] for r in judged):
    own = [r for r in judged if r["arm"] == arm]
    begun = [r for r in own if r["since"] is not None]
    ended = [r for r in own if r["stop"] is not None]
    after = [np.inf if r["stop"] is None else r["steps_after_oracle"] for r in begun]
    told = [r for r in ended if r["unrecoverable"] is not None]
    hits = lambda aborted, lost, told=told: sum(
      r["aborted"] == aborted and r["unrecoverable"] == lost for r in told
    )
    arms[arm] = {
      "adaptations": len(begun),
      "never_begun": len(own) - len(begun),
      "ended": len(ended),
      **_count("early", sum(r["early"] for r in ended), len(ended)),
      **spread("steps_after_oracle_median", after, intervals.censored_median),
    }
    for name in ("return_lost", "return_lost_early", "lost_share"):
      arms[arm] |= spread(name, [r[name] for r in ended if r[name] is not None])
    arms[arm] |= spread("updates_wasted_mean", [r["updates_wasted"] for r in ended], np.mean)
    arms[arm] |= _count("aborted_unrecoverable", hits(True, True), len(told))
    arms[arm] |= _count("aborted_recoverable", hits(True, False), len(told))
    arms[arm] |= _count("ended_unrecoverable", hits(False, True), len(told))
  return {"share": SHARE, "horizon_steps": HORIZON, "arms": arms}


def _count(name: str, hits: int, n: int) -> dict:
  """Hits among n, and Wilson's interval of their number."""
  share = intervals.wilson(hits, n)
  return {name: hits, f"{name}_ci": share and [x * n for x in share]}


def spread(name: str, values: list, statistic: Callable[..., Any] = intervals.iqm) -> dict:
  """A statistic of values, and its bootstrap interval; None where there are none."""
  return {
    name: intervals.finite(statistic(values)) if values else None,
    f"{name}_ci": intervals.interval(values, statistic) if values else None,
  }


def of_folder(folder: str | os.PathLike) -> list[dict]:
  """`rows` of a finished run with snapshots."""
  snapshots, runs = read(folder, "snapshots"), read(folder, "runs")
  columns = _table(folder, "trace", ["stream", "updates"])
  stream, updates = (columns[k].to_numpy() for k in ("stream", "updates"))
  happened = events.read(pathlib.Path(folder) / "events.parquet").to_pylist()
  return rows(snapshots, happened, runs, updates.reshape(len(np.unique(stream)), -1))


SAME = (
  "env",
  "fault",
  "target",
  "severity",
  "onset",
  "duration",
  "schedule",
  "period",
  "share",
  "agent",
  "deterministic",
)
LEARNS = (
  "ratio",
  "average",
  "start_windows",
  "lr",
  "policy_lr",
  "model_lr",
  "last_starts",
  "batch",
  "fresh_moments",
  "anchor",
)  # of AdaptConfig: what its weights depend on


def told(config: RunConfig) -> dict[int, int]:
  """Seed -> control steps from the true onset to the oracle stop, for the arms of a run that end
  there; {} where none does.

  The run in `config.stops` lived the same lives with weights that never stopped, and its snapshots
  say which were the first that were good enough (`oracle`). A stop at 0, where the weights of
  before were already, is one of a single step: a robot that adapts does so for a chunk at least.

  Args:
    config: RunConfig.

  Raises:
    FileError for a folder that holds no such run; UserError for one of another robot, fault, agent
    or way to learn, or without a seed of this run.
  """
  if not any(ARMS[arm].end.told for arm in config.arms):
    return {}
  folder = pathlib.Path(config.stops)  # type: ignore[arg-type]
  try:
    theirs = tables.read_json(folder / "config.json")
  except FileError as e:
    raise FileError(f"stops: {folder} holds no run: {e}") from None
  if not isinstance(adapt := theirs.get("adapt"), dict):
    raise FileError(f"stops: {folder} holds no run: its config.json has no settings of adaptation")
  ours = {k: getattr(config, k) for k in SAME if k in theirs}
  ours["adapt"] = {k: getattr(config.adapt, k) for k in LEARNS if k in adapt}
  ours["benchmark"] = BENCHMARK
  differ = folders.differing(theirs, ours, defaults={"benchmark": 1}, deep=True)
  if differ:
    raise UserError(
      f"stops: {folder} was run with another {', '.join(differ)}; its oracle stops are not "
      "those of this run"
    )
  if not (folder / "snapshots.parquet").exists():
    raise FileError(
      f"stops: {folder} has no snapshots.parquet; run arm oracle-budget with --snapshots 1000 there"
    )
  points: dict[int, list] = {}
  endless = [s for s in read(folder, "snapshots") if s.get("arm") == "oracle-budget"]
  for s in endless:
    points.setdefault(s["seed"], []).append((s["since_start"], s["reward_mean"]))
  out = {}
  for seed, own in points.items():
    age, reward = zip(*sorted(own))
    out[seed] = max(1, int(age[oracle(age, reward)]))
  seeds = range(config.first_seed, config.first_seed + config.seeds)
  missing = [s for s in seeds if s not in out]
  if missing:
    raise UserError(
      f"stops: {folder} has no snapshots of seed {', '.join(map(str, missing))}; it has "
      f"{', '.join(map(str, sorted(out)))}"
    )
  return {seed: out[seed] for seed in seeds}


def _table(folder: str | os.PathLike, name: str, columns: list[str] | None = None) -> pyarrow.Table:
  try:
    return pyarrow.parquet.read_table(pathlib.Path(folder) / f"{name}.parquet", columns=columns)
  except (OSError, pyarrow.ArrowException) as e:
    raise FileError(f"cannot read {name}.parquet of {folder}: {str(e).splitlines()[0]}") from None


def read(folder: str | os.PathLike, name: str) -> list[dict]:
  """Rows of a run's table. FileError where it cannot be read."""
  return _table(folder, name).to_pylist()
