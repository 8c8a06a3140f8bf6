"""A campaign against the command line.

  python -m benchmarks.hostile run [--kinds input ...] [--minutes M] [--out DIR] [--shard K/N]
  python -m benchmarks.hostile run --cut          five minutes over all kinds, status 1 if one fails
  python -m benchmarks.hostile case input-17      one case, again
  python -m benchmarks.hostile table              tried, held, valid, failed by kind

Cases follow from --seed and their number. Finished ones, a line each in OUT/results.jsonl, are not
run again; what a failed one left lies in OUT/failed/CASE, with its command. See
docs/reliability.md.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import sys

from benchmarks.hostile import campaign, processes, room

CUT = {"input": 60, "kill": 2, "poor": 6, "foreign": 8}  # cases of a kind with --cut
CUT_MINUTES = 5.0


def names(kinds: list[str], shard: str, cut: bool, count: int | None) -> list[str]:
  """Names of the cases that are asked for, kinds by turns."""
  part, parts = map(int, shard.split("/"))
  numbers = {
    kind: min(campaign.KINDS[kind][1], CUT.get(kind, 0) if cut else count or 10**9)
    for kind in kinds
  }
  every = sorted(
    ((n + 0.5) / numbers[kind], kind, n) for kind in kinds for n in range(numbers[kind])
  )
  return [f"{kind}-{n}" for k, (_, kind, n) in enumerate(every) if k % parts == part]


def begin(out: pathlib.Path) -> None:
  """Makes what cases start from. They share a compile cache, else each would compile anew."""
  cache = os.environ.setdefault("MJX_CL_CACHE", str(out / "cache"))
  processes.ENVIRONMENT["MJX_CL_CACHE"] = cache
  room.make(out / "room")
  processes.warm()


def run(args: argparse.Namespace) -> int:
  out = args.out.resolve()
  begin(out)
  wanted = names(args.kinds, args.shard, args.cut, args.count)
  minutes = CUT_MINUTES if args.cut and args.minutes is None else args.minutes
  campaign.run(wanted, args.seed, out, minutes, args.again)
  found = [one for name, one in campaign.read(out).items() if name in set(wanted)]
  print(campaign.table(found))
  return int(any(one["how"] == "failed" for one in found))


def case(args: argparse.Namespace) -> int:
  out = args.out.resolve()
  begin(out)
  name = args.name if "-" in args.name else f"input-{args.name}"
  found = campaign.case(name, args.seed, out)
  for key, value in found._asdict().items():
    print(f"{key:8s} {value}")
  return int(found.verdict.how == "failed")


def table(args: argparse.Namespace) -> int:
  print(campaign.table(campaign.read(args.out).values()))
  return 0


def main(argv: list[str] | None = None) -> int:
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  commands = parser.add_subparsers(required=True)
  for do in (run, case, table):
    command = commands.add_parser(do.__name__)
    command.add_argument("--out", type=pathlib.Path, default=pathlib.Path("runs/hostile"))
    command.add_argument("--seed", type=int, default=0)
    command.set_defaults(do=do)
    if do is run:
      command.add_argument(
        "--kinds", nargs="+", choices=campaign.KINDS, default=list(campaign.KINDS)
      )
      command.add_argument("--minutes", type=float, help="stop after so many")
      command.add_argument("--count", type=int, help="the first so many of each kind")
      command.add_argument(
        "--cut", action="store_true", help="a few of each kind, five minutes at most"
      )
      command.add_argument("--again", action="store_true", help="those that failed, once more")
      command.add_argument("--shard", default="0/1", help="K/N: every N-th case from the K-th on")
    if do is case:
      command.add_argument("name", help="KIND-NUMBER")
  args = parser.parse_args(argv)
  return args.do(args)


if __name__ == "__main__":
  sys.exit(main())
