"""An episode as a moving picture: GIF, or MP4 where ffmpeg is at hand.

MuJoCo draws off-screen where the system has a GL library. Where it has none, the bodies are drawn
with matplotlib from the positions that MuJoCo's kinematics gives: in side view a planar robot, in
an oblique view any other. A car is also drawn from above, on its track and with its lidar; so is a
robot that MuJoCo does not know, see `Plan`. Every picture is then framed: caption, and a red border
while a fault acts.
"""

import contextlib
import functools
import itertools
import os
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.config import check_seeds
from mjx_cl.envs.adapters import Puppet, join, worst
from mjx_cl.errors import FileError, UserError
from mjx_cl.render.files import ffmpeg, framed, written
from mjx_cl.render.offscreen import Offscreen, gl_library
from mjx_cl.render.outlines import Plan, Sketch, draw_car
from mjx_cl.render.scene import Frame
from mjx_cl.rollout.scan import nest

SUFFIXES = (".gif", ".mp4")
MOST_STEPS = 100_000  # control steps of an episode


def act(
  env: Any,
  steps: int,
  seed: int = 0,
  agent: Any = None,
  params: Any = None,
  repeat: int = 1,
  deterministic: bool = False,
  **fault: Any,
) -> Iterator[Frame]:
  """Frames of `steps` control steps, one per decision, of the robot that seed `seed` has in `run`;
  faults as in `adapters.join`.
  """
  rollout, begin = join(
    env, agent or Puppet(len(env.spec.act)), repeat=repeat, deterministic=deterministic, **fault
  )  # refuses before it acts
  params = jax.tree.map(lambda x: x[None], jnp.zeros(()) if params is None else params)

  def live() -> Iterator[Frame]:
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


def bare(x: jax.Array) -> np.ndarray:
  """The one robot of a leaf (1, 1, ...), in NumPy; a key as its bits."""
  x = jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
  return np.asarray(x[0, 0])


VIEWS = ("auto", "robot", "top")


def painter(
  env: Any,
  width: int,
  height: int,
  view: str = "auto",
  say: Callable[[str], object] = lambda text: None,
) -> tuple[Plan | Offscreen | Sketch, str]:
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
  if library := gl_library():
    return Offscreen(env, width, height, library), f"MuJoCo ({library})"
  say(
    "no GL library for MuJoCo's renderer (Debian: apt install libegl1, or libosmesa6); drawing "
    "outlines with matplotlib"
  )
  return Sketch(env, width, height), "matplotlib"


def check(
  out: os.PathLike | str, steps: int, width: int, height: int, fps: float, seed: int = 0
) -> pathlib.Path:
  """The output path, or the one thing that is wrong with the arguments."""
  out = pathlib.Path(out)
  if out.suffix.lower() not in SUFFIXES:
    raise UserError(f"--out must end in {' or '.join(SUFFIXES)}; got {str(out)!r}")
  for name, value, low, high, words in (
    ("steps", steps, 1, MOST_STEPS, f"1..{MOST_STEPS:,}, whose pictures are kept in memory"),
    ("width", width, 64, 4096, "64..4096"),
    ("height", height, 64, 4096, "64..4096"),
    ("fps", fps, 1, 50, "1..50"),
  ):
    if not low <= value <= high:
      raise UserError(f"{name} must lie in {words}; got {value}")
  check_seeds(seed)
  if out.suffix.lower() == ".mp4":
    ffmpeg()
  if out.is_dir():
    raise FileError(f"{out} is a folder")
  return out


def render(
  env: Any,
  out: os.PathLike | str,
  steps: int = 400,
  width: int = 480,
  height: int = 360,
  fps: float = 20.0,
  fault: str = "none",
  target: str | None = None,
  repeat: int = 1,
  view: str = "auto",
  say: Callable[[str], object] = lambda text: None,
  **acting: Any,
) -> dict[str, Any]:
  """Acts and writes a picture, at the robot's own pace; every n-th decision is drawn, for `fps`.

  Args:
    env: the robot.
    out: path that ends in .gif or .mp4; written under another name, then renamed.
    steps: control steps.
    width: of a picture [pixels].
    height: of a picture [pixels].
    fps: pictures a second.
    fault: as in `adapters.join`.
    target: what breaks.
    repeat: control steps of a decision.
    view: one of VIEWS.
    say: takes lines for standard error.
    **acting: of `act`.

  Returns:
    file, frames, steps, fps, drawn_by.
  """
  out = check(out, steps, width, height, fps)
  decision_s = env.spec.control_s * repeat
  every = max(1, round(1.0 / (fps * decision_s)))
  fps = 1.0 / (every * decision_s)
  acted = act(env, steps, repeat=repeat, fault=fault, target=target, **acting)
  label = " ".join(["FAULT", fault] + ([target] if target not in (None, "random") else []))
  with written(out) as write:
    scene, drawn_by = painter(env, width, height, view, say)
    with contextlib.closing(scene):
      drawn = itertools.islice(acted, 0, None, every)
      write((pictured(env, scene, frame, label if fault != "none" else "") for frame in drawn), fps)
  return {
    "file": str(out),
    "frames": len(range(0, steps, repeat * every)),
    "steps": steps,
    "fps": round(fps, 3),
    "drawn_by": drawn_by,
  }


def pictured(env: Any, scene: Plan | Offscreen | Sketch, frame: Frame, label: str) -> np.ndarray:
  """A frame as it is shown, uint8 (height, width, 3): with its caption, and with the label and the
  severity of a fault that acts.
  """
  caption = (
    f"{env.spec.name}   step {frame.step}   {frame.step * env.spec.control_s:.1f} s   "
    f"reward {frame.reward:.2f}"
  )
  badge = f"{label} {frame.severity:.2f}" if label and frame.severity > 0 else None
  return framed(scene.picture(frame), caption, badge)
