"""Robots out of a MuJoCo model: a loop of C MuJoCo as oracle, faults by hand, bad input."""

import os
import pathlib
import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_cl import envs, faults
from mjx_cl.envs.mjcf import Robot
from mjx_cl.errors import PluginError, UserError

DOCS = (pathlib.Path(__file__).parents[2] / "docs/extending.md").read_text()
HOPPER = re.search(r"```python\n(# hopper\.py.*?)```", DOCS, re.S)[1]

ARM = """<mujoco><option timestep="0.01"/><worldbody><geom type="plane" size="1 1 1"/>
<body name="upper" pos="0 0 1"><joint name="hip" axis="0 1 0" limited="true" range="-90 90"/>
<geom size="0.05 0.2" type="capsule"/><body name="tip" pos="0 0 -0.4">
<geom name="ball" size="0.1" priority="1"/></body></body></worldbody>
<actuator><motor joint="hip" ctrllimited="true" ctrlrange="-2 6" gear="3"/></actuator></mujoco>"""


class Arm(Robot):
  mjcf, substeps, episode_steps, names, scale = ARM, 5, 7, ("angle", "speed"), (0.1, 2.0)

  def reward(self, before, after, action):
    return after[0][0] - before[0][0] + 10 * action[0]


def alone(robot):
  """The Model that a robot without a fault is stepped by."""
  return robot.model._replace(mj={}, force=None)


def test_the_hopper_of_the_docs_is_gymnasiums(tmp_path, monkeypatch):
  """Hopper-v5 by its documented formulas on C MuJoCo: observation without x, speeds clipped to 10;
  reward dx / dt + 1 (healthy) - 0.001 |a|^2; healthy: z > 0.7 and |angle| < 0.2.
  """
  (tmp_path / "hopper.py").write_text(HOPPER)
  monkeypatch.chdir(tmp_path)
  robot = envs.make("hopper.py:Hopper", "native")
  assert robot.spec.targets == ("thigh_joint", "leg_joint", "foot_joint")
  assert robot.spec.control_s == pytest.approx(0.008) and robot.spec.name == "hopper"
  state, _ = robot.init(robot.model, jax.random.key(0))
  host = robot.mj_model
  data = mujoco.MjData(host)
  data.qpos[:], data.qvel[:] = map(np.asarray, state.physics[1])
  step, rng, ended = jax.jit(robot.step), np.random.default_rng(0), False
  for _ in range(60):
    action = rng.uniform(-1, 1, 3).astype(np.float32)
    state, out = step(alone(robot), state, action)
    x = data.qpos[0]
    data.ctrl[:] = action
    mujoco.mj_step(host, data, nstep=4)
    obs = np.concatenate([data.qpos[1:], np.clip(data.qvel, -10, 10)])
    ended = not (data.qpos[1] > 0.7 and abs(data.qpos[2]) < 0.2)
    np.testing.assert_allclose(out.obs, obs, atol=1e-5)  # float32 of float64
    want = (data.qpos[0] - x) / 0.008 + (not ended) - 1e-3 * (action**2).sum()
    # a difference of two float32 positions of some 0.1 m, over 0.008 s
    assert float(out.reward) == pytest.approx(want, abs=1e-4)
    assert bool(out.terminated) == ended and not bool(out.truncated)
    if ended:
      break
  assert ended


def test_what_the_model_says_is_the_spec():
  robot = Arm("native")
  spec = robot.spec
  assert [(v.name, v.scale) for v in spec.obs] == [
    ("angle", pytest.approx(0.1)),
    ("speed", pytest.approx(2.0)),
  ]
  assert spec.targets == ("hip",) and spec.feet == (("tip", (2,)),)
  assert spec.bodies == (("upper", (1,)), ("tip", (2,)))
  state, obs = robot.init(robot.model, jax.random.key(1))
  assert np.abs(obs).max() <= 0.005
  step = jax.jit(robot.step)
  for k in range(7):
    state, out = step(alone(robot), state, jnp.array([0.5]))
    assert bool(out.truncated) == (k == 6)
  data = mujoco.MjData(robot.mj_model)
  row, _ = robot.init(robot.model, jax.random.key(1))
  data.qpos[:], data.qvel[:] = map(np.asarray, row.physics[1])
  data.ctrl[:] = 2 + 4 * 0.5  # the middle of -2 to 6, and half its half
  mujoco.mj_step(robot.mj_model, data, nstep=35)
  np.testing.assert_allclose(out.obs, [*data.qpos, *data.qvel], rtol=1e-5)


def test_faults_reach_the_model():
  """Half the gear, and a trunk that bears more, against models that were compiled so."""
  robot = Arm("native")
  can = faults.available(robot)
  assert {"gear", "friction", "payload", "joint_damping", "range_loss", "bias"} <= set(can)
  assert not {"wind", "push", "com", "slope"} & set(can)  # it has no trunk that could move
  with pytest.raises(UserError, match="no trunk that is free to move"):
    faults.make("wind", robot)
  for name in ("gear", "payload"):
    fault = can[name]
    injection = faults.begin(fault, jax.random.key(0), faults.plan(0.5), 0)
    ports = faults.Ports(robot.model, ctrl=jnp.zeros(1))
    model = faults.drive(fault, injection, 5, jax.random.key(0), ports)[1].model
    owned = faults.owned_model((fault,), model)
    host = mujoco.MjModel.from_xml_string(ARM)
    if name == "gear":
      host.actuator_gear[:] *= 0.5
    else:
      more = 1 + 0.2 * host.body_mass.sum() / host.body_mass[1]
      host.body_mass[1] *= more
      host.body_inertia[1] *= more
      mujoco.mj_setConst(host, mujoco.MjData(host))
    state, _ = robot.init(robot.model, jax.random.key(1))
    data = mujoco.MjData(host)
    data.qpos[:], data.qvel[:] = map(np.asarray, state.physics[1])
    data.ctrl[:] = 6
    mujoco.mj_step(host, data, nstep=5)
    out = robot.step(owned, state, jnp.ones(1))[1]
    np.testing.assert_allclose(out.obs, [*data.qpos, *data.qvel], rtol=1e-5)


def robot_with(**own):
  return type("Mine", (Robot,), {"mjcf": ARM, "reward": Arm.reward} | own)


@pytest.mark.parametrize(
  "own, error, said",
  [
    ({"mjcf": "no/such.xml"}, UserError, "no file no/such.xml"),
    ({"mjcf": "<mujoco><nonsense/></mujoco>"}, UserError, "mjcf is no MuJoCo model: "),
    ({"mjcf": None}, UserError, "a path, a text of MJCF or a mujoco.MjModel; got NoneType"),
    ({"feet": {"left": ("shoe",)}}, UserError, "the model has no geom 'shoe'; it has ball"),
    ({"observe": lambda self, q, v: q[0]}, PluginError, "one vector is needed"),
  ],
)
def test_what_cannot_be_a_robot_is_one_line(own, error, said):
  with pytest.raises(error, match=re.escape(said)) as e:
    robot_with(**own)("native")
  assert "\n" not in str(e.value)


def test_a_robot_without_a_reward_says_so(tmp_path, monkeypatch):
  (tmp_path / "arm.py").write_text(
    f"from mjx_cl.envs.mjcf import Robot\nclass Arm(Robot):\n  mjcf = '''{ARM}'''\n"
  )
  monkeypatch.chdir(tmp_path)
  with pytest.raises(PluginError, match="Arm has no reward"):
    envs.make(f"{os.curdir}/arm.py:Arm", "native")
