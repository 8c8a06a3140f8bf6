"""Result files: written whole or not at all, nan as null, SQL views, who may write where."""

import errno
import json
import math
import os
import pathlib
import re
import signal
import subprocess
import sys
import threading
import types

import numpy as np
import pyarrow.parquet
import pytest

from mjx_cl.errors import FileError, UserError
from mjx_cl.io import folders, runtime, tables

TABLE = {
  "a": np.array([1.5, np.nan, 3.0], np.float32),
  "b": np.array([1, 2, 3], np.int32),
  "c": ["x", None, "z"],
  "d": [None, 2, None],
  "e": np.array([True, False, True]),
}


def full(*_, **__):
  raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def one_line(error):
  """The text of an error that is one line long."""
  text = str(error.value)
  assert text and "\n" not in text
  return text


# ---- JSON ----------------------------------------------------------------------------------------


def test_json_round_trip(tmp_path):
  tables.write_json(
    tmp_path / "x.json", {"a": [1, None, "b"], "n": np.float32(0.5), "v": np.arange(3)}
  )
  assert json.loads((tmp_path / "x.json").read_text()) == {
    "a": [1, None, "b"],
    "n": 0.5,
    "v": [0, 1, 2],
  }
  assert os.listdir(tmp_path) == ["x.json"]


@pytest.mark.parametrize("value", [math.nan, math.inf, object()])
def test_json_refuses_what_it_cannot_say(tmp_path, value):
  tables.write_json(tmp_path / "x.json", 1)
  with pytest.raises((ValueError, TypeError)):
    tables.write_json(tmp_path / "x.json", {"a": value})
  assert (tmp_path / "x.json").read_text() == "1\n" and os.listdir(tmp_path) == ["x.json"]


# ---- a full disk ---------------------------------------------------------------------------------


def half_written(file):
  """A write that fills the disk: some bytes arrive, then the error."""
  file.write(b"half")
  full()


@pytest.mark.parametrize("where", ["write", "rename"])
@pytest.mark.parametrize("kind", ["json", "table"])
def test_a_full_disk_leaves_the_earlier_file(tmp_path, monkeypatch, kind, where):
  path = tmp_path / f"x.{kind}"
  write = {
    "json": lambda v: tables.write_json(path, {"v": v}),
    "table": lambda v: tables.write_table(path, {"v": [v]}),
  }[kind]
  write(1)
  before = path.read_bytes()
  if where == "rename":
    monkeypatch.setattr(os, "replace", full)
  else:
    atomic = folders.atomic
    monkeypatch.setattr(folders, "atomic", lambda path, write: atomic(path, half_written))
  with pytest.raises(FileError) as error:
    write(2)
  text = one_line(error)
  assert str(path) in text and "No space left" in text and error.value.exit_code == 1
  assert path.read_bytes() == before and os.listdir(tmp_path) == [path.name]
  monkeypatch.undo()
  write(2)
  assert path.read_bytes() != before


def test_files_of_one_result_change_together_or_not_at_all(tmp_path):
  def interrupt():
    raise KeyboardInterrupt

  def write(value, then=lambda: None):
    with folders.together():
      tables.write_json(tmp_path / "a.json", value)
      with folders.together():
        tables.write_table(tmp_path / "b.parquet", {"v": [value]})
      then()

  write(1)
  before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
  with pytest.raises(FileError, match="No space left.*unchanged"):
    write(2, lambda: folders.atomic(tmp_path / "c", half_written))
  with pytest.raises(KeyboardInterrupt):
    write(2, interrupt)
  assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
  write(2)
  after = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
  assert after.keys() == before.keys() and all(after[name] != before[name] for name in before)


def test_a_missing_folder_is_one_line(tmp_path):
  for write in (lambda p: tables.write_json(p, 1), lambda p: tables.write_table(p, {"v": [1]})):
    with pytest.raises(FileError) as error:
      write(tmp_path / "none" / "x")
    assert "No such file" in one_line(error)


# ---- tables --------------------------------------------------------------------------------------


def test_nan_becomes_null(tmp_path):
  tables.write_table(tmp_path / "x.parquet", TABLE)
  table = pyarrow.parquet.read_table(tmp_path / "x.parquet")
  assert table.to_pydict() == {
    "a": [1.5, None, 3.0],
    "b": [1, 2, 3],
    "c": ["x", None, "z"],
    "d": [None, 2, None],
    "e": [True, False, True],
  }
  assert [str(t) for t in table.schema.types] == ["float", "int32", "string", "int64", "bool"]
  tables.write_table(tmp_path / "x.parquet", TABLE, nan_is_null=False)
  assert pyarrow.parquet.read_table(tmp_path / "x.parquet")["a"].null_count == 0


def test_read_table_gives_null_as_nan(tmp_path):
  tables.write_table(tmp_path / "x.parquet", TABLE)
  np.testing.assert_array_equal(tables.read_table(tmp_path / "x.parquet")["a"], TABLE["a"])


def test_read_table_of_a_missing_file_says_so(tmp_path):
  with pytest.raises(FileError, match="^cannot read .*none.csv: no such file$"):
    tables.read_table(tmp_path / "none.csv")


@pytest.mark.parametrize("content", [None, b"", b"PAR1 no table PAR1"])
def test_read_table_of_no_table_is_one_line(tmp_path, content):
  if content is not None:
    (tmp_path / "x.parquet").write_bytes(content)
  with pytest.raises(FileError) as error:
    tables.read_table(tmp_path / "x.parquet")
  assert "x.parquet" in one_line(error)


# ---- queries -------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path):
  """A folder with two tables; its name holds a quote."""
  folder = tmp_path / "it's"
  folder.mkdir()
  tables.write_table(folder / "runs.parquet", {"seed": [0, 1], "latency": np.array([5.0, np.nan])})
  tables.write_table(folder / "trace.parquet", {"seed": [0, 0, 1], "reward": [1.0, 2.0, 4.0]})
  return folder


def test_query_joins_the_views(folder):
  names, rows = tables.query(
    folder,
    (
      "select seed, latency, sum(reward) as total from runs join trace using (seed) group by all "
      "order by seed"
    ),
  )
  assert names == ["seed", "latency", "total"] and rows == [(0, 5.0, 3.0), (1, None, 4.0)]


def test_query_takes_a_name_that_is_no_plain_word(folder):
  tables.write_table(folder / "my-order.parquet", {"x": [7]})
  assert tables.query(folder, 'select x from "my-order"')[1] == [(7,)]


@pytest.mark.parametrize(
  "sql", ["select nothing from runs", "selec 1", "select * from elsewhere", ""]
)
def test_a_bad_query_is_one_line_that_names_the_views(folder, sql):
  with pytest.raises(UserError) as error:
    tables.query(folder, sql)
  assert "runs, trace" in one_line(error) and error.value.exit_code == 2


HOLDS = """import sys
from mjx_cl.io import folders
with folders.alone(sys.argv[1]):
  print("held", flush=True)
  sys.stdin.read()"""


def test_a_folder_is_one_processs_alone(tmp_path):
  """Until that ends, however it does; one process may ask twice, and other folders are free."""
  out = tmp_path / "out"
  other = subprocess.Popen(
    [sys.executable, "-c", HOLDS, str(out)],
    stdin=subprocess.PIPE,
    stdout=subprocess.PIPE,
    text=True,
  )
  assert other.stdout.readline() == "held\n"
  said = pytest.raises(UserError, match=f"out is being written by .* process {other.pid};")
  with said, folders.alone(tmp_path / "." / "out"):
    pass
  with folders.alone(tmp_path / "elsewhere"), folders.alone(tmp_path / "elsewhere"):
    pass
  other.kill()
  other.wait()
  with folders.alone(out):
    pass
  assert not list(tmp_path.iterdir())


ENDLESS = "select count(*) from range(10000000) a, range(10000000) b where a.range < b.range"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("times", [1, 2])
def test_a_query_ends_with_a_signal(folder, monkeypatch, number, times):
  """The last one comes while the first is being acted upon; nothing computes on afterwards."""
  before = set(threading.enumerate())
  begun, inner = threading.Event(), tables._answer
  monkeypatch.setattr(tables, "_answer", lambda *given: begun.set() or inner(*given))

  def send():
    begun.wait()
    for _ in range(times):
      signal.raise_signal(number)

  sender = threading.Thread(target=send)
  sender.start()
  old = signal.signal(number, signal.default_int_handler)
  try:
    with pytest.raises(KeyboardInterrupt):
      tables.query(folder, ENDLESS)
  finally:
    signal.signal(number, old)
    sender.join()
  for thread in set(threading.enumerate()) - before:
    thread.join(60)
    assert not thread.is_alive()


def test_a_query_ends_when_its_time_is_over(folder):
  with pytest.raises(UserError, match="within 0.2 s"):
    tables.query(folder, ENDLESS, timeout_s=0.2)


def test_a_query_gives_as_many_rows_as_asked(folder):
  for limit in (1, 1999, 2000, 2001, 5000):
    assert len(tables.query(folder, "from range(4500)", limit)[1]) == min(limit, 4500)
  assert tables.query(folder, "from range(4500)")[1] == [(k,) for k in range(4500)]


def test_query_of_a_folder_without_tables(tmp_path):
  for where in (tmp_path, tmp_path / "none"):
    with pytest.raises(UserError) as error:
      tables.query(where, "select 1")
    assert str(where) in one_line(error)


def test_query_of_a_broken_table_is_one_line(folder):
  (folder / "events.parquet").write_bytes(b"no table")
  with pytest.raises(FileError) as error:
    tables.query(folder, "select 1")
  assert "events.parquet" in one_line(error)


@pytest.fixture
def tree(tmp_path, monkeypatch):
  """A working folder with results/, a run folder beside it, and a file that no query may see."""
  monkeypatch.chdir(tmp_path)
  for name, rows in (
    ("results/leaderboard", 2),
    ("results/walker_gear/runs", 3),
    ("results/my-suite/2026", 4),
    ("runs/latest/trace", 5),
    ("runs/other/trace", 6),
    ("runs/a[1]/trace", 7),
    ("runs/a1/trace", 8),
  ):
    path = pathlib.Path(name + ".parquet")
    path.parent.mkdir(parents=True, exist_ok=True)
    tables.write_table(path, {"x": list(range(rows)), "y": ["z"] * rows})
  (tmp_path / "secret.csv").write_text("a\n1\n")
  return tmp_path


def every_file(folder):
  return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_views_are_named_by_their_paths(tree):
  named = {
    "leaderboard": "results/leaderboard.parquet",
    "walker_gear_runs": "results/walker_gear/runs.parquet",
    "my_suite_2026": "results/my-suite/2026.parquet",
  }
  assert tables.views() == {k: pathlib.Path(v) for k, v in named.items()}
  more = tables.views(
    ("runs/latest", "B=runs/other", "results/walker_gear")
  )  # what is there already keeps its name
  assert more == tables.views() | {
    "latest_trace": pathlib.Path("runs/latest/trace.parquet"),
    "b_trace": pathlib.Path("runs/other/trace.parquet"),
  }
  assert tables.query(more) == (
    ["view", "rows", "columns"],
    [
      ("leaderboard", 2, "x, y"),
      ("my_suite_2026", 4, "x, y"),
      ("walker_gear_runs", 3, "x, y"),
      ("latest_trace", 5, "x, y"),
      ("b_trace", 6, "x, y"),
    ],
  )
  assert tables.query(
    more, "select (select count(*) from leaderboard) + count(*) as n from b_trace"
  ) == (["n"], [(8,)])


def test_two_tables_of_one_name_are_named(tree):
  tables.write_table("results/walker_gear_runs.parquet", {"x": [1]})
  with pytest.raises(UserError) as error:
    tables.views()
  assert all(
    word in one_line(error)
    for word in ("results/walker_gear/runs.parquet", "results/walker_gear_runs.parquet", "NAME=DIR")
  )
  os.remove("results/walker_gear_runs.parquet")
  (tree / "more" / "latest").mkdir(parents=True)
  tables.write_table("more/latest/Trace.parquet", {"x": [1]})  # SQL does not tell trace from Trace
  with pytest.raises(UserError, match="latest_trace"):
    tables.views(("runs/latest", "more/latest"))
  assert len(tables.views(("runs/latest", "again=more/latest"))) == 5


def test_views_of_nothing(tmp_path, monkeypatch):
  monkeypatch.chdir(tmp_path)
  with pytest.raises(UserError, match="no .parquet file in results"):
    tables.views()
  with pytest.raises(UserError, match="no folder none"):
    tables.views(("none",))


@pytest.mark.parametrize(
  "sql",
  [
    "select x from leaderboard",
    "from leaderboard select x",
    "with t as (select x from leaderboard) select * from t",
    "values (0), (1)",
    "select 7; select x from leaderboard",
  ],
)
def test_a_reading_statement_is_run(tree, sql):
  assert tables.query(tables.views(), sql)[1] == [(0,), (1,)]


def test_a_summary_is_a_reading_statement(tree):
  assert [r[0] for r in tables.query(tables.views(), "describe leaderboard")[1]] == ["x", "y"]
  assert [r[:3] for r in tables.query(tables.views(), "summarize leaderboard")[1]] == [
    ("x", "BIGINT", "0"),
    ("y", "VARCHAR", "z"),
  ]


@pytest.mark.parametrize(
  "sql",
  [
    "copy leaderboard to 'out.csv'",
    "copy (select 1) to 'results/leaderboard.parquet' (format parquet)",
    "create table t as select 1",
    "create view t as select 1",
    "insert into leaderboard values (1, 'z')",
    "update leaderboard set x = 1",
    "delete from leaderboard",
    "drop view leaderboard",
    "alter view leaderboard rename to l",
    "attach 'new.db'",
    "install json",
    "load json",
    "export database 'out'",
    "import database 'out'",
    "pragma enable_profiling",
    "set threads = 1",
    "set enable_external_access = true",
    "reset lock_configuration",
    "checkpoint",
    "call duckdb_settings()",
    "begin",
    "vacuum",
    "use memory",
    "explain analyze copy leaderboard to 'out.csv'",
    "prepare p as select 1",
    "select 1; copy leaderboard to 'out.csv'",
    "pivot leaderboard on y using sum(x)",
  ],
)
def test_a_writing_statement_is_refused(tree, sql):
  before = every_file(tree)
  with pytest.raises(UserError) as error:
    tables.query(tables.views(), sql)
  assert (
    "read-only" in one_line(error)
    and "leaderboard" in one_line(error)
    and error.value.exit_code == 2
  )
  assert every_file(tree) == before


@pytest.mark.parametrize(
  "sql",
  [
    "select * from 'secret.csv'",
    "select * from read_csv('secret.csv')",
    "select * from read_text('{}/secret.csv')",
    "select * from read_blob('results/../secret.csv')",
    "select * from 'results/leaderboard.parquet/../../secret.csv'",
    "select * from sniff_csv('secret.csv')",
    "select * from glob('*')",
    "select * from read_parquet('runs/latest/trace.parquet')",
    "select * from read_parquet('results/*.parquet')",
    "select * from 'results/../runs/latest/trace.parquet'",
    "select * from read_parquet('http://localhost:1/x.parquet')",
    "select * from query('copy (select 1) to ''out.csv''')",
    "select * from query_table('secret.csv')",
    "with q as (insert into leaderboard values (1, 'z') returning x) select * from q",
    "select * from store",
    "select getenv('HOME')",
  ],
)
def test_a_path_trick_is_refused(tree, sql):
  before = every_file(tree)
  with pytest.raises(UserError) as error:
    tables.query(tables.views(), sql.format(tree))
  assert "leaderboard" in one_line(error)
  assert every_file(tree) == before


def test_a_folder_whose_name_is_a_pattern(tree):
  """runs/a[1] as a pattern means runs/a1."""
  assert tables.query("runs/a[1]", "select count(*) from trace")[1] == [(7,)]
  assert tables.query(tables.views(("runs/a[1]", "runs/a1")))[1][-2:] == [
    ("a_1__trace", 7, "x, y"),
    ("a1_trace", 8, "x, y"),
  ]


def test_query_on_the_command_line(tree, capsys):
  from mjx_cl.cli import app

  def call(*argv):
    code = app.main(["query", *argv])
    out, err = capsys.readouterr()
    assert code == 0 and err == ""
    return out

  assert json.loads(call("select x, x from leaderboard order by x", "--json")) == [
    {"x": 0, "x_1": 0},
    {"x": 1, "x_1": 1},
  ]
  assert json.loads(call("select 1 as x_2, 2 as x, 3 as x", "--json")) == [
    {"x_2": 1, "x": 2, "x_3": 3}
  ]
  assert json.loads(call("select 'nan'::float as x", "--json")) == [{"x": None}]
  assert json.loads(
    call(
      "--in",
      "runs/latest",
      "--in",
      "B=runs/other",
      "select max(x) - (select max(x) from latest_trace) as d from b_trace",
      "--json",
    )
  ) == [{"d": 1}]
  assert json.loads(call("--json")) == [
    {"view": k, "rows": n, "columns": "x, y"}
    for k, n in (("leaderboard", 2), ("my_suite_2026", 4), ("walker_gear_runs", 3))
  ]
  assert json.loads(call("runs/latest", "--json")) == [
    {"view": "trace", "rows": 5, "columns": "x, y"}
  ]
  assert json.loads(call("runs/latest", "select count(*) as n from trace", "--json")) == [{"n": 5}]
  assert "[red]x" in call("select '[red]x' as x")  # no markup
  for argv, word in (
    (["a", "b", "c"], "quotes"),
    (["runs/latest", "select 1", "--in", "runs/other"], "not both"),
    (["drop view leaderboard"], "DROP"),
  ):
    assert app.main(["query", *argv]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and word in err


# ---- the output folder ---------------------------------------------------------------------------


def claim(out, resume=False, overwrite=False):
  return folders.claim_folder(out, resume, overwrite)


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
  assert (
    claim(tmp_path, overwrite=True) == "new" and (tmp_path / "thesis.tex").read_text() == "years"
  )


@pytest.mark.parametrize(
  "name",
  [
    "summary.json",
    "work/thesis.txt",
    "work/checkpoints/mine",
    "checkpoints/mine.txt",
    "agent/agent.npz",
  ],
)
def test_what_is_somebody_elses_is_not_replaced(tmp_path, name):
  (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
  (tmp_path / name).write_text("years")
  for flags in ({"overwrite": True}, {"resume": True}):
    with pytest.raises(UserError) as error:
      claim(tmp_path, **flags)
    assert re.search(
      f"but {name.split('/mine')[0].removesuffix('/agent.npz')}\\b", one_line(error)
    ) and "another --out" in one_line(error)
  assert (tmp_path / name).read_text() == "years"


def test_what_was_cut_off_at_its_begin_goes_on(tmp_path):
  for name in (
    "work/checkpoints/5/state",
    "work/trace-000005.npz",
    "work/trace.tmp.npz",
    "work/snapshots/x",
    "checkpoints/3/state",
    "demonstrator/policy_1.npz",
  ):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text("")
  assert claim(tmp_path, resume=True) == "new" and claim(tmp_path, overwrite=True) == "new"


def test_claim_refuses_an_empty_name():
  with pytest.raises(UserError, match="empty name"):
    claim("")


@pytest.mark.parametrize(
  "text, says",
  [("{", "broken"), ("", "broken"), ("[1]", "list"), ("null", "NoneType"), (None, "No such file")],
)
def test_json_that_is_no_object_is_one_line(tmp_path, text, says):
  if text is not None:
    (tmp_path / "x.json").write_text(text)
  with pytest.raises(FileError) as error:
    tables.read_json(tmp_path / "x.json")
  assert says in one_line(error) and "x.json" in one_line(error)


@pytest.mark.parametrize("levels", [65, 600, 100_000])
def test_what_is_nested_without_end_is_one_line(tmp_path, levels):
  """Deeper than is said, than Python's own recursion, and than its parsers go."""
  json_, toml = tmp_path / "x.json", tmp_path / "x.toml"
  json_.write_text('{"a": ' + "[" * levels + "]" * levels + "}")
  toml.write_text("a = " + "[" * levels + "]" * levels)
  for read in (tables.read_json, lambda path: tables.read_suite(str(toml), tmp_path / "none")):
    with pytest.raises(FileError, match="nested deeper than 64 levels"):
      read(json_)
  toml.write_text(".".join("a" * 65) + " = 1")
  with pytest.raises(FileError, match="nested deeper than 64 levels"):
    tables.read_suite(str(toml), tmp_path / "none")
  json_.write_text('{"a": ' + "[" * 63 + "]" * 63 + "}")
  assert tables.read_json(json_)


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e999"])
def test_json_with_a_number_that_is_not_finite_is_one_line(tmp_path, number):
  (tmp_path / "x.json").write_text(f'{{"a": [{number}]}}')
  with pytest.raises(FileError, match="not finite"):
    tables.read_json(tmp_path / "x.json")


def test_a_folder_is_probed_before_what_goes_there_is_computed(tmp_path):
  folders.probe(tmp_path / "a/b")
  assert list((tmp_path / "a/b").iterdir()) == []
  (tmp_path / "file").write_text("")
  with pytest.raises(UserError, match="is a file"):
    folders.probe(tmp_path / "file")
  with pytest.raises(FileError, match="another --out"):
    folders.probe(tmp_path / "file/below")


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


def test_a_long_process_names_the_commit_that_it_began_with(monkeypatch):
  """Commits may come while it runs, and it has loaded none of them."""
  first = runtime.provenance()["git_commit"]
  monkeypatch.setattr(
    runtime.subprocess, "run", lambda *a, **k: types.SimpleNamespace(stdout="another\n")
  )
  assert runtime.provenance()["git_commit"] == first
  runtime._commit.cache_clear()
  assert runtime.provenance()["git_commit"] == "another"
  runtime._commit.cache_clear()


def test_provenance_names_versions_and_machine():
  import jax

  value = runtime.provenance()
  assert value["versions"]["jax"] == jax.__version__ and value["machine"]["cores"] == len(
    runtime.cores()
  )
  json.dumps(value, allow_nan=False)
