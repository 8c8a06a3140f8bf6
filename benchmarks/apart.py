"""How far apart are two methods? python benchmarks/apart.py FOLDER METHOD OTHER; the folder holds
`methods_lives.parquet` of `mjx-cl leaderboard --methods --out FOLDER`.

Over the agents and seeds that the fault costs a tenth without adaptation (`affected` of arm
`none`): METHOD less OTHER of the return lost, as a share of what is lost without adaptation; of the
reward a step over the last 2,000 steps; and of that as a share of what was lost then. Means over
agents of means over their seeds, shares of such means. Intervals: 95 %, bootstrap of agents and
then of their seeds (10,000 draws).
"""

from __future__ import annotations

import pathlib
import sys

import numpy as np

from mjx_cl.io import tables
from mjx_cl.scoring import intervals
from mjx_cl.scoring.adaptation import NOTHING

WHAT = ("return lost, share", "reward at the end", "share of the loss at the end")


def lives(rows: list[dict], names: list[str]) -> list[np.ndarray]:
  """Of each agent (lives, 5): the difference of return lost, `none`'s, the difference of the end,
  the reward before, `none`'s end. Exits where a method has not lived what the other has.
  """
  held: dict[str, dict] = {name: {} for name in (*names, NOTHING)}
  for row in rows:
    held.get(row["method"], {})[row["agent"], row["seed"]] = row
  one, two, none = held.values()
  units = sorted(unit for unit, row in none.items() if row["affected"])
  if not units or any(unit not in own for unit in units for own in (one, two)):
    raise SystemExit(f"apart: no lives of {names[0]} and {names[1]} side by side")
  out: dict[str, list] = {}
  for unit in units:
    a, b, n = one[unit], two[unit], none[unit]
    lost, end = (a[k] - b[k] for k in ("return_lost", "reward_final"))
    own = lost, n["return_lost"], end, a["reward_pre"], n["reward_final"]
    out.setdefault(unit[0], []).append(own)
  return [np.array(own, float) for own in out.values()]


def statistics(agents: list[np.ndarray]) -> np.ndarray:
  """The three of WHAT."""
  lost, of, end, before, none = np.mean([x.mean(0) for x in agents], 0)
  return np.array([lost / of, end, end / (before - none)])


def main(folder: str, method: str, other: str) -> None:
  """Prints a row for each of WHAT."""
  rows = tables.read_rows(pathlib.Path(folder) / "methods_lives.parquet")
  agents = lives(rows, [method, other])
  ends = np.percentile(intervals.nested(agents, statistics), [2.5, 97.5], axis=0).T
  for what, value, (low, high) in zip(WHAT, statistics(agents), ends):
    print(f"{what}: {value:.3f} [{low:.3f}, {high:.3f}], {sum(map(len, agents))} lives")


if __name__ == "__main__":
  if len(sys.argv) != 4:
    raise SystemExit("usage: python benchmarks/apart.py FOLDER METHOD OTHER")
  main(*sys.argv[1:])
