"""Kinds of faults that several are of: a leaf is scaled; a command or a reading is changed, lost or
late.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, PRNGKeyArray, Shaped

from mjx_cl.faults.base import (
  Fault,
  Ports,
  Severity,
  Values,
  actuator_targets,
  channel_targets,
  fault,
  read,
)
from mjx_cl.types import Array

MOST_DELAY = 9  # control steps at severity 1: the hard level of realworldrl_suite


def along(row: Shaped[Array, "..."], value: Shaped[Array, "..."]) -> Shaped[Array, "..."]:
  """`row`, an entry for each along the first axis of `value`, with as many axes as that."""
  return row.reshape(row.shape + (1,) * (value.ndim - row.ndim))


Targets = tuple[tuple[str, ...], Any, int | None]  # names, rows, how many may be drawn (None: all)


def leafwise(
  name: str,
  env: Any,
  maps: Mapping[str, Callable[[Array, Any, Severity], Array]],
  targets: Targets,
  not_monotone: str = "",
) -> Fault:
  """A fault without memory whose leaves change each by itself.

  Args:
    name: registry name.
    env: robot.
    maps: leaf -> (value, row of the target, severity) -> new value.
    targets: names, what each stands for (None: nothing), and how many may be drawn.
    not_monotone: as of `fault`.
  """
  names, rows, drawn = targets

  def act(row: Any, memory: Any, severity: Severity, key: PRNGKeyArray, ports: Ports) -> Values:
    return memory, {leaf: new(read(ports, leaf), row, severity) for leaf, new in maps.items()}

  return fault(name, env, tuple(maps), names, act, (), drawn, not_monotone, rows)


def scaled(
  name: str,
  env: Any,
  leaf: str,
  factor: Callable[[Severity], Severity],
  targets: Targets,
  not_monotone: str = "",
) -> Fault:
  """A fault that multiplies the target's entries of one leaf by factor(severity)."""
  change = lambda value, hit, severity: jnp.where(
    along(hit, value), value * factor(severity), value
  )
  return leafwise(name, env, {leaf: change}, targets, not_monotone)


def signal(
  name: str,
  env: Any,
  port: str,
  change: Callable[[Any, Severity, PRNGKeyArray, Ports], tuple[Any, Array]],
  memory: Any = (),
  not_monotone: str = "",
) -> Fault:
  """A fault of the command or of the reading alone.

  Args:
    name: registry name.
    env: robot.
    port: `ctrl` or `obs`.
    change: (memory, severity, key, ports) -> (memory', the whole signal as it is where the fault
      hits).
    memory: as of `fault`.
    not_monotone: as of `fault`.
  """
  names, mask, drawn = (actuator_targets if port == "ctrl" else channel_targets)(env)

  def act(
    hit: Bool[Array, " n"], memory: Any, severity: Severity, key: PRNGKeyArray, ports: Ports
  ) -> Values:
    memory, value = change(memory, severity, key, ports)
    return memory, {port: jnp.where(hit, value, read(ports, port))}

  return fault(name, env, (port,), names, act, memory, drawn, not_monotone, mask)


def steady(
  name: str, env: Any, port: str, change: Callable[[Array, Severity, PRNGKeyArray], Array]
) -> Fault:
  """A `signal` without memory; change: (the signal, severity, key) -> the signal where it hits."""
  return signal(
    name, env, port, lambda m, severity, key, ports: (m, change(read(ports, port), severity, key))
  )


def loss(name: str, env: Any, port: str) -> Fault:
  """Entries of a signal are 0 with probability 0.5 severity, each entry and step alone."""
  zeros = lambda value, severity, key: jnp.where(
    jax.random.uniform(key, value.shape) < 0.5 * severity, 0.0, value
  )
  return steady(name, env, port, zeros)


def late(name: str, env: Any, port: str, not_monotone: str) -> Fault:
  """A signal arrives ceil(9 severity) control steps late; an episode's start fills the line."""

  def change(
    line: Float[Array, "steps n"], severity: Severity, key: PRNGKeyArray, ports: Ports
  ) -> tuple[Float[Array, "steps n"], Float[Array, " n"]]:
    value = read(ports, port)
    line = jnp.where(
      ports.first,
      jnp.broadcast_to(value, line.shape),
      jnp.concatenate([value[None], line[:-1]]),
    )
    return line, line[jnp.ceil(MOST_DELAY * severity).astype(jnp.int32)]

  size = len(env.spec.act if port == "ctrl" else env.spec.obs)
  return signal(name, env, port, change, jnp.zeros((MOST_DELAY + 1, size)), not_monotone)
