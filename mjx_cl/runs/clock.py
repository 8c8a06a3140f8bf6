"""How long a run goes on: what its chunks took so far, and the finetunings that are expected."""

import itertools
from collections.abc import Sequence

import numpy as np

from mjx_cl.adapt.arms import ARMS, FOREVER
from mjx_cl.config import CHUNK, DreamerConfig, RunConfig
from mjx_cl.faults.presets import becomes
from mjx_cl.io import runtime
from mjx_cl.runs import outlook, work
from mjx_cl.runs.groups import BAND
from mjx_cl.runs.lives import Lives
from mjx_cl.runs.outlook import Standing
from mjx_cl.runs.work import Learner, Load, Speed
from mjx_cl.training import needs
from mjx_cl.types import Spec

# seconds that the programs of lives and those of learners compile on the machine of work.RATE
COMPILE_S, COMPILE_LEARNER_S = 15.0, 35.0
FADES = 0.995  # what a chunk before the newest counts, beside that


class Clock:
  """Seconds left of a run.

    seconds of a kind of work  =  measured / modelled  x  expected, see work.Speed

  A kind that has not been measured goes by the mean of the others.

  Args:
    config: of the run.
    labels: (arm, seed) of each stream.
    together: herds of its lives, see work.herds.
    learners: how each stream learns.
    core: what a core is expected to take.
    cores: that share the work.
    repeat: control steps of a decision.
    stops: seed -> control steps after which an arm that is told ends.

  Attributes:
    joined: all streams are learners from the start, as on an accelerator.
  """

  joined = False

  def __init__(
    self,
    config: RunConfig,
    labels: Sequence[tuple[str, int]],
    together: list[list[list[int]]],
    learners: Sequence[Learner],
    core: Speed,
    cores: int,
    repeat: int = 1,
    stops: dict[int, int] | None = None,
  ) -> None:
    self.config, self.labels, self.together, self.learners = config, labels, together, learners
    self.core, self.cores, self.chunk, self.stops = core, cores, CHUNK * repeat, stops or {}
    self.measured, self.modelled = np.zeros(4), np.zeros(4)  # core seconds by kind
    self.lived, self.foretold = 0.0, 0.0  # seconds of wall time

  def speed(self) -> Speed:
    """Core seconds of each kind, as far as they have been measured."""
    mean = self.measured.sum() / max(1e-9, self.modelled.sum())
    known = self.modelled > 0
    each = np.where(known, self.measured / np.where(known, self.modelled, 1.0), mean)
    return Speed(*(each * np.array(self.core)))

  def see(self, done: Load, seconds: np.ndarray, wall: float) -> None:
    """Takes in a chunk in which nothing was compiled; seconds: core seconds by kind, (4,)."""
    self.measured = self.measured * FADES + seconds
    self.modelled = self.modelled * FADES + (done.kinds() * np.array(self.core)).sum(0)
    self.lived = self.lived * FADES + wall
    self.foretold = self.foretold * FADES + float(work.wall(done, self.speed(), self.cores).sum())

  def expected(self, now: int, stands: Sequence[Standing]) -> Load:
    """What is expected of the chunks from control step `now` on."""
    c = self.config
    most = lambda arm, seed: self.stops[seed] if ARMS[arm].end.told else FOREVER
    spells = [
      outlook.expected(c, arm, seed, now, own, most(arm, seed))
      for (arm, seed), own in zip(self.labels, stands)
    ]
    at = np.arange(now, c.steps, self.chunk)
    begun = [self.joined or own.since >= 0 for own in stands]
    return work.load(spells, begun, self.together, self.learners, at, self.chunk)

  def left(self, now: int, stands: Sequence[Standing], compiled: float = 0.0) -> float | None:
    """Seconds from control step `now` to the end; None: nothing is known yet.

    Args:
      now: control steps done.
      stands: how each stream stands.
      compiled: seconds that the programs of lives took to compile.
    """
    if not self.foretold:
      return None
    todo = self.expected(now, stands)
    rest = float(work.wall(todo, self.speed(), self.cores).sum()) * self.lived / self.foretold
    if self.joined or any(own.since >= 0 for own in stands) or not len(todo.bands):
      return rest
    return rest + COMPILE_LEARNER_S * compiled / COMPILE_S * min(1.0, float(todo.bands.max()))


def clock_of(
  config: RunConfig,
  spec: Spec,
  trained: DreamerConfig,
  repeat: int = 1,
  stops: dict[int, int] | None = None,
) -> Clock:
  """The Clock of a run on this process's cores.

  Args:
    config: of the run.
    spec: of its robot.
    trained: of its agent.
    repeat: control steps of a decision.
    stops: see Clock.
  """
  seeds = range(config.first_seed, config.first_seed + config.seeds)
  labels = list(itertools.product(config.arms, seeds))
  lives = [(ARMS[arm].agent, (ARMS[arm].breaks, seed)) for arm, seed in labels]
  shape = (trained.size, len(spec.obs), len(spec.act))
  size = needs.parameters(*shape, trained.bins)[0] / 640_867  # of size1m on a walker
  robots = filter(None, (config.env, becomes(config)))
  physics = max(work.PHYSICS_S.get(robot, 0.1e-3) for robot in robots)
  core = work.speed(config.adapt, trained, size, physics, repeat)
  own = [work.learner(ARMS[arm], config.adapt, trained, repeat) for arm, _ in labels]
  return Clock(config, labels, work.herds(lives), own, core, len(runtime.cores()), repeat, stops)


def counted(lives: Lives) -> Load:
  """What acts and is watched in the next chunk; its updates are not known yet."""
  alive = {life for life, who in lives.sharing.items() if who}
  herds = sum(any(life in alive for life in herd.lives) for herd in lives.herds)
  one = lambda x: np.array([float(x)])
  bands = len(lives.bands) * lives.band_size / BAND
  return Load(one(herds), one(bands), one(len(alive) + len(lives.place)), one(0), one(0))


def sorted_out(seconds: np.ndarray, learner: np.ndarray, updates: np.ndarray) -> np.ndarray:
  """Core seconds of a chunk by kind (4,), of `seconds` (streams, 3) of acting, watching, learning.

  Args:
    seconds: of lives.Chunk.
    learner: bool (streams,), at the chunk's begin.
    updates: int (streams,), that it took.
  """
  learns = learner & (updates > 0)
  acting, watching, learning = seconds.T
  return np.array(
    [
      acting[~learner].sum(),
      acting[learner].sum(),
      watching.sum() + learning[~learns].sum(),
      learning[learns].sum(),
    ]
  )
