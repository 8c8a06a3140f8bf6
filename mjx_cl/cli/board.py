"""The commands record and leaderboard: recorded streams, and detectors that are scored on them."""

import math
import os
import pathlib
import time
from collections.abc import Callable
from typing import Any

from mjx_cl.cli.flags import Leaderboard, Record
from mjx_cl.cli.machines import WORKER
from mjx_cl.cli.methods import do_methods
from mjx_cl.cli.output import clock, command_line, emit, say
from mjx_cl.cli.tables import console, table
from mjx_cl.config import settings
from mjx_cl.detectors import python_class
from mjx_cl.errors import choose, require
from mjx_cl.io import folders, runtime
from mjx_cl.leaderboard import record, score, spread, streams, submissions
from mjx_cl.runs import cluster


class Paced:
  """Says a line now and then.

  Args:
    every_s: seconds between two lines.
  """

  def __init__(self, every_s: float) -> None:
    self.every_s, self.told = every_s, 0.0

  def __call__(self, text: str, last: bool) -> None:
    """Says `text` where it is time, or the last line."""
    if last or time.monotonic() - self.told > self.every_s:
      self.told = time.monotonic()
      say(text)


def steps_lived() -> Callable[[str, int, int, int], None]:
  """Says now and then how far a part of a recording is."""
  tell = Paced(10)

  def progress(part: str, done: int, steps: int, lanes: int) -> None:
    tell(f"{part}: {done:,}/{steps:,} steps of {lanes} robots", done >= steps)

  return progress


def do_record(args: Record) -> None:
  """Records a suite of streams."""
  on = cluster.of(args.on, args.address)
  suite, out = streams.suite(args.suite), args.out
  if args.overwrite:  # what is refused must not cost the set that is there
    record.prepare(suite, args.robot, args.physics, args.agent)
  record.claim(suite, out, args.overwrite, args.robot)
  folders.probe(out)

  chosen = (args.robot, args.physics, args.agent)
  if on:
    ready = record.prepare(suite, *chosen)
    spread.record(suite, out, ready, args.physics, args.agent, WORKER, on, say)
  result = record.record(suite, out, *chosen, command_line("record"), steps_lived())
  record.clear(out)
  if args.json:
    emit(result)
    return
  for robot, steps in result["stream_steps"].items():
    speed = result["stream_steps_per_s"].get(robot)
    how = f", {speed:,.0f} a second" if speed else ", recorded before"
    print(f"{robot}: {steps:,} stream-steps{how}")
  print(f"{result['bytes'] / 1e6:.1f} MB in {out}")


def do_leaderboard(args: Leaderboard) -> None:
  """Scores detectors on recorded streams, or exports the streams; with --methods see there."""
  if args.methods:
    do_methods(args)
    return
  for flag, given in (
    ("--arm", args.arm),
    ("--seeds", args.seeds),
    ("--beside", args.beside),
  ):
    require(not given, f"{flag} belongs to methods of adaptation; give --methods")
  on = cluster.of(args.on, args.address)
  check_own(args)
  held = streams.StreamSet(args.streams)
  robots = held.choose(args.robot)
  if args.export:
    folders.probe(args.export)
    files = submissions.export(held, args.export, robots, args.overwrite)
    emit(files) if args.json else print("\n".join(files))
    return
  out = pathlib.Path(args.out)
  require(out.is_dir() or not out.exists(), f"--out {args.out} is a file")
  require(
    args.overwrite or not (out / "leaderboard.json").exists(),
    f"{args.out} holds a leaderboard; give --overwrite to replace it, or another --out",
  )
  entries, left = score.able(
    score.chosen(args.detector, robots[0]), held, robots, args.detector or ()
  )
  extra = own(args, held, robots)
  taken = {*score.variants(), *(one.name for one in entries), *score.ORACLES}
  for name, _ in extra:
    require(name not in taken, f"the board has a detector {name!r} already; give --name")
    taken.add(name)
  tell = Paced(2)

  def progress(robot: str, name: str, done: int, total: int, seconds: float) -> None:
    left = clock(seconds / done * (total - done))
    tell(f"{done}/{total}  {robot}: {name}, {clock(seconds)} gone, {left} left", done == total)

  folders.probe(args.out)  # before minutes are spent
  for why in left:
    say(why)
  begin = time.perf_counter()
  found = None
  if on and entries:
    found = spread.examine_all(held, entries, robots, out, WORKER, on, say)
  board = score.score(held, entries, robots, extra, progress, found)
  board = board._replace(seconds=time.perf_counter() - begin)
  if on:
    spread.clear(out)
  with folders.together():
    files = score.write(board, args.out, about(held, board))
  if args.json:
    emit([{k: v for k, v in r.items() if not k.startswith("stream_")} for r in board.rows])
    return
  show(board, held)
  print(
    f"{board.stream_steps:,} stream-steps scored in {clock(board.seconds)}; files: "
    f"{', '.join(files)}"
  )


def check_own(args: Leaderboard) -> None:
  """Raises UserError for settings of a detector of one's own without one."""
  for flag, given, other in (
    ("--set", args.set, args.add),
    ("--threshold", args.threshold, args.add),
    ("--log", args.log, args.add),
    ("--channel", args.channel != Leaderboard.channel, args.add),
    ("--name", args.name, args.add or args.submit),
  ):
    more = " or --submit" if flag == "--name" else ""
    require(other or not given, f"{flag} belongs to a detector of one's own; give --add{more}")
  choose("channel", args.channel, dict.fromkeys(streams.COLUMNS))
  require(
    not (args.name and args.add and args.submit),
    "--name names one detector; give --add and --submit in two commands, or leave it out",
  )


def own(args: Leaderboard, held: streams.StreamSet, robots: list[str]) -> list[tuple[str, Any]]:
  """Detectors of --add and --submit, each with its name on the board."""
  found = []
  if args.add:
    build = lambda value: python_class.load(
      args.add,
      settings(args.set) | ({args.threshold: value} if args.threshold else {}),
      args.name,
      args.channel,
      args.log,
    )
    one = build(1.0)
    host = submissions.from_host(build if args.threshold else one, args.threshold)
    found.append((one.host_name, host))
  if args.submit:
    scores = submissions.read_submission(args.submit, held, robots)
    name = args.name or os.path.basename(args.submit).removesuffix(".parquet")
    found.append((name, submissions.from_scores(scores)))
  return found


def about(held: streams.StreamSet, board: score.Board) -> dict:
  """What leaderboard.json says besides the numbers."""
  out = {
    "command": command_line("leaderboard"),
    "seeds": {k: list(v) for k, v in held.suite.seeds.items()},
    "arl0_target": held.suite.arl0,
    "streams": held.config.get("command"),
    "agents": {robot: held.agent(robot) for robot in sorted({r["robot"] for r in board.rows})},
  }
  if "kept" in held.config:
    out["kept"] = {robot: own.get("command") for robot, own in held.config["kept"].items()}
  return out | {
    "wall_s": round(board.seconds, 1),
    "stream_steps": board.stream_steps,
    **runtime.provenance(),
  }


def show(board: score.Board, held: streams.StreamSet) -> None:
  """Prints the board."""
  number = lambda x, form: "-" if x is None or not math.isfinite(x) else format(x, form)
  rows = []
  for r in board.overall.rows:
    ci = r["cost_standard_ci"]
    rows.append(
      (
        r["detector"],
        number(r["cost_standard"], ".1f"),
        f"{number(ci[0], '.1f')} to {number(ci[1], '.1f')}" if ci else "-",
        number(r["cost_costly"], ".1f"),
        number(r["detected_within_1s"], ".0%"),
        number(r["detected_within_5s"], ".0%"),
        number(r["miss_probability"], ".0%"),
        number(r["false_alarms_per_hour"], ".1f"),
        number(r["mean_rank"], ".1f"),
      )
    )
  named = ("detector", "score", "95 %", "costly faults", "within 1 s", "within 5 s", "missed")
  title = (
    f"{len(board.rows):,} rows, ARL0 {held.suite.arl0:,.0f} steps, means over robots, faults and "
    "severities"
  )
  console().print(
    table((*named, "false alarms/h", "mean rank"), rows, left=("detector",), title=title)
  )
