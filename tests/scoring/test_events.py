"""Events: what an earlier version said in sentences is read into the columns of today."""

import pathlib

import pytest

from mjx_cl.errors import FileError
from mjx_cl.io import tables
from mjx_cl.scoring import events

RESULTS = pathlib.Path(__file__).parents[2] / "results"
OLD = [
  (999, "onset", "severity 0.5"),
  (1100, "alarm", "acted on"),
  (1151, "start", "alarm at step 1100"),
  (1200, "alarm", "logged, not acted on: phase adapting, before onset: a false alarm"),
  (3071, "abort", "settled below acceptance"),
  (3071, "rollback", "the weights of before earned 0.1 a step, those of now 0.05"),
  (4000, "repair", "after 3001 steps"),
]


def test_sentences_are_typed_on_reading(tmp_path):
  columns = {k: [row[i] for row in OLD] for i, k in enumerate(("step", "kind", "reason"))}
  same = {"stream": 0, "arm": "detector", "seed": 3, "fault": "gear:all"}
  tables.write_table(
    tmp_path / "events.parquet", columns | {k: [v] * len(OLD) for k, v in same.items()}
  )
  tables.write_json(tmp_path / "config.json", {"repeat": 2})
  table = events.read(tmp_path / "events.parquet")
  assert table.schema == events.SCHEMA
  rows = table.to_pylist()
  assert [(r["cause"], r["decision"], r["since"], r["chunk"]) for r in rows] == [
    ("gear", None, None, 7),
    ("acted on", None, None, 8),
    ("alarm", "start", 1100, 8),
    ("phase adapting", None, None, 9),
    (None, "abort_below", 1100, 23),
    (None, None, 1100, 23),
    ("gear", None, None, 31),
  ]
  events.write(tmp_path / "events.parquet", rows)
  (tmp_path / "config.json").unlink()  # what is typed needs nothing else
  assert events.read(tmp_path / "events.parquet").equals(table)


def test_published_events_are_typed():
  files = sorted(RESULTS.rglob("events.parquet"))
  assert files
  for file in files:
    assert tables.read_arrow(file).schema.names == list(events.COLUMNS), file


def test_no_events_are_one_line(tmp_path):
  with pytest.raises(FileError, match="no such file"):
    events.read(tmp_path / "events.parquet")
