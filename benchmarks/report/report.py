"""Numbers of README and docs from the files of results/: what lies between `<!-- report:NAME -->`
and `<!-- /report -->` is written by BLOCKS[NAME].

Both markers stand alone on their lines. A block is a function of the results folder that returns
Markdown, with links as of a page beside that folder; a new one is one function and one line of the
table. No JAX is needed but for the blocks of CODE.
"""

from __future__ import annotations

import json
import pathlib
import re
import statistics
import textwrap
from collections import Counter
from typing import NamedTuple

from benchmarks.report import paper
from benchmarks.report.paper import number, span
from mjx_cl.config import CHUNK, named
from mjx_cl.config.sizes import SIZES
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import folders

WIDTH = 150


# ---- reading and wording -------------------------------------------------------------------------


def load(path: pathlib.Path):
  """Value of a JSON file."""
  try:
    return json.loads(path.read_text())
  except FileNotFoundError:
    raise FileError(f"{path} is missing") from None
  except (OSError, ValueError) as e:
    raise FileError(f"cannot read {path}: {str(e).splitlines()[0]}") from None


def table(path: pathlib.Path, columns: list[str] | None = None) -> list[dict]:
  """Rows of a Parquet file, undefined is None."""
  import pyarrow
  import pyarrow.parquet

  if not path.exists():
    raise FileError(f"{path} is missing")
  try:
    return pyarrow.parquet.read_table(path, columns=columns).to_pylist()
  except (OSError, pyarrow.ArrowException) as e:
    raise FileError(f"cannot read {path}: {str(e).splitlines()[0]}") from None


class Bench:
  """Rows {name, value, unit, goal, holds} of a speed script, by name, and what the file says of the
  measurement.
  """

  def __init__(self, path: pathlib.Path):
    value = load(path)
    self.path, self.about = path, {} if isinstance(value, list) else value
    self.rows = {r["name"]: r for r in (value if isinstance(value, list) else value["rows"])}

  def row(self, name: str) -> dict:
    if name not in self.rows:
      raise FileError(f"{self.path} has no row {name!r}")
    return self.rows[name]


def percent(x: float | None, digits: int = 0) -> str:
  return number(None if x is None else 100 * x, digits)


def percents(ci, digits: int = 0) -> str:
  return span(ci and [None if x is None else 100 * x for x in ci], digits)


def fill(text: str) -> str:
  """One paragraph; lines and gaps of `text` do not count."""
  return textwrap.fill(
    " ".join(text.split()), WIDTH, break_long_words=False, break_on_hyphens=False
  )


def both(values: dict, name: str, digits: int = 0) -> str:
  """A figure with its interval: `name` and `name`_ci of a summary."""
  return f"{number(values[name], digits)} {span(values[name + '_ci'], digits)}".strip()


def few(values: dict, name: str, n: int, digits: int = 0) -> str:
  """As `both`, of `n` seeds. A bootstrap of up to three values can only give their smallest and
  largest, which is no 95 % interval: the range is written as such, `0.79 (0.77 to 0.81), 2
  seeds`."""
  low, high = values[name + "_ci"] or (None, None)
  if n > 3:
    text = both(values, name, digits)
  else:
    text = number(values[name], digits) + (
      f" ({number(low, digits)} to {number(high, digits)})" if n > 1 and low is not None else ""
    )
  return f"{text}, {n} seed{'s' * (n != 1)}"


def averaged(values, digits: int = 0) -> str:
  """Mean of a value of each stream with its bootstrap interval; a dash for fewer than two."""
  from mjx_cl.scoring import intervals

  return (
    (
      f"{number(statistics.mean(values), digits)} "
      f"{span(intervals.interval(values, lambda x, axis=-1: x.mean(axis)), digits)}"
    )
    if len(values) > 1
    else "-"
  )


def alarmed(own: dict) -> str:
  """Streams of an arm's summary that alarm after the change, of those whose finetuning was not
  under way when it came.
  """
  return f"{own['alarms']} of {own['seeds'] - own.get('adapting_at_onset', 0)}"


def soon(own: dict) -> str:
  """Affected ones of those that alarm within 500 steps."""
  n = own.get("affected_watched", own["affected"])
  return f"{own['affected_alarmed_within_500']} of {n}" if n else "-"


FEW = "Of three seeds or fewer the range stands in round brackets: they give no interval."


def grid(head, rows) -> str:
  """A Markdown table."""
  line = lambda cells: "|" + "|".join(f" {c} " if c else " " for c in cells) + "|"
  return "\n".join([line(head), "|" + "---|" * len(head), *(line(r) for r in rows)])


def joined(words: list[str]) -> str:
  return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


# ---- blocks --------------------------------------------------------------------------------------


def run_walker(results: pathlib.Path) -> str:
  """The run that the first command of the README makes."""
  folder = results / "walker_gear"
  config, summary = load(folder / "config.json"), load(folder / "summary.json")
  runs = [
    r for r in table(folder / "runs.parquet") if r["arm"] == "detector" and not r.get("change")
  ]
  main, none, machine = summary["arms"]["detector"], summary["arms"]["none"], config["machine"]
  n, hit, first = main["seeds"], main["affected"], config["first_seed"]
  part = lambda r: r["fault"].split(":")[-1]
  shares = ", ".join(f"{k} {percent(v)} %" for k, v in summary["wall_share"].items())
  spared, others, ends = [r for r in runs if r["affected"] is False], "", {}
  if spared:
    parts = joined(
      [f"{name} {count}" for name, count in sorted(Counter(map(part, spared)).items())]
    )
    others = (
      f"; the others ({parts}) lose at most {percent(max(r['reward_drop'] for r in spared), 1)} "
      "% of their reward"
    )
  for r in runs:
    if r["affected"]:
      ends.setdefault(part(r), []).append(r["reward_final"] / r["reward_pre"])
  text = fill(f"""
      Seeds {first} to {first + n - 1}, one shipped agent; {number(summary["wall_s"] / 60, 1)} minutes on {machine["cores"]} shared cores ({machine["cpu"]}; {shares}).
      Brackets hold 95 % intervals: Wilson for shares and counts, bootstrap over the {n} streams for medians and for rewards (interquartile means), all for that one agent;
      `-` is a value that is not reached. Affected: {hit} of {n}{others}.""")
  count = lambda name, of: f"{main[name]} of {of} {span(main[name + '_ci'], 1)}"
  recovered = (
    f"{count('recovered_within_10000', hit)} ({main['recovered']} within "
    f"{number(summary['steps'] - summary['onset'])})"
  )
  ended = " / ".join(
    str(main[k]) for k in ("converged", "aborted_by_rule", "aborted_by_budget", "adapting")
  )
  joints = ", ".join(
    f"{name} {percent(statistics.fmean(x))} % ({len(x)})" for name, x in sorted(ends.items())
  )
  rows = [
    (
      f"streams with a false alarm in {number(summary['onset'])} nominal steps",
      count("false_alarm_streams", n),
      f"{none['false_alarm_streams']} of {n}",
    ),
    (
      "affected streams that alarm within 500 steps of onset",
      count("affected_alarmed_within_500", main.get("affected_watched", hit)),
      "",
    ),
    (
      "median latency over all streams, a miss counted as infinite [steps]",
      both(main, "latency_median_steps"),
      "",
    ),
    ("miss probability, all streams", both(main, "miss_probability", 2), ""),
    (
      "affected streams recovered within 10,000 steps",
      recovered,
      f"{none['recovered_within_10000']} of {none['affected']}",
    ),
    (
      "recovery, median over the affected [steps after onset]",
      both(main, "recovery_median_steps"),
      number(none["recovery_median_steps"]),
    ),
    (
      "finetuning converged / aborted by rule / by budget / still running",
      f"{ended} (the other {sum(r['outcome'] == 'nominal' for r in runs)} never alarmed)",
      "",
    ),
    ("reward per step before onset", both(main, "reward_pre", 2), both(none, "reward_pre", 2)),
    (
      "share of it lost over 2,000 steps after onset, without adaptation",
      "",
      both(none, "reward_drop", 2),
    ),
    (
      "reward over the last 2,000 steps, affected streams",
      both(main, "reward_final_affected", 2),
      both(none, "reward_final_affected", 2),
    ),
    ("that reward over the reward before onset, by joint (streams)", joints, ""),
  ]
  return text + "\n\n" + grid(("", "arm `detector`", "arm `none`"), rows)


def arl0(results: pathlib.Path) -> str:
  """How often the default detector alarms on a healthy walker."""
  value = load(results / "arl0.json")
  chosen, plain, (low, high) = value["chosen"], value["plain"], value["seeds"]
  return fill(f"""
      Detector and stop rule were chosen on seeds {low} to {high} ([results/arl0.json](results/arl0.json),
      [results/walker_gear_tuning](results/walker_gear_tuning)). The detector `rolling_sigma` is the paper's rule on the trailing mean of
      {chosen["smooth"]} {"logarithms" if chosen["log"] else "residuals"} against a reference that lags by {chosen["lag"]}, threshold
      {chosen["threshold"]:g}: ARL0 {number(chosen["arl0"])} steps {span(chosen["arl0_ci"])} from {"only" if chosen["few"] else ""}
      {chosen["alarms"]} alarms in {number(value["nominal_steps"])} nominal steps, and {percent(chosen["within_500"])} % of
      {value["fault_affected"]} affected tuning streams found within 500 steps. The rule as written (`rolling_sigma_plain`: single samples,
      {plain["threshold"]:g} deviations) alarms every {number(plain["arl0"])} steps {span(plain["arl0_ci"])} on a healthy walker, because a gait
      makes residuals swing.""")


def mute(rows) -> dict[str, set]:
  """Detector -> robots on which no threshold brings it to the asked rate: its scores never alarmed
  on the tuning streams.
  """
  silent: dict[str, set] = {}
  for r in rows:
    if not r["reference"] and r["arl0_alarms"] == 0:
      silent.setdefault(r["detector"], set()).add(r["robot"])
  return silent


def never_note(marked: dict[str, set]) -> str:
  """The note under a board on the detectors marked so."""
  return (
    "§ no threshold gives that rate, the detector never alarms: "
    f"{'; '.join(f'{name} on {joined(sorted(own))}' for name, own in marked.items())}."
  )


def chance(rows) -> dict[str, set]:
  """Detector -> robots on which alarms of a lower threshold count with a probability."""
  found: dict[str, set] = {}
  for r in rows:
    if not r["reference"] and (r["note"] or "").startswith("no threshold gives the asked rate"):
      found.setdefault(r["detector"], set()).add(r["robot"])
  return found


SCORED = (
  "detector",
  "reference",
  "robot",
  "fault",
  "severity",
  "cost_standard",
  "streams",
  "stream_latency_steps",
  "stream_healthy_alarms",
  "healthy_steps",
)


def best(rows: list[dict]) -> str:
  """The best detector of each robot, with its score."""
  means = {}
  for r in rows:
    if not r["reference"] and r["cost_standard"] is not None:
      means.setdefault(r["robot"], {}).setdefault(r["detector"], []).append(r["cost_standard"])
  found = {
    robot: max((statistics.fmean(x), name) for name, x in own.items())
    for robot, own in sorted(means.items())
  }
  return joined([f"`{name}` {number(x)} ({robot})" for robot, (x, name) in found.items()])


def lead(rows: list[dict], overall: list[dict]) -> str:
  """How far the first detector lies above the second; `rows` hold SCORED, `overall` is in order."""
  from mjx_cl.scoring import comparison

  first, second = [r["detector"] for r in overall if "(oracle)" not in r["detector"]][:2]
  ahead, interval = comparison.difference(rows, first, second)
  return (
    f"`{first}` lies {number(ahead, 1)} {span(interval, 1)} above `{second}` (paired over seeds, "
    "for these faults only)."
  )


def leaderboard(results: pathlib.Path) -> str:
  """Detectors on the recorded streams: those that beat never alarming, and their own plain form, as
  a table, the others in a sentence.
  """
  meta = load(results / "leaderboard.json")
  overall = sorted(
    table(results / "leaderboard_overall.parquet"),
    key=lambda r: (-r["cost_standard"], r["detector"]),
  )
  rows = table(results / "leaderboard.parquet", ["arl0_alarms", "control_s", "note", *SCORED])
  robots, faults = (
    sorted({r["robot"] for r in rows}),
    len({(r["robot"], r["fault"], r["severity"]) for r in rows}),
  )
  alarms = statistics.mode(r["arl0_alarms"] for r in rows if not r["reference"])
  (low, high), minutes = meta["seeds"]["score"], meta["wall_s"] / 60
  asked = {r["robot"]: 3600 / r["control_s"] / meta["arl0_target"] for r in rows}
  bounded, fitted = chance(rows), meta.get("fitted", {})
  text = fill(f"""
      `mjx-cl leaderboard`: {len(overall)} detectors on the same recordings of frozen agents: {joined(robots)}, {faults} fault settings (fault x severity),
      {high - low + 1} scoring seeds each. Thresholds are set to ARL0 = {number(meta["arl0_target"])} control steps on other seeds' healthy streams, that is
      {joined([f"{number(asked[r], 1)} ({r})" for r in robots])} false alarms an hour; they rest on {alarms} alarms for most detectors{", so the rates are orders of magnitude" if alarms < 50 else ""},
      and the table holds what the scoring seeds gave. Score: 0 for never alarming, 100 for alarming at the onset and at no other time; mean over all faults of all robots,
      intervals over seeds; *costly faults*: over the {overall[0]["blocks_costly"]} settings that take a tenth of the reward or more from a robot that does not adapt. Best on each robot: {best(rows)}. {lead(rows, overall)} Mean ranks closer than {number(meta["critical_difference"], 1)} are not
      told apart (seeds drawn anew, at least Nemenyi's difference; oracles and dummies take no
      rank). {number(meta["stream_steps"] / 1e6, 1)} million stream-steps in
      {number(minutes, 1)} minutes on {meta["machine"]["cores"]}
      core{"s" if meta["machine"]["cores"] > 1 else ""}
      (goal 4 minutes{", missed" if minutes > 4 else ""}).
      The page, sortable, one view per fault:
      [results/leaderboard.html](results/leaderboard.html).""")
  score = {r["detector"]: r["cost_standard"] for r in overall}
  plain = lambda name: (
    name if "(oracle)" in name else re.split("[@ ]", name)[0]
  )  # cusum@opr and cusum white are variants of cusum
  kind = lambda name: (
    "worse"
    if not score[name] > 0
    else "variant"
    if score[name] < score.get(plain(name), score[name])
    else "shown"
  )
  whole = lambda x: f"{percent(x)}%"
  shown = [
    (
      r["detector"] + " §" * (r["detector"] in bounded) + " ¶" * (r["detector"] in fitted),
      f"{number(r['cost_standard'])} {span((r['cost_standard_low'], r['cost_standard_high']))}",
      number(r["cost_costly"]),
      whole(r["detected_within_1s"]),
      whole(r["detected_within_5s"]),
      whole(r["miss_probability"]),
      number(r["false_alarms_per_hour"], 1),
      number(r["mean_rank"], 1),
    )
    for r in overall
    if kind(r["detector"]) == "shown"
  ]
  rest = ""
  for which, words in (
    ("variant", "Variants that score less than the plain form"),
    ("worse", "No better than never alarming"),
  ):
    names = [f"{name} {number(x)}" for name, x in score.items() if kind(name) == which]
    rest += f" {words}: {', '.join(names)}." if names else ""
  marked = [
    f"{name} on {joined(sorted(own))}" for name, own in bounded.items() if kind(name) == "shown"
  ]
  if marked:
    rest = f" § no threshold gives that rate, alarms of the next lower one count with a probability that does: {'; '.join(marked)}.{rest}"
  for on in dict.fromkeys(fitted.values()):
    named = joined(sorted(name for name, words in fitted.items() if words == on))
    rest = f" ¶ {named}: fitted beforehand on {on}." + rest
  board = grid(
    (
      "detector",
      "score [95 %]",
      "costly faults",
      "within 1 s",
      "within 5 s",
      "missed",
      "false alarms/h",
      "mean rank",
    ),
    shown,
  )
  dots = fill(
    "Dots: the score over all faults with its interval, and on each robot "
    "(`python benchmarks/pictures.py`). Grey: up to what the likelihood-ratio oracle scores, which "
    "is told the fault and watches OPR and RPR."
  )
  return "\n\n".join(
    [
      text,
      "![each detector's score](results/leaderboard.png)",
      dots,
      board,
      *([fill(rest)] if rest else []),
    ]
  )


def leaderboard_100k(results: pathlib.Path) -> str:
  """The board at a tenth of the false alarms, beside the default one."""
  folder = results / "leaderboard_100k"
  meta, held = (
    load(folder / "leaderboard.json"),
    {r["detector"]: r["cost_standard"] for r in table(results / "leaderboard_overall.parquet")},
  )
  overall = sorted(
    table(folder / "leaderboard_overall.parquet"),
    key=lambda r: (-r["cost_standard"], r["detector"]),
  )
  rows = [
    r
    for r in table(
      folder / "leaderboard.parquet",
      ["arl0_alarms", "arl0", "arl0_low", "arl0_high", "control_s", *SCORED],
    )
    if not r["reference"]
  ]
  alarms = statistics.mode(r["arl0_alarms"] for r in rows)
  like = next(r for r in rows if r["arl0_alarms"] == alarms)
  asked = {r["robot"]: 3600 / r["control_s"] / meta["arl0_target"] for r in rows}
  (low, high), minutes = meta["seeds"]["score"], meta["wall_s"] / 60
  text = fill(f"""
      Thresholds at ARL0 = {number(meta["arl0_target"])} control steps, calibrated on {number(alarms * like["arl0"])} healthy steps for each robot ({alarms} alarms for most: ARL0
      {number(like["arl0"])} {span((like["arl0_low"], like["arl0_high"]))}), {high - low + 1} scoring seeds; asked for are {joined([f"{number(x, 2)} ({robot})" for robot, x in sorted(asked.items())])} false alarms
      an hour. Score as on the default leaderboard: 0 for never alarming, 100 for alarming at the onset and at no other time; detectors that score above 0. Best on each robot: {best(rows)}.
      {lead(rows, overall)} `mjx-cl leaderboard runs/streams-100k`:
      {number(meta["stream_steps"] / 1e6)} million stream-steps, {number(minutes)} minutes on {meta["machine"]["cores"]} shared core{"s" if meta["machine"]["cores"] > 1 else ""}.""")
  whole = lambda x: f"{percent(x)}%"
  marked = {
    name: own
    for name, own in mute(rows).items()
    if any(r["detector"] == name and r["cost_standard"] > 0 for r in overall)
  }
  shown = [
    (
      r["detector"] + " §" * (r["detector"] in marked),
      f"{number(r['cost_standard'])} {span((r['cost_standard_low'], r['cost_standard_high']))}",
      number(held[r["detector"]]) if r["detector"] in held else "-",
      whole(r["detected_within_5s"]),
      whole(r["miss_probability"]),
      number(r["false_alarms_per_hour"], 1),
    )
    for r in overall
    if r["cost_standard"] > 0
  ]
  return (
    text
    + "\n\n"
    + grid(
      ("detector", "score [95 %]", "at ARL0 10,000", "within 5 s", "missed", "false alarms/h"),
      shown,
    )
    + (f"\n\n{fill(never_note(marked))}" if marked else "")
  )


def speed(results: pathlib.Path, stem: str, lines) -> str:
  """A table of speeds: `lines` of (words, names of rows that share a cell, unit, digits), a column
  for each machine: STEM.json and STEM_*.json.

  A value that misses its goal is marked. A row that a machine's file lacks is a dash there; one
  that no file has is an error. lines None: every row of the first file.
  """
  benches = [Bench(results / f"{stem}.json")] + [
    Bench(path) for path in sorted(results.glob(f"{stem}_*.json"))
  ]
  lines = lines or [(name, (name,), row["unit"], None) for name, row in benches[0].rows.items()]

  def cell(bench, names, digits):
    have = [bench.rows.get(name) for name in names]
    return (
      " / ".join(
        "-"
        if r is None
        else short(r["value"], digits) + (" (missed)" if r["holds"] is False else "")
        for r in have
      )
      if any(have)
      else "-"
    )

  def goal(names):
    found = [
      next((b.rows[name]["goal"] for b in benches if b.rows.get(name, {}).get("goal")), None)
      for name in names
    ]
    return " / ".join(g or "-" for g in found) if any(found) else ""

  rows = []
  for words, names, unit, digits in lines:
    for name in names:
      if not any(name in b.rows for b in benches):
        benches[0].row(name)
    rows.append((words, unit, *(cell(b, names, digits) for b in benches), goal(names)))
  files = ", ".join(f"[{b.path.name}](results/{b.path.name})" for b in benches)
  said = (
    f"`{benches[0].about['command']}`; medians, a column for each machine ({files})."
    if "command" in benches[0].about
    else ""
  )
  return (fill(said) + "\n\n" if said else "") + grid(
    ("", "unit", *(b.about.get("machine", "measured") for b in benches), "goal"), rows
  )


def short(x: float | None, digits: int | None) -> str:
  """A measured value: with so many digits, or three significant ones."""
  return (
    "-"
    if x is None
    else number(x, digits)
    if digits is not None
    else f"{x:.3g}"
    if abs(x) < 1000
    else number(x)
  )


def physics(results: pathlib.Path) -> str:
  """Speed of physics and fault layer."""
  native = lambda robot: (f"{robot}: native against MJX, batch 256",)
  return speed(
    results,
    "physics",
    [
      (
        "jitted rollout of 160 walkers, against bare mjbatch stepping of the same work",
        ("walker: jitted rollout of 160 streams against bare mjbatch",),
        "ratio",
        2,
      ),
      (
        "all faults of the walker traced, one active on every stream, against none",
        ("walker: all faults traced, one active per stream, against none",),
        "ratio",
        2,
      ),
      ("native against MJX on the same cores, batch 256: walker", native("walker"), "ratio", 0),
      ("quadruped", native("quadruped"), "ratio", 1),
      ("`car_real`", native("car_real"), "ratio", 2),
      (
        "`car` / `car_real` with lidar, 160 streams",
        ("car: 160 streams with lidar", "car_real: 160 streams with lidar"),
        "control steps/s",
        0,
      ),
      (
        "largest rise of the cost per stream from 16 to 64, 256 and 1,024 walkers",
        ("walker: largest rise of the cost from one of these sizes to the next",),
        "ratio",
        2,
      ),
    ],
  )


def dreamer(results: pathlib.Path) -> str:
  """Speed of the learner."""
  share = lambda size: (f"update {size}, share of the matrix rate",)
  seeds = lambda how, more="": (f"ten seeds {how}{more}, per seed / one seed alone",)
  acting = tuple(
    f"acting, 40 streams, {whose}, per control step" for whose in ("one agent", "an agent each")
  )
  watching = tuple(
    f"monitor, 40 streams, {whose}, share of the matrix rate"
    for whose in ("one agent", "an agent each")
  )
  lines = [
    (
      "update size1m, 16 x 64, 15 imagined from 1,024 states",
      ("update size1m, 1,024 starts",),
      "ms",
      0,
    ),
    ("that, share of the matrix rate", share("size1m"), "share", 2),
    (
      "update size1m, 256 starts (preset `cpu`)",
      ("update size1m, 256 starts (preset cpu)",),
      "ms",
      0,
    ),
    ("update size12m", ("update size12m",), "ms", 0),
    ("that, share of the matrix rate", share("size12m"), "share", 2),
    (
      "ten seeds in one program, one device: per seed, against one seed alone",
      seeds("in one program (lax.map)"),
      "ratio",
      2,
    ),
    (
      "ten seeds, a share for each core (`train --seeds`): the same",
      seeds("a share for each core"),
      "ratio",
      2,
    ),
    ("the same, 256 starts", seeds("a share for each core", ", 256 starts"), "ratio", 2),
    ("acting, 40 streams of one agent / with an agent each, per control step", acting, "ms", 2),
    (
      "monitor, 40 streams of one agent / with an agent each, share of the matrix rate",
      watching,
      "share",
      2,
    ),
  ]
  lines += [
    (f"compile {name}, cold / cached", (f"compile {name}, cold", f"compile {name}, cached"), "s", 1)
    for name in ("update", "monitor", "rollout")
  ]
  return speed(
    results,
    "dreamer_update",
    [*lines, ("float32 product of two 2,048 x 2,048 matrices", ("matrix rate",), "GFLOP/s", 0)],
  )


TROTS = ("", "-2", "-3")  # ends of the names of the quadrupeds that trot
GOALS = {"velocity_error_m_s": 0.25, "fall_rate": 0.05}  # of the quadruped's agents


def agents(results: pathlib.Path) -> str:
  """The shipped agents: what training cost, and what evaluation gave."""

  def trained(name, curve="curve"):
    last = table(results / name / f"{curve}.parquet", ["updates", "records", "seconds"])[-1]
    return (
      f"{number(round(last['updates'], -2))} updates, {number(last['records'] / 1e6, 1)} M "
      f"records, {number(last['seconds'] / 60)} minutes"
    )

  def driving(e):
    return (
      f"{percent(e['collision_rate'])} % {percents(e['collision_rate_ci'], 1)} collide; "
      f"{both(e, 'mean_speed_m_s', 2)} m/s along the track; "
      f"reference driver, same starts: {number(e['reference_speed_m_s'], 2)} m/s, return "
      f"{number(e['reference_return'])}, "
      f"{e['reference_collisions']} collide"
    )

  def walking(e):
    late = {k: ", missed" if e[k] > goal else "" for k, goal in GOALS.items()}
    return (
      f"{both(e, 'velocity_error_m_s', 3)} m/s off the commanded planar velocity (goal "
      f"{GOALS['velocity_error_m_s']:g}"
      f"{late['velocity_error_m_s']}); {percent(e['fall_rate'])} % "
      f"{percents(e['fall_rate_ci'])} fall (goal {percent(GOALS['fall_rate'])}"
      f"{late['fall_rate']})"
    )

  trotting = lambda e: (
    f"{walking(e)}; reference driver, same starts: {number(e['reference_velocity_error_m_s'], 3)} "
    f"m/s, return {number(e['reference_return'])}, {e['reference_falls']} fall"
  )
  falls = lambda e: f"{e['terminations']} terminations"
  tasks = (
    ("`walker`", "walker_agent/eval.json", trained("walker_agent"), falls),
    (
      "`walker-plain`, without a demonstrator",
      "walker_learning/eval.json",
      trained("walker_learning", "then"),
      falls,
    ),
    ("`walker-2`", "walker_2_agent/eval.json", trained("walker_2_agent"), falls),
    ("`walker-3`", "walker_3_agent/eval.json", trained("walker_3_agent"), falls),
    ("`car`", "car_agent/eval.json", trained("car_agent"), driving),
    ("`car-2`", "car_2_agent/eval.json", trained("car_2_agent"), driving),
    ("`car-3`", "car_3_agent/eval.json", trained("car_3_agent"), driving),
    ("the same in `car_real`, unchanged", "car_agent/eval_car_real.json", "", driving),
    (
      "`quadruped`, without a demonstrator",
      "quadruped_agent/eval.json",
      trained("quadruped_agent", "then"),
      walking,
    ),
    *(
      (
        f"`quadruped-trot{end}`",
        f"quadruped_trot_agent/eval{end}.json",
        trained("quadruped_trot_agent", f"curve{end}"),
        trotting,
      )
      for end in TROTS
    ),
    ("`quadruped-cloned`", "quadruped_cloned/eval.json", trained("quadruped_cloned"), walking),
  )
  rows = []
  for name, file, training, own in tasks:
    e = load(results / file)
    rows.append(
      (
        name,
        training,
        str(e["episodes"]),
        f"{number(e['return_mean'])}; {number(e['return_iqm'])} {span(e['return_ci'])}",
        own(e),
      )
    )
  return grid(
    ("agent", "training", "episodes", "return: mean; IQM [95 %]", "the task's own figures"), rows
  )


def detectors(results: pathlib.Path) -> str:
  """Speed of the detectors."""
  return speed(results, "detectors", None)


def experiments(results: pathlib.Path) -> str:
  """The paper's figures, those of mjx_cl and the difference; see paper.py. An experiment without a
  folder is named as not run.
  """
  rows, differs, heads, absent = [], {}, {}, []
  for name, experiment in paper.EXPERIMENTS.items():
    folder = results / "paper" / experiment.folder
    if not folder.is_dir():
      absent.append(f"`{name}`")
      continue
    config, summary, runs = (
      load(folder / "config.json"),
      load(folder / "summary.json"),
      table(folder / "runs.parquet"),
    )
    events = table(folder / "events.parquet")
    heads[name] = (
      f"`{name}`: {experiment.protocol}; paper {experiment.runs}, here "
      f"{summary['arms']['detector']['seeds']} seeds"
    )
    differs[name] = paper.setup(experiment, config)
    rows += [(name, k, line) for k, line in enumerate(paper.compare(name, config, runs, events))]
  if not rows:
    raise FileError(
      f"{results / 'paper'} holds no experiment; run mjx-cl bench paper --publish "
      f"{results / 'paper'}"
    )
  common = [
    words
    for words in next(iter(differs.values()))
    if all(words in other for other in differs.values())
  ]
  text = fill(f"""
      Arm `detector`; round brackets name the paper's section. Times are median control steps, a stream that never gets there counted as infinite; shares are
      interquartile means. 95 % intervals: bootstrap over streams, Wilson for counts, all for the one agent of an experiment; `-`: not reached.
      {f"Everywhere other than in the paper: {'; '.join(common)}." if common else ""}
      {f"Not run to its end yet: {joined(absent)}." if absent else ""}""")
  own = {
    name: "; ".join(words for words in differs[name] if words not in common) for name in differs
  }
  return (
    text
    + "\n\n"
    + grid(
      ("experiment", "what", "paper", "mjx_cl", "difference", "set-up other than the paper's"),
      [(heads[name] if not k else "", *line, own[name] if not k else "") for name, k, line in rows],
    )
  )


def arms(results: pathlib.Path, suite: str = "paper", beside: dict | None = None) -> str:
  """The arms of a suite side by side, of the paper's: recovery, what it is worth, what it cost.
  `beside`: entries of another suite that come first.
  """
  rows, pairs, entries = [], [], load(results / suite / "bench.json")["entries"]
  for part, entry in [*(beside or {}).items(), *entries.items()]:
    scores = entry["scores"]
    for k, (arm, own) in enumerate(entry["arms"].items()):
      back, worth = scores["recovery"][arm], (scores["normalised"] or {}).get(arm)
      rows.append(
        (
          f"`{part}`" if not k else "",
          arm,
          f"{back['recovered']} of {back['n']}" if back else "none affected",
          both(back, "median_steps") if back else "-",
          both(back, "restricted_mean_steps") if back else "-",
          few(worth, "normalised", worth["seeds"], 2) if worth and worth["seeds"] else "-",
          number(own["updates_mean"]),
          number(own["terminations_mean"], 1),
        )
      )
    pair = scores["against_oracle"]
    if part in entries and pair and pair["seeds"]:
      holds = {
        True: "the interval holds 0",
        False: "the interval does not hold 0",
        None: "no interval",
      }[pair["holds_zero"]]
      pairs.append(f"{part} {both(pair, 'difference', 2)}, {pair['seeds']} seeds, {holds}")
  text = fill(f"""
      Affected streams that recover, Kaplan-Meier's median with Brookmeyer and Crowley's interval, restricted mean up to 10,000 steps or to 2,000 steps before the first
      stream's next change or end; normalised recovery over the last 2,000 steps before the next change (0: arm `none`, 1: the reward before onset), interquartile mean with its bootstrap
      interval; updates and falls or crashes a stream, means. {FEW if any(" to " in cell for row in rows for cell in row) else ""} {f"Method minus oracle trigger, paired over seeds: {'; '.join(pairs)}." if pairs else ""}""")
  return (
    text
    + "\n\n"
    + grid(
      (
        "experiment",
        "arm",
        "recovered",
        "median [steps]",
        "restricted mean [steps]",
        "normalised recovery",
        "updates",
        "falls",
      ),
      rows,
    )
  )


def other_arms(results: pathlib.Path) -> str:
  """`arms` of the suite of that name, beside those of the paper's walker where these are of as many
  seeds.
  """
  entries = load(results / "arms" / "bench.json")["entries"]
  walker = load(results / "paper" / "bench.json")["entries"]["walker"]
  seeds = {own["seeds"] for entry in (walker, *entries.values()) for own in entry["arms"].values()}
  return arms(results, "arms", {"paper/walker": walker} if len(seeds) == 1 else None)


def stop_rule(results: pathlib.Path) -> str:
  """When the stop rule ended finetuning, against the oracle stop; and when it would have with a
  signal left out.
  """
  from mjx_cl.scoring import normalised_recovery

  rows, without, floorless, first = [], [], [], None
  stopped = lambda own: (
    f"{own['converged']} of {own['adaptations']}",
    str(own["aborted"]),
    both(own, "own_stop_steps_median"),
    f"{own['early']} of {own['judged']}",
    "-"
    if own["lost_share"] is None
    else f"{percent(own['lost_share'], 1)} {percents(own['lost_share_ci'], 1)} %",
  )

  def alike(left_out):
    """Signals left out with the same outcome share a row."""
    rows: dict[tuple, tuple[list, dict]] = {}
    for name, own in left_out.items():
      rows.setdefault(stopped(own), ([], own))[0].append(f"`{name}`" if name else "none")
    return [(joined(names).replace(" and ", " or "), own) for names, own in rows.values()]

  for part, entry in load(results / "stop" / "bench.json")["entries"].items():
    first = first or entry["stop_rule"]
    for arm, own in entry["stop_rule"]["arms"].items():
      rows.append(
        (
          f"`{part}`",
          arm,
          f"{own['ended']} of {own['adaptations']}",
          both(own, "steps_after_oracle_median"),
          f"{own['early']} of {own['ended']}",
          both(own, "return_lost"),
          f"{percent(own['lost_share'], 1)} {percents(own['lost_share_ci'], 1)} %",
          both(own, "updates_wasted_mean"),
          f"{own['aborted_unrecoverable']} / {own['aborted_recoverable']}",
          str(own["ended_unrecoverable"]),
        )
      )
    for k, (names, own) in enumerate(alike(entry["scores"]["ablation"])):
      without.append((f"`{part}`" if not k else "", names, *stopped(own)))
    for patience, left_out in entry["scores"]["without_floor"].items():
      for k, (names, own) in enumerate(alike(left_out)):
        floorless.append(
          (
            f"`{part}`" if not k else "",
            number(CHUNK * int(patience)) if not k else "",
            names,
            *stopped(own),
          )
        )
  text = fill(f"""
      The oracle stop is the earliest snapshot whose frozen episodes on the faulty robot reach {percent(first["share"])} % of the best snapshot's. Medians and
      interquartile means with 95 % bootstrap intervals over streams; an adaptation that never ended counts as later than all others. Return lost is the best
      snapshot's reward less that of the stop, over {number(first["horizon_steps"])} control steps, and as a share of the former: an upper bound, since the best of many noisy snapshots is the luckiest too. An abort is
      right where no arm has won back {percent(normalised_recovery.HALF)} % of the loss by the end of the run, {number(entry["steps"] - entry["onset"])} steps after the onset.""")
  more = fill("""
      The rule replayed over the recorded signals of the adaptations that never stop, with each signal left out: how many converge, abort, and
      when.""")
  return "\n\n".join(
    [
      text,
      grid(
        (
          "fault",
          "arm",
          "ended",
          "steps after the oracle stop",
          "earlier than it",
          "return lost",
          "share of the best",
          "updates wasted (mean)",
          "aborts right / wrong",
          "ended on a lost fault",
        ),
        rows,
      ),
      more,
      grid(
        (
          "fault",
          "left out",
          "converged",
          "aborted",
          "median stop [steps]",
          "earlier than the oracle",
          "share of the best lost",
        ),
        without,
      ),
      fill("""
      The same without the floor (`--adapt.least 1`), so that nothing but the signals decides, over shorter and shorter lengths in which they must be settled."""),
      grid(
        (
          "fault",
          "settled over [steps]",
          "left out",
          "converged",
          "aborted",
          "median stop [steps]",
          "earlier than the oracle",
          "share of the best lost",
        ),
        floorless,
      ),
    ]
  )


def oracle_stop(results: pathlib.Path) -> str:
  """Finetuning that ended by the rule beside finetuning that ended at the oracle stop, both lived
  to the end of the run.
  """
  from mjx_cl.scoring import intervals

  rows, told = [], "oracle-stop"
  plan, entries = (load(results / "oracle_stop" / name) for name in ("suite.json", "bench.json"))
  for part, entry in entries["entries"].items():
    own = {(r["arm"], r["seed"]): r for r in table(results / "oracle_stop" / part / "runs.parquet")}
    lived = plan["parts"][part]["steps"] - plan["parts"][part]["onset"]
    seeds = sorted({seed for arm, seed in own})
    got = {
      key: r["reward_pre"] * lived - r["return_lost"] for key, r in own.items()
    }  # a stream's return from the onset to the end of the run
    for k, (arm, summary) in enumerate(entry["arms"].items()):
      adapted = [own[arm, seed]["adapted_steps"] for seed in seeds]
      less = [(got[told, seed] - got[arm, seed]) / got[told, seed] for seed in seeds]
      rows.append(
        (
          f"`{part}`" if not k else "",
          f"`{arm}`",
          "-"
          if arm == "none"
          else (
            f"{number(intervals.censored_median(adapted))} "
            f"{span(intervals.interval(adapted, intervals.censored_median))}"
          ),
          number(summary["updates_mean"]),
          f"{summary['recovered']} of {summary['affected']}",
          both(summary, "reward_final", 2),
          averaged([own[arm, seed]["return_lost"] for seed in seeds]),
          "-" if arm == told else f"{averaged([100 * x for x in less], 1)} %",
        )
      )
  text = fill(f"""
      `mjx-cl bench benchmarks/oracle_stop.toml`: both arms finetune from the true onset; `oracle` ends by the rule, `oracle-stop` at the oracle stop that suite `stop` found for the same seed. Control steps of finetuning, median; updates a
      stream; affected streams that recover before the run ends; reward a step over the last 2,000 steps (interquartile mean); return lost from the onset to the end of the run, {number(lived)} steps, a stream's mean; and how much less return than `oracle-stop` an
      arm has from the onset on, as a share of the latter's, paired over the seeds: below 0 it has more. 95 % bootstrap intervals over streams.""")
  return (
    text
    + "\n\n"
    + grid(
      (
        "fault",
        "arm",
        "finetuned [steps]",
        "updates",
        "recovered",
        "reward at the end",
        "return lost",
        "less return than `oracle-stop`",
      ),
      rows,
    )
  )


def expert(results: pathlib.Path) -> str:
  """The paper's walker measured against an expert, and what that expert is worth."""
  from mjx_cl.scoring import normalised_recovery

  folder, lived = (
    results / "expert" / "walker",
    table(results / "paper" / "walker" / "runs.parquet"),
  )
  config, runs = (
    load(folder / "config.json"),
    {(r["arm"], r["seed"]): r for r in table(folder / "runs.parquet")},
  )
  arm = next(a for a in config["arms"] if a != "none")
  seeds = sorted(seed for a, seed in runs if a == arm)
  by = {
    word: {(r["arm"], r["seed"]): r for r in normalised_recovery.rows(lived, reference)}
    for word, reference in (
      ("before", None),
      ("expert", [r for (a, _), r in runs.items() if a == arm]),
    )
  }
  rows = []
  for seed in seeds:
    of = lambda word, name, column="normalised": number(
      by[word].get((name, seed), {}).get(column), 2
    )
    final = lambda name: of("before", name, "reward_final")
    rows.append(
      (
        str(seed),
        runs[arm, seed]["fault"].split(":")[-1],
        of("before", "none", "reward_pre"),
        final("none"),
        final("detector"),
        final("oracle"),
        number(runs[arm, seed]["reward_final"], 2),
        number(runs["none", seed]["reward_final"], 2),
        of("before", "detector"),
        of("expert", "detector"),
        of("before", "oracle"),
        of("expert", "oracle"),
        number(runs[arm, seed]["updates"]),
      )
    )
  shots = [r for r in table(folder / "snapshots.parquet") if r["arm"] == arm]
  every = config["snapshots"]
  at = sorted({every * round(r["since_start"] / every) for r in shots})
  curve = {(r["seed"], every * round(r["since_start"] / every)): r["reward_mean"] for r in shots}
  text = fill(f"""
      Expert: finetuning from the true onset at train ratio {config["adapt"]["ratio"]:g} for {number(config["adapt"]["budget"])} steps (`mjx-cl bench benchmarks/expert.toml`). Reward a step before the onset and over the last
      2,000 steps of each arm of `paper/walker`, of the expert, and of its pair that never adapts and lives as long; normalised recovery of arms `detector` and `oracle`, with the reward before the onset as 1 and with the expert's last reward as 1; updates of
      the expert. Single seeds, no intervals.""")
  more = fill(f"""
      Reward a step of the expert's weights by the time it has finetuned, as it was when that began (0) and every {number(every)} steps: {len([k for k in shots[0] if k.startswith("return_")])} episodes each on the broken robot, weights frozen.""")
  return "\n\n".join(
    [
      text,
      grid(
        (
          "seed",
          "joint",
          "before",
          "`none`",
          "`detector`",
          "`oracle`",
          "expert",
          "`none`, as long",
          "`detector`, of before",
          "`detector`, of expert",
          "`oracle`, of before",
          "`oracle`, of expert",
          "updates",
        ),
        rows,
      ),
      more,
      grid(
        ("seed", *map(number, at)),
        [(str(seed), *(number(curve.get((seed, t)), 2) for t in at)) for seed in seeds],
      ),
    ]
  )


def rollback(results: pathlib.Path) -> str:
  """Aborts that keep what was learnt beside aborts that take it back where it earned less, on the
  same seeds.
  """

  rows, folder = [], results / "rollback"
  plan, entries = (load(folder / name) for name in ("suite.json", "bench.json"))
  for part, entry in entries["entries"].items():
    own = {(r["arm"], r["seed"]): r for r in table(folder / part / "runs.parquet")}
    back = sum(
      e["kind"] == "rollback" for e in table(folder / part / "events.parquet")
    )  # an aborted stream begins no other finetuning: at most one of each
    seeds = sorted({seed for arm, seed in own})
    one = plan["parts"][part]
    name = (
      f"`{one['env']}`, `{one['fault']}`"
      + ("" if named(one["fault"]) else f" {one['severity']:g}")
      + f", {len(seeds)} seeds"
    )
    for k, (arm, summary) in enumerate(entry["arms"].items()):
      over = lambda other: (
        "-"
        if arm in (other, "none")
        else averaged(
          [own[arm, seed]["reward_final"] - own[other, seed]["reward_final"] for seed in seeds], 2
        )
      )
      rows.append(
        (
          name if not k else "",
          f"`{arm}`",
          "-" if arm == "none" else str(summary["aborted_by_rule"] + summary["aborted_by_budget"]),
          str(back) if arm == "rollback" else "-",
          both(summary, "reward_final", 2),
          over("none"),
          over("detector"),
          averaged([own[arm, seed]["return_lost"] for seed in seeds]),
          averaged([own[arm, seed]["terminations"] for seed in seeds], 1),
        )
      )
  gone = (
    joined([f"`{part}`" for part in plan["parts"] if part not in entries["entries"]])
    if len(entries["entries"]) < len(plan["parts"])
    else ""
  )
  text = fill(f"""
      `mjx-cl bench benchmarks/rollback.toml`: the arms side by side on the same seeds. Streams whose finetuning is aborted, by the rule or its budget; those of them that go back to the weights of before;
      reward a step over the last 2,000 steps (interquartile mean); that reward less that of the same seed in arm `none` and in arm `detector` (means); return lost from the onset to the end of the run and falls,
      a stream's mean. 95 % bootstrap intervals over streams. {f"Not run yet: {gone}." if gone else ""}""")
  return (
    text
    + "\n\n"
    + grid(
      (
        "fault",
        "arm",
        "aborted",
        "taken back",
        "reward at the end",
        "minus `none`",
        "minus `detector`",
        "return lost",
        "falls",
      ),
      rows,
    )
  )


def again(results: pathlib.Path) -> str:
  """A fault, its repair, the same fault once more: what each arm does at each of the three."""
  rows, words = [], ("the fault", "its repair", "the fault again")
  entries = load(results / "again" / "bench.json")["entries"]
  for part, entry in entries.items():
    for _, (what, arms_) in enumerate(zip(words, [entry["arms"], *entry["later_changes"]])):
      for k, (arm, own) in enumerate(arms_.items()):
        rows.append(
          (
            f"`{part}`, {what}" if not k else "",
            arm,
            alarmed(own),
            both(own, "latency_median_steps"),
            f"{own['recovered']} of {own['affected']}",
            both(own, "recovery_median_steps"),
            both(own, "reward_pre", 2),
            both(own, "reward_final", 2),
            number(own["updates_mean"]),
          )
        )
  text = fill("""
      Streams that alarm and when; affected streams (whose reward falls by a tenth; after the first change judged by the stream's own first 2,000 steps) that
      recover and when; reward a step before the change and over the last 2,000 steps before the next one; updates a stream. Medians are censored, rewards interquartile means, with 95 %
      bootstrap intervals over streams.""")
  return (
    text
    + "\n\n"
    + grid(
      (
        "change",
        "arm",
        "alarm",
        "after [steps]",
        "recovered",
        "median [steps]",
        "reward before",
        "reward at the end",
        "updates",
      ),
      rows,
    )
  )


def study(results: pathlib.Path) -> str:
  """Recovery against train ratio and severity from a known onset."""
  rows = []
  plan = load(results / "study" / "suite.json")["parts"]
  entries = load(results / "study" / "bench.json")["entries"]
  for part, entry in sorted(
    entries.items(), key=lambda x: (plan[x[0]]["severity"], plan[x[0]]["adapt"]["ratio"])
  ):
    for arm, back in entry["scores"]["recovery"].items():
      if not entry["arms"][arm]["updates_mean"]:
        continue
      own, worth = entry["arms"][arm], (entry["scores"]["normalised"] or {}).get(arm)
      rows.append(
        (
          f"{plan[part]['severity']:g}",
          f"{plan[part]['adapt']['ratio']:g}",
          str(own["seeds"]),
          f"{back['recovered']} of {back['n']}" if back else "none affected",
          both(back, "restricted_mean_steps") if back else "-",
          few(worth, "normalised", worth["seeds"], 2) if worth and worth["seeds"] else "-",
          number(own["updates_mean"]),
        )
      )
  from mjx_cl.scoring import normalised_recovery

  lived = table(results / "study" / "bench.parquet")
  pairs, severities = [], sorted({plan[p]["severity"] for p in entries})
  for severity in severities:
    ratios = sorted({plan[p]["adapt"]["ratio"] for p in entries if plan[p]["severity"] == severity})
    scored = [
      r | {"arm": ratio}
      for p in entries
      for ratio in ratios
      if (plan[p]["severity"], plan[p]["adapt"]["ratio"]) == (severity, ratio)
      for r in normalised_recovery.rows([r for r in lived if r["part"] == p])
      if r["arm"] != "none"
    ]
    for low, high in zip(ratios, ratios[1:]):
      pair = normalised_recovery.difference(scored, high, low)
      if pair["seeds"] > 3:
        holds = "the interval holds 0" if pair["holds_zero"] else "the interval does not hold 0"
        pairs.append(
          f"{high:g} minus {low:g} at {severity:g}: {both(pair, 'difference', 2)}, "
          f"{pair['seeds']} seeds, {holds}"
        )
  done = f"{len(entries)} of {len(plan)} parts are finished." if len(entries) < len(plan) else ""
  gone = joined([f"`{part}`" for part in plan if part not in entries]) if done else ""
  text = fill(f"""
      Finetuning from the true onset for a fixed time ({", ".join(sorted({plan[p]["env"] + ", " + plan[p]["fault"] for p in entries}))}): affected streams that recover, restricted
      mean time to recovery, normalised recovery over the last 2,000 steps (0: no adaptation, 1: the reward before onset), updates a stream. {FEW if any(" to " in cell for row in rows for cell in row) else ""} {f"Paired over seeds, ratio {'; '.join(pairs)}." if pairs else ""} {done and f"{done} Missing: {gone}."}""")
  return (
    text
    + "\n\n"
    + grid(
      (
        "severity",
        "train ratio",
        "seeds",
        "recovered",
        "restricted mean [steps]",
        "normalised recovery",
        "updates",
      ),
      rows,
    )
  )


def sizes(results: pathlib.Path) -> str:
  """Recovery against the model's size from a known onset."""
  folder, rows = results / "size", []
  plan, entries = load(folder / "suite.json")["parts"], load(folder / "bench.json")["entries"]
  done = [(folder, part, plan[part], entries[part]) for part in plan if part in entries]
  others, lived_there, alike = (
    load(results / "study" / "suite.json")["parts"],
    load(results / "study" / "bench.json")["entries"],
    ("env", "fault", "target", "severity", "onset", "steps"),
  )
  for part, one in others.items():  # the study's own, with the shipped agent
    if part in lived_there and any(
      [one.get(k) for k in alike] == [p.get(k) for k in alike]
      and one["adapt"]["ratio"] == p["adapt"]["ratio"]
      for *_, p, _ in done
    ):
      done.append((results / "study", part, one, lived_there[part]))
  for where, part, one, entry in sorted(
    done,
    key=lambda x: list(SIZES).index(
      load(x[0] / x[1] / "config.json")["agent_card"]["dreamer"]["size"]
    ),
  ):
    card, own = load(where / part / "config.json")["agent_card"], entry["arms"]
    (arm,) = (name for name in own if name != "none")
    back, worth = entry["scores"]["recovery"][arm], (entry["scores"]["normalised"] or {}).get(arm)
    healthy, lived = card["eval"], own[arm]
    rows.append(
      (
        f"`{card['dreamer']['size']}`",
        number(card["updates"]),
        f"{number(healthy['return_iqm'])} {span(healthy['return_ci'])}",
        f"{one['adapt']['ratio']:g}",
        str(lived["seeds"]),
        f"{back['recovered']} of {back['n']}" if back else "none affected",
        both(back, "restricted_mean_steps") if back else "-",
        few(worth, "normalised", worth["seeds"], 2) if worth and worth["seeds"] else "-",
        both(lived, "reward_pre", 2),
        both(own["none"], "reward_final", 2),
        both(lived, "reward_final", 2),
        number(lived["updates_mean"]),
      )
    )
  gone = (
    joined([f"`{part}`" for part in plan if part not in entries])
    if len(entries) < len(plan)
    else ""
  )
  text = fill(f"""
      Finetuning from the true onset for {number(one["steps"] - one["onset"])} steps ({one["env"]}, {one["fault"]}, {one["target"]}, severity {one["severity"]:g}), one agent of each size. Updates and healthy
      return (interquartile mean of {healthy["episodes"]} episodes) of its training; affected streams that recover, restricted mean time to recovery, normalised recovery over the last 2,000 steps (0: no
      adaptation, 1: the reward before onset); reward a step before the onset, and over the last 2,000 steps without adaptation and with it (interquartile means of all streams); updates a stream.
      {FEW if any(" to " in cell for row in rows for cell in row) else ""} {f"Not run yet: {gone}." if gone else ""}""")
  return (
    text
    + "\n\n"
    + grid(
      (
        "size",
        "training",
        "healthy return",
        "train ratio",
        "seeds",
        "recovered",
        "restricted mean [steps]",
        "normalised recovery",
        "reward before",
        "at the end, `none`",
        "at the end",
        "updates",
      ),
      rows,
    )
  )


def full(results: pathlib.Path) -> str:
  """Fault by fault what the method does, of the finished parts of suite `full`, and how complete it
  is.
  """
  from mjx_cl.scoring import intervals

  folder = results / "full"
  plan, entries = load(folder / "suite.json")["parts"], load(folder / "bench.json")["entries"]
  lived = table(
    folder / "bench.parquet",
    ["part", "arm", "seed", "affected", "alarm_step", "reward_pre", "reward_final"],
  )

  def left(part, arm):
    """Reward of the affected streams over the last 2,000 steps as a share of that before the onset."""
    shares = [
      r["reward_final"] / r["reward_pre"]
      for r in lived
      if (r["part"], r["arm"]) == (part, arm) and r["affected"]
    ]
    return f"{percent(intervals.iqm(shares))} %" if shares else "-"

  rows, last = [], None
  for part in (p for p in plan if p in entries):  # in the order of the suite
    one, own, none = plan[part], entries[part]["arms"]["detector"], entries[part]["arms"]["none"]
    worth = (entries[part]["scores"]["normalised"] or {}).get("detector")
    of = lambda arm, name: f"{arm[name]} of {arm['affected']}" if arm["affected"] else "-"
    rows.append(
      (
        f"`{one['env']}`" if one["env"] != last else "",
        f"`{one['fault']}`" + ("" if named(one["fault"]) else f" {one['severity']:g}"),
        f"{own['affected']} of {own['seeds']}",
        str(own["false_alarm_streams"]),
        alarmed(own),
        soon(own),
        both(own, "latency_median_steps"),
        of(none, "recovered"),
        of(own, "recovered"),
        left(part, "none"),
        left(part, "detector"),
        few(worth, "normalised", worth["seeds"], 2) if worth and worth["seeds"] else "-",
        (
          f"{own['converged']} / {own['aborted_by_rule'] + own['aborted_by_budget']} / "
          f"{own['adapting']}"
        ),
        number(own["updates_mean"]),
      )
    )
    last = one["env"]
  robots = {}
  for part in plan:
    robots.setdefault(plan[part]["env"], []).append(part in entries)
  done = ", ".join(f"`{name}` {sum(have)} of {len(have)}" for name, have in robots.items())
  hit, back, alone = (
    sum(entries[p]["arms"][arm][what] for p in plan if p in entries)
    for arm, what in (("detector", "affected"), ("detector", "recovered"), ("none", "recovered"))
  )
  first = {
    (p, r["seed"])
    for p in plan
    if p in entries
    for r in lived
    if r["part"] == p and r["arm"] == "detector" and r["affected"] and r["alarm_step"] is not None
  }
  text = fill(f"""
      Of {hit} affected streams {len(first)} alarm; {back} recover in arm `detector`, {alone} in arm `none`. {len(entries)} of {len(plan)} parts of suite `full` are finished ({done}), seeds {one["first_seed"]} to {one["first_seed"] + one["seeds"] - 1}. Affected streams; streams with a false alarm
      before the onset; streams that alarm after it, of those not adapting to a false one by then; affected ones that do within 500 steps; their median latency, misses counted as infinite; affected streams
      recovered before the run ends, without and with finetuning; their reward over the last 2,000 steps over that before the onset (interquartile mean); normalised recovery (0: arm
      `none`, 1: the reward before onset, interquartile mean with 95 % bootstrap interval over the streams that end a tenth or more below it without adaptation); finetunings that converge / are aborted / still run, those begun by a false alarm included; updates a stream. {FEW if any(" to " in cell for row in rows for cell in row) else ""}""")
  return (
    text
    + "\n\n"
    + grid(
      (
        "robot",
        "fault, severity",
        "affected",
        "false alarms",
        "alarm",
        "within 500",
        "latency [steps]",
        "recovered, `none`",
        "recovered",
        "reward left, `none`",
        "reward left",
        "normalised recovery",
        "converged / aborted / still running",
        "updates",
      ),
      rows,
    )
  )


def in_loop(results: pathlib.Path) -> str:
  """The same robots, faults and seeds with one detector or another in the loop: what an earlier
  alarm is worth.
  """
  folder = results / "loop"
  plan, entries = load(folder / "suite.json")["parts"], load(folder / "bench.json")["entries"]
  parts = [
    p for p in plan if p in entries
  ]  # in the order of the suite; the first of a robot is what its others are set against
  of = lambda arm, name: f"{arm[name]} of {arm['affected']}" if arm["affected"] else "-"
  lost, begun, base, rows = {}, {}, {}, []
  for part in parts:
    own = {
      (r["arm"], r["seed"]): r for r in table(folder / part / "runs.parquet") if not r["change"]
    }
    for (arm, seed), r in own.items():
      still = own["none", seed][
        "reward_pre"
        # one measure for both: a false alarm cuts short what a stream's own reward before the onset
        # is a mean of
      ]
      if None not in (r["return_lost"], r["reward_pre"], still):
        lost.setdefault((part, arm), {})[seed] = r["return_lost"] + (still - r["reward_pre"]) * (
          plan[part]["steps"] - r["onset"]
        )
    begun[part] = sum(
      e["kind"] == "start"
      for e in table(folder / part / "events.parquet")
      if e["arm"] == "detector"
    )
  for part in parts:
    one, own, worth = (
      plan[part],
      entries[part]["arms"]["detector"],
      (entries[part]["scores"]["normalised"] or {}).get("detector"),
    )
    new, mine = one["env"] not in base, lost.get((part, "detector"), {})
    first = lost.get((base.setdefault(one["env"], part), "detector"), {})
    if new:  # arm `none` lives the same life whatever watches it
      none = entries[part]["arms"]["none"]
      rows.append(
        (
          f"`{one['env']}`",
          "none",
          "",
          "",
          "",
          "",
          of(none, "recovered"),
          of(none, "recovered_within_10000"),
          "",
          averaged([*lost.get((part, "none"), {}).values()]),
          "",
          "",
          "",
          "",
        )
      )
    rows.append(
      (
        "",
        f"`{one['detector']}`",
        str(own["false_alarm_streams"]),
        alarmed(own),
        soon(own),
        both(own, "latency_median_steps"),
        of(own, "recovered"),
        of(own, "recovered_within_10000"),
        few(worth, "normalised", worth["seeds"], 2) if worth and worth["seeds"] else "-",
        averaged([*mine.values()]),
        "" if new else averaged([first[seed] - mine[seed] for seed in first if seed in mine]),
        str(begun[part]),
        (
          f"{own['converged']} / {own['aborted_by_rule'] + own['aborted_by_budget']} / "
          f"{own['adapting']}"
        ),
        number(own["updates_mean"]),
      )
    )
  robots = {one["env"]: one for one in plan.values()}.values()
  seeds = sorted(
    {(one["first_seed"], one["first_seed"] + one["seeds"] - 1) for one in plan.values()}
  )
  done = f"{len(entries)} of {len(plan)} parts are finished. " if len(entries) < len(plan) else ""
  text = fill(f"""
      {done}{"; ".join(f"`{one['env']}`: `{one['fault']}` at step {number(one['onset'])} of {number(one['steps'])}" for one in robots)}; seeds {joined([f"{a} to {b}" for a, b in seeds])}. Streams with
      a false alarm before the onset; streams that alarm after it, of those not adapting to a false one by then; affected ones that do within 500 steps; their median latency, misses counted as infinite; affected streams recovered before the run ends,
      and within 10,000 steps; normalised recovery over the last 2,000 steps (0: arm `none`, 1: the reward before onset; interquartile mean); return lost from the onset to the run's end, against the reward of arm `none` before
      it, a stream's mean; how much less of it than with its robot's first detector, a mean paired over seeds (95 % bootstrap intervals over streams); finetunings begun, of all streams together; streams whose last one converged / was aborted /
      still ran; updates a stream. {FEW if any(" to " in row[8] for row in rows) else ""}""")
  return (
    text
    + "\n\n"
    + grid(
      (
        "robot",
        "detector",
        "false alarms",
        "alarm",
        "within 500",
        "latency [steps]",
        "recovered",
        "within 10,000",
        "normalised recovery",
        "return lost",
        "less",
        "begun",
        "converged / aborted / still running",
        "updates",
      ),
      rows,
    )
  )


def two_agents(results: pathlib.Path) -> str:
  """The same run with two agents that were trained apart: what carries over."""
  rows = []
  for agent, folder in (("`walker`", "walker_gear"), ("`walker-plain`", "walker_plain")):
    own = load(results / folder / "summary.json")["arms"]
    r, still = own["detector"], own["none"]
    rows.append(
      (
        agent,
        f"{r['false_alarm_streams']} of {r['seeds']}",
        f"{r['affected_alarmed_within_500']} of {r.get('affected_watched', r['affected'])}",
        both(r, "latency_median_steps"),
        f"{r['recovered_within_10000']} of {r['affected']} ({r['recovered']} in the end)",
        both(r, "reward_pre", 2),
        both(still, "reward_final_affected", 2),
        both(r, "reward_final_affected", 2),
        f"{r['converged']} of {r['seeds']}",
        number(r["updates_mean"]),
      )
    )
  text = fill("""
      `mjx-cl run walker` with each of two agents, arm `detector`: streams with a false alarm before the onset, affected streams that alarm within 500 steps, median latency of all streams (misses count as
      infinite), affected streams recovered within 10,000 steps, reward per step before the onset, and of the affected over the last 2,000 steps without adaptation and with it (interquartile means), streams
      that converged, updates a stream; 95 % bootstrap intervals over streams.""")
  return (
    text
    + "\n\n"
    + grid(
      (
        "agent",
        "false alarms",
        "alarm",
        "latency [steps]",
        "recovered",
        "reward before",
        "at the end, `none`",
        "at the end, `detector`",
        "converged",
        "updates",
      ),
      rows,
    )
  )


def methods_board(results: pathlib.Path) -> str:
  """Methods of adaptation against each other: two tables."""
  folder = results / "methods_board"
  about = load(folder / "methods.json")
  overall, rows = table(folder / "methods_overall.parquet"), table(folder / "methods.parquet")
  robots = list(dict.fromkeys(r["robot"] for r in rows))
  names = [r["method"] for r in overall]
  known = lambda ends: None if ends == [None, None] else ends
  ends = lambda r, key: known([r.get(f"{key}_low"), r.get(f"{key}_high")])
  shown = lambda r, key: f"{number(r[key], 0)} {span(ends(r, key), 0)}".strip()
  first = [
    (
      f"`{r['method']}`",
      number(r["streams"]),
      shown(r, "score"),
      *(shown(r, f"score_{robot}") for robot in robots),
      "" if r["gain"] is None else shown(r, "gain"),
      f"{r['harm']} of {r['settings']}",
      f"{r['harm_agents']} of {r['pairs']}",
      f"{number(100 * r['harm_streams'], 0)} %",
      f"{r['recovered']} of {r['affected']}",
      number(r["falls"], 1),
      number(r["updates"]),
      number(r["wall_s"]),
    )
    for r in overall
  ]
  second = []
  for robot, setting in dict.fromkeys((r["robot"], r["setting"]) for r in rows):
    own = {r["method"]: r for r in rows if (r["robot"], r["setting"]) == (robot, setting)}

    def score(name: str, own: dict = own) -> str:
      row = own.get(name)
      if row is None:
        return "-"
      fewer = row["streams"] < own["none"]["streams"]
      return shown(row, "score") + (f" ({number(row['streams'])})" if fewer else "")

    lost = f"{number(100 * own['none']['lost'], 0)} %"
    second.append(
      (setting, str(own["none"]["streams"]), lost, *(score(n) for n in names if n != "none"))
    )
  text = fill(f"""
      {about["lives"]} lives, best gain first. Score: 0 loses as much return as doing nothing, 100
      loses none, below 0 is harm; mean over a robot's settings and over robots. Gain: score less
      that of the paper's method (`detector`), on the lives of both. Harm: settings in which more is
      lost than by doing nothing, by the paired interval; by agent: pairs of a setting and an agent
      in which that agent's seeds alone say so; worse: lives that lose a tenth of the
      reward more than doing nothing on the same
      seed. Recovered: of the lives that lose a tenth without adaptation. Falls beyond those of
      doing nothing, updates and seconds of a core are of a life. Brackets: 95 %, bootstrap over
      agents and their seeds. Round brackets: lives, where a method has fewer of a setting. Scores
      of other lives do not compare, gains do.""")
  heads = ("method", "lives", "score", *robots, "gain", "harm", "by agent", "worse")
  heads = (*heads, "recovered", "falls", "updates")
  tables = [
    grid((*heads, "time [s]"), first),
    grid(("setting", "lives", "lost, `none`", *(f"`{n}`" for n in names if n != "none")), second),
  ]
  return "\n\n".join([text, *tables])


def several_agents(results: pathlib.Path) -> str:
  """The paper's fault on walkers of several agents, together and apart."""
  held = load(results / "agents" / "bench.json")
  together = held["agents"]["walker"]
  each = [(name, held["entries"][f"agent={name}"]) for name in together["agents"]]
  rows = []
  for name, entry in [(f"all {len(each)}", together), *((f"`{name}`", own) for name, own in each)]:
    own, still = entry["arms"]["detector"], entry["arms"]["none"]
    n = own["affected"]
    shares = lambda arm, n=n: percents(
      [x / n for x in arm["recovered_within_10000_ci"]]
      if arm["recovered_within_10000_ci"]
      else None
    )
    rows.append(
      (
        name,
        f"{n} of {own['seeds']}",
        f"{own['false_alarm_streams']}",
        f"{own['affected_alarmed_within_500']} of {own['affected_watched']}",
        both(own, "latency_median_steps"),
        f"{own['recovered_within_10000']} of {n} {shares(own)} %",
        f"{still['recovered_within_10000']} of {n} {shares(still)} %",
        both(own, "recovery_median_steps"),
        both(own, "reward_final_affected", 2),
        both(still, "reward_final_affected", 2),
        f"{own['converged']}",
      )
    )
  seeds = each[0][1]["arms"]["detector"]["seeds"]
  text = fill(f"""
      Seeds 0 to {seeds - 1} of each agent; arm `detector`, where `none` is not named: streams that
      lose a tenth by the fault, streams with a false alarm before it, affected ones that alarm
      within 500 steps, median latency of all streams [steps] (a miss is infinite), affected ones
      recovered within 10,000 steps, median recovery [steps], reward per step of the affected over
      the last 2,000 steps (interquartile means), streams that converged. Brackets: 95 %; of one
      agent Wilson or a bootstrap of its streams, of all a bootstrap of agents and then of their
      streams.""")
  return (
    text
    + "\n\n"
    + grid(
      (
        "agent",
        "affected",
        "false alarms",
        "alarm",
        "latency",
        "recovered",
        "recovered, `none`",
        "recovery",
        "at the end",
        "at the end, `none`",
        "converged",
      ),
      rows,
    )
  )


def raw_logs(results: pathlib.Path) -> str:
  """What `detect` finds in raw logs, and in the world model's signed errors, beside detectors of
  its residuals.
  """
  rows, shown = [], ("learnt", "multichart", "cusum")
  signed = {one["robot"]: one for one in load(results / "innovations.json")["robots"]}
  for own in load(results / "raw_logs.json")["robots"]:
    other = signed[own["robot"]]
    rows.append(
      (
        f"`{own['robot']}`",
        number(own["columns"]),
        number(own["streams"]),
        f"{percent(own['found'])} {percents(own['found_ci'])}",
        f"1 in {number(own['false_alarm_in'])} ({own['false_alarms']} seen)",
        f"{percent(other['found'])} {percents(other['found_ci'])}",
        f"1 in {number(other['false_alarm_in'])} ({other['false_alarms']})",
        *(percent(own["board"][name]) for name in shown),
      )
    )
  head = (
    "robot",
    "columns",
    "faulty logs",
    "`detect` finds [%]",
    "its false alarms, in samples",
    "in signed errors [%]",
    "false alarms",
  )
  return grid((*head, *(f"`{name}` [%]" for name in shown)), rows)


def long_logs(results: pathlib.Path) -> str:
  """Time and memory of `detect` on an hour at 1 kHz."""
  rows = [
    (
      one["kind"],
      number(one["file_gb"], 1),
      number(one["wall_s"]),
      number(one["peak_gb"] * 1e9 / 2**30, 1),
    )
    for one in load(results / "long_log.json")["logs"]
  ]
  return grid(("file", "size [GB]", "time [s]", "most memory [GiB]"), rows)


def gait(results: pathlib.Path) -> str:
  """How the quadruped's agents walk at each pace."""
  rows = []
  for file, name in (
    ("quadruped_agent/gait.json", "quadruped"),
    *((f"quadruped_trot_agent/gait{end}.json", f"quadruped-trot{end}") for end in TROTS),
  ):
    for own in load(results / file)["paces"]:
      rows.append(
        (
          f"`{name}`",
          number(own["pace_m_s"], 2),
          number(own["reward"], 2),
          number(own["velocity_error_m_s"], 2),
          f"{percent(own['fall_share'])} {percents(own['fall_share_ci'])}",
          number(own["base_height_m"], 2),
          number(100 * own["lift_m"], 1),
          number(own["diagonal"], 2),
          number(own["lateral"], 2),
        )
      )
  head = (
    "agent", "pace [m/s]", "reward a step", "off the pace [m/s]", "fall in 20 s [%]",
    "height of the base [m]", "lift of a foot [cm]", "diagonal feet", "feet of a side",
  )  # fmt: skip
  return grid(head, rows)


def gradient(results: pathlib.Path) -> str:
  """What the imagined policy gradient promises, and what the robot earns along it."""
  agents_ = load(results / "policy_gradient.json")["agents"]
  rows = []
  for own in agents_:
    still = next(r for r in own["rows"] if r["step"] == 0)
    for r in sorted(own["rows"], key=lambda r: r["step"]):
      if r["step"]:
        low, high = r["gain_ci"]
        rows.append(
          (
            f"`{own['name']}`",
            f"{r['step']:+.2f}",
            f"{r['promise']:+.4f}",
            f"{r['gain']:+.4f} [{low:+.4f}, {high:+.4f}]",
            f"{still['terminations']} -> {r['terminations']}",
          )
        )
  kinds = joined(
    sorted(
      {
        (
          f"{own['robots']} robots and {number(own['steps'])} control steps, gradient of "
          f"{own['batches']} batches"
        )
        for own in agents_
      }
    )
  )
  text = fill(f"""
      A step is the root mean square change of the policy's mean action; promise (the mean imagined advantage) and gain are in reward per control step on the healthy
      robot, the gain with 95 % bootstrap intervals over {kinds}, common keys.""")
  return (
    text
    + "\n\n"
    + grid(
      (
        "agent",
        "step along the gradient",
        "the imagined rollouts promise",
        "the robot gains",
        "terminations",
      ),
      rows,
    )
  )


def quadruped(results: pathlib.Path) -> str:
  """What finetuning gives the quadruped, beside an agent that had the faulty robot to itself."""
  folder, rows = results / "quadruped_agent" / "finetuning", []

  def read(name):
    lines = load(folder / name / "curve.json")
    return [
      statistics.mean(r["reward"] for r in lines if r["seed"] == s)
      for s in sorted({r["seed"] for r in lines})
    ], sum(r["falls"] for r in lines)

  still, falls = read("none")
  rows.append(("none", "", "", "", number(statistics.mean(still), 3), "", number(falls), ""))
  for name, what in (
    ("told", "from the onset on"),
    ("ratio64", ""),
    ("ratio64_lr3e-5", ""),
    ("average0.02", ""),
    ("average0.01_lr2e-4", ""),
    ("expert", "none; agent trained on the faulty robot"),
  ):
    reward, falls = read(name)
    more = [x - y for x, y in zip(reward, still)]
    how = ("", "", "", "")
    if name != "expert":
      adapt, (arm,) = (
        load(folder / name / "config.json")["adapt"],
        load(folder / name / "summary.json")["arms"].values(),
      )
      how = (
        number(adapt["ratio"]),
        f"{adapt['lr']:g}",
        f"{adapt['average']:g}",
        number(arm["updates_mean"]),
      )
    rows.append(
      (what, *how[:3], number(statistics.mean(reward), 3), averaged(more, 3), number(falls), how[3])
    )
  config = load(folder / "none" / "config.json")
  text = fill(f"""
      Reward per control step over the {number(config["steps"] - config["onset"])} steps from the onset on; gain over no adaptation, paired by seed, with its 95 % bootstrap interval over {len(still)} streams
      (seeds from {config["first_seed"]} on, one run each); falls of all of them; updates a stream. Average: rate per chunk of the moving average of the weights that acts.""")
  return (
    text
    + "\n\n"
    + grid(
      (
        "adaptation",
        "train ratio",
        "learning rate",
        "average",
        "reward",
        "gain",
        "falls",
        "updates",
      ),
      rows,
    )
  )


def ppo(results: pathlib.Path) -> str:
  """Model-free finetuning on the paper's walker, beside the method's arms."""
  own = load(results / "ppo_finetune.json")
  paper = load(results / "paper" / "bench.json")["entries"]["walker"]
  rows = []
  for arm, learner in (("ppo-none", "PPO, as pretrained"), ("ppo", "PPO, from the true onset")):
    r = own["arms"][arm]
    worth = (
      f"{both(r, 'normalised', 2)}, {r['affected']} seeds" if r["normalised"] is not None else "-"
    )
    rows.append(
      (
        learner,
        f"{r['recovered']} of {r['affected']}",
        both(r, "recovery_median_steps"),
        both(r, "reward_pre", 2),
        both(r, "reward_final_affected", 2),
        worth,
        number(r["updates"]),
        number(r["terminations"] / r["seeds"], 1),
      )
    )
  for arm, learner in (
    ("none", "DreamerV3, as shipped"),
    ("detector", "DreamerV3, by its own alarm"),
    ("oracle", "DreamerV3, from the true onset"),
  ):
    if arm not in paper["arms"]:
      continue
    r, worth = paper["arms"][arm], paper["scores"]["normalised"][arm]
    rows.append(
      (
        learner,
        f"{r['recovered']} of {r['affected']}",
        both(r, "recovery_median_steps"),
        both(r, "reward_pre", 2),
        both(r, "reward_final_affected", 2),
        f"{both(worth, 'normalised', 2)}, {worth['seeds']} seeds",
        number(r["updates_mean"]),
        number(r["terminations_mean"], 1),
      )
    )
  text = fill(f"""
      PPO: brax's, pretrained for {number(own["policy"]["steps"])} control steps to a return of {number(own["policy"]["return"])}, then from the onset on {own["settings"]["epochs"]} epochs of
      {own["settings"]["minibatches"]} minibatches every {number(own["settings"]["horizon"])} control steps at a learning rate of {own["settings"]["lr"]:g}; {own["arms"]["ppo"]["seeds"]} seeds,
      {number(own["steps"])} steps, {number(own["wall_s"])} s in all. The reward before the onset is that of all streams, at the end of the affected ones. Medians are censored, the rest interquartile means,
      with 95 % bootstrap intervals over streams.""")
  return (
    text
    + "\n\n"
    + grid(
      (
        "learner",
        "recovered",
        "median [steps]",
        "reward before",
        "reward at the end",
        "normalised recovery",
        "updates",
        "falls",
      ),
      rows,
    )
  )


BLOCKS = {
  "run-walker": run_walker,
  "arl0": arl0,
  "leaderboard": leaderboard,
  "leaderboard-100k": leaderboard_100k,
  "physics": physics,
  "dreamer": dreamer,
  "agents": agents,
  "detectors": detectors,
  "paper": experiments,
  "arms": arms,
  "other-arms": other_arms,
  "stop-rule": stop_rule,
  "oracle-stop": oracle_stop,
  "expert": expert,
  "rollback": rollback,
  "again": again,
  "study": study,
  "size": sizes,
  "full": full,
  "in-loop": in_loop,
  "two-agents": two_agents,
  "several-agents": several_agents,
  "methods": methods_board,
  "gradient": gradient,
  "raw-logs": raw_logs,
  "long-logs": long_logs,
  "gait": gait,
  "quadruped": quadruped,
  "ppo": ppo,
}


def catalogue(results: pathlib.Path) -> str:
  """Every fault of the package, from its docstring."""
  from mjx_cl import faults

  rows = [
    (f"`{name}`", family, *(x.replace("|", "\\|") for x in faults.said(name)))
    for family, members in faults.FAMILIES.items()
    for name in members
  ]
  return grid(("fault", "family", "what happens", "severity", "target", "owns"), rows)


def gap(results: pathlib.Path) -> str:
  """The items of the reality gap between `car` and `car_real`."""
  from mjx_cl.envs.car_real import GAP

  value = lambda x: f"{x:.4g}"
  return grid(
    ("item", "unit", "`car`", "`car_real`", "leaf", "source"),
    [
      (f"`{name}`", i.unit, value(i.simulator), value(i.real), f"`{i.leaf}`", i.source)
      for name, i in GAP.items()
    ],
  )


def schema(results: pathlib.Path) -> str:
  """The columns of a recorded set."""
  from mjx_cl.leaderboard.streams import LATENT, META, SCHEMA, SIGNED

  files = [
    ("ROBOT.parquet", SCHEMA),
    (
      "ROBOT_latents.parquet",
      {
        "stream, step": "as above",
        f"z0 .. z{LATENT - 1}": "float32, a fixed projection of the world model's latent",
      },
    ),
    (
      "ROBOT_innovations.parquet",
      {
        "stream, step": "as above",
        f"{SIGNED}NAME": "float16, signed one-step error of the world model in a variable NAME of "
        "the observation, and in the reward, in their units",
      },
    ),
    ("streams.parquet", META),
  ]
  rows = []
  for name, columns in files:
    groups = [k for k in columns if k.startswith("group_")]
    for k, (column, text) in enumerate(columns.items()):
      if column not in groups[1:]:
        kind, _, what = text.partition(", ")
        typed = re.fullmatch(r"u?int\d+|float\d+|bool|string", kind)
        rows.append(
          (
            f"`{name}`" if not k else "",
            f"`{column} .. {groups[-1]}`" if column in groups else f"`{column}`",
            *(x.replace("|", "\\|") for x in ((kind, what) if typed else ("", text))),
          )
        )
  return grid(("file", "column", "type", "what"), rows)


def sizes_table(results: pathlib.Path) -> str:
  """Parameters and bytes of every size, as `mjx-cl list sizes` has them."""
  from mjx_cl.training import needs

  rows = [
    (
      f"`{name}`",
      *(part.removesuffix(" with slow critic and moments") for part in text.split("; ")),
    )
    for name, text in needs.table().items()
  ]
  return grid(("size", "on the walker", "weights, slow critic and moments", "replay"), rows)


CODE = {
  "faults": catalogue,
  "gap": gap,
  "schema": schema,
  "sizes": sizes_table,
}  # blocks that are written from the code, by modules that need JAX


# ---- pages ---------------------------------------------------------------------------------------


class Block(NamedTuple):
  """A marked block: `first` and `last` are the lines of its markers, counted from 0."""

  name: str
  first: int
  last: int


def find(lines: list[str], where: str) -> list[Block]:
  """Marked blocks of a text in their order.

  Raises:
    FileError for a marker that is malformed, unclosed or left over, and for an unknown name.
  """
  blocks, opened = [], None
  for k, line in enumerate(lines):
    if not re.search(r"<!--\s*/?\s*report\b", line):
      continue
    here = f"{where}:{k + 1}"
    match = re.fullmatch(r"<!-- (?:report:(\S+)|/report) -->", line.rstrip("\r\n"))
    if not match:
      raise FileError(
        f"{here}: {line.strip()!r} is no marker; write <!-- report:NAME --> or <!-- /report "
        "-->, alone on its line"
      )
    name = match[1]
    if name is None:
      if opened is None:
        raise FileError(f"{here}: <!-- /report --> closes nothing")
      blocks.append(Block(opened[0], opened[1], k))
      opened = None
      continue
    if opened is not None:
      break
    if name not in BLOCKS | CODE:
      raise FileError(
        f"{here}: unknown block {name!r}; choose from: {', '.join(sorted(BLOCKS | CODE))}"
      )
    opened = name, k
  if opened is not None:
    raise FileError(
      f"{where}:{opened[1] + 1}: block {opened[0]!r} is not closed by <!-- /report -->"
    )
  return blocks


def render(name: str, results: pathlib.Path) -> str:
  """Text of a block; a file that is missing or holds something else gives one line with the block's
  name.
  """
  try:
    return (BLOCKS | CODE)[name](results)
  except FileError as e:
    raise FileError(f"block {name!r}: {e}") from None
  except (
    KeyError,
    IndexError,
    TypeError,
    ValueError,
    AttributeError,
    ArithmeticError,
    statistics.StatisticsError,
  ) as e:
    raise FileError(
      f"block {name!r}: its files in {results} do not hold what it shows ({type(e).__name__}: {e})"
    ) from None


def pages(root=".") -> list[pathlib.Path]:
  """README.md, docs/*.md and results/*/README.md of a folder, as far as they hold marked blocks."""
  root = pathlib.Path(root)
  texts = [root / "README.md", *sorted((root / "docs").glob("*.md"))]
  texts += sorted((root / "results").glob("*/README.md"))
  return [
    path for path in texts if path.is_file() and "<!-- report:" in path.read_text(errors="replace")
  ]


def report(results="results", readme="README.md", check: bool = False) -> list[dict]:
  """Writes the marked blocks of a page anew; nothing else in it changes, and nothing at all where
  all agree.

  Args:
    check: only compare.
  Returns:
    Per block, in order: name, line of its opening marker (from 1, of the file as it was), agrees
      (before writing).
  """
  results, readme = pathlib.Path(results), pathlib.Path(readme)
  if not results.is_dir():
    raise UserError(f"no folder {results}")
  try:
    old = readme.read_bytes().decode()
  except FileNotFoundError:
    raise UserError(f"no file {readme}") from None
  except UnicodeDecodeError:
    raise FileError(f"{readme} is no UTF-8 text") from None
  lines = re.findall(r"[^\n]*\n|[^\n]+", old)
  here, root = readme.resolve().parent, results.resolve().parent
  up = (
    "../" * len(here.relative_to(root).parts) if here.is_relative_to(root) else ""
  )  # links are those of a page beside the results
  out, rows, at, texts = [], [], 0, {}
  for block in find(lines, str(readme)):
    texts[block.name] = texts.get(block.name) or render(block.name, results).replace(
      "](results/", f"]({up}results/"
    )
    end = "\r\n" if lines[block.first].endswith("\r\n") else "\n"
    new = "".join(line + end for line in texts[block.name].split("\n"))
    rows.append(
      {
        "name": block.name,
        "line": block.first + 1,
        "agrees": "".join(lines[block.first + 1 : block.last]) == new,
      }
    )
    out += [*lines[at : block.first + 1], new]
    at = block.last
  text = "".join(out + lines[at:])
  if not check and text != old:
    folders.atomic(readme, lambda file: file.write(text.encode()))
  return rows
