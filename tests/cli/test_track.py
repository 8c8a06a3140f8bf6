"""`--track`: curves as TensorBoard and any reader of CSV find them."""

import csv
import sys

import numpy as np
import pyarrow.parquet as parquet

from benchmarks.hostile import room
from mjx_cl.cli import app, track
from mjx_cl.runs.runner import Progress


def scalars(folder):
  """name -> [(step, value)] as TensorBoard's own files hold them."""
  from tensorboardX.proto.event_pb2 import Event
  from tensorboardX.record_writer import masked_crc32c  # noqa: F401  the format's own checksum

  found = {}
  for path in sorted(folder.glob("events.*")):
    data, at = path.read_bytes(), 0
    while at < len(data):  # length 8, its checksum 4, event, its checksum 4
      size = int.from_bytes(data[at : at + 8], "little")
      event = Event.FromString(data[at + 12 : at + 12 + size])
      at += 16 + size
      for value in event.summary.value:
        found.setdefault(value.tag, []).append((event.step, value.simple_value))
  return found


def rows(path):
  with path.open(newline="") as file:
    return [(int(r["step"]), r["name"], float(r["value"])) for r in csv.DictReader(file)]


def test_both_hold_what_was_written_and_a_resumed_run_goes_on(tmp_path):
  for resume, step in ((False, 64), (True, 128)):
    with track.tracked(str(tmp_path), ("tensorboard", "csv"), resume) as write:
      write(step, {"none/3/reward": 0.5 + step, "x": np.nan})
  assert rows(tmp_path / "curves.csv") == [
    (64, "none/3/reward", 64.5),
    (128, "none/3/reward", 128.5),
  ]
  assert scalars(tmp_path / "tensorboard") == {"none/3/reward": [(64, 64.5), (128, 128.5)]}
  with track.tracked(str(tmp_path), ("csv",), False) as write:
    write(1, {"y": 2.0})
  assert rows(tmp_path / "curves.csv") == [(1, "y", 2.0)]


def test_nothing_is_written_unasked(tmp_path):
  seen = []
  with track.beside(seen.append, track.of_training, str(tmp_path / "new"), (), False) as show:
    show({"updates": 1, "y": 2.0})
  assert len(seen) == 1 and not (tmp_path / "new").exists()


def test_the_numbers_of_a_run():
  p = Progress(64, 128, 1.0, ["none", "oracle"], [3, 4], np.array([0, 1]), np.array([0.5, 0.75]),
               np.array([0, 2]), np.array([0, 9]))  # fmt: skip
  step, values = track.of_run(p)
  assert step == 64 and len(values) == 8 and values["oracle/4/reward"] == 0.75
  assert (values["none/3/adapting"], values["oracle/4/adapting"]) == (0.0, 1.0)
  assert track.of_run(p._replace(note="compiling")) == (64, {})
  assert (values["oracle/4/alarms"], values["oracle/4/updates"]) == (2.0, 9.0)


def test_a_training_s_curves_are_its_metrics(tmp_path, capsys):
  (tmp_path / "robot.py").write_text(room.ROBOT)
  out = tmp_path / "out"
  words = [
    "train",
    f"{tmp_path}/robot.py:Reach",
    "--preset",
    "tiny",
    "--set",
    "updates=32",
    "--out",
    str(out),
  ]
  assert app.main([*words, "--track", "csv", "tensorboard"]) == 0, capsys.readouterr().err
  table = parquet.read_table(out / "metrics.parquet").to_pylist()
  want = [(row["updates"], "records", float(row["records"])) for row in table]
  assert want and [row for row in rows(out / "curves.csv") if row[1] == "records"] == want
  assert [(s, v) for s, _, v in want] == scalars(out / "tensorboard")["records"]


def test_wrong_kinds_are_one_line_and_nothing_begins(tmp_path, capsys, monkeypatch):
  words = ["run", "walker", "--out", str(tmp_path / "out"), "--track"]
  assert app.main([*words, "tensorbord"]) == 2
  assert "tensorboard" in capsys.readouterr().err and not (tmp_path / "out").exists()
  monkeypatch.setitem(sys.modules, "tensorboardX", None)
  assert app.main([*words, "tensorboard"]) == 2
  assert "pip install tensorboardX" in capsys.readouterr().err
