"""The command line. Nothing here imports JAX before a command that computes runs, so `--help`
answers at once.

Exit codes: 0 done; 2 arguments, names, ranges, refused --out; 1 files, disk, numeric failure; 3 a
change that was to be a failure; 130 Ctrl-C, after state is saved.

What each command takes stands in flags.py, what does it in the module that COMMANDS names.
"""

import atexit
import contextlib
import dataclasses
import difflib
import importlib
import io
import os
import re
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Union

import tyro

from mjx_cl import __version__
from mjx_cl.adapt.arms import ARMS
from mjx_cl.cli.flags import (
  Bench,
  Calibrate,
  Certify,
  Compare,
  Detect,
  Doctor,
  Eval,
  Leaderboard,
  List,
  Plot,
  Query,
  Record,
  Render,
  Report,
  Run,
  Train,
)
from mjx_cl.cli.output import apart, printable, say
from mjx_cl.config import FaultConfig, quick
from mjx_cl.errors import FileError, PluginError, UserError, choose
from mjx_cl.io import folders, interrupt, limits, plugins, runtime
from mjx_cl.io.interrupt import Interruptible, Lasting

# what is said of a command in flags.py -> the module that does it, imported once it is called
COMMANDS = {
  Run: "runs",
  Train: "agents",
  Eval: "agents",
  Calibrate: "robots",
  Certify: "robots",
  Record: "board",
  Leaderboard: "board",
  Bench: "runs",
  Plot: "results",
  Compare: "comparison",
  Render: "robots",
  Query: "results",
  Detect: "log",
  Report: "results",
  List: "names",
  Doctor: "doctor",
}
Command = Union[  # type: ignore[valid-type]  # noqa: UP007  of a computed tuple
  tuple(
    Annotated[
      kind,
      tyro.conf.subcommand(kind.__name__.lower()),
      *[tyro.conf.PositionalRequiredArgs] * issubclass(kind, FaultConfig),
    ]
    for kind in COMMANDS
  )
]


def done_by(kind: type, module: str) -> Callable[[Any], None]:
  """What does a command: `do_NAME` of its module."""

  def do(command: Any) -> None:
    done = importlib.import_module(f"mjx_cl.cli.{module}")
    getattr(done, f"do_{kind.__name__.lower()}")(command)

  return do


# what our code may raise where a user's gave something that it does not expect
FOREIGN = (TypeError, ValueError, AttributeError, ArithmeticError, LookupError)
DO = {kind: done_by(kind, module) for kind, module in COMMANDS.items()}


def parse(argv: list[str] | None) -> Any:
  """Arguments -> command. `--version` alone prints it and ends; no argument is a mistake that the
  help answers.
  """
  argv = sys.argv[1:] if argv is None else argv
  if argv == ["--version"]:
    print(f"mjx-cl {__version__}")
    raise SystemExit(0)
  for word in argv:
    try:
      word.encode()
    except UnicodeEncodeError:  # result files say how they were made, as UTF-8
      raise UserError(f"an argument is no UTF-8 text: {word}") from None
  if argv and not argv[0].startswith("-"):
    choose("command", argv[0], {kind.__name__.lower(): kind for kind in COMMANDS})
  about = "Robots that notice a fault, adapt to it and know when they are done."
  command = read(Command, argv, prog="mjx-cl", args=argv or ["--help"], description=about)
  check_lists(command, argv)
  return quickly(command, argv[1:]) if isinstance(command, Run) and command.quick else command


def check_lists(command: Any, argv: list[str]) -> None:
  """Refuses a flag of several values that is given twice, of which the last alone would count, or
  without any, as with a shell's variable that is not set.
  """
  several = {"set", "compare"}  # of every command that has them; the others by their default
  several |= {f.name for f in dataclasses.fields(command) if isinstance(f.default, tuple)}
  seen: set[str] = set()
  for k, word in enumerate(argv):
    flag, given, _ = word.partition("=")
    name = flag[2:].replace("-", "_")
    if not flag.startswith("--") or not {name, f"{name}s"} & several:
      continue
    if flag in seen:
      raise UserError(f"{flag} is there twice; give it once, with all its values behind it")
    seen.add(flag)
    if not given and (argv[k + 1 :] or ["--"])[0].startswith("--"):
      raise UserError(f"{flag} got no value; leave it out for the default")


def quickly(command: Run, argv: list[str]) -> Run:
  """`run --quick` with the flags `argv`: they override quick's defaults, and a fault of the user's
  own comes without target and severity of quick's.
  """
  kind = Annotated[Run, tyro.conf.PositionalRequiredArgs]
  defaults = {"fault": Run.fault} | quick.defaults(command.env)
  several = {f.name for f in dataclasses.fields(Run) if isinstance(f.default, tuple)}
  for name in several & set(defaults):
    defaults[name] = defaults[name] if isinstance(defaults[name], tuple) else (defaults[name],)
  for left_out in ((), quick.FAULT):
    own = {name: value for name, value in defaults.items() if name not in left_out}
    asked: Run = read(kind, argv, args=argv, default=Run(env=tyro.MISSING, **own))
    if asked.fault == defaults["fault"]:
      break
  quick.check(asked, any(ARMS[arm].learns for arm in asked.arms if arm in ARMS))
  return asked


def read(kind: Any, argv: list[str], **how: Any) -> Any:
  """What tyro makes of arguments; its framed report of a mistake becomes one line."""
  report = io.StringIO()
  try:
    with contextlib.redirect_stderr(report):
      return tyro.cli(kind, config=(tyro.conf.FlagCreatePairsOff,), **how)
  except SystemExit as e:
    if not argv:
      raise SystemExit(UserError.exit_code) from None
    if e.code in (0, None):
      raise
    text = re.sub(r"\x1b\[[0-9;]*m", "", report.getvalue())
    lines = [re.sub(r"^[│|]|[│|]$", "", line).strip() for line in text.splitlines()]
    words = [
      line
      for line in lines
      if line and not re.match(r"^[╭╰─]", line) and not line.startswith("For full helptext")
    ]
    said = re.sub(r"\s+", " ", " ".join(words))
    raise UserError(_mistake(said, argv) or "wrong arguments; see mjx-cl --help") from None


def _commands_with(flag: str) -> list[str]:
  """Commands that take --flag."""
  name = flag.lstrip("-").partition("=")[0].replace("-", "_")
  return [
    f"mjx-cl {kind.__name__.lower()}"
    for kind in COMMANDS
    if {name, f"{name}s"} & {f.name for f in dataclasses.fields(kind)}
  ]


def _mistake(said: str, argv: list[str]) -> str:
  """What tyro says of a mistake, without its excerpts of the help."""
  command = " ".join(["mjx-cl", *(word for word in argv[:1] if not word.startswith("-"))])
  if found := re.match(
    r"Unrecognized (?:or misplaced )?options: (.*?)(?: Arguments are applied.*?)?"
    r"(?: Available .*)?(?: Perhaps you meant: (--[\w.-]+).*)?$",
    said,
  ):
    words = re.sub(r" \(applied to [^)]*\)", ",", found[1]).replace(",,", ",").split(",")
    words = [word.strip() for word in words if word.strip()]
    flags = [word for word in words if word.startswith("-")] or words
    meant = f"; did you mean {found[2]}?" if found[2] and len(flags) == 1 else ""
    close = meant and difflib.SequenceMatcher(None, flags[0], found[2]).ratio() > 0.8
    if not close and (homes := _commands_with(flags[0]) if len(flags) == 1 else ()):
      meant = f"; it is a flag of {', '.join(homes)}"
    return f"unknown argument of {command}: {', '.join(flags)}{meant}; see {command} --help"
  if re.match(r"Missing from ", said) and (
    flags := re.findall(r"(--[\w.-]+) [^()]*\(required\)", said)
  ):
    return f"{command} needs {', '.join(flags)}; see {command} --help"
  return said


def attempt(do: Callable[[], object], again: Callable[[], str] = lambda: "") -> int:
  """Exit status of `do()`; what goes wrong becomes one line on standard error, an interrupt one
  that ends in `again()`.
  """
  runtime.quiet()
  interrupt.forget()
  signal.signal(signal.SIGTERM, interrupt.stop)
  if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, interrupt.stop)
  before, hook = sys.stderr, sys.unraisablehook
  sys.stderr, sys.unraisablehook = Lasting(before), interrupt.unraisable(hook)
  try:
    with interrupt.enforced():
      return _attempt(do, again)
  finally:
    if getattr(sys.stderr, "_stream", None) is before:
      sys.stderr = before
    sys.unraisablehook = hook
    interrupt.forget()
    if signal.getsignal(signal.SIGINT) is interrupt.stop:
      signal.signal(signal.SIGINT, signal.default_int_handler)


def shortened(text: str, most: int = 480, word: int = 160) -> str:
  """A text as it is printed: the middle is left out of words longer than `word`, then of the whole
  where it is longer than `most`.
  """

  def cut(part: str, most: int) -> str:
    end = most // 4
    return part if len(part) <= most else f"{part[: most - end - 5]} ... {part[-end:]}"

  return cut(" ".join(cut(part, word) for part in printable(text).split(" ")), most)


def _attempt(do: Callable[[], object], again: Callable[[], str]) -> int:
  try:
    do()
    return 0
  except KeyboardInterrupt:
    say(f"mjx-cl: interrupted{again()}")
    # a second signal finds an interpreter that is clearing up
    for number in (signal.SIGINT, signal.SIGTERM):
      atexit.register(signal.signal, number, signal.SIG_IGN)
    return 130
  except BrokenPipeError:
    return (
      0  # of standard output: the reader has what it wanted, results are in their files by then
    )
  except Exception as e:
    known = _known(e)
    if known is None:
      raise
    text, status = known
    say(f"mjx-cl: {text}")
    return status


def _known(error: Exception) -> tuple[str, int] | None:
  """What is said of an error, in one line, and the exit status; None where it is a bug."""
  text, ours = " ".join(str(error).split()), isinstance(error, UserError)
  if limits.ran_out(error.__cause__ or error.__context__ if ours else error):
    why = f": {text[:200]}" if text else ""
    return (
      f"out of memory{why}; fewer --seeds, arms or detectors or a smaller batch need less",
      FileError.exit_code,
    )
  if isinstance(error, UserError):
    return shortened(text), error.exit_code
  if isinstance(error, OSError):
    where = f": {error.filename}" if error.filename else ""
    return shortened(f"{error.strerror or error}{where}"), FileError.exit_code
  return None


def check_filled(command: Any) -> None:
  """Refuses an empty text, as of a shell's variable that is not set, where a flag was given."""
  for field in dataclasses.fields(command):
    value = getattr(command, field.name)
    texts = [x for x in (value if isinstance(value, tuple) else (value,)) if isinstance(x, str)]
    if field.default != "" and not all(text.strip() for text in texts):
      raise UserError(f"--{field.name.replace('_', '-')} got an empty name or text")


def own_code(command: Any) -> list[str]:
  """What of a command is code in the user's files, FILE.py:NAME each."""
  given = [getattr(command, f.name) for f in dataclasses.fields(command)]
  words = [x for value in given for x in (value if isinstance(value, tuple) else (value,))]
  return [x for x in words if isinstance(x, str) and plugins.file_of(x)]


@contextlib.contextmanager
def ours(command: Any) -> Iterator[None]:
  """What a plug-in raises, and whoever wants to end the program but the user, is named, and so is
  the place; where what a user's code gave fails later, in ours, that code.
  """
  try:
    yield
  except UserError:
    raise
  except Exception as e:
    where = None if plugins.of_user(e) else plugins.place(e)
    if where is None and isinstance(e, FOREIGN) and not plugins.of_user(e):
      where = ", ".join(own_code(command)) or None
    if where is None:
      raise
    raise PluginError(f"{where}: {plugins.line(e)}") from None
  except BaseException as e:
    if plugins.of_user(e):
      raise
    *_, last = traceback.extract_tb(e.__traceback__)
    raise PluginError(f"{last.filename}, line {last.lineno}: {plugins.line(e)}") from None


def main(argv: list[str] | None = None) -> int:
  """Entry point of `mjx-cl`."""
  command: Any = None

  def do() -> None:
    nonlocal command
    command = parse(argv)
    check_filled(command)
    if not isinstance(command, (List, Plot, Query, Report)):
      shared = isinstance(command, Train) and command.seeds > 0
      runtime.setup(runtime.sharing(command.seeds) if shared else 1)
    # a run locks its own folder, and so does each part of a suite
    whole = isinstance(command, (Train, Certify, Record, Leaderboard, Detect))
    out = command.out if whole else None
    with apart(command), ours(command), folders.alone(out) if out else contextlib.nullcontext():
      DO[type(command)](command)

  def again() -> str:
    if isinstance(command, (Run, Train)):
      saved = os.path.isdir(command.out) and os.listdir(command.out)
      return "; what was saved can be resumed with --resume" if saved else "; nothing was saved"
    return "; the same command goes on where it stopped" * isinstance(command, (Record, Bench))

  status = attempt(do, again)
  # a save that was broken off has threads that would complain of the interpreter's end; foreign
  # code may have one that never ends
  busy = any(not t.daemon and t is not threading.current_thread() for t in threading.enumerate())
  # nobody waits for what was compiled ahead and not needed: all files are written
  ahead = any(t.name.startswith("ahead") for t in threading.enumerate())
  if argv is None and (ahead or (status and (busy or Interruptible.again))):
    for stream in (sys.stdout, sys.stderr):
      with contextlib.suppress(OSError, ValueError):
        stream.flush()
    os._exit(status)
  if argv is None:  # all is done: what comes now finds an interpreter that is clearing up
    for number in (signal.SIGINT, signal.SIGTERM):
      signal.signal(number, signal.SIG_IGN)
  return status


if __name__ == "__main__":
  sys.exit(main())
