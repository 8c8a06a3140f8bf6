"""Detectors of one's own in plain Python, run over recorded streams on the host: no JAX, no vmap,
one object per stream.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.detectors.base import Alarm, Detector
from mjx_cl.detectors.combine import NAMES, is_channel, on
from mjx_cl.errors import UserError
from mjx_cl.io.apart import apart, check_causal, fresh, run_host
from mjx_cl.io.plugins import find
from mjx_cl.rollout.monitor import Residual


class HostDetector(NamedTuple):
  """A plain Python detector and what it watches.

  Attributes:
    factory: () -> object with `update(x: float)`, a fresh one for each stream.
    host_name: its name in results.
    channel: what it watches, one of combine.CHANNELS.
    log: whether it is given ln max(x, 1e-9).
    source: what `load` found it by, "": none.
    settings: keyword arguments of `source`.
  """

  factory: Callable[[], Any]
  host_name: str
  channel: str = "opr"
  log: bool = False
  source: str = ""
  settings: dict | None = None


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
  host = HostDetector(lambda: build(**settings), host_name or name, channel, log, source, settings)
  fresh(host.factory, host.host_name)
  return host


def run(host: HostDetector, xs: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
  """`run_host` of (T, S) and the seconds that it took; one that was loaded by name runs in a
  process of its own.
  """
  if host.source:
    return apart(host.source, host.settings or {}, xs, host.host_name)
  begin = time.perf_counter()
  return *run_host(host.factory, xs, host.host_name), time.perf_counter() - begin


def causal(host: HostDetector, xs: np.ndarray) -> None:
  """`check_causal`, likewise."""
  if host.source:
    apart(host.source, host.settings or {}, xs, host.host_name, causal=True)
  else:
    check_causal(host.factory, xs, host_name=host.host_name)


def samples(host: HostDetector, residual: Residual) -> np.ndarray:
  """float32 (T, S): what `host` is given of a recorded monitor.Residual with leading (T, S); nan
  where `on` would mask the sample.
  """
  echo = Detector(lambda: (), lambda state, x: (state, Alarm(jnp.bool_(False), x)))
  look = lambda row: on(host.channel, echo, host.log).update((), row)[1].score
  return np.asarray(jax.jit(jax.vmap(jax.vmap(look)))(residual))
