"""Detector `innovations` against a NumPy loop, and its fit on streams whose answer is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_detectors_multivariate import gaussian

from benchmarks import fit_innovations
from mjx_cl import detectors
from mjx_cl.adapt import watch
from mjx_cl.detectors import innovations as own
from mjx_cl.detectors.learnt import CHANNELS
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import arrays
from mjx_cl.leaderboard import entries
from mjx_cl.leaderboard.streams import Streams, StreamSet
from mjx_cl.training import agents

NAMES = own.agents()


def residuals(steps, fit, lift=0.0, key=1):
  """Rows about a healthy robot's whose errors are correlated as its are; from the half on the
  channels are higher by `lift` deviations and the errors half as wide again for each.
  """
  rows = gaussian(jax.random.key(key), (steps,))
  late = np.arange(steps) >= steps // 2
  x = {n: k for k, n in enumerate(CHANNELS)}
  put = lambda z, at: (
    fit.mean[at] + fit.std[at] * (np.asarray(z) + lift * late.reshape(-1, *[1] * (np.ndim(z) - 1)))
  )
  p = len(fit.grain)
  e = np.random.default_rng(key).normal(size=(steps, p)) @ np.linalg.inv(fit.apart).T
  e *= (1 + 0.5 * lift * late)[:, None]
  return rows._replace(
    opr=np.exp(put(rows.opr, x["opr"])),
    rpr=np.exp(put(rows.rpr, x["rpr"])),
    surprise=np.exp(put(rows.surprise, x["surprise"])),
    groups=np.exp(put(rows.groups, slice(x["group_0"], x["group_7"] + 1))),
    reward=put(rows.reward, x["reward"]),
    innovation=(fit.mean[12:] + fit.std[12:] * e).astype(np.float32),
  )


def by_hand(rows, fit, threshold):
  """(score, fired) in a loop of float64."""
  x = {name: np.log(np.float64(getattr(rows, name))) for name in ("opr", "rpr", "surprise")}
  x |= {"reward": np.float64(rows.reward)}
  x |= {f"group_{k}": np.log(np.float64(rows.groups[:, k])) for k in range(8)}
  # rounded in float32, as the detector does: half a step is half a step there
  error = np.float64(np.round(np.asarray(rows.innovation) / fit.grain) * fit.grain)
  fit = own.Fit(*(np.float64(v) for v in fit))
  p, rates = len(fit.grain), (1 / 8, 1 / 32, 1 / 128)
  m, score, fired = np.zeros((3, 12 + 2 * p)), [], []
  for t in range(len(error)):
    if not (rows.valid[t] and np.isfinite(error[t]).all()):
      score.append(np.nan)
      fired.append(False)
      continue
    z = (np.r_[[x[name][t] for name in CHANNELS], error[t]] - fit.mean) / fit.std
    z = np.clip(z, -6, 6)
    c = fit.apart @ z[12:]
    both = (np.r_[c, np.log(c**2 + 0.01)] - fit.center) / fit.scale
    y, weighed = np.r_[z[:12], np.clip(both, -6, 6)], []
    looks = np.zeros((3, 3))
    for k, a in enumerate(rates):
      m[k] += a * (y - m[k])
      u = (m[k] - fit.level[k]) / fit.spread[k]
      b, c, h = u[:12], u[12 : 12 + p], u[12 + p :]
      weighed += b.tolist()
      looks[0, k] = np.sqrt(((np.r_[b, h] @ fit.factor[k]) ** 2).sum())
      looks[1, k], looks[2, k] = np.abs(c).max(), np.abs(h).max()
    x_ = np.r_[weighed, ((np.log(looks + 1e-6) - fit.low) / fit.wide).ravel()]
    x_ = np.clip(x_, -8, 8)
    odds = fit.weights[0] @ x_ + fit.weights[1] @ np.abs(x_) + fit.bias
    one = (np.r_[odds, looks[0, 2], looks[1], looks[2]] / fit.units).max()
    score.append(one)
    fired.append(one > threshold)
    m *= not fired[-1]
  return np.array(score), np.array(fired)


@pytest.mark.parametrize("agent", NAMES)
def test_it_is_its_equation(agent):
  fit = own.fit_of(agent)
  rows = residuals(800, fit, lift=1.5)
  gaps = np.array(rows.innovation)
  gaps[np.arange(800) % 11 == 5, 2] = np.nan  # an error that is not known
  rows = rows._replace(valid=np.arange(800) % 7 != 3, innovation=gaps)
  det = detectors.make("innovations", threshold=1.5, agent=agent)
  _, out = jax.jit(lambda xs: jax.lax.scan(det.update, det.init(), xs))(rows)
  score, fired = by_hand(rows, fit, 1.5)
  assert fired[400:].any() and np.array_equal(np.isnan(score), np.isnan(out.score))
  first = np.flatnonzero(fired)[0]  # beyond it a last digit may move an alarm by a step
  assert not np.asarray(out.fired)[: first - 1].any() and np.asarray(out.fired).any()
  # float32: 1e-7 a digit, amplified by the inverse correlations and their sums over 130 variables
  np.testing.assert_allclose(out.score[:first], score[:first], rtol=5e-3, atol=5e-3)


def test_recorded_faults_are_found_and_a_recorded_healthy_robot_is_left_alone():
  """Streams of the seeds that tune, which the fit has seen."""
  held = StreamSet()
  at = lambda *key: held.get("walker", held.find("walker", *key)[:3], signed=True)
  det = detectors.make("innovations", threshold=1.2, cool_down=200)
  run = jax.jit(lambda xs: jax.lax.scan(jax.vmap(det.update), begin, xs)[1].fired)
  begin = jax.tree.map(lambda x: jnp.broadcast_to(x, (3, *jnp.shape(x))), det.init())
  healthy, wind = at("nominal", "tune"), at("fault", "tune", "wind", 0.5)
  assert np.asarray(run(healthy.residual)).sum() <= 3  # of 24,576 steps; one in 20,000 at 1
  fired = np.asarray(run(wind.residual))
  soon = [fired[onset : onset + 400, k].any() for k, onset in enumerate(wind.onset)]
  early = sum(fired[:onset, k].sum() for k, onset in enumerate(wind.onset))
  assert all(soon) and early <= 2  # of some 8,000 steps


def test_after_a_finetuning_it_learns_mean_deviation_and_scale_anew():
  """By hand: as if the fit's were those of its first 1,500 samples, and its unit the largest score
  of the next.
  """
  fit = own.fit_of("walker")
  rows = residuals(3600, fit._replace(mean=fit.mean + 2 * fit.std, std=1.5 * fit.std))
  past, then = (jax.tree.map(lambda x: x[part], rows) for part in (slice(2400), slice(2400, None)))
  det = detectors.make("innovations", threshold=1e6)
  two = lambda x: jnp.broadcast_to(jnp.asarray(x), (2, *jnp.shape(x)))
  both = jax.tree.map(lambda x: jnp.stack([x, x], 1), past)
  state = watch.refit(det, jax.tree.map(two, det.init()), both, jnp.array([True, False]))
  after = lambda k: jax.lax.scan(det.update, jax.tree.map(lambda x: x[k], state), then)[1]
  seen = jax.vmap(lambda row: own.sample(row, fit)[0])(jax.tree.map(lambda x: x[:1500], rows))
  x = np.asarray(seen, np.float64)
  late = jax.tree.map(lambda x: x[1500:], rows)
  score, _ = by_hand(late, fit._replace(mean=x.mean(0), std=x.std(0)), 1e6)
  peak = max(1.0, score[:1500].max())
  assert peak > 1.2  # errors that are not correlated as the fit's
  got = np.asarray(after(0).score)
  assert np.isnan(got[:600]).all()
  np.testing.assert_allclose(got[600:], score[1500:] / peak, rtol=5e-3, atol=5e-3)  # as above
  assert np.median(after(1).score) > np.median(got[600:])


def test_what_it_cannot_take_is_refused():
  rows = residuals(3, own.fit_of("walker"))
  one = jax.tree.map(lambda x: jnp.asarray(x[0]), rows)
  det = detectors.make("innovations", robot="walker")
  for innovation, text in ((None, "none are there"), (jnp.zeros(4), "there are 4")):
    with pytest.raises(UserError, match=f"takes 25 signed errors a step; {text}"):
      det.update(det.init(), one._replace(innovation=innovation))
  with pytest.raises(UserError, match="no fit of agent 'spot'; choose from: car, "):
    detectors.make("innovations", agent="spot")


def test_a_fit_beside_ones_own_agent(tmp_path):
  with pytest.raises(UserError, match="no fit of agent"):
    detectors.make("innovations", agent=str(tmp_path))
  arrays.write(tmp_path / own.FILE, {"mean": np.zeros(3)})
  with pytest.raises(FileError, match="is no fit of detector 'innovations'"):
    detectors.make("innovations", agent=str(tmp_path))
  whole = own.fit_of("car")._asdict()
  short, spoilt = whole | {"mean": whole["mean"][:3]}, whole | {"bias": np.float32(np.nan)}
  for held, text in ((short, "is no fit of"), (spoilt, "something other than finite numbers")):
    own.fit_of.cache_clear()
    arrays.write(tmp_path / own.FILE, held)
    with pytest.raises(FileError, match=text):
      detectors.make("innovations", agent=str(tmp_path))
  other = tmp_path / "agent"
  other.mkdir()
  arrays.write(other / own.FILE, own.fit_of("car")._asdict())
  jax.tree.map(np.testing.assert_array_equal, own.fit_of(str(other)), own.fit_of("car"))


def test_the_agents_of_the_recordings_have_a_fit_of_their_size():
  held = StreamSet()
  assert {held.agent(robot) for robot in held.robots} <= set(NAMES) <= set(agents.shipped())
  for robot in held.robots:
    grain = held.config["details"][robot]["rounding"]
    want = [grain[name] for name in held.need_innovations(robot)]
    np.testing.assert_array_equal(own.fit_of(held.agent(robot)).grain, np.float32(want))


def test_a_board_says_what_it_was_fitted_on():
  assert "tuning faults" in entries.fitted(["innovations"])["innovations"]


# ---- the fit -------------------------------------------------------------------------------------


def streams(count, steps, shift, onset, fault, seed=0):
  """Streams of a robot with three errors, of which the last two are nearly one; `shift` moves
  apart what is equal in these.
  """
  rng = np.random.default_rng(seed)
  rows = gaussian(jax.random.key(seed), (steps, count))
  late = (np.arange(steps) >= onset)[:, None] * shift
  a, b, c = rng.normal(size=(3, steps, count))
  errors = np.stack([a, b, b + 0.1 * c + late], -1).astype(np.float32)
  exp = {k: np.exp(np.asarray(getattr(rows, k))) for k in ("opr", "rpr", "surprise", "groups")}
  known = np.ones((steps, count), bool)
  return Streams(
    rows._replace(**exp, innovation=errors, valid=known),
    np.zeros((steps, count), np.int16),
    np.arange(count),
    100 + np.arange(count),
    np.full(count, onset),
    [fault] * count,
    [""] * count,
    np.ones(count),
    0.05,
  )


def test_the_fit_finds_what_the_others_do_not_tell():
  """A quarter of a deviation in one of two errors that are nearly one: 2.5 of what they differ
  by.
  """
  grain = np.full(3, 2.0**-10)
  healthy = streams(6, 3000, 0.0, 3000, "")
  fit = fit_innovations.reference(healthy, grain)
  np.testing.assert_allclose(fit.apart @ np.linalg.inv(fit.apart), np.eye(3), atol=1e-4)
  quiet = fit_innovations.weighable(healthy, fit)
  loud = fit_innovations.weighable(streams(6, 1500, 0.25, 800, "a", seed=1), fit)
  fit = fit_innovations.weighed(fit, quiet, loud, np.ones(6, bool))
  score = fit_innovations.scores(quiet, fit)
  late = score[fit_innovations.SETTLED :]
  assert (late > 1).sum(0).max() < 0.05 * len(late)
  assert abs(np.median(fit_innovations.each(quiet, fit)[0])) < 1e-3  # the ratio's middle
  new = fit_innovations.weighable(streams(6, 1500, 0.25, 800, "a", seed=2), fit)
  odds = fit_innovations.scores(new, fit)
  assert (odds[1000:] > 1).mean() > 0.9 and (odds[300:800] > 1).mean() < 0.05


def test_parted_streams_are_those_columns():
  some = streams(4, 50, 0.0, 50, "a")
  two = fit_innovations.parted(some, np.array([False, True, False, True]))
  np.testing.assert_array_equal(two.seed, [101, 103])
  np.testing.assert_array_equal(two.residual.innovation, some.residual.innovation[:, [1, 3]])
  assert two.fault == ["a", "a"]
