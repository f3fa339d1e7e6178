"""Adjacency, for the baseline HRAC: a Tutor that is kept from subgoals out of reach within its period.

Abstract states are rounded to cells. Two cells are adjacent if some agent went from one to the other within the l env
steps of one decision. A network psi learns to tell, with margins eps_near < eps_far, in ||psi(a) - psi(b)||:

    adjacent:      max(||.|| - eps_near, 0)          otherwise:   max(eps_far - ||.||, 0)

and the Tutor's loss grows by weight * max(||psi(s) - psi(s + g)|| - limit, 0).

Source: HRAC (Zhang et al., NeurIPS 2020), sections 4.2 and 4.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from star.agent import tutor
from star.agent.sections import AdjacencyConfig, TutorConfig
from star.agent.task import Task
from star.learners.networks import MLP, apply, descend
from star.learners.replay import Penalty, Transition

Metrics = dict[str, Array]

MAX_CELLS = 8192  # the table of pairs holds its square


class AdjacencyState(struct.PyTreeNode):
    """The network psi, its optimiser, and which pairs of cells were found adjacent."""

    params: Mapping[str, Any]
    optimizer: optax.OptState
    adjacent: Bool[Array, "C C"]


def shape(config: AdjacencyConfig, space: tuple[tuple[float, ...], tuple[float, ...]]) -> tuple[int, ...]:
    """Cells along each abstract dimension of `space` (lower and upper corner)."""
    sides = np.subtract(space[1], space[0])
    return tuple(max(int(np.ceil(side / config.cell)), 1) for side in sides)


def init(
    key: Array, config: AdjacencyConfig, space: tuple[tuple[float, ...], tuple[float, ...]]
) -> AdjacencyState | None:
    """Nothing known, an untrained network; None where it is not asked for."""
    if not config.enabled:
        return None
    count = int(np.prod(shape(config, space)))
    params = _mlp(config).init(key, jnp.zeros(len(space[0])))
    return AdjacencyState(
        params=params, optimizer=optax.scale_by_adam().init(params), adjacent=jnp.zeros((count, count), bool)
    )


def locate(
    config: AdjacencyConfig, space: tuple[tuple[float, ...], tuple[float, ...]], point: Float[Array, "*n d"]
) -> Int[Array, "*n"]:
    """Index of the cell that holds `point`, or of the one nearest to it."""
    cells = shape(config, space)
    along = jnp.floor((point - jnp.asarray(space[0])) / config.cell).astype(jnp.int32)
    along = jnp.clip(along, 0, jnp.asarray(cells) - 1)
    return jnp.ravel_multi_index(tuple(jnp.moveaxis(along, -1, 0)), cells, mode="clip")


def observe(
    config: AdjacencyConfig,
    state: AdjacencyState | None,
    space: tuple[tuple[float, ...], tuple[float, ...]],
    path: Float[Array, "states B d"],
    alive: Float[Array, "l B"],
) -> AdjacencyState | None:
    """Cells that an agent visited within the same l env steps are adjacent; `alive` masks steps after its end."""
    if state is None:
        return None
    cell = locate(config, space, path)
    valid = jnp.concatenate([jnp.ones_like(alive[:1]), alive]) > 0
    first, second = np.triu_indices(path.shape[0], 1)
    both = valid[first] & valid[second]
    a, b = jnp.where(both, cell[first], cell[0]), jnp.where(both, cell[second], cell[0])
    return state.replace(adjacent=state.adjacent.at[a, b].set(True).at[b, a].set(True))


def train(
    config: AdjacencyConfig,
    state: AdjacencyState,
    space: tuple[tuple[float, ...], tuple[float, ...]],
    *,
    key: Array,
) -> tuple[AdjacencyState, Metrics]:
    """`updates_per_epoch` updates of psi on visited cells, each with an adjacent one and one that is not."""
    visited = state.adjacent.any(axis=1)
    centre = _centres(config, space)

    def loss(params: Any, step_key: Array) -> Array:
        anchor_key, near_key, far_key = jax.random.split(step_key, 3)
        anchor = _draw(jnp.broadcast_to(visited, (config.batch_size, visited.shape[0])), anchor_key)
        near = _draw(state.adjacent[anchor], near_key)
        others = visited & ~state.adjacent[anchor]
        far = _draw(others, far_key)
        known = visited.any()
        return _loss(config, params, centre[anchor], centre[near], centre[far], others.any(axis=1), known)

    rate, updates = config.learning_rate, config.updates_per_epoch
    params, optimizer, mean_loss = descend(
        loss, state.params, state.optimizer, learning_rate=rate, updates=updates, key=key
    )
    share = state.adjacent.sum() / jnp.maximum(jnp.square(visited.sum()), 1)
    return state.replace(params=params, optimizer=optimizer), {"loss": mean_loss, "share": share}


def price(section: TutorConfig, task: Task, state: AdjacencyState | None) -> Penalty | None:
    """The price of subgoals in a batch of the Tutor's, by how far they are out of reach; None if there is none."""
    if state is None:
        return None
    spec, d = task.spec, len(task.spec.abstract_indices)

    def of(batch: Transition, action: Array) -> Float[Array, "N"]:
        start, way = tutor.began(section, batch)[..., :d], (action * spec.scale)[..., :d]
        return penalty(section.adjacency, state, start, way)

    return of


def penalty(
    config: AdjacencyConfig, state: AdjacencyState, start: Float[Array, "N d"], subgoal: Float[Array, "N d"]
) -> Float[Array, "N"]:
    """Loss of the Tutor's actor from relative subgoals beyond the reach of psi."""
    apart = _distance(config, state.params, start, start + subgoal)
    return config.weight * jnp.maximum(apart - config.limit, 0.0)


def _mlp(config: AdjacencyConfig) -> MLP:
    return MLP(config.hidden, config.features)


def _distance(config: AdjacencyConfig, params: Any, a: Array, b: Array) -> Float[Array, "*N"]:
    difference = apply(_mlp(config), params, a) - apply(_mlp(config), params, b)
    return jnp.sqrt(jnp.square(difference).sum(axis=-1) + 1e-12)


def _loss(
    config: AdjacencyConfig, params: Any, anchor: Array, near: Array, far: Array, weight: Array, known: Array
) -> Array:
    close = jnp.maximum(_distance(config, params, anchor, near) - config.near, 0.0)
    apart = jnp.maximum(config.far - _distance(config, params, anchor, far), 0.0)
    return known * (close + weight * apart).mean()


def _draw(mask: Bool[Array, "N C"], key: Array) -> Int[Array, "N"]:
    """A random true entry of each row."""
    return jnp.argmax(jnp.where(mask, jax.random.uniform(key, mask.shape), -1.0), axis=-1)


def _centres(config: AdjacencyConfig, space: tuple[tuple[float, ...], tuple[float, ...]]) -> Float[Array, "C d"]:
    axes = [low + config.cell * (np.arange(n) + 0.5) for low, n in zip(space[0], shape(config, space), strict=True)]
    return jnp.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(axes)), jnp.float32)
