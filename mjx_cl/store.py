"""Result files: Parquet written to a temporary name and renamed, DuckDB views to query them."""
from __future__ import annotations

import importlib.metadata
import json
import os
import pathlib
import platform
import subprocess

from mjx_cl.errors import FileError, UserError

PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "mjbatch", "flax", "optax", "orbax-checkpoint", "numpy")


def plain(x):
  """NumPy scalars and arrays as Python values, for json."""
  if hasattr(x, "tolist"):
    return x.tolist()
  raise TypeError(f"{type(x).__name__} is no JSON value")


def write_json(path, value) -> None:
  """Writes JSON (nan and infinity refused) to a temporary name and renames it."""
  path = pathlib.Path(path)
  tmp = path.with_name(path.name + ".tmp")
  try:
    tmp.write_text(json.dumps(value, indent=1, allow_nan=False, default=plain) + "\n")
    os.replace(tmp, path)
  except OSError as e:
    tmp.unlink(missing_ok=True)
    raise FileError(f"cannot write {path}: {e.strerror or e}; what was there is unchanged") from None


def write_table(path, columns: dict, nan_is_null: bool = True) -> None:
  """Writes columns (name -> 1-D array or list) as Parquet; nan becomes null."""
  import numpy as np
  import pyarrow
  import pyarrow.parquet
  path = pathlib.Path(path)
  arrays = {}
  for name, values in columns.items():
    floating = isinstance(values, np.ndarray) and values.dtype.kind == "f"
    arrays[name] = pyarrow.array(values, mask=np.isnan(values) if floating and nan_is_null else None)
  tmp = path.with_name(path.name + ".tmp")
  try:
    pyarrow.parquet.write_table(pyarrow.table(arrays), tmp, compression="zstd")
    os.replace(tmp, path)
  except OSError as e:
    tmp.unlink(missing_ok=True)
    raise FileError(f"cannot write {path}: {e.strerror or e}; what was there is unchanged") from None


def read_table(path) -> dict:
  """Columns of a Parquet file as NumPy arrays, null as nan."""
  import pyarrow
  import pyarrow.parquet
  try:
    table = pyarrow.parquet.read_table(path)
  except (OSError, pyarrow.ArrowException) as e:
    raise FileError(f"cannot read {path}: {str(e).splitlines()[0]}") from None
  return {name: table[name].to_numpy() for name in table.column_names}


def query(folder, sql: str) -> tuple[list[str], list[tuple]]:
  """Runs SQL over a run's files; every FOLDER/*.parquet is a view of its own name."""
  import duckdb
  folder = pathlib.Path(folder)
  files = sorted(folder.glob("*.parquet"))
  if not files:
    raise UserError(f"no .parquet file in {folder}")
  with duckdb.connect() as db:
    for file in files:
      name, at = file.stem.replace('"', '""'), str(file).replace("'", "''")
      try:
        db.execute(f"create view \"{name}\" as select * from read_parquet('{at}')")
      except duckdb.Error as e:
        raise FileError(f"cannot read {file}: {str(e).splitlines()[0]}") from None
    try:
      result = db.execute(sql)
      if result is None:
        raise UserError(f"query: no statement; views: {', '.join(f.stem for f in files)}")
      return [c[0] for c in result.description], result.fetchall()
    except duckdb.Error as e:
      raise UserError(f"query: {str(e).splitlines()[0]}; views: {', '.join(f.stem for f in files)}") from None


def provenance() -> dict:
  """Versions, machine and commit of this process, for config.json."""
  versions = {}
  for name in PACKAGES:
    try:
      versions[name] = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
      versions[name] = None
  return {"versions": versions, "python": platform.python_version(), "git_commit": _commit(),
          "machine": {"cpu": _cpu(), "cores": os.cpu_count(), "system": platform.system(), "arch": platform.machine()}}


def _commit() -> str | None:
  """Commit of the source tree this package runs from, None outside a checkout."""
  try:
    out = subprocess.run(["git", "rev-parse", "HEAD"], cwd=pathlib.Path(__file__).parent, capture_output=True, text=True, timeout=5)
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


def claim_folder(out, resume: bool, overwrite: bool, done_marker: str = "summary.json") -> str:
  """Decides what a command may do with --out.

  Returns:
    `new`, `resume` or `done` (a finished run that --resume finds).
  Raises:
    UserError where the folder holds another run and neither --resume nor --overwrite was given.
  """
  out = pathlib.Path(out)
  if out.exists() and not out.is_dir():
    raise UserError(f"--out {out} is a file")
  if resume and overwrite:
    raise UserError("--resume and --overwrite exclude each other")
  if (out / "config.json").exists():
    if resume:
      return "done" if (out / done_marker).exists() else "resume"
    if not overwrite:
      raise UserError(f"{out} holds another run; give --resume to go on with it, --overwrite to replace it, or another --out")
  elif out.is_dir() and any(out.iterdir()) and not (resume or overwrite):
    raise UserError(f"{out} is not empty and holds no run of mjx-cl; give another --out")
  try:
    out.mkdir(parents=True, exist_ok=True)
  except OSError as e:
    raise FileError(f"cannot make {out}: {e.strerror}") from None
  return "new"
