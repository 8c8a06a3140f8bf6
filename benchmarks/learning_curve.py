"""Draws the learning curve of a pretraining from its metrics.parquet.

  python benchmarks/learning_curve.py runs/train results/walker_agent [--published] [--then runs/on]

One line per seed, the mean with its 95 % bootstrap interval over seeds where there are several,
against updates, records and wall time; `--published` adds DreamerV3's own walker-walk curve.
`--then` is a training that began with the agent of the first (`--agent runs/train/agent`, its seed
0): its line goes on where that one ended, in `then.parquet` too; of the wall time of seeds trained
side by side it inherits one share.
"""

from __future__ import annotations

import argparse
import pathlib

# danijar/dreamerv3, scores/dmc_proprio-dreamerv3.json.gz, walker_walk: mean of five seeds' training
# episodes in bins of 10,000 environment steps;
# 2024 protocol: size12m, action repeat 2, train ratio 512, hence 0.25 updates and half a record per
# environment step
PUBLISHED = {
  10_000: 43,
  50_000: 289,
  90_000: 481,
  130_000: 595,
  170_000: 797,
  210_000: 856,
  250_000: 890,
  330_000: 936,
  450_000: 954,
}


def curves(table: dict) -> dict:
  """{seed: (rows, returns)}: the rows at which episodes of a seed ended, and their mean return."""
  import numpy as np

  seeds = sorted(int(name.split("/")[1]) for name in table if name.startswith("return/")) or [None]
  out = {}
  for seed in seeds:
    values = table["return" if seed is None else f"return/{seed}"].astype(float)
    rows = np.flatnonzero(np.isfinite(values))
    out[seed or 0] = (rows, values[rows])
  return out


def main() -> None:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
  )
  parser.add_argument("train", help="folder that `mjx-cl train` wrote")
  parser.add_argument("out", help="folder for curve.parquet and curve.png")
  parser.add_argument(
    "--published", action="store_true", help="add the published walker-walk curve"
  )
  parser.add_argument("--then", help="folder of a training that began with the agent of the first")
  args = parser.parse_args()
  import matplotlib

  matplotlib.use("Agg")
  import matplotlib.pyplot as plt
  import numpy as np

  from mjx_cl.io import tables
  from mjx_cl.scoring import intervals

  table = tables.read_table(pathlib.Path(args.train) / "metrics.parquet")
  out = pathlib.Path(args.out)
  out.mkdir(parents=True, exist_ok=True)
  seeds = curves(table)
  ended = np.unique(np.concatenate([rows for rows, _ in seeds.values()]))
  columns = (
    "updates",
    "records",
    "seconds",
    "phase",
    "return",
    *(f"return/{s}" for s in seeds),
    "episodes",
    "reward",
    "rew",
    "expert_return",
    "loss/dyn",
    "loss/value",
    "adv_mag",
    "ent/action",
  )
  tables.write_table(out / "curve.parquet", {c: table[c][ended] for c in columns if c in table})
  then = None
  if args.then:
    then = tables.read_table(pathlib.Path(args.then) / "metrics.parquet")
    for name, share in (("updates", 1), ("records", 1), ("seconds", len(seeds))):
      then[name] = then[name] + table[name][-1] / share
    ((rows, _),) = curves(then).values()
    then = {c: then[c][rows] for c in columns if c in then}
    tables.write_table(out / "then.parquet", then)
  fig, axes = plt.subplots(1, 3, figsize=(13, 3.8), sharey=True, constrained_layout=True)
  scales = (
    ("updates", 1.0, "updates of each seed"),
    ("records", 1e6, "records of each seed [million]"),
    ("seconds", 3600, "wall time [h]"),
  )
  smooth = lambda values: np.convolve(np.pad(values, (3, 3), mode="edge"), np.ones(7) / 7, "valid")
  for axis, (name, unit, label) in zip(axes, scales):
    x = table[name].astype(float) / unit
    for seed, (rows, values) in seeds.items():
      axis.plot(
        x[rows],
        smooth(values),
        lw=0.9,
        alpha=0.8,
        label=f"seed {seed}, running mean of 7" if len(seeds) > 1 else "running mean of 7",
      )
    if len(seeds) > 1:
      grid = np.linspace(0, len(table["updates"]) - 1, 31)
      middle, low, high, at = [], [], [], []
      for a, b in zip(grid, grid[1:]):
        means = [
          values[(rows >= a) & (rows < b)].mean() if ((rows >= a) & (rows < b)).any() else np.nan
          for rows, values in seeds.values()
        ]
        if np.isfinite(means).all():
          lo, hi = intervals.interval(means, lambda v, axis: np.mean(v, axis))
          middle, low, high, at = (
            middle + [np.mean(means)],
            low + [lo],
            high + [hi],
            at + [x[int((a + b) / 2)]],
          )
      axis.plot(at, middle, "k", lw=1.6, label="mean")
      axis.fill_between(
        at, low, high, color="k", alpha=0.12, lw=0, label="95 % interval over seeds"
      )
    else:
      for phase, color in (("clone", "C1"), ("fade", "C2")):
        mask = table["phase"] == phase
        if mask.any():
          axis.axvspan(x[mask].min(), x[mask].max(), color=color, alpha=0.12, lw=0, label=phase)
    if then:
      on = then[name].astype(float) / unit
      axis.plot(
        on, smooth(then["return"]), "C0", lw=0.9, label="seed 0 on alone, running mean of 7"
      )
      x = np.append(x, on)
    if args.published and name != "seconds":
      steps = np.asarray(list(PUBLISHED))
      at = steps * 0.25 if name == "updates" else steps / 2 / unit
      axis.plot(
        at,
        list(PUBLISHED.values()),
        "C3--",
        lw=1.2,
        label="published: size12m, repeat 2, ratio 512, 5 seeds",
      )
      axis.set_xlim(0, 1.05 * x.max() if name == "updates" else max(1.05 * x.max(), 0.25))
    axis.set_xlabel(label)
    axis.grid(alpha=0.3)
  axes[0].set_ylabel("return of the training's own episodes")
  fig.legend(
    *axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=7
  )  # axes[1] has every kind of line; below them it covers none
  fig.savefig(out / "curve.png", dpi=110)
  fig.clear()


if __name__ == "__main__":
  main()
