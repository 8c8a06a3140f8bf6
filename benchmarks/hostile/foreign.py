"""Foreign code that hangs, ends the program, raises what is no Exception, or says what cannot be
read: as a detector, fault or robot out of a file, at each place where it is called.
"""

from __future__ import annotations

import pathlib
from typing import NamedTuple

import numpy as np

from benchmarks.hostile import room

# what goes wrong: name -> lines of Python
DEEDS = {
  "hangs": "while True: pass",
  "sleeps": "import time; time.sleep(10**6)",
  "waits": "import threading; threading.Event().wait()",
  "system exit": "raise SystemExit(3)",
  "system exit with text": "import sys; sys.exit('bye')",
  "keyboard interrupt": "raise KeyboardInterrupt",
  "generator exit": "raise GeneratorExit",
  "own base exception": "raise type('Mine', (BaseException,), {})('own')",
  "unreadable": "raise type('Dumb', (Exception,), {'__str__': lambda self: 1 / 0, '__repr__': lambda self: 1 / 0})()",
  "text of many lines": "raise ValueError('one\\ntwo\\n' * 500)",
  "control characters": "raise ValueError('\\x1b[31mred\\x07')",
  "without a message": "raise RuntimeError",
  "stop iteration": "raise StopIteration",
  "no disk": "import errno; raise OSError(errno.ENOSPC, 'No space left on device')",
  "recursion": "f = lambda: f(); f()",
  "chained": "\n{0}try: 1 / 0\n{0}except Exception as e: raise type('Worse', (BaseException,), {{}})() from e",
  "group": "raise BaseExceptionGroup('many', [SystemExit(1), KeyboardInterrupt()])",
  "noise": "print('noise'); import sys; print('noise', file=sys.stderr); raise ValueError('after noise')",
  "wrong answer": "return 'no answer'",
  "none": "return None",
}  # fmt: skip
HOST = """
{imported}
class Own:
  def __init__(self, threshold=3.0):
    self.threshold, self.score = threshold, 0.0
    {made}
  def update(self, x):
    self.score = abs(x)
    {called}
    return self.score > self.threshold
"""
JITTED = """
import jax.numpy as jnp
from mjx_cl.detectors.base import Alarm, Detector, scalar
{imported}
@scalar
def Own(threshold=3.0, warmup=0):
  {made}
  def init():
    {begun}
    return jnp.float32(0)
  def update(state, x):
    {called}
    score = jnp.abs(x)
    return state, Alarm(score > threshold, score)
  return Detector(init, update)
"""
FAULT = """
import jax.numpy as jnp
from mjx_cl.faults.base import actuator_targets, fault
{imported}
def Own(env):
  '''A command is halved. Severity: all. Target: an actuator. Owns `ctrl`. Memory: none. Source: none.'''
  {made}
  names, mask, single = actuator_targets(env)
  def act(hit, held, severity, key, ports):
    {called}
    return held, {{"ctrl": jnp.where(hit, ports.ctrl * (1 - 0.5 * severity), ports.ctrl)}}
  return fault("own", env, ("ctrl",), names, act, memory=jnp.zeros(1), drawn=single, rows=mask)
"""
ROBOT = """
{imported}
from mjx_cl.envs.walker import Walker
class Own(Walker):
  def __init__(self, physics="auto"):
    {made}
    super().__init__(physics)
  def init(self, model, key):
    {begun}
    return super().init(model, key)
  def step(self, model, state, action):
    {called}
    return super().step(model, state, action)
"""


class Place(NamedTuple):
  """Where foreign code is called.

  Attributes:
    text: of its file.
    words: of the command that calls it.
    places: fields of the text that it is put into.
  """

  text: str
  words: list[str]
  places: tuple[str, ...] = ("imported", "made", "called")


DETECT = [
  "detect",
  "log.csv",
  "--nominal",
  "nominal.csv",
  "--arl0",
  "200",
  "--out",
  "out",
  "--detector",
  "hostile.py:Own",
]
PLACES = {
  "host detector, detect": Place(HOST, DETECT),
  "host detector, leaderboard": Place(HOST, ["leaderboard", "set", "--detector", "none", "--add", "hostile.py:Own",
                                             "--out", "out"]),
  "detector, leaderboard": Place(JITTED, ["leaderboard", "set", "--detector", "hostile.py:Own", "--out", "out"],
                                 ("imported", "made", "begun", "called")),
  "detector, run": Place(JITTED, [*room.RUN[:-4], "--detector", "hostile.py:Own", "--out", "out"],
                         ("imported", "made", "begun", "called")),
  "fault, run": Place(FAULT, [*room.RUN, "--fault", "hostile.py:Own", "--out", "out"]),
  "fault, certify": Place(FAULT, ["certify", "walker", "--fault", "hostile.py:Own", "--episodes", "0", "--out", "out"]),
  "robot, run": Place(ROBOT, ["run", "hostile.py:Own", *room.RUN[2:], "--out", "out"],
                      ("imported", "made", "begun", "called")),
  "robot, eval": Place(ROBOT, ["eval", "hostile.py:Own", "--agent", "agent", "--episodes", "1"],
                       ("imported", "made", "begun", "called")),
  "robot, render": Place(ROBOT, ["render", "hostile.py:Own", "--agent", "agent", "--steps", "4", "--out", "out/o.gif"],
                         ("imported", "made", "begun", "called")),
}  # fmt: skip


# (place, field, deed)
EVERY = [(p, field, deed) for p, one in PLACES.items() for field in one.places for deed in DEEDS]


def draw(seed: int, number: int) -> tuple[str, str, str]:
  """(place, field, deed) of a case; all meet as the number rises."""
  return EVERY[np.random.default_rng(seed).permutation(len(EVERY))[number % len(EVERY)]]


def write(place: str, field: str, deed: str, folder: pathlib.Path) -> list[str]:
  """Writes hostile.py; gives the words of the command."""
  one = PLACES[place]
  lines = DEEDS[deed]
  line = next(x for x in one.text.splitlines() if f"{{{field}}}" in x)
  indent = line[: len(line) - len(line.lstrip())]
  if deed == "chained":
    lines = lines.format(indent)
  if field == "imported" and lines.startswith("return"):
    lines = "Own = 7"
  names = ("imported", "made", "begun", "called")
  text = one.text.format(**{name: lines if name == field else "pass" for name in names})
  if deed in ("wrong answer", "none") and field == "imported":
    text += "\nOwn = 7\n"
  (folder / "hostile.py").write_text(text)
  (folder / "out").mkdir()
  return list(one.words)
