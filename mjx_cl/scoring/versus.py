"""Finished runs, or arms of one, against each other: interquartile means, paired differences and
performance profiles (Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the
Statistical Precipice").
"""

import pathlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from mjx_cl.config import own_agent
from mjx_cl.errors import FileError, UserError, require
from mjx_cl.io import tables
from mjx_cl.scoring import intervals, stop_rule

# name -> (what it is, whether more is better)
MEASURES: dict[str, tuple[str, bool]] = {
  "reward_final": ("reward a step over the last 2,000 steps", True),
  "reward_kept": ("that reward over the reward before the onset", True),
  "return_lost": ("return lost after the onset", False),
  "terminations": ("falls or crashes", False),
  "updates": ("gradient steps of the learner", False),
  "alarmed": ("share of streams that alarm after the onset", True),
  "latency_steps": ("control steps from the onset to the alarm, of those that alarm", False),
  "false_alarms": ("alarms before the onset", False),
  "recovered": ("share of affected streams that recover", True),
}
ALL = tuple(MEASURES)[:5]  # of a comparison that names none
SHARES = ("alarmed", "recovered")
NEEDED = frozenset({"arm", "seed", "reward_pre", "reward_final"})  # columns of runs.parquet
MUST_AGREE = (*stop_rule.SAME, "steps", "seeds", "first_seed")


class Variant(NamedTuple):
  """One arm of one run.

  Attributes:
    name: FOLDER:ARM.
    config: of the run.
    rows: seed -> row of runs.parquet, and lived: control steps from the change to the next one
      or the end.
  """

  name: str
  config: dict[str, Any]
  rows: dict[int, dict[str, Any]]


class Part(NamedTuple):
  """A run that several folders hold, or one with several arms.

  Attributes:
    name: folder of the run below that of the suite.
    found: its variants, the first the one that the others are compared with.
  """

  name: str
  found: list[Variant]


def _split(word: str) -> tuple[pathlib.Path, str]:
  """FOLDER or FOLDER:ARM -> folder, arm ("" where none is named); an arm may have colons of its
  own, FILE.py:make.
  """
  folders = [word[:i] for i, x in enumerate(word) if x == ":" and pathlib.Path(word[:i]).is_dir()]
  folder = word if pathlib.Path(word).is_dir() else (folders or [word.rpartition(":")[0]])[-1]
  return pathlib.Path(folder or word), word[len(folder) + 1 :] if folder else ""


def _runs(folder: pathlib.Path) -> dict[str, pathlib.Path]:
  """Finished runs below a folder that is none itself, by name; none of a run."""
  if (folder / "runs.parquet").is_file():
    return {}
  files = sorted(folder.glob("*/runs.parquet")) + sorted(folder.glob("*/*/runs.parquet"))
  return {file.parent.relative_to(folder).as_posix(): file.parent for file in files}


def parts(words: list[str], change: int = 0) -> list[Part]:
  """The runs that all of these folders of suites hold, each as `variants` reads it; [] where none
  of the words is such a folder.

  Raises:
    UserError: a run beside a folder of runs, no run that all of them hold, and as `variants`.
  """
  below = [_runs(home) for home, _ in map(_split, words)]
  if not any(below):
    return []
  if not all(below):
    lone = words[[bool(x) for x in below].index(False)]
    raise UserError(f"{lone} holds no runs of a suite, the others do; compare like with like")
  names = [name for name in below[0] if all(name in there for there in below)]
  if not names:
    raise UserError("these folders have no finished run of one name: " + ", ".join(words))
  arms = [arm for _, arm in map(_split, words)]
  label = lambda word, one: word if _split(word)[1] else f"{word}:{one.name.rpartition(':')[2]}"
  out = []
  for name in names:
    own = [f"{there[name]}:{arm}" if arm else str(there[name]) for there, arm in zip(below, arms)]
    found = variants(own, change)
    if len(words) > 1:
      found = [one._replace(name=label(word, one)) for word, one in zip(words, found)]
    out.append(Part(name, found))
  return out


def by(word: str, setting: str, change: int = 0) -> list[Part]:
  """The runs below a folder of a suite that differ in a setting that the suite varies, such as
  `detector`, against each other: a Part for each combination of the others.

  Args:
    word: FOLDER or FOLDER:ARM; without an arm `detector`.
    setting: as in the names of the runs, `detector=cusum,severity=0.5`.
    change: as of `variants`.

  Raises:
    UserError: a setting that no two runs differ in, and as `variants`.
  """
  home, arm = _split(word)
  groups: dict[str, dict[str, pathlib.Path]] = {}
  varied: set[str] = set()
  for name, folder in _runs(home).items():
    entry, _, last = name.rpartition("/")
    labels = last.split(",")
    varied |= {label.partition("=")[0] for label in labels if "=" in label}
    own = [label for label in labels if label.startswith(f"{setting}=")]
    if own:
      rest = ",".join(label for label in labels if label not in own)
      key = "/".join(filter(None, (entry, rest))) or "."
      groups.setdefault(key, {})[own[0]] = folder
  groups = {key: runs for key, runs in groups.items() if len(runs) > 1}
  if not groups:
    known = ", ".join(sorted(varied)) or "nothing"
    raise UserError(f"no two runs below {home} differ in {setting}; its parts vary {known}")
  out = []
  for key, runs in groups.items():
    found = variants([f"{folder}:{arm or 'detector'}" for folder in runs.values()], change)
    out.append(Part(key, [one._replace(name=label) for label, one in zip(runs, found)]))
  return out


def variants(words: list[str], change: int = 0) -> list[Variant]:
  """Reads FOLDER or FOLDER:ARM each; of one folder alone all of its arms, of several the arm that
  is their only one, or `detector`.

  Args:
    words: as above.
    change: of the robot, 0 the first; a later one is a repair or another fault.

  Raises:
    UserError: no run there, no such arm or change, other robots, fewer than two variants.
    FileError: files that are no run's.
  """
  found: list[Variant] = []
  seen: set[tuple[pathlib.Path, str]] = set()
  for home, arm in map(_split, words):
    if not (home / "runs.parquet").is_file() or not (home / "config.json").is_file():
      board = "; it holds a board: `mjx-cl query`" if (home / "methods.json").is_file() else ""
      raise UserError(f"{home} holds no finished run (no runs.parquet){board}")
    rows, config = tables.read_rows(home / "runs.parquet"), tables.read_json(home / "config.json")
    if not rows or NEEDED - rows[0].keys() or not isinstance(config.get("steps"), int):
      raise FileError(f"{home}: not a run's files")
    arms = list(dict.fromkeys(str(row["arm"]) for row in rows))
    chosen = [arm] if arm else arms if len(words) == 1 or len(arms) == 1 else ["detector"]
    for name in chosen:
      if name not in arms:
        raise UserError(f"{home} has no arm {name!r}; name one as FOLDER:ARM, of {', '.join(arms)}")
      of = lambda row: int(row.get("change", 0))  # which the first runs did not write
      last = max(map(of, rows))
      require(0 <= change <= last, f"{home}: --change must lie in 0..{last}; got {change}")
      ends = {r.get("stream"): r.get("onset") for r in rows if of(r) == change + 1}
      lived = lambda r: (ends.get(r.get("stream")) or config["steps"]) - (r.get("onset") or 0)
      mine = [r for r in rows if r["arm"] == name and of(r) == change]
      own = {int(r["seed"]): r | {"lived": lived(r)} for r in mine}
      label = name if len(words) == 1 else f"{home}:{name}"
      same = (home.resolve(), name)
      require(same not in seen, f"{label} is there twice; name another run or arm")
      seen.add(same)
      found.append(Variant(label, config, own))
  if len(found) < 2:
    raise UserError(f"{words[0]} has one arm; name another run to compare it with")
  robots = {str(one.config.get("env")) for one in found}
  if len(robots) > 1:
    raise UserError(f"runs of different robots cannot be compared: {', '.join(sorted(robots))}")
  # 1 is what a run has that is older than the versions
  versions = {str(one.config.get("benchmark", 1)) for one in found}
  if len(versions) > 1:
    raise UserError(
      f"runs of versions {', '.join(sorted(versions))} of the benchmark cannot be compared; run "
      "the older one anew"
    )
  return found


def unlike(found: list[Variant]) -> list[str]:
  """Settings in which the runs differ that a comparison would have alike."""
  default = {"agent": own_agent(str(found[0].config.get("env")))}
  own = [default | {k: v for k, v in one.config.items() if v is not None} for one in found]
  return [key for key in MUST_AGREE if len({str(config.get(key)) for config in own}) > 1]


def value(row: dict[str, Any], measure: str) -> float:
  """A measure of one stream, nan where it has none."""
  if measure == "reward_kept":
    before, after = row["reward_pre"], row["reward_final"]
    return after / before if before and before > 0 and after is not None else np.nan
  if measure in ("alarmed", "latency_steps") and row.get("adapting_at_onset"):
    return np.nan  # it was finetuning when the change came
  if measure == "alarmed" and "latency_steps" in row:
    return float(row["latency_steps"] is not None)
  if measure == "recovered" and "recovery_step" in row:
    return float(row["recovery_step"] is not None) if row.get("affected") else np.nan
  return np.nan if row.get(measure) is None else float(row[measure])


def _beside(row: dict[str, Any], first: dict[str, Any], measure: str) -> float:
  """A measure of one stream, as it is compared with the first variant's of the same seed: after the
  first change return is lost against one reward before it, that of the first, as a false alarm cuts
  a stream's own short; later each has another reward to lose.
  """
  found = value(row, measure)
  if row.get("change"):
    return found
  if measure == "return_lost" and None not in (row["reward_pre"], first["reward_pre"]):
    found += (first["reward_pre"] - row["reward_pre"]) * row["lived"]
  return found


def against(one: Variant, first: Variant, measure: str) -> dict[str, Any]:
  """A variant's measure and its difference from the first variant's, of `return_lost` after the
  first change that of the return earned.

  Returns:
    streams (one a seed), iqm and iqm_ci of the variant, of SHARES mean and mean_ci; pairs (of the
    same seed in both), difference (mean of variant - first over the pairs), difference_ci
    (bootstrap over pairs), better (share of the pairs in which the variant is better, ties half).
  """
  own = np.array([value(row, measure) for row in one.rows.values()])
  own = own[np.isfinite(own)]
  both = [
    (_beside(one.rows[k], first.rows[k], measure), value(first.rows[k], measure))
    for k in one.rows.keys() & first.rows.keys()
  ]
  pairs = np.array(sorted(p for p in both if np.isfinite(p).all())).reshape(-1, 2)
  gain = pairs[:, 0] - pairs[:, 1]
  sign = 1 if MEASURES[measure][1] else -1
  mean = lambda x, axis=-1: np.mean(x, axis)
  name, middle = ("mean", mean) if measure in SHARES else ("iqm", intervals.iqm)
  return {
    "variant": one.name,
    "measure": measure,
    "streams": len(own),
    name: float(middle(own)) if len(own) else None,
    f"{name}_ci": intervals.interval(own, middle),
    "pairs": len(gain),
    "difference": float(gain.mean()) if len(gain) else None,
    "difference_ci": intervals.interval(gain, mean),
    "better": float(np.mean((sign * gain > 0) + 0.5 * (gain == 0))) if len(gain) else None,
  }


def compare(found: list[Variant], measures: Sequence[str] = ALL) -> list[dict[str, Any]]:
  """Rows of `against` for every measure and variant, the first with itself included."""
  return [against(one, found[0], measure) for measure in measures for one in found]


def profile(one: Variant, levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """(share of streams that keep at least each level of their reward before the onset, its 95 %
  bootstrap interval (2, levels)).
  """
  kept = np.array([value(row, "reward_kept") for row in one.rows.values()])
  kept = kept[np.isfinite(kept)]
  if not len(kept):
    return np.full(len(levels), np.nan), np.full((2, len(levels)), np.nan)
  reached = kept[:, None] >= levels
  drawn = reached[intervals.draws(len(kept), 2000)].mean(1)
  return reached.mean(0), np.quantile(drawn, [0.025, 0.975], 0)
