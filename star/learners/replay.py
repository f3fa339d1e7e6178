"""Transitions of a level, and the rings that keep them.

The rings are flashbax item buffers; the functions here add masked batches to them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flashbax
import jax
import jax.numpy as jnp
from flashbax.buffers.trajectory_buffer import TrajectoryBufferState as Ring
from flax import struct
from jaxtyping import Array, Float


class Transition(struct.PyTreeNode):
    """One decision of a level and what came of it. Leading axes: [T, B] in a rollout, [N] in a batch.

    `terminated` ends the task: no bootstrap. `cut` ends the chain of decisions under one goal: bootstrap from
    `next_obs`, which still shows the old goal, but carry no advantage across. `weight` is 0 for decisions taken
    after the environment had ended, else 1. `extras` is what relabelling needs.
    """

    obs: Float[Array, "*batch obs"]
    action: Float[Array, "*batch act"]
    reward: Float[Array, "*batch"]
    next_obs: Float[Array, "*batch obs"]
    terminated: Float[Array, "*batch"]
    cut: Float[Array, "*batch"]
    weight: Float[Array, "*batch"]
    extras: Any = ()


class Track(struct.PyTreeNode):
    """The agent's place before an env step, and the end of its way: extras of learners that look into the future.

    `over` is 1 where the episode ends with this env step, before its time. `epoch` differs from epoch to epoch: none
    goes on into the next.
    """

    place: Float[Array, "*batch k"]
    over: Float[Array, "*batch"]
    epoch: Float[Array, "*batch"]


class Imitation(struct.PyTreeNode):
    """Actions that were demonstrated, for the actor's mean to come near: mean of weight * ||mean(o) - a||^2 / 2."""

    obs: Float[Array, "M obs"]
    action: Float[Array, "M act"]
    weight: Float[Array, "M"]

    def loss(self, mean: Float[Array, "M act"]) -> Float[Array, ""]:
        """Term added to the actor's loss; `mean` is what it would do on `obs`."""
        return 0.5 * jnp.mean(self.weight * jnp.sum(jnp.square(mean - self.action), axis=-1))


Relabel = Callable[[Transition, Array], Transition]
"""A batch that is replayed, rewritten in the light of what is known today, with a random key."""

Penalty = Callable[[Transition, Array], Array]
"""The price [N] of actions [N, act] that an actor would take in a batch of transitions."""


def flatten(batch: Any) -> Any:
    """Merge the leading two axes, [T, B, ...] to [T * B, ...]."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)


def weighted_mean(x: Float[Array, "*n"], weight: Float[Array, "*n"]) -> Float[Array, ""]:
    """Mean of `x` where `weight` is 1 and not 0; 0 if there is nothing of weight 1."""
    return jnp.sum(x * weight) / jnp.maximum(weight.sum(), 1.0)


def create(example: Any, *, size: int) -> Ring:
    """An empty ring of `size` items shaped like `example` (no leading axis)."""
    ring = _buffer(size, 1).init(example)
    # flashbax leaves what was in the memory before, NaN too; and its index has a weak type, which compiles twice
    return jax.tree.map(lambda x: jnp.zeros_like(x, dtype=x.dtype), ring)


def add(ring: Ring, items: Any) -> Ring:
    """Write items [N, ...] over the oldest; N at most the ring's size."""
    return _buffer(capacity(ring), 1).add(ring, items)


def sample(ring: Ring, key: Array, *, batch_size: int) -> Any:
    """`batch_size` items drawn uniformly with replacement from those written so far."""
    return _buffer(capacity(ring), batch_size).sample(ring, key).experience


def capacity(ring: Ring) -> int:
    """The number of items that the ring can hold."""
    return jax.tree.leaves(ring.experience)[0].shape[1]


def filled(ring: Ring) -> Array:
    """Number of items written so far, at most the capacity."""
    return jnp.where(ring.is_full, capacity(ring), ring.current_index)


def contents(ring: Ring) -> tuple[Any, Float[Array, "size"]]:
    """All slots [size, ...] and a mask that is 1 where something has been written."""
    items = jax.tree.map(lambda x: x[0], ring.experience)
    return items, (jnp.arange(capacity(ring)) < filled(ring)).astype(jnp.float32)


def _buffer(size: int, batch_size: int) -> Any:
    return flashbax.make_item_buffer(
        max_length=size, min_length=1, sample_batch_size=batch_size, add_sequences=False, add_batches=True
    )
