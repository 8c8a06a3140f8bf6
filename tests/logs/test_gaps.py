"""Logs that lack something: samples, rows, a column from some time on. None of it is a change, and
a change is found all the same.
"""

import json

import numpy as np
import pytest
from test_detect import mjx  # noqa: F401  a fixture
from test_verdict import gait, save

from mjx_cl.logs import charts, detect, gaps, healthy, inject, verdict

NAMES = ["hip", "knee", "current"]


def leg(samples, seed, since=None, off=0.1):
  """The gait of docs/tutorials/log.md, its hip off from sample `since` on."""
  rng, t = np.random.default_rng(seed), np.arange(samples) / 50
  phase = 2 * np.pi * 1.3 * t + 0.3 * np.sin(0.2 * t)
  hip = 0.4 * np.sin(phase) + rng.normal(0, 0.01, samples)
  knee = 0.6 * np.cos(phase - 0.5) + rng.normal(0, 0.01, samples)
  current = 2 + 1.5 * np.abs(np.cos(phase)) + rng.normal(0, 0.05, samples)
  if since is not None:
    hip[since:] += off
  return np.stack([hip, knee, current], 1)


@pytest.fixture(scope="module")
def own():
  return verdict.calibrated(leg(6000, 0), 10_000)


@pytest.fixture(scope="module")
def nominal(tmp_path_factory):
  return save(tmp_path_factory.mktemp("gaps") / "healthy.csv", leg(6000, 0), NAMES)


def cells(share):
  def lacking(x, rng):
    x[rng.random(x.shape) < share] = np.nan

  return lacking


def stretches(rows, columns):
  def lacking(x, rng):
    for at in range(60, len(x) - 60, 190):
      x[at : at + rows, columns] = np.nan

  return lacking


LACKING = {
  "one cell in a hundred": cells(0.01),
  "one cell in twenty": cells(0.05),
  "one cell in five": cells(0.2),
  "two of the hip": stretches(2, [0]),
  "three of the knee": stretches(3, [1]),
  "ten of the hip": stretches(10, [0]),
  "ten of the current": stretches(10, [2]),
  "five rows": stretches(5, [0, 1, 2]),
}


@pytest.mark.parametrize("how", LACKING)
def test_missing_samples_are_no_change_and_hide_none(own, how):
  for seed in (1001, 1002, 1003):
    x, wrong = leg(2000, seed), leg(2000, seed, 1000, 0.03)
    for one in (x, wrong):
      LACKING[how](one, np.random.default_rng(seed))
    found = verdict.judge(own, verdict.watch(own, x), NAMES, 500)
    assert not [event for event in found if event["believed"]]
    found = verdict.judge(own, verdict.watch(own, wrong), NAMES, 500)
    (event,) = [event for event in found if event["believed"]]
    assert 1000 <= event["first_alarm"] < 1050
    assert [column["column"] for column in event["columns"]] == ["hip"]


def test_a_residual_on_filled_samples_has_the_deviation_it_is_measured_in(own):
  parts = []
  for seed in range(4):
    x = leg(4000, 50 + seed)
    cells(0.1)(x, np.random.default_rng(seed))
    parts.append(verdict.watch(own, x).residuals)
  deviation = np.nanstd(np.concatenate(parts, 1), 1)
  assert np.all(np.abs(deviation - 1) < 0.1)


def test_missing_samples_of_the_nominal_log_change_little(own):
  past = leg(6000, 0)
  cells(0.05)(past, np.random.default_rng(0))
  other = verdict.calibrated(past, 10_000)
  np.testing.assert_allclose(other.model.scale, own.model.scale, rtol=0.12)
  for seed in (1001, 1002, 1003):
    found = verdict.judge(other, verdict.watch(other, leg(2000, seed)), NAMES, 500)
    assert not [event for event in found if event["believed"]]


def test_what_is_filled_by_hand():
  """The prediction, its error, and that of a second row on the first; far away the mean."""
  rng = np.random.default_rng(0)
  x = rng.normal(size=(6000, 2))
  for t in range(1, len(x)):
    x[t, 0] += 0.9 * x[t - 1, 0]
  model, _ = healthy.fit(x)
  z = healthy.standard(model, x)
  holed = x.copy()
  holed[100:102, 0] = holed[200:300, 0] = np.nan
  got, error = healthy.filled(model, healthy.standard(model, healthy.held(holed)), holed)
  want, s = 0.9 * z[99, 0], model.scale[1, 0]
  np.testing.assert_allclose(got[100:102, 0], [want, 0.9 * want], atol=0.1)
  np.testing.assert_allclose(error[100:102, 0], s * np.sqrt([1, 1 + 0.81]), rtol=0.05)
  assert not error[:100].any() and not error[102:200].any()
  assert (got[250:300, 0] == 0).all() and (error[250:300, 0] == 1).all()
  np.testing.assert_array_equal(got[:, 1], z[:, 1])
  assert healthy.filled(model, z, x)[1] is None


def test_averages_stand_still_where_they_are_paused():
  x = np.random.default_rng(0).normal(size=(60, 2))
  x[20:25, 1] = np.nan
  paused = charts._paused(x)
  assert np.flatnonzero(paused[:, 1]).tolist() == [20, 21, 22, 23, 24] and not paused[:, 0].any()
  rest = np.delete(x, np.s_[20:25], 0)
  for got, want in zip(charts.averages(np.nan_to_num(x), 0.5, paused), charts.averages(rest, 0.5)):
    np.testing.assert_allclose(np.delete(got, np.s_[20:25], 0)[:, 1], want[:, 1])
    np.testing.assert_allclose(got[20:25, 1], want[19, 1])
  long = np.r_[x[:5], np.full((charts.PAUSE + 1, 2), np.nan), x[:5]]
  assert charts._paused(long) is None or not charts._paused(long).any()


def test_a_long_stretch_without_any_sample_begins_anew(own):
  x = leg(3000, 7)
  x[1000:1200] = np.nan
  found = verdict.watch(own, x)
  unknown = np.isnan(found.residuals).all((0, 2))
  assert np.flatnonzero(unknown).tolist() == [*range(16), *range(1003, 1216)]
  assert np.flatnonzero(~found.known.any(1)).tolist() == [*range(1003, 1216)]


# ---- rows that the clock tells of ----------------------------------------------------------------


def test_rows_that_are_missing_are_put_back(tmp_path, nominal, mjx):  # noqa: F811
  x, t = leg(2000, 1001, 1000), np.arange(2000) / 50
  keep = np.ones(2000, bool)
  for at in range(102, 1900, 180):
    keep[at : at + 5] = False
  at = gaps.places(t[keep])
  assert at.tolist() == np.flatnonzero(keep).tolist()
  for name, one in (("fine", leg(2000, 1001)), ("wrong", x)):
    rows = np.c_[t, one][keep]
    head = ",".join(["time", *NAMES])
    np.savetxt(tmp_path / f"{name}.csv", rows, "%.7g", ",", header=head, comments="")
  assert not detect.detect(tmp_path / "fine.csv", nominal).summary["verdict"]["changed"]
  found = detect.detect(tmp_path / "wrong.csv", nominal)
  said = found.summary["verdict"]
  assert said["changed"] and abs(said["begin_s"] - 20) < 0.2
  assert said["begin_s"] == found.seconds[said["begin"]]
  assert all(len(score) == keep.sum() for score in found.scores.values())


def test_a_seventh_of_the_rows_may_be_missing_from_an_even_clock(tmp_path, nominal):
  """More than a tenth of the intervals are wide, all of whole samples."""
  keep = np.random.default_rng(3).random(2000) > 0.15
  t = np.arange(2000) / 50
  assert (np.diff(t[keep]) > 0.03).mean() > 0.1
  assert gaps.places(t[keep]).tolist() == (np.flatnonzero(keep) - np.flatnonzero(keep)[0]).tolist()
  for since in (None, 1000):
    rows = np.c_[t, leg(2000, 1001, since)][keep]
    head = ",".join(["time", *NAMES])
    np.savetxt(tmp_path / "log.csv", rows, "%.7g", ",", header=head, comments="")
    found = detect.detect(tmp_path / "log.csv", nominal).summary["verdict"]
    assert found["changed"] == (since is not None)


def test_what_is_no_missing_row():
  t = np.arange(200) * 0.02
  late = t.copy()
  late[50] += 0.015  # the next one makes up for it
  for seconds in (None, t, late, np.cumsum(np.random.default_rng(0).exponential(size=200))):
    assert gaps.places(seconds) is None
  assert gaps.places(np.r_[t, t + 1000])[200] == 200 + gaps.MOST


# ---- a column that is silent ---------------------------------------------------------------------


def test_a_silent_column_is_named_and_left_out(tmp_path, nominal, mjx):  # noqa: F811
  x = leg(3000, 1001)
  x[1400:, 0] = np.nan
  code, out, err = mjx(save(tmp_path / "ends.csv", x, NAMES), "--nominal", nominal)
  assert code == 1 and out.startswith("no change in knee, current that")
  assert "mjx-cl: could not be judged: hip (no samples from 28.00 s on)" in err
  x[2000:, 1] += 0.1
  path = save(tmp_path / "wrong.csv", x, NAMES)
  found = detect.detect(path, nominal).summary
  assert found["verdict"]["changed"] and abs(found["verdict"]["begin"] - 2000) < 10
  assert [column["column"] for column in found["verdict"]["columns"]] == ["knee"]
  assert mjx(path, "--nominal", nominal, "--fail-on-change")[0] == 3
  x = leg(3000, 1002)
  x[1400:1600, 0] = np.nan
  code, out, err = mjx(save(tmp_path / "while.csv", x, NAMES), "--nominal", nominal)
  assert code == 0 and out.startswith("no change in hip, knee, current")
  assert mjx(tmp_path / "while.csv", "--nominal", nominal, "--fail-on-change")[0] == 0
  assert "hip has no samples from 28.00 s to 32.00 s; there the other columns" in err


def test_a_sensor_that_dies_late_is_no_unchanged_one(tmp_path, nominal, mjx):  # noqa: F811
  """Judged for the most part, so it is no failure to judge, but a script is told."""
  x = leg(3000, 1001)
  x[2400:, 0] = np.nan
  path = save(tmp_path / "dies.csv", x, NAMES)
  code, out, err = mjx(path, "--nominal", nominal)
  assert code == 0 and out.startswith("no change in knee, current that")
  assert "\nhip: no samples from 48.00 s on\n" in out
  code, _, err = mjx(path, "--nominal", nominal, "--fail-on-change")
  assert code == 3 and "ends without samples of hip" in err


def test_what_is_not_judged_is_not_called_unchanged(tmp_path, nominal, mjx):  # noqa: F811
  x = leg(2000, 1001)
  x[np.arange(2000) % 5 != 0, 0] = np.nan
  code, out, err = mjx(save(tmp_path / "rare.csv", x, NAMES), "--nominal", nominal)
  assert code == 1 and out.startswith("no change in knee, current that")
  assert "could not be judged: hip (most of the samples are missing)" in err
  x[np.arange(2000) % 5 != 1] = np.nan
  x[np.arange(2000) % 10 != 1, 1:] = np.nan
  x[:, 0] = np.where(np.arange(2000) % 10 == 6, 0.1, np.nan)
  code, out, err = mjx(save(tmp_path / "all.csv", x, NAMES), "--nominal", nominal)
  assert code == 1 and "no change" not in out
  assert "could not be judged: hip, knee, current (" in err
  x = leg(2000, 1001)
  x[:, 0] = np.nan
  code, out, err = mjx(save(tmp_path / "none.csv", x, NAMES), "--nominal", nominal)
  assert code == 1 and "could not be judged: hip (no samples)" in err


# ---- what is said --------------------------------------------------------------------------------


def test_no_factor_of_one_is_named(tmp_path, nominal):
  """One column that nothing but its past foretells: its mean moved."""
  x = leg(2000, 1001, 1000)[:, :1]
  said = detect.detect(save(tmp_path / "hip.csv", x, ["hip"]), nominal).summary["verdict"]
  (column,) = said["columns"]
  assert column["how"] == "mean" and column["by"] == pytest.approx(0.1, abs=0.03)
  x = leg(4000, 1001)[::2]
  said = detect.detect(save(tmp_path / "fast.csv", x, NAMES), nominal).summary["verdict"]
  assert said["changed"]
  assert not [c for c in said["columns"] if c["how"] == "spread" and 0.84 < c["by"] < 1.19]


def test_a_change_can_be_a_failure(tmp_path, nominal, mjx):  # noqa: F811
  fine = save(tmp_path / "fine.csv", leg(2000, 1001), NAMES)
  wrong = save(tmp_path / "wrong.csv", leg(2000, 1001, 1000), NAMES)
  assert mjx(fine, "--nominal", nominal, "--fail-on-change")[0] == 0
  assert mjx(wrong, "--nominal", nominal)[0] == 0
  code, out, err = mjx(wrong, "--nominal", nominal, "--fail-on-change", "--json")
  assert code == 3 and json.loads(out)["verdict"]["changed"]
  assert err.endswith("mjx-cl: the log has changed\n")
  code, out, err = mjx(wrong, "--nominal", nominal, "--fail-on-change", "--detector", "cusum")
  assert code == 2 and err.count("\n") == 1 and "leave out --detector" in err


def test_a_wide_log_with_missing_cells_is_judged():
  """A prediction there rests on 168 samples, one of which is nearly always missing."""
  wide = lambda rows, seed: np.concatenate([gait(rows, 7 * seed + k) for k in range(4)], 1)
  own = verdict.calibrated(wide(6000, 3), 10_000)
  x = wide(2000, 1001)
  cells(0.01)(x, np.random.default_rng(0))
  found = verdict.watch(own, x)
  assert found.known.mean() > 0.98
  events = verdict.judge(own, found, [f"c{k}" for k in range(28)], 500)
  assert not [event for event in events if event["believed"]]


def test_faults_are_put_into_a_nominal_log_with_missing_cells():
  """At as many places as into a whole one, or nearly."""
  past = leg(6000, 0)
  cells(0.02)(past, np.random.default_rng(0))
  own = verdict.calibrated(past, 10_000)
  whole = healthy.completed(own.model, past)
  there = np.isfinite(past)
  np.testing.assert_array_equal(whole[there], past[there])
  hip = (there[:, 1:].all(1) & ~there[:, 0])[20:]
  assert np.abs(whole - leg(6000, 0))[20:][hip, 0].max() < 0.06  # of 0.8, with noise of 0.01
  assert inject._places(len(past), 100)
  _, places = inject.smallest(own, whole, NAMES, 100)
  assert places >= 8
