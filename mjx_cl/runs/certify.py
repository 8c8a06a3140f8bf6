"""`mjx-cl certify`: every robot x fault x severity and preset, what it changes (faults.certificate)
and what it costs an agent that does not adapt.
"""

import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import envs
from mjx_cl import faults as faults_lib
from mjx_cl.config import PRESETS
from mjx_cl.dreamer.agent import Agent
from mjx_cl.errors import require
from mjx_cl.faults import certificate, presets
from mjx_cl.rollout.monitor import Monitor
from mjx_cl.rollout.scan import Rollout, Row, nest, start
from mjx_cl.rollout.transfer import Transfer
from mjx_cl.runs.certificate_tables import COSTS
from mjx_cl.scoring import intervals
from mjx_cl.training import agents
from mjx_cl.training.episodes import Episodes

CHUNK = 50  # decisions
WARM = 30  # decisions at an episode's start whose residuals are not compared
AT_ONCE = 120  # robots side by side


class Cost:
  """Lives whole episodes of the shipped agent under faults, all in one program per robot.

  Args:
    env: robot.
    trained: its agent.
    faults: name -> Fault, the program's.
    episodes: per lane; episode e starts from seed e, for every lane alike.
  """

  def __init__(self, env: Any, trained: agents.Trained, faults: dict, episodes: int) -> None:
    self.faults, self.episodes = faults, episodes
    self.params = jax.tree.map(lambda x: x[None], trained.train.params)
    agent, own, repeat = trained.agent, tuple(faults.values()), trained.repeat
    self.chunks = -(-env.spec.episode_steps // repeat // CHUNK)
    self.rollout = Rollout(env, agent, own, repeat)
    self.monitor = Monitor(agent, spec=env.spec)
    self.watch = jax.jit(self.monitor.update)
    begin = lambda key, plan, target: start(env, agent, own, key, target=target, plan=plan)
    self.begin = jax.jit(jax.vmap(begin))

  def live(self, chosen: list[certificate.Lane]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Returns of every lane (lanes, episodes), and of each lane the valid (ln OPR, ln RPR),
    (samples, 2).
    """
    lanes = len(chosen)
    plan, target = certificate.plans(self.faults, chosen, onset=0)
    spread = lambda x: jnp.repeat(x, self.episodes, 0)
    keys = jnp.tile(jax.vmap(jax.random.key)(jnp.arange(self.episodes)), lanes)
    streams = jax.tree.map(
      lambda x: x[None], self.begin(keys, jax.tree.map(spread, plan), spread(target))
    )
    history = self.monitor.init(1, lanes * self.episodes)
    lived, residuals, kept = Episodes((1, lanes * self.episodes)), [], []
    for chunk in range(self.chunks):
      streams, rows = self.rollout.chunk(self.params, streams, CHUNK)
      history, residual = self.watch(
        self.params, history, rows, jax.random.split(jax.random.key(chunk), 1)
      )
      residuals.append(np.stack([np.asarray(x)[:, 0] for x in (residual.opr, residual.rpr)], -1))
      warm = np.arange(chunk * CHUNK, (chunk + 1) * CHUNK) >= WARM
      kept.append(lived.add(rows)[:, 0] & warm[:, None])
      if not lived.alive.any():
        break
    values = np.concatenate(residuals)
    good = np.concatenate(kept) & np.isfinite(values).all(-1)
    logs = np.log(np.maximum(values, 1e-9))
    mine = [slice(i * self.episodes, (i + 1) * self.episodes) for i in range(lanes)]
    returns = lived.total.reshape(lanes, self.episodes)
    return returns, [logs[:, own][good[:, own]] for own in mine]


def divergence(faulted: np.ndarray, nominal: np.ndarray) -> float | None:
  """Kullback-Leibler divergence of two normal fits to (ln OPR, ln RPR), nats per step.

    KL = (tr(S0^-1 S1) + (m0 - m1)' S0^-1 (m0 - m1) - 2 + ln(det S0 / det S1)) / 2
    1: faulted, 0: nominal

  What a detector can gain per step if samples were independent; they are not, so it is an upper
  figure for one that reads these two.
  """
  if len(faulted) < 20 or len(nominal) < 20:
    return None
  m1, m0 = faulted.mean(0), nominal.mean(0)
  s1, s0 = np.cov(faulted.T) + 1e-9 * np.eye(2), np.cov(nominal.T) + 1e-9 * np.eye(2)
  inverse = np.linalg.inv(s0)
  volumes = np.log(np.linalg.det(s0) / np.linalg.det(s1))
  return float((np.trace(inverse @ s1) + (m0 - m1) @ inverse @ (m0 - m1) - 2 + volumes) / 2)


def price(
  trained: agents.Trained, nominal: Sequence[np.ndarray], own: Sequence[np.ndarray]
) -> dict:
  """Columns of what a lane costs; of each life the returns (episodes,) and the residuals (samples,
  2). Lost: nominal minus own, paired by episode.
  """
  lost = nominal[0] - own[0]
  low, high = intervals.interval(lost, lambda x, axis: np.mean(x, axis)) or (None, None)
  return {
    "agent": pathlib.Path(trained.path).name,
    "episodes": len(lost),
    "return_nominal": float(nominal[0].mean()),
    "return_mean": float(own[0].mean()),
    "return_lost": float(lost.mean()),
    "return_lost_low": low,
    "return_lost_high": high,
    "kl_nats": divergence(own[1], nominal[1]),
  }


def costs(
  env: Any, trained: agents.Trained, faults: dict, episodes: int, progress: Callable[[str], Any]
) -> dict[certificate.Lane, dict]:
  """Columns of `price` for every lane above severity 0."""
  cost, first = Cost(env, trained, faults, episodes), next(iter(faults))
  chosen = [certificate.Lane(first, faults[first].targets[0], 0.0)]  # the nominal robot
  chosen += [
    lane for lane in certificate.lanes(faults, targets=False) if lane.severity > 0
  ] + certificate.preset_lanes(env, faults)
  at_once = max(2, AT_ONCE // episodes)
  found: dict[certificate.Lane, dict] = {}
  nominal = None
  for i in range(0, len(chosen), at_once):
    part = chosen[i : i + at_once]
    returns, logs = cost.live(part + [chosen[0]] * (at_once - len(part)))
    nominal = (returns[0], logs[0]) if nominal is None else nominal
    found |= {lane: price(trained, nominal, life) for lane, *life in zip(part, returns, logs)}
    progress(f"{env.spec.name}: cost of {min(i + at_once, len(chosen))}/{len(chosen)} settings")
  return found


def changes(robot: str) -> list[str]:
  """Presets that turn this robot into another one and do no more; what others add later is
  certified as a preset of that one.
  """
  return [
    name
    for name, preset in presets.PRESETS.items()
    if preset.robot == robot and preset.becomes and not preset.then
  ]


def become(
  env: Any, other: Any, preset: str, onset: int = 25, seed: int = 0
) -> certificate.Certificate:
  """Certificate of a change of robots.

  diff_1, diff_10 and diff_100 are of the episode that begins with it: `other` against `env` from
  the same key and under the same signal, as in certificate.certify. When it begins to act is seen
  in a stream that becomes `other` at its first end from `onset` on (transfer.Transfer, a policy
  that has learnt nothing) beside the same stream that does not: `early` where a row before that end
  differs, `first_step` counted from the end.
  """
  agent = Agent(PRESETS["tiny"].dreamer, len(env.spec.obs), len(env.spec.act))
  key = jax.random.key(seed)
  moved, stayed, enter = _lives(env, other, agent, key, onset)
  at = np.flatnonzero((moved != stayed).any(-1))
  first = int(at[0]) - enter if at.size else None
  robots = _episodes(env, other, key, seed)
  size = np.sqrt(
    np.mean(((robots[1] - robots[0]) / np.asarray([v.scale for v in env.spec.obs])) ** 2, -1)
  )
  return certificate.Certificate(
    robot=env.spec.name,
    fault=preset,
    family="preset",
    target="preset",
    severity=1.0,
    identical=not at.size,
    early=first is not None and first < 0,
    first_step=first,
    monotone=None,
    reason="",
    finite=bool(np.isfinite(robots).all()),
    **{f"diff_{k}": float(size[k - 1]) for k in certificate.AFTER},
  )


def _lives(
  env: Any, other: Any, agent: Agent, key: jax.Array, onset: int
) -> tuple[np.ndarray, np.ndarray, int]:
  """Rows as bits, uint32 (decisions, channels), of a stream that becomes `other` and of the same
  that does not, and the control step at which it has become it.
  """
  params = jax.tree.map(lambda x: x[None], jax.jit(agent.init)(key).params)
  healthy = (faults_lib.none(env),)
  moves = Transfer(env, other, agent, (faults_lib.none(other),))
  stays = Rollout(env, agent, healthy)
  begin = lambda k: moves.start(k, -1, faults_lib.plan(), onset)
  moving = nest(begin, 0, 0)(key[None, None])
  staying = nest(lambda k: start(env, agent, healthy, k), 0, 0)(key[None, None])
  enter = faults_lib.FOREVER
  moved: list[np.ndarray] = []
  stayed: list[np.ndarray] = []
  while enter == faults_lib.FOREVER or len(moved) * CHUNK < enter + max(certificate.AFTER):
    moving, rows = moves.chunk(params, moving, CHUNK)
    moved.append(_channels(rows))
    staying, rows = stays.chunk(params, staying, CHUNK)
    stayed.append(_channels(rows))
    enter = int(moving.after.enter[0, 0])
  bits = lambda life: np.concatenate(life).view(np.uint32)
  return bits(moved), bits(stayed), enter


def _channels(rows: Row) -> np.ndarray:
  """float32 (decisions, channels)."""
  channels = (rows.final_obs, rows.reward, rows.terminated)
  return np.concatenate([np.asarray(x, np.float32).reshape(CHUNK, -1) for x in channels], 1)


def _episodes(env: Any, other: Any, key: jax.Array, seed: int) -> list[np.ndarray]:
  """What both robots observe from the same key on under the same signal."""
  signal, observed = jnp.asarray(certificate.actions(env, max(certificate.AFTER), seed)), []
  for robot in (env, other):
    none = faults_lib.none(robot)
    alone = jax.jit(
      lambda model, robot=robot, fault=none: certificate.live(
        robot, (fault,), model, key, faults_lib.begin(fault, key, faults_lib.plan()), signal
      )[0]
    )
    observed.append(np.asarray(alone(faults_lib.owned_model((none,), robot.model))))
  return observed


def certify(
  name: str,
  physics: str = "auto",
  episodes: int = 20,
  agent: str | None = None,
  only: tuple[str, ...] = (),
  progress: Callable[[str], Any] = lambda text: None,
) -> list[dict]:
  """Certificates of one robot as rows of results/certificates.parquet.

  Args:
    name: of the robot.
    physics: auto, native or mjx.
    episodes: per lane for the cost; 0, or a robot without a shipped agent: no cost is measured
      (null).
    agent: shipped name or folder; None: the shipped one, where there is one.
    only: names of faults, or of presets that turn the robot into another one; () for all.
    progress: called with each line for the user.
  """
  env = envs.make(name, physics)
  moves = [preset for preset in changes(env.spec.name) if not only or preset in only]
  named = tuple(fault for fault in only if fault not in moves)
  faults = {k: f for k, f in faults_lib.available(env).items() if k != "none"}
  for fault in named:
    require(
      faults_lib.make(fault, env).owns,
      f"fault {fault!r} changes nothing by design; choose from: {', '.join(faults)}",
    )
  faults = {k: faults_lib.make(k, env) for k in named} if only else faults
  trained = agents.of(env, agent) if episodes and (agent or agents.is_shipped(env)) else None
  unknown = dict.fromkeys(COSTS) | {"physics": envs.physics_of(env).name, "episodes": 0}
  rows = []
  if faults:
    progress(f"{name}: {len(faults)} faults, acting under the same commands")
    rows = [c._asdict() | unknown for c in certificate.certify(env, faults)]
    found = costs(env, trained, faults, episodes, progress) if trained else {}
    for row in rows:
      row |= found.get(certificate.Lane(row["fault"], row["target"], row["severity"]), {})
  for preset in moves:
    progress(f"{name}: {preset}")
    other = envs.make(str(presets.PRESETS[preset].becomes), physics)
    row = become(env, other, preset)._asdict() | unknown
    if trained:
      lives = []
      for robot in (env, other):
        cost = Cost(robot, trained, {"none": faults_lib.none(robot)}, episodes)
        returns, logs = cost.live([certificate.Lane("none", "all", 0.0)])
        lives.append((returns[0], logs[0]))
      row |= price(trained, *lives)
    rows.append(row)
  return rows


def check(names: tuple[str, ...]) -> None:
  """Raises UserError for an unknown robot."""
  for name in names:
    require(
      name in envs.ENVS,
      f"unknown environment {name!r}; choose from: {', '.join(sorted(envs.ENVS))}",
    )
