"""Arrays in .npz files: a tree's leaves by the names of their paths; nothing is ever unpickled."""

import os
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from mjx_cl.errors import FileError
from mjx_cl.io import folders


def named(tree: Any) -> dict[str, Any]:
  """Path -> leaf of a tree, in the order of its leaves."""
  return {
    jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
  }


def write(path: str | os.PathLike, arrays: Mapping[str, object], small: bool = False) -> None:
  """Writes arrays by name, whole or not at all.

  Args:
    path: of the .npz file.
    arrays: name -> what NumPy makes an array of.
    small: whether they are compressed.

  Raises:
    FileError: the disk is full or the folder refuses; what was at `path` stays.
  """
  save: Any = np.savez_compressed if small else np.savez
  folders.atomic(path, lambda file: save(file, **{k: np.asarray(v) for k, v in arrays.items()}))


def read(path: str | os.PathLike) -> dict[str, np.ndarray]:
  """Arrays of an .npz file by name.

  Raises:
    FileError: there is none or it is broken.
  """
  try:
    with np.load(path, allow_pickle=False) as z:
      held = {k: z[k] for k in z.files}
    for name, value in held.items():
      if not isinstance(value, np.ndarray):
        raise ValueError(f"{name} in it is no array")
    return held
  except Exception as e:  # NumPy and zipfile raise many kinds for a broken file
    why = (str(e).splitlines() or [""])[0] or type(e).__name__
    raise FileError(f"cannot read {path}: {why}") from None
