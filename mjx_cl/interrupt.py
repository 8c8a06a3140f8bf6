"""Ctrl-C and SIGTERM during a long run: noted at once, acted on between two chunks.

Raising inside a physics callback would surface as an XLA error with half a chunk lived; a flag lets the chunk end, the state be saved, and
then KeyboardInterrupt be raised.
"""
from __future__ import annotations

import os
import signal
import sys
import threading


class Lasting:
  """A text stream that swallows what cannot be written: where the reader of progress lines has gone (`2>&1 | tee log` dies of the same Ctrl-C) the work goes on and is saved."""

  def __init__(self, stream):
    self._stream = stream

  def write(self, text: str) -> int:
    try:
      return self._stream.write(text)
    except (OSError, ValueError):  # ValueError: it is closed
      self._deaf()
      return len(text)

  def flush(self) -> None:
    try:
      self._stream.flush()
    except (OSError, ValueError):
      self._deaf()

  def _deaf(self) -> None:
    """From now on nothing is kept for a reader that is gone, so that the interpreter's last flush finds nothing to fail on."""
    self._stream = open(os.devnull, "w")

  def __getattr__(self, name):
    return getattr(self._stream, name)


class Interruptible:
  """Context in which SIGINT and SIGTERM set a flag; `check()` raises KeyboardInterrupt once it is set. A second signal raises at once."""

  def __init__(self):
    self._set = False
    self._old: dict[int, object] = {}

  def __enter__(self):
    if threading.current_thread() is threading.main_thread():
      for number in (signal.SIGINT, signal.SIGTERM):
        self._old[number] = signal.signal(number, self._handle)
    return self

  def __exit__(self, *_):
    for number, old in self._old.items():
      signal.signal(number, old)

  def _handle(self, *_):
    if self._set:
      raise KeyboardInterrupt
    self._set = True
    print("mjx-cl: stopping after this chunk, saving", file=sys.stderr, flush=True)

  def check(self) -> None:
    if self._set:
      raise KeyboardInterrupt
