"""Combinators: several detectors, several samples, and what a stream passes through first."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from mjx_cl import detectors
from mjx_cl.detectors import (
  Alarm,
  Detector,
  cool_down,
  cusum,
  on,
  page_hinkley,
  patience,
  whitened,
  z_score,
)
from mjx_cl.errors import PluginError, UserError
from mjx_cl.rollout.monitor import unknown


def echo(threshold=0.5):
  """Fires above `threshold`; score is the sample, nan stays unknown; the state counts."""
  return Detector(
    lambda: jnp.int32(0), lambda state, x: (state + 1, Alarm(x > threshold, jnp.float32(x)))
  )


def run(detector, xs):
  state, alarms = jax.jit(lambda xs: jax.lax.scan(detector.update, detector.init(), xs))(
    jax.tree.map(jnp.asarray, xs)
  )
  return state, np.asarray(alarms.fired), np.asarray(alarms.score)


def rows(opr, rpr=None):
  """Residuals whose OPR is `opr`, float (T,); nan: invalid."""
  opr = jnp.asarray(opr, jnp.float32)
  rpr = opr if rpr is None else jnp.asarray(rpr, jnp.float32)
  return unknown(opr.shape, 4)._replace(opr=opr, rpr=rpr, valid=jnp.isfinite(opr))


# ---- patience ------------------------------------------------------------------------------------


def slow_patient_cusum(zs, slack, threshold, k):
  """Page's sums, spent only by the k-th score in a row above the threshold."""
  up = down = run = 0
  fired = []
  for z in zs:
    up, down = max(0.0, up + z - slack), max(0.0, down - z - slack)
    run = run + 1 if max(up, down) > threshold else 0
    fired.append(run >= k)
    if fired[-1]:
      up = down = 0.0
  return np.array(fired)


@pytest.mark.parametrize("k", [1, 2, 7])
def test_patience_fires_at_the_kth_score_in_a_row(k):
  zs = (np.random.default_rng(0).normal(size=800) + np.repeat([0.0, 1.0, 0.0, -2.0], 200)).astype(
    np.float32
  )
  _, fired, _ = run(patience(cusum, k, slack=0.5, threshold=4.0, warmup=0), zs)
  want = slow_patient_cusum(zs.astype(float), 0.5, 4.0, k)
  np.testing.assert_array_equal(fired, want)
  assert want.sum() > 10


def test_patience_of_one_changes_nothing():
  xs = np.random.default_rng(1).normal(size=600).astype(np.float32) + np.repeat([0, 2], 300).astype(
    np.float32
  )
  for factory in (cusum, page_hinkley, z_score):
    _, fired, score = run(patience(factory, 1, threshold=2.0, warmup=50), xs)
    _, plain, plain_score = run(factory(threshold=2.0, warmup=50), xs)
    np.testing.assert_array_equal(fired, plain)
    np.testing.assert_array_equal(score, plain_score)
    assert fired.any()


def test_patience_leaves_one_alarm_per_excursion():
  quiet, loud = [0.0] * 3, [9.0]
  xs = np.float32(quiet + loud * 2 + quiet + loud * 9 + quiet + loud * 4)
  _, fired, _ = run(patience(z_score, 3, threshold=4.0, warmup=0), xs)
  assert np.flatnonzero(fired).tolist() == [
    10,
    22,
  ]  # the third of nine and of four; two are too few


def test_patience_is_not_ended_by_a_sample_without_a_score():
  def factory(threshold=0.5):
    return echo(threshold)

  _, fired, _ = run(patience(factory, 2), np.float32([1, np.nan, 1, 0, 1, np.nan, 0, 1]))
  assert np.flatnonzero(fired).tolist() == [2]


def test_patience_needs_a_threshold():
  with pytest.raises(UserError, match="threshold"):
    patience(lambda: echo(), 2)
  with pytest.raises(UserError, match="k must be"):
    patience(cusum, 0)
  with pytest.raises(UserError, match="slack must be"):
    patience(cusum, 2, slack=-1.0)


# ---- cool_down -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
  "steps, want",
  [(0, [1, 2, 3, 5, 8, 9]), (1, [1, 3, 5, 8]), (2, [1, 5, 9]), (4, [1, 8]), (50, [1])],
)
def test_cool_down_drops_the_alarms_after_one(steps, want):
  xs = np.float32([0, 1, 1, 1, 0, 1, np.nan, 0, 1, 1])
  state, fired, score = run(cool_down(echo(), steps), xs)
  assert np.flatnonzero(fired).tolist() == want
  np.testing.assert_array_equal(score, xs)
  assert int(state.inner) == len(xs)  # the detector runs on


# ---- whitened ------------------------------------------------------------------------------------


def autoregressive(coefficients, steps, seed=0, level=0.0, streams=None):
  """Stationary up to a burn-in of 500; innovations of deviation 1."""
  noise = np.random.default_rng(seed).normal(
    size=(steps + 500,) + (() if streams is None else (streams,))
  )
  xs = np.zeros_like(noise)
  for t in range(len(noise)):
    xs[t] = noise[t] + sum(a * xs[t - 1 - j] for j, a in enumerate(coefficients) if t > j)
  return (level + xs[500:]).astype(np.float32), noise[500:]


@pytest.mark.parametrize(
  "order, coefficients, level",
  [
    (1, (0.9,), 0.0),
    (2, (1.2, -0.5), 40.0),
    (8, (0.9,), -5.0),
    (5, (), 3.0),
    (3, (0.0, 0.0, 0.7), 0.0),
  ],
)
def test_whitened_hands_on_the_innovations_of_yule_walker(order, coefficients, level):
  warmup = 400
  xs, _ = autoregressive(coefficients, 700, level=level)
  state, _, score = run(whitened(echo(), order, warmup), xs)
  past = xs[:warmup].astype(float) - xs[:warmup].astype(float).mean()
  c = np.array([past[k:] @ past[: warmup - k] for k in range(order + 1)]) / warmup
  a = scipy.linalg.solve_toeplitz(c[:-1], c[1:])
  centred = xs.astype(float) - xs[:warmup].astype(float).mean()
  ready = warmup + order
  want = np.array([centred[t] - a @ centred[t - 1 :: -1][:order] for t in range(ready, len(xs))])
  assert np.isnan(score[:ready]).all() and int(state.inner) == len(xs) - ready
  # float32 sums of 400 products, and a solution whose condition is that of the stream
  np.testing.assert_allclose(-np.asarray(state.filters.forward)[1:], a, atol=2e-3)
  np.testing.assert_allclose(score[ready:], want, atol=5e-3)
  if coefficients:
    np.testing.assert_allclose(a[: len(coefficients)], coefficients, atol=0.15)  # 3 / sqrt(400)


def test_whitened_survives_a_constant_stream():
  _, fired, score = run(whitened(echo(), 4, 50), np.full(100, 3.0, np.float32))
  assert not fired.any() and (score[54:] == 0).all()


def run_length(detector, xs, quiet):
  """Samples per alarm after the first `quiet` ones, and its relative error were run lengths
  geometric; xs (T, streams).
  """
  start = jax.tree.map(lambda x: jnp.broadcast_to(x, (xs.shape[1],) + x.shape), detector.init())
  fired = np.asarray(
    jax.jit(lambda xs: jax.lax.scan(jax.vmap(detector.update), start, xs)[1].fired)(jnp.asarray(xs))
  )
  assert not fired[:quiet].any()
  return fired[quiet:].size / fired.sum(), 1 / np.sqrt(fired.sum())


def test_whitening_restores_the_run_length_of_a_dependent_stream():
  """AR(1) with 0.9: as it is, CUSUM (0.5, 4) fires many times as often as on independent samples;
  behind `whitened` as often.
  """
  warm, streams, steps = 4000, 100, 8000
  quiet = 2 * warm + 4
  xs, noise = autoregressive((0.9,), quiet + steps, streams=streams)
  independent, error = run_length(
    cusum(0.5, 4.0, warmup=warm), noise.astype(np.float32)[warm + 4 :], warm
  )
  raw, _ = run_length(cusum(0.5, 4.0, warmup=warm), xs[warm + 4 :], warm)
  white, error_white = run_length(whitened(cusum(0.5, 4.0, warmup=warm), 4, warm), xs, quiet)
  assert raw < independent / 4
  # 3 standard errors of both counts, and 5 % for the fit: coefficients are off by 1 / sqrt(4,000) =
  # 1.6 % each
  assert abs(white / independent - 1) < 3 * np.hypot(error, error_white) + 0.05, (
    raw,
    white,
    independent,
  )
  assert (
    abs(independent / 168 - 1) < 3 * error + 0.05
  )  # the published figure; mean and deviation of 4,000 samples cost a little


# ---- make ----------------------------------------------------------------------------------------


def test_make_puts_the_parts_in_order():
  """Logarithm, then whitening, then the detector with its patience, on each channel; the cool-down
  over all of them.
  """
  steps = 1600  # whitening alone warms up for 1,000 samples
  keep = np.random.default_rng(4).random(steps) > 0.1
  xs = rows(
    *(np.where(keep, np.exp(autoregressive((0.8,), steps, seed=s)[0]), np.nan) for s in (1, 2))
  )
  made = detectors.make("cusum", whiten=3, patience=2, cool_down=30, warmup=100, threshold=1.5)
  whole = lambda: whitened(patience(cusum, 2, warmup=100, threshold=1.5), 3)
  by_hand = cool_down(
    detectors.any_of(on("opr", whole(), log=True), on("rpr", whole(), log=True)), 30
  )
  (_, fired, score), (_, fired_hand, score_hand) = run(made, xs), run(by_hand, xs)
  np.testing.assert_array_equal(fired, fired_hand)
  np.testing.assert_array_equal(score, score_hand)
  valid = np.flatnonzero(keep)
  assert np.isnan(score[: valid[1103]]).all() and np.isfinite(
    score[valid[1103]]
  )  # 1,000 + 3 + 100 valid samples
  assert fired.sum() > 3 and np.diff(np.flatnonzero(fired)).min() > 30


def test_the_whole_chain_keeps_the_contract(same):
  """Types, vmap against single streams, and a masked row that changes nothing."""
  detector = detectors.make(
    "cusum", channel="opr", whiten=3, patience=2, cool_down=5, warmup=100, threshold=1.0
  )
  streams, steps = 3, 1300
  xs = rows(
    np.where(
      np.random.default_rng(1).random((steps, streams)) > 0.1,
      np.exp(np.random.default_rng(0).normal(size=(steps, streams))),
      np.nan,
    )
  )
  state = detector.init()
  new, _ = jax.eval_shape(detector.update, state, jax.tree.map(lambda x: x[0, 0], xs))
  assert jax.tree.map(lambda a: (a.shape, a.dtype), new) == jax.tree.map(
    lambda a: (a.shape, a.dtype), state
  )
  start = jax.tree.map(lambda x: jnp.broadcast_to(x, (streams,) + x.shape), state)
  last, alarms = jax.jit(lambda xs: jax.lax.scan(jax.vmap(detector.update), start, xs))(xs)
  assert alarms.fired.sum() > 10
  alone = jax.jit(lambda xs: jax.lax.scan(detector.update, state, xs)[1])
  for g in range(streams):
    single = alone(jax.tree.map(lambda x: x[:, g], xs))
    np.testing.assert_array_equal(single.fired, alarms.fired[:, g])
    np.testing.assert_allclose(
      single.score, alarms.score[:, g], rtol=1e-4, atol=1e-4
    )  # float32, perhaps fused another way
  masked, alarm = jax.jit(jax.vmap(detector.update))(last, rows(np.full(streams, np.nan)))
  assert same(masked, last) and not alarm.fired.any() and np.isnan(alarm.score).all()


def test_a_detector_of_another_package_is_held_to_its_form(monkeypatch):
  """As one of a file: its state keeps its types, its alarm is a flag and a number."""
  drifts = lambda threshold=1.0: Detector(
    lambda: jnp.int32(0), lambda state, x: (state + 0.5, Alarm(x.opr > threshold, x.opr))
  )
  monkeypatch.setitem(detectors.DETECTORS, "theirs", drifts)
  made = detectors.make("theirs")
  with pytest.raises(PluginError, match=r"'theirs': update gives a state of form float32\[\] in "):
    made.update(made.init(), jax.tree.map(lambda x: x[0], rows(np.ones(1))))


def test_a_residual_detector_keeps_its_own_settings():
  own = detectors.make("rolling_sigma_plain", window=50, warmup=20, patience=3, threshold=0.5)
  xs = rows(1 + np.random.default_rng(0).normal(size=200))
  by_hand = detectors.paper_rule(window=50, warmup=20, patience=3, threshold=0.5)
  np.testing.assert_array_equal(run(own, xs)[1], run(by_hand, xs)[1])
  cooled = run(
    detectors.make(
      "rolling_sigma_plain", window=50, warmup=20, patience=3, threshold=0.5, cool_down=40
    ),
    xs,
  )[1]
  assert 0 < cooled.sum() < run(own, xs)[1].sum()
  with pytest.raises(UserError, match="whiten"):
    detectors.make("rolling_sigma_plain", whiten=4)


@pytest.mark.parametrize(
  "name, settings",
  [
    ("hotelling", {"smooth": 5}),
    ("mewma", {}),
    ("max_variables", {"smooth": 5}),
    ("rolling_sigma", {"window": 50, "smooth": 5}),
    ("rolling_sigma_plain", {"window": 50}),
  ],
)
def test_a_residual_detector_takes_its_own_logarithm(name, settings):
  """As its factory does; not told, its own default holds."""
  xs = rows(np.exp(np.random.default_rng(0).normal(size=300)))
  settings |= {"warmup": 40} | ({} if "rolling" in name else {"channels": "opr+rpr"})
  of = lambda **told: run(detectors.make(name, **settings, **told), xs)[2]
  by_hand = lambda log: run(detectors.DETECTORS[name](**settings, log=log), xs)[2]
  for log in (True, False):
    np.testing.assert_array_equal(of(log=log), by_hand(log))
  assert (by_hand(True) != by_hand(False)).any()
  np.testing.assert_array_equal(of(), of(log=name != "rolling_sigma_plain"))
  with pytest.raises(UserError, match="log"):
    detectors.make("knn", log=False)


def test_two_channels_for_one_detector_are_refused():
  for ask in (detectors.make, lambda name, **told: detectors.calibrated(name, "walker", told)):
    with pytest.raises(UserError, match="cusum@opr is given another channel, rpr"):
      ask("cusum@opr", channel="rpr")
    assert ask("cusum@opr", channel="opr") is not None


def test_a_patience_of_one_is_one():
  """Where the detector's own default is another: the car's calibrated rule wants 20 in a row."""
  steps = 400
  x = np.exp(np.random.default_rng(0).normal(size=steps)) + 5 * (np.arange(steps) % 50 == 49)
  of = lambda **told: run(
    detectors.make("rolling_sigma", robot="car", window=50, warmup=20, **told), rows(x)
  )[1]
  assert of(patience=1).any() and not of().any() and not of(patience=None).any()
  plain, one = (detectors.make("cusum", **told) for told in ({}, {"patience": 1}))
  assert jax.tree.structure(plain.init()) == jax.tree.structure(one.init())
  known = [detectors.calibrated("cusum", "walker", told) for told in ({}, {"patience": 1})]
  assert known[0] is not None and known[0] == known[1]
  assert detectors.calibrated("cusum", "walker", {"patience": 2}) is None
  detectors.make("hotelling", patience=1)  # has none, and one is as none
  with pytest.raises(UserError, match="patience"):
    detectors.make("hotelling", patience=2)


@pytest.mark.parametrize(
  "settings, match",
  [
    (dict(whiten=-1), "order"),
    (dict(whiten=600), "warmup"),
    (dict(patience=0), "k must be"),
    (dict(cool_down=-1), "steps must be"),
    (dict(slacks=1.0), "slacks"),
    (dict(slacks=1.0, patience=2), "slacks"),
  ],
)
def test_make_refuses_settings_out_of_range(settings, match):
  with pytest.raises(UserError, match=match):
    detectors.make("cusum", **settings)


def test_bad_combinations_are_refused():
  with pytest.raises(UserError, match="warmup must be"):
    whitened(echo(), 8, 16)
