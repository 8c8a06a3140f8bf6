"""How slippery the paper's socks are: python benchmarks/socks.py [--out results/socks.json] [--work
runs/socks]

The paper gives one figure of them: the reward drops by around 20 %. Cars of tuning seeds are moved
from `car` to `car_real` and adapt until step 52,000 (half an hour on a core; a run that is cut off
goes on). Then each drives on with what it had learnt, without learning, at several coefficients of
friction under its rear wheels. The preset `car/socks` takes the coefficient at which they lose a
fifth. Scoring seeds (0 to 9) are not used.
"""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import sys
import time

from mjx_cl.io import runtime

runtime.setup()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from mjx_cl import envs, faults
from mjx_cl.cli import app
from mjx_cl.io import tables  # noqa: E402
from mjx_cl.io.interrupt import Interruptible  # noqa: E402
from mjx_cl.rollout.scan import Rollout, nest, start  # noqa: E402
from mjx_cl.runs import suite
from mjx_cl.runs.identity import check_same  # noqa: E402
from mjx_cl.runs.run import Runner  # noqa: E402
from mjx_cl.scoring import intervals  # noqa: E402

GRIPS = (0.65, 0.61, 0.60, 0.59, 0.58, 0.575, 0.57, 0.56, 0.55, 0.50, 0.45, 0.40, 0.35, 0.30)
DRIVES, STEPS, CHUNK = 24, 2_000, 50  # drives of each car at each coefficient, control steps of one
KEY = 9  # what a seed's key folds in for its drives; a run folds in 7


def adapted(work: pathlib.Path, seeds: list[int], steps: int):
  """A Runner that has lived the car part of suite `paper` without its socks, for `steps` control
  steps.
  """
  (part,) = suite.pick(suite.suite("paper").parts, ("car",))
  runner = Runner(
    dataclasses.replace(
      part.config,
      seeds=len(seeds),
      first_seed=seeds[0],
      steps=steps,
      arms=("detector",),
      fault="car/sim-to-real",
    ),
    work,
  )
  work.mkdir(parents=True, exist_ok=True)
  if (work / "config.json").exists():
    check_same(work, runner.config_dict())
  else:
    tables.write_json(work / "config.json", runner.config_dict())
  runner.open()
  runner.resume()
  saved = time.monotonic()
  with Interruptible() as stop:
    while not runner.done:
      progress = runner.step()
      if time.monotonic() - saved > 60:
        runner.save()
        saved = time.monotonic()
        print(f"step {progress.step:,} of {progress.steps:,}", file=sys.stderr)
      try:
        stop.check()
      except KeyboardInterrupt:
        runner.save()
        raise
  runner.save()
  return runner


def drive(runner: Runner, seeds: list[int], grips, drives: int, steps: int):
  """Mean reward per control step and crashes per drive, each (seeds, grips)."""
  env = envs.make("car_real")
  fault = (faults.make("friction", env),)
  target = jnp.asarray([fault[0].targets.index("rear")])
  severity = jnp.tile((1.0 - jnp.asarray(grips) / 0.65) / 0.95, len(seeds))
  keys = jnp.repeat(
    jnp.stack(
      [jax.random.split(jax.random.fold_in(jax.random.key(seed), KEY), drives) for seed in seeds]
    ),
    len(grips),
    0,
  )
  agent = runner.trained.agent
  streams = nest(
    lambda k, s: start(env, agent, fault, k, target=target, plan=faults.plan(s[None])),
    (0, 0),
    (0, None),
  )(keys, severity)
  acting = [runner.lives.acting(g) for g in range(len(seeds))]
  params, rollout = (
    jax.tree.map(lambda *x: jnp.repeat(jnp.stack(x), len(grips), 0), *acting),
    Rollout(env, agent, fault),
  )
  reward, crashes = [], []
  for _ in range(steps // CHUNK):
    streams, rows = rollout.chunk(params, streams, CHUNK)
    reward.append(np.asarray(rows.reward).mean((0, 2)))
    crashes.append(np.asarray(rows.terminated).sum((0, 2)) / drives)
  shape = (len(seeds), len(grips))
  return np.mean(reward, 0).reshape(shape), np.sum(crashes, 0).reshape(shape)


def main(args) -> None:
  seeds = list(range(args.first_seed, args.first_seed + args.seeds))
  reward, crashes = drive(
    adapted(pathlib.Path(args.work), seeds, args.steps), seeds, args.grips, args.drives, STEPS
  )
  lost = 1.0 - reward / reward[:, :1]
  rows = [
    {
      "grip": grip,
      "reward": reward[:, i].tolist(),
      "lost": float(lost[:, i].mean()),
      "lost_ci": intervals.interval(lost[:, i], np.mean),
      "crashes": float(crashes[:, i].mean()),
    }
    for i, grip in enumerate(args.grips)
  ]
  for r in rows:
    print(
      f"grip {r['grip']:.3f}: reward lost {100 * r['lost']:5.1f} %, crashes in {STEPS:,} steps "
      f"{r['crashes']:.1f}",
      file=sys.stderr,
    )
  tables.write_json(
    args.out,
    {
      "command": " ".join(["python", *sys.argv]),
      "seeds": seeds,
      "adapted_steps": args.steps,
      "drives": args.drives,
      "drive_steps": STEPS,
      "rows": rows,
      **runtime.provenance(),
    },
  )


if __name__ == "__main__":
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  parser.add_argument("--out", default="results/socks.json")
  parser.add_argument("--work", default="runs/socks")
  parser.add_argument("--seeds", type=int, default=3)
  parser.add_argument("--first-seed", type=int, default=100)
  parser.add_argument("--steps", type=int, default=52_000)
  parser.add_argument("--drives", type=int, default=DRIVES)
  parser.add_argument(
    "--grips", type=float, nargs="+", default=GRIPS, help="the first is the healthy one"
  )
  sys.exit(app.attempt(lambda: main(parser.parse_args())))
