"""Detection on CSV logs: what is read, thresholds against a loop, the past that counts, what is
written, and one line for bad input.
"""

import csv
import gzip
import inspect
import json
import os
import pathlib
import re
import sys

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl import detectors
from mjx_cl.cli import app
from mjx_cl.detectors import Alarm, Detector, scalar
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import folders
from mjx_cl.logs import detect, programs, results
from mjx_cl.logs.read import read


def save(path, sign=",", **columns):
  """Columns as CSV; nan is an empty cell."""
  cell = lambda x: x if isinstance(x, str) else "" if np.isnan(x) else f"{x:.9g}"
  lines = [sign.join(columns)] + [sign.join(map(cell, row)) for row in zip(*columns.values())]
  path.write_text("\n".join(lines) + "\n")
  return path


def noise(n, seed=0):
  return np.random.default_rng(seed).normal(size=n)


@pytest.fixture
def logs(tmp_path):
  """(log, nominal): 600 samples whose last 200 are shifted by three deviations, 1,500 nominal ones."""
  return save(tmp_path / "log.csv", x=noise(600, 1) + 3.0 * (np.arange(600) >= 400)), save(
    tmp_path / "nominal.csv", x=noise(1500, 2)
  )


def loop_cusum(x, warmup, threshold, slack=0.5):
  """Two-sided CUSUM with restarts in float64: rows that fire."""
  z = (x - x[:warmup].mean()) / x[:warmup].std()
  up = down = 0.0
  fired = []
  for t in range(warmup, len(x)):
    up, down = max(0.0, up + z[t] - slack), max(0.0, down - z[t] - slack)
    if max(up, down) > threshold:
      fired.append(t)
      up = down = 0.0
  return fired


def one_line(error):
  text = str(error.value)
  assert text and "\n" not in text
  return text


# ---- examples of the documentation ---------------------------------------------------------------


def example(name):
  """The Python block of docs/detection.md that begins with `# name`."""
  text = (pathlib.Path(__file__).parents[2] / "docs/detection.md").read_text()
  (block,) = [
    b
    for b in re.findall(r"^```python\n(.*?)^```", text, re.S | re.M)
    if b.startswith(f"# {name}\n")
  ]
  return block


def test_the_pair_of_the_example(tmp_path, monkeypatch):
  """As the board and a run take it: from its file, on both residuals, and in one trace whatever the
  threshold.
  """
  monkeypatch.chdir(tmp_path)
  pathlib.Path("level.py").write_text(example("level.py"))
  x = np.exp(np.where(np.arange(1500) == 1200, 4.0, 0.1 * noise(1500))).astype(np.float32)
  from mjx_cl.rollout.monitor import unknown

  rows = unknown((1500,), 1)._replace(
    opr=jnp.asarray(x), rpr=jnp.ones(1500), valid=jnp.ones(1500, bool)
  )
  det = detectors.make("level.py:level", threshold=2.0)
  fired = jax.lax.scan(det.update, det.init(), rows)[1].fired
  assert np.flatnonzero(fired).tolist() == [1200]
  traced = jax.jit(
    lambda limit: jax.lax.scan(
      (d := detectors.make("level.py:level", threshold=limit)).update, d.init(), rows
    )[1].fired.sum()
  )
  assert int(traced(2.0)) == 1 and int(traced(5.0)) == 0


# ---- files ---------------------------------------------------------------------------------------


def text_log(tmp_path, text):
  (tmp_path / "x.csv").write_bytes(text.encode("utf-8"))
  return detect.read(tmp_path / "x.csv")


@pytest.mark.parametrize(
  "text, columns",
  [
    ("a,b\n1,2\n3,4\n", {"a": [1, 3], "b": [2, 4]}),
    ("\ufeffa;b\r\n1;2.5\r\n\r\n3;-4e3\r\n", {"a": [1, 3], "b": [2.5, -4000]}),
    ("a\tb\n1\t2\n", {"a": [1], "b": [2]}),
    ('"a, b",c\n1,2\n', {"a, b": [1], "c": [2]}),
    ("a,b\n,2\nnan,NaN\n inf ,-inf\n1,1\n", {"a": [np.nan] * 3 + [1], "b": [2, np.nan, np.nan, 1]}),
    ("a\n1\n\n3\n\n", {"a": [1, np.nan, 3]}),
    ("a,word,b\n1,x,2\n", {"a": [1], "b": [2]}),
    ("a,Time,b\n1,0.5,2\n3,0.75,4\n", {"a": [1, 3], "b": [2, 4]}),
    ("a,b\n", {"a": [], "b": []}),
    ("a;b\n0,5;1\n-1,5e3;2,25\n", {"a": [0.5, -1500], "b": [1, 2.25]}),
    ("a\tb\n0,5\t1\n", {"a": [0.5], "b": [1]}),
    (
      "a;b;c\n0,5;1,0;1.5\n0,25;2;2.5\n",
      {"a": [0.5, 0.25], "b": [1, 2]},
    ),  # one decimal sign for the whole file, that of most
    ("a;b;c\n0.5;1,5;1.5\n", {"a": [0.5], "c": [1.5]}),
    ('a,b\n"0,5",1\n', {"b": [1]}),
    ("a;b\n1,234.5;0,5\n1,5;1,5\n", {"b": [0.5, 1.5]}),  # thousands are never guessed
    ("a,b\ns,Nm\n1,2\n", {"a": [1], "b": [2]}),
    ("a,b,c\nA,,[-]\n1,2,x\n", {"a": [1], "b": [2]}),
    ("a;b\nA;V\n0,5;1\n", {"a": [0.5], "b": [1]}),
    ("a,b\r1,2\r3,4\r", {"a": [1, 3], "b": [2, 4]}),
    ("\u200ba,b\n1,2\n", {"\u200ba": [1], "b": [2]}),
    (",a\n0,5\n1,6\n", {"index": [0, 1], "a": [5, 6]}),
    ('"";"a"\n"1";5\n"2";6\n', {"index": [1, 2], "a": [5, 6]}),  # as pandas and R write them
    ("mode,a\nwalk,\nwalk,1\n", {"a": [np.nan, 1]}),
  ],
)
def test_what_is_read(tmp_path, text, columns):
  log = text_log(tmp_path, text)
  assert list(log.columns) == list(columns)
  for name, values in columns.items():
    np.testing.assert_array_equal(log.columns[name], values)


def test_clock_and_words_are_no_columns(tmp_path):
  log = text_log(tmp_path, "step,a,mode,time\n4,1,walk,0\n6,2,3,0.5\n")
  assert (
    log.step.tolist() == [4, 6]
    and log.time.tolist() == [0, 0.5]
    and log.ignored == {"mode": (2, "walk")}
    and list(log.columns) == ["a"]
  )


@pytest.mark.parametrize(
  "text, words",
  [
    ("", ["header"]),
    ("1,2\n3,4\n", ["header", "put a line of names before it, e.g. x1,x2"]),
    ("1.5;2;3;4\n", ["header", "e.g. x1;x2;x3;..."]),
    ("0,5;0,6\n", ["header", "e.g. x1;x2"]),
    ("a\0,b\n1,2\n", ["no CSV", "UTF-8"]),
    ("a,a\n1,2\n", ["name of its own"]),
    ("a,\n1,2\n", ["name of its own"]),
    (",index\n1,2\n", ["name of its own"]),
    ("a,b\n1,2\n3\n", ["line 3", "1 cells under 2"]),
    ("a,time\n1,2\n1,2\n", ["time", "rise"]),
    ("a,time\nA,s\n1,2\n1,2\n", ["time", "rise"]),
    ("a,step\n1,2\n1,\n", ["step", "gap"]),
  ],
)
def test_a_broken_file_is_one_line(tmp_path, text, words):
  with pytest.raises(FileError) as error:
    text_log(tmp_path, text)
  assert all(word in one_line(error) for word in words + ["x.csv"])


def test_units_and_decimal_comma_are_said(tmp_path):
  units, comma = (
    text_log(tmp_path, text) for text in ("time,a,n\ns,A,\n0,1,2\n1,3,4\n", "a;b\n0,5;1\n")
  )
  assert units.time.tolist() == [0, 1]
  assert [note.partition(": ")[2] for note in units.notes] == [
    "line 2 holds no number and is taken for units: s, A"
  ]
  assert [note.partition(": ")[2] for note in comma.notes] == [
    "numbers are read with a decimal comma"
  ]
  assert text_log(tmp_path, "a;b\n0.5;1\n").notes == ()


@pytest.mark.parametrize(
  "head, time",
  [
    ("time_s", True),
    ("Time [s]", True),
    ("t (s)", True),
    ("seconds", True),
    ("timestamp_s", True),
    ("time\ns", True),
    ("t\nsec", True),
    ("t", True),
    ("timestamp", True),
    ("s", False),
    ("epoch", False),
    ("tms", False),
  ],
)
def test_what_is_time(tmp_path, head, time):
  name, *unit = head.split("\n")
  log = text_log(
    tmp_path, "\n".join([f"{name},x", *(f"{u},A" for u in unit), "5,1", "5.5,2", "6,1"]) + "\n"
  )
  assert (log.time is not None and log.time.tolist() == [5, 5.5, 6]) == time and log.step is None
  assert log.clocks == ("time",) * (head == "time\ns")


def test_seconds_that_do_not_rise_are_no_times(tmp_path):
  log = text_log(tmp_path, "t_s,time_s,a\n0,0,1\n1,0,2\n")
  assert log.time.tolist() == [0, 1] and log.notes == ()
  log = text_log(tmp_path, "time_s,a\n0,1\n0,2\n")
  assert log.time is None and [note.partition(": ")[2] for note in log.notes] == [
    "column time_s tells no times, as it does not rise at every row"
  ]


@pytest.mark.parametrize(
  "write",
  [
    lambda p, text: p.write_bytes(gzip.compress(text.encode())),
    lambda p, text: p.write_bytes(text.encode("utf-16")),
    lambda p, text: p.write_bytes(text.encode("latin-1")),
    lambda p, text: p.write_bytes(gzip.compress(text.encode("utf-16"))),
  ],
)
def test_how_a_file_is_written(tmp_path, write):
  path = tmp_path / "x.csv.gz"
  write(path, "α°,b\n1,2\n".replace("α", "µ"))
  log = detect.read(path)
  assert {name: x.tolist() for name, x in log.columns.items()} == {"µ°": [1], "b": [2]}
  assert [note.partition(": ")[2] for note in log.notes] == [
    "no UTF-8, so it is read as Latin-1"
  ] * (path.read_bytes()[:1] == b"\xb5")


@pytest.mark.parametrize(
  "content, words",
  [
    (gzip.compress(b"a,b\n1,2\n" * 99, mtime=0)[:-9], ["cannot read", "ended"]),
    ("a,b\n1,2\n".encode("utf-16-le"), ["no CSV", "UTF-8"]),
    (b"\xff\xfea", ["no CSV", "UTF-8"]),
    (b"PAR1\x15\x04\x15\xd0", ["no CSV"]),
  ],
)
def test_what_cannot_be_read_is_one_line(tmp_path, content, words):
  (tmp_path / "x.csv").write_bytes(content)
  with pytest.raises(FileError) as error:
    detect.read(tmp_path / "x.csv")
  assert all(word in one_line(error) for word in words + ["x.csv"])


# ---- columns that are not watched ----------------------------------------------------------------


def chosen(tmp_path, log, nominal, names=()):
  """(columns, notes) of two logs, t.csv and n.csv, without their folder."""
  log, nominal = save(tmp_path / "t.csv", **log), save(tmp_path / "n.csv", **nominal)
  found, notes = detect.choose_columns(detect.read(log), detect.read(nominal), names, log, nominal)
  return found, [note.replace(f"{tmp_path}/", "") for note in notes]


@pytest.mark.parametrize(
  "name",
  [
    "time_s",
    "time [s]",
    "t",
    "T_ms",
    "timestamp",
    "Stamp",
    "Time",
    "sample",
    "Index",
    "seconds",
    "epoch",
    "frame",
    "simTime",
    "header.stamp.sec",
    "step",
    "TIME",
  ],
)
def test_a_clock_is_known_by_its_name(tmp_path, name):
  """However uneven; in the log that is judged it may even stand still, unless it is `time` or
  `step`.
  """
  uneven = np.cumsum(np.random.default_rng(0).exponential(size=300)) + 1
  still = uneven[:200] if name.lower() in ("time", "step") else np.repeat(uneven[:100], 2)
  for x in (uneven[:200], still):
    found, notes = chosen(tmp_path, {name: x, "a": noise(200)}, {name: uneven, "a": noise(300)})
    assert found == ["a"] and notes == [
      f"column {name} is not watched: rising like a clock or counter"
    ]
  found, notes = chosen(tmp_path, {name: uneven[:200], "a": noise(200)}, {"a": noise(300)})
  assert found == ["a"] and notes == [
    f"column {name} is not watched: rising like a clock or counter"
  ]


def test_a_name_alone_makes_no_clock(tmp_path):
  uneven = np.cumsum(np.random.default_rng(0).exponential(size=300))
  signals = {
    "t": noise(300),
    "sample": noise(300, 1),
    "step_length": noise(300, 2),
    "torque": uneven,
  }
  assert chosen(tmp_path, signals, signals) == (list(signals), [])


def test_a_clock_is_known_by_its_even_steps(tmp_path):
  """Whatever its name: seconds with jitter and a gap, two digits of 1/30 s, a counter with missing
  rows; both logs must show it.
  """
  k = np.arange(300.0)
  jitter = np.random.default_rng(0).uniform(-0.2, 0.2, 300)
  clocks = {
    "ros": 1.7e5 + 0.01 * (k + jitter + 50 * (k > 100)),
    "zeit": np.floor(100 * k / 30) / 100,
    "n": np.where(k % 9 == 4, np.nan, k),
  }
  found, notes = chosen(tmp_path, clocks | {"a": noise(300)}, clocks | {"a": noise(300)})
  assert found == ["a"] and notes == [
    "columns ros, zeit, n are not watched: rising like a clock or counter"
  ]
  assert chosen(tmp_path, clocks | {"a": noise(300)}, clocks | {"a": noise(300)}, ("n", "a")) == (
    ["n", "a"],
    [],
  )  # named, it is watched
  one = chosen(tmp_path, {"n": noise(300), "a": noise(300)}, {"n": k, "a": noise(300)})
  assert (
    one
    == (["n", "a"], [])
    == chosen(tmp_path, {"n": k, "a": noise(300)}, {"n": noise(300), "a": noise(300)})
  )


def test_each_column_left_out_is_said(tmp_path):
  flat, words = np.full(300, 3.0), ["walk"] * 299 + ["run"]
  broken = [f"{x:.3g}" for x in noise(300)]
  broken[120:124] = ["oops"] * 4  # more than a hundredth
  same = {"a": noise(300), "mode": words}
  nan, few = np.full(300, np.nan), np.where(np.arange(300) < 99, noise(300), np.nan)
  found, notes = chosen(
    tmp_path,
    same
    | {
      "flat": flat,
      "stuck": flat + noise(300),
      "current": broken,
      "new": flat,
      "dead": nan,
      "few": flat,
    },
    same
    | {
      "flat": flat,
      "stuck": flat,
      "current": noise(300),
      "old": words,
      "dead": noise(300),
      "few": few,
    },
  )
  assert found == ["a"] and sorted(notes) == [
    "column current is not watched: line 122 of t.csv holds 'oops'",
    "column dead is not watched: no sample in t.csv",
    "column few is not watched: n.csv has 99 samples, at least 100 are needed",
    "column flat is not watched: constant in n.csv",
    "column mode is not watched: line 2 of n.csv holds 'walk'",
    "column new is not watched: missing in n.csv",
    "column old is not watched: missing in t.csv",
    "column stuck is not watched: constant in n.csv, but not in t.csv",
  ]


@pytest.mark.parametrize(
  "names, words",
  [
    (("flat",), ["n.csv", "flat is constant (3)"]),
    (("a", "flat"), ["flat is constant", "--column: a"]),
    (("current",), ["t.csv", "current", "'oops'", "line 4"]),
    (("time",), ["column time tells when", "choose from: a, current, flat, t"]),
    (("time_s",), ["no column 'time_s'"]),
  ],
)
def test_a_column_that_is_named_must_be_watched(tmp_path, names, words):
  k = np.arange(300)
  columns = {"a": noise(300), "flat": np.full(300, 3.0), "time": k, "t": k}
  with pytest.raises(UserError) as error:
    chosen(
      tmp_path,
      columns | {"current": ["1", "2", "oops"] * 100},
      columns | {"current": noise(300)},
      names,
    )
  assert all(word in one_line(error) for word in words) and ("no column" in one_line(error)) == (
    names == ("time_s",)
  )
  assert chosen(tmp_path, columns, columns, ("t",)) == (["t"], [])


def test_nothing_left_to_watch_is_one_line(tmp_path):
  k, flat = np.arange(300), np.full(300, 3.0)
  for log, nominal, words in [
    ({"t": k, "x": flat}, {"t": k, "x": flat}, ["n.csv", "x is constant"]),
    ({"t": k, "k": k}, {"t": k, "k": k}, ["clock or counter: t, k", "--column"]),
    ({"x": ["1,5"] * 300, "y": k}, {"x": k, "z": k}, ["'1,5'", "line 2"]),
  ]:
    with pytest.raises(FileError) as error:
      chosen(
        tmp_path,
        {n: [f'"{c}"' if isinstance(c, str) else c for c in x] for n, x in log.items()},
        nominal,
      )
    assert all(word in one_line(error) for word in words), one_line(error)


def test_notes_are_printed_and_written(tmp_path, mjx):
  k = np.arange(600)
  paths = [
    save(tmp_path / f"{name}.csv", time_s=0.02 * k, x=noise(600, seed), mode=["walk"] * 600)
    for seed, name in enumerate("tn")
  ]
  code, text, err = mjx(
    paths[0], "--nominal", paths[1], "--detector", "z_score", "--arl0", 100, "--json"
  )
  summary = json.loads(text)
  assert (
    code == 0
    and summary["columns"] == ["x"]
    and summary["rate_hz"] == pytest.approx(50)
    and summary["ignored"] == ["mode"]
  )
  assert len(summary["notes"]) == 2 and err.splitlines() == [
    f"note: {note}" for note in summary["notes"]
  ]


# ---- thresholds ----------------------------------------------------------------------------------


@pytest.mark.parametrize("arl0", [50, 200])
def test_calibration_against_a_loop(tmp_path, logs, arl0):
  """Nominal alarms are rows / ARL0 to the nearest count, at the threshold that is told, in a loop
  written anew.
  """
  result = detect.detect(*logs, detectors=("cusum",), arl0=arl0)
  (row,) = result.summary["detectors"]
  nominal, log = detect.read(logs[1]).columns["x"], detect.read(logs[0]).columns["x"]
  wanted = 1000 / arl0  # 1,500 samples, a third of them warm-up
  assert result.summary["warmup"] == 500 and result.summary["counted"] == 1000
  assert row["calibrated"] and abs(row["nominal_alarms"] - wanted) <= 0.5 and row["few"]
  # the log is judged with the nominal one as its past
  fired = loop_cusum(np.concatenate([nominal, log]), 500, row["threshold"])
  assert sum(t < 1500 for t in fired) == row["nominal_alarms"]
  assert [t - 1500 for t in fired if t >= 1500] == np.flatnonzero(result.fired["cusum"]).tolist()
  assert np.flatnonzero(result.before["cusum"]).tolist() == [t for t in fired if t < 1500]
  assert (
    row["first_alarm"] == fired[row["nominal_alarms"]] - 1500
    and row["alarms"] == len(fired) - row["nominal_alarms"]
  )
  assert row["first_alarm_s"] is None and result.summary["notes"] == []


def test_one_program_whatever_the_threshold(logs, monkeypatch):
  """Calibration and detection trace the detector once: thresholds, states and samples are
  arguments.
  """
  chex.clear_trace_counter()
  factory = detectors.DETECTORS["cusum"]

  @scalar
  def counted(threshold=8.0, warmup=1000):
    inner = factory(threshold=threshold, warmup=warmup)
    return Detector(inner.init, chex.assert_max_traces(inner.update, 1))

  calls = []

  @scalar
  def once(threshold=8.0, warmup=1000):
    calls.append(isinstance(threshold, jax.core.Tracer))
    return counted(threshold, warmup)

  monkeypatch.setitem(detectors.DETECTORS, "once", once)
  assert detect.detect(*logs, detectors=("once",), arl0=100).summary["detectors"][0]["alarms"] > 0
  assert calls.count(True) <= 2 and calls.count(False) == 1  # scan may look at its body twice


def test_too_short_for_the_arl0_is_said_and_marked(logs):
  result = detect.detect(
    *logs, detectors=("cusum", "z_score"), arl0=334
  )  # 2.99 alarms are expected
  nominal = detect.read(logs[1]).columns["x"]
  z = np.abs((nominal - nominal[:500].mean()) / nominal[:500].std())[500:]
  cusum, z_score = result.summary["detectors"]
  for row in (cusum, z_score):
    assert (
      row["calibrated"] is False
      and row["nominal_alarms"] == 0
      and row["few"]
      and row["first_alarm"] >= 0
    )
  # float32
  np.testing.assert_allclose(
    z_score["threshold"], z.max() + detect.MARGIN * (z.max() - np.median(z)), rtol=1e-4
  )
  (note,) = result.summary["notes"]
  assert "too short" in note and "334" in note and "1,002 are needed" in note and "\n" not in note
  assert detect.detect(*logs, detectors=("cusum",), arl0=333).summary["detectors"][0][
    "calibrated"
  ]  # 3.003


def test_a_detector_without_a_score_is_told_apart(logs, monkeypatch):
  @scalar
  def slow(threshold=1.0):
    return Detector(
      lambda: jnp.int32(0),
      lambda n, x: (n + 1, Alarm((n > 9000) & (x > threshold), jnp.where(n > 9000, x, jnp.nan))),
    )

  monkeypatch.setitem(detectors.DETECTORS, "slow", slow)
  result = detect.detect(*logs, detectors=("slow", "cusum"), arl0=100)
  row = result.summary["detectors"][0]
  assert row["threshold"] is None and row["calibrated"] is False and row["alarms"] == 0
  assert "slow" in result.summary["notes"][0] and "cusum" not in result.summary["notes"][0]


def test_scores_that_are_infinite_do_not_become_a_threshold(logs, monkeypatch):
  @scalar
  def spiky(threshold=1.0):
    score = lambda x: jnp.where(jnp.abs(x) > 3.0, jnp.inf, jnp.abs(x))
    return Detector(lambda: jnp.int32(0), lambda n, x: (n, Alarm(score(x) > threshold, score(x))))

  monkeypatch.setitem(detectors.DETECTORS, "spiky", spiky)
  (row,) = detect.detect(*logs, detectors=("spiky",), arl0=50).summary["detectors"]
  nominal = detect.read(logs[1]).columns["x"]
  z = np.abs((nominal - nominal.mean()) / nominal.std())[500:]
  assert row["threshold"] < 3.0 and row["nominal_alarms"] == (z > row["threshold"]).sum() == 20
  result = detect.detect(*logs, detectors=("spiky",), arl0=1e6)
  (row,) = result.summary["detectors"]
  assert (
    3.0 < row["threshold"] < 4.0
    and row["nominal_alarms"] == (z > 3.0).sum() > 0
    and "no alarm" not in result.summary["notes"][0]
  )


def test_a_threshold_that_must_be_a_number_is_one_line(logs, monkeypatch):
  @scalar
  def stubborn(threshold=1.0):
    if threshold <= 0:
      raise ValueError
    return Detector(lambda: jnp.int32(0), lambda n, x: (n, Alarm(x > threshold, x)))

  monkeypatch.setitem(detectors.DETECTORS, "stubborn", stubborn)
  with pytest.raises(UserError) as error:
    detect.detect(*logs, detectors=("stubborn",))
  assert "stubborn" in one_line(error) and "base.above" in one_line(error)


@pytest.mark.parametrize(
  "update, words",
  [
    (lambda n, x: (n, x), "AttributeError"),
    (lambda n, x: x > 1, "Type"),
    (lambda n, x: (n, Alarm(x > 1, None)), "failed"),
    (lambda n, x: 1 / 0, "ZeroDivisionError"),
    (lambda n, x: sys.exit(3), "SystemExit"),
  ],
)
def test_a_registered_detector_that_breaks_is_one_line(logs, monkeypatch, update, words):
  @scalar
  def foreign(threshold=1.0):
    return Detector(lambda: jnp.int32(0), update)

  monkeypatch.setitem(detectors.DETECTORS, "foreign", foreign)
  with pytest.raises(UserError) as error:
    detect.detect(*logs, detectors=("foreign",), arl0=100)
  assert "detector 'foreign' failed" in one_line(error) and words in one_line(error)


@pytest.mark.parametrize("registered", [True, False])
@pytest.mark.parametrize("raised", [MemoryError(), RuntimeError("std::bad_alloc")])
def test_too_little_memory_is_not_blamed_on_the_detector(
  tmp_path, logs, monkeypatch, raised, registered
):
  def update(*_):
    raise raised

  @scalar
  def foreign(threshold=1.0):
    return Detector(lambda: jnp.int32(0), update)

  monkeypatch.setitem(detectors.DETECTORS, "foreign", foreign)
  (tmp_path / "own.py").write_text(f"class Own:\n  def update(self, x):\n    raise {raised!r}\n")
  name = "foreign" if registered else f"{tmp_path / 'own.py'}:Own"
  with pytest.raises(type(raised) if registered else MemoryError):
    detect.detect(*logs, detectors=(name,), arl0=100)


# ---- samples -------------------------------------------------------------------------------------


def test_a_missing_sample_changes_nothing(tmp_path, logs):
  """Alarms are those of the log without its missing rows."""
  whole = [detect.read(p).columns["x"] for p in logs]
  holes = [np.insert(x, np.arange(7, len(x), 13), np.nan) for x in whole]
  paths = [save(tmp_path / f"holes_{k}.csv", x=x) for k, x in enumerate(holes)]
  program = programs.Program("cusum", 500, 1, 512)
  run = lambda xs, past: program(
    np.full(programs.LEVELS, 4.0),
    program(np.full(programs.LEVELS, 4.0), program.start, past[:, None])[0],
    xs[:, None],
  )[2:]
  fired, scores = run(*whole)
  fired_h, scores_h = run(*holes)
  kept = np.isfinite(holes[0])
  assert fired.any() and not fired_h[~kept].any() and np.isnan(scores_h[~kept]).all()
  np.testing.assert_array_equal(fired, fired_h[kept])
  np.testing.assert_array_equal(scores, scores_h[kept])
  summary = detect.detect(*paths, detectors=("cusum",), arl0=100).summary
  assert (
    summary["missing"] == len(holes[0]) - 600 and summary["nominal_missing"] == len(holes[1]) - 1500
  )


def test_parts_of_any_length_give_the_same():
  xs = np.stack([noise(700, 3), noise(700, 4)], 1)
  out = [programs.Program("cusum", 100, 2, chunk) for chunk in (64, 700)]
  levels = np.linspace(2.0, 4.5, programs.LEVELS)
  (_, any_a, fired_a, scores_a), (_, any_b, fired_b, scores_b) = (
    p(levels, p.start, xs) for p in out
  )
  assert any_a.any(0).all() and any_a.shape == (700, programs.LEVELS)
  np.testing.assert_array_equal(any_a, any_b)
  np.testing.assert_array_equal(fired_a, fired_b)
  np.testing.assert_allclose(scores_a, scores_b, rtol=1e-5, atol=1e-5)  # two programs, float32


def test_each_column_has_a_detector_and_any_counts(tmp_path):
  n, t = [noise(900, k) for k in range(2)], [noise(300, k) for k in (5, 6)]
  t[1][200:] += 5.0
  nominal, log = (
    save(tmp_path / "n.csv", a=n[0], b=n[1]),
    save(tmp_path / "t.csv", b=t[1], a=t[0], c=t[0]),
  )
  both = detect.detect(log, nominal, detectors=("cusum",), arl0=60)
  assert both.summary["columns"] == ["b", "a"] and both.fired["cusum"].shape == (300, 2)
  (row,) = both.summary["detectors"]
  assert abs(row["nominal_alarms"] - 10) <= 0.5  # of both columns together
  for k, (past, xs) in enumerate(((n[1], t[1]), (n[0], t[0]))):
    fired = loop_cusum(np.concatenate([past, xs]), 300, row["threshold"])
    assert [f - 900 for f in fired if f >= 900] == np.flatnonzero(
      both.fired["cusum"][:, k]
    ).tolist()
  assert "b" in row["columns"] and row["alarms"] == both.fired["cusum"].any(1).sum()
  assert detect.detect(log, nominal, ("b",), ("cusum",), 60).summary["columns"] == ["b"]


def test_units_do_not_matter(tmp_path, logs):
  """Bytes of a pressure in Pa around 10^9 are lost in float32; the log is standardised before."""
  scaled = [
    save(tmp_path / f"scaled_{p.name}", x=np.round(1e5 * detect.read(p).columns["x"]) + 1e8)
    for p in logs
  ]
  one, two = (detect.detect(*p, detectors=("cusum",), arl0=100) for p in (logs, scaled))
  np.testing.assert_array_equal(one.fired["cusum"], two.fired["cusum"])
  assert one.fired["cusum"].any()


def test_an_absurd_sample_does_not_end_the_watch(tmp_path, logs):
  x = detect.read(logs[0]).columns["x"]
  x[10] = 1e300
  result = detect.detect(
    save(tmp_path / "absurd.csv", x=x), logs[1], detectors=("cusum",), arl0=100
  )
  assert result.fired["cusum"][10] and result.fired["cusum"][400:].sum() > 10


def test_the_logarithm(tmp_path):
  n, t = np.exp(noise(600, 1)), np.exp(noise(200, 2))
  files = lambda f, name: (
    save(tmp_path / f"t{name}.csv", x=f(t)),
    save(tmp_path / f"n{name}.csv", x=f(n)),
  )
  one = detect.detect(*files(lambda x: x, "raw"), detectors=("z_score",), arl0=50, logarithm=True)
  two = detect.detect(*files(np.log, "ln"), detectors=("z_score",), arl0=50)
  np.testing.assert_array_equal(one.fired["z_score"], two.fired["z_score"])
  np.testing.assert_allclose(
    one.scores["z_score"], two.scores["z_score"], rtol=1e-4, atol=1e-4
  )  # nine digits in the files


def test_a_logarithm_of_what_is_not_positive_is_refused(tmp_path):
  for k, (low, other) in enumerate([(-0.25, 1.0), (1.0, 0.0)]):
    files = [
      save(tmp_path / f"{name}.csv", b=np.exp(noise(301)), a=np.r_[np.exp(noise(300)), x])
      for name, x in (("t", low), ("n", other))
    ]
    with pytest.raises(FileError) as error:
      detect.detect(*files, detectors=("z_score",), arl0=50, logarithm=True)
    assert all(
      word in one_line(error)
      for word in ("tn"[k] + ".csv", "column a", ("-0.25", "is 0;")[k], "--column", "--logarithm")
    )
  assert detect.detect(*files, ("b",), ("z_score",), 50, logarithm=True).summary["columns"] == ["b"]


def test_seconds_of_time_step_and_rate(tmp_path):
  n = save(tmp_path / "n.csv", x=noise(300))
  x = np.where(np.arange(200) == 150, 50.0, noise(200, 1) * 0.1)
  at = np.arange(200.0) + 100 * (np.arange(200) >= 100)  # a gap

  def first(rate=None, **clock):
    (row,) = (
      result := detect.detect(
        save(tmp_path / "t.csv", x=x, **clock), n, detectors=("z_score",), arl0=1e6, rate=rate
      )
    ).summary["detectors"]
    assert row["first_alarm"] == 150
    return row["first_alarm_s"], result.summary["rate_hz"]

  assert first() == (None, None) and first(rate=50) == (3.0, 50)
  assert first(step=at + 7) == (None, None) and first(rate=50, step=at + 7) == (5.0, 50)
  assert first(time=0.02 * at + 3) == pytest.approx((5.0, 50), rel=1e-6) and first(
    rate=50, time=0.02 * at + 3
  ) == (3.0, 50)


# ---- detectors -----------------------------------------------------------------------------------

TOGETHER = {"hotelling", "mewma", "max_variables"}


def test_the_table_is_every_detector_of_numbers():
  want = {k for k, f in detectors.DETECTORS.items() if getattr(f, "takes", "") == "scalar"}
  assert (
    want <= set(programs.table())
    and set(programs.table()) - want == {"rolling_sigma_plain"} | TOGETHER
  )


def test_columns_that_part_are_seen_by_those_that_watch_all(tmp_path):
  """Two columns that move together, then against each other, each as wide as before: Hotelling's
  and the MEWMA see it; the log lacks samples, and a line says `(all)`.
  """

  def pair(n, seed, since, shift=0.8):
    common, own = noise(n, seed), [0.1 * noise(n, seed + k) for k in (10, 20)]
    late = np.arange(n) >= since
    x, y = common + own[0], common + own[1]
    return np.round(x + shift * late, 6), np.round(y - shift * late, 6)

  (x, y), (u, v) = pair(3000, 0, 3000), pair(1500, 5, 700)
  text = [f"{a},{b}" for a, b in zip(u, v)]
  text[300] = f"{u[300]},"
  (tmp_path / "t.csv").write_text("x,y\n" + "\n".join(text) + "\n")
  nominal = save(tmp_path / "n.csv", x=x, y=y)
  result = detect.detect(tmp_path / "t.csv", nominal, detectors=(*TOGETHER, "cusum"), arl0=500)
  rows = {r["detector"]: r for r in result.summary["detectors"]}
  assert (
    set(rows) == TOGETHER | {"cusum"}
    and result.fired["hotelling"].shape == (1500, 1)
    and result.fired["cusum"].shape == (1500, 2)
  )
  assert np.isnan(result.scores["hotelling"][300, 0])
  for name in ("hotelling", "mewma"):
    first = np.flatnonzero(result.fired[name][700:])
    assert len(first) and first[0] < 60 and rows[name]["columns"] == ["(all)"], name
  results.write(result, tmp_path)
  assert "hotelling,(all)," in (tmp_path / "alarms.csv").read_text()
  # the very detector, on the residual of a run
  inner = programs.together(
    detectors.DETECTORS["hotelling"], rows["hotelling"]["threshold"], 1000, 2
  )
  middle, spread = np.mean(result.past, 0), np.std(result.past, 0)
  both = jnp.asarray(
    np.concatenate([(result.past - middle) / spread, ((result.xs - middle) / spread)[:300]]),
    jnp.float32,
  )
  want = jax.lax.scan(inner.update, inner.init(), both)[1]
  np.testing.assert_array_equal(np.asarray(want.fired)[3000:], result.fired["hotelling"][:300, 0])


def test_one_column_has_nothing_to_be_watched_together(tmp_path):
  nominal, log = save(tmp_path / "n.csv", x=noise(900)), save(tmp_path / "t.csv", x=noise(300, 1))
  with pytest.raises(
    UserError, match="'hotelling' watches all columns together: it needs two columns or more"
  ):
    detect.detect(log, nominal, detectors=("hotelling",))


def test_all_detectors_find_a_jump(tmp_path):
  """A jump of twelve deviations that lasts."""
  nominal, log = (
    save(tmp_path / "n.csv", x=noise(900)),
    save(tmp_path / "t.csv", x=noise(500, 1) + 12.0 * (np.arange(500) >= 200)),
  )
  result = detect.detect(log, nominal, detectors=("all",), arl0=150)
  rows = {r["detector"]: r for r in result.summary["detectors"]}
  assert list(rows) == [
    name for name in programs.table() if name not in TOGETHER
  ]  # there is one column
  for name, row in rows.items():
    if row["threshold"] is not None:
      assert result.fired[name][200:].any(), name
      assert row["nominal_alarms"] <= 12, (
        row
      )  # 4 are wanted; a score of few values may have no threshold that gives them
  assert sum(row["threshold"] is not None for row in rows.values()) >= len(rows) - 1


def test_rolling_sigma_with_a_traced_threshold():
  from mjx_cl.detectors import rolling_sigma

  xs = jnp.asarray(noise(400) + np.repeat([0, 3], 200), jnp.float32)
  run = lambda d: jax.lax.scan(d.update, d.init(), xs)[1]
  want, got = (
    run(rolling_sigma(window=100, warmup=100, threshold=2.0)),
    jax.jit(lambda t: run(programs.table()["rolling_sigma_plain"](t, 100)))(2.0),
  )
  assert want.fired.sum() > 3
  np.testing.assert_array_equal(want.fired, got.fired)
  np.testing.assert_allclose(want.score, got.score, rtol=1e-5)  # fused another way


def test_a_python_class_watches_beside_them(tmp_path, logs):
  (tmp_path / "mine.py").write_text(
    "class Above:\n  def __init__(self, level): self.level = level\n  def update(self, x):\n   "
    " self.score = x\n"
    "    return x > self.level\n"
  )
  name = f"{tmp_path}/mine.py:Above"
  result = detect.detect(*logs, detectors=("cusum", name), arl0=100, settings={"level": 2.5})
  row = result.summary["detectors"][1]
  log, nominal = (detect.read(p).columns["x"] for p in logs)
  np.testing.assert_array_equal(result.fired[name][:, 0], log > 2.5)
  assert (
    row["threshold"] is None
    and row["calibrated"] is None
    and row["nominal_alarms"] == (nominal[500:] > 2.5).sum() > 0
  )
  assert result.summary["notes"] == []
  with pytest.raises(UserError, match="cannot be built"):
    detect.detect(*logs, detectors=(name,))
  with pytest.raises(UserError, match="host detectors"):
    detect.detect(*logs, detectors=("cusum",), settings={"level": 2.5})


# ---- command line --------------------------------------------------------------------------------


@pytest.fixture
def mjx(capsys):
  """mjx(*argv): (exit code, standard output, standard error) of `mjx-cl detect`."""

  def call(*argv):
    capsys.readouterr()
    return app.main(["detect", *map(str, argv)]), *capsys.readouterr()

  return call


def test_files_and_json(mjx, logs, tmp_path):
  out = tmp_path / "a" / "out"
  argv = (
    logs[0],
    "--nominal",
    logs[1],
    "--detector",
    "cusum",
    "z_score",
    "--arl0",
    100,
    "--rate",
    20,
    "--out",
    out,
  )
  code, text, err = mjx(*argv, "--json")
  assert (code, err) == (0, "") and text.count("\n") == 1
  summary = json.loads(text)
  assert json.loads((out / "detect.json").read_text()) == summary and sorted(
    os.listdir(out)
  ) == sorted(results.FILES)
  with open(out / "alarms.csv", newline="") as f:
    alarms = list(csv.DictReader(f))
  for row in summary["detectors"]:
    mine = [a for a in alarms if a["detector"] == row["detector"]]
    assert len(mine) == row["alarms"] > 0 and mine[0] == {
      **mine[0],
      "column": "x",
      "sample": str(row["first_alarm"]),
    }
    assert (
      float(mine[0]["seconds"]) == row["first_alarm_s"] == row["first_alarm"] / 20
      and float(mine[0]["score"]) > row["threshold"]
    )
  image = (out / "detect.png").read_bytes()
  assert image[:8] == b"\x89PNG\r\n\x1a\n" and len(image) > 10_000
  before = {p: p.read_bytes() for p in out.iterdir()}
  code, text, err = mjx(*argv)
  assert (
    (code, text) == (2, "")
    and err.count("\n") == 1
    and "--overwrite" in err
    and {p: p.read_bytes() for p in out.iterdir()} == before
  )
  code, text, err = mjx(*argv, "--overwrite", "--arl0", 2000)  # the last of two flags counts
  assert (
    code == 0
    and "cusum" in text
    and "not calibrated" in text
    and err.count("\n") == 1
    and "too short" in err
  )


def test_a_name_with_a_comma_is_one_cell(tmp_path, mjx):
  for name, n in (("n", 300), ("t", 50)):
    (tmp_path / f"{name}.csv").write_text(
      '"torque, ""left"""\n' + "\n".join(str(x) for x in noise(n) + 9 * (name == "t")) + "\n"
    )
  assert (
    mjx(
      tmp_path / "t.csv",
      "--nominal",
      tmp_path / "n.csv",
      "--detector",
      "z_score",
      "--out",
      tmp_path / "out",
    )[0]
    == 0
  )
  with open(tmp_path / "out" / "alarms.csv", newline="") as f:
    assert {row["column"] for row in csv.DictReader(f)} == {'torque, "left"'}


@pytest.mark.parametrize("width", [80, 400])
def test_the_table_cuts_nothing(tmp_path, mjx, monkeypatch, width):
  monkeypatch.setenv("COLUMNS", str(width))
  names = ["left_hip_motor_current_filtered", "left_knee_joint_position_error"]
  paths = [
    save(tmp_path / f"{k}.csv", **{name: noise(600, k) + 9 * (k == 1) for name in names})
    for k in range(2)
  ]
  code, text, _ = mjx(
    paths[1], "--nominal", paths[0], "--detector", "cusum", "rolling_sigma_plain", "--arl0", 50
  )
  assert (
    code == 0 and "…" not in text and all(name in text for name in [*names, "rolling_sigma_plain"])
  )
  assert max(map(len, (line for line in text.splitlines() if line[:1] in "│┃"))) <= width


@pytest.mark.parametrize(
  "change, code, words",
  [
    (dict(log="none.csv"), 1, ["none.csv", "No such file"]),
    (dict(nominal="none.csv"), 1, ["none.csv"]),
    (dict(log="."), 1, ["directory"]),
    (dict(nominal="/dev/zero"), 1, ["/dev/zero is a device"]),
    (dict(log="words.csv"), 1, ["words.csv", "no column of numbers", "line 2 holds 'a'"]),
    (dict(nominal="short.csv"), 1, ["short.csv", "too short", "99", "100"]),
    (dict(nominal="flat.csv"), 1, ["flat.csv", "x is constant"]),
    (dict(log="other.csv"), 1, ["share no column", "y against x"]),
    (dict(log="empty.csv"), 1, ["empty.csv", "no sample"]),
    (dict(log="bytes.csv"), 1, ["bytes.csv", "no CSV"]),
    (dict(more=["--column", "z"]), 2, ["no column 'z'", "x"]),
    (dict(log="half.csv", nominal="half.csv", more=["--column", "mode"]), 1, ["mode", "'walk'"]),
    (dict(more=["--detector", "cusumm"]), 2, ["cusumm", "cusum"]),
    (dict(more=["--detector", "hotelling"]), 2, ["hotelling"]),
    (dict(more=["--detector", "no_such_module_here:X"]), 2, ["no_such_module_here"]),
    (dict(more=["--arl0", "1"]), 2, ["arl0"]),
    (dict(more=["--arl0", "nan"]), 2, ["arl0"]),
    (dict(more=["--arl0", "inf"]), 2, ["arl0", "finite", "above 1"]),
    (dict(more=["--rate", "0"]), 2, ["rate"]),
    (dict(more=["--out", "log.csv"]), 2, ["is a file"]),
    (dict(more=["--set", "a=1"]), 2, ["host"]),
  ],
)
def test_bad_input_is_one_line(tmp_path, logs, mjx, monkeypatch, change, code, words):
  monkeypatch.chdir(tmp_path)
  save(tmp_path / "words.csv", x=["a", "b"])
  save(tmp_path / "short.csv", x=noise(99))
  save(tmp_path / "flat.csv", x=np.full(500, 3.0))
  save(tmp_path / "other.csv", y=noise(500))
  save(tmp_path / "empty.csv", x=np.full(5, np.nan), y=noise(5))
  save(tmp_path / "half.csv", x=noise(500), mode=["walk"] * 500)
  (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00\x01" * 50)
  before = sorted(os.listdir(tmp_path))
  got, out, err = mjx(
    change.get("log", "log.csv"),
    "--nominal",
    change.get("nominal", "nominal.csv"),
    *change.get("more", []),
  )
  assert (
    (got, out) == (code, "")
    and err.startswith("mjx-cl: ")
    and err.count("\n") == 1
    and all(word in err for word in words)
  ), err
  assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.parametrize("name", ["alarms.csv", "detect.png", "detect.json", None])
def test_a_full_disk_leaves_the_earlier_detection(tmp_path, logs, monkeypatch, name):
  """The disk is full at one of the files, which is written after others, or as all are renamed."""
  results.write(detect.detect(*logs, detectors=("cusum",), arl0=100), tmp_path)
  before = {name: (tmp_path / name).read_bytes() for name in results.FILES}
  other, atomic = detect.detect(*logs, detectors=("page_hinkley",), arl0=100), folders.atomic

  def full(*_, **__):
    raise OSError(28, "No space left on device")

  if name:
    fills = lambda path, write: atomic(path, full if path.name == name else write)
    monkeypatch.setattr(folders, "atomic", fills)
  else:
    monkeypatch.setattr(os, "replace", full)
  with pytest.raises(FileError) as error:
    results.write(other, tmp_path)
  assert "No space left" in one_line(error) and "unchanged" in one_line(error)
  assert {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.name in before} == before
  assert not [name for name in os.listdir(tmp_path) if name.endswith(".tmp")]
  monkeypatch.undo()
  results.write(other, tmp_path)
  assert (tmp_path / "alarms.csv").read_bytes() != before["alarms.csv"]


def test_a_spike_survives_the_drawing():
  x = np.zeros(100_000)
  x[70_001], x[50_000:50_200] = 9.0, np.nan
  at, drawn = results._envelope(x, 5)
  assert (
    len(at) == len(drawn) <= 4100
    and np.nanmax(drawn) == 9.0
    and abs(at[np.nanargmax(drawn)] - 70_006) < 50
    and np.isnan(drawn).any()
  )


def test_the_axis_of_a_figure_shows_a_gap(tmp_path):
  at = np.arange(200.0) + 100 * (np.arange(200) >= 100)
  files = [save(tmp_path / "t.csv", x=noise(200, 1), time=0.02 * at + 3)]
  files += [save(tmp_path / "n.csv", x=noise(300), time=0.02 * np.arange(300.0))]
  found = detect.detect(*files, detectors=("z_score",), arl0=50)
  on_axis = results._time(found, np.array([-10, 0, 99, 100, 199, 200]))
  np.testing.assert_allclose(on_axis, [-0.2, 0.0, 1.98, 4.0, 5.98, 6.0], atol=1e-6)


@pytest.mark.parametrize("given", [{"inject": 2.0}, {"refractory": 1.0}, {"model": "none"}])
def test_what_the_charts_alone_take_is_refused_beside_a_detector(tmp_path, given):
  files = [save(tmp_path / f"{name}.csv", x=noise(300)) for name in "tn"]
  with pytest.raises(UserError, match=f"--{next(iter(given))}: of the charts"):
    detect.detect(*files, detectors=("z_score",), arl0=50, **given)


def test_defaults_of_the_command_are_those_of_the_function():
  parameters = inspect.signature(detect.detect).parameters
  fields = app.Detect.__dataclass_fields__
  assert {n: parameters[n].default for n in ("arl0", "rate", "logarithm")} == {
    n: fields[n].default for n in ("arl0", "rate", "logarithm")
  }


@pytest.mark.parametrize("cell", ["12_34", "1_000.5", "1٢"])
def test_an_identifier_is_no_number(tmp_path, cell):
  """Python's own float takes 12_34 for 1234 and the digits of other scripts."""
  path = tmp_path / "log.csv"
  path.write_text(f"a,b\n1.5,{cell}\n2.5,{cell}\n")
  found = read(path)
  assert list(found.columns) == ["a"] and found.ignored == {"b": (2, cell)}
