"""What a method is: pure functions of one stream that say what of an update is learnt and which
weights act.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.config import AdaptConfig, quick
from mjx_cl.dreamer.agent import Agent, TrainState
from mjx_cl.dreamer.state import Record


class View(NamedTuple):
  """What a method may read of the chunk (64 decisions) that one stream has just lived.

  Attributes:
    was: int32 (), phase before it, of decide.NOMINAL to decide.ENDED.
    phase: int32 (), phase after it.
    begins: bool (), an adaptation begins in it.
    over: bool (), an adaptation ends in it, however it does.
    reward: float32 (), mean reward a control step.
    recent: float32 (), mean reward of the last `patience` chunks of the adaptation; nan: of none.
    signals: float32 (6,), means in the order of decide.SIGNALS; nan: unknown.
    taken: int32 (), updates of the learner after it.
    rate: float32 (), how far what acts is drawn towards the learner; 0 without an update.
    acted: parameters that acted in it.
    learner: parameters of the learner after it.
  """

  was: jax.Array
  phase: jax.Array
  begins: jax.Array
  over: jax.Array
  reward: jax.Array
  recent: jax.Array
  signals: jax.Array
  taken: jax.Array
  rate: jax.Array
  acted: Any
  learner: Any


class Acts(NamedTuple):
  """What a method answers.

  Attributes:
    params: that act, and predict, in the chunk to come.
    memory: of the method.
    back: bool (), the weights of before the adaptation are put back: a row `rollback` of
      events.parquet, with the two that follow.
    earned: float32 (), mean reward a step of the weights of before.
    earns: float32 (), of the learner's.
    learner: parameters that the learner goes on from where an adaptation is over; None: `params`.
  """

  params: Any
  memory: Any
  back: jax.Array | bool = False
  earned: jax.Array | float = jnp.nan
  earns: jax.Array | float = jnp.nan
  learner: Any = None


# (agent, memory, state, batch, key) -> (state', metrics, latents), as Agent.update
Update = Callable[
  [Agent, Any, TrainState, Record, jax.Array],
  tuple[TrainState, dict[str, jax.Array], tuple[jax.Array, jax.Array]],
]


def follow(params: Any, learner: Any, rate: jax.Array) -> Any:
  """Params + rate (learner - params), leaf by leaf."""
  return jax.tree.map(lambda a, p: a + rate * (p - a), params, learner)


def average(memory: Any, view: View) -> Acts:
  """The paper's way: a moving average of the learner's weights acts, and stays in the end."""
  return Acts(follow(view.acted, view.learner, view.rate), memory)


@dataclass(frozen=True)
class Settings:
  """What a method wants otherwise than AdaptConfig's default, see there; None: the run's. A value
  that a run is given and that is neither the default nor that of --quick stands above it.

  Attributes:
    start_windows: Windows that the replay must hold before the first update.
    average: Rate per chunk of the moving average of the weights that acts.
    regain: Share of the reward before the alarm that must be back before it may converge.
  """

  start_windows: int | None = None
  average: float | None = None
  regain: float | None = None

  def __post_init__(self) -> None:
    AdaptConfig(**{k: v for k, v in vars(self).items() if v is not None})  # its ranges

  def of(self, name: str, config: AdaptConfig) -> Any:
    """The value that a run of `config` takes."""
    run, wanted = getattr(config, name), getattr(self, name)
    defaults = getattr(AdaptConfig, name), getattr(quick.ADAPT, name)
    return run if wanted is None or run not in defaults else wanted


@dataclass(frozen=True)
class Method:
  """How a stream learns and acts once an adaptation has begun; before, every stream acts by the
  agent that it came with. All functions are pure, of one stream, and traced by JAX.

  Attributes:
    init: params -> memory, a pytree of arrays whose shapes and types stay; `params` are those that
      act when the first adaptation begins.
    act: (memory, View) -> Acts, after every chunk from the one on in which the first adaptation
      begins.
    keep: (memory, TrainState, TrainState) -> TrainState: of the states before and after an update
      what the learner goes on with. None: the latter.
    update: one update of the learner, see Update; None: Agent.update. Where its metrics show a loss
      at fault the stream is given up.
    hides: memory -> bool (): the chunk was not lived by what learns, the stop rule looks away.
    copies: sets of parameters that the memory holds, for the memory that a run says it takes.
    weighs: `act` fills back, earned and earns.
    learns: updates are taken; False: none are, `act` alone does something.
    settings: in which it differs from the defaults of AdaptConfig.
  """

  init: Callable[[Any], Any] = lambda params: ()
  act: Callable[[Any, View], Acts] = average
  keep: Callable[[Any, TrainState, TrainState], TrainState] | None = None
  update: Update | None = None
  hides: Callable[[Any], jax.Array] | None = None
  copies: int = 0
  weighs: bool = False
  learns: bool = True
  settings: Settings = Settings()


PAPER = Method()
