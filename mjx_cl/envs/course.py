"""Race tracks between two walls, and what a car senses of them: lidar, place along the track,
contact.

A track is a closed centre line of P points, evenly spaced, and two walls of P points each; wall
point i lies beside centre point i, on its normal. The walls ARE these polylines: lidar and contact
are exact against them, and a MuJoCo model may build its boxes from them.
"""

from __future__ import annotations

import functools
import pathlib
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

from mjx_cl.errors import FileError, UserError, choose

if TYPE_CHECKING:
  from collections.abc import Iterable

WIDTH = 2.2  # [m] of the generated tracks
SPACING = 0.4  # [m] between centre points
CAR = (0.58, 0.31)  # [m] length, width
MIN_WIDTH = 0.8  # [m] of a track from a file
MIN_POINTS = 8  # of a track from a file
GAP = 4.0  # a closing gap above this many median spacings leaves the line open

# Waypoints of our own closed lines [m], in driving order: half of the tracks turn left, half turn
# right.
SHAPES = {
  "oval": (
    (0, 0), (4.5, -0.2), (9.1, -0.2), (11.3, 2.8), (8.9, 5.6), (4.5, 5.7), (0, 5.7), (-2.2, 3.1),
  ),
  "kidney": (
    (0, 0), (-3.3, 3.1), (-2.2, 7.5), (1.7, 8.6), (5.6, 6.7), (9.4, 8.6), (13.5, 7.5), (14.5, 2.7),
    (11.2, 0), (5.6, -0.7),
  ),
  "chicane": (
    (0, 0), (4.5, 0), (7.8, 1.8), (11.4, 0.3), (15.4, 0), (18.1, 2.9), (16.1, 6), (12.3, 6.1),
    (8.9, 8), (4.9, 6.9), (-0.1, 6.1), (-2.5, 3.1),
  ),
  "hairpin": (
    (0, 0), (-1.4, 2.2), (0.5, 4.8), (4.5, 4.5), (6.3, 6.7), (4.1, 9.4), (0.3, 9), (-1.4, 11.2),
    (0.1, 13.7), (7.4, 13.2), (11.4, 10.9), (11.8, 5.7), (9.5, 0.5), (5.3, 0),
  ),
  "bean": (
    (0, 0), (3.7, -1.4), (7.4, -0.4), (8.9, 2.9), (7, 5.8), (6.4, 9.1), (3.5, 10.9), (-0.2, 9.7),
    (-1, 6.1), (-2.3, 2.8),
  ),
  "hook": (
    (0, 0), (-3.1, 2.3), (-2.1, 5.8), (1.5, 7.7), (3, 11.4), (5.8, 12.7), (9, 10.8), (9.7, 8.1),
    (13.1, 6.4), (16.8, 5.7), (17.4, 1.9), (15, -0.3), (6.6, -0.3),
  ),
}  # fmt: skip


class Track(NamedTuple):
  """One closed track, NumPy float64; row P - 1 is followed by row 0.

  Attributes:
    name: shape, seed or file.
    centre: (P, 2) [m], evenly spaced along the line.
    heading: (P,) direction of driving [rad], unwrapped.
    curvature: (P,) signed [1/m], positive where the track turns left.
    left: (P, 2) [m], wall points on the normal of each centre point.
    right: (P, 2) [m], the same on the other side.
    length: of the centre line [m].
  """

  name: str
  centre: np.ndarray
  heading: np.ndarray
  curvature: np.ndarray
  left: np.ndarray
  right: np.ndarray
  length: float


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


# ---- tracks, in NumPy ----------------------------------------------------------------------------


def build(
  name: str, points: np.ndarray, right: np.ndarray | float, left: np.ndarray | float
) -> Track:
  """Track along the closed cubic spline through points (K, 2) [m], with half widths right, left
  (K,) or () [m], linear in between; the parameter is the length of the chords.
  """
  points = np.asarray(points, float)
  around = np.concatenate([points, points[:1]])
  knots = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(around, axis=0), axis=1)))
  evaluate = CubicSpline(knots, around, bc_type="periodic")
  fine = np.linspace(0, knots[-1], 20 * len(points) + 2000)
  arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(evaluate(fine), axis=0), axis=1))])
  num = max(8, int(np.ceil(arc[-1] / SPACING)))
  u = np.interp(np.arange(num) * arc[-1] / num, arc, fine)
  centre, d1, d2 = (evaluate(u, k) for k in range(3))
  heading = np.unwrap(np.arctan2(d1[:, 1], d1[:, 0]))
  curvature = (d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]) / np.linalg.norm(d1, axis=1) ** 3
  normal = np.stack([-np.sin(heading), np.cos(heading)], 1)
  left, right = (
    np.interp(u, knots, np.append(w, w[0]))[:, None]
    for w in (np.broadcast_to(x, len(points)).astype(float) for x in (left, right))
  )
  return Track(
    name,
    centre,
    heading,
    curvature,
    centre + left * normal,
    centre - right * normal,
    float(arc[-1]),
  )


def _cross(a: Any, b: Any) -> Any:
  """Z of the cross product of (..., 2) vectors."""
  return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _crossing(a: np.ndarray, b: np.ndarray | None = None) -> bool:
  """Whether two closed polylines (N, 2), (M, 2) cross, or one crosses itself."""
  other = a if b is None else b
  p, q = a, np.roll(a, -1, 0)
  c, d = other[None], np.roll(other, -1, 0)[None]
  for at in range(0, len(a), 256):  # 256 rows at a time bound the memory of long tracks
    u, v = p[at : at + 256, None], q[at : at + 256, None]
    hit = (_cross(v - u, c - u) * _cross(v - u, d - u) <= 0) & (
      _cross(d - c, u - c) * _cross(d - c, v - c) <= 0
    )
    if b is None:
      apart = (np.arange(len(a))[None] - np.arange(at, min(at + 256, len(a)))[:, None]) % len(a)
      hit &= (apart > 1) & (apart < len(a) - 1)  # neighbours share a point
    if hit.any():
      return True
  return False


def _distance(points: np.ndarray, line: np.ndarray) -> np.ndarray:
  """Distance of points (N, 2) to a closed polyline (M, 2) [m], (N,)."""
  step = np.roll(line, -1, 0) - line
  away = points[:, None] - line[None]
  share = np.clip((away * step).sum(-1) / (step**2).sum(-1), 0, 1)
  return np.linalg.norm(away - share[..., None] * step, axis=-1).min(1)


def check(track: Track) -> str | None:
  """What is wrong with a track, in words, or None.

  A wall point is no farther from its own centre point than from any other part of the centre line.
  By the triangle inequality the same then holds for every point between the two, so that no walls
  fold or overlap and the nearest centre point tells the section.
  """
  if _crossing(track.centre):
    return "the centre line crosses itself"
  ahead = np.roll(track.centre, -1, 0) - track.centre
  for wall in (track.left, track.right):
    if ((np.roll(wall, -1, 0) - wall) * ahead).sum(1).min() <= 0:
      return "a wall folds: a curve is tighter than half the track's width"
    own = np.linalg.norm(wall - track.centre, axis=1)
    if (
      _distance(wall, track.centre) < own - 0.05
    ).any():  # the centre polyline cuts its curves by up to 0.02 m
      return (
        "walls overlap: two sections of the track are too close, or a curve is tighter than half "
        "its width"
      )
  if _crossing(track.left) or _crossing(track.right) or _crossing(track.left, track.right):
    return "walls cross each other"
  return None


def generate(shape: str | int) -> Track:
  """One of SHAPES by name, or a track drawn from a seed; 2.2 m wide, radius of the centre line at
  least 1.6 m.

  Drawn: 9 to 12 waypoints at even angles around a point, radius 5 to 8 m *U(0.62, 1.38), turning
  left or right; the first valid line of 25 to 60 m.
  """
  if not isinstance(shape, int):
    return build(shape, np.array(choose("track", shape, SHAPES), float), WIDTH / 2, WIDTH / 2)
  rng = np.random.default_rng(shape)
  for _ in range(1000):
    num = rng.integers(9, 13)
    radius = rng.uniform(5, 8) * rng.uniform(0.62, 1.38, num)
    angle = rng.choice([-1, 1]) * np.arange(num) * 2 * np.pi / num
    track = build(
      str(shape),
      radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1),
      WIDTH / 2,
      WIDTH / 2,
    )
    if (
      25 <= track.length <= 60 and np.abs(track.curvature).max() <= 1 / 1.6 and check(track) is None
    ):
      return track
  raise UserError(f"no valid track drawn from seed {shape}")


def load_csv(path: pathlib.Path | str) -> Track:
  """Track from a centre-line file: one point a line, `x, y, width_right, width_left` [m], `#`
  starts a comment; closed, last point unlike the first.

  Raises:
    FileError: with one line that names the file and what is wrong with it.
  """
  path = pathlib.Path(path)
  try:
    text = path.read_text(encoding="utf-8")
  except (OSError, UnicodeDecodeError) as error:
    raise FileError(
      f"cannot read track {path}: {getattr(error, 'strerror', None) or 'not a text file'}"
    ) from None
  rows = []
  for number, line in enumerate(text.splitlines(), 1):
    fields = [f.strip() for f in line.split("#")[0].split(",")]
    if fields == [""]:
      continue
    if len(fields) != 4:
      raise FileError(
        f"track {path}, line {number}: {len(fields)} columns, expected 4: x, y, width_right, "
        "width_left"
      )
    try:
      rows.append([float(f) for f in fields])
    except ValueError:
      raise FileError(
        f"track {path}, line {number}: not a number in {line.strip()[:60]!r}"
      ) from None
    if not np.isfinite(rows[-1]).all():
      raise FileError(f"track {path}, line {number}: not a finite number in {line.strip()[:60]!r}")
    if min(rows[-1][2:]) <= 0 or sum(rows[-1][2:]) < MIN_WIDTH:
      raise FileError(
        f"track {path}, line {number}: too narrow, {sum(rows[-1][2:]):g} m; at least "
        f"{MIN_WIDTH} m, with the centre line inside"
      )
  table = np.array(rows).reshape(-1, 4)
  table = table[
    np.linalg.norm(table[:, :2] - np.roll(table[:, :2], -1, 0), axis=1) > 1e-6
  ]  # a repeated point, the first as the last included
  if len(table) < MIN_POINTS:
    raise FileError(
      f"track {path}: {len(table)} different points, at least {MIN_POINTS} are needed"
    )
  gap = np.linalg.norm(np.roll(table[:, :2], -1, 0) - table[:, :2], axis=1)
  if gap[-1] > GAP * np.median(gap):
    raise FileError(
      f"track {path}: not closed, {gap[-1]:.2f} m from the last point to the first, "
      f"{np.median(gap):.2f} m between others"
    )
  if _crossing(table[:, :2]):
    raise FileError(f"track {path}: the centre line crosses itself")
  track = build(path.stem, table[:, :2], table[:, 2], table[:, 3])
  wrong = check(track)
  if wrong:
    raise FileError(f"track {path}: {wrong}")
  return track


# ---- windows: which walls can be seen from where -------------------------------------------------


def _gap(a0: np.ndarray, a1: np.ndarray, b0: np.ndarray, b1: np.ndarray) -> np.ndarray:
  """Least distance of segments a, b, given as endpoints (N, 2) each [m], that do not
  cross: (N,).
  """

  def to(p: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    share = np.clip(((p - c) * (d - c)).sum(1) / ((d - c) ** 2).sum(1), 0, 1)
    return np.linalg.norm(p - c - share[:, None] * (d - c), axis=1)

  return np.minimum.reduce([to(a0, b0, b1), to(a1, b0, b1), to(b0, a0, a1), to(b1, a0, a1)])


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


# ---- what a car senses, in JAX -------------------------------------------------------------------


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
    self.angles = np.linspace(
      -fov_rad / 2, fov_rad / 2, beams
    )  # [rad], 0 ahead, positive to the left
    self.tracks, views = (
      _shipped(self.max_range)
      if tracks is None
      else (tuple(tracks), [reach(t, self.max_range) for t in tracks])
    )
    self.window = int(
      max(count.max() for _, count in views)
    )  # cells looked at, one number for all places
    longest = max(len(t.centre) for t in self.tracks)

    def stack(
      rows: Iterable[np.ndarray], wrap: int = 0
    ) -> jax.Array:  # each track repeats from its first point on, as far as indices reach
      return jnp.asarray(
        np.stack([np.take(r, np.arange(longest + wrap), 0, mode="wrap") for r in rows])
      )

    f32 = np.float32
    turn = [(np.roll(t.heading, -1) - t.heading + np.pi) % (2 * np.pi) - np.pi for t in self.tracks]
    self._count = jnp.asarray([len(t.centre) for t in self.tracks], jnp.int32)
    self._cell = jnp.asarray(
      [t.length / len(t.centre) for t in self.tracks], jnp.float32
    )  # arc length of a cell [m]
    self._start = stack([first.astype(np.int32) for first, _ in views])
    self._walls = stack(
      [np.stack([t.left, t.right], 1).astype(f32) for t in self.tracks], self.window + 1
    )  # (tracks, points, 2 sides, 2)
    self._centre = stack([t.centre.astype(f32) for t in self.tracks])
    self._ahead = stack([(np.roll(t.centre, -1, 0) - t.centre).astype(f32) for t in self.tracks])
    self._heading = stack(
      [((t.heading + np.pi) % (2 * np.pi) - np.pi).astype(f32) for t in self.tracks]
    )
    self._turn = stack([x.astype(f32) for x in turn])
    self._curvature = stack([t.curvature.astype(f32) for t in self.tracks], 1)
    half = [
      min(np.linalg.norm(w - t.centre, axis=1).min() for w in (t.left, t.right))
      for t in self.tracks
    ]
    self._side = jnp.asarray(
      [np.clip(h - 0.3, 0.0, 0.3) for h in half], jnp.float32
    )  # lateral offset at spawn [m]; 0.3 m holds half a turned car

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
    side = jnp.sign(_cross(self._ahead[track, cell], off))
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
