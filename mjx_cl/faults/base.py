"""What every fault is: a pure map of owned leaves, driven by a severity in [0, 1].

A fault returns the new values of the leaves that it owns, by name; `fault` puts them in place where
the severity is above 0. So severity 0 is nominal bit for bit, and a leaf that is not owned cannot
be touched, whatever the fault's author wrote.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.errors import UserError
from mjx_cl.faults import schedule
from mjx_cl.keys import OfFaults
from mjx_cl.types import Model

if TYPE_CHECKING:
  from collections.abc import Iterable

  import numpy as np


class Ports(NamedTuple):
  """The places at which a fault can act on one robot in one control step.

  Attributes:
    model: types.Model, nominal on the way in (or as the faults before this one left it in the same
      step): no fault compounds over time.
    ctrl: float32 (A,), the action as the agent gave it, or None where the sensors are read.
    obs: float32 (O,), what the sensors report, or None where the robot is driven.
    first: bool (), this decision or observation is the first of an episode.
    since: int32 (), control steps since the onset; negative before.
  """

  model: Model
  ctrl: jax.Array | Any = None
  obs: jax.Array | Any = None
  first: jax.Array | bool = False
  since: jax.Array | int = 0


class State(NamedTuple):
  """fstate of a fault.

  Attributes:
    target: int32 (), index into its `targets`.
    row: what the target stands for (a mask, a direction), looked up once; the target itself where
      there is no table.
    memory: a pytree (delay lines, held values), () where there is none.
  """

  target: jax.Array
  row: Any
  memory: Any


class Fault(NamedTuple):
  """One thing that can break, on one robot.

  Attributes:
    name: registry name.
    owns: leaves it may write: "mj.actuator_gear", "task.strength", "force", "ctrl" or "obs";
      severity 0 leaves them bit-identical.
    targets: names that a target index stands for.
    drawn: a target that is not named is drawn from the first so many.
    init: (key, target int32 () or -1 to draw it) -> State.
    apply: (State, severity float32 (), key, Ports) -> (State, Ports).
    senses: it acts where the sensors are read; the others act where the robot is driven.
    not_monotone: why a greater severity need not make a greater difference at first, "" where it
      must.
  """

  name: str
  owns: tuple[str, ...]
  targets: tuple[str, ...]
  drawn: int
  init: Callable[..., Any]
  apply: Callable[..., Any]
  senses: bool
  not_monotone: str = ""


class Injection(NamedTuple):
  """The true faults of one stream; logged, never observable to agent or detector.

  Attributes:
    states: fstate of each fault, a tuple of F.
    plan: schedule.Plan with leading (F,).
    walk: float32 (F,), where a random walk of the severity stands.
  """

  states: tuple[State, ...]
  plan: schedule.Plan
  walk: jax.Array

  @property
  def target(self) -> jax.Array:
    """int32 (F,), target of each fault."""
    return jnp.stack([s.target for s in self.states], -1)


def read(ports: Ports, name: str) -> jax.Array:
  """Value of the leaf `name`."""
  kind, _, leaf = name.partition(".")
  return (
    getattr(ports.model, kind)[leaf]  # type: ignore[return-value]
    if leaf
    else ports.model.force
    if kind == "force"
    else getattr(ports, kind)
  )


def write(ports: Ports, name: str, value: jax.Array) -> Ports:
  """Ports with `value` in the leaf `name`."""
  kind, _, leaf = name.partition(".")
  if leaf:
    return ports._replace(
      model=ports.model._replace(**{kind: getattr(ports.model, kind) | {leaf: value}})
    )
  return (
    ports._replace(model=ports.model._replace(force=value))
    if kind == "force"
    else ports._replace(**{kind: value})  # type: ignore[arg-type]
  )


def fault(
  name: str,
  env: Any,
  owns: tuple[str, ...],
  targets: Iterable[str],
  act: Callable[..., Any],
  memory: Any = (),
  drawn: int | None = None,
  not_monotone: str = "",
  rows: jax.Array | np.ndarray | None = None,
) -> Fault:
  """Builds a Fault of `env`.

  Args:
    name: registry name.
    owns: names of its leaves; "obs" is owned alone.
    targets: names, the ones that may be drawn first.
    act: (row, memory, severity, key, ports) -> (memory', {owned leaf: new value}); for severity > 0
      the values take effect.
    memory: initial memory, a pytree of arrays; renewed where ports.first says so by `act` itself.
    drawn: a target that is not named is drawn from the first so many; None: from all.
    not_monotone: why a greater severity need not make a greater difference at first.
    rows: array of what each target stands for, leading (targets,); `act` gets the row of its
      target. None: it gets the target's index.

  Raises:
    UserError where `env` lacks one of the leaves.
  """
  targets = tuple(targets)
  for leaf in owns:
    require(env, leaf, name)
  if not targets:
    raise UserError(f"fault {name!r} finds nothing to act on in robot {env.spec.name!r}")
  senses = "obs" in owns
  if senses and len(owns) > 1:
    raise ValueError(
      f"fault {name!r} owns obs and {', '.join(o for o in owns if o != 'obs')}: sensors are "
      "read at another moment; make two faults"
    )
  count = drawn or len(targets)

  def init(key: jax.Array, target: jax.Array | int = -1) -> State:
    target = jnp.asarray(target)
    index = jnp.where(target < 0, jax.random.randint(key, (), 0, count), target).astype(jnp.int32)
    return State(
      index, index if rows is None else jnp.asarray(rows)[index], jax.tree.map(jnp.asarray, memory)
    )

  def apply(state: State, severity: jax.Array, key: jax.Array, ports: Ports) -> tuple[State, Ports]:
    kept, values = act(state.row, state.memory, severity, key, ports)
    if set(values) != set(owns):
      raise ValueError(
        f"fault {name!r} owns {', '.join(owns)} but gave {', '.join(sorted(values))}"
      )
    for leaf, value in values.items():
      old = read(ports, leaf)
      ports = write(ports, leaf, jnp.where(severity > 0, value.astype(old.dtype), old))
    return state._replace(memory=kept), ports

  return Fault(name, tuple(owns), targets, count, init, apply, senses, not_monotone)


def require(env: Any, leaf: str, name: str) -> None:
  """Raises UserError unless `env` has the leaf."""
  kind, _, key = leaf.partition(".")
  if kind in ("ctrl", "obs"):
    return
  held = getattr(env.model, kind)
  if held is None or (key and key not in held):
    raise UserError(f"fault {name!r} acts on {leaf}, which robot {env.spec.name!r} does not have")


def owned_model(faults: tuple[Fault, ...], model: Model) -> Model:
  """The leaves of `model` that the physics must be told of: those `mj` leaves and that force which
  some fault owns; the task in full.
  """
  owned = {leaf for f in faults for leaf in f.owns}
  return Model(
    {k: v for k, v in model.mj.items() if f"mj.{k}" in owned},
    model.task,
    model.force if "force" in owned else None,
  )


def as_tuple(faults: Fault | Iterable[Fault]) -> tuple[Fault, ...]:
  """One Fault or several -> a tuple."""
  return (faults,) if isinstance(faults, Fault) else tuple(faults)


def begin(
  faults: Fault | Iterable[Fault], key: jax.Array, plan: schedule.Plan, target: jax.Array | int = -1
) -> Injection:
  """Injection of `faults` before the first step; `target` int32 () or (F,), -1: drawn
  from `key`.
  """
  faults = as_tuple(faults)
  target = jnp.broadcast_to(jnp.asarray(target, jnp.int32), (len(faults),))
  keys = [key] + [jax.random.fold_in(key, i) for i in range(1, len(faults))]
  states = tuple(f.init(k, target[i]) for i, (f, k) in enumerate(zip(faults, keys)))
  return Injection(states, schedule.spread(plan, len(faults)), jnp.zeros(len(faults)))


def drive(
  faults: Fault | Iterable[Fault], injection: Injection, t: jax.Array, key: jax.Array, ports: Ports
) -> tuple[Injection, Ports, jax.Array]:
  """Applies every fault that acts on the driven robot, in order, in control step t.

  Returns:
    (injection', ports', severity of each fault now, float32 (F,)).
  """
  faults = as_tuple(faults)
  walk = schedule.walk(injection.plan, injection.walk, t, jax.random.fold_in(key, OfFaults.WALK))
  injection = injection._replace(walk=walk)
  severity = schedule.severity(injection.plan, walk, t) * jnp.asarray(
    [bool(f.owns) for f in faults], jnp.float32
  )  # `none` has no severity
  return *_apply(faults, injection, t, key, ports, severity, False), severity


def sense(
  faults: Fault | Iterable[Fault],
  injection: Injection,
  t: jax.Array,
  key: jax.Array,
  model: Model,
  obs: jax.Array,
  first: jax.Array | bool = False,
) -> tuple[Injection, jax.Array]:
  """Applies every sensor fault to the observation that is read at control step t. Returns
  (injection', obs').

  A severity that walks at random stands where `drive` left it, one control step ago: at the
  boundary of a period a sensor follows one step late.
  """
  faults = as_tuple(faults)
  if not any(f.senses for f in faults):
    return injection, obs
  severity = schedule.severity(injection.plan, injection.walk, t)
  injection, ports = _apply(
    faults, injection, t, key, Ports(model, obs=obs, first=first), severity, True
  )
  return injection, ports.obs


def _apply(
  faults: tuple[Fault, ...],
  injection: Injection,
  t: jax.Array,
  key: jax.Array,
  ports: Ports,
  severity: jax.Array,
  senses: bool,
) -> tuple[Injection, Ports]:
  states = list(injection.states)
  for i, f in enumerate(faults):
    if f.senses == senses:
      ports = ports._replace(since=t - injection.plan.onset[i])
      states[i], after = f.apply(states[i], severity[i], jax.random.fold_in(key, i), ports)
      _check_owned(f, ports, after)
      ports = after
  return injection._replace(states=tuple(states)), ports


def _check_owned(fault: Fault, before: Ports, after: Ports) -> None:
  """Raises UserError, while the program is traced, where a Fault that was not built by `fault` has
  written a leaf that it does not own.
  """
  leaves = lambda ports: (
    {f"{kind}.{k}": v for kind in ("mj", "task") for k, v in getattr(ports.model, kind).items()}
    | {"force": ports.model.force, "ctrl": ports.ctrl, "obs": ports.obs}
  )
  old, new = leaves(before), leaves(after)
  touched = sorted(
    k for k in old.keys() | new.keys() if old.get(k) is not new.get(k) and k not in fault.owns
  )
  if touched:
    raise UserError(
      f"fault {fault.name!r} writes {', '.join(touched)}, which it does not own; it owns "
      f"{', '.join(fault.owns) or 'nothing'}"
    )


def none(env: Any) -> Fault:
  """No fault at all: the nominal robot."""
  del env
  return Fault(
    "none",
    (),
    ("all",),
    1,
    lambda key, target=-1: State(jnp.int32(0), (), ()),
    lambda state, severity, key, ports: (state, ports),
    False,
  )


# ---- targets -------------------------------------------------------------------------------------


def actuator_targets(env: Any) -> tuple[tuple[str, ...], jax.Array, int]:
  """Single actuators, then groups, then all: (names, bool mask (targets, A), how many
  are single).
  """
  size = len(env.spec.act)
  rows = [(name, (i,)) for i, name in enumerate(env.spec.targets)] + list(env.spec.act_groups)
  return _masks(rows, size, len(env.spec.targets))


def channel_targets(env: Any) -> tuple[tuple[str, ...], jax.Array, int]:
  """Groups of the observation, `all`, then single channels: (names, bool mask (targets, O), how
  many may be drawn).
  """
  size = len(env.spec.obs)
  groups = list(env.spec.obs_groups)
  rows = groups + [("all", tuple(range(size)))]
  have = {name for name, _ in rows}
  rows += [(var.name, (i,)) for i, var in enumerate(env.spec.obs) if var.name not in have]
  return _masks(rows, size, max(1, len(groups)), whole=False)


def _masks(
  rows: Iterable[tuple[str, tuple[int, ...]]], size: int, single: int, whole: bool = True
) -> tuple[tuple[str, ...], jax.Array, int]:
  rows = list(rows)
  if whole and "all" not in {name for name, _ in rows}:
    rows.append(("all", tuple(range(size))))
  mask = jnp.asarray([[i in hit for i in range(size)] for _, hit in rows])
  return tuple(name for name, _ in rows), mask, single
