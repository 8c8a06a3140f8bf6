"""What the README shows as Python runs as it stands there."""

import pathlib
import re
import subprocess
import sys

import numpy as np
import pytest

README = (pathlib.Path(__file__).parents[2] / "README.md").read_text()
BLOCKS = re.findall(r"^```python\n(.*?)^```", README, re.S | re.M)


def run(code, cwd):
  done = subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True)
  assert done.returncode == 0, done.stderr[-2000:]
  return done.stdout


@pytest.mark.parametrize("block", [b for b in BLOCKS if "Trainer" not in b])
def test_short_examples_run(block, tmp_path):
  run(block, tmp_path)


def test_the_learner_learns_the_environment_of_the_example(tmp_path):
  """An untrained policy scores about 8 of 20; the example must end well above, and push towards the
  goal.
  """
  (block,) = [b for b in BLOCKS if "Trainer" in b]
  out = run(block + "\nprint(float(action[0]))\n", tmp_path).split("\n")
  assert float(re.search(r"return ([-0-9.]+) of 20", out[0])[1]) > 14 and float(out[1]) > 0


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
