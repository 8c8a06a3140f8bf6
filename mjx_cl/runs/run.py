"""`run`: the whole loop for arms x seeds streams, a host loop over chunks.

Where the robot becomes another one (a preset with `becomes`, see rollout/transfer.py) each stream
has an onset of its own: the step with which its first episode of the other robot begins. That step
is its `onset` in events.parquet, from it on its `severity` is 1, and latency, windows and recovery
in runs.parquet are counted from it. `onset` is null there, and every alarm a false one, for a
stream that never changed. Faults that follow have events of their own at the run's onset plus their
`after`.

A stream that changes more than once (a preset in sequence, such as car/transfer-then-socks, or a
fault that is repaired) has a row in runs.parquet for each change, numbered in column `change`,
`kind` onset or repair; summary.json holds the first in `arms`, the others in `later_changes`. A row
ends where the next change begins. Of a later change reward_pre is the mean of the 2,000 steps
before it, and reward_drop that of the same stream, whatever its arm did in those steps: no stream
without adaptation shares its past.
"""

import pathlib
import shutil
import time
from collections.abc import Callable
from typing import Any

from mjx_cl.adapt.loop import Programs
from mjx_cl.config import RunConfig
from mjx_cl.errors import UserError
from mjx_cl.io import folders, tables
from mjx_cl.io.interrupt import Interruptible
from mjx_cl.runs.doubts import notes
from mjx_cl.runs.identity import check_same, identity
from mjx_cl.runs.results import finish
from mjx_cl.runs.runner import Progress, Runner
from mjx_cl.runs.settings import check


def execute(
  config: RunConfig,
  out: pathlib.Path | str,
  resume: bool = False,
  overwrite: bool = False,
  progress: Callable[[Progress], Any] = lambda p: None,
  save_every_s: float = 60.0,
  tell: Callable[[str], Any] = lambda text: None,
  programs: Programs | None = None,
) -> dict:
  """Runs a config into a folder.

  Args:
    config: of the run.
    out: its folder.
    resume: go on with a run that was cut off.
    overwrite: replace an earlier run.
    progress: called after each chunk.
    save_every_s: a kill at any moment loses at most so many seconds of work.
    tell: called with each line for the user.
    programs: compiled ones of this process that it may share.

  Returns:
    summary.json's value.
  """
  config = check(config)
  out = pathlib.Path(out)
  fresh = not out.exists()
  state = folders.claim_folder(out, resume, overwrite)
  if state == "done":
    # `auto` physics is resolved there
    check_same(out, {k: v for k, v in identity(config).items() if k != "physics"})
    return tables.read_json(out / "summary.json")
  try:
    # refuses wrong names and broken agents before anything of an earlier run is removed
    runner = Runner(config, out, programs)
  except UserError:
    if fresh and not any(out.iterdir()):
      out.rmdir()
    raise
  values = runner.config_dict()
  if state == "resume":
    check_same(out, values)
    runner.open()
    runner.resume()
  else:
    if overwrite:
      clear(out)
    runner.open()
    tables.write_json(out / "config.json", values)
  for text in notes(config):
    tell(f"note: {text}")
  tell(
    f"{len(config.arms) * config.seeds} streams of {config.steps:,} control steps; what is not "
    "compiled yet is compiled first, a minute or two"
  )
  saved = time.monotonic()
  with Interruptible() as interrupt:
    last = None
    while not runner.done:
      last = runner.step()
      progress(last)
      try:
        interrupt.check()
      except KeyboardInterrupt:
        # between two chunks; a second signal, in the middle of one, leaves nothing whole to save
        runner.save()
        raise
      if time.monotonic() - saved > save_every_s:
        runner.save()
        saved = time.monotonic()
  return finish(runner, lambda text: last and progress(last._replace(note=text)))


def clear(out: pathlib.Path) -> None:
  """Removes an earlier run's own files, nothing else."""
  for name in ("config.json", *folders.RESULTS):
    (out / name).unlink(missing_ok=True)
  for name in ("work", "checkpoints"):
    shutil.rmtree(out / name, ignore_errors=True)
  for card in (out / "agents").glob("*/card.json"):
    if '"adapted"' not in card.read_text(errors="replace"):  # not of `keep`
      continue
    for name in ("agent.npz", "card.json"):
      (card.parent / name).unlink(missing_ok=True)
    for folder in (card.parent, card.parent.parent):
      if not any(folder.iterdir()):
        folder.rmdir()
