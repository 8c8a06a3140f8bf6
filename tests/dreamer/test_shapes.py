"""Shapes of the rooms that compute are checked at every call of a test, inner functions apart."""

import jax.numpy as jnp
import pytest

from mjx_cl.dreamer import nets
from mjx_cl.rollout import scan


def test_a_wrong_shape_or_type_is_refused():
  bins = jnp.linspace(-1.0, 1.0, 5)
  assert nets.two_hot_mean(jnp.zeros((2, 3, 5)), bins).shape == (2, 3)
  with pytest.raises(TypeError, match="bins"):
    nets.two_hot_mean(jnp.zeros((2, 3, 7)), bins)
  with pytest.raises(TypeError, match="Type-check error"):
    nets.symlog(jnp.zeros(3, jnp.int32))
  with pytest.raises(TypeError, match="mask"):
    scan.expand(jnp.zeros(3), jnp.zeros((3, 2)))
