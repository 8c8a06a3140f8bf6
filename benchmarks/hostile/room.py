"""The files that cases begin from: a tiny agent of random weights, a finished run, recorded streams,
logs, suites, an own detector. Made once; each case works in a copy.
"""

from __future__ import annotations

import dataclasses
import os
import pathlib
import shutil
import subprocess
import sys

import numpy as np

CHECKOUT = pathlib.Path(__file__).resolve().parents[2]
SUITE = """name = "mini"
about = "one small part"
[run]
seeds = 1
steps = 192
onset = 128
arms = ["none"]
agent = "agent"
detector = "page_hinkley"
settings = {threshold = 2.0, warmup = 40}
adapt = {warmup = 64, start_windows = 32}
[entries.walker]
env = "walker"
fault = "gear"
severity = [0.5]
"""
STREAMS = """name = "mini"
arl0 = 100
count_from = 100
onset = [140, 160]
horizon_s = 5.0
seeds = {score = [0, 1], tune = [100, 101]}
nominal = {steps = 384, score = 1, tune = 1}
latents = {nominal = 1, after_s = 1.0}
[robots.walker]
score.gear = [0.5]
tune.push = [1.0]
"""
DETECTOR = """class Own:
  def __init__(self, threshold=3.0):
    self.threshold, self.score = threshold, 0.0

  def update(self, x):
    self.score = abs(x)
    return self.score > self.threshold
"""
ROBOT = """import jax
import jax.numpy as jnp

from mjx_cl.types import EnvState, Model, Spec, Step, Var


class Reach:  # a point that is pushed along a line towards a goal
  spec = Spec(
    name="reach",
    obs=(Var("x", "m"), Var("goal", "m")),
    act=(Var("push", "m", -1, 1),),
    control_s=0.1,
    episode_steps=20,
    acceptance=0.8,
    posture=None,
    targets=("push",),
  )
  model = Model({}, {})

  def init(self, model, key):
    obs = jax.random.uniform(key, (2,), minval=-1.0)
    return EnvState(obs, jnp.int32(0)), obs

  def step(self, model, state, action):
    obs = state.physics.at[0].add(0.3 * jnp.clip(action[0], -1, 1))
    reward, late = 1 - jnp.abs(obs[0] - obs[1]), state.step + 1 >= 20
    return EnvState(obs, state.step + 1), Step(obs, reward, jnp.bool_(False), late, obs)
"""
KILL = """name = "kill"
about = "two small parts"
[run]
seeds = 1
steps = 512
onset = 192
arms = ["oracle"]
agent = "point"
detector = "page_hinkley"
settings = {threshold = 2.0, warmup = 40}
adapt = {warmup = 64, start_windows = 32, ratio = 4.0, patience = 4, least = 64, refit = 64}
[entries.one]
env = "robot.py:Reach"
fault = "noise"
[entries.two]
env = "robot.py:Reach"
fault = "noise"
severity = [0.9]
"""
PAGE = "# Page\n\n<!-- report:arl0 -->\nold\n<!-- /report -->\n\nkept\n"
LINKS = {
  "loop": "loop",
  "dangling": "nowhere",
  "linked_run": "run",
  "linked_agent": "agent",
  "linked.csv": "log.csv",
}
RUN = ["run", "walker", "--agent", "agent", "--steps", "192", "--onset", "128", "--seeds", "1", "--arm", "none",
       "--detector", "page_hinkley", "--set", "threshold=2", "warmup=40", "--adapt.warmup", "64",
       "--adapt.start-windows", "32"]  # fmt: skip
STREAMS_OF = ["streams.toml", "--agent", "agent"]


def log(steps: int, shift: float) -> str:
  """A CSV log of three columns, the second of which shifts at the middle."""
  rng = np.random.default_rng(steps)
  values = rng.normal(size=(steps, 3))
  values[steps // 2 :, 1] += shift
  rows = (",".join(f"{x:.6f}" for x in (0.02 * t, *row)) for t, row in enumerate(values))
  return "\n".join(["time,a,b,c", *rows]) + "\n"


def environment(folder: pathlib.Path) -> dict[str, str]:
  """The environment of a command that runs in `folder`."""
  own = {"HOME": str(folder), "TMPDIR": str(folder / "tmp"), "PYTHONPATH": str(CHECKOUT)}
  return os.environ | own | {"COLUMNS": "200"}


def agent(folder: pathlib.Path, env: str, obs: int, act: int) -> None:
  """Writes a tiny agent of random weights."""
  import jax

  from mjx_cl.config import PRESETS
  from mjx_cl.dreamer.agent import Agent
  from mjx_cl.training import agents

  made = Agent(PRESETS["tiny"].dreamer, obs, act)
  about = {"env": env, "preset": "tiny", "repeat": 1}
  card = about | {"dreamer": dataclasses.asdict(made.config)}
  agents.save(folder, jax.jit(made.init)(jax.random.key(0)), card)


def command(words: list[str], folder: pathlib.Path) -> None:
  """Runs `mjx-cl WORDS` in a folder; RuntimeError where that fails."""
  done = subprocess.run([sys.executable, "-m", "mjx_cl", *words], cwd=folder, env=environment(folder),
                        capture_output=True, text=True)  # fmt: skip
  if done.returncode:
    raise RuntimeError(f"{' '.join(words[:2])}: {done.stderr.strip().splitlines()[-1]}")


def make(folder: pathlib.Path) -> None:
  """Makes the room unless it is there."""
  if (folder / "done").exists():
    return
  shutil.rmtree(folder, ignore_errors=True)
  (folder / "tmp").mkdir(parents=True)
  for name, about in (("agent", "'walker', 24, 6"), ("point", "'reach', 2, 1")):
    code = f"import pathlib; from benchmarks.hostile import room; room.agent(pathlib.Path({name!r}), {about})"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=folder, env=environment(folder))
  for name, text in (
    ("suite.toml", SUITE), ("streams.toml", STREAMS), ("own.py", DETECTOR), ("page.md", PAGE),
    ("robot.py", ROBOT), ("kill.toml", KILL),
    ("nominal.csv", log(800, 0.0)), ("log.csv", log(400, 2.0)), ("foreign/notes.txt", "mine\n"),
  ):  # fmt: skip
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_text(text)
  (folder / "empty").mkdir()
  command([*RUN, "--out", "run"], folder)
  command(["record", *STREAMS_OF, "--out", "set"], folder)
  command(["leaderboard", "set", "--export", "streams"], folder)
  command(["leaderboard", "set", "--detector", "z_score", "--out", "board"], folder)
  command(["bench", "suite.toml", "--out", "bench", "--jobs", "1"], folder)
  command(["detect", "log.csv", "--nominal", "nominal.csv", "--arl0", "200", "--detector", "z_score", "--out", "found"],
          folder)  # fmt: skip
  submission(folder)
  (folder / "results").mkdir()
  for name in ("arl0.json",):
    shutil.copy(CHECKOUT / "results" / name, folder / "results" / name)
  command(["report", "--results", "results", "--page", "page.md"], folder)
  for name, to in LINKS.items():
    (folder / name).symlink_to(to)
  shutil.rmtree(folder / "tmp")
  (folder / "tmp").mkdir()
  (folder / "done").touch()


def submission(folder: pathlib.Path) -> None:
  """Scores for all exported streams."""
  import pyarrow as pa
  import pyarrow.parquet

  (file,) = (folder / "streams").glob("*.parquet")
  held = pyarrow.parquet.read_table(file, columns=["stream", "step", "opr"])
  columns = {
    "stream": held["stream"],
    "step": held["step"],
    "score": held["opr"].cast(pa.float64()),
  }
  pyarrow.parquet.write_table(pa.table(columns), folder / "scores.parquet")


def copy(room: pathlib.Path, to: pathlib.Path) -> None:
  """A case's own copy of the room."""
  shutil.copytree(room, to, symlinks=True, dirs_exist_ok=True)
