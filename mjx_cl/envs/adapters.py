"""Our environments as other libraries know them: `brax.envs.Env`, `gymnasium.Env`,
`gymnasium.vector.VectorEnv`.

Faults come in through `join` alone, which hands over the parts of the rollout: a fault acts here
exactly as in `mjx-cl run`, and robot i of seed s is the robot that seed s + i of `run` has, its
later episodes included.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import types

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import envs, faults
from mjx_cl.dreamer.agent import Carry
from mjx_cl.errors import UserError
from mjx_cl.faults import presets
from mjx_cl.keys import OfStep, OfStream
from mjx_cl.rollout.scan import Rollout, Stream, expand, nest, start


def worst(severity) -> jax.Array:
  """Largest severity in force of one robot, float32 (), whether it has one fault or several."""
  return jnp.max(jnp.asarray(severity))


class Puppet:
  """The place of an agent for a robot that is driven from outside. Left alone it commands `spread`
  x U(-1, 1): 0 is no command at all.
  """

  def __init__(self, act_size: int, spread: float = 0.0):
    self.act_size, self.spread = act_size, spread
    self.size = types.SimpleNamespace(stoch=1, classes=1)

  def carry(self) -> Carry:
    return Carry(jnp.zeros(1), jnp.zeros(1), jnp.zeros(self.act_size))

  def prepare(self, params):
    return params

  def act(self, params, carry: Carry, obs, key, deterministic: bool = False):
    action = self.spread * jax.random.uniform(key, (self.act_size,), minval=-1.0, maxval=1.0)
    return carry._replace(action=action), action


def join(
  env,
  agent=None,
  fault: str = "none",
  target: str | None = None,
  severity: float | None = None,
  onset: int = 0,
  duration: int | None = None,
  schedule: str = "abrupt",
  period: int = 1000,
  share: float = 0.5,
  repeat: int = 1,
  deterministic: bool = False,
):
  """Environment, fault and agent as `run` joins them.

  Args:
    agent: what acts; None: a Puppet.
    fault: name of a fault, or of a preset, which brings its targets, severities and schedules.
      target: None or `random`: drawn from the stream's key.
    severity: in [0, 1], while active; None: 0.5, or the preset's.
    onset: first control step that the fault acts in. duration: control steps until it is repaired;
      None: never.
    schedule, period, share: how the severity moves from the onset on, see fault_presets.SCHEDULES.
    repeat, deterministic: as in Rollout.

  Returns:
    (rollout, begin): Rollout, and begin(key) -> Stream of one robot.

  Raises:
    UserError for what `fault_presets.resolve` refuses, and for a preset that turns the robot into
    another one.
  """
  changes = presets.resolve(
    env.spec.name,
    fault,
    None if target == "random" else target,
    severity,
    duration,
    schedule,
    period,
    share,
  )
  if presets.named(fault) and (other := presets.find(fault, env.spec.name).becomes):
    raise UserError(
      f"preset {fault!r} turns the robot into {other!r}, which only `mjx-cl run` does; take "
      f"{other!r} itself"
    )
  if onset < 0:
    raise UserError(f"onset must be at least 0; got {onset}")
  if onset >= (last := faults.FOREVER - max(c.after for c in changes)):
    raise UserError(f"onset must be below {last:,}; got {onset}")
  made, plan, index = faults.build(changes, env, onset)
  agent = agent or Puppet(len(env.spec.act))
  return Rollout(env, agent, made, repeat, deterministic), lambda key: start(
    env, agent, made, key, plan=plan, target=index
  )


# ---- brax ----------------------------------------------------------------------------------------


def brax(module: str):
  """Brax's module of that name. What its imports print (a line where warp is absent) stays off
  standard output.

  Raises:
    UserError where brax is not installed.
  """
  try:
    with contextlib.redirect_stdout(io.StringIO()):
      return importlib.import_module(f"brax.{module}")
  except ImportError as e:
    raise UserError(f"this needs brax ({e}): pip install 'mjx-cl[brax]'") from None


def brax_env(
  env,
  fault: str | None = None,
  target: str | None = None,
  severity: float | None = None,
  onset: int = 0,
  duration: int | None = None,
  schedule: str = "abrupt",
  period: int = 1000,
  share: float = 0.5,
):
  """Our environment as a `brax.envs.Env`, nominal unless a fault or a preset is named, with
  settings as in `join`.

  brax's own wrappers do the vmap, the time limit and the autoreset; its autoreset restarts every
  robot from its own first state. They leave `info` alone, which is where the fault and its clock
  live: a reset touches neither.
  """
  base = brax("envs.base")
  rollout, begin = join(
    env, None, fault or "none", target, severity, onset, duration, schedule, period, share
  )

  class BraxEnv(base.Env):
    def reset(self, rng):
      zero = jnp.float32(0)
      if fault is None:
        state, obs = env.init(env.model, rng)
        return base.State(state, obs, zero, zero, {})
      stream = begin(rng)
      return base.State(
        stream.env,
        stream.obs,
        zero,
        zero,
        {},
        {"stream": stream._replace(env=()), "severity": zero},
      )

    def step(self, state, action):
      if fault is None:
        inner, out = env.step(rollout.model, state.pipeline_state, action)
        info = state.info
      else:
        first = state.pipeline_state.step == 0
        stream = state.info["stream"]._replace(env=state.pipeline_state, first=first)
        now = jax.random.fold_in(jax.random.fold_in(stream.key, stream.t), OfStep.FIRST_READING)
        renewed, _ = faults.sense(
          rollout.fault, stream.injection, stream.t, now, rollout.model, state.obs, True
        )
        injection = jax.tree.map(
          lambda new, old: jnp.where(first, new, old), renewed, stream.injection
        )  # brax's autoreset renews no memory
        stream = stream._replace(injection=injection)
        stream, out, severity = rollout._control(stream, action)
        inner, info = (
          stream.env,
          state.info | {"stream": stream._replace(env=()), "severity": worst(severity)},
        )
      return state.replace(
        pipeline_state=inner,
        obs=out.final_obs,
        reward=out.reward,
        done=out.terminated.astype(jnp.float32),
        info=info,
      )

    @property
    def observation_size(self):
      return len(env.spec.obs)

    @property
    def action_size(self):
      return len(env.spec.act)

    @property
    def backend(self):
      return "mjx_cl"

  return BraxEnv()


# ---- gymnasium -----------------------------------------------------------------------------------


class Robots:
  """Driven robots side by side: what both gymnasium adapters hold. Arrays in and out are NumPy's,
  first axis the robot.

  Attributes:
    streams: Stream with leading (1, num).
    untouched: bool (num,), no control step since the last reset.
  """

  def __init__(self, env, num: int, **fault):
    self.num = num
    self.rollout, begin = join(env, **fault)
    self._begin = jax.jit(nest(begin, 0, 0))
    self._reset, self._step = jax.jit(self._reset_where), jax.jit(self._step_where)
    self.streams, self.untouched = None, np.ones(num, bool)

  def begin(self, seeds) -> np.ndarray:
    """New lives: robots, faults and fault clocks anew; observations (num, O)."""
    self.streams = self._begin(jnp.stack([jax.random.key(s) for s in seeds])[None])
    self.untouched = np.ones(self.num, bool)
    return np.array(self.streams.obs[0])

  def reset(self) -> np.ndarray:
    """New episodes of the same lives: fault and clock go on; observations (num, O)."""
    self.streams = self._reset(self.streams, self.untouched[None])
    self.untouched = np.ones(self.num, bool)
    return np.array(self.streams.obs[0])

  def step(self, actions, pending):
    """One control step of all robots but those `pending`, which get a new episode in its place
    while their fault clock stands still.

    Args:
      actions: float32 (num, A). pending: bool (num,).

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

  def _reset_where(self, streams: Stream, untouched):
    # a reset's draw folds in the clock alone, so that episodes are those of a rollout; a second
    # reset on the same clock must differ
    other = nest(lambda key: jax.random.fold_in(key, OfStream.AGAIN), 0, 0)(streams.key)
    streams = streams._replace(key=jnp.where(untouched, other, streams.key))
    return self.rollout._reset(streams, jnp.ones_like(untouched))

  def _step_where(self, streams: Stream, actions, pending):
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


def _gymnasium():
  try:
    import gymnasium
    import gymnasium.vector
  except ImportError:
    raise UserError(
      "the gymnasium adapter needs gymnasium: pip install 'mjx-cl[gymnasium]'"
    ) from None
  return gymnasium


def _prepare(env, physics: str, num: int, fault: dict):
  """(environment, Robots, observation space, action space) of `num` robots."""
  from gymnasium.spaces import Box

  env = envs.make(env, physics) if isinstance(env, str) else env
  box = lambda variables: Box(
    *(np.array([getattr(v, end) for v in variables], np.float32) for end in ("low", "high")),
    dtype=np.float32,
  )
  return env, Robots(env, num, **fault), box(env.spec.obs), box(env.spec.act)


def gymnasium_env(
  env,
  seed: int = 0,
  physics: str = "auto",
  fault: str = "none",
  target: str | None = None,
  severity: float | None = None,
  onset: int = 0,
  duration: int | None = None,
  schedule: str = "abrupt",
  period: int = 1000,
  share: float = 0.5,
):
  """One robot as a `gymnasium.Env`; arguments and the meaning of a reset as in `gymnasium_vector`."""
  gymnasium = _gymnasium()
  options = dict(
    fault=fault,
    target=target,
    severity=severity,
    onset=onset,
    duration=duration,
    schedule=schedule,
    period=period,
    share=share,
  )
  env, robots, obs_space, act_space = _prepare(env, physics, 1, options)

  class GymnasiumEnv(gymnasium.Env):
    metadata = {"render_modes": [], "render_fps": 1.0 / env.spec.control_s}
    observation_space, action_space = obs_space, act_space

    def __init__(self):
      self.robots = robots

    def reset(self, *, seed: int | None = None, options: dict | None = None):
      seed = first_seed if seed is None and self.robots.streams is None else seed
      super().reset(seed=seed)
      return (self.robots.reset() if seed is None else self.robots.begin([seed]))[0], {}

    def step(self, action):
      if self.robots.streams is None:
        raise gymnasium.error.ResetNeeded("call reset before the first step")
      obs, reward, terminated, truncated, now, clock = (
        x[0] for x in self.robots.step(_shaped(action, act_space)[None], [False])
      )
      return obs, float(reward), bool(terminated), bool(truncated), {"severity": now, "t": clock}

  first_seed = seed
  return GymnasiumEnv()


def gymnasium_vector(
  env,
  num_envs: int = 1,
  seed: int = 0,
  physics: str = "auto",
  fault: str = "none",
  target: str | None = None,
  severity: float | None = None,
  onset: int = 0,
  duration: int | None = None,
  schedule: str = "abrupt",
  period: int = 1000,
  share: float = 0.5,
):
  """Robots side by side as a `gymnasium.vector.VectorEnv` with autoreset in the next step.

  After a step with `terminations` or `truncations`, `obs` is the last observation of that episode;
  the next call ignores the robot's action, gives the first observation of a new one, reward 0 and
  neither end, and is no control step: the fault clock stands still. reset(seed=s) begins new lives,
  robot i from seed s + i (or from a list of seeds). reset() without a seed starts a new episode of
  the same robots; fault and fault clock go on. The spaces are the spec's: a faulty sensor may leave
  its bounds. infos hold the true fault for logs, which no agent should see: `severity` in force in
  this step and its clock `t`, each with gymnasium's mask of the robots that made a control step.

  Args:
    env: name or environment. num_envs: robots. seed: of the first reset where that names none.
    physics: backend, where `env` is a name. fault ... share: as in `join`.

  Example:
    robots = gymnasium_vector("walker", 8, fault="gear", severity=0.5, onset=5000)
    obs, infos = robots.reset(seed=0)
  """
  gymnasium = _gymnasium()
  if num_envs < 1:
    raise UserError(f"num_envs must be above 0; got {num_envs}")
  options = dict(
    fault=fault,
    target=target,
    severity=severity,
    onset=onset,
    duration=duration,
    schedule=schedule,
    period=period,
    share=share,
  )
  env, robots, obs_space, act_space = _prepare(env, physics, num_envs, options)
  batch = functools.partial(gymnasium.vector.utils.batch_space, n=num_envs)

  class GymnasiumVector(gymnasium.vector.VectorEnv):
    metadata = {
      "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP,
      "render_modes": [],
      "render_fps": 1.0 / env.spec.control_s,
    }

    def __init__(self):
      self.robots, self.num_envs = robots, num_envs
      self.single_observation_space, self.single_action_space = obs_space, act_space
      self.observation_space, self.action_space = batch(obs_space), batch(act_space)
      self._pending = np.zeros(num_envs, bool)

    def reset(self, *, seed=None, options: dict | None = None):
      if options:
        raise UserError(f"reset takes no options; got {', '.join(map(str, options))}")
      seed = first_seed if seed is None and self.robots.streams is None else seed
      self._pending = np.zeros(num_envs, bool)
      if seed is None:
        return self.robots.reset(), {}
      seeds = (
        [seed + i for i in range(num_envs)] if isinstance(seed, (int, np.integer)) else list(seed)
      )
      if len(seeds) != num_envs:
        raise UserError(
          f"give one seed, or one for each of the {num_envs} robots; got {len(seeds)}"
        )
      super().reset(seed=int(seeds[0]))
      return self.robots.begin([int(s) for s in seeds]), {}

    def step(self, actions):
      if self.robots.streams is None:
        raise gymnasium.error.ResetNeeded("call reset before the first step")
      moved = ~self._pending
      obs, reward, terminated, truncated, now, clock = self.robots.step(
        _shaped(actions, self.action_space), self._pending
      )
      self._pending = terminated | truncated
      infos = {
        "severity": now,
        "_severity": moved,
        "t": np.where(moved, clock, 0),
        "_t": moved.copy(),
      }
      return obs, reward, terminated, truncated, infos

  first_seed = seed
  return GymnasiumVector()


def _shaped(actions, space) -> np.ndarray:
  actions = np.asarray(actions, np.float32)
  if actions.shape != space.shape:
    raise UserError(f"actions must have shape {space.shape}; got {actions.shape}")
  return actions
