"""Pictures of results that are committed: the detectors' board as dots (results/leaderboard.png)
and what each fault costs each robot that does not adapt (docs/fault_map.png).

python benchmarks/pictures.py [leaderboard faults]
"""

from __future__ import annotations

import argparse
import pathlib

import numpy as np

from mjx_cl.io import tables
from mjx_cl.render import style

ROOT = pathlib.Path(__file__).resolve().parents[1]
RESULTS = ROOT / "results"
ROBOTS = ("walker", "quadruped", "car", "car_real")
ORACLE = "likelihood_ratio (oracle)"
DUMMIES = ("never", "always", "periodic", "random", "true onset (oracle)", ORACLE)


def leaderboard(pyplot) -> pathlib.Path:
  """Score of each detector over all faults with its interval, and on each robot; those that beat
  never alarming. Grey: up to what the likelihood-ratio oracle of OPR and RPR scores.
  """
  overall = {r["detector"]: r for r in tables.read_rows(RESULTS / "leaderboard_overall.parquet")}
  rows = tables.read_rows(RESULTS / "leaderboard.parquet")
  names = sorted(
    (n for n, r in overall.items() if n not in DUMMIES and r["cost_standard"] > 0),
    key=lambda n: overall[n]["cost_standard"],
  )
  robots = sorted({r["robot"] for r in rows}, key=ROBOTS.index)
  on = lambda name, robot: np.mean(
    [r["cost_standard"] for r in rows if (r["detector"], r["robot"]) == (name, robot)]
  )
  figure, axes = pyplot.subplots(
    1, 1 + len(robots), figsize=(9, 0.6 + 0.24 * len(names)), sharey=True, sharex=True
  )
  y = np.arange(len(names))
  for axis, robot in zip(axes, (None, *robots)):
    bound = overall[ORACLE]["cost_standard"] if robot is None else on(ORACLE, robot)
    axis.axvspan(0, bound, color="0.93", zorder=0)
    if robot is None:
      values = np.array([overall[n]["cost_standard"] for n in names])
      ends = np.array([[overall[n][f"cost_standard_{e}"] for n in names] for e in ("low", "high")])
      axis.errorbar(values, y, xerr=[values - ends[0], ends[1] - values], fmt="o", ms=4, lw=1)
    else:
      axis.plot([on(n, robot) for n in names], y, "o", ms=4)
    axis.set_title(robot or "all robots")
    axis.grid(axis="y", lw=0.3)
    axis.axvline(0, color="k", lw=0.8)
  axes[0].set_yticks(y, names)
  axes[0].set_xlim(left=-25)
  figure.supxlabel("score: 0 = never alarming, 100 = at the onset and never else", fontsize=9)
  return _saved(figure, RESULTS / "leaderboard.png")


def faults(pyplot) -> pathlib.Path:
  """Share of its return that a robot without adaptation loses to each fault at severity 1, the mean
  of its targets, by family.
  """
  rows = [
    r
    for r in tables.read_rows(RESULTS / "certificates.parquet")
    if r["return_lost"] is not None and r["family"] != "preset"
  ]
  families = list(dict.fromkeys(r["family"] for r in rows))
  names = sorted(
    {(r["family"], r["fault"]) for r in rows}, key=lambda x: (families.index(x[0]), x[1])
  )
  robots = [r for r in ROBOTS if any(row["robot"] == r for row in rows)]
  cost = np.full((len(robots), len(names)), np.nan)
  for i, robot in enumerate(robots):
    for j, (_, fault) in enumerate(names):
      own = [r for r in rows if (r["robot"], r["fault"]) == (robot, fault)]
      most = max((r["severity"] for r in own), default=0.0)
      lost = [r["return_lost"] / r["return_nominal"] for r in own if r["severity"] == most > 0]
      cost[i, j] = np.mean(lost) if lost else np.nan
  figure, axis = pyplot.subplots(figsize=(10, 1.2 + 0.5 * len(robots)))
  shown = axis.imshow(np.clip(cost, 0, 1), cmap="YlOrRd", vmin=0, vmax=1, aspect="auto")
  for (i, j), value in np.ndenumerate(cost):
    if np.isfinite(value):
      axis.text(j, i, f"{100 * value:.0f}", ha="center", va="center", fontsize=7,
                color="w" if value > 0.6 else "k")  # fmt: skip
  axis.set_xticks(range(len(names)), [fault for _, fault in names], rotation=60, ha="right")
  axis.set_yticks(range(len(robots)), robots)
  for j in range(1, len(names)):
    if names[j][0] != names[j - 1][0]:
      axis.axvline(j - 0.5, color="k", lw=1)
  for family in families:
    at = [j for j, (own, _) in enumerate(names) if own == family]
    axis.text(np.mean(at), -0.62, family, ha="center", va="bottom", fontsize=8)
  axis.spines[:].set_visible(False)
  axis.tick_params(length=0)
  figure.colorbar(shown, ax=axis, label="share of the return lost", pad=0.01)
  return _saved(figure, ROOT / "docs" / "fault_map.png")


def _saved(figure, path: pathlib.Path) -> pathlib.Path:
  figure.savefig(path, dpi=130, metadata={"Software": None})
  return path


PICTURES = {"leaderboard": leaderboard, "faults": faults}


def main() -> None:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
  )
  parser.add_argument("names", nargs="*", choices=(*PICTURES, []), default=[])
  args = parser.parse_args()
  import matplotlib

  matplotlib.use("Agg")
  from matplotlib import pyplot

  with style.look():
    pyplot.rcParams["figure.constrained_layout.use"] = True
    for name in args.names or PICTURES:
      print(PICTURES[name](pyplot))


if __name__ == "__main__":
  main()
