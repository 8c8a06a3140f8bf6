"""Slices of benchmarks/accelerator.py: what is measured is kept and not measured again, what is not
says so.
"""

import json
import pathlib
import subprocess
import sys

SCRIPT = pathlib.Path(__file__).parents[2] / "benchmarks/accelerator.py"


def call(out, *flags):
  return subprocess.run(
    [sys.executable, str(SCRIPT), "--out", str(out), *flags], capture_output=True, text=True
  )


def test_a_slice_keeps_its_rows_and_the_next_goes_on(tmp_path):
  empty = call(tmp_path, "--report").stdout
  assert empty.count("not measured") == 5
  flags = ("--preset", "tiny", "--only", "update")
  first = call(tmp_path, *flags)
  assert first.returncode == 0, first.stderr[-2000:]
  (row,) = rows = json.loads((tmp_path / "rows.json").read_text())
  assert row["step"] == "update" and row["platform"] == "cpu" and 0 < row["value"] < 60
  assert call(tmp_path, *flags).returncode == 0
  assert json.loads((tmp_path / "rows.json").read_text()) == rows  # nothing was done again
  assert call(tmp_path, "--report").stdout.count("not measured") == 4


def test_what_does_not_fit_a_slice_says_that_something_is_left(tmp_path):
  assert call(tmp_path, "--slice", "10").returncode == 2
  said = call(tmp_path, "--preset", "tiny", "--only", "run")
  assert said.returncode == 1 and "needs the agent of step `train`" in said.stderr
  assert not (tmp_path / "rows.json").exists()
