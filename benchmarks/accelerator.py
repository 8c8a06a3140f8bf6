"""What a machine with an accelerator trains, lives and times, in slices that can be cut off.

  python benchmarks/accelerator.py --out runs/accelerator --slice 500 [--preset tiny] [--only STEP]
  python benchmarks/accelerator.py --out runs/accelerator --report   # the rows so far as a table

A slice does what it can in so many seconds and is called again until nothing is left: each step is
a process of its own, its rows are kept in OUT/rows.json when it ends, a training that is cut off
goes on from its checkpoint, a run likewise. With `--preset tiny` it is rehearsed on a CPU in
minutes; rows name the device that gave them, and what has not been measured says so.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

HERE = pathlib.Path(__file__).resolve()
SMALL = 30  # seconds that a step must have left to begin
GRACE = 90  # seconds that a step which is told to stop has for its checkpoint
STREAMS = {"tiny": (4, 8), "else": (40, 640, 2560)}
SEEDS = {"tiny": 2, "else": 10}
STEPS = ("update", "seeds", "lives", "train", "run")
NAMES = {
  "update": "an update of the preset's learner, 16 x 64",
  "seeds": "the same for several seeds in one program, a seed",
  "lives": "frozen walkers on MJX, acting and predicted, in one program",
  "train": "training of several seeds by the preset",
  "run": "the loop with the agent that came out",
}


def timed(call, rounds: int = 5) -> float:
  """Median seconds of a call that blocks; the first compiles."""
  import statistics

  call()
  seconds = []
  for _ in range(rounds):
    begin = time.perf_counter()
    call()
    seconds.append(time.perf_counter() - begin)
  return statistics.median(seconds)


def size_of(preset: str) -> str:
  """Size of a preset's learner."""
  from mjx_cl.config import PRESETS

  return PRESETS[preset].dreamer.size


def update(preset: str, out: pathlib.Path) -> list[dict]:
  """Seconds of an update."""
  from dreamer_update import updater

  call = updater(size_of(preset))
  return [{"name": NAMES["update"], "value": timed(call), "unit": "s"}]


def seeds(preset: str, out: pathlib.Path) -> list[dict]:
  """Seconds of an update of each seed, all in one program as `train --seeds` does it here."""
  from dreamer_update import updater

  from mjx_cl.io import runtime

  number = SEEDS.get(preset, SEEDS["else"])
  call = updater(size_of(preset), seeds=number, how=runtime.seeds_by())
  return [{"name": f"{NAMES['seeds']} of {number}", "value": timed(call) / number, "unit": "s"}]


def lives(preset: str, out: pathlib.Path) -> list[dict]:
  """Stream-steps a second of frozen walkers."""
  from recording import live

  from mjx_cl import envs
  from mjx_cl.training import agents

  env, rows = envs.make("walker", "mjx"), []
  trained = agents.of(env)
  for number in STREAMS.get(preset, STREAMS["else"]):
    act, look = live(env, trained, number, 64)
    seconds = timed(lambda act=act, look=look: look(act()), 3)
    rows.append(
      {
        "name": f"{NAMES['lives']}: {number}",
        "value": number * 64 / seconds,
        "unit": "stream-steps/s",
      }
    )
  return rows


def command(out: pathlib.Path, *words: str) -> None:
  """A command of the package, in this process."""
  from mjx_cl.cli import app

  resume = ["--resume"] if (out / "config.json").exists() else []
  code = app.main([*words, "--out", str(out), *resume])
  if code:
    raise SystemExit(code)


def train(preset: str, out: pathlib.Path) -> list[dict]:
  """Seconds of a training of several seeds, cut off or not."""
  number = SEEDS.get(preset, SEEDS["else"])
  begin = time.time()
  command(out / "train", "train", "walker", "--preset", preset, "--seeds", str(number))
  row = {"name": f"{NAMES['train']}, {number} seeds, last slice", "unit": "s"}
  return [row | {"value": time.time() - begin}]


def run(preset: str, out: pathlib.Path) -> list[dict]:
  """Seconds of a run with the first agent that was trained."""
  found = sorted((out / "train").rglob("card.json"))
  if not found:
    raise SystemExit("accelerator: step `run` needs the agent of step `train`")
  steps = ("--onset", "500", "--steps", "1500") if preset == "tiny" else ()
  begin = time.time()
  command(
    out / "run",
    *("run", "walker", "--agent", str(found[0].parent), "--seeds", "2" if steps else "10", *steps),
  )
  return [{"name": f"{NAMES['run']}, last slice", "value": time.time() - begin, "unit": "s"}]


def step(name: str, preset: str, out: pathlib.Path) -> None:
  """Does a step and keeps its rows."""
  sys.path.insert(0, str(HERE.parent))
  from mjx_cl.io import runtime

  runtime.setup()
  import jax

  rows = globals()[name](preset, out)
  device = jax.devices()[0].device_kind
  rows = [
    {"step": name, "preset": preset, "device": device, "platform": jax.default_backend()} | r
    for r in rows
  ]
  keep(out, [*kept(out), *rows])


def kept(out: pathlib.Path) -> list[dict]:
  """The rows so far."""
  path = out / "rows.json"
  return json.loads(path.read_text()) if path.exists() else []


def keep(out: pathlib.Path, rows: list[dict]) -> None:
  """Writes them: to another name, then renamed."""
  tmp = out / ".rows.json"
  tmp.write_text(json.dumps(rows, indent=1) + "\n")
  os.replace(tmp, out / "rows.json")


def report(out: pathlib.Path) -> None:
  """The rows as a table in Markdown; steps without any say so."""
  rows = kept(out)
  print("| | preset | device | value | unit |\n|---|---|---|---|---|")
  for name in STEPS:
    own = [r for r in rows if r["step"] == name]
    for r in own:
      print(f"| {r['name']} | {r['preset']} | {r['device']} | {r['value']:.4g} | {r['unit']} |")
    if not own:
      print(f"| {NAMES[name]} | | | not measured | |")


def slice_of(args: argparse.Namespace) -> int:
  """Does steps until the time is over; 0: nothing is left, 3: something is."""
  end = time.monotonic() + args.slice
  done = {r["step"] for r in kept(args.out)}
  for name in args.only or STEPS:
    if name in done:
      continue
    left = end - time.monotonic() - GRACE
    if left < SMALL:
      return 3
    words = ["--out", str(args.out), "--preset", args.preset, "--step", name]
    with subprocess.Popen([sys.executable, str(HERE), *words]) as process:
      try:
        code = process.wait(left)
      except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        try:
          process.wait(GRACE)
        except subprocess.TimeoutExpired:
          process.kill()
        print(f"accelerator: {name} goes on in the next slice", file=sys.stderr)
        return 3
    if code:
      return code
  return 0


def main() -> None:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
  )
  parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("runs/accelerator"))
  parser.add_argument("--slice", type=float, default=500.0, help="seconds of this call")
  parser.add_argument("--preset", default="paper", help="of `mjx-cl list presets`")
  parser.add_argument("--only", nargs="+", choices=STEPS)
  parser.add_argument("--report", action="store_true", help="prints the rows so far")
  parser.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)
  args = parser.parse_args()
  if args.report:
    return report(args.out)
  if args.slice < SMALL + GRACE:
    parser.error(f"--slice must be at least {SMALL + GRACE} s; got {args.slice:g}")
  args.out.mkdir(parents=True, exist_ok=True)
  if args.step:
    return step(args.step, args.preset, args.out)
  raise SystemExit(slice_of(args))


if __name__ == "__main__":
  main()
