"""Events of a run's streams, the table events.parquet: typed columns beside each event's sentence.

A row is an onset, alarm, start, stop, abort, rollback or repair (`kind`). `cause` says of an onset
or repair what changes, of an alarm whether it is acted on or why not, of a start what triggered it.
`decision` is that of the phase machine where the event is one (decide.DECISIONS), `since` the
control step of what began the adaptation that it starts or ends, `chunk` the number of the chunk
that `step` lies in. `reason` is for people.
"""

import os
import pathlib

import pyarrow

from mjx_cl.adapt import decide
from mjx_cl.config import CHUNK
from mjx_cl.io import tables

_WHOLE = ("stream", "seed", "step", "since", "chunk")
COLUMNS = (
  "stream",
  "arm",
  "seed",
  "step",
  "kind",
  "cause",
  "decision",
  "since",
  "chunk",
  "reason",
  "fault",
)
SCHEMA = pyarrow.schema(
  [(name, pyarrow.int64() if name in _WHOLE else pyarrow.string()) for name in COLUMNS]
)


def write(path: str | os.PathLike, events: list[dict]) -> None:
  """Writes events, dicts with COLUMNS, as Parquet."""
  tables.write_arrow(path, pyarrow.Table.from_pylist(events, SCHEMA))


def read(path: str | os.PathLike) -> pyarrow.Table:
  """Events of a run by their file. One of an earlier version, which has sentences alone, is typed.

  Raises:
    FileError for a file that cannot be read.
  """
  table, folder = tables.read_arrow(path), pathlib.Path(path).parent
  if {"decision", "since"} <= set(table.column_names):
    return table
  repeat = tables.read_json(folder / "config.json").get("repeat", 1)
  return pyarrow.Table.from_pylist(typed(table.to_pylist(), CHUNK * repeat), SCHEMA)


def typed(events: list[dict], chunk_steps: int) -> list[dict]:
  """Events of an earlier version, in order, with what their sentences say in columns."""
  out, begun = [], {}
  for e in events:
    kind, said, since, decision = e["kind"], e["reason"], None, None
    cause = said.removeprefix("logged, not acted on: ").split(",")[0]
    if kind == "start":
      cause, _, at = said.rpartition(" at step ")
      since, decision = int(at), "start"
      begun[e["stream"]] = since
    elif kind in ("stop", "abort"):
      cause, since = None, begun.get(e["stream"])
      decision = decide.DECISIONS[decide.REASONS.index(said)]
    elif kind == "rollback":
      cause, since = None, begun.get(e["stream"])
    elif cause.startswith(("severity ", "after ")):  # of the only fault
      cause = (e.get("fault") or "").split(":")[0]
    typed = {
      "cause": cause,
      "decision": decision,
      "since": since,
      "chunk": e["step"] // chunk_steps,
    }
    out.append(e | typed)
  return out
