"""What an accelerator does with the whole loop, in slices that may be cut off.

  python benchmarks/accelerator.py --out runs/gpu                 size12m, slices of 8 minutes
  python benchmarks/accelerator.py --out runs/rehearsal --quick   on any machine, with `tiny`
  python benchmarks/accelerator.py --table runs/*/rows.json       machines side by side

A call works for `--minutes` at most, leaves what it has done in OUT and may be called again until
it says that all is done: updates of one seed and of several by vmap (timed), a training of several
seeds in one program (checkpoints), control steps a second of frozen streams (timed), a run with and
without adaptation in one band of streams (checkpoints). All programs are those of the command line.
OUT/rows.json: {machine, rows: {name: value}}.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import signal
import subprocess
import sys
import time

HERE = pathlib.Path(__file__).resolve()
REST_S = 60  # a command that is told to stop has as long to save
FULL = {
  "preset": "paper",
  "sets": ["updates=20000"],
  "seeds": 4,
  "streams": [40, 160, 640, 2560],
  "run": ["--seeds", "40", "--steps", "25000", "--onset", "5000"],
}
QUICK = {
  "preset": "tiny",
  "sets": ["updates=24", "envs=4", "ratio=8", "capacity=256"],
  "seeds": 2,
  "streams": [2, 4],
  "run": ["--seeds", "2", "--steps", "640", "--onset", "256"],
}
UNITS = {"update": "ms", "streams": "control steps/s", "training": "records/s", "run": "s"}


# ---- one measurement, in a process of its own: an accelerator's memory goes with it --------------


def update(plan: dict, rounds: int) -> dict[str, float]:
  """Milliseconds of an update of one seed, and per seed of several in one program."""
  from dreamer_update import Clock, updater

  from mjx_cl.config import PRESETS
  from mjx_cl.io import runtime

  runtime.setup()
  dreamer, seeds = PRESETS[plan["preset"]].dreamer, plan["seeds"]
  size, starts, how = dreamer.size, dreamer.last_starts, runtime.seeds_by()
  times = Clock().measure(
    {
      "one seed": updater(size, starts),
      f"of {seeds} seeds, each": updater(size, starts, seeds=seeds, how=how),
    },
    rounds,
  )
  return {
    f"update, {size}, {name}": 1e3 * seconds / (seeds if "seeds" in name else 1)
    for name, seconds in times.items()
  }


def streams(plan: dict, out: pathlib.Path, count: int, rounds: int) -> dict[str, float]:
  """Control steps a second of frozen walkers: acting, physics, predictions, detector, signals."""
  from mjx_cl.config import CHUNK, RunConfig
  from mjx_cl.io import runtime
  from mjx_cl.runs.runner import Runner

  runtime.setup()
  config = RunConfig(
    env="walker",
    fault="none",
    seeds=count,
    arms=("none",),
    steps=10**6,
    agent=str(out / "train/agent"),
  )
  runner, times = Runner(config, out / "streams"), []
  for _ in range(rounds + 2):  # the first two compile
    begin = time.perf_counter()
    runner.step()
    times.append(time.perf_counter() - begin)
  return {f"streams, {count} frozen": count * CHUNK / sorted(times[2:])[rounds // 2]}


# ---- slices --------------------------------------------------------------------------------------


def command(words: list[str], out: pathlib.Path, left: float) -> bool:
  """Runs or resumes a command of mjx-cl for `left` seconds: whether it has come to its end.

  Raises:
    SystemExit: it failed; its words stand on standard error.
  """
  again = ["--resume"] if (out / "config.json").exists() else []
  process = subprocess.Popen([sys.executable, "-m", "mjx_cl", *words, "--out", str(out), *again])
  try:
    status = process.wait(left)
  except (subprocess.TimeoutExpired, KeyboardInterrupt):
    process.send_signal(signal.SIGINT)
    try:
      process.wait(REST_S)
    except subprocess.TimeoutExpired:
      process.kill()  # its last checkpoint holds
      process.wait()
    return False
  if status not in (0, 130):
    raise SystemExit(f"mjx-cl {words[0]} ended with status {status}")
  return status == 0


def measured(task: str, args: argparse.Namespace, left: float) -> dict[str, float] | None:
  """Rows of a measurement, None where `left` seconds did not suffice."""
  words = [sys.executable, str(HERE), "--out", str(args.out), "--task", task]
  try:
    done = subprocess.run(
      words + ["--quick"] * args.quick, timeout=left, stdout=subprocess.PIPE, text=True
    )
  except subprocess.TimeoutExpired:
    return None
  if done.returncode:
    raise SystemExit(f"{task} ended with status {done.returncode}")
  return json.loads(done.stdout.splitlines()[-1])


def trained(out: pathlib.Path) -> dict[str, float]:
  card = json.loads((out / "train/agent/card.json").read_text())
  seeds = json.loads((out / "train/config.json").read_text())["seeds"]
  return {f"training, {seeds} seeds": seeds * card["records"] / card["seconds"]}


def work(args: argparse.Namespace) -> bool:
  """Does what is left, in the order of `tasks`, until the time is over: whether all is done."""
  from mjx_cl.io import tables

  plan, out = QUICK if args.quick else FULL, args.out
  end = time.monotonic() + 60 * args.minutes
  file = out / "rows.json"
  held = json.loads(file.read_text()) if file.exists() else {"done": [], "rows": {}}
  tasks = ["update", "training", *(f"streams-{n}" for n in plan["streams"]), "run"]
  for task in tasks:
    if task in held["done"]:
      continue
    left = end - time.monotonic()
    if left < 5:
      return False
    print(f"{task}: {left / 60:.1f} minutes left", file=sys.stderr, flush=True)
    begin = time.monotonic()
    if task == "training":
      seeds, sets = str(plan["seeds"]), plan["sets"]
      words = ["train", "walker", "--preset", plan["preset"], "--seeds", seeds, "--set", *sets]
      rows = trained(out) if command(words, out / "train", left) else None
    elif task == "run":
      words = ["run", "walker", *plan["run"], "--arm", "oracle", "none"]
      words += ["--agent", str(out / "train/agent")]
      spent = held["rows"].get("run, slices", 0.0)
      whole = command(words, out / "run", left)
      held["rows"]["run, slices"] = spent + time.monotonic() - begin
      rows = {} if whole else None
    else:
      rows = measured(task, args, left)
    if rows is not None:
      held["done"].append(task)
      held["rows"] |= rows
    held["machine"] = held.get("machine") or measured("machine", args, 600)["machine"]
    tables.write_json(file, held)
    if rows is None:
      return False
  return True


# ---- in front ------------------------------------------------------------------------------------


def table(files: list[pathlib.Path]) -> str:
  """A Markdown table, a column a machine; what one has not measured says so."""
  held = [json.loads(file.read_text()) for file in files]
  names = sorted({name for one in held for name in one["rows"]})
  lines = [
    "| | " + " | ".join(one["machine"] for one in held) + " |",
    "|---" * (len(held) + 1) + "|",
  ]
  for name in names:
    cells = [one["rows"].get(name) for one in held]
    unit = UNITS[name.split(",")[0]]
    told = " | ".join("not measured" if x is None else f"{x:,.4g}" for x in cells)
    lines.append(f"| {name} [{unit}] | {told} |")
  return "\n".join(lines)


def machine() -> dict[str, str]:
  """The accelerator, or the processor and how many cores of it."""
  from mjx_cl.io import runtime

  runtime.setup()
  import jax

  device = jax.devices()[0]
  cpu = runtime.provenance()["machine"]
  return {
    "machine": f"{cpu['cores']} cores of {cpu['cpu']}"
    if device.platform == "cpu"
    else device.device_kind
  }


def main() -> int:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
  )
  parser.add_argument("--out", type=pathlib.Path, default=pathlib.Path("runs/accelerator"))
  parser.add_argument("--minutes", type=float, default=8.0, help="of this call, saving apart")
  parser.add_argument("--quick", action="store_true", help="the rehearsal: preset tiny, two seeds")
  parser.add_argument("--table", nargs="+", type=pathlib.Path, help="rows.json of several machines")
  parser.add_argument("--task", help=argparse.SUPPRESS)
  args = parser.parse_args()
  if args.table:
    print(table(args.table))
    return 0
  plan, rounds = QUICK if args.quick else FULL, 3 if args.quick else 10
  if args.task:
    kind, _, count = args.task.partition("-")
    rows = {
      "machine": machine,
      "update": lambda: update(plan, rounds),
      "streams": lambda: streams(plan, args.out, int(count), rounds),
    }[kind]()
    print(json.dumps(rows))
    return 0
  args.out.mkdir(parents=True, exist_ok=True)
  done = work(args)
  print(table([args.out / "rows.json"]) if (args.out / "rows.json").exists() else "")
  print("all is done" if done else "not done: the same command goes on")
  return 0


if __name__ == "__main__":
  sys.exit(main())
