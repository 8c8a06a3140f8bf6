"""`run` where nothing else runs it: on MJX, with an agent that holds each action for two control
steps, cut off and gone on from its checkpoint.
"""

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pyarrow.parquet
import pytest
import quick

from mjx_cl import envs
from mjx_cl import physics as physics_lib
from mjx_cl.config import CHUNK, PRESETS, AdaptConfig, RunConfig, replace
from mjx_cl.dreamer.agent import Agent
from mjx_cl.errors import UserError
from mjx_cl.io import tables
from mjx_cl.runs import run
from mjx_cl.training import agents
from mjx_cl.training import trainer as train
from mjx_cl.types import EnvState, Model, Spec, Step, Var

STEPS, ONSET, EPISODE, WARMUP, REPEAT = (
  1024,
  201,
  150,
  60,
  2,
)  # the onset is the second control step of a decision
ADAPT = AdaptConfig(
  warmup=WARMUP, start_windows=40, patience=4, least=64, trend=1e9, fluctuation=1e9, refit=100
)


XML = """<mujoco><option timestep="0.02"/><worldbody><body><joint name="hinge" type="hinge" axis="0 1 0" damping="0.1"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.03"/></body></worldbody><actuator><motor name="hinge" joint="hinge" gear="2" ctrlrange="-1 1"/></actuator></mujoco>"""


class Pendulum:
  """One hinge, small enough for MJX to compile in seconds; hanging still earns 1. Its task counts
  as done whatever it does: random weights can converge.
  """

  def __init__(self, physics="auto"):
    self.mj_model = mujoco.MjModel.from_xml_string(XML)
    self.physics = physics_lib.make(physics, self.mj_model, substeps=2)
    self.spec = Spec(
      "pendulum",
      (Var("cos", "1"), Var("sin", "1"), Var("speed", "rad/s")),
      (Var("hinge", "1", -1, 1),),
      0.04,
      EPISODE,
      0.0,
      None,
      ("hinge",),
    )
    self.model = Model(physics_lib.leaves(self.mj_model, "actuator_gear"), {})

  def init(self, model, key):
    qpos, qvel = jax.random.uniform(key, (1,), minval=-1.0), jnp.zeros(1)
    return EnvState(self.physics.init(qpos, qvel), jnp.int32(0)), self.observe(qpos, qvel)

  def observe(self, qpos, qvel):
    return jnp.concatenate([jnp.cos(qpos), jnp.sin(qpos), qvel])

  def step(self, model, state, action):
    inner, out = self.physics.step(model.mj, state.physics, jnp.clip(action, -1.0, 1.0))
    obs, step = self.observe(out["qpos"], out["qvel"]), state.step + 1
    return EnvState(inner, step), Step(
      obs, (1.0 + obs[0]) / 2.0, jnp.bool_(False), step >= EPISODE, obs
    )


@pytest.fixture(scope="module")
def lived(tmp_path_factory):
  """(config, folder of a run in one go, folder of one that was cut off after two chunks and went
  on, chunks that the latter lived then).
  """
  with pytest.MonkeyPatch.context() as patch:
    patch.setitem(envs.ENVS, "pendulum", Pendulum)
    yield live(patch, tmp_path_factory)


def live(patch, tmp_path_factory):
  agent, folder = tmp_path_factory.mktemp("agents") / "agent", tmp_path_factory.mktemp("runs")
  whole, cut = folder / "whole", folder / "cut"
  tiny = Agent(PRESETS["tiny"].dreamer, 3, 1)
  agents.save(
    agent,
    jax.jit(tiny.init)(jax.random.key(0)),
    {
      "env": "pendulum",
      "preset": "tiny",
      "repeat": REPEAT,
      "dreamer": dataclasses.asdict(tiny.config),
    },
  )
  config = RunConfig(
    "pendulum",
    onset=ONSET,
    steps=STEPS,
    seeds=1,
    first_seed=3,
    arms=("oracle",),
    detector="rolling_sigma_plain",
    settings=dict(window=100, warmup=30),
    physics="mjx",
    adapt=ADAPT,
    agent=str(agent),
  )
  runner = run.Runner(config, whole)
  whole.mkdir()
  runner.open()
  tables.write_json(whole / "config.json", runner.config_dict())
  while not runner.done:
    if runner.done_chunks == 2:
      runner.save()
      shutil.copytree(whole, cut)
    runner.step()
  run.finish(runner)
  assert (
    quick.traces(runner.loop.programs) == (1, 1, 1)
    and runner.rollout.chunk._cache_size() == 2  # a herd's and a band's
  )  # arrays that MJX binds to a device would be a second compilation of each
  step, later = run.Runner.step, []
  patch.setattr(run.Runner, "step", lambda self: (later.append(self.done_chunks), step(self))[1])
  assert run.execute(config, cut, resume=True)["arms"]["oracle"]["updates_mean"] > 0
  return config, whole, cut, later


def table(folder, name):
  return pyarrow.parquet.read_table(folder / f"{name}.parquet").to_pydict()


@pytest.mark.slow
def test_it_goes_on_where_it_was_cut_off(lived):
  """Every column of what was lived, to the last bit; wall times aside."""
  _, whole, cut, later = lived
  assert later == list(
    range(2, STEPS // (CHUNK * REPEAT))
  )  # what lay in the checkpoint was not lived again
  for name in ("trace", "events", "runs"):
    a, b = table(whole, name), table(cut, name)
    assert list(a) == list(b)
    for column in set(a) - {"wall_s"}:
      assert repr(a[column]) == repr(b[column]), column


@pytest.mark.slow
def test_clock_episodes_and_fault_are_those_of_control_steps(lived):
  config, whole, _, _ = lived
  trace, steps = table(whole, "trace"), np.arange(STEPS)
  assert (
    trace["step"] == steps.tolist()
    and json.loads((whole / "config.json").read_text())["physics"] == config.physics
  )
  np.testing.assert_array_equal(trace["severity"], np.where(steps >= ONSET, 0.5, 0.0))
  np.testing.assert_array_equal(trace["episode"], steps // EPISODE)
  np.testing.assert_array_equal(trace["truncated"], steps % EPISODE == EPISODE - 1)
  reward = np.asarray(trace["reward"])
  assert (
    np.isfinite(reward).all()
    and (reward >= 0).all()
    and (reward <= 1).all()
    and len(np.unique(reward)) > STEPS / 2
  )  # of each step, not of each decision


@pytest.mark.slow
def test_residuals_are_known_once_a_decision(lived):
  """OPR of a decision is known 14 decisions after it, with the last control step of that one."""
  _, whole, _, _ = lived
  trace = table(whole, "trace")
  valid = np.asarray(trace["valid"])
  known = np.asarray([x is not None and np.isfinite(x) for x in trace["opr"]])
  np.testing.assert_array_equal(known, valid)
  assert (
    set(np.flatnonzero(valid) % REPEAT) == {REPEAT - 1}
    and np.flatnonzero(valid)[0] == 15 * REPEAT - 1
  )
  assert valid[REPEAT - 1 :: REPEAT].mean() > 0.8


@pytest.mark.slow
def test_finetuning_starts_with_the_chunk_of_the_onset_and_is_paid_by_decisions(lived):
  """Chunks are of CHUNK decisions. Updates: the train ratio times the records since the start, over
  the records of an update.
  """
  config, whole, _, _ = lived
  events, trace = table(whole, "events"), table(whole, "trace")
  chunk = CHUNK * REPEAT
  start = [s for s, k in zip(events["step"], events["kind"]) if k == "start"]
  assert start == [-(-(ONSET + 1) // chunk) * chunk - 1]
  stop = [s for s, k in zip(events["step"], events["kind"]) if k == "stop"]
  assert stop == [start[0] + ADAPT.patience * chunk] and stop[0] < STEPS - 1
  phase = np.asarray(trace["phase"])
  assert (
    set(phase[: start[0] + 1]) == {"nominal"}
    and set(phase[start[0] + 1 : stop[0] + 1]) == {"adapting"}
    and set(phase[stop[0] + 1 :]) == {"converged"}
  )
  updates, (row,) = (
    np.asarray(trace["updates"]),
    pyarrow.parquet.read_table(whole / "runs.parquet").to_pylist(),
  )
  assert not updates[: start[0] + 1].any() and 0 < row["updates"] <= ADAPT.ratio * (
    stop[0] - start[0]
  ) / REPEAT / (config.adapt.batch * PRESETS["tiny"].dreamer.length)


@pytest.mark.slow
def test_training_on_mjx_is_read_back_to_the_bit(tmp_path):
  """Environment states of MJX hold arrays without an element."""
  tiny = PRESETS["tiny"]
  make = lambda: train.Trainer(
    Pendulum("mjx"), tiny.dreamer, replace(tiny.train, updates=96), tmp_path / "out", seeds=2
  )
  trainer = make()
  while not trainer.done:
    trainer.step()
  trainer.save()
  again = make()
  again.resume()
  bits = lambda tree: [
    np.asarray(
      jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    ).tobytes()
    for x in jax.tree.leaves(tree)
  ]
  assert any(x.size == 0 for x in jax.tree.leaves(trainer.state)) and bits(trainer.state) == bits(
    again.state
  )


def test_more_lives_than_memory_are_refused_before_anything_is_made(tmp_path):
  """A million seeds: no key of theirs is drawn, no folder stays."""
  out = tmp_path / "out"
  with pytest.raises(
    UserError, match=r"streams of 25,000 control steps need [\d,.]+ GiB, .* --see"
  ):
    run.execute(RunConfig("walker", seeds=1_000_000), out)
  assert not out.exists()
