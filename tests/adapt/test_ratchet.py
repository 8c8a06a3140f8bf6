"""The method that goes back to its best so far, against a loop in NumPy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_cl.adapt import methods, phases
from mjx_cl.adapt.methods import ratchet
from mjx_cl.dreamer.agent import TrainState

ACT = jax.jit(ratchet.act)
FIRST = 4  # chunk after which the first update has been taken


def view(c: int, reward: float, acted: float, learner: float, end: int) -> methods.View:
  """Of chunk `c`: the adaptation begins in 0 and ends in `end`."""
  weights = lambda x: {"w": jnp.float32(x), "val": jnp.float32(x)}
  after = phases.ADAPTING if c < end else phases.CONVERGED
  return methods.View(
    was=jnp.int32(phases.ADAPTING if c else phases.NOMINAL),
    phase=jnp.int32(after),
    begins=jnp.bool_(c == 0),
    over=jnp.bool_(c == end),
    reward=jnp.float32(reward),
    recent=jnp.float32(jnp.nan),
    signals=jnp.full(6, jnp.nan),
    taken=jnp.int32(c >= FIRST),
    rate=jnp.float32(c >= FIRST),
    acted=weights(acted),
    learner=weights(learner),
  )


def told(earns, end: int) -> tuple[list[float], list[bool], ratchet.Ratchet]:
  """(weights that act after each chunk, whether the learner is to go back, memory in the end) of a
  learner whose weights are the number of the chunk; `earns(weights, chunk)` is the reward.
  """
  memory = methods.remember(ratchet.METHOD, {"w": jnp.float32(-1), "val": jnp.float32(-1)})
  acted, learner, acting, back = 0.0, 0.0, [], []
  for c in range(end + 1):
    learner = float(memory.best["w"]) if bool(memory.back) else (c if c >= FIRST else 0.0)
    said = ACT(memory, view(c, earns(acted, c), acted, learner, end))
    memory, acted = said.memory, float(said.params["w"])
    acting.append(acted)
    back.append(bool(memory.back))
  return acting, back, memory


def by_hand(earns, end: int) -> tuple[list[float], list[bool], list[float]]:
  """The same, and the best weights after each chunk, from the words of `Ratchet`."""
  best, worth, number, middle = 0.0, 0.0, 0, 0.0
  heard: list[float] = []
  acted, pending, acting, back, kept = 0.0, False, [], [], []
  for c in range(end + 1):
    reward = np.float32(earns(acted, c))
    new, pending = best if pending else float(c) * (c >= FIRST), False
    if c:
      heard.append(reward)
      last = np.array(heard[-16:], float)
      mean = last.mean()
      if len(heard) % 16 == 8:
        middle = new
      if c > FIRST:
        if len(heard) % 16 == 0 and mean > worth:
          best, worth, number = middle, mean, 16
        lack = worth - mean
        spread = last.var(ddof=1) if len(last) > 1 else 0.0
        far = lack**2 > 9 * spread * (1 / len(last) + 1 / number)
        if len(heard) >= 6 and c == end and lack > 0.05 * abs(worth):
          new = best
        elif len(heard) >= 6 and c < end and lack > 0.1 * abs(worth) and far:
          if any(back) and len(heard) == 6:  # the best earn less now
            worth, number = mean, 6
          else:
            new, heard, pending = best, [], True
      if c == FIRST:
        worth, number, heard = mean, len(last), []
    acted = new
    acting.append(acted)
    back.append(pending)
    kept.append(best)
  return acting, back, kept


NOISE = np.random.default_rng(0).normal(0, 0.03, 200)


@pytest.mark.parametrize("end", [150, 77])
def test_it_goes_back_where_it_falls_behind_its_best(end):
  """Old weights earn 0.5; what is learnt 0.9 up to chunk 60, then 0.2; whatever it goes back to
  earns 0.9 again.
  """

  def earns(weights, c):
    base = 0.5 if weights < FIRST else 0.9 if weights < 60 or weights > 100 else 0.2
    return base + NOISE[c]

  acting, back, memory = told(earns, end)
  want, wanted, kept = by_hand(earns, end)
  assert acting == want and back == wanted
  returns = [c for c in range(end + 1) if back[c]]
  assert returns and 60 < returns[0] < 70  # six to eight bad chunks tell
  assert FIRST < acting[returns[0]] < 60  # to what had earned 0.9
  assert float(memory.best["w"]) == kept[-1] and float(memory.stride) == max(
    0.5 ** len(returns), ratchet.LEAST
  )


def test_what_only_does_harm_is_taken_back_to_the_old_weights():
  earns = lambda weights, c: (0.7 if weights == 0 else 0.3) + NOISE[c]
  acting, back, _ = told(earns, 60)
  assert (acting, back) == by_hand(earns, 60)[:2]
  assert sum(back) >= 2 and all(acting[c] == 0 for c in range(60) if back[c]) and acting[-1] == 0


def test_a_robot_that_changes_again_is_not_held_to_what_was():
  """What is learnt falls behind once; then the robot earns half whatever it does, and from chunk 90
  on what is learnt earns more again.
  """

  def earns(weights, c):
    base = 0.5 if weights < FIRST else 0.2 if 40 < weights < 50 else 0.9
    base = base / 2 if c > 50 else base
    return base + (0.2 if c > 90 and weights > 60 else 0) + NOISE[c] / 3

  acting, back, memory = told(earns, 150)
  assert (acting, back) == by_hand(earns, 150)[:2]
  assert sum(back) == 1 and acting[-1] == 150  # it goes on learning, and keeps that
  assert 0.4 < float(memory.worth) < 0.7


def test_steps_have_a_least_share():
  """Whatever it goes back to is good for ten chunks."""
  last = [0.0, 0]

  def earns(weights, c):
    if weights < last[0]:
      last[1] = c
    last[0] = weights
    return (0.9 if c - last[1] < 10 else 0.2) + NOISE[c]

  _, back, memory = told(earns, 199)
  assert sum(back) > 5 and float(memory.stride) == ratchet.LEAST


def test_what_gets_better_or_stays_is_left_alone():
  """The average acts, as in the paper, and what acts in the end is the newest."""
  for earns in (lambda w, c: 0.3 + w / 200 + NOISE[c], lambda w, c: 0.9 + NOISE[c]):
    acting, back, _ = told(earns, 100)
    assert not any(back) and acting == [0.0] * FIRST + [float(c) for c in range(FIRST, 101)]


def test_a_later_adaptation_begins_with_what_acts_then():
  acting, _, memory = told(lambda w, c: 0.9 + NOISE[c], 50)
  memory = memory._replace(stride=jnp.float32(0.25))
  later = ACT(memory, view(0, 0.1, acting[-1], acting[-1], 50))
  assert float(later.memory.best["w"]) == acting[-1] == 50.0
  assert int(later.memory.number) == int(later.memory.chunks) == 0 and not later.memory.learnt
  assert float(later.memory.stride) == 1


def test_the_learner_goes_on_from_the_best_with_its_critic():
  weights = lambda x: {"w": jnp.float32(x), "val": jnp.float32(10 + x)}
  state = lambda x: TrainState(
    weights(x), jnp.float32(x), (jnp.float32(x),), jnp.ones(2), jnp.int32(x)
  )
  held = methods.remember(ratchet.METHOD, weights(3))
  kept = ratchet.keep(held, state(5), state(6))
  values = lambda tree: [np.asarray(x).tolist() for x in jax.tree.leaves(tree)]
  assert values(kept) == values(state(6))
  half = ratchet.keep(held._replace(stride=jnp.float32(0.5)), state(5), state(6))
  assert values(half) == values(state(6)._replace(params=weights(5.5)))
  gone = ratchet.keep(held._replace(back=jnp.bool_(True)), state(5), state(6))
  assert values(gone) == values(state(6)._replace(params=weights(3), slow=jnp.float32(13)))
