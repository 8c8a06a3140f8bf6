"""Robots as MuJoCo draws them, off-screen, where the system has a GL library."""

import contextlib
import copy
import importlib
import os
import subprocess
import sys
from typing import Any

import mujoco
import numpy as np

from mjx_cl.render.scene import Frame, floor_of, planar, qpos_of, reach, sky

PROBE = (
  "import importlib, sys; c = importlib.import_module('mujoco.' + sys.argv[1]).GLContext(16, "
  "16); c.make_current(); c.free()"
)


def gl_library() -> str | None:
  """Name of the MuJoCo GL binding that works here (egl, osmesa, cgl, glfw), or None.

  Tried in processes of their own: a binding that fails spoils the next one, and a broken driver may
  end the process. MUJOCO_GL names the only one to try; `off` is none.
  """
  asked = os.environ.get("MUJOCO_GL", "").lower().strip()
  if asked in ("off", "false", "0", "disable", "disabled"):
    return None
  own = ("cgl",) if sys.platform == "darwin" else ("egl", "osmesa")
  names = (asked,) if asked in ("egl", "osmesa", "glfw", "cgl") else own
  for name in names:
    env = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"} | {"MUJOCO_GL": name}
    command = [sys.executable, "-c", PROBE, name]
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
      if subprocess.run(command, env=env, capture_output=True, timeout=60).returncode == 0:
        return name
  return None


class Offscreen:
  """MuJoCo's own renderer, a camera that follows the robot, bars on the floor at each metre.

  mujoco.Renderer would choose its GL library when mujoco is imported, and gives colour and depth by
  two passes; here one pass gives both, and the depth tells where the sky is.

  Args:
    env: environment with `mj_model`.
    width: of a picture [pixels].
    height: of a picture [pixels].
    library: as `gl_library` names it.
  """

  def __init__(self, env: Any, width: int, height: int, library: str) -> None:
    self.env, self.model, self.data = env, copy.copy(env.mj_model), mujoco.MjData(env.mj_model)
    self.planar, self.reach = planar(self.model), reach(self.model)
    self.model.vis.global_.offwidth, self.model.vis.global_.offheight = width, height
    self.model.vis.headlight.ambient[:] = 0.4  # a lamp of the model may be left behind
    self.model.vis.headlight.diffuse[:] = 0.6
    self._gl = importlib.import_module("mujoco." + library).GLContext(width, height)
    self._gl.make_current()
    self._context = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
    self._rect = mujoco.MjrRect(0, 0, width, height)
    self._scene, self._camera = mujoco.MjvScene(self.model, maxgeom=1000), mujoco.MjvCamera()
    self._camera.azimuth, self._camera.elevation = (90, -8) if self.planar else (130, -20)
    self._camera.distance = 3.2 * self.reach

  def close(self) -> None:
    """Frees the GL context."""
    self._context.free()
    self._gl.free()

  def _bars(self, root: np.ndarray, floor: float) -> None:
    half = 0.8 if self.planar else 8.0
    for axis in range(1 if self.planar else 2):
      for k in np.round(root[axis]) + np.arange(-8, 9):
        middle, size = np.array([*np.round(root[:2]), floor]), np.array([half, half, 0.002])
        middle[axis], size[axis] = k, 0.012
        shade = 0.25 if k % 5 == 0 else 0.42
        mujoco.mjv_initGeom(
          self._scene.geoms[self._scene.ngeom],
          mujoco.mjtGeom.mjGEOM_BOX,
          size,
          middle,
          np.eye(3).ravel(),
          np.array([shade, shade, shade, 1], np.float32),
        )
        self._scene.ngeom += 1

  def picture(self, frame: Frame) -> np.ndarray:
    """uint8 (height, width, 3)."""
    self.data.qpos[:] = qpos_of(self.env, frame.state)
    mujoco.mj_forward(self.model, self.data)
    root, floor = self.data.xpos[1], floor_of(self.model, self.data)
    self._camera.lookat[:] = *root[:2], floor + (0.6 if self.planar else 0.3) * self.reach
    mujoco.mjv_updateScene(
      self.model,
      self.data,
      mujoco.MjvOption(),
      None,
      self._camera,
      mujoco.mjtCatBit.mjCAT_ALL.value,
      self._scene,
    )
    self._bars(root, floor)
    mujoco.mjr_render(self._rect, self._scene, self._context)
    shape = self._rect.height, self._rect.width
    image, depth = np.empty((*shape, 3), np.uint8), np.empty(shape, np.float32)
    mujoco.mjr_readPixels(image, depth, self._rect, self._context)
    # nothing drawn: as far as the depth buffer reaches
    empty = np.flipud(depth)[..., None] >= 1.0
    return np.where(empty, sky(shape[0])[:, None], np.flipud(image))
