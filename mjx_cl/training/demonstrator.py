"""A model-free policy that shows the way: brax PPO on this package's environments.

Used by the `cpu` preset alone (the agent's card names it); `paper` does without. The trained policy
is kept as a plain .npz of its layers, so that using one needs no brax.
"""

import argparse
import functools
import json
import os
import pathlib
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import envs
from mjx_cl.envs.adapters import brax_env, brax_module
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import arrays, folders, runtime
from mjx_cl.types import EnvState, Model, Step


class Policy(NamedTuple):
  """Deterministic tanh policy: observation normaliser and dense layers.

  Attributes:
    mean: float32 (obs,), of the observation, running.
    std: float32 (obs,), alike.
    layers: ((kernel (in, out), bias (out,)), ...); the last layer gives means and raw deviations,
      (2 * act,).
  """

  mean: jax.Array
  std: jax.Array
  layers: tuple[tuple[jax.Array, jax.Array], ...]

  @property
  def sizes(self) -> tuple[int, int]:
    """Variables of an observation, and actions."""
    return self.mean.shape[0], self.layers[-1][0].shape[1] // 2

  def __call__(self, obs: jax.Array) -> jax.Array:
    """Action in [-1, 1], (..., act), for obs (..., obs): the mode of the squashed normal."""
    x = (obs - self.mean) / self.std
    for kernel, bias in self.layers[:-1]:
      x = jax.nn.swish(x @ kernel + bias)
    kernel, bias = self.layers[-1]
    return jnp.tanh((x @ kernel + bias)[..., : kernel.shape[1] // 2])


def save(path: str | os.PathLike, policy: Policy) -> None:
  """Writes an .npz."""
  named = {"mean": policy.mean, "std": policy.std}
  for i, (kernel, bias) in enumerate(policy.layers):
    named |= {f"kernel{i}": kernel, f"bias{i}": bias}
  arrays.write(path, {k: np.asarray(v, np.float32) for k, v in named.items()})


def load(path: str | os.PathLike) -> Policy:
  """Reads what `save` wrote."""
  try:
    z = {k: jnp.asarray(v) for k, v in arrays.read(path).items()}
    count = sum(k.startswith("kernel") for k in z)
    layers = tuple((z[f"kernel{i}"], z[f"bias{i}"]) for i in range(count))
    policy = Policy(z["mean"], z["std"], layers)
    jax.eval_shape(policy.__call__, policy.mean + policy.std)
    return policy
  except (FileError, IndexError, KeyError, TypeError, ValueError) as e:
    raise FileError(f"cannot read demonstrator {path}: {e}") from None


def _to_policy(params: Any) -> Policy:
  normalizer, network, *_ = params
  numbered = sorted(network["params"].items(), key=lambda item: int(item[0].rsplit("_", 1)[1]))
  layers = tuple((layer["kernel"], layer["bias"]) for _, layer in numbered)
  return Policy(normalizer.mean, normalizer.std, layers)


class Shaped:
  """A robot with an easier reward for its demonstrator alone, who only has to show the way: terms
  weighted otherwise, and a constant added.

  Where penalties outweigh what a beginner earns, each step costs, and PPO learns to end its episode
  by falling.

  Args:
    env: robot with `reward_terms`.
    weights: term -> factor on its weight.
    bonus: added to every step's reward.
  """

  def __init__(self, env: Any, weights: dict[str, float], bonus: float) -> None:
    self.env, self.bonus = env, bonus
    factors = jnp.asarray([weights.get(name, 1.0) for name in env.reward_terms], jnp.float32)
    self.model = env.model._replace(
      task=env.model.task | {"reward_weights": env.model.task["reward_weights"] * factors}
    )

  def __getattr__(self, name: str) -> Any:
    return getattr(self.env, name)

  def step(self, model: Model, state: EnvState, action: jax.Array) -> tuple[EnvState, Step]:
    """A step of the robot with the shaped reward."""
    state, out = self.env.step(model, state, action)
    return state, out._replace(reward=out.reward + self.bonus)


PPO = {"discounting": 0.995, "entropy_cost": 1e-2, "reward_scaling": 10.0}
SIZES = {
  "num_envs": 256,
  "unroll_length": 30,
  "num_minibatches": 16,
  "batch_size": 256,
  "num_updates_per_batch": 6,
  "learning_rate": 1e-3,
  "normalize_observations": True,
}
HIDDEN = (128,) * 3  # policy and value


def networks_of(env: Any) -> Any:
  """Brax's networks, of the shapes that `train` trains for `env`."""
  return brax_module("training.agents.ppo.networks").make_ppo_networks(
    len(env.spec.obs),
    len(env.spec.act),
    brax_module("training.acme.running_statistics").normalize,
    policy_hidden_layer_sizes=HIDDEN,
    value_hidden_layer_sizes=HIDDEN,
  )


def _template(env: Any) -> tuple[Any, Any, Any]:
  """(normaliser, policy, value) of those networks: what `latest.msgpack` is read into."""
  net, key = networks_of(env), jax.random.key(0)
  seen = brax_module("training.acme.specs").Array((len(env.spec.obs),), jnp.float32)
  return (
    brax_module("training.acme.running_statistics").init_state(seen),
    net.policy_network.init(key),
    net.value_network.init(key),
  )


def latest(out: pathlib.Path, env: Any) -> tuple[list[dict], tuple]:
  """The curve and the networks that a run in `out` left behind."""
  from flax import serialization

  try:
    rows = json.loads((out / "curve.json").read_text())
    params = serialization.from_bytes(_template(env), (out / "latest.msgpack").read_bytes())
    done = rows[-1]["step"]
  except (OSError, ValueError, KeyError, IndexError, TypeError, RecursionError) as e:
    raise FileError(
      f"{out} holds no demonstrator training that can go on ({e}); leave out --resume to start one"
    ) from None
  return [row for row in rows if row["step"] <= done], params


@dataclass
class Journal:
  """What a training leaves in its folder: curve.json, the latest networks, a policy each time that
  it is evaluated.

  Attributes:
    out: the folder.
    rows: {step, return, seconds} so far.
    progress: called with each new row.
    done: steps of an earlier training that this one goes on from.
    start: when it began, by time.monotonic() [s].
  """

  out: pathlib.Path
  rows: list[dict]
  progress: Callable[[dict[str, Any]], object]
  done: int
  start: float

  def evaluated(self, step: int, metrics: Mapping[str, Any]) -> None:
    """Brax's `progress_fn`."""
    if self.done and not int(step):
      return  # the evaluation that the earlier run ended with
    self.rows.append(
      {
        "step": self.done + int(step),
        "return": float(metrics["eval/episode_reward"]),
        "seconds": round(time.monotonic() - self.start, 1),
      }
    )
    text = json.dumps(self.rows, indent=1)
    folders.atomic(self.out / "curve.json", lambda file: file.write(text.encode()))
    self.progress(self.rows[-1])

  def kept(self, step: int, _: object, params: Any) -> None:
    """Brax's `policy_params_fn`."""
    from flax import serialization

    save(self.out / f"policy_{self.done + int(step):09d}.npz", _to_policy(params))
    state = serialization.to_bytes(jax.device_get(params))
    folders.atomic(self.out / "latest.msgpack", lambda file: file.write(state))


def train(
  env: Any,
  out: str | os.PathLike,
  steps: int,
  seed: int = 0,
  evals: int = 12,
  progress: Callable[[dict[str, Any]], object] = lambda row: None,
  resume: bool = False,
  **settings: Any,
) -> list[dict]:
  """Trains PPO and keeps one policy per evaluation as OUT/policy_NN.npz, with OUT/curve.json.

  `resume` goes on from the last evaluation in `out` up to `steps` in all: networks and observation
  statistics are those of then, the optimiser's moments and the environments start fresh (brax keeps
  neither), so the result is not bit for bit that of one run.

  Settings: 256 environments, unroll 30, 16 minibatches of 256 x 30, 6 epochs, lr 1e-3, observations
  normalised, policy and value 3 x 128, and `PPO` unless the robot has its own in
  `env.demonstration` (`ppo`, and `weights` and `bonus` of Shaped), or `settings` say otherwise
  (arguments of brax's `ppo.train`).

  Returns:
    Rows {step, return, seconds}, return = mean over 128 episodes of the stochastic policy, of the
    shaped reward where there is one.
  """
  own = getattr(env, "demonstration", {})
  out = pathlib.Path(out)
  out.mkdir(parents=True, exist_ok=True)
  rows, params = latest(out, env) if resume else ([], None)
  done, before = (rows[-1]["step"], rows[-1]["seconds"]) if rows else (0, 0.0)
  if done >= steps:
    return rows
  journal = Journal(out, rows, progress, done, time.monotonic() - before)
  brax_module("training.agents.ppo.train").train(
    environment=brax_env(Shaped(env, own["weights"], own["bonus"]) if "bonus" in own else env),
    num_timesteps=steps - done,
    episode_length=env.spec.episode_steps,
    seed=seed + done,
    num_evals=evals,
    restore_params=params,
    progress_fn=journal.evaluated,
    policy_params_fn=journal.kept,
    # a CPU counts as several devices where several seeds train, see runtime.setup
    max_devices_per_host=1 if jax.default_backend() == "cpu" else None,
    network_factory=functools.partial(
      brax_module("training.agents.ppo.networks").make_ppo_networks,
      policy_hidden_layer_sizes=HIDDEN,
      value_hidden_layer_sizes=HIDDEN,
    ),
    **SIZES | PPO | own.get("ppo", {}) | settings,
  )
  return rows


def main() -> None:
  """Python -m mjx_cl.training.demonstrator ENV --out DIR --steps N --seed N --resume"""
  runtime.setup()
  parser = argparse.ArgumentParser(
    prog="python -m mjx_cl.training.demonstrator",
    description="Train the demonstrator of the cpu preset with brax PPO.",
  )
  parser.add_argument("env", choices=sorted(envs.ENVS))
  parser.add_argument("--out", required=True)
  parser.add_argument("--steps", type=int, default=8_000_000)
  parser.add_argument("--seed", type=int, default=0)
  parser.add_argument("--evals", type=int, default=12, help="how often it is evaluated and kept")
  parser.add_argument(
    "--resume", action="store_true", help="go on from the last evaluation in --out"
  )
  args = parser.parse_args()
  told = lambda row: print(json.dumps(row), file=sys.stderr, flush=True)
  try:
    env = envs.make(args.env)
    train(env, args.out, args.steps, args.seed, args.evals, told, args.resume)
  except UserError as e:
    print(f"mjx-cl: {e}", file=sys.stderr)
    raise SystemExit(e.exit_code) from None


if __name__ == "__main__":
  main()
