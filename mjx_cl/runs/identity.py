"""What makes a run what it is: its settings, agents and threshold, and whether a folder holds the
same.
"""

import dataclasses
import hashlib
import json
import pathlib
from typing import Any

import jax
import numpy as np

from mjx_cl import BENCHMARK, detectors, envs
from mjx_cl.adapt import methods
from mjx_cl.adapt.arms import ARMS
from mjx_cl.config import AdaptConfig, RunConfig
from mjx_cl.errors import FileError, UserError, require
from mjx_cl.faults.presets import changes
from mjx_cl.io import folders, plugins, tables
from mjx_cl.runs.settings import check
from mjx_cl.scoring import stop_rule
from mjx_cl.training import agents


def arm_agents(config: RunConfig, env: Any) -> dict[str, agents.Trained]:
  """Arm -> its own agent, of the arms that bring one: the run's with the arm's word behind its
  name, or beside the folder that --agent gives.

  Args:
    config: of the run.
    env: its robot.

  Raises:
    UserError: where there is no such agent, or it differs from the run's in size, obs_scale
      or repeat.
  """
  out = {}
  for arm in (a for a in config.arms if ARMS[a].agent):
    trained = agents.of(env, config.agent)
    given = config.agent and pathlib.Path(config.agent).exists()
    name = f"{trained.path if given else pathlib.Path(trained.path).name}-{ARMS[arm].agent}"
    try:
      other = agents.of(env, name)
    except UserError as e:
      raise type(e)(f"arm {arm!r}: {e}") from None
    same = lambda t: (t.agent.config.size, t.agent.config.obs_scale, t.repeat)
    require(
      same(other) == same(trained),
      f"arm {arm!r}: agent {name!r} differs from the run's in size, obs_scale or repeat",
    )
    out[arm] = other
  return out


def check_learners(config: RunConfig, trained: agents.Trained) -> None:
  """An arm that learns needs a critic to begin from.

  Raises:
    UserError: such an arm, and an agent that was cut down to what acts.
  """
  if any(np.any(leaf) for leaf in jax.tree.leaves(trained.train.params["val"])):
    return
  learns = lambda arm: arm.learns and not arm.fresh and methods.of(arm).learns
  names = [name for name in config.arms if learns(ARMS[name])]
  require(
    not names,
    f"agent {agents.called(trained)!r} holds what acts alone, its critic is zero: nothing can "
    f"learn from it; leave out arm {', '.join(names)}, or give the agent as it was trained",
  )


def known_as(env: Any) -> str:
  """The robot whose agents and figures `env` takes: its own name, or that of the one that it is
  another fidelity of.
  """
  return getattr(env, "agents_of", None) or env.spec.name


def agent_of(config: RunConfig) -> str | None:
  """The run's `agent`, one that ships by its name, however it was given."""
  return config.agent and (agents.named(config.agent) or config.agent)


def threshold_of(config: RunConfig) -> detectors.Threshold | None:
  """The board's threshold that this run's detector has without having been given one; None where it
  has another.
  """
  if "threshold" in config.settings or detectors.split(config.detector)[0] in detectors.PAPER:
    return None
  robot = known_as(envs.make(config.env, config.physics))
  return detectors.calibrated(config.detector, robot, config.settings, agent_of(config))


def identity(config: RunConfig) -> dict:
  """What makes a run what it is, as config.json holds it: its settings, `changes`, what a preset's
  name stood for when it began, the `threshold` that its detector takes from the board,
  `oracle_stops` that its arms are told, the SHA-256 of the `files` that robot, fault, detector or
  arm stand in, with the modules beside them that they import, and the version of the `benchmark`.
  """
  config = check(config)  # one that was built by hand may lack what follows from the others
  found, told = threshold_of(config), stop_rule.told(config)
  sources = {
    name: plugins.file_of(name)
    for name in (
      config.env,
      config.detector,
      *(change.fault for change in changes(config)),
      *config.arms,
    )
  }
  files = {
    name: hashlib.sha256(b"".join(p.read_bytes() for p in plugins.files(path))).hexdigest()
    for name, path in sources.items()
    if path is not None and path.is_file()
  }
  return json.loads(
    json.dumps(
      {
        **dataclasses.asdict(config),
        "changes": [dataclasses.asdict(change) for change in changes(config)],
        **({"threshold": found._asdict()} if found else {}),
        **({"oracle_stops": told} if told else {}),
        **({"files": files} if files else {}),
        "benchmark": BENCHMARK,
      }
    )
  )


def differing(old: dict, values: dict) -> list[str]:
  """Keys of `values` in which the run differs whose config.json holds `old`. A setting that did not
  exist when it began counts as its default.
  """
  if isinstance(old.get("adapt"), dict):
    old = old | {"adapt": {**dataclasses.asdict(AdaptConfig()), **old["adapt"]}}
  defaults = {f.name: f.default for f in dataclasses.fields(RunConfig)}
  defaults |= {"changes": values.get("changes"), "benchmark": 1}  # nor did these always exist
  changed = folders.differing(old, values, ("git_commit", "machine", "python"), defaults)
  return changed + ["threshold"] * ("threshold" in old and "threshold" not in values)


def departure(old: dict, changed: list[str]) -> str:
  """How the run whose config.json holds `old` differs, as the rest of a line that begins with its
  folder; empty where it does not.

  Args:
    old: its config.json.
    changed: see `differing`.
  """
  if changed == ["threshold"]:
    return (
      f"was begun when its detector {old.get('detector')} had another default threshold than today"
    )
  if changed == ["seeds"]:
    return (
      f"was begun with {old.get('seeds')} seeds; the others are a run of their own (--first-seed), "
      "which --merge puts together with it"
    )
  return f"was begun with another {', '.join(changed)}" if changed else ""


def check_told(config: RunConfig, values: dict) -> None:
  """Refuses oracle stops of a run whose agent has other weights than that of `values`, the
  config.json of this one.
  """
  if "oracle_stops" not in values:
    return
  card = tables.read_json(pathlib.Path(str(config.stops)) / "config.json").get("agent_card", {})
  changed = folders.differing(values["agent_card"], card, deep=True)
  require(
    not changed,
    f"stops: {config.stops} was run with another agent ({', '.join(changed)}); its oracle stops "
    "are not those of this run",
  )


def check_same(out: pathlib.Path, values: dict) -> None:
  """Refuses to resume with other settings than the run began with."""
  try:
    old = tables.read_json(out / "config.json")
  except FileError as e:
    raise FileError(f"{e}; give --overwrite or another --out") from None
  changed = differing(old, values)
  way = "give the same settings or --overwrite"
  if changed == ["threshold"]:
    way = "--overwrite begins anew"
  require(not changed, f"--resume: {out} {departure(old, changed)}; {way}")
