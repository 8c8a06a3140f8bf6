"""Ctrl-C and SIGTERM during a long run: noted at once, acted on between two chunks.

Raising inside a physics callback would surface as an XLA error with half a chunk lived; a flag lets the chunk end, the state be saved, and
then KeyboardInterrupt be raised.
"""
from __future__ import annotations

import signal
import sys
import threading


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
