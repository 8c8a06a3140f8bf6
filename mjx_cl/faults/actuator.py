"""Faults of motors, transmissions and the line that brings them their commands.

Commands are in the agent's own units, [-1, 1] of the range, and faults act on them as the policy
gives them, before the environment clips them: one far beyond the range hides a small change. A
target is one actuator, a group (one leg) or all. Where a fault remembers, an episode's start fills
its memory anew with the first command.
"""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from mjx_cl.errors import UserError
from mjx_cl.faults.base import Fault, Ports, Severity, actuator_targets
from mjx_cl.faults.kinds import late, leafwise, loss, scaled, signal, steady
from mjx_cl.types import Array

LOCK = (10.0, 1000.0)  # [kg m^2], [N m s/rad] at severity 1


def dofs(env: Any, name: str) -> Float[np.ndarray, "act nv"]:
  """Which degree of freedom each actuator drives, of 0 and 1: `mask @ dofs` is a mask of degrees of
  freedom.
  """
  model = getattr(env, "mj_model", None)
  if model is None or len(env.spec.targets) != model.nu:
    raise UserError(
      f"fault {name!r} needs a robot with one motor per joint, which {env.spec.name!r} is not"
    )
  joint = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
  if not np.isin(model.actuator_trntype, joint).all():
    raise UserError(
      f"fault {name!r} needs motors that act on joints, not on tendons, sites or bodies as in "
      f"robot {env.spec.name!r}"
    )
  driven = model.actuator_trnid[:, 0]
  if len(set(driven.tolist())) < model.nu:
    raise UserError(
      f"fault {name!r} needs one motor per joint; robot {env.spec.name!r} has a joint with several"
    )
  return np.eye(model.nv, dtype=np.float32)[model.jnt_dofadr[driven]]


def check_motors(env: Any, name: str) -> None:
  """Raises UserError where a scaled gear would move a servo's target instead of weakening it."""
  model = getattr(env, "mj_model", None)
  if model is not None and (model.actuator_biastype != mujoco.mjtBias.mjBIAS_NONE).any():
    raise UserError(
      f"fault {name!r} needs motors that give a torque; those of robot {env.spec.name!r} are "
      "servos, whose target a scaled gear would move"
    )


def gear(env: Any) -> Fault:
  """One joint's gear ratio falls: a motor of the same command gives (1 - severity) of its torque.

    gear_j' = gear_j (1 - severity)

  Severity: lost share of the gear ratio [1], 0 to 1; the paper halves the gear, severity 0.5.
  Target: a joint (drawn), a leg or all. Owns `mj.actuator_gear` [ratio], (nu, 6). Not visible to: a
  robot that does not load the joint. Source: the paper's walker experiment.
  """
  check_motors(env, "gear")
  return scaled(
    "gear", env, "mj.actuator_gear", lambda severity: 1.0 - severity, actuator_targets(env)
  )


def torque_loss(env: Any) -> Fault:
  """A motor gives less torque than it computes (worn magnets, a dropped phase), after its own
  limits.

    torque_j' = torque_j (1 - severity)

  Severity: lost share [1], 0 to 1 (no torque). Target: a joint (drawn), a leg or all. Owns
  `task.strength` [1], (A,), or `mj.actuator_gear` where the motor has no law of its own (the
  walker). Source: torque factors 0.9 to 1.1 in training (Walk These Ways), 0 for a crippled leg
  (Nagabandi et al. 2019).
  """
  inner = "strength" in env.model.task
  if not inner:
    check_motors(env, "torque_loss")
  return scaled(
    "torque_loss",
    env,
    "task.strength" if inner else "mj.actuator_gear",
    lambda severity: 1.0 - severity,
    actuator_targets(env),
    "the position loop runs at every physics step, so a joint held less firmly may end a control "
    "step anywhere"
    if inner
    else "",
  )


def velocity_limit(env: Any) -> Fault:
  """A drive reaches less speed: its torque falls to zero at a lower one.

    v_j' = v_j (1 - 0.95 severity)

  Severity: 1 leaves 5 % of the limit [rad/s; the car: m/s]; the paper's third is severity 0.7018.
  Target: a joint (drawn), a leg or all. Owns `task.velocity_limit`, (A,). Not visible to: a gait
  below the lower limit. Source: the paper's quadruped experiment.
  """
  return scaled(
    "velocity_limit",
    env,
    "task.velocity_limit",
    lambda severity: 1.0 - 0.95 * severity,
    actuator_targets(env),
  )


def joint_lock(env: Any) -> Fault:
  """A joint seizes: it grows heavy and stiff until it hardly moves.

    armature_j' = armature_j + 10 severity^2 [kg m^2],   damping_j' = damping_j + 1,000 severity^2
      [N m s/rad]

  Severity: square root of the share of what holds a joint [1]; 1 holds it: it stops within 10 ms
  and creeps at 0.1 rad/s under 100 N m; 0.5 is a quarter of that. Target: a joint (drawn), a leg or
  all. Owns `mj.dof_armature`, `mj.dof_damping`, (nv,). Damping alone would do in the air, but
  MuJoCo's contact solver does not know of implicit damping: beyond hD = M (h the physics step) a
  leg on the ground gains speed from it; with the armature hD / M stays at 0.5. Source: crippled
  joints of Nagabandi et al. 2019, which are limp; that one is held is this project's own choice.
  """
  names, mask, single = actuator_targets(env)
  holds = {
    "mj.dof_armature": lambda value, hit, severity: value + LOCK[0] * (severity * severity * hit),
    "mj.dof_damping": lambda value, hit, severity: value + LOCK[1] * (severity * severity * hit),
  }
  return leafwise(
    "joint_lock", env, holds, (names, mask.astype(jnp.float32) @ dofs(env, "joint_lock"), single)
  )


def stuck(env: Any) -> Fault:
  """A command sticks at the last value that it had before the fault began.

    u_j' = (1 - severity) u_j + severity u_j(onset - 1)

  Severity: share of the held value [1]; 1 is stuck altogether. Target: an actuator (drawn), a group
  or all. Owns `ctrl`. Memory: the held command; an episode that starts later holds its own first
  command. Not visible to: a constant command. Source: stuck actions of realworldrl_suite, which
  stick now and then for some steps; here for good.
  """

  def change(
    held: Float[Array, " act"], severity: Severity, key: PRNGKeyArray, ports: Ports
  ) -> tuple[Float[Array, " act"], Float[Array, " act"]]:
    held = jnp.where((severity > 0) & ~ports.first, held, ports.ctrl)
    return held, (1.0 - severity) * ports.ctrl + severity * held

  return signal("stuck", env, "ctrl", change, jnp.zeros(len(env.spec.act)))


def offset(env: Any) -> Fault:
  """A constant is added to a command (a slipped encoder, a bent linkage).

    u_j' = clip(u_j + 0.5 severity, -1, 1)

  Severity: 1 adds half of the half-range [half-ranges]. Target: an actuator (drawn), a group or
  all. Owns `ctrl`. Not visible to: a command at its upper bound. Source: motor offsets of Walk
  These Ways; the range is this project's own choice.
  """
  return steady(
    "offset", env, "ctrl", lambda u, severity, key: jnp.clip(u + 0.5 * severity, -1.0, 1.0)
  )


def dead_band(env: Any) -> Fault:
  """Small commands do nothing (play, stiction); larger ones are short by the band.

    u_j' = sign(u_j) max(|u_j| - 0.5 severity, 0)

  Severity: 1 is a band of half the half-range [half-ranges]. Target: an actuator (drawn), a group
  or all. Owns `ctrl`. Source: none; fault and range are this project's own choice.
  """
  return steady(
    "dead_band",
    env,
    "ctrl",
    lambda u, severity, key: jnp.sign(u) * jnp.maximum(jnp.abs(u) - 0.5 * severity, 0.0),
  )


def command_dropout(env: Any) -> Fault:
  """A command is lost now and then: the actuator gets 0 in that control step.

    P(u_j' = 0) = 0.5 severity, each actuator and step alone

  Severity: 1 loses every other command [probability]. Target: an actuator (drawn), a group or all.
  Owns `ctrl`. Source: dropped commands; realworldrl_suite drops observations with 0.01 to 0.1.
  """
  return loss("command_dropout", env, "ctrl")


def command_delay(env: Any) -> Fault:
  """A command arrives late.

    u_j'(t) = u_j(t - d),   d = ceil(9 severity) control steps

  Severity: 1/3, 2/3, 1 are delays of 3, 6, 9 [control steps], realworldrl_suite's easy, medium,
  hard. Target: an actuator (drawn), a group or all. Owns `ctrl`. Memory: the last 9 commands; an
  episode's start fills it with its first command. Source: realworldrl_suite.
  """
  return late("command_delay", env, "ctrl", "an older command may be nearer to the present one")


def command_noise(env: Any) -> Fault:
  """Gaussian noise on a command.

    u_j' = clip(u_j + n, -1, 1),   n ~ N(0, severity^2)

  Severity: standard deviation [half-ranges]; 0.1, 0.3, 1.0 are realworldrl_suite's levels. Target:
  an actuator (drawn), a group or all. Owns `ctrl`. Source: realworldrl_suite.
  """
  return steady(
    "command_noise",
    env,
    "ctrl",
    lambda u, severity, key: jnp.clip(u + severity * jax.random.normal(key, u.shape), -1.0, 1.0),
  )


ACTUATOR = {
  "gear": gear,
  "torque_loss": torque_loss,
  "velocity_limit": velocity_limit,
  "joint_lock": joint_lock,
  "stuck": stuck,
  "offset": offset,
  "dead_band": dead_band,
  "command_dropout": command_dropout,
  "command_delay": command_delay,
  "command_noise": command_noise,
}
