"""Curves of a training or run for other tools, beside the command's own tables (`--track`)."""

import csv
import math
import pathlib
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from mjx_cl.adapt.phases import PHASES
from mjx_cl.errors import UserError, choose
from mjx_cl.runs.runner import Progress

FOLDER, FILE = "tensorboard", "curves.csv"  # in --out
KINDS = ("tensorboard", "csv")


def check(kinds: Collection[str]) -> None:
  """Refuses unknown kinds, and TensorBoard without what writes its files.

  Raises:
    UserError: one line.
  """
  for kind in kinds:
    choose("track", kind, dict.fromkeys(KINDS))
  if "tensorboard" in kinds:
    try:
      import tensorboardX  # noqa: F401
    except ImportError:
      raise UserError("--track tensorboard needs: pip install tensorboardX") from None


@contextmanager
def beside(
  shown: Callable[[Any], object],
  of: Callable[[Any], tuple[int, dict[str, float]]],
  out: str,
  kinds: Collection[str],
  resume: bool,
) -> Iterator[Callable[[Any], object]]:
  """Gives `shown` that also writes the curves of what it shows; without kinds `shown` itself.

  Args:
    shown: display of a row or Progress.
    of: of_training or of_run.
    out: as in `tracked`.
    kinds: of KINDS.
    resume: as in `tracked`.
  """
  if not kinds:
    yield shown
    return
  with tracked(out, kinds, resume) as write:

    def both(what: Any) -> None:
      shown(what)
      write(*of(what))

    yield both


@contextmanager
def tracked(
  out: str, kinds: Collection[str], resume: bool
) -> Iterator[Callable[[int, Mapping[str, float]], None]]:
  """Gives write(step, values): numbers by name, those that are not finite left out.

  curves.csv has a row a number: step, name, value. A run that goes on adds to what is there; what
  it lived twice stands there twice.

  Args:
    out: folder of the training or run, there or not.
    kinds: of KINDS.
    resume: keeps what is there.
  """
  home, writer, table, file = pathlib.Path(out), None, None, None

  def start() -> None:
    nonlocal writer, table, file
    home.mkdir(parents=True, exist_ok=True)
    if "tensorboard" in kinds:
      from tensorboardX import SummaryWriter

      if not resume:
        shutil.rmtree(home / FOLDER, ignore_errors=True)
      # its files are named by the second: one that goes on at once would write over the one before
      writer = SummaryWriter(str(home / FOLDER), filename_suffix=f".{time.time_ns()}")
    if "csv" in kinds:
      new = not (resume and (home / FILE).exists())
      file = (home / FILE).open("w" if new else "a", newline="")
      table = csv.writer(file)
      if new:
        table.writerow(("step", "name", "value"))

  def write(step: int, values: Mapping[str, float]) -> None:
    if writer is None and table is None:
      start()  # with the first values: whatever is refused is refused before
    for name, value in values.items():
      if not math.isfinite(value):
        continue
      if writer is not None:
        writer.add_scalar(name, value, step)
      if table is not None:
        table.writerow((step, name, repr(float(value))))
    if file is not None:
      file.flush()

  try:
    yield write
  finally:
    if writer is not None:
      writer.close()
    if file is not None:
      file.close()


def of_training(row: Mapping[str, Any]) -> tuple[int, dict[str, float]]:
  """(updates, the numbers of a row of metrics.parquet)."""
  own = {k: float(v) for k, v in row.items() if isinstance(v, (int, float)) and k != "updates"}
  return int(row["updates"]), own


def of_run(p: Progress) -> tuple[int, dict[str, float]]:
  """(control step, each stream's reward, alarms, updates and whether it adapts, ARM/SEED/NAME);
  nothing of what is a note alone.
  """
  values: dict[str, float] = {}
  if p.note:
    return p.step, values
  for k, (arm, seed) in enumerate(zip(p.arms, p.seeds)):
    for name in ("reward", "alarms", "updates"):
      values[f"{arm}/{seed}/{name}"] = float(getattr(p, name)[k])
    values[f"{arm}/{seed}/adapting"] = float(PHASES[int(p.phase[k])] == "adapting")
  return p.step, values
