"""Contrastive reinforcement learning (Eysenbach et al. 2022), as in JaxGCRL (Bortkiewicz et al. 2025).

    Q(s, a, g) = -||phi(s, a) - psi(g)||
    g_i    = where the agent was D steps after (s_i, a_i) in the same episode, D ~ Geometric(1 - gamma), cut off there
    critic = -E_i[Q_ii - log sum_j exp Q_ij] + c E_i[(log sum_j exp Q_ij)^2]          # InfoNCE, j over the batch
    actor  = E_i[alpha log pi(a | s_i, g_i) - Q(s_i, a, g_i)]
    alpha  is moved so that the entropy of pi comes to -1/2 for each number of an action

No reward is needed: the agent learns which actions make it likely to be at a goal later. The last numbers of an
observation are the goal. Every rollout enters the replay buffer, then `updates_per_rollout` batches are drawn from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int

from star import devices
from star.learners import replay
from star.learners.networks import MLP, adam_step, apply
from star.learners.protocol import Learner
from star.learners.replay import Imitation, Penalty, Relabel, Track, Transition, flatten, weighted_mean
from star.learners.sections import CRLConfig

Metrics = dict[str, Array]

LOG_STD = (-5.0, 2.0)  # of actions before tanh
ENTROPY = -0.5  # wanted of each number of an action, nats
VARIANCE = 1 / 3  # of an initial weight, times the inputs of its layer
_LEAST = 1e-6


class Step(struct.PyTreeNode):
    """An env step in the buffer: observation, action, and the agent's track."""

    obs: Float[Array, "*batch obs"]
    action: Float[Array, "*batch act"]
    weight: Float[Array, "*batch"]
    track: Track


class CRLState(struct.PyTreeNode):
    """Networks, temperature, their optimisers, and the replay buffer of one learner."""

    params: Mapping[str, Any]
    """`actor`, and the two halves of the critic: `action` is phi, `goal` is psi."""
    log_alpha: Float[Array, ""]
    optimizers: Mapping[str, optax.OptState]
    ring: replay.Ring
    updates: Int[Array, ""]


def _mlp(config: CRLConfig, out: int) -> MLP:
    return MLP(config.hidden, out, activation=nn.swish, hidden_scale=(VARIANCE / 2) ** 0.5, final_scale=VARIANCE**0.5)


def init(key: Array, config: CRLConfig, *, example: Transition) -> CRLState:
    """A learner for transitions shaped like `example` (no leading axes), whose extras are a `Track`."""
    actor_key, action_key, goal_key = jax.random.split(key, 3)
    (size,), goal = example.action.shape, example.extras.place
    state = example.obs[: -len(goal)]
    params = {
        "actor": _mlp(config, 2 * size).init(actor_key, example.obs),
        "critic": {
            "action": _mlp(config, config.representation).init(action_key, jnp.concatenate([state, example.action])),
            "goal": _mlp(config, config.representation).init(goal_key, goal),
        },
    }
    log_alpha, adam = jnp.zeros(()), optax.scale_by_adam()
    return CRLState(
        params=params,
        log_alpha=log_alpha,
        optimizers={name: adam.init(one) for name, one in (params | {"alpha": log_alpha}).items()},
        ring=replay.create(_step(example), size=config.buffer_size),
        updates=jnp.zeros((), jnp.int32),
    )


def _step(transition: Transition) -> Step:
    return Step(transition.obs, transition.action, transition.weight, transition.extras)


def act(
    config: CRLConfig, state: CRLState, obs: Float[Array, "*batch obs"], *, deterministic: bool = False, key: Array
) -> Float[Array, "*batch act"]:
    """Actions in [-1, 1]: drawn, or `deterministic` ones in the middle of what would be drawn."""
    mean, std = _policy(config, state.params["actor"], obs)
    noise = 0.0 if deterministic else jax.random.normal(key, mean.shape)
    return jnp.tanh(mean + std * noise)


def _policy(config: CRLConfig, params: Any, obs: Array) -> tuple[Array, Array]:
    """Mean and deviation of actions before tanh."""
    size = params["params"][f"Dense_{len(config.hidden)}"]["bias"].shape[-1]
    mean, raw = jnp.split(apply(_mlp(config, size), params, obs), 2, axis=-1)
    low, high = LOG_STD
    return mean, jnp.exp(low + 0.5 * (high - low) * (jnp.tanh(raw) + 1.0))


def update(
    config: CRLConfig,
    state: CRLState,
    rollout: Transition,
    *,
    relabel: Relabel | None = None,
    penalty: Penalty | None = None,
    imitation: Imitation | None = None,
    key: Array,
) -> tuple[CRLState, Metrics]:
    """Store one rollout [T, B] and make `updates_per_rollout` updates; the actor also learns from `imitation`.

    Goals of the future take the place of `relabel`, and only a Tutor has a `penalty`.
    """
    rollout = devices.whole(rollout)
    ring = replay.add(state.ring, flatten(_step(rollout)))
    num_envs = rollout.weight.shape[1]
    future = Future.of(ring, num_envs=num_envs)
    state, metrics = jax.lax.scan(
        partial(_one_update, config, future, imitation),
        state.replace(ring=ring),
        jax.random.split(key, config.updates_per_rollout),
    )
    return state, jax.tree.map(jnp.mean, metrics)


class Future(NamedTuple):
    """Items of a ring that others follow: the first `number` of `going`. `left` has the steps that follow each item."""

    left: Int[Array, "size"]
    going: Int[Array, "size"]
    number: Int[Array, ""]
    num_envs: int

    @classmethod
    def of(cls, ring: replay.Ring, *, num_envs: int) -> Future:
        """That of the rollouts of `num_envs` environments in `ring`."""
        left = steps_left(ring, num_envs=num_envs)
        going = jnp.flatnonzero(left > 0, size=len(left), fill_value=0)
        return cls(left, going, jnp.sum(left > 0), num_envs)


def steps_left(ring: replay.Ring, *, num_envs: int) -> Int[Array, "size"]:
    """The number of steps that follow each item of `ring`, in it and of the same episode.

    Items are those of rollouts of `num_envs` environments, so that the next step of an environment is `num_envs` ahead.
    """
    items, _ = replay.contents(ring)
    rows = replay.capacity(ring) // num_envs
    over, epoch, weight = (x.reshape(rows, num_envs) for x in (items.track.over, items.track.epoch, items.weight))
    number = jnp.arange(rows)[:, None]
    newest = (ring.current_index // num_envs - 1) % rows
    alive, later = weight > 0, partial(jnp.roll, shift=-1, axis=0)
    going = (over == 0) & alive & later(alive) & (epoch == later(epoch)) & (number != newest)
    by_age = jnp.roll(going, -(newest + 1), axis=0)
    end = jax.lax.cummin(jnp.where(by_age, rows, number), axis=0, reverse=True)
    return jnp.roll(end - number, newest + 1, axis=0).ravel()


def ahead(left: Int[Array, "*n"], uniform: Float[Array, "*n"], *, discount: Array | float) -> Int[Array, "*n"]:
    """Steps to the goal, at least 1: geometric with parameter 1 - `discount`, given that there are at most `left`.

    `uniform` is drawn from [0, 1). Where nothing is left it is 0.
    """
    tail = 1.0 - jnp.power(discount, left)
    steps = 1 + jnp.floor(jnp.log1p(-uniform * tail) / jnp.log(discount)).astype(left.dtype)
    return jnp.minimum(steps, left)


def _drawn(config: CRLConfig, ring: replay.Ring, future: Future, key: Array) -> tuple[Step, Float[Array, "N k"]]:
    """A batch of steps that others follow, and its goals; without weight if there are none."""
    slot_key, ahead_key = jax.random.split(key)
    items, _ = replay.contents(ring)
    slot = future.going[jax.random.randint(slot_key, (config.batch_size,), 0, jnp.maximum(future.number, 1))]
    steps = ahead(future.left[slot], jax.random.uniform(ahead_key, slot.shape), discount=config.discount)
    batch = jax.tree.map(lambda x: x[slot], items)
    goal = items.track.place[(slot + steps * future.num_envs) % replay.capacity(ring)]
    return batch.replace(weight=batch.weight * (steps > 0)), goal


def _one_update(
    config: CRLConfig, future: Future, imitation: Imitation | None, state: CRLState, key: Array
) -> tuple[CRLState, Metrics]:
    draw_key, noise_key = jax.random.split(key)
    batch, goal = devices.whole(_drawn(config, state.ring, future, draw_key))
    ready = replay.filled(state.ring) >= config.min_transitions
    rate = config.learning_rate

    critic_grad, critic_metrics = jax.grad(partial(_critic_loss, config), has_aux=True)(
        state.params["critic"], batch, goal
    )
    critic, critic_optimizer = adam_step(state.params["critic"], critic_grad, state.optimizers["critic"], rate, ready)
    actor_grad, actor_metrics = jax.grad(partial(_actor_loss, config, imitation), has_aux=True)(
        state.params["actor"], state.params["critic"], state.log_alpha, batch, goal, noise_key
    )
    actor, actor_optimizer = adam_step(state.params["actor"], actor_grad, state.optimizers["actor"], rate, ready)
    wanted = ENTROPY * batch.action.shape[-1]
    alpha_grad = jnp.exp(state.log_alpha) * (actor_metrics["entropy"] - wanted)
    log_alpha, alpha_optimizer = adam_step(state.log_alpha, alpha_grad, state.optimizers["alpha"], rate, ready)
    return (
        state.replace(
            params={"actor": actor, "critic": critic},
            log_alpha=log_alpha,
            optimizers={"actor": actor_optimizer, "critic": critic_optimizer, "alpha": alpha_optimizer},
            updates=state.updates + ready.astype(jnp.int32),
        ),
        critic_metrics | actor_metrics | {"alpha": jnp.exp(state.log_alpha)},
    )


def _embedded(config: CRLConfig, critic: Any, obs: Array, action: Array, goal: Array) -> tuple[Array, Array]:
    """phi(s, a) and psi(g)."""
    mlp, state = _mlp(config, config.representation), obs[..., : -goal.shape[-1]]
    together = jnp.concatenate([state, action], axis=-1)
    return apply(mlp, critic["action"], together), apply(mlp, critic["goal"], goal)


def _energy(x: Array, y: Array) -> Array:
    """-||x - y||, with a slope everywhere."""
    return -jnp.sqrt(jnp.square(x - y).sum(axis=-1) + _LEAST)


def _critic_loss(config: CRLConfig, critic: Any, batch: Step, goal: Array) -> tuple[Array, Metrics]:
    phi, psi = _embedded(config, critic, batch.obs, batch.action, goal)
    logits = _energy(phi[:, None], psi[None])
    total = jax.nn.logsumexp(logits, axis=1)
    lost = total - jnp.diagonal(logits) + config.logsumexp_penalty * jnp.square(total)
    right = jnp.argmax(logits, axis=1) == jnp.arange(len(logits))
    loss = weighted_mean(lost, batch.weight)
    return loss, {"critic_loss": loss, "critic_right": weighted_mean(right.astype(jnp.float32), batch.weight)}


def _actor_loss(
    config: CRLConfig,
    imitation: Imitation | None,
    actor: Any,
    critic: Any,
    log_alpha: Array,
    batch: Step,
    goal: Array,
    key: Array,
) -> tuple[Array, Metrics]:
    seen = batch.obs.at[:, -goal.shape[-1] :].set(goal)
    mean, std = _policy(config, actor, seen)
    noise = jax.random.normal(key, mean.shape)
    action = jnp.tanh(mean + std * noise)
    density = -0.5 * jnp.square(noise) - jnp.log(std) - 0.5 * jnp.log(2 * jnp.pi)
    log_prob = (density - jnp.log(1 - jnp.square(action) + _LEAST)).sum(axis=-1)
    value = _energy(*_embedded(config, critic, batch.obs, action, goal))
    loss = weighted_mean(jnp.exp(log_alpha) * log_prob - value, batch.weight)
    if imitation is not None:
        loss += imitation.loss(jnp.tanh(_policy(config, actor, imitation.obs)[0]))
    return loss, {"actor_loss": loss, "entropy": -weighted_mean(log_prob, batch.weight)}


LEARNER = Learner(Config=CRLConfig, init=init, act=act, update=update)
