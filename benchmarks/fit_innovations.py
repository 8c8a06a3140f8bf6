"""Fits detector `innovations` on recorded streams: `python benchmarks/fit_innovations.py`.

Healthy streams and tuning faults of the seeds that tune, of each robot of a set that holds
innovations; writes mjx_cl/detectors/fits/AGENT.npz, or --out FOLDER/innovations.npz for an agent of
one's own. `--left-out` prints instead, for each tuning fault, the score of detector `learnt` and of
this one by fits that have seen neither that fault nor its seeds, and of this one by a fit that has
seen the fault on other seeds: mean over its streams of 100 2^(-latency / 5 s), 0 where it is
missed, at one alarm in 10,000 healthy control steps of the seeds that were not fitted on.
"""

import argparse
import pathlib
import sys
from typing import Any, NamedTuple

from mjx_cl.io import runtime

runtime.setup()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))  # for its neighbours
from benchmarks import fit_learnt  # noqa: E402
from benchmarks.fit_learnt import (  # noqa: E402
  ARL0,
  SETTLED,
  SHRINK,
  UNIT,
  found,
  level,
  regress,
  rows,
)
from mjx_cl.cli import app  # noqa: E402
from mjx_cl.detectors import innovations, learnt  # noqa: E402
from mjx_cl.errors import require  # noqa: E402
from mjx_cl.io import arrays, folders  # noqa: E402
from mjx_cl.leaderboard.streams import Streams, StreamSet  # noqa: E402
from mjx_cl.training import agents  # noqa: E402

APART = 0.02  # shrinkage of the errors' correlations
RARE = 80_000  # healthy control steps for each alarm of a unit of a single look
THIN = 8  # healthy rows of which one is taken for moments of averages
N, R = innovations.N, len(innovations.RATES)


class Set(NamedTuple):
  """Streams, and what the detector would weigh in them if it never alarmed.

  Attributes:
    inputs: (T, S, i), of the ratio.
    marks: (T, S, 7), looks that count alone.
    known: bool (T, S).
    of: the streams.
  """

  inputs: np.ndarray
  marks: np.ndarray
  known: np.ndarray
  of: Streams


def samples(streams: Streams, fit: innovations.Fit) -> tuple[np.ndarray, np.ndarray]:
  """(T, S, k) and (T, S): `innovations.sample` of every row."""
  look = jax.vmap(lambda row: innovations.sample(row, fit))
  x, known = jax.lax.map(look, streams.residual)
  return np.asarray(x), np.asarray(known)


def scan(x: np.ndarray, known: np.ndarray, fit: innovations.Fit, each: Any) -> Any:
  """(T, S, ...) of `each` of the averages at every row."""

  def step(held: jax.Array, row: tuple) -> tuple[jax.Array, jax.Array]:
    y = jax.vmap(lambda z: innovations.features(z, fit))((row[0] - fit.mean) / fit.std)
    held = jnp.where(row[1][:, None, None], jax.vmap(innovations.averaged)(held, y), held)
    return held, jax.vmap(each)(held)

  begin = jnp.zeros((x.shape[1], R, N + 2 * len(fit.grain)))
  out = jax.jit(lambda x, known: jax.lax.scan(step, begin, (x, known)))(x, known)[1]
  return jax.tree.map(np.asarray, out)


def inverse(x: np.ndarray, shrinkage: float) -> np.ndarray:
  """Inverse of the correlations of x (n, C), shrunk towards independence."""
  r = np.corrcoef(x.T)
  return np.linalg.inv((1 - shrinkage) * r + shrinkage * np.eye(len(r)))


def reference(streams: Streams, grain: np.ndarray) -> innovations.Fit:
  """What is known of healthy robots, without weights."""
  p = len(grain)
  fit = innovations.Fit(*[None] * 2, grain.astype(np.float32), *[None] * 11)
  x, known = samples(streams, fit)
  late = known & (np.arange(len(x))[:, None] >= SETTLED)
  seen = x[late].astype(np.float64)
  mean, std = seen.mean(0), seen.std(0) + 1e-6
  z = np.clip((seen - mean) / std, -learnt.MOST_Z, learnt.MOST_Z)
  precision = inverse(z[:, N:], APART)
  apart = precision / np.sqrt(np.diag(precision))[:, None]
  c = z[:, N:] @ apart.T
  both = np.concatenate([c, np.log(c**2 + innovations.SMALL)], 1)
  fit = fit._replace(mean=mean, std=std, apart=apart, center=both.mean(0))
  fit = as_float32(fit._replace(scale=both.std(0) + 1e-6))
  del seen, z, c, both
  thin = np.where(np.arange(len(x)) % THIN == 0)[0]
  held = scan(x, known, fit, lambda m: m)[thin][late[thin]]
  fit = fit._replace(level=held.mean(0), spread=held.std(0) + 1e-6)
  use = np.r_[:N, N + p : N + 2 * p]
  root = [np.linalg.cholesky(inverse(held[:, k, use], SHRINK)) for k in range(R)]
  fit = as_float32(fit._replace(factor=np.stack(root)))
  log = jax.jit(
    jax.vmap(lambda m: jnp.log(innovations.looks((m - fit.level) / fit.spread, fit) + 1e-6))
  )
  own = np.asarray(log(held))
  return as_float32(fit._replace(low=own.mean(0), wide=own.std(0) + 1e-6))


def as_float32(fit: innovations.Fit) -> innovations.Fit:
  """In float32."""
  return innovations.Fit(*(x if x is None else np.float32(x) for x in fit))


def weighable(streams: Streams, fit: innovations.Fit) -> Set:
  """What is weighed at every row."""
  x, known = samples(streams, fit)
  return Set(*scan(x, known, fit, lambda m: innovations.inputs(m, fit)), known, streams)


def magnitudes(x: np.ndarray) -> np.ndarray:
  """(n, 2 i)."""
  return np.concatenate([x, np.abs(x)], -1)


def weighed(fit: innovations.Fit, healthy: Set, faulty: Set, use: np.ndarray) -> innovations.Fit:
  """With weights learnt from the fault streams `use`, and their unit."""
  quiet, at, weight = rows(healthy, faulty, use)
  b = regress(magnitudes(healthy.inputs[quiet]), magnitudes(faulty.inputs[at]), weight)
  ones = np.ones(2 + 2 * R)
  fit = as_float32(fit._replace(weights=b[1:].reshape(2, -1), bias=b[0], units=ones))
  fit = fit._replace(bias=fit.bias - np.median(each(healthy, fit)[0][healthy.known]))
  units = [level(x, UNIT if k < 2 else RARE) for k, x in enumerate(each(healthy, fit))]
  return as_float32(fit._replace(units=np.array(units)))


def each(held: Set, fit: innovations.Fit) -> np.ndarray:
  """(8, T, S) of the ratio and the looks in units, -inf where nothing is known."""
  odds = held.inputs @ fit.weights[0] + np.abs(held.inputs) @ fit.weights[1] + fit.bias
  out = np.concatenate([odds[..., None], held.marks], -1) / fit.units
  return np.where(held.known, np.moveaxis(out, -1, 0), -np.inf)


def scores(held: Set, fit: innovations.Fit) -> np.ndarray:
  """(T, S) of the score, -inf where nothing is known."""
  return each(held, fit).max(0)


def parted(streams: Streams, use: np.ndarray) -> Streams:
  """The streams `use` alone."""
  at = np.flatnonzero(use)
  residual = jax.tree.map(lambda x: x[:, at], streams.residual)
  names = [streams.fault[k] for k in at]
  targets = [streams.target[k] for k in at]
  return streams._replace(
    residual=residual,
    episode=streams.episode[:, at],
    stream=streams.stream[at],
    seed=streams.seed[at],
    onset=streams.onset[at],
    fault=names,
    target=targets,
    severity=streams.severity[at],
  )


def left_out(healthy: Streams, faulty: Streams, grain: np.ndarray, horizon_s: float) -> dict:
  """{tuning fault: three mean scores}, see the module's text."""
  names, out = np.array(faulty.fault), {}
  middle = np.median(np.unique(healthy.seed))
  for half in (lambda seed: seed < middle, lambda seed: seed >= middle):
    here, there = (parted(healthy, half(healthy.seed) == k) for k in (True, False))
    bad, met = parted(faulty, half(faulty.seed)), parted(faulty, ~half(faulty.seed))
    fit = reference(here, grain)
    quiet, loud, unseen, new = (weighable(s, fit) for s in (here, bad, there, met))
    old, seen = fit_learnt.reference(here)
    before = [fit_learnt.averages(s, old) for s in (bad, there, met)]
    both = weighed(fit, quiet, loud, np.ones(len(bad.fault), bool))
    a, b = scores(unseen, both), scores(new, both)
    seen_ones = found(b, level(a, ARL0), met, horizon_s)
    for name in dict.fromkeys(names):
      use, at = (np.array(s.fault) != name for s in (bad, met))
      own = weighed(fit, quiet, loud, use)
      a, b = scores(unseen, own), scores(new, own)
      one = found(b, level(a, ARL0), met, horizon_s)[~at]
      other = fit_learnt.weighed(old, seen, before[0], use)
      a, b = (fit_learnt.scores(s, other).max(0) for s in before[1:])
      two = found(b, level(a, ARL0), met, horizon_s)[~at]
      out.setdefault(name, []).append((two, one, seen_ones[~at]))
  return {
    name: np.concatenate([np.stack(x) for x in rows], 1).mean(1) for name, rows in out.items()
  }


def main() -> None:
  """The command."""
  parser = argparse.ArgumentParser(description=__doc__)
  parser.add_argument("--streams", help="a recorded set; default: the one that ships")
  parser.add_argument("--robot", help="this one alone")
  parser.add_argument("--out", help="folder of an agent of one's own")
  parser.add_argument("--left-out", action="store_true")
  given = parser.parse_args()
  sys.exit(app.attempt(lambda: run(given)))


def run(given: argparse.Namespace) -> None:
  """What the command does. UserError for a robot or a set that cannot be fitted to."""
  streams = StreamSet(given.streams)
  robots = streams.choose([given.robot] if given.robot else [])
  require(not given.out or len(robots) == 1, "--out takes the fit of one robot; give --robot")
  for robot in robots:
    names = streams.need_innovations(robot)
    grain = np.array([streams.config["details"][robot]["rounding"][name] for name in names])
    told = {name.split(":")[0] for name in streams.suite.robots[robot].get("tune", {})}
    healthy = streams.get(robot, streams.find(robot, "nominal", "tune"), signed=True)
    own = [key for key in streams.faults(robot, "tune") if key[0] in told]
    require(own, f"{streams.folder} holds no tuning faults of {robot}")
    numbers = np.concatenate([streams.find(robot, "fault", "tune", *key) for key in own])
    faulty = streams.get(robot, numbers, signed=True)
    if given.left_out:
      table = left_out(healthy, faulty, grain, streams.suite.horizon_s)
      table["mean"] = np.mean(list(table.values()), 0)
      for name, row in table.items():
        print(f"{robot:10} {name:16}", *(f"{x:6.1f}" for x in row), flush=True)
      continue
    fit = reference(healthy, grain)
    every = np.ones(len(numbers), bool)
    fit = weighed(fit, weighable(healthy, fit), weighable(faulty, fit), every)
    agent = streams.agent(robot)
    require(given.out or agent in agents.shipped(), f"agent {agent} does not ship; give --out")
    folder = pathlib.Path(given.out) if given.out else innovations.FITS
    folders.make(folder)
    target = folder / (innovations.FILE if given.out else f"{agent}.npz")
    arrays.write(target, fit._asdict(), small=True)
    print(f"{target}: {len(grain)} errors, {int(every.sum())} streams with a fault")


if __name__ == "__main__":
  main()
