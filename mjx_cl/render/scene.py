"""What every way of drawing a robot needs: one decision of it, where it stands, sky and floor."""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from mjx_cl.types import EnvState

SKY = np.array([[0.80, 0.88, 0.95], [0.97, 0.98, 1.0]])  # at the picture's top and bottom
GROUND = (0.72, 0.74, 0.74)


class Frame(NamedTuple):
  """One decision: the robot as it decides, and what arriving from there brings.

  Attributes:
    state: EnvState in NumPy.
    obs: float32 (O,), as the robot senses it, its sensors' faults included.
    step: control step.
    episode: 0, 1, ...
    reward: of arriving.
    severity: true severity in force; 0 is healthy.
  """

  state: EnvState
  obs: np.ndarray
  step: int
  episode: int
  reward: float
  severity: float


def qpos_of(env: Any, state: EnvState) -> np.ndarray:
  """Position of one robot, float64 (nq,): of a backend's row or mjx.Data, or of a task's own state
  that keeps either, the latter first.
  """
  inner = state.physics
  while not hasattr(inner, "qpos") and isinstance(inner, tuple):
    inner = inner[0]
  if hasattr(inner, "qpos"):
    return np.asarray(inner.qpos, np.float64)
  at = env.physics._qpos_at
  return np.array(np.asarray(inner).view(np.float64)[at : at + env.mj_model.nq])


def reach(model: mujoco.MjModel) -> float:
  """Distance from the first body to the farthest point of any geom that moves, in the model's own
  pose [m].
  """
  data = mujoco.MjData(model)
  mujoco.mj_kinematics(model, data)
  moving = model.geom_bodyid > 0
  away = np.linalg.norm(data.geom_xpos[moving] - data.xpos[1], axis=-1)
  return float(np.max(away + model.geom_rbound[moving]))


def planar(model: mujoco.MjModel) -> bool:
  """Whether the robot moves in the x-z plane alone: no free joint."""
  return not (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any()


def sky(height: int) -> np.ndarray:
  """Colours of the rows of an empty picture, uint8 (height, 3)."""
  top, bottom = SKY
  return (255 * (top + (bottom - top) * np.linspace(0, 1, height)[:, None])).astype(np.uint8)


def floor_of(model: mujoco.MjModel, data: mujoco.MjData) -> float:
  """Height of the highest plane [m], 0 where there is none."""
  planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
  return float(data.geom_xpos[planes, 2].max()) if planes.any() else 0.0
