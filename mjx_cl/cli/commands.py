"""What each command of the command line does: `do_NAME` takes the parsed arguments (the dataclass
of that name in cli.py), computes, and prints through display.py.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
import os
import pathlib
import re
import sys
import time
import types
from typing import TYPE_CHECKING

from mjx_cl.cli.display import (
  RunDisplay,
  TrainDisplay,
  clock,
  detect_table,
  emit,
  json_value,
  plan_lines,
  say,
  show,
  show_summary,
)
from mjx_cl.config import (
  PRESETS,
  FaultConfig,
  RunConfig,
  TrainConfig,
  check_seeds,
  replace,
  settings,
)
from mjx_cl.errors import FileError, UserError, choose

if TYPE_CHECKING:
  from mjx_cl.cli.flags import (
    Bench,
    Certify,
    Detect,
    Doctor,
    Eval,
    Leaderboard,
    List,
    Plot,
    Query,
    Record,
    Render,
    Report,
    Run,
    Train,
  )


MOST_EPISODES = 10_000  # all at once in one program


def do_run(args: Run) -> None:
  """Lives the loop and prints its table."""
  config = RunConfig(**{f.name: getattr(args, f.name) for f in dataclasses.fields(RunConfig)})
  from mjx_cl.runs import run

  with RunDisplay() as display:
    summary = run.execute(config, args.out, args.resume, args.overwrite, display, tell=say)
  if args.keep and not os.path.isdir(os.path.join(args.out, "agents")):
    say("note: --keep wrote no agent, since no stream has finetuned")
  if args.json:
    emit(summary)
  else:
    show_summary(summary, args.out)


def do_bench(args: Bench) -> None:
  """Runs, plans, merges or publishes a suite."""
  from mjx_cl.io import memory
  from mjx_cl.runs import suite as bench
  from mjx_cl.runs import workers

  change = {
    k: v
    for k, v in (
      ("seeds", args.seeds),
      ("first_seed", args.first_seed),
      ("arms", list(args.arm) or None),
      ("physics", None if args.physics == "auto" else args.physics),
    )
    if v is not None
  }
  suite = bench.suite(args.suite, change)
  k, sign, n = args.shard.partition("/")
  if not (sign and re.fullmatch("[0-9]+", k) and re.fullmatch("[0-9]+", n)):
    raise UserError(f"--shard takes K/N, such as 0/2; got {args.shard!r}")
  if args.jobs is not None and args.jobs < 1:
    raise UserError(f"--jobs must be above 0; got {args.jobs}")
  for folder in args.merge:
    if not os.path.isdir(folder):
      raise UserError(f"--merge: no folder {folder}")
  parts = bench.pick(suite.parts, args.only, (int(k), int(n)))
  out = pathlib.Path(args.out or f"runs/bench/{suite.name}")
  for folder in args.merge:
    if not any(os.path.isfile(os.path.join(folder, p.name, "config.json")) for p in parts):
      raise UserError(
        f"--merge: {folder} holds none of the parts "
        f"{', '.join(p.name for p in parts[:3])}{' ...' * (len(parts) > 3)}; it takes the OUT "
        "of a bench of this suite"
      )
  if args.publish:
    bench.earlier(args.publish, suite)
  done = {p.name for p in parts if bench.finished(out, p)}
  found = bench.offers(out, parts, args.merge, say)
  robots = bench.Robots()
  for part in parts:  # whatever can be refused is refused before the first part runs
    if part.name not in done and part.name not in found:
      bench.check(part, robots)
  estimates = bench.estimates(parts, robots)
  others: dict[str, list[str]]
  chosen, others = {p.name for p in parts}, {}
  for name, text in bench.standing(out, [p for p in suite.parts if p.name not in chosen])[
    1
  ].items():
    others.setdefault(text, []).append(name)
  if others:
    which = "; ".join(f"{', '.join(names)} ({text})" for text, names in others.items())
    say(
      "note: left out of bench.json, with the folder as it is, for settings other than now "
      f"and not asked for: {which}"
    )
  if args.plan:
    done |= set(found)
    if args.json:
      emit(
        [{"part": p.name, "finished": p.name in done, **estimates[p.name]._asdict()} for p in parts]
      )
    else:
      print("\n".join(plan_lines(suite, parts, done, estimates)))
    return
  try:
    out.mkdir(parents=True, exist_ok=True)
  except OSError as e:
    raise FileError(f"cannot make {out}: {e.strerror}") from None
  bench.take(out, parts, found)
  for name in found:
    say(f"{name}: taken over")
    done.add(name)
  needs, space = (
    [estimates[p.name].bytes for p in parts if p.name not in done],
    int(memory.MARGIN * memory.free()),
  )
  if max(needs, default=0) > space:
    raise UserError(
      f"a part needs {max(needs) / 2**30:.1f} GiB, {space / 2**30:.1f} GiB may be used; fewer "
      "--seeds would fit"
    )
  jobs = workers.number(args.jobs, needs, space)
  for line in plan_lines(suite, parts, done, estimates):
    say(line)
  value = bench.execute(
    suite, out, parts, estimates, say, RunDisplay, jobs=jobs, worker="mjx_cl.cli.worker"
  )
  if args.publish:
    bench.publish(out, suite, args.publish)
  if args.json:
    emit(value)
    return
  for name, summary in value["entries"].items():
    print(f"{name}: ", end="")
    show_summary(summary, str(out / name))
  print(f"{value['finished']} of {value['parts']} parts finished; files in {out}")


def do_train(args: Train) -> None:
  """Trains agents."""
  preset = choose("preset", args.preset, PRESETS)
  names = {f.name for f in dataclasses.fields(TrainConfig)}
  changes = settings(args.set)
  from mjx_cl.runs import suite as bench

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
  check_seeds(args.seed)
  if args.agent == "":
    raise UserError("--agent is a shipped name or a folder; got an empty name")
  if not 0 < args.save_every_s < float("inf"):
    raise UserError(f"--save-every-s must be above 0; got {args.save_every_s}")
  from mjx_cl import envs
  from mjx_cl.io import folders
  from mjx_cl.runs import run
  from mjx_cl.training import files, premises
  from mjx_cl.training import trainer as train

  env = envs.make(args.env, args.physics)
  if args.demonstrator not in (
    None,
    "ppo",
  ):  # whatever can be refused is refused before an earlier training is touched
    premises.expert(env, args.demonstrator)
  premises.faults_of(env, train_config)
  files.shown(train_config, args.out, args.demonstrator)
  premises.check(env, dreamer, train_config, args.agent)
  state = folders.claim_folder(args.out, args.resume, args.overwrite, done_marker="agent/card.json")
  if state != "new":
    updates = files.check_same(
      args.out, env, dreamer, train_config, args.seed, args.seeds, args.demonstrator, args.agent
    )
  if state == "done":
    if updates != train_config.updates:
      raise UserError(
        f"{args.out}: this training has finished its {updates:,} updates; go on with --agent "
        f"{pathlib.Path(args.out, 'agent')} and another --out"
      )
    say(f"{args.out}: this training is finished")
    return
  if state == "new" and args.overwrite:
    out = pathlib.Path(args.out)
    for name, given in (("agent", args.agent), ("demonstrator", args.demonstrator)):
      if given and any(
        pathlib.Path(given).resolve().is_relative_to((out / own).resolve())
        for own in ("agent", "agents", "demonstrator", "checkpoints", "work")
      ):
        raise UserError(f"--overwrite removes --{name} {given} with {out}; give another --out")
    run.clear(out)
    files.clear(out)
  command = "mjx-cl " + " ".join(sys.argv[1:]) if len(sys.argv) > 1 else "mjx-cl train"
  trainer = files.build(
    env,
    dreamer,
    train_config,
    args.out,
    args.seed,
    args.seeds,
    args.demonstrator,
    args.agent,
    args.preset,
    command,
    state == "resume",
  )
  display = TrainDisplay(train_config.updates)
  with display:
    train.run(trainer, display, args.save_every_s)
  card = files.export(trainer)
  if args.json:
    emit(card)
  else:
    say(
      f"agent in {args.out}/agent, return {card['eval']['return_mean']:.0f} over "
      f"{card['eval']['episodes']} episodes"
    )


def do_eval(args: Eval) -> None:
  """Prints what an agent returns."""
  if not 1 <= args.episodes <= MOST_EPISODES:
    raise UserError(
      f"episodes must lie in 1..{MOST_EPISODES:,}, which are lived side by side; got "
      f"{args.episodes}"
    )
  check_seeds(args.seed, args.episodes)
  if args.agent == "":
    raise UserError("--agent is a shipped name or a folder; got an empty name")
  from mjx_cl import envs
  from mjx_cl.training import agents, evaluate

  env = envs.make(args.env, args.physics)
  trained = agents.of(env, args.agent)
  result = evaluate.evaluate(
    env,
    trained.agent,
    trained.train.params,
    args.episodes,
    args.seed,
    int(trained.card.get("repeat", 1)),
    args.deterministic,
  )
  if not math.isfinite(result["return_mean"]):
    raise FileError(
      f"agent {trained.path}: its return on {args.env} is {result['return_mean']}; its weights "
      "or the robot give what is no number"
    )
  result = {"env": args.env, "agent": os.path.basename(os.path.normpath(trained.path)), **result}
  if args.json:
    emit(result)
  else:
    print(
      f"{args.env}: return {result['return_mean']:.1f} (IQM {result['return_iqm']:.1f}, 95 % "
      f"interval {result['return_ci'][0]:.1f} to "
      f"{result['return_ci'][1]:.1f}) over {args.episodes} episodes, {result['terminations']} "
      "terminations"
      if result["return_ci"]
      else f"{args.env}: return {result['return_mean']:.1f} in one episode"
    )
    base = ("env", "agent", "episodes", "return_mean", "return_iqm", "terminations")
    figures = {k: v for k, v in result.items() if isinstance(v, (int, float)) and k not in base}
    if figures:
      print("  " + ", ".join(f"{k} {v:.3g}" for k, v in figures.items()))


def do_certify(args: Certify) -> None:
  """Certifies faults."""
  if not 0 <= args.episodes <= MOST_EPISODES:
    raise UserError(f"episodes must lie in 0..{MOST_EPISODES:,}; got {args.episodes}")
  from mjx_cl import envs
  from mjx_cl.runs import certify

  names = args.env or tuple(envs.ENVS)
  certify.check(names)
  certify.guard(args.out, names, args.episodes)
  rows, faulty = [], []
  for name in names:
    mine = certify.certify(name, args.physics, args.episodes, args.agent, args.fault, say)
    certify.write(args.out, mine)  # what is measured is kept, whatever happens to the next robot
    rows += mine
    faulty += certify.certificate.faulty(
      [
        certify.certificate.Certificate(*(r[k] for k in certify.certificate.Certificate._fields))
        for r in mine
      ]
    )
  if args.json:
    emit(certify.summary(rows))
  else:
    for line in certify.summary(rows):
      print(f"{line['name']}: {line['value']}")
    print(f"files in {args.out}")
  for line in faulty:  # type: ignore[assignment]
    say(f"mjx-cl: {line}")


def do_record(args: Record) -> None:
  """Records a suite of streams."""
  from mjx_cl.io import folders
  from mjx_cl.leaderboard import record, streams

  suite, out = streams.suite(args.suite), args.out
  if args.overwrite:
    record.prepare(
      suite, args.robot, args.physics, args.agent
    )  # what is refused must not cost the set that is there
  record.claim(suite, out, args.overwrite, args.robot)
  folders.probe(out)
  told = [0.0]

  def progress(part: str, done: int, steps: int, lanes: int) -> None:
    now = time.monotonic()
    if now - told[0] > 10 or done >= steps:
      told[0] = now
      say(f"{part}: {done:,}/{steps:,} steps of {lanes} robots")

  result = record.record(
    suite, out, args.robot, args.physics, args.agent, "mjx-cl " + " ".join(sys.argv[1:]), progress
  )
  record.clear(out)
  if args.json:
    emit(result)
  else:
    for robot, steps in result["stream_steps"].items():
      speed = result["stream_steps_per_s"].get(robot)
      print(
        f"{robot}: {steps:,} stream-steps"
        + (f", {speed:,.0f} a second" if speed else ", recorded before")
      )
    print(f"{result['bytes'] / 1e6:.1f} MB in {out}")


def do_leaderboard(args: Leaderboard) -> None:
  """Scores detectors on recorded streams, or exports the streams."""
  from mjx_cl.io import folders, runtime
  from mjx_cl.leaderboard import score, streams, submissions

  for flag, given, other in (
    ("--set", args.set, args.add),
    ("--threshold", args.threshold, args.add),
    ("--log", args.log, args.add),
    ("--name", args.name, args.add or args.submit),
  ):
    if given and not other:
      raise UserError(
        f"{flag} belongs to a detector of one's own; give --add"
        + (" or --submit" if flag == "--name" else "")
      )
  if args.name and args.add and args.submit:
    raise UserError(
      "--name names one detector; give --add and --submit in two commands, or leave it out"
    )
  held = streams.StreamSet(args.streams)
  robots = held.choose(args.robot)
  if args.export:
    folders.probe(args.export)
    files = submissions.export(held, args.export, robots, args.overwrite)
    emit(files) if args.json else print("\n".join(files))
    return
  if os.path.exists(args.out) and not os.path.isdir(args.out):
    raise UserError(f"--out {args.out} is a file")
  if os.path.exists(os.path.join(args.out, "leaderboard.json")) and not args.overwrite:
    raise UserError(
      f"{args.out} holds a leaderboard; give --overwrite to replace it, or another --out"
    )
  entries, extra = score.chosen(args.detector, robots[0]), []
  if args.add:
    from mjx_cl.detectors import python_class

    build = lambda value: python_class.load(
      args.add,
      settings(args.set) | ({args.threshold: value} if args.threshold else {}),
      args.name,
      args.channel,
      args.log,
    )
    one = build(1.0)
    extra.append(
      (one.host_name, submissions.from_host(build if args.threshold else one, args.threshold))
    )
  if args.submit:
    scores = submissions.read_submission(args.submit, held, robots)
    extra.append(
      (
        args.name or os.path.basename(args.submit).removesuffix(".parquet"),
        submissions.from_scores(scores),
      )
    )
  taken = {*score.variants(), *(one.name for one in entries), *score.ORACLES}
  for name, _ in extra:
    if name in taken:
      raise UserError(f"the board has a detector {name!r} already; give --name")
    taken.add(name)
  told = [0.0]

  def progress(robot: str, name: str, done: int, total: int, seconds: float) -> None:
    if time.monotonic() - told[0] > 2 or done == total:
      told[0] = time.monotonic()
      say(
        f"{done}/{total}  {robot}: {name}, {clock(seconds)} gone, "
        f"{clock(seconds / done * (total - done))} left"
      )

  folders.probe(args.out)  # before minutes are spent
  board = score.score(held, entries, robots, extra, progress)
  meta = {
    "command": "mjx-cl " + " ".join(sys.argv[1:]),
    "seeds": {k: list(v) for k, v in held.suite.seeds.items()},
    "arl0_target": held.suite.arl0,
    "streams": held.config.get("command"),
    **(
      {"kept": {r: v.get("command") for r, v in held.config["kept"].items()}}
      if "kept" in held.config
      else {}
    ),
    "wall_s": round(board.seconds, 1),
    "stream_steps": board.stream_steps,
    **runtime.provenance(),
  }
  files = score.write(board, args.out, meta)
  if args.json:
    emit([{k: v for k, v in r.items() if not k.startswith("stream_")} for r in board.rows])
    return
  from rich.table import Table

  table = Table(
    title=(
      f"{len(board.rows):,} rows, ARL0 {held.suite.arl0:,.0f} steps, means over robots, faults "
      "and severities"
    ),
    title_justify="left",
  )
  for k, heading in enumerate(
    (
      "detector",
      "score",
      "95 %",
      "within 1 s",
      "within 5 s",
      "missed",
      "false alarms/h",
      "mean rank",
    )
  ):
    table.add_column(heading, justify="right" if k else "left", no_wrap=not k)
  number = lambda x, form: "-" if x is None or not math.isfinite(x) else format(x, form)
  for r in board.overall.rows:
    ci = r["cost_standard_ci"]
    table.add_row(
      r["detector"],
      number(r["cost_standard"], ".1f"),
      f"{number(ci[0], '.1f')} to {number(ci[1], '.1f')}" if ci else "-",
      number(r["detected_within_1s"], ".0%"),
      number(r["detected_within_5s"], ".0%"),
      number(r["miss_probability"], ".0%"),
      number(r["false_alarms_per_hour"], ".1f"),
      number(r["mean_rank"], ".1f"),
    )
  show(table)
  print(
    f"{board.stream_steps:,} stream-steps scored in {clock(board.seconds)}; files: "
    f"{', '.join(files)}"
  )


def do_plot(args: Plot) -> None:
  """Draws the figure of a run anew."""
  from mjx_cl.render import figures as plots

  if not os.path.exists(os.path.join(args.folder, "trace.parquet")):
    raise UserError(f"{args.folder} holds no finished run (no trace.parquet)")
  print(plots.figure(args.folder))


def do_render(args: Render) -> None:
  """Films an agent."""
  from mjx_cl import envs
  from mjx_cl.envs import adapters
  from mjx_cl.render import pictures
  from mjx_cl.training import agents

  out = args.out or f"{args.env.rpartition(':')[2]}.gif"
  pictures.check(out, args.steps, args.width, args.height, args.fps, args.seed)
  env = envs.make(args.env, args.physics)
  acting = {f.name: getattr(args, f.name) for f in dataclasses.fields(FaultConfig)}
  del acting["env"]
  acting |= {"seed": args.seed, "deterministic": args.deterministic}
  if args.agent in ("none", "random"):
    acting["agent"] = adapters.Puppet(len(env.spec.act), float(args.agent == "random"))
  elif args.agent is None and not agents.is_shipped(env):
    raise UserError(
      f"no agent is shipped for {args.env}; give a folder, or --agent none (stands still), "
      "--agent random"
    )
  else:
    trained = agents.of(env, args.agent)
    acting |= {
      "agent": trained.agent,
      "params": trained.train.params,
      "repeat": int(trained.card.get("repeat", 1)),
    }
  result = pictures.render(
    env,
    out,
    args.steps,
    args.width,
    args.height,
    args.fps,
    view=args.view,
    say=lambda text: say(f"mjx-cl: {text}"),
    **acting,
  )
  if args.json:
    emit({"env": args.env, "agent": args.agent or args.env, "fault": args.fault, **result})
  else:
    print(
      f"{result['file']}: {result['frames']} pictures, {result['fps']:g} a second, drawn by "
      f"{result['drawn_by']}"
    )


def do_detect(args: Detect) -> None:
  """Watches a log."""
  from mjx_cl.logs import detect, results

  out = None if args.out is None else results.claim(args.out, args.overwrite)
  tell = say if sys.stderr.isatty() else lambda text: None
  result = detect.detect(
    args.file,
    args.nominal,
    args.column,
    args.detector,
    args.arl0,
    args.rate,
    args.logarithm,
    settings(args.set),
    tell,
  )
  if out:
    results.write(result, out)
  for note in result.summary["notes"]:
    say(f"mjx-cl: {note}")
  if args.json:
    emit(result.summary)
    return
  from rich.console import Console

  console, rows = Console(), result.summary["detectors"]
  table = detect_table(rows, True)
  if (
    wide := console.measure(table, options=console.options.update(width=100_000)).maximum
    > console.width
  ):
    table = detect_table(rows, False)
  console.print(table)
  groups: dict[str, list[str]] = {}
  for row in rows if wide else ():
    groups.setdefault(", ".join(row["columns"]) or "no column", []).append(row["detector"])
  for columns, names in groups.items():
    print(f"{', '.join(names)}: alarms in {columns}")
  if any(row["calibrated"] is False for row in result.summary["detectors"]):
    print("* not calibrated")


def do_query(args: Query) -> None:
  """Answers SQL, or names the views."""
  from mjx_cl.io import tables as store

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


def _writer() -> types.ModuleType:
  """The program beside a checkout's package that writes its documents' numbers.

  Raises:
    UserError where the package stands elsewhere.
  """
  checkout = pathlib.Path(__file__).parents[2]
  if not (checkout / "benchmarks" / "report" / "report.py").is_file():
    raise UserError(
      "report writes the documents of a checkout of mjx_cl; this package is installed without one"
    )
  if str(checkout) not in sys.path:
    sys.path.append(str(checkout))
  return importlib.import_module("benchmarks.report.report")


def do_report(args: Report) -> None:
  """Writes the documents' numbers anew."""
  report = _writer()

  pages = args.page or [str(p) for p in report.pages()] or ["README.md"]
  found = {
    page: report.report(args.results, page, check=True) for page in pages
  }  # whatever is wrong is said before anything is written
  if args.figures and args.check:
    raise UserError("--check writes nothing, --figures draws: give one of the two")
  if not args.check:
    for page in pages:
      report.report(args.results, page)
  if args.figures:
    from mjx_cl.runs import suite as bench

    for file in bench.redraw(args.results):
      print(f"{file}: drawn anew", file=sys.stderr)
  stale = {
    page: list(dict.fromkeys(b["name"] for b in blocks if not b["agrees"]))
    for page, blocks in found.items()
  }
  stale = {page: names for page, names in stale.items() if names}
  if args.json:
    emit([{"page": page, **block} for page, blocks in found.items() for block in blocks])
  else:
    for page, blocks in found.items():
      if not blocks:
        print(f"{page}: no marked block")
      elif not (args.check and page in stale):
        print(
          f"{page}: "
          + (
            f"written anew: {', '.join(stale[page])}"
            if page in stale
            else f"all {len(blocks)} blocks agree with {args.results}"
          )
        )
  if stale and args.check:
    raise FileError(
      "; ".join(
        f"{page} disagrees with {args.results} in: {', '.join(names)}"
        for page, names in stale.items()
      )
      + "; mjx-cl report writes them anew"
    )


def do_list(args: List) -> None:
  """Prints the names that other commands take."""
  from mjx_cl import detectors, envs, faults
  from mjx_cl.adapt.arms import ARMS
  from mjx_cl.faults import presets
  from mjx_cl.leaderboard import streams
  from mjx_cl.runs import suite as bench
  from mjx_cl.training import agents, needs

  first = lambda f: (f.__doc__ or "").strip().split("\n")[0]
  tables = {
    "envs": lambda: {k: first(v) for k, v in envs.ENVS.items()},
    "faults": lambda: {k: faults.about(k) for k in faults.FAULTS},
    "detectors": lambda: {k: first(v) for k, v in detectors.DETECTORS.items()},
    "presets": lambda: {k: p.about for k, p in PRESETS.items()},
    "agents": lambda: {k: "shipped" for k in agents.shipped()},
    "arms": lambda: {k: a.about for k, a in ARMS.items()},
    "fault-presets": lambda: {k: f"{p.about} ({p.source})" for k, p in presets.PRESETS.items()},
    "schedules": lambda: presets.SCHEDULES,
    "sizes": needs.table,
    "suites": streams.about,
    "benches": bench.shipped,
  }
  chosen = {
    k: make()
    for k, make in (
      tables
      if choose("list", args.what, tables | {"all": None}) is None
      else {args.what: tables[args.what]}
    ).items()
  }
  if args.json:
    emit(chosen)
    return
  for kind, table in chosen.items():
    print(kind)
    for name, about in table.items():
      print(f"  {name:22s} {about}")


def do_doctor(args: Doctor) -> None:
  """Prints what the machine offers."""
  from mjx_cl.cli import doctor

  rows = doctor.report()
  if args.json:
    emit(rows)
  else:
    for name, value in rows.items():
      if isinstance(value, dict):
        value = ", ".join(f"{k} {v}" for k, v in value.items())
      print(f"{name:16s} {value}")
