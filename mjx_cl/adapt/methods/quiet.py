"""Methods of the arms `quiet`, `swift`, `still` and those that join them with another, like
`swift-guarded`: the robot does not explore from the alarm on.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.adapt.methods import guarded, ratchet
from mjx_cl.adapt.methods.base import PAPER, Acts, Method, Settings, View
from mjx_cl.adapt.trees import choose

LOW = -20.0  # a head that says it has the least deviation, whatever the state


class Quiet(NamedTuple):
  """Attributes:
  own: memory of the method within.
  params: what it would have acted by, with its own deviations.
  begun: bool (), an adaptation has begun.
  """

  own: Any
  params: Any
  begun: jax.Array


def still(params: Any) -> Any:
  """The parameters, the policy's deviation at its least everywhere."""
  head = params["pol"]["std"]
  head = {"kernel": jnp.zeros_like(head["kernel"]), "bias": jnp.full_like(head["bias"], LOW)}
  return {**params, "pol": {**params["pol"], "std": head}}


def quiet(method: Method) -> Method:
  """`method`, of which the robot acts by the least deviation from the first alarm on and for good;
  the learner keeps its own, so that dreams explore as ever.

  Real mistakes cost return and dreamt ones do not (LIFT, 2026, https://arxiv.org/abs/2601.21363).
  Until the first update the robot is quiet too, so that a method that compares weights of before
  with newer ones compares both without exploring.
  """

  def init(params: Any) -> Quiet:
    return Quiet(method.init(params), params, jnp.bool_(False))

  def act(memory: Quiet, view: View) -> Acts:
    # of what acted the deviations are its own no more, but where it begins with new weights
    loud = view.acted["pol"] | {"std": memory.params["pol"]["std"]}
    quieted = memory.begun & jnp.all(view.acted["pol"]["std"]["bias"] == LOW)
    new = choose(quieted, {**view.acted, "pol": loud}, view.acted)
    params = choose(view.begins, new, memory.params)
    said = method.act(memory.own, view._replace(acted=params))
    learner = said.params if said.learner is None else said.learner
    begun = memory.begun | view.begins
    own = Quiet(said.memory, said.params, begun)
    acts = choose(begun, still(said.params), said.params)
    return said._replace(params=acts, memory=own, learner=learner)

  # of a function of the memory, one of the memory without; None stays
  keep, update, hides = method.keep, method.update, method.hides
  return dataclasses.replace(
    method,
    init=init,
    act=act,
    keep=keep and (lambda memory, before, after: keep(memory.own, before, after)),
    update=update and (lambda agent, memory, *rest: update(agent, memory.own, *rest)),
    hides=hides and (lambda memory: hides(memory.own)),
    copies=method.copies + 1,
  )


METHOD = quiet(PAPER)
GUARDED = quiet(guarded.METHOD)
SOON = Settings(start_windows=64, average=0.2, regain=0.9)
SWIFT = dataclasses.replace(quiet(PAPER), settings=SOON)
SWIFT_GUARDED = dataclasses.replace(quiet(guarded.METHOD), settings=SOON)
SWIFT_RATCHET = dataclasses.replace(quiet(ratchet.METHOD), settings=SOON)
STILL = quiet(Method(learns=False))
