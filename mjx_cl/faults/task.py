"""Changes of the task itself: what is rewarded, what is asked for."""

from typing import Any

import numpy as np
from jaxtyping import Array, Key

from mjx_cl.errors import UserError
from mjx_cl.faults.base import Fault, Ports, Severity, Values, fault
from mjx_cl.faults.kinds import scaled


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
    (names, mask, None),
    lambda severity: 1.0 - severity,
  )


def command_range(env: Any) -> Fault:
  """More is asked for: commands (or the speed to reach) leave the range of the training.   range' =
    range (1 + severity)

  Severity: 1 doubles it [m/s, rad/s]. Target: command, the only one. Owns `task.command_range`.
  Source: none; fault and range are this project's own choice.
  """

  def act(
    target: Any, memory: Any, severity: Severity, key: Key[Array, ""], ports: Ports
  ) -> Values:
    return memory, {"task.command_range": ports.model.task["command_range"] * (1.0 + severity)}

  return fault("command_range", env, ("task.command_range",), ("command",), act)


TASK = {"reward_weight": reward_weight, "command_range": command_range}
