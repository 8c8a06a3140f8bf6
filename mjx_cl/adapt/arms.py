"""What is compared: arms of a run. `ARMS` is the one table; a new arm is a line in it, or comes by
the entry points `mjx_cl.methods` or as FILE.py:make, see `Arms`.

An arm is a set of choices: what starts adaptation, what ends it, the method (what learns, and which
weights act), which weights it starts from, and whether the robot breaks at all. `choices` turns the
arms of a run into arrays over its streams, so that one compiled program serves any mix of them.
Free of JAX, as config.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mjx_cl.config import FOREVER, AdaptConfig
from mjx_cl.errors import PluginError, UserError
from mjx_cl.io import plugins


@dataclass(frozen=True)
class Trigger:
  """What starts adaptation.

  Attributes:
    why: the words that events.parquet says, with the step.
    steps: (AdaptConfig, onsets of the robot, steps of the run, seed) -> control steps at which
      adaptation is due. One that falls into an adaptation or into the warm-up starts nothing.
    listens: alarms of the detector are acted on, after the warm-up.
  """

  why: str
  steps: Callable[..., tuple[int, ...]] = lambda adapt, onsets, steps, seed: ()
  listens: bool = False


@dataclass(frozen=True)
class End:
  """What ends adaptation.

  Attributes:
    rule: stop and abort rules of the phase machine are in force.
    limit: AdaptConfig -> most control steps of one adaptation.
    told: it ends at the oracle stop of the stream's seed, which another run has found
      (RunConfig.stops), or at the limit if that comes first.
  """

  rule: bool
  limit: Callable[..., int]
  told: bool = False


@dataclass(frozen=True)
class Arm:
  """What is compared with others.

  Attributes:
    about: one line for `mjx-cl list arms`.
    trigger: what starts an adaptation.
    end: what ends it.
    method: a name in methods.METHODS, or a methods.Method of one's own.
    fresh: parameters, moments and counters are drawn anew from the stream's seed at every start.
      The latent that the robot carries runs on.
    breaks: the robot gets the run's faults; False: their severity is 0.
    agent: what is joined to the name of the run's agent, after a hyphen, to give that of the arm's
      own; "": it is the run's.
  """

  about: str
  trigger: Trigger
  end: End
  method: Any = "paper"
  fresh: bool = False
  breaks: bool = True
  agent: str = ""

  @property
  def learns(self) -> bool:
    """Something may start an adaptation."""
    return self.trigger is not NEVER


def _random(adapt: AdaptConfig, onsets: tuple[int, ...], steps: int, seed: int) -> tuple[int, ...]:
  """One step, uniform over those from which a whole adaptation fits into the run."""
  import numpy as np  # not needed for the table

  last = steps - adapt.random_steps
  if last < adapt.warmup:
    raise UserError(
      f"arm 'random' needs warmup + random_steps = {adapt.warmup + adapt.random_steps} steps; "
      f"the run has {steps}"
    )
  return (int(np.random.default_rng([seed, 8]).integers(adapt.warmup, last + 1)),)


NEVER = Trigger("")
ALARM = Trigger("alarm", listens=True)
ONSET = Trigger(
  "true onset",
  lambda adapt, onsets, steps, seed: tuple(max(onset, adapt.warmup) for onset in onsets),
)
PERIOD = Trigger(
  "schedule", lambda adapt, onsets, steps, seed: tuple(range(adapt.period, steps, adapt.period))
)
RANDOM = Trigger("random time", _random)
AT_ONCE = Trigger("end of the warm-up", lambda adapt, onsets, steps, seed: (adapt.warmup,))

RULE = End(True, lambda adapt: adapt.budget)
BUDGET = End(False, lambda adapt: adapt.budget)
PERIOD_STEPS = End(False, lambda adapt: adapt.period_steps)
RANDOM_STEPS = End(False, lambda adapt: adapt.random_steps)
ORACLE_STOP = End(False, lambda adapt: adapt.budget, told=True)
NO_END = End(False, lambda adapt: FOREVER)


def never_stops(arm: Arm) -> bool:
  """Nothing but the budget ends the arm's adaptation: it shows what every possible stop would have
  been worth.
  """
  return arm.end is BUDGET


def stops(arm: Arm) -> bool:
  """The arm goes on from the shipped agent, all of it learns and is kept, and the stop rule ends
  that: its stop compares with those of one that never stops.
  """
  return arm.end is RULE and arm.breaks and arm.method == "paper" and not arm.fresh


class Arms(plugins.Registry):
  """A Registry of arms. What a package or a file adds is a function without arguments that gives an
  Arm; it is called once.

  Raises:
    PluginError: it fails, or gives something else.
  """

  def __init__(self, group: str, kind: str, own: dict[str, Arm]) -> None:
    super().__init__(group, kind, own)
    self.made: dict[tuple[str, Any], Arm] = {}

  def __getitem__(self, name: str) -> Arm:
    found = super().__getitem__(name)
    if isinstance(found, Arm):
      return found
    if (name, found) not in self.made:
      try:
        arm = found()
      except Exception as e:
        if plugins.of_user(e) or isinstance(e, UserError):
          raise
        raise PluginError(f"arm {name!r} cannot be made: {plugins.line(e, 1)}") from e
      if not isinstance(arm, Arm):
        raise PluginError(f"arm {name!r} must give a mjx_cl.adapt.arms.Arm; got {arm!r}")
      for part, of in (("trigger", Trigger), ("end", End)):
        if not isinstance(getattr(arm, part), of):
          raise PluginError(
            f"arm {name!r}: its {part} must be a mjx_cl.adapt.arms.{of.__name__}; got "
            f"{getattr(arm, part)!r}"
          )
      self.made[name, found] = arm
    return self.made[name, found]


_SHIPPED: dict[str, Arm] = {
  "detector": Arm("finetuning starts on the detector's alarm", ALARM, RULE),
  "rollback": Arm(
    "as detector, but an aborted finetuning goes back to the weights of before it, where these "
    "earned more after the alarm",
    ALARM,
    RULE,
    method="rollback",
  ),
  "guarded": Arm(
    "as detector, but the weights of before the finetuning and the new ones act by turns, more "
    "often those that earn more; the new ones stay if they do",
    ALARM,
    RULE,
    method="guarded",
  ),
  "staged": Arm(
    "as detector, but first the world model learns, then the critic with it, then the actor",
    ALARM,
    RULE,
    method="staged",
  ),
  "calm": Arm(
    "as detector, but the robot does not explore while it learns; its dreams do",
    ALARM,
    RULE,
    method="calm",
  ),
  "quiet": Arm(
    "as detector, but from the alarm on the robot does not explore; its dreams do",
    ALARM,
    RULE,
    method="quiet",
  ),
  "swift": Arm(
    "as quiet, but it learns from some 130 decisions after the alarm on, in place of 1,090, and "
    "until 90 % of the reward before is back",
    ALARM,
    RULE,
    method="swift",
  ),
  "quiet-guarded": Arm("as guarded, and as quiet", ALARM, RULE, method="quiet-guarded"),
  "swift-guarded": Arm("as guarded, and as swift", ALARM, RULE, method="swift-guarded"),
  "ratchet": Arm(
    "as detector, but the learner goes back to its best weights so far where it falls behind them",
    ALARM,
    RULE,
    method="ratchet",
  ),
  "swift-ratchet": Arm("as ratchet, and as swift", ALARM, RULE, method="swift-ratchet"),
  "still": Arm(
    "from the alarm on the robot does not explore, and learns nothing: quiet without learning",
    ALARM,
    RULE,
    method="still",
  ),
  "none": Arm("no adaptation; alarms are logged", NEVER, NO_END),
  "always": Arm("finetuning from the end of the warm-up on, without an end", AT_ONCE, NO_END),
  "periodic": Arm(
    "finetuning every --adapt.period steps, for --adapt.period-steps; over 25,000 steps about "
    "the updates of one detected fault",
    PERIOD,
    PERIOD_STEPS,
  ),
  "random": Arm(
    "finetuning once, at a time drawn from the seed, for --adapt.random-steps; about the "
    "updates of one detected fault",
    RANDOM,
    RANDOM_STEPS,
  ),
  "oracle": Arm("finetuning starts at the true onset, ends by the stop rule", ONSET, RULE),
  "oracle-budget": Arm(
    "finetuning starts at the true onset, ends after --adapt.budget steps whatever the signals "
    "say: the run from which the best "
    "stop is chosen afterwards",
    ONSET,
    BUDGET,
  ),
  "oracle-stop": Arm(
    "finetuning starts at the true onset and ends where it should: at the oracle stop of the "
    "same seed, found by an earlier run of "
    "oracle-budget with --snapshots, whose folder --stops names",
    ONSET,
    ORACLE_STOP,
  ),
  "scratch": Arm(
    "at the true onset all parameters are drawn anew; ends by the stop rule",
    ONSET,
    RULE,
    fresh=True,
  ),
  "world-model": Arm(
    "as detector, but the world model alone learns; actor and critic stay",
    ALARM,
    RULE,
    method="world-model",
  ),
  "randomised": Arm(
    "no adaptation, an agent that was trained on randomised faults: ROBOT-randomised, or "
    "FOLDER-randomised beside an --agent FOLDER",
    NEVER,
    NO_END,
    agent="randomised",
  ),
  "no-fault": Arm(
    "as detector, on a robot that never breaks: what false alarms cost", ALARM, RULE, breaks=False
  ),
}

ARMS = Arms("mjx_cl.methods", "arm", _SHIPPED)
