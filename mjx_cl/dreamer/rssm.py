"""Recurrent state-space model: block GRU core, categorical latents with straight-through gradients.

State of one robot: deter (D,) and stoch (stoch, classes), one-hot rows, both zero at an episode's
start.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float

from mjx_cl.config.sizes import Size
from mjx_cl.dreamer.nets import MLP, Hidden, Linear, kernel_init, mean_square, parameter
from mjx_cl.types import Array

UNIMIX = 0.01


def dense_part(
  kernel: Float[Array, "blocks inputs width"], own: int
) -> Float[Array, "inputs-{own} blocks*width"]:
  """The rows of a block kernel that meet the shared inputs, as one matrix (shared, blocks out)."""
  return kernel[:, own:].transpose(1, 0, 2).reshape(kernel.shape[1] - own, -1)


def hoist(params: dict) -> dict:
  """Variables of an `RSSM` with the re-arranged kernel beside the parameters: a scan over the core
  then does not re-arrange it every step.
  """
  core = params["core_hidden"]
  own = core["bias"].size // core["kernel"].shape[0]
  dense = dense_part(core["kernel"], own)
  return {"params": params, "hoisted": {"core_hidden": {"dense": dense}}}


class BlockLinear(nn.Module):
  """Block-diagonal linear layer on (blocks, rows, in), plus inputs shared by all blocks (rows,
  shared).

  kernel (blocks, in + shared, out): block g sees [own chunk, shared]. The shared part is one dense
  product. fan_in of the initialiser is the width of the whole concatenated input, blocks (in +
  shared), as in the authors' code.
  """

  units: int  # outputs per block

  @nn.compact
  def __call__(self, x: Array, shared: Array | None = None) -> Array:
    """Each block times its own kernel, plus what all blocks share."""
    blocks, rows, own = x.shape
    extra = 0 if shared is None else shared.shape[-1]
    kernel = parameter(
      self, "kernel", kernel_init(blocks * (own + extra)), (blocks, own + extra, self.units)
    )
    bias = parameter(self, "bias", nn.initializers.zeros, (blocks * self.units,))
    y = jnp.einsum("gni,gio->gno", x, kernel[:, :own]) + bias.reshape(blocks, 1, self.units)
    if shared is not None:
      hoisted: Array | None = self.get_variable("hoisted", "dense")
      dense = dense_part(kernel, own) if hoisted is None else hoisted
      y = y + (shared @ dense).reshape(rows, blocks, self.units).transpose(1, 0, 2)
    return y


class BlockNorm(nn.Module):
  """RMSNorm over the whole concatenated vector of (blocks, rows, width)."""

  @nn.compact
  def __call__(self, x: Array) -> Array:
    """Each block over its root mean square, times the gain."""
    blocks, _, width = x.shape
    gain = parameter(self, "gain", nn.initializers.ones, (blocks * width,)).reshape(
      blocks, 1, width
    )
    return x * jax.lax.rsqrt(jnp.mean(mean_square(x), 0, keepdims=True) + 1e-4) * gain


def clip_action(action: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
  """A / sg(max(1, |a|)): outside [-1, 1] the bound, inside the identity."""
  return action / jax.lax.stop_gradient(jnp.maximum(1.0, jnp.abs(action)))


class RSSM(nn.Module):
  """Core, prior and posterior on rows: deter (N, D), stoch (N, stoch * classes), action (N, A).

  x0, x1, x2 = hidden(deter), hidden(stoch), hidden(clip(action))
  h  = silu(norm(block([chunk_g(deter), x0, x1, x2])));   r, c, u = block(h), cut per block in this
    order
  deter' = sigmoid(u - 1) tanh(sigmoid(r) c) + (1 - sigmoid(u - 1)) deter
  """

  size: Size

  def setup(self) -> None:
    """Declares the layers."""
    s = self.size
    self.in_deter, self.in_stoch = Hidden(s.hidden), Hidden(s.hidden)
    self.in_action = Hidden(s.hidden)
    self.core_hidden, self.core_norm = BlockLinear(s.deter // s.blocks), BlockNorm()
    self.core_gates = BlockLinear(3 * s.deter // s.blocks)
    self.prior_mlp, self.prior_out = MLP(2, s.hidden), Linear(s.stoch * s.classes)
    self.post_hidden, self.post_out = Hidden(s.hidden), Linear(s.stoch * s.classes)

  def __call__(
    self, deter: Array, stoch: Array, action: Array, tokens: Array
  ) -> tuple[Array, Array]:
    """One step; touches every parameter, for initialisation."""
    deter = self.core(deter, stoch, action)
    return self.prior(deter), self.posterior(deter, tokens)

  def cut(self, deter: Array) -> Array:
    """(N, D) -> (blocks, N, D / blocks), the layout in which the block-diagonal products run."""
    return deter.reshape(deter.shape[0], self.size.blocks, -1).transpose(1, 0, 2)

  def acted(self, action: Float[Array, "*lead act"]) -> Float[Array, "*lead hidden"]:
    """What the core makes of the action."""
    return self.in_action(clip_action(action))

  def core(
    self,
    deter: Float[Array, "rows deter"],
    stoch: Float[Array, "rows stoch"],
    action: Float[Array, "rows act"],
  ) -> Float[Array, "rows deter"]:
    """Deter' of one step."""
    return join(self.core_cut(self.cut(deter), deter, stoch, action))

  def core_cut(
    self,
    chunks: Float[Array, "blocks rows width"],
    deter: Float[Array, "rows blocks*width"],
    stoch: Float[Array, "rows stoch"],
    action: Float[Array, "rows act"],
  ) -> Float[Array, "blocks rows width"]:
    """The core where deter is at hand in both layouts; gives deter' as (blocks, N, D / blocks).

    A scan that carries both spares the cut, and keeps XLA from fusing the gates' tanh and sigmoid
    into the transposition that follows, where they are not vectorised.
    """
    shared = jnp.concatenate([self.in_deter(deter), self.in_stoch(stoch), self.acted(action)], -1)
    h = nn.silu(self.core_norm(self.core_hidden(chunks, shared)))
    r, c, u = jnp.split(self.core_gates(h), 3, -1)
    update = jax.nn.sigmoid(u - 1.0)
    return update * jnp.tanh(jax.nn.sigmoid(r) * c) + (1.0 - update) * chunks

  def prior(
    self, deter: Float[Array, "*lead deter"]
  ) -> Float[Array, "*lead {self.size.stoch} {self.size.classes}"]:
    """Logits of p(z | deter)."""
    return self._logits(self.prior_out(self.prior_mlp(deter)))

  def posterior(
    self, deter: Float[Array, "*lead deter"], tokens: Float[Array, "*lead units"]
  ) -> Float[Array, "*lead {self.size.stoch} {self.size.classes}"]:
    """Logits of q(z | deter, tokens), tokens from the encoder."""
    return self._logits(self.post_out(self.post_hidden(deter, tokens)))

  def _logits(self, flat: Array) -> Array:
    return flat.reshape(flat.shape[:-1] + (self.size.stoch, self.size.classes))


def join(chunks: Float[Array, "blocks rows width"]) -> Float[Array, "rows blocks*width"]:
  """(blocks, N, width) -> (N, blocks width), the inverse of `RSSM.cut`."""
  return chunks.transpose(1, 0, 2).reshape(chunks.shape[1], -1)


def probs(logits: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
  """0.99 softmax(logits) + 0.01 / classes over the last axis."""
  return (1.0 - UNIMIX) * jax.nn.softmax(logits, -1) + UNIMIX / logits.shape[-1]


def sample(
  logits: Float[Array, "*lead variables classes"], uniform: Float[Array, "*lead variables"]
) -> Float[Array, "*lead variables classes"]:
  """One-hot rows by inverse CDF of `probs` at numbers in [0, 1), straight-through gradient."""
  p = probs(logits)
  index = jnp.sum(jnp.cumsum(p, -1)[..., :-1] <= uniform[..., None], -1)
  hot = jax.nn.one_hot(index, logits.shape[-1])
  return hot + p - jax.lax.stop_gradient(p)


def entropy(logits: Float[Array, "*lead variables classes"]) -> Float[Array, ""]:
  """Mean over states of the entropy [nats] summed over the categorical variables."""
  p = probs(logits)
  return -jnp.mean(jnp.sum(p * jnp.log(p), (-2, -1)))


def kl(
  logits_q: Float[Array, "*lead variables classes"],
  logits_p: Float[Array, "*lead variables classes"],
) -> Float[Array, "*lead"]:
  """KL(q || p) [nats], summed over the categorical variables, both with the 1 % uniform mixture."""
  q, p = probs(logits_q), probs(logits_p)
  return jnp.sum(q * (jnp.log(q) - jnp.log(p)), (-2, -1))
