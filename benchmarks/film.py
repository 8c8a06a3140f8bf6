"""Moving pictures of robots healthy, broken and adapted, side by side, from committed agents.

  python benchmarks/film.py                       # of each robot in results/film, into docs
  python benchmarks/film.py walker --learn        # results/film/walker anew: minutes, then its film
  python benchmarks/film.py gaits                 # how the two quadrupeds walk

What the third robot has learnt lies in results/film: the weights that act alone, rounded to eight
bits of mantissa. With `--learn` robots break and adapt (`mjx-cl run`) and the first that learnt
something is kept; on another machine they live otherwise.
"""

from __future__ import annotations

import argparse
import pathlib
import subprocess
import sys
from typing import NamedTuple

ROOT = pathlib.Path(__file__).resolve().parents[1]
BITS = 8  # of a mantissa that are kept
ACTS = {"enc", "dyn", "pol"}  # what acting needs of an agent


class Film(NamedTuple):
  """A robot's film.

  Attributes:
    fault: arguments of `act`; what the second and third robot suffer from the first step on.
    becomes: environment that these two are; "": the same.
    words: of the fault, and of what was learnt.
    weak: what is drawn red.
    seed: of the robots that are shown.
    skip: control steps before the first picture.
    steps: control steps shown.
    learn: flags of the run that learns.
    file: below docs.
    look: arguments of `compare.film`.
  """

  fault: dict
  becomes: str
  words: tuple[str, str]
  weak: str | None
  seed: int
  skip: int
  steps: int
  learn: str
  file: str
  look: dict = {}


FILMS = {
  "walker": Film(
    {"fault": "gear", "target": "right_hip", "severity": 0.5},
    "",
    ("right hip at half strength", "same weak hip, after learning"),
    "right_hip",
    4,
    140,
    300,
    "--fault gear --target right_hip --severity 0.5 --onset 3000 --steps 16000 --arm detector --first-seed 4",
    "film.gif",
  ),
  "car": Film(
    {},
    "car_real",
    ("moved to a harder simulator", "same car, after learning"),
    None,
    14,
    40,
    220,
    "--fault car/sim-to-real --onset 2000 --steps 30000 --arm detector --first-seed 4",
    "film_car.gif",
    {"fps": 7, "width": 170, "height": 144},
  ),
}


def learn(robot: str, work: pathlib.Path) -> pathlib.Path:
  """Lets two robots break and adapt; the folder of what the first has learnt."""
  flags = f"{FILMS[robot].learn} --seeds 2 --keep"
  subprocess.run(
    [sys.executable, "-m", "mjx_cl", "run", robot, *flags.split(), "--out", str(work)], check=True
  )
  kept = sorted(work.glob("agents/*-*"))
  if not kept:
    raise SystemExit(f"film: no {robot} has learnt anything on this machine; try another seed")
  return kept[0]


def light(env, folder: pathlib.Path, out: pathlib.Path) -> None:
  """An agent with what acting needs, rounded; all else is zero."""
  import jax
  import numpy as np

  from mjx_cl.training import agents

  def rounded(x):
    x = np.asarray(x)
    if x.dtype != np.float32:
      return x
    step = np.uint32(1 << (23 - BITS))
    return ((x.view(np.uint32) + step // 2) & ~(step - np.uint32(1))).view(np.float32)

  trained = agents.of(env, str(folder))
  train = trained.train._replace(
    params={
      name: jax.tree.map(rounded if name in ACTS else np.zeros_like, part)
      for name, part in trained.train.params.items()
    },
    slow=jax.tree.map(np.zeros_like, trained.train.slow),
    opt=jax.tree.map(np.zeros_like, trained.train.opt),
  )
  agents.save(out, train, trained.card | {"rounded_bits": BITS, "holds": sorted(ACTS)})


def draw(robot: str, agent: pathlib.Path, out: pathlib.Path, **changes) -> dict:
  """Writes a robot's film."""
  from mjx_cl import envs
  from mjx_cl.render import compare
  from mjx_cl.training import agents

  film = FILMS[robot]
  env = envs.make(robot)
  broken = envs.make(film.becomes) if film.becomes else env
  own, learnt = agents.of(env, None), agents.of(broken, str(agent))
  acts = lambda trained: {
    "agent": trained.agent,
    "params": trained.train.params,
    "repeat": trained.repeat,
  }
  pane = compare.Pane
  panes = (
    pane("HEALTHY", "as trained", env, acts(own)),
    pane("BROKEN", film.words[0], broken, acts(own) | film.fault),
    pane("BROKEN, ADAPTED", film.words[1], broken, acts(learnt) | film.fault),
  )
  options = {"seed": film.seed, "weak": film.weak} | film.look | changes
  return compare.film(panes, out, film.steps, film.skip, **options)


def gaits(out: pathlib.Path) -> dict:
  """Writes how the two quadrupeds walk, told 0.9 m/s, on healthy legs."""
  from mjx_cl import envs
  from mjx_cl.render import compare
  from mjx_cl.training import agents

  env, panes = envs.make(f"{ROOT / 'benchmarks/steady.py'}:Steady"), []
  for name, words in (("quadruped", "shuffles"), ("quadruped-trot", "trots")):
    own = agents.of(env, name)
    acts = {"agent": own.agent, "params": own.train.params, "repeat": own.repeat}
    panes.append(compare.Pane(name, words, env, acts))
  return compare.film(panes, out, 300, 100, seed=4, fps=12.5, width=240, height=200)


def main() -> None:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
  )
  parser.add_argument("robots", nargs="*", metavar="ROBOT", help=f"of {', '.join(FILMS)}, gaits")
  parser.add_argument("--learn", action="store_true", help="first learn anew what is shown")
  parser.add_argument("--work", default="runs/film", help="folder of those runs")
  parser.add_argument("--seed", type=int, help="of the robots that are shown")
  args = parser.parse_args()
  if unknown := set(args.robots) - {*FILMS, "gaits"}:
    parser.error(f"no film of {', '.join(sorted(unknown))}; choose from: {', '.join(FILMS)}, gaits")
  from mjx_cl.io import runtime

  runtime.setup()
  from mjx_cl import envs

  if "gaits" in args.robots:
    print(gaits(ROOT / "docs/film_gaits.gif"))
    args.robots.remove("gaits")
    if not args.robots:
      return
  home = ROOT / "results/film"
  for robot in args.robots or [name for name in FILMS if (home / name).is_dir()]:
    agent = home / robot
    if not args.learn and not agent.is_dir():
      raise SystemExit(f"film: no {robot} has learnt yet what is shown; give --learn")
    if args.learn:
      env = envs.make(FILMS[robot].becomes or robot)
      light(env, learn(robot, pathlib.Path(args.work) / robot), agent)
    changes = {} if args.seed is None else {"seed": args.seed}
    said = draw(robot, agent, ROOT / "docs" / FILMS[robot].file, **changes)
    size = pathlib.Path(said["file"]).stat().st_size
    shares = ", ".join(f"{x / said['reward'][0]:.2f}" for x in said["reward"])
    print(f"{said['file']}: {said['frames']} pictures, {size / 1e6:.2f} MB, reward {shares}")


if __name__ == "__main__":
  main()
