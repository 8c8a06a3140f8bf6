"""Change detectors: pure `init` / `update` pairs over one stream. `DETECTORS` is the one table; entry points `mjx_cl.detectors` join it."""
from __future__ import annotations

import importlib.metadata
import inspect

from mjx_cl.detectors.base import Alarm, Detector, scalar
from mjx_cl.detectors.combine import any_of, on
from mjx_cl.detectors.rolling_sigma import rolling_sigma
from mjx_cl.errors import UserError, choose


def paper_rule(threshold: float = 3.0, threshold_rpr: float | None = None, **settings) -> Detector:
  """The paper's rule as written: `rolling_sigma` on OPR and on RPR, beyond three deviations of the mean, either one. `threshold_rpr`: another
  threshold for RPR, None: the same."""
  other = threshold if threshold_rpr is None else threshold_rpr
  return any_of(on("opr", rolling_sigma(threshold=threshold, **settings)), on("rpr", rolling_sigma(threshold=other, **settings)))


def calibrated_rule(**settings) -> Detector:
  """The paper's rule calibrated to ARL0 = 100,000 steps on nominal walkers, seeds 100 to 109: trailing mean of the logarithms, a lagged
  reference, one side, a threshold for each residual.

  How the figures were found: benchmarks/calibrate.py; its table: results/arl0.json. Runs of single samples in a row do not do: a gait makes
  residuals swing, and at this ARL0 they find almost nothing within 500 steps.
  """
  return paper_rule(**(CALIBRATED | settings))


# chosen by benchmarks/calibrate.py on tuning seeds, see results/arl0.json
CALIBRATED = {"window": 4000, "smooth": 400, "lag": 500, "threshold": 6.5, "patience": 1, "two_sided": False, "log": True}

DETECTORS = {"rolling_sigma": calibrated_rule, "rolling_sigma_plain": paper_rule}


def _plugins() -> dict:
  found = {}
  for entry in importlib.metadata.entry_points(group="mjx_cl.detectors"):
    if entry.name in DETECTORS or entry.name in found:
      raise UserError(f"detector {entry.name!r} of {entry.value} is there already; a plug-in must have a name of its own")
    found[entry.name] = entry.load()
  return found


DETECTORS |= _plugins()


def make(name: str, channel: str | None = None, log: bool | None = None, **settings) -> Detector:
  """Builds detector `name`, a map over monitor.Residual. Unknown settings are refused.

  Args:
    name: of DETECTORS, or `name@channel`, short for channel=...
    channel: what a single-residual detector watches: one of combine.CHANNELS, or several joined by `+`, each with a detector of its own; the
      alarm of any counts. Default: `opr+rpr`.
    log: take the logarithm of the channel first; default: of all but the reward, which may be negative.
  """
  name, at, after = name.partition("@")
  if at:
    channel = after
  build = choose("detector", name, DETECTORS)
  try:
    if getattr(build, "takes", "residual") != "scalar":
      if channel is not None or log is not None:
        raise UserError(f"detector {name!r} has channels of its own; leave out channel and log")
      return build(**settings)
    detector = build(**settings)
  except TypeError as e:
    if "argument" not in str(e):
      raise
    known = ", ".join(p for p in inspect.signature(build).parameters)
    raise UserError(f"detector {name!r}: {e}; its settings are: {known}") from None
  members = [on(c, detector, c != "reward" if log is None else log) for c in (channel or "opr+rpr").split("+")]
  return members[0] if len(members) == 1 else any_of(*members)
