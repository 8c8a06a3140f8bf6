"""Numbers that are folded into keys: no two users of a key share one, and none stands outside the
list.
"""

import ast
import enum
import pathlib

import jax
import numpy as np
import pytest

import mjx_cl
from mjx_cl import keys
from mjx_cl.rollout.scan import stream_keys

ENUMS = [x for x in vars(keys).values() if isinstance(x, type) and issubclass(x, enum.IntEnum)][1:]
PACKAGE = pathlib.Path(mjx_cl.__file__).parent


def folded() -> list[tuple[str, ast.expr]]:
  """(place, number) of every `fold_in` of the package."""
  out = []
  for path in sorted(PACKAGE.rglob("*.py")):
    for node in ast.walk(ast.parse(path.read_text())):
      if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "fold_in":
        out.append((f"{path.relative_to(PACKAGE)}:{node.lineno}", node.args[1]))
  return out


def members(expression: ast.expr) -> set[str]:
  return {
    f"{node.value.id}.{node.attr}"
    for node in ast.walk(expression)
    if isinstance(node, ast.Attribute)
    and isinstance(node.value, ast.Name)
    and node.value.id in {e.__name__ for e in ENUMS}
  }


def test_every_number_has_a_name_and_every_name_a_user():
  """What is folded in is a member, or a counter: neither a literal nor a constant of a module."""
  found, used = folded(), set()
  assert len(found) > 20
  for place, number in found:
    used |= members(number)
    for part in (number.left, number.right) if isinstance(number, ast.BinOp) else (number,):
      assert not isinstance(part, ast.Constant), (place, ast.unparse(number))
      constant = isinstance(part, ast.Name) and part.id.isupper()
      assert not constant or isinstance(number.op, ast.FloorDiv), (place, ast.unparse(number))
  assert used == {f"{e.__name__}.{member}" for e in ENUMS for member in e.__members__}


@pytest.mark.parametrize("own", ENUMS)
def test_no_two_users_of_a_key_share_a_number(own):
  numbers = [int(member) for member in own.__members__.values()]
  assert len(set(numbers)) == len(own.__members__) == len(own)


def test_numbers_keep_clear_of_counters_and_parts():
  """A stream's start splits its seed's key in three; one adaptation folds in control steps above
  0; faults are far fewer than 10,000; streams of one seed come before the predictions' number.
  """
  assert min(keys.OfSeed) > 2 and keys.OfAdaptation.FRESH == 0 and keys.OfFaults.WALK >= 10_000
  assert max(keys.OfSeed) == keys.OfSeed.WATCH == keys.OfSeed.FURTHER + 1_000
  whole = jax.random.key_data(jax.random.split(jax.random.key(3), 3))
  one = [jax.random.key_data(jax.random.fold_in(jax.random.key(3), i)) for i in range(3)]
  np.testing.assert_array_equal(whole, one)  # which is why `split` counts as folding in 0, 1, 2


def test_what_a_step_draws_is_disjoint():
  """All keys below three neighbouring steps and a stretch: each is there once, with its parents."""
  key, seen = jax.random.key(0), []
  for t in range(3):
    now = jax.random.fold_in(key, t)
    below = {member: jax.random.fold_in(now, member) for member in keys.OfStep}
    seen += [now, *below.values(), *jax.random.split(below[keys.OfStep.ACT])]
    for port in (keys.OfStep.FAULTS, keys.OfStep.READING, keys.OfStep.FIRST_READING):
      seen += [jax.random.fold_in(below[port], i) for i in (0, 1, 2, keys.OfFaults.WALK)]
  bits = [tuple(np.asarray(jax.random.key_data(k)).tolist()) for k in seen]
  assert len(set(bits)) == len(bits)


def test_streams_of_one_seed_differ_and_the_first_is_that_of_a_run():
  drawn = stream_keys([4, 5], 3)
  bits = np.asarray(jax.random.key_data(drawn))
  assert len(np.unique(bits, axis=0)) == 6
  np.testing.assert_array_equal(bits[3], jax.random.key_data(jax.random.key(5)))
