"""benchmarks/hostile: cases follow from seed and number, what is wrong is counted as wrong, and what
is finished is not run again.
"""

import importlib
import json
import os
import sys

import numpy as np
import pytest

from benchmarks.hostile import __main__ as program
from benchmarks.hostile import (
  campaign,
  files,
  foreign,
  inputs,
  judge,
  kills,
  processes,
  surroundings,
)
from mjx_cl.cli.app import COMMANDS


def done(status, err, **more):
  return processes.Done(status, "", err, 0.1, **more)


def verdict(status, err, before=None, after=None, names=("severity",), tops=("out",)):
  before = {"run/a": "1"} if before is None else before
  return judge.judge(done(status, err), names, before, before if after is None else after, tops)


def test_a_case_follows_from_seed_and_number():
  for number in range(300):
    one, two = inputs.draw(5, number), inputs.draw(5, number)
    assert one[:-1] == two[:-1]
  assert [inputs.draw(5, n).words for n in range(20)] != [
    inputs.draw(6, n).words for n in range(20)
  ]
  for draw in (surroundings.draw, foreign.draw):
    assert [draw(1, n)[:2] for n in range(50)] == [draw(1, n)[:2] for n in range(50)]


def test_every_command_is_tried_and_every_kind():
  assert {base.words[0] for base in inputs.BASES.values()} == {k.__name__.lower() for k in COMMANDS}
  groups = {inputs.draw(0, n).group for n in range(400)}
  assert {"flag", "words", "file.json", "file.toml", "file.npz", "file.parquet"} <= groups
  assert len({foreign.draw(0, n) for n in range(len(foreign.EVERY))}) == len(foreign.EVERY)
  targets = {
    (n % len(kills.TARGETS), n // len(kills.TARGETS) % len(kills.SIGNALS)) for n in range(200)
  }
  assert len(targets) == len(kills.TARGETS) * len(kills.SIGNALS)


def test_one_line_that_names_what_is_wrong_holds():
  good = "mjx-cl: severity must lie in [0, 1]; got nan\n"
  assert verdict(2, good).how == "held"
  assert verdict(2, "note: x\n" + good).how == "held"
  assert verdict(0, "").how == verdict(processes.BEGUN, "").how == "valid"


@pytest.mark.parametrize(
  "status, err",
  [
    (1, "Traceback (most recent call last):\n  File \"x\"\nValueError: severity\n"),
    (2, ""),
    (2, "mjx-cl: severity\nmjx-cl: severity\n"),
    (2, "mjx-cl: severity \x1b[31m\n"),
    (2, "mjx-cl: severity " + "x" * 500 + "\n"),
    (2, "mjx-cl: something is wrong\n"),
    (2, "mjx-cl: severity\nmore\n"),
    (2, "RuntimeWarning: overflow\nmjx-cl: severity\n"),
    (-11, "mjx-cl: severity\n"),
    (3, "mjx-cl: severity\n"),
    (0, "UserWarning: hm\n"),
  ],
)  # fmt: skip
def test_anything_else_fails(status, err):
  assert verdict(status, err).how == "failed"


def test_what_is_lost_or_written_elsewhere_fails():
  good, before = "mjx-cl: severity\n", {"run/a": "1", "out/b": "2"}
  cases = {
    "held": [before, before | {"out/c": "3"}, before | {"tmp/x": "3"}],
    "failed": [{"out/b": "2"}, before | {"run/a": "2"}, before | {"out/b": "9"}, before | {"run/c": "1"}],
  }  # fmt: skip
  for how, after in cases.items():
    assert {verdict(2, good, before, x).how for x in after} == {how}
  assert verdict(0, "", before, before | {"out/b": "9"}).how == "valid"
  assert verdict(0, "", before, before | {"run/a": "9"}).how == "failed"


def test_what_hangs_fails_and_what_ctrl_c_ends_does_not():
  hangs = done(-9, "", interrupted=True, late=None)
  ends = done(130, "mjx-cl: interrupted\n", interrupted=True, late=0.5)
  assert judge.judge(hangs, (), {}, {}, ()).how == "failed"
  assert judge.judge(ends, (), {}, {}, ()).how == "valid"
  assert judge.judge(ends._replace(err="Traceback\n"), (), {}, {}, ()).how == "failed"


def test_signals_end_a_command_with_130_and_one_line():
  assert kills.ended_well("KILL", -9, "") == ""
  assert kills.ended_well("INT", 130, "step 1\nmjx-cl: interrupted; what was saved\n") == ""
  for status, err in (
    (-15, ""),
    (130, ""),
    (130, "Traceback\nmjx-cl: interrupted\n"),
    (1, "mjx-cl: interrupted\n"),
  ):
    assert kills.ended_well("TERM", status, err)


@pytest.mark.parametrize(
  "how", [files.cut, files.flip, files.foreign, files.kind, files.json_field]
)
def test_a_spoilt_file_is_another_each_time(tmp_path, how):
  said = []
  for seed in range(8):
    path = tmp_path / f"{seed}.json"
    path.write_text(json.dumps({"a": [1, 2, {"b": None}], "c": "text"}))
    before = path.read_bytes()
    how(path, np.random.default_rng(seed))
    same = path.is_file() and not path.is_symlink() and path.read_bytes() == before
    said.append(same)
  assert sum(said) < 4


def stub(words):
  """Stands in for mjx-cl: loses a file, prints a traceback, writes elsewhere, hangs, or holds."""
  if words[0] == "loses":
    os.remove("kept")
  if words[0] == "elsewhere":
    open("new", "w").close()
  if words[0] == "raises":
    raise ValueError(words[0])
  if words[0] == "hangs":
    while True:
      pass
  sys.stderr.write(f"mjx-cl: {words[0]} is wrong\n")
  return 2


@pytest.mark.parametrize("deed, how", [("holds", "held"), ("loses", "failed"), ("elsewhere", "failed"),
                                       ("raises", "failed"), ("hangs", "failed")])  # fmt: skip
def test_a_command_that_is_made_to_fail_is_counted_as_failed(tmp_path, deed, how):
  folder = tmp_path / "case"
  folder.mkdir()
  (folder / "kept").write_text("kept")
  before = judge.contents(folder)
  ended = processes.forked([deed], folder, 0.5 if deed == "hangs" else 20.0, work=stub)
  assert judge.judge(ended, (deed,), before, judge.contents(folder), ("out",)).how == how


def test_finished_cases_are_not_run_again(tmp_path, monkeypatch, capsys):
  ran = []

  def one(seed, number, home, folder):
    ran.append(number)
    folder.mkdir(parents=True)
    (folder / "left").touch()
    how = judge.Verdict("failed", "made to fail") if number == 1 else judge.Verdict("held")
    return campaign.Found("stub", "about", ["list", "a b"], how, 2, 0.0)

  monkeypatch.setattr(campaign, "KINDS", {"input": (one, 4)})
  names = program.names(["input"], "0/1", False, None)
  campaign.run(names[:2], 0, tmp_path, None)
  with (tmp_path / "results.jsonl").open("a") as file:
    file.write('{"case": "input-2", "ho')  # cut off
  campaign.run(names, 0, tmp_path, None)
  assert ran == [0, 1, 2, 3]
  campaign.run(names, 0, tmp_path, None, again=True)
  assert ran == [0, 1, 2, 3, 1]
  assert "input-1 failed: made to fail" in capsys.readouterr().out
  assert (tmp_path / "failed/input-1/left").exists()
  assert "mjx-cl list 'a b'" in (tmp_path / "failed/input-1/command.sh").read_text()
  found = campaign.read(tmp_path)
  assert [x["how"] for x in found.values()].count("failed") == 1
  assert campaign.table(found.values()).splitlines()[1].split() == ["all", "4", "3", "0", "1"]
  shares = [program.names(["input"], f"{k}/3", False, None) for k in range(3)]
  assert sorted(sum(shares, [])) == sorted(names) and len(names) == 4


def test_where_long_work_begins_is_there():
  """A renamed function would let a fork go on into it."""
  for module, names in processes.WORK.items():
    for name in names:
      assert callable(getattr(importlib.import_module(module), name)), f"{module}.{name}"
