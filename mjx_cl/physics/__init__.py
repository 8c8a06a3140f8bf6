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

from __future__ import annotations

import types
from typing import TYPE_CHECKING, Any

from mjx_cl.errors import UserError
from mjx_cl.io import runtime

if TYPE_CHECKING:
  from collections.abc import Callable

  import mujoco

  from mjx_cl.physics.mjx import Mjx
  from mjx_cl.physics.native import Native

# in the place of a backend where there is none: no time is spent outside the compiled program
PURE_JAX = types.SimpleNamespace(name="jax", seconds=0.0)


def make(
  name: str,
  mj_model: mujoco.MjModel,
  substeps: int,
  outputs: tuple[str, ...] = ("qpos", "qvel"),
  law: Callable[..., Any] | None = None,
) -> Mjx | Native:
  """Builds a backend. `auto` is `runtime.default_physics()`."""
  if name == "auto":
    name = runtime.default_physics()
  if name == "native":
    from mjx_cl.physics.native import Native

    return Native(mj_model, substeps, outputs, law)
  if name == "mjx":
    from mjx_cl.physics.mjx import Mjx

    return Mjx(mj_model, substeps, outputs, law)
  raise UserError(f"unknown physics {name!r}; choose from: auto, native, mjx")


def leaves(mj_model: mujoco.MjModel, *names: str, backend: Any = None) -> dict:
  """Nominal values of model fields as float32 arrays, for types.Model.mj; `gravity` is mjOption's.

  Fields that `backend` names as `inert`, because they do nothing there, are left out.
  """
  import jax.numpy as jnp

  value = lambda name: mj_model.opt.gravity if name == "gravity" else getattr(mj_model, name)
  inert = getattr(backend, "inert", ())
  return {name: jnp.asarray(value(name), jnp.float32) for name in names if name not in inert}
