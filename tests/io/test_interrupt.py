"""Signals: what is said as one comes must not cost the save."""

import io
import signal
import sys

import pytest

from mjx_cl.io.interrupt import Interruptible, Lasting


class Signalling(io.RawIOBase):
  """A raw stream during whose first write Ctrl-C comes."""

  def __init__(self):
    self.written = []

  def writable(self):
    return True

  def write(self, data):
    self.written.append(bytes(data))
    if len(self.written) == 1:
      signal.raise_signal(signal.SIGINT)
    return len(data)


def test_a_signal_within_a_write_is_acted_on_between_two_chunks(monkeypatch):
  raw = Signalling()
  stream = io.TextIOWrapper(io.BufferedWriter(raw), line_buffering=True)
  monkeypatch.setattr(sys, "stderr", Lasting(stream))
  with Interruptible() as interrupt:
    print("a line of progress", file=sys.stderr)
    with pytest.raises(KeyboardInterrupt):
      interrupt.check()
  assert b"".join(raw.written) == b"a line of progress\n"
