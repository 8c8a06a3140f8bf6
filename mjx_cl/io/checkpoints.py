"""Checkpoints by orbax: written to a temporary name and renamed, two kept, never unpickled."""

import functools
import itertools
import logging
import os
import pathlib
import re
import shutil
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from mjx_cl.errors import FileError

logging.getLogger("absl").setLevel(logging.CRITICAL)  # what orbax says of errors it raises as well


def _is_key(x: Any) -> bool:
  return isinstance(x, jax.Array) and jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key)


def _is_empty(x: Any) -> bool:
  return 0 in getattr(x, "shape", ())


def pack(tree: Any) -> Any:
  """What orbax can write: typed random keys -> their uint32 data; arrays without an element (MJX
  has some) -> one zero; everything else unchanged.
  """
  return jax.tree.map(
    lambda x: jax.random.key_data(x) if _is_key(x) else np.zeros(1, x.dtype) if _is_empty(x) else x,
    tree,
  )


def unpack(tree: Any, like: Any) -> Any:
  """Inverse of `pack`, for a tree of the same structure as `like`."""
  return jax.tree.map(
    lambda x, y: jax.random.wrap_key_data(x) if _is_key(y) else y if _is_empty(y) else x, tree, like
  )


def free(leaves: list, like: list) -> None:
  """Unbinds arrays from their device, in place, where those of `like` are not bound to one.

  Orbax binds all that it reads. To `jax.jit` a bound argument is another program than a free one: a
  run that goes on would compile anew what the compile cache holds. And what is bound to one device
  cannot meet what is spread over several.
  """
  for i, model in enumerate(like):
    if isinstance(leaves[i], jax.Array) and not getattr(model, "committed", False):
      leaves[i] = jax.numpy.array(np.asarray(leaves[i]))


def _fault_of_the_machine(error: BaseException | None) -> bool:
  """Whether reading failed for a reason that says nothing of the file: memory, open files,
  permissions, a disk that does not answer.

  A file or folder that is missing, or one in the place of the other, is damage. TensorStore and XLA
  raise other kinds and say it in words.
  """
  damage = (FileNotFoundError, NotADirectoryError, IsADirectoryError)
  words = r"RESOURCE_EXHAUSTED|PERMISSION_DENIED|OS error (?!2\b|20\b|21\b)\d"
  while error is not None:
    of_machine = isinstance(error, (MemoryError, OSError)) and not isinstance(error, damage)
    if of_machine or re.search(words, str(error)):
      return True
    error = error.__cause__ or error.__context__
  return False


def _first_line(error: BaseException) -> str:
  why = (str(error).splitlines() or [""])[0] or type(error).__name__
  # orbax fails to print how two trees differ
  return "its contents are not those that are asked for" if "truth value" in why else why


def _reason(error: BaseException) -> str:
  """Why a write failed; TensorStore hides the number of the system's error in a long text."""
  number = re.search(r"os_error_code='(\d+)'|OS error (\d+)", str(error))
  return os.strerror(int(number[1] or number[2])) if number else _first_line(error)


def _unraisable(before: Callable[[Any], object], told: Any) -> None:
  """Passes on to the hook `before` all but what a write of TensorStore says whose event loop was
  closed as another one failed.
  """
  if str(told.exc_value) != "Event loop is closed":
    before(told)


def _dtypes(tree: Any) -> dict[tuple[str, ...], np.dtype]:
  """Path -> dtype of every leaf of a tree of arrays or of their metadata, which has dicts and lists
  where the arrays have named tuples.
  """
  name = lambda k: str(next(getattr(k, a) for a in ("name", "key", "idx") if hasattr(k, a)))
  return {
    tuple(map(name, path)): np.dtype(getattr(x, "dtype", type(x)))
    for path, x in jax.tree_util.tree_leaves_with_path(tree)
  }


class Checkpoints:
  """Numbered checkpoints of one run in FOLDER, each an array tree and a JSON dict."""

  def __init__(self, folder: pathlib.Path | str) -> None:
    self.folder = pathlib.Path(folder).absolute()
    self._manager = ocp.CheckpointManager(
      self.folder,
      options=ocp.CheckpointManagerOptions(
        max_to_keep=2, enable_async_checkpointing=False, create=True
      ),
    )

  def latest(self) -> int | None:
    """Number of the newest complete checkpoint."""
    return self._manager.latest_step()

  def numbers(self) -> list[int]:
    """Of all complete checkpoints."""
    return sorted(self._manager.all_steps())

  def save(self, number: int, tree: Any, meta: dict) -> None:
    """Writes one; a kill at any moment leaves the earlier ones whole.

    Raises:
      FileError: the disk is full or the folder refuses; what was written of it is gone.
    """
    before = sys.unraisablehook
    sys.unraisablehook = functools.partial(_unraisable, before)
    try:
      self._manager.save(
        number,
        args=ocp.args.Composite(
          tree=ocp.args.StandardSave(pack(tree)), meta=ocp.args.JsonSave(meta)
        ),
        force=True,
      )
      self._manager.wait_until_finished()
    except (OSError, ValueError) as e:  # threads of TensorStore may go on complaining
      self._clear(number)
      raise FileError(
        f"cannot write checkpoint {number} in {self.folder}: {_reason(e)}; the earlier ones are "
        "intact"
      ) from None
    sys.unraisablehook = before

  def _clear(self, number: int) -> None:
    """Removes a checkpoint that was not finished; threads may be writing to it for a while yet."""
    for _ in range(50):
      unfinished = list(self.folder.glob(f"{number}.orbax-checkpoint-tmp*"))
      if not unfinished:
        return
      for folder in unfinished:
        shutil.rmtree(folder, ignore_errors=True)
      time.sleep(0.1)

  def load(self, like: Any) -> tuple[Any, dict[str, Any]]:
    """Newest checkpoint that can be read, (tree, meta), for a tree like `like`, or, where that is
    a function, like(meta); it is the `latest` from then on.

    Where the newest is broken and an earlier one is whole, that is said in a line on stderr, and
    the broken one is set aside: its folder is renamed to NUMBER.broken.

    Raises:
      FileError: none can be read, or it is of another size or dtype, or reading failed for
        another reason than the file (memory, open files, ...); nothing is set aside then.
    """
    numbers, first = sorted(self._manager.all_steps(), reverse=True), None
    if not numbers:
      raise FileError(f"no checkpoint in {self.folder}")
    for number in numbers:
      try:
        own = like(self._meta(number)) if callable(like) else like
        packed = pack(own)
        stored = _dtypes(
          ocp.PyTreeCheckpointHandler().metadata(self.folder / str(number) / "tree").tree
        )
        out = self._manager.restore(
          number,
          args=ocp.args.Composite(
            tree=ocp.args.StandardRestore(packed), meta=ocp.args.JsonRestore()
          ),
        )
        break
      except Exception as e:  # orbax raises many kinds for a broken or foreign folder
        why = f"cannot read checkpoint {number} in {self.folder}: {_first_line(e)}"
        if _fault_of_the_machine(e):
          raise FileError(
            f"{why}; that need not be the file's fault and nothing was changed: --resume tries "
            "again"
          ) from None
        first = first or why
    else:
      raise FileError(
        f"{first}; it is broken, of another version or of another kind of device: --overwrite "
        "begins anew"
      ) from None
    if not jax.tree.all(jax.tree.map(lambda a, b: a.shape == b.shape, out["tree"], packed)):
      raise FileError(f"checkpoint {number} in {self.folder} belongs to another size or robot")
    for path, dtype in _dtypes(packed).items():
      if stored.get(path, dtype) != dtype:  # orbax has cast it
        raise FileError(
          f"checkpoint {number} in {self.folder} belongs to another version: {'.'.join(path)} "
          f"is {stored[path]} there, {dtype} here"
        )
    if first:
      self._set_aside(numbers[: numbers.index(number)])
      print(
        f"mjx-cl: {first}; it is broken, going on from checkpoint {number}",
        file=sys.stderr,
        flush=True,
      )
    (leaves, structure), meta = jax.tree.flatten(out["tree"]), out["meta"]
    del out  # the arrays are held once
    free(leaves, jax.tree.leaves(packed))
    return unpack(jax.tree.unflatten(structure, leaves), own), meta

  def _meta(self, number: int) -> dict[str, Any]:
    """The JSON dict of one."""
    only = ocp.args.Composite(meta=ocp.args.JsonRestore())
    return self._manager.restore(number, args=only)["meta"]

  def _set_aside(self, numbers: list[int]) -> None:
    """Renames the folders of broken checkpoints to NUMBER.broken (.broken-2, ... where that
    exists); the numbers are free again.
    """
    for number in numbers:
      names = itertools.chain(["broken"], (f"broken-{k}" for k in itertools.count(2)))
      places = (self.folder / f"{number}.{name}" for name in names)
      try:
        (self.folder / str(number)).rename(next(path for path in places if not path.exists()))
      except OSError as e:
        raise FileError(
          f"cannot set the broken checkpoint {number} in {self.folder} aside: {e}"
        ) from None
    self._manager.reload()

  def close(self) -> None:
    """Waits for what is being written and lets go of the folder."""
    self._manager.close()
