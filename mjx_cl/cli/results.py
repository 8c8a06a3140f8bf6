"""The commands plot, query and report: what result files say. Free of JAX but where
figures are drawn anew.
"""

import decimal
import importlib
import itertools
import math
import os
import pathlib
import sys
import types
from typing import Any

from mjx_cl.cli.flags import Plot, Query, Report
from mjx_cl.cli.output import emit, say
from mjx_cl.cli.tables import print_rows
from mjx_cl.errors import FileError, require
from mjx_cl.io import tables

FIRST = 100  # rows that are printed unless more are asked for, and under one heading


def do_plot(args: Plot) -> None:
  """Draws the figure of a run anew."""
  from mjx_cl.render import figures

  require(
    pathlib.Path(args.folder, "trace.parquet").exists(),
    f"{args.folder} holds no finished run (no trace.parquet)",
  )
  print(figures.figure(args.folder))


def do_query(args: Query) -> None:
  """Answers SQL, or names the views."""
  folder, sql = list(args.words[:-1]), args.words[-1] if args.words else None
  if sql is not None and not folder and os.path.isdir(sql):
    folder, sql = [sql], None
  require(
    len(folder) <= 1, f"query takes [FOLDER] [SQL], the SQL in quotes; got {len(args.words)} words"
  )
  require(not (folder and args.within), "query takes a folder or --in, not both")
  require(args.limit is None or args.limit >= 1, f"--limit must be above 0; got {args.limit}")
  if args.timeout is not None:
    require(0 < args.timeout < 1e9, f"--timeout must lie in 0..1e9 s; got {args.timeout:g}")
  limit = args.limit or (None if args.json or sql is None else FIRST)
  found = folder[0] if folder else tables.views(args.within)
  names, rows = tables.query(found, sql, None if limit is None else limit + 1, args.timeout)
  more, rows = limit is not None and len(rows) > limit, rows[:limit]
  if args.json:
    for k, name in enumerate(names):  # two columns of one name would be one in JSON
      others = {*names[:k], *names[k + 1 :]}
      free = (f"{name}_{n}" for n in itertools.count(k) if f"{name}_{n}" not in others)
      names[k] = name if name not in names[:k] else next(free)
    emit([{n: json_value(x) for n, x in zip(names, r)} for r in rows])
  else:
    for k in range(0, max(1, len(rows)), FIRST):  # a long table takes long to be set
      print_rows(names, [shown(row) for row in rows[k : k + FIRST]])
  if more:
    say(f"the first {limit:,} rows; --limit takes a number, --json prints all")


def shown(row: tuple) -> list[object]:
  """A row as a reader wants it: numbers to six significant digits; --json has them whole."""
  return [f"{x:.6g}" if isinstance(x, float) else x for x in row]


def json_value(x: Any) -> Any:
  """A database's value as JSON has it: decimals are numbers, what is not finite is null, keys of a
  map and whatever else there is are text.
  """
  if isinstance(x, dict):
    return {str(k): json_value(v) for k, v in x.items()}
  if isinstance(x, (list, tuple)):
    return [json_value(v) for v in x]
  if isinstance(x, decimal.Decimal):
    x = float(x)
  if isinstance(x, float):
    return x if math.isfinite(x) else None
  return x if x is None or isinstance(x, (bool, int, str)) else str(x)


def _writer() -> types.ModuleType:
  """The program beside a checkout's package that writes its documents' numbers.

  Raises:
    UserError: where the package stands elsewhere.
  """
  checkout = pathlib.Path(__file__).parents[2]
  require(
    (checkout / "benchmarks" / "report" / "report.py").is_file(),
    "report writes the documents of a checkout of mjx_cl; this package is installed without one",
  )
  if str(checkout) not in sys.path:
    sys.path.append(str(checkout))
  return importlib.import_module("benchmarks.report.report")


def do_report(args: Report) -> None:
  """Writes the documents' numbers anew."""
  report = _writer()
  pages = args.page or [str(p) for p in report.pages()] or ["README.md"]
  # whatever is wrong is said before anything is written
  found = {page: report.report(args.results, page, check=True) for page in pages}
  require(
    not (args.figures and args.check),
    "--check writes nothing, --figures draws: give one of the two",
  )
  if not args.check:
    for page in pages:
      report.report(args.results, page)
  if args.figures:
    from mjx_cl.runs import bench

    for file in bench.redraw(args.results):
      print(f"{file}: drawn anew", file=sys.stderr)
  stale: dict[str, str] = {}
  for page, blocks in found.items():
    if names := dict.fromkeys(b["name"] for b in blocks if not b["agrees"]):
      stale[page] = ", ".join(names)
  if args.json:
    emit([{"page": page, **block} for page, blocks in found.items() for block in blocks])
  else:
    for page, blocks in found.items():
      if not blocks:
        print(f"{page}: no marked block")
      elif page not in stale:
        print(f"{page}: all {len(blocks)} blocks agree with {args.results}")
      elif not args.check:
        print(f"{page}: written anew: {stale[page]}")
  if stale and args.check:
    wrong = (f"{page} disagrees with {args.results} in: {names}" for page, names in stale.items())
    raise FileError(f"{'; '.join(wrong)}; mjx-cl report writes them anew")
