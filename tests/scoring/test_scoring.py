"""Alarm scores, recovery, intervals: hand sums, SciPy and published values."""

import math

import numpy as np
import pytest
import scipy.stats

from mjx_cl.scoring import alarms, intervals, recovery


def fired(steps, *at):
  """bool (steps,), true at the steps `at`."""
  return np.isin(np.arange(steps), at)


# ---- alarms --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
  "at, want",
  [
    ((), (None, None, 0)),
    ((40,), (40, 0, 0)),  # known in the first faulty step
    ((39,), (None, None, 1)),  # one step earlier is false
    ((3, 7, 55, 80), (55, 15, 2)),
  ],
)
def test_alarm_score(at, want):
  assert alarms.score(fired(100, *at), onset=40) == want


def test_a_run_without_a_fault_has_false_alarms_alone():
  assert alarms.score(fired(100, 0, 99), onset=100) == (None, None, 2)


# ---- windows of the reward -----------------------------------------------------------------------


def test_reward_pre_is_the_mean_between_warm_up_and_onset():
  reward = np.arange(100.0)
  assert recovery.reward_pre(reward, onset=50, warmup=10, first_alarm=None) == np.mean(
    np.arange(10, 50)
  )
  assert recovery.reward_pre(reward, onset=50, warmup=10, first_alarm=30) == np.mean(
    np.arange(10, 30)
  )
  assert recovery.reward_pre(reward, onset=50, warmup=10, first_alarm=80) == np.mean(
    np.arange(10, 50)
  )
  assert recovery.reward_pre(reward, onset=50, warmup=10, first_alarm=10) is None
  assert recovery.reward_pre(reward, onset=10, warmup=10, first_alarm=None) is None


def test_reward_drop_covers_2000_steps_from_onset():
  reward = np.concatenate(
    [np.full(100, 0.8), np.full(500, 0.2), np.full(1500, 0.6), np.full(1000, 0.0)]
  )
  assert recovery.reward_drop(reward, 100, 0.8) == pytest.approx(
    1 - (500 * 0.2 + 1500 * 0.6) / 2000 / 0.8
  )
  assert recovery.reward_drop(reward, 2600, 0.8) == 1.0  # 500 steps are left: the mean of those
  assert recovery.reward_drop(reward, 100, None) is None
  assert recovery.reward_drop(reward, 100, 0.0) is None  # a share of nothing
  assert recovery.reward_drop(np.full(200, -3.0), 100, -1.0) == 2.0  # twice of what it was is lost
  assert recovery.reward_drop(np.full(200, -0.5), 100, -1.0) == -0.5  # half of it gained


def test_return_lost_is_the_sum_from_onset():
  assert recovery.return_lost(np.array([9.0, 1.0, 2.0, 4.0]), onset=1, pre=3.0) == 2.0 + 1.0 - 1.0
  assert recovery.return_lost(np.ones(4), onset=1, pre=None) is None


# ---- recovery step -------------------------------------------------------------------------------


def slow_recovery(reward, onset, pre):
  """The definition in the README, read word for word: a mean and a hold per step, no shared sums."""
  trailing = [np.mean(reward[max(0, k - 999) : k + 1]) for k in range(len(reward))]
  below = [k for k in range(onset, len(reward)) if trailing[k] < 0.9 * pre]
  if not below:
    return onset
  for k in range(below[0] + 1, len(reward) - 1999):
    if min(trailing[k : k + 2000]) >= 0.9 * pre:
      return k
  return None


def trace(*parts):
  """Piecewise constant reward from (steps, level) pairs."""
  return np.concatenate([np.full(n, x) for n, x in parts])


def test_recovery_step_by_hand():
  # from onset 1,000 on the mean loses 1/1000 per step and is below 0.9 after 101 of them; at step
  # 3,000 + j it has j + 1 good steps
  # among its 1,000 and is at 0.9 with 900 of them
  reward = trace((1000, 1.0), (2000, 0.0), (4000, 1.0))
  assert recovery.recovery_step(reward, 1000, 1.0) == 3000 + 899


@pytest.mark.parametrize(
  "reward",
  [
    trace((1000, 1.0), (300, 0.0), (4000, 1.0)),
    trace(
      (1000, 1.0), (2000, 0.2), (1500, 1.0), (600, 0.0), (5000, 0.95)
    ),  # a dip during the hold: counted from the second rise
    trace(
      (1000, 1.0), (2000, 0.2), (1500, 1.0), (80, 0.0), (5000, 1.0)
    ),  # a dip too small to bring the mean below
    trace((400, 0.1), (600, 1.0), (100, 0.3), (4000, 1.0)),  # low before onset
    trace(
      (50, 0.0), (3950, 1.0), (500, 0.0), (5000, 1.0)
    ),  # a bad start, then the fall long after onset
    trace((1000, 1.0), (500, 0.0), (2899, 1.0)),  # the hold just fits
    trace((1000, 1.0), (500, 0.0), (2898, 1.0)),  # one step short: censored
  ],
)
def test_recovery_step_equals_the_definition(reward):
  pre = 0.999  # off the binary grid, so that no mean ties with the level
  assert recovery.recovery_step(reward, 1000, pre) == slow_recovery(reward, 1000, pre)


def test_recovery_step_at_the_edges():
  assert recovery.recovery_step(trace((5000, 1.0)), 1000, 1.0) == 1000  # never fallen
  assert recovery.recovery_step(trace((1000, 1.0), (4000, 0.1)), 1000, 1.0) is None  # never back
  assert (
    recovery.recovery_step(trace((1000, 1.0), (2000, 0.0), (1899, 1.0)), 1000, 1.0) is None
  )  # back, but the run ends before the hold
  for pre in (None, 0.0):
    assert recovery.recovery_step(trace((5000, 1.0)), 1000, pre) is None


def test_recovery_of_a_reward_below_0():
  """A tenth below the reward before is as far down where that is negative: -1.1 of -1."""
  assert recovery.recovery_step(trace((1000, -1.0), (4000, -1.05)), 1000, -1.0) == 1000
  assert recovery.recovery_step(trace((1000, -1.0), (4000, -1.2)), 1000, -1.0) is None
  # the mean falls by 0.002 a step and is below -1.1 after 51; at step 3,000 + j it has j + 1 good
  # ones among 1,000 and is at -1.1 with 950
  assert (
    recovery.recovery_step(trace((1000, -1.0), (2000, -3.0), (4000, -1.0)), 1000, -1.0)
    == 3000 + 949
  )


def test_stable_asks_for_no_fall_besides():
  """A fall during the hold puts it off; one before it, or before the onset, does not; without falls
  it is the recovery.
  """
  reward, calm = trace((1000, 1.0), (2000, 0.0), (6000, 1.0)), np.zeros(9000, bool)
  back = recovery.recovery_step(reward, 1000, 1.0)
  assert recovery.stable_step(reward, calm, 1000, 1.0) == back
  falls = lambda *steps: np.isin(np.arange(9000), steps)
  assert recovery.stable_step(reward, falls(500, 1500, back - 1), 1000, 1.0) == back
  assert (
    recovery.stable_step(reward, falls(back + 1999), 1000, 1.0) == back + 2000
    and recovery.stable_step(reward, falls(back + 2000), 1000, 1.0) == back
  )
  assert (
    recovery.stable_step(reward, falls(back + 1900, back + 3500, back + 5000), 1000, 1.0) is None
  )
  flat = np.ones(9000)
  assert (
    recovery.stable_step(flat, calm, 1000, 1.0) == 1000
    and recovery.stable_step(flat, falls(1200), 1000, 1.0) == 1201
  )  # a fall is a fall, whatever it costs
  assert recovery.stable_step(flat, calm, 1000, None) is None


# ---- aggregates ----------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 8, 10, 20, 33])
def test_iqm_is_scipys_trimmed_mean(n):
  x = np.random.default_rng(n).normal(size=(3, n))
  np.testing.assert_allclose(
    intervals.iqm(x), scipy.stats.trim_mean(x, 0.25, axis=-1), rtol=1e-12
  )  # rounding of float64 sums
  np.testing.assert_allclose(intervals.iqm(x.T, axis=0), intervals.iqm(x), rtol=1e-12)


def test_interval_contains_the_statistic_and_repeats():
  x = np.random.default_rng(0).normal(10, 2, 10)
  low, high = intervals.interval(x)
  assert low < intervals.iqm(x) < high
  assert [low, high] == intervals.interval(x)
  assert [low, high] != intervals.interval(x, seed=1)
  wide = intervals.interval(x, level=0.99)
  assert wide[0] < low and high < wide[1]


def test_interval_of_a_mean_is_near_the_normal_one():
  x = np.random.default_rng(1).normal(size=400)
  half = 1.96 * x.std() / 20
  # 20,000 resamples place a 2.5 % quantile to about 0.02 standard errors; 5 % of the width leaves
  # room for skew
  np.testing.assert_allclose(
    intervals.interval(x, np.mean), [x.mean() - half, x.mean() + half], atol=0.1 * half
  )


def test_interval_of_too_few_runs_is_undefined():
  assert intervals.interval([1.0]) is None
  assert intervals.interval([]) is None
  assert intervals.interval([3.0, 3.0]) == [3.0, 3.0]


def test_strata_are_resampled_each_by_itself():
  # two tasks on scales far apart: with one pool the mean of a resample wanders between them, with
  # strata half of it is always from each
  x = np.stack(
    [np.random.default_rng(2).normal(0, 1, 10), np.random.default_rng(3).normal(1000, 1, 10)], 1
  )
  low, high = intervals.interval(x, np.mean)
  assert low < x.mean() < high and high - low < 2.0
  pooled = intervals.interval(x.reshape(-1), np.mean)
  assert pooled[1] - pooled[0] > 200.0


def test_censored_median():
  inf = np.inf
  assert intervals.censored_median([3.0, inf, 1.0, 2.0, inf]) == 3.0
  assert intervals.censored_median([1.0, inf]) == 1.0  # Kaplan-Meier falls to one half at 1
  assert intervals.censored_median([1.0, inf, inf]) == inf
  np.testing.assert_array_equal(
    intervals.censored_median([[1.0, 5.0, 2.0], [inf, inf, 0.0]]), [2.0, inf]
  )


def test_interval_of_a_censored_median_has_null_for_infinity():
  low, high = intervals.interval([1.0, 2.0, 3.0, np.inf, np.inf], intervals.censored_median)
  assert low == 1.0 and high is None


@pytest.mark.parametrize(
  "hits, n, want",
  [
    (81, 263, (0.2553, 0.3662)),
    (15, 148, (0.0624, 0.1605)),
    (0, 20, (0.0, 0.1611)),
    (1, 29, (0.0061, 0.1718)),
  ],
)
def test_wilson_equals_newcombe(hits, n, want):
  """Newcombe 1998, Statistics in Medicine 17, 857-872, table I, method 3, printed to four places."""
  np.testing.assert_allclose(intervals.wilson(hits, n), want, atol=5e-5)


def test_wilson_at_the_ends():
  assert intervals.wilson(0, 0) is None
  assert intervals.wilson(10, 10) == pytest.approx(
    [1 - x for x in intervals.wilson(0, 10)[::-1]]
  )  # up to float64 rounding


def test_finite():
  assert intervals.finite(np.float32(2)) == 2.0
  assert all(intervals.finite(x) is None for x in (None, math.nan, math.inf, -math.inf))
