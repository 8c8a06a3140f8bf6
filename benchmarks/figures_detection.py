"""The pictures of docs/detection.md, from simulation with fixed seeds: run lengths, latency,
censoring, two AUROC traps.

python benchmarks/figures_detection.py --out docs
"""

from __future__ import annotations

import argparse
import pathlib

import numpy as np

from mjx_cl.render.style import BLUE, GREEN, GREY, ORANGE, look


def cusum(z: np.ndarray, slack: float = 0.5) -> np.ndarray:
  """One-sided evidence without restarts, (T, S)."""
  out, s = np.empty_like(z), np.zeros(z.shape[1])
  for t, x in enumerate(z):
    s = np.maximum(0.0, s + x - slack)
    out[t] = s
  return out


def first(over: np.ndarray) -> np.ndarray:
  """First true step of each column, inf where there is none."""
  return np.where(over.any(0), over.argmax(0).astype(float), np.inf)


def run_lengths(ax, rng):
  """Healthy streams until their first alarm: a geometric-like spread around its mean, the ARL0."""
  lengths = first(cusum(rng.standard_normal((6000, 2000))) > 4.0) + 1
  lengths = lengths[np.isfinite(lengths)]
  ax.hist(lengths, np.arange(0, 2000, 50), color=BLUE, alpha=0.7)
  ax.axvline(lengths.mean(), color=ORANGE)
  ax.text(
    lengths.mean() + 20,
    ax.get_ylim()[1] * 0.85,
    f"mean = ARL0 = {lengths.mean():.0f} steps",
    color=ORANGE,
  )
  early = np.mean(lengths <= lengths.mean() / 10)
  ax.set(
    xlabel="control steps until the first false alarm",
    ylabel="healthy streams",
    title=f"One CUSUM, 2,000 healthy streams: {early:.0%} alarm within a tenth of the ARL0",
  )


def latency(ax, rng):
  """One stream: evidence, threshold, onset, alarm."""
  z = rng.standard_normal((400, 1))
  z[250:] += 1.0
  s = cusum(z)[:, 0]
  alarm = 250 + int((s[250:] > 8).argmax())
  ax.plot(z[:, 0], color=GREY, lw=0.6, label="residual [deviations]")
  ax.plot(s[: alarm + 1], color=BLUE, label="evidence of the CUSUM")
  ax.axhline(8, color=ORANGE, ls="--", label="threshold")
  ax.axvline(250, color="k", lw=0.8)
  ax.annotate("", (alarm, 11), (250, 11), arrowprops={"arrowstyle": "<->", "color": GREEN})
  ax.text(252, 11.5, f"latency {alarm - 250} steps", color=GREEN)
  ax.set(
    xlabel="control step",
    ylim=(-4, 14),
    title="A fault at step 250 shifts the residual by one deviation",
  )
  ax.legend(loc="upper left", fontsize=8)


def censoring(ax, rng):
  """Ten seeds of a weak fault: four are never found before the stream ends."""
  times = np.sort(np.append(rng.exponential(90, 6), [np.inf] * 4))
  end = 500
  for k, t in enumerate(times):
    ax.plot([0, min(t, end)], [k, k], color=GREY, lw=1)
    ax.plot(
      min(t, end), k, "o" if np.isfinite(t) else ">", color=BLUE if np.isfinite(t) else ORANGE
    )
  mean, median = times[np.isfinite(times)].mean(), times[4]
  ax.axvline(mean, color=ORANGE, ls="--")
  ax.text(mean + 4, 8.3, f"mean over the found ones: {mean:.0f}", color=ORANGE, backgroundcolor="w")
  ax.axvline(median, color=GREEN)
  ax.text(median + 4, 6.8, f"censored median: {median:.0f}", color=GREEN, backgroundcolor="w")
  ax.set(
    xlabel="steps since the onset",
    ylabel="seed, in order of latency",
    title="Four of ten are missed (triangles): a mean over successes hides them",
  )


def traps(ax, rng):
  """Two scores of equal AUROC, one of which is found at once and one after ten seconds."""
  steps, onset = 800, 400
  now = np.arange(steps)
  a = rng.standard_normal(steps) + 2.0 * ((now >= onset) & (now < onset + 200))
  b = rng.standard_normal(steps) + 2.0 * (now >= onset + 200)

  def area(x):
    ranks = np.argsort(np.argsort(x)) + 1
    m = steps - onset
    return (ranks[onset:].sum() - m * (m + 1) / 2) / (m * onset)

  ax.plot(b - 9, color=ORANGE, lw=0.7, label=f"late: AUROC {area(b):.2f}")
  ax.plot(a, color=BLUE, lw=0.7, label=f"at once: AUROC {area(a):.2f}")
  ax.axvline(onset, color="k", lw=0.8)
  ax.set(
    xlabel="control step",
    yticks=[],
    ylabel="score",
    title="The same AUROC: one detector speaks up at once, one 200 steps later",
  )
  ax.legend(loc="upper left", fontsize=8)


PICTURES = {
  "arl": run_lengths,
  "latency": latency,
  "censoring": censoring,
  "auroc": traps,
}


def main() -> None:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
  )
  parser.add_argument("--out", default="docs")
  args = parser.parse_args()
  import matplotlib

  matplotlib.use("Agg")
  from matplotlib import pyplot

  for name, draw in PICTURES.items():
    with look():
      figure, ax = pyplot.subplots(figsize=(7, 3.2), layout="constrained")
      draw(ax, np.random.default_rng(1))
      figure.savefig(pathlib.Path(args.out) / f"{name}.png", dpi=110, metadata={"Software": None})
      pyplot.close(figure)


if __name__ == "__main__":
  main()
