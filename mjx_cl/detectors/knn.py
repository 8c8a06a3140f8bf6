"""Distance of the latent to its nearest neighbours in the healthy robot's latents."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Float

from mjx_cl.detectors.base import (
  Alarm,
  Detector,
  Setting,
  Warm,
  above,
  cold,
  demand,
  judged,
  keep,
  standardise,
  whole,
)
from mjx_cl.detectors.multivariate import Trail, once, push, restart, trail
from mjx_cl.rollout.monitor import LATENT, Residual
from mjx_cl.types import Array

Latents = Float[Array, "references latent"]


class Healthy(NamedTuple):
  """What the end of the warm-up fixes.

  Attributes:
    weight: float32 (16,), 1 / variance of each latent dimension.
    mean: float32 (), of the references' own distances.
    std: float32 (), of the same.
  """

  weight: Array
  mean: Array
  std: Array


class KnnState(NamedTuple):
  """What the detector remembers.

  Attributes:
    warm: of the latent.
    references: float32 (references, 16).
    healthy: how far they lie apart.
    trail: of distances (smooth, 1).
  """

  warm: Warm
  references: Array
  healthy: Healthy
  trail: Trail


def kth(squares: Float[Array, "*rows references"], k: int) -> Float[Array, "*rows"]:
  """k-th smallest along the last axis, equal values counted each; k passes, faster than a sort for
  small k.
  """
  least = jnp.min(squares, -1)
  for _ in range(k - 1):
    enough = jnp.sum(squares <= least[..., None], -1) >= k
    least = jnp.where(
      enough, least, jnp.min(jnp.where(squares > least[..., None], squares, jnp.inf), -1)
    )
  return least


def settled(warm: Warm, stored: Latents, warmup: int, k: int) -> Healthy:
  """How far the references of the warm-up lie apart, in its deviations."""
  weight = 1 / jnp.square(jnp.maximum(jnp.sqrt(warm.squares / warmup), 1e-6))
  squares = jnp.square(stored[:, None] - stored) @ weight
  own = jnp.sqrt(kth(jnp.where(jnp.eye(len(stored), dtype=bool), jnp.inf, squares), k))
  return Healthy(weight, jnp.mean(own), jnp.maximum(jnp.std(own), 1e-6))


@whole
def knn(
  k: int = 5, references: int = 100, smooth: int = 100, threshold: Setting = 0.6, warmup: int = 1000
) -> Detector:
  """Trailing mean of the distance to the k-th nearest healthy latent.

    r_1..r_R = every (warmup // R)-th latent of the warm-up;  s = max(std of the warm-up's latents,
    1e-6), each dimension
    d_t = k-th smallest over i of |(x_t - r_i) / s|;  m, v = mean and deviation over i of the same
    distance from r_i to the other references
    score = mean of the last n = min(smooth, samples since warm-up or alarm) values of (d_t - m) / v
    fired = score > threshold; then the trailing mean starts from nothing, while references, s, m
    and v are kept

  References follow each other within one warm-up, so their own distances are a little short and a
  healthy score lies somewhat above 0. Not divided by the deviation of a trailing mean: calibrate.
  The default threshold has an ARL0 of about 25,000 samples on independent Gaussian latents.

  Args:
    k: neighbour that counts.
    references: latents stored, above k, at most `warmup`.
    smooth: samples of the trailing mean [control steps].
    threshold: decision level [deviations of a single healthy distance].
    warmup: samples that give the references; nothing fires before they end.

  Returns:
    Detector over monitor.Residual.
  Blind to: a change within the cloud of healthy latents (another order of the same states); a fall
  of the distance; what the fixed projection loses. Reference: Sun, Ming, Zhu, Li 2022, ICML, arXiv
  2204.06507; as a baseline in robots: Haider et al. 2023, AAMAS.
  """
  demand(
    "knn",
    k=(k, 1 <= k < references, "at least 1 and below `references`"),
    references=(references, references <= warmup, "at most `warmup`"),
    smooth=(smooth, smooth >= 1, "at least 1"),
    threshold=(threshold, above(threshold, 0), "above 0"),
  )
  stride = warmup // references
  settle = lambda learnt: settled(learnt[0], learnt[1], warmup, k)

  def init() -> KnnState:
    healthy = Healthy(jnp.ones(LATENT), jnp.float32(0), jnp.float32(1))
    return KnnState(cold(LATENT), jnp.zeros((references, LATENT)), healthy, trail(smooth, 1))

  def update(state: KnnState, residual: Residual) -> tuple[KnnState, Alarm]:
    known = jnp.all(jnp.isfinite(residual.latent))
    x = jnp.where(known, residual.latent, 0.0)
    warm, _, ready = standardise(state.warm, x, warmup)
    warm, ready = keep(known, warm, state.warm), ready & known
    at, learning = state.warm.seen // stride, known & (state.warm.seen < warmup)
    store = learning & (state.warm.seen % stride == 0) & (at < references)
    at = jnp.minimum(at, references - 1)
    stored = state.references.at[at].set(jnp.where(store, x, state.references[at]))
    healthy = once(learning & (warm.seen == warmup), settle, (warm, stored), state.healthy)
    distance = jnp.sqrt(kth(jnp.square(x - stored) @ healthy.weight, k))
    held = push(state.trail, ((distance - healthy.mean) / healthy.std)[None], ready)
    alarm = judged(held.total[0] / held.size(), ready, threshold)
    return KnnState(warm, stored, healthy, restart(held, alarm.fired)), alarm

  return Detector(init, update)
