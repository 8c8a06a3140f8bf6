"""Tables for a reader, on standard output. Free of JAX."""

import os
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

from rich.cells import cell_len, set_cell_size
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mjx_cl.cli.output import clock

# columns of a run's table, by heading; below each number its 95 % interval
COLUMNS: dict[str, Callable[[dict], str]] = {
  "streams": lambda arm: str(arm["seeds"]),
  "affected": lambda arm: "-" if arm.get("affected_ci", 0) is None else str(arm["affected"]),
  "alarmed": lambda arm: str(arm["alarms"]),
  "false\nalarms": lambda arm: str(arm["false_alarm_streams"]),
  "latency\n[steps]": lambda arm: _cell(arm, "latency_median_steps", ".0f"),
  "recovered\nin 10,000": lambda arm: _cell(arm, "recovered_within_10000", ".3g", "affected"),
  "outcome": lambda arm: _outcomes(arm),
  "reward\nat first": lambda arm: _cell(arm, "reward_pre", ".2f"),
  "lost\nby fault": lambda arm: _cell(arm, "reward_drop", ".0%"),
  "reward\nat last": lambda arm: _cell(arm, "reward_final", ".2f"),
}
# what a narrow terminal goes without, one after another
DROPPED = (
  "reward\nat first",
  "lost\nby fault",
  "streams",
  "outcome",
  "affected",
  "false\nalarms",
  "alarmed",
)


def table(
  headings: Iterable[str],
  rows: Iterable[Sequence[object]],
  left: Collection[str] = (),
  title: str | None = None,
  **how: Any,
) -> Table:
  """A table of texts.

  Args:
    headings: of the columns.
    rows: of cells.
    left: headings of the columns that are set to the left; the others to the right.
    title: above it.
    **how: settings of rich.table.Table.
  """
  out = Table(title=None if title is None else Text(title), title_justify="left", **how)
  for heading in headings:
    out.add_column(Text(heading), justify="left" if heading in left else "right", overflow="fold")
  for row in rows:
    out.add_row(*(Text(str(cell)) for cell in row))
  return out


def print_rows(names: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
  """Prints a table of foreign values, set to the left; what a terminal would obey is escaped. One
  that fits without a fold is set here, in a fiftieth of the time that rich takes.
  """
  on, texts = console(), [[_harmless(str(x)) for x in row] for row in (names, *rows)]
  widths = [max(map(cell_len, column)) for column in zip(*texts)]
  if sum(widths) + 3 * len(names) + 1 > on.width or any("\n" in x for row in texts for x in row):
    on.print(table(texts[0], texts[1:], left=texts[0]))
    return
  rule = lambda ends: ends[1].join(ends[3] * (n + 2) for n in widths).join((ends[0], ends[2]))
  line = lambda row, bar: (
    f"{bar} {f' {bar} '.join(set_cell_size(x, n) for x, n in zip(row, widths))} {bar}"
  )
  head = [rule("┏┳┓━"), line(texts[0], "┃"), rule("┡╇┩━")]
  print("\n".join([*head, *(line(row, "│") for row in texts[1:]), rule("└┴┘─")]))


def _harmless(text: str) -> str:
  """Text with signs that are not printed written out, but for line breaks."""
  if text.isprintable():
    return text
  return "".join(x if x.isprintable() or x == "\n" else repr(x)[1:-1] for x in text)


def console() -> Console:
  """Of standard output; as wide as a table likes where nothing says how wide a line may be."""
  told = sys.stdout.isatty() or "COLUMNS" in os.environ
  return Console(width=None if told else 200)


def fits(shown: Table, on: Console) -> bool:
  """Whether no cell of the table would be folded."""
  return on.measure(shown, options=on.options.update(width=100_000)).maximum <= on.width


def _cell(arm: dict, key: str, form: str, of: str | None = None) -> str:
  """A number of an arm, and its 95 % interval below it, where it is one out of several that of its
  share; - for what is unknown.
  """
  number = lambda x: "-" if x is None else format(round(x, 9), form)
  text, interval = number(arm[key]), arm.get(f"{key}_ci")
  if of and arm[key] is not None:
    text = f"{text} of {arm[of]}"
    share = lambda x: f"{x / max(1, arm[of]):.0%}"
    return f"{text}\n[{', '.join(map(share, interval))}]" if interval else text
  return f"{text}\n[{', '.join(map(number, interval))}]" if interval else text


def _outcomes(arm: dict) -> str:
  """How many streams ended how, those alone that are some."""
  names = {
    "converged": "converged",
    "aborted_by_rule": "aborted by rule",
    "aborted_by_budget": "by budget",
    "ended": "ended",
    "adapting": "adapting at the end",
    "adapting_at_onset": "adapting at the onset",
    "failed": "numeric failures",
  }
  return ", ".join(f"{arm[key]} {name}" for key, name in names.items() if arm.get(key)) or "-"


def show_summary(s: dict, out: str) -> None:
  """Prints a run's numbers for a reader: a row an arm. What does not fit into the line is left to
  summary.json.
  """
  shares = ", ".join(f"{k} {v:.0%}" for k, v in s["wall_share"].items())
  print(f"{_headline(s)}; {clock(s['wall_s'])} wall ({shares})")
  arms = [((name,), arm) for name, arm in s["arms"].items()]
  dropped = _show_arms(("arm",), arms, s["steps"] - s["onset"])
  _explain(dropped, "95 % interval", "summary.json")
  print(f"files in {out}")


def show_suite(entries: Mapping[str, dict]) -> None:
  """Prints the parts of a suite in one table: a row for each part and arm."""
  rows = [((name, arm), own) for name, s in entries.items() for arm, own in s["arms"].items()]
  lived = max(s["steps"] - s["onset"] for s in entries.values())
  _explain(_show_arms(("part", "arm"), rows, lived), "95 % interval", "bench.json")


def show_agents(together: dict, apart: Mapping[str, dict]) -> None:
  """Prints what runs of several agents say: of each arm a row for all, then one for each agent.

  Args:
    together: entry of `agents` in bench.json.
    apart: agent -> its summary.
  """
  print(_headline(together))
  rows = []
  for arm, every in together["arms"].items():
    rows += [((arm, f"all {len(apart)}"), every)]
    rows += [((arm, agent), own["arms"][arm]) for agent, own in apart.items()]
  dropped = _show_arms(("arm", "agent"), rows, together["steps"] - together["onset"])
  interval = "95 % interval, of all by a bootstrap of agents and then of their streams"
  _explain(dropped, interval, "bench.json")


def _headline(s: dict) -> str:
  severity = "" if s["severity"] is None else f" {s['severity']:g}"
  return (
    f"{s['env']}, {s['fault']}{severity} at step {s['onset']:,} of {s['steps']:,}, detector "
    f"{s['detector']}"
  )


def _show_arms(
  names: tuple[str, ...], arms: Collection[tuple[tuple[str, ...], dict]], lived: int
) -> int:
  """Prints a row for each of `arms`, its names first; returns how many of DROPPED had no room.
  `lived`: control steps after the onset.
  """
  on = console()
  within = lambda name: name.replace("10,000", f"{min(10_000, lived):,}")
  for dropped in range(len(DROPPED) + 1):
    kept = {k: cell for k, cell in COLUMNS.items() if k not in DROPPED[:dropped]}
    rows = [(*own, *(cell(arm) for cell in kept.values())) for own, arm in arms]
    shown = table((*names, *map(within, kept)), rows, left=(*names, "outcome"), show_lines=True)
    if fits(shown, on):
      break
  on.print(shown)
  return dropped


def _explain(dropped: int, interval: str, file: str) -> None:
  """Says below such a table what its numbers are and where those are that it lacks."""
  print(
    "streams in all but latency (median), rewards (a control step, interquartile mean); "
    f"[{interval}]; more in {file}"
  )
  if dropped:
    left = ", ".join(name.replace("\n", " ") for name in DROPPED[:dropped])
    print(f"not shown on a terminal this narrow, but in {file}: {left}")


def show_detections(rows: list[dict]) -> None:
  """Prints a detection's summary; where the columns that alarms are in do not fit into the line
  they stand below, one line for all detectors that name the same.
  """
  on = console()
  shown = detect_table(rows, True)
  wide = not fits(shown, on)
  on.print(detect_table(rows, False) if wide else shown)
  groups: dict[str, list[str]] = {}
  for row in rows if wide else ():
    groups.setdefault(", ".join(row["columns"]) or "no column", []).append(row["detector"])
  for columns, names in groups.items():
    print(f"{', '.join(names)}: alarms in {columns}")
  if any(row["calibrated"] is False for row in rows):
    print("* not calibrated")


def detect_table(rows: list[dict], columns: bool) -> Table:
  """Rows of a detection's summary, with or without the columns that alarms are in."""
  shown = []
  for row in rows:
    mark = "" if row["calibrated"] else " own" if row["calibrated"] is None else " *"
    threshold = "-" if row["threshold"] is None else f"{row['threshold']:.4g}"
    counts = [
      "-" if x is None else f"{x:,}" if isinstance(x, int) else f"{x:,.3f}"
      for x in (row["first_alarm"], row["first_alarm_s"], row["alarms"])
    ]
    alarms = [", ".join(row["columns"])] * columns
    shown.append(
      (row["detector"], threshold + mark, f"{row['nominal_alarms']:,}", *counts, *alarms)
    )
  names = (
    "detector",
    "threshold",
    "nominal\nalarms",
    "first\nalarm",
    "at [s]",
    "alarms",
    "columns",
  )
  return table(names[: 6 + columns], shown, left=("detector", "columns"))


def _columns(event: dict) -> str:
  """Columns of an event, with what happened to them."""

  def how(c: dict) -> str:
    if c["how"] == "course":
      return "another course in time"
    return f"mean by about {c['by']:+.2g}" if c["how"] == "mean" else f"spread x{c['by']:.2f}"

  return ", ".join(f"{c['column']} ({how(c)})" for c in event["columns"]) or "all a little"


def _at(event: dict) -> str:
  seconds = event["begin_s"]
  return f"sample {event['begin']:,}" + ("" if seconds is None else f" ({seconds:,.2f} s)")


def show_verdict(summary: dict) -> None:
  """Prints what a detection without named detectors concludes."""
  verdict = summary["verdict"]
  believed = [event for event in summary["events"] if event["believed"]]
  doubted = len(summary["events"]) - len(believed)
  for k, event in enumerate(believed):
    print(f"{'changed' if not k else 'and again'} from {_at(event)} on: {_columns(event)}")
    chance = f"{event['expected']:.1g}" if event["expected"] > 1e-9 else "less than 1e-09"
    print(
      f"  {len(event['charts'])} of {verdict['of']} charts agree; in a healthy log of this length "
      f"{chance} such events are expected"
    )
  ended = [name for name in summary["ended"] if name not in summary["unjudged"]]
  gone = {name: summary["silent"][name] for name in ended}
  apart = {*gone, *summary["unjudged"]}
  names = [name for name in summary["columns"] if name not in apart]
  if not believed and names:
    which = ", ".join(names) if len(names) <= 8 else f"{len(names)} columns"
    print(f"no change in {which} that a healthy log of this length would not show as well")
  for name, why in gone.items():
    print(f"{name}: {why}")
  if doubted:
    print(f"{doubted} more event{'s' * (doubted > 1)} of a kind that a healthy log shows as well")
  alarms = summary["false_alarms"]
  print(
    f"false alarms: {alarms['counted']:,} in the nominal log by cross-validation; at the rate that "
    f"is set, {alarms['expected']:.3g} are expected"
  )
  if faults := summary.get("inject", {}).get("faults"):
    _show_faults(faults, summary["inject"]["within"], summary["rate_hz"])


def _show_faults(faults: list[dict], within: int, rate: float | None) -> None:
  """Prints the smallest severities that are seen."""
  kinds = list(dict.fromkeys(fault["kind"] for fault in faults))
  rows: dict[str, list[str]] = {}
  for fault in faults:
    value = fault["by"] if fault["by"] is not None else fault["severity"]
    seen = fault["kind"] == "freeze" and value is not None
    text = "-" if value is None else "yes" if seen else f"{value:.2g}"
    rows.setdefault(fault["column"], []).append(text)
  time = f"{within:,} samples" + ("" if rate is None else f" ({within / rate:g} s)")
  print(f"put into the nominal log, the smallest that is seen within {time}:")
  console().print(table(("column", *kinds), [(k, *v) for k, v in rows.items()], left=("column",)))
  print(
    "bias, drift and noise in the column's unit, scale and dropout as shares, delay in samples; -: "
    "not seen"
  )
