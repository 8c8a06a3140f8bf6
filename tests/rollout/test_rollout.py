"""The one scan: against a plain Python loop over single streams, resets, action repeat and replay
records.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl import envs, faults
from mjx_cl.rollout.scan import Rollout, Row, nest, records, start

SEVERITY, ONSET, TARGET = (
  0.5,
  7,
  3,
  # the fault of every stream: half a left hip from step 7 on, the second of its decision at repeat
  # 2
)


def streams_of(env, agent, fault, groups, members, seed=0):
  keys = jax.random.split(jax.random.key(seed), (groups, members))
  return nest(lambda key: start(env, agent, fault, key, SEVERITY, ONSET, target=TARGET), 0, 0)(keys)


def python_loop(env, act, step, params, stream, length, repeat):
  """One stream: no scan, no vmap, no `where`; the fault is written out. Returns the last physics
  state and the rows' fields as lists.
  """
  rows, state, carry, obs, episode, t, first = [], stream.env, stream.agent, stream.obs, 0, 0, True
  blank = carry
  while len(rows) < length:
    key = jax.random.fold_in(stream.key, t)
    carry, action = act(params, carry, obs, jax.random.split(jax.random.fold_in(key, 0))[0])
    rewards, done = [], False
    for k in range(repeat):
      if done:
        rewards.append(0.0)
        continue
      gear = np.array(env.model.mj["actuator_gear"])
      gear[TARGET] *= 1 - SEVERITY * (t + k >= ONSET)
      state, out = step(env.model._replace(mj={"actuator_gear": gear}), state, action)
      rewards.append(float(out.reward))
      done = bool(out.terminated | out.truncated)
    t += repeat
    rows.append(
      dict(
        obs=obs,
        first=first,
        action=action,
        deter=carry.deter,
        reward=sum(rewards),
        rewards=rewards,
        final_obs=out.final_obs,
        terminated=bool(out.terminated),
        truncated=bool(out.truncated),
        episode=episode,
      )
    )
    obs, first = out.obs, done
    if done:
      state, obs = env.init(env.model, jax.random.fold_in(jax.random.fold_in(stream.key, t), 2))
      carry, episode = blank, episode + 1
  return state, {name: np.array([np.asarray(row[name]) for row in rows]) for name in rows[0]}


def at(tree, *index):
  return jax.tree.map(lambda x: x[index], tree)


# ---- two groups of three, action repeat 1 --------------------------------------------------------


@pytest.fixture(scope="module")
def plain(short_walker, tiny, tiny_params):
  """(run, first streams, last streams, rows of 16 decisions); `run` makes two chunks of 8, which
  must join without a seam.
  """
  fault = faults.make("gear", short_walker)
  roll = Rollout(short_walker, tiny, fault)
  begin = streams_of(short_walker, tiny, fault, 2, 3)

  def run(streams):
    streams, a = roll.chunk(tiny_params, streams, length=8)
    streams, b = roll.chunk(tiny_params, streams, length=8)
    return streams, jax.tree.map(lambda x, y: jnp.concatenate([x, y]), a, b)

  return run, begin, *run(begin)


def test_shapes_are_time_major(plain, tiny):
  *_, rows = plain
  assert (
    rows.obs.shape == (16, 2, 3, 24)
    and rows.action.shape == (16, 2, 3, 6)
    and rows.rewards.shape == (16, 2, 3, 1)
  )
  assert rows.stoch.shape == (16, 2, 3, tiny.size.stoch) and rows.deter.shape == (
    16,
    2,
    3,
    tiny.size.deter,
  )
  assert rows.reward.shape == rows.severity.shape == rows.truncated.shape == (16, 2, 3)


def test_same_key_twice_gives_equal_bits(plain, same, short_walker, tiny):
  run, begin, end, rows = plain
  assert same(run(begin), (end, rows))
  _, other = run(streams_of(short_walker, tiny, faults.make("gear", short_walker), 2, 3, seed=1))
  assert not np.isclose(other.action, rows.action).any()
  assert (
    len(np.unique(np.asarray(rows.action).reshape(-1, 6)[:, 0])) == 16 * 6
  )  # streams of one batch differ too


def test_agrees_with_a_python_loop_over_single_streams(plain, short_walker, tiny, tiny_params):
  _, begin, _, rows = plain
  act, step = jax.jit(tiny.act), jax.jit(short_walker.step)
  for g, m in [(0, 0), (0, 2), (1, 1)]:
    _, want = python_loop(short_walker, act, step, at(tiny_params, g), at(begin, g, m), 16, 1)
    for name, value in want.items():
      got = np.asarray(getattr(rows, name))[:, g, m]
      if got.dtype == bool or name == "episode":
        np.testing.assert_array_equal(got, value)
      else:  # rounding of batched products, which 16 steps of physics amplify; measured: 1.9e-6
        np.testing.assert_allclose(got, value, atol=1e-4, err_msg=name)


def test_autoreset(plain, short_walker):
  _, begin, end, rows = plain
  rows = jax.tree.map(np.asarray, rows)
  t = np.arange(16)
  np.testing.assert_array_equal(
    rows.truncated, np.broadcast_to((t == 11)[:, None, None], (16, 2, 3))
  )  # episodes of 12
  np.testing.assert_array_equal(
    rows.first, np.broadcast_to(((t == 0) | (t == 12))[:, None, None], (16, 2, 3))
  )
  np.testing.assert_array_equal(rows.episode, np.broadcast_to((t >= 12)[:, None, None], (16, 2, 3)))
  assert not rows.terminated.any()
  inside = ~rows.first[1:]
  np.testing.assert_array_equal(rows.obs[1:][inside], rows.final_obs[:-1][inside])
  np.testing.assert_array_equal(rows.reward_in[1:][inside], rows.reward[:-1][inside])
  np.testing.assert_array_equal(rows.reward_in[rows.first], 0)
  assert (
    rows.reward[11] > 0
    # the reward of the last step of an episode is in its row, though no row carries it as reward_in
  ).all()
  fresh, ended = rows.obs[12], rows.final_obs[11]
  np.testing.assert_array_equal(fresh[..., 15:], 0)  # no speed
  np.testing.assert_array_equal(fresh[..., 14], np.float32(1.3))  # torso height of a reset [m]
  assert (np.abs(ended[..., 15:]).max(-1) > 0.1).all()
  assert (
    len(np.unique(fresh[..., 0])) == 6 and not (fresh == rows.obs[0]).all(-1).any()
  )  # every reset draws its own posture
  np.testing.assert_array_equal(end.t, 16)
  np.testing.assert_array_equal(end.env.step, 4)
  np.testing.assert_array_equal(end.episode, 1)
  np.testing.assert_array_equal(end.obs, rows.final_obs[-1])
  np.testing.assert_array_equal(jax.random.key_data(end.key), jax.random.key_data(begin.key))


# ---- action repeat -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def repeated(tiny, tiny_params):
  """Action repeat 2, episodes of 5 control steps (so that one ends inside a decision), and a
  demonstrator that drives the first robot.
  """
  env = envs.make("walker", "native")
  env.spec = env.spec._replace(episode_steps=5)
  fault = faults.make("gear", env)
  roll = Rollout(
    env, tiny, fault, repeat=2, expert=lambda stream: jnp.tanh(stream.obs[:6] + stream.obs[15:21])
  )
  begin, params = streams_of(env, tiny, fault, 1, 2), at(tiny_params, slice(0, 1))
  end, rows = roll.chunk(params, begin, length=8, drive=jnp.array([[True, False]]))
  return env, params, begin, end, jax.tree.map(np.asarray, rows)


def test_repeat_sums_rewards_and_advances_the_clock(repeated):
  _, _, _, end, rows = repeated
  assert rows.rewards.shape == (8, 1, 2, 2)
  np.testing.assert_allclose(
    rows.reward, rows.rewards.sum(-1), rtol=1e-6
  )  # XLA may fuse the sum with a product
  np.testing.assert_array_equal(end.t, 16)
  np.testing.assert_array_equal(
    rows.truncated[:, 0, 0], np.arange(8) % 3 == 2
  )  # 5 steps: two decisions and a half
  np.testing.assert_array_equal(rows.rewards[2::3, ..., 1], 0)  # nothing is earned after the end
  assert (rows.rewards[[0, 1, 3, 4]] > 0).all()
  np.testing.assert_array_equal(
    rows.severities[:, 0, 1].ravel(), np.where(np.arange(16) >= ONSET, np.float32(SEVERITY), 0)
  )  # each control step's own
  np.testing.assert_array_equal(rows.severity, rows.severities[..., -1])


def test_repeat_equals_two_steps_with_the_same_action(repeated, tiny):
  env, params, begin, _, rows = repeated
  _, want = python_loop(
    env, jax.jit(tiny.act), jax.jit(env.step), at(params, 0), at(begin, 0, 1), 8, 2
  )
  for name, value in want.items():
    np.testing.assert_allclose(
      getattr(rows, name)[:, 0, 1], value, atol=1e-4, err_msg=name
    )  # as the loop of repeat 1


def test_repeat_equals_two_physics_steps_bit_for_bit(repeated):
  """From the recorded actions, so that no rounding of the agent comes between."""
  env, _, begin, end, rows = repeated
  step, state, t = jax.jit(env.step), at(begin.env, 0, 1), 0
  for action, over in zip(rows.action[:, 0, 1], rows.truncated[:, 0, 1]):
    for k in range(2 - over):  # an episode of 5 ends with half a decision
      gear = np.array(env.model.mj["actuator_gear"])
      gear[TARGET] *= 1 - SEVERITY * (t + k >= ONSET)
      state, out = step(env.model._replace(mj={"actuator_gear": gear}), state, action)
    assert bool(out.truncated) == over
    t += 2
    if over:
      state, _ = env.init(env.model, jax.random.fold_in(jax.random.fold_in(begin.key[0, 1], t), 2))
  np.testing.assert_array_equal(state.physics, end.env.physics[0, 1])
  assert int(state.step) == int(end.env.step[0, 1])


def test_a_demonstrator_drives_the_robots_it_is_given(repeated):
  *_, rows = repeated
  demo = np.tanh(rows.obs[..., :6] + rows.obs[..., 15:21])
  np.testing.assert_allclose(rows.demo, demo, atol=1e-6)  # float32 tanh
  assert rows.has_demo.all()
  np.testing.assert_array_equal(
    rows.action[:, 0, 0], rows.demo[:, 0, 0]
  )  # deviation 0: the very action
  assert not np.isclose(rows.action[:, 0, 1], rows.demo[:, 0, 1]).all(-1).any()


# ---- records -------------------------------------------------------------------------------------


def toy_rows():
  """Five decisions of one group of two streams: the first is truncated at decision 1, the second
  terminates at decision 3.
  """
  ids = np.arange(10, dtype=np.float32).reshape(5, 1, 2)
  end = np.zeros((5, 1, 2), bool)
  truncated, terminated = end.copy(), end.copy()
  truncated[1, 0, 0], terminated[3, 0, 1] = True, True
  first = end.copy()
  first[0], first[2, 0, 0], first[4, 0, 1] = True, True, True
  wide = lambda x, n: np.repeat(x[..., None], n, -1)
  return Row(
    obs=wide(ids, 3),
    first=first,
    reward_in=ids + 0.25,
    action=wide(ids + 0.5, 2),
    deter=wide(ids + 1, 4),
    stoch=wide(ids, 2).astype(int) + 1,
    reward=ids + 100,
    rewards=wide(ids + 100, 1),
    final_obs=wide(ids + 1000, 3),
    terminated=terminated,
    truncated=truncated,
    severity=ids,
    episode=end.astype(int),
    demo=wide(ids + 7, 2),
    has_demo=~end,
  )


def test_shaken_robots_follow_one_random_action_for_a_stretch(
  short_walker, tiny, tiny_params, plain
):
  """Probability 0 changes no bit, 1 gives constant actions over 16 control steps that differ from
  stretch to stretch and robot to robot.
  """
  roll = Rollout(short_walker, tiny, faults.make("gear", short_walker))
  begin = streams_of(short_walker, tiny, roll.fault, 2, 3)
  shake = np.zeros((2, 3), np.float32)
  shake[1, 1:] = 1.0
  _, rows = roll.chunk(tiny_params, begin, length=40, shake=shake)
  _, calm = roll.chunk(tiny_params, begin, length=40, shake=np.zeros((2, 3), np.float32))
  action, quiet = np.asarray(rows.action), np.asarray(calm.action)
  _, _, _, unshaken = plain
  still = shake == 0
  np.testing.assert_array_equal(action[:, still], quiet[:, still])
  np.testing.assert_allclose(
    quiet[:16], np.asarray(unshaken.action), atol=1e-5
  )  # another program of the same arithmetic
  pushed = action[:, ~still]  # (40, 2, act)
  assert np.abs(pushed).max() <= 1.0
  stretches = [pushed[k : k + 16] for k in (0, 16, 32)]
  for stretch in stretches:
    assert np.all(stretch == stretch[0])
  draws = np.concatenate([stretch[0] for stretch in stretches])
  assert len(np.unique(draws, axis=0)) == 6 and draws.std() > 0.3
  assert np.abs(quiet[:, ~still] - pushed).max() > 0.1


def test_records_of_decisions_and_of_ends():
  rows = toy_rows()
  made, valid = records(rows)
  made = jax.tree.map(np.asarray, made)
  assert valid.shape == (1, 2, 10) and made.obs.shape == (1, 2, 10, 3)
  for member, end in ((0, 1), (1, 3)):
    rec, exists = jax.tree.map(lambda x: x[0, member], made), np.asarray(valid[0, member])
    np.testing.assert_array_equal(
      np.flatnonzero(exists), sorted([0, 2, 4, 6, 8, 2 * end + 1])
    )  # 2 records for the decision that ends
    rec = jax.tree.map(lambda x: x[exists], rec)
    acts = np.delete(np.arange(6), end + 1)  # the end's record follows the decision's own
    for name, source in [
      ("obs", rows.obs),
      ("action", rows.action),
      ("reward", rows.reward_in),
      ("first", rows.first),
      ("deter", rows.deter),
      ("stoch", rows.stoch),
      ("demo", rows.demo),
      ("has_demo", rows.has_demo),
    ]:
      np.testing.assert_array_equal(getattr(rec, name)[acts], source[:, 0, member], err_msg=name)
    last = jax.tree.map(lambda x: x[end + 1], rec)
    np.testing.assert_array_equal(last.obs, rows.final_obs[end, 0, member])
    assert last.reward == rows.reward[end, 0, member]
    for name in ("action", "deter", "stoch", "demo"):
      np.testing.assert_array_equal(getattr(last, name), 0, err_msg=name)
    assert not last.first and not last.has_demo
    np.testing.assert_array_equal(rec.last, np.arange(6) == end + 1)
    np.testing.assert_array_equal(
      rec.terminal, (np.arange(6) == end + 1) & (member == 1)
    )  # the value of a truncated episode goes on


def test_records_of_a_rollout(plain):
  *_, rows = plain
  made, valid = records(rows)
  assert valid.shape == (2, 3, 32)
  np.testing.assert_array_equal(valid.sum(-1), 17)  # 16 decisions and one end
  kept = jax.tree.map(lambda x: np.asarray(x[1, 2])[np.asarray(valid[1, 2])], made)
  np.testing.assert_array_equal(np.flatnonzero(kept.last), [12])
  np.testing.assert_array_equal(np.flatnonzero(kept.first), [0, 13])
  assert not kept.terminal.any() and not kept.action[12].any()
  np.testing.assert_array_equal(kept.obs[12], np.asarray(rows.final_obs)[11, 1, 2])
  np.testing.assert_array_equal(
    kept.reward[1:13], np.asarray(rows.reward)[:12, 1, 2]
  )  # every reward is in the record of arriving


def test_a_neighbours_reset_leaves_a_robots_noise_alone():
  """A car's lidar noise comes from a key in its state: the same life alone and beside a car that
  crashes.
  """
  from mjx_cl import envs
  from mjx_cl.envs import adapters

  env = envs.make("car")
  agent, none = adapters.Puppet(2, 1.0), faults.none(env)
  rollout = Rollout(env, agent, none)
  keys = jax.vmap(jax.random.key)(jnp.arange(16))
  live = lambda keys: rollout.chunk(
    {"p": jnp.zeros(1)}, nest(lambda k: start(env, agent, none, k), 0, 0)(keys[None]), 200
  )[1]
  rows = live(keys)
  done = np.asarray(rows.terminated)[:, 0]
  ends = np.where(done.any(0), done.argmax(0), 200)
  last = int(ends.argmax())
  assert ends.min() + 10 < ends[last]  # a neighbour crashed well before
  alone = live(keys[last : last + 1])
  # another batch size sums in another order (1e-5); the lidar's noise is 1e-3 of its range
  np.testing.assert_allclose(
    np.asarray(rows.final_obs)[: ends[last], 0, last],
    np.asarray(alone.final_obs)[: ends[last], 0, 0],
    atol=1e-4,
  )
