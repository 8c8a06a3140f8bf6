"""What a log says: has it changed, when, where, and how sure is that.

Alarms of the charts that lie closer together than the refractory time are one event. An event is
believed where a healthy log of this length would show as much less than DOUBT times, by the tails
of `charts`; the columns it names (`blame`) are the few that, moved by themselves, would move the
residuals so.
"""

from typing import Any, NamedTuple

import numpy as np

from mjx_cl.logs import blame, charts, healthy
from mjx_cl.logs.charts import CHARTS, SPANS

DOUBT = 0.01  # expected number of such events in a healthy log, above which one is not believed
FACTOR = 1.2  # of a spread, below which it is not said to have changed
SHIFT = 3.0  # healthy deviations of the longest average in use, above which a mean has moved
NOISY = 2.0  # healthy deviations beyond which residuals scatter so much that a mean means less
LASTING = 0.8  # of the samples that are looked at, beyond which a shift is taken to last
ROWS = 50_000  # of a large log watched at a time
LARGE = 10_000_000  # samples of all columns from which a log is watched so and kept in 16 bits
WARM = 40  # longest averages of the rows before that such a part begins with; e^-80 is left of more
TOP = 6e4  # highest score that is kept in 16 bits


class Watch(NamedTuple):
  """A calibrated model of a nominal log.

  Attributes:
    model: see healthy.
    scales: of the charts.
    tails: chart -> distribution of its healthy maxima.
    thresholds: chart -> (W,), of `joint` (1,).
    unseen: (2, N, W) residuals of the nominal log.
    means: (W, W) inverse covariance of the healthy averages over the middle span, or the longest
      that is used.
  """

  model: healthy.Healthy
  scales: charts.Scales
  tails: dict[str, charts.Tail]
  thresholds: dict[str, np.ndarray]
  unseen: np.ndarray
  means: np.ndarray


def calibrated(past: np.ndarray, arl0: float, model: str = "ar", commands: int = 0) -> Watch:
  """Watches for what deviates from a nominal log (N, C), missing samples nan, each chart with one
  alarm in `arl0` healthy samples on average; the last `commands` columns are not watched, W others
  are.
  """
  fitted, unseen = healthy.fit(past, model, commands)
  scales = charts.scales(unseen)
  tails = {name: charts.tail(score) for name, score in charts.scores(unseen, scales).items()}
  thresholds = {name: tail.threshold(arl0) for name, tail in tails.items()}
  middle = scales.joint[min(1, charts.used(unseen.shape[1]) - 1)]
  return Watch(fitted, scales, tails, thresholds, unseen, middle)


class Found(NamedTuple):
  """What the charts show of a log.

  Attributes:
    residuals: (2, T, W).
    scores: chart -> (T, W), of `joint` (T, 1).
    fired: chart -> bool, likewise: the score rises above its threshold.
    above: bool (T,), some score is.
    known: bool (T, W), the sample is judged.
    xs: (T, C) the log.
  """

  residuals: np.ndarray
  scores: dict[str, np.ndarray]
  fired: dict[str, np.ndarray]
  above: np.ndarray
  known: np.ndarray
  xs: np.ndarray


def watch(own: Watch, xs: np.ndarray) -> Found:
  """Of a log (T, C), in which missing samples are nan; nothing is judged where too many are."""
  return _watch(own, xs) if xs.size <= LARGE else _in_parts(own, xs)


def _watch(own: Watch, xs: np.ndarray) -> Found:
  judged = _residuals(own, xs, healthy.FARTHEST)
  residuals = healthy.unsettled(own.model, judged)
  scores = charts.scores(residuals, own.scales)
  fired = {name: charts.alarms(x, own.thresholds[name]) for name, x in scores.items()}
  above = [(x > own.thresholds[name]).any(1) for name, x in scores.items()]
  known = np.isfinite(judged).any(0)
  known &= ~healthy.absent(xs, own.model.held)[:, : own.model.watched]
  settling = slice(0, max(*healthy.NOW, *healthy.BEFORE))
  known[settling] = healthy.known(xs[settling], own.model.held)[:, None]
  return Found(residuals, scores, fired, np.any(above, 0), known, xs)


def _residuals(own: Watch, xs: np.ndarray, farthest: float) -> np.ndarray:
  """(2, T, W) of a log (T, C), cut at `farthest` deviations."""
  z, error = healthy.filled(own.model, healthy.standard(own.model, healthy.held(xs)), xs)
  residuals = healthy.residuals(own.model, z, error=error, farthest=farthest)
  return healthy.judged(own.model, residuals, xs, error)


def _around(own: Watch) -> tuple[int, int]:
  """Rows that a part of a log is watched with, before it and after it, so that no average knows the
  difference.
  """
  warm = WARM * max(SPANS[-1], own.model.slow if own.model.drifts.any() else 0)
  return warm, int(own.model.held.max()) + max(*healthy.NOW, *healthy.BEFORE) + 1


def _in_parts(own: Watch, xs: np.ndarray, rows: int = ROWS, kind: Any = np.float16) -> Found:
  """`watch` of `rows` rows at a time; residuals and scores are kept as `kind`."""
  warm, ahead = _around(own)
  total, columns = len(xs), own.model.watched
  size = {name: 1 if name == "joint" else columns for name in CHARTS}
  found = Found(
    np.empty((2, total, columns), kind),
    {name: np.empty((total, n), kind) for name, n in size.items()},
    {name: np.empty((total, n), bool) for name, n in size.items()},
    np.empty(total, bool),
    np.empty((total, columns), bool),
    xs,
  )
  for begin in range(0, total, rows):
    from_ = max(0, begin - warm)
    part = _watch(own, np.ascontiguousarray(xs[from_ : begin + rows + ahead], np.float64))
    at, new = slice(begin, begin + rows), slice(begin - from_, begin - from_ + rows)
    found.residuals[:, at] = part.residuals[:, new]
    for name in CHARTS:
      found.scores[name][at] = np.minimum(part.scores[name][new], TOP)
      found.fired[name][at] = part.fired[name][new]
    found.above[at], found.known[at] = part.above[new], part.known[new]
  return found


def cross_validated(own: Watch, arl0: float) -> tuple[int, float]:
  """(events in the nominal log, expected ones): each fifth watched with thresholds from the others,
  alarms closer than the longest span counted once for each chart.
  """
  healthy_scores, count = charts.scores(own.unseen, own.scales), 0
  shares = healthy.folds(own.unseen.shape[1])
  for score in healthy_scores.values():
    for share in shares:
      rest = np.delete(score, np.r_[share], axis=0)
      threshold = charts.tail(rest).threshold(arl0)
      at = np.flatnonzero(charts.alarms(score[share], threshold).any(1))
      count += len(_events(at, SPANS[-1]))
  return count, len(CHARTS) * own.unseen.shape[1] / arl0


def _events(at: np.ndarray, refractory: int) -> list[np.ndarray]:
  """Samples of alarms, those of one event together."""
  if not len(at):
    return []
  return np.split(at, np.flatnonzero(np.diff(at) > refractory) + 1)


def _begin(x: np.ndarray, at: int) -> int:
  """First sample of a shift of x (T,) that was noticed at `at`: where the cumulative sum of x less
  half of the shift was lowest (Page 1954), within four of the longest spans before.
  """
  shift = _shift(x[at : at + SPANS[-1]].astype(float))
  from_ = max(0, at - 4 * SPANS[-1])
  moved = np.nan_to_num(x[from_:at] * np.sign(shift)) - abs(shift) / 2
  return from_ + int(np.argmin(np.r_[0.0, np.cumsum(moved)]))


def _series(own: Watch, found: Found, chart: str, c: int, at: int) -> np.ndarray:
  """(T,) what shifted when a chart noticed it."""
  if chart == "spread":
    energy = [
      charts.logs(r[:, c]) - m[-1, c] for r, m in zip(found.residuals, own.scales.spread[0])
    ]
    near = slice(at, at + SPANS[-1])
    return max(energy, key=lambda x: abs(np.nan_to_num(x[near]).mean()))
  if chart == "joint":
    c = int(np.argmax(found.scores["level"][at]))
  return found.residuals[0][:, c]


def _whole(own: Watch, found: Found, begin: int, end: int) -> np.ndarray:
  """(2, end - begin, W) residuals that are not cut: a cut one hides how far its column moved, and
  which column moved it.
  """
  cut = found.residuals[:, begin:end].astype(float)
  if not (np.abs(cut) >= healthy.FARTHEST).any():
    return cut
  warm, ahead = _around(own)
  from_ = max(0, begin - warm)
  part = np.ascontiguousarray(found.xs[from_ : end + ahead], np.float64)
  whole = _residuals(own, part, np.inf)[:, begin - from_ : end - from_]
  return np.where(np.abs(cut) >= healthy.FARTHEST, whole, cut)


def _shift(x: np.ndarray) -> float:
  """Mean of x (T,) over the first samples of that one of SPANS over which it stands out most."""
  means = [(np.nanmean(p), np.isfinite(p).sum()) for s in SPANS if np.isfinite(p := x[:s]).any()]
  return float(max(means, key=lambda m: m[0] ** 2 * m[1], default=(0.0, 0))[0])


def _lasts(x: np.ndarray) -> int:
  """Samples for which a shift of x (T,) lasts: to where the cumulative sum of x less half of it is
  highest; all where that is near the end.
  """
  shift = _shift(x)
  rise = np.cumsum(np.nan_to_num(x) * np.sign(shift) - abs(shift) / 2)
  last = max(SPANS[0], int(np.argmax(rise)) + 1)
  return last if last <= LASTING * len(x) else len(x)


def _followed(own: Watch, since: int, rows: int) -> float:
  """Mean share of a shift that a drifting column's residual still shows, in `rows` rows from the
  one `since` rows after it: its average (`healthy.standard`) follows it.
  """
  keep, k = 1 - 2 / (own.model.slow + 1), np.arange(since, since + rows) + 1
  return max(0.1, float((keep**k * (1 - k * (1 - keep))).mean()))


def _mean(own: Watch, names: list[str], c: int, by: float) -> dict[str, Any]:
  """A column whose mean moved by so many deviations."""
  amount = float(by * own.model.spread[c])
  return {"column": names[c], "how": "mean", "by": amount, "deviations": float(by)}


def _where(
  own: Watch, found: Found, since: int, begin: int, end: int, chart: str, c: int, names: list[str]
) -> list[dict[str, Any]]:
  """Columns that an event is in: those whose mean moved by more than what scatters more besides,
  else the one whose error explains most.

  Args:
    own: the watch.
    found: by it.
    since: first sample of the event.
    begin: its first alarm.
    end: of the samples that are looked at.
    chart: that was the first to be sure.
    c: its column.
    names: of all columns.
  """
  whole = _whole(own, found, begin, end)
  x, rows = np.nan_to_num(whole[0]), end - begin
  if chart != "spread":
    rows = _lasts(x[:, c if chart == "level" else int(np.argmax(np.abs(x.mean(0))))])
  x, share = x[:rows], np.sqrt(rows / (end - begin))
  scatter = x.std(0)
  scatter[scatter < NOISY] = 1.0
  shift = x.mean(0) * share * min(1.0, (end - begin) / SPANS[1])
  columns = []
  for k, by in blame.moved(own.model, own.means / np.outer(scatter, scatter), shift):
    by /= share * (_followed(own, begin - since, rows) if own.model.drifts[k] else 1.0)
    columns.append(_mean(own, names, k, by))
  if columns:
    return columns
  excess = found.scores["spread"][begin:end].max(0) / own.thresholds["spread"]
  order = [int(k) for k in np.argsort(-excess)]
  if excess[order[0]] < 1:
    by = float(x[:, c].mean() * own.model.scale[0, c])
    return [_mean(own, names, c, by)] if chart == "level" else []
  logs = charts.logs(whole[0, np.isfinite(whole[0, :, order[0]]), order[0]])
  if len(logs) and logs.mean() < own.scales.spread[0, 0, -1, order[0]]:  # less is going on there
    named = [k for k in order[: blame.MOST] if excess[k] >= max(1.0, 0.5 * excess[order[0]])]
  else:
    named = [blame.erring(own.model, whole[0], order[: blame.TRIED])]
  columns = [{"column": names[k]} | _how(own, whole[:, :, k], k) for k in named]
  clear = [column for column in columns if column["how"] != "course"]
  return clear or columns[:1]


def _how(own: Watch, whole: np.ndarray, c: int) -> dict[str, Any]:
  """What happened to a column whose spread was noticed, by its residuals (2, T): a factor of what
  others or its past do not foretell, or else a shift, or else another course in time.
  """
  factors, shift = [1.0, 1.0], 0.0
  for k, (before, now) in enumerate(zip(own.unseen[:, :, c], whole)):
    if np.isfinite(now).sum() > 1:
      factors[k] = float(np.nanstd(now) / np.nanstd(before))
      shift = float(np.nanmean(now)) if k == 0 else shift
  clear = [not 1 / FACTOR < factor < FACTOR for factor in factors]
  longest = charts.used(own.unseen.shape[1]) - 1
  if not clear[0] and abs(shift) > SHIFT * own.scales.level[longest, c]:
    by = shift * float(own.model.scale[0, c])
    return {"how": "mean", "by": by * float(own.model.spread[c]), "deviations": by}
  if any(clear):
    return {"how": "spread", "by": factors[clear.index(True)], "deviations": None}
  return {"how": "course", "by": None, "deviations": None}


def _sure(
  own: Watch, found: Found, within: slice, strongest: tuple[str, int], samples: int
) -> tuple[int, str, int]:
  """(sample of the event, chart, column) from which on an event is believed: the first score that
  is enough by itself; that of the `strongest` chart if it follows soon.
  """
  hits = []
  for name in CHARTS:
    enough = own.tails[name].threshold(len(CHARTS) * samples / DOUBT)
    ratio = found.scores[name][within] / enough
    if (over := (ratio > 1).any(1)).any():
      at = int(np.argmax(over))
      hits.append((at, name, int(np.argmax(ratio[at]))))
  if not hits:
    chart, c = strongest
    return int(np.argmax(found.scores[chart][within, c])), chart, c
  first = min(hits)
  return next((h for h in hits if h[1] == strongest[0] and h[0] <= first[0] + SPANS[1]), first)


def judge(own: Watch, found: Found, names: list[str], refractory: int) -> list[dict[str, Any]]:
  """Events of a log, in order of time.

  Returns:
    each with begin, first_alarm and end (samples), charts (which gave an alarm), expected
    (events as clear in a healthy log of this length), believed and columns.
  """
  samples = len(found.residuals[0])
  events = []
  for at in _events(np.flatnonzero(found.above), refractory):
    within = slice(at[0], at[-1] + 1)
    expected, strongest = np.inf, ("joint", 0)
    for name in CHARTS:
      highest = found.scores[name][within].max(0).astype(float)
      rates = own.tails[name].expected(highest, samples)
      if rates.min() < expected:
        expected, strongest = float(rates.min()), (name, int(rates.argmin()))
    peak, chart, c = _sure(own, found, within, strongest, samples)
    below = np.flatnonzero(found.scores[chart][within, c][:peak] <= own.thresholds[chart][c])
    first = int(at[0]) + (int(below[-1]) + 1 if len(below) else 0)
    begin = _begin(_series(own, found, chart, c, first), first)
    end = min(samples, first + SPANS[-1])
    events.append(
      {
        "begin": begin,
        "first_alarm": first,
        "end": int(at[-1]) + 1,
        "charts": [name for name in CHARTS if found.fired[name][within].any()],
        "expected": expected * len(CHARTS),
        "believed": expected * len(CHARTS) < DOUBT,
        "columns": _where(own, found, begin, first, end, chart, c, names),
      }
    )
  return events


class Times(NamedTuple):
  """The clock of a log.

  Attributes:
    seconds: (T,) since the first sample, or None.
    rate: samples per second, or None.
    places: see gaps; None where no row is missing.
  """

  seconds: np.ndarray | None
  rate: float | None
  places: np.ndarray | None = None

  def samples(self, seconds: float | None, otherwise: int) -> int:
    """A time in samples; of a log without a clock it is given in samples."""
    return otherwise if seconds is None else max(1, round(seconds * (self.rate or 1.0)))


def together(events: list[dict], more: list[dict], refractory: int) -> list[dict]:
  """Events and those that another model gives, in order of time, less those of the latter that lie
  within the refractory time of a believed one.
  """
  near = lambda one, other: (
    other["begin"] - refractory <= one["end"] and one["begin"] <= other["end"] + refractory
  )
  sure = [event for event in events if event["believed"]]
  more = [event for event in more if not any(near(event, other) for other in sure)]
  return sorted([*events, *more], key=lambda event: event["begin"])


def summary(own: Watch, events: list[dict], names: list[str], times: Times, arl0: float) -> dict:
  """What detect.json holds of events of `judge`: verdict, events, false_alarms, model."""
  for event in events:
    if times.places is not None:
      for what in ("begin", "first_alarm", "end"):
        event[what] = int(np.searchsorted(times.places, event[what]))
    known = times.seconds is not None
    event["begin_s"] = float(times.seconds[event["begin"]]) if known else None  # type: ignore[index]
  believed = [event for event in events if event["believed"]]
  counted, wanted = cross_validated(own, arl0)
  return {
    "verdict": {
      "changed": bool(believed),
      "charts": len(believed[0]["charts"]) if believed else 0,
      "of": len(CHARTS),
      **(
        {k: believed[0][k] for k in ("expected", "begin", "begin_s", "columns")} if believed else {}
      ),
    },
    "events": events,
    "false_alarms": {"counted": counted, "expected": wanted},
    "model": {
      "explained": dict(zip(names, np.round(own.model.explained[0], 3).tolist())),
      "drifts": [name for name, drifts in zip(names, own.model.drifts) if drifts],
    },
  }
