"""The model-free yardstick: brax PPO on the walker through `adapters.brax_env`, the demonstrator's
settings.

  python benchmarks/ppo_walker.py --steps 8000000 --out runs/ppo_walker --json

Prints rows {name, value, unit, goal, holds}. The published curves of model-free learners on
walker-walk end above 900; `holds` of the last row says whether this one does. The figure of
DreamerV3's agent to compare with is that of `mjx-cl eval walker`.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile


def rows_of(curve: list[dict]) -> list[dict]:
  """Rows from the evaluations {step, return, seconds} of a training; the first is before any step."""
  row = lambda name, value, unit, goal=None, holds=None: {
    "name": name,
    "value": value,
    "unit": unit,
    "goal": goal,
    "holds": holds,
  }
  last = curve[-1]
  rows = [
    row(f"PPO walker, return after {r['step']:,} steps", r["return"], "reward per episode")
    for r in curve
  ]
  for level in (500, 900):
    reached = next((r for r in curve if r["return"] >= level), None)
    rows.append(
      row(
        f"PPO walker, control steps until a return of {level}",
        reached and reached["step"],
        "control steps",
      )
    )
    rows.append(
      row(f"PPO walker, seconds until a return of {level}", reached and reached["seconds"], "s")
    )
  rows.append(
    row("PPO walker, control steps per second", last["step"] / max(last["seconds"], 1e-9), "1/s")
  )
  rows.append(
    row(
      "PPO walker, last return",
      last["return"],
      "reward per episode",
      ">= 900",
      bool(last["return"] >= 900),
    )
  )
  return rows


def main() -> None:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
  )
  parser.add_argument("--steps", type=int, default=8_000_000, help="control steps")
  parser.add_argument("--seed", type=int, default=0)
  parser.add_argument(
    "--evals", type=int, default=12, help="evaluations, the first before any step"
  )
  parser.add_argument("--physics", default="auto")
  parser.add_argument(
    "--out",
    default=None,
    help="folder to keep policies and curve.json in; default: nothing is kept",
  )
  parser.add_argument("--json", action="store_true", help="one JSON value on standard output")
  args = parser.parse_args()
  if args.steps < 1 or args.evals < 2:
    parser.error("--steps must be above 0 and --evals above 1")
  from mjx_cl.io import runtime

  runtime.setup()
  from mjx_cl import envs
  from mjx_cl.training import demonstrator

  say = lambda row: print(
    f"step {row['step']:,}: return {row['return']:.0f}, {row['seconds']:.0f} s",
    file=sys.stderr,
    flush=True,
  )
  env = envs.make("walker", args.physics)
  with tempfile.TemporaryDirectory() as scratch:
    rows = rows_of(
      demonstrator.train(env, args.out or scratch, args.steps, args.seed, args.evals, say)
    )
  if args.json:
    print(json.dumps(rows))
  else:
    for row in rows:
      print(
        (
          f"{row['name']}: {row['value'] if row['value'] is None else round(row['value'], 1)} "
          f"{row['unit']} {row['goal'] or ''}"
        ).rstrip()
      )


if __name__ == "__main__":
  main()
