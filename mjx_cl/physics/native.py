"""C MuJoCo inside jit: state crosses JAX as an opaque row, a callback steps the whole batch.

The row is MuJoCo's float64 integration state (time, qpos, qvel, act, warm start, ctrl, applied forces, ...) viewed as uint32,
so nothing is rounded on the way. Every call writes the whole row and every overridden model field before it steps, so no
result depends on what the batch object held before: XLA may repeat or reorder callbacks.
"""
from __future__ import annotations

import threading
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_cl.errors import UserError


def float64_bits(x: jax.Array) -> jax.Array:
  """Float32 (n,) -> uint32 (2n,), the little-endian bits of the same numbers as float64.

  Exact for every normal float32 and for zero; a denormal (below 1.2e-38) becomes zero. Written with integer operations since
  a CPU program without 64-bit mode has no float64.
  """
  bits = jax.lax.bitcast_convert_type(jnp.asarray(x, jnp.float32), jnp.uint32)
  sign, exponent, mantissa = bits & jnp.uint32(0x80000000), (bits >> 23) & 0xFF, bits & 0x7FFFFF
  normal = exponent > 0
  high = jnp.where(normal, sign | ((exponent + 896) << 20) | (mantissa >> 3), sign)  # 1023 - 127 = 896
  low = jnp.where(normal, (mantissa & 7) << 29, jnp.uint32(0))
  return jnp.stack([low, high], -1).reshape(-1)


class Native:
  """C MuJoCo by mjbatch.

  Args:
    mj_model: mujoco.MjModel, copied.
    substeps: physics steps of one `step`.
    outputs: MjData fields to return. `qpos` and `qvel` are current; a derived field (xpos, sensordata, ...) makes every call end
      with mj_forward so that it is current too.
  """
  name = "native"

  def __init__(self, mj_model: mujoco.MjModel, substeps: int, outputs: tuple[str, ...] = ("qpos", "qvel")):
    try:
      import mjbatch
    except ImportError:
      raise UserError("physics 'native' needs the package mjbatch (pip install mjbatch==0.1.4; Linux and macOS)") from None
    self._mjbatch = mjbatch
    self.mj_model, self.substeps, self.outputs = mj_model, substeps, tuple(outputs)
    self._forward = any(o not in ("qpos", "qvel") for o in outputs)
    data = mujoco.MjData(mj_model)
    spec = mujoco.mjtState.mjSTATE_INTEGRATION
    row = np.empty(mujoco.mj_stateSize(mj_model, spec))
    mujoco.mj_getState(mj_model, data, row, spec)
    self._template = row.view(np.uint32).copy()
    self._qpos_at = mujoco.mj_stateSize(mj_model, mujoco.mjtState.mjSTATE_TIME)
    self._shapes = {o: np.shape(getattr(data, o)) for o in self.outputs}
    self._batches: dict[int, object] = {}
    self._lock = threading.Lock()
    self.seconds = 0.0  # spent in callbacks since the start, for a run's wall_share

  def init(self, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Row (uint32, opaque) of the model's initial state with qpos (nq,) and qvel (nv,). Makes no callback."""
    at = 2 * self._qpos_at
    nq, nv = 2 * self.mj_model.nq, 2 * self.mj_model.nv
    row = jnp.asarray(self._template)
    return row.at[at:at + nq].set(float64_bits(qpos)).at[at + nq:at + nq + nv].set(float64_bits(qvel))

  def step(self, fields: dict[str, jax.Array], state: jax.Array, ctrl: jax.Array):
    """`substeps` x mj_step of one robot; a vmap of it steps all robots in one call on all threads."""
    shapes = {o: jax.ShapeDtypeStruct(s, jnp.float32) for o, s in self._shapes.items()}
    result = (jax.ShapeDtypeStruct(self._template.shape, jnp.uint32), shapes)
    return jax.pure_callback(self._host_step, result, fields, state, ctrl, vmap_method="broadcast_all")

  def _host_step(self, fields, state, ctrl):
    begin = time.perf_counter()
    state = np.asarray(state)
    lead, width = state.shape[:-1], state.shape[-1]
    num = int(np.prod(lead, dtype=np.int64))
    with self._lock:
      batch, views = self._batch(num, tuple(sorted(fields)))
      views["state"][...] = np.ascontiguousarray(state.reshape(num, width)).view(np.float64)
      views["ctrl"][...] = np.asarray(ctrl).reshape(num, -1)
      for name, value in fields.items():
        view = views["field " + name]
        view[...] = np.asarray(value).reshape(view.shape)
      batch.step(nstep=self.substeps)
      out = {o: np.array(views["out " + o], np.float32).reshape(lead + self._shapes[o]) for o in self.outputs}
      rows = np.array(views["state"]).view(np.uint32).reshape(lead + (width,))
      self.seconds += time.perf_counter() - begin
      return rows, out

  def _batch(self, num: int, fields: tuple[str, ...]):
    key = (num, fields)
    if key not in self._batches:
      batch = self._mjbatch.Batch(self.mj_model, num, forward=self._forward)
      views = {"state": batch.bind("state"), "ctrl": batch.bind("ctrl")}
      views |= {"field " + f: batch.expand(f) for f in fields}
      views |= {"out " + o: batch.bind(o) for o in self.outputs}
      self._batches[key] = (batch, views)
    return self._batches[key]
