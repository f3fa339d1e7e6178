"""Twin delayed DDPG (Fujimoto, van Hoof and Meger 2018): the published learner of Tutor and Controller.

    y      = r + gamma (1 - terminated) min_i Q'_i(o', pi'(o') + clipped noise)
    critic = sum_i E[huber(Q_i(o, a) - y)]
    actor  = -E[Q_1(o, pi(o))]                   # every `policy_delay` critic updates
    targets follow with rate tau

Every rollout enters the replay buffer, then `updates_per_rollout` batches are drawn from it. Networks see observations
with running mean 0 and variance 1, and r is in running units, so that the scale of rewards does not matter.

Until the first update actions are drawn evenly, and critics begin flat. Else actors follow slopes that nobody has
measured to where tanh ends, and a body stands still there. Of many environments some explore hardly and some a lot
(FastTD3, Seo et al. 2025).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int

from star import devices
from star.learners import replay
from star.learners.networks import MLP, Normalizer, adam_step, apply
from star.learners.protocol import Learner, whole
from star.learners.replay import Imitation, Penalty, Relabel, Transition, flatten, weighted_mean
from star.learners.sections import TD3Config

Metrics = dict[str, Array]

_LEAST = 1e-6  # deviation of rewards


class TD3State(struct.PyTreeNode):
    """Networks with their targets, two optimisers, observation statistics and the replay buffer of one TD3 learner."""

    params: Mapping[str, Any]
    target: Mapping[str, Any]
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    normalizer: Normalizer
    rewards: Normalizer
    ring: replay.Ring
    updates: Int[Array, ""]


def _actor(config: TD3Config, action_size: int) -> MLP:
    return MLP(config.hidden, action_size, final_scale=0.01)


def _critic(config: TD3Config) -> MLP:
    return MLP(config.hidden, 1, final_scale=0.01)


def _q(config: TD3Config, params: Any, obs: Array, action: Array) -> Float[Array, "2 *batch"]:
    """Both critics; their parameters are stacked on a leading axis."""
    x = jnp.concatenate([obs, action], axis=-1)
    return jax.vmap(lambda one: apply(_critic(config), one, x)[..., 0])(params)


def _policy(config: TD3Config, params: Any, obs: Array, action_size: int) -> Array:
    return jnp.tanh(apply(_actor(config, action_size), params, obs))


def init(key: Array, config: TD3Config, *, example: Transition) -> TD3State:
    """A learner for transitions shaped like `example` (no leading axes)."""
    actor_key, critic_key = jax.random.split(key)
    (action_size,) = example.action.shape
    both = jnp.concatenate([example.obs, example.action])
    params = {
        "actor": _actor(config, action_size).init(actor_key, example.obs),
        "critic": jax.vmap(lambda k: _critic(config).init(k, both))(jax.random.split(critic_key)),
    }
    adam = optax.scale_by_adam()
    return TD3State(
        params=params,
        target=jax.tree.map(jnp.copy, params),
        actor_optimizer=adam.init(params["actor"]),
        critic_optimizer=adam.init(params["critic"]),
        normalizer=Normalizer.create(len(example.obs)),
        rewards=Normalizer.create(1),
        ring=replay.create(example, size=config.buffer_size),
        updates=jnp.zeros((), jnp.int32),
    )


def act(
    config: TD3Config, state: TD3State, obs: Float[Array, "*batch obs"], *, deterministic: bool = False, key: Array
) -> Float[Array, "*batch act"]:
    """Actions in [-1, 1], with Gaussian exploration noise unless `deterministic`; before the first update anything."""
    action = _policy(config, state.params["actor"], state.normalizer(obs), _action_size(state))
    if deterministic:
        return action
    noise = config.exploration_noise * _spread(action) * jax.random.normal(key, action.shape)
    anything = jax.random.uniform(jax.random.fold_in(key, 1), action.shape, minval=-1.0)
    return jnp.where(state.updates == 0, anything, jnp.clip(action + noise, -1.0, 1.0))


def _spread(action: Float[Array, "*batch act"]) -> Float[Array, "*batch 1"] | float:
    """Factors on the noise of each environment, the first axis: evenly from 0 to 2, and 1 for a single one."""
    if action.ndim == 1:
        return 1.0
    number = action.shape[0]
    return ((2 * jnp.arange(number) + 1) / number).reshape(-1, *(1,) * (action.ndim - 1))


def update(
    config: TD3Config,
    state: TD3State,
    rollout: Transition,
    *,
    relabel: Relabel | None = None,
    penalty: Penalty | None = None,
    imitation: Imitation | None = None,
    key: Array,
) -> tuple[TD3State, Metrics]:
    """Store one rollout [T, B] and make `updates_per_rollout` updates, on batches passed through `relabel`.

    `penalty(batch, action)` [N] is added to the loss of the actor that would take `action`, and so is that of
    `imitation`.
    """
    rollout = devices.whole(rollout)
    state = state.replace(
        ring=replay.add(state.ring, flatten(rollout)),
        normalizer=state.normalizer.update(rollout.obs, rollout.weight),
        rewards=state.rewards.update(rollout.reward[..., None], rollout.weight),
    )
    if imitation is not None:
        imitation = imitation.replace(obs=state.normalizer(imitation.obs))
    state, metrics = jax.lax.scan(
        partial(_one_update, config, relabel, penalty, imitation),
        state,
        jax.random.split(key, config.updates_per_rollout),
    )
    return state, jax.tree.map(jnp.mean, metrics)


def _one_update(
    config: TD3Config,
    relabel: Relabel | None,
    penalty: Penalty | None,
    imitation: Imitation | None,
    state: TD3State,
    key: Array,
) -> tuple[TD3State, Metrics]:
    sample_key, noise_key, relabel_key = jax.random.split(key, 3)
    batch = devices.whole(replay.sample(state.ring, sample_key, batch_size=config.batch_size))
    if relabel is not None:
        batch = relabel(batch, relabel_key)
    seen = batch.replace(
        obs=state.normalizer(batch.obs),
        next_obs=state.normalizer(batch.next_obs),
        reward=batch.reward / unit(config, state.rewards),
    )
    ready = replay.filled(state.ring) >= config.min_transitions
    act_too = ready & (state.updates % config.policy_delay == 0)

    critic_grad, critic_metrics = jax.grad(partial(_critic_loss, config), has_aux=True)(
        state.params["critic"], state.target, seen, noise_key
    )
    critic, critic_optimizer = adam_step(
        state.params["critic"], critic_grad, state.critic_optimizer, config.critic_learning_rate, ready
    )
    actor_grad, actor_metrics = jax.grad(partial(_actor_loss, config, penalty, imitation), has_aux=True)(
        state.params["actor"], critic, seen, batch
    )
    actor, actor_optimizer = adam_step(
        state.params["actor"], actor_grad, state.actor_optimizer, config.actor_learning_rate, act_too
    )
    params = {"actor": actor, "critic": critic}
    rate = config.tau * act_too
    return (
        state.replace(
            params=params,
            target=jax.tree.map(lambda t, p: t + rate * (p - t), state.target, params),
            actor_optimizer=actor_optimizer,
            critic_optimizer=critic_optimizer,
            updates=state.updates + ready.astype(jnp.int32),
        ),
        critic_metrics | actor_metrics,
    )


def unit(config: TD3Config, rewards: Normalizer) -> Float[Array, ""]:
    """Deviation that returns would have if rewards were independent: the unit of the critics."""
    power = rewards.variance[0] + jnp.square(rewards.mean[0])
    return jnp.maximum(jnp.sqrt(power / jnp.maximum(1 - jnp.square(config.discount), _LEAST)), _LEAST)


def _critic_loss(config: TD3Config, params: Any, target: Any, batch: Transition, key: Array) -> tuple[Array, Metrics]:
    noise = config.target_noise * jax.random.normal(key, batch.action.shape)
    noise = jnp.clip(noise, -config.target_noise_clip, config.target_noise_clip)
    next_action = _policy(config, target["actor"], batch.next_obs, batch.action.shape[-1])
    next_q = _q(config, target["critic"], batch.next_obs, jnp.clip(next_action + noise, -1.0, 1.0)).min(axis=0)
    goal = batch.reward + config.discount * (1 - batch.terminated) * next_q
    q = _q(config, params, batch.obs, batch.action)
    loss = weighted_mean(optax.huber_loss(q, goal).sum(axis=0), batch.weight)
    return loss, {"critic_loss": loss, "q": weighted_mean(q[0], batch.weight)}


def _actor_loss(
    config: TD3Config,
    penalty: Penalty | None,
    imitation: Imitation | None,
    params: Any,
    critic: Any,
    seen: Transition,
    batch: Transition,
) -> tuple[Array, Metrics]:
    """`seen` is the `batch` with normalised observations; the penalty is told of the batch as it is."""
    action = _policy(config, params, seen.obs, batch.action.shape[-1])
    price = penalty(batch, action) if penalty is not None else 0.0
    loss = weighted_mean(price - _q(config, critic, seen.obs, action)[0], batch.weight)
    if imitation is not None:
        loss += imitation.loss(_policy(config, params, imitation.obs, batch.action.shape[-1]))
    return loss, {"actor_loss": loss}


def _action_size(state: TD3State) -> int:
    layers = state.params["actor"]["params"]
    return layers[f"Dense_{len(layers) - 1}"]["bias"].shape[-1]


def shards(state: TD3State) -> TD3State:
    """The slots of the replay buffer, axis 1 of [1, slots, ...], are cut among devices; all else is whole on each."""
    axes = whole(state)
    return axes.replace(ring=axes.ring.replace(experience=jax.tree.map(lambda _: 1, axes.ring.experience)))


LEARNER = Learner(TD3Config, init, act, update, shards)
