"""Faults of what the robot senses. They act where an observation arrives: the agent, its replay and
the monitor see the same faulty one.

`scale` of a channel is spec.obs[i].scale, its typical deviation on the healthy robot [unit of the
channel]. A target is a group of channels, all, or one channel; a target that is not named is drawn
from the groups. Where a fault remembers, an episode's start fills its memory anew.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int, PRNGKeyArray

from mjx_cl.errors import UserError
from mjx_cl.faults.base import Fault, Ports, Severity
from mjx_cl.faults.kinds import late, leafwise, loss, signal, steady
from mjx_cl.types import Array

# at severity 1: probability that one begins, control steps that it lasts; the hard level of
# realworldrl_suite
BURST = (0.1, 10)
DRIFT_STEPS = 2000  # control steps until a drift is complete


def scales(env: Any) -> Float[Array, " obs"]:
  """Typical deviation of each channel [its unit]."""
  return jnp.asarray([v.scale for v in env.spec.obs], jnp.float32)


def bias(env: Any) -> Fault:
  """A constant is added to a reading.   x_i' = x_i + 2 severity scale_i

  Severity: 1 is two typical deviations [unit of the channel]. Target: a group of channels (drawn),
  all, or one channel. Owns `obs`. Source: bias drift, which isaac-sim/IsaacLab#7451 asks for, here
  as a step; the range is this project's own choice.
  """
  scale = scales(env)
  return steady("bias", env, "obs", lambda x, severity, key: x + 2.0 * severity * scale)


def drift(env: Any) -> Fault:
  """A reading wanders off in a straight line.   x_i' = x_i + 2 severity scale_i min(1, (since + 1)
    / 2,000)

  Severity: 1 ends two typical deviations off [unit of the channel], 2,000 control steps after the
  onset. Target: a group of channels (drawn), all, or one channel. Owns `obs`. Source: sensor drift
  of Danesh and Fern 2021; the range is this project's own choice.
  """
  scale = scales(env)

  def change(
    m: Any, severity: Severity, key: PRNGKeyArray, ports: Ports
  ) -> tuple[Any, Float[Array, " obs"]]:
    return m, ports.obs + 2.0 * severity * scale * jnp.clip(
      (ports.since + 1) / DRIFT_STEPS, 0.0, 1.0
    )

  return signal("drift", env, "obs", change)


def scale(env: Any) -> Fault:
  """A sensor's gain falls.   x_i' = x_i (1 - 0.9 severity)

  Severity: 1 leaves a tenth of the gain [1]. Target: a group of channels (drawn), all, or one
  channel. Owns `obs`. Not visible to: a channel that reads 0. Source: calibration faults (a reading
  times a constant) of Danesh and Fern 2021; the range is this project's own choice.
  """
  return steady("scale", env, "obs", lambda x, severity, key: x * (1.0 - 0.9 * severity))


def noise(env: Any) -> Fault:
  """Gaussian noise on a reading.   x_i' = x_i + n,  n ~ N(0, (severity scale_i)^2)

  Severity: standard deviation [typical deviations]; realworldrl_suite's levels are 0.1, 0.3, 1.0 in
  raw units. Target: a group of channels (drawn), all, or one channel. Owns `obs`.
  Source: realworldrl_suite.
  """
  scale = scales(env)
  return steady(
    "noise",
    env,
    "obs",
    lambda x, severity, key: x + severity * scale * jax.random.normal(key, scale.shape),
  )


def dropout(env: Any) -> Fault:
  """A reading is lost now and then: 0 in its place.   P(x_i' = 0) = 0.5 severity, each channel and
    step alone

  A loss lasts one control step; those of `dropout_burst` last longer.

  Severity: 1 loses every other reading [probability]; realworldrl_suite has 0.01, 0.05, 0.1.
  Target: a group of channels (drawn), all, or one channel. Owns `obs`. Not visible to: a channel
  that reads 0. Source: dropped observations of realworldrl_suite.
  """
  return loss("dropout", env, "obs")


def freeze(env: Any) -> Fault:
  """A reading stands still: it is not renewed.   P(x_i'(t) = x_i'(t - 1)) = severity, each channel
    and step alone

  A draw holds for one control step; a reading stands for longer only where draws repeat it, in
  `freeze_burst` for a while at once.

  Severity: how likely a reading is held for another step [probability]; 1 holds it for ever.
  Target: a group of channels (drawn), all, or one channel. Owns `obs`. Memory: the last reading; an
  episode's start renews it. Not visible to: a channel that does not change. Source: stuck sensors
  of realworldrl_suite.
  """

  def change(
    held: Float[Array, " obs"], severity: Severity, key: PRNGKeyArray, ports: Ports
  ) -> tuple[Float[Array, " obs"], Float[Array, " obs"]]:
    hold = (jax.random.uniform(key, ports.obs.shape) < severity) & ~jnp.asarray(ports.first)
    value = jnp.where(hold, held, ports.obs)
    return value, value

  return signal("freeze", env, "obs", change, jnp.zeros(len(env.spec.obs)))


def _burst(
  left: Int[Array, " obs"], severity: Severity, key: PRNGKeyArray, ports: Ports
) -> Int[Array, " obs"]:
  """Control steps that the burst of each channel still lasts, this one included; a new one may
  begin where none is under way.
  """
  begins = jax.random.uniform(key, ports.obs.shape) < BURST[0] * severity
  # 0.1, 0.5, 1 are 1, 5, 10, whatever float32 makes of them
  lasts = jnp.maximum(1, jnp.ceil(BURST[1] * severity - 1e-4).astype(jnp.int32))
  left = jnp.where(ports.first, 0, left)
  return jnp.where(left > 0, left, jnp.where(begins, lasts, 0))


def dropout_burst(env: Any) -> Fault:
  """A reading is lost now and then for a while: 0 in its place.   A burst begins with P = 0.1
    severity, each channel alone, and lasts ceil(10 severity) control steps

  Severity: 0.1, 0.5, 1 are realworldrl_suite's easy, medium and hard: probability 0.01, 0.05, 0.1
  [1], length 1, 5, 10 [control steps]. Target: a group of channels (drawn), all, or one channel.
  Owns `obs`. Memory: how long a burst still lasts; an episode's start ends it. Not visible to: a
  channel that reads 0. Source: dropped observations of realworldrl_suite.
  """

  def change(
    left: Int[Array, " obs"], severity: Severity, key: PRNGKeyArray, ports: Ports
  ) -> tuple[Int[Array, " obs"], Float[Array, " obs"]]:
    left = _burst(left, severity, key, ports)
    return jnp.maximum(left - 1, 0), jnp.where(left > 0, 0.0, ports.obs)

  return signal("dropout_burst", env, "obs", change, jnp.zeros(len(env.spec.obs), jnp.int32))


def freeze_burst(env: Any) -> Fault:
  """A reading stands still now and then for a while.   A burst begins with P = 0.1 severity, each
    channel alone, and holds the last reading for ceil(10 severity) control steps

  Severity: 0.1, 0.5, 1 are realworldrl_suite's easy, medium and hard: probability 0.01, 0.05, 0.1
  [1], length 1, 5, 10 [control steps]. Target: a group of channels (drawn), all, or one channel.
  Owns `obs`. Memory: the last reading and how long it is still held; an episode's start renews it.
  Not visible to: a channel that does not change. Source: stuck sensors of realworldrl_suite.
  """

  def change(
    memory: tuple[Int[Array, " obs"], Float[Array, " obs"]],
    severity: Severity,
    key: PRNGKeyArray,
    ports: Ports,
  ) -> tuple[tuple[Int[Array, " obs"], Float[Array, " obs"]], Float[Array, " obs"]]:
    left, held = memory
    left = jnp.where(jnp.asarray(ports.first), 0, _burst(left, severity, key, ports))
    value = jnp.where(left > 0, held, ports.obs)
    return (jnp.maximum(left - 1, 0), value), value

  size = len(env.spec.obs)
  return signal("freeze_burst", env, "obs", change, (jnp.zeros(size, jnp.int32), jnp.zeros(size)))


def delay(env: Any) -> Fault:
  """A reading arrives late.   x_i'(t) = x_i(t - d),  d = ceil(9 severity) control steps

  Severity: 1/3, 2/3, 1 are delays of 3, 6, 9 [control steps], realworldrl_suite's easy, medium,
  hard. Target: a group of channels (drawn), all, or one channel. Owns `obs`. Memory: the last 9
  readings; an episode's start fills it with its first reading. Source: realworldrl_suite.
  """
  return late("delay", env, "obs", "an older reading may be nearer to the present one")


def lidar_loss(env: Any) -> Fault:
  """Beams of a sector return nothing: they read the greatest range.   x_i' = high_i for the first
    ceil(severity n) of the sector's n beams

  Severity: share of the sector that is blind [1]; 1 is all of it. Target: a group of beams (drawn).
  Owns `obs`. Not visible to: beams that see no wall. Source: none; fault and range are this
  project's own choice.
  """
  beams = [(name, index) for name, index in env.spec.obs_groups if name.startswith("lidar")]
  if not beams:
    raise UserError(
      f"fault 'lidar_loss' needs a lidar, which robot {env.spec.name!r} does not have"
    )
  size = len(env.spec.obs)
  rank = jnp.asarray(
    [[hit.index(i) / len(hit) if i in hit else 2.0 for i in range(size)] for _, hit in beams]
  )  # place in the sector, 2 outside it
  high = jnp.asarray([v.high if v.high < 1e9 else 0.0 for v in env.spec.obs], jnp.float32)
  blind = lambda value, place, severity: jnp.where(place < severity, high, value)
  return leafwise("lidar_loss", env, {"obs": blind}, (tuple(name for name, _ in beams), rank, None))


SENSOR = {
  "bias": bias,
  "drift": drift,
  "scale": scale,
  "noise": noise,
  "dropout": dropout,
  "freeze": freeze,
  "dropout_burst": dropout_burst,
  "freeze_burst": freeze_burst,
  "delay": delay,
  "lidar_loss": lidar_loss,
}
