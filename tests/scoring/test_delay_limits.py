"""Limits of the delay, and the oracle detector that is fitted on them: closed forms, an integral
equation, SciPy, simulation.
"""

import itertools
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
import scipy.stats

from mjx_cl.detectors.likelihood_ratio import likelihood_ratio
from mjx_cl.errors import UserError
from mjx_cl.rollout.monitor import unknown
from mjx_cl.scoring import autoregression, limits


def residual(x, reward=None):
  """monitor.Residual whose opr is x."""
  r = unknown(x.shape, 1)
  return r._replace(opr=x, valid=jnp.isfinite(x), reward=r.reward if reward is None else reward)


def ar1(rng, phi, shape):
  """Stationary AR(1) of unit variance, time first."""
  e = rng.standard_normal(shape)
  e[1:] *= math.sqrt(1 - phi * phi)
  return scipy.signal.lfilter([1], [1, -phi], e, axis=0)


def gaussian(shift):
  """Parameters of a mean shift in independent standard normal values."""
  model = lambda mean: autoregression.Conditional(
    np.array([mean]), np.zeros((0, 1, 1)), np.eye(1), np.array(0.0)
  )
  return autoregression.Parameters(model(0.0), model(shift))


@jax.jit
def alarms(parameters, thresholds, xs):
  """fired (T, H, S) of streams xs (T, S) at thresholds (H,): parameters and thresholds are traced."""

  def one(threshold, x):
    detector = likelihood_ratio(parameters, threshold, log=False)
    return jax.lax.scan(detector.update, detector.init(), residual(x))[1].fired

  return jax.vmap(jax.vmap(one, (None, 1), 1), (0, None), 1)(thresholds, xs)


def run_length(shift, threshold, drift, nodes=200):
  """Mean run length from zero of W = max(0, W + l), l ~ N(drift, shift^2), to W > threshold, by
  Gauss-Legendre on its integral equation.
  """
  x, w = np.polynomial.legendre.leggauss(nodes)
  x, w = (x + 1) * threshold / 2, w * threshold / 2
  x0 = np.concatenate([[0.0], x])
  kernel = np.concatenate(
    [
      scipy.stats.norm.cdf(-x0, drift, shift)[:, None],
      scipy.stats.norm.pdf(x - x0[:, None], drift, shift) * w,
    ],
    1,
  )
  return np.linalg.solve(np.eye(nodes + 1) - kernel, np.ones(nodes + 1))[0]


# ---- closed forms --------------------------------------------------------------------------------


@pytest.mark.parametrize(
  "arl0, shift, delay, half_digit",
  [
    (370, 0.25, 57, 0.5),
    (370, 0.5, 24, 0.5),
    (370, 1, 8.5, 0.05),
    (370, 3, 1.4, 0.05),
    (1e4, 0.5, 49, 0.5),
    (1e4, 1, 15.0, 0.05),
    (1e5, 0.5, 67, 0.5),
    (1e5, 1, 19.6, 0.05),
  ],
)
def test_brownian_delay_equals_its_table(arl0, shift, delay, half_digit):
  assert limits.brownian(arl0, shift).delay == pytest.approx(delay, abs=half_digit)
  assert limits.brownian(arl0, -shift) == limits.brownian(arl0, shift)


@pytest.mark.parametrize("threshold, arl0, arl1", [(5, 930, 10.4), (4, 335, 8.38)])
def test_brownian_agrees_with_published_run_lengths_of_the_one_sided_cusum(threshold, arl0, arl1):
  """Reference value 0.5, shift 1: there the log-likelihood ratio is x - 0.5, so that the chart's h
  is the threshold. Siegmund's error is 1 %.
  """
  limit = limits.brownian(arl0, 1.0)
  assert limit.threshold == pytest.approx(threshold, abs=0.015)
  assert limit.delay == pytest.approx(arl1, rel=0.01)
  assert limits.brownian(arl0, 1.0, discrete=False).threshold == pytest.approx(
    limit.threshold + 1.166
  )


def test_brownian_refuses_what_has_no_limit():
  for arl0, shift in ((0, 1), (100, 0), (math.nan, 1), (100, math.inf)):
    with pytest.raises(UserError, match="brownian"):
      limits.brownian(arl0, shift)


# ---- the oracle ----------------------------------------------------------------------------------


def test_oracle_has_the_optimal_run_lengths_of_independent_gaussian_values():
  """CUSUM is Moustakides' optimum, whose run lengths solve an integral equation: simulated ones
  equal those within four standard errors, and the closed form at the measured ARL0 within 2 % more,
  its own error in discrete time."""
  shift, rng = 1.0, np.random.default_rng(0)
  threshold = limits.brownian(370, shift).threshold
  fired = np.asarray(
    alarms(
      gaussian(shift),
      jnp.array([threshold]),
      jnp.asarray(rng.standard_normal((4000, 200)), jnp.float32),
    )
  )
  arl0, error = (
    fired.size / fired.sum(),
    1 / math.sqrt(fired.sum()),
  )  # run lengths are nearly exponential: relative error of their mean
  assert arl0 == pytest.approx(run_length(shift, threshold, -(shift**2) / 2), rel=4 * error)

  after = np.asarray(
    alarms(
      gaussian(shift),
      jnp.array([threshold]),
      jnp.asarray(shift + rng.standard_normal((200, 4000)), jnp.float32),
    )
  )[:, 0]
  assert after.any(0).all()
  delay = after.argmax(0) + 1
  error = delay.std() / math.sqrt(delay.size)
  assert delay.mean() == pytest.approx(run_length(shift, threshold, shift**2 / 2), abs=4 * error)
  assert delay.mean() == pytest.approx(
    limits.brownian(arl0, shift).delay, abs=4 * error + 0.02 * delay.mean()
  )


@pytest.mark.parametrize(
  "phi, shift, plain_grid, share",
  [(0.9, 3.0, (30, 50), (0.1, 0.5)), (-0.8, 0.5, (1.5, 2.1), (1.0, 1.25))],
)
def test_oracle_beats_a_plain_cusum_on_correlated_data_at_equal_arl0(phi, shift, plain_grid, share):
  """AR(1) with a mean shift: fitted on other seeds, against a CUSUM of the true shift that takes
  values as independent.

  Each one's delay is read at ARL0 2,000 from runs at a grid of thresholds, log-linear between them.
  The first innovation after the onset is 1 / (1 - phi) times the later ones: with phi 0.9 it makes
  the oracle quicker than the closed form (`share`), with phi -0.8 slower.
  """
  onset, target = 100, 2000.0
  rng = np.random.default_rng(1)
  fitted = autoregression.fit(ar1(rng, phi, (2000, 10)), shift + ar1(rng, phi, (2000, 10)), order=1)
  nominal, faulty = ar1(rng, phi, (3000, 150)), ar1(rng, phi, (400, 1000))
  faulty[onset:] += shift
  delays = []
  for parameters, grid in ((gaussian(shift), plain_grid), (fitted, (4, 8))):
    at = jnp.linspace(*grid, 5)
    healthy = np.asarray(alarms(parameters, at, jnp.asarray(nominal, jnp.float32)))
    arl0 = healthy.shape[0] * healthy.shape[2] / healthy.sum((0, 2))
    hits = np.asarray(alarms(parameters, at, jnp.asarray(faulty, jnp.float32)))[onset:]
    delay = np.where(hits.any(0), hits.argmax(0) + 1, len(hits)).mean(-1)
    assert arl0.min() < target < arl0.max() and (np.diff(delay) > 0).all()
    delays.append(np.interp(math.log(target), np.log(arl0), delay))
  plain, oracle = delays
  assert oracle < 0.75 * plain  # measured 0.54 and 0.65, standard errors about 0.02
  low, high = share
  assert (
    low < oracle / limits.brownian(target, shift * math.sqrt((1 - phi) / (1 + phi))).delay < high
  )


def test_oracle_score_is_a_numpy_cusum_of_the_log_ratio():
  """Two channels, one with a logarithm, a gap, a second-order fit: against `log_ratio`, which is
  NumPy in float64.
  """
  rng = np.random.default_rng(2)
  x = np.stack([np.exp(ar1(rng, 0.5, (300, 4))), ar1(rng, 0.7, (300, 4))], -1)
  x[150:] += [0.5, -0.5]
  y = np.stack([np.log(x[..., 0]), x[..., 1]], -1)
  parameters = autoregression.fit(y[:150], y[150:], order=2)
  detector = likelihood_ratio(parameters, 3.0, ("opr", "reward"))
  out = jax.jit(jax.vmap(lambda r: jax.lax.scan(detector.update, detector.init(), r)[1], 1, 1))
  got = jax.device_get(
    out(residual(jnp.asarray(x[..., 0], jnp.float32), jnp.asarray(x[..., 1], jnp.float32)))
  )
  ratio, evidence = autoregression.log_ratio(y, parameters), np.zeros(4)
  assert np.isnan(got.score[:2]).all() and not got.fired[:2].any()
  for t in range(298):
    evidence = np.maximum(0, evidence + ratio[t])
    np.testing.assert_allclose(
      got.score[t + 2], evidence, atol=1e-3
    )  # float32 sums of up to 150 terms of size 10
    np.testing.assert_array_equal(got.fired[t + 2], evidence > 3)
    evidence[evidence > 3] = 0
  assert got.fired.sum() > 4

  masked = residual(
    jnp.asarray(x[..., 0], jnp.float32), jnp.asarray(x[..., 1], jnp.float32).at[100].set(jnp.nan)
  )
  with_gap = out(masked)
  assert np.isnan(with_gap.score[100]).all() and not with_gap.fired[100].any()
  without = out(
    jax.tree.map(lambda a: jnp.concatenate([a[:100], a[101:]] + [a[:1]]), masked)
  )  # of the same length: the same program
  np.testing.assert_array_equal(with_gap.score[101:], without.score[100:299])


def test_oracle_is_one_program_for_all_parameters_and_thresholds():
  chex.clear_trace_counter()
  program = jax.jit(
    chex.assert_max_traces(
      lambda p, t, x: (
        likelihood_ratio(p, t).update(likelihood_ratio(p, t).init(), residual(x))[1].score
      ),
      1,
    )
  )
  scores = [
    float(program(gaussian(s), jnp.float32(h), jnp.float32(math.e**2)))
    for s, h in ((1.0, 3.0), (2.0, 8.0))
  ]
  assert scores == pytest.approx([2 - 0.5, 2 * 2 - 2])  # s x - s^2 / 2 at x = 2


def test_oracle_refuses_wrong_settings_in_one_line():
  for settings in (
    {"threshold": 0.0},
    {"channels": ("oprr",)},
    {"channels": ()},
    {"channels": ("opr", "rpr")},
  ):
    with pytest.raises(UserError) as e:
      likelihood_ratio(gaussian(1.0), **settings)
    assert "\n" not in str(e.value)


# ---- fits and information ------------------------------------------------------------------------


@pytest.mark.parametrize("phi, shift", [(0.0, 0.5), (0.0, 1.0), (0.5, 1.0), (0.9, 2.0)])
def test_information_recovers_the_closed_form(phi, shift):
  rng = np.random.default_rng(3)
  got = limits.information(ar1(rng, phi, (3000, 10)), shift + ar1(rng, phi, (3000, 10)), order=4)
  want, value = shift**2 / 2 * (1 - phi) / (1 + phi), got["information_nats_per_step"]
  # ratio of each step has variance 2 I; the fit adds about the error of the two means; four errors
  # of the 30,000 and twice 15,000 steps
  assert value == pytest.approx(want, abs=4 * math.sqrt(2 * want * (1 / 30_000 + 2 / 15_000)))
  low, high = got["information_nats_per_step_ci"]
  assert low < value < high and high - low < 0.2 * want + 0.02


def test_information_of_two_channels_and_of_a_variance():
  """Independent channels add up; N(0, s^2) against N(0, 1) has (s^2 - 1) / 2 - ln s nats."""
  rng = np.random.default_rng(4)
  nominal, faulty = rng.standard_normal((2, 3000, 7, 2))  # an odd number of seeds
  faulty[..., 0] += 0.6
  faulty[..., 1] *= 1.5
  want = 0.18, (1.5**2 - 1) / 2 - math.log(1.5)
  each = [
    limits.information(nominal[..., c], faulty[..., c], order=1)["information_nats_per_step"]
    for c in (0, 1)
  ]
  both = limits.information(nominal, faulty, order=1)["information_nats_per_step"]
  np.testing.assert_allclose(
    each,
    want,
    atol=0.03,
    # four errors: the ratio of a step has a variance of at most 1, over 21,000 steps, and the fit's
  )
  assert both == pytest.approx(sum(want), abs=0.04)


def test_information_without_a_change_is_about_zero():
  rng = np.random.default_rng(5)
  got = limits.information(ar1(rng, 0.9, (2000, 10)), ar1(rng, 0.9, (2000, 10)))
  assert (
    abs(got["information_nats_per_step"]) < 0.005
  )  # two fits of 10 parameters on 10,000 steps lose about 0.001


def test_information_is_measured_on_other_seeds_than_it_was_fitted_on():
  """Twice 21 parameters on 80 steps of noise: judged on its own steps a fit finds much where
  nothing is to be known; on others nothing, on average exactly so, since healthy and faulty streams
  could change places."""
  own, other = [], []
  for seed in range(30):
    nominal, faulty = np.random.default_rng(seed).standard_normal((2, 100, 2))
    other.append(limits.information(nominal, faulty, order=20, reps=2)["information_nats_per_step"])
    own.append(
      np.nanmean(
        autoregression.log_ratio(
          faulty[:, :1], autoregression.fit(nominal[:, 1:], faulty[:, :1], order=20)
        )
      )
    )
  error = np.std(other) / math.sqrt(len(other))
  assert abs(np.mean(other)) < 4 * error < np.mean(own)


def test_fit_recovers_an_autoregression_and_leaves_unknown_steps_out():
  """A VAR(1) with unlike cross terms, so that a transposed matrix fails; 5 % of its steps unknown."""
  rng = np.random.default_rng(7)
  matrix, factor, mean = (
    np.array([[0.5, 0.3], [-0.2, 0.6]]),
    np.array([[1.0, 0.0], [0.5, 0.8]]),
    np.array([1.0, -2.0]),
  )
  x = np.zeros((5000, 8, 2))
  for t in range(1, 5000):
    x[t] = x[t - 1] @ matrix.T + rng.standard_normal((8, 2)) @ factor.T
  x += mean
  x[rng.random((5000, 8)) < 0.05] = np.nan
  model = autoregression.fit(x, x, order=1).before
  # four errors: 36,000 steps, coefficients' errors are about 1 / sqrt(36,000) of the deviations'
  # ratio
  np.testing.assert_allclose(model.lags[0], matrix, atol=0.03)
  np.testing.assert_allclose(model.intercept, mean - matrix @ mean, atol=0.05)
  np.testing.assert_allclose(np.linalg.inv(model.whitener), factor, atol=0.03)
  assert model.log_det == pytest.approx(2 * math.log(0.8), abs=0.04)
  e = autoregression.innovations(x, model)
  np.testing.assert_allclose(
    np.nanmean(e[..., None] * e[..., None, :], (0, 1)), np.eye(2), atol=1e-5
  )  # the floor adds a millionth


def test_a_frozen_channel_is_finite():
  rng = np.random.default_rng(8)
  ratio = autoregression.log_ratio(
    np.full((50, 2), 3.0),
    autoregression.fit(rng.standard_normal((500, 2)), np.full((500, 2), 3.0), order=2),
  )
  assert np.isfinite(ratio).all() and (ratio > 5).all()


def test_fits_refuse_too_little():
  x = np.zeros((10, 2))
  for call in (
    lambda: autoregression.fit(x, x, order=20),
    lambda: autoregression.fit(x, x, order=8),
    lambda: autoregression.fit(x, np.zeros((10, 2, 2))),
    lambda: limits.information(np.zeros((99, 1)), np.zeros((99, 1))),
    lambda: limits.information(np.zeros((99, 2)), np.zeros((99, 3))),
  ):
    with pytest.raises(UserError):
      call()


# ---- whitening and the closed form ---------------------------------------------------------------


def whitened(x):
  """Innovations under a fit of order 2, and the fit."""
  model = autoregression.fit(x, x, 2).before
  return autoregression.innovations(x, model)[..., 0], model


def test_ljung_box_by_hand_and_its_level():
  """Q against a plain loop with SciPy's chi-square; on white streams p is uniform, after a fit too."""
  rng = np.random.default_rng(9)
  x = ar1(rng, 0.1, (200, 3))
  q = 0.0
  for e in (x - x.mean(0)).T:
    q += sum(200 * 202 * (e[k:] @ e[:-k] / (e @ e)) ** 2 / (200 - k) for k in range(1, 6))
  got = autoregression.ljung_box(x, lags=5, fitted=1)
  assert got == pytest.approx((q, scipy.stats.chi2.sf(q, 14)))

  p = [autoregression.ljung_box(whitened(ar1(rng, 0.8, 1000))[0], fitted=2)[1] for _ in range(200)]
  assert scipy.stats.kstest(p, "uniform").pvalue > 1e-3
  assert autoregression.ljung_box(ar1(rng, 0.2, (1000, 2)))[1] < 1e-6


def test_innovations_of_its_own_fit_have_unit_deviation():
  x = 5 + 3 * ar1(np.random.default_rng(10), 0.9, (4000, 5))
  white, model = whitened(x)
  assert white.shape == (3998, 5) and np.std(white) == pytest.approx(1, abs=1e-3)
  np.testing.assert_allclose(
    model.lags.ravel(), [0.9, 0.0], atol=0.03
  )  # four errors, 1 / sqrt(20,000)


def test_closed_form_is_printed_where_it_applies_alone():
  rng = np.random.default_rng(11)
  draw = lambda: ar1(rng, 0.6, (2000, 8))
  nominal = draw()
  fits = limits.closed_form(nominal, 1 + draw(), 1e4, order=2)
  want = limits.brownian(1e4, math.sqrt(0.4 / 1.6)).delay
  # information 0.125 +- 0.009 (four errors, as above), and the delay goes about as its inverse
  assert fits["note"] is None and fits["optimal_delay_steps"] == pytest.approx(want, rel=0.08)
  low, high = fits["optimal_delay_steps_ci"]
  assert (
    want * 0.85 < low < fits["optimal_delay_steps"] < high < want * 1.15
  )  # eight streams of 2,000: the shift to 0.8 %, its ends four times that at most
  swing = nominal + 2 * np.sin(2 * np.pi * np.arange(2000) / 40)[:, None]  # a gait
  nonlinear = np.where(
    np.arange(2000)[:, None] // 100 % 2, nominal, 3 * rng.standard_normal((2000, 8))
  )
  for healthy, faulty, reason in (
    (nonlinear, 1 + nonlinear, "not white"),
    (swing, 1 + swing, "not white"),
    (nominal, draw(), "not show|mere"),
    (nominal, 2 * draw(), "mere shift"),
  ):
    got = limits.closed_form(healthy, faulty, 1e4, order=2)
    assert got["optimal_delay_steps"] is None and len(got["note"].splitlines()) == 1
    assert any(word in got["note"] for word in reason.split("|")), got


# ---- efficiency ----------------------------------------------------------------------------------


def test_efficiency_is_the_ratio_of_restricted_means():
  got = limits.efficiency([0, 1, 4, 8], [3, None, 7, math.inf], horizon=100)
  oracle, mine = (1 + 2 + 5 + 9) / 4, (4 + 100 + 8 + 100) / 4
  assert (got["oracle_delay_steps"], got["delay_steps"]) == (oracle, mine)
  assert got["efficiency"] == oracle / mine and got["note"] is None
  for name in ("efficiency", "oracle_delay_steps", "delay_steps"):
    low, high = got[f"{name}_ci"]
    assert low < got[name] < high
  every = [
    np.mean(x) for x in itertools.product((1, 2, 5, 9), repeat=4)
  ]  # all draws of a bootstrap over four seeds
  assert got["oracle_delay_steps_ci"] == pytest.approx(
    np.quantile(every, [0.025, 0.975], method="nearest").tolist(), abs=0.26
  )  # a step of that law, 20,000 draws
  assert (
    limits.efficiency([500], [600], horizon=100)["efficiency"] == 1.0
  )  # beyond the horizon is a miss
  one = limits.efficiency([5], [6], horizon=100)
  assert one["efficiency_ci"] is one["oracle_delay_steps_ci"] is one["delay_steps_ci"] is None
  better = limits.efficiency([5, 5], [4, 4], horizon=100)
  assert better["efficiency"] == 6 / 5 and better["note"].startswith("above 1")
  with pytest.raises(UserError):
    limits.efficiency([1, 2], [1], horizon=10)


def test_efficiency_draws_seeds_in_pairs():
  """Detector twice as slow on every seed: paired draws leave no doubt, unpaired ones would leave
  much.
  """
  got = limits.efficiency([1, 3, 7, 15, 31], [3, 7, 15, 31, 63], horizon=1000)
  assert got["efficiency"] == 0.5 and got["efficiency_ci"] == pytest.approx([0.5, 0.5])
