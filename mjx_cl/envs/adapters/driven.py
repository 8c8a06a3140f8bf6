"""Robots that are driven from outside, with the faults of `mjx-cl run`: what every
adapter holds.
"""

import dataclasses
import types
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import envs, faults
from mjx_cl.config.checks import field_kinds
from mjx_cl.dreamer.agent import Carry
from mjx_cl.errors import UserError
from mjx_cl.faults import presets
from mjx_cl.keys import OfStream
from mjx_cl.rollout.scan import Rollout, Stream, expand, nest, start


def worst(severity: jax.Array) -> jax.Array:
  """Largest severity in force of one robot, float32 (), whether it has one fault or several."""
  return jnp.max(jnp.asarray(severity))


class Puppet:
  """The place of an agent for a robot that is driven from outside. Left alone it commands `spread`
  x U(-1, 1): 0 is no command at all.
  """

  def __init__(self, act_size: int, spread: float = 0.0) -> None:
    self.act_size, self.spread = act_size, spread
    self.size = types.SimpleNamespace(stoch=1, classes=1)

  def carry(self) -> Carry:
    """A carry that holds nothing."""
    return Carry(jnp.zeros(1), jnp.zeros(1), jnp.zeros(self.act_size))

  def prepare(self, params: Any) -> Any:
    """The parameters as they are."""
    return params

  def act(
    self, params: Any, carry: Carry, obs: jax.Array, key: jax.Array, deterministic: bool = False
  ) -> tuple[Carry, jax.Array]:
    """An action drawn evenly within `spread`, whatever is observed."""
    action = self.spread * jax.random.uniform(key, (self.act_size,), minval=-1.0, maxval=1.0)
    return carry._replace(action=action), action


@dataclasses.dataclass(frozen=True)
class FaultSettings:
  """The fault of a driven robot, as keyword arguments of every adapter.

  Attributes:
    fault: name of a fault, or of a preset, which brings its targets, severities and schedules.
    target: name of what breaks; None or `random`: drawn from the stream's key.
    severity: in [0, 1], while active; None: 0.5, or the preset's.
    onset: first control step that the fault acts in.
    duration: control steps until it is repaired; None: never.
    schedule: how the severity moves from the onset on, one of faults.SCHEDULES.
    period: of a schedule that repeats [control steps].
    share: of a period in which an intermittent fault acts.
  """

  fault: str = "none"
  target: str | None = None
  severity: float | None = None
  onset: int = 0
  duration: int | None = None
  schedule: str = "abrupt"
  period: int = 1000
  share: float = 0.5

  def build(self, env: Any) -> tuple[tuple[faults.Fault, ...], faults.Plan, jax.Array]:
    """What `faults.build` gives for them on `env`.

    Raises:
      UserError for what `presets.resolve` refuses, for a value of another kind, for a severity or
      target without a fault, and for a preset that turns the robot into another one.
    """
    robot = env.spec.name
    plain = {k: v.item() if isinstance(v, np.generic) else v for k, v in vars(self).items()}
    field_kinds("fault", FaultSettings, plain)
    own = FaultSettings(**plain)
    changes = presets.resolve(
      robot,
      own.fault,
      None if own.target == "random" else own.target,
      own.severity,
      own.duration,
      own.schedule,
      own.period,
      own.share,
    )
    if own.fault == "none" and (own.severity or own.target is not None):
      raise UserError("severity and target are of a fault; name one too, or leave them out")
    if presets.named(own.fault) and (other := presets.find(own.fault, robot).becomes):
      raise UserError(
        f"preset {own.fault!r} turns the robot into {other!r}, which only `mjx-cl run` does; take "
        f"{other!r} itself"
      )
    if own.onset < 0:
      raise UserError(f"onset must be at least 0; got {own.onset}")
    if own.onset >= (last := faults.FOREVER - max(c.after for c in changes)):
      raise UserError(f"onset must be below {last:,}; got {own.onset}")
    return faults.build(changes, env, own.onset)


def join(
  env: Any, agent: Any = None, repeat: int = 1, deterministic: bool = False, **fault: Any
) -> tuple[Rollout, Callable[[jax.Array], Stream]]:
  """Environment, fault and agent as `run` joins them.

  Args:
    env: environment.
    agent: what acts; None: a Puppet.
    repeat: control steps of a decision.
    deterministic: whether the agent acts without sampling.
    **fault: FaultSettings.

  Returns:
    (rollout, begin): Rollout, and begin(key) -> Stream of one robot.

  Raises:
    UserError as FaultSettings.build.
  """
  made, plan, index = FaultSettings(**fault).build(env)
  agent = agent or Puppet(len(env.spec.act))
  return Rollout(env, agent, made, repeat, deterministic), lambda key: start(
    env, agent, made, key, plan=plan, target=index
  )


@dataclasses.dataclass(frozen=True)
class _Bits:
  """A random key as NumPy holds it."""

  data: np.ndarray


def _packed(x: jax.Array) -> np.ndarray | _Bits:
  if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
    return _Bits(np.asarray(jax.random.key_data(x)))
  return np.asarray(x)


def _unpacked(x: np.ndarray | _Bits) -> jax.Array:
  return jax.random.wrap_key_data(jnp.asarray(x.data)) if isinstance(x, _Bits) else jnp.asarray(x)


class Robots:
  """Driven robots side by side: what both gymnasium adapters hold. Arrays in and out are NumPy's,
  first axis the robot.

  Attributes:
    env: the environment.
    num: robots.
    rollout: Rollout that steps them.
    streams: Stream with leading (1, num); None before the first `begin`.
    untouched: bool (num,), no control step since the last reset.
  """

  streams: Stream | Any

  def __init__(self, env: Any, physics: str, num: int, **fault: Any) -> None:
    self._made = (env, physics, num), fault
    self.env, self.num = envs.make(env, physics) if isinstance(env, str) else env, num
    self.rollout, begin = join(self.env, **fault)
    self._begin = jax.jit(nest(begin, 0, 0))
    self._reset, self._step = jax.jit(self._reset_where), jax.jit(self._step_where)
    self.streams, self.untouched = None, np.ones(num, bool)

  def __copy__(self) -> "Robots":
    """Robots whose lives part from here; environment and compiled programs are shared."""
    new = object.__new__(type(self))  # `copy.copy` would go through __setstate__
    new.__dict__.update(self.__dict__)  # arrays are replaced, never written
    return new

  def __deepcopy__(self, memo: dict) -> "Robots":
    """As a shallow copy."""
    return self.__copy__()

  def __getstate__(self) -> dict[str, Any]:
    return {
      "made": self._made,
      "streams": jax.tree.map(_packed, self.streams),
      "untouched": self.untouched,
    }

  def __setstate__(self, state: dict[str, Any]) -> None:
    place, fault = state["made"]
    Robots.__init__(self, *place, **fault)
    self.streams = jax.tree.map(_unpacked, state["streams"], is_leaf=lambda x: isinstance(x, _Bits))
    self.untouched = state["untouched"]

  def begin(self, seeds: Sequence[int]) -> np.ndarray:
    """New lives: robots, faults and fault clocks anew; observations (num, O)."""
    self.streams = self._begin(jnp.stack([jax.random.key(s) for s in seeds])[None])
    self.untouched = np.ones(self.num, bool)
    return np.array(self.streams.obs[0])

  def reset(self) -> np.ndarray:
    """New episodes of the same lives: fault and clock go on; observations (num, O)."""
    self.streams = self._reset(self.streams, self.untouched[None])
    self.untouched = np.ones(self.num, bool)
    return np.array(self.streams.obs[0])

  def step(
    self, actions: np.ndarray, pending: Sequence[bool] | np.ndarray
  ) -> tuple[np.ndarray, ...]:
    """One control step of all robots but those `pending`, which get a new episode in its place
    while their fault clock stands still.

    Args:
      actions: float32 (num, A).
      pending: bool (num,).

    Returns:
      obs (num, O), reward, terminated, truncated (num,), and the true severity in force and the
      fault clock in this step, (num,).
    """
    clock = np.array(self.streams.t[0])
    self.streams, out = self._step(
      self.streams, jnp.asarray(actions, jnp.float32)[None], jnp.asarray(pending)[None]
    )
    self.untouched = np.array(pending)
    return *(np.array(x[0]) for x in out), clock

  def _reset_where(self, streams: Stream, untouched: jax.Array) -> Stream:
    # a reset's draw folds in the clock alone, so that episodes are those of a rollout; a second
    # reset on the same clock must differ
    other = nest(lambda key: jax.random.fold_in(key, OfStream.AGAIN), 0, 0)(streams.key)
    streams = streams._replace(key=jnp.where(untouched, other, streams.key))
    return self.rollout._reset(streams, jnp.ones_like(untouched))

  def _step_where(
    self, streams: Stream, actions: jax.Array, pending: jax.Array
  ) -> tuple[Stream, tuple[jax.Array, ...]]:
    moved, out, severity = nest(self.rollout._control, (0, 0), (0, 0))(streams, actions)
    moved = moved._replace(obs=out.final_obs, reward=out.reward, first=jnp.zeros_like(pending))
    fresh = jax.lax.cond(
      jnp.any(pending), self.rollout._reset, lambda streams, _: streams, streams, pending
    )
    streams = jax.tree.map(lambda new, old: jnp.where(expand(pending, old), new, old), fresh, moved)
    zero = jnp.where(pending, 0.0, 1.0)
    severity = nest(worst, 0, 0)(severity) * zero
    return streams, (
      streams.obs,
      out.reward * zero,
      out.terminated & ~pending,
      out.truncated & ~pending,
      severity,
    )
