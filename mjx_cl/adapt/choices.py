"""The arms of a run as arrays over its streams."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.adapt import methods
from mjx_cl.adapt.arms import ARMS
from mjx_cl.config import FOREVER, AdaptConfig
from mjx_cl.errors import PluginError, choose

# Choices.at is padded to a multiple of it: arms with up to eight starts share a program
WIDTH = 8


@jax.tree_util.register_static
@dataclass(frozen=True)
class Methods:
  """The methods of a run, which are part of its program; the paper's is the first.

  Attributes:
    all: of them.
  """

  all: tuple[methods.Method, ...] = (methods.PAPER,)


class Choices(NamedTuple):
  """The arms of a run as arrays, leading (groups,); see arms.Arm.

  Attributes:
    listens: bool, alarms are acted on.
    at: int32 (groups, K), control steps at which adaptation is due, FOREVER: none; K is a multiple
      of WIDTH.
    rule: bool, stop and abort rules are in force.
    limit: int32, most control steps of one adaptation.
    method: int32, which of `methods` is the stream's.
    methods: of the run.
    fresh: bool, every start draws new parameters; None: no arm of the run does, and the program
      goes without the drawing.
    settings: float32, values of AdaptConfig by name, of those that a method of the run sets.
  """

  listens: jax.Array
  at: jax.Array
  rule: jax.Array
  limit: jax.Array
  method: jax.Array
  methods: Methods
  fresh: jax.Array | None
  settings: dict[str, jax.Array] = {}


def settings(own: Sequence[methods.Method], config: AdaptConfig) -> dict[str, jax.Array]:
  """`Choices.settings` of streams with these methods: a method's own value where the run's is a
  default, else the run's.
  """
  values = {}
  for name in (f.name for f in fields(methods.Settings)):
    each = [method.settings.of(name, config) for method in own]
    if any(x != getattr(config, name) for x in each):
      values[name] = jnp.asarray(each, jnp.float32)
  return values


def _due(arm: str, given: Any) -> tuple[int, ...]:
  """The control steps that an arm's trigger gives."""
  try:
    due = tuple(operator.index(step) for step in given)
  except TypeError:
    due = (-1,)
  if min(due, default=0) < 0:
    raise PluginError(
      f"arm {arm!r}: its trigger must give control steps, whole numbers from 0 on; got {given!r}"
    )
  return due


def choices(
  labels: Sequence[tuple[str, int]],
  config: AdaptConfig,
  steps: int,
  onsets: Sequence[tuple[int, ...]] | None = None,
  stops: dict[int, int] | None = None,
) -> Choices:
  """Choices of streams.

  Args:
    labels: (arm, seed) of each.
    config: AdaptConfig.
    steps: of the run.
    onsets: true onsets of each robot, unless its arm spares it, as control steps, FOREVER: not
      known yet; None: no faults.
    stops: seed -> age of the snapshot [control steps] whose weights an arm that is told its oracle
      stop ends with.

  Raises:
    UserError where an arm's schedule does not fit into the run.
  """
  arms = [choose("arm", arm, ARMS) for arm, _ in labels]
  onsets = [()] * len(arms) if onsets is None else onsets
  due = [
    _due(name, arm.trigger.steps(config, own if arm.breaks else (), steps, seed))
    for arm, own, (name, seed) in zip(arms, onsets, labels)
  ]
  width = WIDTH * max(1, -(-max(map(len, due)) // WIDTH))
  padded = np.full((len(arms), width), FOREVER, np.int32)
  for row, starts in zip(padded, due):
    row[: len(starts)] = [step if step < steps else FOREVER for step in starts]
  own = methods.used(tuple(arm for arm, _ in labels))
  flags = lambda get: jnp.asarray([get(arm) for arm in arms], bool)
  limits = [
    # the chunk in which an arm ends is not learnt from: a step more keeps the snapshot's weights
    min(arm.end.limit(config), (stops or {})[seed] + 1) if arm.end.told else arm.end.limit(config)
    for arm, (_, seed) in zip(arms, labels)
  ]
  return Choices(
    flags(lambda a: a.trigger.listens),
    jnp.asarray(padded),
    flags(lambda a: a.end.rule),
    jnp.asarray(limits, jnp.int32),
    jnp.asarray([own.index(methods.of(arm)) for arm in arms], jnp.int32),
    Methods(own),
    flags(lambda a: a.fresh) if any(arm.fresh for arm in arms) else None,
    settings([methods.of(arm) for arm in arms], config),
  )
