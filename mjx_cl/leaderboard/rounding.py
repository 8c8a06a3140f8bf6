"""How the columns of a recorded set are rounded, which makes its files small."""

import numpy as np

from mjx_cl.leaderboard.streams import COLUMNS, PROJECTION

FLOOR = 1e-6  # residuals below are taken as this before the logarithm
FINENESS = {"opr": 4, "rpr": 4, "reward": 4, "surprise": 4, "group": 2, "z": 2}


def grains(healthy: dict[str, np.ndarray]) -> dict[str, float]:
  """How each column is rounded, from healthy streams: relative steps (of residuals, groups and
  surprise) or absolute ones (reward, latents), powers of two near the deviation (of the logarithm;
  absolute) divided by FINENESS.
  """
  out = {}
  for name in COLUMNS + PROJECTION:
    x = healthy["latent"][..., int(name[1:])] if name in PROJECTION else healthy[name]
    x = x[np.isfinite(x)].astype(np.float64)
    wide = float(np.std(x if absolute(name) else np.log(np.maximum(x, FLOOR)))) if len(x) else 0.0
    fineness = FINENESS["z" if name in PROJECTION else name.split("_")[0]]
    power = float(np.round(np.log2(max(wide, 1e-9) / fineness)))
    out[name] = 2.0 ** (power if absolute(name) else min(-1.0, power))
  return out


def absolute(name: str) -> bool:
  """Whether a column is rounded to absolute steps; the others may not be negative and are rounded
  to relative ones.
  """
  return name == "reward" or name in PROJECTION


def rounded(x: np.ndarray, name: str, grain: dict[str, float]) -> np.ndarray:
  """`x` on the grid of its column, float32 whose low mantissa bits are zero; nan stays nan."""
  x = x.astype(np.float32)
  if absolute(name):
    return (np.round(x.astype(np.float64) / grain[name]) * grain[name]).astype(np.float32)
  drop = 23 + int(np.log2(grain[name]))
  x = np.maximum(x, np.float32(FLOOR))
  if drop < 1:  # a column that hardly varies
    return x
  bits = x.view(np.uint32).astype(np.uint64)
  kept = (((bits + (1 << (drop - 1))) >> drop) << drop).astype(np.uint32).view(np.float32)
  return np.where(np.isfinite(x), kept, np.nan).astype(np.float32)
