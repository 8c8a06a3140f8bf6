"""The board of methods of adaptation: lives of a suite of runs, those that ship and one's own."""

from __future__ import annotations

import dataclasses
import json
import pathlib
from collections.abc import Sequence
from typing import Any

from mjx_cl import BENCHMARK
from mjx_cl.config import AdaptConfig, RunConfig, own_agent
from mjx_cl.errors import FileError, UserError, choose, require
from mjx_cl.io import folders, tables
from mjx_cl.leaderboard import methods_page
from mjx_cl.leaderboard.score import flat
from mjx_cl.runs import suite
from mjx_cl.scoring import adaptation

LIVES = pathlib.Path(__file__).parent / "recordings" / "methods.parquet"
SUITE = "methods"
# of a run's settings what may differ where lives of two folders are put side by side
FREE = {
  "seeds",
  "first_seed",
  "arms",
  "agent",
  "physics",
  "residuals",
  "parts",
  "keep",
  "snapshots",
}
# of a row of runs.parquet
KEPT = (
  "seed",
  "affected",
  "recovery_step",
  "reward_pre",
  "reward_final",
  "return_lost",
  "return_lost_healthy",
  "latency_steps",
  "false_alarms",
  "outcome",
  "terminations",
  "updates",
  "wall_s",
)
TYPES: dict[str, Any] = {"recovery_step": float, "latency_steps": float, "wall_s": float}
FILES = (
  "methods.parquet",
  "methods_overall.parquet",
  "methods_lives.parquet",
  "methods.html",
  "methods.json",
)


def shipped() -> list[dict]:
  """The published lives, see `of_folder`; none where there is no file."""
  return tables.read_rows(LIVES) if LIVES.exists() else []


def of_folder(folder: pathlib.Path | str, robots: tuple[str, ...] = ()) -> list[dict]:
  """Lives of the finished parts of a suite's results: `adaptation.board` says of which keys; of
  each stream the first change.

  Args:
    folder: OUT of `mjx-cl bench`, or a published one.
    robots: those alone; (): all.

  Raises:
    UserError: no results of a suite, no finished part, two parts of one setting and agent.
    FileError: a broken file.
  """
  folder = pathlib.Path(folder)
  require(
    (folder / "suite.json").is_file(),
    f"{folder} holds no results of a suite; give the --out of `mjx-cl bench {SUITE}`",
  )
  parts = tables.read_json(folder / "suite.json").get("parts")
  if not isinstance(parts, dict):
    raise FileError(f"{folder / 'suite.json'}: not a suite's")
  out: list[dict] = []
  for name in parts:
    if not suite.complete(folder / name):
      continue
    config = tables.read_json(folder / name / "config.json")
    try:
      if robots and config["env"] not in robots:
        continue
      version = config.get("benchmark", 1)  # which the first runs did not write
      require(
        version == BENCHMARK,
        f"{folder / name} is of version {version} of the benchmark, this release of {BENCHMARK}; "
        "run it anew",
      )
      setting = suite.apart(name)[0] or config["env"]
      out += _part(setting, config, tables.read_rows(folder / name / "runs.parquet"))
    except (KeyError, TypeError, AttributeError):
      raise FileError(f"{folder / name}: not a run's files") from None
  require(out, f"{folder} holds no finished part{' of these robots' if robots else ''}")
  return out


def settings(config: dict) -> str:
  """What of a run's settings must be alike, as JSON. A setting of adaptation that the run is older
  than has its default.
  """
  names = [f.name for f in dataclasses.fields(RunConfig) if f.name not in FREE]
  adapt = dataclasses.asdict(AdaptConfig()) | (config.get("adapt") or {})
  return json.dumps({k: config.get(k) for k in names} | {"adapt": adapt}, sort_keys=True)


def _part(setting: str, config: dict, rows: list[dict]) -> list[dict]:
  """Lives of one run."""
  whole = {
    "robot": config["env"],
    "setting": setting,
    "agent": config["agent"] or own_agent(config["env"]),
    "control_s": config["control_s"],
    **{k: config[k] for k in ("fault", "severity", "target")},
    "settings": settings(config),
  }
  ends: dict[int, int] = {}  # of the first change
  for r in rows:
    if r["change"] == 1:
      ends[r["stream"]] = r["onset"]
  return [
    whole
    | {"method": r["arm"], "onset": r["onset"]}
    | {"steps": ends.get(r["stream"], config["steps"]) - r["onset"]}
    | {k: TYPES[k](r[k]) if k in TYPES and r[k] is not None else r[k] for k in KEPT}
    for r in rows
    if r["change"] == 0 and r["onset"] is not None
  ]


def joined(
  published: list[dict], own: list[dict], name: str | None = None, apart: bool = True
) -> list[dict]:
  """Lives of one's own, marked by `own`, beside the published ones of the same settings.

  A method that is a file's function goes by the function's name, unless the board has one of that
  name; `name` is that of the only method of one's own. A life that is published already, by method,
  setting, agent and seed, stays as published; of arm `none` one's own stays too, which one's own
  lives are measured against (`adaptation.paired`). Of an agent that no published life of the
  setting has the severity may be another: what costs one agent half may cost another nothing. Lives
  of another suite stand by themselves. Without `apart` all count as published, of whatever suite.

  Raises:
    UserError: a setting of the same name differs; `name` where there are more methods, or it is
      taken.
  """
  known = {life["method"] for life in published}
  new = list(dict.fromkeys(life["method"] for life in own if life["method"] not in known))
  new = [method for method in new if method != adaptation.NOTHING]
  require(
    name is None or len(new) == 1,
    f"--name names one method of one's own; there are {len(new)}: {', '.join(new) or 'none'}",
  )
  free(name, known)
  called: dict[str, str] = {}
  for method in new:
    short = name or method.rsplit(":", 1)[-1]
    called[method] = method if short in known or short in called.values() else short
  setting = lambda life: (life["robot"], life["setting"])
  there = {setting(life): life for life in published}
  alike = {(*setting(life), life["agent"]): life for life in published}
  for life in own:
    of = (*setting(life), life["agent"])
    other = alike.get(of, there.get(setting(life)))
    if other is None:
      continue
    two = [json.loads(settings(json.loads(x["settings"]))) for x in (life, other)]
    if of not in alike:
      two[0]["severity"] = two[1]["severity"]
    if two[0] != two[1]:
      raise UserError(
        f"setting {life['setting']} was run with another {', '.join(folders.differing(*two))} than "
        f"the published one: it takes suite {SUITE!r} as it ships"
      )
  mine = [life | {"method": called.get(life["method"], life["method"])} for life in own]
  if apart and mine and there and not there.keys() & {setting(life) for life in mine}:
    published = []
  mine = [life | {"own": apart} for life in mine]
  unit = lambda life: tuple(life[k] for k in adaptation.KEYS)
  held = {unit(life) for life in published}
  kept = (x for x in mine if unit(x) not in held or apart and x["method"] == adaptation.NOTHING)
  return [*(life | {"own": False} for life in published), *kept]


def together(folders: Sequence[pathlib.Path | str], robots: tuple[str, ...] = ()) -> list[dict]:
  """Lives of several folders, see `of_folder`; of those that two folders hold the first's.

  Raises:
    UserError: as `of_folder`; a setting that differs between two.
  """
  out: list[dict] = []
  for folder in folders:
    out = joined(out, of_folder(folder, robots), apart=False)
  return out


def free(name: str | None, known: set[str]) -> None:
  """Raises UserError where the board has a method of that name."""
  require(name not in known, f"the board has a method {name!r} already; give another --name")


def chosen(lives: list[dict], robots: tuple[str, ...]) -> list[dict]:
  """The lives of these robots, all where there are none.

  Raises:
    UserError: an unknown one.
  """
  known = {life["robot"]: True for life in lives}
  for robot in robots:
    choose("robot", robot, known)
  return [life for life in lives if not robots or life["robot"] in robots]


def write(
  board: adaptation.Board, lives: list[dict], out: pathlib.Path | str, meta: dict
) -> list[str]:
  """FILES in the folder `out`: a row for each method x setting (x_ci as x_low, x_high), for each
  method, for each life; the page; and what they rest on.
  """
  out = pathlib.Path(out)
  out.mkdir(parents=True, exist_ok=True)
  paths = [out / name for name in FILES]
  write_lives(lives, paths[2])
  for path, rows in zip(paths, (board.rows, board.overall)):
    plain = [flat(r) for r in rows]
    keys = dict.fromkeys(k for r in plain for k in r)
    tables.write_table(path, {k: [r.get(k) for r in plain] for k in keys})
  meta = meta | {"critical_difference": board.critical_difference, "friedman_p": board.friedman_p}
  methods_page.write(paths[3], board, lives, meta)
  tables.write_json(paths[4], meta)
  return [str(path) for path in paths]


def write_lives(lives: list[dict], path: pathlib.Path | str) -> None:
  """Lives as Parquet, in one order whatever the order of parts."""
  words = adaptation.KEYS[:-1]
  lives = sorted(lives, key=lambda life: (*(str(life[k]) for k in words), life["seed"]))
  tables.write_table(path, {k: [life[k] for life in lives] for k in lives[0]})


def counted(lives: list[dict]) -> tuple[list[dict], int]:
  """The lives of which arm `none` has the agent and seed, and how many others there are."""
  unit = lambda x: (x["robot"], x["setting"], x["agent"], x["seed"])
  none = {unit(x) for x in lives if x["method"] == adaptation.NOTHING}
  kept = [x for x in lives if unit(x) in none]
  return kept, len(lives) - len(kept)


def whole(lives: list[dict]) -> None:
  """Raises UserError where a setting has no arm `none`."""
  for robot, setting in dict.fromkeys((life["robot"], life["setting"]) for life in lives):
    arms = {x["method"] for x in lives if (x["robot"], x["setting"]) == (robot, setting)}
    if adaptation.NOTHING not in arms:
      raise UserError(
        f"setting {setting} of {robot} was not run with arm {adaptation.NOTHING!r}, which scores "
        f"0: give --arm {adaptation.NOTHING} too"
      )
