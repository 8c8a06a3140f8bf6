"""The figures of results: a run's three panels, a suite's shares not yet recovered and its train
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
from mjx_cl.render import style
from mjx_cl.scoring import survival as estimate
from mjx_cl.scoring.versus import Variant, profile
from mjx_cl.scoring.versus import value as versus_value

FEW = 3  # seeds that give no interval, see report.few


def smooth(values: np.ndarray, width: int) -> np.ndarray:
  """Trailing mean over `width` steps that leaves nan out, (streams, steps)."""
  good = np.isfinite(values)
  sums = np.cumsum(np.where(good, values, 0.0), -1)
  counts = np.cumsum(good, -1)
  sums[:, width:] -= sums[:, :-width].copy()
  counts[:, width:] -= counts[:, :-width].copy()
  return np.where(counts > 0, sums / np.maximum(1, counts), np.nan)


def figure(folder: os.PathLike | str, width: int = 1000) -> pathlib.Path:
  """Draws FOLDER/figure.png from its tables and config, of the robots that the fault costs a tenth
  of their reward, all where none or where runs.parquet is not there: reward of every arm, when each
  robot of arm `detector` (or the first that may learn) alarms, learns and is done, and its OPR.

  Args:
    folder: of the run.
    width: steps of the trailing mean of reward; that of an episode hides how each begins. A fifth
      of it for OPR.

  Raises:
    FileError where these are missing, broken or not a run's.
  """
  folder = pathlib.Path(folder)
  try:
    trace, events = (tables.read_table(folder / f"{name}.parquet") for name in ("trace", "events"))
    there = (folder / "runs.parquet").exists()
    rows = tables.read_rows(folder / "runs.parquet") if there else []
    with style.look():
      drawn = _figure(trace, events, rows, tables.read_json(folder / "config.json"), width)
  except (KeyError, ValueError, TypeError) as e:
    raise FileError(
      f"{folder} holds no run that can be drawn: {type(e).__name__}: "
      f"{str(e).splitlines()[0] if str(e) else ''}"
    ) from None
  return _saved(drawn, folder / "figure.png", 130)


def _saved(drawn: Figure, path: pathlib.Path, dpi: int = 110) -> pathlib.Path:
  folders.atomic(path, lambda file: drawn.savefig(file, format="png", dpi=dpi))
  return path


def _figure(trace: dict, events: dict, rows: list[dict], config: dict, width: int) -> Figure:
  steps, control_s = int(trace["step"].max()) + 1, config["control_s"]
  arms = list(dict.fromkeys(trace["arm"]))
  learns = set(events["arm"][i] for i, kind in enumerate(events["kind"]) if kind == "start")
  likely = ["detector", *(arm for arm in arms if arm in learns), *arms]
  main = next((arm for arm in likely if arm in arms and arm != "none"), "none")
  shown, which = _affected(trace, rows)
  drawn = Figure(figsize=(9, 6.4), layout="constrained")
  axes = drawn.subplots(3, 1, sharex=True, height_ratios=(3, 1.1, 1.7))
  for arm in reversed(arms):  # the first on top
    reward = _of(trace, "reward", arm, shown, steps)
    _lines(axes[0], smooth(reward, width), style.arm(arm), f"arm {arm}", arm in (main, "none"))
  axes[0].set(ylabel="reward a step", ylim=(0, None) if min(trace["reward"]) >= 0 else None)
  axes[0].legend(loc="lower right", ncols=min(5, len(arms)))
  mine = [g for g in shown if trace["arm"][np.flatnonzero(trace["stream"] == g)[0]] == main]
  _spans(axes[1], events, mine, steps, style.arm(main))
  axes[1].set_ylabel(f"{main}:\nlearning")
  brief = max(1, width // 5)
  opr = smooth(_of(trace, "opr", main, shown, steps), brief)
  _lines(axes[2], opr, style.arm(main), None, True)
  axes[2].set(ylabel=f"{main}:\nprediction error (OPR)", xlabel="control step", xlim=(0, steps))
  for axis in axes:
    for step, kind in sorted(set(zip(events["step"], events["kind"]))):
      if kind in ("onset", "repair"):
        axis.axvline(step, color="k", lw=0.9, ls=":")
        if axis is axes[0]:
          axis.text(step, 1.0, f" {kind}", transform=axis.get_xaxis_transform(), va="top")
  clock = axes[0].secondary_xaxis("top", (lambda x: x * control_s, lambda t: t / control_s))
  clock.set_xlabel("seconds")
  # a preset has a severity for each of its faults
  severity = "" if config["severity"] is None else f" {config['severity']:g}"
  drawn.suptitle(
    f"{config['env']}, {config['fault']}{severity}: {which}\n"
    f"thin lines: robots; thick: their median; trailing means of {width:,} steps, OPR {brief:,}",
    fontsize=10,
    x=0.01,
    ha="left",
  )
  return drawn


def _affected(trace: dict, rows: list[dict]) -> tuple[list[int], str]:
  """Streams of the seeds that the fault costs something, and what these are."""
  seeds = {r["seed"] for r in rows if r["affected"] and not r["change"]}
  streams = dict(zip(trace["stream"].tolist(), trace.get("seed", trace["stream"]).tolist()))
  some = [g for g, seed in streams.items() if seed in seeds]
  if some:
    return some, f"the {len(seeds)} of {len(set(streams.values()))} robots that it costs a tenth"
  known = any(r["affected"] is not None for r in rows if not r["change"])
  return list(streams), "all robots" + (", none of which it costs a tenth" if known else "")


def _of(trace: dict, column: str, arm: str, streams: list[int], steps: int) -> np.ndarray:
  """A column of an arm's streams, (streams, steps)."""
  own = (trace["arm"] == arm) & np.isin(trace["stream"], streams)
  return np.asarray(trace[column][own], float).reshape(-1, steps)


def _thin(*curves: np.ndarray) -> list[np.ndarray]:
  """Steps and curves, of some 2,000 points each."""
  steps = np.arange(len(curves[0]))
  return [y[:: max(1, len(steps) // 2000)] for y in (steps, *curves)]


def _lines(axis: Axes, curves: np.ndarray, color: str, label: str | None, each: bool) -> None:
  """The median of curves (streams, steps), and each of them where told."""
  if each:
    for curve in curves:
      axis.plot(*_thin(curve), color=color, lw=0.6, alpha=0.35)
  with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # nothing known yet
    axis.plot(*_thin(np.nanmedian(curves, 0)), color=color, lw=2.0, label=label)


def _spans(axis: Axes, events: dict, streams: list[int], steps: int, color: str) -> None:
  """A row a stream: bars while it learns, where it alarms, and how learning ends."""
  rows = {g: k for k, g in enumerate(streams)}
  marks: dict[str, list[tuple[int, int]]] = {"alarm": [], "stop": [], "abort": [], "end": []}
  begun: dict[int, int] = {}
  told = zip(*(events[k] for k in ("step", "kind", "stream", "decision")))
  for step, kind, g, decision in sorted(told, key=lambda x: x[:3]):
    if g not in rows:
      continue
    kind = "end" if decision == "end" else kind
    if kind == "start":
      begun[g] = step
    elif kind in ("stop", "abort", "end") and g in begun:
      axis.barh(rows[g], step - begun[g], left=begun.pop(g), height=0.6, color=color, alpha=0.5)
    if kind in marks:
      marks[kind].append((step, rows[g]))
  for g, step in begun.items():
    axis.barh(rows[g], steps - step, left=step, height=0.6, color=color, alpha=0.5)
  for kind, marker in (("alarm", "|"), ("stop", "o"), ("abort", "x"), ("end", "s")):
    if marks[kind]:
      name = {"stop": "converged", "abort": "given up", "end": "time over"}.get(kind, kind)
      axis.plot(*zip(*marks[kind]), marker, color="k", ms=5, mfc="w", label=name)
  axis.set(yticks=[], ylim=(len(streams) - 0.4, -0.6))
  if any(marks.values()):
    axis.legend(loc="upper left", bbox_to_anchor=(0.0, 1.0), ncols=1)


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
  with style.look():
    return _saved(_survival(shown, columns), out / "recovery.png")


def _survival(shown: list[tuple[str, list[dict], dict]], columns: int) -> Figure:
  """A panel for each (part, rows, config)."""
  lines, wide = -(-len(shown) // columns), min(columns, len(shown))
  drawn = Figure(figsize=(4.2 * wide, 3.3 * lines), layout="constrained")
  axes = drawn.subplots(lines, wide, squeeze=False)
  for axis in axes.flat[len(shown) :]:
    axis.set_axis_off()
  for axis, (part, rows, config) in zip(axes.flat, shown):
    for arm in config["arms"]:
      own = [
        dict(r, affected=bool(r["affected"]) and not r["change"]) for r in rows if r["arm"] == arm
      ]
      if any(r["affected"] for r in own):
        _share(axis, *estimate.of_runs(own, config["steps"]), arm, style.arm(arm))
    axis.set(title=part, xlabel="control steps since onset", ylim=(-0.03, 1.05))
    axis.locator_params(axis="x", nbins=5)
    axis.legend(fontsize=7, title="recovered", title_fontsize=7)
  axes[0, 0].set_ylabel("share not yet recovered")
  return drawn


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
  with style.look():
    return _saved(_versus(found), pathlib.Path(path), 130)


def _versus(found: list[Variant]) -> Figure:
  levels = np.linspace(0.0, 1.2, 241)
  shared = os.path.commonprefix([one.name for one in found]).rfind("/") + 1
  drawn = Figure(figsize=(6.4, 4.2), layout="constrained")
  axis = drawn.subplots()
  for k, one in enumerate(found):
    share, (low, high) = profile(one, levels)
    axis.step(levels, share, where="post", color=style.nth(k), lw=1.6, label=one.name[shared:])
    axis.fill_between(levels, low, high, step="post", color=style.nth(k), alpha=0.12, lw=0)
  kept = [versus_value(row, "reward_kept") for one in found for row in one.rows.values()]
  ends = (
    np.clip([np.nanmin(kept), np.nanmax(kept)], 0.0, 1.2) if np.isfinite(kept).any() else (0, 1)
  )
  axis.set(
    title="right and high is better; band: 95 % interval",
    xlabel="reward over the last 2,000 steps / reward before the onset",
    ylabel="share of streams with at least that",
    xlim=(max(0.0, ends[0] - 0.1), min(1.2, ends[1] + 0.1)),
    ylim=(-0.03, 1.05),
  )
  axis.legend(loc="lower left")
  return drawn


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
  with style.look():
    return _saved(_ratios(lines, points), pathlib.Path(out) / "ratio.png")


def _ratios(lines: dict[str, list[dict]], points: list[dict]) -> Figure:
  drawn = Figure(figsize=(6, 4), layout="constrained")
  axis = drawn.subplots()
  for k, (line, own) in enumerate(lines.items()):
    _line(axis, line, own, 1.04 ** (k - (len(lines) - 1) / 2), style.nth(k))
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
  return drawn


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
