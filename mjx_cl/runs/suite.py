"""`bench`: a suite of runs, each a folder as `mjx-cl run` writes it; finished parts are never run
again.

A suite is TOML: `name`, `about`, a table `run` of settings for every entry, and tables
`entries.NAME` with settings of RunConfig (`adapt` is a table of AdaptConfig's, `settings` one of
the detector's). A list where RunConfig takes one value makes a part of each, and several lists a
grid:
`severity = [0.25, 0.5]` with `adapt.ratio = [4, 16]` are four parts,
NAME/severity=0.25,adapt.ratio=4 and so on. What is not given is RunConfig's default.

OUT/suite.json holds the resolved parts; OUT/PART/ the result files of each; OUT/bench.parquet all
rows of the finished parts' runs.parquet with their part in front, OUT/bench.json their summaries
and what their arms say together (`scores`), OUT/recovery.png the Kaplan-Meier curves of recovery,
OUT/ratio.png recovery against train ratio where a suite has several. Parts are independent: several
machines share a suite by `shard`, and `merge` takes over what others finished.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import json
import os
import pathlib
import re
import shutil
import time
import tomllib
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl import detectors, envs, faults
from mjx_cl.adapt.arms import ARMS, FOREVER, ONSET
from mjx_cl.config import AdaptConfig, RunConfig, kinds, replace
from mjx_cl.errors import FileError, UserError
from mjx_cl.faults.presets import becomes, changes
from mjx_cl.io import folders, memory, tables
from mjx_cl.render import figures
from mjx_cl.rollout.order import Lanes
from mjx_cl.runs import merge, run, settings, workers
from mjx_cl.runs.doubts import doubts, watching
from mjx_cl.runs.identity import arm_agents
from mjx_cl.runs.records import acts
from mjx_cl.scoring import ablation, normalised_recovery, stop_rule, survival
from mjx_cl.training import agents, needs

if TYPE_CHECKING:
  from collections.abc import Collection, Iterable, Iterator, Sequence
  from typing import Any

SUITES = pathlib.Path(__file__).parent / "suites"
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

# Seconds on 2 quiet cores whose dense float32 products run at RATE (matmul_rate), from wall_s,
# wall_share and updates in results/quick/*/summary.json
RATE = 440e9
WATCH_S, ACT_S = 0.25e-3, 0.11e-3  # monitor; acting: per stream and control step, size1m
PHYSICS_S = {
  "walker": 0.05e-3,
  "quadruped": 0.06e-3,
  "car": 0.0,
  "car_real": 0.06e-3,
}  # car: within acting; car_real: results/physics.json
UPDATE_S = (
  0.045 / (4 * 64)
  # per replayed step that an update trains on, size1m, every state an imagination start, several
  # streams side by side;
)
# results/study: 0.087 s an update on one core
COMPILE_S = 35.0  # programs of one part
ADAPTS = {
  "walker": 7_900,
  "quadruped": 9_200,
  "car": 8_100,
  "car_real": 15_000,
}  # control steps that a finetuning with a stop rule lasted, of the robot
# that it goes on with: the mean, which sums need, of 585 in the published suites; test_bench.py
# holds it against them
ADAPT = 9_000  # of any other robot

FOLDER, LETTERS = (
  r"\w[\w .,=+-]*",
  "letters, digits, spaces and _ - + . , =",
)  # what the names of suites and entries are made of


class Part(NamedTuple):
  """One run of a suite. Attributes: name: folder below OUT. config: RunConfig."""

  name: str
  config: RunConfig


class Suite(NamedTuple):
  """Attributes: name, about: for people. parts: in the order in which they run."""

  name: str
  about: str
  parts: tuple[Part, ...]


class Estimate(NamedTuple):
  """What a part will take. Attributes: streams. stream_steps. updates: of all streams. seconds.
  bytes: that its process grows to.
  """

  streams: int
  stream_steps: int
  updates: float
  seconds: float
  bytes: int


# ---- suites --------------------------------------------------------------------------------------


def shipped() -> dict[str, str]:
  """Name -> about, of the suites that ship."""
  return {
    path.stem: tomllib.loads(path.read_text())["about"] for path in sorted(SUITES.glob("*.toml"))
  }


def suite(name: str, change: dict | None = None) -> Suite:
  """A suite by name or from a TOML file.

  Args:
    change: settings that take the place of the suite's own in every entry, e.g. {"seeds": 2}.

  Raises:
    UserError for an unknown name, key or value, with the choices; FileError for a file that is no
    TOML.
  """
  path, data = tables.read_suite(name, SUITES)
  where = f"suite {path.name}"
  unknown = sorted(set(data) - {"name", "about", "run", "entries"})
  if unknown or "name" not in data:
    wrong = f"unknown {', '.join(map(repr, unknown))}" if unknown else "no name"
    raise UserError(f"{where}: {wrong}; it takes: name, about, run, entries")
  if not isinstance(data["name"], str) or not re.fullmatch(FOLDER, data["name"]):
    raise UserError(f"{where}: name {data['name']!r} is a folder's name and takes {LETTERS} alone")
  if not isinstance(data.get("run", {}), dict):
    raise UserError(f"{where}: run is a table of settings for every entry; got {data['run']!r}")
  entries = data.get("entries", {})
  if (
    not isinstance(entries, dict)
    or not entries
    or not all(isinstance(e, dict) for e in entries.values())
  ):
    raise UserError(f"{where}: it needs tables [entries.NAME]")
  parts: list[Part] = []
  for key, entry in entries.items():
    if not re.fullmatch(FOLDER, key):
      raise UserError(f"{where}: entry {key!r} is a folder's name and takes {LETTERS} alone")
    parts += grid(
      f"{where}, entry {key!r}", key, merged(merged(data.get("run", {}), entry), change or {})
    )
  names = [p.name for p in parts]
  twice = next((n for k, n in enumerate(names) if n in names[:k]), None)
  if twice:
    raise UserError(f"{where}: part {twice} is there twice")
  return Suite(data["name"], str(data.get("about", "")), tuple(parts))


def merged(first: dict, second: dict) -> dict:
  """`second` over `first`, tables within tables."""
  both = dict(first)
  for k, v in second.items():
    both[k] = merged(both[k], v) if isinstance(v, dict) and isinstance(both.get(k), dict) else v
  return both


def grid(where: str, name: str, values: dict) -> list[Part]:
  """Parts of one entry: all combinations of its lists.

  Raises:
    UserError for an empty list, a list of tables, or what `config` refuses.
  """
  for table in ("adapt", "settings"):
    if not isinstance(values.get(table, {}), dict):
      raise UserError(f"{where}: {table} is a table of settings; got {values[table]!r}")
  lists: list[tuple[tuple[str, ...], list]] = [
    ((k,), v) for k, v in values.items() if isinstance(v, list) and k != "arms"
  ]
  lists += [(("adapt", k), v) for k, v in values.get("adapt", {}).items() if isinstance(v, list)]
  for path, choices in lists:
    if not choices:
      raise UserError(f"{where}: {'.'.join(path)} is an empty list")
  parts = []
  for combination in itertools.product(*(choices for _, choices in lists)):
    own = merged(values, {})
    for (path, _), value in zip(lists, combination):
      own = merged(own, {path[0]: value} if len(path) == 1 else {path[0]: {path[1]: value}})
    label = ",".join(
      f"{'.'.join(path)}={str(value).replace('/', '-')}"
      for (path, _), value in zip(lists, combination)
    )
    parts.append(Part(f"{name}/{label}" if label else name, config(where, own)))
  return parts


def config(where: str, values: dict) -> RunConfig:
  """RunConfig from an entry's settings.

  Raises:
    UserError for an unknown setting or a value that RunConfig refuses.
  """
  values = dict(values)
  known = {f.name for f in dataclasses.fields(RunConfig)}
  unknown = sorted(set(values) - known)
  if unknown:
    raise UserError(
      f"{where}: unknown setting {', '.join(map(repr, unknown))}; it takes: "
      f"{', '.join(sorted(known))}"
    )
  if "env" not in values:
    raise UserError(f"{where}: it needs an env")
  arms = values.get("arms", [])
  if not isinstance(arms, (list, tuple)) or not all(isinstance(arm, str) for arm in arms):
    raise UserError(
      f"{where}: arms is one list of names; got {arms!r}; choose from: {', '.join(ARMS)}"
    )
  check_kinds(where, RunConfig, values)
  check_kinds(where, AdaptConfig, values.get("adapt", {}), "adapt.")
  try:
    if "adapt" in values:
      values["adapt"] = replace(AdaptConfig(), **values["adapt"])
    if "arms" in values:
      values["arms"] = tuple(values["arms"])
    return settings.check(RunConfig(**values))
  except UserError as e:
    raise UserError(f"{where}: {e}") from None
  except TypeError as e:
    raise UserError(f"{where}: a value of the wrong kind ({e})") from None


def check_kinds(where: str, of: type, values: dict, before: str = "") -> None:
  """Raises UserError where a setting of the dataclass `of` has a value of another kind than its
  annotation says.
  """
  kinds(where, {field.name: str(field.type) for field in dataclasses.fields(of)}, values, before)


# ---- the plan ------------------------------------------------------------------------------------


def matmul_rate(seconds: float = 1.0) -> float:
  """FLOP/s of a dense float32 product of 2048 x 2048 matrices, the best of `seconds`; first calls,
  which compile, left out.
  """
  x = jnp.ones((2048, 2048), jnp.float32)
  dot = jax.jit(jnp.dot)
  dot(x, x).block_until_ready()
  best, end = float("inf"), time.perf_counter() + seconds
  while time.perf_counter() < end:
    begin = time.perf_counter()
    dot(x, x).block_until_ready()
    best = min(best, time.perf_counter() - begin)
  return 2 * 2048**3 / best


def finetunings(
  config: RunConfig, arm: str, seed: int | None = None, most: int = FOREVER
) -> list[int]:
  """Control steps of each finetuning that is expected of a stream: those of its arm's schedule, or,
  where it listens, one from each onset and repair on; as long as its robot's took (ADAPTS) where a
  rule ends it. What begins within another begins nothing.

  Args:
    seed: of the stream; None: the run's first. most: control steps after which it is told to end.
  """
  own, faulty = ARMS[arm], [change for change in changes(config) if change.fault != "none"]
  first = [config.onset] * (becomes(config) is not None)
  starts: Sequence[int]
  if not own.breaks:
    starts = []
  elif own.trigger.listens:
    starts = first + [
      config.onset + change.after + late
      for change in faulty
      if acts(change)
      for late in (0, change.duration)
      if late is not None
    ]
  else:
    onsets = tuple(first + [config.onset + change.after for change in faulty])
    starts = own.trigger.steps(
      config.adapt, onsets, config.steps, config.first_seed if seed is None else seed
    )
  limit = min(
    ADAPTS.get(becomes(config) or config.env, ADAPT) if own.end.rule else FOREVER,
    own.end.limit(config.adapt),
    most,
  )
  out, free = [], config.adapt.warmup
  for start in sorted(
    max(step, config.adapt.warmup) if own.trigger.listens else step for step in starts
  ):
    if free <= start < config.steps:
      out.append(min(limit, config.steps - start))
      free = start + out[-1]
  return out


class Robots:
  """What the parts of a plan share, each built once."""

  def __init__(self) -> None:
    self.make = functools.cache(envs.make)
    self.learner = functools.cache(
      lambda name, agent: agents.of(self.make(name, "auto"), agent).agent.config
    )


def estimate(part: Part, rate: float, robots: Robots | None = None) -> Estimate:
  """Expected cost of a part on a machine whose dense float32 products run at `rate` FLOP/s. Physics
  is taken to scale alike: an estimate, no promise.

  Raises:
    UserError, FileError for an agent or oracle stops that cannot be read, see `check`.
  """
  c = part.config
  robots = robots or Robots()
  spec, trained = robots.make(c.env, "auto").spec, robots.learner(c.env, c.agent)
  batch, starts = c.adapt.batch or trained.batch, c.adapt.last_starts
  size = (
    needs.parameters(trained.size, len(spec.obs), len(spec.act), trained.bins)[0] / 640_867
  )  # of size1m on a walker
  streams = len(c.arms) * c.seeds
  told = stop_rule.told(c)
  learning = sum(
    max(0, steps - c.adapt.start_windows - trained.length)
    for arm in c.arms
    for seed in range(c.first_seed, c.first_seed + c.seeds)
    for steps in finetunings(c, arm, seed, told[seed] if ARMS[arm].end.told else FOREVER)
  )
  updates = learning * c.adapt.ratio / (batch * trained.length)
  share = (
    1.0 if not starts else 0.5 + 0.5 * starts / trained.length
  )  # imagination is about half of an update
  physics = max(PHYSICS_S.get(name, 0.1e-3) for name in filter(None, (c.env, becomes(c))))
  lanes = len(Lanes(len(c.arms), c.seeds).order)
  seconds = (
    c.steps * (streams * WATCH_S * size + lanes * (ACT_S * size + physics))
    + updates * batch * trained.length * UPDATE_S * share * size
  )
  need = needs.need(
    trained.size,
    len(spec.obs),
    len(spec.act),
    run.capacity(c.steps, spec.episode_steps),
    trained.bins,
  )
  return Estimate(
    streams,
    streams * c.steps,
    updates,
    COMPILE_S + seconds * RATE / rate,
    memory.resident(need.total(streams)),
  )


def estimates(parts: Iterable[Part], robots: Robots | None = None) -> dict[str, Estimate]:
  """Part -> Estimate on this machine."""
  rate, robots = matmul_rate(), robots or Robots()
  return {p.name: estimate(p, rate, robots) for p in parts}


def check(part: Part, robots: Robots | None = None) -> None:
  """Refuses, before the suite starts, names and values that only the registries know: fault,
  target, detector, agent.
  """
  c, robots = part.config, robots or Robots()
  try:
    detectors.make(c.detector, **c.settings)
    faults.build(changes(c), robots.make(becomes(c) or c.env, c.physics), c.onset)
    robots.learner(c.env, c.agent)
    arm_agents(c, robots.make(c.env, c.physics))
    stop_rule.told(c)
  except UserError as e:
    raise type(e)(f"part {part.name}: {e}") from None


def notes(parts: Iterable[Part]) -> list[tuple[str, str]]:
  """What `mjx-cl run` would say of these parts' settings before it starts (doubts.py),
  each with the parts that it holds for.
  """
  which: dict[str, list[str]] = {}
  for part in parts:
    for text in [*filter(None, [watching(part.config)]), *doubts(part.config)]:
      which.setdefault(text, []).append(part.name)
  return [
    (text, names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more")
    for text, names in which.items()
  ]


# ---- running -------------------------------------------------------------------------------------


def finished(out: pathlib.Path, part: Part) -> bool:
  """Whether OUT/PART holds this part's results.

  Raises:
    UserError where it holds a run with other settings.
  """
  folder = pathlib.Path(out) / part.name
  if text := merge.differs(folder, part.config):
    raise UserError(
      f"{folder} {text}; give the same settings or another --out, or remove that folder"
    )
  return _complete(folder)


def _complete(folder: pathlib.Path) -> bool:
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
    elif _complete(folder):
      own.append(part)
  return own, others


def pick(
  parts: tuple[Part, ...], only: tuple[str, ...], shard: tuple[int, int] = (0, 1)
) -> list[Part]:
  """Parts whose name is in `only` or lies below one of its names, all where it is empty; of these
  every n-th from k on, shard = (k, n).
  """
  for name in only:
    if not any(p.name == name or p.name.startswith((name + "/", name + ",")) for p in parts):
      raise UserError(
        f"no part {name!r} in this suite; choose from: {', '.join(p.name for p in parts)}"
      )
  k, n = shard
  if not 0 <= k < n:
    raise UserError(f"shard K/N needs 0 <= K < N; got {k}/{n}")
  chosen = [
    p
    for p in parts
    if not only
    or any(p.name == name or p.name.startswith((name + "/", name + ",")) for name in only)
  ]
  return chosen[k::n]


def offers(
  out: pathlib.Path,
  parts: Iterable[Part],
  folders: Collection[pathlib.Path | str],
  tell: Callable[[str], None] = lambda text: None,
) -> dict[str, list[pathlib.Path]]:
  """Part -> folders that its run can be taken from, of those that are not finished in OUT: one, or
  several whose seeds are to be joined, see pieces.py.

  Args:
    folders: others' OUT of the same suite. tell: gets a line for each part of theirs that is
      refused, since it was run with other settings or cannot be read.

  Raises:
    UserError where OUT holds a part with other settings, or seeds of a part are missing or there
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
          there.append((folder, own))
      except UserError as e:
        tell(f"note: {e}; {part.name} is not taken over from there")
    whole = [[folder] for folder, own in there if own == part_seeds(part)]
    if sources := whole[0] if whole else merge.choose([folder for folder, _ in there], part.config):
      found[part.name] = sources
  return found


def take(out: pathlib.Path, parts: Iterable[Part], found: dict[str, list[pathlib.Path]]) -> None:
  """Copies to OUT, or joins there, what `offers` has found of the parts."""
  for part in parts:
    if not (sources := found.get(part.name)):
      continue
    tmp = out / (part.name + ".tmp")
    shutil.rmtree(tmp, ignore_errors=True)
    tmp.mkdir(parents=True)
    if len(sources) == 1:
      for name in MERGED:
        if (sources[0] / name).exists():
          shutil.copyfile(sources[0] / name, tmp / name)
      merge.copy_agents(sources[0], tmp)
    else:
      merge.join(sources, tmp, part.config)
    shutil.rmtree(out / part.name, ignore_errors=True)
    os.replace(tmp, out / part.name)


def part_seeds(part: Part) -> list[int]:
  """Seeds of a part."""
  return list(range(part.config.first_seed, part.config.first_seed + part.config.seeds))


def publish(out: pathlib.Path | str, plan: Suite, to: pathlib.Path | str) -> list[str]:
  """Copies the finished parts' small files, all but the trace, to the folder `to`, as they are
  committed, and writes there what `collect` does of them and of the parts that lie there already
  and OUT lacks, which stay as they are; returns the names of those copied.

  Raises:
    UserError, FileError as `earlier`.
  """
  out, to = pathlib.Path(out), pathlib.Path(to)
  kept, done = earlier(to, plan), standing(out, plan.parts)[0]
  for part in done:
    kept.pop(part.name, None)
    (to / part.name).mkdir(parents=True, exist_ok=True)
    for name in PUBLISHED:
      if (out / part.name / name).exists():
        folders.atomic(
          to / part.name / name,
          lambda file, source=out / part.name / name: file.write(source.read_bytes()),  # type: ignore[misc]
        )
      else:  # of an earlier run, as the figure where seeds were joined without their traces
        (to / part.name / name).unlink(missing_ok=True)
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
    UserError where another suite was, or suite.json does not say what a part is; FileError for a
    broken file.
  """
  to = pathlib.Path(to)
  if not (to / "bench.json").exists():
    return {}
  value = tables.read_json(to / "bench.json")
  if value.get("suite") != plan.name:
    raise UserError(
      f"--publish: {to} holds suite {value.get('suite')!r}, not {plan.name!r}; give another folder"
    )
  entries = {
    name: entry for name, entry in value.get("entries", {}).items() if _complete(to / name)
  }
  said = tables.read_json(to / "suite.json").get("parts", {}) if entries else {}
  out = {}
  for name, entry in entries.items():
    try:
      out[name] = Part(name, _resolved(said[name])), entry["scores"]
    except (KeyError, TypeError, UserError) as e:
      raise UserError(
        f"--publish: {to} holds part {name}, which its suite.json and bench.json do not "
        f"describe ({e}); give another folder"
      ) from None
  return out


HORIZON = 10_000  # control steps after the onset, of the restricted mean time to recovery
PATIENCES = (
  48,
  24,
  12,
)  # chunks over which signals must be settled, of the stop rule without its floor


def scores(folder: pathlib.Path) -> dict:
  """What several arms of one finished part say together.

  Returns:
    normalised: arm -> recovery, 0 = arm `none`, 1 = reward_pre (scoring.normalised.summarise); null
      without arm `none`.
    against_oracle: paired difference of `detector` and `oracle` in it
      (scoring.normalised.difference); null without both arms.
    recovery: arm -> Kaplan-Meier of the affected streams: n, recovered, median_steps,
      restricted_mean_steps up to HORIZON or to where the first stream is no longer watched, see
      survival.watched, each with _ci; null without affected streams.
    ablation: the stop rule with each signal left out (scoring.ablation); only where an arm that
      never stops has adapted.
    without_floor: patience [chunks], as text -> the same without the floor of `least` control
      steps, so that the signals alone decide.
  """
  config, rows = tables.read_json(folder / "config.json"), tables.read_rows(folder / "runs.parquet")
  arms, watched = config["arms"], survival.watched(rows, config["steps"])
  scored = normalised_recovery.rows(rows) if "none" in arms else []
  out: dict[str, Any] = {
    "normalised": normalised_recovery.summarise(scored) or None,
    "against_oracle": None,
    "recovery": {},
  }
  if scored and {"detector", "oracle"} <= set(arms):
    out["against_oracle"] = normalised_recovery.difference(scored, "detector", "oracle")
  if (folder / "signals.parquet").exists():
    try:
      out["ablation"] = ablation.ablated(ablation.ablation(folder))
      out["without_floor"] = {
        str(n): ablation.ablated(ablation.ablation(folder, least=1, patience=n)) for n in PATIENCES
      }
    except UserError as e:
      if isinstance(e, FileError):
        raise  # else no stream has adapted
  for arm in arms:
    own = [r for r in rows if r["arm"] == arm]
    if not any(r["affected"] for r in own if not r["change"]):
      out["recovery"][arm] = None
      continue
    time_, seen = survival.of_runs(
      [r for r in own if not r["change"]] + [dict(r, affected=False) for r in own if r["change"]],
      config["steps"],
    )
    median, median_ci = survival.quantile(survival.kaplan_meier(time_, seen))
    enough = len(seen) > 3  # three streams or fewer give no interval
    horizon = min(  # type: ignore[type-var]
      HORIZON, *(w for w, r in zip(watched, rows) if not r["change"] and r["onset"] is not None)
    )
    mean, mean_ci = survival.restricted_mean(time_, seen, horizon) if horizon > 0 else (None, None)  # type: ignore[arg-type, operator]
    out["recovery"][arm] = {
      "n": len(seen),
      "recovered": int(seen.sum()),
      "median_steps": median,
      "median_steps_ci": median_ci if enough else None,
      "restricted_mean_steps": mean,
      "restricted_mean_steps_ci": mean_ci if enough else None,
      "horizon": horizon,
    }
  return out


def collect(
  out: pathlib.Path, plan: Suite, known: dict | None = None, kept: frozenset[str] = frozenset()
) -> dict:
  """Writes OUT/bench.parquet, OUT/bench.json, OUT/recovery.png and OUT/ratio.png from the finished
  parts and returns the second's value. What OUT holds of a part with other settings is left out,
  see `standing`.

  Args:
    known: part -> scores, of those that an earlier call has read; filled here. kept: parts that
      count whatever their settings.
  """
  known = {} if known is None else known
  columns: dict[str, list] = {}
  value: dict[str, Any] = {
    "suite": plan.name,
    "parts": len(plan.parts),
    "finished": 0,
    "entries": {},
  }
  there = {p.name for p in standing(out, [p for p in plan.parts if p.name not in kept])[0]} | kept
  for part in plan.parts:
    if part.name not in there:
      continue
    summary = tables.read_json(out / part.name / "summary.json")
    value["finished"] += 1
    if part.name not in known:
      known[part.name] = scores(out / part.name)
    value["entries"][part.name] = summary | {"scores": known[part.name]}
    rows = tables.read_arrow(out / part.name / "runs.parquet").to_pydict()
    count = len(next(iter(rows.values())))
    before = len(next(iter(columns.values()))) if columns else 0
    for name, cells in (
      {
        "suite": [plan.name] * count,
        "part": [part.name] * count,
        "robot": [part.config.env] * count,
        "severity_asked": [part.config.severity] * count,
        "ratio": [part.config.adapt.ratio] * count,
      }
      | rows
    ).items():
      columns.setdefault(name, [None] * before).extend(cells)  # type: ignore[arg-type]
    for cells in columns.values():
      cells.extend([None] * (before + count - len(cells)))
  if columns:
    tables.write_table(out / "bench.parquet", columns)
    draw(out, plan, value)
  tables.write_json(out / "bench.json", value)
  return value


def draw(out: pathlib.Path, plan: Suite, value: dict) -> list[pathlib.Path]:
  """OUT/recovery.png and OUT/ratio.png, as far as there is something to draw, from the rows of
  OUT's parts and what bench.json holds, `value`. Returns the files.
  """
  points = [
    p
    for part in plan.parts
    if part.name in value["entries"]
    for p in _points(part, value["entries"][part.name]["scores"])
  ]
  return [
    file
    for file in (figures.survival(out, list(value["entries"])), figures.ratios(out, points))
    if file
  ]


def redraw(results: pathlib.Path | str) -> list[pathlib.Path]:
  """The figures of every suite that is published in a subfolder of `results`, drawn anew from its
  files. Returns them.

  Raises:
    FileError where a folder with a bench.json is broken, or of a suite that this package does not
    have and without its suite.json.
  """
  out = []
  for folder in sorted(p.parent for p in pathlib.Path(results).glob("*/bench.json")):
    try:
      value = json.loads((folder / "bench.json").read_text())
      out += draw(folder, _published(folder, value["suite"]), value)
    except (OSError, ValueError, KeyError, TypeError) as e:
      raise FileError(f"cannot draw the figures of {folder}: {type(e).__name__}: {e}") from None
    except UserError as e:
      raise FileError(f"cannot draw the figures of {folder}: {e}") from None
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
  return Suite(name, "", tuple(Part(part, _resolved(c)) for part, c in parts.items()))


def _resolved(values: dict) -> RunConfig:
  """The settings of a part as suite.json holds them."""
  return RunConfig(
    **values | {"arms": tuple(values["arms"]), "adapt": AdaptConfig(**values["adapt"])}
  )


def _points(part: Part, scores_: dict) -> list[dict]:
  """What plots.ratios draws of a part: its arms that start at the true onset."""
  c = part.config
  return [
    {
      "line": f"{c.env}, {c.fault}"
      + ("" if c.severity is None else f" {c.severity:g}")
      + (f", {arm}" if sum(ARMS[a].trigger is ONSET for a in c.arms) > 1 else ""),
      "ratio": c.adapt.ratio,
      "mean": own["restricted_mean_steps"],
      "ci": own["restricted_mean_steps_ci"],
      "n": own["n"],
      "recovered": own["recovered"],
    }
    for arm, own in scores_["recovery"].items()
    if own and own["restricted_mean_steps"] is not None and ARMS[arm].trigger is ONSET
  ]


def write_plan(plan: Suite, out: pathlib.Path | str) -> None:
  """OUT/suite.json: name and the resolved settings of every part."""
  out = pathlib.Path(out)
  out.mkdir(parents=True, exist_ok=True)
  tables.write_json(
    out / "suite.json",
    {
      "suite": plan.name,
      "parts": {p.name: json.loads(json.dumps(dataclasses.asdict(p.config))) for p in plan.parts},
    },
  )


@contextlib.contextmanager
def _silent() -> Iterator[Callable[[run.Progress], Any]]:
  """A display that shows nothing."""
  yield lambda progress: None


def execute(
  plan: Suite,
  out: pathlib.Path | str,
  parts: Iterable[Part],
  estimates: dict[str, Estimate] | None = None,
  tell: Callable[[str], None] = lambda text: None,
  display: Callable[[], contextlib.AbstractContextManager[Callable[[run.Progress], Any]]]
  | None = None,
  save_every_s: float = 60.0,
  jobs: int = 1,
  worker: str = "",
) -> dict:
  """Runs the parts that are not finished, in order; one that was cut off goes on from its last
  checkpoint.

  Args:
    parts: of the plan, see `pick`. estimates: part -> Estimate, for the time left. display: context
      manager that gives run.execute's progress.
    jobs: parts side by side, see workers.py, the longest first. The last digits of a run depend on
      how many cores it has.
    worker: module that such a process runs.

  Returns:
    bench.json's value.
  """
  out = pathlib.Path(out)
  write_plan(plan, out)
  todo = [p for p in parts if not finished(out, p)]
  if jobs > 1 and len(todo) > 1:
    names = [p.name for p in todo]
    if estimates:
      names.sort(key=lambda name: -estimates[name].seconds)
    over: list[str]
    known: dict[str, dict]
    over, known, begin = [], {}, time.monotonic()

    def end(name: str) -> None:
      over.append(name)
      collect(out, plan, known)
      left = ""
      if estimates and len(over) < len(names):
        seconds = lambda which: sum(estimates[n].seconds for n in which)
        left = (
          "; at most about "
          f"{round((time.monotonic() - begin) * (seconds(names) / seconds(over) - 1) / 60) or 1} "
          "min left"
        )
      tell(f"{name} finished, {len(over)} of {len(names)}{left}")

    workers.together(worker, out, names, min(jobs, len(names)), end, tell)
    return collect(out, plan, known)
  spent, expected, known, programs = 0.0, 0.0, {}, run.Programs()
  for i, part in enumerate(todo):
    guess = lambda p: estimates[p.name].seconds if estimates else 0.0
    if estimates:
      left = sum(map(guess, todo[i:])) * (spent / expected if expected else 1.0)
      tell(f"{part.name} ({i + 1} of {len(todo)}); about {round(left / 60) or 1} min left")
    begin = time.monotonic()
    begun = (out / part.name / "config.json").exists()
    with (display or _silent)() as progress:
      run.execute(
        part.config,
        out / part.name,
        resume=begun,
        progress=progress,
        save_every_s=save_every_s,
        programs=programs,
      )
    spent, expected = spent + time.monotonic() - begin, expected + guess(part)
    collect(out, plan, known)
  return collect(out, plan, known)
