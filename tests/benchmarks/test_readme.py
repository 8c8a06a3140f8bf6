"""What README and docs/extending.md show as Python runs as it stands there; the README's figures
are those of results/.
"""

import json
import os
import pathlib
import re
import statistics
import subprocess
import sys

import numpy as np
import pyarrow.parquet as parquet
import pytest

ROOT = pathlib.Path(__file__).parents[2]
README, OWN = ((ROOT / page).read_text() for page in ("README.md", "docs/extending.md"))
BLOCKS = re.findall(r"^```python\n(.*?)^```", README + OWN, re.S | re.M)


def run(code, cwd, **env):
  done = subprocess.run(
    [sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, env=os.environ | env
  )
  assert done.returncode == 0, done.stderr[-2000:]
  return done.stdout


@pytest.mark.parametrize("block", [b for b in BLOCKS if "Trainer" not in b])
def test_short_examples_run(block, tmp_path):
  run(block, tmp_path)


def test_the_first_screen_is_short_and_light():
  assert len(README.split()) <= 1200 and len(re.findall(r"\d[\d,.]*", README)) <= 120
  assert sum(p.stat().st_size for p in (ROOT / "docs").glob("*.gif")) <= 4.1e6
  assert (ROOT / "docs/film.gif").stat().st_size <= 2e6 and "](docs/film.gif)" in README


def test_results_are_light():
  """As committed; what a run of one's own left there does not count."""
  found = subprocess.run(
    ["git", "ls-files", "-z", "results"], cwd=ROOT, capture_output=True, text=True
  )
  if found.returncode:
    pytest.skip("no git checkout")
  sizes = {
    name: (ROOT / name).stat().st_size
    for name in found.stdout.split("\0")
    if name and (ROOT / name).exists()
  }
  assert sum(sizes.values()) <= 17e6 and max(sizes.values()) <= 6e6


def counts(folder, change=0):
  """Of the streams of a run: affected, noticed, median latency of those that were not learning,
  back with adaptation, without.
  """
  rows = [
    r
    for r in parquet.read_table(ROOT / "results" / folder / "runs.parquet").to_pylist()
    if (r["change"] or 0) == change
  ]
  own = [r for r in rows if r["arm"] == "detector"]
  back = {
    arm: sum(r["affected"] and r["recovery_step"] is not None for r in rows if r["arm"] == arm)
    for arm in ("detector", "none")
  }
  latency = statistics.median_low(
    np.inf if r["latency_steps"] is None else r["latency_steps"]
    for r in own
    if not r["adapting_at_onset"]
  )
  return (
    sum(r["affected"] for r in own),
    sum(r["latency_steps"] is not None for r in own),
    latency,
    back["detector"],
    back["none"],
  )


def test_the_table_is_that_of_results():
  rows = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in README.splitlines()
    if line.startswith("| ") and re.search(r"\d seeds", line)
  ]
  walker, car, socks, quadruped, trot = (
    [
      int(n)
      for cell in row[1:4]
      for n in re.findall(r"\d+", re.sub(r"\([^)]*\)", "", cell.replace(",000", "000")))
    ]
    for row in rows
  )
  lives = parquet.read_table(ROOT / "results/agents_innovations/methods_lives.parquet").to_pylist()
  own = [x for x in lives if x["method"] == "swift" and x["affected"]]
  still = [x for x in lives if x["method"] == "none" and x["affected"]]
  theirs = [
    r
    for path in (ROOT / "results/agents").glob("agent=*/runs.parquet")
    for r in parquet.read_table(path).to_pylist()
    if r["arm"] == "detector"
  ]
  paper = [r for r in theirs if r["affected"]]
  soon = lambda lived: sum(
    r["recovery_step"] is not None and r["recovery_step"] - r["onset"] <= 10_000 for r in lived
  )
  seeds = lambda lived: len({r["seed"] for r in lived})
  heard = sum(x["latency_steps"] is not None and x["latency_steps"] <= 500 for x in own)
  n = len(own)
  back = [soon(own), n, 10_000, soon(paper), len(paper)]
  assert walker == [heard, n, 500, *back, soon(still), n]
  many = f"{seeds(lives)} or {seeds(theirs)} seeds of each of {len({x['agent'] for x in own})}"
  assert rows[0][4] == f"{many} agents"
  n, noticed, latency, back, without = counts("paper/car")
  assert car == [noticed, 10, latency, back, n, without, n]
  n, noticed, latency, back, _ = counts("paper/car", 1)
  assert socks == [noticed, 10, latency, back, n]
  n, noticed, _, back, without = counts("paper/quadruped")
  assert quadruped == [noticed, 10, back, n, without, n]
  arms = json.loads((ROOT / "results/steady_loop/summary.json").read_text())["arms"]
  own, none = arms["swift"], arms["none"]
  assert own["false_alarm_streams"] == 0 and own["affected"] == own["seeds"]
  back, without = own["recovered_within_10000"], none["recovered_within_10000"]
  assert trot == [own["alarms"], 10, own["latency_median_steps"], back, 10, without, 10]


@pytest.mark.slow
def test_the_learner_learns_the_environment_of_the_example(tmp_path):
  """An untrained policy scores about 8 of 20; the example must end well above, and push towards the
  goal on either side of it.
  """
  (block,) = [b for b in BLOCKS if "Trainer" in b]
  block += """
for x in (-0.5, 0.5):
  act = lambda key: agent.act(params, agent.carry(), jnp.array([x, -x]), key)[1][0]
  print(float(jax.vmap(act)(jax.random.split(jax.random.key(1), 200)).mean()))
"""
  # as outside the tests: XLA's own pipeline, and programs that run longer than they compile
  out = run(block, tmp_path, XLA_FLAGS="").split("\n")
  assert float(re.search(r"return ([-0-9.]+) of 20", out[0])[1]) > 12
  left, right = map(float, out[1:3])
  assert left - right > 0.4, (left, right)


def test_the_detector_of_the_example(tmp_path):
  """The class as `--add` takes it: it knows the level after 500 samples, sees what rises above, and
  its setting works as `--threshold` needs.
  """
  from mjx_cl.detectors import python_class

  (block,) = [b for b in BLOCKS if "# mine.py" in b]
  (tmp_path / "mine.py").write_text(block)
  x = np.random.default_rng(0).uniform(0.5, 1.5, 2000)
  x[1500] = 10.0
  alarms = {}
  for level in (1.2, 2.0, 20.0):
    detector = python_class.load(f"{tmp_path / 'mine.py'}:Mine", {"level": level}).factory()
    alarms[level] = [t for t, sample in enumerate(x) if detector.update(sample)]
  assert (
    alarms[2.0] == [1500]
    and alarms[20.0] == []
    and len(alarms[1.2]) > 100
    and min(alarms[1.2]) >= 500
  )


def test_the_track_of_the_example(tmp_path, monkeypatch):
  """The class drives the file's track and no other; what is wrong with the file is one line, of the
  command as of the class.
  """
  from mjx_cl import envs
  from mjx_cl.cli import app
  from mjx_cl.errors import FileError

  monkeypatch.chdir(tmp_path)
  (block,) = [b for b in BLOCKS if "OnMine" in b]
  pathlib.Path("tracks.py").write_text(block)
  angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
  points = np.stack([8 * np.cos(angle), 5 * np.sin(angle), np.full(60, 1.1), np.full(60, 1.1)], 1)
  np.savetxt("my_track.csv", points, delimiter=", ")
  env = envs.make("tracks.py:OnMine")
  (track,) = env.course.tracks
  assert (
    env.spec.name == "car" and track.name == "my_track" and 38 < track.length < 42
  )  # Ramanujan's perimeter of the ellipse: 41.4 m
  np.savetxt("my_track.csv", points[:40], delimiter=", ")
  with pytest.raises(FileError, match="not closed"):
    envs.make("tracks.py:OnMine")
  assert app.main(["eval", "tracks.py:OnMine", "--agent", "car", "--episodes", "1"]) == 1
