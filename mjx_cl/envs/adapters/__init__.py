"""Our environments as other libraries know them: `brax.envs.Env`, `gymnasium.Env`,
`gymnasium.vector.VectorEnv`. May import the rollout and what lies below it.

Faults come in through `join` alone, which hands over the parts of the rollout: a fault acts here
exactly as in `mjx-cl run`, and robot i of seed s is the robot that seed s + i of `run` has, its
later episodes included. Each library is an optional extra: `brax.py` and `gymnasium.py` are
imported by the first call that needs them.
"""

from __future__ import annotations

import types
from typing import TYPE_CHECKING, Any

from mjx_cl.envs.adapters.driven import FaultSettings, Puppet, Robots, join, worst
from mjx_cl.io import plugins

if TYPE_CHECKING:
  from mjx_cl.envs.adapters.brax import BraxEnv
  from mjx_cl.envs.adapters.gymnasium import GymnasiumEnv, GymnasiumVector

__all__ = [
  "FaultSettings",
  "Puppet",
  "Robots",
  "brax_env",
  "brax_module",
  "gymnasium_env",
  "gymnasium_vector",
  "join",
  "worst",
]


def brax_module(name: str) -> types.ModuleType:
  """Brax's module of that name.

  Raises:
    UserError where brax is not installed.
  """
  return plugins.optional("brax", "brax", f"brax.{name}")


def brax_env(env: Any, fault: str | None = None, **settings: Any) -> BraxEnv:
  """Our environment as a `brax.envs.Env`, nominal unless a fault or a preset is named, with
  `settings` as in FaultSettings.

  brax's own wrappers do the vmap, the time limit and the autoreset; its autoreset restarts every
  robot from its own first state. They leave `info` alone, which is where the fault and its clock
  live: a reset touches neither.
  """
  return plugins.optional("brax", "brax", f"{__name__}.brax").BraxEnv(env, fault, **settings)


def _gymnasium() -> types.ModuleType:
  return plugins.optional("'mjx-cl[gymnasium]'", "gymnasium", f"{__name__}.gymnasium")


def gymnasium_env(env: Any, seed: int = 0, physics: str = "auto", **fault: Any) -> GymnasiumEnv:
  """One robot as a `gymnasium.Env`; arguments and the meaning of a reset as in
  `gymnasium_vector`.
  """
  return _gymnasium().GymnasiumEnv(env, seed, physics, **fault)


def gymnasium_vector(
  env: Any, num_envs: int = 1, seed: int = 0, physics: str = "auto", **fault: Any
) -> GymnasiumVector:
  """Robots side by side as a `gymnasium.vector.VectorEnv` with autoreset in the next step.

  After a step with `terminations` or `truncations`, `obs` is the last observation of that episode;
  the next call ignores the robot's action, gives the first observation of a new one, reward 0 and
  neither end, and is no control step: the fault clock stands still. reset(seed=s) begins new lives,
  robot i from seed s + i (or from a list of seeds). reset() without a seed starts a new episode of
  the same robots; fault and fault clock go on. The spaces are the spec's: a faulty sensor may leave
  its bounds. infos hold the true fault for logs, which no agent should see: `severity` in force in
  this step and its clock `t`, each with gymnasium's mask of the robots that made a control step.
  A deep copy and a pickle go on from where the robots are; to be pickled the environment is given
  by name.

  Args:
    env: name or environment.
    num_envs: robots.
    seed: of the first reset where that names none.
    physics: backend, where `env` is a name.
    **fault: FaultSettings.

  Example:
    robots = gymnasium_vector("walker", 8, fault="gear", severity=0.5, onset=5000)
    obs, infos = robots.reset(seed=0)
  """
  return _gymnasium().GymnasiumVector(env, num_envs, seed, physics, **fault)
