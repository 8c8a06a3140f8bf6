"""Many streams through a detector: the shares of the cores are the streams one by one."""

import pathlib
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl import detectors
from mjx_cl.errors import UserError


def alone(detector, xs, stream):
  return jax.jit(lambda xs: jax.lax.scan(detector.update, detector.init(), xs)[1])(
    jax.tree.map(lambda x: x[:, stream], xs)
  )


@pytest.mark.parametrize("streams,cores", [(1, None), (7, 1), (7, 2), (7, 3), (7, 20), (6, 4)])
def test_every_stream_is_as_by_itself(streams, cores):
  detector = detectors.cusum(warmup=20, threshold=2.0)
  xs = (
    jax.random.normal(jax.random.key(streams), (120, streams)) + jnp.arange(streams) * 0.1
  )  # no two alike: a wrong order shows
  out = detectors.scan(detector, cores)(xs)
  assert out.fired.shape == out.score.shape == (120, streams) and out.fired.any()
  for k in range(streams):
    want = alone(detector, xs, k)
    np.testing.assert_array_equal(out.fired[:, k], want.fired)
    np.testing.assert_allclose(
      out.score[:, k], want.score, rtol=2e-6, atol=2e-6
    )  # a program of another width: last digits


def test_other_shapes_and_samples_of_many_numbers():
  mean = detectors.Detector(
    lambda: jnp.zeros(3),
    lambda s, x: (s + x["a"], detectors.Alarm(jnp.sum(s + x["a"]) > 4, x["b"])),
  )
  call = detectors.scan(mean, 2)
  for steps, streams in ((5, 4), (9, 3)):
    xs = {
      "a": np.ones((steps, streams, 3), np.float32),
      "b": np.arange(steps * streams, dtype=np.float32).reshape(steps, streams),
    }
    out = call(xs)
    np.testing.assert_array_equal(out.score, xs["b"])
    np.testing.assert_array_equal(
      out.fired, np.broadcast_to((3 * np.arange(1, steps + 1) > 4)[:, None], (steps, streams))
    )


@pytest.mark.parametrize(
  "xs",
  [np.zeros(5), np.zeros((5, 0)), np.zeros((0, 5)), {"a": np.zeros((5, 2)), "b": np.zeros((5, 3))}],
)
def test_what_is_no_set_of_streams_is_refused(xs):
  detector = detectors.Detector(
    lambda: jnp.float32(0), lambda s, x: (s, detectors.Alarm(jnp.bool_(False), s))
  )
  with pytest.raises(UserError, match="time first"):
    detectors.scan(detector)(xs)


def test_no_core_is_refused():
  with pytest.raises(UserError, match="one core"):
    detectors.scan(detectors.cusum(), 0)


def test_the_example_of_the_docs_finds_the_rise():
  text = (pathlib.Path(__file__).parents[2] / "docs/detection.md").read_text()
  code = re.search(r"```python\n(# many\.py.*?)```", text, re.DOTALL).group(1)
  out = subprocess.run(
    [sys.executable, "-c", code], capture_output=True, text=True, check=True
  ).stdout
  alarms, found, delay = (
    int(x)
    for x in re.fullmatch(
      r"false alarms (\d+), found (\d+) of 100, median delay (\d+) samples\n", out
    ).groups()
  )
  # slack 0.5: a rise of one deviation gains 0.5 a sample, so some 20 samples to 10; without it a
  # run to 10 has odds of about e^-10 a sample, and 300,000 samples
  # are watched behind the warm-up
  assert found == 100 and 14 <= delay <= 26 and alarms < 150
