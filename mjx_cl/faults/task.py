"""Changes of the task itself: what is rewarded, what is asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from mjx_cl.errors import UserError
from mjx_cl.faults.base import Fault, fault

if TYPE_CHECKING:
  import jax

  from mjx_cl.faults.base import Ports


def reward_weight(env: Any) -> Fault:
  """One term of the reward loses its weight.   w_k' = w_k (1 - severity)

  Severity: lost share [1]. Target: a term of the reward that counts (drawn; env.reward_terms). Owns
  `task.reward_weights`. Not visible to: the observation. Source: Greenberg and Mannor 2021 change
  the cost of actions; that a term fades, and the range, are this project's own choice.
  """
  terms = getattr(env, "reward_terms", ())
  weights = np.asarray(env.model.task.get("reward_weights", ()))
  counted = [
    i for i, w in enumerate(weights[: len(terms)]) if w != 0
  ]  # a term that counts nothing has nothing to lose
  if not counted:
    raise UserError(
      f"fault 'reward_weight' needs a reward of weighted terms, which robot {env.spec.name!r} "
      "does not have"
    )

  def act(
    hit: jax.Array, memory: Any, severity: jax.Array, key: jax.Array, ports: Ports
  ) -> tuple[Any, dict[str, jax.Array]]:
    value = ports.model.task["reward_weights"]
    return memory, {"task.reward_weights": jnp.where(hit, value * (1.0 - severity), value)}

  return fault(
    "reward_weight",
    env,
    ("task.reward_weights",),
    [terms[i] for i in counted],
    act,
    rows=np.eye(len(weights), dtype=bool)[counted],
  )


def command_range(env: Any) -> Fault:
  """More is asked for: commands (or the speed to reach) leave the range of the training.   range' =
    range (1 + severity)

  Severity: 1 doubles it [m/s, rad/s]. Target: command, the only one. Owns `task.command_range`.
  Source: none; fault and range are this project's own choice.
  """

  def act(
    target: jax.Array, memory: Any, severity: jax.Array, key: jax.Array, ports: Ports
  ) -> tuple[Any, dict[str, jax.Array]]:
    return memory, {"task.command_range": ports.model.task["command_range"] * (1.0 + severity)}

  return fault("command_range", env, ("task.command_range",), ("command",), act)


TASK = {"reward_weight": reward_weight, "command_range": command_range}
