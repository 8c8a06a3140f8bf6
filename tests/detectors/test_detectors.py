"""Detectors: one contract for every entry of the table and every scalar detector, then each against
its own oracle.
"""

import importlib
import json
import pathlib
import pkgutil
import re

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick
import scipy.stats

from mjx_cl import detectors
from mjx_cl.detectors import Alarm, Detector, any_of, innovations, on, rolling_sigma
from mjx_cl.errors import UserError
from mjx_cl.leaderboard import entries as entries_of
from mjx_cl.leaderboard import program as program_of
from mjx_cl.rollout.monitor import GROUPS, LATENT, Residual, unknown

# one detector a file, named as the file; a map over one float32
SCALAR = {
  m.name: f
  for m in pkgutil.iter_modules(detectors.__path__)
  if (f := getattr(importlib.import_module(f"mjx_cl.detectors.{m.name}"), m.name, None)) is not None
  and m.name in detectors.DETECTORS
  and getattr(f, "takes", "scalar") == "scalar"
}
ALL = {f"{k} (residual)": lambda k=k: detectors.make(k) for k in detectors.DETECTORS}
ALL |= {f"{k} (scalar)": lambda f=f: on("opr", f()) for k, f in SCALAR.items()}
REFERENCES = {
  f"{k} (residual)" for k, f in detectors.DETECTORS.items() if getattr(f, "reference", False)
}  # they look at nothing
STREAMS, STEPS = 3, 700
ERRORS = len(innovations.fit_of("walker").grain)


def residuals(key, steps=STEPS, streams=None, invalid=0.1):
  """Gaussian residuals around 1; a tenth of the rows is unknown, that is nan throughout."""
  shape = (steps,) if streams is None else (steps, streams)
  keys = jax.random.split(key, 3)
  valid = jax.random.uniform(keys[0], shape) >= invalid
  draw = lambda k: jnp.where(valid, 1.0 + 0.1 * jax.random.normal(k, shape), jnp.nan)
  opr = draw(keys[1])
  wide = lambda k, n: jnp.where(
    valid[..., None], 1.0 + 0.1 * jax.random.normal(k, shape + (n,)), jnp.nan
  )
  more = jax.random.split(keys[2], 5)
  return Residual(
    opr,
    draw(keys[2]),
    opr[..., None] * jnp.ones(4),
    valid,
    wide(more[0], GROUPS),
    draw(more[1]),
    jnp.zeros(shape, bool),
    draw(more[2]),
    wide(more[3], LATENT),
    wide(more[4], ERRORS),
  )


@pytest.fixture(params=ALL, scope="module")
def case(request):
  """A detector and its one jitted program over several streams."""
  detector = ALL[request.param]()
  start = jax.tree.map(
    lambda x: jnp.broadcast_to(x, (STREAMS,) + x.shape).astype(x.dtype), detector.init()
  )
  program = quick.jit(lambda state, xs: jax.lax.scan(jax.vmap(detector.update), state, xs))
  return detector, lambda xs, state=start: program(state, xs)


# ---- contract ------------------------------------------------------------------------------------


def test_table_and_files_are_found():
  assert "rolling_sigma" in SCALAR and {"rolling_sigma", "rolling_sigma_plain"} <= set(
    detectors.DETECTORS
  )
  marked = {name for name, f in SCALAR.items() if getattr(f, "takes", None) == "scalar"}
  assert marked <= set(
    detectors.DETECTORS
  )  # a file with a scalar detector has its line in the table


def test_every_detector_states_its_direction_and_blind_spots():
  for name, factory in {
    **{k: detectors.DETECTORS[k] for k in detectors.DETECTORS.own},
    **SCALAR,
  }.items():
    text = " ".join(factory.__doc__.split())
    assert "Blind to: " in text, name
    if not getattr(factory, "reference", False):
      assert re.search(r"(?i)\b(one|two)[-_]sided\b|\ba (rise|fall) of\b|`up` or `down`", text), (
        name
      )


def test_update_keeps_structure_shapes_and_dtypes(case):
  detector, _ = case
  x = jax.tree.map(lambda a: a[0], residuals(jax.random.key(0)))
  state = detector.init()
  new, alarm = jax.eval_shape(detector.update, state, x)
  chex.assert_trees_all_equal_shapes_and_dtypes(new, state)
  assert jax.tree.structure(new) == jax.tree.structure(state) and isinstance(alarm, Alarm)
  assert (alarm.fired.shape, alarm.fired.dtype, alarm.score.shape, alarm.score.dtype) == (
    (),
    jnp.bool_,
    (),
    jnp.float32,
  )


def test_scan_of_vmap_equals_each_stream_alone(case, same):
  detector, program = case
  xs = residuals(jax.random.key(1), streams=STREAMS)
  state, alarms = program(xs)
  assert alarms.fired.shape == (STEPS, STREAMS)
  alone = quick.jit(lambda xs: jax.lax.scan(detector.update, detector.init(), xs))
  for g in range(STREAMS):
    state_g, alarms_g = alone(jax.tree.map(lambda x: x[:, g], xs))
    chex.assert_trees_all_close(
      alarms_g.score, alarms.score[:, g], rtol=1e-4, atol=1e-4
    )  # another order of a sum of the window in float32
    np.testing.assert_array_equal(alarms_g.fired, alarms.fired[:, g])
    chex.assert_trees_all_close(state_g, jax.tree.map(lambda x: x[g], state), rtol=1e-4)


def test_same_input_gives_equal_bits(case, same):
  _, program = case
  xs = residuals(jax.random.key(2), streams=STREAMS)
  assert same(program(xs), program(xs))


def test_an_invalid_row_changes_nothing(case, same):
  detector, program = case
  state, _ = program(residuals(jax.random.key(3), streams=STREAMS))
  nan, update = jnp.full(STREAMS, jnp.nan), quick.jit(jax.vmap(detector.update))
  for filling in (nan, jnp.full(STREAMS, 1e9)):  # whatever the row holds
    wide = lambda n: jnp.tile(filling[:, None], n)
    row = unknown((STREAMS,), 4)._replace(
      opr=filling, rpr=filling, variables=wide(4), groups=wide(GROUPS), innovation=wide(ERRORS)
    )
    new, alarm = update(state, row)
    assert same(new, state)
    assert not alarm.fired.any() and np.isnan(alarm.score).all()


def test_invalid_rows_may_as_well_be_cut_out(case, request):
  _, program = case
  xs = residuals(jax.random.key(4), streams=STREAMS, invalid=0.2)
  order = jnp.argsort(
    ~xs.valid, axis=0, stable=True
  )  # the valid rows one after the other, the others behind them, where they change nothing
  kept = jax.tree.map(
    lambda x: jnp.take_along_axis(x, order.reshape(order.shape + (1,) * (x.ndim - 2)), 0), xs
  )
  (state, alarms), (state_kept, alarms_kept) = program(xs), program(kept)
  chex.assert_trees_all_close(
    state, state_kept, rtol=1e-6
  )  # the same sums, perhaps fused another way
  for g in range(STREAMS):
    valid = np.asarray(xs.valid[:, g])
    assert 0 < valid.sum() < STEPS
    if request.node.callspec.params["case"] in (
      "kswin (residual)",
      "kswin (scalar)",
      "rolling_sigma_plain (residual)",
      "rolling_sigma (scalar)",
    ):
      assert np.isfinite(alarms.score[valid, g]).any()  # not nan compared with nan
    chex.assert_trees_all_close(
      alarms.score[valid, g], alarms_kept.score[: valid.sum(), g], rtol=1e-5, atol=1e-5
    )


def test_a_step_change_is_found(case, request):
  if request.node.callspec.params["case"] in REFERENCES:
    pytest.skip("detects nothing by design")
  _, program = case
  onset, steps = (
    2500,
    4 * STEPS,
  )  # a long past: every sample of the change enters the reference of a rolling rule
  xs = residuals(jax.random.key(5), steps, STREAMS, invalid=0.0)
  late = (jnp.arange(steps) >= onset)[:, None]
  jump = lambda x: (
    x + 1.0 * (late if x.ndim == 2 else late[..., None])
  )  # ten deviations, in whatever a detector looks at
  xs = xs._replace(
    **{
      k: jump(getattr(xs, k))
      for k in ("opr", "rpr", "variables", "groups", "surprise", "latent", "innovation")
    },
    reward=xs.reward - 1.0 * late,
  )
  fired, past = [], ()
  for k in range(0, steps, STEPS):
    state, alarms = program(jax.tree.map(lambda x: x[k : k + STEPS], xs), *past)
    fired, past = fired + [alarms.fired], (state,)
  assert jnp.concatenate(fired)[onset:].any(0).all()


# ---- rolling_sigma -------------------------------------------------------------------------------


def slow_rolling_sigma(
  xs, window, threshold, patience, two_sided, warmup, smooth=1, lag=0, log=False
):
  """The docstring in NumPy and float64, one sample at a time."""
  seen, run, fired, scores = [], 0, [], []
  xs = np.log(np.maximum(xs, 1e-9)) if log else xs
  for t in range(len(xs)):
    y = np.mean(xs[max(0, t + 1 - smooth) : t + 1])
    held = np.array(seen[: len(seen) - lag][-window:]) if lag < len(seen) else np.array([])
    if t - lag < min(warmup, window):
      fired.append(False)
      scores.append(np.nan)
    else:
      z = (y - held.mean()) / max(held.std(), 1e-6)
      score = abs(z) if two_sided else z
      run = run + 1 if score > threshold else 0
      fired.append(run == patience)
      scores.append(score)
    seen.append(y)
  return np.array(fired), np.array(scores)


@pytest.mark.parametrize(
  "settings",
  [
    dict(window=50, threshold=2.0, patience=1, two_sided=True, warmup=20),
    dict(window=50, threshold=2.0, patience=1, two_sided=False, warmup=20),
    dict(window=30, threshold=0.5, patience=3, two_sided=False, warmup=30),
    dict(
      window=20, threshold=1.0, patience=2, two_sided=True, warmup=500
    ),  # a warm-up beyond the window ends with it
    dict(window=2, threshold=1.5, patience=1, two_sided=True, warmup=2),
    dict(window=40, threshold=1.5, patience=1, two_sided=False, warmup=10, smooth=7, lag=13),
    dict(window=40, threshold=1.2, patience=3, two_sided=True, warmup=40, smooth=4, lag=1),
    dict(
      window=40, threshold=1.5, patience=1, two_sided=True, warmup=10, smooth=3, lag=5, log=True
    ),
  ],
)
def test_rolling_sigma_equals_the_loop(settings):
  rng = np.random.default_rng(0)
  xs = (rng.normal(5.0, 2.0, 300) + np.repeat([0, 4, -3], 100)).astype(np.float32)
  detector = rolling_sigma(**settings)
  alarms = jax.lax.scan(detector.update, detector.init(), jnp.asarray(xs))[1]
  fired, scores = slow_rolling_sigma(xs.astype(float), **settings)
  if (
    settings["window"] > 2
  ):  # a window of two nearly equal samples loses the digits of its deviation
    np.testing.assert_allclose(
      alarms.score, scores, rtol=1e-3, atol=1e-4
    )  # float32 sums of at most 50 samples of size 5
  assert fired.any() and not fired.all()
  np.testing.assert_array_equal(alarms.fired, fired)


@pytest.mark.parametrize(
  "settings",
  [
    dict(window=400, lag=37, smooth=9),
    dict(window=1000, lag=0),
    dict(window=131, lag=300, smooth=2),
    dict(window=3, lag=2),
  ],
)
def test_blocks_of_a_long_window_add_up_to_the_loop(settings):
  """Several blocks, ring buffers that have gone round more than twice, and 20 samples a thousand
  deviations off that come and leave again.

  Float32: a sum of squares of 20 * 10^6 beside 10^3, never subtracted; the old samples' share of z
  is known to 1e-4 behind it.
  """
  settings = dict(dict(threshold=2.0, patience=1, two_sided=False, warmup=3, smooth=1), **settings)
  rng = np.random.default_rng(1)
  xs = rng.normal(5.0, 2.0, 3 * (settings["window"] + settings["lag"]) + 100).astype(np.float32)
  xs[len(xs) // 3 : len(xs) // 3 + 20] += 2000.0
  detector = rolling_sigma(**settings)
  alarms = quick.jit(lambda xs: jax.lax.scan(detector.update, detector.init(), xs)[1])(
    jnp.asarray(xs)
  )
  fired, scores = slow_rolling_sigma(xs.astype(float), **settings)
  np.testing.assert_allclose(alarms.score, scores, rtol=1e-4, atol=1e-4)
  np.testing.assert_array_equal(alarms.fired, fired)
  assert fired.any() and not fired[-50:].all()


def test_a_sample_that_is_nan_is_none(same):
  """Whatever the phase of blocks and rings it falls on: with one nan in two, state and alarms are
  those of the others alone.
  """
  settings = dict(window=40, threshold=1.5, warmup=10, smooth=3, lag=5)
  xs = jax.random.normal(jax.random.key(3), (250,))
  detector = rolling_sigma(**settings)
  run = quick.jit(lambda xs: jax.lax.scan(detector.update, detector.init(), xs))
  gaps = jnp.stack([jnp.full(250, jnp.nan), xs], 1).reshape(-1)
  (state, alarms), (other, holed) = run(xs), run(gaps)
  assert same(state, other) and same(alarms, jax.tree.map(lambda a: a[1::2], holed))
  assert alarms.fired.any() and not holed.fired[::2].any() and jnp.isnan(holed.score[::2]).all()


def test_one_alarm_per_excursion():
  """Ten samples beyond the threshold are one alarm; the next needs a sample below first."""
  quiet = jax.random.normal(jax.random.key(0), (200,)).clip(-2, 2)
  xs = jnp.concatenate([quiet, jnp.full(10, 50.0), quiet[:5], jnp.full(10, 90.0)])
  detector = rolling_sigma(window=100, threshold=4.0, warmup=50, lag=30)
  fired = jax.lax.scan(detector.update, detector.init(), xs)[1].fired
  assert np.flatnonzero(fired).tolist() == [200, 215]


def test_lag_keeps_a_change_out_of_its_own_reference():
  xs = jnp.concatenate(
    [
      jax.random.normal(jax.random.key(0), (200,)),
      3.0 + jax.random.normal(jax.random.key(1), (60,)),
    ]
  )
  last = {
    lag: float(jax.lax.scan(d.update, d.init(), xs)[1].score[-1])
    for lag in (0, 80)
    for d in [rolling_sigma(window=100, threshold=4.0, warmup=50, smooth=20, lag=lag)]
  }
  assert last[80] > 3 * last[0] > 0


def test_a_constant_stream_has_a_floor_under_its_deviation():
  detector = rolling_sigma(window=10, warmup=5)
  alarms = jax.lax.scan(
    detector.update, detector.init(), jnp.concatenate([jnp.full(20, 3.0), jnp.array([3.5])])
  )[1]
  assert not alarms.fired[:20].any() and alarms.fired[20]
  np.testing.assert_allclose(alarms.score[20], 0.5 / 1e-6, rtol=1e-5)  # float32


def test_one_sided_is_blind_to_a_fall():
  xs = jnp.concatenate([jax.random.normal(jax.random.key(0), (200,)), jnp.full(5, -8.0)])
  for two_sided in (True, False):
    detector = rolling_sigma(window=100, threshold=5.0, warmup=50, two_sided=two_sided)
    assert bool(jax.lax.scan(detector.update, detector.init(), xs)[1].fired.any()) == two_sided


def test_arl0_of_three_sigma_is_the_published_370():
  """Two-sided three-sigma limits on Gaussian samples: ARL0 = 1 / P(|z| > 3) = 370.4 (Montgomery,
  Introduction to Statistical Quality Control).

  With mean and deviation of a window of W samples, z sqrt((W - 1) / (W + 1)) is Student's t with W
  - 1 degrees: 359 for W = 1,000.
  """
  window, streams, steps = 1000, 100, 4000
  detector = rolling_sigma(window=window, threshold=3.0, warmup=window)
  start = jax.tree.map(lambda x: jnp.broadcast_to(x, (streams,) + x.shape), detector.init())
  xs = jax.random.normal(jax.random.key(0), (window + steps, streams))
  fired = quick.jit(lambda xs: jax.lax.scan(jax.vmap(detector.update), start, xs)[1].fired)(xs)
  assert not fired[:window].any()
  arl0 = streams * steps / int(fired.sum())
  exact = 1 / (2 * scipy.stats.t.sf(3 * np.sqrt((window - 1) / (window + 1)), window - 1))
  assert abs(exact - 370.4) < 15  # a long window is near the published value
  # 400,000 samples give about 1,100 alarms, so 1 / sqrt(1100) = 3 % standard error; three of them
  np.testing.assert_allclose(arl0, exact, rtol=0.09)


@pytest.mark.parametrize(
  "settings",
  [
    dict(window=1),
    dict(window=0),
    dict(patience=0),
    dict(threshold=0),
    dict(threshold=-1),
    dict(threshold=float("nan")),
    dict(warmup=1),
    dict(warmup=-5),
    dict(smooth=0),
    dict(lag=-1),
    dict(unit=0.0),
  ],
)
def test_bad_settings_are_refused(settings):
  with pytest.raises(UserError, match="rolling_sigma needs"):
    rolling_sigma(**settings)
  with pytest.raises(UserError):
    detectors.make("rolling_sigma", **settings)


# ---- table and combinators -----------------------------------------------------------------------


def test_an_unknown_detector_lists_the_names():
  with pytest.raises(UserError) as error:
    detectors.make("cusumm")
  assert all(name in str(error.value) for name in detectors.DETECTORS)


def test_an_unknown_setting_is_named():
  with pytest.raises(UserError, match="windows"):
    detectors.make("rolling_sigma_plain", windows=5)


def test_calibrated_settings_can_be_overridden():
  assert detectors.make("rolling_sigma").init()[0].buffer.shape == (
    detectors.CALIBRATED["walker"]["window"] + detectors.CALIBRATED["walker"]["lag"],
  )


CALIBRATED = [
  ("quadruped" if "quadruped" in agent else agent, agent) for agent in detectors.CALIBRATED
]


@pytest.mark.parametrize("robot, agent", CALIBRATED)
def test_each_agent_has_its_own_figures(robot, agent):
  """The settings are those that benchmarks/calibrate.py chose and results/ holds; a setting that is
  given wins.
  """
  own = detectors.CALIBRATED[agent]
  chosen = json.loads(
    (
      pathlib.Path(__file__).parents[2]
      / f"results/arl0{'' if agent == 'walker' else '_' + agent}.json"
    ).read_text()
  )["chosen"]
  assert {k: chosen[k] for k in own} == own and chosen["arl0"] >= 100_000
  assert chosen["threshold_rpr"] == own.get("threshold_rpr", own["threshold"])
  state = detectors.make("rolling_sigma", robot=robot, agent=agent).init()
  assert state[0].buffer.shape == (own["window"] + own["lag"],) and state[0].recent.shape == (
    own["smooth"],
  )
  assert detectors.calibrated_settings("quadruped") == detectors.CALIBRATED["quadruped-trot-2"]
  assert detectors.calibrated_settings("walker", "walker-2") == detectors.CALIBRATED["walker"]
  assert detectors.make("rolling_sigma", robot=robot, smooth=7).init()[0].recent.shape == (7,)
  assert detectors.make("rolling_sigma", window=300, lag=20).init()[0].buffer.shape == (320,)
  assert detectors.make("rolling_sigma_plain").init()[0].buffer.shape == (1000,)


@pytest.mark.parametrize("robot, agent", CALIBRATED)
def test_one_threshold_for_both_residuals_is_both_thresholds_in_proportion(robot, agent):
  """What the leaderboard calibrates: at the calibrated threshold it is the detector of `mjx-cl
  run`, and its score tells when it fires.
  """
  own = detectors.CALIBRATED[agent]
  ratio = own.get("threshold_rpr", own["threshold"]) / own["threshold"]
  small = dict(
    window=100, warmup=20, smooth=40, lag=2
  )  # long excursions: the car wants 20 samples in a row
  xs = residuals(jax.random.key(6), 400, invalid=0.0)
  run = lambda det: jax.lax.scan(det.update, det.init(), xs)[1]
  assert detectors.one_threshold(robot, agent) | {
    "threshold_rpr": 0,
    "unit_rpr": 0,
    "threshold": 0,
  } == own | {"threshold_rpr": 0, "unit_rpr": 0, "threshold": 0}
  whose = dict(robot=robot, agent=agent, **small, threshold=0.8)
  one = run(detectors.make("rolling_sigma", shared=True, **whose))
  two = run(detectors.make("rolling_sigma", threshold_rpr=0.8 * ratio, **whose))
  np.testing.assert_array_equal(one.fired, two.fired)
  assert (
    one.fired.any()
    and (np.asarray(one.score)[one.fired] > 0.8).all()
    and detectors.one_threshold("a robot of mine") == detectors.one_threshold("walker")
  )


@pytest.mark.parametrize("robot, agent", CALIBRATED)
def test_a_threshold_that_is_given_moves_both_residuals(robot, agent):
  """Alone, in the calibrated proportion; `threshold_rpr` beside it is taken as it is, None: the
  same for both.
  """
  own = detectors.CALIBRATED[agent]
  ratio = own.get("threshold_rpr", own["threshold"]) / own["threshold"]
  small = dict(robot=robot, agent=agent, window=100, warmup=20, smooth=40, lag=2, threshold=0.8)
  xs = residuals(jax.random.key(6), 400, invalid=0.0)
  fired = lambda **more: (
    (
      jax.lax.scan((d := detectors.make("rolling_sigma", **small | more)).update, d.init(), xs)[1]
    ).fired
  )
  np.testing.assert_array_equal(fired(), fired(threshold_rpr=0.8 * ratio))
  np.testing.assert_array_equal(fired(threshold_rpr=None), fired(threshold_rpr=0.8))
  assert fired().any() and not fired(threshold=100.0).any()
  assert fired(threshold=100.0, threshold_rpr=0.4).any()


def test_an_agent_has_its_own_threshold_where_one_was_found():
  of = lambda name, agent: detectors.calibrated(name, "walker", {}, agent)
  values = [of("innovations", agent).value for agent in (None, "walker", "walker-2", "walker-3")]
  own = [pytest.approx(x, rel=1e-9) for x in (1.58344566822052, 1.474637746810913)]
  assert values == [values[0], values[0], *own]
  assert of("cusum", "walker-2") == of("cusum", None)


@pytest.mark.parametrize("robot", detectors.board())
def test_what_stands_on_the_board_takes_its_threshold_from_there(robot):
  """For just the board's settings, however they are written; whoever names a threshold keeps it."""
  for row in detectors.board()[robot].values():
    own = dict(row["settings"])
    use = own.pop("use")
    assert (
      detectors.calibrated(use, robot, own) == (row["threshold"], row["arl0"], row["alarms"])
      and row["threshold"] > 0
      and row["alarms"] >= 10
    )
    assert detectors.calibrated(use, robot, own | {"threshold": 2.0}) is None
  same = lambda a, b, robot=robot: (
    detectors.calibrated(*a[:1], robot, a[1])
    == detectors.calibrated(*b[:1], robot, b[1])
    is not None
  )
  for other in (
    {"slack": 0.5},
    {"patience": 1, "cool_down": 0, "whiten": 0},
    {"log": True},
    {"log": None},
    {"channel": "rpr+opr"},
    {"shared": False},
  ):
    assert same(("cusum", {}), ("cusum", other)), other
  assert same(("cusum@surprise", {}), ("cusum", {"channel": "surprise"})) and same(
    ("cusum@opr", {}), ("cusum@opr", {"channel": "opr"})
  )  # as in `make`
  assert same(("hotelling", {}), ("hotelling", {"patience": 1})) and not same(
    ("cusum@opr", {}), ("cusum@rpr", {})
  )


def test_the_boards_thresholds_are_for_what_the_board_ran():
  walker = lambda name, **settings: detectors.calibrated(name, "walker", settings)
  for none in (
    walker("rolling_sigma"),
    walker("rolling_sigma_plain"),
    walker("random"),
    walker("never"),
    walker("ewma", whiten=3),
    walker("ewma", rate=0.2),
    walker("cusum", log=False),
    walker("cusum@reward", log=True),
    walker("cusum", patience=2),
    walker("mine.py:ewma"),
    walker("no such detector"),
    detectors.calibrated("ewma", "a robot of mine", {}),
  ):
    assert none is None
  assert (
    walker("kswin") is walker("bocpd") is None
  )  # no threshold gives them that rate on the walker: they would stay silent
  assert {"walker", "quadruped", "car"} == set(detectors.board()) and all(
    len(rows) >= 20 for rows in detectors.board().values()
  )


def echo(threshold):
  """Fires above `threshold`; score is the sample; nan stays unknown."""
  return Detector(
    lambda: jnp.int32(0), lambda state, x: (state + 1, Alarm(x > threshold, jnp.float32(x)))
  )


def row(opr, rpr, valid=True):
  return unknown((), 4)._replace(opr=jnp.float32(opr), rpr=jnp.float32(rpr), valid=jnp.bool_(valid))


def test_on_picks_its_channel():
  for channel, want in (("opr", (True, 5.0)), ("rpr", (False, 1.0))):
    state, alarm = on(channel, echo(3.0)).update(jnp.int32(0), row(5.0, 1.0))
    assert (bool(alarm.fired), float(alarm.score)) == want and int(state) == 1


def test_any_of_fires_when_either_does_and_keeps_both_states():
  detector = any_of(on("opr", echo(3.0)), on("rpr", echo(2.0)))
  for opr, rpr, fired, score in (
    (0, 0, False, 0),
    (4, 0, True, 4),
    (0, 2.5, True, 2.5),
    (9, 7, True, 9),
  ):
    states, alarm = detector.update(detector.init(), row(opr, rpr))
    assert (bool(alarm.fired), float(alarm.score)) == (fired, score) and [
      int(s) for s in states
    ] == [1, 1]


def test_any_of_scores_what_is_known():
  known = lambda value: Detector(
    lambda: jnp.int32(0), lambda state, x: (state, Alarm(jnp.bool_(False), jnp.float32(value)))
  )
  score = lambda *values: float(
    any_of(*map(known, values)).update((jnp.int32(0),) * len(values), row(0, 0))[1].score
  )
  assert (
    score(np.nan, 2.0) == 2.0 and score(-3.0, np.nan) == -3.0 and np.isnan(score(np.nan, np.nan))
  )


def test_the_papers_rule_is_either_residual():
  detector = detectors.make("rolling_sigma_plain", window=50, warmup=20)
  xs = residuals(jax.random.key(6), 200, invalid=0.0)
  run = quick.jit(lambda xs: jax.lax.scan(detector.update, detector.init(), xs)[1].fired)
  opr = slow_rolling_sigma(np.asarray(xs.opr, float), 50, 3.0, 1, True, 20)[0]
  rpr = slow_rolling_sigma(np.asarray(xs.rpr, float), 50, 3.0, 1, True, 20)[0]
  assert (opr & ~rpr).any() or (rpr & ~opr).any()
  np.testing.assert_array_equal(run(xs), opr | rpr)


def test_rpr_may_have_its_own_threshold():
  xs = residuals(jax.random.key(6), 200, invalid=0.0)
  settings = dict(window=50, warmup=20, threshold=1.5)
  fired = lambda **more: np.asarray(
    jax.lax.scan(
      (d := detectors.make("rolling_sigma_plain", **settings, **more)).update, d.init(), xs
    )[1].fired
  )
  opr = slow_rolling_sigma(np.asarray(xs.opr, float), 50, 1.5, 1, True, 20)[0]
  rpr = slow_rolling_sigma(np.asarray(xs.rpr, float), 50, 2.5, 1, True, 20)[0]
  np.testing.assert_array_equal(fired(threshold_rpr=2.5), opr | rpr)
  assert (fired() != fired(threshold_rpr=2.5)).any()


@pytest.mark.parametrize("name", sorted(entries_of.variants()))
def test_pure_detectors_do_not_look_ahead(name):
  """Every entry of the board on a stream and on the same stream with another end: equal up to
  there, in alarms and scores, which are known by then.
  """
  cut, steps = (
    2400,
    2600,
    # the longest warm-up is that of whitened ones: 1,000 samples for the autoregression, then their
    # own
  )
  x, other = (
    residuals(jax.random.key(0), steps, invalid=0.02),
    residuals(jax.random.key(1), steps, invalid=0.02),
  )
  end = lambda a, b: jnp.stack(
    [a, jnp.concatenate([a[:cut], b[cut:] * 2 if a.dtype != bool else b[cut:]])]
  )
  detector = entries_of.entry(name, entries_of.variants()[name]).build(3.0)
  run = quick.jit(
    jax.vmap(lambda xs: jax.lax.scan(program_of.updates(detector), detector.init(), xs)[1])
  )
  fired, scores = (np.asarray(r) for r in run(jax.tree.map(end, x, other)))
  np.testing.assert_array_equal(fired[0, :cut], fired[1, :cut])
  np.testing.assert_array_equal(scores[0, :cut], scores[1, :cut])
  known = scores[0, :cut][np.isfinite(scores[0, :cut])]
  assert len(known) > 20  # bfar scores once in 50 samples
  if f"{name} (residual)" not in REFERENCES:  # what looks at the samples
    assert len(np.unique(known)) > 10 and not np.array_equal(
      scores[0, cut:], scores[1, cut:], equal_nan=True
    )


def test_one_trace_across_seeds():
  detector = detectors.make("rolling_sigma_plain", window=50, warmup=20)
  chex.clear_trace_counter()

  @jax.jit
  @chex.assert_max_traces(n=1)
  def program(key):
    return jax.lax.scan(detector.update, detector.init(), residuals(key, 100))[1].fired

  fired = [np.asarray(program(jax.random.key(seed))) for seed in range(4)]
  assert any((a != fired[0]).any() for a in fired[1:])
