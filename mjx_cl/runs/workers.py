"""Parts of a suite side by side, each in a process of its own on a share of the cores.

One run does not keep several cores busy all the time: its programs are compiled on one core, and
acting is one program for all streams. The parent starts `python -m MODULE OUT PART CORES` for each
part; OUT/suite.json says what the part is. A worker saves and ends when its standard input closes,
so that none outlives its parent.
"""

import contextlib
import os
import pathlib
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import jax

from mjx_cl.errors import FileError, UserError, require
from mjx_cl.io.interrupt import Interruptible
from mjx_cl.io.runtime import cores


def number(asked: int | None, needs: list[int], space: int) -> int:
  """How many parts run side by side: at most one per core, and no more than the largest of `needs`
  [bytes] that fit into `space` together.

  Args:
    asked: the user's number, None: as many as that.

  Raises:
    UserError: where the user's number is below 1, above the cores, or does not fit. On an
      accelerator, which each process would take whole, it is 1.
  """
  limit, fits = len(cores()) if jax.default_backend() == "cpu" else 1, 0
  for need in sorted(needs, reverse=True):
    space -= need
    fits += space >= 0
  if asked is None:
    return max(1, min(limit, fits))
  require(1 <= asked <= limit, f"--jobs must lie in 1..{limit} on this machine; got {asked}")
  fits = max(1, fits)
  require(
    min(asked, len(needs)) <= fits,
    f"{asked} parts side by side do not fit into memory, {fits} would; give --jobs {fits} or fewer "
    "--seeds",
  )
  return asked


class Worker:
  """A running part.

  Attributes:
    name: of the part.
    share: its place among the shares of the cores.
    last: line that it said last.
  """

  def __init__(
    self,
    module: str,
    out: pathlib.Path,
    name: str,
    share: int,
    own: list[int],
    tell: Callable[[str], None],
  ) -> None:
    self.name, self.share, self.last = name, share, ""
    command = [sys.executable, "-m", module, str(out), name, ",".join(map(str, own))]
    # a session of its own: Ctrl-C reaches the parent alone, which then closes the input
    self.process: Any = subprocess.Popen(
      command,
      stdin=subprocess.PIPE,
      stdout=subprocess.DEVNULL,
      stderr=subprocess.PIPE,
      text=True,
      errors="replace",
      start_new_session=True,
    )

    def listen() -> None:
      for line in self.process.stderr:
        if line.strip():
          self.last = line.strip()
          # where nobody listens any more a full pipe would stop the worker
          with contextlib.suppress(OSError):
            tell(f"{name}: {self.last}")

    self.listener = threading.Thread(target=listen, daemon=True)
    self.listener.start()

  def check(self) -> bool:
    """Whether the part is finished.

    Raises:
      UserError: with what the worker said last, where it failed over settings.
      FileError: likewise, over files, or where it was ended.
    """
    code = self.process.poll()
    if code is None:
      return False
    self.listener.join()
    self.process.stdin.close()
    if code < 0:
      raise FileError(
        f"part {self.name} was ended by signal {-code}; where memory ran out, --jobs 1 needs "
        "least; the same command goes on"
      )
    if code:
      kind = UserError if code == 2 else FileError
      raise kind(
        f"part {self.name}: "
        f"{self.last.removeprefix('mjx-cl: ') or f'ended with exit status {code}'}"
      )
    return True


def together(
  module: str,
  out: str | os.PathLike,
  names: list[str],
  jobs: int,
  finished: Callable[[str], None],
  tell: Callable[[str], None] = lambda text: None,
) -> None:
  """Runs the parts `names` of OUT/suite.json, `jobs` at a time, in their order.

  Args:
    module: what each process runs, see cli/worker.py.
    out: folder of the suite.
    names: of the parts.
    jobs: how many at a time.
    finished: called with the name of each part as it ends.
    tell: called with each line that a part says.

  Raises:
    UserError: as soon as one fails over settings. Before any of these is raised the others have
      saved what they had lived and ended.
    FileError: as soon as one fails otherwise.
    KeyboardInterrupt: on a signal.
  """
  waiting, free, all_cores = list(names), list(range(jobs)), cores()
  running: list[Worker] = []
  try:
    with Interruptible() as stop:
      while waiting or running:
        over = [worker for worker in running if worker.check()]
        running = [worker for worker in running if worker not in over]
        free += [worker.share for worker in over]
        while waiting and free:
          share = free.pop(0)
          running.append(
            Worker(module, pathlib.Path(out), waiting.pop(0), share, all_cores[share::jobs], tell)
          )
        for worker in over:
          finished(worker.name)
        stop.check()
        time.sleep(0.1)
  finally:
    running = [worker for worker in running if worker.process.poll() is None]
    for worker in running:  # all at once, then wait for all
      worker.process.stdin.close()
    for worker in running:
      worker.process.wait()
