"""Share of the loss won back over several agents: python benchmarks/won_back.py FOLDER, of a suite
with a part for each agent, as results/steady.

For each arm the mean over parts and streams of (end - without learning) / (before - without
learning), rewards a step, `mjx_cl.scoring.normalised_recovery`; and the differences from the first
arm, paired by seed. Intervals: 95 %, bootstrap of parts and then of their seeds (10,000 draws).
"""

from __future__ import annotations

import json
import pathlib
import sys

import numpy as np
import pyarrow.parquet as parquet

from mjx_cl.scoring import intervals, normalised_recovery


def shares(folder: pathlib.Path) -> dict[str, list[np.ndarray]]:
  """Arm -> of each part its streams' shares, by seed; exits where one is undefined, since the fault
  took less than a tenth.
  """
  out: dict[str, list[np.ndarray]] = {}
  for file in sorted(folder.glob("*/runs.parquet")):
    rows = normalised_recovery.rows(parquet.read_table(file).to_pylist())
    for arm in dict.fromkeys(r["arm"] for r in rows):
      own = {r["seed"]: r["normalised"] for r in rows if r["arm"] == arm}
      if lost := sorted(seed for seed, x in own.items() if x is None):
        raise SystemExit(f"won_back: {file}: seed {lost[0]} loses less than a tenth")
      out.setdefault(arm, []).append(np.asarray([own[seed] for seed in sorted(own)]))
  return out


def mean(parts: list[np.ndarray]) -> float:
  """Over parts of the mean over their streams."""
  return float(np.mean([x.mean() for x in parts]))


def interval(parts: list[np.ndarray]) -> list[float]:
  """Of `mean`."""
  return np.percentile(intervals.nested(parts, mean), [2.5, 97.5]).tolist()


def main(folder: str) -> None:
  arms = shares(pathlib.Path(folder))
  if not arms:
    raise SystemExit(f"won_back: {folder} holds no parts with runs.parquet")
  first = next(iter(arms.values()))
  for arm, parts in arms.items():
    apart = [own - its for own, its in zip(parts, first)]
    print(
      json.dumps(
        {
          "arm": arm,
          "agents": len(parts),
          "streams": sum(map(len, parts)),
          "won_back": mean(parts),
          "won_back_ci": interval(parts),
          "more": mean(apart),
          "more_ci": interval(apart),
        }
      )
    )


if __name__ == "__main__":
  main(sys.argv[1])
