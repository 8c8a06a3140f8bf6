"""Runs that differ in nothing but their seeds, joined to one: what several machines lived, or one
machine on several days.

A stream's keys come from its seed alone, so the seeds of a run may be lived apart; only the last
digits of a float may differ then (see run.Runner). The joined folder is as `mjx-cl run` writes it:
streams are numbered arm by arm, seed by seed, and summary.json is computed anew from the rows. Its
config.json is the first piece's with all the seeds, and `pieces` says of each when and on what it
was run. Tables that one piece lacks, as published ones lack their trace, are left out; agents that
were kept stay by arm and seed.
"""

import functools
import itertools
import pathlib
import shutil
from collections.abc import Iterable

import numpy as np
import pyarrow

from mjx_cl import envs
from mjx_cl.adapt.arms import ARMS
from mjx_cl.config import RunConfig
from mjx_cl.errors import FileError, UserError, require
from mjx_cl.io import arrays
from mjx_cl.io import folders as folder_lib
from mjx_cl.io import tables as store
from mjx_cl.physics import PURE_JAX
from mjx_cl.render import figures
from mjx_cl.runs import summary
from mjx_cl.runs.identity import arm_agents, departure, differing, identity
from mjx_cl.scoring import events, stop_rule
from mjx_cl.training import agents

# table -> what follows the stream
ORDER = {
  "trace": "step",
  "events": "step",
  "runs": "change",
  "signals": "step",
  "snapshots": "step",
  "stop": "since",
  "residuals": "step",
}
KEPT = ("git_commit", "machine", "python", "versions")
PNG_END = b"IEND\xaeB`\x82"  # of every PNG file, https://www.w3.org/TR/png-3/#11IEND
SEEDS = ("seeds", "first_seed")  # settings that pieces do not share
# of config.json, beside the settings: one agent and one backend lived all the seeds
SAME = ("physics", "agent_card", "arm_cards", "repeat", "control_s")
# what `join` takes from summary.json
SUMMED = (
  *summary.HEAD,
  "invalid_share",
  "wall_s",
  "wall_s_arms",
  "wall_share",
)


def differs(folder: pathlib.Path | str, config: RunConfig, but: tuple[str, ...] = ()) -> str | None:
  """How the run in `folder` differs from `config`, as the rest of a line that begins with it; None
  where it does not, or there is none.

  Of `oracle_stops` those of the folder's own seeds count. Agents are compared by their cards, as
  far as today's can be read: a key that a card has gained since is no difference.

  Args:
    folder: of the run.
    config: to compare it with.
    but: settings that may differ.

  Raises:
    FileError: for a config.json or an agent that is broken.
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
    own = _seeds(folder, old)
    values["oracle_stops"] = {k: v for k, v in values["oracle_stops"].items() if int(k) in own}
  changed = differing(old, values)
  # as the folder holds it, of one robot or of two; pure JAX is the same by any
  lived = {*str(old.get("physics") or "").split("+")} - {PURE_JAX.name, ""}
  if config.physics != "auto" and lived and config.physics not in lived:
    changed.append("physics")
  for name, today in cards(config).items():
    if name in old and (keys := folder_lib.differing(today, old[name], deep=True)):
      changed.append(f"{name} ({', '.join(keys)})")
  return departure(old, changed) or None


def cards(config: RunConfig) -> dict[str, dict]:
  """Today's `agent_card` and `arm_cards` as config.json holds them; empty where there is no agent,
  as where it was moved.

  Raises:
    FileError: for a broken one.
  """
  file = pathlib.Path(config.agent or "no agent by folder") / "card.json"
  written = file.stat().st_mtime_ns if file.is_file() else None
  arms = tuple(arm for arm in config.arms if ARMS[arm].agent)
  return _cards(config.env, config.agent, arms, written)


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
    UserError: where it was run with other settings.
    FileError: for a config.json that is not a run's.
  """
  folder = pathlib.Path(folder)
  if not (folder / "config.json").exists() or not (folder / "summary.json").exists():
    return None
  text = differs(folder, config, SEEDS)
  require(not text, f"{folder} {text}; --overwrite of `mjx-cl run` begins it anew")
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
    UserError: where one holds seeds that are not asked for, two hold the same seed, or one is in
      none of them: the line names it.
  """
  wanted = range(config.first_seed, config.first_seed + config.seeds)
  found: dict[int, pathlib.Path] = {}
  for folder in map(pathlib.Path, folders):
    own = seeds_of(folder, config) or []
    require(
      set(own) <= set(wanted),
      f"{folder} holds seeds {min(own, default='')} to {max(own, default='')}, asked for are "
      f"{wanted[0]} to {wanted[-1]}; give --first-seed and --seeds that hold them",
    )
    for seed in own:
      if seed in found:
        raise UserError(f"seed {seed} lies both in {found[seed]} and in {folder}; give one of them")
      found[seed] = folder
  missing = [seed for seed in wanted if seed not in found]
  if found and missing:
    raise UserError(
      f"{', '.join(map(str, dict.fromkeys(found.values())))}: no seed "
      f"{', '.join(map(str, missing))}; run what is missing with --first-seed {missing[0]} "
      "--seeds N and another --out, or ask for fewer --seeds"
    )
  return list(dict.fromkeys(found[seed] for seed in sorted(found)))


def whole(folder: pathlib.Path) -> None:
  """Reads all files of a finished run of somebody else's.

  Raises:
    FileError: one is broken, missing, or a symbolic link, which may lead anywhere.
  """
  files = sorted(path for path in folder.rglob("*") if not path.is_dir() or path.is_symlink())
  for file in (folder, *files):
    if file.is_symlink():
      raise FileError(f"{file} is a symbolic link; put the file itself there")
  for name in ("config.json", "summary.json", "runs.parquet"):
    if folder / name not in files:
      raise FileError(f"{folder} holds no {name}; run that part again")
  for file in files:
    try:
      if file.suffix == ".json":
        store.read_json(file)
      elif file.suffix == ".parquet":
        store.read_arrow(file)
      elif file.suffix == ".npz":
        arrays.read(file)
      elif file.suffix == ".png" and not file.read_bytes().endswith(PNG_END):
        raise FileError(f"{file} is no whole picture")
    except FileError as e:
      raise FileError(f"{e}; copy that run once more, or run it again") from None


def join(folders: Iterable[pathlib.Path], out: pathlib.Path | str, config: RunConfig) -> dict:
  """Writes the run of all seeds of `folders` into the folder `out` and returns summary.json's
  value.

  Args:
    folders: of finished runs, see `choose`.
    out: folder of the joined run.
    config: with the seeds of all of them.

  Raises:
    UserError: where pieces differ in their agent or physics.
    FileError: for a piece that cannot be read.
  """
  folders, out = [pathlib.Path(f) for f in folders], pathlib.Path(out)
  summaries = [store.read_json(folder / "summary.json") for folder in folders]
  configs = [store.read_json(folder / "config.json") for folder in folders]
  for folder, own in zip(folders, summaries):
    if lacks := [k for k in SUMMED if k not in own]:
      raise FileError(f"{folder / 'summary.json'} is not a run's: it lacks {', '.join(lacks)}")
  first = {k: configs[0].get(k) for k in SAME}
  differ = {k for own in configs for k in folder_lib.differing(own, first)}
  require(
    not differ,
    f"{', '.join(map(str, folders))} are no pieces of one run: they differ in "
    f"{', '.join(sorted(differ, key=SAME.index))}",
  )
  out.mkdir(parents=True, exist_ok=True)
  rows = _join_tables(folders, out, config)
  value = _summary(summaries, configs, rows, config)
  told = {seed: stop for own in configs for seed, stop in own.get("oracle_stops", {}).items()}
  said = {"first_seed": config.first_seed, "seeds": config.seeds, "pieces": _pieces(configs)}
  if told:
    said["oracle_stops"] = told
  store.write_json(out / "config.json", configs[0] | said)
  for folder in folders:
    copy_agents(folder, out)
  if "trace" in rows:
    figures.figure(out)
  store.write_json(out / "summary.json", value)  # last: a folder with it is a finished run
  return value


def _join_tables(
  folders: list[pathlib.Path], out: pathlib.Path, config: RunConfig
) -> dict[str, pyarrow.Table]:
  """Writes every table that all folders have, and returns them by name."""
  seeds = range(config.first_seed, config.first_seed + config.seeds)
  number = {at: k for k, at in enumerate(itertools.product(config.arms, seeds))}
  rows = {}
  for name, key in ORDER.items():
    files = [folder / f"{name}.parquet" for folder in folders]
    if all(file.exists() for file in files):
      read = events.read if name == "events" else store.read_arrow
      rows[name] = joined([read(file) for file in files], number, key)
      store.write_arrow(out / f"{name}.parquet", rows[name])
  if "runs" not in rows:
    raise FileError(f"no runs.parquet in one of {', '.join(map(str, folders))}")
  return rows


def _summary(
  summaries: list[dict], configs: list[dict], rows: dict[str, pyarrow.Table], config: RunConfig
) -> dict:
  """summary.json of the joined run. What is a mean over control steps is weighted by streams; of
  seconds the sum counts, as if the pieces had been run one after another.
  """
  wall = [s["wall_s"] for s in summaries]
  mean = lambda values, weights: float(np.average(values, weights=weights))
  invalid = [
    (s["invalid_share"], c["seeds"])
    for s, c in zip(summaries, configs)
    if s["invalid_share"] is not None
  ]
  interval = None  # of streams, so it needs their trace
  if "trace" in rows:
    valid = rows["trace"]["valid"].to_numpy(zero_copy_only=False)
    streams = len(config.arms) * config.seeds
    interval = summary.invalid(valid.reshape(streams, -1).T, int(configs[0]["repeat"]))[1]
  value = {
    **{k: summaries[0][k] for k in summary.HEAD},
    **summary.by_arm(rows["runs"].to_pylist(), config, envs.make(config.env).spec.control_s),
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
    value["stop_rule"] = stop_rule.summarise(rows["stop"].to_pylist())
  return value


def _pieces(configs: list[dict]) -> list[dict]:
  """When and on what each piece was run; those of a piece that was joined itself, one by one."""
  own = lambda c: [{k: c[k] for k in ("first_seed", "seeds", *KEPT) if k in c}]
  return [piece for c in configs for piece in c.get("pieces", own(c))]


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
