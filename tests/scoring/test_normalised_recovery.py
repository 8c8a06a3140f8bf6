"""Normalised recovery by hand sums: five seeds, four arms."""

import pytest

from mjx_cl.scoring import normalised_recovery

PRE = {0: 1.0, 1: 0.8, 2: 1.0, 3: 1.0, 4: None}
FINAL = {
  "none": {0: 0.5, 1: 0.4, 2: 0.95, 3: 0.0, 4: 0.1},
  "detector": {0: 0.75, 1: 0.3, 2: 0.99, 3: 1.1, 4: 0.5},
  "oracle": {0: 1.0, 1: 0.5, 2: 0.9, 3: 0.5, 4: 0.5},
  "no-fault": {0: 1.0, 1: 1.0, 2: 1.0, 3: 1.0, 4: 1.0},
}
EXPERT = {0: 0.9, 1: 0.45, 2: 1.2, 3: 0.05}  # seed 4 did not live there


def run(final=FINAL):
  """Rows of runs.parquet; the pre of an arm of its own must not count, nor must what a later change
  left behind.
  """
  out = [
    {
      "stream": 10 * i + seed,
      "arm": arm,
      "seed": seed,
      "change": 0,
      "onset": None if arm == "no-fault" else 500,
      "reward_final": value,
      "reward_pre": PRE[seed] if arm == "none" else 7.0,
    }
    for i, (arm, own) in enumerate(final.items())
    for seed, value in own.items()
  ]
  return out + [r | {"change": 1, "reward_final": -9.0} for r in out[:2]]


def by(scored):
  return {(r["arm"], r["seed"]): r for r in scored}


def test_by_hand_against_reward_pre():
  scored = by(normalised_recovery.rows(run()))
  got = {k: r["normalised"] for k, r in scored.items()}
  assert len(scored) == 15 and {k[0] for k in scored} == {"none", "detector", "oracle"}
  assert [got["none", s] for s in range(5)] == [
    0.0,
    0.0,
    None,
    0.0,
    None,
  ]  # seed 2 lost 5 %, of seed 4 nothing is known
  assert [got["detector", s] for s in range(5)] == [
    0.5,
    pytest.approx(-0.25),
    None,
    pytest.approx(1.1),
    None,
  ]
  assert [got["oracle", s] for s in range(5)] == [1.0, pytest.approx(0.25), None, 0.5, None]
  row = scored["detector", 1]
  assert (
    row["reward_none"],
    row["reward_final"],
    row["reward_reference"],
    row["reward_pre"],
    row["reference"],
  ) == (0.4, 0.3, 0.8, 0.8, "reward_pre")


def test_a_healthy_robot_that_never_adapts_is_no_floor():
  """An arm of one's own, told after `none`: the highest there is."""
  healthy = [
    r | {"arm": "mine", "reward_final": 9.0, "onset": None} for r in run() if r["arm"] == "none"
  ]
  assert by(normalised_recovery.rows(run() + healthy)) == by(normalised_recovery.rows(run()))


def test_by_hand_against_an_expert():
  expert = [{"arm": "oracle", "seed": s, "reward_final": x} for s, x in EXPERT.items()]
  scored = by(normalised_recovery.rows(run(), expert))
  assert {k[1] for k in scored} == {0, 1, 2, 3} and {r["reference"] for r in scored.values()} == {
    "expert"
  }
  got = {k: r["normalised"] for k, r in scored.items() if k[0] == "detector"}
  assert got == {
    ("detector", 0): pytest.approx(0.625),
    ("detector", 1): None,
    ("detector", 2): pytest.approx(0.16),
    ("detector", 3): None,
  }
  lax = by(normalised_recovery.rows(run(), expert, least=0.04))
  assert lax["detector", 1]["normalised"] == pytest.approx(-2.0) and lax["detector", 3][
    "normalised"
  ] == pytest.approx(22.0)


def test_what_means_little_is_undefined():
  assert normalised_recovery.normalise(0.7, 0.5, 0.9, 1.0) == pytest.approx(0.5)
  at_a_tenth, below = (normalised_recovery.normalise(0.7, 0.75, 1.0, pre) for pre in (2.5, 2.6))
  assert at_a_tenth == pytest.approx(-0.2) and below is None
  assert (
    normalised_recovery.normalise(0.7, 0.9, 0.5, 1.0) is None
    and normalised_recovery.normalise(0.7, 0.5, 0.9, 0.0) is None
  )
  assert normalised_recovery.normalise(-3.0, -4.0, -2.0, -1.0) is None
  for gap in range(4):
    assert (
      normalised_recovery.normalise(
        *[None if i == gap else x for i, x in enumerate((0.7, 0.5, 0.9, 1.0))]
      )
      is None
    )


def test_aggregates_and_the_paired_difference():
  scored = normalised_recovery.rows(run())
  arms = normalised_recovery.summarise(scored)
  assert arms["detector"] == {
    "seeds": 3,
    "undefined": 2,
    "normalised": pytest.approx((0.5 - 0.25 + 1.1) / 3),
    "normalised_ci": pytest.approx([-0.25, 1.1]),
  }
  pair = normalised_recovery.difference(scored, "detector", "oracle")
  assert (
    pair["seeds"] == 3
    and pair["difference"] == pytest.approx((-0.5 - 0.5 + 0.6) / 3)
    and pair["holds_zero"] is True
  )
  assert pair["difference_ci"] == pytest.approx(
    [-0.5, 0.6]
  )  # one draw in 27 takes an end three times: more than one in 40
  worse = normalised_recovery.difference(scored, "none", "oracle")
  assert worse["difference_ci"] == pytest.approx([-1.0, -0.25]) and worse["holds_zero"] is False
  assert normalised_recovery.difference(scored, "detector", "always") == {
    "seeds": 0,
    "difference": None,
    "difference_ci": None,
    "holds_zero": None,
  }
