"""The signals of a chunk are those of the weights that act, all six of them."""

import types

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.adapt import watch
from mjx_cl.adapt.decide import SIGNALS
from mjx_cl.detectors import Alarm, Detector
from mjx_cl.dreamer.agent import TrainState
from mjx_cl.rollout.monitor import History, unknown
from mjx_cl.rollout.scan import Row

T, GROUPS = 4, 2


def test_all_signals_are_of_the_weights_that_act():
  """Residuals and losses say which weights they were computed with: parameters are one number."""
  shape = (T, GROUPS, 1)
  zeros = lambda *more: jnp.zeros(shape + more)
  flags = jnp.zeros(shape, bool)
  rows = Row(
    zeros(3), flags, zeros(), zeros(2), zeros(4), zeros(2).astype(int), zeros(), zeros(1), zeros(3),
    flags, flags, None, None, zeros(2), flags,
  )  # fmt: skip
  history = History(zeros(4), zeros(2).astype(int), zeros(2), zeros(3), zeros(), flags, flags)
  of = lambda params: jnp.broadcast_to(params[:, None], shape)
  residual = lambda params: unknown(shape, 3)._replace(opr=of(params), rpr=of(params))

  def loss(params, slow, range_, batch, key):
    return params, ({"loss/dyn": params, "adv_mag": params, "loss/value": params},)

  learner = jnp.array([5.0, 7.0])
  state = types.SimpleNamespace(
    acting=jnp.array([1.0, 2.0]),
    train=TrainState(learner, learner, (), learner, jnp.zeros(GROUPS, int)),
    history=history,
    detector=jnp.zeros(GROUPS),
    past=unknown((2, GROUPS), 3),
  )
  seen, *_ = watch.watch(
    types.SimpleNamespace(loss=loss),
    types.SimpleNamespace(update=lambda params, history, rows, key: (history, residual(params))),
    Detector(lambda: jnp.float32(0), lambda s, x: (s, Alarm(jnp.bool_(False), x.opr))),
    types.SimpleNamespace(posture=None),
    state,
    rows,
    jax.vmap(lambda k: jax.random.split(k, 2))(jax.random.split(jax.random.key(0), GROUPS)),
  )
  signals = dict(zip(SIGNALS, np.asarray(seen.signals).T))
  for name in set(SIGNALS) - {"reward"}:
    np.testing.assert_array_equal(signals[name], [1.0, 2.0], err_msg=name)
