"""Tables that others add to: robots, faults, detectors and arms, by entry points of their packages
or out of a file, path/to/file.py:Name.
"""

import collections
import contextlib
import difflib
import functools
import hashlib
import importlib
import importlib.metadata
import importlib.util
import io
import modulefinder
import os
import pathlib
import sys
import traceback
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from mjx_cl.errors import FileError, PluginError, UserError
from mjx_cl.io import interrupt, limits


class Registry(collections.UserDict):
  """A table that the entry points of `group` join at its first use, so that a plug-in may import
  whatever it likes of this package. A name with a colon, "path/to/file.py:Name" or "module:Name",
  is what stands there, see `find`; the table does not list it.

  Args:
    group: of entry points, such as `mjx_cl.faults`.
    kind: what a message calls a member.
    own: the members that are there already.
    libraries: what makes a member of another library by its name there, "library:name".

  Raises:
    PluginError: at each use, one line: a name that is taken, a module that cannot be loaded, a
      member that cannot be called.
    UserError: a name with a colon where nothing of that name is.
  """

  def __init__(
    self,
    group: str,
    kind: str,
    own: dict[str, Any],
    libraries: Mapping[str, Callable[[str], Any]] = types.MappingProxyType({}),
  ) -> None:
    self.libraries = libraries
    self.group, self.kind, self.own, self.filled, self.members = (
      group,
      kind,
      frozenset(own),
      False,
      dict(own),
    )

  @property
  def data(self) -> dict[str, Any]:  # type: ignore[override]
    """What UserDict reads and writes."""
    self.fill()
    return self.members

  def fill(self) -> None:
    """Loads the plug-ins unless that is done, or is being done: a plug-in that looks into the table
    meanwhile sees what is there.
    """
    if self.filled:
      return
    self.filled = True
    found = {}
    try:
      for entry in importlib.metadata.entry_points(group=self.group):
        if entry.name in self.own or entry.name in found:
          raise PluginError(
            f"{self.kind} {entry.name!r} of {entry.value} is there already; a plug-in must "
            "have a name of its own"
          )
        note(entry.value.partition(":")[0])
        try:
          found[entry.name] = entry.load()
        except BaseException as e:  # whatever a foreign module raises
          if of_user(e):
            raise
          raise PluginError(
            f"{self.kind} {entry.name!r} of {entry.value} cannot be loaded: {line(e)}"
          ) from e
        if not callable(found[entry.name]):
          raise PluginError(
            f"{self.kind} {entry.name!r} of {entry.value} is nothing that can be called to make one"
          )
    except BaseException:
      self.filled = False
      raise
    self.members |= found

  def __contains__(self, name: object) -> bool:
    return name in self.data or (isinstance(name, str) and ":" in name)

  def __missing__(self, name: object) -> Any:
    if isinstance(name, str) and ":" in name:
      library, _, its = name.partition(":")
      if library in self.libraries:
        return _of_library(self.libraries[library], its)
      return find(name, self.kind)
    raise KeyError(name)


@functools.cache
def _of_library(make: Callable[[str], Any], name: str) -> Callable[[], Any]:
  """The same object for the same name, by which programs are shared."""
  return functools.partial(make, name)


def line(e: BaseException, lines: int | None = None) -> str:
  """An exception in one line: of its message the first `lines`, None: all."""
  try:
    said = " ".join(" ".join(str(e).strip().splitlines()[:lines]).split())
  except BaseException:  # a foreign one's own method
    said = "its message cannot be read"
  return f"{type(e).__name__}: {said or 'without a message'}"


def optional(install: str, *modules: str) -> types.ModuleType:
  """The last of these modules, each imported; UserError, with what pip is told to install, where a
  package is missing. What imports print (brax's a line where warp is absent) stays off standard
  output.
  """
  try:
    with contextlib.redirect_stdout(io.StringIO()):
      return [importlib.import_module(module) for module in modules][-1]
  except ImportError as e:
    raise UserError(f"this needs {modules[0]} ({e}): pip install {install}") from None


_FILE = "mjx_cl_file_"  # what the names of modules out of a user's file begin with
_OTHERS: set[str] = set()  # packages that plug-ins were taken from


def note(module: str) -> None:
  """Notes the package of a module that a plug-in was taken from."""
  _OTHERS.add(module.partition(".")[0])


def place(e: BaseException) -> str | None:
  """Where in a plug-in an exception was raised or passed, "FILE, line N"; None where no plug-in had
  a part in it.
  """
  found = None
  for frame, number in traceback.walk_tb(e.__traceback__):
    module = str(frame.f_globals.get("__name__"))
    if module.startswith(_FILE) or module.partition(".")[0] in _OTHERS - {"mjx_cl"}:
      found = f"{frame.f_code.co_filename}, line {number}"
  return found


def placed(e: BaseException) -> str:
  """Exception in one line, with its place in the plug-in where that is known."""
  where = place(e)
  return line(e) + (f" ({where})" if where else "")


def of_user(e: BaseException) -> bool:
  """Whether an exception is none of a plug-in's making: an interrupt that the user has sent, or the
  end of the memory.
  """
  return (isinstance(e, KeyboardInterrupt) and interrupt.sent()) or limits.ran_out(e)


def file_of(source: str) -> pathlib.Path | None:
  """The file in "path/to/file.py:Name", absolute; None for any other name."""
  where, colon, _ = source.rpartition(":")
  if not colon or not where.endswith(".py"):
    return None
  return pathlib.Path(os.path.realpath(os.path.expanduser(where)))  # takes links in a circle


def find(source: str, kind: str) -> Callable:
  """What "module:Name" or "path/to/file.py:Name" names; UserError, one line that begins with
  `kind`, where there is nothing that can be called.
  """
  where, colon, name = source.rpartition(":")
  if not colon or not where or not name:
    raise UserError(f"{kind} {source!r}: give module:Name or path/to/file.py:Name")
  path = file_of(source)
  if path is None:
    note(where)
    load = lambda: importlib.import_module(where)
  elif not path.is_file():
    raise FileError(f"{kind} {source}: no file {where}")
  else:
    load = lambda: _file(path, path.stat().st_mtime_ns)
  try:
    module = load()
  except UserError:
    raise
  except ModuleNotFoundError as e:
    if e.name and (where == e.name or where.startswith(e.name + ".")):
      raise UserError(
        f"{kind} {source}: no module {e.name!r} is installed; a file of your own is given as "
        "path/to/file.py:Name"
      ) from None
    raise PluginError(f"{kind} {source}: importing {where} failed: {line(e)}") from None
  except BaseException as e:  # whatever a foreign module raises
    if of_user(e):
      raise
    raise PluginError(f"{kind} {source}: importing {where} failed: {line(e)}") from None
  found = getattr(module, name, None)
  if not callable(found):
    like = difflib.get_close_matches(name, [k for k, v in vars(module).items() if callable(v)], 1)
    meant = f"; did you mean {like[0]!r}?" if like else ""
    raise UserError(
      f"{kind} {source}: {where} has nothing of the name {name!r} that can be called{meant}"
    )
  return found


@functools.cache
def _file(path: pathlib.Path, changed: int) -> types.ModuleType:
  """The module in a file, loaded once for each time that it was written (`changed` [ns])."""
  # under a name of its own: two files of one name must not be taken for each other
  inner = f"{_FILE}{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:12]}"
  spec: Any = importlib.util.spec_from_file_location(inner, path)
  module = importlib.util.module_from_spec(spec)
  sys.modules[inner] = module  # dataclasses look their module up there
  with _importable(path.parent):
    try:
      spec.loader.exec_module(module)
    except BaseException:
      del sys.modules[inner]
      raise
  return module


_FOLDERS: set[pathlib.Path] = set()  # of files of the user


def _beside(folder: pathlib.Path, name: str) -> pathlib.Path | None:
  """The file of the module or package of that name in a folder; None where there is none."""
  top = folder / name.partition(".")[0]
  return next((f for f in (top.with_suffix(".py"), top / "__init__.py") if f.is_file()), None)


@contextlib.contextmanager
def _importable(folder: pathlib.Path) -> Iterator[None]:
  """What lies in the folder can be imported, also where another file's folder has a module of that
  name, which is put back in the end.
  """
  _FOLDERS.add(folder)
  others = [f"{other}{os.sep}" for other in _FOLDERS - {folder}]
  foreign = lambda file: not file.startswith(f"{folder}{os.sep}") and file.startswith(tuple(others))
  aside = {
    name: module
    for name, module in list(sys.modules.items())
    if foreign(str(getattr(module, "__file__", None) or "")) and _beside(folder, name)
  }
  for name in aside:
    del sys.modules[name]
  sys.path.insert(0, str(folder))
  try:
    yield
  finally:
    sys.path.remove(str(folder))
    sys.modules.update(aside)


def files(path: pathlib.Path) -> list[pathlib.Path]:
  """A user's file and the modules beside it that it imports, and so on."""
  finder = modulefinder.ModuleFinder([str(path.parent)])
  with contextlib.suppress(OSError, SyntaxError, ValueError):  # whoever loads it says what is wrong
    finder.run_script(str(path))
  own = (getattr(module, "__file__", None) for module in finder.modules.values())
  return [path, *sorted({pathlib.Path(file) for file in own if file} - {path})]
