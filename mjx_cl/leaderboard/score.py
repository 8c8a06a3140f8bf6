"""The leaderboard: every detector on the recorded streams, thresholds at one rate of false alarms,
metrics with intervals, an HTML page.

For each robot: thresholds are found on healthy streams of the seeds that tune, so that nominal
control steps / alarms (with restarts) = ARL0; then the streams of the seeds that score are run
once. A detector is one jitted program over all streams and several thresholds side by side.
"""

from __future__ import annotations

import collections
import concurrent.futures
import inspect
import math
import os
import pathlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from mjx_cl import detectors as detectors_lib
from mjx_cl.errors import FileError, UserError, choose
from mjx_cl.io import tables
from mjx_cl.leaderboard import oracle as oracles
from mjx_cl.leaderboard import page, sweep
from mjx_cl.leaderboard.streams import Data, StreamSet
from mjx_cl.rollout.monitor import CHANNELS
from mjx_cl.scoring import limits, metrics, thresholds

if TYPE_CHECKING:
  from collections.abc import Collection, Iterable, Sequence

  from mjx_cl.rollout.monitor import Residual

ORACLES = (
  "true onset (oracle)",
  "likelihood_ratio (oracle)",
)  # rows that are there whatever detectors are chosen
CURVE = (
  300,
  1_000,
  3_000,
  30_000,
)  # further ARL0 of the latency-against-false-alarm curves [control steps]


class Entry(NamedTuple):
  """A detector on the board.

  Attributes:
    name: on the board. build: threshold -> Detector; None for a host detector or scores.
    calibrated: has a threshold. reference: looks at nothing. about: one line.
    own: robot -> build where the settings are a robot's own, which is compiled for each robot;
      None: `build` serves all.
  """

  name: str
  build: Callable[[Any], Any] | None
  calibrated: bool
  reference: bool
  about: str
  own: Callable[[str], Callable[[Any], Any]] | None = None


class Found(NamedTuple):
  """What a detector did on one robot.

  Attributes:
    threshold: None where there is none to set. arl0: metrics.arl0 on the tuning streams. episode:
      metrics.episode_alarm_probability, scoring streams.
    nominal_fired, nominal_score: (N, S) on the healthy scoring streams, seed by seed. fired, score:
      (T, F) on the fault streams.
    us_per_sample: compute [microseconds], None where not measured. curve: [{false_alarms_per_hour,
      latency_mean_s, detected}].
  """

  threshold: float | None
  arl0: dict
  episode: dict
  nominal_fired: np.ndarray
  nominal_score: np.ndarray
  fired: np.ndarray
  score: np.ndarray
  us_per_sample: float | None
  curve: list[dict]


def variants() -> dict[str, dict]:
  """Settings by name on the board: every registered detector at its defaults, and the usual other
  channels and a whitened form.
  """
  own: dict[str, dict[str, Any]] = {name: {"use": name} for name in detectors_lib.DETECTORS}
  scalar = lambda n: getattr(detectors_lib.DETECTORS.get(n), "takes", "") == "scalar"
  for name in ("cusum", "ewma", "glr", "conformal"):
    if scalar(name):
      own[f"{name} white"] = {"use": name, "whiten": oracles.ORDER}
  if scalar("cusum"):
    groups = [c for c in CHANNELS if c.startswith("group_")]
    own |= {f"cusum@{c}": {"use": f"cusum@{c}"} for c in CHANNELS if c not in groups}
    own["cusum@groups"] = {"use": f"cusum@{'+'.join(groups)}"}
  return own


def entry(name: str, settings: dict) -> Entry:
  """An Entry from settings {use, ...}."""
  settings = dict(settings)
  use = settings.pop("use", name)
  factory = detectors_lib.factory(use)
  parameters = inspect.signature(factory).parameters
  calibrated = "threshold" in parameters or any(
    p.kind is p.VAR_KEYWORD for p in parameters.values()
  )
  about = (inspect.getdoc(factory) or "").split("\n")[0]
  build = lambda threshold, **more: detectors_lib.make(
    use, **(more | settings), **({"threshold": threshold} if calibrated else {})
  )
  own = None
  if use == "rolling_sigma":
    own = lambda robot: lambda threshold: build(threshold, robot=robot, shared=True)
  elif "robot" in parameters:
    own = lambda robot: lambda threshold: build(threshold, robot=robot)
  return Entry(name, build, calibrated, bool(getattr(factory, "reference", False)), about, own)


def chosen(names: Collection[str], robot: str) -> list[Entry]:
  """Entries of these names on the board, in its order, all where there is none; behind them those
  that `detectors.make` takes beside: name@channel, path/to/file.py:factory, module:factory. The
  name `none` stands for no detector.

  Args:
    robot: on which the latter are built once, since what is wrong with one is to be said before
      others are run.

  Raises:
    UserError, one line: no such detector, file, factory or channel.
  """
  known, more = variants(), []
  for name in dict.fromkeys(names):
    if name == "none" or name in known:
      continue
    if name == detectors_lib.split(name)[0] and ":" not in name:
      choose("detector", name, known)
    one = entry(name, {"use": name})
    _one_line(one, lambda: (one.own(robot) if one.own else one.build)(1.0).init())  # type: ignore[misc]
    more.append(one)
  return [entry(n, s) for n, s in known.items() if not names or n in names] + more


def load(streams: StreamSet, robot: str) -> Data:
  """One robot's streams."""
  tune, score = (streams.get(robot, streams.find(robot, "nominal", s)) for s in ("tune", "score"))
  numbers = [
    n for f, s in streams.faults(robot) for n in streams.find(robot, "fault", "score", f, s)
  ]
  data = Data(
    robot,
    tune,
    score,
    streams.get(robot, numbers),
    streams.suite.count_from,
    streams.suite.arl0,
    streams.suite.horizon_s,
  )
  seeds = list(dict.fromkeys(score.seed.tolist()))
  for key in streams.faults(robot):
    if data.fault.seed[data.own(key)].tolist() != seeds:
      raise FileError(
        f"{streams.folder}: {robot}, {key[0]} {key[1]:g}: its streams must be those of the "
        f"seeds {seeds}, in order, one of each"
      )
  return data


# ---- running -------------------------------------------------------------------------------------


def joined(a: Residual, b: Residual) -> Residual:
  """Two residuals side by side, cut to the shorter."""
  steps = min(len(a.opr), len(b.opr))
  return jax.tree.map(lambda x, y: np.concatenate([x[:steps], y[:steps]], 1), a, b)


def examine(one: Entry, data: Data, runner: sweep.Runner, samples: sweep.Samples) -> Found:
  """Calibrates a detector on one robot and runs it.

  Args:
    runner: of the detector, compiled once for all robots. samples: of `data`.
  """
  tune, streams = data.tune.residual.opr.shape[1], len(samples.healthy)
  tried: list[tuple[float, int]]
  counter: sweep.Counter | None
  threshold, tried, counted, counter = math.nan if one.calibrated else 0.0, [], 0, None
  every = lambda t: list(zip(range(streams), np.full((streams, runner.together), t, np.float32)))
  runner.prepare(samples)
  for reuse in (True, False):
    if one.calibrated:
      counter = sweep.Counter(runner, samples, tune, data.count_from, reuse)
      free = counter.score()[data.count_from :]
      counted = int(thresholds.seeing(free, 0).sum()) * len(free)
      target = counted / data.arl0
      threshold, tried = thresholds.narrow(
        lambda levels: counter.count(levels, target), free, target
      )
    runs = list(runner.healthy(every(threshold), samples))
    fired = np.stack([f[0] for f, _ in runs], 1)
    score = np.stack([sweep.strongest(s[0]) for _, s in runs], 1)
    # a threshold that is used otherwise than as score > threshold lets no run tell of another; then
    # all are run
    if (
      counter is None
      or counter.sound
      and fired[data.count_from :, :tune].sum() == dict(tried).get(threshold, 0)
    ):
      break
  levels = [threshold] + [thresholds.nearest(tried, counted, a) for a in CURVE if tried]
  faults_fired, faults_score, before, us = runner.faults(np.asarray(levels, np.float32), samples)
  alarms = dict(tried)
  first, shape = data.fault.onset, data.fault.residual.opr.shape
  pairs = [
    (alarms[t], _placed(f, first, shape, False))
    for t, f in zip(levels, faults_fired)
    if t in alarms
  ]
  own = (
    _placed(faults_fired[0], first, shape, False),
    _placed(faults_score[0], first, shape, np.nan),
  )
  own[0][: len(before)] |= before
  return found(
    data,
    float(np.float32(threshold)) if one.calibrated else None,
    fired,
    score,
    *own,
    us,
    curve(pairs, data, counted),
  )


def _placed(x: np.ndarray, onset: np.ndarray, shape: tuple[int, ...], unknown: float) -> np.ndarray:
  """(T, F) from rows (H, F) that begin at the onsets; `unknown` before and behind, where nothing
  counts.
  """
  out = np.full(shape, unknown, x.dtype)
  for k, first in enumerate(onset):
    out[first : first + len(x), k] = x[: shape[0] - first, k]
  return out


def curve(pairs: Iterable[tuple[int, np.ndarray]], data: Data, counted: float) -> list[dict]:
  """Latency against false alarms: mean over fault streams of min(delay, horizon), a miss counts the
  horizon.

  Args:
    pairs: ((alarms on `counted` healthy steps, fired (T, F) on the fault streams), ...), one for
      each threshold.
  """
  control_s, horizon, points = data.fault.control_s, data.horizon, {}
  for alarms, fired in pairs:
    latency = metrics.latencies(fired, data.fault.onset, horizon)
    rate = alarms / (counted * control_s / 3600)
    points[rate] = {
      "false_alarms_per_hour": rate,
      "latency_mean_s": float(np.mean(np.minimum(latency + 1, horizon)) * control_s),
      "detected": float(np.isfinite(latency).mean()),
    }
  return [points[k] for k in sorted(points)]


def found(
  data: Data,
  threshold: float | None,
  fired: np.ndarray,
  score: np.ndarray,
  fault_fired: np.ndarray,
  fault_score: np.ndarray,
  us: float | None = None,
  points: Iterable[dict] = (),
) -> Found:
  """Found from raw alarms and scores: (N, tuning + scoring streams) on healthy streams, (T, F) on
  fault streams. points: of `curve`.
  """
  tune = data.tune.residual.opr.shape[1]
  steps = min(len(fired), len(data.score.episode))
  tuned, scored = (
    thresholds.seeing(score[:, columns], data.count_from)
    for columns in (slice(None, tune), slice(tune, None))
  )
  episode = metrics.episode_alarm_probability(
    fired[:steps, tune:][:, scored], data.score.episode[:steps, scored], data.count_from
  )
  stacked = [
    thresholds.by_seed(x[:, tune:], data.score.seed, data.count_from, scored)
    for x in (fired, score)
  ]
  return Found(  # type: ignore[call-arg]
    threshold,
    metrics.arl0(fired[:, :tune][:, tuned], data.count_from),
    episode,
    *stacked,  # type: ignore[arg-type]
    fault_fired,
    fault_score,
    us,
    list(points),
  )


# ---- rows ----------------------------------------------------------------------------------------


def rows_of(name: str, reference: bool, result: Found, data: Data, oracle: dict) -> list[dict]:
  """One row per fault and severity."""
  out = []
  for key, known in oracle.items():
    own = data.own(key)
    alarms = result.fired[:, own], result.score[:, own], result.nominal_fired, result.nominal_score
    out.append(
      _row(
        name,
        reference,
        data,
        key,
        alarms,
        known,
        result.threshold,
        result.arl0,
        result.episode,
        result.us_per_sample,
      )
    )
  return out


def _row(
  name: str,
  reference: bool,
  data: Data,
  key: tuple[str, float],
  alarms: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
  oracle: oracles.Oracle,
  threshold: float | None = None,
  arl0: dict | None = None,
  episode: dict | None = None,
  us: float | None = None,
) -> dict:
  """One row; alarms: fired and score on the fault streams, fired and score on healthy
  ones by seed.
  """
  fired, score, nominal_fired, nominal_score = alarms
  onset = data.fault.onset[data.own(key)]
  row = metrics.row(
    fired,
    score,
    onset,
    nominal_fired,
    nominal_score,
    data.fault.control_s,
    data.count_from,
    horizon_s=data.horizon_s,
  )
  latency = metrics.latencies(fired, onset, data.horizon)
  share = limits.efficiency(oracle.run.latency if oracle.run else latency, latency, data.horizon)
  if oracle.run is None:
    share |= dict.fromkeys(
      ("oracle_delay_steps", "oracle_delay_steps_ci", "efficiency", "efficiency_ci")
    )
  known = {k: oracle.limits[k] for k in oracles.LIMITS}
  tells = name == ORACLES[1 if oracle.run else 0]  # the row that says why a limit is unknown
  notes = [n for n in (share["note"], oracle.limits["note"] if tells else None) if n]
  arl0 = arl0 or {"arl0": None, "arl0_ci": None, "alarms": None, "few": False}
  return {
    "detector": name,
    "reference": reference,
    "robot": data.robot,
    "fault": key[0],
    "severity": key[1],
    "threshold": threshold if threshold is None or math.isfinite(threshold) else None,
    "arl0": arl0["arl0"],
    "arl0_ci": arl0["arl0_ci"],
    "arl0_alarms": arl0["alarms"],
    "arl0_few": arl0["few"],
    **{
      k: (episode or {}).get(k)
      for k in ("episode_alarm_probability", "episode_alarm_probability_ci")
    },
    **row,
    "us_per_sample": us,
    **known,
    **share,
    "note": "; ".join(notes) or None,
  }


def _episodes(fired: np.ndarray, data: Data) -> dict:
  """metrics.episode_alarm_probability of alarms on the healthy streams that score, which
  `healthy.by_seed` has put one after the other.
  """
  seeds, episode = data.score.seed, data.score.episode
  order = np.concatenate([np.flatnonzero(seeds == seed) for seed in dict.fromkeys(seeds.tolist())])
  apart = np.zeros(
    episode.shape, bool
  )  # stream by stream again; what came before `count_from` counts nowhere
  apart[data.count_from :] = fired[data.count_from :].T.reshape(len(order), -1).T
  return metrics.episode_alarm_probability(apart, episode[:, order], data.count_from)


def oracle_rows(data: Data, oracle: dict) -> list[dict]:
  """Rows of the two oracles: the true onset, and the likelihood-ratio CUSUM where it could be
  fitted.

  Their `us_per_sample` is None: the one reads the label, the other is a NumPy loop over all streams
  of all faults at once, whose time is no detector's.
  """
  out = []
  onset_name, ratio_name = ORACLES
  steps, nominal = (
    data.fault.residual.opr.shape[0],
    thresholds.by_seed(np.zeros(data.score.episode.shape, bool), data.score.seed, data.count_from),
  )
  for key, o in oracle.items():
    if o.run:
      alarms = o.run.fired, o.run.score, o.run.nominal_fired, o.run.nominal_score
      out.append(
        _row(
          ratio_name,
          True,
          data,
          key,
          alarms,
          o,
          o.run.threshold,
          o.run.arl0,
          _episodes(o.run.nominal_fired, data),
        )
      )
    since = np.arange(steps)[:, None] - data.fault.onset[data.own(key)]
    out.append(
      _row(
        onset_name,
        True,
        data,
        key,
        (since == 0, (since >= 0).astype(float), nominal, nominal.astype(float)),
        o,
      )
    )
  return out


class Board(NamedTuple):
  """Attributes: rows: one dict per detector, robot, fault and severity. overall: metrics.Overall.
  curves, faults: for the page. seconds: wall time.
  stream_steps: stream-steps scored, calibration runs not counted twice.
  """

  rows: list[dict]
  overall: metrics.Overall
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
) -> Board:
  """Scores detectors on a recorded set.

  Args:
    entries: detectors. robots: all where empty.
    extra: ((name, Data -> Found), ...), detectors that are run by something else: a host class, a
      file of scores.
  """
  begin = time.perf_counter()
  robots = streams.choose(robots)
  room = sweep.room(streams, robots)
  runners = {e.name: sweep.Runner(e.build, room) for e in entries if not e.own}  # type: ignore[arg-type]
  rows: list[dict]
  curves: dict[str, dict[str, list[dict]]]
  pages: list[dict]
  rows, curves, pages, n = [], {}, [], len(robots) * (len(entries) + len(extra) + 1)
  done = lived = 0
  took: dict[str, float] = {}  # seconds of each detector on the robot before
  for robot in robots:
    data = load(streams, robot)
    nominal = joined(data.tune.residual, data.score.residual)
    samples = (
      sweep.samples(
        nominal, data.fault.residual, data.fault.onset, data.fault.seed, data.horizon, room.samples
      )
      if entries
      else None
    )
    alarms: dict[str, np.ndarray] = {}
    runner = lambda e: sweep.Runner(e.own(robot), room) if e.own else runners[e.name]
    jobs = [(e.name, lambda d, e=e: _guarded(e, d, runner(e), samples)) for e in entries] + list(
      extra
    )
    rate = lambda name, result, known: rows_of(
      name, next((e.reference for e in entries if e.name == name), False), result, data, known
    )

    def rated(name: str, get: Callable[[Data], Found]) -> tuple[Found, list[dict] | None]:
      started = time.perf_counter()
      result = get(data)
      took[name] = time.perf_counter() - started
      return result, rate(name, result, oracle.result()) if oracle.done() else None

    with _workers() as pool:
      oracle = pool.submit(
        oracles.oracles, streams, data
      )  # one thread's work for a while: detectors run beside it, and are rated once it is there
      longest_first = sorted(
        jobs, key=lambda job: -took.get(job[0], 0.0)
      )  # a long one that begins last would keep one core waiting for another
      begun = {name: pool.submit(rated, name, get) for name, get in longest_first}
      waiting = collections.deque((name, begun.pop(name)) for name, _ in jobs)
      try:
        known = oracle.result()
        rows += oracle_rows(data, known)
        done += 1
        progress(robot, "oracles", done, n, time.perf_counter() - begin)
        while waiting:
          name, job = waiting.popleft()  # what a job found is let go of once it is rated
          result, own = job.result()
          own = rate(name, result, known) if own is None else own
          rows += own
          curves.setdefault(name, {})[robot] = result.curve
          alarms[name] = result.fired
          lived += nominal.opr.size + data.fault.residual.opr.size
          done += 1
          progress(robot, name, done, n, time.perf_counter() - begin)
      finally:
        pool.shutdown(
          wait=False, cancel_futures=True
        )  # after an error or Ctrl-C what has not begun never does
    pages += _pages(data, known, alarms)
  return Board(
    rows,
    metrics.overall(rows),
    {k: v for k, v in curves.items() if any(v.values())},
    pages,
    time.perf_counter() - begin,
    lived,
  )


def _workers() -> concurrent.futures.ThreadPoolExecutor:
  """A thread per core, eight at the most: the program of a detector runs on one core, and several
  run side by side.
  """
  return concurrent.futures.ThreadPoolExecutor(min(8, os.cpu_count() or 1), "detector")


def _guarded(one: Entry, data: Data, runner: sweep.Runner, samples: sweep.Samples | None) -> Found:
  """`examine`, see `_one_line`."""
  return _one_line(one, lambda: examine(one, data, runner, samples))  # type: ignore[arg-type]


def _one_line(one: Entry, run: Callable[[], Any]) -> Any:
  """run(); whatever goes wrong inside a detector, which may be anybody's, becomes one line that
  names it.
  """
  try:
    return run()
  except UserError:
    raise
  except jax.errors.ConcretizationTypeError as e:
    raise UserError(
      f"detector {one.name!r} cannot be calibrated: its threshold is traced, several run side "
      "by side, so no Python `if` may look at it "
      "or at a sample (jnp.where does)"
    ) from e
  except (Exception, SystemExit) as e:
    raise UserError(
      f"detector {one.name!r} failed: {type(e).__name__}: "
      f"{(str(e).strip() or 'without a message').splitlines()[0]}"
    ) from e


def _pages(data: Data, oracle: dict, alarms: dict) -> list[dict]:
  """For each fault the streams of every scoring seed around the onset, thinned, and each detector's
  first alarms there, before the onset and from it on; those of the first in twice the detail.
  """
  out, horizon = [], data.horizon
  for key, o in oracle.items():
    lives: list[dict] = []
    for j, k in enumerate(int(k) for k in data.own(key)):
      onset = int(data.fault.onset[k])
      window = slice(max(0, onset - horizon // 2), onset + horizon)
      points, digits = (150, ".3g") if lives else (300, ".4g")
      thin = max(1, (window.stop - window.start) // points)
      channels = {
        c: getattr(data.fault.residual, c)[window, k]
        for c in CHANNELS
        if not c.startswith("group_")
      }
      values = {
        c: [None if not math.isfinite(v) else float(format(v, digits)) for v in x[::thin]]
        for c, x in channels.items()
      }
      lanes = {name: fired[:, k] for name, fired in alarms.items()} | (
        {ORACLES[1]: o.run.fired[:, j]} if o.run else {}
      )
      first: dict[str, int | None]
      early: dict[str, int]
      first, early = {}, {}
      for name, fired in lanes.items():
        hit, ahead = (
          np.flatnonzero(fired[onset : onset + horizon]),
          np.flatnonzero(fired[window.start : onset]),
        )
        first[name] = int(onset + hit[0]) if len(hit) else None
        early |= {name: int(window.start + ahead[0])} if len(ahead) else {}
      lives.append(
        {
          "target": data.fault.target[k],
          "seed": int(data.fault.seed[k]),
          "onset": onset,
          "first": window.start,
          "every": thin,
          "channels": values,
          "alarms": first,
          "early": early,
        }
      )
    out.append(
      {"robot": data.robot, "fault": key[0], "severity": key[1], "control_s": data.fault.control_s}
      | lives[0]
      | {"others": lives[1:]}
    )
  return out


# ---- writing -------------------------------------------------------------------------------------


def write(board: Board, out: pathlib.Path | str, meta: dict) -> list[str]:
  """leaderboard.parquet (x_ci as x_low, x_high), leaderboard_overall.parquet and leaderboard.html
  in the folder `out`.
  """
  out = pathlib.Path(out)
  out.mkdir(parents=True, exist_ok=True)
  for name, rows in (("leaderboard", board.rows), ("leaderboard_overall", board.overall.rows)):
    flat = [_flat(r) for r in rows]
    tables.write_table(
      out / f"{name}.parquet",
      {k: [r.get(k) for r in flat] for k in dict.fromkeys(k for r in flat for k in r)},
    )
  hidden = ("stream_latency_steps", "stream_healthy_alarms", "healthy_steps")
  overall = board.overall
  meta = meta | {
    "references": sorted({r["detector"] for r in board.rows if r["reference"]}),
    "critical_difference": overall.critical_difference,
    "friedman_p": overall.friedman_p,
    "blocks": overall.blocks,
  }
  shown = [{k: v for k, v in r.items() if k not in hidden} for r in board.rows]
  page.write(out / "leaderboard.html", shown, overall.rows, board.curves, board.faults, meta)
  tables.write_json(out / "leaderboard.json", meta)
  return [
    str(out / f)
    for f in (
      "leaderboard.parquet",
      "leaderboard_overall.parquet",
      "leaderboard.html",
      "leaderboard.json",
    )
  ]


def _flat(row: dict) -> dict:
  """x_ci -> x_low, x_high."""
  out: dict = {}
  for k, v in row.items():
    if k.endswith("_ci"):
      out |= {f"{k[:-3]}_low": v[0] if v else None, f"{k[:-3]}_high": v[1] if v else None}
    else:
      out[k] = v
  return out
