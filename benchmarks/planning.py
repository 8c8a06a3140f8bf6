"""Does planning with the world model earn more than the policy? python benchmarks/planning.py
car_real --agent car [--json]

At every step N sequences of H actions around the policy's mean are dreamt, each M times with the
same draws of the prior for all of them; sequence 0 is the policy's own. A sequence is worth
  sum_k gamma^k r_k + gamma^H v,   gamma of the continue head, r and v of the agent's own heads,
and the robot takes the mean of the first actions of the best tenth: one iteration of the planner of
TD-MPC2 (Hansen et al. 2024, https://arxiv.org/abs/2310.16828), not weighted. Frozen healthy robots,
the same keys for all; differences are per control step, with 95 % bootstrap intervals over robots.
"""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

from mjx_cl.io import runtime

runtime.setup()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jaxtyping import PRNGKeyArray  # noqa: E402

from mjx_cl import envs, faults  # noqa: E402
from mjx_cl.cli import app  # noqa: E402
from mjx_cl.dreamer import heads, nets  # noqa: E402
from mjx_cl.dreamer.networks import Networks  # noqa: E402
from mjx_cl.dreamer.state import Carry  # noqa: E402
from mjx_cl.errors import require  # noqa: E402
from mjx_cl.rollout.scan import Rollout, nest, start  # noqa: E402
from mjx_cl.scoring import intervals  # noqa: E402
from mjx_cl.training import agents  # noqa: E402

CHUNK = 50
PLANS = ((64, 5, 2, 0.3), (64, 10, 2, 0.3), (64, 10, 2, 0.1), (64, 15, 4, 0.15))  # N, H, M, sigma
ELITE = 10  # the best one in so many sequences


class Planner:
  """An agent that plans: `act` alone is its own.

  Args:
    agent: whose networks dream.
    sequences: N.
    horizon: H.
    dreams: M.
    sigma: deviation of the actions around the policy's mean.
  """

  def __init__(
    self, agent: Networks, sequences: int, horizon: int, dreams: int, sigma: float
  ) -> None:
    self.agent, self.shape, self.sigma = agent, (horizon, sequences, dreams), sigma

  def __getattr__(self, name: str) -> Any:
    return getattr(self.agent, name)

  def act(
    self,
    params: Any,
    carry: Carry,
    obs: jax.Array,
    key: PRNGKeyArray,
    deterministic: bool = False,
  ) -> tuple[Carry, jax.Array]:
    """As Networks.act, the action planned."""
    agent, (horizon, n, m) = self.agent, self.shape
    after, _ = agent.act(params, carry, obs, key, True)
    deter, stoch = after.deter[None], after.stoch[None]
    _, key_a, key_u = jax.random.split(key, 3)  # the first is the latent's, in act
    noise = self.sigma * jax.random.normal(key_a, (horizon, n, 1, agent.act_size))
    noise = jnp.broadcast_to(noise.at[:, 0].set(0.0), (horizon, n, m, agent.act_size))
    uniform = jax.random.uniform(key_u, (horizon, 1, m, agent.size.stoch))
    uniform = jnp.broadcast_to(uniform, (horizon, n, m, agent.size.stoch))
    rows = lambda x: x.reshape(horizon, n * m, -1)

    def step(carry: Any, x: Any) -> Any:
      latent, total, weight = carry
      mean, _ = agent._policy(params, latent.deter, latent.stoch)
      action = jnp.clip(mean + x[0], -1.0, 1.0)
      latent = agent.follow(params, latent, action, x[1])
      read = lambda name: heads.read(getattr(agent, name), params[name], latent.deter, latent.stoch)
      total = total + weight * nets.two_hot_mean(read("rew"), agent.bins)
      return (latent, total, weight * jax.nn.sigmoid(read("con")[..., 0])), action

    begin = agent.latent(params, jnp.repeat(deter, n * m, 0), jnp.repeat(stoch, n * m, 0))
    zero = jnp.zeros(n * m)
    (latent, total, weight), actions = jax.lax.scan(
      step, (begin, zero, zero + 1), (rows(noise), rows(uniform))
    )
    value = nets.two_hot_mean(agent.value(params["val"], latent.deter, latent.stoch), agent.bins)
    worth = (total + weight * value).reshape(n, m).mean(1)
    _, best = jax.lax.top_k(worth, max(1, n // ELITE))
    action = actions[0].reshape(n, m, -1)[best, 0].mean(0)
    return after._replace(action=action), action


def drive(
  env: Any, agent: Any, params: Any, args: argparse.Namespace
) -> tuple[np.ndarray, np.ndarray]:
  """Reward a control step and ended episodes of each robot, acting by `agent`."""
  fault = faults.none(env)
  begin = lambda key: start(env, agent, fault, key)
  streams = nest(begin, 0, 0)(jax.random.split(jax.random.key(args.seed), args.robots)[None])
  rollout, own = Rollout(env, agent, fault, 1, True), jax.tree.map(lambda x: x[None], params)
  earned, ended = [], []
  for _ in range(args.steps // CHUNK):
    streams, rows = rollout.chunk(own, streams, CHUNK)
    earned.append(np.asarray(rows.reward)[:, 0])
    ended.append(np.asarray(rows.terminated)[:, 0])
  return np.concatenate(earned).mean(0), np.concatenate(ended).sum(0)


def measure(args: argparse.Namespace) -> dict:
  """Rows of the policy's mean and of each of PLANS."""
  require(args.steps >= CHUNK, f"--steps must be at least {CHUNK}; got {args.steps}")
  require(args.robots >= 2, f"--robots must be at least 2; got {args.robots}")
  env = envs.make(args.env)
  trained = agents.of(env, args.agent)
  by_policy, rows = None, []
  for plan in (None, *PLANS):
    agent = Planner(trained.agent, *plan) if plan else trained.agent
    earned, ended = drive(env, agent, trained.train.params, args)
    by_policy = earned if by_policy is None else by_policy
    gain = earned - by_policy
    rows.append(
      {
        "plan": plan,
        "reward": float(earned.mean()),
        "gain": float(gain.mean()),
        "gain_ci": intervals.interval(gain, np.mean),
        "terminations": int(ended.sum()),
      }
    )
  return {**vars(args), "rows": rows, **runtime.provenance()}


def main(args: argparse.Namespace) -> None:
  value = measure(args)
  if args.json:
    print(json.dumps(value))
    return
  print("sequences, steps, dreams, deviation: reward a step, gain [95 %], ended episodes")
  for row in value["rows"]:
    low, high = row["gain_ci"]
    name = ", ".join(map(str, row["plan"])) if row["plan"] else "the policy's mean"
    print(
      f"{name}: {row['reward']:.3f}, {row['gain']:.3f} [{low:.3f}, {high:.3f}], "
      f"{row['terminations']}"
    )


if __name__ == "__main__":
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  parser.add_argument("env", choices=sorted(envs.ENVS))
  parser.add_argument("--agent", help="shipped name or folder")
  parser.add_argument("--robots", type=int, default=16)
  parser.add_argument("--steps", type=int, default=600)
  parser.add_argument("--seed", type=int, default=100)
  parser.add_argument("--json", action="store_true")
  sys.exit(app.attempt(lambda: main(parser.parse_args())))
