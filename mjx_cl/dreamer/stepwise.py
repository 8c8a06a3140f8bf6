"""Actor and critic losses of behaviour.py computed state by state: the heads that need no gradient
are read where the state is at hand, inside the imagination, and a second scan takes loss and
gradient of actor and critic. Nothing of the size (H, starts, bins) is ever written, since on a CPU
memory traffic is what costs (benchmarks/README.md).
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, PRNGKeyArray

from mjx_cl.dreamer import behaviour, heads, nets
from mjx_cl.dreamer.behaviour import Imagined, States, Sums, readings
from mjx_cl.dreamer.networks import Networks
from mjx_cl.dreamer.state import Latent
from mjx_cl.types import Array

CORE = (("in_deter", "linear"), ("in_stoch", "linear"))  # what of the core meets the state


class Projection(NamedTuple):
  """All linear layers that meet one state, side by side: the heads' first layers (policy, value,
  reward, continue, slow value), then the core's two.

  Attributes:
    deter: kernel (D, 5 U + hidden).
    stoch: kernel (S, 5 U + hidden).
    heads: bias (5 U,).
    core: biases (hidden,) of the core's two.
  """

  deter: jax.Array
  stoch: jax.Array
  heads: jax.Array
  core: tuple[jax.Array, jax.Array]


def first_layer(head: Any) -> dict[str, Any]:
  """Parameters of a head's first layer, of its parameters."""
  return functools.reduce(lambda tree, name: tree[name], heads.FIRST, head)


def side_by_side(params: Any, slow: Any) -> Projection:
  """`Projection` of prepared parameters."""
  layers = [first_layer(params[head]) for head in ("pol", "val", "rew", "con")]
  layers.append(first_layer(slow))
  core = [params["dyn"]["params"][name][layer] for name, layer in CORE]
  width = len(core[0]["kernel"])
  return Projection(
    jnp.concatenate([layer["kernel"][:width] for layer in layers] + [core[0]["kernel"]], 1),
    jnp.concatenate([layer["kernel"][width:] for layer in layers] + [core[1]["kernel"]], 1),
    jnp.concatenate([layer["bias"] for layer in layers]),
    (core[0]["bias"], core[1]["bias"]),
  )


def look(
  agent: Networks, params: Any, slow: Any, layers: Projection, state: Latent
) -> tuple[list[Array], tuple[Array, ...], dict[tuple[str, ...], Array]]:
  """First layers of policy and value at a state, `readings`, and what the core's layers give."""
  from_deter, from_stoch = state.deter @ layers.deter, state.stoch @ layers.stoch
  width = layers.heads.size
  pol, val, rew, con, slow_val = jnp.split(
    from_deter[:, :width] + from_stoch[:, :width] + layers.heads, 5, 1
  )
  said = readings(agent, params, slow, state.deter, state.stoch, (rew, con, val, slow_val))
  own = from_deter[:, width:] + layers.core[0], from_stoch[:, width:] + layers.core[1]
  return [pol, val], said, dict(zip(CORE, own))


def imagine(
  agent: Networks,
  params: Any,
  slow: Any,
  deter: Float[Array, "rows deter"],
  stoch: Float[Array, "rows stoch"],
  key: PRNGKeyArray,
) -> Imagined:
  """`Imagined` with the heads read inside the scan; the same draws as `agent.imagine`."""
  uniform, noise = agent.draws(key, agent.config.imagine, len(deter))
  params = agent.prepare(params)
  layers = side_by_side(params, slow)

  def step(state: Latent, x: tuple[Array, Array]) -> tuple[Latent, tuple[Any, ...]]:
    noise, uniform = x
    first, said, core = look(agent, params, slow, layers, state)
    raw = heads.read(agent.pol, params["pol"], state.deter, state.stoch, first[0])
    mean, std = nets.normal(*raw, *agent.deviations)
    action = mean + std * noise
    with nets.given(core):
      after = agent.follow(params, state, action, uniform)
    return after, (state.deter, state.stoch, action, said, tuple(first))

  end, (deters, stochs, actions, (rew, con, val, slow_val), first) = jax.lax.scan(
    step, agent.latent(params, deter, stoch), (noise[:-1], uniform)
  )
  _, last, _ = look(agent, params, slow, layers, end)
  shift = lambda x, final: jnp.concatenate([x[1:], final[None]])
  states = States(deters, stochs, first, actions)
  after = shift(rew, last[0]), shift(con, last[1]), shift(val, last[2])
  return Imagined(states, *after, con[0], val, slow_val)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def sums(agent: Networks, pol: Any, val: Any, states: States, *against: Array) -> Sums:
  """`behaviour.sums` added up over the states, gradients taken on the way: the backward pass only
  scales them.
  """
  at = lambda x: behaviour.sums(agent, pol, val, *x)
  step = lambda total, x: (jax.tree.map(jnp.add, total, at(x)), None)
  return jax.lax.scan(step, (jnp.float32(0),) * 3, (states, *against))[0]


def gradients(
  agent: Networks, pol: Any, val: Any, states: States, *against: Array
) -> tuple[tuple[Sums, tuple[Any, Any]], Array]:
  """Losses at one state, gradients of policy + value (the two share no parameter), and side by side
  those of what both first layers give, whose own parameters are left at zero.
  """

  def total(pol: Any, val: Any, first: Any) -> tuple[Array, Sums]:
    out = behaviour.sums(agent, pol, val, states._replace(first=first), *against)
    return out[0] + out[1], out

  grad = jax.grad(total, (0, 1, 2), has_aux=True)
  (grad_pol, grad_val, grad_first), out = grad(pol, val, states.first)
  return (out, (grad_pol, grad_val)), jnp.concatenate(grad_first, 1)


def forward(
  agent: Networks, pol: Any, val: Any, states: States, *against: Array
) -> tuple[Sums, tuple[tuple[Any, Any], int]]:
  """Sums and gradients over the states. First layers (kernel that meets deter, that meets stoch,
  bias) come last, in one product over all states: it takes half the time of one for each step.
  """
  xs = (states, *against)
  at = lambda x: gradients(agent, pol, val, *x)
  start = jax.tree.map(
    lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(at, jax.tree.map(lambda x: x[0], xs))[0]
  )

  def step(total: Any, x: Any) -> tuple[Any, Array]:
    new, first = at(x)
    return jax.tree.map(jnp.add, total, new), first

  (out, grads), first = jax.lax.scan(step, start, xs)
  grads = jax.tree.map(lambda x: x, grads)  # a copy, in which first layers take their place
  with_deter, with_stoch = (
    jnp.split(nets.outer(x, first), 2, 1) for x in (states.deter, states.stoch)
  )
  bias = jnp.split(jnp.sum(first, (0, 1)), 2)
  for i, grad in enumerate(grads):
    layer = first_layer(grad)
    layer["kernel"], layer["bias"] = jnp.concatenate([with_deter[i], with_stoch[i]]), bias[i]
  return out, (grads, len(xs))


def backward(
  agent: Networks, kept: tuple[tuple[Any, Any], int], cotangent: Sums
) -> tuple[Any, ...]:
  """The entropy is a metric, its own gradient is left out; states hold no gradient."""
  (pol, val), number = kept
  scale = lambda tree, factor: jax.tree.map(lambda g: factor * g, tree)
  return scale(pol, cotangent[0]), scale(val, cotangent[1]), *(None,) * number


sums.defvjp(forward, backward)
