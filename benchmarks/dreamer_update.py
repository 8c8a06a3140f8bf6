"""Speed of the learner: update, seeds, acting, monitor, compile times, each as a median in one
process.

  python benchmarks/dreamer_update.py --json

A figure that carries over between machines is the share of the matrix rate: floating-point
operations / time / (float32 rate of jnp.dot on 2,048 x 2,048, best of all its runs, which are
interleaved with the measured ones). Operations, counted for walker: 32 GFLOP an update of size1m
(16 x 64 replayed, 15 imagined from all 1,024 states), 470 GFLOP of size12m, 0.5 GFLOP the 15
open-loop predictions of 40 streams. Variants of one row are interleaved too. Nothing else should
run on the machine.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time

GFLOP = {"size1m": 32.0, "size12m": 470.0, "monitor": 0.5}
STREAMS = 40
SEEDS = 10


class Clock:
  """Interleaved timing: `measure` runs every variant in turn, and a few matrix products after each
  round.
  """

  def __init__(self):
    import jax
    import jax.numpy as jnp

    self._x, self._dot, self._times = jnp.ones((2048, 2048)), jax.jit(jnp.dot), []
    self._dot(self._x, self._x).block_until_ready()

  def gemm(self, runs: int = 5) -> None:
    for _ in range(runs):
      begin = time.perf_counter()
      self._dot(self._x, self._x).block_until_ready()
      self._times.append(time.perf_counter() - begin)

  @property
  def rate(self) -> float:
    """Best rate so far [GFLOP/s]."""
    return 2 * 2048**3 / min(self._times) / 1e9

  def measure(self, variants: dict, rounds: int) -> dict[str, float]:
    """Median seconds of each variant, a function without arguments that blocks; the first round is
    not timed.
    """
    times = {name: [] for name in variants}
    for k in range(rounds + 1):
      for name, run in variants.items():
        begin = time.perf_counter()
        run()
        if k:
          times[name].append(time.perf_counter() - begin)
      self.gemm()
    return {name: sorted(t)[len(t) // 2] for name, t in times.items()}


def batch(agent, key):
  """Random windows as replay gives them."""
  import jax
  import jax.numpy as jnp

  from mjx_cl.dreamer.agent import Record

  c, keys = agent.config, jax.random.split(key, 4)
  shape = (c.batch, c.length + 1)
  none = jnp.zeros(shape, bool)
  return Record(
    jax.random.normal(keys[0], shape + (agent.obs_size,)),
    jax.random.uniform(keys[1], shape + (agent.act_size,), minval=-1.0),
    jax.random.uniform(keys[2], shape),
    none.at[:, 0].set(True),
    none,
    none,
    jnp.zeros(shape + (agent.size.deter,), jnp.float16),
    jax.random.randint(keys[3], shape + (agent.size.stoch,), 0, agent.size.classes),
    jnp.zeros(shape + (agent.act_size,)),
    none,
  )


def updater(size: str, last_starts: int = 0, seeds: int = 0, how: str = "map", **options):
  """A function that takes one update (of each of `seeds` seeds) and blocks. how: `map`, `pairs` and
  `vmap` on one device, `devices`: `map` on each of several.
  """
  import jax

  from mjx_cl.config import PRESETS
  from mjx_cl.dreamer.agent import Agent

  config = dataclasses.replace(PRESETS["cpu"].dreamer, size=size, last_starts=last_starts)
  agent = Agent(config, 24, 6, **options)
  data, key = batch(agent, jax.random.key(1)), jax.random.key(2)
  if not seeds:
    step = jax.jit(lambda state: agent.update(state, data, key)[0], donate_argnums=0)
    holder = [jax.jit(agent.init)(jax.random.key(0))]
  else:
    one = lambda state: agent.update(state, data, key)[0]
    each = lambda s: jax.lax.map(one, s)
    many = {
      "map": each,
      "devices": each,
      "pairs": lambda s: jax.lax.map(one, s, batch_size=2),
      "vmap": jax.vmap(one),
    }[how]
    holder = [jax.jit(jax.vmap(agent.init))(jax.random.split(jax.random.key(0), seeds))]
    if how == "devices":  # as train.make_learn shares seeds
      from mjx_cl.training.trainer import seeds_mesh

      mesh, mine = seeds_mesh(seeds), jax.sharding.PartitionSpec("seeds")
      many = jax.shard_map(many, mesh=mesh, in_specs=mine, out_specs=mine, check_vma=False)
      holder = [jax.device_put(holder[0], jax.sharding.NamedSharding(mesh, mine))]
    step = jax.jit(many, donate_argnums=0)

  def run():
    holder[0] = jax.block_until_ready(step(holder[0]))

  return run


def actor(groups: int, members: int):
  """64 decisions of groups x members robots without physics; observations are fixed."""
  import jax
  import jax.numpy as jnp

  from mjx_cl.config import PRESETS
  from mjx_cl.dreamer.agent import Agent

  agent = Agent(PRESETS["cpu"].dreamer, 24, 6)
  params = jax.jit(jax.vmap(lambda k: agent.init(k).params))(
    jax.random.split(jax.random.key(0), groups)
  )
  obs = jax.random.normal(jax.random.key(1), (groups, members, 24))
  carry = jax.tree.map(lambda x: jnp.broadcast_to(x, (groups, members) + x.shape), agent.carry())

  @jax.jit
  def chunk(params, carry, key):
    params = jax.vmap(agent.prepare)(params)
    act = jax.vmap(jax.vmap(agent.act, (None, 0, 0, 0)))

    def step(carry, key):
      carry, action = act(params, carry, obs, jax.random.split(key, (groups, members)))
      return carry, jnp.sum(action)

    return jax.lax.scan(step, carry, jax.random.split(key, 64))

  return lambda: jax.block_until_ready(chunk(params, carry, jax.random.key(2)))


def watcher(groups: int, members: int):
  """The monitor over one chunk of 64 control steps."""
  import jax
  import jax.numpy as jnp

  from mjx_cl.config import PRESETS
  from mjx_cl.dreamer.agent import Agent
  from mjx_cl.rollout.monitor import Monitor
  from mjx_cl.rollout.scan import Row

  agent = Agent(PRESETS["cpu"].dreamer, 24, 6)
  monitor = Monitor(agent)
  params = jax.jit(jax.vmap(lambda k: agent.init(k).params))(
    jax.random.split(jax.random.key(0), groups)
  )
  lead = (64, groups, members)
  n = lambda *shape: jax.random.normal(jax.random.key(3), lead + shape)
  no = jnp.zeros(lead, bool)
  rows = Row(
    n(24),
    no,
    n(),
    n(6),
    jnp.tanh(n(agent.size.deter)),
    jnp.zeros(lead + (agent.size.stoch,), jnp.int32),
    n(),
    n(1),
    n(24),
    no,
    no,
    n(),
    no,
    n(6),
    no,
  )
  history, keys = monitor.init(groups, members), jax.random.split(jax.random.key(4), groups)
  step = jax.jit(monitor.update)
  return lambda: jax.block_until_ready(step(params, history, rows, keys))


def on_gpu(clock: Clock) -> tuple[float | None, float | None]:
  """Milliseconds of a size12m update of one seed, and per seed of ten by vmap, on an accelerator;
  None on a CPU.
  """
  import jax

  if jax.default_backend() == "cpu":
    return None, None
  times = clock.measure(
    {"one": updater("size12m"), "ten": updater("size12m", seeds=SEEDS, how="vmap")}, 8
  )
  return times["one"] * 1e3, times["ten"] / SEEDS * 1e3


COMPILE = """
import sys, time
from mjx_cl.io import runtime; runtime.setup()
import jax
sys.path.insert(0, {here!r})
import dreamer_update as bench
jax.block_until_ready(jax.random.normal(jax.random.key(0), (2, 24)))
make = {{"update": lambda: bench.updater("size1m"), "monitor": lambda: bench.watcher({streams}, 1), "rollout": bench.roller}}[{name!r}]
run = make(); begin = time.perf_counter(); run(); first = time.perf_counter() - begin
begin = time.perf_counter(); run(); print(first - (time.perf_counter() - begin))
"""


def roller():
  """One chunk of the rollout program of a run: acting, fault and native physics of 40 streams."""
  import jax

  from mjx_cl import envs, faults
  from mjx_cl.config import PRESETS
  from mjx_cl.dreamer.agent import Agent
  from mjx_cl.rollout.scan import Rollout, nest, start

  env = envs.make("walker", "native")
  agent, fault = Agent(PRESETS["cpu"].dreamer, 24, 6), faults.make("gear", env)
  rollout = Rollout(env, agent, fault)
  params = jax.jit(jax.vmap(lambda k: agent.init(k).params))(
    jax.random.split(jax.random.key(0), STREAMS)
  )
  streams = nest(lambda k: start(env, agent, fault, k), 0, 0)(
    jax.random.split(jax.random.key(1), (STREAMS, 1))
  )
  return lambda: jax.block_until_ready(rollout.chunk(params, streams, 64))


def compile_times() -> dict[str, tuple[float, float]]:
  """Seconds from call to result of each program's first call, less a second call: with an empty
  cache, and with a filled one.
  """
  out = {}
  with tempfile.TemporaryDirectory() as cache:
    for name in ("update", "monitor", "rollout"):
      code = COMPILE.format(
        here=os.path.dirname(os.path.abspath(__file__)), name=name, streams=STREAMS
      )
      call = lambda: float(
        subprocess.run(
          [sys.executable, "-c", code],
          env=os.environ | {"MJX_CL_CACHE": cache},
          check=True,
          capture_output=True,
          text=True,
        ).stdout.split()[-1]
      )
      out[name] = (call(), call())
  return out


ALLOCATOR = """
import sys
from mjx_cl.io import runtime; runtime.setup()
sys.path.insert(0, {here!r})
import dreamer_update as bench
print(bench.Clock().measure({{"x": bench.updater("size1m")}}, 12)["x"])
"""


def allocator() -> float:
  """Update time with glibc's default allocator / with `runtime.keep_memory`, two processes each, in
  turn.
  """
  code = ALLOCATOR.format(here=os.path.dirname(os.path.abspath(__file__)))
  call = lambda extra: float(
    subprocess.run(
      [sys.executable, "-c", code],
      env=os.environ | extra,
      check=True,
      capture_output=True,
      text=True,
    ).stdout.split()[-1]
  )
  default = {
    "MALLOC_TRIM_THRESHOLD_": "131072"
  }  # glibc's own value: `keep_memory` then leaves everything as it is
  times = [(call(default), call({})) for _ in range(2)]
  return sum(a for a, _ in times) / sum(b for _, b in times)


def main() -> None:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
  )
  parser.add_argument("--json", action="store_true", help="one JSON value on standard output")
  parser.add_argument(
    "--quick", action="store_true", help="size1m's update and acting alone, few rounds"
  )
  args = parser.parse_args()
  from mjx_cl.io import runtime

  shared = runtime.sharing(SEEDS)
  runtime.setup(
    shared
  )  # for the rows of ten seeds; all others are on the first device, with all cores
  clock, rows = Clock(), []

  def row(name, value, unit, goal=None):
    holds = (
      None if goal is None or value is None else bool(eval(f"{value} {goal}", {"__builtins__": {}}))
    )  # goal: our own ">= 0.45"
    rows.append({"name": name, "value": value, "unit": unit, "goal": goal, "holds": holds})
    print(
      f"{name}: {value if value is None else round(value, 4)} {unit} {goal or ''} "
      f"{'' if holds is None else holds}",
      file=sys.stderr,
      flush=True,
    )

  rounds = 5 if args.quick else 30
  times = clock.measure(
    {"stepwise": updater("size1m", stepwise=True), "stacked": updater("size1m", stepwise=False)},
    rounds,
  )
  row("update size1m, 1,024 starts", times["stepwise"] * 1e3, "ms")
  row(
    "update size1m, share of the matrix rate",
    GFLOP["size1m"] / times["stepwise"] / clock.rate,
    "",
    ">= 0.45",
  )
  row(
    "update size1m, large products / state by state", times["stacked"] / times["stepwise"], "ratio"
  )
  row(
    "update size1m, 256 starts (preset cpu)",
    clock.measure({"x": updater("size1m", 16)}, rounds)["x"] * 1e3,
    "ms",
  )
  times = clock.measure({"shared": actor(1, STREAMS), "own": actor(STREAMS, 1)}, rounds)
  row(
    f"acting, {STREAMS} streams, one agent, per control step",
    times["shared"] / 64 * 1e3,
    "ms",
    "<= 1.0",
  )
  row(
    f"acting, {STREAMS} streams, an agent each, per control step",
    times["own"] / 64 * 1e3,
    "ms",
    "<= 1.0",
  )
  times = clock.measure({"shared": watcher(1, STREAMS), "own": watcher(STREAMS, 1)}, rounds)
  for name, what in (("shared", "one agent"), ("own", "an agent each")):
    row(f"monitor, {STREAMS} streams, {what}, per control step", times[name] / 64 * 1e3, "ms")
    row(
      f"monitor, {STREAMS} streams, {what}, share of the matrix rate",
      GFLOP["monitor"] / (times[name] / 64) / clock.rate,
      "",
      ">= 0.45",
    )
  if not args.quick:
    for starts, more in ((0, ""), (16, ", 256 starts")):
      ways = (
        {}
        if starts
        else {"map": "in one program (lax.map)", "pairs": "in pairs", "vmap": "by vmap"}
      )
      if shared > 1:
        ways["devices"] = "a share for each core"
      times = clock.measure(
        {"one": updater("size1m", starts)}
        | {how: updater("size1m", starts, seeds=SEEDS, how=how) for how in ways},
        8,
      )
      for how, words in ways.items():
        goal = (
          "<= 0.9" if not starts and how == ("devices" if shared > 1 else "map") else None
        )  # of the way that `train --seeds` takes on this machine
        row(
          f"ten seeds {words}{more}, per seed / one seed alone",
          times[how] / SEEDS / times["one"],
          "ratio",
          goal,
        )
    times = clock.measure({"x": updater("size12m")}, 5)
    row("update size12m", times["x"] * 1e3, "ms")
    row(
      "update size12m, share of the matrix rate",
      GFLOP["size12m"] / times["x"] / clock.rate,
      "",
      ">= 0.6",
    )
    row("update size1m, default allocator / kept memory", allocator(), "ratio")
    for name, (cold, cached) in compile_times().items():
      row(f"compile {name}, cold", cold, "s", "<= 15")
      row(f"compile {name}, cached", cached, "s", "<= 3")
    one, ten = on_gpu(clock)
    row("update size12m on a GPU, one seed", one, "ms")
    row("update size12m on a GPU, ten seeds by vmap, per seed", ten, "ms")
  row("matrix rate", clock.rate, "GFLOP/s")
  if args.json:
    print(json.dumps(rows))


if __name__ == "__main__":
  main()
