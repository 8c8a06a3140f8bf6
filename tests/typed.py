"""The run-time check of shapes in annotations (pyproject.toml names it): a whole number is legal
where a float is, as it is to type checkers. What a user wrote is checked by `detectors.make`
itself.
"""

import beartype

_check = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))


def check(function):
  return function if function.__module__ == "mjx_cl.detectors.make" else _check(function)
