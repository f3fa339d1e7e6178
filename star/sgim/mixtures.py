"""Mixtures of Gaussians by expectation maximisation, their number chosen by Akaike's criterion (Akaike 1974).

K is the largest number of components, d the dimensions of the points. All is pure: to be jitted, scanned and vmapped.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.stats import multivariate_normal
from jaxtyping import Array, Float, Int


class Mixture(NamedTuple):
    """Components; those beyond the number in use have no weight."""

    weights: Float[Array, "K"]
    means: Float[Array, "K d"]
    covariances: Float[Array, "K d d"]


def log_joint(mixture: Mixture, points: Float[Array, "n d"]) -> Float[Array, "n K"]:
    """Logarithm of each component's weight times its density at each point."""
    density = jax.vmap(multivariate_normal.logpdf, in_axes=(None, 0, 0), out_axes=-1)
    return jnp.log(mixture.weights) + density(points, mixture.means, mixture.covariances)


def improve(mixture: Mixture, points: Float[Array, "n d"], *, floor: float) -> Mixture:
    """One step of expectation maximisation; `floor` is added to variances."""
    n, d = points.shape
    blame = jax.nn.softmax(log_joint(mixture, points), axis=-1)
    total = blame.sum(axis=0)
    blame = blame / jnp.maximum(total, 1e-9)
    means = blame.T @ points
    apart = points[:, None] - means
    covariances = jnp.einsum("nk,nki,nkj->kij", blame, apart, apart) + floor * jnp.eye(d)
    return Mixture(weights=total / n, means=means, covariances=covariances)


def fit(
    points: Float[Array, "n d"], count: Int[Array, ""], *, most: int, steps: int = 30, floor: float = 1e-3, key: Array
) -> tuple[Mixture, Float[Array, ""]]:
    """`count` of `most` components fitted to points of unit scale, from random ones of them; and Akaike's criterion."""
    n, d = points.shape
    start = Mixture(
        weights=(jnp.arange(most) < count) / count,
        means=jax.random.choice(key, points, (most,), replace=False),
        covariances=jnp.broadcast_to(0.1 * jnp.eye(d), (most, d, d)),
    )
    mixture = jax.lax.fori_loop(0, steps, lambda _, now: improve(now, points, floor=floor), start)
    likelihood = jax.nn.logsumexp(log_joint(mixture, points), axis=-1).sum()
    return mixture, 2 * (count * (1 + d + d * (d + 1) // 2) - 1) - 2 * likelihood


def best_fit(points: Float[Array, "n d"], *, most: int, key: Array) -> Mixture:
    """The mixture of 1 to `most` components with the smallest criterion."""
    mixtures, criteria = jax.vmap(lambda count: fit(points, count, most=most, key=key))(jnp.arange(1, most + 1))
    return jax.tree.map(lambda leaf: leaf[jnp.argmin(criteria)], mixtures)
