"""Alarms against the true onset: latency, misses, false alarms. Times are control steps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class AlarmScore(NamedTuple):
  """Attributes:
  alarm_step: first alarm at or after onset, None where there is none (censored at the end).
  latency_steps: alarm_step - onset. false_alarms: alarms before onset.
  """

  alarm_step: int | None
  latency_steps: int | None
  false_alarms: int


def score(alarm: np.ndarray, onset: int) -> AlarmScore:
  """Scores one stream.

  Args:
    alarm: bool (steps,), alarm[k] is known after control step k.
    onset: first control step that the fault acts in.
  """
  steps = np.flatnonzero(alarm)
  after = steps[steps >= onset]
  first = int(after[0]) if len(after) else None
  return AlarmScore(first, None if first is None else first - onset, int(np.sum(steps < onset)))


def false_alarms_per_hour(count: int, steps: int, control_s: float) -> float | None:
  """False alarms per hour of robot time before onset."""
  return count / (steps * control_s / 3600.0) if steps else None
