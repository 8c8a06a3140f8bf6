"""Drop of the reward over whole blocks, with a false-alarm probability from a bootstrap over
blocks.

level = (1 - alpha) quantile over `repetitions` of the largest M in a run of `blocks` healthy
blocks. Each repetition draws m reference blocks, which give it a mean and a deviation of its own,
and then a run, both from the smoothed and variance-preserving bootstrap

  mean + (b_J - mean + g e) / sqrt(1 + g^2 / std^2),  g = 2.1 std m^(-1/5),  J uniform, e standard
  Gaussian

since no draw from 20 blocks alone goes below the smallest of them, so that a level from such draws
is crossed twice as often as stated; twice Silverman's width, since it keeps the statement for
Gaussian blocks where once does not. So threshold = 1 means: an alarm within `blocks` blocks has
probability `alpha`, if blocks are independent and the smoothed blocks are like the true ones; other
thresholds are calibrated. A tail downwards that the reference blocks do not show breaks it. The
draws are fixed numbers (NumPy's default_rng(0)), the same for every stream.

Blocks stand for the paper's episodes, since streams of robots that do not fall have no episode ends
that a Residual shows. A block should be longer than the memory of the reward.
"""

import numbers
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32, Int32

from mjx_cl.detectors import multivariate
from mjx_cl.detectors.base import (
  Alarm,
  Detector,
  Number,
  Real,
  Setting,
  above,
  demand,
  judged,
  whole,
)
from mjx_cl.rollout.monitor import Residual
from mjx_cl.types import Array

Drawn = Int32[np.ndarray, "repetitions drawn"]
Noise = Float32[np.ndarray, "repetitions drawn"]


class Healthy(NamedTuple):
  """What the end of the warm-up fixes.

  Attributes:
    weights: float32 (bins,), sum 1.
    mean: float32 (), of the weighted reference blocks.
    std: float32 (), of the same.
    level: float32 (), the bootstrap's quantile.
  """

  weights: Array
  mean: Array
  std: Array
  level: Array


class BfarState(NamedTuple):
  """What the detector remembers.

  Attributes:
    seen: int32 (), samples since the start.
    step: int32 (), samples in the present block.
    bins: float32 (bins,), sums of the present block.
    references: float32 (blocks, bins), means of the warm-up's blocks.
    healthy: what they come to.
    recent: float32 (longest horizon,), the last weighted blocks, newest first.
    blocks: int32 (), blocks since the warm-up or the last alarm.
  """

  seen: Array
  step: Array
  bins: Array
  references: Array
  healthy: Healthy
  recent: Array
  blocks: Array


def draws(m: int, blocks: int, repetitions: int) -> tuple[Drawn, Noise]:
  """The numbers of the bootstrap, the same at every call: reference blocks, and standard Gaussian
  noise; m for a reference and then a run in each row.
  """
  rng, shape = np.random.default_rng(0), (repetitions, m + blocks)
  chosen = rng.integers(0, m, shape).astype(np.int32)
  return chosen, rng.standard_normal(shape).astype(np.float32)


def settled(
  references: Float[Array, "m bins"],
  chosen: Drawn,
  noise: Noise,
  horizons: tuple[int, ...],
  alpha: Real,
  shrinkage: Real,
) -> Healthy:
  """Weights, mean, deviation and level that the reference blocks give."""
  m, bins = references.shape
  centred = references - references.mean(0)
  covariance = centred.T @ centred / (m - 1)
  variance = jnp.maximum(jnp.trace(covariance) / bins, 1e-12)
  weights = jnp.linalg.solve(
    (1 - shrinkage) * covariance + shrinkage * variance * jnp.eye(bins), jnp.ones(bins)
  )
  weights = weights / weights.sum()
  b = references @ weights
  mean, std = b.mean(), jnp.maximum(b.std(ddof=1), 1e-6)
  width = 2.1 * m**-0.2
  blocks = ((b - mean) / std)[chosen]
  # in deviations of the references
  blocks = (blocks + width * noise) / np.sqrt(1 + width**2)
  own, run = blocks[:, :m], blocks[:, m:]
  own_mean = own.mean(1, keepdims=True)
  own_std = jnp.maximum(own.std(1, ddof=1, keepdims=True), 1e-6)
  sums = jnp.pad(jnp.cumsum(run, 1), ((0, 0), (1, 0)))
  largest = jnp.stack(
    [
      jnp.max(jnp.sqrt(float(h)) * (own_mean - (sums[:, h:] - sums[:, :-h]) / h) / own_std, 1)
      for h in horizons
    ]
  )
  # constant rewards have no quantile; a run of healthy blocks goes beyond 1
  level = jnp.maximum(jnp.quantile(largest.max(0), 1 - alpha), 1.0)
  return Healthy(weights, mean, std, level)


def drops(
  recent: Float[Array, "*rows longest"], mean: Number, std: Number, horizons: tuple[int, ...]
) -> Float[Array, "*rows horizons"]:
  """z_h = sqrt(h) (mean - mean of the newest h blocks) / std for each horizon; recent (..., longest
  horizon), newest first -> (..., horizons).
  """
  sums = jnp.cumsum(recent, -1)
  return jnp.stack([jnp.sqrt(float(h)) * (mean - sums[..., h - 1] / h) / std for h in horizons], -1)


@whole
def bfar(
  block: int = 50,
  bins: int = 1,
  horizons: tuple[int, ...] = (1, 5),
  threshold: Setting = 1.0,
  alpha: Real = 0.05,
  blocks: int = 50,
  warmup: int = 1000,
  repetitions: int = 1000,
  shrinkage: Real = 0.5,
) -> Detector:
  """Drop of the (weighted) mean reward over the last blocks; its level is the bootstrap's for a
  stated probability of a false alarm.

    v_j = means of block j over its `bins` equal parts;  b_j = w . v_j,  w = S^-1 1 / (1' S^-1 1)
      w = 1 for one bin
    z_h = sqrt(h) (mean - mean of the newest h blocks b) / std, mean and std over the m = warmup //
    block reference blocks
    M = max over horizons h that are filled;  score = M / level, at the end of a block, nan between
    fired = score > threshold; then blocks are counted from nothing, while the references and the
    level, of the bootstrap at the head of this file, are kept

  Args:
    block: samples of a block, a multiple of `bins` [control steps].
    bins: parts of a block that have weights of their own, the paper's test for a uniform drop; of
      use where blocks line up with episodes or strides. 1: the plain mean.
    horizons: numbers of blocks looked back on.
    threshold: decision level [bootstrap levels].
    alpha: the stated probability of a false alarm within `blocks` blocks after the warm-up.
    blocks: see `alpha`.
    warmup: samples of the reference blocks, at least 5 blocks.
    repetitions: of the bootstrap.
    shrinkage: in (0, 1], of S = (1 - shrinkage) covariance of v over reference blocks + shrinkage
      times its mean variance on the diagonal.

  Returns:
    Detector over monitor.Residual.
  Blind to: a fault that costs no reward; a rise of the reward; anything for up to `block` samples.
  Reference: Greenberg, Mannor 2021, ICML, arXiv 2010.11660, whose bootstrap draws whole reference
  episodes, without smoothing or a drawn reference.
  """
  horizons = tuple(horizons)
  whole_numbers = all(isinstance(h, numbers.Integral) for h in horizons)
  demand(
    "bfar",
    bins=(bins, bins >= 1, "at least 1"),
    block=(block, block >= 1 and block % max(1, bins) == 0, "a multiple of `bins`, above 0"),
    horizons=(
      horizons,
      whole_numbers and min(horizons, default=0) >= 1,
      "one or several whole numbers, each at least 1",
    ),
    threshold=(threshold, above(threshold, 0), "above 0"),
    alpha=(alpha, 0 < alpha < 1, "in (0, 1)"),
    blocks=(blocks, blocks >= max(horizons, default=1), "at least the longest horizon"),
    repetitions=(repetitions, repetitions >= 1, "at least 1"),
    shrinkage=(shrinkage, 0 < shrinkage <= 1, "in (0, 1]"),
    warmup=(warmup, warmup >= 5 * block, "at least 5 blocks"),
  )
  m = warmup // block
  chosen, noise = draws(m, blocks, repetitions)
  settle = lambda references: settled(references, chosen, noise, horizons, alpha, shrinkage)
  return _blocks(block, bins, horizons, threshold, m, settle)


def _blocks(
  block: int,
  bins: int,
  horizons: tuple[int, ...],
  threshold: Setting,
  m: int,
  settle: Callable[[Float[Array, "m bins"]], Healthy],
) -> Detector:
  """`bfar` once its settings are known to be good; `settle` makes the reference of m blocks."""

  def init() -> BfarState:
    healthy = Healthy(jnp.full(bins, 1.0 / bins), jnp.float32(0), jnp.float32(1), jnp.float32(1))
    references, recent = jnp.zeros((m, bins)), jnp.zeros(max(horizons))
    zero = lambda: jnp.int32(0)
    return BfarState(zero(), zero(), jnp.zeros(bins), references, healthy, recent, zero())

  def update(state: BfarState, residual: Residual) -> tuple[BfarState, Alarm]:
    known = jnp.isfinite(residual.reward)
    reward = jnp.where(known, residual.reward, 0.0)
    learning = state.seen < m * block
    part = jnp.arange(bins) == state.step // (block // bins)
    sums = state.bins + jnp.where(part, reward, 0.0)
    ended = known & (state.step + 1 == block)
    values = sums / (block // bins)
    at = jnp.minimum(state.seen // block, m - 1)
    references = state.references.at[at].set(
      jnp.where(ended & learning, values, state.references[at])
    )
    due = ended & (state.seen + 1 == m * block)
    healthy = multivariate.once(due, settle, references, state.healthy)
    tested = ended & ~learning
    newest = jnp.concatenate([(healthy.weights @ values)[None], state.recent[:-1]])
    recent = jnp.where(tested, newest, state.recent)
    blocks = state.blocks + tested
    filled = blocks >= jnp.array(horizons)
    z = jnp.where(filled, drops(recent, healthy.mean, healthy.std, horizons), -jnp.inf)
    alarm = judged(jnp.max(z) / healthy.level, tested & jnp.any(filled), threshold)
    new = BfarState(
      state.seen + known,
      jnp.where(ended, 0, state.step + known),
      jnp.where(ended, 0.0, sums),
      references,
      healthy,
      recent,
      jnp.where(alarm.fired, 0, blocks),
    )
    return new, alarm

  return Detector(init, update)
