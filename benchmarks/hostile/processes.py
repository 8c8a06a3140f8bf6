"""Processes of cases: `mjx-cl` of its own, or a fork of this process, which has imported all of it
once.

A fork ends with status BEGUN where the input was taken and the long work would begin (WORK).
"""

from __future__ import annotations

import ctypes
import importlib
import os
import pathlib
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import IO, NamedTuple

from benchmarks.hostile import room

BEGUN = 250  # exit status of a fork whose work has begun
GRACE_S = 10.0  # from Ctrl-C to the end of a process
# where long work begins: module -> its functions
WORK = {
  "mjx_cl.runs.run": ("live",),
  "mjx_cl.runs.calibrate": ("watched",),
  "mjx_cl.training.trainer": ("run",),
  "mjx_cl.training.demonstrator": ("train",),
  "mjx_cl.training.evaluate": ("evaluate",),
  "mjx_cl.leaderboard.record": ("_parts",),
  "mjx_cl.leaderboard.score": ("_run",),
  "mjx_cl.faults.certificate": ("certify",),
  "mjx_cl.render.pictures": ("painter",),
  "mjx_cl.io.cache_check": ("check",),
}
LIMITS = {
  "AS": resource.RLIMIT_AS,
  "NOFILE": resource.RLIMIT_NOFILE,
  "FSIZE": resource.RLIMIT_FSIZE,
}


class Done(NamedTuple):
  """How a process ended.

  Attributes:
    status: exit status, negative: the signal that ended it.
    out: standard output.
    err: standard error.
    seconds: until it ended, or was interrupted.
    interrupted: it was at work still when its time was over.
    late: seconds that it took to end after Ctrl-C; None: it had to be killed.
  """

  status: int
  out: str
  err: str
  seconds: float
  interrupted: bool = False
  late: float | None = 0.0


def warm() -> None:
  """Imports what commands import; no backend of JAX starts, which a fork would not survive."""
  app = importlib.import_module("mjx_cl.cli.app")
  for name in {*app.COMMANDS.values()}:
    importlib.import_module(f"mjx_cl.cli.{name}")
  for name in ("mjx_cl.render.figures", "benchmarks.report.report", "matplotlib.pyplot"):
    importlib.import_module(name)


def _wait(
  ended: Callable[[], int | None], pid: int, limit_s: float
) -> tuple[int, float, bool, float | None]:
  """(status, seconds, interrupted, late) of a process that is given Ctrl-C at its limit."""
  begin = time.monotonic()
  while (status := ended()) is None and time.monotonic() < begin + limit_s:
    time.sleep(0.005)
  seconds = time.monotonic() - begin
  if status is not None:
    return status, seconds, False, 0.0
  for wait_s in (GRACE_S, 2 * GRACE_S):  # a second Ctrl-C does not wait for what is under way
    os.kill(pid, signal.SIGINT)
    while (status := ended()) is None and time.monotonic() < begin + seconds + wait_s:
      time.sleep(0.01)
    if status is not None:
      return status, seconds, True, time.monotonic() - begin - seconds
  os.killpg(pid, signal.SIGKILL)
  while (status := ended()) is None:
    time.sleep(0.01)
  return status, seconds, True, None


def _of_its_own(limits: dict[str, int]) -> None:
  """As `_limited`, of what a shell has started: one that runs in the background ignores Ctrl-C."""
  signal.signal(signal.SIGINT, signal.SIG_DFL)
  _limited(limits)


def _limited(limits: dict[str, int]) -> None:
  """Within a new process: its limits; it ends with the campaign."""
  if sys.platform == "linux":
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG, prctl(2)
  for name, value in limits.items():
    hard = resource.getrlimit(LIMITS[name])[1]
    resource.setrlimit(LIMITS[name], (value, hard))


def started(words: list[str], folder: pathlib.Path, limits: dict[str, int] | None = None,
            program: tuple[str, ...] = ("-m", "mjx_cl"), output: str | None = None) -> subprocess.Popen:  # fmt: skip
  """A process of its own, its output in files of the folder above, standard output in `output` where
  that is given.

  Under a limit on the size of files both are pipes into processes without it, since the limit would
  cut off what is said.
  """
  folder.with_suffix(".out").touch()
  with (
    open(output or folder.with_suffix(".out"), "wb") as out,
    open(folder.with_suffix(".err"), "wb") as err,
  ):
    pipes = [_pipe(file) for file in (out, err)] if "FSIZE" in (limits or {}) else []
    ends: list = [pipe.stdin for pipe in pipes] or [out, err]
    process = subprocess.Popen([sys.executable, *program, *map(os.fsencode, words)], cwd=folder,
                               stdin=subprocess.DEVNULL, stdout=ends[0], stderr=ends[1],
                               env=room.environment(folder), start_new_session=True,
                               preexec_fn=lambda: _of_its_own(limits or {}))  # fmt: skip
  for end in ends if pipes else ():
    end.close()
  PIPES[process.pid] = pipes
  return process


PIPES: dict[int, list[subprocess.Popen]] = {}  # of a process that is not finished yet


def _pipe(file: IO[bytes]) -> subprocess.Popen:
  """A process that writes what it is given into a file."""
  return subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=file, start_new_session=True)


def said(folder: pathlib.Path) -> tuple[str, str]:
  """Standard output and error of the last process of a folder, which keeps them in its tmp."""
  texts = []
  for suffix in (".out", ".err"):
    file = folder.with_suffix(suffix)
    texts.append(file.read_bytes()[:2_000_000].decode(errors="backslashreplace"))
    file.replace(folder / "tmp" / f"said{suffix}") if (folder / "tmp").is_dir() else file.unlink()
  return texts[0], texts[1]


def alone(words: list[str], folder: pathlib.Path, limit_s: float, limits: dict[str, int] | None = None,
          program: tuple[str, ...] = ("-m", "mjx_cl"), output: str | None = None) -> Done:  # fmt: skip
  """Runs a process of its own to its end, or the limit."""
  process = started(words, folder, limits, program, output)
  how = _wait(process.poll, process.pid, limit_s)
  for pipe in PIPES.pop(process.pid, []):
    pipe.wait()
  return Done(how[0], *said(folder), *how[1:])


def _begun(*_: object, **__: object) -> None:
  for stream in (sys.stdout, sys.stderr):
    stream.flush()
  os._exit(BEGUN)


def until_work(words: list[str]) -> int:
  """What `mjx-cl WORDS` does, in a fork, until its work begins."""
  for module, names in WORK.items():
    for name in names:
      setattr(sys.modules[module], name, _begun)
  return command(words)


def command(words: list[str]) -> int:
  """What `mjx-cl WORDS` does, in a fork."""
  from mjx_cl.cli import app

  # as a shell hands them over: what is no UTF-8 is a surrogate, no NUL
  sys.argv = ["mjx-cl", *words]
  return app.main()


class Fork:
  """A command in a fork of this process, as subprocess.Popen has it.

  Attributes:
    pid: of the process, and of its group.
    returncode: None until it has ended; negative: the signal that ended it.
  """

  def __init__(
    self,
    words: list[str],
    folder: pathlib.Path,
    limits: dict[str, int] | None = None,
    work: Callable[[list[str]], int] = until_work,
  ) -> None:
    sys.stdout.flush()
    self.returncode: int | None = None
    self.pid = os.fork()
    if not self.pid:
      status = 1
      try:
        status = _within(words, folder, limits or {}, work)
      finally:
        os._exit(status)

  def poll(self) -> int | None:
    """The exit status, None until it has ended."""
    if self.returncode is None:
      got, how = os.waitpid(self.pid, os.WNOHANG)
      self.returncode = os.waitstatus_to_exitcode(how) if got else None
    return self.returncode

  def wait(self, timeout: float = 1e9) -> int:
    """The exit status; subprocess.TimeoutExpired where that takes longer."""
    end = time.monotonic() + timeout
    while (status := self.poll()) is None:
      if time.monotonic() > end:
        raise subprocess.TimeoutExpired("a fork", timeout)
      time.sleep(0.005)
    return status


def _within(
  words: list[str], folder: pathlib.Path, limits: dict[str, int], work: Callable[[list[str]], int]
) -> int:
  """A fork's life: output in files, an environment of its own."""
  os.setsid()
  for number, suffix in ((1, ".out"), (2, ".err")):
    file = os.open(folder.with_suffix(suffix), os.O_CREAT | os.O_TRUNC | os.O_WRONLY, 0o600)
    os.dup2(file, number)
  os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
  os.chdir(folder)
  os.environ.clear()
  os.environ.update(ENVIRONMENT | room.environment(folder))
  signal.signal(signal.SIGINT, signal.default_int_handler)
  _limited(limits)
  sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
  sys.stderr = open(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
  status = 1
  try:
    status = work(words)
  except SystemExit as e:
    status = e.code if isinstance(e.code, int) else 1
  except BaseException:
    sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]
  sys.stdout.flush()
  sys.stderr.flush()
  return status


def forked(
  words: list[str],
  folder: pathlib.Path,
  limit_s: float,
  limits: dict[str, int] | None = None,
  work: Callable[[list[str]], int] = until_work,
) -> Done:
  """Runs a command in a fork of this process to its end, or the limit."""
  process = Fork(words, folder, limits, work)
  how = _wait(process.poll, process.pid, limit_s)
  return Done(how[0], *said(folder), *how[1:])


ENVIRONMENT = dict(os.environ)
