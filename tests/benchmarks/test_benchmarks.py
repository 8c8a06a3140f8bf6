"""Benchmarks that measure a learner: what they hand to others' code, and that what they learn moves
the right way.
"""

import dataclasses
import importlib.util
import json
import os
import pathlib
import re
import subprocess
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import quick
from flax import serialization
from test_agent import shake

from mjx_cl import detectors, envs, faults
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import tables
from mjx_cl.training import agents, demonstrator

FOLDER = pathlib.Path(__file__).parents[2] / "benchmarks"


def load(name):
  spec = importlib.util.spec_from_file_location(f"benchmark_{name}", FOLDER / f"{name}.py")
  module = importlib.util.module_from_spec(spec)
  spec.loader.exec_module(module)
  return module


@pytest.fixture(scope="module")
def ppo():
  return load("ppo_finetune")


@pytest.fixture(scope="module")
def tiny_net():
  """brax's networks for 3 observations and 1 action, with parameters."""
  from brax.training.acme import running_statistics, specs
  from brax.training.agents.ppo import networks

  net = networks.make_ppo_networks(
    3,
    1,
    running_statistics.normalize,
    policy_hidden_layer_sizes=(16,),
    value_hidden_layer_sizes=(16,),
  )
  normaliser = running_statistics.init_state(specs.Array((3,), jnp.float32))
  return net, {
    "normaliser": normaliser,
    "policy": net.policy_network.init(jax.random.key(0)),
    "value": net.value_network.init(jax.random.key(1)),
  }


def rows_of(net, params, key, steps=64):
  obs = jax.random.normal(key, (steps, 3))
  logits = net.policy_network.apply(params["normaliser"], params["policy"], obs)
  raw = net.parametric_action_distribution.sample_no_postprocessing(
    logits, jax.random.fold_in(key, 1)
  )
  action = jnp.tanh(raw)
  none = jnp.zeros(steps, bool)
  reward = -jnp.square(action[:, 0] - 0.5)
  return (
    types.SimpleNamespace(
      obs=obs,
      action=action,
      reward=reward,
      terminated=none,
      truncated=none.at[-1].set(True),
      final_obs=jnp.roll(obs, -1, 0),
    ),
    raw,
    logits,
  )


def test_ppo_transitions_recover_what_the_policy_drew(ppo, tiny_net):
  net, params = tiny_net
  rows, raw, logits = rows_of(net, params, jax.random.key(3))
  out = ppo.transitions(net, params, rows)
  extras = out.extras["policy_extras"]
  assert np.ptp(np.asarray(raw)) > 1.0
  np.testing.assert_allclose(
    extras["raw_action"], raw, atol=1e-4
  )  # float32 tanh and back, |raw| < 3
  np.testing.assert_allclose(
    extras["log_prob"], net.parametric_action_distribution.log_prob(logits, raw), atol=1e-3
  )
  assert out.extras["state_extras"]["truncation"].sum() == 1 and (out.discount == 1).all()
  rows.terminated = rows.terminated.at[5].set(True)
  rows.truncated = rows.truncated.at[5].set(True)
  out = ppo.transitions(net, params, rows)
  assert (
    out.discount[5] == 0 and out.extras["state_extras"]["truncation"][5] == 0
  )  # a fall at the time limit is a fall


def test_ppo_update_climbs(ppo, tiny_net):
  """A reward of -(a - 0.5)^2 draws the actions to 0.5; the normaliser stays."""
  net, params = tiny_net
  settings = {"entropy_cost": 0.0, "discounting": 0.0, "reward_scaling": 1.0}
  init, update = ppo.make_update(net, settings, 3e-3, 4, 2)
  state = (params, init(params))
  earned = []
  for i in range(15):
    parts = [
      rows_of(net, state[0], jax.random.fold_in(jax.random.key(7), 10 * i + j))[0] for j in range(4)
    ]
    earned.append(float(np.mean([p.reward for p in parts])))
    data = jax.tree.map(
      lambda *x: jnp.stack(x), *[ppo.transitions(net, state[0], p) for p in parts]
    )
    state = jax.jit(update)(*state, data, jax.random.key(i))
  assert earned[0] < -0.3 and np.mean(earned[-3:]) > 0.6 * earned[0]
  same = jax.tree.map(
    lambda a, b: bool(jnp.all(a == b)), state[0]["normaliser"], params["normaliser"]
  )
  assert jax.tree.all(same)


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
  """What a training of the walker's demonstrator leaves, untrained."""
  out = tmp_path_factory.mktemp("ppo")
  (out / "latest.msgpack").write_bytes(
    serialization.to_bytes(demonstrator._template(envs.make("walker", "native")))
  )
  (out / "curve.json").write_text(json.dumps([{"step": 0, "return": 10.0, "seconds": 0.0}]))
  return out


def test_ppo_finetunes_from_the_onset_on_and_the_other_arm_not(ppo, policy, tmp_path):
  args = ppo.parser().parse_args(
    [
      "walker",
      "--policy",
      str(policy),
      "--fault",
      "walker/gear-half",
      "--onset",
      "1088",
      "--steps",
      "1400",
      "--seeds",
      "2",
      "--horizon",
      "128",
      "--minibatches",
      "2",
      "--epochs",
      "2",
      "--lr",
      "0.001",
      "--keep",
      str(tmp_path / "r.parquet"),
    ]
  )
  value = ppo.measure(args)
  table = pq.read_table(tmp_path / "r.parquet").to_pydict()
  of = lambda arm, seed: np.asarray(
    [r for r, a, s in zip(table["reward"], table["arm"], table["seed"]) if (a, s) == (arm, seed)]
  )
  first = 1088 + 128  # control step after which the first update acts
  for seed in (0, 1):
    a, b = of("ppo", seed), of("ppo-none", seed)
    assert len(a) == 1400
    np.testing.assert_array_equal(a[:first], b[:first])
    assert not np.array_equal(a[first:], b[first:])
  assert not np.array_equal(of("ppo", 0), of("ppo", 1))
  assert value["arms"]["ppo"]["updates"] == 2 * 2 * 2 and value["arms"]["ppo-none"]["updates"] == 0
  rows = {(r["arm"], r["seed"]): r for r in value["rows"]}
  assert rows["ppo", 0]["reward_pre"] == pytest.approx(of("ppo-none", 0)[1000:1088].mean())
  lost = [rows["ppo", s]["return_lost"] / rows["ppo-none", s]["return_lost"] for s in (0, 1)]
  weight = [rows["ppo-none", s]["return_lost"] for s in (0, 1)]
  share = 100 * (1 - np.average(lost, weights=weight))
  assert value["arms"]["ppo"]["score"] == pytest.approx(share)
  assert json.loads(json.dumps(value))["policy"]["step" + "s"] == 0


@pytest.mark.parametrize(
  "words, message",
  [
    (["--horizon", "100"], "multiple of 64 x minibatches"),
    (["--lr", "0"], "lr must be above 0"),
    (["--fault", "nonsense"], "nonsense"),
    (["--policy", "nowhere"], "nowhere holds no PPO policy of 'walker'; train one with"),
    (["--fault", "walker/gear-half", "--onset", "-1"], "onset must lie in"),
  ],
)
def test_ppo_bad_input_is_one_line(ppo, policy, words, message):
  with pytest.raises(UserError, match=message):
    ppo.measure(ppo.parser().parse_args(["walker", "--policy", str(policy), *words]))


@pytest.mark.slow  # a script of one experiment
def test_policy_gradient_moves_the_policy_by_what_it_says(tiny, tmp_path):
  """Of an agent with made-up heads: five policies at the distances asked for; the unmoved one
  promises and gains nothing on itself, the others differ.
  """
  train = quick.jit(tiny.init)(jax.random.key(0))
  params = shake(train.params)
  bins = np.sign(tiny.bins) * np.log1p(np.abs(np.asarray(tiny.bins)))
  for name in ("rew", "val"):  # predictions near 1, not near the bins' 5e8
    params[name]["out"]["bias"] -= 4 * jnp.abs(jnp.asarray(bins) - 0.5)
  agents.save(
    tmp_path / "agent",
    train._replace(params=params, slow=params["val"], range=jnp.array([0.0, 1.0])),
    {"env": "walker", "preset": "tiny", "repeat": 1, "dreamer": dataclasses.asdict(tiny.config)},
  )
  module = load("policy_gradient")
  value = module.measure(
    module.parser().parse_args(
      [
        "walker",
        "--agent",
        str(tmp_path / "agent"),
        "--robots",
        "4",
        "--steps",
        "64",
        "--records",
        "64",
        "--batches",
        "4",
      ]
    )
  )
  still, *moved = value["rows"]
  assert still["step"] == still["promise"] == still["gain"] == still["moved"] == 0.0
  assert [r["step"] for r in moved] == pytest.approx([0.02, -0.02, 0.06, -0.06])
  np.testing.assert_allclose(
    [r["moved"] for r in moved], [0.02, 0.02, 0.06, 0.06], rtol=0.2
  )  # nearly linear in the step
  assert len({r["reward"] for r in value["rows"]}) == 5 and all(r["promise"] for r in moved)
  assert json.loads(json.dumps(value)) == value


# ---- calibrate.py --------------------------------------------------------------------------------


@pytest.mark.parametrize(
  "settings",
  [
    dict(window=400, threshold=3.0, patience=10),
    dict(window=400, smooth=100, lag=50, threshold=6.0),
    dict(window=300, threshold=3.0, two_sided=True),
  ],
  ids=["in a row", "smoothed", "as written"],
)
def test_calibration_runs_the_detector_that_it_calibrates(settings):
  """The NumPy scores and alarms of the calibration are those of `rolling_sigma` on the same stream,
  with a shift, a spike and gaps in it.
  """
  calibrate = load("calibrate")
  settings = {"patience": 1, "two_sided": False, "smooth": 1, "lag": 0} | settings
  rng = np.random.default_rng(5)
  x = rng.lognormal(0, 0.3, 3000).astype(np.float32)
  x[1500:1600] *= 6
  x[2300] = 40.0
  x[rng.integers(0, 3000, 60)] = np.nan
  z = calibrate.scores(
    x[:, None].astype(np.float64), settings["window"], settings["smooth"], settings["lag"], 200
  )
  fired = calibrate.alarms(z, settings["threshold"], settings["patience"], settings["two_sided"])[
    :, 0
  ]
  detector = detectors.rolling_sigma(warmup=200, **settings)
  good = np.flatnonzero(np.isfinite(x))
  _, out = jax.lax.scan(detector.update, detector.init(), jnp.asarray(x[good]))
  z = np.abs(z[good, 0]) if settings["two_sided"] else z[good, 0]
  # float32 sums of some hundred terms: 1e-5 of each, a few times that of the deviation
  np.testing.assert_allclose(np.asarray(out.score), z, rtol=1e-3, atol=1e-3)
  assert (
    np.array_equal(good[np.asarray(out.fired)], np.flatnonzero(fired)) and 1 <= fired.sum() < 100
  )


def test_settled_stretches_of_a_run(tmp_path):
  """From the rows of refitting before a stream's first stop to its next onset; a stream that never
  stopped has none, and scoring seeds are refused.
  """
  calibrate = load("calibrate")
  config = {"first_seed": 100, "seeds": 3, "steps": 900, "adapt": {"refit": 50}}
  tables.write_json(tmp_path / "config.json", config)
  rows = [
    (0, 9, "onset"),
    (0, 20, "start"),
    (0, 199, "stop"),
    (0, 500, "onset"),
    (0, 700, "stop"),
    (1, 20, "start"),
    (2, 20, "start"),
    (2, 29, "stop"),
  ]
  tables.write_table(
    tmp_path / "events.parquet",
    {"stream": [r[0] for r in rows], "step": [r[1] for r in rows], "kind": [r[2] for r in rows]},
  )
  step = np.tile(np.arange(900), 3)
  tables.write_table(
    tmp_path / "trace.parquet",
    {
      "stream": np.repeat([0, 1, 2], 900),
      "step": step,
      "opr": np.repeat([0, 1, 2], 900) * 1000.0 + step,
      "rpr": -1.0 * step,
    },
  )
  first, last = calibrate.settled(tmp_path)
  assert (
    first["skip"] == 50
    and np.array_equal(first["opr"], np.arange(150, 500))
    and np.array_equal(first["rpr"], -np.arange(150, 500))
  )
  assert last["skip"] == 30 and np.array_equal(last["opr"], 2000 + np.arange(900))
  tables.write_json(tmp_path / "config.json", config | {"first_seed": 0})
  with pytest.raises(SystemExit, match="those that tune"):
    calibrate.settled(tmp_path)


@pytest.mark.slow  # a script of one experiment
def test_socks_at_the_healthy_grip_are_none_and_less_grip_costs(monkeypatch):
  """Cars of two seeds at three coefficients in one program: the friction that MuJoCo gets, and cars
  without any fault beside the first column.
  """
  from mjx_cl.config import PRESETS
  from mjx_cl.dreamer.agent import Agent
  from mjx_cl.rollout.scan import Rollout, nest, start

  socks = load("socks")
  monkeypatch.setattr(socks, "CHUNK", 20)
  env = envs.make("car_real")
  agent = Agent(PRESETS["tiny"].dreamer, len(env.spec.obs), len(env.spec.act))
  params = quick.jit(jax.vmap(lambda k: agent.init(k).params))(
    jax.random.split(jax.random.key(0), 2)
  )
  acting = types.SimpleNamespace(acting=lambda g: jax.tree.map(lambda x: x[g], params))
  runner = types.SimpleNamespace(trained=types.SimpleNamespace(agent=agent), lives=acting)
  seen = []

  class Watched(Rollout):
    def __init__(self, *args):
      super().__init__(*args)
      chunk = self.chunk
      self.chunk = lambda params, streams, length: (
        seen.append((self, streams)) or chunk(params, streams, length)
      )

  monkeypatch.setattr(socks, "Rollout", Watched)
  grips = (0.65, 0.3, 0.1)
  reward, crashes = socks.drive(runner, [100, 101], grips, drives=3, steps=40)
  assert (
    reward.shape == crashes.shape == (2, 3) and np.isfinite(reward).all() and (crashes >= 0).all()
  )
  rollout, streams = seen[-1]
  mj = quick.jit(jax.vmap(jax.vmap(lambda s: rollout._drive(s, s.key, jnp.zeros(2))[1].model)))(
    streams
  ).mj
  wheel = {
    side: np.asarray(mj["geom_friction"])[..., env.mj_model.geom(f"wheel_{side}").id, 0]
    for side in ("front_left", "rear_right")
  }
  np.testing.assert_allclose(
    wheel["rear_right"], np.tile(np.repeat(grips, 3).reshape(3, 3), (2, 1)), rtol=1e-6
  )  # float32
  assert (wheel["front_left"] == wheel["front_left"][0, 0]).all()
  none = faults.none(env)
  streams = nest(lambda k: start(env, agent, none, k), 0, 0)(
    jnp.stack(
      [jax.random.split(jax.random.fold_in(jax.random.key(s), socks.KEY), 3) for s in (100, 101)]
    )
  )
  rollout, own = Rollout(env, agent, none), []
  for _ in range(2):
    streams, rows = rollout.chunk(params, streams, 20)
    own.append(np.asarray(rows.reward).mean((0, 2)))
  np.testing.assert_allclose(reward[:, 0], np.mean(own, 0), rtol=1e-6)
  assert (reward[:, 1:] != reward[:, :1]).all()


@pytest.mark.parametrize("given", [[], ["nosuch"], ["update", "learn"]])
def test_compile_time_names_its_programs(given):
  done = subprocess.run(
    [sys.executable, FOLDER / "compile_time.py", *given], capture_output=True, text=True
  )
  assert (
    done.returncode == 1
    and done.stderr == "usage: python benchmarks/compile_time.py update|watch|learn\n"
  )


ALIKE = [p.name for p in FOLDER.glob("*.py") if re.search(r"^from benchmarks", p.read_text(), re.M)]


@pytest.mark.parametrize("name", ALIKE)
def test_a_script_finds_its_neighbours_from_anywhere(name, tmp_path):
  """As its row has it, `python benchmarks/NAME`: the folder is no part of the package."""
  environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
  told = [sys.executable, FOLDER / name, "--help"]
  got = subprocess.run(told, cwd=tmp_path, env=environment, capture_output=True, text=True)
  assert got.returncode == 0 and got.stdout.startswith("usage: "), got.stderr


def test_the_thresholds_that_ship_are_those_of_the_board(tmp_path):
  thresholds, root = load("thresholds"), FOLDER.parent
  ships = json.loads(thresholds.FILE.read_text())
  assert thresholds.joined([root / name for name in thresholds.BOARDS]) == ships
  first, *later = (
    own["car"]
    for name in thresholds.BOARDS
    if "car" in (own := thresholds.collect(root / name)["robots"])
  )
  assert [[*own] for own in later] == [["learnt"], ["innovations"]]
  assert ships["robots"]["car"] == first | later[0] | later[1]
  (tmp_path / "often").mkdir()
  about = json.loads((root / "results/learnt/car/leaderboard.json").read_text())
  text = json.dumps(about | {"arl0_target": 10_000})
  (tmp_path / "often/leaderboard.json").write_text(text)
  table = pq.read_table(root / "results/learnt/car/leaderboard.parquet")
  pq.write_table(table, tmp_path / "often/leaderboard.parquet")
  with pytest.raises(FileError, match="boards at ARL0 100,000 and 10,000"):
    thresholds.joined([root / thresholds.BOARDS[0], tmp_path / "often"])
  for name, text, words in (
    (None, "", "is missing"),
    ("leaderboard.json", "{}", "not a leaderboard's"),
    ("leaderboard.json", "[", "cannot read"),
  ):
    folder = tmp_path / f"{name}{len(text)}"
    folder.mkdir()
    if name:
      (folder / name).write_text(text)
      pq.write_table(
        pq.read_table(root / "results/leaderboard_100k/leaderboard.parquet"),
        folder / "leaderboard.parquet",
      )
    with pytest.raises(FileError, match=words):
      thresholds.collect(folder)
  (folder / "leaderboard.json").write_text(
    (root / "results/leaderboard_100k/leaderboard.json").read_text()
  )
  (folder / "leaderboard.parquet").write_text("no table")
  with pytest.raises(FileError, match="not a leaderboard's table"):
    thresholds.collect(folder)


def test_host_call_measures_both_forms(monkeypatch):
  """Each form's program is made and traced in that form, and the next one finds things as they
  were.
  """
  from mjx_cl.physics import host_call

  monkeypatch.syspath_prepend(FOLDER)
  bench, asked, ways = load("host_call"), host_call.registered, []

  def make():
    x, program = np.zeros(2, np.uint32), lambda x: host_call.call("nothing", "", 2, x)
    ways.append("pure_callback" in str(jax.make_jaxpr(program)(x)))
    compiled = quick.jit(program)
    return lambda: compiled(x).block_until_ready()

  nothing = host_call.shared("nothing", lambda: lambda word, x: x)
  times = bench.measure(make, 1)
  assert (
    ways == [False, True]
    and list(times) == list(bench.FORMS)
    and min(times.values()) > 0
    and host_call.registered is asked
  )
  del nothing


def test_gpu_rows_are_measured_where_there_is_one(monkeypatch):
  bench, asked = load("dreamer_update"), []
  clock = types.SimpleNamespace(
    measure=lambda variants, rounds: asked.append(variants) or {"one": 0.02, "ten": 0.1}
  )
  monkeypatch.setattr(bench, "updater", lambda size, **options: (size, options))
  assert bench.on_gpu(clock) == (None, None) and not asked  # on a CPU nothing is guessed
  monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
  np.testing.assert_allclose(bench.on_gpu(clock), (20, 10))
  assert asked == [{"one": ("size12m", {}), "ten": ("size12m", {"seeds": 10, "how": "vmap"})}]


def test_slices_of_an_accelerator_go_on_and_say_what_is_missing(tmp_path, monkeypatch):
  """What is cut off is begun again by the next call, what is done is not; the time of a run adds
  up; a machine that has not measured a row says so.
  """
  bench, asked, cut = load("accelerator"), [], {"training", "run"}
  args = types.SimpleNamespace(quick=True, out=tmp_path, minutes=60.0)

  def measured(task, args, left):
    asked.append(task)
    return {"machine": "chip"} if task == "machine" else {f"{task.partition('-')[0]}, {task}": 2.0}

  def command(words, out, left):
    asked.append({"train": "training"}.get(words[0], words[0]))
    over = asked[-1] not in cut
    cut.discard(asked[-1])
    return over

  monkeypatch.setattr(bench, "measured", measured)
  monkeypatch.setattr(bench, "command", command)
  monkeypatch.setattr(bench, "trained", lambda out: {"training, 2 seeds": 1234.5})
  assert [bench.work(args) for _ in range(4)] == [False, False, True, True]
  streams = [f"streams-{n}" for n in bench.QUICK["streams"]]
  whole = ["update", "machine", "training", "training", *streams, "run", "run"]
  assert asked == whole
  other = tmp_path / "other.json"
  other.write_text(json.dumps({"machine": "cores", "rows": {"update, update": 4.0}}))
  lines = bench.table([other, tmp_path / "rows.json"]).splitlines()
  assert lines[0] == "| | cores | chip |"
  assert "| update, update [ms] | 4 | 2 |" in lines
  assert "| training, 2 seeds [records/s] | not measured | 1,234 |" in lines


@pytest.mark.parametrize("seeds", [1, 3])
def test_learning_curve_names_its_axes_and_covers_no_line(tmp_path, monkeypatch, seeds):
  """Two folders in, tables and a figure out: the rows in which episodes ended, the second
  training's after the first's, the legend apart from the axes.
  """
  from matplotlib.figure import Figure

  curve, rng, chunks = load("learning_curve"), np.random.default_rng(0), 40
  row = lambda k: (
    {
      "updates": 8 * k,
      "records": 64 * k,
      "seconds": 2.0 * k,
      "phase": "pure",
      "return": None if k % 2 else float(k),
    }
    | (
      {f"return/{g}": None if k % 2 else float(k + rng.normal()) for g in range(seeds)}
      if seeds > 1
      else {}
    )
  )
  for name in ("first", "then"):
    (tmp_path / name).mkdir()
    rows = [row(k) for k in range(1, chunks + 1)]
    if name == "then":
      rows = [{k: v for k, v in r.items() if "/" not in k} for r in rows]
    tables.write_table(
      tmp_path / name / "metrics.parquet",
      {k: np.array([r[k] for r in rows], str if k == "phase" else float) for k in rows[0]},
    )
  seen = []

  def saved(self, path, **kwargs):
    self.canvas.draw()
    (legend,) = self.legends
    boxes = [x.get_window_extent() for x in self.axes]
    seen.append(
      (
        [x.get_xlabel() for x in self.axes],
        [t.get_text() for t in legend.get_texts()],
        any(legend.get_window_extent().overlaps(b) for b in boxes),
      )
    )

  monkeypatch.setattr(Figure, "savefig", saved)
  monkeypatch.setattr(
    sys,
    "argv",
    [
      "learning_curve.py",
      str(tmp_path / "first"),
      str(tmp_path / "out"),
      "--published",
      "--then",
      str(tmp_path / "then"),
    ],
  )
  curve.main()
  ((labels, lines, covers),) = seen
  assert (
    labels == ["updates of each seed", "records of each seed [million]", "wall time [h]"]
    and not covers
  )
  # each seed; mean and interval of several; what went on; the published curve
  assert len(lines) == len(set(lines)) == {1: 1 + 2, 3: 3 + 2 + 2}[seeds]
  table, then = (
    tables.read_table(tmp_path / "out" / f"{name}.parquet") for name in ("curve", "then")
  )
  np.testing.assert_array_equal(table["updates"], 8 * np.arange(2, chunks + 1, 2))
  np.testing.assert_array_equal(then["records"], 64 * (chunks + np.arange(2, chunks + 1, 2)))
  np.testing.assert_array_equal(then["seconds"], 2 * (chunks / seeds + np.arange(2, chunks + 1, 2)))


def test_won_back_is_a_mean_of_agents_and_refuses_what_lost_nothing(tmp_path, capsys):
  """By hand: shares 0.5 and 1 of one agent, 0 and 0.5 of another; two agents bound the interval."""

  def part(name, finals, none=0.4):
    rows = [
      {"stream": k, "seed": k % 2, "arm": arm, "onset": 9, "reward_pre": 0.8, "reward_final": final}
      for k, (arm, final) in enumerate(
        [*(("oracle", x) for x in finals), ("none", none), ("none", none)]
      )
    ]
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / name / "runs.parquet")

  won_back = load("won_back")
  for name, finals in (("a", (0.6, 0.8)), ("b", (0.4, 0.6))):
    (tmp_path / name).mkdir()
    part(name, finals)
  won_back.main(str(tmp_path))
  oracle, none = map(json.loads, capsys.readouterr().out.splitlines())
  assert oracle["won_back"] == pytest.approx(0.5) and oracle["streams"] == 4
  # a draw is a mean of four shares: 1 in 64 is 0, 1 in 64 is 1, 4 in 64 each lie 0.125 within
  assert oracle["won_back_ci"] == pytest.approx([0.125, 0.875])
  assert none["won_back"] == 0 and none["more"] == pytest.approx(-0.5)
  part("b", (0.8, 0.8), none=0.79)
  with pytest.raises(SystemExit, match="b/runs.parquet: seed 0 loses less than a tenth"):
    won_back.main(str(tmp_path))
  with pytest.raises(SystemExit, match="holds no parts"):
    won_back.main(str(tmp_path / "a"))


def test_ends_are_paired_by_hand(tmp_path, capsys):
  """One method ends 0.1 to 0.2 below `none` in eight pairs, another level with it."""
  life = {"robot": "walker", "setting": "dark", "agent": "walker"}
  off = {"none": [0.0] * 8, "worse": [-0.1, -0.2] * 4, "level": [0.1, -0.1] * 4, "short": [0.0] * 3}
  rows = [
    life | {"method": method, "seed": seed, "reward_final": 0.5 + x + 0.01 * seed}
    for method, own in off.items()
    for seed, x in reversed(list(enumerate(own)))
  ]
  pq.write_table(pa.Table.from_pylist(rows), tmp_path / "methods_lives.parquet")
  load("ends").main(tmp_path)
  worse, level, short = capsys.readouterr().out.splitlines()
  # by sign flips two of 2^8 are as far out: 0.008, below 0.05 / 3
  assert worse.startswith("walker: dark, worse: 0.39, none 0.54, difference -0.150 [-0.1")
  assert worse.endswith("8 pairs, p 0.008; after Holm: below")
  assert "difference -0.000" in level.replace(" 0.000", " -0.000")
  assert level.endswith("after Holm: not told apart") and "3 pairs" in short


def test_two_methods_are_set_apart_by_hand(tmp_path, capsys):
  """Two agents, each alone one end of the interval: 10 of 100 more lost and 0.1 lower at the end of
  0.4 that the fault takes, and nothing; a life that the fault costs nothing does not count.
  """
  rows = [
    {"agent": agent, "method": method, "seed": seed, "affected": seed > 0 if none else None}
    | {"return_lost": 100.0 if none else 20.0 + (10 if worse and seed else 0), "reward_pre": 0.9}
    | {"reward_final": 0.5 if none else 0.8 - (0.1 if worse and seed else 0)}
    for agent in ("a", "b")
    for method in ("one", "two", "none")
    for seed in range(3)
    for none, worse in [(method == "none", (agent, method) == ("a", "one"))]
  ]
  pq.write_table(pa.Table.from_pylist(rows), tmp_path / "methods_lives.parquet")
  apart = load("apart")
  apart.main(str(tmp_path), "one", "two")
  assert capsys.readouterr().out.splitlines() == [
    "return lost, share: 0.050 [0.000, 0.100], 4 lives",
    "reward at the end: -0.050 [-0.100, 0.000], 4 lives",
    "share of the loss at the end: -0.125 [-0.250, 0.000], 4 lives",
  ]
  with pytest.raises(SystemExit, match="no lives of one and three"):
    apart.main(str(tmp_path), "one", "three")
