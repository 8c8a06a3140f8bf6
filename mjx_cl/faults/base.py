"""What every fault is: a pure map of owned leaves, driven by a severity in [0, 1].

A fault returns the new values of the leaves that it owns, by name; `fault` puts them in place where
the severity is above 0. So severity 0 is nominal bit for bit, and a leaf that is not owned cannot
be touched, whatever the fault's author wrote.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from mjx_cl.errors import PluginError, UserError
from mjx_cl.faults import schedule
from mjx_cl.keys import OfFaults
from mjx_cl.types import Array, Model

Severity = Float[Array, ""]
Values = tuple[Any, dict[str, Array]]  # of `act`: (memory', {owned leaf: new value})


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
  ctrl: Any = None
  obs: Any = None
  first: Any = False
  since: Any = 0


class State(NamedTuple):
  """fstate of a fault.

  Attributes:
    target: int32 (), index into its `targets`.
    row: what the target stands for (a mask, a direction), looked up once; the target itself where
      there is no table.
    memory: a pytree (delay lines, held values), () where there is none.
  """

  target: Array
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
  walk: Array

  @property
  def target(self) -> Int[Array, "... faults"]:
    """Target of each fault."""
    return jnp.stack([s.target for s in self.states], -1)


def leaves(ports: Ports) -> dict[str, Any]:
  """Everything that a fault may own, by name."""
  return {
    **{f"mj.{name}": value for name, value in ports.model.mj.items()},
    **{f"task.{name}": value for name, value in ports.model.task.items()},
    "force": ports.model.force,
    "ctrl": ports.ctrl,
    "obs": ports.obs,
  }


def read(ports: Ports, name: str) -> Any:
  """Value of the leaf `name`."""
  return leaves(ports)[name]


def write(ports: Ports, name: str, value: Any) -> Ports:
  """Ports with `value` in the leaf `name`."""
  kind, _, leaf = name.partition(".")
  if kind in ("ctrl", "obs"):
    return ports._replace(**{kind: value})
  held = getattr(ports.model, kind) | {leaf: value} if leaf else value
  return ports._replace(model=ports.model._replace(**{kind: held}))


def fault(
  name: str,
  env: Any,
  owns: tuple[str, ...],
  targets: Iterable[str],
  act: Callable[..., Values],
  memory: Any = (),
  drawn: int | None = None,
  not_monotone: str = "",
  rows: Array | np.ndarray | None = None,
) -> Fault:
  """Builds a Fault of `env`.

  Args:
    name: registry name.
    env: robot.
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
    UserError: `env` lacks one of the leaves.
  """
  targets = tuple(targets)
  _check_leaves(name, env, owns)
  if not targets:
    raise UserError(f"fault {name!r} finds nothing to act on in robot {env.spec.name!r}")
  count = drawn or len(targets)
  if count > len(targets):
    raise PluginError(f"fault {name!r} draws from {count} targets; it has {len(targets)}")
  if rows is not None and np.shape(rows)[:1] != (len(targets),):
    raise PluginError(
      f"fault {name!r} has rows of shape {np.shape(rows)} for {len(targets)} targets"
    )

  def init(key: PRNGKeyArray, target: ArrayLike = -1) -> State:
    target = jnp.asarray(target)
    index = jnp.where(target < 0, jax.random.randint(key, (), 0, count), target).astype(jnp.int32)
    return State(
      index, index if rows is None else jnp.asarray(rows)[index], jax.tree.map(jnp.asarray, memory)
    )

  def apply(
    state: State, severity: Severity, key: PRNGKeyArray, ports: Ports
  ) -> tuple[State, Ports]:
    kept, values = _answer(name, owns, act(state.row, state.memory, severity, key, ports))
    before, after = _form(state.memory), _form(kept)
    if before != after:
      raise PluginError(f"fault {name!r} makes a memory of form {after} of one of form {before}")
    for leaf, value in values.items():
      old = read(ports, leaf)
      ports = write(ports, leaf, jnp.where(severity > 0, _fitting(name, leaf, value, old), old))
    return state._replace(memory=kept), ports

  return Fault(name, tuple(owns), targets, count, init, apply, "obs" in owns, not_monotone)


def _form(memory: Any) -> str:
  """Structure, shapes and types of a memory, in one line."""
  return str(jax.tree.map(lambda x: str(jax.typeof(jnp.asarray(x))), memory))


def _answer(name: str, owns: tuple[str, ...], answer: Any) -> tuple[Any, dict[str, Any]]:
  """What `act` gave; PluginError where that is not (memory', {owned leaf: new value})."""
  pair = isinstance(answer, tuple) and len(answer) == 2 and isinstance(answer[1], Mapping)
  if not pair:
    raise PluginError(
      f"fault {name!r} gives {type(answer).__name__} in place of (memory, {{leaf: value}})"
    )
  kept, values = answer
  if set(values) != set(owns):
    raise PluginError(
      f"fault {name!r} owns {', '.join(owns)} but gave {', '.join(sorted(map(str, values)))}"
    )
  return kept, dict(values)


def _fitting(name: str, leaf: str, value: Any, old: Array) -> Array:
  """A leaf's new value in its type and shape; PluginError where it has none such."""
  try:
    return jnp.broadcast_to(jnp.asarray(value).astype(old.dtype), old.shape)
  except (TypeError, ValueError):
    shape = getattr(value, "shape", None)
    gave = f"{type(value).__name__}" + (f" of shape {shape}" if shape is not None else "")
    raise PluginError(
      f"fault {name!r} gives {gave} for {leaf}, which has shape {old.shape}"
    ) from None


def _check_leaves(name: str, env: Any, owns: tuple[str, ...]) -> None:
  held = leaves(Ports(env.model))
  for leaf in owns:
    if leaf not in ("ctrl", "obs") and held.get(leaf) is None:
      raise UserError(f"fault {name!r} acts on {leaf}, which robot {env.spec.name!r} does not have")
  if "obs" in owns and len(owns) > 1:
    raise ValueError(
      f"fault {name!r} owns obs and {', '.join(o for o in owns if o != 'obs')}: sensors are "
      "read at another moment; make two faults"
    )


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
  faults: Fault | Iterable[Fault],
  key: PRNGKeyArray,
  plan: schedule.Plan,
  target: ArrayLike = -1,
) -> Injection:
  """Injection of `faults` before the first step; `target` () or (F,), -1: drawn from `key`."""
  faults = as_tuple(faults)
  target = jnp.broadcast_to(jnp.asarray(target, jnp.int32), (len(faults),))
  keys = [key] + [jax.random.fold_in(key, i) for i in range(1, len(faults))]
  states = tuple(f.init(k, target[i]) for i, (f, k) in enumerate(zip(faults, keys)))
  return Injection(states, schedule.spread(plan, len(faults)), jnp.zeros(len(faults)))


def drive(
  faults: Fault | Iterable[Fault],
  injection: Injection,
  t: schedule.Step,
  key: PRNGKeyArray,
  ports: Ports,
) -> tuple[Injection, Ports, Float[Array, " faults"]]:
  """Applies every fault that acts on the driven robot, in order, in control step t.

  Returns:
    (injection', ports', severity of each fault now).
  """
  faults = as_tuple(faults)
  walk = schedule.walk(injection.plan, injection.walk, t, jax.random.fold_in(key, OfFaults.WALK))
  injection = injection._replace(walk=walk)
  some = jnp.asarray([bool(f.owns) for f in faults], jnp.float32)  # `none` has no severity
  severity = schedule.severity(injection.plan, walk, t) * some
  return *_apply(faults, injection, t, key, ports, severity, False), severity


def sense(
  faults: Fault | Iterable[Fault],
  injection: Injection,
  t: schedule.Step,
  key: PRNGKeyArray,
  model: Model,
  obs: Float[Array, " obs"],
  first: Bool[ArrayLike, ""] = False,
) -> tuple[Injection, Float[Array, " obs"]]:
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
  t: schedule.Step,
  key: PRNGKeyArray,
  ports: Ports,
  severity: Float[Array, " faults"],
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


def masks(
  rows: Iterable[tuple[str, Iterable[int]]], size: int
) -> tuple[tuple[str, ...], Bool[Array, "targets size"]]:
  """Names, and which of `size` things each stands for, of rows (name, indices)."""
  names, hits = zip(*rows)
  return names, jnp.asarray([[i in hit for i in range(size)] for hit in hits])


def actuator_targets(env: Any) -> tuple[tuple[str, ...], Bool[Array, "targets act"], int]:
  """Single actuators, then groups, then all: (names, masks, how many are single)."""
  singles, size = env.spec.targets, len(env.spec.act)
  rows = [(name, (i,)) for i, name in enumerate(singles)] + list(env.spec.act_groups)
  if "all" not in dict(rows):
    rows.append(("all", range(size)))
  return *masks(rows, size), len(singles)


def channel_targets(env: Any) -> tuple[tuple[str, ...], Bool[Array, "targets obs"], int]:
  """Groups of the observation, `all`, then single channels: (names, masks, how many may be
  drawn).
  """
  groups, size = env.spec.obs_groups, len(env.spec.obs)
  rows = dict(groups) | {"all": range(size)}
  rows |= {var.name: (i,) for i, var in enumerate(env.spec.obs) if var.name not in rows}
  return *masks(rows.items(), size), max(1, len(groups))
