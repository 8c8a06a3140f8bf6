"""Charts of one residual against loops in NumPy, river's Page-Hinkley and published run lengths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick
import scipy.stats
from river.drift import PageHinkley

from mjx_cl import detectors
from mjx_cl.detectors import cusum, ewma, glr, page_hinkley, shiryaev_roberts, z_score
from mjx_cl.errors import UserError


def stream(seed=0, steps=500):
  """Noise around 5 with deviation 2, with a rise, a fall and a slow drift."""
  rng = np.random.default_rng(seed)
  mean = np.concatenate(
    [
      np.zeros(200),
      np.full(60, 1.5),
      np.zeros(60),
      np.full(60, -1.5),
      np.linspace(0, 2, steps - 380),
    ]
  )
  return (5 + 2 * (mean + rng.normal(size=steps))).astype(np.float32)


def run(detector, xs):
  alarms = quick.jit(lambda xs: jax.lax.scan(detector.update, detector.init(), xs)[1])(
    jnp.asarray(xs)
  )
  return np.asarray(alarms.fired), np.asarray(alarms.score)


# ---- each against its docstring, in NumPy and float64, one sample at a time ----------------------


def slow(chart, xs, threshold, warmup):
  """`chart(zs)` scores the samples since the start or the last alarm, and is asked again after each
  alarm.
  """
  xs = np.asarray(xs, float)
  zs = (xs - xs[:warmup].mean()) / max(xs[:warmup].std(), 1e-6) if warmup else xs
  fired, scores, start = np.zeros(len(xs), bool), np.full(len(xs), np.nan), warmup
  for t in range(warmup, len(xs)):
    scores[t] = chart(zs[start : t + 1])
    if scores[t] > threshold:
      fired[t], start = True, t + 1
  return fired, scores


def slow_ewma(zs, rate):
  weights = rate * (1 - rate) ** np.arange(len(zs))[::-1]
  return abs(weights @ zs) / np.sqrt(
    np.sum(weights**2)
  )  # the variance of a sum, with no closed form


def slow_cusum(zs, slack, two_sided):
  """Page's sums as the excess of the walk over its minimum."""

  def excess(zs):
    walk = np.concatenate([[0], np.cumsum(zs - slack)])
    return walk[-1] - walk.min()

  return max(excess(zs), excess(-zs)) if two_sided else excess(zs)


def slow_shiryaev_roberts(zs, shift, two_sided):
  """Sum over all times of change of the likelihood ratio since."""
  ratio = lambda zs: np.sum(np.exp(np.cumsum((shift * zs - shift**2 / 2)[::-1])))
  return np.log((ratio(zs) + ratio(-zs)) / 2 if two_sided else ratio(zs))


def slow_glr(zs, **_):
  return np.max(np.cumsum(zs[::-1]) ** 2 / (2 * np.arange(1, len(zs) + 1)))


def slow_page_hinkley(zs, delta, alpha, mode, min_instances):
  if len(zs) < min_instances:
    return np.nan
  dev = zs - np.cumsum(zs) / np.arange(1, len(zs) + 1)
  up = down = low = high = 0.0
  for d in dev:
    up, down = alpha * up + d - delta, alpha * down + d + delta
    low, high = min(low, up), max(high, down)
  return {"up": up - low, "down": high - down, "both": max(up - low, high - down)}[mode]


CHARTS = [
  (ewma, slow_ewma, dict(rate=0.1, threshold=2.7)),
  (ewma, slow_ewma, dict(rate=0.02, threshold=2.0)),
  (ewma, slow_ewma, dict(rate=1.0, threshold=2.5)),
  (cusum, slow_cusum, dict(slack=0.5, threshold=5.0, two_sided=True)),
  (cusum, slow_cusum, dict(slack=0.25, threshold=8.0, two_sided=False)),
  (cusum, slow_cusum, dict(slack=0.0, threshold=12.0, two_sided=True)),
  (shiryaev_roberts, slow_shiryaev_roberts, dict(shift=1.0, threshold=5.0, two_sided=True)),
  (shiryaev_roberts, slow_shiryaev_roberts, dict(shift=0.3, threshold=6.0, two_sided=False)),
  (
    shiryaev_roberts,
    slow_shiryaev_roberts,
    dict(shift=5.0, threshold=-1.0, two_sided=True),
  ),  # ln R may be negative
  (glr, slow_glr, dict(threshold=8.0)),
  (glr, slow_glr, dict(threshold=1e9)),
  (glr, slow_glr, dict(threshold=3.0)),
  (
    page_hinkley,
    slow_page_hinkley,
    dict(delta=0.005, threshold=20.0, alpha=0.9999, mode="both", min_instances=30),
  ),
  (
    page_hinkley,
    slow_page_hinkley,
    dict(delta=0.3, threshold=8.0, alpha=0.99, mode="down", min_instances=1),
  ),
  (
    page_hinkley,
    slow_page_hinkley,
    dict(delta=0.0, threshold=15.0, alpha=1.0, mode="up", min_instances=50),
  ),
]


@pytest.mark.parametrize("warmup", [0, 80])
@pytest.mark.parametrize(
  "factory, chart, settings",
  CHARTS,
  ids=[f"{f.__name__} {i}" for i, (f, _, _) in enumerate(CHARTS)],
)
def test_equals_the_loop(factory, chart, settings, warmup):
  xs = stream() if warmup else (stream(1) - np.float32(5)) / np.float32(2)
  fired, scores = run(factory(warmup=warmup, **settings), xs)
  more = {k: v for k, v in settings.items() if k != "threshold"}
  want, exact = slow(lambda zs: chart(zs, **more), xs, settings["threshold"], warmup)
  np.testing.assert_allclose(
    scores, exact, rtol=2e-4, atol=2e-4
  )  # float32 sums of at most 500 terms
  np.testing.assert_array_equal(fired, want)
  assert want.any() or settings["threshold"] > 1e6


@pytest.mark.parametrize("two_sided, smooth", [(True, 1), (False, 1), (True, 9), (False, 4)])
def test_z_score_equals_the_loop(two_sided, smooth):
  xs, warmup, threshold = stream(), 80, 1.8
  fired, scores = run(z_score(threshold, two_sided, smooth, warmup), xs)
  ys = np.array([xs[max(0, t + 1 - smooth) : t + 1].astype(float).mean() for t in range(len(xs))])
  z = (ys - ys[:warmup].mean()) / ys[:warmup].std()
  z = np.abs(z) if two_sided else z
  z[:warmup] = np.nan
  beyond = z > threshold
  np.testing.assert_allclose(scores, z, rtol=1e-4, atol=1e-4)  # float32
  np.testing.assert_array_equal(fired, beyond & ~np.concatenate([[False], beyond[:-1]]))
  assert 5 < fired.sum() < beyond.sum()


@pytest.mark.parametrize("factory", [z_score, ewma, cusum, page_hinkley, shiryaev_roberts, glr])
def test_nothing_is_known_before_the_warm_up_ends_and_the_reference_stays(factory):
  detector = factory(warmup=100)
  xs = np.concatenate([stream()[:200], stream()[:300] + 20])
  state, alarms = jax.lax.scan(detector.update, detector.init(), jnp.asarray(xs))
  assert (
    np.isnan(alarms.score[:100]).all() and not alarms.fired[:100].any() and alarms.fired[100:].any()
  )
  np.testing.assert_allclose(state.warm.mean, xs[:100].mean(), rtol=1e-5)
  assert int(state.warm.seen) == 100


# ---- Page-Hinkley as river has it ----------------------------------------------------------------


@pytest.mark.parametrize(
  "settings",
  [
    {},
    dict(delta=0.0, threshold=10.0, min_instances=1),
    dict(delta=0.1, threshold=5.0, alpha=0.99),
    dict(delta=0.005, threshold=25.0, alpha=1.0, mode="up"),
    dict(delta=0.05, threshold=8.0, mode="down", min_instances=100),
    dict(delta=0.5, threshold=3.0, alpha=0.5, min_instances=5),
  ],
)
def test_page_hinkley_fires_where_rivers_does(settings):
  rng = np.random.default_rng(3)
  for level in (0.0, 20.0):  # river's threshold is in units of the input
    xs = (level + np.repeat([0.0, 1.0, -0.5, 2.0, 0.3], 600) + rng.normal(size=3000)).astype(
      np.float32
    )
    theirs, want = PageHinkley(**settings), []
    for t, x in enumerate(xs):
      theirs.update(float(x))
      if theirs.drift_detected:
        want.append(t)
    fired, _ = run(page_hinkley(warmup=0, **settings), xs)
    assert len(want) > 0 and np.flatnonzero(fired).tolist() == want


# ---- published run lengths -----------------------------------------------------------------------

STREAMS, STEPS = 1000, 4000


def run_length(detector, shift=0.0, streams=STREAMS, steps=STEPS, seed=0):
  """(mean samples from alarm to alarm, its standard error) of restarted detectors on independent
  Gaussian samples, standardised exactly.

  Alarms of restarted runs are counted: their number has the relative error (std / mean) /
  sqrt(number), and std / mean <= 1 here.
  """
  start = jax.tree.map(lambda x: jnp.broadcast_to(x, (streams,) + x.shape), detector.init())

  @jax.jit
  def alarms(key):
    def step(state, key):
      state, alarm = jax.vmap(detector.update)(state, shift + jax.random.normal(key, (streams,)))
      return state, jnp.sum(alarm.fired)

    return jax.lax.scan(step, start, jax.random.split(key, steps))[1].sum()

  count = int(alarms(jax.random.key(seed)))
  mean = streams * steps / count
  return mean, mean / np.sqrt(count)


@pytest.mark.parametrize(
  "threshold, shift, want, digit",
  [(5.0, 0.0, 465, 0.5), (5.0, 1.0, 10.4, 0.05), (4.0, 0.0, 168, 0.5), (4.0, 1.0, 8.38, 0.005)],
)
def test_cusum_has_the_published_run_lengths(threshold, shift, want, digit):
  """Montgomery, Introduction to Statistical Quality Control, table of the two-sided chart with
  slack 0.5. `digit`: half of its last one.
  """
  mean, error = run_length(cusum(0.5, threshold, warmup=0), shift)
  # from 8,600 to 480,000 alarms; the run that the end cuts off makes at most want / steps of the
  # mean where run lengths vary little
  cut = want**2 / STEPS / 2 if shift else 0.0
  assert abs(mean - want) < 3 * error + digit + cut, (mean, error)


def ewma_run_lengths(rate, limit, cells=1201):
  """ARL0 of the EWMA chart with asymptotic limits, and with those of the exact variance, by a
  Markov chain over cells of the average.
  """
  edge = limit * np.sqrt(rate / (2 - rate))
  width = 2 * edge / cells
  at = -edge + width * (np.arange(cells) + 0.5)
  up = scipy.stats.norm.cdf((at[None] + width / 2 - (1 - rate) * at[:, None]) / rate)
  step = up - scipy.stats.norm.cdf((at[None] - width / 2 - (1 - rate) * at[:, None]) / rate)
  from_there = np.linalg.solve(np.eye(cells) - step, np.ones(cells))
  p, exact = (np.arange(cells) == cells // 2).astype(float), 0.0
  for n in range(
    1, 301
  ):  # (1 - rate)^600 is nothing: from there on the limits are the asymptotic ones
    exact += p.sum()
    within = edge * np.sqrt(1 - (1 - rate) ** (2 * n))
    p = (p @ step) * np.clip((within - np.abs(at)) / width + 0.5, 0, 1)
  return from_there[cells // 2], exact + p @ from_there


def test_ewma_has_the_run_length_of_the_exact_variance():
  """Lucas and Saccucci 1990: rate 0.1 with limits at 2.814 asymptotic deviations has ARL0 500. The
  exact variance narrows the first limits.
  """
  asymptotic, exact = ewma_run_lengths(0.1, 2.814)
  assert (
    abs(asymptotic - 500) < 1
  )  # the oracle gives the published figure for the chart it was published for
  assert asymptotic - exact > 10
  mean, error = run_length(ewma(0.1, 2.814, warmup=0), steps=16_000)
  # 3 standard errors are about 8, less than the 13 between the two; cells of the oracle cost below
  # 1
  assert abs(mean - exact) < 3 * error < asymptotic - exact, (mean, error, exact)


def test_z_score_has_the_run_length_of_three_sigma():
  p = 2 * scipy.stats.norm.sf(3.0)
  mean, error = run_length(z_score(3.0, warmup=0))
  assert abs(mean - 1 / (p * (1 - p))) < 3 * error  # an excursion of two samples is one alarm


@pytest.mark.parametrize("two_sided", [False, True])
def test_shiryaev_roberts_is_a_martingale_less_the_time(two_sided):
  detector = shiryaev_roberts(shift=0.3, threshold=80.0, two_sided=two_sided, warmup=0)
  streams, steps = 100_000, 20
  start = jax.tree.map(lambda x: jnp.broadcast_to(x, (streams,) + x.shape), detector.init())
  xs = jax.random.normal(jax.random.key(0), (steps, streams))
  r = np.exp(
    quick.jit(lambda xs: jax.lax.scan(jax.vmap(detector.update), start, xs)[1].score)(xs).astype(
      float
    )
  )
  error = r.std(1) / np.sqrt(streams)
  assert (error / np.arange(1, steps + 1) < 0.01).all()
  assert (np.abs(r.mean(1) - np.arange(1, steps + 1)) < 4 * error).all()


@pytest.mark.parametrize("two_sided", [False, True])
def test_shiryaev_roberts_keeps_its_guarantee(two_sided):
  a = 200.0
  mean, error = run_length(shiryaev_roberts(1.0, float(np.log(a)), two_sided, warmup=0))
  assert mean - 3 * error > a
  # renewal theory: ARL0 is near A / 0.5604 at shift 1, which overshoot makes larger than A (Pollak
  # 1987, Ann. Stat. 15)
  if not two_sided:
    assert abs(mean - a / 0.5604) < 3 * error + 0.01 * mean


# ---- candidates of the generalised likelihood ratio ----------------------------------------------


def test_glr_has_room_for_its_candidates():
  """200 streams of 5,000 samples: a full list would leave the last slot taken."""
  detector = glr(threshold=1e9, warmup=100)
  start = jax.tree.map(lambda x: jnp.broadcast_to(x, (200,) + x.shape), detector.init())

  def step(carry, key):
    state, _ = jax.vmap(detector.update)(carry[0], jax.random.normal(key, (200,)))
    return (
      state,
      jnp.maximum(carry[1], jnp.max(jnp.sum(jnp.isfinite(state.evidence.total), -1))),
    ), None

  most = quick.jit(lambda keys: jax.lax.scan(step, (start, 0), keys)[0][1])(
    jax.random.split(jax.random.key(0), 5000)
  )
  assert 10 < int(most) < 32


def test_a_full_glr_is_never_too_large_and_exact_over_small_shifts():
  """The docstring's claim, with room for three: the largest m S - m^2 n / 2 over shifts 0 <= m <=
  bound is still found.
  """
  detector = glr(threshold=1e9, capacity=3, warmup=0)
  update, state = quick.jit(detector.update), detector.init()
  zs = np.random.default_rng(5).normal(size=300).astype(np.float32)
  bound, short, tight = np.inf, 0, 0
  for t, z in enumerate(zs):
    length, total = (
      np.asarray(state.evidence.length, float)[0],
      np.asarray(state.evidence.total, float)[0],
    )
    mean = total / length
    if np.isfinite(total[2]) and 0 < mean[0] < mean[1] < mean[2]:  # full, and all are wanted
      bound = min(bound, 2 * (total[1] - total[2]) / (length[1] - length[2]))
    state, _ = update(state, z)
    s, n = np.cumsum(zs[t::-1].astype(float)), np.arange(1, t + 2)
    exact = np.max(np.maximum(s, 0) ** 2 / (2 * n))
    m = np.clip(s / n, 0, bound)
    small = np.max(m * s - m**2 * n / 2)
    have = np.max(
      np.maximum(np.asarray(state.evidence.total, float)[0], 0) ** 2
      / (2 * np.asarray(state.evidence.length, float)[0])
    )
    assert small - 1e-3 <= have <= exact + 1e-3  # float32
    short, tight = short + (have < exact - 1e-2), tight + (small > 0.5 * exact)
  assert (
    short > 5 and tight > 50 and np.isfinite(bound)
  )  # it was full, it cost something, and the bound says something


def test_a_ramp_fills_the_candidates_and_is_still_found():
  """The mean since s rises with s for ever: every time is a candidate."""
  zs = np.concatenate(
    [np.random.default_rng(6).normal(size=100) * 0.1, 0.02 * np.arange(100)]
  ).astype(np.float32)
  fired, scores = run(glr(threshold=12.0, warmup=0), zs)
  want, exact = slow(slow_glr, zs, 12.0, 0)
  first = np.flatnonzero(want)[0]
  assert (scores[: first + 1] <= exact[: first + 1] * 1.001).all()
  assert first <= np.flatnonzero(fired)[0] <= first + 2


# ---- settings ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
  "name, settings",
  [
    ("z_score", dict(threshold=0.0)),
    ("z_score", dict(smooth=0)),
    ("z_score", dict(warmup=1)),
    ("ewma", dict(rate=0.0)),
    ("ewma", dict(rate=1.5)),
    ("ewma", dict(threshold=-1.0)),
    ("cusum", dict(slack=-0.1)),
    ("cusum", dict(threshold=float("nan"))),
    ("cusum", dict(warmup=-1)),
    ("page_hinkley", dict(mode="sideways")),
    ("page_hinkley", dict(alpha=1.1)),
    ("page_hinkley", dict(delta=-1.0)),
    ("page_hinkley", dict(min_instances=0)),
    ("shiryaev_roberts", dict(shift=0.0)),
    ("shiryaev_roberts", dict(threshold=float("nan"))),
    ("glr", dict(capacity=1)),
    ("glr", dict(threshold=0.0)),
  ],
)
def test_bad_settings_are_refused(name, settings):
  with pytest.raises(UserError, match=rf"{name}.*{list(settings)[0]} must be"):
    detectors.make(name, **settings)


@pytest.mark.parametrize(
  "factory, more",
  [
    (z_score, {}),
    (ewma, {}),
    (cusum, {}),
    (page_hinkley, dict(min_instances=1)),
    (shiryaev_roberts, {}),
    (glr, {}),
  ],
)
def test_one_program_serves_all_thresholds(factory, more):
  xs, thresholds = jnp.asarray(stream()), (1.0, 3.0, 60.0)

  def count(threshold):
    detector = factory(threshold=threshold, warmup=80, **more)
    return jnp.sum(jax.lax.scan(detector.update, detector.init(), xs)[1].fired)

  counts = quick.jit(jax.vmap(count))(jnp.array(thresholds))
  assert counts[0] > counts[1] > counts[2]
  assert int(counts[1]) == run(factory(threshold=3.0, warmup=80, **more), xs)[0].sum()
