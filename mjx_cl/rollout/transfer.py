"""A robot that becomes another one at an episode's end, such as `car` to `car_real`: two compiled
rollouts, and each stream in one of them.

Up to the chunk of the onset only the first rollout runs, once every stream has moved only the
second one. Between the two both run on all streams; the second one takes over a stream in the very
step in which its episode has ended, and of each row the one of the robot that the stream then has
is kept.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float, Int, PRNGKeyArray

from mjx_cl import faults as faults_lib
from mjx_cl.dreamer.state import Carry
from mjx_cl.errors import UserError
from mjx_cl.rollout.scan import Rollout, Row, Stream, expand, start
from mjx_cl.types import Array, EnvState, Step


class Arrival(NamedTuple):
  """A Stream of the second robot, and when it comes to life.

  While the stream waits, `env` rests and `agent`, `obs`, `reward`, `first` mean nothing.

  Attributes:
    env: as in Stream, and so the others to `injection`.
    agent: Carry.
    obs: float32 (O,).
    reward: float32 ().
    first: bool ().
    key: the stream's key.
    t: int32 ().
    episode: int32 ().
    injection: faults of the second robot.
    due: int32 (), the first episode that ends in this control step or a later one is the first
      robot's last.
    enter: int32 (), control step that this robot's first episode begins with, FOREVER: not known
      yet.
  """

  env: EnvState
  agent: Carry
  obs: jax.Array
  reward: jax.Array
  first: jax.Array
  key: jax.Array
  t: jax.Array
  episode: jax.Array
  injection: faults_lib.Injection
  due: jax.Array
  enter: jax.Array


class Moving(NamedTuple):
  """Streams that change robots, leading (groups, members).

  Attributes:
    before: Stream of the first robot; of no meaning from `after.enter` on.
    after: Arrival of the second robot, whose clock stands until the first chunk in which a stream
      may move.
  """

  before: Stream
  after: Arrival


class Arriving(Rollout):
  """Rollout of the second robot. A stream that waits rests; its wait ends as if it were an episode,
  so that the next one begins by the ordinary reset.
  """

  def _control(
    self, stream: Arrival, action: Float[Array, "act"]
  ) -> tuple[Any, Step, Float[Array, ""]]:
    later, out, _ = super()._control(stream, action)
    waits = stream.t < stream.enter
    env = jax.tree.map(lambda rest, moved: jnp.where(waits, rest, moved), stream.env, later.env)
    out = out._replace(
      terminated=out.terminated & ~waits,
      truncated=jnp.where(waits, later.t == stream.enter, out.truncated),
    )
    # to be another robot is severity 1, whatever else befalls it
    return later._replace(env=env), out, jnp.where(waits, 0.0, 1.0)


class Transfer:
  """Rollout of streams that begin as one robot and become another; `chunk` as that of Rollout.

    enter = 1 + min {k >= due: an episode ends in control step k}           a stream is `before` in
      steps 0 .. enter - 1 and `after` from enter on

  Observation, action and reward of both robots are the same, and so is the agent. The life of a
  stream until `enter` is that of a run without a change; every key of the second robot comes from
  the stream's own and the control step, as after any reset.

  Args:
    before: environment of the first robot.
    after: of the second one.
    agent: acts in both.
    faults: of `after`, their clocks counted from step 0 of the run.
    repeat: control steps per decision, 1.
    deterministic: the policy's mean instead of a sample.

  Raises:
    UserError for another `repeat`, or robots that differ in what the agent sees or does.
  """

  def __init__(
    self,
    before: Any,
    after: Any,
    agent: Any,
    faults: tuple[faults_lib.Fault, ...],
    repeat: int = 1,
    deterministic: bool = False,
  ) -> None:
    if repeat != 1:
      raise UserError(
        "a change of robots needs an agent that decides in every control step; this one holds "
        f"its action for {repeat}"
      )
    seen = lambda spec: (spec.obs, spec.act, spec.control_s)
    if seen(before.spec) != seen(after.spec):
      raise UserError(
        f"robot {before.spec.name!r} cannot become {after.spec.name!r}, whose observation, "
        "action or control period is another"
      )
    self.agent, self.healthy = agent, (faults_lib.none(before),)
    self.before = Rollout(before, agent, self.healthy, 1, deterministic)
    self.after = Arriving(after, agent, faults, 1, deterministic)
    self._part, self._merge = jax.jit(part), jax.jit(merge)

  def start(self, key: PRNGKeyArray, target: Any, plan: faults_lib.Plan, due: ArrayLike) -> Moving:
    """A fresh stream.

    Args:
      key: see rollout.start.
      target: of the faults of `after`.
      plan: likewise.
      due: int32 (), see Arrival; FOREVER: never changes.
    """
    before = start(self.before.env, self.agent, self.healthy, key)
    after = start(self.after.env, self.agent, self.after.fault, key, target=target, plan=plan)
    return Moving(before, Arrival(*after, jnp.int32(due), jnp.int32(faults_lib.FOREVER)))

  def chunk(self, params: Any, streams: Moving, length: int) -> tuple[Moving, Row]:
    """`length` decisions of every stream: (streams', Row with leading (length, groups, members)).
    Runs on the host.
    """
    before, after = streams
    if np.all(np.asarray(after.enter) <= np.asarray(after.t)):
      after, rows = self.after.chunk(params, after, length)
      return Moving(before, after), rows
    left, rows = self.before.chunk(params, before, length)
    if np.all(np.asarray(left.t) <= np.asarray(after.due)):
      return Moving(left, after), rows
    after = self._part(before, rows, after)
    arrived, others = self.after.chunk(params, after, length)
    return Moving(left, arrived), self._merge(before.t, after.enter, rows, others)


def clock(t: Int[Array, "groups members"], rows: Row) -> Int[Array, "steps groups members"]:
  """Control step of each row of a chunk that begins with step `t`."""
  return t + jnp.arange(rows.reward.shape[0])[:, None, None]


def part(before: Stream, rows: Row, after: Arrival) -> Arrival:
  """`after` on the clock of `before` at the chunk's start, with `enter` and the episode's number of
  those streams that leave in the chunk.
  """
  ends = (rows.terminated | rows.truncated) & (clock(before.t, rows) >= after.due)
  leaves = (after.enter == faults_lib.FOREVER) & jnp.any(ends, 0)
  last = jnp.argmax(ends, 0)
  episode = jnp.take_along_axis(rows.episode, last[None], 0)[0]  # the reset adds 1
  return after._replace(
    t=before.t,
    enter=jnp.where(leaves, before.t + last + 1, after.enter),
    episode=jnp.where(leaves, episode, after.episode),
  )


def merge(
  t: Int[Array, "groups members"], enter: Int[Array, "groups members"], before: Row, after: Row
) -> Row:
  """Of each stream the rows of `before` up to step enter - 1, then those of `after`."""
  moved = clock(t, before) >= enter
  return jax.tree.map(lambda a, b: jnp.where(expand(moved, a), b, a), before, after)
