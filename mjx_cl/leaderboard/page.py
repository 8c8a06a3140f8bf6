"""The leaderboard as one HTML file that needs no network: tables, plots and a page per fault, drawn
by assets/leaderboard.js.
"""

import base64
import json
import math
import pathlib
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from mjx_cl.errors import FileError, UserError
from mjx_cl.io import folders

ASSETS = pathlib.Path(__file__).parent / "assets"
REFERENCES = ("never", "always", "periodic", "random", "oracle")  # drawn in grey and not ranked
PROFILES = {"standard": "standard", "few_false": "few false alarms", "few_misses": "few misses"}
FAULT_KEYS = ("robot", "fault", "severity", "onset", "control_s", "channels", "alarms")
LIFE_KEYS = ("seed", "onset", "channels", "alarms")
POINT_KEYS = ("false_alarms_per_hour", "latency_mean_s", "detected")
DIGITS = 6  # significant digits that are embedded; the tables show three


class Column(NamedTuple):
  """One column of the tables.

  Attributes:
    key: of a row.
    label: of the header.
    kind: text, number, integer, share (shown in per cent), ratio or score.
    better: 1 where a higher figure is better, -1 where a lower one is, 0 where neither; the first
      click sorts the best to the top.
    help: tooltip of the header.
    core: shown before `all columns` is chosen.
    tables: `rows`, `overall` or both.
    few: flag of a row that marks the figure.
    noted: a figure above it is marked, and the row's note told at the mark.
  """

  key: str
  label: str
  kind: str
  better: int
  help: str
  core: bool = False
  tables: tuple[str, ...] = ("rows",)
  few: str | None = None
  noted: float | None = None


BOTH = ("rows", "overall")
SCORE = (
  "0: never alarms; 100: alarms at the onset of every fault and at no other time; negative: "
  "worse than no detector."
)
COLUMNS = (
  Column("detector", "Detector", "text", 0, "Name in the detector table", True, BOTH, "few"),
  Column("robot", "Robot", "text", 0, "Robot that the streams come from", True),
  Column(
    "fault", "Fault", "text", 0, "Fault that begins at the onset; the link opens its page", True
  ),
  Column(
    "severity", "Severity", "number", 0, "0: healthy, 1: the worst that the fault can do", True
  ),
  Column(
    "reward_lost", "Reward lost", "share", 0, "Share that the fault takes from a frozen robot"
  ),
  Column("cost_standard", "Cost score, standard", "score", 1, SCORE, True, BOTH),
  Column(
    "cost_costly",
    "Cost score, costly faults",
    "score",
    1,
    f"Over faults that take a tenth of the reward or more. {SCORE}",
    True,
    ("overall",),
  ),
  Column(
    "cost_few_false",
    "Cost score, few false alarms",
    "score",
    1,
    f"False alarms weigh more. {SCORE}",
    True,
    BOTH,
  ),
  Column(
    "cost_few_misses",
    "Cost score, few misses",
    "score",
    1,
    f"Misses weigh more. {SCORE}",
    True,
    BOTH,
  ),
  Column(
    "latency_median_s",
    "Median latency [s]",
    "number",
    -1,
    "Onset to first alarm, misses counted as later than all others; dash: half or more are missed",
    True,
  ),
  Column(
    "latency_median_steps", "Median latency [steps]", "number", -1, "The same in control steps"
  ),
  Column(
    "miss_probability",
    "Missed",
    "share",
    -1,
    "Share of streams without an alarm before the horizon",
    True,
    BOTH,
  ),
  Column(
    "detected_within_0.5s",
    "Detected in 0.5\u00a0s",
    "share",
    1,
    "Share of streams with an alarm at most 0.5 s after the onset",
  ),
  Column(
    "detected_within_1s",
    "Detected in 1\u00a0s",
    "share",
    1,
    "Share of streams with an alarm at most 1 s after the onset",
    True,
    BOTH,
  ),
  Column(
    "detected_within_5s",
    "Detected in 5\u00a0s",
    "share",
    1,
    "Share of streams with an alarm at most 5 s after the onset",
    True,
    BOTH,
  ),
  Column(
    "detected_within_20s",
    "Detected in 20\u00a0s",
    "share",
    1,
    "Share of streams with an alarm at most 20 s after the onset",
  ),
  Column(
    "mean_rank",
    "Mean rank",
    "number",
    -1,
    "Mean over robots, faults and severities of the rank by the standard cost score; 1 is best",
    True,
    ("overall",),
  ),
  Column(
    "false_alarms_per_hour",
    "False alarms per hour",
    "number",
    -1,
    "In healthy operation, per hour of robot time",
    True,
    few="arl0_few",
  ),
  Column(
    "arl0",
    "ARL0 [steps]",
    "number",
    0,
    "Healthy steps per alarm, with restarts",
    True,
    few="arl0_few",
  ),
  Column(
    "arl0_alarms", "Alarms behind ARL0", "integer", 0, "Alarms that the ARL0 was counted from"
  ),
  Column(
    "episode_alarm_probability",
    "Alarm in a healthy episode",
    "share",
    -1,
    "Share of healthy episodes with an alarm",
    few="arl0_few",
  ),
  Column("threshold", "Threshold", "number", 0, "Decision level after calibration", few="arl0_few"),
  Column(
    "auroc",
    "AUROC",
    "ratio",
    1,
    "Ranks scores sample by sample; says nothing about delay or false alarms in a row",
    True,
  ),
  Column(
    "efficiency",
    "Efficiency",
    "ratio",
    1,
    "Delay of the likelihood-ratio oracle / delay of this detector, at equal ARL0",
    True,
    noted=1.0,
  ),
  Column(
    "oracle_delay_steps",
    "Oracle delay [steps]",
    "number",
    0,
    "Delay of the likelihood-ratio test fitted on other seeds",
  ),
  Column(
    "optimal_delay_steps",
    "Optimal delay [steps]",
    "number",
    0,
    "Closed form; printed only where its assumptions hold",
  ),
  Column(
    "information_nats_per_step",
    "Information [nats/step]",
    "number",
    0,
    "Estimated divergence of faulty from healthy streams",
  ),
  Column(
    "us_per_sample",
    "Time per sample [µs]",
    "number",
    -1,
    (
      "Wall time of one update of one stream, beside the threads of other detectors on a shared "
      "machine; dash: not timed (oracles, files of scores)"
    ),
  ),
  Column("streams", "Streams", "integer", 0, "Streams that the row rests on"),
  Column("note", "Note", "text", 0, "What is to be known about the row"),
)


def write(
  path: pathlib.Path | str,
  rows: list[dict],
  overall: list[dict],
  curves: dict,
  faults: list[dict],
  meta: dict,
) -> None:
  """Writes the leaderboard to a temporary name and renames it. nan becomes null and is shown as a
  dash; infinity is refused.

  Args:
    path: of the file.
    rows: one dict per detector x robot x fault x severity, with every key of COLUMNS for `rows`;
      key_ci [low, high] or None is optional, and so is arl0_few, which marks figures that rest on
      fewer than 50 alarms; a figure above Column.noted needs a note.
    overall: one dict per detector, with every key of COLUMNS for `overall`, key_ci likewise.
    curves: {detector: {robot: [point, ...]}}, a point has POINT_KEYS.
    faults: dicts with FAULT_KEYS: onset [control steps], channels {name: values}, alarms {detector:
      control step or None}, the first from the onset on; value k of a channel belongs to control
      step first + k * every (optional keys, 0 and 1 where absent). Optional are early, {detector:
      control step} of the first alarm that is shown before the onset, seed, target, and others: the
      streams of further seeds, dicts with LIFE_KEYS, first, every, early and target likewise.
    meta: printed at the foot as it is, save for critical_difference (of mean ranks, or None),
      references (names drawn in grey, instead of REFERENCES) and notes (text, or a list of texts).

  Raises:
    UserError where a key or a note is missing or a figure is infinite; FileError where the file
    cannot be written.
  """
  _check(rows, overall, curves, faults)
  keys = list(dict.fromkeys(key for row in rows for key in row))
  data = {
    "columns": [c._asdict() for c in COLUMNS],
    "profiles": PROFILES,
    "references": meta.get("references", REFERENCES),
    "keys": keys,
    "rows": [[row.get(key) for key in keys] for row in rows],  # keys once: half the size
    "overall": overall,
    "curves": curves,
    "faults": [
      _packed(fault) | {k: [_packed(life) for life in fault[k]] for k in ("others",) if k in fault}
      for fault in faults
    ],
    "meta": {k: v for k, v in meta.items() if k != "references"},
  }
  text = _asset("leaderboard.html")
  for mark, part in (
    ("@CSS@", _asset("leaderboard.css")),
    ("@JS@", _asset("leaderboard.js")),
    ("@DATA@", embed(data)),  # the last, since a name may hold a mark
  ):
    text = text.replace(mark, part)
  folders.atomic(path, lambda file: file.write(text.encode()))


def _check(rows: list[dict], overall: list[dict], curves: dict, faults: list[dict]) -> None:
  """Refuses tables that lack a key or a note."""
  for i, row in enumerate(rows):
    _demand(f"row {i}", row, _keys("rows"))
    for c in COLUMNS:
      if c.noted is not None and (row[c.key] or 0) > c.noted and not row["note"]:
        raise UserError(
          f"page: row {i} of {row['detector']}: its {c.key} is above {c.noted:g}, and no "
          "note says why"
        )
  for i, row in enumerate(overall):
    _demand(f"overall {i}", row, _keys("overall"))
  for i, row in enumerate(faults):
    _demand(f"fault {i}", row, FAULT_KEYS)
    for j, life in enumerate(row.get("others", ())):
      _demand(f"fault {i}, other stream {j}", life, LIFE_KEYS)
  for detector, robots in curves.items():
    for robot, points in robots.items():
      for i, point in enumerate(points):
        _demand(f"curve of {detector} on {robot}, point {i}", point, POINT_KEYS)


def halves(values: Any) -> list:
  """[exponent, base64 text]: values = 2^exponent x IEEE 754 half floats, little-endian; a third of
  the size of JSON numbers of three digits. nan and None are nan.
  """
  x = np.array([math.nan if v is None else v for v in values], float)
  if np.isinf(x).any():
    raise UserError("page: a channel is infinite; give nan for what is undefined")
  exponent = math.frexp(np.max(np.abs(x[~np.isnan(x)]), initial=0.0))[1] - 15
  return [exponent, base64.b64encode(np.ldexp(x, -exponent).astype("<f2").tobytes()).decode()]


def _packed(life: dict) -> dict:
  """A stream with its channels as `halves`."""
  return life | {"channels": {str(c): halves(v) for c, v in life["channels"].items()}}


def embed(value: object) -> str:
  """JSON that may stand inside a script element: no <, > or & is left in it, so no name can end the
  element or open a comment.
  """
  text = json.dumps(_clean(value, "page"), allow_nan=False, separators=(",", ":"))
  return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _clean(value: Any, where: str) -> Any:
  """Plain Python values, floats of DIGITS digits, nan as None."""
  if hasattr(value, "tolist"):
    value = value.tolist()
  if isinstance(value, dict):
    return {str(k): _clean(v, f"{where}: {k}") for k, v in value.items()}
  if isinstance(value, (list, tuple)):
    return [_clean(v, where) for v in value]
  if isinstance(value, float):
    if math.isinf(value):
      raise UserError(f"{where}: infinite; give None for what is undefined")
    return None if math.isnan(value) else float(f"{value:.{DIGITS}g}")
  if value is None or isinstance(value, (str, int)):
    return value
  raise UserError(f"{where}: {type(value).__name__} is no JSON value")


def _keys(table: str) -> list[str]:
  return [c.key for c in COLUMNS if table in c.tables]


def _demand(where: str, row: dict, keys: Iterable[str]) -> None:
  missing = [key for key in keys if key not in row]
  if missing:
    raise UserError(f"page: {where} lacks {', '.join(missing)}")


def _asset(name: str) -> str:
  try:
    return (ASSETS / name).read_text(encoding="utf-8")
  except OSError as e:
    raise FileError(f"cannot read {ASSETS / name}: {e.strerror or e}") from None
