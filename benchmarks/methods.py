"""Methods that are told the onset, as arms: what a method gains is not mixed with what the detector
misses. `mjx-cl run walker --arm benchmarks/methods.py:quiet` from the repository's root.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from mjx_cl.adapt.arms import ONSET, RULE, Arm
from mjx_cl.adapt.methods import Acts, Method, View, average
from mjx_cl.adapt.methods.quiet import SOON
from mjx_cl.adapt.methods.quiet import quiet as quietly
from mjx_cl.adapt.trees import choose
from mjx_cl.dreamer.agent import TrainState


def staged() -> Arm:
  """World model, then critic, then actor."""
  return Arm("method `staged`, told the onset", ONSET, RULE, method="staged")


def calm() -> Arm:
  """Explores in dreams alone."""
  return Arm("method `calm`, told the onset", ONSET, RULE, method="calm")


def guarded() -> Arm:
  """Old and new weights by turns."""
  return Arm("method `guarded`, told the onset", ONSET, RULE, method="guarded")


def quiet() -> Arm:
  """Acts without exploring from the onset on, and explores in dreams."""
  return Arm("method `quiet`, told the onset", ONSET, RULE, method="quiet")


def still() -> Arm:
  """Acts without exploring from the onset on, and learns nothing."""
  return Arm("method `still`, told the onset", ONSET, RULE, method="still")


def swift() -> Arm:
  """As quiet, but learns from the first records on, follows sooner and ends later."""
  return Arm("method `swift`, told the onset", ONSET, RULE, method="swift")


REACH = 0.02  # of a weight of the residual


def _start(params: Any) -> Any:
  """The policy of before."""
  return params["pol"]


def _act(start: Any, view: View) -> Acts:
  """As the paper's; `start` is what acted when the adaptation began."""
  return average(choose(view.begins, view.acted["pol"], start), view)


def _keep(start: Any, before: TrainState, after: TrainState) -> TrainState:
  """Of the policy's mean only what a bounded residual adds."""
  del before
  near = lambda new, old: jnp.clip(new, old - REACH, old + REACH)
  mean = jax.tree.map(near, after.params["pol"]["mean"], start["mean"])
  policy = {**after.params["pol"], "mlp": start["mlp"], "mean": mean}
  return after._replace(params={**after.params, "pol": policy})


RESIDUAL = dataclasses.replace(quietly(Method(_start, _act, _keep, copies=1)), settings=SOON)


def residual() -> Arm:
  """As swift, but to the mean m of the policy of before, action = tanh(m), comes W h + b alone: h
  its last hidden layer, no entry of W and b beyond REACH (residual policy learning, Silver et al.
  2018, https://arxiv.org/abs/1812.06298).
  """
  return Arm("a bounded residual learns, told the onset", ONSET, RULE, method=RESIDUAL)
