"""Result files: JSON, Parquet, suites in TOML, and SQL views over tables."""

import itertools
import json
import math
import os
import pathlib
import re
import threading
import time
import tomllib
from collections.abc import Callable, Mapping
from typing import Any

import duckdb
import numpy as np
import pyarrow
import pyarrow.parquet

from mjx_cl.errors import FileError, UserError
from mjx_cl.io import folders

PAGE = 2_000  # rows that are fetched at a time
TICK_S = 0.05  # how often a signal is looked for
DEEPEST = 64  # levels of lists and tables in one another that a file may have


def plain(x: Any) -> Any:
  """NumPy scalars and arrays as Python values, for json."""
  if hasattr(x, "tolist"):
    return x.tolist()
  raise TypeError(f"{type(x).__name__} is no JSON value")


def write_json(path: os.PathLike | str, value: Any) -> None:
  """Writes JSON (nan and infinity refused)."""
  text = json.dumps(value, indent=1, allow_nan=False, default=plain) + "\n"
  folders.atomic(path, lambda file: file.write(text.encode()))


def read_json(path: os.PathLike | str) -> dict[str, Any]:
  """The JSON object in a file.

  Raises:
    FileError: there is none, or something else.
  """
  value = _parsed(path, json.loads, "is broken")
  try:
    json.dumps(value, allow_nan=False)
  except ValueError:
    raise FileError(f"{path} is broken: it holds a number that is not finite") from None
  if not isinstance(value, dict):
    raise FileError(
      f"{path} holds {type(value).__name__} in place of an object; it is not of mjx-cl"
    )
  return value


def _parsed(path: os.PathLike | str, parse: Callable[[str], Any], wrong: str) -> Any:
  """What `parse` makes of a file's text.

  Raises:
    FileError: there is none, it is not of that format, or lists and tables lie in one another
      deeper than DEEPEST.
  """
  deep = FileError(f"{path} {wrong}: its lists and tables are nested deeper than {DEEPEST} levels")
  try:
    value = parse(pathlib.Path(path).read_text())
  except OSError as e:
    raise FileError(f"cannot read {path}: {e.strerror}") from None
  except ValueError as e:  # of the format, and of UTF-8
    raise FileError(f"{path} {wrong}: {str(e).splitlines()[0]}") from None
  except RecursionError:
    raise deep from None
  level = [value]
  for _ in range(DEEPEST):
    within = (
      x.values() if isinstance(x, dict) else x for x in level if isinstance(x, (dict, list))
    )
    level = list(itertools.chain.from_iterable(within))
  if level:
    raise deep
  return value


def write_table(
  path: os.PathLike | str,
  columns: Mapping[str, Any],
  nan_is_null: bool = True,
  codec: str = "zstd",
  level: int | None = None,
  split: tuple[str, ...] = (),
) -> None:
  """Writes columns (name -> 1-D array or list) as Parquet; nan becomes null.

  Args:
    path: of the file.
    columns: name -> values.
    nan_is_null: whether a nan becomes null.
    codec: of the compression.
    level: of the compression.
    split: float columns whose bytes are stored apart, which suits rounded values; integers then as
      differences.
  """
  arrays = {}
  for name, values in columns.items():
    floating = isinstance(values, np.ndarray) and values.dtype.kind == "f"
    arrays[name] = pyarrow.array(
      values, mask=np.isnan(values) if floating and nan_is_null else None
    )
  how: dict[str, Any] = {"compression": codec, "compression_level": level}
  if split:
    differences = {name: "DELTA_BINARY_PACKED" for name in ("stream", "step") if name in columns}
    apart = dict.fromkeys(split, "BYTE_STREAM_SPLIT")
    how |= {"use_dictionary": False, "column_encoding": apart | differences}
  folders.atomic(path, lambda file: pyarrow.parquet.write_table(pyarrow.table(arrays), file, **how))


def write_arrow(path: os.PathLike | str, table: pyarrow.Table) -> None:
  """Writes a pyarrow Table as Parquet, compressed as `write_table` does."""
  folders.atomic(
    path,
    lambda file: pyarrow.parquet.write_table(table, file, compression="zstd", use_dictionary=False),
  )


def read_suite(name: str, folder: pathlib.Path) -> tuple[pathlib.Path, dict]:
  """A suite by name, FOLDER/NAME.toml, or from a TOML file: (its path, its tables).

  Raises:
    UserError: an unknown name.
    FileError: a file that is no TOML.
  """
  path = folder / f"{name}.toml"
  if not path.exists():
    path = pathlib.Path(name)
    if path.suffix != ".toml":
      raise UserError(
        f"unknown suite {name!r}; choose from: "
        f"{', '.join(sorted(p.stem for p in folder.glob('*.toml')))}; or give a .toml file"
      )
  return path, _parsed(path, tomllib.loads, "is no TOML")


def read_arrow(path: os.PathLike | str) -> pyarrow.Table:
  """A Parquet file as a pyarrow Table.

  Raises:
    FileError: a file that cannot be read.
  """
  try:
    return pyarrow.parquet.read_table(path)
  except FileNotFoundError:
    raise FileError(f"cannot read {path}: no such file") from None
  except (OSError, pyarrow.ArrowException) as e:
    raise FileError(f"cannot read {path}: {str(e).splitlines()[0]}") from None


def read_table(path: os.PathLike | str) -> dict[str, np.ndarray]:
  """Columns of a Parquet file as NumPy arrays, null as nan."""
  table = read_arrow(path)
  return {name: table[name].to_numpy() for name in table.column_names}


def read_rows(path: os.PathLike | str) -> list[dict[str, Any]]:
  """Rows of a Parquet file as Python values by column, null as None."""
  return read_arrow(path).to_pylist()


def views(folders: tuple[str, ...] = (), results: str = "results") -> dict[str, pathlib.Path]:
  """Names of result tables, each after its path: results/leaderboard.parquet is leaderboard,
  results/walker_gear/runs.parquet walker_gear_runs.

  Args:
    folders: more folders, DIR or NAME=DIR; tables in them, at any depth, carry NAME in front, by
      default the folder's own name.
    results: the folder whose name is left out; it need not exist.

  Raises:
    UserError: a folder is missing, nothing is found, or two tables would have one name.
  """
  found: dict[str, pathlib.Path] = {}
  seen = set()
  for folder in (results, *folders):
    name, sign, where = folder.partition("=")
    if not sign or pathlib.Path(folder).is_dir():
      name, where = "", folder
    at = pathlib.Path(where)
    if not at.is_dir():
      if folder == results:
        continue
      raise UserError(f"no folder {at}")
    first = () if folder == results else (name or at.resolve().name,)
    for file in sorted(at.rglob("*.parquet")):
      if file.resolve() in seen:
        continue
      seen.add(file.resolve())
      name = "_".join(
        re.sub(r"\W+", "_", part) for part in (*first, *file.relative_to(at).with_suffix("").parts)
      ).lower()
      name = "_" * name[:1].isdigit() + name  # no SQL word begins with a digit
      if name in found:
        raise UserError(
          f"{found[name]} and {file} would both be the view {name}; give one of their folders "
          "a name by --in NAME=DIR, or rename a file"
        )
      found[name] = file
  if not found:
    raise UserError(
      f"no .parquet file in {' or '.join((results, *folders))}; give a folder, or --in DIR"
    )
  return found


def query(
  tables: os.PathLike | str | dict[str, pathlib.Path],
  sql: str | None = None,
  limit: int | None = None,
  timeout_s: float | None = None,
) -> tuple[list[str], list[tuple]]:
  """Runs SQL over result files, which it can read and not change: SELECT statements alone (FROM,
  DESCRIBE, SHOW and SUMMARIZE are such), no file outside the views, no settings, no extensions.
  An interrupt ends it at once.

  Args:
    tables: a folder, every FOLDER/*.parquet is a view of its own name; or views by name, see
      `views`.
    sql: None lists the views.
    limit: rows at most; None: all.
    timeout_s: it may take; None: as long as it takes.

  Returns:
    (names of columns, rows).
  """
  if not isinstance(tables, dict):
    folder = tables
    tables = {file.stem: file for file in sorted(pathlib.Path(folder).glob("*.parquet"))}
    if not tables:
      raise UserError(f"no .parquet file in {folder}")
  names = ", ".join(list(tables)[:20]) + (
    f" and {len(tables) - 20} more, listed by mjx-cl query without SQL" if len(tables) > 20 else ""
  )
  # nothing is spilled to disk; without external access no Python variable is taken for a table
  # either
  db = duckdb.connect(
    config={
      "temp_directory": "",
      "autoinstall_known_extensions": False,
      "autoload_known_extensions": False,
    }
  )
  working: list[threading.Thread] = []
  try:
    # a path is a pattern to read_parquet; a sign in brackets means itself, so that a folder may be
    # called a[1]
    paths = {name: re.sub(r"([*?\[])", r"[\1]", str(file)) for name, file in tables.items()}
    for name, file in tables.items():
      quoted, at = name.replace('"', '""'), paths[name].replace("'", "''")
      try:
        db.execute(f"create view \"{quoted}\" as select * from read_parquet('{at}')")
      except duckdb.Error as e:
        raise FileError(f"cannot read {file}: {str(e).splitlines()[0]}") from None
    db.execute("set allowed_paths = $1", [[*map(str, tables.values()), *paths.values()]])
    db.execute("set enable_external_access = false")
    db.execute("set lock_configuration = true")
    try:
      if sql is None:
        listed = lambda: [_describe(db, name) for name in tables]
        return ["view", "rows", "columns"], _interruptible(db, listed, timeout_s, working)
      sql.encode()
      statements = duckdb.extract_statements(sql)
      for kind in (x.type.name for x in statements if x.type != duckdb.StatementType.SELECT):
        said = "PIVOT without a list of values" if kind == "MULTI" else kind
        raise UserError(f"query: results are read-only, and {said} is no select; views: {names}")
      if not statements:
        raise UserError(f"query: no statement; views: {names}")
      return _interruptible(db, lambda: _answer(db, statements, limit), timeout_s, working)
    except UserError:
      raise
    except UnicodeEncodeError:
      raise UserError("query: the SQL is no UTF-8 text") from None
    except Exception as e:  # of DuckDB, and what Python cannot make of a value
      said = (str(e) or type(e).__name__).splitlines()[0]
      raise UserError(f"query: {said}; views: {names}") from None
  finally:
    if working and working[0].is_alive():  # a second signal leaves it at work
      threading.Thread(target=_end, args=(db, working[0]), daemon=True).start()
    else:
      db.close()


def _end(db: duckdb.DuckDBPyConnection, working: threading.Thread) -> None:
  """Interrupts until the thread at work gives in: between two pages nothing hears it."""
  while working.is_alive():
    db.interrupt()
    working.join(TICK_S)
  db.close()


def _answer(
  db: duckdb.DuckDBPyConnection, statements: list, limit: int | None
) -> tuple[list[str], list[tuple]]:
  for statement in statements:
    result = db.execute(statement)
  rows: list[tuple] = []
  most = math.inf if limit is None else limit
  while part := result.fetchmany(int(min(PAGE, most - len(rows)))):
    rows += part
  return [c[0] for c in result.description], rows


def _interruptible(
  db: duckdb.DuckDBPyConnection,
  answer: Callable[[], Any],
  timeout_s: float | None,
  working: list[threading.Thread],
) -> Any:
  """What `answer` gives; it is computed on a thread, which `working` gets, since Python notes no
  signal meanwhile.

  Raises:
    UserError: it has not come in time.
  """
  out: list[Any] = []
  done = threading.Event()

  def run() -> None:
    try:
      out.append((answer(), None))
    except BaseException as e:
      out.append((None, e))
    done.set()

  working.append(threading.Thread(target=run, daemon=True))
  working[0].start()
  end = math.inf if timeout_s is None else time.monotonic() + timeout_s
  try:
    while not done.wait(TICK_S):
      if time.monotonic() > end:
        raise UserError(f"query: no answer within {timeout_s:g} s; --timeout gives it longer")
  finally:
    while not done.is_set():  # see _end
      db.interrupt()
      done.wait(TICK_S)
  value, wrong = out[0]
  if wrong is not None:
    raise wrong
  return value


def _describe(db: duckdb.DuckDBPyConnection, name: str) -> tuple[str, int, str]:
  quoted = '"' + name.replace('"', '""') + '"'
  [(rows,)] = db.execute(f"select count(*) from {quoted}").fetchall()
  columns = db.execute(f"select * from {quoted} limit 0").description
  return name, rows, ", ".join(column[0] for column in columns)
