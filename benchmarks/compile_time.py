"""What compiling costs: processor seconds of tracing, lowering and compiling a program anew, its
fusions, and a hash of what it computes.

  [XLA_FLAGS=...] python benchmarks/compile_time.py update|digest

`update`: a learner's update (size1m, 16 x 64, preset `cpu`); `digest`: what a run does with a chunk
of the walker (monitor, detector, rule, updates). Processor time, since it changes less than wall
time beside other work. The hash is of one call: one update from new weights; a first chunk, in
which no stream updates yet. Where it differs between two settings, so do the bits; where it does
not, that much is shown.
"""

from __future__ import annotations

import hashlib
import re
import sys
import tempfile
import time

import dreamer_update


def update():
  """(jitted function, its arguments)."""
  import jax

  from mjx_cl.config import PRESETS
  from mjx_cl.dreamer.agent import Agent

  agent = Agent(PRESETS["cpu"].dreamer, 24, 6)
  data, key = dreamer_update.batch(agent, jax.random.key(1)), jax.random.key(2)
  return jax.jit(agent.update), (jax.jit(agent.init)(jax.random.key(0)), data, key)


def digest():
  """Likewise, for the first stream of a run."""
  import jax.numpy as jnp
  from mjx_cl.adapt.blocks import cut

  from mjx_cl.config import CHUNK, RunConfig
  from mjx_cl.runs import run

  runner = run.Runner(
    RunConfig(env="walker", seeds=2, arms=("detector",), steps=10_000), tempfile.gettempdir()
  )
  _, rows = runner.rollout.chunk(runner.acting, runner.state.streams, CHUNK)
  first, loop = runner.loops.blocks[0], runner.loops.loop
  return loop._program, (
    runner.state.loop[0],
    cut(rows, first, 1),
    jnp.int32(CHUNK),
    cut(runner.choices, first, 0),
    runner.keys[first],
    None,
    loop.config,
  )


def main() -> None:
  programs = {"update": update, "digest": digest}
  if len(sys.argv) != 2 or sys.argv[1] not in programs:
    sys.exit(f"usage: python benchmarks/compile_time.py {'|'.join(programs)}")
  import jax
  import numpy as np

  import mjx_cl  # noqa: F401  its settings before JAX's own

  jax.config.update("jax_enable_compilation_cache", False)
  program, given = programs[sys.argv[1]]()
  begin = time.process_time()
  compiled = program.lower(*given).compile()
  seconds = time.process_time() - begin
  fusions = len(re.findall(r" fusion\(", compiled.as_text()))
  result = compiled(*given)
  words = hashlib.sha256(
    b"".join(
      np.asarray(x).tobytes()
      for x in jax.tree.leaves(result)
      if not jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)
    )
  )
  print(
    f"{sys.argv[1]}: {seconds:.1f} s of processor time, {fusions:,} fusions, result "
    f"{words.hexdigest()[:8]}"
  )


if __name__ == "__main__":
  main()
