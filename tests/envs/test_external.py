"""Robots of Brax and MuJoCo Playground: C MuJoCo as oracle of what faults do to them, bad names."""

import copy
import importlib.util
import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_cl import envs, faults
from mjx_cl.envs import external
from mjx_cl.errors import UserError


@pytest.fixture(scope="module")
def pendulum():
  with warnings.catch_warnings():  # brax says that it is not maintained
    warnings.simplefilter("ignore")
    return envs.make("brax:inverted_pendulum")


def given(robot, name, target):
  """What the robot is stepped by under fault `name` at severity 0.5."""
  fault = faults.make(name, robot)
  injection = faults.begin(fault, jax.random.key(0), faults.plan(0.5), target)
  ports = faults.Ports(robot.model, ctrl=jnp.zeros(len(robot.spec.act)))
  model = faults.drive(fault, injection, 5, jax.random.key(0), ports)[1].model
  return faults.owned_model((fault,), model)


def by_hand(host, state, control, frames, force=0.0):
  """Observation of the pendulum, qpos and qvel, after `frames` steps of C MuJoCo."""
  data = mujoco.MjData(host)
  data.qpos[:], data.qvel[:] = (
    np.asarray(state.physics.data.qpos),
    np.asarray(state.physics.data.qvel),
  )
  data.ctrl[:] = control
  data.qfrc_applied[0] = force
  mujoco.mj_step(host, data, nstep=frames)
  return [*data.qpos, *data.qvel]


def test_a_robot_of_brax_and_its_faults(pendulum):
  """Nominal, half the gear, a heavier limb with the constants that follow, wind: what C MuJoCo says
  of a model that is so from the start. Brax scales actions to ctrlrange, -3 to 3.
  """
  robot = pendulum
  spec, host = robot.spec, robot.mj_model
  assert (spec.name, spec.targets, len(spec.obs)) == ("brax:inverted_pendulum", ("slide",), 4)
  assert [name for name, _ in spec.bodies] == ["cart", "pole"]
  frames = round(spec.control_s / host.opt.timestep)
  state, obs = jax.jit(robot.init)(robot.model, jax.random.key(0))
  np.testing.assert_allclose(obs, by_hand(host, state, 0, 0), atol=1e-6)
  step = jax.jit(robot.step)
  action, seen = jnp.array([0.4]), []
  for name, target in (("none", 0), ("gear", 0), ("limb_mass", 0), ("wind", 0)):
    model = copy.copy(host)
    owned = given(robot, name, target)
    force = 0.0
    if name == "gear":
      model.actuator_gear[:] *= 0.5
    if name == "limb_mass":
      model.body_mass[2] *= 2
      model.body_inertia[2] *= 2
      mujoco.mj_setConst(model, mujoco.MjData(model))
    if name == "wind":
      force = 0.3 * 0.5 * 9.81 * model.body_mass.sum()
    out = step(owned, state, action)[1]
    want = by_hand(model, state, 1.2, frames, force)
    np.testing.assert_allclose(out.obs, want, rtol=1e-3, atol=1e-5)  # float32 of float64
    assert float(out.reward) == 1.0 and not bool(out.terminated) and not bool(out.truncated)
    seen.append(np.asarray(out.obs))
  assert len({tuple(x.tolist()) for x in seen}) == 4
  late = state._replace(step=jnp.int32(spec.episode_steps - 1))
  assert bool(step(given(robot, "none", 0), late, action)[1].truncated)


def test_what_cannot_be_had_is_one_line(pendulum, monkeypatch):
  for name, said in (
    ("brax:pendulum", "unknown brax environment 'pendulum'; choose from: ant, "),
    ("brax:", "unknown brax environment ''"),
  ):
    with pytest.raises(UserError, match=said) as e:
      envs.make(name)
    assert "\n" not in str(e.value)
  with pytest.raises(UserError, match="no physics backend to choose"):
    envs.make("brax:inverted_pendulum", "native")
  with pytest.raises(UserError, match="'pendulum' is none of MuJoCo Playground, nor of brax"):
    external.External(type("Pendulum", (), {})())
  if importlib.util.find_spec("mujoco_playground") is None:
    with pytest.raises(UserError, match="pip install playground"):
      envs.make("playground:CheetahRun")


def test_a_robot_of_playground():
  pytest.importorskip("mujoco_playground")
  robot = envs.make("playground:CartpoleBalance")
  assert robot.spec.targets and len(robot.spec.obs) == 5
  state, _ = jax.jit(robot.init)(robot.model, jax.random.key(0))
  step = jax.jit(robot.step)
  speed = lambda name, action: float(step(given(robot, name, 0), state, action)[1].obs[3])
  still, whole, half = (
    speed("none", jnp.zeros(1)),
    speed("none", jnp.ones(1)),
    speed("gear", jnp.ones(1)),
  )
  # of one physics step from one state: what the motor adds to the cart's speed is linear in it
  assert (half - still) / (whole - still) == pytest.approx(0.5, abs=0.01)
