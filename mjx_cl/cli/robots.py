"""The commands certify and render: what faults do to a robot, and how that looks."""

import dataclasses
from typing import Any

from mjx_cl import envs
from mjx_cl.cli.agents import MOST_EPISODES
from mjx_cl.cli.flags import Certify, Render
from mjx_cl.cli.output import emit, say
from mjx_cl.config import FaultConfig
from mjx_cl.envs import adapters
from mjx_cl.errors import UserError, require
from mjx_cl.faults.certificate import faulty
from mjx_cl.render import pictures
from mjx_cl.runs import certificate_tables, certify
from mjx_cl.training import agents


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


def do_render(args: Render) -> None:
  """Films an agent."""
  out = args.out or f"{args.env.rpartition(':')[2]}.gif"
  pictures.check(out, args.steps, args.width, args.height, args.fps, args.seed)
  env = envs.make(args.env, args.physics)
  acting: dict[str, Any]
  acting = {f.name: getattr(args, f.name) for f in dataclasses.fields(FaultConfig)[1:]}
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
    acting |= {"agent": trained.agent, "params": trained.train.params}
    acting["repeat"] = trained.repeat
  size = (args.steps, args.width, args.height, args.fps)
  tell = lambda text: say(f"note: {text}")
  result = pictures.render(env, out, *size, view=args.view, say=tell, **acting)
  if args.json:
    emit({"env": args.env, "agent": args.agent or args.env, "fault": args.fault, **result})
  else:
    print(
      f"{result['file']}: {result['frames']} pictures, {result['fps']:g} a second, drawn by "
      f"{result['drawn_by']}"
    )
