"""DreamerV3 as pure functions over one seed: `init`, `act`, `update`, `evaluate`, `open_loop`.

Loss (all terms means over their elements), as in the authors' code (danijar/dreamerv3 at e3f0224):
  L = dyn + 0.1 rep + rec + rew + con + policy + value + 0.3 repval
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mjx_cl.config import DreamerConfig
from mjx_cl.dreamer import behaviour, heads, losses, nets, optim, rssm
from mjx_cl.errors import UserError
from mjx_cl.sizes import SIZES

sg = jax.lax.stop_gradient


class Carry(NamedTuple):
  """What acting remembers of one robot: deter (D,), stoch (stoch * classes,), last sampled action
  (A,). Zeros at an episode's start.
  """

  deter: jax.Array
  stoch: jax.Array
  action: jax.Array


class Latent(NamedTuple):
  """Rows of states as a scan carries them: deter (N, D), the same as chunks (blocks, N, D /
  blocks), and stoch (N, S).
  """

  chunks: jax.Array
  deter: jax.Array
  stoch: jax.Array


class TrainState(NamedTuple):
  """Everything that training one seed changes, replay apart.

  Attributes:
    params: enc, dyn, dec, rew, con, pol, val -> flax parameters.
    slow: slow copy of params["val"].
    opt: optax state (RMS and momentum moments, counters).
    range: float32 (2,), EMA of the returns' 5th and 95th percentile.
    updates: int32 (), gradient steps taken.
  """

  params: dict[str, Any]
  slow: Any
  opt: Any
  range: jax.Array
  updates: jax.Array


class Batch(NamedTuple):
  """Windows from replay, batch-major (B, 1 + T, ...); index 0 is context.

  Attributes:
    obs (O,), action (A,) chosen after obs, reward () of arriving at obs, first, last, terminal:
    bool (). deter (D,), stoch: int (stoch,) class indices, latents as stored.
    demo (A,): the demonstrator's action at obs; has_demo: bool ().
  """

  obs: jax.Array
  action: jax.Array
  reward: jax.Array
  first: jax.Array
  last: jax.Array
  terminal: jax.Array
  deter: jax.Array
  stoch: jax.Array
  demo: jax.Array
  has_demo: jax.Array


class Weights(NamedTuple):
  """Traced weights of the terms that a demonstrator needs; the defaults are plain DreamerV3.

  Attributes:
    clone: weight of KL(N(demo, clone_std^2) || policy) on replayed states.
    policy: weight of the imagined policy loss.
    lr: factor on the learning rate.
  """

  clone: jax.Array | float = 0.0
  policy: jax.Array | float = 1.0
  lr: jax.Array | float = 1.0


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
EXPLODED = (
  1e6  # of a loss; in the curves of the shipped agents (results/*/curve.parquet) none is above 10
)


def culprit(metrics: dict[str, jax.Array]) -> jax.Array:
  """Which of CAUSES is at fault in the metrics of an update, int32 (); -1: none.

  A loss is at fault where it is not finite or beyond EXPLODED, the gradient's norm where it is not
  finite. The world model's losses come first, then the critic's and the actor's, which are made of
  its dreams: the first one names the origin.
  """
  bad: Any = [
    ~(
      jnp.abs(metrics[k])
      <= (EXPLODED if k.startswith("loss") or k == "opt/loss" else jnp.finfo(jnp.float32).max)
    )
    if k in metrics
    else jnp.bool_(False)
    for k in CAUSES
  ]
  bad = jnp.stack(bad)
  return jnp.where(jnp.any(bad), jnp.argmax(bad), -1).astype(jnp.int32)


class Agent:
  """DreamerV3 for `obs_size` observations and `act_size` actions.

  Args:
    config: DreamerConfig.
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
    self.stepwise = jax.default_backend() == "cpu" if stepwise is None else stepwise
    self.config, self.obs_size, self.act_size, self.clone_std = (
      config,
      obs_size,
      act_size,
      clone_std,
    )
    self.size = s = SIZES[config.size]
    self.deviations: tuple[float, ...] = config.min_std, config.max_std
    self.bins = jnp.asarray(nets.two_hot_bins(config.bins))
    if isinstance(config.obs_scale, str):
      raise UserError(
        "obs_scale `spec` is for training, where there is a robot; an agent takes the numbers"
      )
    if config.obs_scale and len(config.obs_scale) != obs_size:
      raise UserError(
        f"obs_scale has {len(config.obs_scale)} numbers for {obs_size} observation variables"
      )
    self.obs_scale = jnp.asarray(config.obs_scale or 1.0, jnp.float32)
    self.enc, self.dyn = heads.Encoder(s.units), rssm.RSSM(s)
    self.dec = heads.Decoder(s.units, obs_size)
    self.rew, self.con = heads.Head(1, s.units, config.bins, 0.0), heads.Head(1, s.units, 1, 1.0)
    self.pol, self.val = (
      heads.PolicyHead(s.units, act_size),
      heads.Head(3, s.units, config.bins, 0.0),
    )
    self.optimizer = optim.laprop(config.lr, config.warmup, config.agc)
    self.stoch_size = s.stoch * s.classes

  # ---- parameters --------------------------------------------------------------------------------

  def init(self, key: jax.Array) -> TrainState:
    """Fresh parameters, moments and counters from `key`."""
    keys = jax.random.split(key, 7)
    deter, stoch = jnp.zeros((1, self.size.deter)), jnp.zeros((1, self.stoch_size))
    action, tokens = jnp.zeros((1, self.act_size)), jnp.zeros((1, self.size.units))
    params = {
      "enc": self.enc.init(keys[0], jnp.zeros((1, self.obs_size)))["params"],
      "dyn": self.dyn.init(keys[1], deter, stoch, action, tokens)["params"],
    }
    for key, name in zip(keys[2:], ("dec", "rew", "con", "pol", "val")):
      params[name] = getattr(self, name).init(key, deter, stoch)["params"]
    return TrainState(
      params,
      jax.tree.map(jnp.copy, params["val"]),
      self.optimizer.init(params),
      jnp.zeros(2),
      jnp.int32(0),
    )

  def _apply(self, params: Any, name: str, *args: Any, **kwargs: Any) -> Any:
    own = params[name]
    return getattr(self, name).apply(own if "params" in own else {"params": own}, *args, **kwargs)

  def _encode(self, params: Any, obs: jax.Array) -> jax.Array:
    return self._apply(params, "enc", obs / self.obs_scale)

  def prepare(self, params: Any) -> dict[str, Any]:
    """The same parameters with what a scan over the core would otherwise re-arrange at every step;
    every method takes either form.
    """
    return {**params, "dyn": rssm.hoist(params["dyn"])} if "params" not in params["dyn"] else params

  def _core(self, params: Any, deter: jax.Array, stoch: jax.Array, action: jax.Array) -> jax.Array:
    return self._apply(params, "dyn", deter, stoch, action, method="core")

  def hot(self, index: jax.Array) -> jax.Array:
    """Class indices (..., stoch) -> flat one-hot (..., stoch * classes)."""
    return jax.nn.one_hot(index, self.size.classes).reshape(index.shape[:-1] + (self.stoch_size,))

  # ---- acting ------------------------------------------------------------------------------------

  def carry(self) -> Carry:
    """The carry at an episode's start."""
    return Carry(jnp.zeros(self.size.deter), jnp.zeros(self.stoch_size), jnp.zeros(self.act_size))

  def act(
    self, params: Any, carry: Carry, obs: jax.Array, key: jax.Array, deterministic: bool = False
  ) -> tuple[Carry, jax.Array]:
    """One posterior step and an action for one robot.

    Args:
      obs: float32 (O,).

    Returns:
      (carry', action (A,), unclipped; the environment clips). carry'.deter and .stoch are the
      posterior latent at obs.
    """
    key_z, key_a = jax.random.split(key)
    deter = self._core(params, carry.deter[None], carry.stoch[None], carry.action[None])
    logits = self._apply(params, "dyn", deter, self._encode(params, obs[None]), method="posterior")
    stoch = rssm.sample(logits, jax.random.uniform(key_z, (1, self.size.stoch))).reshape(1, -1)
    mean, std = nets.normal(*self._apply(params, "pol", deter, stoch), *self.deviations)
    action = mean if deterministic else mean + std * jax.random.normal(key_a, mean.shape)
    return Carry(deter[0], stoch[0], action[0]), action[0]

  # ---- world model -------------------------------------------------------------------------------

  def observe(
    self, params: Any, batch: Batch, key: jax.Array
  ) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Posterior states of the T trained steps, time-major: deter (T, B, D), stoch (T, B, S),
    posterior logits (T, B, stoch, classes).
    """
    length, rows = batch.obs.shape[1] - 1, batch.obs.shape[0]
    params = self.prepare(params)
    tokens = self._encode(params, batch.obs[:, 1:].swapaxes(0, 1))
    uniform = nets.in_a_row(jax.random.uniform, key, (length, rows, self.size.stoch))
    wide = lambda x, axis: (
      jnp.repeat(x, 2, axis) if rows == 1 else x
    )  # on a CPU the product of a single row takes twice the time of that of two

    def step(
      state: tuple[jax.Array, jax.Array], x: tuple[jax.Array, jax.Array, jax.Array, jax.Array]
    ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]:
      deter, stoch = state
      action, first, tokens, uniform = x
      keep = 1.0 - first[:, None]
      deter = self._core(params, deter * keep, stoch * keep, action * keep)
      logits = self._apply(params, "dyn", deter, tokens, method="posterior")
      stoch = rssm.sample(logits, uniform).reshape(deter.shape[0], -1)
      return (deter, stoch), (deter[:rows], stoch[:rows], logits[:rows])

    start = (wide(batch.deter[:, 0].astype(jnp.float32), 0), wide(self.hot(batch.stoch[:, 0]), 0))
    xs = (
      batch.action[:, :-1].swapaxes(0, 1),
      batch.first[:, 1:].swapaxes(0, 1).astype(jnp.float32),
      tokens,
      uniform,
    )
    return jax.lax.scan(step, start, jax.tree.map(lambda x: wide(x, 1), xs))[1]

  def imagine(
    self, params: Any, deter: jax.Array, stoch: jax.Array, key: jax.Array, steps: int
  ) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Policy and prior from rows (N, D), (N, S), no gradient.

    Returns:
      deter (steps + 1, N, D), stoch (steps + 1, N, S), action (steps + 1, N, A); index 0 is the
      start.
    """
    params, rows = sg(self.prepare(params)), deter.shape[0]
    uniform, noise = self.draws(key, steps, rows)

    def step(
      state: Latent, x: tuple[jax.Array, jax.Array]
    ) -> tuple[Latent, tuple[jax.Array, jax.Array, jax.Array]]:
      noise, uniform = x
      action = self.choose(params, state.deter, state.stoch, noise)
      return self.follow(params, state, action, uniform), (state.deter, state.stoch, action)

    end, states = jax.lax.scan(
      step, self.latent(params, sg(deter), sg(stoch)), (noise[:-1], uniform)
    )
    last = (end.deter, end.stoch, self.choose(params, end.deter, end.stoch, noise[-1]))
    return sg(jax.tree.map(lambda x, final: jnp.concatenate([x, final[None]]), states, last))

  def draws(self, key: jax.Array, steps: int, rows: int) -> tuple[jax.Array, jax.Array]:
    """Uniform numbers (steps, rows, stoch) for the prior and normal ones (steps + 1, rows, A) for
    the policy.
    """
    key_z, key_a = jax.random.split(key)
    return nets.in_a_row(jax.random.uniform, key_z, (steps, rows, self.size.stoch)), nets.in_a_row(
      jax.random.normal, key_a, (steps + 1, rows, self.act_size)
    )

  def choose(self, params: Any, deter: jax.Array, stoch: jax.Array, noise: jax.Array) -> jax.Array:
    """The policy's action (N, A) for standard normal `noise`."""
    mean, std = nets.normal(*self._apply(params, "pol", deter, stoch), *self.deviations)
    return mean + std * noise

  def latent(self, params: Any, deter: jax.Array, stoch: jax.Array) -> Latent:
    """Rows (N, D), (N, S) as a scan over the prior carries them."""
    return Latent(self._apply(params, "dyn", deter, method="cut"), deter, stoch)

  def follow(
    self,
    params: Any,
    state: Latent,
    action: jax.Array,
    uniform: jax.Array,
    pre: tuple[jax.Array | None, jax.Array | None] = (None, None),
  ) -> Latent:
    """One step of the prior, sampled with numbers `uniform` (N, stoch). `pre`: as in
    `RSSM.core_cut`.
    """
    chunks = self._apply(
      params, "dyn", state.chunks, state.deter, state.stoch, action, pre, method="core_cut"
    )
    deter = rssm.join(chunks)
    stoch = rssm.sample(self._apply(params, "dyn", deter, method="prior"), uniform).reshape(
      state.stoch.shape
    )
    return Latent(chunks, deter, stoch)

  def value(self, value_params: Any, deter: jax.Array, stoch: jax.Array) -> jax.Array:
    """Value logits (..., bins) of a (fast or slow) critic."""
    return self.val.apply({"params": value_params}, deter, stoch)  # type: ignore[return-value]

  def loss(
    self,
    params: Any,
    slow: Any,
    range_: jax.Array,
    batch: Batch,
    key: jax.Array,
    weights: Weights = Weights(),
  ) -> tuple[jax.Array, tuple[dict[str, jax.Array], jax.Array, jax.Array, jax.Array]]:
    """The joint objective.

    Returns:
      (L, (metrics, new range (2,), deter (B, T, D), stoch indices (B, T, stoch))). metrics: name ->
      float32 (); `loss/*` are unscaled.
    """
    c = self.config
    key_observe, key_imagine = jax.random.split(key)
    obs, reward, last, terminal = (
      x[:, 1:].swapaxes(0, 1) for x in (batch.obs, batch.reward, batch.last, batch.terminal)
    )
    last, terminal = last.astype(jnp.float32), terminal.astype(jnp.float32)
    length, rows = reward.shape
    gamma = 1.0 - 1.0 / c.horizon

    # world model
    deter, stoch, logits = self.observe(params, batch, key_observe)
    prior = self._apply(params, "dyn", deter, method="prior")
    dyn = jnp.maximum(c.free_nats, rssm.kl(sg(logits), prior))
    rep = jnp.maximum(c.free_nats, rssm.kl(logits, sg(prior)))
    rec = jnp.sum(
      jnp.square(self._apply(params, "dec", deter, stoch) - nets.symlog(obs / self.obs_scale)), -1
    )
    rew = nets.two_hot_loss(self._apply(params, "rew", deter, stoch), reward, self.bins)
    con_logit = self._apply(params, "con", deter, stoch)[..., 0]
    con_target = (1.0 - terminal) * gamma
    con = -con_target * jax.nn.log_sigmoid(con_logit) - (1.0 - con_target) * jax.nn.log_sigmoid(
      -con_logit
    )

    # imagination from the last `starts` states of each sequence; states are stopped, so no gradient
    # passes through the dynamics
    starts = c.last_starts or length
    flat = lambda x: x[length - starts :].reshape((starts * rows,) + x.shape[2:])
    img = behaviour.behaviour(
      self, params, slow, range_, flat(deter), flat(stoch), key_imagine, self.stepwise
    )

    # replay value over the last `starts` replayed states; its features are not stopped
    tail = slice(length - starts, None)
    boot = img.boot.reshape(starts, rows)
    target = losses.replay_return(reward[tail], terminal[tail], last[tail], boot, c.lam, gamma)
    rep_deter, rep_stoch = deter[tail][:-1], stoch[tail][:-1]
    rep_logits = self.value(params["val"], rep_deter, rep_stoch)
    rep_slow = nets.two_hot_mean(self.value(slow, sg(rep_deter), sg(rep_stoch)), self.bins)
    repval = (1.0 - last[tail][:-1]) * (
      nets.two_hot_loss(rep_logits, target, self.bins)
      + nets.two_hot_loss(rep_logits, rep_slow, self.bins)
    )

    terms = {"dyn": dyn, "rep": rep, "rec": rec, "rew": rew, "con": con, "repval": repval}
    terms = {k: jnp.mean(v) for k, v in terms.items()} | {"policy": img.policy, "value": img.value}
    total = (
      terms["dyn"]
      + c.rep_scale * terms["rep"]
      + terms["rec"]
      + terms["rew"]
      + terms["con"]
      + weights.policy * terms["policy"]
      + terms["value"]
      + c.repval_scale * terms["repval"]
    )
    if self.clone_std is not None:
      terms["clone"] = self._clone_loss(params, sg(deter), sg(stoch), batch)
      total = total + weights.clone * terms["clone"]
    if c.anchor:
      terms["anchor"] = self._anchor_loss(params, sg(deter), sg(stoch), batch)
      total = total + c.anchor * terms["anchor"]
    metrics = (
      {f"loss/{k}": v for k, v in terms.items()}
      | img.metrics
      | {
        "opt/loss": total,
        "dyn_ent": categorical_entropy(prior),
        "rep_ent": categorical_entropy(logits),
      }
    )
    stoch = jnp.argmax(stoch.reshape(length, rows, self.size.stoch, self.size.classes), -1)
    return total, (metrics, img.range, sg(deter).swapaxes(0, 1), stoch.swapaxes(0, 1))

  def _clone_loss(self, params: Any, deter: jax.Array, stoch: jax.Array, batch: Batch) -> jax.Array:
    """Mean over labelled replayed states of KL(N(demo, clone_std^2) || policy) [nats]."""
    mean, std = nets.normal(*self._apply(params, "pol", deter, stoch), *self.deviations)
    demo, has = (
      batch.demo[:, 1:].swapaxes(0, 1),
      batch.has_demo[:, 1:].swapaxes(0, 1).astype(jnp.float32),
    )
    var = self.clone_std**2  # type: ignore[operator]
    kl = jnp.sum(
      jnp.log(std / self.clone_std) + (var + jnp.square(mean - demo)) / (2 * jnp.square(std)) - 0.5,  # type: ignore[operator]
      -1,
    )
    return jnp.sum(kl * has) / jnp.maximum(1.0, jnp.sum(has))

  def _anchor_loss(
    self, params: Any, deter: jax.Array, stoch: jax.Array, batch: Batch
  ) -> jax.Array:
    """Mean over replayed states of -log policy(action taken) [nats], for the policy's mean alone;
    at an episode's last state none was taken.

    The deviation is held: fitted to actions that were drawn from it, it would take in the error of
    the mean, and grow with every round.
    """
    mean, std = nets.normal(*self._apply(params, "pol", deter, stoch), *self.deviations)
    std = sg(std)
    taken = 1.0 - batch.last[:, 1:].swapaxes(0, 1).astype(jnp.float32)
    logp = nets.normal_logp(mean, std, batch.action[:, 1:].swapaxes(0, 1))
    return -jnp.sum(logp * taken) / jnp.maximum(1.0, jnp.sum(taken))

  def update(
    self, state: TrainState, batch: Batch, key: jax.Array, weights: Weights = Weights()
  ) -> tuple[TrainState, dict[str, jax.Array], tuple[jax.Array, jax.Array]]:
    """One gradient step. Where a loss or the gradient is at fault (`culprit`) nothing changes, the
    counter included.

    Returns:
      (state', metrics, (deter (B, T, D), stoch indices (B, T, stoch)) for the latent refresh).
    """
    grad = jax.grad(self.loss, has_aux=True)
    grads, (metrics, range_, deter, stoch) = grad(
      state.params, state.slow, state.range, batch, key, weights
    )
    steps, opt = self.optimizer.update(grads, state.opt, state.params)
    steps = jax.tree.map(lambda x: weights.lr * x, steps)
    if self.config.policy_lr != 1.0:
      steps = {**steps, "pol": jax.tree.map(lambda x: self.config.policy_lr * x, steps["pol"])}
    params = optax.apply_updates(state.params, steps)
    slow = jax.tree.map(
      lambda s, p: (1.0 - self.config.slow_rate) * s + self.config.slow_rate * p,
      state.slow,
      params["val"],
    )
    metrics["opt/grad_norm"] = optax.global_norm(grads)
    sound = culprit(metrics) < 0
    new = TrainState(params, slow, opt, range_, state.updates + 1)
    return jax.tree.map(lambda a, b: jnp.where(sound, a, b), new, state), metrics, (deter, stoch)

  # ---- prediction --------------------------------------------------------------------------------

  def open_loop(
    self, params: Any, deter: jax.Array, stoch: jax.Array, actions: jax.Array, key: jax.Array
  ) -> tuple[jax.Array, jax.Array]:
    """Predictions of the next n steps from rows, actions given, one prior sample each; never looks
    at an observation.

    Args:
      deter, stoch: posterior at t, (N, D), (N, S).
      actions: a_t .. a_{t+n-1}, (n, N, A).

    Returns:
      xhat_{t+1..t+n} (n, N, O) in raw units (symexp applied) and rhat (n, N).
    """
    params = self.prepare(params)
    uniform = nets.in_a_row(
      jax.random.uniform, key, (actions.shape[0], deter.shape[0], self.size.stoch)
    )

    def step(
      state: Latent,
      x: tuple[jax.Array, jax.Array],
      # decoded where the state is at hand: the stacked states would be a hundred times the
      # predictions
    ) -> tuple[Latent, tuple[jax.Array, jax.Array]]:
      state = self.follow(params, state, *x)
      return state, self.predict(params, state.deter, state.stoch)

    return jax.lax.scan(step, self.latent(params, deter, stoch), (actions, uniform))[1]

  def predict(self, params: Any, deter: jax.Array, stoch: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Observation (..., O) in raw units and reward (...) at states."""
    return self.obs_scale * nets.symexp(
      self._apply(params, "dec", deter, stoch)
    ), nets.two_hot_mean(self._apply(params, "rew", deter, stoch), self.bins)

  def beliefs(self, params: Any, deter: jax.Array, obs: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Logits (..., stoch, classes) of the posterior at `obs` and of the prior, both at `deter`."""
    flat, tokens = (
      deter.reshape(-1, deter.shape[-1]),
      self._encode(params, obs.reshape(-1, obs.shape[-1])),
    )
    shape = deter.shape[:-1] + (self.size.stoch, self.size.classes)
    return (
      self._apply(params, "dyn", flat, tokens, method="posterior").reshape(shape),
      self._apply(params, "dyn", flat, method="prior").reshape(shape),
    )

  def dream(
    self, params: Any, deter: jax.Array, stoch: jax.Array, steps: int, key: jax.Array
  ) -> tuple[jax.Array, jax.Array]:
    """As `open_loop`, with the actions that the policy imagines for itself."""
    deters, stochs, _ = self.imagine(params, deter, stoch, key, steps)
    return self.predict(params, deters[1:], stochs[1:])


def categorical_entropy(logits: jax.Array) -> jax.Array:
  """Mean entropy [nats] summed over the categorical variables."""
  p = rssm.probs(logits)
  return -jnp.mean(jnp.sum(p * jnp.log(p), (-2, -1)))


def parameter_count(params: Any) -> int:
  """Trainable parameters, slow critic apart."""
  return int(sum(np.prod(x.shape) for x in jax.tree.leaves(params)))
