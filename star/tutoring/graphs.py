"""Graphs of prerequisites as matrices: [i, j] says that skill j comes before skill i."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Bool, Float


def ancestors(parents: Bool[Array, "n n"]) -> Bool[Array, "n n"]:
    """[i, j]: there is a way from j to i; the transitive closure."""
    closed = parents
    for _ in range(max(1, math.ceil(math.log2(len(parents))))):
        closed = closed | _product(closed, closed)
    return closed


def reduced(parents: Bool[Array, "n n"]) -> Bool[Array, "n n"]:
    """An acyclic graph without the edges that others imply; its `ancestors` are the same."""
    return parents & ~_product(parents, ancestors(parents))


def draw(n: int, *, key: Array) -> Bool[Array, "n n"]:
    """A random graph: skills in a random order, each pair an edge with probability 2 / (n - 1), then `reduced`."""
    order_key, edge_key = random.split(key)
    rank = random.permutation(order_key, n)
    edge = random.bernoulli(edge_key, min(1.0, 2 / max(n - 1, 1)), (n, n))
    return reduced(edge & (rank[:, None] > rank))


def depth(parents: Bool[Array, "n n"]) -> Array:
    """Number of skills that lie one before the other before each skill, at most: 0 for those without prerequisites."""
    deep = jnp.zeros(len(parents), jnp.int32)
    for _ in range(len(parents)):
        deep = jnp.where(parents, deep + 1, 0).max(axis=-1)
    return deep


def acyclic(strength: Float[Array, "n n"], threshold: float | Array) -> Bool[Array, "n n"]:
    """The graph of the edges above `threshold`, taken from the strongest down, but for those that close a cycle.

    What others imply is taken out.
    """
    n = len(strength)
    strength = jnp.where(jnp.eye(n, dtype=bool), -jnp.inf, strength)

    def add(state: tuple[Array, Array], edge: Array) -> tuple[tuple[Array, Array], None]:
        parents, above = state
        child, parent = edge // n, edge % n
        fits = (strength[child, parent] > threshold) & ~above[parent, child]
        below = above[:, child].at[child].set(True)
        before = above[parent].at[parent].set(True)
        above = above | (fits & below[:, None] & before)
        return (parents.at[child, parent].max(fits), above), None

    none = jnp.zeros((n, n), bool)
    parents = jax.lax.scan(add, (none, none), jnp.argsort(-strength.ravel()))[0][0]
    return reduced(parents)


def quality(true: Bool[Array, "n n"], found: Bool[Array, "n n"], strength: Float[Array, "n n"]) -> dict[str, Array]:
    """Precision and recall of the edges found, and the AUC of their strengths, over all ordered pairs of skills.

    Precision is 1 where nothing was found, recall 1 and AUC NaN where there is nothing to find.
    """
    other = ~jnp.eye(len(true), dtype=bool)
    edges, rest = true & other, ~true & other
    hits = (found & edges).sum()
    above = (strength.ravel()[:, None] > strength.ravel()) + 0.5 * (strength.ravel()[:, None] == strength.ravel())
    pairs = edges.ravel()[:, None] & rest.ravel()
    return {
        "precision": jnp.where(found.any(), hits / found.sum(), 1.0),
        "recall": jnp.where(edges.any(), hits / edges.sum(), 1.0),
        "auc": jnp.where(pairs, above, 0.0).sum() / pairs.sum(),
    }


def _product(a: Bool[Array, "n n"], b: Bool[Array, "n n"]) -> Bool[Array, "n n"]:
    return a.astype(jnp.float32) @ b.astype(jnp.float32) > 0
