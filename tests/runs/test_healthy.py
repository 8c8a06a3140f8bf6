"""Runs of one process live what comes before the onset once: a part that goes on from there is the
same, bit for bit, as one by itself.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_lives import make, saved  # noqa: F401  fixtures

from mjx_cl import envs, faults
from mjx_cl.config import CHUNK, PRESETS, RunConfig
from mjx_cl.dreamer.agent import Agent
from mjx_cl.rollout.scan import Rollout, nest, start
from mjx_cl.runs.healthy import Healthy, Past, key_of

CHUNKS, ONSET = 6, 3 * CHUNK + 9
ARMS = ("none", "oracle")


def trace(runner):
  return {k: v.tobytes() for k, v in runner.trace().items()}


@pytest.mark.parametrize(
  "change", [{"severity": 1.0}, {"schedule": "ramp"}, {"target": "left_hip"}]
)
def test_a_forked_part_is_the_part_by_itself(make, monkeypatch, change):  # noqa: F811
  healthy, settings = Healthy(), dict(arms=ARMS, seeds=2, onset=ONSET)
  first = make(**settings, healthy=healthy)
  first.fork()
  assert first.done_chunks == 0
  for _ in range(CHUNKS):
    first.step()
  alone = make(**settings | change)
  forked = make(**settings | change, healthy=healthy)
  forked.fork()
  assert forked.done_chunks == ONSET // CHUNK - 1
  for runner in (alone, forked):
    while not runner.done:
      runner.step()
  assert len(alone.lives.place) == 2  # an arm has departed, with the same weights from then on
  assert trace(alone) == trace(forked) and trace(alone) != trace(first)
  for g in range(len(alone.labels)):
    a, b = (jax.tree.leaves(runner.lives.acting(g)) for runner in (alone, forked))
    assert all(np.array_equal(x, y) for x, y in zip(a, b))


def test_the_past_ends_with_the_first_departure(make):  # noqa: F811
  healthy = Healthy()
  runner = make(arms=("none", "always"), onset=ONSET, healthy=healthy)
  for _ in range(CHUNKS):
    runner.step()
  (past,) = healthy.kept.values()
  assert past.chunks == 1 < ONSET // CHUNK - 1  # arm `always` departs in the second


def test_other_weights_of_the_same_card_share_nothing(make):  # noqa: F811
  healthy = Healthy()
  runner = make(arms=("none",), onset=ONSET, healthy=healthy)
  runner.step()
  ((key, past),) = healthy.kept.items()
  other = lambda herd: jax.tree.map(lambda x: x + 1, herd[0])
  healthy.keep(key, past._replace(herds=[(other(herd), *herd[1:]) for herd in past.herds]))
  again = make(arms=("none",), onset=ONSET, healthy=healthy)
  again.fork()
  assert again.done_chunks == 0


@pytest.mark.parametrize(
  "change, shares",
  [
    ({"severity": 1.0, "schedule": "cyclic", "target": "left_hip", "keep": True}, True),
    ({"fault": "bias"}, True),
    ({"onset": 700}, False),
    ({"seeds": 3}, False),
    ({"detector": "shewhart"}, False),
    ({"arms": ("none",)}, False),
    ({"env": "car", "fault": "bias"}, False),
  ],
)
def test_what_runs_share_a_past(change, shares):
  config = RunConfig("walker", onset=640)
  key = lambda config: key_of(config, [], [])
  assert key(config) and (key(dataclasses.replace(config, **change)) == key(config)) == shares


def test_some_runs_share_nothing(tmp_path):
  config = RunConfig("walker", onset=640)
  assert key_of(config, [{"steps": 1}], []) != key_of(config, [], [])
  masses = [key_of(config, [], [field]) for field in ("body_mass", "geom_friction")]
  assert masses[0] != masses[1] == key_of(config, [], [])
  assert not key_of(RunConfig("car", fault="car/sim-to-real"), [], [])
  endless = dataclasses.replace(config, arms=("oracle-budget", "none"), snapshots=64)
  assert not key_of(endless, [], [])
  own = tmp_path / "own.py"
  own.write_text("from mjx_cl.faults.base import none as worn\n")
  assert not key_of(dataclasses.replace(config, fault=f"{own}:worn"), [], [])


def test_the_newest_pasts_are_kept():
  healthy, past = Healthy(2), Past(1, [], [], np.zeros(1), np.zeros(1))
  for key in "abac":
    healthy.keep(key, past)
  assert list(healthy.kept) == ["a", "c"]


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["walker", "quadruped", "car"])
def test_a_chunk_fills_what_a_fault_remembers(robot):
  """Of every fault of a robot, one on each stream: there from the start, and put in place of a
  healthy robot's a chunk before that of the onset.
  """
  env = envs.make(robot)
  agent = Agent(PRESETS["tiny"].dreamer, len(env.spec.obs), len(env.spec.act))
  own = tuple(faults.available(env).values())
  count = len(own)
  keys = jax.random.split(jax.random.key(0), count)[None]
  one = lambda key, severity: start(env, agent, own, key, severity, 2 * CHUNK + 9)
  begin = jax.jit(nest(one, (0, 0), (0, 0)))
  alone = begin(keys, jnp.eye(count)[None])
  healthy = begin(keys, jnp.zeros((1, count, count)))
  params = jax.tree.map(lambda x: x[None], agent.init(jax.random.key(1)).params)
  live = lambda streams: Rollout(env, agent, own).chunk(params, streams, CHUNK)
  live = jax.jit(live)
  injected = alone.injection
  (alone, _), (healthy, _) = live(alone), live(healthy)
  forked, nominal = healthy._replace(injection=injected), healthy
  for chunk in (1, 2, 3):
    (alone, rows), (forked, own_rows), (nominal, other) = map(live, (alone, forked, nominal))
    for name, x, y in zip(rows._fields, rows, own_rows):
      assert (x is None and y is None) or np.array_equal(x, y, equal_nan=True), (chunk, name)
  moved = [
    (a != b).any((0, 1, 3))
    for a, b in ((rows.final_obs, other.final_obs), (rows.rewards, other.rewards))
  ]
  # a range of commands shows with the next episode
  assert {f.name for f, m in zip(own, moved[0] | moved[1]) if not m} <= {"none", "command_range"}
