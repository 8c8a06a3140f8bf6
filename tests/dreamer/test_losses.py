"""Targets and optimiser against NumPy loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl.dreamer import losses, optim

T, N = 12, 5


def draw(seed):
  rng = np.random.default_rng(seed)
  return (
    rng,
    rng.standard_normal((T, N)).astype(np.float32),
    rng.standard_normal((T, N)).astype(np.float32),
  )


@pytest.mark.parametrize("seed", range(3))
def test_lambda_return_equals_a_loop(seed):
  rng, r, v = draw(seed)
  c = (rng.random((T, N)) * (rng.random((T, N)) > 0.2)).astype(np.float32)  # zeros: predicted ends
  want = np.zeros((T, N))
  for n in range(N):
    ret = v[-1, n]
    for t in reversed(range(T)):
      ret = r[t, n] + c[t, n] * (0.05 * v[t, n] + 0.95 * ret)
      want[t, n] = ret
  np.testing.assert_allclose(
    losses.lambda_return(r, c, v, 0.95), want, atol=1e-5
  )  # float32 sums of 12


@pytest.mark.parametrize("seed", range(3))
def test_replay_return_equals_a_loop(seed):
  rng, r, boot = draw(seed)
  last = rng.random((T, N)) < 0.3
  terminal = last & (rng.random((T, N)) < 0.5)
  want = np.zeros((T - 1, N))
  for n in range(N):
    ret = boot[-1, n]
    for t in reversed(range(T - 1)):
      lam = 0.0 if last[t + 1, n] else 0.9
      future = (1 - lam) * boot[t + 1, n] + lam * ret
      ret = r[t + 1, n] + (0.0 if terminal[t + 1, n] else 0.97) * future
      want[t, n] = ret
  got = losses.replay_return(
    r, terminal.astype(np.float32), last.astype(np.float32), boot, 0.9, 0.97
  )
  np.testing.assert_allclose(got, want, atol=1e-5)  # float32 sums of 12


def test_replay_return_at_the_two_kinds_of_end():
  r, boot = (
    np.array([[0.0], [2.0], [5.0]], np.float32),
    np.array([[7.0], [10.0], [20.0]], np.float32),
  )
  last = np.array([[0.0], [1.0], [0.0]], np.float32)
  limit = losses.replay_return(r, np.zeros((3, 1), np.float32), last, boot, 0.95, 0.9)
  np.testing.assert_allclose(
    limit[0], 2 + 0.9 * 10
  )  # the time limit bootstraps from the last state, the next episode is not seen
  true_end = losses.replay_return(r, last, last, boot, 0.95, 0.9)
  np.testing.assert_allclose(true_end[0], 2)


def test_update_range_equals_a_loop():
  low_high, want = jnp.zeros(2), np.zeros(2)
  for seed in range(6):
    returns = 100 * draw(seed)[1]
    low_high, scale = losses.update_range(low_high, returns, 0.01)
    want = 0.99 * want + 0.01 * np.percentile(returns.astype(np.float64), [5, 95])
    np.testing.assert_allclose(low_high, want, rtol=1e-5)  # float32 interpolation
    np.testing.assert_allclose(
      scale, max(1.0, want[1] - want[0]), rtol=1e-5
    )  # float32 interpolation
  assert scale > 1.0


def test_range_below_one_scales_by_one():
  low_high, scale = losses.update_range(jnp.zeros(2), draw(0)[1], 0.01)
  assert scale == 1.0 and low_high[1] - low_high[0] < 1.0


def test_agc_and_laprop_equal_a_loop():
  lr, warmup, rng = 1e-2, 3, np.random.default_rng(0)
  want = {
    "large": 3 * rng.standard_normal((4, 5)),
    "zero": np.zeros(3),
    "quiet": rng.standard_normal(6),
    "small": 1e-5 * rng.standard_normal(2),
  }
  params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), want)
  optimizer = optim.laprop(lr, warmup)
  state = optimizer.init(params)
  nu, mu = ({k: np.zeros_like(v) for k, v in want.items()} for _ in range(2))
  clipped = set()
  for t in range(1, 8):
    grads = {
      "large": (50.0 if t % 2 else 0.01) * rng.standard_normal((4, 5)),
      "zero": rng.standard_normal(3),
      "quiet": np.zeros(6),
      "small": 1e-5 * rng.standard_normal(2),
    }
    steps, state = optimizer.update(
      jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), grads), state, params
    )
    before, params = params, jax.tree.map(jnp.add, params, steps)
    rate = lr * min(1.0, (t - 1) / warmup)
    for k, g in grads.items():
      limit = 0.3 * max(1e-3, np.sqrt(np.sum(want[k] ** 2)))
      size = np.sqrt(np.sum(g**2))
      clipped |= {k} if size > limit else set()
      g = g / max(1.0, size / limit)
      nu[k] = 0.999 * nu[k] + 0.001 * g**2
      mu[k] = 0.9 * mu[k] + 0.1 * g / (np.sqrt(nu[k] / (1 - 0.999**t)) + 1e-20)
      want[k] = want[k] - rate * mu[k] / (1 - 0.9**t)
      np.testing.assert_allclose(
        params[k], want[k], rtol=1e-4, atol=1e-4 * lr
      )  # 1 - 0.999^t loses 4 digits in float32
    if t == 1:  # the warm-up starts at 0
      assert all(jnp.array_equal(before[k], params[k]) for k in params)
      assert (
        float(jnp.abs(state[1].nu["zero"]).max()) > 0
        and float(jnp.abs(state[2].ema["zero"]).max()) > 0
      )
  assert clipped == {"large", "zero"}  # both rules were met: over and below the limit
  assert jnp.array_equal(
    params["quiet"], jnp.asarray(want["quiet"], jnp.float32)
  )  # a zero gradient moves nothing and stays finite
