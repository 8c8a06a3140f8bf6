"""`mjx-cl leaderboard --methods`: methods of adaptation against each other."""

from __future__ import annotations

import dataclasses
import pathlib

from mjx_cl.cli import runs
from mjx_cl.cli.flags import Bench, Leaderboard
from mjx_cl.cli.output import command_line, emit, say
from mjx_cl.cli.tables import console, table
from mjx_cl.errors import choose, require
from mjx_cl.io import folders, runtime, tables
from mjx_cl.leaderboard import methods
from mjx_cl.runs import cluster
from mjx_cl.scoring import adaptation

TAKES = {"streams", "out", "overwrite", "robot", "methods", "arm", "seeds", "beside", "name"}
TAKES |= {"json", "on", "address"}


def do_methods(args: Leaderboard) -> None:
  """Scores methods of adaptation on their lives, after living those that are asked for."""
  for field in dataclasses.fields(args):
    given = getattr(args, field.name) != field.default
    flag = "--" + field.name.replace("_", "-")
    require(field.name in TAKES or not given, f"{flag} is of detectors; leave out --methods")
  require(not (args.streams and args.arm), "give a folder of lives, or --arm to live them in --out")
  require(args.seeds is None or args.arm, "--seeds is of lives to come; give --arm")
  out = pathlib.Path(args.out)
  require(out.is_dir() or not out.exists(), f"--out {args.out} is a file")
  require(not (args.beside and args.arm), "--beside is of lives that are there; leave out --arm")
  robots = tuple(args.robot)
  published = methods.together(args.beside, robots) if args.beside else methods.shipped()
  lived = (out / "suite.json").exists()
  require(
    args.overwrite or (args.arm and lived) or not (out / methods.FILES[-1]).exists(),
    f"{args.out} holds a board; give --overwrite to replace it, or another --out",
  )
  folders.probe(args.out)
  methods.free(args.name, {life["method"] for life in published})
  if args.arm:
    live(args)
  folder = args.out if args.arm else args.streams
  own = methods.of_folder(folder, robots) if folder else []
  require(published or own, "no lives ship; give a folder of `mjx-cl bench methods`")
  lives = methods.chosen(methods.joined(published, own, args.name), robots)
  methods.whole(lives)
  lives, single = methods.counted(lives)
  if single:
    say(f"note: {single} lives do not count, since arm `none` was not lived with their seeds")
  board = adaptation.board(lives)
  with folders.together():
    meta = {"command": command_line("leaderboard"), "lives": len(lives), **runtime.provenance()}
    files = methods.write(board, lives, args.out, meta)
  if args.json:
    emit({"overall": board.overall, "rows": board.rows})
    return
  show(board, lives)
  print(f"{len(lives):,} lives; files: {', '.join(files)}")


def live(args: Leaderboard) -> None:
  """Lives the suite with the arms of --arm, and `none`, in --out; goes on where it was cut off."""
  arms = dict.fromkeys((*args.arm, adaptation.NOTHING))
  plan, parts = runs.asked(Bench(methods.SUITE, out=args.out, arm=tuple(arms), seeds=args.seeds))
  there = pathlib.Path(args.out, "suite.json")
  held = tables.read_json(there).get("suite") if there.exists() else plan.name
  require(held == plan.name, f"{args.out} holds suite {held!r}; give another --out")
  for robot in args.robot:
    choose("robot", robot, {part.config.env: True for part in plan.parts})
  parts = [part for part in parts if not args.robot or part.config.env in args.robot]
  runs.live(plan, parts, folders.usable(args.out), on=cluster.of(args.on, args.address))


def show(board: adaptation.Board, lives: list[dict]) -> None:
  """Prints the board, and a line for each setting."""
  number = lambda x, form=".0f": "-" if x is None else format(x, form)
  between = lambda ci: "" if ci is None else f" [{number(ci[0])}, {number(ci[1])}]"
  share = lambda x: "-" if x is None else f"{x:.0%}"
  robots = list(dict.fromkeys(life["robot"] for life in lives))
  heads = (
    "method",
    "lives",
    "score",
    "gain",
    *robots,
    "harm",
    "by agent",
    "worse",
    "recovered",
    "falls",
    "updates",
  )
  cells = [
    (
      r["method"],
      number(r["streams"]),
      number(r["score"]) + between(r["score_ci"]),
      number(r["gain"]) + between(r["gain_ci"]),
      *(number(r.get(f"score_{robot}")) for robot in robots),
      f"{r['harm']} of {r['settings']}",
      f"{r['harm_agents']} of {r['pairs']}",
      share(r["harm_streams"]),
      f"{r['recovered']} of {r['affected']}",
      number(r["falls"], "+.1f"),
      number(r["updates"]),
    )
    for r in board.overall
  ]
  agents = max(r["agents"] for r in board.rows)
  title = (
    "score: 0 does nothing, 100 has the reward of before the fault; "
    f"{len({life['seed'] for life in lives})} seeds, {agents} agent{'s' * (agents > 1)} a robot"
  )
  console().print(table(heads, cells, left=("method",), title=title))
  heads = ("robot", "setting", "lost", *(r["method"] for r in board.overall))
  cells = []
  for robot, setting in dict.fromkeys((r["robot"], r["setting"]) for r in board.rows):
    own = {r["method"]: r for r in board.rows if (r["robot"], r["setting"]) == (robot, setting)}
    most = own[adaptation.NOTHING]["streams"]
    few = lambda r: f" ({r['streams']})" if r["streams"] < most else ""
    score = lambda name: number(own[name]["score"]) + few(own[name]) if name in own else "-"
    lost = share(own[adaptation.NOTHING]["lost"])
    cells.append((robot, setting, lost, *(score(r["method"]) for r in board.overall)))
  console().print(
    table(heads, cells, left=("robot", "setting"), title="score by setting (lives, where fewer)")
  )
  say(
    "gain: score less that of the paper's method (`detector`); harm: settings in which it loses "
    "more than doing nothing; by agent: pairs of a setting and an agent that do; worse: streams "
    "that do by a tenth; falls, updates: a stream, falls beyond `none`; [95 % interval]"
  )
