"""The README's moving picture: a walker healthy, broken and adapted, side by side.

  python benchmarks/film.py                                            # writes docs/film.gif
  python benchmarks/film.py --agent runs/film/agents/detector-4

Without `--agent` it first lets two walkers break and adapt (`mjx-cl run walker --keep`, minutes)
and takes what the first has learnt. On another machine they live otherwise, and so does the film.
All three robots have the same seed; they differ in their right hip and in what they have learnt.
"""

from __future__ import annotations

import argparse
import pathlib
import subprocess
import sys

SEED, JOINT, SEVERITY, STEP_S = 4, "right_hip", 0.5, 0.025
DRAWN, SHOWN = (330, 300), (37, 22, 293, 238)  # pixels, and the box of them that is shown
FIRST, EVERY = 140, 2  # control step of the first picture, steps from one picture to the next
LATELY = 40  # control steps whose mean reward is shown
PAPER, INK, GREY, BAR = (255, 255, 255), (32, 36, 44), (120, 126, 136), (228, 230, 234)
WEAK, FAR, PLAIN = (0.86, 0.16, 0.13, 1), (0.62, 0.64, 0.70, 1), (0.93, 0.94, 0.96, 1)
PANES = (
  ("HEALTHY", "as trained", (34, 120, 76)),
  ("BROKEN", "right hip at half strength", (200, 52, 44)),
  ("BROKEN, ADAPTED", "same weak hip, after learning", (36, 92, 176)),
)


def learn(out: pathlib.Path) -> pathlib.Path:
  """Lets two walkers break and adapt; the folder of what the first has learnt."""
  flags = f"--fault gear --target {JOINT} --severity {SEVERITY} --onset 3000 --steps 16000"
  flags += f" --first-seed {SEED} --seeds 2 --arm detector --keep --out {out}"
  subprocess.run([sys.executable, "-m", "mjx_cl", "run", "walker", *flags.split()], check=True)
  kept = out / "agents" / f"detector-{SEED}"
  if not kept.is_dir():
    raise SystemExit(f"film: walker {SEED} has learnt nothing on this machine; give --agent")
  return kept


def tint(model, weak: str) -> None:
  """Plain colours for the walker's parts, the leg on the side `weak` red, the left leg grey."""
  for geom in range(model.ngeom):
    name = model.body(model.geom_bodyid[geom]).name
    if model.geom_bodyid[geom] > 0:
      model.geom_matid[geom] = -1
      model.geom_rgba[geom] = WEAK if weak and weak in name else FAR if "left" in name else PLAIN


def live(agent: str | None, broken: bool, seed: int, steps: int) -> tuple[list, list[float]]:
  """Pictures from step FIRST on, and at each the mean reward of the last LATELY steps."""
  from mjx_cl import envs
  from mjx_cl.render import pictures as draw
  from mjx_cl.training import agents

  env = envs.make("walker")
  found = agents.of(env, agent)
  scene, _ = draw.painter(env, *DRAWN, view="robot")
  tint(scene.model, JOINT.partition("_")[0] if broken else "")
  fault = {"fault": "gear", "target": JOINT, "severity": SEVERITY} if broken else {}
  pictures, rewards, means = [], [], []
  acting = draw.act(env, FIRST + steps, seed, found.agent, found.train.params, **fault)
  for frame in acting:
    rewards.append(frame.reward)
    if frame.step >= FIRST and (frame.step - FIRST) % EVERY == 0:
      pictures.append(scene.picture(frame))
      means.append(sum(rewards[-LATELY:]) / LATELY)
  scene.close()
  return pictures, means


def page(pictures, means, time_s: float):
  """One picture of the film: a pane for each robot, its words above, its reward below."""
  from PIL import Image, ImageDraw, ImageFont

  font = ImageFont.load_default
  width, height = SHOWN[2] - SHOWN[0], SHOWN[3] - SHOWN[1]
  top, gap = 46, 8
  bar, foot = top + height + 8, top + height + 35
  image = Image.new("RGB", (3 * width + 2 * gap, foot + 19), PAPER)
  draw = ImageDraw.Draw(image)
  for k, (title, words, colour) in enumerate(PANES):
    x, room = k * (width + gap), width - 71
    draw.text((x + 2, 2), title, fill=colour, font=font(19))
    draw.text((x + 2, 26), words, fill=INK, font=font(14))
    image.paste(Image.fromarray(pictures[k]).crop(SHOWN), (x, top))
    draw.rectangle((x, top, x + width - 1, top + height - 1), outline=colour, width=3)
    draw.text((x + 2, bar), f"{100 * means[k]:.0f} %", fill=colour, font=font(22))
    draw.rectangle((x + 70, bar + 6, x + 70 + room, bar + 20), fill=BAR)
    draw.rectangle((x + 70, bar + 6, x + 70 + round(room * means[k]), bar + 20), fill=colour)
  text = "reward over the last second: 100 % is upright and at 1 m/s or more"
  draw.text((2, foot), text, fill=GREY, font=font(13))
  text = f"{time_s:.1f} s"
  draw.text((image.width - 2 - font(13).getlength(text), foot), text, fill=GREY, font=font(13))
  return image


def main() -> None:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
  )
  parser.add_argument("--agent", help="folder of a kept agent; default: a run of its own makes one")
  parser.add_argument("--work", default="runs/film", help="folder of that run")
  parser.add_argument("--out", default="docs/film.gif")
  parser.add_argument("--seed", type=int, default=SEED, help="of the robots that are shown")
  parser.add_argument("--steps", type=int, default=300, help="control steps shown, 0.025 s each")
  args = parser.parse_args()
  agent = args.agent or str(learn(pathlib.Path(args.work)))
  from mjx_cl.io import runtime

  runtime.setup()
  from PIL import Image

  robots = ((None, False), (None, True), (agent, True))
  lives = [live(*robot, args.seed, args.steps) for robot in robots]
  pages = [
    page([p[i] for p, _ in lives], [m[i] for _, m in lives], i * EVERY * STEP_S)
    for i in range(len(lives[0][0]))
  ]
  plain = {"dither": Image.Dither.NONE}
  palette = pages[len(pages) // 2].quantize(64, **plain)
  first, *others = (p.quantize(palette=palette, **plain) for p in pages)
  times = [round(1000 * EVERY * STEP_S)] * len(others) + [1200]
  first.save(args.out, save_all=True, append_images=others, duration=times, loop=0, disposal=1)
  size = pathlib.Path(args.out).stat().st_size
  print(f"{args.out}: {len(pages)} pictures, {size / 1e6:.2f} MB")


if __name__ == "__main__":
  main()
