"""What each command of the command line takes: one dataclass a command, whose docstrings are its
help. Free of JAX.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro
from tyro.conf import Positional

from mjx_cl.config import FaultConfig, RunConfig


@dataclass(frozen=True)
class Run(RunConfig):
  """Lives the whole loop: fault, alarm, finetuning, stop; arms x seeds streams side by side.

  Writes config.json, trace.parquet, events.parquet, runs.parquet, summary.json and figure.png into
  --out.

  Example: mjx-cl run walker --fault gear --severity 0.5 --seeds 2 --out runs/gear
  """

  out: str = "runs/latest"
  """Result folder."""
  json: bool = False
  """One JSON value on standard output, nothing else there."""
  resume: bool = False
  """Go on with a run that was cut off."""
  overwrite: bool = False
  """Replace an earlier run in --out."""


@dataclass(frozen=True)
class Train:
  """Pretrains an agent; ends with OUT/agent (weights, card), which every --agent takes.

  Example: mjx-cl train walker --preset tiny --out runs/train
  """

  env: Positional[str]
  """Robot, see `mjx-cl list envs`."""
  out: str = "runs/train"
  """Folder for checkpoints, metrics.parquet and the agent."""
  preset: str = "cpu"
  """Learner and schedule, see `mjx-cl list presets`."""
  demonstrator: str | None = None
  """A policy's .npz, `reference`: the robot's own driver (car), or `ppo`: train one with brax;
  default: none.
  """
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
  """Go on with a training that was cut off, with the settings it began with; `updates` may be
  others.
  """
  overwrite: bool = False
  """Replace an earlier training in --out, its agent and its demonstrator too."""


@dataclass(frozen=True)
class Eval:
  """Return of an agent on the healthy robot.

  Example: mjx-cl eval walker --episodes 20
  """

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
  """Proves for every fault that it acts, and measures what it costs; writes certificates.parquet
  and certificates.md into --out.

  Example: mjx-cl certify walker --fault gear --episodes 0 --out runs/certificates
  """

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
  """Records residual streams of a suite: frozen agents, healthy and faulty robots side by side, to
  Parquet that pandas alone reads.

  A recording that was cut off goes on where it stopped: parts that are finished are kept in
  OUT/work until all are there.

  Example: mjx-cl record leaderboard --robot walker --out runs/streams
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
  """Replace a set that is in --out; with --robot, in a set of the same suite, those robots' streams
  alone.
  """


@dataclass(frozen=True)
class Leaderboard:
  """Scores every registered detector on recorded streams; writes leaderboard.parquet and
  leaderboard.html into --out.

  Ways in for a detector of one's own: a plug-in (entry point mjx_cl.detectors), --add with a Python
  class, --submit with a file of scores.

  Example: mjx-cl leaderboard --robot walker --detector cusum ewma --out runs/leaderboard
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
  """Only these detectors, by their names on the board, or name@channel, path/to/file.py:factory,
  module:factory; `none`: only the oracles and one's own. Default: all.
  """
  add: str | None = None
  """module:Class or file.py:Class, a Python class with update(x) -> bool; a river detector works
  unchanged.
  """
  set: tuple[str, ...] = ()
  """Settings of --add, name=value ..."""
  channel: str = "opr"
  """What --add watches: opr, rpr, reward, surprise or group_0 .. group_7."""
  log: bool = False
  """Give --add the logarithm, as the built-in detectors of one number have it."""
  threshold: str | None = None
  """Setting of --add that is calibrated, larger = fewer alarms; default: it runs as it is, and its
  own rate of false alarms is printed.
  """
  submit: str | None = None
  """Parquet with the columns stream, step, score, for all streams that --export writes."""
  name: str | None = None
  """Name of --add or --submit on the board."""
  export: str | None = None
  """Only write the streams in full into this folder, one Parquet file per robot, for tools of one's
  own.
  """
  json: bool = False


@dataclass(frozen=True)
class Bench:
  """Runs a suite: runs over robots, faults and settings, each in a folder of its own; prints its
  plan first.

  The same command goes on where it was cut off; finished parts are never run again. Writes
  OUT/PART/ as `mjx-cl run` does, OUT/bench.parquet, OUT/bench.json.

  Example: mjx-cl bench quick --plan
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
  """Parts side by side, each on its share of the cores; default: one per core as far as memory
  allows.
  """
  merge: tuple[str, ...] = ()
  """Folders of the same suite from other machines; their finished parts are copied here and not
  run, seeds of a part that several hold are joined.
  """
  publish: str | None = None
  """Copy finished parts' tables and figures, without the traces, to this folder."""
  json: bool = False
  resume: bool = False
  """Said for completeness: a suite always goes on."""


@dataclass(frozen=True)
class Plot:
  """Draws figure.png of a run anew.

  Example: mjx-cl plot runs/latest
  """

  folder: Positional[str]


@dataclass(frozen=True)
class Render(FaultConfig):
  """A moving picture of an agent at work: GIF, or MP4 with mjx-cl[video]; red border while a fault
  acts.

  Example: mjx-cl render walker --fault gear --target right_hip --out gear.gif
  """

  fault: str = "none"
  onset: int = 200
  out: str | None = None
  """File that ends in .gif or .mp4; default: ENV.gif."""
  agent: str | None = None
  """Trained agent: shipped name or folder; `none` stands still, `random` moves at random."""
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

  Read are CSV files, also .csv.gz, with a header row (a row of units may follow) and cells between
  commas, semicolons (then with a decimal comma too) or tabulators; an empty cell or nan is a
  missing sample, `time` [s] or `step` tell when samples were taken. Not watched are clocks and
  counters, columns that are constant in the nominal log, that hold text or that one log lacks; all
  of it is printed, --column watches even a clock.

  The nominal log counts as the past of the other: detectors warm up on its first third (1,000
  samples at most) and are calibrated on the rest. Every column has a detector of its own, the alarm
  of any counts. Writes detect.json, alarms.csv and detect.png into --out.

  Example: mjx-cl detect today.csv --nominal healthy.csv --out runs/detect
  """

  file: Positional[str]
  """Log to judge, .csv or .csv.gz."""
  nominal: str
  """Log of the healthy system, same columns; three times --arl0 samples or more."""
  column: tuple[str, ...] = ()
  """Columns to watch; default: all columns of numbers that both files have, less clocks and
  constant ones.
  """
  detector: tuple[str, ...] = ()
  """Detectors of one number per sample, one for each column, or of several channels, one for all
  columns together; default: all; or module:Class, file.py:Class, a Python class with update(x) and
  a threshold of its own.
  """
  set: tuple[str, ...] = ()
  """Settings of such a class, name=value ..."""
  arl0: float = 10_000
  """Wanted mean number of samples between false alarms of one detector, all columns together."""
  rate: float | None = None
  """Samples (or steps of the column `step`) per second; default: from the column `time`, or one of
  seconds (`time_s`).
  """
  logarithm: bool = False
  """Watch the logarithm; for residuals, which are positive and skewed. A sample of 0 or less is
  refused.
  """
  out: str | None = None
  """Folder for the results; default: only the table."""
  json: bool = False
  overwrite: bool = False
  """Replace an earlier detection in --out."""


@dataclass(frozen=True)
class Query:
  """SQL over all results, read-only; without SQL: the views, their rows and columns.

  `query SQL`: every table under results/ is a view named after its path
  (results/walker_gear/runs.parquet is walker_gear_runs). `query FOLDER SQL`: the tables of one
  folder, under their own names (trace, events, runs).

  Example: mjx-cl query runs/latest "select arm, seed, outcome from runs"
  """

  words: Positional[tuple[str, ...]] = ()
  """[FOLDER] [SQL]"""
  within: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="in")] = ()
  """One more folder, DIR or NAME=DIR: its tables are views that begin with its name. Repeatable."""
  json: bool = False


@dataclass(frozen=True)
class Report:
  """Writes the numbers of README and docs anew from the files in results/: what lies between `<!--
  report:NAME -->` and `<!-- /report -->`, nothing else.

  Example: mjx-cl report --check
  """

  results: str = "results"
  """Folder of the results."""
  page: tuple[str, ...] = ()
  """Texts with marked blocks; default: README.md and docs/*.md."""
  check: bool = False
  """Write nothing; exit code 1 and the names of the blocks where text and results disagree."""
  figures: bool = False
  """Draw recovery.png and ratio.png of every published suite anew as well. A run's figure.png needs
  its trace (`mjx-cl plot`), leaderboard.html the streams (`mjx-cl leaderboard`).
  """
  json: bool = False


@dataclass(frozen=True)
class List:
  """Names that other commands take.

  Example: mjx-cl list faults
  """

  what: Positional[str] = "all"
  """envs, faults, fault-presets, schedules, detectors, presets, agents, arms, sizes, suites,
  benches or all.
  """
  json: bool = False


@dataclass(frozen=True)
class Doctor:
  """Versions, devices, physics backend, free memory and a two-second speed check.

  Example: mjx-cl doctor --json
  """

  json: bool = False
