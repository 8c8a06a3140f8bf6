"""Thresholds that the leaderboard found on healthy robots."""

import functools
import json
import pathlib
from typing import NamedTuple


class Threshold(NamedTuple):
  """A threshold that was found on healthy robots.

  Attributes:
    value: decision level of the score.
    arl0: control steps per false alarm.
    alarms: that were counted.
  """

  value: float
  arl0: float
  alarms: int


@functools.cache
def _held() -> dict:
  return json.loads(pathlib.Path(__file__).with_suffix(".json").read_text())


def board() -> dict:
  """What the leaderboard at ARL0 = 100,000 control steps found: robot -> name on the board ->
  {settings, threshold, arl0, alarms}; written by benchmarks/thresholds.py from
  the folders that it names. The robot's own agent (config.own_agent), seeds 100 to 109; detectors
  that can be had at that rate alone.
  """
  return _held()["robots"]


def known_of(robot: str | None, agent: str | None = None) -> dict:
  """Rows of `board` that hold with this agent: its own, and, where it has no board of its own but
  single rows, the others of the robot's.
  """
  own = of_agents().get(agent or "", {})
  return own if len(own) > 1 else board().get(robot or "", {}) | own


def of_agents() -> dict:
  """Of other agents that ship: agent -> the same of the detectors whose thresholds are its own."""
  return _held()["agents"]
