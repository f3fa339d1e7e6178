"""Stochastic policies with actions in [-1, 1]: the tanh of a Gaussian, whose entropy a temperature keeps (SAC).

    a = tanh(mu + sigma eps),  eps ~ N(0, 1)
    alpha is moved so that the entropy comes to -1/2 for each number of an action

Source: Haarnoja et al. 2018, Soft actor-critic algorithms and applications, sections 5 and C.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

LOG_STD = (-5.0, 2.0)  # of actions before tanh
ENTROPY = -0.5  # wanted of each number of an action, nats
_LEAST = 1e-6


def moments(out: Float[Array, "*batch m"]) -> tuple[Float[Array, "*batch n"], Float[Array, "*batch n"]]:
    """Mean and deviation of actions before tanh, of what a network puts out."""
    mean, raw = jnp.split(out, 2, axis=-1)
    low, high = LOG_STD
    return mean, jnp.exp(low + 0.5 * (high - low) * (jnp.tanh(raw) + 1.0))


def act(
    mean: Float[Array, "*batch n"], std: Float[Array, "*batch n"], *, deterministic: bool, key: Array
) -> Float[Array, "*batch n"]:
    """Actions in [-1, 1]: drawn, or `deterministic` ones in the middle of what would be drawn."""
    noise = 0.0 if deterministic else jax.random.normal(key, mean.shape)
    return jnp.tanh(mean + std * noise)


def draw(
    mean: Float[Array, "*batch n"], std: Float[Array, "*batch n"], *, key: Array
) -> tuple[Float[Array, "*batch n"], Float[Array, "*batch"]]:
    """Actions, and the logarithm of their density."""
    noise = jax.random.normal(key, mean.shape)
    action = jnp.tanh(mean + std * noise)
    density = -0.5 * jnp.square(noise) - jnp.log(std) - 0.5 * jnp.log(2 * jnp.pi)
    return action, (density - jnp.log(1 - jnp.square(action) + _LEAST)).sum(axis=-1)


def temperature_gradient(log_alpha: Float[Array, ""], entropy: Float[Array, ""], *, size: int) -> Float[Array, ""]:
    """Gradient for `log_alpha`, given the entropy (nats) of actions of `size` numbers."""
    return jnp.exp(log_alpha) * (entropy - ENTROPY * size)
