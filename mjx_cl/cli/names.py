"""The command list: names that other commands take. Free of JAX where no plug-in is installed."""

import importlib.metadata
import json
import pathlib

from mjx_cl.cli.flags import List
from mjx_cl.cli.output import emit
from mjx_cl.errors import choose
from mjx_cl.io import runtime

FILE = pathlib.Path(__file__).parent / "names.json"  # what registries.tables gives without plug-ins
GROUPS = ("mjx_cl.envs", "mjx_cl.faults", "mjx_cl.detectors")  # of entry points


def do_list(args: List) -> None:
  """Prints the names that other commands take."""
  known = json.loads(FILE.read_text())
  chosen = choose("list", args.what, {"all": list(known)} | {name: [name] for name in known})
  if any(importlib.metadata.entry_points(group=group) for group in GROUPS):
    runtime.setup()
    from mjx_cl.cli import registries  # imports JAX

    known = registries.tables(chosen)
  if args.json:
    emit({kind: known[kind] for kind in chosen})
    return
  for kind in chosen:
    print(kind)
    for name, about in known[kind].items():
      print(f"  {name:22s} {about}")
