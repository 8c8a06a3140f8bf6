"""The one scan that joins fault, agent and environment. Streams are laid out (groups, members): one
parameter set per group.

Row k of a chunk is control step k: the robot is at obs_k, the agent forms its posterior and chooses
action_k, the fault clock reads k, the environment steps, and reward and `final_obs` are those of
arriving. A reset touches neither the fault clock nor a detector.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Key, PRNGKeyArray

from mjx_cl import faults as faults_lib
from mjx_cl.dreamer.state import Carry, Record
from mjx_cl.keys import OfSeed, OfStep
from mjx_cl.types import Array, EnvState, Step

STRETCH = 16  # control steps under one random action, where a robot is shaken


class Stream(NamedTuple):
  """One robot between two decisions.

  Attributes:
    env: EnvState.
    agent: Carry.
    obs: float32 (O,).
    reward: float32 (), of arriving at obs, 0 at an episode's start.
    first: bool (), obs starts an episode.
    key: the stream's key; every draw folds in the step.
    t: int32 (), control steps since the run began.
    episode: int32 (), number of the episode.
    injection: the true fault.
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
    obs: float32 (O,), at the decision.
    first: bool (), obs starts an episode.
    reward_in: float32 (), of arriving at obs.
    action: float32 (A,).
    deter: float32 (D,), latent at the decision.
    stoch: int32 (stoch,), class indices of the latent.
    reward: float32 (), sum over the control steps of the decision.
    rewards: float32 (repeat,), one by one.
    final_obs: float32 (O,), of arriving.
    terminated: bool (), of arriving.
    truncated: bool (), of arriving.
    severity: float32 (), true severity in force in the last control step, the greatest where there
      are several faults.
    episode: int32 (), number of the episode.
    demo: float32 (A,), the demonstrator's action at obs.
    has_demo: bool ().
    severities: float32 (repeat,), severity of each control step; None where a decision is one.
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


def stream_keys(seeds: Iterable[int], streams: int) -> Key[Array, "keys"]:
  """Keys of `streams` streams for each seed, (len(seeds) * streams,); the first of a seed is the
  one that `run` uses.
  """
  keys = [
    jax.random.key(s) if i == 0 else jax.random.fold_in(jax.random.key(s), OfSeed.FURTHER + i)
    for s in seeds
    for i in range(streams)
  ]
  return jnp.stack(keys)


def start(
  env: Any,
  agent: Any,
  fault: faults_lib.Fault | tuple[faults_lib.Fault, ...],
  key: PRNGKeyArray,
  severity: ArrayLike | Sequence[Any] = 0.0,
  onset: ArrayLike | Sequence[Any] = 0,
  duration: ArrayLike | Sequence[Any] = faults_lib.FOREVER,
  target: Any = -1,
  plan: faults_lib.Plan | None = None,
) -> Stream:
  """A fresh stream; its robot, fault target and every later draw come from `key`.

  Args:
    env: of the robot.
    agent: that acts.
    fault: Fault or tuple of F.
    key: of the stream.
    severity: () or (F,).
    onset: () or (F,) [control steps].
    duration: () or (F,) [control steps].
    target: () or (F,); -1: drawn.
    plan: in place of severity, onset and duration.
  """
  t = jnp.int32(0)
  key_env, key_fault, key = jax.random.split(key, 3)
  plan = faults_lib.plan(severity, onset, duration) if plan is None else plan
  injection = faults_lib.begin(fault, key_fault, plan, target)
  now = jax.random.fold_in(key, t)
  model = faults_lib.owned_model(faults_lib.as_tuple(fault), env.model)
  ports = faults_lib.Ports(model, ctrl=jnp.zeros(len(env.spec.act)), first=True)
  # onset 0: the first episode is of the faulty robot
  _, ports, _ = faults_lib.drive(fault, injection, t, jax.random.fold_in(now, OfStep.FAULTS), ports)
  env_state, obs = env.init(ports.model, key_env)
  injection, obs = faults_lib.sense(
    fault, injection, t, jax.random.fold_in(now, OfStep.FIRST_READING), model, obs, True
  )
  return Stream(
    env=env_state,
    agent=agent.carry(),
    obs=obs,
    reward=jnp.float32(0),
    first=jnp.bool_(True),
    key=key,
    t=t,
    episode=jnp.int32(0),
    injection=injection,
  )


def nest(function: Callable, in_axes_group: Any, in_axes_member: Any) -> Callable:
  """Vmap over groups, then over members."""
  return jax.vmap(jax.vmap(function, in_axes_member), in_axes_group)


class Rollout:
  """Acting, physics and fault for (groups, members) streams.

  Args:
    env: of the robot.
    agent: that acts.
    fault: Fault or a tuple of them.
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
    self,
    params: Any,
    stream: Any,
    drive: Bool[Array, ""],
    shake: Float[Array, ""] | None,
  ) -> tuple[Carry, Float[Array, "act"], Float[Array, "act"], Bool[Array, ""]]:
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

  def _control(
    self, stream: Any, action: Float[Array, "act"]
  ) -> tuple[Any, Step, Float[Array, ""]]:
    """One control step of one robot under its faults."""
    now = jax.random.fold_in(stream.key, stream.t)
    injection, ports, severity = self._drive(stream, now, action)
    env_state, out = self.env.step(ports.model, stream.env, ports.ctrl)
    t = stream.t + 1
    reading = jax.random.fold_in(now, OfStep.READING)
    injection, obs = faults_lib.sense(self.fault, injection, t, reading, self.model, out.final_obs)
    out = out._replace(obs=obs, final_obs=obs)
    return stream._replace(env=env_state, t=t, injection=injection), out, jnp.max(severity)

  def _drive(
    self, stream: Any, now: PRNGKeyArray, action: Float[Array, "act"]
  ) -> tuple[faults_lib.Injection, faults_lib.Ports, Array]:
    ports = faults_lib.Ports(self.model, ctrl=action, first=stream.first)
    return faults_lib.drive(
      self.fault, stream.injection, stream.t, jax.random.fold_in(now, OfStep.FAULTS), ports
    )

  def _chunk(
    self,
    params: Any,
    streams: Any,
    length: int,
    drive: Bool[Array, "groups members"] | None = None,
    shake: Float[Array, "groups members"] | None = None,
  ) -> tuple[Any, Row]:
    """`length` decisions.

    Args:
      params: agent parameters with leading (groups,).
      streams: Stream with leading (groups, members).
      length: decisions.
      drive: the expert acts; used only where there is one.
      shake: probability that a stretch of STRETCH control steps is driven by one random action,
        uniform in [-1, 1], in place of the policy's; None: never.

    Returns:
      (streams', Row with leading (length, groups, members)).
    """
    drive = jnp.zeros(streams.t.shape, bool) if drive is None else drive
    params = jax.vmap(self.agent.prepare)(params)
    step = lambda streams, _: self._step(params, streams, drive, shake)
    return jax.lax.scan(step, streams, None, length=length)

  def _step(
    self,
    params: Any,
    streams: Any,
    drive: Bool[Array, "groups members"],
    shake: Float[Array, "groups members"] | None,
  ) -> tuple[Any, Row]:
    """One decision of all streams."""
    shaken = None if shake is None else 0
    decide = nest(self._decide, (0, 0, 0, shaken), (None, 0, 0, shaken))
    carry, action, demo, has_demo = decide(params, streams, drive, shake)
    moved, out, rewards, severities = self._hold(streams, action)
    reward = sum(rewards[1:], rewards[0])
    done = out.terminated | out.truncated
    size = self.agent.size
    hot = carry.stoch.reshape(carry.stoch.shape[:-1] + (size.stoch, size.classes))
    row = Row(
      obs=streams.obs,
      first=streams.first,
      reward_in=streams.reward,
      action=action,
      deter=carry.deter,
      stoch=jnp.argmax(hot, -1),
      reward=reward,
      rewards=jnp.stack(rewards, -1),
      final_obs=out.final_obs,
      terminated=out.terminated,
      truncated=out.truncated,
      severity=severities[-1],
      episode=streams.episode,
      demo=demo,
      has_demo=has_demo,
      severities=jnp.stack(severities, -1) if self.repeat > 1 else None,
    )
    moved = moved._replace(agent=carry, obs=out.obs, reward=reward, first=jnp.zeros_like(done))
    return jax.lax.cond(jnp.any(done), self._reset, lambda s, d: s, moved, done), row

  def _hold(
    self, streams: Any, action: Float[Array, "groups members act"]
  ) -> tuple[Any, Step, list[Array], list[Array]]:
    """`repeat` control steps with one action; a stream whose episode is over rests, its clock runs
    on. Gives also reward and severity of each step.
    """
    control = nest(self._control, (0, 0), (0, 0))
    streams, out, severity = control(streams, action)
    rewards, severities = [out.reward], [severity]
    for _ in range(self.repeat - 1):
      over = out.terminated | out.truncated
      later, new, severity = control(streams, action)
      rest = lambda old, new: jax.tree.map(lambda a, b: jnp.where(expand(over, b), a, b), old, new)
      walk, resting = later.injection.walk, rest(streams, later)
      injection = resting.injection._replace(walk=walk)  # which knows of no episodes
      streams, out = resting._replace(t=later.t, injection=injection), rest(out, new)
      rewards.append(jnp.where(over, 0.0, new.reward))
      severities.append(severity)
    return streams, out, rewards, severities

  def _reset(self, streams: Any, done: Bool[Array, "groups members"]) -> Any:
    """Starts a new episode where `done`; keys fold in the step, so a reset is reproducible."""

    def one(stream: Any, done: Array) -> Any:
      now = jax.random.fold_in(stream.key, stream.t)
      # a task that has changed draws its episodes otherwise
      _, ports, _ = self._drive(stream, now, jnp.zeros(len(self.env.spec.act)))
      env_state, obs = self.env.init(ports.model, jax.random.fold_in(now, OfStep.EPISODE))
      reading = jax.random.fold_in(now, OfStep.FIRST_READING)
      injection, obs = faults_lib.sense(
        self.fault, stream.injection, stream.t, reading, self.model, obs, True
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


def expand(mask: Bool[Array, "..."], like: Array) -> Bool[Array, "..."]:
  """Appends axes to `mask` until it broadcasts against `like`."""
  return mask.reshape(mask.shape + (1,) * (like.ndim - mask.ndim))


def records(rows: Row) -> tuple[Record, Bool[Array, "groups members records"]]:
  """Rows (T, groups, members) -> replay records (groups, members, 2 T) and which of them exist.

  Every decision gives a record; an episode's end gives one more, of the final observation, with
  zero action.
  """
  done = rows.terminated | rows.truncated
  none = jnp.zeros_like(done)
  act = Record(
    obs=rows.obs,
    action=rows.action,
    reward=rows.reward_in,
    first=rows.first,
    last=none,
    terminal=none,
    deter=rows.deter,
    stoch=rows.stoch,
    demo=rows.demo,
    has_demo=rows.has_demo,
  )
  end = Record(
    obs=rows.final_obs,
    action=jnp.zeros_like(rows.action),
    reward=rows.reward,
    first=none,
    last=done,
    terminal=rows.terminated,
    deter=jnp.zeros_like(rows.deter),
    stoch=jnp.zeros_like(rows.stoch),
    demo=jnp.zeros_like(rows.demo),
    has_demo=none,
  )

  def weave(a: Array, b: Array) -> Array:
    x = jnp.stack([a, b], 1).reshape((-1,) + a.shape[1:])  # (2 T, groups, members, ...)
    return jnp.moveaxis(x, 0, 2)

  return jax.tree.map(weave, act, end), weave(jnp.ones_like(done), done)
