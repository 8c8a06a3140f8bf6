"""Faults of motors, transmissions and the line that brings them their commands.

Commands are in the agent's own units, [-1, 1] of the range. A target is one actuator, a group (one
leg) or all. Where a fault remembers, an episode's start fills its memory anew with the first
command.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.errors import UserError
from mjx_cl.faults.base import Fault, actuator_targets, fault, read

if TYPE_CHECKING:
  from collections.abc import Callable

  from mjx_cl.faults.base import Ports

MOST_DELAY = 9  # control steps at severity 1: the hard level of realworldrl_suite
LOCK = (10.0, 1000.0)  # [kg m^2], [N m s/rad] at severity 1


def dofs(env: Any, name: str) -> np.ndarray:
  """Which degree of freedom each actuator drives, float32 (A, nv) of 0 and 1: `mask @ dofs` is a
  mask of degrees of freedom.
  """
  model = getattr(env, "mj_model", None)
  if model is None or len(env.spec.targets) != model.nu:
    raise UserError(
      f"fault {name!r} needs a robot with one motor per joint, which {env.spec.name!r} is not"
    )
  return np.eye(model.nv, dtype=np.float32)[model.jnt_dofadr[model.actuator_trnid[:, 0]]]


def gear(env: Any) -> Fault:
  """One joint's gear ratio falls: a motor of the same command gives (1 - severity) of its torque.

    gear_j' = gear_j (1 - severity)

  Severity: lost share of the gear ratio [1], 0 to 1; the paper halves the gear, severity 0.5.
  Target: a joint (drawn), a leg or all. Owns `mj.actuator_gear` [ratio], (nu, 6). Not visible to: a
  robot that does not load the joint. Source: the paper's walker experiment.
  """
  names, mask, single = actuator_targets(env)

  def act(
    hit: jax.Array, memory: Any, severity: jax.Array, key: jax.Array, ports: Ports
  ) -> tuple[Any, dict[str, jax.Array]]:
    value = ports.model.mj["actuator_gear"]
    return memory, {"mj.actuator_gear": jnp.where(hit[:, None], value * (1.0 - severity), value)}

  return fault("gear", env, ("mj.actuator_gear",), names, act, drawn=single, rows=mask)


def torque_loss(env: Any) -> Fault:
  """A motor gives less torque than it computes (worn magnets, a dropped phase), after its own
  limits.

    torque_j' = torque_j (1 - severity)

  Severity: lost share [1], 0 to 1 (no torque). Target: a joint (drawn), a leg or all. Owns
  `task.strength` [1], (A,), or `mj.actuator_gear` where the motor has no law of its own (the
  walker). Source: torque factors 0.9 to 1.1 in training (Walk These Ways), 0 for a crippled leg
  (Nagabandi et al. 2019).
  """
  names, mask, single = actuator_targets(env)
  leaf = "task.strength" if "strength" in env.model.task else "mj.actuator_gear"

  def act(
    hit: jax.Array, memory: Any, severity: jax.Array, key: jax.Array, ports: Ports
  ) -> tuple[Any, dict[str, jax.Array]]:
    value = read(ports, leaf)
    return memory, {
      leaf: jnp.where(hit.reshape((-1,) + (1,) * (value.ndim - 1)), value * (1.0 - severity), value)
    }

  reason = (
    ""
    if leaf.startswith("mj.")
    else (
      "the position loop runs at every physics step, so a joint held less firmly may end a "
      "control step anywhere"
    )
  )
  return fault(
    "torque_loss", env, (leaf,), names, act, drawn=single, not_monotone=reason, rows=mask
  )


def velocity_limit(env: Any) -> Fault:
  """A drive reaches less speed: its torque falls to zero at a lower one.

    v_j' = v_j (1 - 0.95 severity)

  Severity: 1 leaves 5 % of the limit [rad/s; the car: m/s]; the paper's third is severity 0.7018.
  Target: a joint (drawn), a leg or all. Owns `task.velocity_limit`, (A,). Not visible to: a gait
  below the lower limit. Source: the paper's quadruped experiment.
  """
  names, mask, single = actuator_targets(env)

  def act(
    hit: jax.Array, memory: Any, severity: jax.Array, key: jax.Array, ports: Ports
  ) -> tuple[Any, dict[str, jax.Array]]:
    value = ports.model.task["velocity_limit"]
    return memory, {"task.velocity_limit": jnp.where(hit, value * (1.0 - 0.95 * severity), value)}

  return fault("velocity_limit", env, ("task.velocity_limit",), names, act, drawn=single, rows=mask)


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
  hits = mask.astype(jnp.float32) @ dofs(env, "joint_lock")

  def act(
    hit: jax.Array, memory: Any, severity: jax.Array, key: jax.Array, ports: Ports
  ) -> tuple[Any, dict[str, jax.Array]]:
    extra = severity * severity * hit
    armature, damping = ports.model.mj["dof_armature"], ports.model.mj["dof_damping"]
    return memory, {
      "mj.dof_armature": armature + LOCK[0] * extra,
      "mj.dof_damping": damping + LOCK[1] * extra,
    }

  return fault(
    "joint_lock", env, ("mj.dof_armature", "mj.dof_damping"), names, act, drawn=single, rows=hits
  )


def _command(
  name: str,
  env: Any,
  change: Callable[..., tuple[Any, jax.Array]],
  memory: Any = (),
  not_monotone: str = "",
) -> Fault:
  """A fault of the command alone; change(hit (A,), memory, severity, key, ports) -> (memory',
  ctrl').
  """
  names, mask, single = actuator_targets(env)

  def act(
    hit: jax.Array, memory: Any, severity: jax.Array, key: jax.Array, ports: Ports
  ) -> tuple[Any, dict[str, jax.Array]]:
    memory, value = change(hit, memory, severity, key, ports)
    return memory, {"ctrl": jnp.where(hit, value, ports.ctrl)}

  return fault(name, env, ("ctrl",), names, act, memory, single, not_monotone, mask)


def stuck(env: Any) -> Fault:
  """A command sticks at the last value that it had before the fault began.

    u_j' = (1 - severity) u_j + severity u_j(onset - 1)

  Severity: share of the held value [1]; 1 is stuck altogether. Target: an actuator (drawn), a group
  or all. Owns `ctrl`. Memory: the held command; an episode that starts later holds its own first
  command. Not visible to: a constant command. Source: stuck actions of realworldrl_suite, which
  stick now and then for some steps; here for good.
  """

  def change(
    hit: jax.Array, held: jax.Array, severity: jax.Array, key: jax.Array, ports: Ports
  ) -> tuple[jax.Array, jax.Array]:
    held = jnp.where((severity > 0) & ~ports.first, held, ports.ctrl)
    return held, (1.0 - severity) * ports.ctrl + severity * held

  return _command("stuck", env, change, jnp.zeros(len(env.spec.act)))


def offset(env: Any) -> Fault:
  """A constant is added to a command (a slipped encoder, a bent linkage).

    u_j' = clip(u_j + 0.5 severity, -1, 1)

  Severity: 1 adds half of the half-range [half-ranges]. Target: an actuator (drawn), a group or
  all. Owns `ctrl`. Not visible to: a command at its upper bound. Source: motor offsets of Walk
  These Ways; the range is this project's own choice.
  """
  return _command(
    "offset",
    env,
    lambda hit, m, severity, key, ports: (m, jnp.clip(ports.ctrl + 0.5 * severity, -1.0, 1.0)),
  )


def dead_band(env: Any) -> Fault:
  """Small commands do nothing (play, stiction); larger ones are short by the band.

    u_j' = sign(u_j) max(|u_j| - 0.5 severity, 0)

  Severity: 1 is a band of half the half-range [half-ranges]. Target: an actuator (drawn), a group
  or all. Owns `ctrl`. Source: none; fault and range are this project's own choice.
  """

  def change(
    hit: jax.Array, m: Any, severity: jax.Array, key: jax.Array, ports: Ports
  ) -> tuple[Any, jax.Array]:
    return m, jnp.sign(ports.ctrl) * jnp.maximum(jnp.abs(ports.ctrl) - 0.5 * severity, 0.0)

  return _command("dead_band", env, change)


def command_dropout(env: Any) -> Fault:
  """A command is lost now and then: the actuator gets 0 in that control step.

    P(u_j' = 0) = 0.5 severity, each actuator and step alone

  Severity: 1 loses every other command [probability]. Target: an actuator (drawn), a group or all.
  Owns `ctrl`. Source: dropped commands; realworldrl_suite drops observations with 0.01 to 0.1.
  """

  def change(
    hit: jax.Array, m: Any, severity: jax.Array, key: jax.Array, ports: Ports
  ) -> tuple[Any, jax.Array]:
    return m, jnp.where(jax.random.uniform(key, hit.shape) < 0.5 * severity, 0.0, ports.ctrl)

  return _command("command_dropout", env, change)


def command_delay(env: Any) -> Fault:
  """A command arrives late.

    u_j'(t) = u_j(t - d),   d = ceil(9 severity) control steps

  Severity: 1/3, 2/3, 1 are delays of 3, 6, 9 [control steps], realworldrl_suite's easy, medium,
  hard. Target: an actuator (drawn), a group or all. Owns `ctrl`. Memory: the last 9 commands; an
  episode's start fills it with its first command. Source: realworldrl_suite.
  """

  def change(
    hit: jax.Array, line: jax.Array, severity: jax.Array, key: jax.Array, ports: Ports
  ) -> tuple[jax.Array, jax.Array]:
    line = jnp.where(
      ports.first,
      jnp.broadcast_to(ports.ctrl, line.shape),
      jnp.concatenate([ports.ctrl[None], line[:-1]]),
    )
    return line, line[jnp.ceil(MOST_DELAY * severity).astype(jnp.int32)]

  return _command(
    "command_delay",
    env,
    change,
    jnp.zeros((MOST_DELAY + 1, len(env.spec.act))),
    "an older command may be nearer to the present one",
  )


def command_noise(env: Any) -> Fault:
  """Gaussian noise on a command.

    u_j' = clip(u_j + n, -1, 1),   n ~ N(0, severity^2)

  Severity: standard deviation [half-ranges]; 0.1, 0.3, 1.0 are realworldrl_suite's levels. Target:
  an actuator (drawn), a group or all. Owns `ctrl`. Source: realworldrl_suite.
  """

  def change(
    hit: jax.Array, m: Any, severity: jax.Array, key: jax.Array, ports: Ports
  ) -> tuple[Any, jax.Array]:
    return m, jnp.clip(ports.ctrl + severity * jax.random.normal(key, hit.shape), -1.0, 1.0)

  return _command("command_noise", env, change)


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
