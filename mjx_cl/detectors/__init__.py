"""Change detectors: pure `init` / `update` pairs over one stream. `DETECTORS` is the one table."""
from __future__ import annotations

from mjx_cl.detectors.base import Alarm, Detector
from mjx_cl.detectors.combine import any_of, on
from mjx_cl.detectors.rolling_sigma import rolling_sigma
from mjx_cl.errors import UserError, choose


def paper_rule(threshold_rpr: float | None = None, **settings) -> Detector:
  """The paper's rule as written: `rolling_sigma` on OPR and on RPR, beyond three deviations of the mean, either one. `threshold_rpr`: another
  threshold for RPR, None: the same."""
  own = {} if threshold_rpr is None else {"threshold": threshold_rpr}
  return any_of(on("opr", rolling_sigma(**settings)), on("rpr", rolling_sigma(**(settings | own))))


def calibrated_rule(**settings) -> Detector:
  """The paper's rule calibrated to ARL0 = 100,000 steps on nominal walkers, seeds 100 to 109: trailing mean of the logarithms, a lagged
  reference, one side, a threshold for each residual.

  How the figures were found: benchmarks/calibrate.py; its table: results/arl0.json. Runs of single samples in a row do not do: a gait makes
  residuals swing, and at this ARL0 they find almost nothing within 500 steps.
  """
  return paper_rule(**(CALIBRATED | settings))


# chosen by benchmarks/calibrate.py on tuning seeds, see results/arl0.json
CALIBRATED = {"window": 4000, "smooth": 400, "lag": 500, "threshold": 6.5, "threshold_rpr": 6.5, "patience": 1, "two_sided": False, "log": True}

DETECTORS = {"rolling_sigma": calibrated_rule, "rolling_sigma_plain": paper_rule}


def make(name: str, **settings) -> Detector:
  """Builds detector `name`, a map over monitor.Residual. Unknown settings are refused."""
  build = choose("detector", name, DETECTORS)
  try:
    return build(**settings)
  except TypeError as e:
    raise UserError(f"detector {name!r}: {e}") from None
