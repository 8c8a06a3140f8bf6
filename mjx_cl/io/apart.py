"""Detectors of one's own in plain Python over recorded streams, sample by sample: here, or in a
process of their own, which can be ended whatever they do. Free of JAX.
"""

import contextlib
import ctypes
import io
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, BinaryIO

import numpy as np

from mjx_cl.errors import UserError
from mjx_cl.io.limits import ran_out
from mjx_cl.io.plugins import find, line, of_user, placed

BEAT_S = 0.5  # how often a process says how far it is
SAMPLE_S, WHOLE_S = 10.0, 3600.0  # that a sample and a whole run may take
BEGIN_S = 120.0  # that importing the detector may take


def fresh(factory: Callable[[], Any], host_name: str) -> Any:
  """What `factory` gives; UserError, one line, where that is no detector."""
  try:
    detector = factory()
  except BaseException as e:
    if of_user(e):
      raise
    raise UserError(f"host detector {host_name} cannot be built: {line(e)}") from None
  if not callable(getattr(detector, "update", None)) or isinstance(detector, type):
    raise UserError(f"host detector {host_name}: {type(detector).__name__} has no method update(x)")
  return detector


def step(detector: Any, x: float) -> tuple[bool, float]:
  """One sample; TypeError where the answer is no answer."""
  answer = detector.update(x)
  if answer is None or answer is detector:
    if not hasattr(detector, "drift_detected"):
      raise TypeError("update gave no bool, and there is no attribute drift_detected")
    answer = detector.drift_detected
  if not isinstance(answer, (bool, np.bool_)):
    raise TypeError(f"update must tell a bool, not {type(answer).__name__}")
  score = getattr(detector, "score", None)
  return bool(answer), float("nan") if score is None or callable(score) else float(score)


def run_host(
  factory: Callable[[], Any],
  xs: np.ndarray,
  host_name: str | None = None,
  at: list[int] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
  """Runs a plain Python detector over recorded streams, sample by sample, a fresh object for each.

    fired[t, s] = what `update(xs[t, s])` returns, a bool; where it returns None or the object
    itself (river's detectors): its `drift_detected`
    score[t, s] = its attribute `score` after that, a float, larger is more suspect; nan where it
    has none or it is None

  A sample that is no finite number is skipped: the object is not called, fired is False, score nan,
  as with every other detector here. What an object does after its alarm (start anew or not) is its
  own affair.

  Args:
    factory: () -> object with `update(x: float)`.
    xs: (T, S), samples of S streams.
    host_name: for messages; default: the name of the class.
    at: tells (stream, step) that it is at.

  Returns:
    (fired bool (T, S), score float64 (T, S)).

  Raises:
    UserError, one line with class, step and stream, for whatever the object raises and for an
    answer that is no bool.
  """
  xs = np.asarray(xs, np.float64)
  if xs.ndim != 2:
    raise UserError(f"run_host takes streams of shape (T, S); got {xs.shape}")
  fired, scores = np.zeros(xs.shape, bool), np.full(xs.shape, np.nan)
  objects: list[Any] = []
  at = [0, -1] if at is None else at
  for s in range(xs.shape[1]):
    at[:] = s, -1
    detector = fresh(factory, host_name or str(getattr(factory, "__name__", "of your own")))
    if any(detector is other for other in objects):
      raise UserError(
        f"host detector {type(detector).__name__}: the factory gave the same object twice; "
        "each stream needs one of its own"
      )
    objects.append(detector)
    for t in np.flatnonzero(np.isfinite(xs[:, s])):
      at[1] = int(t)
      try:
        fired[t, s], scores[t, s] = step(detector, float(xs[t, s]))
      except BaseException as e:
        if of_user(e):
          raise
        raise UserError(
          f"host detector {type(detector).__name__} failed at step {t} of stream {s}: {placed(e)}"
        ) from None
  return fired, scores


def check_causal(
  factory: Callable[[], Any],
  xs: np.ndarray,
  cuts: tuple[int, ...] | None = None,
  host_name: str | None = None,
  at: list[int] | None = None,
) -> None:
  """Refuses a detector whose past answers depend on what came later, on other streams, on an
  earlier run, or on chance.

    run_host(xs[:n])[t] must equal run_host(xs)[t] for t < n, to the bit, for each n of `cuts` and
    each stream by itself

  An `init`/`update` pair cannot fail this; a class with shared state, a file read ahead, a clock or
  an unseeded random number can.

  Args:
    factory: as in `run_host`.
    xs: (T, S).
    cuts: lengths of the beginnings; default: a quarter, a half, and the whole once more.
    host_name: as in `run_host`.
    at: likewise.

  Raises:
    UserError that names class, step and stream of the first difference.
  """
  xs = np.asarray(xs, np.float64)
  whole = run_host(factory, xs, host_name, at)
  for n in cuts or (len(xs) // 4, len(xs) // 2, len(xs)):
    for s in range(xs.shape[1]):
      part = run_host(factory, xs[:n, s : s + 1], host_name, at)
      differ = (part[0][:, 0] != whole[0][:n, s]) | ~(
        (part[1][:, 0] == whole[1][:n, s]) | (np.isnan(part[1][:, 0]) & np.isnan(whole[1][:n, s]))
      )
      if differ.any():
        name = type(fresh(factory, host_name or "")).__name__
        raise UserError(
          f"host detector {name} is not causal: at step {int(differ.argmax())} of stream {s} "
          "it answers otherwise when the stream ends "
          f"after {n} samples than in the whole run (shared state, chance without a seed, or a "
          "look ahead)"
        )


def apart(
  source: str,
  settings: dict,
  xs: np.ndarray,
  host_name: str,
  causal: bool = False,
  sample_s: float = SAMPLE_S,
  whole_s: float = WHOLE_S,
) -> tuple[np.ndarray, np.ndarray, float]:
  """`run_host`, or with `causal` `check_causal`, in a process of its own, which ends with what
  waits for it.

  Args:
    source: "module:Class" or "path/to/file.py:Class".
    settings: keyword arguments of the class.
    xs: (T, S).
    host_name: for messages.
    causal: whether to check that alone; gives empty arrays.
    sample_s: seconds that a sample, or building an object, may take.
    whole_s: seconds that the whole may take.

  Raises:
    UserError: as those, and where the time is over, or the process ended.
    MemoryError: where the process lacked memory.
  """
  how = {"source": source, "settings": settings, "name": host_name, "causal": causal}
  process: Any = subprocess.Popen(
    [sys.executable, "-m", "mjx_cl.io.apart", json.dumps(how)],
    stdin=subprocess.PIPE,
    stdout=subprocess.PIPE,
    env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    start_new_session=True,  # Ctrl-C reaches the parent alone
  )
  said: queue.SimpleQueue[bytes] = queue.SimpleQueue()

  def listen() -> None:
    for text in process.stdout:
      said.put(text)
      if text.startswith(b"{"):  # the last line; arrays follow it
        said.put(process.stdout.read())
        break
    said.put(b"")

  threading.Thread(target=listen, daemon=True).start()
  try:
    with contextlib.suppress(OSError):  # it is gone already: `wait` says so
      process.stdin.write(_packed(np.asarray(xs, np.float64)))
      process.stdin.close()
    return _wait(process, said, host_name, sample_s, whole_s)
  finally:
    process.kill()
    process.wait()


def _wait(
  process: Any, said: queue.SimpleQueue[bytes], host_name: str, sample_s: float, whole_s: float
) -> tuple[np.ndarray, np.ndarray, float]:
  """What a process answers, as long as it gets on."""
  where, beats, beats_in_all = b"", 0, 0
  named = f"host detector {host_name}"
  while True:
    try:
      text = said.get(timeout=BEGIN_S if not where else sample_s + 4 * BEAT_S)
    except queue.Empty:  # not even the thread that says where it is gets on
      last = where.decode().split()
      at = f"after step {last[1]} of stream {last[0]} it" if last else "importing it"
      limit = sample_s if last else BEGIN_S
      raise UserError(f"{named}: {at} takes more than {limit:g} s") from None
    if not text:
      code = process.wait()
      raise UserError(f"{named} ended its process, exit status {code}, without an answer")
    if text.startswith(b"{"):
      answer = json.loads(text)
      if "error" in answer:
        raise UserError(answer["error"])
      if "memory" in answer:
        raise MemoryError(answer["memory"])
      arrays = io.BytesIO(said.get())
      fired, score = (np.load(arrays, allow_pickle=False) for _ in range(2))
      return fired, score, answer["seconds"]
    beats, beats_in_all = (beats + 1 if text == where else 0), beats_in_all + 1
    where = text
    stream, step = where.decode().split()
    place = (
      f"step {step} of stream {stream}" if step != "-1" else f"building it for stream {stream}"
    )
    if beats * BEAT_S > sample_s:
      raise UserError(f"{named}: {place} takes more than {sample_s:g} s")
    if beats_in_all * BEAT_S > whole_s:
      raise UserError(f"{named} takes more than {whole_s:g} s; at {place} it was ended")


def _packed(array: np.ndarray) -> bytes:
  out = io.BytesIO()
  np.save(out, array, allow_pickle=False)
  return out.getvalue()


def _answer(how: dict, out: BinaryIO) -> None:
  xs = np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False)
  at, over = [0, -1], threading.Event()

  def beat() -> None:
    while True:
      out.write(f"{at[0]} {at[1]}\n".encode())
      out.flush()
      if over.wait(BEAT_S):
        break

  thread = threading.Thread(target=beat, daemon=True)
  empty = np.zeros((0, 0))
  said: dict[str, Any] = {}
  fired, score = empty, empty
  begin = time.perf_counter()
  try:
    build = find(how["source"], "host detector")
    begin = time.perf_counter()
    factory = lambda: build(**how["settings"])
    thread.start()
    if how["causal"]:
      check_causal(factory, xs, host_name=how["name"], at=at)
    else:
      fired, score = run_host(factory, xs, how["name"], at)
  except UserError as e:
    said = {"error": str(e)}
  except Exception as e:
    if not ran_out(e):
      raise
    said = {"memory": line(e)}
  over.set()
  if thread.ident:
    thread.join()
  said["seconds"] = time.perf_counter() - begin
  out.write(json.dumps(said).encode() + b"\n")
  for array in (fired, score):
    out.write(_packed(array))
  out.flush()


def main(argument: str) -> None:
  """Answers on what was standard output; whatever else is printed goes to standard error."""
  if sys.platform == "linux":  # it ends with its parent, also where that is killed
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG, prctl(2)
  signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt is the parent's affair
  with os.fdopen(os.dup(1), "wb") as out:
    os.dup2(2, 1)
    _answer(json.loads(argument), out)


if __name__ == "__main__":
  main(sys.argv[1])
