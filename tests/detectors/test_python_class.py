"""Detectors in plain Python: river's as they are, one's own, and what a mistake in them prints."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl.detectors import python_class
from mjx_cl.errors import UserError
from mjx_cl.io import apart
from mjx_cl.rollout.monitor import unknown


class Above:
  """Fires above a level; the score is the running mean."""

  def __init__(self, level=3.0):
    self.level, self.seen, self.score = level, [], None

  def update(self, x):
    self.seen.append(x)
    self.score = sum(self.seen) / len(self.seen)
    return x > self.level


class Silent:
  def update(self, x):
    return None


class Number:
  def update(self, x):
    return 1


class Breaks:
  """Fails at its third sample, in two lines."""

  n = 0

  def update(self, x):
    self.n += 1
    if self.n == 3:
      raise ZeroDivisionError("first\nsecond")
    return False


class Shared:
  """What one stream saw is known to the next."""

  seen = []

  def update(self, x):
    self.seen.append(x)
    return len(self.seen) > 150


class Chance:
  def update(self, x):
    return bool(np.random.default_rng().random() < 0.5)


class NoUpdate:
  pass


def one_line(error):
  text = str(error.value)
  assert text and "\n" not in text
  return text


def streams(steps=200, n=3, seed=0):
  return np.random.default_rng(seed).normal(size=(steps, n))


def river_loop(x, **settings):
  """Steps at which river says that the stream has changed."""
  from river.drift import PageHinkley

  detector, steps = PageHinkley(**settings), []
  for t, v in enumerate(x):
    detector.update(v)
    if detector.drift_detected:
      steps.append(t)
  return steps


# ---- examples of the documentation ---------------------------------------------------------------


def test_example_river():
  """A river detector over recorded residuals."""
  from mjx_cl.detectors import python_class

  page_hinkley = python_class.load(
    "river.drift:PageHinkley", {"delta": 0.5, "threshold": 15.0, "mode": "up"}
  )
  xs = np.random.default_rng(0).normal(size=(1000, 2))
  xs[600:, 1] += 2.0  # the second robot changes
  fired, score = python_class.run_host(page_hinkley.factory, xs)
  assert not fired[:, 0].any() and 600 < np.flatnonzero(fired[:, 1])[0] < 620
  assert np.isnan(score).all()  # river's detectors have no score


def test_example_own_class(tmp_path):
  """A class of one's own in a file of one's own."""
  (tmp_path / "mine.py").write_text("""
class Runs:
  '''So many samples in a row above a level.'''
  def __init__(self, level=2.0, patience=3):
    self.level, self.patience, self.score = level, patience, 0

  def update(self, x):
    self.score = self.score + 1 if x > self.level else 0
    return self.score == self.patience
""")
  from mjx_cl.detectors import python_class

  runs = python_class.load(f"{tmp_path}/mine.py:Runs", {"patience": 2})
  xs = np.array([[0.0], [3.0], [3.0], [3.0], [np.nan], [0.0]])
  python_class.check_causal(runs.factory, xs)
  fired, score = python_class.run_host(runs.factory, xs)
  assert fired[:, 0].tolist() == [False, False, True, False, False, False]
  assert score[[0, 1, 2, 3, 5], 0].tolist() == [0, 1, 2, 3, 0] and np.isnan(score[4, 0])


# ---- runs ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
  "settings",
  [
    {},
    {"threshold": 5.0, "delta": 0.1, "mode": "up"},
    {"min_instances": 5, "threshold": 3.0, "mode": "down"},
  ],
)
def test_river_alarms_where_river_does(settings):
  from river.drift import PageHinkley

  xs = streams(600)
  xs[300:, 1] += 3.0
  xs[200:400, 2] -= 2.0
  fired, _ = python_class.run_host(lambda: PageHinkley(**settings), xs)
  assert fired.any()
  for s in range(3):
    assert np.flatnonzero(fired[:, s]).tolist() == river_loop(xs[:, s], **settings)


def test_samples_that_are_no_number_are_skipped():
  xs = streams(60, 2)
  xs[10:20, 0], xs[30, 1], xs[31, 1] = np.nan, np.inf, -np.inf
  fired, score = python_class.run_host(Above, xs)
  for s in range(2):
    good = np.isfinite(xs[:, s])
    assert not fired[~good, s].any() and np.isnan(score[~good, s]).all()
    cut = python_class.run_host(Above, xs[good, s : s + 1])
    np.testing.assert_array_equal(fired[good, s], cut[0][:, 0])
    np.testing.assert_array_equal(score[good, s], cut[1][:, 0])


def test_an_object_for_each_stream_and_its_score():
  xs = streams(50)
  fired, score = python_class.run_host(lambda: Above(1.0), xs)
  np.testing.assert_array_equal(fired, xs > 1.0)
  np.testing.assert_allclose(
    score, np.cumsum(xs, 0) / np.arange(1, 51)[:, None], rtol=1e-12, atol=1e-12
  )  # float64, another order of sums
  only = Above()
  with pytest.raises(UserError, match="same object twice"):
    python_class.run_host(lambda: only, xs)


def test_a_score_that_is_a_method_or_none_is_unknown():
  class Method(Above):
    score = lambda self: 1.0

    def __init__(self):
      pass

    def update(self, x):
      return False

  assert np.isnan(python_class.run_host(Method, streams(5))[1]).all()


@pytest.mark.parametrize(
  "cls, words",
  [
    (
      Breaks,
      ["Breaks", "step 3 of stream 1", "ZeroDivisionError: first second"],
    ),  # one sample of stream 1 is missing
    (Silent, ["Silent", "step 0", "drift_detected"]),
    (Number, ["Number", "step 0", "int"]),
    (NoUpdate, ["NoUpdate", "update"]),
  ],
)
def test_a_failing_class_is_one_line(cls, words):
  xs = streams(10, 2)
  xs[2:, 0], xs[1, 1] = np.nan, np.nan
  with pytest.raises(UserError) as error:
    python_class.run_host(cls, xs)
  assert all(word in one_line(error) for word in words), one_line(error)


def test_streams_have_two_axes():
  with pytest.raises(UserError, match="shape"):
    python_class.run_host(Above, np.zeros(5))


# ---- causality -----------------------------------------------------------------------------------


def test_causality_of_a_sound_class():
  from river.drift import ADWIN, PageHinkley

  xs = streams(300)
  xs[150:] += 2.0
  xs[40, 1] = np.nan
  for factory in (Above, PageHinkley, ADWIN):
    python_class.check_causal(factory, xs)


def test_causality_finds_shared_state_and_chance():
  Shared.seen.clear()
  with pytest.raises(UserError) as error:
    python_class.check_causal(Shared, streams(100, 2))
  assert "Shared is not causal: at step 0 of stream 0" in one_line(error)
  with pytest.raises(UserError, match="Chance is not causal"):
    python_class.check_causal(Chance, streams(100, 1))


def test_causality_finds_a_look_ahead():
  """An object that holds the whole record and answers by its maximum."""
  xs = np.array([[0.0], [1.0], [5.0], [2.0]])
  record = {"xs": xs[:, 0]}

  class Ahead:
    def __init__(self):
      self.t, self.all = -1, record["xs"]

    def update(self, x):
      self.t += 1
      return bool(x == self.all.max())

  honest = apart.run_host
  with pytest.MonkeyPatch.context() as patch:  # each run opens what it is run on

    def run(factory, part, host_name=None, at=None):
      record["xs"] = part[:, 0]
      return honest(factory, part, host_name)

    patch.setattr(apart, "run_host", run)
    with pytest.raises(UserError, match="at step 1 of stream 0.*ends after 2 samples"):
      python_class.check_causal(Ahead, xs, cuts=(2,))


# ---- loading -------------------------------------------------------------------------------------


def test_load_names_and_settings(tmp_path):
  (tmp_path / "a").mkdir()
  (tmp_path / "mine.py").write_text(
    "class D:\n  def __init__(self, k=1): self.score = k\n  def update(self, x): return False\n"
  )
  (tmp_path / "a" / "mine.py").write_text(
    "class D:\n  score = 7\n  def update(self, x): return True\n"
  )
  score = lambda h: python_class.run_host(h.factory, np.zeros((1, 1)))[1][0, 0]
  first, second = (
    python_class.load(f"{tmp_path}/mine.py:D", {"k": 3}, host_name="mine"),
    python_class.load(f"{tmp_path}/a/mine.py:D"),
  )
  assert (first.host_name, second.host_name, first.channel, first.log) == (
    "mine",
    "D",
    "opr",
    False,
  )
  assert (score(first), score(second)) == (3, 7)  # two files of one name
  assert python_class.load("river.drift:PageHinkley").host_name == "PageHinkley"


class Leaves:
  """Ends the program at its third sample."""

  n = 0

  def update(self, x):
    self.n += 1
    if self.n == 3:
      sys.exit(5)
    return False


def test_a_class_that_ends_the_program_is_one_line():
  with pytest.raises(UserError, match="Leaves failed at step 2 of stream 0: SystemExit: 5"):
    python_class.run_host(Leaves, streams(10, 1))


FILES = {
  "syntax.py": "class D(:\n",
  "raises.py": "raise RuntimeError('first\\nsecond')\n",
  "imports.py": "import no_such_module_here\n",
  "leaves.py": "import sys\nsys.exit()\n",
  "unbuilt.py": "class D:\n  def __init__(self): raise SystemExit(3)\n",
  "plain.py": (
    "class D:\n  pass\nclass Needs:\n  def __init__(self, k): pass\n  def update(self, x): "
    "return False\nx = 3\n"
  ),
}


@pytest.mark.parametrize(
  "source, settings, code, words",
  [
    ("PageHinkley", {}, 2, ["module:Name"]),
    (":X", {}, 2, ["module:Name"]),
    ("river.drift:", {}, 2, ["module:Name"]),
    ("no_such_module_here:X", {}, 2, ["no_such_module_here", "path/to/file.py"]),
    ("river.no_part:X", {}, 2, ["river.no_part"]),
    ("river.drift:Nothing", {}, 2, ["Nothing", "river.drift"]),
    ("river.drift:PageHinkley", {"thresh": 1}, 2, ["thresh", "cannot be built"]),
    ("{}/none.py:D", {}, 1, ["none.py"]),
    ("{}/syntax.py:D", {}, 1, ["SyntaxError"]),
    ("{}/raises.py:D", {}, 1, ["RuntimeError: first second"]),
    ("{}/leaves.py:D", {}, 1, ["importing", "SystemExit"]),
    ("leaves_mjx:D", {}, 1, ["importing leaves_mjx failed", "SystemExit"]),
    ("{}/unbuilt.py:D", {}, 2, ["D cannot be built", "SystemExit: 3"]),
    ("{}/imports.py:D", {}, 1, ["no_such_module_here"]),
    ("{}/plain.py:D", {}, 2, ["D has no method update"]),
    ("{}/plain.py:x", {}, 2, ["nothing of the name 'x'"]),
    ("{}/plain.py:Needs", {}, 2, ["Needs cannot be built", "'k'"]),
  ],
)
def test_what_cannot_be_loaded_is_one_line(tmp_path, monkeypatch, source, settings, code, words):
  for name, text in FILES.items():
    (tmp_path / name).write_text(text)
  (tmp_path / "leaves_mjx.py").write_text(FILES["leaves.py"])
  monkeypatch.syspath_prepend(tmp_path)
  with pytest.raises(UserError) as error:
    python_class.load(source.format(tmp_path), settings)
  assert all(word in one_line(error) for word in words), one_line(error)
  assert error.value.exit_code == code


def test_an_unknown_channel_is_refused():
  with pytest.raises(UserError, match="opr, rpr"):
    python_class.load("river.drift:PageHinkley", channel="oppr")


# ---- recorded residuals --------------------------------------------------------------------------


@pytest.mark.parametrize(
  "channel, log", [("opr", True), ("opr", False), ("reward", False), ("group_2", True)]
)
def test_watch_masks_as_other_detectors_do(channel, log):
  """Rows that are invalid are skipped, but the reward, which is known all the same."""
  rng = np.random.default_rng(0)
  shape = (40, 3)
  values = rng.uniform(0.5, 2.0, shape).astype(np.float32)
  valid = rng.random(shape) < 0.7
  residual = unknown(shape, 4)._replace(
    valid=jnp.asarray(valid),
    opr=jnp.asarray(values),
    reward=jnp.asarray(values),
    groups=jnp.broadcast_to(values[..., None], shape + (8,)),
  )
  residual = residual._replace(reward=residual.reward.at[5].set(jnp.nan))
  used = (
    np.where(np.arange(40)[:, None] == 5, False, True) & np.ones(shape, bool)
    if channel == "reward"
    else valid
  )
  want = np.where(used, np.log(values) if log else values, np.nan)
  one = python_class.HostDetector(Above, "Above", channel, log)
  np.testing.assert_allclose(
    python_class.samples(one, residual), want, rtol=1e-6, atol=1e-7
  )  # float32 logarithm
  fired, score = python_class.run_host(Above, python_class.samples(one, residual))
  assert fired.shape == shape and np.array_equal(np.isfinite(score), used)
  np.testing.assert_array_equal(
    fired,
    python_class.run_host(Above, python_class.samples(one, jax.tree.map(np.asarray, residual)))[0],
  )
