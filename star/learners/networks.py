"""Multilayer perceptrons and running normalisation: all the function approximation of the agent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float

from envs.common.batching import where

VARIANCE = 1 / 3  # of an initial weight, times the inputs of its layer, in JaxGCRL and ChronoSRL
_LEAST = 1e-6


class MLP(nn.Module):
    """Dense layers of the widths `hidden`, then a linear layer of width `out`.

    Initial weights of a layer with n inputs have the variance 2 `hidden_scale`^2 / n, those of the last one
    `final_scale`^2 / n: a small `final_scale` starts a policy near zero.
    """

    hidden: Sequence[int]
    out: int
    activation: Callable[[Array], Array] = nn.relu
    hidden_scale: float = 1.0
    final_scale: float = 1.0

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n"]) -> Float[Array, "*batch out"]:
        """Apply the network to the last axis of `x`."""

        # Not orthogonal initialisation: its QR decomposition, batched over seeds, hangs jaxlib 0.10 on CPUs.
        def dense(width: int, variance: float) -> nn.Dense:
            normal = nn.initializers.variance_scaling(variance, "fan_in", "truncated_normal")
            return nn.Dense(width, kernel_init=normal)

        for width in self.hidden:
            x = self.activation(dense(width, 2 * self.hidden_scale**2)(x))
        return dense(self.out, self.final_scale**2)(x)


class ResidualMLP(nn.Module):
    """A dense layer, `blocks` blocks of four more, and a linear layer of width `out`.

    Each dense layer is followed by LayerNorm and swish. The input of a block is added to its output. Layers of blocks
    are kept in arrays [blocks, 4, ...] of weights, biases, scales and shifts: any depth compiles like one layer.
    """

    width: int
    blocks: int
    out: int

    @nn.compact
    def __call__(self, x: Float[Array, "*batch n"]) -> Float[Array, "*batch out"]:
        """Apply the network to the last axis of `x`."""
        x = nn.swish(nn.LayerNorm()(uniform_dense(self.width)(x)))
        shape, zeros, ones = (self.blocks, 4, self.width), nn.initializers.zeros, nn.initializers.ones
        kernel = nn.initializers.variance_scaling(VARIANCE, "fan_in", "uniform", batch_axis=(0, 1))
        layers = (
            self.param("kernel", kernel, (*shape, self.width)),
            self.param("bias", zeros, shape),
            self.param("scale", ones, shape),
            self.param("shift", zeros, shape),
        )

        def layer(x: Array, params: tuple[Array, ...]) -> tuple[Array, None]:
            kernel, bias, scale, shift = params
            return nn.swish(scale * jax.nn.standardize(x @ kernel + bias, epsilon=1e-6) + shift), None

        def block(x: Array, params: tuple[Array, ...]) -> tuple[Array, None]:
            return x + jax.lax.scan(layer, x, params)[0], None

        return uniform_dense(self.out, name="out")(jax.lax.scan(block, x, layers)[0])


def uniform_dense(width: int, **more: Any) -> nn.Dense:
    """A dense layer whose initial weights are uniform, of variance `VARIANCE` / n with n inputs."""
    return nn.Dense(width, kernel_init=nn.initializers.variance_scaling(VARIANCE, "fan_in", "uniform"), **more)


def apply(mlp: nn.Module, params: Any, x: Float[Array, "*batch n"]) -> Float[Array, "*batch out"]:
    """Output of `mlp` with `params` for the last axis of `x`."""
    return jnp.asarray(mlp.apply(params, x))


def distance(x: Float[Array, "#*batch n"], y: Float[Array, "#*batch n"]) -> Float[Array, "..."]:
    """||x - y|| of vectors along the last axis, with a slope everywhere; the other axes are broadcast."""
    return jnp.sqrt(jnp.square(x - y).sum(axis=-1) + _LEAST)


def descend(
    loss: Callable[[Any, Array], Array],
    params: Any,
    optimizer: optax.OptState,
    *,
    learning_rate: float | Array,
    updates: int,
    key: Array,
) -> tuple[Any, optax.OptState, Float[Array, ""]]:
    """So many Adam steps on `loss(params, key)`: params, state of the optimiser, and the mean loss."""

    def step(carry: tuple, key: Array) -> tuple[tuple, Array]:
        params, optimizer = carry
        value, gradient = jax.value_and_grad(loss)(params, key)
        change, optimizer = optax.scale_by_adam().update(gradient, optimizer)
        return (jax.tree.map(lambda p, c: p - learning_rate * c, params, change), optimizer), value

    (params, optimizer), losses = jax.lax.scan(step, (params, optimizer), jax.random.split(key, updates))
    return params, optimizer, losses.mean()


def adam_step(
    params: Any, gradient: Any, optimizer: optax.OptState, learning_rate: float | Array, enabled: Array
) -> tuple[Any, optax.OptState]:
    """One Adam step, or nothing at all where `enabled` is false."""
    step, stepped = optax.scale_by_adam().update(gradient, optimizer)
    params = jax.tree.map(lambda p, s: p - jnp.where(enabled, learning_rate * s, 0.0), params, step)
    return params, where(enabled, stepped, optimizer)


class Normalizer(struct.PyTreeNode):
    """Running mean and variance of a vector, by the parallel update of Chan, Golub and LeVeque (1979)."""

    mean: Float[Array, "n"]
    variance: Float[Array, "n"]
    count: Float[Array, ""]

    @classmethod
    def create(cls, size: int) -> Normalizer:
        """Mean 0, variance 1, no data."""
        return cls(mean=jnp.zeros(size), variance=jnp.ones(size), count=jnp.zeros(()))

    def update(self, batch: Float[Array, "*batch n"], weight: Float[Array, "*batch"]) -> Normalizer:
        """Fold in the rows of `batch` with weight 1; rows with weight 0 do not count."""
        rows = tuple(range(weight.ndim))
        added = weight.sum()
        safe = jnp.maximum(added, 1.0)
        mean = (batch * weight[..., None]).sum(rows) / safe
        variance = (jnp.square(batch - mean) * weight[..., None]).sum(rows) / safe
        total = jnp.maximum(self.count + added, 1.0)
        delta = mean - self.mean
        pooled = (
            self.variance * self.count + variance * added + jnp.square(delta) * self.count * added / total
        ) / total
        return Normalizer(
            mean=self.mean + delta * added / total,
            variance=jnp.where(added > 0, pooled, self.variance),
            count=self.count + added,
        )

    def __call__(self, x: Float[Array, "*batch n"]) -> Float[Array, "*batch n"]:
        """`x` with mean 0 and variance 1, clipped to [-10, 10]."""
        return jnp.clip((x - self.mean) * jax.lax.rsqrt(self.variance + 1e-4), -10.0, 10.0)
