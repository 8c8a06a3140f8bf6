"""What a log lacks: rows that its clock tells of, and columns that are silent for long, without
which the others are judged.
"""

from typing import Any, NamedTuple

import numpy as np

from mjx_cl.logs import healthy, verdict
from mjx_cl.logs.charts import CHARTS, SPANS
from mjx_cl.logs.clocks import gaps

LONG = SPANS[-1]  # samples for which a column is silent before it is named
MOST = LONG  # rows that a gap is filled up by
HALF = 0.5  # of its samples that are not judged: of such a column nothing is said

RARELY = "most of the samples are missing"


def places(seconds: np.ndarray | None) -> np.ndarray | None:
  """(T,) rows of the samples in an even series; None where no row is missing. A late time stamp
  that the next one makes up for is no gap.
  """
  if seconds is None or len(seconds) < 4:
    return None
  steps = np.diff(seconds)
  usual, wide = float(np.median(steps)), gaps(seconds)
  if not wide.any():
    return None
  beside = np.pad(np.minimum(steps, usual), 1, constant_values=usual)
  lacking = np.rint((steps + beside[:-2] + beside[2:]) / usual) - 3
  more = np.where(wide, np.clip(lacking, 0, MOST), 0).astype(int)
  return np.r_[0, np.cumsum(1 + more)] if more.any() else None


def evened(x: np.ndarray, at: np.ndarray | None) -> np.ndarray:
  """Samples (T, C) at their `places`, missing ones between."""
  if at is None:
    return x
  found = np.full((at[-1] + 1, x.shape[1]), np.nan, x.dtype)
  found[at] = x
  return found


def taken(found: verdict.Found, at: np.ndarray | None) -> verdict.Found:
  """What the charts show at the `places` of samples; an alarm between two counts at the next."""
  if at is None:
    return found
  begin = np.r_[0, at[:-1] + 1]
  return verdict.Found(
    found.residuals[:, at],
    {name: score[at] for name, score in found.scores.items()},
    {name: np.logical_or.reduceat(fired, begin) for name, fired in found.fired.items()},
    np.logical_or.reduceat(found.above, begin),
    found.known[at],
    found.xs[at],
  )


class Silent(NamedTuple):
  """Columns that are silent for long.

  Attributes:
    columns: bool (C,).
    rows: bool (T,), those in which one of them is, or was shortly before.
    stretches: of each column, (first row, row after the last); all rows where most are missing.
  """

  columns: np.ndarray
  rows: np.ndarray
  stretches: list[list[tuple[int, int]]]


def silent(x: np.ndarray, longest: np.ndarray) -> Silent:
  """Of a log (T, C), in which a healthy column is silent for up to `longest` (C,) rows; rows
  without any sample make none silent.
  """
  total, reach = len(x), max(*healthy.NOW, *healthy.BEFORE)
  rows = np.zeros(total, bool)
  stretches: list[list[tuple[int, int]]] = []
  there = np.isfinite(x)
  some = np.r_[0, np.cumsum(there.any(1))]  # rows before each that hold any sample
  for c, least in enumerate(longest):
    if there[:, c].all():
      stretches.append([])
      continue
    edges = np.r_[-1, np.flatnonzero(there[:, c]), total]
    begin, end = edges[:-1] + 1, edges[1:]
    size = some[end] - some[begin]
    long = size > max(LONG, least)
    own = list(zip(begin[long].tolist(), end[long].tolist()))
    lacking = np.maximum(0, size - (least if least > healthy.HELD else 0)).sum()
    if lacking > HALF * some[-1] >= sum(b - a for a, b in own):
      own = [(0, total)]
    for a, b in own:
      rows[a : b + reach] = True
    stretches.append(own)
  return Silent(np.array([bool(own) for own in stretches]), rows, stretches)


def without(
  own: verdict.Watch,
  found: verdict.Found,
  past: np.ndarray,
  xs: np.ndarray,
  lost: Silent,
  arl0: float,
  model: str,
) -> tuple[verdict.Found, verdict.Watch | None, verdict.Found | None, np.ndarray]:
  """Judges the other columns in the rows in which some are silent by a model that knows the others
  alone.

  Args:
    own: of all columns.
    found: by it.
    past: (N, C) nominal log.
    xs: (T, C).
    lost: its silent columns.
    arl0: as `verdict.calibrated` has it.
    model: likewise.

  Returns:
    (`found` with those rows replaced, the model, what it found in those rows, bool (C,) columns of
    it); None where no watched column is left.
  """
  keep = ~lost.columns
  watched = keep[: own.model.watched]
  found.above[lost.rows] = False
  if not watched.any():
    return found, None, None, keep
  other = verdict.calibrated(past[:, keep], arl0, model, int(keep.sum() - watched.sum()))
  seen = verdict.watch(other, xs[:, keep])
  seen.above[~lost.rows] = False
  at = np.ix_(lost.rows, watched)
  found.residuals[:, at[0], at[1]] = seen.residuals[:, lost.rows]
  found.known[at] = seen.known[lost.rows]
  for name in CHARTS:
    of = np.ones(1, bool) if name == "joint" else watched
    place = np.ix_(lost.rows, of)
    scale = own.thresholds[name][of] / other.thresholds[name]
    found.scores[name][lost.rows] = 0.0
    found.fired[name][lost.rows] = False
    found.scores[name][place] = seen.scores[name][lost.rows] * scale
    found.fired[name][place] = seen.fired[name][lost.rows]
  return found, other, seen, keep


def told(
  lost: Silent,
  names: list[str],
  seconds: np.ndarray | None,
  at_rows: np.ndarray | None,
  total: int,
) -> dict[str, str]:
  """Column -> when it has no samples, of `total` rows at `at_rows`, `places` of `seconds`."""

  def at(row: int) -> str:
    k = row if at_rows is None else int(np.searchsorted(at_rows, row))
    return f"sample {k:,}" if seconds is None else f"{seconds[k]:,.2f} s"

  said: dict[str, str] = {}
  for name, own in zip(names, lost.stretches):
    if not own:
      continue
    begin, end = own[0]
    if (begin, end) == (0, total):
      said[name] = RARELY
    elif begin == 0:
      said[name] = f"no samples before {at(end)}"
    elif end >= total:
      said[name] = f"no samples from {at(begin)} on"
    else:
      said[name] = f"no samples from {at(begin)} to {at(end)}"
    if len(own) > 1:
      said[name] += f", and {len(own) - 1} more such stretch{'es' * (len(own) > 2)}"
  return said


def ended(lost: Silent, names: list[str], total: int) -> list[str]:
  """Columns that have no samples any more at the end of `total` rows, as of a sensor that died."""
  return [name for name, own in zip(names, lost.stretches) if own and own[-1][1] >= total]


def unjudged(known: np.ndarray, names: list[str], why: dict[str, str]) -> dict[str, Any]:
  """Columns of which HALF of the samples (T, W) or more could not be judged -> the reason."""
  share = 1 - known.mean(0)
  rest = "too many of its samples, or of those that foretell it, are missing"
  return {name: why.get(name, rest) for name, one in zip(names, share) if one >= HALF}
