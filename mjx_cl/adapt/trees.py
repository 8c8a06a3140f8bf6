"""Trees of arrays that lead with streams, or with none."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp


def choose(where: jax.Array, a: Any, b: Any) -> Any:
  """The leaves of `a` where `where`, () or (groups,), else those of `b`."""
  wide = lambda like: where.reshape(where.shape + (1,) * (like.ndim - where.ndim))
  return jax.tree.map(lambda x, y: jnp.where(wide(x), x, y), a, b)


def take(tree: Any, g: jax.Array) -> Any:
  """Entry g of every leaf."""
  return jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, g, keepdims=False), tree)


def put(tree: Any, g: jax.Array, value: Any) -> Any:
  """`tree` with `value` as entry g of every leaf."""
  return jax.tree.map(lambda x, v: jax.lax.dynamic_update_index_in_dim(x, v, g, 0), tree, value)
