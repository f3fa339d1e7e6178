"""One flat batch axis, however many vmaps surround a function, and its share for each device of a mesh."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jax.sharding import PartitionSpec

AXIS = "envs"
"""The axis of a mesh of devices over which environments are shared out."""

T = TypeVar("T")


def where(mask: jax.Array, new: T, old: T) -> T:
    """`new` where `mask` [...] is set, else `old`: pytrees whose leaves [..., ...] begin with the axes of the mask."""

    def pick(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)

    return jax.tree.map(pick, new, old)


def flattened(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of pytrees with a leading batch axis [n, ...], made to see a single such axis under any vmaps.

    A vmap over S calls it once with [S * n, ...], arguments that are not batched repeated, and returns [S, n, ...].
    Derivatives, forward or backward, are those of `function` itself; vmaps around them nest.
    """
    inner = custom_vmap(_without_empty_constants(function))

    @inner.def_vmap
    def rule(axis_size: int, in_batched: Any, *args: Any) -> tuple[Any, Any]:
        def flatten(leaf: jax.Array, batched: bool) -> jax.Array:
            whole = leaf if batched else jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
            return whole.reshape(whole.shape[0] * whole.shape[1], *whole.shape[2:])

        out = inner(*jax.tree.map(flatten, args, tuple(in_batched)))
        out = jax.tree.map(lambda leaf: leaf.reshape(axis_size, leaf.shape[0] // axis_size, *leaf.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    outer = jax.custom_jvp(inner)  # JAX cannot differentiate a `custom_vmap` backward

    @outer.defjvp
    def derivative(primals: Any, tangents: Any) -> Any:
        return jax.jvp(function, primals, tangents)

    return outer


def shared_out(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of pytrees with a leading batch axis [n, ...], called by each device for its share of the batch.

    Its result must have the structure of its first argument, and be empty only where that is. Where the mesh of the
    context has no axis `AXIS` it is `function` itself. Else its size must divide n, and a vmap over S around it makes
    [S, n / devices, ...] of the share, not of the whole. JAX's partitioner could not do it: neither host callbacks nor
    kernels of Warp tell it how to cut them.

    Arrays without elements stay outside, as do those that a `flattened` function holds (but not functions jitted within
    it): XLA takes them out of what `jax.shard_map` is given before it cuts the program for GPUs, and crashes on what is
    left (jaxlib 0.11.2).
    """

    def call(*args: Any) -> Any:
        mesh = jax.sharding.get_abstract_mesh()
        if AXIS not in mesh.axis_names:
            return function(*args)

        def on_share(*shares: Any) -> Any:
            whole = _with_empty(shares, args, mesh.shape[AXIS])
            result = function(*whole)
            jax.tree.map(_check_empty, result, whole[0])
            return _without_empty(result)

        share = PartitionSpec(AXIS)
        shared = jax.shard_map(on_share, in_specs=share, out_specs=share, check_vma=False)
        return _with_empty(shared(*_without_empty(args)), args[0], 1)

    return call


def _check_empty(leaf: jax.Array, like: jax.Array) -> None:
    assert leaf.size or (leaf.shape, leaf.dtype) == (like.shape, like.dtype), "an empty result is unlike the argument"


def _without_empty(tree: Any) -> Any:
    """`tree` with None in place of arrays without elements."""
    return jax.tree.map(lambda leaf: leaf if leaf.size else None, tree)


def _with_empty(tree: Any, like: Any, parts: int) -> Any:
    """`tree` with arrays in place of None, as in `like` but with a part of the leading axis."""

    def fill(leaf: jax.Array | None, like: jax.Array | None) -> jax.Array | None:
        if leaf is not None or like is None:
            return leaf
        return jnp.zeros((like.shape[0] // parts, *like.shape[1:]), like.dtype)

    return jax.tree.map(fill, tree, like, is_leaf=lambda leaf: leaf is None)


def _without_empty_constants(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, on a mesh with operations in place of the arrays without elements that it holds."""

    def call(*args: Any) -> Any:
        if AXIS not in jax.sharding.get_abstract_mesh().axis_names:
            return function(*args)
        traced, shape = jax.make_jaxpr(function, return_shape=True)(*args)
        constants = [jnp.zeros(c.shape, c.dtype) if c.size == 0 else c for c in traced.consts]
        leaves = jax.core.eval_jaxpr(traced.jaxpr, constants, *jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(shape), leaves)

    return call
