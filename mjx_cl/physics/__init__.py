"""Two physics backends behind one interface.

  native   C MuJoCo, the whole batch of a vmap stepped by mjbatch in one host callback; needs no compile time
  mjx      the same model in pure JAX; for a GPU, and as the reference that parity is measured against

Both offer `init(qpos, qvel) -> state` and `step(fields, state, ctrl) -> (state, out)` for one robot, where `fields` maps
MuJoCo field names to arrays that replace the model's own for this call and `out` maps MjData names to float32 arrays.
"""
from mjx_cl import runtime
from mjx_cl.errors import UserError


def make(name: str, mj_model, substeps: int, outputs: tuple[str, ...] = ("qpos", "qvel")):
  """Builds a backend. `auto` is `runtime.default_physics()`."""
  if name == "auto":
    name = runtime.default_physics()
  if name == "native":
    from mjx_cl.physics.native import Native
    return Native(mj_model, substeps, outputs)
  if name == "mjx":
    from mjx_cl.physics.mjx import Mjx
    return Mjx(mj_model, substeps, outputs)
  raise UserError(f"unknown physics {name!r}; choose from: auto, native, mjx")
