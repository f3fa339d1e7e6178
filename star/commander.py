"""The Commander: chooses the target region, every k env steps, by tabular Q-learning over regions.

    target  <- epsilon-greedy in Q[region, goal region, .] over the successors that reachability allows
    after k steps, with r = max (`max`, published) or mean (`mean`) over them of -||g* - s||:
    Q[i, g, j] <- Q + alpha_n (r + gamma max_j' Q[i', g, j'] - Q)

The B environments are B streams of one table: the errors of a cell are averaged over the n decisions of a batch that
visited it, and alpha_n = 1 - (1 - alpha)^n is the step that n updates in a row towards that average would make. A batch
is what all streams decided at one instant (`sweeps` 0, published), or in a whole epoch, swept `sweeps` times.

Source: STAR (ICLR 2024), section 4.1.
"""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from star.abstraction import inherit
from star.config import CommanderConfig

Metrics = dict[str, Array]


class CommanderState(struct.PyTreeNode):
    """Q over (region, goal region, target region), and how often each target was chosen of late."""

    q: Float[Array, "R R R"]
    chosen: Float[Array, "R"]


class Decision(struct.PyTreeNode):
    """Finished periods of N streams; `weight` is 1 where the period really lasted k env steps, else 0."""

    region: Int[Array, "N"]
    goal_region: Int[Array, "N"]
    target: Int[Array, "N"]
    reward: Float[Array, "N"]
    next_region: Int[Array, "N"]
    weight: Float[Array, "N"]


class Successors(struct.PyTreeNode):
    """Which targets may follow a region: `greedy` for the best choice, `explore` for the random one."""

    greedy: Bool[Array, "R R"]
    explore: Bool[Array, "R R"]


def init(*, regions: int) -> CommanderState:
    """Q = 0 everywhere: optimistic, since rewards are negative."""
    return CommanderState(q=jnp.zeros((regions, regions, regions)), chosen=jnp.zeros(regions))


def successors(
    mode: Literal["any", "possible", "known"],
    *,
    reaches: Bool[Array, "R R"],
    misses: Bool[Array, "R R"],
    active: Bool[Array, "R"],
) -> Successors:
    """Targets allowed from each region by what is known of reachability.

    Random choices leave out the targets shown unreachable. Greedy ones are made among all targets (`any`), among
    those not shown unreachable (`possible`), or among those shown reachable, if there are any (`known`, published).
    A region may always be its own target.
    """
    pairs = active[:, None] & active[None, :]
    own = jnp.eye(active.shape[0], dtype=bool)
    possible = pairs & (~misses | own)
    if mode != "known":
        return Successors(greedy=pairs if mode == "any" else possible, explore=possible)
    known = pairs & reaches & ~own
    has_known = known.any(axis=1, keepdims=True)
    return Successors(greedy=jnp.where(has_known, known | (own & pairs), possible), explore=possible)


def epsilon(config: CommanderConfig, env_steps: Float[Array, ""]) -> Float[Array, ""]:
    """Share of random choices after `env_steps` of all environments: linear, then constant."""
    progress = jnp.clip(env_steps / config.epsilon_steps, 0.0, 1.0)
    return config.epsilon_start + progress * (config.epsilon_end - config.epsilon_start)


def act(
    state: CommanderState,
    allowed: Successors,
    region: Int[Array, "B"],
    goal_region: Int[Array, "B"],
    *,
    epsilon: Float[Array, ""] | float,
    key: Array,
) -> Int[Array, "B"]:
    """Target regions: with probability `epsilon` any allowed one, else the best, ties broken at random."""
    explore_key, random_key, tie_key = jax.random.split(key, 3)
    best = _values(state.q, allowed.greedy, region, goal_region)
    ties = best >= best.max(axis=-1, keepdims=True)
    greedy = jnp.argmax(jnp.where(ties, jax.random.uniform(tie_key, best.shape), -1.0), axis=-1)
    anything = jnp.where(allowed.explore[region], jax.random.uniform(random_key, best.shape), -1.0)
    exploring = jax.random.uniform(explore_key, region.shape) < epsilon
    return jnp.where(exploring, jnp.argmax(anything, axis=-1), greedy)


def update(
    config: CommanderConfig, state: CommanderState, allowed: Successors, batch: Decision
) -> tuple[CommanderState, Metrics]:
    """One step of Q-learning on a batch; time limits are not seen here, so every period bootstraps."""
    future = _values(state.q, allowed.greedy, batch.next_region, batch.goal_region).max(axis=-1)
    cell = (batch.region, batch.goal_region, batch.target)
    error = batch.reward + config.discount * future - state.q[cell]
    visits = jnp.zeros_like(state.q).at[cell].add(batch.weight)
    total = jnp.zeros_like(state.q).at[cell].add(batch.weight * error)
    alpha = 1 - (1 - config.learning_rate) ** visits
    q = state.q + alpha * total / jnp.maximum(visits, 1.0)
    n = jnp.maximum(batch.weight.sum(), 1.0)
    metrics = {
        "reward": jnp.sum(batch.reward * batch.weight) / n,
        "td_error": jnp.sum(jnp.abs(error) * batch.weight) / n,
    }
    return state.replace(q=q), metrics


def start_reward(config: CommanderConfig) -> float:
    """What the reward of a period is accumulated from."""
    return -jnp.inf if config.reward == "max" else 0.0


def accumulate(
    config: CommanderConfig,
    reward: Float[Array, "B"],
    external: Float[Array, "l B"],
    alive: Float[Array, "l B"],
) -> Float[Array, "B"]:
    """The reward of periods so far, after l more env steps with external rewards r_ext; `alive` masks ended ones.

    The maximum is the same whether the agent stays at the goal or leaves it again; the mean tells them apart.
    """
    if config.reward == "max":
        return jnp.maximum(reward, jnp.where(alive > 0, external, -jnp.inf).max(axis=0))
    return reward + jnp.sum(external * alive, axis=0) / config.period


def sweep(
    config: CommanderConfig, state: CommanderState, allowed: Successors, batch: Decision
) -> tuple[CommanderState, Metrics]:
    """`config.sweeps` updates on the decisions of a whole epoch: fitted Q iteration.

    All environments live through the phases of an episode together, so the visitors of a cell at one instant are not
    representative (late in an episode, they are those that are stuck there); those of an epoch are.
    """
    state, metrics = jax.lax.scan(
        lambda state, _: update(config, state, allowed, batch), state, None, length=config.sweeps
    )
    return state, jax.tree.map(lambda x: x[-1], metrics)


def on_split(state: CommanderState, *, parent: Int[Array, ""], child: Int[Array, ""]) -> CommanderState:
    """The new region inherits rows and columns of the one it was cut from; they share its visits."""
    shared = state.chosen.at[parent].multiply(0.5)
    return CommanderState(
        q=inherit(state.q, parent=parent, child=child, axes=(0, 1, 2)),
        chosen=inherit(shared, parent=parent, child=child, axes=(0,)),
    )


def _values(q: Array, allowed: Bool[Array, "R R"], region: Array, goal_region: Array) -> Float[Array, "N R"]:
    return jnp.where(allowed[region], q[region, goal_region], -jnp.inf)
