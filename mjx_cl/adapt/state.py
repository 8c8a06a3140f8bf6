"""What a run carries from chunk to chunk, and what the host logs of one."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_cl.adapt.decide import PhaseState
from mjx_cl.adapt.watch import Minds, Sight
from mjx_cl.dreamer.agent import TrainState
from mjx_cl.dreamer.replay import Replay
from mjx_cl.rollout.monitor import History, Residual

# fields of a LoopState whose streams lie along axis 1; of the others along axis 0
LATER = ("history", "past")
ROWS = ("residual", "score", "fired")  # fields of a Digest, likewise


class LoopState(NamedTuple):
  """Everything of a run but the streams; leading (groups,) unless said.

  Attributes:
    train: TrainState of each stream.
    acting: the parameters that act and predict, a moving average of train.params while adapting,
      equal to them otherwise.
    replay: Replay with one environment each, post-alarm records only.
    history: monitor history, leading (n - 1, groups, 1).
    detector: state of the detector.
    phase: PhaseState.
    past: Residual of the last `refit` rows, leading (refit, groups).
    owed: float32, fraction of an update that is due.
    executed: int32, updates taken since the run began.
    memory: of each method of the run, see Choices.methods.
  """

  train: TrainState
  acting: Any
  replay: Replay | Any
  history: History
  detector: Any
  phase: PhaseState
  past: Residual
  owed: jax.Array
  executed: jax.Array
  memory: tuple[Any, ...] = ((),)

  @property
  def minds(self) -> Minds:
    """What predicts and judges."""
    return Minds(self.acting, self.train.slow, self.train.range)

  @property
  def sight(self) -> Sight:
    """What watching remembers."""
    return Sight(self.history, self.detector, self.past)


class Frozen(NamedTuple):
  """What is kept of a robot that has not begun to learn, leading as in LoopState.

  Attributes:
    sight: what watching remembers.
    phase: PhaseState.
  """

  sight: Sight
  phase: PhaseState


class Digest(NamedTuple):
  """What the host logs of a chunk: rows (T, groups) and values (groups,).

  Attributes:
    residual: Residual of each row.
    score: float32, the detector's, of each row.
    fired: bool, alarms, of each row.
    signals: float32 (groups, 6), in the order of decide.SIGNALS.
    settled: bool (groups, 6), which of them have settled.
    phase: int32, index into phases.PHASES after the chunk.
    decision: int32, index into decide.REASONS.
    since: int32, control step that the last adaptation counts from.
    updates: int32, taken since the run began.
    failed: int32, index into agent.CAUSES of what was at fault in an update, which changed nothing
      and was the stream's last; -1: nothing.
    back: bool, the weights of before the adaptation were put back; None where no method of
      the run does that.
    earned: float32, mean reward a step of those, see Acts; None likewise.
    earns: float32, of the weights that have learnt; None likewise.
  """

  residual: Residual
  score: jax.Array
  fired: jax.Array
  signals: jax.Array
  settled: jax.Array
  phase: jax.Array
  decision: jax.Array
  since: jax.Array
  updates: jax.Array
  failed: jax.Array
  back: jax.Array | None = None
  earned: jax.Array | None = None
  earns: jax.Array | None = None


def cut(tree: Any, block: slice, axis: int) -> Any:
  """Entries `block` along an axis of every leaf."""
  return jax.tree.map(lambda x: x[(slice(None),) * axis + (block,)], tree)


def glue(parts: list, later: tuple[str, ...]) -> Any:
  """Named tuples put together along axis 1 of the fields `later`, axis 0 of the others, NumPy."""

  def field(name: str) -> Any:
    values = [getattr(part, name) for part in parts]
    return jax.tree.map(
      lambda *x: np.concatenate([np.asarray(y) for y in x], int(name in later)), *values
    )

  return type(parts[0])(*(field(name) for name in parts[0]._fields))
