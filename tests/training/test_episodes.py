"""Sums over episodes against a loop, row by row."""

import types

import numpy as np

from mjx_cl.training.episodes import Episodes, Returns


def test_first_and_all_episodes_are_those_of_a_loop():
  rng = np.random.default_rng(0)
  shape = (2, 3)
  first, every, ended = Episodes(shape), Returns(shape), []
  reward = rng.normal(size=(40, *shape)).astype(np.float32)
  terminated, truncated = (rng.random((40, *shape)) < 0.06 for _ in range(2))
  lived = []
  for part in np.split(np.arange(40), 4):
    rows = types.SimpleNamespace(
      reward=reward[part], terminated=terminated[part], truncated=truncated[part]
    )
    lived.append(first.add(rows))
    ended += every.add(rows)
  lived = np.concatenate(lived)
  for at in np.ndindex(shape):
    ends = np.flatnonzero((terminated | truncated)[(slice(None), *at)])
    stop = ends[0] if len(ends) else 39
    own = reward[(slice(stop + 1), *at)].astype(float)
    np.testing.assert_allclose(first.total[at], own.sum(), rtol=1e-12)
    assert first.steps[at] == stop + 1 == lived[(slice(None), *at)].sum()
    assert first.alive[at] == (not len(ends))
    assert first.ended[at] == (len(ends) > 0 and terminated[(stop, *at)])
    pieces = np.split(reward[(slice(None), *at)].astype(float), ends + 1)[: len(ends)]
    found = [value for where, value in ended if where == at]
    np.testing.assert_allclose(found, [x.sum() for x in pieces], rtol=1e-12)
  assert first.ended.any() and not first.ended.all()
