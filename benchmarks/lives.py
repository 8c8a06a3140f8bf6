"""What a life costs, beside the same work in a checkout of an earlier version, by turns:

  git worktree add ../base 10f2717
  python benchmarks/lives.py [--base ../base] [--rounds 5] [--whole] [--json] [--figure FILE]
  python benchmarks/lives.py --of results/lives.json --figure docs/lives.png

Chunks of 64 control steps of walkers, as `mjx-cl run walker` lives them. Each version has a process
of its own that lives through everything once before anything is timed; then they take turns, and
rows are medians. `start` is a new process: from its first import to the end of its first chunk,
with an empty compile cache and with a filled one. `--whole` runs the README's main job once with
each version, programs cached, and draws where its time went. Nothing else should run on the
machine.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

HERE = pathlib.Path(__file__).resolve()
CHUNK, SEEDS, UPDATES = 64, 10, 4  # UPDATES: of a learner in a chunk
NEVER = 10**6  # later than anything here
STEPS = 25_000  # of the runs
MAIN = ("run", "walker", "--seeds", str(SEEDS))
# name -> (arms, seeds, AdaptConfig's settings, onset)
SCENES = {
  "healthy": (("detector", "none"), SEEDS, {"warmup": NEVER}, STEPS),
  "idle": (("oracle",), SEEDS, {"warmup": 0, "start_windows": NEVER}, CHUNK),
  "learning": (("oracle",), SEEDS, {"warmup": 0, "start_windows": 1}, CHUNK),
  **{f"frozen {n}": (("none",), n, {}, STEPS) for n in (40, 160, 640, 2560)},
}
GOALS = {"main job": 0.45, "start, empty cache": 0.4, "update": 0.6}


# ---- in the process of a version -----------------------------------------------------------------


def serve() -> None:
  """Answers scenes on standard input, one name a line, with the seconds of a chunk."""
  from mjx_cl.config import AdaptConfig, RunConfig

  try:
    from mjx_cl.runs.runner import Runner
  except ImportError:  # before there were rooms
    from mjx_cl.run import Runner

    from mjx_cl import runtime

    runtime.setup()
  else:
    from mjx_cl.io import runtime

    runtime.setup()
  runners: dict = {}
  for line in sys.stdin:
    name = line.strip()
    if name not in runners:
      runners.clear()  # memory
      arms, seeds, adapt, onset = SCENES[name]
      config = RunConfig(
        env="walker",
        fault="walker/gear-half",
        seeds=seeds,
        arms=arms,
        steps=STEPS,
        onset=onset,
        adapt=AdaptConfig(**adapt),
        detector="rolling_sigma",
      )
      runners[name] = Runner(config, tempfile.mkdtemp())
      for _ in range(6 if onset == CHUNK else 1):
        runners[name].step()
    begin = time.perf_counter()
    runners[name].step()
    print(json.dumps(time.perf_counter() - begin), flush=True)


# ---- in the process that asks --------------------------------------------------------------------


class Version:
  """A checkout and its process."""

  def __init__(self, folder: pathlib.Path) -> None:
    self.folder = folder
    self.cache = tempfile.mkdtemp(prefix="mjx_cl_lives_")
    self.process = self.begin(self.cache)

  def environment(self, cache: str) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(self.folder), "MJX_CL_CACHE": cache}

  def begin(self, cache: str) -> subprocess.Popen:
    return subprocess.Popen(
      [sys.executable, str(HERE), "--serve"],
      cwd=self.folder,
      env=self.environment(cache),
      stdin=subprocess.PIPE,
      stdout=subprocess.PIPE,
      stderr=subprocess.DEVNULL,
      text=True,
    )

  def chunk(self, scene: str, process: subprocess.Popen | None = None) -> float:
    """Seconds of one more chunk of a scene."""
    process = process or self.process
    process.stdin.write(scene + "\n")
    process.stdin.flush()
    return json.loads(process.stdout.readline())

  def start(self, cache: str) -> float:
    """Seconds of a new process up to the end of its first chunk."""
    begin = time.perf_counter()
    process = subprocess.Popen(
      [
        sys.executable,
        "-m",
        "mjx_cl",
        *MAIN,
        "--steps",
        str(CHUNK),
        "--onset",
        "0",
        "--out",
        tempfile.mkdtemp() + "/run",
      ],
      cwd=self.folder,
      env=self.environment(cache),
      stdout=subprocess.PIPE,
      stderr=subprocess.STDOUT,
      text=True,
    )
    for line in process.stdout:
      if line.startswith("step "):
        break
    took = time.perf_counter() - begin
    process.communicate()
    return took

  def whole(self) -> tuple[float, dict]:
    """Seconds of the main job, and its shares."""
    out = tempfile.mkdtemp() + "/run"
    begin = time.perf_counter()
    subprocess.run(
      [sys.executable, "-m", "mjx_cl", *MAIN, "--out", out],
      cwd=self.folder,
      env=self.environment(self.cache),
      check=True,
      capture_output=True,
    )
    took = time.perf_counter() - begin
    return took, json.loads((pathlib.Path(out) / "summary.json").read_text())["wall_share"]


def by_turns(versions: list[Version], measure, rounds: int) -> list[float]:
  """Median of each version."""
  times = [[measure(v) for v in versions] for _ in range(rounds)]
  return [statistics.median(column) for column in zip(*times)]


def row(name: str, unit: str, values: list[float], factor: float = 1.0) -> dict:
  base = values[1] * factor if len(values) > 1 else None
  ratio = values[0] / values[1] if len(values) > 1 else None
  goal = GOALS.get(name)
  return {
    "name": name,
    "value": round(values[0] * factor, 3),
    "unit": unit,
    "base": base and round(base, 3),
    "ratio": ratio and round(ratio, 3),
    "goal": goal,
    "holds": None if goal is None or ratio is None else ratio <= goal,
  }


def price(versions: list[Version], rounds: int) -> list[dict]:
  """All rows but the main job."""
  rows = [
    row("start, empty cache", "s", by_turns(versions, lambda v: v.start(tempfile.mkdtemp()), 1)),
  ]
  chunks = {}
  for scene in SCENES:
    large = scene.startswith("frozen") and scene != "frozen 40"
    some = versions[:1] if large else versions
    for v in some:
      v.chunk(scene)  # compiles
    chunks[scene] = by_turns(some, lambda v, scene=scene: v.chunk(scene), 1 if large else rounds)
  streams = {name: len(arms) * seeds for name, (arms, seeds, *_) in SCENES.items()}
  for scene, values in chunks.items():
    rows.append(row(f"{scene}, a stream", "ms a chunk", values, 1e3 / streams[scene]))
  cores = len(os.sched_getaffinity(0))
  update = [(a - b) / (SEEDS * UPDATES) for a, b in zip(chunks["learning"], chunks["idle"])]
  rows.append(row("update", "core-ms", update, 1e3 * cores))
  rows.append(row("start, filled cache", "s", by_turns(versions, lambda v: v.start(v.cache), 2)))
  return rows


def draw(job: dict, path: pathlib.Path) -> None:
  """Where the main job's time goes, of its row: a bar for each version, newest on top."""
  import matplotlib

  matplotlib.use("Agg")
  import matplotlib.pyplot as plt

  from mjx_cl.render.style import nth

  wholes = [x for x in (job["base"], job["value"]) if x is not None]
  parts = [
    share | {"other": whole - sum(share.values())}
    for share, whole in zip(job["seconds"][::-1], wholes)
  ]
  figure, axis = plt.subplots(figsize=(7, 1.4 + 0.6 * len(parts)))
  for i, part in enumerate(parts):
    left = 0.0
    for k, (kind, width) in enumerate(part.items()):
      axis.barh(i, width, left=left, color=nth(k), label=kind if not i else None)
      if width > 20:
        axis.text(left + width / 2, i, f"{width:.0f}", ha="center", va="center", color="white")
      left += width
    axis.text(left + 5, i, f"{left:.0f} s", va="center")
  axis.set_yticks(range(len(parts)), ["before (10f2717)", "now"][-len(parts) :])
  axis.set_xlim(0, 1.12 * max(wholes))
  axis.set_xlabel("seconds of the main job: ten walkers in two arms, 25,000 steps, programs cached")
  axis.spines[["top", "right"]].set_visible(False)
  axis.legend(
    ncols=len(parts[0]),
    fontsize="small",
    loc="lower center",
    bbox_to_anchor=(0.5, 1.0),
    frameon=False,
  )
  figure.tight_layout()
  figure.savefig(path, dpi=130)


def main() -> None:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
  )
  parser.add_argument("--base", type=pathlib.Path, help="checkout of an earlier version")
  parser.add_argument("--rounds", type=int, default=5)
  parser.add_argument("--whole", action="store_true", help="the main job as well")
  parser.add_argument("--json", action="store_true", help="one JSON value on standard output")
  parser.add_argument("--figure", type=pathlib.Path, help="draws where the main job's time goes")
  parser.add_argument("--of", type=pathlib.Path, help="measure nothing: draw from what --json gave")
  parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
  args = parser.parse_args()
  if args.serve:
    return serve()
  if args.of:
    (job,) = (r for r in json.loads(args.of.read_text()) if r["name"] == "main job")
    draw(job, args.figure)
    return None
  folders = [HERE.parents[1]] + ([args.base.resolve()] if args.base else [])
  versions = [Version(folder) for folder in folders]
  rows = price(versions, args.rounds)
  if args.whole or args.figure:
    for v in versions:
      v.process.stdin.close()
    told = [v.whole() for v in versions]
    rows.append(row("main job", "s", [seconds for seconds, _ in told]))
    rows[-1]["seconds"] = [
      {kind: seconds * part for kind, part in share.items()} for seconds, share in told
    ]
    if args.figure:
      draw(rows[-1], args.figure)
  for r in rows:
    print(
      f"{r['name']:28s} {r['value']:>9} {r['unit']:10s} base {r['base'] or '-':>9} "
      f"ratio {r['ratio'] or '-'}",
      file=sys.stderr,
    )
  if args.json:
    print(json.dumps(rows))


if __name__ == "__main__":
  main()
