"""Ring buffers on the device: windows of consecutive records, uniform sampling, online queue,
latent refresh.

One `Replay` serves one agent and holds `envs` streams side by side, (envs, capacity, ...). Records
are addressed by their absolute number in the stream; slot = number mod capacity. Latents are
compact: deter as float16, the categorical variables as class indices.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Int, PRNGKeyArray, Shaped

from mjx_cl.dreamer.state import Record
from mjx_cl.types import Array

Address = tuple[Int[Array, "batch"], Int[Array, "batch"]]  # stream and first record of windows


class Replay(NamedTuple):
  """Records of streams side by side.

  Attributes:
    data: Record with leading (envs, capacity).
    count: int32 (envs,), records ever written to each stream.
    queue: int32 (envs,), number of the first record of the next window of the online queue.
  """

  data: Record
  count: jax.Array  # type: ignore[assignment]
  queue: jax.Array


def record_bytes(obs_size: int, act_size: int, deter: int, stoch: int) -> int:
  """Bytes of one record."""
  return 4 * obs_size + 8 * act_size + 4 + 4 + 2 * deter + stoch


def room(records: int) -> int:
  """The least of 1,024, 1,280, 1,536, 1,792, 2,048, 2,560 and so on that holds `records`: at most a
  quarter more than asked above 1,024, so that runs of about the same length share one compiled
  program.
  """
  step = 256
  while 8 * step < records:
    step *= 2
  return max(1024, -(-records // step) * step)


def init(envs: int, capacity: int, obs_size: int, act_size: int, deter: int, stoch: int) -> Replay:
  """An empty replay."""
  zeros = lambda *shape, dtype=jnp.float32: jnp.zeros((envs, capacity) + shape, dtype)
  data = Record(
    obs=zeros(obs_size),
    action=zeros(act_size),
    reward=zeros(),
    first=zeros(dtype=bool),
    last=zeros(dtype=bool),
    terminal=zeros(dtype=bool),
    deter=zeros(deter, dtype=jnp.float16),
    stoch=zeros(stoch, dtype=jnp.uint8),
    demo=zeros(act_size),
    has_demo=zeros(dtype=bool),
  )
  return Replay(data, jnp.zeros(envs, jnp.int32), jnp.zeros(envs, jnp.int32))


def clear(replay: Replay) -> Replay:
  """Forgets every record; the arrays stay."""
  return replay._replace(count=jnp.zeros_like(replay.count), queue=jnp.zeros_like(replay.queue))


def add(replay: Replay, records: Record, keep: Bool[Array, "envs records"]) -> Replay:
  """Appends the records of a chunk.

  Args:
    replay: of `envs` streams.
    records: Record with leading (envs, n), n at most the capacity.
    keep: bool (envs, n); the others are left out, order is kept.
  """
  capacity = replay.data.reward.shape[1]

  def one(data: Record, count: Array, records: Record, keep: Array) -> tuple[Record, Array]:
    number = count + jnp.cumsum(keep) - 1
    # capacity lies outside: the write is dropped
    slot = jnp.where(keep, number % capacity, capacity)
    data = jax.tree.map(lambda d, r: d.at[slot].set(r.astype(d.dtype), mode="drop"), data, records)
    return data, count + jnp.sum(keep)

  data, count = jax.vmap(one)(replay.data, replay.count, records, keep)
  return replay._replace(data=data, count=count.astype(jnp.int32))


def windows(replay: Replay, length: int) -> Int[Array, ""]:
  """Windows of `length` records that can be drawn, int32 ()."""
  capacity = replay.data.reward.shape[1]
  return jnp.sum(jnp.maximum(0, jnp.minimum(replay.count, capacity) - length + 1))


def sample(
  replay: Replay,
  key: PRNGKeyArray,
  batch: int,
  length: int,
  only: Int[Array, ""] | None = None,
) -> tuple[Replay, Record, Address]:
  """Draws windows: first those waiting in the online queue, then uniformly over all windows.

  The queue holds every non-overlapping window of each stream once, oldest first, those of a stream
  that has waited longest before others, so each fresh sequence is seen once promptly. `first` is
  forced at index 0, `last` where the next record is a first one.

  Args:
    replay: to draw from.
    key: of the draw.
    batch: windows.
    length: records of each, context included.
    only: int32 (), the one stream to draw from, as if the others held nothing; None: all.

  Returns:
    (replay', Record with leading (batch, length), address). The caller makes sure that at least one
    window exists.
  """
  capacity = replay.data.reward.shape[1]
  mine = True if only is None else jnp.arange(len(replay.count)) == only
  oldest = jnp.maximum(0, replay.count - capacity)
  queue = jnp.where(mine, jnp.maximum(replay.queue, oldest), replay.queue)
  waiting = jnp.where(mine, jnp.maximum(0, (replay.count - queue) // length), 0)
  # a train ratio below 1 leaves windows behind: none of a stream's may wait for ever
  since = jnp.where(waiting > 0, (replay.count - replay.queue) // length, 0)
  order = jnp.argsort(-since, stable=True) if only is None else jnp.arange(len(waiting))
  ends = jnp.cumsum(waiting[order])
  slot = jnp.arange(batch)
  from_queue = slot < ends[-1]
  turn = jnp.minimum(jnp.searchsorted(ends, slot, side="right"), len(ends) - 1)
  begin = ends - waiting[order]
  q_stream = order[turn]
  q_start = queue[q_stream] + (slot - begin[turn]) * length
  taken = jnp.zeros_like(waiting).at[order].set(jnp.clip(batch - begin, 0, waiting[order]))

  valid = jnp.where(mine, jnp.maximum(0, replay.count - oldest - length + 1), 0)
  valid_ends = jnp.cumsum(valid)
  draw = jax.random.randint(key, (batch,), 0, jnp.maximum(1, valid_ends[-1]))
  u_stream = jnp.minimum(jnp.searchsorted(valid_ends, draw, side="right"), len(ends) - 1)
  u_start = oldest[u_stream] + draw - (valid_ends - valid)[u_stream]

  stream = jnp.where(from_queue, q_stream, u_stream)
  start = jnp.where(from_queue, q_start, u_start)
  at = (start[:, None] + jnp.arange(length)) % capacity
  out = jax.tree.map(lambda d: d[stream[:, None], at], replay.data)
  last = out.last.at[:, :-1].set(out.last[:, :-1] | out.first[:, 1:])
  first = out.first.at[:, 0].set(True)
  drawn = out._replace(first=first, last=last, stoch=out.stoch.astype(jnp.int32))
  queue = queue if only is not None else jnp.where(taken > 0, queue, replay.queue)
  return replay._replace(queue=queue + taken * length), drawn, (stream, start)


def refresh(
  replay: Replay,
  address: Address,
  latents: tuple[Shaped[Array, "batch steps deter"], Int[Array, "batch steps variables"]],
) -> Replay:
  """Overwrites the stored latents of records 1.. of each window with freshly computed ones, evicted
  records apart.

  Args:
    replay: that the windows were drawn from.
    address: as `sample` returned it.
    latents: deter and stoch of records 1..T of each window.
  """
  capacity = replay.data.reward.shape[1]
  stream, start = address
  deter, stoch = latents
  number = start[:, None] + 1 + jnp.arange(deter.shape[1])
  alive = number >= (replay.count - capacity)[stream][:, None]
  slot = jnp.where(alive, number % capacity, capacity)
  write = lambda d, x: d.at[stream[:, None], slot].set(x.astype(d.dtype), mode="drop")
  data = replay.data
  return replay._replace(
    data=data._replace(deter=write(data.deter, deter), stoch=write(data.stoch, stoch))
  )
