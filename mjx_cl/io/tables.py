"""Result files: Parquet written to a temporary name and renamed, DuckDB views to query them."""

from __future__ import annotations

import functools
import importlib.metadata
import json
import os
import pathlib
import platform
import re
import subprocess
import tempfile
import tomllib

from mjx_cl.errors import FileError, UserError

PACKAGES = (
  "jax",
  "jaxlib",
  "mujoco",
  "mujoco-mjx",
  "mjbatch",
  "flax",
  "optax",
  "orbax-checkpoint",
  "numpy",
)


def plain(x):
  """NumPy scalars and arrays as Python values, for json."""
  if hasattr(x, "tolist"):
    return x.tolist()
  raise TypeError(f"{type(x).__name__} is no JSON value")


def atomic(path, write) -> None:
  """Calls `write` with a binary file of a temporary name and renames it to `path`.

  Raises:
    FileError where the disk is full or the folder refuses; what was at `path` stays.
  """
  path = pathlib.Path(path)
  tmp = path.with_name(path.name + ".tmp")
  try:
    with open(tmp, "wb") as file:
      write(file)
    os.replace(tmp, path)
  except OSError as e:
    tmp.unlink(missing_ok=True)
    raise FileError(
      f"cannot write {path}: {e.strerror or e}; what was there is unchanged"
    ) from None


def write_json(path, value) -> None:
  """Writes JSON (nan and infinity refused)."""
  text = json.dumps(value, indent=1, allow_nan=False, default=plain) + "\n"
  atomic(path, lambda file: file.write(text.encode()))


def read_json(path) -> dict:
  """The JSON object in a file.

  Raises:
    FileError where there is none, or something else.
  """
  try:
    value = json.loads(pathlib.Path(path).read_text())
  except OSError as e:
    raise FileError(f"cannot read {path}: {e.strerror}") from None
  except ValueError as e:  # of JSON and of UTF-8
    raise FileError(f"{path} is broken: {str(e).splitlines()[0]}") from None
  if not isinstance(value, dict):
    raise FileError(
      f"{path} holds {type(value).__name__} in place of an object; it is not of mjx-cl"
    )
  return value


def write_table(
  path,
  columns: dict,
  nan_is_null: bool = True,
  codec: str = "zstd",
  level: int | None = None,
  split: tuple[str, ...] = (),
) -> None:
  """Writes columns (name -> 1-D array or list) as Parquet; nan becomes null.

  Args:
    codec, level: of the compression. split: float columns whose bytes are stored apart, which suits
      rounded values; integers then as differences.
  """
  import numpy as np
  import pyarrow
  import pyarrow.parquet

  arrays = {}
  how = (
    {
      "use_dictionary": False,
      "column_encoding": {name: "BYTE_STREAM_SPLIT" for name in split}
      | {name: "DELTA_BINARY_PACKED" for name in ("stream", "step") if name in columns},
    }
    if split
    else {}
  )
  for name, values in columns.items():
    floating = isinstance(values, np.ndarray) and values.dtype.kind == "f"
    arrays[name] = pyarrow.array(
      values, mask=np.isnan(values) if floating and nan_is_null else None
    )
  atomic(
    path,
    lambda file: pyarrow.parquet.write_table(
      pyarrow.table(arrays), file, compression=codec, compression_level=level, **how
    ),
  )


def write_arrow(path, table) -> None:
  """Writes a pyarrow Table as Parquet, compressed as `write_table` does."""
  import pyarrow.parquet

  atomic(
    path,
    lambda file: pyarrow.parquet.write_table(table, file, compression="zstd", use_dictionary=False),
  )


def read_suite(name: str, folder: pathlib.Path) -> tuple[pathlib.Path, dict]:
  """A suite by name, FOLDER/NAME.toml, or from a TOML file: (its path, its tables).

  Raises:
    UserError for an unknown name; FileError for a file that is no TOML.
  """
  path = folder / f"{name}.toml"
  if not path.exists():
    path = pathlib.Path(name)
    if path.suffix != ".toml":
      raise UserError(
        f"unknown suite {name!r}; choose from: "
        f"{', '.join(sorted(p.stem for p in folder.glob('*.toml')))}; or give a .toml file"
      )
  try:
    return path, tomllib.loads(path.read_text())
  except OSError as e:
    raise FileError(f"cannot read {path}: {e.strerror}") from None
  except ValueError as e:
    raise FileError(f"{path} is no TOML: {e}") from None


def read_arrow(path):
  """A Parquet file as a pyarrow Table.

  Raises:
    FileError for a file that cannot be read.
  """
  import pyarrow
  import pyarrow.parquet

  try:
    return pyarrow.parquet.read_table(path)
  except FileNotFoundError:
    raise FileError(f"cannot read {path}: no such file") from None
  except (OSError, pyarrow.ArrowException) as e:
    raise FileError(f"cannot read {path}: {str(e).splitlines()[0]}") from None


def read_arrays(path) -> dict:
  """Arrays of an .npz file by name; FileError where there is none or it is broken. Nothing is
  unpickled.
  """
  import zipfile
  import zlib

  import numpy as np

  try:
    with np.load(path, allow_pickle=False) as z:
      return {k: z[k] for k in z.files}
  except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as e:
    raise FileError(f"cannot read {path}: {e}") from None


def read_table(path) -> dict:
  """Columns of a Parquet file as NumPy arrays, null as nan."""
  table = read_arrow(path)
  return {name: table[name].to_numpy() for name in table.column_names}


def read_plain(path) -> dict[str, list]:
  """Columns of a Parquet file as Python values, null as None."""
  return read_arrow(path).to_pydict()


def read_rows(path) -> list[dict]:
  """Rows of a Parquet file as Python values by column, null as None."""
  columns = read_plain(path)
  return [dict(zip(columns, cells)) for cells in zip(*columns.values())]


def views(folders: tuple[str, ...] = (), results: str = "results") -> dict[str, pathlib.Path]:
  """Names of result tables, each after its path: results/leaderboard.parquet is leaderboard,
  results/walker_gear/runs.parquet walker_gear_runs.

  Args:
    folders: more folders, DIR or NAME=DIR; tables in them, at any depth, carry NAME in front, by
      default the folder's own name.
    results: the folder whose name is left out; it need not exist.

  Raises:
    UserError where a folder is missing, nothing is found, or two tables would have one name.
  """
  found, seen = {}, set()
  for folder in (results, *folders):
    name, sign, at = folder.partition("=")
    if not sign or pathlib.Path(folder).is_dir():
      name, at = "", folder
    at = pathlib.Path(at)
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
      name = "_" + name if name[:1].isdigit() else name  # no SQL word begins with a digit
      if name in found:
        raise UserError(
          f"{found[name]} and {file} would both be the view {name}; give one of their folders "
          "a name by --in NAME=DIR, "
          "or rename a file"
        )
      found[name] = file
  if not found:
    raise UserError(
      f"no .parquet file in {' or '.join((results, *folders))}; give a folder, or --in DIR"
    )
  return found


def query(tables, sql: str | None = None) -> tuple[list[str], list[tuple]]:
  """Runs SQL over result files, which it can read and not change: SELECT statements alone (FROM,
  DESCRIBE, SHOW and SUMMARIZE are such), no file outside the views, no settings, no extensions.

  Args:
    tables: a folder, every FOLDER/*.parquet is a view of its own name; or views by name, see
      `views`.
    sql: None lists the views.

  Returns:
    (names of columns, rows).
  """
  import duckdb

  if not isinstance(tables, dict):
    tables = {file.stem: file for file in sorted(pathlib.Path(tables).glob("*.parquet"))} or _none(
      tables
    )
  names = ", ".join(list(tables)[:20]) + (
    f" and {len(tables) - 20} more, listed by mjx-cl query without SQL" if len(tables) > 20 else ""
  )
  # nothing is spilled to disk; without external access no Python variable is taken for a table
  # either
  with duckdb.connect(
    config={
      "temp_directory": "",
      "autoinstall_known_extensions": False,
      "autoload_known_extensions": False,
    }
  ) as db:
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
    if sql is None:
      return ["view", "rows", "columns"], [_describe(db, name) for name in tables]
    try:
      statements = duckdb.extract_statements(sql)
      for statement in statements:
        if statement.type != duckdb.StatementType.SELECT:
          kind = {"MULTI": "PIVOT without a list of values"}.get(
            statement.type.name, statement.type.name
          )
          raise UserError(f"query: results are read-only, and {kind} is no select; views: {names}")
      if not statements:
        raise UserError(f"query: no statement; views: {names}")
      for statement in statements:
        result = db.execute(statement)
      return [c[0] for c in result.description], result.fetchall()
    except duckdb.Error as e:
      raise UserError(f"query: {str(e).splitlines()[0]}; views: {names}") from None


def _none(folder):
  raise UserError(f"no .parquet file in {folder}")


def _describe(db, name: str) -> tuple[str, int, str]:
  quoted = '"' + name.replace('"', '""') + '"'
  rows = db.execute(f"select count(*) from {quoted}").fetchone()[0]
  return (
    name,
    rows,
    ", ".join(c[0] for c in db.execute(f"select * from {quoted} limit 0").description),
  )


def provenance() -> dict:
  """Versions, machine and commit of this process, for config.json; cores: those that it may use."""
  from mjx_cl.runs import workers

  versions = {}
  for name in PACKAGES:
    try:
      versions[name] = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
      versions[name] = None
  return {
    "versions": versions,
    "python": platform.python_version(),
    "git_commit": _commit(),
    "machine": {
      "cpu": _cpu(),
      "cores": len(workers.cores()),
      "system": platform.system(),
      "arch": platform.machine(),
    },
  }


@functools.cache
def _commit() -> str | None:
  """Commit of the source tree this package runs from, None outside a checkout; asked once, since a
  later one is not what this process has loaded.
  """
  try:
    out = subprocess.run(
      ["git", "rev-parse", "HEAD"],
      cwd=pathlib.Path(__file__).parent,
      capture_output=True,
      text=True,
      timeout=5,
    )
  except (OSError, subprocess.SubprocessError):
    return None
  return out.stdout.strip() or None


def _cpu() -> str:
  try:
    for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
      if line.startswith("model name"):
        return line.split(":", 1)[1].strip()
  except OSError:
    pass
  return platform.processor() or platform.machine()


def probe(out) -> None:
  """Makes the folder `out` and refuses one that cannot be written to, before what goes there is
  computed. An empty folder that was not there is left.
  """
  if not str(out):
    raise UserError("--out is a folder; got an empty name")
  out = pathlib.Path(out)
  if out.exists() and not out.is_dir():
    raise UserError(f"--out {out} is a file")
  try:
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=out):
      pass
  except OSError as e:
    raise FileError(f"cannot write in {out}: {e.strerror or e}; give another --out") from None


# what a run or training leaves beside config.json
RESULTS = (
  "trace.parquet",
  "events.parquet",
  "runs.parquet",
  "residuals.parquet",
  "summary.json",
  "figure.png",
  "metrics.parquet",
  "signals.parquet",
  "snapshots.parquet",
  "stop.parquet",
)


def _foreign(out: pathlib.Path) -> str | None:
  """What a run or training would replace in a folder without config.json that is not one's own,
  which was cut off while it began: its name, or None.
  """
  left = {
    "work": r"checkpoints|snapshots|trace(-\d+|\.tmp)\.npz",
    "work/checkpoints": r"\d.*",
    "checkpoints": r"\d.*",
  }
  strange = [name for name in (*RESULTS, "agent") if (out / name).exists()]
  strange += [
    f"{folder}/{path.name}"
    for folder, known in left.items()
    for path in sorted((out / folder).glob("*"))
    if not re.fullmatch(known, path.name)
  ]
  return strange[0] if strange else None


def claim_folder(out, resume: bool, overwrite: bool, done_marker: str = "summary.json") -> str:
  """Decides what a command may do with --out.

  Returns:
    `new`, `resume` or `done` (a finished run that --resume finds).

  Raises:
    UserError where the folder holds another run and neither --resume nor --overwrite was given.
  """
  if not str(out):
    raise UserError("--out is a folder; got an empty name")
  out = pathlib.Path(out)
  if out.exists() and not out.is_dir():
    raise UserError(f"--out {out} is a file")
  if resume and overwrite:
    raise UserError("--resume and --overwrite exclude each other")
  if (out / "config.json").exists():
    if resume:
      return "done" if (out / done_marker).exists() else "resume"
    if not overwrite:
      raise UserError(
        f"{out} holds another run; give --resume to go on with it, --overwrite to replace it, "
        "or another --out"
      )
  elif out.is_dir() and any(out.iterdir()):
    if not (resume or overwrite):
      raise UserError(f"{out} is not empty and holds no run of mjx-cl; give another --out")
    if name := _foreign(out):
      raise UserError(
        f"{out} holds no config.json of mjx-cl, but {name}, which would be replaced; give "
        "another --out"
      )
  try:
    out.mkdir(parents=True, exist_ok=True)
  except OSError as e:
    raise FileError(f"cannot make {out}: {e.strerror}") from None
  return "new"
