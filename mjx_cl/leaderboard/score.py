"""The leaderboard: every detector on the recorded streams, thresholds at one rate of false alarms,
metrics with intervals, an HTML page.

For each robot: thresholds are found on healthy streams of the seeds that tune, so that nominal
control steps / alarms (with restarts) = ARL0; then the streams of the seeds that score are run
once. A detector is one jitted program over all streams and several thresholds side by side.
"""

import functools
import itertools
import math
import os
import pathlib
import time
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_cl.errors import PluginError
from mjx_cl.io import tables
from mjx_cl.io.interrupt import threads
from mjx_cl.leaderboard import calibration, page, sweep
from mjx_cl.leaderboard import oracle as oracles
from mjx_cl.leaderboard import program as programs
from mjx_cl.leaderboard.calibration import Found
from mjx_cl.leaderboard.entries import Entry, fitted, one_line
from mjx_cl.leaderboard.entries import able as able
from mjx_cl.leaderboard.entries import chosen as chosen
from mjx_cl.leaderboard.entries import variants as variants
from mjx_cl.leaderboard.streams import Data, StreamSet, joined, load
from mjx_cl.rollout.monitor import CHANNELS
from mjx_cl.scoring import comparison, limits, metrics, thresholds

# rows that are there whatever detectors are chosen
ORACLES = ("true onset (oracle)", "likelihood_ratio (oracle)")
EPISODES = ("episode_alarm_probability", "episode_alarm_probability_ci")
HIDDEN = ("stream_latency_steps", "stream_healthy_alarms", "healthy_steps")  # on the page
Job = tuple[str, bool, Callable[[Data], Found]]  # name on the board, whether a reference, what runs


class Board(NamedTuple):
  """Scores of detectors.

  Attributes:
    rows: one dict per detector, robot, fault and severity.
    overall: means of each detector, and ranks.
    curves: for the page.
    faults: for the page.
    seconds: wall time.
    stream_steps: stream-steps scored, calibration runs not counted twice.
  """

  rows: list[dict]
  overall: comparison.Overall
  curves: dict
  faults: list[dict]
  seconds: float
  stream_steps: int


def score(
  streams: StreamSet,
  entries: list[Entry],
  robots: Collection[str] = (),
  extra: Sequence[tuple[str, Callable[[Data], Found]]] = (),
  progress: Callable[[str, str, int, int, float], Any] = lambda robot, name, k, n, seconds: None,
  found: Callable[[str, Data], Found] | None = None,
) -> Board:
  """Scores detectors on a recorded set.

  Args:
    streams: the set.
    entries: detectors.
    robots: all where empty.
    extra: (name, Data -> Found) of detectors that are run by something else: a host class, a file
      of scores.
    progress: called as progress(robot, detector, done, of how many, seconds).
    found: what the detector of that name did, where `entries` were examined before, see spread.py.
  """
  begin = time.perf_counter()
  robots = streams.choose(robots)
  room = programs.room(streams, robots)
  runners = {e.name: sweep.Runner(e.build, room, e.signed) for e in entries if not e.own}
  rows: list[dict] = []
  curves: dict[str, dict[str, list[dict]]] = {}
  faults: list[dict] = []
  done, total, lived = itertools.count(1), len(robots) * (len(entries) + len(extra) + 1), 0
  took: dict[str, float] = {}  # seconds of each detector on the robot before
  for robot in robots:
    data = load(streams, robot)
    if found:
      own_jobs = [functools.partial(found, e.name) for e in entries]
    else:
      known = samples_of(data, room) if entries else None
      own_jobs = [functools.partial(examine, e, runners, room, known) for e in entries]
    jobs: list[Job] = [(e.name, e.reference, job) for e, job in zip(entries, own_jobs)]
    jobs += [(name, False, get) for name, get in extra]
    told = lambda name, robot=robot: progress(
      robot, name, next(done), total, time.perf_counter() - begin
    )
    oracle, own, points, alarms = _run(streams, data, jobs, took, told)
    rows += own
    for name, curve in points.items():
      curves.setdefault(name, {})[robot] = curve
    faults += [_fault(data, key, o, alarms) for key, o in oracle.items()]
    sizes = (x.residual.opr.size for x in (data.tune, data.score, data.fault))
    lived += len(jobs) * sum(sizes)
  drawn = {name: by for name, by in curves.items() if any(by.values())}
  return Board(rows, comparison.overall(rows), drawn, faults, time.perf_counter() - begin, lived)


def samples_of(data: Data, room: programs.Room) -> programs.Samples:
  """The streams of one robot as detectors are run on them."""
  nominal, fault = joined(data.tune.residual, data.score.residual), data.fault
  return programs.samples(
    nominal, fault.residual, fault.onset, fault.seed, data.horizon, room.samples
  )


def examine(
  one: Entry,
  runners: dict[str, sweep.Runner],
  room: programs.Room,
  samples: Any,
  data: Data,
) -> Found:
  """What a detector does on one robot.

  Args:
    one: the detector.
    runners: detector -> what runs it, of those without settings of a robot's own.
    room: of the set.
    samples: of `data`.
    data: streams of the robot.
  """
  runner = sweep.Runner(one.own(data.robot), room, one.signed) if one.own else runners[one.name]
  found = one_line(one.name, lambda: calibration.examine(one, data, runner, samples))
  # one of ours has none where the streams are shorter than its warm-up
  if ":" in one.name and not np.isfinite(found.nominal_score).any():
    raise PluginError(
      f"detector {one.name!r} knows no score on the healthy streams of {data.robot}: nan throughout"
    )
  return found


def _run(
  streams: StreamSet,
  data: Data,
  jobs: list[Job],
  took: dict[str, float],
  told: Callable[[str], Any],
) -> tuple[
  dict[tuple[str, float], oracles.Oracle],
  list[dict],
  dict[str, list[dict]],
  dict[str, np.ndarray],
]:
  """Runs the jobs of a robot side by side.

  Args:
    streams: the set.
    data: streams of the robot.
    jobs: what is run.
    took: {name: seconds} of the robot before, and then of this one.
    told: called with the name of each job that is done, in their order; first with `oracles`.

  Returns:
    (oracle of each fault, rows of oracles and jobs, curves and alarms by job): what else a job
    found is let go of once it is rated.
  """

  def rated(job: Job) -> tuple[Found, list[dict] | None]:
    name, reference, get = job
    started = time.perf_counter()
    result = get(data)
    took[name] = time.perf_counter() - started
    ready = oracle.done()
    return result, rows_of(name, reference, result, data, oracle.result()) if ready else None

  # the program of a detector runs on one core, and several run side by side
  with threads(min(8, os.cpu_count() or 1), "detector") as pool:
    # one thread's work for a while: detectors run beside it, and are rated once it is there
    oracle = pool.submit(oracles.oracles, streams, data)
    # a long one that begins last would keep one core waiting for another
    longest_first = sorted(jobs, key=lambda job: -took.get(job[0], 0.0))
    begun = {job[0]: pool.submit(rated, job) for job in longest_first}
    known = oracle.result()
    rows, curves, alarms = oracle_rows(data, known), {}, {}
    told("oracles")
    for name, reference, _ in jobs:
      result, own = begun.pop(name).result()
      rows += rows_of(name, reference, result, data, known) if own is None else own
      curves[name], alarms[name] = result.curve, result.fired
      told(name)
  return known, rows, curves, alarms


def rows_of(
  name: str, reference: bool, result: Found, data: Data, known: dict[tuple, oracles.Oracle]
) -> list[dict]:
  """One row per fault and severity, of which `known` tells what its oracle did."""
  out = []
  for key, oracle in known.items():
    own = data.own(key)
    part = result._replace(fired=result.fired[:, own], score=result.score[:, own])
    out.append(_row(name, reference, data, key, part, oracle))
  return out


def _row(
  name: str,
  reference: bool,
  data: Data,
  key: tuple[str, float],
  result: Found,
  oracle: oracles.Oracle,
) -> dict:
  """One row; fired and score of `result` are of this fault's streams alone."""
  onset, threshold, arl0 = data.fault.onset[data.own(key)], result.threshold, result.arl0
  row = metrics.row(
    result.fired,
    result.score,
    onset,
    result.nominal_fired,
    result.nominal_score,
    data.fault.control_s,
    data.count_from,
    horizon_s=data.horizon_s,
  )
  latency = metrics.latencies(result.fired, onset, data.horizon)
  best = metrics.latencies(oracle.run.fired, onset, data.horizon) if oracle.run else latency
  share = limits.efficiency(best, latency, data.horizon)
  if oracle.run is None:
    share |= {
      f"{k}{end}": None for k in ("oracle_delay_steps", "efficiency") for end in ("", "_ci")
    }
  tells = name == ORACLES[1 if oracle.run else 0]  # the row that says why a limit is unknown
  said = (result.note, share["note"], oracle.limits["note"] if tells else None)
  notes = [n for n in said if n]
  return {
    "detector": name,
    "reference": reference,
    "robot": data.robot,
    "fault": key[0],
    "severity": key[1],
    "reward_lost": reward_lost(data, key),
    "threshold": threshold if threshold is None or math.isfinite(threshold) else None,
    "arl0": arl0.get("arl0"),
    "arl0_ci": arl0.get("arl0_ci"),
    "arl0_alarms": arl0.get("alarms"),
    "arl0_few": arl0.get("few", False),
    **{k: result.episode.get(k) for k in EPISODES},
    **row,
    "us_per_sample": result.us_per_sample,
    **{k: oracle.limits[k] for k in oracles.LIMITS},
    **share,
    "note": "; ".join(notes) or None,
  }


def reward_lost(data: Data, key: tuple[str, float]) -> float | None:
  """Share of the reward that a fault takes from the recorded robots, which do not adapt: 1 - mean
  reward within the horizon after the onset / that of the same robots whole, in the same control
  steps; None where the latter is not positive or unknown.
  """
  if data.twins is None:
    return None
  own = data.own(key)
  at = data.fault.onset[own]
  after = lambda reward, columns: np.nanmean(
    np.concatenate([reward[t : t + data.horizon, k] for k, t in zip(columns, at)])
  )
  healthy = after(data.twins, range(len(own)))
  broken = after(np.asarray(data.fault.residual.reward), own)
  return float(1 - broken / healthy) if healthy > 0 and np.isfinite(broken) else None


def oracle_rows(data: Data, known: dict[tuple, oracles.Oracle]) -> list[dict]:
  """Rows of the two oracles: the true onset, and the likelihood-ratio CUSUM where it could be
  fitted.

  Their `us_per_sample` is None: the one reads the label, the other is a NumPy loop over all streams
  of all faults at once, whose time is no detector's.
  """
  out = []
  steps = np.arange(len(data.fault.residual.opr))[:, None]
  nominal = thresholds.by_seed(
    np.zeros(data.score.episode.shape, bool), data.score.seed, data.count_from
  )
  for key, oracle in known.items():
    if oracle.run:
      out.append(_row(ORACLES[1], True, data, key, oracle.run, oracle))
    since = steps - data.fault.onset[data.own(key)]
    told = Found(
      None, {}, {}, nominal, nominal.astype(float), since == 0, (since >= 0).astype(float), None, []
    )
    out.append(_row(ORACLES[0], True, data, key, told, oracle))
  return out


def _fault(
  data: Data, key: tuple[str, float], oracle: oracles.Oracle, alarms: dict[str, np.ndarray]
) -> dict:
  """What a fault's page shows: the streams of every scoring seed around the onset, those of the
  first in twice the detail.
  """
  lives = []
  for j, k in enumerate(data.own(key).tolist()):
    oracles_own = {ORACLES[1]: oracle.run.fired[:, j]} if oracle.run else {}
    lanes = {name: fired[:, k] for name, fired in alarms.items()} | oracles_own
    lives.append(_life(data, k, lanes, *((150, ".3g") if j else (300, ".4g"))))
  return {
    "robot": data.robot,
    "fault": key[0],
    "severity": key[1],
    "control_s": data.fault.control_s,
    **lives[0],
    "others": lives[1:],
  }


def _life(data: Data, k: int, lanes: dict[str, np.ndarray], points: int, digits: str) -> dict:
  """Fault stream `k` around its onset, thinned, and each detector's first alarms there, before the
  onset and from it on.
  """
  onset = int(data.fault.onset[k])
  first, last = max(0, onset - data.horizon // 2), onset + data.horizon
  thin = max(1, (last - first) // points)
  shown = lambda x: [float(format(v, digits)) if math.isfinite(v) else None for v in x[::thin]]
  ahead = {name: np.flatnonzero(fired[first:onset]) for name, fired in lanes.items()}
  hits = {name: np.flatnonzero(fired[onset:last]) for name, fired in lanes.items()}
  return {
    "target": data.fault.target[k],
    "seed": int(data.fault.seed[k]),
    "onset": onset,
    "first": first,
    "every": thin,
    "channels": {
      c: shown(np.asarray(getattr(data.fault.residual, c))[first:last, k])
      for c in CHANNELS
      if not c.startswith("group_")
    },
    "alarms": {name: int(onset + hit[0]) if len(hit) else None for name, hit in hits.items()},
    "early": {name: int(first + hit[0]) for name, hit in ahead.items() if len(hit)},
  }


def write(board: Board, out: pathlib.Path | str, meta: dict) -> list[str]:
  """leaderboard.parquet (x_ci as x_low, x_high), leaderboard_overall.parquet, leaderboard.html and
  leaderboard.json in the folder `out`.
  """
  out = pathlib.Path(out)
  out.mkdir(parents=True, exist_ok=True)
  _, *overall = board.overall
  meta = meta | {"references": sorted({r["detector"] for r in board.rows if r["reference"]})}
  meta |= dict(zip(comparison.Overall._fields[1:], overall))
  beforehand = fitted({r["detector"] for r in board.rows})
  if beforehand:
    words = [f"{name} was fitted beforehand on {on}." for name, on in beforehand.items()]
    meta |= {"fitted": beforehand, "notes": words}
  paths = [out / f"leaderboard{end}" for end in (".parquet", "_overall.parquet", ".html", ".json")]
  for path, rows in zip(paths, (board.rows, board.overall.rows)):
    plain = [flat(r) for r in rows]
    keys = dict.fromkeys(k for r in plain for k in r)
    tables.write_table(path, {k: [r.get(k) for r in plain] for k in keys})
  shown = [{k: v for k, v in r.items() if k not in HIDDEN} for r in board.rows]
  page.write(paths[2], shown, board.overall.rows, board.curves, board.faults, meta)
  tables.write_json(paths[3], meta)
  return [str(path) for path in paths]


def flat(row: dict) -> dict:
  """x_ci -> x_low, x_high."""
  out: dict = {}
  for k, v in row.items():
    if k.endswith("_ci"):
      low, high = v or (None, None)
      out |= {f"{k[:-3]}_low": low, f"{k[:-3]}_high": high}
    else:
      out[k] = v
  return out
