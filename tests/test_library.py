"""The library's face: lazy, complete, and each name does what the command line does."""

import subprocess
import sys

import jax
import pytest

import mjx_cl
from mjx_cl.errors import UserError


def test_import_brings_no_jax():
  code = "import sys, mjx_cl; dir(mjx_cl); print(*{'jax', 'mujoco', 'flax'} & set(sys.modules))"
  done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
  assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr


def test_every_name_is_there_and_another_names_them():
  for name in mjx_cl.__all__:
    assert callable(getattr(mjx_cl, name)) and name in dir(mjx_cl)
  with pytest.raises(AttributeError, match="it has: load_agent, make_detector, make_env"):
    mjx_cl.make_robot  # noqa: B018


def test_robot_fault_detector_and_agent_by_name():
  env = mjx_cl.make_env("walker")
  fault = mjx_cl.make_fault("gear", env)
  assert "right_hip" in fault.targets and env.spec.name == "walker"
  assert mjx_cl.make_fault("gear", "walker").targets == fault.targets
  with pytest.raises(UserError, match=r"load_agent\(robot, 'walker-2'\)"):
    mjx_cl.load_agent("walker-2")
  trained = mjx_cl.load_agent("walker")
  assert jax.tree.leaves(trained.train.params) and trained.card["env"] == "walker"
  assert mjx_cl.make_detector("cusum").init()


def test_run_refuses_as_the_command_line_does(tmp_path):
  with pytest.raises(UserError, match="unknown setting 'seed'; choose from: .*seeds"):
    mjx_cl.run("walker", tmp_path / "out", seed=3)
  with pytest.raises(UserError, match="unknown setting 'ration'; choose from: .*ratio"):
    mjx_cl.run("walker", tmp_path / "out", adapt={"ration": 3})
  with pytest.raises(UserError, match="unknown fault 'gears'"):
    mjx_cl.run("walker", tmp_path / "out", fault="gears")
  for wrong, said in (
    ({"severity": "half"}, "severity takes float"),
    ({"seeds": "2"}, "seeds takes int"),
    ({"adapt": {"ratio": "4"}}, "adapt.ratio takes float"),
    ({"arms": "none"}, "arms takes a list of names"),
    ({"detector": mjx_cl.make_detector("cusum")}, "detector takes a name"),
    ({"agent": mjx_cl.load_agent("walker")}, "agent takes a name"),
    ({"settings": "threshold=5"}, "settings takes a dict"),
  ):
    with pytest.raises(UserError, match=said):
      mjx_cl.run("walker", tmp_path / "out", **wrong)
  assert not (tmp_path / "out").exists()


class Late:
  """Alarms once, at sample 1,000."""

  def __init__(self):
    self.count = 0

  def update(self, x):
    self.count += 1
    return self.count == 1000


def test_a_score_is_a_row_for_each_fault_and_severity():
  own = mjx_cl.score(Late, robots=("car",))  # the board's references are left out
  assert {row["detector"] for row in own} == {"Late"}
  assert {row["robot"] for row in own} == {"car"} and len(own) > 5
  assert len({(row["fault"], row["severity"]) for row in own}) == len(own)
  for robots in (("cart",), "cart"):
    with pytest.raises(UserError, match="no robot 'cart'; choose from: walker, car"):
      mjx_cl.score("cusum", robots=robots)
  chance = mjx_cl.score("random", robots="car")  # a reference that is asked for, and no other
  assert {row["detector"] for row in chance} == {"random"} and len(chance) == len(own)
  with pytest.raises(UserError, match="cusum@rpr"):
    mjx_cl.score("cusum", channel="rpr")
  with pytest.raises(UserError, match="unknown detector 'cusun'"):
    mjx_cl.score("cusun")
  with pytest.raises(UserError, match="a name or a class with update"):
    mjx_cl.score(3)
