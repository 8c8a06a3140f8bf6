"""Convergence against a NumPy loop, the phase machine on scripted signals, and the loop that joins
them on hand-made rows.
"""

import dataclasses
import functools
import types
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick

from mjx_cl.adapt import decide as phase_lib
from mjx_cl.adapt import watch
from mjx_cl.adapt.decide import (
  ABORT_BELOW,
  ABORT_BUDGET,
  ABORT_HOPELESS,
  ABORTED,
  ADAPTING,
  CONVERGED,
  NOMINAL,
  SIGNALS,
  START,
  STOP,
  settled,
)
from mjx_cl.adapt.loop import Loop, choices
from mjx_cl.adapt.state import LATER, ROWS, cut, glue
from mjx_cl.config import PRESETS, AdaptConfig
from mjx_cl.detectors import Alarm, Detector
from mjx_cl.dreamer import behaviour
from mjx_cl.dreamer.agent import Agent
from mjx_cl.errors import UserError
from mjx_cl.rollout.monitor import Monitor
from mjx_cl.rollout.scan import Row

CHUNK = 64
# settles after 4 chunks; no settling in sight after 20, tried for a third of that; 40 chunks at
# most. Levels are given, so that the tests do
# not depend on how the defaults are tuned
SMALL = AdaptConfig(
  patience=4,
  trend=0.25,
  fluctuation=0.5,
  excess=2.0,
  near=1.5,
  least=1,
  give_up=20 * CHUNK,
  budget=40 * CHUNK,
  warmup=2 * CHUNK,
)
LEVEL = np.array([1.0, 0.1, 0.8, 2.0, 0.5, 3.0])  # quiet signals in the order of SIGNALS


# ---- convergence ---------------------------------------------------------------------------------


def slow_settled(rows, mean, std, c):
  """The docstring in NumPy for rows in order of time, one signal at a time."""
  out, half = [], len(rows) // 2
  for k in range(6):
    x = rows[:, k]
    level, trend = np.nanmedian(x), abs(np.nanmedian(x[half:]) - np.nanmedian(x[:half]))
    low, high = np.nanquantile(x, [0.25, 0.75])
    steady = trend <= c.trend * abs(level) and (high - low) / 1.349 <= max(
      c.fluctuation * abs(level), c.excess * std[k]
    )
    out.append(steady or (k < 2 and level <= c.near * mean[k]))
  return np.array(out)


def check_settled(rows, mean, std, config=SMALL):
  """`settled` in every rotation of the ring equals the loop; returns it."""
  size = len(rows)
  run = jax.jit(
    lambda ring, count: settled(ring, count, jnp.asarray(mean), jnp.asarray(std), config)
  )
  want = slow_settled(rows, mean, std, config)
  for count in range(size, 2 * size):
    ring = np.roll(rows, count, axis=0)  # the oldest row lies in slot count mod size
    np.testing.assert_array_equal(run(jnp.asarray(ring, jnp.float32), count), want)
  assert not np.asarray(run(jnp.asarray(rows, jnp.float32), size - 1)).any()  # not full yet
  return want


def test_flat_signals_have_settled():
  assert check_settled(np.tile(LEVEL, (8, 1)), LEVEL, 0 * LEVEL).all()


@pytest.mark.parametrize("signal", range(6))
def test_a_trend_is_not_settled(signal):
  rows = np.tile(LEVEL, (8, 1))
  rows[:, signal] *= np.linspace(
    1.6, 2.4, 8
  )  # halves differ by 0.46 of a level of 2: 0.23, within 0.25
  assert check_settled(rows, LEVEL, 0 * LEVEL).all()
  rows[:, signal] = LEVEL[signal] * np.linspace(1.5, 2.5, 8)  # 0.29
  assert list(np.flatnonzero(~check_settled(rows, LEVEL, 0 * LEVEL))) == [signal]


@pytest.mark.parametrize("signal", range(6))
def test_a_fluctuation_is_judged_by_level_and_nominal_deviation(signal):
  rows = np.tile(LEVEL, (8, 1))
  rows[::2, signal], rows[1::2, signal] = (
    3.2 * LEVEL[signal],
    0.8 * LEVEL[signal],
  )  # quartiles 2.4 apart at a level of 2: 0.89
  assert list(np.flatnonzero(~check_settled(rows, LEVEL, 0 * LEVEL))) == [signal]
  assert check_settled(
    rows, LEVEL, 0.95 * LEVEL
  ).all()  # a signal that fluctuates as much on the healthy robot may


@pytest.mark.parametrize("signal", range(6))
def test_one_stumble_does_not_unsettle(signal):
  rows = np.tile(LEVEL, (8, 1))
  rows[3, signal] *= 100.0
  assert check_settled(rows, LEVEL, 0 * LEVEL).all()


def test_residuals_near_their_nominal_mean_have_settled_whatever_they_do():
  rows = np.tile(LEVEL, (8, 1))
  rows[:, :3] = LEVEL[:3] * np.array([0.1, 2.0] * 4)[:, None] * np.linspace(0.5, 1.5, 8)[:, None]
  assert list(check_settled(rows, LEVEL, 0 * LEVEL)) == [True, True, False, True, True, True]
  assert list(check_settled(rows, 0.1 * LEVEL, 0 * LEVEL)) == [
    False,
    False,
    False,
    True,
    True,
    True,
  ]


def test_nan_rows_are_left_out():
  rows = np.tile(LEVEL, (8, 1))
  rows[2, :2] = np.nan
  assert check_settled(rows, 0 * LEVEL, 0 * LEVEL).all()
  rows[4:, 0] = np.nan  # half of a signal unknown: no trend can be told
  assert list(
    np.flatnonzero(~np.asarray(settled(jnp.asarray(rows), 8, 0 * LEVEL, 0 * LEVEL, SMALL)))
  ) == [0]


@pytest.mark.parametrize("seed", range(5))
def test_random_rings_equal_the_loop(seed):
  rng = np.random.default_rng(seed)
  rows = LEVEL * (
    1
    + rng.normal(size=(10, 6)) * rng.uniform(0.05, 1.0, 6)
    + np.linspace(0, 1, 10)[:, None] * rng.uniform(-0.5, 0.5, 6)
  )
  rows[rng.integers(10), :2] = np.nan
  check_settled(rows, LEVEL * rng.uniform(0.3, 1.5, 6), LEVEL * rng.uniform(0, 0.4, 6))


# ---- phase machine -------------------------------------------------------------------------------


def live(signals, alarms=(), acts=True, posture=1.2, config=SMALL):
  """Runs the machine over chunks: signals (chunks, 6), alarm chunks. Acceptance 0.6, least posture
  0.9, as the walker's.

  Returns:
    (last state, phases (chunks,), decisions (chunks,)).
  """
  signals = jnp.asarray(signals, jnp.float32)
  chunks = len(signals)
  now = (jnp.arange(chunks) + 1) * CHUNK
  alarm = jnp.isin(jnp.arange(chunks), jnp.asarray(list(alarms) or [-1]))

  def step(state, x):
    signals, now, alarm, posture = x
    state, decision, _ = phase_lib.update(
      state, signals, posture, alarm, now - 10, now, jnp.bool_(acts), 0.6, 0.9, config
    )
    return state, (state.phase, decision)

  start = phase_lib.init(config)
  state, (phases, decisions) = jax.lax.scan(
    step, start, (signals, now, alarm, jnp.broadcast_to(jnp.float32(posture), chunks))
  )
  assert jax.tree.map(lambda x: (x.shape, x.dtype), state) == jax.tree.map(
    lambda x: (x.shape, x.dtype), start
  )
  return state, np.asarray(phases), np.asarray(decisions)


def quiet(chunks, **changes):
  """Flat signals; changes name one each, as a number or one value per chunk."""
  out = np.tile(LEVEL, (chunks, 1))
  for name, value in changes.items():
    out[:, SIGNALS.index(name)] = value
  return out


def happened(decisions):
  """{chunk: decision} of the chunks in which one was taken."""
  return {int(i): int(decisions[i]) for i in np.flatnonzero(decisions)}


def unsettled(chunks, level=2.0, since=6):
  """A signal that never settles, from chunk `since` on."""
  return np.where(
    np.arange(chunks) < since, level, np.where(np.arange(chunks) % 2, 0.1 * level, 5.0 * level)
  )


def test_alarm_then_convergence():
  state, phases, decisions = live(quiet(15), alarms=[5])
  assert happened(decisions) == {5: START, 9: STOP}  # chunks 6 to 9 fill the patience of 4
  assert list(phases) == [NOMINAL] * 5 + [ADAPTING] * 4 + [CONVERGED] * 6
  assert int(state.since) == 6 * CHUNK - 10


def test_a_stream_may_converge_on_a_higher_residual():
  signals = np.concatenate([quiet(6), quiet(9, opr=5.0, rpr=2.0, reward=0.61)])
  assert happened(live(signals, alarms=[5])[2]) == {5: START, 9: STOP}


@pytest.mark.parametrize("signal", SIGNALS)
def test_each_signal_holds_convergence_back(signal):
  level = LEVEL[SIGNALS.index(signal)]
  wild = np.concatenate([np.full(6, level), level * np.array([0.1, 5.0] * 4), np.full(10, level)])
  # chunk 13 is the last wild one; 14 to 17 are the first four quiet ones. The median of OPR or RPR
  # is back near nominal with two of them
  stop = 15 if signal in SIGNALS[:2] else 17
  assert happened(live(quiet(24, **{signal: wild}), alarms=[5])[2]) == {5: START, stop: STOP}


def test_least_holds_convergence_back():
  config = dataclasses.replace(SMALL, least=10 * CHUNK)
  # the alarm is 10 steps before the end of chunk 5, so that the age after chunk 5 + k is 64 k + 10:
  # 640 is reached with k = 10
  assert happened(live(quiet(20), alarms=[5], config=config)[2]) == {5: START, 15: STOP}


def test_settled_below_acceptance_aborts():
  state, phases, decisions = live(quiet(40, reward=0.3), alarms=[5])
  assert (
    happened(decisions) == {5: START, 25: ABORT_BELOW} and phases[-1] == ABORTED
  )  # give_up: 20 chunks after the alarm
  assert phase_lib.REASONS[ABORT_BELOW] == "settled below acceptance"


def test_a_robot_that_lies_has_not_recovered():
  assert happened(live(quiet(40), alarms=[5], posture=0.3)[2]) == {5: START, 25: ABORT_BELOW}
  assert happened(live(quiet(40), alarms=[5], posture=0.95)[2]) == {5: START, 9: STOP}


def test_a_chunk_that_is_hidden_tells_nothing_of_the_posture():
  """Chunks of weights that do not learn, nan: neither a low robot beside them counts as upright
  nor an upright one as low.
  """
  hidden, signals = np.arange(40) % 4 == 3, quiet(40)
  signals[hidden] = np.nan
  low, high = (np.where(hidden, np.nan, x) for x in (0.85, 0.95))
  assert happened(live(signals, alarms=[5], posture=low)[2]) == {5: START, 25: ABORT_BELOW}
  assert happened(live(signals, alarms=[5], posture=high)[2]) == {5: START, 9: STOP}


def test_no_settling_in_sight_aborts():
  decisions = live(quiet(40, reward=0.3, dyn_loss=unsettled(40)), alarms=[5])[2]
  assert happened(decisions) == {5: START, 25: ABORT_HOPELESS}
  assert phase_lib.REASONS[ABORT_HOPELESS] == "no settling in sight"


def test_progress_defers_the_abort():
  reward = np.concatenate(
    [np.full(6, 0.3), 0.05 + 0.4 * np.minimum(np.arange(50), 25) / 25]
  )  # rises until chunk 31, up to 0.45
  config = dataclasses.replace(SMALL, budget=99 * CHUNK)
  decisions = happened(
    live(quiet(56, reward=reward, dyn_loss=unsettled(56)), alarms=[5], config=config)[2]
  )
  (_, start), (chunk, abort) = decisions.items()
  # the last rise of 0.03 over the best lies in chunks 31 to 34, where the mean of four tops out; a
  # third of give_up (6 chunks) later it ends
  assert (start, abort) == (START, ABORT_HOPELESS) and 36 <= chunk <= 41


def test_what_is_good_but_unsettled_is_given_a_quarter_more():
  assert happened(live(quiet(60, dyn_loss=unsettled(60)), alarms=[5])[2]) == {
    5: START,
    30: ABORT_HOPELESS,
  }  # 25 chunks after the alarm


def test_the_budget_aborts_what_has_not_been_given_up():
  config = dataclasses.replace(SMALL, give_up=60 * CHUNK)
  for reward in (0.3, 0.8):
    assert happened(
      live(quiet(60, dyn_loss=unsettled(60), reward=reward), alarms=[5], config=config)[2]
    ) == {5: START, 45: ABORT_BUDGET}
  assert phase_lib.REASONS[ABORT_BUDGET] == "budget spent"


def test_an_alarm_in_the_warm_up_or_in_arm_none_does_nothing():
  assert happened(live(quiet(20), alarms=[0, 1])[2]) == {}  # warm-up: two chunks
  assert happened(live(quiet(20), alarms=[1, 2])[2])[2] == START
  _, phases, decisions = live(quiet(20), alarms=[5, 6, 12], acts=False)
  assert happened(decisions) == {} and (phases == NOMINAL).all()


def test_an_alarm_while_adapting_is_not_acted_on():
  state, _, decisions = live(quiet(15), alarms=[5, 6, 7])
  assert happened(decisions) == {5: START, 9: STOP} and int(state.since) == 6 * CHUNK - 10


def test_aborted_does_not_start_again():
  assert happened(live(quiet(60, reward=0.3), alarms=[5, 30, 40])[2]) == {5: START, 25: ABORT_BELOW}


def test_converged_starts_again_with_an_empty_ring():
  state, _, decisions = live(quiet(30), alarms=[5, 12])
  assert (
    happened(decisions) == {5: START, 9: STOP, 12: START, 16: STOP}
    and int(state.since) == 13 * CHUNK - 10
  )


def test_nominal_levels_come_from_before_the_alarm():
  rng = np.random.default_rng(0)
  signals = LEVEL * (1 + 0.1 * rng.normal(size=(30, 6)))
  signals[3, :2] = np.nan
  known = signals[2:10]  # after the warm-up, before the chunk of the alarm
  signals[10:] *= 7
  state = live(signals, alarms=[10])[0]
  np.testing.assert_allclose(state.mean, np.nanmean(known, 0), rtol=1e-5)  # Welford in float32
  np.testing.assert_allclose(phase_lib.nominal_std(state), np.nanstd(known, 0, ddof=1), rtol=1e-4)
  assert list(state.number) == [7, 7, 8, 8, 8, 8]


@pytest.mark.parametrize(
  "settings",
  [
    dict(patience=3),
    dict(ratio=0.0),
    dict(budget=0),
    dict(least=-1),
    dict(start_windows=0),
    dict(lr=0.0),
    dict(trend=float("nan")),
  ],
)
def test_bad_settings_are_refused(settings):
  with pytest.raises(UserError, match=next(iter(settings))):
    AdaptConfig(**settings)


# ---- loop ----------------------------------------------------------------------------------------

STEPS, CHUNKS, REFIT = 16, 12, 24  # rows of a chunk; chunks; rows of the refit
AGAIN = 40  # rows after the refit at which the scripted detector fires again
RESETS = (45, 130)
# settled as soon as the patience is full, always acceptable; 1.5 updates a chunk
EAGER = AdaptConfig(
  ratio=3.0,
  start_windows=20,
  patience=4,
  trend=1e9,
  fluctuation=1e9,
  fresh_moments=False,
  least=1,
  acceptance=-9.0,
  give_up=9999,
  budget=9999,
  warmup=20,
  refit=REFIT,
)
ALARMS = np.array(
  [[37, -1], [37, -1], [17, 100]]
)  # 17 lies before the end of the warm-up, in a chunk that outlasts it
ARMS = [("detector", 0), ("none", 1), ("detector", 2)]


class Script(NamedTuple):
  """State of a detector that fires at given rows: at (2,), count of rows, fading sum of the valid
  OPR, which tells their order.
  """

  at: jax.Array
  count: jax.Array
  total: jax.Array


def scripted():
  """A detector for tests."""

  def update(state, residual):
    fired = jnp.any(state.at == state.count)
    total = 0.5 * state.total + jnp.where(residual.valid, residual.opr, 0.0)
    return Script(state.at, state.count + 1, total), Alarm(fired, jnp.float32(0))

  return Detector(
    lambda: Script(jnp.array([REFIT + AGAIN, -1]), jnp.int32(0), jnp.float32(0)), update
  )


class Counting(Agent):
  """Costs nothing and counts how often its update is really computed. (A program with a callback is
  never cached: not for the real agent.)
  """

  calls: list = []

  def open_loop(self, params, deter, stoch, actions, key):
    return jnp.zeros(actions.shape[:2] + (self.obs_size,)), jnp.zeros(actions.shape[:2])

  def judge(self, params, slow, range_, deter, stoch, key):
    said = {"adv_mag": jnp.float32(0.5)}
    return behaviour.Behaviour(jnp.float32(0), jnp.float32(3), deter[:, 0], range_, said)

  def update(self, state, batch, key):
    jax.debug.callback(lambda: self.calls.append(1))
    return state._replace(updates=state.updates + 1), {}, (batch.deter[:, 1:], batch.stoch[:, 1:])


def hand_rows(start):
  """Rows start .. start + STEPS of three streams; obs[0] is the number of the row, final_obs[0]
  that number and a half.
  """
  rng = np.random.default_rng(start)
  shape = (STEPS, 3, 1)
  normal = lambda *more: jnp.asarray(rng.normal(size=shape + more), jnp.float32)
  number = jnp.broadcast_to(start + jnp.arange(STEPS, dtype=jnp.float32)[:, None, None], shape)
  mark = lambda x, n: x.at[..., 0].set(n)
  done, reward = jnp.isin(number, jnp.array(RESETS)), normal()
  return Row(
    mark(normal(24), number),
    jnp.isin(number - 1, jnp.array(RESETS)) | (number == 0),
    normal(),
    normal(6),
    normal(128),
    jnp.asarray(rng.integers(0, 8, shape + (8,))),
    reward,
    reward[..., None],
    mark(normal(24), number + 0.5),
    jnp.zeros(shape, bool),
    done,
    None,
    None,
    jnp.zeros(shape + (6,)),
    jnp.zeros(shape, bool),
  )


class Told(NamedTuple):
  """One chunk of the lived script: NumPy copies of the state after it and of its digest."""

  state: object
  digest: object


def small(kind=Agent):
  """An agent with short windows and dreams."""
  return kind(dataclasses.replace(PRESETS["tiny"].dreamer, batch=4, length=8, imagine=4), 24, 6)


def tell(kind, config=EAGER, used=0, block=1):
  """Lives the script with an agent of class `kind` whose optimiser state is `used` more than fresh:
  (start, [Told of each chunk]).

  block: streams that share a LoopState; one, as on a CPU: any number of them shares a program.
  """
  agent = small(kind)
  loop = Loop(
    agent,
    Monitor(agent, n=4, least=2),
    scripted(),
    types.SimpleNamespace(acceptance=0.6, posture=None),
    config,
    capacity=256,
  )
  loop.programs = quick.programs(loop)
  train = jax.jit(agent.init)(jax.random.key(0))
  # fresh heads say exactly 0, and a signal whose median is 0 has no scale to be settled on
  params = jax.tree.map(
    lambda x: x + 0.01 * jax.random.normal(jax.random.key(x.size), x.shape), train.params
  )
  state = loop.init(
    train._replace(params=params, opt=jax.tree.map(lambda x: x + used, train.opt)), 3
  )
  state = state._replace(detector=state.detector._replace(at=jnp.asarray(ALARMS)))
  keys, chosen = jax.random.split(jax.random.key(1), 3), choices(ARMS, config, CHUNKS * STEPS)
  copy = lambda tree: jax.tree.map(lambda x: np.array(x), tree)
  begin, told = copy(state), []
  blocks = [slice(g, min(g + block, 3)) for g in range(0, 3, block)]
  field = lambda name, own: cut(getattr(state, name), own, int(name in LATER))
  states = [
    jax.tree.map(jnp.array, type(state)(*(field(name, own) for name in state._fields)))
    for own in blocks
  ]
  for c in range(CHUNKS):
    rows, digests = hand_rows(c * STEPS), []
    for k, own in enumerate(blocks):
      states[k], digest = loop.digest(
        states[k], cut(rows, own, 1), jnp.int32((c + 1) * STEPS), cut(chosen, own, 0), keys[own]
      )
      digests.append(copy(digest))
    told.append(Told(glue(copy(states), LATER), glue(digests, ROWS)))
  return begin, told


@pytest.fixture(scope="module")
def story():
  """The script with a tiny agent."""
  return tell(Agent)


@pytest.mark.slow  # of lives in a run: tests/runs/test_lives.py
def test_blocks_of_streams_live_as_each_alone(story):
  """A block of two streams and one of one: the same decisions, alarms, phases and updates. Numbers
  differ by rounding alone, since XLA rounds a product by its shape, which a dozen updates make
  larger: 1e-3 of a signal, a twentieth of the largest step that an array of weights has taken.
  """
  begin, told = story
  again, blocks = tell(Agent, block=2)
  jax.tree.map(np.testing.assert_array_equal, begin, again)
  for one, other in zip(told, blocks, strict=True):
    for name in ("fired", "settled", "phase", "decision", "since", "updates", "failed"):
      np.testing.assert_array_equal(
        getattr(one.digest, name), getattr(other.digest, name), err_msg=name
      )
    same = lambda a, b: np.testing.assert_allclose(
      np.asarray(a, float), np.asarray(b, float), rtol=1e-3, atol=1e-3
    )
    jax.tree.map(
      same,
      (
        one.digest.signals,
        one.digest.residual,
        one.digest.score,
        one.state.history,
        one.state.past,
        one.state.detector,
        one.state.phase,
        one.state.owed,
      ),
      (
        other.digest.signals,
        other.digest.residual,
        other.digest.score,
        other.state.history,
        other.state.past,
        other.state.detector,
        other.state.phase,
        other.state.owed,
      ),
    )
    # obs, reward, flags and counters to the bit; latents that an update has refreshed are its own
    exact = lambda r: (
      r.count,
      r.queue,
      r.data.obs,
      r.data.action,
      r.data.reward,
      r.data.first,
      r.data.terminal,
    )
    jax.tree.map(np.testing.assert_array_equal, exact(one.state.replay), exact(other.state.replay))
    for learnt in (
      lambda t: t.state.train.params,
      lambda t: t.state.acting,
      lambda t: t.state.train.slow,
      lambda t: t.state.train.opt,
    ):  # what was learnt, against the size of it
      start = learnt(Told(begin, None))
      moved = lambda t: jax.tree.map(lambda a, b: np.asarray(a, float) - b, learnt(t), start)
      jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-7 + 0.05 * np.abs(a).max()),
        moved(one),
        moved(other),
      )


def of(tree, group):
  return jax.tree.map(lambda x: x[group], tree)


def test_loop_decisions(story):
  _, told = story
  decisions = np.stack([t.digest.decision for t in told])
  assert happened(decisions[:, 0]) == {2: START, 6: STOP, 9: START}
  assert happened(decisions[:, 1]) == {}  # arm none
  assert happened(decisions[:, 2]) == {
    6: START,
    10: STOP,
  }  # the alarm at row 17, in the warm-up, was not acted on
  fired = np.concatenate([t.digest.fired for t in told])
  assert [list(np.flatnonzero(fired[:, g])) for g in range(3)] == [
    [37, 7 * STEPS + AGAIN],
    [37],
    [17, 100],
  ]
  assert list(told[-1].digest.since) == [7 * STEPS + AGAIN, 0, 100]


def test_replay_holds_what_came_after_the_alarm_and_nothing_else(story):
  """Rows after the alarm, and the final observation of each episode that ended since."""
  _, told = story
  since = {
    0: {c: 37 for c in range(2, 9)} | {c: 152 for c in range(9, 12)},
    2: {c: 100 for c in range(6, 12)},
  }
  kept_until = {
    0: {6: 112, 7: 112, 8: 112},
    2: {11: 176},
  }  # a converged stream adds nothing; what it holds stays until the next alarm
  for c, t in enumerate(told):
    for g in range(3):
      end = kept_until.get(g, {}).get(c, (c + 1) * STEPS)
      rows = range(since.get(g, {}).get(c, end) + 1, end)
      want = sorted(list(rows) + [r + 0.5 for r in RESETS if r in rows])
      replay = of(t.state.replay, g)
      assert replay.count[0] == len(want), (c, g)
      np.testing.assert_array_equal(replay.data.obs[0, : len(want), 0], want)
  assert (
    told[8].state.replay.count[0, 0] > told[9].state.replay.count[0, 0] == 7
  )  # emptied by the second alarm


def test_updates_equal_the_ratio(story):
  """1.5 updates a chunk, 16 rows x 3 / (4 x 8), once 20 windows of 9 records are there, that is 28
  records; the fraction is carried.
  """
  _, told = story
  # alarm in chunk 2; 11, 27, 43 records after chunks 2, 3, 4; stop in 6; alarm in 9; 7, 23, 39
  # records
  want0 = np.cumsum([0, 0, 0, 0, 1, 2, 0, 0, 0, 0, 0, 1])
  # alarm in chunk 6; 11, 27, 44 records (one episode ends) after chunks 6, 7, 8; stop in 10
  want2 = np.cumsum([0, 0, 0, 0, 0, 0, 0, 0, 1, 2, 0, 0])
  updates = np.stack([t.digest.updates for t in told])
  np.testing.assert_array_equal(updates, np.stack([want0, 0 * want0, want2], -1))
  np.testing.assert_array_equal([t.state.executed for t in told], updates)
  np.testing.assert_array_equal([t.state.train.updates for t in told], updates)


@pytest.fixture(scope="module")
def cheap_story():
  """The script, all streams in one program as on an accelerator, with an agent that costs nothing,
  whose moments and counters are 5 and are forgotten at an alarm.
  """
  out = tell(Counting, dataclasses.replace(EAGER, fresh_moments=True), used=5, block=3)
  jax.effects_barrier()
  return out


def test_only_the_streams_that_adapt_compute_updates(cheap_story):
  _, told = cheap_story
  assert len(Counting.calls) == told[-1].state.executed.sum() == 7


def test_fresh_moments_are_fresh_from_the_alarm_on(cheap_story):
  """Moments, and with them the counter that a decay of the learning rate reads; those of the other
  streams stay.
  """
  _, told = cheap_story
  for c, t in enumerate(told):
    for g, start in ((0, 2), (1, 99), (2, 6)):
      assert all(
        (x == (0 if c >= start else 5)).all() for x in jax.tree.leaves(of(t.state.train.opt, g))
      ), (c, g)


def test_a_stream_without_updates_keeps_its_weights_bit_for_bit(story, same):
  begin, told = story
  before, updates = begin, np.zeros(3)
  for t in told:
    for g in range(3):
      ended = t.digest.decision[g] > phase_lib.START
      idle = t.digest.updates[g] == updates[g]
      assert same(of(t.state.train, g), of(before.train, g)) == (idle and not ended)
      assert same(of(t.state.acting, g), of(before.acting, g)) or not idle
    before, updates = t.state, t.digest.updates
  assert same(of(told[-1].state.train, 1), of(begin.train, 1))
  assert same(of(told[8].state.train, 0), of(told[6].state.train, 0))  # frozen after the stop
  assert same(
    of(told[6].state.train.params, 0), of(told[6].state.acting, 0)
  )  # at the average that acts


def test_the_robot_acts_by_a_moving_average(story):
  """acting' = acting + average (newest - acting) in a chunk with updates; it ends where learning
  goes on from.
  """
  begin, told = story
  before, updates, moved = begin, np.zeros(3), 0
  for t in told:
    for g in range(3):
      if t.digest.updates[g] > updates[g] and t.digest.decision[g] <= phase_lib.START:
        want = jax.tree.map(
          lambda a, p: a + 0.1 * (p - a), of(before.acting, g), of(t.state.train.params, g)
        )
        jax.tree.map(
          lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-8),
          of(t.state.acting, g),
          want,
        )  # float32
        moved += 1
    before, updates = t.state, t.digest.updates
  assert moved


def test_the_detector_is_refitted_after_a_stop(story):
  _, told = story
  residual = jax.tree.map(lambda *x: np.concatenate(x), *[t.digest.residual for t in told])
  for g, stop in ((0, 6), (2, 10)):
    end = (stop + 1) * STEPS
    last = np.where(residual.valid, residual.opr, 0.0)[end - REFIT : end, g]
    fitted = of(told[stop].state.detector, g)
    assert fitted.count == REFIT and list(fitted.at) == [REFIT + AGAIN, -1]
    np.testing.assert_allclose(
      fitted.total, np.sum(last * 0.5 ** np.arange(REFIT)[::-1]), rtol=1e-5
    )  # float32 sum of 24 residuals
  assert [int(t.state.detector.count[1]) for t in told] == [
    (c + 1) * STEPS for c in range(CHUNKS)
  ]  # nobody else's is


@functools.cache
def judge():
  """Losses of actor and critic of `small`, all dreams at once."""
  form = behaviour.imagine, behaviour.sums
  return quick.jit(lambda *given: behaviour.losses(small(), *given, *form))


def hand_losses(agent, state, rows, keys, starts):
  """Dynamics loss, advantage magnitude and value loss (streams,) of what acts: the divergence of
  the two beliefs in NumPy, and the agent's losses, all dreams at once, on rows `starts`.
  """
  out = []
  for g in range(len(keys)):
    own = jax.tree.map(lambda x: x[:, g, 0], rows)
    params, slow, range_ = (of(x, g) for x in (state.acting, state.train.slow, state.train.range))
    said = agent.beliefs(params, own.deter, own.obs)
    exp = [np.exp(x - np.max(x, -1, keepdims=True)) for x in np.asarray(said, np.float64)]
    q, p = (0.99 * x / x.sum(-1, keepdims=True) + 0.01 / x.shape[-1] for x in exp)
    kl = (q * np.log(q / p)).sum((-2, -1))
    hot = np.eye(agent.size.classes, dtype=np.float32)[own.stoch[starts]].reshape(len(starts), -1)
    img = judge()(params, slow, range_, own.deter[starts], hot, keys[g])
    dyn = np.maximum(agent.config.free_nats, kl).mean()
    out.append((dyn, img.metrics["adv_mag"], img.value))
  return np.array(out, np.float64).T


def test_signals_of_a_chunk(story):
  """By the weights, the slow critic and the range that the chunk was lived with."""
  begin, told = story
  agent, before = small(), begin
  for c, t in enumerate(told):
    rows = hand_rows(c * STEPS)
    reward = np.asarray(rows.reward).mean((0, 2))
    np.testing.assert_allclose(
      t.digest.signals[:, 2], reward, rtol=1e-5, atol=1e-6
    )  # float32 mean of 16
    np.testing.assert_allclose(
      t.digest.signals[:, 0], np.nanmean(t.digest.residual.opr, 0), rtol=1e-5
    )
    np.testing.assert_allclose(
      t.digest.signals[:, 1], np.nanmean(t.digest.residual.rpr, 0), rtol=1e-5
    )
    if c in (0, 6, 9):  # nominal; one adapts, one starts; one has stopped and starts again
      own = [jax.random.fold_in(k, (c + 1) * STEPS) for k in jax.random.split(jax.random.key(1), 3)]
      keys = [jax.random.split(k, 3)[1] for k in own]
      want = hand_losses(agent, before.state if c else begin, rows, keys, np.arange(STEPS))
      np.testing.assert_allclose(t.digest.signals[:, 3:].T, want, rtol=2e-4)  # float32 sums
    assert np.isfinite(t.digest.signals).all()
    before = t


@pytest.mark.parametrize("length, starts", [(64, range(3, 64, 4)), (5, range(5))])
def test_dreams_begin_at_sixteen_states_evenly_spaced(length, starts):
  """The last of each sixteenth of a chunk; a chunk of fewer: all its states."""
  agent, keys = small(), jax.random.split(jax.random.key(3), 2)
  trains = jax.vmap(lambda key: jax.tree.map(lambda x: x + 0.01, agent.init(key)))(keys)
  many = [hand_rows(k * STEPS) for k in range(4)]
  rows = jax.tree.map(lambda *x: jnp.concatenate(x)[:length, :2], *many)
  minds = watch.Minds(trains.params, trains.slow, trains.range)
  state = types.SimpleNamespace(acting=trains.params, train=trains)
  got = quick.jit(lambda *given: watch.evaluate(agent, *given))(minds, rows, keys)
  want = hand_losses(agent, state, rows, keys, np.array(starts))[1:]
  np.testing.assert_allclose(got, want, rtol=2e-4)  # float32 sums in another order
  assert len(starts) in (watch.STARTS, length)


def test_numbers_of_the_config_are_arguments():
  """All but what shapes arrays or chooses a computation: another budget is the same program,
  another patience is not.
  """
  config = AdaptConfig(budget=777, acceptance=0.5, lr=None)
  leaves, kind = jax.tree.flatten(config)
  assert jax.tree.unflatten(kind, leaves) == config and 777 in leaves and 0.5 in leaves
  traces = []

  @jax.jit
  def double(config):
    traces.append(0)
    return 2 * config.budget + config.trend * config.patience

  assert float(double(config)) == pytest.approx(2 * 777 + 0.2 * 48)
  assert (
    float(double(dataclasses.replace(config, budget=5, ratio=4.0, trend=0.5)))
    == pytest.approx(2 * 5 + 0.5 * 48)
    and len(traces) == 1
  )
  assert (
    float(double(dataclasses.replace(config, patience=8))) == pytest.approx(2 * 777 + 0.2 * 8)
    and len(traces) == 2
  )
