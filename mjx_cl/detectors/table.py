"""The one table of detectors; entry points `mjx_cl.detectors` join it."""

from collections.abc import Callable
from typing import Any

from mjx_cl.detectors import baselines
from mjx_cl.detectors.adwin import adwin
from mjx_cl.detectors.bfar import bfar
from mjx_cl.detectors.bocpd import bocpd
from mjx_cl.detectors.conformal import conformal
from mjx_cl.detectors.cusum import cusum
from mjx_cl.detectors.e_detector import e_detector
from mjx_cl.detectors.ewma import ewma
from mjx_cl.detectors.glr import glr
from mjx_cl.detectors.hotelling import hotelling
from mjx_cl.detectors.innovations import innovations
from mjx_cl.detectors.knn import knn
from mjx_cl.detectors.kswin import kswin
from mjx_cl.detectors.learnt import learnt
from mjx_cl.detectors.max_variables import max_variables
from mjx_cl.detectors.mewma import mewma
from mjx_cl.detectors.multichart import multichart
from mjx_cl.detectors.page_hinkley import page_hinkley
from mjx_cl.detectors.paper_rule import calibrated_rule, paper_rule
from mjx_cl.detectors.shiryaev_roberts import shiryaev_roberts
from mjx_cl.detectors.surprise import surprise
from mjx_cl.detectors.z_score import z_score
from mjx_cl.errors import choose
from mjx_cl.io.plugins import Registry

DETECTORS = Registry(
  "mjx_cl.detectors",
  "detector",
  {
    "rolling_sigma": calibrated_rule,
    "rolling_sigma_plain": paper_rule,
    "z_score": z_score,
    "ewma": ewma,
    "cusum": cusum,
    "page_hinkley": page_hinkley,
    "shiryaev_roberts": shiryaev_roberts,
    "glr": glr,
    "adwin": adwin,
    "kswin": kswin,
    "bocpd": bocpd,
    "e_detector": e_detector,
    "conformal": conformal,
    # over several fields of the residual
    "hotelling": hotelling,
    "mewma": mewma,
    "max_variables": max_variables,
    "surprise": surprise,
    "knn": knn,
    "bfar": bfar,
    "multichart": multichart,
    "learnt": learnt,
    "innovations": innovations,
    # what every score is printed beside; the oracle, which must be told the onset, is in
    # baselines.REFERENCES alone
    "never": baselines.never,
    "always": baselines.always,
    "periodic": baselines.periodic,
    "random": baselines.random,
  },
)


def split(name: str) -> tuple[str, str | None]:
  """Name and channel of `name@channel`; a file's path may hold an @ too."""
  found, at, channel = name.rpartition("@") if "@" in name.rpartition(":")[2] else (name, "", None)
  return found, channel


def factory(name: str) -> Callable[..., Any]:
  """What builds detector `name`, its channel left aside."""
  return choose("detector", split(name)[0], DETECTORS)
