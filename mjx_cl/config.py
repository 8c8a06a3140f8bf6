"""What can be chosen: frozen dataclasses, presets, and all validation. Free of JAX, so that
`--help` is quick.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
from dataclasses import dataclass, field

from mjx_cl.errors import UserError, choose
from mjx_cl.sizes import SIZES

# decisions between two rounds of updates, of a training as of a run, where the stop rule looks as
# often
CHUNK = 64
FOREVER = 2**31 - 1  # control steps that no run outlasts


def positive(config, *names: str) -> None:
  """Raises unless every named field is a finite number above 0."""
  for name in names:
    value = getattr(config, name)
    if not (math.isfinite(value) and value > 0):
      raise UserError(f"{name} must be above 0; got {value}")


def not_below_0(config, *names: str) -> None:
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


def whole(config, *names: str, most: int = FOREVER - 1) -> None:
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


def fraction(config, *names: str) -> None:
  """Raises unless every named field lies in [0, 1]."""
  for name in names:
    value = getattr(config, name)
    if not 0.0 <= value <= 1.0:  # also false for nan
      raise UserError(f"{name} must lie in [0, 1]; got {value}")


@dataclass(frozen=True)
class DreamerConfig:
  """The learner. Defaults are the authors' (facts of danijar/dreamerv3 at e3f0224) except `size`.

  Attributes:
    size: row of the size table.
    batch, length: sequences and trained steps of one update.
    context: leading records of a window that only give the initial state; 1, as the authors'.
    imagine: imagined steps from each start.
    last_starts: imagination starts are the last k states of each sequence; 0 means all.
    horizon: the discount is 1 - 1 / horizon.
    lr, warmup: learning rate and updates of its linear warm-up.
    policy_lr: factor on the policy's steps; 1, as the authors'. Below 1 the world model keeps ahead
      of the policy (the cloned quadruped's at 1 runs to where the model promises too much, and its
      return falls).
    anchor: weight of -log policy(a | s) for the mean of the policy, over the actions that the robot
      itself took, in replayed states; 0: off, as the authors. The policy reads the latents of the
      world model; where learning moves those under it, this makes it follow.
    min_std, max_std: least and greatest deviation of the policy's actions; 0.1 and 1, as the
      authors'. What the robot does is drawn with it, in tests too.
    bins: classes of the two-hot heads.
    entropy: weight of the policy's entropy.
    obs_scale: one number per observation variable that it is divided by before encoder and decoder
      loss, `spec`: the robot's typical deviations (Var.scale); None: raw units, as the authors. In
      raw units a joint angle of 0.2 rad counts a hundredth of a joint speed of 2 rad/s.
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

  def __post_init__(self):
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
    envs: robots that act side by side.
    updates: gradient steps in all.
    ratio: replayed steps per collected record (1,024 = one update per record at batch 16 x 64).
    capacity: records kept per robot.
    repeat: control steps for which an action is held.
    episode: control steps after which a training episode is cut off, None: the robot's own. Short
      ones show more of how an episode starts.
    lr_end: learning rate at the last update, reached linearly over the last `pure` updates (None:
      constant).
    demonstrator: path of a demonstrator policy, `reference` (the robot's own driver that knows its
      state), or None.
    demo_share: share of the robots that the demonstrator drives until the pure phase.
    demo_noise: deviation of the noise on the demonstrator's actions.
    clone: at most so many updates with cloning alone (the policy's own gradient off).
    clone_until: cloning alone ends when the agent's own return reaches this share of the
      demonstrator's.
    clone_weight, clone_std: weight of KL(N(demonstrator's action, clone_std^2) || policy), and that
      deviation.
    fade: updates over which the weight falls to 0 after that.
    pure: least number of last updates with neither the demonstrator's data nor its term.
    shake: probability that a stretch of 16 control steps is driven by one random action, on
      `shake_share` of the robots: stumbles and falls to learn from. 0: never, as the authors.
    shake_share: share of the robots that are shaken; the return of the others is the one reported.
    jitter: deviation of white noise on the actions of those same robots, in every phase: the last
      of them gets all of it, the others equal steps less. What an action does shows in the data
      only as far as actions differ from what the policy would have done there.
    hold: updates of the pure phase, from its start, without the policy's own gradient: critic and
      model learn what the robots do by themselves, held by `anchor`, before the policy climbs on
      them. A critic that saw a demonstrator's data too may tell the two apart by posture.
    fall_cost: taken off the reward of new records where an episode ends for good, but for the last
      `pure` updates; returns are reported without it. Where a random robot pays for every step (the
      quadruped's effort), an end that costs nothing is what is learnt. 0: never.
    penalties: factor on the negative weights of the reward in training, returns included: a first
      stage, from which `--agent` goes on with the task's own, 1. Where effort costs more than a
      beginner earns, it learns not to move.
    fault, severity: domain randomisation: each robot draws a target of this fault and a severity,
      uniform in [0, `severity`], at the start and at the end of every chunk of 64 decisions in
      which one of its episodes ended. A preset (robot/name) brings its own severities, schedules,
      whose clock
      begins with the first step of a robot, and the targets that it names: what an agent comes to
        that has the faulty robot to itself. None: healthy ones.
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
  jitter: float = 0.0
  hold: int = 0
  fall_cost: float = 0.0
  penalties: float = 1.0
  fault: str | None = None
  severity: float = 1.0

  def __post_init__(self):
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
      "jitter",
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
  """When adaptation starts, how it runs and when it ends. Chosen on seeds 100 to 109.

  Attributes:
    ratio: replayed steps per post-alarm record, 16 in the paper.
    start_windows: windows that the post-alarm replay must hold before the first update.
    lr: learning rate while adapting, None: the agent's own.
    policy_lr: factor on the policy's steps while adapting, None: the agent's own.
    anchor: weight while adapting of the actions that the robot took (DreamerConfig.anchor), None:
      the agent's own.
    batch: sequences of one update while adapting, None: the agent's own 16. At the same train ratio
      fewer sequences mean more updates: 4 give four updates every 64 steps. Right hip's gear
        halved, seeds 100 to 103, mean reward 4,000 to 8,000 steps after onset, two agents that
      differ in nothing but their training: 0.73 with 4 sequences at 1e-4, 0.68 with 16 at 2e-4,
        0.58 with 4 at 2e-4 (an agent whose training
      never saw a stumble); 0.85 with 4 at 1e-4 (the shipped one, whose robots were shaken).
    last_starts: imagination starts while adapting, the last k states of each sequence, 0 all; None:
      the agent's own. The gradient of
      few updates must do: with 16 of 64 states its noise undoes the policy.
    average: rate per chunk with updates of the moving average of the weights that acts while
      adapting; 1: the newest weights. An earlier
      agent, seeds 100 to 104, reward 5,000 to 10,000 steps after onset: 0.82 with 0.1, 0.78 with 1
        (that run ended at 8,000).
    fresh_moments: forget the optimiser's moments at an alarm. Kept ones were gathered on the
      gradients of a trained agent; those after an event are many times larger, so that each step
      would be that many times the learning rate until the RMS (memory 1,000 updates) has followed.
      On tuning seeds no difference shows, of walkers and cars (results/fresh_moments).
    patience: length over which every signal must be settled [chunks of 64 decisions].
    trend: largest difference of the medians of the first and second half of that length [share of
      the level].
    fluctuation: largest spread over that length, the interquartile range / 1.349 [share of the
      level], or
    excess: ... that many times the nominal deviation, whichever is larger.
    near: OPR and RPR also count as settled while at most this many times their nominal mean.
    least: steps of adaptation before it may converge [control steps].
    acceptance: mean reward per control step over the patience that counts as recovered, None: the
      task's own.
    give_up: steps after which "no settling in sight" may be declared [control steps]: the reward
      has not risen for a third of this length and is below acceptance; a quarter of this length
      later also where it is acceptable but some signal will not settle.
    budget: most steps of adaptation [control steps].
    warmup: control steps at the start of a run before alarms are acted on and nominal levels are
      taken.
    refit: control steps on which the detector's reference is refitted after convergence.
    period, period_steps: arm `periodic` starts every `period` control steps and adapts for
      `period_steps` [control steps].
    random_steps: length of the one adaptation of arm `random` [control steps]. A detected walker
      adapts for 6,016 to 7,168 steps (seeds 0 to 9, one of six apart) and takes 308 to 376 updates;
      6,000 steps cost as many, since the first 17 chunks fill the replay, and so do 3,520 steps
      twice, as `periodic` spends them in a run of 25,000.
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

  def __post_init__(self):
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
class RunConfig:
  """One run of the loop: arms x seeds streams, each with its own fault.

  Attributes:
    env, fault, target, severity, onset, duration: which robot meets what, when [control steps].
      target None: drawn from the stream's seed. fault may name a preset (robot/name), which brings
        its own faults, targets and severities. severity None: 0.5, or the preset's.
      Where a preset turns the robot into another one, that happens at the end of the first episode
      that ends at the onset or later; an onset after the last step then means never.
    schedule, period, share: how the severity moves once the fault is there, see faults.schedule
      [control steps, 1].
    steps: control steps in all, counted from 0.
    seeds, first_seed: streams per arm; their seeds are first_seed, first_seed + 1, ...
    detector, settings: name and keyword settings.
    arms: names out of ARMS.
    agent: shipped name or folder, None: the shipped agent of the robot.
    physics: auto, native or mjx.
    form, actions: of the residual (monitor.Monitor).
    deterministic: act by the policy's mean.
    snapshots: control steps of adaptation between two snapshots of the weights that act, in arms
      that never stop by themselves; 0: none. Each is evaluated on the broken robot once the run is
      over, see snapshots.py.
    stops: folder of a finished run of the same robots with an arm that never stops by itself and
      snapshots: where arms that end at the oracle stop find it, see scoring.stop.told.
    keep: what each stream has learnt is written as an agent, see run.Runner.keep.
    parts: trace.parquet also holds the residual of each part of the observation (monitor.watched),
      columns residual_NAME.
    residuals: residuals.parquet holds the residual of every observation variable, in its own unit.
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
  steps: int = 25_000
  seeds: int = 10
  first_seed: int = 0
  detector: str = "rolling_sigma"
  settings: dict = field(default_factory=dict)
  arms: tuple[str, ...] = ("detector", "none")
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

  def __post_init__(self):
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
    (
      "size12m, published protocol: action repeat 2, train ratio 512, 16 environments, all 1,024 "
      "imagination starts"
    ),
  ),
  "cpu": Preset(
    DreamerConfig(size="size1m", last_starts=16, lr=3e-4, warmup=200),
    TrainConfig(
      envs=32, updates=48_000, ratio=4.0, capacity=4096, lr_end=1e-4, pure=12_000, shake=0.08
    ),
    "what 2 cores train in a few hours. Departures from the paper: size1m instead of size12m; "
    "imagination from the last 16 states of each "
    "sequence (256 starts instead of 1,024); learning rate 3e-4 falling to 1e-4, warm-up 200, "
    "instead of 4e-5 and 1,000; 32 environments at "
    "train ratio 4 (fresh data is cheap, updates are not) instead of 16 at 512; replay of "
    "131,072 records; action repeat 1; half of the "
    "robots are shaken, that is in 8 % of all stretches of 16 control steps one random action "
    "drives them; optionally a demonstrator, which "
    "the agent's card then names",
  ),
  "tiny": Preset(
    DreamerConfig(size="tiny", batch=8, length=16, imagine=8, lr=1e-3, warmup=20, bins=63),
    TrainConfig(envs=8, updates=200, ratio=16.0, capacity=512),
    "for tests: some 100,000 parameters, seconds per run",
  ),
}


def replace(config, **changes):
  """dataclasses.replace that names the valid fields when it is given an unknown one."""
  known = {f.name for f in dataclasses.fields(config)}
  for name in changes:
    if name not in known:
      raise UserError(f"unknown setting {name!r}; choose from: {', '.join(sorted(known))}")
  return dataclasses.replace(config, **changes)
