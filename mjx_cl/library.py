"""What `import mjx_cl` offers beside `setup`: robots, faults, detectors and agents by name, one run
of the whole loop, a detector's score on the recorded streams.
"""

import pathlib
from collections.abc import Callable, Sequence
from typing import Any

from mjx_cl import envs, faults
from mjx_cl.config import AdaptConfig, RunConfig, field_kinds, replace
from mjx_cl.detectors import make as make_detector
from mjx_cl.detectors.python_class import HostDetector
from mjx_cl.envs import make as make_env
from mjx_cl.errors import UserError, require
from mjx_cl.leaderboard import score as board
from mjx_cl.leaderboard import submissions
from mjx_cl.leaderboard.streams import StreamSet
from mjx_cl.runs.run import execute
from mjx_cl.training import agents

__all__ = ["load_agent", "make_detector", "make_env", "make_fault", "run", "score"]


def load_agent(env: str, path: str | None = None) -> agents.Trained:
  """A trained agent: its `agent` (pure functions), weights and card.

  Args:
    env: robot that it must fit.
    path: shipped name or folder; None: the robot's shipped agent.

  Raises:
    UserError: for an unknown robot or agent.
    FileError: for a broken file.
  """
  if env not in envs.ENVS and (env in agents.shipped() or pathlib.Path(env, "card.json").exists()):
    raise UserError(f"{env!r} is an agent: load_agent(robot, {env!r})")
  return agents.of(envs.make(env), path)


def make_fault(name: str, env: Any) -> faults.Fault:
  """The fault `name` for a robot, see `mjx_cl.faults.make`.

  Args:
    name: on `mjx-cl list faults`, or "path/to/file.py:function".
    env: robot's name or environment.

  Raises:
    UserError: for an unknown robot or fault, or one that the robot cannot have.
  """
  return faults.make(name, envs.make(env) if isinstance(env, str) else env)


def run(
  env: str,
  out: str | pathlib.Path,
  *,
  adapt: dict[str, Any] | None = None,
  resume: bool = False,
  overwrite: bool = False,
  **settings: Any,
) -> dict[str, Any]:
  """Lives the whole loop, as `mjx-cl run` does: fault, alarm, finetuning, stop; arms x seeds
  streams.

  Args:
    env: robot.
    out: folder for the tables, summary.json and figure.png.
    adapt: fields of AdaptConfig.
    resume: go on with a run that was cut off.
    overwrite: replace an earlier run in `out`.
    **settings: fields of RunConfig, such as fault="gear", seeds=10, steps=25_000,
      arms=("detector", "none").

  Returns:
    What summary.json holds.

  Raises:
    UserError: for a wrong name or range.
    FileError: where files cannot be read or written.
  """
  adapt, names = adapt or {}, {"env": env, **settings}
  for name in ("env", "fault", "detector", "agent"):
    given = names.get(name)
    require(
      given is None or isinstance(given, str),
      f"{name} takes a name, a string; got {type(given).__name__}",
    )
  arms = settings.get("arms", ())
  require(
    isinstance(arms, (list, tuple)) and all(isinstance(arm, str) for arm in arms),
    f"arms takes a list of names; got {arms!r}",
  )
  field_kinds("run", RunConfig, settings)
  field_kinds("run", AdaptConfig, adapt, "adapt.")
  table = settings.get("settings", {})
  require(isinstance(table, dict), f"settings takes a dict of the detector's; got {table!r}")
  config = replace(RunConfig(env), **settings, adapt=replace(AdaptConfig(), **adapt))
  return execute(config, out, resume, overwrite)


def score(
  detector: str | Callable[[], Any],
  robots: str | Sequence[str] = (),
  streams: str | pathlib.Path | None = None,
  channel: str = "opr",
) -> list[dict[str, Any]]:
  """Scores one detector on recorded streams, at the leaderboard's rate of false alarms.

  Args:
    detector: name on the board, NAME@CHANNEL, "path/to/file.py:factory", or a class whose objects
      have update(x) -> bool; the latter runs as it is, at a rate of false alarms of its own.
    robots: of the set, or one; all where empty.
    streams: folder of `mjx-cl record`; None: the set that ships.
    channel: what a class watches; of a name NAME@CHANNEL says it.

  Returns:
    Rows of the leaderboard, one for each robot, fault and severity.

  Raises:
    UserError: for an unknown detector, robot or channel.
  """
  held = StreamSet(streams)
  chosen = held.choose((robots,) if isinstance(robots, str) else tuple(robots))
  if isinstance(detector, str):
    require(channel == "opr", f"channel is of a class; a name takes its own: {detector}@{channel}")
    entries, _ = board.able(board.chosen((detector,), chosen[0]), held, chosen, (detector,))
    extra = []
  elif callable(detector):
    name = getattr(detector, "__name__", type(detector).__name__)
    host = HostDetector(detector, name, channel)
    entries, extra = [], [(name, submissions.from_host(host, None))]
  else:
    raise UserError(f"detector is a name or a class with update(x); got {type(detector).__name__}")
  asked = {entry.name for entry in entries} | {name for name, _ in extra}
  return [r for r in board.score(held, entries, chosen, extra).rows if r["detector"] in asked]
