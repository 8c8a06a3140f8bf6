"""Which finetunings are expected of a stream, before it begins and while it lives.

A change of the robot is noticed with chance PROMPT, after a time of mean LATENCY; where it has not
been after t control steps,

  chance  =  PROMPT e / (1 - PROMPT + PROMPT e),    e = exp(-t / LATENCY)

Besides, a stream that listens begins LATE finetunings a control step. A finetuning that a rule ends
lasts as long as the published ones did, LENGTHS; one that has lasted `age` already is expected to
last the mean of those that were longer.
"""

import math
from typing import NamedTuple

import numpy as np

from mjx_cl.adapt import decide, methods
from mjx_cl.adapt.arms import ARMS, FOREVER
from mjx_cl.config import CHUNK, AdaptConfig, RunConfig
from mjx_cl.faults.presets import becomes, changes
from mjx_cl.runs.records import acts
from mjx_cl.runs.work import Spell

# PROMPT, LATENCY [control steps] and LATE [per control step] of the published runs (results/*/
# runs.parquet, events.parquet), by robot at the start; tests check them against these files
NOTICES = {
  "walker": (0.60, 270, 6.9e-6),
  "quadruped": (0.72, 212, 27e-6),
  "car": (0.66, 57, 14e-6),
}
ANY = (0.65, 200, 14e-6)  # of any other robot
# control steps that a finetuning with a stop rule lasts, of the robot that it goes on with: mean,
# and the middle of each tenth
ADAPTS = {"walker": 8_000, "quadruped": 9_200, "car": 7_200, "car_real": 13_400}
ADAPT = 9_000  # of any other robot
LENGTHS = {
  "walker": (5900, 6000, 6000, 6100, 6200, 6700, 7500, 12_000, 12_000, 13_800),
  "quadruped": (3900, 6000, 6300, 6800, 7500, 8600, 11_400, 12_000, 13_000, 15_400),
  "car": (6000, 6100, 6300, 6600, 6700, 6900, 7100, 7700, 8500, 10_100),
  "car_real": (4700, 7100, 7700, 8900, 9900, 11_000, 13_300, 17_600, 24_500, 29_200),
}


def starts(config: RunConfig, arm: str, seed: int | None = None) -> list[int]:
  """Control steps at which a stream may begin a finetuning: those of its arm's schedule, or, where
  it listens, each onset and repair.

  Args:
    config: of the run.
    arm: of the stream.
    seed: of the stream; None: the run's first.
  """
  own, adapt = ARMS[arm], config.adapt
  faulty = [change for change in changes(config) if change.fault != "none"]
  at = [config.onset] * (becomes(config) is not None)
  if not own.breaks:
    return []
  if own.trigger.listens:
    at += [
      config.onset + change.after + late
      for change in faulty
      if acts(change)
      for late in (0, change.duration)
      if late is not None
    ]
    at = [max(step, adapt.warmup) for step in at]
  else:
    at += [config.onset + change.after for change in faulty]
    seed = config.first_seed if seed is None else seed
    at = list(own.trigger.steps(adapt, tuple(at), config.steps, seed))
  return sorted(at)


def scale(adapt: AdaptConfig) -> float:
  """How long finetunings may last at these settings, of those of the published runs."""
  return max(adapt.least, adapt.patience * CHUNK) / AdaptConfig.least


def limit(config: RunConfig, arm: str, most: int = FOREVER) -> tuple[float, float]:
  """Control steps that a finetuning of an arm is expected to last, and those that it lasts at most;
  `most`: after which it is told to end.
  """
  end = min(ARMS[arm].end.limit(config.adapt), most)
  if not ARMS[arm].end.rule:
    return end, end
  mean = ADAPTS.get(becomes(config) or config.env, ADAPT)
  return min(end, round(mean * scale(config.adapt))), end


def finetunings(
  config: RunConfig, arm: str, seed: int | None = None, most: int = FOREVER
) -> list[int]:
  """Control steps of each finetuning of a stream that notices every change at once. What begins
  within another begins nothing.

  Args:
    config: of the run.
    arm: of the stream.
    seed: of the stream; None: the run's first.
    most: control steps after which it is told to end.
  """
  mean, _ = limit(config, arm, most)
  out, free = [], config.adapt.warmup
  for start in starts(config, arm, seed):
    if free <= start < config.steps:
      out.append(int(min(mean, config.steps - start)))
      free = start + out[-1]
  return out


class Standing(NamedTuple):
  """How a stream stands.

  Attributes:
    phase: of phases.PHASES.
    since: control step at which its newest finetuning began, -1: none yet.
  """

  phase: int = decide.NOMINAL
  since: int = -1


NEW = Standing()


def length(config: RunConfig, arm: str, age: int, most: int = FOREVER) -> float:
  """Control steps that a finetuning which has lasted `age` is expected to last in all."""
  mean, end = limit(config, arm, most)
  if not ARMS[arm].end.rule:
    return end
  each = LENGTHS.get(becomes(config) or config.env, (mean,))
  longer = [x for x in np.minimum(np.multiply(each, scale(config.adapt)), end) if x > age]
  return float(np.mean(longer)) if longer else min(end, age + config.adapt.patience * CHUNK / 4)


def expected(
  config: RunConfig,
  arm: str,
  seed: int,
  now: int = 0,
  stands: Standing = NEW,
  most: int = FOREVER,
) -> list[Spell]:
  """Finetunings of a stream that are under way in control step `now` or expected later."""
  own, adapt, out, free = ARMS[arm], config.adapt, [], max(now, config.adapt.warmup)
  if stands.phase == decide.ADAPTING:
    steps = length(config, arm, now - stands.since, most)
    out.append(Spell(stands.since, min(steps, config.steps - stands.since)))
    free = stands.since + int(steps)
  if stands.phase == decide.ABORTED or not (own.learns and methods.of(own).learns):
    return out
  prompt, latency, late = NOTICES.get(config.env, ANY)
  mean = length(config, arm, -1, most)

  def add(start: float, chance: float) -> None:
    steps = min(mean, config.steps - start)
    if steps > 0:
      out.append(Spell(int(start), steps, chance))

  heard = own.trigger.listens
  for start in starts(config, arm, seed):
    if start <= stands.since:
      continue
    if start >= free:
      add(start + heard * latency, prompt if heard else 1.0)
      free = start + int(mean)
    elif heard and start < now and free <= now:
      missed = prompt * math.exp(-(now - start) / latency)
      add(now + latency, missed / (1 - prompt + missed))
  if heard:
    begin = max(now, adapt.warmup)
    watching = config.steps - begin - sum(s.chance * (s.start + s.steps - begin) for s in out)
    add((begin + config.steps) / 2, min(1.0, late * max(0.0, watching)))
  return out
