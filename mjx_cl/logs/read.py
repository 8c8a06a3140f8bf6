"""Logs of one's own as CSV files: what is read of them, and which of their columns can be watched.
`detect` judges what they hold.
"""

from __future__ import annotations

import csv
import gzip
import io
import pathlib
import re
import unicodedata
import zlib
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mjx_cl.errors import FileError, UserError

if TYPE_CHECKING:
  from typing import Any

LEAST = 100  # finite nominal samples that a column needs
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


class Log(NamedTuple):
  """Attributes:
  columns: name -> float64 (T,), nan = missing; clocks too, but for those of `clocks`. time: float64
  (T,) [s], or None. step: float64 (T,), or None. ignored: name of a column that holds something
  else than numbers -> its first such line and cell. clocks: names of the columns `time` and `step`.
  labels: name -> name and unit. notes: what a reader must know of the file, one line each.
  """

  columns: dict[str, np.ndarray]
  time: np.ndarray | None
  step: np.ndarray | None
  ignored: dict[str, tuple[int, str]]
  clocks: tuple[str, ...]
  labels: dict[str, str]
  notes: tuple[str, ...]


# ---- files ---------------------------------------------------------------------------------------


def read(path: pathlib.Path | str) -> Log:
  """Reads a CSV file, also one compressed by gzip: a header row, then numbers; an empty cell, `nan`
  or anything infinite is a missing sample.

  The separator is the comma, or where the header has none the semicolon or the tabulator; then
  numbers may have a decimal comma, if most that have a fraction do: one sign for the whole file, a
  cell with the other is no number. A second row without a number above columns of numbers is taken
  for units. A column `time` [s] or `step` tells when samples were taken and is not watched; a
  column of seconds by another name (`time_s`, `seconds`) is taken as `time` if there is none and it
  rises throughout. A first column without a name, among others, is called `index`. A column with a
  cell that is no number is left out.
  """
  text, notes = _text(path)
  head = _first_line(text)
  sign = next((s for s in ",;\t" if s in head), ",")
  try:
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=sign)
    rows = [(reader.line_num, row) for row in reader]
  except csv.Error as e:
    raise FileError(f"{path} is no CSV file: {e}") from None
  while rows and not rows[-1][1]:
    rows.pop()
  names = _header(path, head, [cell.strip() for cell in rows[0][1]] if rows else [])
  cells = _cells(path, names, rows[1:])
  comma = sign != "," and "," in text and _decimal_comma(cells)
  if comma:
    notes.append(f"{path}: numbers are read with a decimal comma")
  labels = {name: name for name in names}
  if _units(cells, comma):
    (_, units), *cells = cells
    labels = {name: f"{name} [{unit.strip()}]" for name, unit in zip(names, units)}
    notes.append(
      f"{path}: line 2 holds no number and is taken for units: "
      f"{', '.join(filter(None, map(str.strip, units)))}"
    )
  columns, ignored = {}, {}
  for name, column in zip(names, zip(*(row for _, row in cells)) if cells else [()] * len(names)):
    values: Any = [_number(cell, comma) for cell in column]
    if None in values:
      first = values.index(None)
      ignored[name] = cells[first][0], column[first]
    else:
      values = np.array(values, np.float64)
      columns[name] = np.where(np.isfinite(values), values, np.nan)
  clocks, told = tuple(name for name in columns if _told(name, labels[name])), {}
  for name in clocks:
    told[_told(name, labels[name])] = at = columns.pop(name)
    if len(at) and not _throughout(at):
      raise FileError(f"{path}: column {name} must rise from row to row and have no gap")
  seconds = (
    {name: x for name, x in columns.items() if _of_seconds(labels[name])}
    if "time" not in told
    else {}
  )
  told |= dict(zip(["time"], filter(_throughout, seconds.values())))
  if seconds and "time" not in told and cells:
    notes.append(
      f"{path}: column {next(iter(seconds))} tells no times, as it does not rise at every row"
    )
  return Log(columns, told.get("time"), told.get("step"), ignored, clocks, labels, tuple(notes))


def _text(path: pathlib.Path | str) -> tuple[str, list[str]]:
  """What a file says, and a note if it had to be guessed how it is written."""
  try:
    raw = pathlib.Path(path).read_bytes()
    if raw[:2] == b"\x1f\x8b":
      raw = gzip.decompress(raw)
  except (OSError, EOFError, zlib.error) as e:
    raise FileError(f"cannot read {path}: {getattr(e, 'strerror', None) or e}") from None
  notes = []
  try:
    text = raw.decode("utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
  except UnicodeDecodeError as e:
    if e.encoding != "utf-8":
      raise FileError(f"{path} is no CSV file: {e}; save it as UTF-8") from None
    text = raw.decode("latin-1")
    notes.append(f"{path}: no UTF-8, so it is read as Latin-1")
  strange = [
    c
    for c in _first_line(text).replace("\t", " ")
    if unicodedata.category(c) == "Cc" or c == "\ufeff"
  ]
  if strange:
    raise FileError(
      f"{path} is no CSV file: {strange[0]!r} in its first line is no text; save it as UTF-8, "
      "with commas between the cells"
    )
  return text, notes


def _first_line(text: str) -> str:
  return re.split(r"\r\n?|\n", text, maxsplit=1)[0]


def _header(path: pathlib.Path | str, head: str, names: list[str]) -> list[str]:
  """Names of the columns, or a FileError that says what is wrong with them."""
  if not names:
    raise FileError(f"{path} has no header row with the names of its columns")
  for sign in [s for s in ";\t," if s in head] or ",":  # 0,5;0,6 are two numbers
    numbers = [cell.strip('" ') for cell in head.split(sign)]
    if all(
      _number(cell) is not None or sign != "," and _number(cell, True) is not None
      for cell in numbers
    ):
      example = sign.join(f"x{k + 1}" for k in range(min(3, len(numbers)))) + (
        f"{sign}..." if len(numbers) > 3 else ""
      )
      raise FileError(
        f"{path} has no header row with the names of its columns; put a line of names before "
        f"it, e.g. {example}"
      )
  if names[0] == "" and len(names) > 1 and "" not in names[1:] and "index" not in names:
    names = ["index", *names[1:]]  # pandas and R write the numbers of the rows there
  if "" in names or len(set(names)) < len(names):
    raise FileError(
      f"{path}: every column needs a name of its own; got {', '.join(map(repr, names))}"
    )
  return names


def _cells(
  path: pathlib.Path | str, names: list[str], rows: list[tuple[int, list[str]]]
) -> list[tuple[int, list[str]]]:
  """(line, a cell per name) of each sample."""
  cells = []
  for line, row in rows:
    if not row and len(names) > 1:
      continue
    row = row or [""]  # in a file of one column an empty line is a missing sample
    if len(row) != len(names):
      raise FileError(f"{path}, line {line}: {len(row)} cells under {len(names)} names")
    cells.append((line, row))
  return cells


def _number(cell: str, comma: bool = False) -> float | None:
  """Nan where the cell is empty, None where it is no number; a number with the other decimal sign
  is none.
  """
  cell = cell.strip()
  if comma:
    cell = "?" if "." in cell else cell.replace(",", ".")
  if "_" in cell or not cell.isascii():  # an identifier, which Python's float may take all the same
    return None
  try:
    return float(cell) if cell else float("nan")
  except ValueError:
    return None


def _decimal_comma(cells: list[tuple[int, list[str]]]) -> bool:
  """Whether more numbers are written 0,5 than 0.5."""
  commas = points = 0
  for _, row in cells:
    for cell in row:
      if "," in cell:
        commas += _number(cell, True) is not None
      elif "." in cell:
        points += _number(cell) is not None
  return commas > points


def _units(cells: list[tuple[int, list[str]]], comma: bool) -> bool:
  """Whether the second line holds text alone, and somewhere beneath its text are numbers."""
  if len(cells) < 2 or cells[0][0] != 2:
    return False
  first = cells[0][1]
  texts = [k for k, cell in enumerate(first) if cell.strip()]
  if not texts or any(_number(first[k], comma) is not None for k in texts):
    return False
  return any(
    _number(row[k], comma) is not None and row[k].strip() for _, row in cells[1:] for k in texts
  )


# ---- clocks --------------------------------------------------------------------------------------


def _words(label: str) -> list[str]:
  """Words of a name in small letters: "simTime [s]" -> sim, time, s."""
  return [
    word.lower()
    for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-zµ]+|\d+", label.replace("μ", "µ"))
  ]


def _told(name: str, label: str) -> str | None:
  """Says `time` where a column of that name has seconds or no unit, `step` where it is
  called so.
  """
  role = "".join(_words(name)[:1])
  return (
    role
    if role in ("time", "step")
    and (_words(label) == [role] or _words(name) == [role] == ["time"] and _of_seconds(label))
    else None
  )


def _of_seconds(label: str) -> bool:
  """Whether a name tells a clock in seconds: `time_s`, `t [s]`, `seconds`; not `t` or `timestamp`,
  whose unit nobody knows.
  """
  *rest, last = _words(label) or [""]
  return last in SECONDS and set(rest) <= CLOCKS | {"t"} and (bool(rest) or last in CLOCKS)


def _called_clock(label: str) -> bool:
  """Whether a name has a word of CLOCKS, or is `t` with or without a unit."""
  words = _words(label)
  return not CLOCKS.isdisjoint(words) or words[:1] == ["t"] and UNITS.issuperset(words[1:])


def _throughout(x: np.ndarray) -> bool:
  """Whether x has no gap and rises at every row."""
  return len(x) > 0 and bool(np.isfinite(x).all() and (np.diff(x) > 0).all())


def _rises(x: np.ndarray, least: int = LEAST) -> bool:
  """Whether the known samples, `least` or more, rise one after the other."""
  known = x[np.isfinite(x)]
  return len(known) >= least and bool((np.diff(known) > 0).all())


def _evenly(x: np.ndarray) -> bool:
  """Whether 95 % of the increments per row lie within half of their median; a clock that is written
  with few digits has uneven ones.
  """
  at = np.flatnonzero(np.isfinite(x))
  steps = np.diff(x[at]) / np.diff(at)
  return (
    not len(steps)
    or float(np.mean(np.abs(steps - np.median(steps)) <= 0.501 * np.median(steps))) >= 0.95
  )


def _clocks(log: Log, nominal: Log) -> list[str]:
  """Columns that tell when and not what: `time` and `step`, by their name if they rise in a log
  that holds them, by what they hold if they rise evenly in both.
  """
  found = [*log.clocks, *nominal.clocks]
  for name in {**log.columns, **nominal.columns}:
    there = [one.columns[name] for one in (nominal, log) if name in one.columns]
    called = any(_called_clock(one.labels[name]) for one in (log, nominal) if name in one.labels)
    if (
      called
      and any(map(_rises, there))
      or len(there) == 2
      and _rises(there[0])
      and _rises(there[1], 0)
      and all(map(_evenly, there))
    ):
      found.append(name)
  return list(dict.fromkeys(found))


# ---- choice --------------------------------------------------------------------------------------


def choose_columns(
  log: Log,
  nominal: Log,
  names: tuple[str, ...],
  path: pathlib.Path | str,
  nominal_path: pathlib.Path | str,
) -> tuple[list[str], list[str]]:
  """Columns that are watched, and notes on those that are not: those named, or all that both files
  hold as numbers, less clocks and what is unfit.

  Raises:
    FileError or UserError where a column that is named cannot be watched, or none is left.
  """
  files = (nominal, nominal_path), (log, path)
  for one, at in files:
    for name in names:
      _there(one, at, name)
    if not one.columns:
      raise FileError(f"{at} has no column of numbers to watch{_because(one)}")
  shared = list(dict.fromkeys(names)) or [name for name in log.columns if name in nominal.columns]
  if not shared:
    raise FileError(
      (
        f"{path} and {nominal_path} share no column of numbers: {', '.join(log.columns)} against "
        f"{', '.join(nominal.columns)}"
      )
      + (_because(log) or _because(nominal))
    )
  clocks = [] if names else _clocks(log, nominal)
  able = [name for name in shared if name not in clocks]
  unfit = {name: why for name in able if (why := _unfit(name, log, nominal, path, nominal_path))}
  found = [name for name in able if name not in unfit]
  if unfit and (names or not found):
    _, error = next(iter(unfit.values()))
    raise FileError(error + (f"; name the others by --column: {', '.join(found)}" if found else ""))
  if not found:
    raise FileError(
      f"{path} and {nominal_path} share no column but such as rise like a clock or counter: "
      f"{', '.join(clocks)}; "
      "--column watches one all the same"
    )
  return found, [] if names else _left_out(files, clocks, unfit)


def _there(one: Log, at: pathlib.Path | str, name: str) -> None:
  """Refuses a name that is no column of numbers of the file."""
  if name in one.ignored:
    line, cell = one.ignored[name]
    raise FileError(f"{at}: column {name} holds {cell!r} in line {line}, which is no number")
  choices = f"choose from: {', '.join(sorted(one.columns)) or 'none'}"
  if name in one.clocks:
    raise UserError(
      f"{at}: column {name} tells when samples were taken and cannot be watched; {choices}"
    )
  if name not in one.columns:
    raise UserError(f"{at} has no column {name!r}; {choices}")


def _because(one: Log) -> str:
  """The first cell that keeps a column from being one of numbers."""
  return "".join(
    f"; column {name}: line {line} holds {cell!r}"
    for name, (line, cell) in list(one.ignored.items())[:1]
  )


def _unfit(
  name: str, log: Log, nominal: Log, path: pathlib.Path | str, nominal_path: pathlib.Path | str
) -> tuple[str, str] | None:
  """Why a column cannot be watched, for a note and as an error; None if it can."""
  known, now = (x[np.isfinite(x)] for x in (nominal.columns[name], log.columns[name]))
  if len(known) < LEAST:
    why = f"{len(known)} samples, at least {LEAST} are needed"
    return f"{nominal_path} has {why}", f"{nominal_path} is too short: column {name} has {why}"
  if np.ptp(known) == 0:
    return (
      f"constant in {nominal_path}" + (f", but not in {path}" if (now != known[0]).any() else ""),
      f"{nominal_path}: column {name} is constant ({known[0]:g}), nothing can be calibrated on it",
    )
  return None if len(now) else (f"no sample in {path}", f"{path}: column {name} has no sample")


def _left_out(
  files: tuple[tuple[Log, pathlib.Path | str], ...],
  clocks: list[str],
  unfit: dict[str, tuple[str, str]],
) -> list[str]:
  """A note for each reason not to watch columns, with their names."""
  reasons = {name: "rising like a clock or counter" for name in clocks}
  for (one, at), (other, _) in zip(files, files[::-1]):
    for name in other.labels:
      if name not in one.labels:
        reasons.setdefault(name, f"missing in {at}")
  for one, at in files:
    for name, (line, cell) in one.ignored.items():
      reasons.setdefault(name, f"line {line} of {at} holds {cell!r}")
  reasons |= {name: note for name, (note, _) in unfit.items()}
  groups: dict[str, list[str]] = {}
  for name, reason in reasons.items():
    groups.setdefault(reason, []).append(name)
  return [
    (
      f"{'column' if len(group) == 1 else 'columns'} {', '.join(group)} "
      f"{'is' if len(group) == 1 else 'are'} not watched: {reason}"
    )
    for reason, group in groups.items()
  ]
