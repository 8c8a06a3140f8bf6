"""Which charts `multichart` holds: python benchmarks/multichart.py [--out results/multichart.json]

Scores every detector that has a threshold on the shipped streams of the faults and seeds that tune,
which no score of the leaderboard is of: thresholds at the board's ARL0, the board's standard cost
score (0 never alarming, 100 alarming at the onset), false alarms those of the streams that
calibrate. The best one of each robot is a chart; that set and, beside it, the sets that lack one of
them are scored the same way.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import sys

import numpy as np

from mjx_cl.io import runtime

runtime.setup()

from mjx_cl import detectors
from mjx_cl.cli import app
from mjx_cl.detectors.baselines import REFERENCES  # noqa: E402
from mjx_cl.io import tables as store  # noqa: E402
from mjx_cl.leaderboard import calibration, streams, sweep
from mjx_cl.leaderboard import entries as entries_of
from mjx_cl.leaderboard import program as program_of
from mjx_cl.scoring import intervals, metrics  # noqa: E402


def tuning(held: streams.StreamSet, robot: str) -> streams.Data:
  """A robot's tuning streams in the place of those that score; faults that score are left out, the
  oracle alone has them.
  """
  scored = {fault for fault, _ in held.faults(robot)}
  keys = [key for key in held.faults(robot, "tune") if key[0] not in scored]
  healthy = held.get(robot, held.find(robot, "nominal", "tune"))
  faulty = held.get(
    robot,
    [n for fault, severity in keys for n in held.find(robot, "fault", "tune", fault, severity)],
  )
  return streams.Data(
    robot, healthy, healthy, faulty, held.suite.count_from, held.suite.arl0, held.suite.horizon_s
  )


def standing(entry: entries_of.Entry, data: streams.Data, samples) -> dict:
  """threshold, score with its 95 % bootstrap interval over seeds, miss probability, false alarms an
  hour of one detector.
  """
  found = calibration.examine(
    entry, data, sweep.Runner(entry.own(data.robot) if entry.own else entry.build), samples
  )
  seeds = sorted(set(data.fault.seed.tolist()))
  alarms = dict(zip(seeds, found.nominal_fired[data.count_from :].sum(0)))
  latency = metrics.latencies(found.fired, data.fault.onset, data.horizon)
  values = metrics.per_stream(
    latency,
    np.array([alarms[s] for s in data.fault.seed.tolist()]),
    len(found.nominal_fired) - data.count_from,
    data.fault.control_s,
  )
  seed = np.stack([values["cost_standard"][data.fault.seed == s].mean() for s in seeds])
  ends = intervals.ends((intervals.weights(len(seeds), metrics.REPS) @ seed)[None])[0]
  return {
    "threshold": found.threshold,
    "score": float(values["cost_standard"].mean()),
    "score_ci": ends,
    "miss_probability": float(values["miss_probability"].mean()),
    "false_alarms_per_hour": float(values["false_alarms_per_hour"].mean()),
  }


def main(args: argparse.Namespace) -> None:
  held = streams.StreamSet(None)
  known = {
    name: settings
    for name, settings in entries_of.variants().items()
    if settings["use"] != "multichart"
    and name not in REFERENCES
    and not entries_of.entry(name, settings).signed
    and all(name in own or settings["use"] in detectors.PAPER for own in detectors.board().values())
  }
  robots, tables, data = held.choose(), {}, {}
  for robot in robots:
    data[robot] = tuning(held, robot), None
    one = data[robot][0]
    data[robot] = (
      one,
      program_of.samples(
        streams.joined(one.tune.residual, one.score.residual),
        one.fault.residual,
        one.fault.onset,
        one.fault.seed,
        one.horizon,
      ),
    )

  def score(name, settings):
    (entry,), _ = entries_of.able([entries_of.entry(name, settings)], held, robots)
    tables[name] = {robot: standing(entry, *data[robot]) for robot in robots}
    print(
      f"{name:60s}"
      + "".join(f"{robot} {tables[name][robot]['score']:6.1f}   " for robot in robots),
      file=sys.stderr,
      flush=True,
    )

  for name, settings in known.items():
    score(name, settings)
  charts = [name for name in tables if all(name in own for own in detectors.board().values())]
  best = list(
    dict.fromkeys(max(charts, key=lambda name: tables[name][robot]["score"]) for robot in robots)
  )
  sets = [best] + [[c for c in best if c != out] for out in best]
  for chosen in sets:
    score("multichart " + ",".join(chosen), {"use": "multichart", "charts": ",".join(chosen)})
  store.write_json(
    pathlib.Path(args.out),
    {
      "command": "python benchmarks/multichart.py",
      "seeds": held.suite.seeds["tune"],
      "arl0": held.suite.arl0,
      "faults": {
        r: [
          list(k)
          for k in dict.fromkeys(zip(data[r][0].fault.fault, data[r][0].fault.severity.tolist()))
        ]
        for r in robots
      },
      "charts": best,
      "detectors": tables,
      **runtime.provenance(),
    },
  )
  print(json.dumps({"charts": best}))


if __name__ == "__main__":
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  parser.add_argument("--out", default="results/multichart.json")
  sys.exit(app.attempt(lambda: main(parser.parse_args())))
