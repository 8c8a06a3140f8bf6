"""Which columns of a log can be watched."""

import difflib
import pathlib

import numpy as np

from mjx_cl.errors import FileError, UserError
from mjx_cl.logs.clocks import called_clock
from mjx_cl.logs.read import Log

LEAST = 100  # finite nominal samples that a column needs


def _rises(x: np.ndarray, least: int = LEAST) -> bool:
  """Whether the known samples, `least` or more, rise one after the other."""
  known = x[np.isfinite(x)]
  return len(known) >= least and bool((np.diff(known) > 0).all())


def _evenly(x: np.ndarray) -> bool:
  """Whether 95 % of the increments per row lie within half of their median; a clock that is written
  with few digits has uneven ones.
  """
  at = np.flatnonzero(np.isfinite(x))
  steps = np.diff(x[at]) / np.diff(at)
  return (
    not len(steps)
    or float(np.mean(np.abs(steps - np.median(steps)) <= 0.501 * np.median(steps))) >= 0.95
  )


def _clocks(log: Log, nominal: Log) -> list[str]:
  """Columns that tell when and not what: `time` and `step`, by their name if they rise in a log
  that holds them, by what they hold if they rise evenly in both.
  """
  found = [*log.clocks, *nominal.clocks]
  for name in {**log.columns, **nominal.columns}:
    there = [one.columns[name] for one in (nominal, log) if name in one.columns]
    called = any(called_clock(one.labels[name]) for one in (log, nominal) if name in one.labels)
    if (
      called
      and any(map(_rises, there))
      or len(there) == 2
      and _rises(there[0])
      and _rises(there[1], 0)
      and all(map(_evenly, there))
    ):
      found.append(name)
  return list(dict.fromkeys(found))


def choose_columns(
  log: Log,
  nominal: Log,
  names: tuple[str, ...],
  path: pathlib.Path | str,
  nominal_path: pathlib.Path | str,
) -> tuple[list[str], list[str]]:
  """Columns that are watched, and notes on those that are not: those named, or all that both files
  hold as numbers, less clocks and what is unfit.

  Raises:
    FileError or UserError where a column that is named cannot be watched, or none is left.
  """
  files = (nominal, nominal_path), (log, path)
  for one, at in files:
    for name in names:
      _there(one, at, name)
    if not one.columns:
      raise FileError(f"{at} has no column of numbers to watch{_because(one)}")
  shared = list(dict.fromkeys(names)) or [name for name in log.columns if name in nominal.columns]
  if not shared:
    raise FileError(
      (
        f"{path} and {nominal_path} share no column of numbers: {', '.join(log.columns)} against "
        f"{', '.join(nominal.columns)}"
      )
      + (_because(log) or _because(nominal))
    )
  clocks = [] if names else _clocks(log, nominal)
  able = [name for name in shared if name not in clocks]
  unfit = {name: why for name in able if (why := _unfit(name, log, nominal, path, nominal_path))}
  found = [name for name in able if name not in unfit]
  if unfit and (names or not found):
    _, error = next(iter(unfit.values()))
    raise FileError(error + (f"; name the others by --column: {', '.join(found)}" if found else ""))
  if not found:
    raise FileError(
      f"{path} and {nominal_path} share no column but such as rise like a clock or counter: "
      f"{', '.join(clocks)}; "
      "--column watches one all the same"
    )
  return found, [] if names else _left_out(files, clocks, unfit)


def _there(one: Log, at: pathlib.Path | str, name: str) -> None:
  """Refuses a name that is no column of numbers of the file."""
  if name in one.ignored:
    line, cell = one.ignored[name]
    raise FileError(f"{at}: column {name} holds {cell!r} in line {line}, which is no number")
  choices = f"choose from: {', '.join(sorted(one.columns)) or 'none'}"
  if name in one.clocks:
    raise UserError(
      f"{at}: column {name} tells when samples were taken and cannot be watched; {choices}"
    )
  if name not in one.columns:
    raise UserError(f"{at} has no column {name!r}; {choices}")


def _because(one: Log) -> str:
  """The first cell that keeps a column from being one of numbers."""
  return "".join(
    f"; column {name}: line {line} holds {cell!r}"
    for name, (line, cell) in list(one.ignored.items())[:1]
  )


def _unfit(
  name: str, log: Log, nominal: Log, path: pathlib.Path | str, nominal_path: pathlib.Path | str
) -> tuple[str, str] | None:
  """Why a column cannot be watched, for a note and as an error; None if it can."""
  known, now = (x[np.isfinite(x)] for x in (nominal.columns[name], log.columns[name]))
  if len(known) < LEAST:
    why = f"{len(known)} samples, at least {LEAST} are needed"
    return f"{nominal_path} has {why}", f"{nominal_path} is too short: column {name} has {why}"
  if np.ptp(known) == 0:
    return (
      f"constant in {nominal_path}" + (f", but not in {path}" if (now != known[0]).any() else ""),
      f"{nominal_path}: column {name} is constant ({known[0]:g}), nothing can be calibrated on it",
    )
  return None if len(now) else (f"no sample in {path}", f"{path}: column {name} has no sample")


def _left_out(
  files: tuple[tuple[Log, pathlib.Path | str], ...],
  clocks: list[str],
  unfit: dict[str, tuple[str, str]],
) -> list[str]:
  """A note for each reason not to watch columns, with their names."""
  reasons = {name: "rising like a clock or counter" for name in clocks}
  for (one, at), (other, _) in zip(files, files[::-1]):
    for name in other.labels:
      if name not in one.labels:
        like = difflib.get_close_matches(name, [n for n in one.labels if n not in other.labels], 1)
        has = f", which has {like[0]}" if like else ""
        reasons.setdefault(name, f"missing in {at}{has}")
  for one, at in files:
    for name, (line, cell) in one.ignored.items():
      reasons.setdefault(name, f"line {line} of {at} holds {cell!r}")
  reasons |= {name: note for name, (note, _) in unfit.items()}
  groups: dict[str, list[str]] = {}
  for name, reason in reasons.items():
    groups.setdefault(reason, []).append(name)
  return [
    (
      f"{'column' if len(group) == 1 else 'columns'} {', '.join(group)} "
      f"{'is' if len(group) == 1 else 'are'} not watched: {reason}"
    )
    for reason, group in groups.items()
  ]
