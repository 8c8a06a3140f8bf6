"""Speed of physics and fault layer: python benchmarks/physics.py [--json] [--quick]

All in one process, programs interleaved, medians; without compile time. A rollout here is the
certificate's (`certificate.live`): faults, physics, observation and reward in one jitted scan,
without an agent, resets or the rows of a run. Ratios carry over between machines, steps per second
do not.
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
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from mjx_cl import envs, faults  # noqa: E402
from mjx_cl.faults import certificate  # noqa: E402


def race(runs: dict, rounds: int) -> dict[str, float]:
  """Median seconds of each call; the calls take turns, so that a busy moment meets all of them. The
  first call of each is not counted.
  """
  for call in runs.values():
    call()
  times = {name: [] for name in runs}
  for _ in range(rounds):
    for name, call in runs.items():
      begin = time.perf_counter()
      call()
      times[name].append(time.perf_counter() - begin)
  return {name: statistics.median(t) for name, t in times.items()}


def roll(env, streams: int, steps: int, all_faults: bool = False):
  """A call that lives `steps` control steps of `streams` robots without an agent, from settled
  random motion, under drawn commands.
  """
  none = faults.none(env)
  have = {k: f for k, f in faults.available(env).items() if k != "none"}
  used = tuple(have.values()) if all_faults else (none,)
  model = faults.owned_model(used, env.model)
  signal = jnp.asarray(
    np.stack([certificate.actions(env, steps, seed) for seed in range(8)])[np.arange(streams) % 8]
  )
  if all_faults:  # every stream has one active fault, in turn
    names = list(have)
    lanes = [
      certificate.Lane(names[i % len(names)], have[names[i % len(names)]].targets[0], 0.5)
      for i in range(streams)
    ]
    plan, target = certificate.plans(have, lanes, onset=0)
  else:
    plan = jax.tree.map(lambda x: jnp.broadcast_to(x, (streams, 1)), faults.plan())
    target = jnp.zeros((streams, 1), jnp.int32)

  def one(key, plan, target, signal):
    return certificate.live(
      env, used, model, key, faults.begin(used, jax.random.key(0), plan, target), signal
    )[1]

  program = jax.jit(jax.vmap(one))
  keys = jax.random.split(jax.random.key(0), streams)
  return lambda: jax.block_until_ready(program(keys, plan, target, signal))


def bare(env, streams: int, steps: int):
  """A call that does the same physics by mjbatch alone, from the same kind of start: no JAX, no
  observation, no reward.
  """
  import mjbatch

  native = env.physics
  batch = mjbatch.Batch(env.mj_model, streams)
  state, ctrl = batch.bind("state"), batch.bind("ctrl")
  first, _ = jax.vmap(lambda k: env.init(env.model, k))(
    jax.random.split(jax.random.key(0), streams)
  )
  rows = np.asarray(getattr(first.physics, "backend", first.physics)).view(np.float64)
  signal = np.stack([certificate.actions(env, steps, seed) for seed in range(8)])[
    np.arange(streams) % 8
  ]
  limit = env.mj_model.actuator_ctrlrange[:, 1]

  def call():
    state[...] = rows
    for t in range(steps):
      ctrl[...] = np.resize(signal[:, t], ctrl.shape) * limit
      batch.step(nstep=native.substeps)

  return call


def main() -> None:
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  parser.add_argument("--json", action="store_true", help="one JSON value on standard output")
  parser.add_argument("--quick", action="store_true", help="few rounds, for a test")
  args = parser.parse_args()
  rounds, steps = (2, 20) if args.quick else (9, 100)
  say = lambda text: print(text, file=sys.stderr, flush=True)
  rows = []

  def put(name, value, unit, goal=None):
    holds = (
      None
      if goal is None
      else bool(value >= float(goal[3:]) if goal.startswith(">=") else value <= float(goal[3:]))
    )
    rows.append(
      {"name": name, "value": round(float(value), 4), "unit": unit, "goal": goal, "holds": holds}
    )
    say(
      f"{name:64s} {value:10.3g} {unit:18s} {goal or ''} "
      f"{'' if holds is None else 'holds' if holds else 'MISSED'}"
    )

  walker = envs.make("walker", "native")
  t = race(
    {
      "bare": bare(walker, 160, steps),
      "none": roll(walker, 160, steps),
      "faults": roll(walker, 160, steps, all_faults=True),
    },
    rounds,
  )
  put(
    "walker: jitted rollout of 160 streams against bare mjbatch",
    t["bare"] / t["none"],
    "ratio",
    ">= 0.85",
  )
  put("walker: jitted rollout of 160 streams", 160 * steps / t["none"], "control steps/s")
  put(
    "walker: all faults traced, one active per stream, against none",
    t["faults"] / t["none"],
    "ratio",
    "<= 1.15",
  )

  for name, goal in (("walker", ">= 1.6"), ("quadruped", ">= 2.2"), ("car_real", ">= 3.3")):
    batch, short = 256, max(4, steps // 10)
    t = race(
      {kind: roll(envs.make(name, kind), batch, short) for kind in ("native", "mjx")},
      max(2, rounds // 3),
    )
    put(f"{name}: native against MJX, batch {batch}", t["mjx"] / t["native"], "ratio", goal)
    put(f"{name}: native, batch {batch}", batch * short / t["native"], "control steps/s")

  for name, goal in (("car", ">= 20000"), ("car_real", None)):
    t = race({"run": roll(envs.make(name, "native"), 160, steps)}, rounds)
    put(f"{name}: 160 streams with lidar", 160 * steps / t["run"], "control steps/s", goal)

  sizes = (16, 64, 256, 1024)
  t = race({str(n): roll(walker, n, max(4, steps // 4)) for n in sizes}, rounds)
  each = [t[str(n)] / n / max(4, steps // 4) * 1e6 for n in sizes]
  for n, value in zip(sizes, each):
    put(f"walker: cost of a control step with {n} streams", value, "us per stream")
  put(
    "walker: largest rise of the cost from one of these sizes to the next",
    max(b / a for a, b in zip(each, each[1:])),
    "ratio",
    "<= 1.05",
  )

  if args.json:
    print(json.dumps(rows))


if __name__ == "__main__":
  main()
