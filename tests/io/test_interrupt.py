"""Signals: what is said as one comes must not cost the save."""

import contextlib
import io
import signal
import subprocess
import sys
import time
import weakref

import pytest

from mjx_cl.cli import app
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


IN_C = """
import hashlib, signal, sys
from mjx_cl.io.interrupt import enforced
signal.signal(signal.SIGINT, lambda *_: None)  # one that raises could come before the C code does
with enforced(0.2):
  print("begun", flush=True)
  hashlib.pbkdf2_hmac("sha256", b"", b"", int(sys.argv[1]))  # Python hears nothing meanwhile
print("ended", flush=True)
"""


@pytest.mark.parametrize("signals, rounds", [(1000, 10**9), (1, 10**6), (0, 1)])
def test_a_second_signal_ends_what_hears_none(signals, rounds):
  process = subprocess.Popen(
    [sys.executable, "-c", IN_C, str(rounds)],
    stdout=subprocess.PIPE,
    stderr=subprocess.PIPE,
    text=True,
  )
  assert process.stdout.readline() == "begun\n"
  for _ in range(signals):
    process.send_signal(signal.SIGINT)  # one that another is waiting before counts as the same
    with contextlib.suppress(subprocess.TimeoutExpired):
      process.wait(0.05)
      break
  out, err = process.communicate(timeout=60)
  stopped = signals > 1
  assert process.returncode == (130 if stopped else 0), err
  assert (out, err) == (("", "mjx-cl: interrupted\n") if stopped else ("ended\n", ""))


def in_a_callback():
  """Ctrl-C within a weak reference's callback, where Python drops what is raised."""
  thing = io.StringIO()
  kept = weakref.ref(thing, lambda _: signal.raise_signal(signal.SIGINT))
  del thing
  for _ in range(6000):
    time.sleep(0.01)
  return kept


def dropped():
  """Ctrl-C that C code drops."""
  with contextlib.suppress(KeyboardInterrupt):
    signal.raise_signal(signal.SIGINT)
  with Interruptible() as interrupt:
    interrupt.check()


@pytest.mark.parametrize("do", [in_a_callback, dropped])
def test_an_interrupt_that_is_dropped_is_not_lost(do, capsys):
  old = signal.signal(signal.SIGINT, signal.default_int_handler)  # the caller's may be another
  try:
    assert app.attempt(do) == 130
  finally:
    signal.signal(signal.SIGINT, old)
  assert capsys.readouterr().err == "mjx-cl: interrupted\n"
  with Interruptible() as interrupt:  # the next command is its own
    interrupt.check()
