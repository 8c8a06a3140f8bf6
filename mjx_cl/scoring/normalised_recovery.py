"""Normalised recovery: how much of what the change cost an arm has won back, 0 without adaptation,
1 as good as a reference.
"""

from mjx_cl.scoring import intervals

# share of reward_pre that must lie between the reference and no adaptation; as `affected` asks for
LEAST = 0.1
HALF = 0.5  # of normalised recovery: where no arm reaches it, the change counts as unrecoverable


def normalise(
  final: float | None,
  none: float | None,
  reference: float | None,
  pre: float | None,
  least: float = LEAST,
) -> float | None:
  """(final - none) / (reference - none), None where that means little.

  Args:
    final: mean reward of the last 2,000 steps of the arm.
    none: of arm `none` in the same seed, likewise.
    reference: of the reference in the same seed, likewise.
    pre: mean reward before the change.
    least: None is returned unless reference - none is at least this share of pre; neither is
      anything made of a pre of 0 or less.
  """
  if final is None or none is None or reference is None or pre is None or pre <= 0:
    return None
  gain = reference - none
  return None if gain < least * pre else (final - none) / gain


def rows(runs: list[dict], expert: list[dict] | None = None, least: float = LEAST) -> list[dict]:
  """Normalised recovery of every stream whose seed also lived in arm `none`.

  Args:
    runs: rows of runs.parquet; those of later changes are left out, since no stream without
      adaptation shares their past.
    expert: rows of the run that holds the expert, one arm of true-onset trigger: its reward_final
      is the reference. None: reward_pre is.
    least: see `normalise`.

  Returns:
    {stream, arm, seed, reward_final, reward_none, reward_pre, reward_reference, reference (`expert`
    or `reward_pre`), normalised}; `normalised` is None where undefined. Seeds that the expert did
    not live are left out.
  """
  first = [r for r in runs if not r.get("change")]
  none = {r["seed"]: r for r in first if r["arm"] == "none"}
  word, reference = "reward_pre", {seed: r["reward_pre"] for seed, r in none.items()}
  if expert is not None:
    word = "expert"
    reference = {r["seed"]: r["reward_final"] for r in expert if not r.get("change")}
  out = []
  for r in first:
    seed = r["seed"]
    if seed in none and seed in reference and r["onset"] is not None:
      final, pre = none[seed]["reward_final"], none[seed]["reward_pre"]
      out.append(
        {k: r[k] for k in ("stream", "arm", "seed", "reward_final")}
        | {
          "reward_none": final,
          "reward_pre": pre,
          "reward_reference": reference[seed],
          "reference": word,
          "normalised": normalise(r["reward_final"], final, reference[seed], pre, least),
        }
      )
  return out


def summarise(scored: list[dict]) -> dict:
  """Per arm: seeds with a defined value, seeds without, IQM of normalised recovery with its
  bootstrap interval.
  """
  out = {}
  for arm in dict.fromkeys(r["arm"] for r in scored):
    own = [r["normalised"] for r in scored if r["arm"] == arm]
    values = [x for x in own if x is not None]
    out[arm] = {
      "seeds": len(values),
      "undefined": len(own) - len(values),
      "normalised": float(intervals.iqm(values)) if values else None,
      "normalised_ci": intervals.interval(values) if values else None,
    }
  return out


def difference(scored: list[dict], method: str, other: str) -> dict:
  """Paired difference of two arms, method - other: IQM over the seeds in which both are defined,
  with its 95 % bootstrap interval over seeds.

  Returns:
    {seeds, difference, difference_ci, holds_zero}; holds_zero None without an interval.
  """
  of = lambda arm: {
    r["seed"]: r["normalised"] for r in scored if r["arm"] == arm and r["normalised"] is not None
  }
  a, b = of(method), of(other)
  values = [a[seed] - b[seed] for seed in a if seed in b]
  ci = intervals.interval(values) if values else None
  return {
    "seeds": len(values),
    "difference": float(intervals.iqm(values)) if values else None,
    "difference_ci": ci,
    "holds_zero": None if ci is None or None in ci else ci[0] <= 0 <= ci[1],
  }
