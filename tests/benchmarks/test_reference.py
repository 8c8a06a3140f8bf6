"""benchmarks/reference.py: what digests tell apart and leave out, and what a comparison says."""

import importlib.util
import json
import pathlib

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

TABLE = {"step": pa.array([0, 1, 2], pa.int32()), "reward": pa.array([0.5, None, float("nan")])}
# stands in for a checkout: its commands write what they were given
FAKE = """
import json, pathlib, signal, sys, time
command, *words = sys.argv[1:]
if command == "fail":
  sys.exit("mjx-cl: no such robot")
out = pathlib.Path("out")
out.mkdir(exist_ok=True)
if command == "work" and "--resume" not in words:
  signal.signal(signal.SIGINT, lambda *_: sys.exit(130))
  (out / "saved").touch()
  time.sleep(60)
(out / "saved").unlink(missing_ok=True)
result = {"text": pathlib.Path("given").read_text(), "wall_s": time.time()}
(out / "result.json").write_text(json.dumps(result))
print(json.dumps([{"name": w, "value": VALUE} for w in words if w != "--resume"]))
"""


@pytest.fixture(scope="module")
def reference():
  file = pathlib.Path(__file__).parents[2] / "benchmarks" / "reference.py"
  spec = importlib.util.spec_from_file_location("benchmark_reference", file)
  module = importlib.util.module_from_spec(spec)
  spec.loader.exec_module(module)
  return module


def write(folder, columns):
  pyarrow.parquet.write_table(pa.table(columns), folder / "t.parquet")
  return folder / "t.parquet"


def digest(reference, array):
  return reference.entry(array, f"{array.dtype}{list(array.shape)}")


def test_arrays_differ_by_a_bit_a_shape_and_a_type_but_not_by_the_kind_of_nan(reference, tmp_path):
  zeros, at = np.zeros((2, 3), np.float32), digest
  other = zeros.copy()
  other[1, 2] = np.nextafter(np.float32(0), np.float32(1))
  negative = zeros.copy()
  negative[0, 0] = -0.0
  seen = {
    json.dumps(at(reference, x)) for x in (zeros, other, negative, zeros.T, zeros.astype(int))
  }
  assert len(seen) == 5
  nans = np.array([0x7FC00000, 0x7FC00001, 0xFFC00000], np.uint32).view(np.float32)
  assert at(reference, nans) == at(reference, np.full(3, np.nan, np.float32))
  np.savez(tmp_path / "a.npz", zeros=zeros, scalar=np.float32(2.5))
  found = reference.of_file(tmp_path / "a.npz")
  assert found["zeros"] == at(reference, zeros)
  assert found["scalar"]["summary"] == [2.5, 0.0, 2.5, 2.5]


def test_a_column_of_a_table_differs_by_itself(reference, tmp_path):
  first = reference.of_file(write(tmp_path, TABLE))
  assert first["reward"]["summary"][0] == 0.5 and first["step"]["number"] == 3
  assert first == reference.of_file(write(tmp_path, TABLE | {"wall_s": pa.array([1.0, 2.0, 3.0])}))
  changed = TABLE | {"reward": pa.array([0.5, float("nan"), None])}
  lines = reference.differences(first, reference.of_file(write(tmp_path, changed)))
  assert lines == ["reward: no difference in six digits"]
  changed = TABLE | {"step": TABLE["step"].cast(pa.int64()), "cause": pa.array(["a", "b", "c"])}
  lines = reference.differences(first, reference.of_file(write(tmp_path, changed)))
  assert lines == ["cause: only in the second", "step: int32 -> int64"]


def test_every_value_of_json_stands_apart_without_what_is_excluded(reference):
  value = {"arms": {"none": {"alarms": 2, "ci": [0.1, None]}}, "machine": {"cores": 2}, "empty": {}}
  rows = [{"name": "a", "x": 1.0, "wall_s": 3.0}, {"name": "b", "x": 2.0}]
  found = reference.of_json(value | {"rows": rows, "wall_s_arms": {"none": 3.0}})
  assert set(found) == {"arms/none/alarms", "arms/none/ci", "empty", "rows/[]/name", "rows/[]/x"}
  assert found["arms/none/alarms"]["value"] == 2 and found["rows/[]/x"]["summary"] == [
    1.5,
    0.5,
    1.0,
    2.0,
  ]
  near = np.nextafter(1.0, 2.0)
  assert found["rows/[]/x"] != reference.of_json({"rows": [{"x": near}, {"x": 2.0}]})["rows/[]/x"]


def test_a_folder_leaves_out_working_files_and_names_pictures(reference, tmp_path):
  for name in ("work/trace.npz", "part/checkpoints/1.json", "part/figure.png", "part/a.csv"):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text("x,y\n1,2\n3,4\n")
  found = reference.of_folder(tmp_path)
  assert set(found) == {"part/figure.png", "part/a.csv"}
  assert set(found["part/a.csv"]) == {"x", "y"} and found["part/figure.png"]["exists"]["value"]


def test_compare_names_what_differs_and_ends_with_1(reference, tmp_path, capsys):
  one = {"list": {"f": {"a": reference.entry([1.0], "json"), "b": reference.entry([2], "json")}}}
  two = {"list": {"f": {"a": reference.entry([1.5], "json")}}, "eval": {"f": {}}}
  for name, cases in (("one", one), ("two", two)):
    (tmp_path / name).write_text(json.dumps({"wall_s": {"list": len(name)}, "cases": cases}))
  paths = str(tmp_path / "one"), str(tmp_path / "two")
  assert reference.main(["compare", paths[0], paths[0]]) == 0
  assert capsys.readouterr().out == "0 differences in 1 cases\n"
  assert reference.main(["compare", *paths]) == 1
  *lines, _ = capsys.readouterr().out.splitlines()
  assert lines == [
    "eval: only in the second",
    "list/f/a: 1.0 -> 1.5",
    "list/f/b: only in the first",
  ]
  assert reference.main(["compare", *paths, "--only", "list"]) == 1


@pytest.fixture
def living(reference, tmp_path, monkeypatch):
  """living(value, cases): runs cases on a checkout whose commands print `value`; (status, file)."""
  monkeypatch.setitem(reference.CONFIG, "files", {"given": "text"})
  cut = {"like": "whole", "when": "out/saved", "text": "", "after_s": 0.0, "signal": "SIGINT"}
  monkeypatch.setattr(reference, "CUT", {"cut": cut})

  def live(value, **cases):
    (tmp_path / "mjx_cl").mkdir(exist_ok=True)
    (tmp_path / "mjx_cl" / "__main__.py").write_text(FAKE.replace("VALUE", repr(value)))
    monkeypatch.setattr(reference, "CASES", cases)
    out = tmp_path / f"{value}.json"
    words = ["--checkout", str(tmp_path), "--out", str(out), "--work", str(tmp_path / "work")]
    return reference.main(["run", *words]), json.loads(pathlib.Path(out).read_text())

  return live


def test_a_run_lives_its_cases_in_the_checkout(living, reference):
  status, one = living(1, whole=["work --resume", "again 'two words' --json"])
  assert status == 0 and set(one["wall_s"]) == {"whole"}
  assert set(one["cases"]["whole"]) == {"result.json", "again.stdout"}
  assert one["cases"]["whole"]["result.json"]["text"]["value"] == "text"
  _, two = living(2, whole=["work --resume", "again 'two words' --json"])
  lines = reference.differences(one["cases"], two["cases"])
  change = "[1.0, 0.0, 1.0, 1.0] -> [2.0, 0.0, 2.0, 2.0]"
  assert lines == [f"whole/again.stdout/[]/value: {change}"]


def test_a_case_that_is_cut_off_goes_on_and_must_end_as_its_twin(living, capsys):
  status, value = living(1, whole=["work --resume"], cut=["work"])
  assert status == 0 and value["cases"]["cut"] == value["cases"]["whole"]
  status, _ = living(2, whole=["other"], cut=["fast"])
  assert status == 1 and "ended with 0 before it could be cut off" in capsys.readouterr().out


def test_a_command_that_fails_is_told_and_the_others_go_on(living, reference, tmp_path, capsys):
  status, value = living(1, bad=["fail"], good=["other"])
  assert status == 1 and "bad: fail ended with 1: mjx-cl: no such robot" in capsys.readouterr().out
  assert "failed" in value["cases"]["bad"] and "result.json" in value["cases"]["good"]
  assert (
    reference.main(["compare", *[str(tmp_path / "1.json")] * 2]) == 1
  )  # failed alike is no success


def test_all_commands_are_whole_words(reference):
  commands = [reference.command(text) for case in reference.CASES.values() for text in case]
  assert not any("{" in word or "\n" in word for words in commands for word in words)
  assert {
    "run",
    "train",
    "eval",
    "record",
    "leaderboard",
    "certify",
    "detect",
    "bench",
    "query",
    "list",
    "plot",
  } == {words[0] for words in commands}
  assert {*reference.CUT, *reference.CONFIG["long"]} < set(reference.CASES)
