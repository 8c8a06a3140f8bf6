"""What can be chosen of a run and of its learner, as frozen dataclasses. Imports errors alone, no
JAX, so that `--help` is quick.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Annotated

import tyro

from mjx_cl.config.checks import (  # noqa: F401  some for those who import them from here
  FOREVER,
  check_seeds,
  field_kinds,
  finite,
  fraction,
  given,
  kinds,
  not_below_0,
  positive,
  recorded,
  replace,
  settings,
  whole,
)
from mjx_cl.config.learner import (  # noqa: F401
  MOST_REPEAT,
  PRESETS,
  DreamerConfig,
  Preset,
  TrainConfig,
)
from mjx_cl.errors import require

# decisions between two rounds of updates, of a training as of a run, where the stop rule looks as
# often
CHUNK = 64
FINETUNING_LR = 1e-4  # of agents whose card names none
OWN_AGENT = {"quadruped": "quadruped-trot-2"}  # where it is not the one of the robot's name
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


def named(fault: str) -> bool:
  """Whether this names a preset (robot/name) and not a fault; a fault may stand in a file,
  path/to/file.py:name.
  """
  return "/" in fault and ":" not in fault


def own_agent(robot: str) -> str:
  """Name of the agent that a robot has where none is given."""
  return OWN_AGENT.get(robot, robot)


def whose(known: Collection[str], robot: str | None, agent: str | None = None) -> str:
  """Of the agents that something is known of the one whose figures are taken: this one, or the
  robot's own, or the walker's.
  """
  names = agent or "", own_agent(robot or "walker"), "walker"
  return next(name for name in names if name in known)


def finetuning(given: dict, card: dict) -> dict:
  """`given` settings of AdaptConfig, of which the defaults of `lr` and `anchor` give way to
  `finetuning_lr` and `finetuning_anchor` of an agent's card.
  """
  defaults = {"lr": FINETUNING_LR, "anchor": None}
  left = [name for name, value in defaults.items() if name in given and given[name] == value]
  named = {name: card.get(f"finetuning_{name}") for name in left}
  return given | {name: value for name, value in named.items() if value is not None}


@dataclass(frozen=True)
class AdaptConfig:
  """When adaptation starts, how it runs and when it ends.

  Attributes:
    ratio: Replayed steps per record collected after the alarm.
    start_windows: Windows that the replay must hold before the first update.
    lr: Learning rate while adapting; the default gives way to `finetuning_lr` of the agent's card,
      where it names one; None: that of the agent's training.
    policy_lr: Factor on the policy's steps while adapting; None: 1.
    model_lr: Factor on the steps of encoder, dynamics and decoder while adapting, so that what
      reads latents keeps up with them (two time-scales, https://arxiv.org/abs/1706.08500); None: 1.
    anchor: Weight while adapting of the actions that the robot itself took; None:
      `finetuning_anchor` of the agent's card, where it names one, else that of its training.
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
    regain: Share of the mean reward before the first alarm that must be back as well before an
      adaptation may converge; 0: acceptance alone.
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
  lr: float | None = FINETUNING_LR
  policy_lr: float | None = None
  model_lr: float | None = None
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
  regain: float = 0.0
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
    require(self.ratio <= 100_000, f"ratio must be at most 100,000; got {self.ratio:g}")
    whole(self, *given(self, "batch"), most=4096)
    require(
      self.acceptance is None or math.isfinite(self.acceptance),
      f"acceptance must be finite; got {self.acceptance}",
    )
    fraction(self, "average", "regain")
    require(self.patience >= 4, f"patience must be at least 4 chunks; got {self.patience}")
    require(
      self.last_starts is None or self.last_starts == 0 or self.last_starts >= 2,
      f"last_starts must be 0 (all), or 2 or more; got {self.last_starts}",
    )
    require(
      self.period_steps < self.period,
      f"period_steps must be below period={self.period}; got {self.period_steps}",
    )
    positive(self, *given(self, "lr", "policy_lr", "batch"))
    not_below_0(self, *given(self, "anchor", "model_lr"))


@dataclass(frozen=True)
class FaultConfig:
  """A robot and what happens to it.

  Attributes:
    env: Robot, see `mjx-cl list envs`.
    fault: Fault, see `mjx-cl list faults`, several at once by `gear+noise`, or preset, see
      `mjx-cl list fault-presets`; `none` for the healthy robot.
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
      observation, in its own unit, for each stream and control step, and innovation_NAME, the
      signed error of its prediction one step ahead, of the reward too.
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
    require(
      self.steps < FOREVER, f"steps must be below {FOREVER:,} control steps; got {self.steps}"
    )
    check_seeds(self.first_seed, self.seeds, "first_seed")
    finite(self.settings, "settings of the detector")
    require(self.agent != "", "agent is a shipped name or a folder; got an empty name")
    require(
      self.arms and len(set(self.arms)) == len(self.arms),
      f"name each arm once; got {', '.join(self.arms) or 'none'}",
    )
    require(
      self.physics in ("auto", "native", "mjx"),
      f"unknown physics {self.physics!r}; choose from: auto, native, mjx",
    )
    require(
      0 <= self.snapshots < FOREVER,
      f"snapshots must lie in 0..2,147,483,646 control steps; got {self.snapshots}",
    )
