"""Conformal test martingales on one residual: bets against exchangeability, from ranks alone.

The measure of nonconformity is frozen at warm-up, so on exchangeable samples (independent and
equally distributed ones of any distribution) the p-values are independent and uniform, exactly, and
E[T] >= exp(threshold) from every restart; with one start only (no `sum`) Ville's inequality would
bound the probability ever to fire. Restarts at every sample keep the bets able to react late in a
stream, where a single martingale has lost its wealth. Residuals are not exchangeable: an
autocorrelated stream comes in runs of small p, and the alarms come far too often. Whiten it, or
calibrate.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from mjx_cl.detectors.base import (
  Alarm,
  Detector,
  Flag,
  Number,
  Real,
  Setting,
  Warm,
  above,
  at_least,
  cold,
  demand,
  judged,
  scalar,
  standardise,
)
from mjx_cl.detectors.e_detector import FORMS, accumulate

# left edge and width of the bins [warm-up std]: fine where a raised residual lands
LOW, WIDTH = -2.0, 0.25


class Ranks(NamedTuple):
  """Where the samples so far lie.

  Attributes:
    upwards: int32 (bins,), samples in each bin of nonconformity or above it.
    seen: int32 (), their number.
    key: uint32 (2,), of the tie-breaking; its second word counts samples.
  """

  upwards: jax.Array
  seen: jax.Array
  key: jax.Array


class ConformalState(NamedTuple):
  """What the detector remembers.

  Attributes:
    warm: scale of the stream.
    ranks: where its samples lie.
    evidence: float32 (bets,), see e_detector.accumulate.
  """

  warm: Warm
  ranks: Ranks
  evidence: jax.Array


def ranked(state: Ranks, a: Number, ready: Flag, freeze: int) -> tuple[Number, Ranks]:
  """The p-value of nonconformity `a` among the samples so far, and the ranks with it.

  Samples count where ready; beyond `freeze` of them, unless it is 0, none does.
  """
  bins = len(state.upwards)
  mine = jnp.floor(jnp.clip(a / WIDTH, 0, bins - 1)).astype(jnp.int32)
  # each sample has a key of its own: one cipher call, not two; in (0, 1], so that ln p is finite
  u = 1 - jax.random.uniform(jax.random.wrap_key_data(state.key, impl="threefry2x32"))
  upwards = jnp.append(state.upwards, 0)
  more = upwards[mine + 1]
  p = (more + u * (upwards[mine] - more + 1)) / (state.seen + 1)
  counted = ready & ((state.seen < freeze) | (freeze == 0))
  return p, Ranks(
    state.upwards + (counted & (np.arange(bins) <= mine)),
    state.seen + counted,
    state.key + jnp.where(ready, jnp.array([0, 1], jnp.uint32), jnp.uint32(0)),
  )


@scalar
def conformal(
  threshold: Setting = 9.2104,
  bets: tuple[Real, ...] = (0.1, 0.3, 0.5, 0.7, 0.9),
  form: str = "sum",
  two_sided: bool = False,
  bins: int = 33,
  freeze: int = 0,
  seed: int = 0,
  warmup: int = 1000,
) -> Detector:
  """Ranks each sample among the earlier ones, and bets at every sample that small ranks begin here.

    z = (x - mean) / max(std, 1e-6), mean and std frozen after `warmup` samples
    nonconformity a = z, or |z| if two_sided, in bins of 0.25
    p = (#{a_i > a} + U #{a_i = a}) / n over the n samples since warm-up; U uniform breaks ties
    growth_e = ln e + (e - 1) ln p for e in `bets`: the mean of its exponential over uniform p is 1
    (power martingales)
    sum:  M_e = (M_e + 1) exp(growth_e)     max:  M_e = max(M_e, 1) exp(growth_e)
    score = ln mean_e M_e;  fired = score > threshold; then all M_e = 0, the rest is kept

  Args:
    threshold: ln(1 / rate) [nats]; 9.2104 is one false alarm in 10,000 samples; may be traced.
    bets: exponents in (0, 1); small ones win by few tiny p, large ones by many slightly small p.
    form: `sum` (Shiryaev-Roberts) or `max` (CUSUM, with slack).
    two_sided: a large fall counts as a large rise does.
    bins: of nonconformity, from -2 (two_sided: 0) deviations upwards; what lies beyond the outer
      edges is one bin each.
    freeze: samples after warm-up that make the ranks [control steps]; 0: all.
    seed: of U; streams started alike share it.
    warmup: samples that fit mean and std [control steps]; 0: the stream is standardised already.
  Blind to: a fall, unless two_sided (so for the reward); a drift as slow as the ranks' own memory;
  a change present from the first rank on.
  Source: Vovk, Nouretdinov and Gammerman 2003, ICML; Vovk
  2021, Statistical Science 36, 595-611; Volkhonskiy et al. 2017, COPA.
  """
  demand(
    "conformal",
    threshold=(threshold, above(threshold, -math.inf), "a number"),
    bets=(bets, len(bets) > 0 and all(0 < e < 1 for e in bets), "one or more between 0 and 1"),
    form=(form, form in FORMS, "one of sum, max"),
    **at_least(2, bins=bins),
    **at_least(0, freeze=freeze),
    seed=(seed, 0 <= seed < 2**32, "from 0 to 2^32 - 1"),
    warmup=(warmup, warmup == 0 or warmup >= 2, "0, or at least 2"),
  )
  power = np.array(bets, np.float32)

  def init() -> ConformalState:
    ranks = Ranks(jnp.zeros(bins, jnp.int32), jnp.int32(0), jnp.array([seed, 0], jnp.uint32))
    return ConformalState(cold(), ranks, jnp.zeros(len(power)))

  def update(state: ConformalState, x: ArrayLike) -> tuple[ConformalState, Alarm]:
    warm, z, ready = standardise(state.warm, jnp.asarray(x, jnp.float32), warmup)
    p, ranks = ranked(state.ranks, jnp.abs(z) if two_sided else z - LOW, ready, freeze)
    growth = jnp.asarray(np.log(power)) + (power - 1) * jnp.log(p)
    evidence, score = accumulate(state.evidence, growth, form)
    alarm = judged(score, ready, threshold)
    return ConformalState(warm, ranks, jnp.where(ready & ~alarm.fired, evidence, 0.0)), alarm

  return Detector(init, update)
