"""Recordings and boards on a cluster: what record.py and score.py compute part by part is computed
there, in a process of its own for each part (cli/worker.py), and found by them as if it had been
computed here.
"""

import dataclasses
import json
import os
import pathlib
import re
import shutil
from collections.abc import Callable
from typing import Any

import numpy as np

from mjx_cl import envs
from mjx_cl.errors import FileError, require
from mjx_cl.io import arrays, folders, memory, tables
from mjx_cl.leaderboard import parts as parts_of
from mjx_cl.leaderboard import program as programs
from mjx_cl.leaderboard import room, score, streams, sweep
from mjx_cl.leaderboard.calibration import Found
from mjx_cl.leaderboard.entries import Entry, able, chosen
from mjx_cl.leaderboard.suite import Suite, of
from mjx_cl.runs import cluster
from mjx_cl.training import agents

LIVED = "lives.npz"  # in the folder of a recording's part
ARRAYS = ("nominal_fired", "nominal_score", "fired", "score")  # of Found
COPIES = 6  # of a robot's streams in a process that examines a detector: as read, as one, on JAX
Tell = Callable[[str], None]


def _plan(folder: pathlib.Path, command: str, parts: dict[str, dict]) -> None:
  folders.make(folder)
  tables.write_json(folder / "suite.json", {"command": command, "parts": parts})


def _whole(folder: pathlib.Path) -> None:
  """Raises FileError for a broken file of a part that came back."""
  for path in folder.iterdir():
    arrays.read(path)


# ---- recordings ----------------------------------------------------------------------------------


def record(
  suite: Suite,
  out: pathlib.Path | str,
  ready: dict[str, tuple[Any, agents.Trained]],
  physics: str,
  agent: str | None,
  worker: str,
  on: cluster.Cluster,
  tell: Tell,
) -> None:
  """Records on a cluster the parts that OUT/work lacks, where `record.record` finds them.

  Args:
    suite: what is recorded.
    out: folder of the recording.
    ready: robots with their agents, of `record.prepare`.
    physics: name of the simulator.
    agent: of the robots; None: those that ship.
    worker: module that a process runs.
    on: the cluster.
    tell: called with each line for the user.

  Raises:
    FileError: a machine has recorded another agent, or as `cluster.together`.
    UserError: as `cluster.together`.
  """
  work = pathlib.Path(out, "work")
  folder, plain = work / "parts", dataclasses.asdict(suite)
  wanted: dict[str, parts_of.Part] = {}
  values: dict[str, dict] = {}
  needs: dict[str, int] = {}
  for robot, (env, trained) in ready.items():
    for split, kind in parts_of.PARTS:
      name = f"{robot}-{split}-{kind}"
      own = parts_of.part(suite, robot, split, kind, env, trained, physics)
      which = {"robot": robot, "split": split, "kind": kind}
      values[name] = {"suite": plain, **which, "physics": physics, "agent": agent}
      if parts_of.kept(work / f"{name}.npz", own) is not None:
        continue
      wanted[name] = own
      rows = own.steps * len(own.who)
      needs[name] = room.grown(len(own.who), rows, env.spec, trained.agent.config, own.signed)
  if not wanted:
    return
  _plan(folder, "record", values)
  over: list[str] = []

  def finished(name: str) -> None:
    path = folder / name / LIVED
    if parts_of.kept(path, wanted[name]) is None:
      raise FileError(f"part {name} was recorded with another agent or simulator; {path} is left")
    os.replace(path, work / f"{name}.npz")
    over.append(name)
    tell(f"{name} recorded, {len(over)} of {len(wanted)}")

  longest_first = sorted(wanted, key=lambda name: -needs[name])
  cluster.together(worker, folder, longest_first, needs, finished, tell, on, _whole)


def live(folder: pathlib.Path, name: str, values: dict, progress: Callable[..., Any]) -> None:
  """Records a part of FOLDER/suite.json into FOLDER/NAME, unless it is there."""
  env = envs.make(values["robot"], values["physics"])
  trained = agents.of(env, values["agent"])
  where = (values["robot"], values["split"], values["kind"])
  own = parts_of.part(of(values["suite"]), *where, env, trained, values["physics"])
  path = folder / name / LIVED
  folders.make(path.parent)
  if parts_of.kept(path, own) is None:
    parts_of.live(own, path, env, trained, progress)


# ---- boards --------------------------------------------------------------------------------------


def examine_all(
  held: streams.StreamSet,
  entries: list[Entry],
  robots: list[str],
  out: pathlib.Path | str,
  worker: str,
  on: cluster.Cluster,
  tell: Tell,
) -> Callable[[str, streams.Data], Found]:
  """Examines detectors on a cluster, a part each; `score.score` takes what this returns.

  Args:
    held: the set; every machine has it in the same folder.
    entries: detectors.
    robots: of the set.
    out: folder of the board; OUT/work is made anew.
    worker: module that a process runs.
    on: the cluster.
    tell: called with each line for the user.

  Raises:
    UserError: as `cluster.together`.
    FileError: likewise.
  """
  folder = pathlib.Path(out, "work")
  clear(out)
  slug = lambda text: re.sub(r"\W+", "_", text)[-60:]
  part = {e.name: f"{i:03d}-{slug(e.name)}" for i, e in enumerate(entries)}
  ships = held.folder == streams.RECORDINGS / "leaderboard"
  own = {
    "streams": None if ships else str(held.folder),
    "config": held.config,
    "robots": robots,
  }
  _plan(folder, "leaderboard", {part[e.name]: own | {"detector": e.name} for e in entries})
  rows = programs.room(held, robots).samples
  over: list[str] = []

  def finished(name: str) -> None:
    over.append(name)
    tell(f"{name} examined, {len(over)} of {len(entries)}")

  names = list(part.values())
  row = room.ROW + 4 * max(len(held.signed(robot)) for robot in robots)
  needs = dict.fromkeys(names, memory.resident(COPIES * row * rows))
  cluster.together(worker, folder, names, needs, finished, tell, on, _whole)
  return lambda name, data: read_found(folder / part[name] / f"{data.robot}.npz")


def clear(out: pathlib.Path | str) -> None:
  """Removes what `examine_all` left in OUT."""
  folder = pathlib.Path(out, "work")
  if (folder / "suite.json").exists():
    shutil.rmtree(folder)


def examine(folder: pathlib.Path, name: str, values: dict, tell: Tell) -> None:
  """Examines a detector of FOLDER/suite.json on all robots, into FOLDER/NAME."""
  held, robots = streams.StreamSet(values["streams"]), values["robots"]
  require(held.config == values["config"], f"{held.folder} holds another set than the driver's")
  named = (values["detector"],)
  (one,), _ = able(chosen(named, robots[0]), held, robots, named)
  fits = programs.room(held, robots)
  runners = {} if one.own else {one.name: sweep.Runner(one.build, fits, one.signed)}
  folders.make(folder / name)
  for robot in robots:
    data = streams.load(held, robot)
    found = score.examine(one, runners, fits, score.samples_of(data, fits), data)
    write_found(folder / name / f"{robot}.npz", found)
    tell(f"{robot} examined")


def write_found(path: pathlib.Path, found: Found) -> None:
  """Keeps what a detector did on one robot."""
  own = found._asdict()
  told = {k: v for k, v in own.items() if k not in ARRAYS}
  text = json.dumps(told, default=lambda x: x.item())
  arrays.write(path, {"told": text, **{k: own[k] for k in ARRAYS}})


def read_found(path: pathlib.Path) -> Found:
  """What `write_found` kept.

  Raises:
    FileError: the file is broken or none of its.
  """
  own: dict[str, Any] = arrays.read(path)
  try:
    return Found(**json.loads(str(np.asarray(own.pop("told")))), **own)
  except (KeyError, TypeError, ValueError) as e:
    raise FileError(f"{path} is no part of a board: {e}") from None
