"""The same MuJoCo model in pure JAX."""

import contextlib
import io
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_cl.errors import UserError
from mjx_cl.physics.fields import DERIVING

# the import prints a line on standard output when warp is absent
with contextlib.redirect_stdout(io.StringIO()):
  from mujoco import mjx


class Mjx:
  """MuJoCo XLA. Arguments and methods as `native.Native`; float32 throughout; state is an
  `mjx.Data`. `model`: the mjx.Model of `mj_model`, where there is one already.
  """

  name = "mjx"

  def __init__(
    self,
    mj_model: mujoco.MjModel,
    substeps: int,
    outputs: tuple[str, ...] = ("qpos", "qvel"),
    law: Callable[..., Any] | None = None,
    model: mjx.Model | None = None,
  ) -> None:
    self.mj_model, self.substeps, self.outputs, self.law = mj_model, substeps, tuple(outputs), law
    # MJX decides at compile time which constraints exist
    self.inert = () if (mj_model.dof_frictionloss > 0).any() else ("dof_frictionloss",)
    self._forward = any(o not in ("qpos", "qvel") for o in outputs)
    self._model = _anywhere(mjx.put_model(mj_model, impl="jax") if model is None else model)
    self._data = _anywhere(mjx.make_data(mj_model, impl="jax"))

  def init(self, qpos: jax.Array, qvel: jax.Array) -> mjx.Data:
    """mjx.Data at qpos (nq,), qvel (nv,)."""
    return self._data.replace(
      qpos=jnp.asarray(qpos, jnp.float32), qvel=jnp.asarray(qvel, jnp.float32)
    )

  def model(self, fields: dict[str, jax.Array]) -> mjx.Model:
    """The mjx.Model with `fields` in place of its own, and the constants that follow from them.

    Raises:
      UserError for a field without effect here (`inert`).
    """
    if any(name in fields for name in self.inert):
      raise UserError(
        "dof_frictionloss: MJX builds no friction constraint for a model whose joints have "
        "none, so it would do nothing; choose physics native"
      )
    fields = dict(fields)
    model = self._model
    if "gravity" in fields:
      model = model.replace(opt=model.opt.replace(gravity=fields.pop("gravity")))
    model = model.replace(**fields)
    if any(name in fields for name in DERIVING):
      model = model.replace(**self.derived(model))
    return model

  def derived(self, model: mjx.Model) -> dict[str, jax.Array]:
    """What mj_setConst recomputes of masses and MJX uses, in pure JAX at qpos0: no interpolation,
    so faults of mass may be combined.

    body_subtreemass_b = sum of masses below b
    dof_invweight0     = diagonal of M^-1, averaged over the rotations and over the translations of
      a free or ball joint
    body_invweight0_b  = mean diagonal of J M^-1 J^T, J (3, nv) of b's centre of mass, for
    translation and rotation
    tendon_invweight0  = diagonal of J M^-1 J^T, J (tendons, nv)
    """
    m, host = model, self.mj_model
    data = mjx.com_pos(m, mjx.kinematics(m, self._data.replace(qpos=m.qpos0)))
    mass = mjx.full_m(m, mjx.crb(m, data))
    inverse = jnp.linalg.inv(mass)
    below = np.eye(host.nbody, dtype=np.float32)  # [b, c]: c is b or hangs on it
    for b in range(1, host.nbody):
      below[:, b] += below[:, host.body_parentid[b]]
    dof = jnp.diag(inverse)
    for j in range(host.njnt):
      at = host.jnt_dofadr[j]
      starts = {mujoco.mjtJoint.mjJNT_FREE: (at, at + 3), mujoco.mjtJoint.mjJNT_BALL: (at,)}
      for begin in starts.get(host.jnt_type[j], ()):
        dof = dof.at[begin : begin + 3].set(jnp.mean(dof[begin : begin + 3]))
    weights = []
    for b in range(host.nbody):
      if host.body_weldid[b] == 0:
        weights.append(jnp.zeros(2))
      else:
        jacobians = mjx.jac(m, data, data.xipos[b], b)  # (nv, 3) each
        weights.append(jnp.stack([jnp.trace(j.T @ inverse @ j) / 3 for j in jacobians]))
    out = {
      "body_subtreemass": jnp.asarray(below) @ m.body_mass,
      "dof_invweight0": dof,
      "body_invweight0": jnp.stack(weights),
    }
    if host.ntendon:
      moments = mjx.tendon(m, data)._impl.ten_J
      out["tendon_invweight0"] = jnp.diag(moments @ inverse @ moments.T)
    return out

  def step(
    self,
    fields: dict[str, jax.Array],
    state: mjx.Data,
    ctrl: jax.Array,
    task: dict[str, jax.Array] | None = None,
    force: jax.Array | None = None,
  ) -> tuple[mjx.Data, dict[str, jax.Array]]:
    """`substeps` physics steps of one robot, see `Native.step`."""
    model = self.model(fields)
    if force is not None:
      state = state.replace(qfrc_applied=jnp.asarray(force, state.qfrc_applied.dtype))
    extra, law = {}, self.law
    if law is None:
      state = state.replace(ctrl=jnp.asarray(ctrl, state.ctrl.dtype))
      state, _ = jax.lax.scan(
        lambda d, _: (mjx.step(model, d), None), state, None, length=self.substeps
      )
    else:

      def one(carry: tuple[mjx.Data, jax.Array, jax.Array], _: None) -> tuple[Any, None]:
        d = carry[0]
        actuators = jnp.asarray(law(jnp, task, ctrl, d.qpos, d.qvel), d.ctrl.dtype)
        return (mjx.step(model, d.replace(ctrl=actuators)), actuators, d.qvel), None

      (state, actuators, before), _ = jax.lax.scan(
        one, (state, state.ctrl, state.qvel), None, length=self.substeps
      )
      extra = {"ctrl": actuators, "qvel_before": before}
    if self._forward:
      state = mjx.forward(model, state)
    return state, {o: getattr(state, o) for o in self.outputs} | extra


def _anywhere(tree: Any) -> Any:
  """The same arrays, bound to no device. MJX binds its own, which binds all that a step returns: a
  program called with what it returned itself would be compiled a second time, for bound arguments,
  and robots could not be sharded.
  """
  return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), tree)
