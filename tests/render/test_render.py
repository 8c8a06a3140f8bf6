"""Moving pictures: what is drawn where, the mark of a fault, frames and pace of the file, and one
line for whatever is wrong.
"""

import copy
import io
import json
import os
import subprocess
import sys
import types

import mujoco
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image, ImageColor, ImageSequence
from test_cli import mjx, refused  # noqa: F401  fixtures

from mjx_cl import envs
from mjx_cl.cli import app, robots
from mjx_cl.envs import adapters
from mjx_cl.envs.course import Course
from mjx_cl.errors import FileError, UserError
from mjx_cl.render import compare, figures, files, offscreen, outlines
from mjx_cl.render import pictures as render
from mjx_cl.render import scene as scenes
from mjx_cl.types import EnvState

STEPS, ONSET, EVERY = 30, 12, 2  # walker: 0.025 s a step, 20 pictures a second
WIDTH, HEIGHT = 160, 120


@pytest.fixture(scope="module")
def frames(short_walker):
  """Frames of a walker that moves at random, its left hip dead from step 12 on; episodes last 12
  steps.
  """
  return list(
    render.act(
      short_walker,
      STEPS,
      3,
      adapters.Puppet(6, 1.0),
      fault="gear",
      target="left_hip",
      severity=1.0,
      onset=ONSET,
    )
  )


@pytest.fixture
def film(short_walker, frames, monkeypatch):
  """film(out, **options): `render.render` of those frames, without GL."""
  monkeypatch.setattr(render, "gl_library", lambda: None)
  monkeypatch.setattr(render, "act", lambda env, steps, repeat=1, **_: iter(frames[:steps]))
  return lambda out, **options: render.render(
    short_walker,
    out,
    **{"steps": STEPS, "width": WIDTH, "height": HEIGHT, "fault": "gear"} | options,
  )


def still(model, qpos=None, obs=None):
  """A Frame of a robot at qpos, and an environment that has no more than its model."""
  qpos = np.array(mujoco.MjData(model).qpos if qpos is None else qpos)
  return types.SimpleNamespace(mj_model=model), scenes.Frame(
    EnvState(types.SimpleNamespace(qpos=qpos), 0), obs, 0, 0, 0.0, 0.0
  )


def pictures(path):
  """(frames uint8 (N, height, width, 3), duration of each [ms])."""
  with Image.open(path) as image:
    frames = [
      (np.asarray(f.convert("RGB")), f.info["duration"]) for f in ImageSequence.Iterator(image)
    ]
  return np.stack([f for f, _ in frames]), [d for _, d in frames]


def marked(picture):
  """Whether all of the outermost pixels have the mark's colour."""
  edge = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]]).astype(int)
  return bool((np.abs(edge - files.MARK).max(-1) < 24).all())  # a GIF has 128 colours


# ---- acting --------------------------------------------------------------------------------------


def test_frames_are_those_of_the_environment(frames, short_walker):
  assert [f.step for f in frames] == list(range(STEPS)) and [f.episode for f in frames] == [
    k // 12 for k in range(STEPS)
  ]
  assert [f.severity for f in frames] == [float(k >= ONSET) for k in range(STEPS)]
  for f in frames:
    qpos = scenes.qpos_of(short_walker, f.state)
    assert qpos.dtype == np.float64 and f.obs[14] == pytest.approx(
      1.3 + qpos[0], abs=1e-6
    )  # the height it senses is the one drawn
  np.testing.assert_array_equal(
    [scenes.qpos_of(short_walker, f.state)[1] for f in (frames[0], frames[12], frames[24])], 0
  )  # resets
  assert (
    np.ptp([f.reward for f in frames]) > 0
    and len({f.state.physics.tobytes() for f in frames}) == STEPS
  )


def test_position_of_the_other_backend_and_of_a_task_that_keeps_a_state_of_its_own(
  short_walker, frames
):
  row = frames[5].state
  want = scenes.qpos_of(short_walker, row)
  kept = EnvState((row.physics, "something else"), 5)
  np.testing.assert_array_equal(scenes.qpos_of(short_walker, kept), want)
  mjx_data = EnvState(types.SimpleNamespace(qpos=want.astype(np.float32)), 5)
  np.testing.assert_array_equal(scenes.qpos_of(short_walker, mjx_data), want.astype(np.float32))


# ---- outlines ------------------------------------------------------------------------------------

GEOMS = {
  "sphere": ("0.3", 0.3, 0.3),
  "capsule": ("0.2 0.5", 0.2, 0.7),
  "cylinder": ("0.2 0.5", 0.2, 0.5),
  "box": ("0.2 0.3 0.5", 0.2, 0.5),
  "ellipsoid": ("0.2 0.3 0.5", 0.2, 0.5),
}


@pytest.mark.parametrize("kind", GEOMS)
def test_outline_of_each_geom_has_its_size(kind):
  size, half_width, half_height = GEOMS[kind]
  model = mujoco.MjModel.from_xml_string(
    f"<mujoco><worldbody><body><geom type='{kind}' size='{size}'/></body></worldbody></mujoco>"
  )
  points, radius = outlines.solid(model, 0)
  shape = outlines.outline(points[:, [0, 2]], radius)
  np.testing.assert_allclose(
    np.abs(shape).max(0), [half_width, half_height], rtol=0.01
  )  # 48 directions; a ring of 48 points
  np.testing.assert_allclose(shape.mean(0), 0, atol=0.05)


def test_a_plane_is_no_solid_and_a_mesh_is():
  tetra = "0 0 0  1 0 0  0 1 0  0 0 1"
  model = mujoco.MjModel.from_xml_string(
    f"<mujoco><asset><mesh name='m' vertex='{tetra}'/></asset><worldbody><geom type='plane' "
    "size='1 1 1'/>"
    "<body><freejoint/><geom type='mesh' mesh='m'/></body></worldbody></mujoco>"
  )
  assert outlines.solid(model, 0) is None
  points, radius = outlines.solid(model, 1)
  assert points.shape == (4, 3) and radius == 0
  assert not scenes.planar(model) and scenes.floor_of(model, mujoco.MjData(model)) == 0


def test_sketch_draws_the_body_where_it_is(walker):
  """A ball of 0.2 m: it stands in the middle column wherever it is, and rises in the picture with
  z.
  """
  xml = (
    "<mujoco><worldbody><geom type='plane' size='9 9 1'/><body name='b' pos='0 0 0'><joint "
    "type='slide' axis='1 0 0'/>"
    "<joint type='slide' axis='0 0 1'/><geom size='0.2' rgba='1 0 0 "
    "1'/></body></worldbody></mujoco>"
  )
  model = mujoco.MjModel.from_xml_string(xml)

  def red(x, z):
    env, frame = still(model, [x, z])
    picture = outlines.Sketch(env, 100, 100).picture(frame).astype(int)
    rows, columns = np.nonzero((picture[..., 0] > 150) & (picture[..., 1:].max(-1) < 80))
    return rows.mean(), columns.mean(), np.ptp(columns) + 1

  low, high, far = red(0, 0.07), red(0, 0.17), red(7, 0.07)
  scale = 100 / (2.6 * 0.2)  # pixels per metre: the picture is 2.6 reaches high
  assert low[0] - high[0] == pytest.approx(0.1 * scale, abs=1)
  assert low[1] == pytest.approx(49.5, abs=1) == far[1]  # the camera follows
  assert low[2] == pytest.approx(0.4 * scale, abs=4)
  env, frame = still(walker)
  assert len(np.unique(outlines.Sketch(env, 100, 100).picture(frame).reshape(-1, 3), axis=0)) > 5


def test_a_nearer_body_hides_a_farther_one():
  """Seen along +y; the second body stands before the first."""
  ball = lambda y, color: (
    f"<body pos='0 {y} 1'><joint type='slide' axis='1 0 0'/><geom size='0.2' rgba='{color} "
    "1'/></body>"
  )
  model = mujoco.MjModel.from_xml_string(
    f"<mujoco><worldbody>{ball(1, '1 0 0')}{ball(-1, '0 1 0')}</worldbody></mujoco>"
  )
  env, frame = still(model)
  picture = outlines.Sketch(env, 200, 200).picture(frame).astype(int)
  greenish, reddish = (
    picture[..., 1] > picture[..., 0] + 100,
    picture[..., 0] > picture[..., 1] + 100,
  )
  assert (
    greenish.sum() > 50 and reddish.sum() < 0.3 * greenish.sum()
  )  # the edge lines apart, equal balls cover each other


# ---- from above ----------------------------------------------------------------------------------


class Racer:
  """A car at the start of the course's first track, as far as drawing goes."""

  course = Course()

  def pose(self, state):
    track = self.course.tracks[0]
    return 0, *track.centre[0], track.heading[0], 0.0


def test_a_car_is_drawn_on_its_track_with_its_lidar():
  env = Racer()
  env.spec = types.SimpleNamespace(name="car")
  scene, by = render.painter(env, 200, 160)
  _, x, y, yaw, _ = env.pose(None)
  ranges = np.asarray(env.course.scan(0, x, y, yaw)) / env.course.max_range

  def picture(obs):
    return scene.picture(
      scenes.Frame(None, np.concatenate([obs, np.zeros(3)]), 0, 0, 0.0, 0.0)
    ).astype(int)

  seen, blind = picture(ranges), picture(np.zeros(env.course.beams))
  assert by == "matplotlib" and seen.shape == (160, 200, 3)
  np.testing.assert_allclose(seen[80, 100], [196, 71, 43], atol=30)  # the car, in the middle
  blue = lambda image: (image[..., 2] > image[..., 0] + 40).sum()
  assert blue(seen) > 10 * max(1, blue(blind))  # the lidar as read: a dead one shows no rays
  with pytest.raises(UserError, match="no MuJoCo model"):
    render.painter(env, 200, 160, "robot")


def test_an_environment_may_draw_itself():
  class Own:
    spec = types.SimpleNamespace(name="own")

    def draw(self, ax, state, obs):
      ax.fill([0, 2, 2, 0], [0, 0, 1, 1], color=(0, 0, 1))
      return (1.0, 0.5), 1.0

  scene, _ = render.painter(Own(), 128, 64)
  picture = scene.picture(scenes.Frame(None, None, 0, 0, 0.0, 0.0))
  np.testing.assert_array_equal(picture[2:-2, 2:-2], np.broadcast_to([0, 0, 255], (60, 124, 3)))
  blank = types.SimpleNamespace(spec=types.SimpleNamespace(name="blank"))
  with pytest.raises(UserError, match="no view from above"):
    render.painter(blank, 128, 64)


# ---- GL ------------------------------------------------------------------------------------------


def test_without_a_gl_library_one_line_says_so_and_outlines_are_drawn(short_walker, monkeypatch):
  monkeypatch.setattr(
    offscreen.subprocess, "run", lambda *_, **__: subprocess.CompletedProcess((), 1)
  )  # neither binding works
  said = []
  scene, by = render.painter(short_walker, WIDTH, HEIGHT, say=said.append)
  assert isinstance(scene, outlines.Sketch) and by == "matplotlib"
  assert len(said) == 1 and "GL" in said[0] and "matplotlib" in said[0] and "\n" not in said[0]


@pytest.mark.parametrize(
  "works, asked, want",
  [
    (("egl", "osmesa"), "", "egl"),
    (("osmesa",), "", "osmesa"),
    ((), "", None),
    (("egl", "osmesa"), "osmesa", "osmesa"),
    (("egl",), "off", None),
  ],
)
def test_choice_of_the_gl_library(monkeypatch, works, asked, want):
  monkeypatch.setattr(offscreen.sys, "platform", "linux")
  monkeypatch.setenv("MUJOCO_GL", asked)
  monkeypatch.setenv("PYOPENGL_PLATFORM", "glx")

  def run(command, env, **_):
    assert (
      env["MUJOCO_GL"] == command[-1] and "PYOPENGL_PLATFORM" not in env
    )  # what another binding left behind
    return subprocess.CompletedProcess(command, int(command[-1] not in works))

  monkeypatch.setattr(offscreen.subprocess, "run", run)
  assert render.gl_library() == want


def test_mujocos_own_renderer_where_there_is_a_gl_library(walker):
  library = render.gl_library()
  if library is None:
    pytest.skip("no GL library here: MuJoCo cannot draw")
  env, frame = still(walker)
  scene = offscreen.Offscreen(env, 96, 64, library)
  upright = scene.picture(frame)
  turned = scene.picture(still(walker, [-0.5, 3.3, 1.5, 0, 0, 0, 0, 0, 0])[1])
  scene.close()
  assert upright.shape == (64, 96, 3) and upright.dtype == np.uint8
  np.testing.assert_array_equal(
    upright[0], np.broadcast_to(scenes.sky(64)[0], (96, 3))
  )  # nothing but sky above
  assert (upright != turned).any(-1).mean() > 0.02 and (
    upright[:, 48] != scenes.sky(64)
  ).any()  # the robot in the middle


# ---- file ----------------------------------------------------------------------------------------


def test_gif(film, tmp_path):
  result = film(tmp_path / "a.gif")
  shown, durations = pictures(tmp_path / "a.gif")
  assert result == {
    "file": str(tmp_path / "a.gif"),
    "frames": STEPS // EVERY,
    "steps": STEPS,
    "fps": 20.0,
    "drawn_by": "matplotlib",
  }
  assert shown.shape == (STEPS // EVERY, HEIGHT, WIDTH, 3) and durations == [50] * (STEPS // EVERY)
  assert [marked(p) for p in shown] == [
    k * EVERY >= ONSET for k in range(STEPS // EVERY)
  ]  # from the onset on
  badge = shown[:, HEIGHT - 16 :, WIDTH // 2 :].astype(int)
  red = (np.abs(badge - files.MARK).max(-1) < 24).mean((1, 2))
  assert (red[ONSET // EVERY :] > 0.3).all() and (red[: ONSET // EVERY] == 0).all()
  assert os.listdir(tmp_path) == ["a.gif"]


def test_no_mark_without_a_fault_and_every_step_where_that_is_asked(film, tmp_path):
  result = film(tmp_path / "a.gif", fault="none", fps=40)
  shown, durations = pictures(tmp_path / "a.gif")
  assert result["frames"] == len(shown) == STEPS
  assert set(durations) == {20, 30} and sum(durations) == 25 * STEPS  # its clock counts in 10 ms
  assert not any(marked(p) for p in shown)


def test_mp4(film, tmp_path):
  ffmpeg = pytest.importorskip("imageio_ffmpeg")
  film(tmp_path / "a.mp4", width=81, height=65)
  count, seconds = ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))
  assert count == STEPS // EVERY and seconds == pytest.approx(STEPS * 0.025, abs=0.05)
  reader = ffmpeg.read_frames(str(tmp_path / "a.mp4"))
  assert next(reader)["size"] == (82, 66)  # H.264 has even sizes
  reader.close()


def test_an_mp4_without_ffmpeg_says_what_to_install(film, tmp_path, monkeypatch):
  monkeypatch.setattr(files.shutil, "which", lambda _: None)
  monkeypatch.setitem(offscreen.sys.modules, "imageio_ffmpeg", None)
  with pytest.raises(UserError, match=r"pip install 'mjx-cl\[video\]'"):
    film(tmp_path / "a.mp4")
  assert os.listdir(tmp_path) == []


def test_an_ffmpeg_that_fails_is_one_error_and_leaves_nothing(film, tmp_path, monkeypatch):
  broken = tmp_path / "ffmpeg"
  broken.write_text("#!/bin/sh\necho 'Unknown encoder' >&2\nexit 1\n")
  broken.chmod(0o755)
  monkeypatch.setattr(files, "ffmpeg", lambda: str(broken))
  with pytest.raises(FileError, match="Unknown encoder"):
    film(tmp_path / "a.mp4")
  assert os.listdir(tmp_path) == ["ffmpeg"]


def test_a_failure_on_the_way_keeps_the_earlier_file(film, tmp_path, monkeypatch):
  (tmp_path / "a.gif").write_bytes(b"earlier")

  def fail(*_, **__):
    raise OSError(28, "No space left on device")

  monkeypatch.setattr(files, "write_gif", fail)
  with pytest.raises(OSError):
    film(tmp_path / "a.gif")
  assert (tmp_path / "a.gif").read_bytes() == b"earlier" and os.listdir(tmp_path) == ["a.gif"]


# ---- side by side --------------------------------------------------------------------------------


def panes(env, **broken):
  """Two robots that move at random, the second with a fault."""
  puppet = {"agent": adapters.Puppet(len(env.spec.act), 1.0)}
  return [
    compare.Pane("HEALTHY", "whole", env, puppet),
    compare.Pane("BROKEN", "a word", env, puppet | broken),
  ]


def test_robots_side_by_side_are_those_that_act_alone(short_walker, tmp_path, monkeypatch):
  """One seed: alike until the onset, where the second's hip dies; what is said of their reward is
  the mean of what is shown, as `act` gives it.
  """
  monkeypatch.setattr(render, "gl_library", lambda: None)
  dead = {"fault": "gear", "target": "left_hip", "severity": 1.0, "onset": ONSET}
  shown, skip = 24, 6
  two = panes(short_walker, **dead)
  said = compare.film(two, tmp_path / "a.gif", shown, skip, WIDTH, HEIGHT, weak="left_hip", seed=3)
  film, _ = pictures(tmp_path / "a.gif")
  assert said["frames"] == len(film) == shown // EVERY and os.listdir(tmp_path) == ["a.gif"]
  rewards = [
    np.array([f.reward for f in render.act(short_walker, skip + shown, 3, **pane.acting)])
    for pane in two
  ]
  np.testing.assert_allclose(said["reward"], [r[skip:].mean() for r in rewards], rtol=1e-6)
  assert film.shape[2] == 2 * WIDTH + compare.GAP
  first, second = film[..., :WIDTH, :], film[..., WIDTH + compare.GAP :, :]
  body = (slice(None), slice(compare.TOP + 4, compare.TOP + HEIGHT - 4), slice(4, WIDTH - 4))
  bodies = [x[body].astype(int) for x in (first, second)]
  red = [(x[..., 0] - x[..., 1:].max(-1) > 50).any((1, 2)) for x in bodies]
  early = np.arange(len(film)) * EVERY + skip < ONSET
  assert not red[0].any() and not red[1][early].any() and 0 < early.sum() < len(film)
  assert red[1][~early].mean() > 0.8  # its weak leg, unless the other hides it
  plain = lambda x: np.where((x[..., 0] - x[..., 1] > 40)[..., None], 0, x)
  apart = np.abs(plain(bodies[0]) - plain(bodies[1])).sum((1, 2, 3))
  assert apart[-1] > 3 * apart[0]


def test_rewards_below_0_are_no_shares(short_walker):
  """Twice the loss is no bar that is full: the page shows rewards, and no bar."""
  two = panes(short_walker)
  images = [np.zeros((HEIGHT, 160, 3), np.uint8)] * 2
  foot = slice(compare.TOP + HEIGHT + 14, compare.TOP + HEIGHT + 28)
  track = lambda page: (page[foot] == ImageColor.getrgb(compare.TRACK)).all(-1).any()
  assert not track(compare.page(two, images, [-0.5, -1.0], 1.0, in_percent=False))
  assert track(compare.page(two, images, [1.0, 0.3], 1.0))


@pytest.mark.parametrize(
  "kind, decision, said",
  (
    ("stop", "stop", "converged"),
    ("stop", "end", "time over"),
    ("abort", "abort_budget", "given up"),
  ),
)
def test_a_figure_says_how_learning_ended(kind, decision, said):
  """What ends by its budget has not converged."""
  axis = Figure().subplots()
  events = {"step": [100, 500], "kind": ["start", kind], "stream": [0, 0]}
  figures._spans(axis, events | {"decision": ["start", decision]}, [0], 1000, "k")
  assert [text.get_text() for text in axis.get_legend().get_texts()] == [said]


def test_which_parts_an_actuator_moves(short_walker):
  walker, body = short_walker, short_walker.mj_model.body
  parts = lambda *names: {body(n).id for n in names}
  assert compare.bodies(walker, "right_knee") == parts("right_leg", "right_foot")
  assert compare.bodies(walker, "left_leg") == parts("left_thigh", "left_leg", "left_foot")
  assert compare.bodies(walker, "height") == compare.bodies(walker, None) == set()


def test_side_by_side_by_command(mjx, refused, tmp_path, monkeypatch):  # noqa: F811
  monkeypatch.setattr(render, "gl_library", lambda: None)
  out, size = str(tmp_path / "a.gif"), ("--steps", "8", "--width", "96", "--height", "96")
  fault = ("--fault", "car/sim-to-real", "--compare", "car-2")
  code, text, err = mjx("render", "car", *fault, *size, "--out", out, "--json")
  said = json.loads(text)
  assert code == 0 and said["frames"] == len(pictures(out)[0]) and len(said["reward"]) == 3, err
  assert "--overwrite replaces it" in refused(2, "render", "walker", *size, "--out", out)
  other = str(tmp_path / "b.gif")
  say = lambda *flags: refused(2, "render", "walker", "--out", other, *size, *flags)
  assert "got no value" in say("--compare")
  assert "--skip goes with --compare" in say("--skip", "3")
  assert "2 to 6 robots" in say("--fault", "gear", "--compare", *["walker"] * 5)


def test_caption_and_badge_stay_inside_the_picture():
  image = np.full((64, 64, 3), 255, np.uint8)
  out = files.framed(image, "a caption that is longer than the picture is wide", "FAULT gear 1.00")
  assert (
    out.shape == image.shape
    and marked(out)
    and (out[4:16] < 100).any()
    and not marked(files.framed(image, "x"))
  )


# ---- command -------------------------------------------------------------------------------------


def test_help_imports_nothing_heavy():
  process = subprocess.run(
    [sys.executable, "-X", "importtime", "-m", "mjx_cl", "render", "--help"],
    capture_output=True,
    text=True,
    timeout=1200,
  )
  imported = {
    line.split("|")[-1].strip()
    for line in process.stderr.splitlines()
    if line.startswith("import time:")
  }
  assert process.returncode == 0 and all(
    flag in process.stdout for flag in ("--fault", "--onset", "--fps", "--view", "--out")
  )
  assert not imported & {"jax", "mujoco", "matplotlib", "PIL"}


def test_command(mjx, film, tmp_path, monkeypatch, short_walker):  # noqa: F811
  """Puppet, pictures and file; the physics was stepped by the fixture."""
  monkeypatch.setattr(envs, "make", lambda *_: short_walker)
  argv = [
    "render",
    "walker",
    "--agent",
    "random",
    "--steps",
    "6",
    "--width",
    "64",
    "--height",
    "64",
    "--out",
    tmp_path / "a.gif",
  ]
  code, out, err = mjx(*argv, "--json")
  assert (
    code == 0
    and out.count("\n") == 1
    and '"frames": 3' in out
    and err.count("\n") == 1
    and "GL" in err
  )
  assert len(pictures(tmp_path / "a.gif")[0]) == 3
  code, out, err = mjx(*argv, "--overwrite")
  assert code == 0 and str(tmp_path / "a.gif") in out and "3 pictures" in out


def test_the_shipped_agent_acts_by_default(monkeypatch, tmp_path):
  taken = {}
  monkeypatch.setattr(
    render,
    "render",
    lambda env, out, *_, **options: (
      taken.update(options, out=out)
      or {"file": out, "frames": 1, "steps": 1, "fps": 20.0, "drawn_by": "-"}
    ),
  )
  monkeypatch.chdir(tmp_path)
  robots.do_render(app.Render("walker", duration=7))
  assert (
    type(taken["agent"]).__name__ == "Agent"
    and taken["params"]
    and taken["repeat"] == 1
    and taken["duration"] == 7
    and taken["out"] == "walker.gif"
  )
  robots.do_render(app.Render("walker", agent="none"))
  assert taken["agent"].spread == 0


BAD = {
  "environment": (["wlker"], ["wlker", "walker"]),
  "suffix": (["walker", "--out", "a.avi"], [".gif or .mp4", "a.avi"]),
  "no suffix": (["walker", "--out", "a"], [".gif or .mp4"]),
  "zero steps": (["walker", "--steps", "0"], ["steps", "0"]),
  "width": (["walker", "--width", "8"], ["width", "8"]),
  "height": (["walker", "--height", "9999"], ["height", "9999"]),
  "fps": (["walker", "--fps", "0"], ["fps"]),
  "fps nan": (["walker", "--fps", "nan"], ["fps"]),
  "view": (["walker", "--agent", "none", "--view", "side"], ["side", "top"]),
  "no view from above": (["walker", "--agent", "none", "--view", "top"], ["walker", "above"]),
  "fault": (["walker", "--agent", "none", "--fault", "geer"], ["geer", "gear"]),
  "target": (
    ["walker", "--agent", "none", "--fault", "gear", "--target", "elbow"],
    ["elbow", "left_knee"],
  ),
  "severity": (["walker", "--agent", "none", "--severity", "1.5"], ["severity", "1.5"]),
  "onset": (["walker", "--agent", "none", "--onset", "-1"], ["onset"]),
  "duration": (["walker", "--agent", "none", "--duration", "0"], ["duration"]),
  "preset": (
    ["walker", "--agent", "none", "--fault", "walker/gear-haf"],
    ["gear-haf", "walker/gear-half"],
  ),
  "preset's severity": (
    ["walker", "--agent", "none", "--fault", "walker/gear-half", "--severity", "0.1"],
    ["brings its own"],
  ),
  "another robot": (
    ["car", "--agent", "none", "--fault", "car/sim-to-real"],
    ["car_real", "mjx-cl run"],
  ),
  "schedule": (
    ["walker", "--agent", "none", "--fault", "gear", "--schedule", "sine"],
    ["sine", "cyclic"],
  ),
  "seed": (["walker", "--agent", "none", "--seed", "-1"], ["seed"]),
  "agent": (["walker", "--agent", "wlaker"], ["wlaker"]),
  "physics": (["walker", "--physics", "warp"], ["warp"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_argument_is_one_line(refused, tmp_path, monkeypatch, case):  # noqa: F811
  argv, words = BAD[case]
  monkeypatch.chdir(tmp_path)
  text = refused(2, "render", *argv)
  assert all(word in text for word in words), text
  assert os.listdir(tmp_path) == []


def test_a_robot_without_a_shipped_agent(refused, short_walker, monkeypatch):  # noqa: F811
  newcomer = copy.copy(short_walker)
  newcomer.spec = newcomer.spec._replace(name="newcomer")
  monkeypatch.setattr(envs, "make", lambda *_: newcomer)
  text = refused(2, "render", "newcomer")
  assert "newcomer" in text and "--agent none" in text


def test_an_unwritable_place_is_one_line(refused, tmp_path):  # noqa: F811
  assert "No such file" in refused(
    1, "render", "walker", "--agent", "none", "--out", tmp_path / "nowhere" / "a.gif"
  )
  (tmp_path / "a.gif").mkdir()
  assert "is a folder" in refused(
    1, "render", "walker", "--agent", "none", "--out", tmp_path / "a.gif"
  )
  assert os.listdir(tmp_path) == ["a.gif"]


def test_gif_of_one_picture_is_a_gif():
  out = io.BytesIO()
  files.write_gif(out, [np.zeros((64, 64, 3), np.uint8)], 20)
  assert out.getvalue()[:6] in (b"GIF87a", b"GIF89a")
