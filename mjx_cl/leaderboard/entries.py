"""What may stand on the board: registered detectors, their variants, and those of one's own."""

import inspect
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import jax

from mjx_cl import detectors as detectors_lib
from mjx_cl.errors import PluginError, UserError, choose
from mjx_cl.io.plugins import line, of_user
from mjx_cl.leaderboard.streams import StreamSet
from mjx_cl.rollout.monitor import CHANNELS
from mjx_cl.scoring.autoregression import ORDER

Build = Callable[[Any], Any]  # threshold -> Detector


class Entry(NamedTuple):
  """A detector on the board.

  Attributes:
    name: on the board.
    build: threshold -> Detector.
    calibrated: has a threshold.
    reference: looks at nothing.
    own: (robot, agent) -> build where the settings are an agent's own, which is compiled for each
      robot, agent None: the robot's own; None: `build` serves all.
    signed: takes innovations.
  """

  name: str
  build: Build
  calibrated: bool
  reference: bool
  own: Callable[..., Build] | None = None
  signed: bool = False


def variants() -> dict[str, dict]:
  """Settings by name on the board: every registered detector at its defaults, and the usual other
  channels and a whitened form.
  """
  own: dict[str, dict[str, Any]] = {name: {"use": name} for name in detectors_lib.DETECTORS}
  scalar = lambda n: getattr(detectors_lib.DETECTORS.get(n), "takes", "") == "scalar"
  white = filter(scalar, ("cusum", "ewma", "glr", "conformal"))
  own |= {f"{name} white": {"use": name, "whiten": ORDER} for name in white}
  if scalar("cusum"):
    groups = [c for c in CHANNELS if c.startswith("group_")]
    own |= {f"cusum@{c}": {"use": f"cusum@{c}"} for c in CHANNELS if c not in groups}
    own["cusum@groups"] = {"use": f"cusum@{'+'.join(groups)}"}
  return own


def entry(name: str, settings: dict) -> Entry:
  """An Entry from settings {use, ...}."""
  use = settings.get("use", name)
  rest = {k: v for k, v in settings.items() if k != "use"}
  factory = detectors_lib.factory(use)
  parameters = inspect.signature(factory).parameters
  calibrated = "threshold" in parameters or any(
    p.kind is p.VAR_KEYWORD for p in parameters.values()
  )
  build = lambda threshold, **more: detectors_lib.make(
    use, **(more | rest), **({"threshold": threshold} if calibrated else {})
  )
  own = None
  reference, signed = (bool(getattr(factory, k, False)) for k in ("reference", "signed"))
  if use == "rolling_sigma" or signed or {"robot", "agent"} & set(parameters):
    more = {"shared": True} if use == "rolling_sigma" else {}
    own = lambda robot, agent=None: (
      lambda threshold: build(threshold, robot=robot, agent=agent, **more)
    )
  return Entry(name, build, calibrated, reference, own, signed)


def fitted(names: Collection[str]) -> dict[str, str]:
  """{name on the board: what it was fitted on beforehand}, of those that were."""
  known = variants()
  uses = {name: known[name]["use"] for name in names if name in known}
  told = {name: getattr(detectors_lib.factory(use), "fitted", None) for name, use in uses.items()}
  return {name: words for name, words in told.items() if words}


def chosen(names: Collection[str], robot: str) -> list[Entry]:
  """Entries of these names on the board, in its order, all where there is none; behind them those
  that `detectors.make` takes beside: name@channel, path/to/file.py:factory, module:factory. The
  name `none` stands for no detector.

  Args:
    names: on the board.
    robot: on which the latter are built once, since what is wrong with one is to be said before
      others are run.

  Raises:
    UserError, one line: no such detector, file, factory or channel.
  """
  known, more = variants(), []
  for name in dict.fromkeys(names):
    if name == "none" or name in known:
      continue
    if name == detectors_lib.split(name)[0] and ":" not in name:
      choose("detector", name, known)
    one = entry(name, {"use": name})
    build = one.own(robot) if one.own else one.build
    one_line(name, lambda: build(1.0).init())
    more.append(one)
  return [entry(n, s) for n, s in known.items() if not names or n in names] + more


def able(
  entries: list[Entry], streams: StreamSet, robots: Collection[str], named: Collection[str] = ()
) -> tuple[list[Entry], list[str]]:
  """The entries that can be run on these robots of a set, and why each of the others cannot: one
  that takes innovations needs a set that holds them, and what it knows of the set's agents.

  Raises:
    UserError for such a one that is `named`.
  """
  kept, left = [], []
  for one in entries:
    try:
      kept.append(_of_agents(one, streams, robots))
    except UserError as e:
      if one.name in named:
        raise
      left.append(f"{one.name} is left out: {e}")
  return kept, left


def _of_agents(one: Entry, streams: StreamSet, robots: Collection[str]) -> Entry:
  """A detector with settings of each agent that acted in the set."""
  of = one.own
  own = of and (lambda robot: of(robot, streams.agent(robot)))
  for robot in robots if one.signed else ():
    streams.need_innovations(robot)
    if own:
      own(robot)(1.0)
  return one._replace(own=own)


def one_line(name: str, run: Callable[[], Any]) -> Any:
  """run(); whatever goes wrong inside a detector, which may be anybody's, becomes one line that
  names it.
  """
  try:
    return run()
  except UserError:
    raise
  except jax.errors.ConcretizationTypeError as e:
    raise UserError(
      f"detector {name!r} cannot be calibrated: its threshold is traced, several run side "
      "by side, so no Python `if` may look at it or at a sample (jnp.where does)"
    ) from e
  except BaseException as e:
    if of_user(e):
      raise
    raise PluginError(f"detector {name!r} failed: {line(e, 1)}") from e
