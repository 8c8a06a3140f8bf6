"""Suites of runs: what a TOML file asks for, part by part, and which parts are done.

A suite is TOML: `name`, `about`, a table `run` of settings for every entry, and tables
`entries.NAME` with settings of RunConfig (`adapt` is a table of AdaptConfig's, `settings` one of
the detector's). A list where RunConfig takes one value makes a part of each, and several lists a
grid: `severity = [0.25, 0.5]` with `adapt.ratio = [4, 16]` are four parts,
NAME/severity=0.25,adapt.ratio=4 and so on. What is not given is RunConfig's default.
"""

import dataclasses
import itertools
import json
import math
import os
import pathlib
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from mjx_cl.adapt.arms import ARMS
from mjx_cl.config import AdaptConfig, RunConfig, field_kinds, replace
from mjx_cl.errors import UserError, choose, require
from mjx_cl.io import folders, tables
from mjx_cl.runs import merge, settings

SUITES = pathlib.Path(__file__).parent / "suites"
# what the names of suites and entries are made of
FOLDER, LETTERS = r"\w[\w .,=+-]*", "letters, digits, spaces and _ - + . , ="
LONGEST = 250  # bytes of a folder's name, which has a suffix while it is written
MOST = 1000  # parts; each takes a minute or more
# what OUT holds besides parts
OWN = ("suite.json", "bench.json", "bench.parquet", "recovery.png", "ratio.png")


class Part(NamedTuple):
  """One run of a suite.

  Attributes:
    name: folder below OUT.
    config: of the run.
  """

  name: str
  config: RunConfig


class Suite(NamedTuple):
  """A suite.

  Attributes:
    name: for people.
    about: for people.
    parts: in the order in which they run.
  """

  name: str
  about: str
  parts: tuple[Part, ...]


def shipped() -> dict[str, str]:
  """Name -> about, of the suites that ship."""
  return {
    path.stem: tomllib.loads(path.read_text())["about"] for path in sorted(SUITES.glob("*.toml"))
  }


def suite(name: str, change: dict | None = None) -> Suite:
  """A suite by name or from a TOML file.

  Args:
    name: of a shipped suite, or a path.
    change: settings that take the place of the suite's own in every entry, e.g. {"seeds": 2}.

  Raises:
    UserError: for an unknown name, key or value, with the choices.
    FileError: for a file that is no TOML.
  """
  path, data = tables.read_suite(name, SUITES)
  where = f"suite {path.name}"
  unknown = sorted(set(data) - {"name", "about", "run", "entries"})
  wrong = f"unknown {', '.join(map(repr, unknown))}" if unknown else "no name"
  require(not unknown and "name" in data, f"{where}: {wrong}; it takes: name, about, run, entries")
  called, run, entries = data["name"], data.get("run", {}), data.get("entries", {})
  _check_name(f"{where}: name", called)
  require(
    isinstance(run, dict), f"{where}: run is a table of settings for every entry; got {run!r}"
  )
  _check_names(f"{where}, [run]", run)
  require(
    entries
    and isinstance(entries, dict)
    and all(isinstance(entry, dict) for entry in entries.values()),
    f"{where}: it needs tables [entries.NAME]",
  )
  whole = {key: merged(merged(run, entry), change or {}) for key, entry in entries.items()}
  for key in entries:
    _check_name(f"{where}: entry", key)
    require(
      key not in OWN,
      f"{where}: entry {key!r} is a file of the results, as are {', '.join(OWN)}; give another",
    )
  count = sum(
    math.prod(map(len, _lists(f"{where}, entry {key!r}", own).values()))
    for key, own in whole.items()
  )
  require(count <= MOST, f"{where}: {count:,} parts; it takes {MOST:,} at most: shorten its lists")
  parts = [part for key, own in whole.items() for part in grid(f"{where}, entry {key!r}", key, own)]
  seen: set[str] = set()
  for name, _ in parts:
    require(name not in seen, f"{where}: part {name} is there twice")
    seen.add(name)
  return Suite(called, str(data.get("about", "")), tuple(parts))


def _check_names(where: str, values: dict) -> None:
  """Raises UserError for a setting that RunConfig or AdaptConfig does not have, or has of another
  kind; lists are for `grid`.
  """
  adapt = values.get("adapt", {})
  for kind, own, before in ((RunConfig, values, ""), (AdaptConfig, adapt, "adapt.")):
    known = {before + field.name: True for field in dataclasses.fields(kind)}
    own = own if isinstance(own, dict) else {}
    field_kinds(where, kind, {k: v for k, v in own.items() if not isinstance(v, list)}, before)
    for name in own:
      try:
        choose("setting", before + name, known)
      except UserError as e:
        other = {f.name for f in dataclasses.fields(AdaptConfig)}
        place = f"; {name} is a setting of its table adapt" * (not before and name in other)
        raise UserError(f"{where}: {e}{place}") from None


def _check_name(what: str, name: Any) -> None:
  """Raises UserError for a name that no folder of a suite may have."""
  require(
    isinstance(name, str) and re.fullmatch(FOLDER, name),
    f"{what} {name!r} is a folder's name and takes {LETTERS} alone",
  )
  _check_folder(what, name)


def _check_folder(what: str, name: str) -> None:
  """Raises UserError for a folder that could not be written."""
  size = len(os.fsencode(name))
  require(
    size <= LONGEST,
    f"{what} {name[:40]!r}... is a folder's name of {size} bytes; it takes {LONGEST} at most",
  )
  require(
    not name.endswith(".tmp"),
    f"{what} {name!r} ends in .tmp, as what is being written does; give another",
  )


def merged(first: dict, second: dict) -> dict:
  """`second` over `first`, tables within tables."""
  both = dict(first)
  for k, v in second.items():
    both[k] = merged(both[k], v) if isinstance(v, dict) and isinstance(both.get(k), dict) else v
  return both


def grid(where: str, name: str, values: dict) -> list[Part]:
  """Parts of one entry: all combinations of its lists.

  Raises:
    UserError: for an empty list, a list of tables, or what `config` refuses.
  """
  lists, parts = _lists(where, values), []
  for combination in itertools.product(*lists.values()):
    own = values
    labels = []
    for path, value in zip(lists, combination):
      own = merged(own, {path[0]: {path[1]: value} if path[1:] else value})
      labels.append(f"{'.'.join(path)}={str(value).replace('/', '-')}")
    _check_folder(f"{where}: part", label := ",".join(labels))
    parts.append(Part("/".join(filter(None, (name, label))), config(where, own)))
  return parts


def _lists(where: str, values: dict) -> dict[tuple[str, ...], list]:
  """The settings of an entry that are lists, by their path."""
  for table in ("adapt", "settings"):
    own = values.get(table, {})
    require(isinstance(own, dict), f"{where}: {table} is a table of settings; got {own!r}")
  lists: dict[tuple[str, ...], list]
  lists = {(k,): v for k, v in values.items() if isinstance(v, list) and k != "arms"}
  lists |= {("adapt", k): v for k, v in values.get("adapt", {}).items() if isinstance(v, list)}
  for path, choices in lists.items():
    require(choices, f"{where}: {'.'.join(path)} is an empty list")
  return lists


def config(where: str, values: dict) -> RunConfig:
  """RunConfig from an entry's settings.

  Raises:
    UserError: for an unknown setting or a value that RunConfig refuses.
  """
  require("env" in values, f"{where}: it needs an env")
  arms, adapt = values.get("arms", RunConfig.arms), values.get("adapt", {})
  require(
    isinstance(arms, (list, tuple)) and all(isinstance(arm, str) for arm in arms),
    f"{where}: arms is one list of names; got {arms!r}; choose from: {', '.join(ARMS)}",
  )
  field_kinds(where, RunConfig, values)
  field_kinds(where, AdaptConfig, adapt, "adapt.")
  try:
    whole = values | {"arms": tuple(arms), "adapt": replace(AdaptConfig(), **adapt)}
    return settings.check(replace(RunConfig(values["env"]), **whole))
  except UserError as e:
    raise UserError(f"{where}: {e}") from None
  except TypeError as e:
    raise UserError(f"{where}: a value of the wrong kind ({e})") from None


def resolved(values: dict) -> RunConfig:
  """The settings of a part as suite.json holds them."""
  return RunConfig(
    **values | {"arms": tuple(values["arms"]), "adapt": AdaptConfig(**values["adapt"])}
  )


def write_plan(plan: Suite, out: pathlib.Path | str) -> None:
  """OUT/suite.json: name and the resolved settings of every part."""
  parts = {p.name: json.loads(json.dumps(dataclasses.asdict(p.config))) for p in plan.parts}
  folders.make(pathlib.Path(out))
  tables.write_json(pathlib.Path(out, "suite.json"), {"suite": plan.name, "parts": parts})


def pick(
  parts: tuple[Part, ...], only: tuple[str, ...], shard: tuple[int, int] = (0, 1)
) -> list[Part]:
  """Parts whose name is in `only` or lies below one of its names, all where it is empty; of these
  every n-th from k on, shard = (k, n).
  """
  below = lambda part, name: part.name == name or part.name.startswith((f"{name}/", f"{name},"))
  for name in only:
    require(
      any(below(part, name) for part in parts),
      f"no part {name!r} in this suite; choose from: {', '.join(p.name for p in parts)}",
    )
  k, n = shard
  require(0 <= k < n, f"shard K/N needs 0 <= K < N; got {k}/{n}")
  chosen = [part for part in parts if not only or any(below(part, name) for name in only)]
  return chosen[k::n]


def of_each(run: RunConfig, choices: Mapping[str, Sequence[Any]]) -> Suite:
  """The suite whose parts are `run` with each combination of values.

  Args:
    run: settings of all of them.
    choices: field of RunConfig -> its values; more than one stands in the parts' names.

  Raises:
    UserError: for a value named twice, or what `settings.check` refuses.
  """
  label = lambda field, value: f"{field}={re.sub('[/,]', '-', str(value))}"
  several = [field for field, values in choices.items() if len(values) > 1]
  for field in several:
    seen: set[str] = set()
    for value in choices[field]:
      require(label(field, value) not in seen, f"name each {field} once; got {value} twice")
      seen.add(label(field, value))
  parts = []
  for values in itertools.product(*choices.values()):
    own = dict(zip(choices, values))
    name = ",".join(label(field, own[field]) for field in several)
    _check_folder("part", name)
    parts.append(Part(name, settings.check(dataclasses.replace(run, **own))))
  about = ", ".join(f"{len(choices[field])} of {field}" for field in several)
  return Suite("run", f"a run with each of: {about}", tuple(parts))


def by_agent(parts: Iterable[Part]) -> dict[str, dict[str, Part]]:
  """Parts of two or more agents that differ in nothing else: name without the agent, the robot's
  where none is left, -> agent -> part.
  """
  groups: dict[tuple[str, str], dict[str, Part]] = {}
  for part in parts:
    name, whose = apart(part.name)
    if whose and part.config.agent:
      alike = repr(dataclasses.replace(part.config, agent=None))
      groups.setdefault((name, alike), {})[part.config.agent] = part
  several = [(name, own) for (name, _), own in groups.items() if len(own) > 1]
  return {name or next(iter(own.values())).config.env: own for name, own in several}


def apart(name: str) -> tuple[str, str | None]:
  """The name of a part without its agent, and the agent as it stands there or None."""
  whose = re.search(r"(?:^|(?<=/)|,)agent=([^,]*),?", name)
  if whose is None:
    return name, None
  return (name[: whose.start()] + "," + name[whose.end() :]).strip(",/").replace("/,", "/"), whose[
    1
  ]


def finished(out: pathlib.Path, part: Part) -> bool:
  """Whether OUT/PART holds this part's results.

  Raises:
    UserError: where it holds a run with other settings, or a file.
  """
  folder = folders.usable(pathlib.Path(out) / part.name)
  text = merge.differs(folder, part.config)
  require(
    not text, f"{folder} {text}; give the same settings or another --out, or remove that folder"
  )
  return complete(folder)


def complete(folder: pathlib.Path) -> bool:
  """Whether a folder holds a finished run."""
  return (folder / "config.json").exists() and (folder / "summary.json").exists()


def standing(out: pathlib.Path | str, parts: Iterable[Part]) -> tuple[list[Part], dict[str, str]]:
  """What OUT holds of the parts: those that are finished, and name -> why, in a few words, of those
  that it holds with other settings.
  """
  own, others = [], {}
  for part in parts:
    folder = pathlib.Path(out) / part.name
    try:
      text = merge.differs(folder, part.config)
    except UserError as e:
      text = f"cannot be compared: {e}"
    if text:
      others[part.name] = text
    elif complete(folder):
      own.append(part)
  return own, others
