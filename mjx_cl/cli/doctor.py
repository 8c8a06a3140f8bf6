"""The command doctor: what the machine offers."""

import time

import jax
import numpy as np
import psutil

from mjx_cl import __version__, envs
from mjx_cl.cli.flags import Doctor
from mjx_cl.cli.output import emit
from mjx_cl.io import cache_check, runtime
from mjx_cl.runs import costs


def report() -> dict:
  """Versions, devices, backend, memory, compile cache and whether a second process finds in it what
  a first one compiled, and a speed check of about two seconds.
  """
  rows = {
    "mjx_cl": __version__,
    **{k: v for k, v in runtime.provenance().items() if k in ("versions", "python", "machine")},
  }
  rows["devices"] = ", ".join(str(d) for d in jax.devices())
  rows["physics"] = runtime.default_physics()
  rows["free_memory_gib"] = round(psutil.virtual_memory().available / 2**30, 1)
  rows["compile_cache"] = str(runtime.cache_dir())
  found = cache_check.check()
  rows["compile_cache_hit"], rows["compile_cache_remedy"] = found.hit, found.remedy or None
  rows["matmul_gflop_s"] = round(costs.matmul_rate() / 1e9)
  env = envs.make("walker")
  if env.physics.name == "native":
    num = 256
    keys = jax.random.split(jax.random.key(0), num)
    state, _ = jax.vmap(lambda k: env.init(env.model, k))(keys)
    rows_, ctrl = np.asarray(state.physics), np.zeros((num, 6), np.float32)
    env.physics.host.step({}, rows_, ctrl)
    steps, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < 1.0:
      rows_, _ = env.physics.host.step({}, rows_, ctrl)
      steps += num
    rows["walker_control_steps_s"] = round(steps / (time.perf_counter() - begin))
  return rows


def do_doctor(args: Doctor) -> None:
  """Prints what the machine offers."""
  rows = report()
  if args.json:
    emit(rows)
    return
  remedy = rows.pop("compile_cache_remedy")
  hit = "a second process finds what a first one compiled"
  rows["compile_cache_hit"] = f"no: {remedy}" if remedy else f"yes: {hit}"
  for name, value in rows.items():
    if isinstance(value, dict):
      value = ", ".join(f"{k} {v}" for k, v in value.items())
    print(f"{name:20s} {value}")
