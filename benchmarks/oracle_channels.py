"""How much of what the recordings hold detectors find: oracles that are told the fault.

  mjx-cl record benchmarks/oracle_channels.toml --out runs/streams-oracle
  python benchmarks/oracle_channels.py [--tuned DIR] [--robot ROBOT ...] [--out FILE]

For each fault of the board four oracles, in the order of ORACLES: the likelihood ratio of OPR and
RPR as autoregressions (leaderboard/oracle.py); `learnt`'s averages of all twelve channels with
weights fitted to this very fault (benchmarks/fit_learnt.py); the same of detector `innovations`
(benchmarks/fit_innovations.py); and that with weights for the averages of every signed error and
its energy too. Each is fitted on seeds 100 to 109 and scored on 0 to 9; the best on seeds 105 to
109, fitted on 100 to 104, is the oracle of the fault: of all four, and of the first two, which see
no signed error. Score: mean over streams of 100 2^(-latency / 5 s), 0 where missed within 20 s, at
one alarm in 10,000 healthy steps of seeds 100 to 109.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import sys

import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))  # for its neighbours
from benchmarks import fit_innovations, fit_learnt  # noqa: E402
from mjx_cl.detectors import innovations, learnt  # noqa: E402
from mjx_cl.io import folders, runtime  # noqa: E402
from mjx_cl.leaderboard import oracle  # noqa: E402
from mjx_cl.leaderboard.streams import Streams, StreamSet  # noqa: E402
from mjx_cl.scoring import autoregression  # noqa: E402

ORACLES = ("two_channels", "all_channels", "innovations_weighed", "every_variable")
FROM = 2_000  # control steps at the start of a stream in which nothing counts


def after(streams: Streams, use: np.ndarray, horizon: int) -> np.ndarray:
  """OPR and RPR from the onset on, (horizon, streams, 2)."""
  x = oracle.channels(streams.residual)
  own = np.flatnonzero(use)
  return np.stack([x[(o := streams.onset[s]) : o + horizon, s] for s in own], 1)


def pair(normal, healthy, streams, use, horizon):
  """Alarms of the likelihood ratio of OPR and RPR: a function of streams -> bool (T, S)."""
  fit = autoregression.fit(normal, after(streams, use, horizon))
  ratio = lambda x: oracle._ratios(x, [fit])
  own = ratio(healthy)
  most = own.shape[1] * (len(own) - FROM) / fit_learnt.ARL0
  level = oracle._thresholds(own, own.shape[1], FROM, most)[0]

  def fired(other: Streams) -> np.ndarray:
    r = ratio(oracle.channels(other.residual))
    return oracle.restarted(r, np.full(r.shape[1], level))[0]

  return fired


def whole(fit, healthy, faulty, use):
  """Alarms of the averages of all channels: a function of fit_learnt.Set -> bool (T, S)."""
  own = fit_learnt.weighed(fit, healthy, faulty, use[None])
  level = fit_learnt.level(fit_learnt.scores(healthy, own)[1], fit_learnt.ARL0)
  return lambda held: fit_learnt.scores(held, own)[1] > level


def signed(fit, healthy, faulty, use):
  """Alarms of detector `innovations`, its weights of this very fault: a function of
  fit_innovations.Set -> bool (T, S).
  """
  own = fit_innovations.weighed(fit, healthy, faulty, use[None])
  level = fit_learnt.level(fit_innovations.scores(healthy, own), fit_learnt.ARL0)
  return lambda held: fit_innovations.scores(held, own) > level


def everything(streams: Streams, fit: innovations.Fit) -> fit_innovations.Set:
  """As fit_innovations.weighable, with the averages of every feature among the inputs."""

  def each(averages):
    x, marks = innovations.inputs(averages, fit)
    u = ((averages - fit.level) / fit.spread)[:, innovations.N :].ravel()
    return jnp.concatenate([x, jnp.clip(u, -innovations.MOST_U, innovations.MOST_U)]), marks

  x, known = fit_innovations.samples(streams, fit)
  return fit_innovations.Set(*fit_innovations.scan(x, known, fit, each), known, streams)


def weighing(healthy, faulty, use):
  """Alarms of the log odds of all inputs and their magnitudes: a function of
  fit_innovations.Set -> bool (T, S).
  """
  quiet, at, weight = fit_learnt.rows(healthy, faulty, use[None])
  wide = fit_innovations.magnitudes
  b = fit_learnt.regress(wide(healthy.inputs[quiet]), wide(faulty.inputs[at]), weight)
  odds = lambda held: np.where(held.known, wide(held.inputs) @ b[1:] + b[0], -np.inf)
  level = fit_learnt.level(odds(healthy), fit_learnt.ARL0)
  return lambda held: odds(held) > level


def narrow(held: fit_innovations.Set, fit: innovations.Fit) -> fit_innovations.Set:
  """With the inputs of the detector alone."""
  return held._replace(inputs=held.inputs[..., : fit.weights.shape[1]])


def main() -> None:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
  )
  parser.add_argument(
    "--tuned", default="runs/streams-oracle", help="of the suite beside this file"
  )
  parser.add_argument("--robot", nargs="*", default=())
  parser.add_argument("--out", default="results/innovations/oracle.json")
  given = parser.parse_args()
  runtime.setup()
  ships, tuned, rows = StreamSet(None), StreamSet(given.tuned), []
  horizon_s = ships.suite.horizon_s
  for robot in given.robot or ships.robots:
    nominal = ships.get(robot, ships.find(robot, "nominal", "tune"))
    fit, healthy = fit_learnt.reference(nominal)
    x = oracle.channels(nominal.residual)
    each = len(nominal.seed) // len(set(nominal.seed.tolist()))
    normal = autoregression.Healthy(x[FROM:, ::each], autoregression.ORDER)
    shipped = learnt.fits()[ships.agent(robot)]
    level = fit_learnt.level(
      fit_learnt.scores(fit_learnt.averages(nominal, shipped), shipped).max(0), fit_learnt.ARL0
    )
    loud = innovations.fit_of(ships.agent(robot))
    nominal = ships.get(robot, ships.find(robot, "nominal", "tune"), signed=True)
    more = everything(nominal, loud)
    few = narrow(more, loud)
    own_level = fit_learnt.level(fit_innovations.scores(few, loud), fit_learnt.ARL0)
    for key in ships.faults(robot):
      known = tuned.get(robot, tuned.find(robot, "fault", "score", *key), signed=True)
      asked = ships.get(robot, ships.find(robot, "fault", "score", *key), signed=True)
      horizon = int(horizon_s / known.control_s)
      of = lambda fired, streams: fit_learnt.found(1.0 * fired, 0.5, streams, horizon_s)
      all_, half = np.ones(len(known.seed), bool), known.seed < 105
      held, other = (fit_learnt.averages(s, fit) for s in (known, asked))
      many, mine = (everything(s, loud) for s in (known, asked))
      chosen = []
      for use in (half, all_):
        streams, averages, errors = (known, held, many) if use is half else (asked, other, mine)
        fired = [
          pair(normal, x, known, use, horizon)(streams),
          whole(fit, healthy, held, use)(averages),
          signed(loud, few, narrow(many, loud), use)(narrow(errors, loud)),
          weighing(more, many, use)(errors),
        ]
        out = [of(own, streams) for own in fired]
        chosen.append([float(s[~half].mean() if use is half else s.mean()) for s in out])
      own = fit_learnt.scores(fit_learnt.averages(asked, shipped), shipped).max(0)
      loudest = fit_innovations.scores(narrow(mine, loud), loud) > own_level
      row = {
        "robot": robot,
        "fault": key[0],
        "severity": key[1],
        "learnt": float(of(own > level, asked).mean()),
        "innovations": float(of(loudest, asked).mean()),
        **dict(zip(ORACLES, chosen[1])),
        "oracle": chosen[1][int(np.argmax(chosen[0][:2]))],
        "oracle_signed": chosen[1][int(np.argmax(chosen[0]))],
      }
      rows.append(row)
      shown = (f"{v:6.1f}" for v in list(row.values())[3:])
      print(f"{robot:10} {key[0]:18} {key[1]:5.2f}", *shown, flush=True)
  mean = lambda k, robot: float(np.mean([r[k] for r in rows if robot in ("", r["robot"])]))
  for robot in ["", *dict.fromkeys(r["robot"] for r in rows)]:
    for name, told in (("learnt", "oracle"), ("innovations", "oracle_signed")):
      own, best = mean(name, robot), mean(told, robot)
      print(f"{robot or 'all'}: {name} {own:.1f}, {told} {best:.1f}, share {own / best:.2f}")
  value = {"command": " ".join(["python", *sys.argv]), **runtime.provenance(), "rows": rows}
  out = pathlib.Path(given.out)
  out.parent.mkdir(parents=True, exist_ok=True)
  folders.atomic(out, lambda file: file.write((json.dumps(value) + "\n").encode()))


if __name__ == "__main__":
  main()
