"""Several agents, faults and severities in one command: their parts, and what they say together."""

import dataclasses
import json
import shutil

import jax
import numpy as np
import pyarrow.parquet
import pytest
from test_cli import content, mjx, refused  # noqa: F401  fixtures
from test_records import row
from test_transfer import agent, saved  # noqa: F401  fixtures: a tiny agent of the car

from mjx_cl import config, envs
from mjx_cl.cli import runs
from mjx_cl.config import RunConfig
from mjx_cl.errors import UserError
from mjx_cl.runs import identity, suite, summary
from mjx_cl.training import agents

WALKER = RunConfig("walker", arms=("detector",))


def of(name, **apart):
  config = RunConfig("walker", agent=name.split("agent=")[-1].split(",")[0], **apart)
  return suite.Part(name, config)


def rows(value, n=10):
  """Streams of one agent that end alike."""
  return [row(k, reward_final=value) for k in range(n)]


def test_parts_are_grouped_by_all_but_their_agent():
  parts = [
    of("gear/agent=a"),
    of("gear/agent=b"),
    of("gear/agent=b,severity=0.5", severity=0.5),
    of("gear/agent=c,severity=0.5", severity=0.5),
    of("lost/severity=0.1,agent=a,steps=9000", severity=0.1, steps=9000),
    of("lost/severity=0.1,agent=b,steps=9000", severity=0.1, steps=9000),
    of("alone/agent=a", steps=7000),
    of("agent=a", seeds=3),
    of("agent=b", seeds=3),
  ]
  groups = suite.by_agent(parts)
  assert {name: list(own) for name, own in groups.items()} == {
    "gear": ["a", "b"],
    "gear/severity=0.5": ["b", "c"],
    "lost/severity=0.1,steps=9000": ["a", "b"],
    "walker": ["a", "b"],
  }
  assert groups["gear"]["b"] is parts[1]


def test_agents_that_differ_widen_the_interval_to_their_own_values():
  """Of two agents that each end alike, 0.2 and 0.8, a bootstrap of agents draws the first twice in
  a quarter of its draws, the second twice in another: the interval ends at 0.2 and 0.8, the middle
  half of both is their mean.
  """
  out = summary.over_agents({"a": rows(0.2), "b": rows(0.8)}, WALKER, 0.025)
  arm = out["arms"]["detector"]
  assert out["agents"] == ["a", "b"] and arm["seeds"] == 20
  assert arm["reward_final"] == pytest.approx(0.5)
  assert arm["reward_final_ci"] == pytest.approx([0.2, 0.8])
  narrow = summary.summarise(rows(0.2) + rows(0.8), WALKER, 0.025)["reward_final_ci"]
  assert narrow[0] > 0.2 and narrow[1] < 0.8


def test_counts_are_drawn_as_shares_and_missing_times_as_infinite():
  """One agent never recovers: the share of the two together may be 0 or 1, the median time has no
  upper end.
  """
  back, lost = rows(0.8, 4), [row(k, recovery_step=None) for k in range(12)]
  arm = summary.over_agents({"a": back, "b": lost}, WALKER, 0.025)["arms"]["detector"]
  assert (arm["recovered"], arm["affected"]) == (4, 16)
  assert arm["recovered_ci"] == pytest.approx([0.0, 16.0])
  assert arm["recovery_median_steps"] is None
  assert arm["recovery_median_steps_ci"] == [4000.0, None]


def test_an_agent_that_no_fault_affects_makes_no_time_infinite():
  """In draws of the second agent alone nobody is there who could recover."""
  back, well = rows(0.8), [row(k, affected=False, recovery_step=None) for k in range(10)]
  arm = summary.over_agents({"a": back, "b": well}, WALKER, 0.025)["arms"]["detector"]
  assert arm["recovery_median_steps"] == 4000.0
  assert arm["recovery_median_steps_ci"] == [4000.0, 4000.0]


def test_no_interval_is_narrower_than_that_of_one_agent():
  """A bootstrap of streams that all end alike has no width; Wilson's interval has."""
  arm = summary.over_agents({"a": rows(0.8), "b": rows(0.8)}, WALKER, 0.025)["arms"]["detector"]
  one = summary.summarise(rows(0.8) * 2, WALKER, 0.025)
  assert arm["recovered_ci"] == pytest.approx(one["recovered_ci"]) and one["recovered_ci"][0] < 20
  assert arm["false_alarms_per_hour_ci"] == one["false_alarms_per_hour_ci"]


def test_the_bootstrap_is_that_of_agents_and_then_of_their_rows():
  """Against a loop with draws of its own; a mean, whose bootstrap needs no more than sums. Ends of
  1,000 draws scatter by some 0.05 of the standard deviation.
  """
  random = np.random.default_rng(1)
  values = [random.normal(m, 30.0, 8) for m in (100.0, 140.0, 170.0)]
  given = {
    f"{k}": [row(i, updates=float(u)) for i, u in enumerate(v)] for k, v in enumerate(values)
  }
  got = summary.over_agents(given, WALKER, 0.025)["arms"]["detector"]
  drawn = [
    np.mean([random.choice(values[k], 8) for k in random.integers(3, size=3)]) for _ in range(4000)
  ]
  assert got["updates_mean"] == pytest.approx(np.mean(values))
  want = np.quantile(drawn, [0.025, 0.975])
  assert got["updates_mean_ci"] == pytest.approx(want, abs=0.25 * np.std(drawn))


def test_the_shipped_agents_numbered():
  assert agents.numbered("car") == agents.numbered("car_real") == ["car", "car-2", "car-3"]
  assert "walker-plain" not in agents.numbered("walker")
  trots = [f"quadruped-trot{end}" for end in ("", "-2", "-3")]
  assert agents.numbered("quadruped") == trots
  own = agents.of(envs.make("quadruped"))  # not the one of the robot's name, which crouches
  assert agents.called(own) == config.own_agent("quadruped") == "quadruped-trot-2"
  with pytest.raises(UserError, match="no agent of 'halfcheetah' ships; shipped: car,"):
    agents.numbered("halfcheetah")


def test_a_shipped_agent_has_its_threshold_however_it_is_named():
  of = lambda agent: identity.threshold_of(
    RunConfig("walker", detector="innovations", agent=agent, arms=("none",))
  )
  assert of(str(agents.HERE / "walker-2")) == of("walker-2") != of("walker") == of(None)


@pytest.fixture
def two(saved, tmp_path):  # noqa: F811
  """Folders of two agents of the car that differ in their weights."""
  other = tmp_path / "other"
  trained = agents.load(str(saved), "car", 67, 2)
  weights = jax.jit(trained.agent.init)(jax.random.key(1))
  agents.save(other, weights, trained.card)
  return [str(saved), str(other)]


SHORT = (  # programs of test_suite.py
  *("run", "car", "--fault", "friction", "--target", "rear", "--steps", "128", "--onset", "64"),
  *("--seeds", "2", "--arm", "none", "--adapt.warmup", "30"),
  *("--detector", "rolling_sigma_plain", "--set", "window=40", "warmup=20"),
)


def test_each_agent_lives_its_run_and_one_table_says_all(
  mjx,  # noqa: F811
  refused,  # noqa: F811
  two,
  tmp_path,
  monkeypatch,
):
  out, alone = tmp_path / "out", tmp_path / "alone"
  code, text, _ = mjx(*SHORT, "--agent", *two, "--out", out)
  assert code == 0 and "all 2" in text and "bootstrap of agents" in text
  parts = [f"agent={name.replace('/', '-')}" for name in two]
  value = json.loads((out / "bench.json").read_text())
  assert list(value["entries"]) == parts and value["agents"]["car"]["agents"] == two
  assert value["agents"]["car"]["arms"]["none"]["seeds"] == 4
  table = pyarrow.parquet.read_table(out / "bench.parquet").to_pydict()
  assert table["agent"] == [two[0]] * 2 + [two[1]] * 2
  assert len(set(table["reward_final"])) == 4

  assert mjx(*SHORT, "--agent", two[1], "--out", alone)[0] == 0
  own = lambda folder: pyarrow.parquet.read_table(folder / "trace.parquet").to_pydict()
  assert own(out / parts[1]) == own(alone)

  before = content(out)
  assert "holds another run" in refused(2, *SHORT, "--agent", *two, "--out", out)
  assert "holds another run" in refused(2, *SHORT, "--agent", *two, "--out", alone)
  assert content(out) == before
  shutil.rmtree(out / parts[0])
  code, text, err = mjx(*SHORT, "--agent", *two, "--out", out, "--resume", "--json")
  assert code == 0 and "1 of 2 parts finished" in err
  assert json.loads(text)["agents"] == value["agents"]
  wrong = refused(2, *SHORT[:-4], "ewmma", "--agent", *two, "--out", out, "--overwrite")
  assert "ewmma" in wrong and (out / parts[1] / "summary.json").exists()
  left = []
  monkeypatch.setattr(runs, "live", lambda *_: left.extend(content(out)) or value)
  assert mjx(*SHORT, "--agent", *two, "--out", out, "--overwrite")[0] == 0
  assert left and not any("agent=" in name for name in left)


def test_one_target_is_of_all_faults(refused, tmp_path):  # noqa: F811
  run = ("run", "car", "--target", "rear", "--out", tmp_path / "out")
  assert "target 'rear'" in refused(2, *run, "--fault", "friction", "bias")
  assert "grip" in refused(2, *run, "--fault", "friction", "grip")
  assert not (tmp_path / "out").exists()


def test_each_fault_and_severity_is_a_run_of_its_own(mjx, tmp_path):  # noqa: F811
  """Bit for bit the run of that fault alone."""
  plain = [*SHORT[:2], *SHORT[6:]]
  both, alone = tmp_path / "both", tmp_path / "alone"
  given = ("--fault", "friction", "offset", "--severity", "0.4", "0.6")
  code, text, _ = mjx(*plain, *given, "--out", both)
  parts = [f"fault={f},severity={s}" for f in ("friction", "offset") for s in (0.4, 0.6)]
  assert code == 0 and all(name in text for name in parts)
  assert list(json.loads((both / "bench.json").read_text())["entries"]) == parts
  assert mjx(*plain, "--fault", "offset", "--severity", "0.6", "--out", alone)[0] == 0

  def own(folder):
    """The life, and losses that nothing acts on: another number of threads sums them otherwise."""
    table = pyarrow.parquet.read_table(folder / "trace.parquet").to_pydict()
    losses = [table.pop(name) for name in ("dyn_loss", "adv_mag", "value_loss")]
    return str(table), np.array(losses, float)

  lived, losses = own(both / parts[-1])
  assert lived == own(alone)[0] != own(both / parts[-2])[0]
  np.testing.assert_allclose(losses, own(alone)[1], rtol=1e-4)


def test_parts_are_named_after_what_differs():
  run = dataclasses.replace(WALKER, fault="gear")
  choices = {"fault": ["gear", "walker/gear-half"], "severity": [None], "agent": ["walker"]}
  names = [part.name for part in suite.of_each(run, choices).parts]
  assert names == ["fault=gear", "fault=walker-gear-half"]
  choices |= {"fault": ["gear"], "severity": [0.5, 1.0], "agent": ["walker", "walker-2"]}
  parts = suite.of_each(run, choices).parts
  assert parts[1].name == "severity=0.5,agent=walker-2"
  assert (parts[1].config.severity, parts[1].config.agent) == (0.5, "walker-2")
  assert set(suite.by_agent(parts)) == {"severity=0.5", "severity=1.0"}


@pytest.mark.parametrize(
  "more, words",
  [
    (("--agent", "car", "car"), "name each agent once; got car twice"),
    (("--agent", "car", "wlker"), "no agent 'wlker'"),
    (("--agent", "car", "walker"), "was trained on 'walker', not on 'car'"),
    (("--agent", "car", ""), "empty name"),
    (("--agent", "car", "all"), "'all' stands alone"),
    (("--agent", "all", "--track", "csv"), "--track is of one run"),
    (("--agent", "all", "--resume", "--overwrite"), "exclude each other"),
    (("--agent", "all", "--stops", "x"), "--stops is of one run"),
    (("--fault", "bias"), "--fault is there twice"),
    (("--set", "slack=1", "--set", "threshold=9"), "--set is there twice"),
    (("--severity", "0.5", "0.50"), "name each severity once; got 0.5 twice"),
    (("--severity", "0.5", "2"), "severity"),
    (("--severity",), "--severity got no value"),
    (("--agent", "car", "--agent", "car-2"), "--agent is there twice"),
  ],
)
def test_what_several_agents_refuse_is_one_line(refused, tmp_path, more, words):  # noqa: F811
  assert words in refused(2, *SHORT, *more, "--out", tmp_path / "out")
  assert not (tmp_path / "out").exists()
