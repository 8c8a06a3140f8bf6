"""Checkpoints: what is read has the placement of what it takes the place of."""
import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.checkpoint import Checkpoints


def test_arrays_come_back_as_free_or_bound_as_they_were(tmp_path):
  """An array that is bound to a device where it was free before would be another program to `jax.jit`."""
  device = jax.devices()[0]
  tree = {"free": jnp.arange(6.0).reshape(2, 3), "bound": jax.device_put(jnp.arange(4), device), "host": np.arange(3), "key": jax.random.key(3),
          "keys": jax.random.split(jax.random.key(4), 2), "empty": jnp.zeros((0, 2)), "half": jnp.ones(2, jnp.float16), "flag": jnp.array([True, False])}
  checkpoints = Checkpoints(tmp_path / "c")
  checkpoints.save(1, tree, {"n": 7})
  like = jax.tree.map(lambda x: x if x.dtype == tree["key"].dtype else (np if isinstance(x, np.ndarray) else jnp).zeros_like(x), tree) | {"bound": jax.device_put(jnp.zeros(4, int), device)}
  got, meta = checkpoints.load(like)
  checkpoints.close()
  assert meta == {"n": 7} and got.keys() == tree.keys()
  for name, x in tree.items():
    y = got[name]
    assert (type(y), y.shape, y.dtype) == (type(x), x.shape, x.dtype), name
    assert getattr(y, "committed", None) == getattr(x, "committed", None) == {"bound": True, "host": None}.get(name, False), name
    data = lambda v: np.asarray(jax.random.key_data(v) if "key" in name else v)
    np.testing.assert_array_equal(data(x), data(y), err_msg=name)
  program = jax.jit(lambda t: t["free"].sum() + t["half"].sum())
  program({k: tree[k] for k in ("free", "half")})
  program({k: got[k] for k in ("free", "half")})
  assert program._cache_size() == 1
