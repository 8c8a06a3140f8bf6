"""Folders of results: files written whole or not at all, and who may write where."""

import contextlib
import hashlib
import itertools
import os
import pathlib
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import BinaryIO

from mjx_cl.errors import FileError, UserError

try:
  import fcntl
except ImportError:  # Windows
  fcntl = None  # type: ignore[assignment]

_HELD: set[str] = set()  # folders that this process writes into
# of the outermost `together` that is under way: (temporary name, name) of what is written
ASIDE: list[list[tuple[pathlib.Path, pathlib.Path]]] = []


@contextlib.contextmanager
def together() -> Iterator[None]:
  """Files of one result, written within by `atomic`: they are renamed at the end, once all are
  written. One within another ends with it.

  Raises:
    FileError: as `atomic`.
  """
  if ASIDE:
    yield
    return
  ASIDE.append([])
  try:
    yield
    for k, (tmp, path) in enumerate(ASIDE[-1]):
      try:
        _rename(tmp, path)
      except FileError as e:
        new = ", ".join(path.name for _, path in ASIDE[-1][:k])
        raise (FileError(f"{e}, but {new} are new") if new else e) from None
  finally:
    for tmp, _ in ASIDE.pop():
      tmp.unlink(missing_ok=True)


def atomic(path: str | os.PathLike, write: Callable[[BinaryIO], object]) -> None:
  """Calls `write` with a binary file of a temporary name and renames it to `path`.

  Raises:
    FileError: the disk is full or the folder refuses; what was at `path` stays.
  """
  path = pathlib.Path(path)
  tmp = path.with_name(path.name + ".tmp")
  try:
    with open(tmp, "wb") as file:
      write(file)
  except OSError as e:
    tmp.unlink(missing_ok=True)
    raise _unwritten(path, e) from None
  if ASIDE:
    ASIDE[-1].append((tmp, path))
  else:
    _rename(tmp, path)


def _rename(tmp: pathlib.Path, path: pathlib.Path) -> None:
  try:
    os.replace(tmp, path)
  except OSError as e:
    tmp.unlink(missing_ok=True)
    raise _unwritten(path, e) from None


def _unwritten(path: pathlib.Path, e: OSError) -> FileError:
  return FileError(f"cannot write {path}: {e.strerror or e}; what was there is unchanged")


def make(folder: pathlib.Path) -> None:
  """Makes a folder, and those that it lies in; FileError where that is refused."""
  try:
    folder.mkdir(parents=True, exist_ok=True)
  except OSError as e:
    raise FileError(f"cannot make {folder}: {e.strerror}") from None


def usable(out: str | os.PathLike) -> pathlib.Path:
  """`out`, which is refused where it can be no folder."""
  if not str(out):
    raise UserError("--out is a folder; got an empty name")
  out = pathlib.Path(out)
  if out.exists() and not out.is_dir():
    raise UserError(f"--out {out} is a file")
  return out


@contextlib.contextmanager
def alone(out: str | os.PathLike, wait: bool = False) -> Iterator[None]:
  """No other process of this machine and user that asks likewise writes into `out` meanwhile. A
  lock ends with its process, however that ends; where the system has none, nothing is asked.

  Args:
    out: the folder.
    wait: for another process that does.

  Raises:
    UserError: one does, without `wait`.
  """
  path = str(usable(out).resolve())
  if fcntl is None or path in _HELD:
    yield
    return
  name = f"mjx_cl_locks_{os.getuid()}"
  folder = pathlib.Path(tempfile.gettempdir(), name)
  try:
    folder.mkdir(mode=0o700, exist_ok=True)
    fd = os.open(
      folder / hashlib.sha256(os.fsencode(path)).hexdigest(), os.O_RDWR | os.O_CREAT, 0o600
    )
  except OSError:  # a full disk, another user's folder of that name
    yield
    return
  try:
    try:
      fcntl.flock(fd, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
      who = os.read(fd, 20).decode(errors="replace").strip()
      raise UserError(
        f"{out} is being written by another mjx-cl, process {who or 'unknown'}; wait for it, or "
        "give another --out"
      ) from None
    with contextlib.suppress(OSError):
      os.ftruncate(fd, 0)
      os.write(fd, str(os.getpid()).encode())
    _HELD.add(path)
    try:
      yield
    finally:
      _HELD.discard(path)
  finally:
    os.close(fd)


def probe(out: str | os.PathLike) -> None:
  """Makes the folder `out` and refuses one that cannot be written to, before what goes there is
  computed. An empty folder that was not there is left.
  """
  out = usable(out)
  try:
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=out):
      pass
  except OSError as e:
    raise FileError(f"cannot write in {out}: {e.strerror or e}; give another --out") from None


def differing(
  old: Mapping,
  new: Mapping,
  skip: Sequence[str] = (),
  defaults: Mapping | None = None,
  deep: bool = False,
) -> list[str]:
  """In which settings two runs, trainings or agents differ.

  Args:
    old: what one of them says of itself.
    new: what the other says; its keys count, in their order.
    skip: keys that may differ.
    defaults: what holds where `old` lacks a key; None where they lack it too.
    deep: whether of a table in both its own keys are named, as `adapt.ratio`.
  """
  found = []
  for key in (k for k in new if k not in skip):
    before = old.get(key, (defaults or {}).get(key))
    if deep and isinstance(before, Mapping) and isinstance(new[key], Mapping):
      found += [f"{key}.{below}" for below in differing(before, new[key], deep=True)]
    elif before != new[key]:
      found.append(key)
  return found


# what a run or training leaves beside config.json; first what says that it is finished
RESULTS = (
  "summary.json",
  "trace.parquet",
  "events.parquet",
  "runs.parquet",
  "residuals.parquet",
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
  return next(
    itertools.chain(
      (name for name in (*RESULTS, "agent") if (out / name).exists()),
      (
        f"{folder}/{path.name}"
        for folder, known in left.items()
        for path in sorted((out / folder).glob("*"))
        if not re.fullmatch(known, path.name)
      ),
    ),
    None,
  )


def claim_folder(
  out: str | os.PathLike, resume: bool, overwrite: bool, done_marker: str = "summary.json"
) -> str:
  """Decides what a command may do with --out.

  Returns:
    `new`, `resume` or `done` (a finished run that --resume finds).

  Raises:
    UserError: the folder holds another run and neither --resume nor --overwrite was given.
  """
  out = usable(out)
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
  make(out)
  return "new"
