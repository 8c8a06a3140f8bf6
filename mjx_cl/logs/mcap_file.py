"""Logs in MCAP files, such as rosbag2 writes: numbers of all topics at the times of the topic that
speaks most, the others holding their last value. Needs `pip install 'mjx-cl[ros]'`.
"""

import json
import pathlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from mjx_cl.errors import FileError, UserError

LONGEST = 64  # numbers of a list that become columns


def numbers(message: Any, name: str = "") -> Iterator[tuple[str, float]]:
  """(field, number) of a decoded message: nested fields joined by a point, elements of lists by
  their index, or by the message's own `name` as in sensor_msgs/JointState; header, text and lists
  of more than LONGEST are passed over.
  """
  if isinstance(message, (bool, int, float, np.number)):
    yield name, float(message)
  elif isinstance(message, (list, tuple, np.ndarray)):
    if len(message) <= LONGEST:
      for k, item in enumerate(message):
        yield from numbers(item, f"{name}[{k}]")
  elif not isinstance(message, (str, bytes, bytearray)) and message is not None:
    fields = message if isinstance(message, dict) else _fields(message)
    labels = fields.get("name")
    for field, value in fields.items():
      if field in ("header", "name"):
        continue
      path = f"{name}.{field}" if name else str(field)
      if isinstance(labels, (list, tuple)) and _as_long(value, labels):
        for label, item in zip(labels, value):
          yield from numbers(item, f"{path}.{label}")
      else:
        yield from numbers(value, path)


def _fields(message: Any) -> dict[str, Any]:
  names = getattr(message, "__slots__", None) or getattr(message, "__dict__", {})
  return {name.lstrip("_"): getattr(message, name) for name in names}


def _as_long(value: Any, labels: list | tuple) -> bool:
  return isinstance(value, (list, tuple, np.ndarray)) and len(value) == len(labels) > 0


class _Json:
  """Decodes messages that are JSON, as mcap's readers ask their factories."""

  def decoder_for(self, encoding: str, schema: Any) -> Callable[[bytes], Any] | None:
    """json.loads for messages of that encoding."""
    return json.loads if encoding == "json" else None


def read_mcap(path: pathlib.Path | str) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
  """(times since the first [s], column -> numbers, notes) of a file.

  Raises:
    UserError: the packages are missing.
    FileError: it is no MCAP file, or holds no numbers.
  """
  try:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
  except ImportError as e:
    raise UserError(f"this needs mcap ({e}): pip install 'mjx-cl[ros]'") from None
  topics: dict[str, tuple[list[int], list[dict[str, float]]]] = {}
  strange: set[str] = set()
  try:
    with open(path, "rb") as file:
      ros, plain = DecoderFactory(), _Json()
      decoders: dict[int, Callable[[bytes], Any] | None] = {}
      for schema, channel, message in make_reader(file).iter_messages():
        if channel.id not in decoders:
          decoders[channel.id] = plain.decoder_for(
            channel.message_encoding, schema
          ) or ros.decoder_for(channel.message_encoding, schema)
        decode = decoders[channel.id]
        if decode is None:
          strange.add(channel.topic)
          continue
        times, rows = topics.setdefault(channel.topic, ([], []))
        times.append(message.log_time)
        rows.append(dict(numbers(decode(message.data))))
  except OSError as e:
    raise FileError(f"cannot read {path}: {e.strerror}") from None
  except MemoryError:
    raise
  except Exception as e:  # of the file's bytes: each decoder and decompressor has errors of its own
    raise FileError(f"{path} is no MCAP file, or a broken one: {str(e)[:200]}") from None
  topics = {topic: found for topic, found in topics.items() if any(found[1])}
  if not topics:
    raise FileError(f"{path} holds no message with numbers that can be read")
  return *_joined(topics), _notes(path, topics, strange)


def _joined(
  topics: dict[str, tuple[list[int], list[dict[str, float]]]],
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
  """Columns of all topics at the times of the one with most messages, in order of time."""
  leader = max(topics, key=lambda topic: len(topics[topic][0]))
  at = np.sort(np.array(topics[leader][0], np.int64))
  columns = {}
  for topic, (times, rows) in topics.items():
    order = np.argsort(np.array(times, np.int64), kind="stable")
    held = np.searchsorted(np.array(times, np.int64)[order], at, "right") - 1
    for name in dict.fromkeys(name for row in rows for name in row):
      values = np.array([rows[k].get(name, np.nan) for k in order])
      columns[f"{topic}/{name}" if name else topic] = np.where(
        held < 0, np.nan, values[np.maximum(held, 0)]
      )
  return (at - at[0]) / 1e9, columns


def _notes(path: pathlib.Path | str, topics: dict, strange: set[str]) -> list[str]:
  notes = []
  if len(topics) > 1:
    leader = max(topics, key=lambda topic: len(topics[topic][0]))
    notes.append(
      f"{path}: samples are at the times of {leader}; other topics hold their last value"
    )
  if strange:
    notes.append(f"{path}: no decoder for {', '.join(sorted(strange))}")
  return notes
