"""`mjx-cl certify`: every robot x fault x severity and preset, what it changes (faults.certificate)
and what it costs an agent that does not adapt.
"""

from __future__ import annotations

import pathlib
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import envs
from mjx_cl import faults as faults_lib
from mjx_cl.config import PRESETS
from mjx_cl.dreamer.agent import Agent
from mjx_cl.errors import FileError, UserError
from mjx_cl.faults import certificate, presets
from mjx_cl.io import tables
from mjx_cl.rollout.monitor import Monitor
from mjx_cl.rollout.scan import Rollout, nest, start
from mjx_cl.rollout.transfer import Transfer
from mjx_cl.scoring import intervals
from mjx_cl.training import agents
from mjx_cl.training.episodes import Episodes

if TYPE_CHECKING:
  from collections.abc import Callable, Sequence
  from typing import Any

CHUNK = 50  # decisions
WARM = 30  # decisions at an episode's start whose residuals are not compared
AT_ONCE = 120  # robots side by side
COLUMNS = certificate.Certificate._fields + (
  "physics",
  "agent",
  "episodes",
  "return_nominal",
  "return_mean",
  "return_lost",
  "return_lost_low",
  "return_lost_high",
  "kl_nats",
)


class Cost:
  """Lives whole episodes of the shipped agent under faults, all in one program per robot.

  Args:
    env, trained: robot and its agent. faults: name -> Fault, the program's.
    episodes: per lane; episode e starts from seed e, for every lane alike.
  """

  def __init__(self, env: Any, trained: agents.Trained, faults: dict, episodes: int) -> None:
    self.env, self.agent, self.faults, self.episodes = env, trained.agent, faults, episodes
    self.params = jax.tree.map(lambda x: x[None], trained.train.params)
    self.repeat = int(trained.card.get("repeat", 1))
    self.rollout = Rollout(env, self.agent, tuple(faults.values()), self.repeat)
    self.monitor = Monitor(self.agent, spec=self.env.spec)
    self.watch = jax.jit(self.monitor.update)
    self.begin = jax.jit(
      jax.vmap(
        lambda key, plan, target: start(
          env, self.agent, tuple(faults.values()), key, target=target, plan=plan
        )
      )
    )

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
    for chunk in range(-(-self.env.spec.episode_steps // self.repeat // CHUNK)):
      streams, rows = self.rollout.chunk(self.params, streams, CHUNK)
      history, residual = self.watch(
        self.params, history, rows, jax.random.split(jax.random.key(chunk), 1)
      )
      residuals.append(
        np.stack([np.asarray(residual.opr)[:, 0], np.asarray(residual.rpr)[:, 0]], -1)
      )
      warm = np.arange(chunk * CHUNK, (chunk + 1) * CHUNK) >= WARM
      kept.append(lived.add(rows)[:, 0] & warm[:, None])
      if not lived.alive.any():
        break
    values, kept = np.concatenate(residuals), np.concatenate(kept)  # type: ignore[assignment]
    good = kept & np.isfinite(values).all(-1)
    logs = np.log(np.maximum(values, 1e-9))
    mine = lambda i: slice(i * self.episodes, (i + 1) * self.episodes)
    return lived.total.reshape(lanes, self.episodes), [
      logs[:, mine(i)][good[:, mine(i)]] for i in range(lanes)
    ]


def divergence(faulted: np.ndarray, nominal: np.ndarray) -> float | None:
  """Kullback-Leibler divergence of two normal fits to (ln OPR, ln RPR), nats per step.

    KL = (tr(S0^-1 S1) + (m0 - m1)' S0^-1 (m0 - m1) - 2 + ln(det S0 / det S1)) / 2          1
      faulted, 0 nominal

  What a detector can gain per step if samples were independent; they are not, so it is an upper
  figure for one that reads these two.
  """
  if len(faulted) < 20 or len(nominal) < 20:
    return None
  m1, m0 = faulted.mean(0), nominal.mean(0)
  s1, s0 = np.cov(faulted.T) + 1e-9 * np.eye(2), np.cov(nominal.T) + 1e-9 * np.eye(2)
  inverse = np.linalg.inv(s0)
  return float(
    (
      np.trace(inverse @ s1)
      + (m0 - m1) @ inverse @ (m0 - m1)
      - 2
      + np.log(np.linalg.det(s0) / np.linalg.det(s1))
    )
    / 2
  )


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
  agent, key = (
    Agent(PRESETS["tiny"].dreamer, len(env.spec.obs), len(env.spec.act)),
    jax.random.key(seed),
  )
  params = jax.tree.map(lambda x: x[None], jax.jit(agent.init)(key).params)
  none, others = faults_lib.none(env), faults_lib.none(other)
  moves, stays = Transfer(env, other, agent, (others,)), Rollout(env, agent, (none,))
  moving, staying = (
    nest(begin, 0, 0)(key[None, None])
    for begin in (
      lambda k: moves.start(k, -1, faults_lib.plan(), onset),
      lambda k: start(env, agent, (none,), k),
    )
  )
  lives: tuple[list[np.ndarray], list[np.ndarray]]
  lives = [], []
  while int(moving.after.enter[0, 0]) == faults_lib.FOREVER or len(lives[0]) * CHUNK < int(
    moving.after.enter[0, 0]
  ) + max(certificate.AFTER):
    moving, a = moves.chunk(params, moving, CHUNK)
    staying, b = stays.chunk(params, staying, CHUNK)
    for life, rows in zip(lives, (a, b)):
      life.append(
        np.concatenate(
          [
            np.asarray(x, np.float32).reshape(CHUNK, -1)
            for x in (rows.final_obs, rows.reward, rows.terminated)
          ],
          1,
        )
      )
  moved, stayed = (np.concatenate(life).view(np.uint32) for life in lives)
  at = np.flatnonzero((moved != stayed).any(-1))
  first = int(at[0]) - int(moving.after.enter[0, 0]) if at.size else None
  signal, robots = jnp.asarray(certificate.actions(env, max(certificate.AFTER), seed)), []
  for robot, fault in ((env, none), (other, others)):
    alone = jax.jit(
      lambda model, robot=robot, fault=fault: certificate.live(
        robot, (fault,), model, key, faults_lib.begin(fault, key, faults_lib.plan()), signal
      )[0]
    )
    robots.append(np.asarray(alone(faults_lib.owned_model((fault,), robot.model))))
  size = np.sqrt(
    np.mean(((robots[1] - robots[0]) / np.asarray([v.scale for v in env.spec.obs])) ** 2, -1)
  )
  return certificate.Certificate(  # type: ignore[call-arg]
    env.spec.name,
    preset,
    "preset",
    "preset",
    1.0,
    not at.size,
    first is not None and first < 0,
    first,
    *(float(size[k - 1]) for k in certificate.AFTER),  # type: ignore[arg-type]
    None,
    "",
    bool(np.isfinite(robots).all()),
  )


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
    episodes: per lane for the cost; 0, or a robot without a shipped agent: no cost is measured
      (null).
    only: names of faults, or of presets that turn the robot into another one; () for all.
  """
  env = envs.make(name, physics)
  moves = [preset for preset in changes(env.spec.name) if not only or preset in only]
  named = tuple(fault for fault in only if fault not in moves)
  faults = {k: f for k, f in faults_lib.available(env).items() if k != "none"}
  for fault in named:
    if not faults_lib.make(fault, env).owns:
      raise UserError(
        f"fault {fault!r} changes nothing by design; choose from: {', '.join(faults)}"
      )
  faults = {k: faults_lib.make(k, env) for k in named} if only else faults
  trained = agents.of(env, agent) if episodes and (agent or agents.is_shipped(env)) else None
  unknown = {
    "physics": envs.physics_of(env).name,
    "agent": None,
    "episodes": 0,
    "return_nominal": None,
    "return_mean": None,
    "return_lost": None,
    "return_lost_low": None,
    "return_lost_high": None,
    "kl_nats": None,
  }
  rows = []
  if faults:
    progress(f"{name}: {len(faults)} faults, acting under the same commands")
    rows = [c._asdict() | unknown for c in certificate.certify(env, faults)]
    found = costs(env, trained, faults, episodes, progress) if trained else {}
    for row in rows:
      row |= found.get(certificate.Lane(row["fault"], row["target"], row["severity"]), {})
  for preset in moves:
    progress(f"{name}: {preset}")
    other = envs.make(presets.PRESETS[preset].becomes, physics)  # type: ignore[arg-type]
    row = become(env, other, preset)._asdict() | unknown
    if trained:
      whole = [
        Cost(robot, trained, {"none": faults_lib.none(robot)}, episodes).live(
          [certificate.Lane("none", "all", 0.0)]
        )
        for robot in (env, other)
      ]
      row |= price(trained, *((returns[0], logs[0]) for returns, logs in whole))
    rows.append(row)
  return rows


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
  found: dict[certificate.Lane, dict]
  at_once, found = max(2, AT_ONCE // episodes), {}
  nominal = None
  for i in range(0, len(chosen), at_once):
    part = chosen[i : i + at_once]
    returns, logs = cost.live(part + [chosen[0]] * (at_once - len(part)))
    nominal = (returns[0], logs[0]) if nominal is None else nominal
    found |= {lane: price(trained, nominal, life) for lane, *life in zip(part, returns, logs)}
    progress(f"{env.spec.name}: cost of {min(i + at_once, len(chosen))}/{len(chosen)} settings")
  return found


def old_rows(folder: pathlib.Path | str) -> list[dict]:
  """Rows of certificates.parquet in `folder`, [] where there is none; FileError for one that is no
  such table or a folder that cannot be written.
  """
  import pyarrow
  import pyarrow.parquet

  folder = pathlib.Path(folder)
  path = folder / "certificates.parquet"
  try:
    folder.mkdir(parents=True, exist_ok=True)
    probe = folder / "certificates.tmp"
    probe.touch()
    probe.unlink()
    rows = pyarrow.parquet.read_table(path).to_pylist() if path.exists() else []
  except OSError as e:
    raise FileError(f"cannot write in {folder}: {e.strerror or e}") from None
  except pyarrow.ArrowException as e:
    raise FileError(
      f"{path} is no table of certificates: {str(e).splitlines()[0]}; give another --out"
    ) from None
  if rows and set(rows[0]) != set(COLUMNS):
    raise FileError(
      f"{path} has the columns of another version; give another --out, or move it away"
    )
  return rows


def guard(folder: pathlib.Path | str, names: tuple[str, ...], episodes: int) -> None:
  """Refuses what would lose measured costs, before anything is measured."""
  costly = {r["robot"] for r in old_rows(folder) if r["episodes"]} & {
    envs.make(name).spec.name if ":" in name else name for name in names
  }
  if not episodes and costly:
    raise UserError(
      f"{folder} holds measured costs of {', '.join(sorted(costly))}; give --episodes above 0, "
      "or another --out"
    )


def write(folder: pathlib.Path | str, rows: list[dict]) -> None:
  """Writes certificates.parquet and certificates.md; rows of other robots, faults and backends that
  are there already are kept.
  """
  folder = pathlib.Path(folder)
  which = lambda r: (r["robot"], r["fault"], r["physics"])
  new = {which(r) for r in rows}
  rows = [r for r in old_rows(folder) if which(r) not in new] + rows
  tables.write_table(folder / "certificates.parquet", {k: [r[k] for r in rows] for k in COLUMNS})
  tmp = folder / "certificates.md.tmp"
  tmp.write_text(table(rows))
  tmp.replace(folder / "certificates.md")


def table(rows: list[dict]) -> str:
  """The certificates for a reader: one line per robot, fault and target, its greatest severity;
  backends apart.
  """
  number = lambda x, form: "" if x is None else format(x, form)
  out = [
    "# Certificates: every fault acts",
    "",
    (
      "Made by `mjx-cl certify`; all severities are in certificates.parquet. Each line is a "
      "fault at severity 1 (a preset: its own). `first` is the first control"
    ),
    (
      "step from the onset whose outcome differs under the same commands, `after 1, 10, 100` the "
      "difference so many steps on (root mean square over the"
    ),
    (
      "channels, in typical deviations). `return lost`: mean over episodes of the shipped agent, "
      "which does not adapt, with its 95 % bootstrap interval over"
    ),
    "episodes. `KL`: normal fits to ln OPR, ln RPR against the nominal robot's, nats per step.",
    "",
  ]
  for robot, physics in dict.fromkeys((r["robot"], r["physics"]) for r in rows):
    mine = [
      r
      for r in rows
      if (r["robot"], r["physics"]) == (robot, physics)
      and r["fault"] != "none"
      and r["severity"] > 0
    ]
    top: dict[tuple[str, str], dict] = {}
    for r in mine:
      key = (r["fault"], r["target"])
      if key not in top or r["severity"] > top[key]["severity"]:
        top[key] = r
    agent = next((r for r in mine if r["episodes"]), None)
    several = len({r["physics"] for r in rows if r["robot"] == robot}) > 1
    out += [
      f"## {robot}" + (f", physics {physics}" if several else ""),
      "",
      "No agent is shipped for it, so no return is given."
      if agent is None
      else (
        f"Nominal return {agent['return_nominal']:.0f} over {agent['episodes']} episodes of "
        f"agent `{agent['agent']}`."
      ),
      "",
      "| family | fault | target | severity | first | after 1 | 10 | 100 | return lost | KL |",
      "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in top.values():
      lost = (
        ""
        if r["return_lost"] is None
        else (
          f"{r['return_lost']:.0f} [{number(r['return_lost_low'], '.0f')}, "
          f"{number(r['return_lost_high'], '.0f')}]"
        )
      )
      out.append(
        f"| {r['family']} | {r['fault']} | {r['target']} | {r['severity']:.3g} | "
        f"{number(r['first_step'], 'd')} | {number(r['diff_1'], '.2g')} | "
        f"{number(r['diff_10'], '.2g')} | {number(r['diff_100'], '.2g')} | {lost} | "
        f"{number(r['kl_nats'], '.2g')} |"
      )
    out.append("")
  return "\n".join(out)


def summary(rows: list[dict]) -> list[dict]:
  """What `--json` prints: {name, value, unit, goal, holds} per robot."""
  out = []
  fields = certificate.Certificate._fields
  for robot in dict.fromkeys(r["robot"] for r in rows):
    mine = [certificate.Certificate(*(r[k] for k in fields)) for r in rows if r["robot"] == robot]
    wrong = certificate.faulty(mine)
    names = {c.fault for c in mine if c.fault != "none" and not presets.named(c.fault)}
    out += [
      {
        "name": f"{robot}: faults certified",
        "value": len(names),
        "unit": "faults",
        "goal": None,
        "holds": None,
      },
      {
        "name": f"{robot}: faults that fail",
        "value": len(wrong),
        "unit": "lanes",
        "goal": "== 0",
        "holds": not wrong,
      },
    ]
  return out


def check(names: tuple[str, ...]) -> None:
  """Raises UserError for an unknown robot."""
  for name in names:
    if name not in envs.ENVS:
      raise UserError(f"unknown environment {name!r}; choose from: {', '.join(sorted(envs.ENVS))}")
