"""A suite as a job array of shards and a merge: what docs/experiments.md shows, and the whole suite."""

import pathlib
import re
import shlex
import subprocess

import pytest
from test_cli import mjx  # noqa: F401  a fixture
from test_suite import mini  # noqa: F401  a fixture
from test_transfer import agent, saved  # noqa: F401  fixtures

from mjx_cl.cli import app
from mjx_cl.cli.runs import asked
from mjx_cl.io import memory, tables
from mjx_cl.runs import suite as suites

PAGE = pathlib.Path(__file__).parents[2] / "docs/experiments.md"


def test_the_script_of_the_documentation_is_a_partition_and_its_merge(tmp_path):
  (block,) = (b for b in re.findall(r"```bash\n(.*?)```", PAGE.read_text(), re.S) if "SBATCH" in b)
  script = re.sub(r"^  ", "", block, flags=re.M)
  (tmp_path / "array.sh").write_text(script)
  done = subprocess.run(["bash", "-n", tmp_path / "array.sh"], capture_output=True, text=True)
  assert (done.returncode, done.stderr) == (0, "") and script.startswith("#!/bin/bash\n")
  first, last = map(int, re.search(r"--array=(\d+)-(\d+)", script).groups())
  each, merge = (shlex.split(line) for line in re.findall(r"mjx-cl (.*)", script))
  parts, outs = [], set()
  for k in range(first, last + 1):
    args = app.parse([word.replace("$SLURM_ARRAY_TASK_ID", str(k)) for word in each])
    parts += [part.name for part in asked(args)[1]]
    outs.add(args.out)
  whole = [part.name for part in suites.suite("full").parts]
  assert sorted(parts) == sorted(whole) and len(outs) == last - first + 1
  args = app.parse(merge)
  (pattern,) = args.merge
  assert all(pathlib.PurePath(out).match(pattern) for out in outs)
  assert not pathlib.PurePath(args.out).match(pattern)
  assert [part.name for part in asked(args)[1]] == whole


@pytest.mark.slow
def test_shards_and_a_merge_are_the_whole(mjx, mini, tmp_path, monkeypatch):  # noqa: F811
  monkeypatch.setattr(memory, "free", lambda: 2**36)  # a busy machine would refuse
  for k in (0, 1):
    code, _, err = mjx(
      "bench", mini, "--shard", f"{k}/2", "--out", tmp_path / f"out-{k}", "--jobs", 1
    )
    assert code == 0, err
  shards = sorted(tmp_path.glob("out-*"))
  code, _, err = mjx("bench", mini, "--out", tmp_path / "merged", "--merge", *shards)
  assert code == 0 and err.count("taken over") == 3, err
  assert mjx("bench", mini, "--out", tmp_path / "whole", "--jobs", 1)[0] == 0
  files = ["bench.parquet"] + [
    f"{part.name}/{name}.parquet"
    for part in suites.suite(str(mini)).parts
    for name in ("trace", "events", "runs")
  ]
  for file in files:
    one, two = (tables.read_arrow(tmp_path / name / file) for name in ("merged", "whole"))
    if "wall_s" in one.column_names:
      one, two = (table.drop_columns("wall_s") for table in (one, two))
    assert one.equals(two), file
