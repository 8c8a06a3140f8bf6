"""The command calibrate: its threshold against a scan of the same robots, and what it refuses."""

import json
import math

import numpy as np
import pytest

from mjx_cl import detectors, envs
from mjx_cl.cli import app
from mjx_cl.rollout.scan import stream_keys
from mjx_cl.runs import calibrate
from mjx_cl.training import agents

SEEDS, STEPS, ARL0 = (100, 101), 1500, 100


@pytest.fixture
def mjx(capsys):
  def call(*argv):
    capsys.readouterr()
    return app.main(["calibrate", *map(str, argv)]), *capsys.readouterr()

  return call


def test_the_threshold_gives_the_wanted_rate(mjx):
  """A scan of the same healthy robots alarms as often as is said, and no threshold a little below
  gives so few; what the command says is what `run` takes.
  """
  argv = ("walker", "--detector", "cusum@opr", "--set", "slack=1", "--seeds", 2)
  argv += ("--steps", STEPS, "--arl0", ARL0, "--json")
  code, text, _ = mjx(*argv)
  found = json.loads(text)
  assert code == 0 and found["settings"] == {"slack": 1, "threshold": found["threshold"]}
  env = envs.make("walker")
  residual = calibrate.watched(env, agents.of(env), stream_keys(SEEDS, 1), STEPS)
  assert residual.opr.shape == (STEPS, 2)

  def alarms(threshold):
    one = detectors.make("cusum@opr", robot="walker", slack=1, threshold=threshold)
    return int(np.asarray(detectors.scan(one)(residual).fired)[calibrate.WARMUP :].sum())

  wanted = found["steps"] / ARL0
  assert found["steps"] == 2 * (STEPS - calibrate.WARMUP) and wanted == 10
  assert alarms(found["threshold"]) == found["alarms"] <= wanted
  assert found["arl0"] == pytest.approx(found["steps"] / found["alarms"])
  # the search ends where a lower one gives more, or one alarm more alone lies between
  assert max(alarms(found["threshold"] * x) for x in (0.98, 0.95, 0.9, 0.8)) > wanted - 2
  low, high = found["arl0_ci"]
  assert low < found["arl0"] < high and math.isfinite(high)


@pytest.mark.parametrize(
  "argv, code, words",
  [
    (("--seeds", 1, "--steps", 2000), 2, "5 are needed: more --seeds or --steps"),
    (("--set", "threshold=3"), 2, "threshold is what is looked for"),
    (("--detector", "cusom"), 2, "unknown detector 'cusom'"),
    (("--detector", "never"), 2, "detector 'never' has no threshold"),
    (("--detector", "cusum", "--set", "slack=-1"), 2, "slack must be at least 0"),
    (("--arl0", 0), 2, "--arl0 must be above 0"),
    (("--first-seed", -1), 2, "--first-seed must be 0 or above"),
  ],
)
def test_what_cannot_be_calibrated_is_one_line(mjx, argv, code, words):
  got, text, err = mjx("walker", *argv)
  assert (got, text) == (code, "") and words in err and err.count("\n") == 1, err
