"""A suite of four equal parts on a Ray cluster of two machines of a core each, against `--jobs 2`,
by turns, programs cached: wall and processor seconds of the processes that run parts.

  python benchmarks/cluster.py [--steps 3000] [--turns 2]
  python benchmarks/cluster.py --plan full [--seeds 40] [--agents 3] [--cores 1 16 256]

With --plan nothing is run: `bench --plan` for one core of this machine, every part once for each
agent, given to so many cores longest first; whole, or with its seeds in shares of eight, which
`bench --merge` joins.

Both ways a process runs part after part; the start of each is in what is measured. The processor
seconds say more than the wall's beside other work.
"""

from __future__ import annotations

import argparse
import dataclasses
import heapq
import json
import os
import pathlib
import tempfile
import threading
import time

import psutil

from mjx_cl.io import runtime

WORKER = "mjx_cl.cli.worker"
SUITE = """name = "equal"
[entries.walker]
env = "walker"
fault = "gear"
target = "right_hip"
severity = [0.4, 0.5, 0.6, 0.7]
seeds = 1
arms = ["none"]
onset = 1000
steps = """


class Processor(threading.Thread):
  """Adds up the processor seconds of processes of parts, as they were last seen."""

  def __init__(self) -> None:
    super().__init__(daemon=True)
    self.seen: dict[int, float] = {}
    self.over = threading.Event()

  def run(self) -> None:
    """Looks five times a second."""
    while not self.over.wait(0.2):
      for process in psutil.process_iter(["cmdline", "cpu_times"]):
        if WORKER in (process.info["cmdline"] or []):
          self.seen[process.pid] = sum(process.info["cpu_times"][:2])


def timed(run, plan):
  """(wall, processor) seconds of `run(folder, names)` on a new folder."""
  from mjx_cl.runs import suite as suites

  with tempfile.TemporaryDirectory() as folder:
    suites.write_plan(plan, folder)
    watch, begin = Processor(), time.perf_counter()
    watch.start()
    run(folder, [part.name for part in plan.parts])
    wall = time.perf_counter() - begin
    watch.over.set()
    watch.join()
    return wall, sum(watch.seen.values())


def makespan(seconds: list[float], cores: int) -> float:
  """Until the last of the parts has ended, the longest begun first on the first core that is free."""
  free = [0.0] * cores
  for one in sorted(seconds, reverse=True):
    heapq.heappush(free, heapq.heappop(free) + one)
  return max(free)


def planned(name: str, seeds: int, agents: int, cores: list[int]) -> None:
  """Prints a JSON row for each number of cores."""
  os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
  runtime.setup()
  from mjx_cl.runs import costs
  from mjx_cl.runs import suite as suites

  robots, rate = costs.Robots(), costs.matmul_rate()
  cost = lambda part, n: (
    costs.estimate(
      part._replace(config=dataclasses.replace(part.config, seeds=n)), rate, robots
    ).seconds
  )
  parts = suites.suite(name).parts
  shares = [8] * (seeds // 8) + [seeds % 8] * (seeds % 8 > 0)
  ways = {
    "whole": [cost(part, seeds) for part in parts] * agents,
    "shares": [cost(part, n) for part in parts for n in shares] * agents,
  }
  for way, seconds in ways.items():
    for n in cores:
      took = makespan(seconds, n)
      row = {"suite": name, "parts": way, "number": len(seconds), "cores": n}
      row |= {"hours": took / 3600, "of_ideal": sum(seconds) / n / took}
      row |= {"longest_h": max(seconds) / 3600, "stops_at": int(sum(seconds) / max(seconds))}
      print(json.dumps(row | {"gflops": rate / 1e9}), flush=True)


def main() -> None:
  """Prints a JSON row for each turn."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("--steps", type=int, default=3000)
  parser.add_argument("--turns", type=int, default=2)
  parser.add_argument("--plan", metavar="SUITE")
  parser.add_argument("--seeds", type=int, default=40)
  parser.add_argument("--agents", type=int, default=3)
  parser.add_argument("--cores", type=int, nargs="+", default=[1, 16, 256])
  args = parser.parse_args()
  if args.plan:
    return planned(args.plan, args.seeds, args.agents, args.cores)
  os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
  # Ray's is 15: other work on this machine would weigh on its parts alone
  os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112  Ray spells it so
  root = str(pathlib.Path(__file__).parents[1])
  os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
  runtime.setup()
  from ray.cluster_utils import Cluster

  from mjx_cl.runs import cluster, workers
  from mjx_cl.runs import suite as suites

  with tempfile.NamedTemporaryFile("w", suffix=".toml") as file:
    file.write(f"{SUITE}{args.steps}\n")
    file.flush()
    plan = suites.suite(file.name)
  made = Cluster()
  made.add_node(num_cpus=0, include_dashboard=False)
  for _ in range(2):
    made.add_node(num_cpus=1)
  made.wait_for_nodes()
  nothing = lambda *_: None
  on = cluster.Cluster(made.address)
  ways = {
    "jobs": lambda out, names: workers.together(WORKER, out, names, 2, nothing),
    "ray": lambda out, names: cluster.together(
      WORKER, out, names, dict.fromkeys(names, 2**20), nothing, on=on
    ),
  }
  for turn in range(args.turns + 1):  # the first fills the cache and is not counted
    for way, run in ways.items():
      wall, processor = timed(run, plan)
      row = {"turn": turn, "way": way, "wall_s": round(wall, 1), "cpu_s": round(processor, 1)}
      print(json.dumps(row | {"steps": args.steps, "load": os.getloadavg()[0]}), flush=True)
  made.shutdown()


if __name__ == "__main__":
  main()
