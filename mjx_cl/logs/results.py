"""What a detection on a log found, and the files that hold it."""

from __future__ import annotations

import csv
import io
import pathlib
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np

from mjx_cl.errors import FileError, UserError
from mjx_cl.io import folders, tables

if TYPE_CHECKING:
  from matplotlib.axes import Axes  # loaded where something is drawn

ALL = "(all)"  # in the place of a column: one detector watches all
FILES = ("detect.json", "alarms.csv", "detect.png")
INJECTED = ("inject.csv", "inject.png")  # where faults were put into the nominal log


class Detection(NamedTuple):
  """What was found; C is 1 in what a detector gives that watches all columns together.

  Attributes:
    summary: what detect.json holds; of the charts also verdict, events, false_alarms, model,
      silent (column: when it has no samples), ended (columns without samples at the end), unjudged
      (column: why nothing is said of it) and, where faults were put into the nominal log, inject.
    xs: float (T, C), the log as read.
    past: float (N, C), the nominal log as read.
    fired: detector -> bool (T, C).
    scores: detector -> float (T, C).
    before: detector -> bool (N,), nominal alarms of any column.
    seconds: float64 (T,) since the first sample, or None.
  """

  summary: dict
  xs: np.ndarray
  past: np.ndarray
  fired: dict[str, np.ndarray]
  scores: dict[str, np.ndarray]
  before: dict[str, np.ndarray]
  seconds: np.ndarray | None


def watched(fired: np.ndarray, columns: list[str]) -> list[str]:
  """The names of the columns of `fired`, (T, C)."""
  return columns if fired.shape[1] == len(columns) else [ALL]


def claim(out: pathlib.Path | str, overwrite: bool) -> pathlib.Path:
  """Makes the folder of the results; an earlier detection in it is refused unless `overwrite`."""
  out = pathlib.Path(out)
  if out.exists() and not out.is_dir():
    raise UserError(f"--out {out} is a file")
  there = [name for name in (*FILES, *INJECTED) if (out / name).exists()]
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
  folder `out`, and inject.csv and inject.png where faults were put into the nominal log. `event` of
  an alarm: the number, from 1, of the event of detect.json that it lies in, where that is believed.
  """
  out, text = pathlib.Path(out), io.StringIO()
  alarms = csv.writer(text, lineterminator="\n")
  alarms.writerow(("detector", "column", "sample", "seconds", "score", "event"))
  event = np.zeros(len(result.xs), int)
  for k, own in enumerate(result.summary.get("events", ()), 1):
    if own["believed"]:
      event[own["begin"] : own["end"]] = k
  for detector, fired in result.fired.items():
    names = watched(fired, result.summary["columns"])
    for t, c in np.argwhere(fired):
      score = result.scores[detector][t, c]
      at = "" if result.seconds is None else f"{result.seconds[t]:.9g}"
      told = f"{score:.9g}" if np.isfinite(score) else ""
      alarms.writerow((detector, names[c], t, at, told, event[t] or ""))
  faults = result.summary.get("inject", {}).get("faults", [])
  with folders.together():
    if faults:
      folders.atomic(out / "inject.csv", lambda file: file.write(_faults_csv(faults).encode()))
      folders.atomic(out / "inject.png", lambda file: faults_figure(result.summary, file))
    folders.atomic(out / "alarms.csv", lambda file: file.write(text.getvalue().encode()))
    folders.atomic(out / "detect.png", lambda file: figure(result, file))
    tables.write_json(out / "detect.json", result.summary)
  for name in () if faults else INJECTED:
    (out / name).unlink(missing_ok=True)  # of an earlier detection


def _faults_csv(faults: list[dict]) -> str:
  """A line for each column, kind and severity: share of the places at which it was seen."""
  text = io.StringIO()
  rows = csv.writer(text, lineterminator="\n")
  rows.writerow(("column", "kind", "severity", "seen"))
  for fault in faults:
    for severity, share in zip(fault["tried"], fault["shares"]):
      rows.writerow((fault["column"], fault["kind"], severity, share))
  return text.getvalue()


def faults_figure(summary: dict, file: pathlib.Path | str | BinaryIO) -> None:
  """Draws, for each column and kind of fault, the smallest severity that is seen: the darker, the
  smaller among those tried.
  """
  import matplotlib

  matplotlib.use("Agg")
  import matplotlib.pyplot as plt

  faults, columns = summary["inject"]["faults"], summary["columns"]
  kinds = list(dict.fromkeys(fault["kind"] for fault in faults))
  shade = np.zeros((len(columns), len(kinds)))
  fig, axis = plt.subplots(
    figsize=(2.5 + 0.9 * len(kinds), 1.2 + 0.32 * len(columns)), constrained_layout=True
  )
  for fault in faults:
    at = columns.index(fault["column"]), kinds.index(fault["kind"])
    if fault["severity"] is None:
      text = "-"
    else:
      shade[at] = 1 - fault["tried"].index(fault["severity"]) / len(fault["tried"])
      value = fault["severity"] if fault["by"] is None else fault["by"]
      text = "yes" if len(fault["tried"]) == 1 else f"{value:.2g}"
    dark = shade[at] > 0.6
    axis.text(*at[::-1], text, ha="center", va="center", fontsize=8, color="w" if dark else "k")
  axis.imshow(shade, cmap="Blues", vmin=0, vmax=1, aspect="auto")
  units = {"scale": "share", "freeze": "", "dropout": "share", "delay": "samples"}
  named = [f"{kind}\n{units.get(kind, 'in its unit')}" for kind in kinds]
  axis.set_xticks(range(len(kinds)), named, fontsize=8)
  axis.set_yticks(range(len(columns)), columns, fontsize=8)
  within, rate = summary["inject"]["within"], summary["rate_hz"]
  time = f"{within:,} samples" if rate is None else f"{within / rate:g} s"
  axis.set_title(f"Smallest fault seen within {time} (-: none)", fontsize=9)
  fig.savefig(file, dpi=130, format="png")
  plt.close(fig)


def figure(result: Detection, file: pathlib.Path | str | BinaryIO, panels: int = 8) -> None:
  """Draws the columns, before sample 0 the end of the nominal log in grey, events that are believed
  shaded in the columns they name, and beneath them each detector's alarms as marks.

  Args:
    result: what was found.
    file: path or binary file.
    panels: columns that are drawn, those with alarms first.
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
    for x, begin, color in ((result.past, -len(result.past), "0.6"), (result.xs, 0, "#1f5fa8")):
      at, line = _envelope(x[:, c], begin)
      axis.plot(_time(result, at), line, color=color, lw=0.7)
    axis.set_ylabel(f"ln {names[c]}" if result.summary["logarithm"] else names[c], fontsize=8)
    axis.tick_params(labelsize=8)
  for event in result.summary.get("events", ()):
    named = {column["column"] for column in event["columns"]} if event["believed"] else ()
    for axis, c in zip(axes, shown):
      if names[c] in named:
        span = _time(result, np.array([event["begin"], event["end"]]))
        axis.axvspan(*span, color="#c4472b", alpha=0.2, lw=0)
  _marks(result, axes[-1])
  for axis in axes:
    axis.axvline(0, color="k", lw=0.8)
    # the log that is judged keeps half of the width at least
    end = float(_time(result, np.array([steps]))[0])
    axis.set_xlim(max(-end, -len(result.past) * _step(result)), end)
  hidden = f"; {len(names) - len(shown)} more columns watched" if len(names) > len(shown) else ""
  axes[0].set_title(
    f"{pathlib.Path(result.summary['log']).name}: alarms per detector (marks); nominal log in "
    f"grey{hidden}",
    fontsize=10,
  )
  fig.savefig(file, dpi=130, format="png")
  plt.close(fig)


def _marks(result: Detection, axis: Axes) -> None:
  """Alarms of each detector as marks."""
  for k, (name, fired) in enumerate(result.fired.items()):
    at = _time(result, np.flatnonzero(fired.any(1)))
    early = _time(result, np.flatnonzero(result.before[name]) - len(result.past))
    axis.plot(early, np.full(len(early), k), "|", color="0.6", ms=8, mew=1.2)
    axis.plot(at, np.full(len(at), k), "|", color="#c4472b", ms=8, mew=1.2)
  unsure = {r["detector"] for r in result.summary["detectors"] if r["calibrated"] is False}
  axis.set_yticks(
    range(len(result.fired)),
    [name + (" *" if name in unsure else "") for name in result.fired],
    fontsize=8,
  )
  axis.set_ylim(len(result.fired) - 0.5, -0.5)
  axis.grid(axis="y", lw=0.4, color="0.85")
  axis.set_xlabel(_axis(result) + ("; * threshold not calibrated" if unsure else ""), fontsize=9)


def _step(result: Detection) -> float:
  """Of the axis between two samples: in seconds where the log has a clock."""
  rate = result.summary["rate_hz"]
  return 1.0 if rate is None else 1 / rate


def _time(result: Detection, at: np.ndarray) -> np.ndarray:
  """Of samples on the axis: their own times, which may have gaps; the nominal log's, below 0, in
  even steps.
  """
  step = _step(result)
  if result.seconds is None or result.summary["rate_hz"] is None:
    return at * step
  known = np.append(result.seconds, result.seconds[-1] + step)
  return np.where(at < 0, at * step, known[np.clip(at, 0, len(known) - 1)])


def _axis(result: Detection) -> str:
  unit = "sample" if result.summary["rate_hz"] is None else "time [s]"
  return f"{unit} (below 0: the end of the nominal log)"


def _envelope(x: np.ndarray, begin: int, bins: int = 2000) -> tuple[np.ndarray, np.ndarray]:
  """X against its sample number; a long stream as the lowest and highest sample of each bin, so
  that no spike is lost.
  """
  at = begin + np.arange(len(x))
  if len(x) <= 2 * bins:
    return at, x
  width = -(-len(x) // bins)
  full = np.pad(x, (0, -len(x) % width), constant_values=np.nan).reshape(-1, width)
  low = np.where(np.isnan(full), np.inf, full).min(1)
  high = np.where(np.isnan(full), -np.inf, full).max(1)
  both = np.stack([low, high], 1).ravel()
  return np.repeat(begin + width * np.arange(len(full)), 2), np.where(np.isinf(both), np.nan, both)
