"""The same MuJoCo model in pure JAX."""
from __future__ import annotations

import contextlib
import io

import jax
import jax.numpy as jnp
import mujoco

with contextlib.redirect_stdout(io.StringIO()):  # the import prints a line on standard output when warp is absent
  from mujoco import mjx


class Mjx:
  """MuJoCo XLA. Arguments and methods as `native.Native`; float32 throughout; state is an `mjx.Data`."""
  name = "mjx"

  def __init__(self, mj_model: mujoco.MjModel, substeps: int, outputs: tuple[str, ...] = ("qpos", "qvel")):
    self.mj_model, self.substeps, self.outputs = mj_model, substeps, tuple(outputs)
    self._forward = any(o not in ("qpos", "qvel") for o in outputs)
    self._model = mjx.put_model(mj_model, impl="jax")
    self._data = mjx.make_data(mj_model, impl="jax")

  def init(self, qpos: jax.Array, qvel: jax.Array):
    """mjx.Data at qpos (nq,), qvel (nv,)."""
    return self._data.replace(qpos=jnp.asarray(qpos, jnp.float32), qvel=jnp.asarray(qvel, jnp.float32))

  def step(self, fields: dict[str, jax.Array], state, ctrl: jax.Array):
    model = self._model.replace(**fields)
    state = state.replace(ctrl=jnp.asarray(ctrl, state.ctrl.dtype))
    state, _ = jax.lax.scan(lambda d, _: (mjx.step(model, d), None), state, None, length=self.substeps)
    if self._forward:
      state = mjx.forward(model, state)
    return state, {o: getattr(state, o) for o in self.outputs}
