"""The run-time check of shapes in annotations (pyproject.toml names it): a whole number is legal
where a float is, as it is to type checkers. What a user wrote is checked by `detectors.make`
itself.
"""

import inspect

import beartype
import jaxtyping

_check = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))
_jaxtyped = jaxtyping.jaxtyped


def check(function):
  return function if function.__module__ == "mjx_cl.detectors.make" else _check(function)


def once(*, typechecker):
  """`jaxtyping.jaxtyped`, but for functions within functions, which it would compile a check for
  each time that the outer one is traced: a tenth of the time of such tests.
  """
  decorate = _jaxtyped(typechecker=typechecker)

  def decorated(what):
    inner = inspect.isfunction(what) and "<locals>" in what.__qualname__
    return what if inner else decorate(what)

  return decorated


jaxtyping.jaxtyped = once
