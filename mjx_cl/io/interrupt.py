"""Ctrl-C and SIGTERM during a long run: noted at once, acted on between two chunks.

Raising inside a physics callback would surface as an XLA error with half a chunk lived; a flag lets
the chunk end, the state be saved, and then KeyboardInterrupt be raised.
"""

import concurrent.futures
import contextlib
import os
import signal
import socket
import sys
import threading
import types
from collections.abc import Callable, Iterator
from typing import Any, Self, TextIO


class Lasting:
  """A text stream that swallows what cannot be written: where the reader of progress lines has gone
  (`2>&1 | tee log` dies of the same Ctrl-C) the work goes on and is saved.
  """

  def __init__(self, stream: TextIO) -> None:
    self._stream = stream

  def write(self, text: str) -> int:
    """Writes, or nothing where nobody reads any more."""
    try:
      return self._stream.write(text)
    except (OSError, ValueError):  # ValueError: it is closed
      self._deaf()
      return len(text)

  def flush(self) -> None:
    """Flushes, or nothing where nobody reads any more."""
    try:
      self._stream.flush()
    except (OSError, ValueError):
      self._deaf()

  def _deaf(self) -> None:
    """From now on nothing is kept for a reader that is gone, so that the interpreter's last flush
    finds nothing to fail on.
    """
    self._stream = open(os.devnull, "w")  # noqa: SIM115  for as long as the process lives

  def __getattr__(self, name: str) -> object:
    return getattr(self._stream, name)


@contextlib.contextmanager
def threads(count: int, name: str = "") -> Iterator[concurrent.futures.ThreadPoolExecutor]:
  """A pool of threads. After an error or an interrupt what has not begun never does, and what has
  is not waited for: it may never end.
  """
  pool = concurrent.futures.ThreadPoolExecutor(count, name)
  try:
    yield pool
  except BaseException:
    pool.shutdown(wait=False, cancel_futures=True)
    raise
  pool.shutdown()


_SENT: list[int] = []  # signals that have come and were acted upon
_RAISED = threading.Event()  # `stop` has raised, and what it raised may have been dropped


def note(number: int) -> None:
  """Notes that a signal has come which ends what is under way."""
  _SENT.append(number)


def forget() -> None:
  """Forgets signals that have been acted upon."""
  _SENT.clear()
  _RAISED.clear()


def sent() -> bool:
  """Whether a KeyboardInterrupt is the user's: a signal has come, or Python's own handler is in
  place, which tells nobody.
  """
  return bool(_SENT) or signal.getsignal(signal.SIGINT) is signal.default_int_handler


def stop(number: int, frame: types.FrameType | None) -> None:
  """Handler of a command's signals: raises KeyboardInterrupt where the program is."""
  note(number)
  _RAISED.set()
  raise KeyboardInterrupt


def heed() -> None:
  """Raises KeyboardInterrupt where `stop` has: C code such as NumPy's may have dropped it."""
  if _RAISED.is_set():
    raise KeyboardInterrupt


def unraisable(hook: Callable[[Any], Any]) -> Callable[[Any], None]:
  """`hook` for sys.unraisablehook, but that a KeyboardInterrupt which Python drops, such as in a
  callback of the collector, is sent once more, in a moment.
  """

  def heard(what: Any) -> None:
    if what.exc_type is not None and issubclass(what.exc_type, KeyboardInterrupt):
      number = _SENT[-1] if _SENT else signal.SIGINT
      threading.Timer(0.01, signal.raise_signal, (number,)).start()
    else:
      hook(what)

  return heard


class Interruptible:
  """Context in which SIGINT and SIGTERM set a flag; `check()` raises KeyboardInterrupt once it is
  set. A second signal raises at once.

  Attributes:
    again: of the class, a second signal came. What it broke off, such as a save, may still be under
      way on other threads: the process should end without them.
  """

  again = False

  def __init__(self) -> None:
    self._set = False
    self._old: dict[int, Any] = {}

  def __enter__(self) -> Self:
    if threading.current_thread() is threading.main_thread():
      for number in (signal.SIGINT, signal.SIGTERM):
        self._old[number] = signal.signal(number, self._handle)
    return self

  def __exit__(self, *_: object) -> None:
    for number, old in self._old.items():
      signal.signal(number, old)

  def _handle(self, number: int, frame: types.FrameType | None) -> None:
    if self._set:
      Interruptible.again = True
      note(number)
      raise KeyboardInterrupt
    self._set = True
    note(number)
    with contextlib.suppress(RuntimeError):  # the stream is being written to: a reentrant call
      print("mjx-cl: stopping after this chunk, saving", file=sys.stderr, flush=True)

  def check(self) -> None:
    """Raises KeyboardInterrupt once a signal has come."""
    if self._set:
      raise KeyboardInterrupt
    heed()


GRACE_S = 5.0


@contextlib.contextmanager
def enforced(grace_s: float = GRACE_S) -> Iterator[None]:
  """A second SIGINT or SIGTERM ends the process after `grace_s`, status 130, if the context has not
  ended by then: Python acts on signals between two of its instructions, and a compiler or foreign C
  code may take minutes to come back. Outside the main thread it does nothing.
  """
  if threading.current_thread() is not threading.main_thread():
    yield
    return
  ours, heard = socket.socketpair()
  over = threading.Event()

  def listen() -> None:
    count = 0
    while count < 2:
      sent = ours.recv(64)  # numbers of the signals
      if not sent:
        return
      count += sum(sent.count(number) for number in (signal.SIGINT, signal.SIGTERM))
    if not over.wait(grace_s):
      os.write(2, b"mjx-cl: interrupted\n")
      os._exit(130)

  heard.setblocking(False)
  old = signal.set_wakeup_fd(heard.fileno(), warn_on_full_buffer=False)
  thread = threading.Thread(target=listen, daemon=True)
  thread.start()
  try:
    yield
  finally:
    signal.set_wakeup_fd(old)
    over.set()
    heard.close()
    thread.join()
    ours.close()
