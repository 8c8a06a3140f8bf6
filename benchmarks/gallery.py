"""One still of each family of faults, docs/gallery.png: python benchmarks/gallery.py

A shipped agent drives a robot from one seed, whole and with the fault from the first step on; both
are drawn at the same step, the weak part red.
"""

from __future__ import annotations

import contextlib
import pathlib
import sys
from typing import NamedTuple

from mjx_cl.io import runtime

runtime.setup()

import numpy as np  # noqa: E402
from PIL import Image, ImageDraw, ImageFont  # noqa: E402

from mjx_cl import envs  # noqa: E402
from mjx_cl.cli import app  # noqa: E402
from mjx_cl.render import compare, pictures  # noqa: E402
from mjx_cl.training import agents  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parents[1]
WIDTH, HEIGHT, TOP, GAP, COLUMNS = 232, 200, 44, 10, 2  # pixels; families in a row


class Still(NamedTuple):
  """A family's picture.

  Attributes:
    words: what is broken.
    robot: environment.
    fault: arguments of `act`.
    step: control step that is drawn.
    weak: what is drawn red.
    becomes: environment that the broken robot is; "": the same.
    seed: of both.
  """

  words: str
  robot: str
  fault: dict
  step: int
  weak: str | None = None
  becomes: str = ""
  seed: int = 4


STILLS = {
  "actuator": Still(
    "gear: left knee at a tenth",
    "walker", {"fault": "gear", "target": "left_knee", "severity": 0.9}, 150, "left_knee",
  ),
  "body": Still(
    "payload: 21 kg on the trunk", "quadruped", {"fault": "payload", "severity": 1.0}, 150
  ),
  "contact": Still(
    "slope: 20 degrees", "quadruped", {"fault": "slope", "target": "left", "severity": 1.0}, 100
  ),
  "sensor": Still(
    "lidar_loss: all beams on the left", "car",
    {"fault": "lidar_loss", "target": "lidar_left", "severity": 1.0}, 30,
  ),
  "transfer": Still("gap: the harder simulator", "car", {}, 45, None, "car_real"),
  "task": Still(
    "command_range: doubled", "quadruped",
    {"fault": "command_range", "severity": 1.0}, 100,
  ),
}  # fmt: skip


def drawn(env, acting: dict, step: int, seed: int, weak: str | None) -> np.ndarray:
  """The robot at a control step, uint8 (HEIGHT, WIDTH, 3)."""
  scene, _ = pictures.painter(env, WIDTH, HEIGHT)
  with contextlib.closing(scene):
    if model := getattr(scene, "model", None):
      compare.tint(model, compare.bodies(env, weak), True)
    *_, frame = pictures.act(env, step, seed, **acting)
    return scene.picture(frame)


def pair(still: Still) -> tuple[np.ndarray, np.ndarray]:
  """The robot whole and broken."""
  env = envs.make(still.robot)
  broken = envs.make(still.becomes) if still.becomes else env
  both = []
  for robot, fault, weak in ((env, {}, None), (broken, still.fault, still.weak)):
    trained = agents.of(robot, "quadruped" if still.robot == "quadruped" else None)
    acting = {"agent": trained.agent, "params": trained.train.params, "repeat": trained.repeat}
    both.append(drawn(robot, acting | fault, still.step, still.seed, weak))
  return both[0], both[1]


def main() -> None:
  rows = -(-len(STILLS) // COLUMNS)
  wide, high = 2 * WIDTH + GAP, TOP + HEIGHT + GAP
  image = Image.new("RGB", (COLUMNS * (wide + 2 * GAP) - 2 * GAP, rows * high), compare.PAPER)
  draw = ImageDraw.Draw(image)
  for k, (family, still) in enumerate(STILLS.items()):
    x, y = k % COLUMNS * (wide + 2 * GAP), k // COLUMNS * high
    draw.text((x, y + 2), f"{family} ({still.robot})", compare.INK, ImageFont.load_default(17))
    draw.text((x, y + 22), "whole", compare.FAINT, ImageFont.load_default(14))
    draw.text(
      (x + WIDTH + GAP, y + 22), still.words, compare.COLOURS[2], ImageFont.load_default(14)
    )
    for side, picture in enumerate(pair(still)):
      image.paste(Image.fromarray(picture), (x + side * (WIDTH + GAP), y + TOP))
  out = ROOT / "docs/gallery.png"
  image.quantize(192).save(out, optimize=True)
  print(f"{out.relative_to(ROOT)}: {out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
  sys.exit(app.attempt(main))
