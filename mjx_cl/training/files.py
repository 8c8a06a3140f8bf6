"""Files of a training: config.json, by which it is begun, resumed or refused; its demonstrator; the
agent that it leaves.
"""

import dataclasses
import json
import os
import pathlib
import sys
from typing import Any

import jax
import jax.numpy as jnp

from mjx_cl.config import DreamerConfig, TrainConfig, recorded
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import folders, runtime, tables
from mjx_cl.training import agents, demonstrator, evaluate
from mjx_cl.training.premises import check, scaled
from mjx_cl.training.trainer import Trainer, mean

DEMONSTRATOR_STEPS = 8_000_000


def build(
  env: Any,
  dreamer: DreamerConfig,
  config: TrainConfig,
  out: os.PathLike | str,
  seed: int,
  seeds: int,
  demonstrator_name: str | None,
  agent_name: str | None,
  preset: str,
  command: str,
  resume: bool,
) -> Trainer:
  """A Trainer with its folder and config.json; trains the demonstrator first where
  `demonstrator_name` is `ppo`.
  """
  out, dreamer = pathlib.Path(out), scaled(env, dreamer)
  config = shown(config, out, demonstrator_name)
  about = {
    "env": env.spec.name,
    "preset": preset,
    "command": command,
    "seed": seed,
    "repeat": config.repeat,
    "dreamer": dataclasses.asdict(dreamer),
    "train": dataclasses.asdict(config),
    "started_from": agent_name,
  }
  values = {"command": "train", "seeds": seeds, **about, **runtime.provenance()}
  if demonstrator_name == "ppo":
    tables.write_json(out / "config.json", values)  # by which it goes on if it is cut off
    _demonstrate(env, out / "demonstrator", seed, resume)
  trainer = Trainer(env, dreamer, config, out, seed, seeds)
  trainer.about = about
  if resume and trainer.checkpoints.latest() is not None:
    trainer.resume()
  elif agent_name:  # one that was cut off before its first checkpoint begins anew
    check(env, dreamer, config, agent_name)
    trained = agents.of(env, agent_name)
    spread = jax.tree.map(lambda x: jnp.broadcast_to(x, (seeds,) + x.shape).copy(), trained.train)
    trainer.state = trainer.state._replace(
      train=spread._replace(updates=jnp.zeros_like(spread.updates))
    )
  tables.write_json(out / "config.json", values)  # `updates` may have grown
  return trainer


def _demonstrate(env: Any, folder: pathlib.Path, seed: int, resume: bool) -> None:
  """Trains the demonstrator of a training unless its policy lies there."""
  if (folder / "policy.npz").exists():
    return
  demonstrator.train(
    env,
    folder,
    getattr(env, "demonstration", {}).get("steps", DEMONSTRATOR_STEPS),
    seed,
    progress=lambda row: print(
      f"demonstrator: {row['step']:,} steps, return {row['return']:.0f}",
      file=sys.stderr,
      flush=True,
    ),
    resume=resume and (folder / "latest.msgpack").exists(),
  )
  os.replace(max(folder.glob("policy_*.npz")), folder / "policy.npz")


def shown(
  config: TrainConfig, out: os.PathLike | str, demonstrator_name: str | None
) -> TrainConfig:
  """The settings with their demonstrator: the policy that `ppo` leaves in the folder, or what the
  user named.
  """
  if not demonstrator_name:
    return config
  own = pathlib.Path(out, "demonstrator", "policy.npz")
  return dataclasses.replace(
    config, demonstrator=str(own) if demonstrator_name == "ppo" else demonstrator_name
  )


def check_same(
  out: os.PathLike | str,
  env: Any,
  dreamer: DreamerConfig,
  config: TrainConfig,
  seed: int,
  seeds: int,
  demonstrator_name: str | None,
  agent_name: str | None,
) -> int:
  """Refuses to resume a training with other settings than it began with; the number of updates may
  be another. Returns the one it has.

  Raises:
    UserError: names the flags.
    FileError: config.json is not a training's.
  """
  settings = dataclasses.asdict(scaled(env, dreamer)) | dataclasses.asdict(
    shown(config, out, demonstrator_name)
  )
  before = _begun(pathlib.Path(out, "config.json"), seeds)
  now = {
    "env": env.spec.name,
    "seed": seed,
    "seeds": seeds,
    **json.loads(json.dumps(settings)),
    "agent": agent_name,
  }
  for key in ("demonstrator", "agent"):
    if before[key] and now[key] and _one_file(pathlib.Path(before[key]), pathlib.Path(now[key])):
      before[key] = now[key]
  changed = folders.differing(before, now, ("updates",))
  if changed:
    raise UserError(
      f"--resume: {out} was begun with another {', '.join(changed)}; give the same settings, "
      "--overwrite, or another --out with "
      f"--agent {pathlib.Path(out, 'agent')} once it has ended"
    )
  return int(before["updates"])


def _one_file(a: pathlib.Path, b: pathlib.Path) -> bool:
  """Whether two paths mean one file, which may be named in two ways; its folder may have moved."""
  return a.resolve() == b.resolve() if a.exists() and b.exists() else a.name == b.name


def _begun(path: pathlib.Path, seeds: int) -> dict[str, Any]:
  """The settings that a training's config.json holds, one beside another; of a setting younger than
  the training its default.
  """
  try:
    old = tables.read_json(path)
    return {
      "env": old["env"],
      "seed": old["seed"],
      "seeds": old.get("seeds", seeds),
      **dataclasses.asdict(DreamerConfig()),
      **dataclasses.asdict(TrainConfig()),
      **recorded(DreamerConfig, old["dreamer"]),
      **recorded(TrainConfig, old["train"]),
      "agent": old.get("started_from"),
    }
  except (FileError, ValueError, KeyError, TypeError) as e:
    why = f": {e}" if type(e) in (FileError, ValueError) else ""
    raise FileError(f"{path} is not a training's{why}; give --overwrite or another --out") from None


def clear(out: pathlib.Path) -> None:
  """Removes the agents and the demonstrator that an earlier training wrote, nothing else; the rest:
  run.clear.
  """
  for path in (
    out / "agent/agent.npz",
    out / "agent/card.json",
    *out.glob("seed-*/agent/agent.npz"),
    *out.glob("seed-*/agent/card.json"),
    *(out / "demonstrator").glob("policy*.npz"),
  ):
    path.unlink(missing_ok=True)


def export(trainer: Trainer, count: int = 20) -> dict[str, Any]:
  """Writes an agent of every seed that has not failed, with weights, moments, counters, and the
  card with its returns: the first to OUT/agent, of several each to OUT/seed-N/agent too, N counting
  from the training's seed. Returns the card of the first.
  """
  sound = sorted(set(range(trainer.seeds)) - set(trainer.failed))
  about = _told(trainer)
  cards: list[dict[str, Any]] = []
  first: Any = None
  for g in sound:
    train = jax.tree.map(lambda x: jax.device_put(x[g], jax.devices()[0]), trainer.state.train)
    scores = evaluate.evaluate(
      trainer.env, trainer.plain, train.params, count, 0, trainer.config.repeat
    )
    cards.append(about | {"eval": {"first_seed": 0, **scores}, **runtime.provenance()})
    first = train if g == sound[0] else first
    if trainer.seeds > 1:
      own = cards[-1] | {"group": g}
      agents.save(trainer.out / f"seed-{about['seed'] + g}" / "agent", train, own)
  agents.save(trainer.out / "agent", first, cards[0])  # the last, since it says that all is done
  return cards[0]


def _told(trainer: Trainer) -> dict[str, Any]:
  """What the cards of a training's seeds have in common."""
  phases = {}
  for name in dict.fromkeys(row["phase"] for row in trainer.rows):
    mine = [row for row in trainer.rows if row["phase"] == name]
    returns = [row["return"] for row in mine if row["return"] is not None]
    phases[name] = {
      "first_update": mine[0]["updates"],
      "last_update": mine[-1]["updates"],
      # own episodes of the training, about the last three rounds
      "return_at_end": mean(returns[-3:]),
      "return_at_start": mean(returns[:1]),
    }
  kept = json.loads(json.dumps(trainer.about))
  if kept["train"]["demonstrator"]:
    kept["train"]["demonstrator"] = pathlib.Path(kept["train"]["demonstrator"]).name
  return {
    **kept,
    "updates": trainer.updates,
    "records": trainer.rows[-1]["records"],
    "seconds": round(trainer.seconds),
    "phases": phases,
    "demonstrator_return": trainer.expert_return or None,
  }
