"""Recordings and boards on a Ray cluster: what they are without one."""

import re

import numpy as np
import pytest
from test_cli import mjx, refused  # noqa: F401  fixtures
from test_cluster import build, machines  # noqa: F401  fixtures
from test_leaderboard import late, small  # noqa: F401  fixtures
from test_record import recorded  # noqa: F401  a fixture
from test_run import saved  # noqa: F401  a fixture

from mjx_cl.errors import FileError
from mjx_cl.io import tables
from mjx_cl.leaderboard import calibration, entries, parts, program, score, spread, streams
from mjx_cl.runs import cluster


def test_a_recording_is_the_same_wherever_its_parts_are(
  mjx,  # noqa: F811
  recorded,  # noqa: F811
  saved,  # noqa: F811
  machines,  # noqa: F811
  tmp_path,
  monkeypatch,
):
  """Its machines see no disk of each other here: parts come back as bytes."""
  monkeypatch.setattr(cluster, "HERE", ".elsewhere")
  where = ("--on", "ray", "--address", machines[0].address)
  how = ("--out", tmp_path / "set", "--agent", saved, "--physics", "native")
  code, _, err = mjx("record", recorded[1], *how, *where)
  assert code == 0, err
  assert "recorded, 4 of 4" in err
  # lines of parts are sampled: the last part's may be missed, that of the first to end is not
  assert re.search(r"lived: \d+/\d+ steps of [268] robots", err), err
  for name in ("walker.parquet", "walker_latents.parquet", "streams.parquet"):
    assert (tmp_path / "set" / name).read_bytes() == (recorded[0] / name).read_bytes()
  assert not (tmp_path / "set" / "work").exists()


def test_a_board_is_the_same_wherever_its_detectors_are(mjx, late, machines, tmp_path):  # noqa: F811
  which = ("--detector", "cusum", "always", "rolling_sigma")
  where = ("--on", "ray", "--address", machines[0].address)
  for name, more in (("here", ()), ("there", where)):
    code, _, err = mjx("leaderboard", late, "--out", tmp_path / name, *which, *more)
    assert code == 0, err
  assert "examined, 3 of 3" in err
  assert {p.name for p in (tmp_path / "here").iterdir()} == {
    p.name for p in (tmp_path / "there").iterdir()
  }
  one, two = (
    tables.read_arrow(tmp_path / name / "leaderboard.parquet").drop_columns("us_per_sample")
    for name in ("here", "there")
  )
  assert one.equals(two) and one.num_rows == 2 * 3 * 5
  one, two = (tables.read_json(tmp_path / name / "leaderboard.json") for name in ("here", "there"))
  changing = ("command", "wall_s")
  assert {k: v for k, v in one.items() if k not in changing} == {
    k: v for k, v in two.items() if k not in changing
  }


def test_what_a_detector_did_is_kept_to_the_bit(small, tmp_path):  # noqa: F811
  held = small[0]
  fits, data = program.room(held, ["walker"]), streams.load(held, "walker")
  (one,) = entries.chosen(("ewma",), "walker")
  runners = {"ewma": spread.sweep.Runner(one.build, fits)}
  found = score.examine(one, runners, fits, score.samples_of(data, fits), data)
  spread.write_found(tmp_path / "a.npz", found)
  again = spread.read_found(tmp_path / "a.npz")
  for name, value in found._asdict().items():
    if isinstance(value, np.ndarray):
      np.testing.assert_array_equal(value, getattr(again, name), strict=True)
  rows, others = (score.rows_of("ewma", False, f, data, {}) for f in (found, again))
  assert rows == others and again.threshold == found.threshold and again.curve == found.curve
  np.savez(tmp_path / "b.npz", told=np.asarray("{}"))
  with pytest.raises(FileError, match="no part of a board"):
    spread.read_found(tmp_path / "b.npz")


def test_a_part_of_another_agent_is_refused(tmp_path, monkeypatch):
  """A machine whose agent of that name is another's."""
  own = parts.Part([], None, np.zeros(0, int), 4, 0, "lanes", "agent 1")

  def elsewhere(module, out, names, needs, finished, *_):
    (out / names[0]).mkdir()
    other = {"tag": np.asarray("lanes"), "of": np.asarray("agent 2"), "opr": np.zeros(1)}
    np.savez(out / names[0] / spread.LIVED, **other)
    finished(names[0])

  monkeypatch.setattr(spread.parts_of, "part", lambda *_: own)
  monkeypatch.setattr(spread.room, "grown", lambda *_: 1)
  monkeypatch.setattr(spread.cluster, "together", elsewhere)
  suite = streams.suite("leaderboard")
  ready = {"walker": (type("Env", (), {"spec": None}), FakeTrained)}
  with pytest.raises(FileError, match="walker-score-nominal was recorded with another agent"):
    spread.record(suite, tmp_path, ready, "native", None, "", cluster.Cluster(), print)


class FakeTrained:
  """What `spread.record` asks of an agent."""

  class agent:  # noqa: N801
    config = None


def test_where_parts_run_is_checked_at_first(refused, tmp_path):  # noqa: F811
  for command in ("record", "leaderboard", "bench"):
    said = refused(2, command, "--out", tmp_path / "x", "--address", "h:1")
    assert "--address is of a cluster; give --on ray" in said
  assert "--gpu is of a cluster" in refused(2, "bench", "--out", tmp_path / "x", "--gpu")
  assert not (tmp_path / "x").exists()
  assert calibration.Found._fields  # of which spread.ARRAYS are some
  assert set(spread.ARRAYS) < set(calibration.Found._fields)
