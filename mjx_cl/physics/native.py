"""C MuJoCo inside jit: state crosses JAX as an opaque row, a callback steps the whole batch.

The row is MuJoCo's float64 integration state (time, qpos, qvel, act, warm start, ctrl, applied
forces, ...) viewed as uint32, so nothing is rounded on the way. Every call writes the whole row and
every overridden model field before it steps, so no result depends on what the batch object held
before: XLA may repeat or reorder callbacks, and instances of one model share a host.
"""

import copy
import functools
import hashlib
import json
import math
import threading
import time
import types
import uuid
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_cl.errors import UserError
from mjx_cl.physics import host_call
from mjx_cl.physics.fields import DERIVING

FEW = 16  # robots of a call among which repetitions are looked for, see runs/lives.py


def float64_bits(x: jax.Array) -> jax.Array:
  """Float32 (n,) -> uint32 (2n,), the little-endian bits of the same numbers as float64.

  Exact for every normal float32 and for zero; a denormal (below 1.2e-38) becomes zero. Written with
  integer operations since a CPU program without 64-bit mode has no float64.
  """
  bits = jax.lax.bitcast_convert_type(jnp.asarray(x, jnp.float32), jnp.uint32)
  sign, exponent, mantissa = bits & jnp.uint32(0x80000000), (bits >> 23) & 0xFF, bits & 0x7FFFFF
  normal, shift = exponent > 0, 1023 - 127  # what the two formats add to an exponent
  high = jnp.where(normal, sign | ((exponent + shift) << 20) | (mantissa >> 3), sign)
  low = jnp.where(normal, (mantissa & 7) << 29, jnp.uint32(0))
  return jnp.stack([low, high], -1).reshape(-1)


def identity(
  mj_model: mujoco.MjModel, substeps: int, outputs: tuple[str, ...], law: Callable[..., Any] | None
) -> str:
  """A name for all that a host's results depend on: 32 hexadecimal digits, the same in every
  process, of the model's bytes, the arguments and the motor law.

  A law counts by its module, code and what it closes over: a name has to tell the laws of one
  process apart, no more. Where it cannot (a callable object, a closure over one), it is a new one
  each time, and programs with it are not found in the cache.
  """
  model = np.empty(mujoco.mj_sizeModel(mj_model), np.uint8)
  mujoco.mj_saveModel(mj_model, None, model)
  digest = hashlib.sha256(model.tobytes())
  try:
    digest.update(repr((substeps, outputs, _words(law))).encode())
  except TypeError:
    return uuid.uuid4().hex
  return digest.hexdigest()[:32]


def _words(x: Any) -> tuple[Any, ...]:
  """What tells a motor law from another, or a value that it closes over."""
  if x is None or x is Ellipsis or isinstance(x, (bool, int, float, complex, str, bytes)):
    return (type(x).__name__, x)
  if isinstance(x, frozenset):
    return ("frozenset", *sorted(map(repr, map(_words, x))))
  if isinstance(x, (tuple, list)):
    return (type(x).__name__, *map(_words, x))
  if isinstance(x, (np.ndarray, np.generic)) and x.dtype != object:
    return ("array", x.dtype.str, x.shape, x.tobytes())
  if isinstance(x, types.CodeType):
    return ("code", x.co_code, x.co_names, x.co_freevars, *map(_words, x.co_consts))
  if isinstance(x, types.FunctionType):
    cells = [c.cell_contents for c in x.__closure__ or ()]
    return (
      "law",
      x.__module__,
      x.__qualname__,
      *map(_words, (x.__code__, cells, x.__defaults__, sorted((x.__kwdefaults__ or {}).items()))),
    )
  raise TypeError(f"no name for {type(x).__name__}")


class Native:
  """C MuJoCo by mjbatch.

  Args:
    mj_model: mujoco.MjModel, copied.
    substeps: physics steps of one `step`.
    outputs: MjData fields to return. `qpos` and `qvel` are current; a derived field (xpos,
      sensordata, ...) makes every call end with mj_forward so that it is current too.
    law: motor law, evaluated before every physics step, see physics.Law; None: `ctrl` goes to the
      actuators as it is. With a law the outputs also hold `ctrl` (nu,), what the law gave last, and
      `qvel_before` (nv,), the velocity before the last physics step.
  """

  name = "native"

  def __init__(
    self,
    mj_model: mujoco.MjModel,
    substeps: int,
    outputs: tuple[str, ...] = ("qpos", "qvel"),
    law: Callable[..., Any] | None = None,
  ) -> None:
    try:
      import mjbatch  # noqa: F401
    except ImportError:
      raise UserError(
        "physics 'native' needs the package mjbatch (pip install mjbatch==0.1.4; Linux and macOS)"
      ) from None
    self.mj_model, self.substeps, self.outputs, self.law = mj_model, substeps, tuple(outputs), law
    make = lambda: Host(copy.copy(mj_model), substeps, self.outputs, law)
    name = identity(mj_model, substeps, self.outputs, law)
    self.host = host_call.shared(name, make)
    of = lambda function: getattr(function, "__globals__", None)
    if of(self.host.law) is not of(law):  # the same words in another module of the same name
      name = uuid.uuid4().hex
      self.host = host_call.shared(name, make)
    self._name = name
    self._qpos_at = mujoco.mj_stateSize(mj_model, mujoco.mjtState.mjSTATE_TIME)

  @property
  def seconds(self) -> float:
    """Spent in calls to the host since its start, for a run's wall_share."""
    return self.host.seconds

  def init(self, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Row (uint32, opaque) of the model's initial state with qpos (nq,) and qvel (nv,). Makes no
    callback.
    """
    at = 2 * self._qpos_at
    bits = jnp.concatenate([float64_bits(qpos), float64_bits(qvel)])
    return jnp.asarray(self.host.template).at[at : at + bits.shape[0]].set(bits)

  def step(
    self,
    fields: dict[str, jax.Array],
    state: jax.Array,
    ctrl: jax.Array,
    task: dict[str, jax.Array] | None = None,
    force: jax.Array | None = None,
  ) -> tuple[jax.Array, dict[str, jax.Array]]:
    """`substeps` x mj_step of one robot; a vmap of it steps all robots in one call on all threads.

    Everything crosses to the host and back as one array of bits each way: one operand, whatever the
    fields.
    """
    given = {"ctrl": ctrl} | ({} if force is None else {"force": force})
    given |= {f"field {k}": v for k, v in fields.items()}
    given |= {f"task {k}": v for k, v in (task or {}).items()} if self.law is not None else {}
    given = {k: jnp.asarray(v, jnp.float32) for k, v in given.items()}
    layout = json.dumps([(k, v.shape) for k, v in given.items()])
    bits = [jax.lax.bitcast_convert_type(v, jnp.uint32).reshape(-1) for v in given.values()]
    shapes = self.host.shapes
    *ends, width = np.cumsum([state.shape[0], *(math.prod(s) for s in shapes.values())]).tolist()
    out = host_call.call(self._name, layout, width, jnp.concatenate([state, *bits]))
    row, *parts = jnp.split(out, ends)
    return row, {
      name: jax.lax.bitcast_convert_type(part, jnp.float32).reshape(shape)
      for (name, shape), part in zip(shapes.items(), parts)
    }


@functools.cache
def _read(layout: str) -> tuple[dict[str, tuple[int, ...]], np.ndarray]:
  """{name: shape} of every array behind the state, as `Native.step` wrote them, and where each
  begins.
  """
  shapes = {name: tuple(shape) for name, shape in json.loads(layout)}
  return shapes, np.cumsum([0, *map(math.prod, shapes.values())])[:-1]


class Host:
  """What stands behind a `Native` outside JAX: steps batches of its model, one call after another.

  Attributes:
    template: uint32, the row of the model's initial state.
    shapes: {output: shape}.
    seconds: spent in calls.
  """

  def __init__(
    self,
    mj_model: mujoco.MjModel,
    substeps: int,
    outputs: tuple[str, ...],
    law: Callable[..., Any] | None,
  ) -> None:
    self.mj_model, self.substeps, self.outputs, self.law = mj_model, substeps, outputs, law
    self._forward = any(o not in ("qpos", "qvel") for o in outputs)
    data = mujoco.MjData(mj_model)
    spec = mujoco.mjtState.mjSTATE_INTEGRATION
    row = np.empty(mujoco.mj_stateSize(mj_model, spec))
    mujoco.mj_getState(mj_model, data, row, spec)
    self.template = row.view(np.uint32).copy()
    self.shapes = {o: np.shape(getattr(data, o)) for o in outputs}
    if law is not None:
      self.shapes |= {"ctrl": (mj_model.nu,), "qvel_before": (mj_model.nv,)}
    self._batches: dict[tuple[int, tuple[str, ...], bool], tuple[Any, dict[str, np.ndarray]]] = {}
    self._lock = threading.Lock()
    self.seconds = 0.0

  def __call__(self, layout: str, packed: np.ndarray) -> np.ndarray:
    """`step` on one array of bits, (..., state + everything in `layout`) -> (..., state
    + outputs). Of a few robots those that are the same in every bit are stepped once.
    """
    rows = packed.reshape(-1, packed.shape[-1])
    if 1 < len(rows) <= FEW:
      first = {row.tobytes(): i for i, row in reversed(list(enumerate(rows)))}
      if len(first) < len(rows):
        own = sorted(first.values())
        place = [own.index(first[row.tobytes()]) for row in rows]
        return self._step(layout, rows[own])[place].reshape(packed.shape[:-1] + (-1,))
    return self._step(layout, packed)

  def _step(self, layout: str, packed: np.ndarray) -> np.ndarray:
    shapes, begins = _read(layout)
    state, *parts = np.split(packed, len(self.template) + begins, -1)
    lead = packed.shape[:-1]
    given = {
      name: part.view(np.float32).reshape(lead + shape)
      for (name, shape), part in zip(shapes.items(), parts)
    }
    named = lambda kind: {k.removeprefix(kind): v for k, v in given.items() if k.startswith(kind)}
    rows, out = self.step(named("field "), state, given["ctrl"], named("task "), given.get("force"))
    flat = [out[o].reshape(lead + (-1,)).view(np.uint32) for o in self.shapes]
    return np.concatenate([rows, *flat], -1)

  def step(
    self,
    fields: dict[str, np.ndarray],
    state: np.ndarray,
    ctrl: np.ndarray,
    task: dict[str, np.ndarray] | None = None,
    force: np.ndarray | None = None,
  ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """`Native.step` on NumPy arrays with any leading axes: (rows, {output: float32})."""
    state = np.asarray(state)
    lead, width = state.shape[:-1], state.shape[-1]
    num = math.prod(lead)
    flat = lambda x: np.asarray(x).reshape((num,) + np.shape(x)[len(lead) :])
    with self._lock:
      begin = time.perf_counter()
      batch, views = self._batch(num, tuple(sorted(fields)), force is not None)
      self._write_fields(batch, views, fields, num)
      views["state"][...] = np.ascontiguousarray(state.reshape(num, width)).view(np.float64)
      if force is not None:
        views["force"][...] = flat(force)
      extra = {}
      if self.law is None:
        views["ctrl"][...] = flat(ctrl)
        batch.step(nstep=self.substeps)
      else:
        task, ctrl = {k: flat(v) for k, v in (task or {}).items()}, flat(ctrl)
        for _ in range(self.substeps):
          views["ctrl"][...] = self.law(np, task, ctrl, views["qpos"], views["qvel"])
          extra = {"ctrl": views["ctrl"].copy(), "qvel_before": views["qvel"].copy()}
          batch.step(nstep=1)
      out = {o: views["out " + o] for o in self.outputs} | extra
      out = {k: np.array(v, np.float32).reshape(lead + v.shape[1:]) for k, v in out.items()}
      rows = np.array(views["state"]).view(np.uint32).reshape(lead + (width,))
      self.seconds += time.perf_counter() - begin
      return rows, out

  def _write_fields(
    self, batch: Any, views: dict[str, np.ndarray], fields: dict[str, np.ndarray], num: int
  ) -> None:
    """Model fields of every robot, in double precision where they are the nominal ones; constants
    derived of a changed mass are renewed.
    """
    stale = np.zeros(num, bool)
    for name, value in fields.items():
      view, own, held = views["field " + name], views["nominal " + name], views["held " + name]
      value = np.asarray(value).reshape(view.shape)
      # what a field holds follows from the last value written alone, so it is there already
      if np.array_equal(value, held):
        continue
      held[...] = value
      # float32 cannot hold every nominal value: severity 0 is the model itself
      value = np.where(value == own.astype(np.float32), own, value)
      if name in DERIVING:
        stale |= (view != value).reshape(num, -1).any(1)
      view[...] = value
    if stale.any():
      batch.set_const(np.flatnonzero(stale))

  def _batch(
    self, num: int, fields: tuple[str, ...], force: bool
  ) -> tuple[Any, dict[str, np.ndarray]]:
    import mjbatch

    key = (num, fields, force)
    if key not in self._batches:
      batch = mjbatch.Batch(self.mj_model, num, forward=self._forward)
      views = {name: batch.bind(name) for name in ("state", "ctrl", "qpos", "qvel")}
      if force:
        views["force"] = batch.bind("qfrc_applied")
      for f in fields:
        view = batch.expand(f)
        held = np.full(view.shape, np.nan, np.float32)  # equal to nothing yet
        views |= {"field " + f: view, "held " + f: held, "nominal " + f: np.array(view[0])}
      views |= {"out " + o: batch.bind(o) for o in self.outputs}
      self._batches[key] = (batch, views)
    return self._batches[key]
