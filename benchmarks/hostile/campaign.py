"""Cases of all kinds, one after another: what each finds is a line of OUT/results.jsonl."""

from __future__ import annotations

import collections
import json
import os
import pathlib
import shlex
import shutil
import time
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from benchmarks.hostile import foreign, inputs, judge, kills, processes, room, surroundings

APART = 0.05  # share of the cases of bad input that run in a process of their own
FORK_S, APART_S = 20.0, 40.0  # that a case of bad input may take until Ctrl-C
LIVE_S, STRANGE_S = 120.0, 20.0  # that one of poor surroundings, and of foreign code, may take


class Found(NamedTuple):
  """What a case found.

  Attributes:
    group: of the table.
    about: what was done.
    words: of the command line.
    verdict: whether it held.
    status: exit status of the command.
    seconds: that it took.
  """

  group: str
  about: str
  words: list[str]
  verdict: judge.Verdict
  status: int
  seconds: float


def bad_input(seed: int, number: int, home: pathlib.Path, folder: pathlib.Path) -> Found:
  """A case of bad input."""
  case = inputs.draw(seed, number)
  room.copy(home, folder)
  names = (*case.names, *case.spoil(folder))
  names = () if inputs.ANY in names else names
  apart = np.random.default_rng((seed, number, 1)).random() < APART
  before = judge.contents(folder)
  done = (processes.alone(case.words, folder, APART_S) if apart
          else processes.forked(case.words, folder, FORK_S))  # fmt: skip
  verdict = judge.judge(done, names, before, judge.contents(folder), case.tops)
  note = folder / "tmp" / "about"
  about = f"{case.about} {note.read_text()[:200]}" if note.exists() else case.about
  return Found(
    case.group, about + " (apart)" * apart, case.words, verdict, done.status, round(done.seconds, 2)
  )


def killed(seed: int, number: int, home: pathlib.Path, folder: pathlib.Path) -> Found:
  """A case of a kill; commands and signals meet by turns."""
  rng = np.random.default_rng((seed, number, 3))
  target = list(kills.TARGETS)[number % len(kills.TARGETS)]
  names = kills.SIGNALS[(number // len(kills.TARGETS)) % len(kills.SIGNALS)]
  room.copy(home, folder)
  begin = time.monotonic()
  wrong, status, places = kills.kill(target, names.split(), rng, home, folder)
  verdict = judge.Verdict("failed" if wrong else "held", wrong)
  about = f"{target}: {names} at {places}"
  return Found(
    f"{target} {names}",
    about,
    kills.TARGETS[target].words,
    verdict,
    status,
    round(time.monotonic() - begin, 1),
  )


def poor(seed: int, number: int, home: pathlib.Path, folder: pathlib.Path) -> Found:
  """A case of poor surroundings."""
  kind, command, rng = surroundings.draw(seed, number)
  words, limits = surroundings.COMMANDS[command], surroundings.limits(kind, rng)
  room.copy(home, folder)
  with surroundings.disk(kind, folder, rng) as able:
    if not able:
      return Found(kind, "no mount is permitted", words, judge.Verdict("skipped"), 0, 0.0)
    before = judge.contents(folder)
    output = "/dev/full" if kind == "output" else None
    done = processes.alone(words, folder, LIVE_S, limits, output=output)
    tops = ("out/o", "out/o.gif", "out/run/figure.png")
    verdict = judge.judge(done, surroundings.NAMES[kind], before, judge.contents(folder), tops)
  about = f"{kind}: {command} {limits or ''}"
  return Found(kind, about, words, verdict, done.status, round(done.seconds, 2))


def strange(seed: int, number: int, home: pathlib.Path, folder: pathlib.Path) -> Found:
  """A case of foreign code."""
  place, field, deed = foreign.draw(seed, number)
  room.copy(home, folder)
  words = foreign.write(place, field, deed, folder)
  before = judge.contents(folder)
  done = processes.forked(words, folder, STRANGE_S, work=processes.command)
  verdict = judge.judge(
    done, ("hostile", "Own"), before, judge.contents(folder), ("out", "__pycache__")
  )
  if verdict.how == "valid" and done.interrupted:  # it hung, and Ctrl-C ended it
    verdict = verdict._replace(how="held")
  return Found(
    place, f"{place}, {field}: {deed}", words, verdict, done.status, round(done.seconds, 2)
  )


# kind -> (what does a case, how many there are)
KINDS: dict[str, tuple[Callable[[int, int, pathlib.Path, pathlib.Path], Found], int]] = {
  "input": (bad_input, 2000),
  "kill": (killed, 200),
  "poor": (poor, 120),
  "foreign": (strange, len(foreign.EVERY)),
}


def tell_now(text: str) -> None:
  """Prints a line at once."""
  print(text, flush=True)


def line(name: str, found: Found) -> str:
  """A case as a line of JSON."""
  value = found._asdict() | found.verdict._asdict() | {"case": name}
  del value["verdict"]
  return json.dumps(value) + "\n"


def case(name: str, seed: int, out: pathlib.Path) -> Found:
  """Does a case by its name, KIND-NUMBER; its folder is kept where it fails."""
  kind, _, number = name.rpartition("-")
  home = out / "room"
  folder = out / "work" / name
  shutil.rmtree(folder, ignore_errors=True)
  folder.parent.mkdir(parents=True, exist_ok=True)
  try:
    found = KINDS[kind][0](seed, int(number), home, folder)
  except OSError as e:  # the campaign's own trouble, such as a full disk
    verdict = judge.Verdict("failed", f"the campaign itself: {type(e).__name__}: {e}")
    found = Found(kind, "", [], verdict, -1, 0.0)
  if found.verdict.how == "failed":
    kept = out / "failed" / name
    shutil.rmtree(kept, ignore_errors=True)
    kept.parent.mkdir(exist_ok=True)
    folder.mkdir(exist_ok=True)
    shutil.copytree(folder, kept, symlinks=True, ignore_dangling_symlinks=True)
    command = f"cd {shlex.quote(str(kept))} && mjx-cl {shlex.join(found.words)}\n"
    (kept / "command.sh").write_text(command, errors="surrogateescape")
  shutil.rmtree(folder, ignore_errors=True)
  return found


def read(out: pathlib.Path) -> dict[str, dict]:
  """Cases that are finished, by name; of one that was done again the last."""
  path = out / "results.jsonl"
  lines = path.read_text().splitlines() if path.exists() else []
  found = {}
  for text in lines:
    try:
      value = json.loads(text)
      found[value["case"]] = value
    except (ValueError, KeyError):  # cut off while it was written: done again
      continue
  return found


def run(names: Iterable[str], seed: int, out: pathlib.Path, minutes: float | None,
        again: bool = False, tell: Callable[[str], object] = tell_now) -> None:  # fmt: skip
  """Does those of the cases that are not finished, until the time is over; with `again` those that
  failed, once more.
  """
  out.mkdir(parents=True, exist_ok=True)
  begin, finished = time.monotonic(), read(out)
  for name in names:
    if (name in finished) != again or (again and finished[name]["how"] != "failed"):
      continue
    if minutes is not None and time.monotonic() - begin > 60 * minutes:
      break
    found = case(name, seed, out)
    with (out / "results.jsonl").open("ab+") as file:
      file.seek(max(0, file.tell() - 1))
      whole = file.read(1) in (b"", b"\n")  # else the last line was cut off
      file.write(b"\n" * (not whole) + line(name, found).encode())
      file.flush()
      os.fsync(file.fileno())
    if found.verdict.how == "failed":
      tell(f"{name} failed: {found.verdict.why}; {found.about}; {found.verdict.said[:200]!r}")


def table(found: Iterable[dict]) -> str:
  """Tried, held, valid and failed by kind and group."""
  counts: dict[tuple[str, str], collections.Counter] = collections.defaultdict(collections.Counter)
  for one in found:
    kind = one["case"].rpartition("-")[0]
    for row in ((kind, one["group"]), (kind, "all"), ("all", "")):
      counts[row][one["how"]] += 1
  rows = [("kind", "of", "tried", "held", "valid", "failed")]
  for (kind, group), count in sorted(counts.items()):
    each = [count[how] for how in ("held", "valid", "failed")]
    rows.append((kind, group, *map(str, (sum(each), *each))))
  widths = [max(len(row[k]) for row in rows) for k in range(6)]
  return "\n".join("  ".join(x.ljust(w) if k < 2 else x.rjust(w) for k, (x, w) in enumerate(zip(row, widths)))
                   for row in rows)  # fmt: skip
