"""Does a method end below doing nothing? python benchmarks/ends.py FOLDER, which holds
`methods_lives.parquet` of `mjx-cl leaderboard --methods --out FOLDER`.

For each setting and method the reward a step over the last 2,000 steps, and its difference from arm
`none`, paired by agent and seed: mean, 95 % bootstrap of pairs, chance by sign flips
(`mjx_cl.scoring.adaptation.sign_flips`), and whether it is below after Holm's correction over all.
"""

from __future__ import annotations

import pathlib
import sys

import numpy as np

from mjx_cl.io import tables
from mjx_cl.scoring import intervals
from mjx_cl.scoring.adaptation import NOTHING, holm, sign_flips


def pairs(lives: list[dict]) -> dict[tuple[str, str], np.ndarray]:
  """(robot: setting, method) -> rewards at the end, (pairs, 2): the method's and that of `none`."""
  ends: dict[tuple[str, str], dict] = {}
  for x in lives:
    key = f"{x['robot']}: {x['setting']}", x["method"]
    ends.setdefault(key, {})[x["agent"], x["seed"]] = x["reward_final"]
  return {
    (setting, method): np.array([(own[u], none[u]) for u in own if u in none])
    for (setting, method), own in ends.items()
    if method != NOTHING and (none := ends.get((setting, NOTHING)))
  }


def main(folder: pathlib.Path) -> None:
  """Prints a row for each setting and method."""
  found = pairs(tables.read_rows(folder / "methods_lives.parquet"))
  chances = [sign_flips(x[:, 0] - x[:, 1]) for x in found.values()]
  for (key, x), p, told in zip(found.items(), chances, holm(chances)):
    apart = x[:, 0] - x[:, 1]
    low, high = intervals.interval(apart, np.mean) or (np.nan, np.nan)
    end, none = x.mean(0)
    place = "below" if told and apart.mean() < 0 else "above" if told else "not told apart"
    print(
      f"{key[0]}, {key[1]}: {end:.2f}, none {none:.2f}, difference {apart.mean():.3f} "
      f"[{low:.3f}, {high:.3f}], {len(x)} pairs, p {p:.3f}; after Holm: {place}"
    )


if __name__ == "__main__":
  main(pathlib.Path(sys.argv[1]))
