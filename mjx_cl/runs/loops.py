"""What watches the streams of a run and learns from them: detector, monitor and learner, made from
its settings, and room for what they keep.
"""

import json
from typing import Any

from mjx_cl import detectors
from mjx_cl.adapt.loop import Loop, Programs
from mjx_cl.config import CHUNK, RunConfig
from mjx_cl.dreamer import replay
from mjx_cl.rollout.monitor import Monitor
from mjx_cl.runs.identity import known_as, threshold_of
from mjx_cl.training import agents, needs


def capacity(steps: int, episode: int, repeat: int = 1) -> int:
  """Replay records kept for a stream of `steps` control steps whose episodes last `episode`: all
  that it can write, one more than steps an episode. A robot that falls often begins more episodes
  than that, and in the end forgets its oldest records.
  """
  chunks = -(-steps // (CHUNK * repeat))
  return replay.room((chunks + 2) * CHUNK + steps // episode)


def make_loop(
  config: RunConfig,
  robots: list[Any],
  trained: agents.Trained,
  learners: int,
  programs: Programs,
) -> Loop:
  """The run's Loop.

  Args:
    config: of the run.
    robots: what each stream's robot is, and what it becomes where it becomes another.
    trained: the run's agent.
    learners: streams that may learn.
    programs: compiled ones that it may share.

  Raises:
    UserError: for a detector that is not there, or a run that does not fit into memory.
  """
  agent, spec, robot = trained.agent, robots[0].spec, known_as(robots[0])
  found = threshold_of(config)
  settings = config.settings | ({"threshold": found.value} if found else {})
  told = {"robot": robot, "agent": agents.called(trained)} | settings
  detector = detectors.make(config.detector, **told)
  signed = config.residuals or getattr(detectors.factory(config.detector), "signed", False)
  repeat, episode = trained.repeat, min(r.spec.episode_steps for r in robots)
  records = lambda steps: capacity(steps, episode, repeat)
  size = (agent.config.size, len(spec.obs), len(spec.act))
  bounded = ("steps", records)
  needs.check(*size, records(config.steps), max(1, learners), bounded, agent.config.bins)
  same = (
    agent.config,
    agent.obs_size,
    agent.act_size,
    agent.stepwise,
    config.form,
    config.actions,
    config.residuals,
    spec,
    detectors.factory(config.detector),
    config.detector,
    robot,
    told["agent"],
    json.dumps(settings, sort_keys=True, default=repr),
  )
  return Loop(
    agent,
    Monitor(agent, 15, config.form, config.actions, spec=spec, signed=signed),
    detector,
    spec,
    config.adapt,
    repeat,
    capacity=records(config.steps),
    same=same,
    programs=programs,
  )
