"""Change detectors: pure `init` / `update` pairs over one stream. `DETECTORS` is the one table;
entry points `mjx_cl.detectors` join it.
"""

from __future__ import annotations

import functools
import inspect
import json
import pathlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from mjx_cl.config import kinds
from mjx_cl.detectors import baselines, combine
from mjx_cl.detectors.adwin import adwin
from mjx_cl.detectors.base import Alarm, Detector, scalar
from mjx_cl.detectors.bfar import bfar
from mjx_cl.detectors.bocpd import bocpd
from mjx_cl.detectors.combine import any_of, cool_down, on, patience, whitened
from mjx_cl.detectors.conformal import conformal
from mjx_cl.detectors.cusum import cusum
from mjx_cl.detectors.e_detector import e_detector
from mjx_cl.detectors.ewma import ewma
from mjx_cl.detectors.glr import glr
from mjx_cl.detectors.hotelling import hotelling
from mjx_cl.detectors.knn import knn
from mjx_cl.detectors.kswin import kswin
from mjx_cl.detectors.max_variables import max_variables
from mjx_cl.detectors.mewma import mewma
from mjx_cl.detectors.multichart import multichart
from mjx_cl.detectors.page_hinkley import page_hinkley
from mjx_cl.detectors.rolling_sigma import rolling_sigma
from mjx_cl.detectors.scan import scan
from mjx_cl.detectors.shiryaev_roberts import shiryaev_roberts
from mjx_cl.detectors.surprise import surprise
from mjx_cl.detectors.z_score import z_score
from mjx_cl.errors import UserError, choose
from mjx_cl.io.plugins import Registry


def paper_rule(
  threshold: float = 3.0, threshold_rpr: float | None = None, unit_rpr: float = 1.0, **settings: Any
) -> Detector:
  """The paper's rule as written: `rolling_sigma` on OPR and on RPR, beyond three deviations of the
  mean, either one. `threshold_rpr`: another threshold for RPR, None: the same. `unit_rpr`:
  deviations of RPR that count as one.

  Two-sided, unless two_sided=False, a rise alone.
  Blind to: a change that moves neither OPR nor RPR; one slower than window + lag, which the rolling
  reference absorbs; with `patience` or `smooth`, one
    much shorter than these.
  """
  other = threshold if threshold_rpr is None else threshold_rpr
  return any_of(
    on("opr", rolling_sigma(threshold=threshold, **settings)),
    on("rpr", rolling_sigma(threshold=other, unit=unit_rpr, **settings)),
  )


def calibrated_rule(**settings: Any) -> Detector:
  """The paper's rule calibrated to ARL0 = 100,000 steps on nominal robots, seeds 100 to 109:
  trailing mean of the logarithms, a lagged reference, one side, a threshold for each residual.
  Figures of the walker; `make` takes those of the robot where it is told which.

  How the figures were found: benchmarks/calibrate.py; its table: results/arl0.json. Runs of single
  samples in a row do for the car, not for what walks: a gait makes residuals swing, and at this
  ARL0 they find almost nothing within 500 steps.

  One-sided: a rise of OPR or RPR alone.
  Blind to: a fall of a residual; a change that moves neither; one slower than window + lag (4,000
  or 4,500 control steps), which the reference absorbs; one
    much shorter than the trailing mean (walker 400, quadruped 200), on the car one of fewer than 20
    samples in a row.
  """
  return paper_rule(**(CALIBRATED["walker"] | settings))


# by robot, chosen by benchmarks/calibrate.py on tuning seeds, see results/arl0.json,
# arl0_quadruped.json, arl0_car.json
CALIBRATED = {
  "walker": {
    "window": 4000,
    "smooth": 400,
    "lag": 500,
    "threshold": 6.5,
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


def one_threshold(robot: str | None) -> dict:
  """Settings of `rolling_sigma` on a robot, without a threshold: both residuals share one, RPR's
  deviations counted in the proportion of its calibrated threshold to that of OPR. A single
  threshold can then be calibrated, as the leaderboard does.
  """
  own = dict(CALIBRATED.get(robot, CALIBRATED["walker"]))  # type: ignore[arg-type]
  threshold = own.pop("threshold")
  return own | {"threshold_rpr": None, "unit_rpr": own.get("threshold_rpr", threshold) / threshold}


PAPER = (
  "rolling_sigma",
  "rolling_sigma_plain",
)  # the paper's rule, with figures of its own: CALIBRATED, three deviations


class Threshold(NamedTuple):
  """A threshold that was found on healthy robots. Attributes: value. arl0: control steps per false
  alarm. alarms: that were counted.
  """

  value: float
  arl0: float
  alarms: int


@functools.cache
def board() -> dict:
  """What the leaderboard at ARL0 = 100,000 control steps found: robot -> name on the board ->
  {settings, threshold, arl0, alarms}; written by benchmarks/thresholds.py from
  results/leaderboard_100k. Shipped agents, seeds 100 to 109; detectors that can be had at that rate
  alone.
  """
  return json.loads((pathlib.Path(__file__).parent / "thresholds.json").read_text())["robots"]


def calibrated(name: str, robot: str, settings: dict) -> Threshold | None:
  """The board's threshold of detector `name` with these settings on `robot`; a setting at its
  default counts as none.

  None where a threshold is among the settings, or the board has no such robot or no detector that
  is set so. PAPER's have figures of their own.
  """
  use, channel = split(name)
  _check_channel(name, channel)
  _check_channel(name, settings.get("channel"))
  rows = [row for row in board().get(robot, {}).values() if row["settings"]["use"] == use]
  own = (
    _told(
      use,
      {"channel": channel or settings.get("channel")}
      | {k: v for k, v in settings.items() if k != "channel"},
    )
    if rows
    else None
  )
  return next(
    (
      Threshold(row["threshold"], row["arl0"], row["alarms"])
      for row in rows
      if own == _told(use, {k: v for k, v in row["settings"].items() if k != "use"})
    ),
    None,
  )


def _check_channel(name: str, channel: Any) -> None:
  if channel is not None and not (channel and isinstance(channel, str)):
    raise UserError(f"detector {name!r}: {channel!r} is no channel; choose from: {combine.NAMES}")


def _told(use: str, settings: dict) -> dict:
  """What `settings` say beyond the defaults of `make` and of the factory; channels in the order of
  their names.
  """
  defaults = {
    p.name: p.default
    for f in (factory(use), make)
    for p in inspect.signature(f).parameters.values()
  }
  channels = sorted((settings.get("channel") or "opr+rpr").split("+"))
  if settings.get("log") is True and "reward" not in channels:  # as without it
    settings = settings | {"log": None}
  return {
    k: v
    for k, v in settings.items()
    if k != "channel" and v != defaults.get(k, inspect.Parameter.empty)
  } | {"channel": channels}


DETECTORS: dict[str, Callable[..., Detector]] | Registry = {
  "rolling_sigma": calibrated_rule,
  "rolling_sigma_plain": paper_rule,
}
DETECTORS |= {
  "z_score": z_score,
  "ewma": ewma,
  "cusum": cusum,
  "page_hinkley": page_hinkley,
  "shiryaev_roberts": shiryaev_roberts,
  "glr": glr,
}
DETECTORS |= {
  "adwin": adwin,
  "kswin": kswin,
  "bocpd": bocpd,
  "e_detector": e_detector,
  "conformal": conformal,
}
# over several fields of the residual
DETECTORS |= {
  "hotelling": hotelling,
  "mewma": mewma,
  "max_variables": max_variables,
  "surprise": surprise,
  "knn": knn,
  "bfar": bfar,
  "multichart": multichart,
}
# what every score is printed beside; the oracle, which must be told the onset, is in
# references.REFERENCES alone
DETECTORS |= {
  "never": baselines.never,
  "always": baselines.always,
  "periodic": baselines.periodic,
  "random": baselines.random,
}


DETECTORS = Registry("mjx_cl.detectors", "detector", DETECTORS)


def known_settings(build: Callable[..., Any]) -> list[str]:
  """Names of the settings of a factory; those of the paper's rule go on to `rolling_sigma`."""
  own = inspect.signature(build).parameters.values()
  more: list[Callable[..., Any]] = (
    [paper_rule, rolling_sigma] if build in (calibrated_rule, paper_rule) else []
  )
  found = [
    p.name
    for f in (build, *more)
    for p in inspect.signature(f).parameters.values()
    if p.kind is not p.VAR_KEYWORD
  ]
  return list(dict.fromkeys(found)) + ["..."] * (
    not more and any(p.kind is p.VAR_KEYWORD for p in own)
  )


def _pure(name: str, factory: Callable[..., Any]) -> Callable[..., Detector]:
  """`factory`, held to giving Detectors; a class in plain Python is told where it can go
  instead.
  """

  @functools.wraps(factory)
  def build(*args: Any, **settings: Any) -> Detector:
    detector = factory(*args, **settings)
    if not isinstance(detector, Detector):
      plain = callable(getattr(detector, "update", None))
      raise UserError(
        f"detector {name!r} gives {type(detector).__name__} in place of a Detector"
        + (
          ": plain Python cannot run inside the compiled loop; score it by `mjx-cl leaderboard "
          "--add` or use it in `mjx-cl detect`, or write it as a pure "
          "init/update pair, as mjx_cl/detectors/cusum.py"
          if plain
          else ", a pure init/update pair as in mjx_cl/detectors/cusum.py"
        )
      )
    return detector

  return build


def split(name: str) -> tuple[str, str | None]:
  """Name and channel of `name@channel`; a file's path may hold an @ too."""
  found, at, channel = name.rpartition("@") if "@" in name.rpartition(":")[2] else (name, "", None)
  return found, channel


def factory(name: str) -> Callable[..., Any]:
  """What builds detector `name`, its channel left aside."""
  return choose("detector", split(name)[0], DETECTORS)  # type: ignore[return-value]


def check_kinds(name: str, settings: dict, *builds: Callable[..., Any]) -> None:
  """Refuses a setting of another kind than its annotation in one of `builds` says, before a program
  is traced with it. Words are the factories' own to read, and numbers of JAX pass.
  """
  known = {
    p.name: getattr(p.annotation, "__name__", str(p.annotation))
    for build in builds
    for p in inspect.signature(build).parameters.values()
  }
  kinds(
    f"detector {name!r}",
    {k: text for k, text in known.items() if "str" not in text},
    {k: v for k, v in settings.items() if not isinstance(v, jax.Array)},
  )


def make(
  name: str,
  channel: str | None = None,
  log: bool | None = None,
  whiten: int = 0,
  patience: int = 1,
  cool_down: int = 0,
  robot: str | None = None,
  shared: bool = False,
  **settings: Any,
) -> Detector:
  """Builds detector `name`, a map over monitor.Residual. Unknown settings are refused.

  Args:
    name: of DETECTORS, or `name@channel`, short for channel=...; or path/to/file.py:factory,
      module:factory, a factory of one's own that gives a Detector.
    channel: what a single-residual detector watches: one of combine.CHANNELS, or several joined by
      `+`, each with a detector of its own; the alarm of any counts. Default: `opr+rpr`.
    log: take the logarithm of the channel first; default: of all but the reward, which may be
      negative.
    whiten: order of the autoregression whose innovations a single-residual detector sees in place
      of the channel, behind the logarithm; its own warm-up begins after that of combine.whitened;
      0: none.
    patience: scores in a row above the threshold before a single-residual detector fires, see
      combine.patience; others have their own setting of this name, or none.
    cool_down: samples after an alarm in which no other counts, of the channels together, see
      combine.cool_down.
    robot: whose figures `rolling_sigma` starts from, where CALIBRATED has them, default the
      walker's; handed on to a factory that takes it. Others: see `calibrated`.
    shared: `rolling_sigma` has one threshold for both residuals, see `one_threshold`.
  """
  name, own = split(name)
  _check_channel(name, own)
  _check_channel(name, channel)
  build, channel = factory(name), own or channel
  more = (paper_rule, rolling_sigma) if build in (calibrated_rule, paper_rule) else ()
  check_kinds(
    name,
    {**settings, "log": log, "whiten": whiten, "patience": patience, "cool_down": cool_down},
    *more,
    build,
    make,
  )
  if ":" in name:
    build = _pure(name, build)
  if name == "rolling_sigma":
    settings = (
      one_threshold(robot) if shared else CALIBRATED.get(robot, {})  # type: ignore[arg-type]
    ) | settings
  elif robot is not None and "robot" in inspect.signature(build).parameters:
    settings = {"robot": robot} | settings
  try:
    if getattr(build, "takes", "residual") != "scalar":
      if channel is not None or log is not None or whiten:
        raise UserError(
          f"detector {name!r} has channels of its own; leave out channel, log and whiten"
        )
      detector = build(**(settings | ({} if patience == 1 else {"patience": patience})))
      return combine.cool_down(detector, cool_down) if cool_down else detector
    detector = build(**settings) if patience == 1 else combine.patience(build, patience, **settings)
  except (TypeError, ValueError) as e:
    values = ", ".join(
      f"{k}={v!r}" for k, v in settings.items() if not isinstance(v, jax.core.Tracer)
    )
    if not settings:
      raise UserError(f"detector {name!r} cannot be built: {type(e).__name__}: {e}") from None
    if "argument" not in str(e):
      raise UserError(
        f"detector {name!r}: a setting of the wrong kind among {values} ({e}); its settings "
        f"are: {', '.join(known_settings(build))}"
      ) from None
    raise UserError(
      f"detector {name!r}: {e}; its settings are: {', '.join(known_settings(build))}"
    ) from None
  if whiten:
    detector = whitened(detector, whiten)
  members = [
    on(c, detector, c != "reward" if log is None else log)
    for c in (channel or "opr+rpr").split("+")
  ]
  detector = members[0] if len(members) == 1 else any_of(*members)
  return combine.cool_down(detector, cool_down) if cool_down else detector
