"""Seeds trained on a Ray cluster: each is the training of that seed alone."""

import json

import pytest
from test_cli import mjx, refused  # noqa: F401  fixtures
from test_cluster import build, machines  # noqa: F401  fixtures

from mjx_cl.cli import trainings
from mjx_cl.errors import FileError
from mjx_cl.io import arrays

SET = ("updates=8", "envs=4", "capacity=256", "batch=4", "length=8", "imagine=4", "ratio=1")
HOW = ("train", "walker", "--preset", "tiny", "--physics", "native", "--set", *SET)


def test_a_seed_on_a_cluster_is_the_training_of_that_seed(mjx, refused, machines, tmp_path):  # noqa: F811
  where = ("--on", "ray", "--address", machines[0].address)
  spread = (*HOW, "--seed", "3", "--seeds", "2", "--out", tmp_path / "many", *where)
  code, out, err = mjx(*spread, "--json")
  assert code == 0, err
  cards = json.loads(out)
  assert list(cards) == ["seed-3", "seed-4"] and "trained, 2 of 2" in err
  assert [card["seed"] for card in cards.values()] == [3, 4]
  code, _, err = mjx(*HOW, "--seed", "4", "--out", tmp_path / "one")
  assert code == 0, err
  weights = lambda folder: arrays.read(tmp_path / folder / "agent/agent.npz")
  one, other, third = map(weights, ("one", "many/seed-4", "many/seed-3"))
  assert one.keys() == other.keys()
  assert all(one[name].tobytes() == other[name].tobytes() for name in one)
  assert any(one[name].tobytes() != third[name].tobytes() for name in one)
  assert {p.name for p in (tmp_path / "many/seed-4").iterdir()} == {
    "agent",
    "config.json",
    "metrics.parquet",
  }
  # the same command finds all finished; another's settings are refused
  assert mjx(*spread)[0] == 0
  at = spread.index(SET[-1]) + 1
  said = refused(2, *spread[:at], "lr=1e-4", *spread[at:])
  assert "begun with another lr" in said
  assert "beside trainings of seeds" in refused(2, *HOW, "--out", tmp_path, *where)
  assert "leave out --overwrite" in refused(2, *spread, "--overwrite")


def test_a_training_that_is_not_whole_is_refused(tmp_path):
  (tmp_path / "config.json").write_text("{}")
  with pytest.raises(FileError, match=r"card\.json"):
    trainings.whole(tmp_path)
