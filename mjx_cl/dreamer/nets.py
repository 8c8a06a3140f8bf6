"""Layers of DreamerV3 as flax modules, and the two output distributions.

Linear layers always have a bias (initially 0). Kernels: standard normal truncated to [-2, 2], times
1.1368 sqrt(1 / fan_in), so that the deviation is sqrt(1 / fan_in), times `outscale`. A hidden layer
is Linear -> RMSNorm -> SiLU.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import Any

import flax
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from mjx_cl.types import Array


def symlog(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
  """sign(x) ln(1 + |x|), elementwise."""
  return jnp.sign(x) * jnp.log1p(jnp.abs(x))


def symexp(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
  """sign(x) (exp|x| - 1), the inverse of `symlog`."""
  return jnp.sign(x) * jnp.expm1(jnp.abs(x))


def in_a_row(draw: Callable, key: PRNGKeyArray, shape: tuple[int, ...]) -> Float[Array, "..."]:
  """`draw(key, shape)`, the same numbers, drawn as one row: loops over short axes are unrolled,
  which LLVM is slow to compile.
  """
  return draw(key, (math.prod(shape),)).reshape(shape)


def kernel_init(fan_in: int, outscale: float = 1.0) -> Callable:
  """Initialiser with the deviation outscale sqrt(1 / fan_in); outscale 0 gives exact zeros."""

  def init(key: Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
    if outscale == 0.0:
      return jnp.zeros(shape, dtype)
    scale = 1.1368 * outscale * np.sqrt(1.0 / fan_in)
    return scale * jax.random.truncated_normal(key, -2.0, 2.0, shape, dtype)

  return init


def parameter(module: nn.Module, name: str, init: Callable, shape: tuple[int, ...]) -> Array:
  """`module.param(name, init, shape)`. Flax traces the initialiser at every use, to compare shapes;
  here they are compared as they are.
  """
  if not module.has_variable("params", name):
    return module.param(name, init, shape)
  value: Array = module.get_variable("params", name)
  if value.shape != shape:
    path = module.scope.path_text  # type: ignore[union-attr]
    raise flax.errors.ScopeParamShapeError(name, path, shape, value.shape)
  return value


def outer(x: Float[Array, "*lead inputs"], y: Float[Array, "*lead units"]) -> Array:
  """Sum over rows of x y^T, (inputs, units). The narrower one goes first: the other way round, a
  CPU takes twice the time, and the barrier keeps XLA from turning it.
  """
  x, y = x.reshape(-1, x.shape[-1]), y.reshape(-1, y.shape[-1])
  return x.T @ y if x.shape[1] <= y.shape[1] else jax.lax.optimization_barrier(y.T @ x).T


@jax.custom_vjp
def product(
  x: Float[Array, "*lead inputs"], kernel: Float[Array, "inputs units"]
) -> Float[Array, "*lead units"]:
  """The product x W, with the kernel's gradient by `outer`."""
  return x @ kernel


product.defvjp(
  lambda x, kernel: (x @ kernel, (x, kernel)), lambda kept, y: (y @ kept[1].T, outer(kept[0], y))
)


class Linear(nn.Module):
  """y = x W + b over the last axis. `split` inputs, given as a tuple, are multiplied one by one and
  added: the product of their concatenation, without building it.
  """

  units: int
  outscale: float = 1.0

  @nn.compact
  def __call__(self, *xs: Array) -> Array:
    """Kernel times the inputs side by side, plus bias."""
    fan_in = sum(x.shape[-1] for x in xs)
    kernel = parameter(self, "kernel", kernel_init(fan_in, self.outscale), (fan_in, self.units))
    bias = parameter(self, "bias", nn.initializers.zeros, (self.units,))
    start, y = 0, bias
    for x in xs:
      y = y + product(x, kernel[start : start + x.shape[-1]])
      start += x.shape[-1]
    return y


def mean_square(x: Float[Array, "*lead width"]) -> Float[Array, "*lead 1"]:
  """Mean of x^2 over the last axis, kept as an axis of 1. As a product with ones: XLA's CPU backend
  does not vectorise a reduction over the last axis that it has fused with the square.
  """
  return jnp.square(x) @ jnp.full((x.shape[-1], 1), 1.0 / x.shape[-1], x.dtype)


class Norm(nn.Module):
  """RMSNorm over the last axis: x g / sqrt(mean(x^2) + 1e-4), g initially 1."""

  @nn.compact
  def __call__(self, x: Array) -> Array:
    """The input over its root mean square, times the gain."""
    gain = parameter(self, "gain", nn.initializers.ones, (x.shape[-1],))
    return x * jax.lax.rsqrt(mean_square(x) + 1e-4) * gain


def instead(layers: dict[tuple[str, ...], Callable]) -> contextlib.AbstractContextManager:
  """Within it `layers[its path in the module that is applied]` takes the place of a layer; it is
  called with the layer's own method and the inputs.
  """

  def layer(method: Callable, xs: Any, kwargs: Any, context: Any) -> Any:
    other = layers.get(context.module.path)
    return method(*xs, **kwargs) if other is None else other(method, *xs)

  return nn.intercept_methods(layer)


def given(outputs: dict[tuple[str, ...], Array]) -> contextlib.AbstractContextManager:
  """Within it a linear layer gives `outputs[its path in the module that is applied]`, where a
  caller has that already, in place of its product.
  """
  return instead({path: lambda *_, y=y: y for path, y in outputs.items()})


class Hidden(nn.Module):
  """Linear -> RMSNorm -> SiLU."""

  units: int

  @nn.compact
  def __call__(self, *xs: Array) -> Array:
    """silu(norm(linear(inputs)))."""
    return nn.silu(Norm(name="norm")(Linear(self.units, name="linear")(*xs)))


class MLP(nn.Module):
  """`layers` hidden layers of width `units`; several inputs are concatenated."""

  layers: int
  units: int

  @nn.compact
  def __call__(self, *xs: Array) -> Array:
    """Hidden layers one after another."""
    for i in range(self.layers):
      xs = (Hidden(self.units, name=f"hidden{i}")(*xs),)
    return xs[0]


# ---- two-hot -------------------------------------------------------------------------------------


def two_hot_bins(num: int = 255) -> Float[np.ndarray, "{num}"]:
  """Bin centres, float32 (num,), num odd: symexp of an even grid on [-20, 20], mirrored so that
  pairs are exact opposites.
  """
  half = np.linspace(-20, 0, (num - 1) // 2 + 1, dtype=np.float32)
  half = (np.sign(half) * np.expm1(np.abs(half))).astype(np.float32)
  return np.concatenate([half, -half[:-1][::-1]])


def two_hot_loss(
  logits: Float[Array, "*lead bins"], x: Float[Array, "*lead"], bins: Float[Array, "bins"]
) -> Float[Array, "*lead"]:
  """Cross-entropy [nats] of logits against the two-hot of x: weight on the two neighbouring bins,
  linear in raw distance, ends clipped.

  Only the two weighted entries of log-softmax are read; the target is never built.
  """
  x = jax.lax.stop_gradient(x)
  below = jnp.clip(jnp.searchsorted(bins, x, side="right") - 1, 0, len(bins) - 2)
  low, high = bins[below], bins[below + 1]
  weight = jnp.clip((x - low) / (high - low), 0.0, 1.0)
  pair = jnp.take_along_axis(logits, jnp.stack([below, below + 1], -1), -1)
  return jax.nn.logsumexp(logits, -1) - (1 - weight) * pair[..., 0] - weight * pair[..., 1]


def two_hot_mean(
  logits: Float[Array, "*lead bins"], bins: Float[Array, "bins"]
) -> Float[Array, "*lead"]:
  """Expectation of logits, summed in opposite pairs so that equal logits give exactly 0."""
  probs = jax.nn.softmax(logits, -1)
  middle = len(bins) // 2
  upper = probs[..., middle + 1 :] - probs[..., :middle][..., ::-1]
  return jnp.sum(upper * bins[middle + 1 :], -1)


# ---- the policy's normal -------------------------------------------------------------------------


def normal(
  mean_raw: Float[Array, "*lead act"],
  std_raw: Float[Array, "*lead act"],
  least: float = 0.1,
  most: float = 1.0,
) -> tuple[Float[Array, "*lead act"], Float[Array, "*lead act"]]:
  """Mean tanh(m) and deviation least + (most - least) sigmoid(s + 2). Samples are neither squashed
  nor clipped.
  """
  return jnp.tanh(mean_raw), least + (most - least) * jax.nn.sigmoid(std_raw + 2.0)


def normal_logp(
  mean: Float[Array, "*lead act"], std: Float[Array, "*lead act"], x: Float[Array, "*lead act"]
) -> Float[Array, "*lead"]:
  """Log-density of x, summed over action dimensions."""
  return jnp.sum(-0.5 * jnp.square((x - mean) / std) - jnp.log(std) - 0.5 * np.log(2 * np.pi), -1)


def normal_entropy(std: Float[Array, "*lead act"]) -> Float[Array, "*lead"]:
  """Differential entropy [nats], summed over action dimensions."""
  return jnp.sum(jnp.log(std) + 0.5 * np.log(2 * np.pi * np.e), -1)
