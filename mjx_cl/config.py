"""What can be chosen: frozen dataclasses, presets, and all validation. Free of JAX, so that
`--help` is quick.
"""

from __future__ import annotations

import dataclasses
import json
import math
import numbers
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from mjx_cl.errors import UserError, choose
from mjx_cl.sizes import SIZES

if TYPE_CHECKING:
  from typing import TypeVar

  from _typeshed import DataclassInstance

  Settled = TypeVar("Settled", bound=DataclassInstance)

# decisions between two rounds of updates, of a training as of a run, where the stop rule looks as
# often
CHUNK = 64
FOREVER = 2**31 - 1  # control steps that no run outlasts


def positive(config: object, *names: str) -> None:
  """Raises unless every named field is a finite number above 0."""
  for name in names:
    value = getattr(config, name)
    if not (math.isfinite(value) and value > 0):
      raise UserError(f"{name} must be above 0; got {value}")


def not_below_0(config: object, *names: str) -> None:
  """Raises unless every named field is a finite number of at least 0."""
  for name in names:
    value = getattr(config, name)
    if not (math.isfinite(value) and value >= 0):
      raise UserError(f"{name} must be 0 or above; got {value}")


KINDS = {
  "bool": bool,
  "int": numbers.Integral,
  "float": numbers.Real,
  "str": str,
  "None": type(None),
}


def kinds(where: str, annotations: dict[str, str], values: dict, before: str = "") -> None:
  """Raises UserError where a value is of another kind than its annotation says, such as `int |
  None`; what is annotated otherwise, or not at all, passes.
  """
  for name, value in values.items():
    words = [word.strip() for word in annotations.get(name, "").split("|")]
    if not all(word in KINDS for word in words):
      continue
    allowed = tuple(KINDS[word] for word in words)
    if not isinstance(value, allowed) or isinstance(value, bool) and bool not in allowed:
      raise UserError(
        f"{where}: {before}{name} takes "
        f"{' or '.join(word for word in words if word != 'None')}; got {value!r}"
      )


def field_kinds(where: str, of: type, values: dict, before: str = "") -> None:
  """`kinds` of the fields of the dataclass `of`."""
  kinds(where, {field.name: str(field.type) for field in dataclasses.fields(of)}, values, before)


def whole(config: object, *names: str, most: int = FOREVER - 1) -> None:
  """Raises unless every named field is a whole number of at least 0 and at most `most`."""
  for name in names:
    value = getattr(config, name)
    if not (isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= most):
      raise UserError(f"{name} must be a whole number in 0..{most:,}; got {value}")


def named(fault: str) -> bool:
  """Whether this names a preset (robot/name) and not a fault; a fault may stand in a file,
  path/to/file.py:name.
  """
  return "/" in fault and ":" not in fault


def check_seeds(first: int, count: int = 1, name: str = "seed") -> None:
  """Raises unless `count` seeds from `first` on are whole numbers from 0 to 2,147,483,647, as files
  hold them.
  """
  if not 0 <= first <= 2**31 - count:
    raise UserError(f"{name} must lie in 0..{2**31 - count:,}; got {first}")


def finite(values: dict, where: str) -> None:
  """Raises where a setting is a number that is not finite: results could not hold it as JSON."""
  for name, value in values.items():
    if isinstance(value, float) and not math.isfinite(value):
      raise UserError(f"{where}: {name} must be finite; got {value}")


def settings(pairs: Iterable[str]) -> dict:
  """("a=1", "b=x") -> {"a": 1, "b": "x"}; values are read as JSON where they are JSON."""
  out = {}
  for pair in pairs:
    name, sign, value = pair.partition("=")
    if not sign:
      raise UserError(f"--set takes name=value; got {pair!r}")
    try:
      out[name] = json.loads(value.lower() if value in ("True", "False") else value)
    except ValueError:
      out[name] = value
  finite(out, "--set")
  return out


# settings by name; on the command line --set name=value ...
Settings = Annotated[
  dict,
  tyro.conf.arg(name="set"),
  tyro.constructors.PrimitiveConstructorSpec(
    nargs="*",
    metavar="[NAME=VALUE ...]",
    instance_from_str=settings,
    is_instance=lambda x: isinstance(x, dict),
    str_from_instance=lambda x: [f"{name}={json.dumps(value)}" for name, value in x.items()],
  ),
]


def fraction(config: object, *names: str) -> None:
  """Raises unless every named field lies in [0, 1]."""
  for name in names:
    value = getattr(config, name)
    if not 0.0 <= value <= 1.0:  # also false for nan
      raise UserError(f"{name} must lie in [0, 1]; got {value}")


@dataclass(frozen=True)
class DreamerConfig:
  """The learner. Defaults are those of DreamerV3's authors, less `size`.

  Attributes:
    size: Row of the size table, see `mjx-cl list sizes`.
    batch: Sequences of one update.
    length: Trained steps of a sequence.
    context: Leading records of a window that only give the initial state; 1.
    imagine: Imagined steps from each start.
    last_starts: Imagination starts are the last so many states of each sequence; 0: all.
    horizon: The discount is 1 - 1 / horizon.
    lam: Lambda of the returns, in [0, 1].
    lr: Learning rate.
    policy_lr: Factor on the policy's steps; below 1 the world model keeps ahead of the policy.
    anchor: Weight of -log policy(a | s) for the actions that the robot itself took, in replayed
      states; holds the policy where learning moves the latents that it reads. 0: off.
    min_std: Least deviation of the policy's actions.
    max_std: Greatest deviation of the policy's actions.
    warmup: Updates over which the learning rate rises linearly.
    agc: Adaptive gradient clipping: largest ratio of a gradient's norm to its weights'.
    bins: Classes of the two-hot heads, odd.
    entropy: Weight of the policy's entropy.
    free_nats: Divergence below which dynamics and representation are not trained [nat].
    rep_scale: Weight of the representation loss.
    repval_scale: Weight of the value loss on replayed states.
    range_rate: Rate at which the range of returns is followed.
    slow_rate: Rate at which the slow critic follows the critic.
    obs_scale: What each observation variable is divided by before encoder and decoder loss; `spec`:
      the robot's typical deviations; None: raw units, in which a joint's angle counts far less
      than its speed.
  """

  size: str = "size12m"
  batch: int = 16
  length: int = 64
  context: int = 1
  imagine: int = 15
  last_starts: int = 0
  horizon: int = 333
  lam: float = 0.95
  lr: float = 4e-5
  policy_lr: float = 1.0
  anchor: float = 0.0
  min_std: float = 0.1
  max_std: float = 1.0
  warmup: int = 1000
  agc: float = 0.3
  bins: int = 255
  entropy: float = 3e-4
  free_nats: float = 1.0
  rep_scale: float = 0.1
  repval_scale: float = 0.3
  range_rate: float = 0.01
  slow_rate: float = 0.02
  obs_scale: tuple[float, ...] | str | None = None

  def __post_init__(self) -> None:
    choose("size", self.size, SIZES)
    if isinstance(self.obs_scale, (list, tuple)):
      object.__setattr__(self, "obs_scale", tuple(self.obs_scale))  # a card holds a list
      if not all(isinstance(x, (int, float)) and x > 0 for x in self.obs_scale):
        raise UserError(f"obs_scale needs numbers above 0; got {self.obs_scale}")
    elif self.obs_scale not in (None, "spec"):
      raise UserError(f"obs_scale is `spec`, numbers above 0, or none; got {self.obs_scale!r}")
    positive(self, "batch", "length", "imagine", "horizon", "lr", "policy_lr", "bins")
    if not 0 < self.min_std < self.max_std <= 1:
      raise UserError(
        f"min_std and max_std must lie above 0 and up to 1, min_std below; got {self.min_std} "
        f"and {self.max_std}"
      )
    if self.context != 1:
      raise UserError(f"context must be 1, as in the authors' code; got {self.context}")
    if self.length < 2:  # the value of a replayed state is learnt from the one behind it
      raise UserError(f"length must be at least 2; got {self.length}")
    if self.last_starts == 1 or not 0 <= self.last_starts <= self.length:
      raise UserError(
        f"last_starts must be 0, or lie in 2..length={self.length}; got {self.last_starts}"
      )
    positive(self, "agc", "range_rate", "slow_rate")
    not_below_0(self, "anchor", "warmup", "entropy", "free_nats", "rep_scale", "repval_scale")
    fraction(self, "lam")
    if self.bins % 2 == 0:
      raise UserError(f"bins must be odd; got {self.bins}")


@dataclass(frozen=True)
class TrainConfig:
  """Pretraining.

  Attributes:
    envs: Robots that act side by side.
    updates: Gradient steps in all.
    ratio: Replayed steps per collected record; 1,024 is one update per record at batch 16 x 64.
    capacity: Records kept per robot.
    repeat: Control steps for which an action is held.
    episode: Control steps after which a training episode is cut off; None: the robot's own.
    lr_end: Learning rate at the last update, reached linearly over the last `pure` updates; None:
      constant.
    demonstrator: Path of a demonstrator policy, `reference` (the robot's own driver that knows its
      state), or None.
    demo_share: Share of the robots that the demonstrator drives until the pure phase.
    demo_noise: Deviation of the noise on the demonstrator's actions.
    clone: At most so many updates with cloning alone, the policy's own gradient off.
    clone_until: Cloning alone ends when the agent's own return reaches this share of the
      demonstrator's.
    clone_weight: Weight of KL(N(demonstrator's action, clone_std^2) || policy).
    clone_std: That deviation.
    fade: Updates over which the weight falls to 0 after that.
    pure: Least number of last updates with neither the demonstrator's data nor its term.
    shake: Probability that a stretch of 16 control steps is driven by one random action, on
      `shake_share` of the robots: stumbles and falls to learn from.
    shake_share: Share of the robots that are shaken; the return of the others is reported.
    hold: Updates of the pure phase, from its start, without the policy's own gradient: critic and
      model learn what the robots do by themselves before the policy climbs on them.
    fall_cost: Taken off the reward of new records where an episode ends for good, but for the last
      `pure` updates; returns are reported without it.
    penalties: Factor on the negative weights of the reward in training, returns included. Where
      effort costs more than a beginner earns, a first stage below 1 keeps it moving.
    fault: Domain randomisation: each robot draws a target of this fault and a severity at the start
      and whenever one of its episodes has ended. A preset (robot/name) brings its own severities,
      targets and schedules, on the robot's own clock. None: healthy robots.
    severity: Severities are drawn uniformly in [0, severity].
  """

  envs: int = 16
  updates: int = 500_000
  ratio: float = 1024.0
  capacity: int = 62_500
  repeat: int = 1
  episode: int | None = None
  lr_end: float | None = None
  demonstrator: str | None = None
  demo_share: float = 0.5
  demo_noise: float = 0.2
  clone: int = 4000
  clone_until: float = 0.85
  clone_weight: float = 0.3
  clone_std: float = 0.2
  fade: int = 2000
  pure: int = 6000
  shake: float = 0.0
  shake_share: float = 0.5
  hold: int = 0
  fall_cost: float = 0.0
  penalties: float = 1.0
  fault: str | None = None
  severity: float = 1.0

  def __post_init__(self) -> None:
    whole(
      self,
      "envs",
      "updates",
      "capacity",
      "repeat",
      "clone",
      "fade",
      "pure",
      "hold",
      *(("episode",) if self.episode is not None else ()),
    )
    positive(
      self,
      "envs",
      "updates",
      "ratio",
      "capacity",
      "repeat",
      *(("episode",) if self.episode is not None else ()),
    )
    fraction(self, "demo_share", "clone_until", "shake", "shake_share", "severity")
    positive(self, "clone_std")
    not_below_0(
      self,
      "fall_cost",
      "penalties",
      "demo_noise",
      "clone_weight",
      *(("lr_end",) if self.lr_end is not None else ()),
    )
    if self.fall_cost and self.pure >= self.updates:
      raise UserError(
        f"fall_cost is not taken in the last pure={self.pure} updates, and there are no more "
        f"than updates={self.updates}; set pure below that"
      )
    if self.demonstrator and self.clone + self.fade + self.pure > self.updates:
      raise UserError(
        f"clone + fade + pure = {self.clone + self.fade + self.pure} exceeds updates = "
        f"{self.updates}"
      )


@dataclass(frozen=True)
class AdaptConfig:
  """When adaptation starts, how it runs and when it ends.

  Attributes:
    ratio: Replayed steps per record collected after the alarm.
    start_windows: Windows that the replay must hold before the first update.
    lr: Learning rate while adapting; None: the agent's own.
    policy_lr: Factor on the policy's steps while adapting; None: the agent's own.
    anchor: Weight while adapting of the actions that the robot itself took; None: the agent's own.
    batch: Sequences of one update while adapting; fewer mean more updates at the same ratio. None:
      the agent's own.
    last_starts: Imagination starts are the last so many states of each sequence; 0: all, None: the
      agent's own.
    average: Rate per chunk of the moving average of the weights that acts while adapting; 1: the
      newest weights act.
    fresh_moments: Forget the optimiser's moments at an alarm.
    patience: Length over which every signal must be settled [chunks of 64 decisions].
    trend: Largest difference of the medians of that length's two halves [share of the level].
    fluctuation: Largest spread over that length, interquartile range / 1.349 [share of the level].
    excess: Spread also counts as small up to so many times the nominal deviation.
    near: Residuals also count as settled up to so many times their nominal mean.
    least: Steps of adaptation before it may converge [control steps].
    acceptance: Mean reward per control step that counts as recovered; None: the robot's own.
    give_up: Steps after which an adaptation without settling in sight may be aborted: the reward
      has not risen for a third of this length and is below acceptance; a quarter later also where
      it is acceptable but a signal will not settle [control steps].
    budget: Most steps of one adaptation [control steps].
    warmup: Steps at the start of a run before alarms are acted on and nominal levels are taken
      [control steps].
    refit: Steps on which the detector learns its reference anew after adaptation [control steps].
    period: Arm `periodic` starts so often [control steps].
    period_steps: Length of each of its adaptations [control steps].
    random_steps: Length of the one adaptation of arm `random` [control steps].
  """

  ratio: float = 16.0
  start_windows: int = 1024
  lr: float | None = 1e-4
  policy_lr: float | None = None
  anchor: float | None = None
  batch: int | None = 4
  last_starts: int | None = 0
  average: float = 0.1
  fresh_moments: bool = False
  patience: int = 48
  trend: float = 0.2
  fluctuation: float = 0.5
  excess: float = 2.0
  near: float = 1.25
  least: int = 6000
  acceptance: float | None = None
  give_up: int = 12_000
  budget: int = 19_000
  warmup: int = 1000
  refit: int = 2000
  period: int = 10_000
  period_steps: int = 3520
  random_steps: int = 6000

  def __post_init__(self) -> None:
    whole(
      self,
      "start_windows",
      "least",
      "give_up",
      "budget",
      "warmup",
      "period",
      "period_steps",
      "random_steps",
    )
    whole(self, "patience", most=100_000)  # what a stream keeps for it lies in memory
    whole(self, "refit", most=1_000_000)
    positive(
      self,
      "ratio",
      "start_windows",
      "trend",
      "fluctuation",
      "excess",
      "near",
      "least",
      "give_up",
      "budget",
      "refit",
      "average",
      "period",
      "period_steps",
      "random_steps",
    )
    if self.batch is not None:
      whole(self, "batch", most=4096)
    if self.acceptance is not None and not math.isfinite(self.acceptance):
      raise UserError(f"acceptance must be finite; got {self.acceptance}")
    fraction(self, "average")
    if self.patience < 4:
      raise UserError(f"patience must be at least 4 chunks; got {self.patience}")
    if self.last_starts is not None and (self.last_starts < 0 or self.last_starts == 1):
      raise UserError(f"last_starts must be 0 (all), or 2 or more; got {self.last_starts}")
    if self.period_steps >= self.period:
      raise UserError(f"period_steps must be below period={self.period}; got {self.period_steps}")
    positive(
      self, *(name for name in ("lr", "policy_lr", "batch") if getattr(self, name) is not None)
    )
    not_below_0(self, *(("anchor",) if self.anchor is not None else ()))


@dataclass(frozen=True)
class FaultConfig:
  """A robot and what happens to it.

  Attributes:
    env: Robot, see `mjx-cl list envs`.
    fault: Fault, see `mjx-cl list faults`, or preset, see `mjx-cl list fault-presets`; `none` for
      the healthy robot.
    target: Joint or part that the fault hits; `random` or None: drawn from the seed.
    severity: In [0, 1]; 0 is nominal. None: 0.5, or the preset's own.
    onset: First control step that the fault acts in. A preset that turns the robot into another one
      waits for the end of an episode.
    duration: Control steps until the fault is repaired; None: never.
    schedule: How the severity moves from the onset on: abrupt, ramp, intermittent, cyclic or
      random_walk.
    period: Control steps of the ramp, of one cycle, or between two steps of the random walk.
    share: On-share of an intermittent fault, deviation of a random walk's steps.
  """

  env: str
  fault: str = "gear"
  target: str | None = None
  severity: float | None = None
  onset: int = 5000
  duration: int | None = None
  schedule: str = "abrupt"
  period: int = 1000
  share: float = 0.5

  def __post_init__(self) -> None:
    if self.target == "random":
      object.__setattr__(self, "target", None)


@dataclass(frozen=True)
class RunConfig(FaultConfig):
  """One run of the loop: arms x seeds streams, each with its own fault.

  Attributes:
    steps: Control steps in all, counted from 0.
    seeds: Streams per arm.
    first_seed: Seeds are first_seed, first_seed + 1, ...
    detector: Change detector, see `mjx-cl list detectors`; NAME@CHANNEL watches one channel. One
      that stands on the leaderboard has, unless given, its threshold of one false alarm in 100,000
      steps.
    settings: Detector settings, name=value ...
    arms: Arms, see `mjx-cl list arms`.
    agent: Trained agent: shipped name or folder; None: the robot's shipped one.
    physics: auto, native or mjx.
    form: Residual form, paper or streaming.
    actions: Actions of the monitor's predictions, recorded or policy.
    deterministic: Act by the policy's mean instead of a sample.
    adapt: When adaptation starts, how it runs and when it ends.
    snapshots: Control steps of adaptation between two snapshots of arm oracle-budget, which the
      stop rule is scored against; 0: none.
    stops: For arm oracle-stop: folder of a finished run of arm oracle-budget with --snapshots, of
      the same robot, fault and seeds.
    keep: Write what each stream has learnt as an agent, OUT/agents/ARM-SEED, for --agent of another
      run.
    parts: Also write the residual of each part of the observation into trace.parquet, columns
      residual_NAME.
    residuals: Also write residuals.parquet: the residual of every single variable of the
      observation, in its own unit, for each stream and control step.
  """

  steps: int = 25_000
  seeds: int = 10
  first_seed: int = 0
  detector: str = "rolling_sigma"
  settings: Settings = field(default_factory=dict)
  arms: Annotated[tuple[str, ...], tyro.conf.arg(name="arm")] = ("detector", "none")
  agent: str | None = None
  physics: str = "auto"
  form: str = "paper"
  actions: str = "recorded"
  deterministic: bool = False
  adapt: AdaptConfig = AdaptConfig()
  snapshots: int = 0
  stops: str | None = None
  keep: bool = False
  parts: bool = False
  residuals: bool = False

  def __post_init__(self) -> None:
    super().__post_init__()
    positive(self, "steps", "seeds")
    if self.steps >= FOREVER:
      raise UserError(f"steps must be below {FOREVER:,} control steps; got {self.steps}")
    check_seeds(self.first_seed, self.seeds, "first_seed")
    finite(self.settings, "settings of the detector")
    if self.agent == "":
      raise UserError("agent is a shipped name or a folder; got an empty name")
    if not self.arms or len(set(self.arms)) != len(self.arms):
      raise UserError(f"name each arm once; got {', '.join(self.arms) or 'none'}")
    if self.physics not in ("auto", "native", "mjx"):
      raise UserError(f"unknown physics {self.physics!r}; choose from: auto, native, mjx")
    if not 0 <= self.snapshots < FOREVER:
      raise UserError(f"snapshots must lie in 0..2,147,483,646 control steps; got {self.snapshots}")


@dataclass(frozen=True)
class Preset:
  """A learner with the way it is pretrained."""

  dreamer: DreamerConfig
  train: TrainConfig
  about: str = field(default="")


PRESETS = {
  "paper": Preset(
    DreamerConfig(size="size12m"),
    TrainConfig(envs=16, updates=250_000, ratio=512.0, repeat=2),
    "size12m, published protocol: action repeat 2, train ratio 512, 16 robots, all 1,024 "
    "imagination starts",
  ),
  "cpu": Preset(
    DreamerConfig(size="size1m", last_starts=16, lr=3e-4, warmup=200),
    TrainConfig(
      envs=32, updates=48_000, ratio=4.0, capacity=4096, lr_end=1e-4, pure=12_000, shake=0.08
    ),
    "what 2 cores train in a few hours: size1m, imagination from the last 16 states of each "
    "sequence, 32 robots, one update to 256 records, half of the robots shaken",
  ),
  "tiny": Preset(
    DreamerConfig(size="tiny", batch=8, length=16, imagine=8, lr=1e-3, warmup=20, bins=63),
    TrainConfig(envs=8, updates=200, ratio=16.0, capacity=512),
    "for tests: some 100,000 parameters, seconds per run",
  ),
}


# settings of earlier versions, with the one value that still means what is done today
GONE = {"jitter": 0.0}


def recorded(kind: type, record: Mapping[str, Any]) -> dict[str, Any]:
  """Fields of `kind` that a card or a config.json of this or an earlier version holds.

  Raises:
    ValueError, one line: a field that this version has not, unless its value changes nothing.
  """
  names = {f.name for f in dataclasses.fields(kind)}
  for name, value in record.items():
    if name not in names and not (name in GONE and value == GONE[name]):
      raise ValueError(f"{name}={value!r} is no setting of this version")
  return {name: value for name, value in record.items() if name in names}


def replace(config: Settled, **changes: Any) -> Settled:
  """dataclasses.replace that names the valid fields when it is given an unknown one."""
  known = {f.name for f in dataclasses.fields(config)}
  for name in changes:
    if name not in known:
      raise UserError(f"unknown setting {name!r}; choose from: {', '.join(sorted(known))}")
  return dataclasses.replace(config, **changes)
