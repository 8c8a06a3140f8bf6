"""What each command of the command line takes: one dataclass a command, whose docstrings are its
help. Free of JAX.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro
from tyro.conf import Positional

from mjx_cl.cli.machines import GpuMachines, Machines
from mjx_cl.config import FaultConfig, RunConfig


@dataclass(frozen=True)
class Run(RunConfig):
  """Lives the whole loop: fault, alarm, finetuning, stop; arms x seeds streams side by side.

  Writes config.json, trace.parquet, events.parquet, runs.parquet, summary.json and figure.png into
  --out.

  Example: mjx-cl run walker --fault gear --severity 0.5 --seeds 2 --out runs/gear

  Attributes:
    fault: Faults, see `mjx-cl list faults`, several at once by `gear+noise`, or presets, see
      `mjx-cl list fault-presets`; `none` for the healthy robot. Of several faults, severities or
      agents each combination is a run of its own, in OUT/fault=NAME,severity=X,agent=NAME;
      OUT/bench.json says what they say together.
    severity: In [0, 1]; 0 is nominal. Default: 0.5, or the preset's own.
    agent: Trained agents: shipped names or folders; default: the robot's own (walker, car,
      quadruped-trot-2); `all`: it and its like of other training seeds.
    out: Result folder.
    quick: A whole loop in about two minutes, for a first look: other defaults of fault, seeds,
      onset, steps and stop rule, for walker, quadruped and car.
    track: Curves for other tools as well: tensorboard (OUT/tensorboard), csv (OUT/curves.csv).
    json: One JSON value on standard output, nothing else there.
    resume: Go on with a run that was cut off.
    overwrite: Replace an earlier run in --out.
  """

  # of a RunConfig: one each
  fault: tuple[str, ...] = (RunConfig.fault,)  # type: ignore[assignment]
  severity: tuple[float | None, ...] = ()  # type: ignore[assignment]
  agent: tuple[str, ...] = ()  # type: ignore[assignment]
  out: str = "runs/latest"
  quick: bool = False
  track: tuple[str, ...] = ()
  json: bool = False
  resume: bool = False
  overwrite: bool = False


@dataclass(frozen=True)
class Train(GpuMachines):
  """Pretrains an agent; ends with OUT/agent (weights, card), which every --agent takes.

  Example: mjx-cl train walker --preset tiny --out runs/train

  Attributes:
    env: Robot, see `mjx-cl list envs`.
    out: Folder for checkpoints, metrics.parquet and the agent.
    preset: Learner and schedule, see `mjx-cl list presets`.
    demonstrator: A policy's .npz, `reference`: the robot's own driver (car, quadruped), or
      `ppo`: train one with brax; default: none.
    agent: Start from this agent's weights, moments and counters; the replay is filled by
      acting.
    set: Settings of learner or schedule, name=value ... (updates=20000 lr=1e-4).
    seeds: Agents trained side by side in one program, each in OUT/seed-N too. On ray: a training
      of its own each.
    save_every_s: Seconds between checkpoints.
    track: Curves for other tools as well: tensorboard (OUT/tensorboard), csv (OUT/curves.csv).
    resume: Go on with a training that was cut off, with the settings it began with; `updates`
      may be others.
    overwrite: Replace an earlier training in --out, its agent and its demonstrator too.
  """

  env: Positional[str]
  out: str = "runs/train"
  preset: str = "cpu"
  demonstrator: str | None = None
  agent: str | None = None
  set: tuple[str, ...] = ()
  seed: int = 0
  seeds: int = 1
  physics: str = "auto"
  save_every_s: float = 240.0
  track: tuple[str, ...] = ()
  json: bool = False
  resume: bool = False
  overwrite: bool = False


@dataclass(frozen=True)
class Eval:
  """Return of an agent that learns nothing, on the healthy robot or under a fault from the first
  step on.

  Example: mjx-cl eval walker --episodes 20

  Attributes:
    fault: Fault or preset, see `mjx-cl list faults` and `fault-presets`.
    target: Joint or part that it hits; default: drawn from the seed.
    severity: In [0, 1]; default: 0.5, or the preset's own.
    seed: Episodes use seeds seed, seed + 1, ...
  """

  env: Positional[str]
  episodes: int = 20
  fault: str = "none"
  target: str | None = None
  severity: float | None = None
  agent: str | None = None
  seed: int = 0
  physics: str = "auto"
  deterministic: bool = False
  json: bool = False


@dataclass(frozen=True)
class Calibrate:
  """The threshold at which a detector gives a wanted rate of false alarms on healthy robots; for a
  robot or agent of your own, as `run` knows those of the shipped ones.

  Example: mjx-cl calibrate robot.py:Robot --agent runs/mine/agent --detector cusum

  Attributes:
    agent: Trained agent: shipped name or folder; default: the robot's own.
    detector: Name, or FILE.py:FACTORY.
    set: Settings of the detector, name=value ...
    arl0: Wanted mean number of control steps between two false alarms.
    seeds: Healthy robots, of seeds first_seed, first_seed + 1, ...
    first_seed: The first seed; `run` takes 0 and on.
    steps: Control steps of each.
  """

  env: Positional[str]
  agent: str | None = None
  detector: str = "rolling_sigma"
  set: tuple[str, ...] = ()
  arl0: float = 10_000
  seeds: int = 10
  first_seed: int = 100
  steps: int = 20_000
  physics: str = "auto"
  json: bool = False


@dataclass(frozen=True)
class Certify:
  """Proves for every fault that it acts, and measures what it costs; writes certificates.parquet
  and certificates.md into --out.

  Example: mjx-cl certify walker --fault gear --episodes 0 --out runs/certificates

  Attributes:
    env: Robots, default: all, see `mjx-cl list envs`.
    out: Result folder; rows of other robots in it are kept.
    fault: Only these faults, or presets that turn the robot into another one.
    episodes: Episodes per fault and severity for the return lost without adaptation; 0: none.
    agent: Trained agent: shipped name or folder; default: the shipped one, where there is one.
  """

  env: Positional[tuple[str, ...]] = ()
  out: str = "runs/certificates"
  fault: tuple[str, ...] = ()
  episodes: int = 20
  agent: str | None = None
  physics: str = "auto"
  json: bool = False


@dataclass(frozen=True)
class Record(Machines):
  """Records residual streams of a suite: frozen agents, healthy and faulty robots side by side, to
  Parquet that pandas alone reads.

  A recording that was cut off goes on where it stopped: parts that are finished are kept in
  OUT/work until all are there.

  Example: mjx-cl record leaderboard --robot walker --out runs/streams

  Attributes:
    suite: Suite by name, see `mjx-cl list suites`, or a .toml file.
    out: Folder of the set.
    robot: Only these robots of the suite.
    agent: Trained agent: shipped name or folder; default: the shipped one of each robot.
    overwrite: Replace a set that is in --out; with --robot, in a set of the same suite, those
      robots' streams alone.
  """

  suite: Positional[str] = "leaderboard"
  out: str = "runs/streams"
  robot: tuple[str, ...] = ()
  agent: str | None = None
  physics: str = "auto"
  json: bool = False
  overwrite: bool = False


@dataclass(frozen=True)
class Leaderboard(Machines):
  """Scores every registered detector on recorded streams; writes leaderboard.parquet and
  leaderboard.html into --out.

  Ways in for a detector of one's own: a plug-in (entry point mjx_cl.detectors), --add with a Python
  class, --submit with a file of scores.

  With --methods: methods of adaptation, on the lives that ship and, with --arm or a folder, on
  one's own; writes methods*.parquet and methods.json.

  Example: mjx-cl leaderboard --robot walker --detector cusum ewma --out runs/leaderboard

  Attributes:
    streams: Folder of `mjx-cl record`, with --methods of `mjx-cl bench methods`; default: what
      ships.
    out: Result folder.
    overwrite: Replace an earlier board in --out, or files that --export left.
    robot: Only these robots of the set.
    methods: Methods of adaptation in place of detectors.
    arm: Methods to live suite `methods` with in --out first, as --arm of `mjx-cl run`: names or
      FILE.py:make; goes on where it was cut off.
    seeds: Of these lives, in place of the suite's.
    beside: Folders of `mjx-cl bench` or `run --agent` whose lives take the place of the published
      methods'.
    detector: Only these detectors, by their names on the board, or name@channel,
      path/to/file.py:factory, module:factory; `none`: only the oracles and one's own. Default:
      all.
    add: module:Class or file.py:Class, a Python class with update(x) -> bool; a river detector
      works unchanged.
    set: Settings of --add, name=value ...
    channel: What --add watches: opr, rpr, reward, surprise or group_0 .. group_7.
    log: Give --add the logarithm, as the built-in detectors of one number have it.
    threshold: Setting of --add that is calibrated, larger = fewer alarms; default: it runs as
      it is, and its own rate of false alarms is printed.
    submit: Parquet with the columns stream, step, score, for all streams that --export writes.
    name: Name of --add, --submit or one --arm on the board.
    export: Only write the streams in full into this folder, one Parquet file per robot, for
      tools of one's own.
  """

  streams: Positional[str | None] = None
  out: str = "runs/leaderboard"
  overwrite: bool = False
  robot: tuple[str, ...] = ()
  methods: bool = False
  arm: tuple[str, ...] = ()
  seeds: int | None = None
  beside: tuple[str, ...] = ()
  detector: tuple[str, ...] = ()
  add: str | None = None
  set: tuple[str, ...] = ()
  channel: str = "opr"
  log: bool = False
  threshold: str | None = None
  submit: str | None = None
  name: str | None = None
  export: str | None = None
  json: bool = False


@dataclass(frozen=True)
class Bench(GpuMachines):
  """Runs a suite: runs over robots, faults and settings, each in a folder of its own; prints its
  plan first.

  The same command goes on where it was cut off; finished parts are never run again. Writes
  OUT/PART/ as `mjx-cl run` does, OUT/bench.parquet, OUT/bench.json.

  Example: mjx-cl bench quick --plan

  Attributes:
    suite: paper, quick, full, study or a .toml file, see `mjx-cl list benches`.
    out: Result folder; default: runs/bench/SUITE.
    only: Only these parts, or those below these names.
    seeds: In place of the suite's.
    first_seed: In place of the suite's.
    arm: In place of the suite's.
    plan: Only print the plan.
    shard: K/N: this machine runs every N-th part from the K-th on.
    jobs: Parts side by side, each on its share of the cores; default: one per core as far as
      memory allows.
    merge: Folders of the same suite from other machines; their finished parts are copied here
      and not run, seeds of a part that several hold are joined.
    publish: Copy finished parts' tables and figures, without the traces, to this folder.
    resume: Said for completeness: a suite always goes on.
  """

  suite: Positional[str] = "quick"
  out: str | None = None
  only: tuple[str, ...] = ()
  seeds: int | None = None
  first_seed: int | None = None
  arm: tuple[str, ...] = ()
  physics: str = "auto"
  plan: bool = False
  shard: str = "0/1"
  jobs: int | None = None
  merge: tuple[str, ...] = ()
  publish: str | None = None
  json: bool = False
  resume: bool = False


@dataclass(frozen=True)
class Plot:
  """Draws figure.png of a run anew.

  Example: mjx-cl plot runs/latest
  """

  folder: Positional[str]


@dataclass(frozen=True)
class Compare:
  """Finished runs of one robot against each other, or the arms of one: interquartile means, and
  differences of the streams of a seed from the first one's, with 95 % bootstrap intervals. Of
  folders of `bench`, or of `run` with several faults, a line for each part.

  Example: mjx-cl compare runs/mine runs/theirs:rollback --out compare.png

  Attributes:
    runs: FOLDER or FOLDER:ARM; of one folder alone all of its arms, of several the arm `detector`.
      The first is what the others are compared with.
    measure: reward_final, reward_kept, return_lost, terminations, updates, alarmed, latency_steps,
      false_alarms, recovered; default: the first five, of parts the first, third and fourth.
    by: Setting that the suite in one folder varies, such as detector: its runs against each other.
    out: Picture (.png): shares of streams that keep so much of their reward.
    change: Of the robot: 0 the first, its fault; 1 what came next, as a repair.
    overwrite: Replace --out.
  """

  runs: Positional[tuple[str, ...]]
  measure: tuple[str, ...] = ()
  by: str | None = None
  change: int = 0
  out: str | None = None
  json: bool = False
  overwrite: bool = False


@dataclass(frozen=True)
class Render(FaultConfig):
  """A moving picture of an agent at work: GIF, or MP4 with mjx-cl[video]; red border while a fault
  acts.

  Example: mjx-cl render walker --fault gear --target right_hip --out gear.gif

  Attributes:
    out: File that ends in .gif or .mp4; default: ENV.gif.
    agent: Trained agent: shipped name or folder; `none` stands still, `random` moves at random.
    steps: Control steps in all.
    width: Pixels.
    height: Pixels.
    fps: Pictures per second, at the robot's own pace.
    view: robot (MuJoCo), top (a car on its track, with its lidar) or auto.
    deterministic: Act by the policy's mean instead of a sample.
    compare: Side by side, from one seed: the robot whole, with the fault, and with the fault and
      each of these trained agents. Its width and height are then those of one robot.
    skip: Control steps before the first picture; --compare alone.
    overwrite: Replace --out.
  """

  fault: str = "none"
  onset: int = 200
  out: str | None = None
  agent: str | None = None
  steps: int = 400
  seed: int = 0
  width: int = 480
  height: int = 360
  fps: float = 20.0
  view: str = "auto"
  physics: str = "auto"
  deterministic: bool = False
  compare: tuple[str, ...] | None = None
  skip: int = 0
  json: bool = False
  overwrite: bool = False


@dataclass(frozen=True)
class Detect:
  """Says whether a log has changed against a healthy one, when, and in which columns.

  Read are Parquet and MCAP files (rosbag2; extra [ros]), and CSV files, also .csv.gz, with a header
  row (a row of units may follow) and cells between commas, semicolons (then with a decimal comma
  too) or tabulators; an empty cell or nan is a missing sample. `time`, `t`, a clock with its unit
  (`time_ms`), `step` or time stamps tell when samples were taken. Not watched are clocks and
  counters, columns that are constant in the nominal log, that hold text or that one log lacks; all
  of it is printed, --column watches even a clock.

  The nominal log is modelled: each column from the others and from the recent past, drifting ones
  relative to their slow average. Three charts watch what deviates. --detector runs detectors of the
  leaderboard instead, which take the nominal log as the past of the other. Writes detect.json,
  alarms.csv, detect.png and with --inject inject.csv and inject.png into --out.

  Example: mjx-cl detect today.csv --nominal healthy.csv --inject 2 --out runs/detect

  Attributes:
    file: Log to judge, .csv, .csv.gz, .parquet or .mcap.
    nominal: Log of the healthy system, same columns.
    column: Columns to watch; default: all columns of numbers that both files have, less clocks
      and constant ones.
    detector: In place of the charts: detectors of one number per sample, one for each column, or of
      several channels, one for all columns together; `all`; or module:Class, file.py:Class, a
      Python class with update(x) and a threshold of its own.
    set: Settings of such a class, name=value ...
    arl0: Wanted mean number of samples between false alarms of one detector or chart, all columns
      together.
    rate: Samples (or steps of the column `step`) per second, whatever clocks the logs hold;
      default: from those.
    model: Of the nominal log: ar, or none (the columns themselves).
    command: Columns that explain others and are not watched themselves, such as set points.
    refractory: Alarms of the charts that are closer than this are one event [s], in samples where
      the log has no clock; default: 10 s, 500 samples.
    inject: Also put faults into the nominal log: the smallest severity of each that is seen within
      so many seconds, or samples where the log has no clock.
    logarithm: Watch the logarithm; for residuals, which are positive and skewed. A sample of 0
      or less is refused.
    out: Folder for the results; default: only the table.
    overwrite: Replace an earlier detection in --out.
    fail_on_change: Exit with code 3 where the log has changed, or a column ends without samples.
  """

  file: Positional[str]
  nominal: str
  column: tuple[str, ...] = ()
  detector: tuple[str, ...] = ()
  set: tuple[str, ...] = ()
  arl0: float = 10_000
  rate: float | None = None
  model: str = "ar"
  command: tuple[str, ...] = ()
  refractory: float | None = None
  inject: float | None = None
  logarithm: bool = False
  out: str | None = None
  json: bool = False
  overwrite: bool = False
  fail_on_change: bool = False


@dataclass(frozen=True)
class Query:
  """SQL over all results, read-only; without SQL: the views, their rows and columns.

  `query SQL`: every table under results/ is a view named after its path
  (results/walker_gear/runs.parquet is walker_gear_runs). `query FOLDER SQL`: the tables of one
  folder, under their own names (trace, events, runs).

  Example: mjx-cl query runs/latest "select arm, seed, outcome from runs"

  Attributes:
    words: [FOLDER] [SQL]
    within: One more folder, DIR or NAME=DIR: its tables are views that begin with its name.
      Repeatable.
    limit: Rows at most; None: 100, with --json all.
    timeout: Seconds that it may take.
  """

  words: Positional[tuple[str, ...]] = ()
  within: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="in")] = ()
  limit: int | None = None
  timeout: float | None = None
  json: bool = False


@dataclass(frozen=True)
class Report:
  """Writes the numbers of README and docs anew from the files in results/: what lies between `<!--
  report:NAME -->` and `<!-- /report -->`, nothing else.

  Example: mjx-cl report --check

  Attributes:
    results: Folder of the results.
    page: Texts with marked blocks; default: README.md, docs/*.md and results/*/README.md.
    check: Write nothing; exit code 1 and the names of the blocks where text and results
      disagree.
    figures: Draw recovery.png and ratio.png of every published suite anew as well. A run's
      figure.png needs its trace (`mjx-cl plot`), leaderboard.html the streams (`mjx-cl
      leaderboard`).
  """

  results: str = "results"
  page: tuple[str, ...] = ()
  check: bool = False
  figures: bool = False
  json: bool = False


@dataclass(frozen=True)
class List:
  """Names that other commands take.

  Example: mjx-cl list faults

  Attributes:
    what: envs, faults, targets, fault-presets, schedules, detectors, presets, agents, arms, sizes,
      suites, benches or all.
  """

  what: Positional[str] = "all"
  json: bool = False


@dataclass(frozen=True)
class Doctor:
  """Versions, devices, physics backend, free memory, whether compiled programs are found again, and
  a two-second speed check.

  Example: mjx-cl doctor --json
  """

  json: bool = False
