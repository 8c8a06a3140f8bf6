"""mjx_cl: a vectorised benchmark of robots that notice a fault, adapt to it and know when they are
done.

The names of `__all__` are the library's face; each is loaded at its first use, so `import mjx_cl`
alone starts no JAX. Call `setup` first. Other modules are private unless the documentation names
them.
"""

import importlib
import sys
from typing import Any

__version__ = "1.0.0"
BENCHMARK = 1  # of suites, recordings and scores: what differs in it is not compared
__all__ = [
  "load_agent",
  "make_detector",
  "make_env",
  "make_fault",
  "register_envs",
  "run",
  "score",
  "setup",
]


def __getattr__(name: str) -> Any:
  if name not in __all__:
    raise AttributeError(f"module 'mjx_cl' has no attribute {name!r}; it has: {', '.join(__all__)}")
  # these two come before the first use of JAX, all else brings JAX with it
  early = {"setup": "mjx_cl.io.runtime", "register_envs": "mjx_cl.io.registration"}
  return getattr(importlib.import_module(early.get(name, "mjx_cl.library")), name)


def __dir__() -> list[str]:
  return sorted([*globals(), *__all__])


if "gymnasium" in sys.modules:
  __getattr__("register_envs")()
