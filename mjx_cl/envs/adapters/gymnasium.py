"""One robot as a `gymnasium.Env`, robots side by side as a `gymnasium.vector.VectorEnv`; see
`gymnasium_env` and `gymnasium_vector`. Importing this needs gymnasium, which comes to `make` and
`make_vec` by io.registration.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector.utils import batch_space

from mjx_cl.envs.adapters.driven import Robots
from mjx_cl.errors import UserError
from mjx_cl.io import runtime
from mjx_cl.types import Var


class GymnasiumEnv(gymnasium.Env):
  """One robot.

  Args:
    env: name or environment.
    seed: of the first reset where that names none.
    physics: backend, where `env` is a name.
    **fault: FaultSettings.
  """

  def __init__(self, env: Any, seed: int = 0, physics: str = "auto", **fault: Any) -> None:
    self.robots, self._seed = Robots(env, physics, 1, **fault), seed
    spec = self.robots.env.spec
    self.metadata = {"render_modes": [], "render_fps": 1.0 / spec.control_s}
    self.observation_space, self.action_space = _box(spec.obs), _box(spec.act)

  def reset(
    self, *, seed: int | None = None, options: dict | None = None
  ) -> tuple[np.ndarray, dict]:
    """A new life where a seed is given (or at first), else a new episode of the same one."""
    _check_options(options)
    seed = self._seed if seed is None and self.robots.streams is None else seed
    super().reset(seed=seed)
    return (self.robots.reset() if seed is None else self.robots.begin([seed]))[0], {}

  def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
    """One control step."""
    actions = _checked(self.robots, action, self.action_space)[None]
    obs, reward, terminated, truncated, now, clock = (
      x[0] for x in self.robots.step(actions, [False])
    )
    return obs, float(reward), bool(terminated), bool(truncated), {"severity": now, "t": clock}


class GymnasiumVector(gymnasium.vector.VectorEnv):
  """Robots side by side.

  Args:
    env: name or environment.
    num_envs: robots.
    seed: of the first reset where that names none.
    physics: backend, where `env` is a name.
    **fault: FaultSettings.
  """

  def __init__(
    self, env: Any, num_envs: int = 1, seed: int = 0, physics: str = "auto", **fault: Any
  ) -> None:
    if num_envs < 1:
      raise UserError(f"num_envs must be above 0; got {num_envs}")
    self.robots, self.num_envs, self._seed = Robots(env, physics, num_envs, **fault), num_envs, seed
    spec = self.robots.env.spec
    self.metadata = {
      "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP,
      "render_modes": [],
      "render_fps": 1.0 / spec.control_s,
    }
    self.single_observation_space, self.single_action_space = _box(spec.obs), _box(spec.act)
    self.observation_space, self.action_space = (
      batch_space(space, num_envs)
      for space in (self.single_observation_space, self.single_action_space)
    )
    self._pending = np.zeros(num_envs, bool)

  def reset(
    self, *, seed: int | Sequence[int] | None = None, options: dict | None = None
  ) -> tuple[np.ndarray, dict]:
    """New lives where a seed is given (or at first), else new episodes of the same ones."""
    _check_options(options)
    seed = self._seed if seed is None and self.robots.streams is None else seed
    self._pending = np.zeros(self.num_envs, bool)
    if seed is None:
      return self.robots.reset(), {}
    seeds = (
      [int(seed) + i for i in range(self.num_envs)]
      if isinstance(seed, (int, np.integer))
      else [int(s) for s in seed]
    )
    if len(seeds) != self.num_envs:
      raise UserError(
        f"give one seed, or one for each of the {self.num_envs} robots; got {len(seeds)}"
      )
    super().reset(seed=seeds[0])
    return self.robots.begin(seeds), {}

  def step(
    self, actions: np.ndarray
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
    """One control step of every robot but those whose episode ended in the last one."""
    actions, moved = _checked(self.robots, actions, self.action_space), ~self._pending
    obs, reward, terminated, truncated, now, clock = self.robots.step(actions, self._pending)
    self._pending = terminated | truncated
    infos = {
      "severity": now,
      "_severity": moved,
      "t": np.where(moved, clock, 0),
      "_t": moved.copy(),
    }
    return obs, reward, terminated, truncated, infos


def make(render_mode: str | None = None, **settings: Any) -> GymnasiumEnv:
  """What `gymnasium.make("mjx_cl/...")` calls; settings: of GymnasiumEnv."""
  _unseen(render_mode)
  runtime.setup()
  return GymnasiumEnv(**settings)


def make_vec(render_mode: str | None = None, **settings: Any) -> GymnasiumVector:
  """What `gymnasium.make_vec("mjx_cl/...")` calls; settings: of GymnasiumVector."""
  _unseen(render_mode)
  runtime.setup()
  return GymnasiumVector(**settings)


def _unseen(render_mode: str | None) -> None:
  if render_mode is not None:
    raise UserError(f"robots are drawn by `mjx-cl render`; got render_mode={render_mode!r}")


def _box(variables: Sequence[Var]) -> Box:
  return Box(
    np.array([v.low for v in variables], np.float32),
    np.array([v.high for v in variables], np.float32),
    dtype=np.float32,
  )


def _check_options(options: dict | None) -> None:
  if options:
    raise UserError(f"reset takes no options; got {', '.join(map(str, options))}")


def _checked(robots: Robots, actions: np.ndarray, space: gymnasium.Space) -> np.ndarray:
  if robots.streams is None:
    raise gymnasium.error.ResetNeeded("call reset before the first step")
  actions = np.asarray(actions, np.float32)
  if actions.shape != space.shape:
    raise UserError(f"actions must have shape {space.shape}; got {actions.shape}")
  return actions
