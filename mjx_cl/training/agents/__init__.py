"""Trained agents: one folder each with `agent.npz` (arrays, never unpickled) and `card.json` (how
it was made, what it scores).

Names of the shipped ones are the folders beside this file; a path to any such folder works too.
"""

import dataclasses
import json
import os
import pathlib
import re
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np

from mjx_cl import envs
from mjx_cl.config import (
  MOST_REPEAT,
  DreamerConfig,
  field_kinds,
  finetuning,
  kinds,
  own_agent,
  recorded,
)
from mjx_cl.dreamer.agent import Agent, TrainState
from mjx_cl.errors import FileError, UserError, require
from mjx_cl.io import arrays, folders, tables

HERE = pathlib.Path(__file__).parent
_HALF = "|bfloat16"  # suffix of a moment that is stored as the upper half of its float32
_WEIGHT = "|float16"  # of weights in half precision
_SQUARE = "|octaves"  # of mean squared gradients as uint8, see `_octaves`
_FORGOTTEN = "|0"  # of momentum that is not stored, as bool
# what a card must hold besides `dreamer`; where it has no `repeat` that is 1
CARD = {
  "env": "str",
  "repeat": "int",
  "updates": "int | None",
  "finetuning_lr": "float | None",
  "finetuning_anchor": "float | None",
}


class Trained(NamedTuple):
  """A loaded agent.

  Attributes:
    agent: its programs.
    train: weights, moments and counters.
    card: its JSON card: env, preset, repeat, dreamer (config), command, returns, ...
    path: the folder.
  """

  agent: Agent
  train: TrainState
  card: dict
  path: str

  @property
  def repeat(self) -> int:
    """Control steps for which an action is held."""
    return self.card.get("repeat", 1)


def shipped() -> list[str]:
  """Names of the agents inside the package."""
  return sorted(p.parent.name for p in HERE.glob("*/card.json"))


def save(folder: os.PathLike | str, train: TrainState, card: dict, small: bool = False) -> None:
  """Writes an agent of one seed: parameters and counters in full, optimiser moments as bfloat16
  (they only steer step sizes).

  Args:
    folder: gets agent.npz and card.json.
    train: of one seed.
    card: see CARD.
    small: two fifths of the size, as the shipped ones are: parameters as float16, mean squared
      gradients to a third of an octave between 2^-80 and 32, momentum, which ten updates fill
      again, not at all. What it costs: results/README.md, Half precision.

  Raises:
    UserError: `small`, and a weight is not finite or beyond 65,504.
  """
  folder = pathlib.Path(folder)
  folder.mkdir(parents=True, exist_ok=True)
  stored = {}
  for name, leaf in arrays.named(train).items():
    value = np.asarray(leaf)
    moment = name.startswith(".opt") and value.dtype == np.float32 and value.ndim
    if small and name.startswith((".params", ".slow")):
      require(np.abs(value).max() < 65_504, f"{name} does not fit half precision; leave out small")
      stored[name + _WEIGHT] = value.astype(np.float16)
    elif not moment:
      stored[name] = value
    elif not small:
      stored[name + _HALF] = value.astype(ml_dtypes.bfloat16).view(np.uint16)
    elif ".nu" in name:
      stored[name + _SQUARE] = _octaves(value)
    else:
      stored[name + _FORGOTTEN] = np.zeros(value.shape, bool)
  text = json.dumps(card, indent=1) + "\n"
  with folders.together():
    arrays.write(folder / "agent.npz", stored, small=True)
    folders.atomic(folder / "card.json", lambda file: file.write(text.encode()))


def _octaves(square: np.ndarray) -> np.ndarray:
  """3 (log2 x + 80), rounded, from 1 to 255; 0 for 0. uint8."""
  with np.errstate(divide="ignore"):
    level = np.round(3 * (np.log2(square) + 80))
  return np.where(square > 0, np.clip(level, 1, 255), 0).astype(np.uint8)


def _stored(held: dict[str, np.ndarray], key: str) -> np.ndarray | None:
  """A leaf of what `save` has written; None: it is not there, or of another type."""
  if key in held:
    return held[key]
  forms = {
    _HALF: (np.uint16, lambda x: x.view(ml_dtypes.bfloat16).astype(np.float32)),
    _WEIGHT: (np.float16, lambda x: x.astype(np.float32)),
    _SQUARE: (np.uint8, lambda x: np.where(x > 0, 2.0 ** (x / 3.0 - 80), 0).astype(np.float32)),
    _FORGOTTEN: (np.bool_, lambda x: np.zeros(x.shape, np.float32)),
  }
  for suffix, (kind, read) in forms.items():
    value = held.get(key + suffix)
    if value is not None and value.dtype == kind:
      return read(value)
  return None


def called(trained: Trained) -> str:
  """The name of an agent that ships, the whole path of another's folder."""
  return named(trained.path) or str(pathlib.Path(trained.path).absolute())


def named(path: str) -> str | None:
  """The name of the agent that ships in this folder; None: another's."""
  folder = pathlib.Path(path).resolve()
  return folder.name if folder.parent == HERE.resolve() else None


def of(env: Any, path: str | None = None, **departures: Any) -> Trained:
  """`load` for the robot `env`, which is known by the name in its spec; its `agents_of` names
  another whose agents it takes.
  """
  return load(
    path,
    env.spec.name,
    len(env.spec.obs),
    len(env.spec.act),
    getattr(env, "agents_of", None),
    **departures,
  )


def numbered(env_name: str) -> list[str]:
  """Shipped agents of a robot, each of a training seed of its own, by the recipe of the one that it
  has without a path: NAME, NAME-2, ...

  Raises:
    UserError: where none ships.
  """
  name = _own_name(env_name, getattr(envs.ENVS.data.get(env_name), "agents_of", None))
  name = re.sub(r"-\d+$", "", name)
  found = [agent for agent in shipped() if re.fullmatch(rf"{re.escape(name)}(-\d+)?", agent)]
  require(found, f"no agent of {env_name!r} ships; shipped: {', '.join(shipped()) or 'none'}")
  return found


def _own_name(env_name: str, related: str | None) -> str:
  """The shipped agent that a robot has without a path."""
  name = own_agent(env_name)
  return own_agent(related) if related and name not in shipped() else name


def is_shipped(env: Any) -> bool:
  """Whether there is an agent for this robot without a path."""
  return _own_name(env.spec.name, getattr(env, "agents_of", None)) in shipped()


def read_card(folder: pathlib.Path) -> tuple[dict, DreamerConfig]:
  """The card of an agent, and the settings of its learner.

  Raises:
    FileError: a card that is broken or of something else.
  """
  path, where = folder / "card.json", "its settings"
  card = tables.read_json(path)
  held = {"env": None, "repeat": 1, "dreamer": None} | card
  try:
    kinds(where, CARD, held)
    fits = 1 <= held["repeat"] <= MOST_REPEAT
    require(fits, f"repeat must lie in 1..{MOST_REPEAT}; got {held['repeat']}")
    rate, anchor = held.get("finetuning_lr"), held.get("finetuning_anchor")
    require(rate is None or 0 < rate < 1, f"finetuning_lr must lie between 0 and 1; got {rate}")
    require(anchor is None or anchor >= 0, f"finetuning_anchor must be 0 or above; got {anchor}")
    require(isinstance(held["dreamer"], dict), "dreamer must be a table of settings")
    dreamer = recorded(DreamerConfig, held["dreamer"])
    field_kinds(where, DreamerConfig, dreamer, "dreamer.")
    return card, DreamerConfig(**dreamer)
  except (UserError, ValueError, TypeError) as e:
    raise FileError(f"{path} is not an agent's card: {e}") from None


def load(
  path: str | None,
  env_name: str,
  obs_size: int,
  act_size: int,
  agents_of: str | None = None,
  **departures: Any,
) -> Trained:
  """Loads an agent by shipped name or folder.

  Args:
    path: folder or shipped name; None: the robot's own (config.own_agent), or that of the robot
      whose agents it takes.
    env_name: robot that it must fit.
    obs_size: variables of its observation.
    act_size: variables of its action.
    agents_of: robot with the same observation, action and reward, whose agents fit too; None: that
      of the class registered under this name.
    departures: fields of its DreamerConfig to go on with otherwise, e.g. lr, see
      config.finetuning; None: its own, of policy_lr and model_lr 1.

  Raises:
    UserError: an agent of another robot or an unknown name.
    FileError: a broken or foreign file.
  """
  related = agents_of or getattr(envs.ENVS.data.get(env_name), "agents_of", None)
  name = path or _own_name(env_name, related)
  folder = pathlib.Path(name)
  if not (folder / "card.json").exists():
    folder = HERE / name
  if not (folder / "card.json").exists():
    require(
      path is not None,
      f"no agent ships for {env_name!r}: give one with --agent; mjx-cl train makes one, OUT/agent",
    )
    require(
      not pathlib.Path(name, "agent", "card.json").exists(),
      f"{name} is a training; its agent is {pathlib.Path(name, 'agent')}",
    )
    raise UserError(
      f"no agent {name!r}; shipped: {', '.join(shipped()) or 'none'}; or give a folder that "
      "holds agent.npz and card.json"
    )
  card, config = read_card(folder)
  if card["env"] not in (env_name, related):
    raise UserError(f"agent {name!r} was trained on {card['env']!r}, not on {env_name!r}")
  # whatever goes on from here does so at full learning rate, whatever its last stage held still
  departures = finetuning(departures, card)
  other = {"warmup": 0, "policy_lr": 1.0, "model_lr": 1.0} | {
    k: v for k, v in departures.items() if v is not None
  }
  config = dataclasses.replace(config, **other)
  agent = Agent(config, obs_size, act_size)
  like = jax.eval_shape(agent.init, jax.random.key(0))
  stored, leaves = arrays.read(folder / "agent.npz"), []
  for key, want in arrays.named(like).items():
    value = _stored(stored, key)
    if value is None or value.shape != want.shape or value.dtype.kind not in "fiub":
      raise FileError(
        f"{folder / 'agent.npz'} does not fit size {config.size} with {obs_size} observations "
        f"and {act_size} actions: {key}"
      )
    leaves.append(jnp.asarray(value, want.dtype))
  return Trained(agent, jax.tree.unflatten(jax.tree.structure(like), leaves), card, str(folder))
