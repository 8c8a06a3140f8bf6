"""Returns of episodes, summed on the host from the rows of chunks as the scan gives them."""

import numpy as np

from mjx_cl.rollout.scan import Row


class Episodes:
  """The first episode of each robot.

  Attributes:
    total: float64, the return so far.
    steps: int, decisions.
    ended: bool, by termination.
    alive: bool, not over yet.
  """

  def __init__(self, shape: tuple[int, ...]) -> None:
    self.total, self.steps = np.zeros(shape), np.zeros(shape, int)
    self.ended, self.alive = np.zeros(shape, bool), np.ones(shape, bool)

  def add(self, rows: Row) -> np.ndarray:
    """Adds a chunk; which of its decisions belong to these episodes, bool (decisions, *shape)."""
    reward, terminated = np.asarray(rows.reward), np.asarray(rows.terminated)
    done = terminated | np.asarray(rows.truncated)
    before = np.concatenate([~self.alive[None], done[:-1]])
    lived = ~np.logical_or.accumulate(before, 0)  # up to the decision that ends the episode
    for r, now in zip(reward, lived):
      self.total += r * now
    self.steps += lived.sum(0)
    self.ended |= (terminated & lived).any(0)
    self.alive &= ~done.any(0)
    return lived


class Returns:
  """Returns of all episodes that end, per robot."""

  def __init__(self, shape: tuple[int, ...]) -> None:
    self.sums = np.zeros(shape)

  def add(self, rows: Row) -> list[tuple[tuple[int, int], float]]:
    """Rows of a chunk -> [((group, member), return)] of the episodes that ended in it."""
    ended: list[tuple[tuple[int, int], float]] = []
    for reward, done in zip(np.asarray(rows.reward), np.asarray(rows.terminated | rows.truncated)):
      self.sums += reward
      ended += [((g, m), float(self.sums[g, m])) for g, m in np.argwhere(done).tolist()]
      self.sums[done] = 0.0
    return ended
