"""Residuals against a plain loop over starts and steps, with a stub agent whose predictions are
linear, and once with a real one.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl import envs
from mjx_cl.errors import UserError
from mjx_cl.rollout.monitor import GROUPS as GROUPS_SEEN
from mjx_cl.rollout.monitor import Monitor, watched
from mjx_cl.rollout.scan import Row
from mjx_cl.types import Spec, Var

GROUPS, MEMBERS, OBS, ACT, DETER, STOCH, CLASSES = 2, 2, 3, 2, 4, 2, 3
PAST = np.random.default_rng(0)
A, B, E, C, K = (
  0.5 * PAST.normal(size=s)
  for s in ((DETER, DETER), (ACT, DETER), (STOCH * CLASSES, DETER), (DETER, OBS + 1), (DETER, ACT))
)
KEYS = jax.random.split(jax.random.key(0), GROUPS)


class Size(NamedTuple):
  deter: int = DETER
  stoch: int = STOCH


class Stub:
  """d' = d A + a B + z E; observation and reward = gain d' C; the policy's action is d K. Every
  group has its own gain.
  """

  size, obs_size, act_size = Size(), OBS, ACT
  params = {"gain": jnp.array([1.0, -2.0])}

  def hot(self, index):
    return jax.nn.one_hot(index, CLASSES).reshape(index.shape[:-1] + (STOCH * CLASSES,))

  def open_loop(self, params, deter, stoch, actions, key):
    out = []
    for action in actions:
      deter = deter @ A + action @ B + stoch @ E
      out.append(params["gain"] * deter @ C)
    return jnp.stack(out)[..., :-1], jnp.stack(out)[..., -1]

  stoch_size = STOCH * CLASSES

  def beliefs(self, params, deter, obs):
    """Posterior logits move with the observation, prior logits with the state."""
    shape = deter.shape[:-1] + (STOCH, CLASSES)
    return (jnp.tile(obs, 2).reshape(shape), jnp.tile(deter[..., :CLASSES], 2).reshape(shape))

  def dream(self, params, deter, stoch, steps, key):
    out = []
    for _ in range(steps):
      deter = deter @ A + (deter @ K) @ B + stoch @ E
      out.append(params["gain"] * deter @ C)
    return jnp.stack(out)[..., :-1], jnp.stack(out)[..., -1]


def make_rows(steps, resets=0.1, seed=1, agent=Stub):
  """Random rows; an end of an episode is half of the time a termination, half a truncation."""
  rng = np.random.default_rng(seed)
  shape = (steps, GROUPS, MEMBERS)
  normal = lambda *more: jnp.asarray(rng.normal(size=shape + more), jnp.float32)
  done, kind = rng.random(shape) < resets, rng.random(shape) < 0.5
  stoch = jnp.asarray(rng.integers(0, CLASSES, shape + (agent.size.stoch,)))
  return Row(
    normal(agent.obs_size),
    None,
    None,
    normal(agent.act_size),
    normal(agent.size.deter),
    stoch,
    normal(),
    None,
    normal(agent.obs_size),
    jnp.asarray(done & kind),
    jnp.asarray(done & ~kind),
    None,
    None,
    None,
    None,
  )


def part(rows, start, stop):
  return jax.tree.map(lambda x: x[start:stop], rows)


def slow(rows, n, least, form, actions):
  """Residuals of one stream in NumPy and float64, with a loop over rows and over the steps of each
  window: (T, OBS + 1), nan where invalid.
  """
  total = len(rows.reward)
  done = rows.terminated | rows.truncated
  truth = np.concatenate([rows.final_obs, rows.reward[:, None]], -1)
  predicted = {}
  for s in range(total):
    deter, hot = rows.deter[s], np.eye(CLASSES)[rows.stoch[s]].reshape(-1)
    for i in range(min(n, total - s)):
      action = rows.action[s + i] if actions == "recorded" else deter @ K
      deter = deter @ A + action @ B + hot @ E
      predicted[s, s + i] = deter @ C
  out = np.full((total, OBS + 1), np.nan)
  for t in range(n - 1, total):  # row in which the residual is known
    pairs = (
      [(t - n + 1, t - n + 1 + i) for i in range(n)]
      if form == "paper"
      else [(t - i, t) for i in range(n)]
    )
    errors = [
      np.abs(predicted[s, k] - truth[k]) for s, k in pairs if not done[s:k].any()
    ]  # an end at k itself still counts
    if len(errors) >= least:
      out[t] = np.mean(errors, 0)
  return out


def expect(rows, n, least, form, actions):
  """`slow` for every stream, (T, GROUPS, MEMBERS, OBS + 1)."""
  out = np.zeros(rows.reward.shape + (OBS + 1,))
  for g in range(GROUPS):
    for m in range(MEMBERS):
      one = Row(*(None if x is None else np.asarray(x)[:, g, m] for x in rows))
      gain = float(Stub.params["gain"][g])
      one = one._replace(deter=one.deter.astype(float))
      one = one._replace(
        final_obs=one.final_obs / gain, reward=one.reward / gain
      )  # |g p - x| = |g| |p - x / g|
      scaled = slow(one, n, least, form, actions)
      out[:, g, m] = abs(gain) * scaled
  return out


def check(residual, want):
  """OPR, RPR, variables and validity against (T, ..., OBS + 1); float32 sums of a few numbers of
  size 1 to 10.
  """
  close = dict(rtol=2e-5, atol=2e-5)
  np.testing.assert_array_equal(residual.valid, np.isfinite(want).all(-1))
  np.testing.assert_allclose(residual.variables, want[..., :-1], **close)
  np.testing.assert_allclose(residual.rpr, want[..., -1], **close)
  np.testing.assert_allclose(residual.opr, want[..., :-1].mean(-1), **close)


@pytest.mark.parametrize("actions", ["recorded", "policy"])
@pytest.mark.parametrize("form", ["paper", "streaming"])
def test_residuals_equal_the_loop_over_two_chunks(form, actions):
  n, least, rows = 4, 2, make_rows(36)
  monitor = Monitor(Stub(), n, form, actions, least)
  update = jax.jit(monitor.update)
  want = expect(rows, n, least, form, actions)
  assert 0 < np.isnan(want[n - 1 :]).mean() < 0.5  # resets make some rows invalid, and not most
  history, whole = update(Stub.params, monitor.init(GROUPS, MEMBERS), rows, KEYS)
  check(whole, want)
  middle, first = update(Stub.params, monitor.init(GROUPS, MEMBERS), part(rows, 0, 18), KEYS)
  end, second = update(Stub.params, middle, part(rows, 18, 36), KEYS)
  check(jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second), want)
  for a, b in zip(end, history):  # both hold the last n - 1 rows
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("form", ["paper", "streaming"])
def test_defaults_ask_for_five_of_fifteen_steps(form):
  """One reset, at row 20: windows that it leaves 4 steps or fewer are invalid, those with 5 or more
  are not.
  """
  rows = make_rows(60, resets=0.0)
  rows = rows._replace(truncated=rows.truncated.at[20].set(True))
  monitor = Monitor(Stub(), form=form)
  residual = jax.jit(monitor.update)(Stub.params, monitor.init(GROUPS, MEMBERS), rows, KEYS)[1]
  check(residual, expect(rows, 15, 5, form, "recorded"))
  # paper: the start of row t is t - 14 and keeps rows up to 20, 35 - t of them; from start 21 on it
  # is whole again
  # streaming: row t keeps the starts after 20, t - 20 of them
  bad = set(range(31, 35)) if form == "paper" else set(range(21, 25))
  want = [t >= 14 and t not in bad for t in range(60)]
  assert (np.asarray(residual.valid) == np.array(want)[:, None, None]).all()


@pytest.mark.parametrize("form", ["paper", "streaming"])
def test_the_first_rows_of_a_run_are_invalid(form):
  monitor = Monitor(Stub(), n=6, form=form, least=1)
  residual = jax.jit(monitor.update)(
    Stub.params, monitor.init(GROUPS, MEMBERS), make_rows(8, resets=0.0), KEYS
  )[1]
  assert (np.asarray(residual.valid) == (np.arange(8) >= 5)[:, None, None]).all()
  assert (
    np.isnan(residual.opr[:5]).all()
    and np.isnan(residual.variables[:5]).all()
    and np.isfinite(residual.rpr[5:]).all()
  )


def test_one_step_ahead_needs_no_history():
  rows = make_rows(5)
  for form in ("paper", "streaming"):
    monitor = Monitor(Stub(), n=1, form=form, least=1)
    update = jax.jit(monitor.update)
    check(
      update(Stub.params, monitor.init(GROUPS, MEMBERS), rows, KEYS)[1],
      expect(rows, 1, 1, form, "recorded"),
    )


def test_innovations_are_signed_errors_of_one_step():
  """In the row of the arrival itself, over two chunks, resets or not; without them a residual has
  no such field.
  """
  rows = make_rows(40)
  monitor = Monitor(Stub(), 5, least=2, signed=True)
  history, innovation = monitor.init(GROUPS, MEMBERS), []
  for at in (0, 20):
    history, seen = monitor.update(Stub.params, history, part(rows, at, at + 20), KEYS)
    innovation.append(np.asarray(seen.innovation))
  innovation, r = np.concatenate(innovation), jax.tree.map(np.asarray, rows)
  hot = np.eye(CLASSES)[r.stoch].reshape(r.stoch.shape[:3] + (-1,))
  ahead = r.deter @ A + r.action @ B + hot @ E
  gain = np.asarray(Stub.params["gain"])[None, :, None, None]
  came = np.concatenate([r.final_obs, r.reward[..., None]], -1)
  np.testing.assert_allclose(innovation, came - gain * (ahead @ C), rtol=1e-4, atol=1e-4)  # float32
  assert (r.terminated | r.truncated).any() and (innovation < 0).any() and (innovation > 0).any()
  plain = Monitor(Stub(), 5, least=2)
  _, seen = plain.update(Stub.params, plain.init(GROUPS, MEMBERS), part(rows, 0, 20), KEYS)
  assert seen.innovation is None


def test_opr_is_the_mean_over_variables_and_blind_to_none():
  """A shift of one variable by 3 adds 3 / OBS to OPR where every prediction lies below the truth,
  and nothing to the other variables.
  """
  rows = make_rows(12, resets=0.0)
  high = rows._replace(final_obs=rows.final_obs + 1000.0)
  shifted = high._replace(final_obs=high.final_obs.at[..., 1].add(3.0))
  monitor = Monitor(Stub(), n=3, least=1)
  update = jax.jit(
    lambda rows: monitor.update(Stub.params, monitor.init(GROUPS, MEMBERS), rows, KEYS)[1]
  )
  a, b = update(high), update(shifted)
  np.testing.assert_allclose((b.opr - a.opr)[2:], 3.0 / OBS, atol=1e-3)  # float32 at 1,000
  np.testing.assert_allclose(
    (b.variables - a.variables)[2:],
    np.broadcast_to([0.0, 3.0, 0.0], (10, GROUPS, MEMBERS, OBS)),
    atol=1e-3,
  )
  np.testing.assert_array_equal(a.rpr, b.rpr)


@pytest.mark.parametrize(
  "settings, word",
  [
    (dict(form="papers"), "paper, streaming"),
    (dict(actions="own"), "recorded, policy"),
    (dict(least=0), "least"),
    (dict(n=4, least=5), "least"),
  ],
)
def test_wrong_settings_are_refused(settings, word):
  with pytest.raises(UserError, match=word):
    Monitor(Stub(), **settings)


def test_with_a_real_agent(tiny, tiny_params):
  """Rows of a chunk equal what open_loop says from the same posterior, actions and key."""
  steps, n = 20, 15
  rng = np.random.default_rng(3)
  shape = (steps, 2, 1)
  normal = lambda *more: jnp.asarray(rng.normal(size=shape + more), jnp.float32)
  never = jnp.zeros(shape, bool)
  rows = Row(
    normal(24),
    None,
    None,
    normal(6),
    normal(128),
    jnp.asarray(rng.integers(0, 8, shape + (8,))),
    normal(),
    None,
    normal(24),
    never,
    never,
    None,
    None,
    None,
    None,
  )
  monitor = Monitor(tiny)
  residual = jax.jit(monitor.update)(tiny_params, monitor.init(2, 1), rows, KEYS)[1]
  predict = jax.jit(tiny.open_loop)
  past = lambda x: jnp.concatenate([jnp.zeros((n - 1,) + x.shape[1:], x.dtype), x])
  for g in range(2):
    params = jax.tree.map(lambda x: x[g], tiny_params)
    deter, stoch, action = (past(x[:, g, 0]) for x in (rows.deter, rows.stoch, rows.action))
    actions = jnp.stack(
      [action[i : i + steps] for i in range(n)]
    )  # start s acts in rows s .. s + n - 1
    obs, reward = predict(params, deter[:steps], tiny.hot(stoch[:steps]), actions, KEYS[g])
    for t in range(n - 1, steps):  # the start of row t is row t - n + 1, number t of `deter`
      own = slice(t - n + 1, t + 1)
      each = np.abs(obs[:, t] - rows.final_obs[own, g, 0]).mean(0)
      # the batched products of two groups are summed in another order; a categorical draw never
      # flips here, which would show as a large error
      np.testing.assert_allclose(residual.variables[t, g, 0], each, rtol=1e-4, atol=1e-5)
      np.testing.assert_allclose(residual.opr[t, g, 0], each.mean(), rtol=1e-4)
      np.testing.assert_allclose(
        residual.rpr[t, g, 0], np.abs(reward[:, t] - rows.reward[own, g, 0]).mean(), rtol=1e-4
      )


def test_a_member_is_watched_as_if_alone(tiny, tiny_params):
  """With a key for each member: the same residuals whoever else is there, which are those of
  `update` on it alone.
  """
  rows = make_rows(20, agent=tiny)
  one = lambda x: jax.tree.map(lambda a: a[:, :1], x)
  params = jax.tree.map(lambda x: x[:1], tiny_params)
  monitor = Monitor(tiny)
  keys = jax.random.split(jax.random.key(5), (1, MEMBERS))
  part = lambda x, n: jax.tree.map(lambda a: a[:, :, :n], x)
  history, rows = monitor.init(1, MEMBERS), one(rows)
  watch = jax.jit(monitor.update_each)
  all_history, everyone = watch(params, history, rows, keys)
  n = MEMBERS - 1
  # the products of few members and of many are summed in another order; another draw would show as
  # a large error
  close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
  jax.tree.map(
    close,
    watch(params, part(history, n), part(rows, n), keys[:, :n]),
    (part(all_history, n), part(everyone, n)),
  )
  alone = jax.jit(monitor.update)(params, part(history, 1), part(rows, 1), keys[:, 0])
  jax.tree.map(close, alone, (part(all_history, 1), part(everyone, 1)))
  assert np.isfinite(everyone.opr).sum() > 5


def test_what_detectors_see_beside_the_residuals():
  """Groups, reward, surprise and latent against sums in NumPy."""
  rows = make_rows(8)
  spec = Spec(
    "",
    tuple(Var(f"o{k}", "", scale=s) for k, s in enumerate((0.5, 1.0, 2.0))),
    (),
    1.0,
    1,
    0.0,
    None,
    (),
    watched=(("a", (0, 2)), ("b", (1,))) + tuple((f"none{k}", (0,)) for k in range(6)),
  )
  monitor = Monitor(Stub(), n=1, least=1, spec=spec)
  seen = monitor.update(Stub.params, monitor.init(GROUPS, MEMBERS), rows, KEYS)[1]
  v = np.asarray(seen.variables)
  np.testing.assert_allclose(
    seen.groups[..., 0], (v[..., 0] / 0.5 + v[..., 2] / 2.0) / 2, rtol=1e-5
  )  # float32 sums of two numbers
  np.testing.assert_allclose(seen.groups[..., 1], v[..., 1], rtol=1e-5)
  np.testing.assert_array_equal(seen.reward, rows.reward)
  np.testing.assert_array_equal(seen.terminated, rows.terminated)
  mixed = lambda x: 0.99 * np.exp(x) / np.exp(x).sum(-1, keepdims=True) + 0.01 / CLASSES
  q, p = mixed(np.asarray(rows.obs, float)), mixed(np.asarray(rows.deter, float)[..., :CLASSES])
  np.testing.assert_allclose(
    seen.surprise, 2 * (q * np.log(q / p)).sum(-1), rtol=1e-4
  )  # both variables of the stub are alike
  hot = np.eye(CLASSES)[np.asarray(rows.stoch)].reshape(8, GROUPS, MEMBERS, -1)
  np.testing.assert_allclose(
    seen.latent, np.concatenate([rows.deter, hot], -1) @ monitor._projection, rtol=1e-4, atol=1e-5
  )


def test_every_robot_has_eight_watched_parts():
  for name in envs.ENVS:
    spec = envs.make(name).spec
    parts = watched(spec)
    indices = [i for _, at in parts for i in at]
    assert len(parts) == GROUPS_SEEN == len({n for n, _ in parts}) and all(at for _, at in parts)
    assert len(set(indices)) == len(indices) and set(indices) <= set(range(len(spec.obs)))
