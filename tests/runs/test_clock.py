"""The model of a run's cost: what is expected of a stream, the time left, memory."""

import dataclasses
import pathlib

import numpy as np
import pytest

from mjx_cl.adapt import decide
from mjx_cl.adapt.arms import ARMS, FOREVER
from mjx_cl.config import AdaptConfig, DreamerConfig, RunConfig
from mjx_cl.faults.presets import becomes, changes
from mjx_cl.io import tables
from mjx_cl.runs import outlook, work
from mjx_cl.runs.clock import Clock
from mjx_cl.runs.outlook import Standing
from mjx_cl.runs.work import Speed, Spell
from mjx_cl.scoring import stop_rule

RESULTS = pathlib.Path(__file__).parents[2] / "results"
CORE = Speed(0.066, 0.068, 0.016, 0.105)  # size1m on a walker
SLOW = Speed(0.4, 0.3, 0.03, 0.45)  # another machine: slower, and not evenly so


@pytest.fixture(scope="module")
def published():
  """(name, RunConfig, rows of runs.parquet, adaptations) of each published run."""
  out = []
  for file in sorted(RESULTS.rglob("runs.parquet")):
    said = tables.read_json(file.parent / "config.json")
    known = lambda kind, values: {
      f.name: values[f.name] for f in dataclasses.fields(kind) if f.name in values
    }
    adapt = AdaptConfig(**known(AdaptConfig, said["adapt"]))
    fixed = {"adapt": adapt, "arms": tuple(said["arms"]), "physics": "auto"}
    config = RunConfig(**known(RunConfig, said) | fixed)
    spans = stop_rule.spans(tables.read_rows(file.parent / "events.parquet"))
    name = str(file.parent.relative_to(RESULTS))
    out.append((name, config, tables.read_rows(file), spans))
  return out


def clock_of(config, cores=2):
  labels = [
    (arm, seed)
    for arm in config.arms
    for seed in range(config.first_seed, config.first_seed + config.seeds)
  ]
  lives = [(ARMS[arm].agent, (ARMS[arm].breaks, seed)) for arm, seed in labels]
  own = work.learner(config.adapt, DreamerConfig(batch=8, length=64))
  stops = dict.fromkeys(range(1000), FOREVER)
  return Clock(config, labels, work.herds(lives), own, CORE, cores, stops=stops)


def lived(clock, spans):
  """The chunks of a published run as `work.load` has them, and how streams stood after each."""
  c = clock.config
  own = [
    [
      Spell(s["since"], (c.steps if s["stop"] is None else s["stop"] + 1) - s["since"])
      for s in spans
      if (s["arm"], s["seed"]) == label
    ]
    for label in clock.labels
  ]
  outcomes = [
    [s["outcome"] for s in spans if (s["arm"], s["seed"]) == label] for label in clock.labels
  ]
  at = np.arange(0, c.steps, clock.chunk)
  phase = {"aborted": decide.ABORTED, "converged": decide.CONVERGED, "ended": decide.ENDED}

  def stands(now):
    out = []
    for spells, ends in zip(own, outcomes):
      past = [(s, end) for s, end in zip(spells, ends) if s.start < now]
      if not past:
        out.append(Standing())
      else:
        (start, steps, _), end = past[-1]
        out.append(Standing(decide.ADAPTING if start + steps > now else phase.get(end, 0), start))
    return out

  return at, work.load(own, [False] * len(own), clock.together, clock.own, at, clock.chunk), stands


def told_after_a_tenth(config, spans, core, cores=2):
  """(seconds left as the clock says, as they are) after a tenth of a run's seconds."""
  clock = clock_of(config, cores)
  at, done, stands = lived(clock, spans)
  each = work.wall(done, core, cores) * 1.07  # what is logged and written besides
  for k, begin in enumerate(at):
    own = work.Load(*(x[k : k + 1] for x in done))
    clock.see(own, (own.kinds() * np.array(core))[0], each[k])
    if each[: k + 1].sum() >= 0.1 * each.sum():
      return clock.left(begin + clock.chunk, stands(begin + clock.chunk)), each[k + 1 :].sum()
  raise AssertionError("a run has a tenth")
