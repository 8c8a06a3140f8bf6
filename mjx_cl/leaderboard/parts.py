"""The parts of a recording: what one program lives of a robot, and the file that keeps it."""

import itertools
import json
import pathlib
import zlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.errors import FileError
from mjx_cl.io import arrays, runtime
from mjx_cl.leaderboard import lives
from mjx_cl.leaderboard.streams import VERSION
from mjx_cl.leaderboard.suite import Suite
from mjx_cl.rollout.scan import stream_keys
from mjx_cl.training import agents

PARTS = tuple(itertools.product(("score", "tune"), ("nominal", "fault")))  # of a robot


class Part(NamedTuple):
  """What one program lives: a split's healthy or faulty robots.

  Attributes:
    who: lanes.
    keys: of the lanes.
    onsets: int, of the lanes.
    steps: control steps.
    watch_from: control step from which the monitor looks at faulty lanes.
    tag: lanes and length, which its file holds.
    of: onsets, agent and physics, likewise.
    signed: whether innovations are kept.
  """

  who: list[lives.Lane]
  keys: jax.Array
  onsets: np.ndarray
  steps: int
  watch_from: int
  tag: str
  of: str
  signed: bool = False


def part(
  suite: Suite,
  robot: str,
  split: str,
  kind: str,
  env: Any,
  trained: agents.Trained,
  physics: str,
) -> Part:
  """A part of a robot, see PARTS."""
  simulator = runtime.default_physics() if physics == "auto" else physics
  who, keys, onsets, steps, watch_from = who_lives(suite, robot, split, kind, env.spec.control_s)
  tag = json.dumps([who, steps, trained.card.get("updates"), VERSION, suite.innovations])
  of = json.dumps([onsets.tolist(), digest(trained.train.params), simulator])
  return Part(who, keys, onsets, steps, watch_from, tag, of, suite.innovations)


def live(
  own: Part,
  path: pathlib.Path,
  env: Any,
  trained: agents.Trained,
  progress: Callable[[int, int, int], Any],
) -> dict[str, np.ndarray]:
  """Lives a part, keeps it in a file and returns what `lives.live` gives."""
  data = lives.live(
    env, trained, own.who, own.keys, own.onsets, own.steps, own.watch_from, own.signed, progress
  )
  arrays.write(path, {"tag": own.tag, "of": own.of, **data})
  return data


def kept(path: pathlib.Path, own: Part) -> dict | None:
  """What an earlier recording left of a part, None where it is of something else or broken; a file
  may not tell onsets, agent and physics.
  """
  try:
    data = arrays.read(path)
  except FileError:
    return None
  told = str(data.pop("tag", None)), str(data.pop("of", own.of))
  return data if told == (own.tag, own.of) else None


def who_lives(
  suite: Suite, robot: str, split: str, kind: str, control_s: float
) -> tuple[list[lives.Lane], jax.Array, np.ndarray, int, int]:
  """Lanes of a part, their keys and onsets, its control steps, and that from which the monitor
  looks at faulty ones.
  """
  seeds = suite.numbers(split)
  if kind == "fault":
    who = lives.lanes(suite, robot, split)
    keys = jnp.stack([jax.random.key(lane.seed) for lane in who])
    onsets = np.asarray([suite.onset_of(lane.seed) for lane in who])
    return who, keys, onsets, int(onsets.max()) + suite.after(control_s), int(onsets.min())
  each = suite.nominal[split]
  who = [lives.Lane(s) for s in seeds for _ in range(each)]
  # the first key of a seed belongs to the faults
  own = np.flatnonzero(np.arange(len(seeds) * (each + 1)) % (each + 1))
  keys = stream_keys(seeds, each + 1)[own]
  return who, keys, np.zeros(len(who), int), suite.nominal["steps"], 0


def digest(params: Any) -> int:
  """CRC-32 of an agent's weights, which tells agents apart; config.json of a set holds it for each
  robot's.
  """
  return zlib.crc32(b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(params)))
