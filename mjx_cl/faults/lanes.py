"""Lanes of a certificate: which fault, target and severity each robot of the one program has."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from mjx_cl.faults import presets, schedule
from mjx_cl.faults.base import Fault
from mjx_cl.types import Array

SEVERITIES = (0.0, 0.25, 0.5, 0.75, 1.0)
# lanes at a time: XLA cuts a wide batch into shares and their rests, which scalar code computes
# with other last bits
WIDTH = 64
REST = presets.Change("none", severity=0.0)


class Lane(NamedTuple):
  """One robot of the proof.

  Attributes:
    fault: name of a fault, or of a preset.
    target: its name; `preset` of a preset.
    severity: in [0, 1].
  """

  fault: str
  target: str
  severity: float

  @property
  def changes(self) -> tuple[presets.Change, ...]:
    """What the robot of this lane meets."""
    if presets.named(self.fault):
      return presets.PRESETS[self.fault].changes
    return (presets.Change(*self),)


def lanes(
  faults: Mapping[str, Fault],
  severities: Sequence[float] = SEVERITIES,
  targets: bool = True,
) -> list[Lane]:
  """Every severity on the first target, and severity 1 on all others; of a sensor, whose channels
  are many, on those that may be drawn.
  """
  out = []
  for name, f in faults.items():
    others = f.targets[1 : f.drawn if f.senses else None] if targets else ()
    out += [Lane(name, f.targets[0], s) for s in severities]
    out += [Lane(name, target, 1.0) for target in others]
  return out


def preset_lanes(env: Any, faults: Mapping[str, Fault]) -> list[Lane]:
  """One lane for every preset that this robot can have."""
  return [
    Lane(name, "preset", max(c.severity for c in preset.changes))
    for name, preset in presets.PRESETS.items()
    if preset.robot in (env.spec.name, "*")
    and preset.changes
    and all(c.fault in faults for c in preset.changes)
  ]


def parts(chosen: list[Lane]) -> list[list[Lane]]:
  """Lanes in batches that leave room for the nominal robot; a fault's lanes stay together, as far
  as they fit.
  """
  out: list[list[Lane]] = [[]]
  for name in dict.fromkeys(lane.fault for lane in chosen):
    mine = [lane for lane in chosen if lane.fault == name]
    for i in range(0, len(mine), WIDTH - 1):
      batch = mine[i : i + WIDTH - 1]
      if len(out[-1]) + len(batch) > WIDTH - 1:
        out.append([])
      out[-1] += batch
  return out


def plans(
  faults: Mapping[str, Fault], chosen: Sequence[Lane], onset: int
) -> tuple[schedule.Plan, Int[Array, "lanes faults"]]:
  """Plan (lanes, F) and targets: each lane has its own fault or faults, the others rest at
  severity 0.

  Of a preset that has a fault again, later, its first time counts here: each fault has one place in
  the program, and the proof is of what it does.
  """
  table = []
  for lane in chosen:
    if len({(c.fault, c.after) for c in lane.changes}) < len(lane.changes):
      raise ValueError(
        f"preset {lane.fault!r} has a fault twice at once, which one program cannot hold"
      )
    # the earliest of each fault comes last, and stays
    mine = {c.fault: c for c in sorted(lane.changes, key=lambda c: -c.after)}
    table.append([mine.get(name, REST) for name in faults])
  cells = np.array([[schedule.numbers(c, onset) for c in row] for row in table])
  targets = [
    [0 if c.target is None else f.targets.index(c.target) for c, f in zip(row, faults.values())]
    for row in table
  ]
  return (
    schedule.plan(*np.moveaxis(cells, -1, 0)),
    jnp.asarray(targets, jnp.int32),
  )
