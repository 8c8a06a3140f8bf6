"""What the parts of a suite will take on this machine, seconds and bytes, before any is run."""

import functools
import time
from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl import detectors, envs, faults
from mjx_cl.adapt.arms import ARMS, FOREVER
from mjx_cl.config import RunConfig
from mjx_cl.errors import UserError
from mjx_cl.faults.presets import becomes, changes
from mjx_cl.io import memory
from mjx_cl.runs.identity import arm_agents
from mjx_cl.runs.loops import capacity
from mjx_cl.runs.records import acts
from mjx_cl.runs.suite import Part
from mjx_cl.scoring import stop_rule
from mjx_cl.training import agents, needs

# seconds on 2 quiet cores whose dense float32 products run at RATE [FLOP/s], of size1m
RATE = 440e9
WATCH_S, ACT_S = 0.25e-3, 0.11e-3  # monitor; acting: per stream and control step
# per stream and control step; a car's physics is part of its acting
PHYSICS_S = {"walker": 0.05e-3, "quadruped": 0.06e-3, "car": 0.0, "car_real": 0.06e-3}
# per replayed step that an update trains on, every state an imagination start, several streams side
# by side
UPDATE_S = 0.045 / (4 * 64)
COMPILE_S = 35.0  # programs of one part
# control steps that a finetuning with a stop rule lasts, of the robot that it goes on with: the
# mean in the published suites
ADAPTS = {"walker": 7_900, "quadruped": 9_200, "car": 8_100, "car_real": 15_000}
ADAPT = 9_000  # of any other robot


class Estimate(NamedTuple):
  """What a part will take.

  Attributes:
    streams: of the part.
    stream_steps: control steps of all streams.
    updates: of all streams.
    seconds: of wall time.
    bytes: that its process grows to.
  """

  streams: int
  stream_steps: int
  updates: float
  seconds: float
  bytes: int


def matmul_rate(seconds: float = 1.0) -> float:
  """FLOP/s of a dense float32 product of 2048 x 2048 matrices, the best of `seconds`; first calls,
  which compile, left out.
  """
  x = jnp.ones((2048, 2048), jnp.float32)
  dot = jax.jit(jnp.dot)
  dot(x, x).block_until_ready()
  best, end = float("inf"), time.perf_counter() + seconds
  while time.perf_counter() < end:
    begin = time.perf_counter()
    dot(x, x).block_until_ready()
    best = min(best, time.perf_counter() - begin)
  return 2 * 2048**3 / best


def finetunings(
  config: RunConfig, arm: str, seed: int | None = None, most: int = FOREVER
) -> list[int]:
  """Control steps of each finetuning that is expected of a stream: those of its arm's schedule, or,
  where it listens, one from each onset and repair on; as long as its robot's took (ADAPTS) where a
  rule ends it. What begins within another begins nothing.

  Args:
    config: of the run.
    arm: of the stream.
    seed: of the stream; None: the run's first.
    most: control steps after which it is told to end.
  """
  own, adapt, other = ARMS[arm], config.adapt, becomes(config)
  faulty = [change for change in changes(config) if change.fault != "none"]
  starts = [config.onset] * (other is not None)
  if not own.breaks:
    starts = []
  elif own.trigger.listens:
    starts += [
      config.onset + change.after + late
      for change in faulty
      if acts(change)
      for late in (0, change.duration)
      if late is not None
    ]
    starts = [max(step, adapt.warmup) for step in starts]
  else:
    starts += [config.onset + change.after for change in faulty]
    seed = config.first_seed if seed is None else seed
    starts = list(own.trigger.steps(adapt, tuple(starts), config.steps, seed))
  rule = ADAPTS.get(other or config.env, ADAPT) if own.end.rule else FOREVER
  limit = min(rule, own.end.limit(adapt), most)
  out, free = [], adapt.warmup
  for start in sorted(starts):
    if free <= start < config.steps:
      out.append(min(limit, config.steps - start))
      free = start + out[-1]
  return out


class Robots:
  """What the parts of a plan share, each built once."""

  def __init__(self) -> None:
    self.make = functools.cache(envs.make)
    self.learner = functools.cache(
      lambda name, agent: agents.of(self.make(name, "auto"), agent).agent.config
    )


def estimate(part: Part, rate: float, robots: Robots) -> Estimate:
  """Expected cost of a part on a machine whose dense float32 products run at `rate` FLOP/s. Physics
  is taken to scale alike: an estimate, no promise.

  Raises:
    UserError: for an agent or oracle stops that cannot be read, see `check`.
    FileError: likewise.
  """
  c = part.config
  spec, trained = robots.make(c.env, "auto").spec, robots.learner(c.env, c.agent)
  batch, starts = c.adapt.batch or trained.batch, c.adapt.last_starts
  shape = (trained.size, len(spec.obs), len(spec.act))
  size = needs.parameters(*shape, trained.bins)[0] / 640_867  # of size1m on a walker
  streams = lanes = len(c.arms) * c.seeds
  told = stop_rule.told(c)
  learning = sum(
    max(0, steps - c.adapt.start_windows - trained.length)
    for arm in c.arms
    for seed in range(c.first_seed, c.first_seed + c.seeds)
    for steps in finetunings(c, arm, seed, told[seed] if ARMS[arm].end.told else FOREVER)
  )
  updates = learning * c.adapt.ratio / (batch * trained.length)
  # imagination is about half of an update
  share = 1.0 if not starts else 0.5 + 0.5 * starts / trained.length
  physics = max(PHYSICS_S.get(name, 0.1e-3) for name in filter(None, (c.env, becomes(c))))
  seconds = (
    c.steps * (streams * WATCH_S * size + lanes * (ACT_S * size + physics))
    + updates * batch * trained.length * UPDATE_S * share * size
  )
  need = needs.need(*shape, capacity(c.steps, spec.episode_steps), trained.bins)
  return Estimate(
    streams,
    streams * c.steps,
    updates,
    COMPILE_S + seconds * RATE / rate,
    memory.resident(need.total(streams)),
  )


def estimates(parts: Iterable[Part], robots: Robots) -> dict[str, Estimate]:
  """Part -> Estimate on this machine."""
  rate = matmul_rate()
  return {p.name: estimate(p, rate, robots) for p in parts}


def check(part: Part, robots: Robots) -> None:
  """Refuses, before the suite starts, names and values that only the registries know: fault,
  target, detector, agent.
  """
  c = part.config
  try:
    detectors.make(c.detector, **c.settings)
    faults.build(changes(c), robots.make(becomes(c) or c.env, c.physics), c.onset)
    robots.learner(c.env, c.agent)
    arm_agents(c, robots.make(c.env, c.physics))
    stop_rule.told(c)
  except UserError as e:
    raise type(e)(f"part {part.name}: {e}") from None
