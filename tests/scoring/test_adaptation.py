"""The board of methods by hand."""

import itertools

import numpy as np
import pytest

from mjx_cl.errors import UserError
from mjx_cl.scoring import adaptation

STEPS = 1_000  # after the onset


def life(method, seed, lost, robot="walker", setting="gear", agent="walker", **other):
  """One that loses the share `lost` of a reward of 0.5 a step."""
  own = {
    "robot": robot,
    "setting": setting,
    "method": method,
    "agent": agent,
    "seed": seed,
    "reward_pre": 0.5,
    "return_lost": lost * 0.5 * STEPS,
    "return_lost_healthy": 0.0,
    "onset": 400,
    "steps": STEPS,
    "affected": lost > 0.1,
    "recovery_step": None,
    "terminations": 0,
    "false_alarms": 0,
    "updates": 10,
    "wall_s": 2.0,
  }
  return own | other


def lives(lost, **other):
  """{method: shares lost, by seed} as lives, affected where `none` loses more than a tenth."""
  return [
    life(method, seed, x, **{"affected": lost.get("none", of)[seed] > 0.1} | other)
    for method, of in lost.items()
    for seed, x in enumerate(of)
  ]


NONE = [0.4, 0.2, 0.3, 0.5, 0.1, 0.3]
HALF = [x / 2 for x in NONE]


def of(board, method):
  return next(r for r in board.overall if r["method"] == method)


def test_scores_by_hand():
  """A mean over settings and then over robots, of ratios of mean losses."""
  some = lives({"none": NONE, "detector": [0.3, 0.2, 0.3, 0.3, 0.0, 0.1], "mine": HALF})
  more = lives({"none": [0.5, 0.7], "detector": [0.6, 0.9], "mine": [0.3, 0.3]}, setting="payload")
  car = lives({"none": [0.2, 0.2], "detector": [0.1, 0.1], "mine": [0.0, 0.1]}, robot="car")
  board = adaptation.board(some + more + car)
  detector, mine = of(board, "detector"), of(board, "mine")
  walker = [100 * (1 - 1.2 / 1.8), 100 * (1 - 1.5 / 1.2)]
  assert detector["score_walker"] == pytest.approx(np.mean(walker))
  assert detector["score"] == pytest.approx((np.mean(walker) + 50) / 2)
  assert mine["score_walker"] == pytest.approx((50 + 50) / 2) and mine["score_car"] == 75
  assert mine["gain"] == pytest.approx(62.5 - detector["score"])
  assert mine["gain_car"] == pytest.approx(25) and "gain_car" not in detector
  assert of(board, "none")["score"] == 0
  assert [r["method"] for r in board.overall] == ["mine", "detector", "none"]
  assert mine["mean_rank"] == 1 and detector["mean_rank"] == 2  # `none` takes no rank
  assert board.critical_difference == pytest.approx(1.96 * (2 * 3 / 6 / 3) ** 0.5, rel=1e-3)


def test_the_best_gain_comes_first_whatever_other_lives_a_method_has():
  """`many` has lived a harder agent too, which lowers its score, not what it gains."""
  easy = {
    "none": NONE,
    "detector": HALF,
    "few": [x / 3 for x in NONE],
    "many": [x / 4 for x in NONE],
  }
  hard = {"none": NONE, "detector": NONE, "many": [x / 2 for x in NONE]}
  board = adaptation.board(lives(easy, agent="a") + lives(hard, agent="b"))
  score = {r["method"]: r["score"] for r in board.overall}
  assert score["few"] > score["many"] > score["detector"]
  gain = {r["method"]: r["gain"] for r in board.overall}
  assert gain["few"] == pytest.approx(50 / 3) and gain["many"] == pytest.approx(37.5)
  assert [r["method"] for r in board.overall] == ["many", "few", "detector", "none"]


def test_half_of_every_loss_has_no_interval_and_a_difference_is_paired():
  board = adaptation.board(lives({"none": NONE, "mine": HALF}))
  assert of(board, "mine")["score_ci"] == pytest.approx([50, 50])
  row = next(r for r in board.rows if r["method"] == "mine")
  assert row["beyond"] == pytest.approx(-0.15) and row["beyond_ci"][1] < 0
  assert row["beyond_p"] == pytest.approx(2 / 2**6)  # all six one way


def test_harm_is_told_by_pairs_and_corrected():
  worse = [x + 0.15 for x in NONE]
  one = lives({"none": NONE, "bad": worse})
  many = one + [
    x
    for k in range(3)
    for x in lives({"none": NONE, "bad": [NONE[0] + (-1) ** k * 0.01, *NONE[1:]]}, setting=f"{k}")
  ]
  bad = of(adaptation.board(one), "bad")
  assert (bad["harm"], bad["harm_holm"], bad["harm_streams"]) == (1, 1, 1.0)
  bad = of(adaptation.board(many), "bad")  # four tests: 0.031 is above 0.05 / 4
  assert (bad["settings"], bad["harm"], bad["harm_holm"], bad["harm_streams"]) == (4, 1, 0, 0.25)


def test_harm_by_agent_shows_what_unlike_agents_hide():
  """One agent of two is undone, the other repaired: together nothing can be said, apart it can."""
  both = lives({"none": NONE, "mine": [x + 0.3 for x in NONE]}, agent="a")
  both += lives({"none": NONE, "mine": [0.1 * x for x in NONE]}, agent="b")
  row = of(adaptation.board(both), "mine")
  assert (row["harm"], row["harm_agents"], row["pairs"], row["harm_streams"]) == (0, 1, 2, 0.5)
  alone = [x for x in both if x["seed"] == both[0]["seed"]]  # a seed of an agent tells nothing
  assert of(adaptation.board(alone), "mine")["harm_agents"] == 0


def test_agents_are_drawn_too():
  """Two agents that differ, whose seeds do not: the interval is that of agents."""
  both = lives({"none": [0.4] * 6, "mine": [0.1] * 6}, agent="a")
  both += lives({"none": [0.4] * 6, "mine": [0.3] * 6}, agent="b")
  row = of(adaptation.board(both), "mine")
  assert row["score"] == pytest.approx(50) and row["agents"] == 2
  assert row["score_ci"] == pytest.approx([25, 75])


def test_robots_are_drawn_apart():
  """Two robots whose losses mirror each other by seed: a mean of two independent draws."""
  own = [0.0, 0.1, 0.2, 0.3]
  both = lives({"none": [0.4] * 4, "mine": own})
  both += lives({"none": [0.4] * 4, "mine": own[::-1]}, robot="car")
  row = of(adaptation.board(both), "mine")
  low, high = row["score_ci"]
  one = row["score_walker_ci"][1] - row["score_walker_ci"][0]
  assert 0.5 * one < high - low < 0.9 * one  # about one / sqrt(2)


def test_a_method_of_fewer_seeds_is_compared_on_those():
  """The paper's method on the first three seeds alone, under another name, gains nothing."""
  paper = [0.3, 0.2, 0.3, 0.3, 0.0, 0.1]
  board = adaptation.board(lives({"none": NONE, "detector": paper, "mine": paper[:3]}))
  row = of(board, "mine")
  assert row["gain"] == pytest.approx(0) and row["gain_ci"] == pytest.approx([0, 0], abs=1e-9)
  assert row["mean_rank"] == of(board, "detector")["mean_rank"] == 1.5
  single = of(adaptation.board(lives({"none": NONE, "mine": [0.1]})), "mine")
  assert single["score_ci"] is None and single["score"] == pytest.approx(75)


def test_the_reward_before_is_that_of_none():
  """A false alarm that cuts a method's own window short does not move what it lost."""
  some = lives({"none": NONE, "mine": HALF})
  for x in some:
    if x["method"] == "mine":  # as much is earned, said from a window of another mean
      x["return_lost"] += (0.6 - 0.5) * STEPS
      x["reward_pre"] = 0.6
  assert of(adaptation.board(some), "mine")["score"] == pytest.approx(50)


def test_what_is_not_known_does_not_count():
  some = lives({"none": NONE, "mine": HALF})
  some[6] |= {"reward_pre": None, "return_lost": None, "return_lost_healthy": None}
  row = next(r for r in adaptation.board(some).rows if r["method"] == "mine")
  assert row["lost_none"] == pytest.approx(sum(NONE[1:]) / 5)
  for x in some:  # lived without arm `none`: nobody knows when it recovers
    if x["method"] == "mine":
      x["affected"] = None
  row = next(r for r in adaptation.board(some).rows if r["method"] == "mine")
  assert (row["affected"], row["recovered"]) == (0, 0)


def test_one_known_pair_has_no_interval():
  """Neither of a score, nor of harm, nor of a gain over the paper's method."""
  some = lives({"none": [0.1, 0.1], "mine": [0.3, 0.3]})
  some[3] |= {"reward_pre": None}
  board = adaptation.board(some)
  row = next(r for r in board.rows if r["method"] == "mine")
  assert (row["streams"], row["known"]) == (2, 1)
  assert row["score_ci"] is row["beyond_ci"] is None and of(board, "mine")["harm"] == 0
  mine = of(adaptation.board(lives({"none": NONE, "mine": HALF, "detector": [0.3]})), "mine")
  assert mine["gain"] == pytest.approx(25) and mine["gain_ci"] is mine["gain_walker_ci"] is None


def test_a_gain_is_of_the_lives_that_both_are_known_of():
  some = lives({"none": [0.4] * 4, "mine": [0.0, 0.1, 0.2, 0.3], "detector": [0.0, 0.1, 0.2, 0.9]})
  some[-1] |= {"return_lost": None}
  board = adaptation.board(some)
  mine = of(board, "mine")
  assert mine["gain"] == 0 and mine["gain_ci"] == [0, 0]
  assert mine["mean_rank"] == of(board, "detector")["mean_rank"]


def test_draws_in_which_nothing_is_lost_leave_the_end_open():
  """Of `none` 0.3, -0.1, -0.1, -0.05 four draws in ten have a mean of 0 or less."""
  lost = {"none": [0.3, -0.1, -0.1, -0.05], "detector": [-0.1] * 4, "mine": [-0.2] * 4}
  lost["bad"] = [x + 0.2 for x in lost["none"]]
  board = adaptation.board(lives(lost))
  low, high = of(board, "mine")["score_ci"]
  assert low <= of(board, "mine")["score"] and high is None
  assert of(board, "none")["score_ci"] == [0, 0]
  # what loses more is as much worse as what loses less is better, and a gain has these draws too
  low, high = of(board, "bad")["score_ci"]
  assert low is None and of(board, "bad")["score"] <= high < 0
  low, high = of(board, "mine")["gain_ci"]
  assert 0 < low <= of(board, "mine")["gain"] and high is None


def test_lives_of_ones_own_are_measured_against_ones_own_none():
  """The same seeds on another machine: there `none` loses 0.6, here 0.3."""
  published = lives({"none": [0.3] * 4, "detector": [0.15] * 4})
  own = lives({"none": [0.6] * 4, "mine": [0.45] * 4}, own=True)
  board = adaptation.board(published + own)
  row = next(r for r in board.rows if r["method"] == "mine")
  assert (row["score"], row["beyond"], row["worse"]) == (pytest.approx(25), pytest.approx(-0.15), 0)
  assert of(board, "mine")["gain"] == pytest.approx(25 - 50)
  assert of(board, "mine")["gain_ci"] == pytest.approx([-25, -25])
  assert next(r for r in board.rows if r["method"] == "none")["lost"] == pytest.approx(0.3)
  alone = adaptation.board(own)  # no published ones
  assert of(alone, "mine")["score"] == pytest.approx(25) and of(alone, "none")["streams"] == 4
  bare = adaptation.board(published + own[4:])  # lived without `none`
  assert of(bare, "mine")["score"] == pytest.approx(-50)


def test_draws_of_agents_that_a_method_has_no_life_of_do_not_count():
  """`mine` is lived by one agent of three: that agent's seeds alone make its interval."""
  lost = {"none": NONE, "detector": HALF, "mine": [0.1] * 6}
  some = [x for agent in "abc" for x in lives(lost, agent=agent)]
  some = [x for x in some if x["method"] != "mine" or x["agent"] == "a"]
  row = of(adaptation.board(some), "mine")
  alone = of(adaptation.board(lives(lost, agent="a")), "mine")
  assert row["gain"] == pytest.approx(alone["gain"])
  assert row["gain_ci"] == pytest.approx(alone["gain_ci"], abs=6)  # other draws


def test_a_method_of_one_robot_has_no_score_over_all():
  some = lives({"none": NONE, "detector": HALF, "mine": [0.0] * 6})
  some += lives({"none": NONE, "detector": HALF}, robot="car")
  mine = of(adaptation.board(some), "mine")
  assert mine["score"] is mine["score_ci"] is None
  assert (mine["score_walker"], mine["gain"]) == (100, pytest.approx(50))


def test_what_it_costs():
  lost = {"none": [0.3, 0.3, 0.0], "mine": [0.1, 0.1, 0.1]}
  own = lives(lost)
  for x in own:
    if x["method"] == "mine":
      x |= {"terminations": 3, "false_alarms": int(x["seed"] == 1), "return_lost_healthy": 20.0}
      x |= {"recovery_step": 900 if x["seed"] == 0 else None}
  row = next(r for r in adaptation.board(own).rows if r["method"] == "mine")
  assert (row["falls"], row["false_alarms"], row["updates"], row["wall_s"]) == (3, 1, 10, 2)
  assert row["healthy_lost"] == pytest.approx(20 / (0.5 * 400))
  assert (row["affected"], row["recovered"]) == (2, 1)  # the third loses nothing without it
  for x in own:  # nor was one affected where it was lived: when it recovers was not asked
    x |= {"affected": False} if x["method"] == "mine" and x["seed"] == 1 else {}
  row = next(r for r in adaptation.board(own).rows if r["method"] == "mine")
  assert (row["affected"], row["recovered"]) == (1, 1)


def test_time_to_recovery_is_a_restricted_mean():
  """Of two that take 500 and 1,500 steps and one that never does within 3,000 that can be seen."""
  own = [life("none", k, 0.3, steps=5_000) for k in range(3)]
  when = [900, 1_900, None]
  own += [life("mine", k, 0.1, steps=5_000, affected=True, recovery_step=when[k]) for k in range(3)]
  row = next(r for r in adaptation.board(own).rows if r["method"] == "mine")
  assert row["recovery_steps"] == pytest.approx((500 + 1_500 + 3_000) / 3)
  own[-1]["steps"] = 2_000  # in which nobody can have been back for as long as it takes
  row = next(r for r in adaptation.board(own).rows if r["method"] == "mine")
  assert row["recovery_steps"] is row["recovery_steps_ci"] is None


@pytest.mark.parametrize("n", (5, 9))
def test_sign_flips_count_every_choice(n):
  x = np.random.default_rng(n).normal(0.4, 1, n)
  count = sum(
    abs(sum(s * v for s, v in zip(signs, x))) >= abs(x.sum()) - 1e-9
    for signs in itertools.product((-1, 1), repeat=n)
  )
  assert adaptation.sign_flips(x) == pytest.approx(count / 2**n)
  assert adaptation.sign_flips(x[:1]) is None


def test_holm_by_hand():
  p = [0.04, 0.001, None, 0.012, 0.03]  # against 0.0125, 0.0167, 0.025: the third stops it
  assert adaptation.holm(p) == [False, True, False, True, False]


def test_what_cannot_be_compared_is_said():
  with pytest.raises(UserError, match="setting gear of walker has no arm 'none'"):
    adaptation.board(lives({"mine": HALF}))
  with pytest.raises(UserError, match="two lives of walker, gear, none, walker, 0"):
    adaptation.board(lives({"none": NONE}) * 2)


def test_no_score_where_the_fault_costs_nothing():
  board = adaptation.board(lives({"none": [0.0] * 3, "mine": [0.1] * 3}))
  assert of(board, "mine")["score"] is None and of(board, "mine")["harm"] == 1
