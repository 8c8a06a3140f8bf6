"""Suites as they are committed under results/: copied there, read back, their figures redrawn."""

from __future__ import annotations

import functools
import json
import pathlib
from typing import BinaryIO

from mjx_cl.errors import FileError, UserError, require
from mjx_cl.io import folders, tables
from mjx_cl.runs.scores import collect, draw
from mjx_cl.runs.suite import Part, Suite, complete, resolved, shipped, standing, suite, write_plan

PUBLISHED = (
  "config.json",
  "events.parquet",
  "runs.parquet",
  "summary.json",
  "figure.png",
  "snapshots.parquet",
  "stop.parquet",
  "signals.parquet",
)


def _copy(source: pathlib.Path, file: BinaryIO) -> None:
  file.write(source.read_bytes())


def publish(out: pathlib.Path | str, plan: Suite, to: pathlib.Path | str) -> list[str]:
  """Copies the finished parts' small files, all but the trace, to the folder `to`, as they are
  committed, and writes there what `collect` does of them and of the parts that lie there already
  and OUT lacks, which stay as they are; returns the names of those copied.

  Raises:
    UserError: as `earlier`.
    FileError: likewise.
  """
  out, to = pathlib.Path(out), pathlib.Path(to)
  kept, done = earlier(to, plan), standing(out, plan.parts)[0]
  for part in done:
    kept.pop(part.name, None)
    (to / part.name).mkdir(parents=True, exist_ok=True)
    for name in PUBLISHED:
      source, copy = out / part.name / name, to / part.name / name
      if source.exists():
        folders.atomic(copy, functools.partial(_copy, source))
      else:  # of an earlier run, as the figure where seeds were joined without their traces
        copy.unlink(missing_ok=True)
  if done:
    names = {p.name for p in plan.parts}
    both = plan._replace(
      parts=(
        *(kept[p.name][0] if p.name in kept else p for p in plan.parts),
        *(part for name, (part, _) in kept.items() if name not in names),
      )
    )
    known = {name: scored for name, (_, scored) in kept.items()} | {
      p.name: tables.read_json(out / "bench.json")["entries"][p.name]["scores"] for p in done
    }
    write_plan(both, to)
    collect(to, both, known, frozenset(kept))
  return [p.name for p in done]


def earlier(to: pathlib.Path | str, plan: Suite) -> dict[str, tuple[Part, dict]]:
  """Name -> the part and its scores, of what was published in the folder `to` before.

  Raises:
    UserError: where another suite was, or suite.json does not say what a part is.
    FileError: for a broken file.
  """
  to = pathlib.Path(to)
  if not (to / "bench.json").exists():
    return {}
  value = tables.read_json(to / "bench.json")
  require(
    value.get("suite") == plan.name,
    f"--publish: {to} holds suite {value.get('suite')!r}, not {plan.name!r}; give another folder",
  )
  entries = {k: entry for k, entry in value.get("entries", {}).items() if complete(to / k)}
  said = tables.read_json(to / "suite.json").get("parts", {}) if entries else {}
  out = {}
  for name, entry in entries.items():
    try:
      out[name] = Part(name, resolved(said[name])), entry["scores"]
    except (KeyError, TypeError, UserError) as e:
      raise UserError(
        f"--publish: {to} holds part {name}, which its suite.json and bench.json do not "
        f"describe ({e}); give another folder"
      ) from None
  return out


def redraw(results: pathlib.Path | str) -> list[pathlib.Path]:
  """The figures of every suite that is published in a subfolder of `results`, drawn anew from its
  files. Returns them.

  Raises:
    FileError: where a folder with a bench.json is broken, or of a suite that this package does not
      have and without its suite.json.
  """
  out = []
  for folder in sorted(p.parent for p in pathlib.Path(results).glob("*/bench.json")):
    try:
      value = json.loads((folder / "bench.json").read_text())
      out += draw(folder, _published(folder, value["suite"]), value)
    except (OSError, ValueError, KeyError, TypeError, UserError) as e:
      kind = "" if isinstance(e, UserError) else f"{type(e).__name__}: "
      raise FileError(f"cannot draw the figures of {folder}: {kind}{e}") from None
  return out


def _published(folder: pathlib.Path, name: str) -> Suite:
  """The suite of a published folder: the shipped one of that name, or a user's own as suite.json
  holds it.
  """
  if name in shipped():
    return suite(name)
  try:
    parts = tables.read_json(folder / "suite.json")["parts"]
  except FileError as e:
    raise UserError(f"suite {name!r} is none of this package's, and {e}") from None
  return Suite(name, "", tuple(Part(part, resolved(c)) for part, c in parts.items()))
