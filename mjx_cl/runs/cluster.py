"""Parts of a suite on the machines of a Ray cluster.

A part is a Ray task, which has it run by a process as on one machine (runs/workers.py), on a core
of its own. Where a machine sees the folder of the suite it writes there; elsewhere into a
folder of its own, which comes back as bytes. A part whose task, process or machine is lost begins
again, from its newest checkpoint where that can be reached. A part is never divided.
"""

import contextlib
import functools
import os
import pathlib
import platform
import shutil
import socket
import sys
import tempfile
import time
import uuid
import zlib
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO, NamedTuple

from mjx_cl import __version__
from mjx_cl.errors import FileError, UserError, require
from mjx_cl.io import folders, runtime
from mjx_cl.io.interrupt import Interruptible
from mjx_cl.runs import merge, workers

AGAIN = 3  # times that a part whose process was lost begins anew
ANSWER_S = 10.0  # that a cluster may take to answer
SAVE_S = 120.0  # that parts may take to save, where others were interrupted or have failed
ASK_S = 2.0  # after which a part asks again whether it is to end
HERE = ".ray"  # file in OUT by which a machine knows that it sees the driver's


class Cluster(NamedTuple):
  """A cluster, and what it gives a part besides a core.

  Attributes:
    address: HOST:PORT; None: one is started here.
    gpu: whether a part has a GPU to itself; without, it has none.
  """

  address: str | None = None
  gpu: bool = False


def of(on: str, address: str | None, gpu: bool = False) -> Cluster | None:
  """The cluster that --on, --address and --gpu mean, None where parts run here."""
  require(not gpu or on == "ray", "--gpu is of a cluster; give --on ray")
  require(address is None or on == "ray", "--address is of a cluster; give --on ray")
  return Cluster(address, gpu) if on == "ray" else None


class Given(NamedTuple):
  """What a task is given.

  Attributes:
    module: what its process runs, see cli/worker.py.
    out: folder of the suite where the driver runs.
    token: what OUT/.ray holds there.
    suite: text of OUT/suite.json.
    versions: that a machine must have.
    begun: folder in which the driver was started, which relative paths begin at.
    gpu: whether the part has one.
  """

  module: str
  out: str
  token: str
  suite: str
  versions: dict[str, str]
  begun: str = ""
  gpu: bool = False


class Told(NamedTuple):
  """What became of a part.

  Attributes:
    code: exit status; negative: the signal that ended its process; None: another version.
    line: what it said last.
    files: path below the part's folder -> bytes; None: they lie in the driver's folder.
  """

  code: int | None
  line: str = ""
  files: dict[str, bytes] | None = None


def versions() -> dict[str, str]:
  """What the bits of a result depend on."""
  own = runtime.provenance()
  return {"mjx_cl": __version__, "python": own["python"], **own["versions"]}


@contextlib.contextmanager
def own_core() -> Iterator[list[int]]:
  """A core of this machine that no other part of this user's has; all where none is free."""
  with contextlib.ExitStack() as held:
    mine = runtime.cores()
    for core in mine:
      with contextlib.suppress(UserError):
        held.enter_context(folders.alone(pathlib.Path(tempfile.gettempdir(), f"core-{core}")))
        mine = [core]
        break
    yield mine


def folder_of(given: Given) -> tuple[pathlib.Path, bool]:
  """Where this machine writes the suite, and whether that is the driver's folder. A folder of its
  own is named after this very suite, so that what other settings left is none of it.
  """
  out = pathlib.Path(given.out)
  with contextlib.suppress(OSError):
    if (out / HERE).read_text() == given.token:
      return out, True
  user = os.getuid() if hasattr(os, "getuid") else "all"
  name = "".join(c if c.isalnum() else "_" for c in given.out)[-80:]
  name += f"_{zlib.crc32(given.suite.encode()):08x}"
  return pathlib.Path(tempfile.gettempdir(), f"mjx_cl_ray_{user}", name), False


def run_part(
  name: str,
  given: Given,
  tell: Callable[[str], Any],
  stopped: Callable[[], bool] = lambda: False,
) -> Told:
  """Runs a part on this machine.

  Args:
    name: of the part.
    given: what the task is given.
    tell: called with each line that the part says.
    stopped: whether it is to save and end, asked every ASK_S.

  Raises:
    KeyboardInterrupt: once it is; what was lived is saved.
  """
  found = versions()
  wrong = [
    f"{k} {found.get(k)} in place of {v}" for k, v in given.versions.items() if found.get(k) != v
  ]
  if wrong:
    return Told(None, f"{platform.node()} has {', '.join(wrong)}")
  out, shared = folder_of(given)
  if not shared:
    folders.make(out)
    with folders.alone(out, wait=True):  # other tasks of this machine begin at the same moment
      folders.atomic(out / "suite.json", lambda file: file.write(given.suite.encode()))
  with own_core() as cores:
    told = _process(name, given, out, cores, tell, stopped)
  if told.code or shared:
    return told
  folder = out / name
  paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.is_symlink()]
  files = {str(p.relative_to(folder)): p.read_bytes() for p in paths}
  shutil.rmtree(folder, ignore_errors=True)  # they are the driver's from here on
  return told._replace(files=files)


def _process(
  name: str,
  given: Given,
  out: pathlib.Path,
  cores: list[int],
  tell: Callable[[str], Any],
  stopped: Callable[[], bool],
) -> Told:
  worker = _worker(given, out, cores)
  worker.tell = tell
  asked = time.monotonic()
  try:
    worker.give(name)
    while not worker.check():
      time.sleep(0.1)
      if time.monotonic() - asked >= ASK_S:
        asked = time.monotonic()
        if stopped():
          raise KeyboardInterrupt
    return Told(0)
  except UserError as e:
    release()
    return Told(worker.process.returncode or FileError.exit_code, str(e))
  except BaseException:  # Ray cancels a task by an exception
    release()
    raise


# the process of this task's parts, and what it was started for; a process of Ray runs a task at a
# time, and the next of the same suite goes on with what was imported and compiled
_HELD: list[tuple[tuple, workers.Worker]] = []


def release() -> None:
  """Has the process that is kept for the next part save and end."""
  while _HELD:
    worker = _HELD[-1][1]
    worker.close()
    while worker.process.poll() is None:
      with contextlib.suppress(KeyboardInterrupt):  # told once more: it is saving
        worker.process.wait()
    _HELD.pop()


def _worker(given: Given, out: pathlib.Path, cores: list[int]) -> workers.Worker:
  """The process that is kept, where it fits and lives, else a new one."""
  # which of a machine's GPUs are the part's stands in a variable that Ray has set; JAX would take a
  # GPU that Ray gave to another
  platforms = (os.environ.get("JAX_PLATFORMS") or "cuda,cpu") if given.gpu else "cpu"
  begun = given.begun if os.path.isdir(given.begun) else None
  of = (given, str(out), tuple(cores), platforms, os.environ.get("CUDA_VISIBLE_DEVICES"))
  if _HELD and (_HELD[0][0] != of or _HELD[0][1].process.poll() is not None):
    release()
  if not _HELD:
    own = os.environ | {"JAX_PLATFORMS": platforms}
    made = workers.Worker(given.module, out, 0, cores, lambda line: None, cwd=begun, env=own)
    _HELD.append((of, made))
  return _HELD[0][1]


class Board:
  """What parts say, kept for the driver."""

  def __init__(self) -> None:
    self.lines: dict[str, str] = {}
    self.over = False

  def stop(self) -> None:
    """The parts are to save and end."""
    self.over = True

  def stopped(self) -> bool:
    """Whether they are."""
    return self.over

  def put(self, name: str, line: str) -> None:
    """Takes a line of a part."""
    self.lines[name] = line

  def take(self) -> list[str]:
    """The newest line of each part that has said something since."""
    lines, self.lines = self.lines, {}
    return list(lines.values())


def _ray() -> Any:
  os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent anywhere
  try:
    import ray
  except ImportError:
    raise UserError("--on ray needs the package ray: pip install 'mjx_cl[ray]'") from None
  return ray


def _answers(address: str) -> None:
  """Raises UserError where nothing listens at HOST:PORT, for which Ray would look for minutes."""
  host, _, port = address.removeprefix("ray://").rpartition(":")
  if not host or not port.isdigit():
    raise UserError(f"--address is HOST:PORT of a Ray cluster, as ray start says it; got {address}")
  try:
    socket.create_connection((host, int(port)), ANSWER_S).close()
  except (OSError, OverflowError) as e:
    raise UserError(f"--address {address}: no Ray cluster answers ({e})") from None


def together(
  module: str,
  out: str | os.PathLike,
  names: list[str],
  needs: dict[str, int],
  finished: Callable[[str], None],
  tell: Callable[[str], None] = lambda text: None,
  on: Cluster | None = None,
  check: Callable[[pathlib.Path], None] = merge.whole,
) -> None:
  """Runs the parts `names` of OUT/suite.json on a cluster, in their order as machines are free.

  Args:
    module: what each process runs, see cli/worker.py.
    out: folder of the suite.
    names: of the parts.
    needs: bytes that each takes.
    finished: called with the name of each part as it ends.
    tell: called with each line that a part says.
    on: the cluster; None: one that is started here.
    check: raises FileError for a part's folder that is not whole.

  Raises:
    UserError: as soon as one fails over settings, a machine has other versions, or no machine is
      large enough. Before any of these is raised the others have saved what they had lived.
    FileError: as soon as one fails otherwise.
    KeyboardInterrupt: on a signal.
  """
  ray, out, on = _ray(), pathlib.Path(out).resolve(), on or Cluster()
  if on.address:
    _answers(on.address)
  own = {} if on.address else {"num_cpus": len(runtime.cores()), "include_dashboard": False}
  paths = os.pathsep.join(filter(None, sys.path))
  try:
    ray.init(
      on.address,
      log_to_driver=False,
      logging_level="ERROR",
      runtime_env={"env_vars": {} if on.address else {"PYTHONPATH": paths}},
      **own,
    )
  except (ConnectionError, ValueError, RuntimeError) as e:
    raise UserError(f"--address {on.address}: no Ray cluster answers ({e})") from None
  token = uuid.uuid4().hex
  folders.atomic(out / HERE, lambda file: file.write(token.encode()))
  suite = (out / "suite.json").read_text()
  given = Given(module, str(out), token, suite, versions(), os.getcwd(), on.gpu)

  def ended(name: str, told: Told) -> None:
    if told.files is not None:
      place(out, name, told.files, check)
    finished(name)

  try:
    _drive(ray, given, names, needs, ended, tell)
  finally:
    ray.shutdown()
    (out / HERE).unlink(missing_ok=True)


def _check_room(ray: Any, names: list[str], needs: dict[str, int], gpu: bool) -> None:
  nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
  nodes = [n for n in nodes if n.get("CPU", 0) >= 1 and n.get("GPU", 0) >= gpu]
  most, name = max((needs[name], name) for name in names)
  if most > max((n.get("memory", 0) for n in nodes), default=-1):
    raise UserError(
      f"no machine of the cluster has a core{', a GPU' * gpu} and {most / 2**30:.1f} GiB for part "
      f"{name}"
    )


def _drive(
  ray: Any,
  given: Given,
  names: list[str],
  needs: dict[str, int],
  ended: Callable[[str, Told], None],
  tell: Callable[[str], None],
) -> None:
  _check_room(ray, names, needs, given.gpu)
  # on the driver's machine, which no part can do without
  here = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
    ray.get_runtime_context().get_node_id(), soft=False
  )
  board = ray.remote(Board).options(num_cpus=0, scheduling_strategy=here).remote()

  def task(name: str, given: Given) -> Told:
    stopped = lambda: ray.get(board.stopped.remote())
    return run_part(name, given, lambda line: board.put.remote(name, line), stopped)

  def submit(name: str) -> Any:
    how = {"num_cpus": 1, "num_gpus": int(given.gpu), "memory": needs[name], "max_retries": -1}
    return ray.remote(task).options(**how).remote(name, given)

  lost = dict.fromkeys(names, 0)
  running = {submit(name): name for name in names}
  try:
    with Interruptible() as stop:
      while running:
        ready, _ = ray.wait(list(running), timeout=0.5)
        for line in ray.get(board.take.remote()):
          tell(line)
        for reference in ready:
          name = running.pop(reference)
          told = ray.get(reference)
          if told.code == 0:
            ended(name, told)
            continue
          again = told.code is not None and told.code < 0 and lost[name] < AGAIN
          if not again:
            raise _failure(told)
          lost[name] += 1
          tell(f"{name}: ended by signal {-told.code}; it begins again")
          running[submit(name)] = name
        stop.check()
  finally:
    # a KeyboardInterrupt to each task, which closes its process's standard input and waits until
    # that has saved; where C code drops it the task hears of it from the board. What Ray ends by
    # force takes its processes along
    if running:
      board.stop.remote()
    for reference in running:
      ray.cancel(reference)
    if running:
      ray.wait(list(running), num_returns=len(running), timeout=SAVE_S)


def _failure(told: Told) -> UserError:
  if told.code is None:
    return UserError(f"{told.line}; install the driver's versions there")
  return (UserError if told.code == UserError.exit_code else FileError)(told.line)


def place(
  out: pathlib.Path,
  name: str,
  files: dict[str, bytes],
  check: Callable[[pathlib.Path], None] = merge.whole,
) -> None:
  """Writes a part's files to OUT/NAME, whole or not at all.

  Raises:
    FileError: a path leads out of the folder, or a file is broken, see `check`.
  """
  folder, tmp = out / name, out / (name + ".tmp")
  with contextlib.ExitStack() as stack:
    stack.callback(_remove, tmp)
    for path, value in files.items():
      target = (tmp / path).resolve()
      if not target.is_relative_to(tmp.resolve()):
        raise FileError(f"part {name}: {path} leads out of its folder")
      folders.make(target.parent)
      folders.atomic(target, functools.partial(_write, value))
    check(tmp)
    _remove(folder)
    os.replace(tmp, folder)


def _write(value: bytes, file: BinaryIO) -> None:
  file.write(value)


def _remove(folder: pathlib.Path) -> None:
  shutil.rmtree(folder, ignore_errors=True)
