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
  results/leaderboard_100k and, of `learnt` and `innovations`, the folders of that name. The agent
  that ships under the robot's name, seeds 100 to 109; detectors that can be had at that rate alone.
  """
  return _held()["robots"]


def of_agents() -> dict:
  """Of other agents that ship: agent -> the same of the detectors whose thresholds are its own."""
  return _held()["agents"]
