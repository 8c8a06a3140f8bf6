"""Suites, sets, detectors and files of scores of one's own: small, odd and wrong ones."""

import dataclasses
import importlib.metadata
import json

import jax.numpy as jnp
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from test_cli import mjx, refused  # noqa: F401  fixtures
from test_leaderboard import CONTROL_S, SUITE, Above, make_set, pick, small, submission, trailing  # noqa: F401  a fixture among them

from mjx_cl import detectors
from mjx_cl.detectors import Alarm, Detector
from mjx_cl.detectors.python_class import HostDetector
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import tables
from mjx_cl.io.plugins import Registry
from mjx_cl.leaderboard import entries as entries_of
from mjx_cl.leaderboard import oracle as oracles
from mjx_cl.leaderboard import parts, record, set_tables, streams, submissions
from mjx_cl.leaderboard import score as leaderboard
from mjx_cl.scoring import thresholds

NEVER = [entries_of.entry("never", {})]


def one_line(error):
  return "\n" not in str(error.value)


# ---- suites --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
  "edit, text",
  [
    (
      {"robots": {"walker": {"score": {"gear:left": (0.5,), "gear:right": (0.5, 1.0)}}}},
      "gear 0.5 is there twice",
    ),
    ({"robots": {"walker": {"score": {"gear": (0.5, 0.5)}}}}, "gear 0.5 is there twice"),
    ({"nominal": {"steps": 1024, "score": 0, "tune": 4}}, "one or more streams per seed"),
    ({"seeds": {"score": (-2, 3), "tune": (100, 103)}}, "the seeds that score"),
  ],
)
def test_suites_that_cannot_be_scored_are_refused(edit, text):
  with pytest.raises(UserError, match=text) as e:
    dataclasses.replace(SUITE, **edit)
  assert one_line(e)


def test_one_seed_and_nothing_to_tune_on(tmp_path):
  suite = dataclasses.replace(
    SUITE,
    horizon_s=30.0,
    seeds={"score": (0, 0), "tune": (100, 100)},
    robots={"walker": {"score": {"gear": (1.0,)}}},
  )
  make_set(tmp_path / "set", suite)
  board = leaderboard.score(
    streams.StreamSet(tmp_path / "set"), [entries_of.entry("cusum", {"warmup": 150})]
  )
  (row,) = pick(board, detector="cusum")
  assert (
    row["information_nats_per_step"] is None
    and row["optimal_delay_steps"] is None
    and row["cost_standard_ci"] is None
  )
  assert (
    row["streams"] == 1 and row["healthy_steps"] == 2 * 824 and row["latency_median_steps"] < 20
  )
  (oracle,) = pick(board, detector="likelihood_ratio (oracle)")
  assert (
    "two or more seeds" in oracle["note"]
    and row["efficiency"] == oracle["delay_steps"] / row["delay_steps"]
  )
  assert len(leaderboard.write(board, tmp_path / "board", {})) == 4


def test_too_little_for_an_oracle(tmp_path):
  """Eight steps after the onset cannot fit autoregressions of order 8: no oracle, no efficiency,
  and the reason in the row that is left.
  """
  make_set(tmp_path / "set", dataclasses.replace(SUITE, horizon_s=4.0))
  board = leaderboard.score(streams.StreamSet(tmp_path / "set"), NEVER)
  assert {r["detector"] for r in board.rows} == {"never", "true onset (oracle)"}
  for r in board.rows:
    assert (
      r["efficiency"] is None
      and r["efficiency_ci"] is None
      and r["oracle_delay_steps"] is None
      and r["information_nats_per_step"] is None
    )
    assert r["delay_steps"] == (8 if r["detector"] == "never" else 1)
    assert (
      ("more than 8 steps" in r["note"])
      if r["detector"] == "true onset (oracle)"
      else r["note"] is None
    )
  leaderboard.write(board, tmp_path / "board", {})


class Late:
  """Fires once, `wait` samples after a value of 100."""

  def __init__(self, wait):
    self.left, self.wait = None, wait

  def update(self, x):
    self.left = (
      self.wait if x == 100 and self.left is None else None if self.left is None else self.left - 1
    )
    return self.left == 0


def test_the_horizon_is_that_of_the_suite(tmp_path, monkeypatch):
  """An alarm 8 s after the onset counts in a suite of 20 s and is a miss in one of 6 s, which knows
  no share found within 20 s.
  """
  for horizon_s in (20.0, 6.0):
    folder = tmp_path / str(horizon_s)
    make_set(folder, dataclasses.replace(SUITE, horizon_s=horizon_s))
    held = streams.StreamSet(folder)

    def get(data):
      for s, onset in enumerate(data.fault.onset):
        data.fault.residual.opr[onset, s] = 100.0
      return submissions.from_host(HostDetector(lambda: Late(16), "late"))(data)

    row = pick(leaderboard.score(held, [], extra=[("late", get)]), detector="late", fault="bias")[0]
    found = horizon_s == 20.0
    assert (
      row["miss_probability"] == 1 - found
      and row["detected_within_5s"] == 0
      and row["delay_steps"] == (17 if found else 12)
    )
    assert (row["detected_within_20s"], row["detected_within_20s_ci"] is None) == (
      (1.0, False) if found else (None, True)
    )


def test_unknown_faults_are_refused_before_anything_is_recorded(tmp_path):
  suite = dataclasses.replace(
    SUITE, robots={"walker": {"score": {"gear": (0.5,)}, "tune": {"nonsense": (1.0,)}}}
  )
  with pytest.raises(UserError, match="unknown fault 'nonsense'"):
    record.record(suite, tmp_path / "x", physics="native")
  assert not list((tmp_path / "x").rglob("*.npz"))


# ---- sets ----------------------------------------------------------------------------------------


def test_a_column_that_hardly_varies_is_kept_as_it_is():
  constant, unknown = np.full((50, 2), 3.25, np.float32), np.full((50, 2), np.nan, np.float32)
  columns = {c: constant for c in streams.COLUMNS} | {
    "latent": np.zeros((50, 2, 16), np.float16),
    "rpr": unknown,
  }
  grain = set_tables.grains(columns)
  np.testing.assert_array_equal(
    set_tables.rounded(constant[:, 0], "group_3", grain), constant[:, 0]
  )
  np.testing.assert_array_equal(set_tables.rounded(unknown[:, 0], "rpr", grain), unknown[:, 0])
  np.testing.assert_array_equal(
    set_tables.rounded(np.zeros(3, np.float32), "group_3", grain),
    np.full(3, set_tables.FLOOR, np.float32),
  )


def test_parts_of_another_agent_or_onset_are_recorded_again(tmp_path):
  data = {"opr": np.ones((3, 1), np.float32)}
  np.savez(tmp_path / "a.npz", tag=np.asarray("lanes"), of=np.asarray("agent 1"), **data)
  np.savez(tmp_path / "old.npz", tag=np.asarray("lanes"), **data)
  part = lambda tag, of: parts.Part([], None, None, 0, 0, tag, of)
  assert set(parts.kept(tmp_path / "a.npz", part("lanes", "agent 1"))) == {"opr"}
  assert (
    parts.kept(tmp_path / "a.npz", part("lanes", "agent 2")) is None
    and parts.kept(tmp_path / "a.npz", part("others", "agent 1")) is None
  )
  assert set(parts.kept(tmp_path / "old.npz", part("lanes", "agent 2"))) == {
    "opr"
  }  # parts from before this mark
  params = {"w": jnp.arange(4.0)}
  assert (
    parts.digest(params)
    == parts.digest({"w": jnp.arange(4.0)})
    != parts.digest({"w": jnp.arange(4.0).at[2].set(0)})
  )


def test_overwrite_removes_a_set_and_nothing_else(tmp_path):
  refuse = pytest.raises(UserError, match="is no folder of a recording")
  own = tmp_path / "project"  # a folder with a config.json of something else
  own.mkdir()
  (own / "config.json").write_text('{"version": 1, "name": "mine"}')
  for overwrite in (False, True):
    with refuse:
      record.claim(SUITE, own, overwrite)
  assert (own / "config.json").exists()
  for name in (
    "data.parquet",
    "work/thesis.tex",
  ):  # nor are other tables, or another folder `work`, taken for parts
    folder = tmp_path / name.replace("/", "_")
    (folder / name).parent.mkdir(parents=True)
    (folder / name).write_text("x")
    with refuse:
      record.claim(SUITE, folder, True)
    record.clear(folder)
    assert (folder / name).read_text() == "x"
  held = tmp_path / "set"
  make_set(held)
  tables.write_json(
    held / "config.json",
    json.loads((held / "config.json").read_text()) | {"schema": {}, "meta": {}, "stream_steps": {}},
  )
  (held / "notes.txt").write_text("x")
  with pytest.raises(UserError, match="holds a recorded set"):
    record.claim(SUITE, held, False)
  assert (held / "walker.parquet").exists()
  record.claim(SUITE, held, True)
  assert [p.name for p in held.iterdir()] == ["notes.txt"]


def test_a_broken_set_gets_one_line(tmp_path):
  make_set(tmp_path)
  config = json.loads((tmp_path / "config.json").read_text())
  for value, text in (
    ([], "no readable config.json"),
    ({"a": 1}, "of something else"),
    ({"version": streams.VERSION}, "names no suite"),
    (config | {"suite": {"name": "x"}}, "names no suite"),
  ):
    (tmp_path / "config.json").write_text(json.dumps(value))
    with pytest.raises(FileError, match=text) as e:
      streams.StreamSet(tmp_path)
    assert one_line(e)
  (tmp_path / "config.json").write_text(json.dumps(config))
  meta = tables.read_table(tmp_path / "streams.parquet")
  swapped = meta["seed"].copy()
  swapped[np.flatnonzero((meta["kind"] == "fault") & (meta["split"] == "score"))[:2]] = [1, 0]
  tables.write_table(tmp_path / "streams.parquet", meta | {"seed": swapped})
  with pytest.raises(FileError, match="walker, gear 0.5: its streams must be those of the seeds"):
    streams.load(streams.StreamSet(tmp_path), "walker")
  tables.write_table(tmp_path / "streams.parquet", meta)
  rows = tables.read_arrow(tmp_path / "walker.parquet")
  for name, values in (
    ("group_0", ["a"] * len(rows)),
    ("step", [-1] * len(rows)),
    ("step", [None] * len(rows)),
    ("terminated", [0.5] * len(rows)),
  ):
    at = rows.column_names.index(name)
    tables.write_arrow(tmp_path / "walker.parquet", rows.set_column(at, name, [values]))
    with pytest.raises(FileError, match=f"walker.parquet.*{name}"):
      streams.load(streams.StreamSet(tmp_path), "walker")
  for name, values in (("full", [[1, 2]]), ("steps", [2**62]), ("robot", [7]), ("stream", [None])):
    changed = meta | {name: values * len(meta["stream"])}
    tables.write_table(tmp_path / "streams.parquet", changed)
    with pytest.raises(FileError, match=f"streams.parquet.*{name}"):
      streams.StreamSet(tmp_path)
  tables.write_table(tmp_path / "streams.parquet", {k: v[:0] for k, v in meta.items()})
  with pytest.raises(FileError, match="no rows|not of this schema"):
    streams.StreamSet(tmp_path)
  tables.write_table(tmp_path / "streams.parquet", meta)
  tables.write_table(tmp_path / "walker.parquet", {"stream": np.arange(3)})
  with pytest.raises(FileError, match="is not of this schema"):
    streams.load(streams.StreamSet(tmp_path), "walker")


# ---- thresholds ----------------------------------------------------------------------------------


def test_a_threshold_below_one_with_too_many_alarms_is_none():
  """A score that stays above a low threshold crosses it seldom; that is no low rate of false
  alarms.
  """
  count = lambda t: np.where(t < 1.0, 0, np.where(t < 5.0, 1000, 3))
  assert thresholds.narrow(count, np.linspace(0.0, 10.0, 1001), 10)[0] == pytest.approx(
    5.0, rel=1e-4
  )


@pytest.mark.parametrize("name", ["slow", "clipped", "constant"])
def test_no_threshold_lies_where_nothing_is_counted(name):
  """A score that crosses no level as often as is allowed: the threshold with the most crossings,
  not one below all scores, above which even a sound score stays from its first step on.
  """
  steps = np.arange(6000)
  score = {
    "slow": np.sin(steps * 2 * np.pi / 1000) - steps / 6000,
    "clipped": np.where(steps % 1000 == 999, 1.0, 0.0),
    "constant": np.full(6000, 5.0),
  }[name]
  count = lambda levels: np.array(
    [submissions.crossings(score[:, None], t)[500:].sum() for t in levels]
  )
  threshold, tried = thresholds.narrow(count, score, 20)
  alarms = dict(tried)[threshold]
  assert alarms == max(dict(tried).values()) and (alarms == 0) == (name == "constant")
  rise = np.concatenate([score, score.min() + np.zeros(10), score.max() + np.ones(10)])
  assert submissions.crossings(rise[:, None], threshold)[6000:].any()


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_the_unit_of_a_score_is_its_own_affair(scale):
  score = scale * np.random.default_rng(0).exponential(size=100_000)
  threshold, tried = thresholds.narrow(lambda t: (score[:, None] > t).sum(0), score, 20)
  assert (score > threshold).sum() == dict(tried)[threshold] == 20


def test_evidence_far_above_its_threshold():
  """A CUSUM's scores reach zero, and grow without end where it never restarts."""
  assert thresholds.narrow(lambda t: np.where(t < 5.0, 1000, 3), np.linspace(0.0, 1e8, 1001), 10)[
    0
  ] == pytest.approx(5.0, rel=0.02)


def test_an_oracle_of_heavy_tails_keeps_the_asked_rate():
  """A healthy step that carries 500 nats now and then: a threshold of 40 would be passed each time."""
  ratio = np.full((1000, 4), -1.0)
  ratio[::50] = 500.0
  ratio[25::50, :2] = 5.0
  levels = oracles._thresholds(ratio, 2, 0, 10)
  fired = oracles.restarted(ratio, np.repeat(levels, 2))[0]
  assert (fired.reshape(1000, 2, 2).sum((0, 2)) <= 10).all() and (levels > 400).all()


def test_what_a_detector_cannot_see_is_no_healthy_operation(small):  # noqa: F811
  """knn looks at latents, which are kept for 6 of 16 healthy streams that tune and of 8 that score."""
  board = leaderboard.score(
    small[0], [entries_of.entry("knn", {"warmup": 150, "references": 50, "smooth": 10})]
  )
  row = pick(board, detector="knn", fault="bias")[0]
  assert 1 <= row["arl0_alarms"] <= 6 * 824 / 400 and row["arl0"] == 6 * 824 / row["arl0_alarms"]
  assert row["healthy_steps"] == 6 * 824 // 4 and row["auroc"] is not None
  hours = row["healthy_steps"] * CONTROL_S / 3600
  assert row["false_alarms_per_hour"] == pytest.approx(
    sum(row["stream_healthy_alarms"]) / 4 / hours
  )


def test_streams_of_a_seed_are_put_together():
  x, seeds = np.arange(30).reshape(5, 6), np.array([0, 0, 1, 1, 2, 2])
  np.testing.assert_array_equal(
    thresholds.by_seed(x, seeds, 2)[:, 1], [2, 8, 14, 20, 26, 15, 21, 27]
  )  # its warm-up once
  seen = np.array([True, False, True, False, False, False])
  np.testing.assert_array_equal(
    thresholds.by_seed(x, seeds, 2, seen)[2:], [[12, 24, 20], [18, 14, 26]]
  )  # 6 steps of streams 0 and 2, 2 for each seed
  assert (
    thresholds.seeing(np.full((5, 2), np.nan), 2).sum() != 0
  )  # a detector without scores sees all


# ---- detectors of one's own ----------------------------------------------------------------------


def bare(build):
  return entries_of.Entry("mine", build, True, False)


def step(decide):
  return lambda threshold: Detector(
    lambda: jnp.float32(0), lambda state, r: decide(state, r, threshold)
  )


@pytest.mark.parametrize(
  "decide, text",
  [
    (
      lambda s, r, t: (s, Alarm(r.opr > t if t > 0 else r.opr > 1, r.opr)),
      "'mine' cannot be calibrated: its threshold is traced",
    ),
    (lambda s, r, t: (s, Alarm(r.nothing > t, r.opr)), "'mine' failed: AttributeError: .*nothing"),
    (lambda s, r, t: (jnp.zeros(3), Alarm(r.opr > t, r.opr)), "'mine' failed: TypeError"),
  ],
)
def test_a_broken_plug_in_gets_one_line(small, decide, text):  # noqa: F811
  with pytest.raises(UserError, match=text) as e:
    leaderboard.score(small[0], [bare(step(decide))])
  assert one_line(e)


def test_a_plug_in_is_scored(small, monkeypatch):  # noqa: F811
  def mine(threshold: float = 1.0):
    """OPR above a level."""
    return Detector(
      lambda: (),
      lambda state, r: (
        state,
        Alarm(r.valid & (r.opr > threshold), jnp.where(r.valid, r.opr, jnp.nan)),
      ),
    )

  monkeypatch.setitem(detectors.DETECTORS, "mine", mine)
  assert entries_of.variants()["mine"] == {"use": "mine"}
  row = pick(
    leaderboard.score(small[0], [entries_of.entry("mine", {})]), detector="mine", fault="bias"
  )[0]
  host = submissions.from_host(lambda v: HostDetector(lambda: Above(v), "above"), "threshold")
  other = pick(
    leaderboard.score(small[0], [], extra=[("above", host)]), detector="above", fault="bias"
  )[0]
  for k in (
    "arl0_alarms",
    "stream_latency_steps",
    "stream_healthy_alarms",
    "auroc",
    "cost_standard",
  ):
    assert row[k] == other[k], k  # the same detector by two ways in


@pytest.mark.parametrize(
  "load, text",
  [
    (lambda: 1 / 0, "cannot be loaded: ZeroDivisionError"),
    (lambda: 3, "is nothing that can be called"),
  ],
)
def test_plug_ins_that_cannot_be_loaded_get_one_line(monkeypatch, load, text):
  entry = type(
    "Entry", (), {"name": "theirs", "value": "theirs:detector", "load": staticmethod(load)}
  )
  monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [entry])
  with pytest.raises(UserError, match=f"detector 'theirs' of theirs:detector {text}") as e:
    Registry("mjx_cl.detectors", "detector", {"cusum": detectors.cusum})["cusum"]
  assert one_line(e)


def test_a_class_that_looks_ahead_or_shares_state_is_refused(small):  # noqa: F811
  class Shared(Above):
    seen = 0

    def update(self, x):
      Shared.seen += 1
      return x > 1 + Shared.seen % 7 / 10

  for how in (
    (lambda v: HostDetector(lambda: Shared(v), "shared"), "threshold"),
    (HostDetector(Shared, "shared"), None),
  ):
    with pytest.raises(UserError, match="Shared is not causal"):
      leaderboard.score(small[0], [], extra=[("shared", submissions.from_host(*how))])


def test_the_threshold_of_a_class_is_found_at_any_scale():
  score = np.random.default_rng(0).exponential(size=10_000)
  for scale in (1e-6, 1.0, 1e6):
    calls = []
    value = submissions._least(
      lambda v: calls.append(v) or int((scale * score > v).sum()), 20, "--threshold x"
    )
    assert (scale * score > value).sum() == 20 and len(calls) < 25
  stairs = lambda v: 22 if v < 3.7 else 17  # no value gives twenty
  assert submissions._least(stairs, 20, "--threshold x") == pytest.approx(3.7, rel=1e-5)
  with pytest.raises(UserError, match="--threshold x: .*larger values must mean fewer alarms"):
    submissions._least(lambda v: 1000, 20, "--threshold x")
  with pytest.raises(
    UserError, match="--threshold x: even at .* nothing is calibrated"
  ):  # a score that is always below 0
    submissions._least(lambda v: 0, 20, "--threshold x")


# ---- files of scores -----------------------------------------------------------------------------


@pytest.mark.parametrize(
  "score, precision",
  [
    (lambda y: 1000 + y, 1e-7),
    (lambda y: 1e-7 * y, 1e-7),
    (lambda y: np.exp(9 * y), 1e-7),
    (lambda y: 1 - 1e-6 / (1 + np.exp(-y)), 1e-16),
  ],
)
def test_a_look_ahead_shows_in_any_unit(small, tmp_path, score, precision):  # noqa: F811
  held = small[0]
  ahead = lambda x: score(
    np.convolve(np.nan_to_num(np.log(x)), np.ones(3) / 3, "same")
  )  # one sample of the future
  tables.write_table(tmp_path / "s.parquet", submission(held, ahead))
  with pytest.raises(FileError, match="looks ahead"):
    submissions.read_submission(tmp_path / "s.parquet", held)
  rng = np.random.default_rng(0)  # a sum in another order is none
  tables.write_table(
    tmp_path / "s.parquet",
    submission(held, lambda x: score(trailing(x)) * (1 + precision * rng.standard_normal(len(x)))),
  )
  assert len(submissions.read_submission(tmp_path / "s.parquet", held)) == len(held.scored())


def spoiled(held, path, column, edit):
  table = submission(held, trailing)
  pyarrow.parquet.write_table(pyarrow.table(table | {column: edit(list(table[column]))}), path)
  return path


@pytest.mark.parametrize(
  "column, edit, text",
  [
    ("score", lambda x: x[:40] + [float("nan")] + x[41:], "a score is nan in stream 0, step 40"),
    ("score", lambda x: ["high"] * len(x), "column 'score' must hold numbers"),
    ("stream", lambda x: [None] + x[1:], "row 0 names no stream or no step"),
    ("step", lambda x: [0.0] + [float("nan")] + x[2:], "row 1 names no stream or no step"),
    (
      "stream",
      lambda x: x[:7] + [605.5] + x[8:],
      "row 7, stream 605.5, step 7, is none of the set",
    ),
    (
      "step",
      lambda x: x[:7] + [7.5] + x[8:],
      "row 7, stream 0, step 7.5, is none with a whole step",
    ),
  ],
)
def test_odd_columns_get_one_line(small, tmp_path, column, edit, text):  # noqa: F811
  with pytest.raises(FileError, match=text) as e:
    submissions.read_submission(spoiled(small[0], tmp_path / "s.parquet", column, edit), small[0])
  assert one_line(e)


def test_null_is_an_unknown_score_unless_nothing_sets_the_threshold(small, tmp_path):  # noqa: F811
  held = small[0]
  read = submissions.read_submission(
    spoiled(held, tmp_path / "s.parquet", "score", lambda x: x[:300] + [None] + x[301:]), held
  )
  assert np.isnan(read[0][300]) and np.isfinite(read[0][301])
  table = submission(held, trailing)
  table["score"][np.isin(table["stream"], held.find("walker", "nominal", "tune"))] = np.nan
  tables.write_table(tmp_path / "s.parquet", table)
  with pytest.raises(
    FileError, match="no score is known on the healthy streams of walker that set the threshold"
  ):
    submissions.read_submission(tmp_path / "s.parquet", held)


def test_one_robot_of_several(tmp_path):
  make_set(
    tmp_path / "set",
    dataclasses.replace(SUITE, robots={r: SUITE.robots["walker"] for r in ("walker", "car")}),
    ("walker", "car"),
  )
  held = streams.StreamSet(tmp_path / "set")
  assert [submissions.export(held, tmp_path / "out", r, True) for r in ((), ("car",))] == [
    [str(tmp_path / "out" / f"{r}.parquet") for r in rs] for rs in (("walker", "car"), ("car",))
  ]
  own = np.isin(list(held.scored()), list(held.scored(("car",))))
  assert 0 < own.sum() < len(own)
  table = {"stream": [], "step": [], "score": []}
  for n, steps in held.scored(("car",)).items():
    table["stream"].append(np.full(steps, n))
    table["step"].append(np.arange(steps))
    table["score"].append(trailing(held.get("car", [n]).residual.opr[:, 0]))
  tables.write_table(tmp_path / "s.parquet", {k: np.concatenate(v) for k, v in table.items()})
  with pytest.raises(FileError, match="streams are missing"):
    submissions.read_submission(tmp_path / "s.parquet", held)
  scores = submissions.read_submission(tmp_path / "s.parquet", held, ("car",))
  board = leaderboard.score(
    held, NEVER, ("car", "car"), [("mine", submissions.from_scores(scores))]
  )
  assert {r["robot"] for r in board.rows} == {"car"} and len(pick(board, detector="mine")) == 3
  with pytest.raises(UserError, match="has no robot 'cat'; choose from: walker, car"):
    leaderboard.score(held, NEVER, ("cat",))


# ---- the command ---------------------------------------------------------------------------------


def test_settings_without_a_detector_are_refused(refused, small, tmp_path):  # noqa: F811
  folder = small[2]
  assert "--threshold belongs to a detector of one's own; give --add" in refused(
    2, "leaderboard", folder, "--threshold", "x"
  )
  assert "--channel belongs to a detector of one's own; give --add" in refused(
    2, "leaderboard", folder, "--channel", "nope"
  )
  said = refused(2, "leaderboard", "--add", "x.py:X", "--channel", "variable_0")
  assert "unknown channel 'variable_0'; choose from: group_0, group_1" in said
  assert "--log belongs to a detector of one's own; give --add" in refused(
    2, "leaderboard", folder, "--log"
  )
  assert "--set belongs to" in refused(2, "leaderboard", folder, "--set", "a=1")
  assert "give --add or --submit" in refused(2, "leaderboard", folder, "--name", "x")
  assert "--name names one detector" in refused(
    2, "leaderboard", folder, "--name", "x", "--add", "a:B", "--submit", "c.parquet"
  )
  tables.write_table(tmp_path / "PageHinkley.parquet", submission(small[0], trailing))
  both = (
    "--add",
    "river.drift:PageHinkley",
    "--submit",
    tmp_path / "PageHinkley.parquet",
    "--out",
    tmp_path / "board",
  )
  assert "the board has a detector 'PageHinkley' already" in refused(
    2, "leaderboard", folder, "--detector", "never", *both
  )
  assert not (tmp_path / "board").exists()
