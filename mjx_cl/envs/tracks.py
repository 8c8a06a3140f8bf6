"""Race tracks between two walls: shapes of our own, drawn ones, and those of a file.

A track is a closed centre line of P points, evenly spaced, and two walls of P points each; wall
point i lies beside centre point i, on its normal. The walls ARE these polylines: lidar and contact
are exact against them, and a MuJoCo model may build its boxes from them.
"""

import pathlib
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from mjx_cl.errors import FileError, UserError, choose

WIDTH = 2.2  # [m] of the generated tracks
SPACING = 0.4  # [m] between centre points
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


def cross(a: Any, b: Any) -> Any:
  """Z of the cross product of (..., 2) vectors."""
  return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _crossing(a: np.ndarray, b: np.ndarray | None = None) -> bool:
  """Whether two closed polylines (N, 2), (M, 2) cross, or one crosses itself."""
  other = a if b is None else b
  p, q = a, np.roll(a, -1, 0)
  c, d = other[None], np.roll(other, -1, 0)[None]
  for at in range(0, len(a), 256):  # 256 rows at a time bound the memory of long tracks
    u, v = p[at : at + 256, None], q[at : at + 256, None]
    hit = (cross(v - u, c - u) * cross(v - u, d - u) <= 0) & (
      cross(d - c, u - c) * cross(d - c, v - c) <= 0
    )
    if b is None:
      apart = (np.arange(len(a))[None] - np.arange(at, min(at + 256, len(a)))[:, None]) % len(a)
      hit &= (apart > 1) & (apart < len(a) - 1)  # neighbours share a point
    if hit.any():
      return True
  return False


def distance(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
  """Distance of points to the segments from `start` to `end`, all (..., 2) [m]: (...)."""
  step, away = end - start, points - start
  share = np.clip((away * step).sum(-1) / (step**2).sum(-1), 0, 1)
  return np.linalg.norm(away - share[..., None] * step, axis=-1)


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
    nearest = distance(wall[:, None], track.centre, np.roll(track.centre, -1, 0)).min(1)
    if (nearest < own - 0.05).any():  # the centre polyline cuts its curves by up to 0.02 m
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


def _point(line: str, where: str) -> list[float]:
  """The four numbers of a line of a file, which `where` names."""
  fields = line.split("#")[0].split(",")
  if len(fields) != 4:
    raise FileError(f"{where}: {len(fields)} columns, expected 4: x, y, width_right, width_left")
  try:
    row = [float(f) for f in fields]
  except ValueError:
    raise FileError(f"{where}: not a number in {line.strip()[:60]!r}") from None
  if not np.isfinite(row).all():
    raise FileError(f"{where}: not a finite number in {line.strip()[:60]!r}")
  if min(row[2:]) <= 0 or sum(row[2:]) < MIN_WIDTH:
    raise FileError(
      f"{where}: too narrow, {sum(row[2:]):g} m; at least {MIN_WIDTH} m, with the centre line "
      "inside"
    )
  return row


def load_csv(path: pathlib.Path | str) -> Track:
  """Track from a centre-line file: one point a line, `x, y, width_right, width_left` [m], `#`
  starts a comment; closed, last point unlike the first.

  Raises:
    FileError: with one line that names the file and what is wrong with it.
  """
  path = pathlib.Path(path)
  try:
    lines = path.read_text(encoding="utf-8").splitlines()
  except (OSError, UnicodeDecodeError) as error:
    raise FileError(
      f"cannot read track {path}: {getattr(error, 'strerror', None) or 'not a text file'}"
    ) from None
  table = np.array(
    [
      _point(line, f"track {path}, line {number}")
      for number, line in enumerate(lines, 1)
      if line.split("#")[0].strip()
    ]
  ).reshape(-1, 4)
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
  if wrong := check(track):
    raise FileError(f"track {path}: {wrong}")
  return track
