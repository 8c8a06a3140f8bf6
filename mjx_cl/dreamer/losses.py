"""Targets of DreamerV3: lambda-returns, replay-value targets, return normaliser. Time runs along
axis 0 unless said.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float

from mjx_cl.types import Array


def lambda_return(
  r_t: Float[Array, "steps *rows"],
  c_t: Float[Array, "steps *rows"],
  v_t: Float[Array, "steps *rows"],
  lam: float,
) -> Float[Array, "steps *rows"]:
  """Imagined returns from reward, continue and value at states 1..H.

  R_i = r_{i+1} + c_{i+1} ((1 - lam) v_{i+1} + lam R_{i+1}),   i = H-1..0,   R_H = v_H;   c already
    holds the discount
  """

  def step(ret: Array, x: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    r, c, v = x
    ret = r + c * ((1.0 - lam) * v + lam * ret)
    return ret, ret

  return jax.lax.scan(step, v_t[-1], (r_t, c_t, v_t), reverse=True)[1]


def replay_return(
  r_t: Float[Array, "steps *rows"],
  terminal_t: Float[Array, "steps *rows"],
  last_t: Float[Array, "steps *rows"],
  boot_t: Float[Array, "steps *rows"],
  lam: float,
  discount: float,
) -> Float[Array, "steps-1 *rows"]:
  """Replay-value targets from arrays over T replayed steps.

    G_{T-1} = b_{T-1};   G_t = r_{t+1} + (1 - terminal_{t+1}) discount [(1 - l_{t+1}) b_{t+1} +
      l_{t+1} G_{t+1}],   l = lam (1 - last)

  b is the imagined return from each state: a time limit bootstraps fully from b at the last state,
  a true terminal cuts off.
  """

  def step(ret: Array, x: tuple[Array, Array, Array, Array]) -> tuple[Array, Array]:
    r, terminal, last, boot = x
    mix = lam * (1.0 - last)
    ret = r + (1.0 - terminal) * discount * ((1.0 - mix) * boot + mix * ret)
    return ret, ret

  xs = (r_t[1:], terminal_t[1:], last_t[1:], boot_t[1:])
  return jax.lax.scan(step, boot_t[-1], xs, reverse=True)[1]


def update_range(
  low_high: Float[Array, "2"], returns: Float[Array, "..."], rate: float
) -> tuple[Float[Array, "2"], Float[Array, ""]]:
  """Percentile normaliser: EMA (rate, from 0, no bias correction) of the 5th and 95th percentile of
  `returns`. Gives the new one and the scale max(1, high - low).
  """
  now = jnp.quantile(returns.reshape(-1), jnp.array([0.05, 0.95]))
  low_high = (1.0 - rate) * low_high + rate * now
  return low_high, jnp.maximum(1.0, low_high[1] - low_high[0])
