"""Methods: what of an update is learnt, and which weights act. `METHODS` is the table of those that
ship; an arm names one, or brings its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from mjx_cl.adapt.arms import ARMS, Arm
from mjx_cl.adapt.methods import calm, guarded, quiet, ratchet, rollback, staged, world_model
from mjx_cl.adapt.methods.base import (
  PAPER,
  Acts,
  Method,
  Settings,
  Update,
  View,
  average,
  follow,
)
from mjx_cl.adapt.settling import SIGNALS
from mjx_cl.dreamer import replay as replay_lib
from mjx_cl.dreamer.agent import Agent, TrainState, culprit
from mjx_cl.dreamer.state import Record
from mjx_cl.errors import PluginError, choose
from mjx_cl.io import plugins

__all__ = [
  "METHODS",
  "PAPER",
  "Acts",
  "Method",
  "Settings",
  "Update",
  "View",
  "average",
  "check",
  "follow",
  "of",
  "remember",
  "used",
]

METHODS: dict[str, Method] = {
  "paper": PAPER,
  "rollback": rollback.METHOD,
  "guarded": guarded.METHOD,
  "world-model": world_model.METHOD,
  "staged": staged.METHOD,
  "calm": calm.METHOD,
  "quiet": quiet.METHOD,
  "swift": quiet.SWIFT,
  "quiet-guarded": quiet.GUARDED,
  "swift-guarded": quiet.SWIFT_GUARDED,
  "ratchet": ratchet.METHOD,
  "swift-ratchet": quiet.SWIFT_RATCHET,
  "still": quiet.STILL,
}


def of(arm: Arm) -> Method:
  """The arm's method."""
  own = arm.method
  return own if isinstance(own, Method) else choose("method", own, METHODS)


def used(arms: tuple[str, ...]) -> tuple[Method, ...]:
  """The methods of arms, each once: the paper's, those of METHODS in their order, others as they
  come.
  """
  own = {of(ARMS[arm]) for arm in arms}
  shipped = [m for m in METHODS.values() if m is PAPER or m in own]
  return tuple(dict.fromkeys([*shipped, *(of(ARMS[arm]) for arm in arms)]))


def remember(method: Method, params: Any) -> Any:
  """The method's memory before its first chunk, arrays of plain types; `params` of one stream."""
  array = lambda x: jnp.array(x, jnp.asarray(x).dtype)  # copies: what is learnt from is used up
  return jax.tree.map(array, method.init(params))


def _drawn(agent: Agent) -> tuple[Record, tuple[jax.Array, jax.Array], jax.Array]:
  """A batch as the learner draws it, the latents that an update finds of it, and a key."""
  c, size, key = agent.config, agent.size, jax.random.key(0)
  length = c.length + 1
  replay = replay_lib.init(1, length, agent.obs_size, agent.act_size, size.deter, size.stoch)
  batch = replay_lib.sample(replay, key, c.batch, length)[1]
  return batch, (batch.deter[:, 1:], batch.stoch[:, 1:]), key


def _updated(method: Method, agent: Agent, *given: Any) -> tuple[TrainState, Any]:
  """(state', latents) of the method's update, whose metrics are read as the loop reads them."""
  learnt, metrics, latents = method.update(agent, *given)  # type: ignore[misc]
  culprit(metrics)
  return learnt, latents


def check(name: str, method: Method, agent: Agent) -> None:
  """Tries the functions of a method on shapes alone.

  Raises:
    PluginError: one of them fails, or gives something of another structure, shape or type than it
      must.
  """
  train = jax.eval_shape(agent.init, jax.random.key(0))
  form: Any = lambda tree: jax.tree.structure(tree)
  said = lambda tree: [(x.shape, jnp.dtype(x.dtype)) for x in jax.tree.leaves(tree)]

  def tried(what: str, function: Callable, *args: Any) -> Any:
    try:
      return jax.eval_shape(function, *args)
    except Exception as e:
      if plugins.of_user(e):
        raise
      raise PluginError(f"arm {name!r}: {what} of its method fails: {plugins.line(e, 1)}") from e

  def like(what: str, is_: Any, must: Any, whose: str) -> None:
    if form(is_) != form(must) or said(is_) != said(must):
      raise PluginError(
        f"arm {name!r}: {what} of its method must keep structure, shapes and types of {whose}"
      )

  scalar: Any = lambda dtype: jax.ShapeDtypeStruct((), dtype)
  whole, flag, real = scalar(jnp.int32), scalar(jnp.bool_), scalar(jnp.float32)
  signals: Any = jax.ShapeDtypeStruct((len(SIGNALS),), jnp.float32)
  params = train.params
  view = View(whole, whole, flag, flag, real, real, signals, whole, real, params, params)
  try:
    hash(method)
  except TypeError as e:
    raise PluginError(f"arm {name!r}: the functions of its method need a hash: {e}") from e
  if not isinstance(method.copies, int) or method.copies < 0:
    raise PluginError(f"arm {name!r}: copies of its method must be 0 or more; got {method.copies}")
  memory = tried("init", lambda p: remember(method, p), params)
  if any(jnp.issubdtype(x.dtype, jax.dtypes.prng_key) for x in jax.tree.leaves(memory)):
    raise PluginError(
      f"arm {name!r}: the memory of its method holds a key; keep jax.random.key_data of it"
    )
  acts = tried("act", method.act, memory, view)
  if not isinstance(acts, Acts):
    raise PluginError(f"arm {name!r}: act of its method must give an Acts")
  like("act", acts.params, params, "the parameters")
  if acts.learner is not None:
    like("what act gives the learner", acts.learner, params, "the parameters")
  for what in ("back", "earned", "earns"):
    if jnp.shape(getattr(acts, what)) != ():
      raise PluginError(f"arm {name!r}: {what} of its method's Acts must be one value of a stream")
  shapes = lambda tree: [x.shape for x in jax.tree.leaves(tree)]
  if form(acts.memory) != form(memory) or shapes(acts.memory) != shapes(memory):
    raise PluginError(f"arm {name!r}: act of its method must keep structure and shapes of memory")
  if method.keep is not None:
    like("keep", tried("keep", method.keep, memory, train, train), train, "the learner's state")
  if method.update is not None:
    update = lambda *given: _updated(method, agent, *given)
    batch, latents, key = jax.eval_shape(lambda: _drawn(agent))
    learnt, found = tried("update", update, memory, train, batch, key)
    like("update", learnt, train, "the learner's state")
    if form(found) != form(latents) or shapes(found) != shapes(latents):
      raise PluginError(f"arm {name!r}: update of its method must keep shapes of the latents")
  if method.hides is not None:
    hides = tried("hides", method.hides, memory)
    like("hides", hides, flag, "one bool")
