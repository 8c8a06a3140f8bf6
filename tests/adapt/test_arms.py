"""Arms: the table, the phase machine without rules, ten arms side by side in one compiled loop on
hand-made rows, and a run of all of them.
"""

import dataclasses
import functools
import json
import shutil
import types
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet
import pytest
import quick

from mjx_cl import envs
from mjx_cl.adapt import decide as phase_lib
from mjx_cl.adapt import loop as loop_lib
from mjx_cl.adapt import methods
from mjx_cl.adapt.arms import ARMS, FOREVER
from mjx_cl.adapt.decide import ABORT_BUDGET, END, ENDED, START, STOP
from mjx_cl.adapt.loop import WIDTH, Loop, choices
from mjx_cl.adapt.methods import guarded
from mjx_cl.config import PRESETS, AdaptConfig, RunConfig
from mjx_cl.detectors import Alarm, Detector
from mjx_cl.dreamer.agent import Agent
from mjx_cl.envs.walker import Walker
from mjx_cl.errors import UserError
from mjx_cl.io import tables
from mjx_cl.keys import OfAdaptation
from mjx_cl.rollout.monitor import Monitor
from mjx_cl.rollout.scan import Row
from mjx_cl.runs import run, settings
from mjx_cl.runs.runner import KINDS, Runner
from mjx_cl.scoring import normalised_recovery, recovery
from mjx_cl.training import agents

FOUR = (
  "detector",
  "none",
  "oracle",
  "no-fault",
)  # as many streams as are computed alike to the last bit, see run.Runner
NAMES = (
  "detector",
  "rollback",
  "guarded",
  "staged",
  "calm",
  "quiet",
  "swift",
  "quiet-guarded",
  "swift-guarded",
  "ratchet",
  "swift-ratchet",
  "still",
  "none",
  "always",
  "periodic",
  "random",
  "oracle",
  "oracle-budget",
  "oracle-stop",
  "scratch",
  "world-model",
  "randomised",
  "no-fault",
)


LIKE = {*NAMES[1 : NAMES.index("none")], "world-model"}
HEARD = LIKE | {"detector", "no-fault"}

# ---- table ---------------------------------------------------------------------------------------


def test_the_table_is_what_is_tested_here():
  assert tuple(ARMS) == NAMES


def test_choices_of_all_arms():
  c = AdaptConfig(warmup=1000, budget=777, period=400, period_steps=30, random_steps=60)
  x = choices([(name, 5) for name in NAMES], c, 1500, [(700, 1200, FOREVER)] * len(NAMES), {5: 333})
  rows = {name: jax.tree.map(lambda a: np.asarray(a)[i], x) for i, name in enumerate(NAMES)}
  at = {name: sorted(int(s) for s in row.at if s < FOREVER) for name, row in rows.items()}
  drawn = at.pop("random")
  assert at == {
    "detector": [],
    "none": [],
    "always": [1000],
    "periodic": [400, 800, 1200],
    "oracle": [1000, 1200],  # the warm-up comes first
    "oracle-budget": [1000, 1200],
    "oracle-stop": [1000, 1200],
    "scratch": [1000, 1200],
    "world-model": [],
    "rollback": [],
    "guarded": [],
    "staged": [],
    "calm": [],
    "quiet": [],
    "swift": [],
    "quiet-guarded": [],
    "swift-guarded": [],
    "ratchet": [],
    "swift-ratchet": [],
    "still": [],
    "randomised": [],
    "no-fault": [],
  }
  assert len(drawn) == 1 and 1000 <= drawn[0] <= 1440
  on = lambda field: {name for name, row in rows.items() if getattr(row, field)}
  assert on("listens") == HEARD and on("fresh") == {"scratch"}
  own = tuple(methods.METHODS.values())
  assert x.methods.all == own and own[0] is methods.PAPER
  by = {name: list(methods.METHODS)[int(row.method)] for name, row in rows.items()}
  assert by == {name: name if name in methods.METHODS else "paper" for name in NAMES}
  few = choices([("detector", 0), ("none", 0)], c, 1500)
  assert few.fresh is None and few.methods.all == (methods.PAPER,)
  assert few.at.shape[1] == x.at.shape[1] == WIDTH  # one program
  assert choices(
    [("periodic", 0)], dataclasses.replace(c, period=100, warmup=100), 1500
  ).at.shape == (1, 2 * WIDTH)
  assert on("rule") == HEARD | {"oracle", "scratch"}
  assert {name: int(row.limit) for name, row in rows.items()} == dict.fromkeys(NAMES, 777) | {
    "none": FOREVER,
    "always": FOREVER,
    "randomised": FOREVER,
    "periodic": 30,
    "random": 60,
    "oracle-stop": 334,
  }
  late = choices([("oracle-stop", 5), ("oracle-stop", 6)], c, 1500, None, {5: 778, 6: 1})
  assert late.limit.tolist() == [777, 2]  # no later than the budget
  assert [name for name, arm in ARMS.items() if not arm.breaks] == ["no-fault"]


def test_a_random_time_comes_from_the_seed_and_leaves_room():
  c = AdaptConfig(warmup=100, random_steps=50)
  at = np.asarray(choices([("random", seed) for seed in range(2000)], c, 160).at)[:, 0]
  assert (
    set(at) == set(range(100, 111)) and np.bincount(at)[100:].min() > 120
  )  # 11 values, 182 expected of each, deviation 13
  assert (
    np.asarray(choices([("random", seed) for seed in range(1999, -1, -1)], c, 160).at)[::-1, 0]
    == at
  ).all()
  with pytest.raises(UserError, match="needs warmup .* 150 steps; the run has 149"):
    choices([("random", 0)], c, 149)


def test_bad_settings_are_refused():
  with pytest.raises(UserError, match="period_steps must be below period=50; got 50"):
    AdaptConfig(period=50, period_steps=50)
  for name in ("period", "period_steps", "random_steps"):
    with pytest.raises(UserError, match=name):
      AdaptConfig(**{name: 0})
  with pytest.raises(
    UserError,
    match=(
      "unknown arm 'orcale'; choose from: always, calm, detector, guarded, no-fault, none, oracle, "
      "oracle-budget, oracle-stop, periodic"
    ),
  ):
    settings.check(RunConfig("walker", arms=("orcale",)))


# ---- phase machine -------------------------------------------------------------------------------


def live(reward, due, rule, limit, chunks=30):
  """{chunk: decision} and phases of a stream with flat signals and this reward (acceptance 0.6),
  chunks of 64, no alarms.
  """
  config = AdaptConfig(patience=4, least=1, give_up=8 * 64, budget=12 * 64, warmup=64)
  signals = jnp.tile(jnp.array([1.0, 0.1, reward, 2.0, 0.5, 3.0]), (chunks, 1))

  def step(state, x):
    signals, c = x
    now = (c + 1) * 64
    state, decision, _ = phase_lib.update(
      state,
      signals,
      1.0,
      False,
      now - 64,
      now,
      False,
      0.6,
      0.9,
      config,
      jnp.isin(c, jnp.array(due)),
      rule,
      limit,
    )
    return state, (state.phase, decision)

  _, (phases, decisions) = jax.lax.scan(step, phase_lib.init(config), (signals, jnp.arange(chunks)))
  return {int(i): int(decisions[i]) for i in np.flatnonzero(decisions)}, np.asarray(phases)


def test_without_rules_nothing_but_the_limit_ends_adaptation():
  """What is due starts it, no alarm and no listening needed. The start is 64 before the end of its
  chunk: age 64 (k + 1) after chunk 5 + k.
  """
  for reward in (0.3, 0.8):  # settled below acceptance, settled and accepted: neither counts
    decisions, phases = live(reward, [5], False, 20 * 64)
    assert (
      decisions == {5: START, 24: END}
      and (phases[24:] == ENDED).all()
      and (phases[5:24] == phase_lib.ADAPTING).all()
    )
    assert live(reward, [5], False, FOREVER)[0] == {5: START}
  assert live(0.8, [5], True, 20 * 64)[0] == {5: START, 9: STOP}
  assert live(0.3, [5], True, 7 * 64)[0] == {
    5: START,
    11: ABORT_BUDGET,
  }  # as a limit that comes before the rules do


def test_what_is_due_while_adapting_or_in_the_warm_up_starts_nothing_and_later_it_starts_again():
  assert live(0.8, [0, 5, 6, 9], False, 4 * 64)[0] == {5: START, 8: END, 9: START, 12: END}


# ---- all arms in one loop ------------------------------------------------------------------------

STEPS, CHUNKS, ONSET = 16, 16, 60  # rows of a chunk; chunks; true onset
RESETS = (45, 130)
# settled as soon as the patience is full, always acceptable; 1.5 updates a chunk once 20 windows of
# 9 records are there
EAGER = AdaptConfig(
  ratio=3.0,
  start_windows=20,
  patience=4,
  trend=1e9,
  fluctuation=1e9,
  least=1,
  acceptance=-9.0,
  give_up=9999,
  budget=100,
  warmup=20,
  refit=24,
  period=80,
  period_steps=40,
  random_steps=50,
)
ALARMS = (
  10,
  37,
  150,
)  # of every stream's detector: in the warm-up, after it, and once more unless it has been refitted


class Script(NamedTuple):
  """State of a detector that fires at given rows: at (3,), count of rows."""

  at: jax.Array
  count: jax.Array


def scripted():
  """A detector that never fires unless its state is told to."""
  update = lambda state, residual: (
    Script(state.at, state.count + 1),
    Alarm(jnp.any(state.at == state.count), jnp.float32(0)),
  )
  return Detector(lambda: Script(jnp.full(3, -1, jnp.int32), jnp.int32(0)), update)


def hand_rows(start, groups):
  """Rows start .. start + STEPS, the same for every stream; obs[0] is the number of the row,
  final_obs[0] that number and a half.
  """
  rng = np.random.default_rng(start)
  normal = lambda *more: jnp.broadcast_to(
    jnp.asarray(rng.normal(size=(STEPS, 1, 1) + more), jnp.float32), (STEPS, groups, 1) + more
  )
  shape = (STEPS, groups, 1)
  number = jnp.broadcast_to(start + jnp.arange(STEPS, dtype=jnp.float32)[:, None, None], shape)
  mark = lambda x, n: x.at[..., 0].set(n)
  done, reward = jnp.isin(number, jnp.array(RESETS)), normal()
  stoch = jnp.broadcast_to(jnp.asarray(rng.integers(0, 8, (STEPS, 1, 1, 8))), shape + (8,))
  return Row(
    mark(normal(24), number),
    jnp.isin(number - 1, jnp.array(RESETS)) | (number == 0),
    normal(),
    normal(6),
    normal(128),
    stoch,
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


class Story(NamedTuple):
  """A life of all arms: the start, [state of each chunk], [digest of each chunk], choices, keys,
  the loop.
  """

  begin: object
  states: list
  digests: list
  chosen: object
  keys: object
  loop: Loop


@pytest.fixture(scope="module")
def story():
  agent = Agent(dataclasses.replace(PRESETS["tiny"].dreamer, batch=4, length=8, imagine=4), 24, 6)
  loop = Loop(
    agent,
    Monitor(agent, n=4, least=2),
    scripted(),
    types.SimpleNamespace(acceptance=0.6, posture=None),
    EAGER,
    capacity=512,
  )
  loop.programs = quick.programs(loop)
  train = jax.jit(agent.init)(jax.random.key(0))
  # fresh heads say exactly 0, and a signal whose median is 0 has no scale to be settled on; slow
  # critic and moments get values of their own
  shake = lambda tree, seed: jax.tree.map(
    lambda x: (
      x + (0.01 * jax.random.normal(jax.random.key(x.size + seed), x.shape)).astype(x.dtype)
    ),
    tree,
  )
  moments = jax.tree.map(
    lambda x: (
      x + jnp.abs(0.01 * jax.random.normal(jax.random.key(x.size), x.shape)).astype(x.dtype)
      if x.ndim
      else x
    ),
    train.opt,
  )
  train = train._replace(
    params=shake(train.params, 1),
    slow=shake(train.slow, 2),
    opt=moments,
    range=jnp.array([-0.5, 0.5]),
    updates=jnp.int32(100),
  )
  labels = [(name, i) for i, name in enumerate(NAMES)]
  keys = jax.vmap(jax.random.key)(jnp.arange(len(NAMES)))

  def begin():
    state = loop.init(train, len(NAMES), methods.used(NAMES))
    return state._replace(
      detector=state.detector._replace(at=jnp.tile(jnp.array(ALARMS), (len(NAMES), 1)))
    )

  copy = lambda tree: jax.tree.map(lambda x: np.array(x), tree)
  state, states, digests = begin(), [], []
  stops = {NAMES.index("oracle-stop"): 70}
  chosen = choices(labels, EAGER, STEPS * CHUNKS, [(ONSET,)] * len(NAMES), stops)
  first = copy(state)
  for c in range(CHUNKS):
    state, digest = loop.digest(
      state, hand_rows(c * STEPS, len(NAMES)), jnp.int32((c + 1) * STEPS), chosen, keys
    )
    states.append(copy(state))
    digests.append(copy(digest))
  other = choices(labels[::-1], EAGER, STEPS * CHUNKS, [(ONSET,)] * len(NAMES), stops)
  loop.digest(begin(), hand_rows(0, len(NAMES)), jnp.int32(STEPS), other, keys)
  return Story(first, states, digests, chosen, keys, loop)


def of(tree, name):
  return jax.tree.map(lambda x: x[NAMES.index(name)], tree)


def spans(story):
  """By hand, arm -> [(control step of the start, chunk of the start, chunk of the end or None,
  decision of the end)].
  """
  drawn = int(np.asarray(story.chosen.at)[NAMES.index("random")].min())
  over = next(c for c in range(CHUNKS) if (c + 1) * STEPS - drawn >= 50)
  heard, true = (
    [(37, 2, 6, STOP)],
    [(60, 3, 7, STOP)],
  )  # the patience of 4 is full after four more chunks
  return {
    "detector": heard,
    "rollback": heard,
    "guarded": heard,
    "staged": heard,
    "calm": heard,
    "quiet": heard,
    "swift": [(37, 2, 8, ABORT_BUDGET)],  # 90 % of the reward before do not come back
    "quiet-guarded": heard,
    "swift-guarded": [(37, 2, 8, ABORT_BUDGET)],
    "ratchet": heard,
    "swift-ratchet": [(37, 2, 8, ABORT_BUDGET)],
    "still": heard,
    "none": [],
    "always": [(20, 1, None, None)],
    "periodic": [(80, 5, 7, END), (160, 10, 12, END), (240, 15, None, None)],
    "random": [(drawn, drawn // STEPS, over, END)],
    "oracle": true,
    "oracle-budget": [(60, 3, 9, END)],
    "oracle-stop": [(60, 3, 8, END)],  # 70 steps after step 60 lie in the chunk of 128 to 143
    "scratch": [
      (60, 3, 8, STOP)
      # first update in chunk 5, at learning rate 0 of its warm-up: fresh heads say 0 in 4, 5 and 6
    ],
    "world-model": heard,
    "randomised": [],
    "no-fault": heard,
  }


@pytest.mark.parametrize("name", NAMES)
def test_when_an_arm_starts_and_ends(story, name):
  want = {}
  for since, start, end, decision in spans(story)[name]:
    want |= {start: START} | ({} if end is None else {end: decision})
    assert of(story.digests[start].since, name) == since
  decisions = np.array([of(d.decision, name) for d in story.digests])
  assert {int(c): int(decisions[c]) for c in np.flatnonzero(decisions)} == want


def test_detectors_hear_the_same_until_they_are_refitted(story):
  fired = np.concatenate([d.fired for d in story.digests])
  for g, name in enumerate(NAMES):
    end = [c for _, _, c, how in spans(story)[name] if c is not None and how != ABORT_BUDGET]
    assert list(np.flatnonzero(fired[:, g])) == [
      a for a in ALARMS if not end or a < (end[0] + 1) * STEPS
    ], name


@pytest.mark.parametrize("name", NAMES)
def test_replay_and_updates(story, name):
  """Rows after the alarm, or from what was due on, and the final observation of episodes that
  ended; updates by a loop over chunks.
  """
  first, owed, total, records = None, 0.0, 0, []
  active = {
    c: since
    for since, start, end, _ in spans(story)[name]
    for c in range(start, CHUNKS if end is None else end)
  }
  kept = {
    c: since
    for since, start, end, _ in spans(story)[name]
    for c in range(start, CHUNKS if end is None else end + 1)
  }
  for c in range(CHUNKS):
    if c in kept:
      if kept[c] != first:
        first, records = kept[c], []
      rows = [
        r
        for r in range(c * STEPS, (c + 1) * STEPS)
        if (r > first if ARMS[name].trigger.listens else r >= first)
      ]
      records += sorted(rows + [r + 0.5 for r in RESETS if r in rows])
    owed = owed + 1.5 if c in active and len(records) >= 28 and name != "still" else 0.0
    total, owed = total + int(owed), owed - int(owed)
    replay = of(story.states[c].replay, name)
    assert replay.count[0] == len(records), c
    np.testing.assert_array_equal(replay.data.obs[0, : len(records), 0], records)
    assert of(story.digests[c].updates, name) == total, c
  assert (total > 0) == (name not in ("none", "randomised", "still"))


def test_the_world_model_alone_learns(story, same):
  begin, end = of(story.begin.train, "world-model"), of(story.states[6].train, "world-model")
  assert of(story.digests[6].updates, "world-model") > 0
  for part in ("pol", "val"):
    assert same(begin.params[part], end.params[part]) and same(
      begin.params[part], of(story.states[6].acting, "world-model")[part]
    )
  assert same(begin.slow, end.slow) and same(begin.range, end.range)
  for part in ("enc", "dyn", "dec", "rew", "con"):
    assert not same(begin.params[part], end.params[part]), part
  everything = of(story.states[6].train, "detector")  # the same alarm, the same number of updates
  assert not any(same(begin.params[part], everything.params[part]) for part in begin.params)
  assert not same(begin.slow, everything.slow) and not same(begin.range, everything.range)
  moved = lambda new: {
    path for (path, a), (_, b) in zip(named(begin.opt), named(new.opt)) if not same(a, b)
  }
  behaviour = lambda paths: {p for p in paths if "'pol'" in p or "'val'" in p}
  assert behaviour(moved(everything)) and moved(end) == moved(everything) - behaviour(
    moved(everything)
  )


def named(tree):
  return [
    (jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
  ]


def test_scratch_starts_from_fresh_parameters(story, same):
  """Drawn from the stream's own key in the chunk of the trigger, in which no update is due yet; the
  shipped ones until then.
  """
  begin, init = of(story.begin.train, "scratch"), jax.jit(story.loop.agent.init)
  assert same(of(story.states[2].train, "scratch"), begin)
  new = of(story.states[3].train, "scratch")
  want = init(jax.random.fold_in(story.keys[NAMES.index("scratch")], OfAdaptation.FRESH))
  jax.tree.map(
    lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7), new, want
  )  # float32 of two programs
  assert (
    same(new.params, of(story.states[3].acting, "scratch"))
    and new.updates == 0
    and begin.updates == 100
  )
  other = init(jax.random.fold_in(story.keys[0], OfAdaptation.FRESH))
  kernel = lambda state: max(jax.tree.leaves(state.params["enc"]), key=np.size)
  assert not np.allclose(kernel(new), kernel(other), atol=0.01) and not np.allclose(
    kernel(new), kernel(begin), atol=0.01
  )
  assert same(
    of(story.states[3].train, "oracle"), of(story.begin.train, "oracle")
  )  # beside it nobody else's are


def test_one_trace_serves_all_arms(story):
  assert quick.traces(story.loop.programs) == (1, 0, 1)


# ---- an abort that goes back ---------------------------------------------------------------------

BEFORE, SINCE = (
  0.5,
  {"rollback": (0.1, 0.9), "detector": (0.1,)},
)  # reward a step of the weights of before, and of those that have learnt


@pytest.fixture(scope="module")
def aborted(story):
  """aborted(labels, due, config, chunks, reward(c, learnt), level(c)): [state], [digest] of streams
  that are due at these control steps; the digests are theirs alone. The program is that of all
  arms, whose other streams are due at none.
  """
  loop = story.loop

  def live(names, due, config, chunks, reward, level):
    count, all_ = len(names), len(NAMES)
    labels = [(name, 0) for name in (*names, "scratch", *methods.METHODS, *["none"] * all_)]
    labels = [label for label in labels if label[0] != "paper"][:all_]
    chosen = choices(labels, config, STEPS * CHUNKS)
    chosen = chosen._replace(at=chosen.at.at[:count, : len(due)].set(jnp.array(due)))
    keys = jax.vmap(jax.random.key)(jnp.zeros(all_, int))
    state = loop.init(of(story.begin.train, "detector"), all_, methods.used(NAMES))
    state = state._replace(
      train=state.train._replace(updates=jnp.full(all_, 2000, jnp.int32))
    )  # past the warm-up of the learning rate
    states, digests = [jax.tree.map(np.array, state)], []
    for c in range(chunks):
      # numbers of the config are arguments of the program
      loop.config = dataclasses.replace(config, acceptance=level(c))
      rows = hand_rows(c * STEPS, all_)
      earned = jnp.asarray(reward(c, bool(digests) and bool(digests[-1].updates.any())))
      earned = jnp.pad(earned, (0, all_ - count))
      rows = rows._replace(
        rewards=jnp.broadcast_to(earned[..., None, None], rows.rewards.shape).astype(jnp.float32)
      )
      now = jnp.int32((c + 1) * STEPS)
      state, digest = loop.digest(state, rows, now, chosen, keys)
      states.append(jax.tree.map(np.array, state))
      slim = digest._replace(residual=None, score=None, fired=None)  # what leads with streams
      digests.append(jax.tree.map(lambda x: np.array(x)[:count], slim))
    return states, digests

  yield live
  loop.config = EAGER
  assert quick.traces(loop.programs) == (1, 0, 1)


UNACCEPTED = dataclasses.replace(EAGER, budget=9 * STEPS, start_windows=40)


def test_an_abort_goes_back_to_what_earned_more(aborted, same):
  """Three streams whose budget is spent, each with its own rewards: hand means over the chunks of
  the old weights and over the last ones of the new.
  """
  names, after = zip(*((name, reward) for name, own in SINCE.items() for reward in own))
  earned = []

  def reward(c, learnt):
    earned.append(np.asarray(after if learnt else [BEFORE + 0.01 * c] * 3))
    return earned[-1]

  states, digests = aborted(names, (2 * STEPS,), UNACCEPTED, 13, reward, lambda c: 9.0)
  end = 10
  assert all(
    (d.decision == (START if c == 2 else phase_lib.ABORT_BUDGET if c == end else 0)).all()
    for c, d in enumerate(digests)
  )
  old = (
    next(c for c, d in enumerate(digests) if d.updates.any()) + 1
  )  # chunks 3 .. old - 1 were lived by the old weights
  assert 4 < old < end - 4
  assert [d.back.tolist() for d in digests] == [[False] * 3] * end + [[True, False, False]] + [
    [False] * 3
  ] * 2
  weighs = np.array(names) == "rollback"  # the other's method weighs nothing
  mean = lambda rows: np.where(weighs, np.mean(rows, 0), np.nan)
  np.testing.assert_allclose(digests[end].earned, mean(earned[3:old]), rtol=1e-6)
  np.testing.assert_allclose(
    digests[end].earns, mean(earned[end - 3 : end + 1]), rtol=1e-6
  )  # a patience of 4 chunks
  pick = lambda tree, g: jax.tree.map(lambda x: x[g], tree)
  for g, back in enumerate((True, False, False)):
    assert not same(pick(states[end].acting, g), pick(states[0].acting, g)), names[
      g
    ]  # it had learnt something
    for later in states[end + 1 :]:
      assert same(pick(later.acting, g), pick(states[0].acting, g)) == back and same(
        pick(later.acting, g), pick(later.train.params, g)
      ), names[g]
  assert (digests[-1].updates == digests[end].updates).all()  # an aborted stream learns no more


def test_a_later_adaptation_goes_back_to_where_it_began(aborted, same):
  """The first converges, the second is aborted: what comes back is what the first had learnt, not
  what the run began with.
  """
  states, digests = aborted(
    ("rollback",) * 3,
    (2 * STEPS, 8 * STEPS),
    dataclasses.replace(UNACCEPTED, budget=7 * STEPS),
    CHUNKS,
    lambda c, learnt: [0.1 if c > 11 else 0.5] * 3,
    lambda c: -9.0 if c < 8 else 9.0,
  )
  assert {c: int(d.decision[0]) for c, d in enumerate(digests) if d.decision[0]} == {
    2: START,
    6: STOP,
    8: START,
    14: phase_lib.ABORT_BUDGET,
  }
  assert digests[14].back.all() and not any(d.back.any() for d in digests[:14])
  acting = [state.acting for state in states[1:]]
  assert (
    same(acting[14], acting[7])
    and not same(acting[7], acting[1])
    and not same(acting[13], acting[7])
  )


def test_old_and_new_weights_act_by_turns(same):
  """By hand, chunk after chunk, for four streams: the new weights earn less, more, as much (with
  noise, so that it is not clear), and less in an arm that is not guarded.
  """
  new, groups, first, last = np.array([0.2, 0.9, 0.5, 0.2], np.float32), 4, 3, 350
  noise = np.random.default_rng(0).normal(0, 0.05, (last + 1, groups))
  flags = lambda on: jnp.full(groups, on)
  weights = lambda x: {"w": jnp.full((groups, 3), x)}
  own, which = (methods.PAPER, guarded.METHOD), jnp.array([1, 1, 1, 0])
  memory = tuple(jax.vmap(functools.partial(methods.remember, m))(weights(7.0)) for m in own)
  acting, told = weights(1.0), []
  heard = {1: [[] for _ in range(groups)], 0: [[] for _ in range(groups)]}
  periods: list[set] = [set() for _ in range(3)]
  begun: dict[int, int] = {}  # chunks from the first update to the first turn
  other, waits, losses = np.zeros(3, bool), np.zeros(3, int), np.zeros(3, int)
  age, guard_acts = np.zeros(groups, int), np.zeros(groups, bool)  # age: see Guard
  leads = np.zeros(groups, bool)  # the old do

  def weighed(g):
    kept = 6 if leads[g] or age[g] < 48 else 16
    sides = [np.array(heard[side][g][-n:]) for side, n in ((0, 16), (1, kept))]
    few = min(len(heard[side][g]) for side in (0, 1)) < 4
    gap, error, free = np.nan, np.inf, sum(map(len, sides)) - 2
    if min(map(len, sides)):
      gap = sides[1].mean() - sides[0].mean()
      squares = sum(((x - x.mean()) ** 2).sum() for x in sides)
      error = np.sqrt(squares / free * sum(1 / len(x) for x in sides)) if free else np.inf
    ahead = 0 if few else int(gap > 2 * error) - int(gap < -2 * error)  # 1: the new are ahead
    fails = len(heard[1][g]) >= 6 and gap < -3 * error
    return sides, few, gap, ahead, fails

  for c in range(last + 1):
    old_acts = np.asarray(acting["w"][:, 0]) == 1.0
    reward = (np.where(old_acts, 0.5, new) + noise[c]).astype(np.float32)
    # the learner's average moves on with each chunk, and reaches the learner at once
    learnt, ends = c > first, c == last
    held = jnp.where(((which == 1) & learnt)[:, None], memory[1].new["w"], acting["w"])
    view = methods.View(
      was=flags(phase_lib.ADAPTING if c else phase_lib.NOMINAL),
      phase=flags(phase_lib.CONVERGED if ends else phase_lib.ADAPTING),
      begins=flags(c == 0),
      over=flags(ends),
      reward=jnp.asarray(reward),
      recent=flags(jnp.nan),
      signals=jnp.full((groups, 6), jnp.nan),
      taken=flags(int(c >= first)),
      rate=flags(float(c >= first)),
      acted=acting,
      learner={"w": held + 1.0},
    )
    acting, _, memory, (back, earned, earns) = loop_lib._act(own, which, memory, view, weights(7.0))
    for g in range(groups):
      if c and (not learnt or age[g] % guarded.TURN >= guarded.SKIP):
        heard[int(learnt and not bool(guard_acts[g]))][g].append(reward[g])
    guard_acts = np.asarray(memory[1].acts) & (np.asarray(which) == 1)
    was = [weighed(g) for g in range(groups)]
    age = age + learnt
    age = np.where([w[-1] for w in was], np.maximum(age, 48), age)
    told.append(np.asarray(acting["w"][:, 0]) == 1.0)
    for g in range(3) if first <= c < last else ():
      sides, few, gap, ahead, _ = was[g]
      mean = [x.mean() if len(x) else np.nan for x in sides]
      np.testing.assert_allclose([earned[g], earns[g]], mean, rtol=1e-5)
      if age[g] % 4:
        assert told[-1][g] == told[-2][g]  # whole turns
        continue
      grace = age[g] < 48
      lives = age[g] > 0 and not told[-2][g]  # the new have just had a turn
      losses[g] = losses[g] + (lives and not grace) if ahead < 0 else 0
      losing = [4, 4, 8, 16][min(losses[g], 3)]
      period = 2 if few else {1: np.inf, 0: 4 if gap < 0 else 16, -1: losing}[ahead]
      waits[g] = 0 if other[g] else waits[g] + (age[g] > 0)
      other[g] = waits[g] >= period - 1 and not grace
      assert told[-1][g] == (not grace and (ahead < 0) != other[g]), (c, g)
      leads[g] = told[-1][g] != other[g]
      if not grace:
        periods[g].add((period, ahead))
        begun.setdefault(g, c - first)
  assert periods[:2] == [{(2, 0), (4, -1), (8, -1), (16, -1)}, {(2, 0), (np.inf, 1)}], periods
  assert {(2, 0), (4, 0), (16, 0)} <= periods[2], periods  # what is equal is clear now and then
  assert 8 <= begun[0] < 16 and begun[1] == 48  # who fails has no grace
  share = np.array(told)[first + 48 : last].mean(0)  # of the chunks that the old weights live
  assert share[0] > 0.8 and share[1] < 0.02 and 0.05 < share[2] < 0.4 and share[3] == 0
  sides, _, gap, ahead, _ = was[2]
  stays = [True, False, gap < 0.05 * sides[0].mean() and ahead <= 0, False]
  assert back.tolist() == stays and (np.asarray(acting["w"][:, 0]) == 1.0).tolist() == stays
  assert not memory[1].learnt.any() and not memory[1].acts.any()


# ---- a run of all arms ---------------------------------------------------------------------------

LIFE, FAULT, WARMUP, SEED = 700, 300, 100, 3
CONFIG = dict(
  env="walker",
  onset=FAULT,
  steps=LIFE,
  seeds=1,
  first_seed=SEED,
  detector="rolling_sigma_plain",
  settings=dict(window=100, warmup=30),
  physics="native",
  adapt=AdaptConfig(
    warmup=WARMUP,
    ratio=4.0,  # an update a chunk
    start_windows=40,
    patience=4,
    least=64,
    trend=1e9,
    fluctuation=1e9,
    refit=100,
    budget=256,
    period=250,
    period_steps=128,
    random_steps=200,
  ),
)


class Easy(Walker):
  """A walker with short episodes whose task counts as done whatever the robot does: random weights
  can converge.
  """

  def __init__(self, physics="auto"):
    super().__init__(physics)
    self.spec = self.spec._replace(episode_steps=150, posture=None, acceptance=0.0)


@pytest.fixture(scope="module")
def lived(tiny, tmp_path_factory):
  """lived(name, arms): a finished run, its folder."""
  patch = pytest.MonkeyPatch()
  patch.setitem(envs.ENVS, "walker", Easy)
  agent = tmp_path_factory.mktemp("arms") / "agent"
  card = {
    "env": "walker",
    "preset": "tiny",
    "repeat": 1,
    "dreamer": dataclasses.asdict(tiny.config),
  }
  stops = agent.with_name("stops")
  stops.mkdir()
  tables.write_json(stops / "config.json", {"env": "walker", "onset": FAULT, "adapt": {}})
  tables.write_table(
    stops / "snapshots.parquet",
    {
      "arm": ["oracle-budget"] * 3,
      "seed": [SEED] * 3,
      "since_start": [20, 148, 212],
      "reward_mean": [0.1, 0.99, 1.0],
    },
  )
  for path, seed in ((agent, 0), (agent.with_name("agent-randomised"), 1)):
    agents.save(path, jax.jit(tiny.init)(jax.random.key(seed)), card | {"seed": seed})

  @functools.cache
  def make(arms, cut=None, suffix=""):
    out, config = (
      tmp_path_factory.mktemp("arms") / "out",
      RunConfig(
        **CONFIG,
        arms=arms,
        agent=str(agent) + suffix,
        stops=str(stops) if "oracle-stop" in arms else None,
      ),
    )
    if cut is not None:  # cut off after `cut` chunks
      runner = run.Runner(config, out)
      out.mkdir(exist_ok=True)
      runner.open()
      tables.write_json(out / "config.json", runner.config_dict())
      for _ in range(cut):
        runner.step()
      runner.save()
      runner.checkpoints.close()
    run.execute(config, out, resume=cut is not None)
    return out

  yield make
  patch.undo()


def columns(folder, name, arm=None):
  """{column: list} of a result file, of one arm."""
  table = pyarrow.parquet.read_table(folder / f"{name}.parquet").to_pydict()
  keep = [i for i, a in enumerate(table["arm"]) if arm in (None, a)]
  return {k: [v[i] for i in keep] for k, v in table.items()}


def events(folder, arm, *kinds):
  e = columns(folder, "events", arm)
  return [(s, r) for s, k, r in zip(e["step"], e["kind"], e["reason"]) if k in kinds]


@pytest.mark.slow
def test_events_say_what_started_and_ended_each_arm(lived):
  out = lived(NAMES)
  drawn = int(choices([("random", SEED)], CONFIG["adapt"], LIFE).at.min())
  want = {
    "always": ["end of the warm-up at step 100"],
    "periodic": ["schedule at step 250", "schedule at step 500"],
    "random": [f"random time at step {drawn}"],
    "oracle": ["true onset at step 300"],
    "oracle-budget": ["true onset at step 300"],
    "oracle-stop": ["true onset at step 300"],
    "scratch": ["true onset at step 300"],
    "none": [],
    "randomised": [],
  }
  for name, reasons in want.items():
    assert [r for _, r in events(out, name, "start")] == reasons, name
  for name in sorted(HEARD):
    acted = [s for s, r in events(out, name, "alarm") if r.startswith("acted on")]
    assert acted and [r for _, r in events(out, name, "start")] == [
      f"alarm at step {s}" for s in acted
    ], name
  over = "fixed number of steps over"
  assert {
    name: [r for _, r in events(out, name, "stop", "abort")]
    for name in ("always", "periodic", "random", "oracle", "oracle-budget", "oracle-stop")
  } == {
    "always": [],
    "periodic": [over, over],
    "random": [over],
    "oracle": ["all six signals settled, task acceptable"],
    "oracle-budget": [over],
    "oracle-stop": [over],
  }
  assert [s for s, _ in events(out, "oracle-stop", "stop")] == [
    511
  ]  # the chunk after the one that ends 148 steps after step 300, whose weights stay
  outcome = dict(zip(*(columns(out, "runs")[k] for k in ("arm", "outcome"))))
  assert {
    name: outcome[name]
    for name in ("none", "always", "periodic", "random", "oracle", "oracle-budget", "oracle-stop")
  } == {
    "none": "nominal",
    "always": "adapting",
    "periodic": "ended",
    "random": "ended",
    "oracle": "converged",
    "oracle-budget": "ended",
    "oracle-stop": "ended",
  }
  for name in ("always", "periodic", "random", "oracle", "oracle-budget", "oracle-stop", "scratch"):
    assert events(out, name, "alarm") and all(
      "arm does not listen" in r for _, r in events(out, name, "alarm")
    ), name


@pytest.mark.slow
def test_the_robot_of_arm_no_fault_never_breaks(lived):
  out = lived(NAMES)
  for name in NAMES:
    trace, severity = columns(out, "trace", name), 0.0 if name == "no-fault" else 0.5
    np.testing.assert_array_equal(
      trace["severity"], np.where(np.arange(LIFE) >= FAULT, severity, 0.0)
    )
    assert trace["fault_active"] == [s > 0 for s in trace["severity"]]
    assert len(events(out, name, "onset")) == (name != "no-fault")
  row = {k: v[0] for k, v in columns(out, "runs", "no-fault").items()}
  alarms = events(out, "no-fault", "alarm")
  assert all(r.endswith(", on a healthy robot: a false alarm") for _, r in alarms) and any(
    s >= FAULT for s, _ in alarms
  )
  assert row["false_alarms"] == len(alarms) and row["fault"] == "none"
  assert all(
    row[k] is None
    for k in (
      "onset",
      "alarm_step",
      "latency_steps",
      "affected",
      "recovery_step",
      "reward_drop",
      "return_lost",
    )
  )
  healthy, broken = columns(out, "trace", "no-fault"), columns(out, "trace", "detector")
  # rows of one batch may be summed in another order, which hundreds of steps of a walker let grow
  np.testing.assert_allclose(healthy["reward"][:50], broken["reward"][:50], atol=1e-3)
  assert np.abs(np.subtract(healthy["reward"][FAULT:], broken["reward"][FAULT:])).max() > 0.02
  summary = json.loads((out / "summary.json").read_text())["arms"]["no-fault"]
  assert (
    summary["miss_probability"] is None
    and summary["alarms"] == 0
    and summary["false_alarm_streams"] == 1
  )
  assert summary["false_alarms_per_hour"] == pytest.approx(len(alarms) / (LIFE * 0.025 / 3600))


@pytest.mark.slow
def test_what_false_alarms_cost(lived):
  """From the first start to the onset, to the end for a robot that never breaks: reward_pre less
  the reward.
  """
  out = lived(NAMES)
  for name in NAMES:
    reward = np.array(columns(out, "trace", name)["reward"])
    begun = [int(r.split()[-1]) for _, r in events(out, name, "start")]
    row = {k: v[0] for k, v in columns(out, "runs", name).items()}
    end = LIFE if name == "no-fault" else FAULT
    window = (
      min([end] + begun) if ARMS[name].trigger.listens else FAULT
    )  # arms that do not listen have arm none's, unless they bring an agent
    source = (
      reward
      if ARMS[name].trigger.listens or ARMS[name].agent
      else np.array(columns(out, "trace", "none")["reward"])
    )
    assert row["reward_pre"] == pytest.approx(source[WARMUP:window].mean()), name
    want = (row["reward_pre"] - reward[begun[0] : end]).sum() if begun and begun[0] < end else 0.0
    assert row["return_lost_healthy"] == pytest.approx(want), name
  assert recovery.return_lost_healthy(np.array([1.0, 2.0, 3.0, 4.0]), 3, 2.5, 1) == 0.5 + -0.5
  assert (
    recovery.return_lost_healthy(np.ones(4), 3, 2.0, 3)
    == recovery.return_lost_healthy(np.ones(4), 3, 2.0, None)
    == 0.0
  )
  assert recovery.return_lost_healthy(np.ones(4), 3, None, 1) is None


@pytest.mark.slow
def test_the_ledger_of_each_arm(lived):
  out = lived(NAMES)
  summary = json.loads((out / "summary.json").read_text())
  assert tuple(summary["arms"]) == NAMES and all(
    summary[k] == v for k, v in summary["arms"]["detector"].items()
  )
  for name in NAMES:
    trace, row, arm = (
      columns(out, "trace", name),
      {k: v[0] for k, v in columns(out, "runs", name).items()},
      summary["arms"][name],
    )
    assert (
      row["adapted_steps"] == trace["phase"].count("adapting")
      and row["updates"] >= max(trace["updates"])
      and row["updates"] % 1 == 0
    )
    assert (row["updates"] > 0) == (name not in ("none", "randomised", "still"))
    for key in ("updates", "adapted_steps", "terminations", "return_lost_healthy"):
      assert (
        arm[f"{key}_mean"] == row[key] and arm[f"{key}_mean_ci"] is None
      )  # one stream has no interval
  wall = {name: columns(out, "runs", name)["wall_s"][0] for name in NAMES}
  assert summary["wall_s_arms"] == wall
  lived = summary["wall_s"] * (1 - summary["wall_share"]["other"])
  assert sum(wall.values()) == pytest.approx(lived) and min(wall.values()) > 0


def test_streams_pay_for_what_they_take():
  """Seconds of acting, watching and learning of three streams, on two cores, by hand."""
  cores = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 4.0], [1.0, 1.0, 0.0]])
  kinds = dict.fromkeys(KINDS, 0.0)
  run = types.SimpleNamespace(seconds=kinds, stream_seconds=np.zeros(3))
  Runner._account(run, 5.0, cores, 1.0, 0.0)
  assert run.stream_seconds.tolist() == [1.0, 3.0, 1.0]
  assert kinds == {
    "physics": 0.5,
    "acting": 1.0,
    "monitor": 1.5,
    "updates": 2.0,
    "compiling": 0.0,
    "other": 0.0,
  }
  Runner._account(run, 6.0, cores, 1.0, 2.5)  # something was compiled
  assert run.stream_seconds.tolist() == [3.0, 5.0, 3.0] and kinds["compiling"] == 6.0
  assert sum(kinds.values()) == 11.0


@pytest.mark.slow
def test_an_arm_with_an_agent_of_its_own(lived):
  """It lives as a run whose agent that is, the others as they do without it; the card is kept."""
  # with fresh parameters and a way back, all runs here are one program
  out, whole = lived(("none", "randomised", "rollback", "scratch")), lived(NAMES)
  folder = json.loads((out / "config.json").read_text())
  assert folder["agent_card"]["seed"] == 0 and {
    k: v["seed"] for k, v in folder["arm_cards"].items()
  } == {"randomised": 1}
  other = lived(("none", "rollback", "scratch"), suffix="-randomised")
  mine, same, first = (
    columns(out, "trace", "randomised"),
    columns(other, "trace", "none"),
    columns(out, "trace", "none"),
  )
  # a product of one row and of two may be summed in another order, which hundreds of steps of a
  # walker let grow
  np.testing.assert_allclose(mine["reward"][:50], same["reward"][:50], atol=1e-3)
  assert np.abs(np.subtract(mine["reward"][:50], first["reward"][:50])).max() > 0.02
  assert (
    "randomised"
    in {r["arm"] for r in normalised_recovery.rows(tables.read_rows(whole / "runs.parquet"))}
    and len(
      {r["reward_none"] for r in normalised_recovery.rows(tables.read_rows(whole / "runs.parquet"))}
    )
    == 1
  )
  assert (
    normalised_recovery.rows(tables.read_rows(whole / "runs.parquet"))[0]["reward_none"]
    == columns(whole, "runs", "none")["reward_final"][0]
  )


def test_an_arm_without_its_agent_is_refused(tiny, tmp_path):
  config = RunConfig("walker", fault="gear", steps=300, onset=200, seeds=1, arms=("randomised",))
  with pytest.raises(
    UserError, match="arm 'randomised': no agent 'quadruped-trot-2-randomised'; shipped: .*walker"
  ):
    run.Runner(dataclasses.replace(config, env="quadruped"), tmp_path)
  agents.save(
    tmp_path / "walker-randomised",
    jax.jit(tiny.init)(jax.random.key(0)),
    {"env": "walker", "dreamer": dataclasses.asdict(tiny.config)},
  )
  shutil.copytree(agents.HERE / "walker", tmp_path / "walker")
  with pytest.raises(
    UserError, match="arm 'randomised': agent .*walker-randomised' differs from the run's in size"
  ):
    run.Runner(dataclasses.replace(config, agent=str(tmp_path / "walker")), tmp_path / "out")


@pytest.mark.slow  # bit for bit only where a product's rows do not depend on how many there are
def test_detector_and_none_are_the_same_alone_and_beside_the_others(lived):
  out, pair = lived(FOUR), lived(FOUR[:2])
  for name in ("trace", "events", "runs"):
    for arm in ("detector", "none"):
      a, b = columns(out, name, arm), columns(pair, name, arm)
      assert list(a) == list(b) and a["arm"]
      for column in set(a) - {"stream", "wall_s"}:
        assert repr(a[column]) == repr(b[column]), (name, arm, column)


@pytest.mark.slow
def test_a_run_of_all_arms_resumes_to_the_same_files(lived):
  out, cut = (
    lived(NAMES),
    lived(NAMES, cut=6),
  )  # fresh parameters, fixed ends and schedules are on their way then
  for name in ("trace", "events", "runs"):
    a, b = columns(out, name), columns(cut, name)
    for column in set(a) - {"wall_s"}:
      assert repr(a[column]) == repr(b[column]), (name, column)
