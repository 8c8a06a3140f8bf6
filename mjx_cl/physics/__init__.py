"""Two physics backends behind one interface.

  native   C MuJoCo, the whole batch of a vmap stepped by mjbatch in one host callback; needs no
    compile time
  mjx      the same model in pure JAX; for a GPU, and as the reference that parity is measured
    against

Both offer `init(qpos, qvel) -> state` and `step(fields, state, ctrl, task, force) -> (state, out)`
for one robot, where `fields` maps MuJoCo field names (mjModel's and `gravity` of mjOption) to
arrays that replace the model's own for this call, `force` (nv,) is a generalised force applied from
outside [N, N m] or None, and `out` maps MjData names to float32 arrays.

A motor law `law(xp, task, ctrl, qpos, qvel) -> (..., nu)` turns what the agent commands into what
the actuators get, at every physics step. `xp` is numpy (native, the whole batch: ctrl (N, A), qpos
(N, nq), qvel (N, nv), task name -> (N, ...)) or jax.numpy (one robot, no leading axis), so it is
written with `xp` alone and with `...` indices. `task` holds the leaves of types.Model.task.
"""

import types
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import mujoco

from mjx_cl.errors import UserError
from mjx_cl.io import runtime
from mjx_cl.physics.native import Native

# in the place of a backend where there is none: no time is spent outside the compiled program
PURE_JAX = types.SimpleNamespace(name="jax", seconds=0.0)


def make(
  name: str,
  mj_model: mujoco.MjModel,
  substeps: int,
  outputs: tuple[str, ...] = ("qpos", "qvel"),
  law: Callable[..., Any] | None = None,
) -> Any:
  """Builds a backend, a Native or an Mjx. `auto` is `runtime.default_physics()`."""
  if name == "auto":
    name = runtime.default_physics()
  if name == "native":
    return Native(mj_model, substeps, outputs, law)
  if name == "mjx":
    from mjx_cl.physics.mjx import Mjx  # a costly import

    return Mjx(mj_model, substeps, outputs, law)
  raise UserError(f"unknown physics {name!r}; choose from: auto, native, mjx")


def leaves(mj_model: mujoco.MjModel, *names: str, backend: Any = None) -> dict:
  """Nominal values of model fields as float32 arrays, for types.Model.mj; `gravity` is mjOption's.

  Fields that `backend` names as `inert`, because they do nothing there, are left out.
  """
  inert = getattr(backend, "inert", ())
  values = {
    name: getattr(mj_model.opt if name == "gravity" else mj_model, name)
    for name in names
    if name not in inert
  }
  return {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}
