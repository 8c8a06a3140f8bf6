"""The commands run and bench: one run, and suites of runs."""

import dataclasses
import os
import pathlib
import re
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

from mjx_cl.adapt import methods
from mjx_cl.adapt.arms import ARMS
from mjx_cl.cli import track
from mjx_cl.cli.flags import Bench, Run
from mjx_cl.cli.live import RunDisplay
from mjx_cl.cli.machines import WORKER
from mjx_cl.cli.output import clock, emit, say
from mjx_cl.cli.tables import show_agents, show_suite, show_summary
from mjx_cl.config import RunConfig, quick
from mjx_cl.errors import UserError, require
from mjx_cl.io import folders, memory
from mjx_cl.runs import bench, cluster, costs, run, workers
from mjx_cl.runs.suite import Part, Suite, by_agent, finished, of_each, pick, standing, suite
from mjx_cl.training.agents import numbered


def do_run(args: Run) -> None:
  """Lives the loop and prints its table."""
  given = {f.name: getattr(args, f.name) for f in dataclasses.fields(RunConfig)}
  names = args.agent
  if "all" in names:
    require(len(names) == 1, "--agent: 'all' stands alone")
    names = tuple(numbered(args.env))
  choices = {
    "fault": args.fault or (RunConfig.fault,),
    "severity": args.severity or (None,),
    "agent": names or (None,),
  }
  config = RunConfig(**given | {field: values[0] for field, values in choices.items()})
  if args.quick:
    say(f"note: {quick.said(config)}")
  if any(len(values) > 1 for values in choices.values()):
    several(args, config, choices)
    return
  track.check(args.track)
  with (
    RunDisplay() as display,
    track.beside(display, track.of_run, args.out, args.track, args.resume) as show,
  ):
    summary = run.execute(config, args.out, args.resume, args.overwrite, show, tell=say)
  idle = [name for name, arm in summary["arms"].items() if arm["updates_mean"] == 0]
  learners = [name for name in idle if ARMS[name].learns and methods.of(ARMS[name]).learns]
  if learners:
    say(
      f"note: no stream of arm {', '.join(learners)} has finetuned: nothing is said of its method"
    )
  if args.keep and not pathlib.Path(args.out, "agents").is_dir():
    say("note: --keep wrote no agent, since no stream has finetuned")
  if args.json:
    emit(summary)
  else:
    show_summary(summary, args.out)


def several(args: Run, config: RunConfig, choices: Mapping[str, Sequence]) -> None:
  """Lives a run with each combination of `of_each` and prints what they say, agents together."""
  for flag, given in (("track", args.track), ("stops", args.stops)):
    require(not given, f"--{flag} is of one run; give one --fault, --severity and --agent")
  require(not (args.resume and args.overwrite), "--resume and --overwrite exclude each other")
  plan = of_each(config, choices)
  out = folders.usable(args.out)
  begun = [f for f in (out, *(out / p.name for p in plan.parts)) if (f / "config.json").exists()]
  require(
    args.overwrite or not begun or (args.resume and out not in begun),
    f"{out} holds another run; give --resume to go on with it, --overwrite to replace it, or "
    "another --out",
  )
  robots = costs.Robots()
  for part in plan.parts:  # what is refused is refused before anything is removed
    costs.check(part, robots)
  for folder in begun if args.overwrite else ():
    with folders.alone(folder):
      run.clear(folder)
  value = live(plan, plan.parts, out)
  if args.json:
    emit(value)
    return
  together = by_agent(plan.parts)
  if not together:
    show_parts(value, out)
  show_together(value, together)
  print(f"files in {out}")


def do_bench(args: Bench) -> None:
  """Runs, plans, merges or publishes a suite."""
  require(args.jobs is None or args.on == "here", "--jobs is of this machine; leave out --on ray")
  on = cluster.of(args.on, args.address, args.gpu)
  plan, parts = asked(args)
  out = folders.usable(f"runs/bench/{plan.name}" if args.out is None else args.out)
  check_merge(args.merge, parts)
  if args.publish:
    bench.earlier(args.publish, plan)
  if args.plan:
    todo = planned(plan, parts, out, args.merge)
    if args.json:
      emit(
        [
          {"part": p.name, "finished": p.name in todo.done, **todo.estimates[p.name]._asdict()}
          for p in parts
        ]
      )
    else:
      print("\n".join(todo.lines))
    return
  value = live(plan, parts, out, args.merge, args.jobs, on)
  if args.publish:
    bench.publish(out, plan, args.publish)
  if args.json:
    emit(value)
    return
  show_parts(value, out)
  show_together(value, by_agent(plan.parts))
  print(f"{value['finished']} of {value['parts']} parts finished; files in {out}")


def show_parts(value: dict, out: pathlib.Path) -> None:
  """Prints what the parts of bench.json's value say, several in one table."""
  if len(value["entries"]) > 1:
    show_suite(value["entries"])
    return
  for name, summary in value["entries"].items():
    print(f"{name}: ", end="")
    show_summary(summary, str(out / name))


def show_together(value: dict, groups: Mapping[str, Mapping[str, Part]]) -> None:
  """Prints what the agents of each group of `by_agent` say together, as far as they have lived."""
  for name, own in groups.items():
    if name in value.get("agents", {}):
      print(f"{name}: " * (len(groups) > 1), end="")
      names = value["agents"][name]["agents"]
      show_agents(
        value["agents"][name], {agent: value["entries"][own[agent].name] for agent in names}
      )


class Planned(NamedTuple):
  """What is left to do of parts.

  Attributes:
    done: names of those that are finished or found.
    found: name -> folders of others that it is taken from.
    estimates: name -> what it costs.
    lines: the plan for a reader.
  """

  done: set[str]
  found: dict[str, list[pathlib.Path]]
  estimates: dict[str, costs.Estimate]
  lines: list[str]


def planned(
  plan: Suite, parts: Sequence[Part], out: pathlib.Path, others: Collection[str] = ()
) -> Planned:
  """The plan of a suite's parts; whatever can be refused is refused before the first part runs.

  Args:
    plan: the suite.
    parts: of it, those that are asked for.
    out: its folder.
    others: folders of --merge.
  """
  done = {p.name for p in parts if finished(out, p)}
  found = bench.offers(out, parts, others, say)
  robots = costs.Robots()
  for part in parts:
    if part.name not in done and part.name not in found:
      costs.check(part, robots)
  estimates = costs.estimates(parts, robots)
  note_others(out, [p for p in plan.parts if p not in parts])
  done |= set(found)
  return Planned(done, found, estimates, plan_lines(plan, parts, done, estimates))


def live(
  plan: Suite,
  parts: Sequence[Part],
  out: pathlib.Path,
  others: Collection[str] = (),
  jobs: int | None = None,
  on: cluster.Cluster | None = None,
) -> dict:
  """Runs what is left of a suite's parts and returns bench.json's value; arguments as of `planned`,
  jobs: parts side by side, None: as many as this machine takes, on: a cluster.
  """
  with folders.alone(out):
    done, found, estimates, lines = planned(plan, parts, out, others)
    folders.make(out)
    bench.take(out, parts, found)
    for name in found:
      say(f"{name}: taken over")
    needs = [estimates[p.name].bytes for p in parts if p.name not in done]
    most, space = max(needs, default=0), int(memory.MARGIN * memory.free())
    require(
      most <= space or on is not None,
      f"a part needs {most / 2**30:.1f} GiB, {space / 2**30:.1f} GiB may be used; fewer "
      "--seeds would fit",
    )
    jobs = workers.number(jobs, needs, space) if on is None else 1
    for line in lines:
      say(line)
    return bench.execute(
      plan, out, parts, estimates, say, RunDisplay, jobs=jobs, worker=WORKER, on=on
    )


def asked(args: Bench) -> tuple[Suite, list[Part]]:
  """The suite, and those of its parts that are to be run.

  Raises:
    UserError: for a suite, part or shard that is not there, jobs below 1.
  """
  change = {
    "seeds": args.seeds,
    "first_seed": args.first_seed,
    "arms": list(args.arm) or None,
    "physics": None if args.physics == "auto" else args.physics,
  }
  plan = suite(args.suite, {k: v for k, v in change.items() if v is not None})
  shard = re.fullmatch("([0-9]+)/([0-9]+)", args.shard)
  if not shard:
    raise UserError(f"--shard takes K/N, such as 0/2; got {args.shard!r}")
  require(args.jobs is None or args.jobs >= 1, f"--jobs must be above 0; got {args.jobs}")
  return plan, pick(plan.parts, args.only, (int(shard[1]), int(shard[2])))


def check_merge(others: Collection[str], parts: Sequence[Part]) -> None:
  """Raises UserError for a folder that holds none of the parts."""
  for folder in map(pathlib.Path, others):
    require(folder.is_dir(), f"--merge: no folder {folder}")
  names = f"{', '.join(p.name for p in parts[:3])}{' ...' * (len(parts) > 3)}"
  for folder in map(pathlib.Path, others):
    require(
      any(os.path.lexists(folder / p.name / "config.json") for p in parts),
      f"--merge: {folder} holds none of the parts {names}; it takes the OUT of a bench of this "
      "suite",
    )


def note_others(out: pathlib.Path, parts: Sequence[Part]) -> None:
  """Says which parts that are not asked for the folder holds with other settings than now."""
  others: dict[str, list[str]] = {}
  for name, text in standing(out, parts)[1].items():
    others.setdefault(text, []).append(name)
  if others:
    which = "; ".join(f"{', '.join(names)} ({text})" for text, names in others.items())
    say(
      "note: left out of bench.json, with the folder as it is, for settings other than now "
      f"and not asked for: {which}"
    )


def plan_lines(
  plan: Suite, parts: Sequence[Part], done: Collection[str], estimates: Mapping[str, costs.Estimate]
) -> list[str]:
  """The plan of a suite for a reader."""
  lines = [f"{plan.name}: {plan.about}"]
  width = max([4, *(len(p.name) for p in parts)])
  lines.append(f"  {'part':{width}s}  streams  stream-steps   updates  minutes    GiB")
  for p in parts:
    e = estimates[p.name]
    minutes = "finished" if p.name in done else f"{e.seconds / 60:.0f}"
    lines.append(
      f"  {p.name:{width}s}  {e.streams:7,d}  {e.stream_steps:12,d}  {e.updates:8,.0f}  "
      f"{minutes:>7s}  {e.bytes / 2**30:5.1f}"
    )
  todo = [p for p in parts if p.name not in done]
  left = sum(estimates[p.name].seconds for p in todo)
  lines.append(
    f"  {len(done)} of {len(parts)} parts finished; about {clock(left)} left, by a one-second "
    "measurement of this machine's matrix product"
  )
  return lines + [f"  note, {which}: {text}" for text, which in bench.notes(todo)]
