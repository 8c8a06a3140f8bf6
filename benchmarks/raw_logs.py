"""What `mjx-cl detect` finds in the raw logs of our own robots, without their world model: python
benchmarks/raw_logs.py [--out results/raw_logs.json] [--innovations]

Frozen shipped agents drive robots with the faults of suite `leaderboard` (all that score), on seeds
that tune. A log holds what the robot sees and does, observation and action, a column each. The
nominal log is of healthy robots of other seeds, a life after the other. The first 2.5 s of an
episode are missing in every log, since a robot that is dropped on its feet is no fault. The charts
are set to one false alarm in as many samples as the board's detectors, all three together; what
they give, alarms within 10 s as one, is counted on healthy robots of still other seeds. Found: an
alarm within 5 s of the onset. Beside it the same share of detectors that watch the world model's
residuals, of the same faults on seeds 0 to 9 (results/leaderboard.parquet).

With --innovations a log holds what the world model did not foresee instead: the signed one-step
errors of every variable and of the reward, as `run --residuals` writes them.
"""

from __future__ import annotations

import argparse
import sys
import time

from mjx_cl.io import runtime

runtime.setup()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from mjx_cl import envs, faults  # noqa: E402
from mjx_cl.cli import app  # noqa: E402
from mjx_cl.io import tables  # noqa: E402
from mjx_cl.leaderboard import lives, parts, streams, suite  # noqa: E402
from mjx_cl.logs import charts, verdict  # noqa: E402
from mjx_cl.rollout.monitor import Monitor  # noqa: E402
from mjx_cl.rollout.scan import Rollout, nest, start  # noqa: E402
from mjx_cl.scoring import intervals  # noqa: E402
from mjx_cl.training import agents  # noqa: E402

ROBOTS = ("walker", "quadruped", "car")
SEEDS, NOMINAL, QUIET = range(100, 103), range(120, 128), range(128, 136)
WITHIN_S, APART_S, CHUNK = 5.0, 2.5, 64
PAUSE_S = 10.0  # alarms that are closer are one event, as `detect` has it
BESIDE = ("learnt", "multichart", "cusum", "rolling_sigma")  # of the board


def live(env, trained, who, keys, onsets, steps, ahead) -> tuple[np.ndarray, np.ndarray]:
  """Observation and action, or where `ahead` the innovations, (lanes, steps, columns), and which
  steps begin an episode.
  """
  names = list(dict.fromkeys(lane.fault for lane in who if lane.fault))
  breaks = tuple(faults.make(n, env) for n in names) or (faults.none(env),)
  severity, target, _ = lives._drawn(who, names, breaks)
  rollout = Rollout(env, trained.agent, breaks)
  plan = jax.vmap(
    lambda s, o: faults.plan(
      s, jnp.broadcast_to(o, s.shape), jnp.full(s.shape, faults.FOREVER)
    )
  )(jnp.asarray(severity), jnp.asarray(onsets, jnp.int32))  # fmt: skip
  begin = lambda k, p, t: start(env, trained.agent, breaks, k, target=t, plan=p)
  state = nest(begin, 0, 0)(
    keys[None], jax.tree.map(lambda x: x[None], plan), jnp.asarray(target)[None]
  )
  params = jax.tree.map(lambda x: x[None], trained.train.params)
  seen, episodes = [], []
  monitor = Monitor(trained.agent, signed=True)
  errors = jax.jit(lambda rows, key: monitor.ahead(trained.train.params, rows, key))
  for k in range(-(-steps // CHUNK)):
    state, rows = rollout.chunk(params, state, CHUNK)
    if ahead:
      alone = jax.tree.map(lambda x: x[:, 0], rows)
      seen.append(np.asarray(errors(alone, jax.random.key(k))))
    else:
      seen.append(np.concatenate([np.asarray(rows.obs)[:, 0], np.asarray(rows.action)[:, 0]], -1))
    episodes.append(np.asarray(rows.episode)[:, 0])
  episode = np.concatenate(episodes)[:steps].T
  fresh = np.diff(episode, axis=1, prepend=episode[:, :1]) != 0
  return np.concatenate(seen)[:steps].swapaxes(0, 1).astype(np.float64), fresh


def gapped(x: np.ndarray, fresh: np.ndarray, rows: int) -> np.ndarray:
  """A log (T, C) whose first rows of an episode are missing."""
  x = x.copy()
  for at in np.r_[0, np.flatnonzero(fresh)]:
    x[at : at + rows] = np.nan
  return x


def robot(name: str, ahead: bool) -> dict:
  """Shares found of a robot's faults, the charts' and the board's; `ahead`: in innovations."""
  env, board = envs.make(name), suite.suite("leaderboard")
  trained = agents.of(env, streams.StreamSet().agent(name))  # as in the set it stands beside
  who, keys, onsets, steps, _ = parts.who_lives(board, name, "tune", "fault", env.spec.control_s)
  scored = {(f.partition(":")[0], s) for f, own in board.robots[name]["score"].items() for s in own}
  keep = np.array(
    [
      i
      for i, lane in enumerate(who)
      if lane.seed in SEEDS and (lane.fault is None or (lane.fault, lane.severity) in scored)
    ]
  )
  who = [who[i] for i in keep]
  apart, within = (round(x / env.spec.control_s) for x in (APART_S, WITHIN_S))
  sound = []
  for seeds in (NOMINAL, QUIET):
    lanes, drawn = [lives.Lane(s) for s in seeds], jnp.stack([jax.random.key(s) for s in seeds])
    steps_ = board.nominal["steps"]
    logs, fresh = live(env, trained, lanes, drawn, np.zeros(len(lanes)), steps_, ahead)
    sound.append([gapped(x, f, apart) for x, f in zip(logs, fresh)])
  past = np.concatenate(sound[0])
  varies = np.nanstd(past, 0) > 1e-6
  own = verdict.calibrated(past[:, varies], len(charts.CHARTS) * board.arl0)
  fired = lambda x: np.any(
    [alarm.any(1) for alarm in verdict.watch(own, x[:, varies]).fired.values()], 0
  )
  pause = round(PAUSE_S / env.spec.control_s)
  events = lambda at: 1 + int((np.diff(at) > pause).sum()) if len(at) else 0
  false = sum(events(np.flatnonzero(fired(x))) for x in sound[1])
  counted = sum(len(x) for x in sound[1])
  hits: dict[tuple[str, float], list[bool]] = {}
  logs, fresh = live(env, trained, who, keys[keep], onsets[keep], steps, ahead)
  for lane, onset, x, begin in zip(who, onsets[keep], logs, fresh):
    if lane.fault:
      alarms = fired(gapped(x, begin, apart))[onset : onset + within]
      hits.setdefault((lane.fault, lane.severity), []).append(bool(alarms.any()))
  flat = np.concatenate(list(hits.values()))
  rows = tables.read_rows("results/leaderboard.parquet")
  beside = {
    one: np.mean([r["detected_within_5s"] for r in rows if (r["robot"], r["detector"]) == (name, one)])
    for one in BESIDE
  }  # fmt: skip
  return {
    "robot": name,
    "columns": int(varies.sum()),
    "nominal_samples": len(past),
    "streams": len(flat),
    "found": float(flat.mean()),
    "found_ci": intervals.wilson(int(flat.sum()), len(flat)),
    "false_alarm_in": counted / max(1, false),
    "false_alarms": false,
    "board": {k: float(v) for k, v in beside.items()},
    "faults": [
      {"fault": f, "severity": s, "found": float(np.mean(v))} for (f, s), v in hits.items()
    ],
  }


def main(args) -> None:
  began, found = time.monotonic(), []
  for name in args.robot:
    found.append(robot(name, args.innovations))
    print({k: v for k, v in found[-1].items() if k != "faults"}, flush=True)
  if args.out:
    command = " ".join(["python", *sys.argv])
    out = {"command": command, "seconds": time.monotonic() - began, "robots": found}
    tables.write_json(args.out, out | runtime.provenance())


if __name__ == "__main__":
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  parser.add_argument("--robot", nargs="+", choices=ROBOTS, default=ROBOTS)
  parser.add_argument("--out")
  parser.add_argument("--innovations", action="store_true")
  sys.exit(app.attempt(lambda: main(parser.parse_args())))
