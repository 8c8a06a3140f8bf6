"""The command list: names that other commands take. Free of JAX where no plug-in is installed:
`python -m mjx_cl.cli.names` writes anew what it reads.
"""

import importlib.metadata
import json
import pathlib
import shutil
import textwrap
from collections.abc import Iterable

from mjx_cl.cli.flags import List
from mjx_cl.cli.output import emit
from mjx_cl.errors import choose
from mjx_cl.io import folders, runtime

FILE = pathlib.Path(__file__).parent / "names.json"  # what registries.tables gives without plug-ins
GROUPS = ("mjx_cl.envs", "mjx_cl.faults", "mjx_cl.detectors", "mjx_cl.methods")  # of entry points


# of headings that do not speak for themselves
ABOUT = {
  "envs": " (or brax:NAME, playground:NAME, FILE.py:NAME of your own, docs/extending.md)",
  "arms": " (or FILE.py:NAME of your own, docs/extending.md)",
  "suites": " (of recorded streams, for record)",
  "benches": " (suites of runs, for bench)",
}


def _live(kinds: Iterable[str] | None = None) -> dict[str, dict[str, str]]:
  """What the registries hold of these kinds; None: of all."""
  runtime.setup()
  from mjx_cl.cli import registries  # imports JAX

  return registries.tables(registries.TABLES if kinds is None else kinds)


def do_list(args: List) -> None:
  """Prints the names that other commands take."""
  known = json.loads(FILE.read_text())
  chosen = choose("list", args.what, {"all": list(known)} | {name: [name] for name in known})
  if any(importlib.metadata.entry_points(group=group) for group in GROUPS):
    known = _live(chosen)
  if args.json:
    emit({kind: known[kind] for kind in chosen})
    return
  wide = max(60, shutil.get_terminal_size((100, 24)).columns)
  for kind in chosen:
    print(kind + ABOUT.get(kind, ""))
    for name, about in known[kind].items():
      line = f"  {name:22s} {about}"
      print(textwrap.fill(line, wide, subsequent_indent=" " * 25, break_on_hyphens=False))


def write() -> None:
  """Writes names.json."""
  text = json.dumps(_live(), indent=1, ensure_ascii=False) + "\n"
  folders.atomic(FILE, lambda file: file.write(text.encode()))


if __name__ == "__main__":
  write()
