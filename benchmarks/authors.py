"""An update of DreamerV3 beside one of the authors' own code, by turns.

  git clone https://github.com/danijar/dreamerv3 ../dreamerv3
  git -C ../dreamerv3 checkout e3f0224
  python -m venv ../authors
  ../authors/bin/pip install jax==0.5.3 chex einops elements granular ninjax optax portal \\
    ruamel.yaml
  python benchmarks/authors.py --code ../dreamerv3 --python ../authors/bin/python [--json]

Both: size1m, 24 numbers observed, 6 actions, 16 x 64 replayed records and the one before each,
15 steps imagined from all 1,024 states, float32, random data, one process each on all cores; theirs
as its configs.yaml has it, but for platform and precision. Each compiles and takes an update before
anything is timed; then they take turns. Nothing else should run on the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import statistics
import subprocess
import sys
import time

HERE = pathlib.Path(__file__).resolve()
BATCH, LENGTH, OBS, ACT = 16, 64, 24, 6


def theirs(code: str):
  """A function that takes one of their updates and blocks."""
  sys.path.insert(0, code)
  import elements
  import jax
  import numpy as np
  import ruamel.yaml
  from dreamerv3.agent import Agent

  known = ruamel.yaml.YAML(typ="safe").load(
    pathlib.Path(code, "dreamerv3/configs.yaml").read_text()
  )
  config = elements.Config(known["defaults"]).update(known["size1m"])
  config = config.update({"jax.platform": "cpu", "jax.compute_dtype": "float32"})
  config = config.update({"batch_size": BATCH, "batch_length": LENGTH})
  own = dict(config.jax) | {"precompile": False, "enable_policy": False}
  scalar = lambda kind, *ends: elements.Space(kind, (), *ends)
  flags = {name: scalar(bool) for name in ("is_first", "is_last", "is_terminal")}
  observed = {"state": elements.Space(np.float32, (OBS,)), "reward": scalar(np.float32), **flags}
  acted = {"action": elements.Space(np.float32, (ACT,), -1.0, 1.0)}
  shared = (
    "seed",
    "batch_size",
    "batch_length",
    "replay_context",
    "report_length",
    "replica",
    "replicas",
  )
  agent = Agent(
    observed,
    acted,
    elements.Config(
      **config.agent, logdir="/nonexistent", jax=own, **{name: config[name] for name in shared}
    ),
  )
  random = np.random.default_rng(0)
  shape = (BATCH, LENGTH + config.replay_context)

  def values(name, space):
    if space.dtype == bool:
      return np.zeros((*shape, *space.shape), bool)
    if np.issubdtype(space.dtype, np.floating):
      return random.uniform(-1, 1, (*shape, *space.shape)).astype(space.dtype)
    return np.zeros((*shape, *space.shape), space.dtype)

  data = {name: values(name, space) for name, space in agent.spaces.items()}
  data["is_first"][:, 0] = True
  stream = iter(agent.stream(iter(lambda: {k: v.copy() for k, v in data.items()}, None)))
  carry = [agent.init_train(BATCH)]

  def run() -> None:
    carry[0], *_ = agent.train(carry[0], next(stream))
    jax.block_until_ready(agent.params)

  return run


def ours():
  """A function that takes one of our updates and blocks."""
  sys.path[:0] = [str(HERE.parent), str(HERE.parents[1])]
  from dreamer_update import updater

  from mjx_cl.io import runtime

  runtime.setup()
  return updater("size1m")


def serve(code: str | None) -> None:
  """Takes an update for each line on standard input and answers with its seconds."""
  said = os.dup(1)
  os.dup2(2, 1)  # what a library prints is no answer
  run = theirs(code) if code else ours()
  run()
  for _ in sys.stdin:
    begin = time.perf_counter()
    run()
    os.write(said, f"{time.perf_counter() - begin}\n".encode())


def measure(python: str, code: str, rounds: int) -> dict[str, list[float]]:
  """Seconds of each update, theirs and ours by turns."""
  argv = {
    "theirs": [python, str(HERE), "--serve", code],
    "ours": [sys.executable, str(HERE), "--serve"],
  }
  served = {
    name: subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    for name, words in argv.items()
  }
  times: dict[str, list[float]] = {name: [] for name in served}
  try:
    for k in range(rounds + 1):
      for name, process in served.items():
        process.stdin.write("\n")
        process.stdin.flush()
        line = process.stdout.readline()
        if not line:
          raise SystemExit(f"{name}: the process ended, see above")
        if k:  # the other was compiling in the first
          times[name].append(float(line))
  finally:
    for process in served.values():
      process.kill()
      process.wait()
  return times


def main() -> None:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
  )
  parser.add_argument("--code", type=pathlib.Path, help="their repository")
  parser.add_argument("--python", default=sys.executable, help="that has what their code needs")
  parser.add_argument("--rounds", type=int, default=15)
  parser.add_argument("--json", action="store_true")
  parser.add_argument("--serve", nargs="?", const="", help=argparse.SUPPRESS)
  args = parser.parse_args()
  if args.serve is not None:
    serve(args.serve or None)
    return
  if args.code is None or not (args.code / "dreamerv3" / "agent.py").is_file():
    parser.error("--code takes a checkout of github.com/danijar/dreamerv3")
  times = measure(args.python, str(args.code.resolve()), args.rounds)
  median = {name: statistics.median(own) for name, own in times.items()}
  by_turn = [a / b for a, b in zip(times["theirs"], times["ours"])]
  value = {
    "theirs_s": median["theirs"],
    "ours_s": median["ours"],
    "ratio": statistics.median(by_turn),
    "ratio_quartiles": statistics.quantiles(by_turn, n=4)[::2],
    "rounds": args.rounds,
  }
  if args.json:
    print(json.dumps(value))
  else:
    low, high = value["ratio_quartiles"]
    print(
      f"theirs {value['theirs_s']:.3f} s, ours {value['ours_s']:.3f} s; theirs over ours, turn by "
      f"turn: {value['ratio']:.2f} (quartiles {low:.2f}, {high:.2f})"
    )


if __name__ == "__main__":
  main()
