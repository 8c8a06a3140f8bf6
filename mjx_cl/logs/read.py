"""Logs of one's own as CSV, Parquet and MCAP files: what is read of them."""

import contextlib
import csv
import gzip
import io
import os
import pathlib
import re
import stat
import unicodedata
import zlib
from typing import Any, NamedTuple

import numpy as np
import pyarrow
import pyarrow.csv
import pyarrow.parquet

from mjx_cl.errors import FileError
from mjx_cl.logs.clocks import (
  EPOCHS,
  called_clock,
  epoch_seconds,
  guessed,
  irregular,
  iso_seconds,
  never_falls,
  split,
  throughout,
  told_by_name,
  unit,
  unitless,
)
from mjx_cl.logs.mcap_file import read_mcap

LARGE = 2_000_000  # bytes from which a file is given to pyarrow's reader first
STRAY = 0.01  # share of a column's cells that may be no numbers, and are missing then
BLOCK = 4_000_000  # bytes of it that are parsed at a time


class Log(NamedTuple):
  """What a file holds.

  Attributes:
    columns: name -> float (T,), nan = missing; clocks too, but for those of `clocks`.
    time: float64 (T,) [s], or None.
    step: float64 (T,), or None.
    ignored: name of a column that holds something else than numbers -> its first such line and
      cell.
    clocks: names of the columns `time` and `step`.
    labels: name -> name and unit.
    notes: what a reader must know of the file, one line each.
  """

  columns: dict[str, np.ndarray]
  time: np.ndarray | None
  step: np.ndarray | None
  ignored: dict[str, tuple[int, str]]
  clocks: tuple[str, ...]
  labels: dict[str, str]
  notes: tuple[str, ...]


def read(path: pathlib.Path | str) -> Log:
  """Reads a Parquet or MCAP file, by its ending, or a CSV file, also one compressed by gzip: a
  header row, then numbers; an empty cell, `nan` or anything infinite is a missing sample.

  The separator is the comma, or where the header has none the semicolon or the tabulator; then
  numbers may have a decimal comma, if most that have a fraction do: one sign for the whole file, a
  cell with the other is no number. A column with no more than STRAY of such cells has them missing
  and is noted, one with more is left out. A second row without a number above columns of numbers is
  taken for units. A column `time` or `step` tells when samples were taken and is not watched; a
  clock whose name tells a unit (`time_ms`, `seconds`) is taken as `time` if there is none and it
  rises throughout, at last one without (`t`, `timestamp`). Of a clock without a unit that follows
  from how far it rises; what was guessed is noted. A first column without a name, among others, is
  called `index`. Where nothing else tells times, a column of time stamps does: ISO 8601, or
  seconds, ms, us or ns since 1970, or whole seconds beside a column of their fraction
  (`stamp.sec`, `stamp.nanosec`); gaps and repeated ones are noted.
  """
  with contextlib.suppress(OSError):  # whoever opens it says what is wrong
    mode = os.stat(path).st_mode
    if stat.S_ISCHR(mode) or stat.S_ISBLK(mode):
      raise FileError(f"{path} is a device, not a log")
  if str(path).endswith(".parquet"):
    return _parquet(path)
  if str(path).endswith(".mcap"):
    time, columns, notes = read_mcap(path)
    clean = {name: np.where(np.isfinite(x), x, np.nan) for name, x in columns.items()}
    return _timed(path, clean, {}, {name: name for name in clean}, {"log_time": time}, notes)
  if quick := _large(path):
    return quick
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
      first, wrong = values.index(None), values.count(None)
      if wrong > STRAY * len(values):
        ignored[name] = cells[first][0], column[first]
        continue
      notes.append(
        f"{path}: {wrong} cell{'s' * (wrong > 1)} of column {name} hold{'s' * (wrong == 1)} no "
        f"number, the first {column[first]!r} in line {cells[first][0]}; read as missing"
      )
    columns[name] = _finite(np.array(values, np.float64))
  stamps = {}
  for k, name in enumerate(names):
    if name in ignored:
      found = iso_seconds([row[k] for _, row in cells])
      if found is not None:
        stamps[name] = found
        del ignored[name]
  return _timed(path, columns, ignored, labels, stamps, notes)


def _large(path: pathlib.Path | str) -> Log | None:
  """A large file of commas and numbers as `read` has it, by the reader of pyarrow; None where it is
  another one, so that our own says what is wrong with it.
  """
  try:
    if pathlib.Path(path).stat().st_size < LARGE:
      return None
    with open(path, encoding="utf-8-sig") as file:
      head, first = file.readline().rstrip("\r\n"), file.readline()
    names = _header(path, head, [cell.strip() for cell in next(csv.reader([head]))])
    if "," not in head or ";" in first or _number(first.split(",")[0]) is None:
      return None  # units, other signs
    parts: list[list] = [[] for _ in names]
    with pyarrow.csv.open_csv(
      path,
      read_options=pyarrow.csv.ReadOptions(column_names=names, skip_rows=1, block_size=BLOCK),
      convert_options=pyarrow.csv.ConvertOptions(
        null_values=["", "nan", "NaN", "NAN"],
        column_types=dict.fromkeys(names, pyarrow.float64()),
      ),
    ) as batches:
      for batch in batches:
        for part, column in zip(parts, batch.columns):
          part.append(column)
  except (OSError, ValueError, StopIteration, csv.Error, FileError, pyarrow.ArrowException):
    return None
  columns = {}
  for name, part in zip(names, parts):
    columns[name] = _finite(np.concatenate([x.to_numpy(zero_copy_only=False) for x in part]))
    part.clear()  # a column at a time: no file is held twice
  pyarrow.default_memory_pool().release_unused()
  return _timed(path, columns, {}, {name: name for name in names}, {}, [])


def _finite(x: np.ndarray) -> np.ndarray:
  """X, changed in place: what is not finite is missing."""
  x[~np.isfinite(x)] = np.nan
  return x


def _timed(
  path: pathlib.Path | str,
  columns: dict[str, np.ndarray],
  ignored: dict[str, tuple[int, str]],
  labels: dict[str, str],
  stamps: dict[str, np.ndarray],
  notes: list[str],
) -> Log:
  """The log of columns of numbers, with what tells its times; `stamps`: seconds of columns that
  hold time stamps.
  """
  parts = split(columns)
  for pair, seconds in parts.items():
    stamps[pair[0]] = seconds
    for name in pair:
      del columns[name]
  clocks, told = tuple(name for name in columns if told_by_name(name, labels[name])), {}
  rows = len(next(iter([*columns.values(), *stamps.values()]), ()))
  for name in clocks:
    told[told_by_name(name, labels[name])] = at = columns.pop(name)
    if len(at) and not throughout(at):
      why = "".join(f"; {note}" for note in notes if f" column {name} " in note)
      raise FileError(f"{path}: column {name} must rise from row to row and have no gap{why}")
  if "time" in told and rows:
    name = next(n for n in clocks if told_by_name(n, labels[n]) == "time")
    told["time"] = _in_seconds(name, told["time"], labels[name], notes)
  units = {} if "time" in told else {n: u for n in columns if (u := unit(labels[n])) is not None}
  rising = {n: columns[n] * u for n, u in units.items() if throughout(columns[n])}
  told |= dict(zip(["time"], rising.values()))
  if units and not rising and rows:
    notes.append(
      f"{path}: column {next(iter(units))} tells no times, as it does not rise at every row"
    )
  if "time" not in told:
    for name in [n for n in columns if called_clock(labels[n])]:
      found = epoch_seconds(columns[name])
      if found is not None:
        stamps[name] = found
        del columns[name]
    for name, at in stamps.items():
      told.setdefault("time", at) if never_falls(at) else notes.append(
        f"{path}: column {name} tells no times, as it has gaps or falls"
      )
  for name in [n for n in columns if unitless(labels[n]) and throughout(columns[n])]:
    if "time" not in told and rows > 1:
      if guessed(columns[name]):
        told["time"] = _in_seconds(name, columns[name], labels[name], notes)
      else:
        notes.append(f"column {name} tells no times, as its unit is unknown: give --rate")
  clocks += (*stamps, *(fraction for _, fraction in parts))
  if "time" in told:
    notes.extend(f"{path}: {text}" for text in irregular(told["time"]))
  return Log(columns, told.get("time"), told.get("step"), ignored, clocks, labels, tuple(notes))


def _in_seconds(name: str, x: np.ndarray, label: str, notes: list[str]) -> np.ndarray:
  """Times x of a clock without a unit in seconds, with a note where that was a guess."""
  if x[0] >= min(EPOCHS) and (found := epoch_seconds(x)) is not None:
    return found
  if unit(label) is not None or len(x) < 2:
    return x * (unit(label) or 1.0)
  rise, own = float(np.median(np.diff(x))), guessed(x)
  text = f"{rise:,.0f}" if rise >= 10 else f"{rise:.4g}"
  word, size = own or ("seconds", 1.0)
  if not (name.lower() == "time" and rise <= 1):
    notes.append(
      f"column {name} rises by {text} a row and is taken for {word} "
      f"({1 / (rise * size):,.4g} Hz); if it is not, give --rate"
    )
  return x * size


def _parquet(path: pathlib.Path | str) -> Log:
  """Columns of a Parquet file: numbers, booleans and time stamps; those of float32 stay so."""
  try:
    file = pyarrow.parquet.ParquetFile(path)
    names = _own_names(path, file.schema_arrow.names)
    columns: dict[str, np.ndarray] = {}
    ignored: dict[str, tuple[int, str]] = {}
    stamps = {}
    for name, kind in zip(names, file.schema_arrow.types):
      numeric = (
        pyarrow.types.is_integer(kind) or pyarrow.types.is_floating(kind)
        or pyarrow.types.is_decimal(kind) or pyarrow.types.is_boolean(kind)
      )  # fmt: skip
      if not numeric and not pyarrow.types.is_timestamp(kind):
        ignored[name] = 1, f"{kind}"
        continue
      column = file.read(columns=[name]).column(name)
      if not numeric:
        whole = column.cast(pyarrow.timestamp("ns", kind.tz)).cast(pyarrow.int64())
        if len(whole) and not whole.null_count:
          stamps[name] = (whole.to_numpy() - whole[0].as_py()) / 1e9
        else:
          ignored[name] = 1, f"{kind}"
        continue
      x = column.cast(kind if pyarrow.types.is_float32(kind) else pyarrow.float64()).to_numpy()
      columns[name] = _finite(np.require(x, requirements="W"))
  except (OSError, pyarrow.ArrowException) as e:
    raise FileError(f"cannot read {path}: {str(e).splitlines()[0][:200]}") from None
  labels = {name: name for name in names}
  return _timed(path, columns, ignored, labels, stamps, [])


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
  return _own_names(path, names)


def _own_names(path: pathlib.Path | str, names: list[str]) -> list[str]:
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
      why = "; a line that begins with # is no comment here" * names[0].startswith("#")
      raise FileError(f"{path}, line {line}: {len(row)} cells under {len(names)} names{why}")
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
