"""figure.png of a run: the paper's two panels, mean and standard deviation over the streams of arm
`detector`, arm `none` in grey, one aborted run dotted.
"""

from __future__ import annotations

import os
import pathlib
import warnings

import numpy as np

from mjx_cl.errors import FileError
from mjx_cl.io import folders, tables

UPPER = (("reward", "reward per step"), ("opr", "OPR"), ("rpr", "RPR"))
LOWER = (
  ("adv_mag", "advantage magnitude"),
  ("dyn_loss", "dynamics loss [nats]"),
  ("value_loss", "value loss [nats]"),
)
COLORS = ("#1f5fa8", "#c4472b", "#3b8a4a")


def smooth(values: np.ndarray, width: int) -> np.ndarray:
  """Trailing mean over `width` steps that leaves nan out, (streams, steps)."""
  good = np.isfinite(values)
  sums = np.cumsum(np.where(good, values, 0.0), -1)
  counts = np.cumsum(good, -1)
  sums[:, width:] -= sums[:, :-width].copy()
  counts[:, width:] -= counts[:, :-width].copy()
  return np.where(counts > 0, sums / np.maximum(1, counts), np.nan)


def figure(folder: os.PathLike | str, width: int = 500) -> pathlib.Path:
  """Draws FOLDER/figure.png from its trace, events and config.

  Args:
    width: steps of the trailing mean that every curve is drawn with.

  Raises:
    FileError where these are missing, broken or not a run's.
  """
  try:
    return _figure(folder, width)
  except (KeyError, ValueError, TypeError) as e:
    raise FileError(
      f"{folder} holds no run that can be drawn: {type(e).__name__}: "
      f"{str(e).splitlines()[0] if str(e) else ''}"
    ) from None


def _figure(folder: os.PathLike | str, width: int) -> pathlib.Path:
  import matplotlib

  matplotlib.use("Agg")
  import matplotlib.pyplot as plt

  folder = pathlib.Path(folder)
  trace, events = (
    tables.read_table(folder / "trace.parquet"),
    tables.read_table(folder / "events.parquet"),
  )
  config = tables.read_json(folder / "config.json")
  steps = int(trace["step"].max()) + 1
  control_s = config["control_s"]
  panels = {}
  arms = list(dict.fromkeys(trace["arm"]))
  main = "detector" if "detector" in arms else next((arm for arm in arms if arm != "none"), "none")
  for arm in arms:
    if arm in (main, "none"):
      mask = trace["arm"] == arm
      panels[arm] = {
        c: np.asarray(trace[c][mask], float).reshape(-1, steps) for c, _ in UPPER + LOWER
      }
  failed = next(
    (
      g
      for g, k, a in zip(events["stream"], events["kind"], events["arm"])
      if k == "abort" and a == main
    ),
    None,
  )
  fig, axes = plt.subplots(2, 1, figsize=(10, 7.2), sharex=True, constrained_layout=True)
  x = np.arange(steps)
  every = max(1, steps // 2000)
  for axis, columns in zip(axes, (UPPER, LOWER)):
    hosts = [axis, axis.twinx(), axis.twinx()]
    hosts[2].spines["right"].set_position(("axes", 1.09))
    for host, (column, label), color in zip(hosts, columns, COLORS):
      top = 0.0
      for arm, data in panels.items():
        curves = smooth(data[column], width)
        with warnings.catch_warnings():  # the first rows of a run have no residual yet
          warnings.simplefilter("ignore", RuntimeWarning)
          mean, std = np.nanmean(curves, 0), np.nanstd(curves, 0)
        shade = color if arm == main else "0.6"
        host.plot(
          x[::every],
          mean[::every],
          color=shade,
          lw=1.6 if arm == main else 1.0,
          zorder=3 if arm == main else 1,
          ls="-" if arm == main else ("--", ":", "-.")[columns.index((column, label))],
        )
        if arm == main:
          host.fill_between(
            x[::every], (mean - std)[::every], (mean + std)[::every], color=color, alpha=0.14, lw=0
          )
        top = max(top, np.nanmax((mean + std)[min(width, steps - 1) :], initial=0.0))
      if failed is not None:  # one run that was given up, on its own
        curve = smooth(np.asarray(trace[column][trace["stream"] == failed], float)[None], width)[0]
        host.plot(
          x[::every],
          curve[::every],
          color=color,
          lw=0.7,
          ls=":",
          zorder=2,
          label=f"stream {int(failed)}, aborted" if column == "reward" else None,
        )
      host.set_ylim(0, 1.1 * top if top else 1)
      host.set_ylabel(label, color=color)
      host.tick_params(axis="y", colors=color)
    onset = [int(s) for s, k in zip(events["step"], events["kind"]) if k == "onset"]
    starts = [
      int(s)
      for s, k, a in zip(events["step"], events["kind"], events["arm"])
      if k == "start" and a == main
    ]
    stops = [
      int(s)
      for s, k, a in zip(events["step"], events["kind"], events["arm"])
      if k in ("stop", "abort") and a == main
    ]
    for s in sorted(set(onset)):
      axis.axvline(s, color="k", lw=1.3)
    low, high = axis.get_ylim()
    # in_layout: an empty line that is not clipped has no extent, and the layout would collapse
    axis.plot(
      starts,
      [high * 0.985] * len(starts),
      "v",
      color="k",
      ms=5,
      clip_on=False,
      in_layout=False,
      label="alarm, finetuning starts",
    )
    axis.plot(
      stops,
      [high * 0.985] * len(stops),
      "^",
      mfc="w",
      mec="k",
      ms=5,
      clip_on=False,
      in_layout=False,
      label="finetuning ends",
    )
  axes[0].legend(loc="lower right", fontsize=8, framealpha=0.9)
  severity = (
    "" if config["severity"] is None else f" {config['severity']:g}"
  )  # a preset has one for each of its faults
  axes[0].set_title(
    f"{config['env']}: {config['fault']}{severity} at step {config['onset']:,}; "
    f"{panels[main]['opr'].shape[0]} streams, mean and "
    f"standard deviation\narm {main} in colour"
    + (", arm none in grey" if "none" in panels and main != "none" else "")
    + f"; curves are trailing means of {width} steps",
    fontsize=10,
  )
  axes[1].set_xlabel(f"control step ({control_s:g} s)")
  folders.atomic(folder / "figure.png", lambda file: fig.savefig(file, format="png", dpi=130))
  plt.close(fig)
  return folder / "figure.png"


FEW = 3  # seeds that give no interval, see report.few


def survival(out: os.PathLike | str, parts: list[str], columns: int = 3) -> pathlib.Path | None:
  """Draws OUT/recovery.png: of each part with affected streams and several arms, the share not yet
  recovered (Kaplan-Meier) since the onset, shaded its pointwise 95 % interval, which ends where the
  last stream recovers or is watched no longer.

  Returns:
    The file; None where no part has an affected stream.
  """
  import matplotlib

  matplotlib.use("Agg")
  import matplotlib.pyplot as plt

  from mjx_cl.scoring import survival as estimate

  out, drawn = pathlib.Path(out), []
  for part in parts:
    rows, config = (
      tables.read_rows(out / part / "runs.parquet"),
      tables.read_json(out / part / "config.json"),
    )
    if any(r["affected"] for r in rows if not r["change"]):
      drawn.append((part, rows, config))
  if not drawn:
    return None
  lines = -(-len(drawn) // columns)
  fig, axes = plt.subplots(
    lines,
    min(columns, len(drawn)),
    figsize=(4.2 * min(columns, len(drawn)), 3.3 * lines),
    squeeze=False,
    constrained_layout=True,
  )
  for axis in axes.flat[len(drawn) :]:
    axis.set_axis_off()
  for axis, (part, rows, config) in zip(axes.flat, drawn):
    for k, arm in enumerate(config["arms"]):
      own = [
        dict(r, affected=bool(r["affected"]) and not r["change"]) for r in rows if r["arm"] == arm
      ]
      if not any(r["affected"] for r in own):
        continue
      time, seen = estimate.of_runs(own, config["steps"])
      curve = estimate.kaplan_meier(time, seen)
      x, level = [0.0, *curve.time, curve.last], [1.0, *curve.survival]
      axis.step(
        x,
        level + level[-1:],
        where="post",
        color=f"C{k}",
        lw=1.6,
        label=f"{arm}, {int(seen.sum())} of {len(seen)}",
      )
      bounds = [[1.0, *side, *side[-1:]] for side in (curve.low, curve.high)]
      axis.fill_between(
        x,
        *(side if len(side) == len(x) else [1.0] * len(x) for side in bounds),
        step="post",
        color=f"C{k}",
        alpha=0.12,
        lw=0,
      )
      axis.plot(
        time[~seen],
        [level[int(np.searchsorted(curve.time, t, "right"))] for t in time[~seen]],
        "|",
        color=f"C{k}",
        ms=7,
      )
    axis.set(title=part, xlabel="control steps since onset", ylim=(-0.03, 1.05))
    axis.locator_params(axis="x", nbins=5)
    axis.legend(fontsize=7, title="recovered", title_fontsize=7)
  axes[0, 0].set_ylabel("share not yet recovered")
  folders.atomic(out / "recovery.png", lambda file: fig.savefig(file, format="png", dpi=110))
  plt.close(fig)
  return out / "recovery.png"


def ratios(out: os.PathLike | str, points: list[dict]) -> pathlib.Path | None:
  """Draws OUT/ratio.png: restricted mean time to recovery against train ratio, a line with 95 %
  intervals for each env, fault and severity. Points of FEW seeds or fewer are hollow, without an
  interval, and no line joins them to others, which are of other seeds too.

  Args:
    points: {line, ratio, mean, ci (low, high) or None, n, recovered} of parts with affected
      streams.

  Returns:
    The file; None where no line has two ratios.
  """
  import matplotlib

  matplotlib.use("Agg")
  import matplotlib.pyplot as plt

  out = pathlib.Path(out)
  lines = {
    p["line"]: sorted((q for q in points if q["line"] == p["line"]), key=lambda q: q["ratio"])
    for p in points
  }
  if not any(len({p["ratio"] for p in own}) > 1 for own in lines.values()):
    return None
  fig, axis = plt.subplots(figsize=(6, 4), constrained_layout=True)
  for k, (line, own) in enumerate(lines.items()):
    x, mean = (
      np.array([p["ratio"] for p in own]) * 1.04 ** (k - (len(lines) - 1) / 2),
      np.array([p["mean"] for p in own]),
    )
    ends = np.array([p["ci"] or (p["mean"], p["mean"]) for p in own], float).T
    many = np.array([p["n"] > FEW for p in own])
    if many.any():
      axis.errorbar(
        x[many],
        mean[many],
        np.maximum(0.0, [mean - ends[0], ends[1] - mean])[:, many],
        fmt="o-",
        capsize=3,
        color=f"C{k}",
      )
    axis.plot(x[~many], mean[~many], "o:", color=f"C{k}", mfc="white")
    axis.plot([], [], "o-", color=f"C{k}", label=line, mfc=f"C{k}" if many.any() else "white")
    for a, b, p in zip(x, mean, own):
      axis.annotate(
        f"{p['recovered']}/{p['n']}",
        (a, b),
        textcoords="offset points",
        xytext=(5, 4),
        fontsize=7,
        color=f"C{k}",
      )
  axis.set_title(f"recovered / affected at each point; hollow: {FEW} seeds or fewer", fontsize=9)
  axis.set(
    xscale="log",
    xlabel="train ratio (replayed steps per lived step)",
    ylabel="control steps to recovery, restricted mean",
    ylim=(0, 1.1 * max(p["ci"][1] if p["ci"] and p["ci"][1] else p["mean"] for p in points)),
  )
  axis.set_xticks(
    sorted({p["ratio"] for p in points}), [f"{r:g}" for r in sorted({p["ratio"] for p in points})]
  )
  axis.minorticks_off()
  axis.legend(fontsize=8)
  folders.atomic(out / "ratio.png", lambda file: fig.savefig(file, format="png", dpi=110))
  plt.close(fig)
  return out / "ratio.png"
