"""Proof that every fault acts: what it changes, from when on, by how much, and what it costs.
`mjx-cl certify` writes it down.

All lanes of a robot (every fault, severity and target) live in one compiled program, under the same
actions, beside the robot without any fault.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl import faults as faults_lib
from mjx_cl.faults import presets, schedule
from mjx_cl.keys import OfStep

if TYPE_CHECKING:
  from collections.abc import Callable, Sequence

  from mjx_cl.types import Model

SEVERITIES = (0.0, 0.25, 0.5, 0.75, 1.0)
AFTER = (1, 10, 100)  # control steps at which the size of the difference is reported
# largest relative difference of the same nominal robot in two programs: XLA folds constants, which
# shifts last bits
ROUNDING = 1e-4
# relative; a sum's last bits depend on the place of a lane in its batch, since XLA adds whole
# vectors and rests otherwise
REWARD_ROUNDING = 2e-6
# lanes at a time: XLA cuts a wide batch into shares and their rests, which scalar code computes
# with other last bits
WIDTH = 64
SLACK = 0.9  # a difference counts as not smaller from this share of the one before on


class Lane(NamedTuple):
  """One robot of the proof: fault, target, severity; or a preset, with `fault` its name and the
  target `preset`.
  """

  fault: str
  target: str
  severity: float


class Certificate(NamedTuple):
  """What one lane shows.

  Attributes:
    robot, fault, family, target, severity: what was set; the row of fault `none` holds the nominal
      robot in this program against a program without any fault, diff_1 the largest relative
      difference.
    identical: observations bit-identical to the nominal robot's in all steps, rewards to rounding
      (must hold at severity 0).
    early: something differs before the onset (must not be).
    first_step: first control step, counted from the onset, whose outcome differs; None: none does.
    diff_1, diff_10, diff_100: root mean square over channels of (x - x_nominal) / scale, so many
      steps after that first one (1 = itself); for a fault that only changes the reward, |r -
      r_nominal|.
    monotone: at the step at which the greatest severity first differs, the differences do not fall
      with severity; None: single severity.
    reason: why it need not be monotone.
    finite: every observation and reward is a number.
  """

  robot: str
  fault: str
  family: str
  target: str
  severity: float
  identical: bool
  early: bool
  first_step: int | None
  diff_1: float | None
  diff_10: float | None
  diff_100: float | None
  monotone: bool | None
  reason: str
  finite: bool = True


def lanes(
  faults: dict[str, faults_lib.Fault],
  severities: Sequence[float] = SEVERITIES,
  targets: bool = True,
) -> list[Lane]:
  """Every severity on the first target, and severity 1 on all others; of a sensor, whose channels
  are many, on those that may be drawn.
  """
  out = []
  for name, f in faults.items():
    out += [Lane(name, f.targets[0], s) for s in severities]
    out += (
      [Lane(name, t, 1.0) for t in f.targets[1 : f.drawn if f.senses else None]] if targets else []
    )
  return out


def preset_lanes(env: Any, faults: dict[str, faults_lib.Fault]) -> list[Lane]:
  """One lane for every preset that this robot can have."""
  out = []
  for name, preset in presets.PRESETS.items():
    if (
      preset.robot in (env.spec.name, "*")
      and preset.changes
      and all(c.fault in faults for c in preset.changes)
    ):
      out.append(Lane(name, "preset", max(c.severity for c in preset.changes)))
  return out


def actions(env: Any, steps: int, seed: int, size: float = 1.0) -> np.ndarray:
  """A smooth command signal, float32 (steps, A) in [-1, 1]: two sines of drawn frequency and phase,
  0.9 and 0.4 times `size`.
  """
  rng = np.random.default_rng(seed)
  t = np.arange(steps)[:, None] * env.spec.control_s
  hertz, phase = (
    rng.uniform(0.5, 2.5, (2, 1, len(env.spec.act))),
    rng.uniform(0, 2 * np.pi, (2, 1, len(env.spec.act))),
  )
  signal = 0.9 * np.sin(2 * np.pi * hertz[0] * t + phase[0]) + 0.4 * np.sin(
    2 * np.pi * hertz[1] * t + phase[1]
  )
  return np.clip(size * signal, -1, 1).astype(np.float32)


def live(
  env: Any,
  faults: tuple,
  model: Model,
  key: jax.Array,
  injection: faults_lib.Injection,
  signal: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
  """One robot of nominal `model` under `signal` (T, A), never reset. Returns (obs (T, O), reward
  (T,), terminated (T,)) of arriving.
  """
  key_env, key = jax.random.split(key)
  state, obs = env.init(model, key_env)
  injection, _ = faults_lib.sense(faults, injection, jnp.int32(0), key, model, obs, True)

  def step(
    carry: tuple[Any, faults_lib.Injection], x: tuple[jax.Array, jax.Array]
  ) -> tuple[tuple[Any, faults_lib.Injection], tuple[jax.Array, jax.Array, jax.Array]]:
    state, injection = carry
    t, action = x
    now = jax.random.fold_in(key, t)
    injection, ports, _ = faults_lib.drive(
      faults,
      injection,
      t,
      jax.random.fold_in(now, OfStep.FAULTS),
      faults_lib.Ports(model, ctrl=action, first=t == 0),
    )
    state, out = env.step(ports.model, state, ports.ctrl)
    injection, obs = faults_lib.sense(
      faults, injection, t + 1, jax.random.fold_in(now, OfStep.READING), model, out.final_obs
    )
    return (state, injection), (obs, out.reward, out.terminated)

  times = jnp.arange(signal.shape[0])
  return jax.lax.scan(step, (state, injection), (times, signal))[1]


def program(env: Any, faults: tuple) -> Callable[..., Any]:
  """(model, key, plans, targets, signal) -> (obs, reward, terminated) of every lane and of the same
  robot in a program without faults, jitted.

  plans and targets lead with (lanes,). The nominal model is an argument: as a constant it would be
  folded.
  """
  none = faults_lib.none(env)

  def run(
    model: Model, key: jax.Array, plans: schedule.Plan, targets: jax.Array, signal: jax.Array
  ) -> tuple[tuple[jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]:
    one = lambda plan, target: live(
      env, faults, model, key, faults_lib.begin(faults, jax.random.key(0), plan, target), signal
    )
    plain = live(
      env,
      (none,),
      faults_lib.owned_model((none,), env.model),
      key,
      faults_lib.begin(none, jax.random.key(0), faults_lib.plan()),
      signal,
    )
    return jax.vmap(one)(plans, targets), plain

  return jax.jit(run)


def plans(
  faults: dict[str, faults_lib.Fault], chosen: list[Lane], onset: int
) -> tuple[schedule.Plan, jax.Array]:
  """Plan (lanes, F) and targets (lanes, F): each lane has its own fault or faults, the others rest
  at severity 0.

  Of a preset that has a fault again, later, its first time counts here: each fault has one place in
  the program, and the proof is of what it does.
  """
  names, shape = list(faults), (len(chosen), len(faults))
  columns = {
    "severity": np.zeros(shape),
    "onset": np.full(shape, onset),
    "duration": np.full(shape, faults_lib.FOREVER),
    "schedule": np.zeros(shape, int),
    "period": np.full(shape, 1000),
    "share": np.full(shape, 0.5),
  }
  target = np.zeros(shape, np.int32)
  for i, lane in enumerate(chosen):
    changes = (
      (presets.Change(lane.fault, lane.target, lane.severity),)
      if not presets.named(lane.fault)
      else presets.PRESETS[lane.fault].changes
    )
    if len({(c.fault, c.after) for c in changes}) < len(changes):
      raise ValueError(
        f"preset {lane.fault!r} has a fault twice at once, which one program cannot hold"
      )
    for c in {
      c.fault: c for c in sorted(changes, key=lambda c: -c.after)
    }.values():  # the earliest of each comes last, and stays
      f = names.index(c.fault)
      values = (
        c.severity,
        onset + c.after,
        c.duration or faults_lib.FOREVER,
        list(schedule.SCHEDULES).index(c.schedule),
        c.period,
        c.share,
      )
      for column, value in zip(columns.values(), values):
        column[i, f] = value
      target[i, f] = 0 if c.target is None else faults[c.fault].targets.index(c.target)
  return schedule.plan(**columns), jnp.asarray(target)


def certify(
  env: Any,
  faults: dict[str, faults_lib.Fault] | None = None,
  severities: Sequence[float] = SEVERITIES,
  chosen: list[Lane] | None = None,
  onset: int = 25,
  steps: int = 240,
  seed: int = 0,
  sizes: Sequence[float] = (1.0, 0.4),
) -> list[Certificate]:
  """Certificates of `faults` (all that the robot can have) on `env`.

  Args:
    chosen: lanes, in place of those that `severities` give, and the presets.
    onset, steps: control steps; a fault must act within steps - onset - 100.
    seed: of the start and the signal; one more for each further size.
    sizes: of the signals. Identity and onset must hold under each; to act, and to grow with
      severity, a fault needs one: a vigorous one reaches limits of speed and range, a gentle one
        leaves a legged robot on its feet.
  """
  if faults is None:
    faults = {k: f for k, f in faults_lib.available(env).items() if k != "none"}
  chosen = lanes(faults, severities) + preset_lanes(env, faults) if chosen is None else chosen
  nominal = Lane(next(iter(faults)), next(iter(faults.values())).targets[0], 0.0)
  run = program(env, tuple(faults.values()))
  model = faults_lib.owned_model(tuple(faults.values()), env.model)
  under: list[list[Certificate]] = []
  for k, size in enumerate(sizes):
    signal, out = jnp.asarray(actions(env, steps, seed + k, size)), []  # type: ignore[var-annotated]
    for part in parts(chosen):
      plan, target = plans(faults, part + [nominal] * (WIDTH - len(part)), onset)
      rows, plain = jax.tree.map(
        np.asarray, run(model, jax.random.key(seed + k), plan, target, signal)
      )
      found = compare(env, faults, part, rows, plain, onset)
      out += found[1:] if out else found
    under.append(out)
  return [best(rows) for rows in zip(*under)]


def best(rows: tuple[Certificate, ...]) -> Certificate:
  """One certificate of the same lane under several signals."""
  acting = [r for r in rows if not r.identical] or [rows[0]]
  chosen = next((r for r in acting if r.monotone), acting[0])
  identical = all(r.identical for r in rows) if rows[0].severity == 0 else chosen.identical
  return chosen._replace(
    identical=identical,
    early=any(r.early for r in rows),
    finite=all(r.finite for r in rows),
    diff_1=max((r.diff_1 for r in rows), default=None)  # type: ignore[type-var]
    if rows[0].fault == "none"
    else chosen.diff_1,
  )


def parts(chosen: list[Lane]) -> list[list[Lane]]:
  """Lanes in batches that leave room for the nominal robot; a fault's lanes stay together, as far
  as they fit.
  """
  out: list[list[Lane]] = [[]]
  for name in dict.fromkeys(lane.fault for lane in chosen):
    mine = [lane for lane in chosen if lane.fault == name]
    for i in range(0, len(mine), WIDTH - 1):
      batch = mine[i : i + WIDTH - 1]
      if len(out[-1]) + len(batch) > WIDTH - 1:
        out.append([])
      out[-1] += batch
  return out


def compare(
  env: Any,
  faults: dict[str, faults_lib.Fault],
  chosen: list[Lane],
  rows: tuple[np.ndarray, ...],
  plain: tuple[np.ndarray, ...],
  onset: int,
) -> list[Certificate]:
  """Rows of the lanes, the last of which is the nominal robot, against that one; it is held against
  the program without faults.
  """
  obs, reward, terminated = (x[: len(chosen)] for x in rows)
  rounding = max(
    float(np.max(np.abs(rows[k][-1] - plain[k]) / (1.0 + np.abs(plain[k])))) for k in (0, 1)
  )
  plain = tuple(x[-1] for x in rows)
  scale = np.asarray([v.scale for v in env.spec.obs])
  bits = lambda x: np.ascontiguousarray(x, np.float32).view(np.uint32)
  paid = np.abs(reward - plain[1][None]) > REWARD_ROUNDING * (1.0 + np.abs(plain[1][None]))
  differs = (
    (bits(obs) != bits(plain[0])[None]).any(-1) | paid | (terminated != plain[2][None])
  )  # (lanes, T)
  size = np.sqrt(np.mean(((obs - plain[0][None]) / scale) ** 2, -1))
  size = np.where(size == 0, np.abs(reward - plain[1][None]), size)
  sound = np.isfinite(obs).all((1, 2)) & np.isfinite(reward).all(1)
  # an outcome of step t is read at t + 1: a sensor that fails at the onset already shows in the
  # outcome of the step before
  out = [
    Certificate(
      env.spec.name,
      "none",
      "none",
      "all",
      0.0,
      rounding < ROUNDING,
      False,
      None,
      rounding,
      None,
      None,
      None,
      "",
    )
  ]
  for i, lane in enumerate(chosen):
    mine = (
      (lane.fault,)
      if not presets.named(lane.fault)
      else tuple(c.fault for c in presets.PRESETS[lane.fault].changes)
    )
    begin = onset - 1 if any(faults[name].senses for name in mine) else onset
    at = np.flatnonzero(differs[i])
    first = int(at[0]) if at.size else None
    values = [
      float(size[i, first + k - 1]) if first is not None and first + k - 1 < size.shape[1] else None
      for k in AFTER
    ]
    kind, reason = (
      ("preset", "")
      if presets.named(lane.fault)
      else (faults_lib.family(lane.fault), faults[lane.fault].not_monotone)
    )
    out.append(
      Certificate(  # type: ignore[call-arg]
        env.spec.name,
        lane.fault,
        kind,
        lane.target,
        lane.severity,
        not at.size,
        first is not None and first < begin,
        None if first is None else first - begin,
        *values,  # type: ignore[arg-type]
        monotone(chosen, differs, size, i),
        reason,
        bool(sound[i]),
      )
    )
  return out


def monotone(chosen: list[Lane], differs: np.ndarray, size: np.ndarray, i: int) -> bool | None:
  """Whether the differences do not fall with severity at the step at which the greatest severity of
  this fault and target first differs: none by more than a tenth from one severity to the next
  (SLACK), and the greatest severity's is no smaller than that of the least above 0.
  """
  same = sorted(
    (lane.severity, k)
    for k, lane in enumerate(chosen)
    if (lane.fault, lane.target) == (chosen[i].fault, chosen[i].target)
  )
  if len(same) < 2:
    return None
  last = same[-1][1]
  if not differs[last].any():
    return False
  at = int(np.argmax(differs[last]))
  values = [size[k, at] for _, k in same]
  acting = [x for (severity, _), x in zip(same, values) if severity > 0]
  return bool(all(b >= SLACK * a for a, b in zip(values, values[1:])) and acting[-1] >= acting[0])


def faulty(rows: list[Certificate]) -> list[str]:
  """What is wrong, one line each; empty where every fault does what it claims."""
  out = []
  for c in rows:
    who = f"{c.robot}: fault {c.fault}, target {c.target}, severity {c.severity:g}"
    if c.fault == "none" and not c.identical:
      out.append(
        f"{c.robot}: with all faults at severity 0 it is not the robot without faults "
        f"(relative difference {c.diff_1:.1e})"
      )
    elif c.severity == 0 and not c.identical:
      out.append(f"{who} is not the nominal robot bit for bit (step {c.first_step} from the onset)")
    if not c.finite:
      out.append(f"{who} makes observations or rewards that are no numbers")
    if c.severity > 0 and c.identical:
      out.append(f"{who} changes nothing")
    if c.early:
      out.append(f"{who} changes something before the onset")
    if c.severity == 1 and c.monotone is False and not c.reason:
      out.append(f"{who}: its difference falls with severity, and no reason is given")
  return out
