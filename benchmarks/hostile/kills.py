"""Kills: a command is ended by a signal at a moment drawn from its undisturbed time, goes on as the
manual says, and must end with the results of the undisturbed one, bit for bit.
"""

from __future__ import annotations

import json
import os
import pathlib
import shutil
import signal
import subprocess
import time
from typing import NamedTuple

import numpy as np
import psutil

from benchmarks import reference
from benchmarks.hostile import judge, processes, room

PROGRAM = ("-m", "benchmarks.hostile.saving")
MOST_S = 30.0  # processor time that a command may take to end after a signal
LIMIT_S = 900.0  # of a command that is not disturbed
APART = (
  0.25  # share of the kills of a process of its own; the others are forks that have imported all
)
IMPORT_S = 3.0  # processor time of what a process imports and a fork has
ADAPT = ["--adapt.warmup", "64", "--adapt.start-windows", "32", "--adapt.ratio", "4", "--adapt.patience", "4",
         "--adapt.least", "64", "--adapt.refit", "64"]  # fmt: skip


class Target(NamedTuple):
  """A command that is killed.

  Attributes:
    words: of its command line.
    again: words that let it go on.
  """

  words: list[str]
  again: tuple[str, ...] = ()


TARGETS = {
  "run": Target(["run", "robot.py:Reach", "--agent", "point", "--fault", "noise", "--steps", "1024", "--onset", "192",
                 "--seeds", "1", "--arm", "oracle", "--detector", "page_hinkley", "--set", "threshold=2",
                 "warmup=40", *ADAPT, "--out", "out"], ("--resume",)),
  "train": Target(["train", "robot.py:Reach", "--preset", "tiny", "--set", "updates=256", "ratio=4", "--save-every-s",
                   "0.5", "--out", "out"], ("--resume",)),
  "bench": Target(["bench", "kill.toml", "--jobs", "1", "--out", "out"]),
  "record": Target(["record", *room.STREAMS_OF, "--out", "out"]),
  "leaderboard": Target(["leaderboard", "set", "--detector", "z_score", "--out", "out"], ("--overwrite",)),
}  # fmt: skip
SIGNALS = ("KILL", "TERM", "INT", "KILL KILL", "INT INT", "TERM TERM", "TERM INT")


def program(words: list[str]) -> int:
  """`mjx-cl` that saves often, in a fork."""
  import sys

  from benchmarks.hostile import saving

  sys.argv = ["mjx-cl", *words]
  return saving.main()


def spent(pid: int) -> float:
  """Processor time of a process so far [s]."""
  try:
    return sum(psutil.Process(pid).cpu_times()[:2])
  except psutil.Error:
    return 0.0


def whole(target: str, home: pathlib.Path, folder: pathlib.Path) -> tuple[float, dict]:
  """(processor time of a fork, digests) of an undisturbed run; made once, after one
  that compiles.
  """
  known = home.parent / "undisturbed" / f"{target}.json"
  if not known.exists():
    known.parent.mkdir(exist_ok=True)
    times, digests = [], []
    for _ in range(2):
      shutil.rmtree(folder, ignore_errors=True)
      room.copy(home, folder)
      process, most = _fork(TARGETS[target].words, folder), 0.0
      while process.poll() is None:
        most = max(most, spent(process.pid))
        time.sleep(0.05)
      err = processes.said(folder)[1]
      if process.returncode:
        raise OSError(f"{target} undisturbed: status {process.returncode}, {err[-500:]}")
      times.append(most)
      digests.append(reference.of_folder(folder / "out"))
    if differing := reference.differences(*digests):
      raise OSError(f"{target} undisturbed differs from itself: {differing[:3]}")
    known.write_text(json.dumps({"seconds": times[1], "digests": digests[1]}))
    shutil.rmtree(folder)
    room.copy(home, folder)
  value = json.loads(known.read_text())
  return value["seconds"], value["digests"]


def _fork(words: list[str], folder: pathlib.Path) -> processes.Fork:
  return processes.Fork(words, folder, work=program)


def _process(words: list[str], folder: pathlib.Path) -> subprocess.Popen:
  return processes.started(words, folder, program=PROGRAM)


def ended_well(name: str, status: int, err: str) -> str:
  """What is wrong with how a signal ended a command; "" where nothing is."""
  if name == "KILL":
    return ""  # it had no say
  lines = judge.lines_of(processes.Done(status, "", err, 0.0))
  if status != 130:
    return f"SIG{name}: status {status}, {(lines or [''])[-1][:200]}"
  if noise := next((x for x in lines if judge.NOISE.search(x)), None):
    return f"SIG{name}: noise: {noise.strip()[:200]}"
  said = [x for x in lines if x.startswith("mjx-cl: interrupted")]
  return (
    ""
    if len(said) == 1 and lines[-1] == said[0]
    else f"SIG{name}: not one line that it is interrupted at the end"
  )


def cut(
  process: subprocess.Popen | processes.Fork,
  names: list[str],
  at_s: float,
  group: bool,
  rng: np.random.Generator,
) -> tuple[bool, float]:
  """Sends the signals after so much processor time; (whether it was at work still, seconds that it
  took to end).
  """
  while process.poll() is None and spent(process.pid) < at_s:
    time.sleep(0.005)
  if process.poll() is not None:
    return False, 0.0
  begin = time.monotonic()
  for k, name in enumerate(names):
    if k:
      time.sleep(float(rng.choice([0.0, 0.02, 0.3, 1.0])))
    try:
      (os.killpg if group else os.kill)(process.pid, getattr(signal, f"SIG{name}"))
    except ProcessLookupError:
      break
  while process.poll() is None:
    if spent(process.pid) > at_s + MOST_S or time.monotonic() > begin + LIMIT_S:
      os.killpg(process.pid, signal.SIGKILL)
      process.wait()
      return True, float("inf")
    time.sleep(0.01)
  return True, time.monotonic() - begin


def kill(target: str, names: list[str], rng: np.random.Generator, home: pathlib.Path, folder: pathlib.Path
         ) -> tuple[str, int, str]:  # fmt: skip
  """Kills once or twice and lets the command end: (what is wrong, status, where it was cut off)."""
  seconds, digests = whole(target, home, folder)
  start = _fork
  if rng.random() < APART:
    start, seconds = _process, seconds + IMPORT_S
  one = TARGETS[target]
  words, places = list(one.words), []
  twice_killed = names == ["KILL", "KILL"]  # the second falls upon what goes on
  for signals in [["KILL"], ["KILL"]] if twice_killed else [names]:
    at = float(rng.uniform(0, seconds))
    process = start(words, folder)
    working, late = cut(process, signals, at, bool(rng.random() < 0.5), rng)
    err = processes.said(folder)[1]
    places.append(f"{at:.2f} of {seconds:.2f} s" if working else "not at all, it had ended")
    if late == float("inf"):
      return (
        f"does not end within {MOST_S:g} s of processor time",
        process.returncode,
        "; ".join(places),
      )
    code = process.returncode
    early = start is _process and code in (-15, -2) and at < 1.0  # Python had hardly begun
    if working and code and not early and (wrong := ended_well(signals[-1], code, err)):
      return wrong, code, "; ".join(places)
    words = [*one.words, *one.again]
  done = processes.forked(words, folder, LIMIT_S, work=program)
  if done.status:
    return (
      f"does not go on: {(judge.lines_of(done) or [''])[-1][:300]}",
      done.status,
      "; ".join(places),
    )
  if noise := next((x for x in judge.lines_of(done) if judge.NOISE.search(x)), None):
    return f"goes on with noise: {noise[:200]}", 0, "; ".join(places)
  differing = reference.differences(digests, reference.of_folder(folder / "out"))
  return f"differs: {' | '.join(differing[:3])}" if differing else "", 0, "; ".join(places)
