"""Proximal policy optimisation (Schulman et al. 2017) on short rollouts of many environments.

    for each of `passes`:                        # over one rollout [T, B], shuffled into minibatches
        ratio  = pi(a|o) / pi_old(a|o)
        actor  = -E[min(ratio A, clip(ratio) A)] - entropy H(pi)
        critic = E[(v(o) - (R - mean) / deviation)^2] / 2
        the step size grows or shrinks to keep KL(pi_old, pi) near `target_kl`

A and R come from generalised advantage estimation (Schulman et al. 2016); time limits and changes of goal are
cut, never treated as the end of the task.

The scale of rewards does not matter: V(o) = mean + deviation v(o), with running statistics of R (as in PopArt, van
Hasselt et al. 2016, but for its exact correction of v), and the gradients of actor and critic are clipped apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from flax.linen import elu
from jaxtyping import Array, Float

from envs.common.batching import where
from star import devices
from star.learners.networks import MLP, Normalizer, apply
from star.learners.protocol import Learner
from star.learners.replay import Imitation, Penalty, Transition, flatten, weighted_mean
from star.learners.sections import PPOConfig

Metrics = dict[str, Array]

_RATE = 0.05  # of a rollout in the running statistics of returns
_LEAST = 1e-6  # deviation of returns


class Returns(struct.PyTreeNode):
    """Mean and variance of the returns of late, the units of the critic; variance 0: none were seen."""

    mean: Float[Array, ""]
    variance: Float[Array, ""]

    @property
    def deviation(self) -> Float[Array, ""]:
        """Not below what keeps numbers finite."""
        return jnp.maximum(jnp.sqrt(self.variance), _LEAST)

    def normalized(self, returned: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """The critic's values of these returns."""
        return (returned - self.mean) / self.deviation

    def restored(self, said: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """The returns that the critic speaks of."""
        return self.mean + self.deviation * said

    def started(self, config: PPOConfig, rollout: Transition) -> Returns:
        """Before the first rollout a guess by its rewards, as if they were independent of one another."""
        power = weighted_mean(jnp.square(rollout.reward), rollout.weight)
        guess = power / jnp.maximum(1 - jnp.square(config.discount), 1 / len(rollout.reward))
        return self.replace(variance=jnp.where(self.variance > 0, self.variance, guess))

    def updated(self, returned: Float[Array, "*n"], weight: Float[Array, "*n"], *, rate: Array) -> Returns:
        """With those of a rollout, of which samples of weight 0 do not count."""
        mean = weighted_mean(returned, weight)
        variance = weighted_mean(jnp.square(returned - mean), weight)
        return Returns(
            mean=self.mean + rate * (mean - self.mean), variance=self.variance + rate * (variance - self.variance)
        )


class PPOState(struct.PyTreeNode):
    """Networks, optimiser, observation statistics and the adaptive step size of one PPO learner."""

    params: Mapping[str, Any]
    optimizer: optax.OptState
    normalizer: Normalizer
    returns: Returns
    learning_rate: Float[Array, ""]


class _Sample(struct.PyTreeNode):
    transition: Transition | None
    obs: Array
    action: Array
    log_prob: Array
    advantage: Array
    target: Array
    weight: Array


def _actor(config: PPOConfig, action_size: int) -> MLP:
    return MLP(config.hidden, action_size, elu, final_scale=0.01)


def _critic(config: PPOConfig) -> MLP:
    return MLP(config.hidden, 1, elu)


def _optimizer(config: PPOConfig) -> optax.GradientTransformation:
    return optax.chain(_clip_apart(config.max_grad_norm), optax.scale_by_adam(eps=1e-5))


def _clip_apart(norm: float | Array) -> optax.GradientTransformation:
    """The norm of the critic's gradient is clipped, and that of the policy's."""
    clip = optax.clip_by_global_norm(norm)

    def update(gradient: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        critic = {"critic": gradient["critic"]}
        policy = {name: part for name, part in gradient.items() if name not in critic}
        return clip.update(policy, state)[0] | clip.update(critic, state)[0], state

    return optax.GradientTransformation(clip.init, update)


def init(key: Array, config: PPOConfig, *, example: Transition) -> PPOState:
    """A learner for transitions shaped like `example` (no leading axes)."""
    actor_key, critic_key = jax.random.split(key)
    (obs_size,), (action_size,) = example.obs.shape, example.action.shape
    params = {
        "actor": _actor(config, action_size).init(actor_key, example.obs),
        "log_std": jnp.full(action_size, jnp.log(jnp.maximum(config.initial_std, config.min_std)), jnp.float32),
        "critic": _critic(config).init(critic_key, example.obs),
    }
    return PPOState(
        params=params,
        optimizer=_optimizer(config).init(params),
        normalizer=Normalizer.create(obs_size),
        returns=Returns(mean=jnp.zeros(()), variance=jnp.zeros(())),
        learning_rate=jnp.asarray(config.learning_rate, jnp.float32),
    )


def act(
    config: PPOConfig, state: PPOState, obs: Float[Array, "*batch obs"], *, deterministic: bool = False, key: Array
) -> Float[Array, "*batch act"]:
    """Draw actions from the Gaussian policy, or take its mean. Not clipped to [-1, 1]: the environment does that."""
    mean, std = _policy(config, state.params, state.normalizer(obs))
    return mean if deterministic else mean + std * jax.random.normal(key, mean.shape)


def update(
    config: PPOConfig,
    state: PPOState,
    rollout: Transition,
    *,
    penalty: Penalty | None = None,
    imitation: Imitation | None = None,
    key: Array,
) -> tuple[PPOState, Metrics]:
    """Learn from one rollout [T, B] that `state` itself has collected; nothing if all of it has weight 0.

    `penalty(batch, action)` [N] is added to the loss of the actor whose mean is `action`, and so is that of
    `imitation`.
    """
    samples, returns = _prepare(config, state, rollout, keep=penalty is not None)
    if imitation is not None:
        imitation = imitation.replace(obs=state.normalizer(imitation.obs))

    def one_pass(carry: tuple, pass_key: Array) -> tuple[tuple, Metrics]:
        params, optimizer, learning_rate = carry
        batches = _minibatches(samples, config.minibatches, key=pass_key)
        (params, optimizer), metrics = jax.lax.scan(
            partial(_gradient_step, config, penalty, imitation, learning_rate), (params, optimizer), batches
        )
        metrics = jax.tree.map(jnp.mean, metrics)
        return (params, optimizer, _adapt(config, learning_rate, metrics["kl"])), metrics

    (params, optimizer, learning_rate), metrics = jax.lax.scan(
        one_pass, (state.params, state.optimizer, state.learning_rate), jax.random.split(key, config.passes)
    )
    learnt = PPOState(
        params=params,
        optimizer=optimizer,
        normalizer=state.normalizer.update(rollout.obs, rollout.weight),
        returns=returns,
        learning_rate=learning_rate,
    )
    state = where(rollout.weight.sum() > 0, learnt, state)
    metrics = jax.tree.map(jnp.mean, metrics) | {
        "learning_rate": state.learning_rate,
        "std": jnp.exp(state.params["log_std"]).mean(),
    }
    return state, metrics


def advantages(
    config: PPOConfig, rollout: Transition, values: Float[Array, "T B"], next_values: Float[Array, "T B"]
) -> Float[Array, "T B"]:
    """Generalised advantage estimates, A_t = delta_t + gamma lambda A_{t+1}, with the sum ended at every cut."""
    bootstrap = config.discount * (1 - rollout.terminated)
    delta = rollout.reward + bootstrap * next_values - values
    decay = bootstrap * config.gae_lambda * (1 - rollout.cut)

    def backwards(later: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        advantage = now[0] + now[1] * later
        return advantage, advantage

    return jax.lax.scan(backwards, jnp.zeros_like(delta[0]), (delta, decay), reverse=True)[1]


def _policy(config: PPOConfig, params: Mapping[str, Any], obs: Array) -> tuple[Array, Array]:
    mean = apply(_actor(config, params["log_std"].shape[0]), params["actor"], obs)
    return mean, jnp.exp(params["log_std"])


def _value(config: PPOConfig, params: Mapping[str, Any], obs: Array) -> Array:
    return apply(_critic(config), params["critic"], obs)[..., 0]


def _log_prob(mean: Array, std: Array, action: Array) -> Array:
    return jnp.sum(-0.5 * jnp.square((action - mean) / std) - jnp.log(std), axis=-1)


def _prepare(config: PPOConfig, state: PPOState, rollout: Transition, *, keep: bool) -> tuple[_Sample, Returns]:
    """The rollout as independent samples [T * B], seen through the networks that collected it, and returns with it.

    With `keep` the samples hold their transition too. Every device gets them all, to draw its shares of minibatches.
    """
    obs, next_obs = state.normalizer(rollout.obs), state.normalizer(rollout.next_obs)
    known = state.returns.started(config, rollout)
    values, next_values = (known.restored(_value(config, state.params, seen)) for seen in (obs, next_obs))
    advantage = advantages(config, rollout, values, next_values)
    rate = jnp.where(state.returns.variance > 0, _RATE, 1.0)
    returns = known.updated(advantage + values, rollout.weight, rate=rate)
    mean, std = _policy(config, state.params, obs)
    sample = _Sample(
        transition=rollout if keep else None,
        obs=obs,
        action=rollout.action,
        log_prob=_log_prob(mean, std, rollout.action),
        advantage=advantage,
        target=returns.normalized(advantage + values),
        weight=rollout.weight,
    )
    return flatten(devices.whole(sample)), returns


def _minibatches(samples: _Sample, count: int, *, key: Array) -> _Sample:
    """`count` minibatches [count, N], shuffled, whose weights sum to 1 and whose advantages have mean 0 and variance 1.

    Each device gets its share of each; what takes sums over a minibatch is done before, where that costs no messages.
    """
    order = devices.whole(jax.random.permutation(key, samples.weight.shape[0])).reshape(count, -1)
    weight, advantage = devices.whole((samples.weight[order], samples.advantage[order]))
    weight /= jnp.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    centred = advantage - jnp.sum(weight * advantage, axis=1, keepdims=True)
    advantage = centred / (jnp.sqrt(jnp.sum(weight * jnp.square(centred), axis=1, keepdims=True)) + 1e-8)
    ours = devices.share(order, axis=1)
    batches = jax.tree.map(lambda x: x[ours], samples).replace(weight=weight, advantage=advantage)
    return devices.share(batches, axis=1)


def _gradient_step(
    config: PPOConfig,
    penalty: Penalty | None,
    imitation: Imitation | None,
    learning_rate: Array,
    carry: tuple,
    batch: _Sample,
) -> tuple[tuple, Metrics]:
    params, optimizer = carry
    gradient, metrics = jax.grad(partial(_loss, config, penalty, imitation), has_aux=True)(params, batch)
    step, optimizer = _optimizer(config).update(gradient, optimizer)
    params = jax.tree.map(lambda p, s: p - learning_rate * s, params, step)
    # here, not in the policy, whose gradient would vanish below: the deviation could never grow again
    params = {**params, "log_std": jnp.maximum(params["log_std"], jnp.log(config.min_std))}
    return (params, optimizer), metrics


def _loss(
    config: PPOConfig,
    penalty: Penalty | None,
    imitation: Imitation | None,
    params: Mapping[str, Any],
    batch: _Sample,
) -> tuple[Array, Metrics]:
    share, advantage = batch.weight, batch.advantage
    mean, std = _policy(config, params, batch.obs)
    log_ratio = _log_prob(mean, std, batch.action) - batch.log_prob
    log_ratio = jnp.where(share > 0, log_ratio, 0.0)  # others' actions may be infinitely unlikely, and 0 * inf is NaN
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
    price = 0.0 if penalty is None or batch.transition is None else penalty(batch.transition, mean)
    actor_loss = jnp.sum(share * (price - jnp.minimum(ratio * advantage, clipped * advantage)))
    if imitation is not None:
        actor_loss += imitation.loss(_policy(config, params, imitation.obs)[0])
    critic_loss = 0.5 * jnp.sum(share * jnp.square(_value(config, params, batch.obs) - batch.target))
    entropy = jnp.sum(jnp.log(std)) + 0.5 * std.shape[0] * jnp.log(2 * jnp.pi * jnp.e)
    metrics = {
        "actor_loss": actor_loss,
        "critic_loss": critic_loss,
        "entropy": entropy,
        "kl": jnp.sum(share * (ratio - 1 - log_ratio)),
        "clipped": jnp.sum(share * (jnp.abs(ratio - 1) > config.clip)),
    }
    return actor_loss + critic_loss - config.entropy * entropy, metrics


def _adapt(config: PPOConfig, learning_rate: Array, kl: Array) -> Array:
    """Shrink the step size when the policy moved too far in a pass, grow it when it hardly moved."""
    factor = jnp.where(kl > 2 * config.target_kl, 1 / 1.5, jnp.where(kl < config.target_kl / 2, 1.5, 1.0))
    return jnp.clip(learning_rate * factor, 1e-5, config.max_learning_rate)


LEARNER = Learner(PPOConfig, init, act, update)
