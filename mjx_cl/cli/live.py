"""Live displays of what goes on: on a terminal a table or bar, elsewhere a line now and then."""

import time
from typing import Any, Self

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from mjx_cl.adapt.phases import PHASES
from mjx_cl.cli.output import clock, say
from mjx_cl.cli.tables import table
from mjx_cl.runs.runner import Progress


class Display:
  """What is shown while a command computes, on a terminal by `shown`.

  Attributes:
    shown: of rich, None without a terminal.
    told: when a plain line was said last [s].
  """

  def __init__(self, console: Console, shown: Any) -> None:
    self.shown = shown if console.is_terminal else None
    self.told = 0.0

  def __enter__(self) -> Self:
    if self.shown:
      self.shown.start()
    return self

  def __exit__(self, *_: object) -> None:
    if self.shown:
      self.shown.stop()

  def due(self, every_s: float, last: bool) -> bool:
    """Whether a plain line is to be said now."""
    now = time.monotonic()
    if now - self.told <= every_s and not last:
      return False
    self.told = now
    return True


class RunDisplay(Display):
  """Table of a run's streams."""

  def __init__(self) -> None:
    console = Console(stderr=True)
    super().__init__(console, Live(console=console, refresh_per_second=2, transient=True))
    self.begin = time.monotonic()

  def __call__(self, p: Progress) -> None:
    """Shows how far a run is, every few seconds."""
    now = time.monotonic()
    left = "?" if p.left is None else clock(p.left)
    head = p.note or f"step {p.step:,}/{p.steps:,}  {clock(now - self.begin)} gone, {left} left"
    if self.shown:
      rewards = (f"{x:.2f}" for x in p.reward)
      phases = (PHASES[x] for x in p.phase)
      rows = zip(
        p.arms, map(str, p.seeds), phases, rewards, map(str, p.alarms), map(str, p.updates)
      )
      names = ("arm", "seed", "phase", "reward", "alarms", "updates")
      self.shown.update(table(names, rows, left=("arm", "phase"), title=head))
    elif self.due(15, p.step >= p.steps and not p.note):
      counts = [(int((p.phase == i).sum()), name) for i, name in enumerate(PHASES)]
      many = ", ".join(f"{n} {name}" for n, name in counts if n)
      say(p.note or f"{head}; {many}; mean reward {p.reward.mean():.2f}")


class TrainDisplay(Display):
  """Progress bar of a training with return, updates per second and time left."""

  def __init__(self, total: int) -> None:
    console = Console(stderr=True)
    bar = Bar(
      TextColumn("{task.description}", markup=False),
      BarColumn(),
      TextColumn("{task.completed:,.0f}/{task.total:,.0f} updates", markup=False),
      TimeRemainingColumn(),
      console=console,
    )
    super().__init__(console, bar)
    self.total, self.task = total, bar.add_task("", total=total)
    self.recent: list[float] = []
    self.marks: list[tuple[float, int]] = []

  def __call__(self, row: dict) -> None:
    """Shows how far a training is, every few seconds."""
    if row["return"] is not None:
      self.recent = (self.recent + [row["return"]])[-5:]
    self.marks = (self.marks + [(time.monotonic(), row["updates"])])[-200:]
    (begin, before), (now, updates) = self.marks[0], self.marks[-1]
    rate = (updates - before) / max(1e-9, now - begin)
    mean = f"{sum(self.recent) / len(self.recent):.0f}" if self.recent else "-"
    step = "" if row["reward"] is None else f" ({row['reward']:.2f} a step)"
    text = f"{row['phase']}: return {mean}{step}, {rate:.1f} updates/s"
    if self.shown:
      self.shown.update(self.task, completed=updates, description=text)
    elif self.due(30, updates >= self.total):
      left = clock((self.total - updates) / rate) if rate else "?"
      say(f"{updates:,}/{self.total:,} updates, {row['records']:,} records, {text}, {left} left")
