"""Parts of a suite side by side, in a process for each share of the cores.

One run does not keep several cores busy all the time: its programs are compiled on one core, and a
few lives act as one batch. The parent starts `python -m MODULE OUT CORES`, writes the name of a
part on its standard input, and reads `finished NAME` on its standard output before it writes the
next; OUT/suite.json says what a part is. What is compiled, and what robots live before their onset,
serves the later parts of a process. A worker saves and ends when its standard input closes, so that
none outlives its parent.
"""

import contextlib
import os
import pathlib
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Hashable
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
  """A process that runs parts, one after the other.

  Attributes:
    share: its place among the shares of the cores.
    name: of the part that it runs, "": none.
    kind: of the part that it has run last, see `together`.
    last: line that it said last.
    tell: called with each line that it says.
  """

  def __init__(
    self,
    module: str,
    out: pathlib.Path,
    share: int,
    own: list[int],
    tell: Callable[[str], None],
    **how: Any,
  ) -> None:
    # how: of subprocess.Popen
    self.share, self.name, self.last, self.tell = share, "", "", tell
    self.kind: Hashable = None
    command = [sys.executable, "-m", module, str(out), ",".join(map(str, own))]
    # a session of its own: Ctrl-C reaches the parent alone, which then closes the input
    self.process: Any = subprocess.Popen(
      command,
      stdin=subprocess.PIPE,
      stdout=subprocess.PIPE,
      stderr=subprocess.PIPE,
      text=True,
      errors="replace",
      start_new_session=True,
      **how,
    )
    self._over = threading.Event()

    def listen() -> None:
      for line in self.process.stderr:
        if line.strip():
          self.last = line.strip()
          # where nobody listens any more a full pipe would stop the worker
          with contextlib.suppress(OSError):
            self.tell(f"{self.name}: {self.last}")

    def wait() -> None:
      for line in self.process.stdout:
        if line.rstrip("\r\n") == f"finished {self.name}":
          self._over.set()

    self.listeners = [threading.Thread(target=own, daemon=True) for own in (listen, wait)]
    for thread in self.listeners:
      thread.start()

  def give(self, name: str, kind: Hashable = None) -> None:
    """Has it run a part; a process that is gone is noticed by `check`."""
    self.name, self.kind = name, kind
    with contextlib.suppress(OSError):
      self.process.stdin.write(f"{name}\n")
      self.process.stdin.flush()

  def check(self) -> bool:
    """Whether it has finished its part; it has none from then on.

    Raises:
      UserError: with what the worker said last, where it failed over settings.
      FileError: likewise, over files, or where it was ended.
    """
    code = self.process.poll()
    if code is not None:
      for thread in self.listeners:
        thread.join()
    if self._over.is_set():
      self._over.clear()
      self.name = ""
      return True
    if code is None:
      return False
    if code < 0:
      raise FileError(
        f"part {self.name} was ended by signal {-code}; where memory ran out, --jobs 1 needs "
        "least; the same command goes on"
      )
    kind = UserError if code == 2 else FileError
    raise kind(
      f"part {self.name}: {self.last.removeprefix('mjx-cl: ') or f'ended with exit status {code}'}"
    )

  def close(self) -> None:
    """Has it save and end, if it has not ended yet; `wait` for it afterwards."""
    with contextlib.suppress(OSError):
      self.process.stdin.close()


def together(
  module: str,
  out: str | os.PathLike,
  names: list[str],
  jobs: int,
  finished: Callable[[str], None],
  tell: Callable[[str], None] = lambda text: None,
  kind: Callable[[str], Hashable] = lambda name: None,
) -> None:
  """Runs the parts `names` of OUT/suite.json, `jobs` at a time, in their order, but that a process
  goes on with parts of the kind that it has begun, of which it has programs and lives.

  Args:
    module: what each process runs, see cli/worker.py.
    out: folder of the suite.
    names: of the parts.
    jobs: how many at a time.
    finished: called with the name of each part as it ends.
    tell: called with each line that a part says.
    kind: of a part.

  Raises:
    UserError: as soon as one fails over settings. Before any of these is raised the others have
      saved what they had lived and ended.
    FileError: as soon as one fails otherwise.
    KeyboardInterrupt: on a signal.
  """
  waiting, all_cores = list(names), cores()
  workers: list[Worker] = []
  try:
    with Interruptible() as stop:
      while waiting or any(worker.name for worker in workers):
        over = [name for worker in workers if (name := worker.name) and worker.check()]
        while waiting and len(workers) < jobs:
          share = len(workers)
          workers.append(Worker(module, pathlib.Path(out), share, all_cores[share::jobs], tell))
        for worker in workers:
          if waiting and not worker.name:
            alike = (name for name in waiting if kind(name) == worker.kind)
            name = next(alike, waiting[0])
            waiting.remove(name)
            worker.give(name, kind(name))
        for name in over:
          finished(name)
        stop.check()
        time.sleep(0.1)
  finally:
    for worker in workers:  # all at once, then wait for all
      worker.close()
    for worker in workers:
      worker.process.wait()
