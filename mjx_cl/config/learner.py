"""The learner and how it is pretrained: frozen dataclasses and presets. Free of JAX."""

from __future__ import annotations

from dataclasses import dataclass

from mjx_cl.config.checks import fraction, given, not_below_0, positive, whole
from mjx_cl.config.sizes import SIZES
from mjx_cl.errors import choose, require

MOST_REPEAT = 100  # control steps; a chunk of decisions takes so many times as long

LARGEST = 65_536  # of a batch, a sequence and what is imagined


@dataclass(frozen=True)
class DreamerConfig:
  """The learner. Defaults are those of DreamerV3's authors, less `size`.

  Attributes:
    size: Row of the size table, see `mjx-cl list sizes`.
    batch: Sequences of one update.
    length: Trained steps of a sequence.
    imagine: Imagined steps from each start.
    last_starts: Imagination starts are the last so many states of each sequence; 0: all.
    horizon: The discount is 1 - 1 / horizon.
    lam: Lambda of the returns, in [0, 1].
    lr: Learning rate.
    policy_lr: Factor on the policy's steps; below 1 the world model keeps ahead of the policy.
    model_lr: Factor on the steps of encoder, dynamics and decoder; 0: they stay, so that the heads
      learn another reward and nothing moves the latents that the policy reads.
    anchor: Weight of -log policy(a | s) for the actions that the robot itself took, in replayed
      states; holds the policy where learning moves the latents that it reads. 0: off.
    min_std: Least deviation of the policy's actions.
    max_std: Greatest deviation of the policy's actions.
    warmup: Updates over which the learning rate rises linearly.
    agc: Adaptive gradient clipping: largest ratio of a gradient's norm to its weights'.
    bins: Classes of the two-hot heads, odd, at least 3.
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
  imagine: int = 15
  last_starts: int = 0
  horizon: int = 333
  lam: float = 0.95
  lr: float = 4e-5
  policy_lr: float = 1.0
  model_lr: float = 1.0
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
      require(
        all(isinstance(x, (int, float)) and x > 0 for x in self.obs_scale),
        f"obs_scale needs numbers above 0; got {self.obs_scale}",
      )
    else:
      require(
        self.obs_scale in (None, "spec"),
        f"obs_scale is `spec`, numbers above 0, or none; got {self.obs_scale!r}",
      )
    positive(self, "batch", "length", "imagine", "horizon", "lr", "policy_lr", "bins")
    require(
      0 < self.min_std < self.max_std <= 1,
      f"min_std and max_std must lie above 0 and up to 1, min_std below; got {self.min_std} "
      f"and {self.max_std}",
    )
    # the value of a replayed state is learnt from the one behind it
    require(self.length >= 2, f"length must be at least 2; got {self.length}")
    for name in ("batch", "length", "imagine"):
      value = getattr(self, name)
      require(value <= LARGEST, f"{name} must be at most {LARGEST:,}; got {value:,}")
    require(
      self.last_starts != 1 and 0 <= self.last_starts <= self.length,
      f"last_starts must be 0, or lie in 2..length={self.length}; got {self.last_starts}",
    )
    positive(self, "agc", "range_rate", "slow_rate")
    fraction(self, "range_rate", "slow_rate")
    not_below_0(
      self, "anchor", "model_lr", "warmup", "entropy", "free_nats", "rep_scale", "repval_scale"
    )
    fraction(self, "lam")
    require(self.bins % 2 and self.bins > 1, f"bins must be odd and 3 or more; got {self.bins}")


@dataclass(frozen=True)
class TrainConfig:
  """Pretraining.

  Attributes:
    envs: Robots that act side by side.
    updates: Gradient steps in all.
    ratio: Replayed steps per collected record; 1,024 is one update per record at batch 16 x 64.
    capacity: Records kept per robot.
    repeat: Control steps for which an action is held.
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
    shaping: Weight of the robot's own shaping terms, added to the reward in training, returns
      included: shows a first stage a way of moving.
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
  shaping: float = 0.0
  fault: str | None = None
  severity: float = 1.0

  def __post_init__(self) -> None:
    whole(
      self,
      "envs",
      "updates",
      "capacity",
      "clone",
      "fade",
      "pure",
      "hold",
    )
    whole(self, "repeat", most=MOST_REPEAT)
    positive(
      self,
      "envs",
      "updates",
      "ratio",
      "capacity",
      "repeat",
    )
    fraction(self, "demo_share", "clone_until", "shake", "shake_share", "severity")
    positive(self, "clone_std")
    not_below_0(
      self,
      "fall_cost",
      "penalties",
      "shaping",
      "demo_noise",
      "clone_weight",
      *given(self, "lr_end"),
    )
    require(
      not self.fall_cost or self.pure < self.updates,
      f"fall_cost is not taken in the last pure={self.pure} updates, and there are no more "
      f"than updates={self.updates}; set pure below that",
    )
    require(
      not self.demonstrator or self.clone + self.fade + self.pure <= self.updates,
      f"clone + fade + pure = {self.clone + self.fade + self.pure} exceeds updates = "
      f"{self.updates}",
    )


@dataclass(frozen=True)
class Preset:
  """A learner with the way it is pretrained."""

  dreamer: DreamerConfig
  train: TrainConfig
  about: str = ""


PRESETS = {
  "paper": Preset(
    DreamerConfig(size="size12m"),
    TrainConfig(envs=16, updates=250_000, ratio=512.0, repeat=2),
    "size12m, published protocol: action repeat 2, train ratio 512, 16 robots, all 1,024 "
    "imagination starts; replay of a million records",
  ),
  "cpu": Preset(
    DreamerConfig(size="size1m", last_starts=16, lr=3e-4, warmup=200),
    TrainConfig(
      envs=32, updates=48_000, ratio=4.0, capacity=4096, lr_end=1e-4, pure=12_000, shake=0.08
    ),
    "what 2 cores train in one to two hours: size1m, imagination from the last 16 states of each "
    "sequence, 32 robots, one update to 256 records, replay of 131,072 records, learning rate 3e-4 "
    "after 200 updates, over the last 12,000 falling to 1e-4, half of the robots shaken",
  ),
  "tiny": Preset(
    DreamerConfig(size="tiny", batch=8, length=16, imagine=8, lr=1e-3, warmup=20, bins=63),
    TrainConfig(envs=8, updates=200, ratio=16.0, capacity=512),
    "for tests: some 100,000 parameters, seconds per run",
  ),
}
