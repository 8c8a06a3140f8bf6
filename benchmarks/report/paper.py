"""The paper's four experiments beside runs of mjx_cl: what it reports, what was measured, how the
two set-ups differ.

The paper: F. Domberg and G. Schildbach, arXiv 2603.04029. Each statement carries the section or
caption it stands in.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from mjx_cl.config import DreamerConfig, finetuning
from mjx_cl.errors import FileError
from mjx_cl.scoring import intervals

RATIO = 16.0  # the paper's train ratio while finetuning, III-C


class Statement(NamedTuple):
  """One line of the paper's results.

  Attributes:
    what: in words. text: what the paper says, short. source: where. measure: key of MEASURES.
      value: the paper's figure in the unit of the measure,
    None where it gives words alone.
  """

  what: str
  text: str
  source: str
  measure: str
  value: float | None = None


class Experiment(NamedTuple):
  """One of the paper's experiments and the run that repeats it.

  Attributes:
    folder: of the run, under results/paper. change: the rows of runs.parquet that count, by their
      column `change`.
    onset: of the paper's first change [control steps]. protocol, runs: of the paper, in words.
      robot: what the robot differs in, None: nothing.
  """

  folder: str
  change: int
  onset: int
  protocol: str
  runs: str
  robot: str | None
  statements: tuple[Statement, ...]


EXPERIMENTS: dict[str, Experiment] = {
  "paper/walker": Experiment(
    "walker",
    0,
    5000,
    "one random joint's gear halved",
    "10 runs",
    None,
    (
      Statement("alarm after onset", '"rapidly"', "IV-A", "latency"),
      Statement(
        "reward back after onset",
        "most metrics near their old values in less than 10,000 steps",
        "IV-A",
        "recovery",
        10_000,
      ),
      Statement("reward at the end / before", '"slightly less"', "IV-A", "kept"),
    ),
  ),
  "paper/quadruped": Experiment(
    "quadruped",
    0,
    9000,
    "right hind leg's velocity limits to a third",
    "9 runs and a failed one",
    "MuJoCo in place of Isaac Lab; agent first cloned from a driver that knows the robot's state",
    (
      Statement("alarm after onset", '"quickly"', "IV-B", "latency"),
      Statement(
        "reward back after onset",
        "walking stable after 5,000 steps on average",
        "IV-B",
        "recovery",
        5000,
      ),
      Statement(
        "no fall for 2,000 steps and reward back", "as above, 9 runs of 10", "IV-B", "stable", 5000
      ),
      Statement("last finetuning stops at step", "26,000", "IV-B", "last_stop", 26_000),
      Statement(
        "how finetuning ends",
        "9 runs stop by themselves, a failed one is aborted",
        "IV-B",
        "outcomes",
        0.9,
      ),
    ),
  ),
  "paper/car-transfer": Experiment(
    "car",
    0,
    10_000,
    "simulator to car",
    "1 run",
    "a simulated four-wheel car in place of the real one",
    (
      Statement("alarm after transfer", '"quickly"', "IV-C", "latency"),
      Statement(
        "reward back after transfer",
        "40,000 steps (driving stable after 10,000)",
        "IV-C, V-C",
        "recovery",
        40_000,
      ),
      Statement(
        "first finetuning ends after",
        "shortly after step 50,000, that is 40,000 steps",
        "IV-C",
        "stop",
        40_000,
      ),
    ),
  ),
  "paper/car-socks": Experiment(
    "car",
    1,
    10_000,
    "rear friction cut, as by socks",
    "1 run",
    (
      "a simulated four-wheel car in place of the real one; friction under its socks chosen, on "
      "other seeds, to cost the paper's 20 %"
    ),
    (
      Statement("reward lost at first", "20 %", "IV-C", "drop", 0.2),
      Statement("alarm after the socks", "OPR nearly blind", "IV-C", "latency"),
      Statement("reward back after the socks", "10,000 steps", "V-C", "recovery", 10_000),
      Statement("reward at the end / before", '"slightly lower"', "IV-C", "kept"),
    ),
  ),
}


class Measured(NamedTuple):
  """A figure with its unit, interval and n; `value` None: the median stream never gets there, or
  nothing was measured.
  """

  value: float | None
  text: str
  unit: str = "steps"


def number(x: float | None, digits: int = 0) -> str:
  """1,234.5; `-` for None, no negative zero."""
  if x is None:
    return "-"
  text = f"{x:,.{digits}f}"
  return text.lstrip("-") if not float(text.replace(",", "")) else text


def span(ci, digits: int = 0) -> str:
  """[low, high], `-` for an end that is censored; empty where there is no interval."""
  return f"[{', '.join(number(x, digits) for x in ci)}]" if ci else ""


def times(values: list[float], n: str) -> Measured:
  """Censored median of times in control steps (inf: never), with its bootstrap interval."""
  if not values:
    return Measured(None, f"none of {n}")
  median = intervals.finite(intervals.censored_median(values))
  ci = intervals.interval(values, intervals.censored_median)
  return Measured(
    median,
    (
      f"{number(median)} {span(ci)} steps, {int(np.sum(np.isfinite(values)))} of {len(values)} {n}"
    ).replace("  ", " "),
  )


def shares(values: list[float], n: str) -> Measured:
  """IQM of shares with its bootstrap interval, in per cent."""
  if not values:
    return Measured(None, f"none of {n}", "%")
  ci, value = intervals.interval(values), float(intervals.iqm(values))
  interval = span(ci and [None if x is None else 100 * x for x in ci])
  return Measured(
    value, f"{number(100 * value)} {interval} %, {len(values)} {n}".replace("  ", " "), "%"
  )


def latency(rows: list[dict]) -> Measured:
  met = [r for r in rows if r["onset"] is not None and not r.get("adapting_at_onset")]
  return times(
    [np.inf if r["latency_steps"] is None else r["latency_steps"] for r in met], "streams"
  )


def recovery(rows: list[dict]) -> Measured:
  return times(
    [
      np.inf if r["recovery_step"] is None else r["recovery_step"] - r["onset"]
      for r in rows
      if r["affected"]
    ],
    "affected streams",
  )


def stable(rows: list[dict]) -> Measured:
  """Steps from the onset until a stream neither falls nor earns less than 90 % for 2,000 steps, of
  all streams (scoring.recovery.stable_step).
  """
  met = [r for r in rows if r["onset"] is not None]
  if any("stable_step" not in r for r in met):
    return Measured(None, "not measured: runs.parquet is older than this figure")
  return times(
    [np.inf if r["stable_step"] is None else r["stable_step"] - r["onset"] for r in met], "streams"
  )


def stop(rows: list[dict]) -> Measured:
  """Steps from the change to the end of the first finetuning that converged after it; a stream
  without one is censored. Says how many alarmed again.
  """
  met = [r for r in rows if r["onset"] is not None]
  own = times(
    [np.inf if r["first_stop"] is None else r["first_stop"] - r["onset"] for r in met], "streams"
  )
  again = sum(r["first_stop"] is not None and r["restarts"] > 0 for r in met)
  return own._replace(text=own.text + (f", {again} of them alarmed again later" if again else ""))


def last_stop(rows: list[dict]) -> Measured:
  """Absolute step of the last stop or abort; None while a stream is still adapting, for the first
  time or again. A maximum has no bootstrap interval.
  """
  ends, still = (
    [r["adapt_stop"] for r in rows if r["adapt_stop"] is not None],
    sum(r["outcome"] == "adapting" for r in rows),
  )
  last = max(ends) if ends and not still else None
  said = f"{len(ends)} streams ended one" + (
    f", the last at {number(max(ends))}; {still} still adapting at the end of the run"
    if ends and still
    else ""
  )
  return Measured(last, f"{number(last)} ({said})")


def outcomes(rows: list[dict]) -> Measured:
  """How the finetunings that went on at the change or began after it ended; the value is the share
  of streams that converged. Those whose finetuning was over before, begun by a false alarm, are
  counted apart."""
  over = lambda r: (
    r["adapt_stop"] is not None
    and r["onset"] is not None
    and r["adapt_stop"] < r["onset"]
    and r["outcome"] != "adapting"
  )
  count = lambda *names: sum(not over(r) and r["outcome"] in names for r in rows)
  before = sum(map(over, rows))
  n, good = len(rows), count("converged")
  ci = [x * n for x in intervals.wilson(good, n)]
  return Measured(
    good / n,
    f"converged {good} of {n} {span(ci, 1)}, aborted "
    f"{count('aborted_by_rule', 'aborted_by_budget')}, "
    f"still adapting {count('adapting')}, never alarmed {count('nominal')}"
    + f", over before the change {before}"
    * bool(before),
    "%",
  )


def kept(rows: list[dict]) -> Measured:
  return shares(
    [r["reward_final"] / r["reward_pre"] for r in rows if r["affected"] and r["reward_pre"]],
    "affected streams",
  )


def drop(rows: list[dict]) -> Measured:
  return shares([r["reward_drop"] for r in rows if r["reward_drop"] is not None], "streams")


MEASURES = {
  "latency": latency,
  "recovery": recovery,
  "stop": stop,
  "last_stop": last_stop,
  "outcomes": outcomes,
  "kept": kept,
  "drop": drop,
  "stable": stable,
}


def difference(paper: float | None, own: Measured) -> str:
  """mjx_cl minus paper, in words where one of the two has no figure."""
  if paper is None:
    return "the paper gives no figure"
  if own.value is None:
    return "not reached"
  scale, unit = (100, "points") if own.unit == "%" else (1, own.unit)
  gap = scale * (own.value - paper)
  return f"{'+' if gap > 0 else ''}{number(gap)} {unit}"


def setup(experiment: Experiment, config: dict) -> list[str]:
  """What differs from the paper's set-up: the settings that config.json holds against the authors'
  defaults, then what the robot differs in.
  """
  card, adapt, author = config["agent_card"], config["adapt"], DreamerConfig()
  dreamer = {
    **dataclasses.asdict(author),
    **card["dreamer"],
  }  # a card older than a setting has its default
  adapt = finetuning(adapt, card)
  own = lambda name: adapt[name] if adapt.get(name) is not None else dreamer[name]
  pairs = [
    (card["dreamer"]["size"], author.size, "{} in place of {}"),
    (own("batch"), author.batch, "{} sequences an update in place of {}"),
    (own("lr"), author.lr, "learning rate {:g} in place of {:g}"),
    (adapt.get("policy_lr") or 1.0, author.policy_lr, "the policy's own steps {:g} times as long"),
    (
      1.0 if adapt.get("model_lr") is None else adapt["model_lr"],
      author.model_lr,
      "the world model's own steps {:g} times as long",
    ),
    (own("anchor"), author.anchor, "policy held to the actions taken with a weight of {:g}"),
    (
      dreamer["min_std"],
      author.min_std,
      "standard deviation of the actions at least {:g} in place of {:g}",
    ),
    (dreamer["max_std"], author.max_std, "at most {:g} in place of {:g}"),
    (dreamer["entropy"], author.entropy, "entropy weight {:g} in place of {:g}"),
    (dreamer["horizon"], author.horizon, "discount horizon {} in place of {}"),
    (adapt["ratio"], RATIO, "train ratio {:g} in place of {:g}"),
    (config["onset"], experiment.onset, "onset {:,} in place of {:,}"),
    (
      adapt["average"],
      1.0,
      (
        "while finetuning the robot acts by a moving average of the weights (rate {:g} every 64 "
        "steps)"
      ),
    ),
    (adapt["least"], 1, "a finetuning lasts {:,} steps at least before it may converge"),
  ]
  words = [text.format(ours, theirs) for ours, theirs, text in pairs if ours != theirs]
  if config["detector"] != "rolling_sigma_plain":
    words.append(
      f"detector `{config['detector']}` in place of three standard deviations of single residuals"
    )
  if card.get("demonstrator"):
    words.append("agent pretrained with a demonstrator")
  return words + ([experiment.robot] if experiment.robot else [])


def with_stops(runs: list[dict], events: list[dict]) -> list[dict]:
  """Rows of runs.parquet with `first_stop`, control step of the first end of a finetuning that
  converged between the row's change and the next one, None without, and `restarts`, how many
  finetunings began after it."""
  out = []
  for r in runs:
    later = [
      q["onset"]
      for q in runs
      if q["stream"] == r["stream"]
      and q["onset"] is not None
      and r["onset"] is not None
      and q["onset"] > r["onset"]
    ]
    end = min(later, default=np.inf)
    own = [
      e
      for e in events
      if r["onset"] is not None and e["stream"] == r["stream"] and r["onset"] <= e["step"] < end
    ]
    first = next((e["step"] for e in own if e["kind"] == "stop"), None)
    out.append(
      r
      | {
        "first_stop": first,
        "restarts": 0
        if first is None
        else sum(e["kind"] == "start" and e["step"] > first for e in own),
      }
    )
  return out


def compare(
  name: str, config: dict, runs: list[dict], events: list[dict]
) -> list[tuple[str, str, str, str]]:
  """Rows (what, paper, mjx_cl, difference) of one experiment, arm `detector` alone, from the rows
  of runs.parquet and events.parquet.
  """
  experiment = EXPERIMENTS[name]
  rows = [
    r
    for r in with_stops(runs, events)
    if r["arm"] == "detector" and r.get("change", 0) == experiment.change
  ]
  if not rows:
    raise FileError(
      f"{name}: runs.parquet holds no row of arm `detector` with change {experiment.change}"
    )
  out = []
  for s in experiment.statements:
    own = MEASURES[s.measure](rows)
    out.append((s.what, f"{s.text} ({s.source})", own.text, difference(s.value, own)))
  return out
