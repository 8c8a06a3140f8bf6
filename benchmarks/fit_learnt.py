"""Fits detector `learnt` on recorded streams: `python benchmarks/fit_learnt.py`.

Healthy streams and tuning faults of the seeds that tune, of each robot; writes the fits of the
agents that acted into mjx_cl/detectors/learnt.json, beside those of others. `--left-out` prints
instead, for each tuning fault, the score of a fit that has not seen it, and of one that has seen it
on other seeds: mean over its streams of 100 2^(-latency / 5 s), 0 where it is missed, at one alarm
in 10,000 healthy control steps.
"""

import argparse
import json
import pathlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize, special

from mjx_cl import __version__
from mjx_cl.detectors import learnt
from mjx_cl.detectors.multivariate import pick
from mjx_cl.io import folders, runtime
from mjx_cl.leaderboard.streams import Streams, StreamSet

SETTLED = 500  # control steps after which averages that begin with 0 are a healthy robot's
EVERY, AFTER = (16, 8), 5  # rows taken of healthy and faulty streams; the first after an onset
HALF_S, LEAST = 10.0, 0.1  # weight of a row t after its onset: LEAST + 2^(-t / HALF_S)
PENALTY = 1e-3  # of squared weights
SHRINK = 0.1
UNIT, ARL0 = 20_000, 10_000  # healthy control steps for each alarm: of a unit, of --left-out
QUIET = 200  # control steps after an alarm in which no other counts


class Set(NamedTuple):
  """Averages of streams, without restarts.

  Attributes:
    averages: (T, S, r, p).
    known: bool (T, S).
    of: the streams.
  """

  averages: np.ndarray
  known: np.ndarray
  of: Streams


def channels(streams: Streams) -> tuple[np.ndarray, np.ndarray]:
  """(T, S, p) and (T, S): `multivariate.pick` of every row."""
  look = jax.vmap(jax.vmap(lambda row: pick(row, learnt.CHANNELS, True)))
  x, known = jax.jit(look)(streams.residual)
  return np.asarray(x), np.asarray(known)


def averages(streams: Streams, fit: learnt.Fit) -> Set:
  """The averages that the detector holds at each row if it never alarms."""
  x, known = channels(streams)

  def step(held: jax.Array, row: tuple) -> tuple[jax.Array, jax.Array]:
    new = jax.vmap(learnt.averaged)(held, (row[0] - fit.mean) / fit.std)
    held = jnp.where(row[1][:, None, None], new, held)
    return held, held

  begin = jnp.zeros((x.shape[1], len(learnt.RATES), x.shape[2]))
  _, out = jax.jit(lambda x, known: jax.lax.scan(step, begin, (x, known)))(x, known)
  return Set(np.asarray(out), known, streams)


def reference(streams: Streams) -> tuple[learnt.Fit, Set]:
  """What is known of healthy robots, without weights."""
  x, known = channels(streams)
  late = np.arange(len(x))[:, None] >= SETTLED
  seen = x[known & late]
  p, r = len(learnt.CHANNELS), len(learnt.RATES)
  fit = learnt.Fit(seen.mean(0), seen.std(0) + 1e-6, *[np.zeros((r, p))] * 2, *[0.0] * 4)
  held = averages(streams, fit)
  seen = held.averages[known & late]
  cov = np.cov(seen[:, -1].T)
  cov = (1 - SHRINK) * cov + SHRINK * np.diag(np.diag(cov))
  fit = fit._replace(level=seen.mean(0), spread=seen.std(0) + 1e-6, inverse=np.linalg.inv(cov))
  return fit, held


def features(held: Set, at: np.ndarray, fit: learnt.Fit) -> np.ndarray:
  """(n, 2 r p) of the rows where `at` (T, S)."""
  each = jax.jit(jax.vmap(lambda a: learnt.standardised(a, fit)))
  return np.asarray(each(held.averages[at])).reshape(at.sum(), -1)


def regress(healthy: np.ndarray, faulty: np.ndarray, weight: np.ndarray) -> np.ndarray:
  """Logistic regression, [b, w...]; healthy and faulty rows weigh the same together."""
  x = np.concatenate([healthy, faulty])
  sign = np.r_[-np.ones(len(healthy)), np.ones(len(faulty))]
  share = np.r_[np.full(len(healthy), 0.5 / len(healthy)), 0.5 * weight / weight.sum()]

  def loss(b: np.ndarray) -> tuple[float, np.ndarray]:
    u = sign * (x @ b[1:] + b[0])
    slope = -share * sign * special.expit(-u)
    value = share @ np.logaddexp(0, -u) + PENALTY * b[1:] @ b[1:]
    return value, np.r_[slope.sum(), x.T @ slope + 2 * PENALTY * b[1:]]

  begin = np.zeros(x.shape[1] + 1)
  return optimize.minimize(loss, begin, jac=True, method="L-BFGS-B", options={"maxiter": 300}).x


def rows(healthy: Any, faulty: Any, use: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Rows that a fit takes, bool (T, S), of two sets with `known` and `of`: healthy ones and those
  of the fault streams `use`; and the weights of the latter.
  """
  t = np.arange(len(faulty.known))[:, None] - faulty.of.onset
  at = faulty.known & use & (t >= AFTER) & (t % EVERY[1] == 0)
  step = np.arange(len(healthy.known))[:, None]
  quiet = healthy.known & (step >= SETTLED) & (step % EVERY[0] == 0)
  weight = LEAST + 2 ** (-np.broadcast_to(t, at.shape)[at] * faulty.of.control_s / HALF_S)
  return quiet, at, weight


def weighed(fit: learnt.Fit, healthy: Set, faulty: Set, use: np.ndarray) -> learnt.Fit:
  """With weights learnt from the fault streams `use`, and units."""
  quiet, at, weight = rows(healthy, faulty, use)
  b = regress(features(healthy, quiet, fit), features(faulty, at, fit), weight)
  shape = (2, len(learnt.RATES), len(learnt.CHANNELS))
  fit = fit._replace(weights=b[1:].reshape(shape), bias=b[0], units=np.ones(2))
  middle = np.median(scores(healthy, fit)[1][healthy.known])
  fit = fit._replace(bias=fit.bias - middle)
  return fit._replace(units=np.array([level(s, UNIT) for s in scores(healthy, fit)]))


def scores(held: Set, fit: learnt.Fit) -> np.ndarray:
  """(2, T, S) of learnt.LOOKS, in units."""
  both = lambda a: jnp.stack([learnt.distance(a, fit), learnt.ratio(a, fit)]) / fit.units
  out = np.asarray(jax.jit(jax.vmap(jax.vmap(both)))(held.averages))
  return np.where(held.known, np.moveaxis(out, -1, 0), -np.inf)


def level(score: np.ndarray, arl0: int) -> float:
  """Threshold of one alarm in `arl0` healthy control steps."""
  score = score[SETTLED:]
  want = score.size / arl0

  def alarms(threshold: float) -> int:
    count = 0
    for own in score.T:
      last = -QUIET
      for at in np.flatnonzero(own > threshold):
        if at - last >= QUIET:
          count, last = count + 1, at
    return count

  known = np.sort(score[np.isfinite(score)])
  low, high = 0.5, 1.0
  for _ in range(30):
    middle = (low + high) / 2
    few = alarms(known[int(middle * (len(known) - 1))]) <= want
    low, high = (low, middle) if few else (middle, high)
  return float(known[int(high * (len(known) - 1))])


def found(score: np.ndarray, threshold: float, streams: Streams, horizon_s: float) -> np.ndarray:
  """100 2^(-latency / 5 s) of each stream."""
  out = []
  for own, onset in zip(score.T, streams.onset):
    late = np.flatnonzero(own[onset : onset + int(horizon_s / streams.control_s)] > threshold)
    out.append(100 * 2 ** (-(late[0] + 1) * streams.control_s / 5) if len(late) else 0.0)
  return np.array(out)


def left_out(fit: learnt.Fit, healthy: Set, faulty: Set, horizon_s: float) -> dict[str, list]:
  """{tuning fault: scores of the distance, the ratio and both, by fits that have not seen it, and
  of both by fits that have, on every other seed}.
  """
  names, odd, out = np.array(faulty.of.fault), faulty.of.seed % 2, {}

  def each(use: np.ndarray, at: np.ndarray) -> np.ndarray:
    own = weighed(fit, healthy, faulty, use)
    quiet, loud = (scores(held, own) for held in (healthy, faulty))
    looks = [(quiet[0], loud[0]), (quiet[1], loud[1]), (quiet.max(0), loud.max(0))]
    return np.stack([found(b, level(a, ARL0), faulty.of, horizon_s)[at] for a, b in looks])

  for name in dict.fromkeys(names):
    own = names == name
    unseen = each(~own, own).mean(1).tolist()
    halves = [own & (odd == half) for half in (0, 1)]
    seen = np.concatenate([each(~at, at)[2] for at in halves]).mean()
    out[name] = [*unseen, float(seen)]
  return out


def main() -> None:
  """The command."""
  parser = argparse.ArgumentParser(description=__doc__)
  parser.add_argument("--streams", help="a recorded set; default: the one that ships")
  parser.add_argument("--left-out", action="store_true")
  given = parser.parse_args()
  runtime.setup()
  streams = StreamSet(given.streams)
  target = pathlib.Path(learnt.__file__).with_suffix(".json")
  held = json.loads(target.read_text())
  for robot in streams.robots:
    told = {name.split(":")[0] for name in streams.suite.robots[robot].get("tune", {})}
    fit, healthy = reference(streams.get(robot, streams.find(robot, "nominal", "tune")))
    own = [key for key in streams.faults(robot, "tune") if key[0] in told]
    numbers = np.concatenate([streams.find(robot, "fault", "tune", *key) for key in own])
    faulty = averages(streams.get(robot, numbers), fit)
    if given.left_out:
      table = left_out(fit, healthy, faulty, streams.suite.horizon_s)
      table["mean"] = np.mean(list(table.values()), 0).tolist()
      for name, row in table.items():
        print(f"{robot:10} {name:16}", *(f"{x:6.1f}" for x in row))
      continue
    fit = weighed(fit, healthy, faulty, np.ones(len(numbers), bool))
    short = lambda x: np.vectorize(lambda v: float(f"{v:.6g}"))(np.asarray(x, float)).tolist()
    held["agents"][streams.agent(robot)] = {k: short(v) for k, v in fit._asdict().items()}
  if not given.left_out:
    held |= {"version": __version__}
    folders.atomic(target, lambda file: file.write((json.dumps(held) + "\n").encode()))


if __name__ == "__main__":
  main()
