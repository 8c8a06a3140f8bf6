"""What commands print: lines on standard error, tables, the one JSON value, live displays. Free of
JAX.
"""

from __future__ import annotations

import contextlib
import json
import math
import sys
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
  from collections.abc import Collection, Iterator, Mapping, Sequence
  from typing import Any, Self, TextIO

  from rich.table import Table

  from mjx_cl.runs.run import Progress
  from mjx_cl.runs.suite import Estimate, Part, Suite


def say(text: str) -> None:
  """One line on standard error."""
  print(text, file=sys.stderr, flush=True)


def clock(seconds: float) -> str:
  """m:ss or h:mm:ss."""
  seconds = int(max(0, seconds))
  return (
    f"{seconds // 3600}:{seconds % 3600 // 60:02d}:{seconds % 60:02d}"
    if seconds >= 3600
    else f"{seconds // 60}:{seconds % 60:02d}"
  )


def show(table: Table) -> None:
  """Prints a rich table; as wide as it likes where no terminal says how wide that is, so that no
  cell is cut.
  """
  from rich.console import Console

  Console(width=None if sys.stdout.isatty() else 200).print(table)


# standard output of a command with --json, while whatever else is printed goes to standard error
RESULT: list[TextIO] = []


def emit(value: Any) -> None:
  """The one JSON value of a command."""
  from mjx_cl.io.tables import plain

  print(json.dumps(value, allow_nan=False, default=plain), file=RESULT[-1] if RESULT else None)


@contextlib.contextmanager
def apart(command: object) -> Iterator[None]:
  """With --json nothing but `emit` reaches standard output, also not what a user's detector or
  robot prints.
  """
  if not getattr(command, "json", False):
    yield
    return
  RESULT.append(sys.stdout)
  try:
    with contextlib.redirect_stdout(sys.stderr):
      yield
  finally:
    RESULT.pop()


def _cell(arm: dict, key: str, form: str, of: str | None = None) -> str:
  """A number of an arm, out of how many, and its 95 % interval below it."""
  value, interval = arm[key], arm.get(f"{key}_ci")
  if value is None:
    return "-"
  text = format(value, form) + (f" of {arm[of]}" if of else "")
  return text if interval is None else f"{text}\n[{interval[0]:{form}}, {interval[1]:{form}}]"


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
  """Prints a run's numbers for a reader: a row an arm, below each number its 95 % interval."""
  from rich.table import Table
  from rich.text import Text

  severity = "" if s["severity"] is None else f" {s['severity']:g}"
  shares = ", ".join(f"{k} {v:.0%}" for k, v in s["wall_share"].items())
  print(
    f"{s['env']}, {s['fault']}{severity} at step {s['onset']:,} of {s['steps']:,}, detector "
    f"{s['detector']}; {clock(s['wall_s'])} wall ({shares})"
  )
  table = Table(show_lines=True)
  for heading in (
    "arm",
    "streams",
    "affected",
    "alarmed",
    "false\nalarms",
    "latency\n[steps]",
    "recovered\nin 10,000",
    "outcome",
    "reward\nat first",
    "lost\nby fault",
    "reward\nat last",
  ):
    table.add_column(Text(heading), justify="left" if heading in ("arm", "outcome") else "right")
  for name, arm in s["arms"].items():
    cells = (
      name,
      str(arm["seeds"]),
      str(arm["affected"]),
      str(arm["alarms"]),
      str(arm["false_alarm_streams"]),
      _cell(arm, "latency_median_steps", ".0f"),
      _cell(arm, "recovered_within_10000", ".3g", "affected"),
      _outcomes(arm),
      _cell(arm, "reward_pre", ".2f"),
      _cell(arm, "reward_drop", ".0%"),
      _cell(arm, "reward_final", ".2f"),
    )
    table.add_row(*map(Text, cells))
  show(table)
  print(
    "streams in all but latency (median), rewards (a control step, interquartile mean); [95 % "
    f"interval]; more in summary.json\nfiles in {out}"
  )


def plan_lines(
  suite: Suite, parts: Sequence[Part], done: Collection[str], estimates: Mapping[str, Estimate]
) -> list[str]:
  """The plan of a suite for a reader."""
  lines = [f"{suite.name}: {suite.about}"]
  width = max([4, *(len(p.name) for p in parts)])
  lines.append(f"  {'part':{width}s}  streams  stream-steps   updates  minutes    GiB")
  for p in parts:
    e = estimates[p.name]
    minutes = "finished" if p.name in done else f"{e.seconds / 60:.0f}"
    lines.append(
      f"  {p.name:{width}s}  {e.streams:7,d}  {e.stream_steps:12,d}  {e.updates:8,.0f}  "
      f"{minutes:>7s}  {e.bytes / 2**30:5.1f}"
    )
  todo = [p for p in parts if p.name not in done]
  left = sum(estimates[p.name].seconds for p in todo)
  lines.append(
    f"  {len(done)} of {len(parts)} parts finished; about {clock(left)} left, by a one-second "
    "measurement of this machine's matrix product"
  )
  from mjx_cl.runs import suite as bench

  return lines + [f"  note, {which}: {text}" for text, which in bench.notes(todo)]


def detect_table(rows: list[dict], columns: bool) -> Table:
  """Rows of a detection's summary as a table in which cells wrap and nothing is cut, with or
  without the columns that alarms are in.
  """
  from rich.table import Table
  from rich.text import Text

  table = Table()
  for name in ("detector", "threshold", "nominal\nalarms", "first\nalarm", "at [s]", "alarms") + (
    "columns",
  ) * columns:
    table.add_column(
      Text(name), justify="left" if name in ("detector", "columns") else "right", overflow="fold"
    )
  for row in rows:
    mark = "" if row["calibrated"] else " own" if row["calibrated"] is None else " *"
    shown = (
      ("-" if row["threshold"] is None else f"{row['threshold']:.4g}") + mark,
      f"{row['nominal_alarms']:,}",
      *(
        "-" if x is None else f"{x:,}" if isinstance(x, int) else f"{x:,.3f}"
        for x in (row["first_alarm"], row["first_alarm_s"], row["alarms"])
      ),
    )
    table.add_row(Text(row["detector"]), *shown, *[Text(", ".join(row["columns"]))] * columns)
  return table


def json_value(x: Any) -> Any:
  """A database's value as JSON has it: decimals are numbers, what is not finite is null, keys of a
  map and whatever else there is are text.
  """
  import decimal

  if isinstance(x, dict):
    return {str(k): json_value(v) for k, v in x.items()}
  if isinstance(x, (list, tuple)):
    return [json_value(v) for v in x]
  if isinstance(x, decimal.Decimal):
    x = float(x)
  if isinstance(x, float):
    return x if math.isfinite(x) else None
  return x if x is None or isinstance(x, (bool, int, str)) else str(x)


class RunDisplay:
  """Live table of a run on a terminal; a plain line now and then elsewhere."""

  def __init__(self) -> None:
    from rich.console import Console
    from rich.live import Live

    self.console = Console(stderr=True)
    self.live = (
      Live(console=self.console, refresh_per_second=2, transient=True)
      if self.console.is_terminal
      else None
    )
    self.first: tuple[float, int] | None
    self.begin, self.first, self.told = time.monotonic(), None, 0.0

  def __enter__(self) -> Self:
    if self.live:
      self.live.start()
    return self

  def __exit__(self, *_: object) -> None:
    if self.live:
      self.live.stop()

  def __call__(self, p: Progress) -> None:
    """Shows how far a run is, every few seconds."""
    from mjx_cl.adapt.decide import PHASES

    now = time.monotonic()
    if self.first is None:
      self.first = (now, p.step)
    rate = (p.step - self.first[1]) / max(1e-9, now - self.first[0])
    left = clock((p.steps - p.step) / rate) if rate > 0 else "?"
    head = p.note or f"step {p.step:,}/{p.steps:,}  {clock(now - self.begin)} gone, {left} left"
    if self.live:
      from rich.table import Table

      table = Table(title=head, title_justify="left")
      for name in ("arm", "seed", "phase", "reward", "alarms", "updates"):
        table.add_column(name, justify="left" if name in ("arm", "phase") else "right")
      for i, arm in enumerate(p.arms):
        table.add_row(
          arm,
          str(p.seeds[i]),
          PHASES[p.phase[i]],
          f"{p.reward[i]:.2f}",
          str(p.alarms[i]),
          str(p.updates[i]),
        )
      self.live.update(table)
    elif now - self.told > 15 or p.step >= p.steps and not p.note:
      self.told = now
      if p.note:
        say(p.note)
        return
      counts = ", ".join(
        f"{int((p.phase == i).sum())} {name}"
        for i, name in enumerate(PHASES)
        if (p.phase == i).any()
      )
      say(f"{head}; {counts}; mean reward {p.reward.mean():.2f}")


class TrainDisplay:
  """Progress bar with return, updates per second and time left; a plain line now and then without a
  terminal.
  """

  def __init__(self, total: int) -> None:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    self.console = Console(stderr=True)
    self.recent: list[float]
    self.marks: list[tuple[float, int]]
    self.total, self.recent, self.marks, self.told = total, [], [], 0.0
    self.bar = (
      Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:,.0f}/{task.total:,.0f} updates"),
        TimeRemainingColumn(),
        console=self.console,
      )
      if self.console.is_terminal
      else None
    )
    self.task = self.bar.add_task("", total=total) if self.bar else None

  def __enter__(self) -> Self:
    if self.bar:
      self.bar.start()
    return self

  def __exit__(self, *_: object) -> None:
    if self.bar:
      self.bar.stop()

  def __call__(self, row: dict) -> None:
    """Shows how far a training is, every few seconds."""
    now = time.monotonic()
    if row["return"] is not None:
      self.recent = (self.recent + [row["return"]])[-5:]
    self.marks = (self.marks + [(now, row["updates"])])[-200:]
    rate = (self.marks[-1][1] - self.marks[0][1]) / max(1e-9, self.marks[-1][0] - self.marks[0][0])
    mean = f"{sum(self.recent) / len(self.recent):.0f}" if self.recent else "-"
    step = "" if row["reward"] is None else f" ({row['reward']:.2f} a step)"
    text = f"{row['phase']}: return {mean}{step}, {rate:.1f} updates/s"
    if self.bar:
      self.bar.update(self.task, completed=row["updates"], description=text)  # type: ignore[arg-type]
    elif now - self.told > 30 or row["updates"] >= self.total:
      self.told = now
      left = clock((self.total - row["updates"]) / rate) if rate else "?"
      say(
        f"{row['updates']:,}/{self.total:,} updates, {row['records']:,} records, {text}, "
        f"{left} left"
      )
