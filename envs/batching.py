"""One flat batch axis, however many vmaps surround a function, and its share for each device of a mesh."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.sharding import PartitionSpec

AXIS = "envs"
"""The axis of a mesh of devices over which environments are shared out."""


def flattened(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of pytrees with a leading batch axis [n, ...], made to see a single such axis under any vmaps.

    A vmap over S calls it once with [S * n, ...], arguments that are not batched repeated, and returns [S, n, ...].
    """
    inner = custom_vmap(function)

    @inner.def_vmap
    def rule(axis_size: int, in_batched: Any, *args: Any) -> tuple[Any, Any]:
        def flatten(leaf: jax.Array, batched: bool) -> jax.Array:
            whole = leaf if batched else jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
            return whole.reshape(whole.shape[0] * whole.shape[1], *whole.shape[2:])

        out = inner(*jax.tree.map(flatten, args, tuple(in_batched)))
        out = jax.tree.map(lambda leaf: leaf.reshape(axis_size, leaf.shape[0] // axis_size, *leaf.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return inner


def shared_out(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of pytrees with a leading batch axis [n, ...], called by each device for its share of the batch.

    Where the mesh of the context has no axis `AXIS` it is `function` itself. Else its size must divide n, and a vmap
    over S around it makes [S, n / devices, ...] of the share, not of the whole. JAX's partitioner could not do it:
    neither host callbacks nor kernels of Warp tell it how to cut them.
    """

    def call(*args: Any) -> Any:
        if AXIS not in jax.sharding.get_abstract_mesh().axis_names:
            return function(*args)
        share = PartitionSpec(AXIS)
        return jax.shard_map(function, in_specs=share, out_specs=share, check_vma=False)(*args)

    return call
