"""What commands say: lines on standard error, one JSON value on standard output. Free of JAX."""

import contextlib
import json
import sys
from collections.abc import Iterator
from typing import Any, TextIO


def printable(text: str) -> str:
  """A text in which what a terminal would obey, and what is no character, stands escaped."""
  return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


def say(text: str) -> None:
  """One line on standard error."""
  print(printable(text), file=sys.stderr, flush=True)


def clock(seconds: float) -> str:
  """m:ss or h:mm:ss."""
  seconds = int(max(0, seconds))
  return (
    f"{seconds // 3600}:{seconds % 3600 // 60:02d}:{seconds % 60:02d}"
    if seconds >= 3600
    else f"{seconds // 60}:{seconds % 60:02d}"
  )


# standard output of a command with --json, while whatever else is printed goes to standard error
RESULT: list[TextIO] = []


def emit(value: Any) -> None:
  """The one JSON value of a command."""
  from mjx_cl.io.tables import plain  # not at the top: help needs no Parquet

  print(json.dumps(value, allow_nan=False, default=plain), file=RESULT[-1] if RESULT else None)


@contextlib.contextmanager
def apart(command: object) -> Iterator[None]:
  """With --json nothing but `emit` reaches standard output, also not what a user's detector or
  robot prints.
  """
  if not getattr(command, "json", False):
    yield
    return
  RESULT.append(sys.stdout)
  try:
    with contextlib.redirect_stdout(sys.stderr):
      yield
  finally:
    RESULT.pop()


def command_line(command: str) -> str:
  """What was typed, as result files say it; of another program that called `command` just that."""
  return "mjx-cl " + (" ".join(sys.argv[1:]) or command)
