"""Lanes: two arms of a seed live the same life to the last bit until one of them learns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl.config import AdaptConfig, RunConfig
from mjx_cl.rollout.order import Lanes
from mjx_cl.runs import run


def test_order_by_hand():
  lanes = Lanes(
    3, 2, "cpu"
  )  # streams: arm 0 has 0 and 1, arm 1 has 2 and 3, arm 2 has 4 and 5; four lanes a seed
  assert (
    lanes.order.tolist() == [0, 2, 4, 0, 1, 3, 5, 1]
    and lanes.place.tolist() == [0, 4, 1, 5, 2, 6]
    and not lanes.plain
  )
  assert Lanes(2, 3, "cpu").order.tolist() == [0, 3, 1, 4, 2, 5]
  for plain in (Lanes(1, 10, "cpu"), Lanes(2, 2, "cpu"), Lanes(2, 10, "gpu")):
    assert plain.plain and plain.order.tolist() == plain.place.tolist() == list(
      range(len(plain.order))
    )


@pytest.mark.parametrize("arms, seeds", [(2, 3), (3, 5), (5, 2), (12, 1), (1, 7)])
def test_there_and_back(arms, seeds):
  lanes, streams = (
    Lanes(arms, seeds, "cpu"),
    {
      "x": jnp.arange(arms * seeds * 2).reshape(arms * seeds, 2),
      "key": jax.vmap(jax.random.key)(jnp.arange(arms * seeds)),
    },
  )
  spread = lanes.spread(streams)
  back = lanes.gather(spread)
  np.testing.assert_array_equal(back["x"], streams["x"])
  assert (back["key"] == streams["key"]).all()
  np.testing.assert_array_equal(
    lanes.gather_rows(jnp.stack([spread["x"], -spread["x"]]))[1], -streams["x"]
  )
  for seed in range(seeds):  # arms of a seed lie in one block, whose length is a power of two
    at = lanes.place.reshape(arms, seeds)[:, seed]
    width = 1 << (arms - 1).bit_length()
    assert lanes.plain or len(set(at // width)) == 1


def test_arms_live_the_same_life(tmp_path):
  """The shipped quadruped in three arms before the onset: rewards, residuals and what the agents
  remember. In their own order some of these 15 streams differ.
  """
  seeds = 5
  runner = run.Runner(
    RunConfig(
      "quadruped",
      fault="payload",
      seeds=seeds,
      arms=("detector", "oracle", "none"),
      steps=640,
      onset=600,
      physics="native",
      adapt=AdaptConfig(warmup=500),
    ),
    tmp_path,
  )
  for _ in range(4):
    runner.step()
  by_arm = lambda x: np.asarray(x).reshape((3, seeds) + x.shape[1:])
  carry = jax.tree.map(by_arm, runner.state.streams.agent._asdict())
  trace = {k: np.asarray(v) for k, v in runner.trace().items() if k in ("reward", "opr", "rpr")}
  carry |= {k: by_arm(v.T) for k, v in trace.items()}
  assert all(np.isfinite(carry[k][:, :, 20:]).mean() > 0.8 for k in trace)
  assert len(np.unique(carry["reward"][0, :, -1])) == seeds
  for name, x in carry.items():
    np.testing.assert_array_equal(x[1], x[0], err_msg=name)
    np.testing.assert_array_equal(x[2], x[0], err_msg=name)
