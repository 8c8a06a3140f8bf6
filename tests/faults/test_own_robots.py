"""Faults on robots of one's own, whose motors, floors and joints are unlike the shipped ones'."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl import faults
from mjx_cl.envs.mjcf import Robot
from mjx_cl.errors import UserError

LINK = '<geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass="1"/>'
LIMITED = 'ctrllimited="true" ctrlrange="-1.5 1.5"'
ARM = f"""<mujoco><worldbody><body name="arm"><joint name="j" type="hinge" axis="0 1 0"
  damping="2"/>{LINK}</body></worldbody><actuator>MOTOR</actuator></mujoco>"""
SERVO = f'<position name="j" joint="j" kp="100" {LIMITED} FORCE/>'
STRONG = 'forcelimited="true" forcerange="-50 40"'


def robot(xml, **own):
  """A robot of this model."""
  reward = lambda self, before, after, action: 0.0
  return type("Own", (Robot,), {"mjcf": xml, "noise": 0.0, "reward": reward, **own})("native")


def driven(env, name, target):
  """Its model under a fault of severity 1."""
  fault = faults.make(name, env)
  injection = faults.begin(
    fault, jax.random.key(0), faults.plan(1.0), faults.target_index(fault, target)
  )
  ports = faults.Ports(env.model, ctrl=jnp.zeros(len(env.spec.act)))
  return faults.drive(fault, injection, 5, jax.random.key(0), ports)[1].model


def test_a_servo_is_not_weakened_by_moving_its_target():
  servo = robot(ARM.replace("MOTOR", SERVO.replace("FORCE", STRONG)))
  for name in ("gear", "torque_loss"):
    with pytest.raises(UserError, match=f"fault '{name}' needs motors that give a torque"):
      faults.make(name, servo)
  motor = robot(ARM.replace("MOTOR", f'<motor name="j" joint="j" gear="30" {LIMITED}/>'))
  assert driven(motor, "gear", "j").mj["actuator_gear"][0, 0] == 0


def test_dry_friction_is_a_quarter_of_the_greatest_torque():
  """Of a servo that of its forcerange, whose ends may differ; of a motor that of its command."""
  friction = lambda env: float(driven(env, "joint_friction", "j").mj["dof_frictionloss"][0])
  assert friction(robot(ARM.replace("MOTOR", SERVO.replace("FORCE", STRONG)))) == 0.25 * 50
  motor = f'<motor name="j" joint="j" gear="30" {LIMITED}/>'
  assert friction(robot(ARM.replace("MOTOR", motor))) == 0.25 * 30 * 1.5
  with pytest.raises(UserError, match="needs motors with a greatest torque"):
    faults.make("joint_friction", robot(ARM.replace("MOTOR", SERVO.replace("FORCE", ""))))


@pytest.mark.parametrize("through", ('tendon="t"', 'site="s" gear="0 0 1 0 0 0"'))
def test_a_motor_of_a_tendon_or_a_site_is_no_joints(through):
  """Its number would be taken for a joint's; a robot of site motors still has its other faults."""
  xml = f"""<mujoco><worldbody><body name="cart"><joint name="slide" type="slide" axis="1 0 0"/>
    {LINK}<site name="s"/><body name="pole"><joint name="h" type="hinge" axis="0 1 0"/>{LINK}</body>
    </body></worldbody><tendon><fixed name="t"><joint joint="h" coef="1"/></fixed></tendon>
    <actuator><motor name="a" {through} {LIMITED}/><motor name="b" joint="slide" {LIMITED}/>
    </actuator></mujoco>"""
  env = robot(xml)
  for name in ("joint_damping", "joint_friction", "range_loss", "joint_lock"):
    with pytest.raises(UserError, match="needs motors that act on joints"):
      faults.make(name, env)
  assert {"gear", "noise", "payload"} <= faults.available(env).keys()


@pytest.mark.parametrize("floor", ("plane", "box"))
def test_a_floor_of_any_shape_masks_the_friction_of_a_foot(floor):
  xml = f"""<mujoco><worldbody><geom type="{floor}" size="5 5 .5" pos="0 0 -.5" friction="1"/>
    <body name="block" pos="0 0 .1"><freejoint/><geom name="foot" type="box" size=".1 .1 .1"
    mass="1" friction=".8" PRIORITY/><body name="arm" pos="0 0 .2"><joint name="h" type="hinge"
    axis="0 1 0"/><geom type="sphere" size=".02" mass=".1" contype="0" conaffinity="0"/></body>
    </body></worldbody><actuator><motor joint="h" {LIMITED}/></actuator></mujoco>"""
  feet = {"feet": {"foot": ["foot"]}}
  with pytest.raises(UserError, match="the floor masks the friction of foot"):
    faults.make("friction", robot(xml.replace("PRIORITY", ""), **feet))
  assert faults.make("friction", robot(xml.replace("PRIORITY", 'priority="1"'), **feet))


def test_wind_blows_along_the_world_where_the_trunk_is_turned():
  """A cart whose own x axis is the world's y is not moved by a force along x."""
  xml = f"""<mujoco><worldbody><body name="cart" euler="0 0 90"><joint name="slide" type="slide"
    axis="1 0 0"/>{LINK}</body></worldbody><actuator><motor name="push" joint="slide" {LIMITED}/>
    </actuator></mujoco>"""
  env = robot(xml)
  fault = faults.make("wind", env)
  assert {name for name in fault.targets if name != "random"} <= {"left", "right"}
  force = {name: float(driven(env, "wind", name).force[0]) for name in ("left", "right")}
  assert force["left"] == pytest.approx(-force["right"]) and abs(force["left"]) > 0
  assert np.isclose(force["left"], abs(force["left"]))  # left is the world's y, as the slide is


def test_what_is_welded_to_the_world_is_neither_trunk_nor_foot():
  xml = f"""<mujoco><worldbody><body name="ramp"><geom type="box" size="1 1 .1" pos="0 0 -.2"
    mass="200"/></body><body name="block" pos="0 0 .1"><freejoint/><geom type="box"
    size=".1 .1 .1" mass="1"/><body name="leg" pos="0 0 -.1"><joint name="h" type="hinge"
    axis="0 1 0"/><geom name="toe" type="sphere" size=".02" mass=".1" priority="1"/></body></body>
    </worldbody><actuator><motor name="h" joint="h" {LIMITED}/></actuator></mujoco>"""
  env = robot(xml)
  assert [name for name, _ in env.spec.bodies] == ["block", "leg"]
  assert [name for name, _ in env.spec.feet] == ["leg"]
  mass = driven(env, "payload", "trunk").mj["body_mass"] - env.model.mj["body_mass"]
  assert (np.asarray(mass) > 0).tolist() == [False, False, True, False]
  assert {"com", "wind", "push", "friction"} <= faults.available(env).keys()


def test_a_joint_of_two_motors_is_no_motors_joint():
  """A position and a velocity servo: what breaks one of them alone would break both or none."""
  xml = f"""<mujoco><worldbody><body name="cart"><joint name="slide" type="slide" axis="1 0 0"
    limited="true" range="-2 2"/>{LINK}</body></worldbody><actuator><position name="p" joint="slide"
    {LIMITED}/><velocity name="v" joint="slide" {LIMITED}/></actuator></mujoco>"""
  env = robot(xml)
  for name in ("joint_damping", "joint_friction", "range_loss", "joint_lock"):
    with pytest.raises(UserError, match="has a joint with several"):
      faults.make(name, env)
  assert "noise" in faults.available(env)


def test_mjx_takes_dry_friction_where_every_joint_has_some():
  xml = f"""<mujoco><worldbody><body name="a"><joint name="j" type="hinge" axis="0 1 0"
    frictionloss=".1"/>{LINK}<body name="b" pos=".4 0 0"><joint name="k" type="hinge" axis="0 1 0"
    FRICTION/>{LINK}</body></body></worldbody><actuator><motor name="j" joint="j" {LIMITED}/><motor
    name="k" joint="k" {LIMITED}/></actuator></mujoco>"""
  own = lambda friction, on: type(robot(xml.replace("FRICTION", friction)))(on)
  for friction, on in (("", "native"), ('frictionloss=".1"', "mjx")):
    assert faults.make("joint_friction", own(friction, on))
  with pytest.raises(
    UserError, match="MJX builds no friction constraint for a joint that has none"
  ):
    faults.make("joint_friction", own("", "mjx"))


def test_a_robot_that_names_no_physics_has_faults(monkeypatch):
  env = robot(ARM.replace("MOTOR", SERVO.replace("FORCE", STRONG)))
  monkeypatch.delattr(env, "physics")
  assert "joint_friction" in faults.available(env)
