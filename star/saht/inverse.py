"""The local inverse model: which action reaches a goal, by weighted ridge regression over the neighbours of the goal.

With neighbours (x_i, y_i) of a goal g, weights w_i and the weighted means x', y',

    B = (sum_i w_i z_i z_i' + lambda I)^-1 sum_i w_i z_i (y_i - y')',   z_i = (x_i - x') / s,
    y(g) = y' + B' (g - x') / s,          w_i = exp(-(d_i / s)^2),      s = 2 (d_best + `CLOSE`),

d_i being the distance of x_i from g. It is linear in the neighbourhood; without slope it is their weighted mean.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from star.saht.memory import Memory, Neighbours

RIDGE = 0.01  # lambda
CLOSE = 0.01  # of distances: neighbours closer than this are as good as one another
SAME_WAY = 0.5  # root mean square of the differences of two actions that do the same in the same way


def regress(
    inputs: Float[Array, "k 4"],
    outputs: Float[Array, "k n"],
    distances: Float[Array, "k"],
    used: Bool[Array, "k"],
    goal: Float[Array, "4"],
) -> Float[Array, "n"]:
    """The output at `goal`, from those neighbours that are `used`; at least one must be."""
    nearest = jnp.where(used, distances, jnp.inf).min()
    reach = 2 * (jnp.where(jnp.isfinite(nearest), nearest, 0.0) + CLOSE)
    weights = jnp.where(used, jnp.exp(-jnp.square(distances / reach)), 0.0)
    weights = weights / jnp.maximum(weights.sum(), 1e-9)
    middle, mean = weights @ inputs, weights @ outputs
    apart = (inputs - middle) / reach * used[:, None]
    moments = (weights[:, None] * apart).T @ apart + RIDGE * jnp.eye(4)
    slopes = jnp.linalg.solve(moments, (weights[:, None] * apart).T @ (outputs - mean))
    return mean + (goal - middle) / reach @ slopes


def same_way(memory: Memory, near: Neighbours) -> Bool[Array, "k"]:
    """True for neighbours of the best one's length that do it in the same way: two ways must not be averaged."""
    sequences, lengths = memory.sequences[near.rows], memory.lengths[near.rows]
    _, longest, numbers = sequences.shape
    played = (jnp.arange(longest) < lengths[0])[:, None]
    apart = jnp.sum(jnp.square(sequences - sequences[0]) * played, axis=(1, 2)) / (lengths[0] * numbers)
    return near.known & (lengths == lengths[0]) & (apart <= SAME_WAY**2)


def action(memory: Memory, near: Neighbours, goal: Float[Array, "4"], dims: Array) -> Float[Array, "L p"]:
    """A sequence, as long as that of the best neighbour, for a goal of so many dimensions.

    Neighbours count that do it in the same way. Where fewer than `dims` + 1 remain it is the best one's own.
    """
    sequences, used = memory.sequences[near.rows], same_way(memory, near)
    found = regress(near.outcomes, sequences.reshape(len(sequences), -1), near.distances, used, goal)
    enough = used.sum() > dims
    return jnp.clip(jnp.where(enough, found.reshape(sequences.shape[1:]), sequences[0]), -1.0, 1.0)
