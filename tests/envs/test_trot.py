"""The quadruped's reference driver."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_cl import envs
from mjx_cl.envs import anymal, trot

ROBOTS, STEPS, SETTLED = 24, 500, 50


def test_angles_are_the_inverse_of_reach():
  spread = jax.random.uniform(jax.random.key(0), (50, 12), minval=-0.25, maxval=0.25)
  joints = (anymal.DEFAULT + spread).reshape(50, 4, 3)
  again = jax.vmap(lambda q: trot.angles(trot.reach(q)))(joints)
  # float32: angles of a nearly stretched leg lose three digits in the arc cosine
  np.testing.assert_allclose(again, joints, atol=2e-3)


def test_a_robot_that_stands_is_told_what_carries_it():
  """In the stance, at rest and level: the torques that it asks for are the forces' own, by virtual
  work on C MuJoCo's Jacobians of the feet.
  """
  model = anymal.load_model()
  data = mujoco.MjData(model)
  data.qpos[:] = [0, 0, trot.GAIT.height, 1, 0, 0, 0, *anymal.DEFAULT]
  mujoco.mj_kinematics(model, data)
  mujoco.mj_comPos(model, data)
  torque = np.zeros(12)
  for leg in anymal.LEGS:
    geom = model.geom(f"{leg}_foot").id
    jacobian = np.zeros((3, model.nv))
    point = data.geom_xpos[geom]
    mujoco.mj_jac(model, data, jacobian, None, point, model.geom_bodyid[geom])
    torque -= jacobian[2, 6:] * trot.MASS * trot.GRAVITY / 4
  gait = trot.GAIT._replace(smooth=0.0, bear=1.0)
  zero = jnp.zeros(3)
  given = lambda gait: trot.action(
    jnp.int32(0), jnp.asarray(data.qpos), jnp.zeros(18), zero, jnp.zeros(12), gait
  )
  told = anymal.STIFFNESS * (given(gait) - given(gait._replace(bear=0.0)))
  np.testing.assert_allclose(told, torque, atol=0.05)  # float32 angles times 80 N m/rad


@pytest.mark.parametrize("command", [(0.0, 0.0, 0.0), (0.8, 0.0, 0.0), (0.0, -0.5, 0.5)])
def test_it_trots_as_commanded(command):
  env = envs.make("quadruped")
  wanted = jnp.asarray([command] * 2, jnp.float32)
  model = env.model._replace(task=env.model.task | {"command_range": wanted})

  def step(state, _):
    state, out = env.step(model, state, env.reference(state))
    p = state.physics
    return state, (out.terminated, p.air > 0, p.qpos[2], p.velocity_error)

  live = lambda key: jax.lax.scan(step, env.init(model, key)[0], None, length=STEPS)[1]
  keys = jax.random.split(jax.random.key(100), ROBOTS)
  fallen, up, height, error = map(np.asarray, jax.jit(jax.vmap(live))(keys))
  # starts are with bent legs and a push: one in thirty falls at once
  sound = ~fallen.any(1)
  assert sound.sum() >= ROBOTS - 4
  assert height[sound, SETTLED:].mean() > 0.5 and error[sound, SETTLED:].mean() < 0.25
  up = up[sound, SETTLED:].reshape(-1, 4).astype(float)
  if not any(command):
    assert up.mean() < 0.02
    return
  alike = np.corrcoef(up.T)
  assert alike[0, 3] > 0.7 and alike[1, 2] > 0.7 and alike[0, 1] < -0.5 and alike[0, 2] < -0.5
