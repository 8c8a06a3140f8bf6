"""Recording of a suite: healthy and faulty robots of all seeds in one batched program per robot and
split, written as streams.py describes.
"""

import functools
import itertools
import json
import pathlib
import time
import zlib
from collections.abc import Callable, Collection
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import envs
from mjx_cl import faults as faults_lib
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import arrays, runtime, tables
from mjx_cl.leaderboard import lives, set_tables
from mjx_cl.leaderboard.set_folder import HELD, MADE, beside, plain, publish
from mjx_cl.leaderboard.set_folder import claim as claim
from mjx_cl.leaderboard.set_folder import clear as clear
from mjx_cl.leaderboard.streams import META, SCHEMA, VERSION
from mjx_cl.leaderboard.suite import Suite
from mjx_cl.rollout.frozen import stream_keys
from mjx_cl.rollout.monitor import watched
from mjx_cl.training import agents


def prepare(
  suite: Suite, robots: Collection[str], physics: str, agent: str | None
) -> dict[str, tuple[Any, agents.Trained]]:
  """Robot -> (env, agent) of a recording; all robots of the suite where none is named.

  Raises:
    UserError, before hours are spent: an unknown robot, fault, target or agent, or an agent that
      does not act in every control step.
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
    if int(trained.card.get("repeat", 1)) != 1:
      raise UserError(
        f"the agent of {robot!r} holds its actions; streams are recorded with agents that act "
        "in every control step"
      )
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

  Returns:
    {robot: stream-steps per second of its parts}, plus the size of the files.
  """
  out = pathlib.Path(out)
  staged = out / "work" / "set"
  staged.mkdir(parents=True, exist_ok=True)
  for p in staged.iterdir():
    if p.name != HELD:
      p.unlink()
  ready = prepare(suite, robots, physics, agent)
  old = beside(suite, out, robots) if robots else None
  table = tables.read_rows(out / "streams.parquet") if old else []
  kind_of = {row["stream"]: row["kind"] for row in table}
  # probes of healthy streams are numbered anew, behind all others
  table = [row for row in table if kind_of.get(row["prefix"]) != "nominal"]
  kept = [r for r in old["suite"]["robots"] if r not in robots] if old else []
  rows = [row for row in table if row["robot"] in kept]
  free, speed = 1 + max((row["stream"] for row in table), default=-1), {}
  made: dict[str, dict] = {"agents": {}, "details": {}, "stream_steps": {}}
  for robot, (env, trained) in ready.items():
    parts, speed[robot] = _parts(suite, robot, env, trained, out / "work", physics, progress)
    groups = ",".join(name for name, _ in watched(env.spec))
    number = min((row["stream"] for row in table if row["robot"] == robot), default=free)
    made["details"][robot], fresh = set_tables.write(
      suite, staged, robot, parts, number, env.spec.control_s, groups
    )
    rows, free = rows + fresh, max(free, number + len(fresh))
    made["stream_steps"][robot] = int(sum(data["opr"].size for *_, data in parts.values()))
    name, weights = pathlib.Path(trained.path).name, _digest(trained.train.params)
    made["agents"][robot] = {"name": name, "crc32": weights}
  set_tables.write_meta(staged, rows + set_tables.healthy_probes(rows))
  stays: dict[str, dict] = {}
  if old:
    stays = {"kept": {r: old.get("kept", {}).get(r, {k: old[k] for k in MADE}) for r in kept}}
    made = {k: {r: old[k][r] for r in kept if r in old.get(k, ())} | made[k] for k in made}
  config = {
    "version": VERSION,
    "suite": plain(suite, [r for r in suite.robots if r in {*ready, *kept}]),
    "command": command,
    "schema": SCHEMA,
    "meta": META,
  }
  tables.write_json(staged / "config.json", config | made | runtime.provenance() | stays)
  publish(staged, out)
  size = sum(p.stat().st_size for p in out.glob("*.parquet"))
  return {"stream_steps_per_s": speed, "stream_steps": made["stream_steps"], "bytes": size}


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
  simulator = runtime.default_physics() if physics == "auto" else physics
  parts, seconds, lived = {}, 0.0, 0
  for split, kind in itertools.product(("score", "tune"), ("nominal", "fault")):
    who, keys, onsets, steps, watch_from = _who(suite, robot, split, kind, env.spec.control_s)
    path = work / f"{robot}-{split}-{kind}.npz"
    lanes = [list(lane) for lane in who]
    tag = json.dumps([lanes, steps, trained.card.get("updates"), VERSION])
    of = json.dumps([onsets.tolist(), _digest(trained.train.params), simulator])
    data = _part(path, tag, of)
    if data is None:
      begin = time.monotonic()
      told = functools.partial(progress, f"{robot} {split} {kind}")
      data = lives.live(env, trained, who, keys, onsets, steps, watch_from, told)
      seconds, lived = seconds + time.monotonic() - begin, lived + steps * len(who)
      arrays.write(path, {"tag": tag, "of": of, **data})
    parts[split, kind] = who, onsets, data
  return parts, lived / seconds if seconds else None


def _who(
  suite: Suite, robot: str, split: str, kind: str, control_s: float
) -> tuple[list[lives.Lane], jax.Array, np.ndarray, int, int]:
  """Lanes of a part, their keys and onsets, its control steps, and that from which the monitor
  looks at faulty ones.
  """
  seeds = suite.numbers(split)
  if kind == "fault":
    who = lives.lanes(suite, robot, split)
    keys = jnp.stack([jax.random.key(lane.seed) for lane in who])
    onsets = np.asarray([suite.onset_of(lane.seed) for lane in who])
    return who, keys, onsets, int(onsets.max()) + suite.after(control_s), int(onsets.min())
  each = suite.nominal[split]
  who = [lives.Lane(s) for s in seeds for _ in range(each)]
  # the first key of a seed belongs to the faults
  own = np.flatnonzero(np.arange(len(seeds) * (each + 1)) % (each + 1))
  keys = stream_keys(seeds, each + 1)[own]
  return who, keys, np.zeros(len(who), int), suite.nominal["steps"], 0


def _digest(params: Any) -> int:
  """CRC-32 of an agent's weights, which tells agents apart; config.json of a set holds it for each
  robot's.
  """
  return zlib.crc32(b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(params)))


def _part(path: pathlib.Path, tag: str, of: str) -> dict | None:
  """What an earlier recording left, None where it is of something else or broken.

  Args:
    path: of the file.
    tag: lanes and length that are wanted.
    of: onsets, agent and physics that are wanted; a file may not tell its own.
  """
  try:
    part = arrays.read(path)
  except FileError:
    return None
  same = str(part.pop("tag", None)) == tag and str(part.pop("of", of)) == of
  return part if same else None
