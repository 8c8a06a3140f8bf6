"""An episode as a moving picture: GIF, or MP4 where ffmpeg is at hand.

MuJoCo draws off-screen where the system has a GL library. Where it has none, the bodies are drawn
with matplotlib from the positions that MuJoCo's kinematics gives: in side view a planar robot, in
an oblique view any other. A car is also drawn from above, on its track and with its lidar; so is a
robot that MuJoCo does not know, see `Plan`. Every picture is then framed: caption, and a red border
while a fault acts.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import importlib
import os
import pathlib
import shutil
import subprocess
import sys
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_cl.config import check_seeds
from mjx_cl.envs.adapters import Puppet, join, worst
from mjx_cl.errors import FileError, UserError
from mjx_cl.rollout.scan import nest
from mjx_cl.types import EnvState

SUFFIXES = (".gif", ".mp4")
MOST_STEPS = 100_000  # control steps of an episode
MARK = (214, 39, 40)  # of an acting fault
SKY = (
  np.array([0.80, 0.88, 0.95]),
  np.array([0.97, 0.98, 1.0]),
)  # at the top and at the bottom of the picture
GROUND = (0.72, 0.74, 0.74)
DIRECTIONS = np.stack(
  [f(np.linspace(0, 2 * np.pi, 48, endpoint=False)) for f in (np.cos, np.sin)], -1
)


class Frame(NamedTuple):
  """One decision: the robot as it decides, and what arriving from there brings.

  Attributes:
    state: EnvState in NumPy. obs: float32 (O,), as the robot senses it, its sensors' faults
      included.
    step: control step. episode: 0, 1, ... reward: of arriving. severity: true severity in force; 0
      is healthy.
  """

  state: EnvState
  obs: np.ndarray
  step: int
  episode: int
  reward: float
  severity: float


# ---- acting --------------------------------------------------------------------------------------


def qpos_of(env, state: EnvState) -> np.ndarray:
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


def act(
  env,
  steps: int,
  seed: int = 0,
  agent=None,
  params=None,
  repeat: int = 1,
  deterministic: bool = False,
  **fault,
) -> Iterator[Frame]:
  """Frames of `steps` control steps, one per decision, of the robot that seed `seed` has in `run`;
  faults as in `adapters.join`.
  """
  rollout, begin = join(
    env, agent or Puppet(len(env.spec.act)), repeat=repeat, deterministic=deterministic, **fault
  )  # refuses before it acts
  params = jax.tree.map(lambda x: x[None], jnp.zeros(()) if params is None else params)

  def live():
    streams = jax.jit(nest(begin, 0, 0))(jax.random.key(seed)[None, None])
    for step in range(0, steps, repeat):
      state = jax.tree.map(bare, streams.env)
      streams, row = rollout.chunk(params, streams, 1)
      yield Frame(
        state,
        np.asarray(row.obs[0, 0, 0]),
        step,
        int(row.episode[0, 0, 0]),
        float(row.reward[0, 0, 0]),
        float(worst(row.severity)),
      )

  return live()


def bare(x) -> np.ndarray:
  """The one robot of a leaf (1, 1, ...), in NumPy; a key as its bits."""
  return np.asarray(
    (jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)[0, 0]
  )


# ---- off-screen MuJoCo ---------------------------------------------------------------------------

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


def reach(model: mujoco.MjModel) -> float:
  """Distance from the first body to the farthest point of any geom that moves, in the model's own
  pose [m].
  """
  data = mujoco.MjData(model)
  mujoco.mj_kinematics(model, data)
  moving = model.geom_bodyid > 0
  return float(
    np.max(
      np.linalg.norm(data.geom_xpos[moving] - data.xpos[1], axis=-1) + model.geom_rbound[moving]
    )
  )


def planar(model: mujoco.MjModel) -> bool:
  """Whether the robot moves in the x-z plane alone: no free joint."""
  return not (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any()


class Offscreen:
  """MuJoCo's own renderer, a camera that follows the robot, bars on the floor at each metre.

  Args:
    env: environment with `mj_model`. width, height: pixels. library: as `gl_library` names it.
  """

  def __init__(self, env, width: int, height: int, library: str):
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


def sky(height: int) -> np.ndarray:
  """Colours of the rows of an empty picture, uint8 (height, 3)."""
  return (255 * (SKY[0] + (SKY[1] - SKY[0]) * np.linspace(0, 1, height)[:, None])).astype(np.uint8)


def floor_of(model: mujoco.MjModel, data: mujoco.MjData) -> float:
  """Height of the highest plane [m], 0 where there is none."""
  planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
  return float(data.geom_xpos[planes, 2].max()) if planes.any() else 0.0


# ---- matplotlib ----------------------------------------------------------------------------------


def solid(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float] | None:
  """A geom as (points (n, 3), radius): the convex hull of balls of that radius about those points,
  in its own frame [m]; None: not drawn.
  """
  kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
  circle = np.concatenate([DIRECTIONS, np.zeros((len(DIRECTIONS), 1))], 1)
  if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
    return np.zeros((1, 3)), float(size[0])
  if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
    return np.array([[0, 0, -size[1]], [0, 0, size[1]]]), float(size[0])
  if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
    return np.concatenate([circle * size[0] + [0, 0, end * size[1]] for end in (-1, 1)]), 0.0
  if kind == mujoco.mjtGeom.mjGEOM_BOX:
    return np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size, 0.0
  if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
    rings = [circle * np.cos(a) + [0, 0, np.sin(a)] for a in np.linspace(-np.pi / 2, np.pi / 2, 17)]
    return np.concatenate(rings) * size, 0.0
  if kind == mujoco.mjtGeom.mjGEOM_MESH:
    mesh = model.geom_dataid[geom]
    at = model.mesh_vertadr[mesh]
    return np.array(model.mesh_vert[at : at + model.mesh_vertnum[mesh]], float), 0.0
  return None


def outline(points: np.ndarray, radius: float) -> np.ndarray:
  """Outline of a convex body in the picture plane, (48, 2), from its points (n, 2): the farthest
  one in each of 48 directions.
  """
  return points[np.argmax(points @ DIRECTIONS.T, 0)] + radius * DIRECTIONS


class Canvas:
  """A matplotlib figure of width x height pixels that is one pair of axes, equal scales, no frame."""

  def __init__(self, width: int, height: int):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    self.width, self.height = width, height
    self.figure = Figure(figsize=(width / 100, height / 100), dpi=100)
    self._agg = FigureCanvasAgg(self.figure)
    self.ax = self.figure.add_axes((0, 0, 1, 1))

  def aim(self, center, span: float) -> None:
    """`span` [m] is the height of the picture, `center` (2,) its middle."""
    wide = span * self.width / self.height
    self.ax.set_axis_off()
    self.ax.set_xlim(center[0] - wide / 2, center[0] + wide / 2)
    self.ax.set_ylim(center[1] - span / 2, center[1] + span / 2)

  def pixels(self) -> np.ndarray:
    """uint8 (height, width, 3)."""
    self._agg.draw()
    image = np.asarray(self._agg.buffer_rgba())[..., :3]
    return np.array(image[: self.height, : self.width])


class Sketch:
  """Outlines of the geoms in parallel projection, far ones first; the camera follows the robot."""

  def __init__(self, env, width: int, height: int):
    self.env, self.model = env, env.mj_model
    model, self.data, self.canvas = env.mj_model, mujoco.MjData(env.mj_model), Canvas(width, height)
    self.reach, self.planar = reach(model), planar(model)
    azimuth, elevation = (
      (np.pi / 2, 0.0) if self.planar else (np.radians(130), np.radians(-20))
    )  # of the line of sight, as MuJoCo counts
    sight = np.array(
      [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    self.axes = np.stack(
      [right, np.cross(right, sight), sight]
    )  # (3, 3): a point times its transpose is (right, up, away)
    self.solids = [
      (g, *s)
      for g in range(model.ngeom)
      if model.geom_rgba[g, 3] > 0 and (s := solid(model, g)) is not None
    ]

  def close(self) -> None:
    pass

  def _floor(self, center: np.ndarray, height: float) -> None:
    from matplotlib.collections import LineCollection

    ax = self.canvas.ax
    if self.planar:
      ax.axhspan(height - 100, height, color=GROUND, zorder=0)
      for x in range(int(center[0]) - 9, int(center[0]) + 10):
        ax.plot([x, x], [height - (0.1 if x % 5 else 0.2), height], color="0.3", lw=1, zorder=1)
        ax.text(
          x,
          height - 0.16 * self.reach,
          f"{x} m",
          ha="center",
          va="top",
          fontsize=7,
          color="0.3",
          clip_on=True,
        )
      return
    ax.axhspan(-1e4, 1e4, color=GROUND, zorder=0)
    near = np.arange(-12, 13)
    x, y = np.round(center[0]) + near, np.round(center[1]) + near
    lines = [[(a, y[0], height), (a, y[-1], height)] for a in x] + [
      [(x[0], b, height), (x[-1], b, height)] for b in y
    ]
    ax.add_collection(
      LineCollection(np.array(lines) @ self.axes[:2].T, colors="0.62", linewidths=0.8, zorder=1)
    )

  def picture(self, frame: Frame) -> np.ndarray:
    """uint8 (height, width, 3)."""
    from matplotlib.collections import PolyCollection

    self.data.qpos[:] = qpos_of(self.env, frame.state)
    mujoco.mj_kinematics(self.model, self.data)
    floor, root = floor_of(self.model, self.data), self.data.xpos[1]
    look = np.array([root[0], root[1], floor + (0.6 if self.planar else 0.3) * self.reach])
    self.canvas.figure.set_facecolor(SKY[1])
    self.canvas.ax.clear()
    self._floor(root, floor)
    shapes = []
    for geom, points, radius in self.solids:
      seen = (
        points @ self.data.geom_xmat[geom].reshape(3, 3).T + self.data.geom_xpos[geom]
      ) @ self.axes.T
      shapes.append(
        (seen[:, 2].mean(), outline(seen[:, :2], radius), self.model.geom_rgba[geom, :3])
      )
    shapes.sort(key=lambda shape: -shape[0])
    far, close = shapes[0][0], shapes[-1][0]
    tints = [
      np.clip(color * (1.0 - 0.35 * (depth - close) / max(far - close, 1e-9)), 0, 1)
      for depth, _, color in shapes
    ]
    self.canvas.ax.add_collection(
      PolyCollection(
        [s[1] for s in shapes], facecolors=tints, edgecolors="0.15", linewidths=0.8, zorder=3
      )
    )
    self.canvas.aim(self.axes[:2] @ look, 2.6 * self.reach)
    return self.canvas.pixels()


class Plan:
  """A view from above, drawn by `draw(ax, state, obs)`.

  ax is a cleared matplotlib Axes in metres with equal scales, state the EnvState in NumPy, obs what
  the robot senses. It draws, and returns (center (2,), span): the middle of the picture and its
  height [m]. An environment may offer a `draw` of its own; one with `course` and `pose`, a car, is
  drawn by `draw_car`.
  """

  def __init__(self, draw, width: int, height: int):
    self.draw, self.canvas = draw, Canvas(width, height)
    self.canvas.figure.set_facecolor("0.93")

  def close(self) -> None:
    pass

  def picture(self, frame: Frame) -> np.ndarray:
    """uint8 (height, width, 3)."""
    self.canvas.ax.clear()
    self.canvas.aim(*self.draw(self.canvas.ax, frame.state, frame.obs))
    return self.canvas.pixels()


def draw_car(env, ax, state: EnvState, obs: np.ndarray):
  """A car on its track, with the lidar as it reads it (its first observations, in units of the
  longest range), and a map in the corner.
  """
  from matplotlib.collections import LineCollection

  from mjx_cl.envs.course import CAR

  track, x, y, yaw, _ = (np.asarray(v) for v in env.pose(state))
  track, here = env.course.tracks[int(track)], np.array([x, y])
  cos, sin = np.cos(yaw), np.sin(yaw)
  ring = np.concatenate([track.left, track.left[:1], track.right[:1], track.right[::-1]])

  def lay(ax, lw):
    ax.fill(*ring.T, color="0.82", lw=0, zorder=0)
    for wall in (track.left, track.right):
      ax.plot(*np.concatenate([wall, wall[:1]]).T, color="0.2", lw=lw, zorder=3)

  lay(ax, 2)
  ax.plot(
    *np.concatenate([track.centre, track.centre[:1]]).T,
    color="0.65",
    lw=0.8,
    ls=(0, (6, 6)),
    zorder=1,
  )
  angles, ranges = yaw + env.course.angles, obs[: env.course.beams] * env.course.max_range
  ends = here + ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], -1)
  ax.add_collection(
    LineCollection(
      [(here, end) for end in ends], colors="#2a7ab9", linewidths=0.5, alpha=0.5, zorder=2
    )
  )
  ax.plot(*ends.T, "o", color="#2a7ab9", ms=2, zorder=4)
  length, width = CAR
  corners = np.array([[-1, -1], [0.7, -1], [1, -0.4], [1, 0.4], [0.7, 1], [-1, 1]]) * [
    length / 2,
    width / 2,
  ]  # the nose is where it narrows
  ax.fill(
    *(corners @ [[cos, sin], [-sin, cos]] + here).T, color="#c4472b", ec="0.1", lw=0.8, zorder=5
  )
  chart = ax.inset_axes((0.02, 0.02, 0.24, 0.24), zorder=6)
  chart.set(aspect="equal", xticks=[], yticks=[], facecolor="0.97")
  lay(chart, 0.8)
  chart.plot(*here, "o", color="#c4472b", ms=4)
  return here, 9.0


VIEWS = ("auto", "robot", "top")


def painter(env, width: int, height: int, view: str = "auto", say=lambda text: None):
  """(what draws this robot here, its name). `auto`: from above a car and what MuJoCo does not know,
  else as MuJoCo has it.
  """
  if view not in VIEWS:
    raise UserError(f"unknown view {view!r}; choose from: {', '.join(VIEWS)}")
  draw = getattr(env, "draw", None) or (
    functools.partial(draw_car, env) if hasattr(env, "course") else None
  )
  if view == "top" or (view == "auto" and (draw or not hasattr(env, "mj_model"))):
    if draw is None:
      raise UserError(
        f"environment {env.spec.name!r} has no view from above; choose from: auto, robot"
      )
    return Plan(draw, width, height), "matplotlib"
  if not hasattr(env, "mj_model"):
    raise UserError(
      f"environment {env.spec.name!r} has no MuJoCo model to look at; choose from: auto, top"
    )
  library = gl_library()
  if library:
    return Offscreen(env, width, height, library), f"MuJoCo ({library})"
  say(
    "no GL library for MuJoCo's renderer (Debian: apt install libegl1, or libosmesa6); drawing "
    "outlines with matplotlib"
  )
  return Sketch(env, width, height), "matplotlib"


# ---- caption and file ----------------------------------------------------------------------------


def framed(image: np.ndarray, caption: str, badge: str | None = None) -> np.ndarray:
  """A picture with its caption, and with a red border and a badge where a fault acts; uint8
  (height, width, 3).
  """
  from PIL import Image, ImageDraw, ImageFont

  picture = Image.fromarray(image)
  draw = ImageDraw.Draw(picture)
  size, edge = max(10, picture.height // 26), max(2, picture.height // 90)
  room = picture.width - 8 * edge
  fonts = [ImageFont.load_default(s) for s in range(size, 5, -1)]
  font = lambda text: next((f for f in fonts if draw.textlength(text, font=f) <= room), fonts[-1])
  draw.text((2 * edge, 2 * edge), caption, fill=(20, 20, 20), font=font(caption))
  if badge:
    small = font(badge)
    left, top, right, bottom = draw.textbbox((0, 0), badge, font=small)
    x, y = picture.width - right - 4 * edge, picture.height - bottom - 4 * edge
    draw.rectangle(
      (x + left - edge, y + top - edge, x + right + edge, y + bottom + edge), fill=MARK
    )
    draw.text((x, y), badge, fill=(255, 255, 255), font=small)
    draw.rectangle((0, 0, picture.width - 1, picture.height - 1), outline=MARK, width=edge)
  return np.asarray(picture)


def ffmpeg() -> str:
  """Path of ffmpeg: the system's, or that of the package imageio-ffmpeg."""
  found = shutil.which("ffmpeg")
  if found:
    return found
  try:
    import imageio_ffmpeg

    return imageio_ffmpeg.get_ffmpeg_exe()
  except (ImportError, RuntimeError):
    raise UserError("an .mp4 needs ffmpeg: pip install 'mjx-cl[video]', or name a .gif") from None


def write_gif(path, images, fps: float) -> None:
  """A GIF that repeats for ever; its clock counts in 10 ms."""
  from PIL import Image

  reduced = [Image.fromarray(x).quantize(128, dither=Image.Dither.NONE) for x in images]
  reduced[0].save(
    path,
    format="GIF",
    save_all=True,
    append_images=reduced[1:],
    duration=max(20, round(100 / fps) * 10),
    loop=0,
    disposal=1,
  )


def write_mp4(path, images, fps: float) -> None:
  """H.264 by ffmpeg; an odd width or height is padded to the next even one."""
  images = iter(images)
  first = next(images)
  command = [
    ffmpeg(),
    "-y",
    "-loglevel",
    "error",
    "-f",
    "rawvideo",
    "-pix_fmt",
    "rgb24",
    "-s",
    f"{first.shape[1]}x{first.shape[0]}",
    "-r",
    f"{fps:.6g}",
    "-i",
    "-",
    "-vf",
    "pad=ceil(iw/2)*2:ceil(ih/2)*2",
    "-c:v",
    "libx264",
    "-pix_fmt",
    "yuv420p",
    "-f",
    "mp4",
    str(path),
  ]
  with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
    with contextlib.suppress(BrokenPipeError):
      process.stdin.write(first.tobytes())
      for image in images:
        process.stdin.write(image.tobytes())
    _, words = process.communicate()
  if process.returncode:
    raise FileError(
      f"ffmpeg failed: {words.decode(errors='replace').strip() or process.returncode}"
    )


def check(out, steps: int, width: int, height: int, fps: float, seed: int = 0) -> pathlib.Path:
  """The output path, or the one thing that is wrong with the arguments."""
  out = pathlib.Path(out)
  if out.suffix.lower() not in SUFFIXES:
    raise UserError(f"--out must end in {' or '.join(SUFFIXES)}; got {str(out)!r}")
  if not 1 <= steps <= MOST_STEPS:
    raise UserError(
      f"steps must lie in 1..{MOST_STEPS:,}, whose pictures are kept in memory; got {steps}"
    )
  check_seeds(seed)
  for name, value in (("width", width), ("height", height)):
    if not 64 <= value <= 4096:
      raise UserError(f"{name} must lie in 64..4096; got {value}")
  if not 1 <= fps <= 50:
    raise UserError(f"fps must lie in 1..50; got {fps}")
  if out.suffix.lower() == ".mp4":
    ffmpeg()
  if out.is_dir():
    raise FileError(f"{out} is a folder")
  return out


def render(
  env,
  out,
  steps: int = 400,
  width: int = 480,
  height: int = 360,
  fps: float = 20.0,
  fault: str = "none",
  target: str | None = None,
  repeat: int = 1,
  view: str = "auto",
  say=lambda text: None,
  **acting,
) -> dict:
  """Acts and writes the picture, at the robot's own pace; every n-th decision is drawn so that
  `fps` is met.

  Args:
    out: path that ends in .gif or .mp4; written under another name, then renamed.
    width, height: pixels. view: one of VIEWS. acting: of `act`.
    say: takes lines for standard error.

  Returns:
    file, frames, steps, fps, drawn_by.
  """
  out = check(out, steps, width, height, fps)
  decision_s = env.spec.control_s * repeat
  every = max(1, round(1.0 / (fps * decision_s)))
  fps = 1.0 / (every * decision_s)
  frames = act(env, steps, repeat=repeat, fault=fault, target=target, **acting)
  label = " ".join(["FAULT", fault] + ([target] if target not in (None, "random") else []))
  count = 0
  tmp = out.with_name(f".{out.stem}.tmp{out.suffix.lower()}")
  try:
    tmp.touch()  # an unwritable place is found before anything is computed
  except OSError as e:
    raise FileError(f"cannot write {out}: {e.strerror or e}") from None
  scene = None
  try:
    scene, drawn_by = painter(env, width, height, view, say)

    def images():
      nonlocal count
      for i, frame in enumerate(frames):
        if i % every == 0:
          count += 1
          caption = (
            f"{env.spec.name}   step {frame.step}   {frame.step * env.spec.control_s:.1f} s   "
            f"reward {frame.reward:.2f}"
          )
          acts = fault != "none" and frame.severity > 0
          yield framed(
            scene.picture(frame), caption, f"{label} {frame.severity:.2f}" if acts else None
          )

    (write_gif if out.suffix.lower() == ".gif" else write_mp4)(tmp, images(), fps)
    os.replace(tmp, out)
  finally:
    tmp.unlink(missing_ok=True)
    if scene:
      scene.close()
  return {
    "file": str(out),
    "frames": count,
    "steps": steps,
    "fps": round(fps, 3),
    "drawn_by": drawn_by,
  }
