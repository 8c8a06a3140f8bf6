"""Host functions by name: what a program computes with them, errors, names of hosts, and that a
program is found in the cache by another process.
"""

import gc
import os
import subprocess
import sys
import textwrap
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import quick

from mjx_cl import physics
from mjx_cl.physics import host_call, native

XML = """<mujoco><option timestep="0.02"/><worldbody><body>
<joint name="hinge" type="hinge" axis="0 1 0" damping="0.1"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03"/></body></worldbody>
<actuator><motor name="hinge" joint="hinge" gear="{gear}" ctrlrange="-1 1"/></actuator></mujoco>"""


def pendulum(gear=2.0):
  return mujoco.MjModel.from_xml_string(XML.format(gear=gear))


class Function:
  """Adds the word's number, and keeps the shapes it was called with."""

  def __init__(self):
    self.shapes = []

  def __call__(self, word, x):
    self.shapes.append(x.shape)
    if word == "bad":
      raise ValueError("a bad word")
    return x[..., :2] + np.uint32(int(word))


@pytest.fixture(params=[True, False], ids=["by name", "pure_callback"])
def way(request, monkeypatch):
  """Both forms of a call."""
  if not request.param:
    monkeypatch.setattr(host_call, "registered", lambda: False)
  else:
    assert host_call.registered()


def test_a_batch_is_one_call(way):
  function = host_call.shared("a batch", Function)
  x = np.arange(12, dtype=np.uint32).reshape(2, 2, 3)
  out = quick.jit(jax.vmap(jax.vmap(lambda x: host_call.call("a batch", "7", 2, x))))(x)
  np.testing.assert_array_equal(out, x[..., :2] + 7)
  assert function.shapes == [(2, 2, 3)]


@pytest.mark.parametrize("version", ["0.9.1", "0.9.3", "0.10.2", "0.9.2.dev1"])
def test_another_jaxlib_gets_a_pure_callback(version, monkeypatch):
  """Whose memory layout nobody has looked at: no program calls by name, no target is registered."""
  function, x = host_call.shared("another", Function), np.arange(3, dtype=np.uint32)
  program = lambda: jax.jit(lambda x: host_call.call("another", "7", 2, x)).lower(x)
  assert host_call.TARGET in program().as_text()
  asked = []
  monkeypatch.setattr(host_call, "_register", lambda: asked.append(1) or True)
  monkeypatch.setattr(host_call.jaxlib, "__version__", version)
  other = program()
  assert host_call.TARGET not in other.as_text() and "callback" in other.as_text() and not asked
  np.testing.assert_array_equal(other.compile()(x), x[:2] + 7)
  assert function.shapes == [(3,)]


def test_an_empty_batch_is_nothing(way):
  function = host_call.shared("empty", Function)
  assert quick.jit(jax.vmap(lambda x: host_call.call("empty", "7", 2, x)))(
    np.zeros((0, 3), np.uint32)
  ).shape == (0, 2)
  assert set(function.shapes) <= {(0, 3)}


def test_an_exception_ends_the_program_with_its_text(way):
  function = host_call.shared("raises", Function)
  program = quick.jit(lambda x: host_call.call("raises", "bad", 2, x))
  for _ in range(2):
    with pytest.raises(jax.errors.JaxRuntimeError, match="a bad word"):
      program(jnp.zeros(3, jnp.uint32)).block_until_ready()
  assert len(function.shapes) == 2


def test_a_function_that_is_gone_is_named(way):
  function = host_call.shared("gone", Function)
  program = quick.jit(lambda x: host_call.call("gone", "1", 2, x))
  np.testing.assert_array_equal(program(jnp.zeros(3, jnp.uint32)), [1, 1])
  del function
  gc.collect()
  with pytest.raises(
    (jax.errors.JaxRuntimeError, ValueError), match="host function gone .* is gone; keep its robot"
  ):  # JAX raises the one, or the other at a later call
    program(jnp.zeros(3, jnp.uint32)).block_until_ready()


def test_a_name_is_made_once_and_freed():
  one = host_call.shared("once", Function)
  assert host_call.shared("once", lambda: pytest.fail("made twice")) is one
  with pytest.raises(ValueError, match="without"):
    host_call.shared("on|ce", Function)


# ---- names of hosts ------------------------------------------------------------------------------


def law(xp, task, ctrl, qpos, qvel):
  return ctrl - 0.5 * xp.stack([qvel[..., i] for i in range(1)], -1)


def law_of(gain, more=None):
  def law(xp, task, ctrl, qpos, qvel):
    return ctrl - gain * qvel

  return law


def elsewhere(gain):
  """A law of another module of this module's name."""
  module = types.ModuleType(__name__)
  exec(
    f"GAIN = {gain}\ndef law(xp, task, ctrl, qpos, qvel):\n  return ctrl - GAIN * qvel",
    module.__dict__,
  )
  return module.law


def test_a_name_tells_what_results_depend_on():
  """Equal for equal content, and different for all else."""
  name = lambda gear=2.0, substeps=2, outputs=("qpos", "qvel"), law=None: native.identity(
    pendulum(gear), substeps, outputs, law
  )
  assert (
    name() == name()
    and name(law=law) == name(law=law)
    and name(law=law_of(0.5)) == name(law=law_of(0.5))
  )
  assert name(law=law_of(np.ones(2))) == name(law=law_of(np.ones(2)))
  names = [
    name(),
    name(gear=2.5),
    name(substeps=3),
    name(outputs=("qpos",)),
    name(law=law),
    name(law=law_of(0.5)),
    name(law=law_of(0.25)),
    name(law=law_of(np.ones(2))),
    name(law=law_of(np.ones(2, np.float32))),
    name(law=law_of(True)),
    name(law=law_of(1)),
    name(law=law_of(1.0)),
  ]
  assert len(set(names)) == len(names)


def test_a_law_without_words_has_a_name_of_its_own():
  class Law:
    def __call__(self, xp, task, ctrl, qpos, qvel):
      return ctrl

  one = Law()
  for value in (one, law_of(one)):
    assert native.identity(pendulum(), 2, ("qpos",), value) != native.identity(
      pendulum(), 2, ("qpos",), value
    )


def test_laws_of_two_modules_of_one_name_stay_apart():
  step = lambda backend: quick.jit(
    lambda: backend.step({}, backend.init(jnp.zeros(1), jnp.ones(1)), jnp.zeros(1))[1]
  )()
  gains = (0.0, 3.0)
  both = [physics.make("native", pendulum(), 2, law=elsewhere(g)) for g in gains]
  assert both[0].host is not both[1].host
  np.testing.assert_allclose(
    [float(step(b)["ctrl"][0]) / -float(step(b)["qvel_before"][0]) for b in both], gains, atol=1e-6
  )


def test_instances_of_one_model_share_a_host_and_not_what_it_held():
  """Each robot's fields are its own, in whichever order two instances step."""
  one, other, alone = (physics.make("native", pendulum(), 2) for _ in range(3))
  assert one.host is other.host
  start = one.init(jnp.zeros(1), jnp.zeros(1))
  step = lambda backend, gear: quick.jit(
    lambda: backend.step({"actuator_gear": jnp.full((1, 6), gear)}, start, jnp.ones(1))[1]["qvel"]
  )()
  want = {g: float(step(alone, g)[0]) for g in (1.0, 2.0)}
  assert want[1.0] != want[2.0]
  for g in (1.0, 2.0, 1.0):
    assert float(step(one, g)[0]) == want[g] and float(step(other, 3.0 - g)[0]) == want[3.0 - g]
  assert one.seconds == other.seconds > 0


def test_a_model_changed_later_is_another_one():
  """A backend copies its model."""
  model = pendulum()
  one = physics.make("native", model, 2)
  model.actuator_gear[:] = 5.0
  other = physics.make("native", model, 2)
  step = lambda backend: float(
    quick.jit(
      lambda: backend.step({}, backend.init(jnp.zeros(1), jnp.zeros(1)), jnp.ones(1))[1]["qvel"]
    )()[0]
  )
  assert one.host is not other.host and step(other) > 2 * step(one)


def test_another_process_finds_the_program_in_the_cache(tmp_path):
  """Two processes, robots made in another order: the second compiles nothing of the native step and
  computes the same.
  """
  code = textwrap.dedent("""
    import sys
    from mjx_cl.io import runtime
    runtime.setup()
    import jax, numpy as np
    from jax import monitoring
    from mjx_cl import envs
    events = []
    monitoring.register_event_listener(lambda name, **_: events.append(name))
    made = {name: envs.make(name, "native") for name in sys.argv[1].split(",")}
    env = made["quadruped"]
    start = np.stack([np.asarray(env.physics.host.template)] * 2)
    fields = {k: np.stack([np.asarray(v)] * 2) for k, v in env.model.mj.items()}
    task = {k: np.stack([np.asarray(v)] * 2) for k, v in env.model.task.items()}
    program = jax.jit(jax.vmap(lambda f, s, c, t: env.physics.step(f, s, c, t)[1]["qpos"]))
    out = np.asarray(program(fields, start, np.full((2, 12), 0.1, np.float32), task))
    print(events.count("/jax/compilation_cache/cache_misses"), out.tobytes().hex())
  """)
  run = lambda order: subprocess.run(
    [sys.executable, "-c", code, order],
    env=os.environ | {"MJX_CL_CACHE": str(tmp_path)},
    capture_output=True,
    text=True,
    check=True,
  ).stdout.split()
  (first, result), (second, again) = run("quadruped,car_real"), run("car_real,quadruped")
  assert int(first) > 0 and int(second) == 0 and result == again
