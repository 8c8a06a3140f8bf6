"""Return of an agent on a robot, healthy or not, and the task's own figures."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import faults
from mjx_cl.errors import UserError
from mjx_cl.faults.presets import Change
from mjx_cl.rollout.scan import Rollout, nest, start
from mjx_cl.scoring import intervals
from mjx_cl.training.episodes import Episodes


class Readings:
  """Sums over observations of `size` variables."""

  def __init__(self, size: int) -> None:
    self.count, self.first = 0, np.zeros(size)
    self.sums, self.squares = np.zeros(size), np.zeros(size)

  def add(self, obs: np.ndarray) -> None:
    """Adds observations (N, size)."""
    if not self.count and len(obs):
      self.first = obs[0]  # near which squares lose no digits
    self.count += len(obs)
    self.sums += (obs - self.first).sum(0)
    self.squares += ((obs - self.first) ** 2).sum(0)

  def deviations(self) -> np.ndarray:
    """Standard deviation of each variable, nan without observations."""
    if not self.count:
      return np.full(self.sums.shape, np.nan)
    n = self.count
    return np.sqrt(np.maximum(0.0, self.squares / n - (self.sums / n) ** 2))


def evaluate(
  env: Any,
  agent: Any,
  params: Any,
  episodes: int,
  seed: int = 0,
  repeat: int = 1,
  deterministic: bool = False,
  changes: Sequence[Change] = (),
) -> dict[str, Any]:
  """Runs `episodes` episodes side by side, seeds seed, seed + 1, ..., under the faults `changes`
  from the first step on.

  Returns:
    episodes, return_mean, return_iqm, return_ci (95 % bootstrap of the IQM over episodes of this
    one agent), returns, terminations, deviations (variable -> standard deviation of its readings
    after the first quarter of an episode: what `scale` of a robot's spec says; None where no
    episode lasts so long), and where the environment measures them (env.measure), means
    over the steps of all episodes with their bootstrap interval over episodes: of the quadruped
    velocity_error_m_s and fall_rate; of the car mean_speed_m_s and collision_rate. Of a robot with
    a reference driver the same for it, from the same starts: reference_return,
    reference_velocity_error_m_s or reference_speed_m_s, reference_falls or reference_collisions.
  """
  fault, plan, target = faults.build(changes or (Change("none"),), env)
  rollout = Rollout(env, agent, fault, repeat, deterministic)
  how: dict[str, Any] = {"plan": plan, "target": target}
  seen = Readings(len(env.spec.obs))
  total, steps, sums, ended = live(env, rollout, agent, params, episodes, seed, seen, **how)

  def counted(name: str, hits: np.ndarray) -> dict[str, Any]:
    share = intervals.wilson(int(hits.sum()), episodes)
    return {name: int(hits.sum()), name + "_ci": share and [x * episodes for x in share]}

  def per_step(name: str, value: np.ndarray, steps: np.ndarray) -> dict[str, Any]:
    """A mean over steps, so that a short episode counts for little; drawn anew by episodes."""
    over = lambda drawn, axis: (
      value[drawn.astype(int)].sum(axis) / np.maximum(1, steps[drawn.astype(int)].sum(axis))
    )
    return {
      name: float(value.sum() / max(1, steps.sum())),
      name + "_ci": intervals.interval(np.arange(episodes), over),
    }

  out = {
    "episodes": episodes,
    "return_mean": float(total.mean()),
    "return_iqm": float(intervals.iqm(total)),
    "return_ci": intervals.interval(total),
    **counted("terminations", ended),
    "returns": [round(float(x), 2) for x in total],
    "deviations": {
      var.name: float(f"{x:.3g}") if np.isfinite(x) else None
      for var, x in zip(env.spec.obs, seen.deviations())
    },
  }
  for name, value in sums.items():
    out |= per_step(name, value, steps)
  rate = getattr(env, "termination_rate", None)
  if rate:
    out |= {rate: float(ended.mean()), rate + "_ci": intervals.wilson(int(ended.sum()), episodes)}
  if hasattr(env, "reference"):
    driver = Rollout(env, agent, fault, repeat, expert=lambda stream: env.reference(stream.env))
    how |= {"drive": True}
    reference, steps, sums, ended = live(env, driver, agent, params, episodes, seed, None, **how)
    out |= {
      "reference_return": float(reference.mean()),
      "reference_return_ci": intervals.interval(reference, np.mean),
      **counted(f"reference_{(rate or 'termination_rate').removesuffix('_rate')}s", ended),
    }
    for name, value in sums.items():
      out |= per_step("reference_" + name.removeprefix("mean_"), value, steps)
  return out


def live(
  env: Any,
  rollout: Rollout,
  agent: Any,
  params: Any,
  episodes: int,
  seed: int,
  seen: "Readings | None" = None,
  drive: bool = False,
  **fault: Any,
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], np.ndarray]:
  """One episode each: (return, measured steps, {figure: sum over the steps}, terminated), arrays
  (episodes,); `fault` as `start` takes it, `seen` gets the readings.

  A figure is read after a step, from the state; the step that ends an episode, after which a new
  one has begun, is left out.
  """
  keys = jnp.stack([jax.random.key(seed + i) for i in range(episodes)])[None]
  streams = nest(lambda k: start(env, agent, rollout.fault, k, **fault), 0, 0)(keys)
  params = jax.tree.map(lambda x: x[None], params)
  measure = jax.jit(nest(env.measure, 0, 0)) if hasattr(env, "measure") else None
  lived, steps = Episodes((1, episodes)), np.zeros(episodes)
  sums: dict[str, np.ndarray] = {}
  chunk, decisions = 50 if measure is None else 1, 0
  while lived.alive.any():
    if decisions * rollout.repeat > env.spec.episode_steps:
      raise UserError(
        f"robot {env.spec.name!r} ends no episode in its episode_steps={env.spec.episode_steps}; "
        "its step has to set `truncated` by then"
      )
    decisions += chunk
    streams, rows = rollout.chunk(params, streams, chunk, jnp.full((1, episodes), drive))
    within = lived.add(rows)
    if seen is not None:
      at = np.arange(decisions - chunk, decisions) * rollout.repeat
      late = within & (at >= env.spec.episode_steps // 4)[:, None, None]
      seen.add(np.asarray(rows.final_obs, np.float64)[late])
    if measure is not None:
      alive = lived.alive[0]
      steps += alive
      for name, value in measure(streams.env).items():
        sums[name] = sums.get(name, 0.0) + np.asarray(value)[0] * alive
  return lived.total[0], steps, sums, lived.ended[0]
