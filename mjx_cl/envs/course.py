"""What a car senses of race tracks (`tracks`): lidar, place along the track, contact."""

import functools
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.envs.tracks import SHAPES, Track, cross, distance, generate
from mjx_cl.envs.tracks import load_csv as load_csv  # for whoever brings a track of his own

CAR = (0.58, 0.31)  # [m] length, width


class Place(NamedTuple):
  """Where a point is along a track, each float32 ().

  Attributes:
    s: arc length of the nearest point of the centre line [m].
    lateral: signed distance from the centre line [m], positive on the left.
    heading: direction of the track there [rad].
    curvature: of the track there [1/m], positive where it turns left.
  """

  s: jax.Array
  lateral: jax.Array
  heading: jax.Array
  curvature: jax.Array


# ---- windows: which walls can be seen from where -------------------------------------------------


def _gap(a0: np.ndarray, a1: np.ndarray, b0: np.ndarray, b1: np.ndarray) -> np.ndarray:
  """Least distance of segments a, b, given as endpoints (N, 2) each [m], that do not
  cross: (N,).
  """
  return np.minimum.reduce(
    [distance(a0, b0, b1), distance(a1, b0, b1), distance(b0, a0, a1), distance(b1, a0, a1)]
  )


def reach(track: Track, max_range: float) -> tuple[np.ndarray, np.ndarray]:
  """Cells that a ray from cell i can end in, as first cell and number of cells, int (P,) each. Cell
  i lies between cross sections i and i + 1.

  A straight ray inside the corridor crosses the sections one after another, so its line has all
  their left ends on one side and all right ends on the other. A cell counts where both hold for the
  sections up to it:
    max_a [ min over left ends n(a) . l - max over right ends n(a) . r ] >= 0, n(a) = normal of the
    direction a, within 90 degrees of the track's distance from the first section to the last <=
    max_range
  The bracket changes by at most |l - r| per rad, so that 721 directions and that much slack leave
  no line out. One cell more on either side, since the nearest centre point may name the neighbour
  of the cell that a point is in.
  """
  num = len(track.centre)
  grid = np.linspace(-np.pi / 2, np.pi / 2, 721)
  widest = np.linalg.norm(track.left - track.right, axis=1).max()
  slack = (
    (2 * max_range + 3 * widest) * (grid[1] - grid[0]) / 2
  )  # [m]; all ends are within max_range + widest of the first section

  def ahead(sign: int) -> np.ndarray:
    first = (np.arange(num) + (2 if sign > 0 else -1)) % num
    angle = track.heading[first, None] + grid
    normal = np.stack([-np.sin(angle), np.cos(angle)])  # (2, P, directions)

    def along(ends: np.ndarray) -> np.ndarray:
      return normal[0] * ends[:, :1] + normal[1] * ends[:, 1:]

    low, high = along(track.left[first]), along(track.right[first])
    count, alive = np.full(num, 2), np.ones(num, bool)
    for k in range(1, num):
      at = (first + sign * k) % num
      low, high = np.minimum(low, along(track.left[at])), np.maximum(high, along(track.right[at]))
      alive &= ((low - high).max(1) >= -slack) & (
        _gap(track.left[first], track.right[first], track.left[at], track.right[at]) <= max_range
      )
      if not alive.any():
        break
      count = count + alive
    return count

  back, forward = ahead(-1), ahead(1)
  return (np.arange(num) - back) % num, np.minimum(back + 1 + forward, num)


@functools.lru_cache
def _shipped(max_range: float) -> tuple[tuple[Track, ...], tuple]:
  """All of SHAPES and `reach` of each, which takes half a second."""
  tracks = tuple(generate(name) for name in SHAPES)
  return tracks, tuple(reach(t, max_range) for t in tracks)


# ---- the course, in JAX --------------------------------------------------------------------------


class Course:
  """Several tracks in one program. Every function is for one car, pure and traceable; `track` is an
  int32 () index into `tracks`.

  Args:
    tracks: sequence of Track; by default all of SHAPES.
    beams: lidar beams, evenly spread over the field of view, from right to left.
    fov_rad: field of view [rad], 270 degrees.
    max_range_m: reading of a beam that meets nothing nearer [m].
  """

  def __init__(
    self,
    tracks: Iterable[Track] | None = None,
    beams: int = 64,
    fov_rad: float = 4.712389,
    max_range_m: float = 10.0,
  ) -> None:
    self.beams, self.max_range = beams, float(max_range_m)
    # [rad], 0 ahead, positive to the left
    self.angles = np.linspace(-fov_rad / 2, fov_rad / 2, beams)
    if tracks is None:
      self.tracks, views = _shipped(self.max_range)
    else:
      self.tracks = tuple(tracks)
      views = tuple(reach(t, self.max_range) for t in self.tracks)
    # cells looked at, one number for all places
    self.window = int(max(count.max() for _, count in views))
    longest = max(len(t.centre) for t in self.tracks)

    def stack(rows: Iterable[np.ndarray], wrap: int = 0, dtype: Any = np.float32) -> jax.Array:
      """Each track repeats from its first point on, as far as indices reach."""
      at = np.arange(longest + wrap)
      return jnp.asarray(np.stack([np.take(r, at, 0, mode="wrap") for r in rows]), dtype)

    def within(angle: np.ndarray) -> np.ndarray:
      return (angle + np.pi) % (2 * np.pi) - np.pi

    self._count = jnp.asarray([len(t.centre) for t in self.tracks], jnp.int32)
    # arc length of a cell [m]
    self._cell = jnp.asarray([t.length / len(t.centre) for t in self.tracks], jnp.float32)
    self._start = stack([first for first, _ in views], dtype=np.int32)
    # (tracks, points, 2 sides, 2)
    self._walls = stack([np.stack([t.left, t.right], 1) for t in self.tracks], self.window + 1)
    self._centre = stack([t.centre for t in self.tracks])
    self._ahead = stack([np.roll(t.centre, -1, 0) - t.centre for t in self.tracks])
    self._heading = stack([within(t.heading) for t in self.tracks])
    self._turn = stack([within(np.roll(t.heading, -1) - t.heading) for t in self.tracks])
    self._curvature = stack([t.curvature for t in self.tracks], 1)
    half = [
      min(np.linalg.norm(w - t.centre, axis=1).min() for w in (t.left, t.right))
      for t in self.tracks
    ]
    # lateral offset at spawn [m]; 0.3 m holds half a turned car
    self._side = jnp.asarray([np.clip(h - 0.3, 0.0, 0.3) for h in half], jnp.float32)

  def _project(
    self, track: jax.Array, x: jax.Array, y: jax.Array
  ) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Nearest cell (int32 ()), share of it that lies behind (), and offset from its line
    [m] (2,).
    """
    step = self._ahead[track]
    away = jnp.stack([x, y]) - self._centre[track]
    share = jnp.clip(jnp.sum(away * step, -1) / jnp.sum(step * step, -1), 0.0, 1.0)
    off = away - share[:, None] * step
    distance = jnp.where(
      jnp.arange(off.shape[0]) < self._count[track], jnp.sum(off * off, -1), jnp.inf
    )
    cell = jnp.argmin(distance)
    return cell, share[cell], off[cell]

  def _nearby(
    self, track: jax.Array, x: jax.Array, y: jax.Array, yaw: jax.Array
  ) -> tuple[jax.Array, jax.Array]:
    """Wall points of the window around the car, in its frame [m]: forward and left, (window + 1, 2
    sides) each.
    """
    cell, _, _ = self._project(track, x, y)
    points = self._walls[track, self._start[track, cell] + jnp.arange(self.window + 1)] - jnp.stack(
      [x, y]
    )
    sin, cos = jnp.sin(yaw), jnp.cos(yaw)
    return cos * points[..., 0] + sin * points[..., 1], cos * points[..., 1] - sin * points[..., 0]

  def at(self, track: jax.Array, s: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """X [m], y [m], heading [rad] and curvature [1/m] of the centre line at arc length s [m], any
    real number.
    """
    place = s / self._cell[track]
    whole = jnp.floor(place)
    share, cell = place - whole, whole.astype(jnp.int32) % self._count[track]
    point = self._centre[track, cell] + share * self._ahead[track, cell]
    bend = self._curvature[track, cell] * (1 - share) + self._curvature[track, cell + 1] * share
    return point[0], point[1], self._heading[track, cell] + share * self._turn[track, cell], bend

  def locate(self, track: jax.Array, x: jax.Array, y: jax.Array) -> Place:
    """Place of the point x, y [m] along its track, by the nearest point of the centre polyline."""
    cell, share, off = self._project(track, x, y)
    s = (cell + share) * self._cell[track]
    _, _, heading, curvature = self.at(track, s)
    side = jnp.sign(cross(self._ahead[track, cell], off))
    return Place(s, side * jnp.sqrt(jnp.sum(off * off)), heading, curvature)

  def scan(self, track: jax.Array, x: jax.Array, y: jax.Array, yaw: jax.Array) -> jax.Array:
    """Range of each beam from the car's origin, float32 (beams,) [m], at most `max_range`; exact
    for a point between the walls.

    A wall piece from a to b (car frame) meets the line along the unit vector d where cross(a, d)
    and cross(b, d) differ in sign, at the range
    t = cross(a, b - a) / (cross(a, d) - cross(b, d)); the nearest t > 0 is the reading. Neighbours
    share the value of their common point, so that no beam slips between them.
    """
    px, py = self._nearby(track, x, y, yaw)
    side = px[..., None] * jnp.asarray(np.sin(self.angles), jnp.float32) - py[
      ..., None
    ] * jnp.asarray(np.cos(self.angles), jnp.float32)
    area = px[:-1] * (py[1:] - py[:-1]) - py[:-1] * (px[1:] - px[:-1])
    t = area[..., None] / (side[:-1] - side[1:])
    hit = ((side[:-1] >= 0) != (side[1:] >= 0)) & (t >= 0)
    return jnp.min(jnp.where(hit, t, self.max_range), (0, 1), initial=self.max_range)

  def collides(self, track: jax.Array, x: jax.Array, y: jax.Array, yaw: jax.Array) -> jax.Array:
    """Whether the car's rectangle, 0.58 x 0.31 m around its origin, touches a wall: bool ().

    A wall piece a + u (b - a), u in [0, 1], is cut to the two slabs |forward| <= 0.29 m and |left|
    <= 0.155 m; it touches where something is left. Exact while the origin is between the walls. The
    check is done once per control step, in which the car moves less than its own width.
    """
    ends = []
    for p, half in zip(self._nearby(track, x, y, yaw), (CAR[0] / 2, CAR[1] / 2)):
      a, step = p[:-1], p[1:] - p[:-1]
      step = jnp.where(
        jnp.abs(step) < 1e-9, 1e-9, step
      )  # a piece along the slab: u then runs to +-inf, or the slab is missed
      u, v = (-half - a) / step, (half - a) / step
      ends.append((jnp.minimum(u, v), jnp.maximum(u, v)))
    enter = jnp.maximum(jnp.maximum(ends[0][0], ends[1][0]), 0.0)
    leave = jnp.minimum(jnp.minimum(ends[0][1], ends[1][1]), 1.0)
    return jnp.any(enter <= leave)

  def spawn(self, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """A place to start: track int32 (), x, y [m], yaw [rad]; uniform in track and arc length,
    lateral +-U(0, 0.3) m, heading +-U(0, 0.2) rad.

    On narrow tracks the lateral offset ends 0.3 m from the nearer wall.
    """
    key_track, key_s, key_side, key_yaw = jax.random.split(key, 4)
    track = jax.random.randint(key_track, (), 0, len(self.tracks))
    x, y, heading, _ = self.at(
      track, jax.random.uniform(key_s, ()) * self._cell[track] * self._count[track]
    )
    side = self._side[track] * jax.random.uniform(key_side, (), minval=-1.0, maxval=1.0)
    return (
      track,
      x - side * jnp.sin(heading),
      y + side * jnp.cos(heading),
      heading + 0.2 * jax.random.uniform(key_yaw, (), minval=-1.0, maxval=1.0),
    )
