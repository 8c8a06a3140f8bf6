"""Detection on a log of one's own: thresholds from a nominal CSV file, alarms in another. `mjx-cl
detect` is the command.

The nominal log is the past of the log that is judged: every detector lives through all of it, warms
up on its first third (1,000 samples at most), and goes on from there into the log with all that it
has learnt. Each column is watched by a detector of its own, and the alarm of any counts; detectors
of several channels watch all columns together. Samples are handed on in nominal deviations, (x -
mean) / std of the nominal log, so that no unit matters to a detector.
"""

from __future__ import annotations

import inspect
import pathlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_cl.detectors import DETECTORS, Alarm, Detector, python_class, rolling_sigma
from mjx_cl.errors import FileError, UserError, choose
from mjx_cl.io import folders, tables
from mjx_cl.logs.read import Log, choose_columns, read
from mjx_cl.rollout.monitor import unknown
from mjx_cl.scoring import thresholds

if TYPE_CHECKING:
  from typing import BinaryIO

EXPECTED = 3  # nominal alarms below which the wanted ARL0 cannot be read off the nominal log
FEW = 50  # alarms below which a measured run length is marked
# of the way from the median to the highest nominal score, added to the latter where nothing can be
# calibrated
MARGIN = 0.25
LEVELS = 8  # thresholds tried side by side
SMOOTH = (
  100  # rows of the trailing mean of a detector over all columns, a quarter of the warm-up at most
)
CHUNK = 2048  # rows of one call of a program
FARTHEST = (
  1e6  # nominal deviations at which a sample is cut, so that no sum of squares overflows float32
)


# ---- detectors -----------------------------------------------------------------------------------


def _rolling(threshold: float, warmup: int) -> Detector:
  """`rolling_sigma` as the paper has it, its window as long as the warm-up."""
  return rolling_sigma(threshold=threshold, window=warmup, warmup=warmup)


def table() -> dict[str, Callable[..., Detector]]:
  """Detectors of one number per sample, those of DETECTORS that are marked so, and the paper's
  rule; and those of several channels, which watch all columns together.
  """
  found = {
    name: build
    for name, build in DETECTORS.items()
    if getattr(build, "takes", "") == "scalar"
    and not getattr(build, "reference", False)
    and "threshold" in inspect.signature(build).parameters
  }
  return (
    {"rolling_sigma_plain": _rolling}
    | found
    | {name: build for name, build in DETECTORS.items() if _joint(build)}
  )


def _joint(factory: Callable[..., Detector]) -> bool:
  """Whether a factory is told its channels: then one detector watches all columns."""
  return getattr(factory, "takes", "") == "residual" and {
    "channels",
    "log",
    "threshold",
    "warmup",
  } <= set(inspect.signature(factory).parameters)


def _together(
  factory: Callable[..., Detector], threshold: float | jax.Array, warmup: int, columns: int
) -> Detector:
  """A detector of several channels on a row of `columns` numbers; a row with a missing one is
  passed over.
  """
  names = tuple(f"variable_{k}" for k in range(columns))
  smooth = (
    {"smooth": max(1, min(SMOOTH, warmup // 4))}
    if "smooth" in inspect.signature(factory).parameters
    else {}
  )
  inner = factory(threshold=threshold, warmup=warmup, channels=names, log=False, **smooth)
  residual = jax.tree.map(lambda x: x[0], unknown((1,), columns))
  return Detector(
    inner.init,
    lambda state, x: inner.update(state, residual._replace(variables=x, valid=jnp.bool_(True))),
  )


class Program:
  """One detector over many columns and LEVELS thresholds at once, compiled once; thresholds, states
  and samples are its arguments.
  """

  def __init__(self, name: str, warmup: int, columns: int, chunk: int) -> None:
    factory: Callable[..., Detector] = choose("detector", name, table())  # type: ignore[assignment]
    parameters = inspect.signature(factory).parameters
    settings = {"warmup": warmup} if "warmup" in parameters else {}
    some = (
      1.0
      if parameters["threshold"].default is inspect.Parameter.empty
      else parameters["threshold"].default
    )
    joint = _joint(factory)
    build = (
      (lambda threshold: _together(factory, threshold, warmup, columns))
      if joint
      else lambda threshold: factory(threshold=threshold, **settings)
    )
    self.columns = 1 if joint else columns  # of its alarms
    self.start = jax.tree.map(
      lambda x: jnp.broadcast_to(x, (LEVELS, self.columns) + jnp.shape(x)), build(some).init()
    )
    self.chunk = chunk

    def single(threshold: jax.Array, state: Any, x: jax.Array) -> tuple[Any, Alarm]:
      known = jnp.isfinite(x)
      if joint:
        known = jnp.all(known)
      new, alarm = build(threshold).update(state, jnp.where(known, x, 0.0))
      return jax.tree.map(lambda a, b: jnp.where(known, a, b), new, state), Alarm(
        alarm.fired & known, jnp.where(known, alarm.score, jnp.nan)
      )

    def run(
      thresholds: jax.Array, states: Any, xs: jax.Array
    ) -> tuple[Any, tuple[jax.Array, jax.Array, jax.Array]]:
      every = jax.vmap(jax.vmap(single, (None, 0, 0)), (0, 0, None))

      def step(states: Any, x: jax.Array) -> tuple[Any, tuple[jax.Array, jax.Array, jax.Array]]:
        states, alarm = every(thresholds, states, x[None] if joint else x)
        return states, (alarm.fired.any(-1), alarm.fired[0], alarm.score[0])

      return jax.lax.scan(step, states, xs)

    self.run = jax.jit(run)

  def __call__(
    self, thresholds: np.ndarray | jax.Array, states: Any, xs: np.ndarray
  ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray]:
    """Over xs (T, C), in calls of equal shape; rows that fill up the last are missing samples,
    which change nothing.

    Returns:
      (states', alarms of any column bool (T, LEVELS), alarms bool (T, C) and scores (T, C) at the
      first threshold); C is 1 where one detector watches all.
    """
    thresholds, parts = jnp.asarray(thresholds, jnp.float32), []
    for begin in range(0, len(xs), self.chunk):
      part = xs[begin : begin + self.chunk]
      part = np.pad(part, ((0, self.chunk - len(part)), (0, 0)), constant_values=np.nan)
      states, out = self.run(thresholds, states, jnp.asarray(part, jnp.float32))
      parts.append(jax.tree.map(np.asarray, out))
    return states, *(np.concatenate(x)[: len(xs)] for x in zip(*parts))


def calibrate(
  program: Program, nominal: np.ndarray, begin: int, arl0: float
) -> tuple[float | None, bool]:
  """Threshold at which nominal alarms, counted with restarts from row `begin` on, come nearest to
  rows / ARL0.

  The number of alarms falls with the threshold only on the whole, so the search starts at the
  highest nominal score, below which there is an alarm at last, and refines the uppermost interval
  in which the wanted number is passed, LEVELS thresholds at a time.

  Args:
    nominal: (T, C), standardised.

  Returns:
    (threshold, True), or where fewer than EXPECTED alarms are wanted (highest nominal score +
    MARGIN x its distance from the median, False); (None, False) where no score is known before the
    log ends.
  """
  quiet = program(np.full(LEVELS, 1e30), program.start, nominal)[3][begin:]
  scores = quiet[np.isfinite(quiet)]
  if not len(scores):
    return None, False
  top, wanted = float(scores.max()), _counted(nominal, begin) / arl0
  if wanted < EXPECTED:
    return top + MARGIN * max(top - float(np.median(scores)), 1e-3), False
  count = lambda levels: program(levels, program.start, nominal)[1][begin:].sum(0)

  def finer(tried: dict[float, int]) -> np.ndarray | None:
    if min(abs(alarms - wanted) for alarms in tried.values()) <= 0.5:
      return None
    under, high = thresholds.passed({t: n for t, n in tried.items() if t < max(tried)}, wanted)
    return None if under == -np.inf else np.linspace(under, min(high, max(tried)), LEVELS + 2)[1:-1]

  levels = np.quantile(scores, [0, 0.25, 0.5, 0.75, 0.9, 0.97, 0.99, 1])
  tried = thresholds.refine(count, levels, finer, 6)  # 9^5 intervals between two quantiles
  return min(tried, key=lambda level: (abs(tried[level] - wanted), -level)), True


def _counted(nominal: np.ndarray, begin: int) -> int:
  """Nominal rows after the warm-up that hold a sample."""
  return int(np.isfinite(nominal[begin:]).any(1).sum())


# ---- detection -----------------------------------------------------------------------------------


class Detection(NamedTuple):
  """C is 1 in what a detector gives that watches all columns together.

  Attributes:
    summary: what detect.json holds. xs: float64 (T, C) the log, past: float64 (N, C) the nominal
      log, as read. fired: detector -> bool (T, C),
    scores: detector -> (T, C), before: detector -> nominal alarms of any column, bool (N,).
      seconds: float64 (T,) since the first sample, or None.
  """

  summary: dict
  xs: np.ndarray
  past: np.ndarray
  fired: dict[str, np.ndarray]
  scores: dict[str, np.ndarray]
  before: dict[str, np.ndarray]
  seconds: np.ndarray | None


def detect(
  path: pathlib.Path | str,
  nominal_path: pathlib.Path | str,
  columns: tuple[str, ...] = (),
  detectors: tuple[str, ...] = (),
  arl0: float = 10_000,
  rate: float | None = None,
  logarithm: bool = False,
  settings: dict | None = None,
  tell: Callable[[str], None] = lambda text: None,
) -> Detection:
  """Calibrates detectors on one CSV file and runs them on another.

  Args:
    columns: default: all columns of numbers that both files have, less clocks and those that are
      constant in the nominal log.
    detectors: of `table()`, default all of them; or host detectors, module:Class or file.py:Class,
      which bring a threshold of their own and see samples in the file's own units.
    arl0: wanted mean number of samples between false alarms, of all columns of one detector
      together.
    rate: samples per second, for times; default: from the column `time` or one of seconds,
      otherwise times are unknown. With a column `step`: steps per second.
    logarithm: watch ln max(x, 1e-9); for residuals, which are positive and skewed. A sample of 0 or
      less is refused.
    settings: of the host detectors.
  """
  if not (arl0 > 1 and np.isfinite(arl0)):
    raise UserError(f"arl0 must be a finite number above 1 sample; got {arl0}")
  if rate is not None and not 1e-9 <= rate <= 1e12:
    raise UserError(f"rate must lie in 1e-9..1e12 samples a second; got {rate}")
  names, every = list(dict.fromkeys(detectors)) or list(table()), not detectors
  if settings and not any(":" in name for name in names):
    raise UserError(
      "settings are for host detectors (module:Class, file.py:Class); the others are calibrated"
    )
  hosts = {name: python_class.load(name, settings) for name in names if ":" in name}
  for name in names:
    name in hosts or choose("detector", name, table())
  log, nominal = read(path), read(nominal_path)
  found, left = choose_columns(log, nominal, columns, path, nominal_path)
  xs, past = (np.stack([one.columns[c] for c in found], 1) for one in (log, nominal))
  if logarithm:
    xs, past = _logarithm(xs, found, path), _logarithm(past, found, nominal_path)
  with np.errstate(over="ignore", invalid="ignore"):
    middle, spread = np.nanmean(past, 0), np.nanstd(past, 0)
  if not np.isfinite(spread).all():
    raise FileError(
      f"{nominal_path}: column {found[int(np.argmin(np.isfinite(spread)))]} holds numbers too "
      "large to be computed with"
    )
  if not (spread > 0).all():
    raise FileError(
      (
        f"{nominal_path}: column {found[int(np.argmin(spread))]} varies too little to be told "
        "from a constant"
      )
      + (" once its logarithm is taken" if logarithm else "")
    )
  standard = [np.clip((x - middle) / spread, -FARTHEST, FARTHEST) for x in (xs, past)]
  warmup = min(1000, len(past) // 3)
  together = [name for name in names if name not in hosts and _joint(table()[name])]
  if together and not 2 <= len(found) <= warmup - 2:
    if not every:
      raise UserError(
        f"detector {together[0]!r} watches all columns together: it needs two columns or more, "
        f"and a nominal log of {3 * (len(found) + 2)} rows; "
        f"there are {len(found)} columns and {len(past)} rows"
      )
    names = [name for name in names if name not in together]
  seconds, rate = _clock(log, rate, len(xs))
  rows, fired, scores, before = [], {}, {}, {}
  for k, name in enumerate(names):
    tell(f"{k + 1}/{len(names)} {name}")
    run = (
      _host(hosts[name], xs, past) if name in hosts else _registered(name, *standard, warmup, arl0)  # type: ignore[call-arg]
    )
    threshold, calibrated, before[name], fired[name], scores[name] = run
    rows.append(
      _row(name, threshold, calibrated, before[name][warmup:], fired[name], found, seconds)
    )
  counted = _counted(past, warmup)
  summary = {
    "log": str(path),
    "nominal": str(nominal_path),
    "columns": found,
    "ignored": sorted({*log.ignored, *nominal.ignored}),
    "samples": len(xs),
    "nominal_samples": len(past),
    "missing": int(np.isnan(xs).sum()),
    "nominal_missing": int(np.isnan(past).sum()),
    "warmup": warmup,
    "counted": counted,
    "arl0": arl0,
    "rate_hz": rate,
    "logarithm": logarithm,
    "detectors": rows,
    "notes": [*dict.fromkeys(nominal.notes + log.notes), *left, *_notes(rows, counted, arl0)],
  }
  return Detection(summary, xs, past, fired, scores, before, seconds)


def _logarithm(x: np.ndarray, names: list[str], path: pathlib.Path | str) -> np.ndarray:
  """Ln max(x, 1e-9) of x (T, C); nan stays, anything else that is not positive is refused."""
  for name, column in zip(names, x.T):
    if (column <= 0).any():
      raise FileError(
        f"{path}: column {name} has samples without a logarithm, the smallest is "
        f"{np.nanmin(column):g}; "
        "name the others by --column, or leave out --logarithm"
      )
  return np.log(np.maximum(x, 1e-9))


def _clock(log: Log, rate: float | None, samples: int) -> tuple[np.ndarray | None, float | None]:
  """Seconds since the first sample, and samples per second."""
  if log.time is not None and rate is None and samples > 1:
    return log.time - log.time[0], float(1 / np.median(np.diff(log.time)))
  at = np.arange(samples, dtype=float) if log.step is None else log.step - log.step[0]
  return (None if rate is None else at / rate), rate


def _registered(
  name: str, xs: np.ndarray, past: np.ndarray, warmup: int, arl0: float
) -> tuple[float | None, bool, np.ndarray, np.ndarray, np.ndarray]:
  """(threshold, calibrated, nominal alarms (N,), alarms (T, C), scores (T, C)); what goes wrong
  inside a detector, which may be anybody's, becomes one line that names it.
  """
  try:
    return _examined(name, xs, past, warmup, arl0)
  except UserError:
    raise
  except jax.errors.ConcretizationTypeError:
    raise UserError(
      f"detector {name!r} cannot be calibrated here: its factory asks for a threshold that is "
      "a number; "
      "use base.above to check it"
    ) from None
  except (Exception, SystemExit) as e:
    raise UserError(
      f"detector {name!r} failed: {type(e).__name__}: "
      f"{(str(e).strip() or 'without a message').splitlines()[0]}"
    ) from e


def _examined(
  name: str, xs: np.ndarray, past: np.ndarray, warmup: int, arl0: float
) -> tuple[float | None, bool, np.ndarray, np.ndarray, np.ndarray]:
  """`_registered`, as it goes."""
  program = Program(name, warmup, xs.shape[1], min(CHUNK, len(past)))
  threshold, calibrated = calibrate(program, past, warmup, arl0)
  if threshold is None:
    return (
      None,
      False,
      np.zeros(len(past), bool),
      np.zeros((len(xs), program.columns), bool),
      np.full((len(xs), program.columns), np.nan),
    )
  levels = np.full(LEVELS, threshold)
  states, _, before, _ = program(levels, program.start, past)
  _, _, fired, scores = program(levels, states, xs)
  return threshold, calibrated, before.any(1), fired, scores  # type: ignore[return-value]


def _host(
  one: python_class.HostDetector, xs: np.ndarray, past: np.ndarray
) -> tuple[None, None, np.ndarray, np.ndarray, np.ndarray]:
  """As `_registered`, of a detector that brings its own threshold."""
  fired, scores = python_class.run_host(one.factory, np.concatenate([past, xs]), one.host_name)
  return None, None, fired[: len(past)].any(1), fired[len(past) :], scores[len(past) :]  # type: ignore[return-value]


def _row(
  name: str,
  threshold: float | None,
  calibrated: bool | None,
  before: np.ndarray,
  fired: np.ndarray,
  columns: list[str],
  seconds: np.ndarray | None,
) -> dict[str, Any]:
  at, count = np.flatnonzero(fired.any(1)), int(before.sum())
  first = int(at[0]) if len(at) else None
  return {
    "detector": name,
    "threshold": threshold,
    "calibrated": calibrated,
    "nominal_alarms": count,
    "few": count < FEW,
    "first_alarm": first,
    "first_alarm_s": None if first is None or seconds is None else float(seconds[first]),
    "alarms": len(at),
    "columns": [
      c
      for c, some in zip(columns if fired.shape[1] == len(columns) else [ALL], fired.any(0))  # type: ignore[arg-type]
      if some
    ],
  }


def _notes(rows: list[dict], counted: int, arl0: float) -> list[str]:
  """What a reader must know, one line each."""
  notes = []
  unsure = [r for r in rows if r["calibrated"] is False and r["threshold"] is not None]
  if unsure:
    silent = not any(
      r["nominal_alarms"] for r in unsure
    )  # an infinite score fires whatever the threshold
    notes.append(
      f"the nominal log is too short for an ARL0 of {arl0:g}: {counted:,} samples after the "
      f"warm-up, {EXPECTED * arl0:,.0f} are needed; "
      "thresholds are the highest nominal score and a margin, and the ARL0 is unknown"
      + (
        f" (no alarm in {counted:,} samples: above {counted / 3:,.0f} with 95 % confidence)"
        if silent
        else ""
      )
    )
  blind = [r["detector"] for r in rows if r["calibrated"] is False and r["threshold"] is None]
  if blind:
    notes.append(
      "the nominal log ends before these detectors know a score, so they watched nothing: "
      f"{', '.join(blind)}"
    )
  return notes


# ---- results -------------------------------------------------------------------------------------

ALL = "(all)"  # in the place of a column: one detector watches all
FILES = ("detect.json", "alarms.csv", "detect.png")


def claim(out: pathlib.Path | str, overwrite: bool) -> pathlib.Path:
  """Makes the folder of the results; an earlier detection in it is refused unless `overwrite`."""
  out = pathlib.Path(out)
  if out.exists() and not out.is_dir():
    raise UserError(f"--out {out} is a file")
  there = [name for name in FILES if (out / name).exists()]
  if there and not overwrite:
    raise UserError(
      f"{out} holds {', '.join(there)} of an earlier detection; give --overwrite to replace "
      "it, or another --out"
    )
  try:
    out.mkdir(parents=True, exist_ok=True)
  except OSError as e:
    raise FileError(f"cannot make {out}: {e.strerror}") from None
  return out


def write(result: Detection, out: pathlib.Path | str) -> None:
  """Writes detect.json, alarms.csv (one line per detector, column and alarm) and detect.png into
  folder `out`.
  """
  out, names = pathlib.Path(out), result.summary["columns"]
  lines = ["detector,column,sample,seconds,score"]
  for detector, fired in result.fired.items():
    own = names if fired.shape[1] == len(names) else [ALL]
    for t, c in np.argwhere(fired):
      score = result.scores[detector][t, c]
      lines.append(
        ",".join(
          (
            _quoted(detector),
            _quoted(own[c]),
            str(t),
            "" if result.seconds is None else f"{result.seconds[t]:.9g}",
            f"{score:.9g}" if np.isfinite(score) else "",
          )
        )
      )
  folders.atomic(out / "alarms.csv", lambda file: file.write(("\n".join(lines) + "\n").encode()))
  folders.atomic(out / "detect.png", lambda file: figure(result, file))
  tables.write_json(out / "detect.json", result.summary)


def _quoted(cell: str) -> str:
  return '"' + cell.replace('"', '""') + '"' if set(cell) & set(',"\r\n') else cell


def figure(result: Detection, file: pathlib.Path | str | BinaryIO, panels: int = 8) -> None:
  """Draws the columns, before sample 0 the end of the nominal log in grey, and beneath them each
  detector's alarms as marks.

  Args:
    file: path or binary file. panels: columns that are drawn, those with alarms first.
  """
  import matplotlib

  matplotlib.use("Agg")
  import matplotlib.pyplot as plt

  names, (steps, _) = result.summary["columns"], result.xs.shape
  hits = sum(fired.sum(0) for fired in result.fired.values())
  shown = sorted(sorted(range(len(names)), key=lambda c: -hits[c])[:panels])
  height = [1.5] * len(shown) + [0.35 + 0.22 * len(result.fired)]
  fig, axes = plt.subplots(
    len(height),
    1,
    figsize=(10, sum(height) + 1.0),
    sharex=True,
    constrained_layout=True,
    gridspec_kw={"height_ratios": height},
  )
  for axis, c in zip(axes, shown):
    axis.plot(*_envelope(result.past[:, c], -len(result.past)), color="0.6", lw=0.7)
    axis.plot(*_envelope(result.xs[:, c], 0), color="#1f5fa8", lw=0.7)
    axis.set_ylabel(f"ln {names[c]}" if result.summary["logarithm"] else names[c], fontsize=8)
    axis.tick_params(labelsize=8)
  for k, (name, fired) in enumerate(result.fired.items()):
    at = np.flatnonzero(fired.any(1))
    early = np.flatnonzero(result.before[name]) - len(result.past)
    axes[-1].plot(early, np.full(len(early), k), "|", color="0.6", ms=8, mew=1.2)
    axes[-1].plot(at, np.full(len(at), k), "|", color="#c4472b", ms=8, mew=1.2)
  unsure = {r["detector"] for r in result.summary["detectors"] if r["calibrated"] is False}
  axes[-1].set_yticks(
    range(len(result.fired)),
    [name + (" *" if name in unsure else "") for name in result.fired],
    fontsize=8,
  )
  axes[-1].set_ylim(len(result.fired) - 0.5, -0.5)
  axes[-1].grid(axis="y", lw=0.4, color="0.85")
  axes[-1].set_xlabel(
    _axis(result) + ("; * threshold not calibrated" if unsure else ""), fontsize=9
  )
  for axis in axes:
    axis.axvline(0, color="k", lw=0.8)
    axis.set_xlim(
      -min(len(result.past), steps), steps
    )  # the log that is judged keeps half of the width at least
  hidden = f"; {len(names) - len(shown)} more columns watched" if len(names) > len(shown) else ""
  axes[0].set_title(
    f"{pathlib.Path(result.summary['log']).name}: alarms per detector (marks); nominal log in "
    f"grey{hidden}",
    fontsize=10,
  )
  fig.savefig(file, dpi=130, format="png")
  plt.close(fig)


def _axis(result: Detection) -> str:
  rate = result.summary["rate_hz"]
  return "sample" if rate is None else f"sample ({1 / rate:.4g} s)"


def _envelope(x: np.ndarray, begin: int, bins: int = 2000) -> tuple[np.ndarray, np.ndarray]:
  """X against its sample number; a long stream as the lowest and highest sample of each bin, so
  that no spike is lost.
  """
  at = begin + np.arange(len(x))
  if len(x) <= 2 * bins:
    return at, x
  width = -(-len(x) // bins)
  full = np.pad(x, (0, -len(x) % width), constant_values=np.nan).reshape(-1, width)
  low, high = (
    np.where(np.isnan(full), np.inf, full).min(1),
    np.where(np.isnan(full), -np.inf, full).max(1),
  )
  both = np.stack([low, high], 1).ravel()
  return np.repeat(begin + width * np.arange(len(full)), 2), np.where(np.isinf(both), np.nan, both)
