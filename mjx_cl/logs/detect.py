"""Detection on a log of one's own: thresholds from a nominal CSV file, alarms in another. `mjx-cl
detect` is the command.

The nominal log is the past of the log that is judged: every detector lives through all of it, warms
up on its first third (1,000 samples at most), and goes on from there into the log with all that it
has learnt. Each column is watched by a detector of its own, and the alarm of any counts; detectors
of several channels watch all columns together. Samples are handed on in nominal deviations, (x -
mean) / std of the nominal log, so that no unit matters to a detector.
"""

import pathlib
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from mjx_cl.detectors import python_class
from mjx_cl.errors import FileError, PluginError, UserError, choose
from mjx_cl.io import plugins
from mjx_cl.logs import charts, clocks, gaps, healthy, verdict
from mjx_cl.logs import inject as injection
from mjx_cl.logs.columns import choose_columns
from mjx_cl.logs.programs import LEVELS, Program, joint, table
from mjx_cl.logs.read import Log, read
from mjx_cl.logs.results import ALL, Detection, watched
from mjx_cl.logs.verdict import Times, Watch
from mjx_cl.scoring import thresholds

EXPECTED = 3  # nominal alarms below which the wanted ARL0 cannot be read off the nominal log
FEW = 50  # alarms below which a measured run length is marked
# of the way from the median to the highest nominal score, added to the latter where nothing can be
# calibrated
MARGIN = 0.25
CHUNK = 2048  # rows of one call of a program
MANY = 8  # columns that a line names
SAME = 1.2  # ratio of two rates above which they are not the same
# nominal deviations at which a sample is cut, so that no sum of squares overflows float32
FARTHEST = 1e6


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
  model: str = "ar",
  refractory: float | None = None,
  inject: float | None = None,
  commands: tuple[str, ...] = (),
) -> Detection:
  """Calibrates detectors on one CSV file and runs them on another.

  Without `detectors` it is the three charts of `charts` on what deviates from a model of the
  nominal log, and a verdict on what they say.

  Args:
    path: of the log that is judged.
    nominal_path: of the nominal log.
    columns: default: all of numbers that both files have, less clocks and nominal constants.
    detectors: of `table()`, "all" of them; or host detectors, module:Class or file.py:Class, which
      bring a threshold of their own and see samples in the file's own units.
    arl0: wanted mean number of samples between false alarms, all columns of a detector together.
    rate: samples per second, for times; default: from the clocks of the logs, which must agree,
      otherwise times are unknown. With a column `step`: steps per second.
    logarithm: watch ln max(x, 1e-9), for positive and skewed residuals; x <= 0 is refused.
    settings: of the host detectors.
    tell: is told which detector comes next.
    model: of the nominal log, see `healthy.fit`; of the charts.
    refractory: alarms of the charts closer than this are one event [s], in samples where there is
      no clock; default 10 s or 500 samples.
    inject: put faults into the nominal log, and say which are seen within so long, as refractory.
    commands: columns that explain others in the model and are not watched.
  """
  names = list(dict.fromkeys(detectors))
  names = [*table(), *(n for n in names if n != "all")] if "all" in names else names
  names = list(dict.fromkeys(names))
  hosts = _hosts(arl0, rate, names, settings)
  alone = {"inject": inject, "refractory": refractory, "model": None if model == "ar" else model}
  if names and (idle := [f"--{name}" for name, value in alone.items() if value is not None]):
    raise UserError(f"{', '.join(idle)}: of the charts; leave it out beside --detector")
  log, nominal = read(path), read(nominal_path)
  if commands and (names or model == "none"):
    raise UserError(
      "commands explain others in the model alone: leave out --detector and --model none"
    )
  dead = [
    name
    for name, x in log.columns.items()
    if np.isnan(x).all() and np.isfinite(nominal.columns.get(name, x)).any()
  ]
  found, left = choose_columns(log, nominal, columns, path, nominal_path)
  if commands:
    told, _ = choose_columns(log, nominal, commands, path, nominal_path)
    if twice := [name for name in columns if name in told]:
      raise UserError(f"column {twice[0]} is watched or a command, not both")
    found = [name for name in found if name not in told]
    if not found:
      raise UserError(f"all columns are commands; name fewer of: {', '.join(told)}")
    found += told
  xs, past = (
    _samples(log, found, path, logarithm),
    _samples(nominal, found, nominal_path, logarithm),
  )
  middle, spread = _spread(past, found, nominal_path, logarithm)
  warmup = min(1000, len(past) // 3)
  names = _able(names, len(found), len(past), warmup, "all" not in detectors)
  given = rate is not None
  if not given:
    _same_rate(log, nominal, path, nominal_path)
  seconds, rate = _clock(log, rate, len(xs))
  if not names:
    settling = max(*healthy.NOW, *healthy.BEFORE)
    if len(xs) <= settling:
      raise FileError(f"{path}: {len(xs)} rows; judged are those after the first {settling}")
    own = found[: len(found) - len(set(commands))]
    times = Times(seconds, rate, None if given else gaps.places(log.time))
    places = None if given else gaps.places(nominal.time)
    judged = _judged(xs, past, own, times, places, arl0, model, refractory, inject, tell)
    judged.summary["unjudged"] |= {name: "no samples" for name in dead if name not in found}
    notes = [*dict.fromkeys(nominal.notes + log.notes), *left, *judged.summary["notes"]]
    judged.summary.update(
      log=str(path), nominal=str(nominal_path), columns=own, logarithm=logarithm, notes=notes,
      ignored=sorted({*log.ignored, *nominal.ignored}), commands=found[len(own):],
    )  # fmt: skip
    return judged
  now, before_it = (
    np.clip((x - middle) / spread, -FARTHEST, FARTHEST, dtype=np.float64) for x in (xs, past)
  )
  rows, fired, scores, before = [], {}, {}, {}
  for k, name in enumerate(names):
    tell(f"{k + 1}/{len(names)} {name}")
    run = _host(hosts[name], xs, past) if name in hosts else None
    run = run or _registered(name, now, before_it, warmup, arl0)
    *_, before[name], fired[name], scores[name] = run
    rows.append(_row(run, name, warmup, found, seconds))
  sizes = _sizes(xs, past, warmup)
  notes = _notes(rows, sizes["counted"], arl0)
  summary = {
    "log": str(path),
    "nominal": str(nominal_path),
    "columns": found,
    "ignored": sorted({*log.ignored, *nominal.ignored}),
    **sizes,
    "arl0": arl0,
    "rate_hz": rate,
    "logarithm": logarithm,
    "detectors": rows,
    "notes": [*dict.fromkeys(nominal.notes + log.notes), *left, *notes],
  }
  return Detection(summary, xs, past, fired, scores, before, seconds)


def _judged(
  xs: np.ndarray,
  past: np.ndarray,
  names: list[str],
  times: Times,
  past_places: np.ndarray | None,
  arl0: float,
  model: str,
  refractory: float | None,
  inject: float | None,
  tell: Callable[[str], None],
) -> Detection:
  """What the charts say of a log (T, C) whose columns beyond `names` are commands."""
  for what, value in (("refractory", refractory), ("inject", inject)):
    if value is not None and not 0 < value <= 1e9:
      raise UserError(f"{what} must lie in 0..1e9 seconds (or samples); got {value}")
  choose("model", model, dict.fromkeys(healthy.MODELS))
  tell("model of the nominal log")
  past, wild = healthy.plausible(past)
  even, even_past = gaps.evened(xs, times.places), gaps.evened(past, past_places)
  used, at = healthy.thinned(even_past)
  own = verdict.calibrated(used, arl0, model, past.shape[1] - len(names))
  found, lost = verdict.watch(own, even), gaps.silent(even, own.model.held)
  default = times.samples(10.0, 500) if times.rate else 500
  pause = times.samples(refractory, default)
  scores = charts.scores(own.unseen, own.scales)
  before = {}
  for k, score in scores.items():
    before[k] = np.zeros(len(even_past), bool)
    before[k][at[charts.alarms(score, own.thresholds[k]).any(1) & (at >= 0)]] = True
    before[k] = before[k] if past_places is None else before[k][past_places]
  events = []
  if lost.columns.any():
    found, other, seen, keep = gaps.without(own, found, used, even, lost, arl0, model)
    if other is not None and seen is not None:
      left = [name for name, there in zip(names, keep) if there]
      events = verdict.judge(other, seen, left, pause)
  events = verdict.together(verdict.judge(own, found, names, pause), events, pause)
  found, rows = gaps.taken(found, times.places), []
  for name in charts.CHARTS:
    run: Run = None, True, before[name], found.fired[name], found.scores[name]
    row = _row(run, name, 0, names, times.seconds)
    labels = names if found.scores[name].shape[1] == len(names) else [ALL]
    rows.append(row | {"thresholds": dict(zip(labels, own.thresholds[name].tolist()))})
  said = verdict.summary(own, events, names, times, arl0)
  silent = gaps.told(lost, names, times.seconds, times.places, len(even))
  unjudged = gaps.unjudged(found.known, names, silent)
  said |= {"silent": silent, "ended": gaps.ended(lost, names, len(even))}
  said |= {"unjudged": unjudged, "refractory": pause}
  said |= {"arl0": arl0, "rate_hz": times.rate, "detectors": rows}
  notes = [
    f"{name}: nominal samples beyond {healthy.WILD:g} of its deviations are taken as missing: {n}"
    for name, n in zip(names, wild)
    if n
  ]
  notes += _said_of(own, names, found.known, len(used), arl0, silent, unjudged)
  said |= {**_sizes(xs, past, 0), "notes": notes}
  if len(used) < len(past):
    said["notes"].append(
      f"of the {len(past):,} nominal samples {int((at >= 0).sum()):,} are used, in {healthy.FOLDS} "
      "stretches"
    )
  if inject is not None:
    within = times.samples(inject, 1)
    tell("faults put into the nominal log")
    found_faults, places = injection.smallest(
      own, healthy.completed(own.model, used), names, within, healthy.since(own.model, used)
    )
    said["inject"] = {"within": within, "places": places, "faults": found_faults}
    if not places:
      said["notes"].append(
        f"no fault could be put into the nominal log: {healthy.FOLDS} stretches of "
        f"{injection.BEFORE + within} samples without an alarm are needed"
      )
  shown, own_past = (x[:, : len(names)] for x in (xs, past))
  return Detection(said, shown, own_past, found.fired, found.scores, before, times.seconds)


def _said_of(
  own: Watch,
  names: list[str],
  known: np.ndarray,
  rows: int,
  arl0: float,
  silent: dict[str, str],
  unjudged: dict[str, str],
) -> list[str]:
  """What a reader must know of the model, one line each."""
  notes = []
  if drifts := [name for name, yes in zip(names, own.model.drifts) if yes]:
    notes.append(
      f"{', '.join(drifts)}: drifting while healthy, so only changes quicker than "
      f"{own.model.slow} samples are seen there, and only large ones in a log's first rows"
    )
  notes += [
    f"{name} has {why}; there the other columns are judged without it"
    for name, why in silent.items()
    if name not in unjudged
  ]
  blind = {name: int(n) for name, n in zip(names, (~known).sum(0)) if n}
  most = sorted(set(blind) - {*silent, *unjudged}, key=lambda name: -blind[name])
  if most:
    rest = f" and {len(most) - MANY} more columns" if len(most) > MANY else ""
    notes.append(
      f"not judged of {len(known):,} samples, as they or too many that foretell them are missing: "
      + ", ".join(f"{name} {blind[name]:,}" for name in most[:MANY])
      + rest
    )
  if unused := charts.SPANS[charts.used(rows) :]:
    notes.append(
      f"{rows:,} nominal samples are few: averages over {' and '.join(map(str, unused))} samples "
      "are not watched, so slow and small changes are not seen; "
      f"{charts.LEAST_BLOCKS * unused[-1]:,} would do"
    )
  if rows < arl0 * len(names):
    notes.append(
      f"thresholds lie above what {rows:,} nominal samples can show: they follow from the tail of "
      "their highest scores"
    )
  return notes


def _sizes(xs: np.ndarray, past: np.ndarray, warmup: int) -> dict[str, int]:
  """How many samples there are, are missing and count."""
  return {
    "samples": len(xs),
    "nominal_samples": len(past),
    "missing": int(np.isnan(xs).sum()),
    "nominal_missing": int(np.isnan(past).sum()),
    "warmup": warmup,
    "counted": _counted(past, warmup),
  }


def _hosts(
  arl0: float, rate: float | None, names: list[str], settings: dict | None
) -> dict[str, python_class.HostDetector]:
  """The host detectors among `names`; refuses what cannot be asked for."""
  if not (arl0 > 1 and np.isfinite(arl0)):
    raise UserError(f"arl0 must be a finite number above 1 sample; got {arl0}")
  if rate is not None and not 1e-9 <= rate <= 1e12:
    raise UserError(f"rate must lie in 1e-9..1e12 samples a second; got {rate}")
  if settings and not any(":" in name for name in names):
    raise UserError(
      "settings are for host detectors (module:Class, file.py:Class); the others are calibrated"
    )
  hosts = {name: python_class.load(name, settings) for name in names if ":" in name}
  for name in names:
    if name not in hosts:
      choose("detector", name, table())
  return hosts


def _spread(
  past: np.ndarray, names: list[str], path: pathlib.Path | str, logarithm: bool
) -> tuple[np.ndarray, np.ndarray]:
  """Mean and deviation (C,) of the nominal log, refused where nothing can be calibrated."""
  with np.errstate(over="ignore", invalid="ignore"):
    middle = np.array([np.nanmean(x, dtype=np.float64) for x in past.T])
    spread = np.array([np.nanstd(x, dtype=np.float64) for x in past.T])
  if not np.isfinite(spread).all():
    raise FileError(
      f"{path}: column {names[int(np.argmin(np.isfinite(spread)))]} holds numbers too large to be "
      "computed with"
    )
  if not (spread > 0).all():
    raise FileError(
      f"{path}: column {names[int(np.argmin(spread))]} varies too little to be told from a constant"
      + (" once its logarithm is taken" if logarithm else "")
    )
  return middle, spread


def _able(names: list[str], columns: int, rows: int, warmup: int, asked: bool) -> list[str]:
  """`names`, where the logs do not allow it without those that watch all columns together; refused
  where one was asked for.
  """
  if 2 <= columns <= warmup - 2:
    return names
  several = [name for name in names if ":" not in name and joint(table()[name])]
  if several and asked:
    raise UserError(
      f"detector {several[0]!r} watches all columns together: it needs two columns or more, and a "
      f"nominal log of {3 * (columns + 2)} rows; there are {columns} columns and {rows} rows"
    )
  return [name for name in names if name not in several]


def _samples(log: Log, names: list[str], path: pathlib.Path | str, logarithm: bool) -> np.ndarray:
  """Columns (T, C) of a log, or ln max(x, 1e-9) of them; nan stays, anything else that is not
  positive has no logarithm and is refused. The log's own are given up one by one, so that no file
  is held twice.
  """
  rows = len(log.columns[names[0]])
  kind = np.result_type(*(log.columns[name] for name in names))
  if rows * len(names) > verdict.LARGE and all(_short(log.columns[name]) for name in names):
    kind = np.dtype(np.float32)
  x = np.empty((rows, len(names)), kind, order="F")
  for k, name in enumerate(names):
    x[:, k] = log.columns.pop(name)
  for name, column in zip(names if logarithm else (), x.T):
    if (column <= 0).any():
      raise FileError(
        f"{path}: column {name} has samples without a logarithm, the smallest is "
        f"{np.nanmin(column):g}; name the others by --column, or leave out --logarithm"
      )
  return np.log(np.maximum(x, 1e-9)) if logarithm else x


def _short(x: np.ndarray) -> bool:
  """Whether float32 rounds a column by less than a thousandth of its deviation."""
  highest = max(abs(float(np.nanmin(x))), abs(float(np.nanmax(x))))
  return highest * 2.0**-24 <= 1e-3 * float(np.nanstd(x[::97], dtype=np.float64))


def _same_rate(
  log: Log, nominal: Log, path: pathlib.Path | str, nominal_path: pathlib.Path | str
) -> None:
  """Refuses logs whose clocks tell that one has SAME times as many rows per second as the other."""
  if log.time is None or nominal.time is None:
    return
  now, past = clocks.rate(log.time), clocks.rate(nominal.time)
  if now is None or past is None:
    return
  if all(not 1 / SAME < a / b < SAME for a, b in zip(now, past)):
    slow, fast = sorted((now[0], past[0]))
    times = round(fast / slow)
    dense = path if now[0] > past[0] else nominal_path
    remedy = (
      f"keep one row of {times} of {dense}"
      if times > 1 and abs(fast / slow - times) < 0.05 * times
      else "bring both to one rate"
    )
    raise FileError(
      f"{path} has {now[0]:,.4g} rows a second and {nominal_path} {past[0]:,.4g}: {remedy}, or "
      "give --rate to compare them row by row all the same"
    )


def _clock(log: Log, rate: float | None, samples: int) -> tuple[np.ndarray | None, float | None]:
  """Seconds since the first sample, and samples per second."""
  if log.time is not None and rate is None and samples > 1:
    seconds = log.time - log.time[0]
    usual = float(np.median(np.diff(seconds))) or float(seconds[-1] / (samples - 1))
    return seconds, 1 / usual
  at = np.arange(samples, dtype=float) if log.step is None else log.step - log.step[0]
  return (None if rate is None else at / rate), rate


Run = tuple[float | None, bool | None, np.ndarray, np.ndarray, np.ndarray]


def _registered(name: str, xs: np.ndarray, past: np.ndarray, warmup: int, arl0: float) -> Run:
  """(threshold, calibrated, nominal alarms (N,), alarms (T, C), scores (T, C)); what goes wrong
  inside a detector, which may be anybody's, becomes one line that names it.
  """
  try:
    return _examined(name, xs, past, warmup, arl0)
  except UserError:
    raise
  except jax.errors.ConcretizationTypeError:
    raise UserError(
      f"detector {name!r} cannot be calibrated here: its factory asks for a threshold that is a "
      "number; use base.above to check it"
    ) from None
  except BaseException as e:
    if plugins.of_user(e):
      raise
    raise PluginError(f"detector {name!r} failed: {plugins.line(e, 1)}") from e


def _examined(name: str, xs: np.ndarray, past: np.ndarray, warmup: int, arl0: float) -> Run:
  """`_registered`, as it goes."""
  program = Program(name, warmup, xs.shape[1], min(CHUNK, len(past)))
  threshold, calibrated = calibrate(program, past, warmup, arl0)
  if threshold is None:
    shape = len(xs), program.columns
    return None, False, np.zeros(len(past), bool), np.zeros(shape, bool), np.full(shape, np.nan)
  levels = np.full(LEVELS, threshold)
  states, _, before, _ = program(levels, program.start, past)
  _, _, fired, scores = program(levels, states, xs)
  return threshold, calibrated, np.asarray(before.any(1)), fired, scores


def _host(one: python_class.HostDetector, xs: np.ndarray, past: np.ndarray) -> Run:
  """As `_registered`, of a detector that brings its own threshold."""
  fired, scores, _ = python_class.run(one, np.concatenate([past, xs]))
  return None, None, np.asarray(fired[: len(past)].any(1)), fired[len(past) :], scores[len(past) :]


def _row(
  run: Run, name: str, warmup: int, columns: list[str], seconds: np.ndarray | None
) -> dict[str, Any]:
  threshold, calibrated, before, fired, _ = run
  at, count = np.flatnonzero(fired.any(1)), int(before[warmup:].sum())
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
    "columns": [c for c, own in zip(watched(fired, columns), fired.T) if own.any()],
  }


def _notes(rows: list[dict], counted: int, arl0: float) -> list[str]:
  """What a reader must know, one line each."""
  notes = []
  unsure = [r for r in rows if r["calibrated"] is False and r["threshold"] is not None]
  if unsure:
    # an infinite score fires whatever the threshold
    silent = not any(r["nominal_alarms"] for r in unsure)
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
