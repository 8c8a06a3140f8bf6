"""Detectors by name: what builds one, which settings it takes, and its threshold on a robot."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.config import kinds
from mjx_cl.detectors import combine
from mjx_cl.detectors.base import Alarm, Detector, Real, Setting
from mjx_cl.detectors.paper_rule import (
  calibrated_rule,
  calibrated_settings,
  one_threshold,
  paper_rule,
)
from mjx_cl.detectors.rolling_sigma import rolling_sigma
from mjx_cl.detectors.table import DETECTORS, factory, split
from mjx_cl.detectors.thresholds import Threshold, known_of
from mjx_cl.errors import PluginError, UserError
from mjx_cl.io.plugins import line


def calibrated(name: str, robot: str, settings: dict, agent: str | None = None) -> Threshold | None:
  """The board's threshold of detector `name` with these settings on `robot`, of the shipped `agent`
  where it has one of its own; a setting at its default counts as none.

  None where a threshold is among the settings, or the board has no such robot or no detector that
  is set so. Those of paper_rule.PAPER have figures of their own.
  """
  use, channel = split(name)
  _check_channels(use, channel, settings.get("channel"))
  known = known_of(robot, agent)
  rows = [row for row in known.values() if row["settings"]["use"] == use]
  own = settings | ({"channel": channel} if channel else {})
  for row in rows:
    if _told(use, own) == _told(use, row["settings"]):
      return Threshold(row["threshold"], row["arl0"], row["alarms"])
  return None


def _check_channels(name: str, own: str | None, given: Any) -> None:
  """Refuses what is no channel, and another one beside that of `name@channel`."""
  for channel in (own, given):
    if channel is not None and not (channel and isinstance(channel, str)):
      raise UserError(f"detector {name!r}: {channel!r} is no channel; choose from: {combine.NAMES}")
  if None not in (own, given) and own != given:
    raise UserError(f"detector {name}@{own} is given another channel, {given}; leave one out")


def _told(use: str, settings: dict) -> dict:
  """What `settings` say beyond the defaults of `make` and of the factory; channels in the order of
  their names.
  """
  build, every = factory(use), inspect.signature(make).parameters
  own = inspect.signature(build).parameters
  parameters = {**own, **every} if takes_number(build) else {**every, **own}
  channels = sorted((settings.get("channel") or "opr+rpr").split("+"))
  plain = {"patience": 1} if takes_number(build) or "patience" not in own else {}
  plain = {k: p.default for k, p in parameters.items() if p.default is not p.empty} | plain
  if takes_number(build) and "reward" not in channels:
    plain["log"] = True
  given = {k: v for k, v in settings.items() if k not in every or v is not None}
  told = {k: v for k, v in given.items() if k not in ("use", "channel")}
  return {k: v for k, v in told.items() if k not in plain or v != plain[k]} | {"channel": channels}


def _reads(build: Callable[..., Any]) -> tuple[Callable[..., Any], ...]:
  """Factories whose parameters are settings of `build`; the paper's rule hands on to others."""
  rule = build in (calibrated_rule, paper_rule)
  return (build, paper_rule, rolling_sigma) if rule else (build,)


def known_settings(build: Callable[..., Any]) -> list[str]:
  """Names of the settings of a factory, and `...` where it takes any."""
  found = [p for f in _reads(build) for p in inspect.signature(f).parameters.values()]
  names = [p.name for p in found if p.kind is not p.VAR_KEYWORD and p.name != "make"]
  every = len(_reads(build)) == 1 and any(p.kind is p.VAR_KEYWORD for p in found)
  return [*dict.fromkeys(names), *["..."] * every]


def check_kinds(name: str, settings: dict, *builds: Callable[..., Any]) -> None:
  """Refuses a setting of another kind than its annotation in one of `builds` says, before a program
  is traced with it. Words are the factories' own to read, and numbers of JAX pass.
  """
  number = {Real: "float", Setting: "float", Setting | None: "float | None"}
  known = {
    p.name: number.get(p.annotation) or getattr(p.annotation, "__name__", str(p.annotation))
    for build in builds
    for p in inspect.signature(build).parameters.values()
  }
  kinds(
    f"detector {name!r}",
    {k: text for k, text in known.items() if "str" not in text},
    {k: v for k, v in settings.items() if not isinstance(v, jax.Array)},
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
    return _answering(name, detector)

  return build


def _answering(name: str, detector: Detector) -> Detector:
  """`detector`, whose answers are looked at as a program is traced with it."""

  def init() -> Any:
    state = _asked(f"detector {name!r}: init", detector.init)
    for leaf in jax.tree.leaves(state):
      if not isinstance(leaf, (jax.Array, np.ndarray, np.generic, int, float)):
        given = type(leaf).__name__
        raise PluginError(f"detector {name!r}: init gives {given} in place of arrays")
    return state

  def update(state: Any, x: Any) -> tuple[Any, Alarm]:
    answer = _asked(f"detector {name!r}: update", detector.update, state, x)
    pair = isinstance(answer, tuple) and len(answer) == 2
    alarm = answer[1] if pair else answer
    if not pair or not isinstance(alarm, Alarm):
      given = type(alarm).__name__
      raise PluginError(f"detector {name!r}: update gives {given} in place of (state, Alarm)")
    _check_alarm(name, alarm)
    given, wanted = _form(answer[0]), _form(state)
    if given != wanted:
      raise PluginError(
        f"detector {name!r}: update gives a state of form {given} in place of {wanted}"
      )
    return answer

  return detector._replace(init=init, update=update)


def _form(tree: Any) -> str:
  """Structure, shapes and types, weak or not, in one line."""
  return str(jax.tree.map(_kind, tree)).replace("'", "")


def _kind(leaf: Any) -> str:
  """Type and shape of what an array can be made of; the Python type of anything else."""
  try:
    return str(jax.typeof(jnp.asarray(leaf))).lstrip("~")
  except (TypeError, ValueError):
    return type(leaf).__name__


def _check_alarm(name: str, alarm: Alarm) -> None:
  """Refuses what is no flag and one number."""
  fired, score = map(_kind, alarm)
  if fired != "bool[]" or score[-2:] != "[]":
    raise PluginError(
      f"detector {name!r}: update gives an Alarm(fired {fired}, score {score}) in place of "
      "(bool[], float32[])"
    )


def _asked(where: str, function: Callable, *args: Any) -> Any:
  """What foreign code answers; a StopIteration would end a generator of ours without a word."""
  try:
    return function(*args)
  except StopIteration as e:
    raise PluginError(f"{where} raised {line(e)}") from None


def _figures(
  name: str, build: Callable[..., Any], robot: str | None, agent: str | None, shared: bool
) -> dict:
  """What `make` hands on to a factory of its own accord; `shared`: one threshold for both residuals
  of `rolling_sigma`.
  """
  if name == "rolling_sigma":
    return (one_threshold if shared else calibrated_settings)(robot, agent)
  handed = {"robot": robot, "agent": agent, "make": make}
  taken = inspect.signature(build).parameters
  return {k: v for k, v in handed.items() if v is not None and k in taken}


def _built(name: str, build: Callable[..., Any], patience: int | None, settings: dict) -> Detector:
  """The detector of a factory, whose refusals become one line."""
  try:
    own = not takes_number(build) and {"patience", "..."} & set(known_settings(build))
    if patience is None or patience == 1 and not own:
      return build(**settings)
    if takes_number(build):
      return combine.patience(build, patience, **settings)
    return build(**(settings | {"patience": patience}))
  except (TypeError, ValueError) as e:
    told = {k: v for k, v in settings.items() if k != "make"}
    if not told:
      raise UserError(f"detector {name!r} cannot be built: {type(e).__name__}: {e}") from None
    values = (f"{k}={v!r}" for k, v in told.items() if not isinstance(v, jax.core.Tracer))
    wrong = f"a setting of the wrong kind among {', '.join(values)} ({e})"
    raise UserError(
      f"detector {name!r}: {e if 'argument' in str(e) else wrong}; its settings are: "
      f"{', '.join(known_settings(build))}"
    ) from None


def takes_number(build: Callable[..., Any]) -> bool:
  """Whether detectors of the factory take one number a step."""
  return getattr(build, "takes", "residual") == "scalar"


def make(
  name: str,
  channel: str | None = None,
  log: bool | None = None,
  whiten: int = 0,
  patience: int | None = None,
  cool_down: int = 0,
  robot: str | None = None,
  agent: str | None = None,
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
      negative. Detectors of the whole residual have their own setting of this name, or none.
    whiten: order of the autoregression whose innovations a single-residual detector sees in place
      of the channel, behind the logarithm; its own warm-up begins after that of combine.whitened;
      0: none.
    patience: scores in a row above the threshold before a single-residual detector fires, see
      combine.patience, default: 1; others have their own setting of this name, or none.
    cool_down: samples after an alarm in which no other counts, of the channels together, see
      combine.cool_down.
    robot: whose agent's figures `rolling_sigma` starts from, where CALIBRATED has them, default the
      walker's; handed on to a factory that takes it. Others: see `calibrated`.
    agent: that acts, a shipped name or a folder, likewise; default: the robot's own.
    shared: `rolling_sigma` has one threshold for both residuals, see `one_threshold`; so it has
      where a `threshold` is given without a `threshold_rpr`.
    **settings: of the factory. One that takes `make` is handed this function, to build others.
  """
  name, own = split(name)
  _check_channels(name, own, channel)
  build, channel = factory(name), own or channel
  told = {"log": log, "whiten": whiten, "patience": patience, "cool_down": cool_down}
  check_kinds(name, settings | told, *_reads(build), make)
  build = build if name in DETECTORS.own else _pure(name, build)
  if not takes_number(build):
    if log is not None and "log" in known_settings(build):
      settings, log = settings | {"log": log}, None
    if channel is not None or log is not None or whiten:
      raise UserError(
        f"detector {name!r} has channels of its own; leave out channel, log and whiten"
      )
  shared = shared or ("threshold" in settings and "threshold_rpr" not in settings)
  detector = _built(name, build, patience, _figures(name, build, robot, agent, shared) | settings)
  if takes_number(build):
    detector = combine.whitened(detector, whiten) if whiten else detector
    names = (channel or "opr+rpr").split("+")
    members = [combine.on(c, detector, c != "reward" if log is None else log) for c in names]
    detector = members[0] if len(members) == 1 else combine.any_of(*members)
  return combine.cool_down(detector, cool_down) if cool_down else detector
