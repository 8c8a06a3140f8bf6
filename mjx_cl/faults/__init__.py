"""What can break (one function per fault), and when (`schedule.py`); named settings are in ../fault_presets.py. `FAULTS` is the one table.

A robot may have several faults in one compiled program, at once or one after the other: wherever a Fault is taken, a tuple of them is too. Their
severities, onsets, schedules and targets are arrays, so any mix over a batch of robots is one trace.
"""
from __future__ import annotations

import importlib.metadata
import inspect
import re

import jax.numpy as jnp

from mjx_cl.errors import UserError, choose
from mjx_cl.faults.actuator import ACTUATOR
from mjx_cl.faults.base import (Fault, Injection, Ports, State, as_tuple, begin, drive, fault, none, owned_model, sense)
from mjx_cl.faults.body import BODY
from mjx_cl.faults.contact import CONTACT
from mjx_cl.faults.schedule import FOREVER, SCHEDULES, Plan, plan
from mjx_cl.faults.sensor import SENSOR
from mjx_cl.faults.task import TASK
from mjx_cl.faults.transfer import TRANSFER

FAMILIES = {"actuator": ACTUATOR, "body": BODY, "contact": CONTACT, "sensor": SENSOR, "transfer": TRANSFER, "task": TASK}
FAULTS = {"none": none} | {name: make for family in FAMILIES.values() for name, make in family.items()}


def _plugins() -> None:
  """Adds the faults of other packages (entry-point group `mjx_cl.faults`); a name that is taken is an error."""
  for entry in importlib.metadata.entry_points(group="mjx_cl.faults"):
    if entry.name in FAULTS:
      raise UserError(f"fault {entry.name!r} of {entry.value} has a name that is taken")
    FAULTS[entry.name] = entry.load()
    FAMILIES.setdefault("plugin", {})[entry.name] = FAULTS[entry.name]


_plugins()


def family(name: str) -> str:
  """Name of the family of fault `name`."""
  return next((f for f, members in FAMILIES.items() if name in members), "none")


def about(name: str) -> str:
  """One line on fault `name` from its docstring: family, what happens, what severity means, what it owns."""
  text = inspect.getdoc(FAULTS[name]) or ""
  part = lambda word: next(iter(re.findall(rf"{word}:? (.*?)\.(?: [A-Z]|\n|$)", " ".join(text.split("\n\n")[-1].split()))), "")
  lines = [f"{family(name)}: {text.split(chr(10))[0]}"]
  lines += [f"severity: {part('Severity')}"] * bool(part("Severity")) + [f"target: {part('Target')}"] * bool(part("Target"))
  return "; ".join(lines)


def make(name: str, env) -> Fault:
  """Builds fault `name` for the robot `env`.

  Raises:
    UserError for an unknown name, or a fault that has nothing to act on in this robot.
  """
  return choose("fault", name, FAULTS)(env)


def available(env) -> dict[str, Fault]:
  """Every fault that `env` can have, by name."""
  out = {}
  for name, build in FAULTS.items():
    try:
      out[name] = build(env)
    except UserError:
      continue
  return out


def target_index(fault: Fault, target: str | None) -> int:
  """Index of a named target, -1 where it is to be drawn from the stream's seed (`random` or None)."""
  if target in (None, "random"):
    return -1
  if target not in fault.targets:
    raise UserError(f"unknown target {target!r} of fault {fault.name!r}; choose from: random, {', '.join(fault.targets)}")
  return fault.targets.index(target)


def build(changes, env, onset: int = 0):
  """The changes of a run (fault_presets.Change) on one robot.

  Returns:
    (faults, plan, targets): tuple of F Faults, Plan with leading (F,), int32 (F,); what `rollout.start` takes.
  """
  made = tuple(make(c.fault, env) for c in changes)
  targets = [target_index(f, c.target) for f, c in zip(made, changes)]
  column = lambda get: [get(c) for c in changes]
  kinds = [list(SCHEDULES).index(c.schedule) for c in changes]
  when = plan(column(lambda c: c.severity), column(lambda c: onset + c.after), column(lambda c: c.duration or FOREVER), kinds,
              column(lambda c: c.period), column(lambda c: c.share))
  return made, when, jnp.asarray(targets, jnp.int32)
