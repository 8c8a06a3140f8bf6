"""Values that more than one package passes around. All are pytrees of one robot, one stream;
callers vmap.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

if TYPE_CHECKING:
  from jax import Array
else:  # of annotations whose shapes tests check: NumPy's arrays are taken as JAX's
  Array = jax.Array | np.ndarray

GROUPS = 8  # parts of an observation with a residual of their own


class Model(NamedTuple):
  """What a fault may change.

  Attributes:
    mj: MuJoCo field name -> array in MjModel's own layout and units, e.g. `actuator_gear` (nu, 6).
    task: whatever is no MuJoCo field (motor law, tyre, reward weights), name -> array.
    force: float32 (nv,), generalised force applied from outside [N, N m], or None: none is applied.
  An environment lists all leaves that faults may own; `rollout` passes on those `mj` leaves and the
  force that its fault owns, no others.
  """

  mj: dict[str, jax.Array]
  task: dict[str, jax.Array]
  force: jax.Array | None = None


class Step(NamedTuple):
  """What arriving at a state brings.

  Attributes:
    obs: float32 (obs_size,), the first one of the next episode where a caller has reset the robot.
    reward: float32 (), of arriving.
    terminated: bool (), an end that is worth nothing from here on (a fall where the task ends on
      one).
    truncated: bool (), the time limit; the value of what would have followed still counts.
    final_obs: float32 (obs_size,), the observation arrived at, also when `obs` belongs to a new
      episode.
  """

  obs: jax.Array
  reward: jax.Array
  terminated: jax.Array
  truncated: jax.Array
  final_obs: jax.Array


class Var(NamedTuple):
  """One scalar of an observation or action.

  Attributes:
    name: what files call it.
    unit: SI.
    low: least value.
    high: greatest value.
    scale: typical deviation while the healthy robot is at work.
  """

  name: str
  unit: str
  low: float = float("-inf")
  high: float = float("inf")
  scale: float = 1.0


class Spec(NamedTuple):
  """What a task is, in numbers a reader can check.

  Attributes:
    name: what tables and agents' cards call it; of a registered robot the name that it is
      registered by.
    obs: one Var per scalar, in the order of the array.
    act: likewise.
    control_s: control period [s].
    episode_steps: control steps until truncation.
    acceptance: mean reward per control step from which the task counts as done well enough
      [reward].
    posture: index into obs and the least mean value that counts as upright, or None where no
      posture is asked for.
    targets: what a joint-wise fault can name, in actuator order.
    act_groups: (name, indices into act), such as the joints of one leg.
    obs_groups: (name, indices into obs), such as all joint speeds.
    feet: (name, indices), what touches the ground: geoms of the MuJoCo model, or axles of a model
      that is none.
    bodies: (name, indices), bodies whose mass may change, the trunk first; empty where there are
      none by name.
    watched: (name, indices into obs), the eight parts of the observation whose residuals a detector
      sees one by one, each of one kind; what the world model cannot foresee (commands, the robot's
      own last action) is left out. Empty: the observation in eight stretches.
  """

  name: str
  obs: tuple[Var, ...]
  act: tuple[Var, ...]
  control_s: float
  episode_steps: int
  acceptance: float
  posture: tuple[int, float] | None
  targets: tuple[str, ...]
  act_groups: tuple[tuple[str, tuple[int, ...]], ...] = ()
  obs_groups: tuple[tuple[str, tuple[int, ...]], ...] = ()
  feet: tuple[tuple[str, tuple[int, ...]], ...] = ()
  bodies: tuple[tuple[str, tuple[int, ...]], ...] = ()
  watched: tuple[tuple[str, tuple[int, ...]], ...] = ()


class EnvState(NamedTuple):
  """State of one robot.

  Attributes:
    physics: backend state; opaque.
    step: int32 (), control steps since the reset.
  """

  physics: Any
  step: jax.Array
