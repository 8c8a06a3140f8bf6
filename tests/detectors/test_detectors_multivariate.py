"""Detectors over several fields of a residual, and the references: each against NumPy, a
distribution or a published run length.
"""

import chex
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
import quick
import scipy.special
import scipy.stats

from mjx_cl import detectors
from mjx_cl.detectors import multivariate
from mjx_cl.detectors.baselines import REFERENCES, always, never, oracle, periodic, random
from mjx_cl.detectors.bfar import bfar
from mjx_cl.detectors.hotelling import hotelling
from mjx_cl.detectors.knn import knn, kth
from mjx_cl.detectors.max_variables import corrected, max_variables
from mjx_cl.detectors.mewma import mewma
from mjx_cl.detectors.surprise import surprise
from mjx_cl.errors import UserError
from mjx_cl.rollout.monitor import GROUPS, LATENT, Residual

FOUR = tuple(f"group_{k}" for k in range(4))


def rows(shape, **fields):
  """Residual rows of leading `shape`, known, ones, but for `fields`."""
  full = lambda *more: jnp.ones(shape + more)
  out = Residual(
    full(),
    full(),
    full(1),
    jnp.ones(shape, bool),
    full(GROUPS),
    full(),
    jnp.zeros(shape, bool),
    full(),
    full(LATENT),
  )
  return out._replace(**{k: jnp.asarray(v) for k, v in fields.items()})


def gaussian(key, shape):
  """Rows whose fields are independent standard Gaussians."""
  keys = iter(jax.random.split(key, 6))
  draw = lambda *more: jax.random.normal(next(keys), shape + more)
  return rows(
    shape,
    opr=draw(),
    rpr=draw(),
    groups=draw(GROUPS),
    reward=draw(),
    surprise=draw(),
    latent=draw(LATENT),
  )


def scan(detector, xs):
  """Alarms of one stream (T,)."""
  return quick.jit(lambda xs: jax.lax.scan(detector.update, detector.init(), xs)[1])(xs)


def simulate(detector, streams, steps, seed=0, make=gaussian):
  """Alarms (steps, streams) of streams whose rows are drawn on the way."""
  start = jax.tree.map(lambda x: jnp.broadcast_to(x, (streams,) + x.shape), detector.init())
  body = lambda state, key: jax.vmap(detector.update)(state, make(key, (streams,)))
  return jax.tree.map(
    np.asarray,
    quick.jit(lambda keys: jax.lax.scan(body, start, keys)[1])(
      jax.random.split(jax.random.key(seed), steps)
    ),
  )


def spoilt(rng, steps=300):
  """Correlated, skewed rows with a shift and unknown ones; (rows, {channel: float64 (steps,)},
  known).
  """
  known = rng.uniform(size=steps) > 0.1
  base = rng.normal(size=(steps, 1))
  groups = np.exp(
    0.3 * (rng.normal(size=(steps, GROUPS)) + base)
    + np.where(np.arange(steps) >= 220, 0.5, 0.0)[:, None]
  )
  more = {
    c: np.exp(0.2 * rng.normal(size=steps) + 0.1 * base[:, 0]) for c in ("opr", "rpr", "surprise")
  } | {"reward": 3 + rng.normal(size=steps)}
  hide = lambda x: np.where(known.reshape((-1,) + (1,) * (x.ndim - 1)), x, np.nan).astype(
    np.float32
  )
  fields = {
    k: hide(v)
    for k, v in (
      more
      | {"groups": groups, "latent": rng.normal(size=(steps, LATENT)) * np.arange(1, LATENT + 1)}
    ).items()
  }
  return (
    rows((steps,), valid=known, **fields),
    {k: v.astype(float) for k, v in fields.items()},
    known,
  )


def equal(alarms, fired, scores, **tolerance):
  assert fired.any() and not fired.all()
  np.testing.assert_allclose(alarms.score, scores, **tolerance)
  np.testing.assert_array_equal(alarms.fired, fired)


# ---- what they share -----------------------------------------------------------------------------


def test_once_computes_only_where_due():
  """The branch runs for the one stream that is due, in the one step in which it is, under one vmap
  and under two.
  """
  calls = []

  def compute(x):
    jax.debug.callback(lambda x: calls.append(float(x)), x)
    return x * 10

  body = lambda state, t: (multivariate.once(t == 3, compute, t + 0.5, state), None)
  due = jnp.array([[1, 3, 5], [0, 0, 7]], jnp.float32)
  end = quick.jit(
    jax.vmap(
      jax.vmap(lambda shift: jax.lax.scan(body, jnp.float32(-1), jnp.arange(4.0) + shift)[0])
    )
  )(due - 2)
  jax.effects_barrier()
  # stream with shift s sees t = s, s + 1, s + 2, s + 3 and is due at t = 3 if that is among them
  np.testing.assert_array_equal(end, np.where((due - 2 <= 3) & (due - 2 >= 0), 35.0, -1.0))
  assert sorted(calls) == [3.5] * int(((due - 2 <= 3) & (due - 2 >= 0)).sum()) and len(calls) == 2


def test_trail_is_the_sum_of_the_last_known_samples():
  rng = np.random.default_rng(0)
  xs, known = rng.normal(size=(200, 2)).astype(np.float32), rng.uniform(size=200) > 0.2
  again = rng.uniform(size=200) > 0.97

  def step(state, x):
    state = multivariate.push(state, x[0], x[1])
    return multivariate.restart(state, x[2]), state.total

  totals = jax.lax.scan(
    step, multivariate.trail(7, 2), (jnp.asarray(xs), jnp.asarray(known), jnp.asarray(again))
  )[1]
  held, want = [], []
  for x, k, a in zip(xs.astype(float), known, again):
    held = (held + [x])[-7:] if k else held
    want.append(np.sum(held, 0) if held else np.zeros(2))
    held = [] if a else held
  np.testing.assert_allclose(
    totals, want, atol=2e-5
  )  # float32 sums of seven; each step adds a rounding error of 1e-7


@pytest.mark.parametrize(
  "build,settings",
  [
    (hotelling, dict(channels="opr+grups")),
    (hotelling, dict(channels="opr+opr")),
    (mewma, dict(channels="group_0+groups")),
    (max_variables, dict(channels=())),
    (hotelling, dict(warmup=12)),
    (hotelling, dict(shrinkage=1.5)),
    (hotelling, dict(smooth=0)),
    (hotelling, dict(threshold=0.0)),
    (mewma, dict(rate=0.0)),
    (mewma, dict(rate=1.5)),
    (mewma, dict(threshold=float("nan"))),
    (max_variables, dict(warmup=150)),
    (surprise, dict(smooth=100, warmup=199)),
    (knn, dict(k=100)),
    (knn, dict(references=2000)),
    (bfar, dict(warmup=200)),
    (bfar, dict(bins=3)),
    (bfar, dict(horizons=())),
    (bfar, dict(horizons=(0,))),
    (bfar, dict(alpha=0.0)),
    (bfar, dict(blocks=3)),
    (bfar, dict(shrinkage=0.0)),
    (periodic, dict(threshold=-1.0)),
    (random, dict(threshold=-0.1)),
    (oracle, dict(onset=-5)),
  ],
)
def test_bad_settings_are_refused(build, settings):
  with pytest.raises(UserError, match=build.__name__):
    build(**settings)


@pytest.mark.parametrize(
  "name, settings",
  [
    ("hotelling", dict(channels=[5])),
    ("mewma", dict(channels=["opr", None])),
    ("max_variables", dict(channels=[1.5])),
    ("bfar", dict(horizons=[1.5])),
    ("bfar", dict(horizons=[5, 1.5])),
  ],
)
def test_lists_of_the_wrong_kind_are_refused(name, settings, monkeypatch):
  """As a user without the tests' check of types is told."""
  monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
  with pytest.raises(UserError, match=f"{name}': {next(iter(settings))} must be one or several"):
    detectors.make(name, **settings)


@pytest.mark.parametrize(
  "build", [hotelling, mewma, max_variables, surprise, knn, bfar, periodic, random]
)
def test_the_threshold_may_be_traced(build):
  """One trace serves all thresholds; a higher one never fires more, the lowest fires."""
  xs = gaussian(jax.random.key(0), (400,))
  settings = {} if build in (periodic, random) else dict(warmup=120)
  settings |= (
    dict(smooth=10)
    if build in (hotelling, max_variables, surprise, knn)
    else dict(block=10)
    if build is bfar
    else {}
  )
  chex.clear_trace_counter()

  @jax.jit
  @chex.assert_max_traces(n=1)
  def count(threshold):
    detector = build(threshold=threshold, **settings)
    return jnp.sum(jax.lax.scan(detector.update, detector.init(), xs)[1].fired)

  counts = [int(count(jnp.float32(t))) for t in (1e-3, 1.0, 1e3)]
  assert counts[0] >= counts[1] >= counts[2] == 0 < counts[0]


# ---- T^2 -----------------------------------------------------------------------------------------


def reference(x, warmup, shrinkage):
  """Mean and shrunk covariance of the first rows."""
  s = np.cov(x[:warmup].T)
  return x[:warmup].mean(0), (1 - shrinkage) * s + shrinkage * np.diag(np.diag(s))


def default_channels(fields):
  return np.concatenate(
    [
      np.log(fields["groups"]),
      np.log(fields["opr"])[:, None],
      np.log(fields["rpr"])[:, None],
      fields["reward"][:, None],
    ],
    1,
  )


def test_hotelling_equals_the_loop():
  xs, fields, known = spoilt(np.random.default_rng(1))
  x, warmup, smooth, threshold = default_channels(fields), 100, 10, 28.0
  mean, s = reference(x[known], warmup, 0.1)
  held, seen, fired, scores = [], 0, [], []
  for row, k in zip(x, known):
    scores.append(np.nan)
    fired.append(False)
    seen += k
    if k and seen > warmup:
      held = (held + [row - mean])[-smooth:]
      d = np.mean(held, 0)
      scores[-1] = len(held) * d @ np.linalg.solve(s, d)
      fired[-1] = scores[-1] > threshold
      held = [] if fired[-1] else held
  alarms = scan(hotelling(smooth=smooth, threshold=threshold, warmup=warmup), xs)
  equal(
    alarms, np.array(fired), scores, rtol=1e-3
  )  # float32 through a factorisation of condition about 100


@pytest.mark.parametrize("smooth", [1, 20])
def test_hotelling_has_the_quantiles_of_f(smooth):
  """T^2 / (1 + n / m) = p (m - 1) / (m - p) F(p, m - p) for independent Gaussian rows, mean and
  covariance from m rows, no shrinkage.
  """
  m, p, streams, points = 60, 5, 400, 30
  detector = hotelling(
    smooth=smooth, threshold=1e9, warmup=m, shrinkage=0.0, channels=FOUR + ("reward",), log=False
  )
  mix = jnp.asarray(
    np.random.default_rng(0).normal(size=(4, 4))
  )  # the chart does not depend on the coordinates
  score = simulate(
    detector,
    streams,
    m + smooth * points,
    1,
    lambda key, shape: (r := gaussian(key, shape))._replace(
      groups=(r.groups.at[..., :4].set(r.groups[..., :4] @ mix + 7))
    ),
  ).score
  assert np.isnan(score[:m]).all()
  values = score[m + smooth - 1 :: smooth].ravel() / (1 + smooth / m)
  assert len(values) == streams * points
  for q in (0.5, 0.9, 0.99):
    exact = p * (m - 1) / (m - p) * scipy.stats.f.ppf(q, p, m - p)
    # 12,000 values, but those of a stream share its reference: at worst 400 independent ones,
    # standard error of the share sqrt(q (1 - q) / 400)
    assert abs(np.mean(values <= exact) - q) < 3 * np.sqrt(q * (1 - q) / streams), q
  # the reference is known in the limit: with warmup = 0 the score is chi-square, exactly
  assert (
    abs(
      scipy.stats.chi2.ppf(0.99, p) / (p * (m - 1) / (m - p) * scipy.stats.f.ppf(0.99, p, m - p))
      - 1
    )
    > 0.1
  )  # and the two are told apart


def test_hotelling_with_a_known_reference_is_chi_square():
  detector = hotelling(smooth=4, threshold=1e9, warmup=0, channels="groups", log=False)
  values = simulate(detector, 100, 400).score[3::4].ravel()
  assert (
    scipy.stats.kstest(values, "chi2", (8,)).pvalue > 0.01
  )  # 10,000 independent values, a fixed seed


def test_shrinkage_keeps_a_constant_channel_and_a_copy_harmless():
  """A channel that never moves and one that copies another have no inverse; the shrunk covariance
  has.
  """
  noise = jax.random.normal(jax.random.key(0), (600,))
  groups = jnp.ones((600, GROUPS)).at[:, 0].set(noise).at[:, 1].set(noise)
  alarms = scan(
    hotelling(smooth=5, threshold=60.0, warmup=200, channels="group_0+group_1+group_2", log=False),
    rows((600,), groups=groups),
  )
  assert (
    np.isfinite(alarms.score[200:]).all()
    and not alarms.fired.any()
    and float(alarms.score[200:].max()) > 1
  )


# ---- MEWMA ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("exact", [False, True])
def test_mewma_equals_the_loop(exact):
  xs, fields, known = spoilt(np.random.default_rng(2))
  x, warmup, rate, threshold = default_channels(fields), 100, 0.15, 28.0
  mean, s = reference(x[known], warmup, 0.2)
  z, t, seen, fired, scores = np.zeros(x.shape[1]), 0, 0, [], []
  for row, k in zip(x, known):
    scores.append(np.nan)
    fired.append(False)
    seen += k
    if k and seen > warmup:
      z, t = rate * (row - mean) + (1 - rate) * z, t + 1
      v = s * rate / (2 - rate) * (1 - (1 - rate) ** (2 * t) if exact else 1)
      scores[-1] = z @ np.linalg.solve(v, z)
      fired[-1] = scores[-1] > threshold
      z, t = (np.zeros_like(z), 0) if fired[-1] else (z, t)
  equal(
    scan(mewma(rate=rate, threshold=threshold, warmup=warmup, shrinkage=0.2, exact=exact), xs),
    np.array(fired),
    scores,
    rtol=1e-3,
  )


def test_mewma_has_the_published_run_lengths():
  """p = 4, rate 0.1, h = 12.73, asymptotic variance: ARL 199.78 in control, 12.17 at a shift of 1
  and 5.19 of 2 (Runger, Prabhu 1996, table 1, as recomputed with the program of Molnau et al.
  2001)."""
  detector = mewma(rate=0.1, threshold=12.73, warmup=0, channels=FOUR, log=False)
  streams, steps = 500, 4000
  alarms = simulate(detector, streams, steps).fired.sum()
  # 10,000 alarms of nearly exponential intervals: a standard error of 1 %, and a last interval cut
  # off in each stream
  np.testing.assert_allclose(streams * steps / alarms, 199.78, rtol=0.04)
  for shift, published in ((1.0, 12.17), (2.0, 5.19)):
    fired = simulate(
      detector,
      2000,
      80,
      1,
      lambda key, shape: (r := gaussian(key, shape))._replace(
        groups=r.groups.at[..., 0].add(shift)
      ),
    ).fired
    assert fired.any(0).all()
    first = fired.argmax(0) + 1
    assert abs(first.mean() - published) < 4 * first.std() / np.sqrt(len(first)) < 0.6


def test_mewma_for_two_variables_is_near_200_at_the_published_limit():
  """p = 2, rate 0.1: h = 8.66 (Lowry et al. 1992) or 8.64 (Prabhu, Runger 1997) for an ARL0 of 200."""
  streams, steps = 500, 4000
  alarms = simulate(
    mewma(rate=0.1, threshold=8.66, warmup=0, channels="group_0+group_1", log=False), streams, steps
  ).fired.sum()
  np.testing.assert_allclose(
    streams * steps / alarms, 201, rtol=0.04
  )  # 10,000 alarms: 1 %; the two published limits lie 1 % of ARL0 apart


# ---- maximum of channels -------------------------------------------------------------------------


@pytest.mark.parametrize("two_sided", [True, False])
def test_corrected_equals_float64(two_sided):
  z = np.linspace(0, 12, 49)
  p = scipy.stats.norm.sf(z) * (2 if two_sided else 1)
  np.testing.assert_allclose(
    corrected(jnp.asarray(z, jnp.float32), 9, two_sided),
    -np.log(-np.expm1(9 * np.log1p(-np.minimum(p, 1 - 1e-12)))),
    rtol=2e-5,
    atol=2e-6,
  )  # float32
  far = np.asarray(corrected(jnp.float32([20.0, 40.0, 1000.0]), 9, two_sided))
  np.testing.assert_allclose(
    far[:2],
    [-scipy.special.log_ndtr(-z) - np.log(18 if two_sided else 9) for z in (20.0, 40.0)],
    rtol=1e-5,
  )
  assert np.isfinite(far).all() and (np.diff(far) > 0).all()


@pytest.mark.parametrize("smooth,two_sided", [(1, True), (1, False), (6, True)])
def test_sidaks_level_by_simulation(smooth, two_sided):
  """With known mean and deviation, P(score > -ln alpha) = alpha at each step, for nine independent
  channels.
  """
  detector = max_variables(smooth=smooth, threshold=1e9, warmup=0, two_sided=two_sided, log=False)
  values = (
    simulate(detector, 200, 100 * smooth, 2).score[smooth - 1 :: smooth].ravel()
  )  # apart by `smooth`, so independent
  for alpha in (0.5, 0.05, 0.005):
    assert abs(np.mean(values > -np.log(alpha)) - alpha) < 3 * np.sqrt(
      alpha * (1 - alpha) / len(values)
    ), alpha


def slow_trailing_z(x, known, smooth, warmup, score, threshold):
  """Scores and alarms of a standardised trailing mean, restarted after an alarm; `score` maps z
  (p,) to a number.
  """
  means, held, seen, fired, scores = [], [], 0, [], []
  for row, k in zip(x, known):
    scores.append(np.nan)
    fired.append(False)
    if not k:
      continue
    seen += 1
    held = (held + [row])[-smooth:]
    if len(held) < smooth:
      continue
    if seen <= warmup:
      means.append(np.mean(held, 0))
      continue
    scores[-1] = score((np.mean(held, 0) - np.mean(means, 0)) / np.std(means, 0))
    fired[-1] = scores[-1] > threshold
    held = [] if fired[-1] else held
  return np.array(fired), np.array(scores)


def test_max_variables_equals_the_loop():
  xs, fields, known = spoilt(np.random.default_rng(3))
  x = np.concatenate([np.log(fields["groups"]), fields["reward"][:, None]], 1)
  z_to_score = lambda z: -np.log(-np.expm1(9 * np.log1p(-2 * scipy.stats.norm.sf(np.abs(z).max()))))
  fired, scores = slow_trailing_z(x, known, 8, 100, z_to_score, 7.0)
  equal(
    scan(max_variables(smooth=8, threshold=7.0, warmup=100), xs),
    fired,
    scores,
    rtol=2e-3,
    atol=1e-4,
  )  # float32 z of up to 6, squared


def test_one_side_is_a_rise_of_residuals_or_a_fall_of_the_reward():
  for two_sided in (True, False):
    detector = max_variables(smooth=5, threshold=30.0, warmup=100, two_sided=two_sided, log=False)
    program = quick.jit(lambda xs: jax.lax.scan(detector.update, detector.init(), xs)[1].fired)
    for field, shift, found in (
      ("groups", 5.0, True),
      ("groups", -5.0, False),
      ("reward", -5.0, True),
      ("reward", 5.0, False),
    ):
      xs = gaussian(jax.random.key(0), (300,))
      fired = program(xs._replace(**{field: getattr(xs, field).at[200:].add(shift)}))
      assert bool(fired.any()) == (found or two_sided), (field, shift, two_sided)


# ---- surprise ------------------------------------------------------------------------------------


@pytest.mark.parametrize("two_sided", [False, True])
def test_surprise_equals_the_loop(two_sided):
  xs, fields, known = spoilt(np.random.default_rng(4))
  steps = np.arange(300)
  x = (
    np.log(fields["surprise"])[:, None]
    + np.where(steps >= 270, -1.0, np.where(steps >= 200, 0.5, 0.0))[:, None]
  )
  xs = xs._replace(surprise=jnp.exp(jnp.asarray(x[:, 0], jnp.float32)))
  fired, scores = slow_trailing_z(x, known, 6, 100, lambda z: abs(z[0]) if two_sided else z[0], 2.5)
  equal(
    scan(surprise(smooth=6, threshold=2.5, warmup=100, two_sided=two_sided), xs),
    fired,
    scores,
    rtol=1e-3,
    atol=1e-3,
  )  # float32


def test_surprise_and_latent_are_known_where_residuals_are_not():
  """After a reset the residuals are unknown for some steps, surprise, latent and reward are known."""
  xs = gaussian(jax.random.key(1), (260,))
  xs = xs._replace(
    surprise=jnp.exp(xs.surprise), valid=jnp.zeros(260, bool), opr=jnp.full(260, jnp.nan)
  )
  for detector in (
    surprise(smooth=5, warmup=100),
    knn(k=2, references=20, warmup=100),
    bfar(block=10, warmup=100),
  ):
    assert np.isfinite(scan(detector, xs).score[200:]).any()
  assert np.isnan(scan(max_variables(smooth=5, warmup=100, log=False), xs).score).all()


# ---- nearest neighbours --------------------------------------------------------------------------


def test_kth_smallest():
  x = jnp.asarray(
    np.random.default_rng(0).integers(0, 6, (40, 12)), jnp.float32
  )  # many equal values
  for k in (1, 2, 5, 12):
    np.testing.assert_array_equal(kth(x, k), np.sort(x, -1)[:, k - 1])


def test_knn_equals_brute_force():
  xs, fields, known = spoilt(np.random.default_rng(5))
  k, number, smooth, warmup, threshold = 3, 30, 8, 100, 1.5
  x = fields["latent"].copy()
  x[240:] *= 2.0
  learnt = x[known][:warmup]
  spread = learnt.std(0)
  refs = learnt[:: warmup // number][:number]
  distances = lambda row, others: np.sort(np.linalg.norm((row - others) / spread, axis=1))
  own = np.array([distances(refs[i], np.delete(refs, i, 0))[k - 1] for i in range(number)])
  held, seen, fired, scores = [], 0, [], []
  for row, there in zip(x, known):
    scores.append(np.nan)
    fired.append(False)
    seen += there
    if there and seen > warmup:
      held = (held + [(distances(row, refs)[k - 1] - own.mean()) / own.std()])[-smooth:]
      scores[-1] = np.mean(held)
      fired[-1] = scores[-1] > threshold
      held = [] if fired[-1] else held
  alarms = scan(
    knn(k=k, references=number, smooth=smooth, threshold=threshold, warmup=warmup),
    xs._replace(latent=jnp.asarray(x, jnp.float32)),
  )
  equal(alarms, np.array(fired), scores, rtol=1e-3, atol=1e-4)  # float32


# ---- bootstrap of blocks -------------------------------------------------------------------------


def slow_bfar(
  x, known, block, bins, horizons, threshold, alpha, blocks, warmup, repetitions, shrinkage
):
  """The docstring in NumPy, with the same fixed draws."""
  m = warmup // block
  rng = np.random.default_rng(0)
  chosen, noise = (
    rng.integers(0, m, (repetitions, m + blocks)),
    rng.standard_normal((repetitions, m + blocks)),
  )
  v = x[known][: len(x[known]) // block * block].reshape(-1, bins, block // bins).mean(2)
  s = np.cov(v[:m].T).reshape(bins, bins)
  s = (1 - shrinkage) * s + shrinkage * np.trace(s) / bins * np.eye(bins)
  w = np.linalg.solve(s, np.ones(bins))
  b = v @ (w / w.sum())
  mean, std, g = b[:m].mean(), b[:m].std(ddof=1), 2.1 * b[:m].std(ddof=1) * m**-0.2
  largest = []
  for j, e in zip(chosen, noise):
    drawn = mean + (b[:m][j] - mean + g * e) / np.sqrt(1 + g**2 / std**2)
    own, run = drawn[:m], drawn[m:]
    largest.append(
      max(
        np.sqrt(h) * (own.mean() - run[t - h + 1 : t + 1].mean()) / own.std(ddof=1)
        for h in horizons
        for t in range(h - 1, blocks)
      )
    )
  level = np.quantile(largest, 1 - alpha)
  ends = np.flatnonzero(known)[block - 1 :: block]
  fired, scores, held = np.zeros(len(x), bool), np.full(len(x), np.nan), []
  for t, value in list(zip(ends, b))[m:]:
    held.append(value)
    z = [np.sqrt(h) * (mean - np.mean(held[-h:])) / std for h in horizons if len(held) >= h]
    if z:
      scores[t] = max(z) / level
      fired[t] = scores[t] > threshold
      held = [] if fired[t] else held
  return fired, scores


@pytest.mark.parametrize("bins,horizons", [(1, (1, 4)), (5, (2, 3))])
def test_bfar_equals_the_loop(bins, horizons):
  rng = np.random.default_rng(6)
  known = rng.uniform(size=600) > 0.1
  x = rng.normal(size=600).astype(np.float32) * (1 + np.arange(600) % 10) - np.where(
    np.arange(600) >= 400, 3.0, 0.0
  ).astype(np.float32)
  settings = dict(
    block=10,
    bins=bins,
    horizons=horizons,
    threshold=0.8,
    alpha=0.1,
    blocks=20,
    warmup=200,
    repetitions=100,
    shrinkage=0.5,
  )
  alarms = scan(bfar(**settings), rows((600,), reward=np.where(known, x, np.nan)))
  fired, scores = slow_bfar(x.astype(float), known, **settings)
  equal(alarms, fired, scores, rtol=1e-3, atol=1e-4)  # float32


@pytest.mark.parametrize("phi,block,warmup", [(0.0, 5, 100), (0.0, 5, 500), (0.5, 20, 400)])
def test_bfar_has_the_stated_probability_of_a_false_alarm(phi, block, warmup):
  """alpha = 10 % within 30 blocks, of Gaussian rewards, independent or an AR(1) whose memory of two
  samples is short beside a block of twenty.
  """
  streams, blocks, alpha = 1500, 30, 0.1
  steps = warmup + blocks * block
  noise = jax.random.normal(jax.random.key(3), (steps, streams))
  reward = jax.lax.scan(
    lambda r, e: ((new := phi * r + e), new), noise[0] / np.sqrt(1 - phi**2), noise
  )[1]
  detector = bfar(block=block, alpha=alpha, blocks=blocks, warmup=warmup, repetitions=400)
  start = jax.tree.map(lambda x: jnp.broadcast_to(x, (streams,) + x.shape), detector.init())
  fired = quick.jit(
    lambda r: (
      jax.lax.scan(jax.vmap(detector.update), start, rows((steps, streams), reward=r))[1].fired
    )
  )(reward)
  assert not fired[:warmup].any()
  share = float(fired.any(0).mean())
  # standard error sqrt(0.1 * 0.9 / 1500) = 0.8 %, and 1.5 % of the 400 repetitions, which all
  # streams share; smoothing and serial dependence bias by
  # 1 or 2 %
  assert abs(share - alpha) < 0.04, share


def test_bfar_finds_a_drop_and_no_rise():
  for shift, found in ((-1.0, True), (1.0, False)):
    reward = jax.random.normal(jax.random.key(0), (2000,)) + shift * (jnp.arange(2000) >= 1200)
    fired = scan(bfar(), rows((2000,), reward=reward)).fired
    assert bool(fired[1200:].any()) == found and not fired[:1200].any()
    assert set(np.flatnonzero(fired) % 50) <= {49}  # at the end of a block


# ---- references ----------------------------------------------------------------------------------


def test_references_are_in_the_table_but_for_the_oracle():
  assert set(REFERENCES) - set(detectors.DETECTORS) == {"oracle"}
  assert {k for k, f in detectors.DETECTORS.items() if getattr(f, "reference", False)} == set(
    REFERENCES
  ) - {"oracle"}
  assert all(f.reference and f.__name__ == k for k, f in REFERENCES.items())


def test_never_and_always():
  xs = rows((10,), valid=np.arange(10) % 2 == 0)
  for detector, fires in ((never(), False), (always(), True)):
    alarms = scan(detector, xs)
    np.testing.assert_array_equal(alarms.fired, np.asarray(xs.valid) & fires)
    np.testing.assert_array_equal(alarms.score, np.where(xs.valid, float(fires), np.nan))


@pytest.mark.parametrize("interval", [1, 2, 7, 100])
def test_periodic_has_its_rate_and_three_intervals_at_most(interval):
  known = np.random.default_rng(0).uniform(size=20_000) > 0.3
  alarms = scan(periodic(np.log(interval)), rows((20_000,), valid=known))
  fired = np.asarray(alarms.fired)
  assert (
    not (fired & ~known).any() and abs(fired.sum() - known.sum() / interval) <= 4
  )  # the discrepancy of 14,000 multiples of the golden ratio
  at = np.cumsum(known)[fired]  # numbers of the known rows that fire
  gaps = np.unique(np.diff(at))
  assert (
    len(gaps) <= 3 and interval / 2.7 < gaps.min() <= interval <= gaps.max() < 2.7 * interval
  )  # neighbours in a Fibonacci-like row
  np.testing.assert_array_equal(np.asarray(alarms.score)[known] > np.log(interval), fired[known])


def test_periodic_streams_begin_anywhere_and_keep_the_rate_where_they_are_short():
  """400 streams of 60 rows at an interval of 100: 60 % fire once, at a uniform row."""
  alarms = simulate(periodic(np.log(100)), 400, 60)
  once = alarms.fired.sum(0)
  assert abs(once.mean() - 0.6) < 4 * np.sqrt(0.24 / 400)  # binomial
  assert scipy.stats.kstest((alarms.fired.argmax(0)[once > 0] + 0.5) / 60, "uniform").pvalue > 0.001
  np.testing.assert_array_equal(
    simulate(periodic(np.log(10)), 400, 60).score, alarms.score
  )  # free of the threshold


def test_random_has_its_rate_in_streams_that_differ():
  streams, steps, interval = 200, 2000, 40
  alarms = simulate(random(np.log(interval)), streams, steps)
  n = streams * steps
  assert abs(alarms.fired.sum() - n / interval) < 4 * np.sqrt(n / interval)  # Poisson
  assert scipy.stats.kstest(alarms.score[::7, ::7].ravel(), "expon").pvalue > 0.01
  gaps = np.diff(np.flatnonzero(alarms.fired.T.ravel()))
  assert (
    abs(gaps.std() / gaps.mean() - 1) < 0.04
  )  # 10,000 geometric gaps: deviation = mean, to 1 % each
  # 200 independent streams: a step has Binomial(200, 1 / 40) alarms, of variance 4.9; streams in
  # unison would have 200 * 4.9
  assert abs(alarms.fired.sum(1).var() / (streams / interval * (1 - 1 / interval)) - 1) < 0.2
  again = simulate(random(np.log(interval)), streams, steps)
  np.testing.assert_array_equal(alarms.score, again.score)
  assert (simulate(random(np.log(interval), seed=1), streams, steps).fired != alarms.fired).any()


def test_oracle_fires_at_the_onset_alone_known_or_not():
  xs = rows((50,), valid=np.zeros(50, bool), reward=np.full(50, np.nan, np.float32))
  program = quick.jit(lambda onset: jax.lax.scan((d := oracle(onset)).update, d.init(), xs)[1])
  for onset in (0, 17, 49, 60):  # traced
    alarms = program(jnp.int32(onset))
    np.testing.assert_array_equal(np.flatnonzero(alarms.fired), [onset] if onset < 50 else [])
    np.testing.assert_array_equal(alarms.score, np.arange(50) >= onset)


def test_references_do_not_look_at_the_residual():
  """Their alarms are the same before and after a change, as often as chance has it."""
  a = gaussian(jax.random.key(0), (300,))
  b = a._replace(
    groups=a.groups + 100, surprise=a.surprise + 100, latent=a.latent + 100, rpr=a.rpr + 100
  )
  for build in REFERENCES.values():
    chex.assert_trees_all_equal(scan(build(), a), scan(build(), b))


# ---- multichart ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
  "robot, units_of", [("quadruped", "quadruped"), ("mine", "walker"), (None, "walker")]
)
def test_multichart_is_its_charts_in_their_units(robot, units_of):
  """Each chart alone, at its own threshold: the alarm of any, the largest score in units of these
  thresholds, each one's restart.
  """
  charts, level = (
    ("cusum@surprise", "hotelling", "cusum white"),
    0.003,
  )  # low, so that each alarms here and starts afresh
  steps = 2600
  xs = gaussian(jax.random.key(3), (steps,))
  shift = lambda x, at, by: x + by * (np.arange(steps) >= at).reshape((-1,) + (1,) * (x.ndim - 1))
  xs = xs._replace(
    opr=jnp.exp(shift(xs.opr, 2100, 4.0)),
    rpr=jnp.exp(xs.rpr),
    surprise=jnp.exp(shift(xs.surprise, 1700, 2.0)),
    groups=jnp.exp(shift(xs.groups, 2400, 6.0)),
  )
  got = scan(
    detectors.make("multichart", robot=robot, threshold=level, charts=",".join(charts)), xs
  )
  board = detectors.board()[units_of]
  alone = [
    scan(
      detectors.make(
        **({"name": (s := dict(board[c]["settings"])).pop("use")} | s),
        threshold=level * board[c]["threshold"],
      ),
      xs,
    )
    for c in charts
  ]
  assert all(a.fired.any() for a in alone)
  np.testing.assert_array_equal(got.fired, np.any([a.fired for a in alone], 0))
  want = np.stack(
    [np.asarray(a.score, np.float64) / board[c]["threshold"] for a, c in zip(alone, charts)]
  )
  known = ~np.isnan(want).all(0)
  np.testing.assert_array_equal(np.isnan(got.score), ~known)
  np.testing.assert_allclose(
    got.score[known], np.nanmax(want[:, known], 0), rtol=1e-5
  )  # float32, another order of the same sums
  np.testing.assert_array_equal(got.fired, np.nan_to_num(got.score, nan=-1) > np.float32(level))


def test_the_units_of_multichart_are_the_robots():
  xs = gaussian(jax.random.key(4), (1500,))
  score = lambda robot: scan(
    detectors.make("multichart", robot=robot, charts="cusum@surprise"), xs
  ).score[-1]
  known = detectors.board()
  crouches = {"robot": "quadruped", "agent": "quadruped"}  # has thresholds of its own
  per = lambda own: detectors.calibrated("cusum@surprise", settings={}, **own).value
  of = lambda own: scan(detectors.make("multichart", charts="cusum@surprise", **own), xs).score[-1]
  trots = crouches | {"agent": "quadruped-trot-2"}
  np.testing.assert_allclose(of(crouches) / of(trots), per(trots) / per(crouches), rtol=1e-5)
  assert per(trots) == detectors.board()["quadruped"]["cusum@surprise"]["threshold"]
  np.testing.assert_allclose(
    score("walker") / score("car"),
    known["car"]["cusum@surprise"]["threshold"] / known["walker"]["cusum@surprise"]["threshold"],
    rtol=1e-5,
  )


@pytest.mark.parametrize(
  "charts, word",
  [
    ("cusum@surprise,nobody", "'nobody'"),
    ("mewma,mewma", "twice"),
    ("", "choose from"),
    ("multichart", "choose from"),
    (5, "commas"),
  ],
)
def test_charts_that_are_none_are_refused(charts, word):
  with pytest.raises(UserError, match=word):
    detectors.make("multichart", charts=charts)
