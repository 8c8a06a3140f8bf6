"""Speed of the detectors of one residual: python benchmarks/detectors.py [--json] [--quick]

Each is one jitted program over many streams (`detectors.scan`: a scan over time of the vmapped
update, the streams shared among the cores), whose alarms of all samples come back. Seconds are
without compile time; programs take turns and the median counts. Beside them river and plain Python,
one sample at a time, on the first of the same streams.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time

from mjx_cl.io import runtime

runtime.setup()

import jax  # noqa: E402
import numpy as np  # noqa: E402

from mjx_cl import detectors  # noqa: E402

HEAVY = ("adwin", "kswin", "bocpd")  # windows and run lengths in their state: another goal


def compiled(detector, xs, cores=None):
  """(call, seconds of compiling and the first call): the call gives bool (samples, streams)."""
  program = detectors.scan(detector, cores)
  call = lambda: jax.block_until_ready(program(xs).fired)
  return call, seconds(call)


def seconds(call) -> float:
  begin = time.perf_counter()
  call()
  return time.perf_counter() - begin


def alarms_of(detector, xs) -> list[int]:
  """River's interface: alarms of one stream."""
  out = []
  for t, x in enumerate(xs):
    detector.update(x)
    if detector.drift_detected:
      out.append(t)
  return out


def plain_cusum(xs, slack: float = 0.5, threshold: float = 8.0) -> list[int]:
  """detectors.cusum on standardised samples, in plain Python."""
  up = down = 0.0
  out = []
  for t, x in enumerate(xs):
    up, down = max(0.0, up + x - slack), max(0.0, down - x - slack)
    if up > threshold or down > threshold:
      out.append(t)
      up = down = 0.0
  return out


def river_ewma(stats, xs, rate: float = 0.1, threshold: float = 3.0) -> list[int]:
  """An EWMA chart around river's average, with asymptotic limits."""
  limit, out, average = threshold * (rate / (2 - rate)) ** 0.5, [], stats.EWMean(rate)
  average.update(0.0)
  for t, x in enumerate(xs):
    average.update(x)
    if abs(average.get()) > limit:
      out.append(t)
      average = stats.EWMean(rate)
      average.update(0.0)
  return out


def main() -> None:
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  parser.add_argument("--json", action="store_true", help="one JSON value on standard output")
  parser.add_argument("--quick", action="store_true", help="few streams, one round, for a test")
  args = parser.parse_args()
  streams, samples, rounds, others = (20, 1500, 1, 1) if args.quick else (1000, 10_000, 5, 5)
  rows = []

  def put(name, value, unit, goal=None):
    goal = None if args.quick else goal  # goals are for the full size
    holds = (
      None
      if goal is None or value is None
      else bool(value >= float(goal[3:]) if goal.startswith(">=") else value <= float(goal[3:]))
    )
    rows.append(
      {
        "name": name,
        "value": None if value is None else round(float(value), 6),
        "unit": unit,
        "goal": goal,
        "holds": holds,
      }
    )
    shown = "-" if value is None else f"{value:.3g}"
    print(
      f"{name:72s} {shown:>10s} {unit:14s} {goal or ''} "
      f"{'' if holds is None else 'holds' if holds else 'MISSED'}",
      file=sys.stderr,
      flush=True,
    )

  xs = jax.random.normal(jax.random.key(0), (samples, streams))
  scalars = {
    name: f
    for name, f in detectors.DETECTORS.items()
    if getattr(f, "takes", "residual") == "scalar"
  }
  rolling = {
    "rolling_sigma_plain": detectors.rolling_sigma(),
    "rolling_sigma": detectors.rolling_sigma(**detectors.CALIBRATED["walker"]),
  }  # of one residual
  built = (
    rolling
    | {name: f() for name, f in scalars.items()}
    | {"cusum behind whitening of order 8": detectors.whitened(detectors.cusum(), 8)}
  )
  against = {
    name: scalars[name](warmup=0) for name in ("page_hinkley", "cusum", "ewma", "adwin")
  }  # no more work than the others do
  programs, taken = {}, {}
  for name, detector in (
    built | {f"{name}, standardised input": d for name, d in against.items()}
  ).items():
    programs[name], spent = compiled(
      detector, xs, 1 if "," in name else None
    )  # on one core, as those beside it
    print(f"{name}: compiled and run once in {spent:.1f} s", file=sys.stderr, flush=True)
  for _ in range(rounds):
    for name, call in programs.items():
      if len(taken.setdefault(name, [])) < (2 if name.split(",")[0] in HEAVY else rounds):
        taken[name].append(seconds(call))
  taken = {name: statistics.median(t) for name, t in taken.items()}
  for name in built:
    put(
      f"{name}: {streams} streams of {samples} samples",
      taken[name],
      "s",
      "<= 20" if name in HEAVY else None if " " in name else "<= 1",
    )

  try:
    from river import drift, stats
  except ImportError:
    drift = stats = None
    print(
      "river is not installed (pip install 'mjx-cl[test]'): its figures are left out",
      file=sys.stderr,
    )
  lists = np.asarray(xs, float).T[:others].tolist()
  slow = {
    "page_hinkley": ("river", drift and (lambda x: alarms_of(drift.PageHinkley(), x))),
    "cusum": ("plain Python", plain_cusum),
    "ewma": ("river's average", stats and (lambda x: river_ewma(stats, x))),
    "adwin": ("river", drift and (lambda x: alarms_of(drift.ADWIN(), x))),
  }
  for name, (whose, call) in slow.items():
    mine = taken[f"{name}, standardised input"] / (streams * samples)
    theirs = call and statistics.median(seconds(lambda: call(x)) for x in lists) / samples
    put(f"{name}: a sample", mine * 1e9, "ns")
    put(f"{name}: a sample, {whose}", theirs and theirs * 1e9, "ns")
    put(
      f"{name}: {whose} against this",
      theirs and theirs / mine,
      "ratio",
      None if name == "adwin" else ">= 20",
    )
  fired = np.asarray(programs["page_hinkley, standardised input"]())
  equal = (
    [
      np.flatnonzero(fired[:, k]).tolist() == slow["page_hinkley"][1](x)
      for k, x in enumerate(lists)
    ]
    if drift
    else None
  )
  put(
    f"page_hinkley: of {others} streams, alarms at the same samples as river's",
    equal and np.mean(equal),
    "share",
  )

  if args.json:
    print(json.dumps(rows))


if __name__ == "__main__":
  main()
