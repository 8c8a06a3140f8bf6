"""Which names of columns tell a clock, which samples rise like one, and time stamps."""

import datetime
import re
from collections.abc import Mapping, Sequence

import numpy as np

SECONDS = frozenset(("s", "sec", "secs", "second", "seconds"))
# words of a name -> seconds of the unit that they tell
UNITS = {word: 1.0 for word in SECONDS} | {
  "ms": 1e-3, "msec": 1e-3, "millis": 1e-3, "milliseconds": 1e-3,
  "us": 1e-6, "µs": 1e-6, "usec": 1e-6, "micros": 1e-6, "microseconds": 1e-6,
  "ns": 1e-9, "nsec": 1e-9, "nanos": 1e-9, "nanoseconds": 1e-9,
  "min": 60.0, "h": 3600.0,
}  # fmt: skip
ABBREVIATED = {"s", "ms", "us", "µs", "ns", "min", "h"}  # tell no clock by themselves
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


def unit(label: str) -> float | None:
  """Seconds of the unit that a clock's name tells: `time_s`, `t [ms]`, `micros`; None for `t` or
  `timestamp`, whose unit nobody knows.
  """
  *rest, last = _words(label) or [""]
  told = last in UNITS and set(rest) <= CLOCKS | {"t"} and (bool(rest) or last not in ABBREVIATED)
  return UNITS[last] if told else None


def of_seconds(label: str) -> bool:
  """Whether a name tells a clock in seconds."""
  return unit(label) == 1.0


def called_clock(label: str) -> bool:
  """Whether a name has a word of CLOCKS, or is `t` with or without a unit."""
  words = _words(label)
  return not CLOCKS.isdisjoint(words) or words[:1] == ["t"] and UNITS.keys() >= set(words[1:])


# last words of a name of a split clock's fraction of a second -> its unit
FRACTIONS = {word: 1e-9 for word in ("nanosec", "nanosecs", "nsec", "nsecs", "nanoseconds", "ns")}
FRACTIONS |= {word: 1e-6 for word in ("usec", "usecs", "microseconds", "us")}


def split(columns: Mapping[str, np.ndarray]) -> dict[tuple[str, str], np.ndarray]:
  """(column of whole seconds, column of their fraction) -> seconds since the first row, of clocks
  in two columns such as `header.stamp.sec` and `header.stamp.nanosec`.
  """
  ends = {tuple(words): name for name in columns if (words := _words(name))}
  found = {}
  for (*rest, last), name in ends.items():
    if last not in SECONDS:
      continue
    for word, size in FRACTIONS.items():
      other = ends.get((*rest, word))
      if other is None:
        continue
      whole, part = columns[name], columns[other]
      if len(whole) and np.all((part >= 0) & (part * size < 1) & (whole == np.round(whole))):
        at = whole - whole[0] + part * size
        if never_falls(at - at[0]):
          found[name, other] = at - at[0]
  return found


def throughout(x: np.ndarray) -> bool:
  """Whether x has no gap and rises at every row."""
  return len(x) > 0 and bool(np.isfinite(x).all() and (np.diff(x) > 0).all())


# names of a clock that may tell times without a unit
UNITLESS = {"time", "t", "timestamp", "stamp", "elapsed", "uptime"}
# rise per row of such a clock, of whole numbers, from which its unit follows: 1 Hz to 1 kHz
RISES = {1e6: ("nanoseconds", 1e-9), 1e3: ("microseconds", 1e-6)}


def unitless(label: str) -> bool:
  """Whether a name tells a clock and no unit."""
  words = _words(label)
  return len(words) == 1 and words[0] in UNITLESS


def guessed(x: np.ndarray) -> tuple[str, float] | None:
  """Unit of the times x, in words and in seconds, by how far they rise in a row; None where it may
  be one of several.
  """
  rise = float(np.median(np.diff(x))) if len(x) > 1 else 0.0
  whole = bool((x[:1000] == np.round(x[:1000])).all())
  for least, told in RISES.items():
    if whole and rise >= least:
      return told
  return ("seconds", 1.0) if 0 < rise < 1 else None


# first value from which a number is taken for a time since 1970 -> seconds of its unit
EPOCHS = {1e17: 1e-9, 1e14: 1e-6, 1e11: 1e-3, 1e8: 1.0}
GAP = 1.5  # typical intervals above which there is a gap
RARE = 0.1  # share of the intervals that may be wide in an even clock whose gaps are of any length
NEAR, MOSTLY = 0.2, 0.9  # to a whole number of intervals; share of the gaps that must be so near


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


def gaps(seconds: np.ndarray) -> np.ndarray:
  """Which intervals (T - 1,) of times are gaps; none where the clock itself is uneven: wide ones
  are not RARE, nor do they hold a whole number of usual ones.
  """
  steps = np.diff(seconds)
  usual = float(np.median(steps)) if len(steps) else 0.0
  wide = steps > GAP * max(usual, 1e-12)
  if usual > 0 and wide.mean() >= RARE:
    lengths = steps[wide] / usual
    wide &= bool((abs(lengths - np.rint(lengths)) < NEAR).mean() >= MOSTLY)
  return wide & (usual > 0)


def rate(seconds: np.ndarray) -> tuple[float, float] | None:
  """Rows per second by the median distance of two and by the mean one without gaps; None where that
  tells nothing.
  """
  steps = np.diff(seconds)
  usual = float(np.median(steps)) if len(steps) else 0.0
  return (1 / usual, 1 / float(steps[steps <= GAP * usual].mean())) if usual > 0 else None


def irregular(seconds: np.ndarray) -> list[str]:
  """What is uneven in times that never fall: repeated ones and gaps."""
  steps, notes = np.diff(seconds), []
  if not len(steps):
    return []
  if same := int((steps == 0).sum()):
    notes.append(f"{same:,} times stand in more than one row")
  wide = np.flatnonzero(gaps(seconds))
  if len(wide):
    longest = wide[int(np.argmax(steps[wide]))]
    notes.append(
      f"{len(wide):,} gap{'s' * (len(wide) > 1)} in the times, the longest of "
      f"{steps[longest]:.3g} s before sample {longest + 1:,}"
    )
  return notes
