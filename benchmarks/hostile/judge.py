"""Whether a command held: what it said, how it ended, what it left of what was there."""

from __future__ import annotations

import hashlib
import os
import pathlib
import re
from typing import NamedTuple

from benchmarks.hostile.processes import BEGUN, Done

MOST = 500  # characters of an error's line
# what XLA notes of programs from its cache is not of this package
NOT_OURS = re.compile(
  r"cpu_aot|^[WI]\d{4} .*\.cc:|^WARNING: All log messages before absl::InitializeLog"
)
NOISE = re.compile(
  r"Traceback|Warning\b|Exception\b|^\s+File \"|^[EF]\d{4} |Fatal Python|core dumped|Exception ignored"
)


OURS = ("mjx-cl: ", "note: ")  # what a line that is meant for the user begins with


class Verdict(NamedTuple):
  """What became of a case.

  Attributes:
    how: held, valid (the input was no mistake) or failed.
    why: of a failure.
    said: the line of the error.
  """

  how: str
  why: str = ""
  said: str = ""


def contents(folder: pathlib.Path) -> dict[str, str]:
  """Digest of each file in a folder, the target of a link, "folder" of a folder, by path."""
  found = {}
  for where, folders, files in os.walk(folder):
    for name in (*folders, *files):
      path = pathlib.Path(where, name)
      key = os.fspath(path.relative_to(folder))
      if path.is_symlink():
        found[key] = f"-> {os.readlink(path)}"
      elif path.is_dir():
        found[key] = "folder"
      elif path.is_file():
        found[key] = hashlib.sha256(path.read_bytes()).hexdigest()
      else:
        found[key] = "special"
  return found


def below(path: str, tops: tuple[str, ...]) -> bool:
  """Whether a path is one of the tops, lies in one, or is a folder that one lies in."""
  return any(
    path == top or path.startswith(f"{top}/") or top.startswith(f"{path}/") for top in tops
  )


def written(
  before: dict[str, str], after: dict[str, str], tops: tuple[str, ...], status: int
) -> str:
  """What a command wrote that it should not have; "" where there is nothing.

  A refusal changes nothing that was there; new files lie below `tops`, whatever the status.
  """
  for path, digest in before.items():
    if after.get(path) != digest and not (status in (0, BEGUN, 130) and below(path, tops)):
      return f"{path} was {'changed' if path in after else 'removed'}"
  for path in after:
    begun = status == BEGUN and ".tmp" in path  # the fork ended before it could rename it
    if path not in before and not begun and not below(path, (*tops, "tmp", ".cache", ".config")):
      return f"{path} was written outside of --out"
  return ""


def lines_of(done: Done) -> list[str]:
  """Lines on standard error, split at nothing but line feeds."""
  return [x for x in done.err.split("\n") if x and not NOT_OURS.search(x)]


def spoken(done: Done, names: tuple[str, ...]) -> str:
  """What is wrong with how an error is told; "" where nothing is."""
  lines = lines_of(done)
  if noise := next((x for x in lines if NOISE.search(x) and not x.startswith(OURS)), None):
    return f"noise: {noise.strip()[:200]}"
  errors = [x for x in lines if x.startswith("mjx-cl: ")]
  if not errors or lines[-1] != errors[-1]:
    return "no line of an error at the end"
  if len(errors) > 1 and done.status != 130:
    return f"{len(errors)} lines of errors"
  line = errors[-1]
  if len(line) > MOST:
    return f"a line of {len(line)} characters"
  if not line.isprintable():
    return f"a line with {[c for c in line if not c.isprintable()][0]!r} in it"
  plain = line.lower().replace("-", "_").replace("\\\\", "\\")
  if names and not any(x.lower().replace("-", "_") in plain for x in names if x):
    return "the line names nothing that was given"
  return ""


def judge(done: Done, names: tuple[str, ...], before: dict[str, str], after: dict[str, str],
          tops: tuple[str, ...]) -> Verdict:  # fmt: skip
  """Whether a case of wrong input held."""
  last = (lines_of(done) or [""])[-1][:1500]
  if wrong := written(before, after, tops, done.status):
    return Verdict("failed", wrong, last)
  if done.interrupted and done.status not in (1, 2):  # these ended by themselves
    if done.late is None:
      return Verdict("failed", "hangs: not ended by Ctrl-C", last)
    if done.status == BEGUN:  # in the same moment
      return Verdict("valid", "", last)
    if done.status != 130 or (wrong := spoken(done, ())):
      return Verdict("failed", f"Ctrl-C: status {done.status}, {wrong}", last)
    return Verdict("valid", "", last)
  if done.status in (0, BEGUN):
    noise = next((x for x in lines_of(done) if NOISE.search(x) and not x.startswith(OURS)), None)
    return (
      Verdict("failed", f"status 0, noise: {noise[:200]}", last)
      if noise
      else Verdict("valid", "", last)
    )
  if done.status not in (1, 2):
    return Verdict("failed", f"status {done.status}", last)
  if not done.err and done.out.startswith("usage: mjx-cl"):  # without a command: the help
    return Verdict("held", "", "the help")
  wrong = spoken(done, names)
  return Verdict("failed" if wrong else "held", wrong, last)
