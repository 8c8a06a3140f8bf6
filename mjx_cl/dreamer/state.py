"""What acting, imagining, replaying and training carry: pytrees of the learner."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax


class Carry(NamedTuple):
  """What acting remembers of one robot; zeros at an episode's start.

  Attributes:
    deter: float32 (D,).
    stoch: float32 (stoch * classes,), one-hot.
    action: float32 (A,), the last one that was sampled.
  """

  deter: jax.Array
  stoch: jax.Array
  action: jax.Array


class Latent(NamedTuple):
  """Rows of states as a scan over the prior carries them.

  Attributes:
    chunks: float32 (blocks, N, D / blocks), deter once more.
    deter: float32 (N, D).
    stoch: float32 (N, stoch * classes).
  """

  chunks: jax.Array
  deter: jax.Array
  stoch: jax.Array


class Record(NamedTuple):
  """What replay holds of one robot at one time. A batch of windows is batch-major, (B, 1 + T, ...);
  index 0 is context.

  Attributes:
    obs: float32 (O,).
    action: float32 (A,), chosen after obs, unclipped, zero where `last`.
    reward: float32 (), of arriving at obs.
    first: bool (), obs starts an episode.
    last: bool (), obs ends it.
    terminal: bool (), what follows is worth nothing.
    deter: (D,), latent of acting, float16 in replay.
    stoch: (stoch,), its class indices, uint8 in replay, int32 in a batch.
    demo: float32 (A,), the demonstrator's action at obs.
    has_demo: bool ().
  """

  obs: jax.Array
  action: jax.Array
  reward: jax.Array
  first: jax.Array
  last: jax.Array
  terminal: jax.Array
  deter: jax.Array
  stoch: jax.Array
  demo: jax.Array
  has_demo: jax.Array


class TrainState(NamedTuple):
  """Everything that training one seed changes, replay apart.

  Attributes:
    params: enc, dyn, dec, rew, con, pol, val -> flax parameters.
    slow: slow copy of params["val"].
    opt: optax state (RMS and momentum moments, counters).
    range: float32 (2,), EMA of the returns' 5th and 95th percentile.
    updates: int32 (), gradient steps taken.
  """

  params: dict[str, Any]
  slow: Any
  opt: Any
  range: jax.Array
  updates: jax.Array


class Weights(NamedTuple):
  """Traced weights of the terms that a demonstrator needs; the defaults are plain DreamerV3.

  Attributes:
    clone: weight of KL(N(demo, clone_std^2) || policy) on replayed states.
    policy: weight of the imagined policy loss.
    lr: factor on the learning rate.
  """

  clone: jax.Array | float = 0.0
  policy: jax.Array | float = 1.0
  lr: jax.Array | float = 1.0
