"""What can break (one function per fault) and when (`schedule.py`). `FAULTS` is the one table."""
from __future__ import annotations

from mjx_cl.errors import UserError, choose
from mjx_cl.faults.actuator import gear
from mjx_cl.faults.base import Fault, Injection, Ports, inject, none

FAULTS = {"none": none, "gear": gear}


def make(name: str, spec) -> Fault:
  """Builds fault `name` for a robot whose Spec is `spec`."""
  return choose("fault", name, FAULTS)(spec)


def target_index(fault: Fault, target: str | None) -> int:
  """Index of a named target, -1 where it is to be drawn from the stream's seed (`random` or None)."""
  if target in (None, "random"):
    return -1
  if target not in fault.targets:
    raise UserError(f"unknown target {target!r} of fault {fault.name!r}; choose from: random, {', '.join(fault.targets)}")
  return fault.targets.index(target)
