"""The command list: names that other commands take."""

from collections.abc import Callable, Mapping

from mjx_cl import detectors, envs, faults
from mjx_cl.adapt.arms import ARMS
from mjx_cl.cli.flags import List
from mjx_cl.cli.output import emit
from mjx_cl.config import PRESETS
from mjx_cl.errors import choose
from mjx_cl.faults import presets
from mjx_cl.leaderboard import streams
from mjx_cl.runs import suite
from mjx_cl.training import agents, needs


def first(member: object) -> str:
  """First line of its docstring."""
  return str(member.__doc__ or "").strip().split("\n")[0]


TABLES: dict[str, Callable[[], Mapping[str, str]]] = {
  "envs": lambda: {k: first(v) for k, v in envs.ENVS.items()},
  "faults": lambda: {k: faults.about(k) for k in faults.FAULTS},
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


def do_list(args: List) -> None:
  """Prints the names that other commands take."""
  chosen = choose("list", args.what, {"all": list(TABLES)} | {name: [name] for name in TABLES})
  tables = {kind: TABLES[kind]() for kind in chosen}
  if args.json:
    emit(tables)
    return
  for kind, table in tables.items():
    print(kind)
    for name, about in table.items():
      print(f"  {name:22s} {about}")
