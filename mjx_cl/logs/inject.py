"""Which faults a nominal log would show: they are put into it, one column at a time.

A fault counts as seen at a severity where it gives an alarm within the time asked for in SEEN of
the places that it is put into, and at all greater severities too. Places are spread over the
nominal log; each is judged by a model that was fitted to the other fifths of the log, and is left
out where the log gives an alarm by itself.
"""

from typing import Any

import numpy as np

from mjx_cl.logs import charts, healthy
from mjx_cl.logs.charts import SPANS
from mjx_cl.logs.verdict import Watch

PLACES = 10  # that each fault is put into
SEEN = 0.8
BEFORE = 2 * SPANS[-1]  # healthy samples before each
DEVIATIONS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
# kind -> (severities, what they are)
KINDS: dict[str, tuple[tuple[float, ...], str]] = {
  "bias": (DEVIATIONS, "nominal deviations added"),
  "drift": (DEVIATIONS, "nominal deviations that it grows by within the time asked for"),
  "scale": ((0.02, 0.05, 0.1, 0.2, 0.5, 1.0), "share that all values grow by"),
  "noise": (DEVIATIONS, "nominal deviations of normal noise"),
  "freeze": ((1.0,), "the last value is held"),
  "dropout": ((0.02, 0.05, 0.1, 0.2, 0.5), "share of samples that read zero"),
  "delay": ((1.0, 2.0, 5.0, 10.0, 20.0), "samples"),
}


def spoiled(
  x: np.ndarray, kind: str, severity: float, at: int, spread: float, rng: np.random.Generator
) -> np.ndarray:
  """A column x (..., T) with a fault from sample `at` on; `spread`: a nominal deviation."""
  x, rest = x.copy(), x[..., at:]
  steps = rest.shape[-1]
  x[..., at:] = {
    "bias": lambda: rest + severity * spread,
    "drift": lambda: rest + severity * spread * np.arange(1, steps + 1) / steps,
    "scale": lambda: rest * (1 + severity),
    "noise": lambda: rest + severity * spread * rng.normal(size=rest.shape),
    "freeze": lambda: np.broadcast_to(x[..., at - 1 : at], rest.shape),
    "dropout": lambda: np.where(rng.random(rest.shape) < severity, 0.0, rest),
    "delay": lambda: x[..., at - int(severity) : at - int(severity) + steps],
  }[kind]()
  return x


def _places(rows: int, within: int) -> list[tuple[int, int]]:
  """(first row, fold) of stretches of BEFORE + within rows, each within one fold."""
  length, found = BEFORE + within, []
  for k, share in enumerate(healthy.folds(rows)):
    room = share.stop - share.start - length
    if room >= 0:
      each = PLACES // healthy.FOLDS
      found += [(share.start + int(at), k) for at in np.linspace(0, room, each)]
  return found


def _alarmed(own: Watch, xs: np.ndarray, since: np.ndarray, folds: np.ndarray) -> np.ndarray:
  """Bool (B,): whether stretches (B, BEFORE + within, C) give an alarm after BEFORE; since: (B,
  BEFORE + within, W), as of `healthy.since`.
  """
  rows = np.arange(xs.shape[1])[:, None]
  found = np.zeros(len(xs), bool)
  for k in np.unique(folds):
    of = folds == k
    residuals = healthy.residuals(own.model, healthy.standard(own.model, xs[of]), int(k))
    at = np.maximum(rows - since[of], 0)[None]
    residuals = np.take_along_axis(residuals, at, 2)
    for name, score in charts.scores(residuals, own.scales).items():
      found[of] |= (score[:, BEFORE:] > own.thresholds[name]).any((1, 2))
  return found


def smallest(
  own: Watch,
  past: np.ndarray,
  names: list[str],
  within: int,
  since: np.ndarray | None = None,
  seed: int = 0,
) -> tuple[list[dict[str, Any]], int]:
  """The smallest severity of each kind of fault that is seen within so many samples.

  Args:
    own: from verdict.calibrated, on `past`.
    past: (N, C) the nominal log, none missing.
    names: of the columns that are watched.
    within: samples.
    since: (N, W) of the log, as of `healthy.since`; None: 0, no sample was missing.
    seed: of noise and dropout.

  Returns:
    (a row for each column and kind: column, kind, severity (None: none was seen), by (the same in
    the column's own unit where it is an amount), shares (of the places, for each severity tried);
    number of places).
  """
  places = _places(len(past), within)
  if not places:
    return [], 0
  cut = np.stack([past[at : at + BEFORE + within] for at, _ in places])
  since = np.zeros((len(past), own.model.watched), int) if since is None else since
  ago = np.stack([since[at : at + BEFORE + within] for at, _ in places])
  folds = np.array([k for _, k in places])
  quiet = ~_alarmed(own, cut, ago, folds)
  cut, ago, folds = cut[quiet], ago[quiet], folds[quiet]
  rng = np.random.default_rng(seed)
  rows: list[dict[str, Any]] = []
  if not len(cut):
    return [], 0
  for c, name in enumerate(names):
    spread = float(past[:, c].std())
    for kind, (severities, _) in KINDS.items():
      every = []
      for severity in severities:
        one = cut.copy()
        one[:, :, c] = spoiled(cut[:, :, c], kind, severity, BEFORE, spread, rng)
        every.append(one)
      times = len(severities)
      again = np.tile(ago, (times, 1, 1)), np.tile(folds, times)
      fired = _alarmed(own, np.concatenate(every), *again)
      shares = fired.reshape(len(severities), -1).mean(1)
      seen = np.flip(np.logical_and.accumulate(np.flip(shares >= SEEN)))
      least = float(severities[int(np.argmax(seen))]) if seen.any() else None
      amount = kind in ("bias", "drift", "noise")
      rows.append(
        {
          "column": name,
          "kind": kind,
          "severity": least,
          "by": least * spread if amount and least is not None else None,
          "tried": list(severities),
          "shares": [round(float(x), 3) for x in shares],
        }
      )
  return rows, len(cut)
