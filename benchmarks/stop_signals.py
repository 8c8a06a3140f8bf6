"""The stop rule on signals of acting beside those of a second pass, on the same lives:

  python benchmarks/stop_signals.py [walker] [--first-seed 100] [--seeds 6] [--steps 12032]

Robots break at step 5,000 and finetune from there on without a stop (arm `oracle-budget`), so that
what the signals say changes nothing. Dynamics loss, advantage magnitude and value loss are taken
twice of each chunk: from the weights that act and the latents that acting has found
(`adapt.watch`), and as before, from the newest weights, which observe the chunk once more and
imagine from all its states. Then the rule reads either, beside the same other three. Prints how the
two go together, and when each stops.
"""

from __future__ import annotations

import argparse
import functools
import tempfile

from mjx_cl.io import runtime

runtime.setup()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from mjx_cl.adapt import decide, loop, state  # noqa: E402
from mjx_cl.config import AdaptConfig, RunConfig  # noqa: E402
from mjx_cl.dreamer.agent import Record  # noqa: E402
from mjx_cl.keys import OfSeed  # noqa: E402
from mjx_cl.runs import run  # noqa: E402

ONSET = 5_000
NAMES = ("dynamics loss", "advantage magnitude", "value loss")


def observed(agent, params, minds, before, rows, keys):
  """The three signals (groups, 3) by a second pass with `params`."""
  join = lambda old, new: jnp.concatenate([old[-1:].astype(new.dtype), new])[:, :, 0].swapaxes(
    0, 1
  )[:, None]
  first = join(before.done, rows.first).at[:, :, 0].set(True)
  none, action = jnp.zeros_like(first), join(before.action, rows.action)
  batch = Record(
    obs=join(before.obs, rows.obs),
    action=action,
    reward=join(before.reward, rows.reward_in),
    first=first,
    last=jnp.concatenate([first[:, :, 1:], none[:, :, :1]], 2),
    terminal=none,
    deter=join(before.deter, rows.deter),
    stoch=join(before.stoch, rows.stoch),
    demo=jnp.zeros_like(action),
    has_demo=none,
  )

  def one(params, slow, range_, batch, key):
    metrics = agent.loss(params, slow, range_, batch, key)[1][0]
    return jnp.stack([metrics["loss/dyn"], metrics["adv_mag"], metrics["loss/value"]])

  return jax.vmap(one)(params, minds.slow, minds.range, batch, keys)


def listen() -> dict:
  """Lets every watched chunk leave (key, step) -> (old, new) signals in the dict."""
  seen: dict = {}
  newest: dict = {}  # id of minds -> the weights that learn
  minds, watch = state.LoopState.minds.fget, loop.Loop.watch

  def remembering(self):
    out = minds(self)
    newest[id(out)] = self.train.params
    return out

  def watching(self, minds, sight, rows, now, keys):
    if not hasattr(self, "second"):
      self.second = loop.Once(jax.jit(functools.partial(observed, self.agent)))
    params = newest.pop(id(minds), minds.params)
    draws = jax.vmap(lambda key: jax.random.fold_in(key, now))(keys)
    old = self.second(params, minds, sight.history, rows, draws)
    out = watch(self, minds, sight, rows, now, keys)
    key = tuple(np.asarray(jax.random.key_data(keys))[0].tolist())
    seen[key, int(now)] = np.asarray(old)[0], np.asarray(out[0].signals)[0]
    return out

  state.LoopState.minds, loop.Loop.watch = property(remembering), watching
  return seen


def stop(rows: list[tuple[int, np.ndarray]], acceptance: float, config: AdaptConfig) -> str:
  """What the rule decides, and how many steps after the start; rows: (step, signals)."""
  update = jax.jit(
    lambda state, signals, due, now: decide.update(
      state, signals, jnp.float32(0), due, ONSET, now, True, acceptance, -jnp.inf, config
    )
  )
  phase = decide.init(config)
  for now, signals in rows:
    due = jnp.bool_(now - 64 <= ONSET < now)
    phase, decision, _ = update(phase, jnp.asarray(signals), due, jnp.int32(now))
    if int(decision) > decide.START:
      return f"{decide.DECISIONS[int(decision)]} {now - ONSET:,}"
  return "-"


def main() -> None:
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  parser.add_argument("robot", nargs="?", default="walker")
  parser.add_argument("--first-seed", type=int, default=100)
  parser.add_argument("--seeds", type=int, default=6)
  parser.add_argument("--steps", type=int, default=12_032)
  args = parser.parse_args()
  seen = listen()
  config = RunConfig(
    env=args.robot,
    seeds=args.seeds,
    first_seed=args.first_seed,
    arms=("oracle-budget",),
    steps=args.steps,
    onset=ONSET,
  )
  out = tempfile.mkdtemp() + "/run"
  run.execute(config, out, progress=lambda p: print(f"step {p.step}", end="\r", flush=True))
  both = [np.array([x[i] for x in seen.values()]) for i in range(2)]
  for k, name in enumerate(NAMES):
    old, new = both[0][:, k], both[1][:, 3 + k]
    print(
      f"{name}: medians {np.median(old):.3f}, {np.median(new):.3f}; correlation of logarithms "
      f"{np.corrcoef(np.log(old), np.log(new))[0, 1]:.2f}"
    )
  from mjx_cl import envs

  level = envs.make(args.robot).spec.acceptance
  for seed in range(args.first_seed, args.first_seed + args.seeds):
    key = jax.random.fold_in(jax.random.key(seed), OfSeed.ADAPTATION)
    own = tuple(np.asarray(jax.random.key_data(key)).tolist())
    mine = sorted((now, value) for (key, now), value in seen.items() if key == own)
    for least in (config.adapt.least, 1):
      rule = AdaptConfig(least=least)
      old = [(now, np.concatenate([new[:3], old])) for now, (old, new) in mine]
      new = [(now, new) for now, (_, new) in mine]
      print(
        f"seed {seed}, least {least}: second pass {stop(old, level, rule)}, "
        f"acting {stop(new, level, rule)}"
      )


if __name__ == "__main__":
  main()
