"""Recording of a suite: healthy and faulty robots of all seeds in one batched program per robot and
split, written as streams.py describes.
"""

import dataclasses
import functools
import itertools
import json
import os
import pathlib
import shutil
import time
from collections.abc import Callable, Collection, Iterable
from typing import Any

from mjx_cl import envs
from mjx_cl import faults as faults_lib
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import folders, runtime, tables
from mjx_cl.leaderboard import parts as parts_of
from mjx_cl.leaderboard import room, set_tables
from mjx_cl.leaderboard.streams import META, SCHEMA, VERSION
from mjx_cl.leaderboard.suite import Suite
from mjx_cl.rollout.monitor import watched
from mjx_cl.training import agents

MADE = ("command", "versions", "python", "git_commit", "machine")  # of config.json: how it was made
ENDS = ("", "_latents", "_innovations")  # of the names of a robot's files
HELD = "held.json"  # config.json of the set whose files are being replaced


def claim(
  suite: Suite, out: pathlib.Path | str, overwrite: bool, robots: Collection[str] = ()
) -> None:
  """Makes sure that `out` may take a recording of the suite; with `overwrite` the set that it holds
  is removed, and no other file; where it has more than the `robots` named, and is of this very
  suite, it stays until theirs are recorded, see `record`.

  Raises:
    UserError for a folder that holds a set, or anything else than parts of one.
  """
  out = pathlib.Path(out)
  if not out.exists():
    return
  held = _held(out)
  if held is not None and not overwrite:
    raise UserError(f"{out} holds a recorded set; give --overwrite to replace it, or another --out")
  if held and robots and held - set(robots):
    _beside(suite, out, robots)
    return
  ours = {"config.json", "streams.parquet"} | {
    f"{r}{end}.parquet" for r in {*suite.robots, *(held or ())} for end in ENDS
  }
  if held is not None:
    for name in sorted(ours):
      (out / name).unlink(missing_ok=True)
    clear(out)
  elif {p.name.removesuffix(".tmp") for p in out.iterdir()} - ours - {"work"} or _others(out):
    raise _foreign(out)


def _foreign(out: pathlib.Path) -> UserError:
  return UserError(f"{out} is no folder of a recording; give another --out")


def _held(out: pathlib.Path) -> set[str] | None:
  """Robots of the set in `out`, None where it has no config.json."""
  if not out.is_dir():
    raise _foreign(out)
  if not (out / "config.json").exists():
    return None
  try:
    config = tables.read_json(out / "config.json")
    robots = set(config["suite"]["robots"])
  except (FileError, KeyError, TypeError):
    raise _foreign(out) from None
  if not {"meta", "schema", "stream_steps"} <= set(config):
    raise _foreign(out)
  return robots


def _beside(suite: Suite, out: pathlib.Path, robots: Collection[str]) -> dict | None:
  """config.json of the set in `out` that holds more than `robots`, whose other streams stay there;
  None where it holds no more, or is none.

  Raises:
    UserError where streams of `suite` have no place in it.
  """
  try:
    config = tables.read_json(out / "config.json")
  except FileError:  # or files were being moved into place when it was cut off
    try:
      config = tables.read_json(out / "work" / "set" / HELD)
    except FileError:
      return None
  held = config["suite"]["robots"]
  if not set(held) - set(robots):
    return None
  whole = json.loads(json.dumps(_plain(suite, suite.robots)))
  same = whole | {"robots": {r: whole["robots"].get(r) for r in held}}
  differ = (
    folders.differing(same, config["suite"])
    + [k for k in MADE if k not in config]
    + ["version"] * (config["version"] != VERSION)
    + [k for k in ("details", "stream_steps") if set(config.get(k, ())) != set(held)]
  )
  if differ:
    raise UserError(
      f"{out} holds a set of another suite (its {', '.join(differ)}), whose other robots' "
      "streams would be lost; give another --out, or record all robots"
    )
  return config


def _plain(suite: Suite, robots: Iterable[str]) -> dict:
  """The suite as config.json has it, with these robots alone."""
  return dataclasses.asdict(suite) | {"robots": {r: suite.robots[r] for r in robots}}


def _others(out: pathlib.Path) -> list[pathlib.Path]:
  """What in the folder `work` is no part of a recording; `parts` holds those that were lived
  elsewhere, see apart.py.
  """
  staged = lambda p: (
    p.name == "set"
    and p.is_dir()
    and all(f.suffix in (".parquet", ".json", ".tmp") for f in p.iterdir())
  )
  parts = (out / "work").iterdir() if (out / "work").is_dir() else ()
  ours = lambda p: p.name.removesuffix(".tmp").endswith(".npz") or p.name == "parts" or staged(p)
  return [p for p in parts if not ours(p)]


def clear(out: pathlib.Path | str) -> None:
  """Removes the parts of a recording."""
  work = pathlib.Path(out) / "work"
  if work.is_dir() and not _others(work.parent):
    shutil.rmtree(work)


def _publish(staged: pathlib.Path, out: pathlib.Path) -> None:
  """Moves a set's files into place. config.json, without which a folder holds no set, leaves first
  and comes last: no one reads old beside new.
  """
  if (out / "config.json").exists():
    os.replace(out / "config.json", staged / HELD)
  for p in sorted(staged.glob("*.parquet")):
    os.replace(p, out / p.name)
  os.replace(staged / "config.json", out / "config.json")


def prepare(
  suite: Suite, robots: Collection[str], physics: str, agent: str | None
) -> dict[str, tuple[Any, agents.Trained]]:
  """Robot -> (env, agent) of a recording; all robots of the suite where none is named.

  Raises:
    UserError, before hours are spent: an unknown robot, fault, target or agent, an agent that does
      not act in every control step, or more than memory holds.
  """
  out = {}
  for robot in robots or suite.robots:
    if robot not in suite.robots:
      raise UserError(
        f"suite {suite.name!r} has no robot {robot!r}; choose from: {', '.join(suite.robots)}"
      )
    if ":" in robot:
      raise UserError(
        f"suite {suite.name!r}: robot {robot!r} gives the recording's files their names; "
        "register it, in the entry-point group mjx_cl.envs"
      )
    env = envs.make(robot, physics)
    for key in itertools.chain(*suite.robots[robot].values()):
      fault, _, target = key.partition(":")
      faults_lib.target_index(faults_lib.make(fault, env), target or None)
    trained = agents.of(env, agent)
    if trained.repeat != 1:
      raise UserError(
        f"the agent of {robot!r} holds its actions; streams are recorded with agents that act "
        "in every control step"
      )
    room.check(suite, robot, env.spec, trained.agent.config)
    out[robot] = env, trained
  return out


def record(
  suite: Suite,
  out: pathlib.Path | str,
  robots: Collection[str] = (),
  physics: str = "auto",
  agent: str | None = None,
  command: str = "",
  progress: Callable[[str, int, int, int], Any] = lambda part, done, steps, lanes: None,
) -> dict:
  """Records a suite into the folder `out`; parts that are finished already are kept, so a recording
  that was cut off goes on.

  Where `robots` are named and `out` holds a set of this very suite, the streams of its other robots
  stay in it, with the numbers that they have; how they were recorded stands under `kept` of
  config.json then.

  Args:
    suite: what is recorded.
    out: the folder.
    robots: of the suite, all where empty.
    physics: name of the simulator.
    agent: of the robots; None: those that ship.
    command: for config.json.
    progress: called as progress(part, steps lived, of how many, lanes).

  Returns:
    {robot: stream-steps per second of its parts}, plus the size of the files.
  """
  out = pathlib.Path(out)
  ready = prepare(suite, robots, physics, agent)
  staged = out / "work" / "set"
  staged.mkdir(parents=True, exist_ok=True)
  for p in staged.iterdir():
    if p.name != HELD:
      p.unlink()
  old, table = _old(suite, out, robots)
  kept = [r for r in old["suite"]["robots"] if r not in robots] if old else []
  rows = [row for row in table if row["robot"] in kept]
  free, speed = 1 + max((row["stream"] for row in table), default=-1), {}
  made: dict[str, dict] = {"agents": {}, "details": {}, "stream_steps": {}}
  for robot, (env, trained) in ready.items():
    parts, speed[robot] = _parts(suite, robot, env, trained, out / "work", physics, progress)
    groups = ",".join(name for name, _ in watched(env.spec))
    variables = (*(v.name for v in env.spec.obs), "reward") if suite.innovations else ()
    number = min((row["stream"] for row in table if row["robot"] == robot), default=free)
    made["details"][robot], fresh = set_tables.write(
      suite, staged, robot, parts, number, env.spec.control_s, groups, variables
    )
    rows, free = rows + fresh, max(free, number + len(fresh))
    made["stream_steps"][robot] = int(sum(data["opr"].size for *_, data in parts.values()))
    name, weights = pathlib.Path(trained.path).name, parts_of.digest(trained.train.params)
    made["agents"][robot] = {"name": name, "agent": agents.called(trained), "crc32": weights}
  set_tables.write_meta(staged, rows + set_tables.healthy_probes(rows))
  config = _config(suite, command, made, old, kept)
  tables.write_json(staged / "config.json", config)
  _publish(staged, out)
  size = sum(p.stat().st_size for p in out.glob("*.parquet"))
  return {"stream_steps_per_s": speed, "stream_steps": config["stream_steps"], "bytes": size}


def _config(
  suite: Suite, command: str, made: dict[str, dict], old: dict | None, kept: list[str]
) -> dict:
  """config.json of a set: `made` tells of each robot that was recorded, `old` of those kept."""
  stays: dict[str, dict] = {}
  if old:
    stays = {"kept": {r: old.get("kept", {}).get(r, {k: old[k] for k in MADE}) for r in kept}}
    made = {k: {r: old[k][r] for r in kept if r in old.get(k, ())} | made[k] for k in made}
  robots = [r for r in suite.robots if r in {*made["details"], *kept}]
  return {
    "version": VERSION,
    "suite": _plain(suite, robots),
    "command": command,
    "schema": SCHEMA,
    "meta": META,
    **made,
    **runtime.provenance(),
    **stays,
  }


def _old(
  suite: Suite, out: pathlib.Path, robots: Collection[str]
) -> tuple[dict | None, list[dict]]:
  """config.json of the set that stays beside these robots, None where none does, and its rows of
  META but those of probes of healthy streams, which are numbered anew, behind all others.
  """
  old = _beside(suite, out, robots) if robots else None
  if old is None:
    return None, []
  table = tables.read_rows(out / "streams.parquet")
  kind_of = {row["stream"]: row["kind"] for row in table}
  return old, [row for row in table if kind_of.get(row["prefix"]) != "nominal"]


def _parts(
  suite: Suite,
  robot: str,
  env: Any,
  trained: agents.Trained,
  work: pathlib.Path,
  physics: str,
  progress: Callable[[str, int, int, int], Any],
) -> tuple[dict[tuple[str, str], set_tables.Part], float | None]:
  """Parts of a robot by split and kind, lived or kept from before, and the stream-steps per second
  of those that were lived.
  """
  parts, seconds, lived = {}, 0.0, 0
  for split, kind in parts_of.PARTS:
    own = parts_of.part(suite, robot, split, kind, env, trained, physics)
    path = work / f"{robot}-{split}-{kind}.npz"
    data = parts_of.kept(path, own)
    if data is None:
      begin = time.monotonic()
      told = functools.partial(progress, f"{robot} {split} {kind}")
      data = parts_of.live(own, path, env, trained, told)
      seconds, lived = seconds + time.monotonic() - begin, lived + own.steps * len(own.who)
    parts[split, kind] = own.who, own.onsets, data
  return parts, lived / seconds if seconds else None
