"""Distribution functions that intervals and tests need; SciPy is a dependency of the tests alone."""

from __future__ import annotations

import functools
import math

import numpy as np

TINY = 1e-300  # keeps a continued fraction from dividing by zero


def gamma_cdf(a: float, x: float) -> float:
  """P(a, x) = integral_0^x t^(a-1) e^-t dt / Gamma(a), a > 0: the chance that a Poisson variable of
  mean x is at least a (a whole).

  Series below x = a + 1, Lentz's continued fraction above: about sqrt(a) terms where x is near a,
  relative error about 1e-12.
  """
  if x <= 0:
    return 0.0
  front = math.exp(a * math.log(x) - x - math.lgamma(a))
  if x < a + 1:
    term = total = 1.0 / a
    k = a
    while term > total * 1e-16:
      k += 1
      term *= x / k
      total += term
    return min(1.0, front * total)
  b = x + 1 - a
  c, d = 1 / TINY, 1 / b
  fraction, k, step = d, 0, 0.0
  while abs(step - 1) > 1e-15 and k < 1_000_000:
    k += 1
    b += 2
    pull = -k * (k - a)
    d = pull * d + b
    c = b + pull / c
    d, c = 1 / (d if abs(d) > TINY else TINY), c if abs(c) > TINY else TINY
    step = c * d
    fraction *= step
  return max(0.0, 1 - front * fraction)


def normal_quantile(p: float) -> float:
  """X with P(Z <= x) = p for a standard normal Z, by bisection of the error function."""
  low, high = -9.0, 9.0
  for _ in range(60):
    x = (low + high) / 2
    low, high = (x, high) if 0.5 * math.erfc(-x / math.sqrt(2)) < p else (low, x)
  return (low + high) / 2


@functools.lru_cache(maxsize=4096)
def gamma_quantile(a: float, p: float) -> float:
  """X with gamma_cdf(a, x) = p, 0 < p < 1: Newton's steps from Wilson and Hilferty's cube, inside a
  bracket.
  """
  x = max(a * (1 - 1 / (9 * a) + normal_quantile(p) / (3 * math.sqrt(a))) ** 3, 1e-8)
  low, high = 0.0, math.inf
  for _ in range(200):
    miss = gamma_cdf(a, x) - p
    low, high = (low, x) if miss > 0 else (x, high)
    density = math.exp((a - 1) * math.log(x) - x - math.lgamma(a))
    new = x - miss / density if density > 0 else low
    if not low < new < high:
      new = (low + high) / 2 if high < math.inf else 2 * x
    if abs(new - x) <= 1e-12 * x:
      return new
    x = new
  return x


def chi_square_tail(x: float, freedom: float) -> float:
  """P(chi-square with `freedom` degrees > x)."""
  return 1.0 - gamma_cdf(freedom / 2, x / 2)


def poisson_interval(count: int, level: float = 0.95) -> tuple[float, float]:
  """Exact interval of a Poisson mean after `count` events; below 0 events it begins at 0.

    low: P(N >= count; low) = (1 - level) / 2,  high: P(N <= count; high) = (1 - level) / 2

  Reference: Garwood 1936, Biometrika 28, 437-442.
  """
  tail = (1 - level) / 2
  return (gamma_quantile(count, tail) if count else 0.0), gamma_quantile(count + 1, 1 - tail)


@functools.lru_cache(maxsize=256)
def studentised_range(members: int, p: float = 0.95) -> float:
  """Quantile of the range of `members` independent standard normal variables: the studentised range
  with infinitely many degrees of freedom.

  P(range <= r) = k integral phi(x) (Phi(x) - Phi(x - r))^(k-1) dx, by a sum over a grid of step
  0.01, solved by bisection
  """
  x = np.arange(-9, 9, 0.01)
  cdf = lambda v: 0.5 * np.array([math.erfc(-u / math.sqrt(2)) for u in v])
  density, here = np.exp(-x * x / 2) / math.sqrt(2 * math.pi) * 0.01, cdf(x)
  low, high = 0.0, 20.0
  for _ in range(50):
    r = (low + high) / 2
    chance = members * np.sum(density * (here - cdf(x - r)) ** (members - 1))
    low, high = (r, high) if chance < p else (low, r)
  return (low + high) / 2
