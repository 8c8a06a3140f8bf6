"""The learner of DreamerV3 for one seed: its loss and its update.

Loss (all terms means over their elements), as in the authors' code (danijar/dreamerv3 at e3f0224):
  L = dyn + 0.1 rep + rec + rew + con + policy + value + 0.3 repval
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Float, Int, PRNGKeyArray

from mjx_cl.config import DreamerConfig
from mjx_cl.dreamer import behaviour, losses, nets, optim, rssm, stepwise
from mjx_cl.dreamer.networks import Networks, later, parameter_count, sg
from mjx_cl.dreamer.state import Carry, Record, TrainState, Weights
from mjx_cl.types import Array

__all__ = ["Agent", "Carry", "Record", "TrainState", "Weights", "culprit", "parameter_count"]

CAUSES = (
  "loss/dyn",
  "loss/rep",
  "loss/rec",
  "loss/rew",
  "loss/con",
  "loss/value",
  "loss/repval",
  "loss/policy",
  "loss/clone",
  "loss/anchor",
  "opt/loss",
  "opt/grad_norm",
)
EXPLODED = 1e6  # of a loss; those of the shipped agents (results/*/curve.parquet) stay below 10


def culprit(metrics: dict[str, Float[Array, ""]]) -> Int[Array, ""]:
  """Which of CAUSES is at fault in the metrics of an update, int32 (); -1: none.

  A loss is at fault where it is not finite or beyond EXPLODED, the gradient's norm where it is not
  finite. The world model's losses come first, then the critic's and the actor's, which are made of
  its dreams: the first one names the origin.
  """
  most = dict.fromkeys(CAUSES, EXPLODED) | {"opt/grad_norm": jnp.finfo(jnp.float32).max}
  at_fault: list[Array] = [
    ~(jnp.abs(metrics[k]) <= most[k]) if k in metrics else jnp.bool_(False) for k in CAUSES
  ]
  bad = jnp.stack(at_fault)
  return jnp.where(jnp.any(bad), jnp.argmax(bad), -1).astype(jnp.int32)


class Agent(Networks):
  """DreamerV3 for `obs_size` observations and `act_size` actions.

  Args:
    config: DreamerConfig.
    obs_size: observation variables.
    act_size: action variables.
    clone_std: deviation of the demonstrator's action in the cloning term, or None: the term is not
      compiled.
    stepwise: the form of actor and critic losses (behaviour.py); None: stepwise on a CPU, stacked
      elsewhere.
  """

  def __init__(
    self,
    config: DreamerConfig,
    obs_size: int,
    act_size: int,
    clone_std: float | None = None,
    stepwise: bool | None = None,
  ) -> None:
    super().__init__(config, obs_size, act_size)
    self.clone_std = clone_std
    self.stepwise = jax.default_backend() == "cpu" if stepwise is None else stepwise
    self.discount = 1.0 - 1.0 / config.horizon
    self.optimizer = optim.laprop(config.lr, config.warmup, config.agc)

  def init(self, key: PRNGKeyArray) -> TrainState:
    """Fresh parameters, moments and counters from `key`."""
    params = self.init_params(key)
    slow = jax.tree.map(jnp.copy, params["val"])
    return TrainState(params, slow, self.optimizer.init(params), jnp.zeros(2), jnp.int32(0))

  # ---- loss --------------------------------------------------------------------------------------

  def loss(
    self,
    params: Any,
    slow: Any,
    range_: Float[Array, "2"],
    batch: Record,
    key: PRNGKeyArray,
    weights: Weights = Weights(),
  ) -> tuple[Float[Array, ""], tuple[dict[str, Array], Array, Array, Array]]:
    """The joint objective.

    Args:
      params: of the networks.
      slow: of the slow critic.
      range_: TrainState.range.
      batch: windows (B, 1 + T).
      key: of latents and dreams.
      weights: of the terms that a demonstrator needs.

    Returns:
      (L, (metrics, new range (2,), deter (B, T, D), stoch indices (B, T, stoch))). metrics: name ->
      float32 (); `loss/*` are unscaled.
    """
    c = self.config
    key_observe, key_imagine = jax.random.split(key)
    seen = jax.tree.map(later, batch)
    seen = seen._replace(
      last=seen.last.astype(jnp.float32), terminal=seen.terminal.astype(jnp.float32)
    )
    deter, stoch, logits = self.observe(params, batch, key_observe)
    prior = self._apply(params, "dyn", deter, method="prior")
    terms = self._world_losses(params, deter, stoch, logits, prior, seen)
    img, repval = self._behaviour_losses(params, slow, range_, deter, stoch, seen, key_imagine)
    terms = {k: jnp.mean(v) for k, v in (terms | {"repval": repval}).items()}
    total = (
      terms["dyn"]
      + c.rep_scale * terms["rep"]
      + terms["rec"]
      + terms["rew"]
      + terms["con"]
      + weights.policy * img.policy
      + img.value
      + c.repval_scale * terms["repval"]
    )
    terms |= {"policy": img.policy, "value": img.value}
    if self.clone_std is not None:
      terms["clone"] = self._clone_loss(params, sg(deter), sg(stoch), seen, self.clone_std)
      total = total + weights.clone * terms["clone"]
    if c.anchor:
      terms["anchor"] = self._anchor_loss(params, sg(deter), sg(stoch), seen)
      total = total + c.anchor * terms["anchor"]
    metrics = {f"loss/{k}": v for k, v in terms.items()} | img.metrics | {"opt/loss": total}
    metrics |= {"dyn_ent": rssm.entropy(prior), "rep_ent": rssm.entropy(logits)}
    stoch = jnp.argmax(stoch.reshape(logits.shape), -1)
    return total, (metrics, img.range, sg(deter).swapaxes(0, 1), stoch.swapaxes(0, 1))

  def _world_losses(
    self,
    params: Any,
    deter: Float[Array, "steps batch deter"],
    stoch: Float[Array, "steps batch stoch"],
    logits: Float[Array, "steps batch variables classes"],
    prior: Float[Array, "steps batch variables classes"],
    seen: Record,
  ) -> dict[str, Float[Array, "steps batch"]]:
    """Losses of the world model at each posterior state; `seen`: records there, time-major."""
    terms = {
      "dyn": jnp.maximum(self.config.free_nats, rssm.kl(sg(logits), prior)),
      "rep": jnp.maximum(self.config.free_nats, rssm.kl(logits, sg(prior))),
      "rec": jnp.sum(
        jnp.square(
          self._apply(params, "dec", deter, stoch) - nets.symlog(seen.obs / self.obs_scale)
        ),
        -1,
      ),
      "rew": nets.two_hot_loss(self._apply(params, "rew", deter, stoch), seen.reward, self.bins),
    }
    con = self._apply(params, "con", deter, stoch)[..., 0]
    target = (1.0 - seen.terminal) * self.discount
    terms["con"] = -target * jax.nn.log_sigmoid(con) - (1.0 - target) * jax.nn.log_sigmoid(-con)
    return terms

  def _behaviour_losses(
    self,
    params: Any,
    slow: Any,
    range_: Float[Array, "2"],
    deter: Float[Array, "steps batch deter"],
    stoch: Float[Array, "steps batch stoch"],
    seen: Record,
    key: PRNGKeyArray,
  ) -> tuple[behaviour.Behaviour, Float[Array, "replayed batch"]]:
    """Losses on dreams from the last `last_starts` states of each sequence, and of the value on
    these states themselves. No gradient passes from dreams into the dynamics; the features of the
    replayed value are not stopped.
    """
    c = self.config
    tail = slice(len(deter) - (c.last_starts or len(deter)), None)
    flat = lambda x: x[tail].reshape((-1,) + x.shape[2:])
    img = self.judge(params, slow, range_, flat(deter), flat(stoch), key)
    reward, terminal, last = seen.reward[tail], seen.terminal[tail], seen.last[tail]
    target = losses.replay_return(
      reward, terminal, last, img.boot.reshape(reward.shape), c.lam, self.discount
    )
    deter, stoch = deter[tail][:-1], stoch[tail][:-1]
    logits = self.value(params["val"], deter, stoch)
    slow_value = nets.two_hot_mean(self.value(slow, sg(deter), sg(stoch)), self.bins)
    return img, (1.0 - last[:-1]) * (
      nets.two_hot_loss(logits, target, self.bins)
      + nets.two_hot_loss(logits, slow_value, self.bins)
    )

  def judge(
    self,
    params: Any,
    slow: Any,
    range_: Float[Array, "2"],
    deter: Float[Array, "rows deter"],
    stoch: Float[Array, "rows stoch"],
    key: PRNGKeyArray,
  ) -> behaviour.Behaviour:
    """Losses of actor and critic on dreams from rows of states."""
    form = (
      (stepwise.imagine, stepwise.sums) if self.stepwise else (behaviour.imagine, behaviour.sums)
    )
    return behaviour.losses(self, params, slow, range_, deter, stoch, key, *form)

  def _clone_loss(
    self,
    params: Any,
    deter: Float[Array, "steps batch deter"],
    stoch: Float[Array, "steps batch stoch"],
    seen: Record,
    clone_std: float,
  ) -> Float[Array, ""]:
    """Mean over labelled replayed states of KL(N(demo, clone_std^2) || policy) [nats]."""
    mean, std = self._policy(params, deter, stoch)
    spread = clone_std**2 + jnp.square(mean - seen.demo)
    kl = jnp.sum(jnp.log(std / clone_std) + spread / (2 * jnp.square(std)) - 0.5, -1)
    has = seen.has_demo.astype(jnp.float32)
    return jnp.sum(kl * has) / jnp.maximum(1.0, jnp.sum(has))

  def _anchor_loss(
    self,
    params: Any,
    deter: Float[Array, "steps batch deter"],
    stoch: Float[Array, "steps batch stoch"],
    seen: Record,
  ) -> Float[Array, ""]:
    """Mean over replayed states of -log policy(action taken) [nats], for the policy's mean alone;
    at an episode's last state none was taken.

    The deviation is held: fitted to actions that were drawn from it, it would take in the error of
    the mean, and grow with every round.
    """
    mean, std = self._policy(params, deter, stoch)
    taken = 1.0 - seen.last
    logp = nets.normal_logp(mean, sg(std), seen.action)
    return -jnp.sum(logp * taken) / jnp.maximum(1.0, jnp.sum(taken))

  # ---- update ------------------------------------------------------------------------------------

  def update(
    self, state: TrainState, batch: Record, key: PRNGKeyArray, weights: Weights = Weights()
  ) -> tuple[TrainState, dict[str, Array], tuple[Array, Array]]:
    """One gradient step. Where a loss or the gradient is at fault (`culprit`) nothing changes, the
    counter included.

    Returns:
      (state', metrics, (deter (B, T, D), stoch indices (B, T, stoch)) for the latent refresh).
    """
    c = self.config
    grads, (metrics, range_, deter, stoch) = jax.grad(self.loss, has_aux=True)(
      state.params, state.slow, state.range, batch, key, weights
    )
    steps, opt = self.optimizer.update(grads, state.opt, state.params)
    steps = jax.tree.map(lambda x: weights.lr * x, steps)
    if c.model_lr != 1.0:
      model = ("enc", "dyn", "dec")
      steps |= {k: jax.tree.map(lambda x: c.model_lr * x, steps[k]) for k in model}
    if c.policy_lr != 1.0:
      steps = {**steps, "pol": jax.tree.map(lambda x: c.policy_lr * x, steps["pol"])}
    params = optax.apply_updates(state.params, steps)
    mix = lambda s, p: (1.0 - c.slow_rate) * s + c.slow_rate * p
    slow = jax.tree.map(mix, state.slow, params["val"])
    metrics["opt/grad_norm"] = optax.global_norm(grads)
    sound = culprit(metrics) < 0
    new = TrainState(params, slow, opt, range_, state.updates + 1)
    return jax.tree.map(lambda a, b: jnp.where(sound, a, b), new, state), metrics, (deter, stoch)
