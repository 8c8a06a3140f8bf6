"""`quick.jit`: jax.jit for programs that are run once or twice. XLA lowers them as ever, LLVM
leaves them as they are: a third to a half less to compile (benchmarks/README.md).
"""

import functools

import jax

from mjx_cl.adapt.loop import Jitted, Once

jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})


def programs(loop):
  """The programs of a Loop by `jit`."""
  learn = jit(loop._learn, donate_argnums=0)
  return Jitted(Once(jit(loop._watch)), Once(jit(loop._rest)), Once(learn))


def traces(programs):
  """How often each program of a Loop has been compiled: (watch, rest, learn)."""
  return tuple(once.function._cache_size() for once in programs)
