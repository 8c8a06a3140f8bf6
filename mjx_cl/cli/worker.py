"""One part of a suite in a process of its own: `python -m mjx_cl.cli.worker OUT PART CORES`."""

import os
import pathlib
import signal
import sys
import threading

from mjx_cl.cli import app
from mjx_cl.io import runtime, tables


def main(arguments: list[str]) -> int:
  """Runs PART of OUT/suite.json on the cores (numbers, separated by commas).

  Returns:
    Exit status 0, 1 (files), 2 (settings) or 130 (stopped, saved).
  """
  out, name, own = arguments
  if own and hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {int(core) for core in own.split(",")})  # before JAX counts its threads
  threading.Thread(target=_orphan, daemon=True).start()

  def do() -> None:
    runtime.setup()
    # JAX has not started before
    from mjx_cl.cli.live import RunDisplay
    from mjx_cl.runs import run, suite

    folder = pathlib.Path(out)
    values = tables.read_json(folder / "suite.json")["parts"][name]
    with RunDisplay() as shown:
      run.execute(
        suite.config(name, values),
        folder / name,
        resume=(folder / name / "config.json").exists(),
        progress=shown,
      )

  return app.attempt(do)


def _orphan() -> None:
  """Ends this process, its state saved, once the parent closes its standard input."""
  os.read(0, 1)  # not sys.stdin, whose lock would still be held as the interpreter ends
  # where the parent died, nobody reads what is said, and saying it would be an error before the
  # state is saved
  os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
  os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
  sys.exit(main(sys.argv[1:]))
