"""Return of an agent on the healthy robot."""
from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import faults
from mjx_cl.rollout import Rollout, nest, start
from mjx_cl.scoring import bootstrap


def evaluate(env, agent, params, episodes: int, seed: int = 0, repeat: int = 1, deterministic: bool = False) -> dict:
  """Runs `episodes` episodes side by side, seeds seed, seed + 1, ...

  Returns:
    episodes, return_mean, return_iqm, return_ci (95 % bootstrap of the IQM over episodes of this one agent), returns, terminations.
  """
  fault = faults.make("none", env)
  rollout = Rollout(env, agent, fault, repeat, deterministic)
  keys = jnp.stack([jax.random.key(seed + i) for i in range(episodes)])[None]
  streams = nest(lambda k: start(env, agent, fault, k), 0, 0)(keys)
  params = jax.tree.map(lambda x: x[None], params)
  total, alive, ended = np.zeros(episodes), np.ones(episodes, bool), 0
  while alive.any():
    streams, rows = rollout.chunk(params, streams, 50)
    reward, terminated, done = (np.asarray(x)[:, 0] for x in (rows.reward, rows.terminated, rows.terminated | rows.truncated))
    for r, t, d in zip(reward, terminated, done):
      total += r * alive
      ended += int((t & alive).sum())
      alive &= ~d
  return {"episodes": episodes, "return_mean": float(total.mean()), "return_iqm": float(bootstrap.iqm(total)), "return_ci": bootstrap.interval(total),
          "terminations": ended, "returns": [round(float(x), 2) for x in total]}
