"""Methods: one contract for each that ships, is installed or stands in the docs, and what is said
of one that breaks it.
"""

import dataclasses
import functools
import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick
from test_arms import EAGER, STEPS, hand_rows, scripted

from benchmarks import methods as told
from mjx_cl.adapt import decide, methods
from mjx_cl.adapt.arms import ALARM, ARMS, NEVER, NO_END, RULE, Arm
from mjx_cl.adapt.choices import settings as settings_of
from mjx_cl.adapt.loop import Loop, choices
from mjx_cl.adapt.methods import Acts, Method, Settings, quiet, staged
from mjx_cl.config import PRESETS, AdaptConfig, RunConfig
from mjx_cl.config import quick as quick_settings
from mjx_cl.dreamer.agent import Agent
from mjx_cl.errors import PluginError, UserError
from mjx_cl.rollout.monitor import Monitor
from mjx_cl.runs import identity, settings
from mjx_cl.types import Spec

ROOT = pathlib.Path(__file__).parents[2]
CHUNKS, ALARMED = 14, 37  # chunks lived; row of the alarm
END = 10  # chunk in which the first adaptation ends, where it has a budget
AGENT = Agent(dataclasses.replace(PRESETS["tiny"].dreamer, batch=4, length=8, imagine=4), 24, 6)
LASTING = dataclasses.replace(EAGER, budget=END * STEPS - ALARMED, patience=99)
TASK = Spec("", (), (), 0.02, 100, 0.6, None, ())


@pytest.fixture(scope="module")
def example(tmp_path_factory):
  """The method of docs/extending.md as FILE.py:make."""
  block = re.search(
    r"```python\n(# trust\.py.*?)```", (ROOT / "docs/extending.md").read_text(), re.S
  )
  path = tmp_path_factory.mktemp("methods") / "trust.py"
  path.write_text(block[1])
  assert len(block[1].splitlines()) < 60
  return f"{path}:trust"


NAMES = [*methods.METHODS, "example"]
NAMES += [name for name in ARMS if name not in ARMS.own and methods.of(ARMS[name]) != methods.PAPER]


OWN = {"paper": "detector"}  # name of the arm of a method, started by alarms, where it differs
each = pytest.mark.parametrize("g", range(len(NAMES)), ids=NAMES)


def begin(loop, arms, train):
  """State and choices of streams of arms."""
  labels = [(arm, i) for i, arm in enumerate(arms)]
  chosen = choices(labels, loop.config, STEPS * CHUNKS)
  state = loop.init(train, len(arms), chosen.methods.all)
  at = jnp.tile(jnp.array([ALARMED, -1, -1]), (len(arms), 1))
  return state._replace(detector=state.detector._replace(at=at)), chosen


@functools.cache
def loop_of(arms):
  """The loop that lives these arms; a program is compiled once."""
  loop = Loop(AGENT, Monitor(AGENT, n=4, least=2), scripted(), TASK, LASTING, capacity=512)
  loop.programs = quick.programs(loop)
  return loop


def live(arms, at=0, state=None):
  """[state of each chunk from `at` on, the begin included], [digest], of streams of arms whose
  detectors all alarm at the same row; `state`: goes on from that one.
  """
  loop = loop_of(arms)
  train = jax.jit(AGENT.init)(jax.random.key(0))
  # past the warm-up of the learning rate; fresh heads say exactly 0
  shake = lambda x: x + 0.01 * jax.random.normal(jax.random.key(x.size), x.shape)
  train = train._replace(params=jax.tree.map(shake, train.params), updates=jnp.int32(2000))
  new, chosen = begin(loop, arms, train)
  state = new if state is None else jax.tree.map(jnp.array, state)
  keys = jax.vmap(jax.random.key)(jnp.arange(len(arms)))
  copy = lambda tree: jax.tree.map(lambda x: np.array(x), tree)
  states, digests = [copy(state)], []
  for c in range(at, CHUNKS):
    rows = hand_rows(c * STEPS, len(arms))
    state, digest = loop.digest(state, rows, jnp.int32((c + 1) * STEPS), chosen, keys)
    states.append(copy(state))
    digests.append(copy(digest))
  assert quick.traces(loop.programs) == (1, 0, 1)  # the memory's shapes and types stay
  return states, digests


def _update(agent, memory, state, batch, key):
  """A gradient step of the method's own: the policy stays."""
  learnt, metrics, latents = agent.update(state, batch, key)
  return learnt._replace(params={**learnt.params, "pol": state.params["pol"]}), metrics, latents


COUNTS = Method(
  init=lambda params: (jnp.int32(0), params["pol"]["std"]["bias"]),
  act=lambda memory, view: Acts(quiet.still(view.acted), (memory[0] + 1, memory[1])),
  learns=False,
)
TRIED = {  # arms of methods that this file alone has
  "own": Arm("", ALARM, RULE, method=Method(update=_update)),
  "part": Arm(  # the dynamics alone are taken up
    "",
    ALARM,
    RULE,
    method=Method(
      keep=lambda memory, before, after: before._replace(
        params={**before.params, "dyn": after.params["dyn"]}
      )
    ),
  ),
  "later": Arm("", ALARM, RULE, method=COUNTS),
  "never": Arm("", NEVER, NO_END, method=COUNTS),
  "hiding": Arm(
    "",
    ALARM,
    RULE,
    method=Method(
      init=lambda params: jnp.int32(0),
      act=lambda chunk, view: methods.average(chunk + 1, view),
      hides=lambda chunk: chunk % 3 == 1,
    ),
  ),
  "eager": Arm(
    "", ALARM, RULE, method=Method(settings=Settings(average=1.0, start_windows=10_000))
  ),
}


@pytest.fixture(scope="module")
def arms(example):
  """Each method's arm, those of this file alone and one that never learns: streams of one program,
  since an update takes long to compile.
  """
  contract = (example if name == "example" else OWN.get(name, name) for name in NAMES)
  for name, arm in TRIED.items():
    ARMS.members[name] = lambda arm=arm: arm
  yield (*contract, *TRIED, "none")
  for name in TRIED:
    del ARMS.members[name]


@pytest.fixture(scope="module")
def lived(arms):
  """Their lives side by side."""
  return live(arms)


def stream(tree, g):
  """Of stream g, of fields that lead with streams."""
  return jax.tree.map(lambda x: x[g], tree)


@each
def test_shapes_are_right(arms, g):
  methods.check(arms[g], methods.of(ARMS[arms[g]]), AGENT)


@each
def test_it_is_frozen_until_the_alarm(lived, g, same):
  states, digests = lived
  first = next(c for c, d in enumerate(digests) if d.decision[g] == decide.START)
  assert first == ALARMED // STEPS
  for state in states[: first + 1]:
    for tree in ("acting", "train"):
      assert same(stream(getattr(state, tree), g), stream(getattr(states[0], tree), g))
  learns = NAMES[g] != "still"
  assert (digests[-1].updates[g] > 0) == learns
  changed = lambda tree: not same(stream(tree(states[-1]), g), stream(tree(states[0]), g))
  assert changed(lambda s: s.acting) and changed(lambda s: s.train.params) == learns


@each
def test_it_learns_from_what_came_after_the_alarm_alone(lived, g):
  states, digests = lived
  rows = states[-1].replay.data.obs[g, 0, :, 0]
  count = int(states[-1].replay.count[g, 0])
  assert count > 5 * STEPS and (rows[:count] > ALARMED).all()


def test_others_are_untouched(lived, same):
  """The stream that never learns to the last bit; the paper's as without the methods beside it,
  up to rounding: it is another program.
  """
  states, digests = lived
  for tree in ("acting", "train"):
    assert same(stream(getattr(states[-1], tree), -1), stream(getattr(states[0], tree), -1))
  alone, _ = live(("detector", "none"))
  flat = lambda state, g: np.concatenate([x[g].ravel() for x in jax.tree.leaves(state.acting)])
  moved = np.linalg.norm(flat(alone[8], 0) - flat(alone[0], 0))
  beside = flat(states[8], NAMES.index("paper"))
  assert moved > 0 and np.linalg.norm(beside - flat(alone[8], 0)) < 0.05 * moved


@each
def test_what_acts_when_it_is_over_is_learnt_on_from(lived, g, same):
  states, digests = lived
  over = next(c for c, d in enumerate(digests) if d.decision[g] == decide.ABORT_BUDGET)
  for state in states[over + 1 :]:
    acts, learns = stream(state.acting, g), stream(state.train.params, g)
    own = {**acts["pol"], "std": learns["pol"]["std"]}  # a robot may be quieter than its dreams
    assert same({**acts, "pol": own}, learns)
    assert same(acts, stream(states[over + 1].acting, g))


def test_they_go_on_from_a_checkpoint(lived, arms, same):
  states, _ = lived
  again, _ = live(arms, 6, states[6])
  assert same(again[-1], states[-1])


def test_the_tables_name_each_other():
  own = {arm.method for name, arm in ARMS.items() if name in ARMS.own}
  assert own == set(methods.METHODS)
  assert methods.used(("none", "calm", "rollback")) == (
    methods.PAPER,
    methods.METHODS["rollback"],
    methods.METHODS["calm"],
  )


def test_stages_by_hand(same):
  """Which parts of a state an update changes, by the number of updates before it."""
  train = jax.jit(AGENT.init)(jax.random.key(0))
  after = jax.tree.map(lambda x: x + 1, train)
  parts = {k: (lambda s, k=k: s.params[k]) for k in train.params}
  parts |= {"slow": lambda s: s.slow, "range": lambda s: s.range}
  for taken, still in ((0, 2), (staged.MODEL - 1, 2), (staged.MODEL, 1), (staged.CRITIC, 0)):
    kept = staged.keep(jnp.int32(taken), train, after)
    held = {k for k, part in parts.items() if same(part(kept), part(train))}
    assert held == [set(), {"pol"}, {"pol", "val", "slow", "range"}][still], taken
    assert kept.updates == after.updates


def test_a_residual_is_linear_and_bounded_by_hand(same):
  """Its trunk is that of before; the head moves by 0.02 at most from where it was at the onset."""
  method = told.residual().method
  methods.check("residual", method, AGENT)
  train = jax.jit(AGENT.init)(jax.random.key(0))
  far = jax.tree.map(lambda x: x + 1, train)
  near = jax.tree.map(lambda x: x + jnp.asarray(0.01, x.dtype), train)
  memory = methods.remember(method, train.params)
  for after, moved in ((far, 0.02), (near, 0.01)):
    kept = method.keep(memory, train, after)
    assert same(kept.params["pol"]["mlp"], train.params["pol"]["mlp"])
    move = jax.tree.map(lambda a, b: a - b, kept.params["pol"]["mean"], train.params["pol"]["mean"])
    for step in jax.tree.leaves(move):
      np.testing.assert_allclose(step, moved, atol=1e-6)  # float32 near 1
    rest = lambda s: {**s.params, "pol": s.params["pol"]["std"]}
    assert same(rest(kept), rest(after)) and same(kept.slow, after.slow)


def test_a_calm_robot_explores_in_dreams_alone(lived):
  states, digests = lived
  g = NAMES.index("calm")
  deter = jax.random.normal(jax.random.key(1), (5, AGENT.size.deter))
  stoch = AGENT.hot(jnp.zeros((5, AGENT.size.stoch), int))
  spread = lambda params: np.asarray(AGENT._policy(stream(params, g), deter, stoch)[1])
  learning = [c for c, d in enumerate(digests) if d.phase[g] == decide.ADAPTING and d.updates[g]]
  least, _ = AGENT.deviations
  for c, state in enumerate(states[1:]):
    assert (spread(state.train.params) > 2 * least).all()  # what dreams
    assert (spread(state.acting).max() < 1.001 * least) == (c in learning)
  assert len(learning) > 3


def test_a_quiet_robot_explores_in_dreams_alone(lived, same):
  """From the alarm on and for good; it learns from other records than the paper's, by its rule."""
  least, _ = AGENT.deviations
  deter = jax.random.normal(jax.random.key(1), (5, AGENT.size.deter))
  stoch = AGENT.hot(jnp.zeros((5, AGENT.size.stoch), int))
  states, digests = lived
  for arm in ("quiet", "quiet-guarded", "still"):
    g = NAMES.index(arm)
    spread = lambda params: np.asarray(AGENT._policy(stream(params, g), deter, stoch)[1])
    first = next(c for c, d in enumerate(digests) if d.decision[g] == decide.START)
    for c, state in enumerate(states):
      assert (spread(state.train.params) > 2 * least).all()
      assert (spread(state.acting).max() < 1.001 * least) == (c > first)
  # `still`: but for its deviations as it was
  acts, was = stream(states[-1].acting, g), stream(states[0].acting, g)
  assert same({**acts, "pol": {**acts["pol"], "std": was["pol"]["std"]}}, was)


def test_an_update_of_ones_own_takes_the_place_of_dreamers(lived, arms, same):
  """A gradient step of the method's own, in a stream beside another."""
  states, digests = lived
  g, paper = arms.index("own"), arms.index("detector")
  policy = lambda state, at: stream(state.train.params["pol"], at)
  assert same(policy(states[-1], g), policy(states[0], g))
  assert not same(policy(states[-1], paper), policy(states[0], paper))
  assert digests[-1].updates[g] == digests[-1].updates[paper] > 0


def test_an_update_counts_whatever_of_it_is_taken_up(lived, arms):
  """From the state before, the dynamics alone replaced: the counter is the loop's."""
  g, paper = arms.index("part"), arms.index("detector")
  for digest in lived[1]:
    assert digest.updates[g] == digest.updates[paper]
  assert digest.updates[g] > 0


def test_a_method_waits_for_the_first_adaptation(lived, arms, same):
  """Where all streams share a program, as on an accelerator: one that never adapts acts by what it
  came with, and its method remembers nothing; another's begins with what acted then.
  """
  states, digests = lived
  later, never = arms.index("later"), arms.index("never")
  number, bias = states[-1].memory[methods.used(arms).index(COUNTS)]
  first = next(c for c, d in enumerate(digests) if d.decision[later] == decide.START)
  assert number[[later, never, -1]].tolist() == [len(digests) - first, 0, 0]
  assert same(stream(states[-1].acting, never), stream(states[0].acting, never))
  assert (stream(states[-1].acting, later)["pol"]["std"]["bias"] == quiet.LOW).all()
  assert (bias[later] == states[0].acting["pol"]["std"]["bias"][later]).all()


def test_a_quiet_robot_of_new_weights_has_their_deviations():
  """A second adaptation that begins with weights drawn anew, and one that does not."""
  own, new = (jax.jit(AGENT.init)(jax.random.key(k)).params for k in range(2))
  raised = lambda tree, level: jax.tree.map(lambda x: x + level, tree)
  std = lambda params, level: {
    **params,
    "pol": {**params["pol"], "std": raised(params["pol"]["std"], level)},
  }
  own, new = std(own, 1.0), std(new, 2.0)
  none, memory = jnp.float32(jnp.nan), quiet.Quiet((), own, jnp.bool_(True))
  after = lambda acted: quiet.METHOD.act(
    memory,
    methods.View(
      *(jnp.int32(decide.CONVERGED), jnp.int32(decide.ADAPTING), jnp.bool_(True), jnp.bool_(False)),
      *(none, none, jnp.full(6, jnp.nan), jnp.int32(0), jnp.float32(0.0), acted, own),
    ),
  ).memory.params["pol"]["std"]["bias"]
  assert (after(new) == new["pol"]["std"]["bias"]).all()
  assert (after(quiet.still(new)) == own["pol"]["std"]["bias"]).all()


def test_the_rule_reads_nothing_of_a_chunk_that_a_method_hides(lived, arms):
  states, digests = lived
  phase = states[-1].phase
  for g, want in ((arms.index("hiding"), True), (arms.index("detector"), False)):
    lived = slice(phase.count[g])
    hidden = np.isnan(phase.posture[g, lived])
    assert lived.stop > 4 and hidden.any() == want and not hidden.all()
    assert (np.isnan(phase.ring[g, lived]).all(1) == hidden).all()
    assert np.isfinite(digests[-1].signals[g]).all()  # what is written down hides nothing


def test_who_is_told_its_stop_keeps_the_weights_of_that_snapshot(same):
  """A snapshot of an age holds what that chunk has learnt."""
  arms, onset, chunk = ("oracle-budget", "oracle-stop"), 37, 7
  age = chunk * STEPS - onset
  loop = loop_of(arms)
  labels = [(arm, 0) for arm in arms]
  chosen = choices(labels, loop.config, STEPS * CHUNKS, [(onset,)] * 2, {0: age})
  train = jax.jit(AGENT.init)(jax.random.key(0))
  state = loop.init(train._replace(updates=jnp.int32(2000)), 2, chosen.methods.all)
  keys, snapshots = jax.vmap(jax.random.key)(jnp.zeros(2, int)), []
  for c in range(chunk + 2):
    rows = hand_rows(c * STEPS, 2)
    state, digest = loop.digest(state, rows, jnp.int32((c + 1) * STEPS), chosen, keys)
    snapshots.append(jax.tree.map(lambda x: np.array(x[0]), state.acting))
  assert digest.phase.tolist() == [decide.ADAPTING, decide.ENDED]
  told = stream(state.acting, 1)
  assert same(told, snapshots[chunk - 1])
  assert not same(told, snapshots[chunk - 2]) and not same(told, snapshots[chunk])


def found(batch):
  """The latents that the batch came with."""
  return batch.deter[:, 1:], batch.stoch[:, 1:]


def test_an_update_is_tried_on_what_the_learner_draws():
  """Dreamer's own passes, and so does one that reads the batch alone."""
  whole = lambda agent, memory, state, batch, key: agent.update(state, batch, key)
  still = lambda agent, memory, state, batch, key: (state, {"x": batch.reward[0, 0]}, found(batch))
  for update in (whole, still):
    methods.check("mine", Method(update=update), AGENT)


@dataclasses.dataclass
class Unhashed:
  """A callable of a plain dataclass has no hash."""

  rate: float = 0.1

  def __call__(self, memory, view):
    return methods.average(memory, view)


BROKEN = {
  "init of its method fails: KeyError": Method(init=lambda params: params["policy"]),
  "act of its method fails: AttributeError": Method(act=lambda memory, view: view.weights),
  "act of its method must give an Acts": Method(act=lambda memory, view: view.acted),
  "act of its method must keep structure, shapes and types of the parameters": Method(
    act=lambda memory, view: Acts(view.acted["pol"], memory)
  ),
  "what act gives the learner of its method must keep structure, shapes and types of the para": (
    Method(act=lambda memory, view: Acts(view.acted, memory, learner=view.acted["pol"]))
  ),
  "act of its method must keep structure and shapes of memory": Method(
    act=lambda memory, view: Acts(view.acted, (1.0,))
  ),
  "keep of its method must keep structure, shapes and types of the learner's state": Method(
    keep=lambda memory, before, after: after.params
  ),
  "update of its method fails: ValueError: not enough values to unpack": Method(
    update=lambda agent, memory, state, batch, key: (state, {})
  ),
  "update of its method fails: NameError: name 'undefined'": Method(
    update=lambda agent, memory, state, batch, key: (state, {}, undefined)  # noqa: F821
  ),
  "update of its method must keep structure, shapes and types of the learner's state": Method(
    update=lambda agent, memory, state, batch, key: (state.params, {}, found(batch))
  ),
  "update of its method must keep shapes of the latents": Method(
    update=lambda agent, memory, state, batch, key: (state, {}, (batch.deter, batch.stoch))
  ),
  "hides of its method must keep structure, shapes and types of one bool": Method(
    hides=lambda memory: 1.0
  ),
  "earned of its method's Acts must be one value of a stream": Method(
    act=lambda memory, view: Acts(view.acted, memory, earned=jnp.zeros(2), earns=jnp.zeros(2))
  ),
  "the functions of its method need a hash: unhashable type: 'Unhashed'": Method(act=Unhashed()),
  "copies of its method must be 0 or more; got -5": Method(copies=-5),
  "the memory of its method holds a key; keep jax.random.key_data of it": Method(
    init=lambda params: jax.random.key(0)
  ),
}


@pytest.mark.parametrize("said", BROKEN)
def test_a_broken_method_is_refused_in_a_line(said):
  with pytest.raises(PluginError) as e:
    methods.check("mine", BROKEN[said], AGENT)
  assert str(e.value).startswith(f"arm 'mine': {said}") and "\n" not in str(e.value)


def test_what_is_no_arm_is_refused_in_a_line(tmp_path):
  file = tmp_path / "mine.py"
  file.write_text(
    "from mjx_cl.adapt.arms import ALARM, RULE, Arm, Trigger\n"
    "def fails():\n  raise ValueError('no luck')\ndef other():\n  return 3\n"
    "def word():\n  return Arm('', 'ALARM', RULE)\n"
    "def past():\n  return Arm('', Trigger('', lambda *_: (-2**40,)), RULE)\n"
    "def nothing():\n  return Arm('', Trigger('', lambda *_: None), RULE)\n"
  )
  for name, said in (
    ("word", "its trigger must be a mjx_cl.adapt.arms.Trigger; got 'ALARM'"),
    ("fails", "cannot be made: ValueError: no luck"),
    ("other", "must give a mjx_cl.adapt.arms.Arm; got 3"),
    ("othr", "has nothing of the name 'othr' that can be called; did you mean 'other'"),
  ):
    with pytest.raises((PluginError, UserError), match=re.escape(said)):
      settings.check(RunConfig("walker", arms=(f"{file}:{name}",)))
  for name in ("past", "nothing"):
    with pytest.raises(PluginError, match="trigger must give control steps, whole numbers from 0"):
      choices([(f"{file}:{name}", 0)], AdaptConfig(), 1000, [(500,)])


def test_a_run_knows_the_file_of_its_arm(example):
  """A run that goes on notices that the method has changed meanwhile."""
  config = settings.check(RunConfig("walker", arms=("none", example)))
  files = identity.identity(config)["files"]
  assert set(files) == {example} and len(files[example]) == 64


def test_settings_of_a_method_stand_above_defaults_alone():
  """Where the run's value is the default the method's own counts, in its streams alone."""
  own = [methods.PAPER, Method(settings=Settings(start_windows=256, regain=0.9))]
  said = settings_of(own, AdaptConfig())
  assert {k: v.tolist() for k, v in said.items()} == {
    "start_windows": [1024.0, 256.0],
    "regain": [0.0, np.float32(0.9)],
  }
  assert set(settings_of(own, AdaptConfig(start_windows=512))) == {"regain"}
  swift = [methods.METHODS["swift"]]  # what --quick asks for is a default too
  assert settings_of(swift, quick_settings.ADAPT)["start_windows"].tolist() == [64.0]
  assert settings_of([methods.PAPER] * 2, AdaptConfig()) == {}
  with pytest.raises(UserError, match="start_windows must be above 0"):
    Settings(start_windows=0)


def test_a_loop_lives_by_the_settings_of_a_method(lived, arms):
  """Its own rate of the moving average; the run's `start_windows`, which is no default, stands."""
  states, digests = lived
  eager, paper = arms.index("eager"), arms.index("detector")
  before = states[END - 1]  # still adapting
  apart = lambda g: max(
    np.abs(x[g] - y[g]).max()
    for x, y in zip(jax.tree.leaves(before.acting), jax.tree.leaves(before.train.params))
  )
  assert apart(eager) < 1e-6 < 1e-4 < apart(paper)  # a + (p - a) is p but for rounding
  assert digests[-1].updates[eager] == digests[-1].updates[paper] > 0


def test_what_must_be_back_by_hand():
  known = {"mean": jnp.array([0, 0, 0.75, 0, 0, 0.0]), "number": jnp.ones(6)}
  state = decide.init(LASTING)._replace(**known)
  poor = state._replace(mean=state.mean.at[2].set(-2.0))
  both = jax.tree.map(lambda *x: jnp.stack(x), state, poor)
  level = lambda accepted, regain: decide.regained(both, accepted, regain).tolist()
  assert level(0.48, 0.0) == pytest.approx([0.48, 0.48])
  assert level(0.48, 0.9) == pytest.approx([0.675, 0.48])
  assert level(-9.0, 0.9) == pytest.approx([0.675, -2.2])
  assert level(-9.0, jnp.array([0.0, 1.0])) == pytest.approx([-9.0, -2.0])
  fresh = jax.tree.map(lambda x: x[None], decide.init(LASTING))  # it alarmed in its first chunk
  assert decide.regained(fresh, -5.0, 0.9).tolist() == [-5.0]
