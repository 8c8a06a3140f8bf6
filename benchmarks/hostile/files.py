"""Files made wrong: cut off, foreign, of another kind, with one field or column that is not what it
should be.
"""

from __future__ import annotations

import json
import pathlib
import re
import shutil
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.hostile import values

FOREIGN = (b"", b"\x00" * 64, b"\x89PNG\r\n\x1a\n" + b"\x07" * 40, b"PK\x03\x04broken", b"PAR1PAR1", b"\x93NUMPY\x01\x00",
           b"\xff\xfe\x00a", b"\x1f\x8b\x08\x00broken", b"null", b"[]", b"{}", b"[" * 4000, b'{"a":' * 4000, b"a = " + b"[" * 3000,
           b"<html>", b"\xef\xbb\xbf{}", b"\n\n\n", b"a" * 100_000, b"\x80\x04\x95\x10\x00")  # fmt: skip

TURNED = "bytes turned over"


def cut(path: pathlib.Path, rng: np.random.Generator) -> str:
  data = path.read_bytes()
  path.write_bytes(data[: rng.integers(len(data))])
  return "cut off"


def flip(path: pathlib.Path, rng: np.random.Generator) -> str:
  data = np.frombuffer(path.read_bytes(), np.uint8).copy()
  at = rng.integers(len(data), size=rng.integers(1, 9))
  data[at] ^= rng.integers(1, 256, len(at)).astype(np.uint8)
  path.write_bytes(data.tobytes())
  return TURNED


def foreign(path: pathlib.Path, rng: np.random.Generator) -> str:
  data = FOREIGN[rng.integers(len(FOREIGN))]
  path.write_bytes(data)
  return f"in its place {data[:12]!r}"


def kind(path: pathlib.Path, rng: np.random.Generator) -> str:
  """A folder, a link or nothing in the place of a file."""
  path.unlink()
  which = rng.integers(5)
  if which == 0:
    path.mkdir()
  elif which == 1:
    path.symlink_to("nowhere")
  elif which == 2:
    path.symlink_to(path.name)
  elif which == 3:
    path.symlink_to("/dev/null")
  return ("a folder", "a dangling link", "a link to itself", "/dev/null", "nothing")[
    which
  ] + " in its place"


def places(value: Any, path: tuple = ()) -> list[tuple]:
  """Paths of all leaves and tables in a JSON value."""
  found = [path] if path else []
  items = (
    value.items()
    if isinstance(value, dict)
    else enumerate(value)
    if isinstance(value, list)
    else ()
  )
  return found + [x for k, v in items for x in places(v, (*path, k))]


def json_field(path: pathlib.Path, rng: np.random.Generator) -> str:
  value = json.loads(path.read_text())
  found = places(value)
  *above, last = found[rng.integers(len(found))]
  inner = value
  for key in above:
    inner = inner[key]
  how, wrong = rng.integers(4), values.leaf(rng)
  if how == 0:
    del inner[last]
    said = "left out"
  elif how == 1 and isinstance(inner, dict):
    inner[values.text(rng)] = wrong
    said = "has a stranger beside it"
  else:
    inner[last] = wrong
    said = f"is {str(wrong)[:20]!r}"
  path.write_text(json.dumps(value))
  return f"{'.'.join(map(str, (*above, last)))} {said}"


def toml_field(path: pathlib.Path, rng: np.random.Generator) -> str:
  """One value of a TOML file, or a line of it, replaced."""
  text = path.read_text()
  found = list(re.finditer(r"(?<==)\s*(\"[^\"]*\"|\[[^\]\n]*\]|[-\w.]+)|^.+$", text, re.M))
  one = found[rng.integers(len(found))]
  wrong = values.leaf(rng)
  shown = json.dumps(wrong) if wrong is not None else values.text(rng)
  shown = shown.replace("NaN", "nan").replace("Infinity", "inf")
  at = one.span(1) if one[1] else one.span()
  path.write_text(text[: at[0]] + shown + text[at[1] :], errors="surrogateescape")
  return f"{one[0].strip()[:30]!r} is {shown[:20]!r}"


def npz_field(path: pathlib.Path, rng: np.random.Generator) -> str:
  with np.load(path) as file:
    held = {k: file[k] for k in file.files}
  name = list(held)[rng.integers(len(held))]
  array = held[name]
  changes: tuple[Callable[[], Any], ...] = (
    lambda: held.pop(name), lambda: array.astype("U3"), lambda: np.array([None, {}], object),
    lambda: array[None], lambda: np.zeros(0, array.dtype), lambda: array.astype(complex),
    lambda: np.full_like(array, np.nan if array.dtype.kind == "f" else 0),
    lambda: np.full(array.shape, np.inf, np.float32), lambda: array.ravel(),
    lambda: array.astype(bool), lambda: np.full(array.shape, "a", "S1"), lambda: array.astype("M8[s]"),
  )  # fmt: skip
  which = rng.integers(len(changes))
  changed = changes[which]()
  if which:
    held[name] = changed
  np.savez(path, **held)  # type: ignore[arg-type]
  return f"{name}: change {which}"


def parquet_field(path: pathlib.Path, rng: np.random.Generator) -> str:
  import pyarrow as pa
  import pyarrow.parquet

  table = pyarrow.parquet.read_table(path)
  which = int(rng.integers(12))
  at = int(rng.integers(table.num_columns))
  name, size = table.column_names[at], table.num_rows
  column = {
    0: lambda: pa.array(["a"] * size), 1: lambda: pa.array([None] * size), 2: lambda: pa.array([float("nan")] * size),
    3: lambda: pa.array([-(2**62)] * size), 4: lambda: pa.array([[1, 2]] * size), 5: lambda: pa.array([{"a": 1}] * size),
    6: lambda: pa.array([True] * size), 7: lambda: pa.array([float("inf")] * size),
  }  # fmt: skip
  if which in column:
    table = table.set_column(at, name, column[which]())
  else:
    table = (table.drop_columns, lambda n: table.slice(0, 0), lambda n: table.slice(0, size // 2),
             lambda n: table.append_column("\x1b[31m" + n, table[n]))[which - 8](name)  # fmt: skip
  pyarrow.parquet.write_table(table, path)
  return f"column {name}: change {which}"


def csv_field(path: pathlib.Path, rng: np.random.Generator) -> str:
  lines = path.read_text().splitlines()
  row = int(rng.integers(len(lines))) if rng.random() < 0.6 else 0
  cells = lines[row].split(",")
  wrong = values.any_of(rng)
  which = rng.integers(6)
  at = int(rng.integers(len(cells)))
  if which < 2:
    cells[at] = wrong
  elif which == 2:
    cells.append(wrong)
  elif which == 3:
    cells.pop(at)
  elif which == 4:
    cells[at] = '"' + cells[at]
  lines[row] = ",".join(cells)
  if which == 5:
    lines = (lines[:1], lines[:2], lines[1:], [lines[0]] * 50, [x + "\0" for x in lines])[
      rng.integers(5)
    ]
  path.write_text("\n".join(lines) + "\n", errors="surrogateescape")
  return f"line {row + 1}, cell {at + 1}: change {which}, {wrong[:20]!r}"


def bare(path: pathlib.Path, rng: np.random.Generator) -> str:
  """A folder that is empty, a file, a link to nothing, or not there."""
  shutil.rmtree(path)
  which = rng.integers(4)
  if which == 0:
    path.mkdir()
  elif which == 1:
    path.write_text("x")
  elif which == 2:
    path.symlink_to("nowhere")
  return ("an empty folder", "a file", "a dangling link", "nothing")[which] + " in its place"


FIELDS = {
  ".json": json_field,
  ".toml": toml_field,
  ".npz": npz_field,
  ".parquet": parquet_field,
  ".csv": csv_field,
}


def spoil(path: pathlib.Path, rng: np.random.Generator) -> str:
  """Makes a file or folder wrong; tells how."""
  if path.is_dir():
    return bare(path, rng)
  field = FIELDS.get(path.suffix, foreign)
  how = (field, field, field, cut, flip, foreign, kind)[rng.integers(7)]
  return how(path, rng)
