"""Averages of all channels and of the world model's signed one-step errors against what healthy
robots and robots with other faults looked like.
"""

import functools
import pathlib
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mjx_cl.config import own_agent
from mjx_cl.detectors.base import (
  Alarm,
  Detector,
  Number,
  Setting,
  Warm,
  above,
  cold,
  demand,
  judged,
  keep,
  standardise,
  whole,
)
from mjx_cl.detectors.learnt import CHANNELS, MOST_U, MOST_Z, ON, OWN, RATES
from mjx_cl.detectors.multivariate import pick
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import arrays
from mjx_cl.rollout.monitor import Residual
from mjx_cl.types import Array

SMALL = 0.01  # added to a squared error before its logarithm
FILE = "innovations.npz"  # beside an agent of one's own
FITS = pathlib.Path(__file__).parent / "fits"  # of those that ship
N = len(CHANNELS)

Averages = Float[Array, "rates features"]


class Fit(NamedTuple):
  """What was fitted on one agent's robots; p errors, k = 12 + p, f = 12 + 2 p, r rates.

  Attributes:
    mean: float32 (k,), of the channels and the errors, healthy.
    std: float32 (k,), likewise.
    grain: float32 (p,), what errors are rounded to.
    apart: float32 (p, p), what of an error the others do not tell, in its deviations.
    center: float32 (2 p,), mean of that and of its energy.
    scale: float32 (2 p,), likewise.
    level: float32 (r, f), mean of the averages, healthy.
    spread: float32 (r, f), their deviation.
    factor: float32 (r, k, k), of the inverse correlations of channels' and energies' averages.
    low: float32 (3, r), mean of the logarithms of the looks, healthy.
    wide: float32 (3, r), likewise.
    weights: float32 (2, 12 r + 3 r), of an input and of its magnitude.
    bias: float32 ().
    units: float32 (2 + 2 r,), of the ratio and of `marks`, that are 1.
  """

  mean: Any
  std: Any
  grain: Any
  apart: Any
  center: Any
  scale: Any
  level: Any
  spread: Any
  factor: Any
  low: Any
  wide: Any
  weights: Any
  bias: Any
  units: Any


def agents() -> list[str]:
  """Shipped agents with a fit."""
  return sorted(p.stem for p in FITS.glob("*.npz"))


@functools.cache
def fit_of(agent: str) -> Fit:
  """The fit of a shipped agent, or the one beside an agent of one's own, which
  benchmarks/fit_innovations.py writes.

  Raises:
    UserError: there is none; FileError: it is broken.
  """
  path = FITS / f"{agent}.npz" if agent in agents() else pathlib.Path(agent) / FILE
  if not path.is_file():
    raise UserError(
      f"detector 'innovations' has no fit of agent {agent!r}; choose from: {', '.join(agents())}; "
      "docs/detection.md says how to fit another"
    )
  held = {k: np.asarray(v) for k, v in arrays.read(path).items()}
  count = held["grain"].size if "grain" in held else 0
  wanted = shapes(count)
  if not count or {k: v.shape for k, v in held.items()} != wanted:
    raise FileError(f"{path} is no fit of detector 'innovations'")
  if not all(v.dtype.kind == "f" and np.isfinite(v).all() for v in held.values()):
    raise FileError(f"{path} holds something other than finite numbers")
  return Fit(**{k: np.asarray(v, np.float32) for k, v in held.items()})


def shapes(p: int) -> dict[str, tuple[int, ...]]:
  """Of the fields of a Fit with `p` errors."""
  k, f, r = N + p, N + 2 * p, len(RATES)
  return {
    "mean": (k,),
    "std": (k,),
    "grain": (p,),
    "apart": (p, p),
    "center": (2 * p,),
    "scale": (2 * p,),
    "level": (r, f),
    "spread": (r, f),
    "factor": (r, k, k),
    "low": (3, r),
    "wide": (3, r),
    "weights": (2, (N + 3) * r),
    "bias": (),
    "units": (2 + 2 * r,),
  }


class State(NamedTuple):
  """What the detector remembers.

  Attributes:
    warm: of channels and errors: the fit's moments, or those of the stream's own samples.
    averages: of the features.
    seen: int32 (), scores that `peak` was taken of.
    peak: float32 (), the largest of a changed agent's first scores; 1 of the agent of the fit.
  """

  warm: Warm
  averages: Any
  seen: Any
  peak: Any


def sample(residual: Residual, fit: Fit) -> tuple[Float[Array, "k"], Any]:
  """Channels and rounded errors of one sample, and whether all of them are known."""
  x, known = pick(residual, CHANNELS, log=True)
  e = jnp.round(residual.innovation / fit.grain) * fit.grain
  there = jnp.all(jnp.isfinite(e))
  return jnp.concatenate([x, jnp.where(there, e, 0.0)]), known & there


def features(z: Float[Array, "k"], fit: Fit) -> Float[Array, "features"]:
  """What is averaged, of one standardised sample."""
  z = jnp.clip(z, -MOST_Z, MOST_Z)
  c = fit.apart @ z[N:]
  both = jnp.concatenate([c, jnp.log(jnp.square(c) + SMALL)])
  return jnp.concatenate([z[:N], jnp.clip((both - fit.center) / fit.scale, -MOST_Z, MOST_Z)])


def averaged(averages: Averages, y: Float[Array, "features"]) -> Averages:
  """The averages one sample later."""
  return averages + jnp.asarray(RATES)[:, None] * (y - averages)


def looks(u: Averages, fit: Fit) -> Float[Array, "3 rates"]:
  """Of averages in their healthy deviations: distance of channels and energies, largest error,
  largest energy.
  """
  p = len(fit.grain)
  c, h = u[:, N : N + p], u[:, N + p :]
  joint = jnp.einsum("rk,rkl->rl", jnp.concatenate([u[:, :N], h], 1), fit.factor)
  largest = lambda x: jnp.max(jnp.abs(x), 1)
  return jnp.stack([jnp.sqrt(jnp.sum(jnp.square(joint), 1)), largest(c), largest(h)])


def inputs(averages: Averages, fit: Fit) -> tuple[Float[Array, "inputs"], Float[Array, "marks"]]:
  """What the ratio weighs, and the magnitudes of; and the looks that count alone."""
  u = (averages - fit.level) / fit.spread
  own = looks(u, fit)
  log = (jnp.log(own + 1e-6) - fit.low) / fit.wide
  x = jnp.clip(jnp.concatenate([u[:, :N].ravel(), log.ravel()]), -MOST_U, MOST_U)
  return x, jnp.concatenate([own[0, -1:], own[1:].ravel()])


def score(averages: Averages, fit: Fit) -> Number:
  """The largest of the log odds that these are averages of a robot with a fault and of the looks
  that count alone, in units.
  """
  x, marks = inputs(averages, fit)
  odds = fit.weights[0] @ x + fit.weights[1] @ jnp.abs(x) + fit.bias
  return jnp.max(jnp.concatenate([odds[None], marks]) / fit.units)


@whole
def innovations(
  threshold: Setting = 1.0, warmup: int = 0, agent: str | None = None, robot: str | None = None
) -> Detector:
  """Exponentially weighted averages, at three rates, of all channels and of the world model's
  signed one-step errors of every variable: how much they look like faults that were seen before.

    z = (x - mean) / std of channels x and of innovations e (monitor.Residual), these rounded as
      recordings are
    c_i = sum_j P_ij z_j / sqrt(P_ii), P the inverse of the errors' healthy correlations, shrunk by
      a fiftieth: what of an error the others of that step do not tell;  h = ln(c^2 + 0.01)
    y = (z of the channels, c, h), standardised;  m_a <- m_a + a (y - m_a),  a = 1/8, 1/32, 1/128
    u = (m_a - level_a) / spread_a;  looks: l_1 = sqrt(u' S_a^-1 u) of channels and h, S_a shrunk by
      a tenth;  l_2 = max |u| of c;  l_3 = max |u| of h
    ratio = sum w x + v |x| + b, the log odds of a logistic regression of x = (u of the channels,
      ln l standardised) on "after an onset"
    score = max(ratio, l_1 of the slowest averages, every l_2 and l_3, each divided by its unit)
    fired = score > threshold; then m_a = 0

  x holds nothing of one error alone, so no weight can be learnt for the variable that a fault seen
  before moved. The looks are two-sided and know of no fault; the ratio has the direction of the
  faults that it was fitted on. mean, std, P, level, spread and S are of healthy robots of one
  agent; w, v and b of those against the tuning faults of the suite `leaderboard`. Units: what
  healthy robots pass once in 20,000 control steps (ratio, l_1) or 80,000 (l_2, l_3). After a
  finetuning the agent is another: mean and std are those of its next 1,500 samples, and scores are
  divided by the largest of the 1,500 after these, if that is above 1.

  Args:
    threshold: decision level.
    warmup: samples that fit mean and std from the start, and as many the score's scale [control
      steps]; 0: the fit's.
    agent: whose fit is taken, a shipped name or a folder; default: the robot's.
    robot: default: the walker.

  Returns:
    Detector over monitor.Residual of a Monitor that is `signed`.
  Blind to: what the world model foresees all the same; a change of fewer steps than the fastest
  average takes; the 3,000 samples after a finetuning.
  Reference: Mehra, Peschon 1971, Automatica 7, 637-640 (innovations of a healthy model for fault
  detection); Hawkins 1991, Technometrics 33, 61-75 (each error against what the others tell);
  Lowry, Woodall, Champ, Rigdon 1992, Technometrics 34, 46-53 (averages of several variables).
  """
  demand(
    "innovations",
    threshold=(threshold, above(threshold, 0), "above 0"),
    warmup=(warmup, warmup == 0 or warmup >= 2, "0, or at least 2"),
  )
  fit = fit_of(agent or own_agent(robot or "walker"))
  own, size, count = warmup or OWN, len(fit.mean), len(fit.grain)
  none = lambda: jnp.zeros((len(RATES), N + 2 * count))
  told = lambda: Warm(jnp.int32(own), jnp.asarray(fit.mean), jnp.square(fit.std) * own)
  begin = lambda: State(told(), none(), jnp.int32(own), jnp.float32(1.0))
  learns = lambda: State(cold(size), none(), jnp.int32(0), jnp.float32(1.0))

  def update(state: State, residual: Residual) -> tuple[State, Alarm]:
    e = residual.innovation
    if e is None or e.shape[-1] != count:
      raise UserError(
        f"detector 'innovations' of this agent takes {count} signed errors a step; "
        f"{'none are there' if e is None else f'there are {e.shape[-1]}'}"
      )
    x, known = sample(residual, fit)
    warm, z, ready = standardise(state.warm, x, own)
    known, warm = known & ready, keep(known, warm, state.warm)
    new = keep(known, averaged(state.averages, features(z, fit)), state.averages)
    own_score, tells = score(new, fit), known & (state.seen >= own)
    peak = jnp.where(known & ~tells, jnp.maximum(state.peak, own_score), state.peak)
    seen = jnp.minimum(state.seen + known, own)
    alarm = judged(own_score / state.peak, tells, threshold)
    return State(warm, jnp.where(alarm.fired, 0.0, new), seen, peak), alarm

  return Detector(learns if warmup else begin, update, anew=learns)


# whether its rows must have innovations, and what a board says beside its name
innovations.signed = True  # type: ignore[attr-defined]
innovations.fitted = ON  # type: ignore[attr-defined]
