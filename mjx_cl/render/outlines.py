"""Robots as matplotlib draws them: outlines of their bodies, or a view from above."""

import copy
import itertools
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from mjx_cl.envs.course import CAR
from mjx_cl.render.scene import GROUND, SKY, Frame, floor_of, planar, qpos_of, reach
from mjx_cl.types import EnvState

_AROUND = np.linspace(0, 2 * np.pi, 48, endpoint=False)
DIRECTIONS = np.stack([np.cos(_AROUND), np.sin(_AROUND)], -1)
_CIRCLE, _ENDS = np.pad(DIRECTIONS, ((0, 0), (0, 1))), np.array([[0, 0, -1], [0, 0, 1]])
_RINGS = [_CIRCLE * np.cos(a) + [0, 0, np.sin(a)] for a in np.linspace(-np.pi / 2, np.pi / 2, 17)]
# points, the sizes that each of their axes is multiplied by, whether size 0 is their radius
SOLIDS = {
  mujoco.mjtGeom.mjGEOM_SPHERE: (np.zeros((1, 3)), [0, 0, 0], True),
  mujoco.mjtGeom.mjGEOM_CAPSULE: (_ENDS, [1, 1, 1], True),
  mujoco.mjtGeom.mjGEOM_CYLINDER: (np.concatenate([_CIRCLE + e for e in _ENDS]), [0, 0, 1], False),
  mujoco.mjtGeom.mjGEOM_BOX: (np.array([*itertools.product((-1, 1), repeat=3)]), [0, 1, 2], False),
  mujoco.mjtGeom.mjGEOM_ELLIPSOID: (np.concatenate(_RINGS), [0, 1, 2], False),
}


def solid(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, float] | None:
  """A geom as (points (n, 3), radius): the convex hull of balls of that radius about those points,
  in its own frame [m]; None: not drawn.
  """
  kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
  if kind == mujoco.mjtGeom.mjGEOM_MESH:
    mesh = model.geom_dataid[geom]
    at = model.mesh_vertadr[mesh]
    return np.array(model.mesh_vert[at : at + model.mesh_vertnum[mesh]], float), 0.0
  if kind not in SOLIDS:
    return None
  points, axes, rounded = SOLIDS[kind]
  return points * size[axes], float(size[0]) if rounded else 0.0


def outline(points: np.ndarray, radius: float) -> np.ndarray:
  """Outline of a convex body in the picture plane, (48, 2), from its points (n, 2): the farthest
  one in each of 48 directions.
  """
  return points[np.argmax(points @ DIRECTIONS.T, 0)] + radius * DIRECTIONS


class Canvas:
  """A matplotlib figure of width x height pixels that is one pair of axes, equal scales,
  no frame.
  """

  def __init__(self, width: int, height: int) -> None:
    self.width, self.height = width, height
    self.figure = Figure(figsize=(width / 100, height / 100), dpi=100)
    self._agg = FigureCanvasAgg(self.figure)
    self.ax = self.figure.add_axes((0, 0, 1, 1))

  def close(self) -> None:
    """Nothing to free."""

  def aim(self, center: np.ndarray, span: float) -> None:
    """`span` [m] is the height of the picture, `center` (2,) its middle."""
    wide = span * self.width / self.height
    self.ax.set_axis_off()
    self.ax.set_xlim(center[0] - wide / 2, center[0] + wide / 2)
    self.ax.set_ylim(center[1] - span / 2, center[1] + span / 2)

  def pixels(self) -> np.ndarray:
    """uint8 (height, width, 3)."""
    self._agg.draw()
    return np.array(self._agg.buffer_rgba())[: self.height, : self.width, :3]


class Sketch(Canvas):
  """Outlines of the geoms in parallel projection, far ones first; the camera follows the robot."""

  def __init__(self, env: Any, width: int, height: int) -> None:
    super().__init__(width, height)
    self.figure.set_facecolor(tuple(SKY[1]))
    self.env, self.model, self.data = env, copy.copy(env.mj_model), mujoco.MjData(env.mj_model)
    self.reach, self.planar = reach(self.model), planar(self.model)
    # of the line of sight, as MuJoCo counts
    azimuth, elevation = np.radians((90, 0) if self.planar else (130, -20))
    along = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    sight = along * np.cos(elevation) + [0.0, 0.0, np.sin(elevation)]
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    # (3, 3): a point times its transpose is (right, up, away)
    self.axes = np.stack([right, np.cross(right, sight), sight])
    self.solids = [
      (g, *s)
      for g in range(self.model.ngeom)
      if self.model.geom_rgba[g, 3] > 0 and (s := solid(self.model, g)) is not None
    ]

  def _floor(self, center: np.ndarray, height: float) -> None:
    ax = self.ax
    if self.planar:
      ax.axhspan(height - 100, height, color=GROUND, zorder=0)
      low = height - 0.16 * self.reach
      for x in range(int(center[0]) - 9, int(center[0]) + 10):
        ax.plot([x, x], [height - (0.1 if x % 5 else 0.2), height], color="0.3", lw=1, zorder=1)
        ax.text(x, low, f"{x} m", ha="center", va="top", fontsize=7, color="0.3", clip_on=True)
      return
    ax.axhspan(-1e4, 1e4, color=GROUND, zorder=0)
    near = np.arange(-12, 13)
    x, y = np.round(center[0]) + near, np.round(center[1]) + near
    across = [[(a, y[0], height), (a, y[-1], height)] for a in x]
    lines = np.array(across + [[(x[0], b, height), (x[-1], b, height)] for b in y])
    ax.add_collection(
      LineCollection(lines @ self.axes[:2].T, colors="0.62", linewidths=0.8, zorder=1)
    )

  def picture(self, frame: Frame) -> np.ndarray:
    """uint8 (height, width, 3)."""
    self.data.qpos[:] = qpos_of(self.env, frame.state)
    mujoco.mj_kinematics(self.model, self.data)
    floor, root = floor_of(self.model, self.data), self.data.xpos[1]
    look = np.array([root[0], root[1], floor + (0.6 if self.planar else 0.3) * self.reach])
    self.ax.clear()
    self._floor(root, floor)
    shapes = []
    for geom, points, radius in self.solids:
      turned = points @ self.data.geom_xmat[geom].reshape(3, 3).T
      seen = (turned + self.data.geom_xpos[geom]) @ self.axes.T
      color = self.model.geom_rgba[geom, :3]
      shapes.append((seen[:, 2].mean(), outline(seen[:, :2], radius), color))
    shapes.sort(key=lambda shape: -shape[0])
    far, close = shapes[0][0], shapes[-1][0]
    tints = [
      np.clip(color * (1.0 - 0.35 * (depth - close) / max(far - close, 1e-9)), 0, 1)
      for depth, _, color in shapes
    ]
    bodies = PolyCollection([s[1] for s in shapes], facecolors=tints, edgecolors="0.15", zorder=3)
    bodies.set_linewidth(0.8)
    self.ax.add_collection(bodies)
    self.aim(self.axes[:2] @ look, 2.6 * self.reach)
    return self.pixels()


class Plan(Canvas):
  """A view from above, drawn by `draw(ax, state, obs)`.

  ax is a cleared matplotlib Axes in metres with equal scales, state the EnvState in NumPy, obs what
  the robot senses. It draws, and returns (center (2,), span): the middle of the picture and its
  height [m]. An environment may offer a `draw` of its own; one with `course` and `pose`, a car, is
  drawn by `draw_car`.
  """

  def __init__(self, draw: Callable[..., Any], width: int, height: int) -> None:
    super().__init__(width, height)
    self.figure.set_facecolor("0.93")
    self.draw = draw

  def picture(self, frame: Frame) -> np.ndarray:
    """uint8 (height, width, 3)."""
    self.ax.clear()
    self.aim(*self.draw(self.ax, frame.state, frame.obs))
    return self.pixels()


def draw_car(env: Any, ax: Axes, state: EnvState, obs: np.ndarray) -> tuple[np.ndarray, float]:
  """A car on its track, with the lidar as it reads it (its first observations, in units of the
  longest range), and a map in the corner.
  """
  track, x, y, yaw, _ = (np.asarray(v) for v in env.pose(state))
  track, here = env.course.tracks[int(track)], np.array([x, y])
  cos, sin = np.cos(yaw), np.sin(yaw)
  ring = np.concatenate([track.left, track.left[:1], track.right[:1], track.right[::-1]])

  def lay(ax: Axes, lw: float) -> None:
    ax.fill(*ring.T, color="0.82", lw=0, zorder=0)
    for wall in (track.left, track.right):
      ax.plot(*np.concatenate([wall, wall[:1]]).T, color="0.2", lw=lw, zorder=3)

  lay(ax, 2)
  centre = np.concatenate([track.centre, track.centre[:1]])
  ax.plot(*centre.T, color="0.65", lw=0.8, ls=(0, (6, 6)), zorder=1)
  angles, ranges = yaw + env.course.angles, obs[: env.course.beams] * env.course.max_range
  ends = here + ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], -1)
  rays = [(here, end) for end in ends]
  ax.add_collection(LineCollection(rays, colors="#2a7ab9", linewidths=0.5, alpha=0.5, zorder=2))
  ax.plot(*ends.T, "o", color="#2a7ab9", ms=2, zorder=4)
  # the nose is where it narrows
  nose = np.array([[-1, -1], [0.7, -1], [1, -0.4], [1, 0.4], [0.7, 1], [-1, 1]])
  body = nose * np.array(CAR) / 2 @ [[cos, sin], [-sin, cos]] + here
  ax.fill(*body.T, color="#c4472b", ec="0.1", lw=0.8, zorder=5)
  chart = ax.inset_axes((0.02, 0.02, 0.24, 0.24), zorder=6)
  chart.set(aspect="equal", xticks=[], yticks=[], facecolor="0.97")
  lay(chart, 0.8)
  chart.plot(*here, "o", color="#c4472b", ms=4)
  return here, 9.0
