"""What a run writes down: streams that are adapting when their fault comes, and results that are
scored anew.
"""

import json
import pathlib
import shutil

import pytest

from mjx_cl.config import RunConfig
from mjx_cl.io import tables
from mjx_cl.runs import records, summary

RESULTS = pathlib.Path(__file__).parents[2] / "results"


def row(stream, **other):
  return {
    "stream": stream,
    "arm": "detector",
    "seed": stream,
    "change": 0,
    "onset": 5000,
    "alarm_step": 5100,
    "latency_steps": 100,
    "latency_s": 2.5,
    "false_alarms": 0,
    "outcome": "converged",
    "affected": True,
    "recovery_step": 9000,
    "reward_pre": 0.9,
    "reward_drop": 0.3,
    "reward_final": 0.85,
    "return_lost": 500.0,
    "return_lost_healthy": None,
    "adapted_steps": 6000,
    "updates": 300,
    "terminations": 0,
  } | other


def event(stream, step, kind):
  return {"stream": stream, "step": step, "kind": kind}


EVENTS = [
  event(0, 5120, "start"),
  event(0, 11_000, "stop"),  # after the onset: as it should be
  event(1, 3000, "start"),
  event(1, 5100, "alarm"),
  event(1, 12_000, "stop"),  # under way
  event(2, 1000, "start"),
  event(2, 4900, "stop"),  # over in time
  event(3, 1000, "start"),
  event(3, 4000, "abort"),
  event(3, 5000, "start"),  # the step of the onset is not before it
  event(4, 1000, "start"),
  event(4, 3000, "stop"),
  event(4, 4999, "start"),
]


def test_a_stream_that_is_adapting_at_the_onset_has_no_latency():
  rows = records.set_apart([row(k) for k in range(5)] + [row(5, onset=None)], EVENTS)
  assert [r["adapting_at_onset"] for r in rows] == [False, True, False, False, True, False]
  assert [r["latency_steps"] for r in rows] == [100, None, 100, 100, None, 100]
  assert all(
    r[k] is None for r in (rows[1], rows[4]) for k in ("alarm_step", "latency_steps", "latency_s")
  )
  soon = [event(0, 5055, "start") | {"since": 4998}, event(1, 5055, "start") | {"since": 5000}]
  rows = records.set_apart([row(0), row(1)], soon)  # a chunk's end follows what started it
  assert [r["adapting_at_onset"] for r in rows] == [True, False]
  later = records.set_apart([row(0, change=1, onset=8000), row(2, change=1, onset=8000)], EVENTS)
  assert [r["adapting_at_onset"] for r in later] == [True, False]


def test_it_is_neither_a_detection_nor_a_miss_and_recovers_all_the_same():
  rows = records.set_apart(
    [row(k, latency_steps=None if k == 2 else 100 + 500 * (k == 3)) for k in range(5)], EVENTS
  )
  out = summary.summarise(rows, RunConfig("walker"), 0.025)
  assert (
    out["seeds"],
    out["affected"],
    out["adapting_at_onset"],
    out["affected_watched"],
    out["recovered"],
  ) == (5, 5, 2, 3, 5)
  assert (out["alarms"], out["affected_alarmed_within_500"]) == (2, 1)
  assert (
    out["miss_probability"] == pytest.approx(1 / 3) and out["latency_median_steps"] == 600
  )  # of 100, 600 and a miss
  alone = summary.summarise(records.set_apart([row(1), row(4)], EVENTS), RunConfig("walker"), 0.025)
  assert (
    alone["latency_median_steps"] is None
    and alone["miss_probability"] is None
    and alone["alarms"] == 0
  )


def test_every_aggregate_has_an_interval():
  out = summary.summarise(
    records.set_apart([row(k) for k in range(5)], EVENTS), RunConfig("walker"), 0.025
  )
  bare = {k for k in out if not k.endswith("_ci") and k + "_ci" not in out}
  assert bare == {"seeds"}  # a setting
  low, high = out["false_alarms_per_hour_ci"]
  assert out["false_alarms_per_hour"] == 0 == low and high == pytest.approx(
    3.689 / (5 * 5000 * 0.025 / 3600), rel=1e-3
  )  # Garwood: 0 events


@pytest.mark.parametrize(
  "part, apart", [("full/car/fault=offset,severity=0.25", 2), ("walker_gear", 0)]
)
def test_published_results_are_scored_by_todays_definitions(tmp_path, part, apart):
  """Scoring a published run anew changes nothing of what it says already; a run without such
  streams only gains the columns.
  """
  shutil.copytree(RESULTS / part, tmp_path / "run")
  before = json.loads((tmp_path / "run/summary.json").read_text())["arms"]["detector"]
  config = tables.read_json(tmp_path / "run/config.json")
  rows = [tables.read_rows(tmp_path / f"run/{name}.parquet") for name in ("runs", "events")]
  rows = records.set_apart(*rows)
  run = RunConfig(config["env"], steps=config["steps"], arms=tuple(config["arms"]))
  after = summary.by_arm(rows, run, config["control_s"])["arms"]["detector"]
  assert after["adapting_at_onset"] == apart
  assert {k: v for k, v in after.items() if k in before and not k.endswith("_ci")} == {
    k: v for k, v in before.items() if not k.endswith("_ci")
  }
  assert sum(r["adapting_at_onset"] for r in rows if r["arm"] == "detector") == apart
