"""`quick.jit`: jax.jit for programs that are run once or twice. XLA lowers them as ever, LLVM
leaves them as they are: a third to a half less to compile (benchmarks/README.md).
"""

import functools

import jax

jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
