"""Errors that reach a user as one line. The CLI prints the message and leaves with `exit_code`."""

import difflib
from collections.abc import Mapping
from typing import TypeVar

Member = TypeVar("Member")


class UserError(Exception):
  """Wrong arguments, names or ranges: exit code 2."""

  exit_code = 2


class PluginError(UserError):
  """What goes wrong inside a robot, fault, detector or arm of another package: exit code 1."""

  exit_code = 1


class FileError(UserError):
  """A broken, foreign or missing file, a full disk, a numeric failure: exit code 1."""

  exit_code = 1


class ChangeError(UserError):
  """A log that has changed, where that was to be a failure: exit code 3."""

  exit_code = 3


def require(holds: object, text: str) -> None:
  """Raises UserError with this text unless the condition holds."""
  if not holds:
    raise UserError(text)


def choose(kind: str, name: str, table: Mapping[str, Member]) -> Member:
  """table[name], or a UserError that names every valid choice, and the one most like it."""
  try:
    return table[name]
  except KeyError:
    like = difflib.get_close_matches(name, table, 1)
    meant = f"; did you mean {like[0]!r}?" if like else ""
    known = ", ".join(sorted(table))
    raise UserError(f"unknown {kind} {name!r}; choose from: {known}{meant}") from None
