"""Residual streams of an agent that does not adapt, for calibrating and comparing detectors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import faults as faults_lib
from mjx_cl.config import CHUNK
from mjx_cl.keys import OfSeed
from mjx_cl.rollout.monitor import Monitor
from mjx_cl.rollout.scan import Rollout, nest, start

if TYPE_CHECKING:
  from collections.abc import Callable, Iterable


def stream_keys(seeds: Iterable[int], streams: int) -> jax.Array:
  """Keys of `streams` streams for each seed, (len(seeds) * streams,); the first of a seed is the
  one that `run` uses.
  """
  keys = [
    jax.random.key(s) if i == 0 else jax.random.fold_in(jax.random.key(s), OfSeed.FURTHER + i)
    for s in seeds
    for i in range(streams)
  ]
  return jnp.stack(keys)


def record(
  env: Any,
  trained: Any,
  keys: jax.Array,
  steps: int,
  fault: str = "none",
  severity: float = 0.0,
  onset: int = 0,
  target: int = -1,
  form: str = "paper",
  progress: Callable[[int, int], Any] = lambda done, steps: None,
) -> dict[str, np.ndarray]:
  """Acts with a frozen agent and returns its residual streams.

  Args:
    keys: one per stream. steps: decisions, rounded up to chunks of 64.

  Returns:
    opr, rpr, reward float32 (steps, streams); valid bool (steps, streams); variables float32
    (steps, streams, O); target int (streams,).
  """
  agent = trained.agent
  the_fault = faults_lib.make(fault, env)
  rollout = Rollout(env, agent, the_fault, int(trained.card.get("repeat", 1)))
  monitor = Monitor(agent, form=form, spec=env.spec)
  streams = nest(lambda k: start(env, agent, the_fault, k, severity, onset, target=target), 0, 0)(
    keys[None]
  )
  params = jax.tree.map(lambda x: x[None], trained.train.params)
  history = monitor.init(1, len(keys))
  watch = jax.jit(monitor.update)
  out: dict[str, list] = {"opr": [], "rpr": [], "reward": [], "valid": [], "variables": []}
  for chunk in range(-(-steps // CHUNK)):
    streams, rows = rollout.chunk(params, streams, CHUNK)
    history, residual = watch(
      params, history, rows, jax.random.split(jax.random.fold_in(keys[0], chunk), 1)
    )
    for name in ("opr", "rpr", "valid", "variables"):
      out[name].append(np.asarray(getattr(residual, name))[:, 0])
    out["reward"].append(np.asarray(rows.reward)[:, 0])
    progress(min(steps, (chunk + 1) * CHUNK), steps)
  result = {k: np.concatenate(v)[:steps] for k, v in out.items()}
  result["target"] = np.asarray(streams.injection.target)[0, :, 0]
  return result
