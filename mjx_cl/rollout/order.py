"""Where in a batch each stream acts, so that two arms of a seed are rounded alike.

On a CPU XLA computes a batch in vector registers of some 4 to 16 streams, and what is left over at
the end of a batch (or of one core's share of it) by other instructions, which round otherwise. A
gait makes much of a last bit: 1,000 steps later two robots with the same keys are in different
places. Streams that shall live the same life therefore lie side by side, in blocks whose length is
a power of two and divides what a register holds:

    lane = width * seed + arm        width = the least power of two that holds all arms; lanes
      without an arm live an arm's life once more

What it costs is in benchmarks/README.md.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

ALIKE = 4  # as many streams are computed alike wherever they lie


class Lanes:
  """The lanes of arms x seeds streams, which are numbered arm by arm, seed by seed.

  Args:
    arms: their number.
    seeds: their number.
    backend: name of JAX's backend; None: the default one. On an accelerator all streams are
      computed alike.

  Attributes:
    order: int (lanes,), the stream in each lane.
    place: int (arms x seeds,), lane of each stream.
    plain: streams lie in their own order.
  """

  def __init__(self, arms: int, seeds: int, backend: str | None = None) -> None:
    self.plain = arms == 1 or arms * seeds <= ALIKE or (backend or jax.default_backend()) != "cpu"
    width = 1 if self.plain else 1 << (arms - 1).bit_length()
    self.order = (
      np.arange(arms * seeds)
      if self.plain
      else np.array([arm % arms * seeds + seed for seed in range(seeds) for arm in range(width)])
    )
    self.place = np.array([int(np.argmax(self.order == stream)) for stream in range(arms * seeds)])

  def spread(self, tree: Any) -> Any:
    """Leaves (streams, ...) -> (lanes, ...)."""
    return tree if self.plain else jax.tree.map(lambda x: x[self.order], tree)

  def gather(self, tree: Any) -> Any:
    """Leaves (lanes, ...) -> (streams, ...)."""
    return tree if self.plain else jax.tree.map(lambda x: x[self.place], tree)

  def gather_rows(self, tree: Any) -> Any:
    """Leaves (T, lanes, ...) -> NumPy (T, streams, ...)."""
    return tree if self.plain else jax.tree.map(lambda x: np.asarray(x)[:, self.place], tree)
