"""LaProp with adaptive gradient clipping, as an optax chain."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax


def agc(clip: float = 0.3, floor: float = 1e-3) -> optax.GradientTransformation:
  """Adaptive gradient clipping per parameter tensor (Brock et al. 2021, here with whole-tensor
  norms).

    limit = clip max(floor, ||theta||);   g <- g / max(1, ||g|| / limit)

  optax.adaptive_grad_clip uses unit-wise norms, which is another rule.
  """

  def update(grads: Any, state: Any, params: Any) -> tuple[Any, Any]:
    def one(g: jax.Array, p: jax.Array) -> jax.Array:
      limit = clip * jnp.maximum(floor, jnp.linalg.norm(p.reshape(-1)))
      return g / jnp.maximum(1.0, jnp.linalg.norm(g.reshape(-1)) / limit)

    return jax.tree.map(one, grads, params), state

  return optax.GradientTransformation(lambda params: optax.EmptyState(), update)


def laprop(
  lr: float,
  warmup: int,
  clip: float = 0.3,
  beta1: float = 0.9,
  beta2: float = 0.999,
  eps: float = 1e-20,
) -> optax.GradientTransformation:
  """AGC, RMS scaling, then momentum (LaProp order), then the learning rate with linear warm-up from
  0.

  nu <- beta2 nu + (1 - beta2) g^2;  u = g / (sqrt(nu / (1 - beta2^t)) + eps)
  mu <- beta1 mu + (1 - beta1) u;    theta <- theta - lr_t mu / (1 - beta1^t)
  lr_t = lr min(1, t / warmup), t from 0
  """
  schedule = optax.linear_schedule(0.0, lr, warmup) if warmup else optax.constant_schedule(lr)
  return optax.chain(
    agc(clip),
    optax.scale_by_rms(beta2, eps, eps_in_sqrt=False, bias_correction=True),
    optax.ema(beta1, debias=True),
    optax.scale_by_learning_rate(schedule),
  )
