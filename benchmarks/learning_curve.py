"""Draws the learning curve of a pretraining from its metrics.parquet.

  python benchmarks/learning_curve.py runs/train results/walker_agent
"""
from __future__ import annotations

import argparse
import pathlib


def main() -> None:
  parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
  parser.add_argument("train", help="folder that `mjx-cl train` wrote")
  parser.add_argument("out", help="folder for curve.parquet and curve.png")
  args = parser.parse_args()
  import matplotlib
  matplotlib.use("Agg")
  import matplotlib.pyplot as plt
  import numpy as np
  from mjx_cl import store
  table = store.read_table(pathlib.Path(args.train) / "metrics.parquet")
  out = pathlib.Path(args.out)
  out.mkdir(parents=True, exist_ok=True)
  ended = np.isfinite(table["return"].astype(float))
  columns = ("updates", "records", "seconds", "phase", "return", "episodes", "expert_return", "loss/dyn", "loss/value", "adv_mag", "ent/action")
  store.write_table(out / "curve.parquet", {c: table[c][ended] for c in columns if c in table})
  fig, axis = plt.subplots(figsize=(8, 3.6), constrained_layout=True)
  updates, returns = table["updates"][ended], table["return"][ended].astype(float)
  for phase in dict.fromkeys(table["phase"][ended]):
    mask = table["phase"][ended] == phase
    axis.plot(updates[mask], returns[mask], lw=0.7, alpha=0.5, color={"clone": "C1", "fade": "C2"}.get(phase, "C0"))
    smooth = np.convolve(np.pad(returns[mask], (3, 3), mode="edge"), np.ones(7) / 7, "valid")
    axis.plot(updates[mask], smooth, color={"clone": "C1", "fade": "C2"}.get(phase, "C0"), label=phase)
  axis.axhline(900, color="0.7", lw=0.8)
  axis.set_xlabel("updates")
  axis.set_ylabel("return of the agent's own episodes")
  axis.set_ylim(0, 1000)
  axis.legend(loc="lower right")
  fig.savefig(out / "curve.png", dpi=110)


if __name__ == "__main__":
  main()
