"""Faults by name: the paper's, and realworldrl_suite's levels where they have a figure here.
`PRESETS` is the one table; no JAX needed.

A preset is a tuple of changes to one robot. Onsets are counted from the run's own onset, so a later
one makes a sequence; equal ones act at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from mjx_cl.config import FOREVER, RunConfig, named
from mjx_cl.errors import UserError

SCHEDULES = {
  "abrupt": "from the onset on in full",
  "ramp": "grows linearly over `period` control steps from the onset on, then stays",
  "intermittent": "on for `share` of every `period`, off for the rest",
  "cyclic": "rises and falls as (1 - cos) / 2 with `period`",
  "random_walk": "starts at 0; every `period` a normal step of deviation `share`, reflected at 0 "
  "and 1",
}


@dataclass(frozen=True)
class Change:
  """One fault of a preset.

  Attributes:
    fault, target: names; target None: drawn from the stream's seed.
    severity: in [0, 1].
    after: control steps from the run's onset.
    duration: control steps, None: never repaired.
    schedule, period, share: see faults.schedule.
  """

  fault: str
  target: str | None = None
  severity: float = 0.5
  after: int = 0
  duration: int | None = None
  schedule: str = "abrupt"
  period: int = 1000
  share: float = 0.5


@dataclass(frozen=True)
class Preset:
  """Named changes of one robot, `*` for any.

  Attributes:
    robot: environment. changes: see Change. source: of the figures.
    becomes: environment that the robot turns into at the end of its first episode that ends at the
      onset or later, None: stays.
    then: changes of the robot that it has become, instead of `changes`; they come an episode after
      the onset or later.
  """

  robot: str
  changes: tuple[Change, ...]
  about: str
  source: str
  becomes: str | None = None
  then: tuple[Change, ...] = ()


THIRD = (1.0 - 1.0 / 3.0) / 0.95  # severity of velocity_limit that leaves a third
# coefficient left under the rear wheels, of 0.65: a car that has adapted loses a fifth of its
# reward, results/socks.json
SOCKS_GRIP = 0.575
SOCKS = (1.0 - SOCKS_GRIP / 0.65) / 0.95
SOCKS_AFTER = 42_000  # control steps, 35 minutes
# thirds of 9 steps of delay; deviation; severity of a burst, probability that it begins and control
# steps that it lasts
LEVELS = {
  "easy": (1, 0.1, 0.1, 0.01, 1),
  "medium": (2, 0.3, 0.5, 0.05, 5),
  "hard": (3, 1.0, 1.0, 0.1, 10),
}
THERE = {
  "easy": (10, 1),
  "medium": (20, 2),
  "hard": (40, 3),
}  # the suite's delay of the reward, length of an action

PRESETS: dict[str, Preset] = {
  "walker/gear-half": Preset(
    "walker",
    (Change("gear", None, 0.5),),
    "one random joint's gear ratio halved",
    "the paper, walker",
  ),
  "walker/gear-half-twice": Preset(
    "walker",
    (Change("gear", "right_knee", 0.5, 0, 10_000), Change("gear", "right_knee", 0.5, 20_000)),
    "right knee's gear halved for 10,000 control steps, whole for 10,000, halved again",
    "the paper's fault, twice",
  ),
  "quadruped/rh-velocity-third": Preset(
    "quadruped",
    (Change("velocity_limit", "RH", THIRD),),
    "right hind leg's velocity limits cut to a third",
    "the paper, ANYmal",
  ),
  "car/sim-to-real": Preset(
    "car",
    (),
    "the simulated car becomes the stand-in for the real one at an episode's end",
    "the paper, race car",
    "car_real",
  ),
  "car/transfer-then-socks": Preset(
    "car",
    (),
    (
      "the simulated car becomes the stand-in for the real one, with socks on its rear wheels "
      f"{SOCKS_AFTER:,} control steps after the onset"
    ),
    "the paper, race car; friction as in car/socks",
    "car_real",
    (Change("friction", "rear", SOCKS, SOCKS_AFTER),),
  ),
  "car/socks": Preset(
    "car_real",
    (Change("friction", "rear", SOCKS),),
    f"socks on the rear wheels: friction {SOCKS_GRIP} in place of 0.65",
    "the paper, race car; chosen to cost the paper's 20 % of reward, no figure of a sock was found",
  ),
}
for _level, (_thirds, _deviation, _burst, _probability, _lasts) in LEVELS.items():
  _rwrl = f"realworldrl_suite, level {_level}"
  _reward, _repeats = THERE[_level]
  _once = f"each for {_lasts} control step{'s' * (_lasts > 1)}"
  _beyond = "; of the suite's combined challenge they leave out dummy channels, changed lengths" + (
    f", repeated actions (each for {_repeats}) and the reward's delay ({_reward} control steps)"
    if _repeats > 1
    else f" and the reward's delay ({_reward} control steps)"
  )
  PRESETS |= {
    f"any/observation-delay-{_level}": Preset(
      "*",
      (Change("delay", "all", _thirds / 3),),
      f"observations {3 * _thirds} control steps late",
      _rwrl,
    ),
    f"any/action-delay-{_level}": Preset(
      "*",
      (Change("command_delay", "all", _thirds / 3),),
      f"commands {3 * _thirds} control steps late",
      _rwrl,
    ),
    f"any/observation-noise-{_level}": Preset(
      "*",
      (Change("noise", "all", _deviation),),
      f"Gaussian noise of {_deviation:g} typical deviations (there: of raw units)",
      _rwrl,
    ),
    f"any/action-noise-{_level}": Preset(
      "*",
      (Change("command_noise", "all", _deviation),),
      f"Gaussian noise of {_deviation:g} on commands",
      _rwrl,
    ),
    f"any/observation-dropout-{_level}": Preset(
      "*",
      (Change("dropout_burst", "all", _burst),),
      f"readings lost with probability {_probability:g}, {_once}",
      _rwrl,
    ),
    f"any/observation-stuck-{_level}": Preset(
      "*",
      (Change("freeze_burst", "all", _burst),),
      f"readings held with probability {_probability:g}, {_once}",
      _rwrl,
    ),
    f"any/all-{_level}": Preset(
      "*",
      tuple(
        Change(f, "all", s)
        for f, s in (
          ("delay", _thirds / 3),
          ("command_delay", _thirds / 3),
          ("noise", _deviation),
          ("command_noise", _deviation),
          ("dropout_burst", _burst),
          ("freeze_burst", _burst),
        )
      ),
      f"all of these at once{_beyond}",
      _rwrl,
    ),
  }
for _level, _damping, _grip in (("easy", 0.05, 0.2), ("medium", 0.25, 0.5), ("hard", 1.0, 1.0)):
  PRESETS |= {
    f"walker/damping-{_level}": Preset(
      "walker",
      (Change("joint_damping", "all", _damping),),
      f"joint damping 0.1 + {10 * _damping:g} N m s/rad",
      "realworldrl_suite, walker: range 0.1 to 10, deviation 0.5",
    ),
    f"walker/friction-{_level}": Preset(
      "walker",
      (Change("friction", "all", _grip),),
      f"contact friction {0.7 * (1 - 0.95 * _grip):.2f}",
      "realworldrl_suite, walker: range 0.01 to 2",
    ),
  }
# lengths of limbs are excluded: MuJoCo calls a change of geom_size at run time unsafe


def find(name: str, env_name: str) -> Preset:
  """The preset `name` for a robot; `any/...` fits every robot. A robot of one's own may take that
  of a shipped one, from which it may be derived: whether it has what the faults act on, and the
  targets, is for them to say. What turns a robot into another one it may not.

  Raises:
    UserError for an unknown name, or one of another robot.
  """
  shipped = env_name in {preset.robot for preset in PRESETS.values()}
  fits = lambda preset: preset.robot in (env_name, "*") or not (shipped or preset.becomes)
  if name not in PRESETS:
    raise UserError(
      f"unknown preset {name!r}; choose from: {', '.join(n for n, p in PRESETS.items() if fits(p))}"
    )
  preset = PRESETS[name]
  if not fits(preset):
    raise UserError(f"preset {name!r} is of robot {preset.robot!r}, not of {env_name!r}")
  return preset


def resolve(
  env_name: str,
  fault: str,
  target: str | None = None,
  severity: float | None = None,
  duration: int | None = None,
  schedule: str = "abrupt",
  period: int = 1000,
  share: float = 0.5,
) -> tuple[Change, ...]:
  """The changes that a fault or a preset stands for on a robot, its settings checked.

  Args:
    fault: name of a fault, or of a preset, which brings its own targets, severities and schedules.
    severity: in [0, 1]; None: 0.5, or the preset's. duration: control steps, where the preset
      leaves it open; None: never repaired.
    schedule, period, share: see SCHEDULES and `Change`.

  Returns:
    Changes; of a robot that becomes another one, those of that other one.

  Raises:
    UserError for an unknown preset or schedule, one of another robot, a number out of range, or
    settings that the preset brings itself.
  """
  if severity is not None and not 0.0 <= severity <= 1.0:  # also true for nan
    raise UserError(f"severity must lie in [0, 1]; got {severity}")
  if not 0.0 <= share <= 1.0:
    raise UserError(f"share must lie in [0, 1]; got {share}")
  if schedule not in SCHEDULES:
    raise UserError(f"unknown schedule {schedule!r}; choose from: {', '.join(SCHEDULES)}")
  for name, value in (("duration", duration), ("period", period)):
    if value is not None and not (1 <= value < FOREVER and value == int(value)):
      raise UserError(
        f"{name} must be a whole number in 1..{FOREVER - 1:,} control steps; got {value}"
      )
  if not named(fault):
    return (
      Change(
        fault,
        target,
        Change.severity if severity is None else severity,
        0,
        duration,
        schedule,
        period,
        share,
      ),
    )
  preset = find(fault, env_name)
  if severity is not None or target is not None:
    raise UserError(
      f"preset {fault!r} brings its own severity and target; leave severity and target out"
    )
  if (schedule, period, share) != ("abrupt", 1000, 0.5):
    raise UserError(
      f"preset {fault!r} brings its own schedule; leave schedule, period and share out"
    )
  if preset.becomes:
    if duration is not None:
      raise UserError(
        f"preset {fault!r} turns the robot into {preset.becomes!r} for good; leave duration out"
      )
    return preset.then or (Change("none"),)
  return tuple(
    replace(c, duration=duration if c.duration is None else c.duration) for c in preset.changes
  )


def becomes(config: RunConfig) -> str | None:
  """The environment that the robot of a run becomes, None: stays what it is."""
  return find(config.fault, config.env).becomes if named(config.fault) else None


def changes(config: RunConfig) -> tuple[Change, ...]:
  """The faults of a run, with its duration where the preset leaves it open; of a robot that becomes
  another one, those of that other one.
  """
  return resolve(
    config.env,
    config.fault,
    config.target,
    config.severity,
    config.duration,
    config.schedule,
    config.period,
    config.share,
  )
