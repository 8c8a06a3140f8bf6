"""Thresholds that `mjx-cl run --detector NAME` takes where none is given: python
benchmarks/thresholds.py [--board FOLDER ...] [--out FILE]

Writes mjx_cl/detectors/thresholds.json from leaderboards' own files, of which the first that has a
robot's detector counts: robot -> name on the board -> settings, threshold, ARL0 and the alarms that
it was counted from; of boards of another agent than the robot's own the same by agent. Left out are references, which look at nothing, the paper's rule, which has
figures of its own (`detectors.PAPER`), and what no threshold brings to that rate or the board
counted fewer than ten alarms of: the former stays silent, the latter has not been measured.
"""

from __future__ import annotations

import argparse
import pathlib
import sys

import pyarrow.parquet as parquet

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))  # for its neighbours
from benchmarks.report.report import load  # noqa: E402
from mjx_cl import detectors  # noqa: E402
from mjx_cl.cli import app  # noqa: E402
from mjx_cl.config import own_agent  # noqa: E402
from mjx_cl.detectors import baselines  # noqa: E402
from mjx_cl.errors import FileError  # noqa: E402
from mjx_cl.io import tables  # noqa: E402
from mjx_cl.leaderboard import score  # noqa: E402

FILE = pathlib.Path(detectors.__file__).parent / "thresholds.json"
LEAST = 10  # alarms
TROTS = "quadruped-trot", "quadruped-trot-2", "quadruped-trot-3"
FITTED = "car", "quadruped", *TROTS, "walker", "walker-2", "walker-3"
LATER = [
  *(f"results/learnt/{robot}" for robot in ("car", "quadruped", "walker")),
  *(f"results/innovations/{agent}" for agent in FITTED),
  # `multichart` apart, whose units are the thresholds of its charts
  "results/leaderboard_100k/quadruped-trot-2-multichart",
  "results/leaderboard_100k/quadruped-trot-2",
]
BOARDS = ["results/leaderboard_100k", *LATER]


def collect(folder: pathlib.Path) -> dict:
  """What the file holds. Raises FileError where the board's files are missing or foreign."""
  about = load(folder / "leaderboard.json")
  try:
    rows = parquet.read_table(
      folder / "leaderboard.parquet",
      columns=["detector", "robot", "threshold", "arl0", "arl0_alarms", "note"],
    ).to_pylist()
  except Exception as e:  # pyarrow raises of its own
    raise FileError(
      f"{folder / 'leaderboard.parquet'}: not a leaderboard's table ({str(e).splitlines()[0]})"
    ) from None
  known = score.variants()
  robots: dict[str, dict] = {}
  for row in rows:
    name = row["detector"]
    if (
      name not in known
      or name in detectors.PAPER
      or name in baselines.REFERENCES
      or row["threshold"] is None
      or row["arl0_alarms"] < LEAST
      or "asked" in (row["note"] or "")  # no threshold gives the asked rate
    ):
      continue
    settings = dict(known[name])
    use, channel = detectors.split(settings.pop("use"))
    settings = {"use": use} | ({"channel": channel} if channel else {}) | settings
    robots.setdefault(row["robot"], {})[name] = {
      "settings": settings,
      "threshold": row["threshold"],
      "arl0": row["arl0"],
      "alarms": row["arl0_alarms"],
    }
  try:
    head = {
      "command": about["command"],
      "arl0": about["arl0_target"],
      "seeds": about["seeds"]["tune"],
    }
  except (KeyError, TypeError):
    raise FileError(f"{folder / 'leaderboard.json'}: not a leaderboard's") from None
  agents = about.get("agents", {})
  out: dict[str, dict] = {"robots": {}, "agents": {}}
  for robot, own in sorted(robots.items()):
    agent = agents.get(robot, robot)
    shared = agent == own_agent(robot)
    out["robots" if shared else "agents"][robot if shared else agent] = dict(sorted(own.items()))
  return head | out


def joined(folders: list[pathlib.Path]) -> dict:
  """What the file holds, of several boards."""
  values, *others = [collect(folder) for folder in folders]
  for more in others:
    if more["arl0"] != values["arl0"]:
      raise FileError(f"boards at ARL0 {values['arl0']:,} and {more['arl0']:,}; give those of one")
    values["command"] += f"; {more['command']}"
    for kind in ("robots", "agents"):
      for name, own in more[kind].items():
        known = values[kind].get(name, {})
        values[kind][name] = dict(sorted((own | known).items()))
  return values


def main(args: argparse.Namespace) -> None:
  values = joined([pathlib.Path(folder) for folder in args.board])
  tables.write_json(pathlib.Path(args.out), values)
  print(
    f"{sum(map(len, values['robots'].values()))} thresholds of {', '.join(values['robots'])} "
    f"at ARL0 {values['arl0']:,} in {args.out}"
  )


if __name__ == "__main__":
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  parser.add_argument(
    "--board",
    nargs="+",
    default=BOARDS,
    help="folders that `mjx-cl leaderboard --out` wrote",
  )
  parser.add_argument("--out", default=str(FILE))
  sys.exit(app.attempt(lambda: main(parser.parse_args())))
