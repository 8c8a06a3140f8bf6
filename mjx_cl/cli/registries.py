"""What the registries hold, name by name."""

import inspect
import itertools
from collections.abc import Callable, Iterable, Mapping

from mjx_cl import detectors, envs, faults
from mjx_cl.adapt.arms import ARMS
from mjx_cl.config import PRESETS
from mjx_cl.faults import presets
from mjx_cl.leaderboard import streams
from mjx_cl.runs import suite
from mjx_cl.training import agents, needs


def first(member: object) -> str:
  """First paragraph of its docstring."""
  return " ".join(inspect.cleandoc(str(member.__doc__ or "")).split("\n\n")[0].split())


def shortened(names: Iterable[str]) -> str:
  """Names in a row; of x_00, x_01, ... the first and the last."""
  out = []
  for stem, own in itertools.groupby(names, lambda name: name.rstrip("0123456789")):
    same = list(own)
    numbered = len(same) > 2 and stem != same[0]
    out += [f"{same[0]} to {same[-1]}"] if numbered else same
  return ", ".join(out)


def targets() -> dict[str, str]:
  """Robot -> the faults that it can have, with what they can hit, those of the same targets
  together.
  """
  out = {}
  for robot in envs.ENVS:
    same: dict[tuple[str, ...], list[str]] = {}
    for name, fault in faults.available(envs.make(robot)).items():
      same.setdefault(fault.targets, []).append(name)
    out[robot] = "; ".join(f"{', '.join(own)}: {shortened(hit)}" for hit, own in same.items())
  return out


TABLES: dict[str, Callable[[], Mapping[str, str]]] = {
  "envs": lambda: {k: first(v) for k, v in envs.ENVS.items()},
  "faults": lambda: {k: faults.about(k) for k in faults.FAULTS},
  "targets": targets,
  "detectors": lambda: {k: first(v) for k, v in detectors.DETECTORS.items()},
  "presets": lambda: {k: p.about for k, p in PRESETS.items()},
  "agents": lambda: dict.fromkeys(agents.shipped(), "shipped"),
  "arms": lambda: {k: a.about for k, a in ARMS.items()},
  "fault-presets": lambda: {k: f"{p.about} ({p.source})" for k, p in presets.PRESETS.items()},
  "schedules": lambda: presets.SCHEDULES,
  "sizes": needs.table,
  "suites": streams.about,
  "benches": suite.shipped,
}


def tables(kinds: Iterable[str]) -> dict[str, dict[str, str]]:
  """Kind -> name -> a line about it, plug-ins included."""
  return {kind: dict(TABLES[kind]()) for kind in kinds}
