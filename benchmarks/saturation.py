"""Actions that are stuck at their limit, and an arm that frees them.

`python benchmarks/saturation.py` says of each shipped agent in what share of states the mean of
each action lies within a hundredth of its limit, and which actions are stuck: mean = tanh(m), so
an action with m = 6 everywhere has a slope of 2.5e-5 and hardly learns.

`mjx-cl run car --arm benchmarks/saturation.py:freed none` is arm `swift` but for the first updates
of an adaptation, which scale the last layer of such an action to |m| = 1.5 in the median (slope
0.18). Saturation and learning: Hausknecht and Stone 2016, https://arxiv.org/abs/1511.04143.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from typing import Any

from mjx_cl.io import runtime

runtime.setup()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402

from mjx_cl import envs, faults  # noqa: E402
from mjx_cl.adapt.arms import ALARM, RULE, Arm  # noqa: E402
from mjx_cl.adapt.methods import Acts, Method, View, average  # noqa: E402
from mjx_cl.adapt.methods.quiet import SWIFT, quiet  # noqa: E402
from mjx_cl.cli import app  # noqa: E402
from mjx_cl.dreamer.agent import Agent, TrainState  # noqa: E402
from mjx_cl.dreamer.state import Record  # noqa: E402
from mjx_cl.errors import choose  # noqa: E402
from mjx_cl.rollout.scan import Rollout, nest, start  # noqa: E402
from mjx_cl.training import agents  # noqa: E402

FREE = 1.5  # |m| of a freed action in the median: tanh 0.905, slope 0.18
SHARE = 0.05  # an action is stuck where all but this share of its m lie beyond FREE, on one side
ROBOTS, STEPS = 8, 300


def one_sided(raw: jax.Array) -> jax.Array:
  """How far beyond 0 all but SHARE of an action's states lie, on one side: (N, A) -> (A,)."""
  return jnp.maximum(jnp.quantile(raw, SHARE, axis=0), -jnp.quantile(raw, 1 - SHARE, axis=0))


def free(agent: Agent, state: TrainState, batch: Record) -> TrainState:
  """`state`, its stuck actions brought to |m| = FREE in the median of a batch's states (B, 1 + T).

  Mean squared gradients of such an action's last layer, tiny by then, become those of the layer's
  greatest action; its momentum is forgotten.
  """
  raw, _ = agent._apply(
    state.params, "pol", batch.deter.astype(jnp.float32), agent.hot(batch.stoch)
  )
  raw = raw.reshape(-1, raw.shape[-1])
  stuck = one_sided(raw) > FREE
  scale = jnp.where(stuck, FREE / jnp.median(jnp.abs(raw), axis=0), 1.0)
  policy = state.params["pol"]
  params = {
    **state.params,
    "pol": {**policy, "mean": jax.tree.map(lambda x: x * scale, policy["mean"])},
  }

  def moments(path: tuple[Any, ...], x: jax.Array) -> jax.Array:
    name = jax.tree_util.keystr(path)
    if "['pol']['mean']" not in name:
      return x
    return jnp.where(stuck, 0.0 if ".ema" in name else jnp.max(x, -1, keepdims=True), x)

  opt = jax.tree_util.tree_map_with_path(moments, state.opt)
  return state._replace(params=params, opt=opt)


def update(agent: Agent, taken: jax.Array, state: TrainState, batch: Record, key: jax.Array):
  """Agent.update, before the first of an adaptation `free`."""
  begun = lambda s: free(agent, s, batch)
  return agent.update(jax.lax.cond(taken == 0, begun, lambda s: s, state), batch, key)


def act(taken: jax.Array, view: View) -> Acts:
  """As the paper's; counts the updates of the adaptation, int32 ()."""
  return average(jnp.where(view.begins, 0, taken + view.taken), view)


FREEING = Method(lambda params: jnp.int32(0), act, update=update)


def freed() -> Arm:
  """As swift, and stuck actions are freed."""
  method = dataclasses.replace(quiet(FREEING), settings=SWIFT.settings)
  return Arm(
    "as swift, but actions that are stuck at their limit are freed", ALARM, RULE, method=method
  )


def saturation(name: str) -> tuple[jax.Array, jax.Array]:
  """Of each action of a shipped agent's healthy robots: share of states with |tanh(m)| > 0.99, and
  whether it is stuck.
  """
  env = envs.make(agents.read_card(agents.HERE / name)[0]["env"])
  trained = agents.of(env, name)
  agent, params, fault = trained.agent, trained.train.params, faults.make("none", env)
  keys = jax.random.split(jax.random.key(100), ROBOTS)[None]
  streams = nest(lambda key: start(env, agent, fault, key), 0, 0)(keys)
  rollout = Rollout(env, agent, fault, trained.repeat, deterministic=True)
  _, rows = rollout.chunk(jax.tree.map(lambda x: x[None], params), streams, STEPS)
  raw, _ = agent._apply(params, "pol", rows.deter, agent.hot(rows.stoch))
  raw = raw.reshape(-1, raw.shape[-1])
  return jnp.mean(jnp.tanh(jnp.abs(raw)) > 0.99, 0), one_sided(raw) > FREE


def main(args: argparse.Namespace) -> None:
  known = dict.fromkeys(agents.shipped())
  for name in args.agent:
    choose("agent", name, known)
  print(f"{ROBOTS} healthy robots, {STEPS} decisions, by the policy's mean")
  for name in args.agent or known:
    share, stuck = saturation(name)
    shown = ", ".join(f"{100 * s:.0f} %" for s in share)
    held = [str(i) for i, one in enumerate(stuck) if one]
    print(f"{name}: within 0.01 of the limit {shown}; stuck: {', '.join(held) or 'none'}")


if __name__ == "__main__":
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  parser.add_argument("--agent", nargs="*", default=[], help="shipped agents; default: all")
  sys.exit(app.attempt(lambda: main(parser.parse_args())))
