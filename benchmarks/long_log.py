"""Time and memory of `mjx-cl detect` on a long log: python benchmarks/long_log.py [--out
results/long_log.json]

A synthetic machine of 50 columns at 1 kHz (two harmonics of 1.7 Hz and noise, column by column out
of phase): ten healthy minutes, and an hour in which column 7 gains an offset and column 30 a
seventh of its size at 2,000 s. As CSV and as Parquet.
"""

from __future__ import annotations

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

import numpy as np
import pyarrow
import pyarrow.csv
import pyarrow.parquet

from mjx_cl.io import runtime, tables

RATE, COLUMNS, PART = 1000, 50, 200_000  # [Hz]; rows made at a time
CHANGE_S = 2000


def rows(begin: int, count: int, rng: np.random.Generator, broken: bool) -> pyarrow.Table:
  """Rows of the machine from row `begin` on."""
  t = (begin + np.arange(count)) / RATE
  phase = 2 * np.pi * 1.7 * t
  made = {"time": t}
  for c in range(COLUMNS):
    x = np.sin(phase + c) + 0.3 * np.sin(2 * phase + 2 * c) + 0.1 * rng.standard_normal(count)
    late = broken & (t > CHANGE_S)
    x = x + 0.3 * late if c == 7 else x * (1 + 0.15 * late) if c == 30 else x
    made[f"c{c:02d}"] = x.astype(np.float32)
  return pyarrow.table(made)


def write(path: pathlib.Path, seconds: int, seed: int, broken: bool) -> None:
  """A log as CSV or Parquet, by its ending."""
  rng, writer = np.random.default_rng(seed), None
  kind = pyarrow.csv.CSVWriter if path.suffix == ".csv" else pyarrow.parquet.ParquetWriter
  for begin in range(0, seconds * RATE, PART):
    part = rows(begin, min(PART, seconds * RATE - begin), rng, broken)
    writer = writer or kind(str(path), part.schema)
    writer.write(part)
  writer.close()


def measure(kind: str, folder: pathlib.Path, seconds: int, nominal: int) -> dict:
  """Wall time [s], peak of resident memory [GB] and verdict of one detection."""
  log, healthy = folder / f"log.{kind}", folder / f"healthy.{kind}"
  write(healthy, nominal, 1, False)
  write(log, seconds, 3, True)
  command = [
    sys.executable,
    "-m",
    "mjx_cl",
    "detect",
    str(log),
    "--nominal",
    str(healthy),
    "--json",
  ]
  began = time.monotonic()
  with open(folder / "said.json", "w") as said:
    process = subprocess.Popen(command, stdout=said)
    _, status, used = os.wait4(process.pid, 0)
  if status:
    raise SystemExit(f"long_log: {' '.join(command)} failed")
  verdict = json.loads((folder / "said.json").read_text())["verdict"]
  return {
    "kind": kind,
    "seconds": seconds,
    "nominal_seconds": nominal,
    "file_gb": log.stat().st_size / 1e9,
    "wall_s": time.monotonic() - began,
    "peak_gb": used.ru_maxrss * 1024 / 1e9,
    "begin_s": verdict.get("begin_s"),
    "columns": [one["column"] for one in verdict.get("columns", [])],
  }


if __name__ == "__main__":
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  parser.add_argument("--out")
  parser.add_argument("--seconds", type=int, default=3600)
  parser.add_argument("--nominal", type=int, default=600)
  args = parser.parse_args()
  found = []
  for name in ("csv", "parquet"):
    with tempfile.TemporaryDirectory() as at:
      found.append(measure(name, pathlib.Path(at), args.seconds, args.nominal))
    print(found[-1], flush=True)
  if args.out:
    command = " ".join(["python", *sys.argv])
    tables.write_json(args.out, {"command": command, "logs": found, **runtime.provenance()})
