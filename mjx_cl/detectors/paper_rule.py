"""The paper's rule as it is written, and with the figures that were calibrated for each robot."""

from typing import Any

from mjx_cl.config import whose
from mjx_cl.detectors.base import Detector, Real, Setting, whole
from mjx_cl.detectors.combine import any_of, on
from mjx_cl.detectors.rolling_sigma import rolling_sigma

# names of the rule in the table; it has figures of its own: CALIBRATED, three deviations
PAPER = "rolling_sigma", "rolling_sigma_plain"
# by agent, chosen by benchmarks/calibrate.py on tuning seeds, see results/arl0.json and
# arl0_AGENT.json
CALIBRATED: dict[str, dict[str, Any]] = {
  "walker": {
    "window": 4000,
    "smooth": 400,
    "lag": 500,
    "threshold": 6.5,
    "patience": 1,
    "two_sided": False,
    "log": True,
  },
  "quadruped-trot-2": {
    "window": 4000,
    "smooth": 200,
    "lag": 500,
    "threshold": 6.0,
    "threshold_rpr": 4.0,
    "patience": 1,
    "two_sided": False,
    "log": True,
  },
  "quadruped": {
    "window": 4000,
    "smooth": 200,
    "lag": 500,
    "threshold": 4.5,
    "threshold_rpr": 12.0,
    "patience": 1,
    "two_sided": False,
    "log": True,
  },
  # also where a car that has adapted must not take its own crashes for an event
  "car": {
    "window": 4000,
    "smooth": 1,
    "lag": 0,
    "threshold": 4.0,
    "threshold_rpr": 4.0,
    "patience": 20,
    "two_sided": False,
    "log": False,
  },
}


@whole
def paper_rule(
  threshold: Setting = 3.0,
  threshold_rpr: Setting | None = None,
  unit_rpr: Real = 1.0,
  **settings: Any,
) -> Detector:
  """The paper's rule as written: `rolling_sigma` on OPR and on RPR, beyond three deviations of the
  mean, either one.

  Args:
    threshold: decision level [rolling std].
    threshold_rpr: another threshold for RPR; None: the same.
    unit_rpr: deviations of RPR that count as one.
    **settings: of `rolling_sigma`.

  Two-sided, unless two_sided=False, a rise alone.
  Blind to: a change that moves neither OPR nor RPR; one slower than window + lag, which the rolling
  reference absorbs; with `patience` or `smooth`, one much shorter than these.
  """
  other = threshold if threshold_rpr is None else threshold_rpr
  return any_of(
    on("opr", rolling_sigma(threshold=threshold, **settings)),
    on("rpr", rolling_sigma(threshold=other, unit=unit_rpr, **settings)),
  )


@whole
def calibrated_rule(**settings: Any) -> Detector:
  """The paper's rule calibrated to ARL0 = 100,000 steps on nominal robots, seeds 100 to 109:
  trailing mean of the logarithms, a lagged reference, one side, a threshold for each residual.
  Figures of the walker; `make` takes those of the agent where it is told which.

  How the figures were found: benchmarks/calibrate.py; its table: results/arl0.json. Runs of single
  samples in a row do for the car, not for what walks: a gait makes residuals swing, and at this
  ARL0 they find almost nothing within 500 steps.

  One-sided: a rise of OPR or RPR alone.
  Blind to: a fall of a residual; a change that moves neither; one slower than window + lag (4,000
  or 4,500 control steps), which the reference absorbs; one much shorter
  than the trailing mean (walker 400, quadruped 200), on the car one of fewer than 20
    samples in a row.
  """
  return paper_rule(**(CALIBRATED["walker"] | settings))


def calibrated_settings(robot: str | None, agent: str | None = None) -> dict:
  """Settings of `rolling_sigma` with this agent."""
  return CALIBRATED[whose(CALIBRATED, robot, agent)]


def one_threshold(robot: str | None, agent: str | None = None) -> dict:
  """`calibrated_settings` without a threshold: both residuals share one, RPR's deviations counted
  in the proportion of its calibrated threshold to that of OPR. A single threshold can then be
  calibrated, as the leaderboard does.
  """
  own = dict(calibrated_settings(robot, agent))
  threshold = own.pop("threshold")
  return own | {"threshold_rpr": None, "unit_rpr": own.get("threshold_rpr", threshold) / threshold}
