"""The cut of a region of which only a part reaches another: between the leaves that do and those that do not."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from star.abstraction.reachability import Leaves
from star.abstraction.regions import Abstraction, Cut


def best_cut(
    abstraction: Abstraction,
    candidates: Bool[Array, "R"],
    leaves: Leaves,
    *,
    min_width: float | Array,
) -> tuple[Cut, Float[Array, ""]]:
    """The cut of one of the `candidates` that best parts reaching from missing leaves, and what it gains.

    The gain is the decrease of Gini impurity, as in a decision tree: the impurity of a part with volume v, of which r
    reaches, is r (v - r) / v; it is given as a share of the volume of all leaves. Cuts lie on leaf boundaries and
    leave both parts at least `min_width` wide.
    """
    positions = leaves.upper.T  # those of places not in use lie on the faces of the box, where nothing can be cut
    volume = jnp.prod(leaves.upper - leaves.lower, axis=-1)

    def overlap(lower: Array, upper: Array) -> Float[Array, "L"]:
        inside = jnp.minimum(upper, leaves.upper) - jnp.maximum(lower, leaves.lower)
        return jnp.prod(jnp.maximum(inside, 0.0), axis=-1)

    def impurity(part: Float[Array, "L"]) -> Array:
        reaching, missing = jnp.sum(part * leaves.reaches), jnp.sum(part * ~leaves.reaches)
        return reaching * missing / jnp.maximum(reaching + missing, 1e-12)

    def gain(region: Array, dimension: Array, position: Array) -> Array:
        lower, upper = abstraction.lower[region], abstraction.upper[region]
        wide = (position - lower[dimension] >= min_width) & (upper[dimension] - position >= min_width)
        below = overlap(lower, upper.at[dimension].set(jnp.minimum(position, upper[dimension])))
        whole = overlap(lower, upper)
        decrease = impurity(whole) - impurity(below) - impurity(whole - below)
        return jnp.where(wide & candidates[region], decrease / volume.sum(), 0.0)

    d, count = positions.shape
    every_region, every_dimension = jnp.arange(abstraction.capacity), jnp.arange(d)
    over_positions = jax.vmap(gain, in_axes=(None, None, 0))
    over_dimensions = jax.vmap(over_positions, in_axes=(None, 0, 0))
    gains = jax.vmap(over_dimensions, in_axes=(0, None, None))(every_region, every_dimension, positions)
    best = jnp.argmax(gains)
    region, dimension, index = jnp.unravel_index(best, (abstraction.capacity, d, count))
    return Cut(region=region, dimension=dimension, position=positions[dimension, index]), gains.reshape(-1)[best]


def random_cut(abstraction: Abstraction, region: Int[Array, ""], *, min_width: float | Array, key: Array) -> Cut:
    """A cut of `region` anywhere along any dimension that leaves both parts at least `min_width` wide."""
    dimension_key, position_key = jax.random.split(key)
    lowest, highest = abstraction.lower[region] + min_width, abstraction.upper[region] - min_width
    dimension = jax.random.categorical(dimension_key, jnp.where(lowest <= highest, 0.0, -jnp.inf))
    position = jax.random.uniform(position_key, minval=lowest[dimension], maxval=highest[dimension])
    return Cut(region=region, dimension=dimension, position=position)
