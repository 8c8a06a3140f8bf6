"""Plain Python detectors in a process of their own: the same answers, and an end to each."""

import os
import signal
import threading

import numpy as np
import psutil
import pytest

from mjx_cl.errors import UserError
from mjx_cl.io import apart, interrupt

XS = np.random.default_rng(0).normal(size=(40, 3))
XS[5, 1] = np.nan
HONEST = """
class Honest:
  def __init__(self, level=1.0): self.level, self.score = level, 0.0
  def update(self, x):
    print("what it prints is no answer")
    self.score += x / 3
    return self.score > self.level
"""
FAILS = {
  "import sys; sys.exit(0)": "failed at step 2 of stream 0: SystemExit: 0",
  "raise KeyboardInterrupt": "failed at step 2 of stream 0: KeyboardInterrupt",
  "class Own(BaseException): pass\n      raise Own('gone')": "step 2 of stream 0: Own: gone",
  "class Own(Exception):\n        def __str__(self): raise ValueError\n      raise Own": (
    "step 2 of stream 0: Own: its message cannot be read"
  ),
  "raise ValueError('[/red] two\\nlines')": (
    r"ValueError: \[/red\] two lines \(.*mine\.py, line 6\)"
  ),
  "import os; os._exit(0)": "ended its process, exit status 0, without an answer",
  "import os; os.kill(os.getpid(), 9)": "ended its process, exit status -9",
  "return 'yes'": "update must tell a bool, not str",
}
HANGS = {
  "while True: pass": "step 2 of stream 0 takes more than 1 s",
  "import time; time.sleep(1e6)": "step 2 of stream 0 takes more than 1 s",
  # holds the interpreter's lock, so that not even the thread that says where it is gets on
  "import re; re.match('(a+)+$', 'a' * 60 + 'b')": "takes more than 1 s",
}


@pytest.fixture
def detector(tmp_path):
  """detector(body): name of a class whose third update is `body`."""

  def write(body):
    (tmp_path / "mine.py").write_text(
      f"class Mine:\n  n = 0\n  def update(self, x):\n    self.n += 1\n    if self.n == 3:\n"
      f"      {body}\n    return False\n"
    )
    return f"{tmp_path / 'mine.py'}:Mine"

  return write


def test_it_answers_as_in_this_process(tmp_path):
  (tmp_path / "mine.py").write_text(HONEST)
  source = f"{tmp_path / 'mine.py'}:Honest"
  fired, score, seconds = apart.apart(source, {"level": 0.5}, XS, "honest")
  build = apart.find(source, "host detector")
  want = apart.run_host(lambda: build(0.5), XS)
  np.testing.assert_array_equal(fired, want[0])
  np.testing.assert_array_equal(score, want[1])
  assert fired.any() and not fired.all() and np.isnan(score[5, 1]) and seconds > 0
  apart.apart(source, {}, XS, "honest", causal=True)
  (tmp_path / "mine.py").write_text(
    HONEST.replace("self.score += x", "Honest.n += 1; self.score += x * Honest.n").replace(
      "  def __init__", "  n = 0\n  def __init__"
    )
  )
  with pytest.raises(UserError, match="not causal"):
    apart.apart(source, {}, XS, "honest", causal=True)


@pytest.mark.parametrize("body", FAILS)
def test_whatever_it_does_is_one_line(detector, body):
  with pytest.raises(UserError, match=FAILS[body]) as error:
    apart.apart(detector(body), {}, XS, "mine")
  assert "\n" not in str(error.value) and not psutil.Process().children()


@pytest.mark.parametrize("body", HANGS)
def test_what_never_returns_is_ended_and_named(detector, body):
  with pytest.raises(UserError, match=HANGS[body]):
    apart.apart(detector(body), {}, XS, "mine", sample_s=1.0)
  assert not psutil.Process().children()


def test_the_whole_has_a_limit_too(detector):
  with pytest.raises(UserError, match="takes more than 0.1 s; at .* it was ended"):
    apart.apart(detector("import time; time.sleep(1e6)"), {}, XS, "mine", whole_s=0.1)


def test_an_interrupt_ends_it(detector, monkeypatch):
  begun, inner = threading.Event(), apart._wait
  monkeypatch.setattr(apart, "_wait", lambda *given: begun.set() or inner(*given))

  def send():
    begun.wait()
    os.kill(os.getpid(), signal.SIGINT)

  threading.Thread(target=send).start()
  with pytest.raises(KeyboardInterrupt):
    apart.apart(detector("while True: pass"), {}, XS, "mine")
  assert not psutil.Process().children()


def test_threads_that_never_end_are_not_waited_for():
  over, begun = threading.Event(), threading.Event()
  with pytest.raises(KeyboardInterrupt), interrupt.threads(1) as pool:
    pool.submit(lambda: begun.set() or over.wait())
    begun.wait()
    never = pool.submit(lambda: 1)
    raise KeyboardInterrupt
  assert never.cancelled()
  over.set()
  with interrupt.threads(2) as pool:
    assert list(pool.map(abs, (-1, 2))) == [1, 2]
