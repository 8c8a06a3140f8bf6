"""What a fault cost and when the robot was back. Definitions: windows and recovery in control
steps, reward per step.
"""

import numpy as np

TRAIL = 1000  # steps of the trailing mean
HOLD = 2000  # steps for which it must stay
# of reward_pre; where that is negative, as much below it as 90 % are below a positive one
SHARE = 0.9
DROP = 2000  # steps after onset over which the drop is taken
FINAL = 2000  # last steps of the run


def reward_pre(
  reward: np.ndarray, onset: int, warmup: int, first_alarm: int | None
) -> float | None:
  """Mean reward of all steps before onset, after warm-up, before any alarm that was acted on; None
  where none are left.

  An alarm that is only logged (arm `none`) changes nothing that the robot does, so it does not end
  the window.
  """
  end = onset if first_alarm is None else min(onset, first_alarm)
  return float(np.mean(reward[warmup:end])) if end > warmup else None


def reward_drop(reward: np.ndarray, onset: int, pre: float | None) -> float | None:
  """(reward_pre - mean(onset .. onset + 2,000)) / |reward_pre|, of arm `none`."""
  if not pre:
    return None
  return float(np.copysign(1.0, pre) * (1.0 - np.mean(reward[onset : onset + DROP]) / pre))


def recovery_step(reward: np.ndarray, onset: int, pre: float | None) -> int | None:
  """First step from which the trailing 1,000-step mean stays at or above 90 % of reward_pre for
  2,000 steps, after it had fallen below.

    mean >= reward_pre - 0.1 |reward_pre|

  The mean lags by up to 1,000 steps. A stream whose mean never falls below after onset was never
  down: its recovery step is the onset. None: censored, or the run ends before the hold does.
  """
  return _held(_good(reward, pre), onset) if pre else None


def stable_step(
  reward: np.ndarray, terminated: np.ndarray, onset: int, pre: float | None
) -> int | None:
  """As `recovery_step`, with one demand more: not one of the 2,000 steps ends an episode early (a
  fall, a crash), `terminated` bool (steps,).

  A stream that neither falls nor loses a tenth after the onset was stable throughout: the onset.
  Source: "stable gait" of the paper's quadruped.
  """
  return _held(_good(reward, pre) & ~np.asarray(terminated, bool), onset) if pre else None


def _good(reward: np.ndarray, pre: float) -> np.ndarray:
  """Steps whose trailing mean is at or above 90 % of `pre`, bool."""
  sums = np.concatenate([[0.0], np.cumsum(reward, dtype=float)])
  steps = np.arange(len(reward))
  begin = np.maximum(0, steps + 1 - TRAIL)
  trailing = (sums[steps + 1] - sums[begin]) / (steps + 1 - begin)
  return trailing >= (SHARE if pre > 0 else 2 - SHARE) * pre


def _held(good: np.ndarray, onset: int) -> int | None:
  """First step of HOLD good ones in a row after the first bad one from `onset` on; `onset` where
  none is bad, None where there are none.
  """
  bad = np.flatnonzero(~good[onset:])
  if not len(bad):
    return onset
  run = 0
  for k in range(onset + int(bad[0]), len(good)):
    run = run + 1 if good[k] else 0
    if run == HOLD:
      return k - HOLD + 1
  return None


def return_lost(reward: np.ndarray, onset: int, pre: float | None) -> float | None:
  """Sum of (reward_pre - reward) from onset on."""
  return None if pre is None else float(np.sum(pre - reward[onset:]))


def return_lost_healthy(
  reward: np.ndarray, onset: int, pre: float | None, start: int | None
) -> float | None:
  """What adapting a healthy robot cost: sum of (reward_pre - reward) from the first start of
  adaptation to the onset.

  Args:
    reward: (steps,).
    onset: the number of steps for a robot that never breaks.
    pre: reward_pre.
    start: control step of the alarm, or of whatever else started adaptation; None: nothing.

  Returns:
    0 where nothing started before onset; None where there is no reward_pre to compare with.
  """
  if start is None or start >= onset:
    return 0.0
  return None if pre is None else float(np.sum(pre - reward[start:onset]))
