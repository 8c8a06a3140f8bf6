"""The scan over replayed steps, its gradient made for a CPU: nothing that does not depend on the
recurrent state is in the loop, and no kernel's gradient either.

The plain gradient of a scan adds to every kernel's gradient at every step, which for few rows is
more traffic than the step itself, and multiplies by transposed kernels, which takes three times
what the step's own products take. Here the way back keeps what each layer's output is to be
changed by, and every kernel gets its gradient from all rows at once (`nets.outer`). What lies
between the products is computed anew: it costs less than keeping it.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from mjx_cl.dreamer import nets
from mjx_cl.dreamer.rssm import RSSM, dense_part, hoist, join, sample
from mjx_cl.types import Array

Path = tuple[str, ...]  # of a layer in the RSSM
IN_DETER: Path = ("in_deter", "linear")
IN_STOCH: Path = ("in_stoch", "linear")
CORE: Path = ("core_hidden",)
GATES: Path = ("core_gates",)
HIDDEN: Path = ("post_hidden", "linear")
OUT: Path = ("post_out",)
PRODUCTS = (IN_DETER, IN_STOCH, CORE, GATES, HIDDEN, OUT)  # the layers in the loop, in their order
SHARED = 1  # which input of CORE is no deter

State = tuple[Float[Array, "rows deter"], Float[Array, "rows stoch"]]
States = tuple[
  Float[Array, "steps rows deter"],
  Float[Array, "steps rows stoch"],
  Float[Array, "steps rows variables classes"],
]


class Inputs(NamedTuple):
  """What meets the state at each step, leading (T, B).

  Attributes:
    keep: (..., 1), 0 where an episode starts, else 1.
    acted: (..., hidden), what the core makes of the action.
    seen: (..., hidden), what the posterior's first layer makes of the tokens.
    uniform: (..., variables), numbers in [0, 1).
  """

  keep: jax.Array
  acted: jax.Array
  seen: jax.Array
  uniform: jax.Array


def inputs(
  rssm: RSSM,
  params: Any,
  action: Float[Array, "steps rows act"],
  first: Float[Array, "steps rows"],
  tokens: Float[Array, "steps rows units"],
  uniform: Float[Array, "steps rows variables"],
) -> Inputs:
  """`Inputs` of all steps at once."""
  keep = 1.0 - first[..., None]
  acted: Any = rssm.apply({"params": params}, action * keep, method="acted")
  kernel = params["post_hidden"]["linear"]["kernel"][-tokens.shape[-1] :]
  return Inputs(keep, acted, nets.product(tokens, kernel), uniform)


def step(
  rssm: RSSM, variables: Any, state: State, x: Inputs, layers: dict[Path, Any]
) -> tuple[Array, Array, Array]:
  """Deter, stoch and logits one step on; `layers` take the place of products."""
  deter, stoch = (part * x.keep for part in state)
  with nets.instead({("in_action",): lambda *_: x.acted} | layers):
    new: Any = rssm.apply(variables, deter, stoch, x.acted, method="core")
    logits: Any = rssm.apply(variables, new, x.seen, method="posterior")
  return new, sample(logits, x.uniform).reshape(stoch.shape), logits


def steps(
  rssm: RSSM, params: Any, start: State, xs: Inputs
) -> tuple[States, dict[Path, tuple[tuple[Array, ...], Array]]]:
  """States and logits, and of each product its inputs and its output, all with leading T."""
  variables, hidden = hoist(params), params["post_hidden"]["linear"]
  kernel = hidden["kernel"][: start[0].shape[-1]]

  def one(state: State, x: Inputs) -> tuple[State, tuple[Any, Any]]:
    kept = {}

    def layer(path: Path, method: Any, *given: Array) -> Array:
      y = given[0] @ kernel + hidden["bias"] + x.seen if path == HIDDEN else method(*given)
      kept[path] = given, y
      return y

    layers = {path: functools.partial(layer, path) for path in PRODUCTS}
    deter, stoch, logits = step(rssm, variables, state, x, layers)
    return (deter, stoch), ((deter, stoch, logits), kept)

  return jax.lax.scan(one, start, xs)[1]


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def posteriors(rssm: RSSM, params: Any, start: State, xs: Inputs) -> States:
  """Posterior states and logits from a start on."""
  return steps(rssm, params, start, xs)[0]


def forward(rssm: RSSM, params: Any, start: State, xs: Inputs) -> tuple[States, Any]:
  """With what the way back needs."""
  out, kept = steps(rssm, params, start, xs)
  outputs = {path: y for path, (_, y) in kept.items()}
  met = {GATES: kept[GATES][0][0], OUT: kept[OUT][0][0], CORE: kept[CORE][0][SHARED]}
  before = tuple(jnp.concatenate([s[None], x[:-1]]) for s, x in zip(start, out))
  return out, (params, xs, before, out[0], outputs, met)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def known(back: Any, y: Array, *xs: Array) -> Array:
  """`y`, the output of a product of `xs`; `back` turns its cotangent into theirs."""
  return y


known.defvjp(lambda back, y, *xs: (y, None), lambda back, _, g: (g, *back(g)))


def ways_back(rssm: RSSM, params: Any, deter: int) -> dict[Path, Any]:
  """Of each product, what turns its output's cotangent into those of its inputs. Kernels are
  transposed here, outside of the loop.
  """
  turned = lambda kernel: jax.lax.optimization_barrier(kernel.swapaxes(-1, -2))
  kernel = lambda path: functools.reduce(lambda tree, name: tree[name], path, params)["kernel"]
  width = deter // rssm.size.blocks
  own, shared = turned(kernel(CORE)[:, :width]), turned(dense_part(kernel(CORE), width))
  gates, hidden = turned(kernel(GATES)), turned(kernel(HIDDEN)[:deter])
  plain = {path: turned(kernel(path)) for path in (IN_DETER, IN_STOCH, OUT)}
  blocks = lambda g, k: jnp.einsum("gno,goi->gni", g, k)
  return {path: lambda g, k=k: (g @ k,) for path, k in plain.items()} | {
    CORE: lambda g: (blocks(g, own), join(g) @ shared),
    GATES: lambda g: (blocks(g, gates),),
    HIDDEN: lambda g: (g @ hidden, g),
  }


def with_gains(gains: dict[str, Any], layers: dict[str, Any]) -> dict[str, Any]:
  """The layers that have gains, with those."""
  whole = lambda name: {**layers[name], "norm": gains[name]}
  return {name: whole(name) if "linear" in layers[name] else gains[name] for name in gains}


def backward(rssm: RSSM, kept: Any, cotangents: States) -> tuple[Any, State, Inputs]:
  """Gradients of parameters, start and inputs."""
  params, xs, before, deter, outputs, met = kept
  back = ways_back(rssm, params, deter.shape[-1])
  gains = {name: params[name] for name in ("in_deter", "in_stoch", "core_norm", "post_hidden")}
  gains = {name: own.get("norm", own) for name, own in gains.items()}

  def again(
    gains: Any, state: State, acted: Array, outputs: Any, x: Inputs
  ) -> tuple[Array, Array, Array]:
    own = {**params, **with_gains(gains, params)}
    layer = lambda path: lambda _, *given: known(back[path], outputs[path], *given)
    layers = {path: layer(path) for path in PRODUCTS}
    return step(rssm, {"params": own}, state, x._replace(acted=acted), layers)

  def one(total: tuple[State, Any], x: Any) -> tuple[tuple[State, Any], Any]:
    (after, sums), (x, state, outputs, (deter, stoch, logits)) = total, x
    _, pull = jax.vjp(functools.partial(again, x=x), gains, state, x.acted, outputs)
    new, state, acted, changes = pull((after[0] + deter, after[1] + stoch, logits))
    return (state, jax.tree.map(jnp.add, sums, new)), (acted, changes)

  zeros = jax.tree.map(jnp.zeros_like, (tuple(x[0] for x in before), gains))
  (start, sums), (acted, changes) = jax.lax.scan(
    one, zeros, (xs, before, outputs, cotangents), reverse=True
  )
  was = tuple(x * xs.keep for x in before)
  grads = gradients(rssm, params, was, deter, met, changes)
  grads |= with_gains(sums, grads)
  none = jnp.zeros_like
  return grads, start, Inputs(none(xs.keep), acted, changes[HIDDEN], none(xs.uniform))


def gradients(
  rssm: RSSM,
  params: Any,
  was: tuple[Array, Array],
  deter: Float[Array, "steps rows deter"],
  met: dict[Path, Array],
  changes: dict[Path, Array],
) -> dict[str, Any]:
  """Of the products' kernels and biases, from all steps: what each met, what its output is to be
  changed by.
  """
  blocks = lambda x: x.swapaxes(0, 1).reshape(rssm.size.blocks, -1, x.shape[-1])
  each = lambda x, y: jnp.einsum("gni,gno->gio", blocks(x), blocks(y))
  dense = lambda path, x: {
    "kernel": nets.outer(x, changes[path]),
    "bias": jnp.sum(changes[path], (0, 1)),
  }
  flat = lambda path: jnp.sum(changes[path], (0, 2)).reshape(-1)
  chunks = was[0].reshape(was[0].shape[:2] + (rssm.size.blocks, -1)).swapaxes(1, 2)
  core = changes[CORE].swapaxes(1, 2)
  shared = nets.outer(met[CORE], core.reshape(core.shape[:2] + (-1,)))
  shared = shared.reshape(-1, rssm.size.blocks, core.shape[-1]).swapaxes(0, 1)
  hidden, none = dense(HIDDEN, deter), params["post_hidden"]["linear"]["kernel"][deter.shape[-1] :]
  hidden["kernel"] = jnp.concatenate([hidden["kernel"], jnp.zeros_like(none)])  # `inputs` has those
  return jax.tree.map(jnp.zeros_like, params) | {
    "in_deter": {"linear": dense(IN_DETER, was[0])},
    "in_stoch": {"linear": dense(IN_STOCH, was[1])},
    "core_hidden": {
      "kernel": jnp.concatenate([each(chunks, changes[CORE]), shared], 1),
      "bias": flat(CORE),
    },
    "core_gates": {"kernel": each(met[GATES], changes[GATES]), "bias": flat(GATES)},
    "post_hidden": {"linear": hidden},
    "post_out": dense(OUT, met[OUT]),
  }


posteriors.defvjp(forward, backward)
