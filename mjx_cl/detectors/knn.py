"""Distance of the latent to its nearest neighbours in the healthy robot's latents."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.detectors import multivariate
from mjx_cl.detectors.base import Alarm, Detector, Warm, above, demand, standardise
from mjx_cl.rollout.monitor import LATENT

if TYPE_CHECKING:
  from mjx_cl.rollout.monitor import Residual


class Healthy(NamedTuple):
  """What the end of the warm-up fixes.

  Attributes: weight: float32 (16,), 1 / variance of each latent dimension. mean, std: float32 (),
    of the references' own distances.
  """

  weight: jax.Array
  mean: jax.Array
  std: jax.Array


class KnnState(NamedTuple):
  """Attributes: warm: base.Warm of the latent. references: float32 (references, 16). healthy:
  Healthy. trail: many.Trail of distances (smooth, 1).
  """

  warm: Warm
  references: jax.Array
  healthy: Healthy
  trail: multivariate.Trail


def kth(squares: jax.Array, k: int) -> jax.Array:
  """k-th smallest along the last axis, equal values counted each; k passes, which take a fifth of
  the time of a sort for small k.
  """
  least = jnp.min(squares, -1)
  for _ in range(k - 1):
    enough = jnp.sum(squares <= least[..., None], -1) >= k
    least = jnp.where(
      enough, least, jnp.min(jnp.where(squares > least[..., None], squares, jnp.inf), -1)
    )
  return least


def knn(
  k: int = 5, references: int = 100, smooth: int = 100, threshold: float = 0.6, warmup: int = 1000
) -> Detector:
  """Trailing mean of the distance to the k-th nearest healthy latent.

    r_1..r_R = every (warmup // R)-th latent of the warm-up;  s = max(std of the warm-up's latents,
    1e-6), each dimension
    d_t = k-th smallest over i of |(x_t - r_i) / s|;  m, v = mean and deviation over i of the same
    distance from r_i to the other references
    score = mean over the last n = min(smooth, samples since the warm-up or the last alarm) of (d_t
    - m) / v
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
    Detector whose update takes a monitor.Residual and gives Alarm(fired: bool (), score: float32
    ()).
  Blind to: a change within the cloud of healthy latents (another order of the same states); a fall
  of the distance; what the fixed projection loses. Reference: Sun, Ming, Zhu, Li 2022, ICML, arXiv
  2204.06507; as a baseline in robots: Haider et al. 2023, AAMAS. Example: _, out =
  jax.lax.scan(det.update, det.init(), residuals)
  """
  demand(
    "knn",
    k=(k, 1 <= k < references, "at least 1 and below `references`"),
    references=(references, references <= warmup, "at most `warmup`"),
    smooth=(smooth, smooth >= 1, "at least 1"),
    threshold=(threshold, above(threshold, 0), "above 0"),
  )
  stride = warmup // references

  def init() -> KnnState:
    healthy = Healthy(jnp.ones(LATENT), jnp.float32(0), jnp.float32(1))
    return KnnState(
      Warm(jnp.int32(0), jnp.zeros(LATENT), jnp.zeros(LATENT)),
      jnp.zeros((references, LATENT)),
      healthy,
      multivariate.trail(smooth, 1),
    )

  def settle(learnt: tuple[Warm, jax.Array]) -> Healthy:
    warm, stored = learnt
    weight = 1 / jnp.square(jnp.maximum(jnp.sqrt(warm.squares / warmup), 1e-6))
    squares = jnp.square(stored[:, None] - stored) @ weight
    own = jnp.sqrt(kth(jnp.where(jnp.eye(references, dtype=bool), jnp.inf, squares), k))
    return Healthy(weight, jnp.mean(own), jnp.maximum(jnp.std(own), 1e-6))

  def update(state: KnnState, residual: Residual) -> tuple[KnnState, Alarm]:
    known = jnp.all(jnp.isfinite(residual.latent))
    x = jnp.where(known, residual.latent, 0.0)
    warm, _, ready = standardise(state.warm, x, warmup)
    warm, ready = multivariate.keep(known, warm, state.warm), ready & known
    at, learning = state.warm.count // stride, known & (state.warm.count < warmup)
    store = learning & (state.warm.count % stride == 0) & (at < references)
    at = jnp.minimum(at, references - 1)
    stored = state.references.at[at].set(jnp.where(store, x, state.references[at]))
    healthy = multivariate.once(
      learning & (warm.count == warmup), settle, (warm, stored), state.healthy
    )
    distance = jnp.sqrt(kth(jnp.square(x - stored) @ healthy.weight, k))
    held = multivariate.push(state.trail, ((distance - healthy.mean) / healthy.std)[None], ready)
    score = held.total[0] / jnp.maximum(1, jnp.minimum(held.count, smooth))
    fired = ready & (score > threshold)
    return KnnState(warm, stored, healthy, multivariate.restart(held, fired)), Alarm(
      fired, jnp.where(ready, score, jnp.nan)
    )

  return Detector(init, update)


knn.takes = "residual"  # type: ignore[attr-defined]
