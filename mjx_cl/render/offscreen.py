"""Robots as MuJoCo draws them, off-screen, where the system has a GL library."""

from __future__ import annotations

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
  names = (
    (asked,)
    if asked in ("egl", "osmesa", "glfw", "cgl")
    else ("cgl",)
    if sys.platform == "darwin"
    else ("egl", "osmesa")
  )
  for name in names:
    env = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"} | {"MUJOCO_GL": name}
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
      if (
        subprocess.run(
          [sys.executable, "-c", PROBE, name], env=env, capture_output=True, timeout=60
        ).returncode
        == 0
      ):
        return name
  return None


class Offscreen:
  """MuJoCo's own renderer, a camera that follows the robot, bars on the floor at each metre.

  Args:
    env: environment with `mj_model`. width, height: pixels. library: as `gl_library` names it.
  """

  def __init__(self, env: Any, width: int, height: int, library: str) -> None:
    model = env.mj_model
    self.env, self.model, self.data = env, copy.copy(model), mujoco.MjData(model)
    self.model.vis.global_.offwidth, self.model.vis.global_.offheight = width, height
    self.model.vis.headlight.ambient[:], self.model.vis.headlight.diffuse[:] = (
      0.4,
      0.6,
    )  # a lamp of the model may be left behind
    self.width, self.height, self.reach = width, height, reach(model)
    self._gl = importlib.import_module("mujoco." + library).GLContext(width, height)
    self._gl.make_current()
    self._context = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
    self._scene, self._option, self._camera = (
      mujoco.MjvScene(self.model, maxgeom=1000),
      mujoco.MjvOption(),
      mujoco.MjvCamera(),
    )
    self._camera.azimuth, self._camera.elevation = (90, -8) if planar(model) else (130, -20)
    self._camera.distance = 3.2 * self.reach

  def close(self) -> None:
    """Frees the GL context."""
    self._context.free()
    self._gl.free()

  def _bars(self, root: np.ndarray, floor: float) -> None:
    half = 0.8 if planar(self.model) else 8.0
    for axis in range(1 if planar(self.model) else 2):
      for k in np.round(root[axis]) + np.arange(-8, 9):
        geom, middle, size = (
          self._scene.geoms[self._scene.ngeom],
          np.array([*np.round(root[:2]), floor]),
          np.array([half, half, 0.002]),
        )
        middle[axis], size[axis] = k, 0.012
        shade = 0.25 if k % 5 == 0 else 0.42
        mujoco.mjv_initGeom(
          geom,
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
    floor = floor_of(self.model, self.data)
    self._camera.lookat[:] = (
      *self.data.xpos[1][:2],
      floor + (0.6 if planar(self.model) else 0.3) * self.reach,
    )
    mujoco.mjv_updateScene(
      self.model,
      self.data,
      self._option,
      None,
      self._camera,
      mujoco.mjtCatBit.mjCAT_ALL.value,
      self._scene,
    )
    self._bars(self.data.xpos[1], floor)
    rect = mujoco.MjrRect(0, 0, self.width, self.height)
    mujoco.mjr_render(rect, self._scene, self._context)
    image, depth = (
      np.empty((self.height, self.width, 3), np.uint8),
      np.empty((self.height, self.width), np.float32),
    )
    mujoco.mjr_readPixels(image, depth, rect, self._context)
    image, empty = (
      np.flipud(image),
      np.flipud(depth)[..., None] >= 1.0,
    )  # nothing drawn: as far as the depth buffer reaches
    return np.where(empty, sky(self.height)[:, None], image)
