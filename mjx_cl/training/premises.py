"""What a training stands on: demonstrator, eased reward, faults and scales of a robot; and what is
refused before it begins.
"""

import copy
import dataclasses
import json
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import faults
from mjx_cl.config import CHUNK, DreamerConfig, TrainConfig
from mjx_cl.errors import FileError, UserError
from mjx_cl.faults import presets
from mjx_cl.rollout.scan import Stream
from mjx_cl.training import agents, demonstrator


def expert(env: Any, name: str) -> Callable[[Stream], jax.Array]:
  """A demonstrator, Stream -> action: `reference`, the environment's own driver that knows its
  state, or a policy's .npz of as many observations and actions.

  A policy sees the observation without its noise where the robot can give it (`noiseless`): labels
  then follow from what a latent can know.
  """
  if name == "reference":
    if not hasattr(env, "reference"):
      raise UserError(
        f"robot {env.spec.name!r} has no reference driver; give a policy's .npz or `ppo`"
      )
    return lambda stream: env.reference(stream.env)
  policy = demonstrator.load(name)
  sizes, has = (len(env.spec.obs), len(env.spec.act)), policy.sizes
  if has != sizes:
    raise FileError(
      f"demonstrator {name} takes {has[0]} observations and gives {has[1]} actions; robot "
      f"{env.spec.name!r} has {sizes[0]} and {sizes[1]}"
    )
  if hasattr(env, "noiseless"):
    return lambda stream: policy(env.noiseless(env.model, stream.env))
  return lambda stream: policy(stream.obs)


def eased(env: Any, factor: float) -> Any:
  """The environment with its reward's negative weights times `factor`; itself for 1."""
  if factor == 1.0:
    return env
  weights = env.model.task.get("reward_weights")
  if weights is None or not (np.asarray(weights) < 0).any():
    raise UserError(f"penalties: the reward of robot {env.spec.name!r} has no negative weights")
  env = copy.copy(env)
  env.model = env.model._replace(
    task=env.model.task | {"reward_weights": jnp.where(weights < 0, weights * factor, weights)}
  )
  return env


def shaped(env: Any, weight: float) -> Any:
  """The environment whose reward has `weight` times `env.shaping(before, after)` added; itself for
  0.
  """
  if weight == 0.0:
    return env
  if not hasattr(env, "shaping"):
    raise UserError(f"shaping: robot {env.spec.name!r} has no shaping terms")
  env = copy.copy(env)
  plain = env.step

  def step(model: Any, state: Any, action: jax.Array) -> Any:
    after, out = plain(model, state, action)
    return after, out._replace(reward=out.reward + weight * env.shaping(state, after))

  env.step = step
  return env


def faults_of(
  env: Any, config: TrainConfig
) -> tuple[faults.Fault | tuple[faults.Fault, ...], faults.Plan | None, jax.Array | int]:
  """(Fault or tuple of them, their Plan, targets) of a training: of a preset its own; of a fault no
  Plan and -1, since both are drawn.

  Raises:
    UserError: what is unknown, belongs to another robot, or turns the robot into another one.
  """
  if config.fault is None and config.severity != 1.0:
    raise UserError("severity is of a fault; give --set fault=NAME too, or leave severity out")
  if config.fault is None or not presets.named(config.fault):
    names = presets.joined(config.fault or "none")
    return tuple(faults.make(name, env) for name in names), None, -1
  if config.severity != 1.0:
    raise UserError(f"preset {config.fault!r} brings its own severity; leave severity out")
  changes = presets.resolve(env.spec.name, config.fault)
  if presets.find(config.fault, env.spec.name).becomes:
    raise UserError(
      f"preset {config.fault!r} turns the robot into another one, which only `mjx-cl run` "
      "does; train that one itself"
    )
  return faults.build(changes, env)


def scaled(env: Any, dreamer: DreamerConfig) -> DreamerConfig:
  """`dreamer` with the robot's own deviations in the place of obs_scale `spec`."""
  if dreamer.obs_scale != "spec":
    return dreamer
  return dataclasses.replace(dreamer, obs_scale=tuple(float(v.scale) for v in env.spec.obs))


def check(
  env: Any, dreamer: DreamerConfig, config: TrainConfig, agent_name: str | None = None
) -> None:
  """Refuses actions whose bounds are not -1 and 1, a replay that can never hold one update's
  windows, and an agent that sees or acts otherwise than this training would have it.

  Raises:
    UserError: one line.
  """
  for var in env.spec.act:
    if (var.low, var.high) != (-1, 1):
      raise UserError(
        f"action {var.name!r} of robot {env.spec.name!r} has bounds {var.low:g} and "
        f"{var.high:g}; the policy acts in -1 to 1: declare these bounds "
        f"(Var(..., -1, 1)) and scale in the environment's `step`"
      )
  least = max(2 * CHUNK, dreamer.length + -(-dreamer.batch * dreamer.length // config.envs))
  if config.capacity < least:
    raise UserError(
      f"capacity={config.capacity} records of each of {config.envs} robots never hold the "
      f"{dreamer.batch} x {dreamer.length} steps of an update; capacity={least} would"
    )
  if agent_name:
    _check_agent(env, dreamer, config, agent_name)


def _check_agent(env: Any, dreamer: DreamerConfig, config: TrainConfig, name: str) -> None:
  """Size, bins and obs_scale decide what weights mean, repeat what an action does; what else
  differs a training may change.
  """
  trained = agents.of(env, name)
  has, wanted = (
    {"size": c.size, "bins": c.bins, "obs_scale": scaled(env, c).obs_scale, "repeat": repeat}
    for c, repeat in (
      (trained.agent.config, trained.repeat),
      (dreamer, config.repeat),
    )
  )
  spec = scaled(env, dataclasses.replace(dreamer, obs_scale="spec")).obs_scale
  say = lambda x: "spec" if x == spec else x if isinstance(x, str) else json.dumps(x)
  for key, value in has.items():
    if value != wanted[key]:
      raise UserError(
        f"agent {name!r} has {key} {say(value)}, this training {say(wanted[key])}; "
        f"--set {key}={say(value)} goes on with its own"
      )
