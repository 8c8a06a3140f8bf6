"""Snapshots of an adaptation that never stops by itself, and what each is worth on the broken
robot: afterwards the best stop can be chosen.

A snapshot is what the robot acts by (encoder, dynamics, policy: 1.6 MiB of size1m), float32, so
that it is what acted to the last bit. It lies in OUT/work until the run is over. Its name holds its
stream and step: a chunk that is lived again after a kill writes the same file again.
"""

import pathlib
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import faults as faults_lib
from mjx_cl.adapt import decide as phase_lib
from mjx_cl.adapt.arms import ARMS, never_stops
from mjx_cl.adapt.loop import Digest
from mjx_cl.config import RunConfig
from mjx_cl.errors import FileError, UserError
from mjx_cl.faults.presets import Change
from mjx_cl.io import arrays, folders
from mjx_cl.io.interrupt import Interruptible
from mjx_cl.keys import OfSeed
from mjx_cl.rollout.scan import Rollout, Stream, nest, start
from mjx_cl.training import agents
from mjx_cl.training.episodes import Episodes

ACTS = ("enc", "dyn", "pol")  # of the parameters: what Agent.act reads
EPISODES = 5
LIMIT_MIB = 2048  # of snapshots on the disk
BATCH = 32  # snapshots evaluated side by side ...
BATCH_MIB = 256  # ... unless their weights together are more
LENGTH = 50  # decisions per call


class Snapshot(NamedTuple):
  """One snapshot.

  Attributes:
    stream: its number.
    since: control step at which its adaptation started.
    step: last control step before it was taken.
  """

  stream: int
  since: int
  step: int


def due(
  before: np.ndarray | jax.Array,
  decision: np.ndarray | jax.Array,
  since: np.ndarray | jax.Array,
  now: int,
  length: int,
  every: int,
) -> np.ndarray:
  """Streams of which a snapshot is taken after a chunk.

    one of since, since + every, since + 2 every, ...  lies in now - length .. now - 1, and the
    stream adapted in the chunk

  Args:
    before: int (groups,), phase before the chunk.
    decision: int (groups,), of its end, see decide.PhaseState.
    since: int (groups,), likewise.
    now: control steps done after it.
    length: control steps of a chunk.
    every: control steps between two snapshots.

  Returns:
    bool (groups,). The first one, at since itself, holds the weights that adaptation began with.
  """
  before, decision, age = np.asarray(before), np.asarray(decision), now - 1 - np.asarray(since)
  adapted = (before == phase_lib.ADAPTING) | (decision == phase_lib.START)
  return adapted & (age >= 0) & (age // every != (age - length) // every)


class Snapshots:
  """Snapshots of one run: taken chunk by chunk, evaluated when it is over.

  Args:
    config: of the run.
    env: the robot as it is once it has changed.
    trained: its agent.
    faults: of the robot.
    changes: what happens to it.
    labels: (arm, seed) of each stream.
    folder: where the snapshots lie; made when the first is taken.

  Raises:
    UserError: where the run would take more than LIMIT_MIB of them.
  """

  def __init__(
    self,
    config: RunConfig,
    env: Any,
    trained: agents.Trained,
    faults: tuple[faults_lib.Fault, ...],
    changes: tuple[Change, ...],
    labels: list[tuple[str, int]],
    folder: pathlib.Path,
  ) -> None:
    self.config, self.changes, self.labels, self.folder = config, changes, labels, folder
    self.repeat = trained.repeat
    self.setting = (env, trained.agent, faults)
    self.kept = np.array([never_stops(ARMS[arm]) for arm, _ in labels])
    acts = {k: trained.train.params[k] for k in ACTS}
    self.like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), acts)
    self.bytes = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(self.like))
    streams, span = int(self.kept.sum()), max(0, config.steps - config.onset)
    need = streams * (span // config.snapshots + 1 + len(changes)) * self.bytes
    if need > LIMIT_MIB * 2**20:
      # of one stream, besides the first of each adaptation
      fit = LIMIT_MIB * 2**20 // (self.bytes * streams) - 1 - len(changes)
      more = f"snapshots={span // (fit + 1) + 1} would fit" if fit >= 0 else "take fewer seeds"
      raise UserError(
        f"snapshots={config.snapshots} would take up to {need / 2**20:,.0f} MiB on the disk, "
        f"{LIMIT_MIB} may be used; {more}"
      )

  # ---- while the run lives -----------------------------------------------------------------------

  def take(
    self,
    acting: Callable[[int], Any],
    before: np.ndarray,
    digest: Digest,
    now: int,
    length: int,
  ) -> None:
    """Writes the snapshots that are due.

    Args:
      acting: stream -> what it acts by.
      before: as in `due`.
      digest: of the chunk.
      now: as in `due`.
      length: as in `due`.
    """
    for s in self._due(before, digest.decision, digest.since, now, length):
      weights = arrays.named({k: acting(s.stream)[k] for k in ACTS})
      self._write(self._path(s), {name: np.asarray(leaf) for name, leaf in weights.items()})

  def _due(
    self, before: np.ndarray, decision: Any, since: Any, now: int, length: int
  ) -> list[Snapshot]:
    """What is to be taken after a chunk; arguments as of `due`."""
    hit = due(before, decision, since, now, length, self.config.snapshots) & self.kept
    last = min(now, self.config.steps) - 1
    return [Snapshot(int(g), int(since[g]), last) for g in np.flatnonzero(hit)]

  def _path(self, s: Snapshot) -> pathlib.Path:
    return self.folder / f"{s.stream:04d}-{s.step:09d}.npz"

  def _write(self, path: pathlib.Path, values: dict[str, np.ndarray]) -> None:
    folders.make(self.folder)
    arrays.write(path, values)

  def _read(self, s: Snapshot) -> Any:
    path = self._path(s)
    like: dict[str, Any] = arrays.named(self.like)
    stored = arrays.read(path)
    if {k: x.shape for k, x in stored.items()} != {k: x.shape for k, x in like.items()}:
      raise FileError(f"snapshot {path} belongs to another size or robot")
    return jax.tree.unflatten(jax.tree.structure(self.like), [stored[k] for k in like])

  def taken(self, trace: dict[str, np.ndarray], length: int) -> list[Snapshot]:
    """All snapshots of a run, from its trace: `phase` (steps, groups), `decision`, `since` (chunks,
    groups); no other file counts.
    """
    chunks = enumerate(zip(trace["phase"][::length], trace["decision"], trace["since"]), 1)
    return sorted(taken for k, at in chunks for taken in self._due(*at, k * length, length))

  # ---- when it is over ---------------------------------------------------------------------------

  def severities(self, since: int) -> list[float]:
    """Of each fault: its full severity where it is there in control step `since`, else 0."""
    begins = [self.config.onset + c.after for c in self.changes]
    return [
      c.severity if begin <= since and (not c.duration or since < begin + c.duration) else 0.0
      for c, begin in zip(self.changes, begins)
    ]

  def evaluate(
    self,
    wanted: list[Snapshot],
    targets: np.ndarray,
    tell: Callable[[str], Any] = lambda text: None,
  ) -> tuple[dict[str, np.ndarray], float]:
    """Lives EPISODES episodes with each snapshot: weights frozen, the stream's own fault in full
    force from step 0, whatever its schedule.

    All snapshots of a seed meet the same keys: the same starts, the same noise. Up to BATCH of them
    share one program, their weights and faults along a leading axis; each batch leaves its scores
    beside the snapshots, so that what was cut off goes on with the next one.

    Args:
      wanted: see `taken`.
      targets: int (groups, F), of each stream's faults.
      tell: called with a line after each batch.

    Returns:
      (columns of snapshots.parquet, seconds that it took).
    """
    size = max(1, min(BATCH, len(wanted), BATCH_MIB * 2**20 // self.bytes))
    parts, program = [], None
    with Interruptible() as interrupt:
      for first in range(0, len(wanted), size):
        batch = wanted[first : first + size]
        path = self.folder / f"scores-{first:06d}.npz"
        part = arrays.read(path) if path.exists() else None
        if part is None or part["of"].tolist() != [list(s) for s in batch]:
          begin = time.perf_counter()
          program = program or self._program()
          returns, steps = self._live(
            program, batch + batch[:1] * (size - len(batch)), np.asarray(targets), interrupt
          )
          part = {
            "of": np.array(batch),
            "returns": returns[: len(batch)],
            "steps": steps[: len(batch)],
            "seconds": np.array(time.perf_counter() - begin),
          }
          self._write(path, part)
          interrupt.check()
        parts.append(part)
        tell(f"snapshots evaluated: {min(first + size, len(wanted))} of {len(wanted)}")
    returns, steps = (np.concatenate([p[k] for p in parts]) for k in ("returns", "steps"))
    return self._columns(wanted, returns, steps), float(sum(p["seconds"] for p in parts))

  def _columns(
    self, wanted: list[Snapshot], returns: np.ndarray, steps: np.ndarray
  ) -> dict[str, np.ndarray]:
    stream, since, step = np.array(wanted).T
    return {
      "stream": stream.astype(np.int32),
      "arm": np.array([self.labels[g][0] for g in stream]),
      "seed": np.array([self.labels[g][1] for g in stream], np.int32),
      "step": step.astype(np.int32),
      "since_start": (step + 1 - since).astype(np.int32),
      "reward_mean": returns.sum(1) / steps.sum(1),
      "steps": steps.sum(1).astype(np.int32),
      **{f"return_{i}": returns[:, i] for i in range(EPISODES)},
    }

  def _program(self) -> tuple[Callable[..., Stream], Rollout]:
    begin = lambda key, target, severity: start(
      *self.setting, key, target=target, plan=faults_lib.plan(severity)
    )
    rollout = Rollout(*self.setting, self.repeat, self.config.deterministic)
    return jax.jit(nest(begin, (0, 0, 0), (0, None, None))), rollout

  def _live(
    self,
    program: tuple[Callable[..., Stream], Rollout],
    batch: list[Snapshot],
    targets: np.ndarray,
    interrupt: Interruptible,
  ) -> tuple[np.ndarray, np.ndarray]:
    """Returns and control steps of one episode per key, float64 and int (snapshots, EPISODES)."""
    begin, rollout = program
    params = jax.tree.map(lambda *x: jnp.stack(x), *map(self._read, batch))
    keys = jnp.stack(
      [
        jax.random.split(
          jax.random.fold_in(jax.random.key(self.labels[s.stream][1]), OfSeed.SNAPSHOTS), EPISODES
        )
        for s in batch
      ]
    )
    severity = jnp.asarray([self.severities(s.since) for s in batch], jnp.float32)
    streams = begin(keys, jnp.asarray(targets[[s.stream for s in batch]], jnp.int32), severity)
    lived = Episodes((len(batch), EPISODES))
    while lived.alive.any():
      streams, rows = rollout.chunk(params, streams, LENGTH)
      lived.add(rows)
      interrupt.check()
    return lived.total, lived.steps * self.repeat
