"""Robots side by side in one moving picture: whole, with a fault, and with what others have learnt.

All panes show one seed. Parts that a fault weakens are red where MuJoCo draws the robot, the other
ones plain. Below each robot stands its mean reward of the last second, in percent of the first
robot's over the whole film.
"""

import contextlib
import functools
import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mjx_cl.errors import UserError
from mjx_cl.render import pictures, style
from mjx_cl.render.files import written

PAPER, INK, FAINT, TRACK = "#ffffff", "#20242c", "#787e88", "#e4e6ea"
WEAK, SOUND = (0.86, 0.16, 0.13, 1), (0.80, 0.83, 0.88, 1)
COLOURS = (style.GREEN, style.GREY, style.BLUE, *style.CYCLE[3:])
TOP, FOOT, GAP, MOST = 46, 52, 8, 6  # pixels above and below a robot, between panes; panes


class Pane(NamedTuple):
  """A robot that is shown.

  Attributes:
    title: in capitals above it.
    words: in a line below that.
    env: the robot.
    acting: arguments of `pictures.act`: agent, params, repeat, fault, ...
  """

  title: str
  words: str
  env: Any
  acting: dict[str, Any]


def bodies(env: Any, target: str | None) -> set[int]:
  """Bodies that an actuator, or a group of them, moves: of its joints and all behind them."""
  names, model = [v.name for v in env.spec.act], getattr(env, "mj_model", None)
  group = dict(env.spec.act_groups).get(target or "", ())
  moved = [names.index(target)] if target in names else list(group)
  if model is None or not moved:
    return set()
  joints = [model.actuator_trnid[i, 0] for i in moved]
  found = {int(model.jnt_bodyid[j]) for j in joints}
  for body in range(1, model.nbody):  # a parent comes before its children
    if int(model.body_parentid[body]) in found:
      found.add(body)
  return found


def tint(model: mujoco.MjModel, weak: set[int], acts: bool) -> None:
  """One colour for a robot's parts, another for those of the bodies `weak` while the fault acts."""
  for geom in range(model.ngeom):
    if (body := int(model.geom_bodyid[geom])) > 0 and model.geom_rgba[geom, 3] > 0:
      model.geom_matid[geom] = -1
      model.geom_rgba[geom] = WEAK if acts and body in weak else SOUND


def live(
  pane: Pane,
  steps: int,
  skip: int,
  every: int,
  lately: int,
  scene: Any,
  paint: Callable[[bool], None],
  **acting: Any,
) -> tuple[list[np.ndarray], list[float], float]:
  """(pictures, mean reward of the last `lately` decisions at each, mean reward of all that is
  shown) of one robot; `steps`, `skip` and `every` count decisions; `paint` is told before each
  picture whether the fault acts.
  """
  images, means, rewards = [], [], []
  repeat = pane.acting.get("repeat", 1)
  acted = pictures.act(pane.env, (skip + steps) * repeat, **pane.acting, **acting)
  for k, frame in enumerate(acted):
    rewards.append(frame.reward)
    if k >= skip and (k - skip) % every == 0:
      paint(frame.severity > 0)
      images.append(scene.picture(frame))
      means.append(float(np.mean(rewards[-lately:])))
  return images, means, float(np.mean(rewards[skip:]))


def page(
  panes: Sequence[Pane],
  images: Sequence[np.ndarray],
  shares: Sequence[float],
  time_s: float,
  in_percent: bool = True,
) -> np.ndarray:
  """One picture of the film, uint8 (height, width, 3); `shares` of the first robot's reward, or
  unless `in_percent` the rewards themselves.
  """
  font = ImageFont.load_default
  height, width = images[0].shape[:2]
  foot = TOP + height + 8
  image = Image.new("RGB", (len(panes) * (width + GAP) - GAP, TOP + height + FOOT), PAPER)
  draw = ImageDraw.Draw(image)
  fits = lambda text, size, room=width - 4: next(
    (f for f in (font(s) for s in range(size, 5, -1)) if draw.textlength(text, f) <= room), font(6)
  )
  for k, pane in enumerate(panes):
    x, room, colour = k * (width + GAP), width - 71, COLOURS[k % len(COLOURS)]
    draw.text((x + 2, 2), pane.title, fill=colour, font=fits(pane.title, 19))
    draw.text((x + 2, 26), pane.words, fill=INK, font=fits(pane.words, 14))
    image.paste(Image.fromarray(images[k]), (x, TOP))
    draw.rectangle((x, TOP, x + width - 1, TOP + height - 1), outline=colour, width=3)
    said = f"{100 * shares[k]:.0f} %" if in_percent else f"{shares[k]:.3g}"
    draw.text((x + 2, foot), said, fill=colour, font=font(22))
    if in_percent:
      draw.rectangle((x + 70, foot + 6, x + 70 + room, foot + 20), fill=TRACK)
      filled = round(room * min(1.0, max(0.0, shares[k])))
      draw.rectangle((x + 70, foot + 6, x + 70 + filled, foot + 20), fill=colour)
  clock, size = f"{time_s:.1f} s", font(13)
  right = image.width - 2 - draw.textlength(clock, size)
  draw.text((right, foot + 27), clock, fill=FAINT, font=size)
  text = f"reward {'of' if in_percent else 'a decision, mean of'} the last second"
  text += ", in % of the first robot's mean" * in_percent
  draw.text((2, foot + 27), text, fill=FAINT, font=fits(text, 13, right - 12))
  return np.asarray(image)


def film(
  panes: Sequence[Pane],
  out: os.PathLike | str,
  steps: int = 400,
  skip: int = 0,
  width: int = 256,
  height: int = 216,
  fps: float = 20.0,
  view: str = "auto",
  weak: str | None = None,
  say: Callable[[str], object] = lambda text: None,
  **acting: Any,
) -> dict[str, Any]:
  """Lets each pane's robot live and writes them side by side.

  Args:
    panes: 2 to MOST robots of equal pace; the first is what the others' reward is measured by.
    out: path that ends in .gif or .mp4.
    steps: control steps shown.
    skip: control steps before.
    width: of a pane [pixels].
    height: likewise.
    fps: pictures a second.
    view: one of pictures.VIEWS.
    weak: actuator or group of them, red where and while the fault acts.
    say: takes lines for standard error.
    **acting: of `pictures.act`, for all panes.

  Returns:
    file, frames, steps, fps, drawn_by, reward: a pane's mean of what is shown.

  Raises:
    UserError: another number of panes, or of another pace.
    FileError: a place that cannot be written.
  """
  pictures.check(out, skip + steps, width, height, fps)
  if not 2 <= len(panes) <= MOST:
    raise UserError(f"a film shows 2 to {MOST} robots side by side; got {len(panes)}")
  paces = [p.env.spec.control_s * p.acting.get("repeat", 1) for p in panes]
  if max(paces) - min(paces) > 1e-9:
    raise UserError(
      f"robots side by side decide at one pace; got {', '.join(f'{x:g} s' for x in paces)}"
    )
  every = max(1, round(1.0 / (fps * paces[0])))
  held = panes[0].acting.get("repeat", 1)
  shown, before = -(-steps // held), skip // held
  lives: list[tuple[list[np.ndarray], list[float], float]] = []
  with written(out) as write:
    for k, pane in enumerate(panes):
      tell = (lambda text: None) if k else say
      scene, drawn_by = pictures.painter(pane.env, width, height, view, tell)
      with contextlib.closing(scene):
        model, parts = getattr(scene, "model", None), bodies(pane.env, weak)
        paint = functools.partial(tint, model, parts) if model else lambda acts: None
        lately = max(1, round(1.0 / paces[0]))
        lives.append(live(pane, shown, before, every, lately, scene, paint, **acting))
    whole = lives[0][2]  # of a reward below 0 there are no shares
    pages = (
      page(
        panes,
        [images[i] for images, _, _ in lives],
        [means[i] / (whole if whole > 0 else 1.0) for _, means, _ in lives],
        i * every * paces[0],
        whole > 0,
      )
      for i in range(len(lives[0][0]))
    )
    write(pages, 1.0 / (every * paces[0]))
  return {
    "file": str(out),
    "frames": len(lives[0][0]),
    "steps": steps,
    "fps": round(1.0 / (every * paces[0]), 3),
    "drawn_by": drawn_by,
    "reward": [mean for _, _, mean in lives],
  }
