"""Whether a signal has settled: neither trend nor excess fluctuation over the last chunks."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from mjx_cl.config import AdaptConfig

SIGNALS = ("opr", "rpr", "reward", "dyn_loss", "adv_mag", "value_loss")


def settled(
  ring: jax.Array,
  count: jax.Array,
  nominal_mean: jax.Array,
  nominal_std: jax.Array,
  config: AdaptConfig,
) -> jax.Array:
  """Which signals show neither trend nor excess fluctuation over the ring.

    level      = median of the ring
    trend      : |median(second half) - median(first half)| <= trend level
    fluctuation: (upper - lower quartile) / 1.349 <= max(fluctuation level, excess nominal_std)
    OPR, RPR   : also settled while level <= near nominal_mean

  Medians and quartiles, because a chunk that holds a stumble or an episode's start is many times
  the others.

  Args:
    ring: float32 (patience, 6), one row per chunk in any rotation, SIGNALS along the last axis; nan
      rows are left out.
    count: int32 (), rows ever written; fewer than `patience` means not settled.
    nominal_mean: float32 (6,).
    nominal_std: float32 (6,).
    config: levels of the rule.

  Returns:
    bool (6,).
  """
  size = ring.shape[0]
  order = jnp.arange(size)
  ring = ring[(count + order) % size]  # oldest first
  half = size // 2
  level = jnp.nanmedian(ring, 0)
  trend = jnp.abs(jnp.nanmedian(ring[half:], 0) - jnp.nanmedian(ring[:half], 0))
  scale = jnp.abs(level)
  spread = jnp.nanquantile(ring, 0.75, axis=0) - jnp.nanquantile(ring, 0.25, axis=0)
  calm = spread / 1.349 <= jnp.maximum(config.fluctuation * scale, config.excess * nominal_std)
  steady = (trend <= config.trend * scale) & calm
  residual = jnp.arange(len(SIGNALS)) < 2
  return (steady | (residual & (level <= config.near * nominal_mean))) & (count >= size)
