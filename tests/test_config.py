"""Settings as they are read: of the command line, and of earlier versions."""

import pytest

from mjx_cl.config import DreamerConfig, TrainConfig, recorded, settings


def test_a_setting_that_is_gone_is_dropped_where_it_meant_nothing():
  assert recorded(TrainConfig, {"envs": 8, "jitter": 0.0, "episode": None}) == {"envs": 8}
  assert recorded(DreamerConfig, {"batch": 4, "context": 1}) == {"batch": 4}


@pytest.mark.parametrize(
  "name, value", [("jitter", 0.1), ("ration", 4), ("episode", 500), ("context", 2)]
)
def test_a_setting_that_meant_something_is_named(name, value):
  with pytest.raises(ValueError, match=f"{name}={value} is no setting of this version"):
    recorded(TrainConfig, {"envs": 8, name: value})


def test_a_setting_that_is_nested_without_end_is_text():
  text = "[" * 100_000
  assert settings([f"a={text}"]) == {"a": text}
