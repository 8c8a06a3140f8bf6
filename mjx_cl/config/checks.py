"""What a setting may be: checks of numbers, names and kinds, whose errors name the choices."""

from __future__ import annotations

import dataclasses
import json
import math
import numbers
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

from mjx_cl.errors import UserError, choose, require

if TYPE_CHECKING:
  from typing import TypeVar

  from _typeshed import DataclassInstance

  Settled = TypeVar("Settled", bound=DataclassInstance)

LARGEST = sys.float_info.max  # a whole number beyond it is no float
FOREVER = 2**31 - 1  # control steps that no run outlasts
KINDS = {
  "bool": bool,
  "int": numbers.Integral,
  "float": numbers.Real,
  "str": str,
  "None": type(None),
}
# settings of earlier versions, with the one value that still means what is done today
GONE: dict[str, Any] = {"jitter": 0.0, "episode": None, "context": 1}


def _each(config: object, names: Iterable[str], holds: Callable[[Any], bool], what: str) -> None:
  """Raises UserError unless `holds` is true of every named field."""
  for name in names:
    value = getattr(config, name)
    require(holds(value), f"{name} must {what}; got {value}")


def positive(config: object, *names: str) -> None:
  """Raises unless every named field is a finite number above 0."""
  _each(config, names, lambda x: 0 < x <= LARGEST, "be above 0 and finite")


def not_below_0(config: object, *names: str) -> None:
  """Raises unless every named field is a finite number of at least 0."""
  _each(config, names, lambda x: 0 <= x <= LARGEST, "be 0 or above and finite")


def whole(config: object, *names: str, most: int = FOREVER - 1) -> None:
  """Raises unless every named field is a whole number of at least 0 and at most `most`."""
  fits = lambda x: isinstance(x, int) and not isinstance(x, bool) and 0 <= x <= most
  _each(config, names, fits, f"be a whole number in 0..{most:,}")


def fraction(config: object, *names: str) -> None:
  """Raises unless every named field lies in [0, 1]."""
  _each(config, names, lambda x: 0.0 <= x <= 1.0, "lie in [0, 1]")  # also false for nan


def given(config: object, *names: str) -> tuple[str, ...]:
  """Those of the named fields that are not None."""
  return tuple(name for name in names if getattr(config, name) is not None)


def kinds(where: str, annotations: dict[str, str], values: dict, before: str = "") -> None:
  """Raises UserError where a value is of another kind than its annotation says, such as `int |
  None`; what is annotated otherwise, or not at all, passes.
  """
  for name, value in values.items():
    words = [word.strip() for word in annotations.get(name, "").split("|")]
    if not all(word in KINDS for word in words):
      continue
    allowed = tuple(KINDS[word] for word in words)
    if not isinstance(value, allowed) or isinstance(value, bool) and bool not in allowed:
      raise UserError(
        f"{where}: {before}{name} takes "
        f"{' or '.join(word for word in words if word != 'None')}; got {value!r}"
      )


def field_kinds(where: str, of: type, values: dict, before: str = "") -> None:
  """`kinds` of the fields of the dataclass `of`."""
  written = lambda kind: kind.__name__ if isinstance(kind, type) else str(kind)
  kinds(where, {f.name: written(f.type) for f in dataclasses.fields(of)}, values, before)


def check_seeds(first: int, count: int = 1, name: str = "seed") -> None:
  """Raises unless `count` seeds from `first` on are whole numbers from 0 to 2,147,483,647, as files
  hold them.
  """
  require(count <= 2**31, f"there are 2,147,483,648 seeds at most; got {count}")
  require(0 <= first <= 2**31 - count, f"{name} must lie in 0..{2**31 - count:,}; got {first}")


def finite(values: dict, where: str) -> None:
  """Raises where a setting is a number that is not finite: results could not hold it as JSON."""
  for name, value in values.items():
    require(
      not isinstance(value, float) or math.isfinite(value),
      f"{where}: {name} must be finite; got {value}",
    )


def settings(pairs: Iterable[str]) -> dict:
  """("a=1", "b=x") -> {"a": 1, "b": "x"}; values are read as JSON where they are JSON."""
  out = {}
  for pair in pairs:
    name, sign, value = pair.partition("=")
    require(sign and name.strip(), f"--set takes name=value; got {pair!r}")
    try:
      out[name] = json.loads(value.lower() if value in ("True", "False") else value)
    except (ValueError, RecursionError):
      out[name] = value
  finite(out, "--set")
  return out


def recorded(kind: type, record: Mapping[str, Any]) -> dict[str, Any]:
  """Fields of `kind` that a card or a config.json of this or an earlier version holds.

  Raises:
    ValueError: one line, for a field that this version has not, unless its value changes nothing.
  """
  names = {f.name for f in dataclasses.fields(kind)}
  for name, value in record.items():
    if name not in names and not (name in GONE and value == GONE[name]):
      raise ValueError(f"{name}={value!r} is no setting of this version")
  return {name: value for name, value in record.items() if name in names}


def replace(config: Settled, **changes: Any) -> Settled:
  """dataclasses.replace that names the valid fields when it is given an unknown one."""
  known = {f.name for f in dataclasses.fields(config)}
  for name in changes:
    choose("setting", name, dict.fromkeys(known))
  return dataclasses.replace(config, **changes)
