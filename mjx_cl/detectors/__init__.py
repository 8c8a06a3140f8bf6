"""Change detectors: pure `init` / `update` pairs over one stream. `DETECTORS` is the one table;
entry points `mjx_cl.detectors` join it.
"""

from mjx_cl.detectors.base import Alarm, Detector, scalar
from mjx_cl.detectors.combine import any_of, cool_down, on, patience, whitened
from mjx_cl.detectors.make import calibrated, check_kinds, known_settings, make
from mjx_cl.detectors.paper_rule import (
  CALIBRATED,
  PAPER,
  calibrated_rule,
  calibrated_settings,
  one_threshold,
  paper_rule,
)
from mjx_cl.detectors.rolling_sigma import rolling_sigma
from mjx_cl.detectors.scan import scan
from mjx_cl.detectors.table import (
  DETECTORS,
  adwin,
  bfar,
  bocpd,
  conformal,
  cusum,
  e_detector,
  ewma,
  factory,
  glr,
  hotelling,
  knn,
  kswin,
  max_variables,
  mewma,
  multichart,
  page_hinkley,
  shiryaev_roberts,
  split,
  surprise,
  z_score,
)
from mjx_cl.detectors.thresholds import Threshold, board
