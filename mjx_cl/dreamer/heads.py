"""Encoder, decoder and the four heads. Features of a state: [deter, stoch], for the decoder [stoch,
deter].
"""

from __future__ import annotations

from typing import Any

import flax.linen as nn
from jaxtyping import Float

from mjx_cl.dreamer.nets import MLP, Linear, given, symlog
from mjx_cl.types import Array

FIRST = ("mlp", "hidden0", "linear")  # where a head keeps its first layer


class Encoder(nn.Module):
  """symlog, then 3 hidden layers: observation (..., obs) -> tokens (..., units)."""

  units: int

  @nn.compact
  def __call__(self, obs: Array) -> Array:
    """Tokens of an observation, from symlog(obs)."""
    return MLP(3, self.units, name="mlp")(symlog(obs))


class Decoder(nn.Module):
  """Mean of the observation in symlog space, (..., obs)."""

  units: int
  obs: int

  @nn.compact
  def __call__(self, deter: Array, stoch: Array) -> Array:
    """Observation in symlog units, from both parts of the latent."""
    return Linear(self.obs, name="out")(MLP(3, self.units, name="mlp")(stoch, deter))


class Head(nn.Module):
  """`layers` hidden layers and one linear output: reward (1 layer, 255, outscale 0), continue (1,
  1, 1), value (3, 255, 0).
  """

  layers: int
  units: int
  out: int
  outscale: float

  @nn.compact
  def __call__(self, deter: Array, stoch: Array) -> Array:
    """Output of the head, (..., out)."""
    x = MLP(self.layers, self.units, name="mlp")(deter, stoch)
    return Linear(self.out, self.outscale, name="out")(x)


class PolicyHead(nn.Module):
  """3 hidden layers, two separate outputs: raw means and raw deviations, each (..., act)."""

  units: int
  act: int

  @nn.compact
  def __call__(self, deter: Array, stoch: Array) -> tuple[Array, Array]:
    """Mean and deviation before they are bounded, (..., act) each."""
    x = MLP(3, self.units, name="mlp")(deter, stoch)
    return Linear(self.act, 0.01, name="mean")(x), Linear(self.act, 0.01, name="std")(x)


def read(
  head: Head | PolicyHead,
  params: Any,
  deter: Float[Array, "*lead deter"],
  stoch: Float[Array, "*lead stoch"],
  first: Float[Array, "*lead units"] | None = None,
) -> Any:
  """What `head` says of states; `first`: what its first layer gives, where that is known."""
  with given({} if first is None else {FIRST: first}):
    return head.apply({"params": params}, deter, stoch)
