"""The leaderboard: every detector on the recorded streams, thresholds at one rate of false alarms, metrics with intervals, an HTML page.

For each robot: thresholds are found on healthy streams of the seeds that tune, so that nominal control steps / alarms (with restarts) = ARL0; then
the streams of the seeds that score are run once. A detector is one jitted program over all streams and several thresholds side by side.
"""
from __future__ import annotations

import inspect
import math
import time
from typing import Any, Callable, NamedTuple

import numpy as np

from mjx_cl import detectors as detectors_lib
from mjx_cl.errors import FileError, UserError, choose
from mjx_cl.scoring import limits, metrics
from mjx_cl.streams import Streams, StreamSet

THRESHOLDS = 8     # run side by side in one program
ROUNDS = 5         # of narrowing a threshold down
ORDER = 8          # of the autoregressions of the likelihood-ratio oracle
ORACLE = ("opr", "rpr")  # its declared channel: what the single-residual detectors see
CURVE = (300, 1_000, 3_000, 30_000)  # further ARL0 of the latency-against-false-alarm curves [control steps]


class Entry(NamedTuple):
  """A detector on the board.

  Attributes:
    name: on the board. build: threshold -> Detector; None for a host detector or scores.
    calibrated: has a threshold. reference: looks at nothing. about: one line.
  """
  name: str
  build: Callable[[Any], Any] | None
  calibrated: bool
  reference: bool
  about: str


class Found(NamedTuple):
  """What a detector did on one robot.

  Attributes:
    threshold: None where there is none to set. arl0: metrics.arl0 on the tuning streams. episode: metrics.episode_alarm_probability, scoring streams.
    nominal_fired, nominal_score: (N, S) on the healthy scoring streams, seed by seed. fired, score: (T, F) on the fault streams.
    us_per_sample: compute [microseconds], None where not measured. curve: [{false_alarms_per_hour, latency_mean_s, detected}].
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


class Data(NamedTuple):
  """The streams of one robot: tuning streams first, then scoring ones, in `nominal`; padded faults; labels of faults are per stream."""
  robot: str
  tune: Streams
  score: Streams
  fault: Streams
  count_from: int
  arl0: float


def variants() -> dict[str, dict]:
  """Settings by name on the board: every registered detector at its defaults, and the usual other channels and a whitened form."""
  own = {name: {"use": name} for name in detectors_lib.DETECTORS}
  scalar = lambda n: getattr(detectors_lib.DETECTORS.get(n), "takes", "") == "scalar"
  for name in ("cusum", "ewma", "glr"):
    if scalar(name):
      own[f"{name} white"] = {"use": name, "whiten": ORDER}
  if scalar("cusum"):
    own |= {f"cusum@{c}": {"use": f"cusum@{c}"} for c in ("opr", "rpr", "reward", "surprise")}
    own["cusum@groups"] = {"use": "cusum@" + "+".join(f"group_{k}" for k in range(8))}
  return own


def entry(name: str, settings: dict) -> Entry:
  """An Entry from settings {use, ...}."""
  settings = dict(settings)
  use = settings.pop("use", name)
  factory = choose("detector", use.partition("@")[0], detectors_lib.DETECTORS)
  parameters = inspect.signature(factory).parameters
  calibrated = "threshold" in parameters or any(p.kind is p.VAR_KEYWORD for p in parameters.values())
  about = (inspect.getdoc(factory) or "").split("\n")[0]
  build = (lambda threshold: detectors_lib.make(use, threshold=threshold, **settings)) if calibrated else (lambda threshold: detectors_lib.make(use, **settings))
  return Entry(name, build, calibrated, bool(getattr(factory, "reference", False)), about)


def load(streams: StreamSet, robot: str) -> Data:
  """One robot's streams."""
  tune, score = (streams.get(robot, streams.find(robot, "nominal", s)) for s in ("tune", "score"))
  numbers = [n for f, s in streams.faults(robot) for n in streams.find(robot, "fault", "score", f, s)]
  return Data(robot, tune, score, streams.get(robot, numbers), streams.suite.count_from, streams.suite.arl0)


# ---- running -------------------------------------------------------------------------------------------------------------------------

def _joined(a, b):
  """Two residuals side by side, cut to the shorter."""
  import jax
  steps = min(len(a.opr), len(b.opr))
  return jax.tree.map(lambda x, y: np.concatenate([x[:steps], y[:steps]], 1), a, b)


def _padded(residual, steps: int, streams: int):
  """A residual filled up with unknown rows and streams, so that one compiled program serves every robot."""
  import jax

  def fill(x):
    shape = (steps, streams) + x.shape[2:]
    out = np.zeros(shape, bool) if x.dtype == bool else np.full(shape, np.nan, x.dtype)
    out[:x.shape[0], :x.shape[1]] = x
    return out
  return jax.tree.map(fill, residual)


def program(build):
  """(thresholds (K,), residual (T, S)) -> (fired bool (K, T, S), score float32 (K, T, S)), jitted."""
  import jax
  import jax.numpy as jnp

  def run(thresholds, residual):
    streams = residual.opr.shape[1]

    def one(threshold):
      detector = build(threshold)
      start = jax.tree.map(lambda x: jnp.broadcast_to(x, (streams,) + jnp.shape(x)), detector.init())
      alarm = jax.lax.scan(jax.vmap(detector.update), start, residual)[1]
      return alarm.fired, alarm.score
    return jax.vmap(one)(thresholds)
  return jax.jit(run)


def narrow(count: Callable[[np.ndarray], np.ndarray], scores: np.ndarray, target: float) -> tuple[float, list[tuple[float, int]]]:
  """The least threshold found with at most `target` alarms.

  Args:
    count: thresholds (K,) -> alarms (K,). scores: of the healthy streams without restarts, nan unknown. target: alarms.
  Returns:
    (threshold, [(threshold, alarms)] of all that were tried); infinity where no score is known.
  """
  known = scores[np.isfinite(scores)]
  if not len(known):
    return math.inf, []
  top = float(known.max())
  top += max(abs(top) * 1e-3, 1e-6)
  grid = np.unique(np.append(np.quantile(known, 1 - np.geomspace(0.3, 1e-5, THRESHOLDS - 1)), top))
  low, tried = float(known.min()), []
  for _ in range(ROUNDS):
    grid = np.sort(np.append(grid, [grid[-1]] * (THRESHOLDS - len(grid))))[:THRESHOLDS]
    found = count(grid.astype(np.float32))
    tried += [(float(t), int(c)) for t, c in zip(grid, found)]
    good = [t for t, c in tried if c <= target]
    high = min(good) if good else None
    if high is None:
      return math.inf, tried
    below = [t for t, c in tried if t < high and c > target]
    under = max(below) if below else low if low < high else high - max(1.0, abs(high))
    if high - under <= 1e-5 * max(1.0, abs(high)) or (below and dict(tried)[under] - dict(tried)[high] <= 1):
      break
    wide = under > 0 and high / under > 8
    grid = (np.geomspace(under, high, THRESHOLDS + 2) if wide else np.linspace(under, high, THRESHOLDS + 2))[1:-1]
  return high, tried


def _at(tried, steps: float, arl0: float) -> float:
  """Of the thresholds that were tried the one whose ARL0 is nearest."""
  return min(tried, key=lambda x: abs(math.log(steps / max(0.5, x[1])) - math.log(arl0)))[0]


def examine(one: Entry, data: Data, nominal, faults, run=None) -> Found:
  """Calibrates a detector on one robot and runs it.

  Args:
    nominal: monitor.Residual of the tuning, then the scoring streams. faults: of the fault streams, padded. run: of `program`, compiled before.
  """
  run = run or program(one.build)
  tune = data.tune.residual.opr.shape[1]
  streams, steps = data.fault.residual.opr.shape[1], data.fault.residual.opr.shape[0]
  counted = tune * (len(nominal.opr) - data.count_from)
  same = lambda t: np.full(THRESHOLDS, t, np.float32)
  kept: dict[float, tuple[np.ndarray, np.ndarray]] = {}

  def count(thresholds):
    fired, score = (np.asarray(x) for x in run(thresholds, nominal))
    alarms = fired[:, data.count_from:, :tune].sum((1, 2))
    for t, f, s in zip(thresholds, fired, score):
      kept[float(t)] = f, s
    return alarms
  if one.calibrated:
    free = np.asarray(run(same(np.inf), nominal)[1])[0]
    threshold, tried = narrow(count, free[data.count_from:, :tune], counted / data.arl0)
    kept = {k: v for k, v in kept.items() if k == float(np.float32(threshold))}
    if not math.isfinite(threshold):
      kept = {}
    levels = [threshold] + [_at(tried, counted, a) for a in CURVE] if tried else [threshold]
  else:
    threshold, tried, levels = math.nan, [], [0.0]
  fired, score = kept.popitem()[1] if kept else tuple(np.asarray(x)[0] for x in run(same(threshold if one.calibrated else 0.0), nominal))
  levels = np.asarray((levels + [levels[0]] * THRESHOLDS)[:THRESHOLDS], np.float32)
  run(levels, faults)[0].block_until_ready()
  begin = time.perf_counter()
  out = run(levels, faults)
  out[0].block_until_ready()
  us = (time.perf_counter() - begin) / (THRESHOLDS * faults.opr.size) * 1e6
  fault_fired, fault_score = (np.asarray(x)[:, :steps, :streams] for x in out)
  curve = _curve([(counts_of(tried, t), f) for t, f in zip(levels[:1 + len(CURVE)], fault_fired)], data, counted) if tried else []
  return found(data, None if not one.calibrated else float(np.float32(threshold)), fired, score, fault_fired[0], fault_score[0], us, curve)


def counts_of(tried, threshold) -> int | None:
  """Alarms that were counted at a threshold."""
  return next((c for t, c in tried if np.float32(t) == np.float32(threshold)), None)


def _curve(pairs, data: Data, counted: float) -> list[dict]:
  """Latency against false alarms: mean over fault streams of min(delay, horizon), a miss counts the horizon."""
  control_s, horizon = data.fault.control_s, int(metrics.HORIZON_S / data.fault.control_s)
  points = {}
  for alarms, fired in pairs:
    if alarms is None:
      continue
    latency = metrics.latencies(fired, data.fault.onset, horizon)
    rate = alarms / (counted * control_s / 3600)
    points[rate] = {"false_alarms_per_hour": rate, "latency_mean_s": float(np.mean(np.minimum(latency + 1, horizon)) * control_s),
                    "detected": float(np.isfinite(latency).mean())}
  return [points[k] for k in sorted(points)]


def found(data: Data, threshold, fired, score, fault_fired, fault_score, us=None, curve=()) -> Found:
  """Found from raw alarms and scores: (N, tuning + scoring streams) on healthy streams, (T, F) on fault streams."""
  tune = data.tune.residual.opr.shape[1]
  steps = min(len(fired), len(data.score.episode))
  episode = metrics.episode_alarm_probability(fired[:steps, tune:], data.score.episode[:steps], data.count_from)
  stacked = [_by_seed(x[:, tune:], data.score.seed, data.count_from) for x in (fired, score)]
  return Found(threshold, metrics.arl0(fired[:, :tune], data.count_from), episode, *stacked, fault_fired, fault_score, us, list(curve))


def _by_seed(x: np.ndarray, seeds: np.ndarray, count_from: int) -> np.ndarray:
  """Several streams of a seed one after the other, their first `count_from` steps once at the front: (steps, seeds)."""
  columns = []
  for seed in dict.fromkeys(seeds.tolist()):
    own = np.flatnonzero(seeds == seed)
    columns.append(np.concatenate([x[:count_from, own[0]]] + [x[count_from:, k] for k in own]))
  return np.stack(columns, -1)


# ---- oracles -------------------------------------------------------------------------------------------------------------------------

class Oracle(NamedTuple):
  """What is known of one fault: latencies of the likelihood-ratio CUSUM (S,), and limits."""
  latency: np.ndarray
  fired: np.ndarray
  score: np.ndarray
  nominal_fired: np.ndarray
  nominal_score: np.ndarray
  threshold: float
  arl0: dict
  limits: dict


def _channels(residual, columns=slice(None)) -> np.ndarray:
  """ln of the oracle's channels, (T, S, C)."""
  return np.stack([np.log(np.maximum(getattr(residual, c)[:, columns].astype(float), 1e-9)) for c in ORACLE], -1)


def restarted(ratio: np.ndarray, thresholds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """CUSUM with restarts of log-likelihood ratios (T, S), nan = skipped, at one threshold for each stream: (fired, score), (T, S)."""
  evidence, fired, score = np.zeros(ratio.shape[1]), np.zeros(ratio.shape, bool), np.full(ratio.shape, np.nan)
  known = np.isfinite(ratio)
  for t in range(len(ratio)):
    now = np.maximum(0.0, evidence + np.where(known[t], ratio[t], 0.0))
    score[t] = np.where(known[t], now, np.nan)
    fired[t] = known[t] & (now > thresholds)
    evidence = np.where(fired[t], 0.0, now)
  return fired, score


def oracles(streams: StreamSet, data: Data) -> dict[tuple[str, float], Oracle]:
  """The likelihood-ratio CUSUM of every fault: fitted on the seeds that tune, calibrated on their healthy streams, run on the seeds that score."""
  keys, robot = streams.faults(data.robot), data.robot
  each = data.tune.residual.opr.shape[1] // len(dict.fromkeys(data.tune.seed.tolist()))
  healthy_fit = _channels(data.tune.residual, slice(None, None, each))[data.count_from:]
  pad = lambda r: np.concatenate([np.full((ORDER,) + r.shape[1:], np.nan), r])
  ratios, limit = {}, {}
  for key in keys:
    tuned = streams.get(robot, streams.find(robot, "fault", "tune", *key))
    horizon = int(metrics.HORIZON_S / tuned.control_s)
    after = np.stack([_channels(tuned.residual, slice(s, s + 1))[o:o + horizon, 0] for s, o in enumerate(tuned.onset)], 1)
    p = limits.fit(healthy_fit, after, ORDER)
    own = np.flatnonzero([f == key[0] and s == key[1] for f, s in zip(data.fault.fault, data.fault.severity)])
    ratios[key] = [pad(limits.log_ratio(_channels(x.residual, c), p)) for x, c in ((data.tune, slice(None)), (data.score, slice(None)), (data.fault, own))]
    limit[key] = limits.information(healthy_fit, after, ORDER) | limits.closed_form(healthy_fit[..., 0], after[..., 0], data.arl0, ORDER)
  lanes = data.tune.residual.opr.shape[1]
  tune_ratio = np.concatenate([ratios[k][0] for k in keys], 1)
  counted = lanes * (len(tune_ratio) - data.count_from)
  low, high = np.zeros(len(keys)), np.full(len(keys), 40.0)
  for _ in range(14):
    middle = (low + high) / 2
    alarms = restarted(tune_ratio, np.repeat(middle, lanes))[0][data.count_from:].sum(0).reshape(len(keys), lanes).sum(1)
    few = alarms <= counted / data.arl0
    low, high = np.where(few, low, middle), np.where(few, middle, high)
  out = {}
  for k, key in enumerate(keys):
    run = lambda r: restarted(r, np.full(r.shape[1], high[k]))
    (tuned_fired, _), (nominal_fired, nominal_score), (fired, score) = (run(r) for r in ratios[key])
    own = np.flatnonzero([f == key[0] and s == key[1] for f, s in zip(data.fault.fault, data.fault.severity)])
    horizon = int(metrics.HORIZON_S / data.fault.control_s)
    latency = metrics.latencies(fired, data.fault.onset[own], horizon)
    stack = lambda x: _by_seed(x, data.score.seed, data.count_from)
    out[key] = Oracle(latency, fired, score, stack(nominal_fired), stack(nominal_score), float(high[k]), metrics.arl0(tuned_fired, data.count_from), limit[key])
  return out


# ---- rows ----------------------------------------------------------------------------------------------------------------------------

def rows_of(name: str, reference: bool, result: Found, data: Data, oracle: dict) -> list[dict]:
  """One row per fault and severity."""
  out = []
  horizon = int(metrics.HORIZON_S / data.fault.control_s)
  for key in oracle:
    own = np.flatnonzero([f == key[0] and s == key[1] for f, s in zip(data.fault.fault, data.fault.severity)])
    onset = data.fault.onset[own]
    row = metrics.row(result.fired[:, own], result.score[:, own], onset, result.nominal_fired, result.nominal_score, data.fault.control_s, data.count_from)
    out.append(_labelled(name, reference, data, key, row, result.threshold, result.arl0, result.episode, result.us_per_sample, oracle[key],
                         metrics.latencies(result.fired[:, own], onset, horizon), horizon))
  return out


def _labelled(name, reference, data, key, row, threshold, arl0, episode, us, oracle, latency, horizon) -> dict:
  share = limits.efficiency(oracle.latency, latency, horizon)
  known = {k: oracle.limits[k] for k in ("information_nats_per_step", "information_nats_per_step_ci", "optimal_delay_steps")}
  notes = [n for n in (share["note"], oracle.limits["note"] if name == "likelihood_ratio (oracle)" else None) if n]
  return {"detector": name, "reference": reference, "robot": data.robot, "fault": key[0], "severity": key[1],
          "threshold": threshold if threshold is None or math.isfinite(threshold) else None,
          "arl0": arl0["arl0"], "arl0_ci": arl0["arl0_ci"], "arl0_alarms": arl0["alarms"], "arl0_few": arl0["few"],
          "episode_alarm_probability": episode["episode_alarm_probability"], "episode_alarm_probability_ci": episode["episode_alarm_probability_ci"],
          **row, "us_per_sample": us, **known, "oracle_delay_steps": share["oracle_delay_steps"], "delay_steps": share["delay_steps"],
          "efficiency": share["efficiency"], "efficiency_ci": share["efficiency_ci"], "note": "; ".join(notes) or None}


def oracle_rows(data: Data, oracle: dict) -> list[dict]:
  """Rows of the two oracles: the true onset, and the likelihood-ratio CUSUM."""
  out = []
  horizon = int(metrics.HORIZON_S / data.fault.control_s)
  nothing = {"episode_alarm_probability": None, "episode_alarm_probability_ci": None}
  for key, o in oracle.items():
    own = np.flatnonzero([f == key[0] and s == key[1] for f, s in zip(data.fault.fault, data.fault.severity)])
    onset = data.fault.onset[own]
    row = metrics.row(o.fired, o.score, onset, o.nominal_fired, o.nominal_score, data.fault.control_s, data.count_from)
    out.append(_labelled("likelihood_ratio (oracle)", True, data, key, row, o.threshold, o.arl0, nothing, None, o, o.latency, horizon))
    fired = np.zeros((data.fault.residual.opr.shape[0], len(own)), bool)
    fired[onset, np.arange(len(own))] = True
    score = (np.arange(len(fired))[:, None] >= onset).astype(float)
    never = np.zeros_like(o.nominal_fired)
    row = metrics.row(fired, score, onset, never, never.astype(float), data.fault.control_s, data.count_from)
    none = {"arl0": None, "arl0_ci": None, "alarms": 0, "few": False}
    out.append(_labelled("true onset (oracle)", True, data, key, row, None, none, nothing, None, o, np.zeros(len(own)), horizon))
  return out


class Board(NamedTuple):
  """Attributes: rows: one dict per detector, robot, fault and severity. overall: metrics.Overall. curves, faults: for the page. seconds: wall time.
  stream_steps: stream-steps scored, calibration runs not counted twice."""
  rows: list[dict]
  overall: metrics.Overall
  curves: dict
  faults: list[dict]
  seconds: float
  stream_steps: int


def score(streams: StreamSet, entries: list[Entry], robots=(), extra=(), progress=lambda robot, name, k, n, seconds: None) -> Board:
  """Scores detectors on a recorded set.

  Args:
    entries: detectors. robots: all where empty.
    extra: ((name, Data -> Found), ...), detectors that are run by something else: a host class, a file of scores.
  """
  begin = time.perf_counter()
  for r in robots:
    if r not in streams.robots:
      raise UserError(f"this set has no robot {r!r}; choose from: {', '.join(streams.robots)}")
  held = {r: load(streams, r) for r in (robots or streams.robots)}
  steps, wide = (max(d.fault.residual.opr.shape[k] for d in held.values()) for k in (0, 1))
  programs = {e.name: program(e.build) for e in entries}
  rows, curves, pages, n = [], {}, [], len(held) * (len(entries) + len(extra) + 1)
  done = lived = 0
  for robot, data in held.items():
    nominal, faults = _joined(data.tune.residual, data.score.residual), _padded(data.fault.residual, steps, wide)
    oracle = oracles(streams, data)
    rows += oracle_rows(data, oracle)
    done += 1
    progress(robot, "oracles", done, n, time.perf_counter() - begin)
    alarms: dict[str, np.ndarray] = {}
    for name, get in [(e.name, lambda d, e=e: examine(e, d, nominal, faults, programs[e.name])) for e in entries] + list(extra):
      result = get(data)
      reference = next((e.reference for e in entries if e.name == name), False)
      rows += rows_of(name, reference, result, data, oracle)
      curves.setdefault(name, {})[robot] = result.curve
      alarms[name] = result.fired
      lived += nominal.opr.size + data.fault.residual.opr.size
      done += 1
      progress(robot, name, done, n, time.perf_counter() - begin)
    pages += _pages(data, oracle, alarms)
  return Board(rows, metrics.overall(rows), {k: v for k, v in curves.items() if any(v.values())}, pages, time.perf_counter() - begin, lived)


def _pages(data: Data, oracle: dict, alarms: dict) -> list[dict]:
  """For each fault the streams of the first scoring seed around the onset, thinned, and each detector's first alarm there."""
  out, control_s = [], data.fault.control_s
  horizon = int(metrics.HORIZON_S / control_s)
  for key, o in oracle.items():
    own = np.flatnonzero([f == key[0] and s == key[1] for f, s in zip(data.fault.fault, data.fault.severity)])
    k, onset = int(own[0]), int(data.fault.onset[own[0]])
    window = slice(max(0, onset - horizon // 2), onset + horizon)
    thin = max(1, (window.stop - window.start) // 300)
    channels = {c: getattr(data.fault.residual, c)[window, k] for c in ("opr", "rpr", "reward", "surprise")}
    values = {c: [None if not math.isfinite(v) else float(f"{v:.4g}") for v in x[::thin]] for c, x in channels.items()}
    first = {}
    for name, fired in alarms.items():
      hit = np.flatnonzero(fired[onset:onset + horizon, k])
      first[name] = int(onset + hit[0]) if len(hit) else None
    hit = np.flatnonzero(o.fired[onset:onset + horizon, 0])
    first["likelihood_ratio (oracle)"] = int(onset + hit[0]) if len(hit) else None
    out.append({"robot": data.robot, "fault": key[0], "severity": key[1], "target": data.fault.target[k], "seed": int(data.fault.seed[k]),
                "onset": onset, "first": window.start, "every": thin, "control_s": control_s, "channels": values, "alarms": first})
  return out


# ---- other ways in -------------------------------------------------------------------------------------------------------------------

def crossings(score: np.ndarray, threshold: float) -> np.ndarray:
  """Alarms of scores (T, S): where a known score rises above `threshold`; the next alarm needs a score at or below it first."""
  over = score > threshold
  known = np.isfinite(score)
  at = np.arange(len(score))[:, None]
  last = np.maximum.accumulate(np.where(known, at, -1), 0)
  before = np.concatenate([np.full((1,) + score.shape[1:], -1), last[:-1]])
  was = np.take_along_axis(over, np.maximum(before, 0), 0) & (before >= 0)
  return over & known & ~was


def from_scores(scores: dict[int, np.ndarray]) -> Callable[[Data], Found]:
  """Data -> Found for scores that someone else computed, stream -> float (steps,); calibrated like the others."""
  def get(data: Data) -> Found:
    def column(own: Streams, steps: int) -> np.ndarray:
      out = np.full((steps, len(own.stream)), np.nan)
      for k, n in enumerate(own.stream):
        x = np.asarray(scores[int(n)], float)[:steps]
        out[:len(x), k] = x
      return out
    steps = min(len(data.tune.residual.opr), len(data.score.residual.opr))
    nominal = np.concatenate([column(data.tune, steps), column(data.score, steps)], 1)
    fault = column(data.fault, len(data.fault.residual.opr))
    tune = data.tune.residual.opr.shape[1]
    counted = tune * (steps - data.count_from)
    count = lambda thresholds: np.asarray([crossings(nominal[:, :tune], t)[data.count_from:].sum() for t in thresholds])
    threshold, tried = narrow(count, nominal[data.count_from:, :tune], counted / data.arl0)
    levels = [threshold] + [_at(tried, counted, a) for a in CURVE] if tried else [threshold]
    curve = _curve([(counts_of(tried, t), crossings(fault, t)) for t in levels], data, counted) if tried else []
    return found(data, threshold, crossings(nominal, threshold), nominal, crossings(fault, threshold), fault, None, curve)
  return get


def read_submission(path, streams: StreamSet) -> dict[int, np.ndarray]:
  """Checks and reads a file of scores: Parquet with the columns stream, step, score, a row for every control step of every stream of the set
  but those of kind `past`.

  Raises:
    FileError, one line: unreadable, a missing column or stream, a wrong length, an infinite score, all scores unknown, or a score that looks ahead:
    streams of kind `probe` are others cut off, and their scores must be those of the whole stream up to there.
  """
  from mjx_cl import store
  table = store.read_table(path)
  if not {"stream", "step", "score"} <= set(table):
    raise FileError(f"{path}: needs the columns stream, step, score; it has {', '.join(table)}")
  number, step, score = (np.asarray(table[k], float) for k in ("stream", "step", "score"))
  if np.isinf(score).any():
    raise FileError(f"{path}: a score is infinite in stream {int(number[np.isinf(score)][0])}; leave out (null) what is not known")
  m = streams.meta
  want = {int(n): int(s) for n, s, k, f in zip(m["stream"], m["steps"], m["kind"], m["full"]) if k != "past" and f}
  out: dict[int, np.ndarray] = {}
  order = np.lexsort((step, number))
  number, step, score = number[order], step[order], score[order]
  at = {int(n): (i, c) for n, i, c in zip(*np.unique(number, return_index=True, return_counts=True))}
  missing = sorted(set(want) - set(at))
  if missing:
    raise FileError(f"{path}: {len(missing)} of {len(want)} streams are missing, the first is stream {missing[0]}")
  for n, steps in want.items():
    i, c = at[n]
    if c != steps or not np.array_equal(step[i:i + c], np.arange(steps)):
      raise FileError(f"{path}: stream {n} must have one row for each of its steps 0 to {steps - 1}; it has {c} rows")
    out[n] = score[i:i + c]
  if not any(np.isfinite(x).any() for x in out.values()):
    raise FileError(f"{path}: no score is known")
  for n, prefix in ((int(n), int(p)) for n, k, p in zip(m["stream"], m["kind"], m["prefix"]) if k == "probe"):
    whole, cut = out[prefix][:want[n]], out[n]
    if not np.allclose(whole, cut, rtol=1e-3, atol=1e-6, equal_nan=True):  # a sum in another order is no look ahead
      first = int(np.flatnonzero(~np.isclose(whole, cut, rtol=1e-3, atol=1e-6, equal_nan=True))[0])
      raise FileError(f"{path}: the score looks ahead: stream {n} is stream {prefix} cut off after {want[n]} steps, yet their scores differ from step {first} on")
  return out


def from_host(host, threshold_name: str | None = None) -> Callable[[Data], Found]:
  """Data -> Found for a plain Python class, see detectors.host.

  Args:
    host: detectors.host.HostDetector, or with `threshold_name` a function of one setting's value to one.
    threshold_name: setting that is calibrated to the ARL0, larger = fewer alarms; None: run as it is, its own ARL0 printed.
  """
  from mjx_cl.detectors import host as host_lib

  def get(data: Data) -> Found:
    def run(detector, residual):
      x = np.asarray(getattr(residual, detector.channel) if not detector.channel.startswith("group_") else residual.groups[..., int(detector.channel[6:])], float)
      x = np.log(np.maximum(x, 1e-9)) if detector.log else x
      return host_lib.run_host(detector.factory, x, detector.host_name)
    tune = data.tune.residual.opr.shape[1]
    nominal = _joined(data.tune.residual, data.score.residual)
    value = None
    if threshold_name:
      counted = tune * (len(nominal.opr) - data.count_from)
      alarms = lambda v: int(run(host(v), data.tune.residual)[0][data.count_from:].sum())
      low, high = 0.0, 1.0
      while alarms(high) > counted / data.arl0 and high < 1e9:
        low, high = high, high * 8
      for _ in range(8):
        middle = (low + high) / 2
        low, high = (low, middle) if alarms(middle) <= counted / data.arl0 else (middle, high)
      value = high
    detector = host(value) if threshold_name else host
    fired, score = run(detector, nominal)
    begin = time.perf_counter()
    fault_fired, fault_score = run(detector, data.fault.residual)
    us = (time.perf_counter() - begin) / data.fault.residual.opr.size * 1e6
    return found(data, value, fired, score, fault_fired, fault_score, us)
  return get


def export(streams: StreamSet, folder) -> list[str]:
  """Every stream that a submission needs, in full, as ROBOT.parquet with its past joined: for tools that know nothing of this package."""
  import pathlib
  from mjx_cl import store
  from mjx_cl.streams import COLUMNS
  folder = pathlib.Path(folder)
  folder.mkdir(parents=True, exist_ok=True)
  written = []
  for robot in streams.robots:
    numbers = [n for n, r, k, f in zip(streams.meta["stream"], streams.meta["robot"], streams.meta["kind"], streams.meta["full"])
               if r == robot and k != "past" and f]
    table: dict[str, list] = {k: [] for k in ("stream", "step", "episode", "terminated") + COLUMNS}
    for n in numbers:
      one = streams.get(robot, [n])
      r, steps = one.residual, len(one.episode)
      values = {"stream": np.full(steps, n, np.int32), "step": np.arange(steps, dtype=np.int32), "episode": one.episode[:, 0], "terminated": r.terminated[:, 0],
                **{c: (r.groups[:, 0, int(c[6:])] if c.startswith("group_") else getattr(r, c)[:, 0]) for c in COLUMNS}}
      for k, v in values.items():
        table[k].append(v)
    store.write_table(folder / f"{robot}.parquet", {k: np.concatenate(v) for k, v in table.items()}, level=9)
    written.append(str(folder / f"{robot}.parquet"))
  return written


# ---- writing -------------------------------------------------------------------------------------------------------------------------

def write(board: Board, out, meta: dict) -> list[str]:
  """leaderboard.parquet (x_ci as x_low, x_high), leaderboard_overall.parquet and leaderboard.html in the folder `out`."""
  import pathlib
  from mjx_cl import page, store
  out = pathlib.Path(out)
  out.mkdir(parents=True, exist_ok=True)
  for name, rows in (("leaderboard", board.rows), ("leaderboard_overall", board.overall.rows)):
    flat = [_flat(r) for r in rows]
    store.write_table(out / f"{name}.parquet", {k: [r.get(k) for r in flat] for k in dict.fromkeys(k for r in flat for k in r)})
  hidden = ("stream_latency_steps", "stream_healthy_alarms", "healthy_steps")
  meta = meta | {"references": sorted({r["detector"] for r in board.rows if r["reference"]}), "critical_difference": board.overall.critical_difference, "friedman_p": board.overall.friedman_p, "blocks": board.overall.blocks}
  page.write(out / "leaderboard.html", [{k: v for k, v in r.items() if k not in hidden} for r in board.rows], board.overall.rows, board.curves, board.faults, meta)
  store.write_json(out / "leaderboard.json", meta)
  return [str(out / f) for f in ("leaderboard.parquet", "leaderboard_overall.parquet", "leaderboard.html", "leaderboard.json")]


def _flat(row: dict) -> dict:
  """x_ci -> x_low, x_high."""
  out = {}
  for k, v in row.items():
    if k.endswith("_ci"):
      out |= {f"{k[:-3]}_low": v[0] if v else None, f"{k[:-3]}_high": v[1] if v else None}
    else:
      out[k] = v
  return out
