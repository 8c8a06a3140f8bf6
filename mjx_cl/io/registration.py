"""Our robots under gymnasium's names, `gymnasium.make("mjx_cl/Walker-v0", fault="gear")` and
`gymnasium.make_vec`. JAX comes with the first robot.
"""

import importlib
from typing import Any

from mjx_cl.io import runtime

# name -> robot; v0 becomes v1 where rewards, observations or episodes of a robot change
ROBOTS = {
  "Walker-v0": "walker",
  "Quadruped-v0": "quadruped",
  "Car-v0": "car",
  "CarReal-v0": "car_real",
}
ADAPTERS = "mjx_cl.envs.adapters.gymnasium"


def register_envs() -> None:
  """Tells gymnasium the names. `import mjx_cl` does so where gymnasium is imported already."""
  from gymnasium.envs import registration

  for name, robot in ROBOTS.items():
    if f"mjx_cl/{name}" in registration.registry:  # a second time gymnasium warns
      continue
    registration.register(
      id=f"mjx_cl/{name}",
      entry_point=f"{__name__}:make",
      vector_entry_point=f"{__name__}:make_vec",
      kwargs={"env": robot},
    )


def make(**settings: Any) -> Any:
  """A robot as a `gymnasium.Env`, see the adapter's `make`."""
  runtime.quiet()  # before JAX
  return importlib.import_module(ADAPTERS).make(**settings)


def make_vec(**settings: Any) -> Any:
  """Robots as a `gymnasium.vector.VectorEnv`, see the adapter's `make_vec`."""
  runtime.quiet()
  return importlib.import_module(ADAPTERS).make_vec(**settings)
