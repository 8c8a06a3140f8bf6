"""Hostile texts for flags, cells and fields."""

from __future__ import annotations

from typing import Any

import numpy as np

NUMBERS = (
  "nan", "inf", "-inf", "NaN", "-nan", "-1", "0", "-0", "1e400", "-1e400", "1e-400", "1.5", "-0.5",
  "99999999999999999999", "2147483647", "2147483648", "-2147483649", "9223372036854775808",
  "1" + "0" * 400, "0x10", "1_000", "0b1", "1,5", "1e3", "+1", "--1", "1e", "\u0661\u0662", "1 2",
  "\u00bd", "\u221e", "1j",
)  # fmt: skip
TEXTS = (
  "", " ", "\t", "\n", "None", "null", "true", "False", "[]", "{}", "()", "[1,2", '{"a":', "[" * 3000,
  '{"a":' * 2000, "a" * 200, "a" * 5000, "[bold]x[/bold]", "[/]", "[red", "[link=x]y", "<script>alert(1)</script>",
  "<!-- x", "\x1b[31mred\x1b[0m", "\x1b]0;title\x07", "a\x07b", "one\ntwo", "one\r\ntwo", "\x0c", "\x85", "a\u2028b",
  "\x9b31m", "\udcff\udcfe", "a\udc80b", "\ufffe", "\u00fcn\u00ef", "\u202egnirts", "\U0001f4a5", "e\u0301",
  "..", "./", "../nope", "~", "~nobody/x", "nope", "no/such/name", "walker ", "WALKER", "walkr", ":", "a:b",
  "file.py:", ":name", "nope.py:x", "a:b:c", "mjx_cl:nope", "%s%n%d", "{0.__class__}", "{}", "${HOME}", "$(touch pwned)",
  "; touch pwned", "`touch pwned`", "--", "-", "-x", "--nope", "--out", "=", "a=", "=b", "a=b", "a=b=c", "'", '"', "\\",
  "' or 1=1 --", "*", "?", "[a-z]*", "a@b", "cusum@", "@opr", "cusum@nope", "a/b@c", "a,b", "con", "nul", ".", "0/0",
)  # fmt: skip
PATHS = (
  "", "nope", "nope/nope/nope", "log.csv", "log.csv/x", "run", "run/trace.parquet", "set", "agent", "agent/card.json",
  "loop", "dangling", "linked_run", "linked_agent", "linked.csv", "empty", "foreign", "x" * 300, "x/" * 3000, "/dev/null",
  "/dev/full", "/dev/null/x", "/proc/self/nope", "/proc/version", "a\nb", "\x1b[31m", "\udcff", "-", "--", "~", "$HOME",
  "%s", "[a]", "a b", "*", ".", "suite.toml", "streams.toml", "\u202egnp", "con", "run/", "./run", "run/../run",
)  # fmt: skip
SETTINGS = ("nope", "threshold", "window", "warmup", "updates", "lr", "envs", "capacity", "ratio", "size", "batch",
            "obs_scale", "repeat", "fault", "", " ", "__class__", "a.b", "slack", "bins", "length")  # fmt: skip
SQL = (
  "drop table runs", "drop view runs", "create table x as select 1", "insert into runs select * from runs",
  "copy runs to 'stolen.csv'", "copy (select 1) to '/dev/stdout'", "select * from read_csv('/etc/passwd')",
  "select * from read_text('log.csv')", "select * from 'log.csv'", "attach 'x.db'", "install httpfs", "load httpfs",
  "pragma database_list", "set threads=1", "export database 'x'", "select", "selec 1", "select * from nope",
  "select nope from runs", "select 1;", ";", "select 1; drop view runs", "select 1/0", "select 'unterminated",
  'select "unterminated', "/* open", "-- only", "with recursive t(n) as (select 1 union all select n + 1 from t) select max(n) from t",
  "select count(*) from range(100000000000) a, range(1000) b", "select repeat('x', 1000000000000)", "call x()",
  "select error('two\nlines')", "select chr(27) || '[31m'", "select '[bold]x[/bold]'", "select cast('x' as int)",
  "select [1, null, nan]", "select {'a': inf}", "select '\u202ex'", "select " + "(" * 3000 + "1" + ")" * 3000,
  "select " + "1+" * 20000 + "1", "explain select 1", "describe runs", "show tables", "vacuum", "checkpoint", "begin",
  "select getenv('HOME')", "select current_setting('temp_directory')", "pivot runs on arm", "from runs limit -1",
  "select * from runs limit 'x'", "select interval 1 year", "select date '0001-01-01'", "select timestamp 'infinity'",
  "select uuid()", "select '\\x00'::blob", "select 1e308::double * 10", "select 170141183460469231731687303715884105727",
)  # fmt: skip


def number(rng: np.random.Generator) -> str:
  """A number, or what looks like one."""
  return NUMBERS[rng.integers(len(NUMBERS))]


def text(rng: np.random.Generator) -> str:
  """Any text: mostly hostile, sometimes of random characters."""
  if rng.random() < 0.15:
    return "".join(chr(int(c)) for c in rng.integers(1, 0x250, rng.integers(1, 40)))
  return TEXTS[rng.integers(len(TEXTS))]


def path(rng: np.random.Generator) -> str:
  """A path that is not what a flag asks for, mostly."""
  return PATHS[rng.integers(len(PATHS))]


def any_of(rng: np.random.Generator) -> str:
  """A number, a text or a path."""
  return (number, text, path)[rng.integers(3)](rng)


def setting(rng: np.random.Generator) -> str:
  """NAME=VALUE of --set, wrong in one of its halves, mostly."""
  name = SETTINGS[rng.integers(len(SETTINGS))]
  return f"{name}={any_of(rng)}" if rng.random() < 0.85 else any_of(rng)


def leaf(rng: np.random.Generator) -> Any:
  """A value for a field of JSON or TOML."""
  values: tuple[Any, ...] = (
    None, True, -1, 0, 10**30, 1.5, -1e308, 1e400, float("nan"), "", "nope", "[red", "\x1b[31m",
    "a" * 3000, [], {}, [[]], {"a": {"b": [1, {"c": None}]}}, [None], ["a", 1, None], 2**31, 2**63,
    "1", [1, 2, 3], "../..", "\u202ex", 0.0, -0.5,
  )  # fmt: skip
  return values[rng.integers(len(values))]
