"""What memory a run takes at most, known before it begins.

  lives     sight (monitor's history, detector, residuals of `refit` steps) and a chunk of rows
  weights   of learners: parameters, moments, slow critic, what acts, and that once more in its band
  replays   of learners
  scratch   of updates, for each core that has one, and of the compiler before the first
  trace     what is logged, and its table while it is written

Lives, weights and scratch are flat in the steps of the run; a replay is not, nor is the trace.
"""

from typing import NamedTuple

from mjx_cl.adapt import methods
from mjx_cl.adapt.arms import ARMS
from mjx_cl.config import CHUNK, DreamerConfig, RunConfig
from mjx_cl.errors import require
from mjx_cl.io import memory, runtime
from mjx_cl.runs.groups import HERD
from mjx_cl.runs.lives import MANY
from mjx_cl.runs.loops import capacity
from mjx_cl.training import needs
from mjx_cl.types import Spec

LIFE = 200_000  # bytes of a life besides: detector, history, robot
TRACE = 400  # bytes of a stream and control step, most of them while the table is written

# bytes of an update of 4 x 64 steps of size1m. With two learners on two cores processes peaked at
# 2.1 (car) and 2.3 GiB (quadruped), compiling included, where this says 2.5
SCRATCH = 0.35 * 2**30


class Room(NamedTuple):
  """Bytes.

  Attributes:
    lives: of robots that have not begun to learn.
    weights: of learners, and scratch.
    replays: of learners.
    trace: of all streams.
    learners: streams that may learn.
  """

  lives: int
  weights: int
  replays: int
  trace: int
  learners: int

  @property
  def total(self) -> int:
    """That the process grows to."""
    return memory.resident(self.lives + self.weights + self.replays) + self.trace

  def __str__(self) -> str:
    gib = lambda size: f"{size / 2**30:.1f} GiB" if size >= 2**29 else f"{size / 2**20:.0f} MiB"
    grows = (
      f"; of that {gib(self.replays)} for the replays of {self.learners} learners and "
      f"{gib(self.trace)} for the trace grow with the steps"
      if self.learners
      else f"; of that the trace grows with the steps, {gib(self.trace)}"
    )
    return f"memory: at most about {gib(self.total)}{grows}, nothing else does"


def check(room: Room, config: RunConfig) -> None:
  """Refuses a run of more lives or a longer trace than fit into memory; what learners need is told
  apart, see `training.needs`.

  Raises:
    UserError: one line.
  """
  space = int(memory.MARGIN * memory.free()) + memory.held()
  least = memory.resident(room.lives) + room.trace
  require(
    least <= space,
    f"{len(config.arms) * config.seeds:,} streams of {config.steps:,} control steps need "
    f"{least / 2**30:,.1f} GiB, {space / 2**30:,.1f} GiB may be used; fewer --seeds, --arm or "
    "--steps need less",
  )


def of(config: RunConfig, spec: Spec, trained: DreamerConfig, repeat: int = 1) -> Room:
  """What a run needs.

  Args:
    config: of the run.
    spec: of its robot; one that it becomes is like it.
    trained: of its agent.
    repeat: control steps of a decision.
  """
  arms = [ARMS[arm] for arm in config.arms]
  learners = sum(arm.learns for arm in arms) * config.seeds
  agents = {(arm.agent, arm.breaks) for arm in arms}
  shape = (trained.size, len(spec.obs), len(spec.act))
  records = capacity(config.steps, spec.episode_steps, repeat)
  one = needs.need(*shape, records, trained.bins)
  params = 4 * needs.parameters(*shape, trained.bins)[0]
  lives = len(agents) * config.seeds
  # rows hold latents in full, records in half precision
  rows = 2 * one.record * CHUNK * HERD * min(-(-lives // HERD), MANY * len(runtime.cores()))
  residual = 4 * (2 * len(spec.obs) + 8)
  copies = 2 + sum(method.copies for method in methods.used(config.arms))
  at_once = min(learners, len(runtime.cores()))
  size = params / 4 / 640_867 * (config.adapt.batch or trained.batch) * trained.length / (4 * 64)
  scratch = int(at_once * SCRATCH * size / memory.GROWTH)
  more = config.parts * 8 + config.residuals * (2 * len(spec.obs) + 1)  # columns of four bytes
  return Room(
    lives * (config.adapt.refit * residual + LIFE) + rows,
    learners * (one.weights + copies * params) + (at_once + len(agents)) * one.weights + scratch,
    learners * one.replay,
    len(config.arms) * config.seeds * config.steps * (TRACE + 12 * more),
    learners,
  )
