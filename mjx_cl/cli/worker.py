"""Parts of a command in a process of its own, see runs/workers.py: `python -m mjx_cl.cli.worker OUT
CORES`, names of parts on standard input. OUT/suite.json says of which command, and what a part is.
"""

import functools
import os
import pathlib
import queue
import shutil
import signal
import sys
import threading
from collections.abc import Callable
from typing import Any

from mjx_cl.cli import app
from mjx_cl.io import interrupt, runtime, tables

Do = Callable[[str, dict], None]  # name and values of a part


class Parts:
  """Names of parts as they come in; once the parent closes standard input this process ends, its
  state saved.
  """

  def __init__(self) -> None:
    self.given, self.done = 0, 0
    self.names: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=self._listen, daemon=True).start()

  def _listen(self) -> None:
    rest = b""
    # not sys.stdin, whose lock would still be held as the interpreter ends
    while more := os.read(0, 4096):
      *lines, rest = (rest + more).split(b"\n")
      for line in lines:
        self.given += 1
        self.names.put(line.decode())
    if self.given == self.done:
      self.names.put("")
      return
    # where the parent died, nobody reads what is said, and saying it would be an error before the
    # state is saved
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    os.kill(os.getpid(), signal.SIGTERM)
    self.names.put("")  # the part that it has may be at its end


def runs(folder: pathlib.Path) -> Do:
  """Runs of a suite; they share their programs, and what healthy robots live."""
  from mjx_cl.cli.live import RunDisplay
  from mjx_cl.runs import run, suite
  from mjx_cl.runs.healthy import Healthy

  programs, healthy = run.Programs(), Healthy()

  def do(name: str, values: dict) -> None:
    with RunDisplay() as shown:
      run.execute(
        suite.config(name, values),
        folder / name,
        resume=(folder / name).exists(),
        progress=shown,
        programs=programs,
        healthy=healthy,
      )

  return do


def streams(folder: pathlib.Path) -> Do:
  """Parts of a recording."""
  from mjx_cl.cli.board import steps_lived
  from mjx_cl.leaderboard import spread

  tell = functools.partial(steps_lived(), "lived")
  return lambda name, values: spread.live(folder, name, values, tell)


def detectors(folder: pathlib.Path) -> Do:
  """Detectors of a board."""
  from mjx_cl.cli.output import say
  from mjx_cl.leaderboard import spread

  return lambda name, values: spread.examine(folder, name, values, say)


def trainings(folder: pathlib.Path) -> Do:
  """Trainings of one seed each."""
  from mjx_cl import envs
  from mjx_cl.cli import agents
  from mjx_cl.cli.flags import Train

  def do(name: str, values: dict) -> None:
    flags: dict[str, Any] = values["flags"]
    own: dict[str, Any] = flags | {"set": tuple(flags["set"])}
    args = Train(**own, seed=values["seed"], out=str(folder / name), resume=True)
    env = envs.make(args.env, args.physics)
    agents.trained(args, env, *agents.chosen(args), values["command"])
    # of use to nobody once the agent is there, and as large as its replay
    shutil.rmtree(folder / name / "checkpoints", ignore_errors=True)

  return do


# command -> what does its parts; JAX starts there
COMMANDS = {"bench": runs, "record": streams, "leaderboard": detectors, "train": trainings}


def main(arguments: list[str]) -> int:
  """Runs parts of OUT/suite.json on the cores (numbers, separated by commas).

  Returns:
    Exit status 0, 1 (files), 2 (settings) or 130 (stopped, saved).
  """
  out, own = arguments
  if own and hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {int(core) for core in own.split(",")})  # before JAX counts its threads
  parts, folder = Parts(), pathlib.Path(out)

  def do() -> None:
    runtime.setup()
    work = COMMANDS[tables.read_json(folder / "suite.json").get("command", "bench")](folder)
    while name := parts.names.get():
      interrupt.heed()
      work(name, tables.read_json(folder / "suite.json")["parts"][name])
      parts.done += 1
      print(f"finished {name}", flush=True)

  return app.attempt(do)


if __name__ == "__main__":
  sys.exit(main(sys.argv[1:]))
