"""The contract of a detector."""
from __future__ import annotations

from typing import Any, Callable, NamedTuple

import jax


class Alarm(NamedTuple):
  """Attributes:
    fired: bool (). score: float32 (), larger is more suspect; nan where the sample was masked or nothing is known yet.
  """
  fired: jax.Array
  score: jax.Array


class Detector(NamedTuple):
  """Attributes:
    init: () -> state, a pytree of arrays.
    update: (state, x) -> (state, Alarm), same structure, shapes and dtypes in and out: scannable and vmappable.
  """
  init: Callable[[], Any]
  update: Callable[[Any, Any], tuple[Any, Alarm]]
