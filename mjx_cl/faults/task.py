"""Changes of the task itself: what is rewarded, what is asked for."""

from typing import Any

import numpy as np

from mjx_cl.errors import UserError
from mjx_cl.faults.base import Fault
from mjx_cl.faults.kinds import leafwise, scaled


def reward_weight(env: Any) -> Fault:
  """One term of the reward loses its weight.   w_k' = w_k (1 - severity)

  Severity: lost share [1]. Target: a term of the reward that counts (drawn; env.reward_terms). Owns
  `task.reward_weights`. Not visible to: the observation. Source: Greenberg and Mannor 2021 change
  the cost of actions; that a term fades, and the range, are this project's own choice.
  """
  terms = getattr(env, "reward_terms", ())
  weights = np.asarray(env.model.task.get("reward_weights", ()))
  # a term that counts nothing has nothing to lose
  counted = np.flatnonzero(weights[: len(terms)])
  if not counted.size:
    raise UserError(
      f"fault 'reward_weight' needs a reward of weighted terms, which robot {env.spec.name!r} "
      "does not have"
    )

  names, mask = tuple(terms[i] for i in counted), np.eye(len(weights), dtype=bool)[counted]
  return scaled(
    "reward_weight",
    env,
    "task.reward_weights",
    lambda severity: 1.0 - severity,
    (names, mask, None),
  )


def command_range(env: Any) -> Fault:
  """More is asked for: commands (or the speed to reach) leave the range of the training.   range' =
    range (1 + severity)

  Severity: 1 doubles it [m/s, rad/s]. Target: command, the only one. Owns `task.command_range`.
  Source: none; fault and range are this project's own choice.
  """
  return leafwise(
    "command_range",
    env,
    {"task.command_range": lambda value, _, severity: value * (1.0 + severity)},
    (("command",), None, None),
  )


TASK = {"reward_weight": reward_weight, "command_range": command_range}
