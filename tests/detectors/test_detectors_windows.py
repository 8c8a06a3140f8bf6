"""ADWIN, KSWIN, BOCPD, e-detector and conformal martingale, each against its own oracle; the common
contract is in test_detectors.py.
"""

import importlib
import itertools
import math
import random

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick
import river.drift
import river.drift.adwin
import scipy.stats

from mjx_cl.detectors.adwin import adwin, empty, insert
from mjx_cl.detectors.bocpd import bocpd, gamma_ratio
from mjx_cl.detectors.conformal import LOW, WIDTH, conformal
from mjx_cl.detectors.e_detector import e_detector
from mjx_cl.detectors.kswin import draw, kswin, surprisals
from mjx_cl.errors import UserError


def run(detector, xs):
  """(fired, score) as NumPy arrays of xs's shape, float32 (steps,) or (steps, streams)."""
  update, state = detector.update, detector.init()
  if np.ndim(xs) == 2:
    update, state = (
      jax.vmap(update),
      jax.tree.map(lambda a: jnp.broadcast_to(a, (xs.shape[1],) + a.shape), state),
    )
  alarms = quick.jit(lambda xs: jax.lax.scan(update, state, xs)[1])(jnp.asarray(xs, jnp.float32))
  return np.asarray(alarms.fired), np.asarray(alarms.score)


def arl(detector, xs):
  """(samples per alarm with restarts, its standard error by the count of alarms)."""
  alarms = int(run(detector, xs)[0].sum())
  assert alarms >= 50
  return xs.size / alarms, xs.size / alarms / math.sqrt(alarms)


def autoregression(rng, shape, phi):
  """x_t = phi x_{t-1} + e_t of variance 1, float64 (steps, streams)."""
  x = rng.normal(size=shape)
  for t in range(1, shape[0]):
    x[t] = phi * x[t - 1] + math.sqrt(1 - phi**2) * x[t]
  return x


# ---- all of them ---------------------------------------------------------------------------------

SMALL = {
  adwin: dict(clock=8, warmup=50),
  kswin: dict(window=60, stat_size=20, every=4),
  bocpd: dict(recent=10, max_run=30, warmup=50),
  e_detector: dict(warmup=50),
  conformal: dict(warmup=50),
}
by_name = dict(argnames="factory", argvalues=SMALL, ids=lambda f: f.__name__)


@pytest.mark.parametrize(**by_name)
def test_the_threshold_may_be_traced_and_is_compared_with_the_score(factory):
  """One program serves all thresholds; up to its first alarm a detector shows the scores of one
  that never fires.
  """
  rng = np.random.default_rng(0)
  xs = jnp.asarray(np.concatenate([rng.normal(size=200), rng.normal(3.0, 1.0, 100)]), jnp.float32)

  @jax.jit
  def program(threshold):
    detector = factory(threshold=threshold, **SMALL[factory])
    return jax.lax.scan(detector.update, detector.init(), xs)[1]

  silent = np.asarray(program(jnp.float32(1e9)).score)
  assert not np.asarray(program(jnp.float32(1e9)).fired).any()
  firsts = []
  for threshold in (5.0, 7.0):
    fired, score = map(np.asarray, program(jnp.float32(threshold)))
    first = int(np.flatnonzero(fired)[0])
    firsts.append(first)
    assert first == np.flatnonzero(silent > threshold)[0] >= 150
    np.testing.assert_array_equal(score[: first + 1], silent[: first + 1])
    np.testing.assert_array_equal(run(factory(threshold=threshold, **SMALL[factory]), xs)[0], fired)
  assert firsts[0] <= firsts[1]


@pytest.mark.parametrize(
  "factory, settings",
  [
    (adwin, dict(threshold=0)),
    (adwin, dict(clock=0)),
    (adwin, dict(grace_period=0)),
    (adwin, dict(max_buckets=1)),
    (adwin, dict(min_window_length=0)),
    (adwin, dict(rows=0)),
    (adwin, dict(rows=25)),
    (adwin, dict(warmup=1)),
    (kswin, dict(threshold=-1)),
    (kswin, dict(window=50)),
    (kswin, dict(stat_size=1)),
    (kswin, dict(every=0)),
    (kswin, dict(seed=-1)),
    (bocpd, dict(threshold=math.nan)),
    (bocpd, dict(hazard=0)),
    (bocpd, dict(hazard=1)),
    (bocpd, dict(recent=0)),
    (bocpd, dict(max_run=51)),
    (bocpd, dict(max_run=10, recent=2)),
    (bocpd, dict(kappa=0)),
    (bocpd, dict(alpha=0)),
    (bocpd, dict(beta=0)),
    (bocpd, dict(warmup=1)),
    (e_detector, dict(threshold=math.nan)),
    (e_detector, dict(bound=-1)),
    (e_detector, dict(deviation=0)),
    (e_detector, dict(shifts=())),
    (e_detector, dict(shifts=(0.0,))),
    (e_detector, dict(form="mean")),
    (e_detector, dict(warmup=-1)),
    (conformal, dict(threshold=math.nan)),
    (conformal, dict(bets=())),
    (conformal, dict(bets=(1.0,))),
    (conformal, dict(form="mean")),
    (conformal, dict(bins=1)),
    (conformal, dict(freeze=-1)),
    (conformal, dict(seed=2**32)),
    (conformal, dict(warmup=1)),
  ],
)
def test_bad_settings_are_refused_by_name(factory, settings):
  with pytest.raises(UserError, match=f"{factory.__name__}.*{next(iter(settings))} must be"):
    factory(**settings)


# ---- adwin ---------------------------------------------------------------------------------------


def changing(steps=2400):
  """Streams in [0, 1], float32 (steps, 4): a step up and down, a coin, a ramp, nothing."""
  rng = np.random.default_rng(1)
  third = np.arange(steps) * 3 // steps
  step = rng.uniform(0, 0.5, steps) + np.array([0.0, 0.3, 0.1])[third]
  coin = rng.random(steps) < np.array([0.2, 0.2, 0.5])[third]
  ramp = rng.beta(2, 5, steps) * 0.6 + 0.4 * np.clip((np.arange(steps) - 700) / 900, 0, 1)
  return np.stack([step, coin, ramp, rng.random(steps)], 1).astype(np.float32)


@pytest.mark.parametrize(
  "settings",
  [
    dict(),
    dict(clock=1, grace_period=30, min_window_length=10, max_buckets=3),
    dict(keep=True),
    dict(keep=True, clock=5, max_buckets=2, min_window_length=1, grace_period=50),
  ],
)
def test_adwin_alarms_where_river_does(settings):
  xs, delta = changing(), 0.01
  fired, _ = run(adwin(threshold=-math.log(delta), warmup=0, **settings), xs)
  shared = {k: v for k, v in settings.items() if k != "keep"}
  for g in range(xs.shape[1]):
    if settings.get("keep"):  # the window below river's detector keeps what the cuts leave
      helper = river.drift.adwin.AdaptiveWindowing(
        **dict(delta=delta, clock=32, max_buckets=5, min_window_length=5, grace_period=10) | shared
      )
      want = [helper.update(float(x)) for x in xs[:, g]]
    else:
      oracle, want = river.drift.ADWIN(delta=delta, **shared), []
      for x in xs[:, g]:
        oracle.update(float(x))
        want.append(oracle.drift_detected)
    assert np.flatnonzero(fired[:, g]).tolist() == np.flatnonzero(want).tolist()
  assert fired[:, :3].any(0).all() and not fired[:, 3].any()


def test_adwin_scores_where_rivers_test_turns():
  """River, made to look once, at that sample, with delta just above and just below exp(-score)."""
  xs = changing(1600)[:, 0]
  _, score = run(adwin(threshold=1e9, warmup=0), xs)
  checks = np.arange(31, 1600, 32)
  np.testing.assert_array_equal(
    score[31:], np.repeat(score[checks], 32)[: 1600 - 31]
  )  # between checks the last one's
  assert np.isnan(score[:31]).all() and (score[checks] > 1).sum() > 20
  for t in checks[::4]:
    for nudge, want in (
      (-1e-3, True),
      (1e-3, False),
    ):  # float32 sums of 1,600 samples leave 1e-4 of a score of 50 or less
      oracle = river.drift.ADWIN(
        delta=math.exp(-score[t] - nudge * max(1, abs(score[t]))), clock=int(t) + 1
      )
      for x in xs[: t + 1]:
        oracle.update(float(x))
      assert oracle.drift_detected == want


def test_adwin_hides_up_to_a_clock_of_delay():
  xs = changing()[:, 0]
  first = {
    clock: np.flatnonzero(run(adwin(threshold=4.0, warmup=0, clock=clock), xs)[0])[0]
    for clock in (1, 32)
  }
  assert (first[32] + 1) % 32 == 0 and 0 < first[32] - first[1] < 32 and first[1] > 800


@pytest.mark.parametrize("places, rows, steps", [(5, 16, 300), (2, 12, 300), (3, 3, 100)])
def test_adwin_buckets_hold_the_newest_samples(places, rows, steps):
  xs = np.random.default_rng(2).normal(size=steps).astype(np.float32)
  windows = quick.jit(
    lambda xs: jax.lax.scan(lambda w, x: (insert(w, x),) * 2, empty(places, rows), xs)[1]
  )(xs)
  for t in (0, places, 37, steps - 1):
    mean, squares, number = (np.asarray(a[t]) for a in windows)
    sizes = [(2**i, k, i) for i in reversed(range(rows)) for k in range(number[i])]  # oldest first
    held = sum(n for n, _, _ in sizes)
    assert (
      held == t + 1
      if t < places * (2**rows - 1) - 2**rows
      else places * (2**rows - 1) - 2**rows < held <= places * (2**rows - 1)
    )
    at = t + 1 - held
    for n, k, i in sizes:
      part = xs[at : at + n].astype(np.float64)
      np.testing.assert_allclose(
        [mean[k, i], squares[k, i]],
        [part.mean(), ((part - part.mean()) ** 2).sum()],
        rtol=1e-4,
        atol=1e-5,
      )  # float32
      at += n
    assert at == t + 1


def test_adwin_needs_a_scale():
  """The same shift in millionths: found in warm-up deviations, hidden by the bound's linear term as
  it is.
  """
  rng = np.random.default_rng(3)
  xs = 1e-3 * (rng.normal(size=1200) + 2 * (np.arange(1200) >= 800))
  fired = {warmup: run(adwin(warmup=warmup), xs)[0] for warmup in (0, 200)}
  assert not fired[0].any() and fired[200][800:900].any() and not fired[200][:800].any()
  np.testing.assert_array_equal(run(adwin(warmup=200), 1e6 * xs)[0], fired[200])


# ---- kswin ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [2, 7, 30, 100])
def test_kswin_p_value_is_scipys_exact_one(size):
  table, grid = surprisals(size), np.arange(size)
  assert table.shape == (size + 1,) and table[0] == 0
  np.testing.assert_allclose(
    table[1], 0, atol=1e-7
  )  # two samples without ties differ by one step at least; SciPy gives up there
  for h in range(2, size + 1):
    exact = scipy.stats.ks_2samp(grid, grid + h - 0.5, method="exact")
    assert round(exact.statistic * size) == h
    np.testing.assert_allclose(
      table[h], -math.log(exact.pvalue), rtol=1e-5, atol=1e-6
    )  # float32, and SciPy's float64 recursion


def test_kswin_draws_every_set_as_often():
  sets = np.sort(
    quick.jit(jax.vmap(lambda t: draw(jax.random.key_data(jax.random.key(5)), t, 6, 3)))(
      jnp.arange(20000)
    ),
    1,
  )
  assert (np.diff(sets, axis=1) > 0).all() and sets.min() == 0 and sets.max() == 5
  found, counts = np.unique(sets, axis=0, return_counts=True)
  assert found.tolist() == [list(c) for c in itertools.combinations(range(6), 3)]
  assert (
    scipy.stats.chisquare(counts).pvalue > 1e-4
  )  # fixed key: a fair draw fails one seed in 10,000


class RecordedKswin(river.drift.KSWIN):
  """River's detector, whose generator lives on over alarms and notes its draws."""

  def __init__(self, **settings):
    self.rng, self.draws = random.Random(3), []
    super().__init__(**settings)

  def _reset(self):
    super()._reset()
    self._rng = self

  def sample(self, population, number):
    self.draws.append(self.rng.sample(population, number))
    return self.draws[-1]


def slow_kswin(xs, draws, window, stat_size, every, threshold, keep):
  """The docstring with SciPy's p-value, one sample at a time."""
  held, fired, draws = [], [], iter(draws)
  for t, x in enumerate(xs):
    held = (held + [x])[-window:]
    hit = False
    if len(held) == window and (t + 1) % every == 0:
      test = scipy.stats.ks_2samp([held[i] for i in next(draws)], held[-stat_size:], method="exact")
      hit = -math.log(max(test.pvalue, 1e-300)) > threshold
      held = held[-stat_size:] if hit and keep else [] if hit else held
    fired.append(hit)
  return np.array(fired)


def test_kswin_alarms_where_river_does(monkeypatch):
  rng = np.random.default_rng(4)
  xs = (rng.normal(size=900) + np.repeat([0.0, 1.5, 1.5, 0.5, 0.0, 2.0], 150)).astype(np.float32)
  oracle, want = RecordedKswin(alpha=0.005, window_size=100, stat_size=30), []
  for x in xs:
    oracle.update(float(x))
    want.append(oracle.drift_detected)
  table = jnp.asarray(np.array(oracle.draws))
  monkeypatch.setattr(
    importlib.import_module("mjx_cl.detectors.kswin"),
    "draw",
    lambda key, tests, older, number: table[tests],
  )
  fired, _ = run(kswin(threshold=-math.log(0.005), window=100, stat_size=30, every=1), xs)
  assert sum(want) >= 3
  assert np.flatnonzero(fired).tolist() == np.flatnonzero(want).tolist()

  settings = dict(
    threshold=4.0, window=100, stat_size=30, every=7, keep=True
  )  # not river's: the paper's window after an alarm, fewer tests
  fired, _ = run(kswin(**settings), xs)
  assert fired.sum() >= 3
  np.testing.assert_array_equal(fired, slow_kswin(xs, oracle.draws, **settings))


def test_kswin_finds_a_change_of_spread_and_depends_on_its_seed_alone():
  rng = np.random.default_rng(5)
  xs = rng.normal(size=1000) * np.where(np.arange(1000) < 700, 1.0, 4.0)
  settings = dict(stat_size=100)  # a distribution function moves less by a spread than by a shift
  fired, score = run(kswin(**settings), xs)
  assert (
    not fired[:700].any()
    and fired[700:].any()
    and np.isnan(score[:299]).all()
    and np.isfinite(score[299:]).all()
  )
  np.testing.assert_array_equal(run(kswin(**settings), xs)[1], score)
  assert (run(kswin(seed=1, **settings), xs)[1][299:700] != score[299:700]).any()


# ---- bocpd ---------------------------------------------------------------------------------------


def exact_bocpd(xs, threshold, hazard, recent, kappa, alpha, beta):
  """Every run length of its own, SciPy's Student-t, logarithms in float64: O(T^2)."""
  fired, scores = [], []
  restart = lambda: (np.zeros(1), np.zeros(1), np.full(1, beta))
  log_p, m, b = restart()
  for x in xs:
    run_length = np.arange(len(log_p))
    k, a = kappa + run_length, alpha + run_length / 2
    joint = log_p + scipy.stats.t.logpdf(x, 2 * a, m, np.sqrt(b * (k + 1) / (a * k)))
    joint -= scipy.special.logsumexp(joint)
    log_p = np.concatenate([[math.log(hazard)], math.log(1 - hazard) + joint])
    m, b = (
      np.concatenate([[0.0], (k * m + x) / (k + 1)]),
      np.concatenate([[beta], b + k * (x - m) ** 2 / (2 * (k + 1))]),
    )
    since = len(log_p) - 1  # the run that began with the restart
    new, old = log_p[1 : min(recent + 1, since)], log_p[max(1, min(recent + 1, since)) :]
    scores.append(
      scipy.special.logsumexp(new) - scipy.special.logsumexp(old) if len(new) else -np.inf
    )
    fired.append(scores[-1] > threshold)
    if fired[-1]:
      log_p, m, b = restart()
  return np.array(fired), np.array(scores)


def levels(rng, lengths, means, deviations):
  """Gaussian samples, level after level."""
  return np.concatenate(
    [rng.normal(m, s, n) for n, m, s in zip(lengths, means, deviations)]
  ).astype(np.float32)


@pytest.mark.parametrize(
  "settings",
  [
    dict(threshold=3.0, hazard=0.01, recent=20, kappa=0.1, alpha=1.0, beta=1.0),
    dict(threshold=60.0, hazard=0.002, recent=5, kappa=1.0, alpha=2.5, beta=0.5),
  ],
)
def test_bocpd_equals_the_exact_posterior(settings):
  xs = levels(np.random.default_rng(6), [120, 60, 100], [0.0, 2.5, 1.0], [1.0, 1.0, 0.2])
  fired, score = run(bocpd(max_run=300, warmup=0, **settings), xs)
  want_fired, want = exact_bocpd(xs.astype(float), **settings)
  seen = np.isfinite(want)  # -inf: no run began since the restart
  assert (
    seen.sum() > 200 and (want[seen] > 0).any() and want_fired.any() == (settings["threshold"] < 50)
  )
  np.testing.assert_allclose(
    score[seen], want[seen], rtol=1e-3, atol=2e-3
  )  # 280 float32 sums of log densities
  assert (score[~seen] < -9000).all()
  np.testing.assert_array_equal(fired, want_fired)


def test_bocpd_has_no_bound_that_a_large_step_reaches():
  settings = dict(threshold=1e9, hazard=0.002, recent=60, kappa=0.1, alpha=1.0, beta=1.0)
  xs = levels(np.random.default_rng(5), [260, 19], [0.0, 15.0], [1.0, 1.0])
  score, want = (
    run(bocpd(max_run=300, warmup=0, **settings), xs)[1],
    exact_bocpd(xs.astype(float), **settings)[1],
  )
  assert (
    want[-1] > 90 and want[-1] > want[-2] > want[-3]
  )  # where probabilities end at 1e-30 it stops at 69
  np.testing.assert_allclose(score[-19:], want[-19:], rtol=1e-3)


def test_bocpd_with_merged_tail_stays_near_the_exact_posterior():
  """Runs of 400 samples in 80 cells: the same alarms, and log odds within a quarter of a nat."""
  settings = dict(threshold=3.0, hazard=0.002, recent=30, kappa=0.1, alpha=1.0, beta=1.0)
  xs = levels(np.random.default_rng(7), [500, 400, 300], [0.0, 2.5, 1.0], [1.0, 1.0, 0.2])
  fired, score = run(bocpd(max_run=80, warmup=0, **settings), xs)
  want_fired, want = exact_bocpd(xs.astype(float), **settings)
  assert want_fired.sum() >= 2
  np.testing.assert_array_equal(np.flatnonzero(fired), np.flatnonzero(want_fired))
  near = np.abs(want) < 20
  assert np.abs(score - want)[near].max() < 0.25  # 0.08 seen


def test_bocpd_survives_the_impossible():
  xs = np.random.default_rng(8).normal(size=400)
  xs[200:203] = 1e30, -1e30, 0.0
  fired, score = run(bocpd(warmup=100, threshold=1e9), xs)
  assert (
    np.isnan(score[:100]).all()
    and np.isfinite(score[100:]).all()
    and score[200] > 30
    and not fired.any()
  )


def test_bocpd_gamma_ratio():
  a = np.array([8.0, 30.5, 1e3, 1e5])
  np.testing.assert_allclose(
    gamma_ratio(jnp.float32(a)),
    np.exp(scipy.special.gammaln(a + 0.5) - scipy.special.gammaln(a)),
    rtol=1e-6,
  )


# ---- e_detector ----------------------------------------------------------------------------------


def wealth(factors, form):
  """Sum or maximum over all starts j <= t of prod factors[j..t], float64 (steps,)."""
  out = []
  for t in range(len(factors)):
    products = np.cumprod(factors[t::-1])
    out.append(products.sum() if form == "sum" else products.max())
  return np.array(out)


@pytest.mark.parametrize(
  "form, two_sided, sign", [("sum", False, 1), ("max", False, 1), ("sum", True, -1)]
)
def test_e_detector_adds_up_bets_from_every_start(form, two_sided, sign):
  xs = np.random.default_rng(9).normal(0.0, 1.0, 120) + sign * np.repeat([0.0, 0.8], 60)
  shifts, bound, deviation = (0.5, 1.5), 0.1, 1.3
  settings = dict(
    bound=bound, deviation=deviation, shifts=shifts, form=form, two_sided=two_sided, warmup=0
  )
  xs = xs.astype(np.float32).astype(float)
  factor = lambda s, way: np.exp(s / deviation**2 * (way * xs - bound) - (s / deviation) ** 2 / 2)
  want = np.log(
    np.mean(
      [wealth(factor(s, way), form) for way in ((1, -1) if two_sided else (1,)) for s in shifts], 0
    )
  )
  fired, score = run(e_detector(threshold=1e9, **settings), xs)
  np.testing.assert_allclose(score, want, rtol=1e-4, atol=1e-4)  # 120 float32 logarithms
  fired, score = run(e_detector(threshold=4.0, **settings), xs)
  first = np.flatnonzero(want > 4.0)[0]
  assert np.flatnonzero(fired)[0] == first
  again = np.log(
    np.mean(
      [
        wealth(factor(s, way)[first + 1 :], form)
        for way in ((1, -1) if two_sided else (1,))
        for s in shifts
      ],
      0,
    )
  )
  np.testing.assert_allclose(
    score[first + 1 : first + 4], again[:3], rtol=1e-4, atol=1e-4
  )  # from nothing


BOUNDED = dict(threshold=math.log(200), bound=0.0, warmup=0)  # at least 200 samples per false alarm
SHAPE = (4000, 100)


def volatile(rng):
  """Martingale differences: fair signs whose size, from 0.2 to 1, rises after a plus and falls
  after a minus; sub-Gaussian with deviation 1.
  """
  x, size = np.zeros(SHAPE), np.ones(SHAPE[1])
  for t in range(SHAPE[0]):
    x[t] = size * rng.choice([-1.0, 1.0], SHAPE[1])
    size = np.clip(size * np.exp(0.3 * np.sign(x[t])), 0.2, 1.0)
  return x


def test_e_detector_keeps_its_bound_on_martingale_differences():
  rng = np.random.default_rng(10)
  gaussian, dependent = rng.normal(size=SHAPE), volatile(rng)
  assert np.corrcoef(np.abs(dependent[1:]).ravel(), np.abs(dependent[:-1]).ravel())[0, 1] > 0.5
  detector = e_detector(**BOUNDED)
  for xs in (gaussian, dependent):  # the first is the worst case, on the edge of the class
    mean, error = arl(detector, xs)
    assert mean > 200 - 3 * error
  assert (
    arl(detector, gaussian + 0.3)[0] < 150
  )  # the bound is no platitude: a mean beyond it breaks it
  assert arl(e_detector(form="max", **BOUNDED), gaussian)[0] > arl(detector, gaussian)[0]


def test_e_detector_needs_an_autocorrelated_stream_whitened():
  phi = 0.9
  xs = autoregression(np.random.default_rng(11), SHAPE, phi)
  white = (xs[1:] - phi * xs[:-1]) / math.sqrt(1 - phi**2)
  assert arl(e_detector(**BOUNDED), xs)[0] < 100
  mean, error = arl(e_detector(**BOUNDED), white)
  assert mean > 200 - 3 * error


# ---- conformal -----------------------------------------------------------------------------------


def ranks(xs, two_sided, bins, freeze, seed):
  """Conformal p-values by counting lists, with the detector's own U."""
  a = np.clip((np.abs(xs) if two_sided else xs - LOW) // WIDTH, 0, bins - 1)
  keys = jax.random.wrap_key_data(
    jnp.stack([jnp.full(len(xs), seed, jnp.uint32), jnp.arange(len(xs), dtype=jnp.uint32)], 1),
    impl="threefry2x32",
  )
  u = 1 - np.asarray(jax.vmap(jax.random.uniform)(keys), float)
  past = lambda t: np.append(a[: t if freeze == 0 else min(t, freeze)], a[t])
  return np.array(
    [
      ((past(t) > a[t]).sum() + u[t] * (past(t) == a[t]).sum()) / len(past(t))
      for t in range(len(xs))
    ]
  )


@pytest.mark.parametrize(
  "settings",
  [
    dict(form="sum", two_sided=False, bins=33, freeze=0),
    dict(form="max", two_sided=True, bins=9, freeze=40),
  ],
)
def test_conformal_bets_on_ranks_from_every_start(settings):
  xs = (np.random.default_rng(12).normal(size=150) + np.repeat([0.0, 1.5], 75)).astype(np.float32)
  bets, seed = (0.2, 0.7), 9
  p = ranks(xs, settings["two_sided"], settings["bins"], settings["freeze"], seed)
  assert scipy.stats.kstest(p[:75], "uniform").pvalue > 1e-3 and p[75:100].mean() < 0.35
  want = np.log(np.mean([wealth(e * p ** (e - 1), settings["form"]) for e in bets], 0))
  _, score = run(conformal(threshold=1e9, bets=bets, seed=seed, warmup=0, **settings), xs)
  np.testing.assert_allclose(score, want, rtol=1e-4, atol=1e-4)  # 150 float32 logarithms


def test_conformal_keeps_its_bound_on_exchangeable_streams_of_any_distribution():
  rng = np.random.default_rng(13)
  detector = conformal(threshold=math.log(200), warmup=50)
  for xs in (
    rng.normal(size=SHAPE),
    rng.standard_cauchy(SHAPE),
    rng.choice([0.0, 1.0, 5.0], SHAPE, p=[0.6, 0.3, 0.1]),
  ):
    mean, error = arl(detector, xs[:2000])
    assert mean > 200 - 3 * error


def test_conformal_fails_on_an_autocorrelated_stream():
  xs = autoregression(np.random.default_rng(14), SHAPE, 0.9)
  assert arl(conformal(threshold=math.log(200), warmup=50), xs[:2000])[0] < 100


def test_conformal_holds_on_the_whitened_form_of_the_same_stream():
  """Its innovations are nearly independent: the mean time to an alarm keeps the bound, which the
  raw stream breaks twofold.
  """
  from mjx_cl.detectors import combine

  xs = autoregression(np.random.default_rng(14), (SHAPE[0] + 550, SHAPE[1]), 0.9)
  mean, error = arl(
    combine.whitened(conformal(threshold=math.log(200), warmup=50), order=1, warmup=500), xs
  )
  assert (
    mean * (1 - 501 / len(xs)) > 200 - 3 * error
  )  # the samples of the fit, once for each stream, are no run


def test_conformal_ranks_take_in_a_lasting_change_unless_frozen():
  rng = np.random.default_rng(15)
  xs = rng.normal(size=(3500, 20)) + 1.5 * (np.arange(3500) >= 500)[:, None]
  late = {
    freeze: run(conformal(warmup=100, freeze=freeze), xs)[0][2500:].sum() for freeze in (0, 400)
  }
  assert late[400] > 500 > 100 > late[0]  # of 20,000 samples


def test_conformal_error_of_a_frozen_reference_breaks_the_bound():
  """100 ranked samples with a few large ones too few pay out to that error at every later sample."""
  xs = np.random.default_rng(16).normal(size=(3000, 100))
  mean, error = arl(conformal(threshold=math.log(1000), warmup=0, freeze=100), xs)
  assert mean < 1000 - 3 * error
