"""What a user is told before a run starts: its threshold, and what may not have been meant."""

import dataclasses
import inspect

from mjx_cl import detectors, envs
from mjx_cl.adapt.arms import ARMS
from mjx_cl.config import CHUNK, RunConfig, own_agent, whose
from mjx_cl.faults.presets import becomes, changes
from mjx_cl.runs.identity import agent_of, known_as
from mjx_cl.runs.records import acts
from mjx_cl.scoring import intervals


def watching(config: RunConfig) -> str | None:
  """The threshold that a detector has without having been given one, in a line; None where it was,
  takes none, looks at nothing or is one of the paper's rules with settings of its own.
  """
  name = detectors.split(config.detector)[0]
  build = detectors.factory(config.detector)
  if (
    name == "rolling_sigma_plain"
    or getattr(build, "reference", False)
    or "threshold" in config.settings
    or "threshold" not in detectors.known_settings(build)
    or not any(ARMS[arm].trigger.listens for arm in config.arms)
  ):
    return None
  if name == "rolling_sigma":
    return _uncalibrated(config)
  robot = known_as(envs.make(config.env, config.physics))
  found = detectors.calibrated(config.detector, robot, config.settings, agent_of(config))
  if found is None:
    default = inspect.signature(build).parameters.get("threshold")
    own = "its own default threshold" + (
      f", {default.default:g}" if default and isinstance(default.default, (int, float)) else ""
    )
    return (
      f"detector {config.detector} runs at {own}: none was found for {robot} with these "
      "settings, and false alarms may be many; --set threshold=... "
      "(`mjx-cl calibrate` finds one)"
    )
  steps = found.arl0 * found.alarms
  low, high = (steps / n for n in reversed(intervals.poisson(found.alarms)))
  shared = found == detectors.calibrated(config.detector, robot, config.settings)
  agent = own_agent(robot) if shared else agent_of(config)
  plain = {f.name: (f.default,) for f in dataclasses.fields(RunConfig)} | {
    "env": (robot,),
    "agent": (None, agent) if shared else (config.agent,),
  }
  other = [
    k
    for k in ("env", "agent", "form", "actions", "deterministic")
    if getattr(config, k) not in plain[k]
  ]
  return (
    f"detector {config.detector} at threshold {found.value:.6g}, at which the shipped {agent} "
    f"gave {found.alarms} false alarms in {steps:,.0f} healthy control steps, "
    f"one in {found.arl0:,.0f} [{low:,.0f}, {high:,.0f}]"
    + (f"; this run has another {' and '.join(other)}" if other else "")
  )


def _uncalibrated(config: RunConfig) -> str | None:
  """Whose settings `rolling_sigma` takes on a robot that it is not calibrated for, in a line."""
  known, agent = detectors.CALIBRATED, agent_of(config)
  if own_agent(config.env) in known or agent in known:
    return None
  robot = known_as(envs.make(config.env, config.physics))
  if own_agent(robot) in known:
    return None
  taken = whose(known, robot, agent)
  return (
    f"detector {config.detector} runs with the settings calibrated for {taken}, at threshold "
    f"{known[taken]['threshold']:g}: it is not calibrated for {robot}, and false alarms may be "
    "many; --set threshold=... sets another (`mjx-cl calibrate` finds one)"
  )


def doubts(config: RunConfig) -> list[str]:
  """What a user may not have meant, one line each."""
  adapt, warmup, said = config.adapt, config.adapt.warmup, []
  if (
    config.onset >= config.steps
    and becomes(config) is None
    and any(acts(change) for change in changes(config))
  ):
    said.append(
      f"the run ends at step {config.steps:,}, before its fault at {config.onset:,}: no stream "
      "meets it"
    )
  least = max(adapt.least, adapt.patience * CHUNK)
  if adapt.budget < least and any(ARMS[arm].end.rule for arm in config.arms):
    said.append(
      f"adapt.budget={adapt.budget:,} ends every finetuning before one may converge, after "
      f"{least:,} steps (adapt.least, {CHUNK} adapt.patience)"
    )
  if adapt.start_windows >= config.steps and any(ARMS[arm].learns for arm in config.arms):
    said.append(
      f"adapt.start_windows={adapt.start_windows:,} is more than the replay of {config.steps:,} "
      "steps ever holds: nothing is learnt"
    )
  if warmup >= config.steps:
    said.append(
      f"the run ends at step {config.steps:,}, within adapt.warmup={warmup:,}: no alarm can "
      "start anything"
    )
  elif warmup >= config.onset:
    listens = any(ARMS[arm].trigger.listens for arm in config.arms)
    said.append(
      f"onset {config.onset:,} lies within adapt.warmup={warmup:,}: "
      + ("an alarm before its end starts nothing, and " if listens else "")
      + "without a reward before the onset no stream "
      "counts as affected or recovered; a later --onset or a smaller --adapt.warmup would do"
    )
  return said


def notes(config: RunConfig) -> list[str]:
  """Everything that a user is told, one line each."""
  return [*filter(None, [watching(config)]), *doubts(config)]
