"""The folder that a suite is recorded into: what it may hold, and how a set gets there whole."""

import dataclasses
import json
import os
import pathlib
import shutil
from collections.abc import Collection, Iterable

from mjx_cl.errors import FileError, UserError
from mjx_cl.io import folders, tables
from mjx_cl.leaderboard.streams import VERSION
from mjx_cl.leaderboard.suite import Suite

MADE = ("command", "versions", "python", "git_commit", "machine")  # of config.json: how it was made
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
    beside(suite, out, robots)
    return
  ours = {"config.json", "streams.parquet"} | {
    f"{r}{end}.parquet" for r in {*suite.robots, *(held or ())} for end in ("", "_latents")
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
    config = json.loads((out / "config.json").read_text())
    robots = set(config["suite"]["robots"])
  except (OSError, ValueError, KeyError, TypeError):
    raise _foreign(out) from None
  if not {"meta", "schema", "stream_steps"} <= set(config):
    raise _foreign(out)
  return robots


def beside(suite: Suite, out: pathlib.Path, robots: Collection[str]) -> dict | None:
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
  whole = json.loads(json.dumps(plain(suite, suite.robots)))
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


def plain(suite: Suite, robots: Iterable[str]) -> dict:
  """The suite as config.json has it, with these robots alone."""
  return dataclasses.asdict(suite) | {"robots": {r: suite.robots[r] for r in robots}}


def _others(out: pathlib.Path) -> list[pathlib.Path]:
  """What in the folder `work` is no part of a recording."""
  staged = lambda p: (
    p.name == "set"
    and p.is_dir()
    and all(f.suffix in (".parquet", ".json", ".tmp") for f in p.iterdir())
  )
  parts = (out / "work").iterdir() if (out / "work").is_dir() else ()
  return [p for p in parts if not (p.name.removesuffix(".tmp").endswith(".npz") or staged(p))]


def clear(out: pathlib.Path | str) -> None:
  """Removes the parts of a recording."""
  work = pathlib.Path(out) / "work"
  if work.is_dir() and not _others(work.parent):
    shutil.rmtree(work)


def publish(staged: pathlib.Path, out: pathlib.Path) -> None:
  """Moves a set's files into place. config.json, without which a folder holds no set, leaves first
  and comes last: no one reads old beside new.
  """
  if (out / "config.json").exists():
    os.replace(out / "config.json", staged / HELD)
  for p in sorted(staged.glob("*.parquet")):
    os.replace(p, out / p.name)
  os.replace(staged / "config.json", out / "config.json")
