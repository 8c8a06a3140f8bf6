"""Layers, output distributions, latents and the recurrent core against plain NumPy, written from
the equations.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from mjx_cl.config.sizes import SIZES
from mjx_cl.dreamer import heads, nets, rssm

TINY = SIZES["tiny"]
ROWS = 3


def shake(params, seed=0, scale=0.5):
  """Adds noise to every parameter, so that gains, biases and zero kernels count too."""
  leaves, tree = jax.tree.flatten(params)
  rng = np.random.default_rng(seed)
  return jax.tree.unflatten(
    tree,
    [
      x + jnp.asarray(scale * rng.standard_normal(x.shape) / np.sqrt(max(1, x.shape[-1])), x.dtype)
      for x in leaves
    ],
  )


def normals(*shape, seed=1):
  return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def to64(params):
  return jax.tree.map(lambda x: np.asarray(x, np.float64), params)


# the equations once more, in float64


def np_sigmoid(x):
  return 1 / (1 + np.exp(-x))


def np_silu(x):
  return x * np_sigmoid(x)


def np_softmax(x):
  e = np.exp(x - x.max(-1, keepdims=True))
  return e / e.sum(-1, keepdims=True)


def np_norm(x, gain):
  return x * gain / np.sqrt(np.mean(x**2, -1, keepdims=True) + 1e-4)


def np_linear(p, x):
  return x @ p["kernel"] + p["bias"]


def np_hidden(p, x):
  return np_silu(np_norm(np_linear(p["linear"], x), p["norm"]["gain"]))


def np_mlp(p, x):
  for i in range(len(p)):
    x = np_hidden(p[f"hidden{i}"], x)
  return x


# ---- symlog, two-hot -----------------------------------------------------------------------------


def test_symexp_inverts_symlog():
  x = np.concatenate([-np.geomspace(1e6, 1e-6, 50), [0], np.geomspace(1e-6, 1e6, 50)]).astype(
    np.float32
  )
  np.testing.assert_allclose(
    nets.symexp(nets.symlog(x)), x, rtol=1e-5
  )  # float32 rounding of the exponent, at most ln 1e6 ulps
  np.testing.assert_allclose(
    nets.symlog(x), np.sign(x) * np.log1p(np.abs(x, dtype=np.float64)), rtol=1e-6
  )  # a few float32 ulps


def test_bins_are_symmetric_symexp():
  bins = nets.two_hot_bins(255)
  assert bins.shape == (255,) and bins.dtype == np.float32
  assert bins[127] == 0.0 and not np.signbit(bins[127])
  np.testing.assert_array_equal(bins, -bins[::-1])
  grid = np.linspace(-20, 20, 255)
  np.testing.assert_allclose(
    bins, np.sign(grid) * np.expm1(np.abs(grid)), rtol=3e-6
  )  # 20 rounded to float32 is 1e-6 off in the exponent
  np.testing.assert_allclose(bins[-1], 485_165_194, rtol=2e-7)  # one float32 ulp
  assert np.all(np.diff(bins) > 0)


def np_two_hot(x, bins):
  """One target distribution, by a loop over the bins."""
  out = np.zeros(len(bins))
  if x <= bins[0]:
    out[0] = 1
  elif x >= bins[-1]:
    out[-1] = 1
  else:
    for i in range(len(bins) - 1):
      if bins[i] <= x < bins[i + 1]:
        weight = (x - bins[i]) / (bins[i + 1] - bins[i])
        out[i], out[i + 1] = 1 - weight, weight
  return out


TARGETS = {
  "inside": np.concatenate([normals(20), 300 * normals(20, seed=2), 1e5 * normals(10, seed=3)]),
  "on_bins": nets.two_hot_bins(255)[[1, 50, 126, 127, 128, 200, 253]],
  "ends": nets.two_hot_bins(255)[[0, -1]],
  "beyond": np.array([-1e9, 1e9, -4.9e8, 4.9e8], np.float32),
}


@pytest.mark.parametrize("kind", TARGETS)
def test_two_hot_and_its_loss_equal_a_loop(kind):
  bins, x = nets.two_hot_bins(255), TARGETS[kind].astype(np.float32)
  want = np.stack([np_two_hot(float(v), bins.astype(np.float64)) for v in x])
  logits = normals(len(x), 255)
  slope = jax.grad(lambda y: jnp.sum(nets.two_hot_loss(y, x, jnp.asarray(bins))))(logits)
  target = jax.nn.softmax(logits) - slope
  np.testing.assert_allclose(
    target, want, atol=1e-5
  )  # x - low loses at most 100 ulps of the bin width
  loss = -np.sum(want * np.log(np_softmax(logits.astype(np.float64))), -1)
  np.testing.assert_allclose(
    nets.two_hot_loss(logits, x, jnp.asarray(bins)), loss, rtol=1e-4
  )  # the weights' 1e-5 times logits of a few units
  if kind in ("on_bins", "ends"):
    np.testing.assert_allclose(np.asarray(target).max(-1), 1.0, rtol=3e-7)


def test_two_hot_loss_stops_the_target():
  bins = jnp.asarray(nets.two_hot_bins(255))
  assert jax.grad(lambda x: nets.two_hot_loss(jnp.asarray(normals(255)), x, bins))(0.3) == 0.0


def test_two_hot_mean():
  bins = nets.two_hot_bins(255)
  for level in (0.0, 3.7, -12.0):
    assert nets.two_hot_mean(jnp.full(255, level), jnp.asarray(bins)) == 0.0
  logits = normals(5, 255) - 0.7 * np.abs(np.linspace(-20, 20, 255)).astype(np.float32)
  probs = np_softmax(logits.astype(np.float64))
  np.testing.assert_allclose(
    nets.two_hot_mean(logits, jnp.asarray(bins)),
    probs @ bins.astype(np.float64),
    atol=1e-5 * float(np.max(probs @ np.abs(bins))),
  )  # float32 sum of terms of this size
  target = np_two_hot(37.5, bins.astype(np.float64)).astype(np.float32)
  np.testing.assert_allclose(
    nets.two_hot_mean(jnp.log(target + 1e-30), jnp.asarray(bins)), 37.5, rtol=1e-5
  )  # float32 softmax


# ---- layers --------------------------------------------------------------------------------------


@pytest.mark.parametrize("outscale", [1.0, 0.01])
def test_kernel_deviation(outscale):
  p = nets.Linear(512, outscale).init(jax.random.key(0), jnp.zeros((1, 300)), jnp.zeros((1, 212)))[
    "params"
  ]
  kernel = np.asarray(p["kernel"])
  assert kernel.shape == (512, 512)
  np.testing.assert_allclose(
    kernel.std(), outscale / np.sqrt(512), rtol=0.006
  )  # 4 standard errors of 2^18 draws
  assert (
    np.abs(kernel).max() <= 2 * 1.1368 * outscale / np.sqrt(512) * 1.0001
  )  # truncated at 2 deviations of the parent normal
  assert np.all(np.asarray(p["bias"]) == 0)


def test_zero_outscale_is_exact():
  p = nets.Linear(7, 0.0).init(jax.random.key(0), jnp.zeros((1, 5)))["params"]
  assert np.all(np.asarray(p["kernel"]) == 0) and np.all(np.asarray(p["bias"]) == 0)


def test_linear_of_several_inputs_is_linear_of_their_concatenation():
  a, b = normals(ROWS, 5), normals(ROWS, 4, seed=2)
  layer = nets.Linear(6)
  params = shake(layer.init(jax.random.key(0), a, b)["params"])
  np.testing.assert_allclose(
    layer.apply({"params": params}, a, b),
    np_linear(to64(params), np.concatenate([a, b], -1)),
    atol=1e-5,
  )  # float32 sum of 9


def test_rms_norm():
  x = 3 * normals(ROWS, 16)
  x[1] *= 1e-3  # where the 1e-4 counts
  gain = 1 + normals(16, seed=2)
  got = nets.Norm().apply({"params": {"gain": gain}}, x)
  np.testing.assert_allclose(
    got, np_norm(x.astype(np.float64), gain), rtol=1e-5
  )  # float32 mean of 16 squares
  np.testing.assert_array_equal(
    nets.Norm().init(jax.random.key(0), x)["params"]["gain"], np.ones(16)
  )


def test_block_linear_equals_a_loop_over_blocks():
  x, shared = normals(8, ROWS, 4), normals(ROWS, 6, seed=2)
  layer = rssm.BlockLinear(5)
  params = shake(layer.init(jax.random.key(0), x, shared)["params"])
  p, got = to64(params), layer.apply({"params": params}, x, shared)
  for g in range(8):
    want = np.concatenate([x[g], shared], -1) @ p["kernel"][g] + p["bias"][5 * g : 5 * g + 5]
    np.testing.assert_allclose(got[g], want, atol=1e-5)  # float32 sum of 10


def test_block_linear_starts_with_the_full_fan_in():
  p = rssm.BlockLinear(64).init(jax.random.key(0), jnp.zeros((8, 1, 48)), jnp.zeros((1, 80)))[
    "params"
  ]
  assert p["kernel"].shape == (8, 128, 64)
  np.testing.assert_allclose(
    np.asarray(p["kernel"]).std(), np.sqrt(1 / (8 * 128)), rtol=0.012
  )  # 4 standard errors of 2^16 draws


def test_block_norm_is_over_the_whole_vector():
  x, gain = normals(8, ROWS, 4), normals(32, seed=2)
  got = rssm.BlockNorm().apply({"params": {"gain": gain}}, x)
  flat = x.transpose(1, 0, 2).reshape(ROWS, 32).astype(np.float64)
  np.testing.assert_allclose(
    np.asarray(got).transpose(1, 0, 2).reshape(ROWS, 32), np_norm(flat, gain), rtol=1e-4, atol=1e-6
  )  # float32 mean


# ---- policy --------------------------------------------------------------------------------------


def test_policy_at_init():
  _, std = nets.normal(jnp.zeros(6), jnp.zeros(6))
  np.testing.assert_allclose(std, 0.8927, atol=5e-5)  # published digits
  np.testing.assert_allclose(nets.normal_entropy(std), 7.833, atol=5e-4)  # published digits
  deter, stoch = normals(ROWS, TINY.deter), normals(ROWS, 64, seed=2)
  mean, std = nets.normal(
    *heads.PolicyHead(32, 6).init_with_output(jax.random.key(0), deter, stoch)[0]
  )
  np.testing.assert_allclose(
    mean, 0.0, atol=0.05
  )  # output kernels are scaled by 0.01: raw values of about 0.01
  np.testing.assert_allclose(std, 0.8927, atol=0.01)  # slope of the deviation there is 0.09


def test_policy_density_and_bounds():
  mean, std, x = (
    np.tanh(normals(ROWS, 6)),
    0.1 + np.abs(normals(ROWS, 6, seed=2)),
    2 * normals(ROWS, 6, seed=3),
  )
  np.testing.assert_allclose(
    nets.normal_logp(mean, std, x), scipy.stats.norm.logpdf(x, mean, std).sum(-1), rtol=1e-5
  )  # float32 sum
  np.testing.assert_allclose(
    nets.normal_entropy(jnp.asarray(std)), scipy.stats.norm.entropy(mean, std).sum(-1), rtol=1e-5
  )  # float32 sum
  low, high = nets.normal(jnp.zeros(2), jnp.array([-1e3, 1e3]))[1]
  np.testing.assert_allclose([low, high], [0.1, 1.0], rtol=1e-6)  # one ulp


# ---- latents -------------------------------------------------------------------------------------


def test_sample_frequencies_are_probs():
  logits, draws = 2 * normals(5, 8), 4000
  uniform = jnp.broadcast_to(
    ((jnp.arange(draws) + 0.5) / draws)[:, None], (draws, 5)
  )  # an even grid: frequencies are exact to one count
  hot = np.asarray(rssm.sample(jnp.broadcast_to(logits, (draws, 5, 8)), uniform))
  np.testing.assert_allclose(hot.sum(-1), 1.0, atol=1e-6)  # p - p may round
  np.testing.assert_allclose(
    hot.round().mean(0), 0.99 * np_softmax(logits) + 0.01 / 8, atol=1.5 / draws
  )  # one count, and float32 cumsum


def test_sample_at_the_ends_of_the_unit_interval():
  logits = 30 * normals(4, 8)
  for u in (0.0, float(np.nextafter(np.float32(1), np.float32(0)))):
    hot = np.asarray(rssm.sample(logits, jnp.full(4, u))).round()
    np.testing.assert_array_equal(hot.argmax(-1), 0 if u == 0.0 else 7)
    np.testing.assert_array_equal(hot.sum(-1), 1)


def test_sample_gradient_is_that_of_probs():
  logits, weights, uniform = (
    normals(5, 8),
    normals(5, 8, seed=2),
    jnp.asarray(np.random.default_rng(0).random(5), jnp.float32),
  )
  got = jax.grad(lambda x: jnp.sum(weights * rssm.sample(x, uniform)))(logits)
  want = jax.grad(lambda x: jnp.sum(weights * rssm.probs(x)))(logits)
  np.testing.assert_allclose(got, want, rtol=1e-6)  # the same sum, perhaps fused otherwise
  assert np.abs(want).max() > 0.01


def test_unimix_floor():
  probs = np.asarray(rssm.probs(jnp.array([1000.0, 0, 0, -1000.0])))
  np.testing.assert_allclose(probs, [0.99 + 0.0025, 0.0025, 0.0025, 0.0025], rtol=1e-6)  # one ulp


def test_kl_equals_a_loop():
  q_logits, p_logits = 2 * normals(ROWS, 5, 8), 2 * normals(ROWS, 5, 8, seed=2)
  want = np.zeros(ROWS)
  for n in range(ROWS):
    for i in range(5):
      q, p = (
        0.99 * np_softmax(x[n, i].astype(np.float64)) + 0.01 / 8 for x in (q_logits, p_logits)
      )
      want[n] += sum(q[k] * np.log(q[k] / p[k]) for k in range(8))
  np.testing.assert_allclose(rssm.kl(q_logits, p_logits), want, rtol=1e-5)  # float32 sum of 40
  assert np.all(np.asarray(rssm.kl(q_logits, q_logits)) == 0.0)


# ---- recurrent core, prior, posterior, heads -----------------------------------------------------


@pytest.fixture(scope="module")
def model():
  deter, stoch, action, tokens = (
    normals(ROWS, TINY.deter),
    normals(ROWS, 64, seed=2),
    2 * normals(ROWS, 6, seed=3),
    normals(ROWS, 32, seed=4),
  )
  module = rssm.RSSM(TINY)
  params = shake(jax.jit(module.init)(jax.random.key(0), deter, stoch, action, tokens)["params"])
  return module, params, deter, stoch, action, tokens


def test_core_equals_numpy(model):
  module, params, deter, stoch, action, _ = model
  p, blocks = to64(params), TINY.blocks
  width = TINY.deter // blocks
  clipped = action / np.maximum(1, np.abs(action))
  shared = np.concatenate(
    [
      np_hidden(p["in_deter"], deter),
      np_hidden(p["in_stoch"], stoch),
      np_hidden(p["in_action"], clipped),
    ],
    -1,
  )
  kernel, bias = p["core_hidden"]["kernel"], p["core_hidden"]["bias"]
  own = [deter[:, width * g : width * (g + 1)] for g in range(blocks)]
  h = (
    np.concatenate([np.concatenate([own[g], shared], -1) @ kernel[g] for g in range(blocks)], -1)
    + bias
  )
  h = np_silu(np_norm(h, p["core_norm"]["gain"]))
  r, c, u = [], [], []
  for g in range(blocks):
    gates = (
      h[:, width * g : width * (g + 1)] @ p["core_gates"]["kernel"][g]
      + p["core_gates"]["bias"][3 * width * g : 3 * width * (g + 1)]
    )
    for part, name in zip((r, c, u), np.split(gates, 3, -1)):
      part.append(name)
  r, c, u = (np.concatenate(x, -1) for x in (r, c, u))
  update = np_sigmoid(u - 1)
  want = update * np.tanh(np_sigmoid(r) * c) + (1 - update) * deter
  np.testing.assert_allclose(
    module.apply({"params": params}, deter, stoch, action, method="core"), want, atol=2e-5
  )  # float32 sums of 100


def test_core_moves_slowly_at_init(model):
  module, params, _, _, action, _ = model
  still = jax.tree.map(
    jnp.zeros_like, params
  )  # gates of 0: the candidate is 0 and the old state keeps 1 - sigmoid(-1)
  deter = normals(ROWS, TINY.deter)
  got = module.apply({"params": still}, deter, jnp.zeros((ROWS, 64)), action, method="core")
  np.testing.assert_allclose(got, (1 - 0.26894142) * deter, rtol=1e-5)  # a few ulps


def test_actions_are_clipped_to_the_bound_with_their_gradient():
  a = jnp.array([-3.0, -1.0, -0.4, 0.0, 0.7, 2.0])
  np.testing.assert_allclose(rssm.clip_action(a), [-1, -1, -0.4, 0, 0.7, 1], rtol=1e-6)  # one ulp
  np.testing.assert_allclose(
    jax.vmap(jax.grad(rssm.clip_action))(a), [1 / 3, 1, 1, 1, 1, 0.5], rtol=1e-6
  )  # the divisor is stopped


def test_prior_and_posterior_equal_numpy(model):
  module, params, deter, _, _, tokens = model
  p, shape = to64(params), (ROWS, TINY.stoch, TINY.classes)
  prior = np_linear(p["prior_out"], np_mlp(p["prior_mlp"], deter)).reshape(shape)
  post = np_linear(
    p["post_out"], np_hidden(p["post_hidden"], np.concatenate([deter, tokens], -1))
  ).reshape(shape)
  assert set(p["prior_mlp"]) == {"hidden0", "hidden1"}
  np.testing.assert_allclose(
    module.apply({"params": params}, deter, method="prior"), prior, atol=2e-5
  )  # float32 sums of 128
  np.testing.assert_allclose(
    module.apply({"params": params}, deter, tokens, method="posterior"), post, atol=2e-5
  )  # float32 sums of 160


HEADS = {  # module, hidden layers, order of the features
  "reward": (heads.Head(1, 32, 255, 0.0), 1, "ds"),
  "continue": (heads.Head(1, 32, 1, 1.0), 1, "ds"),
  "value": (heads.Head(3, 32, 255, 0.0), 3, "ds"),
  "decoder": (heads.Decoder(32, 24), 3, "sd"),
  "policy": (heads.PolicyHead(32, 6), 3, "ds"),
}


@pytest.mark.parametrize("name", HEADS)
def test_heads_equal_numpy(name):
  module, layers, order = HEADS[name]
  deter, stoch = normals(ROWS, TINY.deter), normals(ROWS, 64, seed=2)
  params = shake(jax.jit(module.init)(jax.random.key(0), deter, stoch)["params"])
  p = to64(params)
  assert len(p["mlp"]) == layers
  x = np_mlp(p["mlp"], np.concatenate([deter, stoch] if order == "ds" else [stoch, deter], -1))
  want = [np_linear(p[n], x) for n in (("mean", "std") if name == "policy" else ("out",))]
  for g, w in zip(jax.tree.leaves(module.apply({"params": params}, deter, stoch)), want):
    np.testing.assert_allclose(g, w, atol=5e-5)  # float32 through up to 4 layers


def test_encoder_equals_numpy():
  obs = 10 * normals(ROWS, 24)
  module = heads.Encoder(32)
  params = shake(jax.jit(module.init)(jax.random.key(0), obs)["params"])
  p = to64(params)
  assert len(p["mlp"]) == 3
  want = np_mlp(p["mlp"], np.sign(obs) * np.log1p(np.abs(obs)))
  np.testing.assert_allclose(
    module.apply({"params": params}, obs), want, atol=5e-5
  )  # float32 through 3 layers


# ---- draws ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("draw", [jax.random.uniform, jax.random.normal])
def test_draws_in_a_row_are_the_draws(draw):
  """To the last bit, for one key and for a batch of them."""
  key = jax.random.key(3)
  np.testing.assert_array_equal(nets.in_a_row(draw, key, (5, 3, 2)), draw(key, (5, 3, 2)))
  keys = jax.random.split(key, 4)
  np.testing.assert_array_equal(
    jax.vmap(lambda k: nets.in_a_row(draw, k, (3, 7)))(keys),
    jax.vmap(lambda k: draw(k, (3, 7)))(keys),
  )
