"""Runs that differ in nothing but their seeds, joined to one: what several machines lived, or one
machine on several days.

A stream's keys come from its seed alone, so the seeds of a run may be lived apart; only the last
digits of a float may differ then (see run.Runner). The joined folder is as `mjx-cl run` writes it:
streams are numbered arm by arm, seed by seed, and summary.json is computed anew from the rows. Its
config.json is the first piece's with all the seeds, and `pieces` says of each when and on what it
was run. Tables that one piece lacks, as published ones lack their trace, are left out; agents that
were kept stay by arm and seed.
"""

from __future__ import annotations

import functools
import pathlib
import shutil
from typing import TYPE_CHECKING

import numpy as np
import pyarrow

from mjx_cl import envs
from mjx_cl.adapt.arms import ARMS
from mjx_cl.config import RunConfig
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import folders as folder_lib
from mjx_cl.io import tables as store
from mjx_cl.render import figures
from mjx_cl.runs import records
from mjx_cl.runs.identity import arm_agents, differing, identity
from mjx_cl.scoring import events
from mjx_cl.scoring import stop_rule as stop
from mjx_cl.training import agents

if TYPE_CHECKING:
  from collections.abc import Iterable

ORDER = {
  "trace": "step",
  "events": "step",
  "runs": "change",
  "signals": "step",
  "snapshots": "step",
  "stop": "since",
  "residuals": "step",
}  # table -> what follows the stream
KEPT = ("git_commit", "machine", "python", "versions")
SEEDS = ("seeds", "first_seed")  # settings that pieces do not share
SAME = (
  "physics",
  "agent_card",
  "arm_cards",
  "repeat",
  "control_s",
)  # of config.json, beside the settings: one agent and one backend lived all the seeds

SUMMED = (
  "env",
  "fault",
  "severity",
  "onset",
  "steps",
  "detector",
  "invalid_share",
  "wall_s",
  "wall_s_arms",
  "wall_share",
)  # what `join` takes from summary.json


def differs(folder: pathlib.Path | str, config: RunConfig, but: tuple[str, ...] = ()) -> str | None:
  """How the run in `folder` differs from `config`, as the rest of a line that begins with it; None
  where it does not, or there is none.

  Of `oracle_stops` those of the folder's own seeds count. Agents are compared by their cards, as
  far as today's can be read: a key that a card has gained since is no difference.

  Args:
    but: settings that may differ.

  Raises:
    FileError for a config.json or an agent that is broken.
  """
  folder = pathlib.Path(folder)
  if not (folder / "config.json").exists():
    return None
  try:
    old = store.read_json(folder / "config.json")
  except FileError as e:
    raise FileError(f"{e}; give another folder, or remove that one") from None
  values = {k: v for k, v in identity(config).items() if k not in ("physics", *but)}
  if "oracle_stops" in values:
    values["oracle_stops"] = {
      seed: stop
      for seed, stop in values["oracle_stops"].items()
      if int(seed) in _seeds(folder, old)
    }
  changed = differing(old, values)
  for name, today in cards(config).items():
    if name in old and (keys := folder_lib.differing(today, old[name], deep=True)):
      changed.append(f"{name} ({', '.join(keys)})")
  if changed == ["threshold"]:
    return (
      f"was begun when its detector {old.get('detector')} had another default threshold than today"
    )
  return f"was begun with another {', '.join(changed)}" if changed else None


def cards(config: RunConfig) -> dict[str, dict]:
  """Today's `agent_card` and `arm_cards` as config.json holds them; empty where there is no agent,
  as where it was moved.

  Raises:
    FileError for a broken one.
  """
  file = pathlib.Path(config.agent or "no agent by folder") / "card.json"
  return _cards(
    config.env,
    config.agent,
    tuple(arm for arm in config.arms if ARMS[arm].agent),
    file.stat().st_mtime_ns if file.is_file() else None,
  )


@functools.lru_cache(maxsize=64)
def _cards(
  env_name: str, agent: str | None, arms: tuple[str, ...], written: int | None
) -> dict[str, dict]:
  """written: when the card of an agent by folder was; it stands for its content."""
  try:
    env = envs.make(env_name, "auto")
    others = arm_agents(RunConfig(env_name, agent=agent, arms=("none", *arms)), env)
    return {
      "agent_card": agents.of(env, agent).card,
      **({"arm_cards": {arm: other.card for arm, other in others.items()}} if others else {}),
    }
  except FileError:
    raise
  except UserError:
    return {}


def seeds_of(folder: pathlib.Path | str, config: RunConfig) -> list[int] | None:
  """Seeds of the finished run in `folder` if it is `config` but for its seeds; None where there is
  no finished run.

  Raises:
    UserError where it was run with other settings; FileError for a config.json that is not a run's.
  """
  folder = pathlib.Path(folder)
  if not (folder / "config.json").exists() or not (folder / "summary.json").exists():
    return None
  if text := differs(folder, config, SEEDS):
    raise UserError(f"{folder} {text}; --overwrite of `mjx-cl run` begins it anew")
  return list(_seeds(folder, store.read_json(folder / "config.json")))


def _seeds(folder: pathlib.Path, values: dict) -> range:
  """Seeds of a run by its config.json, `values`."""
  try:
    return range(values["first_seed"], values["first_seed"] + values["seeds"])
  except (KeyError, TypeError):
    raise FileError(f"{folder / 'config.json'} is not a run's: it does not say its seeds") from None


def choose(folders: Iterable[pathlib.Path | str], config: RunConfig) -> list[pathlib.Path]:
  """Of `folders` those whose seeds make up the seeds of `config`, in the order of their seeds;
  empty where none of them holds any.

  Raises:
    UserError where one holds seeds that are not asked for, two hold the same seed, or one is in
      none of them: the line names it.
  """
  wanted = range(config.first_seed, config.first_seed + config.seeds)
  found: dict[int, pathlib.Path] = {}
  begins = {}
  for folder in map(pathlib.Path, folders):
    own = seeds_of(folder, config)
    if own is None:
      continue
    if not set(own) <= set(wanted):
      raise UserError(
        f"{folder} holds seeds {own[0]} to {own[-1]}, asked for are {wanted[0]} to "
        f"{wanted[-1]}; give --first-seed and --seeds that hold them"
      )
    for seed in own:
      if seed in found:
        raise UserError(f"seed {seed} lies both in {found[seed]} and in {folder}; give one of them")
      found[seed] = folder
    begins[folder] = own[0]
  missing = [seed for seed in wanted if seed not in found]
  if found and missing:
    raise UserError(
      f"{', '.join(map(str, begins))}: no seed {', '.join(map(str, missing))}; run what is "
      f"missing with --first-seed {missing[0]} --seeds N and "
      "another --out, or ask for fewer --seeds"
    )
  return sorted(begins, key=begins.get)  # type: ignore[arg-type]


def join(folders: Iterable[pathlib.Path], out: pathlib.Path | str, config: RunConfig) -> dict:
  """Writes the run of all seeds of `folders` into the folder `out` and returns summary.json's
  value.

  Args:
    folders: of finished runs, see `choose`. config: with the seeds of all of them.

  Raises:
    UserError where pieces differ in their agent or physics; FileError for a piece that cannot be
    read.
  """
  folders, out = [pathlib.Path(f) for f in folders], pathlib.Path(out)
  summaries, configs = [], []
  for folder in folders:
    summaries.append(store.read_json(folder / "summary.json"))
    configs.append(store.read_json(folder / "config.json"))
    lacks = [k for k in SUMMED if k not in summaries[-1]]
    if lacks:
      raise FileError(f"{folder / 'summary.json'} is not a run's: it lacks {', '.join(lacks)}")
  first = {k: configs[0].get(k) for k in SAME}
  differ = sorted({k for own in configs for k in folder_lib.differing(own, first)}, key=SAME.index)
  if differ:
    raise UserError(
      f"{', '.join(map(str, folders))} are no pieces of one run: they differ in {', '.join(differ)}"
    )
  arms = list(config.arms)
  number = {
    (arm, config.first_seed + i): a * config.seeds + i
    for a, arm in enumerate(arms)
    for i in range(config.seeds)
  }
  out.mkdir(parents=True, exist_ok=True)
  rows = {}
  for name, key in ORDER.items():
    files = [folder / f"{name}.parquet" for folder in folders]
    if not all(file.exists() for file in files):
      continue
    read = events.read if name == "events" else store.read_arrow
    tables = [read(file) for file in files]
    table = joined(tables, number, key)
    rows[name] = table
    store.write_arrow(out / f"{name}.parquet", table)
  if "runs" not in rows:
    raise FileError(f"no runs.parquet in one of {', '.join(map(str, folders))}")
  runs = rows["runs"].to_pylist()
  # what is a mean over control steps is weighted by streams; of seconds the sum counts, as if the
  # pieces had been run one after another
  wall = [s["wall_s"] for s in summaries]
  mean = lambda values, weights: float(np.average(values, weights=weights))
  invalid = [
    (s["invalid_share"], c["seeds"])
    for s, c in zip(summaries, configs)
    if s["invalid_share"] is not None
  ]
  spec = envs.make(config.env).spec
  value = {k: summaries[0][k] for k in SUMMED[:6]}
  value |= records.by_arm(runs, config, spec.control_s)
  interval = None  # of streams, so it needs their trace
  if "trace" in rows:
    interval = records.invalid(
      rows["trace"]["valid"].to_numpy(zero_copy_only=False).reshape(len(number), -1).T,
      int(configs[0]["repeat"]),
    )[1]
  value |= {
    "invalid_share": mean(*zip(*invalid)) if invalid else None,
    "invalid_share_ci": interval,
    "wall_s": float(sum(wall)),
    "wall_s_arms": {
      arm: float(sum(s["wall_s_arms"][arm] for s in summaries))
      for arm in summaries[0]["wall_s_arms"]
    },
    "wall_share": {
      k: mean([s["wall_share"][k] for s in summaries], wall) for k in summaries[0]["wall_share"]
    },
  }
  if "stop" in rows:
    value["wall_s_snapshots"] = float(sum(s.get("wall_s_snapshots") or 0.0 for s in summaries))
    value["stop_rule"] = stop.summarise(rows["stop"].to_pylist())
  pieces = [
    piece
    for own in configs
    for piece in own.get(
      "pieces", [{k: own[k] for k in ("first_seed", "seeds", *KEPT) if k in own}]
    )
  ]
  told = {seed: stop for own in configs for seed, stop in own.get("oracle_stops", {}).items()}
  store.write_json(
    out / "config.json",
    configs[0]
    | {
      "first_seed": config.first_seed,
      "seeds": config.seeds,
      **({"oracle_stops": told} if told else {}),
      "pieces": pieces,
    },
  )
  for folder in folders:
    copy_agents(folder, out)
  if "trace" in rows:
    figures.figure(out)
  store.write_json(out / "summary.json", value)  # last: a folder with it is a finished run
  return value


def copy_agents(folder: pathlib.Path, out: pathlib.Path) -> None:
  """Agents that the run in `folder` kept (RunConfig.keep), ARM-SEED each, also into the folder
  `out`.
  """
  if (folder / "agents").is_dir():
    shutil.copytree(folder / "agents", out / "agents", dirs_exist_ok=True)


def joined(
  tables: list[pyarrow.Table], number: dict[tuple[str, int], int], key: str
) -> pyarrow.Table:
  """Pyarrow Tables one below the other, `stream` counted anew, ordered by stream and `key`. A
  column that a piece lacks is null there.
  """
  table = pyarrow.concat_tables(tables, promote_options="permissive")
  stream = [number[at] for at in zip(table["arm"].to_pylist(), table["seed"].to_pylist())]
  at = table.column_names.index("stream")
  table = table.set_column(at, "stream", pyarrow.array(stream, table.schema.field("stream").type))
  rank = pyarrow.array(range(len(table)))  # events of one step stay in their order
  return (
    table.append_column("rank", rank)
    .sort_by([("stream", "ascending"), (key, "ascending"), ("rank", "ascending")])
    .drop_columns("rank")
  )
