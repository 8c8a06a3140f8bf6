"""Which columns of a log moved, by the residuals of all: what one column does by itself, it does to
its own residual and, by the weights that foretell them from it, to those of the others.
"""

import numpy as np

from mjx_cl.logs import healthy
from mjx_cl.logs.healthy import Healthy

MOST = 4  # columns that an event names
GAIN = 25.0  # squared deviations that a column has to explain to be named
SHARE = 0.1  # of what the first column explains, that each of the others has to
TRIED = 8  # columns whose own errors are fitted
RIDGE = 1e-6  # of such a fit, in mean squares of its features


def _gains(model: Healthy) -> np.ndarray:
  """(lags of NOW, W, W): what a column adds to the prediction of another, at each lag."""
  every, own = len(model.mean), model.watched
  return model.others[-1].reshape(len(healthy.NOW), every, every)[:, :own, :own]


def moved(model: Healthy, means: np.ndarray, shift: np.ndarray) -> list[tuple[int, float]]:
  """(column, deviations that it moved by) that explain a shift of the residuals, the first most:
  orthogonal matching pursuit (Pati, Rezaiifar and Krishnaprasad 1993).

  Args:
    model: of the nominal log.
    means: (W, W) inverse covariance that the shift has where nothing moved.
    shift: (W,) of the residuals of what the others foretell.
  """
  columns = len(shift)
  effect = (np.eye(columns) - _gains(model).sum(0).T) / model.scale[0][:, None]
  root = np.linalg.cholesky(means).T
  left, seen = root @ shift, root @ effect
  named: list[int] = []
  first, by = 0.0, np.zeros(0)
  target = left.copy()
  while len(named) < min(MOST, columns):
    explains = (seen.T @ left) ** 2 / np.maximum((seen**2).sum(0), 1e-300)
    explains[named] = 0.0
    best = int(np.argmax(explains))
    if explains[best] < max(GAIN, SHARE * first):
      break
    first = first or float(explains[best])
    named.append(best)
    by = np.linalg.lstsq(seen[:, named], target, rcond=None)[0]
    left = target - seen[:, named] @ by
  return [(c, float(b)) for c, b in zip(named, by)]


def erring(model: Healthy, residuals: np.ndarray, columns: list[int]) -> int:
  """The one of some columns whose own error, another in each row, explains most of the squares of
  the residuals (T, W) of what the others foretell: ridge regression.
  """
  rows, width = residuals.shape
  gains, lags = _gains(model), healthy.NOW
  ahead, y = max(lags), np.nan_to_num(residuals)
  at = np.arange(rows)

  def explained(j: int) -> float:
    gram, target = np.zeros((rows + ahead,) * 2), np.zeros(rows + ahead)
    for i in range(width):
      own = [float(lag == 0 and i == j) - gains[k, j, i] for k, lag in enumerate(lags)]
      own = [g / model.scale[0, i] for g in own]
      for lag, g in zip(lags, own):
        if g:
          target[at + ahead - lag] += g * y[:, i]
          for other, h in zip(lags, own):
            gram[at + ahead - lag, at + ahead - other] += g * h
    ridge = RIDGE * np.trace(gram) / len(gram)
    error = np.linalg.solve(gram + ridge * np.eye(len(gram)), target)
    return float(error @ target - ridge * error @ error)

  return max(columns, key=explained)
