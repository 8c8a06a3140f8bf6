"""Which names of columns tell a clock, and which samples rise like one."""

import re

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
