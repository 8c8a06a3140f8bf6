"""What a chunk of a run leaves in its trace: arrays over control steps or chunks, and streams."""

from typing import Any

import numpy as np

from mjx_cl.adapt.loop import Digest
from mjx_cl.rollout.scan import Row


def at_end(x: Any, repeat: int) -> np.ndarray:
  """float32 (control steps, ...) of a value per decision, known with its last control step; nan in
  the others.
  """
  out = np.full((len(x), repeat) + x.shape[1:], np.nan, np.float32)
  out[:, -1] = x
  return out.reshape((-1,) + x.shape[1:])


def columns(rows: Row, digest: Digest, phase: Any, updates: Any, repeat: int) -> dict[str, Any]:
  """A chunk's rows, (control steps, groups), and its chunk values, (1, groups).

  Args:
    rows: leading (decisions, groups, 1).
    digest: of the chunk.
    phase: int (groups,), before the chunk.
    updates: int (groups,), taken before it.
    repeat: control steps of a decision.
  """
  held = lambda x: np.repeat(np.asarray(x)[:, :, 0], repeat, 0)
  ends = lambda x: at_end(np.asarray(x).astype(np.float32), repeat) > 0

  def each(x: Any) -> np.ndarray:
    """A value per control step."""
    x = np.asarray(x)[:, :, 0].swapaxes(1, 2)
    return x.reshape(-1, x.shape[2])

  rewards = each(rows.rewards)
  known = digest.residual
  out = {
    "reward": rewards,
    "severity": held(rows.severity) if rows.severities is None else each(rows.severities),
    "episode": held(rows.episode),
    "terminated": ends(np.asarray(rows.terminated)[:, :, 0]),
    "truncated": ends(np.asarray(rows.truncated)[:, :, 0]),
    "opr": at_end(known.opr, repeat),
    "rpr": at_end(known.rpr, repeat),
    "valid": ends(known.valid),
    "score": at_end(digest.score, repeat),
    "alarm": ends(digest.fired),
    "phase": np.broadcast_to(phase.astype(np.int8), rewards.shape).copy(),
    "updates": np.broadcast_to(updates.astype(np.int32), rewards.shape).copy(),
  }
  for name in ("signals", "decision", "since", "settled", "back", "earned", "earns"):
    value: Any = getattr(digest, name)
    if value is not None:
      out[name] = value[None]
  return out
