"""The scan over replayed steps against the plain one: values, gradients, updates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick
from test_agent import ACT, KEY, OBS, SMALL, make_batch, shake

from mjx_cl.config import DreamerConfig
from mjx_cl.dreamer import nets, rssm
from mjx_cl.dreamer.agent import Agent
from mjx_cl.dreamer.networks import later


class Plain(Agent):
  """An agent whose scan takes everything step by step, with JAX's own gradient."""

  def observe(self, params, batch, key):
    tokens = self._encode(params, later(batch.obs))
    uniform = jax.random.uniform(key, (*tokens.shape[:2], self.size.stoch))

    def step(state, x):
      action, first, tokens, uniform = x
      deter, stoch = (part * (1.0 - first[:, None]) for part in state)
      deter = self._core(params, deter, stoch, action * (1.0 - first[:, None]))
      logits = self._apply(params, "dyn", deter, tokens, method="posterior")
      stoch = rssm.sample(logits, uniform).reshape(stoch.shape)
      return (deter, stoch), (deter, stoch, logits)

    start = batch.deter[:, 0].astype(jnp.float32), self.hot(batch.stoch[:, 0])
    first = later(batch.first).astype(jnp.float32)
    xs = batch.action[:, :-1].swapaxes(0, 1), first, tokens, uniform
    return jax.lax.scan(step, start, xs)[1]


@pytest.fixture(scope="module")
def both():
  return tuple(kind(DreamerConfig(**SMALL), OBS, ACT) for kind in (Agent, Plain))


def test_states_and_gradients_equal_the_plain_scan(both):
  """Of a sum in which each value has a weight of its own; float32 sums over rows and steps in
  another order, so a millionth or two of the largest part of a gradient.
  """
  batch, params = make_batch(ends=True), shake(both[0].init_params(KEY))

  def total(params, start, agent):
    out = agent.observe(params, batch._replace(deter=start), KEY)
    rng = np.random.default_rng(1)
    return sum(jnp.sum(x * rng.standard_normal(x.shape)) for x in out), out

  of = lambda agent: quick.jit(
    jax.grad(lambda p, start: total(p, start, agent), (0, 1), has_aux=True)
  )(params, batch.deter)
  (got, states), (want, plain) = of(both[0]), of(both[1])
  for a, b in zip(states, plain):
    np.testing.assert_allclose(a, b, atol=2e-5)
  reached = 0
  for (path, a), b in zip(jax.tree.leaves_with_path(got), jax.tree.leaves(want)):
    most = np.abs(np.asarray(b)).max()
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * most + 1e-7, err_msg=str(path))
    reached += most > 0
  assert reached == 9 + 19 + 1  # of the encoder, of core and posterior, the start


def test_updates_agree_with_those_of_the_plain_scan(both):
  """Four updates on one batch move the parameters alike: LaProp divides a gradient by its own size,
  so that rounding counts where a gradient is small; over all it stays below a thousandth.
  """
  batch, start = make_batch(ends=True), both[0].init(KEY)
  start = start._replace(params=shake(start.params), updates=jnp.int32(0))
  ends = []
  for agent in both:
    state, update = start, quick.jit(agent.update)
    for i in range(4):
      state, _, _ = update(state, batch, jax.random.fold_in(KEY, i))
    ends.append(state.params)
  norm = lambda a, b: np.sqrt(
    sum(np.sum(np.square(np.asarray(x - y))) for x, y in zip(*map(jax.tree.leaves, (a, b))))
  )
  assert norm(*ends) < 1e-3 * norm(ends[1], start.params)


@pytest.mark.parametrize("inputs, units", [(9, 4), (4, 9)])
def test_gradient_of_a_product_equals_the_plain_one(inputs, units):
  draw = lambda i, *shape: jax.random.normal(jax.random.key(i), shape)
  x, kernel, y = draw(0, 2, 5, inputs), draw(1, inputs, units), draw(2, 2, 5, units)
  for got, want in zip(
    jax.vjp(nets.product, x, kernel)[1](y), jax.vjp(jnp.matmul, x, kernel)[1](y)
  ):
    np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-5)  # float32 sums
