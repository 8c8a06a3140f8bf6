"""Detectors of one's own in plain Python, run over recorded streams on the host: no JAX, no vmap,
one object per stream.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.detectors.base import Alarm, Detector
from mjx_cl.detectors.combine import NAMES, is_channel, on
from mjx_cl.errors import UserError
from mjx_cl.io import limits
from mjx_cl.io.plugins import find, line
from mjx_cl.rollout.monitor import Residual


class HostDetector(NamedTuple):
  """A plain Python detector and what it watches.

  Attributes:
    factory: () -> object with `update(x: float)`, a fresh one for each stream.
    host_name: its name in results.
    channel: what it watches, one of combine.CHANNELS.
    log: whether it is given ln max(x, 1e-9).
  """

  factory: Callable[[], Any]
  host_name: str
  channel: str = "opr"
  log: bool = False


def load(
  source: str,
  settings: dict | None = None,
  host_name: str | None = None,
  channel: str = "opr",
  log: bool = False,
) -> HostDetector:
  """Finds a class, or any function that builds detectors, and tries it once.

  Args:
    source: "module:Class" or "path/to/file.py:Class".
    settings: keyword arguments of the class.
    host_name: default: the name after the colon.
    channel: as in `combine.on`.
    log: as in `combine.on`.

  Raises:
    UserError, one line: no such module, file, class or channel, refused settings, an object without
      `update`.
  Example: load("river.drift:PageHinkley", {"threshold": 20.0, "mode": "up"})
  """
  if not is_channel(channel):
    raise UserError(f"unknown channel {channel!r}; choose from: {NAMES}")
  build, name = find(source, "host detector"), source.rpartition(":")[2]
  settings = dict(settings or {})
  host = HostDetector(lambda: build(**settings), host_name or name, channel, log)
  _fresh(host.factory, host.host_name)
  return host


def _fresh(factory: Callable[[], Any], host_name: str) -> Any:
  try:
    detector = factory()
  except (Exception, SystemExit) as e:
    raise UserError(f"host detector {host_name} cannot be built: {line(e)}") from None
  if not callable(getattr(detector, "update", None)) or isinstance(detector, type):
    raise UserError(f"host detector {host_name}: {type(detector).__name__} has no method update(x)")
  return detector


def _step(detector: Any, x: float) -> tuple[bool, float]:
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
  factory: Callable[[], Any], xs: np.ndarray, host_name: str | None = None
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
  for s in range(xs.shape[1]):
    detector = _fresh(factory, host_name or str(getattr(factory, "__name__", "of your own")))
    if any(detector is other for other in objects):
      raise UserError(
        f"host detector {type(detector).__name__}: the factory gave the same object twice; "
        "each stream needs one of its own"
      )
    objects.append(detector)
    for t in np.flatnonzero(np.isfinite(xs[:, s])):
      try:
        fired[t, s], scores[t, s] = _step(detector, float(xs[t, s]))
      except (Exception, SystemExit) as e:
        if limits.ran_out(e):
          raise
        raise UserError(
          f"host detector {type(detector).__name__} failed at step {t} of stream {s}: {line(e)}"
        ) from None
  return fired, scores


def check_causal(
  factory: Callable[[], Any],
  xs: np.ndarray,
  cuts: tuple[int, ...] | None = None,
  host_name: str | None = None,
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

  Raises:
    UserError that names class, step and stream of the first difference.
  """
  xs = np.asarray(xs, np.float64)
  whole = run_host(factory, xs, host_name)
  for n in cuts or (len(xs) // 4, len(xs) // 2, len(xs)):
    for s in range(xs.shape[1]):
      part = run_host(factory, xs[:n, s : s + 1], host_name)
      differ = (part[0][:, 0] != whole[0][:n, s]) | ~(
        (part[1][:, 0] == whole[1][:n, s]) | (np.isnan(part[1][:, 0]) & np.isnan(whole[1][:n, s]))
      )
      if differ.any():
        name = type(_fresh(factory, host_name or "")).__name__
        raise UserError(
          f"host detector {name} is not causal: at step {int(differ.argmax())} of stream {s} "
          "it answers otherwise when the stream ends "
          f"after {n} samples than in the whole run (shared state, chance without a seed, or a "
          "look ahead)"
        )


def samples(host: HostDetector, residual: Residual) -> np.ndarray:
  """float32 (T, S): what `host` is given of a recorded monitor.Residual with leading (T, S); nan
  where `on` would mask the sample.
  """
  echo = Detector(lambda: (), lambda state, x: (state, Alarm(jnp.bool_(False), x)))
  look = lambda row: on(host.channel, echo, host.log).update((), row)[1].score
  return np.asarray(jax.jit(jax.vmap(jax.vmap(look)))(residual))
