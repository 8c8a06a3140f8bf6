"""Lives: every life is lived once, whoever else there is, and whatever shares the work."""

import dataclasses
import functools
import itertools
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl.adapt import decide
from mjx_cl.adapt.choices import Choices, Methods
from mjx_cl.config import CHUNK, FOREVER, AdaptConfig, RunConfig
from mjx_cl.errors import FileError
from mjx_cl.io.checkpoints import Checkpoints
from mjx_cl.runs import groups, lives, packing, run
from mjx_cl.runs import runner as runner_lib
from mjx_cl.training import agents

CHUNKS = 6
# an update a chunk or more, once ten windows of 17 records are there; nothing settles
ADAPT = AdaptConfig(
  warmup=CHUNK,
  start_windows=10,
  ratio=4.0,
  batch=4,
  patience=4,
  period=200,
  period_steps=130,
  random_steps=60,
  refit=60,
)
ARMS = ("none", "always", "oracle", "oracle-budget", "periodic", "random", "detector")
JOINED = {"always": 1, "oracle": 2, "oracle-budget": 2, "periodic": 3}  # chunk of the departure


@pytest.fixture(scope="module")
def saved(tiny, tmp_path_factory):
  """Folder of a tiny agent of random weights."""
  folder = tmp_path_factory.mktemp("agents") / "tiny"
  card = {"env": "walker", "preset": "tiny", "repeat": 1}
  agents.save(
    folder,
    jax.jit(tiny.init)(jax.random.key(0)),
    card | {"dreamer": dataclasses.asdict(tiny.config)},
  )
  return folder


@pytest.fixture(scope="module")
def make(saved, tmp_path_factory):
  """make(arms, seeds, ...): Runner of tiny agents."""

  def runner(arms=ARMS, seeds=1, out=None, healthy=None, **given):
    settings = dict(steps=CHUNKS * CHUNK, onset=150, physics="native", adapt=ADAPT)
    settings |= dict(detector="rolling_sigma_plain", settings={"window": 60, "warmup": 30})
    config = RunConfig("walker", fault="gear", agent=str(saved), arms=arms, seeds=seeds)
    config = dataclasses.replace(config, **({"severity": 0.5} | settings | given))
    return run.Runner(config, out or tmp_path_factory.mktemp("out"), healthy=healthy)

  return runner


def live(runner, chunks=CHUNKS):
  for _ in range(chunks):
    runner.step()
  return runner


def host(tree):
  """NumPy copies; random keys as their numbers."""
  key = lambda x: jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)
  return jax.tree.map(lambda x: np.array(jax.random.key_data(x) if key(x) else x), tree)


def stream(runner, arm, seed):
  """All that a trace says of one stream that has a number each step, and what it acts by."""
  g = runner.labels.index((arm, seed))
  columns = {k: v[:, g] for k, v in runner.trace().items() if v.ndim == 2}
  return columns | {"acting": host(runner.lives.acting(g))}


@pytest.fixture(scope="module")
def whole(make):
  """One seed in all ARMS; folders of what was saved on the way: {learners: folder}."""
  runner, kept = make(), {}
  runner.open()
  for _ in range(CHUNKS):
    runner.step()
    learners = len(runner.lives.place)
    if learners not in kept:
      runner.save()
      kept[learners] = runner.out.parent / f"{runner.out.name}-{learners}"
      shutil.copytree(runner.out, kept[learners])
  return runner, kept


# ---- who lives what ------------------------------------------------------------------------------


def test_arms_of_a_seed_are_one_life_until_they_depart(whole):
  """A stream departs with the chunk in which its arm starts, and what it lived in it is the life
  of all; afterwards its weights are its own.
  """
  runner, _ = whole
  trace = runner.trace()
  reward, none = trace["reward"], ARMS.index("none")
  assert np.isfinite(reward).all() and np.isfinite(trace["opr"][100:]).mean() > 0.5
  for arm, chunk in JOINED.items():
    g, end = ARMS.index(arm), (chunk + 1) * CHUNK
    for name in ("reward", "opr", "rpr"):
      assert trace[name][:end, g].tobytes() == trace[name][:end, none].tobytes(), (arm, name)
    assert trace["updates"][-1, g] > 0 and (reward[end:, g] != reward[end:, none]).any(), arm
  assert not trace["updates"][:, none].any()


def test_a_life_is_watched_once(make, monkeypatch):
  """Three arms of two seeds are two lives; those that have departed are watched by themselves."""
  runner, watched = make(("none", "detector", "oracle"), 2), []
  watch = runner.loop.watch
  monkeypatch.setattr(runner.loop, "watch", lambda *a: watched.append(0) or watch(*a))
  counts, learners = [], []
  for _ in range(4):
    learners.append(len(runner.lives.place))
    runner.step()
    counts.append(len(watched))
  assert np.diff([0, *counts]).tolist() == [2 + n for n in learners]
  assert learners[0] == 0 and learners[-1] >= 2


def test_an_arm_that_never_learns_keeps_the_shipped_weights(whole, same, saved):
  runner, _ = whole
  shipped = agents.load(str(saved), "walker", 24, 6).train.params
  g = ARMS.index("none")
  assert same(runner.lives.acting(g), shipped) and g not in runner.lives.place
  for arm in JOINED:
    assert not same(runner.lives.acting(ARMS.index(arm)), shipped), arm
    learnt = runner.lives.learnt(ARMS.index(arm))
    assert same(learnt.params, runner.lives.acting(ARMS.index(arm))) and learnt.updates > 0


def test_a_lane_of_a_band_gives_no_other_bits(whole, same):
  """Two oracles of a seed lie side by side in one band, and live the same."""
  runner, _ = whole
  one, other = (stream(runner, arm, 0) for arm in ("oracle", "oracle-budget"))
  places = [runner.lives.place[ARMS.index(a)] for a in ("oracle", "oracle-budget")]
  assert places[0][0] is places[1][0] and places[0][1] != places[1][1]
  assert one["updates"][-1] > 1 and same(one, other)


def test_a_life_is_the_same_with_other_seeds_and_learners(make, whole, same):
  """Seed 9 of ten, in another herd, band and lane, against the same seed alone."""
  many, alone = (
    live(make(("oracle", "none"), **n), 5) for n in (dict(seeds=10), dict(first_seed=9))
  )
  band, lane = many.lives.place[9]
  assert len(many.lives.herds) == 2 and len(many.lives.bands) == 3
  assert (many.lives.bands.index(band), lane) == (2, 1) and alone.lives.place[0][1] == 0
  for arm in ("oracle", "none"):
    assert same(stream(many, arm, 9), stream(alone, arm, 9)), arm
  assert stream(many, "oracle", 9)["updates"][-1] > 0
  assert len({stream(many, "none", seed)["reward"][-1] for seed in range(10)}) == 10
  # and with learners of its own seed around it
  first, other = stream(many, "oracle", 0), stream(whole[0], "oracle", 0)
  for name in ("reward", "opr", "rpr", "signals", "phase", "updates"):
    if name in first:
      assert same(first[name], other[name][: len(first[name])]), name


@pytest.mark.slow
def test_the_shipped_walkers_life_is_the_same_alone_and_among_ten(tmp_path, same):
  config = RunConfig("walker", fault="gear", arms=("none",), steps=640, onset=600, physics="native")
  many, alone = (
    live(run.Runner(dataclasses.replace(config, **own), tmp_path / name), 4)
    for name, own in (("many", dict(seeds=10)), ("alone", dict(seeds=1, first_seed=9)))
  )
  assert same(stream(many, "none", 9), stream(alone, "none", 9))
  assert np.isfinite(many.trace()["opr"][20:]).mean() > 0.8


@pytest.mark.parametrize(
  "changes",
  [
    pytest.param(dict(cores=1), id="one core", marks=pytest.mark.slow),
    pytest.param(dict(cores=7), id="seven"),
    pytest.param(dict(many=0), id="many groups", marks=pytest.mark.slow),
  ],
)
def test_how_the_work_is_shared_changes_nothing(make, monkeypatch, same, changes):
  """Threads, and whether a group is seen to as a whole by one of them."""
  asked = dict(arms=("always", "oracle", "none"), seeds=2)
  plain = live(make(**asked), 5)
  if "cores" in changes:
    monkeypatch.setattr(lives, "cores", lambda: list(range(changes["cores"])))
  else:
    monkeypatch.setattr(lives, "MANY", changes["many"])
  other = live(make(**asked), 5)
  assert len(plain.lives.place) == 4 and same(plain.trace(), other.trace())
  (one, bands), (two, again) = packing.pack(plain.lives), packing.pack(other.lives)
  assert bands == again and same(host(one), host(two))


def test_a_run_that_may_go_back_says_so_of_every_stream(make):
  """Streams that have learnt nothing weigh nothing, beside one whose learning is played."""
  runner = make(("none", "rollback", "oracle"), adapt=dataclasses.replace(ADAPT, warmup=150))
  loop, one = runner.loop, jnp.ones(1)

  def learn(state, seen, sight, rows, now, *more):
    phase, digest = loop.rest(state.phase, seen, now)
    told = digest._replace(back=one > 0, earned=one, earns=2 * one, decision=digest.decision + 1)
    return state._replace(phase=phase, **sight._asdict()), told

  loop.learn = learn
  live(runner, 4)
  trace, learners = runner.trace(), sorted(runner.lives.place)
  assert 2 in learners and 0 not in learners
  back = np.zeros((4, 3), bool)
  for g in learners:
    back[np.flatnonzero(trace["decision"][:, g])[0] :, g] = True
  assert trace["back"].tolist() == back.tolist() and back[2:, 2].all()
  np.testing.assert_array_equal(trace["earned"], np.where(back, 1.0, np.nan))
  np.testing.assert_array_equal(trace["earns"], np.where(back, 2.0, np.nan))


# ---- all streams as one band ---------------------------------------------------------------------


@pytest.mark.slow
def test_all_streams_as_one_band_decide_alike(make, monkeypatch, same, tmp_path):
  """As on an accelerator, from the start; and it goes on from what it saved. Numbers are those of
  other programs: rounded otherwise, which a robot that falls makes larger.
  """
  arms = ("always", "oracle", "none")
  plain = live(make(arms, 2), 4)
  together = functools.partial(lives.Lives, together=True)
  monkeypatch.setattr(runner_lib, "Lives", together)
  other = make(arms, 2, out=tmp_path / "out")
  other.open()
  live(other, 2)
  other.save()
  again = make(arms, 2, out=tmp_path / "out")
  live(other, 2)
  assert not other.lives.herds and [b.who for b in other.lives.bands] == [list(range(6))]
  one, two = plain.trace(), other.trace()
  for name in ("phase", "updates", "episode", "valid"):
    assert same(one[name], two[name]), name
  start = CHUNK  # after twice as many a walker on the floor makes 0.2 % of a last bit
  for name in ("reward", "opr", "rpr"):
    np.testing.assert_allclose(one[name][:start], two[name][:start], rtol=1e-3, atol=1e-3)
  other.checkpoints.close()
  again.open()
  again.resume()
  live(again, 2)
  assert same(again.trace(), two) and same(
    host(packing.pack(again.lives)[0]), host(packing.pack(other.lives)[0])
  )
  again.checkpoints.close()


# ---- departing -----------------------------------------------------------------------------------


@pytest.mark.parametrize("repeat", [1, 3])
def test_a_stream_departs_where_the_phase_machine_starts(repeat):
  """Random alarms, schedules, warm-ups, phases and times against `decide`."""
  rng, config, rows = np.random.default_rng(repeat), AdaptConfig(patience=4), 8
  state = decide.init(config)

  @jax.jit
  def starts(fired, phase, choices, now, config):
    begin = decide.starts(fired[:, None], choices.at, now, repeat, config)
    own = jax.tree.map(lambda x: x[None], state._replace(phase=phase))
    given = (jnp.zeros((1, 6)), jnp.zeros(1), begin, now, choices, 0.0, 0.0, config)
    return decide.decide(own, *given)[1][0] == decide.START

  seen = []
  for _ in range(600):
    now = int(rng.integers(1, 8)) * rows * repeat
    fired = rng.random(rows) < rng.choice([0.0, 0.1, 0.5])
    at = np.full((1, 8), FOREVER, np.int32)
    number = rng.integers(0, 4)
    at[0, :number] = rng.integers(0, 9 * rows * repeat, number)
    edges = [now - rows * repeat - 1, now - rows * repeat, now - 1, now]
    if rng.random() < 0.3:  # on the edges of the chunk
      at[0, 0] = max(0, rng.choice(edges))
    own = dataclasses.replace(
      config, warmup=max(0, int(rng.choice([rng.integers(0, 6 * rows * repeat), *edges])))
    )
    phase = decide.NOMINAL if rng.random() < 0.8 else decide.ABORTED
    one = lambda x, kind: jnp.full(1, x, kind)
    chosen = Choices(
      one(rng.random() < 0.5, bool),
      jnp.asarray(at),
      one(True, bool),
      one(9999, jnp.int32),
      one(0, jnp.int32),
      Methods(),
      None,
    )
    want = bool(starts(fired, jnp.int32(phase), chosen, jnp.int32(now), own))
    assert groups.departs(fired, phase, chosen, now, repeat, own) == want, (now, fired, at, own)
    seen.append(want)
  assert 0.1 < np.mean(seen) < 0.9


# ---- kill and resume -----------------------------------------------------------------------------


@pytest.mark.parametrize("learners", [0, 1, 5])
def test_a_run_that_was_cut_off_ends_as_the_whole_one(make, whole, same, learners, tmp_path):
  """Without a learner, with one, and with a second band."""
  runner, kept = whole
  assert learners in kept, sorted(kept)
  shutil.copytree(kept[learners], tmp_path / "out")
  again = make(out=tmp_path / "out")
  again.open()
  again.resume()
  assert len(again.lives.place) == learners and again.done_chunks < CHUNKS
  assert len(again.lives.bands) == -(-learners // groups.BAND)
  live(again, CHUNKS - again.done_chunks)
  again.checkpoints.close()
  assert same(again.trace(), runner.trace())
  (tree, bands), (want, whose) = packing.pack(again.lives), packing.pack(runner.lives)
  assert bands == whose and same(host(tree), host(want))


@pytest.mark.parametrize("learners, rollback", list(itertools.product((0, 1, 4, 5), (False, True))))
def test_shapes_are_those_of_what_is_packed(make, learners, rollback):
  arms = ("none", "rollback") if rollback else ("none", "oracle")
  runner, empty = (make(arms, 5) for _ in range(2))
  one = lambda x: x[:, :1]
  for g in range(5, 5 + learners):
    robot = jax.tree.map(one, runner.lives.herds[0].streams)
    runner.lives._join(g, runner.loop.init(runner.trained.train, 1, runner.lives.methods), robot)
  tree, bands = packing.pack(runner.lives)
  assert bands == [list(range(5, 5 + learners))[k : k + 4] for k in range(0, learners, 4)]
  shapes = lambda tree: jax.tree.map(lambda x: (x.shape, str(x.dtype)), tree)
  assert shapes(packing.like(empty.lives, bands)) == shapes(tree)
  packing.unpack(empty.lives, tree, bands)
  assert (
    shapes(packing.pack(empty.lives)[0]) == shapes(tree) and packing.pack(empty.lives)[1] == bands
  )
  assert sorted(empty.lives.place) == list(range(5, 5 + learners))


@pytest.mark.parametrize("tree", ["the same", "another"])
def test_a_checkpoint_of_an_earlier_version_is_refused_in_a_line(make, tmp_path, tree):
  runner = make(("none",), out=tmp_path / "out")
  runner.open()
  runner.step()
  runner.save()
  runner.checkpoints.close()
  old = Checkpoints(tmp_path / "out" / "work" / "checkpoints")
  kept, meta = packing.pack(runner.lives)[0], {"seconds": runner.seconds}
  old.save(2, kept if tree == "the same" else {"loop": np.zeros(3)}, meta)
  old.close()
  shutil.rmtree(old.folder / "1")
  again = make(("none",), out=tmp_path / "out")
  again.open()
  with pytest.raises(FileError) as e:
    again.resume()
  again.checkpoints.close()
  assert "\n" not in str(e.value) and "earlier version" in str(e.value)
  assert "--overwrite begins anew" in str(e.value) and (old.folder / "2").exists()
