"""What the finished parts of a suite say together.

OUT/bench.parquet holds all rows of their runs.parquet with part and agent in front, OUT/bench.json
their summaries, what the arms of each say together (`scores`) and, where parts differ in their
agent alone, what these say together (`agents`), OUT/recovery.png the Kaplan-Meier curves of
recovery, OUT/ratio.png recovery against train ratio where a suite has several.
"""

import pathlib
from typing import Any

from mjx_cl.adapt.arms import ARMS, ONSET
from mjx_cl.errors import FileError, UserError
from mjx_cl.io import folders, tables
from mjx_cl.render import figures
from mjx_cl.runs.suite import Part, Suite, by_agent, standing
from mjx_cl.runs.summary import HEAD, over_agents
from mjx_cl.scoring import ablation, normalised_recovery, survival

HORIZON = 10_000  # control steps after the onset, of the restricted mean time to recovery
# chunks over which signals must be settled, of the stop rule without its floor
PATIENCES = (48, 24, 12)


def scores(folder: pathlib.Path) -> dict:
  """What several arms of one finished part say together.

  Returns:
    normalised: arm -> recovery, 0 = arm `none`, 1 = reward_pre (normalised_recovery.summarise);
      null without arm `none`.
    against_oracle: paired difference of `detector` and `oracle` in it
      (normalised_recovery.difference); null without both arms.
    recovery: arm -> `recovery` of its streams.
    ablation: the stop rule with each signal left out (scoring.ablation); only where an arm that
      never stops has adapted.
    without_floor: patience [chunks], as text -> the same without the floor of `least` control
      steps, so that the signals alone decide.
  """
  config, rows = tables.read_json(folder / "config.json"), tables.read_rows(folder / "runs.parquet")
  arms, steps = config["arms"], config["steps"]
  scored = normalised_recovery.rows(rows) if "none" in arms else []
  both = scored and {"detector", "oracle"} <= set(arms)
  out: dict[str, Any] = {
    "normalised": normalised_recovery.summarise(scored) or None,
    "against_oracle": normalised_recovery.difference(scored, "detector", "oracle")
    if both
    else None,
    "recovery": {},
  }
  if (folder / "signals.parquet").exists():
    try:
      out["ablation"] = ablation.ablated(ablation.ablation(folder))
      out["without_floor"] = {
        str(n): ablation.ablated(ablation.ablation(folder, least=1, patience=n)) for n in PATIENCES
      }
    except FileError:
      raise
    except UserError:  # no stream has adapted
      pass
  # no longer than the first stream is watched
  watched = zip(survival.watched(rows, steps), rows)
  seen = [w for w, r in watched if w is not None and not r["change"]]
  for arm in arms:
    own = [r for r in rows if r["arm"] == arm]
    out["recovery"][arm] = recovery(own, steps, min([HORIZON, *seen]))
  return out


def recovery(rows: list[dict], steps: int, horizon: int) -> dict | None:
  """Kaplan-Meier of an arm's affected streams: n, recovered, median_steps, restricted_mean_steps up
  to `horizon` control steps after the onset, each with _ci; None without affected streams.

  Args:
    rows: of runs.parquet.
    steps: of the run.
    horizon: control steps.
  """
  first = [r for r in rows if not r["change"]]
  if not any(r["affected"] for r in first):
    return None
  later = [r | {"affected": False} for r in rows if r["change"]]
  times, seen = survival.of_runs(first + later, steps)
  median, median_ci = survival.quantile(survival.kaplan_meier(times, seen))
  mean, mean_ci = survival.restricted_mean(times, seen, horizon) if horizon > 0 else (None, None)
  enough = len(seen) > 3  # three streams or fewer give no interval
  return {
    "n": len(seen),
    "recovered": int(seen.sum()),
    "median_steps": median,
    "median_steps_ci": median_ci if enough else None,
    "restricted_mean_steps": mean,
    "restricted_mean_steps_ci": mean_ci if enough else None,
    "horizon": horizon,
  }


def collect(
  out: pathlib.Path, plan: Suite, known: dict | None = None, kept: frozenset[str] = frozenset()
) -> dict:
  """Writes OUT/bench.parquet, OUT/bench.json, OUT/recovery.png and OUT/ratio.png from the finished
  parts and returns the second's value. What OUT holds of a part with other settings is left out,
  see `standing`.

  Args:
    out: folder of the suite.
    plan: the suite.
    known: part -> scores, of those that an earlier call has read, and what agents say together;
      filled here.
    kept: parts that count whatever their settings.
  """
  known = {} if known is None else known
  there = {p.name for p in standing(out, [p for p in plan.parts if p.name not in kept])[0]} | kept
  entries, rows = {}, []
  for part in (p for p in plan.parts if p.name in there):
    folder = out / part.name
    if part.name not in known:
      known[part.name] = scores(folder)
    entries[part.name] = tables.read_json(folder / "summary.json") | {"scores": known[part.name]}
    before = {
      "suite": plan.name,
      "part": part.name,
      "robot": part.config.env,
      "agent": part.config.agent,
      "severity_asked": part.config.severity,
      "ratio": part.config.adapt.ratio,
    }
    rows += [before | row for row in tables.read_rows(folder / "runs.parquet")]
  value = {
    "suite": plan.name,
    "parts": len(plan.parts),
    "finished": len(entries),
    "entries": entries,
  }
  if agents := together(out, [p for p in plan.parts if p.name in there], known):
    value["agents"] = agents
  with folders.together():
    if rows:
      names = dict.fromkeys(name for row in rows for name in row)
      table = {name: [row.get(name) for row in rows] for name in names}
      tables.write_table(out / "bench.parquet", table)
      draw(out, plan, value)
    tables.write_json(out / "bench.json", value)
  return value


def together(out: pathlib.Path, parts: list[Part], known: dict) -> dict[str, dict]:
  """What finished parts that differ in their agent alone say together, see `over_agents`; arguments
  as of `collect`.
  """
  value = {}
  for name, own in by_agent(parts).items():
    key = f"{name} of {', '.join(own)}"
    if key not in known:
      rows = {a: tables.read_rows(out / p.name / "runs.parquet") for a, p in own.items()}
      part = next(iter(own.values()))
      control_s = tables.read_json(out / part.name / "config.json")["control_s"]
      head = tables.read_json(out / part.name / "summary.json")
      known[key] = {k: head[k] for k in HEAD} | over_agents(rows, part.config, control_s)
    value[name] = known[key]
  return value


def draw(out: pathlib.Path, plan: Suite, value: dict) -> list[pathlib.Path]:
  """OUT/recovery.png and OUT/ratio.png, as far as there is something to draw, from the rows of
  OUT's parts and what bench.json holds, `value`. Returns the files.
  """
  points = [
    p
    for part in plan.parts
    if part.name in value["entries"]
    for p in _points(part, value["entries"][part.name]["scores"])
  ]
  files = (figures.survival(out, list(value["entries"])), figures.ratios(out, points))
  return [file for file in files if file]


def _points(part: Part, scores_: dict) -> list[dict]:
  """What figures.ratios draws of a part: its arms that start at the true onset."""
  c = part.config
  return [
    {
      "line": f"{c.env}, {c.fault}"
      + ("" if c.severity is None else f" {c.severity:g}")
      + (f", {arm}" if sum(ARMS[a].trigger is ONSET for a in c.arms) > 1 else ""),
      "ratio": c.adapt.ratio,
      "mean": own["restricted_mean_steps"],
      "ci": own["restricted_mean_steps_ci"],
      "n": own["n"],
      "recovered": own["recovered"],
    }
    for arm, own in scores_["recovery"].items()
    if own and own["restricted_mean_steps"] is not None and ARMS[arm].trigger is ONSET
  ]
