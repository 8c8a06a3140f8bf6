"""Whether the settings of a whole run fit together: its fault, its robot, its arms."""

import dataclasses

from mjx_cl.adapt.arms import ARMS, never_stops
from mjx_cl.config import FOREVER, RunConfig
from mjx_cl.errors import UserError, choose, require
from mjx_cl.faults import presets


def check(config: RunConfig) -> RunConfig:
  """The run with the severity that it has: of a fault that is no preset the default where none is
  given.

  Raises:
    UserError: for an unknown preset, schedule or arm, a number out of range, or settings that
      exclude each other.
  """
  for arm in config.arms:
    choose("arm", arm, ARMS)
  changes = presets.changes(config)
  moves = presets.becomes(config) is not None
  # a robot that becomes another one at an onset later than the last step never does
  last = FOREVER - 1 - max(c.after for c in changes) if moves else config.steps
  require(
    0 <= config.onset <= last,
    f"onset must lie in 0..{'' if moves else 'steps='}{last}; got {config.onset}",
  )
  _check_arms(config, {c.after for c in changes} | {0} if moves else {c.after for c in changes})
  if config.severity is None and not presets.named(config.fault):
    return dataclasses.replace(config, severity=changes[0].severity)
  return config


def _check_arms(config: RunConfig, moments: set[int]) -> None:
  """Raises UserError unless the arms fit snapshots, stops and the `moments` [control steps after
  the onset] at which the robot changes.
  """
  endless = [name for name, arm in ARMS.items() if never_stops(arm)]
  require(
    not config.snapshots or set(endless) & set(config.arms),
    f"snapshots={config.snapshots} needs an arm that never stops by itself: {', '.join(endless)}",
  )
  told = [arm for arm in config.arms if ARMS[arm].end.told]
  if told and not config.stops:
    raise UserError(
      f"arm {told[0]!r} needs stops: the folder of a run of the same seeds with arm "
      "oracle-budget and snapshots, which finds their oracle stops"
    )
  ends = ", ".join(name for name, arm in ARMS.items() if arm.end.told)
  require(told or not config.stops, f"stops={config.stops} needs an arm that ends there: {ends}")
  if told and len(moments) > 1:
    raise UserError(
      f"arm {told[0]!r} takes a robot that changes once; {config.fault!r} changes it "
      f"{len(moments)} times"
    )
