"""Kaplan-Meier against a published example, against 1 - ECDF where nothing is censored, and by
its equations; means by hand.
"""

import numpy as np
import pytest

from mjx_cl.scoring import survival

# Remission of leukaemia in weeks, 21 patients on 6-mercaptopurine and 21 on placebo: Freireich et
# al. 1963; figures of Klein and Moeschberger 2003,
# tables 4.1A, 4.2 and section 4.5
DRUG = np.array(
  [6, 6, 6, 6, 7, 9, 10, 10, 11, 13, 16, 17, 19, 20, 22, 23, 25, 32, 32, 34, 35], float
)
SEEN = np.array([1, 1, 1, 0, 1, 0, 1, 0, 0, 1, 1, 0, 0, 0, 1, 1, 0, 0, 0, 0, 0], bool)
PLACEBO = np.array([1, 1, 2, 2, 3, 4, 4, 5, 5, 8, 8, 8, 8, 11, 11, 12, 12, 15, 17, 22, 23], float)
ALL = np.ones(21, bool)


def test_the_published_curve():
  curve = survival.kaplan_meier(DRUG, SEEN)
  assert (
    list(curve.time) == [6, 7, 10, 13, 16, 22, 23]
    and list(curve.events) == [3, 1, 1, 1, 1, 1, 1]
    and curve.last == 35
  )
  assert list(curve.at_risk) == [21, 17, 15, 12, 11, 7, 6]
  np.testing.assert_allclose(
    curve.survival, [0.857, 0.807, 0.753, 0.690, 0.627, 0.538, 0.448], atol=5.1e-4
  )
  plain = survival.kaplan_meier(DRUG, SEEN, "linear")
  np.testing.assert_allclose(
    (plain.survival - plain.low) / survival.Z,
    [0.0764, 0.0869, 0.0963, 0.1068, 0.1141, 0.1282, 0.1346],
    atol=5.1e-5,
  )


def test_the_published_medians_and_mean():
  assert survival.quantile(survival.kaplan_meier(DRUG, SEEN)) == (23.0, [13.0, None])
  assert survival.quantile(survival.kaplan_meier(PLACEBO, ALL)) == (8.0, [4.0, 11.0])
  assert [
    survival.quantile(survival.kaplan_meier(DRUG, SEEN), share)[0] for share in (0.25, 0.75)
  ] == [13.0, None]
  mean, (low, high) = survival.restricted_mean(DRUG, SEEN, 35)
  assert mean == pytest.approx(23.287, abs=5e-4) and (high - low) / 2 / 1.96 == pytest.approx(
    2.827, abs=1e-3
  )


@pytest.mark.parametrize("name", ["linear", "log-log"])
def test_as_its_equations_where_some_are_censored(name):
  rng = np.random.default_rng(0)
  for n in (3, 10, 40):
    for _ in range(5):
      time, seen = rng.integers(1, 15, n).astype(float), rng.random(n) < 0.6
      if not seen.any():
        continue
      curve = survival.kaplan_meier(time, seen, name)
      left = np.cumprod(1 - curve.events / curve.at_risk)
      np.testing.assert_allclose(curve.survival, left, atol=1e-12)
      known = curve.survival > 0
      d, n_i, left = curve.events[known], curve.at_risk[known], left[known]
      root = np.sqrt(np.cumsum(d / (n_i * (n_i - d))))
      arm = np.exp(survival.Z * root / -np.log(left))
      low, high = (
        (left**arm, left ** (1 / arm))
        if name == "log-log"
        else np.clip([left - survival.Z * root * left, left + survival.Z * root * left], 0, 1)
      )
      np.testing.assert_allclose(curve.low[known], low, atol=1e-12)
      np.testing.assert_allclose(curve.high[known], high, atol=1e-12)
      assert np.isnan(curve.low[~known]).all() and np.isnan(curve.high[~known]).all()


def test_without_censoring_it_is_one_less_the_share_that_recovered():
  time = np.random.default_rng(1).integers(0, 9, 25).astype(float)
  curve, every = survival.kaplan_meier(time, np.ones(25, bool)), np.arange(10)
  at = np.searchsorted(curve.time, every, "right")
  np.testing.assert_allclose(
    np.append(1.0, curve.survival)[at], [(time > t).mean() for t in every], atol=1e-12
  )
  for horizon in (3.0, 4.5, 50.0):
    mean, (low, high) = survival.restricted_mean(time, np.ones(25, bool), horizon)
    cut = np.minimum(time, horizon)
    assert mean == pytest.approx(cut.mean()) and (high - low) / 2 / 1.96 == pytest.approx(
      cut.std() / 5, rel=1e-3
    )  # Greenwood: the plain variance
  assert survival.quantile(curve)[0] == np.sort(time)[12]


def test_a_tie_of_event_and_censoring_and_a_median_on_the_edge():
  curve = survival.kaplan_meier([2, 2, 3, 3], [True, False, False, False])
  assert list(curve.survival) == [0.75]  # the censored one was at risk
  assert survival.quantile(survival.kaplan_meier([1, 2, 3, 4], [True] * 4))[0] == 2.0  # S(2) is 1/2
  thirds = survival.kaplan_meier([1, 1, 2, 4, 4, 4], [True] * 6)
  assert survival.quantile(thirds)[0] == 2.0


def test_where_nobody_recovers_and_where_all_do():
  curve = survival.kaplan_meier([5, 7], [False, False])
  assert (
    len(curve.time) == 0 and curve.last == 7 and survival.quantile(curve) == (None, [None, None])
  )
  assert survival.restricted_mean([5, 7], [False, False], 6) == (6.0, None)
  assert survival.restricted_mean([5, 5, 5], [True] * 3, 10) == (
    5.0,
    None,
  )  # all at once: Greenwood's only term is undefined
  assert survival.restricted_mean([5, 7], [False, False], 8) == (
    None,
    None,
  )  # nobody was watched for so long
  assert survival.restricted_mean([5, 7], [True, True], 8)[0] == 6.0
  assert survival.restricted_mean([5, 7, 9], [True, True, False], 9)[0] == pytest.approx(
    5 + 2 * 2 / 3 + 2 / 3
  )
  for bad in (([1.0, np.inf], [True, False]), ([], []), ([-1.0], [True]), ([1.0, 2.0], [True])):
    with pytest.raises(ValueError):
      survival.kaplan_meier(*bad)


def test_the_interval_of_the_median_covers():
  """True median 10 log 2, 40 of exponential law, a third censored: 2,000 samples, coverage 0.95,
  deviation of the count 0.005.
  """
  rng, hits = np.random.default_rng(2), 0
  for _ in range(2000):
    time, limit = rng.exponential(10.0, 40), rng.exponential(20.0, 40)
    low, high = survival.quantile(survival.kaplan_meier(np.minimum(time, limit), time <= limit))[1]
    hits += (low or 0.0) <= 10 * np.log(2) <= (np.inf if high is None else high)
  assert 0.93 < hits / 2000 < 0.98


def test_times_of_runs():
  rows = [
    {"affected": True, "recovery_step": 700, "onset": 500},
    {"affected": True, "recovery_step": None, "onset": 500},
    {"affected": False, "recovery_step": None, "onset": 500},
    {"affected": None, "recovery_step": None, "onset": None},
  ]
  rows = [{"stream": i} | r for i, r in enumerate(rows)]
  time, seen = survival.of_runs(rows, 10_000)
  assert list(time) == [200.0, 7500.0] and list(seen) == [True, False]
  again = {
    "stream": 1,
    "affected": True,
    "recovery_step": None,
    "onset": 6000,
  }  # the stream changes once more
  assert list(survival.of_runs(rows + [again], 10_000)[0]) == [200.0, 3500.0, 2000.0]
  assert list(survival.of_runs([again], 7000)[0]) == [
    0.0
  ]  # the run ends before any recovery could be told
