"""Faults by name: the paper's, and realworldrl_suite's levels where they have a figure here.
`PRESETS` is the one table; no JAX needed.

A preset is a tuple of changes to one robot. Onsets are counted from the run's own onset, so a later
one makes a sequence; equal ones act at once.
"""

import pathlib
from dataclasses import dataclass, replace

from mjx_cl.config import FOREVER, RunConfig, fraction, named
from mjx_cl.errors import UserError

SCHEDULES = {
  "abrupt": "from the onset on in full",
  "ramp": "grows linearly over `period` control steps from the onset on, then stays",
  "intermittent": "on for `share` of every `period`, off for the rest",
  "cyclic": "rises and falls as (1 - cos) / 2 with `period`",
  "random_walk": "starts at 0; every `period` a normal step of deviation `share`, reflected at 0 "
  "and 1",
}


def place(schedule: str) -> int:
  """Place of a schedule in SCHEDULES; UserError for an unknown one."""
  if schedule not in SCHEDULES:
    raise UserError(f"unknown schedule {schedule!r}; choose from: {', '.join(SCHEDULES)}")
  return list(SCHEDULES).index(schedule)


@dataclass(frozen=True)
class Change:
  """One fault of a preset.

  Attributes:
    fault: its name.
    target: its name; None: drawn from the stream's seed.
    severity: in [0, 1].
    after: control steps from the run's onset.
    duration: control steps, None: never repaired.
    schedule: a name of SCHEDULES.
    period: control steps, see SCHEDULES.
    share: in [0, 1], see SCHEDULES.

  Raises:
    UserError: an unknown schedule or a number out of range.
  """

  fault: str
  target: str | None = None
  severity: float = 0.5
  after: int = 0
  duration: int | None = None
  schedule: str = "abrupt"
  period: int = 1000
  share: float = 0.5

  def __post_init__(self) -> None:
    fraction(self, "severity", "share")
    place(self.schedule)
    idle = self.schedule in ("intermittent", "random_walk") and self.share == 0
    if idle or (self.schedule == "cyclic" and self.period == 1):
      what = "share=0" if idle else "period=1"
      raise UserError(f"schedule {self.schedule!r} with {what} never acts; give more")
    for name, value in (("duration", self.duration), ("period", self.period)):
      if value is not None and not (1 <= value < FOREVER and value == int(value)):
        raise UserError(
          f"{name} must be a whole number in 1..{FOREVER - 1:,} control steps; got {value}"
        )


@dataclass(frozen=True)
class Preset:
  """Named changes of one robot, `*` for any.

  Attributes:
    robot: environment.
    changes: of it, in force one after the other.
    about: what happens, in words.
    source: of the figures.
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
SOCKS_GRIP = 0.575  # friction coefficient under rear wheels in socks; without them 0.65
SOCKS = (1.0 - SOCKS_GRIP / 0.65) / 0.95
SOCKS_AFTER = 42_000  # control steps, 35 minutes
# realworldrl_suite's levels: thirds of 9 steps of delay; deviation; severity of a burst, its
# probability, control steps that it lasts; delay of the reward, how often an action is repeated
LEVELS = {
  "easy": (1, 0.1, 0.1, 0.01, 1, 10, 1),
  "medium": (2, 0.3, 0.5, 0.05, 5, 20, 2),
  "hard": (3, 1.0, 1.0, 0.1, 10, 40, 3),
}

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
for _level, (
  _thirds,
  _deviation,
  _burst,
  _probability,
  _lasts,
  _reward,
  _repeats,
) in LEVELS.items():
  _rwrl = f"realworldrl_suite, level {_level}"
  _repeated = f", repeated actions (each for {_repeats})" if _repeats > 1 else ""
  _likely = f"with probability {_probability:g}, each for {_lasts} control step{'s' * (_lasts > 1)}"
  _challenges = {
    "observation-delay": ("delay", _thirds / 3, f"observations {3 * _thirds} control steps late"),
    "action-delay": ("command_delay", _thirds / 3, f"commands {3 * _thirds} control steps late"),
    "observation-noise": (
      "noise",
      _deviation,
      f"Gaussian noise of {_deviation:g} typical deviations (there: of raw units)",
    ),
    "action-noise": ("command_noise", _deviation, f"Gaussian noise of {_deviation:g} on commands"),
    "observation-dropout": ("dropout_burst", _burst, f"readings lost {_likely}"),
    "observation-stuck": ("freeze_burst", _burst, f"readings held {_likely}"),
  }
  PRESETS |= {
    f"any/{name}-{_level}": Preset("*", (Change(fault, "all", severity),), about, _rwrl)
    for name, (fault, severity, about) in _challenges.items()
  }
  PRESETS[f"any/all-{_level}"] = Preset(
    "*",
    tuple(Change(fault, "all", severity) for fault, severity, _ in _challenges.values()),
    "all of these at once; of the suite's combined challenge they leave out dummy channels, "
    f"changed lengths{_repeated} and the reward's delay ({_reward} control steps)",
    _rwrl,
  )
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
    UserError: an unknown name, or one of another robot.
  """
  shipped = env_name in {preset.robot for preset in PRESETS.values()}
  fits = lambda preset: preset.robot in (env_name, "*") or not (shipped or preset.becomes)
  if "+" in name:
    raise UserError(f"{name!r}: + joins faults, such as gear+noise; a preset stands alone")
  if name not in PRESETS:
    raise UserError(
      f"unknown preset {name!r}; choose from: {', '.join(n for n, p in PRESETS.items() if fits(p))}"
    )
  preset = PRESETS[name]
  if not fits(preset):
    raise UserError(f"preset {name!r} is of robot {preset.robot!r}, not of {env_name!r}")
  return preset


def _names(fault: str) -> list[str]:
  """What stands between the + of `fault` that belong to no path of a file."""
  at = fault.find(".py:")
  if at < 0:
    return fault.split("+")
  starts = [0, *(i + 1 for i in range(at) if fault[i] == "+")]
  begin = next((s for s in starts if pathlib.Path(fault[s : at + 3]).exists()), starts[-1])
  end = (fault + "+").index("+", at)
  before = _names(fault[: begin - 1]) if begin else []
  return [*before, fault[begin:end], *(_names(fault[end + 1 :]) if end < len(fault) else [])]


def joined(fault: str) -> tuple[str, ...]:
  """Names of the faults that `fault` joins by `+`, FILE.py:NAME among them, whose path may hold a
  +. UserError for an empty or repeated one.
  """
  names = tuple(_names(fault))
  if "" in names or len(set(names)) < len(names):
    raise UserError(f"fault {fault!r} joins an empty name, or a name twice; e.g. gear+noise")
  return names


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
    env_name: robot.
    fault: name of a fault; names joined by `+`, at once; or of a preset, which brings its own
      targets, severities and schedules.
    target: see `Change`; of one fault alone.
    severity: in [0, 1], of each; None: 0.5, or the preset's.
    duration: control steps, where the preset leaves it open; None: never repaired.
    schedule: see `Change`.
    period: see `Change`.
    share: see `Change`.

  Returns:
    Changes; of a robot that becomes another one, those of that other one.

  Raises:
    UserError: an unknown preset or schedule, one of another robot, a number out of range, a fault
      that is joined with itself, or settings that the preset brings itself.
  """
  level = Change.severity if severity is None else severity
  own = Change(fault, target, level, 0, duration, schedule, period, share)
  if not named(fault):
    names = joined(fault)
    if len(names) > 1 and target not in (None, "random"):
      raise UserError(f"target {target!r} is of one fault; each of {fault!r} draws its own")
    return tuple(replace(own, fault=name) for name in names)
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
