"""The command line. Nothing here imports JAX before a command that computes runs, so `--help` answers at once.

Exit codes: 0 done; 2 arguments, names, ranges, refused --out; 1 files, disk, numeric failure; 130 Ctrl-C, after state is saved.
"""
from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import math
import os
import pathlib
import re
import signal
import sys
import time
from dataclasses import dataclass
from typing import Annotated

import tyro

from mjx_cl import __version__
from mjx_cl.config import ARMS, PRESETS, AdaptConfig, RunConfig, TrainConfig, replace
from mjx_cl.errors import FileError, UserError, choose

Positional = tyro.conf.Positional


@dataclass(frozen=True)
class Run:
  """Lives the whole loop: fault, alarm, finetuning, stop; arms x seeds streams side by side.

  Writes config.json, trace.parquet, events.parquet, runs.parquet, summary.json and figure.png into --out.
  """
  env: Positional[str]
  """Robot, see `mjx-cl list envs`."""
  out: str = "runs/latest"
  """Result folder."""
  fault: str = "gear"
  """Fault, see `mjx-cl list faults`, or preset, see `mjx-cl list fault-presets`; `none` for the healthy robot."""
  target: str = "random"
  """Joint or part that the fault hits, `random`: drawn from the stream's seed."""
  severity: float | None = None
  """In [0, 1]; 0 is nominal, 0.5 (the default) is the paper's gear halved; a preset brings its own."""
  onset: int = 5000
  """First control step that the fault acts in."""
  duration: int | None = None
  """Control steps until the fault is repaired; default: never."""
  schedule: str = "abrupt"
  """How the severity moves from the onset on: abrupt, ramp, intermittent, cyclic or random_walk."""
  period: int = 1000
  """Control steps of the ramp, of one cycle, or between two steps of the random walk."""
  share: float = 0.5
  """On-share of an intermittent fault, deviation of a random walk's steps."""
  steps: int = 25_000
  """Control steps in all, counted from 0."""
  seeds: int = 10
  """Streams per arm."""
  first_seed: int = 0
  """Seeds are first_seed, first_seed + 1, ..."""
  detector: str = "rolling_sigma"
  """Change detector, see `mjx-cl list detectors`; NAME@CHANNEL watches one channel. One that stands on the leaderboard has, unless given, its threshold of one false alarm in 100,000 steps."""
  set: tuple[str, ...] = ()
  """Detector settings, name=value ..."""
  arm: tuple[str, ...] = ("detector", "none")
  """Arms, see `mjx-cl list arms`."""
  agent: str | None = None
  """Trained agent: shipped name or folder."""
  physics: str = "auto"
  """auto, native or mjx."""
  form: str = "paper"
  """Residual form, paper or streaming."""
  actions: str = "recorded"
  """Actions of the monitor's predictions, recorded or policy."""
  deterministic: bool = False
  """Act by the policy's mean instead of a sample."""
  snapshots: int = 0
  """Control steps of adaptation between two snapshots of arm oracle-budget, which the stop rule is scored against; 0: none."""
  keep: bool = False
  """Write what each stream has learnt as an agent, OUT/agents/ARM-SEED, for --agent of another run."""
  parts: bool = False
  """Also write the residual of each part of the observation into trace.parquet, columns residual_NAME."""
  residuals: bool = False
  """Also write residuals.parquet: the residual of every single variable of the observation, in its own unit, for each stream and control step."""
  adapt: AdaptConfig = AdaptConfig()
  json: bool = False
  """One JSON value on standard output, nothing else there."""
  resume: bool = False
  """Go on with a run that was cut off."""
  overwrite: bool = False
  """Replace an earlier run in --out."""


@dataclass(frozen=True)
class Train:
  """Pretrains an agent; ends with OUT/agent (weights, card), which every --agent takes."""
  env: Positional[str]
  """Robot, see `mjx-cl list envs`."""
  out: str = "runs/train"
  """Folder for checkpoints, metrics.parquet and the agent."""
  preset: str = "cpu"
  """Learner and schedule, see `mjx-cl list presets`."""
  demonstrator: str | None = None
  """A policy's .npz, `reference`: the robot's own driver (car), or `ppo`: train one first with brax (needs mjx-cl[brax]); default: none."""
  agent: str | None = None
  """Start from this agent's weights, moments and counters; the replay is filled by acting."""
  set: tuple[str, ...] = ()
  """Settings of learner or schedule, name=value ... (updates=20000 lr=1e-4)."""
  seed: int = 0
  seeds: int = 1
  """Agents trained side by side; their parameters share one program."""
  physics: str = "auto"
  save_every_s: float = 240.0
  """Seconds between checkpoints."""
  json: bool = False
  resume: bool = False
  """Go on with a training that was cut off, with the settings it began with; `updates` may be others."""
  overwrite: bool = False
  """Replace an earlier training in --out, its agent and its demonstrator too."""


@dataclass(frozen=True)
class Eval:
  """Return of an agent on the healthy robot."""
  env: Positional[str]
  episodes: int = 20
  agent: str | None = None
  seed: int = 0
  """Episodes use seeds seed, seed + 1, ..."""
  physics: str = "auto"
  deterministic: bool = False
  json: bool = False


@dataclass(frozen=True)
class Certify:
  """Proves for every fault that it acts, and measures what it costs; writes certificates.parquet and certificates.md into --out."""
  env: Positional[tuple[str, ...]] = ()
  """Robots, default: all, see `mjx-cl list envs`."""
  out: str = "results"
  """Result folder; rows of other robots in it are kept."""
  fault: tuple[str, ...] = ()
  """Only these faults, or presets that turn the robot into another one."""
  episodes: int = 20
  """Episodes per fault and severity for the return lost without adaptation; 0: none."""
  agent: str | None = None
  """Trained agent: shipped name or folder; default: the shipped one, where there is one."""
  physics: str = "auto"
  json: bool = False


@dataclass(frozen=True)
class Record:
  """Records residual streams of a suite: frozen agents, healthy and faulty robots side by side, to Parquet that pandas alone reads.

  A recording that was cut off goes on where it stopped: parts that are finished are kept in OUT/work until all are there.
  """
  suite: Positional[str] = "leaderboard"
  """Suite by name, see `mjx-cl list suites`, or a .toml file."""
  out: str = "runs/streams"
  """Folder of the set."""
  robot: tuple[str, ...] = ()
  """Only these robots of the suite."""
  agent: str | None = None
  """Trained agent: shipped name or folder; default: the shipped one of each robot."""
  physics: str = "auto"
  json: bool = False
  overwrite: bool = False
  """Replace a set that is in --out; with --robot, in a set of the same suite, those robots' streams alone."""


@dataclass(frozen=True)
class Leaderboard:
  """Scores every registered detector on recorded streams; writes leaderboard.parquet and leaderboard.html into --out.

  Ways in for a detector of one's own: a plug-in (entry point mjx_cl.detectors), --add with a Python class, --submit with a file of scores.
  """
  streams: Positional[str | None] = None
  """Folder of `mjx-cl record`; default: the set that ships."""
  out: str = "runs/leaderboard"
  """Result folder."""
  overwrite: bool = False
  """Replace an earlier board in --out, or files that --export left."""
  robot: tuple[str, ...] = ()
  """Only these robots of the set."""
  detector: tuple[str, ...] = ()
  """Only these detectors, by their names on the board; `none`: only the oracles and one's own. Default: all."""
  add: str | None = None
  """module:Class or file.py:Class, a Python class with update(x) -> bool; a river detector works unchanged."""
  set: tuple[str, ...] = ()
  """Settings of --add, name=value ..."""
  channel: str = "opr"
  """What --add watches: opr, rpr, reward, surprise or group_0 .. group_7."""
  log: bool = False
  """Give --add the logarithm, as the built-in detectors of one number have it."""
  threshold: str | None = None
  """Setting of --add that is calibrated, larger = fewer alarms; default: it runs as it is, and its own rate of false alarms is printed."""
  submit: str | None = None
  """Parquet with the columns stream, step, score, for all streams that --export writes."""
  name: str | None = None
  """Name of --add or --submit on the board."""
  export: str | None = None
  """Only write the streams in full into this folder, one Parquet file per robot, for tools of one's own."""
  json: bool = False


@dataclass(frozen=True)
class Bench:
  """Runs a suite: runs over robots, faults and settings, each in a folder of its own; prints its plan first.

  The same command goes on where it was cut off; finished parts are never run again. Writes OUT/PART/ as `mjx-cl run` does, OUT/bench.parquet, OUT/bench.json.
  """
  suite: Positional[str] = "quick"
  """paper, quick, full, study or a .toml file, see `mjx-cl list benches`."""
  out: str | None = None
  """Result folder; default: runs/bench/SUITE."""
  only: tuple[str, ...] = ()
  """Only these parts, or those below these names."""
  seeds: int | None = None
  """In place of the suite's."""
  first_seed: int | None = None
  """In place of the suite's."""
  arm: tuple[str, ...] = ()
  """In place of the suite's."""
  physics: str = "auto"
  plan: bool = False
  """Only print the plan."""
  shard: str = "0/1"
  """K/N: this machine runs every N-th part from the K-th on."""
  jobs: int | None = None
  """Parts side by side, each on its share of the cores; default: one per core as far as memory allows."""
  merge: tuple[str, ...] = ()
  """Folders of the same suite from other machines; their finished parts are copied here and not run, seeds of a part that several hold are joined."""
  publish: str | None = None
  """Copy finished parts' tables and figures, without the traces, to this folder."""
  json: bool = False
  resume: bool = False
  """Said for completeness: a suite always goes on."""


@dataclass(frozen=True)
class Plot:
  """Draws figure.png of a run anew."""
  folder: Positional[str]


@dataclass(frozen=True)
class Render:
  """A moving picture of an agent at work: GIF, or MP4 with mjx-cl[video]; red border while a fault acts."""
  env: Positional[str]
  """Robot, see `mjx-cl list envs`."""
  out: str | None = None
  """File that ends in .gif or .mp4; default: ENV.gif."""
  agent: str | None = None
  """Trained agent: shipped name or folder; `none` stands still, `random` moves at random."""
  fault: str = "none"
  """Fault, see `mjx-cl list faults`, or preset, see `mjx-cl list fault-presets`."""
  target: str = "random"
  """Joint or part that the fault hits, `random`: drawn from the seed."""
  severity: float | None = None
  """In [0, 1], default 0.5; a preset brings its own."""
  onset: int = 200
  """First control step that the fault acts in."""
  duration: int | None = None
  """Control steps until the fault is repaired; default: never."""
  schedule: str = "abrupt"
  """How the severity moves from the onset on: abrupt, ramp, intermittent, cyclic or random_walk."""
  period: int = 1000
  """Control steps of the ramp, of one cycle, or between two steps of the random walk."""
  share: float = 0.5
  """On-share of an intermittent fault, deviation of a random walk's steps."""
  steps: int = 400
  """Control steps in all."""
  seed: int = 0
  width: int = 480
  """Pixels."""
  height: int = 360
  """Pixels."""
  fps: float = 20.0
  """Pictures per second, at the robot's own pace."""
  view: str = "auto"
  """robot (MuJoCo), top (a car on its track, with its lidar) or auto."""
  physics: str = "auto"
  deterministic: bool = False
  """Act by the policy's mean instead of a sample."""
  json: bool = False


@dataclass(frozen=True)
class Detect:
  """Watches a CSV log of one's own: thresholds from a nominal log, alarms in another.

  Read are CSV files, also .csv.gz, with a header row (a row of units may follow) and cells between commas, semicolons (then with a decimal comma too)
  or tabulators; an empty cell or nan is a missing sample, `time` [s] or `step` tell when samples were taken. Not watched are clocks and counters,
  columns that are constant in the nominal log, that hold text or that one log lacks; all of it is printed, --column watches even a clock.

  The nominal log counts as the past of the other: detectors warm up on its first third (1,000 samples at most) and are calibrated on the rest. Every
  column has a detector of its own, the alarm of any counts. Writes detect.json, alarms.csv and detect.png into --out.
  """
  file: Positional[str]
  """Log to judge, .csv or .csv.gz."""
  nominal: str
  """Log of the healthy system, same columns; three times --arl0 samples or more."""
  column: tuple[str, ...] = ()
  """Columns to watch; default: all columns of numbers that both files have, less clocks and constant ones."""
  detector: tuple[str, ...] = ()
  """Detectors of one number per sample, one for each column, or of several channels, one for all columns together; default: all; or module:Class, file.py:Class, a Python class with update(x) and a threshold of its own."""
  set: tuple[str, ...] = ()
  """Settings of such a class, name=value ..."""
  arl0: float = 10_000
  """Wanted mean number of samples between false alarms of one detector, all columns together."""
  rate: float | None = None
  """Samples (or steps of the column `step`) per second; default: from the column `time`, or one of seconds (`time_s`)."""
  logarithm: bool = False
  """Watch the logarithm; for residuals, which are positive and skewed. A sample of 0 or less is refused."""
  out: str | None = None
  """Folder for the results; default: only the table."""
  json: bool = False
  overwrite: bool = False
  """Replace an earlier detection in --out."""


@dataclass(frozen=True)
class Query:
  """SQL over all results, read-only; without SQL: the views, their rows and columns.

  `query SQL`: every table under results/ is a view named after its path (results/walker_gear/runs.parquet is walker_gear_runs).
  `query FOLDER SQL`: the tables of one folder, under their own names (trace, events, runs).
  """
  words: Positional[tuple[str, ...]] = ()
  """[FOLDER] [SQL]"""
  within: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="in")] = ()
  """One more folder, DIR or NAME=DIR: its tables are views that begin with its name. Repeatable."""
  json: bool = False


@dataclass(frozen=True)
class Report:
  """Writes the numbers of README and docs anew from the files in results/: what lies between `<!-- report:NAME -->` and `<!-- /report -->`, nothing else."""
  results: str = "results"
  """Folder of the results."""
  page: tuple[str, ...] = ()
  """Texts with marked blocks; default: README.md and docs/*.md."""
  check: bool = False
  """Write nothing; exit code 1 and the names of the blocks where text and results disagree."""
  figures: bool = False
  """Draw recovery.png and ratio.png of every published suite anew as well. A run's figure.png needs its trace (`mjx-cl plot`), leaderboard.html the streams (`mjx-cl leaderboard`)."""
  json: bool = False


@dataclass(frozen=True)
class List:
  """Names that other commands take."""
  what: Positional[str] = "all"
  """envs, faults, fault-presets, schedules, detectors, presets, agents, arms, sizes, suites, benches or all."""
  json: bool = False


@dataclass(frozen=True)
class Doctor:
  """Versions, devices, physics backend, free memory and a two-second speed check."""
  json: bool = False


Command = (Annotated[Run, tyro.conf.subcommand("run")] | Annotated[Train, tyro.conf.subcommand("train")] | Annotated[Eval, tyro.conf.subcommand("eval")]
           | Annotated[Certify, tyro.conf.subcommand("certify")] | Annotated[Record, tyro.conf.subcommand("record")] | Annotated[Leaderboard, tyro.conf.subcommand("leaderboard")] | Annotated[Bench, tyro.conf.subcommand("bench")] | Annotated[Plot, tyro.conf.subcommand("plot")] | Annotated[Render, tyro.conf.subcommand("render")] | Annotated[Query, tyro.conf.subcommand("query")] | Annotated[Detect, tyro.conf.subcommand("detect")]
           | Annotated[Report, tyro.conf.subcommand("report")]
           | Annotated[List, tyro.conf.subcommand("list")] | Annotated[Doctor, tyro.conf.subcommand("doctor")])


# ---- helpers ---------------------------------------------------------------------------------------------------------------------

def settings(pairs: tuple[str, ...]) -> dict:
  """("a=1", "b=x") -> {"a": 1, "b": "x"}; values are read as JSON where they are JSON."""
  out = {}
  for pair in pairs:
    name, sign, value = pair.partition("=")
    if not sign:
      raise UserError(f"--set takes name=value; got {pair!r}")
    try:
      out[name] = json.loads(value.lower() if value in ("True", "False") else value)
    except ValueError:
      out[name] = value
  return out


def say(text: str) -> None:
  """One line on standard error."""
  print(text, file=sys.stderr, flush=True)


def clock(seconds: float) -> str:
  """m:ss or h:mm:ss."""
  seconds = int(max(0, seconds))
  return f"{seconds // 3600}:{seconds % 3600 // 60:02d}:{seconds % 60:02d}" if seconds >= 3600 else f"{seconds // 60}:{seconds % 60:02d}"


def show(table) -> None:
  """Prints a rich table; as wide as it likes where no terminal says how wide that is, so that no cell is cut."""
  from rich.console import Console
  Console(width=None if sys.stdout.isatty() else 200).print(table)


RESULT = []  # standard output of a command with --json, while whatever else is printed goes to standard error


def emit(value) -> None:
  """The one JSON value of a command."""
  from mjx_cl.store import plain
  print(json.dumps(value, allow_nan=False, default=plain), file=RESULT[-1] if RESULT else None)


@contextlib.contextmanager
def apart(command):
  """With --json nothing but `emit` reaches standard output, also not what a user's detector or robot prints."""
  if not getattr(command, "json", False):
    yield
    return
  RESULT.append(sys.stdout)
  try:
    with contextlib.redirect_stdout(sys.stderr):
      yield
  finally:
    RESULT.pop()


class RunDisplay:
  """Live table of a run on a terminal; a plain line now and then elsewhere."""

  def __init__(self):
    from rich.console import Console
    from rich.live import Live
    self.console = Console(stderr=True)
    self.live = Live(console=self.console, refresh_per_second=2, transient=True) if self.console.is_terminal else None
    self.begin, self.first, self.told = time.monotonic(), None, 0.0

  def __enter__(self):
    if self.live:
      self.live.start()
    return self

  def __exit__(self, *_):
    if self.live:
      self.live.stop()

  def __call__(self, p) -> None:
    from mjx_cl.adapt.phase import PHASES
    now = time.monotonic()
    if self.first is None:
      self.first = (now, p.step)
    rate = (p.step - self.first[1]) / max(1e-9, now - self.first[0])
    left = clock((p.steps - p.step) / rate) if rate > 0 else "?"
    head = p.note or f"step {p.step:,}/{p.steps:,}  {clock(now - self.begin)} gone, {left} left"
    if self.live:
      from rich.table import Table
      table = Table(title=head, title_justify="left")
      for name in ("arm", "seed", "phase", "reward", "alarms", "updates"):
        table.add_column(name, justify="left" if name in ("arm", "phase") else "right")
      for i, arm in enumerate(p.arms):
        table.add_row(arm, str(p.seeds[i]), PHASES[p.phase[i]], f"{p.reward[i]:.2f}", str(p.alarms[i]), str(p.updates[i]))
      self.live.update(table)
    elif now - self.told > 15 or p.step >= p.steps and not p.note:
      self.told = now
      if p.note:
        say(p.note)
        return
      counts = ", ".join(f"{int((p.phase == i).sum())} {name}" for i, name in enumerate(PHASES) if (p.phase == i).any())
      say(f"{head}; {counts}; mean reward {p.reward.mean():.2f}")


# ---- commands --------------------------------------------------------------------------------------------------------------------

def do_run(args: Run) -> None:
  config = RunConfig(
      env=args.env, fault=args.fault, target=None if args.target == "random" else args.target, severity=args.severity, onset=args.onset,
      duration=args.duration, schedule=args.schedule, period=args.period, share=args.share, steps=args.steps, seeds=args.seeds, first_seed=args.first_seed, detector=args.detector, settings=settings(args.set),
      arms=args.arm, agent=args.agent, physics=args.physics, form=args.form, actions=args.actions, deterministic=args.deterministic, adapt=args.adapt,
      snapshots=args.snapshots, keep=args.keep, parts=args.parts, residuals=args.residuals)
  from mjx_cl import run
  with RunDisplay() as display:
    summary = run.execute(config, args.out, args.resume, args.overwrite, display, tell=say)
  if args.keep and not os.path.isdir(os.path.join(args.out, "agents")):
    say("note: --keep wrote no agent, since no stream has finetuned")
  if args.json:
    emit(summary)
  else:
    print(summary_text(summary, args.out))


def summary_text(s: dict, out: str) -> str:
  """A run's numbers for a reader."""
  lines = [f"{s['env']}, {s['fault']} {s['severity']:g} at step {s['onset']:,} of {s['steps']:,}, detector {s['detector']}; {clock(s['wall_s'])} wall ("
           + ", ".join(f"{k} {v:.0%}" for k, v in s["wall_share"].items()) + ")"]
  number = lambda x, form: "-" if x is None else format(x, form)
  width = max(9, *map(len, s["arms"]))
  for arm, a in s["arms"].items():
    lines.append(f"  {arm:{width}s} {a['seeds']} seeds, {a['affected']} affected; false-alarm streams {a['false_alarm_streams']}; alarm within 500 steps "
                 f"{a['affected_alarmed_within_500']}/{a['affected']}, median {number(a['latency_median_steps'], '.0f')} steps; recovered within 10,000 steps "
                 f"{a['recovered_within_10000']}/{a['affected']}, median {number(a['recovery_median_steps'], '.0f')}; converged {a['converged']}, aborted by rule "
                 f"{a['aborted_by_rule']}, by budget {a['aborted_by_budget']}{f', numeric failures {failed}' if (failed := a.get('failed')) else ''}; reward {number(a['reward_pre'], '.2f')} -> drop {number(a['reward_drop'], '.0%')} -> "
                 f"{number(a['reward_final'], '.2f')}; a stream: {number(a['updates_mean'], '.0f')} updates in {number(a['adapted_steps_mean'], '.0f')} steps of "
                 f"adaptation, return lost by it before onset {number(a['return_lost_healthy_mean'], '.0f')}")
  return "\n".join(lines + [f"files in {out}"])


def do_bench(args: Bench) -> None:
  from mjx_cl import bench, memory, workers
  change = {k: v for k, v in (("seeds", args.seeds), ("first_seed", args.first_seed), ("arms", list(args.arm) or None),
                              ("physics", None if args.physics == "auto" else args.physics)) if v is not None}
  suite = bench.suite(args.suite, change)
  k, sign, n = args.shard.partition("/")
  if not (sign and k.isdigit() and n.isdigit()):
    raise UserError(f"--shard takes K/N, such as 0/2; got {args.shard!r}")
  if args.jobs is not None and args.jobs < 1:
    raise UserError(f"--jobs must be above 0; got {args.jobs}")
  for folder in args.merge:
    if not os.path.isdir(folder):
      raise UserError(f"--merge: no folder {folder}")
  parts = bench.pick(suite.parts, args.only, (int(k), int(n)))
  out = pathlib.Path(args.out or f"runs/bench/{suite.name}")
  done = {p.name for p in parts if bench.finished(out, p)}
  robots = bench.Robots()
  estimates = bench.estimates(parts, robots)
  for part in parts:  # whatever can be refused is refused before the first part runs
    if part.name not in done:
      bench.check(part, robots)
  if args.plan:
    if args.json:
      emit([{"part": p.name, "finished": p.name in done, **estimates[p.name]._asdict()} for p in parts])
    else:
      print("\n".join(plan_lines(suite, parts, done, estimates)))
    return
  for folder in args.merge:
    if not any(os.path.isfile(os.path.join(folder, p.name, "config.json")) for p in parts):
      raise UserError(f"--merge: {folder} holds none of the parts {', '.join(p.name for p in parts[:3])}{' ...' * (len(parts) > 3)}; it takes the OUT of a bench of this suite")
  try:
    out.mkdir(parents=True, exist_ok=True)
  except OSError as e:
    raise FileError(f"cannot make {out}: {e.strerror}") from None
  for name in bench.take(out, parts, args.merge):
    say(f"{name}: taken over")
    done.add(name)
  needs, space = [estimates[p.name].bytes for p in parts if p.name not in done], int(memory.MARGIN * memory.free())
  if max(needs, default=0) > space:
    raise UserError(f"a part needs {max(needs) / 2**30:.1f} GiB, {space / 2**30:.1f} GiB may be used; fewer --seeds would fit")
  jobs = workers.number(args.jobs, needs, space)
  for line in plan_lines(suite, parts, done, estimates):
    say(line)
  value = bench.execute(suite, out, parts, estimates, say, RunDisplay, jobs=jobs)
  if args.publish:
    bench.publish(out, suite.parts, args.publish)
  if args.json:
    emit(value)
    return
  for name, summary in value["entries"].items():
    print(f"{name}: {summary_text(summary, str(out / name))}")
  print(f"{value['finished']} of {value['parts']} parts finished; files in {out}")


def plan_lines(suite, parts, done, estimates) -> list[str]:
  """The plan of a suite for a reader."""
  lines = [f"{suite.name}: {suite.about}"]
  width = max([4, *(len(p.name) for p in parts)])
  lines.append(f"  {'part':{width}s}  streams  stream-steps   updates  minutes    GiB")
  for p in parts:
    e = estimates[p.name]
    minutes = "finished" if p.name in done else f"{e.seconds / 60:.0f}"
    lines.append(f"  {p.name:{width}s}  {e.streams:7,d}  {e.stream_steps:12,d}  {e.updates:8,.0f}  {minutes:>7s}  {e.bytes / 2**30:5.1f}")
  todo = [p for p in parts if p.name not in done]
  left = sum(estimates[p.name].seconds for p in todo)
  lines.append(f"  {len(done)} of {len(parts)} parts finished; about {clock(left)} left, by a one-second measurement of this machine's matrix product")
  from mjx_cl import bench
  return lines + [f"  note, {which}: {text}" for text, which in bench.notes(todo)]


def do_train(args: Train) -> None:
  preset = choose("preset", args.preset, PRESETS)
  names = {f.name for f in dataclasses.fields(TrainConfig)}
  changes = settings(args.set)
  from mjx_cl import bench
  kept = {k: v for k, v in changes.items() if k in names}
  bench.check_kinds("--set", TrainConfig, kept)
  train_config = replace(preset.train, **kept)
  rest = {k: v for k, v in changes.items() if k not in names}
  known = {f.name for f in dataclasses.fields(preset.dreamer)}
  for name in rest:
    if name not in known:
      raise UserError(f"unknown setting {name!r}; choose from: {', '.join(sorted(names | known))}")
  bench.check_kinds("--set", type(preset.dreamer), rest)
  dreamer = replace(preset.dreamer, **rest)
  if args.seeds < 1:
    raise UserError(f"seeds must be above 0; got {args.seeds}")
  from mjx_cl import envs, run, store, train
  env = envs.make(args.env, args.physics)
  if args.demonstrator not in (None, "ppo"):  # whatever can be refused is refused before an earlier training is touched
    train.expert(env, args.demonstrator)
  train.faults_of(env, train_config)
  train.shown(train_config, args.out, args.demonstrator)
  train.check(env, dreamer, train_config, args.agent)
  state = store.claim_folder(args.out, args.resume, args.overwrite, done_marker="agent/card.json")
  if state != "new":
    updates = train.check_same(args.out, env, dreamer, train_config, args.seed, args.seeds, args.demonstrator, args.agent)
  if state == "done":
    if updates != train_config.updates:
      raise UserError(f"{args.out}: this training has finished its {updates:,} updates; go on with --agent {pathlib.Path(args.out, 'agent')} and another --out")
    say(f"{args.out}: this training is finished")
    return
  if state == "new" and args.overwrite:
    out = pathlib.Path(args.out)
    for name, given in (("agent", args.agent), ("demonstrator", args.demonstrator)):
      if given and any(pathlib.Path(given).resolve().is_relative_to((out / own).resolve()) for own in ("agent", "agents", "demonstrator", "checkpoints", "work")):
        raise UserError(f"--overwrite removes --{name} {given} with {out}; give another --out")
    run.clear(out)
    train.clear(out)
  command = "mjx-cl " + " ".join(sys.argv[1:]) if len(sys.argv) > 1 else "mjx-cl train"
  trainer = train.build(env, dreamer, train_config, args.out, args.seed, args.seeds, args.demonstrator, args.agent, args.preset, command, state == "resume")
  display = TrainDisplay(train_config.updates)
  with display:
    train.run(trainer, display, args.save_every_s)
  card = train.export(trainer)
  if args.json:
    emit(card)
  else:
    say(f"agent in {args.out}/agent, return {card['eval']['return_mean']:.0f} over {card['eval']['episodes']} episodes")


class TrainDisplay:
  """Progress bar with return, updates per second and time left; a plain line now and then without a terminal."""

  def __init__(self, total: int):
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
    self.console = Console(stderr=True)
    self.total, self.recent, self.marks, self.told = total, [], [], 0.0
    self.bar = Progress(TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:,.0f}/{task.total:,.0f} updates"), TimeRemainingColumn(),
                        console=self.console) if self.console.is_terminal else None
    self.task = self.bar.add_task("", total=total) if self.bar else None

  def __enter__(self):
    if self.bar:
      self.bar.start()
    return self

  def __exit__(self, *_):
    if self.bar:
      self.bar.stop()

  def __call__(self, row: dict) -> None:
    now = time.monotonic()
    if row["return"] is not None:
      self.recent = (self.recent + [row["return"]])[-5:]
    self.marks = (self.marks + [(now, row["updates"])])[-200:]
    rate = (self.marks[-1][1] - self.marks[0][1]) / max(1e-9, self.marks[-1][0] - self.marks[0][0])
    mean = f"{sum(self.recent) / len(self.recent):.0f}" if self.recent else "-"
    step = "" if row["reward"] is None else f" ({row['reward']:.2f} a step)"
    text = f"{row['phase']}: return {mean}{step}, {rate:.1f} updates/s"
    if self.bar:
      self.bar.update(self.task, completed=row["updates"], description=text)
    elif now - self.told > 30 or row["updates"] >= self.total:
      self.told = now
      left = clock((self.total - row["updates"]) / rate) if rate else "?"
      say(f"{row['updates']:,}/{self.total:,} updates, {row['records']:,} records, {text}, {left} left")


def do_eval(args: Eval) -> None:
  if args.episodes < 1:
    raise UserError(f"episodes must be above 0; got {args.episodes}")
  from mjx_cl import agents, envs, evaluate
  env = envs.make(args.env, args.physics)
  trained = agents.of(env, args.agent)
  result = evaluate.evaluate(env, trained.agent, trained.train.params, args.episodes, args.seed, int(trained.card.get("repeat", 1)), args.deterministic)
  if not math.isfinite(result["return_mean"]):
    raise FileError(f"agent {trained.path}: its return on {args.env} is {result['return_mean']}; its weights or the robot give what is no number")
  result = {"env": args.env, "agent": os.path.basename(os.path.normpath(trained.path)), **result}
  if args.json:
    emit(result)
  else:
    print(f"{args.env}: return {result['return_mean']:.1f} (IQM {result['return_iqm']:.1f}, 95 % interval {result['return_ci'][0]:.1f} to "
          f"{result['return_ci'][1]:.1f}) over {args.episodes} episodes, {result['terminations']} terminations" if result["return_ci"] else
          f"{args.env}: return {result['return_mean']:.1f} in one episode")
    base = ("env", "agent", "episodes", "return_mean", "return_iqm", "terminations")
    figures = {k: v for k, v in result.items() if isinstance(v, (int, float)) and k not in base}
    if figures:
      print("  " + ", ".join(f"{k} {v:.3g}" for k, v in figures.items()))


def do_certify(args: Certify) -> None:
  if args.episodes < 0:
    raise UserError(f"episodes must be at least 0; got {args.episodes}")
  from mjx_cl import certify, envs
  names = args.env or tuple(envs.ENVS)
  certify.check(names)
  certify.guard(args.out, names, args.episodes)
  rows, faulty = [], []
  for name in names:
    mine = certify.certify(name, args.physics, args.episodes, args.agent, args.fault, say)
    certify.write(args.out, mine)  # what is measured is kept, whatever happens to the next robot
    rows += mine
    faulty += certify.certificate.faulty([certify.certificate.Certificate(*(r[k] for k in certify.certificate.Certificate._fields)) for r in mine])
  if args.json:
    emit(certify.summary(rows))
  else:
    for line in certify.summary(rows):
      print(f"{line['name']}: {line['value']}")
    print(f"files in {args.out}")
  for line in faulty:
    say(f"mjx-cl: {line}")


def do_record(args: Record) -> None:
  from mjx_cl import recording, streams
  suite, out = streams.suite(args.suite), args.out
  if args.overwrite:
    recording.prepare(suite, args.robot, args.physics, args.agent)  # what is refused must not cost the set that is there
  recording.claim(suite, out, args.overwrite, args.robot)
  told = [0.0]

  def progress(part, done, steps, lanes):
    now = time.monotonic()
    if now - told[0] > 10 or done >= steps:
      told[0] = now
      say(f"{part}: {done:,}/{steps:,} steps of {lanes} robots")
  result = recording.record(suite, out, args.robot, args.physics, args.agent, "mjx-cl " + " ".join(sys.argv[1:]), progress)
  recording.clear(out)
  if args.json:
    emit(result)
  else:
    for robot, steps in result["stream_steps"].items():
      speed = result["stream_steps_per_s"].get(robot)
      print(f"{robot}: {steps:,} stream-steps" + (f", {speed:,.0f} a second" if speed else ", recorded before"))
    print(f"{result['bytes'] / 1e6:.1f} MB in {out}")


def do_leaderboard(args: Leaderboard) -> None:
  from mjx_cl import leaderboard, store, streams, submissions
  for flag, given, other in (("--set", args.set, args.add), ("--threshold", args.threshold, args.add), ("--log", args.log, args.add), ("--name", args.name, args.add or args.submit)):
    if given and not other:
      raise UserError(f"{flag} belongs to a detector of one's own; give --add" + (" or --submit" if flag == "--name" else ""))
  if args.name and args.add and args.submit:
    raise UserError("--name names one detector; give --add and --submit in two commands, or leave it out")
  held = streams.StreamSet(args.streams)
  robots = held.choose(args.robot)
  if args.export:
    files = submissions.export(held, args.export, robots, args.overwrite)
    emit(files) if args.json else print("\n".join(files))
    return
  if os.path.exists(args.out) and not os.path.isdir(args.out):
    raise UserError(f"--out {args.out} is a file")
  if os.path.exists(os.path.join(args.out, "leaderboard.json")) and not args.overwrite:
    raise UserError(f"{args.out} holds a leaderboard; give --overwrite to replace it, or another --out")
  known, extra = leaderboard.variants(), []
  for name in args.detector:
    if name != "none":
      choose("detector", name, known)
  entries = [leaderboard.entry(n, s) for n, s in known.items() if not args.detector or n in args.detector]
  if args.add:
    from mjx_cl.detectors import host
    build = lambda value: host.load(args.add, settings(args.set) | ({args.threshold: value} if args.threshold else {}), args.name, args.channel, args.log)
    one = build(1.0)
    extra.append((one.host_name, submissions.from_host(build if args.threshold else one, args.threshold)))
  if args.submit:
    scores = submissions.read_submission(args.submit, held, robots)
    extra.append((args.name or os.path.basename(args.submit).removesuffix(".parquet"), submissions.from_scores(scores)))
  taken = {*known, *leaderboard.ORACLES}
  for name, _ in extra:
    if name in taken:
      raise UserError(f"the board has a detector {name!r} already; give --name")
    taken.add(name)
  told = [0.0]

  def progress(robot, name, done, total, seconds):
    if time.monotonic() - told[0] > 2 or done == total:
      told[0] = time.monotonic()
      say(f"{done}/{total}  {robot}: {name}, {clock(seconds)} gone, {clock(seconds / done * (total - done))} left")
  board = leaderboard.score(held, entries, robots, extra, progress)
  meta = {"command": "mjx-cl " + " ".join(sys.argv[1:]), "seeds": {k: list(v) for k, v in held.suite.seeds.items()}, "arl0_target": held.suite.arl0,
          "streams": held.config.get("command"), **({"kept": {r: v.get("command") for r, v in held.config["kept"].items()}} if "kept" in held.config else {}),
          "wall_s": round(board.seconds, 1), "stream_steps": board.stream_steps, **store.provenance()}
  files = leaderboard.write(board, args.out, meta)
  if args.json:
    emit([{k: v for k, v in r.items() if not k.startswith("stream_")} for r in board.rows])
    return
  from rich.table import Table
  table = Table(title=f"{len(board.rows):,} rows, ARL0 {held.suite.arl0:,.0f} steps, means over robots, faults and severities", title_justify="left")
  for k, heading in enumerate(("detector", "score", "95 %", "within 1 s", "within 5 s", "missed", "false alarms/h", "mean rank")):
    table.add_column(heading, justify="right" if k else "left", no_wrap=not k)
  number = lambda x, form: "-" if x is None or not math.isfinite(x) else format(x, form)
  for r in board.overall.rows:
    ci = r["cost_standard_ci"]
    table.add_row(r["detector"], number(r["cost_standard"], ".1f"), f"{number(ci[0], '.1f')} to {number(ci[1], '.1f')}" if ci else "-",
                  number(r["detected_within_1s"], ".0%"), number(r["detected_within_5s"], ".0%"), number(r["miss_probability"], ".0%"),
                  number(r["false_alarms_per_hour"], ".1f"), number(r["mean_rank"], ".1f"))
  show(table)
  print(f"{board.stream_steps:,} stream-steps scored in {clock(board.seconds)}; files: {', '.join(files)}")


def do_plot(args: Plot) -> None:
  from mjx_cl import plots
  if not os.path.exists(os.path.join(args.folder, "trace.parquet")):
    raise UserError(f"{args.folder} holds no finished run (no trace.parquet)")
  print(plots.figure(args.folder))


def do_render(args: Render) -> None:
  from mjx_cl import adapters, agents, envs, render
  out = args.out or f"{args.env.rpartition(':')[2]}.gif"
  render.check(out, args.steps, args.width, args.height, args.fps, args.seed)
  env = envs.make(args.env, args.physics)
  acting = {"seed": args.seed, "deterministic": args.deterministic, "severity": args.severity, "onset": args.onset, "duration": args.duration,
            "schedule": args.schedule, "period": args.period, "share": args.share}
  if args.agent in ("none", "random"):
    acting["agent"] = adapters.Puppet(len(env.spec.act), float(args.agent == "random"))
  elif args.agent is None and not agents.is_shipped(env):
    raise UserError(f"no agent is shipped for {args.env}; give a folder, or --agent none (stands still), --agent random")
  else:
    trained = agents.of(env, args.agent)
    acting |= {"agent": trained.agent, "params": trained.train.params, "repeat": int(trained.card.get("repeat", 1))}
  result = render.render(env, out, args.steps, args.width, args.height, args.fps, args.fault, args.target, view=args.view,
                         say=lambda text: say(f"mjx-cl: {text}"), **acting)
  if args.json:
    emit({"env": args.env, "agent": args.agent or args.env, "fault": args.fault, **result})
  else:
    print(f"{result['file']}: {result['frames']} pictures, {result['fps']:g} a second, drawn by {result['drawn_by']}")


def do_detect(args: Detect) -> None:
  from mjx_cl import detect
  out = None if args.out is None else detect.claim(args.out, args.overwrite)
  tell = say if sys.stderr.isatty() else lambda text: None
  result = detect.detect(args.file, args.nominal, args.column, args.detector, args.arl0, args.rate, args.logarithm, settings(args.set), tell)
  if out:
    detect.write(result, out)
  for note in result.summary["notes"]:
    say(f"mjx-cl: {note}")
  if args.json:
    emit(result.summary)
    return
  from rich.console import Console
  console, rows = Console(), result.summary["detectors"]
  table = detect_table(rows, True)
  if wide := console.measure(table, options=console.options.update(width=100_000)).maximum > console.width:
    table = detect_table(rows, False)
  console.print(table)
  groups: dict[str, list[str]] = {}
  for row in rows if wide else ():
    groups.setdefault(", ".join(row["columns"]) or "no column", []).append(row["detector"])
  for columns, names in groups.items():
    print(f"{', '.join(names)}: alarms in {columns}")
  if any(row["calibrated"] is False for row in result.summary["detectors"]):
    print("* not calibrated")


def detect_table(rows: list[dict], columns: bool):
  """Rows of a detection's summary as a table in which cells wrap and nothing is cut, with or without the columns that alarms are in."""
  from rich.table import Table
  from rich.text import Text
  table = Table()
  for name in ("detector", "threshold", "nominal\nalarms", "first\nalarm", "at [s]", "alarms") + ("columns",) * columns:
    table.add_column(Text(name), justify="left" if name in ("detector", "columns") else "right", overflow="fold")
  for row in rows:
    mark = "" if row["calibrated"] else " own" if row["calibrated"] is None else " *"
    shown = ("-" if row["threshold"] is None else f"{row['threshold']:.4g}") + mark, f"{row['nominal_alarms']:,}", *(
        "-" if x is None else f"{x:,}" if isinstance(x, int) else f"{x:,.3f}" for x in (row["first_alarm"], row["first_alarm_s"], row["alarms"]))
    table.add_row(Text(row["detector"]), *shown, *[Text(", ".join(row["columns"]))] * columns)
  return table


def json_value(x):
  """A database's value as JSON has it: decimals are numbers, what is not finite is null, keys of a map and whatever else there is are text."""
  import decimal
  if isinstance(x, dict):
    return {str(k): json_value(v) for k, v in x.items()}
  if isinstance(x, (list, tuple)):
    return [json_value(v) for v in x]
  if isinstance(x, decimal.Decimal):
    x = float(x)
  if isinstance(x, float):
    return x if math.isfinite(x) else None
  return x if x is None or isinstance(x, (bool, int, str)) else str(x)


def do_query(args: Query) -> None:
  from mjx_cl import store
  *folder, sql = args.words or (None,)
  if sql is not None and not folder and os.path.isdir(sql):
    folder, sql = [sql], None
  if len(folder) > 1:
    raise UserError(f"query takes [FOLDER] [SQL], the SQL in quotes; got {len(args.words)} words")
  if folder and args.within:
    raise UserError("query takes a folder or --in, not both")
  names, rows = store.query(folder[0] if folder else store.views(args.within), sql)
  if args.json:
    for k, name in enumerate(names):  # two columns of one name would be one in JSON
      names[k] = name if name not in names[:k] else f"{name}_{k}"
    emit([{n: json_value(x) for n, x in zip(names, r)} for r in rows])
    return
  from rich.table import Table
  from rich.text import Text
  table = Table(*names)
  for r in rows:
    table.add_row(*(Text(str(x)) for x in r))
  show(table)


def do_report(args: Report) -> None:
  from mjx_cl import report
  pages = args.page or [str(p) for p in report.pages()] or ["README.md"]
  found = {page: report.report(args.results, page, check=True) for page in pages}  # whatever is wrong is said before anything is written
  if args.figures and args.check:
    raise UserError("--check writes nothing, --figures draws: give one of the two")
  if not args.check:
    for page in pages:
      report.report(args.results, page)
  if args.figures:
    from mjx_cl import bench
    for file in bench.redraw(args.results):
      print(f"{file}: drawn anew", file=sys.stderr)
  stale = {page: list(dict.fromkeys(b["name"] for b in blocks if not b["agrees"])) for page, blocks in found.items()}
  stale = {page: names for page, names in stale.items() if names}
  if args.json:
    emit([{"page": page, **block} for page, blocks in found.items() for block in blocks])
  else:
    for page, blocks in found.items():
      if not blocks:
        print(f"{page}: no marked block")
      elif not (args.check and page in stale):
        print(f"{page}: " + (f"written anew: {', '.join(stale[page])}" if page in stale else f"all {len(blocks)} blocks agree with {args.results}"))
  if stale and args.check:
    raise FileError("; ".join(f"{page} disagrees with {args.results} in: {', '.join(names)}" for page, names in stale.items()) + "; mjx-cl report writes them anew")


def do_list(args: List) -> None:
  from mjx_cl import agents, bench, detectors, envs, fault_presets, faults, memory, streams
  first = lambda f: (f.__doc__ or "").strip().split("\n")[0]
  tables = {"envs": lambda: {k: first(v) for k, v in envs.ENVS.items()}, "faults": lambda: {k: faults.about(k) for k in faults.FAULTS},
            "detectors": lambda: {k: first(v) for k, v in detectors.DETECTORS.items()}, "presets": lambda: {k: p.about for k, p in PRESETS.items()},
            "agents": lambda: {k: "shipped" for k in agents.shipped()}, "arms": lambda: {k: a.about for k, a in ARMS.items()},
            "fault-presets": lambda: {k: f"{p.about} ({p.source})" for k, p in fault_presets.PRESETS.items()}, "schedules": lambda: fault_presets.SCHEDULES,
            "sizes": memory.table, "suites": streams.about, "benches": bench.shipped}
  chosen = {k: make() for k, make in (tables if args.what == "all" else {args.what: choose("list", args.what, tables)}).items()}
  if args.json:
    emit(chosen)
    return
  for kind, table in chosen.items():
    print(kind)
    for name, about in table.items():
      print(f"  {name:22s} {about}")


def do_doctor(args: Doctor) -> None:
  from mjx_cl import doctor
  rows = doctor.report()
  if args.json:
    emit(rows)
  else:
    for name, value in rows.items():
      print(f"{name:16s} {value if not isinstance(value, dict) else ', '.join(f'{k} {v}' for k, v in value.items())}")


DO = {Run: do_run, Bench: do_bench, Train: do_train, Eval: do_eval, Certify: do_certify, Record: do_record, Leaderboard: do_leaderboard, Plot: do_plot, Render: do_render, Query: do_query, Report: do_report, Detect: do_detect, List: do_list, Doctor: do_doctor}


def parse(argv: list[str] | None):
  """Arguments -> command. tyro's framed report of a mistake becomes one line. `--version` alone prints it and ends."""
  if (sys.argv[1:] if argv is None else argv) == ["--version"]:
    print(f"mjx-cl {__version__}")
    raise SystemExit(0)
  report = io.StringIO()
  try:
    with contextlib.redirect_stderr(report):
      return tyro.cli(Command, prog="mjx-cl", args=argv, description="Robots that notice a fault, adapt to it and know when they are done.",
                      config=(tyro.conf.FlagCreatePairsOff,))
  except SystemExit as e:
    if e.code in (0, None):
      raise
    text = re.sub(r"\x1b\[[0-9;]*m", "", report.getvalue())
    lines = [re.sub(r"^[│|]|[│|]$", "", line).strip() for line in text.splitlines()]
    words = [line for line in lines if line and not re.match(r"^[╭╰─]", line) and not line.startswith("For full helptext")]
    raise UserError(re.sub(r"\s+", " ", " ".join(words)) or "wrong arguments; see mjx-cl --help") from None


def attempt(do, again=lambda: "") -> int:
  """Exit status of `do()`; what goes wrong becomes one line on standard error, an interrupt one that ends in `again()`."""
  def stop(*_):
    raise KeyboardInterrupt
  signal.signal(signal.SIGTERM, stop)
  try:
    do()
    return 0
  except UserError as e:
    say(f"mjx-cl: {' '.join(str(e).split())}")
    return e.exit_code
  except KeyboardInterrupt:
    say(f"mjx-cl: interrupted{again()}")
    return 130
  except BrokenPipeError:
    return 0
  except OSError as e:
    say(f"mjx-cl: {e.strerror or e}{f': {e.filename}' if e.filename else ''}")
    return FileError.exit_code
  except (MemoryError, RuntimeError) as e:  # XLA's error is a RuntimeError
    if isinstance(e, RuntimeError) and "RESOURCE_EXHAUSTED" not in str(e):
      raise
    say(f"mjx-cl: out of memory: {' '.join(str(e).split())[:200]}; fewer --seeds, arms or a smaller batch need less")
    return FileError.exit_code


def main(argv: list[str] | None = None) -> int:
  """Entry point of `mjx-cl`."""
  command = None

  def do():
    nonlocal command
    command = parse(argv)
    if not isinstance(command, (Plot, Query, Report)):
      from mjx_cl import runtime
      runtime.setup(runtime.sharing(command.seeds) if isinstance(command, Train) and command.seeds > 0 else 1)
    with apart(command):
      DO[type(command)](command)

  def again():
    kind = type(command) if command else None
    return "; what was saved can be resumed with --resume" if kind in (Run, Train) else \
           "; the same command goes on where it stopped" if kind in (Record, Bench) else ""
  return attempt(do, again)


if __name__ == "__main__":
  sys.exit(main())
