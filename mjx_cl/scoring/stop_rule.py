"""Is the stop rule right? Stops and aborts against the best stop that the same seed could have had,
and the rule with each signal left out.

The best stop is known afterwards, from snapshots of an arm that never stops (snapshots.py). With
five episodes a snapshot its own reward is noise, and the best of twenty is the luckiest of them
too: what a stop loses against it is an upper bound, for the perfect stop as well.
"""

from __future__ import annotations

import json
import pathlib
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow
import pyarrow.parquet

from mjx_cl.adapt import decide
from mjx_cl.adapt.arms import ARMS, never_stops, stops
from mjx_cl.adapt.decide import REASONS, SIGNALS, START, STOP
from mjx_cl.config import AdaptConfig
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import folders, tables
from mjx_cl.scoring import events, intervals, normalised_recovery

if TYPE_CHECKING:
  import os
  from collections.abc import Callable, Sequence

  from numpy.typing import ArrayLike

  from mjx_cl.config import RunConfig

SHARE = 0.95  # of the best snapshot's reward, from which a stop is good enough
HORIZON = 10_000  # control steps that the robot lives on with the weights of its stop
RULE = (
  "patience",
  "trend",
  "fluctuation",
  "excess",
  "near",
  "least",
  "give_up",
)  # settings of AdaptConfig that ablation may change
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
    age: (n,) control steps since adaptation started, rising. reward: (n,) mean reward per control
      step.
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


def spans(happened: list[dict]) -> list[dict]:
  """Adaptations in events.parquet (rows in order): {stream, arm, seed, since (the control step of
  what started it), stop, outcome, reason}.

  outcome: converged, aborted, ended, or adapting, whose stop and reason are None.
  """
  out = []
  for e in happened:
    if e["kind"] == "start":
      out.append(
        {k: e[k] for k in ("stream", "arm", "seed")}
        | {
          "since": e["since"],
          "stop": None,
          "outcome": "adapting",
          "reason": None,
        }
      )
    elif e["kind"] in ("stop", "abort"):
      rule = ARMS[e["arm"]].end.rule
      out[-1] |= {
        "stop": e["step"],
        "outcome": ("converged" if rule else "ended") if e["kind"] == "stop" else "aborted",
        "reason": e["reason"],
      }
  return out


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
    snapshots, happened, runs: rows of snapshots.parquet, events.parquet and runs.parquet. updates:
      int (streams, steps), the column of trace.parquet.

  Returns:
    rows with COLUMNS, sorted by stream.
  """
  label, lived = unrecoverable(runs), spans(happened)
  curves: dict[tuple, list] = {}
  for s in snapshots:
    curves.setdefault((s["stream"], s["step"] + 1 - s["since_start"]), []).append(s)
  total: dict[int, int] = {}
  for r in runs:
    total[r["stream"]] = total.get(r["stream"], 0) + r["updates"]
  streams = sorted({(r["stream"], r["arm"], r["seed"]) for r in runs if stops(ARMS[r["arm"]])})
  out = []
  for (endless, begin), own in sorted(curves.items()):
    own = sorted(own, key=lambda s: s["since_start"])
    later = min([b for g, b in curves if g == endless and b > begin], default=np.inf)
    for g, arm, seed in streams:
      if seed == own[0]["seed"]:
        span = next((s for s in lived if s["stream"] == g and begin <= s["since"] < later), {})
        done = lambda step: int(updates[g][step + 1] if step + 1 < len(updates[g]) else total[g])
        row = (
          dict.fromkeys(COLUMNS)
          | {k: v for k, v in span.items() if k in COLUMNS}
          | {"stream": g, "arm": arm, "seed": seed}
        )
        row |= _against(own, row["since"], row["stop"], done)
        first = begin == min(
          b for h, b in curves if h == endless
        )  # what comes later has no arm `none` to be normalised by
        out.append(
          row
          | {
            "aborted": row["outcome"] == "aborted" if span else None,
            "unrecoverable": label.get(seed) if first else None,
          }
        )
  return sorted(out, key=lambda r: (r["stream"], -1 if r["since"] is None else r["since"]))


def _against(curve: list[dict], since: int, stop: int | None, done: Callable[[int], int]) -> dict:
  """The stop of one adaptation against the snapshots `curve`; done: control step -> updates taken
  by then.
  """
  age, reward = (
    np.array([s["since_start"] for s in curve]),
    np.array([s["reward_mean"] for s in curve]),
  )
  first, best = oracle(age, reward), float(reward.max())
  out = {
    "oracle_stop_steps": int(age[first]),
    "reward_best": best,
    "reward_oracle": float(reward[first]),
  }
  if stop is None:
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
    begun, ended = (
      [r for r in own if r["since"] is not None],
      [r for r in own if r["stop"] is not None],
    )
    out: dict = {
      "adaptations": len(begun),
      "never_begun": len(own) - len(begun),
      "ended": len(ended),
    }

    def count(name: str, hits: int, n: int) -> None:
      p = intervals.wilson(hits, n)
      out[name], out[name + "_ci"] = hits, None if p is None else [x * n for x in p]

    def put(name: str, values: list[float], statistic: Callable[..., Any]) -> None:
      out[name] = intervals.finite(statistic(values)) if values else None
      out[name + "_ci"] = intervals.interval(values, statistic) if values else None

    count("early", sum(r["early"] for r in ended), len(ended))
    after = [np.inf if r["stop"] is None else r["steps_after_oracle"] for r in begun]
    put("steps_after_oracle_median", after, intervals.censored_median)
    for name in ("return_lost", "return_lost_early", "lost_share"):
      put(name, [r[name] for r in ended if r[name] is not None], intervals.iqm)
    put("updates_wasted_mean", [r["updates_wasted"] for r in ended], np.mean)
    told = [r for r in ended if r["unrecoverable"] is not None]
    for name, aborted, lost in (
      ("aborted_unrecoverable", True, True),
      ("aborted_recoverable", True, False),
      ("ended_unrecoverable", False, True),
    ):
      count(
        name, sum(r["aborted"] == aborted and r["unrecoverable"] == lost for r in told), len(told)
      )
    arms[arm] = out
  return {"share": SHARE, "horizon_steps": HORIZON, "arms": arms}


def of_folder(folder: str | os.PathLike) -> list[dict]:
  """`rows` of a finished run with snapshots."""
  snapshots, runs = _read(folder, "snapshots"), _read(folder, "runs")
  columns = _table(folder, "trace", ["stream", "updates"])
  stream, updates = (columns[k].to_numpy() for k in ("stream", "updates"))
  happened = events.read(pathlib.Path(folder) / "events.parquet").to_pylist()
  return rows(snapshots, happened, runs, updates.reshape(len(np.unique(stream)), -1))


# ---- the rule with a signal left out -------------------------------------------------------------


def ablation(folder: str | os.PathLike, **rule: Any) -> list[dict]:
  """When the stop rule would have ended the first adaptation of each stream that never stops, had
  it not asked a signal to settle.

  The phase machine of a run (adapt.decide) lives once more over the recorded chunk signals. A
  reward that is left out need not settle, but must still be accepted. Until the stop this is the
  life of arm `oracle` in the same seed, as far as both were rounded alike (run.Runner).

  Args:
    rule: settings of AdaptConfig that the rule reads, in place of the run's: ablation(folder,
      least=1, patience=12) asks what it would have done without its floor of control steps. What
      the robot learnt meanwhile does not depend on them.

  Returns:
    rows {stream, arm, seed, left_out ("" or a signal), outcome, reason, stop (last control step,
    None: adapting to the end), own_stop_steps}, and where the run has snapshots what `rows` says of
      such a stop: oracle_stop_steps, steps_after_oracle, early, reward_stop, return_lost,
      lost_share.

  Raises:
    FileError where the folder holds no signals.parquet; UserError where no stream that never stops
    has adapted, or for a setting that is not the rule's.
  """
  if not set(rule) <= set(RULE):
    raise UserError(
      f"the stop rule has no {', '.join(sorted(set(rule) - set(RULE)))}; choose from: "
      f"{', '.join(RULE)}"
    )
  try:
    config = AdaptConfig(
      **json.loads((pathlib.Path(folder) / "config.json").read_text())["adapt"] | rule
    )
  except (OSError, ValueError, KeyError, TypeError) as e:
    raise FileError(f"{folder} holds no run: {e}") from None
  curves: dict[tuple[int, int], list[dict]]
  chunks, curves = _read(folder, "signals"), {}
  if (pathlib.Path(folder) / "snapshots.parquet").exists():
    for s in _read(folder, "snapshots"):
      curves.setdefault((s["stream"], s["step"] + 1 - s["since_start"]), []).append(s)
  first: dict[int, dict] = {}
  for span in spans(events.read(pathlib.Path(folder) / "events.parquet").to_pylist()):
    if never_stops(ARMS[span["arm"]]):
      first.setdefault(span["stream"], span)
  if not first:
    raise UserError(f"{folder}: no stream of an arm that never stops has adapted")
  own = {g: [c for c in chunks if c["stream"] == g] for g in first}
  decisions = _relive(own, {g: s["since"] for g, s in first.items()}, SIGNALS, config)
  out = []
  for g, span in first.items():
    for left_out, decision in zip(("", *SIGNALS), decisions[g]):
      ends = [c for c in np.flatnonzero(decision) if decision[c] != START]
      row = {k: span[k] for k in ("stream", "arm", "seed")} | {
        "left_out": left_out,
        "outcome": "adapting",
      }
      row |= dict.fromkeys(("reason", "stop", "own_stop_steps"))
      if ends:
        code = int(decision[ends[0]])
        row |= {
          "outcome": "converged" if code == STOP else "aborted",
          "reason": REASONS[code],
          "stop": own[g][ends[0]]["step"],
        }
        row["own_stop_steps"] = row["stop"] + 1 - span["since"]
      if (g, span["since"]) in curves:
        curve = sorted(curves[g, span["since"]], key=lambda s: s["since_start"])
        judged = dict.fromkeys(COLUMNS) | _against(
          curve, span["since"], row["stop"], lambda step: 0
        )
        row |= {
          k: judged[k]
          for k in (
            "oracle_stop_steps",
            "steps_after_oracle",
            "early",
            "reward_stop",
            "return_lost",
            "lost_share",
          )
        }
      out.append(row)
  return out


def ablated(rows: list[dict]) -> dict:
  """Aggregates of `ablation`: signal left out ("" none) -> {adaptations, converged, aborted,
  own_stop_steps_median, early, lost_share}.

  own_stop_steps_median: of all adaptations, one that never ends counts as later than all others.
  early, lost_share: of those that ended and have snapshots: stops before the oracle's, and IQM of
  the share of the best snapshot's reward that the stop gave up; each but the counts with _ci.
  """
  out = {}
  for name in dict.fromkeys(r["left_out"] for r in rows):
    own = [r for r in rows if r["left_out"] == name]
    steps = [np.inf if r["own_stop_steps"] is None else r["own_stop_steps"] for r in own]
    judged = [r for r in own if r["stop"] is not None and r.get("lost_share") is not None]
    lost = [r["lost_share"] for r in judged]
    out[name] = {
      "adaptations": len(own),
      "converged": sum(r["outcome"] == "converged" for r in own),
      "aborted": sum(r["outcome"] == "aborted" for r in own),
      "own_stop_steps_median": intervals.finite(intervals.censored_median(steps)),
      "own_stop_steps_median_ci": intervals.interval(steps, intervals.censored_median),
      "judged": len(judged),
      "early": sum(bool(r["early"]) for r in judged),
      "lost_share": float(intervals.iqm(lost)) if lost else None,
      "lost_share_ci": intervals.interval(lost) if lost else None,
    }
  return out


def _relive(
  own: dict[int, list[dict]], since: dict[int, int], names: tuple[str, ...], config: AdaptConfig
) -> dict[int, np.ndarray]:
  """Stream -> decisions (1 + 6, chunks) of the phase machine: with all signals, then with each left
  out.
  """
  number = lambda x: np.float32(np.nan if x is None else x)
  signals = np.array(
    [[[number(c[n]) for n in names] for c in chunks] for chunks in own.values()], np.float32
  )
  posture, acceptance = (
    np.array([[number(c[n]) for c in chunks] for chunks in own.values()], np.float32)
    for n in ("posture", "acceptance")
  )
  rows = next(iter(own.values()))
  least = jnp.float32(-np.inf if rows[0]["least_posture"] is None else rows[0]["least_posture"])
  length = (
    rows[0]["step"] + 1
  )  # chunks are equally long; the last one may reach past the end of the run
  now = (np.arange(len(rows), dtype=np.int32) + 1) * length
  counts = np.vstack([np.ones(len(names), bool), ~np.eye(len(names), dtype=bool)])

  def live(
    signals: jax.Array,
    posture: jax.Array,
    acceptance: jax.Array,
    since: jax.Array,
    counts: jax.Array,
  ) -> jax.Array:
    def step(
      state: decide.PhaseState, x: tuple[jax.Array, jax.Array, jax.Array, jax.Array]
    ) -> tuple[decide.PhaseState, jax.Array]:
      signals, posture, acceptance, now = x
      falls = (since >= now - length) & (since < now)
      state, decision, _ = decide.update(
        state,
        signals,
        posture,
        False,  # type: ignore[arg-type]
        since,
        now,
        False,
        acceptance,
        least,
        config,
        falls,
        counts=counts,
      )
      return state, decision

    return jax.lax.scan(
      step, decide.init(config), (signals, posture, acceptance, jnp.asarray(now))
    )[1]

  every = jax.vmap(jax.vmap(live, (None, None, None, None, 0)), (0, 0, 0, 0, None))
  decisions = jax.jit(every)(
    signals, posture, acceptance, jnp.asarray(list(since.values()), jnp.int32), counts
  )
  return dict(zip(own, np.asarray(decisions)))


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
  differ = folders.differing(theirs, ours, deep=True)
  if differ:
    raise UserError(
      f"stops: {folder} was run with another {', '.join(differ)}; its oracle stops are not "
      "those of this run"
    )
  if not (folder / "snapshots.parquet").exists():
    raise FileError(
      f"stops: {folder} has no snapshots.parquet; run arm oracle-budget with --snapshots 1000 there"
    )
  curves: dict[int, list] = {}
  for s in _read(folder, "snapshots"):
    curves.setdefault(s["seed"], []).append((s["since_start"], s["reward_mean"]))
  out = {}
  for seed, points in curves.items():
    age, reward = zip(*sorted(points))
    out[seed] = max(1, int(age[oracle(age, reward)]))
  seeds = range(config.first_seed, config.first_seed + config.seeds)
  missing = [s for s in seeds if s not in out]
  if missing:
    raise UserError(
      f"stops: {folder} has no snapshots of seed {', '.join(map(str, missing))}; it has "
      f"{', '.join(map(str, sorted(out)))}"
    )
  return {seed: out[seed] for seed in seeds}


# ---- files ---------------------------------------------------------------------------------------


def _table(folder: str | os.PathLike, name: str, columns: list[str] | None = None) -> pyarrow.Table:
  try:
    return pyarrow.parquet.read_table(pathlib.Path(folder) / f"{name}.parquet", columns=columns)
  except (OSError, pyarrow.ArrowException) as e:
    raise FileError(f"cannot read {name}.parquet of {folder}: {str(e).splitlines()[0]}") from None


def _read(folder: str | os.PathLike, name: str) -> list[dict]:
  return _table(folder, name).to_pylist()
