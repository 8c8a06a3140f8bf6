"""Robots of a recording, healthy and faulty, and their lives with a frozen agent."""

import contextlib
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import faults as faults_lib
from mjx_cl.config import CHUNK
from mjx_cl.detectors.combine import read
from mjx_cl.keys import OfSeed
from mjx_cl.leaderboard.streams import COLUMNS
from mjx_cl.leaderboard.suite import Suite
from mjx_cl.rollout.monitor import History, Monitor
from mjx_cl.rollout.scan import Rollout, Row, nest, start
from mjx_cl.training import agents

TILE = 16  # lanes are filled up to a multiple of it


class Lane(NamedTuple):
  """One robot of a recording.

  Attributes:
    seed: of its keys.
    fault: None: healthy.
    target: None: drawn.
    severity: of the fault.
    full: False: OPR and RPR alone are kept.
  """

  seed: int
  fault: str | None = None
  target: str | None = None
  severity: float = 0.0
  full: bool = True


def lanes(suite: Suite, robot: str, split: str) -> list[Lane]:
  """The robots of one fault recording: every seed healthy first, then every fault, severity and
  seed. The split `tune` repeats the faults that score on seeds that do not, for oracles that must
  be fitted; of those OPR and RPR alone are kept. A fault's own noise is drawn by its place in the
  suite: new faults belong behind the others, which then live as before.
  """
  seeds, tables = suite.numbers(split), suite.robots[robot]
  out = [Lane(seed) for seed in seeds]
  for source in ("score",) if split == "score" else ("score", "tune"):
    for key, severities in tables.get(source, {}).items():
      fault, _, target = key.partition(":")
      out += [
        Lane(seed, fault, target or None, float(s), source == split)
        for s in severities
        for seed in seeds
      ]
  return out


@contextlib.contextmanager
def behind(function: Callable[..., Any]) -> Iterator[Callable[..., None]]:
  """Calls of one function on a thread of its own, in order and at most one behind: a frozen agent
  acts without waiting for what is made of its last chunk.

  with behind(function) as call: call(...)         an error of the function comes up at the next
    call, or at the end
  """
  last: list[Future] = []

  def call(*args: Any) -> None:
    if last:
      last.pop().result()
    last.append(pool.submit(function, *args))

  with ThreadPoolExecutor(1, "behind") as pool:
    yield call
  if last:
    last.pop().result()


def _drawn(
  who: list[Lane], names: list[str], faults: tuple[faults_lib.Fault, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Severity float32 (S, faults), target int32 (S, faults) and its name (S,) of each lane."""
  severity = np.zeros((len(who), len(faults)), np.float32)
  target, drawn = np.zeros_like(severity, np.int32), [""] * len(who)
  for i, lane in enumerate(who):
    if lane.fault:
      k = names.index(lane.fault)
      at = faults_lib.target_index(faults[k], lane.target)
      if at < 0:  # from seed and name alone: a fault more in the suite changes no other's target
        rng = np.random.default_rng([lane.seed, zlib.crc32(lane.fault.encode())])
        at = int(rng.integers(faults[k].drawn))
      severity[i, k], target[i, k], drawn[i] = lane.severity, at, faults[k].targets[at]
  return severity, target, np.asarray(drawn)


def live(
  env: Any,
  trained: agents.Trained,
  who: list[Lane],
  keys: jax.Array,
  onsets: np.ndarray,
  steps: int,
  watch_from: int,
  signed: bool,
  progress: Callable[[int, int, int], Any],
) -> dict[str, np.ndarray]:
  """Lives `steps` control steps of every lane; the monitor looks at healthy lanes all the time, at
  the others from `watch_from` on; `signed`: with innovations.

  Returns:
    COLUMNS float32 (steps, S), nan where unknown; episode int16, terminated bool (steps, S); latent
    float16 (steps, S, 16); innovation float32 (steps, S, O + 1) where `signed`; target (S,) names.
  """
  names = list(dict.fromkeys(lane.fault for lane in who if lane.fault))
  faults = tuple(faults_lib.make(n, env) for n in names) or (faults_lib.none(env),)
  severity, target, drawn = _drawn(who, names, faults)
  agent, n = trained.agent, len(who)
  rollout, monitor = Rollout(env, agent, faults), Monitor(agent, spec=env.spec, signed=signed)
  plan = lambda s, o: faults_lib.plan(
    s, jnp.broadcast_to(o, s.shape), jnp.full(s.shape, faults_lib.FOREVER)
  )
  plans = jax.vmap(plan)(jnp.asarray(severity), jnp.asarray(onsets, jnp.int32))
  begin = lambda k, p, t: start(env, agent, faults, k, target=t, plan=p)
  # matrix products take the last rows of an odd batch in another order, and a lane's past must be
  # its twin's
  fill = np.arange(n + -n % TILE) % n
  state = nest(begin, 0, 0)(
    keys[None, fill], jax.tree.map(lambda x: x[None, fill], plans), jnp.asarray(target)[None, fill]
  )
  params = jax.tree.map(lambda x: x[None], trained.train.params)
  look = _looks(monitor, params, who, keys, watch_from)
  remember, history = jax.jit(monitor.remember), monitor.init(1, n)
  parts: list[dict[str, np.ndarray]] = []

  def store(chunk: int, history: History, rows: Row) -> None:
    parts.append(look(chunk, history, rows))
    progress(min(steps, (chunk + 1) * CHUNK), steps, n)

  with behind(store) as stored:
    for chunk in range(-(-steps // CHUNK)):
      state, rows = rollout.chunk(params, state, CHUNK)
      rows = jax.tree.map(lambda x: x[:, :, :n], rows)
      stored(chunk, history, rows)
      history = remember(history, rows)
  columns = {k: np.concatenate([part[k] for part in parts])[:steps] for k in parts[0]}
  return columns | {"target": drawn}


def _looks(
  monitor: Monitor, params: Any, who: list[Lane], keys: jax.Array, watch_from: int
) -> Callable[[int, History, Row], dict[str, np.ndarray]]:
  """(chunk, history, rows) -> what `live` keeps of the chunk, by column."""
  healthy = sum(lane.fault is None for lane in who)
  watch = jax.jit(monitor.update_each)
  draws = jax.vmap(
    lambda key, chunk: jax.random.fold_in(jax.random.fold_in(key, OfSeed.WATCH), chunk), (0, None)
  )

  def look(chunk: int, history: History, rows: Row) -> dict[str, np.ndarray]:
    seen_of = len(who) if (chunk + 1) * CHUNK > watch_from else healthy
    take = lambda x: x[:, :, :seen_of]
    own = draws(keys[:seen_of], chunk)[None]
    _, seen = watch(params, jax.tree.map(take, history), jax.tree.map(take, rows), own)
    seen = jax.tree.map(lambda x: np.asarray(x)[:, 0], seen)
    gap = ((0, 0), (0, len(who) - seen_of))
    wide = lambda x: np.pad(x, (gap + ((0, 0),))[: x.ndim], constant_values=np.nan)
    more = {"innovation": wide(seen.innovation)} if monitor.signed else {}
    return (
      {name: wide(read(name, seen)) for name in COLUMNS}
      | more
      | {
        "episode": np.asarray(rows.episode)[:, 0].astype(np.int16),
        "terminated": np.asarray(rows.terminated)[:, 0],
        "latent": wide(seen.latent).astype(np.float16),
      }
    )

  return look
