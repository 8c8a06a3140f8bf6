"""Averages of all channels against what healthy robots and robots with other faults looked like."""

import functools
import json
import pathlib
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mjx_cl.config import whose
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
from mjx_cl.detectors.multivariate import Rows, pick, split
from mjx_cl.errors import UserError
from mjx_cl.rollout.monitor import Residual
from mjx_cl.types import Array

CHANNELS = split("learnt", "opr+rpr+reward+surprise+groups")
RATES = (1 / 8, 1 / 32, 1 / 128)
MOST_Z, MOST_U = 6.0, 8.0  # deviations beyond which a sample, an average counts as so many
LOOKS = ("distance", "ratio")
OWN = 1500  # samples after a finetuning that fit mean and deviation
ON = "healthy streams and tuning faults of the seeds that tune"

Averages = Float[Array, "rates channels"]


class Fit(NamedTuple):
  """What was fitted on one agent's robots; p channels, r rates.

  Attributes:
    mean: float32 (p,), of the channels, healthy.
    std: float32 (p,), likewise.
    level: float32 (r, p), mean of the averages, healthy.
    spread: float32 (r, p), their deviation.
    inverse: float32 (p, p), inverse covariance of the slowest averages, healthy.
    weights: float32 (2, r, p), of an average and of its magnitude.
    bias: float32 (), of the ratio.
    units: float32 (2,), score of each of LOOKS that is 1.
  """

  mean: Any
  std: Any
  level: Any
  spread: Any
  inverse: Any
  weights: Any
  bias: Any
  units: Any


@functools.cache
def fits() -> dict[str, Fit]:
  """Fit of each agent that has one; written by benchmarks/fit_learnt.py."""
  agents = json.loads(pathlib.Path(__file__).with_suffix(".json").read_text())["agents"]
  return {
    agent: Fit(**{k: np.asarray(v, np.float32) for k, v in own.items()})
    for agent, own in agents.items()
  }


class State(NamedTuple):
  """What the detector remembers.

  Attributes:
    warm: of the channels: the fit's moments, or those of the stream's own first samples.
    averages: of the standardised channels.
  """

  warm: Warm
  averages: Any


def averaged(averages: Averages, z: Rows) -> Averages:
  """The averages one standardised sample later."""
  rates = jnp.asarray(RATES)[:, None]
  return averages + rates * (jnp.clip(z, -MOST_Z, MOST_Z) - averages)


def distance(averages: Averages, fit: Fit) -> Number:
  """Mahalanobis distance of the slowest averages from the healthy robot's."""
  off = averages[-1] - fit.level[-1]
  return jnp.sqrt(off @ fit.inverse @ off)


def standardised(averages: Averages, fit: Fit) -> Float[Array, "2 rates channels"]:
  """The averages in their healthy deviations, and their magnitudes: what the ratio weighs."""
  u = jnp.clip((averages - fit.level) / fit.spread, -MOST_U, MOST_U)
  return jnp.stack([u, jnp.abs(u)])


def ratio(averages: Averages, fit: Fit) -> Number:
  """Logarithm of the odds that these are averages of a robot with a fault."""
  return jnp.sum(fit.weights * standardised(averages, fit)) + fit.bias


@whole
def learnt(
  threshold: Setting = 1.0,
  looks: str = "both",
  warmup: int = 0,
  agent: str | None = None,
  robot: str | None = None,
) -> Detector:
  """Exponentially weighted averages of all channels at three rates: how far they are from a healthy
  robot's, and how much they look like faults that were seen before.

    z = (x - mean) / std;  m_a <- m_a + a (z - m_a),  a = 1/8, 1/32, 1/128, from 0
    distance = sqrt((m - level)' S^-1 (m - level)) of the slowest averages, S shrunk by a tenth
    u = (m_a - level_a) / spread_a;  ratio = sum w u + v |u| + b, the log odds of a logistic
      regression of u on "after an onset"
    score = max(distance / unit, ratio / unit);  fired = score > threshold; then m_a = 0

  x: logarithms of opr, rpr, surprise and the eight groups, and the reward. Everything else was
  fitted on recordings of the shipped agent: mean, std, level, spread, S and the units on healthy
  robots, w, v and b on those against the tuning faults of the suite `leaderboard`. The distance
  knows of no fault; the ratio is sharper on faults that resemble those it has seen. A unit is a
  score that healthy robots pass once in 20,000 control steps.

  The distance is two-sided; the ratio has the direction of the faults that it was fitted on. After
  a finetuning mean and std are those of the next 1,500 samples, since the agent is another.

  Args:
    threshold: decision level [units].
    looks: `distance`, `ratio` or `both`.
    warmup: samples that fit mean and std from the start [control steps]; 0: the fit's.
    agent: whose fit is taken, a shipped name; default, and for one without any: the robot's own.
    robot: default, and for a robot without any: the walker.

  Returns:
    Detector over monitor.Residual.
  Blind to: a change of fewer steps than the fastest average takes; whatever a healthy robot does
  now and then. Other agents than the shipped ones need a fit of their own, or a `warmup`, which
  knows their mean and std and no more.
  Reference: Lowry, Woodall, Champ, Rigdon 1992, Technometrics 34, 46-53 (averages of several
  channels); Gong, Lee, Cheng, Xie 2022, arXiv 2210.17312 (a learnt likelihood ratio).
  """
  demand(
    "learnt",
    threshold=(threshold, above(threshold, 0), "above 0"),
    warmup=(warmup, warmup == 0 or warmup >= 2, "0, or at least 2"),
  )
  if looks not in ("both", *LOOKS):
    raise UserError(f"detector 'learnt': looks is both, {' or '.join(LOOKS)}; got {looks!r}")
  fit = fits()[whose(fits(), robot, agent)]
  use, own = np.array([looks in ("both", name) for name in LOOKS]), warmup or OWN
  none = lambda: jnp.zeros((len(RATES), len(CHANNELS)))
  told = lambda: Warm(jnp.int32(own), jnp.asarray(fit.mean), jnp.square(fit.std) * own)

  def update(state: State, residual: Residual) -> tuple[State, Alarm]:
    x, known = pick(residual, CHANNELS, log=True)
    warm, z, ready = standardise(state.warm, x, own)
    known, warm = known & ready, keep(known, warm, state.warm)
    new = keep(known, averaged(state.averages, z), state.averages)
    both = jnp.stack([distance(new, fit), ratio(new, fit)]) / fit.units
    alarm = judged(jnp.max(both, where=use, initial=-jnp.inf), known, threshold)
    return State(warm, jnp.where(alarm.fired, 0.0, new)), alarm

  learns = lambda: State(cold(len(CHANNELS)), none())
  return Detector(learns if warmup else lambda: State(told(), none()), update, anew=learns)


# what a board says beside its name
learnt.fitted = ON  # type: ignore[attr-defined]
