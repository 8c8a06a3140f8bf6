"""What the parts of a suite will take on this machine, seconds and bytes, before any is run."""

import functools
import time
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl import detectors, envs, faults
from mjx_cl.errors import UserError
from mjx_cl.faults.presets import becomes, changes
from mjx_cl.runs import room, work
from mjx_cl.runs.clock import COMPILE_LEARNER_S, COMPILE_S, clock_of
from mjx_cl.runs.identity import arm_agents, known_as
from mjx_cl.runs.outlook import Standing
from mjx_cl.runs.suite import Part
from mjx_cl.scoring import stop_rule
from mjx_cl.training import agents


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


class Robots:
  """What the parts of a plan share, each built once."""

  def __init__(self) -> None:
    self.make = functools.cache(envs.make)
    self._agent = functools.cache(self._load)

  def _load(self, name: str, agent: str | None) -> tuple[Any, str, int]:
    trained = agents.of(self.make(name, "auto"), agent)
    return trained.agent.config, agents.called(trained), trained.repeat

  def learner(self, name: str, agent: str | None) -> Any:
    """DreamerConfig of a robot's agent."""
    return self._agent(name, agent)[0]

  def repeat(self, name: str, agent: str | None) -> int:
    """Control steps of a decision of the agent."""
    return self._agent(name, agent)[2]

  def called(self, name: str, agent: str | None) -> str:
    """The agent's own name, see `agents.called`."""
    return self._agent(name, agent)[1]


def estimate(part: Part, rate: float, robots: Robots) -> Estimate:
  """Expected cost of a part on a machine whose dense float32 products run at `rate` FLOP/s. Physics
  is taken to scale alike: an estimate, no promise.

  Raises:
    UserError: for an agent or oracle stops that cannot be read, see `check`.
    FileError: likewise.
  """
  c = part.config
  env, trained = robots.make(c.env, "auto"), robots.learner(c.env, c.agent)
  repeat = robots.repeat(c.env, c.agent)
  clock = clock_of(c, env.spec, trained, repeat, stops=stop_rule.told(c))
  chunks = clock.expected(0, [Standing()] * len(clock.labels))
  # RATE is that of two cores, `rate` that of all
  slower = work.RATE / 2 / (rate / clock.cores)
  compiling = COMPILE_S + COMPILE_LEARNER_S * min(1.0, float(chunks.bands.max()))
  return Estimate(
    len(clock.labels),
    len(clock.labels) * c.steps,
    float(chunks.updates.sum()),
    compiling + slower * float(work.wall(chunks, clock.core, clock.cores).sum()),
    room.of(c, env.spec, trained, repeat).total,
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
    faults.build(changes(c), robots.make(becomes(c) or c.env, c.physics), c.onset)
    robot, agent = known_as(robots.make(c.env, c.physics)), robots.called(c.env, c.agent)
    detectors.make(c.detector, **({"robot": robot, "agent": agent} | c.settings))
    arm_agents(c, robots.make(c.env, c.physics))
    stop_rule.told(c)
  except UserError as e:
    raise type(e)(f"part {part.name}: {e}") from None
