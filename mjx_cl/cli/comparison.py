"""The command compare: runs, or arms of one, against each other."""

import os
import pathlib
import sys
from collections.abc import Sequence

from rich import box

from mjx_cl.cli.flags import Compare
from mjx_cl.cli.output import emit, say
from mjx_cl.cli.tables import console, table
from mjx_cl.errors import choose, require
from mjx_cl.scoring import versus

FEW = 6  # pairs, below which a bootstrap interval covers too rarely


def do_compare(args: Compare) -> None:
  """Compares runs, or arms of one."""
  require(args.runs, "compare takes folders of runs: FOLDER or FOLDER:ARM ...")
  for measure in args.measure:
    choose("measure", measure, versus.MEASURES)
  out = None if args.out is None else pathlib.Path(args.out)
  if out is not None:
    require(out.suffix == ".png", f"--out is a picture, .png; got {args.out}")
    require(not out.is_dir(), f"--out {out} is a folder")
    require(args.overwrite or not out.exists(), f"{out} is there; --overwrite replaces it")
  if args.by is not None:
    require(len(args.runs) == 1, "--by compares the runs below one folder")
    suite = versus.by(args.runs[0], args.by, args.change)
  else:
    suite = versus.parts(list(args.runs), args.change)
  if suite:
    require(out is None, "--out is a picture of one run's variants; name one part's folder")
    return _compare_parts(args, suite)
  found = versus.variants(list(args.runs), args.change)
  if other := versus.unlike(found):
    say(f"note: these runs differ in {', '.join(other)}")
  rows = versus.compare(found, args.measure or versus.ALL)
  if args.json:
    emit(rows)
  else:
    _show_comparison(rows, found[0].name)
  if out is not None:
    from mjx_cl.render import figures

    print(figures.versus(found, out), file=sys.stderr if args.json else sys.stdout)


def _compare_parts(args: Compare, suite: list[versus.Part]) -> None:
  """A line for each part and variant, and over the parts how often a difference is told from 0."""
  measures = args.measure or ("reward_final", "return_lost", "terminations")
  rows, lines = [], {}
  for part in suite:
    if other := [k for k in versus.unlike(part.found) if k != args.by]:
      say(f"note: {part.name}: the runs differ in {', '.join(other)}")
    first, *others = part.found
    for one in others:
      line = lines[part.name, one.name] = [versus.against(one, first, m) for m in measures]
      rows += [{"part": part.name, "against": first.name} | row for row in line]
  if args.json:
    emit(rows)
    return
  cells = [
    (part, variant, line[0]["pairs"], *(_difference(row) for row in line))
    for (part, variant), line in lines.items()
  ]
  for variant in dict.fromkeys(variant for _, variant in lines):
    mine = [line for (_, name), line in lines.items() if name == variant]
    cells.append((f"{len(mine)} parts", variant, "", *map(_told, zip(*mine))))
  heads = ("part", "variant", "pairs", *measures)
  alone = {variant for _, variant in lines}
  if len(alone) == 1:  # it stands below
    heads, cells = heads[:1] + heads[2:], [cell[:1] + cell[2:] for cell in cells]
  left = [head for head in heads if head in ("part", "variant")]
  console().print(table(heads, cells, left=left, box=box.SIMPLE, pad_edge=False))
  firsts = ", ".join(dict.fromkeys(part.found[0].name for part in suite))
  print(
    f"{alone.pop() if len(alone) == 1 else 'variant'} less {firsts}: mean over pairs of one seed "
    "[95 % interval of each part by itself: one in twenty leaves out 0 by chance]; last: parts "
    "whose interval leaves out 0"
  )
  for what, more in (versus.MEASURES[m] for m in measures):
    print(f"{what}: {'more' if more else 'less'} is better")
  if any(0 < line[0]["pairs"] < FEW for line in lines.values()):
    print(f"fewer than {FEW} pairs: such intervals are too narrow; take more seeds")


def _number(x: float | None) -> str:
  return "-" if x is None else f"{x:.3g}" if abs(x) < 1e3 else f"{x:.0f}"


def _difference(row: dict) -> str:
  """A difference and its interval."""
  ci = row["difference_ci"]
  return _number(row["difference"]) + (f" [{_number(ci[0])}, {_number(ci[1])}]" if ci else "")


def _told(rows: Sequence[dict]) -> str:
  """Of parts, in how many a measure is better and in how many worse, told from 0."""
  sign = 1 if versus.MEASURES[rows[0]["measure"]][1] else -1
  ends = [sorted(sign * x for x in row["difference_ci"]) for row in rows if row["difference_ci"]]
  better, worse = sum(low > 0 for low, _ in ends), sum(high < 0 for _, high in ends)
  return f"{better} better, {worse} worse"


def _better(row: dict) -> str:
  """Share of pairs in which a variant is better; where none differs, that."""
  if row["better"] is None:
    return "-"
  alike = row["difference"] == 0 and not any(row["difference_ci"] or (0,))
  return "alike" if alike else f"{row['better']:.0%}"


def _show_comparison(rows: list[dict], first: str) -> None:
  """A table for each measure: a line for each variant, intervals beneath the numbers."""
  between = lambda x: "" if x is None else f"\n[{_number(x[0])}, {_number(x[1])}]"
  shared = os.path.commonprefix([row["variant"] for row in rows]).rfind("/") + 1
  for measure in dict.fromkeys(row["measure"] for row in rows):
    middle = "mean" if measure in versus.SHARES else "iqm"
    heads = ("variant", "n", middle.replace("iqm", "IQM"), "pairs", "difference", "better")
    cells = []
    for row in (row for row in rows if row["measure"] == measure):
      own = row["variant"] == first
      cells.append(
        (
          row["variant"][shared:],
          row["streams"],
          _number(row[middle]) + between(row[f"{middle}_ci"]),
          "" if own else row["pairs"],
          "" if own else _number(row["difference"]) + between(row["difference_ci"]),
          "" if own else _better(row),
        )
      )
    what, more = versus.MEASURES[measure]
    title = f"{measure}: {what}; {'more' if more else 'fewer'} is better"
    close = {"box": box.SIMPLE, "pad_edge": False, "collapse_padding": True}
    console().print(table(heads, cells, left=("variant",), title=title, **close))
  print(
    f"n: streams; IQM: interquartile mean; difference: from {first[shared:]}, mean over pairs of "
    "one seed; better: of pairs, a tie is half a pair; [95 % interval]"
  )
  others = [row for row in rows if row["variant"] != first]
  paired = {row["variant"] for row in others if row["pairs"]}
  if alone := list(dict.fromkeys(r["variant"] for r in others if r["variant"] not in paired)):
    print(f"no pair of one seed with {', '.join(alone)}: nothing is said of the difference")
  if any(0 < row["pairs"] < FEW for row in others):
    print(f"fewer than {FEW} pairs: such intervals are too narrow; take more seeds")
