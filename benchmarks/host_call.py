"""What a call from a compiled program to the host costs, by name and by jax.pure_callback: python
benchmarks/host_call.py [--json]

Microseconds of a call that does nothing (2,000 in a loop, 40 rows of 3 numbers), and milliseconds
of 64 control steps of ten walkers with their agent, each form in turn, medians; and seconds until
such a chunk has been run the first time, in a new process with a new compile cache and in a second
one that finds it there.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time

FORMS = ("by name", "pure_callback")


def use(form: str) -> None:
  from mjx_cl.physics import host_call

  if form == "pure_callback":
    host_call.registered = lambda: False
  elif not host_call.registered():
    sys.exit("this jaxlib does not take the target; there is only one form")


def calls():
  """A program of 2,000 calls."""
  import jax
  import jax.numpy as jnp

  from mjx_cl.physics import host_call

  x = jnp.zeros((40, 3), jnp.uint32)
  program = jax.jit(
    lambda x: jax.lax.fori_loop(
      0, 2000, lambda i, x: jax.vmap(lambda x: host_call.call("nothing", "", 3, x))(x), x
    )
  )
  return lambda: program(x).block_until_ready()


def chunk():
  """64 control steps of ten walkers."""
  import jax

  from mjx_cl.config import CHUNK, RunConfig
  from mjx_cl.runs import run

  runner = run.Runner(
    RunConfig(env="walker", seeds=10, arms=("none",), steps=10_000), tempfile.gettempdir()
  )
  params = jax.tree.map(lambda x: jax.numpy.asarray(x)[None], runner.trained.train.params)
  robots = [jax.tree.map(lambda x: x[:, :n], h.streams) for h, n in zip(runner.lives.herds, (8, 2))]
  streams = jax.tree.map(lambda *x: jax.numpy.concatenate(x, 1), *robots)
  return lambda: jax.block_until_ready(runner.rollout.chunk(params, streams, CHUNK)[1])


def measure(make, rounds: int) -> dict[str, float]:
  """Median seconds of each form, which take turns."""
  from physics import race  # the script beside this one

  from mjx_cl.physics import host_call

  asked, programs = host_call.registered, {}
  for form in FORMS:
    use(form)
    programs[form] = make()
    programs[form]()
    host_call.registered = asked
  return race(programs, rounds)


def first(form: str) -> float:
  """Seconds until the first chunk is there, its robot and agent apart."""
  from mjx_cl.io import runtime

  runtime.setup()
  use(form)
  run = chunk()
  begin = time.perf_counter()
  run()
  return time.perf_counter() - begin


def main() -> None:
  parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
  parser.add_argument("--json", action="store_true")
  parser.add_argument("--first", choices=FORMS, help=argparse.SUPPRESS)
  args = parser.parse_args()
  if args.first:
    print(first(args.first))
    return
  from mjx_cl.io import runtime

  runtime.setup()
  from mjx_cl.physics import host_call

  nothing = host_call.shared("nothing", lambda: lambda word, x: x)
  rows = [
    {"name": f"a call, {form}", "value": 1e6 * s / 2000, "unit": "us"}
    for form, s in measure(calls, 15).items()
  ]
  rows += [
    {"name": f"64 steps of ten walkers, {form}", "value": 1e3 * s, "unit": "ms"}
    for form, s in measure(chunk, 30).items()
  ]
  del nothing
  for form in FORMS:
    with tempfile.TemporaryDirectory() as folder:
      for which in ("new cache", "second process"):
        out = subprocess.run(
          [sys.executable, __file__, "--first", form],
          env=os.environ | {"MJX_CL_CACHE": folder},
          capture_output=True,
          text=True,
          check=True,
        ).stdout
        rows.append({"name": f"first chunk, {form}, {which}", "value": float(out), "unit": "s"})
  if args.json:
    print(
      json.dumps(
        {"command": "python benchmarks/host_call.py --json", **runtime.provenance(), "rows": rows},
        indent=1,
      )
    )
  else:
    for row in rows:
      print(f"{row['name']:45} {row['value']:8.2f} {row['unit']}")


if __name__ == "__main__":
  main()
