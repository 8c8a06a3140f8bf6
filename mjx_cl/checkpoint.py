"""Checkpoints by orbax: written to a temporary name and renamed, two kept, never unpickled."""
from __future__ import annotations

import logging
import pathlib
import sys

import jax
import numpy as np
import orbax.checkpoint as ocp

from mjx_cl.errors import FileError

logging.getLogger("absl").setLevel(logging.ERROR)


def _is_key(x) -> bool:
  return isinstance(x, jax.Array) and jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key)


def _is_empty(x) -> bool:
  return 0 in getattr(x, "shape", ())


def pack(tree):
  """What orbax can write: typed random keys -> their uint32 data; arrays without an element (MJX has some) -> one zero; everything else unchanged."""
  return jax.tree.map(lambda x: jax.random.key_data(x) if _is_key(x) else np.zeros(1, x.dtype) if _is_empty(x) else x, tree)


def unpack(tree, like):
  """Inverse of `pack`, for a tree of the same structure as `like`."""
  return jax.tree.map(lambda x, l: jax.random.wrap_key_data(x) if _is_key(l) else l if _is_empty(l) else x, tree, like)


def free(leaves: list, like: list) -> None:
  """Unbinds arrays from their device, in place, where those of `like` are not bound to one.

  Orbax binds all that it reads. To `jax.jit` a bound argument is another program than a free one: a run that goes on would compile anew what the
  compile cache holds. And what is bound to one device cannot meet what is spread over several.
  """
  for i, model in enumerate(like):
    if isinstance(leaves[i], jax.Array) and not getattr(model, "committed", False):
      leaves[i] = jax.numpy.array(np.asarray(leaves[i]))


class Checkpoints:
  """Numbered checkpoints of one run in FOLDER, each an array tree and a JSON dict."""

  def __init__(self, folder):
    self.folder = pathlib.Path(folder).absolute()
    options = ocp.CheckpointManagerOptions(max_to_keep=2, enable_async_checkpointing=False, create=True)
    self._manager = ocp.CheckpointManager(self.folder, options=options)

  def latest(self) -> int | None:
    """Number of the newest complete checkpoint."""
    return self._manager.latest_step()

  def save(self, number: int, tree, meta: dict) -> None:
    """Writes one; a kill at any moment leaves the earlier ones whole."""
    try:
      self._manager.save(number, args=ocp.args.Composite(tree=ocp.args.StandardSave(pack(tree)), meta=ocp.args.JsonSave(meta)), force=True)
      self._manager.wait_until_finished()
    except (OSError, ValueError) as e:
      raise FileError(f"cannot write checkpoint {number} in {self.folder}: {e}; the earlier ones are intact") from e

  def load(self, like):
    """Newest checkpoint that can be read, (tree, meta), for a tree like `like`; it is the `latest` from then on.

    Where the newest is broken and an earlier one is whole, that is said in a line on stderr, and the broken one is removed.

    Raises:
      FileError where none can be read, or it is of another size; nothing is removed then.
    """
    packed, numbers, first = pack(like), sorted(self._manager.all_steps(), reverse=True), None
    if not numbers:
      raise FileError(f"no checkpoint in {self.folder}")
    for number in numbers:
      try:
        out = self._manager.restore(number, args=ocp.args.Composite(tree=ocp.args.StandardRestore(packed), meta=ocp.args.JsonRestore()))
        break
      except Exception as e:  # orbax raises many kinds for a broken or foreign folder
        why = (str(e).splitlines() or [type(e).__name__])[0]
        if "truth value" in why:  # orbax fails to print how two trees differ
          why = "its contents are not those that are asked for"
        first = first or f"cannot read checkpoint {number} in {self.folder}: {why}"
    else:
      raise FileError(f"{first}; it is broken, of another version or of another kind of device: --overwrite begins anew") from None
    for broken in numbers[:numbers.index(number)]:
      self._manager.delete(broken)
    if first:
      print(f"mjx-cl: {first}; it is broken, going on from checkpoint {number}", file=sys.stderr, flush=True)
    same = jax.tree.map(lambda a, b: a.shape == b.shape, out["tree"], packed)
    if not all(jax.tree.leaves(same)):
      raise FileError(f"checkpoint {number} in {self.folder} belongs to another size or robot")
    (leaves, structure), meta = jax.tree.flatten(out["tree"]), out["meta"]
    del out  # the arrays are held once
    free(leaves, jax.tree.leaves(packed))
    return unpack(jax.tree.unflatten(structure, leaves), like), meta

  def close(self) -> None:
    self._manager.close()
