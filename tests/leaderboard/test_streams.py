"""The set that ships: its documentation, who acted in it, how it reads."""

import pathlib
import re

import numpy as np
import pytest

from mjx_cl import envs
from mjx_cl.leaderboard import lives, parts, streams
from mjx_cl.rollout.scan import stream_keys
from mjx_cl.training import agents

ROOT = pathlib.Path(__file__).parents[2]


@pytest.fixture(scope="module")
def shipped():
  return streams.StreamSet()


# CRC-32 of the weights that acted, in single precision, and of the same in half, which ship: both
# taken of one agent when they were rounded
ROUNDED = {
  "walker": (230908211, 2567389287),
  "car": (3211297954, 3384754313),
  "quadruped": (829730412, 1807368934),
}


def test_the_agents_that_ship_are_those_that_acted(shipped):
  assert set(ROUNDED) == set(shipped.robots)
  for robot, (acted, ships) in ROUNDED.items():
    trained = agents.of(envs.make(robot), shipped.agent(robot))
    assert shipped.config["agents"][robot]["crc32"] == acted, robot
    assert parts.digest(trained.train.params) == ships, robot


def test_what_the_docs_say_of_it(shipped):
  m, text = shipped.meta, (ROOT / "docs/recordings.md").read_text()
  hours = {
    r: sum(
      m["steps"][k] * m["control_s"][k]
      for k in np.flatnonzero((m["robot"] == r) & (m["kind"] == "nominal"))
    )
    / 3600
    for r in shipped.robots
  }
  said = re.search(r"walker (\d+\.\d) hours, car (\d+\.\d), quadruped (\d+\.\d)", text).groups()
  assert [float(x) for x in said] == [
    round(hours[r], 1) for r in ("walker", "car", "quadruped")
  ] and sum(hours.values()) >= 10
  assert {r: d["pasts_that_differ"] for r, d in shipped.config["details"].items()} == {
    "walker": 0,
    "car": 0,
    "quadruped": 1,
  }
  files = sum(p.stat().st_size for p in shipped.folder.iterdir())
  assert files <= 51e6  # goal 45e6, missed: every variable's error is kept


def test_duckdb_reads_it(shipped, monkeypatch):
  text = (ROOT / "docs/recordings.md").read_text()
  code = re.search(r"```python\n(# mean\.py.*?)```", text, re.DOTALL)[1]
  monkeypatch.chdir(ROOT)
  exec(compile(code.replace("print(", "keep("), "mean.py", "exec"), {"keep": (held := []).append})
  rows = held[0].fetchall()
  fault, severity, opr, _ = rows[0]
  m = shipped.meta
  wanted = dict(robot="walker", kind="fault", split="score", fault=fault, severity=severity)
  streams = [k for k in range(len(m["stream"])) if all(m[n][k] == v for n, v in wanted.items())]
  read = lambda k: shipped.get("walker", [int(m["stream"][k])]).residual.opr[:, 0]
  values = np.concatenate([read(k)[int(m["onset"][k]) :] for k in streams])
  # float32 as stored, averaged in float64 by both
  assert len(rows) == 5 and opr == pytest.approx(float(np.nanmean(values.astype(float))), rel=1e-6)


def test_pandas_alone_joins_a_stream(shipped):
  code = re.search(
    r"```python\n(# join\.py.*?)```", (ROOT / "docs/recordings.md").read_text(), re.DOTALL
  ).group(1)
  held = {}
  exec(compile(code, "join.py", "exec"), held)
  one, life = held["one"], held["life"]
  want = shipped.get("walker", [one.stream])
  assert life.step.tolist() == list(range(one.steps)) and want.onset[0] == one.onset
  for name in ("opr", "rpr", "reward", "surprise"):
    np.testing.assert_array_equal(
      life[name].to_numpy(np.float32), getattr(want.residual, name)[:, 0]
    )
  np.testing.assert_array_equal(
    life[[f"group_{k}" for k in range(8)]].to_numpy(np.float32), want.residual.groups[:, 0]
  )


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["walker", "quadruped", "car"])
def test_recorded_again_it_begins_alike(shipped, robot):
  """40 steps of healthy robots by today's code and the agent that was recorded. Its weights were
  rounded to half precision since, which no bound on the largest difference outlives: half of the
  residuals lie within the rounding of the files, and the first rewards.
  """
  env = envs.make(robot)
  seeds, each = shipped.suite.numbers("score")[:4], shipped.suite.nominal["score"]
  keys = stream_keys(seeds, each + 1)[
    np.flatnonzero(np.arange(len(seeds) * (each + 1)) % (each + 1))
  ]
  lanes = [lives.Lane(seed) for seed in seeds for _ in range(each)]
  got = lives.live(
    env, agents.of(env, robot), lanes, keys, np.zeros(len(lanes), int), 64, 0, True, lambda *_: None
  )
  want = shipped.get(robot, shipped.find(robot, "nominal", "score")[: len(lanes)]).residual
  grain = shipped.config["details"][robot]["rounding"]
  ratio = np.abs(np.log(got["opr"][:40] / want.opr[:40]))
  np.testing.assert_array_equal(np.isfinite(got["opr"][:40]), np.isfinite(want.opr[:40]))
  assert np.nanmedian(ratio) < grain["opr"]
  assert np.abs(got["reward"][0] - want.reward[0]).max() <= grain["reward"] / 2 + 0.01
