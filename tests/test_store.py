"""Result files: written whole or not at all, nan as null, SQL views, who may write where."""
import errno
import json
import math
import os
import pathlib

import numpy as np
import pyarrow.parquet
import pytest

from mjx_cl import store
from mjx_cl.errors import FileError, UserError

TABLE = {"a": np.array([1.5, np.nan, 3.0], np.float32), "b": np.array([1, 2, 3], np.int32), "c": ["x", None, "z"], "d": [None, 2, None],
         "e": np.array([True, False, True])}


def full(*_, **__):
  raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def one_line(error):
  """The text of an error that is one line long."""
  text = str(error.value)
  assert text and "\n" not in text
  return text


# ---- JSON ----------------------------------------------------------------------------------------------------------------------------

def test_json_round_trip(tmp_path):
  store.write_json(tmp_path / "x.json", {"a": [1, None, "b"], "n": np.float32(0.5), "v": np.arange(3)})
  assert json.loads((tmp_path / "x.json").read_text()) == {"a": [1, None, "b"], "n": 0.5, "v": [0, 1, 2]}
  assert os.listdir(tmp_path) == ["x.json"]


@pytest.mark.parametrize("value", [math.nan, math.inf, object()])
def test_json_refuses_what_it_cannot_say(tmp_path, value):
  store.write_json(tmp_path / "x.json", 1)
  with pytest.raises((ValueError, TypeError)):
    store.write_json(tmp_path / "x.json", {"a": value})
  assert (tmp_path / "x.json").read_text() == "1\n" and os.listdir(tmp_path) == ["x.json"]


# ---- a full disk ---------------------------------------------------------------------------------------------------------------------

def half_written(path, *_, **__):
  """A write that fills the disk: some bytes arrive, then the error."""
  with open(path, "wb") as f:
    f.write(b"half")
  full()


@pytest.mark.parametrize("where", ["write", "rename"])
@pytest.mark.parametrize("kind", ["json", "table"])
def test_a_full_disk_leaves_the_earlier_file(tmp_path, monkeypatch, kind, where):
  path = tmp_path / f"x.{kind}"
  write = {"json": lambda v: store.write_json(path, {"v": v}), "table": lambda v: store.write_table(path, {"v": [v]})}[kind]
  write(1)
  before = path.read_bytes()
  if where == "rename":
    monkeypatch.setattr(os, "replace", full)
  elif kind == "json":
    monkeypatch.setattr(pathlib.Path, "write_text", half_written)
  else:
    monkeypatch.setattr(pyarrow.parquet, "write_table", lambda table, path, **_: half_written(path))
  with pytest.raises(FileError) as error:
    write(2)
  text = one_line(error)
  assert str(path) in text and "No space left" in text and error.value.exit_code == 1
  assert path.read_bytes() == before and os.listdir(tmp_path) == [path.name]
  monkeypatch.undo()
  write(2)
  assert path.read_bytes() != before


def test_a_missing_folder_is_one_line(tmp_path):
  for write in (lambda p: store.write_json(p, 1), lambda p: store.write_table(p, {"v": [1]})):
    with pytest.raises(FileError) as error:
      write(tmp_path / "none" / "x")
    assert "No such file" in one_line(error)


# ---- tables --------------------------------------------------------------------------------------------------------------------------

def test_nan_becomes_null(tmp_path):
  store.write_table(tmp_path / "x.parquet", TABLE)
  table = pyarrow.parquet.read_table(tmp_path / "x.parquet")
  assert table.to_pydict() == {"a": [1.5, None, 3.0], "b": [1, 2, 3], "c": ["x", None, "z"], "d": [None, 2, None], "e": [True, False, True]}
  assert [str(t) for t in table.schema.types] == ["float", "int32", "string", "int64", "bool"]
  store.write_table(tmp_path / "x.parquet", TABLE, nan_is_null=False)
  assert pyarrow.parquet.read_table(tmp_path / "x.parquet")["a"].null_count == 0


def test_read_table_gives_null_as_nan(tmp_path):
  store.write_table(tmp_path / "x.parquet", TABLE)
  np.testing.assert_array_equal(store.read_table(tmp_path / "x.parquet")["a"], TABLE["a"])


@pytest.mark.parametrize("content", [None, b"", b"PAR1 no table PAR1"])
def test_read_table_of_no_table_is_one_line(tmp_path, content):
  if content is not None:
    (tmp_path / "x.parquet").write_bytes(content)
  with pytest.raises(FileError) as error:
    store.read_table(tmp_path / "x.parquet")
  assert "x.parquet" in one_line(error)


# ---- queries -------------------------------------------------------------------------------------------------------------------------

@pytest.fixture
def folder(tmp_path):
  """A folder with two tables; its name holds a quote."""
  folder = tmp_path / "it's"
  folder.mkdir()
  store.write_table(folder / "runs.parquet", {"seed": [0, 1], "latency": np.array([5.0, np.nan])})
  store.write_table(folder / "trace.parquet", {"seed": [0, 0, 1], "reward": [1.0, 2.0, 4.0]})
  return folder


def test_query_joins_the_views(folder):
  names, rows = store.query(folder, "select seed, latency, sum(reward) as total from runs join trace using (seed) group by all order by seed")
  assert names == ["seed", "latency", "total"] and rows == [(0, 5.0, 3.0), (1, None, 4.0)]


def test_query_takes_a_name_that_is_no_plain_word(folder):
  store.write_table(folder / "my-order.parquet", {"x": [7]})
  assert store.query(folder, 'select x from "my-order"')[1] == [(7,)]


@pytest.mark.parametrize("sql", ["select nothing from runs", "selec 1", "select * from elsewhere", ""])
def test_a_bad_query_is_one_line_that_names_the_views(folder, sql):
  with pytest.raises(UserError) as error:
    store.query(folder, sql)
  assert "runs, trace" in one_line(error) and error.value.exit_code == 2


def test_query_of_a_folder_without_tables(tmp_path):
  for where in (tmp_path, tmp_path / "none"):
    with pytest.raises(UserError) as error:
      store.query(where, "select 1")
    assert str(where) in one_line(error)


def test_query_of_a_broken_table_is_one_line(folder):
  (folder / "events.parquet").write_bytes(b"no table")
  with pytest.raises(FileError) as error:
    store.query(folder, "select 1")
  assert "events.parquet" in one_line(error)


# ---- the output folder ---------------------------------------------------------------------------------------------------------------

def claim(out, resume=False, overwrite=False):
  return store.claim_folder(out, resume, overwrite)


@pytest.mark.parametrize("flags", [{}, {"resume": True}, {"overwrite": True}])
def test_claim_of_a_new_or_empty_folder(tmp_path, flags):
  assert claim(tmp_path / "a" / "b", **flags) == "new" and (tmp_path / "a" / "b").is_dir()
  assert claim(tmp_path / "a" / "b", **flags) == "new"


@pytest.mark.parametrize("finished", [True, False])
def test_claim_of_another_run(tmp_path, finished):
  for name in ["config.json"] + ["summary.json"] * finished:
    (tmp_path / name).write_text("{}")
  with pytest.raises(UserError) as error:
    claim(tmp_path)
  assert all(word in one_line(error) for word in (str(tmp_path), "--resume", "--overwrite"))
  assert claim(tmp_path, resume=True) == ("done" if finished else "resume")
  assert claim(tmp_path, overwrite=True) == "new"
  assert (tmp_path / "config.json").read_text() == "{}"  # a claim removes nothing


def test_claim_of_a_folder_of_something_else(tmp_path):
  (tmp_path / "thesis.tex").write_text("years")
  with pytest.raises(UserError) as error:
    claim(tmp_path)
  assert "holds no run" in one_line(error)
  assert claim(tmp_path, overwrite=True) == "new" and (tmp_path / "thesis.tex").read_text() == "years"


def test_claim_refuses_a_file_and_both_flags(tmp_path):
  (tmp_path / "x").write_text("")
  with pytest.raises(UserError, match="is a file"):
    claim(tmp_path / "x", overwrite=True)
  with pytest.raises(UserError, match="exclude each other"):
    claim(tmp_path, resume=True, overwrite=True)


def test_claim_that_cannot_make_the_folder(tmp_path, monkeypatch):
  monkeypatch.setattr(pathlib.Path, "mkdir", full)
  with pytest.raises(FileError) as error:
    claim(tmp_path / "a")
  assert "No space left" in one_line(error)


def test_provenance_names_versions_and_machine():
  import jax
  value = store.provenance()
  assert value["versions"]["jax"] == jax.__version__ and value["machine"]["cores"] == os.cpu_count()
  json.dumps(value, allow_nan=False)
