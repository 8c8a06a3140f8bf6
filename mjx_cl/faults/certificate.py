"""Proof that every fault acts: what it changes, from when on, by how much, and what it costs.
`mjx-cl certify` writes it down.

All lanes of a robot (every fault, severity and target) live in one compiled program, under the same
actions, beside the robot without any fault.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from mjx_cl import faults as faults_lib
from mjx_cl.faults import presets, schedule
from mjx_cl.faults.lanes import SEVERITIES, WIDTH, Lane, lanes, parts, plans, preset_lanes
from mjx_cl.keys import OfStep
from mjx_cl.types import Array, Model

AFTER = (1, 10, 100)  # control steps at which the size of the difference is reported
# largest relative difference of the same nominal robot in two programs: XLA folds constants, which
# shifts last bits
ROUNDING = 1e-4
# relative; a sum's last bits depend on the place of a lane in its batch, since XLA adds whole
# vectors and rests otherwise
REWARD_ROUNDING = 2e-6
SLACK = 0.9  # a difference counts as not smaller from this share of the one before on

# what a robot under a signal gives, step by step
Life = tuple[Float[Array, "steps obs"], Float[Array, " steps"], Bool[Array, " steps"]]


class Certificate(NamedTuple):
  """What one lane shows.

  Attributes:
    robot: its name.
    fault: name of a fault or preset; the row of fault `none` holds the nominal robot in this
      program against a program without any fault, diff_1 the largest relative difference.
    family: of the fault, or `preset`.
    target: what was hit.
    severity: in [0, 1].
    identical: observations bit-identical to the nominal robot's in all steps, rewards to rounding
      (must hold at severity 0).
    early: something differs before the onset (must not be).
    first_step: first control step, counted from the onset, whose outcome differs; None: none does.
    diff_1: root mean square over channels of (x - x_nominal) / scale in that first step; for a
      fault that only changes the reward, |r - r_nominal|.
    diff_10: the same in the tenth step from there.
    diff_100: the same in the hundredth.
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
  early: bool = False
  first_step: int | None = None
  diff_1: float | None = None
  diff_10: float | None = None
  diff_100: float | None = None
  monotone: bool | None = None
  reason: str = ""
  finite: bool = True


def actions(env: Any, steps: int, seed: int, size: float = 1.0) -> Float[np.ndarray, "steps act"]:
  """A smooth command signal in [-1, 1]: two sines of drawn frequency and phase, 0.9 and 0.4 times
  `size`.
  """
  rng = np.random.default_rng(seed)
  shape = (2, 1, len(env.spec.act))
  t = np.arange(steps)[:, None] * env.spec.control_s
  hertz = rng.uniform(0.5, 2.5, shape)
  phase = rng.uniform(0, 2 * np.pi, shape)
  first, second = np.sin(2 * np.pi * hertz * t + phase)
  return np.clip(size * (0.9 * first + 0.4 * second), -1, 1).astype(np.float32)


def live(
  env: Any,
  faults: tuple,
  model: Model,
  key: PRNGKeyArray,
  injection: faults_lib.Injection,
  signal: Float[Array, "steps act"],
) -> Life:
  """One robot of nominal `model` under `signal`, never reset: (obs, reward, terminated) of
  arriving.
  """
  key_env, key = jax.random.split(key)
  state, obs = env.init(model, key_env)
  injection, _ = faults_lib.sense(faults, injection, jnp.int32(0), key, model, obs, True)

  def step(
    carry: tuple[Any, faults_lib.Injection], x: tuple[Array, Array]
  ) -> tuple[tuple[Any, faults_lib.Injection], tuple[Array, Array, Array]]:
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

  return jax.lax.scan(step, (state, injection), (jnp.arange(signal.shape[0]), signal))[1]


def program(env: Any, faults: tuple) -> Callable[..., Any]:
  """(model, key, plans, targets, signal) -> (obs, reward, terminated) of every lane and of the same
  robot in a program without faults, jitted.

  plans and targets lead with (lanes,). The nominal model is an argument: as a constant it would be
  folded.
  """
  none = faults_lib.none(env)

  def run(
    model: Model, key: PRNGKeyArray, plans: schedule.Plan, targets: Array, signal: Array
  ) -> tuple[tuple[Array, ...], Life]:
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


def certify(
  env: Any,
  faults: Mapping[str, faults_lib.Fault] | None = None,
  severities: Sequence[float] = SEVERITIES,
  chosen: list[Lane] | None = None,
  onset: int = 25,
  steps: int = 240,
  seed: int = 0,
  sizes: Sequence[float] = (1.0, 0.4),
) -> list[Certificate]:
  """Certificates of `faults` (all that the robot can have) on `env`.

  Args:
    env: robot.
    faults: by name; None: all that it can have.
    severities: of the lanes.
    chosen: lanes, in place of those that `severities` give, and the presets.
    onset: first control step in which a fault acts.
    steps: control steps in all; a fault must act within steps - onset - 100.
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
    signal = jnp.asarray(actions(env, steps, seed + k, size))
    out: list[Certificate] = []
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
  if chosen.severity == 0:
    chosen = chosen._replace(identical=all(r.identical for r in rows))
  if chosen.fault == "none":
    chosen = chosen._replace(diff_1=max(r.diff_1 or 0.0 for r in rows))
  return chosen._replace(early=any(r.early for r in rows), finite=all(r.finite for r in rows))


def compare(
  env: Any,
  faults: Mapping[str, faults_lib.Fault],
  chosen: list[Lane],
  rows: tuple[np.ndarray, ...],
  plain: tuple[np.ndarray, ...],
  onset: int,
) -> list[Certificate]:
  """Rows of the lanes, the last of which is the nominal robot, against that one; it is held against
  the program without faults.
  """
  rounding = max(
    float(np.max(np.abs(rows[k][-1] - plain[k]) / (1.0 + np.abs(plain[k])))) for k in (0, 1)
  )
  differs, size = differences(env, rows)
  sound = np.isfinite(rows[0]).all((1, 2)) & np.isfinite(rows[1]).all(1)
  out = [
    Certificate(env.spec.name, "none", "none", "all", 0.0, rounding < ROUNDING, diff_1=rounding)
  ]
  for i, lane in enumerate(chosen):
    # an outcome of step t is read at t + 1: a sensor that fails at the onset already shows in the
    # outcome of the step before
    begin = onset - any(faults[c.fault].senses for c in lane.changes)
    at = np.flatnonzero(differs[i])
    certificate = Certificate(
      env.spec.name,
      lane.fault,
      "preset" if presets.named(lane.fault) else faults_lib.family(lane.fault),
      lane.target,
      lane.severity,
      not at.size,
      monotone=monotone(chosen, differs, size, i),
      reason="" if presets.named(lane.fault) else faults[lane.fault].not_monotone,
      finite=bool(sound[i]),
    )
    if at.size:
      first = int(at[0])
      after: Any = {
        f"diff_{k}": float(size[i, first + k - 1]) for k in AFTER if first + k <= size.shape[1]
      }
      certificate = certificate._replace(early=first < begin, first_step=first - begin, **after)
    out.append(certificate)
  return out


def differences(
  env: Any, rows: tuple[np.ndarray, ...]
) -> tuple[Bool[np.ndarray, "lanes steps"], Float[np.ndarray, "lanes steps"]]:
  """In which steps each lane differs from the last one, and how much: root mean square over
  channels in their typical deviations, or of the reward alone.
  """
  obs, reward, terminated = rows
  bits = np.ascontiguousarray(obs, np.float32).view(np.uint32)
  paid = np.abs(reward - reward[-1]) > REWARD_ROUNDING * (1.0 + np.abs(reward[-1]))
  differs = (bits != bits[-1]).any(-1) | paid | (terminated != terminated[-1])
  scale = np.asarray([v.scale for v in env.spec.obs])
  size = np.sqrt(np.mean(((obs - obs[-1]) / scale) ** 2, -1))
  return differs, np.where(size == 0, np.abs(reward - reward[-1]), size)


def monotone(
  chosen: list[Lane],
  differs: Bool[np.ndarray, "lanes steps"],
  size: Float[np.ndarray, "lanes steps"],
  i: int,
) -> bool | None:
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
    none, sought = c.fault == "none", c.severity > 0
    wrong = {
      f"{c.robot}: with all faults at severity 0 it is not the robot without faults "
      f"(relative difference {c.diff_1 or 0.0:.1e})": none and not c.identical,
      f"{who} is not the nominal robot bit for bit (step {c.first_step} from the onset)": not (
        none or sought or c.identical
      ),
      f"{who} makes observations or rewards that are no numbers": not c.finite,
      f"{who} changes nothing": sought and c.identical,
      f"{who} changes something before the onset": c.early,
      f"{who}: its difference falls with severity, and no reason is given": c.severity == 1
      and c.monotone is False
      and not c.reason,
    }
    out += [text for text, holds in wrong.items() if holds]
  return out
