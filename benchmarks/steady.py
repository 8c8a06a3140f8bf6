"""The quadruped told to walk straight ahead at 0.9 m/s, as the paper's robot is driven: `mjx-cl run
benchmarks/steady.py:Steady --agent quadruped-trot`, `mjx-cl bench benchmarks/steady.toml`.
"""

from __future__ import annotations

import jax.numpy as jnp

from mjx_cl.envs.quadruped import Quadruped

PACE = 0.9  # [m/s]


class Steady(Quadruped):
  """The quadruped with one command."""

  agents_of = "quadruped"

  def __init__(self, physics: str = "auto") -> None:
    super().__init__(physics)
    self.spec = self.spec._replace(name="steady")
    command = jnp.asarray([[PACE, 0.0, 0.0]] * 2, jnp.float32)
    self.model = self.model._replace(task=self.model.task | {"command_range": command})
