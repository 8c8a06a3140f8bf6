"""Several charts at once, each in units of its own threshold on the robot."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from mjx_cl.detectors.base import Alarm, Detector, Real, Setting, above, demand, whole
from mjx_cl.detectors.combine import any_of
from mjx_cl.detectors.thresholds import board, known_of
from mjx_cl.errors import UserError

CHARTS = "cusum@surprise,ewma,e_detector"


def in_units(detector: Detector, unit: Real, threshold: Setting) -> Detector:
  """`detector`, built with the threshold `threshold * unit`, with its score in units of `unit`:
  fired if and only if score > threshold, rounding or not.
  """

  def update(state: Any, x: Any) -> tuple[Any, Alarm]:
    new, alarm = detector.update(state, x)
    score, level = alarm.score / unit, jnp.asarray(threshold, jnp.float32)
    score = jnp.where(
      alarm.fired, jnp.maximum(score, jnp.nextafter(level, jnp.inf)), jnp.minimum(score, level)
    )
    return new, Alarm(alarm.fired, jnp.where(jnp.isnan(alarm.score), jnp.nan, score))

  return Detector(detector.init, update, anew=detector.anew)


@whole
def multichart(
  make: Callable[..., Detector],
  threshold: Setting = 1.0,
  charts: Any = CHARTS,
  robot: str | None = None,
  agent: str | None = None,
) -> Detector:
  """Charts that look at different things, side by side; the alarm of any counts.

    score = max_i s_i / h_i;  fired = score > threshold; the charts above it start afresh, as each
      does at its own alarm
    s_i: score of chart i.  h_i: its threshold at which the robot, healthy, gives it one alarm in
      100,000 control steps (detectors.board)

  No one chart is good on every robot: what a fault disturbs differs. In units of h_i all charts
  share one threshold and, near 1, one rate of false alarms; k charts alarm at most k times as often
  as one of them, so that at threshold 1 the ARL0 is 100,000 / k or longer. Calibrate. Each chart
  looks in its own direction: of the default ones cusum and ewma are two-sided, e_detector is
  one-sided, a rise alone.

  Args:
    make: (name, **settings) -> Detector, `detectors.make`, which hands itself on.
    threshold: decision level [thresholds h_i].
    charts: names on the leaderboard, joined by commas; those whose h_i is known.
    robot: whose h_i are taken; default, and for a robot without any: the walker's.
    agent: whose h_i stand above the robot's, where it has its own.

  Returns:
    Detector over monitor.Residual.
  Blind to: what all of its charts are blind to.
  Reference: Tartakovsky, Nikiforov, Basseville 2014, Sequential Analysis, Chapman and Hall, section
  9.3 (multichart procedures). The charts and how they were chosen: benchmarks/multichart.py.
  """
  demand("multichart", threshold=(threshold, above(threshold, 0), "above 0"))
  if not isinstance(charts, str):
    raise UserError(f"detector 'multichart': charts are names, joined by commas; got {charts!r}")
  rows = known_of(robot, agent)
  rows = rows if len(rows) > 1 else board()["walker"]
  known = {name: row for name, row in rows.items() if row["settings"]["use"] != "multichart"}
  names = [name.strip() for name in charts.split(",")]
  for name in names:
    if name not in known:
      raise UserError(f"detector 'multichart': no chart {name!r}; choose from: {', '.join(known)}")
  if len(set(names)) < len(names):
    raise UserError(f"detector 'multichart': a chart is named twice in {charts!r}")

  def chart(name: str) -> list[Detector]:
    """Each part that starts afresh by itself."""
    settings, unit = dict(known[name]["settings"]), known[name]["threshold"]
    use = settings.pop("use")
    built = make(use, threshold=threshold * unit, robot=robot, agent=agent, **settings)
    return [in_units(part, unit, threshold) for part in built.members or (built,)]

  return any_of(*(part for name in names for part in chart(name)))
