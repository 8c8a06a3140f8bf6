"""How a quadruped walks at each commanded pace: python benchmarks/gait.py [--agent quadruped]
[--fault velocity_limit --target RH --severity 0 0.5 0.7018] [--out gait.json]

Robots are told to walk straight ahead at one pace, 20 s each, healthy or with a fault from the start
on, with a frozen agent. By severity and pace:

  reward              mean of a step, up to the end of an episode
  velocity_error_m_s  mean of |v_xy - command|, the first second left out
  fall_share          robots whose base touches the ground within the 20 s, with Wilson's interval
  base_height_m       mean height of the base's frame (standing in the stance: 0.56)
  lift_m              mean over swings of a foot's greatest clearance
  on_ground           share of time that each foot is on the ground (LF, RF, LH, RH)
  diagonal            correlation of being on the ground, mean of LF with RH and RF with LH; a trot
                      is near 1
  lateral             the same of LF with LH and RF with RH; a trot is near -1
"""

from __future__ import annotations

import argparse
import copy
import sys

from mjx_cl.io import runtime

runtime.setup()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from mjx_cl import envs, faults  # noqa: E402
from mjx_cl.cli import app  # noqa: E402
from mjx_cl.envs import anymal  # noqa: E402
from mjx_cl.io import tables  # noqa: E402
from mjx_cl.rollout.scan import Rollout, nest, start  # noqa: E402
from mjx_cl.scoring import intervals  # noqa: E402
from mjx_cl.training import agents  # noqa: E402

PACES = (0.25, 0.5, 0.75, 1.0)  # [m/s]
SETTLED = 50  # steps of the start that no mean counts
PAIRS = {"diagonal": ((0, 3), (1, 2)), "lateral": ((0, 2), (1, 3))}


def ahead(env, pace: float):
  """The environment whose every command is to walk straight ahead at `pace` [m/s]."""
  env = copy.copy(env)
  command = jnp.asarray([[pace, 0.0, 0.0]] * 2, jnp.float32)
  env.model = env.model._replace(task=env.model.task | {"command_range": command})
  return env


def walk(env, trained, fault, target, severity, robots: int, seed: int) -> dict[str, np.ndarray]:
  """One episode each; arrays (steps, robots, ...), and `alive`, false from a robot's end on."""
  at = faults.target_index(fault, target)
  rollout = Rollout(env, trained.agent, fault, trained.repeat)
  keys = jnp.stack([jax.random.key(seed + i) for i in range(robots)])[None]
  streams = nest(lambda k: start(env, trained.agent, fault, k, severity, target=at), 0, 0)(keys)
  params = jax.tree.map(lambda x: x[None], trained.train.params)

  @jax.jit
  def look(state):
    p = state.physics
    feet = jax.vmap(lambda q: anymal.leg_points(q)[0][:, 2])(p.qpos[0])
    return {
      "clearance": feet - anymal.FOOT_RADIUS,
      "ground": p.air[0] == 0,
      "height": p.qpos[0, :, 2],
      "error": p.velocity_error[0],
      "moving": p.command[0, :, 0] > 0,
    }

  alive, seen = np.ones(robots, bool), []
  drive = jnp.zeros((1, robots), bool)
  for _ in range(env.spec.episode_steps):
    streams, rows = rollout.chunk(params, streams, 1, drive)
    ended = np.asarray(rows.terminated | rows.truncated).reshape(robots)
    fallen = np.asarray(rows.terminated).reshape(robots) & alive
    lives = alive
    alive = alive & ~ended
    seen.append({k: np.asarray(v) for k, v in look(streams.env).items()})
    reward = np.asarray(rows.reward).reshape(robots)
    seen[-1] |= {"alive": alive, "fallen": fallen, "reward": reward, "lives": lives}
  return {k: np.stack([row[k] for row in seen]) for k in seen[0]}


def swings(ground: np.ndarray, clearance: np.ndarray) -> list[float]:
  """Greatest clearance of each whole swing of one foot, arrays (steps,)."""
  edges = np.flatnonzero(np.diff(np.concatenate([[1], ground.astype(int), [1]])))
  return [float(clearance[a:b].max()) for a, b in zip(edges[::2], edges[1::2])]


def summary(seen: dict[str, np.ndarray]) -> dict[str, object]:
  """The figures above of one pace; robots that were told to stand are left out."""
  moving = seen["moving"][0]
  keep = seen["alive"] & (np.arange(len(seen["alive"])) >= SETTLED)[:, None] & moving
  fell = seen["fallen"].any(0) & moving
  lifts, together = [], {name: [] for name in PAIRS}
  for robot in np.flatnonzero(keep.sum(0) > 100):
    at = keep[:, robot]
    ground, clear = seen["ground"][at, robot], seen["clearance"][at, robot]
    for foot in range(4):
      lifts += swings(ground[:, foot], clear[:, foot])
    for name, pairs in PAIRS.items():
      # a foot that never moves goes with none
      together[name].append(
        np.mean([
          np.corrcoef(ground[:, a], ground[:, b])[0, 1]
          if ground[:, a].std() and ground[:, b].std()
          else 0.0
          for a, b in pairs
        ])
      )  # fmt: skip
  return {
    "robots": int(moving.sum()),
    "reward": float(seen["reward"][seen["lives"] & moving].mean()),
    "velocity_error_m_s": float(seen["error"][keep].mean()),
    "fall_share": float(fell.sum() / moving.sum()),
    "fall_share_ci": intervals.wilson(int(fell.sum()), int(moving.sum())),
    "base_height_m": float(seen["height"][keep].mean()),
    "lift_m": float(np.mean(lifts)),
    "on_ground": [float(x) for x in seen["ground"][keep].mean(0)],
    **{name: float(np.mean(v)) for name, v in together.items()},
  }


def main(args) -> None:
  env = envs.make("quadruped")
  trained = agents.of(env, args.agent)
  fault, rows = faults.make(args.fault, env), []
  for severity in args.severity:
    for pace in PACES:
      seen = walk(
        ahead(env, pace), trained, fault, args.target, severity, args.robots, args.seed
      )  # fmt: skip
      rows.append({"severity": severity, "pace_m_s": pace} | summary(seen))
      print({k: v if isinstance(v, int) else np.round(v, 3).tolist() for k, v in rows[-1].items()})
  if args.out:
    tables.write_json(
      args.out,
      {
        "command": " ".join(["python", *sys.argv]),
        "agent": trained.card.get("command", args.agent),
        "paces": rows,
        **runtime.provenance(),
      },
    )


if __name__ == "__main__":
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  parser.add_argument("--agent", default="quadruped")
  parser.add_argument("--fault", default="none")
  parser.add_argument("--target")
  parser.add_argument("--severity", type=float, nargs="+", default=[0.0])
  parser.add_argument("--robots", type=int, default=24)
  parser.add_argument("--seed", type=int, default=0)
  parser.add_argument("--out")
  sys.exit(app.attempt(lambda: main(parser.parse_args())))
