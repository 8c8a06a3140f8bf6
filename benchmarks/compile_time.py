"""What compiling costs: processor seconds of tracing, lowering and compiling a program anew, its
fusions, and a hash of what it computes.

  [XLA_FLAGS=...] python benchmarks/compile_time.py update|watch|learn

`update`: a learner's update (size1m, 16 x 64, preset `cpu`); what a run does with a chunk of the
walker: `watch` (monitor, detector, signals) and `learn` (rule, updates). Processor time, since it
changes less than wall time beside other work. The hash is of one call: one update from new weights;
a first chunk, in which no stream updates yet. Where it differs between two settings, so do the
bits; where it does not, that much is shown.
"""

from __future__ import annotations

import functools
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


def chunk(which):
  """Likewise, for the first stream of a run and its program `which`."""
  import jax.numpy as jnp

  from mjx_cl.adapt.state import cut
  from mjx_cl.config import CHUNK, RunConfig
  from mjx_cl.runs import run

  runner = run.Runner(
    RunConfig(env="walker", seeds=2, arms=("detector",), steps=10_000), tempfile.gettempdir()
  )
  herd, loop, now = runner.lives.herds[0], runner.loop, jnp.int32(CHUNK)
  _, rows = runner.rollout.chunk(herd.minds.params, herd.streams, CHUNK)
  rows, sight, key = cut(rows, slice(0, 1), 2), herd.frozen[0].sight, runner.keys[:1]
  watch = loop.programs.watch
  if which == "watch":
    return watch.function, (herd.minds, sight, rows, now, key)
  seen, _ = watch(herd.minds, sight, rows, now, key)
  state = loop.init(herd.train, 1)
  given = (state, seen, rows, now, runner.choices[0], key, None, loop.config)
  return loop.programs.learn.function, given


def main() -> None:
  chunks = {which: functools.partial(chunk, which) for which in ("watch", "learn")}
  programs = {"update": update} | chunks
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
