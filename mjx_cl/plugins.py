"""Tables that other packages add to: robots, faults and detectors by entry points of their packages."""
from __future__ import annotations

import collections
import importlib.metadata

from mjx_cl.errors import PluginError


class Registry(collections.UserDict):
  """A table that the entry points of `group` join at its first use, so that a plug-in may import whatever it likes of this package.

  Args:
    group: of entry points, such as `mjx_cl.faults`. kind: what a message calls a member. own: the members that are there already.
  Raises:
    PluginError at each use, one line: a name that is taken, a module that cannot be loaded, a member that cannot be called.
  """

  def __init__(self, group: str, kind: str, own: dict):
    self.group, self.kind, self.own, self.filled, self.members = group, kind, frozenset(own), False, dict(own)

  @property
  def data(self) -> dict:
    """What UserDict reads and writes."""
    self.fill()
    return self.members

  def fill(self) -> None:
    """Loads the plug-ins unless that is done, or is being done: a plug-in that looks into the table meanwhile sees what is there."""
    if self.filled:
      return
    self.filled = True
    found = {}
    try:
      for entry in importlib.metadata.entry_points(group=self.group):
        if entry.name in self.own or entry.name in found:
          raise PluginError(f"{self.kind} {entry.name!r} of {entry.value} is there already; a plug-in must have a name of its own")
        try:
          found[entry.name] = entry.load()
        except (Exception, SystemExit) as e:  # whatever a foreign module raises
          raise PluginError(f"{self.kind} {entry.name!r} of {entry.value} cannot be loaded: {line(e)}") from e
        if not callable(found[entry.name]):
          raise PluginError(f"{self.kind} {entry.name!r} of {entry.value} is nothing that can be called to make one")
    except BaseException:
      self.filled = False
      raise
    self.members |= found

  def plugged(self) -> list[str]:
    """Names that are not this package's own."""
    return [name for name in self if name not in self.own]


def line(e: BaseException) -> str:
  """An exception in one line."""
  return f"{type(e).__name__}: {' '.join(str(e).split()) or 'without a message'}"
