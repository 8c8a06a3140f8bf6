"""Tracks, lidar, contact and place along the track, against NumPy in float64 that looks at every
wall.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl.envs import course as lib
from mjx_cl.envs import tracks
from mjx_cl.errors import FileError, UserError

SEEDS = (0, 1)  # drawn tracks


@pytest.fixture(scope="module")
def course():
  """All shapes and two drawn tracks in one program."""
  return lib.Course(
    [tracks.generate(name) for name in tracks.SHAPES] + [tracks.generate(seed) for seed in SEEDS]
  )


def poses(course, num, seed=0, margin=0.05):
  """Random poses between the walls: track (N,), x, y, yaw float32, and the lateral offset; `num`
  per track.
  """
  rng = np.random.default_rng(seed)
  rows = []
  for k, t in enumerate(course.tracks):
    i, u, v = (
      rng.integers(len(t.centre), size=num),
      rng.random(num)[:, None],
      rng.uniform(margin, 2.2 - margin, num)[:, None] / 2.2,
    )
    j = (i + 1) % len(t.centre)
    left, right = (
      t.left[i] * (1 - u) + t.left[j] * u,
      t.right[i] * (1 - u) + t.right[j] * u,
    )  # points of both wall pieces of a cell
    rows.append(
      np.concatenate(
        [np.full((num, 1), k), right * (1 - v) + left * v, rng.uniform(-4, 4, (num, 1))], 1
      )
    )
  track, x, y, yaw = np.concatenate(rows).T
  return track.astype(np.int32), x.astype(np.float32), y.astype(np.float32), yaw.astype(np.float32)


def pieces(track):
  """Ends of all wall pieces of a track, (2 P, 2) twice."""
  return (
    np.concatenate([track.left, track.right]),
    np.concatenate([np.roll(track.left, -1, 0), np.roll(track.right, -1, 0)]),
  )


def brute_scan(track, angles, x, y, yaw, most):
  """Nearest crossing of each ray with any wall piece, by solving o + t d = a + u (b - a) for t and
  u: ranges, and cells of the pieces (-1: none).
  """
  a, b = pieces(track)
  ranges, cells = [], []
  for angle in np.float64(yaw) + angles:
    matrix = np.stack([np.broadcast_to([np.cos(angle), np.sin(angle)], a.shape), a - b], -1)
    t, u = np.linalg.solve(matrix, (a - [np.float64(x), np.float64(y)])[..., None])[..., 0].T
    t = np.where((t >= 0) & (u >= 0) & (u <= 1), t, np.inf)
    ranges.append(min(most, t.min()))
    cells.append(t.argmin() % len(track.left) if t.min() < most else -1)
  return ranges, cells


def brute_contact(track, x, y, yaw):
  """Gap between the car's outline and the walls [m], negative (-1) where they touch; from crossings
  and distances of all pairs of pieces.
  """
  a, b = pieces(track)
  turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]], float)
  corners = np.array([[0.29, 0.155], [-0.29, 0.155], [-0.29, -0.155], [0.29, -0.155]]) @ turn.T + [
    x,
    y,
  ]
  least = np.inf
  inside = np.abs((a - [x, y]) @ turn) <= [0.29, 0.155]
  for p, q in zip(corners, np.roll(corners, -1, 0)):

    def side(u, v, w):
      return (v[..., 0] - u[..., 0]) * (w[..., 1] - u[..., 1]) - (v[..., 1] - u[..., 1]) * (
        w[..., 0] - u[..., 0]
      )

    if (
      (side(p, q, a) * side(p, q, b) <= 0) & (side(a, b, p) * side(a, b, q) <= 0)
    ).any() or inside.all(1).any():
      return -1.0
    least = min(
      least, lib._gap(np.broadcast_to(p, a.shape), np.broadcast_to(q, a.shape), a, b).min()
    )
  return least


# ---- tracks --------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [*tracks.SHAPES, *SEEDS, 2])
def test_generated_track_is_closed_even_wide_and_gentle(shape):
  track = tracks.generate(shape)
  step = np.roll(track.centre, -1, 0) - track.centre
  spacing = np.linalg.norm(step, axis=1)
  assert 25 <= track.length <= 61 and track.name == str(shape)
  assert (
    spacing.max() / spacing.min() < 1.01 and spacing.max() <= tracks.SPACING
  )  # the last point to the first included; chords are shorter in curves
  assert abs(spacing.sum() / track.length - 1) < 0.003  # (0.4 m / 1.6 m)^2 / 24
  np.testing.assert_allclose(np.linalg.norm(track.left - track.right, axis=1), 2.2, rtol=1e-12)
  np.testing.assert_allclose((track.left + track.right) / 2, track.centre, atol=1e-12)
  assert np.abs(track.curvature).max() <= 1 / 1.6
  tangent = np.stack([np.cos(track.heading), np.sin(track.heading)], 1)
  np.testing.assert_allclose(((track.left - track.centre) * tangent).sum(1), 0, atol=1e-12)
  assert ((step * tangent).sum(1) > 0).all()
  cross = (
    tangent[:, 0] * (track.left - track.centre)[:, 1]
    - tangent[:, 1] * (track.left - track.centre)[:, 0]
  )
  np.testing.assert_allclose(cross, 1.1, rtol=1e-12)  # left is to the left
  turn = (np.roll(track.heading, -1) - track.heading + np.pi) % (2 * np.pi) - np.pi
  assert abs(turn.sum()) == pytest.approx(2 * np.pi)
  middle = (track.curvature + np.roll(track.curvature, -1)) / 2
  assert (
    np.abs(turn / (track.length / len(turn)) - middle).max() < 0.05
  )  # [1/m]; both ends of a cell against its mean, 1.6 m radius or more
  assert tracks.check(track) is None


def test_tracks_turn_both_ways_and_a_seed_gives_one_track():
  ways = [np.sign(tracks.generate(name).curvature.sum()) for name in tracks.SHAPES]
  assert ways.count(1) == ways.count(-1) == 3
  np.testing.assert_array_equal(tracks.generate(5).centre, tracks.generate(5).centre)
  assert tracks.generate(5).length != tracks.generate(6).length
  with pytest.raises(UserError, match="unknown track 'square'.*chicane.*oval"):
    tracks.generate("square")


def circle(radius, num=40):
  angle = np.arange(num) * 2 * np.pi / num
  return radius * np.stack([np.cos(angle), np.sin(angle)], 1)


def waist(num=60):
  """A dumbbell whose two long sides come as close as 1.5 m."""
  angle = np.arange(num) * 2 * np.pi / num
  x = 9 * np.cos(angle)
  return np.stack([x, 3.5 * np.sin(angle) * (1 - 0.786 * np.exp(-((x / 3) ** 2)))], 1)


def test_check_finds_what_is_wrong():
  angle = np.arange(40) * 2 * np.pi / 40
  eight = np.stack([8 * np.sin(angle), 8 * np.sin(angle) * np.cos(angle)], 1)
  flat = np.stack(
    [10 * np.cos(angle), 0.9 * np.sin(angle)], 1
  )  # its two long sides are less than a width apart
  assert tracks.check(tracks.build("circle", circle(3), 1.1, 1.1)) is None
  assert "crosses itself" in tracks.check(tracks.build("eight", eight, 1.1, 1.1))
  assert "folds" in tracks.check(tracks.build("tight", circle(1.0), 1.1, 1.1))
  assert tracks.check(tracks.build("flat", flat, 1.1, 1.1)) is not None
  assert "too close" in tracks.check(tracks.build("waist", waist(), 1.1, 1.1))
  assert tracks.check(tracks.build("waist", waist(), 0.5, 0.5)) is None


# ---- files ---------------------------------------------------------------------------------------


def rows(points, right=1.1, left=1.1):
  return [f"{x:.6f}, {y:.6f}, {right}, {left}" for x, y in points]


def test_csv_gives_the_track_it_was_written_from(tmp_path):
  want = tracks.generate("hook")
  path = tmp_path / "hook.csv"
  lines = rows(want.centre, 0.8, 1.0)
  path.write_text(
    "\n".join(["# x_m, y_m, w_tr_right_m, w_tr_left_m", *lines[:-1], "", lines[-1], lines[0]])
    + "  # the first point again\n"
  )
  track = tracks.load_csv(path)
  assert track.name == "hook" and track.length == pytest.approx(want.length, rel=1e-4)
  np.testing.assert_allclose(
    track.centre, want.centre, atol=1e-3
  )  # a spline through points of a spline, 6 decimals
  np.testing.assert_allclose(np.linalg.norm(track.left - track.centre, axis=1), 1.0)
  np.testing.assert_allclose(np.linalg.norm(track.right - track.centre, axis=1), 0.8)
  assert lib.Course([track]).window < len(track.centre)


good = rows(circle(5))
eight = rows(
  np.stack([9 * np.sin(np.arange(60) * np.pi / 30), 9 * np.sin(np.arange(60) * np.pi / 15)], 1),
  0.5,
  0.5,
)


@pytest.mark.parametrize(
  "lines, want",
  [
    (None, "cannot read track .*No such file"),
    (b"\xff\xfe\x00", "cannot read track .*not a text file"),
    ([*good[:3], "1.0, two, 1.1, 1.1", *good[3:]], "line 4: not a number in '1.0, two"),
    ([*good[:3], "1.0, nan, 1.1, 1.1", *good[3:]], "line 4: not a finite number"),
    (["# x; y"] + [g.replace(",", ";") for g in good], "line 2: 1 columns, expected 4"),
    ([g + ", 0.0" for g in good], "line 1: 5 columns, expected 4"),
    ([], "0 different points, at least 8"),
    (good[::8], "5 different points, at least 8"),
    (good[:2] * 10, "crosses itself"),
    (good[:30], "not closed, .* m from the last point to the first"),
    (eight, "crosses itself"),
    ([*good[:9], "5, 5, 0.35, 0.4"], "line 10: too narrow, 0.75 m; at least 0.8 m"),
    ([*good[:9], "5, 5, -0.1, 2"], "line 10: too narrow"),
    (rows(circle(1.0, 20)), "a wall folds"),
    (rows(waist()), "too close"),
  ],
)
def test_broken_files_are_refused_in_one_line(tmp_path, lines, want):
  path = tmp_path / "track.csv"
  if isinstance(lines, bytes):
    path.write_bytes(lines)
  elif lines is not None:
    path.write_text("\n".join(lines))
  with pytest.raises(FileError, match=want) as error:
    tracks.load_csv(path)
  assert "\n" not in str(error.value) and str(path) in str(error.value)


# ---- lidar ---------------------------------------------------------------------------------------


def test_lidar_equals_brute_force_over_all_walls(course):
  at = poses(course, 150)
  got = np.asarray(jax.jit(jax.vmap(course.scan))(*at))
  want = np.array(
    [
      brute_scan(course.tracks[k], course.angles, x, y, yaw, course.max_range)[0]
      for k, x, y, yaw in zip(*at)
    ]
  )
  # Walls seen at a grazing angle: a place known to 1e-6 m (float32 at 10 m) moves the reading by
  # 1e-6 m / sin(angle). Measured: 1e-4 to 3e-4.
  np.testing.assert_allclose(got, want, atol=2e-3)
  assert np.median(np.abs(got - want)) < 1e-5
  assert course.window < min(len(t.centre) for t in course.tracks)  # it did not look at every wall
  assert (want == 10).any() and want.min() < 0.1 and 1.0 < want.mean() < 5.0


def test_reach_holds_every_cell_that_is_seen_and_few_others(course):
  """The windows are no wider than needed: on every track some ray ends within 4 cells of the end of
  its cell's window, either way.
  """
  rng, spare = np.random.default_rng(4), []
  for track in course.tracks:
    first, count = lib.reach(track, course.max_range)
    num = len(track.centre)
    least = np.full(2, num)
    for i in rng.integers(num, size=60):
      x, y = (track.centre[i] + track.centre[(i + 1) % num]) / 2 + rng.uniform(-0.7, 0.7) * (
        track.left[i] - track.centre[i]
      )
      _, cells = brute_scan(track, np.linspace(-np.pi, np.pi, 90), x, y, 0.0, course.max_range)
      place = (np.array(cells)[np.array(cells) >= 0] - first[i]) % num
      assert place.max() < count[i], (track.name, i)
      least = np.minimum(least, [place.min(), count[i] - 1 - place.max()])
    spare.append(least)
  assert np.max(spare) <= 4, spare


def test_lidar_on_a_ring_by_hand():
  ring = tracks.build("ring", circle(4.0, 80), 1.1, 1.1)
  course = lib.Course([ring], beams=7)
  np.testing.assert_allclose(np.degrees(course.angles), [-135, -90, -45, 0, 45, 90, 135], atol=1e-4)
  x, y = ring.centre[5]
  got = np.asarray(
    jax.jit(course.scan)(0, jnp.float32(x), jnp.float32(y), jnp.float32(ring.heading[5]))
  )
  slant = 4 * np.cos(np.pi / 4)
  outward, inward = np.sqrt(5.1**2 - slant**2) - slant, slant - np.sqrt(2.9**2 - slant**2)
  # radii of the walls 5.1 m and 2.9 m; polylines of 0.4 to 0.5 m lie up to 6 mm inside the circles,
  # at a slant up to twice that
  np.testing.assert_allclose(
    got, [outward, 1.1, outward, np.sqrt(5.1**2 - 16), inward, 1.1, inward], atol=0.015
  )
  np.testing.assert_allclose(got[[1, 5]], 1.1, atol=1e-5)  # wall points lie beside the car


def test_a_track_among_others_reads_as_alone(course):
  at = poses(course, 20, seed=1)
  together = jax.jit(jax.vmap(course.scan))(*at)
  for k in (0, 3):
    alone, mine = lib.Course([course.tracks[k]]), at[0] == k
    np.testing.assert_allclose(
      jax.jit(jax.vmap(alone.scan, (None, 0, 0, 0)))(0, *(v[mine] for v in at[1:])),
      together[mine],
      atol=1e-4,
    )


# ---- place, contact, spawn -----------------------------------------------------------------------


def test_locate_finds_arc_length_and_side(course):
  rng = np.random.default_rng(2)
  track = np.repeat(np.arange(len(course.tracks), dtype=np.int32), 100)
  s = (rng.random(len(track)) * np.array([t.length for t in course.tracks])[track]).astype(
    np.float32
  )
  side = rng.uniform(-1.0, 1.0, len(track)).astype(np.float32)
  x, y, heading, curvature = (np.asarray(v) for v in jax.jit(jax.vmap(course.at))(track, s))
  place = jax.jit(jax.vmap(course.locate))(
    track, x - side * np.sin(heading), y + side * np.cos(heading)
  )
  length = np.array([t.length for t in course.tracks])[track]
  away = (np.asarray(place.s) - s + length / 2) % length - length / 2
  # the nearest point of a polyline lies up to a tenth of a cell beside that of the curve, times 1 /
  # (1 - side * curvature) <= 3 inside curves
  assert np.abs(away).max() < 0.15 and np.median(np.abs(away)) < 0.01
  np.testing.assert_allclose(place.lateral, side, atol=0.03)  # sagitta of a cell, 0.0125 m at most
  assert np.abs((place.heading - heading + np.pi) % (2 * np.pi) - np.pi).max() < 0.15 / 1.6
  assert np.abs(place.curvature - curvature).max() < 0.2


def test_place_wraps_around_the_line(course):
  t, at = course.tracks[1], jax.jit(course.at)
  for s in (0.3, 7.7):
    one, more, less = (at(1, jnp.float32(s + turns * t.length)) for turns in (0, 2, -1))
    np.testing.assert_allclose(np.array(more)[:2], np.array(one)[:2], atol=1e-4)  # float32 of 100 m
    np.testing.assert_allclose(np.array(less)[:2], np.array(one)[:2], atol=1e-4)


def test_contact_equals_brute_force(course):
  at = poses(course, 150, seed=3)
  got = np.asarray(jax.jit(jax.vmap(course.collides))(*at))
  gap = np.array(
    [
      brute_contact(course.tracks[k], np.float64(x), np.float64(y), np.float64(yaw))
      for k, x, y, yaw in zip(*at)
    ]
  )
  clear = (gap < 0) | (gap > 1e-5)  # float32
  np.testing.assert_array_equal(got[clear], gap[clear] < 0)
  assert clear.mean() > 0.99 and 0.15 < got.mean() < 0.5


def test_contact_by_hand(course):
  x, y = course.tracks[0].centre[3]
  heading = course.tracks[0].heading[3]
  touch = jax.jit(course.collides)
  for side, yaw, want in (
    (0.0, 0.0, False),
    (0.9, 0.0, False),
    (1.0, 0.0, True),
    (-0.9, 0.0, False),
    (-1.0, 0.0, True),
    (0.75, np.pi / 2, False),
    (0.85, np.pi / 2, True),
  ):  # 1.1 m less half the width, 0.155, or half the length, 0.29
    assert (
      bool(touch(0, x - side * np.sin(heading), y + side * np.cos(heading), heading + yaw)) == want
    ), (side, yaw)


def test_spawn_is_spread_and_free(course, same):
  keys = jax.random.split(jax.random.key(0), 2000)
  spawn = jax.jit(jax.vmap(course.spawn))
  track, x, y, yaw = spawn(keys)
  place = jax.jit(jax.vmap(course.locate))(track, x, y)
  share = np.asarray(place.s) / np.array([t.length for t in course.tracks])[np.asarray(track)]
  assert not jax.jit(jax.vmap(course.collides))(track, x, y, yaw).any()
  counts = np.bincount(track, minlength=len(course.tracks))
  assert np.abs(counts - 250).max() < 75  # 250 +- 15, 5 deviations
  assert np.abs(np.histogram(share, 10, (0, 1))[0] - 200).max() < 67  # 200 +- 13.4
  assert 0.29 < np.abs(place.lateral).max() < 0.32
  turn = np.abs((yaw - place.heading + np.pi) % (2 * np.pi) - np.pi)
  assert 0.15 < turn.max() < 0.3
  assert same(spawn(keys[:3]), spawn(keys[:3])) and not same(spawn(keys[:3]), spawn(keys[3:6]))


def test_narrow_tracks_spawn_clear_of_the_walls():
  course = lib.Course([tracks.build("lane", circle(6), 0.4, 0.4)])
  at = jax.jit(jax.vmap(course.spawn))(jax.random.split(jax.random.key(0), 300))
  assert not jax.jit(jax.vmap(course.collides))(*at).any()
