"""Speed of recording residual streams: python benchmarks/recording.py [--json] [--streams 40]
[--steps 2560]

40 healthy walkers (acting, physics, world model's predictions) in one batch as `mjx-cl record` does
it, the predictions of a chunk beside the next chunk's physics, against a loop that calls the same
jitted functions for one robot at a time, one after the other; stream-steps per second without
compile time. Both take turns, medians.
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

from mjx_cl import envs, faults  # noqa: E402
from mjx_cl.leaderboard.lives import behind  # noqa: E402
from mjx_cl.rollout.monitor import Monitor  # noqa: E402
from mjx_cl.rollout.scan import Rollout, nest, start, stream_keys  # noqa: E402
from mjx_cl.training import agents

TOGETHER = 8  # chunks in a row, the last of which nothing runs beside: a recording has hundreds


def live(env, trained, streams: int, chunk: int):
  """Two calls for `streams` robots side by side: one that lives one more chunk and gives its rows,
  one that looks at rows.
  """
  none = faults.none(env)
  rollout, monitor = Rollout(env, trained.agent, none), Monitor(trained.agent, spec=env.spec)
  watch = jax.jit(monitor.update)
  params = jax.tree.map(lambda x: x[None], trained.train.params)
  state = nest(lambda k: start(env, trained.agent, none, k), 0, 0)(stream_keys([0], streams)[None])
  held = {"state": state, "history": monitor.init(1, streams), "n": 0}

  def act():
    held["state"], rows = rollout.chunk(params, held["state"], chunk)
    return jax.block_until_ready(rows)

  def look(rows):
    key = jax.random.split(jax.random.fold_in(jax.random.key(0), held["n"]), 1)
    held["history"], seen = watch(params, held["history"], rows, key)
    held["n"] += 1
    return jax.block_until_ready(seen)

  return act, look


def main() -> None:
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  parser.add_argument("--json", action="store_true", help="one JSON value on standard output")
  parser.add_argument("--streams", type=int, default=40)
  parser.add_argument("--steps", type=int, default=2560)
  args = parser.parse_args()
  chunk = 64
  env = envs.make("walker")
  trained = agents.of(env)
  batch, single = live(env, trained, args.streams, chunk), live(env, trained, 1, chunk)
  times = {"batch": [], "single": []}
  rounds = max(1, args.steps // (chunk * TOGETHER))
  for k in range(1 + rounds):  # the first round compiles
    begin = time.perf_counter()
    with behind(batch[1]) as look:
      for _ in range(TOGETHER):
        look(batch[0]())
    middle = time.perf_counter()
    for _ in range(TOGETHER):
      single[1](single[0]())
    if k:
      times["batch"].append((middle - begin) / TOGETHER)
      times["single"].append((time.perf_counter() - middle) / TOGETHER)
  rate = {
    "batch": args.streams * chunk / statistics.median(times["batch"]),
    "single": chunk / statistics.median(times["single"]),
  }
  ratio = rate["batch"] / rate["single"]
  rows = [
    {
      "name": f"recording, {args.streams} streams in one program",
      "value": round(rate["batch"]),
      "unit": "stream-steps/s",
      "goal": None,
      "holds": None,
    },
    {
      "name": "recording, one robot at a time",
      "value": round(rate["single"]),
      "unit": "stream-steps/s",
      "goal": None,
      "holds": None,
    },
    {
      "name": "recording, one program against one robot at a time",
      "value": round(ratio, 2),
      "unit": "ratio",
      "goal": ">= 10",
      "holds": ratio >= 10,
    },
  ]
  for r in rows:
    print(f"{r['name']:42s} {r['value']:>10,} {r['unit']}", file=sys.stderr)
  if args.json:
    print(json.dumps(rows))


if __name__ == "__main__":
  main()
