"""The commands certify and render: what faults do to a robot, and how that looks."""

import dataclasses
import shlex
from typing import Any

from mjx_cl import envs
from mjx_cl.cli.agents import MOST_EPISODES
from mjx_cl.cli.flags import Calibrate, Certify, Render
from mjx_cl.cli.output import emit, say
from mjx_cl.config import FOREVER, FaultConfig, own_agent, settings
from mjx_cl.envs import adapters
from mjx_cl.errors import FileError, UserError, require
from mjx_cl.faults import presets
from mjx_cl.faults.certificate import faulty
from mjx_cl.render import compare, pictures
from mjx_cl.runs import calibrate, certificate_tables, certify
from mjx_cl.training import agents


def do_calibrate(args: Calibrate) -> None:
  """Finds a detector's threshold."""
  require(args.arl0 > 0, f"--arl0 must be above 0; got {args.arl0:g}")
  require(
    1 <= args.seeds <= MOST_EPISODES, f"--seeds must lie in 1..{MOST_EPISODES:,}; got {args.seeds}"
  )
  require(1 <= args.steps < FOREVER, f"--steps must lie in 1..{FOREVER - 1:,}; got {args.steps}")
  require(args.first_seed >= 0, f"--first-seed must be 0 or above; got {args.first_seed}")
  env = envs.make(args.env, args.physics)
  trained = agents.of(env, args.agent)
  seeds = range(args.first_seed, args.first_seed + args.seeds)
  own = settings(args.set)
  found = calibrate.calibrate(env, trained, args.detector, own, seeds, args.steps, args.arl0, say)
  words = [args.env, *(["--agent", args.agent] if args.agent else []), "--detector", args.detector]
  words += ["--set", *args.set, f"threshold={found.threshold:.6g}"]
  if args.json:
    emit(found._asdict() | {"settings": own | {"threshold": found.threshold}})
    return
  rate = "no false alarm" if found.arl0 is None else f"a false alarm in {found.arl0:,.0f}"
  low, high = ("-" if x is None else f"{x:,.0f}" for x in found.arl0_ci)
  print(
    f"{args.detector} on {args.env}: threshold {found.threshold:.6g}, {rate} [{low}, {high}] "
    f"control steps ({found.alarms} in {found.steps:,})"
  )
  print("mjx-cl run " + shlex.join(words))


def do_certify(args: Certify) -> None:
  """Certifies faults."""
  require(
    0 <= args.episodes <= MOST_EPISODES,
    f"episodes must lie in 0..{MOST_EPISODES:,}; got {args.episodes}",
  )
  names = args.env or tuple(envs.ENVS)
  certify.check(names)
  certificate_tables.guard(args.out, names, args.episodes)
  rows: list[dict] = []
  wrong: list[str] = []
  for name in names:
    mine = certify.certify(name, args.physics, args.episodes, args.agent, args.fault, say)
    # what is measured is kept, whatever happens to the next robot
    certificate_tables.write(args.out, mine)
    rows += mine
    wrong += faulty(certificate_tables.certificates(mine))
  summary = certificate_tables.summary(rows)
  if args.json:
    emit(summary)
  else:
    for line in summary:
      print(f"{line['name']}: {line['value']}")
    print(f"files in {args.out}")
  for text in wrong:
    say(f"mjx-cl: {text}")
  if wrong:
    raise FileError(f"{len(wrong)} certificates fail")


def do_render(args: Render) -> None:
  """Films an agent, or several side by side."""
  out = args.out or f"{args.env.rpartition(':')[2]}.gif"
  require(args.compare is not None or args.skip == 0, "--skip goes with --compare; got it without")
  path = pictures.check(out, args.steps + args.skip, args.width, args.height, args.fps, args.seed)
  require(args.overwrite or not path.exists(), f"{path} is there; --overwrite replaces it")
  env = envs.make(args.env, args.physics)
  fault = {f.name: getattr(args, f.name) for f in dataclasses.fields(FaultConfig)[1:]}
  acting: dict[str, Any] = {"seed": args.seed, "deterministic": args.deterministic}
  size = (args.width, args.height, args.fps)
  tell = lambda text: say(f"note: {text}")
  if args.compare is None:
    acting |= fault | _acts(env, args.env, args.agent)
    result = pictures.render(env, out, args.steps, *size, view=args.view, say=tell, **acting)
  else:
    panes = _panes(env, args, fault)
    result = compare.film(
      panes,
      out,
      args.steps,
      args.skip,
      *size,
      view=args.view,
      weak=args.target or _target(args),
      say=tell,
      **acting,
    )
  if args.json:
    emit(
      {"env": args.env, "agent": args.agent or own_agent(args.env), "fault": args.fault, **result}
    )
  else:
    print(
      f"{result['file']}: {result['frames']} pictures, {result['fps']:g} a second, drawn by "
      f"{result['drawn_by']}"
    )


def _acts(env: Any, name: str, agent: str | None) -> dict[str, Any]:
  """The arguments of `pictures.act` for an agent as --agent names it."""
  if agent in ("none", "random"):
    return {"agent": adapters.Puppet(len(env.spec.act), float(agent == "random"))}
  if agent is None and not agents.is_shipped(env):
    raise UserError(
      f"no agent is shipped for {name}; give a folder, or --agent none (stands still), "
      "--agent random"
    )
  trained = agents.of(env, agent)
  return {"agent": trained.agent, "params": trained.train.params, "repeat": trained.repeat}


def _target(args: Render) -> str | None:
  """What a preset breaks, where all that it breaks is one thing."""
  changes = presets.find(args.fault, args.env).changes if presets.named(args.fault) else ()
  targets = {c.target for c in changes}
  return targets.pop() if len(targets) == 1 else None


def _panes(env: Any, args: Render, fault: dict[str, Any]) -> list[compare.Pane]:
  """Whole, with the fault, and with it and each agent of --compare."""
  require(args.fault != "none", "--compare shows what a fault does; name one with --fault")
  words = " ".join([args.fault, *([args.target] if args.target else [])])
  if args.severity is not None:
    words += f" {args.severity:g}"
  broken = env
  if presets.named(args.fault):
    preset = presets.find(args.fault, args.env)
    if preset.becomes and not preset.then:  # broken from the first step on
      broken, fault = envs.make(preset.becomes, args.physics), {}
  own = _acts(env, args.env, args.agent)
  shown = [
    compare.Pane("HEALTHY", "as trained", env, own),
    compare.Pane("BROKEN", words, broken, fault | own),
  ]
  return shown + [
    compare.Pane("BROKEN", f"agent {name}", broken, fault | _acts(broken, args.env, name))
    for name in args.compare or ()
  ]
