"""The stop rule with each signal left out, lived once more over the recorded signals."""

import os
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.adapt import decide
from mjx_cl.adapt.arms import ARMS, never_stops
from mjx_cl.adapt.decide import REASONS, SIGNALS, START, STOP
from mjx_cl.config import AdaptConfig
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import tables
from mjx_cl.scoring import events, intervals, stop_rule

# settings of AdaptConfig that it may change
RULE = ("patience", "trend", "fluctuation", "excess", "near", "least", "give_up", "regain")
# of a row of stop_rule, where the run has snapshots
JUDGED = (
  "oracle_stop_steps",
  "steps_after_oracle",
  "early",
  "reward_stop",
  "return_lost",
  "lost_share",
)


def ablation(folder: str | os.PathLike, **rule: Any) -> list[dict]:
  """When the stop rule would have ended the first adaptation of each stream that never stops, had
  it not asked a signal to settle.

  The phase machine of a run (adapt.decide) lives once more over the recorded chunk signals. A
  reward that is left out need not settle, but must still be accepted. Until the stop this is the
  life of arm `oracle` in the same seed, as far as both were rounded alike (run.Runner).

  Args:
    folder: of the run.
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
    config = AdaptConfig(**tables.read_json(pathlib.Path(folder) / "config.json")["adapt"] | rule)
  except (FileError, KeyError, TypeError) as e:
    raise FileError(f"{folder} holds no run: {e}") from None
  chunks, known = stop_rule.read(folder, "signals"), {}
  if (pathlib.Path(folder) / "snapshots.parquet").exists():
    known = stop_rule.curves(stop_rule.read(folder, "snapshots"))
  first: dict[int, dict] = {}
  happened = events.read(pathlib.Path(folder) / "events.parquet").to_pylist()
  for span in stop_rule.spans(happened):
    if never_stops(ARMS[span["arm"]]):
      first.setdefault(span["stream"], span)
  if not first:
    raise UserError(f"{folder}: no stream of an arm that never stops has adapted")
  own = {g: [c for c in chunks if c["stream"] == g] for g in first}
  decisions = _relive(own, [s["since"] for s in first.values()], config)
  return [
    _row(span, left_out, decision, own[g], known.get((g, span["since"])))
    for g, span in first.items()
    for left_out, decision in zip(("", *SIGNALS), decisions[g])
  ]


def _row(
  span: dict,
  left_out: str,
  decision: np.ndarray,
  chunks: list[dict],
  curve: list[dict] | None,
) -> dict:
  """One row of `ablation`.

  Args:
    span: the adaptation.
    left_out: the signal, or "".
    decision: int (chunks,), of the phase machine.
    chunks: rows of signals.parquet.
    curve: snapshots of the adaptation by their age, None where there are none.
  """
  ends = np.flatnonzero((decision != 0) & (decision != START))
  row = {k: span[k] for k in ("stream", "arm", "seed")} | {"left_out": left_out}
  row |= {"outcome": "adapting", "reason": None, "stop": None, "own_stop_steps": None}
  if len(ends):
    code, stop = int(decision[ends[0]]), chunks[ends[0]]["step"]
    row |= {
      "outcome": "converged" if code == STOP else "aborted",
      "reason": REASONS[code],
      "stop": stop,
      "own_stop_steps": stop + 1 - span["since"],
    }
  if curve:
    judged = dict.fromkeys(JUDGED) | stop_rule.against(curve, span["since"], row["stop"])
    row |= {k: judged[k] for k in JUDGED}
  return row


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
    out[name] = {
      "adaptations": len(own),
      **{end: sum(r["outcome"] == end for r in own) for end in ("converged", "aborted")},
      **stop_rule.spread("own_stop_steps_median", steps, intervals.censored_median),
      "judged": len(judged),
      "early": sum(bool(r["early"]) for r in judged),
      **stop_rule.spread("lost_share", [r["lost_share"] for r in judged]),
    }
  return out


def _relive(
  own: dict[int, list[dict]], since: list[int], config: AdaptConfig
) -> dict[int, np.ndarray]:
  """Stream -> decisions (1 + 6, chunks) of the phase machine: with all signals, then with each left
  out.
  """
  number = lambda x: np.float32(np.nan if x is None else x)
  column = lambda k: np.array([[number(c[k]) for c in chunks] for chunks in own.values()])
  signals = np.stack([column(k) for k in SIGNALS], -1)
  rows = next(iter(own.values()))
  least = jnp.float32(-np.inf if rows[0]["least_posture"] is None else rows[0]["least_posture"])
  # chunks are equally long; the last one may reach past the end of the run
  length = rows[0]["step"] + 1
  now = jnp.asarray((np.arange(len(rows), dtype=np.int32) + 1) * length)
  counts = np.vstack([np.ones(len(SIGNALS), bool), ~np.eye(len(SIGNALS), dtype=bool)])

  def live(
    signals: jax.Array,
    posture: jax.Array,
    acceptance: jax.Array,
    since: jax.Array,
    counts: jax.Array,
  ) -> jax.Array:
    def step(state: decide.PhaseState, x: tuple) -> tuple[decide.PhaseState, jax.Array]:
      signals, posture, acceptance, now = x
      falls = (since >= now - length) & (since < now)
      first = jax.tree.map(lambda x: x[None], state)
      acceptance = decide.regained(first, acceptance, config.regain)[0]
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

    return jax.lax.scan(step, decide.init(config), (signals, posture, acceptance, now))[1]

  every = jax.vmap(jax.vmap(live, (None, None, None, None, 0)), (0, 0, 0, 0, None))
  decisions = jax.jit(every)(
    signals, column("posture"), column("acceptance"), jnp.asarray(since, jnp.int32), counts
  )
  return dict(zip(own, np.asarray(decisions)))
