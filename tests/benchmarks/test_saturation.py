"""The arm that frees actions which are stuck at their limit (benchmarks/saturation.py)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import saturation
from mjx_cl.adapt import methods
from mjx_cl.config import DreamerConfig
from mjx_cl.dreamer.agent import Agent
from mjx_cl.dreamer.state import Record

OBS, ACT, ROWS, LENGTH = 5, 3, 2, 16


def test_an_action_is_stuck_where_nearly_all_states_lie_to_one_side():
  n = np.arange(100)
  raw = np.stack(
    [6.0 + 0 * n, -6.0 + 0 * n, np.where(n % 2, 6.0, -6.0), np.where(n < 4, 0, 6.0)], 1
  )
  np.testing.assert_allclose(saturation.one_sided(raw), [6, 6, -6, 6])
  np.testing.assert_array_equal(saturation.one_sided(np.where(n < 20, 0.0, 6.0)[:, None]), [0])


@pytest.fixture(scope="module")
def whole():
  """(agent, state, batch) whose middle action is stuck."""
  agent = Agent(DreamerConfig(size="tiny", batch=ROWS, length=LENGTH), OBS, ACT)
  state = agent.init(jax.random.key(0))
  head = state.params["pol"]["mean"]
  # the output layer begins at nought: give every action a slope, the middle one a bias of 6
  kernel = 0.1 * jax.random.normal(jax.random.key(1), head["kernel"].shape)
  head = {"kernel": kernel, "bias": jnp.asarray([0.0, 6.0, 0.0])}
  state = state._replace(params={**state.params, "pol": {**state.params["pol"], "mean": head}})
  state = state._replace(
    opt=jax.tree.map(lambda x: x + 1 if x.dtype == jnp.float32 else x, state.opt)
  )
  size, rng = agent.size, np.random.default_rng(0)
  n = lambda *shape: rng.standard_normal((ROWS, LENGTH + 1, *shape)).astype(np.float32)
  no = np.zeros((ROWS, LENGTH + 1), bool)
  stoch = rng.integers(0, size.classes, (ROWS, LENGTH + 1, size.stoch))
  return agent, state, Record(n(OBS), n(ACT), n(), no, no, no, n(size.deter), stoch, n(ACT), no)


def pre(agent, params, batch):
  return np.asarray(agent._apply(params, "pol", batch.deter, agent.hot(batch.stoch))[0]).reshape(
    -1, ACT
  )


def test_what_is_stuck_is_freed_and_nothing_else(whole):
  agent, state, batch = whole
  before, new = pre(agent, state.params, batch), jax.jit(saturation.free, static_argnums=0)(*whole)
  after = pre(agent, new.params, batch)
  assert np.median(np.abs(before[:, 1])) > 4
  assert np.median(np.abs(after[:, 1])) == pytest.approx(saturation.FREE, rel=1e-5)
  np.testing.assert_array_equal(after[:, [0, 2]], before[:, [0, 2]])
  changed = {
    jax.tree_util.keystr(path)
    for (path, a), b in zip(jax.tree_util.tree_flatten_with_path(state)[0], jax.tree.leaves(new))
    if not np.array_equal(a, b)
  }
  assert changed and all("['pol']['mean']" in name for name in changed)
  ema = [
    np.asarray(x)
    for p, x in jax.tree_util.tree_flatten_with_path(new.opt)[0]
    if ".ema" in jax.tree_util.keystr(p) and "['pol']['mean']" in jax.tree_util.keystr(p)
  ]
  assert all((x[..., 1] == 0).all() and (x[..., [0, 2]] == 1).all() for x in ema) and len(ema) == 2


def test_a_second_look_finds_nothing_stuck(whole):
  agent, _, batch = whole
  once = saturation.free(*whole)
  twice = saturation.free(agent, once, batch)
  np.testing.assert_allclose(pre(agent, twice.params, batch), pre(agent, once.params, batch))


def test_the_arm_keeps_the_contract_and_frees_in_the_first_updates_alone(whole):
  agent, state, batch = whole
  method = methods.of(saturation.freed())
  methods.check("freed", method, agent)
  memory = methods.remember(method, state.params)
  update = jax.jit(method.update, static_argnums=0)
  far = lambda memory: np.median(
    pre(agent, update(agent, memory, state, batch, jax.random.key(2))[0].params, batch)[:, 1]
  )
  later = memory._replace(own=jnp.int32(1))
  assert abs(far(memory)) < 2 < 4 < far(later)
