"""Bad input: a command that works on the room's files, with one thing wrong about it."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import re
import typing
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.hostile import files, room, values


class Base(NamedTuple):
  """A command that works.

  Attributes:
    words: of its command line.
    tops: where it may write.
    reads: files and folders of the room that it reads.
    share: how often it is taken, relative to others.
    flags: whether its flags are made wrong too.
  """

  words: list[str]
  tops: tuple[str, ...] = ()
  reads: tuple[str, ...] = ()
  share: float = 1.0
  flags: bool = True


AGENT = ("agent/card.json", "agent/agent.npz", "agent")
RESULT = (
  "run/trace.parquet",
  "run/runs.parquet",
  "run/events.parquet",
  "run/config.json",
  "run/summary.json",
  "run",
)
SET = (
  "set/config.json",
  "set/walker.parquet",
  "set/streams.parquet",
  "set/walker_latents.parquet",
  "set",
)
TOLD = ["oracle-stop" if word == "none" else word for word in room.RUN]
BASES = {
  "list": Base(["list"], share=0.7),
  "run": Base([*room.RUN, "--out", "out"], ("out",), AGENT, 4),
  "run again": Base([*room.RUN, "--out", "run", "--resume"], ("run",), RESULT, 1, False),
  "run over": Base([*room.RUN, "--out", "run", "--overwrite"], ("run",), AGENT, 1),
  "run stops": Base([*TOLD, "--stops", "run", "--out", "out"], ("out",), RESULT, 0.5, False),
  "run own": Base([*room.RUN, "--detector", "own.py:Own", "--out", "out"], ("out",), ("own.py",), 0.3, False),
  "train": Base(["train", "walker", "--preset", "tiny", "--set", "updates=32", "--out", "out"], ("out",), (), 2),
  "train on": Base(["train", "walker", "--preset", "tiny", "--set", "updates=32", "--agent", "agent", "--out", "out"],
                   ("out",), AGENT, 1, False),
  "eval": Base(["eval", "walker", "--agent", "agent", "--episodes", "2"], (), AGENT),
  "record": Base(["record", *room.STREAMS_OF, "--out", "out"], ("out",), ("streams.toml",), 2),
  "record over": Base(["record", *room.STREAMS_OF, "--out", "set", "--overwrite"], ("set",), ("streams.toml", *SET)),
  "detect": Base(["detect", "log.csv", "--nominal", "nominal.csv", "--arl0", "200", "--detector", "z_score", "--out",
                  "out"], ("out",), ("log.csv", "nominal.csv"), 3),
  "detect own": Base(["detect", "log.csv", "--nominal", "nominal.csv", "--arl0", "200", "--detector", "own.py:Own",
                      "--out", "out"], ("out",), ("own.py",), 0.3, False),
  "detect charts": Base(["detect", "log.csv", "--nominal", "nominal.csv", "--inject", "0.2", "--out", "out"], ("out",),
                        ("log.csv", "nominal.csv"), 2),
  "compare": Base(["compare", "run", "run", "--out", "out.png"], ("out.png",), RESULT),
  "calibrate": Base(["calibrate", "walker", "--agent", "agent", "--detector", "cusum", "--seeds",
                     "1", "--steps", "2000", "--arl0", "100"], (), AGENT),
  "certify": Base(["certify", "walker", "--fault", "gear", "--episodes", "0", "--out", "out"], ("out",)),
  "bench": Base(["bench", "suite.toml", "--out", "out", "--jobs", "1"], ("out",), ("suite.toml", *AGENT), 2),
  "bench again": Base(["bench", "suite.toml", "--out", "bench", "--jobs", "1"], ("bench",), (
    "bench/suite.json", "bench/walker/severity=0.5/runs.parquet", "bench/walker/severity=0.5/summary.json", "bench/walker/severity=0.5/config.json")),
  "bench merge": Base(["bench", "suite.toml", "--out", "out", "--merge", "bench", "--jobs", "1"], ("out",), (
    "bench/suite.json", "bench/walker/severity=0.5/runs.parquet", "bench/walker/severity=0.5/summary.json", "bench/walker/severity=0.5/config.json",
    "bench/walker/severity=0.5/trace.parquet", "bench/walker/severity=0.5/events.parquet"), 1, False),
  "bench publish": Base(["bench", "suite.toml", "--out", "bench", "--publish", "out", "--jobs", "1"], ("bench", "out"),
                        ("bench/bench.json", "bench/walker/severity=0.5/runs.parquet", "bench/bench.parquet"), 0.5, False),
  "leaderboard": Base(["leaderboard", "set", "--detector", "z_score", "--out", "out"], ("out",), SET, 2),
  "leaderboard submit": Base(["leaderboard", "set", "--detector", "none", "--submit", "scores.parquet", "--out", "out"],
                             ("out",), ("scores.parquet",)),
  "leaderboard add": Base(["leaderboard", "set", "--detector", "none", "--add", "own.py:Own", "--threshold", "threshold",
                           "--out", "out"], ("out",), ("own.py",)),
  "leaderboard over": Base(["leaderboard", "set", "--detector", "z_score", "--out", "board", "--overwrite"],
                           ("board",), SET, 0.5),
  "plot": Base(["plot", "run"], ("run/figure.png",), RESULT),
  "render": Base(["render", "walker", "--agent", "agent", "--steps", "4", "--out", "out.gif"], ("out.gif",), AGENT),
  "report": Base(["report", "--results", "results", "--page", "page.md", "--check"], (), ("results/arl0.json", "page.md",
                                                                                       "results")),
  "query": Base(["query", "run", "select arm, count(*) from runs group by all", "--timeout", "5", "--limit", "50"], (),
                ("run/runs.parquet", "run/trace.parquet", "run"), 1.5),
  "doctor": Base(["doctor"], share=0.3),
}  # fmt: skip
ANY = "*"  # whatever the error names
# flags that name folders which a command writes
FOLDERS = ("out", "export", "publish")
# how wrong input comes: kind -> its share
KINDS = {"flag": 0.5, "file": 0.35, "words": 0.15}


class Case(NamedTuple):
  """A command with one thing wrong.

  Attributes:
    words: of its command line.
    about: what is wrong.
    names: one of these must be named by the error.
    tops: where it may write.
    group: of the table.
    spoil: makes files of the folder wrong; gives what more is to be named.
  """

  words: list[str]
  about: str
  names: tuple[str, ...]
  tops: tuple[str, ...]
  group: str
  spoil: Callable[[pathlib.Path], tuple[str, ...]]


def command_of(base: Base) -> type:
  """The dataclass of a command's flags."""
  from mjx_cl.cli.app import COMMANDS

  return next(kind for kind in COMMANDS if kind.__name__.lower() == base.words[0])


def flags(kind: type, above: str = "") -> dict[str, Any]:
  """Flag -> default, of a command's dataclass and of those in it."""
  found: dict[str, Any] = {}
  hints = typing.get_type_hints(kind)
  renamed = {"arms": "arm", "settings": "set", "within": "in"}
  for field in dataclasses.fields(kind):
    name = above + renamed.get(field.name, field.name).replace("_", "-")
    if dataclasses.is_dataclass(hints.get(field.name)):
      found |= flags(hints[field.name], f"{field.name}.")
    else:
      found[name] = field.default
  return found


POSITIONAL = ("env", "suite", "what", "streams", "folder", "file", "words")


def flag_case(name: str, base: Base, rng: np.random.Generator) -> Case:
  """One flag with a hostile value, or a positional argument."""
  kind = command_of(base)
  known = flags(kind)
  flag = list(known)[rng.integers(len(known))]
  default, words, tops = known[flag], list(base.words), base.tops
  if flag in POSITIONAL:
    text = values.any_of(rng)
    if flag == "words":
      text = values.SQL[rng.integers(len(values.SQL))] if rng.random() < 0.7 else text
      words[2 if rng.random() < 0.8 else 1] = text
    elif base.words[0] not in ("list", "doctor"):
      words[1] = text
    else:
      words.append(text)
    given = [text]
  elif isinstance(default, bool):
    given = [] if rng.random() < 0.4 else [values.text(rng)]
    words += [f"--{flag}", *given]
  else:
    numeric = isinstance(default, int | float)
    pick = values.number if numeric and rng.random() < 0.7 else values.any_of
    pick = (
      values.setting
      if flag == "set"
      else values.path
      if flag in FOLDERS and rng.random() < 0.8
      else pick
    )
    given = [
      pick(rng) for _ in range(2 if isinstance(default, tuple) and rng.random() < 0.3 else 1)
    ]
    words += (
      [f"--{flag}={given[0]}"] if rng.random() < 0.3 and len(given) == 1 else [f"--{flag}", *given]
    )
  if flag in FOLDERS and given:
    tops = (*tops, *(to for link, to in room.LINKS.items() if given[0].rstrip("/") == link))
    tops = (*tops, given[0].strip("/"), os.path.normpath(given[0]) if "\0" not in given[0] else "")
  if base.words[0] == "render" and flag in ("out", "env") and given:
    tops = (*tops, given[0], f"{given[0]}.gif", *(f"{given[0].rpartition(':')[2]}.gif",))
  names = (
    flag,
    flag.rpartition(".")[2],
    *shown(given),
    *(("query",) if base.words[0] == "query" else ()),
  )
  return Case(
    words,
    f"{name}: --{flag} {given}"[:300],
    names,
    tuple(t for t in tops if t),
    "flag",
    lambda _: (),
  )


def shown(given: list[str]) -> list[str]:
  """Pieces of given texts by which an error may name them."""
  found = []
  for text in given:
    for piece in (
      re.sub(r"\x1b\[[0-9;]*m", "", text),
      text,
      text.partition("=")[0],
      text.rpartition("/")[2],
    ):
      plain = "".join(c if c.isprintable() else " " for c in piece).split()
      found += [word[:12] for word in plain[:1]] or [
        ascii(piece)[1:-1][:8],
        "unrecognized",
        "empty",
      ]
  return found or ["empty", "blank", "''", "unrecognized"]


def file_case(name: str, base: Base, rng: np.random.Generator) -> Case:
  """One file that a command reads, made wrong."""
  which = base.reads[rng.integers(len(base.reads))]
  seed = int(rng.integers(2**31))

  def spoil(folder: pathlib.Path) -> tuple[str, ...]:
    said = files.spoil(folder / which, np.random.default_rng(seed))
    (folder / "tmp" / "about").write_text(said, errors="backslashreplace")
    if said == files.TURNED:  # a name in it may be another now: the error names what it found
      return (ANY,)
    return (*(x for x in said.split(" is ")[0].split(".")[-2:] if len(x) > 2),)

  path = pathlib.Path(which)
  near = (path.name, path.stem, str(path.parent) if path.parent.name else path.name)
  return Case(
    list(base.words), f"{name}: {which}", near, base.tops, f"file{path.suffix or ' folder'}", spoil
  )


def words_case(name: str, base: Base, rng: np.random.Generator) -> Case:
  """Words missing, strange, twice or in another order."""
  words, which = list(base.words), int(rng.integers(7))
  at = int(rng.integers(1, len(words) + 1))
  names: tuple[str, ...] = ()
  if which == 0:
    words.insert(at, values.any_of(rng))
  elif which == 1:
    words = words[:at]
  elif which == 2:
    words.pop(int(rng.integers(len(words))))
  elif which == 3:
    words.insert(at, "--" + values.text(rng))
  elif which == 4:
    words = [words[0], *[words[1 + i] for i in rng.permutation(len(words) - 1)]]
  elif which == 5:
    words[0] = values.any_of(rng)
  else:
    words += ["--resume", "--overwrite"]
  if "--check" not in words and words[:1] == ["report"]:
    words.append("--check")  # no page of the checkout is ever written
  # what stands for --out may be any of the words by now
  tops = (
    *base.tops,
    *(w for w in words if w and not w.startswith("-")),
    "runs",
    "results",
    "walker.gif",
  )
  return Case(words, f"{name}: words {which}", names, tops, "words", lambda _: ())


def draw(seed: int, number: int) -> Case:
  """Case `number` of a campaign."""
  rng = np.random.default_rng((seed, number))
  kind = rng.choice(list(KINDS), p=list(KINDS.values()))
  fit = {k: b for k, b in BASES.items() if (b.reads if kind == "file" else b.flags)}
  shares = np.array([b.share for b in fit.values()])
  name = str(rng.choice(list(fit), p=shares / shares.sum()))
  make = {"flag": flag_case, "file": file_case, "words": words_case}[str(kind)]
  case = make(name, fit[name], rng)
  return case._replace(words=[w.replace("\0", "") for w in case.words])
