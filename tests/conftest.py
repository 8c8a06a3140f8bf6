"""Shared by all tests: XLA flags and compile cache before the first use of JAX, and the few
programs that are costly to compile.
"""

import functools
import gc
import os
import pathlib
import signal
import tempfile
import threading

os.environ.setdefault(
  "MJX_CL_CACHE", str(pathlib.Path(tempfile.gettempdir()) / "mjx_cl_tests_cache")
)  # shared by all runs and processes; XLA keys what it holds by the flags below
# Most of the tests' time is compiling. LLVM leaves programs as they are, kernels come from the
# older emitters, which need no MLIR, and passes are left out that cost more than they save: half of
# a learner's compile time. Flags of one's own come later and win; processes that tests start
# inherit them.
QUICK = {
  "xla_backend_optimization_level": 0,
  "xla_cpu_parallel_codegen_split_count": 1,
  "xla_cpu_use_fusion_emitters": False,
  "xla_disable_hlo_passes": ",".join(
    (
      "gather_expander",
      "simplify-while-loops",
      "tree_reduction_rewriter",
      "while-loop-constant-sinking",
      "while-loop-invariant-code-motion",
    )
  ),
}
os.environ["XLA_FLAGS"] = " ".join(
  [f"--{name}={str(value).lower()}" for name, value in QUICK.items()]
  + os.environ.get("XLA_FLAGS", "").split()
)

import typed  # noqa: E402, F401  before the package, whose checks it makes

from mjx_cl.io import runtime  # noqa: E402

runtime.setup()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

ROBOTS = 256  # batch of the one MJX program that the suite compiles
LIMIT = 2.0  # GiB


def resident_gib() -> float:
  """Memory that this process holds; 0 where /proc is missing."""
  try:
    return (
      int(pathlib.Path("/proc/self/statm").read_text().split()[1])
      * os.sysconf("SC_PAGE_SIZE")
      / 2**30
    )
  except OSError:
    return 0.0


@pytest.fixture(scope="session", autouse=True)
def programs():
  """All runs of a test process share their compiled programs, as the parts of a suite do."""
  from mjx_cl.runs import run, runner

  kept = run.Programs()
  with pytest.MonkeyPatch.context() as patch:
    for module in (run, runner):
      patch.setattr(module, "Programs", lambda: kept)
    yield kept


@pytest.fixture(scope="module", autouse=True)
def forget(programs):
  """A module's compiled programs go with it once the process holds more than LIMIT GiB; session
  fixtures take theirs from the compile cache again.
  """
  yield
  if resident_gib() > LIMIT:
    jax.clear_caches()
    programs.kept.clear()
    gc.collect()
    runtime.give_back()


@pytest.fixture(autouse=True)
def at_a_terminal():
  """Ctrl-C and SIGTERM act as they do at a terminal, here and in the processes that a test starts:
  a shell ignores SIGINT for what it starts in the background. Handlers of a test end with it.
  """
  own = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
  before = {number: signal.signal(number, handler) for number, handler in own.items()}
  mask = signal.pthread_sigmask(signal.SIG_UNBLOCK, own)
  yield
  for number, handler in before.items():
    signal.signal(number, handler)
  signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@pytest.fixture(scope="session")
def walker():
  """mujoco.MjModel of the walker."""
  from mjx_cl.envs.walker import load_model

  return load_model()


@pytest.fixture(scope="session")
def pair(walker):
  """Native and MJX backend of the walker (10 substeps), as {name: (init, step)} for ROBOTS robots;
  one program each. XLA and LLVM optimise them, as they do outside the tests: MJX then rounds as it
  does for a user, and takes a tenth of the time.
  """
  from mjx_cl import physics

  backends = {name: physics.make(name, walker, substeps=10) for name in ("native", "mjx")}
  default = {
    "xla_backend_optimization_level": 3,
    "xla_cpu_parallel_codegen_split_count": 32,
    "xla_cpu_use_fusion_emitters": True,
    "xla_disable_hlo_passes": "",
  }
  jit = functools.partial(jax.jit, compiler_options=default)
  return {name: (jit(jax.vmap(b.init)), jit(jax.vmap(b.step))) for name, b in backends.items()}


@pytest.fixture(scope="session")
def fields(walker):
  """Nominal model fields of ROBOTS robots."""
  return {"actuator_gear": jnp.tile(jnp.asarray(walker.actuator_gear, jnp.float32), (ROBOTS, 1, 1))}


@pytest.fixture(scope="session")
def crowd(walker, pair, fields):
  """1,024 states of walkers that thrash about on the floor: qpos (4, ROBOTS, 9), qvel (4, ROBOTS,
  9), at 0.75, 1.5, 2.25 and 3 s.
  """
  init, step = pair["native"]
  rng = np.random.default_rng(0)
  low, high = walker.jnt_range[3:].T
  qpos = np.concatenate(
    [
      np.zeros((ROBOTS, 2)),
      rng.uniform(-np.pi, np.pi, (ROBOTS, 1)),
      rng.uniform(low, high, (ROBOTS, 6)),
    ],
    1,
  )
  state, kept = init(qpos.astype(np.float32), np.zeros((ROBOTS, 9), np.float32)), []
  for k in range(120):
    state, out = step(fields, state, rng.uniform(-1, 1, (ROBOTS, 6)).astype(np.float32))
    if k % 30 == 29:
      kept.append((np.asarray(out["qpos"]), np.asarray(out["qvel"])))
  return tuple(np.stack(x) for x in zip(*kept))


@pytest.fixture(scope="session")
def tiny():
  """Agent of the preset `tiny` for the walker."""
  from mjx_cl.config import PRESETS
  from mjx_cl.dreamer.agent import Agent

  return Agent(PRESETS["tiny"].dreamer, 24, 6)


@pytest.fixture(scope="session")
def tiny_params(tiny):
  """Parameters of two tiny agents, leading axis (2,)."""
  return jax.jit(jax.vmap(lambda key: tiny.init(key).params))(
    jax.random.split(jax.random.key(7), 2)
  )


@pytest.fixture(scope="session")
def short_walker():
  """Native walker whose episodes last 12 control steps."""
  from mjx_cl import envs

  env = envs.make("walker", "native")
  env.spec = env.spec._replace(episode_steps=12)
  return env


@pytest.fixture
def within():
  """within(seconds, function): what `function` returns, or a failure (not a hang) where it takes
  longer.
  """

  def call(seconds, function):
    out = []
    thread = threading.Thread(target=lambda: out.append(function()), daemon=True)
    thread.start()
    thread.join(seconds)
    assert out, f"raised, or did not finish within {seconds} s"
    return out[0]

  return call


@pytest.fixture
def same():
  """same(a, b): every leaf of two pytrees is bit for bit equal (nan equals itself, -0.0 differs
  from 0.0).
  """

  def bits(x):
    if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
      x = jax.random.key_data(x)
    x = np.asarray(x)
    return x.shape, x.dtype, x.tobytes()

  def compare(a, b):
    a, b = jax.tree.leaves_with_path(a), jax.tree.leaves_with_path(b)
    assert [p for p, _ in a] == [p for p, _ in b]
    return all(bits(jnp.asarray(x)) == bits(jnp.asarray(y)) for (_, x), (_, y) in zip(a, b))

  return compare
