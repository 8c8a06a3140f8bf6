"""Robots and their tasks. `ENVS` is the one table; `make(name)` builds one."""
from __future__ import annotations

from mjx_cl.envs.walker import Walker
from mjx_cl.errors import choose

ENVS = {"walker": Walker}


def make(name: str, physics: str = "auto"):
  """Builds environment `name` on a physics backend (`auto`, `native` or `mjx`)."""
  return choose("environment", name, ENVS)(physics=physics)
