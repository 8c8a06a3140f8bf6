"""Does the imagined policy gradient point where the robot earns more? python
benchmarks/policy_gradient.py walker [--agent DIR] [--json]

The gradient of the policy loss, averaged over many batches of the agent's own data, is followed for
a small step forwards and backwards; each policy then dreams from the same replayed states and
drives the same robots (common keys). Where the dream promises more and the robot earns less, the
policy runs to where the world model is wrong, and finetuning with this model does harm.

What the dream promises is the return of an imagined stretch under the moved policy, and the critic
of the unmoved one behind it, less the same of the unmoved policy, over the length of the stretch:
the mean advantage per control step. By the performance difference lemma (Kakade and Langford, ICML
2002) that is what the reward per control step should gain, as far as the moved policy visits the
  same states.

A step is measured by how far it moves the policy's mean action, root mean square over replayed
states. Differences of reward are per control step, with 95 % bootstrap intervals over robots,
against the policy as it is; the entropy bonus is left out of the gradient.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys

from mjx_cl.io import runtime

runtime.setup()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from mjx_cl import envs, faults
from mjx_cl.cli import app
from mjx_cl.dreamer import (
  nets,  # noqa: E402
  replay,
)
from mjx_cl.dreamer.agent import Agent, Weights  # noqa: E402
from mjx_cl.rollout.scan import Rollout, nest, records, start  # noqa: E402
from mjx_cl.scoring import intervals  # noqa: E402
from mjx_cl.training import agents

CHUNK, FACTORS, DREAMS = 64, (0, 1, -1, 3, -3), 20


def streams_of(env, agent, groups: int, robots: int, seed: int):
  """(groups, robots) healthy streams, the same keys in every group."""
  keys = jax.random.split(jax.random.key(seed), robots)
  return nest(lambda key: start(env, agent, faults.none(env), key), 0, 0)(
    jnp.stack([keys] * groups)
  )


def own_data(env, trained, robots: int, steps: int, seed: int = 1) -> replay.Replay:
  """A replay of what the agent did in `steps` control steps."""
  agent, size = trained.agent, trained.agent.size
  roll, streams = Rollout(env, agent, faults.none(env)), streams_of(env, agent, 1, robots, seed)
  held = replay.init(
    robots, 2 * steps, len(env.spec.obs), len(env.spec.act), size.deter, size.stoch
  )
  params, add = jax.tree.map(lambda x: x[None], trained.train.params), jax.jit(replay.add)
  for _ in range(-(-steps // CHUNK)):
    streams, rows = roll.chunk(params, streams, CHUNK)
    held = add(held, *jax.tree.map(lambda x: x[0], records(rows)))
  return held


def ascent(agent: Agent, train, held: replay.Replay, batches: int):
  """The mean gradient of the policy's objective, and its squared length over the sampling noise of
  one batch.
  """

  @jax.jit
  def gradient(key):
    key_sample, key_update = jax.random.split(key)
    _, batch, _ = replay.sample(held, key_sample, agent.config.batch, agent.config.length + 1)
    grads, _ = jax.grad(agent.loss, has_aux=True)(
      train.params, train.slow, train.range, batch, key_update, Weights(0.0, 1.0, 1.0)
    )
    return jax.tree.map(jnp.negative, grads["pol"])

  found = [gradient(jax.random.key(i)) for i in range(batches)]
  mean = jax.tree.map(lambda *x: sum(x) / batches, *found)
  square = lambda tree: float(sum(jnp.sum(jnp.square(x)) for x in jax.tree.leaves(tree)))
  noise = sum(square(jax.tree.map(jnp.subtract, x, mean)) for x in found) / (batches - 1)
  return mean, (square(mean) - noise / batches) / noise


def measure(args) -> dict:
  env = envs.make(args.env)
  trained = agents.of(env, args.agent)
  agent = Agent(
    dataclasses.replace(trained.agent.config, last_starts=0, entropy=0.0),
    len(env.spec.obs),
    len(env.spec.act),
  )
  train, params = trained.train, trained.train.params
  held = own_data(env, trained, args.robots, args.records)
  direction, signal = ascent(agent, train, held, args.batches)

  _, batch, _ = replay.sample(held, jax.random.key(5), agent.config.batch, agent.config.length + 1)
  deter, stoch, _ = agent.observe(params, batch, jax.random.key(6))
  moved_by = lambda k: jax.tree.map(lambda p, d: p + k * d, params["pol"], direction)
  mean_of = jax.jit(
    lambda pol: nets.normal(*agent.pol.apply({"params": pol}, deter, stoch), *agent.deviations)[0]
  )
  distance = lambda k: float(
    jnp.sqrt(jnp.mean(jnp.square(mean_of(moved_by(k)) - mean_of(params["pol"]))))
  )
  k = 1.0
  for _ in range(60):  # nearly linear in k
    k *= args.size / max(distance(k), 1e-9)

  flat = lambda x: x.reshape((-1,) + x.shape[2:])
  gamma = 1.0 - 1.0 / agent.config.horizon

  @jax.jit
  def dream(pol, key):
    """Discounted return of the imagined steps and the critic behind them, mean over starts."""
    deters, stochs, _ = agent.imagine(
      {**params, "pol": pol}, flat(deter), flat(stoch), key, agent.config.imagine
    )
    _, reward = agent.predict(params, deters[1:], stochs[1:])
    value = nets.two_hot_mean(agent.value(params["val"], deters[-1], stochs[-1]), agent.bins)
    steps = agent.config.imagine
    return jnp.mean(jnp.sum(gamma ** jnp.arange(steps)[:, None] * reward, 0) + gamma**steps * value)

  policies = [moved_by(f * k) for f in FACTORS]
  promised = [
    np.mean([float(dream(pol, jax.random.key(i))) for i in range(DREAMS)]) for pol in policies
  ]
  every = jax.tree.map(lambda x: jnp.stack([x] * len(FACTORS)), params) | {
    "pol": jax.tree.map(lambda *x: jnp.stack(x), *policies)
  }
  roll, streams = (
    Rollout(env, agent, faults.none(env)),
    streams_of(env, agent, len(FACTORS), args.robots, 11),
  )
  earned, ends = 0.0, 0
  for _ in range(-(-args.steps // CHUNK)):
    streams, rows = roll.chunk(every, streams, CHUNK)
    earned, ends = (
      earned + np.asarray(rows.reward).sum(0),
      ends + np.asarray(rows.terminated).sum((0, 2)),
    )
  earned = earned / (CHUNK * -(-args.steps // CHUNK))
  rows = []
  for i, factor in enumerate(FACTORS):
    gain = earned[i] - earned[0]
    rows.append(
      {
        "step": factor * args.size,
        "moved": distance(factor * k),
        "promise": (promised[i] - promised[0]) / agent.config.imagine,
        "reward": float(earned[i].mean()),
        "gain": float(gain.mean()),
        "gain_ci": intervals.interval(gain, np.mean),
        "terminations": int(ends[i]),
      }
    )
  at = {r["step"]: r for r in rows}
  return {
    "env": args.env,
    "name": args.agent or args.env,
    "robots": args.robots,
    "steps": args.steps,
    "batches": args.batches,
    "signal_to_noise": signal,
    "slope": (at[args.size]["gain"] - at[-args.size]["gain"]) / 2,
    "rows": rows,
    **runtime.provenance(),
  }


def main(args) -> None:
  value = measure(args) | {"command": " ".join(["python", *sys.argv])}
  if args.json:
    print(json.dumps(value))
    return
  print(
    f"{value['name']}: squared length of the gradient against the noise of one batch "
    f"{value['signal_to_noise']:.2f}"
  )
  print(
    f"{'step':>7} {'dream promises':>15} {'robot earns':>12} "
    f"{'gain a control step [95 %]':>34} {'terminations':>13}"
  )
  for r in value["rows"]:
    print(
      f"{r['step']:7.3f} {r['promise']:15.4f} {r['reward']:12.4f} {r['gain']:12.4f} "
      f"[{r['gain_ci'][0]:.4f}, {r['gain_ci'][1]:.4f}] {r['terminations']:13d}"
    )


def parser() -> argparse.ArgumentParser:
  out = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  out.add_argument("env", nargs="?", default="walker", choices=sorted(envs.ENVS))
  out.add_argument("--agent", help="shipped name or folder; default: the robot's own")
  out.add_argument("--json", action="store_true", help="one JSON value on standard output")
  out.add_argument("--robots", type=int, default=48)
  out.add_argument("--steps", type=int, default=1000, help="control steps that each policy drives")
  out.add_argument("--records", type=int, default=1000, help="control steps of own data")
  out.add_argument("--batches", type=int, default=48)
  out.add_argument(
    "--size", type=float, default=0.02, help="root mean square change of the policy's mean action"
  )
  return out


if __name__ == "__main__":
  sys.exit(app.attempt(lambda: main(parser().parse_args())))
