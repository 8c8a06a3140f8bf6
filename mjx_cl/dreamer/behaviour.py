"""Actor and critic on imagined states: the losses in one piece of plain code, and the same computed
step by step for a CPU.

With imagined states s_0..s_H (no gradient), R the lambda-return, S the return scale and omega the
product of continues:
  policy = -mean omega_i [log pi(a_i | s_i) sg((R_i - v_i) / S) + eta H(pi(s_i))]
  value  =  mean omega_i [CE(v(s_i), sg R_i) + CE(v(s_i), sg v_slow(s_i))],   i = 0..H-1, means over
    i and starts

`stacked` keeps all states and puts one large product per layer through each head. `stepwise` reads
the heads that need no gradient where the state is at hand, inside the imagination, and takes loss
and gradient of actor and critic state by state in a second scan: nothing of the size (H, starts,
bins) is ever written. On 2 CPU cores memory traffic is what costs (benchmarks/README.md); for a GPU
`stacked` is a choice by expectation, not measured.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_cl.dreamer import losses, nets

if TYPE_CHECKING:
  from mjx_cl.dreamer.agent import Agent, Latent

sg = jax.lax.stop_gradient


class Imagined(NamedTuple):
  """States 0..H-1 and what the heads without gradient say of them, each (H, N, ...).

  Attributes:
    deter (D,), stoch (S,), action (A,): state i and the action chosen there.
    rew, con, val: predictions at states 1..H; con0 (N,): continue at state 0; val0: value at states
      0..H-1; slow: slow critic there.
    pre: outputs (U,) of the first layer of policy and value, or None.
  """

  deter: jax.Array
  stoch: jax.Array
  action: jax.Array
  rew: jax.Array
  con: jax.Array
  val: jax.Array
  con0: jax.Array
  val0: jax.Array
  slow: jax.Array
  pre: tuple | None


def readings(
  agent: Agent,
  params: Any,
  slow: Any,
  *features: jax.Array,
  pre: tuple[jax.Array | None, ...] = (None,) * 4,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
  """Reward, continue, value and slow value (...) at states (..., D), (..., S), or from the first
  layers' outputs `pre`.
  """
  read = lambda head, own, pre: head.apply({"params": own}, *features, pre=pre)
  mean = lambda logits: nets.two_hot_mean(logits, agent.bins)
  return (
    mean(read(agent.rew, params["rew"], pre[0])),
    jax.nn.sigmoid(read(agent.con, params["con"], pre[1])[..., 0]),
    mean(read(agent.val, params["val"], pre[2])),
    mean(read(agent.val, slow, pre[3])),
  )


def step_losses(
  agent: Agent,
  pol: Any,
  val: Any,
  features: tuple[jax.Array, ...],
  action: jax.Array,
  adv: jax.Array,
  omega: jax.Array,
  ret: jax.Array,
  slow: jax.Array,
  pre: tuple[jax.Array | None, ...] = (None, None),
) -> tuple[jax.Array, jax.Array, jax.Array]:
  """Sums over rows of the policy loss, the value loss and the entropy, three float32 ()."""
  mean, std = nets.normal(
    *agent.pol.apply({"params": pol}, *features, pre=pre[0]), *agent.deviations
  )
  entropy = nets.normal_entropy(std)
  policy = -omega * (nets.normal_logp(mean, std, action) * adv + agent.config.entropy * entropy)
  logits = agent.val.apply({"params": val}, *features, pre=pre[1])
  value = omega * (
    nets.two_hot_loss(logits, ret, agent.bins) + nets.two_hot_loss(logits, slow, agent.bins)  # type: ignore[arg-type]
  )
  return jnp.sum(policy), jnp.sum(value), jnp.sum(entropy)


# ---- large products ------------------------------------------------------------------------------


def imagine_stacked(
  agent: Agent, params: Any, slow: Any, deter: jax.Array, stoch: jax.Array, key: jax.Array
) -> Imagined:
  """`Imagined` from the stacked states of `agent.imagine`."""
  deter, stoch, action = agent.imagine(params, deter, stoch, key, agent.config.imagine)
  rew, con, val, slow_val = readings(agent, params, slow, deter, stoch)
  return Imagined(
    deter[:-1],
    stoch[:-1],
    action[:-1],
    rew[1:],
    con[1:],
    val[1:],
    con[0],
    val[:-1],
    slow_val[:-1],
    None,
  )


def sums_stacked(
  agent: Agent, pol: Any, val: Any, img: Imagined, *targets: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
  """`step_losses` over all states at once."""
  return step_losses(agent, pol, val, (img.deter, img.stoch), img.action, *targets)  # type: ignore[arg-type]


# ---- state by state ------------------------------------------------------------------------------

FIRST = ("mlp", "hidden0", "linear")  # where a head keeps its first layer


def first_layer(head: Any) -> dict[str, Any]:
  """Parameters of a head's first layer, of its parameters."""
  for name in FIRST:
    head = head[name]
  return head


def imagine_stepwise(
  agent: Agent, params: Any, slow: Any, deter: jax.Array, stoch: jax.Array, key: jax.Array
) -> Imagined:
  """`Imagined` with the heads read inside the scan; the same draws as `agent.imagine`.

  The first layers of all heads and of the core's two projections meet the same state: one product
  with deter, one with stoch.
  """
  steps, rows, width = agent.config.imagine, deter.shape[0], deter.shape[1]
  uniform, noise = agent.draws(key, steps, rows)
  params = agent.prepare(params)
  layers = [
    first_layer(head) for head in (params["pol"], params["val"], params["rew"], params["con"], slow)
  ]
  core = params["dyn"]["params"]
  own = [core[name]["linear"] for name in ("in_deter", "in_stoch")]
  with_deter = jnp.concatenate(
    [layer["kernel"][:width] for layer in layers] + [own[0]["kernel"]], 1
  )
  with_stoch = jnp.concatenate(
    [layer["kernel"][width:] for layer in layers] + [own[1]["kernel"]], 1
  )
  bias = jnp.concatenate([layer["bias"] for layer in layers])

  def look(
    state: Latent,
  ) -> tuple[
    list[jax.Array], tuple[jax.Array, jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array]
  ]:
    """(policy and value parts (N, 2 U), what the heads say, the core's parts)."""
    from_deter, from_stoch = state.deter @ with_deter, state.stoch @ with_stoch
    pre = jnp.split(from_deter[:, : bias.size] + from_stoch[:, : bias.size] + bias, len(layers), 1)
    said = readings(agent, params, slow, pre=(pre[2], pre[3], pre[1], pre[4]))
    return (
      pre[:2],
      said,
      (from_deter[:, bias.size :] + own[0]["bias"], from_stoch[:, bias.size :] + own[1]["bias"]),
    )

  def step(state: Latent, x: tuple[jax.Array, jax.Array]) -> tuple[Latent, tuple[Any, ...]]:
    noise, uniform = x
    pre, said, parts = look(state)
    mean, std = nets.normal(
      *agent.pol.apply({"params": params["pol"]}, pre=pre[0]), *agent.deviations
    )
    action = mean + std * noise
    return agent.follow(params, state, action, uniform, parts), (
      state.deter,
      state.stoch,
      action,
      said,
      tuple(pre),
    )

  end, (deters, stochs, actions, (rew, con, val, slow_val), pre) = jax.lax.scan(
    step, agent.latent(params, deter, stoch), (noise[:-1], uniform)
  )
  last = look(end)[1]
  shift = lambda x, final: jnp.concatenate([x[1:], final[None]])
  return Imagined(
    deters,
    stochs,
    actions,
    shift(rew, last[0]),
    shift(con, last[1]),
    shift(val, last[2]),
    con[0],
    val,
    slow_val,
    pre,
  )


def sums_stepwise(
  agent: Agent, pol: Any, val: Any, img: Imagined, *targets: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
  """`step_losses` added up over the states, gradients taken on the way: the backward pass only
  scales them.
  """

  def losses_at(pol: Any, val: Any, x: tuple[Any, ...]) -> tuple[jax.Array, jax.Array, jax.Array]:
    _, _, pre, action, targets = x
    return step_losses(agent, pol, val, (), action, *targets, pre=pre)  # type: ignore[misc]

  def gradients_at(
    pol: Any, val: Any, x: tuple[Any, ...]
  ) -> tuple[Any, tuple[Any, Any], tuple[jax.Array, ...]]:
    """Losses, and gradients of policy + value: the two share no parameter. Those of the first
    layers follow from that of `pre`.
    """

    def total(
      pol: Any, val: Any, pre: tuple[jax.Array, ...]
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array]]:
      policy, value, entropy = losses_at(pol, val, (None, None, pre) + x[3:])
      return policy + value, (policy, value, entropy)

    (grad_pol, grad_val, grad_pre), out = jax.grad(total, (0, 1, 2), has_aux=True)(pol, val, x[2])
    joint = jnp.concatenate(grad_pre, 1)
    return out, (grad_pol, grad_val), (x[0].T @ joint, x[1].T @ joint, jnp.sum(joint, 0))

  def add_first(grads: tuple[Any, Any], first: tuple[jax.Array, ...]) -> tuple[Any, Any]:
    """Puts the gradients of both first layers in their place."""
    with_deter, with_stoch, bias = (jnp.split(x, 2, -1) for x in first)
    for i, grad in enumerate(grads):
      layer = first_layer(grad)  # zeros: `pre` stood in for it
      layer["kernel"], layer["bias"] = jnp.concatenate([with_deter[i], with_stoch[i]]), bias[i]
    return grads

  @jax.custom_vjp
  def total(pol: Any, val: Any, xs: tuple[Any, ...]) -> tuple[jax.Array, jax.Array, jax.Array]:
    step = lambda sums, x: (jax.tree.map(jnp.add, sums, losses_at(pol, val, x)), None)
    return jax.lax.scan(step, (jnp.float32(0),) * 3, xs)[0]

  def forward(
    pol: Any, val: Any, xs: tuple[Any, ...]
  ) -> tuple[tuple[jax.Array, jax.Array, jax.Array], tuple[Any, Any]]:
    at = lambda x: gradients_at(pol, val, x)
    start = jax.tree.map(
      lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(at, jax.tree.map(lambda x: x[0], xs))
    )
    (out, grads, first), _ = jax.lax.scan(
      lambda sums, x: (jax.tree.map(jnp.add, sums, at(x)), None), start, xs
    )
    return out, add_first(jax.tree.map(lambda x: x, grads), first)

  def backward(
    grads: tuple[Any, Any], cotangent: tuple[jax.Array, jax.Array, jax.Array]
  ) -> tuple[Any, Any, None]:
    scale = lambda tree, factor: jax.tree.map(lambda g: factor * g, tree)
    # the entropy is a metric, its own gradient is left out; xs hold no gradient
    return scale(grads[0], cotangent[0]), scale(grads[1], cotangent[1]), None

  total.defvjp(forward, backward)
  return total(pol, val, (img.deter, img.stoch, img.pre, img.action, targets))


# ---- both ----------------------------------------------------------------------------------------


class Behaviour(NamedTuple):
  """Losses of actor and critic.

  Attributes:
    policy, value: float32 (), means. boot: float32 (N,), imagined return from each start. range:
      (2,), the new percentile range.
    metrics: name -> float32 ().
  """

  policy: jax.Array
  value: jax.Array
  boot: jax.Array
  range: jax.Array
  metrics: dict[str, jax.Array]


def behaviour(
  agent: Agent,
  params: Any,
  slow: Any,
  range_: jax.Array,
  deter: jax.Array,
  stoch: jax.Array,
  key: jax.Array,
  stepwise: bool,
) -> Behaviour:
  """Imagines from rows (N, D), (N, S) and gives the losses.

  Args:
    stepwise: the form for a CPU, else large products; they agree up to the order of float32 sums.
  """
  c, frozen = agent.config, sg(params)
  imagine, sums = (imagine_stepwise, sums_stepwise) if stepwise else (imagine_stacked, sums_stacked)
  img = sg(imagine(agent, frozen, sg(slow), sg(deter), sg(stoch), key))
  ret = losses.lambda_return(img.rew, img.con, img.val, c.lam)
  omega = jnp.cumprod(jnp.concatenate([img.con0[None], img.con[:-1]]), 0)
  range_, scale = losses.update_range(range_, ret, c.range_rate)
  adv = (ret - img.val0) / scale
  out = sums(agent, params["pol"], params["val"], img, *sg((adv, omega, ret, img.slow)))
  policy, value, entropy = (x / adv.size for x in out)
  every = lambda inner, first: (
    (jnp.sum(inner) + jnp.sum(first)) / (inner.size + first.size)
  )  # over states 0..H
  metrics = {
    "adv": adv.mean(),
    "adv_std": adv.std(),
    "adv_mag": jnp.abs(adv).mean(),
    "ret": ((ret - range_[0]) / scale).mean(),
    "val": every(img.val, img.val0[0]),
    "tar": ret.mean(),
    "rew": img.rew.mean(),
    "con": every(img.con, img.con0),
    "weight": omega.mean(),
    "ent/action": entropy,
    "ret_scale": scale,
  }
  return Behaviour(policy, value, ret[0], range_, metrics)
