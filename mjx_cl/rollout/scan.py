"""The one scan that joins fault, agent and environment. Streams are laid out (groups, members): one
parameter set per group.

Row k of a chunk is control step k: the robot is at obs_k, the agent forms its posterior and chooses
action_k, the fault clock reads k, the environment steps, and reward and `final_obs` are those of
arriving. A reset touches neither the fault clock nor a detector.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl import faults as faults_lib
from mjx_cl.dreamer.agent import Carry
from mjx_cl.dreamer.replay import Record
from mjx_cl.keys import OfStep
from mjx_cl.types import EnvState

if TYPE_CHECKING:
  from collections.abc import Sequence

  from jax.typing import ArrayLike

  from mjx_cl.types import Step

STRETCH = 16  # control steps under one random action, where a robot is shaken


class Stream(NamedTuple):
  """One robot between two decisions.

  Attributes:
    env: EnvState. agent: Carry. obs: float32 (O,). reward: float32 (), of arriving at obs, 0 at an
      episode's start.
    first: bool (), obs starts an episode. key: the stream's key; every draw folds in the step.
    t: int32 (), control steps since the run began. episode: int32 (). injection: the true fault.
  """

  env: EnvState
  agent: Carry
  obs: jax.Array
  reward: jax.Array
  first: jax.Array
  key: jax.Array
  t: jax.Array
  episode: jax.Array
  injection: faults_lib.Injection


class Row(NamedTuple):
  """What one decision brings; a chunk stacks T of them, time-major.

  Attributes:
    obs (O,), first (), reward_in (), action (A,), deter (D,), stoch (stoch,) int: at the decision.
    reward (): sum over the control steps of the decision; rewards (repeat,): one by one.
    final_obs (O,), terminated (), truncated (): of arriving.
    severity (): true severity in force in the last control step, the greatest where there are
      several faults. episode int32 (). demo (A,), has_demo ().
    severities (repeat,): that of each control step; None where a decision is one.
  """

  obs: jax.Array
  first: jax.Array
  reward_in: jax.Array
  action: jax.Array
  deter: jax.Array
  stoch: jax.Array
  reward: jax.Array
  rewards: jax.Array
  final_obs: jax.Array
  terminated: jax.Array
  truncated: jax.Array
  severity: jax.Array
  episode: jax.Array
  demo: jax.Array
  has_demo: jax.Array
  severities: jax.Array | None = None


def start(
  env: Any,
  agent: Any,
  fault: faults_lib.Fault | tuple[faults_lib.Fault, ...],
  key: jax.Array,
  severity: ArrayLike | Sequence[float] = 0.0,
  onset: ArrayLike | Sequence[float] = 0,
  duration: ArrayLike | Sequence[float] = faults_lib.FOREVER,
  target: jax.Array | int = -1,
  plan: faults_lib.Plan | None = None,
) -> Stream:
  """A fresh stream; its robot, fault target and every later draw come from `key`.

  Args:
    fault: Fault or tuple of F. severity, onset, duration, target: () or (F,). plan: in place of
      severity, onset and duration.
  """
  t = jnp.int32(0)
  key_env, key_fault, key = jax.random.split(key, 3)
  injection = faults_lib.begin(
    fault, key_fault, faults_lib.plan(severity, onset, duration) if plan is None else plan, target
  )
  now, model = (
    jax.random.fold_in(key, t),
    faults_lib.owned_model(faults_lib.as_tuple(fault), env.model),
  )
  ports = faults_lib.Ports(model, ctrl=jnp.zeros(len(env.spec.act)), first=True)
  _, ports, _ = faults_lib.drive(
    fault, injection, t, jax.random.fold_in(now, OfStep.FAULTS), ports
  )  # onset 0: the first episode is of the faulty robot
  env_state, obs = env.init(ports.model, key_env)
  injection, obs = faults_lib.sense(
    fault, injection, t, jax.random.fold_in(now, OfStep.FIRST_READING), model, obs, True
  )
  return Stream(
    env_state,
    agent.carry(),
    obs,
    jnp.float32(0),
    jnp.bool_(True),
    key,
    t,
    jnp.int32(0),
    injection,
  )


def nest(function: Callable, in_axes_group: Any, in_axes_member: Any) -> Callable:
  """Vmap over groups, then over members."""
  return jax.vmap(jax.vmap(function, in_axes_member), in_axes_group)


class Rollout:
  """Acting, physics and fault for (groups, members) streams.

  Args:
    env, agent, fault: what is joined; `fault` may be a tuple.
    repeat: control steps per decision.
    deterministic: the policy's mean instead of a sample.
    expert: a demonstrator, Stream -> action, or None.
    expert_noise: deviation of the noise on its actions.
  """

  def __init__(
    self,
    env: Any,
    agent: Any,
    fault: faults_lib.Fault | tuple[faults_lib.Fault, ...],
    repeat: int = 1,
    deterministic: bool = False,
    expert: Callable[[Stream], jax.Array] | None = None,
    expert_noise: float = 0.0,
  ) -> None:
    self.env, self.agent, self.fault, self.repeat = env, agent, fault, repeat
    self.model = faults_lib.owned_model(faults_lib.as_tuple(fault), env.model)
    self.deterministic, self.expert, self.expert_noise = deterministic, expert, expert_noise
    self.chunk = functools.partial(jax.jit, static_argnames=("length",))(self._chunk)

  def _decide(
    self, params: Any, stream: Stream, drive: jax.Array, shake: jax.Array | None
  ) -> tuple[Carry, jax.Array, jax.Array, jax.Array]:
    key = jax.random.fold_in(stream.key, stream.t)
    key_act, key_expert = jax.random.split(jax.random.fold_in(key, OfStep.ACT))
    carry, action = self.agent.act(params, stream.agent, stream.obs, key_act, self.deterministic)
    demo, has_demo = jnp.zeros_like(action), jnp.bool_(False)
    if self.expert is not None:
      demo, has_demo = self.expert(stream), jnp.bool_(True)
      noisy = demo + self.expert_noise * jax.random.normal(key_expert, demo.shape)
      action = jnp.where(drive, noisy, action)
      carry = carry._replace(action=action)
    if shake is not None:
      key_stretch, key_push = jax.random.split(
        jax.random.fold_in(jax.random.fold_in(stream.key, stream.t // STRETCH), OfStep.SHAKE)
      )
      push = jax.random.uniform(key_push, action.shape, minval=-1.0, maxval=1.0)
      action = jnp.where(jax.random.uniform(key_stretch) < shake, push, action)
      carry = carry._replace(action=action)
    return carry, action, demo, has_demo

  def _control(self, stream: Stream, action: jax.Array) -> tuple[Any, Step, jax.Array]:
    """One control step of one robot under its faults."""
    now = jax.random.fold_in(stream.key, stream.t)
    injection, ports, severity = self._drive(stream, now, action)
    env_state, out = self.env.step(ports.model, stream.env, ports.ctrl)
    injection, obs = faults_lib.sense(
      self.fault,
      injection,
      stream.t + 1,
      jax.random.fold_in(now, OfStep.READING),
      self.model,
      out.final_obs,
    )
    out = out._replace(obs=obs, final_obs=obs)
    return (
      stream._replace(env=env_state, t=stream.t + 1, injection=injection),
      out,
      jnp.max(severity),
    )

  def _drive(
    self, stream: Stream, now: jax.Array, action: jax.Array
  ) -> tuple[faults_lib.Injection, faults_lib.Ports, jax.Array]:
    ports = faults_lib.Ports(self.model, ctrl=action, first=stream.first)
    return faults_lib.drive(
      self.fault, stream.injection, stream.t, jax.random.fold_in(now, OfStep.FAULTS), ports
    )

  def _chunk(
    self,
    params: Any,
    streams: Stream,
    length: int,
    drive: jax.Array | None = None,
    shake: jax.Array | None = None,
  ) -> tuple[Any, Row]:
    """`length` decisions.

    Args:
      params: agent parameters with leading (groups,).
      streams: Stream with leading (groups, members).
      drive: bool (groups, members), the expert acts; used only where there is one.
      shake: float32 (groups, members), probability that a stretch of STRETCH control steps is
        driven by one random action, uniform in [-1, 1], in place of the policy's; None: never.

    Returns:
      (streams', Row with leading (length, groups, members)).
    """
    if drive is None:
      drive = jnp.zeros(streams.t.shape, bool)
    shaken = None if shake is None else 0
    decide = nest(self._decide, (0, 0, 0, shaken), (None, 0, 0, shaken))
    control = nest(self._control, (0, 0), (0, 0))
    params = jax.vmap(self.agent.prepare)(params)

    def step(streams: Stream, _: Any) -> tuple[Stream, Row]:
      carry, action, demo, has_demo = decide(params, streams, drive, shake)
      before = streams
      streams, out, severity = control(streams, action)
      rewards, severities = [out.reward], [severity]
      for _ in range(self.repeat - 1):
        over = out.terminated | out.truncated
        later, new, severity = control(streams, action)
        hold = lambda old, new: jax.tree.map(
          lambda a, b: jnp.where(expand(over, b), a, b), old, new
        )
        clock = later.t
        streams, out = hold(streams, later)._replace(t=clock), hold(out, new)
        rewards.append(jnp.where(over, 0.0, new.reward))
        severities.append(severity)
      reward = sum(rewards[1:], rewards[0])
      done = out.terminated | out.truncated
      stoch = jnp.argmax(
        carry.stoch.reshape(
          carry.stoch.shape[:-1] + (self.agent.size.stoch, self.agent.size.classes)
        ),
        -1,
      )
      row = Row(
        before.obs,
        before.first,
        before.reward,
        action,
        carry.deter,
        stoch,
        reward,
        jnp.stack(rewards, -1),
        out.final_obs,
        out.terminated,
        out.truncated,
        severity,
        before.episode,
        demo,
        has_demo,
        jnp.stack(severities, -1) if self.repeat > 1 else None,
      )
      streams = streams._replace(
        agent=carry, obs=out.obs, reward=reward, first=jnp.zeros_like(done)
      )
      return jax.lax.cond(jnp.any(done), self._reset, lambda s, d: s, streams, done), row

    return jax.lax.scan(step, streams, None, length=length)

  def _reset(self, streams: Stream, done: jax.Array) -> Stream:
    """Starts a new episode where `done`; keys fold in the step, so a reset is reproducible."""

    def one(stream: Stream, done: jax.Array) -> Stream:
      now = jax.random.fold_in(stream.key, stream.t)
      _, ports, _ = self._drive(
        stream, now, jnp.zeros(len(self.env.spec.act))
      )  # a task that has changed draws its episodes otherwise
      env_state, obs = self.env.init(ports.model, jax.random.fold_in(now, OfStep.EPISODE))
      injection, obs = faults_lib.sense(
        self.fault,
        stream.injection,
        stream.t,
        jax.random.fold_in(now, OfStep.FIRST_READING),
        self.model,
        obs,
        True,
      )
      new = stream._replace(
        env=env_state,
        agent=self.agent.carry(),
        obs=obs,
        reward=jnp.float32(0),
        first=jnp.bool_(True),
        episode=stream.episode + 1,
        injection=injection,
      )
      return jax.tree.map(lambda a, b: jnp.where(done, a, b), new, stream)

    return nest(one, (0, 0), (0, 0))(streams, done)


def expand(mask: jax.Array, like: jax.Array) -> jax.Array:
  """Appends axes to `mask` until it broadcasts against `like`."""
  return mask.reshape(mask.shape + (1,) * (like.ndim - mask.ndim))


def records(rows: Row) -> tuple[Record, jax.Array]:
  """Rows (T, groups, members) -> replay records (groups, members, 2 T) and which of them exist.

  Every decision gives a record; an episode's end gives one more, of the final observation, with
  zero action.
  """
  done = rows.terminated | rows.truncated
  none = jnp.zeros_like(done)
  act = Record(
    rows.obs,
    rows.action,
    rows.reward_in,
    rows.first,
    none,
    none,
    rows.deter,
    rows.stoch,
    rows.demo,
    rows.has_demo,
  )
  end = Record(
    rows.final_obs,
    jnp.zeros_like(rows.action),
    rows.reward,
    none,
    done,
    rows.terminated,
    jnp.zeros_like(rows.deter),
    jnp.zeros_like(rows.stoch),
    jnp.zeros_like(rows.demo),
    none,
  )

  def weave(a: jax.Array, b: jax.Array) -> jax.Array:
    x = jnp.stack([a, b], 1).reshape((-1,) + a.shape[1:])  # (2 T, groups, members, ...)
    return jnp.moveaxis(x, 0, 2)

  return jax.tree.map(weave, act, end), weave(jnp.ones_like(done), done)
