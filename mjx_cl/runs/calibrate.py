"""`mjx-cl calibrate`: the threshold at which a detector gives a wanted rate of false alarms on
healthy robots.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import detectors, faults
from mjx_cl.config import CHUNK, AdaptConfig
from mjx_cl.errors import PluginError, UserError, require
from mjx_cl.io import memory
from mjx_cl.rollout.monitor import Monitor, Residual
from mjx_cl.rollout.scan import Rollout, nest, start, stream_keys
from mjx_cl.runs.identity import known_as
from mjx_cl.scoring import metrics, thresholds
from mjx_cl.training import agents

LEAST = 5  # alarms that the wanted rate must give, below which it cannot be read off
WARMUP = AdaptConfig.warmup  # control steps of a stream in which no alarm counts, as in a run


class Calibrated(NamedTuple):
  """A threshold, and the false alarms that it gave.

  Attributes:
    threshold: of the detector.
    arl0: as of metrics.arl0, control steps.
    arl0_ci: likewise.
    alarms: likewise.
    steps: healthy control steps that were counted.
  """

  threshold: float
  arl0: float | None
  arl0_ci: list[float | None]
  alarms: int
  steps: int


def watched(
  env: Any,
  trained: agents.Trained,
  keys: jax.Array,
  rows: int,
  signed: bool = False,
  fault: tuple[str, float, int] = ("none", 0.0, 0),
  tell: Callable[[str], Any] = lambda text: None,
) -> Residual:
  """Residuals of robots that learn nothing, leading (rows, S), NumPy.

  Args:
    env: robot.
    trained: its agent.
    keys: (S,), as of `stream_keys`.
    rows: decisions.
    signed: with signed errors as well.
    fault: name, severity, onset in control steps.
    tell: gets a line now and then.
  """
  name, severity, onset = fault
  broken = faults.make(name, env)
  rollout = Rollout(env, trained.agent, broken, trained.repeat)
  monitor = Monitor(trained.agent, spec=env.spec, signed=signed)
  begin = lambda k: start(env, trained.agent, broken, k, severity, onset)
  streams = nest(begin, 0, 0)(keys[None])
  params = jax.tree.map(lambda x: x[None], trained.train.params)
  history, watch, parts = monitor.init(1, len(keys)), jax.jit(monitor.update), []
  for chunk in range(-(-rows // CHUNK)):
    streams, seen = rollout.chunk(params, streams, CHUNK)
    key = jax.random.split(jax.random.fold_in(keys[0], chunk), 1)
    history, residual = watch(params, history, seen, key)
    parts.append(jax.tree.map(lambda x: np.asarray(x)[:, 0], residual))
    if chunk % 50 == 49:
      tell(f"{(chunk + 1) * CHUNK:,} of {rows:,} decisions of {len(keys)} robots")
  return jax.tree.map(lambda *x: np.concatenate(x)[:rows], *parts)


def alarms(
  build: Callable[[Any], detectors.Detector], residual: Residual
) -> Callable[[np.ndarray], detectors.Alarm]:
  """A detector over all streams, compiled once: thresholds (K,) -> Alarm of NumPy (T, K, S).

  Args:
    build: threshold -> Detector.
    residual: leading (T, S).
  """

  def single(threshold: jax.Array, state: Any, x: Residual) -> tuple[Any, detectors.Alarm]:
    return build(threshold).update(state, x)

  @jax.jit
  def run(levels: jax.Array, xs: Residual) -> detectors.Alarm:
    streams = jax.tree.leaves(xs)[0].shape[1]
    begin = jax.vmap(lambda level: build(level).init())(levels)
    wide = lambda x: jnp.broadcast_to(x[:, None], (len(levels), streams, *x.shape[1:]))
    every = jax.vmap(jax.vmap(single, (None, 0, 0)), (0, 0, None))
    step = lambda states, x: every(levels, states, x)
    return jax.lax.scan(step, jax.tree.map(wide, begin), xs)[1]

  return lambda levels: jax.tree.map(np.asarray, run(jnp.asarray(levels, jnp.float32), residual))


def calibrate(
  env: Any,
  trained: agents.Trained,
  detector: str,
  settings: dict[str, Any],
  seeds: Sequence[int],
  steps: int,
  arl0: float,
  tell: Callable[[str], Any] = lambda text: None,
) -> Calibrated:
  """The least threshold from which on healthy robots give no more than steps / arl0 alarms, counted
  with restarts from control step WARMUP on.

  Args:
    env: robot.
    trained: its agent.
    detector: name, or path/to/file.py:factory.
    settings: of it, without `threshold`.
    seeds: of the healthy robots.
    steps: control steps of each.
    arl0: wanted mean number of control steps between two false alarms.
    tell: gets a line now and then.

  Raises:
    UserError: a detector without a threshold, or too few steps for the rate.
    PluginError: one whose threshold must be a plain number.
  """
  require("threshold" not in settings, "threshold is what is looked for; leave it out of --set")
  repeat = trained.repeat
  rows, first = steps // repeat, WARMUP // repeat
  counted = max(0, rows - first) * len(seeds) * repeat
  require(
    counted / arl0 >= LEAST,
    f"{len(seeds)} robots of {steps:,} control steps give {counted / arl0:.3g} false alarms at one "
    f"in {arl0:g}; {LEAST} are needed: more --seeds or --steps",
  )
  held = 8 * rows * len(seeds) * (2 * len(env.spec.obs) + 64)  # bytes, twice while joined
  require(
    held <= memory.MARGIN * memory.free(),
    f"{len(seeds)} robots of {steps:,} control steps take {held / 2**30:.1f} GiB; fewer would fit",
  )
  told = {"robot": known_as(env), "agent": agents.called(trained)} | settings
  factory = detectors.factory(detectors.split(detector)[0])
  known = detectors.known_settings(factory)
  require("threshold" in known, f"detector {detector!r} has no threshold")
  build = lambda level: detectors.make(detector, **told, threshold=level)
  build(1.0)  # whatever its settings refuse
  signed = getattr(factory, "signed", False)
  residual = watched(env, trained, stream_keys(seeds, 1), rows, signed, tell=tell)
  run = alarms(build, residual)
  try:
    quiet = run(np.full(thresholds.TOGETHER, 1e30))
  except jax.errors.ConcretizationTypeError as e:
    raise PluginError(
      f"detector {detector!r} cannot be calibrated: its factory asks for a threshold that is a "
      f"plain number ({str(e).splitlines()[0]})"
    ) from None
  scores = np.asarray(quiet.score)[first:, 0]
  count = lambda levels: np.asarray(run(levels).fired)[first:].sum((0, 2))
  level, _ = thresholds.narrow(count, scores, counted / arl0)
  if not np.isfinite(level):
    raise UserError(f"detector {detector!r} tells no score on these healthy robots")
  fired = run(np.full(thresholds.TOGETHER, level)).fired[first:, 0]
  found = metrics.arl0(fired)
  scaled = lambda x: None if x is None else x * repeat
  return Calibrated(
    float(np.float32(level)),
    scaled(found["arl0"]),
    [scaled(x) for x in found["arl0_ci"]],
    found["alarms"],
    counted,
  )
