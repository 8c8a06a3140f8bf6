"""The leaderboard's numbers: hand sums, brute force, SciPy, published tables, and what must not
change them.
"""

import math
import time

import numpy as np
import pytest
import scipy.stats

from mjx_cl.errors import UserError
from mjx_cl.scoring import comparison, intervals, metrics

STEPS, HEALTHY, SEEDS, ONSET, WARM, CONTROL = 1200, 1500, 6, 300, 100, 0.05
HORIZON = 400  # 20 s


def fired(steps, *at):
  """bool (steps, streams): stream s fires at the steps at[s]."""
  return np.stack([np.isin(np.arange(steps), x) for x in at], 1)


def noise(steps, seed=0, streams=SEEDS):
  return np.random.default_rng(seed).standard_normal((steps, streams))


QUIET = fired(HEALTHY, *[()] * SEEDS)
NEVER = fired(STEPS, *[()] * SEEDS)


def row(alarm, healthy=QUIET, score=None, healthy_score=None, **settings):
  score = noise(len(alarm)) if score is None else score
  healthy_score = noise(len(healthy), 1) if healthy_score is None else healthy_score
  return metrics.row(
    alarm,
    score,
    settings.pop("onset", ONSET),
    healthy,
    healthy_score,
    CONTROL,
    settings.pop("count_from", WARM),
    **settings,
  )


def random_row(seed=0, onset=ONSET):
  rng = np.random.default_rng(seed)
  return row(rng.random((STEPS, SEEDS)) < 0.006, rng.random((HEALTHY, SEEDS)) < 0.001, onset=onset)


# ---- a row by hand -------------------------------------------------------------------------------


def test_row_by_hand():
  """Six streams of 0.05 s: latencies 0, 9, 10, 99, 399 steps and a miss; 3 false alarms in 6 x
  1,400 healthy steps.
  """
  alarm = fired(STEPS, (50, 250, 300), (309, 310), (310,), (399, 1100), (699,), (299, 700))
  healthy = fired(HEALTHY, (99,), (100, 700), (), (), (1499,), ())
  got = row(alarm, healthy)
  assert got["streams"] == 6 and got["stream_latency_steps"] == [0, 9, 10, 99, 399, None]
  assert (got["latency_median_steps"], got["latency_median_s"]) == (10, 0.5)
  assert got["miss_probability"] == pytest.approx(1 / 6)
  assert got["false_alarms_per_hour"] == pytest.approx(3 / (6 * 1400 * 0.05 / 3600))
  # 0.5 s are 10 steps: the alarm of step 9 after the onset is known when they are over, that of
  # step 10 is not
  assert [got[f"detected_within_{x}s"] for x in ("0.5", "1", "5", "20")] == pytest.approx(
    [2 / 6, 3 / 6, 4 / 6, 5 / 6]
  )
  late = [1 - 2 ** (-k * 0.05 / 5) for k in (0, 9, 10, 99, 399)]
  false = 0.1 * got["false_alarms_per_hour"]  # 0.1 h for each fault
  assert got["cost_standard"] == pytest.approx(100 * (1 - (sum(late) + 1) / 6 - 0.1 * false))
  assert got["cost_few_false"] == pytest.approx(100 * (1 - (sum(late) + 1) / 6 - 0.2 * false))
  assert got["cost_few_misses"] == pytest.approx(
    100 * (1 - ((sum(late) + 2) / 6 + 0.1 * false) / 2)
  )


def test_never_is_worth_0_and_the_oracle_100_and_noise_less():
  oracle = fired(STEPS, *[(ONSET,)] * SEEDS)
  for name in metrics.PROFILES:
    assert row(NEVER)[f"cost_{name}"] == 0.0 and row(oracle)[f"cost_{name}"] == 100.0
    assert (
      row(np.ones_like(NEVER), np.ones_like(QUIET))[f"cost_{name}"] < -1000
    )  # an alarm in every step
  # one false alarm, one miss: each profile dislikes its own
  late, false = (
    row(fired(STEPS, (), *[(ONSET,)] * 5)),
    row(oracle, fired(HEALTHY, range(200, 220), *[()] * 5)),
  )
  assert (
    late["cost_few_misses"] == pytest.approx(late["cost_few_false"])
    and false["cost_few_false"] < false["cost_few_misses"]
  )


def test_undefined_is_none():
  got = row(fired(STEPS, (310,), (310,), (310,), (), (), ()))  # half are missed
  assert got["latency_median_steps"] is None and got["latency_median_s"] is None
  got = row(fired(STEPS, (310,), (310,), (310,), (310,), (), ()))
  assert got["latency_median_steps"] == 10 and got["latency_median_steps_ci"] == [
    10,
    None,
  ]  # more than 2.5 % of draws miss half
  got = row(NEVER)
  assert got["latency_median_steps_ci"] is None and got["latency_median_s_ci"] is None
  assert (
    got["miss_probability"] == 1.0
    and got["miss_probability_ci"][1] == 1.0 > got["miss_probability_ci"][0] > 0.5
  )
  got = row(NEVER, QUIET[:WARM], healthy_score=noise(WARM))  # no healthy step after the warm-up
  for name in ("false_alarms_per_hour", "cost_standard", "cost_few_misses", "auroc"):
    assert got[name] is None and got[f"{name}_ci"] is None
  got = row(NEVER, score=np.full(NEVER.shape, np.nan))
  assert got["auroc"] is None and got["cost_standard"] == 0.0


def test_one_seed_has_no_interval():
  got = row(NEVER[:, :1], QUIET[:, :1], noise(STEPS, 0, 1), noise(HEALTHY, 1, 1))
  assert (
    all(x is None for name, x in got.items() if name.endswith("_ci")) and got["auroc"] is not None
  )


def test_every_number_has_an_interval_that_holds_it():
  got = random_row()
  for name in (
    "latency_median_steps",
    "latency_median_s",
    "miss_probability",
    "false_alarms_per_hour",
    "auroc",
    "detected_within_1s",
    *(f"cost_{p}" for p in metrics.PROFILES),
  ):
    low, high = got[f"{name}_ci"]
    assert low - 1e-12 <= got[name] <= high and low < high, (
      name
    )  # Wilson's lower end is 0 but for rounding
  # no alarm at all: Poisson's 0 .. 3.689 in place of a bootstrap of width zero
  hours = SEEDS * (HEALTHY - WARM) * CONTROL / 3600
  assert row(NEVER)["false_alarms_per_hour_ci"] == pytest.approx([0, -math.log(0.025) / hours])


def test_intervals_cover_at_their_level():
  """Bootstrap over 20 seeds of a mean covers 95 % less what its small sample costs: the cost score,
  300 suites, true mean from 20,000 streams.
  """
  rng = np.random.default_rng(0)
  draw = lambda n: np.minimum(rng.geometric(0.02, n) - 1, HORIZON)  # HORIZON steps is a miss

  def values(latency):
    latency = np.where(latency < HORIZON, latency, np.inf)
    return metrics.per_stream(latency, np.zeros(len(latency)), 1000, CONTROL)["cost_standard"]

  truth, hits = values(draw(20_000)).mean(), 0
  for _ in range(300):
    low, high = intervals.ends((intervals.weights(20, metrics.REPS) @ values(draw(20)))[None])[0]
    hits += low <= truth <= high
  assert 0.90 - 0.04 < hits / 300 < 0.99  # 0.93 expected at n = 20; three binomial errors are 0.04


def test_row_refuses_what_it_could_not_score():
  for call in (
    lambda: row(NEVER, onset=WARM - 1),
    lambda: row(NEVER, onset=STEPS - HORIZON + 1),
    lambda: row(NEVER[:, :5], score=noise(STEPS, 0, 5)),
    lambda: row(NEVER, score=noise(STEPS - 1)),
    lambda: row(NEVER, QUIET[: WARM - 1]),
  ):
    with pytest.raises(UserError) as e:
      call()
    assert "\n" not in str(e.value)
  assert row(NEVER, onset=STEPS - HORIZON)["miss_probability"] == 1.0
  assert row(NEVER, onset=np.arange(ONSET, ONSET + SEEDS))["streams"] == SEEDS


def test_onsets_may_differ_between_streams():
  onset = ONSET + 10 * np.arange(SEEDS)
  got = row(fired(STEPS, *[(ONSET - 1, ONSET + 52)] * SEEDS), onset=onset)
  assert got["stream_latency_steps"] == [52, 42, 32, 22, 12, 2]


# ---- what must not change it ---------------------------------------------------------------------


def test_a_longer_fault_stream_changes_nothing():
  """1,000 more steps of alarms and wild scores behind the horizon, and others before the onset:
  every number stays.
  """
  rng = np.random.default_rng(0)
  alarm, healthy, score = (
    rng.random((ONSET + HORIZON, SEEDS)) < 0.002,
    rng.random((HEALTHY, SEEDS)) < 0.001,
    noise(ONSET + HORIZON),
  )
  before = row(alarm, healthy, score)
  assert before["miss_probability"] > 0  # there is something that a late alarm could spoil
  longer = np.concatenate([alarm, np.ones((1000, SEEDS), bool)])
  longer[:ONSET] = True
  scores = np.concatenate([score, np.full((1000, SEEDS), 9.0)])
  scores[:ONSET] = 9.0
  assert row(longer, healthy, scores) == before


def test_more_faults_change_a_mean_by_their_share_alone():
  """Of four faults of equal weight the fourth moves each mean by a quarter of its distance (that it
  changes no row of the others: test_leaderboard.py).
  """
  rows = [
    random_row(k) | {"detector": d, "robot": "walker", "fault": f"f{k}", "severity": 0.5}
    for d in ("a", "b")
    for k in range(3)
  ]
  new = random_row(7) | {"robot": "walker", "fault": "new", "severity": 1.0}
  before, after = (
    comparison.overall(x).rows for x in (rows, rows + [new | {"detector": d} for d in "ab"])
  )
  for old in before:
    own = next(r for r in after if r["detector"] == old["detector"])
    assert (old["blocks"], own["blocks"]) == (3, 4)
    for key in ("cost_standard", "detected_within_5s", "false_alarms_per_hour"):
      assert own[key] == pytest.approx((3 * old[key] + new[key]) / 4), key
  # another fault of the suite leaves the false alarms alone, which come from healthy streams
  assert row(np.ones_like(NEVER), QUIET)["false_alarms_per_hour"] == 0.0


def test_longer_healthy_streams_change_the_rate_by_their_alarms_alone():
  healthy = fired(HEALTHY, (500,), *[()] * 5)
  double = np.concatenate([healthy, healthy[WARM:]])
  assert row(NEVER, double)["false_alarms_per_hour"] == pytest.approx(
    row(NEVER, healthy)["false_alarms_per_hour"]
  )


# ---- AUROC ---------------------------------------------------------------------------------------


def test_auroc_equals_brute_force_with_ties_and_unknown_scores():
  rng = np.random.default_rng(0)
  score, healthy = (
    rng.integers(0, 6, (STEPS, SEEDS)).astype(float),
    rng.integers(-1, 5, (HEALTHY, SEEDS)).astype(float),
  )
  score[rng.random(score.shape) < 0.1] = np.nan
  healthy[rng.random(healthy.shape) < 0.1] = np.nan
  onset = ONSET + np.arange(SEEDS)
  a = np.concatenate([score[k : k + HORIZON, s] for s, k in enumerate(onset)])
  b = healthy[WARM:].ravel()
  a, b = a[~np.isnan(a)], b[~np.isnan(b)]
  want = np.mean((a[:, None] > b) + 0.5 * (a[:, None] == b))
  assert row(NEVER, score=score, healthy_score=healthy, onset=onset)["auroc"] == pytest.approx(want)
  assert want == pytest.approx(scipy.stats.mannwhitneyu(a, b).statistic / len(a) / len(b))


def test_auroc_interval_equals_a_bootstrap_by_loop():
  """Seeds of unlike sizes and levels; the same draws, each AUROC pooled anew."""
  rng = np.random.default_rng(0)
  faulty = [rng.standard_normal(20 + 5 * k) + 0.5 * k for k in range(5)]
  healthy = [rng.standard_normal(30 + k) for k in range(5)]
  _, got = metrics.auroc(faulty, healthy, reps=200)
  values = []
  for draw in intervals.draws(5, 200):
    a, b = np.concatenate([faulty[i] for i in draw]), np.concatenate([healthy[i] for i in draw])
    values.append(np.mean(a[:, None] > b))
  assert got == pytest.approx(intervals.ends(np.array(values)[None])[0])
  assert 0.02 < got[1] - got[0] < 0.5


def test_difference_of_two_detectors_is_paired_over_seeds():
  """Against the loop: a drawn seed counts for both detectors, with all faults of its robot; a
  constant lead has no width.
  """
  rows = []
  for name, false in (("a", 1), ("b", 0)):
    rng = np.random.default_rng(4)
    for robot, severity in (("walker", 0.5), ("walker", 1.0), ("car", 0.5)):
      latency, false_alarms = rng.integers(100, 300, SEEDS), np.full(SEEDS, false)
      rows.append(
        {
          "detector": name,
          "robot": robot,
          "fault": "gear",
          "severity": severity,
          "streams": SEEDS,
          "control_s": CONTROL,
          "healthy_steps": 5000,
          "stream_latency_steps": latency.tolist(),
          "stream_healthy_alarms": false_alarms.tolist(),
        }
      )
      rows[-1] |= {
        k: float(np.mean(v))
        for k, v in metrics.per_stream(latency.astype(float), false_alarms, 5000, CONTROL).items()
      }
  value, (low, high) = comparison.difference(rows, "b", "a", reps=400)
  assert value > 0 and low == pytest.approx(value) == high
  rows[-1]["stream_latency_steps"] = rows[-1]["stream_latency_steps"][
    ::-1
  ]  # no longer the same lead in every stream
  value, interval = comparison.difference(rows, "b", "a", reps=400)
  cost = lambda r: metrics.per_stream(
    np.array(r["stream_latency_steps"], float), np.array(r["stream_healthy_alarms"]), 5000, CONTROL
  )["cost_standard"]
  strata, loop = {"car": [2], "walker": [0, 1]}, []
  gains = [cost(b) - cost(a) for a, b in zip(rows[:3], rows[3:])]
  draws = {robot: intervals.draws(SEEDS, 400, k) for k, robot in enumerate(sorted(strata))}
  for i in range(400):
    loop.append(
      sum(gains[j][draws[robot][i]].mean() for robot, own in strata.items() for j in own) / 3
    )
  assert interval == pytest.approx(intervals.ends([loop])[0]) and interval[0] < value < interval[1]
  with pytest.raises(UserError, match="same faults; got 3 and 2"):
    comparison.difference(rows[:5], "a", "b")
  with pytest.raises(UserError, match="no streams"):
    comparison.difference(
      [{k: v for k, v in r.items() if k != "stream_latency_steps"} for r in rows], "a", "b"
    )


# ---- bootstrap -----------------------------------------------------------------------------------


def test_weights_are_the_draws_and_ends_are_quantiles():
  x = np.random.default_rng(0).standard_normal(7)
  np.testing.assert_allclose(intervals.weights(7, 500) @ x, x[intervals.draws(7, 500)].mean(1))
  assert (intervals.draws(7, 500, 1) != intervals.draws(7, 500)).any()
  stats = np.random.default_rng(1).standard_normal((3, 999))
  assert (
    intervals.ends(stats) == np.quantile(stats, [0.025, 0.975], axis=1, method="nearest").T.tolist()
  )
  assert intervals.ends(
    [
      [1.0, 2.0, math.inf, math.inf],
      [math.inf] * 4,
      [math.nan, math.nan, math.nan, 1.0],
      [3.0, math.nan, 1.0, 2.0],
    ]
  ) == [[1.0, None], None, None, [1.0, 3.0]]


def test_bootstrap_interval_of_a_row_equals_the_loop():
  """Median and cost from the same draws, one at a time."""
  got = random_row(3)
  latency = np.array([np.inf if x is None else x for x in got["stream_latency_steps"]])
  cost = metrics.per_stream(
    latency, np.array(got["stream_healthy_alarms"]), got["healthy_steps"], CONTROL
  )["cost_standard"]
  medians, costs = [], []
  for draw in intervals.draws(SEEDS, metrics.REPS):
    x = latency[draw]
    medians.append(sorted(x)[(SEEDS - 1) // 2] if np.isinf(x).sum() * 2 < SEEDS else np.inf)
    costs.append(cost[draw].mean())
  assert [got["latency_median_steps_ci"], got["cost_standard_ci"]] == [
    pytest.approx(x) for x in intervals.ends([medians, costs])
  ]
  assert got["cost_standard"] == pytest.approx(cost.mean())


def test_a_row_takes_5_ms():
  """100,000 scores of ten seeds, as in the suite. Goal 5 ms on a quiet core; ten times that, so
  that only a loop over draws fails on a busy one.
  """
  alarm, score = np.zeros((4000, 10), bool), noise(4000, 0, 10).astype(np.float32)
  seconds = []
  for _ in range(5):
    begin = time.thread_time()
    metrics.row(alarm, score, 2000, alarm, score, 0.025, 1000)
    seconds.append(time.thread_time() - begin)
  assert min(seconds) < 0.05


# ---- ARL0 and episodes ---------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 7, 49, 50, 1000])
def test_arl0_has_the_exact_poisson_interval(count):
  alarm = np.zeros((2000, 3), bool)
  alarm[:500] = True  # warm-up
  alarm[500 : 500 + count // 3, :] = True
  alarm[1999, : count % 3] = True
  got = metrics.arl0(alarm, 500)
  assert got["alarms"] == count and got["few"] == (count < 50)
  assert got["arl0"] == (4500 / count if count else None)
  low, high = got["arl0_ci"]
  assert low == pytest.approx(4500 / (scipy.stats.chi2.ppf(0.975, 2 * count + 2) / 2), rel=1e-9)
  assert high == (
    pytest.approx(4500 / (scipy.stats.chi2.ppf(0.025, 2 * count) / 2), rel=1e-9) if count else None
  )


def test_arl0_of_nothing_is_undefined():
  assert metrics.arl0(np.zeros((10, 2), bool), 10) == {
    "arl0": None,
    "arl0_ci": None,
    "alarms": 0,
    "few": True,
  }


def test_episode_alarm_probability_counts_whole_episodes():
  """Stream 0: episodes of 40, 30, 20, 10 steps; stream 1: of 50 and 50. From step 10 on, whole and
  followed: 30 and 20 of stream 0.
  """
  episode = np.stack([np.repeat([0, 1, 2, 3], [40, 30, 20, 10]), np.repeat([5, 6], [50, 50])], 1)
  probability = lambda *at, count_from=10: metrics.episode_alarm_probability(
    fired(100, *at), episode, count_from
  )
  assert probability((45, 46), ())["episode_alarm_probability"] == 0.5
  assert probability((39, 70, 89), ()) == {
    "episode_alarm_probability": 0.5,
    "episode_alarm_probability_ci": intervals.wilson(1, 2),
    "episodes": 2,
  }
  assert (
    probability((39, 90, 99), (49, 50))["episode_alarm_probability"] == 0.0
  )  # in episodes that are cut at either end
  assert (
    probability((0,), (49,), count_from=0)["episode_alarm_probability"] == 0.5
    and probability((), (), count_from=0)["episodes"] == 4
  )
  assert probability((), (), count_from=90) == {
    "episode_alarm_probability": None,
    "episode_alarm_probability_ci": None,
    "episodes": 0,
  }


# ---- overall -------------------------------------------------------------------------------------


def suite(levels, robots=("walker", "car"), faults=4, spread=40, seed=0):
  """Rows of detectors whose latency is levels[name] plus noise that all detectors share, and some
  of their own.
  """
  rng, rows = np.random.default_rng(seed), []
  for robot in robots:
    for k in range(faults):
      shared = rng.integers(0, spread, SEEDS)
      for name, level in levels.items():
        latency = level + shared + rng.integers(0, spread, SEEDS)
        r = row(
          fired(STEPS, *[(ONSET + x,) for x in latency]),
          fired(HEALTHY, *[(200 + x,) for x in latency]),
        )
        rows.append(r | {"detector": name, "robot": robot, "fault": f"f{k}", "severity": 0.5})
  return rows


def test_a_reference_takes_no_rank_and_makes_none():
  rivals = suite({"slow": 200, "quick": 5, "middle": 100})
  told = [r | {"reference": True} for r in suite({"oracle": 0})]
  told[0]["cost_standard"] = None  # nor does a fault without it cost the others their ranks
  want, got = (
    comparison.overall(rivals),
    comparison.overall([r | {"reference": False} for r in rivals] + told),
  )
  ranks = lambda o: {r["detector"]: r["mean_rank"] for r in o.rows}
  assert (
    ranks(got) == ranks(want) | {"oracle": None}
    and got[1:] == want[1:]
    and want.critical_difference
  )


def test_overall_means_ranks_and_order():
  rows = suite({"slow": 200, "quick": 5, "middle": 100})
  got = comparison.overall(rows)
  assert (
    [r["detector"] for r in got.rows] == ["quick", "middle", "slow"]
    and [r["mean_rank"] for r in got.rows] == [1, 2, 3]
    and got.blocks == 8
  )
  for r in got.rows:
    mine = [x for x in rows if x["detector"] == r["detector"]]
    for name in (
      "cost_standard",
      "cost_few_misses",
      "detected_within_5s",
      "miss_probability",
      "false_alarms_per_hour",
    ):
      assert r[name] == pytest.approx(np.mean([x[name] for x in mine]))
    low, high = r["cost_standard_ci"]
    assert low < r["cost_standard"] < high < low + 10
  costly = comparison.overall(
    [r | {"reward_lost": 0.1 if r["fault"] == "f0" else 0.09} for r in rows]
  ).rows[0]
  mine = [x for x in rows if x["detector"] == "quick" and x["fault"] == "f0"]
  assert 0 < costly["blocks_costly"] == len(mine) < 8
  assert costly["cost_costly"] == pytest.approx(np.mean([x["cost_standard"] for x in mine]))
  low, high = costly["cost_costly_ci"]
  assert low <= costly["cost_costly"] <= high
  assert got.rows[0]["cost_costly"] is None and got.rows[0]["blocks_costly"] == 0
  again = comparison.overall(rows[::-1])
  assert [r["detector"] for r in again.rows] == ["quick", "middle", "slow"]
  assert again.rows[0]["cost_standard_ci"] == pytest.approx(
    got.rows[0]["cost_standard_ci"]
  )  # sums in another order
  # all are found within 20 s, without false alarms: no interval of width zero
  none = comparison.overall(
    [r | {"stream_healthy_alarms": [0] * SEEDS, "false_alarms_per_hour": 0.0} for r in rows]
  ).rows[0]
  assert none["detected_within_20s_ci"] == intervals.wilson(12, 12)
  assert none["false_alarms_per_hour_ci"] == pytest.approx(
    [0, -math.log(0.025) / (12 * 1400 * 0.05 / 3600)]
  )


def test_overall_interval_draws_a_seed_with_all_faults_of_its_robot():
  """Faults whose latencies are equal seed by seed: the interval is that of one fault; independent
  draws would narrow it by sqrt(faults).
  """
  r = random_row(1)
  same = [
    r | {"detector": "a", "robot": "walker", "fault": f"f{k}", "severity": 0.5} for k in range(9)
  ]
  one, nine = comparison.overall(same[:1]).rows[0], comparison.overall(same).rows[0]
  assert nine["cost_standard_ci"] == pytest.approx(one["cost_standard_ci"]) and one[
    "cost_standard_ci"
  ] == pytest.approx(r["cost_standard_ci"])
  width = lambda x: x["cost_standard_ci"][1] - x["cost_standard_ci"][0]
  robots = comparison.overall([x | {"robot": f"r{k}"} for k, x in enumerate(same)]).rows[0]
  assert width(robots) == pytest.approx(
    width(one) / 3, rel=0.2
  )  # nine robots are independent; 2,000 draws and six seeds' skew


def test_overall_of_rows_without_streams_and_with_gaps():
  rows = suite({"a": 0, "b": 50}, faults=2)
  bare = [{k: v for k, v in r.items() if not k.startswith("stream_")} for r in rows]
  got = comparison.overall(bare)
  assert (
    got.rows[0]["cost_standard"] == pytest.approx(comparison.overall(rows).rows[0]["cost_standard"])
    and got.rows[0]["cost_standard_ci"] is None
  )
  assert comparison.overall(rows[:-1]).blocks == 3  # the block that one detector lacks has no ranks
  gap = comparison.overall([rows[0] | {"cost_standard": None}] + rows[1:])
  a = next(r for r in gap.rows if r["detector"] == "a")
  assert (
    a["cost_standard"] is None
    and a["cost_standard_ci"] is None
    and gap.blocks == 3
    and gap.rows[-1] is a
  )
  assert comparison.overall(rows[:1])[1:] == (None, None, 1) and comparison.overall([]) == (
    [],
    None,
    None,
    0,
  )
  with pytest.raises(UserError, match="two rows"):
    comparison.overall(rows + rows[:1])


@pytest.mark.parametrize("detectors, q", [(2, 1.960), (3, 2.343), (5, 2.728), (10, 3.164)])
def test_critical_difference_equals_demsars_table(detectors, q):
  """Table 5a of Demsar 2006: q at 5 %; CD = q sqrt(k (k + 1) / (6 n))."""
  r = random_row()
  rows = [
    r | {"detector": str(d), "robot": "walker", "fault": f"f{k}", "severity": 0.5}
    for d in range(detectors)
    for k in range(12)
  ]
  got = comparison.overall(rows, reps=2)
  assert got.critical_difference == pytest.approx(
    q * math.sqrt(detectors * (detectors + 1) / 72), rel=3e-4
  )
  assert got.friedman_p == 1.0 and {x["mean_rank"] for x in got.rows} == {
    (detectors + 1) / 2
  }  # all equal


def test_blocks_that_share_a_seed_are_no_evidence_of_their_own():
  """`b` is `a` but for an alarm on one of six healthy streams, which lies below all of a robot's
  faults: in a third of the draws that stream is missing, and the two are alike.
  """
  alarm, healthy = fired(STEPS, *[(ONSET + 20,)] * SEEDS), fired(HEALTHY, *[()] * SEEDS)
  once = healthy.copy()
  once[300, 0] = True
  rows = [
    row(alarm, quiet) | {"detector": d, "robot": "walker", "fault": f"f{k}", "severity": 0.5}
    for d, quiet in (("a", healthy), ("b", once))
    for k in range(30)
  ]
  got = comparison.overall(rows)
  ranks = {r["detector"]: r["mean_rank"] for r in got.rows}
  assert ranks == {"a": 1, "b": 2}
  assert got.critical_difference >= 1 > 1.96 * (2 * 3 / 6 / 30) ** 0.5  # Nemenyi's


def test_friedman_equals_scipy_with_ties():
  rng, rows = np.random.default_rng(0), []
  base = random_row()
  scores = rng.integers(0, 6, (4, 9)) + np.arange(4)[:, None]
  for d in range(4):
    rows += [
      base
      | {
        "detector": str(d),
        "robot": "car",
        "fault": f"f{k}",
        "severity": 0.5,
        "cost_standard": float(scores[d, k]),
      }
      for k in range(9)
    ]
  got = comparison.overall(rows, reps=2)
  assert (
    got.friedman_p == pytest.approx(scipy.stats.friedmanchisquare(*scores).pvalue)
    and 1e-6 < got.friedman_p < 0.5
  )
  ranks = np.mean([scipy.stats.rankdata(-scores[:, k]) for k in range(9)], 0)
  assert {r["detector"]: r["mean_rank"] for r in got.rows} == {
    str(d): pytest.approx(ranks[d]) for d in range(4)
  }
