"""The streams of a robot laid out one after the other, as the programs of detectors read them."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import numpy as np

from mjx_cl.leaderboard.streams import StreamSet
from mjx_cl.rollout.monitor import Residual

LANES, LANES_SHARED = 80, 20  # side by side: of one threshold each, or of thresholds.TOGETHER
LEVELS = 5  # thresholds that fault streams are run at: the calibrated one and those of the curve


class Samples(NamedTuple):
  """The streams of one robot, one after the other.

  Attributes:
    residual: monitor.Residual with leading (N,), unknown rows at the end.
    steps: of each healthy stream.
    horizon: of each fault stream, from its onset.
    healthy: int (S,), first row of each healthy stream, those that tune first.
    past: int (P,), first row of each past.
    onset: int (P,), steps of each past.
    fault: int (F,), row of each fault stream's onset.
    owner: int (F,), past of each fault stream.
  """

  residual: Any
  steps: int
  horizon: int
  healthy: np.ndarray
  past: np.ndarray
  onset: np.ndarray
  fault: np.ndarray
  owner: np.ndarray


class Room(NamedTuple):
  """Sizes that serve all robots of a set, so that none is compiled anew.

  Attributes:
    samples: rows of Samples.
    rows: output rows by number of lanes.
    pasts: of fault streams.
  """

  samples: int
  rows: dict[int, int]
  pasts: int


def room(streams: StreamSet, robots: Iterable[str]) -> Room:
  """Room for these robots of a set; a robot whose streams share fewer pasts than their seeds takes
  more, and compiles anew.
  """
  m, samples, pasts, rows = streams.meta, 0, 0, {LANES: 0, LANES_SHARED: 0}
  for robot in robots:
    nominal = np.isin(m["stream"], streams.find(robot, "nominal"))
    fault = np.isin(m["stream"], streams.find(robot, "fault", "score"))
    most, number = streams.extent(robot)
    seeds, longest = len(np.unique(m["seed"][fault])), int(m["steps"][nominal].max())
    horizon = int(streams.suite.horizon_s / m["control_s"][fault].min() + 1e-6)
    samples = max(samples, int(nominal.sum()) * longest + seeds * most + number * horizon + 1)
    pasts = max(pasts, seeds)
    for lanes, copies in ((LANES, LEVELS), (LANES_SHARED, 1)):
      own = -(-copies * seeds // lanes) * most + -(-copies * number // lanes) * horizon
      rows[lanes] = max(rows[lanes], longest, own)
  return Room(samples, rows, pasts)


def _owners(fault: Residual, onset: np.ndarray, seed: np.ndarray) -> tuple[list[int], np.ndarray]:
  """(a fault stream of each past, past of each fault stream): streams of one seed and onset share
  a past where it is the same in all residuals.
  """
  leaves = jax.tree.leaves(fault)
  same = lambda a, b, steps: all(
    np.array_equal(x[:steps, a], x[:steps, b], equal_nan=x.dtype.kind == "f") for x in leaves
  )
  lanes: list[int] = []
  owner: list[int] = []
  for column, (first, number) in enumerate(zip(onset, seed)):
    shares = lambda k, first=first, number=number, column=column: (
      onset[lanes[k]] == first and seed[lanes[k]] == number and same(lanes[k], column, first)
    )
    owner.append(next(filter(shares, range(len(lanes))), len(lanes)))
    if owner[-1] == len(lanes):
      lanes.append(column)
  return lanes, np.asarray(owner, int)


def samples(
  nominal: Residual,
  fault: Residual,
  onset: np.ndarray,
  seed: np.ndarray,
  horizon: int,
  most: int = 0,
) -> Samples:
  """Samples of healthy streams (T, S) and fault streams (T, F).

  Args:
    nominal: monitor.Residual, NumPy.
    fault: monitor.Residual, NumPy.
    onset: int (F,).
    seed: int (F,).
    horizon: steps kept from the onset on.
    most: rows to fill up to.
  """
  lanes, owner = _owners(fault, onset, seed)
  steps, streams = nominal.opr.shape
  past, after = onset[lanes].astype(int), np.full(len(onset), horizon)
  starts = np.concatenate([[0], np.cumsum(np.concatenate([np.full(streams, steps), past, after]))])
  total, cut = max(int(starts[-1]) + 1, most), streams + len(lanes)

  def flat(a: np.ndarray, b: np.ndarray) -> jax.Array:
    out = np.full((total,) + a.shape[2:], False if a.dtype == bool else np.nan, a.dtype)
    out[: streams * steps] = np.swapaxes(a, 0, 1).reshape((streams * steps,) + a.shape[2:])
    for at, column, n in zip(starts[streams:], lanes, past):
      out[at : at + n] = b[:n, column]
    for column, at in enumerate(starts[cut:-1]):
      part = b[onset[column] : onset[column] + horizon, column]
      out[at : at + len(part)] = part
    return jax.device_put(out)

  return Samples(
    jax.tree.map(flat, nominal, fault),
    steps,
    horizon,
    starts[:streams],
    starts[streams:cut],
    past,
    starts[cut:-1],
    owner,
  )
