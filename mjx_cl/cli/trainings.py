"""Trainings on a cluster: each seed is one of its own there, that of `mjx-cl train --seed N`.

Seeds in one program share more than the program: one key draws for all, and a demonstrator leaves
them by their mean return. So no part of that training could be made elsewhere.
"""

import dataclasses
import pathlib
import re
from typing import Any

from mjx_cl.cli.flags import Train
from mjx_cl.cli.machines import WORKER
from mjx_cl.cli.output import say
from mjx_cl.config import DreamerConfig, TrainConfig, check_seeds
from mjx_cl.errors import require
from mjx_cl.io import arrays, folders, memory, tables
from mjx_cl.runs import cluster
from mjx_cl.training import files, needs

# what a part is not told: it has its own
DRIVERS = ("out", "seed", "seeds", "on", "address", "gpu", "json", "resume", "overwrite")


def asked(args: Train) -> cluster.Cluster | None:
  """The cluster that is asked for, None where agents are trained here."""
  on = cluster.of(args.on, args.address, args.gpu)
  require(
    on is None or not args.overwrite,
    "on a cluster the same command goes on, and replaces nothing; leave out --overwrite, and give "
    "another --out for other trainings",
  )
  return on


def spread(
  args: Train,
  env: Any,
  dreamer: DreamerConfig,
  config: TrainConfig,
  command: str,
  on: cluster.Cluster,
) -> dict[str, dict]:
  """Trains each seed on a core of a cluster, into OUT/seed-N; what is finished is not made again.

  Returns:
    name -> the agent's card.

  Raises:
    UserError: OUT holds something else, or a seed's training with other settings.
    FileError: as `cluster.together`.
  """
  check_seeds(args.seed, args.seeds)
  out = folders.usable(args.out)
  ours = lambda name: name in ("suite.json", cluster.HERE) or re.fullmatch(r"seed-\d+(.tmp)?", name)
  others = sorted(p.name for p in out.iterdir() if not ours(p.name)) if out.is_dir() else []
  require(not others, f"{out} holds {others[:1]} beside trainings of seeds; give another --out")
  seeds = {f"seed-{n}": n for n in range(args.seed, args.seed + args.seeds)}
  for name, seed in seeds.items():
    if (out / name / "config.json").exists():
      same = (seed, 1, args.demonstrator, args.agent)
      files.check_same(out / name, env, dreamer, config, *same)
  card = lambda name: out / name / "agent" / "card.json"
  todo = [name for name in seeds if not card(name).exists()]
  told = {k: v for k, v in dataclasses.asdict(args).items() if k not in DRIVERS}
  parts = {name: {"seed": n, "command": command, "flags": told} for name, n in seeds.items()}
  folders.make(out)
  tables.write_json(out / "suite.json", {"command": "train", "parts": parts})
  sizes, records = (len(env.spec.obs), len(env.spec.act)), config.envs * config.capacity
  need = needs.need(dreamer.size, *sizes, records, dreamer.bins).total(1)
  over: list[str] = []

  def finished(name: str) -> None:
    over.append(name)
    mean = tables.read_json(card(name))["eval"]["return_mean"]
    say(f"{name} trained, {len(over)} of {len(todo)}; return {mean:.0f}")

  if todo:
    bytes_of = dict.fromkeys(todo, memory.resident(need))
    cluster.together(WORKER, out, todo, bytes_of, finished, say, on, whole)
  say(f"agents in {out}/seed-*/agent")
  return {name: tables.read_json(card(name)) for name in seeds}


def whole(folder: pathlib.Path) -> None:
  """Raises FileError for a broken file of a training that came back."""
  for name in ("config.json", "agent/card.json"):
    tables.read_json(folder / name)
  arrays.read(folder / "agent" / "agent.npz")
