"""Which names of columns tell a clock, which samples rise like one, and time stamps."""

import datetime
import re
from collections.abc import Sequence

import numpy as np

SECONDS = frozenset(("s", "sec", "secs", "second", "seconds"))
UNITS = SECONDS | {"ms", "msec", "us", "µs", "usec", "ns", "nsec", "min", "h"}
CLOCKS = SECONDS - {"s"} | {  # words of a name; such a column is a clock if it also rises
  "time",
  "timestamp",
  "stamp",
  "clock",
  "epoch",
  "elapsed",
  "uptime",
  "millis",
  "micros",
  "sample",
  "samples",
  "step",
  "steps",
  "index",
  "idx",
  "frame",
  "row",
  "tick",
  "seq",
}


def _words(label: str) -> list[str]:
  """Words of a name in small letters: "simTime [s]" -> sim, time, s."""
  return [
    word.lower()
    for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-zµ]+|\d+", label.replace("μ", "µ"))
  ]


def told_by_name(name: str, label: str) -> str | None:
  """Says `time` where a column of that name has seconds or no unit, `step` where it is
  called so.
  """
  role = "".join(_words(name)[:1])
  return (
    role
    if role in ("time", "step")
    and (_words(label) == [role] or _words(name) == [role] == ["time"] and of_seconds(label))
    else None
  )


def of_seconds(label: str) -> bool:
  """Whether a name tells a clock in seconds: `time_s`, `t [s]`, `seconds`; not `t` or `timestamp`,
  whose unit nobody knows.
  """
  *rest, last = _words(label) or [""]
  return last in SECONDS and set(rest) <= CLOCKS | {"t"} and (bool(rest) or last in CLOCKS)


def called_clock(label: str) -> bool:
  """Whether a name has a word of CLOCKS, or is `t` with or without a unit."""
  words = _words(label)
  return not CLOCKS.isdisjoint(words) or words[:1] == ["t"] and UNITS.issuperset(words[1:])


def throughout(x: np.ndarray) -> bool:
  """Whether x has no gap and rises at every row."""
  return len(x) > 0 and bool(np.isfinite(x).all() and (np.diff(x) > 0).all())


# first value from which a number is taken for a time since 1970 -> seconds of its unit
EPOCHS = {1e17: 1e-9, 1e14: 1e-6, 1e11: 1e-3, 1e8: 1.0}
GAP = 1.5  # typical intervals above which there is a gap


def iso_seconds(cells: Sequence[str]) -> np.ndarray | None:
  """Seconds since the first of ISO 8601 times such as 2026-11-25T10:00:00.02Z; None where a cell is
  something else.
  """
  if not cells or not re.match(r"\s*\d{4}-?\d\d-?\d\d[T ]\d\d", cells[0]):
    return None
  try:
    times = [datetime.datetime.fromisoformat(cell.strip()) for cell in cells]
    return np.array([(t - times[0]).total_seconds() for t in times])
  except (ValueError, TypeError):  # TypeError: some with a time zone, some without
    return None


def epoch_seconds(x: np.ndarray) -> np.ndarray | None:
  """Seconds since the first of times since 1970, whose unit follows from their size; None where
  they are too small for that.
  """
  if not len(x) or not np.isfinite(x).all():
    return None
  for least, unit in EPOCHS.items():
    if x[0] >= least:
      return (x - x[0]) * unit
  return None


def never_falls(x: np.ndarray) -> bool:
  """Whether x has no gap, does not fall and rises in all."""
  return len(x) > 1 and bool(np.isfinite(x).all() and (np.diff(x) >= 0).all() and x[-1] > x[0])


def irregular(seconds: np.ndarray) -> list[str]:
  """What is uneven in times that never fall: repeated ones and gaps."""
  steps, notes = np.diff(seconds), []
  if not len(steps):
    return []
  if same := int((steps == 0).sum()):
    notes.append(f"{same:,} times stand in more than one row")
  usual = float(np.median(steps))
  wide = np.flatnonzero(steps > GAP * max(usual, 1e-12))
  if usual > 0 and len(wide) and len(wide) < len(steps) / 10:
    longest = wide[int(np.argmax(steps[wide]))]
    notes.append(
      f"{len(wide):,} gap{'s' * (len(wide) > 1)} in the times, the longest of "
      f"{steps[longest]:.3g} s before sample {longest + 1:,}"
    )
  return notes
