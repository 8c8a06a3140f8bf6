"""`bench`: the parts of a suite run one after another or side by side, each into a folder as
`mjx-cl run` writes it; finished parts are never run again.

OUT/suite.json holds the resolved parts; OUT/PART/ the result files of each; what they say together
is in scores.py. Parts are independent: several machines share a suite by `shard`, and `offers` and
`take` take over what others finished.
"""

import contextlib
import functools
import os
import pathlib
import shutil
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Any, BinaryIO

from mjx_cl.config import RunConfig
from mjx_cl.errors import FileError, UserError, require
from mjx_cl.io import folders as folder_lib
from mjx_cl.io import tables
from mjx_cl.runs import cluster, merge, run, workers
from mjx_cl.runs.costs import Estimate
from mjx_cl.runs.doubts import notes as notes_of
from mjx_cl.runs.healthy import Healthy
from mjx_cl.runs.scores import collect, draw
from mjx_cl.runs.suite import (
  Part,
  Suite,
  complete,
  finished,
  resolved,
  shipped,
  standing,
  suite,
  write_plan,
)

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
MERGED = (*PUBLISHED, "trace.parquet", "residuals.parquet")
Tell = Callable[[str], None]
Display = Callable[[], contextlib.AbstractContextManager[Callable[[run.Progress], Any]]]


def notes(parts: Iterable[Part]) -> list[tuple[str, str]]:
  """What `mjx-cl run` would say of these parts' settings before it starts (doubts.py),
  each with the parts that it holds for.
  """
  which: dict[str, list[str]] = {}
  for part in parts:
    for text in notes_of(part.config):
      which.setdefault(text, []).append(part.name)
  return [
    (text, names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more")
    for text, names in which.items()
  ]


def offers(
  out: pathlib.Path,
  parts: Iterable[Part],
  folders: Collection[pathlib.Path | str],
  tell: Tell = lambda text: None,
) -> dict[str, list[pathlib.Path]]:
  """Part -> folders that its run can be taken from, of those that are not finished in OUT: one, or
  several whose seeds are to be joined, see merge.py.

  Args:
    out: folder of the suite.
    parts: of the suite.
    folders: others' OUT of the same suite.
    tell: gets a line for each part of theirs that is refused, since it was run with other settings
      or cannot be read.

  Raises:
    UserError: where OUT holds a part with other settings, or seeds of a part are missing or there
      twice.
  """
  found = {}
  for part in parts:
    if finished(out, part):
      continue
    there = []
    for folder in (pathlib.Path(f) / part.name for f in folders):
      try:
        if text := merge.differs(folder, part.config, merge.SEEDS):
          tell(f"note: {folder} {text}; it is not taken over")
        elif own := merge.seeds_of(folder, part.config):
          merge.whole(folder)
          there.append((folder, own))
      except UserError as e:
        tell(f"note: {e}; {part.name} is not taken over from there")
    first, count = part.config.first_seed, part.config.seeds
    whole = [[folder] for folder, own in there if own == list(range(first, first + count))]
    if sources := whole[0] if whole else merge.choose([folder for folder, _ in there], part.config):
      found[part.name] = sources
  return found


def take(out: pathlib.Path, parts: Iterable[Part], found: dict[str, list[pathlib.Path]]) -> None:
  """Copies to OUT, or joins there, what `offers` has found of the parts."""
  for part in parts:
    if not (sources := found.get(part.name)):
      continue
    with folder_lib.alone(out / part.name):
      _take(out / part.name, part.config, sources)


def _take(folder: pathlib.Path, config: RunConfig, sources: list[pathlib.Path]) -> None:
  """A part's folder, of finished runs that have its seeds."""
  tmp = folder.with_name(folder.name + ".tmp")
  shutil.rmtree(tmp, ignore_errors=True)
  try:
    tmp.mkdir(parents=True)
    if len(sources) == 1:
      for name in MERGED:
        if (sources[0] / name).exists():
          shutil.copyfile(sources[0] / name, tmp / name)
      merge.copy_agents(sources[0], tmp)
    else:
      merge.join(sources, tmp, config)
  except BaseException:
    shutil.rmtree(tmp, ignore_errors=True)
    raise
  shutil.rmtree(folder, ignore_errors=True)
  os.replace(tmp, folder)


def _together(
  plan: Suite,
  out: pathlib.Path,
  names: list[str],
  guess: Callable[[list[str]], float],
  tell: Tell,
  jobs: int,
  worker: str,
  needs: dict[str, int] | None = None,
  on: cluster.Cluster | None = None,
) -> dict[str, dict]:
  """Runs parts side by side; arguments as of `execute`, `guess` gives the seconds that parts take,
  0 where nobody knows, `needs` the bytes that each takes where they run on a cluster.

  Returns:
    name -> scores of the parts that are finished.
  """
  over: list[str] = []
  known: dict[str, dict] = {}
  begin = time.monotonic()

  def end(name: str) -> None:
    over.append(name)
    collect(out, plan, known)
    left = ""
    if guess(over) and len(over) < len(names):
      rest = (time.monotonic() - begin) * (guess(names) / guess(over) - 1)
      left = f"; at most about {round(rest / 60) or 1} min left"
    tell(f"{name} finished, {len(over)} of {len(names)}{left}")

  if on is not None and needs is not None:
    cluster.together(worker, out, names, needs, end, tell, on)
    return known
  robots = {part.name: part.config.env for part in plan.parts}
  workers.together(worker, out, names, min(jobs, len(names)), end, tell, robots.get)
  return known


@contextlib.contextmanager
def _silent() -> Iterator[Callable[[run.Progress], Any]]:
  """A display that shows nothing."""
  yield lambda progress: None


def execute(
  plan: Suite,
  out: pathlib.Path | str,
  parts: Iterable[Part],
  estimates: dict[str, Estimate] | None = None,
  tell: Tell = lambda text: None,
  display: Display = _silent,
  save_every_s: float = 60.0,
  jobs: int = 1,
  worker: str = "",
  on: cluster.Cluster | None = None,
) -> dict:
  """Runs the parts that are not finished, in order; one that was cut off goes on from its last
  checkpoint.

  Args:
    plan: the suite.
    out: folder of the suite.
    parts: of the plan, see `pick`.
    estimates: part -> Estimate, for the time left.
    tell: called with each line for the user.
    display: context manager that gives run.execute's progress.
    save_every_s: most seconds of work that a kill loses.
    jobs: parts side by side, see workers.py, the longest first.
    worker: module that such a process runs.
    on: a cluster, see cluster.py; None: here.

  Returns:
    bench.json's value.
  """
  out = pathlib.Path(out)
  write_plan(plan, out)
  todo = [p for p in parts if not finished(out, p)]
  guess = lambda names: sum(estimates[name].seconds for name in names) if estimates else 0.0
  names = [p.name for p in todo]
  if on is not None and todo:
    names.sort(key=lambda name: -guess([name]))
    needs = {name: estimates[name].bytes if estimates else 0 for name in names}
    done = _together(plan, out, names, guess, tell, 1, worker, needs, on)
    return collect(out, plan, done)
  if jobs > 1 and len(todo) > 1:
    names.sort(key=lambda name: -guess([name]))
    return collect(out, plan, _together(plan, out, names, guess, tell, jobs, worker))
  spent, programs, healthy = 0.0, run.Programs(), Healthy()
  known: dict[str, dict] = {}
  for i, part in enumerate(todo):
    if estimates:
      left = guess(names[i:]) * (spent / guess(names[:i]) if i else 1.0)
      tell(f"{part.name} ({i + 1} of {len(todo)}); about {round(left / 60) or 1} min left")
    begin = time.monotonic()
    folder = out / part.name
    with display() as progress:
      run.execute(
        part.config,
        folder,
        resume=folder.exists(),
        progress=progress,
        save_every_s=save_every_s,
        programs=programs,
        healthy=healthy,
      )
    spent += time.monotonic() - begin
    collect(out, plan, known)
  return collect(out, plan, known)


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
    merge.whole(out / part.name)
  for part in done:
    kept.pop(part.name, None)
    (to / part.name).mkdir(parents=True, exist_ok=True)
    for name in PUBLISHED:
      source, copy = out / part.name / name, to / part.name / name
      if source.exists():
        folder_lib.atomic(copy, functools.partial(_copy, source))
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
      value = tables.read_json(folder / "bench.json")
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
