"""What a model-free learner makes of the same faults: brax's PPO, pretrained on the healthy robot,
goes on learning on the broken one.

  python -m mjx_cl.training.demonstrator walker --out runs/ppo_walker --steps 8000000
  python benchmarks/ppo_finetune.py walker --policy runs/ppo_walker --fault walker/gear-half --json

The robots are those of `mjx-cl run` with the same seeds: same joint, same starts, same clock, one
robot each and nothing but its own steps to learn from. PPO has no world model, so nothing raises an
alarm and no rule ends it: it is told the onset and learns to the end. Each arm keeps the ledger of
runs.parquet: what the fault cost, when the robot was back, return lost, falls, updates, seconds.
Arms:

  ppo-none   the pretrained policy as it is
  ppo        from the onset on an update every `horizon` control steps: `epochs` passes over them in
    minibatches, brax's loss

Learning rate, horizon and minibatches were chosen on seeds 100 to 109 (walker/gear-half, normalised
recovery of the 7 affected, one run each): 3e-4 with 1,024 and 4 0.75, with 2,048 and 8 0.66; at
1e-3 -0.01, at 1e-4 0.29. Observation statistics stay those of the pretraining; discount, reward
scale and entropy weight are its own too (demonstrator.PPO), so that the critic goes on from what it
knows. This is no arm of `mjx-cl run`: there an arm is a choice of when a DreamerV3 agent learns,
and which part of it.
"""

from __future__ import annotations

import argparse
import functools
import json
import pathlib
import sys
import time
import types

from mjx_cl.io import runtime

runtime.setup()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import optax  # noqa: E402

from mjx_cl import envs, faults
from mjx_cl.cli import app
from mjx_cl.config import RunConfig  # noqa: E402
from mjx_cl.dreamer.agent import Carry  # noqa: E402
from mjx_cl.envs.adapters import brax_module  # noqa: E402
from mjx_cl.errors import FileError, UserError  # noqa: E402
from mjx_cl.faults.presets import becomes, changes  # noqa: E402
from mjx_cl.io import tables  # noqa: E402
from mjx_cl.rollout.scan import Rollout, nest, start  # noqa: E402
from mjx_cl.runs.settings import check
from mjx_cl.scoring import intervals, normalised_recovery, recovery  # noqa: E402
from mjx_cl.training import demonstrator

CHUNK, WARMUP = (
  64,
  1000,
  # control steps of a chunk, and those at the start of a run that count for nothing, as in
  # AdaptConfig
)


class Actor:
  """A brax policy in the place of an agent in a Rollout; its parameters are {normaliser, policy,
  value}. It remembers nothing.
  """

  def __init__(self, net, act_size: int):
    self.net, self.act_size, self.size = net, act_size, types.SimpleNamespace(stoch=1, classes=1)

  def carry(self) -> Carry:
    return Carry(jnp.zeros(1), jnp.zeros(1), jnp.zeros(self.act_size))

  def prepare(self, params):
    return params

  def act(self, params, carry: Carry, obs, key, deterministic: bool = False):
    logits = self.net.policy_network.apply(params["normaliser"], params["policy"], obs)
    dist = self.net.parametric_action_distribution
    action = dist.mode(logits) if deterministic else dist.sample(logits, key)
    return carry._replace(action=action), action


def transitions(net, params, rows):
  """One robot's rows (T, ...) as brax's Transition; log-probabilities under the parameters that
  acted.

  The action before tanh is recovered from the one taken: float32 atanh is good to 1e-3 as far out
  as |a| = 1 - 1e-4; it is cut off at 1 - 1e-6.
  """
  brax_types = brax_module("training.types")
  dist = net.parametric_action_distribution
  raw = jnp.arctanh(jnp.clip(rows.action, -1 + 1e-6, 1 - 1e-6))
  logits = net.policy_network.apply(params["normaliser"], params["policy"], rows.obs)
  return brax_types.Transition(
    observation=rows.obs,
    action=rows.action,
    reward=rows.reward,
    discount=1.0 - rows.terminated.astype(jnp.float32),
    next_observation=rows.final_obs,
    extras={
      "state_extras": {"truncation": (rows.truncated & ~rows.terminated).astype(jnp.float32)},
      "policy_extras": {
        "raw_action": raw,
        "log_prob": dist.log_prob(logits, raw),
        "distribution_params": logits,
      },
    },
  )


def make_update(net, settings: dict, lr: float, epochs: int, minibatches: int):
  """(params, opt, data (B, T, ...), key) -> (params, opt): `epochs` passes over B stretches of T
  steps, each in so many minibatches.
  """
  losses = brax_module("training.agents.ppo.losses")
  optimiser = optax.adam(lr)
  loss = functools.partial(
    losses.compute_ppo_loss,
    ppo_network=net,
    entropy_cost=settings["entropy_cost"],
    discounting=settings["discounting"],
    reward_scaling=settings["reward_scaling"],
  )

  def step(state, x):
    params, opt = state
    part, key = x
    own = losses.PPONetworkParams(params["policy"], params["value"])
    grads, _ = jax.grad(loss, has_aux=True)(own, params["normaliser"], part, key)
    steps, opt = optimiser.update(grads, opt)
    own = optax.apply_updates(own, steps)
    return (params | {"policy": own.policy, "value": own.value}, opt), None

  def epoch(state, key, data):
    key_order, key_loss = jax.random.split(key)
    count = jax.tree.leaves(data)[0].shape[0]
    order = jax.random.permutation(key_order, count)
    parts = jax.tree.map(
      lambda x: x[order].reshape((minibatches, count // minibatches) + x.shape[1:]), data
    )
    return jax.lax.scan(step, state, (parts, jax.random.split(key_loss, minibatches)))[0]

  def update(params, opt, data, key):
    return jax.lax.scan(
      lambda state, key: (epoch(state, key, data), None),
      (params, opt),
      jax.random.split(key, epochs),
    )[0]

  init = lambda params: optimiser.init(losses.PPONetworkParams(params["policy"], params["value"]))
  return init, update


def measure(args) -> dict:
  """Lives the run and scores it; the value of --json."""
  if args.horizon % CHUNK or (args.horizon // CHUNK) % args.minibatches:
    raise UserError(
      f"horizon must be a multiple of {CHUNK} x minibatches = {CHUNK * args.minibatches}; got "
      f"{args.horizon}"
    )
  for name in ("lr", "epochs", "minibatches", "horizon"):
    if not getattr(args, name) > 0:
      raise UserError(f"{name} must be above 0; got {getattr(args, name)}")
  config = check(
    RunConfig(
      args.env,
      fault=args.fault,
      target=args.target,
      severity=args.severity,
      onset=args.onset,
      steps=args.steps,
      seeds=args.seeds,
      first_seed=args.first_seed,
    )
  )
  if becomes(config):
    raise UserError(
      f"{args.fault!r} turns the robot into another one; this benchmark takes faults of one robot"
    )
  env = envs.make(args.env)
  if "bonus" in getattr(env, "demonstration", {}):
    raise UserError(
      f"the demonstrator of {args.env!r} learned another reward than the robot's; take a robot "
      "whose demonstrator did not"
    )
  settings = demonstrator.PPO | getattr(env, "demonstration", {}).get("ppo", {})
  try:
    curve, (normaliser, policy, value) = demonstrator.latest(pathlib.Path(args.policy), env)
  except FileError:
    raise FileError(
      f"{args.policy} holds no PPO policy of {args.env!r}; train one with: python -m "
      f"mjx_cl.training.demonstrator {args.env} --out DIR"
    ) from None
  net = demonstrator.networks_of(env)
  actor = Actor(net, len(env.spec.act))
  the_faults, plan, target = faults.build(changes(config), env, config.onset)
  roll = Rollout(env, actor, the_faults)
  seeds = [args.first_seed + i for i in range(args.seeds)]
  labels = [(arm, seed) for arm in ("ppo", "ppo-none") for seed in seeds]
  keys = jnp.stack([jax.random.key(seed) for _, seed in labels])[:, None]
  streams = nest(lambda k: start(env, actor, the_faults, k, target=target, plan=plan), 0, 0)(keys)
  learns = np.asarray([arm == "ppo" for arm, _ in labels])
  spread = lambda tree: jax.tree.map(lambda x: jnp.stack([jnp.asarray(x)] * len(labels)), tree)
  init, update = make_update(net, settings, args.lr, args.epochs, args.minibatches)
  params = spread({"normaliser": normaliser, "policy": policy, "value": value})
  opt = jax.vmap(init)(params)

  @jax.jit
  def learn(params, opt, chunks, now):
    data = jax.tree.map(lambda *x: jnp.stack(x, 1), *chunks)  # (groups, B, T, ...)
    key = jax.vmap(lambda k: jax.random.fold_in(jax.random.fold_in(k, 9), now))(keys[:, 0])
    new = jax.vmap(update)(params, opt, data, key)
    pick = lambda a, b: jnp.where(learns.reshape((-1,) + (1,) * (a.ndim - 1)), a, b)
    return jax.tree.map(pick, new, (params, opt))

  gather = jax.jit(
    lambda params, rows: jax.vmap(functools.partial(transitions, net))(
      params, jax.tree.map(lambda x: x[:, :, 0].swapaxes(0, 1), rows)
    )
  )
  reward, ended, held, updates, began, learning = [], [], [], 0, time.monotonic(), 0.0
  for chunk in range(-(-args.steps // CHUNK)):
    streams, rows = roll.chunk(params, streams, CHUNK)
    reward.append(np.asarray(rows.reward)[:, :, 0])
    ended.append(np.asarray(rows.terminated)[:, :, 0])
    if chunk * CHUNK >= args.onset:
      held.append(gather(params, rows))
    if len(held) * CHUNK == args.horizon:
      clock = time.monotonic()
      params, opt = jax.block_until_ready(learn(params, opt, tuple(held), chunk))
      if not all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(params)):
        raise FileError(
          f"PPO diverged at step {(chunk + 1) * CHUNK}: a weight is not finite; take a smaller "
          f"--lr than {args.lr:g}"
        )
      held, updates, learning = (
        [],
        updates + args.epochs * args.minibatches,
        learning + time.monotonic() - clock,
      )
  if args.keep:
    tables.write_table(
      pathlib.Path(args.keep),
      {
        "step": np.tile(np.arange(args.steps, dtype=np.int32), len(labels)),
        "arm": np.repeat([a for a, _ in labels], args.steps),
        "seed": np.repeat(np.asarray([s for _, s in labels], np.int32), args.steps),
        "reward": np.concatenate(reward)[: args.steps].T.reshape(-1),
      },
    )
  value = score(
    labels,
    np.concatenate(reward)[: args.steps],
    np.concatenate(ended)[: args.steps],
    args.onset,
    env.spec.control_s,
    updates,
  )
  return {
    "env": args.env,
    "fault": args.fault,
    "target": args.target,
    "severity": args.severity,
    "onset": args.onset,
    "steps": args.steps,
    "seeds": seeds,
    "policy": {
      "steps": curve[-1]["step"],
      "return": curve[-1]["return"],
      "seconds": curve[-1]["seconds"],
    },
    "settings": {
      "lr": args.lr,
      "horizon": args.horizon,
      "epochs": args.epochs,
      "minibatches": args.minibatches,
      **settings,
    },
    "wall_s": time.monotonic() - began,
    "wall_s_updates": learning,
    **value,
    **runtime.provenance(),
  }


def score(
  labels, reward: np.ndarray, ended: np.ndarray, onset: int, control_s: float, updates: int
) -> dict:
  """Ledger of every stream and summary of each arm; definitions are those of mjx_cl.scoring.

  Args:
    labels: (arm, seed) of each stream; reward, ended: (steps, streams).
  """
  index = {label: g for g, label in enumerate(labels)}
  rows = []
  for g, (arm, seed) in enumerate(labels):
    base = reward[:, index["ppo-none", seed]].astype(float)
    own, pre = reward[:, g].astype(float), recovery.reward_pre(base, onset, WARMUP, None)
    lost = recovery.reward_drop(base, onset, pre)
    affected = lost is not None and lost >= 0.1
    final = lambda x: float(np.mean(x[-recovery.FINAL :]))
    back = recovery.recovery_step(own, onset, pre) if affected else None
    rows.append(
      {
        "arm": arm,
        "seed": seed,
        "affected": affected,
        "reward_pre": pre,
        "reward_drop": lost,
        "reward_final": final(own),
        "recovery_steps": None if back is None else back - onset,
        "return_lost": recovery.return_lost(own, onset, pre),
        "terminations": int(ended[:, g].sum()),
        "updates": updates if arm == "ppo" else 0,
        "normalised": normalised_recovery.normalise(final(own), final(base), pre, pre),
      }
    )
  arms = {}
  for arm in dict.fromkeys(a for a, _ in labels):
    own = [r for r in rows if r["arm"] == arm]
    hit = [r for r in own if r["affected"]]
    times = [np.inf if r["recovery_steps"] is None else r["recovery_steps"] for r in hit]
    mean = lambda rows, name: (
      (float(intervals.iqm(x)), intervals.interval(x))
      if (x := [r[name] for r in rows if r[name] is not None])
      else (None, None)
    )
    out = {
      "seeds": len(own),
      "affected": len(hit),
      "recovered": int(np.sum(np.isfinite(times))),
      "recovery_median_steps": intervals.finite(intervals.censored_median(times))
      if times
      else None,
      "recovery_median_steps_ci": intervals.interval(times, intervals.censored_median)
      if times
      else None,
      "terminations": sum(r["terminations"] for r in own),
      "updates": updates if arm == "ppo" else 0,
    }
    for key, name, of in (
      ("reward_pre", "reward_pre", own),
      ("reward_final", "reward_final", own),
      ("reward_final_affected", "reward_final", hit),
      ("return_lost", "return_lost", own),
      ("normalised", "normalised", hit),
    ):
      out[key], out[key + "_ci"] = mean(of, name)
    arms[arm] = out
  lost = [np.array([r["return_lost"] for r in rows if r["arm"] == a]) for a in ("ppo", "ppo-none")]
  share = lambda own, none: 100 * (1 - own.mean(-1) / none.mean(-1))
  drawn = intervals.draws(len(lost[0]), 10_000)
  arms["ppo"]["score"] = float(share(*lost))  # as on the leaderboard of methods
  arms["ppo"]["score_ci"] = intervals.ends(share(*(x[drawn] for x in lost))[None])[0]
  return {"arms": arms, "rows": rows, "control_s": control_s}


def main(args) -> None:
  value = measure(args) | {"command": " ".join(["python", *sys.argv])}
  if args.json:
    print(json.dumps(value))
    return
  for arm, r in value["arms"].items():
    show = lambda name, digits=2: (
      "-"
      if r[name] is None
      else (
        f"{r[name]:.{digits}f} {['-' if x is None else round(x, digits) for x in r[name + '_ci']]}"
      )
    )
    print(
      f"{arm}: {r['recovered']} of {r['affected']} affected recovered, median "
      f"{show('recovery_median_steps', 0)} steps; reward {show('reward_pre')} before, "
      f"{show('reward_final_affected')} of the affected at the end; normalised "
      f"{show('normalised')}; {r['updates']} updates, {r['terminations']} falls"
    )
  print(f"{value['wall_s']:.0f} s, of which {value['wall_s_updates']:.0f} s updates")


def parser() -> argparse.ArgumentParser:
  out = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
  )
  out.add_argument("env", nargs="?", default="walker", choices=sorted(envs.ENVS))
  out.add_argument(
    "--policy",
    required=True,
    help=(
      "folder that `python -m mjx_cl.training.demonstrator ENV` or benchmarks/ppo_walker.py "
      "--out wrote"
    ),
  )
  out.add_argument("--fault", default="walker/gear-half", help="fault or preset")
  out.add_argument("--target", help="joint or part; left out: drawn from the seed")
  out.add_argument("--severity", type=float, help="left out: 0.5, or the preset's own")
  out.add_argument("--onset", type=int, default=5000)
  out.add_argument("--steps", type=int, default=25_000)
  out.add_argument("--seeds", type=int, default=10)
  out.add_argument("--first-seed", type=int, default=0)
  out.add_argument("--lr", type=float, default=3e-4)
  out.add_argument("--horizon", type=int, default=1024, help="control steps between updates")
  out.add_argument("--epochs", type=int, default=10)
  out.add_argument("--minibatches", type=int, default=4)
  out.add_argument("--keep", help="Parquet file for the rewards of every step")
  out.add_argument("--json", action="store_true", help="one JSON value on standard output")
  return out


if __name__ == "__main__":
  sys.exit(app.attempt(lambda: main(parser().parse_args())))
