"""Alarms against the true onset: latency, misses, false alarms. Times are control steps."""

from typing import NamedTuple

import numpy as np


class AlarmScore(NamedTuple):
  """Alarms of one stream.

  Attributes:
    alarm_step: first alarm at or after onset, None where there is none (censored at the end).
    latency_steps: alarm_step - onset.
    false_alarms: alarms before onset.
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
  early = int(np.sum(steps < onset))
  if early == len(steps):
    return AlarmScore(None, None, early)
  return AlarmScore(int(steps[early]), int(steps[early]) - onset, early)
