"""The whole agent: sizes, values at initialisation, resets and context, gradient routes, the losses
against NumPy, acting, prediction.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick

from mjx_cl.config import DreamerConfig, replace
from mjx_cl.dreamer import nets, rssm
from mjx_cl.dreamer.agent import Agent, Record, parameter_count
from mjx_cl.dreamer.state import Weights

OBS, ACT, ROWS, LENGTH, IMAGINE = 5, 2, 3, 4, 3
SMALL = dict(size="tiny", batch=ROWS, length=LENGTH, imagine=IMAGINE, warmup=20)
KEY = jax.random.key(7)
TERMS = ("dyn", "rep", "rec", "rew", "con", "policy", "value", "repval", "clone")
GAMMA = 1 - 1 / 333


def make_batch(seed=0, ends=False):
  """Random windows; with `ends`, time limits at index 3 of row 0 and 2 of row 2, a true terminal at
  index 4 of row 1.
  """
  rng = np.random.default_rng(seed)
  flag = lambda *at: np.isin(
    np.arange(ROWS * (LENGTH + 1)).reshape(ROWS, -1), [r * (LENGTH + 1) + i for r, i in at]
  )
  n = lambda *shape: rng.standard_normal((ROWS, LENGTH + 1) + shape).astype(np.float32)
  last, terminal, first = (
    flag(*((0, 3), (2, 2), (1, 4)) * ends),
    flag(*((1, 4),) * ends),
    flag(*((0, 4), (2, 3)) * ends),
  )
  return Record(
    3 * n(OBS),
    1.5 * n(ACT),
    n(),
    first,
    last,
    terminal,
    np.tanh(n(128)),
    rng.integers(0, 8, (ROWS, LENGTH + 1, 8)),
    np.tanh(n(ACT)),
    rng.random((ROWS, LENGTH + 1)) < 0.6,
  )


def shake(params, seed=0):
  """Noise on every parameter: heads that start at zero speak, and the KL is above its floor."""
  leaves, tree = jax.tree.flatten(params)
  rng = np.random.default_rng(seed)
  return jax.tree.unflatten(
    tree,
    [
      x + jnp.asarray(rng.standard_normal(x.shape) * 2 / np.sqrt(max(4, x.shape[-1])), jnp.float32)
      for x in leaves
    ],
  )


class Fixture:
  """One agent and its compiled loss, which also gives each term's gradient with respect to every
  module.
  """

  def __init__(self, last_starts):
    self.agent = Agent(DreamerConfig(**SMALL, last_starts=last_starts), OBS, ACT, clone_std=0.2)

    def terms(params, slow, range_, batch, key, weights):
      total, (metrics, range_, deter, stoch) = self.agent.loss(
        params, slow, range_, batch, key, weights
      )
      return jnp.stack([metrics[f"loss/{k}"] for k in TERMS]), (
        total,
        metrics,
        range_,
        deter,
        stoch,
      )

    self._jac = quick.jit(jax.jacrev(terms, has_aux=True))
    self.fresh = quick.jit(self.agent.init)(jax.random.key(0)).params
    self.params, self.slow = shake(self.fresh), shake(self.fresh["val"], seed=1)
    self.observe = quick.jit(self.agent.observe)

  def __call__(self, params, slow, batch, range_=(0.0, 0.0), weights=Weights(0.3, 1.0)):
    jac, aux = self._jac(params, slow, jnp.array(range_), batch, KEY, weights)
    return jac, *aux

  def reached(self, jac, term):
    """Modules with any non-zero gradient of `term`."""
    i = TERMS.index(term)
    return {
      name
      for name, tree in jac.items()
      if any(np.any(np.asarray(x[i]) != 0) for x in jax.tree.leaves(tree))
    }


@pytest.fixture(scope="module")
def full():
  return Fixture(0)


@pytest.fixture(scope="module")
def tail():
  return Fixture(2)


# ---- sizes and initial values --------------------------------------------------------------------


def count(size):
  params = jax.eval_shape(Agent(DreamerConfig(size=size), 24, 6).init, jax.random.key(0)).params
  return parameter_count(params), {k: parameter_count(v) for k, v in params.items()}


def test_parameter_counts():
  total, modules = count("size1m")
  assert total == 640_867
  assert modules == {
    "enc": 10_112,
    "dyn": 364_416,
    "dec": 51_096,
    "rew": 57_663,
    "con": 41_153,
    "pol": 50_316,
    "val": 66_111,
  }
  total, modules = count("size12m")
  assert total == 9_738_019
  assert modules == {
    "enc": 138_752,
    "dyn": 5_783_040,
    "dec": 794_136,
    "rew": 721_407,
    "con": 656_129,
    "pol": 791_052,
    "val": 853_503,
  }


def test_losses_at_init(full):
  _, _, metrics, range_, _, _ = full(full.fresh, full.fresh["val"], make_batch())
  np.testing.assert_allclose(metrics["loss/rew"], np.log(255), rtol=1e-6)  # float32 logsumexp
  np.testing.assert_allclose(
    metrics["loss/repval"], 2 * np.log(255), rtol=1e-6
  )  # float32 logsumexp
  for name in ("val", "tar", "rew", "adv"):
    assert metrics[name] == 0.0, name
  assert metrics["ret_scale"] == 1.0 and np.all(np.asarray(range_) == 0.0)


def test_half_precision_of_stored_latents_changes_no_loss(full):
  """A replay keeps the context's deterministic state as float16, half a thousandth of it at most:
  losses and gradients differ by no more than that.
  """
  batch = make_batch(3)
  half = batch._replace(deter=np.asarray(batch.deter).astype(np.float16).astype(np.float32))
  (jac, terms, *_), (jac_half, terms_half, *_) = (
    full(full.params, full.slow, x) for x in (batch, half)
  )
  assert 1e-5 < np.abs(half.deter - batch.deter).max() < 2**-11
  np.testing.assert_allclose(terms_half, terms, rtol=5e-4)
  norm = lambda tree: np.sqrt(
    sum(np.sum(np.square(np.asarray(x, np.float64))) for x in jax.tree.leaves(tree))
  )
  assert norm(jax.tree.map(lambda a, b: a - b, jac_half, jac)) < 2e-3 * norm(
    jac
  )  # sums of many such differences


def test_heads_predict_zero_at_init(full):
  agent = full.agent
  deter, stoch = (
    np.random.default_rng(i).standard_normal((50, n)).astype(np.float32)
    for i, n in ((0, 128), (1, 64))
  )
  for name in ("rew", "val"):
    logits = getattr(agent, name).apply({"params": full.fresh[name]}, deter, stoch)
    assert np.all(np.asarray(nets.two_hot_mean(logits, agent.bins)) == 0.0), name


def test_floors_of_continue_and_kl(full):
  params = dict(full.fresh)
  flat = lambda tree, bias: {
    **tree,
    "kernel": jnp.zeros_like(tree["kernel"]),
    "bias": jnp.full_like(tree["bias"], bias),
  }
  params["con"] = {
    **params["con"],
    "out": flat(params["con"]["out"], np.log(332.0)),
  }  # sigmoid(ln 332) = 332 / 333
  params["dyn"] = {
    **params["dyn"],
    "prior_out": flat(params["dyn"]["prior_out"], 0.0),
    "post_out": flat(params["dyn"]["post_out"], 0.0),
  }
  jac, _, metrics, _, _, _ = full(params, full.fresh["val"], make_batch())
  np.testing.assert_allclose(metrics["loss/con"], 0.02044, atol=5e-6)  # published digits
  assert metrics["loss/dyn"] == 1.0 and metrics["loss/rep"] == 1.0
  assert (
    full.reached(jac, "dyn") == set() and full.reached(jac, "rep") == set()
  )  # no gradient below the free nats


# ---- resets and context --------------------------------------------------------------------------


def changed(batch, **arrays):
  return batch._replace(**arrays)


def poke(x, index, value=0.7):
  """A copy of x (rows, time, ...) with other values at the time indices."""
  x = np.array(x)
  x[:, index] = (
    (x[:, index] + 1) % 8
    if x.dtype.kind == "i"
    else ~x[:, index]
    if x.dtype == bool
    else x[:, index] + value
  )
  return x


def same(a, b):
  return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b)))


def test_first_erases_state_and_action(full):
  batch = make_batch()
  for at in (1, 3):
    first = np.zeros_like(batch.first)
    first[:, at] = True
    start = changed(batch, first=first)
    before = list(range(at))
    other = changed(
      start,
      deter=poke(batch.deter, 0),
      stoch=poke(batch.stoch, 0),
      action=poke(batch.action, before),
      obs=poke(batch.obs, before),
    )
    a, b = (
      jax.tree.map(lambda x: x[at - 1 :], full.observe(full.params, x, KEY)) for x in (start, other)
    )
    assert same(a, b)
  no_reset = jax.tree.map(
    lambda x: x[at - 1 :],
    full.observe(full.params, changed(other, first=np.zeros_like(batch.first)), KEY),
  )
  assert not same(no_reset, b)


def test_first_state_of_an_episode_is_the_core_of_zeros(full):
  batch = make_batch()
  deter, _, _ = full.observe(full.params, changed(batch, first=np.ones_like(batch.first)), KEY)
  zeros = full.agent._core(
    full.params, jnp.zeros((1, 128)), jnp.zeros((1, 64)), jnp.zeros((1, ACT))
  )
  np.testing.assert_allclose(
    deter, np.broadcast_to(zeros, deter.shape), atol=1e-6
  )  # another program, same float32 sums


def test_only_latent_and_action_of_the_context_count(full):
  batch = make_batch(ends=True)
  out = lambda b: full(full.params, full.slow, b)
  base = out(batch)
  quiet = changed(
    batch,
    **{
      n: poke(getattr(batch, n), 0)
      for n in ("obs", "reward", "first", "last", "terminal", "demo", "has_demo")
    },
    deter=poke(batch.deter, slice(1, None)),
    stoch=poke(batch.stoch, slice(1, None)),
  )
  assert same(base, out(quiet))
  for name in ("deter", "stoch", "action"):
    assert not same(base, out(changed(batch, **{name: poke(getattr(batch, name), 0)}))), name


# ---- gradient routes -----------------------------------------------------------------------------

ROUTES = {
  "dyn": {"enc", "dyn"},
  "rep": {"enc", "dyn"},
  "rec": {"enc", "dyn", "dec"},
  "rew": {"enc", "dyn", "rew"},
  "con": {"enc", "dyn", "con"},
  "policy": {"pol"},
  "value": {"val"},
  "repval": {"enc", "dyn", "val"},
  "clone": {"pol"},
}


@pytest.mark.parametrize("starts", ["full", "tail"])
def test_each_loss_reaches_exactly_its_modules(starts, request):
  fixture = request.getfixturevalue(starts)
  jac, _, metrics, _, _, _ = fixture(fixture.params, fixture.slow, make_batch())
  assert (
    metrics["loss/dyn"] > 1.0 and metrics["loss/rep"] > 1.0
  )  # else the free nats hide the route
  assert {term: fixture.reached(jac, term) for term in TERMS} == ROUTES


def test_dyn_and_rep_stop_one_side(full):
  batch = make_batch()
  batch = changed(
    batch, first=np.ones_like(batch.first)
  )  # no step sees an earlier posterior, so only the direct route is left
  jac, _, metrics, _, _, _ = full(full.params, full.slow, batch)
  assert metrics["loss/dyn"] > 1.0
  touched = lambda term: {
    n
    for n, t in jac["dyn"].items()
    if any(np.any(np.asarray(x[TERMS.index(term)]) != 0) for x in jax.tree.leaves(t))
  }
  core = {"in_deter", "in_stoch", "in_action", "core_hidden", "core_norm", "core_gates"}
  assert touched("dyn") - core == {"prior_mlp", "prior_out"} and "core_gates" in touched("dyn")
  assert touched("rep") - core == {"post_hidden", "post_out"} and "core_gates" in touched("rep")
  assert "enc" not in full.reached(jac, "dyn") and "enc" in full.reached(jac, "rep")


# ---- the loss against NumPy ----------------------------------------------------------------------


def np_two_hot_ce(logits, x, bins):
  """Cross-entropy (...) of logits (..., bins) with the two-hot of x (...), by a loop."""
  out = np.zeros(x.shape)
  for at in np.ndindex(x.shape):
    row, target = logits[at].astype(np.float64), np.clip(x[at], bins[0], bins[-1])
    logp = row - row.max() - np.log(np.sum(np.exp(row - row.max())))
    high = min(max(1, int(np.sum(bins <= target))), len(bins) - 1)
    weight = (target - bins[high - 1]) / (bins[high] - bins[high - 1])
    out[at] = -(1 - weight) * logp[high - 1] - weight * logp[high]
  return out


def np_mean(logits, bins):
  e = np.exp(logits.astype(np.float64) - logits.max(-1, keepdims=True))
  return (e / e.sum(-1, keepdims=True)) @ bins


@pytest.mark.parametrize("starts", ["full", "tail"])
def test_loss_equals_numpy(starts, request):
  fixture = request.getfixturevalue(starts)
  agent, batch, weights = fixture.agent, make_batch(ends=True), Weights(0.3, 0.7)
  # peaked heads keep the predictions small against the bins' 5e8, so that float32 and float64 agree
  symlog_bins = np.sign(agent.bins) * np.log1p(np.abs(np.asarray(agent.bins)))
  peak = lambda tree, at: {
    **tree,
    "out": {
      **tree["out"],
      "bias": tree["out"]["bias"] - 4 * jnp.abs(jnp.asarray(symlog_bins) - at),
    },
  }
  params = {
    **fixture.params,
    "rew": peak(fixture.params["rew"], 0.4),
    "val": peak(fixture.params["val"], 1.0),
  }
  slow = peak(fixture.slow, 1.3)
  range_ = (-1.0, 3.0)
  _, total, metrics, new_range, _, _ = fixture(params, slow, batch, range_, weights)
  key_observe, key_imagine = jax.random.split(KEY)
  deter, stoch, post = fixture.observe(params, batch, key_observe)
  head = lambda name, d, s, p=None: getattr(agent, name).apply(
    {"params": params[name] if p is None else p}, d, s
  )
  bins = np.asarray(agent.bins, np.float64)
  time = lambda x: np.asarray(x)[:, 1:].swapaxes(0, 1)
  obs, reward, last, terminal, demo, has = (
    time(x)
    for x in (batch.obs, batch.reward, batch.last, batch.terminal, batch.demo, batch.has_demo)
  )
  want = {}

  prior = agent.dyn.apply({"params": params["dyn"]}, deter, method="prior")
  want["dyn"] = want["rep"] = np.mean(np.maximum(1.0, rssm.kl(post, prior)))
  want["rec"] = np.mean(
    np.sum((np.asarray(head("dec", deter, stoch)) - np.sign(obs) * np.log1p(np.abs(obs))) ** 2, -1)
  )
  want["rew"] = np.mean(np_two_hot_ce(np.asarray(head("rew", deter, stoch)), reward, bins))
  p_con, target = (
    1 / (1 + np.exp(-np.asarray(head("con", deter, stoch), np.float64)[..., 0])),
    (1 - terminal) * GAMMA,
  )
  want["con"] = np.mean(-target * np.log(p_con) - (1 - target) * np.log(1 - p_con))

  starts = agent.config.last_starts or LENGTH
  flat = lambda x: x[LENGTH - starts :].reshape((starts * ROWS, -1))
  i_deter, i_stoch, action = quick.jit(agent.imagine, static_argnums=4)(
    params, flat(deter), flat(stoch), key_imagine, IMAGINE
  )
  r, v_logits = (
    np_mean(np.asarray(head("rew", i_deter, i_stoch)), bins),
    np.asarray(head("val", i_deter, i_stoch)),
  )
  c = 1 / (1 + np.exp(-np.asarray(head("con", i_deter, i_stoch), np.float64)[..., 0]))
  v, w = np_mean(v_logits, bins), np_mean(np.asarray(head("val", i_deter, i_stoch, slow)), bins)
  ret = np.zeros((IMAGINE, starts * ROWS))
  after = v[-1]
  for i in reversed(range(IMAGINE)):
    after = ret[i] = r[i + 1] + c[i + 1] * (0.05 * v[i + 1] + 0.95 * after)
  omega = np.stack([np.prod(c[: i + 1], 0) for i in range(IMAGINE)])
  low_high = 0.99 * np.array(range_) + 0.01 * np.percentile(ret, [5, 95])
  adv = (ret - v[:-1]) / max(1.0, low_high[1] - low_high[0])
  mean, std = (np.asarray(x, np.float64) for x in head("pol", i_deter[:-1], i_stoch[:-1]))
  mean, std = np.tanh(mean), 0.1 + 0.9 / (1 + np.exp(-std - 2))
  logp = np.sum(
    -0.5 * ((np.asarray(action)[:-1] - mean) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi), -1
  )
  entropy = np.sum(0.5 * np.log(2 * np.pi * np.e * std**2), -1)
  want["policy"] = np.mean(-omega * (logp * adv + 3e-4 * entropy))
  want["value"] = np.mean(
    omega * (np_two_hot_ce(v_logits[:-1], ret, bins) + np_two_hot_ce(v_logits[:-1], w[:-1], bins))
  )

  reward, last, terminal, boot = (
    *(x[LENGTH - starts :] for x in (reward, last, terminal)),
    ret[0].reshape(starts, ROWS),
  )
  after, targets = boot[-1], np.zeros((starts - 1, ROWS))
  for t in reversed(range(starts - 1)):
    lam = 0.95 * (1 - last[t + 1])
    after = targets[t] = reward[t + 1] + (1 - terminal[t + 1]) * GAMMA * (
      (1 - lam) * boot[t + 1] + lam * after
    )
  d, s = deter[LENGTH - starts :][:-1], stoch[LENGTH - starts :][:-1]
  logits, slow_value = (
    np.asarray(head("val", d, s)),
    np_mean(np.asarray(head("val", d, s, slow)), bins),
  )
  want["repval"] = np.mean(
    (1 - last[:-1])
    * (np_two_hot_ce(logits, targets, bins) + np_two_hot_ce(logits, slow_value, bins))
  )

  mean, std = (np.asarray(x, np.float64) for x in head("pol", deter, stoch))
  mean, std = np.tanh(mean), 0.1 + 0.9 / (1 + np.exp(-std - 2))
  kl = np.sum(np.log(std / 0.2) + (0.2**2 + (demo - mean) ** 2) / (2 * std**2) - 0.5, -1)
  want["clone"] = kl[has].mean()

  assert (
    np.abs(adv).max() > 0.01 and np.abs(w - v).max() > 0.1 and last.any()
  )  # the case is not trivial
  np.testing.assert_allclose(
    new_range, low_high, rtol=1e-4
  )  # float32 expectations over bins up to 5e8
  for name in TERMS:
    np.testing.assert_allclose(
      metrics[f"loss/{name}"], want[name], rtol=1e-3, atol=1e-5, err_msg=name
    )  # the same expectations
  scales = dict(dyn=1, rep=0.1, rec=1, rew=1, con=1, policy=0.7, value=1, repval=0.3, clone=0.3)
  np.testing.assert_allclose(
    total, sum(scales[k] * float(metrics[f"loss/{k}"]) for k in TERMS), rtol=1e-5
  )  # float32 sum of 9


@pytest.mark.parametrize("starts", [pytest.param(0, marks=pytest.mark.slow), 2])
def test_both_forms_of_the_behaviour_losses_agree(starts):
  """State by state (CPU) against large products: value, metrics, and the gradient under unequal
  weights of policy and the rest.
  """
  out = []
  for stepwise in (True, False):
    agent = Agent(DreamerConfig(**SMALL, last_starts=starts), OBS, ACT, stepwise=stepwise)
    params = shake(quick.jit(agent.init)(jax.random.key(0)).params)
    # small biases on the two-hot heads: predictions stay near 1, not near the bins' 5e8
    symlog_bins = np.sign(agent.bins) * np.log1p(np.abs(np.asarray(agent.bins)))
    for name in ("rew", "val"):
      params[name]["out"]["bias"] -= 4 * jnp.abs(jnp.asarray(symlog_bins) - 0.5)
    slow = jax.tree.map(lambda x: 0.9 * x, params["val"])
    grad = quick.jit(jax.value_and_grad(agent.loss, has_aux=True))
    out.append(
      grad(params, slow, jnp.array([-1.0, 3.0]), make_batch(ends=True), KEY, Weights(0.0, 0.6))
    )
  ((total, (metrics, range_, _, _)), grads), ((total_b, (metrics_b, range_b, _, _)), grads_b) = out
  np.testing.assert_allclose(total, total_b, rtol=1e-5)  # order of float32 sums
  np.testing.assert_allclose(range_, range_b, rtol=1e-4)
  assert metrics.keys() == metrics_b.keys()
  for name in metrics:
    np.testing.assert_allclose(
      metrics[name], metrics_b[name], rtol=1e-3, atol=1e-5, err_msg=name
    )  # two-hot means sum bins up to 5e8
  for (path, a), b in zip(jax.tree.leaves_with_path(grads), jax.tree.leaves(grads_b)):
    assert np.any(np.asarray(b) != 0) or "kernel" not in jax.tree_util.keystr(path)
    np.testing.assert_allclose(
      a, b, atol=2e-4 * float(np.max(np.abs(b))) + 1e-7, err_msg=jax.tree_util.keystr(path)
    )


# ---- updates -------------------------------------------------------------------------------------


def updater(clone_std):
  """Agent, its compiled update (weights always traced: one program) and a fresh state."""
  agent = Agent(DreamerConfig(**SMALL), OBS, ACT, clone_std)
  jitted = quick.jit(agent.update)
  update = lambda state, batch, key, weights=Weights(): jitted(
    state, batch, key, jax.tree.map(jnp.float32, weights)
  )
  return agent, update, quick.jit(agent.init)(jax.random.key(0))


@pytest.fixture(scope="module")
def plain():
  return updater(None)


@pytest.fixture(scope="module")
def cloning():
  return updater(0.2)


def gap(a, b):
  """Largest absolute difference over all leaves."""
  return max(
    float(np.max(np.abs(np.asarray(x, np.float64) - np.asarray(y, np.float64))))
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b))
  )


def test_first_update_only_moves_the_moments(plain):
  _, update, state = plain
  new, metrics, (deter, stoch) = update(state, make_batch(), KEY)
  assert same(new.params, state.params)
  assert metrics["tar"] == 0.0 and np.all(np.asarray(new.range) == 0.0)
  assert gap(new.slow, state.slow) < 1e-6  # 0.98 + 0.02 of the same number, rounded
  moved = {k for k, v in new.opt[1].nu.items() if gap(v, jax.tree.map(jnp.zeros_like, v)) > 0}
  assert moved == set(state.params) and new.updates == 1
  assert deter.shape == (ROWS, LENGTH, 128) and stoch.shape == (ROWS, LENGTH, 8)
  after, _, _ = update(new, make_batch(), KEY)
  assert all(gap(after.params[k], state.params[k]) > 0 for k in state.params)


def test_slow_critic_follows(plain):
  _, update, state = plain
  state = state._replace(
    params=shake(state.params), slow=shake(state.slow, seed=1), updates=jnp.int32(5)
  )
  new, _, _ = update(state, make_batch(), KEY)
  want = jax.tree.map(lambda s, p: 0.98 * s + 0.02 * p, state.slow, new.params["val"])
  assert gap(new.slow, want) < 1e-6  # float32 rounding of numbers near 1
  assert gap(new.slow, state.slow) > 1e-3


def test_learning_rate_factor_scales_the_step(plain):
  _, update, state = plain
  state, _, _ = update(state, make_batch(), KEY)
  full_step, _, _ = update(state, make_batch(1), KEY, Weights(lr=1.0))
  half_step, _, _ = update(state, make_batch(1), KEY, Weights(lr=0.5))
  middle = jax.tree.map(lambda a, b: (a + b) / 2, state.params, full_step.params)
  assert gap(half_step.params, middle) < 1e-6  # float32 rounding of gains near 1
  assert gap(full_step.params, half_step.params) > 1e-6


@pytest.mark.slow
def test_policy_lr_scales_the_steps_of_the_policy_alone(plain):
  agent, update, state = plain
  slow = Agent(replace(agent.config, policy_lr=0.25), agent.obs_size, agent.act_size)
  assert agent.config.policy_lr == 1.0
  state, _, _ = update(state, make_batch(), KEY)
  full, _, _ = update(state, make_batch(1), KEY)
  quarter, _, _ = quick.jit(slow.update)(
    state, make_batch(1), KEY, jax.tree.map(jnp.float32, Weights())
  )
  wanted = jax.tree.map(lambda a, b: 0.75 * a + 0.25 * b, state.params["pol"], full.params["pol"])
  assert gap(quarter.params["pol"], wanted) < 1e-6  # float32 rounding of gains near 1
  assert gap(full.params["pol"], quarter.params["pol"]) > 1e-6
  rest = lambda tree: {k: v for k, v in tree.items() if k != "pol"}
  assert gap(rest(quarter.params), rest(full.params)) < 1e-6


def test_model_lr_of_zero_leaves_the_model_and_the_heads_learn(plain):
  agent, update, state = plain
  still = Agent(replace(agent.config, model_lr=0.0), agent.obs_size, agent.act_size)
  state, _, _ = update(state, make_batch(), KEY)
  full, _, _ = update(state, make_batch(1), KEY)
  heads, _, _ = quick.jit(still.update)(
    state, make_batch(1), KEY, jax.tree.map(jnp.float32, Weights())
  )
  for name in ("enc", "dyn", "dec"):
    assert (
      gap(heads.params[name], state.params[name]) == 0 < gap(full.params[name], state.params[name])
    )
  tenth = Agent(replace(agent.config, model_lr=0.1), agent.obs_size, agent.act_size)
  slow, _, _ = quick.jit(tenth.update)(
    state, make_batch(1), KEY, jax.tree.map(jnp.float32, Weights())
  )
  wanted = jax.tree.map(lambda a, b: 0.9 * a + 0.1 * b, state.params["dyn"], full.params["dyn"])
  assert gap(slow.params["dyn"], wanted) < 1e-6 < gap(slow.params["dyn"], full.params["dyn"])
  rest = lambda tree: {k: v for k, v in tree.items() if k not in ("enc", "dyn", "dec")}
  assert gap(rest(heads.params), rest(full.params)) < 1e-6  # float32 rounding of gains near 1
  assert gap(heads.params["rew"], state.params["rew"]) > 1e-6


def trained(update, state, steps=3, **kwargs):
  for i in range(steps):
    state, metrics, _ = update(state, make_batch(i), jax.random.fold_in(KEY, i), **kwargs)
  return state, metrics


@pytest.mark.slow
def test_clone_weight_of_zero_is_no_cloning(plain, cloning):
  a, _ = trained(plain[1], plain[2])
  b, _ = trained(cloning[1], cloning[2], weights=Weights(clone=0.0))
  lr = 4e-5 * 2 / 20  # of the third update
  assert gap(a.opt[1].nu, b.opt[1].nu) < 1e-6 * gap(
    a.opt[1].nu, jax.tree.map(jnp.zeros_like, a.opt[1].nu)
  )  # two programs, one float32 sum
  far = [
    np.mean(np.abs(np.asarray(x) - np.asarray(y)) > 0.01 * lr)
    for x, y in zip(jax.tree.leaves(a.params), jax.tree.leaves(b.params))
  ]
  assert (
    max(far) < 0.01 and gap(a.params, b.params) < 4 * lr
  )  # LaProp steps by a gradient's sign: rounding may turn one near 0


def test_cloning_moves_the_policy_alone(plain, cloning):
  a, _ = trained(plain[1], plain[2], steps=1)
  b, _ = trained(cloning[1], cloning[2], steps=1, weights=Weights(clone=1.0))
  for k in a.params:
    size = gap(b.opt[1].nu[k], jax.tree.map(jnp.zeros_like, b.opt[1].nu[k]))
    assert (gap(a.opt[1].nu[k], b.opt[1].nu[k]) > 0.9 * size) == (k == "pol"), (
      k
    )  # with no return yet, the policy's own gradient is tiny


def test_clone_term_without_labels_is_zero(cloning):
  _, update, state = cloning
  batch = make_batch()
  _, metrics, _ = update(
    state, batch._replace(has_demo=np.zeros_like(batch.has_demo)), KEY, Weights(clone=1.0)
  )
  assert metrics["loss/clone"] == 0.0


def test_anchor_is_the_likelihood_of_the_actions_taken_and_moves_the_mean_alone(plain):
  """-log N(a; mean, std) by a loop, without the last states of episodes; its gradient reaches the
  policy's mean, not its deviation, and nothing else.
  """
  agent, _, state = plain
  held = Agent(replace(agent.config, anchor=0.5, min_std=0.05), agent.obs_size, agent.act_size)
  params, batch = shake(state.params), make_batch(ends=True)
  loose = Agent(replace(held.config, anchor=0.0), agent.obs_size, agent.act_size)
  grad = lambda a: quick.jit(jax.value_and_grad(a.loss, has_aux=True))(
    params, state.slow, jnp.zeros(2), batch, KEY
  )
  ((total, (metrics, _, _, _)), with_it), ((without, (rest, _, _, _)), plain_grads) = (
    grad(held),
    grad(loose),
  )
  assert "loss/anchor" not in rest
  np.testing.assert_allclose(
    total - without, 0.5 * metrics["loss/anchor"], rtol=1e-3
  )  # difference of two float32 sums
  deter, stoch, _ = held.observe(params, batch, jax.random.split(KEY)[0])
  raw = [np.asarray(x, np.float64) for x in held.pol.apply({"params": params["pol"]}, deter, stoch)]
  mean, std = np.tanh(raw[0]), 0.05 + 0.95 / (1 + np.exp(-raw[1] - 2))
  action, last = (np.asarray(x)[:, 1:].swapaxes(0, 1) for x in (batch.action, batch.last))
  terms = [
    sum(
      0.5 * ((action[t, b, i] - mean[t, b, i]) / std[t, b, i]) ** 2
      + np.log(std[t, b, i])
      + 0.5 * np.log(2 * np.pi)
      for i in range(ACT)
    )
    for t in range(LENGTH)
    for b in range(ROWS)
    if not last[t, b]
  ]
  assert last.any() and len(terms) < LENGTH * ROWS
  np.testing.assert_allclose(
    metrics["loss/anchor"], np.mean(terms), rtol=1e-4
  )  # float32 through the network
  for name in params:
    same_ = gap(with_it[name], plain_grads[name]) < 1e-5
    assert same_ == (name != "pol"), name
  assert (
    gap(with_it["pol"]["std"], plain_grads["pol"]["std"])
    < 1e-6
    < gap(with_it["pol"]["mean"], plain_grads["pol"]["mean"])
  )


def test_least_deviation_of_the_actions(plain):
  """With raw deviations far below 0 the actions scatter by min_std, in acting as in the dream; far
  above it by max_std.
  """
  agent, _, state = plain
  low, high = nets.normal(jnp.zeros(2), jnp.array([-50.0, 50.0]), 0.02, 0.3)[1]
  np.testing.assert_allclose([low, high], [0.02, 0.3], rtol=1e-6)
  params = {
    **state.params,
    "pol": {
      **state.params["pol"],
      "std": {"kernel": 0.0 * state.params["pol"]["std"]["kernel"], "bias": jnp.full(ACT, -50.0)},
    },
  }
  for least in (0.1, 0.02):
    own = Agent(replace(agent.config, min_std=least), agent.obs_size, agent.act_size)
    draw = lambda key, fixed: own.act(params, own.carry(), jnp.zeros(OBS), key, fixed)[1]
    keys = jax.random.split(KEY, 400)
    sampled, fixed = (np.asarray(jax.vmap(draw, (0, None))(keys, f)) for f in (False, True))
    assert 0.8 * least < np.std(sampled - fixed) < 1.2 * least  # 400 draws: 3.5 % standard error
    states = jnp.zeros((400, own.size.deter)), jnp.zeros((400, own.stoch_size))
    noise = jax.random.normal(KEY, (400, ACT))
    np.testing.assert_allclose(
      own.choose(params, *states, noise) - own.choose(params, *states, 0 * noise),
      least * noise,
      atol=1e-6,
    )  # float32


@pytest.mark.slow
def test_vmap_over_seeds_equals_a_loop(plain):
  agent, update, _ = plain
  keys = jax.random.split(jax.random.key(3), 2)
  states = quick.jit(jax.vmap(agent.init))(keys)
  batches = jax.tree.map(lambda *x: jnp.stack(x), make_batch(1), make_batch(2))
  many, metrics, latents = quick.jit(jax.vmap(agent.update))(states, batches, keys)
  for i in range(2):
    one, one_metrics, one_latents = update(
      jax.tree.map(lambda x: x[i], states), make_batch(i + 1), keys[i]
    )
    got = jax.tree.map(lambda x: x[i], many)
    for k in one_metrics:
      np.testing.assert_allclose(
        metrics[k][i], one_metrics[k], rtol=1e-4, atol=1e-6, err_msg=k
      )  # float32 sums in another order
    np.testing.assert_array_equal(latents[1][i], one_latents[1])
    np.testing.assert_allclose(
      latents[0][i], one_latents[0], atol=1e-5
    )  # the same sums over 4 steps
    for a, b in zip(jax.tree.leaves(got.opt[1].nu), jax.tree.leaves(one.opt[1].nu)):
      np.testing.assert_allclose(
        a, b, rtol=1e-3, atol=1e-3 * float(np.abs(b).max()) + 1e-12
      )  # the same sums, squared


# ---- acting, imagination, prediction -------------------------------------------------------------


def test_act_is_one_step_of_observe(full):
  batch, agent, params = make_batch(), full.agent, full.params
  deters, _, logits = full.observe(params, batch, KEY)
  row, key = 1, jax.random.key(5)
  carry = agent.carry()._replace(
    deter=batch.deter[row, 0], stoch=agent.hot(batch.stoch[row, 0]), action=batch.action[row, 0]
  )
  new, action = quick.jit(agent.act)(params, carry, batch.obs[row, 1], key)
  np.testing.assert_allclose(
    new.deter, deters[0, row], atol=1e-5
  )  # float32 sums of 200 in another order
  key_z, key_a = jax.random.split(key)
  stoch = rssm.sample(logits[0, row], jax.random.uniform(key_z, (1, 8))[0]).reshape(-1)
  np.testing.assert_allclose(new.stoch, stoch, atol=1e-5)  # one-hot, up to p - p
  mean, std = nets.normal(*agent.pol.apply({"params": params["pol"]}, new.deter, new.stoch))
  np.testing.assert_allclose(
    action, mean + std * jax.random.normal(key_a, (1, ACT))[0], atol=1e-4
  )  # float32 through the policy
  np.testing.assert_array_equal(new.action, action)
  _, chosen = agent.act(params, carry, batch.obs[row, 1], key, deterministic=True)
  np.testing.assert_allclose(chosen, mean, atol=1e-4)  # float32 through the policy


def python_steps(agent, params, deter, stoch, uniform, choose):
  """States of a loop of core and prior; choose(i, deter, stoch) gives the action."""
  states, actions = [], []
  for i, u in enumerate(uniform):
    actions.append(choose(i, deter, stoch))
    deter = agent._core(params, deter, stoch, actions[-1])
    stoch = rssm.sample(
      agent.dyn.apply({"params": params["dyn"]}, deter, method="prior"), u
    ).reshape(len(deter), -1)
    states.append((deter, stoch))
  return [jnp.stack(x) for x in zip(*states)] + [jnp.stack(actions)]


def start_rows(agent):
  batch = make_batch()
  return jnp.asarray(batch.deter[:, 0]), agent.hot(batch.stoch[:, 0])


def test_open_loop_equals_a_loop(full):
  agent, params, steps = full.agent, full.params, 5
  deter, stoch = start_rows(agent)
  actions = jnp.asarray(np.random.default_rng(0).standard_normal((steps, ROWS, ACT)), jnp.float32)
  obs, reward = quick.jit(agent.open_loop)(params, deter, stoch, actions, KEY)
  deters, stochs, _ = python_steps(
    agent,
    params,
    deter,
    stoch,
    jax.random.uniform(KEY, (steps, ROWS, 8)),
    lambda i, d, s: actions[i],
  )
  raw = np.asarray(agent.dec.apply({"params": params["dec"]}, deters, stochs))
  np.testing.assert_allclose(
    obs, np.sign(raw) * np.expm1(np.abs(raw)), rtol=1e-3, atol=1e-4
  )  # float32 over 5 steps, then exp
  want = nets.two_hot_mean(agent.rew.apply({"params": params["rew"]}, deters, stochs), agent.bins)
  np.testing.assert_allclose(reward, want, rtol=1e-3)  # softmax of logits that differ by 1e-4


def test_imagine_equals_a_loop_and_has_no_gradient(full):
  agent, params = full.agent, full.params
  deter, stoch = start_rows(agent)
  run = lambda params, deter, stoch: agent.imagine(params, deter, stoch, KEY, IMAGINE)
  got = quick.jit(run)(params, deter, stoch)
  key_z, key_a = jax.random.split(KEY)
  noise = jax.random.normal(key_a, (IMAGINE + 1, ROWS, ACT))

  def choose(i, d, s):
    mean, std = nets.normal(*agent.pol.apply({"params": params["pol"]}, d, s))
    return mean + std * noise[i]

  deters, stochs, actions = python_steps(
    agent, params, deter, stoch, jax.random.uniform(key_z, (IMAGINE, ROWS, 8)), choose
  )
  last = choose(IMAGINE, deters[-1], stochs[-1])
  np.testing.assert_allclose(
    got[0], jnp.concatenate([deter[None], deters]), atol=1e-4
  )  # float32 over 3 steps
  np.testing.assert_allclose(
    got[1], jnp.concatenate([stoch[None], stochs]), atol=1e-4
  )  # one-hot, up to p - p
  np.testing.assert_allclose(
    got[2], jnp.concatenate([actions, last[None]]), atol=1e-3
  )  # float32 through the policy
  grads = quick.jit(jax.grad(lambda *x: sum(jnp.sum(y) for y in run(*x)), argnums=(0, 1, 2)))(
    params, deter, stoch
  )
  assert all(np.all(np.asarray(g) == 0) for g in jax.tree.leaves(grads))
