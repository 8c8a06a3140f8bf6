"""The figures of results: a run's two panels, a suite's shares not yet recovered and its train
ratios.
"""

import os
import pathlib
import warnings
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjx_cl.errors import FileError
from mjx_cl.io import folders, tables
from mjx_cl.scoring import survival as estimate
from mjx_cl.scoring.versus import Variant, profile

UPPER = (("reward", "reward per step"), ("opr", "OPR"), ("rpr", "RPR"))
LOWER = (
  ("adv_mag", "advantage magnitude"),
  ("dyn_loss", "dynamics loss [nats]"),
  ("value_loss", "value loss [nats]"),
)
COLORS = ("#1f5fa8", "#c4472b", "#3b8a4a")
DASHES = ("--", ":", "-.")  # of arm `none`
MARKS = (
  (("start",), "v", "k", "alarm, finetuning starts"),
  (("stop", "abort"), "^", "w", "finetuning ends"),
)
FEW = 3  # seeds that give no interval, see report.few


def smooth(values: np.ndarray, width: int) -> np.ndarray:
  """Trailing mean over `width` steps that leaves nan out, (streams, steps)."""
  good = np.isfinite(values)
  sums = np.cumsum(np.where(good, values, 0.0), -1)
  counts = np.cumsum(good, -1)
  sums[:, width:] -= sums[:, :-width].copy()
  counts[:, width:] -= counts[:, :-width].copy()
  return np.where(counts > 0, sums / np.maximum(1, counts), np.nan)


def figure(folder: os.PathLike | str, width: int = 500) -> pathlib.Path:
  """Draws FOLDER/figure.png from its trace, events and config: the paper's two panels, mean and
  standard deviation over the streams of arm `detector` (or the first arm but `none`), arm `none` in
  grey, one aborted run dotted.

  Args:
    folder: of the run.
    width: steps of the trailing mean that every curve is drawn with.

  Raises:
    FileError where these are missing, broken or not a run's.
  """
  folder = pathlib.Path(folder)
  try:
    drawn = _figure(
      tables.read_table(folder / "trace.parquet"),
      tables.read_table(folder / "events.parquet"),
      tables.read_json(folder / "config.json"),
      width,
    )
  except (KeyError, ValueError, TypeError) as e:
    raise FileError(
      f"{folder} holds no run that can be drawn: {type(e).__name__}: "
      f"{str(e).splitlines()[0] if str(e) else ''}"
    ) from None
  return _saved(drawn, folder / "figure.png", 130)


def _saved(drawn: Figure, path: pathlib.Path, dpi: int = 110) -> pathlib.Path:
  folders.atomic(path, lambda file: drawn.savefig(file, format="png", dpi=dpi))
  return path


def _figure(trace: dict, events: dict, config: dict, width: int) -> Figure:
  steps, control_s = int(trace["step"].max()) + 1, config["control_s"]
  arms = list(dict.fromkeys(trace["arm"]))
  main = "detector" if "detector" in arms else next((arm for arm in arms if arm != "none"), "none")
  own = [
    (int(s), k, g)
    for s, k, a, g in zip(*(events[c] for c in ("step", "kind", "arm", "stream")))
    if a == main
  ]
  aborted = next((stream for _, kind, stream in own if kind == "abort"), None)
  drawn = Figure(figsize=(10, 7.2), layout="constrained")
  axes = drawn.subplots(2, 1, sharex=True)
  for axis, columns in zip(axes, (UPPER, LOWER)):
    hosts = [axis, axis.twinx(), axis.twinx()]
    hosts[2].spines["right"].set_position(("axes", 1.09))
    for host, (column, label), color, dash in zip(hosts, columns, COLORS, DASHES):
      values = {
        arm: np.asarray(trace[column][trace["arm"] == arm], float).reshape(-1, steps)
        for arm in arms
        if arm in (main, "none")
      }
      _curves(host, values, main, width, color, dash)
      if aborted is not None:  # one run that was given up, on its own
        curve = smooth(np.asarray(trace[column][trace["stream"] == aborted], float)[None], width)[0]
        name = f"stream {int(aborted)}, aborted" if column == "reward" else None
        host.plot(*_thin(curve), color=color, lw=0.7, ls=":", zorder=2, label=name)
      host.set_ylabel(label, color=color)
      host.tick_params(axis="y", colors=color)
    for s in sorted({int(s) for s, k in zip(events["step"], events["kind"]) if k == "onset"}):
      axis.axvline(s, color="k", lw=1.3)
    for kinds, marker, face, label in MARKS:
      at = [s for s, kind, _ in own if kind in kinds]
      high = [axis.get_ylim()[1] * 0.985] * len(at)
      # in_layout: an empty line that is not clipped has no extent, and the layout would collapse
      axis.plot(
        at, high, marker, color="k", mfc=face, ms=5, clip_on=False, in_layout=False, label=label
      )
  # a preset has a severity for each of its faults
  severity = "" if config["severity"] is None else f" {config['severity']:g}"
  axes[0].legend(loc="lower right", fontsize=8, framealpha=0.9)
  axes[0].set_title(
    f"{config['env']}: {config['fault']}{severity} at step {config['onset']:,}; "
    f"{(trace['arm'] == main).sum() // steps} streams, mean and "
    f"standard deviation\narm {main} in colour"
    + (", arm none in grey" if "none" in arms and main != "none" else "")
    + f"; curves are trailing means of {width} steps",
    fontsize=10,
  )
  axes[1].set_xlabel(f"control step ({control_s:g} s)")
  return drawn


def _thin(*curves: np.ndarray) -> list[np.ndarray]:
  """Steps and curves, of some 2,000 points each."""
  steps = np.arange(len(curves[0]))
  return [y[:: max(1, len(steps) // 2000)] for y in (steps, *curves)]


def _curves(
  host: Axes, values: dict[str, np.ndarray], main: str, width: int, color: str, dash: str
) -> None:
  """Trailing means of one signal, {arm: (streams, steps)}, and the axis from 0 to above them."""
  top = 0.0
  for arm, curves in values.items():
    curves = smooth(curves, width)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # no residual yet
      mean, std = np.nanmean(curves, 0), np.nanstd(curves, 0)
    if arm == main:
      host.plot(*_thin(mean), color=color, lw=1.6, zorder=3, ls="-")
      x, low, high = _thin(mean - std, mean + std)
      host.fill_between(x, low, high, color=color, alpha=0.14, lw=0)
    else:
      host.plot(*_thin(mean), color="0.6", lw=1.0, zorder=1, ls=dash)
    top = max(top, np.nanmax((mean + std)[min(width, len(mean) - 1) :], initial=0.0))
  host.set_ylim(0, 1.1 * top if top else 1)


def survival(out: os.PathLike | str, parts: list[str], columns: int = 3) -> pathlib.Path | None:
  """Draws OUT/recovery.png: of each part with affected streams and several arms, the share not yet
  recovered (Kaplan-Meier) since the onset, shaded its pointwise 95 % interval, which ends where the
  last stream recovers or is watched no longer.

  Returns:
    The file; None where no part has an affected stream.
  """
  out, shown = pathlib.Path(out), []
  for part in parts:
    rows = tables.read_rows(out / part / "runs.parquet")
    config = tables.read_json(out / part / "config.json")
    if any(r["affected"] for r in rows if not r["change"]):
      shown.append((part, rows, config))
  if not shown:
    return None
  lines, wide = -(-len(shown) // columns), min(columns, len(shown))
  drawn = Figure(figsize=(4.2 * wide, 3.3 * lines), layout="constrained")
  axes = drawn.subplots(lines, wide, squeeze=False)
  for axis in axes.flat[len(shown) :]:
    axis.set_axis_off()
  for axis, (part, rows, config) in zip(axes.flat, shown):
    for k, arm in enumerate(config["arms"]):
      own = [
        dict(r, affected=bool(r["affected"]) and not r["change"]) for r in rows if r["arm"] == arm
      ]
      if any(r["affected"] for r in own):
        _share(axis, *estimate.of_runs(own, config["steps"]), arm, f"C{k}")
    axis.set(title=part, xlabel="control steps since onset", ylim=(-0.03, 1.05))
    axis.locator_params(axis="x", nbins=5)
    axis.legend(fontsize=7, title="recovered", title_fontsize=7)
  axes[0, 0].set_ylabel("share not yet recovered")
  return _saved(drawn, out / "recovery.png")


def _share(axis: Axes, time: np.ndarray, seen: np.ndarray, arm: str, color: str) -> None:
  """Share not yet recovered by the times of recovery, or of censoring where none was seen."""
  curve = estimate.kaplan_meier(time, seen)
  x, level = [0.0, *curve.time, curve.last], [1.0, *curve.survival]
  label = f"{arm}, {int(seen.sum())} of {len(seen)}"
  axis.step(x, level + level[-1:], where="post", color=color, lw=1.6, label=label)
  bounds = [[1.0, *side, *side[-1:]] for side in (curve.low, curve.high)]
  low, high = (side if len(side) == len(x) else [1.0] * len(x) for side in bounds)
  axis.fill_between(x, low, high, step="post", color=color, alpha=0.12, lw=0)
  lost = time[~seen]
  heights = [level[int(np.searchsorted(curve.time, t, "right"))] for t in lost]
  axis.plot(lost, heights, "|", color=color, ms=7)


def versus(found: list[Variant], path: os.PathLike | str) -> pathlib.Path:
  """Draws, for each variant, the share of its streams that keep at least so much of their reward
  before the onset (a performance profile), with 95 % bootstrap intervals over streams.
  """
  levels = np.linspace(0.0, 1.2, 121)
  drawn = Figure(figsize=(6.4, 4.2), layout="constrained")
  axis = drawn.subplots()
  for k, one in enumerate(found):
    share, (low, high) = profile(one, levels)
    axis.step(levels, share, where="post", color=f"C{k}", lw=1.6, label=one.name)
    axis.fill_between(levels, low, high, step="post", color=f"C{k}", alpha=0.12, lw=0)
  axis.set(
    xlabel="reward over the last 2,000 steps / reward before the onset",
    ylabel="share of streams with at least that",
    ylim=(-0.03, 1.05),
  )
  axis.legend(fontsize=8)
  return _saved(drawn, pathlib.Path(path), 130)


def ratios(out: os.PathLike | str, points: list[dict]) -> pathlib.Path | None:
  """Draws OUT/ratio.png: restricted mean time to recovery against train ratio, a line with 95 %
  intervals for each env, fault and severity. Points of FEW seeds or fewer are hollow, without an
  interval, and no line joins them to others, which are of other seeds too.

  Args:
    out: folder.
    points: {line, ratio, mean, ci (low, high) or None, n, recovered} of parts with affected
      streams.

  Returns:
    The file; None where no line has two ratios.
  """
  by_ratio = sorted(points, key=lambda p: p["ratio"])
  lines = {p["line"]: [q for q in by_ratio if q["line"] == p["line"]] for p in points}
  if not any(len({p["ratio"] for p in own}) > 1 for own in lines.values()):
    return None
  drawn = Figure(figsize=(6, 4), layout="constrained")
  axis = drawn.subplots()
  for k, (line, own) in enumerate(lines.items()):
    _line(axis, line, own, 1.04 ** (k - (len(lines) - 1) / 2), f"C{k}")
  axis.set_title(f"recovered / affected at each point; hollow: {FEW} seeds or fewer", fontsize=9)
  axis.set(
    xscale="log",
    xlabel="train ratio (replayed steps per lived step)",
    ylabel="control steps to recovery, restricted mean",
    ylim=(0, 1.1 * max(p["ci"][1] if p["ci"] and p["ci"][1] else p["mean"] for p in points)),
  )
  ticks = sorted({p["ratio"] for p in points})
  axis.set_xticks(ticks, [f"{r:g}" for r in ticks])
  axis.minorticks_off()
  axis.legend(fontsize=8)
  return _saved(drawn, pathlib.Path(out) / "ratio.png")


def _line(axis: Axes, line: str, own: list[dict[str, Any]], aside: float, color: str) -> None:
  """The points of one line, drawn `aside` times their ratio, so that lines stay apart."""
  x, mean = np.array([p["ratio"] for p in own]) * aside, np.array([p["mean"] for p in own])
  ends = np.array([p["ci"] or (p["mean"], p["mean"]) for p in own], float).T
  many = np.array([p["n"] > FEW for p in own])
  if many.any():
    bars = np.maximum(0.0, [mean - ends[0], ends[1] - mean])[:, many]
    axis.errorbar(x[many], mean[many], bars, fmt="o-", capsize=3, color=color)
  axis.plot(x[~many], mean[~many], "o:", color=color, mfc="white")
  axis.plot([], [], "o-", color=color, label=line, mfc=color if many.any() else "white")
  for a, b, p in zip(x, mean, own):
    axis.annotate(
      f"{p['recovered']}/{p['n']}",
      (a, b),
      textcoords="offset points",
      xytext=(5, 4),
      fontsize=7,
      color=color,
    )
