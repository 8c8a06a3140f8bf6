"""The replay against plain Python deques. Every record carries its stream and its absolute number
in `obs`.
"""

import collections

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl.dreamer import replay as replay_lib
from mjx_cl.dreamer.replay import Record

ENVS, CAPACITY, LENGTH, CHUNK, BATCH = 3, 20, 5, 8, 4
add = jax.jit(replay_lib.add)
sample = jax.jit(replay_lib.sample, static_argnums=(2, 3))
refresh = jax.jit(replay_lib.refresh)


def empty():
  return replay_lib.init(ENVS, CAPACITY, obs_size=2, act_size=2, deter=4, stoch=3)


def make_records(rng, numbers):
  """Records (ENVS, n) whose obs is (stream, number); `numbers` (ENVS, n)."""
  shape = numbers.shape
  n = lambda *size: rng.standard_normal(shape + size).astype(np.float32)
  flag = lambda p: rng.random(shape) < p
  obs = np.stack([np.broadcast_to(np.arange(ENVS)[:, None], shape), numbers], -1).astype(np.float32)
  return Record(
    obs,
    n(2),
    n(),
    flag(0.2),
    flag(0.1),
    flag(0.1),
    n(4),
    rng.integers(0, 256, shape + (3,)).astype(np.uint8),
    n(2),
    flag(0.5),
  )


def filled(chunks, seed=0, keep=0.8):
  """A replay after some chunks with random gaps, and its model: per stream a deque of (number,
  record) and the count.
  """
  rng, replay = np.random.default_rng(seed), empty()
  model, count = [collections.deque(maxlen=CAPACITY) for _ in range(ENVS)], np.zeros(ENVS, int)
  for _ in range(chunks):
    kept = rng.random((ENVS, CHUNK)) < keep
    records = make_records(rng, count[:, None] + np.cumsum(kept, 1) - 1)
    replay = add(replay, jax.tree.map(jnp.asarray, records), jnp.asarray(kept))
    for e in range(ENVS):
      for i in np.flatnonzero(kept[e]):
        model[e].append((count[e], jax.tree.map(lambda x: x[e, i], records)))
        count[e] += 1
  return replay, model, count


def valid_starts(model):
  return {(e, rows[i][0]) for e, rows in enumerate(model) for i in range(len(rows) - LENGTH + 1)}


def starts(address):
  return list(zip(*(np.asarray(x).tolist() for x in address)))


def queue_off(replay):
  return replay._replace(queue=replay.count)


@pytest.mark.parametrize(
  "chunks", [1, 2, 9]
)  # below the capacity, at its edge, wrapped several times
def test_windows_equal_the_model(chunks):
  replay, model, count = filled(chunks)
  np.testing.assert_array_equal(replay.count, count)
  assert int(replay_lib.windows(replay, LENGTH)) == len(valid_starts(model))
  for seed in range(10):
    replay, batch, address = sample(replay, jax.random.key(seed), BATCH, LENGTH)
    for row, (e, start) in enumerate(starts(address)):
      assert (e, start) in valid_starts(model)
      want = dict(model[e])
      for i in range(LENGTH):
        record, got = want[start + i], jax.tree.map(lambda x: np.asarray(x)[row, i], batch)
        np.testing.assert_array_equal(got.obs, [e, start + i])
        for name in ("action", "reward", "terminal", "demo", "has_demo", "stoch"):
          np.testing.assert_array_equal(getattr(got, name), getattr(record, name))
        np.testing.assert_array_equal(got.deter, record.deter.astype(np.float16))
        assert got.first == (record.first or i == 0)
        assert got.last == (record.last or (i + 1 < LENGTH and want[start + i + 1].first))


def test_types_out():
  _, batch, _ = sample(filled(2)[0], jax.random.key(0), BATCH, LENGTH)
  assert (
    batch.stoch.dtype == jnp.int32
    and batch.deter.dtype == jnp.float16
    and batch.obs.dtype == jnp.float32
  )
  assert (
    batch.first.dtype == batch.last.dtype == batch.terminal.dtype == batch.has_demo.dtype == bool
  )
  assert int(batch.stoch.max()) > 127  # indices are unsigned


def test_uniform_over_all_windows():
  replay, model, _ = filled(9)
  draws = 20_000
  _, _, address = sample(queue_off(replay), jax.random.key(0), draws, LENGTH)
  times, valid = collections.Counter(starts(address)), valid_starts(model)
  assert set(times) == valid  # each is reached and nothing else is
  mean = draws / len(valid)
  assert max(abs(n - mean) for n in times.values()) < 5 * np.sqrt(
    mean
  )  # 5 standard deviations of a count


def test_streams_weigh_by_their_windows():
  replay = empty()
  kept = np.arange(CHUNK) < np.array([[8], [6], [3]])  # 4, 2 and 0 windows of 5
  numbers = np.broadcast_to(np.arange(CHUNK), (ENVS, CHUNK))
  replay = add(
    replay,
    jax.tree.map(jnp.asarray, make_records(np.random.default_rng(0), numbers)),
    jnp.asarray(kept),
  )
  _, _, address = sample(queue_off(replay), jax.random.key(0), 20_000, LENGTH)
  times = np.bincount(np.asarray(address[0]), minlength=ENVS)
  assert times[2] == 0 and abs(times[0] / 20_000 - 2 / 3) < 5 * np.sqrt(
    2 / 9 / 20_000
  )  # 5 standard deviations


# ---- online queue --------------------------------------------------------------------------------


def drawn_in_order(replay, calls):
  out = []
  for i in range(calls):
    replay, _, address = sample(replay, jax.random.key(i), BATCH, LENGTH)
    out += starts(address)
  return replay, out


def serves_fresh_windows_first(replay, model, calls=4):
  """True where the first draws are every non-overlapping window exactly once, oldest first in each
  stream.
  """
  waiting = [[rows[i][0] for i in range(0, len(rows) - LENGTH + 1, LENGTH)] for rows in model]
  total = sum(map(len, waiting))
  assert 0 < total < calls * BATCH
  _, drawn = drawn_in_order(replay, calls)
  return all(
    [n for e, n in drawn[:total] if e == stream] == numbers
    for stream, numbers in enumerate(waiting)
  )


@pytest.mark.parametrize("chunks", [2, 9])  # nothing evicted; unseen records evicted
def test_queue_serves_each_fresh_window_once(chunks):
  replay, model, _ = filled(chunks)
  assert serves_fresh_windows_first(replay, model)
  assert not serves_fresh_windows_first(
    queue_off(replay), model
  )  # the check notices a queue that is off


def test_no_stream_of_the_queue_waits_for_ever():
  """Half of what each chunk adds is drawn: a train ratio below 1."""
  rng, replay, drawn = np.random.default_rng(0), empty(), []
  for i in range(20):
    numbers = np.broadcast_to(i * CHUNK + np.arange(CHUNK), (ENVS, CHUNK))
    records = jax.tree.map(jnp.asarray, make_records(rng, numbers))
    replay = add(replay, records, jnp.ones((ENVS, CHUNK), bool))
    replay, _, address = replay_lib.sample(replay, jax.random.key(i), 2, LENGTH)
    drawn += starts(address)
  share = np.bincount([stream for stream, _ in drawn], minlength=ENVS) / len(drawn)
  assert (share > 0.25).all(), share  # a third each


def test_queue_goes_on_where_it_stopped():
  replay, model, count = filled(2, keep=1.0)
  replay, first = drawn_in_order(replay, 4)
  np.testing.assert_array_equal(
    replay.queue, count // LENGTH * LENGTH
  )  # 15 of 16 records are served, the 16th waits for its window
  fresh = make_records(
    np.random.default_rng(1), np.broadcast_to(16 + np.arange(CHUNK), (ENVS, CHUNK))
  )
  replay = add(replay, jax.tree.map(jnp.asarray, fresh), jnp.ones((ENVS, CHUNK), bool))
  _, second = drawn_in_order(replay, 1)
  assert set(first[:9]) == {(e, n) for e in range(ENVS) for n in (0, 5, 10)} and second[:3] == [
    (e, 15) for e in range(ENVS)
  ]


# ---- latent refresh ------------------------------------------------------------------------------


def test_refresh_writes_the_right_records_and_skips_evicted_ones():
  replay, model, count = filled(3, keep=1.0)  # numbers 4..23 are held
  address = (jnp.array([0, 2]), jnp.array([5, 19]))
  fresh = make_records(
    np.random.default_rng(1), np.broadcast_to(24 + np.arange(CHUNK), (ENVS, CHUNK))
  )
  held = add(
    replay,
    jax.tree.map(jnp.asarray, fresh),
    jnp.asarray(np.arange(CHUNK) < np.array([[4], [0], [0]])),
  )  # stream 0 holds 8..27
  deter, stoch = (
    10 + jnp.arange(2 * 4 * 4.0).reshape(2, 4, 4),
    (100 + jnp.arange(2 * 4 * 3)).reshape(2, 4, 3),
  )
  new = refresh(held, address, (deter, stoch))
  want_deter, want_stoch = np.array(held.data.deter), np.array(held.data.stoch)
  for row, (e, start) in enumerate(starts(address)):
    for i in range(4):
      if start + 1 + i >= int(held.count[e]) - CAPACITY:
        slot = (start + 1 + i) % CAPACITY
        want_deter[e, slot], want_stoch[e, slot] = deter[row, i], stoch[row, i]
  assert (
    np.sum(want_deter != np.asarray(held.data.deter)) == (2 + 4) * 4
  )  # 6 and 7 of stream 0 are gone
  np.testing.assert_array_equal(new.data.deter, want_deter)
  np.testing.assert_array_equal(new.data.stoch, want_stoch)
  rest = lambda r: r.data._replace(deter=0, stoch=0)
  assert all(
    np.array_equal(a, b) for a, b in zip(jax.tree.leaves(rest(new)), jax.tree.leaves(rest(held)))
  )


def test_refreshed_latents_are_sampled_again():
  replay, _, _ = filled(2, keep=1.0)
  replay, batch, address = sample(replay, jax.random.key(0), BATCH, LENGTH)
  replay = refresh(replay, address, (batch.deter[:, 1:] * 0 + 0.5, batch.stoch[:, 1:] * 0 + 7))
  _, again, _ = sample(
    replay._replace(queue=jnp.zeros(ENVS, jnp.int32)), jax.random.key(1), BATCH, LENGTH
  )  # the queue serves the same windows
  assert np.all(np.asarray(again.deter[:, 1:]) == 0.5) and np.all(
    np.asarray(again.stoch[:, 1:]) == 7
  )
  np.testing.assert_array_equal(
    again.deter[:, 0], batch.deter[:, 0]
  )  # the context's latent is another update's


# ---- the rest ------------------------------------------------------------------------------------


def test_left_out_records_change_nothing():
  replay, _, _ = filled(3)
  records = make_records(np.random.default_rng(1), np.zeros((ENVS, CHUNK), int))
  same = add(replay, jax.tree.map(jnp.asarray, records), jnp.zeros((ENVS, CHUNK), bool))
  assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(same), jax.tree.leaves(replay)))


def test_clear_forgets():
  replay = replay_lib.clear(filled(9)[0])
  assert (
    int(replay_lib.windows(replay, LENGTH)) == 0
    and not np.any(replay.count)
    and not np.any(replay.queue)
  )
  records = make_records(np.random.default_rng(1), np.broadcast_to(np.arange(CHUNK), (ENVS, CHUNK)))
  replay = add(replay, jax.tree.map(jnp.asarray, records), jnp.ones((ENVS, CHUNK), bool))
  assert int(replay_lib.windows(replay, LENGTH)) == ENVS * (CHUNK - LENGTH + 1)
  _, batch, _ = sample(queue_off(replay), jax.random.key(0), 20_000, LENGTH)
  assert set(np.unique(batch.obs[..., 1])) == set(range(CHUNK))  # no old record is left in a window


def test_record_bytes_is_what_init_allocates():
  replay = empty()
  size = sum(x.nbytes for x in jax.tree.leaves(replay.data)) / (ENVS * CAPACITY)
  assert replay_lib.record_bytes(2, 2, 4, 3) == size


def test_vmap_over_seeds_equals_a_loop():
  replays = [filled(3, seed)[0] for seed in range(2)]
  keys = jax.random.split(jax.random.key(0), 2)
  many = jax.vmap(lambda r, k: replay_lib.sample(r, k, BATCH, LENGTH))(
    jax.tree.map(lambda *x: jnp.stack(x), *replays), keys
  )
  for i in range(2):
    one = sample(replays[i], keys[i], BATCH, LENGTH)
    assert all(np.array_equal(a[i], b) for a, b in zip(jax.tree.leaves(many), jax.tree.leaves(one)))
