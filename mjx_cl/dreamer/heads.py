"""Encoder, decoder and the four heads. Features of a state: [deter, stoch], for the decoder [stoch,
deter].

`pre` in place of the features: the output of the first linear layer, where the caller has it
already (behaviour.py).
"""

from __future__ import annotations

import flax.linen as nn
import jax

from mjx_cl.dreamer.nets import MLP, Linear, symlog


class Encoder(nn.Module):
  """symlog, then 3 hidden layers: observation (..., obs) -> tokens (..., units)."""

  units: int

  @nn.compact
  def __call__(self, obs: jax.Array) -> jax.Array:
    """Tokens of an observation, from symlog(obs)."""
    return MLP(3, self.units, name="mlp")(symlog(obs))


class Decoder(nn.Module):
  """Mean of the observation in symlog space, (..., obs)."""

  units: int
  obs: int

  @nn.compact
  def __call__(self, deter: jax.Array, stoch: jax.Array) -> jax.Array:
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
  def __call__(self, *features: jax.Array, pre: jax.Array | None = None) -> jax.Array:
    """Output of the head; `pre`: what its first layer gives, where that is known already."""
    return Linear(self.out, self.outscale, name="out")(
      MLP(self.layers, self.units, name="mlp")(*features, pre=pre)
    )


class PolicyHead(nn.Module):
  """3 hidden layers, two separate outputs: raw means and raw deviations, each (..., act)."""

  units: int
  act: int

  @nn.compact
  def __call__(
    self, *features: jax.Array, pre: jax.Array | None = None
  ) -> tuple[jax.Array, jax.Array]:
    """Mean and deviation before they are bounded, (..., act) each; `pre` as of the other heads."""
    x = MLP(3, self.units, name="mlp")(*features, pre=pre)
    return Linear(self.act, 0.01, name="mean")(x), Linear(self.act, 0.01, name="std")(x)
