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
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from star import devices
from star.learners import futures, replay, squashed
from star.learners.futures import Future, ReplayState, Step, ahead
from star.learners.networks import MLP, VARIANCE, apply, distance
from star.learners.protocol import Learner
from star.learners.replay import Imitation, Transition, weighted_mean
from star.learners.sections import CRLConfig

Metrics = dict[str, Array]


def _mlp(config: CRLConfig, out: int) -> MLP:
    return MLP(config.hidden, out, activation=nn.swish, hidden_scale=(VARIANCE / 2) ** 0.5, final_scale=VARIANCE**0.5)


def init(key: Array, config: CRLConfig, *, example: Transition) -> ReplayState:
    """A learner for transitions shaped like `example` (no leading axes), whose extras are a `Track`.

    The two halves of its critic are `action`, which is phi, and `goal`, which is psi.
    """
    actor_key, action_key, goal_key = jax.random.split(key, 3)
    (size,), goal = example.action.shape, example.extras.place
    state = example.obs[: -len(goal)]
    params: Mapping[str, Any] = {
        "actor": _mlp(config, 2 * size).init(actor_key, example.obs),
        "critic": {
            "action": _mlp(config, config.representation).init(action_key, jnp.concatenate([state, example.action])),
            "goal": _mlp(config, config.representation).init(goal_key, goal),
        },
    }
    return ReplayState.create(params, Step.of(example), size=config.buffer_size)


def act(
    config: CRLConfig, state: ReplayState, obs: Float[Array, "*batch obs"], *, deterministic: bool = False, key: Array
) -> Float[Array, "*batch act"]:
    """Actions in [-1, 1]: drawn, or `deterministic` ones in the middle of what would be drawn."""
    return squashed.act(*_policy(config, state.params["actor"], obs), deterministic=deterministic, key=key)


def _policy(config: CRLConfig, params: Any, obs: Array) -> tuple[Array, Array]:
    """Mean and deviation of actions before tanh."""
    size = params["params"][f"Dense_{len(config.hidden)}"]["bias"].shape[-1]
    return squashed.moments(apply(_mlp(config, size), params, obs))


def _drawn(config: CRLConfig, ring: replay.Ring, future: Future, key: Array) -> tuple[Step, Float[Array, "N k"]]:
    """A batch of steps that others follow, and its goals; without weight if there are none."""
    slot_key, ahead_key = jax.random.split(key)
    items, _ = replay.contents(ring)
    slot = future.draw(slot_key, size=config.batch_size)
    steps = ahead(future.left[slot], jax.random.uniform(ahead_key, slot.shape), discount=config.discount)
    batch = jax.tree.map(lambda x: x[slot], items)
    goal = future.later(items.track.place, slot, steps)
    return batch.replace(weight=batch.weight * (steps > 0)), goal


def _one_update(
    config: CRLConfig, imitation: Imitation | None, future: Future, state: ReplayState, key: Array
) -> tuple[ReplayState, Metrics]:
    draw_key, noise_key = jax.random.split(key)
    batch, goal = devices.whole(_drawn(config, state.ring, future, draw_key))
    ready = replay.filled(state.ring) >= config.min_transitions
    critic_slope, told = jax.grad(partial(_critic_loss, config), has_aux=True)(state.params["critic"], batch, goal)
    actor_slope, more = jax.grad(partial(_actor_loss, config, imitation), has_aux=True)(
        state.params["actor"], state.params["critic"], state.log_alpha, batch, goal, noise_key
    )
    alpha_slope = squashed.temperature_gradient(state.log_alpha, more["entropy"], size=batch.action.shape[-1])
    slopes = {"actor": actor_slope, "critic": critic_slope, "alpha": alpha_slope}
    metrics = told | more | {"alpha": jnp.exp(state.log_alpha)}
    state = state.stepped(slopes, rate=config.learning_rate, ready=ready)
    return state.replace(updates=state.updates + ready.astype(jnp.int32)), metrics


def _embedded(config: CRLConfig, critic: Any, obs: Array, action: Array, goal: Array) -> tuple[Array, Array]:
    """phi(s, a) and psi(g)."""
    mlp, state = _mlp(config, config.representation), obs[..., : -goal.shape[-1]]
    together = jnp.concatenate([state, action], axis=-1)
    return apply(mlp, critic["action"], together), apply(mlp, critic["goal"], goal)


def _critic_loss(config: CRLConfig, critic: Any, batch: Step, goal: Array) -> tuple[Array, Metrics]:
    phi, psi = _embedded(config, critic, batch.obs, batch.action, goal)
    logits = -distance(phi[:, None], psi[None])
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
    action, log_prob = squashed.draw(*_policy(config, actor, seen), key=key)
    value = -distance(*_embedded(config, critic, batch.obs, action, goal))
    loss = weighted_mean(jnp.exp(log_alpha) * log_prob - value, batch.weight)
    if imitation is not None:
        loss += imitation.loss(jnp.tanh(_policy(config, actor, imitation.obs)[0]))
    return loss, {"actor_loss": loss, "entropy": -weighted_mean(log_prob, batch.weight)}


LEARNER = Learner(Config=CRLConfig, init=init, act=act, update=futures.updating(_one_update))
