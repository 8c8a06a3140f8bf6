"""What is healthy: a linear model of the nominal log, and what a log deviates from it.

Each column is predicted twice by ridge regression: from the present and recent past of the other
columns (`others`: a sensor that is wrong stays wrong against its neighbours), and from the recent
past of all (`past`: what changes from one sample to the next), to which belongs the present of
commands, which predict and are not judged. Columns that drift while healthy,
such as a battery's voltage, are taken relative to a slow average of their own first. Which columns
predict which follows Gertler, "Fault Detection and Diagnosis in Engineering Systems" (1998),
chapter 4, with regression in place of a physical model.

A missing sample is filled with what `past` foretells, and the error of that widens the deviation in
which all that rests on it is measured; what would be measured in more than twice the healthy
variance is not judged.
"""

import warnings
from typing import NamedTuple

import numpy as np
from scipy import signal

from mjx_cl.errors import UserError

FOLDS = 5  # consecutive shares of the nominal log; what is said of one comes from the others
NOW = (0, 1, 2, 4, 8, 16)  # lags of other columns that predict a column
BEFORE = (1, 2, 3, 4, 8, 16)  # lags of all columns that predict all
RIDGES = (1e-4, 1e-2, 1.0, 100.0)  # tried, relative to the mean square of a feature
USEFUL = 0.05  # share of a column's variance that a prediction has to explain to be used
DRIFTS = 0.2  # share of a column's variance in the means of DRIFT_BLOCKS shares: above, it drifts
DRIFT_BLOCKS = 10
STRAIGHT = 0.8  # R^2 of a line through these means, above which little drift is drift
WILD, RARE = 200.0, 5e-4  # deviations of a nominal sample that is not believed; most of a column
SLOW = 1000  # samples of a drifting column's average, a tenth of the nominal log at most
# rows that a missing sample is replaced for; twice the usual distance of a column that is written
# less often than others
HELD = 3
DOUBTFUL = 0.5  # variance that filled samples may add to a residual, in its healthy variance
SURE, LOST = 0.5, 0.9  # errors of what is filled [nominal deviations]: after one row, at most
FARTHEST = 10.0  # deviations at which a residual is cut
ROWS = 20_000  # predicted at a time
MOST = 10_000_000  # samples of all columns of a nominal log that are used
MODELS = ("ar", "none")
REFITS = 2  # of the model, each with missing samples filled by the one before


class Healthy(NamedTuple):
  """A nominal log's model; C columns, of which the first W are watched, the rest commands.

  Attributes:
    watched: W.
    mean: (C,) of the nominal log.
    spread: (C,) its standard deviation.
    drifts: bool (C,), taken relative to its slow average.
    slow: samples of that average.
    held: (C,) rows that a missing sample is replaced for.
    others: (FOLDS + 1, len(NOW) * C, C) weights, each fold's from the other folds, the last from
      all.
    past: (FOLDS + 1, len(BEFORE) * C, C), likewise; where there are commands of lag 0 too.
    explained: (2, C) share of the variance that each prediction explains of folds it has not seen.
    middle: (2, W) mean of the residuals.
    scale: (2, W) their standard deviation.
    step: (C,) root mean square change from one row to the next, in deviations.
  """

  watched: int
  mean: np.ndarray
  spread: np.ndarray
  drifts: np.ndarray
  slow: int
  held: np.ndarray
  others: np.ndarray
  past: np.ndarray
  explained: np.ndarray
  middle: np.ndarray
  scale: np.ndarray
  step: np.ndarray


def held(x: np.ndarray) -> np.ndarray:
  """(T, C) with missing samples replaced by the last known one, before the first by the first."""
  at = np.where(np.isfinite(x), np.arange(len(x))[:, None], -1)
  at = np.maximum.accumulate(at, 0)
  first = np.isfinite(x).argmax(0)
  return np.take_along_axis(x, np.where(at < 0, first, at), 0)


def thinned(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """A nominal log (N, C) as it is used, and the row of each of its rows, -1 where there is none:
  all of it, or of one with more than MOST samples the middle of each fold, missing rows between.
  """
  rows, columns = x.shape
  if x.size <= MOST:
    return x, np.arange(rows)
  each = MOST // columns // FOLDS
  apart = np.full(int(usual(x[:each]).max()) + max(*NOW, *BEFORE) + 1, -1)
  begins = [(share.start + share.stop - each) // 2 for share in folds(rows)]
  at = np.concatenate([np.r_[begin : begin + each, apart] for begin in begins])
  return np.where(at[:, None] < 0, np.nan, x[at]).astype(np.float64), at


def usual(x: np.ndarray) -> np.ndarray:
  """(C,) `Healthy.held` of a nominal log."""
  each = [np.diff(np.flatnonzero(np.isfinite(column))) for column in x.T]
  gaps = np.array([np.median(gap) if len(gap) else 1.0 for gap in each])
  return np.maximum(HELD, np.ceil(2 * gaps)).astype(int)


def ages(x: np.ndarray) -> np.ndarray:
  """(T, C) rows since the last sample of x; before the first one, since the row before x."""
  rows, there = np.arange(len(x))[:, None], np.isfinite(x)
  if there.all():
    return np.zeros_like(x, int)
  return rows - np.maximum.accumulate(np.where(there, rows, -1), 0)


def _apart(x: np.ndarray, longest: np.ndarray) -> np.ndarray:
  """Bool (T,): rows of a stretch without any sample that is longer than `longest` (C,) and the
  longest lag; what comes after it begins anew.
  """
  whole, rows = ~np.isfinite(x).any(1), np.arange(len(x))
  if not whole.any():
    return whole
  ends = np.where(whole & ~np.r_[whole[1:], False], rows, len(x) - 1)
  end = np.minimum.accumulate(ends[::-1])[::-1]
  return whole & np.all(ages(x) > longest + max(*NOW, *BEFORE), 1)[end]


def known(x: np.ndarray, longest: np.ndarray) -> np.ndarray:
  """Bool (T,): rows of x (T, C) whose predictions do not reach into stretches that set them
  `_apart`, from `longest` (C,) rows after the last sample on.
  """
  nothing = _apart(x, longest)
  if not nothing.any():
    return ~nothing
  nothing &= (ages(x) > longest).all(1)
  reach = np.cumsum(np.r_[0, nothing])
  begin = np.maximum(0, np.arange(len(x)) - max(*NOW, *BEFORE))
  return reach[1:] == reach[begin]


def absent(x: np.ndarray, longest: np.ndarray) -> np.ndarray:
  """Bool (T, C): samples of x that are missing where a healthy log has one; not those of a column
  that is seldom written, nor of stretches that set rows `_apart`.
  """
  missing = ages(x) > np.where(longest > HELD, longest, 0)
  return missing & ~_apart(x, longest)[:, None]


def since(model: Healthy, x: np.ndarray) -> np.ndarray:
  """(T, W) rows since the sample whose residual stands at one of x (T, C): where a healthy log has
  none either, the last one.
  """
  own, rows = x[:, : model.watched], np.arange(len(x))[:, None]
  return np.where(absent(x, model.held)[:, : model.watched], 0, np.minimum(ages(own), rows))


def filled(model: Healthy, z: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
  """Z of `standard`, what is `absent` in x (T, C) filled, and the deviation (T, C) of the error of
  that, 0 where there is a sample; None where nothing is filled.

  By the prediction from the past, or where that errs more, as for commands, by the last sample;
  once the longest lag is over, nothing is known of it but the nominal mean.
  """
  missing = absent(x, model.held)
  if not missing.any():
    return z, None
  age, own, error = ages(x), model.watched, missing.astype(float)
  lags, weights = np.array(_before(own, z)), model.past[-1].reshape(-1, *[len(model.mean)] * 2)
  near = missing & (age <= model.held + max(*NOW, *BEFORE))
  z = np.where(missing & ~near, 0.0, z)
  step = np.minimum(1.0, model.step * np.sqrt(age))
  foretold = np.r_[model.scale[1] < model.step[:own], np.zeros(len(model.mean) - own, bool)]
  error = np.where(near & ~foretold, step, error)
  near &= foretold
  for t in np.flatnonzero(near.any(1)):
    at, columns = np.maximum(t - lags, 0), np.flatnonzero(near[t])
    used = weights[:, :, columns]
    z[t, columns] = np.einsum("lc,lck->k", z[at], used) + model.middle[1, columns]
    doubt = np.einsum("lc,lck->ck", error[at], np.abs(used))
    error[t, columns] = np.minimum(1.0, np.sqrt(model.scale[1, columns] ** 2 + (doubt**2).sum(0)))
  return z, error


def completed(model: Healthy, x: np.ndarray) -> np.ndarray:
  """(T, C) `held`, and what is `absent` of columns that do not drift as it is `filled`."""
  known_last = held(x)
  z, error = filled(model, standard(model, known_last), x)
  if error is None:
    return known_last
  return np.where((error > 0) & ~model.drifts, model.mean + model.spread * z, known_last)


def _added(
  weights: np.ndarray, lags: tuple[int, ...], error: np.ndarray, scale: np.ndarray
) -> np.ndarray:
  """Variance (T, W) that errors (T, C) of the features add to a prediction, in squares of `scale`
  (W,): those of one column as if they were one, those of several independent.
  """
  found = np.zeros((len(error), len(scale)))
  by_column = np.abs(weights.reshape(len(lags), -1, weights.shape[-1])[..., : len(scale)])
  at = np.maximum(np.arange(len(error))[:, None] - np.array(lags), 0)
  for c in np.flatnonzero(error.any(0)):
    found += (error[at, c] @ by_column[:, c]) ** 2
  return found / scale**2


def judged(
  model: Healthy, residuals: np.ndarray, x: np.ndarray, error: np.ndarray | None = None
) -> np.ndarray:
  """Residuals (2, T, W) of x (T, C), nan in rows that are not `known` and where a sample is
  `absent`; but a column that its past alone foretells keeps what was `filled`, unless with too
  large an error (SURE, LOST), as an average of a swing must not miss a part of it. Where a healthy
  log has no sample either they are those of the last one.
  """
  own, reach = x[:, : residuals.shape[-1]], max(*NOW, *BEFORE)
  missing = absent(x, model.held)[:, : own.shape[1]]
  at = np.arange(len(x))[:, None] - since(model, x)
  found = np.take_along_axis(residuals, at[None], 1)
  found[:, ~known(x, model.held)] = np.nan
  found[1, missing] = np.nan
  if error is not None:
    sure = ~np.any(model.others, (0, 1))[: own.shape[1]] & (model.scale[1] < SURE)
    missing = missing & (~sure | (error[:, : own.shape[1]] > LOST))
  found[0, missing] = np.nan
  found[:, :reach] = np.nan
  return found


def unsettled(model: Healthy, residuals: np.ndarray) -> np.ndarray:
  """Residuals (2, T, W) of a log, those of its first rows widened by what the average of a drifting
  column, which begins anew with a log, may still be off: e^(-2 t / slow) deviations; nan where that
  is too much.
  """
  if not model.drifts.any():
    return residuals
  found, own = residuals.copy(), model.watched
  rows = min(found.shape[1], model.slow)
  error = np.where(model.drifts, np.exp(-2 * np.arange(rows) / model.slow)[:, None], 0.0)
  used = (model.others, NOW), (model.past, _before(own, error))
  for one, scale, (weights, lags) in zip(found, model.scale, used):
    more = _added(weights[-1], lags, error, scale) + (error[:, :own] / scale) ** 2
    one[:rows] /= np.sqrt(1 + more)
    one[:rows][more > DOUBTFUL] = np.nan
  return found


def plausible(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """A nominal log (N, C) without its wild samples, which would set the scale of their columns, and
  how many there are (C,): those more than WILD deviations (1.4826 x the median absolute one) from
  the median, where they are no more than RARE of a column.
  """
  with np.errstate(invalid="ignore", over="ignore"), warnings.catch_warnings():
    warnings.simplefilter("ignore", RuntimeWarning)  # a column without a sample
    off = np.abs(x - np.nanmedian(x, 0))
    wild = off > WILD * 1.4826 * np.nanmedian(np.where(off > 0, off, np.nan), 0)
  wild &= wild.sum(0) <= np.maximum(1, RARE * len(x))
  return np.where(wild, np.nan, x) if wild.any() else x, wild.sum(0)


def _levelled(x: np.ndarray, drifts: np.ndarray, slow: int) -> np.ndarray:
  """X (..., T, C) with the drifting columns relative to a slow average of their own: twice the
  exponentially weighted one over `slow` samples less the average of that, which follows a straight
  line without lag; both begin with the mean of the first tenth of `slow`.
  """
  if not drifts.any():
    return x
  x, rate = x.copy(), 2 / (slow + 1)
  own = x[..., drifts]
  begin = own[..., : max(1, slow // 10), :].mean(-2, keepdims=True)
  average = lambda y: signal.lfilter([rate], [1, rate - 1], y, -2, (1 - rate) * begin)[0]
  once = average(own)
  x[..., drifts] = own - 2 * once + average(once)
  return x


def standard(model: Healthy, x: np.ndarray) -> np.ndarray:
  """Samples (..., T, C), none missing, in nominal deviations, without drift."""
  with np.errstate(over="ignore"):
    z = np.clip((x - model.mean) / model.spread, -1e6, 1e6)
  return _levelled(z, model.drifts, model.slow)


def lagged(z: np.ndarray, lags: tuple[int, ...]) -> np.ndarray:
  """(..., T, len(lags) * C): z at each lag in turn, the first sample where there is none."""
  at = np.maximum(np.arange(z.shape[-2])[:, None] - np.array(lags), 0)
  return z[..., at, :].reshape(*z.shape[:-1], -1)


def _predicted(weights: np.ndarray, lags: tuple[int, ...], z: np.ndarray) -> np.ndarray:
  """Prediction of the columns of `weights` (F, W) from z (T, C) or (B, T, C)."""
  if not weights.any():
    return np.zeros((*z.shape[:-1], weights.shape[1]))
  parts = []
  for begin in range(0, z.shape[-2], ROWS):
    from_ = max(0, begin - max(lags))
    part = lagged(z[..., from_ : begin + ROWS, :], lags)[..., begin - from_ :, :]
    parts.append(part @ weights)
  return np.concatenate(parts, -2)


def residuals(
  model: Healthy,
  z: np.ndarray,
  fold: int = -1,
  error: np.ndarray | None = None,
  farthest: float = FARTHEST,
) -> np.ndarray:
  """(2, ..., T, W): what z (..., T, C), from `standard`, deviates from both predictions, in
  deviations, cut at `farthest`, which an error (T, C) of samples that are `filled` widens; nan
  where the past is unknown or the error too large.
  """
  own = model.watched
  found = np.stack(
    [
      z[..., :own] - _predicted(weights[fold][:, :own], lags, z)
      for weights, lags in ((model.others, NOW), (model.past, _before(model.watched, z)))
    ]
  )
  shape = (2, *[1] * (z.ndim - 1), own)
  found -= model.middle.reshape(shape)
  found /= model.scale.reshape(shape)
  if error is not None:
    used = (model.others, NOW), (model.past, _before(own, z))
    for one, scale, (weights, lags) in zip(found, model.scale, used):
      more = _added(weights[fold], lags, error, scale)
      one /= np.sqrt(1 + more)
      one[more > DOUBTFUL] = np.nan
  found[..., : max(*NOW, *BEFORE), :] = np.nan
  return np.clip(found, -farthest, farthest, out=found)


def folds(rows: int) -> list[slice]:
  """The shares of a nominal log of so many rows."""
  ends = np.linspace(0, rows, FOLDS + 1).astype(int)
  return [slice(a, b) for a, b in zip(ends[:-1], ends[1:])]


def unseen(model: Healthy, z: np.ndarray, error: np.ndarray | None = None) -> np.ndarray:
  """(2, N, W) `residuals` of the nominal log, each fold by the weights of the others."""
  parts = []
  for k, share in enumerate(folds(len(z))):
    begin = max(0, share.start - 2 * max(*NOW, *BEFORE))
    at = slice(begin, share.stop)
    part = residuals(model, z[at], k, None if error is None else error[at])
    parts.append(part[:, share.start - begin :])
  return np.concatenate(parts, 1)


def drifting(x: np.ndarray) -> np.ndarray:
  """Bool (C,): columns of (N, C) whose means of DRIFT_BLOCKS shares hold DRIFTS of their variance,
  or lie on a line (R^2 above STRAIGHT) and hold a twentieth of DRIFTS and five times what they do
  where nothing moves slowly, some DRIFT_BLOCKS / N: a short log shows little of a slow drift.
  """
  usable = len(x) // DRIFT_BLOCKS * DRIFT_BLOCKS
  means = x[:usable].reshape(DRIFT_BLOCKS, -1, x.shape[1]).mean(1)
  share = means.var(0) / np.maximum(x.var(0), 1e-300)
  time = np.arange(DRIFT_BLOCKS) - (DRIFT_BLOCKS - 1) / 2
  along = (time @ means) ** 2 / (time @ time) / DRIFT_BLOCKS
  straight = along > STRAIGHT * np.maximum(means.var(0), 1e-300)
  return (share > DRIFTS) | straight & (share > max(DRIFTS / 20, 5 * DRIFT_BLOCKS / len(x)))


def _before(watched: int, z: np.ndarray) -> tuple[int, ...]:
  """Lags of `past`, of z (..., C)."""
  return BEFORE if watched == z.shape[-1] else (0, *BEFORE)


def _solved(
  gram: np.ndarray, target: np.ndarray, ridge: float, own: bool, present: int
) -> np.ndarray:
  """Weights (F, C) of ridge regression on features with Gram matrix (F, F); with `own` of False no
  column's own features are used for it; the first `present` features are used for none.
  """
  size, columns = target.shape
  penalty = ridge * np.trace(gram) / size
  if own:
    weights, use = np.zeros_like(target), np.arange(size) >= present
    own_gram = gram[np.ix_(use, use)] if present else gram
    weights[use] = np.linalg.solve(own_gram + penalty * np.eye(use.sum()), target[use])
    return weights
  weights = np.zeros_like(target)
  for c in range(columns):
    use = np.arange(size) % columns != c
    weights[use, c] = np.linalg.solve(
      gram[np.ix_(use, use)] + penalty * np.eye(use.sum()), target[use, c]
    )
  return weights


def _regression(
  z: np.ndarray, lags: tuple[int, ...], own: bool, present: int = 0
) -> tuple[np.ndarray, np.ndarray]:
  """(weights (FOLDS + 1, F, C), share of variance explained in folds that were left out (C,)); the
  ridge is the one of RIDGES that explains most, and a column is left without prediction where it
  explains less than USEFUL.
  """
  grams, targets = [], []
  for share in folds(len(z)):
    size = len(lags) * z.shape[1]
    gram, target = np.zeros((size, size)), np.zeros((size, z.shape[1]))
    for begin in range(share.start, share.stop, ROWS):
      from_ = max(0, begin - max(lags))
      to = min(begin + ROWS, share.stop)
      part = lagged(z[from_:to], lags)[begin - from_ :]
      gram, target = gram + part.T @ part, target + part.T @ z[begin:to]
    grams.append(gram)
    targets.append(target)
  total, aim = np.sum(grams, 0), np.sum(targets, 0)
  best: tuple[float, np.ndarray, np.ndarray] | None = None
  for ridge in RIDGES:
    solved = lambda gram, target, ridge=ridge: _solved(gram, target, ridge, own, present)
    each = [solved(total - gram, aim - target) for gram, target in zip(grams, targets)]
    left = np.zeros(z.shape[1])  # sum of squares of what is not explained
    for weights, gram, target, share in zip(each, grams, targets, folds(len(z))):
      square = (z[share] ** 2).sum(0)
      left += square - 2 * (weights * target).sum(0) + (weights * (gram @ weights)).sum(0)
    explained = 1 - left / np.maximum((z**2).sum(0), 1e-300)
    score = float(np.clip(explained, 0, 1)[: present or None].sum())  # commands foretell themselves
    if best is None or score > best[0]:
      best = score, explained, np.stack([*each, solved(total, aim)])
  assert best is not None
  _, explained, weights = best
  weights[:, :, explained < USEFUL] = 0.0
  return weights, np.clip(explained, 0, 1)


def fit(x: np.ndarray, model: str = "ar", commands: int = 0) -> tuple[Healthy, np.ndarray]:
  """The model of a nominal log, and its `unseen` residuals as `judged`.

  Args:
    x: (N, C), missing samples nan, no column constant.
    model: "ar", or "none": no prediction, the columns themselves.
    commands: of the columns the last so many predict and are not watched.

  Raises:
    UserError: too much of the log is missing.
  """
  columns, longest, samples = x.shape[1], usual(x), x
  if (ages(x) > longest).mean(0).max() > 0.5 or known(x, longest).mean() < 0.5:
    raise UserError(
      "columns of the nominal log are missing for so long that less than half of it can be used; "
      "name others by --column"
    )
  x = held(x)
  mean, spread = x.mean(0), x.std(0)
  drifts = drifting(x)
  slow = max(10, min(SLOW, len(x) // 10))
  level = _levelled((x - mean) / spread, drifts, slow)
  spread = spread * level.std(0)
  own = columns - commands
  none, one = np.zeros((2, columns)), np.ones((2, own))
  blank = lambda lags: np.zeros((FOLDS + 1, len(lags) * columns, columns))
  fitted = Healthy(
    own, mean, spread, drifts, slow, longest, blank(NOW), blank(_before(own, x)), none, 0 * one,
    one, one[0],
  )  # fmt: skip
  z = standard(fitted, x)
  fitted = fitted._replace(step=np.sqrt((np.diff(z, axis=0) ** 2).mean(0)))
  able = model == "ar" and len(x) >= 20 * columns + 200
  fitted = _scaled(_weighed(fitted, z) if able else fitted, z, samples)
  error = None
  for _ in range(REFITS if absent(samples, longest).any() else 0):
    z, error = filled(fitted, standard(fitted, x), samples)
    fitted = _scaled(_weighed(fitted, z) if able else fitted, z, samples, error)
  return fitted, judged(fitted, unseen(fitted, z, error), samples, error)


def _weighed(model: Healthy, z: np.ndarray) -> Healthy:
  """A model with the weights that z (N, C) gives."""
  commands = len(model.mean) - model.watched
  others, first = _regression(z, NOW, False)
  past, second = _regression(z, _before(model.watched, z), True, model.watched if commands else 0)
  return model._replace(others=others, past=past, explained=np.stack([first, second]))


def _scaled(
  model: Healthy, z: np.ndarray, samples: np.ndarray, error: np.ndarray | None = None
) -> Healthy:
  """A model with mean and deviation of the `unseen` residuals of z (N, C); with an error of what is
  filled, relative to those it has.
  """
  if error is None:
    model = model._replace(middle=0 * model.middle, scale=0 * model.scale + 1)
  found = judged(model, unseen(model, z, error), samples, error)
  middle, scale = np.nanmean(found, 1), np.maximum(np.nanstd(found, 1), 1e-9)
  if error is not None:
    middle, scale = model.middle + model.scale * middle, model.scale * scale
  return model._replace(middle=middle, scale=scale)
