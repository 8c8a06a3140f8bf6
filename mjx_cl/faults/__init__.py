"""What can break (one function per fault), and when (`schedule.py`); named settings are in
presets.py. `FAULTS` is the one table.

A robot may have several faults in one compiled program, at once or one after the other: wherever a
Fault is taken, a tuple of them is too. Their severities, onsets, schedules and targets are arrays,
so any mix over a batch of robots is one trace.
"""

import inspect
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Int

from mjx_cl.errors import PluginError, UserError, choose
from mjx_cl.faults.actuator import ACTUATOR
from mjx_cl.faults.base import (
  Fault,
  Injection,
  Ports,
  State,
  as_tuple,
  begin,
  drive,
  fault,
  none,
  owned_model,
  sense,
)
from mjx_cl.faults.body import BODY
from mjx_cl.faults.contact import CONTACT
from mjx_cl.faults.presets import SCHEDULES, Change
from mjx_cl.faults.schedule import FOREVER, Plan, numbers, plan
from mjx_cl.faults.sensor import SENSOR
from mjx_cl.faults.task import TASK
from mjx_cl.faults.transfer import TRANSFER
from mjx_cl.io.plugins import Registry, of_user, placed
from mjx_cl.types import Array

FAMILIES = {
  "actuator": ACTUATOR,
  "body": BODY,
  "contact": CONTACT,
  "sensor": SENSOR,
  "transfer": TRANSFER,
  "task": TASK,
}
FAULTS = Registry(
  "mjx_cl.faults",
  "fault",
  {"none": none} | {name: make for family in FAMILIES.values() for name, make in family.items()},
)


def family(name: str) -> str:
  """Name of the family of fault `name`; those of other packages and files are of family
  `plugin`.
  """
  return next(
    (f for f, members in FAMILIES.items() if name in members),
    "none" if name == "none" else "plugin",
  )


class Said(NamedTuple):
  """What the docstring of a fault says of it, "" where it does not say.

  Attributes:
    what: what happens, its first paragraph.
    severity: what it means.
    target: what a target is.
    owns: the leaves that it writes.
  """

  what: str
  severity: str
  target: str
  owns: str


def said(name: str) -> Said:
  """`Said` of fault `name`."""
  paragraphs = [" ".join(x.split()) for x in str(inspect.getdoc(FAULTS[name]) or "").split("\n\n")]
  last = paragraphs[-1].replace("`", "")
  hits = [
    re.search(rf"\b{word}:? (.*?)\.(?: [A-Z]|$)", last) for word in ("Severity", "Target", "Owns")
  ]
  return Said(paragraphs[0], *(hit[1] if hit else "" for hit in hits))


def about(name: str) -> str:
  """One line on fault `name` from its docstring: family, what happens, what severity means, what a
  target is, what it owns.
  """
  what, *rest = said(name)
  return "; ".join(
    [f"{family(name)}: {what}"]
    + [f"{word}: {text}" for word, text in zip(Said._fields[1:], rest) if text]
  )


def make(name: str, env: Any) -> Fault:
  """Builds fault `name` for the robot `env`.

  Raises:
    UserError: an unknown name, a fault that has nothing to act on in this robot, and whatever
      goes wrong in one of another package.
  """
  try:
    made: Any = choose("fault", name, FAULTS)(env)
    if not isinstance(made, Fault):
      raise PluginError(
        f"fault {name!r} gives {type(made).__name__} in place of a Fault, see "
        "mjx_cl.faults.base.fault"
      )
    return made
  except UserError:
    raise
  except BaseException as e:  # whatever a foreign function raises
    if of_user(e):
      raise
    if getattr(e, "name", None) == "mj_model" and not hasattr(env, "mj_model"):
      raise UserError(
        f"fault {name!r} acts on a MuJoCo model, which robot {env.spec.name!r} does not have"
      ) from None
    if name in FAULTS.own:
      raise
    raise PluginError(
      f"fault {name!r} cannot be built for robot {env.spec.name!r}: {placed(e)}"
    ) from e


def available(env: Any) -> dict[str, Fault]:
  """Every fault that `env` can have, by name."""
  out = {}
  for name in FAULTS:
    try:
      out[name] = make(name, env)
    except UserError as e:
      if isinstance(e, PluginError):
        raise
  return out


def target_index(fault: Fault, target: str | None) -> int:
  """Index of a named target, -1 where it is to be drawn from the stream's seed (`random`
  or None).
  """
  if target in (None, "random"):
    return -1
  if target not in fault.targets:
    raise UserError(
      f"unknown target {target!r} of fault {fault.name!r}; choose from: random, "
      f"{', '.join(fault.targets)}"
    )
  return fault.targets.index(target)


def build(
  changes: Sequence[Change], env: Any, onset: int = 0
) -> tuple[tuple[Fault, ...], Plan, Int[Array, " faults"]]:
  """The changes of a run (presets.Change) on one robot.

  Returns:
    (faults, plan, targets): tuple of F Faults, Plan with leading (F,), targets; what
    `rollout.start` takes.
  """
  made = tuple(make(c.fault, env) for c in changes)
  when = plan(*zip(*(numbers(c, onset) for c in changes)))
  return (
    made,
    when,
    jnp.asarray([target_index(f, c.target) for f, c in zip(made, changes)], jnp.int32),
  )
