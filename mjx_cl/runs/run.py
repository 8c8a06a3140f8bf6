"""`run`: the whole loop for arms x seeds streams, a host loop over chunks, and its result files.

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
import re
import shutil
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from mjx_cl import detectors, envs, faults
from mjx_cl.adapt import decide as phase_lib
from mjx_cl.adapt.loop import Programs
from mjx_cl.config import RunConfig
from mjx_cl.errors import FileError, UserError, require
from mjx_cl.faults.presets import becomes, changes
from mjx_cl.io import folders, tables
from mjx_cl.io.interrupt import Interruptible
from mjx_cl.render import figures
from mjx_cl.runs import merge
from mjx_cl.runs.doubts import notes
from mjx_cl.runs.healthy import Healthy
from mjx_cl.runs.identity import check_same, check_told, identity
from mjx_cl.runs.records import Ledger
from mjx_cl.runs.runner import Progress, Runner
from mjx_cl.runs.settings import check
from mjx_cl.runs.summary import summary
from mjx_cl.scoring import events as event_table
from mjx_cl.scoring import stop_rule
from mjx_cl.training import agents


def execute(
  config: RunConfig,
  out: pathlib.Path | str,
  resume: bool = False,
  overwrite: bool = False,
  progress: Callable[[Progress], Any] = lambda p: None,
  save_every_s: float = 60.0,
  tell: Callable[[str], Any] = lambda text: None,
  programs: Programs | None = None,
  healthy: Healthy | None = None,
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
    healthy: lives before the onset, likewise.

  Returns:
    summary.json's value.
  """
  config = check(config)
  with folders.alone(out):
    begins = resume and not pathlib.Path(out, "config.json").exists()
    runner = _begun(config, out, resume, overwrite, programs, healthy)
    if runner is None:
      return tables.read_json(pathlib.Path(out) / "summary.json")
    news = [f"{out} holds no run to go on with: one begins"] if begins else []
    for text in news + notes(config):
      tell(f"note: {text}")
    streams = len(config.arms) * config.seeds
    tell(
      f"{streams} stream{'s' * (streams > 1)} of {config.steps:,} control steps; what is not "
      "compiled yet is compiled first, a minute or two"
    )
    tell(str(runner.room))
    last = live(runner, progress, save_every_s)
    return finish(runner, lambda text: last and progress(last._replace(note=text)))


def _begun(
  config: RunConfig,
  out: pathlib.Path | str,
  resume: bool,
  overwrite: bool,
  programs: Programs | None,
  healthy: Healthy | None,
) -> Runner | None:
  """A run that is ready for its next chunk; None where it is finished. Arguments of `execute`."""
  fresh = not pathlib.Path(out).exists()
  try:
    state = folders.claim_folder(out, resume, overwrite)
  except UserError:
    _known(config)  # a name that is wrong is the better news
    raise
  out = pathlib.Path(out)  # not before: it would make the current folder of an empty name
  if state == "done":
    # physics is resolved there, see `differs`
    check_same(out, {k: v for k, v in identity(config).items() if k != "physics"})
    text = merge.differs(out, config)  # its agents' cards
    require(not text, f"--resume: {out} {text}; --overwrite begins anew")
    return None
  try:
    # refuses wrong names and broken agents before anything of an earlier run is removed
    runner = Runner(config, out, programs, healthy)
  except (UserError, KeyboardInterrupt):
    if fresh and not any(out.iterdir()):
      out.rmdir()
    raise
  values = runner.config_dict()
  check_told(config, values)
  if state == "resume":
    check_same(out, values)
    runner.open()
    runner.resume()
  else:
    clear(out)  # what one that was cut off while it began, or was removed, has left too
    runner.open()
    tables.write_json(out / "config.json", values)
    runner.fork()
  return runner


def _known(config: RunConfig) -> None:
  """Raises UserError where robot, fault, target or detector are not there."""
  into = becomes(config)
  robot = envs.make(config.env if into is None else into, config.physics)
  faults.build(changes(config), robot, config.onset)
  detectors.factory(config.detector)


def live(
  runner: Runner, progress: Callable[[Progress], Any], save_every_s: float
) -> Progress | None:
  """Lives a run to its end and returns its last Progress; saves every `save_every_s` seconds, and
  before an interrupt ends it.
  """
  saved, last = time.monotonic(), None
  with Interruptible() as interrupt:

    def heed() -> None:
      """Between two chunks; a second signal, within one, leaves nothing whole to save."""
      try:
        interrupt.check()
      except KeyboardInterrupt:
        runner.save()
        raise

    while not runner.done:
      last = runner.step()
      progress(last)
      heed()
      if time.monotonic() - saved > save_every_s:
        runner.save()
        saved = time.monotonic()
        heed()  # a signal during the last save too
  return last


def clear(out: pathlib.Path) -> None:
  """Removes an earlier run's own files, nothing else."""
  for name in folders.RESULTS:
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
  (out / "config.json").unlink(missing_ok=True)  # last: what is left without it is nobody's


def finish(runner: Runner, tell: Callable[[str], Any] = lambda text: None) -> dict:
  """Writes trace, events, runs, summary and figure, of an arm that never stops also signals,
  snapshots and stop; removes the working files.

  Returns:
    summary.json's value.
  """
  config, out, steps = runner.config, runner.out, runner.config.steps
  if runner.snapshots:
    runner.save()  # their evaluation takes a while; one that is cut off goes on from here
  trace = {k: v[:steps] if v.shape[0] >= steps else v for k, v in runner.trace().items()}
  # the last chunk lives on to its end
  outside = (trace["decision"] == phase_lib.START) & (trace["since"] >= steps)
  trace["decision"] = np.where(outside, phase_lib.NOTHING, trace["decision"])
  ledger = ledger_of(runner)
  table, events = ledger.trace(trace), ledger.events(trace)
  rows = ledger.rows(trace, events)
  tables.write_table(out / "trace.parquet", table)
  event_table.write(out / "events.parquet", events)
  write_rows(out / "runs.parquet", rows, rows[0])
  if config.residuals:
    columns = {k: table[k] for k in ("stream", "arm", "seed", "step")}
    names = [v.name for v in runner.env.spec.obs]
    one = lambda values, k: np.ascontiguousarray(values[:, :, k].T).reshape(-1)
    columns |= {name: one(trace["variables"], k) for k, name in enumerate(names)}
    columns |= {
      f"innovation_{name}": one(trace["innovation"], k) for k, name in enumerate([*names, "reward"])
    }
    tables.write_table(out / "residuals.parquet", columns)
  figures.figure(out)
  if runner.endless and "posture" in trace:
    tables.write_table(out / "signals.parquet", ledger.signals(trace))
  value = summary(ledger, rows, trace, runner.seconds)
  if runner.snapshots and (taken := runner.snapshots.taken(trace, runner.chunk_steps)):
    scores, value["wall_s_snapshots"] = runner.snapshots.evaluate(taken, targets(runner), tell)
    tables.write_table(out / "snapshots.parquet", scores)
    judged = stop_rule.of_folder(out)
    write_rows(out / "stop.parquet", judged, stop_rule.COLUMNS)
    value["stop_rule"] = stop_rule.summarise(judged)
  if config.keep:
    keep(runner)
  tables.write_json(out / "summary.json", value)
  runner.checkpoints.close()
  shutil.rmtree(runner.work, ignore_errors=True)
  return value


def write_rows(path: pathlib.Path, rows: list[dict], names: Iterable[str]) -> None:
  """Writes the columns `names` of rows as Parquet."""
  tables.write_table(path, {name: [r[name] for r in rows] for name in names})


def targets(runner: Runner) -> np.ndarray:
  """Int (groups, F), of each stream's faults."""
  last = lambda robots: robots if runner.other is None else robots.after
  return runner.lives.each(lambda robots: last(robots).injection.target)


def ledger_of(runner: Runner) -> Ledger:
  """What must be known of the run besides its trace."""
  names = [runner.config.fault] * runner.groups
  if runner.other is None:
    names = [
      "+".join(f"{f.name}:{f.targets[t]}" for f, t in zip(runner.faults, row))
      for row in targets(runner)
    ]
  return Ledger(
    runner.config,
    runner.env.spec,
    runner.repeat,
    runner.chunk_steps,
    runner.changes,
    None if runner.other is None else runner.other.spec.name,
    runner.labels,
    runner.breaks,
    [name if breaks else "none" for name, breaks in zip(names, runner.breaks)],
    runner.onsets(),
    np.asarray(runner._updates),
    runner.stream_seconds,
  )


def keep(runner: Runner) -> None:
  """Writes OUT/agents/ARM-SEED for every stream that has learnt: the weights that it acts by at
  the end, and the moments and counters of its learner. In ARM whatever is no letter, digit, point,
  hyphen or underscore is an underscore.

  Of a stream that went back (arms `rollback`, `guarded`, `ratchet`) the weights are those of
  before, moments, slow critic and counters those of the learner that was given up. The card is that
  of the agent it began with but for what that scored, and `adapted`: robot and fault it has lived
  with, arm, seed, control steps of the run, updates taken.
  """
  config, folder = runner.config, runner.out / "agents"
  for g, (arm, seed) in enumerate(runner.labels):
    updates = int(runner._updates[g])
    if not updates:
      continue
    card = runner.others.get(arm, runner.trained).card | {
      "adapted": {
        "env": config.env,
        "becomes": becomes(config),
        "fault": config.fault,
        "arm": arm,
        "seed": seed,
        "steps": config.steps,
        "updates": updates,
      }
    }
    card = {k: v for k, v in card.items() if k not in ("eval", "demonstrator_return")}
    try:
      agents.save(
        folder / f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', arm)}-{seed}", runner.lives.learnt(g), card
      )
    except OSError as e:
      raise FileError(
        f"cannot write in {folder}: {e.strerror or e}; --resume writes them again"
      ) from None
