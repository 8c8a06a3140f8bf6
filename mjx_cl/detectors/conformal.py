"""Conformal test martingales on one residual: bets against exchangeability, from ranks alone."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.detectors.base import Alarm, Detector, Warm, above, cold, demand, scalar, standardise
from mjx_cl.detectors.e_detector import FORMS, accumulate

LOW, WIDTH = (
  -2.0,
  0.25,
)  # left edge and width of the bins [warm-up std]: fine where a raised residual lands


class ConformalState(NamedTuple):
  """Attributes:
  warm: scale of the stream. upwards: int32 (bins,), samples so far in each bin of nonconformity or
  above it. seen: int32 (), their number. evidence: float32 (bets,), see e_detector.accumulate. key:
  uint32 (2,), of the tie-breaking; its second word counts samples.
  """

  warm: Warm
  upwards: jax.Array
  seen: jax.Array
  evidence: jax.Array
  key: jax.Array


@scalar
def conformal(
  threshold: float = 9.2104,
  bets: tuple[float, ...] = (0.1, 0.3, 0.5, 0.7, 0.9),
  form: str = "sum",
  two_sided: bool = False,
  bins: int = 33,
  freeze: int = 0,
  seed: int = 0,
  warmup: int = 1000,
) -> Detector:
  """Ranks each sample among the earlier ones, and bets at every sample that small ranks begin here.

    z = (x - mean) / max(std, 1e-6), mean and std frozen after `warmup` samples; nonconformity a =
    z, or |z| if two_sided, in bins of 0.25
    p = (#{a_i > a} + U #{a_i = a}) / n over the n samples since warm-up, this one among them; U
    uniform breaks ties at random
    growth_e = ln e + (e - 1) ln p for e in `bets`: the mean of its exponential over uniform p is 1
    (power martingales)
    sum:  M_e = (M_e + 1) exp(growth_e)     max:  M_e = max(M_e, 1) exp(growth_e)     score = ln
      mean_e M_e
    fired = score > threshold; then all M_e = 0, while mean, std and counts are kept

  The measure of nonconformity is frozen at warm-up, so on exchangeable samples (independent and
  equally distributed ones of any distribution) the p-values are independent and uniform, exactly,
  and
    E[T] >= exp(threshold) from every restart; with one start only (no `sum`) Ville's inequality
    would bound the probability ever to fire.
  Restarts at every sample keep it able to react late in a stream, where a single martingale has
  lost its wealth. Residuals are not exchangeable: an autocorrelated stream comes in runs of small
  p, and the alarms come far too often. Whiten it, or calibrate.
  With freeze = 0 the samples of a change join the ranks too and are the new normal once as many as
  all before; freeze = N stops counting after N samples, which keeps a change visible for good but
  makes the ranks repeat the error of those N: the bound then holds only about.

  Args:
    threshold: ln(1 / rate) [nats]; 9.2104 is one false alarm in 10,000 samples at most. May be
      traced.
    bets: exponents in (0, 1); small ones win by few tiny p, large ones by many slightly small p.
    form: `sum` (Shiryaev-Roberts) or `max` (CUSUM, with slack).
    two_sided: a large fall counts as a large rise does.
    bins: of nonconformity, from -2 (two_sided: 0) deviations upwards; what lies beyond the outer
      edges is one bin each.
    freeze: samples after warm-up that make the ranks [control steps]; 0: all.
    seed: of U; streams started alike share it.
    warmup: samples that fit mean and std; nothing fires before they end [control steps]. 0: the
      stream is standardised already.

  Returns:
    Detector whose update takes x, float32 (), and gives Alarm(fired: bool (), score: float32 ());
    score nan during warm-up.
  Blind to: a fall, unless two_sided (so for the reward); a drift as slow as the ranks' own memory;
  a change present from the first rank on. Source: Vovk, Nouretdinov and Gammerman 2003, ICML; Vovk
  2021, Statistical Science 36, 595-611; Volkhonskiy et al. 2017, COPA. Example: _, out =
  jax.lax.scan(det.update, det.init(), xs)
  """
  demand(
    "conformal",
    threshold=(threshold, above(threshold, -math.inf), "a number"),
    bets=(bets, len(bets) > 0 and all(0 < e < 1 for e in bets), "one or more between 0 and 1"),
    form=(form, form in FORMS, "one of sum, max"),
    bins=(bins, bins >= 2, "at least 2"),
    freeze=(freeze, freeze >= 0, "at least 0"),
    seed=(seed, 0 <= seed < 2**32, "from 0 to 2^32 - 1"),
    warmup=(warmup, warmup == 0 or warmup >= 2, "0, or at least 2"),
  )
  power, place = np.array(bets, np.float32), np.arange(bins)

  def start(warm: Warm) -> ConformalState:
    return ConformalState(
      warm,
      jnp.zeros(bins, jnp.int32),
      jnp.int32(0),
      jnp.zeros(len(power)),
      jnp.array([seed, 0], jnp.uint32),
    )

  def update(state: ConformalState, x: jax.Array) -> tuple[ConformalState, Alarm]:
    warm, z, ready = standardise(state.warm, jnp.asarray(x, jnp.float32), warmup)
    a = jnp.abs(z) if two_sided else z - LOW
    mine = jnp.floor(jnp.clip(a / WIDTH, 0, bins - 1)).astype(jnp.int32)
    # each sample has a key of its own: one cipher call, not two
    u = 1 - jax.random.uniform(
      jax.random.wrap_key_data(state.key, impl="threefry2x32")
    )  # in (0, 1], so that ln p is finite
    upwards = jnp.append(state.upwards, 0)
    more = upwards[mine + 1]
    equal = upwards[mine] - more + 1
    p = (more + u * equal) / (state.seen + 1)

    evidence, score = accumulate(
      state.evidence,
      np.log(power) + (power - 1) * jnp.log(p),  # type: ignore[arg-type]
      form,
    )
    fired = ready & (score > threshold)
    counted = ready & ((state.seen < freeze) | (freeze == 0))
    new = ConformalState(
      warm,
      state.upwards + (counted & (place <= mine)),
      state.seen + counted,
      jnp.where(ready & ~fired, evidence, 0.0),
      state.key + jnp.where(ready, jnp.array([0, 1], jnp.uint32), jnp.uint32(0)),
    )
    return new, Alarm(fired, jnp.where(ready, score, jnp.nan))

  return Detector(lambda: start(cold()), update)
