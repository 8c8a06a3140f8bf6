"""When a fault acts: a factor in [0, 1] on its severity, as a pure function of the control step."""
from __future__ import annotations

import jax
import jax.numpy as jnp

FOREVER = 2**31 - 1  # a duration that no run outlasts


def abrupt(t: jax.Array, onset: jax.Array, duration: jax.Array) -> jax.Array:
  """1 for onset <= t < onset + duration, else 0, float32 (). `onset`, `duration` in control steps; FOREVER is never repaired."""
  return ((t >= onset) & (t - onset < duration)).astype(jnp.float32)
